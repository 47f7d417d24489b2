"""Ctrl-C in a training: it ends soon, with the best so far."""

from __future__ import annotations

import signal
import threading
from types import FrameType


class Interruption:
    """A context in which Ctrl-C asks for an end where there is something to return, and raises where there is not.

    A second one raises KeyboardInterrupt in any case. In another thread than the main one, or where the program has a
    handler of its own, nothing is changed.

    Attributes
    ----------
    armed : bool
        Whether there is something to return.
    asked : bool
        Whether the end was asked for; what runs looks at it.
    """

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
