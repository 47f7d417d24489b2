"""Figures of stability: energy error against the step, and maps of step against stiffness."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.studies.figure_style import TEXT, dress, legend_above, method_styles, new_figure
from sympflow.studies.stability_report import StabilityReport, StabilityRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

SMALLEST, LARGEST = 1e-15, 1e3
UNSTABLE = "#5A1020"
_GREEK = {"omega": "ω"}


def stability_figure(report: StabilityReport, kind: str | None = None) -> Figure:
    """The figure "map" or "steps" of a report.

    Raises
    ------
    ValueError
        For another kind, or a map of a single system.
    """
    kind = kind or ("map" if len(report.systems) > 1 else "steps")
    if kind == "steps":
        return _steps(report)
    if kind != "map":
        raise ValueError(f"`kind` must be 'steps' or 'map'; got {kind!r}.")
    if len({row.value for row in report.rows}) < 2:
        raise ValueError("`kind` 'map' needs several systems that differ in a parameter: pass a family to stability().")
    return _map(report)


def _steps(report: StabilityReport) -> Figure:
    """A panel for each system: energy error against the step, unstable steps as crosses at the top."""
    figure = new_figure(5.6 * len(report.systems), 4.2)
    axes = figure.subplots(1, len(report.systems), squeeze=False)[0]
    styles = method_styles(list(dict.fromkeys((r.label, r.method) for r in report.rows)))
    names = list(dict.fromkeys(r.system for r in report.rows))
    for ax, name in zip(axes, names, strict=False):
        rows = [r for r in report.rows if r.system == name and r.energy_error is not None]
        for label, dtype in dict.fromkeys((r.label, r.dtype) for r in rows):
            own = [r for r in rows if (r.label, r.dtype) == (label, dtype)]
            _curve(ax, own, styles[label], "" if dtype == "float64" else f" ({dtype})")
        ax.set_ylim(SMALLEST / 3, 3 * LARGEST)  # before the scale, which warns where all errors are the same
        ax.set_xscale("log")
        ax.set_yscale("log")
        _plain_ticks(ax.xaxis, [r.dt for r in rows if r.dt is not None])
        dress(ax, "step", "largest |energy error|, relative")
        ax.set_title(name, loc="left", fontsize=10, color=TEXT)
    legend_above(figure, axes, 6)
    return figure


def _curve(ax: Axes, rows: list[StabilityRow], style: tuple[str, str], note: str) -> None:
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


def _shown(row: StabilityRow) -> float:
    error = row.energy_error
    return LARGEST if error is None or not math.isfinite(error) else min(max(error, SMALLEST), LARGEST)


def _filled(text: str, width: int) -> str:
    """Each line of a text broken at so many characters."""
    return "\n".join(textwrap.fill(line, width) for line in text.splitlines())


def _map(report: StabilityReport) -> Figure:
    """A panel for each method: step against stiffness, coloured by energy error; × where it says nothing."""
    from matplotlib.colors import LogNorm

    labels = list(dict.fromkeys(r.label for r in report.rows if r.energy_error is not None and r.dt is not None))
    columns = min(3, len(labels)) or 1
    lines = -(-len(labels) // columns) or 1
    figure = new_figure(3.6 * columns + 1.0, 3.0 * lines + 0.4)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    norm, image = LogNorm(1e-10, 10), None
    for ax, label in zip(axes, labels, strict=False):
        rows = [r for r in report.rows if r.label == label and r.dt is not None and r.energy_error is not None]
        x, y = np.array([r.dt for r in rows]), np.array([r.value for r in rows])
        error = np.array([_shown(r) for r in rows])
        bad = np.array([r.status in ("unstable", "outside") for r in rows])
        image = ax.scatter(
            x[~bad], y[~bad], c=np.clip(error[~bad], norm.vmin, norm.vmax), norm=norm, cmap="viridis", marker="s", s=34
        )
        ax.scatter(x[bad], y[bad], c=UNSTABLE, marker="x", s=22, lw=1.0)
        limits = [
            (x.stable, x.value) for x in report.limits if x.label == label and x.stable is not None and x.unstable
        ]
        if limits:
            ax.plot(*zip(*limits, strict=True), color="#D55E00", lw=1.4, marker="o" if len(limits) == 1 else "", ms=4)
        ax.set_xscale("log")
        ax.set_yscale("log")
        _plain_ticks(ax.xaxis, [r.dt for r in report.rows if r.dt is not None])
        _plain_ticks(ax.yaxis, [r.value for r in report.rows if r.value is not None])
        parameter = next((r.parameter for r in rows if r.parameter), "parameter")
        dress(ax, "step", _GREEK.get(parameter, parameter))
        ax.set_title(label, loc="left", fontsize=10, color=TEXT)
    for i in range(len(labels), len(axes)):  # an empty place: the panel above it bears the labels
        axes[i].set_visible(False)
        axes[i - columns].tick_params(labelbottom=True)
    if missing := report.without_limit() if report.limits else []:
        note = "Line: the longest stable step.\n" + "\n".join(missing)
        figure.supxlabel(_filled(note, int(16 * figure.get_figwidth())), fontsize=8, color=TEXT, ha="left", x=0.02)
    if image is not None:
        bar = figure.colorbar(image, ax=list(axes), shrink=0.9)
        bar.set_label("largest |energy error|, relative (×: unstable)", fontsize=9, color=TEXT)
    return figure
