"""Phase portraits and Poincaré sections."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.integrators.registry import build
from sympflow.solver import solve
from sympflow.studies.comparison_report import Comparison
from sympflow.studies.crossings import Plane, crossings
from sympflow.studies.figure_style import TEXT, dress, frame, method_styles, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def portrait(comparison: Comparison) -> Figure:
    """Phase space, a panel for each method with the reference behind in grey.

    One degree of freedom: the orbit in the (q, p) plane. Two: the Poincaré section q₁ = 0 with q₁ increasing along the
    run, on each method's own map. More: q₁ against q₂.
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
        lowest = k + columns >= len(runs)  # nothing below it, or an empty place
        dress(ax, x_label if lowest else "", y_label if k % columns == 0 else "")
        ax.tick_params(labelbottom=lowest)
    frame(axes[0, 0], truth, 0.25)  # around the reference: a run that leaves shall not shrink everything else
    section = ": section q₁ = 0, p₁ > 0" if system.ndof == 2 else ""
    figure.suptitle(f"{comparison.title}{section}; reference in grey", fontsize=10, color=TEXT, x=0.01, ha="left")
    return figure


def _phase_points(comparison: Comparison, integrator: Any) -> np.ndarray:
    """What a portrait shows of one run, (m, 2)."""
    system = comparison.system
    if system.ndof == 2:
        starts = to_numpy(comparison.y0).reshape(-1, 4)
        found = crossings(integrator, system, comparison.t_span, starts, Plane(0, 0.0, 1), system.dt)
        return found.states[:, [1, 3]]
    t = comparison.t
    sol = solve(system, integrator, comparison.t_span, comparison.y0, t_eval=t, on_domain_exit="ignore")
    return to_numpy(sol.states).reshape(-1, 2 * system.ndof)[:, [0, 1]]


def _reference_points(comparison: Comparison) -> np.ndarray:
    system = comparison.system
    accurate = build("kahan_li8", {}) if system.separable else build("dop853", {"rtol": 1e-12, "atol": 1e-12})
    return _phase_points(comparison, accurate)
