"""Polynomials in q, Σ_m c_m q^m: the monomials that suit a potential, values and gradients, for NumPy and torch."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, like, stack

if TYPE_CHECKING:
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian


MOST_MONOMIALS = 60
MOST_MIRRORED = 6  # coordinates of which all combinations of signs are tried
Monomials = tuple[tuple[int, ...], ...]  # exponents of q1 … qd, one tuple a monomial


def monomials(symbols: SymbolicHamiltonian, degree: int) -> Monomials:
    """Return the monomials up to a total degree that a kick of a trained flow can use, for H = ½ pᵀM⁻¹p + V(q)."""
    d = symbols.ndof
    if math.comb(d + degree, d) > 1000 * MOST_MONOMIALS:
        raise ValueError(_too_many(degree, d))
    kept = _generated(symbols, degree) if symbols.V.is_polynomial(*symbols.q) else _as_even(symbols, degree)
    if not kept:
        raise ValueError(f"`polynomial` {degree!r} leaves no monomial that suits V: take a higher degree.")
    if len(kept) > MOST_MONOMIALS:
        raise ValueError(_too_many(degree, d))
    return tuple(sorted(kept, key=lambda m: (sum(m), m)))


def _generated(symbols: SymbolicHamiltonian, degree: int) -> set[tuple[int, ...]]:
    """The monomials of V, and of products ∇fᵀM⁻¹∇g, until there are no more up to the degree, or too many."""
    import sympy as sp

    M = symbols.inverse_mass
    d = symbols.ndof
    pairs = [(i, j) for i in range(d) for j in range(d) if M[i, j] != 0]
    of_v = {m for m in sp.Poly(symbols.V, *symbols.q).monoms() if any(m)}
    found, new = set(of_v), set(of_v)
    while new and len({m for m in found if sum(m) <= degree}) <= MOST_MONOMIALS:
        products = set()
        for f, g in itertools.product(new, found):
            products |= {_product(f, g, i, j) for i, j in pairs if f[i] and g[j]}
        new = {m for m in products if 1 <= sum(m) <= degree} - found
        found |= new
    return {m for m in found if sum(m) <= degree}


def _product(f: Sequence[int], g: Sequence[int], i: int, j: int) -> tuple[int, ...]:
    """The exponents of ∂ᵢf ∂ⱼg."""
    return tuple(a + b - (k == i) - (k == j) for k, (a, b) in enumerate(zip(f, g, strict=True)))


def _as_even(symbols: SymbolicHamiltonian, degree: int) -> list[tuple[int, ...]]:
    """The monomials that are as even as V."""
    import sympy as sp

    found = [m for m in itertools.product(range(degree + 1), repeat=symbols.ndof) if 1 <= sum(m) <= degree]
    for signs in _signs(symbols.ndof):
        mirrored = symbols.V.xreplace({s: sign * s for s, sign in zip(symbols.q, signs, strict=True)})
        if sp.expand(mirrored - symbols.V) == 0:
            found = [m for m in found if math.prod(sign**e for sign, e in zip(signs, m, strict=True)) == 1]
    return found


def _too_many(degree: int, d: int) -> str:
    return (
        f"`polynomial` {degree!r} makes more than {MOST_MONOMIALS} monomials in {d} coordinates: take a lower degree."
    )


def _signs(d: int) -> Iterator[tuple[int, ...]]:
    """Changes of sign of coordinates: all, or for many coordinates those of one of them and of all."""
    if d <= MOST_MIRRORED:
        yield from itertools.product((1, -1), repeat=d)
        return
    for i in range(d):
        yield tuple(-1 if j == i else 1 for j in range(d))
    yield (-1,) * d


def in_monomials(f: Any, symbols: SymbolicHamiltonian, of: Monomials) -> np.ndarray | None:
    """The coefficients (M,) of such a polynomial in q, up to a constant; None for other expressions."""
    import sympy as sp

    if not f.is_polynomial(*symbols.q):
        return None
    found = sp.Poly(f, *symbols.q).as_dict()
    found.pop((0,) * symbols.ndof, None)
    if not set(found) <= set(of):
        return None
    return np.array([float(found.get(m, 0)) for m in of])


def value(of: Monomials, coefficients: Array, q: Array) -> Array:
    """Σ_m c_m q^m for coefficients (…, M) and positions (…, d): (…)."""
    exponents = np.array(of)
    powers = _powers(q, int(exponents.max()))
    terms = powers[0][..., exponents[:, 0]]
    for j in range(1, exponents.shape[1]):
        terms = terms * powers[j][..., exponents[:, j]]
    return (like(coefficients, q) * terms).sum(-1)


def gradient(of: Monomials, coefficients: Array, q: Array) -> Array:
    """The gradient of `value`: (…, d)."""
    exponents = np.array(of)
    powers = _powers(q, int(exponents.max()))
    coefficients, columns = like(coefficients, q), []
    for i in range(exponents.shape[1]):
        there = np.flatnonzero(exponents[:, i])
        lowered = exponents[there]
        factors = like(lowered[:, i], q)
        lowered[:, i] -= 1
        terms = powers[0][..., lowered[:, 0]]
        for j in range(1, exponents.shape[1]):
            terms = terms * powers[j][..., lowered[:, j]]
        columns.append((coefficients[..., there] * (factors * terms)).sum(-1))
    return stack(columns)


def _powers(q: Array, highest: int) -> list[Array]:
    """1, q_j, q_j², … for each j: (…, highest + 1)."""
    powers = []
    for j in range(q.shape[-1]):
        of_one = [q[..., j] * 0 + 1]
        for _ in range(highest):
            of_one.append(of_one[-1] * q[..., j])
        powers.append(stack(of_one))
    return powers
