"""Loops of splitting methods on systems of any size, whose states are changed in place: lattices, and bodies in pairs.

A large one is executed in pieces, which threads share: see `Team`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from sympflow.kernels.protocol import NOTHING
from sympflow.kernels.threads import NEVER, given, threads_for

__all__ = ["SizedLoops", "Team"]

T = TypeVar("T")
BLOCK, MOMENT = 64, 500_000_000
"""Most steps between two looks for a non-finite state and for an interrupt, of a system in pieces, and about how many
nanoseconds they take."""


class SizedLoops(ABC):
    """The functions that `SplittingLoops` asks for, of one system of any size and one kind of kicks.

    A subclass says which pieces the system has, and how stages are made of them: `_in_pieces`, `_advanced`, `_states`,
    `_load` and `_pack`.

    Parameters
    ----------
    module : ModuleType
        That of the text `sized_states` and what it stands on.
    compensated : bool
    work : int
        About how many nanoseconds a stage takes.
    n_pieces : int
        Pieces that threads may share.
    arguments : tuple
        The geometry, the size of a vector, and the values of parameters by site and of all: arguments of the loops.
    """

    def __init__(
        self, module: ModuleType, compensated: bool, work: int, n_pieces: int, arguments: tuple[Any, ...]
    ) -> None:
        self._module, self._compensated = module, compensated
        self._work, self._n_pieces, self._arguments = work, n_pieces, arguments

    # the functions of `SplittingLoops` ----------------------------------------------------------------------------

    def rollout(
        self,
        table: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        threads: int | None = None,
    ) -> int:
        """The steps of one state: see the text `loops`; on several threads where that pays."""
        with self._team(table.shape[1] * (n_steps - first), threads) as team:
            if not self._in_pieces(team.threads):
                whole = save, out, stop, first, running, False
                return self._module.rollout(table, y0, n_steps, *whole, *self._arguments)
            return self._rollout_in_pieces(team, table, y0, n_steps, save, out, stop, first, running)

    def rollout_batch(
        self,
        table: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
    ) -> None:
        """The same of every row of `y0` (N, 2d), each in one thread."""
        for i in range(len(y0)):
            own = running[i] if len(running) else NOTHING[0]
            n_finite[i] = self.rollout(table, y0[i], n_steps, save, out[i], stop, first, own, 1)

    def rollout_processed(
        self,
        before: np.ndarray,
        run: np.ndarray,
        after: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        threads: int | None = None,
    ) -> int:
        """`rollout` in other coordinates, `before` into them and `after` out of them."""
        start = np.zeros((1, len(y0)))
        if first == 0:
            self._map([before], y0[None], start)
        n_finite = self.rollout(run, start[0], n_steps, save, out, stop, first, running, threads)
        at_start = int(np.searchsorted(save, 0, "right"))
        self._map([after] * (len(out) - at_start), out[at_start:], out[at_start:])
        out[:at_start] = y0
        finite = np.isfinite(out).all(-1) | (save > n_finite)
        if finite.all():
            return n_finite
        row = int(np.argmin(finite))
        out[row:] = math.nan
        return int(save[row]) - 1

    def rollout_processed_batch(
        self,
        before: np.ndarray,
        run: np.ndarray,
        after: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
    ) -> None:
        """The same of every row of `y0` (N, 2d)."""
        tables = before, run, after
        for i in range(len(y0)):
            own = running[i] if len(running) else NOTHING[0]
            n_finite[i] = self.rollout_processed(*tables, y0[i], n_steps, save, out[i], stop, first, own, 1)

    def step_rows(
        self, table: np.ndarray, x: np.ndarray, h: np.ndarray, t: np.ndarray, y: np.ndarray, out: np.ndarray
    ) -> None:
        """One step of length ``h[i]`` from every row of `y` (N, 2d): see the text `loops`."""
        numbers = np.zeros((*table.shape[:2], len(h)))
        for k in range(table.shape[2] - 1, -1, -1):
            numbers = numbers * x + table[:, :, k, None]
        powers = np.array([1, 1, 3, 5])[: len(table)]
        tables = np.ascontiguousarray((numbers * h ** powers[:, None, None]).transpose(2, 0, 1))
        self._map(list(tables), y, out)

    def _map(self, tables: Sequence[np.ndarray], y: np.ndarray, out: np.ndarray) -> None:
        """The map of the columns of each table, of each row of `y`."""
        nothing, none = np.empty(0, dtype=np.int64), NOTHING[0]
        for i, (table, row) in enumerate(zip(tables, given(y), strict=True)):
            with self._team(table.shape[1], None) as team:
                if not self._in_pieces(team.threads):
                    to = out[i : i + 1]
                    self._module.rollout(table, row, 0, nothing, to, NEVER, 0, none, True, *self._arguments)
                    continue
                states = self._states(), self._states()
                self._load(row, states[0], 0)
                found, _ = self._advanced(team, states, table, 0, table.shape[1], True)
                self._pack(found[0], 0, out[i])

    # systems in pieces ----------------------------------------------------------------------------------------------

    def _rollout_in_pieces(
        self,
        team: Team,
        table: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
    ) -> int:
        link, width = table.shape[1] - 2, len(y0)
        most = max(1, min(BLOCK, MOMENT // max(1, link * self._work)))
        states = self._states(), self._states()

        def opened() -> int:
            """Load the running state after `first` steps; the column that comes next."""
            states[0][2:] = 0.0
            self._load(running[:width] if first else y0, states[0], 0)
            if first and self._compensated:
                self._load(running[width:], states[0], 2)
            return link if first else 0

        def closed() -> np.ndarray:
            """The end of the present step, beside the running state."""
            return self._advanced(team, states, table, link + 1, 1, False)[0][0]

        n, j = first, opened()
        saved = int(np.searchsorted(save, 0, "right"))
        out[:saved] = y0
        while n < n_steps and not stop[0]:
            block = min(most, n_steps - n, *([int(save[saved]) - n] if saved < len(save) else []))
            states, j = self._advanced(team, states, table, j, block * link, False)
            end = closed()
            if not _finite(end):
                out[saved:] = math.nan
                states, j = self._advanced(team, states, table, opened(), (n - first) * link, False)
                for _ in range(block - 1):
                    states, j = self._advanced(team, states, table, j, link, False)
                    if not _finite(closed()):
                        break
                    n += 1
                running[:] = math.nan
                return n
            n += block
            while saved < len(save) and save[saved] == n:
                self._pack(end, 0, out[saved])
                saved += 1
        if len(running):
            self._pack(states[0], 0, running[:width])
            if self._compensated:
                self._pack(states[0], 2, running[width:])
        return n_steps

    def _team(self, stages: int, threads: int | None) -> Team:
        """The threads of a run of so many stages."""
        return Team(threads_for(self._n_pieces, stages * self._work, threads))

    @abstractmethod
    def _in_pieces(self, threads: int) -> bool:
        """True if a run with so many threads is made in pieces, stage by stage from here; else by one compiled call."""

    @abstractmethod
    def _states(self) -> np.ndarray:
        """Room for a state: q, p and, with compensated sums, their errors first."""

    @abstractmethod
    def _load(self, y: np.ndarray, X: np.ndarray, first: int) -> None:
        """A row [q, p] into two sets of X, the first of which is given."""

    @abstractmethod
    def _pack(self, X: np.ndarray, first: int, y: np.ndarray) -> None:
        """The inverse of `_load`."""

    @abstractmethod
    def _advanced(
        self, team: Team, states: tuple[np.ndarray, np.ndarray], table: np.ndarray, j: int, count: int, single: bool
    ) -> tuple[tuple[np.ndarray, np.ndarray], int]:
        """The states after `count` stages from column j on, the first of them the present one; and the column after.

        Of a run, or of a `single` map. One stage leaves the present state as it is, as the second one.
        """


def _finite(X: np.ndarray) -> bool:
    with np.errstate(all="ignore"):
        return bool(np.isfinite(X[:2].sum()) or np.isfinite(X[:2]).all())


class Team:
    """Threads that share the pieces of a system, each the same ones every time."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None

    def __enter__(self) -> Team:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def __call__(self, pieces: Callable[[int, int], None], n: int) -> None:
        """``pieces(first, last)`` over 0 … n."""
        if self._pool is None:
            pieces(0, n)
            return
        bounds = [n * k // self.threads for k in range(self.threads + 1)]
        others = [self._pool.submit(pieces, *ends) for ends in pairwise(bounds[1:])]
        pieces(bounds[0], bounds[1])
        for other in others:
            other.result()
