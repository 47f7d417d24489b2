"""Terms of a Hamiltonian, H = Σ θ_k f_k(q, p), with their gradients and Hessians as array functions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from sympflow.hamiltonian.symbolic import generate, parse

NEAR = 0.05
"""Least distance from a singular point, over the size of the coordinates, of data for which 1/r is in the library."""
COLLINEAR = 1e-7
"""Sine of the angle between a term's gradient and those before it, over the data, below which it says nothing new."""
MOST_PRODUCTS = 2
"""Degrees of freedom up to which all products of powers are in the library; beyond, those of one and of pairs."""

Coordinates = tuple[sp.Symbol, ...]


def coordinates(ndof: int) -> tuple[Coordinates, Coordinates]:
    """The symbols q1 … qd and p1 … pd."""
    return sp.symbols(f"q1:{ndof + 1}", real=True), sp.symbols(f"p1:{ndof + 1}", real=True)


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


class _Term:
    """A term with its derivatives, as functions of columns."""

    def __init__(self, expression: sp.Expr, symbols: Sequence[sp.Symbol]) -> None:
        self.expression = expression
        slopes = {i: sp.diff(expression, x) for i, x in enumerate(symbols) if x in expression.free_symbols}
        self.rows = list(slopes)
        self.places = [(i, j) for i in self.rows for j in self.rows if i <= j]
        self._symbols = symbols
        self._slopes = slopes

    @cached_property
    def value(self) -> Any:
        return generate([self.expression], self._symbols, "numpy")

    @cached_property
    def gradient(self) -> Any:
        return generate(list(self._slopes.values()), self._symbols, "numpy")

    @cached_property
    def hessian(self) -> Any:
        """The entries at `places` that are not 0."""
        second = {(i, j): sp.diff(self._slopes[i], self._symbols[j]) for i, j in self.places}
        self.places = [place for place, entry in second.items() if entry != 0]
        return generate([second[place] for place in self.places], self._symbols, "numpy") if self.places else None


class Library:
    """Terms f_k of a Hamiltonian.

    Parameters
    ----------
    expressions : sequence of sympy.Expr
        In the symbols q1 … qd, p1 … pd.
    ndof : int
    """

    def __init__(self, expressions: Sequence[sp.Expr], ndof: int) -> None:
        self.ndof = ndof
        q, p = coordinates(ndof)
        self.expressions = tuple(expressions)
        self._terms = [_Term(f, (*q, *p)) for f in expressions]

    def __len__(self) -> int:
        return len(self.expressions)

    def subset(self, index: Sequence[int]) -> Library:
        """The library of some of the terms."""
        chosen = Library.__new__(Library)
        chosen.ndof, chosen._terms = self.ndof, [self._terms[k] for k in index]
        chosen.expressions = tuple(self.expressions[k] for k in index)
        return chosen

    @classmethod
    def joined(cls, *libraries: Library) -> Library:
        """The terms of several libraries, one after another."""
        whole = cls.__new__(cls)
        whole.ndof, whole._terms = libraries[0].ndof, [term for one in libraries for term in one._terms]
        whole.expressions = tuple(term.expression for term in whole._terms)
        return whole

    def values(self, x: np.ndarray) -> np.ndarray:
        """f_k at x (n, 2d): (n, K)."""
        made = np.empty((len(x), len(self)))
        for k, term in enumerate(self._terms):
            made[:, k] = term.value(*x.T)[0]
        return made

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """∇f_k at x (n, 2d): (n, 2d, K)."""
        made = np.zeros((*x.shape, len(self)))
        columns = list(x.T)
        for k, term in enumerate(self._terms):
            for i, entry in zip(term.rows, term.gradient(*columns), strict=True):
                made[:, i, k] = entry
        return made

    def fields(self, x: np.ndarray) -> np.ndarray:
        """J∇f_k at x (n, 2d): (n, 2d, K)."""
        g, d = self.gradients(x), self.ndof
        return np.concatenate([g[:, d:], -g[:, :d]], axis=1)

    def field_jacobian(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The Jacobian of J∇H at x (n, 2d): (n, 2d, 2d)."""
        made, d = np.zeros((len(x), 2 * self.ndof, 2 * self.ndof)), self.ndof
        columns = list(x.T)
        for coefficient, term in zip(theta, self._terms, strict=True):
            if term.hessian is None:
                continue
            for (i, j), entry in zip(term.places, term.hessian(*columns), strict=True):
                made[:, i, j] += coefficient * entry
                if i != j:
                    made[:, j, i] += coefficient * entry
        return np.concatenate([made[:, d:], -made[:, :d]], axis=1)

    def hamiltonian(self, theta: np.ndarray) -> sp.Expr:
        """Σ θ_k f_k."""
        return sp.Add(*[sp.Float(float(c)) * f for c, f in zip(theta, self.expressions, strict=True)])


def library_for(terms: Any, ndof: int, degree: int, states: np.ndarray) -> tuple[Library, tuple[sp.Expr, ...]]:
    """The library that was asked for, and the terms of it that others make superfluous.

    Parameters
    ----------
    terms : None or sequence of str or sympy.Expr
        Names of `LIBRARIES`, and expressions; all of `LIBRARIES` if None.
    ndof, degree : int
    states : ndarray, shape (n, 2d)
        Where the terms are compared.

    Raises
    ------
    ValueError
        If an expression is none of the coordinates, or not finite at the states.
    """
    given = LIBRARIES if terms is None else [terms] if isinstance(terms, str | sp.Expr) else list(terms)
    near = _near_the_centre(states[:, :ndof])
    expressions: list[sp.Expr] = []
    named: set[sp.Expr] = set()
    for term in given:
        if isinstance(term, str) and term == "polynomials":
            found = polynomials(ndof, degree)
        elif isinstance(term, str) and term in LIBRARIES:
            found = [] if term == "distances" and near else LIBRARIES[term](ndof)
        else:
            found = [_read(term, ndof)]
            named |= set(found)
        expressions += [f for f in found if f not in expressions]
    whole = Library(expressions, ndof)
    kept = _independent(whole, states, named)
    return whole.subset(kept), tuple(f for k, f in enumerate(expressions) if k not in kept)


def _near_the_centre(q: np.ndarray) -> bool:
    r = q[:, 0] if q.shape[1] == 1 else np.linalg.norm(q, axis=1)
    return bool(r.min() < NEAR * np.abs(q).max())


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
