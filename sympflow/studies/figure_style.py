"""How the figures look: colours and markers of the methods, frame and grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

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
_OTHER_MARKERS = ("P", "X", "*", "<", ">", "h")
TEXT = "#333333"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, in inches."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "sympflow[plot]".') from error
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def method_styles(labels: Sequence[tuple[str, str]]) -> dict[str, tuple[str, str]]:
    """Colour and marker for each (label, method); the methods of the paper have their own."""
    styles: dict[str, tuple[str, str]] = {}
    taken: set[str] = set()
    others = 0
    for label, method in labels:
        if label in styles:
            continue
        if method in _STYLES and method not in taken:
            styles[label] = _STYLES[method]
            taken.add(method)
        else:
            styles[label] = (_OTHER_COLOURS[others % 6], _OTHER_MARKERS[(others + others // 6) % 6])
            others += 1
    return styles


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
