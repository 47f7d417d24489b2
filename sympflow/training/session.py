"""One call of `train`: Ctrl-C, the time that it may take, the file that keeps it, and the progress that is shown."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from sympflow.arguments import real_number
from sympflow.training.checkpoint import check_writable
from sympflow.workers import Unpicklable, WorkerPool, available_cores

Path = str | os.PathLike[str]
Callback = Callable[[int, dict[str, float]], None]

GRACE = 1.0  # seconds that workers have for the step that is under way when their time is up
LEAST_PART = 1.0  # seconds that a part of a budget has at least: what is compiled and imported takes as long


class OutOfTime(Exception):
    """Raised within a task whose time is up, or that Ctrl-C ended."""


class Interruption:
    """A context in which Ctrl-C requests an end once it is `armed`; before that, and a second time, it raises."""

    def __init__(self) -> None:
        self.armed = self.asked = False
        self._installed = False

    def __enter__(self) -> Interruption:
        in_main = threading.current_thread() is threading.main_thread()
        self._installed = in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._installed:
            signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked or not self.armed:
            raise KeyboardInterrupt
        self.asked = True


@dataclass
class Session:
    """The surroundings of a run, and the clock that began with it."""

    checkpoint: Path | None = None
    resume: Path | None = None
    time_budget: float | None = None
    progress: bool | None = False
    callback: Callback | None = None
    pool: WorkerPool = field(default_factory=WorkerPool)
    interruption: Interruption = field(default_factory=Interruption)
    cut: bool = field(default=False, init=False)
    pool_is_busy: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._began = time.perf_counter()
        budget, callback = self.time_budget, self.callback
        if budget is not None and not (real_number(budget) and 0 < budget < math.inf):
            raise ValueError(f"`time_budget` must be a positive number of seconds; got {budget!r}: leave it out.")
        if callback is not None and not callable(callback):
            raise TypeError(
                f"`callback` must be a function of the step and the figures; got {callback!r}: leave it out."
            )
        for name, path in (("checkpoint", self.checkpoint), ("resume", self.resume)):
            if path is not None and not isinstance(path, (str, os.PathLike)):
                raise TypeError(f"`{name}` must be the path of a file; got {path!r}: pass a string or leave it out.")
        if self.checkpoint is not None:
            check_writable(self.checkpoint)

    @property
    def passed(self) -> float:
        """Seconds since the session began."""
        return time.perf_counter() - self._began

    @property
    def deadline(self) -> Deadline:
        """The moment by which all that the session does has to end."""
        return Deadline(self, math.inf if self.time_budget is None else self._began + self.time_budget)

    def each(
        self,
        function: Callable[[Any, Any], Any],
        common: Any,
        items: Sequence[Any],
        deadline: Deadline,
        threads: bool = False,
    ) -> Generator[Any]:
        """Yield `function(common, item)` of each item in order, by the pool, or by `threads` where that is this one.

        While others work Ctrl-C raises KeyboardInterrupt here. After that, or where workers do not answer soon after
        the deadline, this thread does the rest.
        """
        interruption = self.interruption
        ended = interruption.asked or deadline.left <= 0
        n_threads = min(available_cores(), len(items)) if threads else 1
        if self.pool_is_busy or ended or len(items) < 2 or (self.pool.alone and n_threads < 2):
            for item in items:
                yield function(common, item)
            return
        executor = ThreadPoolExecutor(n_threads) if self.pool.alone else None
        pool = self.pool if executor is None else WorkerPool(executor)
        patience = None if deadline.end == math.inf else deadline.left + GRACE
        answers, left = pool.map(function, common, items, patience), len(items)
        self.pool_is_busy = True
        try:
            while left:
                armed = interruption.armed
                interruption.armed = armed and executor is not None
                try:
                    answer = next(answers)
                except TimeoutError:
                    break
                except Unpicklable as error:
                    raise TypeError(
                        f"`system` cannot be sent to `workers` ({error}): define its functions in a module, or leave "
                        "`workers` out."
                    ) from error
                finally:
                    interruption.armed = armed
                left -= 1
                self.pool_is_busy = left > 0
                yield answer
            self.pool_is_busy = False
            for item in items[len(items) - left :]:
                yield function(common, item)
        finally:
            self.pool_is_busy = False
            if executor is not None:
                executor.shutdown(wait=False, cancel_futures=True)

    def bar(self, total: int | None, label: str, start: int = 0) -> Silent:
        """The display of so many steps, None where their number is not known, as a context."""
        if not (sys.stderr.isatty() if self.progress is None else self.progress):
            return Silent()
        try:
            return Bar(total, label, start)
        except ImportError:
            return Lines(total, label)


@dataclass(frozen=True)
class Deadline:
    """The moment by which a task has to end; it is handed down to all that takes long."""

    session: Session
    end: float = math.inf

    def __reduce__(self) -> tuple[Any, ...]:
        """By the time of day, for another process, which has no part in the session."""
        return _deadline_at, (time.time() + self.left,)

    @property
    def left(self) -> float:
        """Seconds."""
        return self.end - time.perf_counter() if self.end < math.inf else math.inf

    def over(self) -> bool:
        """Return whether to end: called between steps."""
        over = self.session.interruption.asked or self.left <= 0
        self.session.cut = self.session.cut or over
        return over

    def check(self) -> None:
        """Raise OutOfTime if it is over: called within a step."""
        if self.over():
            raise OutOfTime

    def part(self, share: float) -> Deadline:
        """The end of this share of the time left, or of a second if that is more."""
        if self.end == math.inf:
            return self
        return Deadline(self.session, time.perf_counter() + max(share * self.left, LEAST_PART))

    def before(self, seconds: float) -> Deadline:
        """So many seconds earlier, for what comes after."""
        return Deadline(self.session, self.end - seconds)


def _deadline_at(end: float) -> Deadline:
    return Deadline(Session(), time.perf_counter() + end - time.time())


# progress -------------------------------------------------------------------------------------------------------


class Silent:
    """Shows nothing."""

    def __enter__(self) -> Silent:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def advance(self, step: int, loss: float) -> None:
        pass

    def tries(self, done: int, what: str) -> None:
        pass


class Lines(Silent):
    """One line for each validation, where rich is not installed."""

    def __init__(self, total: int | None, label: str) -> None:
        self.total, self.label = total or "?", label

    def tries(self, done: int, what: str) -> None:
        print(f"{self.label} {done}/{self.total}  {what}", file=sys.stderr, flush=True)


class Bar(Silent):
    """A bar with the losses, the one-step error and the time left."""

    def __init__(self, total: int | None, label: str, start: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        description, figures = TextColumn("[bold]{task.description}"), TextColumn("{task.fields[figures]}")
        columns = description, BarColumn(), MofNCompleteColumn(), figures, TimeRemainingColumn()
        self.bar = Progress(*columns, console=Console(stderr=True))
        self.task: Any = self.bar.add_task(label, total=total, completed=start, figures="")
        self.figures = ""

    def __enter__(self) -> Bar:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def advance(self, step: int, loss: float) -> None:
        if step % 10 == 0:
            self.bar.update(self.task, completed=step, figures=f"loss {loss:.1e}  {self.figures}")

    def tries(self, done: int, what: str) -> None:
        self.figures = what
        self.bar.update(self.task, completed=done, figures=what)


def shown(figures: dict[str, float]) -> str:
    """Figures in short."""
    names = {"loss": "held-out", "residual_loss": "L1", "matching_loss": "L2", "one_step_error": "one-step"}
    return "  ".join(f"{short} {figures[name]:.1e}" for name, short in names.items() if name in figures)
