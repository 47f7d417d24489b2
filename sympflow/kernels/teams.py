"""Teams: threads that make one run together, and meet where one needs what others have made.

A pool's threads need as long to begin as the forces of some hundred bodies take: those of a team run on to the end.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, NamedTuple

import numpy as np

from sympflow.compiler.control import INT, Code, Type, Value
from sympflow.compiler.machine import address, given
from sympflow.kernels.rollouts import Columns, SplittingRollouts
from sympflow.kernels.runs import BLOCK, Memory, Room
from sympflow.kernels.threads import NEVER, threads_for

__all__ = ["Member", "SharedMemory", "SharedRollouts", "meet"]

ARRIVED, TURN = 0, 8
"""Places in `meeting` (16,), in lines of the cache of their own: threads that are here, and times that all were."""
SPINS, YIELDS = 1_000, 2_000  # looks before a thread lets others run, and before it sleeps
PAUSE = 20  # µs
MOMENT = 200_000_000  # about how many nanoseconds pass between two looks for an interrupt
_I32 = Type("i32")


def together(threads: int, member: Callable[[int], None], stop: np.ndarray) -> None:
    """``member(k)`` of each thread k at the same time; one that fails sets ``stop[0]``, which ends the others."""
    if threads == 1:
        member(0)
        return

    def guarded(k: int) -> None:
        try:
            member(k)
        except BaseException:
            stop[0] = 1  # the others would wait for ever
            raise

    with ThreadPoolExecutor(threads - 1) as pool:
        try:
            others = [pool.submit(copy_context().run, guarded, k) for k in range(1, threads)]
            guarded(0)
            for other in others:
                other.result()
        except BaseException:
            stop[0] = 1
            raise


def meet(meeting: Value, members: Value, stop: Value) -> None:
    """Write code that waits until so many threads are here, or until ``stop[0]`` is 1."""
    with meeting.code.given(members > 1):
        meeting.code.outlined("meet", (meeting, members, stop), _waited)


def _waited(meeting: Value, members: Value, stop: Value) -> None:
    code, (meeting, stop) = meeting.code, (meeting.code.address(x) for x in (meeting, stop))

    def seen(place: int) -> Value:
        return code.load(meeting, place, INT, shared=True)

    turn, one = seen(TURN), code.constant(1, INT)
    last = code.apply("eq", (code.added(one, meeting, ARRIVED) + 1, members))
    with code.given(last):
        code.added(-members, meeting, ARRIVED)
        code.added(one, meeting, TURN)
    looks, going = code.variable(code.constant(0, INT)), code.variable(~last)
    with code.during(lambda: going.value):
        looks.value = looks.value + 1
        if os.name == "posix":
            with code.given((looks.value > SPINS) & (looks.value <= SPINS + YIELDS)):
                code.external("sched_yield", (), _I32)
            with code.given(looks.value > SPINS + YIELDS):
                code.external("usleep", (code.constant(PAUSE, _I32),), _I32)
        stopped = code.apply("eq", (code.load(stop, 0, INT, shared=True), 0))
        going.value = code.apply("eq", (seen(TURN), turn)) & stopped


class Member(NamedTuple):
    """The view that one thread has of its team."""

    room: np.ndarray  # for three states
    context: np.ndarray  # numbers and addresses that stages read, of int64
    others: Any  # what is kept for these addresses


class SharedMemory(Memory, ABC):
    """A state in memory as so many sets of numbers, positions, momenta and their errors, which threads share."""

    at_once = 8

    def __init__(self, sets: int, code: Code, width: int, arguments: Sequence[Value], before: bool) -> None:
        super().__init__(code, width, arguments, before)
        self._sets, self._context = sets, arguments[3]

    @abstractmethod
    def copied(self, room: Room, rows: Value, row: Value, sets: int, loads: bool) -> None:
        """Take sets of a state from a row, or write them there."""

    def open(self, rows: Value, begin: Value, n_rows: Value, given: int | None = None, own: int = 0) -> None:
        with self._blocks() as (i, type):
            self.code.store(self.code.constant(0.0, type), self._running.place, i)
        self.copied(self._running, rows, begin, self._sets if given is None else 2, True)

    def store(self, out: Value, begin: Value, n_rows: Value, stride: Value, at: Value) -> None:
        self.copied(self._end, out, begin * stride + at, 2, False)

    def keep(self, running: Value, begin: Value, n_rows: Value) -> None:
        self.copied(self._running, running, begin, self._sets, False)


class SharedRollouts(SplittingRollouts):
    """Rollouts of states in memory, which `pieces` threads may share; a stage takes about `work` nanoseconds."""

    lanes = 1
    room = 0
    work: int
    pieces: int
    terms: int

    @abstractmethod
    def members(self, meeting: np.ndarray, stop: np.ndarray, threads: int, block: int) -> Callable[[int], Member]:
        """The maker of the members of a team: by the numbers where it meets and what ends it, the threads, and the most
        steps between two looks for an interrupt."""

    def prepared(self, table: np.ndarray) -> Columns:
        """The columns of a table; their kinds tell the last of b, g and c that is not 0, from 1 on."""
        kinds = np.zeros(table.shape[1], dtype=np.int64)
        for k in range(1, 1 + self.terms):
            kinds[table[k] != 0] = k
        return np.ascontiguousarray(table.T), kinds

    def call(self, name: str, width: int, *arguments: Any, n_out: int | None = None) -> None:
        """Call a compiled run or map; one state is shared by several threads where that pays."""
        if name == "run":
            n_rows, n_columns = arguments[5], arguments[2] * (arguments[7] - arguments[6])
        else:
            n_rows, n_columns = arguments[6], arguments[2]
        stop = np.zeros(1, dtype=np.int64)
        if name == "run" and arguments[-1] is not NEVER:
            stop = arguments[-1]
        elif name == "run":
            arguments = *arguments[:-1], stop
        threads = threads_for(self.pieces, n_columns * self.work, None) if n_rows == 1 and os.name == "posix" else 1
        function, meeting = self.function(name, width), np.zeros(16, dtype=np.int64)
        shared = given(arguments)
        members = self.members(meeting, stop, threads, max(1, min(BLOCK, MOMENT // max(1, self.work))))

        def run(k: int) -> None:
            own = members(k)
            function(*shared, len(own.room) // 3, self.n_out, address(own.room), address(own.context))

        together(threads, run, stop)

    def own_steps(self, table: np.ndarray, y: np.ndarray) -> np.ndarray:
        out, tables = np.empty_like(y), table.reshape(len(table), -1, len(y))
        for i in range(len(y)):
            self.mapped(tables[..., i], y[i : i + 1], out[i : i + 1])
        return out
