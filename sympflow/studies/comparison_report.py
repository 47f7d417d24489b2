"""Comparison: what `compare` returns, and several of them as one table or file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.reference import Reference
from sympflow.studies.measurements import Row, Run
from sympflow.studies.tables import Column, number, plain, records, seconds, text_table, write_csv, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Comparison:
    """Methods side by side on one system.

    Attributes
    ----------
    system, t_span, y0
        The problem.
    t : ndarray (n,)
        The instants.
    metrics : tuple of str
    repeats : int
    match : str or None
    reference : Reference or None
        What the errors are against, if they were asked for.
    rows : tuple of Row
    runs : tuple
        Behind each row: its solution (`.sol`) and the energy and volume errors over time (`.energy`, `.volume`).
    """

    system: HamiltonianSystem
    t_span: tuple[float, float]
    y0: np.ndarray = field(repr=False)
    t: np.ndarray = field(repr=False)
    metrics: tuple[str, ...]
    repeats: int
    match: str | None
    reference: Reference | None
    runs: tuple[Run, ...] = field(repr=False)

    @property
    def rows(self) -> tuple[Row, ...]:
        return tuple(run.row for run in self.runs)

    @property
    def title(self) -> str:
        """The scene in a line."""
        return title(self.system)

    def table(self, width: int | None = None) -> str:
        """The rows as text, with what was done above and the reasons below.

        Where `width` characters do not hold them, the methods are columns.
        """
        return combined_table([self], width)

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows, every figure to full precision."""
        return write_csv(self.rows, path)

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows and the settings."""
        return write_json(self.to_dict(), path)

    def to_dict(self) -> dict[str, Any]:
        reference = self.reference
        return {
            "system": {"name": self.system.name, "params": self.system.params},
            "t_span": list(self.t_span),
            "y0": self.y0.tolist(),
            "n_outputs": len(self.t),
            "repeats": self.repeats,
            "match": self.match,
            "reference": None if reference is None else {"method": reference.method, "accuracy": reference.accuracy},
            "rows": records(self.rows),
        }

    def figure(self, kind: str = "overview") -> Figure:
        """A matplotlib figure: "overview", "energy", "volume", "error" (against run time) or "portrait"."""
        from sympflow.studies.comparison_figure import comparison_figure

        return comparison_figure(self, kind)

    def plot(self, path: str | os.PathLike[str] | None = None, kind: str = "overview", prefix: str = "") -> Figure:
        """The figure, by default the overview; with a path it is also saved.

        Parameters
        ----------
        path : path-like, optional
            A file (.png, .pdf or .svg); or a folder, in which the overview saves every kind to a file of its own.
        kind : str
            As for `figure`.
        prefix : str
            What the names of the files in a folder begin with; the kinds follow.
        """
        from sympflow.studies.comparison_figure import save_comparison

        figure = self.figure(kind)
        if path is not None:
            save_comparison(self, path, kind, prefix)
        return figure


def combined_table(comparisons: Sequence[Comparison], width: int | None = None) -> str:
    """The rows of several comparisons as one table, with the settings above and the reasons below.

    Where `width` characters do not hold it, there is a table for each system with the methods as columns.
    """
    rows = [row for c in comparisons for row in c.rows]
    several = len(comparisons) > 1
    names = [c.title for c in comparisons for _ in c.rows]
    first = [i == 0 for c in comparisons for i in range(len(c.rows))]
    columns = [
        Column("system", [n if f and several else "" for n, f in zip(names, first, strict=True)], left=True),
        *_columns(rows),
    ]
    notes = [
        f"  {f'{name}, ' if several else ''}{row.label}: {row.reason}"
        for name, row in zip(names, rows, strict=True)
        if row.reason
    ]
    below = ["", "Notes", *notes] if notes else []
    table = text_table(columns)
    if width is None or max(map(len, table.splitlines())) <= width:
        return "\n".join([*map(_settings, comparisons), "", table, *below])
    blocks = [line for c in comparisons for line in (_settings(c), "", _upright(_columns(c.rows)), "")]
    return "\n".join([*blocks[:-1], *below])


def _upright(columns: Sequence[Column]) -> str:
    """The table turned round: a line for each of its columns."""
    names, *others = [c for c in columns if any(c.cells)]
    titles = Column("", [c.title for c in others], left=True)
    cells = [Column(name, [c.cells[i] for c in others]) for i, name in enumerate(names.cells)]
    return text_table([titles, *cells])


def _columns(rows: Sequence[Row]) -> list[Column]:
    return [
        Column("method", [row.label for row in rows], left=True),
        Column("step", [_step(row) for row in rows]),
        Column("backend", [row.backend or "" for row in rows], left=True),
        Column("run time", [_run_time(row) for row in rows]),
        Column("forces", [f"{row.force_evaluations:,}" if row.force_evaluations else "" for row in rows]),
        Column("Hessians", [f"{row.hessian_evaluations:,}" if row.hessian_evaluations else "" for row in rows]),
        Column("error", [number(row.error) for row in rows]),
        Column("energy error", [number(row.energy_error) for row in rows]),
        Column("drift per unit t", [_with_error(row.energy_drift, row.energy_drift_error) for row in rows]),
        Column("volume error", [number(row.volume_error) for row in rows]),
        Column("sympl. defect", [number(row.symplecticity_defect) for row in rows]),
        Column("reversal", [number(row.time_reversal_error) for row in rows]),
        Column("training", [seconds(row.training_time) for row in rows]),
        Column("status", ["" if row.status == "ok" else row.status for row in rows], left=True),
    ]


_GREEK = {"omega": "ω", "mu": "μ", "epsilon": "ε", "alpha": "α", "beta": "β"}
_NAMES = {"henon_heiles": "Hénon–Heiles"}


def _settings(c: Comparison) -> str:
    batch = f", batch of {int(np.prod(c.y0.shape[:-1]))}" if c.y0.ndim > 1 else ""
    text = f"{c.title}: t = {c.t_span[0]:g} … {c.t_span[1]:g}{batch}, {len(c.t)} instants, median of {c.repeats} runs"
    if c.match:
        text += f", matched in {c.match.replace('_', ' ')}"
    if c.reference is not None:
        text += f"; reference: {c.reference.method}, good to {number(c.reference.accuracy)}"
    return text


def title(system: HamiltonianSystem) -> str:
    """The name and parameters of a system, as they are printed."""
    params = ", ".join(f"{_GREEK.get(k, k)} = {v:g}" for k, v in system.params.items())
    return _NAMES.get(system.name, system.name.replace("_", " ")) + (f", {params}" if params else "")


def _step(row: Row) -> str:
    return plain(row.dt) if row.dt is not None else f"rtol {row.tolerance:.0e}" if row.tolerance is not None else ""


def _run_time(row: Row) -> str:
    if not row.run_time or row.run_time_spread is None:
        return ""
    return f"{seconds(row.run_time)} ± {100 * row.run_time_spread / row.run_time:2.0f} %"


def _with_error(value: float | None, error: float | None) -> str:
    return "" if value is None else f"{number(value)} ± {number(error, 1)}"
