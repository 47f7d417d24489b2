"""Sun and eight planets: energy error and time of each method, beside REBOUND where it is installed.

    python benchmarks/planets.py                                   5,000 years, a minute
    python benchmarks/planets.py --years 1e5                       the comparison at length
    python benchmarks/planets.py --figure docs/figures/planets.png eccentricities over 200,000 years

The energy error is the largest of 40 outputs, relative to |H(y0)|; times are processor times of whole calls of `solve`,
the least of the repeats, on one thread. REBOUND runs from the same state, without safe mode.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

from measuring.machine import least, pin_to_one_thread

pin_to_one_thread()

import numpy as np
from measuring import fragments

from sympflow import elements, solve
from sympflow.systems import solar_system

YEAR = 365.25
OUTPUTS = 40
METHODS = {
    "wisdom_holman": ("wisdom_holman", {}, ("whfast", {})),
    "wisdom_holman, corrector 17": ("wisdom_holman", {"corrector": 17}, ("whfast", {"corrector": 17})),
    "kepler_aba864": ("kepler_aba864", {}, ("saba", {"type": "8_6_4"})),
    "kepler_aba1064": ("kepler_aba1064", {}, ("saba", {"type": "10_6_4"})),
    "srkn11b": ("srkn11b", {}, None),
}
"""Ours, with options, and REBOUND's integrator of the same scheme, with attributes."""


def ours(system: Any, name: str, days: float, years: float, repeats: int) -> tuple[float, float]:
    """Energy error, and microseconds a step."""
    method, options, _ = METHODS[name]
    n = OUTPUTS * round(years * YEAR / days / OUTPUTS)
    given = {"t_span": (0.0, n * days), "dt": days, "save_every": n // OUTPUTS, "on_domain_exit": "ignore", **options}
    seconds, sol = least(lambda: solve(system, method, **given), repeats)
    return float(np.abs(sol.energy_error()).max()), 1e6 * seconds / n


def rebounds(system: Any, name: str, days: float, years: float, repeats: int) -> tuple[float, float] | None:
    """The same of REBOUND; None where it is not installed or has no such scheme."""
    try:
        import rebound
    except ImportError:
        return None
    peer = METHODS[name][2]
    if peer is None:
        return None

    def simulation() -> Any:
        sim = rebound.Simulation()
        sim.G, sim.dt, sim.integrator = system.params["G"], days, peer[0]
        masses = system.local.masses
        for m, q, p in zip(masses, *system.y0.reshape(2, -1, 3), strict=True):
            sim.add(m=m, x=q[0], y=q[1], z=q[2], vx=p[0] / m, vy=p[1] / m, vz=p[2] / m)
        settings = sim.integrator if not isinstance(sim.integrator, str) else getattr(sim, f"ri_{peer[0]}")
        settings.safe_mode = 0
        for option, value in peer[1].items():
            setattr(settings, option, value)
        return sim

    def run(sim: Any) -> float:
        E, worst = sim.energy(), 0.0
        for t in np.linspace(0, years * YEAR, OUTPUTS + 1)[1:]:
            sim.integrate(t, exact_finish_time=0)
            (sim.synchronize if hasattr(sim, "synchronize") else sim.integrator_synchronize)()
            worst = max(worst, abs(sim.energy() / E - 1))
        return worst

    seconds, worst = least(lambda: run(simulation()), repeats)
    return worst, 1e6 * seconds / (years * YEAR / days)


def table(years: float, steps: list[float], repeats: int) -> str:
    """The comparison as Markdown."""
    system, lines = solar_system(), []
    for name in METHODS:
        for days in steps:
            error, each = ours(system, name, days, years, repeats)
            peer = rebounds(system, name, days, years, repeats)
            own = [f"{days:g} d", f"{error:.1e}", f"{each:.3f} µs", f"{each / days:.4f} µs"]
            other = ["", ""] if peer is None else [f"{peer[0]:.1e}", f"{peer[1] / days:.4f} µs"]
            lines.append(
                [f"`{name.replace(', corrector ', '`, corrector ')}" + ("`" if "," not in name else ""), *own, *other]
            )
            print(*lines[-1], flush=True)
    titles = [
        "method",
        "step",
        "energy error",
        "time of a step",
        "of a simulated day",
        "REBOUND's error",
        "its time of a day",
    ]
    if not any(line[-1] for line in lines):
        titles, lines = titles[:-2], [line[:-2] for line in lines]
    return fragments.table(titles, lines)


def batch(systems: int = 1000, steps: int = 2000) -> str:
    """The time of a step and system in a batch."""
    system = solar_system()
    y0 = system.y0 * (1 + 1e-6 * np.random.default_rng(0).standard_normal((systems, 1)))
    given = {"dt": 4.0, "t_span": (0.0, 4.0 * steps), "save_every": steps, "on_domain_exit": "ignore"}
    seconds, _ = least(lambda: solve(system, "wisdom_holman", y0=y0, **given), 2)
    return f"{systems} systems at once: {1e6 * seconds / systems / steps:.3f} µs a step and system."


def figure(path: Path) -> None:
    """Eccentricities of the outer planets over 200,000 years."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    system = solar_system(("Jupiter", "Saturn", "Uranus", "Neptune"))
    sol = solve(system, t_span=(0.0, 200_000 * YEAR), save_every=500, on_domain_exit="ignore")
    orbits = elements(sol, about="jacobi")
    fig, axes = plt.subplots(2, 1, figsize=(7, 4.4), sharex=True, layout="constrained")
    for k, name in enumerate(("Jupiter", "Saturn", "Uranus", "Neptune")):
        for axis, y in zip(axes, (orbits.e[k], np.degrees(orbits.inc[k])), strict=True):
            axis.plot(sol.t / YEAR / 1000, y, label=name, lw=0.8)
    axes[0].set_ylabel("eccentricity")
    axes[1].set_ylabel("inclination / °")
    axes[1].set_xlabel("time / 1000 years")
    axes[0].legend(ncols=4, fontsize=8, loc="upper right")
    fig.savefig(path, dpi=110, metadata={"Software": None})
    print(f"{path}: relative energy error {np.abs(sol.energy_error()).max():.1e}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=5000.0)
    parser.add_argument("--steps", type=float, nargs="+", default=[4.0, 8.0, 12.0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--figure", type=Path, help="draw this picture, and nothing else")
    fragments.add_out(parser)
    given = parser.parse_args()
    warnings.filterwarnings("ignore", "`dt` .* is long for method")
    if given.figure:
        figure(given.figure)
        return
    body = table(given.years, given.steps, given.repeats)
    together = batch()
    print(together)
    fragments.write(given.out, "planets", f"{body}\n\n{together}")


if __name__ == "__main__":
    main()
