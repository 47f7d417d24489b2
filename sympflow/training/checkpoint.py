"""Checkpoints: all the state of a run, written so that a kill at any moment leaves a whole file."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from sympflow.arguments import put_file
from sympflow.storage.identity import digest

if TYPE_CHECKING:
    from sympflow.flow.flow_map import FlowMap
    from sympflow.hamiltonian.system import HamiltonianSystem

FORMAT = 1
FIELDS = {"format", "config", "architecture", "system", "step", "flow", "best", "optimizer", "history", "seconds"}


def identity(flow: FlowMap, system: HamiltonianSystem, config: dict[str, Any]) -> dict[str, Any]:
    """The description that a run must share with the one that it goes on with."""
    return {
        "config": json.dumps(config),
        "architecture": json.dumps({"kind": flow.kind, "dt": flow.dt, **flow.architecture()}),
        "system": f"{system.fingerprint} {digest(system)}",  # the numbers tell functions of C apart
    }


def read_same(path: str | os.PathLike[str], mine: dict[str, Any]) -> dict[str, Any]:
    """`read`, of a run with this identity; how often it writes checkpoints may differ."""
    state = read(path)
    theirs, ours = (json.loads(run["config"]) for run in (state, mine))
    names = (set(theirs) | set(ours)) - {"checkpoint_every"}
    nothing = object()
    differing = sorted(n for n in names if theirs.get(n, nothing) != ours.get(n, nothing))
    if differing:
        raise ValueError(f"`resume` is a run with another {', '.join(differing)}: pass the same arguments as then.")
    for name in ("architecture", "system"):
        if state[name] != mine[name]:
            raise ValueError(
                f"`resume` is a run with another {name}: pass the same system, and the same arguments of "
                "the flow, as then."
            )
    return state


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise ValueError where no checkpoint can be written; the folder is made."""
    path, why = Path(path), None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = error.strerror or type(error).__name__
    if path.is_dir():
        why = "it is a folder"
    elif why is None and not os.access(path.parent, os.W_OK):
        why = "its folder is write-protected"
    if why is not None:
        raise ValueError(f"`checkpoint` {str(path)!r} cannot be written ({why}): name a file that can be.")


def write(path: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """Write `state` to a new file beside `path`, then put it in place in one step."""
    path, content = Path(path), io.BytesIO()
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"format": FORMAT, **state}, content)
    put_file(path, content.getvalue())


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The state in a checkpoint; only tensors and plain values are ever loaded."""
    if not Path(path).is_file():
        raise ValueError(f"`resume` {str(path)!r} is not a file: pass the path that was given as checkpoint=.")
    try:
        with zipfile.ZipFile(path) as archive:  # of which none takes more memory than the file has bytes
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is packed")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler and archive reader raise
        raise ValueError(
            f"`resume` {str(path)!r} is not a checkpoint ({type(error).__name__}): start a new run."
        ) from error
    if not isinstance(state, dict) or set(state) != FIELDS:
        raise ValueError(f"`resume` {str(path)!r} is not a checkpoint of sympflow: start a new run.")
    if state["format"] != FORMAT:
        raise ValueError(f"`resume` {str(path)!r} has format {state['format']!r}, not {FORMAT}: update sympflow.")
    return state
