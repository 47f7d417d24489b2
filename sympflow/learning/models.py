"""Models of an unknown H: a sum of parts, each a function of q, of p or of both, with some numbers θ to be learned.

States are columns here: y (2d, N), as a batch of N states with its coordinates first.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import sympy


class Linear(NamedTuple):
    """A function f(θ, x) of columns x (m, N) with its derivatives; None for those that were not asked for.

    Attributes
    ----------
    value : ndarray of shape (m, N)
    slope : ndarray of shape (m, m, N) or None
        ∂f/∂x.
    by_parameters : ndarray of shape (m, n, N) or None
        ∂f/∂θ.
    """

    value: np.ndarray
    slope: np.ndarray | None = None
    by_parameters: np.ndarray | None = None


class Part(ABC):
    """A function of q, p or y = [q, p], with n numbers θ.

    Attributes
    ----------
    of : {"q", "p", "y"}
    n : int
    """

    of: str
    n: int

    @property
    def quadratic(self) -> bool:
        """True if it is known to be a quadratic form."""
        return False

    @abstractmethod
    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        """The gradient at columns x (m, N), with its derivatives."""

    @abstractmethod
    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The values (N,)."""

    @abstractmethod
    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        """The function in symbols."""

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """θ before anything is known."""
        return np.zeros(self.n)


class Polynomial(Part):
    """Σ_m θ_m Π_i (x_i/s_i)^m_i.

    Parameters
    ----------
    of : {"q", "p", "y"}
    exponents : array_like of int, shape (n, m)
    scales : array_like of shape (m,)
        s, of the size of the data, which makes all θ comparable.
    """

    def __init__(self, of: str, exponents: Any, scales: Any) -> None:
        self.of, self.exponents, self.scales = of, np.asarray(exponents, dtype=int), np.asarray(scales, dtype=float)
        self.n = len(self.exponents)

    @property
    def quadratic(self) -> bool:
        return bool((self.exponents.sum(axis=1) == 2).all())

    @classmethod
    def up_to(cls, degree: int, of: str, scales: Any) -> Polynomial:
        """All monomials of degree 1 to `degree`."""
        m = len(scales)
        exponents = [e for e in product(range(degree + 1), repeat=m) if 0 < sum(e) <= degree]
        return cls(of, sorted(exponents, key=lambda e: (sum(e), e[::-1])), scales)

    @cached_property
    def _derivatives(self) -> dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]]:
        """For each list of coordinates, of one or two: the factors and exponents of the derivatives by them."""
        made: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}
        m = self.exponents.shape[1]
        for places in [(i,) for i in range(m)] + [(i, j) for i in range(m) for j in range(i, m)]:
            factor, left = np.ones(self.n), self.exponents.copy()
            for i in places:
                factor, left[:, i] = factor * left[:, i] / self.scales[i], np.maximum(left[:, i] - 1, 0)
            made[places] = factor, left
        return made

    def _powers(self, x: np.ndarray) -> list[np.ndarray]:
        """The powers of each coordinate, (degree + 1, N)."""
        powers = []
        for z, most in zip(x / self.scales[:, None], self.exponents.max(axis=0, initial=0), strict=True):
            table = np.ones((most + 1, len(z)))
            for k in range(1, most + 1):
                np.multiply(table[k - 1], z, out=table[k])
            powers.append(table)
        return powers

    @staticmethod
    def _monomials(powers: list[np.ndarray], exponents: np.ndarray) -> np.ndarray:
        made = powers[0][exponents[:, 0]]
        for table, e in zip(powers[1:], exponents.T[1:], strict=True):
            made *= table[e]
        return made

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        m, N = x.shape
        powers, derivatives = self._powers(x), self._derivatives
        value = np.empty((m, N))
        columns = np.empty((m, self.n, N)) if by_parameters else None
        for i in range(m):
            factor, left = derivatives[i,]
            made = self._monomials(powers, left)
            value[i] = (theta * factor) @ made
            if columns is not None:
                np.multiply(made, factor[:, None], out=columns[i])
        slopes = np.empty((m, m, N)) if slope else None
        if slopes is not None:
            for i in range(m):
                for j in range(i, m):
                    factor, left = derivatives[i, j]
                    used = factor != 0
                    slopes[i, j] = slopes[j, i] = (theta * factor)[used] @ self._monomials(powers, left[used])
        return Linear(value, slopes, columns)

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        return theta @ self._monomials(self._powers(x), self.exponents)

    def subset(self, kept: np.ndarray) -> Polynomial:
        """The polynomial of some of the monomials (n,)."""
        return Polynomial(self.of, self.exponents[kept], self.scales)

    def coefficients(self, theta: np.ndarray) -> np.ndarray:
        """The coefficients of the monomials in x itself."""
        return theta / np.prod(self.scales**self.exponents, axis=1)

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        import sympy

        terms = zip(self.coefficients(theta), self.exponents.tolist(), strict=True)
        return sympy.Add(
            *(sympy.Float(c, 17) * sympy.Mul(*(v**e for v, e in zip(x, m, strict=True))) for c, m in terms if c)
        )


class Kinetic(Polynomial):
    """½ pᵀM⁻¹p, M⁻¹ symmetric, θ its entries on and above the diagonal; or on the diagonal alone."""

    def __init__(self, scales: Any, mixed: bool = True) -> None:
        d = len(scales)
        pairs = [(i, j) for i in range(d) for j in range(i, d if mixed else i + 1)]
        exponents = np.zeros((len(pairs), d), dtype=int)
        for row, pair in zip(exponents, pairs, strict=True):
            for i in pair:
                row[i] += 1
        super().__init__("p", exponents, scales)


class FixedKinetic(Part):
    """½ pᵀM⁻¹p of a mass matrix that is given."""

    def __init__(self, inverse_mass: np.ndarray) -> None:
        self.of, self.n, self.inverse_mass = "p", 0, inverse_mass

    @property
    def quadratic(self) -> bool:
        return True

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        W = self.inverse_mass
        slopes = np.broadcast_to(W[:, :, None], (*W.shape, x.shape[1])) if slope else None
        return Linear(W @ x, slopes, np.empty((len(x), 0, x.shape[1])) if by_parameters else None)

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        return 0.5 * np.einsum("in,ij,jn->n", x, self.inverse_mass, x)

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        import sympy

        v = sympy.Matrix(list(x))
        return sympy.expand((v.T * sympy.Matrix(self.inverse_mass.tolist()) * v)[0] / 2)


@dataclass(frozen=True)
class Model:
    """H_θ(q, p), the sum of its parts, each with its own place in θ; y' = J∇H, with friction p' = −∂H/∂q − Γp.

    Parameters
    ----------
    ndof : int
    parts : tuple of Part
    rates : int
        How many rates of friction there are at the end of θ: none, one, or one for each p.
    """

    ndof: int
    parts: tuple[Part, ...]
    rates: int = 0

    @property
    def n(self) -> int:
        """The length of θ."""
        return sum(part.n for part in self.parts) + self.rates

    @property
    def separable(self) -> bool:
        """True if H = T(p) + V(q), without friction."""
        return not self.rates and all(part.of != "y" for part in self.parts)

    @property
    def nystrom(self) -> bool:
        """True if T is quadratic."""
        return self.separable and all(part.quadratic for part in self.parts if part.of == "p")

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
        value = np.zeros((m, N))
        slopes = np.zeros((m, m, N)) if slope else None
        columns = np.zeros((m, self.n, N)) if by_parameters else None
        for part, place in zip(self.parts, self.places, strict=True):
            if of in (part.of, "y"):
                rows = self._columns(part.of) if of == "y" else slice(None)
                found = part.gradient(theta[place], x[rows], slope, by_parameters)
                value[rows] += found.value
                if slopes is not None and found.slope is not None:
                    slopes[rows, rows] += found.slope
                if columns is not None and found.by_parameters is not None:
                    columns[rows, place] += found.by_parameters
        return Linear(value, slopes, columns)

    def field(self, theta: np.ndarray, y: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        """The vector field."""
        d = self.ndof
        value, slopes, columns = (
            None if a is None else np.concatenate([a[d:], -a[:d]])
            for a in self.gradient(theta, y, "y", slope, by_parameters)
        )
        assert value is not None
        if self.rates:
            rates = theta[-self.rates :]
            value[d:] -= np.broadcast_to(rates, d)[:, None] * y[d:]
            for i in range(d):
                place = i if self.rates > 1 else 0
                if slopes is not None:
                    slopes[d + i, d + i] -= rates[place]
                if columns is not None:
                    columns[d + i, self.n - self.rates + place] -= y[d + i]
        return Linear(value, slopes, columns)

    def hamiltonian(self, theta: np.ndarray, y: np.ndarray) -> np.ndarray:
        """H (N,)."""
        shares = zip(self.parts, self.places, strict=True)
        return np.sum([part.value(theta[own], y[self._columns(part.of)]) for part, own in shares], axis=0)

    def expression(self, theta: np.ndarray) -> sympy.Expr:
        """H in q1 … qd, p1 … pd, or q and p."""
        import sympy

        names = [f"{c}{i + 1}" if self.ndof > 1 else c for c in "qp" for i in range(self.ndof)]
        y = sympy.symbols(names, real=True)
        shares = zip(self.parts, self.places, strict=True)
        return sympy.Add(*(part.expression(theta[own], y[self._columns(part.of)]) for part, own in shares))

    def without(self, dropped: np.ndarray) -> Model:
        """The model without some of the numbers (n,), which are those of polynomials."""
        kept = [
            part.subset(~dropped[place]) if isinstance(part, Polynomial) else part
            for part, place in zip(self.parts, self.places, strict=True)
        ]
        return replace(self, parts=tuple(kept))

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """θ before anything is known; friction 0."""
        return np.concatenate([part.start(rng) for part in self.parts] + [np.zeros(self.rates)])
