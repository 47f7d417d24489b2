"""The cost of an ensemble: time against the number of orbits, the overhead of a chunk, the memory with a store, and the
gain of two processes in a fit. Set OMP_NUM_THREADS=1, so that processes do not share cores with each other's threads.

    python benchmarks/ensembles.py [--out docs/measured]
    python benchmarks/ensembles.py --memory --orbits 1e7        peak memory of a process that writes a store

Hénon–Heiles, Verlet, dt 0.1, T = 100, final states, y0 from the domain. Wall time; runs with one and two workers
are timed in turn, and the least of each counts. The overhead of a chunk is the time of an ensemble of many chunks of
one orbit, each of one step, divided by their number: with one worker at a time, so that nothing is hidden.
"""

from __future__ import annotations

import argparse
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from measuring import fragments

import sympflow

SYSTEM = sympflow.systems.henon_heiles()
COUNTS = (1_000, 10_000, 100_000, 1_000_000)
END, DT, CHUNKS = 100.0, 0.1, 200
STARTS = 600  # of a primed flow's fit
ORBITS, CORES = 1e9, 1000  # of the extrapolation


def ensemble(y0: Any, **how: Any) -> Any:
    return sympflow.ensemble(SYSTEM, "verlet", (0, END), y0, dt=DT, reduce="final", **how)


def seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def growth(rounds: int) -> dict[int, tuple[float, float]]:
    """Wall times with one and two workers, by the number of orbits."""
    states = SYSTEM.domain.sample(max(COUNTS), 1)
    ensemble(states[:1000])  # compiled
    found = {}
    for n in COUNTS:
        times = [[seconds(lambda w=w, n=n: ensemble(states[:n], workers=w)) for w in (1, 2)] for _ in range(rounds)]
        found[n] = tuple(np.min(times, axis=0).tolist())
    return found


def tiny(workers: Any, store: Path | None = None) -> Any:
    """An ensemble of which each chunk is next to no work."""
    states = np.tile(SYSTEM.y0, (CHUNKS, 1))
    how = {"dt": DT, "reduce": "final", "chunk": 1, "workers": workers}
    return sympflow.ensemble(SYSTEM, "verlet", (0, DT), states, store=store, **how)


def overheads(rounds: int) -> dict[str, float]:
    """Seconds a chunk, by the engine."""
    from distributed import Client, LocalCluster

    def least(workers: Any, stored: bool = False) -> float:
        with tempfile.TemporaryDirectory() as folder:
            tiny(workers)  # started, and compiled there
            return (
                min(seconds(lambda i=i: tiny(workers, Path(folder, str(i)) if stored else None)) for i in range(rounds))
                / CHUNKS
            )

    found = {"this thread": least(1), "this thread, with `store`": least(1, True)}
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found["`ProcessPoolExecutor`, one process"] = least(pool)
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        found["dask `LocalCluster`, one process"] = least(client)
    return found


def highest() -> float:
    """The peak memory of this process so far, in MB; of a Linux system, whose `ru_maxrss` is that of the parent too."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def memory(n: int) -> None:
    """Run an ensemble with a store, and print the peak memory of this process."""
    before = highest()
    with tempfile.TemporaryDirectory() as folder:
        took = seconds(lambda: ensemble(SYSTEM.domain, n=n, store=Path(folder, "a.zarr"), workers=2))
    print(f"{n:.3g} {took:.4g} {before:.4g} {highest():.4g}")


def peak(n: int) -> tuple[float, float, float]:
    """Seconds, and MB of memory after the import and at the peak, of an ensemble with a store in a new process."""
    command = [sys.executable, __file__, "--memory", "--orbits", str(n)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    return tuple(map(float, answer[1:]))  # type: ignore[return-value]


def training(rounds: int) -> tuple[float, float]:
    """Seconds of a fit of `STARTS` random starts, on this thread and in two processes that are there already."""
    from sympflow import SympFlow, train

    def fit(workers: Any) -> float:
        flow = SympFlow.primed(SYSTEM, 6, dt=1.0)
        return seconds(lambda: train(SYSTEM, flow=flow, restarts=STARTS, seed=0, progress=False, workers=workers))

    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        fit(pool)  # started, and compiled there
        alone, shared = np.min([[fit(1), fit(pool)] for _ in range(rounds)], axis=0)
    return float(alone), float(shared)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--memory", action="store_true", help="run once with a store and print the peak memory")
    parser.add_argument("--orbits", type=float, default=1e6, help="of the run with a store")
    fragments.add_out(parser)
    given = parser.parse_args()
    n = int(given.orbits)
    if given.memory:
        memory(n)
        return

    times = growth(given.rounds)
    rows = [[f"{k:,}", fragments.duration(a), fragments.duration(b), f"{a / b:.2f}"] for k, (a, b) in times.items()]
    grown = fragments.table(["orbits", "one worker", "two workers", "ratio"], rows)
    costs = overheads(given.rounds)
    cost = fragments.table(["engine", "overhead of a chunk"], [[k, f"{1e3 * v:.2g} ms"] for k, v in costs.items()])
    took, idle, most = peak(n)
    kept = (
        f"{n:,} orbits with `store` and two threads: {fragments.duration(took)}, at most {most:.0f} MB of memory, of "
        f"which {idle:.0f} MB are there before the run."
    )

    alone, shared = training(given.rounds)
    trained = (
        f"`train` with {STARTS} starts of a primed flow: {fragments.duration(alone)} on one thread, "
        f"{fragments.duration(shared)} in two processes that are there already, {alone / shared:.2f} times faster."
    )

    largest = max(times)
    orbit = times[largest][0] / largest
    chunk = 16384
    chunks = ORBITS / chunk
    dask = costs["dask `LocalCluster`, one process"]
    work, handed = ORBITS * orbit / CORES, chunks * dask
    steps = 100
    model = fragments.table(
        ["of 1e9 orbits on 1000 cores", "T = 100", f"T = {100 * steps:,}"],
        [
            ["work, N τ / P", fragments.duration(work), fragments.duration(steps * work)],
            ["handing out, (N / n) δ", fragments.duration(handed), fragments.duration(handed)],
            ["time, the greater of both", *(fragments.duration(max(k * work, handed)) for k in (1, steps))],
            ["cores that are busy", *(f"{min(1.0, k * work / handed):.0%}" for k in (1, steps))],
        ],
    )
    constants = f"τ = {orbit * 1e6:.3g} µs an orbit of T = 100, n = {chunk:,} orbits a chunk, δ = {dask * 1e3:.2g} ms."
    fragments.write(given.out, "ensembles", f"{grown}\n\n{cost}\n\n{kept}\n\n{trained}")
    fragments.write(given.out, "ensembles-model", f"{model}\n\n{constants}")


if __name__ == "__main__":
    main()
