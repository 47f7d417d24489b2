"""The figures of comparisons: error against run time, energy and volume errors over time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.solution import Solution
from sympflow.studies.comparison_report import Comparison
from sympflow.studies.figure_style import TEXT, dress, method_styles, new_figure, save
from sympflow.studies.measurements import Run
from sympflow.studies.portraits import portrait

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("overview", "energy", "volume", "error", "portrait")
ROUNDING_FLOOR = 1e-17
FIGURE_FILES = (".png", ".pdf", ".svg")


def comparison_figure(comparison: Comparison, kind: str = "overview") -> Figure:
    """One figure of a comparison: "overview", "energy", "volume", "error" or "portrait".

    The overview of a comparison that measured none of its panels is the portrait.

    Raises
    ------
    ValueError
        For an unknown kind, or one whose metric was not asked for.
    ImportError
        Without matplotlib.
    """
    if kind not in KINDS:
        raise ValueError(f"`kind` must be one of {', '.join(map(repr, KINDS))}; got {kind!r}.")
    if kind == "overview":
        return portrait(comparison) if _drawable(comparison) == ("portrait",) else overview([comparison])
    if kind not in _drawable(comparison):
        raise ValueError(f"`kind` {kind!r} shows what was not measured: add it to `metrics` of compare().")
    if kind == "portrait":
        return portrait(comparison)
    figure = new_figure(6.4, 4.2)
    ax = figure.add_subplot()
    _PANELS[kind](ax, comparison, _styles([comparison]))
    ax.set_title(comparison.title, loc="left", fontsize=10, color=TEXT)
    if kind != "error":
        _legend(figure, [comparison])
    return figure


def save_comparison(
    comparison: Comparison, path: str | os.PathLike[str], kind: str = "overview", prefix: str = ""
) -> list[Path]:
    """Save one figure to a file (.png, .pdf or .svg); into a folder the overview saves every kind that was measured.

    Returns
    -------
    list of Path
        The files written.
    """
    path = Path(path)
    if path.suffix.lower() in FIGURE_FILES:
        return [save(comparison_figure(comparison, kind), path)]
    if path.suffix:
        raise ValueError(f"`path` must be a folder or end in {', '.join(FIGURE_FILES)}; got {str(path)!r}.")
    kinds = _drawable(comparison) if kind == "overview" else (kind,)
    return [save(comparison_figure(comparison, k), path / f"{prefix}{k}.png") for k in kinds]


def overview(comparisons: Sequence[Comparison]) -> Figure:
    """One row for each system: error against run time, energy error over time, volume error over time.

    Panels of metrics that were not asked for are left out.
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
        row[0].set_title(comparison.title, loc="left", fontsize=10, color=TEXT, fontweight="bold")
    _legend(figure, comparisons)
    return figure


# panels ---------------------------------------------------------------------------------------------------


def _error_panel(ax: Axes, comparison: Comparison, styles: dict[str, tuple[str, str]]) -> None:
    """Error against run time: one point for each method."""
    from matplotlib.ticker import NullFormatter

    shown = [r.row for r in comparison.runs if r.row.run_time and r.row.error is not None and np.isfinite(r.row.error)]
    for row in shown:
        colour, marker = styles[row.label]
        spread = min(row.run_time_spread or 0.0, row.run_time or 0.0) / 2
        error = max(row.error or 0.0, ROUNDING_FLOOR)
        ax.errorbar(row.run_time or 0.0, error, xerr=spread, color=colour, lw=1, capsize=0, zorder=2)
        ax.plot(row.run_time or 0.0, error, marker, color=colour, ms=8, mec="white", mew=0.8, zorder=3)
    ax.set_xscale("log")
    ax.set_yscale("log")
    if shown:
        _widen(ax.set_xlim, [row.run_time or 0.0 for row in shown])
        _widen(ax.set_ylim, [max(row.error or 0.0, ROUNDING_FLOOR) for row in shown], share=0.16)
    _annotate(ax, [(row.run_time or 0.0, max(row.error or 0.0, ROUNDING_FLOOR), row.label) for row in shown], styles)
    for axis in (ax.xaxis, ax.yaxis):  # with a decade there are labels enough; those between would overlap
        axis.set_minor_formatter(NullFormatter())
    dress(ax, "run time [s]", r"$\max_t\,\|y - y_{\mathrm{ref}}\|$")


def _energy_panel(ax: Axes, comparison: Comparison, styles: dict[str, tuple[str, str]]) -> None:
    """|energy error| over time: samples faint, their running maximum bold."""
    for run, sol, series in _series(comparison, "energy"):
        colour = styles[run.row.label][0]
        t, e = sol.t, np.maximum(_middle(series), ROUNDING_FLOOR)
        ax.plot(t, e, color=colour, lw=0.4, alpha=0.3, zorder=1)
        order = 3 if run.row.method == "sympflow" else 2
        ax.plot(t, np.fmax.accumulate(e), _dash(run), color=colour, lw=1.6, zorder=order)
    ax.set_yscale("log")
    _limits(ax)
    dress(ax, "t", "|energy error|" + (", relative" if comparison.system.energy_scale is None else ", scaled"))


def _volume_panel(ax: Axes, comparison: Comparison, styles: dict[str, tuple[str, str]]) -> None:
    """|Σ log|det|| over time; shaded, what the rounding of the steps can amount to."""
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


def _series(comparison: Comparison, name: str) -> list[tuple[Run, Solution, np.ndarray]]:
    found = [(run, run.sol, getattr(run, name)) for run in comparison.runs]
    return [(run, sol, series) for run, sol, series in found if sol is not None and series is not None and len(sol.t)]


def _dash(run: Run) -> str:
    """Leapfrog is dashed: its curves lie on Verlet's."""
    return "--" if run.row.method == "leapfrog" else "-"


def _middle(series: np.ndarray) -> np.ndarray:
    """The median over the trajectories of a batch."""
    return series if series.ndim == 1 else np.median(series.reshape(-1, series.shape[-1]), axis=0)


def _drawable(comparison: Comparison) -> tuple[str, ...]:
    ran = any(run.sol is not None for run in comparison.runs)
    return (*_panels(comparison), *(("portrait",) if ran else ()))


def _panels(comparison: Comparison) -> tuple[str, ...]:
    return tuple(k for k in _PANELS if k in comparison.metrics)


def _styles(comparisons: Sequence[Comparison]) -> dict[str, tuple[str, str]]:
    return method_styles([(run.row.label, run.row.method) for c in comparisons for run in c.runs])


def _legend(figure: Figure, comparisons: Sequence[Comparison]) -> None:
    """One legend above all panels."""
    from matplotlib.lines import Line2D

    ran = {run.row.label for c in comparisons for run in c.runs if run.sol is not None}
    handles = [
        Line2D([], [], color=colour, marker=marker, ms=6, mec="white", lw=1.8, label=label)
        for label, (colour, marker) in _styles(comparisons).items()
        if label in ran
    ]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=min(len(handles), 4 if figure.get_figwidth() < 7 else 7) or 1,
        frameon=False,
        fontsize=9,
        labelcolor=TEXT,
    )


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
            low = centre + np.array([dx - shift * size[0], dy])
            taken = markers[:k] + markers[k + 1 :] + placed
            outside = _area(low, low + size) - _overlap((low, low + size), (np.zeros(2), inches * 72))
            choices.append((sum(_overlap((low, low + size), other) for other in taken) + outside, dx, dy, align, low))
        _, dx, dy, align, low = min(choices, key=lambda choice: choice[0])
        placed.append((low, low + size))
        ax.annotate(
            label,
            (x, y),
            xytext=(dx, dy),
            textcoords="offset points",
            ha=align,
            fontsize=8,
            color=styles[label][0],
        )


LETTER, LINE = 4.4, 9.0  # points that a letter of a label is wide, and high
_BESIDE = ((0.0, 9.0, "center", 0.5), (0.0, -15.0, "center", 0.5), (8.0, -3.0, "left", 0.0), (-8.0, -3.0, "right", 1.0))
"""Offsets of a label in points, its alignment, and the share of it that is left of there."""


def _area(low: np.ndarray, high: np.ndarray) -> float:
    return float(np.prod(np.maximum(high - low, 0.0)))


def _overlap(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    """The area that two rectangles share, each its lower left and its upper right corner."""
    return _area(np.maximum(one[0], other[0]), np.minimum(one[1], other[1]))
