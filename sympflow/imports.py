"""Imports that an interrupt does not cut in two."""

from __future__ import annotations

import signal
import sys
import threading
from importlib import import_module
from types import FrameType, ModuleType


def whole_import(name: str) -> ModuleType:
    """Import a module; Ctrl-C meanwhile takes effect after it.

    A compiled library that is left half initialized, as torch within the second that its import takes, cannot be
    imported again: the process crashes.
    """
    handler = signal.getsignal(signal.SIGINT)
    if name in sys.modules or not callable(handler) or threading.current_thread() is not threading.main_thread():
        return import_module(name)
    pending: list[tuple[int, FrameType | None]] = []
    signal.signal(signal.SIGINT, lambda number, frame: pending.append((number, frame)))
    try:
        return import_module(name)
    finally:
        signal.signal(signal.SIGINT, handler)
        if pending:
            handler(*pending[0])
