"""Runs of a system with impulses: between them by any method, and at them by kicks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sympflow.arrays import Array, concatenate, join
from sympflow.integrators.contract import Integrator, Interrupted, Outcome, Problem, finished, interrupted
from sympflow.integrators.grid import EPS, warn_of_jumps

Run = Callable[[Integrator, Problem], tuple[Outcome, Problem]]


def run_between_impulses(run: Run, integrator: Integrator, problem: Problem) -> tuple[Outcome, Problem]:
    """The outcome of a problem of a system with impulses, by runs from each to the next, and the problem."""
    t0, t1, times, search = problem.t0, problem.t1, problem.t_eval, problem.events
    low, high = min(t0, t1), max(t0, t1)
    near = 8 * EPS * max(abs(low), abs(high))
    kicks = [
        kick for kick in problem.system.kicks(low - 2 * near, high + 2 * near) if low + near < kick.t <= high + near
    ]
    sign, stages = (1, kicks) if t1 >= t0 else (-1, kicks[::-1])
    piece = replace(problem, system=problem.system.between_impulses, progress=None, diagnosed=False)
    ends = [*(min(kick.t, high) for kick in stages), t1]
    found: list[Outcome] = []
    warned, stopped, start, done = False, None, t0, 0
    for i, end in enumerate(ends):
        last = i == len(ends) - 1
        piece = replace(piece, t0=start, t1=end)
        if times is not None:
            beyond = (times[done:] - end) * sign > (near if sign < 0 else -near)
            due = len(times) if last else done + (int(beyond.argmax()) if beyond.any() else len(beyond))
            asked = np.clip(times[done:due], min(start, end), max(start, end))
            piece = replace(piece, t_eval=asked if len(asked) and asked[-1] == end else np.append(asked, end))
        if not (warned or piece.system.autonomous):
            dt, at_ends = integrator.step_length(piece.system), integrator.forces_at_ends(piece.system)
            warned = warn_of_jumps(piece.system, start, end, dt, integrator.label if at_ends else None, stacklevel=5)
        try:
            outcome, _ = run(integrator, piece)
        except Interrupted as stop:
            outcome, stopped = stop.outcome, stop
        y, first, stop_at = outcome.y, 0, len(outcome.t)
        if times is not None:
            stop_at = min(stop_at, due - done)
            done = due
        elif sign > 0 and not last and outcome.t[-1:] == end:
            stop_at -= 1
        elif sign < 0 and i:
            first = 1
        found.append(replace(outcome, t=outcome.t[first:stop_at], y=y[first:stop_at]))
        if stopped is not None or last or (np.ndim(outcome.status) == 0 and outcome.status != 0):
            break
        state = stages[i](y[-1], sign)
        if search is not None:
            search.values = [event.value(end, state) for event in search.events]
        piece, start = replace(piece, y0=state), end
        if problem.progress is not None:
            problem.progress(abs(end - t0))
    merged = _merged(found, problem, np.array([t0, *ends[: len(found)]]))
    if stopped is not None:
        raise interrupted(merged, stopped.outcome.stats["interrupted_at"])
    return merged, replace(problem, diagnosed=False)


def _merged(found: list[Outcome], problem: Problem, ends: np.ndarray) -> Outcome:
    """The outcomes of runs one after the other as one: counts are added, and what failed first is told."""
    t = np.concatenate([each.t for each in found])
    if problem.t_eval is not None:
        t = problem.t_eval[: len(t)]
    last, stats = found[-1], dict(found[0].stats)
    status = last.status
    for each in found[1:]:
        for name, value in each.stats.items():
            counted = isinstance(value, int | np.integer) or (isinstance(value, np.ndarray) and value.dtype.kind == "i")
            if name not in stats:
                stats[name] = value
            elif counted:
                stats[name] = stats[name] + value
            elif isinstance(value, np.ndarray):
                stats[name] = np.where(np.isnan(stats[name]), value, stats[name])
            elif name == "copy_distance":
                stats[name] = max(stats[name], value)
        if np.ndim(status):
            status = np.where(np.asarray(each.status) < 0, each.status, status)
    failed = next((each for each in found if np.any(np.asarray(each.status) < 0)), None)
    stats["impulses"] = len(found) - 1
    message = finished(problem) if not np.any(np.asarray(status)) else (failed or last).message
    outcome = Outcome(t, join([each.y for each in found]), status, message, stats)
    if problem.dense_output:
        outcome.sol = BetweenImpulses(tuple(each.sol for each in found if each.sol is not None), ends)
    return outcome


@dataclass(frozen=True)
class BetweenImpulses:
    """The dense output of a run with impulses: that of the piece in which t lies, at an impulse the later one."""

    pieces: tuple[Callable[[Any], Array], ...]
    times: np.ndarray

    def __call__(self, t: Any) -> Array:
        sign = 1 if self.times[-1] >= self.times[0] else -1
        ends, pieces = self.times[::sign], self.pieces[::sign]
        index = np.searchsorted(ends[1:-1] - 8 * EPS * np.abs(ends).max(), t, side="right")
        inside = np.clip(t, ends[index], ends[index + 1])
        if np.ndim(t) == 0:
            return pieces[int(index)](float(inside))
        return concatenate([pieces[i](s)[..., None] for i, s in zip(index.tolist(), inside.tolist(), strict=True)])
