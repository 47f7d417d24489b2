"""Files of flows: safetensors with a JSON record, never pickle. A file is taken for hostile until all of it is checked.

The metadata entry "sympflow" is a JSON object: format, version (of the package), kind, architecture, dt, domain,
system, fingerprint, recipe, figures, checksum (of the tensors), and, where there are any, certificate, identity
(the H of the system, at states of the domain and as an expression), unfitted (intervals of t without labels)
drive_times (where a drive without a period was fitted), and lattice_terms (the terms of a lattice, as texts). The entry
"sympflow_checksum" is of this object's text; files of format 1 have none, and their weights alone are known to be those
that were saved.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from sympflow._version import __version__
from sympflow.arguments import naming_path, put_file, warn, writable
from sympflow.flow import records
from sympflow.flow.families import family_of
from sympflow.flow.potentials import Unregistered
from sympflow.flow.records import KEY, MAX_DT, MIN_DT, Provenance, Refused, checked_integer, checked_path, text_checksum
from sympflow.flow.weights import checked_device, checksum
from sympflow.hamiltonian.system import HamiltonianSystem

DTYPES = {"F32": torch.float32, "F64": torch.float64}


# writing ---------------------------------------------------------------------------------------------------


OTHERS = (".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".npz", ".npy", ".h5", ".hdf5", ".onnx", ".json", ".csv")
"""Endings of files that other programs read."""


def write(
    path: str | os.PathLike[str],
    kind: str,
    architecture: dict[str, Any],
    dt: float,
    weights: Mapping[str, Tensor],
    provenance: Provenance,
) -> None:
    """Write a flow to a safetensors file, atomically: see `FlowMap.save`."""
    file = checked_path(path)
    if file.suffix.lower() in OTHERS:
        raise ValueError(
            f"`path` {file.name!r} ends as a file of another format, and a flow is in that of safetensors: call it "
            f"{file.stem}.safetensors."
        )
    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"`flow` has weights that are not finite ({name}): train it again before saving.")
    record = {
        "format": records.FORMAT,
        "version": __version__,
        "kind": kind,
        "architecture": architecture,
        "dt": dt,
        "checksum": checksum(tensors),
        **provenance.to_record(),
    }
    if provenance.certified is not None:
        if provenance.certified.weights == record["checksum"]:
            record["certificate"] = provenance.certified.to_dict()
        else:
            warn(
                "`flow` was changed, or converted to another precision, after its certificate was computed, which is "
                "therefore not stored: compute it again by flow.certificate(system) before saving.",
                RuntimeWarning,
            )
    record = _finite(record)
    try:
        Provenance.of_record(record, architecture["ndof"])
    except Refused as reason:
        raise ValueError(f"`flow` cannot be saved as it is: {reason}. Correct it first.") from None
    text = json.dumps(record, allow_nan=False, separators=(",", ":"))
    content = save_tensors(tensors, {KEY: text, records.SUM: text_checksum(text)})
    if (length := struct.unpack("<Q", content[:8])[0]) > records.MAX_HEADER:
        raise ValueError(
            f"`flow` cannot be saved as it is: its description takes {length:,} bytes, more than "
            f"{records.MAX_HEADER:,}. Describe its domain with fewer numbers, for instance a Tube around fewer states."
        )
    with naming_path(writable(file)):
        put_file(file, content, durable=False)


def _finite(value: Any) -> Any:
    """Return the value with None for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# reading, with suspicion -----------------------------------------------------------------------------------


def load(
    path: str | os.PathLike[str], *, system: HamiltonianSystem | None = None, device: torch.device | str | None = None
) -> Any:
    """Read a flow from a file that `flow.save` wrote.

    Parameters
    ----------
    path
    system : HamiltonianSystem, optional
        The system of the flow, which is checked. A primed flow needs its V and T: given here, or later by
        `flow.bind(system)`; `solve` gives them as well. A flow that was learned from data brings its own.
    device : torch.device or str, optional

    Returns
    -------
    SympFlow or MLPFlow
        With parameters that do not require gradients, and its domain, recipe and figures.

    Raises
    ------
    ValueError
        If the file is missing, truncated, of another or a later format, or has invalid content:
        tensors of the wrong name, shape or dtype, weights that are not finite, weights or a record (Δt, architecture,
        domain, figures) that are not those that were saved, an absurd architecture. Of a file of format 1, as earlier
        versions wrote them and as flows ship, the weights alone are compared with what was saved. Or if `system` is not
        the one that the flow was made for, or `device` is not available.
    TypeError
        If `path` is not a path, or `device` not a device.
    """
    file, device = checked_path(path), checked_device(device)
    try:
        content, header, record, altered = records.read(file)
        flow = _build(record, _dtype_of(header))
        _fill(flow, content, header, record)
        provenance = Provenance.of_record(record, flow.ndof)
        if altered:
            raise Refused("its record is not the one that was saved: its checksum differs, the file was altered")
        flow.provenance = provenance
    except Refused as reason:
        raise _refusal(file, str(reason), reason.remedy) from None
    except OverflowError:
        raise _refusal(file, "a number in its record is too large", Refused("").remedy) from None
    if system is not None:
        flow.check_system(system)
        flow = flow.bound(system)
    else:
        flow.take_learned()
    return flow.to(device) if device is not None else flow


def _refusal(path: Path, reason: str, remedy: str) -> ValueError:
    return ValueError(f"`path` {str(path)!r} is not a usable flow: {reason}. {remedy}.")


def _dtype_of(header: dict[str, Any]) -> torch.dtype:
    if not header:  # a flow without numbers of its own
        return torch.float64
    names = {str(entry.get("dtype")) if isinstance(entry, dict) else "nothing" for entry in header.values()}
    if len(names) != 1 or not names <= set(DTYPES):
        raise Refused(f"its tensors must all be F32 or all F64, not {sorted(names)}")
    return DTYPES[names.pop()]


def _build(record: dict[str, Any], dtype: torch.dtype) -> Any:
    """Return the flow of the record's architecture; its family checks all sizes before memory is taken."""
    plan, dt = record.get("architecture"), record.get("dt")
    if not isinstance(plan, dict):
        raise Refused("its architecture is missing")
    if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not MIN_DT <= dt <= MAX_DT:
        raise Refused(f"its dt {dt!r} is not a number between {MIN_DT:g} and {MAX_DT:g}")
    ndof = checked_integer(plan.get("ndof"), "ndof", records.MAX_WIDTH)
    try:
        return family_of(record["kind"], plan).from_architecture(ndof, plan, dt, dtype)
    except Unregistered as error:
        remedy = f"Import the package that it is from, or {error.remedy}, before you load the file"
        raise Refused(f"it needs the {error.what}, which is not known here", remedy) from None
    except ValueError as error:
        raise Refused(f"its architecture is not admissible ({error})") from None


def _fill(flow: nn.Module, content: bytes, header: dict[str, Any], record: dict[str, Any]) -> None:
    """Put the file's tensors into the flow."""
    expected = flow.state_dict()
    if set(header) != set(expected):
        odd = sorted(set(header) ^ set(expected))[:3]
        raise Refused(f"its tensors do not fit its architecture (missing or unknown: {', '.join(odd)})")
    for name, value in expected.items():
        if header[name].get("shape") != list(value.shape):
            raise Refused(f"its tensor {name} has shape {header[name].get('shape')}, not {list(value.shape)}")
    try:
        tensors = load_tensors(content)
    except (SafetensorError, ValueError, RuntimeError) as error:
        raise Refused(f"it is truncated or damaged ({error})") from None
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise Refused(f"its tensor {name} is not finite")
        if name.split(".")[-1] in ("scale", "tau", "gain") and not (value > 0).all():
            raise Refused(f"its unit {name} is not positive")
    if not isinstance(record.get("checksum"), str):
        raise Refused("its record has no checksum of the weights")
    if record["checksum"] != checksum(tensors):
        raise Refused("its weights are not those that were saved: their checksum differs, the file is damaged")
    flow.load_state_dict(tensors)
    flow.requires_grad_(False)
