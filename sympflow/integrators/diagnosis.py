"""Checks after a run: poles of H and collisions within a step, and steps that are too long.

For a failed run also the time at which the solution becomes infinite.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sympflow.arguments import warn
from sympflow.arrays import Array, masked, readable, to_numpy
from sympflow.hamiltonian.formulas import TracedHamiltonian
from sympflow.hamiltonian.scales import known_scale, rate_of_motion
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.contract import Failure, Integrator, Outcome, Problem
from sympflow.integrators.domain_exit import check_domain, check_system_along, warn_of_loss

if TYPE_CHECKING:
    from sympflow.hamiltonian.parameter_rows import ParameterRows
    from sympflow.hamiltonian.poles import Poles

TAIL = 200  # steps before the end of a run, at least, from which the solution is followed
AHEAD = 4  # steps beyond the end: an implicit method gives up before a singularity
MOST_DIAGNOSED = 16  # sets of values of parameters
MOST_TRIED, MOST_ROWS, MOST_STORED = 500, 4096, 10**7  # steps of the reference; trajectories at once; numbers
RTOL = 1e-10
LOST = 0.01  # of y·∇H: a state whose energy differs by more is no longer on the solution
SHORT = 1e-11  # of the way: steps below it go on no more
NEAR, NEARER, GROWTH = 1e-3, 1e-8, 10.0
"""The state is infinite at the end if it grows by so much from this to that part of the way before it."""
LOOKED_AT, LOOKED_AT_TOGETHER = 32, 4096  # outputs of one trajectory, states of all, at which H and signs are compared
OFF, FAR_OFF = 0.01, 0.5  # of the kinetic energy: a change of H after which steps are looked at; where H may change
MOST_WALKED, MOST_TESTED, MOST_NAMED = 4 * 10**6, 32, 64  # numbers of a run executed again; crossings; trajectories
ACROSS, AROUND, PARTS = 0.25, 8, 9
"""A step leaps if, at one of so many points on it, what vanishes is so small a part of what it is at another; around it
H changes by more than a tenth of the kinetic energy within so many steps."""
LOST_AROUND = 0.1
TOO_LONG = 0.01
"""The energy error, over the size of the energy, from which a step is too long: that of Verlet's method at a tenth of
its stability. Where energy is not kept, the error of an oscillation as fast as the motion."""
TOO_LOOSE = 0.05  # the same, of adaptive methods, and of the end of a run on a clock
PHASES = np.geomspace(1e-3, 3.0, 400)  # oscillations, in radians a step; beyond the last one none is followed
LARGE = 200  # degrees of freedom
FEW_STEPS = 20
FINER, MOST_FINER = 4, 64  # fine steps for each step of a run that they judge, and the most between two outputs
MOST_AGAIN = 100  # steps on a clock, which are made again in halves
SAFE = 4  # steps of so many `dt` of a system are not looked at in a run of few
STRAIGHT = 1 - 1e-9  # of the squared cosine of velocity and acceleration, of a motion that may lead to a centre
NUDGE = 1e-9  # of the momenta, by which forces change them to show the way of what is at rest
TURNING = Failure.CLOCK, Failure.ENCOUNTER  # breakdowns of methods that turn at an exact collision
NO_FORCE = (
    "At the last state the force is NaN: write H without parts that overflow, such as exp(800), or are 0/0; shorter "
    "steps do not help. Start elsewhere"
)


def diagnose_piece(outcome: Outcome, integrator: Integrator, problem: Problem, rows: ParameterRows | None) -> bool:
    """Note poles that a run passed, if any, and when the solution of one that failed ends."""
    system, failed = problem.system, _failed(outcome)
    looked = system.definition.poles is not None or problem.parameter_values is not None
    if not problem.diagnosed or not (failed or looked) or not readable(outcome.y):
        return False
    found: list[Passage] = []
    plain = problem.parameter_values is None
    if problem.store is None and looked and (not failed or np.any(np.asarray(outcome.status) >= 0)):
        found = note_poles(outcome, integrator, problem, rows)
    passed = any(each.certain for each in found)
    if plain and (failed or passed):
        note_singularities(outcome, integrator, problem, passed)
    return bool(found)


def diagnose(
    outcome: Outcome,
    integrator: Integrator,
    problem: Problem,
    rows: ParameterRows | None,
    action: str,
    interrupted: bool,
) -> None:
    """Check the outcome of a run: a finding ends it, is added to its message, or causes a warning."""
    system, y0 = problem.system, problem.y0
    told = not interrupted and diagnose_piece(outcome, integrator, problem, rows)
    values, between = readable(outcome.y), system.between_impulses
    held = values and problem.store is None and not _failed(outcome)
    if held and not told and problem.parameter_values is None:
        told = warn_of_collision(outcome, integrator, problem)
    if held and system.definition.leaps and problem.parameter_values is None:
        told = warn_of_leap(outcome, system, y0) or told
    if values and system.functions_given:
        told = system.check_functions_along(outcome.y) or told
    if integrator.trained:
        check_system_along(outcome, integrator, between, y0)
    if values and action != "ignore":
        check_domain(outcome, integrator, between, action)
        if held and between is system:
            warn_of_loss(outcome, integrator, system, y0)
    if held and not told and problem.diagnosed and not problem.followed:
        warn_of_long_steps(outcome, integrator, problem)


def _failed(outcome: Outcome) -> bool:
    """True if a trajectory has failed."""
    status = outcome.status
    return status < 0 if isinstance(status, int) else bool(np.any(np.asarray(status) < 0))


class Passage(NamedTuple):
    """The times between which a trajectory passed a pole, its name, "" of a start, and True if no solution does."""

    begin: float
    end: float
    place: str
    certain: bool


def note_poles(
    outcome: Outcome, integrator: Integrator, problem: Problem, values: ParameterRows | None
) -> list[Passage]:
    """End a run where it passed a place at which H is infinite or NaN; warn where it may have passed one."""
    poles, width, n = problem.system.definition.poles, 2 * problem.system.ndof, len(outcome.t)
    numbers: Sequence[Any] = ()
    if problem.parameter_values is not None:
        poles, numbers = problem.system.definition.parametric.poles, [*problem.parameter_values]
    if not poles or not n:
        return []
    starts = to_numpy(problem.y0).reshape(-1, width)
    outputs = to_numpy(outcome.y).reshape(n, -1, width)
    with np.errstate(all="ignore"):
        if not poles.may_pass(np.array([starts, outputs[-1]])):
            return []
        every = slice(n - 1, None, -max(1, -(-n // LOOKED_AT), n * starts.size // LOOKED_AT_TOGETHER))  # the last too
        y = np.concatenate([starts[None], outputs[every][::-1]])
        t = np.concatenate([[problem.t0], outcome.t[every][::-1]])
        try:
            looked = _look(problem.system, poles.look(y, t[:, None], numbers))
            if looked is not None and not numbers and (exact := poles.exact) is not poles:
                looked = _look(problem.system, exact.look(y, t[:, None])) if exact else None
        except TypeError:  # a function that takes no arrays
            return []
        if looked is None:
            return []
        odd, scale = looked
        held = (np.atleast_1d(np.asarray(outcome.status)) >= 0).reshape(-1)
        rows = np.flatnonzero(odd.any(0) & held)
        found: dict[int, Passage] = {}
        for row in rows[np.argsort(~odd[0, rows], kind="stable")][:MOST_NAMED].tolist():
            if odd[0, row]:
                found[row] = Passage(problem.t0, problem.t0, "", True)
                continue
            own = (
                problem
                if values is None or problem.parameter_values is None
                else replace(problem, system=values.system_of(row), parameter_values=None)
            )
            known = own.system.definition.poles and own.system.definition.poles.exact
            if not known:
                continue
            ends = t[-1], t[int(np.argmax(odd[:, row]))]
            passage = _passage(known, *_steps_of(outcome, integrator, own, row, ends), scale[row])
            if passage is not None:
                found[row] = passage
    certain = [row for row, passage in found.items() if passage.certain]
    if certain:
        _end(outcome, integrator, problem, {row: found[row] for row in certain}, values)
    likely = [row for row in found if row not in certain]
    if likely:
        passage, which = found[likely[0]], _which(problem, likely, values)
        warn(
            f"H{which} changed permanently between t = {passage.begin:.10g} and {passage.end:.10g}, where a step "
            f"jumped over a place at which H is infinite, {passage.place}: the run is meaningless after that. "
            f"{_remedy(integrator, problem)}.",
            RuntimeWarning,
        )
    return [*found.values()]


def warn_of_collision(outcome: Outcome, integrator: Integrator, problem: Problem) -> bool:
    """Warn, and return True, of a run that turns at an exact collision, as those on a clock do, or Kepler's motion."""
    system, poles = problem.system, problem.system.definition.poles
    if not isinstance(integrator, FixedStep) or integrator.breakdown not in TURNING or not len(outcome.t):
        return False
    if not poles:
        return False
    d, y0 = system.ndof, to_numpy(problem.y0).reshape(-1, 2 * system.ndof)[:MOST_NAMED].astype(float)
    with np.errstate(all="ignore"):
        force, p = -np.asarray(system.gradient(y0))[:, :d], y0[:, d:]
        sizes, strengths = np.abs(p).max(1, keepdims=True), np.abs(force).max(1, keepdims=True)
        share = np.where(sizes > 0, NUDGE * sizes, 1.0) / np.maximum(strengths, 1e-300)
        falling = np.concatenate([y0[:, :d], p + share * force], axis=1)  # of what is at rest, as it begins to move
        if isinstance(system.form, TracedHamiltonian):  # whose places are written in symbols for that
            v, a = (np.asarray(system.gradient(np.concatenate([y0[:, :d], x], axis=1)))[:, d:] for x in (p, force))
            if ((v * a).sum(1) ** 2 < STRAIGHT * (v * v).sum(1) * (a * a).sum(1)).all():
                return False
        exact = poles.exact
        if not exact or not len(rows := np.flatnonzero(exact.ahead(falling))):
            return False
        begin, end = (np.full(len(rows), float(t)) for t in (problem.t0, outcome.t[-1]))
        times, *_ = _end_of_solution(system, begin, y0[rows], end)
    met = np.flatnonzero(np.isfinite(times))
    if len(met):
        warn(
            f"The solution{_which(problem, rows[met].tolist(), None)} becomes infinite, at about t = "
            f"{times[met[0]]:.10g}, by a collision: no step can pass it, and the run turns back there. End `t_span` "
            "before, or soften H.",
            RuntimeWarning,
        )
    return bool(len(met))


def _look(
    system: HamiltonianSystem, looked: tuple[np.ndarray, np.ndarray, np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray] | None:
    """True for states (n, N) with signs or H unlike the first ones, and for a start without H."""
    cells, H, T = looked
    if T is not None and (cells == cells[0]).all() and (H.max(0) - H.min(0) <= OFF * np.abs(T).max(0)).all():
        return None
    odd = (cells != cells[0]).any(-1)
    scale = np.full(H.shape[1], np.inf)
    if T is not None:
        V = H - T
        scale = np.fmax.reduce(np.maximum(np.abs(T), np.abs(V - V[0])), axis=0)
        odd |= ~(np.abs(H - H[0]) <= (OFF if system.keeps_energy else FAR_OFF) * scale)
    odd[0] = ~np.isfinite(H[0])
    return (odd, scale) if odd.any() else None


def _steps_of(
    outcome: Outcome, integrator: Integrator, problem: Problem, row: int, ends: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and states (n, 2d) of a trajectory at its steps up to an end, the first that is near; or outputs."""
    width, length = 2 * problem.system.ndof, integrator.step_length(problem.system)
    y0 = to_numpy(problem.y0).reshape(-1, width)[row]
    known = problem.t_eval is None and problem.save_every == 1 and (length is not None or problem.y0.ndim == 1)
    for end in () if known else ends:
        n_steps = abs(end - problem.t0) / length if length else outcome.stats.get("n_steps", 0)
        if n_steps * width <= MOST_WALKED:
            try:
                again = integrator.run(Problem(problem.system, problem.t0, end, y0, backend=problem.backend))
            except Exception:  # of a plug-in, whose outputs are all that is known
                break
            return again.t.astype(float), again.y.astype(float)
    first = int(outcome.t[0] == problem.t0)
    y = to_numpy(outcome.y).reshape(len(outcome.t), -1, width)[first:, row]
    return np.append(problem.t0, outcome.t[first:]), np.concatenate([y0[None], y]).astype(float)


def _passage(poles: Poles, t: np.ndarray, y: np.ndarray, scale: float) -> Passage | None:
    """The first place that was passed between states y (n, 2d) at t (n,): surely, or else likely."""
    cells, H, T = poles.look(y, t)
    for k, column in np.argwhere(cells[1:] != cells[:-1])[:MOST_TESTED].tolist():
        if poles.passed(column, t[k : k + 2].tolist(), y[k : k + 2]):
            return Passage(float(t[k]), float(t[k + 1]), poles.name(column), True)
    if T is None:
        return None
    k = np.arange(len(y) - 1)
    lost = np.abs(H[np.minimum(k + 1 + AROUND, len(k))] - H[np.maximum(k - AROUND, 0)])
    k = np.flatnonzero(~(lost <= LOST_AROUND * scale))
    if not len(k):
        return None
    s = np.linspace(0, 1, PARTS)[:, None]
    along = y[k][:, None] * (1 - s) + y[k + 1][:, None] * s
    size = np.abs(poles.sizes(along, t[k][:, None] * (1 - s[:, 0]) + t[k + 1][:, None] * s[:, 0]))
    leapt = size.min(1) < ACROSS * size.max(1)
    if not leapt.any():
        return None
    first, column = np.argwhere(leapt)[0].tolist()
    return Passage(float(t[k[first]]), float(t[k[first] + 1]), poles.name(column), False)


def _remedy(integrator: Integrator, problem: Problem) -> str:
    if integrator.step_length(problem.system) is None:
        return "Reduce `rtol` and `atol`, or soften H there"
    own = "steps of its own, such as 'dop853'"
    if problem.system.separable:
        own = "a clock of its own, such as 'log_leapfrog'"
    return f"Reduce `dt`, soften H there, or take a method with {own}"


def _which(problem: Problem, rows: list[int], values: ParameterRows | None) -> str:
    """The trajectories of a batch, in words: by their places, or parameters."""
    if values is not None:
        return f" with {values.shown(rows[0])}"
    if problem.y0.ndim == 1:
        return ""
    first = ", ".join(map(str, np.unravel_index(rows[0], problem.y0.shape[:-1])))
    return f" of trajectory {first}" + (f", the first of {len(rows)}," if len(rows) > 1 else "")


def _end(
    outcome: Outcome, integrator: Integrator, problem: Problem, found: dict[int, Passage], values: ParameterRows | None
) -> None:
    """Set status −1 and the message of trajectories that passed a pole; end them before."""
    sign = 1.0 if problem.t1 >= problem.t0 else -1.0
    rows = sorted(found, key=lambda row: (found[row].end - problem.t0) * sign)
    first, which = found[rows[0]], _which(problem, rows, values)
    if not first.place:
        outcome.message = f"H{which} is infinite, or NaN, at `y0`: start elsewhere."
    else:
        outcome.message = (
            f"Between t = {first.begin:.10g} and {first.end:.10g} the run{which} passed {first.place}, "
            f"where H is infinite or NaN: no solution does. {_remedy(integrator, problem)}, or end `t_span` "
            "earlier."
        )
    if problem.y0.ndim == 1:
        keep = (outcome.t - first.begin) * sign <= 0
        outcome.t, outcome.y, outcome.status = outcome.t[keep], outcome.y[keep], -1
        outcome.stats["failed_at"] = first.begin
        return
    failed_at = np.full(int(np.prod(problem.y0.shape[:-1])), np.nan)
    failed_at[list(found)] = [passage.begin for passage in found.values()]
    before = np.asarray(outcome.stats.get("failed_at", np.nan)).reshape(-1)
    failed_at = np.where(np.isnan(failed_at), before, failed_at).reshape(problem.y0.shape[:-1])
    after = ~((outcome.t.reshape(-1, *[1] * failed_at.ndim) - failed_at) * sign <= 0) & np.isin(
        np.arange(failed_at.size), list(found)
    ).reshape(failed_at.shape)
    outcome.stats["failed_at"], outcome.finite = failed_at, False
    outcome.status = np.where(after.any(0) | ~np.isnan(failed_at), -1, outcome.status)
    outcome.y = masked(outcome.y, after[..., None], np.nan)


def warn_of_long_steps(outcome: Outcome, integrator: Integrator, problem: Problem) -> None:
    """Warn of the doubts of a method, and of steps with which the energy is off by more than 1 % of its size.

    Where energy is not kept, the motion at the start and the end must not be too fast for the step. On a clock the
    energy may be kept although the time is wrong: a run of few steps is compared with one in halves.

    H is evaluated at the start and a few outputs, of large systems at one for every 200 steps, and not in runs of few
    steps that are not long, which would take twice the time. Its size is ½ Σ|y_i ∂H/∂y_i|, that of an oscillator.
    """
    system, n, n_steps = problem.system, len(outcome.t), outcome.stats.get("n_steps", 0)
    dt, known, few = None, False, False
    if isinstance(integrator, FixedStep):
        if doubt := integrator.doubt(system):
            warn(doubt, RuntimeWarning)
        dt = integrator.step_length(system)
        known = integrator.dt is None or (not system.step_is_open and integrator.dt <= system.dt)
        few = n_steps < FEW_STEPS and (known or dt <= SAFE * system.dt)
    if integrator.trained:
        return
    seen = LOOKED_AT * (not few) if system.ndof <= LARGE else min(LOOKED_AT, n_steps // 200)
    fixed = integrator if isinstance(integrator, FixedStep) and not known else None
    if not system.keeps_energy and dt is not None:
        if (
            fixed
            and n
            and n_steps >= FEW_STEPS
            and problem.parameter_values is None
            and (told := _too_fast(outcome, fixed, problem))
        ):
            warn(told, RuntimeWarning)
        return
    if not n or not seen or system.between_impulses is not system:
        return
    most = TOO_LOOSE if dt is None else TOO_LONG
    if system.keeps_energy:
        off = _energy_off(outcome, problem, seen, most, dt is None)
    else:
        off = _energy_lost(outcome, problem)
    told = "the energy of the run " + ("overflows" if off == math.inf else f"is off by {100 * off:.2g} %")
    if off <= most and fixed and fixed.in_another_time and n_steps <= MOST_AGAIN:
        off, most = _end_off(outcome, fixed, problem), TOO_LOOSE
        told = f"with half of it the final state differs by {100 * off:.2g} % of its size"
    if off > most:
        what, remedy = "`rtol` is too large", "Take rtol=1e-8, or a method of fixed steps with tol=1e-6"
        if dt is not None:
            what, remedy = f"`dt` {dt:g} is too long", "Take a shorter step, or tol=1e-6, which chooses one"
        warn(f"{what} for method {integrator.label!r}: {told}. {remedy}.", RuntimeWarning)


def try_steps(integrator: Integrator, system: HamiltonianSystem, t_span: tuple[float, float], y0: np.ndarray) -> None:
    """Warn of poles passed, and steps that are too long, in the first steps of some of the orbits from y0 (N, 2d)."""
    t0, t1 = t_span
    end = t0 + math.copysign(min(abs(t1 - t0), MOST_TRIED * (integrator.step_length(system) or system.dt)), t1 - t0)
    one = len(y0) == 1 or integrator.one_by_one or system.ndof > LARGE
    piece = Problem(system, t0, end, y0[0] if one else y0[:LOOKED_AT], save_every=MOST_TRIED // LOOKED_AT)
    try:
        outcome = integrator.run(piece)
    except Exception:  # which the run itself tells
        return
    if not _failed(outcome):
        told = diagnose_piece(outcome, integrator, piece, None)
        if _failed(outcome):
            warn(f"`system`: {outcome.message}", RuntimeWarning)
        elif not told:
            warn_of_long_steps(outcome, integrator, piece)


def _energy_off(outcome: Outcome, problem: Problem, seen: int, most: float, each: bool) -> float:
    """The largest change of H at the start and some outputs, over its size, at `each` or at most; 0 if not known."""
    system, n, width = problem.system, len(outcome.t), 2 * problem.system.ndof
    every = slice((n - 1) % (step := -(-n // seen)), None, step)  # the last among them
    if problem.y0.ndim == 1 and n <= seen and outcome.t[0] == problem.t0:
        y = to_numpy(outcome.y)
    else:
        parts = (
            to_numpy(part).reshape(-1, math.prod(problem.y0.shape[:-1]), width)
            for part in (problem.y0, outcome.y[every])
        )
        y = np.concatenate([*parts])[:, :LOOKED_AT].astype(float)
    functions: Any = system
    numbers: dict[str, Any] = {}
    if problem.parameter_values is not None:
        functions, numbers = system.definition.parametric, {"numbers": problem.parameter_values[:, :LOOKED_AT]}
    with np.errstate(all="ignore"):
        try:
            H = np.asarray(functions.hamiltonian(y, **numbers))
            if (H.max(0) - H.min(0) <= most * np.abs(H[0])).all():
                return 0.0
            change = np.abs(H - H[0])
            if not (change > most * np.abs(H[0])).any():
                return 0.0
            sizes = 0.5 * np.abs(y * np.asarray(functions.gradient(y, **numbers))).sum(-1)
            size = sizes if each else sizes.max(0)
        except (ArithmeticError, ValueError, TypeError):  # a function that takes no batches
            return 0.0
        off = np.fmax.reduce(change / np.maximum(size, system.energy_scale or 0.0), axis=None)  # of a rest 0/0
        if off > most:  # told as the energy error of the run
            off = np.fmax(off, np.fmax.reduce(change / known_scale(system, H, sizes), axis=None))
    if np.isfinite(H[0]).all() and np.isinf(change).any():
        return math.inf
    return float(off) if off < math.inf else 0.0


def _energy_lost(outcome: Outcome, problem: Problem) -> float:
    """The energy that the steps of a driven or damped run lose in all, over its size; 0 if not known.

    It is that of the states at a few outputs and of fine steps from the ones before, times the number of outputs, or
    of those within the time in which friction forgets.
    """
    system, n, width = problem.system, len(outcome.t), 2 * problem.system.ndof
    y0, t = to_numpy(problem.y0), np.append(problem.t0, outcome.t)
    y = np.concatenate([y0[None], to_numpy(outcome.y)]).reshape(n + 1, -1, width)[:, :LOOKED_AT].astype(float)
    t, y = (x[int(t[1] == t[0]) :] for x in (t, y))
    trajectories = 1 if y0.ndim == 1 else max(1, y0.size // width)
    parts = FINER * math.ceil(outcome.stats.get("n_steps", 0) / trajectories / max(len(t) - 1, 1))
    if len(t) < 2 or parts > MOST_FINER or system.ndof > LARGE:
        return 0.0
    k = np.unique(np.linspace(0, len(t) - 2, LOOKED_AT // 2).astype(int))
    h = (t[k + 1] - t[k])[:, None] / parts
    with np.errstate(all="ignore"):
        try:
            fine = y[k]
            for i in range(parts):
                fine = fine + h[..., None] * _increment(system, t[k][:, None] + i * h, fine, h)[0]
            ends = np.broadcast_to(t[k + 1][:, None], fine.shape[:-1])
            lost = np.mean(system.hamiltonian(y[k + 1], ends) - system.hamiltonian(fine, ends), axis=0)
            slopes = np.asarray(system.gradient(y[k], np.broadcast_to(t[k][:, None], ends.shape)))
            size = 0.5 * np.abs(y[k] * slopes)[..., system.ndof :].sum(-1).max(0)  # T: that of a rotor does not grow
        except (ArithmeticError, ValueError, TypeError):  # a function that takes no batches
            return 0.0
        rates = system.friction.rates[system.friction.rates > 0] if system.friction else np.zeros(0)
        memory = 1 / (rates.min() * np.abs(t[-1] - t[0])) if rates.size else 1.0
        off = np.fmax.reduce(np.abs(lost) / size) * (len(t) - 1) * min(1.0, memory)
    return float(off) if off < math.inf else 0.0


def _end_off(outcome: Outcome, integrator: FixedStep, problem: Problem) -> float:
    """How far a run with half the step ends from an outcome, over the size of q or p; 0 where that is not known."""
    end = float(outcome.t[-1])
    half = replace(integrator, dt=0.5 * integrator.step_length(problem.system))
    again = half.run(replace(problem, t1=end, t_eval=np.array([end]), events=None, progress=None))
    if _failed(again) or not len(again.t):
        return 0.0
    y, other = (np.stack(np.split(to_numpy(x[-1]), 2, axis=-1)).reshape(2, -1) for x in (outcome.y, again.y))
    return float(np.max(np.abs(y - other).max(1) / np.maximum(np.abs(y).max(1), 1e-300)))


def _too_fast(outcome: Outcome, integrator: FixedStep, problem: Problem) -> str:
    """A warning of a step that is long for the motion at the start and the end, or nothing."""
    times, ends = [problem.t0, float(outcome.t[-1])], [to_numpy(y) for y in (problem.y0, outcome.y[-1])]
    rate = rate_of_motion(problem.system.between_impulses, times, ends)
    dt = integrator.step_length(problem.system)
    if not rate or not _misses(integrator, np.array([dt * rate])).any():
        return ""
    most = float(PHASES[_misses(integrator, PHASES)][0])
    return (
        f"`dt` {dt:g} is too long for method {integrator.label!r}: the rate of the motion is {rate:.3g}, and its "
        f"product with the step should be at most {most:.2g}. Take {most / rate:.2g}, or tol=1e-6, for which the step "
        "is chosen."
    )


def _misses(integrator: FixedStep, z: np.ndarray) -> np.ndarray:
    """True for oscillations of z radians in a step that a method does not follow, (n,)."""
    with np.errstate(all="ignore"):
        error = integrator.oscillation_error(z)
    return (error > TOO_LONG) | ((error > 0) & (z >= PHASES[-1]))


def note_singularities(outcome: Outcome, integrator: Integrator, problem: Problem, told: bool = False) -> None:
    """Add to the message, and as `stats["blow_up_time"]`, when the solution of a failed run becomes infinite."""
    if not told:
        _note_last_state(outcome, problem)
    if not problem.system.keeps_energy:  # a state of the solution is told by its energy
        return
    y0 = to_numpy(problem.y0)
    failed = (np.atleast_1d(np.asarray(outcome.status)) < 0).reshape(-1)
    last = outcome.t[-1] if len(outcome.t) else problem.t0
    failed_at = np.broadcast_to(np.asarray(outcome.stats.get("failed_at", last), dtype=float), y0.shape[:-1])
    rows = np.flatnonzero(failed & np.isfinite(failed_at).reshape(-1))
    if problem.system.definition.poles is not None and len(rows):  # of a start without H there is no solution
        with np.errstate(all="ignore"):
            rows = rows[np.isfinite(problem.system.hamiltonian(y0.reshape(-1, y0.shape[-1])[rows]))]
    times, passed = np.full(len(failed), np.nan), np.zeros(len(failed), dtype=bool)
    with np.errstate(all="ignore"):
        try:
            for chunk in np.array_split(rows, max(1, -(-len(rows) // MOST_ROWS))):
                if len(chunk):
                    found = _followed(outcome, integrator, problem, chunk, failed_at.reshape(-1)[chunk])
                    times[chunk], passed[chunk] = found
        except Exception:  # functions that take no NumPy arrays, or a plug-in that fails again
            return
    first = int(rows[0]) if len(rows) else 0
    if np.isfinite(times).any():
        outcome.stats["blow_up_time"] = float(times[0]) if y0.ndim == 1 else times.reshape(y0.shape[:-1])
        i = first if np.isfinite(times[first]) else int(np.argmax(np.isfinite(times)))
        which = "" if y0.ndim == 1 else f" of trajectory {', '.join(map(str, np.unravel_index(i, y0.shape[:-1])))}"
        outcome.message += (
            f" The solution{which} itself becomes infinite, at about t = {times[i]:.10g}: no step leads beyond that; "
            "end `t_span` before."
        )
    elif passed[first] and integrator.on_grid:
        outcome.message += " The solution itself goes on there: it takes shorter steps."


def _note_last_state(outcome: Outcome, problem: Problem) -> None:
    """Add to the message what the system has to say of the last finite state of the first trajectory that failed."""
    d = problem.system.ndof
    failed = (np.atleast_1d(np.asarray(outcome.status)) < 0).reshape(-1)
    row = int(np.argmax(failed))
    if problem.store is not None:  # which has the outputs
        return
    outputs = to_numpy(outcome.y).reshape(len(outcome.t), len(failed), 2 * d)[:, row]
    finite = np.flatnonzero(np.isfinite(outputs).all(-1))
    t, y = problem.t0, to_numpy(problem.y0).reshape(-1, 2 * d)[row]
    if finite.size:
        t, y = float(outcome.t[finite[-1]]), outputs[finite[-1]]
    with np.errstate(all="ignore"), suppress(ArithmeticError, ValueError, TypeError):
        if np.isnan(problem.system.vector_field(y, t)).any() and np.isfinite(y).all():
            outcome.message = outcome.message.replace("Reduce `dt`", NO_FORCE)
    remark = problem.system.definition.remark(y[:d])
    if remark:
        outcome.message += f" At t = {t:.10g} {remark}"


def _followed(
    outcome: Outcome, integrator: Integrator, problem: Problem, rows: np.ndarray, failed_at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """For the trajectories `rows` the time of the singularity, NaN for none, and whether the solution goes on."""
    system, sign = problem.system, 1.0 if problem.t1 >= problem.t0 else -1.0
    y0 = to_numpy(problem.y0).reshape(-1, 2 * system.ndof)[rows].astype(float)
    on_grid = integrator.on_grid
    n_steps = max(1, outcome.stats.get("n_steps", 0) if problem.y0.ndim == 1 else outcome.stats["n_steps"] / len(rows))
    h = np.maximum(np.abs(failed_at - problem.t0) / n_steps, 1e-300)
    if "dt" in outcome.stats:
        h = np.full(len(rows), float(outcome.stats["dt"]))
    end = failed_at + sign * AHEAD * h if on_grid else np.full(len(rows), problem.t1)
    times, passed, open_ = _end_of_solution(system, np.full(len(rows), problem.t0), y0.copy(), end)
    t, y = _tail_states(outcome, integrator, problem, rows, failed_at, h, open_)
    missing = np.abs(system.hamiltonian(y) - system.hamiltonian(y0))
    again = (t != problem.t0) & (missing < LOST * np.abs((y * system.gradient(y)).sum(-1)))
    if again.any():
        times[again], passed[again], _ = _end_of_solution(system, t[again], y[again], end[again])
    return times, passed


def _tail_states(
    outcome: Outcome,
    integrator: Integrator,
    problem: Problem,
    rows: np.ndarray,
    failed_at: np.ndarray,
    h: np.ndarray,
    wanted: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and states (n, 2d), `TAIL` to 2·`TAIL` steps before the end where `wanted`; else the beginning."""
    sign, d2, y0 = 1.0 if problem.t1 >= problem.t0 else -1.0, 2 * problem.system.ndof, to_numpy(problem.y0)
    blocks = np.where(wanted, np.maximum(0, np.abs(failed_at - problem.t0) // (TAIL * h) - 1), 0)
    goal = problem.t0 + sign * blocks * TAIL * h
    t, y = np.full(len(rows), problem.t0), y0.reshape(-1, d2)[rows].astype(float)
    near = np.zeros(len(rows), dtype=bool)
    if len(outcome.t):
        stored = (np.searchsorted(sign * outcome.t, sign * goal, "right") - 1).clip(0)
        near = (blocks > 0) & (np.abs(goal - outcome.t[stored]) <= TAIL * h)
        outputs = to_numpy(outcome.y).reshape(len(outcome.t), -1, d2)
        t[near], y[near] = outcome.t[stored[near]], outputs[stored[near], rows[near]]
    again = np.flatnonzero((blocks > 0) & ~near)
    if len(again):
        times = np.array(sorted(set(goal[again].tolist()), key=lambda x: sign * x))
        times = times[:: max(1, -(-len(times) * len(again) * d2 // MOST_STORED))]
        start = y0 if y0.ndim == 1 else y0.reshape(-1, d2)[rows[again]]
        piece = Problem(problem.system, problem.t0, float(times[-1]), start, times, backend=problem.backend)
        found = np.asarray(integrator.run(piece).y, dtype=float).reshape(len(times), len(again), d2)
        index = np.searchsorted(sign * times, sign * goal[again], "right") - 1
        t[again], y[again] = times[index], found[index, np.arange(len(again))]
    return t, y


def _increment(
    system: HamiltonianSystem, t: np.ndarray, y: np.ndarray, h: np.ndarray, first: np.ndarray | None = None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The mean slope of steps h (...) of DOP853 from states (..., 2d) at t (...), and its slopes; `first` if known."""
    from scipy.integrate import DOP853

    K = [system.vector_field(y, t) if first is None else first]
    for c, row in zip(DOP853.C[1:], DOP853.A[1 : len(DOP853.B)], strict=False):
        stage = y + h[..., None] * sum(a * k for a, k in zip(row, K, strict=False) if a)
        K.append(system.vector_field(stage, t + c * h))
    return sum(b * k for b, k in zip(DOP853.B, K, strict=True) if b), K


def _end_of_solution(
    system: HamiltonianSystem, t: np.ndarray, y: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times at which solutions from y (n, 2d) at t (n,) become infinite, or NaN; which reach `end`; which are open."""
    from scipy.integrate import DOP853

    n, d, begin = len(t), system.ndof, t.copy()
    h = (end - t) / 100
    f = system.vector_field(y)
    running = np.isfinite(y).all(-1) & np.isfinite(f).all(-1) & (h != 0)  # of ẏ not finite no step is ever good
    stuck, passed, refused = (np.zeros(n, dtype=bool) for _ in range(3))
    history = [(t.copy(), _sizes(y, d))]
    for _ in range(MOST_TRIED):
        i = np.flatnonzero(running)
        if not len(i):
            break
        step = h[i, None]
        slope, K = _increment(system, t[i], y[i], h[i], f[i])
        y_new = y[i] + step * slope
        K.append(system.vector_field(y_new))
        scale = RTOL * np.repeat(np.maximum(_sizes(y[i], d), _sizes(y_new, d)), d, axis=1)
        scale[scale == 0] = RTOL
        e5, e3 = (((step * sum(e * k for e, k in zip(E, K, strict=True))) / scale) for E in (DOP853.E5, DOP853.E3))
        s5, s3 = (e5**2).mean(-1), (e3**2).mean(-1)
        error = np.where(s5 + s3 == 0, 0.0, s5 / np.sqrt(s5 + 0.01 * s3))
        good = (error <= 1) & np.isfinite(y_new).all(-1) & np.isfinite(K[-1]).all(-1)
        t[i[good]] += h[i[good]]
        y[i[good]], f[i[good]] = y_new[good], K[-1][good]
        factor = np.where(np.isfinite(error), np.clip(0.9 * np.maximum(error, 1e-16) ** -0.125, 0.2, 5.0), 0.1)
        h[i] *= np.where(good & ~refused[i], factor, np.minimum(factor, np.where(good, 1.0, 0.9)))
        refused[i] = ~good
        left = end[i] - t[i]
        passed[i] = done = left * np.sign(h[i]) <= 1e-14 * np.abs(end[i])
        h[i] = np.where(np.abs(h[i]) > np.abs(left), left, h[i])
        stuck[i] = still = ~done & (np.abs(h[i]) <= SHORT * np.abs(t[i] - begin[i]) + 4 * np.spacing(np.abs(t[i])))
        running[i] = ~(done | still)
        history.append((t.copy(), _sizes(y, d)))
    times = np.array([a for a, _ in history])
    sizes = np.array([s for _, s in history])
    before = np.abs(times - t) / np.maximum(np.abs(t - begin), 1e-300)
    near, nearer = (np.argmax(before <= part, axis=0) for part in (NEAR, NEARER))
    grown = (sizes[nearer, np.arange(n)] > GROWTH * sizes[near, np.arange(n)]).any(-1)
    return np.where(stuck & grown, t, np.nan), passed, running


def _sizes(y: Array, d: int) -> np.ndarray:
    """The largest |q_i| and |p_i|: (n, 2)."""
    return np.stack([np.abs(y[..., :d]).max(-1), np.abs(y[..., d:]).max(-1)], axis=-1)


def note_singularities_of_rows(sol: Any, integrator: Integrator, problem: Problem, rows: ParameterRows) -> None:
    """Note when solutions with parameters of their own become infinite, of the first `MOST_DIAGNOSED` that fail."""
    status = np.asarray(sol.status)
    failed, times = np.flatnonzero(status < 0), np.full(len(status), np.nan)
    for few, system, _ in itertools.islice(rows.taken(failed).distinct(), MOST_DIAGNOSED):
        i = failed[few]
        stats = {name: value[i] if isinstance(value, np.ndarray) else value for name, value in sol.stats.items()}
        outcome = Outcome(sol.t, np.moveaxis(sol.y[i], -1, 0), status[i], "", stats)
        note_singularities(
            outcome, integrator, replace(problem, system=system, y0=problem.y0[i], parameter_values=None)
        )
        times[i] = outcome.stats.get("blow_up_time", np.nan)
    if np.isfinite(times).any():
        sol.stats["blow_up_time"] = times
        first = int(np.argmax(np.isfinite(times)))
        sol.message += f" A solution itself becomes infinite, at about t = {times[first]:.10g}: end `t_span` before."


def warn_of_leap(outcome: Outcome, system: HamiltonianSystem, y0: Array) -> bool:
    """Warn, and return True, of a run that leapt over a singularity of V, and goes on with any energy."""
    n, width = len(outcome.t), 2 * system.ndof
    if not n:
        return False
    starts, outputs = to_numpy(y0).reshape(-1, width), to_numpy(outcome.y).reshape(n, -1, width)
    n_steps = outcome.stats.get("n_steps", 0)
    leapt_of = partial(system.definition.leapt, n_steps=n_steps, conserves=system.keeps_energy)
    leapt = leapt_of(starts, outputs[-1])
    if not leapt.any():
        return False
    row = int(np.argmax(leapt))
    start, along = starts[row], outputs[:, row]
    first = int(np.argmax(leapt_of(np.broadcast_to(start, along.shape), along)))
    with np.errstate(all="ignore"):
        H0, H = system.hamiltonian(np.stack([start, along[-1]]))
    after = f"between t = {outcome.t[first - 1]:.10g} and {outcome.t[first]:.10g}" if first else "by the first output"
    which = "" if len(leapt) == 1 else f" of trajectory {row}, the first of {leapt.sum()},"
    warn(
        f"The energy{which} went from {H0:.6g} to {H:.6g} over a singularity of V, and the run is meaningless after "
        f"that. It was lost {after}, where {system.definition.leap(along[first], start)}.",
        RuntimeWarning,
    )
    return True
