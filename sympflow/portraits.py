"""Phase portraits and Poincaré sections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.comparison_report import Comparison
from sympflow.crossings import section_crossings
from sympflow.figure_style import TEXT, dress, method_styles, new_figure
from sympflow.integrators.registry import build
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.system import HamiltonianSystem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def portrait(comparison: Comparison) -> Figure:
    """Phase space, a panel for each method with the reference behind in grey.

    One degree of freedom: the orbit in the (q, p) plane. Two: the Poincaré section q₁ = 0, p₁ > 0, from a run with
    outputs every `system.dt`. More: q₁ against q₂.
    """
    system = comparison.system
    runs = [run for run in comparison.runs if run.sol is not None]
    rows = -(-len(runs) // 5)
    columns = -(-len(runs) // rows)
    figure = new_figure(0.5 + 2.5 * columns, 0.5 + 2.7 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    styles = method_styles([(run.row.label, run.row.method) for run in comparison.runs])
    truth = _reference_points(comparison)
    for ax in axes.flat[len(runs) :]:
        ax.set_axis_off()
    x_label, y_label = {1: ("q", "p"), 2: ("q₂", "p₂")}.get(system.ndof, ("q₁", "q₂"))
    for k, (ax, run) in enumerate(zip(axes.flat, runs, strict=False)):
        points = _phase_points(comparison, run.candidate.integrator)
        ax.plot(*truth.T, ".", color="#C8C8C8", ms=8 if system.ndof == 2 else 2.5, mew=0, zorder=1, rasterized=True)
        ax.plot(
            *points.T,
            ".",
            color=styles[run.row.label][0],
            ms=2.2 if len(points) > 100 else 4,
            mew=0,
            zorder=2,
            rasterized=True,
        )
        ax.set_title(run.row.label, fontsize=9, color=styles[run.row.label][0])
        dress(ax, x_label if k // columns == rows - 1 else "", y_label if k % columns == 0 else "")
    _frame(axes[0, 0], truth)
    section = " — section q₁ = 0, p₁ > 0" if system.ndof == 2 else ""
    figure.suptitle(f"{comparison.title}{section}; reference in grey", fontsize=10, color=TEXT, x=0.01, ha="left")
    return figure


def section_figure(sections: Sequence[tuple[str, Solution]], energy: float | None = None) -> Figure:
    """Poincaré sections q₁ = 0, p₁ > 0 of two degrees of freedom, one panel for each (title, solution).

    Parameters
    ----------
    sections : sequence of (str, Solution)
        Single trajectories or batches, with outputs every fraction of the fastest oscillation.
    energy : float, optional
        Draws the boundary H(0, q₂, 0, p₂) = energy of what can be reached.
    """
    if not sections:
        raise ValueError("`sections` is empty: give at least one (title, solution).")
    figure = new_figure(0.5 + 3.4 * len(sections), 3.7)
    axes = figure.subplots(1, len(sections), sharex=True, sharey=True, squeeze=False)[0]
    for k, (ax, (title, sol)) in enumerate(zip(axes, sections, strict=True)):
        if sol.system.ndof != 2:
            raise ValueError(f"`sections` are of two degrees of freedom; {sol.system.name!r} has {sol.system.ndof}.")
        points = section_crossings(sol)[:, [1, 3]]
        ax.plot(*points.T, ".", color="#0072B2", ms=1.6, mew=0, rasterized=True)
        if energy is not None:
            _draw_boundary(ax, sol.system, energy, points)
        ax.set_title(title, fontsize=10, color=TEXT)
        dress(ax, "q₂", "p₂" if k == 0 else "")
        ax.set_aspect("equal")
    return figure


def _draw_boundary(ax: Axes, system: HamiltonianSystem, energy: float, points: np.ndarray) -> None:
    reach = 1.6 * np.abs(points).max(initial=0.1)
    grid = np.linspace(-reach, reach, 400)
    q2, p2 = np.meshgrid(grid, grid)
    H = system.hamiltonian(np.stack([0 * q2, q2, 0 * q2, p2], axis=-1))
    ax.contour(q2, p2, H, levels=[energy], colors="#999999", linewidths=0.8)


def _phase_points(comparison: Comparison, integrator: Any) -> np.ndarray:
    """What a portrait shows of one run, (m, 2)."""
    system = comparison.system
    if system.ndof != 2:
        t = comparison.t
        pair = [0, 1]
    else:
        t0, t1 = comparison.t_span
        n = min(int(np.ceil(abs(t1 - t0) / system.dt)), 400_000)
        t, pair = np.linspace(t0, t1, n + 1), [1, 3]
    sol = solve(system, integrator, comparison.t_span, comparison.y0, t_eval=t, on_domain_exit="ignore")
    states = section_crossings(sol) if system.ndof == 2 else to_numpy(sol.states).reshape(-1, 2 * system.ndof)
    return states[:, pair]


def _reference_points(comparison: Comparison) -> np.ndarray:
    system = comparison.system
    accurate = build("kahan_li8", {}) if system.separable else build("dop853", {"rtol": 1e-12, "atol": 1e-12})
    return _phase_points(comparison, accurate)


def _frame(ax: Axes, points: np.ndarray) -> None:
    """Limits around the reference, so that a run that leaves does not shrink everything else."""
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return
    low, high = points.min(0), points.max(0)
    margin = 0.25 * np.maximum(high - low, 1e-12)
    ax.set_xlim(low[0] - margin[0], high[0] + margin[0])
    ax.set_ylim(low[1] - margin[1], high[1] + margin[1])
