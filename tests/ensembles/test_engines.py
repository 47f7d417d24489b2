"""Engines that really run: processes, joblib, a dask cluster of which a worker is killed; the example of a cluster."""

import importlib.util
import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import sympflow

CLUSTER = Path(__file__).parents[2] / "examples" / "cluster"
SYSTEM = sympflow.systems.henon_heiles()
STATES = SYSTEM.domain.sample(400, 1)


def final(workers, **how):
    return sympflow.ensemble(SYSTEM, "verlet", (0, 5), STATES, dt=0.1, reduce="final", workers=workers, **how)


@pytest.mark.slow
def test_processes_and_joblib():
    joblib = pytest.importorskip("joblib")
    expected = final(1).final
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        assert np.array_equal(final(pool).final, expected)
    assert np.array_equal(final(joblib.Parallel(2)).final, expected)
    joblib.externals.loky.get_reusable_executor().shutdown()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of dask, about what it loses
def test_a_dask_cluster_one_of_whose_workers_is_killed(tmp_path):
    distributed = pytest.importorskip("distributed")
    expected = final(1).final
    killed = []

    def kill(done, total):
        if done >= 20 and not killed:
            killed.append(pids[0])
            os.kill(pids[0], signal.SIGKILL)

    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = list(client.run(os.getpid).values())
        result = final(client, chunk=2, progress=kill, store=tmp_path / "a.zarr")
        assert killed
    assert np.array_equal(result.final, expected)


def example():
    spec = importlib.util.spec_from_file_location("cluster_example", CLUSTER / "slurm.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_example_runs(tmp_path):
    result = example().run(1, 64, str(tmp_path / "a.zarr"))
    assert result.energy_error.max() < 1e-3


@pytest.mark.slow
def test_compiling_in_several_threads_at_once():
    """Threads of a program that calls ensembles at the same time."""
    system = sympflow.HamiltonianSystem.from_sympy("p**2/2 + q**2/2 + q**4/17", y0=[1.0, 0.0], dt=0.1)
    found = []
    threads = [
        threading.Thread(target=lambda: found.append(sympflow.ensemble(system, "verlet", (0, 1)).y)) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 3
    assert all(np.array_equal(y, found[0]) for y in found)
