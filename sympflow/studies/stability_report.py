"""What `stability` returns: rows, limits, tables, files and figures."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.studies.tables import Column, number, plain, text_table, write_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class StabilityRow:
    """One method with one step on one system; None where something was not asked for or does not apply.

    Attributes
    ----------
    system : str
    parameter, value : str, float
        The system's first parameter, such as its stiffness.
    method, label, dtype : str
    dt : float or None
        The step; None for an adaptive method.
    t_end : float
        End of the run.
    status : str
        "stable"; "bounded", as stable, but the energy error exceeds 1: the result says nothing; "outside", if a run of
        a trained flow left the domain that the flow was trained on, where it says nothing either; "unstable", if a run
        became non-finite, could not go on, or its energy error exceeded the bound; "not applicable", if the method
        cannot run, or not with this step.
    reason : str
        Why, in words.
    n_steps : int
    energy_error : float
        The largest over all initial states and outputs, relative as in `sympflow.energy_error`; inf if a run failed.
    energy_drift, energy_drift_error : float
        Slope of the energy error per unit of time, and its standard error by batch means; the median over the states.
    blow_up : float
        When a run failed: the time of the singularity if the solution has one, else of its last finite state.
    singular : bool
        Whether it is a singularity of the solution, rather than an instability of the method.
    domain_exit : float
        When the first trajectory left the domain Ω of the flow, or of the system.
    volume_error, symplecticity_defect : float
        |Σ log|det|| and max ‖AᵀJA − J‖/‖A‖² over the first 256 steps.
    """

    system: str
    parameter: str | None
    value: float | None
    method: str
    label: str
    dtype: str
    dt: float | None
    t_end: float
    status: str = ""
    reason: str = ""
    n_steps: int | None = None
    energy_error: float | None = None
    energy_drift: float | None = None
    energy_drift_error: float | None = None
    blow_up: float | None = None
    singular: bool | None = None
    domain_exit: float | None = None
    volume_error: float | None = None
    symplecticity_defect: float | None = None


@dataclass(frozen=True)
class StepLimit:
    """The longest stable step of one method on one system.

    Attributes
    ----------
    system, parameter, value, method, label, dtype
        As in `StabilityRow`.
    stable : float or None
        The longest step that was found stable or bounded, all shorter ones that were tried being so; None if there is
        none.
    unstable : float or None
        The next longer one that was tried, which is not; None if all were stable.
    energy_error : float
        The largest energy error with `stable`.
    reached : str
        What else is to be said: that all steps are stable, up to the flow's Δt or the length of the interval; or that
        the solution itself is singular, or leaves the flow's domain, so that none is.
    """

    system: str
    parameter: str | None
    value: float | None
    method: str
    label: str
    dtype: str
    stable: float | None
    unstable: float | None
    energy_error: float | None = None
    reached: str = ""


@dataclass(frozen=True)
class StabilityReport:
    """Methods and steps on a system or a family of them.

    Attributes
    ----------
    systems : tuple of HamiltonianSystem
    metrics : tuple of str
    bound : float
        The energy error above which a run counts as unstable.
    rows : tuple of StabilityRow
    limits : tuple of StepLimit
    """

    systems: tuple[HamiltonianSystem, ...] = field(repr=False)
    metrics: tuple[str, ...]
    bound: float
    rows: tuple[StabilityRow, ...] = field(repr=False)
    limits: tuple[StepLimit, ...]

    def table(self) -> str:
        """The longest stable steps, and all rows, as text; the reasons below."""
        notes = [
            f"  {row.system}, {row.label}{'' if row.dt is None else f', dt = {plain(row.dt)}'}: {row.reason}"
            for row in self.rows
            if row.reason
        ]
        parts = [text_table(self._limit_columns()), *self.without_limit(), ""] if self.limits else []
        below = ["", "Notes", *dict.fromkeys(notes)] if notes else []
        return "\n".join([*parts, text_table(self._columns()), *below])

    def without_limit(self) -> list[str]:
        """For each method whose longest stable step is not found on some systems, where that is and why: sentences."""
        found = {(x.system, x.label, x.dtype): x for x in self.limits}
        why: dict[tuple[str, str], list[str]] = {}
        for row in self.rows:
            limit = found.get((row.system, row.label, row.dtype))
            if limit is not None and limit.stable is not None and limit.unstable is not None:
                continue
            if limit is not None:
                reason = f"{'stable: ' * (limit.stable is not None)}{limit.reached}" or "none of the steps is stable"
            else:
                reason = "an adaptive method" if row.dt is None else f"{row.status}: see the notes"
            systems = why.setdefault((row.label, reason), [])
            if row.system not in systems:
                systems.append(row.system)
        several = len(self.systems) > 1
        return [
            f"No limit of {label}{f' on {_listed(systems)}' if several else ''}: {reason}."
            for (label, reason), systems in why.items()
        ]

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the rows, every figure to full precision."""
        return write_csv(self.rows, path)

    def figure(self, kind: str | None = None) -> Figure:
        """A matplotlib figure: "steps", the energy error against the step; or "map", step against stiffness.

        The default is the map for a family, else the steps.
        """
        from sympflow.studies.stability_figure import stability_figure

        return stability_figure(self, kind)

    def plot(self, path: str | os.PathLike[str] | None = None, kind: str | None = None) -> Figure:
        """The figure, as `figure`; with a path it is also saved."""
        figure = self.figure(kind)
        if path is not None:
            from sympflow.studies.figure_style import save

            save(figure, path)
        return figure

    def _limit_columns(self) -> list[Column]:
        return [
            *self._names(self.limits),
            Column("longest stable step", ["none" if x.stable is None else f"{x.stable:.5g}" for x in self.limits]),
            Column("energy error there", [number(x.energy_error) for x in self.limits]),
            Column("stable", [x.reached for x in self.limits], left=True),
        ]

    def _columns(self) -> list[Column]:
        rows = self.rows
        drifts = [
            "" if r.energy_drift is None else f"{number(r.energy_drift)} ± {number(r.energy_drift_error, 1)}"
            for r in rows
        ]
        ends = ["" if r.blow_up is None else f"{r.blow_up:.6g}{' (singular)' if r.singular else ''}" for r in rows]
        return [
            *self._names(rows),
            Column("step", [plain(r.dt) for r in rows]),
            Column("steps", [f"{r.n_steps:,}" if r.n_steps else "" for r in rows]),
            Column("energy error", [number(r.energy_error) for r in rows]),
            Column("drift per unit t", drifts),
            Column("blow-up at t", ends),
            Column("leaves domain at t", [plain(r.domain_exit) for r in rows]),
            Column("volume error", [number(r.volume_error) for r in rows]),
            Column("sympl. defect", [number(r.symplecticity_defect) for r in rows]),
            Column("status", [r.status for r in rows], left=True),
        ]

    def _names(self, rows: tuple[StabilityRow, ...] | tuple[StepLimit, ...]) -> list[Column]:
        several = len(self.systems) > 1
        precisions = {r.dtype for r in rows}
        return [
            Column("system", [r.system if several else "" for r in rows], left=True),
            Column("method", [r.label for r in rows], left=True),
            Column("dtype", [r.dtype if len(precisions) > 1 else "" for r in rows], left=True),
        ]


def _listed(systems: list[str]) -> str:
    """Names that begin alike, as of a family, once: "oscillator, ω = 1, 100"."""
    first, _, _ = systems[0].rpartition(" = ")
    if first and all(name.startswith(f"{first} = ") for name in systems):
        return f"{first} = {', '.join(name.removeprefix(f'{first} = ') for name in systems)}"
    return "; ".join(systems)
