"""Files of flows: safetensors with a JSON record, never pickle; and the flows that ship with the package.

The metadata entry "sympflow" is a JSON object: format, version (of the package), kind, architecture, dt, domain,
system, fingerprint, recipe, figures, checksum (of the tensors), seal (of the architecture), and certificate, if one was
computed. A file is taken for hostile until every part of it has been checked.
"""

from __future__ import annotations

import json
import math
import os
import struct
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors.torch import save as save_tensors

import sympflow
from sympflow.arguments import naming_path, writable
from sympflow.flow.base import FlowMap
from sympflow.flow.description import check, describe
from sympflow.flow.placement import checked_device
from sympflow.flow.record import Refused, build, checksum, dtype_of, fill, parse, seal, tensor_bytes
from sympflow.flow.shipped import choose

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem

FORMAT = 1
KEY = "sympflow"
MAX_HEADER = 2**20
MAX_FILE = 2**28


def save(flow: FlowMap, path: str | os.PathLike[str]) -> None:
    """Write a flow to a safetensors file, atomically.

    A flow without a system (one that was never trained) is recorded as such, and fits any when it is loaded.

    Raises
    ------
    TypeError
        If `path` is not a path.
    ValueError
        If a weight is not finite, the record is one that `load` would refuse, or the file cannot be written.

    Warns
    -----
    RuntimeWarning
        If the flow's certificate is one of other weights: it is left out.
    """
    path = _path(path)
    tensors = {name: value.detach().cpu().contiguous() for name, value in flow.state_dict().items()}
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"`flow` has weights that are not finite ({name}): train it again before saving.")
    record = {
        "format": FORMAT,
        "version": sympflow.__version__,
        "kind": flow.kind,
        "architecture": flow.architecture(),
        "dt": flow.dt,
        "domain": flow.domain.to_dict() if flow.domain is not None else None,
        "system": flow.system_name,
        "fingerprint": flow.fingerprint,
        "recipe": flow.recipe,
        "figures": flow.figures,
        "checksum": checksum(tensors),
    }
    if flow.certified is not None:
        if flow.certified.weights == record["checksum"]:
            record["certificate"] = flow.certified.to_dict()
        else:
            warnings.warn(
                "`flow` was changed, or converted to another precision, after its certificate was computed, which is "
                "therefore not stored: compute it again by flow.certificate(system) before saving.",
                RuntimeWarning,
                stacklevel=3,
            )
    record = _finite(record)
    record["seal"] = seal(record)
    try:
        check(record, flow.ndof)
    except Refused as reason:
        raise ValueError(f"`flow` cannot be saved as it is: {reason}. Set it right first.") from None
    content = save_tensors(tensors, {KEY: json.dumps(record, allow_nan=False, separators=(",", ":"))})
    if (length := struct.unpack("<Q", content[:8])[0]) > MAX_HEADER:
        raise ValueError(
            f"`flow` cannot be saved as it is: its description takes {length:,} bytes, more than {MAX_HEADER:,}. "
            "Describe its domain with fewer numbers, for instance a Tube around fewer states."
        )
    _write(path, content)


def reseal(path: str | os.PathLike[str]) -> bool:
    """Give a file of an earlier version its seal, once it has been checked; the weights stay as they are.

    Returns
    -------
    bool
        Whether the file was changed: False if it had a seal.

    Raises
    ------
    ValueError
        As `load`.
    """
    path = _path(path)
    load(path)
    content, _, record = _read(path)
    if "seal" in record:
        return False
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"][KEY] = json.dumps({**record, "seal": seal(record)}, allow_nan=False, separators=(",", ":"))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    _write(path, struct.pack("<Q", len(text)) + text + content[8 + length :])
    return True


def _write(path: Path, content: bytes) -> None:
    """All of it or nothing."""
    with naming_path(writable(path)):
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(name).chmod(0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def load(
    path: str | os.PathLike[str],
    *,
    system: HamiltonianSystem | None = None,
    device: torch.device | str | None = None,
) -> Any:
    """Read a flow from a file that `flow.save` wrote.

    Parameters
    ----------
    path
    system : HamiltonianSystem, optional
        The system of the flow, which is checked. A primed flow needs its V and T: given here, or later by
        `flow.bind(system)`; `solve` gives them as well.
    device : torch.device or str, optional

    Returns
    -------
    SympFlow or MLPFlow
        With parameters that do not require gradients, and its domain, recipe and figures.

    Raises
    ------
    ValueError
        If the file is missing, truncated, of another or a later format, or anything in it is not as it should be:
        tensors of the wrong name, shape or dtype, weights that are not finite or not those that were saved, an absurd
        architecture. Or if `system` is not the one that the flow was made for, or `device` is not to be had.
    TypeError
        If `path` is not a path, or `device` not a device.
    """
    path, device = _path(path), checked_device(device)
    content, header, record = _read(path)
    try:
        flow = build(record, dtype_of(header))
        fill(flow, content, header, record)
        describe(flow, record)
    except Refused as reason:
        raise _refusal(path, str(reason)) from None
    except OverflowError:
        raise _refusal(path, "a number in its record is too large") from None
    if system is not None:
        flow.check_system(system)
        flow.bound(system)
    return flow.to(device) if device is not None else flow


def shipped(system: HamiltonianSystem, kind: str = "sympflow", tol: float | None = None) -> Any:
    """The flow that the package ships for `system`, recognised by its fingerprint: see `flow.shipped.choose`.

    Raises
    ------
    ValueError
        If there is none, or none that meets `tol`; the message lists those there are.
    """
    return choose(system, kind, tol).load(system)


# reading, with suspicion -----------------------------------------------------------------------------------


def _path(path: Any) -> Path:
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"`path` must be the path of a file; got {path!r}: pass a string or a pathlib.Path.")
    return Path(path)


def _refusal(path: str | os.PathLike[str], reason: str) -> ValueError:
    return ValueError(f"`path` {str(path)!r} is not a usable flow: {reason}. Save it again with flow.save(path).")


def _read(path: str | os.PathLike[str]) -> tuple[bytes, dict[str, Any], dict[str, Any]]:
    """The bytes of the file, its safetensors header, and the record in it."""
    path = _path(path)
    try:
        found = path.is_file()
    except OSError:  # a name that no file can have
        found = False
    if not found:
        raise ValueError(f"`path` {str(path)!r} is not a file: pass the path of a flow saved with flow.save(path).")
    try:
        size = path.stat().st_size
        if size > MAX_FILE:
            raise Refused(f"it has {size:,} bytes, more than any flow")
        with path.open("rb") as file:
            content = file.read(8)
            if len(content) < 8:
                raise Refused("it is truncated")
            (length,) = struct.unpack("<Q", content)
            if length > MAX_HEADER:
                raise Refused(f"it is no safetensors file, or its header is oversized ({length:,} bytes)")
            content += file.read(length)
            if len(content) < 8 + length:
                raise Refused("it is truncated")
            header = parse(content[8:], "header")
            if (expected := len(content) + tensor_bytes(header)) != size:
                raise Refused(f"it is truncated or damaged: it has {size:,} bytes, by its header {expected:,}")
            content += file.read()
        notes = header.pop("__metadata__", None)
        if not isinstance(notes, dict) or not isinstance(notes.get(KEY), str):
            raise Refused("it holds no record of a sympflow flow")
        record = parse(notes[KEY], "record")
        format_ = record.get("format")
        if isinstance(format_, bool) or not isinstance(format_, int):
            raise Refused("its record has no format number")
        if format_ < 1:
            raise Refused(f"its format {format_} is not one there has been")
        if format_ > FORMAT:
            raise Refused(
                f"its format {format_} is later than {FORMAT}, which this version of sympflow reads: update it"
            )
        if record.get("kind") not in ("sympflow", "mlp"):
            raise Refused(f"its kind {record.get('kind')!r} is unknown")
    except Refused as reason:
        raise _refusal(path, str(reason)) from None
    return content, header, record


def _finite(value: Any) -> Any:
    """The value with None for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
