"""Figures with matplotlib: `Figure` objects, never pyplot, so nothing global is touched and any backend will do."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.comparison import Run
from sympflow.comparison_report import Comparison
from sympflow.crossings import section_crossings
from sympflow.integrators.registry import build
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.system import HamiltonianSystem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("overview", "energy", "volume", "error", "portrait")
ROUNDING_FLOOR = 1e-17
FIGURE_FILES = (".png", ".pdf", ".svg")

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
_TEXT = "#333333"


def comparison_figure(comparison: Comparison, kind: str = "overview") -> Figure:
    """One figure of a comparison: "overview", "energy", "volume", "error" or "portrait".

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
        return overview([comparison])
    if kind not in _drawable(comparison):
        raise ValueError(f"`kind` {kind!r} shows what was not measured: add it to `metrics` of compare().")
    if kind == "portrait":
        return portrait(comparison)
    figure = _figure(6.4, 4.2)
    ax = figure.add_subplot()
    _PANELS[kind](ax, comparison, _styles([comparison]))
    ax.set_title(comparison.title, loc="left", fontsize=10, color=_TEXT)
    if kind != "error":
        _legend(figure, [comparison])
    return figure


def save_comparison(
    comparison: Comparison, path: str | os.PathLike[str], kind: str | None = None, prefix: str = ""
) -> list[Path]:
    """Save every figure that the metrics allow into a folder, or one to a file (.png, .pdf or .svg)."""
    path = Path(path)
    if path.suffix.lower() in FIGURE_FILES:
        return [save(comparison_figure(comparison, kind or "overview"), path)]
    if path.suffix:
        raise ValueError(f"`path` must be a folder or end in {', '.join(FIGURE_FILES)}; got {str(path)!r}.")
    kinds = _drawable(comparison) if kind is None else (kind,)
    return [save(comparison_figure(comparison, k), path / f"{prefix}{k}.png") for k in kinds]


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure, making its folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=200)
    return path


def overview(comparisons: Sequence[Comparison]) -> Figure:
    """One row for each system: error against run time, energy error over time, volume error over time.

    Panels of metrics that were not asked for are left out.
    """
    kinds = [k for k in ("error", "energy", "volume") if any(k in _drawable(c) for c in comparisons)]
    if not kinds:
        raise ValueError("`comparisons` hold nothing to draw: ask compare() for 'error', 'energy' or 'volume'.")
    n, m = len(comparisons), len(kinds)
    figure = _figure(0.6 + 4.1 * m, 0.7 + 2.9 * n)
    axes = figure.subplots(n, m, squeeze=False)
    styles = _styles(comparisons)
    for row, comparison in zip(axes, comparisons, strict=True):
        for ax, kind in zip(row, kinds, strict=True):
            if kind in _drawable(comparison):
                _PANELS[kind](ax, comparison, styles)
            else:
                ax.set_axis_off()
        row[0].set_title(comparison.title, loc="left", fontsize=10, color=_TEXT, fontweight="bold")
    _legend(figure, comparisons)
    return figure


# panels ---------------------------------------------------------------------------------------------------


def _error_panel(ax: Axes, comparison: Comparison, styles: dict[str, tuple[str, str]]) -> None:
    """Error against run time: one point for each method."""
    shown = [r.row for r in comparison.runs if r.row.run_time and r.row.error is not None and np.isfinite(r.row.error)]
    for row in shown:
        colour, marker = styles[row.label]
        spread = None if row.run_time_spread is None else row.run_time_spread / 2
        error = max(row.error or 0.0, ROUNDING_FLOOR)
        ax.errorbar(row.run_time or 0.0, error, xerr=spread, color=colour, lw=1, capsize=0, zorder=2)
        ax.plot(row.run_time or 0.0, error, marker, color=colour, ms=8, mec="white", mew=0.8, zorder=3)
    ax.set_xscale("log")
    ax.set_yscale("log")
    if shown:
        _widen(ax.set_xlim, [row.run_time or 0.0 for row in shown])
        _widen(ax.set_ylim, [max(row.error or 0.0, ROUNDING_FLOOR) for row in shown])
    _annotate(ax, [(row.run_time or 0.0, max(row.error or 0.0, ROUNDING_FLOOR), row.label) for row in shown], styles)
    _dress(ax, "run time [s]", r"$\max_t\,\|y - y_{\mathrm{ref}}\|$")


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
    _dress(ax, "t", "|energy error|" + (", relative" if comparison.system.energy_scale is None else ", scaled"))


def _volume_panel(ax: Axes, comparison: Comparison, styles: dict[str, tuple[str, str]]) -> None:
    """|Σ log|det|| over time; shaded, what the rounding of the steps can amount to."""
    n_steps = 0
    for run, sol, series in _series(comparison, "volume"):
        n_steps = max(n_steps, int(sol.stats["n_steps"]))
        v = np.abs(series).reshape(-1, len(sol.t))
        worst = v[np.argmax(np.where(np.isfinite(v[:, -1]), v[:, -1], np.inf))]
        worst = np.where(np.isfinite(worst), np.maximum(worst, ROUNDING_FLOOR), np.nan)
        ax.plot(sol.t, worst, _dash(run), color=styles[run.row.label][0], lw=1.4)
    rounding = 4 * n_steps * np.finfo(float).eps
    ax.axhspan(ROUNDING_FLOOR / 10, rounding, color="#EEEEEE", zorder=0, lw=0)
    where = ax.get_yaxis_transform()
    ax.text(0.98, rounding / 2, "rounding", transform=where, ha="right", va="top", fontsize=8, color="#888888")
    ax.set_yscale("log")
    _limits(ax)
    _dress(ax, "t", "|log volume ratio|")


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


# phase space ----------------------------------------------------------------------------------------------


def portrait(comparison: Comparison) -> Figure:
    """Phase space, a panel for each method with the reference behind in grey.

    One degree of freedom: the orbit in the (q, p) plane. Two: the Poincaré section q₁ = 0, p₁ > 0, from a run with
    outputs every `system.dt`. More: q₁ against q₂.
    """
    system = comparison.system
    runs = [run for run in comparison.runs if run.sol is not None]
    rows = -(-len(runs) // 5)
    columns = -(-len(runs) // rows)
    figure = _figure(0.5 + 2.5 * columns, 0.5 + 2.7 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    styles = _styles([comparison])
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
        _dress(ax, x_label if k // columns == rows - 1 else "", y_label if k % columns == 0 else "")
    _frame(axes[0, 0], truth)
    section = " — section q₁ = 0, p₁ > 0" if system.ndof == 2 else ""
    figure.suptitle(f"{comparison.title}{section}; reference in grey", fontsize=10, color=_TEXT, x=0.01, ha="left")
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
    figure = _figure(0.5 + 3.4 * len(sections), 3.7)
    axes = figure.subplots(1, len(sections), sharex=True, sharey=True, squeeze=False)[0]
    for k, (ax, (title, sol)) in enumerate(zip(axes, sections, strict=True)):
        if sol.system.ndof != 2:
            raise ValueError(f"`sections` are of two degrees of freedom; {sol.system.name!r} has {sol.system.ndof}.")
        points = section_crossings(sol)[:, [1, 3]]
        ax.plot(*points.T, ".", color="#0072B2", ms=1.6, mew=0, rasterized=True)
        if energy is not None:
            _draw_boundary(ax, sol.system, energy, points)
        ax.set_title(title, fontsize=10, color=_TEXT)
        _dress(ax, "q₂", "p₂" if k == 0 else "")
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


# appearance -----------------------------------------------------------------------------------------------


def _figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "sympflow[plot]".') from error
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _drawable(comparison: Comparison) -> tuple[str, ...]:
    ran = any(run.sol is not None for run in comparison.runs)
    return (*(k for k in ("error", "energy", "volume") if k in comparison.metrics), *(("portrait",) if ran else ()))


def _styles(comparisons: Sequence[Comparison]) -> dict[str, tuple[str, str]]:
    """Colour and marker of every label."""
    styles: dict[str, tuple[str, str]] = {}
    taken: set[str] = set()
    others = 0
    for run in (run for c in comparisons for run in c.runs):
        label, method = run.row.label, run.row.method
        if label in styles:
            continue
        if method in _STYLES and method not in taken:
            styles[label] = _STYLES[method]
            taken.add(method)
        else:
            styles[label] = (_OTHER_COLOURS[others % 6], _OTHER_MARKERS[others // 6 % 6 if others >= 6 else others])
            others += 1
    return styles


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
        labelcolor=_TEXT,
    )


def _dress(ax: Axes, x_label: str, y_label: str) -> None:
    ax.set_xlabel(x_label, fontsize=9, color=_TEXT)
    ax.set_ylabel(y_label, fontsize=9, color=_TEXT)
    ax.tick_params(labelsize=8, colors=_TEXT, which="both", width=0.6)
    ax.grid(True, which="major", color="#E6E6E6", lw=0.6, zorder=0)
    ax.set_axisbelow(True)
    for side, spine in ax.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#999999")
        spine.set_linewidth(0.8)


def _limits(ax: Axes) -> None:
    """Log axis within what float64 errors can mean, and not squashed by a run that diverges."""
    values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.lines] or [np.ones(1)])
    values = values[np.isfinite(values) & (values > 0)]
    if values.size:
        low, high = max(values.min(), ROUNDING_FLOOR), min(values.max(), 1e4)
        ax.set_ylim(low / 3, max(high, 10 * low) * 3)


def _widen(set_limits: Any, values: Sequence[float]) -> None:
    """Limits of a log axis that leave a sixth of it on either side, for labels."""
    low, high = np.log10(min(values)), np.log10(max(values))
    margin = max(0.25 * (high - low), 0.4)
    set_limits(10 ** (low - margin), 10 ** (high + margin))


def _annotate(ax: Axes, points: Sequence[tuple[float, float, str]], styles: dict[str, tuple[str, str]]) -> None:
    """A label beside each point; where two points nearly coincide the second label goes below."""
    placed: list[np.ndarray] = []
    for x, y, label in sorted(points):
        at = ax.transAxes.inverted().transform(ax.transData.transform((x, y)))
        crowded = sum(bool((np.abs(at - p) < (0.25, 0.12)).all()) for p in placed)
        placed.append(at)
        ax.annotate(
            label,
            (x, y),
            xytext=(0, -15 if crowded % 2 else 9),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=styles[label][0],
        )
