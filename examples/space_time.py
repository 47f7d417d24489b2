"""Pictures of space against time: waves on lattices of some hundred sites.

    python examples/space_time.py [--quick] [--out docs/figures]

writes space_time.png: a breather and a kink of the sine-Gordon equation, kink and antikink of φ⁴ that collide, a
soliton of Toda's chain, two solitons of the Schrödinger equation, and the energy of disordered oscillators, which
hardly leaves the sites where it started.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

from sympflow import HamiltonianSystem, solve, systems

Picture = tuple[str, np.ndarray, np.ndarray, np.ndarray, str]
"""Title, times (m,), places (n,), values (n, m), and the name of a colour map."""


def breather(frames: int) -> Picture:
    system = systems.sine_gordon("breather", frequency=0.4, velocity=0.3)
    t = np.linspace(0, 100, frames)
    return "sine-Gordon breather: u", t, systems.grid(system), field(system, "srkn14a", t, 0.1), "RdBu_r"


def kink(frames: int) -> Picture:
    system = systems.sine_gordon("kink", velocity=0.5)
    t = np.linspace(0, 80, frames)
    return "sine-Gordon kink: u", t, systems.grid(system), field(system, "srkn14a", t, 0.1), "viridis"


def collision(frames: int, velocity: float = 0.2) -> Picture:
    """A kink and an antikink that are too slow to part at once: they bounce twice, and then part."""
    h, n = 0.1, 800
    g = 1 / math.sqrt(2 * (1 - velocity**2))
    system = HamiltonianSystem.lattice(
        onsite="(q**2 - 1)**2/4", bond="r**2/(2*h**2)", boundary="free", shape=n, params={"h": h}
    )
    x = systems.grid(system)
    u = np.tanh(g * (x + 10)) - np.tanh(g * (x - 10)) - 1
    u_t = -g * velocity * (np.cosh(g * (x + 10)) ** -2 + np.cosh(g * (x - 10)) ** -2)
    t = np.linspace(0, 120, frames)
    return "φ⁴, kink and antikink: u", t, x, field(system, "srkn11b", t, 0.08, np.r_[u, u_t]), "RdBu_r"


def soliton(frames: int) -> Picture:
    system = systems.toda_chain(160, kappa=0.8)
    t = np.linspace(0, 70, frames)
    r = np.diff(field(system, "srkn14a", t, 0.1), axis=0)
    return "Toda soliton: −r", t, systems.grid(system)[:-1], -r, "magma"


def schroedinger(frames: int) -> Picture:
    """Two solitons that pass through each other."""
    system = systems.nonlinear_schroedinger(n=512, length=60.0)
    x = systems.grid(system)
    psi = np.exp(1j * x) / np.cosh(x + 15) + 1.4 * np.exp(-1j * x) / np.cosh(1.4 * (x - 15))
    y0 = math.sqrt(2) * np.r_[psi.real, psi.imag]
    t = np.linspace(0, 30, frames)
    sol = solve(system, "linear_kahan_li6", (0, t[-1]), y0, dt=0.05, t_eval=t)
    density = (sol.y[:512] ** 2 + sol.y[512:] ** 2) / 2
    return "Schrödinger, two solitons: |ψ|²", t, x, density, "magma"


def disorder(frames: int) -> Picture:
    """Energy that starts at one site of oscillators of random frequencies."""
    n = 201
    system = HamiltonianSystem.lattice(
        onsite="w*q**2/2 + q**4/4",
        bond="r**2/8",
        boundary="fixed",
        shape=n,
        params={"w": np.random.default_rng(1).uniform(0.5, 1.5, n)},
    )
    y0 = np.zeros(2 * n)
    y0[n + n // 2] = 1.0
    t = np.linspace(0, 500, frames)
    sol = solve(system, "srkn14a", (0, t[-1]), y0, dt=0.5, t_eval=t)
    density = system.energy_density(sol.states).T
    return "disorder: log₁₀ of the energy", t, systems.grid(system), np.log10(density + 1e-8), "viridis"


def field(system: HamiltonianSystem, method: str, t: np.ndarray, dt: float, y0: Any = None) -> np.ndarray:
    """q at the times: (n, m)."""
    sol = solve(system, method, (0, t[-1]), y0, dt=dt, t_eval=t)
    return sol.y[: system.ndof]


def draw(pictures: list[Picture], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.4), layout="constrained", facecolor="white")
    for axes, (title, t, x, u, colours) in zip(figure.subplots(2, 3).ravel(), pictures, strict=True):
        image = axes.pcolormesh(t, x, u, cmap=colours, rasterized=True)
        axes.set(title=title, xlabel="t", ylabel="x")
        figure.colorbar(image, ax=axes)
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few frames")
    parser.add_argument("--out", type=Path, default=Path())
    given = parser.parse_args()
    frames = 40 if given.quick else 300
    makers = (breather, kink, collision, soliton, schroedinger, disorder)
    draw([make(frames) for make in makers], given.out / "space_time.png")


if __name__ == "__main__":
    main()
