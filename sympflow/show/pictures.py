"""Figures of trajectories: orbits, phase planes and energy errors, of solutions, flows, ensembles and data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.show.style import TEXT, dress, filled, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("orbit", "phase", "energy")
MOST_LINES, MOST_POINTS = 16, 20_000  # trajectories of a batch that are drawn, and points of each
CURVED, SMOOTH = 12, 0.02  # points of a curve between two outputs, and its error in units of its extent at most
FEW = 30  # points of a line from which none is marked
COARSE = 0.5  # radians between two points of a phase plane beyond which these are not joined
MANY = 12  # degrees of freedom from which the orbit is a map of q over time
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F3C8D", "#666666")


def trajectory_figure(
    t: np.ndarray,
    y: np.ndarray,
    energy_error: Any,
    title: str,
    kinds: Sequence[str] = KINDS,
    marker: str = "",
    rates: np.ndarray | None = None,
    masses: np.ndarray | None = None,
) -> Figure:
    """Panels of trajectories y (N, 2d, n) at t, (n,) or (N, n), with a `marker` where states are samples.

    States that are far apart are joined by curves that have the derivatives `rates`, where such curves are right. Of
    bodies with `masses` (b,), 0 where momenta are per unit mass, those of the first trajectory are drawn.
    """
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise ValueError(f"`kinds` must be some of {', '.join(map(repr, KINDS))}; got {list(kinds)!r}.")
    panels = [kind for kind in dict.fromkeys(kinds) if kind != "energy" or energy_error is not None]
    figure = new_figure(3.6 * max(1, len(panels)), 3.3)
    draw = {"orbit": _orbit, "phase": _phase, "energy": _energy}
    every = max(1, -(-t.shape[-1] // MOST_POINTS))
    error = np.empty((0, t.shape[-1])) if energy_error is None else energy_error[:MOST_LINES, ::every]
    times, t, y = t[..., ::every], t[..., ::every], y[:MOST_LINES, :, ::every]
    if masses is not None and y.shape[1] // 2 > len(masses):
        y, rates = _by_bodies(y[0], masses), None if rates is None else _by_bodies(rates[0], masses)
        draw["orbit"], draw["phase"] = _bodies, _phase_of_bodies
    if rates is not None and not marker and every == 1:
        t, y = _curves(t, y, rates[:MOST_LINES])
    marker = marker or "." * _coarse(y[:, :: max(1, y.shape[1] // 2)])
    for kind, ax in zip(panels, figure.subplots(1, len(panels), squeeze=False)[0] if panels else (), strict=True):
        draw[kind](ax, times if kind == "energy" else t, y, error, marker)
    figure.suptitle(filled(title, 3.4 * max(1, len(panels)), 10), fontsize=10, color=TEXT)
    return figure


def _dress(ax: Axes, x_label: str, y_label: str) -> None:
    """Labels and frame, and numbers along x that do not overlap."""
    dress(ax, x_label, y_label)
    ax.locator_params(axis="x", nbins=6)
    ax.ticklabel_format(axis="x", scilimits=(-3, 4))


def _coarse(y: np.ndarray) -> bool:
    """True for curves (N, 2, n) that turn too far between points to be drawn by lines from one to the next."""
    with np.errstate(all="ignore"):
        steps = np.diff(y, axis=-1) / np.ptp(y, axis=-1, keepdims=True)
        turns = np.diff(np.arctan2(steps[:, 1], steps[:, 0]), axis=-1)
        turns = np.abs((turns + np.pi) % (2 * np.pi) - np.pi)
    return bool(np.median(turns[np.isfinite(turns)]) > COARSE) if np.isfinite(turns).any() else y.shape[-1] == 1


def _by_bodies(y: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """States (2d, n) of bodies as (b, 4, n): two coordinates of each, and momenta over masses."""
    q, p = y.reshape(2, len(masses), -1, y.shape[-1])[..., :2, :]
    return np.concatenate([q, p / np.where(masses == 0, 1.0, masses)[:, None, None]], axis=1)[:MOST_LINES]


def _curves(t: np.ndarray, y: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cubic curves (N, 2d, m) through states by their derivatives; the states themselves where these miss too much.

    A curve over two intervals misses the state between them by 16 times the error of one over one interval.
    """
    if not 3 <= len(t) < MOST_POINTS // CURVED or (np.diff(t) == 0).any():
        return t, y
    middle = _hermite(t[::2], y[..., ::2], rates[..., ::2], t[1:-1:2])
    d = y.shape[1] // 2
    with np.errstate(all="ignore"):
        missed = np.abs(middle - y[..., 1:-1:2]).max(-1) / 16 / np.ptp(y, axis=-1)
        if not np.nanmedian(missed[:, [0, min(1, d), d]], axis=0).max() < SMOOTH:
            return t, y
    s = np.append((t[:-1, None] + np.diff(t)[:, None] * np.arange(CURVED) / CURVED).ravel(), t[-1])
    return s, _hermite(t, y, rates, s)


def _hermite(t: np.ndarray, y: np.ndarray, rates: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Cubic interpolation (..., m) at times s of values y (..., n) with these derivatives."""
    i = np.searchsorted(t if t[-1] > t[0] else -t, s if t[-1] > t[0] else -s, side="right").clip(1, len(t) - 1)
    h = t[i] - t[i - 1]
    x = (s - t[i - 1]) / h
    a, b = y[..., i - 1], y[..., i]
    rest = (1 - x) * (a - b + h * rates[..., i - 1]) + x * (b - a - h * rates[..., i])
    return (1 - x) * a + x * b + x * (1 - x) * rest


def _lines(ax: Axes, x: np.ndarray, y: np.ndarray, marker: str = "") -> None:
    marker = marker or ".-" * (x.shape[-1] < FEW)
    thin = 0.9 if x.shape[-1] > 2000 else 1.2
    for k, (a, b) in enumerate(zip(np.broadcast_to(x, y.shape), y, strict=True)):
        ax.plot(a, b, marker or "-", ms=2.5, lw=thin, alpha=0.85, color=COLOURS[k % len(COLOURS)])


def _orbit(ax: Axes, t: np.ndarray, y: np.ndarray, error: np.ndarray, marker: str) -> None:
    d = y.shape[1] // 2
    if d == 1:
        _lines(ax, t, y[:, 0], marker and f"{marker}-")
        _dress(ax, "t", "q")
    elif d < MANY:
        _lines(ax, y[:, 0], y[:, 1], marker)
        _dress(ax, "q₁", "q₂")
        ax.set_aspect("equal", "datalim")
    else:
        q = y[0, :d]
        largest = float(np.nanmax(np.abs(q), initial=0.0)) or 1.0
        times, sites = t if t.ndim == 1 else t[0], np.arange(1, d + 1)
        shown = ax.pcolormesh(times, sites, q, cmap="RdBu_r", vmin=-largest, vmax=largest, rasterized=True)
        ax.figure.colorbar(shown, ax=ax, shrink=0.8).set_label("q", color=TEXT)
        _dress(ax, "t", "coordinate")


def _bodies(ax: Axes, t: np.ndarray, y: np.ndarray, error: np.ndarray, marker: str) -> None:
    _lines(ax, y[:, 0], y[:, 1], marker)
    for i, (line, place) in enumerate(zip(list(ax.lines), y[:, :2, -1], strict=True)):
        line.set_label(str(i))
        ax.plot(*place, "o", ms=3, color=line.get_color())
    _dress(ax, "x", "y")
    ax.set_aspect("equal", "datalim")
    if len(y) <= 2 * len(COLOURS):
        ax.legend(title="body", loc="upper left", bbox_to_anchor=(1, 1), fontsize=7, title_fontsize=7, frameon=False)


def _phase_of_bodies(ax: Axes, t: np.ndarray, y: np.ndarray, error: np.ndarray, marker: str) -> None:
    _lines(ax, y[:, 0], y[:, 2], marker)
    _dress(ax, "x", "pₓ/m")


def _phase(ax: Axes, t: np.ndarray, y: np.ndarray, error: np.ndarray, marker: str) -> None:
    d = y.shape[1] // 2
    _lines(ax, y[:, 0], y[:, d], marker)
    _dress(ax, *(("q", "p") if d == 1 else ("q₁", "p₁")))


def _energy(ax: Axes, t: np.ndarray, y: np.ndarray, error: np.ndarray, marker: str) -> None:
    _lines(ax, t, np.where(error == 0, np.nan, np.abs(error)))
    _dress(ax, "t", "|energy error|, relative")
    if np.isfinite(error).any() and np.any(error):
        ax.set_yscale("log")


def histogram_figure(values: dict[str, np.ndarray], title: str) -> Figure:
    """Histograms of numbers, a panel for each name."""
    figure = new_figure(3.6 * len(values), 3.0)
    for ax, (name, array) in zip(figure.subplots(1, len(values), squeeze=False)[0], values.items(), strict=True):
        ax.hist(array[np.isfinite(array)], bins=40, color=COLOURS[0])
        _dress(ax, name, "orbits")
    figure.suptitle(filled(title, 3.4 * len(values), 10), fontsize=10, color=TEXT)
    return figure


def curves_figure(x: np.ndarray, curves: np.ndarray, labels: tuple[str, str], title: str, bars: bool = False) -> Figure:
    """Curves (N, n) over x, (n,) or (N, n), positive ones on a logarithmic scale; as bars where x is not in order."""
    figure = new_figure(4.2, 3.3)
    ax = figure.subplots()
    x, curves = np.broadcast_to(x, curves.shape)[:MOST_LINES], curves[:MOST_LINES]
    _lines(ax, x, curves, "o" * bars)
    if bars:
        ax.vlines(x.ravel(), np.nanmin(curves) / 10, curves.ravel(), lw=0.8, color="#999999", zorder=1)
    if np.nanmin(curves, initial=np.inf) > 0 and np.isfinite(curves).any():
        ax.set_yscale("log")
    _dress(ax, *labels)
    figure.suptitle(filled(title, 4.0, 10), fontsize=10, color=TEXT)
    return figure


def points_figure(x: np.ndarray, y: np.ndarray, labels: tuple[str, str], title: str) -> Figure:
    """Points (N,) in a plane."""
    figure = new_figure(4.2, 3.8)
    ax = figure.subplots()
    ax.plot(x, y, ".", ms=max(1.0, min(5.0, 200 / np.sqrt(max(1, x.size)))), alpha=0.6, color=COLOURS[0], mew=0)
    _dress(ax, *labels)
    figure.suptitle(filled(title, 4.0, 10), fontsize=10, color=TEXT)
    return figure
