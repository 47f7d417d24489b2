"""The work–precision diagram."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sympflow.studies.figure_style import dress, legend_above, method_styles, new_figure
from sympflow.studies.precision_points import Point
from sympflow.studies.precision_report import WorkPrecision

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURES = {"energy_error": "largest |energy error|, relative", "error": r"$\max_t\,\|y - y_{\mathrm{ref}}\|$"}
LARGEST = 10.0
COSTS = {"run_time": "run time [s]", "evaluations": "forces + Hessian–vector products, one trajectory"}


def precision_figure(report: WorkPrecision, measure: str = "energy_error") -> Figure:
    """Cost against error, log–log: run time on the left, evaluations on the right; a row for each batch size.

    Points whose error the reference cannot resolve are hollow. Trained flows have no evaluations of the force.
    """
    if measure not in MEASURES:
        raise ValueError(f"`measure` must be one of {', '.join(map(repr, MEASURES))}; got {measure!r}.")
    figure = new_figure(9.6, 0.8 + 3.9 * len(report.sizes))
    axes = figure.subplots(len(report.sizes), 2, squeeze=False, sharex=False)
    labels = list(dict.fromkeys((row.label, row.method) for row in report.rows))
    styles = method_styles(labels)
    for row, size in zip(axes, report.sizes, strict=True):
        for ax, cost in zip(row, COSTS, strict=True):
            for label, _ in labels:
                points = [p for p in report.rows if p.label == label and p.trajectories == size]
                _curve(ax, points, cost, measure, styles[label])
            ax.set_xscale("log")
            ax.set_yscale("log")
            dress(ax, MEASURES[measure], COSTS[cost])
            ax.invert_xaxis()
        many = "one trajectory" if size == 1 else f"batch of {size:,}"
        row[0].set_title(
            f"{report.title}, T = {report.t_span[1] - report.t_span[0]:g}, {many}", loc="left", fontsize=10
        )
    legend_above(figure, axes.flat, 7)
    return figure


def _curve(ax: Axes, points: list[Point], cost_name: str, measure: str, style: tuple[str, str]) -> None:
    colour, marker = style
    known = [
        (error, cost, p.status == "uncertain")
        for p, error, cost in ((p, getattr(p, measure), _cost(p, cost_name)) for p in points)
        if error and cost and error < LARGEST
    ]
    if not known:
        return
    errors, costs, _ = zip(*known, strict=True)
    ax.plot(errors, costs, color=colour, lw=1.2, marker=marker, ms=5.5, mec="white", mew=0.6, label=points[0].label)
    if measure == "error":
        hollow = [(e, c) for e, c, doubt in known if doubt]
        ax.plot(*zip(*hollow, strict=True), marker, color="white", mec=colour, ms=5) if hollow else None


def _cost(point: Point, cost: str) -> float:
    if cost == "run_time":
        return point.run_time or 0.0
    return (point.force_evaluations or 0.0) + (point.hessian_evaluations or 0.0)
