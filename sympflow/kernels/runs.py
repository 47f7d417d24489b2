"""Compiled runs over traced numbers: n steps of stages, their outputs, the first that is not finite; for every method.

A method says what a stage is: a function of the values of a state and of the numbers of one column of a table. A run
executes columns [opening, inner …, link, closing]: the first step begins with the opening, each other one with the
link, which is the end of a step and the beginning of the next in one. An output is a copy of the state to which the
closing column is applied. One function is the run of a single trajectory, and of several in the lanes of registers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

from sympflow.compiler.control import INT, POINTER, Code, Module, Type, Value, Variable
from sympflow.compiler.machine import compiled, host

__all__ = ["LONGEST", "NUMBERS", "ROOM", "ROW", "WHOLE", "Memory", "Numbers", "Stage", "map_function", "run_function", "step_function"]

BLOCK = 1024  # steps between two looks for a state that is not finite, where nothing is saved

Numbers = Callable[[int], Any]
"""The number of an index, of one column."""
Stage = Callable[[list[Value], Numbers, Value, Value], list[Value]]
"""``stage(values, numbers, kind, step)``: the values after a stage; `kind` is an integer, which the column has, and
`step` tells after how many whole steps the stage is executed."""


def run_function(
    n_values: int,
    n_out: int,
    size: int,
    stage: Stage,
    width: int = 1,
    own: bool = False,
    memory: Memory | None = None,
) -> Callable[..., None]:
    """Compile the runs of trajectories, `width` of them side by side.

    Parameters
    ----------
    n_values, n_out : int
        Numbers of a state, and how many of them, the first ones, are the output.
    size : int
        Numbers of a column.
    stage
    width : int
    own : bool
        True if each trajectory has a table of its own.
    memory : Memory, optional
        Where states stand that are too long for registers.

    Returns
    -------
    callable
        Of addresses and integers (table, kinds, link, closes, rows, n_rows, first, n_steps, save, n_saved, out, finite,
        running, keeps, stop).

        The table holds columns, in each of these `size` numbers or, for tables of their own, `size` times `width`, a
        table for every `width` trajectories. `rows` (n_rows, n_values) are the states to begin with, those of the run
        where it goes on after `first` steps. Outputs are made after ``save[i]`` steps, later than `first`, with the
        closing column where `closes` is 1. `finite[i]` becomes the last step of row i that ends in a finite state; of
        trajectories side by side only whether it is `n_steps`, else −1. Where `keeps` is 1, `running` is left with the
        state of the run. Ends soon if ``stop[0]`` becomes 1. With `memory` there is one more address, of its context.
    """
    module = Module(host().fused)
    types = [POINTER, POINTER, INT, INT, POINTER, INT, INT, INT, POINTER, INT, POINTER, POINTER, POINTER, INT, POINTER]
    types += [POINTER] * (memory is not None)
    code = module.function("run", types)
    table, kinds, link, closes, rows, n_rows, first, n_steps, save, n_saved, out, finite, running, keeps, stop = (
        code.arguments[:15]
    )
    one, zero = code.constant(1, INT), code.constant(0, INT)
    lanes = Lanes(code, n_values, n_values, width) if memory is None else Room(code, memory, code.arguments[15], n_out, n_values)
    with code.over(lanes.groups(n_rows)) as group:
        begin = group * width
        place = code.at(table, group * (link + 2) * (size * width)) if own else table
        column = _column(code, place, kinds, size, width if own else 1, width, stage)
        state = lanes.opened(rows, begin, n_rows)
        n, saved, longest = code.variable(first), code.variable(zero), code.variable(lanes.block)
        j, step = code.variable(code.select(zero < first, link, zero)), code.variable(first)
        alive = code.variable(code.constant(1, Type("i1", width)))
        going = code.variable(first < n_steps)
        with code.during(lambda: going.value):
            k = code.apply("min", (longest.value, n_steps - n.value))
            left = saved.value < n_saved
            following = code.load(save, code.select(left, saved.value, zero), INT) - n.value
            k = code.select(left, code.apply("min", (k, following)), k)
            before, j_before, step_before = lanes.copied(state, 1), j.value, step.value
            with code.over(k * link):
                at = j.value
                lanes.set(state, column(at, lanes.values(state), step.value))
                j.value = code.select(code.apply("eq", (at, link)), one, at + 1)
                step.value = code.select(code.apply("eq", (j.value, link)), step.value + 1, step.value)
            end = lanes.copied(state, 2)
            with code.over(closes):
                lanes.set(end, column(link + 1, lanes.values(end), step.value))
            alive.value = alive.value & lanes.finite(end)
            good = code.any(alive.value)
            going.value = good & code.apply("eq", (code.load(stop, 0, INT, shared=True), zero))
            with code.given(good):
                n.value = n.value + k
                going.value = going.value & (n.value < n_steps)
                with code.during(partial(_due, code, save, n_saved, saved, n)):
                    lanes.kept(end, n_out, out, begin, n_rows, n_saved, saved.value)
                    saved.value = saved.value + 1
            if width == 1:  # again, step by step
                with code.given(~good & (one < k)):
                    lanes.set(state, lanes.values(before))
                    j.value, step.value, longest.value = j_before, step_before, one
                    alive.value, going.value = code.constant(1, Type("i1")), code.constant(1, Type("i1"))
        if width == 1:
            code.store(n.value, finite, begin)
        else:
            lanes.mark(alive.value, n.value, finite, begin, n_rows)
        with code.given(one <= keeps):
            lanes.kept(state, n_values, running, begin, n_rows, one, zero)
    return _finished(code, types)


def map_function(
    n_values: int, n_out: int, size: int, stage: Stage, width: int = 1, memory: Memory | None = None
) -> Callable[..., None]:
    """Compile a map of rows: all columns of one table.

    Returns
    -------
    callable
        Of (table, kinds, n_columns, steps, n_steps, rows, n_rows, out): row i is mapped after ``steps[i % n_steps]``
        whole steps, in lanes the same for all of them; `out` may be `rows`.
    """
    types = [POINTER, POINTER, INT, POINTER, INT, POINTER, INT, POINTER]
    types += [POINTER] * (memory is not None)
    code = Module(host().fused).function("map", types)
    table, kinds, n_columns, steps, n_steps, rows, n_rows, out = code.arguments[:8]
    lanes = Lanes(code, n_values, n_out, width) if memory is None else Room(code, memory, code.arguments[8], n_out, n_out)
    column = _column(code, table, kinds, size, 1, width, stage)
    with code.over(lanes.groups(n_rows)) as group:
        begin = group * width
        state = lanes.opened(rows, begin, n_rows)
        step = code.load(steps, code.op("srem", INT, begin, n_steps), INT)
        with code.over(n_columns) as j:
            lanes.set(state, column(j, lanes.values(state), step))
        lanes.kept(state, n_out, out, begin, n_rows, code.constant(1, INT), code.constant(0, INT))
    return _finished(code, types)


def step_function(
    n_values: int,
    n_out: int,
    powers: Sequence[int],
    own: int,
    numbers: Callable[..., Sequence[Any]],
    stage: Stage,
    width: int = 1,
) -> Callable[..., None]:
    """Compile single steps from rows, each of its own length.

    Parameters
    ----------
    powers : sequence of int
        Of the step length, with which the given numbers of a column grow.
    own : int
        Numbers that follow each state in its row and replace the last ones given.
    numbers : callable
        From the given numbers to those that a stage reads.

    Returns
    -------
    callable
        Of (coefficients, n_columns, n_powers, x, h, t, rows, n_rows, out): the given numbers of a column of row i are
        polynomials Σ_k coefficients[:, column, k] x[i]^k for a step of length 1.
    """
    types = [POINTER, INT, INT, POINTER, POINTER, POINTER, POINTER, INT, POINTER]
    code = Module(host().fused).function("steps", types)
    table, n_columns, n_powers, x, h, _, rows, n_rows, out = code.arguments
    lanes, alone = Lanes(code, n_values, n_out + own, width), Lanes(code, 1, 1, width)
    with code.over(lanes.groups(n_rows)) as group:
        begin = group * width
        (at,), (length,) = alone.loaded(x, begin, n_rows), alone.loaded(h, begin, n_rows)
        values = lanes.loaded(rows, begin, n_rows)
        state = lanes.padded(values[:n_out])
        with code.over(n_columns) as j:
            given = []
            for r in range(len(powers)):
                total = code.variable(code.constant(0.0, at.type))
                start = code.at(table, (n_columns * r + j) * n_powers)
                with code.over(n_powers) as k:
                    total.value = total.value * at + code.splat(code.load(start, n_powers - 1 - k), width)
                given.append(total.value)
            grown = [value * length**power if power else value for value, power in zip(given, powers, strict=True)]
            entries = numbers(*grown[: len(grown) - own], *values[n_out:])
            lanes.set(state, stage(lanes.values(state), entries.__getitem__, j, j))
        lanes.kept(state, n_out, out, begin, n_rows, code.constant(1, INT), code.constant(0, INT))
    return _finished(code, types)


class Lanes:
    """Rows of memory as values of registers: `width` rows side by side, the last one again where there are fewer.

    A row has `n_given` numbers, and a state `n_values`, of which those that are not given begin as 0.
    """

    def __init__(self, code: Code, n_values: int, n_given: int, width: int) -> None:
        self.code, self.n_values, self.n_given, self.width = code, n_values, n_given, width
        self.type = Type("double", width)
        self.block = code.constant(BLOCK, INT)
        self._buffer = None if width == 1 else code.memory(max(n_values, n_given), self.type)

    # a state, which consists of variables ---------------------------------------------------------------------------

    def opened(self, rows: Value, begin: Value, n_rows: Value) -> list[Variable]:
        return self.padded(self.loaded(rows, begin, n_rows))

    def padded(self, x: Sequence[Value]) -> list[Variable]:
        zero = self.code.constant(0.0, self.type)
        return [self.code.variable(value) for value in [*x, *[zero] * (self.n_values - len(x))]]

    def values(self, state: Any) -> list[Value]:
        return [x.value for x in state]

    def set(self, state: Any, values: Sequence[Value]) -> None:
        for variable, value in zip(state, values, strict=True):
            variable.value = value

    def copied(self, state: Any, _: int) -> Any:
        """A copy of a state: of its beginning (1) or its end (2)."""
        return [self.code.variable(x.value) for x in state]

    def finite(self, state: Any) -> Value:
        """True where all values are finite: times 0 they are 0."""
        first, *others = self.values(state)
        total = first * 0.0
        for value in others:
            total = self.code.fma(value, self.code.constant(0.0, value.type), total)
        return self.code.apply("eq", (total, 0.0))

    def kept(self, state: Any, count: int, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        """Write the first values of a state to memory: see `store`."""
        self.store(self.values(state)[:count], out, begin, n_rows, stride, at)

    # rows -----------------------------------------------------------------------------------------------------------

    def groups(self, n_rows: Value) -> Value:
        if self.width == 1:
            return n_rows
        return self.code.op("sdiv", INT, n_rows + (self.width - 1), self.code.constant(self.width, INT))

    def loaded(self, rows: Value, begin: Value, n_rows: Value) -> list[Value]:
        code, n = self.code, self.n_given
        if self._buffer is None:
            start = code.at(rows, begin * n)
            return [code.load(start, i) for i in range(n)]
        with code.over(code.constant(self.width, INT)) as lane:
            start = code.at(rows, code.apply("min", (begin + lane, n_rows - 1)) * n)
            with code.over(code.constant(n, INT)) as i:
                code.store(code.load(start, i), self._buffer, i * self.width + lane)
        return [code.load(self._buffer, i * self.width, self.type) for i in range(n)]

    def store(self, x: Sequence[Value], out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        """Write values to the row `at` of `stride` rows that each trajectory has in `out`."""
        code, n = self.code, len(x)
        if self._buffer is None:
            start = code.at(out, (begin * stride + at) * n)
            for i, value in enumerate(x):
                code.store(value, start, i)
            return
        for i, value in enumerate(x):
            code.store(value, self._buffer, i * self.width)
        with code.over(self._there(begin, n_rows)) as lane:
            start = code.at(out, ((begin + lane) * stride + at) * n)
            for i in range(n):
                code.store(code.load(self._buffer, lane + i * self.width), start, i)

    def mark(self, alive: Value, n: Value, finite: Value, begin: Value, n_rows: Value) -> None:
        """Write n for the trajectories that are alive, else −1."""
        code = self.code
        marks = code.memory(1, Type("i64", self.width))
        code.store(code.select(alive, code.splat(n, self.width), code.constant(-1, Type("i64", self.width))), marks)
        with code.over(self._there(begin, n_rows)) as lane:
            code.store(code.load(marks, lane, INT), finite, begin + lane)

    def _there(self, begin: Value, n_rows: Value) -> Value:
        return self.code.apply("min", (self.code.constant(self.width, INT), n_rows - begin))


class Memory(Protocol):
    """States in memory, of any length, which stages change in place: what `run_function` must know of them.

    A context is an array of whole numbers: sizes, and addresses of what the caller provides, so that code depends on
    neither. The first five are the address of room for three states, the numbers of a state, those of a row and of a
    `whole` one, which holds errors too, and the steps between two looks for a state that is not finite. The values of a
    state are its address and that of the context, and a stage returns these.
    """

    def load(self, code: Code, context: Value, row: Value, state: Value, whole: bool) -> None:
        """Write code that makes a state of a row [q, p] or, if `whole`, of all that `keep` wrote."""

    def keep(self, code: Code, context: Value, state: Value, row: Value, whole: bool) -> None:
        """Write code of the inverse; one thread does that."""


ROOM, NUMBERS, ROW, WHOLE, LONGEST = range(5)
"""Numbers of a context."""
_BLOCK = Type("double", 8)
"""Numbers of a state that are copied at a time: it has a multiple of these."""


class Room:
    """A state in memory, in the place of `Lanes`, and its two copies."""

    width = 1

    def __init__(self, code: Code, memory: Memory, context: Value, n_out: int, n_given: int) -> None:
        self.code, self._memory, self._context = code, memory, context
        self._n_out, self._n_given = n_out, n_given
        self.block, self._n, *rows = (code.load(context, i, INT) for i in (LONGEST, NUMBERS, ROW, WHOLE))
        self._rows = dict(zip((False, True), rows, strict=True))
        self._room = code.address(code.load(context, ROOM, INT))

    def groups(self, n_rows: Value) -> Value:
        return n_rows

    def opened(self, rows: Value, begin: Value, n_rows: Value) -> Any:
        whole = self._n_given > self._n_out
        row = self.code.at(rows, begin * self._rows[whole])
        self._memory.load(self.code, self._context, row, self._room, whole)
        return self._room

    def values(self, state: Any) -> list[Value]:
        return [state, self._context]

    def set(self, state: Any, values: Sequence[Value]) -> None:
        if values[0] is not state:
            self._copy(values[0], state)

    def copied(self, state: Any, which: int) -> Any:
        copy = self.code.at(self._room, self._n * which)
        self._copy(state, copy)
        return copy

    def _copy(self, source: Value, target: Value) -> None:
        with self._blocks() as i:
            self.code.store(self.code.load(source, i, _BLOCK), target, i)

    def finite(self, state: Any) -> Value:
        code = self.code
        total = code.variable(code.constant(0.0, _BLOCK))
        with self._blocks() as i:
            total.value = code.fma(code.load(state, i, _BLOCK), code.constant(0.0, _BLOCK), total.value)
        return ~code.any(~code.apply("eq", (total.value, 0.0)))

    @contextmanager
    def _blocks(self) -> Iterator[Value]:
        with self.code.over(self._n >> 3) as k:
            yield k << 3

    def kept(self, state: Any, count: int, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        whole = count > self._n_out
        row = self.code.at(out, (begin * stride + at) * self._rows[whole])
        self._memory.keep(self.code, self._context, state, row, whole)


def _column(
    code: Code, table: Value, kinds: Value, size: int, lanes: int, width: int, stage: Stage
) -> Callable[[Value, list[Value], Value], list[Value]]:
    """The stage of a column, the numbers of which are those of all lanes, or one for each."""

    def at(j: Value, values: list[Value], step: Value) -> list[Value]:
        start = code.at(table, j * (size * lanes))

        def number(i: int) -> Value:
            if lanes > 1:
                return code.load(start, i * lanes, Type("double", lanes))
            return code.splat(code.load(start, i), width)

        return stage(values, number, code.load(kinds, j, INT), step)

    return at


def _due(code: Code, save: Value, n_saved: Value, saved: Variable, n: Variable) -> Value:
    """True if the next output is that after n steps."""
    left = saved.value < n_saved
    following = code.load(save, code.select(left, saved.value, code.constant(0, INT)), INT)
    return left & code.apply("eq", (following, n.value))


_C = {"ptr": ctypes.c_void_p, "i64": ctypes.c_int64, "double": ctypes.c_double}


def _finished(code: Code, types: Sequence[Type]) -> Callable[..., None]:
    code.give()
    return compiled(str(code.module), code.name, ctypes.CFUNCTYPE(None, *[_C[t.scalar] for t in types]))
