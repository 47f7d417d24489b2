"""Bodies that interact in pairs: a step of Verlet against REBOUND's and a loop written by hand, and atoms by cells.

    python benchmarks/large_pairs.py [--out docs/measured]

Float64; processor time of one thread, and for one large system wall time on two. What is compared is timed in turn, and
the least time of the rounds counts. All
take the same steps of Verlet under gravity with softening. The loop by hand is direct summation over i < j in Numba.
REBOUND is its `leapfrog` with `gravity="basic"`, where it is installed. Atoms are a Lennard-Jones fluid in a periodic
box at the density 0.8442 with a cut-off of 2.5.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from measuring import fragments
from numba import njit

from sympflow import HamiltonianSystem, solve
from sympflow.kernels.threads import at_most

SOFTENING, H = 0.05, 1e-4


@njit(fastmath={"contract"}, error_model="numpy")
def kick(q, p, m, b):  # type: ignore[no-untyped-def]
    for i in range(len(m)):
        fx = fy = fz = 0.0
        for j in range(i + 1, len(m)):
            dx, dy, dz = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
            s = dx * dx + dy * dy + dz * dz + SOFTENING * SOFTENING
            g = b * m[i] * m[j] / (s * math.sqrt(s))
            fx, fy, fz = fx + g * dx, fy + g * dy, fz + g * dz
            p[j, 0] += g * dx
            p[j, 1] += g * dy
            p[j, 2] += g * dz
        p[i, 0] -= fx
        p[i, 1] -= fy
        p[i, 2] -= fz


@njit(fastmath={"contract"}, error_model="numpy")
def verlet(q, p, m, h, n):  # type: ignore[no-untyped-def]
    kick(q, p, m, h / 2)
    for k in range(n):
        for i in range(len(m)):
            for x in range(3):
                q[i, x] += h * p[i, x] / m[i]
        kick(q, p, m, h if k < n - 1 else h / 2)


def cluster(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.standard_normal((n, 3)), 0.1 * rng.standard_normal((n, 3)), rng.uniform(1, 2, n)


def rebound_run(n: int, steps: int) -> Callable[[], Any] | None:
    """So many steps of REBOUND; None where it is not installed."""
    try:
        import rebound
    except ImportError:
        return None
    q, p, m = cluster(n)
    sim = rebound.Simulation()
    sim.integrator, sim.gravity, sim.dt, sim.softening = "leapfrog", "basic", H, SOFTENING
    for mass, x, v in zip(m.tolist(), q.tolist(), (p / m[:, None]).tolist(), strict=True):
        sim.add(m=mass, x=x[0], y=x[1], z=x[2], vx=v[0], vy=v[1], vz=v[2])
    return lambda: sim.steps(steps)


def least_times(
    calls: dict[str, Callable[[], Any]], rounds: int, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    least = dict.fromkeys(calls, math.inf)
    for call in calls.values():
        call()
    for _ in range(rounds):
        for name, call in calls.items():
            start = clock()
            call()
            least[name] = min(least[name], clock() - start)
    return least


def on_threads(n: int, call: Callable[[], Any]) -> Callable[[], Any]:
    def limited() -> Any:
        with at_most(n):
            return call()

    return limited


def gravity(n: int) -> HamiltonianSystem:
    q, p, m = cluster(n)
    y0 = np.concatenate([q.ravel(), p.ravel()])
    return HamiltonianSystem.pairs("-m1*m2/r", masses=m, softening=SOFTENING, y0=y0)


def fluid(side: int) -> HamiltonianSystem:
    n, length = side**3, side * 0.8442 ** (-1 / 3)
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(*[np.arange(side)] * 3), -1).reshape(-1, 3) * (length / side)
    y0 = np.concatenate([(places + rng.uniform(-0.05, 0.05, places.shape)).ravel(), rng.standard_normal(3 * n)])
    return HamiltonianSystem.pairs("4*(1/r**12 - 1/r**6)", masses=np.ones(n), box=length, cutoff=2.5, y0=y0, dt=0.002)


def bodies(rounds: int) -> str:
    rows = []
    for n, steps in ((10, 20_000), (100, 2_000), (1000, 30)):
        q, p, m = cluster(n)
        system = gravity(n)

        def ours(system: HamiltonianSystem = system, steps: int = steps) -> np.ndarray:
            return solve(system, "verlet", (0.0, steps * H), dt=H, t_eval=[steps * H]).y[:, -1]

        def by_hand(state: tuple[np.ndarray, ...] = (q, p, m), steps: int = steps) -> np.ndarray:
            x, momenta = state[0].copy(), state[1].copy()
            verlet(x, momenta, state[2], H, steps)
            return np.concatenate([x.ravel(), momenta.ravel()])

        np.testing.assert_allclose(ours(steps=20), by_hand(steps=20), rtol=0, atol=1e-10)
        calls: dict[str, Callable[[], Any]] = {"ours": on_threads(1, ours), "by hand": by_hand}
        theirs = rebound_run(n, steps)
        if theirs is not None:
            calls["REBOUND"] = theirs
        times = {name: 1e6 * seconds / steps for name, seconds in least_times(calls, rounds).items()}
        cells = [f"{times[name]:.3g}" if name in times else "" for name in ("ours", "by hand", "REBOUND")]
        ratios = [f"{times['ours'] / times[name]:.2f}" if name in times else "" for name in ("by hand", "REBOUND")]
        rows.append([f"{n:,}", *cells, *ratios])
    return fragments.table(
        ["bodies", "µs a step", "by hand", "REBOUND's leapfrog", "ours / by hand", "ours / REBOUND"], rows
    )


def atoms(rounds: int) -> str:
    rows = []
    for side in (8, 11, 16, 23):
        system, n = fluid(side), side**3

        def run(system: HamiltonianSystem = system) -> np.ndarray:
            return solve(system, "verlet", (0.0, 0.04), t_eval=[0.04]).y

        seconds = least_times({"ours": on_threads(1, run)}, rounds)["ours"] / 20
        rows.append([f"{n:,}", f"{1e3 * seconds:.3g}", f"{1e6 * seconds / n:.2f}"])
    return fragments.table(["atoms", "ms a step", "µs an atom and step"], rows)


def threads(rounds: int) -> str:
    rows = []
    systems = {f"gravity, {n:,} bodies": (gravity(n), H, steps) for n, steps in ((1000, 100), (3000, 15))}
    systems["4,096 atoms, cells"] = fluid(16), 0.002, 20
    for name, (system, h, steps) in systems.items():

        def run(system: HamiltonianSystem = system, h: float = h, steps: int = steps) -> np.ndarray:
            return solve(system, "verlet", (0.0, steps * h), dt=h, t_eval=[steps * h]).y

        calls = {str(n): on_threads(n, run) for n in (1, 2)}
        one, two = least_times(calls, rounds, time.perf_counter).values()
        rows.append([name, f"{1e3 * one / steps:.3g}", f"{1e3 * two / steps:.3g}", f"{one / two:.2f}"])
    return fragments.table(["system", "ms a step, one thread", "two threads", "ratio"], rows)


PARTS = {"large-bodies": bodies, "large-atoms": atoms, "large-pair-threads": threads}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    fragments.add_out(parser)
    parser.add_argument("--rounds", type=int, default=7)
    arguments = parser.parse_args()
    for name, part in PARTS.items():
        body = part(arguments.rounds)
        print(body)
        fragments.write(arguments.out, name, body)


if __name__ == "__main__":
    main()
