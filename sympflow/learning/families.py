"""Families of models, each from simple to rich, among which held-out trajectories choose."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import sympy

from sympflow.flow.scaling import Scaling
from sympflow.learning.inertia import Inertia
from sympflow.learning.library import coordinates_of
from sympflow.learning.maps import NetworkFlow
from sympflow.learning.models import Force, Model, drags
from sympflow.learning.parts import Distances, Drive, Fixed, Network, Part, Polynomial, Waves, kinetic, known_kinetic

DEGREES = (2, 3, 4, 5, 6, 8, 10)
HARMONICS = (1, 2, 3, 4, 6, 8)
ORDERS = (1, 2, 3, 4)
"""Highest harmonics of angles, or powers of other coordinates, in a mass matrix M(q) and its potential."""
WIDTHS = (6, 12, 24)
WHOLE_WIDTHS = (12, 24, 40)
FLOW_SIZES = ((2, 6, False), (2, 6, True), (3, 10, True), (5, 12, True))
"""Pairs of layers, of half of them where it is palindromic, neurons of each, and True for palindromic SympFlows."""
POWERS = ((-1,), (-2, -1, 0, 1, 2))  # Powers of distances, 0 for the logarithm
CHANGING = 0.5
"""Variance of the total momentum along a trajectory, over the sum of those of its parts, where it is not constant."""
MOST_TERMS = 400
ASSUMED = {"radians": 2 * np.pi, "degrees": 360.0}  # periods of angles that are tried where none is known
FLAT = 0.02  # Spread of an angle, over its period, from which its cosine is told from a parabola


@dataclass(frozen=True)
class Constraints:
    """Knowledge of H."""

    scales: np.ndarray  # (2d,): The spread of each coordinate in the data
    separable: bool | None  # None for not known
    inverse_mass: np.ndarray | None  # (d, d)
    force: Force | None  # Friction or drag whose factors are to be learned, as `models.friction`
    periods: np.ndarray  # (2d,): Of the coordinates that are angles, infinite for the others
    known: tuple[Fixed, ...] = ()  # Parts of H
    # (d, d): The covariance of the momenta along a trajectory, in their mean; None where it is not known
    momenta: np.ndarray | None = None
    flow_scaling: Scaling | None = None  # The units of a flow that is fitted itself, and its Δt; None for none
    velocities: bool = False  # True if [q, q'] are observed: then (M⁻¹)₁₁ = 1, or M₁₁ in the middle of the data
    middle: np.ndarray | None = None  # (d,): The mean of q
    frequencies: tuple[float, ...] = ()  # ω of each drive, about
    angles_known: bool = False  # False if coordinates may be angles though no period is known

    @property
    def ndof(self) -> int:
        return len(self.scales) // 2

    @property
    def kinetic_is_known(self) -> bool:
        return self.inverse_mass is not None or any(part.of == "p" for part in self.known)

    @property
    def angles(self) -> bool:
        """True if there are any."""
        return bool(np.isfinite(self.periods).any())

    def groups(self, name: str) -> Iterator[Group]:
        """The models of a family, and the same with q as angles, if no `period` was given."""
        family, d = FAMILIES[name], self.ndof
        yield Group(family, [*family.models(self)])
        for said, period in () if self.angles_known or not family.angular else ASSUMED.items():
            if ((self.scales[:d] > FLAT * period) & (self.scales[:d] < period)).all():
                wrapped = replace(self, periods=np.where(np.arange(2 * d) < d, period, np.inf), angles_known=True)
                models = (replace(c, kind=f"{c.kind}, q angles in {said}") for c in family.models(wrapped))
                yield Group(family, [*models], assumed=True)

    def at_rest(self, bodies: np.ndarray) -> bool:
        """True unless the total momentum of bodies (n, dim) changes, which forces between them cannot cause."""
        if self.momenta is None or self.known:
            return True
        total = sum(self.momenta[np.ix_(axis, axis)].sum() for axis in bodies.T)
        return bool(total < CHANGING * np.trace(self.momenta))

    def kinetic(self) -> tuple[Part, ...]:
        """½ pᵀM⁻¹p, learned if it is not known."""
        if self.inverse_mass is not None:
            return (known_kinetic(self.inverse_mass),)
        if self.kinetic_is_known:
            return ()
        T = kinetic(self.scales[self.ndof :])
        if not self.velocities:
            return (T,)
        unit = known_kinetic(np.diag(np.eye(self.ndof)[0]))
        return (unit, T.subset(np.arange(T.n) > 0)) if self.ndof > 1 else (unit,)

    def separated(self, *potential: Part) -> Model:
        """T(p) + V(q)."""
        return self.whole(*self.kinetic(), *potential)

    def whole(self, *parts: Part) -> Model:
        """H(q, p)."""
        drives = map(self.driven, self.frequencies)
        return Model(self.ndof, (*parts, *drives, *self.known), self.force, self.velocities)

    def driven(self, frequency: float) -> Drive:
        """Forces and stiffnesses of this frequency: of degree 2 in q, of an angle its first harmonic."""
        scales, periods = self.scales[: self.ndof], self.periods[: self.ndof]
        base = Waves.up_to(1, 2, "q", scales, periods)
        pushes = np.eye(self.ndof)[np.isfinite(periods)]
        exponents = np.concatenate([base.powers.exponents, pushes])
        waves, phases = np.concatenate([base.waves, 0 * pushes]), np.concatenate([base.phases, 0 * pushes[:, 0]])
        return Drive(Waves("q", exponents, waves, phases, scales), frequency)


@dataclass(frozen=True)
class Candidate:
    """A model of some kind, and how many terms it has where none is left out."""

    kind: str
    model: Any
    whole: int | None = None

    @property
    def name(self) -> str:
        """The kind, and how many terms are kept."""
        return self.kind if self.whole is None else f"{self.kind}, {self.model.n} of {self.whole} terms"


T = "T = ½ pᵀM⁻¹p"


@dataclass(frozen=True)
class Form:
    """A function of some coordinates in several sizes."""

    said: str
    sizes: Sequence[int]  # Of V(q)
    whole_sizes: Sequence[int]  # Of H(q, p)
    parts: Callable[[int, str, np.ndarray, np.ndarray], Sequence[Part]]  # By size, coordinates, scales and periods

    def of(self, constraints: Constraints, coordinates: str) -> Iterator[tuple[str, Sequence[Part]]]:
        """The functions of "q" or "y" with not too many numbers, in words and as parts of H."""
        own = slice(constraints.ndof if coordinates == "q" else None)
        for size in self.sizes if coordinates == "q" else self.whole_sizes:
            parts = self.parts(size, coordinates, constraints.scales[own], constraints.periods[own])
            if parts and sum(part.n for part in parts) <= MOST_TERMS:
                yield self.said.format(size), parts

    def potentials(self, constraints: Constraints) -> Iterator[Candidate]:
        """T(p) + V(q)."""
        for said, parts in self.of(constraints, "q"):
            yield Candidate(f"{T}, V {said}", constraints.separated(*parts))

    def hamiltonians(self, constraints: Constraints) -> Iterator[Candidate]:
        """H(q, p)."""
        for said, parts in self.of(constraints, "y"):
            yield Candidate(f"H(q, p) {said}", constraints.whole(*parts))


def _polynomial(degree: int, of: str, scales: np.ndarray, periods: np.ndarray) -> Sequence[Part]:
    few = math.comb(len(scales) + degree, degree) <= MOST_TERMS
    return (Polynomial.up_to(degree, of, scales),) if few else ()


def _series(harmonics: int, of: str, scales: np.ndarray, periods: np.ndarray) -> Sequence[Part]:
    """A Fourier series in the angles, of degree 2 at least in the other coordinates and of degree 2 in p."""
    degree = max(harmonics, 2) if of == "q" else 2
    return (Waves.up_to(harmonics, degree, of, scales, periods),) if np.isfinite(periods).any() else ()


def _network(width: int, of: str, scales: np.ndarray, periods: np.ndarray) -> Sequence[Part]:
    """A network beside quadratic polynomials of the coordinates that are not angles."""
    whole = Polynomial.up_to(2, of, scales)
    quadratic = whole.subset((whole.exponents[:, np.isfinite(periods)] == 0).all(axis=1))
    return quadratic, Network(of, width, scales, periods)


POLYNOMIALS = Form("a polynomial of degree {}", DEGREES, DEGREES, _polynomial)
SERIES = Form("a Fourier series of {} harmonics", HARMONICS, HARMONICS[1:], _series)
NETWORKS = Form("a network of {} neurons", WIDTHS, WHOLE_WIDTHS, _network)


def _inertia(constraints: Constraints) -> Iterator[Candidate]:
    q = slice(0, constraints.ndof)
    scales, periods = constraints.scales[q], constraints.periods[q]
    for order in () if constraints.kinetic_is_known else ORDERS:
        V = Waves.up_to(order, max(order, 2), "q", scales, periods)
        M = Waves.up_to(order, order, "q", scales, periods, constant=True)
        part = Inertia(M, unit=constraints.middle if constraints.velocities else None)
        if V.n + part.n <= MOST_TERMS:
            yield Candidate(f"H = ½ pᵀM(q)⁻¹p + V(q), M and V series of order {order}", constraints.whole(part, V))


def _magnetic(constraints: Constraints) -> Iterator[Candidate]:
    d = constraints.ndof
    exponents = [np.eye(2 * d, dtype=int)[[i, d + j]].sum(axis=0) for i, j in combinations(range(d), 2)]
    turn = Polynomial("y", exponents, constraints.scales)
    for said, parts in POLYNOMIALS.of(constraints, "q") if exponents else ():
        yield Candidate(f"H = ½ pᵀM⁻¹p + Σ b_ij q_i p_j + V, V {said}", constraints.separated(turn, *parts))


def _central(constraints: Constraints) -> Iterator[Candidate]:
    d, size = constraints.ndof, 2 * float(np.mean(constraints.scales[: constraints.ndof]))
    if constraints.angles or d not in (2, 3):
        return
    bodies = np.arange(d)[None]
    for powers in POWERS:
        name = f"{T}, V of the distance from the origin, {_of_powers(powers)}"
        yield Candidate(name, constraints.separated(Distances.between(bodies, powers, size, central=True)))


def _of_powers(powers: Sequence[int]) -> str:
    return "1/r" if powers == (-1,) else "powers of r from −2 to 2 and log r"


def _pairs(constraints: Constraints) -> Iterator[Candidate]:
    d = constraints.ndof
    size = 2 * float(np.mean(constraints.scales[:d]))
    for dim in (2, 3):
        if d % dim or d < 2 * dim:
            continue
        orders = {
            "one body after another": np.arange(d).reshape(-1, dim),
            "one axis after another": np.arange(d).reshape(dim, -1).T,
        }
        for central, powers in product((False, True), POWERS):
            for order, bodies in orders.items():
                if not central and not constraints.at_rest(bodies):
                    continue
                name = f"{T}, V of the distances of {len(bodies)} bodies in {dim} dimensions"
                name += f"{' and from the origin' * central}, {order}, {_of_powers(powers)}"
                yield Candidate(name, constraints.separated(Distances.between(bodies, powers, size, central)))


def _flows(constraints: Constraints) -> Iterator[Candidate]:
    scaling = constraints.flow_scaling
    told = constraints.force or constraints.frequencies or constraints.known or constraints.angles
    if scaling is None or told or constraints.inverse_mass is not None:
        return
    for pairs, width, palindromic in FLOW_SIZES:
        kind, all_pairs = ("palindromic SympFlow", 2 * pairs) if palindromic else ("SympFlow", pairs)
        name = f"{kind} of {all_pairs} pairs of layers of {width} neurons, Δt = {scaling.t:.3g}"
        yield Candidate(name, NetworkFlow(scaling, pairs, width, palindromic))


@dataclass(frozen=True)
class Family:
    """Models of one kind."""

    separable: bool  # True of the form T(p) + V(q)
    # models(constraints): candidates from simple to rich, none where the family does not apply
    models: Callable[[Constraints], Iterator[Candidate]]
    # True of models that are linear in their numbers, and soon fitted. Before those that are not, the data are asked
    # whether any H explains them
    linear: bool = True
    angular: bool = False  # True if it tells angles from other coordinates
    observed: str = "both"  # What its numbers can be told by: "qp" for states, "qv" for velocities, "both"

    def tells(self, constraints: Constraints) -> bool:
        """True if the observed quantities determine the numbers of its models."""
        return self.observed in ("both", "qv" if constraints.velocities else "qp")


class Group(NamedTuple):
    """The models of a family."""

    family: Family
    models: list[Candidate]
    assumed: bool = False  # True where q would be angles, which nobody told


FAMILIES = {
    "central": Family(True, _central),
    "pairs": Family(True, _pairs),
    "waves": Family(True, SERIES.potentials, angular=True),
    "polynomial": Family(True, POLYNOMIALS.potentials),
    "network": Family(True, NETWORKS.potentials, linear=False),
    "inertia": Family(False, _inertia, linear=False, angular=True),
    "magnetic": Family(False, _magnetic, observed="qv"),
    "whole-waves": Family(False, SERIES.hamiltonians, angular=True, observed="qp"),
    "whole-polynomial": Family(False, POLYNOMIALS.hamiltonians, observed="qp"),
    "whole-network": Family(False, NETWORKS.hamiltonians, linear=False, observed="qp"),
    "sympflow": Family(False, _flows, linear=False, observed="qp"),
}
"""In the order in which they are tried: potentials of the distance from the origin, and of distances of bodies; Fourier
series, where a `period` is given; polynomials; networks of one layer. The first five have H = ½ pᵀM⁻¹p + V(q);
"inertia" has a mass matrix that depends on q, as of pendulums that hang on each other; "magnetic", for velocities, a
uniform magnetic field, in Landau's gauge; the next three are functions H(q, p). "sympflow" is last: flow maps with
neural potentials, which are fitted to the data themselves, and no H is learned."""


def families(constraints: Constraints, name: str | None) -> list[str]:
    """The names of the families that are consistent with the options, or of the one that is chosen.

    Raises
    ------
    ValueError
        If there is no such family, or it contradicts the options.
    """
    if name is not None and name not in FAMILIES:
        raise ValueError(f"`family` {name!r} is unknown: choose from {', '.join(FAMILIES)}, or leave it out.")
    if name is not None and constraints.separable and not FAMILIES[name].separable:
        raise ValueError(
            f"`family` {name!r} is of functions H(q, p), not separable: leave out `separable` or `family`."
        )
    whole = constraints.separable is False or (name and not FAMILIES[name].separable)  # an H(q, p) is asked for
    if constraints.frequencies and whole:
        raise ValueError("`drive` is of a separable H: leave out `separable`, or the `family`.")
    if constraints.frequencies and constraints.force is drags:
        raise ValueError("`drive` is learned beside friction, not beside drag: pass damping=True, or leave it out.")
    if constraints.frequencies and not all(_kicks(part, constraints.ndof) for part in constraints.known):
        raise ValueError("`drive` is of H = ½ pᵀM⁻¹p + V(q, t), which `known` does not fit: leave out one of them.")
    if constraints.inverse_mass is not None and whole:
        raise ValueError("`mass` is of T = ½ pᵀM⁻¹p in a separable H: leave out one of them.")
    if name is not None and not (FAMILIES[name].tells(constraints) and next(FAMILIES[name].models(constraints), None)):
        raise ValueError(
            f"`family` {name!r} does not apply: series need the `period` of an angle, pairs the coordinates of two "
            "bodies or more in two or three dimensions, central fields those of one, functions H(q, p) and flows "
            "momenta, a magnetic field velocities in two dimensions or more, flows nothing that is known of H, and "
            "other families not too many degrees of freedom."
        )
    if name is not None:
        return [name]
    only = constraints.separable if constraints.inverse_mass is None and not constraints.frequencies else True
    kinds = {name: family for name, family in FAMILIES.items() if family.tells(constraints)}
    return [name for name, family in kinds.items() if only is None or family.separable == only]


def _kicks(part: Fixed, ndof: int) -> bool:
    """True of a V(q), or a T(p) whose masses are constant."""
    x = coordinates_of(part.of, ndof)
    return part.of == "q" or (part.of == "p" and not sympy.hessian(part.expression(part.theta, x), x).free_symbols)


def with_unit_mass(candidate: Candidate, constraints: Constraints) -> Candidate | None:
    """The same model with T = ½ p²; None if its T is not learned."""
    model, parts = candidate.model, candidate.model.parts
    if not any(part.of == "p" and part.n for part in parts) or not (model.nystrom or model.forces):
        return None
    rest = tuple(part for part in parts if part.of != "p")
    kind = candidate.name.replace("T = ½ pᵀM⁻¹p", "T = ½ p²")
    return Candidate(kind, replace(candidate.model, parts=(known_kinetic(np.eye(constraints.ndof)), *rest)))


def pruned(candidate: Candidate, theta: np.ndarray, precision: np.ndarray, values: int) -> Candidate | None:
    """The same model without terms that are not significant; None if all are.

    Terms are left out one by one, that one first which, by the quadratic approximation of χ² at its minimum, raises it
    least, as long as Schwarz's criterion gains: by less than the logarithm of the number of values.

    References
    ----------
    .. [1] G. Schwarz, Estimating the dimension of a model, Ann. Statist. 6 (1978) 461–464.
    """
    model = candidate.model
    droppable = np.zeros(model.n, dtype=bool)
    for part, place in zip(model.parts, model.places, strict=True):
        droppable[place] = part.terms
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
        theta, covariance = theta - column * theta[k], covariance - np.outer(column, covariance[k])
    if not dropped.any():
        return None
    left = model.without(dropped)
    if any(part.n == 0 for part, former in zip(left.parts, model.parts, strict=True) if former.n):
        return None
    return replace(candidate, model=left, whole=candidate.whole or model.n)
