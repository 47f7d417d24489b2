"""From the parts of a file to a flow, with suspicion: everything is checked before it is used."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors

from sympflow.flow.base import MAX_DT, MIN_DT, FlowMap
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.layers import LAYERS
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.split import SplitFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.monomials import MOST_MONOMIALS, Monomials

MAX_LAYERS = 1000
MAX_WIDTH = 4096
MAX_DEGREE = 64
MAX_PARAMETERS = 10_000_000
KINDS_OF_MODES = ("oscillator", "hyperbolic", "free", "idle")
DTYPES = {"F32": torch.float32, "F64": torch.float64}


class Refused(Exception):
    """Why a file is refused."""


def parse(text: str | bytes, what: str) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(constant)

    try:
        value = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError):
        raise Refused(f"its {what} is not valid JSON") from None
    if not isinstance(value, dict):
        raise Refused(f"its {what} is not a JSON object")
    return value


def tensor_bytes(header: dict[str, Any]) -> int:
    """How many bytes follow the header, by the offsets in it."""
    try:
        return max(
            (int(entry["data_offsets"][1]) for name, entry in header.items() if name != "__metadata__"), default=0
        )
    except (KeyError, TypeError, ValueError, IndexError):
        raise Refused("its header has a tensor without offsets") from None


def dtype_of(header: dict[str, Any]) -> torch.dtype:
    names = {str(entry.get("dtype")) if isinstance(entry, dict) else "nothing" for entry in header.values()}
    if len(names) != 1 or not names <= set(DTYPES):
        raise Refused(f"its tensors must all be F32 or all F64, not {sorted(names)}")
    return DTYPES[names.pop()]


def build(record: dict[str, Any], dtype: torch.dtype) -> FlowMap:
    """The flow of the record's architecture, on the meta device: sizes are checked before memory is taken."""
    plan, dt = record.get("architecture"), record.get("dt")
    if not isinstance(plan, dict):
        raise Refused("its architecture is missing")
    if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not MIN_DT <= dt <= MAX_DT:
        raise Refused(f"its dt {dt!r} is not a number between {MIN_DT:g} and {MAX_DT:g}")
    ndof = _integer(plan.get("ndof"), "ndof", MAX_WIDTH)
    try:
        if record["kind"] == "mlp":
            hidden = _widths(plan.get("hidden"), 2 * ndof)
            return MLPFlow(ndof, hidden, str(plan.get("activation")), dt, dtype)
        if "split" in plan:
            return _split(ndof, plan["split"], dt, dtype)
        if "clocked" in plan:
            return _clocked(ndof, plan["clocked"], dt, dtype)
        if "primed" in plan:
            return _primed(ndof, plan["primed"], dt, dtype)
        layers = plan.get("layers")
        if not isinstance(layers, list) or not 1 <= len(layers) <= MAX_LAYERS:
            raise Refused("its list of layers is missing or absurdly long")
        # All sizes first: nothing is allocated for a file that asks for too much.
        potentials = [_potential(layer) for layer in layers]
        widths = [_widths(potential.get("hidden"), ndof) for potential in potentials]
        if sum(_parameters(w, ndof) for w in widths) > MAX_PARAMETERS:
            raise Refused("its architecture is absurdly large")
        return SympFlow.from_layers(
            (
                LAYERS[layer["kind"]](MLPPotential(ndof, hidden, str(potential.get("activation")), dtype=dtype))
                for layer, potential, hidden in zip(layers, potentials, widths, strict=True)
            ),
            dt,
        )
    except ValueError as error:
        raise Refused(f"its architecture is not admissible ({error})") from None


def _primed(ndof: int, plan: Any, dt: float, dtype: torch.dtype) -> PrimedFlow:
    """A primed flow, which `bind` will give its system."""
    if not isinstance(plan, dict) or plan.get("first") not in ("kick", "drift"):
        raise Refused("its plan of a primed flow is missing")
    curvature = plan.get("curvature", False)  # files of earlier versions have none
    for name, value in (*((n, plan.get(n)) for n in ("palindromic", "force_gradient")), ("curvature", curvature)):
        if not isinstance(value, bool):
            raise Refused(f"its {name} is neither true nor false")
    maps = _integer(plan.get("maps"), "number of maps", MAX_LAYERS)
    degree = _integer(plan.get("degree"), "degree", MAX_DEGREE)
    processor = plan.get("processor", 0)  # files of the first release have none
    if processor != 0 or isinstance(processor, bool):
        processor = _integer(processor, "processor", MAX_LAYERS)
    shape = (plan["first"], maps, degree, plan["palindromic"], plan["force_gradient"])
    more: dict[str, Any] = {"curvature": curvature, "monomials": _monomials(plan.get("monomials", []), ndof)}
    return PrimedFlow(ndof, *shape, dt, processor=processor, **more, dtype=dtype)


def _monomials(plan: Any, ndof: int) -> Monomials:
    if not isinstance(plan, list) or len(plan) > MOST_MONOMIALS:
        raise Refused(f"its monomials are not a list of at most {MOST_MONOMIALS}")
    for m in plan:
        if not isinstance(m, list) or len(m) != ndof:
            raise Refused(f"its monomials do not have {ndof} exponents each")
        if not all(isinstance(e, int) and not isinstance(e, bool) and 0 <= e <= MAX_DEGREE for e in m):
            raise Refused(f"its monomials have exponents that are not integers from 0 to {MAX_DEGREE}")
    monomials = tuple(tuple(m) for m in plan)
    if len(set(monomials)) < len(monomials) or (0,) * ndof in monomials:
        raise Refused("its monomials are not different ones that vary with q")
    return monomials


def _clocked(ndof: int, plan: Any, dt: float, dtype: torch.dtype) -> ClockedFlow:
    """A flow with a trained clock, which `bind` will give its system."""
    if not isinstance(plan, dict) or not isinstance(plan.get("scheme"), str):
        raise Refused("its scheme is missing")
    terms = _integer(plan.get("terms"), "number of terms", MAX_DEGREE)
    return ClockedFlow(ndof, plan["scheme"], terms, dt, dtype=dtype)


def _split(ndof: int, plan: Any, dt: float, dtype: torch.dtype) -> SplitFlow:
    """A flow of the parts of a system, which `bind` will give it."""
    if not isinstance(plan, dict):
        raise Refused("its plan of a split flow is missing")
    if not isinstance(plan.get("filters"), bool):
        raise Refused("its filters are neither true nor false")
    gradients = plan.get("gradients")
    if not isinstance(gradients, list) or not all(isinstance(i, int) and 0 <= i < MAX_LAYERS for i in gradients):
        raise Refused("its gradients are not a list of kicks")
    for name, admissible in (("kinds", ("kick", "shear")), ("classes", KINDS_OF_MODES)):
        value = plan.get(name)
        if not isinstance(value, list) or len(value) > MAX_LAYERS or not all(entry in admissible for entry in value):
            raise Refused(f"its {name} are not a list of {', '.join(admissible)}")
    sequence, expressions = plan.get("sequence"), plan.get("expressions")
    if not isinstance(sequence, list) or not 1 <= len(sequence) <= MAX_LAYERS:
        raise Refused("its sequence of maps is missing or absurdly long")
    if not all(isinstance(k, int) and not isinstance(k, bool) and 0 <= k <= len(plan["kinds"]) for k in sequence):
        raise Refused("its sequence of maps does not consist of numbers of parts")
    if expressions is not None and not (isinstance(expressions, list) and all(isinstance(e, str) for e in expressions)):
        raise Refused("its parts are not a list of expressions")
    if expressions is not None:
        from sympflow.hamiltonian.expression import Unreadable, read

        if len(expressions) > len(plan["kinds"]) + 1:
            raise Refused("it has more parts than kinds of them")
        try:
            for expression in expressions:
                read(expression)
        except Unreadable as error:
            raise Refused(f"its parts are not all expressions ({error})") from None
    terms = _integer(plan.get("terms"), "number of terms", MAX_DEGREE)
    if len(sequence) * terms * (len(plan["classes"]) + 2) > MAX_PARAMETERS // 100:
        raise Refused("its architecture is absurdly large")
    shape = (sequence, plan["kinds"], plan["classes"], terms, plan["filters"], gradients)
    return SplitFlow(ndof, *shape, dt, expressions, dtype=dtype)


def _potential(layer: Any) -> dict[str, Any]:
    """The potential of a layer's description."""
    if not isinstance(layer, dict) or str(layer.get("kind")) not in LAYERS:
        raise Refused("it has a layer of unknown kind")
    potential = layer.get("potential")
    if not isinstance(potential, dict) or potential.get("type") != "mlp":
        raise Refused("it has a potential of unknown type")
    return potential


def _widths(hidden: Any, inputs: int) -> tuple[int, ...]:
    if not isinstance(hidden, list) or not 1 <= len(hidden) <= MAX_LAYERS:
        raise Refused("its hidden layers are missing or absurdly many")
    widths = tuple(_integer(h, "hidden width", MAX_WIDTH) for h in hidden)
    if _parameters(widths, inputs) > MAX_PARAMETERS:
        raise Refused("its architecture is absurdly large")
    return widths


def _parameters(widths: tuple[int, ...], inputs: int) -> int:
    return sum(m * n for m, n in zip((inputs + 2, *widths), (*widths, inputs), strict=True))


def _integer(value: Any, what: str, largest: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= largest:
        raise Refused(f"its {what} {value!r} is not an integer from 1 to {largest}")
    return value


def checksum(tensors: dict[str, torch.Tensor]) -> str:
    """SHA-256 of the tensors by name: their names, dtypes, shapes and little-endian bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        array = tensors[name].detach().cpu().numpy()
        digest.update(json.dumps([name, str(array.dtype), array.shape]).encode())
        digest.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def seal(record: dict[str, Any]) -> str:
    """SHA-256 of what the flow is made by: kind, architecture (with the parts of H that it names), dt, and checksum.

    Like the checksum it tells a damaged file, or one edited by hand, not one that somebody made on purpose: therefore
    nothing in a file is trusted, sealed or not.
    """
    made_of = {name: record.get(name) for name in ("kind", "architecture", "dt", "checksum")}
    return hashlib.sha256(json.dumps(made_of, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def fill(flow: FlowMap, content: bytes, header: dict[str, Any], record: dict[str, Any]) -> None:
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
    _check_seal(record)
    flow.load_state_dict(tensors)
    flow.requires_grad_(False)


def _check_seal(record: dict[str, Any]) -> None:
    """Files of earlier versions have none; those that name parts of H must."""
    split = record["architecture"].get("split")
    if "seal" not in record and not (isinstance(split, dict) and split.get("expressions")):
        return
    if record.get("seal") != seal(record):
        raise Refused("its architecture is not the one that was saved: its seal differs, the file is damaged")
