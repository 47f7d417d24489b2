"""Crossings of a plane: in steps on a grid those of all trajectories at once, else by events of each.

Also the states after whole periods, the crossings of a driven system with the planes t = t0 + k·T.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator, Problem
from sympflow.integrators.contract import FINISHED
from sympflow.integrators.diagnosis import try_steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.registry import naming_plugin
from sympflow.solver import solve


@dataclass(frozen=True)
class Plane:
    """y[coordinate] = level, crossed upwards (direction 1), downwards (−1) or either way (0) along the run."""

    coordinate: int
    level: float
    direction: int

    def height(self, y: np.ndarray) -> np.ndarray:
        """y[..., coordinate] − level: (..., 2d) to (...)."""
        return y[..., self.coordinate] - self.level


def bisected(
    low: np.ndarray, high: np.ndarray, before: Callable[[np.ndarray], np.ndarray], halvings: int = 54
) -> tuple[np.ndarray, np.ndarray]:
    """The ends (n,) of intervals that are halved so often; `before` is True where a place is before the point sought.

    By 54 halvings they are neighbours among floating-point numbers.
    """
    for _ in range(halvings):
        middle = (low + high) / 2
        kept = before(middle)
        low, high = np.where(kept, middle, low), np.where(kept, high, middle)
    return low, high


class Crossings(NamedTuple):
    """Crossings of N trajectories: which one (n,), t (n,), states (n, 2d); the status (N,) of the runs, and words."""

    trajectory: np.ndarray
    t: np.ndarray
    states: np.ndarray
    status: np.ndarray
    message: str


def crossings(
    integrator: Integrator,
    system: HamiltonianSystem,
    t_span: tuple[float, float],
    rows: np.ndarray,
    plane: Plane,
    sample: float,
) -> Crossings:
    """All crossings of the trajectories from `rows` (N, 2d), two of one within the time `sample` excepted."""
    if isinstance(integrator, FixedStep) and integrator.on_grid:
        try_steps(integrator, system, t_span, rows)
        with naming_plugin(integrator):
            return _Search(integrator, system, plane, sample).run(t_span, rows)
    return _by_events(integrator, system, t_span, rows, plane, sample)


def stroboscopic(
    integrator: Integrator, system: HamiltonianSystem, t_span: tuple[float, float], rows: np.ndarray, period: float
) -> Crossings:
    """The states (n, 2d) at t0 + k·T of the trajectories from `rows` (N, 2d), those at t0 among them.

    Fixed steps are shortened to T/m with a whole m, so that all these times are ends of steps; trained flows, which are
    other maps at other steps, and methods that choose theirs are asked for them as outputs.
    """
    t0, t1 = t_span
    n = whole_periods(t_span, period)
    turn = float(np.copysign(period, t1 - t0))
    y0 = rows[0] if len(rows) == 1 else rows
    if isinstance(integrator, FixedStep) and integrator.on_grid and not integrator.trained:
        integrator = replace(integrator, dt=dividing_step(period, integrator.step_length(system)))
    times = t0 + turn * np.arange(n + 1)
    sol = solve(system, integrator, (t0, times[-1]), y0, t_eval=times, on_domain_exit="ignore")
    states = np.moveaxis(sol.y, -1, -2).reshape(len(rows), len(sol.t), -1)
    trajectory, k = np.nonzero(np.isfinite(states).all(-1))
    whole = np.rint((sol.t - t0) / turn)
    at_period = np.abs(sol.t - t0 - whole * turn) <= 1e-9 * period  # a run that fails ends where it can
    kept = at_period[k]
    trajectory, k = trajectory[kept], k[kept]
    status = np.broadcast_to(np.asarray(sol.status), len(rows))
    return Crossings(trajectory, sol.t[k], states[trajectory, k], status, sol.message)


def whole_periods(t_span: tuple[float, float], period: float) -> int:
    """Number of periods that an interval holds; one of them short by no more than rounding is whole."""
    return int(np.floor(abs(t_span[1] - t_span[0]) / period * (1 + 1e-12)))


def dividing_step(period: float, longest: float) -> float:
    """T/m, with the least whole number m for which it is no longer than a step, but for rounding."""
    return period / max(1, int(np.ceil(period / longest * (1 - 1e-12))))


def _by_events(
    integrator: Integrator,
    system: HamiltonianSystem,
    t_span: tuple[float, float],
    rows: np.ndarray,
    plane: Plane,
    sample: float,
) -> Crossings:
    """The crossings of trajectories that take steps of their own: events of each."""

    def g(t: float, y: np.ndarray) -> float:
        return float(plane.height(y))

    g.direction = plane.direction  # type: ignore[attr-defined]
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
    return Crossings(trajectory, np.concatenate(times), np.concatenate(states), status, message)


class _Search:
    """Finds the crossings in the steps of a run, those of all trajectories at once, as they stream by."""

    def __init__(self, integrator: FixedStep, system: HamiltonianSystem, plane: Plane, sample: float) -> None:
        self.integrator, self.system, self.plane, self.sample = integrator, system, plane, sample
        self.found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.at_start = True

    def run(self, t_span: tuple[float, float], rows: np.ndarray) -> Crossings:
        """Search all steps from `rows` (N, 2d)."""
        grid = Grid(*t_span, self.integrator.step_length(self.system))
        self.stepper = self.integrator.stepper(Problem(self.system, *t_span, rows))
        y_end, to_go = rows, grid.t1 - grid.t0
        held: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        for chunk in self.integrator.steps(self.system, t_span, rows):
            if held:
                self.search(*held, np.concatenate([held[1][1:], chunk[1][:1]]))
            held = chunk
        if held:
            t, y, h = held
            y_end = self._end(grid, t, y, h)
            self.search(t, y, h, np.concatenate([y[1:], y_end[None]]))
            to_go = grid.t1 - float(t[-1] + h[-1])
        reached = abs(to_go) < abs(grid.h) / 2 and bool(np.isfinite(y_end).all())
        status, message = np.zeros(len(rows), dtype=int), FINISHED
        if not reached:  # as `solve` says of the run that could not go on
            y0, end = rows[0] if len(rows) == 1 else rows, [t_span[1]]
            sol = solve(self.system, self.integrator, t_span, y0, t_eval=end, on_domain_exit="ignore")
            status, message = np.broadcast_to(np.asarray(sol.status), len(rows)), sol.message
        return Crossings(*self._located(rows.shape[-1], grid.h), status, message)

    def _end(self, grid: Grid, t: np.ndarray, y: np.ndarray, h: np.ndarray) -> np.ndarray:
        """The end (N, 2d) of the last chunk of steps, run again: a single step would differ from it in rounding."""
        n, step = len(y), float(h[-1])
        with np.errstate(all="ignore"):
            stepper = self.integrator.stepper(Problem(self.system, float(t[0]), float(t[-1]) + step, y[0]))
            states, _ = stepper.rollout(y[0], step, n, np.arange(n + 1), float(t[0]))
            end = states[-1] if step == grid.h else stepper.shorter(y[0], step, float(t[0]))
        return np.asarray(end)

    def search(self, t: np.ndarray, y: np.ndarray, h: np.ndarray, y_end: np.ndarray) -> None:
        """Steps (n,) of N trajectories: times (n,), states at their beginnings and ends (n, N, 2d), lengths."""
        h, t = (np.broadcast_to(a.reshape(len(y), -1), y.shape[:-1]) for a in (h, t))
        parts = max(1, int(np.ceil(np.abs(h).max() / self.sample * (1 - 1e-12))))
        before = self.plane.height(y)
        starts = np.zeros(before.shape, dtype=bool)
        starts[:1] = self.at_start & (before[:1] == 0)  # a zero at the end of a step was counted in that step
        self.at_start = False
        for part in range(parts):
            with np.errstate(all="ignore"):
                # the end of a step must be the beginning of the next to the last bit, or a zero there is lost
                y_part = y_end if part == parts - 1 else self._step(t, y, h * ((part + 1) / parts))
                after = self.plane.height(y_part)
                up, down = ((before < 0) | starts) & (after >= 0), ((before > 0) | starts) & (after <= 0)
            starts = np.zeros_like(starts)
            crossed = {1: up, -1: down, 0: up | down}[self.plane.direction] & (h != 0)
            if crossed.any():
                self._locate(t, y, h, crossed, part / parts, (part + 1) / parts, before)
            before = after

    def _locate(
        self, t: np.ndarray, y: np.ndarray, h: np.ndarray, crossed: np.ndarray, a: float, b: float, before: np.ndarray
    ) -> None:
        """Bisect all crossings together, in the fraction of the step."""
        y, t, h, sign = y[crossed], t[crossed], h[crossed], np.sign(before[crossed])
        low, high = np.full(len(y), a), np.where(sign == 0, a, b)
        _, high = bisected(low, high, lambda middle: self.plane.height(self._step(t, y, h * middle)) * sign > 0)
        self.found.append((np.nonzero(crossed)[1], t + h * high, self._step(t, y, h * high)))

    def _step(self, t: np.ndarray, y: np.ndarray, h: np.ndarray) -> np.ndarray:
        return np.asarray(self.stepper.shorter(y, h, t))

    def _located(self, width: int, direction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The crossings that were found, by trajectory and along the run."""
        if not self.found:
            return np.empty(0, dtype=int), np.empty(0), np.empty((0, width))
        trajectory, t, states = (np.concatenate(parts) for parts in zip(*self.found, strict=True))
        order = np.lexsort((t * np.sign(direction), trajectory))
        return trajectory[order], t[order], states[order]
