"""Files that are to be written: their paths checked, and what the system refuses as an error that names `path`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def writable(path: Any) -> Path:
    """`path` of a file to be written, its folder made.

    Raises
    ------
    TypeError
        If it is no path.
    ValueError
        If it is a folder, or its folder cannot be made.
    """
    if isinstance(path, bytes) or not isinstance(path, str | os.PathLike):
        raise TypeError(f"`path` must be a file name or a pathlib.Path; got {type(path).__name__}.")
    file = Path(os.fsdecode(path))
    if not str(path) or file.is_dir():
        raise ValueError(f"`path` {str(path)!r} is {'a folder' if str(path) else 'empty'}: name a file in a folder.")
    with naming_path(file):
        file.parent.mkdir(parents=True, exist_ok=True)
    return file


@contextmanager
def naming_path(path: Path) -> Iterator[None]:
    """What the system refuses about a file as a ValueError that names the argument."""
    try:
        yield
    except OSError as error:
        why = error.strerror or type(error).__name__
        raise ValueError(f"`path` {str(path)!r} cannot be written ({why}): name a file that can be.") from error
