#!/usr/bin/env bash

#SBATCH -J dask-worker
#SBATCH -p main
#SBATCH -n 1
#SBATCH --cpus-per-task=32
#SBATCH --mem=60G
#SBATCH -t 02:00:00
#SBATCH --export=ALL
export SYMPFLOW_CACHE_DIR=${TMPDIR:-/tmp}/sympflow-$USER
python -m distributed.cli.dask_worker tcp://SCHEDULER:PORT --name dummy-name --nthreads 1 --memory-limit 1.86GiB --nworkers 32 --nanny --death-timeout 60 --lifetime 115m --lifetime-stagger 4m
