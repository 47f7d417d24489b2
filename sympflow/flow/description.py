"""What a file tells of its flow beside the weights: domain, system, recipe, figures; checked in saving and loading."""

from __future__ import annotations

import math
from typing import Any

from sympflow.flow.base import FlowMap
from sympflow.flow.certificate import Certificate
from sympflow.flow.record import Refused
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain, domain_from_dict

FIELDS = ("version", "domain", "system", "fingerprint", "recipe", "figures")
FINGERPRINT_LENGTH = 8
STAGE: dict[str, Any] = {
    "optimizer": str,
    "loss": str,
    "schedule": str,
    "ended_early": (str, type(None)),
    "points": (int, type(None)),
    **dict.fromkeys(("steps", "steps_taken", "best_step", "seed"), int),
}
"""The types of what every stage of training may record; its other entries are numbers, strings, booleans or None."""


def describe(flow: FlowMap, record: dict[str, Any]) -> None:
    """Give the flow the description in its file."""
    flow.domain = check(record, flow.ndof)
    if record["fingerprint"] is not None:
        flow.fingerprint = tuple(math.nan if v is None else float(v) for v in record["fingerprint"])
    flow.system_name, flow.recipe, flow.figures = record["system"], record["recipe"], record["figures"]
    flow.certified = _certificate(record)


def check(record: dict[str, Any], ndof: int) -> Domain | None:
    """The domain in the record, all of whose description is checked.

    Raises
    ------
    Refused
    """
    missing = [name for name in FIELDS if name not in record]
    if missing:
        raise Refused(f"its record has no {', '.join(missing)}")
    if not isinstance(record["version"], str):
        raise Refused("its version is not a string")
    _check_system(record["system"], record["fingerprint"])
    _check_recipe(record["recipe"], ndof)
    if not isinstance(record["figures"], dict):
        raise Refused(f"its figures are not a table: {record['figures']!r}")
    for name, value in record["figures"].items():
        if value is not None and not _is_number(value):
            raise Refused(f"its figures have a {name} that is neither a number nor None: {value!r}")
    _certificate(record)
    return None if record["domain"] is None else _domain(record["domain"], ndof)


def _certificate(record: dict[str, Any]) -> Certificate | None:
    """The certificate in the record, if there is one; it must be of the weights that the file holds."""
    if record.get("certificate") is None:
        return None
    try:
        certificate = Certificate.from_dict(record["certificate"])
    except ValueError as error:
        raise Refused(f"its certificate is not admissible ({error})") from None
    if certificate.weights != record.get("checksum"):
        raise Refused("its certificate is one of other weights")
    return certificate


def _check_system(name: Any, fingerprint: Any) -> None:
    """A fingerprint, or for a flow that never had a system an explicit None as its system and its fingerprint."""
    if not isinstance(name, str | None):
        raise Refused("its system is not a name")
    if fingerprint is None:
        if name is not None:
            raise Refused(f"its fingerprint of the system {name!r} is missing")
        return
    if not isinstance(fingerprint, list) or len(fingerprint) != FINGERPRINT_LENGTH:
        raise Refused(f"its fingerprint is not a list of {FINGERPRINT_LENGTH} numbers")
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
    if domain.width != 2 * ndof:
        raise Refused(f"its domain has states of length {domain.width}, not {2 * ndof}")
    return domain


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
