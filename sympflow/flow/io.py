"""Files of flows: safetensors with a JSON record, never pickle; and the flows that ship with the package.

The metadata entry "sympflow" is a JSON object: format, version (of the package), kind, architecture, dt, domain,
system, fingerprint, recipe, figures. A file is taken for hostile until every part of it has been checked.
"""

from __future__ import annotations

import json
import math
import os
import struct
import tempfile
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from sympflow.domain import domain_from_dict
from sympflow.flow.base import FlowMap, same_system
from sympflow.flow.layers import LAYERS
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.sympflow import SympFlow

if TYPE_CHECKING:
    from sympflow.system import HamiltonianSystem

FORMAT = 1
KEY = "sympflow"
MAX_HEADER = 2**20
MAX_FILE = 2**28
MAX_LAYERS = 1000
MAX_WIDTH = 4096
MAX_PARAMETERS = 10_000_000
DTYPES = {"F32": torch.float32, "F64": torch.float64}


def save(flow: FlowMap, path: str | os.PathLike[str]) -> None:
    """Write a flow to a safetensors file, atomically.

    Raises
    ------
    ValueError
        If a weight is not finite.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in flow.state_dict().items()}
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"`flow` has weights that are not finite ({name}): train it again before saving.")
    record = {
        "format": FORMAT,
        "version": metadata.version("sympflow"),
        "kind": flow.kind,
        "architecture": flow.architecture(),
        "dt": flow.dt,
        "domain": flow.domain.to_dict() if flow.domain is not None else None,
        "system": flow.system_name,
        "fingerprint": flow.fingerprint,
        "recipe": flow.recipe,
        "figures": flow.figures,
    }
    content = save_tensors(tensors, {KEY: json.dumps(_finite(record), allow_nan=False, separators=(",", ":"))})
    path = Path(path)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(name).chmod(0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def load(path: str | os.PathLike[str], *, device: torch.device | str | None = None) -> Any:
    """Read a flow from a file that `flow.save` wrote.

    Returns
    -------
    SympFlow or MLPFlow
        With parameters that do not require gradients, and its domain, recipe and figures.

    Raises
    ------
    ValueError
        If the file is missing, truncated, of another or a later format, or anything in it is not as it should be:
        tensors of the wrong name, shape or dtype, weights that are not finite, an absurd architecture.
    """
    content, header, record = _read(path)
    try:
        flow = _build(record, _dtype(header))
        _fill(flow, content, header)
        _describe(flow, record)
    except _Refused as reason:
        raise _refusal(path, str(reason)) from None
    return flow.to(device) if device is not None else flow


def shipped(system: HamiltonianSystem, kind: str = "sympflow") -> Any:
    """The flow that the package ships for `system`, recognised by its fingerprint.

    Raises
    ------
    ValueError
        If there is none; the message lists those there are.
    """
    for path, record in _catalogue():
        fingerprint = tuple(math.nan if v is None else v for v in record.get("fingerprint") or ())
        if record["kind"] == kind and same_system(fingerprint, system.fingerprint):
            flow = load(path)
            flow.check_system(system)
            return flow
    there = ", ".join(path.stem for path, record in _catalogue() if record["kind"] == kind)
    raise ValueError(
        f"`system` {system.name!r} has no shipped {kind} flow (there are: {there or 'none'}): train one by "
        f"flow = sympflow.train(system{', kind=' + repr(kind) if kind != 'sympflow' else ''}) and pass flow=flow."
    )


@cache
def _catalogue() -> tuple[tuple[Path, dict[str, Any]], ...]:
    folder = Path(str(resources.files("sympflow"))) / "pretrained"
    return tuple((path, _read(path)[2]) for path in sorted(folder.glob("*.safetensors")))


# reading, with suspicion -----------------------------------------------------------------------------------


class _Refused(Exception):
    """Why a file is refused."""


def _refusal(path: str | os.PathLike[str], reason: str) -> ValueError:
    return ValueError(f"`path` {str(path)!r} is not a usable flow: {reason}. Save it again with flow.save(path).")


def _read(path: str | os.PathLike[str]) -> tuple[bytes, dict[str, Any], dict[str, Any]]:
    """The bytes of the file, its safetensors header, and the record in it."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"`path` {str(path)!r} is not a file: pass the path of a flow saved with flow.save(path).")
    try:
        size = path.stat().st_size
        if size > MAX_FILE:
            raise _Refused(f"it has {size:,} bytes, more than any flow")
        content = path.read_bytes()
        if len(content) < 8:
            raise _Refused("it is truncated")
        (length,) = struct.unpack("<Q", content[:8])
        if length > MAX_HEADER:
            raise _Refused(f"it is no safetensors file, or its header is oversized ({length:,} bytes)")
        if len(content) < 8 + length:
            raise _Refused("it is truncated")
        header = _json(content[8 : 8 + length], "header")
        notes = header.pop("__metadata__", None)
        if not isinstance(notes, dict) or not isinstance(notes.get(KEY), str):
            raise _Refused("it holds no record of a sympflow flow")
        record = _json(notes[KEY], "record")
        format_ = record.get("format")
        if isinstance(format_, bool) or not isinstance(format_, int):
            raise _Refused("its record has no format number")
        if format_ > FORMAT:
            raise _Refused(
                f"its format {format_} is later than {FORMAT}, which this version of sympflow reads: update it"
            )
        if record.get("kind") not in ("sympflow", "mlp"):
            raise _Refused(f"its kind {record.get('kind')!r} is unknown")
    except _Refused as reason:
        raise _refusal(path, str(reason)) from None
    return content, header, record


def _json(text: str | bytes, what: str) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(constant)

    try:
        value = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError):
        raise _Refused(f"its {what} is not valid JSON") from None
    if not isinstance(value, dict):
        raise _Refused(f"its {what} is not a JSON object")
    return value


def _dtype(header: dict[str, Any]) -> torch.dtype:
    names = {entry.get("dtype") if isinstance(entry, dict) else None for entry in header.values()}
    if len(names) != 1 or not names <= set(DTYPES):
        raise _Refused(f"its tensors must all be F32 or all F64, not {sorted(map(str, names))}")
    return DTYPES[names.pop()]  # type: ignore[index]


def _build(record: dict[str, Any], dtype: torch.dtype) -> FlowMap:
    """The flow of the record's architecture, on the meta device: sizes are checked before memory is taken."""
    plan, dt = record.get("architecture"), record.get("dt")
    if not isinstance(plan, dict):
        raise _Refused("its architecture is missing")
    if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 < dt < math.inf:
        raise _Refused(f"its dt {dt!r} is not a positive number")
    ndof = _integer(plan.get("ndof"), "ndof", MAX_WIDTH)
    try:
        if record["kind"] == "mlp":
            hidden = _widths(plan.get("hidden"), 2 * ndof)
            return MLPFlow(ndof, hidden, str(plan.get("activation")), dt, dtype)
        layers = plan.get("layers")
        if not isinstance(layers, list) or not 1 <= len(layers) <= MAX_LAYERS:
            raise _Refused("its list of layers is missing or absurdly long")
        # All sizes first: nothing is allocated for a file that asks for too much.
        potentials = [_potential(layer) for layer in layers]
        widths = [_widths(potential.get("hidden"), ndof) for potential in potentials]
        if sum(_parameters(w, ndof) for w in widths) > MAX_PARAMETERS:
            raise _Refused("its architecture is absurdly large")
        return SympFlow.from_layers(
            (
                LAYERS[layer["kind"]](MLPPotential(ndof, hidden, str(potential.get("activation")), dtype=dtype))
                for layer, potential, hidden in zip(layers, potentials, widths, strict=True)
            ),
            dt,
        )
    except ValueError as error:
        raise _Refused(f"its architecture is not admissible ({error})") from None


def _potential(layer: Any) -> dict[str, Any]:
    """The potential of a layer's description."""
    if not isinstance(layer, dict) or layer.get("kind") not in LAYERS:
        raise _Refused("it has a layer of unknown kind")
    potential = layer.get("potential")
    if not isinstance(potential, dict) or potential.get("type") != "mlp":
        raise _Refused("it has a potential of unknown type")
    return potential


def _widths(hidden: Any, inputs: int) -> tuple[int, ...]:
    if not isinstance(hidden, list) or not 1 <= len(hidden) <= MAX_LAYERS:
        raise _Refused("its hidden layers are missing or absurdly many")
    widths = tuple(_integer(h, "hidden width", MAX_WIDTH) for h in hidden)
    if _parameters(widths, inputs) > MAX_PARAMETERS:
        raise _Refused("its architecture is absurdly large")
    return widths


def _parameters(widths: tuple[int, ...], inputs: int) -> int:
    return sum(m * n for m, n in zip((inputs + 2, *widths), (*widths, inputs), strict=True))


def _integer(value: Any, what: str, largest: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= largest:
        raise _Refused(f"its {what} {value!r} is not an integer from 1 to {largest}")
    return value


def _fill(flow: FlowMap, content: bytes, header: dict[str, Any]) -> None:
    """Put the file's tensors into the flow."""
    expected = flow.state_dict()
    if set(header) != set(expected):
        odd = sorted(set(header) ^ set(expected))[:3]
        raise _Refused(f"its tensors do not fit its architecture (missing or unknown: {', '.join(odd)})")
    for name, value in expected.items():
        if header[name].get("shape") != list(value.shape):
            raise _Refused(f"its tensor {name} has shape {header[name].get('shape')}, not {list(value.shape)}")
    try:
        tensors = load_tensors(content)
    except (SafetensorError, ValueError, RuntimeError) as error:
        raise _Refused(f"it is truncated or damaged ({error})") from None
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise _Refused(f"its tensor {name} is not finite")
        if name.split(".")[-1] in ("scale", "tau", "gain") and not (value > 0).all():
            raise _Refused(f"its unit {name} is not positive")
    flow.load_state_dict(tensors)
    flow.requires_grad_(False)


def _describe(flow: FlowMap, record: dict[str, Any]) -> None:
    """Give the flow the record of its file."""
    if record.get("domain") is not None:
        try:
            flow.domain = domain_from_dict(record["domain"])
        except (ValueError, TypeError, AttributeError) as error:
            raise _Refused(f"its domain is not admissible ({error})") from None
    fingerprint = record.get("fingerprint")
    if fingerprint is not None:
        if not isinstance(fingerprint, list) or not all(
            v is None or (isinstance(v, (int, float)) and not isinstance(v, bool)) for v in fingerprint
        ):
            raise _Refused("its fingerprint is not a list of numbers")
        flow.fingerprint = tuple(math.nan if v is None else float(v) for v in fingerprint)
    for name, kind in (("recipe", dict), ("figures", dict)):
        if not isinstance(record.get(name), kind):
            raise _Refused(f"its {name} is missing")
    if not isinstance(record.get("system"), str | None):
        raise _Refused("its system is not a name")
    flow.system_name, flow.recipe, flow.figures = record["system"], record["recipe"], record["figures"]


def _finite(value: Any) -> Any:
    """The value with None for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
