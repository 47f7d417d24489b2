"""Where the potential of a lattice is infinite, over which a step may leap without a trace."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import sympy as sp

__all__ = ["Poles"]


class _Lattice(Protocol):
    """The attributes of a `LatticeHamiltonian` that poles need."""

    shape: tuple[int, ...]
    boundary: tuple[str, ...]
    U: sp.Expr
    x: tuple[sp.Symbol, ...]
    r: tuple[sp.Symbol, ...]
    bonds: dict[int, sp.Expr]

    def of_terms(self, key: str, expressions: Any, q: Any) -> list[tuple[int | None, int, list[Any]]]: ...


class Poles:
    """The places at which a term of a lattice divides by 0, or takes the logarithm of 0.

    No solution passes them. So what a term divides by has the same sign all along, at each site and bond, and what it
    takes a logarithm of is positive.

    Parameters
    ----------
    lattice : LatticeHamiltonian

    Attributes
    ----------
    there_are : bool
    """

    def __init__(self, lattice: _Lattice) -> None:
        self._lattice = lattice
        terms = [(lattice.U, lattice.x), *((V, lattice.r) for V in lattice.bonds.values())]
        self.there_are = any(_vanishing(f, x) for f, x in terms)

    def passed(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return True for positions (n, d) on the other side of a pole than those of the start (n, d): (n,)."""
        found = np.zeros(len(ends), dtype=bool)
        for _, _, beyond in self._beyond(starts, ends):
            found |= beyond.reshape(len(ends), -1).any(-1)
        return found

    def where(self, start: np.ndarray, q: np.ndarray) -> str:
        """The first site or bond of positions (d,) that is on the other side, and how many more, in words."""
        found = [(axis, k, beyond) for axis, k, beyond in self._beyond(start, q) if beyond.any()]
        if not found:
            return ""
        axis, k, beyond = found[0]
        more = sum(int(each.sum()) for _, _, each in found) - 1
        return self._place(axis, k, int(np.argmax(beyond)), beyond.shape) + (f" and {more} more" if more else "")

    def nearest(self, q: np.ndarray) -> str:
        """The site or bond of positions (d,) that is nearest to a pole, in words."""
        places = []
        for axis, k, values in self._lattice.of_terms("poles", _vanishing, q):
            for value in values:
                i = int(np.argmin(np.abs(value)))
                places.append((abs(float(value.flat[i])), self._place(axis, k, i, value.shape)))
        return min(places)[1]

    def _beyond(self, starts: np.ndarray, ends: np.ndarray) -> list[tuple[int | None, int, np.ndarray]]:
        lattice, found = self._lattice, []
        with np.errstate(all="ignore"):
            before, after = (lattice.of_terms("poles", _vanishing, q) for q in (starts, ends))
            for (axis, k, olds), (_, _, news), of in zip(before, after, self._signed(), strict=True):
                for old, new, positive in zip(olds, news, of, strict=True):
                    found.append((axis, k, ~(new > 0) if positive else np.sign(new) != np.sign(old)))
        return found

    def _signed(self) -> list[list[bool]]:
        """True for each expression that has to be positive, in the order of `LatticeHamiltonian.of_terms`."""

        def signed(f: sp.Expr, x: tuple[sp.Symbol, ...]) -> list[bool]:
            arguments = {log.args[0] for log in f.atoms(sp.log)}
            return [g in arguments for g in _vanishing(f, x)]

        lattice = self._lattice
        onsite = [signed(lattice.U, lattice.x)] if lattice.U != 0 else []
        return onsite + [signed(V, lattice.r) for _ in lattice.shape for V in lattice.bonds.values()]

    def _place(self, axis: int | None, k: int, i: int, shape: tuple[int, ...]) -> str:
        first = [int(n) for n in np.unravel_index(i, shape)]
        if axis is None:
            return f"the site {_name(first)}"
        n, boundary = self._lattice.shape[axis], self._lattice.boundary[axis]
        if boundary == "fixed":
            first[axis] -= k  # bonds to the wall before the first sites come first
        last = [*first]
        last[axis] += k
        if boundary == "periodic":
            last[axis] %= n
        ends = [_name(end) if 0 <= end[axis] < n else "the wall" for end in (first, last)]
        return f"the bond of {ends[0]} and {ends[1]}"


def _name(site: Sequence[int]) -> str:
    return str(site[0]) if len(site) == 1 else f"({', '.join(map(str, site))})"


@lru_cache(maxsize=64)
def _vanishing(f: sp.Expr, x: tuple[sp.Symbol, ...]) -> list[sp.Expr]:
    """Denominators and arguments of logarithms in f that depend on x and may be 0 for all that SymPy knows.

    An exponent by a parameter counts as negative where it is written so.
    """
    found = {power.base for power in f.atoms(sp.Pow) if power.exp.could_extract_minus_sign()}
    found |= {sp.cos(g.args[0]) for g in f.atoms(sp.tan, sp.sec)} | {sp.sin(g.args[0]) for g in f.atoms(sp.cot, sp.csc)}
    found = {g.args[0] if isinstance(g, sp.Abs) else g for g in found}
    logarithms = {log.args[0] for log in f.atoms(sp.log)}
    may_vanish = (g for g in found | logarithms if g.free_symbols & set(x) and g.is_positive is not True)
    return sorted((g for g in may_vanish if g in logarithms or not _removable(f, g)), key=str)


def _removable(f: sp.Expr, g: sp.Expr) -> bool:
    """Return True if f is finite where g vanishes, a polynomial in one letter of degree 1 or 2, as sin(r)/r at 0."""
    if len(f.free_symbols) != 1 or not g.is_polynomial(*g.free_symbols) or sp.degree(g) > 2:
        return False
    (x,) = f.free_symbols
    values = [sp.limit(f, x, root) for root in sp.real_roots(sp.Poly(g, x))]
    return all(value.is_finite for value in values)
