"""WorkPrecision: what `work_precision` returns; its tables, files and figure."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.reference import Reference
from sympflow.studies.comparison_report import title
from sympflow.studies.precision_points import Point, cost_at
from sympflow.studies.tables import Column, number, plain, records, seconds, text_table, write_csv, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = (1e-3, 1e-6, 1e-9)


@dataclass(frozen=True)
class WorkPrecision:
    """Error against cost on one system.

    Attributes
    ----------
    system, t_span, n_outputs, repeats
        What was run.
    references : tuple of (Reference or None)
        For one trajectory, and for the batch if there is one.
    rows : tuple of Point
    """

    system: HamiltonianSystem
    t_span: tuple[float, float]
    n_outputs: int
    repeats: int
    references: tuple[Reference | None, ...]
    rows: tuple[Point, ...]

    @property
    def title(self) -> str:
        """The scene in a line."""
        return title(self.system)

    @property
    def sizes(self) -> list[int]:
        """Numbers of trajectories: 1, and the size of the batch."""
        return sorted({row.trajectories for row in self.rows})

    def table(self, levels: tuple[float, ...] = LEVELS) -> str:
        """Evaluations and run time of each method for each level of the energy error; then every point."""
        heading = [f"{self.title}: t = {self.t_span[0]:g} … {self.t_span[1]:g}, {self.n_outputs} instants"]
        for size, reference in zip(self.sizes, self.references, strict=True):
            known = "none" if reference is None else f"{reference.method}, good to {number(reference.accuracy)}"
            heading.append(f"reference for {_size(size)}: {known}")
        blocks = [
            f"For an energy error of …, {_size(size)} (run time of all, evaluations of one)\n\n{self._at(size, levels)}"
            for size in self.sizes
        ]
        notes = dict.fromkeys(f"  {row.label}: {row.reason}" for row in self.rows if row.reason)
        below = ["\n".join(["Notes", *notes])] if notes else []
        return "\n\n".join(["\n".join(heading), *blocks, "Every point\n\n" + self._points(), *below])

    def _at(self, size: int, levels: tuple[float, ...]) -> str:
        rows = [row for row in self.rows if row.trajectories == size]
        labels = list(dict.fromkeys(row.label for row in rows))
        columns = [Column("method", labels, left=True)]
        for level in levels:
            for cost, show in (("force_evaluations", _count), ("run_time", seconds)):
                found = [cost_at([r for r in rows if r.label == label], level, cost) for label in labels]
                head = f"{level:.0e}" if cost == "run_time" else "forces"
                columns.append(Column(head, [show(x) if math.isfinite(x) else "–" for x in found]))
        trained = {row.label: row for row in rows if row.training_time is not None}
        columns.append(Column("training", [seconds(trained[n].training_time) if n in trained else "" for n in labels]))
        paid = [_paid(trained[n].break_even) if n in trained else "" for n in labels]
        columns.append(Column("paid after t =", paid))
        return text_table(columns)

    def _points(self) -> str:
        rows = self.rows
        return text_table(
            [
                Column("method", [r.label for r in rows], left=True),
                Column("batch", [f"{r.trajectories:,}" for r in rows]),
                Column("step", [plain(r.dt) for r in rows]),
                Column("rtol", ["" if r.tolerance is None else f"{r.tolerance:.0e}" for r in rows]),
                Column("backend", [r.backend or "" for r in rows], left=True),
                Column("run time", [seconds(r.run_time) for r in rows]),
                Column("±", [seconds(r.run_time_spread) for r in rows]),
                Column("forces", [_count(r.force_evaluations) for r in rows]),
                Column("Hessians", [_count(r.hessian_evaluations or None) for r in rows]),
                Column("error", [number(r.error) for r in rows]),
                Column("energy error", [number(r.energy_error) for r in rows]),
                Column("status", ["" if r.status == "ok" else r.status for r in rows], left=True),
            ]
        )

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write every point, every figure to full precision."""
        return write_csv(self.rows, path)

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """Write the points and the settings."""
        return write_json(self.to_dict(), path)

    def to_dict(self) -> dict[str, Any]:
        return {
            "system": {"name": self.system.name, "params": self.system.params},
            "t_span": list(self.t_span),
            "n_outputs": self.n_outputs,
            "repeats": self.repeats,
            "references": [
                None if r is None else {"method": r.method, "accuracy": r.accuracy} for r in self.references
            ],
            "rows": records(self.rows),
        }

    def figure(self, measure: str = "energy_error") -> Figure:
        """Error against run time and against evaluations, log–log; a row for one trajectory and one for the batch.

        Parameters
        ----------
        measure : "energy_error" or "error"
        """
        from sympflow.studies.precision_figure import precision_figure

        return precision_figure(self, measure)

    def plot(self, path: str | os.PathLike[str] | None = None, measure: str = "energy_error") -> Figure:
        """The figure, as `figure`; with a path it is also saved."""
        from sympflow.studies.figure_style import save

        figure = self.figure(measure)
        if path is not None:
            save(figure, path)
        return figure


def _size(n: int) -> str:
    return "one trajectory" if n == 1 else f"a batch of {n:,}"


def _count(x: float | None) -> str:
    return "" if not x else f"{x:,.0f}"


def _paid(x: float | None) -> str:
    return "" if x is None else "never" if x == math.inf else f"{x:.2g}"
