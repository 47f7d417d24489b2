"""Compiled runs of equal steps in another time, up to physical times.

States are [q, t, p, B] of a logarithmic Hamiltonian. Elapsed times are positive: t is multiplied by the sign of the
step. The change that a trained clock adds to t at each step is constant along a run, for B is: it is added where a time
is needed.

A run looks at the time after each `stride` steps, a single one seldomer far from an output. If an output is due since,
they are made again, one by one, and a last step is shortened until its time is the one that is wanted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from sympflow.compiler.control import DOUBLE, INT, POINTER, Code, Module, Type, Value, Variable
from sympflow.compiler.machine import host
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.runs import ColumnStage, Lanes, assign, finished, groups, there
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.kernels.splittings import SplittingCode
from sympflow.kernels.stages import run_table, step_table
from sympflow.kernels.threads import run_one, run_rows
from sympflow.schemes import Scheme

__all__ = ["lifted_rows", "reach_times"]

FEWEST, MANY = 1000, 8.0  # steps after which a run is given up: these, and so many times the expected ones
EPS = 2.0**-52
MOST_TRIALS = 80
MOST_AT_ONCE = 1024  # steps between two looks
CLOSE = 1e-3  # of the elapsed time, beyond which a residual means that no step leads to that time
LANES = 16  # trajectories side by side, in two registers or four, so that one need not wait for the other


def reach_times(
    system: HamiltonianSystem,
    scheme: Scheme,
    h: float,
    y0: np.ndarray,
    times: np.ndarray,
    stride: int,
    expected: float,
    clock: Sequence[float] = (),
) -> tuple[np.ndarray, np.ndarray] | None:
    """The states at elapsed times of a scheme with equal steps on a logarithmic Hamiltonian, each by a shorter step.

    Parameters
    ----------
    system : HamiltonianSystem
        The transformed one, symbolic, with states [q, t, p, B]; the scheme has no force gradients.
    h : float
        Step in the other time, negative to go back.
    y0 : ndarray of shape (N, 2d + 2)
        With t = 0.
    times : ndarray of shape (n,)
        Elapsed ones, increasing, positive for every sign of h.
    stride : int
        Steps between two looks at the time.
    expected : float
        Steps that a run takes, roughly; after many more it is given up.
    clock : sequence of float
        Of a trained clock: the numbers c_k of what it adds to t in a step s, Σ_k c_k s^(3+2k) B^k, the last one first.

    Returns
    -------
    [q, p] of shape (n, N, 2d), and counts (N, 2) of the steps taken and those tried to meet the times; None where a
    trajectory does not reach its times: because a state is not finite, time turns, or steps run out.
    """
    loops = splitting_loops(system)
    found = loops.functions(0, False)
    if not isinstance(found, SplittingCode):
        return None
    (table, kinds), step = found.prepared(loops.rows(run_table(scheme, h))), _step(scheme, loops.values)
    n_rows, width = len(y0), 1 if len(y0) == 1 else LANES
    function = found.kept(("reach", width), lambda: _compiled(found, width))
    out, counts = np.empty((len(times), n_rows, y0.shape[1] - 2)), np.zeros((n_rows, 2), dtype=np.int64)
    most, work = int(FEWEST + MANY * expected), int(expected * len(kinds) * system.ndof)
    numbers, y0, times = np.array(clock, dtype=float), np.ascontiguousarray(y0), np.ascontiguousarray(times)
    reached: list[int] = []

    def rows(i: slice, stop: np.ndarray) -> None:
        done = np.zeros(1, dtype=np.int64)
        start, begin, end = y0[i], counts[i], out[:, i]
        arrays = (table, kinds, step, numbers, start, times, end, begin, stop, done)
        at = [x.ctypes.data for x in arrays]
        sizes = len(kinds) - 2, len(step), len(numbers), len(start), n_rows, len(times), stride, most
        function(*at, *sizes, h)
        reached.append(int(done[0]))

    if n_rows == 1:
        run_one(lambda stop: rows(slice(0, 1), stop), work)
    else:
        run_rows(rows, n_rows, work, None)
    return (out, counts) if all(reached) else None


def lifted_rows(system: HamiltonianSystem, y: np.ndarray, c: float) -> np.ndarray | None:
    """States [q, t, p, B] (N, 2d + 2) with t = 0 and B = c − H of rows of `y` (N, 2d) of a symbolic system.

    None unless c exceeds V at all of them.
    """
    d = system.ndof
    with np.errstate(all="ignore"):
        if not (np.asarray(system.potential(y[:, :d])) < c).all():
            return None
        B = c - np.asarray(system.hamiltonian(y))
    return np.column_stack([y[:, :d], np.zeros(len(y)), y[:, d:], B])


@lru_cache(maxsize=256)
def _step(scheme: Scheme, values: tuple[float, ...]) -> np.ndarray:
    """The given numbers (m, n) of the columns of one step for h = 1."""
    numbers = step_table(scheme).packed[..., 0].T
    return np.ascontiguousarray(np.column_stack([numbers, *[np.full(len(numbers), v) for v in values]]))


def _compiled(made: SplittingCode, width: int) -> Callable[..., None]:
    code = Module(host().fused).function("reach", [POINTER] * 10 + [INT] * 8 + [DOUBLE])
    _Reach(code, made, width).write()
    return finished(code, [POINTER] * 10 + [INT] * 8 + [DOUBLE])


class _Reach:
    """The code of runs up to times, `width` trajectories side by side."""

    def __init__(self, code: Code, made: SplittingCode, width: int) -> None:
        self.code, self.made, self.width = code, made, width
        self.table, self.kinds, self.step, self.clock, self.rows = code.arguments[:5]
        self.targets, self.out, self.counts, self.stop, self.done = code.arguments[5:10]
        self.link, self.n_columns, self.n_clock, self.n_rows, self.total = code.arguments[10:15]
        self.n_targets, self.stride, self.most, self.h = code.arguments[15:]
        self.n_values, self.time = made.n_values, made.n_values // 2 - 1
        self.zero, self.one = code.constant(0, INT), code.constant(1, INT)
        self.sign = code.select(self.h < 0.0, code.constant(-1.0), code.constant(1.0))

    def write(self) -> None:
        code = self.code
        code.store(self.one, self.done)
        with code.over(groups(code, self.n_rows, self.width)) as group:
            self._group(group * self.width)

    def _group(self, begin: Value) -> None:
        """The runs of some trajectories, until each is at its last time."""
        code, width, type = self.code, self.width, Type("double", self.width)
        state = [code.variable(x) for x in Lanes(code, self.n_values, width).loaded(self.rows, begin, self.n_rows)]
        column = ColumnStage(code, self.table, self.kinds, self.made.size, 1, width, self.made.stage)
        start, advance, then = code.memory(self.n_values, type), code.memory(1, type), code.memory(1, type)
        saved, now = code.memory(width, INT), code.memory(width)
        of_clock = self._advance(code.splat(self.h, width), state[-1].value)
        code.store(of_clock, advance)
        with code.over(code.constant(width, INT)) as lane:
            code.store(self.zero, saved, lane)
            code.store(code.constant(0.0), now, lane)
        left, fine = code.variable(there(code, width, begin, self.n_rows)), code.variable(code.constant(1, Type("i1")))
        n, j = code.variable(self.zero), code.variable(self.zero)
        with code.during(lambda: fine.value & (self.zero < left.value)):
            block = code.apply("min", (self._block(saved, now, n.value), self.most - n.value))
            fine.value = fine.value & (self.zero < block)
            for i, x in enumerate(state):
                code.store(x.value, start, i * width)
            first = j.value
            with code.over(block * self.link):
                assign(state, column(j.value, [x.value for x in state], self.zero))
                j.value = self._following(j.value)
            end = column(self.link + 1, [x.value for x in state], self.zero)
            code.store(self._elapsed(end, n.value + block, of_clock), then)
            with code.over(there(code, width, begin, self.n_rows)) as lane, code.given(self._waits(saved, lane)):
                reached = code.load(then, lane)
                fine.value = fine.value & (code.load(now, lane) <= reached)
                with code.given(fine.value & (self._target(code.load(saved, lane, INT)) <= reached)):
                    lane_start = [code.load(start, lane + i * width) for i in range(self.n_values)]
                    given = first, n.value, block, reached, code.load(advance, lane), saved, begin, lane
                    fine.value = fine.value & self._deliver(lane_start, *given)
                code.store(reached, now, lane)
                left.value = code.select(self._waits(saved, lane), left.value, left.value - 1)
            n.value = n.value + block
            fine.value = fine.value & code.apply("eq", (code.load(self.stop, 0, INT, shared=True), self.zero))
        with code.given(self.zero < left.value):
            code.store(self.zero, self.done)

    def _block(self, saved: Value, now: Value, n: Value) -> Value:
        """Steps to the next look: of a single run far from its next output, half of those left, by the pace so far."""
        if self.width > 1:
            return self.stride
        code, t = self.code, self.code.load(now, 0)
        pace = (self._target(code.load(saved, 0, INT)) - t) / t * (0.5 * code.convert("sitofp", n, "double"))
        far = code.convert("fptosi", code.apply("min", (pace, code.constant(float(MOST_AT_ONCE)))), "i64")
        return code.select(t > 0.0, code.apply("max", (self.stride, far)), self.stride)

    def _following(self, j: Value) -> Value:
        return self.code.select(self.code.apply("eq", (j, self.link)), self.one, j + 1)

    def _target(self, k: Value) -> Value:
        """The time of output k; behind the last, that of the first."""
        return self.code.load(self.targets, self.code.select(k < self.n_targets, k, self.zero))

    def _waits(self, saved: Value, lane: Value) -> Value:
        return self.code.load(saved, lane, INT) < self.n_targets

    def _elapsed(self, x: Sequence[Value], n: Value, advance: Value) -> Value:
        """The elapsed time of a state after n steps; NaN where one of its numbers is not finite."""
        code, width = self.code, x[0].type.width
        zero = code.constant(0.0, x[0].type)
        total = x[self.time] + code.splat(code.convert("sitofp", n, "double"), width) * advance
        total = total * code.splat(self.sign, width)
        for value in x:
            total = code.fma(value, zero, total)
        return total

    def _advance(self, s: Value, B: Value) -> Value:
        """Σ_k c_k s^(3+2k) B^k of the numbers of the clock."""
        code = self.code
        square, total = s * s * B, code.variable(code.constant(0.0, s.type))
        with code.over(self.n_clock) as k:
            total.value = total.value * square + code.splat(code.load(self.clock, k), s.type.width)
        return s * s * s * total.value

    # one trajectory -----------------------------------------------------------------------------------------------

    def _deliver(
        self,
        start: list[Value],
        first: Value,
        n: Value,
        block: Value,
        end: Value,
        advance: Value,
        saved: Value,
        begin: Value,
        lane: Value,
    ) -> Value:
        """Make the outputs until the elapsed time `end`, within `block` steps from the running state after n.

        False if one of them is not reached.
        """
        code = self.code
        column = ColumnStage(code, self.table, self.kinds, self.made.size, 1, 1, self.made.stage)
        state, before = [code.variable(x) for x in start], [code.variable(x) for x in start]
        with code.given(self.zero < n):
            assign(before, column(self.link + 1, start, self.zero))
        j, k, s = code.variable(first), code.variable(self.zero), code.variable(code.load(saved, lane, INT))
        found, row = code.variable(code.constant(1, Type("i1"))), begin + lane

        def due() -> Value:
            return (s.value < self.n_targets) & (self._target(s.value) <= end)

        with code.during(lambda: found.value & due() & (k.value < block)):
            with code.over(self.link):
                assign(state, column(j.value, [x.value for x in state], self.zero))
                j.value = self._following(j.value)
            after = column(self.link + 1, [x.value for x in state], self.zero)
            t = (
                self._elapsed([x.value for x in before], n + k.value, advance),
                self._elapsed(after, n + k.value + 1, advance),
            )
            last = code.apply("eq", (k.value + 1, block))
            with code.during(lambda: found.value & due() & ((self._target(s.value) <= t[1]) | last)):
                at, target = [code.variable(x) for x in after], self._target(s.value)
                with code.given(~code.apply("eq", (target, t[1]))):
                    found.value = self._step_to(at, [x.value for x in before], *t, target, row)
                place = code.at(self.out, (s.value * self.total + row) * (self.n_values - 2))
                for i, x in enumerate(x for i, x in enumerate(at) if i not in (self.time, self.n_values - 1)):
                    code.store(x.value, place, i)
                code.store(n + k.value + 1, self.counts, row * 2)
                s.value = s.value + 1
            assign(before, after)
            k.value = k.value + 1
        code.store(s.value, saved, lane)
        return found.value

    def _step_to(
        self, best: list[Variable], start: list[Value], before: Value, after: Value, target: Value, row: Value
    ) -> Value:
        """The state after a step whose time is the `target`, by secants within brackets; False if none leads there.

        The times of the start and of a whole step are `before` and `after`.
        """
        code, none = self.code, self.code.constant(0.0)
        longest = code.apply("abs", (self.h,))
        tolerance = code.apply("max", (target, before)) * (2.0 * EPS)
        low, high, last_sigma, last_t = (code.variable(x) for x in (none, longest, none, before))
        guess = code.select(before < after, longest * (target - before) / (after - before), none)
        sigma = code.variable(code.apply("min", (code.apply("max", (guess, none)), longest)))
        assign(best, start)
        residual_of_best = code.variable(code.apply("abs", (before - target,)))
        trials = code.variable(self.zero)
        open_ = code.variable(code.constant(1, Type("i1")))
        with code.during(lambda: open_.value & (trials.value < MOST_TRIALS)):
            trials.value = trials.value + 1
            s = sigma.value
            x = self._short_step(start, self.sign * s)
            gone = x[self.time] - start[self.time] + self._advance(self.sign * s, start[-1])
            now = before + self.sign * gone
            residual = now - target
            size = code.apply("abs", (residual,))
            with code.given(size < residual_of_best.value):
                assign(best, x)
                residual_of_best.value = size
            short = residual < 0.0  # NaN counts as too far
            low.value = code.select(short, s, low.value)
            high.value = code.select(short, high.value, s)
            slope = (now - last_t.value) / (s - last_sigma.value)
            last_sigma.value, last_t.value = s, now
            secant = s - residual / slope
            inside = (slope > 0.0) & (slope < float("inf")) & (low.value < secant) & (secant < high.value)
            sigma.value = code.select(inside, secant, (low.value + high.value) * 0.5)
            open_.value = tolerance < residual_of_best.value
        place = row * 2 + 1
        code.store(code.load(self.counts, place, INT) + trials.value, self.counts, place)
        return residual_of_best.value <= code.apply("max", ((target - before) * CLOSE, tolerance * 100.0))

    def _short_step(self, start: list[Value], sigma: Value) -> list[Value]:
        """A step of length sigma by the numbers for h = 1."""
        code, made = self.code, self.made
        x, given = [code.variable(value) for value in start], made.given_numbers
        with code.over(self.n_columns) as c:
            numbers: list[Any] = [code.load(self.step, c * given + i) for i in range(given)]
            numbers[:2] = [sigma * number for number in numbers[:2]]
            assign(x, made.executed(numbers, [value.value for value in x]))
        return [value.value for value in x]
