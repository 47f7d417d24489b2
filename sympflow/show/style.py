"""Style of the figures: colours and markers of the methods, frame and grid; and how they are saved.

`Figure` objects, never pyplot: nothing global is touched, and any backend will do.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arguments import naming_path, writable
from sympflow.lazy import needed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers can tell apart; a method has its colour in every figure.
_STYLES = {
    "sympflow": ("#D55E00", "o"),
    "mlp": ("#CC79A7", "s"),
    "verlet": ("#0072B2", "^"),
    "leapfrog": ("#56B4E9", "v"),
    "rk45": ("#009E73", "D"),
}
_OTHER_COLOURS = ("#E69F00", "#000000", "#7F3C8D", "#8C6D31", "#666666", "#A5AA99")
_OTHER_MARKERS = ("P", "X", "p", "<", ">", "h")
TEXT = "#333333"
LETTER_WIDTH = 0.55  # of a mean letter, in units of the font size
LONGEST_LABEL, TWO_LINES = 2.6, 0.5  # width of a line of a legend, and height of two lines of it, in inches


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, in inches."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(f"Figures need matplotlib: {needed('matplotlib', 'plot')}.") from error
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def method_styles(labels: Sequence[tuple[str, str]]) -> dict[str, tuple[str, str]]:
    """Colour and marker for each (label, method).

    Each method of the paper has its own, borne by the one that is labelled with its name, or else by the first.
    """
    own = {method: label for label, method in reversed(labels)} | {m: label for label, m in labels if label == m}
    styles: dict[str, tuple[str, str]] = {}
    others = 0
    for label, method in labels:
        if label in styles:
            continue
        if method in _STYLES and own[method] == label:
            styles[label] = _STYLES[method]
        else:
            styles[label] = (_OTHER_COLOURS[others % 6], _OTHER_MARKERS[(others + others // 6) % 6])
            others += 1
    return styles


def frame(ax: Axes, points: np.ndarray, margin: float) -> None:
    """Limits around points (n, 2) with a margin, as a share of their extent.

    An extent below a tenth of the largest coordinate counts as that: where all points are one, the rounding of its
    coordinates is not magnified into a picture.
    """
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return
    low, high = points.min(0), points.max(0)
    half = (0.5 + margin) * np.maximum(high - low, 0.1 * np.abs(points).max() + 1e-12)
    (left, bottom), (right, top) = (low + high) / 2 - half, (low + high) / 2 + half
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)


def labelled(axes: Iterable[Axes]) -> list[Any]:
    """The lines of the panels that have a label, one for each label."""
    return list({h.get_label(): h for ax in axes for h in ax.lines if not str(h.get_label()).startswith("_")}.values())


def legend_above(figure: Figure, handles: Sequence[Any], columns: int) -> None:
    """One legend above all panels, in at most so many columns, within the width of the figure.

    Long labels are broken. The figure grows by the lines of the legend beyond the second, so that these take nothing
    from the panels.
    """
    longest = min(LONGEST_LABEL, figure.get_figwidth() - 0.8)  # a line takes its part
    labels = [filled(str(h.get_label()), longest, 9) for h in handles]
    for n in range(min(len(handles), columns), 0, -1):
        legend = figure.legend(
            list(handles), labels, loc="outside upper center", ncols=n, frameon=False, fontsize=9, labelcolor=TEXT
        )
        box = legend.get_window_extent()
        if n == 1 or box.width <= 0.98 * figure.bbox.width:
            figure.set_figheight(figure.get_figheight() + max(0.0, box.height / figure.dpi - TWO_LINES))
            return
        legend.remove()


def filled(text: str, inches: float, size: float) -> str:
    """Break the lines of a text that are longer than a width in inches at a font size in points."""
    width = max(12, int(72 * inches / (LETTER_WIDTH * size)))
    return "\n".join(textwrap.fill(line, width, break_long_words=False) for line in text.splitlines())


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure, making its folder; errors as for `files.writable`, and a ValueError for an unknown format."""
    path = writable(path)
    known = figure.canvas.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in known:
        raise ValueError(
            f"`path` {path.name!r} ends in {path.suffix!r}, which is not a format of figures: take one of "
            f"{', '.join(sorted(known))}."
        )
    path = path if path.suffix else path.with_name(f"{path.name}.png")
    with naming_path(path):
        figure.savefig(path, dpi=200)
    return path


def saved(figure: Figure, path: str | os.PathLike[str] | None) -> Figure:
    """The figure, which is also saved where a path is given."""
    if path is not None:
        save(figure, path)
    return figure


def dress(ax: Axes, x_label: str, y_label: str) -> None:
    """Labels, grid and frame, the same in every panel."""
    ax.set_xlabel(x_label, fontsize=9, color=TEXT)
    ax.set_ylabel(y_label, fontsize=9, color=TEXT)
    ax.tick_params(labelsize=8, colors=TEXT, which="both", width=0.6)
    ax.grid(True, which="major", color="#E6E6E6", lw=0.6, zorder=0)
    ax.set_axisbelow(True)
    for side, spine in ax.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#999999")
        spine.set_linewidth(0.8)
