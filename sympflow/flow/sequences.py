"""Kicks and drifts in turn, and the columns of numbers that they take theirs from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import nn

from sympflow.flow.coefficients import Coefficients, Entry
from sympflow.flow.frozen import Kind, Substep


class Terms(NamedTuple):
    """What kicks have beside V: a force gradient, a curvature, or so many monomials."""

    force_gradient: bool
    curvature: bool
    monomials: int


class Columns(NamedTuple):
    """Those of a sequence; all None if it is empty."""

    kicks: Any = None
    drifts: Any = None
    gradients: Any = None
    curvatures: Any = None
    polynomials: Any = None


def alternating(first: Kind, n: int) -> tuple[Kind, ...]:
    """The kinds of n maps."""
    other: Kind = "drift" if first == "kick" else "kick"
    return tuple(first if i % 2 == 0 else other for i in range(n))


def columns_of(
    sequence: Sequence[Kind], degree: int, stride: int, dt: float, mirrored: bool, total: float | None, terms: Terms,
    **like: Any,
) -> Columns:  # fmt: skip
    """Untrained columns of the numbers of a sequence: polynomials in t of that degree, the powers `stride` apart."""

    def column(kind: Kind, power: int, total: float | None = None) -> Coefficients:
        return Coefficients(sequence.count(kind), tuple(range(0, degree, stride)), dt, power, mirrored, total, **like)

    if not sequence:
        return Columns()
    return Columns(
        column("kick", 1, total),
        column("drift", 1, total),
        column("kick", 3) if terms.force_gradient else None,
        column("kick", 5) if terms.curvature else None,
        nn.ModuleList(column("kick", 3) for _ in range(terms.monomials)) if terms.monomials else None,
    )


def substeps_of(sequence: Sequence[Kind], columns: Columns, sign: int) -> list[Substep]:
    """The maps of a sequence, with their places in the columns."""
    kicks, drifts, gradients, curvatures, polynomials = columns
    more = [c for c in (gradients, curvatures) if c is not None] if polynomials is None else polynomials
    made = []
    for i, kind in enumerate(sequence):
        one, *others = [kicks, *more] if kind == "kick" else [drifts]
        made.append(Substep(kind, Entry(one, i // 2, sign), tuple(Entry(c, i // 2, sign) for c in others)))
    return made
