"""Compiled runs over traced numbers: n steps of stages, their outputs, the first that is not finite; for every method.

A method defines a stage: a function of the values of a state and of the numbers of one column of a table. A run
executes columns [opening, inner …, link, closing]: the first step begins with the opening, each other one with the
link, which is the end of a step and the beginning of the next in one. An output is a copy of the state after the
closing column. One function is the run of a single trajectory, and of several in the lanes of registers.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Generic, TypeVar

from sympflow.compiler.control import BOOL, INT, POINTER, Code, Module, Rows, Type, Value, Variable, assign
from sympflow.compiler.machine import compiled, host

__all__ = [
    "Lanes",
    "Memory",
    "Numbers",
    "Room",
    "Values",
    "begun",
    "finished",
    "groups",
    "map_function",
    "reverse_function",
    "run_function",
    "step_function",
]

FAST_MEMORY = 16_384  # bytes of the states of a chunk after the other, and of their ends
MOST_CHUNKS = 32
BLOCK = 1024  # steps between two looks for a state that is not finite, where nothing is saved

Values = list[Value]
Numbers = Callable[..., Any]
"""``numbers(i, lone=False)``: number i of one column, in all lanes; `lone`, as a scalar if the lanes share it."""
Stage = Callable[[list[Value], Numbers, Value, Value], list[Value]]
"""``stage(values, numbers, kind, step)``: the values after a stage; `kind` is an integer, which the column has, and
`step` tells after how many whole steps the stage is executed."""
Adjoint = Callable[..., tuple[list[Value], list[Value]]]
"""``adjoint(values, cotangents, numbers, kind, step, slopes, *room)``: the cotangents of the values before a stage, and
with `slopes` of its numbers, for those of the values after it; with the room, where states are in memory."""
MemoryStage = Callable[["Room", Numbers, Value, Value], None]
"""The same of a state in memory, which it changes in place."""
AnyStage = Stage | MemoryStage
OfValues = Callable[[Sequence[Value], Sequence[Value], Value], Sequence[Value]]
"""``of_values(given, cotangents, kind)``: the cotangents of the values of parameters that are the last numbers given,
for those of the numbers that a stage reads."""
Over = Callable[[Callable[..., None], Numbers, Value, Value], None]
"""``over(each, numbers, kind, step)``: a stage of many states, ``each(body)`` executes ``body(values)`` for each of
them; what is the same for all is computed before."""


def run_function(
    n_values: int,
    n_out: int,
    size: int,
    stage: AnyStage,
    width: int = 1,
    own: bool = False,
    memory: Callable[..., Memory] | None = None,
    look: Callable[[Any], Any] | None = None,
    every: int = BLOCK,
    closing: bool = True,
    over: Over | None = None,
    kept: bool = False,
) -> Callable[..., None]:
    """Compile the runs of trajectories, `width` of them side by side, and of these as many as the fast memory holds.

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
    memory : callable, optional
        How states are in memory: then their sizes are arguments of the function, not `n_values` and `n_out`.
    look : callable, optional
        ``look(values)``, the values of the running state after each `every` steps of the run, changed so that the
        outputs are the same but for what it knows of; of states in memory ``look(room)`` in place.
    every : int
        Steps between two looks, for a state that is not finite too.
    closing : bool
        False if `closes` is always 0.
    over : callable, optional
        The stage of many states, where these are to be in memory: as pays where a stage is long.
    kept : bool
        True to keep the state before each stage, and the last one, for `reverse_function`: a further argument is the
        address of ((n_steps − first)·link + 1) states of all trajectories side by side, group by group.

    Returns
    -------
    callable
        Of addresses and integers (table, kinds, link, closes, rows, n_rows, first, n_steps, save, n_saved, out, finite,
        running, keeps, stop), of states in memory then `MEMORY`.

        The table holds columns, in each of these `size` numbers or, for tables of their own, `size` times `width`, a
        table for every `width` trajectories. `rows` (n_rows, n_values) are the states to begin with, those of the run
        where it goes on after `first` steps. Outputs are made after ``save[i]`` steps, later than `first`, with the
        closing column where `closes` is 1. `finite[i]` becomes the last step of row i that ends in a finite state; of
        trajectories side by side only whether it is `n_steps`, else −1. Where `keeps` is 1, `running` is left with the
        state of the run. Ends soon if ``stop[0]`` becomes 1.
    """
    types = [POINTER, POINTER, INT, INT, POINTER, INT, INT, INT, POINTER, INT, POINTER, POINTER, POINTER, INT, POINTER]
    types += [POINTER] * kept + (MEMORY if memory else [])
    code = begun("run", types)
    table, kinds, link, closes, rows, n_rows, first, n_steps, save, n_saved, out, finite, running, keeps, stop = (
        code.arguments[:15]
    )
    one, zero = code.constant(1, INT), code.constant(0, INT)
    sizes, more = (code, n_values, n_out, width, own, over if width > 1 else None), code.arguments[15 + kept :]
    state = memory(code, width, more, width == 1) if memory else _Registers(*sizes)
    chunks = state.chunks
    with code.over(groups(code, n_rows, width * chunks)) as group:
        begin = group * (width * chunks)
        length = (link + 2) * (size * width)
        place = code.at(table, group * length * chunks) if own else table
        column = ColumnStage(code, place, kinds, size, width if own else 1, width, stage, length if own else None)
        state.open(rows, begin, n_rows)
        n, saved, longest = code.variable(first), code.variable(zero), code.variable(state.block(every))
        j, step = code.variable(code.select(zero < first, link, zero)), code.variable(first)
        going = code.variable(first < n_steps)
        history = _History(code, code.arguments[15], group, (n_steps - first) * link, n_values, width) if kept else None
        with code.during(lambda: going.value):
            k = code.apply("min", (longest.value, n_steps - n.value))
            if look is not None:
                k = code.apply("min", (k, every - code.op("srem", INT, n.value, code.constant(every, INT))))
            left = saved.value < n_saved
            following = code.load(save, code.select(left, saved.value, zero), INT) - n.value
            k = code.select(left, code.apply("min", (k, following)), k)
            j_before, step_before = j.value, step.value
            state.remember()
            made = (n.value - first) * link
            with code.over(k * link) as i:
                at = j.value
                if history is not None:
                    state.record(history, made + i)
                state.change(column, at, step.value)
                j.value = code.select(code.apply("eq", (at, link)), one, at + 1)
                step.value = code.select(code.apply("eq", (j.value, link)), step.value + 1, step.value)
            state.end()
            if history is not None:
                state.record(history, made + k * link)
            if closing:
                with code.over(closes):
                    state.change(column, link + 1, step.value, end=True)
            good = state.finite()
            going.value = good & code.apply("eq", (code.load(stop, 0, INT, shared=True), zero))
            with code.given(good):
                n.value = n.value + k
                going.value = going.value & (n.value < n_steps)
                with code.during(partial(_due, code, save, n_saved, saved, n)):
                    state.store(out, begin, n_rows, n_saved, saved.value)
                    saved.value = saved.value + 1
                if look is not None:
                    whole = code.op("srem", INT, n.value, code.constant(every, INT))
                    with code.given(code.apply("eq", (whole, 0))):
                        state.look(look)
            if width == 1:  # again, step by step
                with code.given(~good & (one < k)):
                    state.restore()
                    j.value, step.value, longest.value = j_before, step_before, one
                    going.value = code.constant(1, BOOL)
        if width == 1:
            code.store(n.value, finite, begin)
        else:
            state.mark(n.value, finite, begin, n_rows)
        with code.given(one <= keeps):
            state.keep(running, begin, n_rows)
    return finished(code)


def reverse_function(
    n_values: int,
    n_out: int,
    size: int,
    adjoint: Adjoint,
    width: int,
    own: bool,
    slopes: bool,
    closing: bool,
    memory: bool,
    of_values: OfValues,
    n_given: int,
    n_own: int,
) -> Callable[..., None]:
    """Compile the reverse of runs whose states were kept: cotangents of the outputs are pulled back to the beginning.

    Returns a function of addresses and integers (table, kinds, link, kept, rows, n_rows, first, n_steps, save, n_saved,
    out, slopes, columns, starts, values): `rows` (n_rows, n_values) are the cotangents of the running states after
    `n_steps` steps, and become those after `first`; `out` (n_rows, n_saved, n_out) those of the outputs, later than
    `first`. With `slopes`, what a table of its own for every `width` trajectories would hold is added to that array, in
    the same order. The numbers of columns are made of others, `columns` (n_given, link + 2), of which the last ones
    follow each state in `starts` (n_rows, n_out + n_own): `values` (n_rows, n_own) are the cotangents of these, by
    `of_values`. Where states were in `memory`, `MEMORY` follows, and `adjoint` is given the room too.
    """
    types = [POINTER, POINTER, INT, POINTER, POINTER, INT, INT, INT, POINTER, INT, *[POINTER] * 5]
    types += MEMORY if memory else []
    code = begun("reverse", types)
    table, kinds, link, kept, rows, n_rows, first, n_steps, save, n_saved, out, derivatives, columns, starts, values = (
        code.arguments[:15]
    )
    more = Memory(code, width, code.arguments[15:], False).rooms[:1] if memory else []
    one, zero = code.constant(1, INT), code.constant(0, INT)
    lanes, outputs = Lanes(code, n_values, width), Lanes(code, n_out, width)
    with code.over(groups(code, n_rows, width)) as group:
        begin, length = group * width, (link + 2) * (size * width)
        place = code.at(table, group * length) if own else table
        column = ColumnStage(code, place, kinds, size, width if own else 1, width, lambda *_: None)
        found = code.at(derivatives, group * length)
        history = _History(code, kept, group, (n_steps - first) * link, n_values, width)
        cotangents = [code.variable(x) for x in lanes.loaded(rows, begin, n_rows)]
        n, saved = code.variable(n_steps), code.variable(n_saved)

        def pulled(j: Value, step: Value, state: list[Value], given: list[Value]) -> list[Value]:
            of_state, of_numbers = adjoint(state, given, column.numbers(j), column.kind(j), step, slopes, *more)
            for i, x in enumerate(of_numbers if slopes else ()):
                at = j * (size * width) + i * width
                code.store(code.load(found, at, x.type) + x, found, at)
            return of_state

        def last() -> Value:
            some = zero < saved.value
            return code.select(some, code.load(save, code.select(some, saved.value - 1, zero), INT), first)

        with code.during(lambda: first < n.value):
            s = code.variable((n.value - first) * link)
            with code.during(lambda: (zero < saved.value) & code.apply("eq", (last(), n.value))):
                saved.value = saved.value - 1
                given = outputs.loaded(out, begin, n_rows, n_saved * n_out, saved.value * n_out)
                given += [code.constant(0.0, given[0].type)] * (n_values - n_out)
                if closing:
                    given = pulled(link + 1, n.value, history.state(s.value), given)
                for x, change in zip(cotangents, given, strict=True):
                    x.value = x.value + change
            to = code.apply("max", (last(), first))
            r, step = code.variable(link), code.variable(n.value)
            with code.over((n.value - to) * link):
                s.value, r.value = s.value - 1, r.value - 1
                opens = code.apply("eq", (r.value, 0))
                step.value = code.select(code.apply("eq", (r.value + 1, link)), step.value - 1, step.value)
                begins = code.apply("eq", (s.value + first, 0))
                j = code.select(opens, code.select(begins, zero, link), r.value)
                assign(cotangents, pulled(j, step.value, history.state(s.value), [x.value for x in cotangents]))
                r.value = code.select(opens, link, r.value)
            n.value = to
        lanes.store([x.value for x in cotangents], rows, begin, n_rows, one, zero)
        if slopes and n_own:
            behind, stride = Lanes(code, n_own, width), code.constant(n_out + n_own, INT)
            own_values = behind.loaded(starts, begin, n_rows, stride, code.constant(n_out, INT))
            totals = [code.variable(code.constant(0.0, lanes.type)) for _ in range(n_own)]
            with code.over(link + 2) as j:
                shared = [code.load(columns, (link + 2) * r + j) for r in range(n_given - n_own)]
                numbers = [*(code.splat(x, width) for x in shared), *own_values]
                of_column = [code.load(found, (j * size + i) * width, lanes.type) for i in range(size)]
                for total, slope in zip(totals, of_values(numbers, of_column, column.kind(j)), strict=True):
                    total.value = total.value + slope
            behind.store([x.value for x in totals], values, begin, n_rows, one, zero)
    return finished(code)


def map_function(
    n_values: int,
    n_out: int,
    size: int,
    stage: AnyStage,
    width: int = 1,
    memory: Callable[..., Memory] | None = None,
    timed: bool = False,
) -> Callable[..., None]:
    """Compile a map of rows: all columns of one table. If `timed`, stages are given the steps of each lane.

    Returns a function of (table, kinds, n_columns, steps, n_steps, rows, n_rows, out), then `MEMORY`: row i is mapped
    after ``steps[i % n_steps]`` whole steps.
    """
    types = [POINTER, POINTER, INT, POINTER, INT, POINTER, INT, POINTER, *(MEMORY if memory else [])]
    code = begun("map", types)
    table, kinds, n_columns, steps, n_steps, rows, n_rows, out = code.arguments[:8]
    state = memory(code, width, code.arguments[8:], False) if memory else _Registers(code, n_values, n_out, width)
    column = ColumnStage(code, table, kinds, size, 1, width, stage)
    with code.over(groups(code, n_rows, width)) as group:
        begin = group * width
        state.open(rows, begin, n_rows, n_out)
        step = _steps_of_lanes(code, steps, n_steps, begin, width if timed else 1)
        with code.over(n_columns) as j:
            state.change(column, j, step)
        state.end()
        state.store(out, begin, n_rows, code.constant(1, INT), code.constant(0, INT))
    return finished(code)


def _steps_of_lanes(code: Code, steps: Value, n_steps: Value, begin: Value, width: int) -> Value:
    if width == 1:
        return code.load(steps, code.op("srem", INT, begin, n_steps), INT)
    found = code.memory(1, Type("i64", width))
    with code.over(code.constant(width, INT)) as lane:
        code.store(code.load(steps, code.op("srem", INT, begin + lane, n_steps), INT), found, lane)
    return code.load(found, 0, Type("i64", width))


def step_function(
    n_values: int,
    n_out: int,
    powers: Sequence[int],
    own: int,
    numbers: Callable[..., Sequence[Any]],
    stage: AnyStage,
    width: int = 1,
    memory: Callable[..., Memory] | None = None,
) -> Callable[..., None]:
    """Compile single steps from rows, each of its own length.

    Returns a function of (coefficients, n_columns, n_powers, x, h, t, rows, n_rows, out), then `MEMORY`: the given
    numbers of a column of row i are polynomials Σ_k coefficients[:, column, k] x[i]^k times a power of the length, of
    which the last `own` ones follow each state; ``numbers(time, *given)`` are those that a stage reads.
    """
    types = [POINTER, INT, INT, POINTER, POINTER, POINTER, POINTER, INT, POINTER, *(MEMORY if memory else [])]
    code = begun("steps", types)
    table, n_columns, n_powers, x, h, t, rows, n_rows, out = code.arguments[:9]
    state = memory(code, width, code.arguments[9:], False) if memory else _Registers(code, n_values, n_out, width)
    alone, behind = Lanes(code, 1, width), Lanes(code, own, width) if own else None
    place = code.arguments[10] if memory else code.constant(n_out, INT)
    with code.over(groups(code, n_rows, width)) as group:
        begin = group * width
        at, length, time = (alone.loaded(given, begin, n_rows)[0] for given in (x, h, t))
        state.open(rows, begin, n_rows, n_out, own)
        values = [] if behind is None else behind.loaded(rows, begin, n_rows, place + own, place)
        with code.over(n_columns) as j:
            given = []
            for r in range(len(powers)):
                total = code.variable(code.constant(0.0, at.type))
                start = code.at(table, (n_columns * r + j) * n_powers)
                with code.over(n_powers) as k:
                    total.value = total.value * at + code.splat(code.load(start, n_powers - 1 - k), width)
                given.append(total.value)
            grown = [value * length**power if power else value for value, power in zip(given, powers, strict=True)]
            entries = numbers(time, *grown[: len(grown) - own], *values)
            state.change(lambda j, x, step, entries=entries: stage(x, entries.__getitem__, j, step), j, j)
        state.end()
        state.store(out, begin, n_rows, code.constant(1, INT), code.constant(0, INT))
    return finished(code)


MEMORY = [INT, INT, POINTER, POINTER]
"""Further arguments where states are in memory: the numbers of a state, and how many of them are the output; room for
three states, and after these for what stages need, times the width; an array of the addresses of what they read."""


class Room(Rows):
    """A state of any `size` in memory: its numbers, each of all trajectories side by side.

    Behind them is room for others, `work`; `places` is the address of an array of addresses.
    """

    def __init__(self, state: Value, width: int, work: Value, size: Value, places: Value) -> None:
        super().__init__(state, Type("double", width))
        self.width, self.work, self.size, self.places = width, Rows(work, self.type), size, places

    def data(self, i: int) -> Value:
        """The address of array i of those that a stage reads."""
        return self.code.load(self.places, i, POINTER)


class _History:
    """The states before the stages of a run, of a group of trajectories."""

    def __init__(self, code: Code, place: Value, group: Value, stages: Value, n_values: int, width: int) -> None:
        self.code, self._n, self._width, self._size = code, n_values, width, n_values * width
        self._place = code.at(place, group * ((stages + 1) * self._size))

    def place(self, s: Value) -> Value:
        return self.code.at(self._place, s * self._size)

    def state(self, s: Value) -> list[Value]:
        start, type = self.place(s), Type("double", self._width)
        return [self.code.load(start, i * self._width, type) for i in range(self._n)]


_Place = TypeVar("_Place", Room, Rows)
_Count = TypeVar("_Count", Value, int)


class _States(ABC, Generic[_Place, _Count]):
    """The state, its end, and the state before a block of steps. Numbers are copied `at_once`, and `chunks` groups of
    trajectories run in turn."""

    at_once = chunks = 1
    code: Code
    width: int
    n_values: _Count
    n_out: _Count
    _running: _Place
    _end: _Place
    _before: _Place
    _remembers: bool

    def block(self, every: int) -> Value:
        return self.code.constant(every, INT)

    @abstractmethod
    def _copy(self, source: _Place, target: _Place) -> None: ...

    @abstractmethod
    def _revive(self) -> None: ...

    @abstractmethod
    def _write(
        self, room: _Place, n: _Count, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value
    ) -> None:
        """Write n numbers of the states at a place into rows."""

    def remember(self) -> None:
        if self._remembers:
            self._copy(self._running, self._before)

    def restore(self) -> None:
        self._copy(self._before, self._running)
        self._revive()

    def end(self) -> None:
        self._copy(self._running, self._end)

    def store(self, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        self._write(self._end, self.n_out, out, begin, n_rows, stride, at)

    def keep(self, running: Value, begin: Value, n_rows: Value) -> None:
        one, zero = self.code.constant(1, INT), self.code.constant(0, INT)
        self._write(self._running, self.n_values, running, begin, n_rows, one, zero)


class Memory(_States[Room, Value]):
    """States in memory. A subclass may order numbers in another way than rows do: see `open`, `store` and `keep`."""

    def __init__(self, code: Code, width: int, arguments: Sequence[Value], before: bool) -> None:
        self.code, self.width, self._remembers = code, width, before
        self.n_values, self.n_out, work, data = arguments
        self._alive = code.variable(code.constant(1, Type("i1", width)))
        places = [code.at(work, self.n_values * (i * width)) for i in range(4)]
        self.rooms = [Room(x, width, places[3], self.n_values, data) for x in places[:3]]
        self._running, self._end, self._before = self.rooms

    def open(self, rows: Value, begin: Value, n_rows: Value, given: int | None = None, own: int = 0) -> None:
        n = self.n_values if given is None else self.n_out
        self._revive()
        with self.code.over(self.width) as k:
            start = self.code.at(rows, self.code.apply("min", (begin + k, n_rows - 1)) * (n + own))
            with self.code.over(n) as i:
                self.code.store(self.code.load(start, i), self._running.place, i * self.width + k)
        if given is not None:
            with self.code.over(self.n_values - n) as i:
                self._running[n + i] = 0.0

    def change(self, column: Callable[..., Any], j: Value, step: Value, end: bool = False) -> None:
        column(j, self._end if end else self._running, step)

    def record(self, history: _History, s: Value) -> None:
        start = history.place(s)
        with self._blocks() as (i, type):
            self.code.store(self.code.load(self._running.place, i, type), start, i)

    def look(self, look: Callable[[Any], Any]) -> None:
        look(self._running)

    def _revive(self) -> None:
        self._alive.value = self.code.constant(1, Type("i1", self.width))

    @contextmanager
    def _blocks(self) -> Iterator[tuple[Value, Type]]:
        """Places of blocks of numbers, which are copied at a time, and the type of each."""
        size = self.at_once * self.width
        with self.code.over(self.code.op("udiv", INT, self.n_values, self.code.constant(self.at_once, INT))) as i:
            yield i * size, Type("double", size)

    def _copy(self, source: Room, target: Room) -> None:
        with self._blocks() as (i, type):
            self.code.store(self.code.load(source.place, i, type), target.place, i)

    def finite(self) -> Value:
        zero = self.code.constant(0.0, Type("double", self.at_once * self.width))
        total = self.code.variable(zero)
        with self._blocks() as (i, type):
            total.value = self.code.fma(self.code.load(self._end.place, i, type), zero, total.value)
        good = self.code.apply("eq", (total.value, 0.0))
        self._alive.value = self._alive.value & (good if self.at_once == 1 else ~self.code.any(~good))
        return self.code.any(self._alive.value)

    def _write(self, room: Room, n: Value, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        with self.code.over(there(self.code, self.width, begin, n_rows)) as k:
            source, start = self.code.at(room.place, k), self.code.at(out, ((begin + k) * stride + at) * n)
            with self.code.over(n) as i:
                self.code.store(self.code.load(source, i * self.width), start, i)

    def mark(self, n: Value, finite: Value, begin: Value, n_rows: Value) -> None:
        _mark(self.code, self._alive.value, n, finite, begin, n_rows)


class _Registers(_States[Rows, int]):
    """States that pass through registers in each stage: a chunk of lanes, which stays there, or many in memory.

    A chunk need not wait for the one before, whose chain of operations goes on meanwhile.
    """

    def __init__(
        self, code: Code, n_values: int, n_out: int, width: int, own: bool = False, over: Over | None = None
    ) -> None:
        self.code, self.width, self.n_values, self.n_out = code, width, n_values, n_out
        self._own, self._over, self._lanes = own, over, Lanes(code, n_values, width)
        self._remembers = width == 1  # a single trajectory alone goes back
        self.chunks = 1 if over is None else min(max(FAST_MEMORY // (16 * n_values * width), 1), MOST_CHUNKS)
        sizes, type = [n_values * self.chunks] * 3 + [self.chunks], self._lanes.type
        self._running, self._end, self._before, self._watch = (Rows(code.memory(n, type), type) for n in sizes)

    @contextmanager
    def _each(self) -> Iterator[Any]:
        if self.chunks == 1:
            yield 0
            return
        with self.code.over(self._used) as c:
            yield c

    def _values(self, rows: Rows, c: Any) -> list[Value]:
        return [rows[c * self.n_values + i] for i in range(self.n_values)]

    def _put(self, rows: Rows, c: Any, values: Sequence[Any]) -> None:
        for i, x in enumerate(values):
            rows[c * self.n_values + i] = x

    def open(self, rows: Value, begin: Value, n_rows: Value, given: int | None = None, own: int = 0) -> None:
        """Read states; numbers behind those that are given are 0."""
        given = self.n_values if given is None else given
        lanes = self._lanes if given + own == self.n_values else Lanes(self.code, given + own, self.width)
        if self.chunks > 1:
            chunks = self.code.constant(self.chunks, INT)
            self._used = self.code.apply("min", (groups(self.code, n_rows - begin, self.width), chunks))
        self._revive()
        with self._each() as c:
            x = lanes.loaded(rows, begin + c * self.width, n_rows)[:given]
            self._put(self._running, c, [*x, *[0.0] * (self.n_values - given)])

    def change(self, column: Callable[..., Any], j: Value, step: Value, end: bool = False) -> None:
        room = self._end if end else self._running

        def each(body: Callable[..., Sequence[Value]]) -> None:
            with self._each() as c:
                self._put(room, c, body(self._values(room, c), *[c] * (self.chunks > 1 and self._own)))

        if self._over is None or self._own:
            each(lambda x, *chunk: column(j, x, step, *chunk))
        else:
            assert isinstance(column, ColumnStage)
            self._over(each, column.numbers(j), column.kind(j), step)

    def record(self, history: _History, s: Value) -> None:
        """Keep the state before stage s."""
        start = history.place(s)
        for i, x in enumerate(self._values(self._running, 0)):
            self.code.store(x, start, i * self.width)

    def look(self, look: Callable[[Any], Any]) -> None:
        with self._each() as c:
            self._put(self._running, c, look(self._values(self._running, c)))

    def _revive(self) -> None:
        with self._each() as c:
            self._watch[c] = 0.0

    def _copy(self, source: Rows, target: Rows) -> None:
        with self._each() as c:
            self._put(target, c, self._values(source, c))

    def finite(self) -> Value:
        """True if the end of a trajectory is finite, as it was up to now: times 0 they are 0."""
        code, zero = self.code, self.code.constant(0.0, self._lanes.type)
        alive = code.variable(code.constant(0, BOOL))
        with self._each() as c:
            total = self._watch[c]
            for x in self._values(self._end, c):
                total = code.fma(x, zero, total)
            self._watch[c] = total
            alive.value = alive.value | code.any(code.apply("eq", (total, 0.0)))
        return alive.value

    def _write(self, room: Rows, n: int, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        with self._each() as c:
            self._lanes.store(self._values(room, c)[:n], out, begin + c * self.width, n_rows, stride, at)

    def mark(self, n: Value, finite: Value, begin: Value, n_rows: Value) -> None:
        """Write n for the trajectories that are alive, else −1."""
        with self._each() as c:
            alive = self.code.apply("eq", (self._watch[c], 0.0))
            _mark(self.code, alive, n, finite, begin + c * self.width, n_rows)


def groups(code: Code, n_rows: Value, width: int) -> Value:
    """How often `width` rows are begun side by side."""
    if width == 1:
        return n_rows
    return code.op("sdiv", INT, n_rows + (width - 1), code.constant(width, INT))


def there(code: Code, width: int, begin: Value, n_rows: Value) -> Value:
    """How many rows there are of `width` from `begin` on."""
    return code.apply("min", (code.constant(width, INT), n_rows - begin))


def _mark(code: Code, alive: Value, n: Value, finite: Value, begin: Value, n_rows: Value) -> None:
    """Write n for the trajectories that are alive, else −1."""
    width = alive.type.width
    marks = code.memory(1, Type("i64", width))
    code.store(code.select(alive, code.splat(n, width), code.constant(-1, Type("i64", width))), marks)
    with code.over(there(code, width, begin, n_rows)) as lane:
        code.store(code.load(marks, lane, INT), finite, begin + lane)


class Lanes:
    """Rows of memory as values of registers: `width` rows side by side, the last one again where there are fewer."""

    def __init__(self, code: Code, n_values: int, width: int) -> None:
        self.code, self.n_values, self.width = code, n_values, width
        self.type = Type("double", width)
        self._buffer = None if width == 1 else code.memory(self.n_values, self.type)

    def loaded(
        self, rows: Value, begin: Value, n_rows: Value, stride: Value | None = None, at: Value | None = None
    ) -> list[Value]:
        """The values of rows, or of parts of rows of `stride` numbers, from `at` on."""
        code, n = self.code, self.n_values
        length, first = n if stride is None else stride, code.constant(0, INT) if at is None else at
        if self._buffer is None:
            start = code.at(rows, begin * length + first)
            return [code.load(start, i) for i in range(n)]
        with code.over(code.constant(self.width, INT)) as lane:
            start = code.at(rows, code.apply("min", (begin + lane, n_rows - 1)) * length + first)
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
        with code.over(there(code, self.width, begin, n_rows)) as lane:
            start = code.at(out, ((begin + lane) * stride + at) * n)
            for i in range(n):
                code.store(code.load(self._buffer, lane + i * self.width), start, i)


class ColumnStage:
    """The stage of a column: all lanes have the same numbers, or each its own, in tables of a length."""

    def __init__(
        self,
        code: Code,
        table: Value,
        kinds: Value,
        size: int,
        lanes: int,
        width: int,
        stage: AnyStage,
        length: Value | None = None,
    ) -> None:
        self.code, self._table, self._kinds, self._size, self._lanes = code, table, kinds, size, lanes
        self._width, self._stage, self._length = width, stage, length

    def numbers(self, j: Value, chunk: Value | None = None) -> Numbers:
        code, lanes = self.code, self._lanes
        table = self._table
        if chunk is not None and self._length is not None:
            table = code.at(table, chunk * self._length)
        start = code.at(table, j * (self._size * lanes))

        def number(i: int, lone: bool = False) -> Value:
            if lanes > 1:
                return code.load(start, i * lanes, Type("double", lanes))
            return code.splat(code.load(start, i), 1 if lone else self._width)

        return number

    def kind(self, j: Value) -> Value:
        return self.code.load(self._kinds, j, INT)

    def __call__(self, j: Value, values: Any, step: Value, chunk: Value | None = None) -> Any:
        return self._stage(values, self.numbers(j, chunk), self.kind(j), step)


def _due(code: Code, save: Value, n_saved: Value, saved: Variable, n: Variable) -> Value:
    """True if the next output is that after n steps."""
    left = saved.value < n_saved
    following = code.load(save, code.select(left, saved.value, code.constant(0, INT)), INT)
    return left & code.apply("eq", (following, n.value))


_C = {"ptr": ctypes.c_void_p, "i64": ctypes.c_int64, "double": ctypes.c_double}


def begun(name: str, types: Sequence[Type]) -> Code:
    """Begin the code of a function for this machine."""
    return Module(host().fused).function(name, types)


def finished(code: Code) -> Callable[..., None]:
    """End the code of a function, and compile it."""
    code.give()
    types = [_C[x.type.scalar] for x in code.arguments]
    return compiled(str(code.module), code.name, ctypes.CFUNCTYPE(None, *types))
