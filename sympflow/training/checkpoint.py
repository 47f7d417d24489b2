"""Checkpoints: all the state of a run, written so that a kill at any moment leaves a whole file."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import torch

FORMAT = 1
FIELDS = {
    "format",
    "config",
    "architecture",
    "fingerprint",
    "step",
    "flow",
    "best",
    "optimizer",
    "history",
    "seconds",
}


def write(path: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """Write `state` to a new file beside `path`, then put it in place in one step."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            torch.save({"format": FORMAT, **state}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The state in a checkpoint; only tensors and plain values are ever loaded.

    Raises
    ------
    ValueError
        If the file is not a whole checkpoint of this format.
    """
    if not Path(path).is_file():
        raise ValueError(f"`resume` {str(path)!r} is not a file: pass the path that was given as checkpoint=.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler and archive reader raise
        raise ValueError(
            f"`resume` {str(path)!r} is not a checkpoint ({type(error).__name__}): start afresh."
        ) from error
    if not isinstance(state, dict) or set(state) != FIELDS:
        raise ValueError(f"`resume` {str(path)!r} is not a checkpoint of sympflow: start afresh.")
    if state["format"] != FORMAT:
        raise ValueError(f"`resume` {str(path)!r} has format {state['format']!r}, not {FORMAT}: update sympflow.")
    return state
