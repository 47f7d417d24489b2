"""The paper's figures, and a Poincaré section, from the networks that ship with the package.

Long-time energy of SympFlow against the unconstrained MLP, and trajectories of SympFlow and ODE45 (SciPy's RK45 at its
default tolerances), for the harmonic oscillator and Hénon–Heiles. Then the section q₁ = 0, p₁ > 0 of Hénon–Heiles at
E = 0.1, the reference (Kahan–Li 8) beside it.

    python examples/reproduce_paper.py --out out/paper
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import sympflow
from sympflow import HamiltonianSystem, poincare_section, solve, systems

LABELS = {"sympflow": "SympFlow", "mlp": "MLP", "rk45": "ODE45", "kahan_li8": "reference (Kahan–Li 8)"}
TITLES = {"harmonic_oscillator": "Harmonic oscillator", "henon_heiles": "Hénon–Heiles"}
COLOURS = {"sympflow": "C0", "mlp": "C3", "rk45": "C1", "kahan_li8": "black"}


def network(system: HamiltonianSystem, method: str) -> dict[str, str]:
    """The option that asks for the paper's kind of flow: by default a primed one is taken where one ships."""
    return {"flow": f"{system.name}-{method}"} if method in ("sympflow", "mlp") else {}


def energy_figure(system: HamiltonianSystem, t_end: float) -> Figure:
    """Energy over time of SympFlow and of the MLP, from the system's default initial state."""
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for ax, method in zip(axes, ("sympflow", "mlp"), strict=True):
        sol = solve(system, method, (0.0, t_end), on_domain_exit="ignore", **network(system, method))
        H0 = system.hamiltonian(system.y0)
        ax.plot(sol.t, (sol.energy() - H0) / H0, color=COLOURS[method], lw=0.8)
        ax.axhline(0.0, color="black", lw=0.8, ls="--")
        ax.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
        error = sympflow.max_energy_error(sol)
        note = f"at most {error:.1e}" if sol.success else f"non-finite after t = {sol.t[-1]:g}"
        ax.set(xlabel="$t$", ylabel="$(H - H_0)/H_0$", title=f"{LABELS[method]}: {note}")
    figure.suptitle(f"{TITLES[system.name]}, long-time energy error (mind the scales)", fontsize=11)
    return figure


def trajectory_figure(system: HamiltonianSystem, t_end: float) -> Figure:
    """Coordinates over time of SympFlow (at its Δt, and between by ψ̄ at the fractional time), ODE45 and a reference."""
    figure = Figure(figsize=(8.0, 2.4 * system.ndof), layout="constrained")
    axes = figure.subplots(system.ndof, 1, sharex=True, squeeze=False)[:, 0]
    times = np.linspace(0.0, t_end, 2001)
    for method in ("kahan_li8", "rk45", "sympflow"):
        sol = solve(system, method, (0.0, t_end), t_eval=times, **network(system, method))
        for i, ax in enumerate(axes):
            style = {"lw": 1.6, "alpha": 0.4} if method == "kahan_li8" else {"lw": 0.9}
            ax.plot(sol.t, sol.q[i], color=COLOURS[method], label=LABELS[method], **style)
            ax.set_ylabel(f"$q_{i + 1}$" if system.ndof > 1 else "$q$")
    axes[-1].set_xlabel("$t$")
    axes[0].legend(loc="upper right", ncols=3, fontsize=8)
    axes[0].set_title(f"{TITLES[system.name]}: SympFlow with Δt = 1 and ODE45 at default tolerances")
    return figure


def section_figure(t_end: float, energy: float = 0.1) -> Figure:
    """The section q₁ = 0, p₁ > 0 of Hénon–Heiles."""
    system = systems.henon_heiles()
    q2 = np.array([-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.15, 0.15, 0.0, 0.0])
    p2 = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25, -0.25, 0.35, -0.35])
    V = system.potential(np.stack([0 * q2, q2], -1))
    p1 = np.sqrt(2 * (energy - V) - p2**2)
    y0 = np.stack([0 * q2, q2, p1, p2], -1)
    figure = Figure(figsize=(8.0, 4.9), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    choices = {"sympflow": network(system, "sympflow"), "kahan_li8": {"dt": 0.1}}
    for ax, (method, options) in zip(axes, choices.items(), strict=True):
        points = poincare_section(system, method, (0.0, t_end), y0, sample=1.0, **options).states
        ax.plot(points[:, 1], points[:, 3], ".", ms=1.2, color=COLOURS[method])
        ax.set(xlabel="$q_2$", ylabel="$p_2$", title=LABELS[method], aspect="equal")
    figure.suptitle(f"Hénon–Heiles, E = {energy:g}: section $q_1 = 0$, $p_1 > 0$ to t = {t_end:g}", fontsize=11)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    parser.add_argument("--t-end", type=float, default=1000.0, help="end of the energy figures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    figures = {"poincare_henon_heiles": section_figure(2 * arguments.t_end)}
    for system in (systems.harmonic_oscillator(), systems.henon_heiles()):
        figures[f"energy_{system.name}"] = energy_figure(system, arguments.t_end)
        figures[f"trajectory_{system.name}"] = trajectory_figure(system, 100.0)
    for name, figure in figures.items():
        path = arguments.out / f"{name}.png"
        figure.savefig(path, dpi=150)
        print(path)


if __name__ == "__main__":
    main()
