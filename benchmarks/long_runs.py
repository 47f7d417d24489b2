"""The cost of windows, of progress and of a store in one long run.

    python benchmarks/long_runs.py [--steps 1e8] [--out docs/measured]

Hénon–Heiles, Verlet, dt 0.05, one trajectory, and a batch of 1000 with a hundredth of the steps. Process time of the
run in one piece, in windows, and with a progress function, in turn; the least of each counts. With a store: wall time
against that in memory with as many outputs, and the size on disk.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measuring import fragments

import sympflow
from sympflow.integrators import grid_runs

SYSTEM = sympflow.systems.henon_heiles()
DT, BATCH = 0.05, 1000


def seconds(call: Callable[[], Any], clock: Callable[[], float] = time.process_time) -> float:
    start = clock()
    call()
    return clock() - start


def run(y0: Any, n_steps: int, **how: Any) -> Any:
    how = {"save_every": n_steps} | how
    return sympflow.solve(SYSTEM, "verlet", (0, n_steps * DT), y0, dt=DT, **how)


def windows(n_steps: int, rounds: int) -> list[list[str]]:
    """Rows of times in one piece, in windows and with progress."""
    rows, in_windows = [], grid_runs.first_window
    many = SYSTEM.y0 + 0.02 * np.random.default_rng(0).standard_normal((BATCH, 4))
    for label, y0, n in (("one trajectory", SYSTEM.y0, n_steps), (f"{BATCH} trajectories", many, n_steps // 100)):
        run(y0, 10)  # compiled
        times: dict[str, list[float]] = {"piece": [], "windows": [], "progress": []}
        for _ in range(rounds):
            grid_runs.first_window = lambda *run: 0
            times["piece"].append(seconds(lambda y0=y0, n=n: run(y0, n)))
            grid_runs.first_window = in_windows
            times["windows"].append(seconds(lambda y0=y0, n=n: run(y0, n)))
            times["progress"].append(seconds(lambda y0=y0, n=n: run(y0, n, progress=lambda done, total: None)))
        piece, cut, told = (min(times[name]) for name in ("piece", "windows", "progress"))
        rows.append([label, f"{n:,}", f"{piece:.3f} s", f"{cut / piece - 1:+.1%}", f"{told / piece - 1:+.1%}"])
    return rows


def stores(n_steps: int, rounds: int) -> list[list[str]]:
    """Rows of wall times in memory and with a store."""
    rows = []
    for every in (n_steps // 1_000_000, n_steps // 10_000):
        how: dict[str, Any] = {"save_every": every}
        memory, stored = [], []
        for _ in range(rounds):
            memory.append(seconds(lambda how=how: run(SYSTEM.y0, n_steps, **how), time.perf_counter))
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "run.zarr"
                stored.append(seconds(lambda h=how, p=path: run(SYSTEM.y0, n_steps, store=p, **h), time.perf_counter))
                size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        least, kept = min(memory), min(stored)
        outputs = n_steps // every + 1
        row = [f"{n_steps:,}", f"{outputs:,}", f"{least:.3f} s", f"{kept:.3f} s", f"{(kept - least) * 1e3:.0f} ms"]
        rows.append([*row, f"{size / 1e6:.1f} MB"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=float, default=1e8)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    n = int(options.steps)
    heads = ["run", "steps", "in one piece", "windows", "progress"]
    found = fragments.table(heads, windows(n, options.rounds))
    print(found)
    fragments.write(options.out, "long-windows", found)
    heads = ["steps", "outputs", "in memory", "with a store", "more", "on disk"]
    found = fragments.table(heads, stores(n, options.rounds))
    print(found)
    fragments.write(options.out, "long-stores", found)


if __name__ == "__main__":
    main()
