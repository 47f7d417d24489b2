"""Families of models, each from simple to rich, among which held-out trajectories choose."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sympflow.learning.models import FixedKinetic, Kinetic, Model, Part, Polynomial

DEGREES = (2, 3, 4, 5, 6, 8)
MOST_TERMS = 500


@dataclass(frozen=True)
class Said:
    """What is known of H.

    Attributes
    ----------
    scales : ndarray of shape (2d,)
        The spread of each coordinate in the data.
    separable : bool or None
        None for not known.
    inverse_mass : ndarray of shape (d, d) or None
    rates : int
        How many rates of friction are to be learned.
    """

    scales: np.ndarray
    separable: bool | None = None
    inverse_mass: np.ndarray | None = None
    rates: int = 0

    @property
    def ndof(self) -> int:
        return len(self.scales) // 2

    def kinetic(self) -> Part:
        """½ pᵀM⁻¹p, learned if it is not known."""
        return Kinetic(self.scales[self.ndof :]) if self.inverse_mass is None else FixedKinetic(self.inverse_mass)

    def separated(self, potential: Part) -> Model:
        """½ pᵀM⁻¹p + V(q)."""
        return Model(self.ndof, (self.kinetic(), potential), self.rates)


@dataclass(frozen=True)
class Candidate:
    """A model with its name."""

    name: str
    model: Model


def _polynomials(said: Said) -> Iterator[Candidate]:
    for degree in DEGREES:
        V = Polynomial.up_to(degree, "q", said.scales[: said.ndof])
        if V.n > MOST_TERMS:
            return
        yield Candidate(f"T = ½ pᵀM⁻¹p, V a polynomial of degree {degree}", said.separated(V))


def _whole_polynomials(said: Said) -> Iterator[Candidate]:
    for degree in DEGREES:
        H = Polynomial.up_to(degree, "y", said.scales)
        if H.n > MOST_TERMS:
            return
        yield Candidate(f"H(q, p) a polynomial of degree {degree}", Model(said.ndof, (H,), said.rates))


@dataclass(frozen=True)
class Family:
    """Models of one kind.

    Attributes
    ----------
    separable : bool
        Whether they have the form T(p) + V(q).
    models : callable
        models(said): candidates from simple to rich.
    """

    separable: bool
    models: Callable[[Said], Iterator[Candidate]]


FAMILIES = {
    "polynomial": Family(True, _polynomials),
    "whole-polynomial": Family(False, _whole_polynomials),
}
"""In the order in which they are tried."""


def families(said: Said, name: str | None) -> list[str]:
    """The names of the families that fit what is known, or of the one that is asked for.

    Raises
    ------
    ValueError
        If there is no such family, or it contradicts what is known.
    """
    if name is not None and name not in FAMILIES:
        raise ValueError(f"`family` {name!r} is unknown: choose from {', '.join(FAMILIES)}, or leave it out.")
    if name is not None and said.separable and not FAMILIES[name].separable:
        raise ValueError(
            f"`family` {name!r} is of functions H(q, p), not separable: leave out `separable` or `family`."
        )
    if said.inverse_mass is not None and (said.separable is False or (name and not FAMILIES[name].separable)):
        raise ValueError("`mass` is of T = ½ pᵀM⁻¹p in a separable H: leave out one of them.")
    if name is not None:
        return [name]
    only = said.separable if said.inverse_mass is None else True
    return [name for name, family in FAMILIES.items() if only is None or family.separable == only]


def with_unit_mass(candidate: Candidate, said: Said) -> Candidate | None:
    """The same model with T = ½ p²; None if its T is not learned."""
    parts = candidate.model.parts
    if said.inverse_mass is not None or (not candidate.model.nystrom and not candidate.model.rates):
        return None
    rest = tuple(part for part in parts if part.of != "p")
    name = candidate.name.replace("T = ½ pᵀM⁻¹p", "T = ½ p²")
    return Candidate(name, Model(said.ndof, (FixedKinetic(np.eye(said.ndof)), *rest), said.rates))


def pruned(candidate: Candidate, theta: np.ndarray, precision: np.ndarray, values: int) -> Candidate | None:
    """The same model without the terms of polynomials that the data do not ask for; None if they ask for all.

    Terms are left out one by one, that one first which, by the quadratic approximation of χ² at its minimum, raises it
    least, as long as Schwarz's criterion gains: by less than the logarithm of the number of values.

    Parameters
    ----------
    theta : ndarray of shape (n,)
    precision : ndarray of shape (n, n)
        Half the second derivative of χ² by θ.
    values : int
        Numbers observed.

    References
    ----------
    .. [1] G. Schwarz, Estimating the dimension of a model, Ann. Statist. 6 (1978) 461–464.
    """
    model = candidate.model
    droppable = np.zeros(model.n, dtype=bool)
    for part, place in zip(model.parts, model.places, strict=True):
        droppable[place] = isinstance(part, Polynomial)
    theta, covariance, dropped = theta.copy(), np.linalg.pinv(precision, hermitian=True), np.zeros(model.n, dtype=bool)
    while True:
        spread = np.diagonal(covariance)
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = np.where(droppable & ~dropped & (spread > 0), theta**2 / spread, np.inf)
        k = int(np.argmin(rise))
        if not rise[k] < math.log(values):
            break
        dropped[k] = True
        column = covariance[:, k] / covariance[k, k]
        theta = theta - column * theta[k]
        covariance = covariance - np.outer(column, covariance[k])
    if not dropped.any():
        return None
    left = model.without(dropped)
    if any(part.n == 0 for part, former in zip(left.parts, model.parts, strict=True) if former.n):
        return None
    return Candidate(f"{candidate.name}, {left.n} of {model.n} terms", left)
