"""Clocks: the times in which the steps of a method are equal, and runs in the physical time t.

On the physical clock the steps are those of the grid t0 + k·dt. On the logarithmic one they are equal in the time s of
the logarithmic Hamiltonian; t is a coordinate of the transformed system, whose value at the end of a step is what the
method makes it. A state at a given time is a shorter step from the last state before it, of the length σ
that solves t(σ) = t, to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sympflow.arguments import check_array
from sympflow.arrays import Array, to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import default_shift, lifted, projected, time_scale, time_transformed
from sympflow.integrators.contract import Failure, Outcome, Problem, Steps, finished
from sympflow.integrators.grid import Grid
from sympflow.integrators.grid_runs import Run, broken_off
from sympflow.integrators.interpolants import DenseOutput
from sympflow.integrators.steppers import Stepper
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.lazy import kept

LARGEST_CHUNK = 2**20  # numbers in one chunk of states
FIRST_CHUNK = 2**16  # steps, at most, before it is known how fast time goes
LONGEST_STRIDE = 64  # steps from one state that a compiled run keeps to the next, where few outputs are wanted
MOST_KEPT = 100_000_000  # numbers that a run may store where every step is an output
FEW_EVALUATIONS = 20_000  # of forces on arrays, half a second, before a run whose time hardly advances is ended;
EVALUATIONS_EACH = 50  # and these for each step of the physical length dt within the interval,
STEPS_EACH = 6  # or as many as so many steps take
COMPILED_FOR_ONE = 10  # compiled evaluations that are allowed for one on arrays, which takes a thousand times longer
_transformed = kept(time_transformed)
scale_of = kept(time_scale)
"""ds/dt where the kinetic energy is c − E, at the energy E of the system's y0, of a system and c."""


def transformed_system(system: HamiltonianSystem, shift: float | None) -> HamiltonianSystem:
    """Return the transformed system, made once for each c."""
    c = default_shift(system) if shift is None else float(shift)
    return _transformed(system, c)


ARRAYS_ONLY = (
    "finds its outputs by root-finding on NumPy arrays: pass y0.numpy(), or solve time_transformed(system), which "
    "takes tensors"
)


class LogarithmicClock(NamedTuple):
    """A method with equal steps in s, on one system."""

    method: Any
    system: HamiltonianSystem
    transformed: HamiltonianSystem
    dt: float
    new_step: float

    @property
    def shift(self) -> float:
        """c, of the transformed system."""
        return self.transformed.params["shift"]

    def step(self, y: Array, h: float | Array, t: Any = 0.0) -> Array:
        """One step of the physical length h, with B = c − H(y)."""
        rows, lengths = _rows(y, h)
        return projected(self._reached(lifted(self.system, rows, self.shift), lengths)[0]).reshape(y.shape)

    def inverse(self, y: Array, h: float | Array, t: Any = 0.0) -> Array:
        """The states from which `step` leads to y."""
        rows, lengths = _rows(y, h)
        system, c = self.system, self.shift
        x, B = rows, c - system.hamiltonian(rows)
        for _ in range(100):  # B belongs to the state that is sought: a contraction, for the step changes H little
            x = projected(self._reached(lifted(system, rows, c, B), -lengths)[0])
            before, B = B, c - system.hamiltonian(x)
            if not (np.abs(B - before) > 2 * np.finfo(rows.dtype).eps * (np.abs(B) + np.abs(c - B))).any():
                break
        return x.reshape(y.shape)

    def tangent(self, y: Array, h: Array, t: Any = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """The step and its Jacobian in [q, p], the realised step in s and B held fixed."""
        rows, lengths = _rows(to_numpy(y), h)
        end, sigma = self._reached(start := lifted(self.system, rows, self.shift), lengths)
        _, A = self.method.inner.tangent(self.transformed, 0.0, start, sigma)
        d = self.system.ndof
        keep = np.r_[0:d, d + 1 : 2 * d + 1]
        return projected(end).reshape(y.shape), A[:, keep][:, :, keep].reshape(*y.shape, 2 * d)

    def _reached(self, start: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The states a physical time h after `start` by one step each, and its length σ in s."""

        def step(sigma: np.ndarray) -> np.ndarray:
            return np.asarray(self.method.inner.step(self.transformed, 0.0, start, sigma))

        d = self.system.ndof
        with np.errstate(all="ignore"):
            speed = self.shift - to_numpy(self.system.potential(start[:, :d]))
            longest = h * speed
            for _ in range(60):  # a length beyond the one that is sought
                short = (step(longest)[:, d] - h) * np.sign(h) < 0
                if not short.any():
                    break
                longest = np.where(short, 2 * longest, longest)
            return reach(step, start, longest, h, h * speed)

    def run(self, problem: Problem) -> Outcome:
        """Solve the problem."""
        self.method.check_library(problem.y0)
        return PhysicalRun(self, problem).outcome()

    def steps(self, t_span: tuple[float, float], y0: Array) -> Steps:
        """The steps of the run, their physical lengths; in a batch, trajectories that have ended get length 0."""
        run = PhysicalRun(self, Problem(self.system, *t_span, y0))
        run.stride = 1
        sign, batch = run.sign, y0.shape[:-1]
        for states, last in run.chunks():
            t = run.sign * states[..., self.system.ndof]
            t = np.minimum(t, abs(t_span[1] - t_span[0]))
            n = int(last.max())
            index = np.minimum(np.arange(n + 1), last[:, None])
            t, x = np.take_along_axis(t, index, 1), np.take_along_axis(states, index[..., None], 1)
            shape = (n, *batch)
            y = projected(x[:, :-1]).swapaxes(0, 1).reshape(*shape, -1)
            yield t_span[0] + sign * t[:, :-1].T.reshape(shape), y, sign * np.diff(t, axis=1).T.reshape(shape)


def _rows(y: Array, h: Any) -> tuple[np.ndarray, np.ndarray]:
    """States as rows, and a length for each."""
    check_array(y, "the logarithmic methods step NumPy arrays")
    rows = np.asarray(y).reshape(-1, y.shape[-1])
    return rows, np.broadcast_to(np.asarray(h, dtype=rows.dtype), y.shape[:-1]).reshape(-1)


@lru_cache(maxsize=256)
def physical_length(h: float, scale: float, clock: tuple[float, ...]) -> float:
    """The physical length of a step h in the new time where the kinetic energy is B = scale/2: h/scale."""
    square, total = h * h * scale / 2, 0.0
    for c in clock:
        total = total * square + c
    return h / scale + h * h * h * total


@lru_cache(maxsize=256)
def step_of_length(length: float, scale: float, clock: tuple[float, ...]) -> float:
    """The step h of that `physical_length`, if it is at most the one for which the clock was trained."""
    h = length * scale
    for _ in range(100 if clock else 0):  # a contraction, for the clock adds little
        before, h = h, h - scale * (physical_length.__wrapped__(h, scale, clock) - length)
        if abs(h - before) <= 1e-15 * h:
            break
    return h


def reach(
    step: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    longest: np.ndarray,
    target: np.ndarray,
    guess: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The states step(σ), σ from 0 to `longest`, whose time is `target`, and σ: the secant method within brackets."""
    d = start.shape[1] // 2 - 1
    eps = float(np.finfo(start.dtype).eps)
    tolerance = 4 * eps * np.maximum(np.abs(target), np.abs(start[:, d]))
    low, high = np.zeros_like(longest), longest.copy()
    sign = np.sign(longest)
    sigma = np.where((guess - low) * sign < 0, low, np.where((guess - high) * sign > 0, high, guess))
    best, best_sigma, best_residual = start.copy(), np.zeros_like(sigma), np.abs(start[:, d] - target)
    last_sigma, last_t = np.zeros_like(sigma), start[:, d].copy()
    for _ in range(80):
        x = step(sigma)
        residual = x[:, d] - target
        better = (np.abs(residual) < best_residual) & (best_residual > tolerance)  # others are done
        best[better], best_sigma[better], best_residual[better] = x[better], sigma[better], np.abs(residual)[better]
        if not (best_residual > tolerance).any():
            break
        beyond = ~(residual * sign < 0)  # NaN counts as too far
        high, low = np.where(beyond, sigma, high), np.where(beyond, low, sigma)
        slope = (x[:, d] - last_t) / (sigma - last_sigma)  # the first time of the chord of the step so far
        rate = np.where(np.isfinite(slope) & (slope > 0), slope, np.inf)
        secant = sigma - residual / rate
        inside = ((secant - low) * sign > 0) & ((high - secant) * sign > 0)
        last_sigma, last_t = sigma, x[:, d].copy()
        sigma = np.where(inside & np.isfinite(secant), secant, (low + high) / 2)
    best[best_residual > np.maximum(1e-3 * np.abs(target - start[:, d]), 100 * tolerance)] = np.nan  # no such σ
    return best, best_sigma


class PhysicalRun(Run):
    """A run in chunks of steps that are equal in s, until the physical end is passed."""

    def __init__(self, clock: LogarithmicClock, problem: Problem) -> None:
        super().__init__(clock.method, problem, clock.dt)
        self.clock, self.system, self.transformed = clock, problem.system, clock.transformed
        self.d, c = self.system.ndof, clock.shift
        rows = problem.y0.reshape(-1, problem.y0.shape[-1])
        with np.errstate(all="ignore"):
            gap = np.asarray(c - self.system.potential(rows[:, : self.d]))
            self.start = lifted(self.system, rows, c)
        if (gap <= 0).any():
            i = int(np.argmax(gap <= 0))
            with np.errstate(all="ignore"):
                energy = float(self.system.hamiltonian(rows[i]))
            if not np.isfinite(energy):
                raise ValueError(f"`y0` has the energy {energy:g}: give a state of a finite one.")
            raise ValueError(
                f"`shift` {c:g} does not exceed the potential at `y0`, {c - gap[i]:g}: give one above the energy "
                f"{energy:g}, so that c − V stays positive."
            )
        self.length = abs(problem.t1 - problem.t0)
        self.sign = 1.0 if problem.t1 >= problem.t0 else -1.0
        if self.length:
            Grid(problem.t0, problem.t1, clock.dt)  # refuses a dt of too many steps
        self.h = self.sign * clock.new_step
        compiled = problem.backend != "array" and problem.y0.dtype == np.float64 and self.system.written is not None
        stages = max(1, round(sum(clock.method.evaluations(1000, 0, 0, "numpy").values()) / 1000))
        allowed = FEW_EVALUATIONS / stages + max(EVALUATIONS_EACH / stages, STEPS_EACH) * self.length / self.dt
        self.most_steps = int((COMPILED_FOR_ONE if compiled else 1) * allowed)
        """Steps after which time hardly advances: before a collision they would never end."""
        self.n_steps, self.n_extra = np.zeros(len(rows), dtype=int), 0
        self.stepper = self._stepper()
        self.elapsed, self.done = np.zeros(len(rows)), 0.0
        self.failed_at = np.full(len(rows), np.nan)
        self.stalled = np.zeros(len(rows), dtype=bool)
        times = problem.t_eval
        if times is None and problem.y0.ndim > 1:  # the trajectories take different steps: report on a common grid
            times = Grid(problem.t0, problem.t1, clock.dt).outputs(None, problem.save_every)
        self.times: np.ndarray | None = times
        """The times of outputs; None for those of the steps of a single trajectory."""
        self.wanted = np.empty(0) if times is None else (times - problem.t0).astype(self.start.dtype)
        self.out = np.full((len(self.wanted), len(rows), 2 * self.d), np.nan, dtype=self.start.dtype)
        self.out[self.wanted == 0] = projected(self.start)
        self.delivered = np.full(len(rows), int((self.wanted == 0).sum()))
        self.kept: list[tuple[np.ndarray, np.ndarray]] = []
        if len(self.wanted) and not problem.dense_output:
            self.length = abs(float(self.wanted[-1]))  # nothing is asked for beyond
        self.stride = 1
        """Steps from one state of a chunk to the next: those between are made again where an output is due."""
        if self.stepper.compiled and times is not None and not problem.dense_output:
            self.stride = int(min(max(1.0, self.length / self.dt / (len(times) + 1)) ** 0.5, LONGEST_STRIDE))

    def _stepper(self) -> Stepper:
        clock, start = self.clock, self.start[0] if len(self.start) == 1 else self.start
        return clock.method.inner.stepper(Problem(clock.transformed, 0.0, self.h, start, backend=self.problem.backend))

    def __getstate__(self) -> dict[str, Any]:
        """All but the stepper, whose compiled loops belong to a process, and a function that is told of progress."""
        problem = replace(self.problem, progress=None)
        return {name: x for name, x in vars(self).items() if name != "stepper"} | {"problem": problem}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)
        self.stepper = self._stepper()

    def chunks(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Chunks of states (N, m + 1, 2d + 2), and the last one (N,) of each trajectory, at or past its end."""
        x, rows, carry = self.start, np.arange(len(self.start)), RunCheckpoint()
        n = self._chunk(1.1 * self.length / self.dt + 2, FIRST_CHUNK)
        running = np.full(len(x), self.length > 0)
        while running.any():
            m = -(-min(n, max(1, self.most_steps - carry.steps)) // self.stride)
            before = carry.steps, carry.running
            states, good = np.zeros((len(x), m + 1, x.shape[1]), x.dtype), np.zeros(len(x), dtype=int)
            states[:, 0] = x
            states[running, 1:], good[running] = self._steps(x, running, m, carry)
            t = self.sign * states[..., self.d]
            forward = t[:, 1:] >= t[:, :-1]
            good = np.minimum(good, np.where(forward.all(1), m, np.argmin(forward, axis=1)))  # time must not turn
            passed = (t >= self.length) & (np.arange(m + 1) <= good[:, None])
            ends = running & passed.any(1)
            last = np.where(ends, passed.argmax(1), np.where(running, good, 0))
            lost = running & ~ends & (good < m)
            if self.stride > 1 and lost.any():  # their ends are found step by step
                self.stride = 1
                carry.advance(*before)
                n = self._chunk(n, n)
                continue
            if carry.steps >= self.most_steps:
                self.stalled = running & ~ends & ~lost
                lost |= self.stalled
            self.n_steps += last * self.stride
            if self.stride > 1 and ends.any():
                self.n_steps[ends] -= self.stride - self._within(states[ends, last[ends] - 1], self.length)[1] - 1
            self.elapsed = np.nan_to_num(t[rows, last], posinf=np.inf)  # 0 of a start that is not finite
            self._end(lost)
            yield states, last
            paces = np.where(running, (t[rows, last] - t[:, 0]) / np.maximum(last * self.stride, 1), np.nan)
            pace = np.fmin.reduce(paces)  # of those that are numbers, if any is
            go_on = running & ~ends & ~lost
            if len(rows) > 1 and carry.running is not None:
                carry.running = carry.running[go_on[running]]
            running = go_on
            x = states[rows, last]
            left = (self.length - self.elapsed[running]).max(initial=0.0)
            n = self._chunk(1.02 * left / pace + 2 if pace > 0 else np.inf, 4 * n)

    def _end(self, rows: np.ndarray) -> None:
        """Note that trajectories end where they are."""
        self.failed_at[rows] = self.problem.t0 + self.sign * self.elapsed[rows]

    def _chunk(self, steps: float, most: int) -> int:
        """The number of steps of a chunk that is to have so many, or the most that there may be."""
        largest = self.stride * LARGEST_CHUNK // self.start.size
        return int(min(max(16, steps if steps < most else most) + 1, max(16, largest)))

    def _steps(self, x: np.ndarray, rows: np.ndarray, m: int, carry: RunCheckpoint) -> tuple[np.ndarray, np.ndarray]:
        """The next m states of some rows, which go on from the carry and are at x, and the last finite ones."""
        begun, n = carry.steps, m * self.stride
        start, going = (self.start, carry) if self.stepper.takes_carry else (x, RunCheckpoint())
        save, alone = np.arange(self.stride, n + 1, self.stride) + going.steps, len(x) == 1
        found, finite = self.stepper.rollout(start[0] if alone else start[rows], self.h, save[-1], save, carry=going)
        carry.steps = begun + n
        good = (np.atleast_1d(finite) - (save[-1] - n)) // self.stride
        return (found[None] if alone else np.moveaxis(found, 0, 1)), good

    def _within(self, start: np.ndarray, target: Any) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """The states before and after the elapsed times `target`, of steps from `start` (M, 2d + 2), and how many."""
        save = np.arange(self.stride + 1)
        states = np.moveaxis(self.stepper.rollout(start, self.h, self.stride, save)[0], 0, 1)
        self.n_extra += len(start) * self.stride
        ahead = self.sign * states[..., self.d] >= np.reshape(target, (-1, 1))
        k, rows = np.where(ahead.any(1), ahead.argmax(1), self.stride).clip(1) - 1, np.arange(len(start))
        return (states[rows, k], states[rows, k + 1]), k

    def reach(self, before: np.ndarray, after: np.ndarray, target: np.ndarray) -> np.ndarray:
        """States [q, t, p, B] at the elapsed times `target`, within the steps from `before` to `after`."""

        def step(sigma: np.ndarray) -> np.ndarray:
            self.n_extra += len(sigma)
            return np.asarray(self.stepper.shorter(before, sigma))

        with np.errstate(all="ignore"):
            advance = after[:, self.d] - before[:, self.d]
            h = np.full(len(before), self.h, dtype=before.dtype)
            guess = h * (target - before[:, self.d]) / np.where(advance == 0, 1, advance)
            x, _ = reach(step, before, h, target, guess)
        at_end = after[:, self.d] == target
        x[at_end] = after[at_end]
        return x

    def windows(self) -> Iterator[float]:
        keeps = self.problem.dense_output or self.times is None
        if not keeps and (self.delivered == len(self.wanted)).all():
            return
        for states, last in self.chunks():
            if keeps:
                self.kept.append((states, last))
                if sum(states.size for states, _ in self.kept) > MOST_KEPT:
                    raise ValueError(
                        f"`t_eval` is not given, and the steps are so short that more than {MOST_KEPT:.0e} values "
                        "would be stored: choose the times with `t_eval`, leave dense_output out, or raise `dt`."
                    )
            if self.times is not None:
                self._deliver(states, last)
                if not keeps and (self.delivered == len(self.wanted)).all():
                    return
            yield self._slowest

    @property
    def _slowest(self) -> float:
        """The time that has elapsed for all trajectories that have not failed."""
        return float(np.minimum(self.elapsed, self.length)[np.isnan(self.failed_at)].min(initial=self.length))

    @property
    def reached(self) -> float:
        return self.problem.t0 + self.sign * self.done

    def stop(self) -> None:
        super().stop()
        self.done = self._slowest
        self._end(np.isnan(self.failed_at) & (self.elapsed < self.length))

    def taken(self) -> Outcome:
        problem, single = self.problem, self.problem.y0.ndim == 1
        path = _Path(self, self.kept) if self.kept or problem.dense_output else None
        if self.times is None:
            times, out = self._every_step(path)
        else:
            n = int(self.delivered.max()) if single or self.stopped else len(self.times)
            times, out = self.times[:n], self.out[:n]
        y = out.reshape(len(times), *problem.y0.shape)
        failed = np.isfinite(self.failed_at)
        n_steps = int(self.n_steps.max(initial=0))
        status: Any = -int(failed[0]) if single else np.where(failed, -1, 0).reshape(y.shape[1:-1])
        stats = self.stats(n_steps, n_steps, n_steps // self.stride, self.n_extra)
        outcome = Outcome(times, y, status, finished(problem), stats, path if problem.dense_output else None)
        if failed.any() and not self.stopped:
            stats["failed_at"] = float(self.failed_at[0]) if single else self.failed_at.reshape(y.shape[1:-1])
            i = int(np.argmax(failed))
            outcome.message = broken_off(
                Failure.STALLED if self.stalled[i] else Failure.CLOCK,
                float(self.failed_at[i]),
                failed=None if single else np.argwhere(outcome.status),
                of=len(failed),
                n_steps=self.n_steps[i],
            )
        return outcome

    def _deliver(self, states: np.ndarray, last: np.ndarray) -> None:
        """The outputs that fall into a chunk."""
        wanted, delivered, t = self.wanted, self.delivered, self.sign * states[..., self.d]
        ahead = t[np.arange(len(t)), last]
        end = np.where(last > 0, np.searchsorted(self.sign * wanted, ahead, side="right"), delivered)
        count = np.maximum(end - delivered, 0)
        row = np.repeat(np.arange(len(t)), count)
        output = np.arange(len(row)) - np.repeat(np.cumsum(count) - count - delivered, count)
        due = self.sign * wanted[output]
        if len(row) <= len(t):  # few outputs of many trajectories
            k = (np.where(np.arange(t.shape[1]) <= last[row, None], t[row], np.inf) >= due[:, None]).argmax(1)
        else:
            k = np.concatenate([t[i, : last[i] + 1].searchsorted(due[row == i]) for i in np.flatnonzero(count)])
        k = k.clip(1) - 1
        if len(row):
            ends = states[row, k], states[row, k + 1]
            if self.stride > 1:
                ends, _ = self._within(ends[0], due)
            self.out[output, row] = projected(self.reach(*ends, wanted[output]))
        self.delivered = delivered + count

    def _every_step(self, path: _Path | None) -> tuple[np.ndarray, np.ndarray]:
        """Times and states (n, 1, 2d) of every `save_every`-th step of a single trajectory, and of the end."""
        if path is None:
            return np.array([self.problem.t0]), projected(self.start)[None]
        x = path.kept[0]
        inside = self.sign * x[:, self.d] < self.length
        count = int(np.count_nonzero(inside))
        keep = np.arange(0, count, self.problem.save_every)
        t = self.problem.t0 + x[keep, self.d].astype(float)
        y = projected(x[keep])
        if np.isnan(self.failed_at[0]):
            t = np.append(t, self.problem.t1)
            y = np.concatenate([y, path(self.problem.t1).reshape(1, -1)])
        elif keep[-1] != count - 1:
            t, y = np.append(t, self.problem.t0 + x[count - 1, self.d]), np.concatenate([y, projected(x[[count - 1]])])
        return t, y[:, None]


class _Path(DenseOutput):
    """Dense output in the physical time."""

    def __init__(self, run: PhysicalRun, kept: list[tuple[np.ndarray, np.ndarray]]) -> None:
        self.run = run
        self.kept = [
            np.concatenate([run.start[i : i + 1], *(states[i, 1 : last[i] + 1] for states, last in kept)])
            for i in range(len(run.start))
        ]
        self.t_min, self.t_max = sorted((run.problem.t0, run.problem.t1))

    def states(self, times: np.ndarray) -> Array:
        run = self.run
        target = (times - run.problem.t0).astype(run.start.dtype)
        rows = []
        for x in self.kept:
            if len(x) == 1:
                rows.append(np.repeat(projected(x), len(times), axis=0))
                continue
            k = np.searchsorted(run.sign * x[:, run.d], run.sign * target, side="left").clip(1, len(x) - 1) - 1
            found = projected(run.reach(x[k], x[k + 1], target))
            found[target == 0] = projected(x[:1])
            found[run.sign * target > run.sign * x[-1, run.d]] = np.nan
            rows.append(found)
        return np.stack(rows, axis=1).reshape(len(times), *run.problem.y0.shape)
