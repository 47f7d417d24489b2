"""Lazy values: results kept with an object, classes made by a call, imports of plug-ins and of what may be missing."""

from __future__ import annotations

import copyreg
import sys
from collections.abc import Callable, Container, Iterable
from functools import wraps
from importlib import import_module
from math import inf
from types import FrameType, ModuleType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


K = TypeVar("K")
P = ParamSpec("P")
T = TypeVar("T")
MOST_KEPT = 64


def kept(make: Callable[Concatenate[K, P], T], most: float = inf) -> Callable[Concatenate[K, P], T]:
    """Make a function of an object, and of what is hashable, keep `most` values as long as that object lives."""
    known: WeakKeyDictionary[K, dict[Any, T]] = WeakKeyDictionary()

    @wraps(make)
    def found(owner: K, *args: P.args, **options: P.kwargs) -> T:
        values = known.get(owner)
        if values is None:
            values = known[owner] = {}
        key = (*args, *options.items()) if options else args
        if key not in values:
            if len(values) >= most:
                values.clear()
            values[key] = make(owner, *args, **options)
        return values[key]

    return found


def lately_kept(make: Callable[Concatenate[K, P], T]) -> Callable[Concatenate[K, P], T]:
    """Make a function keep a few of its latest values, those of states for instance."""
    return kept(make, MOST_KEPT)


class Made(type):
    """The type of classes that no module holds: they pickle as the call `made_of`, a function and its arguments."""


copyreg.pickle(Made, lambda cls: vars(cls).get("made_of", cls.__qualname__))  # a subclass is found by its name


def needed(library: str, extra: str) -> str:
    """The way to install a library that is missing, in a message."""
    return f'pip install {library}, or in the clone of sympflow pip install ".[{extra}]"'


def whole_import(name: str) -> ModuleType:
    """Import a module; Ctrl-C meanwhile takes effect after it.

    A compiled library that is left half initialized, as torch within the second that its import takes, cannot be
    imported again: the process crashes.
    """
    import signal
    import threading

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


# plug-ins ------------------------------------------------------------------------------------------


def announced(group: str, what: str, taken: Container[str], others: Iterable[EntryPoint] = ()) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, of all installed distributions; none is imported.

    Parameters
    ----------
    group : str
    what : str
        Their kind in one word, for the warning that a name is taken: by `taken`, or by an entry point before.
    taken : container of str
    others : iterable of EntryPoint
        Those of other groups, to stand beside them.
    """
    import warnings
    from importlib.metadata import entry_points

    found: dict[str, EntryPoint] = {}
    for point in (*entry_points(group=group), *others):
        if point.name in taken or point.name in found:
            message = f"The {what} {point.name!r} of {distribution(point)} is ignored: the name is taken."
            try:
                warnings.warn(message, RuntimeWarning, stacklevel=5)
            except RuntimeWarning:  # where warnings are errors, it must not take all others with it
                import logging

                logging.getLogger(__name__).warning(message)
        else:
            found[point.name] = point
    return found


def load_announced(point: EntryPoint, argument: str) -> Any:
    """Import the object of an entry point.

    Parameters
    ----------
    point : EntryPoint
    argument : str
        The argument that names it, for the message.

    Raises
    ------
    ImportError
        If it cannot be imported, with the name of its distribution.
    """
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        raise ImportError(
            f"`{argument}` {point.name!r} of the plug-in {distribution(point)} cannot be loaded "
            f"({type(error).__name__}: {error}): reinstall or remove that distribution."
        ) from error


def distribution(point: EntryPoint) -> str:
    """Return the name of the distribution of an entry point, for messages."""
    return point.dist.name if point.dist is not None else point.value
