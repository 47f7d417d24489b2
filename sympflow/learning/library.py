"""Terms of a Hamiltonian, H = Σ θ_k f_k(q, p), with their gradients and Hessians as array functions."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import sympy as sp

from sympflow.hamiltonian.symbolic import generate, parse
from sympflow.learning.models import Model
from sympflow.learning.parts import Curvature, Linear, Sum

NEAR = 0.05
"""Least distance from a singular point, over the size of the coordinates, of data for which 1/r is in the library."""
COLLINEAR = 1e-7
"""Sine of the angle between a term's gradient and those before it, over the data, below which it says nothing new."""
MOST_PRODUCTS = 2
"""Degrees of freedom up to which all products of powers are in the library; beyond, those of one and of pairs."""

KINDS = "qpy"  # kinds of terms: of q alone, of p alone, of both

Coordinates = tuple[sp.Symbol, ...]


@lru_cache
def coordinates(ndof: int) -> tuple[Coordinates, Coordinates]:
    """The symbols q1 … qd and p1 … pd."""
    return sp.symbols(f"q1:{ndof + 1}", real=True), sp.symbols(f"p1:{ndof + 1}", real=True)


def coordinates_of(part: str, ndof: int) -> Coordinates:
    """The coordinates of a part of H: of "q", "p" or "y", which is both."""
    q, p = coordinates(ndof)
    return {"q": q, "p": p, "y": (*q, *p)}[part]


def polynomials(ndof: int, degree: int = 4) -> list[sp.Expr]:
    """All products of powers up to a degree; of three or more degrees of freedom those of one, and pairs.

    Pairs (i, j) have p_i p_j, q_i p_j and powers of q_i − q_j, by which q_i q_j can be written.
    """
    q, p = coordinates(ndof)
    sets = [(*q, *p)] if ndof <= MOST_PRODUCTS else list(zip(q, p, strict=True))
    terms = [
        sp.Mul(*product)
        for symbols in sets
        for n in range(1, degree + 1)
        for product in itertools.combinations_with_replacement(symbols, n)
    ]
    if ndof > MOST_PRODUCTS:
        for (a, b), (u, v) in zip(itertools.combinations(q, 2), itertools.combinations(p, 2), strict=True):
            terms += [u * v, a * v, b * u, *((a - b) ** n for n in range(2, degree + 1))]
    return terms


def trigonometric(ndof: int) -> list[sp.Expr]:
    """cos and sin of each q, of 2q where there is one, of differences of two."""
    q, _ = coordinates(ndof)
    angles = [*q, *((2 * q[0],) if ndof == 1 else ()), *(a - b for a, b in itertools.combinations(q, 2))]
    return [f(angle) for angle in angles for f in (sp.cos, sp.sin)]


def distances(ndof: int) -> list[sp.Expr]:
    """Powers and the logarithm of r = |q| in two or three dimensions; of q itself in one."""
    q, _ = coordinates(ndof)
    if ndof > 3:
        return []
    r = q[0] if ndof == 1 else sp.sqrt(sum(x**2 for x in q))
    return [1 / r, 1 / r**2, 1 / r**3, sp.log(r), *(() if ndof == 1 else (r,))]


LIBRARIES = {"polynomials": polynomials, "trigonometric": trigonometric, "distances": distances}


class Library:
    """Terms f_k of a Hamiltonian, expressions in the symbols q1 … qd, p1 … pd."""

    def __init__(self, expressions: Sequence[sp.Expr], ndof: int) -> None:
        self.ndof, self.expressions = ndof, tuple(expressions)

    def __len__(self) -> int:
        return len(self.expressions)

    def subset(self, index: Sequence[int]) -> Library:
        """The library of some of the terms."""
        return Library([self.expressions[k] for k in index], self.ndof)

    @cached_property
    def kinds(self) -> list[str]:
        """The coordinates that each term depends on: "q", "p" or "y" for both."""
        q, p = map(set, coordinates(self.ndof))
        used = [f.free_symbols for f in self.expressions]
        return ["q" if symbols <= q else "p" if symbols <= p else "y" for symbols in used]

    def by_kind(self) -> Library:
        """The same terms, those of q alone first, then those of p alone: in the order of a `model`."""
        return self.subset(sorted(range(len(self)), key=lambda k: KINDS.index(self.kinds[k])))

    def model(self) -> Model:
        """The sum of these terms as an H to be fitted, of terms `by_kind`."""
        chosen = {of: [k for k, kind in enumerate(self.kinds) if kind == of] for of in KINDS}
        return Model(self.ndof, tuple(Terms(self.subset(index), of) for of, index in chosen.items() if index))

    def values(self, x: np.ndarray) -> np.ndarray:
        """f_k at x (n, 2d): (n, K)."""
        return Terms(self, "y").functions(x.T).T

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """∇f_k at x (n, 2d): (n, 2d, K)."""
        return Terms(self, "y").derivatives(x.T)[0].transpose(2, 0, 1)

    def fields(self, x: np.ndarray) -> np.ndarray:
        """J∇f_k at x (n, 2d): (n, 2d, K)."""
        g, d = self.gradients(x), self.ndof
        return np.concatenate([g[:, d:], -g[:, :d]], axis=1)

    def hamiltonian(self, theta: np.ndarray) -> sp.Expr:
        """Σ θ_k f_k."""
        return sp.Add(*[sp.Float(float(c)) * f for c, f in zip(theta, self.expressions, strict=True)])


class Terms(Sum):
    """Σ_k θ_k f_k, the terms of a library, which are all of q alone, of p alone, or of both."""

    def __init__(self, library: Library, of: str) -> None:
        self.of, self.library, self.n = of, library, len(library)

    @cached_property
    def quadratic(self) -> bool:  # type: ignore[override]
        terms = self.library.expressions
        return all(f.is_polynomial() and sp.Poly(f, *f.free_symbols).homogeneous_order() == 2 for f in terms)

    @property
    def width(self) -> int:
        return self.library.ndof * (2 if self.of == "y" else 1)

    def subset(self, kept: np.ndarray) -> Terms:
        return Terms(self.library.subset(np.flatnonzero(kept).tolist()), self.of)

    def _filled(self, x: np.ndarray, order: int) -> np.ndarray:
        """All derivatives of an order, (m, …, n, N)."""
        places, function = _derivatives(self.library.expressions, coordinates_of(self.of, self.library.ndof), order)
        made = np.zeros((*[len(x)] * order, self.n, x.shape[1]))
        for place, entry in zip(places, function(*x), strict=True):
            made[place] = entry
        return made

    def functions(self, x: np.ndarray) -> np.ndarray:
        return self._filled(x, 0)

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, Curvature]:
        pairs = itertools.combinations_with_replacement(range(len(x)), 2)

        def curvature() -> Curvature:
            made = self._filled(x, 2)
            yield from ((pair, slice(None), made[pair]) for pair in pairs)

        return self._filled(x, 1), curvature()

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        used = theta != 0
        if used.all() or self.quadratic:
            return super().gradient(theta, x, slope, by_parameters)
        value, slopes, _ = self.subset(used).gradient(theta[used], x, slope, False)
        return Linear(value, slopes, self._filled(x, 1) if by_parameters else None)

    def expression(self, theta: np.ndarray, x: Sequence[sp.Symbol]) -> sp.Expr:
        symbols = dict(zip(coordinates_of(self.of, self.library.ndof), x, strict=True))
        return self.library.hamiltonian(theta).subs(symbols, simultaneous=True)


@lru_cache(maxsize=512)
def _derivatives(terms: tuple[sp.Expr, ...], symbols: Coordinates, order: int) -> tuple[list[tuple[int, ...]], Any]:
    """The derivatives of an order that are not 0, as a function of the coordinates, and their places (i, …, k)."""
    entries = {
        (*places, k): sp.diff(f, *(symbols[i] for i in places)) if places else f
        for places in itertools.combinations_with_replacement(range(len(symbols)), order)
        for k, f in enumerate(terms)
    }
    entries = {place: entry for place, entry in entries.items() if entry != 0}
    return [*entries], generate([*entries.values()], symbols, "numpy")


def library_for(terms: Any, ndof: int, degree: int, states: np.ndarray) -> tuple[Library, tuple[sp.Expr, ...]]:
    """The given library, and those of its terms that are linear combinations of others."""
    given = LIBRARIES if terms is None else [terms] if isinstance(terms, str | sp.Expr) else terms
    if not isinstance(given, Iterable):
        raise TypeError(f"`terms` must be expressions and names of {', '.join(LIBRARIES)}; got {given!r}.")
    given = list(given)
    if not given:
        raise ValueError(f"`terms` is an empty list: name terms, or some of {', '.join(LIBRARIES)}, or leave it out.")
    r = np.linalg.norm(states[:, :ndof], axis=1) if ndof > 1 else states[:, 0]
    near, finite = r.min() < NEAR * np.abs(states[:, :ndof]).max(), distances(ndof)[4:]  # r, which has no pole
    expressions: list[sp.Expr] = []
    named: set[sp.Expr] = set()
    for term in given:
        if isinstance(term, str) and term == "polynomials":
            found = polynomials(ndof, degree)
        elif isinstance(term, str) and term in LIBRARIES:
            found = [f for f in LIBRARIES[term](ndof) if not (term == "distances" and near and f not in finite)]
        else:
            found = [_read(term, ndof)]
            named |= set(found)
        expressions += [f for f in found if f not in expressions]
    whole = Library(expressions, ndof)
    kept = _independent(whole, states, named)
    return whole.subset(kept), tuple(f for k, f in enumerate(expressions) if k not in kept)


def _read(term: Any, ndof: int) -> sp.Expr:
    q, p = coordinates(ndof)
    try:
        f = parse(term, {})
    except ValueError as error:
        raise ValueError(f"`terms` has {term!r}: {error}") from None
    if ndof == 1:
        f = f.xreplace({sp.Symbol("q", real=True): q[0], sp.Symbol("p", real=True): p[0]})
    strange = sorted(s.name for s in f.free_symbols - {*q, *p})
    if strange or not f.free_symbols:
        said = f"holds {', '.join(strange)}" if strange else "is a constant, which moves nothing"
        raise ValueError(
            f"`terms` has {term!r}, which {said}: write it in q1 … q{ndof}, p1 … p{ndof}, or as one of "
            f"{', '.join(LIBRARIES)}."
        )
    return f


def _independent(library: Library, states: np.ndarray, named: set[sp.Expr]) -> list[int]:
    """The terms whose gradients over the states no terms before them make up."""
    with np.errstate(all="ignore"):
        columns = library.gradients(states).reshape(-1, len(library))
    kept: list[int] = []
    basis = np.empty((len(columns), 0))
    for k, column in enumerate(columns.T):
        length = np.linalg.norm(column)
        if not np.isfinite(length):
            if library.expressions[k] in named:
                raise ValueError(
                    f"`terms` has {library.expressions[k]}, which is not finite at the data: leave it out."
                )
            continue
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)
        if length > 0 and np.linalg.norm(rest) > COLLINEAR * length:
            kept.append(k)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return kept
