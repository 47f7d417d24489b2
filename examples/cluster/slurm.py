"""A large ensemble on a SLURM cluster, by dask-jobqueue: chaotic and regular orbits of Hénon–Heiles.

python examples/cluster/slurm.py --script                  prints the job script that each job is submitted with
python examples/cluster/slurm.py --jobs 32 --orbits 1e9    submits 32 jobs and runs; needs pip install dask-jobqueue
python examples/cluster/slurm.py --here --orbits 1e5       runs on two processes of this machine, to try it out

A run that ends early, by a limit of time or a crash, is gone on with by the same command: what is in the store is not
done again. The store must lie on a file system that all nodes see.
"""

from __future__ import annotations

import argparse
from typing import Any

import sympflow

JOB: dict[str, Any] = {
    "cores": 32,  # of a job, which takes a part of one node
    "processes": 32,  # a worker for each core: a chunk runs on one thread
    "memory": "64GB",
    "walltime": "02:00:00",
    "queue": "main",
    "job_extra_directives": ["--export=ALL"],
    # workers that are not told to stop before the limit of time are killed there, and their chunks done again
    "worker_extra_args": ["--lifetime", "115m", "--lifetime-stagger", "4m"],
    # compiled loops are kept in a folder that the workers of a node share
    "job_script_prologue": ["export SYMPFLOW_CACHE_DIR=${TMPDIR:-/tmp}/sympflow-$USER"],
}
"""The request to SLURM; put in the queue and the limits of your cluster."""


def slurm_cluster() -> Any:
    from dask_jobqueue import SLURMCluster

    return SLURMCluster(**JOB)


def run(client: Any, orbits: int, store: str) -> Any:
    system = sympflow.systems.henon_heiles()
    return sympflow.ensemble(
        system,
        "kahan_li8",
        (0, 1000),
        system.domain,
        n=orbits,
        dt=0.5,
        reduce="energy_error",
        workers=client,
        store=store,
        resume=True,
        progress=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--script", action="store_true", help="print the job script and end")
    parser.add_argument("--here", action="store_true", help="run on two processes of this machine")
    parser.add_argument("--jobs", type=int, default=32)
    parser.add_argument("--orbits", type=float, default=1e6)
    parser.add_argument("--store", default="henon-heiles.zarr")
    given = parser.parse_args()
    if given.here:
        from distributed import LocalCluster

        cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    else:
        cluster = slurm_cluster()
    with cluster:
        if given.script:
            print(cluster.job_script())
            return
        if not given.here:
            cluster.scale(jobs=given.jobs)
        with cluster.get_client() as client:
            result = run(client, int(given.orbits), given.store)
    print(result.message, f"{result.wall_time:.1f} s; read them by xarray.open_zarr({given.store!r}).")


if __name__ == "__main__":
    main()
