"""Rollouts: the runs and maps of one stage as functions of arrays, each compiled when it is first called."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from ctypes import addressof, c_char
from functools import cached_property
from typing import Any

import numpy as np

from sympflow.compiler.control import Value
from sympflow.kernels.runs import BLOCK, Numbers, map_function, run_function

__all__ = ["Columns", "Rollouts", "address", "aligned"]

LINE = 8  # numbers in a line of memory
AT_ONCE = 4096  # trajectories with tables of their own

Columns = tuple[np.ndarray, np.ndarray]
"""The numbers (m, size) of columns and their kinds (m,), as compiled code reads them: see `run_function`."""


def address(x: np.ndarray) -> int:
    """Where an array begins, in a fraction of the time that `ctypes.data` takes; 0 of one without numbers."""
    if not x.size:
        return 0
    return addressof(c_char.from_buffer(x.data)) if x.flags.writeable else int(x.ctypes.data)


def aligned(n: int) -> np.ndarray:
    """Numbers in memory, of any values, that begin with a line of it."""
    memory = np.empty(n + LINE)
    begin = -(address(memory) // 8) % LINE
    return memory[begin : begin + n]


class Rollouts:
    """The compiled functions of one stage. A method says what its stage is, and how its tables become columns.

    Attributes
    ----------
    n_out : int
        Numbers of a state.
    n_values : int
        Numbers that a stage changes: those of the state, and others behind them, which begin as 0.
    lanes : int
        Trajectories of a batch that run side by side: of two registers or four, so that one need not wait for the
        other.
    fewest : int
        Trajectories that run in lanes rather than one after the other.
    room : int, optional
        Where states are in memory, how many numbers more stages need there; None where they are in registers.
    data : sequence of ndarray
        Arrays that stages of states in memory read: see `sympflow.kernels.runs.Room`.
    every : int, optional
        Steps after which `look` changes the running state.
    """

    lanes = 16
    fewest = 2
    room: int | None = None
    data: Sequence[np.ndarray] = ()
    every: int | None = None

    def __init__(self, n_values: int, n_out: int) -> None:
        self.n_values, self.n_out = n_values, n_out
        self._lock = threading.RLock()
        self._functions: dict[Any, Callable[..., None]] = {}

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        """The values after one column: see `sympflow.kernels.runs.Stage`."""
        raise NotImplementedError

    def look(self, values: Any) -> Any:
        """The running state changed, where there is `every`: see `sympflow.kernels.runs.run_function`."""
        raise NotImplementedError

    @cached_property
    def size(self) -> int:
        """Numbers of a column."""
        raise NotImplementedError

    def prepared(self, table: Any) -> Columns:
        """The columns of a table."""
        raise NotImplementedError

    def own_columns(self, table: Any, values: np.ndarray, width: int) -> Columns:
        """The columns of trajectories with their own values (N, n): a table for every `width` of them."""
        raise NotImplementedError

    def function(self, name: str, width: int) -> Callable[..., None]:
        """The compiled function of a name, see `made`."""
        found = self._functions.get((name, width))
        if found is None:
            with self._lock:
                found = self._functions.get((name, width))
                if found is None:
                    found = self._functions[name, width] = self.made(name, width)
        return found

    def made(self, name: str, width: int) -> Callable[..., None]:
        """Compile the function of a name: "run", "run own" or "map"."""
        memory = self.room is not None
        if name == "map":
            return map_function(self.n_values, self.n_out, self.size, self.stage, width, memory)
        look, every = (None, BLOCK) if self.every is None else (self.look, self.every)
        return run_function(
            self.n_values, self.n_out, self.size, self.stage, width, name == "run own", memory, look, every
        )

    def call(self, name: str, width: int, *arguments: Any) -> None:
        """Call the compiled function of a name with arrays and integers."""
        if self.room is not None:
            work = aligned((3 * self.n_values + self.room) * width)
            places = np.array([*map(address, self.data)], dtype=np.int64)
            arguments = *arguments, self.n_values, self.n_out, work, places
        self.function(name, width)(*[address(x) if isinstance(x, np.ndarray) else x for x in arguments])

    def rollout(
        self,
        table: Any,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        closed: bool = True,
    ) -> int:
        """The steps from `first` to `n_steps` from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``."""
        finite = np.empty(1, dtype=np.int64)
        self._run(table, y0[None], n_steps, save, out[None], finite, stop, first, running[None], closed, 1)
        return int(finite[0])

    def rollout_batch(
        self,
        table: Any,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        closed: bool = True,
    ) -> None:
        """`rollout` of every row of `y0` (N, 2d), in the lanes of registers; with own values (N, 2d + n) behind it."""
        rest = n_steps, save, stop, first, closed
        if len(y0) == 1 or y0.shape[1] > self.n_out:
            size = AT_ONCE if y0.shape[1] > self.n_out else 1
            for k in range(0, len(y0), size):
                rows = slice(k, k + size)
                self._some(table, y0[rows], out[rows], n_finite[rows], running[rows], *rest)
            return
        self._some(table, y0, out, n_finite, running, *rest)

    def _some(
        self,
        table: Any,
        y0: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        running: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        stop: np.ndarray,
        first: int,
        closed: bool,
    ) -> None:
        """Rows side by side; those that end before the last step once more, by themselves, to find that end."""
        before = running.copy() if first > 0 else running
        rest = stop, first
        width = self.lanes if len(y0) >= self.fewest else 1
        self._run(table, y0, n_steps, save, out, n_finite, *rest, running, closed, width)
        for i in np.flatnonzero(n_finite < n_steps) if width > 1 and not stop[0] else ():
            one = slice(i, i + 1)
            if len(before):
                running[i] = before[i]
            self._run(table, y0[one], n_steps, save, out[one], n_finite[one], *rest, running[one], closed, 1)

    def _run(
        self,
        table: Any,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        closed: bool,
        width: int,
    ) -> None:
        states = y0[:, : self.n_out]
        if y0.shape[1] > self.n_out:
            name, (entries, kinds) = "run own", self.own_columns(table, y0[:, self.n_out :], width)
        else:
            name, (entries, kinds) = "run", self.prepared(table)
        begun = int(np.searchsorted(save, 0, side="right")) if len(save) and save[0] <= 0 else 0
        if begun:
            out[:, :begun] = states[:, None]
        later, outputs = save[begun:], out
        if begun or not out.flags.c_contiguous:
            outputs = np.empty((len(y0), len(later), self.n_out))
        if first > 0:
            start = np.ascontiguousarray(running)
        elif self.n_values > self.n_out:
            start = np.concatenate([states, np.zeros((len(states), self.n_values - self.n_out))], axis=1)
        else:
            start = np.ascontiguousarray(states)
        keeps = running.shape[-1] > 0
        left = np.empty((len(y0), self.n_values)) if keeps else running
        given = entries, kinds, len(kinds) - 2, int(closed), start, len(y0), first, n_steps, later, len(later)
        self.call(name, width, *given, outputs, n_finite, left, int(keeps), stop)
        if outputs is not out:
            out[:, begun:] = outputs
        if keeps:
            running[:] = left
        if width == 1:
            for i in np.flatnonzero(n_finite < n_steps):
                out[i, np.searchsorted(save, n_finite[i], side="right") :] = np.nan
                if keeps:
                    running[i] = np.nan

    def rollout_processed(self, before: Any, run: Any, after: Any, y0: np.ndarray, *rest: Any) -> int:
        """`rollout` in other coordinates: `before` into them, and `after`, which begins with the last stage, out."""
        n_steps, save, out, stop, first, running = rest
        finite = np.empty(1, dtype=np.int64)
        rows = n_steps, save, out[None], finite, stop, first, running[None]
        self.rollout_processed_batch(before, run, after, y0[None], *rows)
        return int(finite[0])

    def rollout_processed_batch(self, before: Any, run: Any, after: Any, y0: np.ndarray, *rest: Any) -> None:
        """The same of every row of `y0` (N, 2d)."""
        n_steps, save, out, n_finite, stop, first, running = rest
        start = y0
        if first == 0:
            start = np.empty_like(y0)
            self.mapped(before, y0, start)
        self.rollout_batch(run, start, n_steps, save, out, n_finite, stop, first, running, False)
        self.mapped(after, out.reshape(-1, self.n_out), out.reshape(-1, self.n_out))
        out[:, : np.searchsorted(save, 0, side="right")] = y0[:, None]
        good = np.isfinite(out).all(-1)
        for i in np.flatnonzero(~good.all(-1)):
            row = int(np.argmin(good[i]))
            if save[row] <= n_finite[i]:
                out[i, row:], n_finite[i] = np.nan, save[row] - 1

    def mapped(self, table: Any, y: np.ndarray, out: np.ndarray) -> None:
        """All columns of a table, applied to rows `y` (N, 2d); `out` may be `y`."""
        if not len(y):
            return
        entries, kinds = self.prepared(table)
        width = 1 if len(y) == 1 else self.lanes
        self.call("map", width, entries, kinds, len(kinds), kinds, 1, y, len(y), out)
