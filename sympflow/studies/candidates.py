"""What `compare` and its relatives accept as a method, made uniform."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.registry import build, name_of


@dataclass(frozen=True)
class Candidate:
    """A method under its label; `problem` says why it has no integrator, if so."""

    label: str
    method: str
    integrator: Any
    problem: str = ""


def candidates(methods: Sequence[Any], dt: float | None = None) -> list[Candidate]:
    """The candidates that the methods mean; labels are made distinct.

    Parameters
    ----------
    methods : sequence
        Names, integrators, trained flows, or pairs (label, any of these).
    dt : float, optional
        Step of the fixed-step classical methods that are given by name.

    Raises
    ------
    ValueError, TypeError
        For an unknown name, or no methods at all. A plug-in that cannot be loaded is a candidate with a problem.
    """
    if isinstance(methods, str) or not isinstance(methods, Sequence):
        raise TypeError(f"`methods` must be a list of methods; got {methods!r}. Put it in brackets.")
    if not methods:
        raise ValueError("`methods` is empty: name at least one of sympflow.available().")
    found: list[Candidate] = []
    for entry in methods:
        labelled = isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[0], str)
        label, method = entry if labelled else (None, entry)
        try:
            integrator = build(method, {})
        except ImportError as error:
            name = str(method)
            found.append(Candidate(_distinct(label or name, found), name, None, str(error)))
            continue
        if dt is not None and isinstance(method, str) and isinstance(integrator, FixedStep) and not integrator.trained:
            integrator = replace(integrator, dt=dt)
        name = method if isinstance(method, str) else name_of(integrator)
        found.append(Candidate(_distinct(label or _label(name, method, integrator), found), name, integrator))
    return found


def _label(name: str, method: Any, integrator: Integrator) -> str:
    """The name, with the step or tolerance if the caller configured one."""
    if not isinstance(method, Integrator) or integrator.trained:
        return name
    if isinstance(integrator, FixedStep):
        return name if integrator.dt is None else f"{name} (dt={integrator.dt:g})"
    return f"{name} (rtol={integrator.rtol:g})" if hasattr(integrator, "rtol") else name


def _distinct(label: str, found: list[Candidate]) -> str:
    taken = {c.label for c in found}
    if label not in taken:
        return label
    return next(f"{label} #{k}" for k in range(2, len(found) + 2) if f"{label} #{k}" not in taken)
