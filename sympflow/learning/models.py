"""Models of an unknown H: a sum of parts, each a function of q, of p or of both, with some numbers θ to be learned.

States are columns here: y (2d, N), as a batch of N states with its coordinates first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from typing import Any, ClassVar

import numpy as np
import sympy

from sympflow.learning.parts import Drive, Linear, Part, Polynomial

NEWTON = 8  # steps by which momenta are found of velocities


class VectorField:
    """A vector field of states [q, p], which are observed as they are; by default linear in nothing."""

    velocities: bool = False  # True if [q, q'] are observed

    def at(self, t: np.ndarray) -> Any:
        """The field at times t (N,), one for each state."""
        return self

    def observed(self, theta: np.ndarray, x: np.ndarray, X: np.ndarray | None) -> tuple[np.ndarray, Any]:
        """Observations (2d, N) of states x, and their derivatives (2d, c, N) by what X are derivatives by."""
        return x, X

    def states(self, theta: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The states (2d, N) of observations."""
        return y

    def frequencies(self, theta: np.ndarray) -> list[float]:
        """The angular frequencies of the drives."""
        return []


Force = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Fields (2d, k, N) of states (2d, N) that no H(q, p) gives, and their slopes (2d, k, 2d, N)."""


def frictions(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """−p_i of each p."""
    return _of_each(y, -y, -np.ones_like(y))


def friction(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """−p of all."""
    fields, slopes = frictions(y)
    return fields.sum(axis=1, keepdims=True), slopes.sum(axis=1, keepdims=True)


def drags(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic drag −|p_i|p_i of each p."""
    return _of_each(y, -np.abs(y) * y, -2 * np.abs(y))


def _of_each(y: np.ndarray, forces: np.ndarray, bent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A force on each p_i that depends on it alone."""
    m, N = y.shape
    d = m // 2
    fields, slopes = np.zeros((m, d, N)), np.zeros((m, d, m, N))
    for i in range(d, m):
        fields[i, i - d], slopes[i, i - d, i] = forces[i], bent[i]
    return fields, slopes


def turns(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Uniform magnetic fields that turn p_i to p_j, i < j."""
    m, N = y.shape
    pairs = [*combinations(range(m // 2, m), 2)]
    fields, slopes = np.zeros((m, len(pairs), N)), np.zeros((m, len(pairs), m, N))
    for k, (i, j) in enumerate(pairs):
        fields[i, k], fields[j, k] = y[j], -y[i]
        slopes[i, k, j], slopes[j, k, i] = 1.0, -1.0
    return fields, slopes


@dataclass(frozen=True)
class Model(VectorField):
    """H_θ(q, p), the sum of its parts, each with its own place in θ; y' = J∇H + Σ_k c_k F_k, c the last of θ."""

    ndof: int
    parts: tuple[Part, ...]
    force: Force | None = None
    velocities: bool = False  # True if q' = ∂H/∂p is observed in place of p
    stepper: ClassVar[Any] = None  # the steps of a map of its own; None where schemes follow a field

    @property
    def n(self) -> int:
        """The length of θ."""
        return sum(part.n for part in self.parts) + self.forces

    @cached_property
    def forces(self) -> int:
        """The number of forces that no H gives."""
        return 0 if self.force is None else self.force(np.zeros((2 * self.ndof, 1)))[0].shape[1]

    @cached_property
    def drives(self) -> tuple[Drive, ...]:
        """The parts that depend on time."""
        return tuple(part for part in self.parts if isinstance(part, Drive))

    def at(self, t: np.ndarray) -> Model:
        return replace(self, parts=tuple(part.at(t) for part in self.parts)) if self.drives else self

    def frequencies(self, theta: np.ndarray) -> list[float]:
        shares = zip(self.parts, self.places, strict=True)
        return [part.frequency + float(theta[own][-1]) for part, own in shares if isinstance(part, Drive)]

    @property
    def separable(self) -> bool:
        """True if H = T(p) + V(q), without forces."""
        return not self.forces and all(part.of != "y" for part in self.parts)

    @property
    def nystrom(self) -> bool:
        """True if T is quadratic."""
        return self.separable and all(part.quadratic for part in self.parts if part.of == "p")

    @property
    def prior(self) -> np.ndarray:
        """One over the size (n,) that each number is expected to have, 0 for any."""
        return np.concatenate([part.prior for part in self.parts] + [np.zeros(self.forces)])

    def _columns(self, of: str) -> slice:
        return {"q": slice(0, self.ndof), "p": slice(self.ndof, None), "y": slice(None)}[of]

    @cached_property
    def places(self) -> tuple[slice, ...]:
        """The places of the numbers of each part in θ."""
        ends = np.cumsum([0, *(part.n for part in self.parts)]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    def gradient(self, theta: np.ndarray, x: np.ndarray, of: str, slope: bool, by_parameters: bool) -> Linear:
        """∇ of the sum of the parts of q alone, or of p alone, or of all of H."""
        m, N = x.shape
        chosen = [(part, place) for part, place in zip(self.parts, self.places, strict=True) if of in (part.of, "y")]
        columns: Any = np.zeros((m, self.n, N)) if by_parameters else None
        if len(chosen) == 1 and chosen[0][0].of == of:
            part, place = chosen[0]
            found = part.gradient(theta[place], x, slope, by_parameters)
            if by_parameters:
                columns[:, place] = found.by_parameters
            return Linear(found.value, found.slope, columns)
        value = np.zeros((m, N))
        slopes: Any = np.zeros((m, m, N)) if slope else None
        for part, place in chosen:
            rows = self._columns(part.of) if of == "y" else slice(None)
            found = part.gradient(theta[place], x[rows], slope, by_parameters)
            value[rows] += found.value
            if slope:
                slopes[rows, rows] += found.slope
            if by_parameters:
                columns[rows, place] += found.by_parameters
        return Linear(value, slopes, columns)

    def field(self, theta: np.ndarray, y: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        """The vector field."""
        d = self.ndof
        found: Any = self.gradient(theta, y, "y", slope, by_parameters)
        value, slopes, columns = (None if a is None else np.concatenate([a[d:], -a[:d]]) for a in found)
        if self.force is not None:
            (fields, bent), factors = self.force(y), theta[-self.forces :]
            value = value + np.einsum("mkn,k->mn", fields, factors)
            slopes = None if slopes is None else slopes + np.einsum("mkjn,k->mjn", bent, factors)
            if columns is not None:
                columns[:, -self.forces :] = fields
        return Linear(value, slopes, columns)  # type: ignore[arg-type]

    def observed(self, theta: np.ndarray, x: np.ndarray, X: np.ndarray | None) -> tuple[np.ndarray, Any]:
        if not self.velocities:
            return x, X
        d = self.ndof
        f = self.field(theta, x, X is not None, X is not None and X.shape[1] > 2 * d)
        seen = np.concatenate([x[:d], f.value[:d]])
        if X is None:
            return seen, None
        moved = np.einsum("ijn,jcn->icn", f.slope[:d], X)
        if f.by_parameters is not None:
            moved[:, 2 * d :] += f.by_parameters[:d]
        return seen, np.concatenate([X[:d], moved])

    def states(self, theta: np.ndarray, y: np.ndarray) -> np.ndarray:
        if not self.velocities:
            return y
        d, x = self.ndof, y.copy()
        for _ in range(1 if all(part.quadratic or part.of == "q" or part.inertial for part in self.parts) else NEWTON):
            f = self.field(theta, x, True, False)
            by_p = np.moveaxis(np.broadcast_to(f.slope[:d, d:], (d, d, x.shape[1])), -1, 0)
            x[d:] += np.linalg.solve(by_p, (y[d:] - f.value[:d]).T[..., None])[..., 0].T
        return x

    @property
    def linear(self) -> bool:
        """True if the vector field is linear in θ."""
        return all(part.linear for part in self.parts)

    @property
    def lagrangian(self) -> bool:
        """True if Lagrange's equations of motion are linear in θ though the vector field is not."""
        return any(p.inertial for p in self.parts) and all(p.inertial or (p.of == "q" and p.linear) for p in self.parts)

    def momenta(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """p and p' by Lagrange's equations for θ = 0, and their derivatives by θ, without those of forces."""
        values, columns = zip(*(part.momenta(q, v) for part in self.parts), strict=True)
        return np.sum(values, axis=0), np.concatenate(columns, axis=1)

    def hamiltonian(self, theta: np.ndarray, y: np.ndarray) -> np.ndarray:
        """H (N,)."""
        shares = zip(self.parts, self.places, strict=True)
        return np.sum([part.value(theta[own], y[self._columns(part.of)]) for part, own in shares], axis=0)

    def expression(self, theta: np.ndarray) -> sympy.Expr:
        """H in q1 … qd, p1 … pd, or q and p."""
        names = [f"{c}{i + 1}" if self.ndof > 1 else c for c in "qp" for i in range(self.ndof)]
        y = sympy.symbols(names, real=True)
        shares = zip(self.parts, self.places, strict=True)
        return sympy.Add(*(part.expression(theta[own], y[self._columns(part.of)]) for part, own in shares))

    def without(self, dropped: np.ndarray) -> Model:
        """The model without some of the numbers (n,), which are those of polynomials."""
        kept = [part.subset(~dropped[place]) for part, place in zip(self.parts, self.places, strict=True)]
        return replace(self, parts=tuple(kept))

    def flow(self, theta: np.ndarray) -> Any:
        """The flow that was fitted itself; None where one is trained to the H that was learned."""
        return None

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """θ before anything is known; forces 0."""
        return np.concatenate([part.start(rng) for part in self.parts] + [np.zeros(self.forces)])


class FreeField(VectorField):
    """A vector field of polynomials that need not be Hamiltonian, to be compared with those that are."""

    separable = nystrom = lagrangian = False
    linear, forces, drives = True, 0, ()
    stepper = None

    def __init__(self, scales: Any, degree: int) -> None:
        m = len(scales)
        self.ndof, self.degree = m // 2, degree
        self.polynomial = Polynomial("y", [(0,) * m, *Polynomial.up_to(degree, "y", scales).exponents.tolist()], scales)
        self.n = m * self.polynomial.n
        self.prior = np.zeros(self.n)

    def start(self, rng: np.random.Generator) -> np.ndarray:
        return np.zeros(self.n)

    def field(self, theta: np.ndarray, y: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        """The vector field."""
        m, N = y.shape
        rows, K = theta.reshape(m, -1), self.polynomial.n
        terms = self.polynomial.functions(y)
        columns = np.zeros((m, self.n, N)) if by_parameters else None
        if columns is not None:
            for i in range(m):
                columns[i, i * K : (i + 1) * K] = terms
        slopes = np.stack([rows @ by for by in self.polynomial.derivatives(y)[0]], axis=1) if slope else None
        return Linear(rows @ terms, slopes, columns)
