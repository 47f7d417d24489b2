"""Records of flows in their files; each entry is checked before it is used."""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from sympflow.flow.certificate import Certificate
from sympflow.flow.families import KINDS
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain, domain_from_dict
from sympflow.hamiltonian.fingerprint import Identity

T = TypeVar("T")

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
    """The reason why a file is refused, and the remedy."""

    def __init__(self, reason: str, remedy: str = "Save it again with flow.save(path)") -> None:
        super().__init__(reason)
        self.remedy = remedy


@dataclass
class Provenance:
    """The records of a flow apart from its map: its system, its domain, its figures, and where these hold."""

    domain: Domain | None = None  # Ω, where it was trained
    system_name: str | None = None  # of the system it was trained for
    fingerprint: tuple[float, ...] | None = None
    recipe: dict[str, Any] = field(default_factory=dict)  # how it was trained
    figures: dict[str, Any] = field(default_factory=dict)  # and what it achieved
    certified: Certificate | None = None  # what `certificate` found, or the file held that it was loaded from
    identity: Identity | None = None  # H of that system, all over Ω; None without a system, or from an early file
    unfitted: tuple[tuple[float, float], ...] = ()  # open intervals of t in which it was compared with nothing
    drive_times: tuple[float, float] | None = None  # t0 + t for which a drive without a period was fitted
    lattice_terms: Mapping[str, str] = field(default_factory=dict)  # of a lattice, for messages

    def to_record(self) -> dict[str, Any]:
        """The entries of the record in a file, without those that say nothing; the certificate is not among them."""
        told: dict[str, Any] = {
            "domain": None if self.domain is None else self.domain.to_dict(),
            "system": self.system_name,
            **{name: getattr(self, name) for name in ("fingerprint", "recipe", "figures")},
        }
        more = {
            "unfitted": self.unfitted,
            "drive_times": [] if self.drive_times is None else [self.drive_times],
            "lattice_terms": dict(self.lattice_terms),
            "identity": None if self.identity is None else self.identity.to_dict(),
        }
        return told | {name: value for name, value in more.items() if value}

    @classmethod
    def of_record(cls, record: dict[str, Any], ndof: int) -> Self:
        """Return the provenance of a record, all of it checked."""
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
        identity, certificate = _identity(record, ndof), None
        if record.get("certificate") is not None:
            certificate = _made("certificate", Certificate.from_dict, record["certificate"])
            if certificate.weights != record.get("checksum"):
                raise Refused("its certificate is one of other weights")
        domain = None if record["domain"] is None else _domain(record["domain"], ndof)
        if fingerprint is not None:
            fingerprint = tuple(math.nan if v is None else float(v) for v in fingerprint)
        unfitted = _intervals(record.get("unfitted", []), "unfitted times")
        driven = _intervals(record.get("drive_times", []), "times of its drive")
        if len(driven) > 1 or any(low >= high for low, high in driven):
            raise Refused("its times of the drive are not one interval")
        texts = record.get("lattice_terms", {})  # which are shown and never read
        if not isinstance(texts, dict) or not all(isinstance(text, str) for text in texts.values()):
            raise Refused("its terms of a lattice are not a table of texts")
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
            texts,
        )


def text_checksum(text: str) -> str:
    """Return the SHA-256 of a record's text."""
    return hashlib.sha256(text.encode()).hexdigest()


def numbers_checksum(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of arrays by name: their names, dtypes, shapes and little-endian bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(json.dumps([name, str(array.dtype), array.shape]).encode())
        digest.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def checked_path(path: Any) -> Path:
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"`path` must be the path of a file; got {path!r}: pass a string or a pathlib.Path.")
    return Path(path)


def read(path: Path) -> tuple[bytes, dict[str, Any], dict[str, Any], bool]:
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
            raise Refused(f"it is not a safetensors file, or its header is oversized ({length:,} bytes)")
        content += file.read(length)
        if len(content) < 8 + length:
            raise Refused("it is truncated")
        header = parsed(content[8:], "header")
        if (expected := len(content) + _tensor_bytes(header)) != size:
            raise Refused(f"it is truncated or damaged: it has {size:,} bytes, by its header {expected:,}")
        content += file.read()
    notes = header.pop("__metadata__", None)
    if not isinstance(notes, dict) or not isinstance(notes.get(KEY), str):
        raise Refused("it holds no record of a sympflow flow")
    record = parsed(notes[KEY], "record")
    format_ = record.get("format")
    if isinstance(format_, bool) or not isinstance(format_, int):
        raise Refused("its record has no format number")
    if format_ < 1:
        raise Refused(f"its format {format_} is unknown")
    if format_ > FORMAT:
        raise Refused(f"its format {format_} is later than {FORMAT}, which this version of sympflow reads: update it")
    if record.get("kind") not in KINDS:
        raise Refused(f"its kind {record.get('kind')!r} is unknown")
    altered = format_ > 1 and notes.get(SUM) != text_checksum(notes[KEY])
    return content, header, record, altered


def parsed(text: str | bytes, what: str) -> dict[str, Any]:
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


# parts of a record -----------------------------------------------------------------------------------------


def checked_integer(value: Any, what: str, largest: int) -> int:
    """Return a number of a record that is an integer from 1 to `largest`; else it is refused."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= largest:
        raise Refused(f"its {what} {value!r} is not an integer from 1 to {largest}")
    return value


def checked_widths(hidden: Any, inputs: int) -> tuple[int, ...]:
    """Return the widths of hidden layers that a record gives; else they are refused."""
    if not isinstance(hidden, list) or not 1 <= len(hidden) <= MAX_LAYERS:
        raise Refused("its hidden layers are missing or too many")
    widths = tuple(checked_integer(h, "hidden width", MAX_WIDTH) for h in hidden)
    if count_parameters(widths, inputs) > MAX_PARAMETERS:
        raise Refused("its architecture is too large")
    return widths


def count_parameters(widths: tuple[int, ...], inputs: int) -> int:
    """Return how many parameters a network of these widths has, nearly."""
    return sum(m * n for m, n in zip((inputs + 2, *widths), (*widths, inputs), strict=True))


def _made(what: str, make: Callable[..., T], *given: Any) -> T:
    """Return what a part of the record describes; else it is refused."""
    try:
        return make(*given)
    except (ValueError, TypeError, AttributeError) as error:
        raise Refused(f"its {what} is not admissible ({error})") from None


def _identity(record: dict[str, Any], ndof: int) -> Identity | None:
    """Return the identity of the system in the record, if there is one; a text in it is not read yet."""
    kept = record.get("identity")
    return None if kept is None else _made("identity of the system", Identity.from_dict, kept, ndof)


def _intervals(pairs: Any, what: str) -> tuple[tuple[float, float], ...]:
    """Return the intervals of times in a record; else they are refused."""
    if not isinstance(pairs, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
        raise Refused(f"its {what} are not a list of pairs")
    if not all(_is_number(v) for pair in pairs for v in pair):
        raise Refused(f"its {what} are not numbers")
    return tuple((float(low), float(high)) for low, high in pairs)


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
        _made("recipe's scaling", _scaling, recipe["scaling"], ndof)


def _scaling(told: Any, ndof: int) -> None:
    if not all(_is_number(v) for u in told.values() for v in (u if isinstance(u, list) else [u])):
        raise TypeError("not numbers")
    if len(Scaling.from_dict(told).q) != ndof:
        raise ValueError(f"not of {ndof} degrees of freedom")


def _domain(description: Any, ndof: int) -> Domain:
    domain = _made("domain", domain_from_dict, description)
    if domain.width not in (None, 2 * ndof):
        raise Refused(f"its domain has states of length {domain.width}, not {2 * ndof}")
    return domain


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
