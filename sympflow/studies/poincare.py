"""poincare_section(): where trajectories cross a plane of phase space, located on the method's own map."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, make_dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import is_tensor
from sympflow.integrators.base import FINISHED, FixedStep, Integrator, Problem
from sympflow.integrators.grid import Grid
from sympflow.integrators.registry import build
from sympflow.solver import solve
from sympflow.studies.tables import Column, text_table, write_csv
from sympflow.system import HamiltonianSystem
from sympflow.validation import check_t_span, check_y0

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Located = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Crossings: trajectory (n,), t (n,), states (n, 2d)."""


def poincare_section(
    system: HamiltonianSystem,
    method: Any = "sympflow",
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    coordinate: int | str = 0,
    level: float = 0.0,
    direction: int = 1,
    sample: float | None = None,
    **options: Any,
) -> PoincareSection:
    """The states in which trajectories cross the plane y[coordinate] = level.

    Each crossing is located to rounding on the dense output of the method, as an event is: of fixed steps that is a
    shorter step. The run streams: only the crossings are stored.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator or trained flow
    t_span : (float, float), optional
        The default is the system's.
    y0 : array_like of shape (..., 2d), optional
        One state, or a batch of them. With fixed steps the trajectories advance together. The default is the system's.
    coordinate : int or str
        Index into [q, p], or a name such as "q1" or "p2".
    level : float
    direction : 1, -1 or 0
        Only crossings upwards, only downwards, or both, along the run as for events: in a run backward in time the
        coordinate decreases with t where it is crossed upwards. A start on the plane counts, as it does for events.
    sample : float, optional
        Longest time between two samples; two crossings within it are missed. The default is `system.dt`, or the
        method's step where that is shorter.
    **options
        Options of the method.

    Returns
    -------
    PoincareSection
        With `.rows`, `.table()`, `.plot()` and `.to_csv()`.

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> section = poincare_section(system, "kahan_li8", (0, 100))
    >>> section.states.shape[1]
    4
    """
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    integrator = build(method, options)
    integrator.check(system)
    span = check_t_span(system.t_span if t_span is None else t_span)
    if is_tensor(y0):
        raise TypeError("`y0` is a tensor, but crossings are located on NumPy arrays: pass y0.numpy().")
    start = check_y0(system, system.y0 if y0 is None else y0, None)
    index = _check_coordinate(coordinate, system.ndof)
    if direction not in (-1, 0, 1):
        raise ValueError(f"`direction` must be 1 (upwards), -1 (downwards) or 0 (both); got {direction!r}.")
    if not (_is_number(level) and math.isfinite(level)):
        raise ValueError(f"`level` must be a finite number, the value of the coordinate on the plane; got {level!r}.")
    sample = system.dt if sample is None else sample
    if not (_is_number(sample) and sample > 0):
        raise ValueError(f"`sample` must be a positive number, a time; got {sample!r}.")
    rows = start.reshape(-1, start.shape[-1])
    if isinstance(integrator, FixedStep) and integrator.on_grid:
        found = _Crossings(integrator, system, index, float(level), direction, float(sample))
        status, message = found.run(span, rows)
        crossings = found.result(system.ndof, np.sign(span[1] - span[0]))
    else:
        crossings, status, message = _events(integrator, system, span, rows, index, float(level), direction, sample)
    ended = int(status[0]) if start.ndim == 1 else status
    return PoincareSection(
        system, integrator, span, rows, index, float(level), direction, *crossings, status=ended, message=message
    )


@dataclass(frozen=True)
class PoincareSection:
    """The crossings of a plane, those of each trajectory together and in order of time.

    Attributes
    ----------
    system, integrator, t_span
        What was run.
    y0 : ndarray (N, 2d)
        The initial states.
    coordinate, level, direction
        The plane.
    trajectory : ndarray (n,)
        Which of the initial states each crossing belongs to.
    t : ndarray (n,)
    states : ndarray (n, 2d)
    status : int, or ndarray (N,) of a batch
        As of a `Solution`: 0 where the end was reached, −1 where the run failed. Crossings shortly before a failure may
        be those of a solution that is exploding already.
    message : str
        In words, with the time and the remedy.
    """

    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    y0: np.ndarray = field(repr=False)
    coordinate: int
    level: float
    direction: int
    trajectory: np.ndarray = field(repr=False)
    t: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)
    status: int | np.ndarray
    message: str

    @property
    def success(self) -> bool:
        """Whether every trajectory reached the end."""
        return bool(np.all(np.asarray(self.status) >= 0))

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def rows(self) -> tuple[Any, ...]:
        """One for each crossing: trajectory, t, and the coordinates q1 … pd."""
        d = self.system.ndof
        columns = [("trajectory", int), ("t", float), *((name, float) for name in names(d))]
        Crossing = make_dataclass("Crossing", columns, frozen=True)
        return tuple(
            Crossing(int(k), float(t), *map(float, y))
            for k, t, y in zip(self.trajectory, self.t, self.states, strict=True)
        )

    def table(self, limit: int = 20) -> str:
        """The first `limit` crossings as text, and the message if a trajectory failed."""
        shown = range(min(limit, len(self)))
        columns = [
            Column("trajectory", [str(self.trajectory[i]) for i in shown]),
            Column("t", [f"{self.t[i]:.6f}" for i in shown]),
            *(
                Column(name, [f"{self.states[i, j]:.6f}" for i in shown])
                for j, name in enumerate(names(self.system.ndof))
                if j != self.coordinate
            ),
        ]
        more = f"\n… {len(self) - limit} more" if len(self) > limit else ""
        failure = "" if self.success else f"\n{self.message}"
        return (text_table(columns) + more if len(self) else "no crossing") + failure

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write all crossings to a CSV file, numbers to full precision."""
        if not len(self):
            raise ValueError("`section` has no crossing to write: run it longer, or move `level`.")
        return write_csv(self.rows, path)

    def plot(self, x: int | str | None = None, y: int | str | None = None) -> Figure:
        """The crossings in the plane of two coordinates, each trajectory in a shade of its own.

        Parameters
        ----------
        x, y : int or str, optional
            The coordinates; the default is the first other position, or p if there is none, and its momentum.

        Raises
        ------
        ImportError
            Without matplotlib.
        """
        from sympflow.studies.figure_style import TEXT, dress, new_figure

        d, label = self.system.ndof, names(self.system.ndof)
        position = next((j for j in range(d) if j != self.coordinate), d)
        i = position if x is None else _check_coordinate(x, d)
        j = (position + d if position < d else 0) if y is None else _check_coordinate(y, d)
        figure = new_figure(4.6, 4.4)
        ax = figure.add_subplot()
        ax.scatter(
            self.states[:, i],
            self.states[:, j],
            c=self.trajectory,
            cmap="viridis",
            s=3.0,
            linewidths=0,
            vmax=max(1.15 * (len(self.y0) - 1), 1),
            rasterized=True,
        )
        way = {1: f", {label[self.coordinate]} increasing", -1: f", {label[self.coordinate]} decreasing", 0: ""}
        in_time = self.direction if self.t_span[1] >= self.t_span[0] else -self.direction
        plane = f"{label[self.coordinate]} = {self.level:g}{way[in_time]}"
        ax.set_title(f"{self.system.name.replace('_', ' ')}, {self.integrator.name}: {plane}", fontsize=9, color=TEXT)
        dress(ax, label[i], label[j])
        return figure


def _events(
    integrator: Integrator,
    system: HamiltonianSystem,
    t_span: tuple[float, float],
    rows: np.ndarray,
    coordinate: int,
    level: float,
    direction: int,
    sample: float,
) -> tuple[Located, np.ndarray, str]:
    """The crossings of trajectories that take steps of their own, events of each; their status and message."""

    def g(t: float, y: np.ndarray) -> float:
        return float(y[coordinate] - level)

    g.direction = direction  # type: ignore[attr-defined]
    runs = [
        solve(system, integrator, t_span, y, t_eval=[], events=g, event_step=sample, on_domain_exit="ignore")
        for y in rows
    ]
    times, states = zip(*((run.t_events[0], run.y_events[0]) for run in runs), strict=True)  # type: ignore[index]
    trajectory = np.repeat(np.arange(len(rows)), [len(t) for t in times])
    status = np.array([run.status for run in runs], dtype=int)
    failed = np.flatnonzero(status < 0)
    message = runs[failed[0] if failed.size else 0].message
    if failed.size and len(runs) > 1:
        message = f"{len(failed)} of {len(runs)} trajectories failed, the first of them (index {failed[0]}): {message}"
    return (trajectory, np.concatenate(times), np.concatenate(states)), status, message


class _Crossings:
    """Finds the crossings in the steps of a run, those of all trajectories at once, as they stream by."""

    def __init__(
        self,
        integrator: FixedStep,
        system: HamiltonianSystem,
        coordinate: int,
        level: float,
        direction: int,
        sample: float,
    ) -> None:
        self.integrator, self.system = integrator, system
        self.coordinate, self.level, self.direction, self.sample = coordinate, level, direction, sample
        self.found: list[Located] = []
        self.at_start = True

    def run(self, t_span: tuple[float, float], rows: np.ndarray) -> tuple[np.ndarray, str]:
        """Search all steps from `rows` (N, 2d): the status (N,) of the trajectories, and the message."""
        grid = Grid(*t_span, self.integrator.step_length(self.system))
        y_end, n_searched = rows, 0
        finite = np.zeros(len(rows), dtype=int)  # the steps of each trajectory that began at a finite state
        held: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        for chunk in self.integrator.steps(self.system, t_span, rows):
            if held:
                self.search(*held, np.concatenate([held[1][1:], chunk[1][:1]]))
            held = chunk
            finite += np.isfinite(chunk[1]).all(-1).sum(0)
            n_searched += len(chunk[1])
        if held:
            t, y, h = held
            y_end = self._end(grid, t, y, h)
            self.search(t, y, h, np.concatenate([y[1:], y_end[None]]))
        reached = np.isfinite(y_end).all(-1) & (n_searched == grid.n_steps + bool(grid.remainder))
        status = np.where(reached, 0, -1)
        failed = np.flatnonzero(status)
        if not failed.size:
            return status, FINISHED
        what, remedy = self.integrator.breakdown
        first = int(failed[0])
        # the last finite state is that at the beginning of the step that failed, or the end of a run cut short
        last = int(finite[first]) - (0 if np.isfinite(y_end[first]).all() else 1)
        whole = f"after t = {grid.time(last):.17g} (step {last + 1} of {grid.n_steps + bool(grid.remainder)})"
        if len(rows) == 1:
            return status, f"{what} {whole}. {remedy}, or end `t_span` earlier."
        which = f"{len(failed)} of {len(rows)} trajectories failed, the first of them (index {first})"
        return status, f"{which} {whole}. {what}. {remedy}."

    def _end(self, grid: Grid, t: np.ndarray, y: np.ndarray, h: np.ndarray) -> np.ndarray:
        """The end (N, 2d) of the last chunk of steps, run again: a single step would differ from it in rounding."""
        n, step = len(y), float(h[-1])
        with np.errstate(all="ignore"):
            piece = Problem(self.system, float(t[0]), float(t[-1]) + step, y[0])
            states, _, backend = self.integrator.rollout(piece, step, n, np.arange(n + 1))
            end = states[-1] if step == grid.h else self.integrator.substep(self.system, y[0], step, backend)
        return np.asarray(end)

    def search(self, t: np.ndarray, y: np.ndarray, h: np.ndarray, y_end: np.ndarray) -> None:
        """Steps (n,) of N trajectories: times (n,), states at their beginnings and ends (n, N, 2d), lengths."""
        h, t = (np.broadcast_to(a.reshape(len(y), -1), y.shape[:-1]) for a in (h, t))
        parts = max(1, int(np.ceil(np.abs(h).max() / self.sample * (1 - 1e-12))))
        before = y[..., self.coordinate] - self.level
        starts = np.zeros(before.shape, dtype=bool)
        starts[:1] = self.at_start & (before[:1] == 0)  # a zero at the end of a step was counted in that step
        self.at_start = False
        for part in range(parts):
            with np.errstate(all="ignore"):
                # the end of a step must be the beginning of the next to the last bit, or a zero there is lost
                y_part = y_end if part == parts - 1 else self._step(y, h * ((part + 1) / parts))
                after = y_part[..., self.coordinate] - self.level
                up, down = ((before < 0) | starts) & (after >= 0), ((before > 0) | starts) & (after <= 0)
            starts = np.zeros_like(starts)
            crossed = {1: up, -1: down, 0: up | down}[self.direction] & (h != 0)
            if crossed.any():
                self._locate(t, y, h, crossed, part / parts, (part + 1) / parts, before)
            before = after

    def _locate(
        self, t: np.ndarray, y: np.ndarray, h: np.ndarray, crossed: np.ndarray, a: float, b: float, before: np.ndarray
    ) -> None:
        """Bisect all crossings together, in the fraction of the step."""
        y, t, h, sign = y[crossed], t[crossed], h[crossed], np.sign(before[crossed])
        low, high = np.full(len(y), a), np.where(sign == 0, a, b)
        for _ in range(54):
            middle = (low + high) / 2
            g = self._step(y, h * middle)[:, self.coordinate] - self.level
            low, high = np.where(g * sign > 0, middle, low), np.where(g * sign > 0, high, middle)
        self.found.append((np.nonzero(crossed)[1], t + h * high, self._step(y, h * high)))

    def _step(self, y: np.ndarray, h: np.ndarray) -> np.ndarray:
        return self.integrator.step(self.system, 0.0, y, h)

    def result(self, ndof: int, direction: float) -> Located:
        if not self.found:
            return np.empty(0, dtype=int), np.empty(0), np.empty((0, 2 * ndof))
        trajectory, t, states = (np.concatenate(parts) for parts in zip(*self.found, strict=True))
        order = np.lexsort((t * direction, trajectory))
        return trajectory[order], t[order], states[order]


def names(ndof: int) -> list[str]:
    """q, p for one degree of freedom; q1 … qd, p1 … pd for more."""
    return [f"{x}{i + 1}" if ndof > 1 else x for x in "qp" for i in range(ndof)]


def _is_number(x: object) -> bool:
    return isinstance(x, int | float | np.number) and not isinstance(x, bool)


def _check_coordinate(coordinate: int | str, ndof: int) -> int:
    known = names(ndof)
    if isinstance(coordinate, str) and coordinate in known:
        return known.index(coordinate)
    if isinstance(coordinate, int | np.integer) and not isinstance(coordinate, bool) and 0 <= coordinate < 2 * ndof:
        return int(coordinate)
    raise ValueError(f"`coordinate` must be one of {', '.join(known)}, or an index into them; got {coordinate!r}.")
