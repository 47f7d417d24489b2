"""The cost of deviation vectors: chaos indicators against the orbits alone, both compiled.

    python benchmarks/chaos.py [--out docs/measured]

Float64, one thread, process time. The runs of a row are timed in turn, in rounds, and the least time of each counts. A
run is `--steps` steps of 1024 orbits, or twenty times as many of one. SALI is followed to the end: no orbit ends early.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

import sympflow
from sympflow import HamiltonianSystem, solve
from sympflow.systems import henon_heiles, kepler, pendulum

ORBITS = 1024
SCENES = {"Hénon–Heiles": henon_heiles(), "Kepler": kepler(), "pendulum": pendulum()}


def least(calls: list[Callable[[], object]], rounds: int) -> list[float]:
    """The least process time of each call, in seconds, of calls in turn."""
    for call in calls:
        call()
    times = np.empty((rounds, len(calls)))
    for i in range(rounds):
        for j, call in enumerate(calls):
            start = time.process_time()
            call()
            times[i, j] = time.process_time() - start
    return times.min(0).tolist()


def ratios(system: HamiltonianSystem, method: str, batch: int, n_steps: int, rounds: int) -> str:
    """The cost of one vector and of two, over that of the orbit, and the time of its step in nanoseconds."""
    dt = system.dt / 10
    spread = np.linspace(0.9, 1.0, ORBITS)[:, None]
    y0 = system.y0 if batch == 1 else spread * system.y0
    span = (0.0, n_steps * dt)
    orbit, one, two = least(
        [
            lambda: solve(system, method, span, y0, dt=dt, t_eval=[span[1]]),
            lambda: sympflow.lyapunov(system, method, span, y0, dt=dt, backend="compiled"),
            lambda: sympflow.sali(system, method, span, y0, dt=dt, backend="compiled", below=0),
        ],
        rounds,
    )
    return f"{one / orbit:.2f} | {two / orbit:.2f} (of {orbit / n_steps / batch * 1e9:.3g} ns a step)"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=4_000)
    parser.add_argument("--rounds", type=int, default=7)
    fragments.add_out(parser)
    given = parser.parse_args(arguments)
    lines = [
        "| system | method | one orbit: Lyapunov exponent | one orbit: SALI | 1024 orbits: Lyapunov exponent | "
        "1024 orbits: SALI |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, system in SCENES.items():
        for method in ("verlet", "kahan_li8"):
            single = ratios(system, method, 1, 20 * given.steps, given.rounds)
            many = ratios(system, method, ORBITS, given.steps, given.rounds)
            lines.append(f"| {name} | `{method}` | {single} | {many} |")
            print(lines[-1], flush=True)
    fragments.write(given.out, "chaos", "\n".join(lines))


if __name__ == "__main__":
    main()
