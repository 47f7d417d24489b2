"""Progress: how much of a long call is done, reported to a function of the user or drawn as a bar on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

Asked = bool | Callable[[Any, Any], Any]
"""The argument `progress` of long calls: True for a bar, or a function of what is done and the total."""
BETWEEN = 0.1  # seconds between two times that progress is told or drawn, at least
WIDTH = 24  # characters of the bar


class Progress:
    """Progress of one call: the part of a total that is done, as reported."""

    def __init__(self, asked: Asked, total: Any, told: Callable[[Any], str]) -> None:
        check_progress(asked)
        self.function = asked if callable(asked) else None
        self.draws = asked is True
        self.total, self.told = total, told
        self.begin = self.last = time.perf_counter()
        self.first: Any = None
        self.done: Any = None

    def __call__(self, done: Any) -> None:
        """Report the progress."""
        now = time.perf_counter()
        if self.first is None:  # a run that is resumed begins later than at 0
            self.first = done
        if now - self.last < BETWEEN and done != self.total:
            return
        self.last, self.done = now, done
        if self.function is not None:
            self.function(done, self.total)
        elif self.draws:
            self._draw(done, now - self.begin)

    def end(self) -> None:
        """Leave the bar as it is, and begin a new line."""
        if self.draws and self.first is not None:
            print(file=sys.stderr, flush=True)

    def _draw(self, done: Any, elapsed: float) -> None:
        part = done / self.total if self.total else 1.0
        filled = int(WIDTH * part)
        left = ""
        if done > self.first:
            seconds = round(elapsed * (self.total - done) / (done - self.first))
            left = f", {seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"
        bar = "#" * filled + "-" * (WIDTH - filled)
        print(f"\r[{bar}] {int(100 * part):3} %  {self.told(done)}{left}   ", end="", file=sys.stderr, flush=True)


def check_progress(asked: Any) -> None:
    """Raise a TypeError unless `progress` is True, False or a function."""
    if not (isinstance(asked, bool) or callable(asked)):
        raise TypeError(f"`progress` must be True, False, or a function of (done, total); got {asked!r}.")
