"""The largest step of a method: the harmonic oscillator at z = dt·ω, whatever ω is.

From q = 1, p = 0 the relative energy error of Störmer–Verlet (kick–drift–kick) is bounded by z²/4, that of leapfrog
(drift–kick–drift) by (z²/4)/(1 − z²/4), and both diverge for z > 2. The flow shipped for ω = 100 has z = 1.

    python examples/step_limits.py
"""

from __future__ import annotations

import sympflow
from sympflow import solve, systems


def bound(method: str, z: float) -> float:
    """The largest relative energy error, by theory."""
    if z >= 2:
        return float("inf")
    return z**2 / 4 if method == "verlet" else z**2 / 4 / (1 - z**2 / 4)


def main() -> None:
    print("| method | ω | z = dt·ω | steps | largest relative energy error | bound |")
    print("| --- | --- | --- | --- | --- | --- |")
    for method in ("verlet", "leapfrog"):
        for omega in (1.0, 1e3, 1e6):
            for z in (0.1, 1.9, 1.99, 2.01):
                system = systems.harmonic_oscillator(omega)
                steps = 100_000 if z < 2 else 2_000
                sol = solve(system, method, (0.0, steps * z / omega), dt=z / omega)
                error = sympflow.max_energy_error(sol)
                print(f"| {method} | {omega:g} | {z:g} | {steps:,} | {error:.6g} | {bound(method, z):.6g} |")
    stiff = systems.harmonic_oscillator(100.0)
    sol = solve(stiff, "sympflow", (0.0, 1000.0))
    print(f"| sympflow | 100 | 1 | {sol.stats['n_steps']:,} | {sympflow.max_energy_error(sol):.3g} | — |")


if __name__ == "__main__":
    main()
