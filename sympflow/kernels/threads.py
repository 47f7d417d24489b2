"""Runs of compiled code on threads, and what such code is given."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

__all__ = ["NEVER", "at_most", "given", "run_one", "run_rows", "threads_for"]

T = TypeVar("T")

BLOCK = 64  # a thread takes a multiple of so many rows
LONG = 100_000_000  # units of work from which a run can be interrupted
NEVER = np.zeros(1, dtype=np.int64)
"""The `stop` of runs that are not stopped."""
WORTH_A_THREAD = 500_000  # units of work, about a nanosecond each, below which another thread does not pay

_most_threads: ContextVar[int | None] = ContextVar("most_threads", default=None)


def given(x: ArrayLike, dtype: DTypeLike = np.float64) -> np.ndarray:
    """An array as compiled functions are given it: contiguous, and not read-only."""
    array = np.ascontiguousarray(x, dtype=dtype)
    return array if array.flags.writeable else array.copy()


@contextmanager
def at_most(threads: int) -> Iterator[None]:
    """Run what is inside, in this thread, on at most so many threads: for callers that have workers of their own."""
    token = _most_threads.set(threads)
    try:
        yield
    finally:
        _most_threads.reset(token)


def run_one(call: Callable[[np.ndarray], T], work: float) -> T:
    """``call(stop)``, whose work takes about so many nanoseconds or more; it must end soon once ``stop[0]`` is set.

    Compiled code in the main thread holds Ctrl-C off until it returns. So long calls run in another thread, while this
    one waits.
    """
    if work < LONG:
        return call(NEVER)
    return run_in_threads([call])[0]


def threads_for(n_pieces: int, work: float, threads: int | None) -> int:
    """The number of threads for so many pieces and nanoseconds of work: that given, or as many as pay."""
    threads = _most_threads.get() if threads is None else threads
    if threads is None:
        threads = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
        threads = min(threads, 1 + int(work // WORTH_A_THREAD))
    return max(1, min(threads, n_pieces))


def run_rows(rows: Callable[[slice, np.ndarray], None], n_rows: int, work_per_row: float, threads: int | None) -> None:
    """Call ``rows(slice, stop)`` without the GIL over 0 … n_rows, on threads if the work is worth it; see `run_one`."""
    n_blocks = -(-n_rows // BLOCK)
    threads = threads_for(n_blocks, n_rows * work_per_row, threads) if n_blocks > 1 else 1
    if threads == 1:
        run_one(partial(rows, slice(0, n_rows)), n_rows * work_per_row)
        return
    bounds = [BLOCK * (n_blocks * k // threads) for k in range(threads)] + [n_rows]
    run_in_threads([partial(rows, slice(*ends)) for ends in pairwise(bounds)])


def run_in_threads(calls: Sequence[Callable[[np.ndarray], T]]) -> list[T]:
    """``call(stop)`` of each, at the same time; for `stop` see `run_one`."""
    stop = np.zeros(1, dtype=np.int64)
    with ThreadPoolExecutor(len(calls)) as pool:
        futures = [pool.submit(copy_context().run, call, stop) for call in calls]  # with the limit of `at_most`
        try:
            return [future.result() for future in futures]
        except BaseException:  # of the user's, most likely: the threads need not go on
            stop[0] = 1
            raise
