"""The figures of the studies: comparisons, phase portraits, work and precision, stability, and sections."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arguments import check_one_of
from sympflow.arrays import to_numpy
from sympflow.hamiltonian.scales import smallest_size
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.registry import build
from sympflow.metrics.crossings import Plane, crossings, stroboscopic, whole_periods
from sympflow.show.style import TEXT, dress, filled, frame, labelled, legend_above, method_styles, new_figure, save
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.studies.attempts import Attempt, Row, any_step
from sympflow.studies.reports import Report

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

KINDS = ("overview", "energy", "volume", "error", "portrait")
ROUNDING_FLOOR = 1e-17
FIGURE_FILES = (".png", ".pdf", ".svg")
MEASURES = {
    "energy_error": "largest |energy error|, relative",
    "balance_error": "largest |error of the energy balance|, relative",
    "error": r"$\max_t\,\|y - y_{\mathrm{ref}}\|$",
}
COSTS = {"run_time": "run time [s]", "evaluations": "forces + Hessian–vector products, one trajectory"}
LEAST_PRECISE = 10.0  # error beyond which a point of a work–precision diagram is left out
SMALLEST, LARGEST = 1e-15, 1e3  # errors shown in figures of stability
UNSTABLE = "#5A1020"
_GREEK = {"omega": "ω"}


@dataclass(frozen=True, repr=False)
class Compared(Report):
    """The part of a comparison that is drawn."""

    system: HamiltonianSystem
    t_span: tuple[float, float]
    y0: np.ndarray = field(repr=False)
    t: np.ndarray = field(repr=False)
    metrics: tuple[str, ...]
    runs: tuple[Attempt, ...] = field(repr=False)

    @property
    def title(self) -> str:
        """The scene in a line."""
        return self.system.title


# comparisons ----------------------------------------------------------------------------------------------------------


def comparison_figure(comparison: Compared, kind: str = "overview") -> Figure:
    """One figure of a comparison: "overview", "energy", "volume", "error" or "portrait".

    The overview of a comparison that measured none of its panels is the portrait.

    Raises
    ------
    ValueError
        For an unknown kind, or one whose metric was not requested.
    ImportError
        Without matplotlib.
    """
    check_one_of("kind", kind, KINDS)
    if kind == "overview":
        return portrait(comparison) if _drawable(comparison) == ("portrait",) else overview([comparison])
    if kind not in _drawable(comparison):
        raise ValueError(f"`kind` {kind!r} shows what was not measured: add it to `metrics` of compare().")
    if kind == "portrait":
        return portrait(comparison)
    figure = new_figure(6.4, 4.2)
    ax = figure.add_subplot()
    _PANELS[kind](ax, comparison, _styles([comparison]))
    ax.set_title(filled(comparison.title, 5.6, 10), loc="left", fontsize=10, color=TEXT)
    if kind != "error":
        _legend(figure, [comparison])
    return figure


def save_comparison(
    comparison: Compared, path: str | os.PathLike[str], kind: str = "overview", prefix: str = ""
) -> list[Path]:
    """Save one figure to a file; into a folder the overview saves every kind that was measured. The files written."""
    path = Path(path)
    if path.suffix.lower() in FIGURE_FILES:
        return [save(comparison_figure(comparison, kind), path)]
    if path.suffix:
        raise ValueError(f"`path` must be a folder or end in {', '.join(FIGURE_FILES)}; got {str(path)!r}.")
    kinds = _drawable(comparison) if kind == "overview" else (kind,)
    return [save(comparison_figure(comparison, k), path / f"{prefix}{k}.png") for k in kinds]


def overview(comparisons: Sequence[Compared]) -> Figure:
    """One row for each system: error against run time, energy error over time, volume error over time.

    Panels of metrics that were not requested are left out.
    """
    kinds = [k for k in _PANELS if any(k in _panels(c) for c in comparisons)]
    if not kinds:
        raise ValueError("`comparisons` hold nothing to draw: ask compare() for 'error', 'energy' or 'volume'.")
    n, m = len(comparisons), len(kinds)
    figure = new_figure(0.6 + 4.1 * m, 0.7 + 2.9 * n)
    axes = figure.subplots(n, m, squeeze=False)
    styles = _styles(comparisons)
    for row, comparison in zip(axes, comparisons, strict=True):
        for ax, kind in zip(row, kinds, strict=True):
            if kind in _drawable(comparison):
                _PANELS[kind](ax, comparison, styles)
            else:
                ax.set_axis_off()
        row[0].set_title(filled(comparison.title, 3.4, 10), loc="left", fontsize=10, color=TEXT, fontweight="bold")
    _legend(figure, comparisons)
    return figure


def _error_panel(ax: Axes, comparison: Compared, styles: dict[str, tuple[str, str]]) -> None:
    """Error against run time: one point for each method."""
    from matplotlib.ticker import NullFormatter

    shown = [r.row for r in comparison.runs if r.row.run_time and r.row.error is not None and np.isfinite(r.row.error)]
    for row in shown:
        colour, marker = styles[row.label]
        spread = min(row.run_time_spread or 0.0, row.run_time or 0.0) / 2
        error = max(row.error or 0.0, ROUNDING_FLOOR)
        ax.errorbar(row.run_time or 0.0, error, xerr=spread, color=colour, lw=1, capsize=0, zorder=2)
        ax.plot(row.run_time or 0.0, error, marker, color=colour, ms=8, mec="white", mew=0.8, zorder=3)
    ax.set(xscale="log", yscale="log")
    if shown:
        _widen(ax.set_xlim, [row.run_time or 0.0 for row in shown])
        _widen(ax.set_ylim, [max(row.error or 0.0, ROUNDING_FLOOR) for row in shown], share=0.16)
    _annotate(ax, [(row.run_time or 0.0, max(row.error or 0.0, ROUNDING_FLOOR), row.label) for row in shown], styles)
    for axis in (ax.xaxis, ax.yaxis):  # with a decade there are labels enough; those between would overlap
        axis.set_minor_formatter(NullFormatter())
    dress(ax, "run time [s]", r"$\max_t\,\|y - y_{\mathrm{ref}}\|$")


def _energy_panel(ax: Axes, comparison: Compared, styles: dict[str, tuple[str, str]]) -> None:
    """|energy error| over time: samples faint, their running maximum bold."""
    for run, sol, series in _series(comparison, "energy"):
        colour = styles[run.row.label][0]
        middle = np.median(series.reshape(-1, series.shape[-1]), axis=0)  # of a batch
        t, e = sol.t, np.maximum(middle, ROUNDING_FLOOR)
        ax.plot(t, e, color=colour, lw=0.4, alpha=0.3, zorder=1)
        order = 3 if run.row.method == "sympflow" else 2
        ax.plot(t, np.fmax.accumulate(e), _dash(run), color=colour, lw=1.6, zorder=order)
    ax.set_yscale("log")
    _limits(ax)
    what = "|error of the energy balance|" if "balance" in comparison.metrics else "|energy error|"
    dress(ax, "t", what + (", relative" if comparison.system.energy_scale is None else ", scaled"))


def _volume_panel(ax: Axes, comparison: Compared, styles: dict[str, tuple[str, str]]) -> None:
    """|Σ log|det|| over time; shaded, the amount that rounding of the steps explains."""
    n_steps = 0
    for run, sol, series in _series(comparison, "volume"):
        n_steps = max(n_steps, int(sol.stats["n_steps"]))
        v = np.abs(series).reshape(-1, len(sol.t))
        worst = v[np.argmax(np.where(np.isfinite(v[:, -1]), v[:, -1], np.inf))]
        worst = np.where(np.isfinite(worst), np.maximum(worst, ROUNDING_FLOOR), np.nan)
        ax.plot(sol.t, worst, _dash(run), color=styles[run.row.label][0], lw=1.4)
    ax.set_yscale("log")
    _limits(ax)
    if n_steps:  # else no run reached its end
        rounding = 4 * n_steps * np.finfo(float).eps
        ax.axhspan(ROUNDING_FLOOR / 10, rounding, color="#EEEEEE", zorder=0, lw=0)
        where, top = ax.get_yaxis_transform(), min(rounding, ax.get_ylim()[1])
        ax.text(0.98, top / 2, "rounding", transform=where, ha="right", va="top", fontsize=8, color="#888888")
    dress(ax, "t", "|log volume ratio|")


_PANELS = {"error": _error_panel, "energy": _energy_panel, "volume": _volume_panel}


def _series(comparison: Compared, name: str) -> list[tuple[Attempt, Solution, np.ndarray]]:
    found = [(run, run.sol, getattr(run, name)) for run in comparison.runs]
    return [(run, sol, series) for run, sol, series in found if sol is not None and series is not None and len(sol.t)]


def _dash(run: Attempt) -> str:
    """Leapfrog is dashed: its curves lie on Verlet's."""
    return "--" if run.row.method == "leapfrog" else "-"


def _drawable(comparison: Compared) -> tuple[str, ...]:
    return (*_panels(comparison), *(("portrait",) if any(run.sol is not None for run in comparison.runs) else ()))


def _panels(comparison: Compared) -> tuple[str, ...]:
    measured = {"energy" if m == "balance" else m for m in comparison.metrics}
    return tuple(k for k in _PANELS if k in measured)


def _styles(comparisons: Sequence[Compared]) -> dict[str, tuple[str, str]]:
    return method_styles([(run.row.label, run.row.method) for c in comparisons for run in c.runs])


def _legend(figure: Figure, comparisons: Sequence[Compared]) -> None:
    """One legend above all panels."""
    from matplotlib.lines import Line2D

    ran = {run.row.label for c in comparisons for run in c.runs if run.sol is not None}
    handles = [
        Line2D([], [], color=colour, marker=marker, ms=6, mec="white", lw=1.8, label=label)
        for label, (colour, marker) in _styles(comparisons).items()
        if label in ran
    ]
    legend_above(figure, handles, 4 if figure.get_figwidth() < 7 else 7)


def _limits(ax: Axes) -> None:
    """Log axis within what float64 errors can mean, and not squashed by a run that diverges."""
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines] or [np.ones(1)])
    values = values[np.isfinite(values) & (values > 0)]
    if values.size:
        low, high = max(values.min(), ROUNDING_FLOOR), min(values.max(), 1e4)
        ax.set_ylim(low / 3, max(high, 10 * low) * 3)


def _widen(set_limits: Any, values: Sequence[float], share: float = 0.25) -> None:
    """Limits of a log axis that leave a share of the range on either side, for labels, and hold a decade at least."""
    low, high = np.log10(min(values)), np.log10(max(values))
    margin = max(share * (high - low), 0.4, (1.3 - (high - low)) / 2)
    set_limits(10 ** (low - margin), 10 ** (high + margin))


def _annotate(ax: Axes, points: Sequence[tuple[float, float, str]], styles: dict[str, tuple[str, str]]) -> None:
    """A label beside each point: above, below, right or left of it, where it covers least of the others."""
    box = ax.get_window_extent()
    inches = np.array([box.width, box.height]) / ax.figure.dpi
    place = ax.transData + ax.transAxes.inverted()
    markers = [(at - 5.0, at + 5.0) for at in (place.transform((x, y)) * inches * 72 for x, y, _ in points)]
    placed: list[tuple[np.ndarray, np.ndarray]] = []
    for k in sorted(range(len(points)), key=lambda k: points[k]):
        x, y, label = points[k]
        size = np.array([LETTER * len(label), LINE])
        centre = (markers[k][0] + markers[k][1]) / 2
        choices = []
        for dx, dy, align, shift in _BESIDE:
            low = centre + np.array([dx - shift * size[0], dy - BELOW])
            taken = markers[:k] + markers[k + 1 :] + placed
            outside = _area(low, low + size) - _overlap((low, low + size), (np.zeros(2), inches * 72))
            choices.append((sum(_overlap((low, low + size), other) for other in taken) + outside, dx, dy, align, low))
        _, dx, dy, align, low = min(choices, key=lambda choice: choice[0])
        placed.append((low, low + size))
        ax.annotate(
            label, (x, y), xytext=(dx, dy), textcoords="offset points", ha=align, fontsize=8, color=styles[label][0]
        )


LETTER, LINE, BELOW = 4.4, 11.0, 2.0
"""Points that a letter of a label is wide, that a label is high, and that it reaches below its line."""
_BESIDE = ((0.0, 7.0, "center", 0.5), (0.0, -13.0, "center", 0.5), (8.0, -3.0, "left", 0.0), (-8.0, -3.0, "right", 1.0))
"""Offsets of a label in points, its alignment, and the share of it that is left of there."""


def _area(low: np.ndarray, high: np.ndarray) -> float:
    return float(np.prod(np.maximum(high - low, 0.0)))


def _overlap(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    """The area that two rectangles share, each its lower left and its upper right corner."""
    return _area(np.maximum(one[0], other[0]), np.minimum(one[1], other[1]))


# phase portraits ------------------------------------------------------------------------------------------------------


def portrait(comparison: Compared) -> Figure:
    """Phase space, a panel for each method with the reference behind in grey.

    One degree of freedom: the orbit in the (q, p) plane. Two: the Poincaré section q₁ = 0 with q₁ increasing along the
    run, on each method's own map. More: q₁ against q₂. Of a driven system the states after each period, q₁ against p₁.
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
    seen_after = _period(comparison) is not None
    x_label, y_label = {1: ("q", "p"), 2: ("q₂", "p₂")}.get(system.ndof, ("q₁", "q₂"))
    if seen_after and system.ndof > 1:
        x_label, y_label = "q₁", "p₁"
    for k, (ax, run) in enumerate(zip(axes.flat, runs, strict=False)):
        points = _phase_points(comparison, run.sols[0].integrator)
        ax.plot(*truth.T, ".", color="#C8C8C8", ms=8 if system.ndof == 2 else 2.5, mew=0, zorder=1, rasterized=True)
        colour, size = styles[run.row.label][0], 2.2 if len(points) > 100 else 4
        ax.plot(*points.T, ".", color=colour, ms=size, mew=0, zorder=2, rasterized=True)
        ax.set_title(filled(run.row.label, 2.2, 9), fontsize=9, color=colour)
        lowest = k + columns >= len(runs)  # nothing below it, or an empty place
        dress(ax, x_label if lowest else "", y_label if k % columns == 0 else "")
        ax.tick_params(labelbottom=lowest)
    frame(axes[0, 0], truth, 0.25)  # around the reference: a run that leaves shall not shrink everything else
    section = ": section q₁ = 0, p₁ > 0" if system.ndof == 2 else ""
    section = ": after each period" if seen_after else section
    heading = filled(f"{comparison.title}{section}; reference in grey", figure.get_figwidth() - 0.1, 10)
    figure.suptitle(heading, fontsize=10, color=TEXT, x=0.01, ha="left")
    return figure


def _phase_points(comparison: Compared, integrator: Any) -> np.ndarray:
    """The points of one run that a portrait shows, (m, 2)."""
    system = comparison.system
    starts = to_numpy(comparison.y0).reshape(-1, 2 * system.ndof)
    period = _period(comparison)
    if period is not None:
        return stroboscopic(integrator, system, comparison.t_span, starts, period).states[:, [0, system.ndof]]
    if system.ndof == 2:
        found = crossings(integrator, system, comparison.t_span, starts, Plane(0, 0.0, 1), system.dt)
        return found.states[:, [1, 3]]
    t = comparison.t
    with any_step():
        sol = solve(system, integrator, comparison.t_span, comparison.y0, t_eval=t, on_domain_exit="ignore")
    return to_numpy(sol.states).reshape(-1, 2 * system.ndof)[:, [0, 1]]


def _period(comparison: Compared) -> float | None:
    """The period of a driven system, of which the interval holds one at least."""
    period = comparison.system.period
    return period if period is not None and whole_periods(comparison.t_span, period) else None


def _reference_points(comparison: Compared) -> np.ndarray:
    system = comparison.system
    atol = 1e-12 * smallest_size(system, to_numpy(comparison.y0))
    accurate = build("kahan_li8", {}) if system.separable else build("dop853", {"rtol": 1e-12, "atol": atol})
    return _phase_points(comparison, accurate)


# work and precision ---------------------------------------------------------------------------------------------------


def precision_figure(rows: Sequence[Row], heading: str, measure: str = "energy_error") -> Figure:
    """Cost against error, log–log: run time on the left, evaluations on the right; a row for each batch size.

    Points whose error the reference cannot resolve are hollow. Trained flows have no evaluations of the force.

    Raises
    ------
    ValueError
        For another measure than "energy_error", "balance_error" or "error".
    """
    check_one_of("measure", measure, MEASURES)
    sizes = sorted({row.trajectories for row in rows})
    figure = new_figure(9.6, 0.8 + 3.9 * len(sizes))
    axes = figure.subplots(len(sizes), 2, squeeze=False, sharex=False)
    labels = list(dict.fromkeys((row.label, row.method) for row in rows))
    styles = method_styles(labels)
    for line, size in zip(axes, sizes, strict=True):
        for ax, cost in zip(line, COSTS, strict=True):
            for label, _ in labels:
                points = [row for row in rows if row.label == label and row.trajectories == size]
                _precision_curve(ax, points, cost, measure, styles[label])
            ax.set(xscale="log", yscale="log")
            dress(ax, MEASURES[measure], COSTS[cost])
            ax.invert_xaxis()
        many = "one trajectory" if size == 1 else f"batch of {size:,}"
        line[0].set_title(filled(f"{heading}, {many}", 4.3, 10), loc="left", fontsize=10)
    legend_above(figure, labelled(axes.flat), 7)
    return figure


def _precision_curve(ax: Axes, points: Sequence[Row], cost: str, measure: str, style: tuple[str, str]) -> None:
    colour, marker = style
    known = []
    for p in points:
        error = getattr(p, measure)
        counted = (p.force_evaluations or 0.0) + (p.hessian_evaluations or 0.0)
        spent = p.run_time if cost == "run_time" else counted
        if error and spent and error < LEAST_PRECISE:
            known.append((error, spent, p.status == "uncertain"))
    if not known:
        return
    errors, costs, _ = zip(*known, strict=True)
    ax.plot(errors, costs, color=colour, lw=1.2, marker=marker, ms=5.5, mec="white", mew=0.6, label=points[0].label)
    hollow = [(e, c) for e, c, doubt in known if doubt]
    if measure == "error" and hollow:
        ax.plot(*zip(*hollow, strict=True), marker, color="white", mec=colour, ms=5)


# stability ------------------------------------------------------------------------------------------------------------


def step_errors(all_rows: Sequence[Row]) -> Figure:
    """A panel for each system: energy error against the step, unstable steps as crosses at the top."""
    names = list(dict.fromkeys(r.system for r in all_rows))
    figure = new_figure(5.6 * len(names), 4.2)
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    styles = method_styles(list(dict.fromkeys((r.label, r.method) for r in all_rows)))
    for ax, name in zip(axes, names, strict=True):
        rows = [r for r in all_rows if r.system == name and r.energy_error is not None]
        for label, dtype in dict.fromkeys((r.label, r.dtype) for r in rows):
            own = [r for r in rows if (r.label, r.dtype) == (label, dtype)]
            _stability_curve(ax, own, styles[label], "" if dtype == "float64" else f" ({dtype})")
        ax.set_ylim(SMALLEST / 3, 3 * LARGEST)  # before the scale, which warns where all errors are the same
        ax.set(xscale="log", yscale="log")
        _plain_ticks(ax.xaxis, [r.dt for r in rows if r.dt is not None])
        dress(ax, "step", "largest |energy error|, relative")
        ax.set_title(filled(name, 5.0, 10), loc="left", fontsize=10, color=TEXT)
    legend_above(figure, labelled(axes), 6)
    return figure


def _stability_curve(ax: Axes, rows: Sequence[Row], style: tuple[str, str], note: str) -> None:
    colour, marker = style
    fixed = [(r.dt, _shown(r)) for r in rows if r.dt is not None]
    line: dict[str, Any] = {"color": colour, "lw": 1.2, "ls": "--" if note else "-", "mec": "white", "mew": 0.6}
    if fixed:
        ax.plot(*zip(*fixed, strict=True), marker=marker, ms=5.5, label=rows[0].label + note, **line)
    elif rows:  # adaptive: no step
        ax.axhline(_shown(rows[0]), color=colour, lw=1.0, ls=":", label=rows[0].label + note)
    lost = [r.dt for r in rows if r.dt is not None and r.status in ("unstable", "outside")]
    if lost:
        ax.plot(lost, [LARGEST] * len(lost), "x", color=colour, ms=7, mew=1.6)


def _plain_ticks(axis: Axis, values: list[float]) -> None:
    """The values themselves as ticks where powers of ten are too few for a scale; matplotlib would write 6×10⁰."""
    ticks = sorted(set(values))
    if ticks and ticks[-1] < 100 * ticks[0]:
        spread = [t for i, t in enumerate(ticks) if i == 0 or t > 1.15 * ticks[i - 1]]
        axis.set_ticks(spread, labels=[f"{t:.3g}" for t in spread])
        axis.set_ticks([], minor=True)


def _shown(row: Row) -> float:
    error = row.energy_error
    return LARGEST if error is None or not math.isfinite(error) else min(max(error, SMALLEST), LARGEST)


def stability_map(
    all_rows: Sequence[Row], limits: Mapping[str, Sequence[tuple[float, float]]], missing: Sequence[str]
) -> Figure:
    """A panel for each method: step against stiffness, coloured by energy error; × where it is not valid.

    Parameters
    ----------
    limits : mapping
        For each label the points (longest stable step, stiffness) of its line.
    missing : sequence of str
        Sentences on the methods without a limit, for the foot of the figure.
    """
    from matplotlib.colors import LogNorm

    labels = list(dict.fromkeys(r.label for r in all_rows if r.energy_error is not None and r.dt is not None))
    columns = min(3, len(labels)) or 1
    lines = -(-len(labels) // columns) or 1
    figure = new_figure(3.6 * columns + 1.0, 3.0 * lines + 0.4)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    norm, image = LogNorm(1e-10, 10), None
    for ax, label in zip(axes, labels, strict=False):
        rows = [r for r in all_rows if r.label == label and r.dt is not None and r.energy_error is not None]
        x, y = np.array([r.dt for r in rows]), np.array([r.value for r in rows])
        error = np.array([_shown(r) for r in rows])
        bad = np.array([r.status in ("unstable", "outside") for r in rows])
        shades: dict[str, Any] = {"c": np.clip(error[~bad], norm.vmin, norm.vmax), "norm": norm, "cmap": "viridis"}
        image = ax.scatter(x[~bad], y[~bad], marker="s", s=34, **shades)
        ax.scatter(x[bad], y[bad], c=UNSTABLE, marker="x", s=22, lw=1.0)
        if line := limits.get(label):
            ax.plot(*zip(*line, strict=True), color="#D55E00", lw=1.4, marker="o" if len(line) == 1 else "", ms=4)
        ax.set(xscale="log", yscale="log")
        _plain_ticks(ax.xaxis, [r.dt for r in all_rows if r.dt is not None])
        _plain_ticks(ax.yaxis, [r.value for r in all_rows if r.value is not None])
        parameter = next((r.parameter for r in rows if r.parameter), "parameter")
        dress(ax, "step", _GREEK.get(parameter, parameter))
        ax.set_title(filled(label, 3.2, 10), loc="left", fontsize=10, color=TEXT)
    for i in range(len(labels), len(axes)):  # an empty place: the panel above it bears the labels
        axes[i].set_visible(False)
        axes[i - columns].tick_params(labelbottom=True)
    if missing:
        note = "Line: the longest stable step.\n" + "\n".join(missing)
        figure.supxlabel(filled(note, figure.get_figwidth() - 0.2, 8), fontsize=8, color=TEXT, ha="left", x=0.02)
    if image is not None:
        bar = figure.colorbar(image, ax=list(axes), shrink=0.9)
        bar.set_label("largest |energy error|, relative (×: unstable)", fontsize=9, color=TEXT)
    return figure


# sections ---------------------------------------------------------------------------------------------------------


def section_figure(
    points: np.ndarray, trajectory: np.ndarray, n_trajectories: int, axes: tuple[str, str], heading: str
) -> Figure:
    """Points (n, 2) of a section, each trajectory in a shade of its own."""
    figure = new_figure(4.6, 4.4)
    ax = figure.add_subplot()
    shades: dict[str, Any] = {"c": trajectory, "cmap": "viridis", "vmax": max(1.15 * (n_trajectories - 1), 1)}
    ax.scatter(points[:, 0], points[:, 1], s=3.0, linewidths=0, rasterized=True, **shades)
    frame(ax, points, 0.05)
    ax.set_title(filled(heading, 4.0, 9), fontsize=9, color=TEXT)
    dress(ax, *axes)
    return figure
