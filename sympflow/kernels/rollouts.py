"""Rollouts: the runs and maps of one stage as functions of arrays, each compiled when it is first called."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import cached_property, partial
from typing import Any

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import Value, assign
from sympflow.compiler.machine import address, given
from sympflow.compiler.program import Program, adjoint, traced
from sympflow.kernels.protocol import Batch, Task, begun_in, end_finite, run_states
from sympflow.kernels.runs import (
    BLOCK,
    Memory,
    Numbers,
    Room,
    Values,
    map_function,
    reverse_function,
    run_function,
)
from sympflow.kernels.stages import evaluated
from sympflow.kernels.threads import NEVER

__all__ = ["Columns", "Rollouts", "SplittingRollouts", "aligned", "filled", "shared", "zeros"]

LINE = 8  # numbers in a line of memory
START, ONE = np.zeros(1, dtype=np.int64), np.ones(1, dtype=np.int64)
AT_ONCE = 4096  # trajectories with tables of their own
POWERS = np.array([1, 1, 3, 5])  # of the step, with which the numbers of a drift and a kick grow

Columns = tuple[np.ndarray, np.ndarray]
"""The numbers (m, size) of columns and their kinds (m,), as compiled code reads them: see `run_function`."""


def aligned(n: int) -> np.ndarray:
    """Numbers in memory, of any values, that begin with a line of it."""
    memory = np.empty(n + LINE)
    begin = -(address(memory) // 8) % LINE
    return memory[begin : begin + n]


def zeros(n: int) -> np.ndarray:
    """The same, of 0."""
    x = aligned(n)
    x[:] = 0.0
    return x


def filled(x: np.ndarray, lanes: int, times: int = 1) -> np.ndarray:
    """Columns (…, J N), of each of J times the last one again where there are fewer than lanes."""
    n = x.shape[-1] // times
    if n >= lanes:
        return np.ascontiguousarray(x)
    each = x.reshape(*x.shape[:-1], times, n)
    more = np.repeat(each[..., -1:], lanes - n, axis=-1)
    return np.concatenate([each, more], axis=-1).reshape(*x.shape[:-1], times * lanes)


MOST_CODES = 64  # that are kept, of systems with other structures
_CODES: dict[Any, Any] = {}


def shared(key: Any, make: Callable[[], Any]) -> Any:
    """Return the code of a key, made once while it is kept: systems are often made again."""
    found = _CODES.get(key)
    if found is None:
        while len(_CODES) >= MOST_CODES:
            _CODES.pop(next(iter(_CODES)), None)
        found = _CODES[key] = make()
    return found


class Rollouts(ABC):
    """The compiled functions of one stage. A method defines its stage, and how its tables become columns.

    Attributes
    ----------
    n_out, n_values, size : int
        Numbers of a state; numbers that a stage changes, those behind the state begin as 0; numbers of a column.
    lanes, fewest : int
        Trajectories of a batch that run side by side, of two registers or four, and the fewest that do.
    room : int, optional
        Where states are in memory, as the class `memory` has them, how many numbers more stages need there; else None.
    data : sequence of ndarray
        Arrays that stages of states in memory read: see `sympflow.kernels.runs.Room`.
    chunked, timed : bool
        True if many trajectories are in memory and pass through registers in each stage; if stages depend on the step.
    every, block : int
        Steps after which `look` changes the running state, if given; steps between two looks for the end of a run.
    counted, closing : bool
        True if the last of `n_values` is a count, which is not part of the running state; False if none closes outputs.
    kinds : int
        Kinds of stages.
    given, own : int
        Numbers of which a column is made, and how many of them, the last ones, each trajectory may have of its own.
    """

    size: Any
    lanes = 16
    fewest = 2
    room: int | None = None
    data: Sequence[np.ndarray] = ()
    memory: Callable[..., Memory] = Memory
    every: int | None = None
    timed = False
    chunked = False
    block = BLOCK
    counted = False
    closing = True
    kinds = 1
    given = own = 0

    _given: tuple[Any, ...]
    """The arguments of the class."""

    def __init__(self, n_values: int, n_out: int) -> None:
        self.n_values, self.n_out = n_values, n_out
        self._lock = threading.RLock()
        self._functions: dict[Any, Callable[..., None]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._given

    @abstractmethod
    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        """The values after one column: see `sympflow.kernels.runs.Stage`."""

    def adjoint(
        self, values: Values, cotangents: Values, numbers: Numbers, kind: Value, step: Value, slopes: bool, *room: Room
    ) -> tuple[Values, Values]:
        """The reverse of `stage`: see `sympflow.kernels.runs.Adjoint`."""
        code, type, n = step.code, values[0].type, self.n_values
        column = [numbers(i, lone=True) for i in range(self.size)]
        given = [*values, *column, code.convert("sitofp", step, "double"), *cotangents]
        found = [code.variable(code.constant(0.0, type)) for _ in range(n + self.size * slopes)]
        for k in self.given_kind(kind):
            program = self._reversed[k]
            asked = Program(program.inputs, program.outputs[: len(found)])
            assign(found, [code.operand(x, type) for x in asked(*given)])
        return [x.value for x in found[:n]], [x.value for x in found[n:]]

    def given_kind(self, kind: Value) -> Iterator[int]:
        """Each kind of stage: what is written for it is executed for columns of this kind."""
        for k in range(self.kinds):
            with kind.code.given(kind.code.apply("eq", (kind, k))) if self.kinds > 1 else nullcontext():
                yield k

    def plain(self, kind: int, state: Sequence[Any], column: Sequence[Any], step: Any) -> Sequence[Any]:
        """The state after a stage of a kind, of recorded numbers: `stage`, up to rounding, to be differentiated."""
        raise NotImplementedError

    @cached_property
    def _reversed(self) -> list[Program]:
        """The reverse of the stage of each kind, of the state, a column, the step and the cotangents."""
        n, names = self.n_values, [f"x_{i}" for i in range(self.n_values + self.size + 1)]

        def stage(kind: int, *x: Any) -> Sequence[Any]:
            return self.plain(kind, x[:n], x[n:-1], x[-1])

        return [adjoint(traced(partial(stage, k), *names)) for k in range(self.kinds)]

    def check_reverse(self) -> None:
        """Raise a ValueError, with the reason, where stages have no compiled reverse."""
        raise NotCompiled("`system` has compiled loops without a reverse, which gradients need: use backend='array'.")

    def chained(self, kernel: Any, task: Task, table: Any) -> Any:
        """The run of a kernel with a reverse step by step, see `reverse.Chained`; None where stages are reversed."""
        return None

    def of_values(self, given: Sequence[Value], cotangents: Sequence[Value], kind: Value) -> Sequence[Value]:
        """The cotangents of values that each trajectory has: see `sympflow.kernels.runs.OfValues`."""
        return cotangents[: self.own]

    def over(self, each: Callable[..., None], numbers: Numbers, kind: Value, step: Value) -> None:
        """One column of many states: see `sympflow.kernels.runs.Over`."""
        each(lambda values: self.stage(values, numbers, kind, step))

    def look(self, values: Any) -> Any:
        """The running state changed, where there is `every`: see `sympflow.kernels.runs.run_function`."""
        return values

    def prepared(self, table: Any) -> Columns:
        """The columns of a table; a table may be these already."""
        columns: Columns = table
        return columns

    def own_columns(self, table: Any, values: np.ndarray, width: int) -> Columns:
        """The columns of trajectories with their own values (N, n): a table for every `width` of them.

        The values are a place, where there are columns (…, m, size) for each of them.
        """
        if isinstance(table, tuple) and table[0].ndim > 2:
            entries, kinds = table[0][values[:, 0].astype(int)], table[1]
        else:
            entries, kinds = self.own_entries(table, values)
        groups = -(-len(entries) // width)
        if len(entries) < groups * width:
            entries = np.concatenate([entries, entries[-1:].repeat(groups * width - len(entries), axis=0)])
        return np.ascontiguousarray(entries.reshape(groups, width, *entries.shape[1:]).transpose(0, 2, 3, 1)), kinds

    def own_entries(self, table: Any, values: np.ndarray) -> Columns:
        """The numbers (N, m, size) of the columns of each, and their kinds (m,), where trajectories may have values."""
        raise NotImplementedError

    def summed(self, kinds: np.ndarray) -> np.ndarray:
        """The sums over trajectories that a reverse of columns of these kinds left, such as derivatives by weights."""
        return np.zeros(0)

    @property
    def place(self) -> Callable[..., Memory] | None:
        """The class of states in memory; None where they are in registers."""
        return None if self.room is None else self.memory

    def function(self, name: str, width: int) -> Callable[..., None]:
        """The compiled function of a name, see `made`; made once."""
        key = name, width
        if key not in self._functions:
            with self._lock:
                if key not in self._functions:
                    self._functions[key] = self.made(name, width)
        return self._functions[key]

    def made(self, name: str, width: int) -> Callable[..., None]:
        """Compile the function of a name: "run", "step", "kept", "reverse" or "slopes", each " own" too, or "map"."""
        sizes, memory, (what, _, own_tables) = (self.n_values, self.n_out, self.size), self.place, name.partition(" ")
        if name == "map":
            return map_function(*sizes, self.stage, width, memory, self.timed)
        own, kept = bool(own_tables), what == "kept"
        if what == "step":
            return self.step_made(width, own)
        if what in ("reverse", "slopes"):
            asked = what == "slopes", self.closing, memory is not None
            return reverse_function(*sizes, self.adjoint, width, own, *asked, self.of_values, self.given, self.own)
        look, every = (None, self.block) if self.every is None else (self.look, self.every)
        over = self.over if self.chunked and not kept else None
        return run_function(*sizes, self.stage, width, own, memory, look, every, self.closing, over, kept)

    def step_made(self, width: int, own: bool) -> Callable[..., None]:
        """Compile single steps of rows, of a method that has them: see `sympflow.kernels.runs.step_function`."""
        raise NotImplementedError

    @cached_property
    def _places(self) -> np.ndarray:
        """The addresses of the data."""
        return np.array([*map(address, self.data)], dtype=np.int64)

    def call(self, name: str, width: int, *arguments: Any, n_out: int | None = None) -> None:
        """Call the compiled function of a name with arrays and integers."""
        if self.room is not None:
            work = aligned((3 * self.n_values + self.room) * width)
            arguments = *arguments, self.n_values, self.n_out if n_out is None else n_out, work, self._places
        self.function(name, width)(*given(arguments))

    def run(self, table: Any, batch: Batch, closed: bool = True) -> None:
        """Run the rows of a batch in the lanes of registers; those that end early once more, alone, to find where."""
        size = AT_ONCE if batch.y0.shape[1] > self.n_out else len(batch.y0)
        for k in range(0, len(batch.y0), size or 1):
            part = batch.rows(k, k + size)
            if len(part.y0) < self.fewest:
                self._run(table, part, closed, 1)
                continue
            before = part.running.copy() if part.first > 0 else part.running
            self._run(table, part, closed, self.lanes)
            for i in part.ended if self.lanes > 1 and not part.stop[0] else ():
                part.running[i] = before[i]
                self._run(table, part.rows(i, i + 1), closed, 1)

    def _run(self, table: Any, batch: Batch, closed: bool, width: int) -> None:
        y0, n_steps, save, out, n_finite, first, running, counts, stop, kept = batch
        run, states, more = "run" if kept is None else "kept", y0[:, : self.n_out], () if kept is None else (kept,)
        if y0.shape[1] > self.n_out:
            name, (entries, kinds) = f"{run} own", self.own_columns(table, y0[:, self.n_out :], width)
        else:
            name, (entries, kinds) = run, self.prepared(table)
        begun = int(save.searchsorted(0, "right")) if len(save) and save[0] <= 0 else 0
        if begun:
            out[:, :begun] = states[:, None]
        later, outputs = save[begun:], out[:, begun:]
        apart = not outputs.flags.c_contiguous
        if apart:
            outputs = np.empty(outputs.shape)
        start = np.ascontiguousarray(running if first > 0 else states)
        if self.n_values > start.shape[1]:
            start = np.concatenate([start, np.zeros((len(states), self.n_values - start.shape[1]))], axis=1)
        keeps = running.shape[-1] > 0
        left = np.empty((len(y0), self.n_values)) if keeps or self.counted else NEVER
        given = entries, kinds, len(kinds) - 2, int(closed), start, len(y0), first, n_steps
        outlets = later if len(later) else NEVER, len(later), outputs  # an empty array has no address
        self.call(name, width, *given, *outlets, n_finite, left, int(keeps or self.counted), stop, *more)
        if apart:
            out[:, begun:] = outputs
        if self.counted:
            counts[:], left = left[:, -1], left[:, :-1]
        if keeps:
            running[:] = left
        for i in batch.ended if width == 1 else ():
            out[i, np.searchsorted(save, n_finite[i], side="right") :] = np.nan
            if keeps:
                running[i] = np.nan

    def run_processed(self, before: Any, table: Any, after: Any, batch: Batch) -> None:
        """`run` in other coordinates: `before` into them, and `after`, which begins with the last stage, out."""
        y0, _, save, out, n_finite, *_ = batch
        start = y0
        if batch.first == 0:
            start = np.empty_like(y0)
            self.mapped(before, y0, start)
        self.run(table, batch._replace(y0=start), False)
        self.mapped(after, out.reshape(-1, self.n_out), out.reshape(-1, self.n_out), save)
        out[:, : begun_in(save)] = y0[:, None]
        end_finite(out, save, n_finite)

    def mapped(self, table: Any, y: np.ndarray, out: np.ndarray, steps: np.ndarray = START) -> None:
        """All columns of a table, applied to rows `y` (N, 2d) after steps (n,), in turn; `out` may be `y`."""
        if not len(y):
            return
        entries, kinds = self.prepared(table)
        width = 1 if len(y) == 1 else self.lanes
        self.call("map", width, entries, kinds, len(kinds), steps, len(steps), y, len(y), out)

    def single_steps(self, entries: np.ndarray, kinds: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One step from every row of `y` (N, 2d) by columns of its own: (N, m, size), of these kinds (m,)."""
        nothing = np.zeros((len(y), 2, self.size))
        columns = np.concatenate([entries, nothing], axis=1), np.append(kinds, [0, 0])
        rollout, task = partial(self.run, columns, closed=False), Task(0.0, y, 1, ONE)
        start = np.column_stack([y, np.arange(len(y), dtype=float)])
        return run_states(rollout, task, self.n_values, 0.0, start).states[:, 0]


class SplittingRollouts(Rollouts):
    """The compiled functions of splitting schemes, whose tables are the numbers of kicks and drifts."""

    def step_rows(
        self, table: np.ndarray, x: np.ndarray, h: np.ndarray, t: np.ndarray, y: np.ndarray, out: np.ndarray
    ) -> None:
        """One step of length ``h[i]`` at ``t[i]`` from every row of `y`, by polynomials of ``x[i]``, into `out`."""
        powers = POWERS[: len(table), None, None]
        out[:] = self.own_steps((evaluated(table, x) * h**powers).reshape(len(table), -1), y)

    def own_steps(self, table: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One step from every row of `y` (N, 2d) by its own numbers: a table (n, m N), a column of all rows each."""
        n = len(y)
        entries, kinds = self.columns(table)
        return self.single_steps(entries.reshape(-1, n, self.size).swapaxes(0, 1), kinds[::n], y)

    def columns(self, table: np.ndarray) -> Columns:
        """The columns of a table of numbers."""
        return self.prepared(table)
