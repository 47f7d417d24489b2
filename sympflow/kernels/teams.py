"""Teams: threads that make one run together, and meet where one needs what others have made.

A pool's threads need a tenth of a millisecond to begin and to end a piece of work, as long as the forces of some
hundred bodies. Those of a team run the same compiled code from the first step to the last, and meet in it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context

import numpy as np

from sympflow.compiler.control import INT, Type, Value

__all__ = ["Team", "meet"]

ARRIVED, TURN = 0, 8
"""Places in `meeting` (16,), in lines of the cache of their own: threads that are here, and times that all were."""
SPINS, YIELDS = 20_000, 200  # looks before a thread lets others run, and before it sleeps
PAUSE = 20  # µs
_I32 = Type("i32")


class Team:
    """So many threads.

    Parameters
    ----------
    threads : int
        One, where threads cannot leave a core.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads if os.name == "posix" else 1

    def __call__(self, member: Callable[[int], None], stop: np.ndarray) -> None:
        """``member(k)`` of each thread k at the same time; one that fails sets ``stop[0]``, which ends the others."""
        if self.threads == 1:
            member(0)
            return

        def guarded(k: int) -> None:
            try:
                member(k)
            except BaseException:
                stop[0] = 1  # the others would wait for ever
                raise

        with ThreadPoolExecutor(self.threads - 1) as pool:
            try:
                others = [pool.submit(copy_context().run, guarded, k) for k in range(1, self.threads)]
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
