"""Large systems: a step of the FPUT-β ring against loops written by hand, and the time that compiling takes.

    python benchmarks/large.py [--out docs/measured]
    python benchmarks/large.py --only large-fput,large-threads,large-compile

Float64. In `large-fput` Verlet runs from one state to its end, by `solve` as a user calls it, in turn with two loops in
Numba: one keeps the spring's force for the next site, the other computes both forces of each site. The faster one
counts. It is process time. In `large-threads` two threads run in turn with Numba's `prange`, by the time of the clock,
which other programs on the machine lengthen. In `large-compile` each number is that of a fresh process: its processor
time from the call of `solve` to its return, after the libraries are imported.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from measuring import fragments
from numba import njit, prange

from sympflow import HamiltonianSystem, solve
from sympflow.kernels.threads import at_most

OPTIONS: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy", "nogil": True}
H = 0.05


@njit(**OPTIONS)
def kick_once(q, p, b):
    """Each spring's force once, kept for the site at its other end."""
    n = len(q)
    r = q[0] - q[n - 1]
    around = r + r * r * r
    behind = around
    for i in range(n - 1):
        r = q[i + 1] - q[i]
        ahead = r + r * r * r
        p[i] += b * (ahead - behind)
        behind = ahead
    p[n - 1] += b * (around - behind)


@njit(**OPTIONS)
def kick_twice(q, p, b):
    """Both springs of each site."""
    n = len(q)
    for i in range(1, n - 1):
        r, s = q[i + 1] - q[i], q[i] - q[i - 1]
        p[i] += b * ((r + r * r * r) - (s + s * s * s))
    r, s, w = q[1] - q[0], q[n - 1] - q[n - 2], q[0] - q[n - 1]
    p[0] += b * ((r + r * r * r) - (w + w * w * w))
    p[n - 1] += b * ((w + w * w * w) - (s + s * s * s))


@njit(**OPTIONS)
def drift(q, p, a):
    for i in range(len(q)):
        q[i] += a * p[i]


def run_of(kick: Callable[..., None]) -> Callable[..., None]:
    @njit(**OPTIONS)
    def run(q, p, h, n):
        kick(q, p, h / 2)
        for _ in range(n - 1):
            drift(q, p, h)
            kick(q, p, h)
        drift(q, p, h)
        kick(q, p, h / 2)

    return run


@njit(parallel=True, **OPTIONS)
def run_threaded(q, p, h, n):
    """Both springs of each site, threads over sites."""
    size = len(q)
    for k in range(n + 1):
        b = h if 0 < k < n else h / 2
        for i in prange(size):
            r = (q[i + 1] if i + 1 < size else q[0]) - q[i]
            s = q[i] - q[i - 1]
            p[i] += b * ((r + r * r * r) - (s + s * s * s))
        if k < n:
            for i in prange(size):
                q[i] += h * p[i]


def apart(q: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Copies that begin 512 bytes more than whole pages apart: others share places in the caches of some processors."""
    start = len(q) + (64 - len(q)) % 512
    both = np.empty(start + len(p))
    both[: len(q)], both[start:] = q, p
    return both[: len(q)], both[start:]


def fput(rounds: int, threads: int) -> str:
    """On one thread, or on several."""
    rows, clock = [], time.process_time if threads == 1 else time.perf_counter
    runs = {"once": run_of(kick_once), "twice": run_of(kick_twice)} if threads == 1 else {"threaded": run_threaded}
    for size, n in ((100, 100_000), (10_000, 2_000), (1_000_000, 60)):
        system = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=size)
        y0 = np.random.default_rng(0).normal(scale=0.3, size=2 * size)

        def ours(threads: int, system: Any = system, y0: np.ndarray = y0, n: int = n) -> np.ndarray:
            with at_most(threads):
                return solve(system, "verlet", t_span=(0.0, n * H), y0=y0, dt=H, t_eval=[n * H]).y[:, -1]

        def by_hand(run: Callable[..., None], size: int = size, y0: np.ndarray = y0, n: int = n) -> np.ndarray:
            q, p = apart(y0[:size], y0[size:])
            run(q, p, H, n)
            return np.concatenate([q, p])

        calls: dict[str, Callable[[], Any]] = {
            "ours": lambda f=ours: f(threads),
            **{name: (lambda f=by_hand, run=run: f(run)) for name, run in runs.items()},
        }
        np.testing.assert_allclose(ours(1), by_hand(next(iter(runs.values()))), rtol=0, atol=1e-9)
        least = dict.fromkeys(calls, np.inf)
        for _ in range(rounds * (10 if size < 100_000 else 1)):
            for name, call in calls.items():
                start = clock()
                call()
                least[name] = min(least[name], clock() - start)
        unit = 1e9 / (n * size)
        hand = min(least[name] for name in runs)
        rows.append([f"{size:,}", f"{least['ours'] * unit:.3f}", f"{hand * unit:.3f}", f"{least['ours'] / hand:.2f}"])
    return fragments.table(["sites", "ns a site and step", "by hand", "ratio"], rows)


CODE = """
import sys, time
import numpy as np, numba, scipy, sympy, sympflow
kind, method, size = sys.argv[1], sys.argv[2], int(sys.argv[3])
if kind == "bodies":
    system = sympflow.HamiltonianSystem.pairs("-m1*m2/r", masses=np.ones(size), softening=0.1)
else:
    shape = (round(size ** (1 / int(kind))),) * int(kind)
    system = sympflow.HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=shape)
y0 = np.random.default_rng(0).uniform(-0.1, 0.1, 2 * system.ndof)
import sympflow.solver, sympflow.integrators.splitting, sympflow.kernels.lattices, sympflow.kernels.splitting_loops
start = time.process_time()
sympflow.solve(system, method, t_span=(0.0, 0.01), y0=y0, dt=0.01, t_eval=[0.01], backend="compiled")
print(time.process_time() - start)
"""
COMPILED = {"1": "chain", "2": "two axes", "3": "three axes", "bodies": "bodies in pairs"}


def compiling() -> str:
    """Times of compiling: of another size the next process finds the code in the cache."""
    rows = []
    for kind, name in COMPILED.items():
        for method in ("verlet", "chin4c"):
            with tempfile.TemporaryDirectory() as folder:
                environment = {**os.environ, "SYMPFLOW_CACHE_DIR": folder}
                seconds = []
                for size in (100, 100, 1000 if kind == "bodies" else 30_000):
                    command = [sys.executable, "-c", CODE, kind, method, str(size)]
                    out = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
                    seconds.append(f"{float(out):.2f}")
                rows.append([f"{name}, {method}", *seconds])
    titles = ["system, method", "100 sites or bodies, first time, s", "again, s", "30,000 sites, 1,000 bodies, s"]
    return fragments.table(titles, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    fragments.add_out(parser)
    parser.add_argument("--only", default="large-fput,large-compile")
    parser.add_argument("--rounds", type=int, default=9)
    arguments = parser.parse_args()
    parts: dict[str, Callable[[], str]] = {
        "large-fput": lambda: fput(arguments.rounds, 1),
        "large-threads": lambda: fput(arguments.rounds, 2),
        "large-compile": compiling,
    }
    for name in arguments.only.split(","):
        body = parts[name]()
        print(body)
        fragments.write(arguments.out, name, body)


if __name__ == "__main__":
    main()
