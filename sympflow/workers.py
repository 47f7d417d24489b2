"""A map over workers: this thread, threads, processes, or an engine that a user hands in.

The conventions are SciPy's and gala's: a number; an object with `.map`, as an Executor, a dask Client, a pool of
schwimmbad or mpi4py; or a function such as `map` itself. Of an engine only `.map` is used, which may return values or
futures. The task of a worker that died is repeated.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import reprlib
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent import futures
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from sympflow._version import __version__

TRIES = 3  # times in a row that workers may die before anything was done
LOOK = 0.2  # seconds between two looks at the processes of a pool that does not tell when they die
LOST = {"KilledWorker", "FutureCancelledError", "TerminatedWorkerError"}
"""Names of the errors by which engines say that a worker died: of dask and joblib, which need not be installed."""
SAME = ("numpy", "llvmlite")  # distributions whose versions may decide the last bits of a result


class LostWorkers(RuntimeError):
    """Workers died several times in a row, and nothing more was done."""


class Unpicklable(TypeError):
    """The call that workers are to be sent cannot be pickled."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def checked_workers(workers: Any) -> Any:
    """The number of workers, −1 being as many as there are cores, or the engine as it is."""
    if isinstance(workers, int) and not isinstance(workers, bool):
        if workers == -1:
            return available_cores()
        if workers < 1:
            raise ValueError(
                f"`workers` must be a positive number, or −1 for as many as there are cores; got {workers}."
            )
        return workers
    if workers is map:  # which is a class
        return workers
    if isinstance(workers, type) or not (callable(getattr(workers, "map", None)) or callable(workers)):
        raise TypeError(
            f"`workers` must be a number, an object with .map (an Executor, a dask Client, a pool), or a function such "
            f"as map; got {workers!r}. Pass a number such as 2, or make an instance."
        )
    return workers


@cache
def _versions() -> dict[str, str]:
    found = {"sympflow": __version__, "Python": ".".join(map(str, sys.version_info[:2]))}
    for name in SAME:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # frozen into a program
            found[name] = "unknown"
    return found


class PickledTask:
    """The common part of all calls: pickled once, and unpacked once by each worker; in this process sent as it is."""

    def __init__(self, value: Any) -> None:
        self._value, self._packed = value, b""
        self._blob = b""

    @property
    def value(self) -> Any:
        """The object; an error if it was packed with other versions than those that are installed here."""
        return _unpacked(self._packed) if self._packed else self._value

    def pack(self) -> bytes:
        """The object as bytes, with the versions of the program; an Unpicklable if it cannot be pickled."""
        if not self._blob:
            self._blob = pickle.dumps((_versions(), _pickled(self._value)))
        return self._blob

    def __reduce__(self) -> tuple[Any, ...]:
        return _sent, (self.pack(),)


def _sent(packed: bytes) -> PickledTask:
    task = PickledTask(None)
    task._packed = task._blob = packed
    return task


def _pickled(value: Any) -> bytes:
    """Return the pickle of an object.

    It is cloudpickle's, if that is installed, where Python's refuses functions that are in no module, or finds some in
    the script that runs, which the workers of an engine do not import.
    """
    refused, data = None, b""
    try:
        data = pickle.dumps(value)
        if b"__main__" not in data:
            return data
    except Exception as error:
        refused = error
    try:
        import cloudpickle

        return cloudpickle.dumps(value)
    except Exception:
        if refused is not None:
            raise Unpicklable(f"{type(refused).__name__}: {refused}") from refused
        return data


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Any:
    theirs, value = pickle.loads(packed)
    mine = _versions()
    if theirs != mine:
        other = [
            f"{name} {mine.get(name)} instead of {theirs[name]}" for name in theirs if mine.get(name) != theirs[name]
        ]
        raise ValueError(
            f"`workers` run other versions than this program: {', '.join(other)}, so that results might differ. "
            "Install the same versions everywhere."
        )
    return pickle.loads(value)


@dataclass(frozen=True)
class Answer:
    """The result of a call, or its exception."""

    index: int
    value: Any
    error: Exception | None = None


class _Call:
    """A call of `function(common, item)` for a numbered item."""

    def __init__(self, function: Callable[[Any, Any], Any], common: PickledTask) -> None:
        self.function, self.common = function, common
        self.__name__ = function.__name__  # by which engines call it

    def __call__(self, numbered: tuple[int, int, Any]) -> Answer:
        _, index, item = numbered
        try:
            return Answer(index, self.function(self.common.value, item))
        except Exception as error:
            try:
                pickle.loads(pickle.dumps(error))
            except Exception:
                error = RuntimeError(f"{type(error).__name__}: {error}")
            return Answer(index, None, error)


Numbered = tuple[int, int, Any]


class _Clock:
    """The seconds that are left to wait for answers: None without an end."""

    def __init__(self, timeout: float | None) -> None:
        self.end = None if timeout is None else time.monotonic() + timeout

    def left(self) -> float | None:
        return None if self.end is None else max(0.0, self.end - time.monotonic())


def mapped(
    function: Callable[[Any, Any], Any],
    common: Any,
    items: Iterable[Any],
    workers: Any = 1,
    *,
    processes: bool = False,
    timeout: float | None = None,
) -> Iterator[tuple[int, Any]]:
    """Yield the index of each item and `function(common, item)`, in the order in which they are ready.

    Parameters
    ----------
    function : callable
        Of a module, so that its name is enough to find it.
    common : object
        The first argument of all calls: each worker receives it, and unpacks it once.
    items : iterable
    workers : int, object with .map, or callable
        See the module's docstring.
    processes : bool
        True if a number of workers is one of processes, because Python code runs for long; else they are threads.
    timeout : float, optional
        Seconds to wait for answers in all, where they come from an `Executor`, from futures, or a number of workers.

    Raises
    ------
    LostWorkers
        If workers die again and again.
    TimeoutError
        After `timeout` seconds: tasks that have not begun are cancelled, running ones are left.
    TypeError
        If the `.map` of `workers` does not return the results.
    Unpicklable
        If processes cannot be sent `common`.
    Exception
        The exception of `function` for the first item that fails.
    """
    workers = checked_workers(workers)
    call, left, clock = _Call(function, PickledTask(common)), dict(enumerate(items)), _Clock(timeout)
    answers = _rounds(1 if isinstance(workers, int) and len(left) < 2 else workers, call, processes, clock)
    attempt = idle = 0
    while left:
        done = 0
        try:
            for answer in answers([(attempt, index, item) for index, item in left.items()]):
                if answer.error is not None:
                    raise answer.error
                if left.pop(answer.index, _Lost) is _Lost:  # some engines do a call twice
                    continue
                done += 1
                yield answer.index, answer.value
            if left and not done:
                raise _no_results(len(left), "nothing")
        except _Lost as loss:
            attempt, idle = attempt + 1, 0 if done else idle + 1
            if idle >= TRIES:
                raise LostWorkers(
                    f"`workers` died {TRIES} times in a row ({loss}) with {len(left)} chunks to do. The system "
                    "may have ended them for the memory that they took: take a smaller `chunk`, or fewer workers. "
                    "A script that starts processes needs `if __name__ == '__main__':` around what it runs."
                ) from loss.__cause__
            if isinstance(workers, futures.Executor) and not done:  # broken for good
                n = getattr(workers, "_max_workers", None) or available_cores()
                warnings.warn(
                    "A process of the executor `workers` died, so that it accepts no more work: the rest is done in "
                    f"{n} new processes.",
                    RuntimeWarning,
                    stacklevel=2,
                )
                workers, answers = n, _rounds(n, call, True, clock)


class WorkerPool:
    """Workers that stay from one map to the next, closed as a context; a number is one of processes.

    Ctrl-C is left to the program that has them: it ends them.

    Parameters
    ----------
    workers : int, object with .map, or callable
        See the module's docstring.
    """

    def __init__(self, workers: Any = 1) -> None:
        self.workers = checked_workers(workers)
        self._pool: futures.ProcessPoolExecutor | None = None

    @property
    def alone(self) -> bool:
        """True if all is done on this thread."""
        return isinstance(self.workers, int) and self.workers == 1

    def map(
        self, function: Callable[[Any, Any], Any], common: Any, items: Sequence[Any], timeout: float | None = None
    ) -> Iterator[Any]:
        """Yield `function(common, item)` of each item, in their order; raises as `mapped` does."""
        workers = self.workers
        if isinstance(workers, int) and workers > 1 and len(items) > 1:
            if self._pool is None:
                self._pool = futures.ProcessPoolExecutor(workers, _context(), _leave_interrupts)
            workers = self._pool
        early: dict[int, Any] = {}
        following = 0
        for index, value in mapped(function, common, items, workers, timeout=timeout):
            early[index] = value
            while following in early:
                yield early.pop(following)
                following += 1

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes, whatever they do."""
        if self._pool is not None:
            processes = list((self._pool._processes or {}).values())
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            self._pool = None


def _leave_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _rounds(workers: Any, call: _Call, processes: bool, clock: _Clock) -> Callable[[list[Numbered]], Iterable[Answer]]:
    """Return the function that gives the answers of numbered items, as they come, by such workers."""
    if not isinstance(workers, int):
        if isinstance(workers, futures.ProcessPoolExecutor):
            call.common.pack()
        return partial(_by_map, workers, call, clock)
    if workers == 1:
        return partial(map, call)
    if not processes:
        return partial(_in_pool, partial(futures.ThreadPoolExecutor, workers), call, 2 * workers, clock)
    call.common.pack()
    return partial(_in_pool, partial(futures.ProcessPoolExecutor, workers, _context()), call, 2 * workers, clock)


class _Lost(Exception):
    """A worker died, or its result was lost."""


def _is_loss(error: BaseException) -> bool:
    lost = isinstance(error, futures.BrokenExecutor | futures.CancelledError)
    return lost or any(c.__name__ in LOST for c in type(error).__mro__)


def _context() -> Any:
    """Return the way to start processes: afresh, for a fork of a program with threads may wait forever."""
    return multiprocessing.get_context("spawn")


def _in_pool(
    make: Callable[[], futures.Executor], call: _Call, most: int, clock: _Clock, todo: list[Numbered]
) -> Iterator[Answer]:
    """Answers as they come, from a pool that is closed afterwards; never more than `most` calls are under way."""
    pool = make()
    waiting = iter(todo)
    under_way: set[futures.Future[Answer]] = set()
    try:
        while True:
            for numbered in waiting:
                under_way.add(pool.submit(call, numbered))
                if len(under_way) >= most:
                    break
            if not under_way:
                break
            ready, under_way = futures.wait(under_way, clock.left(), return_when=futures.FIRST_COMPLETED)
            if not ready:
                raise TimeoutError
            lost = None
            for future in ready:
                try:
                    answer = future.result()
                except futures.BrokenExecutor as error:
                    lost = error
                    continue
                yield answer
            if lost is not None:
                raise _Lost(str(lost)) from lost
    except futures.BrokenExecutor as error:
        raise _Lost(str(error)) from error
    finally:
        pool.shutdown(wait=isinstance(pool, futures.ThreadPoolExecutor), cancel_futures=True)


def _by_map(workers: Any, call: _Call, clock: _Clock, todo: list[Numbered]) -> Iterator[Answer]:
    """Answers by the `.map` of an engine, in the order of the calls; of futures, of all that were not lost."""
    lost: BaseException | None = None
    try:
        answers = _map_of(workers, clock)(call, todo)
        if not isinstance(answers, Iterable):
            raise _no_results(len(todo), reprlib.repr(answers))
        for given in answers:
            try:
                answer = given if isinstance(given, Answer) else _result_of(given, clock)
            except Exception as error:
                if not _is_loss(error):
                    raise
                lost = error
                continue
            if not isinstance(answer, Answer):
                raise _no_results(len(todo), f"{reprlib.repr(given)} among others")
            yield answer
    except Exception as error:
        if not _is_loss(error):
            raise
        lost = error
    if lost is not None:
        raise _Lost(f"{type(lost).__name__}: {lost}") from lost


def _result_of(future: Any, clock: _Clock) -> Any:
    """The result of a future; None for anything else."""
    result = getattr(future, "result", None)
    if not callable(result):
        return None
    left = clock.left()
    return result() if left is None else result(timeout=left)


def _no_results(n: int, got: str) -> TypeError:
    return TypeError(
        f"`workers` must return the results of the {n} calls of its .map, or futures of them; it returns {got}. An "
        "engine has the signature of Python's map: .map(function, items)."
    )


def _map_of(workers: Any, clock: _Clock) -> Callable[[_Call, list[Numbered]], Iterable[Any]]:
    """Return the map of an engine."""
    joblib = sys.modules.get("joblib")
    if joblib is not None and isinstance(workers, joblib.Parallel):
        return lambda call, todo: workers(joblib.delayed(call)(numbered) for numbered in todo)
    pools = sys.modules.get("multiprocessing.pool")
    if pools is not None and isinstance(workers, pools.Pool) and not isinstance(workers, pools.ThreadPool):
        return lambda call, todo: _watched(workers, call, todo)
    if isinstance(workers, futures.Executor) and (left := clock.left()) is not None:
        return partial(workers.map, timeout=left)
    return getattr(workers, "map", workers)


def _watched(pool: Any, call: _Call, todo: list[Numbered]) -> Iterator[Answer]:
    """The map of a pool of `multiprocessing`, which waits forever for a process that died: they are looked at."""
    size = max(1, len(todo) // 8)
    for start in range(0, len(todo), size):
        children = multiprocessing.active_children()
        answers: list[Any] = []
        part = todo[start : start + size]
        thread = threading.Thread(target=lambda a=answers, p=part: a.append(_caught(pool.map, call, p)), daemon=True)
        thread.start()
        while thread.is_alive():
            thread.join(LOOK)
            dead = [child for child in children if child.exitcode not in (None, 0)]
            if thread.is_alive() and dead:
                raise _Lost(f"process {dead[0].pid} ended with exit code {dead[0].exitcode}")
        if isinstance(answers[0], Exception):
            raise answers[0]
        yield from answers[0]


def _caught(function: Callable[..., Any], *args: Any) -> Any:
    try:
        return list(function(*args))
    except Exception as error:
        return error
