"""Places where H is infinite or leaves its domain, over which a step may leap without a trace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import mpmath
import numpy as np
import sympy as sp

from sympflow.hamiltonian.removable import BOUNDED_VALUES, Min, X, bose, elliptic_e, elliptic_k, removed

FACTORED = 8  # letters of a polynomial, at most, that is split into factors
MOST_SHOWN = 100  # characters of terms
DIGITS, HALVINGS = 50, 100  # of the arithmetic in which H is judged beside such a place, and of the way to it
BESIDE = 1e-3, 1e-6, 1e-9
"""Distances from a place, in parts of a step, at which H is compared: of a finite one the differences decrease."""
AIMED = 1e-12  # share of the square of a distance below which that of the closest approach is 0
MOST_MET = 16  # pairs that changed their cells in a step, which are looked at
DECREASES = 0.7  # by less, of the second difference to the first, where H is infinite: by 1 of a logarithm


class Place(NamedTuple):
    """An expression that vanishes where a function may be infinite, and one that is another whole number beyond."""

    g: sp.Expr
    cell: sp.Expr


class Places(Protocol):
    """The places at which H of a system may be infinite, in columns, as runs look at them."""

    def __bool__(self) -> bool:
        """False if H has none."""

    @property
    def exact(self) -> Poles | None:
        """The places by which runs are judged, where these may have passed one; None if they are not known."""

    def may_pass(self, y: np.ndarray) -> bool:
        """Return False if runs between states y (2, N, 2d) passed no place; True where more is to be looked at."""
        return True

    def look(
        self, y: np.ndarray, t: Any, numbers: Sequence[Any] = ()
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Numbers (..., m) that differ on the two sides of a place, H and T at states (..., 2d) and times (...).

        T is None, and H is 0 or NaN, where runs are not judged by the size of H.
        """

    def sizes(self, y: np.ndarray, t: Any) -> np.ndarray:
        """The values (..., m) that vanish at the places by which H is judged."""
        return np.empty((*y.shape[:-1], 0))


class Poles(Places, Protocol):
    """Such places that are known exactly."""

    @property
    def exact(self) -> Poles | None:
        return self

    def ahead(self, y: np.ndarray) -> np.ndarray:
        """True (N,) for states (N, 2d) from which a free flight meets a place, or may."""
        return np.ones(len(y), dtype=bool)

    def passed(self, column: int, t: Sequence[float], y: np.ndarray) -> bool:
        """Return True if H is infinite or not a number on the way between states y (2, 2d) in two cells."""

    def name(self, column: int) -> str:
        """The place, in words that go before "passed"."""


class SymbolicPoles(Poles):
    """The places of H, as it is written."""

    def __init__(self, symbols: Any) -> None:
        self._symbols = symbols
        letters = (*symbols.q, *symbols.p, *((symbols.time,) if symbols.timed else ()))
        parts = [symbols.V, symbols.T] if symbols.separable else [symbols.H]
        self._letters, self._places = letters, [(place, f) for f in parts for place in places(f, letters)]
        self._m = len(self._places)
        if not self._places:
            return
        T = symbols.T if symbols.separable else sp.Add(*[sp.Abs(s * sp.diff(symbols.H, s)) for s in letters])
        cells = [sp.S.Zero if place.g.is_nonnegative else place.cell for place, _ in self._places]
        self._look = symbols.evaluated("cells", [*cells, symbols.H, T])
        states = {*symbols.q, *symbols.p}  # a place in t alone is crossed, or met by none of the steps
        sizes = [place.g if place.g.free_symbols & states else sp.S.One for place, _ in self._places]
        self._sizes = symbols.evaluated("sizes", sizes)

    def __bool__(self) -> bool:
        return bool(self._places)

    def look(self, y: np.ndarray, t: Any, numbers: Sequence[Any] = ()) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        values = self._look(y, *self._time(y, t), numbers=numbers)
        return values[..., : self._m], values[..., -2], values[..., -1]

    def sizes(self, y: np.ndarray, t: Any) -> np.ndarray:
        return self._sizes(y, *self._time(y, t))

    def ahead(self, y: np.ndarray) -> np.ndarray:
        if not all(place.g.is_nonnegative for place, _ in self._places):
            return super().ahead(y)
        q, v = y[:, : self._symbols.ndof], self._symbols.gradient(y)[:, self._symbols.ndof :]
        duration = np.abs(q).max(1, keepdims=True) / np.maximum(np.abs(v).max(1, keepdims=True), 1e-300)
        on_the_way = [np.concatenate([q + s * duration * v, y[:, self._symbols.ndof :]], axis=1) for s in (-1, 0, 1)]
        before, now, after = (self.sizes(x, 0.0) for x in on_the_way)
        slope, bend = (after - before) / 2, (after + before) / 2 - now  # of a square of a distance
        least = now * bend - slope**2 / 4
        return ((bend > 0) & (np.abs(least) <= AIMED * np.abs(now * bend))).any(-1)

    def passed(self, column: int, t: Sequence[float], y: np.ndarray) -> bool:
        place, f = self._places[column]
        ends = np.column_stack([y, t]) if self._symbols.timed else y
        return infinite_between(f, place.cell, self._letters, *ends.tolist())

    def name(self, column: int) -> str:
        return f"{_written(self._places[column][0].g)} = 0"

    def _time(self, y: np.ndarray, t: Any) -> tuple[Any, ...]:
        return (np.broadcast_to(t, y.shape[:-1]),) if self._symbols.timed else ()


class LatticePoles(Poles):
    """The places of the terms of a lattice, at each site and bond."""

    def __init__(self, lattice: Any) -> None:
        self._lattice = lattice
        terms = [(lattice.U, lattice.x), *((V, lattice.r) for V in lattice.bonds.values())]
        self._any = any(places(f, x) for f, x in terms)

    def __bool__(self) -> bool:
        return self._any

    def look(self, y: np.ndarray, t: Any, numbers: Sequence[Any] = ()) -> tuple[np.ndarray, np.ndarray, None]:
        cells = self._columns("cells", _cells, y)
        ending = self._columns("endings", _endings, y)
        return cells, np.where(np.isnan(ending).any(-1), np.nan, 0.0), None

    def passed(self, column: int, t: Sequence[float], y: np.ndarray) -> bool:
        f, x, place, axis, k, i, _ = self._at(column, y)
        letters = (*x, *self._lattice.c)
        rows = self._lattice.of_terms("letters", lambda f, x: [*x, *self._lattice.c], self._positions(y))
        (values,) = (found for found_axis, found_k, found in rows if (found_axis, found_k) == (axis, k))
        ends = [[float(np.reshape(value, (2, -1))[end, i]) for value in values] for end in (0, 1)]
        return infinite_between(f, place.cell, letters, *ends)

    def name(self, column: int) -> str:
        lattice = self._lattice
        _, x, place, axis, k, i, shape = self._at(column, np.zeros(2 * lattice.ndof))
        names = [*lattice.names["x" if axis is None else "r"], *lattice.params]
        written = place.g.xreplace({s: sp.Symbol(name) for s, name in zip((*x, *lattice.c), names, strict=True)})
        return f"{_written(written)} = 0 at {self._place(axis, k, i, shape)}"

    def nearest(self, q: np.ndarray) -> str:
        """The site or bond of positions (d,) that is nearest to a place, in words."""
        found = []
        for axis, k, values in self._lattice.of_terms("poles", lambda f, x: [g.g for g in places(f, x)], q):
            for value in values:
                i = int(np.argmin(np.abs(value)))
                found.append((abs(float(value.flat[i])), self._place(axis, k, i, value.shape)))
        return min(found)[1]

    def _positions(self, y: np.ndarray) -> np.ndarray:
        return y[..., : self._lattice.ndof]

    def _columns(self, key: str, expressions: Any, y: np.ndarray) -> np.ndarray:
        rows = self._lattice.of_terms(key, expressions, self._positions(y))
        columns = [value.reshape(*y.shape[:-1], -1) for _, _, values in rows for value in values]
        return np.concatenate([np.zeros((*y.shape[:-1], 0)), *columns], axis=-1)

    def _at(self, column: int, y: np.ndarray) -> tuple[Any, ...]:
        """The term, its letters, its place, the axis and the distance, which site or bond, the shape of these."""
        lattice, lead = self._lattice, y.ndim - 1
        for axis, k, values in lattice.of_terms("cells", _cells, self._positions(y)):
            f, x = (lattice.U, lattice.x) if axis is None else (lattice.bonds[k], lattice.r)
            for place, value in zip(places(f, x), values, strict=True):
                shape = value.shape[lead:]
                if column < (size := int(np.prod(shape))):
                    return f, x, place, axis, k, column, shape
                column -= size
        raise IndexError(column)

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


class PairsPoles(Poles):
    """The places of V of two bodies, at a distance that changes its sign where they pass each other on a line."""

    def __init__(self, pairs: Any) -> None:
        self._pairs, self._x = pairs, sp.Symbol("r", real=True)
        f = pairs.of_distance.xreplace({s: self._x for s in pairs.of_distance.free_symbols if s.name == "r"})
        distance, meeting = {self._x: sp.Abs(self._x)}, sp.sign(self._x)
        found = [place for place in places(f, (self._x,)) if pairs.signed or place.cell != meeting]
        self._f = f.xreplace(distance)
        self._places = [Place(place.g, meeting * place.cell.xreplace(distance)) for place in found]
        self._only_meet = pairs.dim > 1 and [place.cell for place in found] == [meeting]

    def __bool__(self) -> bool:
        return bool(self._places)

    def may_pass(self, y: np.ndarray) -> bool:
        return not self._only_meet or self._pairs.may_pass(y)

    def ahead(self, y: np.ndarray) -> np.ndarray:
        return np.array([self.may_pass(state) for state in y])

    def look(self, y: np.ndarray, t: Any, numbers: Sequence[Any] = ()) -> tuple[np.ndarray, np.ndarray, None]:
        q, end = y[..., : self._pairs.ndof], self._pairs.cutoff
        sums = np.zeros((*y.shape[:-1], len(self._places)))
        for i, j, x, letters in self._pairs.met(y):
            cells = self._cells(x, letters)
            beyond = self._cells(np.full_like(x, end), letters) if end else [0.0] * len(cells)
            number = 1 + i * self._pairs.n_bodies + j
            sums += np.stack([((a - b) * number).sum(-1) for a, b in zip(cells, beyond, strict=True)], axis=-1)
        return sums, np.where(np.isnan(self._pairs.potential(q)), np.nan, 0.0), None

    def passed(self, column: int, t: Sequence[float], y: np.ndarray) -> bool:
        names, cell = (self._x, *self._pairs.first, *self._pairs.second, *self._pairs.c), self._places[column].cell
        for _, _, x, letters in self._pairs.met(y, together=True):
            cells = self._cells(x, letters)[column]
            for k in np.flatnonzero(cells[0] != cells[1])[:MOST_MET]:
                own = [float(np.broadcast_to(v, x.shape)[0, k]) for v in letters]
                if infinite_between(self._f, cell, names, *([float(v), *own] for v in x[:, k])):
                    return True
        return False

    def name(self, column: int) -> str:
        names = dict(zip(self._pairs.c, map(sp.Symbol, self._pairs.params), strict=False))
        return f"{_written(self._places[column].g.xreplace(names))} = 0 of two bodies"

    def _cells(self, x: np.ndarray, letters: Sequence[Any]) -> list[np.ndarray]:
        return self._pairs.values_of("cells", [place.cell for place in self._places], self._x, x, letters)


def _cells(f: sp.Expr, x: tuple[sp.Symbol, ...]) -> list[sp.Expr]:
    return [place.cell for place in places(f, x)]


def _endings(f: sp.Expr, x: tuple[sp.Symbol, ...]) -> list[sp.Expr]:
    """The parts of f that are NaN beyond some place."""
    return [*f.atoms(*_ENDING), *(power for power in f.atoms(sp.Pow) if power.exp.is_integer is False)]


def _written(g: sp.Expr) -> str:
    return str(g.xreplace({a: sp.Float(a, 6) for a in g.atoms(sp.Float)}))


def _name(site: Sequence[int]) -> str:
    return str(site[0]) if len(site) == 1 else f"({', '.join(map(str, site))})"


# in an expression -----------------------------------------------------------------------------------------------------


_SINGULAR: dict[Any, Callable[..., Sequence[sp.Expr]]] = {
    sp.log: lambda a, *_: [a],
    sp.tan: lambda a: [sp.cos(a)],
    sp.sec: lambda a: [sp.cos(a)],
    sp.cot: lambda a: [sp.sin(a)],
    sp.csc: lambda a: [sp.sin(a)],
    sp.coth: lambda a: [a],
    sp.csch: lambda a: [a],
    sp.asin: lambda a: [1 - a, 1 + a],
    sp.acos: lambda a: [1 - a, 1 + a],
    sp.acosh: lambda a: [a - 1],
    sp.atanh: lambda a: [1 - a, 1 + a],
    sp.gamma: lambda a: [1 / sp.gamma(a)],
    sp.loggamma: lambda a: [1 / sp.gamma(a)],
    sp.LambertW: lambda a, *_: [a + sp.exp(-1).evalf(17)],
    elliptic_k: lambda m: [1 - m],
    elliptic_e: lambda *a: [1 - a[-1]],
    bose: lambda a: [a],
    sp.bessely: lambda n, a: [a],
    sp.besselk: lambda n, a: [a],
}
"""Expressions that vanish where a function is infinite, or ends."""
_ENDING = sp.log, sp.asin, sp.acos, sp.acosh, sp.atanh, sp.LambertW, elliptic_k, elliptic_e
_ODD = sp.sinh, sp.tanh, sp.asinh, sp.atan, sp.erf, sp.sign


@lru_cache(maxsize=64)
def places(f: sp.Expr, x: tuple[sp.Symbol, ...]) -> tuple[Place, ...]:
    """The places where f may be infinite or not a number, as far as they are found, by letters of x."""
    found = [g for function in f.atoms(*_SINGULAR) for g in _SINGULAR[function.func](*function.args)]
    for power in f.atoms(sp.Pow):
        if power.exp.could_extract_minus_sign() or (
            power.exp.is_integer is False and power.base.is_nonnegative is not True
        ):
            found.append(power.base)
    for part in f.atoms(removed):
        beside = [place.g for place in places(part.formula, (X,)) if place.g.subs(X, 0) != 0]
        found += [g.xreplace({X: part.args[1]}) for g in beside]
    by_cell = {place.cell: place for g in found for place in _split(g, x)}
    infinite = [place for place in by_cell.values() if not _removable(f, place)]
    return tuple(sorted(infinite, key=lambda place: sp.default_sort_key(place.cell)))


def _split(g: sp.Expr, x: tuple[sp.Symbol, ...]) -> Iterator[Place]:
    """Places by which g vanishes, each of them one that is crossed and not touched, where that can be told."""
    if not g.free_symbols & set(x) or g.is_zero is False:
        return
    if g.is_Mul:
        for factor in g.args:
            yield from _split(factor, x)
    elif isinstance(g, (sp.Abs, *_ODD)) or (g.is_Pow and g.exp.is_positive):
        yield from _split(g.args[0], x)
    elif g.is_Pow and g.base.func is sp.gamma:
        yield Place(g, Min(sp.floor(g.base.args[0]), 0))
    elif g.is_Pow:  # what it divides by is looked for itself
        return
    elif isinstance(g, sp.sin | sp.tan):
        yield Place(g, sp.floor(g.args[0] / sp.pi))
    elif isinstance(g, sp.cos):
        yield Place(g, sp.floor(g.args[0] / sp.pi + sp.Rational(1, 2)))
    elif (
        len(g.free_symbols) <= FACTORED
        and g.is_rational_function(*g.free_symbols)
        and all(a.exp.is_Integer for a in g.atoms(sp.Pow))
    ):
        exact = g.xreplace({a: sp.nsimplify(a, rational=True) for a in g.atoms(sp.Number, sp.NumberSymbol)})
        exact, _ = sp.fraction(sp.together(exact))
        for factor, _ in sp.Poly(exact, *sorted(g.free_symbols, key=str), domain="QQ").factor_list()[1]:
            yield from _of_polynomial(factor.as_expr(), x)
    else:
        yield Place(g, sp.sign(g))
        if len(g.free_symbols) == 1 and _vanishes(g, s := min(g.free_symbols, key=str)):  # which it may touch
            yield Place(g, sp.sign(s))


def _vanishes(g: sp.Expr, s: sp.Symbol) -> bool:
    """Return True if g is 0 where s is."""
    try:
        return bool(g.subs(s, 0).is_zero)
    except ValueError:  # of Max and Min, with something infinite in them
        return False


def _of_polynomial(g: sp.Expr, x: tuple[sp.Symbol, ...]) -> Iterator[Place]:
    """The places of a factor; of one in one letter its real roots."""
    if not g.free_symbols & set(x) or g.is_zero is False:
        return
    if len(g.free_symbols) > 1:
        yield Place(_plain(g), sp.sign(_plain(g)))
        return
    (s,) = g.free_symbols
    for root in sp.real_roots(sp.Poly(g, s)):
        root = root if root.is_Integer else root.evalf(17)  # noqa: PLW2901
        yield Place(s - root, sp.sign(s - root))


def _plain(g: sp.Expr) -> sp.Expr:
    """A polynomial with its fractions as floats, divided by the largest of them."""
    g = g / max((abs(a) for a in sp.Poly(g, *sorted(g.free_symbols, key=str)).coeffs()), default=1)
    return g.xreplace({a: sp.Float(a, 17) for a in g.atoms(sp.Rational) if not a.is_Integer})


def _root(place: Place, s: sp.Symbol) -> float:
    g = place.cell.args[0]
    return float(-g.subs(s, 0) / sp.diff(g, s))


@lru_cache(maxsize=256)
def _removable(f: sp.Expr, place: Place) -> bool:
    """Return True if the terms of f in the one letter of a linear g are finite where it vanishes, as exp(-1/q**2)."""
    if not isinstance(place.cell, sp.sign) or len(place.g.free_symbols) != 1:
        return False
    (s,) = place.g.free_symbols
    f = sp.Add(*[term for term in sp.Add.make_args(f) if term.has(s)])
    g = place.cell.args[0]
    if f.free_symbols != {s} or not g.is_polynomial(s) or sp.degree(g, s) != 1:
        return False
    root = _root(place, s)
    width = abs(root) or 1.0
    return not infinite_between(f, place.cell, (s,), [root - width], [root + width])


def infinite_between(
    f: sp.Expr, cell: sp.Expr, letters: tuple[sp.Symbol, ...], a: Sequence[float], b: Sequence[float]
) -> bool:
    """Return True if f grows without bound, or is not real, where the cell changes from a to b (k,)."""
    function, number = _precise(f, cell, letters)
    with mpmath.workdps(DIGITS):
        start, way = [mpmath.mpf(x) for x in a], [mpmath.mpf(y) - mpmath.mpf(x) for x, y in zip(a, b, strict=True)]

        def at(s: Any) -> list[Any]:
            return [x + s * v for x, v in zip(start, way, strict=True)]

        try:
            low, high, first = mpmath.mpf(0), mpmath.mpf(1), number(*start)
            for _ in range(HALVINGS):
                middle = (low + high) / 2
                low, high = (middle, high) if number(*at(middle)) == first else (low, middle)
            for side in (-1, 1):
                if (low if side < 0 else 1 - high) == 0:  # the way begins or ends there
                    continue
                values = [function(*at(low + side * mpmath.mpf(d))) for d in BESIDE]
                if any(mpmath.im(value) != 0 or not mpmath.isfinite(value) for value in values):
                    return True
                before, after = (abs(y - x) for x, y in pairwise(values))
                if after > DECREASES * before:
                    return True
        except (ArithmeticError, ValueError, TypeError, NameError):  # no number there
            return True
    return False


@lru_cache(maxsize=256)
def _precise(f: sp.Expr, cell: sp.Expr, letters: tuple[sp.Symbol, ...]) -> tuple[Any, Any]:
    """f and the number of the cell, in the arithmetic of mpmath; samples, which are bounded, are left out."""
    f = f.replace(lambda e: type(e).__name__ == "sampled", lambda _: sp.S.One)
    function, number = (sp.lambdify(letters, e, [BOUNDED_VALUES, "mpmath"]) for e in (f, cell))
    return function, number
