"""The cost of friction: compiled runs of damped systems against the same without damping.

    python benchmarks/friction.py [--out docs/measured]

Float64, one thread, process time. The two runs of a row are timed in turn, in rounds, and the median of the ratios
counts. A run is `--steps` steps of one trajectory, or a tenth of it of 256 trajectories. The rates are so low that
nothing comes to rest: numbers below 1e-308 are denormal, which processors compute ten times as slowly.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import HamiltonianSystem, solve
from sympflow.systems import damped_pendulum, henon_heiles, pendulum

TRAJECTORIES = 256
H = henon_heiles()
DAMPED = {
    "pendulum, γ": (pendulum(), damped_pendulum(1e-4)),
    "Hénon–Heiles, γ": (H, HamiltonianSystem.from_sympy(H.symbols.H, damping=1e-4, y0=H.y0)),
    "Hénon–Heiles, one γ for each p": (H, HamiltonianSystem.from_sympy(H.symbols.H, damping=[1e-4, 2e-4], y0=H.y0)),
    "Hénon–Heiles, a matrix Γ": (
        H,
        HamiltonianSystem.from_sympy(H.symbols.H, damping=[[2e-4, 1e-4], [1e-4, 2e-4]], y0=H.y0),
    ),
}


def ratio(
    plain: HamiltonianSystem, damped: HamiltonianSystem, method: str, n_steps: int, batch: int, rounds: int
) -> tuple[float, float]:
    """The median of the ratios of process times, and the time of a step without friction in nanoseconds."""
    y0 = plain.y0 if batch == 1 else np.linspace(0.5, 1.0, batch)[:, None] * plain.y0

    def timed(system: HamiltonianSystem) -> float:
        start = time.process_time()
        solve(system, method, (0.0, 0.05 * n_steps), y0, dt=0.05, save_every=n_steps)
        return time.process_time() - start

    timed(plain), timed(damped)  # compiled
    times = np.array([(timed(plain), timed(damped)) for _ in range(rounds)])
    return float(np.median(times[:, 1] / times[:, 0])), float(np.median(times[:, 0])) / n_steps / batch * 1e9


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--methods", nargs="*", default=["verlet", "kahan_li8", "chin4c"])
    fragments.add_out(parser)
    asked = parser.parse_args(arguments)
    lines = [
        "| system | method | one trajectory, with friction / without | 256 trajectories |",
        "| --- | --- | --- | --- |",
    ]
    for name, (plain, damped) in DAMPED.items():
        for method in asked.methods:
            figures = [
                ratio(plain, damped, method, max(1, asked.steps // (1 if batch == 1 else 10)), batch, asked.rounds)
                for batch in (1, TRAJECTORIES)
            ]
            cells = (f"{r:.2f} (of {ns:.3g} ns a step)" for r, ns in figures)
            lines.append(f"| {name} | `{method}` | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    fragments.write(asked.out, "friction", "\n".join(lines))


if __name__ == "__main__":
    main()
