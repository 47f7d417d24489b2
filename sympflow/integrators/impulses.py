"""Runs in pieces, by any method: from each jump of H in t to the next, and between impulses, which are kicks."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from sympflow.arrays import Array, concatenate
from sympflow.hamiltonian.definition import ASIDE
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator, Interrupted, Outcome, Problem, finished, interrupted
from sympflow.integrators.grid import EPS

Run = Callable[[Integrator, Problem], tuple[Outcome, Problem]]
MOST_LANDINGS = 20_000  # jumps at which a run is cut; one with more is not, and warns
MOST_KINKS = 5000


def landings(
    integrator: Integrator, system: HamiltonianSystem, t0: float, t1: float, able: bool = True, kinks: bool = True
) -> tuple[str, list[float]]:
    """The warning of a run that loses its order at jumps of H in t; or, if it is `able`, those at which it is cut.

    By fixed steps of more than second order it is cut at kinks of H too, or, without `kinks`, warned of them.
    """
    if not system.definition.may_jump or not math.isfinite(t1) or t0 == t1:
        return "", []
    dt, at_ends, said = integrator.step_length(system), integrator.forces_at_ends(system), ""
    step = (dt or system.dt) / 4
    times = system.jump_times(min(t0, t1), max(t0, t1), step).tolist()
    if dt is None and times:  # its steps may be longer than a pulse
        said = (
            f"`t_span` ({t0:g}, {t1:g}): H of {system.name!r} jumps in t, at t = {times[0]:.6g} and {len(times):,} "
            f"times or more, where {integrator.name!r} ends no step: it is of first order there, or jumps over a "
            "pulse. Solve in shorter intervals, or by a fixed `dt` that divides all pieces between jumps."
        )
    elif dt is not None:
        within = _within(times, t0, dt)
        ends = [t for t in (t0, t1) if at_ends and _jumps_into(system, t, t0, t1, dt)]
        times = sorted([*ends, *times], reverse=t1 < t0)
        if len(within):
            said = (
                f"`dt` {dt:g}: H of {system.name!r} jumps within a step, at t = {within[0 if t1 > t0 else -1]:.6g}, "
                "where every method is of first order. Choose a `dt` that divides all pieces between jumps from t0 on, "
                "or solve from jump to jump."
            )
        elif at_ends and times:
            said = (
                f"`method` {integrator.label!r} takes forces at the ends of its steps, and H of {system.name!r} jumps "
                f"at one, at t = {times[0]:.6g}: it is of first order there. Use one that takes none, such as "
                "'leapfrog', 'kahan_li8' or 'gauss_legendre6'."
            )
    cuts = [(times, False)] if said else []
    if dt is not None and (integrator.order or 0) > 2:
        bends = system.jump_times(min(t0, t1), max(t0, t1), step, True)
        if len(within := _within(bends, t0, dt)):
            said = said or (
                f"`dt` {dt:g}: H of {system.name!r} has a kink in t within a step, at t = "
                f"{within[0 if t1 > t0 else -1]:.6g}, where method {integrator.name!r} of order {integrator.order} is "
                "of second. Choose a `dt` that divides all pieces between kinks from t0 on, or solve from kink to kink."
            )
            if kinks and len(bends) <= MOST_KINKS:
                cuts.insert(0, (sorted({*bends.tolist(), *times}), True))
    if not able or integrator.forces_beyond(system):
        return said, []
    for met, bent in cuts:  # all times must be known: `jump_times` may list the first ones alone
        if 0 < len(met) <= MOST_LANDINGS and not len(system.jump_times(max(met), max(t0, t1), step, bent)):
            return "", met
    return said, []


def _within(times: Any, t0: float, dt: float) -> np.ndarray:
    """The times (n,) that lie within steps from t0, not at their ends."""
    t = np.array(times)
    x = (t - t0) / dt
    return t[np.abs(x - np.round(x)) > np.maximum(1e-9, 8 * EPS * np.maximum(abs(t0), np.abs(t)) / dt)]


def _jumps_into(system: HamiltonianSystem, t: float, t0: float, t1: float, dt: float) -> bool:
    """Return True if H jumps at an end t of a run, and its value there is not that within the run."""
    near = 4 * EPS * abs(t) + 1e-9 * dt
    if not len(system.jump_times(t - near, t + near, dt / 4)):
        return False
    y = np.random.default_rng(0).uniform(-1, 1, (16, 2 * system.ndof)) * 10.0 ** np.arange(-8, 8)[:, None]
    inward = math.copysign(1e-6 * dt, (t0 + t1) / 2 - t)
    with np.errstate(all="ignore"):
        outside, at, inside = (system.hamiltonian(y, t + s * inward) for s in (-1, 0, 1))
        return bool((np.abs(at - inside) > 0.01 * np.abs(outside - inside)).any())


def spans(t0: float, t1: float, ends: Collection[float], jumps: Sequence[float]) -> list[tuple[float, float, float]]:
    """The intervals that end at certain times and at jumps of H in t, within which it does not jump; and their ends."""
    aside = math.copysign(ASIDE * max(abs(t0), abs(t1)), t1 - t0)
    fixed = [t0, *ends, t1]
    met = {next((t for t in fixed if abs(t - jump) <= 4 * abs(aside)), jump) for jump in jumps}
    times = [t0, *sorted({*ends, *(met - {t0, t1})}, reverse=t1 < t0), t1]
    return [(a + aside * (a in met), b - aside * (b in met), b) for a, b in pairwise(times)]


def pieces_of(integrator: Integrator, system: HamiltonianSystem, t0: float, t1: float) -> list[tuple[float, float]]:
    """The pieces of a run of a system without impulses."""
    return [piece[:2] for piece in spans(t0, t1, [], landings(integrator, system, t0, t1)[1])]


def run_in_pieces(
    run: Run, integrator: Integrator, problem: Problem, jumps: Sequence[float]
) -> tuple[Outcome, Problem]:
    """The outcome of a problem by runs from each impulse, or jump of H in t, to the next, and the problem."""
    t0, t1, times, search = problem.t0, problem.t1, problem.t_eval, problem.events
    low, high = min(t0, t1), max(t0, t1)
    near, sign = 8 * EPS * max(abs(low), abs(high)), 1 if t1 >= t0 else -1
    kicks = {
        min(kick.t, high): kick
        for kick in problem.system.kicks(low - 2 * near, high + 2 * near)
        if low + near < kick.t <= high + near
    }
    piece = replace(problem, system=problem.system.between_impulses, progress=None)
    found: list[Outcome] = []
    stopped, done, since, pieces = None, 0, t0, spans(t0, t1, kicks, jumps)
    for i, (start, end, stop) in enumerate(pieces):
        last = i == len(pieces) - 1
        piece = replace(piece, t0=start, t1=end)
        if times is not None:
            beyond = (times[done:] - stop) * sign > (near if sign < 0 else -near)
            due = len(times) if last else done + (int(beyond.argmax()) if beyond.any() else len(beyond))
            asked = np.clip(times[done:due], min(start, end), max(start, end))
            piece = replace(piece, t_eval=asked if len(asked) and asked[-1] == end else np.append(asked, end))
        try:
            outcome, _ = run(integrator, piece)
        except Interrupted as interruption:
            outcome, stopped = interruption.outcome, interruption
        y, first, stop_at = outcome.y, 0, len(outcome.t)
        if times is not None:
            stop_at = min(stop_at, due - done)
            done = due
        elif sign > 0 and not last and outcome.t[-1:] == end:
            stop_at -= 1
        elif sign < 0 and i:
            first = 1
        t = np.where(outcome.t == start, since, np.where(outcome.t == end, stop, outcome.t))
        found.append(replace(outcome, t=t[first:stop_at], y=y[first:stop_at]))
        if stopped is not None or last or (np.ndim(outcome.status) == 0 and outcome.status != 0):
            break
        state = y[-1]
        if stop in kicks:
            state = kicks[stop](state, sign)
            if search is not None:
                search.values = [event.value(stop, state) for event in search.events]
        piece, since = replace(piece, y0=state), stop
        if problem.progress is not None:
            problem.progress(abs(stop - t0))
    merged = _merged(found, problem, pieces, sum(stop in kicks for *_, stop in pieces[: len(found) - 1]))
    if stopped is not None:
        raise interrupted(merged, stopped.outcome.stats["interrupted_at"])
    return merged, replace(problem, diagnosed=False)


def _merged(found: list[Outcome], problem: Problem, pieces: list[Any], impulses: int) -> Outcome:
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
    if problem.system.between_impulses is not problem.system:
        stats["impulses"] = impulses
    if impulses < len(found) - 1:
        stats["jumps"] = len(found) - 1 - impulses
    message = finished(problem) if not np.any(np.asarray(status)) else (failed or last).message
    outcome = Outcome(t, concatenate([each.y for each in found], 0), status, message, stats)
    if problem.dense_output:
        solutions = tuple(each.sol for each in found if each.sol is not None)
        outcome.sol = PiecewiseSolution(solutions, np.array(pieces)[: len(found), :2])
    return outcome


@dataclass(frozen=True)
class PiecewiseSolution:
    """The dense output of a run in pieces: that of the piece in which t lies, at an impulse the later one.

    `spans` (n, 2) are their ends, which decrease in a run back in time.
    """

    pieces: tuple[Callable[[Any], Array], ...]
    spans: np.ndarray

    def __call__(self, t: Any) -> Array:
        sign = 1 if self.spans[-1, 1] >= self.spans[0, 0] else -1
        ends, pieces = np.sort(self.spans[::sign], axis=1), self.pieces[::sign]
        index = np.searchsorted(ends[1:, 0] - 8 * EPS * np.abs(ends).max(), t, side="right")
        inside = np.clip(t, *ends[index].T)
        if np.ndim(t) == 0:
            return pieces[int(index)](float(inside))
        return concatenate([pieces[i](s)[..., None] for i, s in zip(index.tolist(), inside.tolist(), strict=True)])
