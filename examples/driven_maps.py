"""Pictures of driven systems: a strange attractor, islands in a chaotic sea, and where Mathieu's equation is stable.

    python examples/driven_maps.py [--quick] [--out docs/figures]

writes duffing_attractor.png, driven_pendulum_section.png and mathieu_stability.png.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from scipy.special import mathieu_a, mathieu_b

import sympflow
from sympflow import HamiltonianSystem, poincare_section, solve, systems

KAHAN_LI = "kahan_li8"
MATHIEU = HamiltonianSystem.from_sympy(  # a and q as coordinates that stand still: one batch holds all values
    "p1**2/2 + (q2 - 2*q3*cos(2*t))*q1**2/2", time="t", period=math.pi
)


def attractor(orbits: int, periods: int) -> sympflow.PoincareSection:
    """Duffing's oscillator after each period, without the first 30, in which the orbits fall onto the attractor."""
    system = systems.duffing()
    T = system.period
    return poincare_section(
        system, KAHAN_LI, (0, (30 + periods) * T), system.domain.sample(orbits, seed=0), dt=0.15
    ).since(30 * T)


def draw_attractor(section: sympflow.PoincareSection, path: Path) -> None:
    """All points, and those of a small part of the plane, where the layers of the attractor repeat."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 4.6), layout="constrained", facecolor="white")
    whole, part = figure.subplots(1, 2)
    window = (0.55, 0.9, 0.4, 0.58)
    q, p = section.states.T
    inside = (q > window[0]) & (q < window[1]) & (p > window[2]) & (p < window[3])
    whole.plot(q, p, ",", color="#0072B2", alpha=0.3, rasterized=True)
    whole.plot(*box(*window), color="#D55E00", lw=1)
    part.plot(q[inside], p[inside], ".", ms=1.5, mew=0, color="#0072B2", rasterized=True)
    part.set(xlim=window[:2], ylim=window[2:], xlabel="q")
    whole.set(xlabel="q", ylabel="p", title=f"Duffing's oscillator after each period: {len(q):,} points")
    part.set_title("the small rectangle")
    figure.savefig(path, dpi=110)


def box(left: float, right: float, bottom: float, top: float) -> tuple[list[float], list[float]]:
    return [left, right, right, left, left], [bottom, bottom, top, top, bottom]


def pendulum(periods: int) -> sympflow.PoincareSection:
    """The driven pendulum after each period, from rest at angles up to 3 and from the bottom at speeds up to 3.6."""
    system = systems.driven_pendulum()
    angles, speeds = np.linspace(0.15, 3.0, 20), np.linspace(2.0, 3.6, 9)
    y0 = [*([q, 0.0] for q in angles), *([0.0, p] for p in speeds), *([0.0, -p] for p in speeds)]
    return poincare_section(system, KAHAN_LI, (0, periods * system.period), y0, dt=0.2)


def half_traces(a: np.ndarray, q: np.ndarray) -> np.ndarray:
    """½ tr M of Mathieu's equation x'' + (a − 2q cos 2t)x = 0, M the matrix of a period, at (a, q)."""
    total = np.zeros(a.size)
    for k in (0, 3):  # of x, and of x'
        y0 = np.zeros((a.size, 6))
        y0[:, k], y0[:, 1], y0[:, 2] = 1.0, a.ravel(), q.ravel()
        total += solve(MATHIEU, KAHAN_LI, (0, math.pi), y0, dt=math.pi / 16, t_eval=[math.pi]).y[:, k, -1] / 2
    return total.reshape(a.shape)


def draw_stability(n: int, path: Path) -> None:
    """Left Mathieu's equation, coloured by its phase advance where it is stable; right the trap, both planes of it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 4.4), layout="constrained", facecolor="white")
    one, both = figure.subplots(1, 2)
    q, a = np.meshgrid(np.linspace(0.01, 8, n), np.linspace(-6, 14, n))
    trace = half_traces(a, q)
    advance = np.where(np.abs(trace) <= 1, np.arccos(np.clip(trace, -1, 1)), np.nan)
    extent = (0, 8, -6, 14)
    shown = one.imshow(advance / math.pi, origin="lower", extent=extent, aspect="auto", cmap="viridis", vmin=0, vmax=1)
    figure.colorbar(shown, ax=one, label="phase advance of a period / π")
    line = np.linspace(0.0, 8, 200)
    for m in range(5):
        one.plot(line, mathieu_a(m, line), color="#D55E00", lw=0.8)
        if m:
            one.plot(line, mathieu_b(m, line), color="#D55E00", lw=0.8, ls="--")
    one.set(xlim=extent[:2], ylim=extent[2:], xlabel="q", ylabel="a")
    one.set_title("Mathieu's equation; lines: a_m (solid), b_m (dashed)", fontsize=10)
    q, a = np.meshgrid(np.linspace(0.002, 1.0, n), np.linspace(-0.3, 0.3, n))
    first, second = (np.abs(half_traces(side * a, q)) <= 1 for side in (1, -1))
    colour = np.where(first & second, 3.0, np.where(first, 1.0, np.where(second, 2.0, 0.0)))
    from matplotlib.colors import ListedColormap

    palette = ListedColormap(["white", "#CFE5F3", "#F6DCC6", "#009E73"])
    both.imshow(colour, origin="lower", extent=(0, 1, -0.3, 0.3), aspect="auto", cmap=palette, vmin=0, vmax=3)
    both.plot([0.9080463337], [0.0], "ko", ms=4)
    both.annotate("q = 0.90805", (0.908, 0.0), (-8, 6), textcoords="offset points", ha="right", color="white")
    both.set(xlabel="q", ylabel="a")
    both.set_title("Paul trap: q₁ stable (blue), q₂ (orange), both (green)", fontsize=10)
    figure.savefig(path, dpi=110)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few points")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the pictures")
    given = parser.parse_args(arguments)
    orbits, periods, n = (20, 30, 20) if given.quick else (1000, 300, 500)
    section = attractor(orbits, periods)
    draw_attractor(section, given.out / "duffing_attractor.png")
    print(f"Duffing: {len(section):,} states, |q| up to {np.abs(section.states[:, 0]).max():.3f}")
    pendulum(30 if given.quick else 600).plot(path=given.out / "driven_pendulum_section.png", turn=2 * math.pi)
    draw_stability(n, given.out / "mathieu_stability.png")


if __name__ == "__main__":
    main()
