"""Files of flows: safetensors with a JSON record, never pickle. A file is taken for hostile until all of it is checked.

The metadata entry "sympflow" is a JSON object: format, version (of the package), kind, architecture, dt, domain,
system, fingerprint, recipe, figures, checksum (of the tensors), and, where there are any, certificate, identity
(the H of the system, at states of the domain and as an expression), unfitted (intervals of t without labels)
drive_times (where a drive without a period was fitted), and lattice_terms (the terms of a lattice, as texts). The entry
"sympflow_checksum" is of this object's text; files of format 1 have none, and their weights alone are known to be those
that were saved.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from sympflow._version import __version__
from sympflow.arguments import naming_path, writable
from sympflow.flow.certificate import Certificate
from sympflow.flow.families import KINDS, family_of
from sympflow.flow.potentials import Unregistered
from sympflow.flow.scaling import Scaling
from sympflow.flow.weights import checked_device, checksum
from sympflow.hamiltonian.domain import Domain, domain_from_dict
from sympflow.hamiltonian.fingerprint import Identity
from sympflow.hamiltonian.system import HamiltonianSystem

FORMAT = 2
KEY, SUM = "sympflow", "sympflow_checksum"
MAX_HEADER = 2**20
MAX_FILE = 2**28
MIN_DT, MAX_DT = 1e-18, 1e18  # were they seconds, from an attosecond to more than the age of the universe
MAX_LAYERS = 1000
MAX_WIDTH = 4096
MAX_DEGREE = 64
MAX_PARAMETERS = 10_000_000
FINGERPRINT_LENGTH = 8
DTYPES = {"F32": torch.float32, "F64": torch.float64}
FIELDS = ("version", "domain", "system", "fingerprint", "recipe", "figures")
STAGE: dict[str, Any] = {
    "optimizer": str,
    "loss": str,
    "schedule": str,
    "ended_early": (str, type(None)),
    "points": (int, type(None)),
    **dict.fromkeys(("steps", "steps_taken", "best_step", "seed"), int),
}
"""The types of what every stage of training may record; its other entries are numbers, strings, booleans or None."""


class Refused(Exception):
    """The reason for which a file is refused, and what to do.

    Parameters
    ----------
    reason : str
    remedy : str
    """

    def __init__(self, reason: str, remedy: str = "Save it again with flow.save(path)") -> None:
        super().__init__(reason)
        self.remedy = remedy


@dataclass(frozen=True)
class Description:
    """All that a file tells of its flow beside architecture and weights.

    Attributes
    ----------
    domain, system, fingerprint, recipe, figures, certificate
        `FlowMap`'s domain, system_name, fingerprint, recipe, figures, certified.
    identity, unfitted, drive_times, lattice_terms
        `FlowMap`'s own.
    """

    domain: Domain | None = None
    system: str | None = None
    fingerprint: tuple[float, ...] | None = None
    recipe: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    certificate: Certificate | None = None
    identity: Identity | None = None
    unfitted: tuple[tuple[float, float], ...] = ()
    drive_times: tuple[float, float] | None = None
    lattice_terms: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_record(cls, record: dict[str, Any], ndof: int) -> Self:
        """Return what the record tells, all of it checked.

        Raises
        ------
        Refused
        """
        missing = [name for name in FIELDS if name not in record]
        if missing:
            raise Refused(f"its record has no {', '.join(missing)}")
        if not isinstance(record["version"], str):
            raise Refused("its version is not a string")
        system, fingerprint = record["system"], record["fingerprint"]
        _check_system(system, fingerprint, ndof)
        _check_recipe(record["recipe"], ndof)
        if not isinstance(record["figures"], dict):
            raise Refused(f"its figures are not a table: {record['figures']!r}")
        for name, value in record["figures"].items():
            if value is not None and not _is_number(value):
                raise Refused(f"its figures have a {name} that is neither a number nor None: {value!r}")
        certificate, identity = _certificate(record), _identity(record, ndof)
        domain = None if record["domain"] is None else _domain(record["domain"], ndof)
        if fingerprint is not None:
            fingerprint = tuple(math.nan if v is None else float(v) for v in fingerprint)
        unfitted = _intervals(record.get("unfitted", []), "unfitted times")
        driven = _intervals(record.get("drive_times", []), "times of its drive")
        if len(driven) > 1 or any(low >= high for low, high in driven):
            raise Refused("its times of the drive are not one interval")
        return cls(
            domain,
            system,
            fingerprint,
            record["recipe"],
            record["figures"],
            certificate,
            identity,
            unfitted,
            driven[0] if driven else None,
            _texts(record.get("lattice_terms", {})),
        )


# writing ---------------------------------------------------------------------------------------------------


def write(
    path: str | os.PathLike[str],
    kind: str,
    architecture: dict[str, Any],
    dt: float,
    weights: Mapping[str, Tensor],
    description: Description,
) -> None:
    """Write a flow to a safetensors file, atomically: see `FlowMap.save`."""
    file = _path(path)
    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"`flow` has weights that are not finite ({name}): train it again before saving.")
    record = {
        "format": FORMAT,
        "version": __version__,
        "kind": kind,
        "architecture": architecture,
        "dt": dt,
        "domain": None if description.domain is None else description.domain.to_dict(),
        "system": description.system,
        "fingerprint": description.fingerprint,
        "recipe": description.recipe,
        "figures": description.figures,
        "checksum": checksum(tensors),
    }
    if description.unfitted:
        record["unfitted"] = description.unfitted
    if description.drive_times is not None:
        record["drive_times"] = [description.drive_times]
    if description.lattice_terms:
        record["lattice_terms"] = dict(description.lattice_terms)
    if description.identity is not None:
        record["identity"] = description.identity.to_dict()
    if description.certificate is not None:
        if description.certificate.weights == record["checksum"]:
            record["certificate"] = description.certificate.to_dict()
        else:
            warnings.warn(
                "`flow` was changed, or converted to another precision, after its certificate was computed, which is "
                "therefore not stored: compute it again by flow.certificate(system) before saving.",
                RuntimeWarning,
                stacklevel=3,
            )
    record = _finite(record)
    try:
        Description.of_record(record, architecture["ndof"])
    except Refused as reason:
        raise ValueError(f"`flow` cannot be saved as it is: {reason}. Set it right first.") from None
    text = json.dumps(record, allow_nan=False, separators=(",", ":"))
    content = save_tensors(tensors, {KEY: text, SUM: text_checksum(text)})
    if (length := struct.unpack("<Q", content[:8])[0]) > MAX_HEADER:
        raise ValueError(
            f"`flow` cannot be saved as it is: its description takes {length:,} bytes, more than {MAX_HEADER:,}. "
            "Describe its domain with fewer numbers, for instance a Tube around fewer states."
        )
    with naming_path(writable(file)):
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "wb") as temporary:
            temporary.write(content)
        Path(name).chmod(0o644)
        os.replace(name, file)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def text_checksum(text: str) -> str:
    """Return the SHA-256 of a record's text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _finite(value: Any) -> Any:
    """Return the value with None for numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# reading, with suspicion -----------------------------------------------------------------------------------


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
        `flow.bind(system)`; `solve` gives them as well. A flow that was learned from data brings its own.
    device : torch.device or str, optional

    Returns
    -------
    SympFlow or MLPFlow
        With parameters that do not require gradients, and its domain, recipe and figures.

    Raises
    ------
    ValueError
        If the file is missing, truncated, of another or a later format, or anything in it is not as it should be:
        tensors of the wrong name, shape or dtype, weights that are not finite, weights or a record (Δt, architecture,
        domain, figures) that are not those that were saved, an absurd architecture. Of a file of format 1, as earlier
        versions wrote them and as flows ship, the weights alone are compared with what was saved. Or if `system` is not
        the one that the flow was made for, or `device` is not to be had.
    TypeError
        If `path` is not a path, or `device` not a device.
    """
    file, device = _path(path), checked_device(device)
    try:
        content, header, record, altered = _read(file)
        flow = _build(record, _dtype_of(header))
        _fill(flow, content, header, record)
        description = Description.of_record(record, flow.ndof)
        if altered:
            raise Refused("its record is not the one that was saved: its checksum differs, the file was altered")
        flow.describe(description)
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


def _path(path: Any) -> Path:
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"`path` must be the path of a file; got {path!r}: pass a string or a pathlib.Path.")
    return Path(path)


def _refusal(path: Path, reason: str, remedy: str) -> ValueError:
    return ValueError(f"`path` {str(path)!r} is not a usable flow: {reason}. {remedy}.")


def _read(path: Path) -> tuple[bytes, dict[str, Any], dict[str, Any], bool]:
    """Return the bytes of the file, its safetensors header, the record in it, and True if that was altered."""
    try:
        found = path.is_file()
    except OSError:  # a name that no file can have
        found = False
    if not found:
        raise ValueError(f"`path` {str(path)!r} is not a file: pass the path of a flow saved with flow.save(path).")
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
        header = _parsed(content[8:], "header")
        if (expected := len(content) + _tensor_bytes(header)) != size:
            raise Refused(f"it is truncated or damaged: it has {size:,} bytes, by its header {expected:,}")
        content += file.read()
    notes = header.pop("__metadata__", None)
    if not isinstance(notes, dict) or not isinstance(notes.get(KEY), str):
        raise Refused("it holds no record of a sympflow flow")
    record = _parsed(notes[KEY], "record")
    format_ = record.get("format")
    if isinstance(format_, bool) or not isinstance(format_, int):
        raise Refused("its record has no format number")
    if format_ < 1:
        raise Refused(f"its format {format_} is not one there has been")
    if format_ > FORMAT:
        raise Refused(f"its format {format_} is later than {FORMAT}, which this version of sympflow reads: update it")
    if record.get("kind") not in KINDS:
        raise Refused(f"its kind {record.get('kind')!r} is unknown")
    altered = format_ > 1 and notes.get(SUM) != text_checksum(notes[KEY])
    return content, header, record, altered


def _parsed(text: str | bytes, what: str) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(constant)

    try:
        value = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError):
        raise Refused(f"its {what} is not valid JSON") from None
    if not isinstance(value, dict):
        raise Refused(f"its {what} is not a JSON object")
    return value


def _tensor_bytes(header: dict[str, Any]) -> int:
    """Return how many bytes follow the header, by the offsets in it."""
    try:
        return max(
            (int(entry["data_offsets"][1]) for name, entry in header.items() if name != "__metadata__"), default=0
        )
    except (KeyError, TypeError, ValueError, IndexError):
        raise Refused("its header has a tensor without offsets") from None


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
    ndof = checked_integer(plan.get("ndof"), "ndof", MAX_WIDTH)
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


# parts of a record -----------------------------------------------------------------------------------------


def checked_integer(value: Any, what: str, largest: int) -> int:
    """Return a number of a record that is an integer from 1 to `largest`; else it is refused."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= largest:
        raise Refused(f"its {what} {value!r} is not an integer from 1 to {largest}")
    return value


def checked_widths(hidden: Any, inputs: int) -> tuple[int, ...]:
    """Return the widths of hidden layers that a record gives; else they are refused."""
    if not isinstance(hidden, list) or not 1 <= len(hidden) <= MAX_LAYERS:
        raise Refused("its hidden layers are missing or absurdly many")
    widths = tuple(checked_integer(h, "hidden width", MAX_WIDTH) for h in hidden)
    if count_parameters(widths, inputs) > MAX_PARAMETERS:
        raise Refused("its architecture is absurdly large")
    return widths


def count_parameters(widths: tuple[int, ...], inputs: int) -> int:
    """Return how many parameters a network of these widths has, nearly."""
    return sum(m * n for m, n in zip((inputs + 2, *widths), (*widths, inputs), strict=True))


def _certificate(record: dict[str, Any]) -> Certificate | None:
    """Return the certificate in the record, if there is one; it must be of the weights that the file holds."""
    if record.get("certificate") is None:
        return None
    try:
        certificate = Certificate.from_dict(record["certificate"])
    except ValueError as error:
        raise Refused(f"its certificate is not admissible ({error})") from None
    if certificate.weights != record.get("checksum"):
        raise Refused("its certificate is one of other weights")
    return certificate


def _identity(record: dict[str, Any], ndof: int) -> Identity | None:
    """Return the identity of the system in the record, if there is one; a text in it is not read yet."""
    if record.get("identity") is None:
        return None
    try:
        return Identity.from_dict(record["identity"], ndof)
    except ValueError as error:
        raise Refused(f"its identity of the system is not admissible: {error}") from None


def _intervals(pairs: Any, what: str) -> tuple[tuple[float, float], ...]:
    """Return the intervals of times in a record; else they are refused."""
    if not isinstance(pairs, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
        raise Refused(f"its {what} are not a list of pairs")
    if not all(_is_number(v) for pair in pairs for v in pair):
        raise Refused(f"its {what} are not numbers")
    return tuple((float(low), float(high)) for low, high in pairs)


def _texts(table: Any) -> dict[str, str]:
    """Return a table of texts in a record, which are shown and never read; else it is refused."""
    if not isinstance(table, dict) or not all(isinstance(text, str) for text in table.values()):
        raise Refused("its terms of a lattice are not a table of texts")
    return table


def _check_system(name: Any, fingerprint: Any, ndof: int) -> None:
    """Refuse all but a fingerprint, or, of a flow that never had a system, None as its system and fingerprint."""
    if not isinstance(name, str | None):
        raise Refused("its system is not a name")
    if fingerprint is None:
        if name is not None:
            raise Refused(f"its fingerprint of the system {name!r} is missing")
        return
    friction = 0, 1, ndof, ndof**2
    if not isinstance(fingerprint, list) or len(fingerprint) - FINGERPRINT_LENGTH not in friction:
        raise Refused(f"its fingerprint is not a list of {FINGERPRINT_LENGTH} numbers, and those of its friction")
    if not all(v is None or _is_number(v) for v in fingerprint):
        raise Refused("its fingerprint is not a list of numbers")


def _check_recipe(recipe: Any, ndof: int) -> None:
    if not isinstance(recipe, dict):
        raise Refused(f"its recipe is not a table: {recipe!r}")
    stages = recipe.get("stages", [])
    if not isinstance(stages, list) or not all(isinstance(stage, dict) for stage in stages):
        raise Refused("its recipe has stages that are not a list of tables")
    for stage in stages:
        for name, value in stage.items():
            kind = STAGE.get(name, (int, float, str, bool, type(None)))
            if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
                raise Refused(f"its recipe has a stage with {name} {value!r}, which is of the wrong type")
    made = recipe.get("transforms")
    if isinstance(made, dict) and made.get("identity") is not None:
        _identity(made, ndof - 1)
    if not isinstance(recipe.get("torch", ""), str):
        raise Refused("its recipe has a version of torch that is not a string")
    if "scaling" in recipe:
        scaling = recipe["scaling"]
        try:
            if not all(_is_number(v) for u in scaling.values() for v in (u if isinstance(u, list) else [u])):
                raise TypeError("not numbers")
            if len(Scaling.from_dict(scaling).q) != ndof:
                raise ValueError(f"not of {ndof} degrees of freedom")
        except (TypeError, ValueError, AttributeError) as error:
            raise Refused(f"its recipe has a scaling that is not admissible ({error})") from None


def _domain(description: Any, ndof: int) -> Domain:
    try:
        domain = domain_from_dict(description)
    except (ValueError, TypeError, AttributeError) as error:
        raise Refused(f"its domain is not admissible ({error})") from None
    if domain.width not in (None, 2 * ndof):
        raise Refused(f"its domain has states of length {domain.width}, not {2 * ndof}")
    return domain


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
