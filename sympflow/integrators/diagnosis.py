"""The time at which the solution of a run that could not go on becomes infinite, if it does."""

from __future__ import annotations

import numpy as np
from scipy.integrate import DOP853

from sympflow.arrays import Array, to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator, Outcome, Problem

TAIL = 200  # steps before the end of a run, at least, from which the solution is followed
AHEAD = 4  # steps beyond the end: an implicit method gives up before a singularity
MOST_TRIED, MOST_ROWS, MOST_STORED = 500, 4096, 10**7  # steps of the reference; trajectories at once; numbers
RTOL = 1e-10
LOST = 0.01  # of y·∇H: a state whose energy differs by more is no longer on the solution
SHORT = 1e-11  # of the way: steps below it go on no more
NEAR, NEARER, GROWTH = 1e-3, 1e-8, 10.0
"""The state is infinite at the end if it grows by so much from this to that part of the way before it."""


def note_singularities(outcome: Outcome, integrator: Integrator, problem: Problem) -> None:
    """Add to the message, and as `stats["blow_up_time"]`, when the solution of a failed run becomes infinite.

    The method's own last states tell little of when: a step leaps over a singularity and is finite for a while beyond
    it, and one beyond the method's limit grows without a singularity. So the solution is followed again, by steps of
    order 8 that are adapted to a tolerance, from y0; where the end is not reached in `MOST_TRIED` of them, from a state
    some hundred steps before it, if that still has the energy of y0. The solution is singular where the steps become
    too short to move t while the state grows without bound. Nothing is said where that is not settled, or the functions
    of the system do not take NumPy arrays, or it has friction or is driven, with which energy tells nothing.

    `blow_up_time` is an estimate. In a batch it is an array, NaN for
    the trajectories that have none; without any it is left out.
    """
    _note_last_state(outcome, problem)
    if not (problem.system.conservative and problem.system.autonomous):  # a state of the solution is told by its energy
        return
    y0 = to_numpy(problem.y0)
    failed = (np.atleast_1d(np.asarray(outcome.status)) < 0).reshape(-1)
    last = outcome.t[-1] if len(outcome.t) else problem.t0
    failed_at = np.broadcast_to(np.asarray(outcome.stats.get("failed_at", last), dtype=float), y0.shape[:-1])
    rows = np.flatnonzero(failed & np.isfinite(failed_at).reshape(-1))
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
    remark = problem.system.remark(y[:d])
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
    """Times (n,) and states (n, 2d), `TAIL` to 2·`TAIL` steps before the end where `wanted`; else the beginning.

    From the outputs where they hold one, and else by executing the run again from its beginning, bit by bit the same:
    from elsewhere a chaotic orbit would take another course.
    """
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


def _end_of_solution(
    system: HamiltonianSystem, t: np.ndarray, y: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solutions from y (n, 2d) at t (n,) to `end`: where they become infinite, else NaN; which go on; which are open.

    Open are those whose steps are spent. By Dormand and Prince's method of order 8, each with steps of its own.
    """
    A, B, E3, E5 = DOP853.A, DOP853.B, DOP853.E3, DOP853.E5
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
        step, K = h[i, None], [f[i]]
        for row in A[1 : len(B)]:
            K.append(system.vector_field(y[i] + step * sum(a * k for a, k in zip(row, K, strict=False) if a)))
        y_new = y[i] + step * sum(b * k for b, k in zip(B, K, strict=True) if b)
        K.append(system.vector_field(y_new))
        scale = RTOL * np.repeat(np.maximum(_sizes(y[i], d), _sizes(y_new, d)), d, axis=1)
        scale[scale == 0] = RTOL
        e5, e3 = (((step * sum(e * k for e, k in zip(E, K, strict=True))) / scale) for E in (E5, E3))
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
