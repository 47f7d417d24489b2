"""Phase portraits and Poincaré sections."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, to_numpy
from sympflow.integrators.registry import build
from sympflow.solver import solve
from sympflow.studies.comparison_report import Comparison
from sympflow.studies.figure_style import TEXT, dress, method_styles, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def portrait(comparison: Comparison) -> Figure:
    """Phase space, a panel for each method with the reference behind in grey.

    One degree of freedom: the orbit in the (q, p) plane. Two: the Poincaré section q₁ = 0, p₁ > 0, by events of each
    method. More: q₁ against q₂.
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


def _phase_points(comparison: Comparison, integrator: Any) -> np.ndarray:
    """What a portrait shows of one run, (m, 2)."""
    system = comparison.system
    if system.ndof == 2:
        return _section(comparison, integrator)
    t = comparison.t
    sol = solve(system, integrator, comparison.t_span, comparison.y0, t_eval=t, on_domain_exit="ignore")
    return to_numpy(sol.states).reshape(-1, 2 * system.ndof)[:, [0, 1]]


def _section(comparison: Comparison, integrator: Any) -> np.ndarray:
    """(q₂, p₂) where q₁ passes 0 upwards, (m, 2): events of each trajectory."""

    def q1(t: float, y: Array) -> Array:
        return y[0]

    q1.direction = 1  # type: ignore[attr-defined]
    points = []
    for y0 in to_numpy(comparison.y0).reshape(-1, 4):
        sol = solve(
            comparison.system,
            integrator,
            comparison.t_span,
            y0,
            t_eval=[],
            events=q1,
            event_step=comparison.system.dt,
            on_domain_exit="ignore",
        )
        assert sol.y_events is not None
        points.append(sol.y_events[0])
    return np.concatenate(points)[:, [1, 3]]


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
