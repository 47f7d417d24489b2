"""Where an expression jumps, its impulses and its period in t, read from the functions in it.

A function that can jump, such as a step, a sign or the condition of a piece, jumps where its argument g vanishes: at
the border g = 0. The jump across it is the difference of the expression with the values of all such functions of g
on either side, taken on the border. So what is known does not depend on states or times that would be tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.relational import Relational

from sympflow.hamiltonian.definition import ASIDE
from sympflow.hamiltonian.driving import sampled, with_symbols
from sympflow.hamiltonian.parameters import JUMP, MOST_TURNS, Samples
from sympflow.hamiltonian.removable import X, cancelling, exact, removed, triangle, with_values

MISMATCH = 1e-6
"""Share of the values on both sides of a border by which pieces that are joined may differ there: their constants are
often written with seven figures."""
GROWTH = 1e3  # from 1e-4 of a place to it, of what is infinite there and does not jump
PERIOD_TOLERANCE = 1e-9  # share of itself by which a period may differ from a multiple of that of a term
MOST_POINTS = 2**20  # times at which a function that is neither a polynomial nor periodic is looked at for its zeros
MOST_IMPULSES = 1_000_000
POINTS_A_PERIOD = 4096
LONGEST_MULTIPLE = 64  # periods of a term that the common period of all may have
TOUCHED = 1e-12  # share of the terms of a function, below which it vanishes where its slope does
NEAR = 1e-3  # share of two places by which they differ, so that what jumps at one is constant at the other
MOST_ROOTS = 64  # zeros in a state at which an expression is tried
EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Border:
    """A place g = 0 at which an expression may jump: the terms that it is a part of, with g > 0 and with g < 0."""

    g: sp.Expr
    above: tuple[sp.Expr, ...]
    below: tuple[sp.Expr, ...]

    @property
    def symbols(self) -> set[sp.Symbol]:
        return set().union(self.g.free_symbols, *(f.free_symbols for f in (*self.above, *self.below)))


_STEPS = (sp.Heaviside, sp.sign, sp.Abs, sp.acot, sp.atan2, sp.floor)
_KINKS = (sp.Max, sp.Min, triangle)


def borders(f: sp.Expr, symbols: Iterable[sp.Symbol], kinks: bool = False) -> list[Border]:
    """The borders across which an expression may jump and whose g depends on some symbols, or has `kinks`."""
    wanted = set(symbols)
    if f.has(sp.ceiling, sp.frac, sp.Mod):
        f = f.replace(sp.frac, lambda x: x - sp.floor(x)).replace(sp.ceiling, lambda x: -sp.floor(-x))
        f = f.replace(sp.Mod, lambda x, m: x - m * sp.floor(x / m))
    sides: dict[sp.Expr, dict[sp.Basic, tuple[Any, Any]]] = {}
    atoms = [(a, *_sides(a)) for a in f.atoms(*_STEPS, Relational)]
    atoms += [(a, *_sides(a)) for a in (f.atoms(*_KINKS) if kinks else ()) if len(a.args) < 3]
    atoms += [side for a in f.atoms(sp.Function) for side in _sides_of_quotient(a)]
    for a, g, above, below in atoms:
        if g.free_symbols & wanted:
            flipped = g.could_extract_minus_sign()
            sides.setdefault(-g if flipped else g, {})[a] = (below, above) if flipped else (above, below)
    found, holding = [], dict[sp.Basic, list[sp.Expr]]()
    known = {a for values in sides.values() for a in values}
    for term in sp.Add.make_args(f):
        for a in known.intersection(sp.preorder_traversal(term)):
            holding.setdefault(a, []).append(term)
    lines = {g: line for g in sides if (line := _line(g)) is not None}
    for g, values in sorted(sides.items(), key=lambda item: str(item[0])):
        terms = list(dict.fromkeys(term for a in values for term in holding[a]))
        decided = _decided(g, lines, sides)
        above, below = (
            tuple(term.xreplace(decided | {a: v[i] for a, v in values.items()}) for term in terms) for i in (0, 1)
        )
        if sp.Add(*above) != sp.Add(*below):
            found.append(Border(g, above, below))
    return found


def _line(g: sp.Expr) -> tuple[sp.Symbol, float, float] | None:
    """The symbol, the slope and the zero of a linear function of one symbol."""
    if len(g.free_symbols) != 1:
        return None
    (s,) = g.free_symbols
    slope = sp.diff(g, s)
    return (s, float(slope), float(-g.subs(s, 0) / slope)) if slope.is_number and slope != 0 else None


def _decided(
    g: sp.Expr, lines: Mapping[sp.Expr, tuple[sp.Symbol, float, float]], sides: Mapping[sp.Expr, Mapping[Any, Any]]
) -> dict[sp.Basic, Any]:
    """The values of steps at other places of the symbol of a linear g, where that vanishes."""
    if g not in lines:
        return {}
    s, _, at = lines[g]
    found: dict[sp.Basic, Any] = {}
    for other, (symbol, slope, zero) in lines.items():
        if symbol == s and abs(at - zero) > NEAR * max(abs(at), abs(zero)):
            found |= {a: v[slope * (at - zero) < 0] for a, v in sides[other].items()}
    return found


def _sides(a: sp.Basic) -> tuple[sp.Expr, Any, Any]:
    """The g at whose zeros an atom may jump, without a factor, and the values on either side of it."""
    x = a.args[0] - a.args[1] if isinstance(a, Relational | sp.Max | sp.Min) else a.args[0]
    factor, g = x.primitive() if x.is_Add else x.as_coeff_Mul()
    values: tuple[Any, Any]
    if isinstance(a, Relational):
        values = tuple(sp.sympify(isinstance(a, kinds)) for kinds in (sp.Gt | sp.Ge | sp.Ne, sp.Lt | sp.Le | sp.Ne))
    elif isinstance(a, sp.Heaviside):
        values = sp.S.One, sp.S.Zero
    elif isinstance(a, sp.sign):
        values = sp.S.One, sp.S.NegativeOne
    elif isinstance(a, sp.Abs):
        values = x, -x
    elif isinstance(a, sp.Max | sp.Min):
        values = a.args if isinstance(a, sp.Max) else a.args[::-1]
    elif isinstance(a, triangle):
        return sp.cos(x), *(sp.sin(x) * (sp.pi / 2 - s * sp.cos(x)) for s in (1, -1))
    elif isinstance(a, sp.acot):
        values = sp.pi / 2, -sp.pi / 2
    elif isinstance(a, sp.atan2):
        values = tuple(sp.Piecewise((s * sp.pi, a.args[1] < 0), (0, True)) for s in (1, -1))
    else:
        return sp.sin(sp.pi * x), x, x - 1
    return g, *(values if factor > 0 else values[::-1])


def _sides_of_quotient(a: sp.Function) -> Iterator[tuple[sp.Function, sp.Expr, sp.Expr, sp.Expr]]:
    """The function itself, g and the two limits of a function such as atan(1/g), where they are finite."""
    places = {b: (sp.cos if isinstance(b, sp.tan) else sp.sin)(b.args[0]) for b in a.atoms(sp.tan, sp.cot)}
    for wave, g in places.items():
        values = [a.xreplace({wave: infinity}) for infinity in (sp.oo, -sp.oo)]
        if wave != a and all(value.is_finite for value in values):
            yield a, g, *values
    for power in {b for x in a.args for b in x.atoms(sp.Pow)}:
        if power.exp.is_negative and power.exp.is_odd:
            values = [a.xreplace({power: infinity}) for infinity in (sp.oo, -sp.oo)]
            if all(value.is_finite for value in values):
                yield a, power.base, *values


def _values(variables: list[sp.Symbol], expressions: list[sp.Expr]) -> Callable[..., np.ndarray]:
    """The expressions as a function of arrays (...) that returns (k, ...)."""
    function = sp.lambdify(variables, expressions, ["scipy", np], cse=True)

    def values(*columns: Any) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.stack(np.broadcast_arrays(*function(*columns), *columns)[: len(expressions)])

    return values


def _across(border: Border, variables: list[sp.Symbol]) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """The jump across a border, and the size of what jumps, as functions of arrays."""
    n = len(border.above)
    values = _values(variables, [*border.above, *border.below])

    def across(*columns: Any) -> tuple[np.ndarray, np.ndarray]:
        found = values(*columns)
        with np.errstate(all="ignore"):
            return (found[:n] - found[n:]).sum(0), np.abs(found).sum(0)

    return across


def _tried(s: sp.Symbol, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Values of a symbol at which an expression is tried: half of them within [−1, 1], the others of all sizes."""
    x = np.where(rng.random(shape) < 0.5, rng.uniform(-1, 1, shape), 10 ** rng.uniform(-4, 4, shape))
    return np.abs(x) if s.is_positive else x * rng.choice([-1.0, 1.0], shape)


# jumps in states -----------------------------------------------------------------------------------


def check_continuous(
    argument: str,
    f: sp.Expr,
    states: Iterable[sp.Symbol],
    values: Mapping[sp.Symbol, Any] | None = None,
    names: Mapping[sp.Symbol, str] | None = None,
) -> None:
    """Refuse an expression that jumps in some of its symbols, where the force would be a delta function."""
    states = set(states)
    refuse_deltas(argument, f, names)
    numbers = {s: exact(float(v)) for s, v in (values or {}).items() if np.ndim(v) == 0}
    if cancelling(f) != cancelling(with_values(f, numbers)):
        raise ValueError(
            f"`{argument}` has terms that cancel with the values that `params` gives, so that no digits are left near "
            "the place where they do: write these values as numbers in it."
        )
    [f], _ = with_symbols([f])
    for border in borders(f, states):
        try:
            found = _jump_in_states(border, states, values or {})
        except (NameError, TypeError, AttributeError, KeyError):
            continue  # what NumPy has no function for cannot run either, and what is infinite there is a pole
        if found is None:
            continue
        x, at, below, above = found
        raise ValueError(
            f"`{argument}` jumps where {_named(border.g, names)} = 0, at {_named(x, names)} = {at:.6g} from "
            f"{below:.6g} to {above:.6g}: the force there is a delta function, which no step resolves. Let the pieces "
            "meet there, or write it as a continuous function, such as (1 + tanh((q - a)/w))/2 for a step at a of a "
            "width w that steps resolve; or, for a wall, solve from event to event and reflect p."
        )


def _jump_in_states(
    border: Border, states: set[sp.Symbol], values: Mapping[sp.Symbol, Any]
) -> tuple[sp.Symbol, float, float, float] | None:
    """Return a jump of an expression across a border: a symbol, its value, and those on the sides; None without."""
    rng, n = np.random.default_rng(0), 64
    variables = sorted(border.symbols, key=str)
    given = {s: rng.choice(np.ravel(values[s]), n) if s in values else _tried(s, (n,), rng) for s in variables}
    across = _across(border, variables)
    for x in sorted(border.g.free_symbols & states, key=str)[:8]:
        rows, at, doubt = _roots(border.g, x, given)
        tried = [at if s == x else given[s][rows] for s in variables]
        moved = [
            at + 1e-4 * np.abs(at) + (at == 0) * 1e-4 if s == x else v for s, v in zip(variables, tried, strict=True)
        ]
        jump, size = across(*tried)
        with np.errstate(all="ignore"):
            beside = across(*moved)[0]
            slope = np.abs(beside - jump) / np.where(at == 0, 1e-4, 1e-4 * np.abs(at))
            finite = np.isfinite(size) & (np.abs(jump) < GROWTH * np.abs(beside))
            seen = np.flatnonzero(finite & (np.abs(jump) > MISMATCH * size + 4 * doubt * slope))
        if seen.size:
            i = seen[0]
            sides = [
                float(_values(variables, [sp.Add(*f)])(*(v[i] for v in tried))[0]) for f in (border.below, border.above)
            ]
            return x, float(at[i]), *sides
    return None


def _roots(
    g: sp.Expr, x: sp.Symbol, given: Mapping[sp.Symbol, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Zeros of g in x at rows of values of the other symbols: the row of each, the zero, and how far it may be off."""
    others = sorted(g.free_symbols - {x}, key=str)
    n = len(next(iter(given.values())))
    columns = [given[s] for s in others]
    kinks = [a for a in g.atoms(sp.Abs) if x in a.free_symbols]
    if len(kinks) == 1:  # the zeros on either side of it
        either = [_roots(g.xreplace({kinks[0]: s * kinks[0].args[0]}), x, given) for s in (1, -1)]
        rows, at, off = (np.concatenate(each) for each in zip(*either, strict=True))
        terms = _values([x, *others], list(sp.Add.make_args(g)))(at, *(c[rows] for c in columns))
        kept = np.abs(terms.sum(0)) <= MISMATCH * np.abs(terms).max(0)
        return rows[kept], at[kept], off[kept]
    if g.is_polynomial(x):
        coefficients = _values([x, *others], sp.Poly(g, x).all_coeffs())(np.zeros(n), *columns)
        found = [(i, root) for i in range(n) for root in _real_roots(coefficients[:, i])]
        rows, at = np.array([i for i, _ in found], dtype=int), np.array([z for _, z in found], dtype=float)
        rest = np.zeros(len(at))
    else:
        f = _values([x, *others], [g])
        sizes = np.logspace(-30, 30, 1201)
        line = np.concatenate([-sizes[::-1], sizes])
        value = np.broadcast_to(f(line[None], *(c[:, None] for c in columns))[0], (n, len(line)))
        finite = np.isfinite(value)
        changes = ((value[:, 1:] > 0) != (value[:, :-1] > 0)) & finite[:, 1:] & finite[:, :-1]
        rows, k = np.nonzero(changes)
        near = np.argsort(np.abs(line[k]), kind="stable")
        near = np.concatenate([near[rows[near] == i][:MOST_ROOTS] for i in range(n)])
        rows, k = rows[near], k[near]
        fixed = [c[rows] for c in columns]
        at = _bisected(lambda z: f(z, *fixed)[0], line[k], line[k + 1])
        with np.errstate(all="ignore"):
            ulps = f(at * (1 + 64 * EPS), *fixed)[0] - f(at * (1 - 64 * EPS), *fixed)[0]
            change = f(at * (1 + 1e-6), *fixed)[0] - f(at * (1 - 1e-6), *fixed)[0]
            rest = np.abs(2e-6 * at * f(at, *fixed)[0] / change)  # what rounding leaves of g, over its slope
        told = np.abs(ulps) <= 1e-3 * (np.abs(value[rows, k]) + np.abs(value[rows, k + 1]))
        rows, at, rest = rows[told], at[told], np.where(np.isfinite(rest), rest, 0.0)[told]
    if x.is_positive:
        rows, at, rest = rows[at > 0], at[at > 0], rest[at > 0]
    at[np.abs(at) < 1e-30] = 0.0  # as near as the line goes
    off = 16 * EPS * np.abs(at) + rest
    if g.is_polynomial(x):
        both = _values([x, *others], [g, sp.diff(g, x)])
        for _ in range(3):
            value, slope = both(at, *(c[rows] for c in columns))
            with np.errstate(all="ignore"):
                change = np.where(np.isfinite(value / slope), value / slope, 0.0)
            at = at - change
        off = off + np.abs(change)
    return rows, at, off


def _real_roots(coefficients: np.ndarray) -> list[float]:
    if not np.isfinite(coefficients).all():
        return []
    if len(coefficients) == 2 and coefficients[0]:
        return [float(-coefficients[1] / coefficients[0])]
    roots = np.roots(coefficients)
    return [float(z.real) for z in roots if abs(z.imag) <= 1e-7 * abs(z)]


def _bisected(f: Callable[[np.ndarray], np.ndarray], left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The ends, on the right, of intervals in which f changes its sign."""
    with np.errstate(all="ignore"):
        up = f(left) > 0
        for _ in range(200):
            middle = np.where(left * right > 1e-250, np.sign(left) * np.sqrt(left * right), (left + right) / 2)
            middle = np.where((middle > left) & (middle < right), middle, (left + right) / 2)
            if ((middle <= left) | (middle >= right)).all():
                break
            same = (f(middle) > 0) == up
            left, right = np.where(same, middle, left), np.where(same, right, middle)
    return right


# jumps in t ----------------------------------------------------------------------------------------


class Zeros:
    """The zeros of a function g of the time alone: of a linear one exactly, of a periodic one by its period."""

    def __init__(self, g: sp.Expr, time: sp.Symbol, samples: Mapping[str, Samples] | None = None) -> None:
        self.g, self.time, self.samples = g, time, samples or {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Zeros, (self.g, self.time, self.samples)

    @cached_property
    def root(self) -> float | None:
        """The zero of a linear g, NaN if it has none; None of another."""
        slope = sp.diff(self.g, self.time)
        if not slope.is_number:
            return None
        return float(-self.g.subs(self.time, 0) / slope) if slope != 0 else math.nan

    @cached_property
    def _period(self) -> Any:
        return common_period(self.g, self.time)

    @cached_property
    def _once(self) -> np.ndarray:
        """The zeros in a period, which begins where zeros are rare."""
        return self._sign_changes(self._period * (np.arange(POINTS_A_PERIOD + 1) + 0.1234567) / POINTS_A_PERIOD)

    @cached_property
    def _of_time(self) -> Callable[..., np.ndarray]:
        terms, symbols = with_symbols([self.g])
        values = _values([self.time, *symbols.values()], terms)
        return lambda t: values(t, *(_sampled_at(a, self.time, self.samples, t) for a in symbols))

    @cached_property
    def _slope(self) -> Callable[..., np.ndarray]:
        return _values([self.time], [sp.diff(self.g, self.time)])

    def slopes(self, t: np.ndarray, step: float) -> np.ndarray:
        """Return g' at zeros (n,), 0 at those that are not simple, near which g changes by far more."""
        [slope], near = self._slope(t), 1e-3 * step
        return np.where(np.abs(slope) * near > 1e-6 * np.abs(self._of_time(t + near)[0]), slope, 0.0)

    def within(self, low: float, high: float, step: float, most: int = MOST_TURNS) -> np.ndarray:
        """Return the zeros between two times, of a periodic g those of the first `most` periods."""
        if self.root is not None:
            found = np.array([self.root])
        elif self.g.is_polynomial(self.time):
            roots = np.roots([float(c) for c in sp.Poly(self.g, self.time).all_coeffs()]).real
            aside = 1e-4 * np.maximum(np.abs(roots), step)
            near = np.concatenate([[low, high], roots - aside, roots + aside])
            found = self._sign_changes(np.unique(np.clip(near, low, high)))
        elif (period := self._period) is None:
            found = self._sign_changes(np.linspace(low, high, min(MOST_POINTS, math.ceil((high - low) / step)) + 1))
        else:
            first = math.floor(low / period)
            turns = np.arange(first - 1, min(math.ceil(high / period), first + most) + 1)
            found = np.sort((self._once + period * turns[:, None]).ravel())
            found[np.abs(found) <= 4 * EPS * period] = 0.0
        return found[(found > low) & (found < high)]

    def _sign_changes(self, t: np.ndarray) -> np.ndarray:
        up = self._of_time(t)[0] > 0
        changed = np.flatnonzero(up[1:] != up[:-1])
        return _bisected(lambda s: self._of_time(s)[0], t[changed], t[changed + 1])


class Switch:
    """A border at which an expression may jump in the time, with functions that are generated once."""

    def __init__(self, border: Border, time: sp.Symbol, samples: Mapping[str, Samples]) -> None:
        self.zeros, self.time, self.samples = Zeros(border.g, time, samples), time, samples
        terms, symbols = with_symbols([*border.above, *border.below])
        n = len(border.above)
        self._border = Border(border.g, tuple(terms[:n]), tuple(terms[n:]))
        self._symbols = symbols

    @cached_property
    def _across(self) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """The jump at times (n,), and the size of what jumps, (n, m) at m values of the states."""
        rng = np.random.default_rng(0)
        symbols = self._symbols
        states = sorted(self._border.symbols - {self.time} - set(symbols.values()), key=str)
        tried = [_tried(s, (1, 32), rng) for s in states]
        across = _across(self._border, [self.time, *symbols.values(), *states])

        def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return across(t[:, None], *(_sampled_at(a, self.time, self.samples, t)[:, None] for a in symbols), *tried)

        return at

    @cached_property
    def at_root(self) -> bool:
        """True if there is a jump at the zero of a linear g."""
        root = self.zeros.root
        return root is not None and bool(self._jumps(np.array([root]), abs(root) or 1.0)[0])

    def _jumps(self, times: np.ndarray, step: float) -> np.ndarray:
        """True for the zeros (n,) at which the expression jumps at some of the states; where none tells, True too."""
        jump, size = self._across(times)
        with np.errstate(all="ignore"):
            aside = 0.01 * step
            change = np.abs(self._across(times + aside)[0] - jump)
            doubt = 16 * EPS * np.maximum(np.abs(times)[:, None], aside) * change / aside
            jumps = (np.abs(jump) > JUMP * size + doubt).any(-1)
            return jumps | ~((np.abs(jump) > 0) | (change > 0)).any(-1)

    def times(self, low: float, high: float, step: float, kinks: bool = False) -> np.ndarray:
        """Return the times (n,) at which the expression jumps, or has kinks too; `step` as of `Zeros.within`."""
        if self.zeros.root is not None:
            found = np.array([self.zeros.root])
            return found[(found > low) & (found < high) & (kinks or self.at_root)]
        found = self.zeros.within(low, high, step)
        return found[self._jumps(found, step)] if len(found) and not kinks else found


class Touch:
    """The double zeros of a function g of t under a root in H, such as sqrt(1 - cos(t)): kinks, not jumps."""

    at_root = False

    def __init__(self, g: sp.Expr, time: sp.Symbol, samples: Mapping[str, Samples]) -> None:
        self.g, self._turns = g, Zeros(sp.diff(g, time), time, samples)
        terms, self._symbols = with_symbols([*sp.Add.make_args(g)])
        self._terms = _values([time, *self._symbols.values()], terms)

    def times(self, low: float, high: float, step: float, kinks: bool = False) -> np.ndarray:
        """Return the times (n,) of `kinks`; `step` as of `Zeros.within`."""
        if not kinks:
            return np.zeros(0)
        found = self._turns.within(low, high, step)
        terms = self._values_at(found)
        found = found[np.abs(terms.sum(0)) <= TOUCHED * np.abs(terms).max(0)]
        near = ASIDE * max(abs(low), abs(high)) * np.linspace(-4, 4, 33)  # where rounding must not make g negative
        beside = self._values_at((found + near[:, None]).ravel()).sum(0).reshape(len(near), len(found))
        return found[(beside >= 0).all(0)]

    def _values_at(self, t: np.ndarray) -> np.ndarray:
        """The terms of g, (m, n) at times (n,)."""
        turns = self._turns
        return self._terms(t, *(_sampled_at(a, turns.time, turns.samples, t) for a in self._symbols))


def touches(f: sp.Expr, time: sp.Symbol, samples: Mapping[str, Samples]) -> list[Touch]:
    """The functions of t alone that stand under a root in f, and may vanish without a change of sign."""
    f = f.replace(removed, lambda *args: removed(*args).formula.xreplace({X: args[1]}))
    bases = [power.base for power in f.atoms(sp.Pow) if power.exp.is_integer is False]
    bases += [g for a in f.atoms(sp.asin, sp.acos) for g in (1 - a.args[0], 1 + a.args[0])]
    bases += [a.args[0] - 1 for a in f.atoms(sp.acosh)]
    factors = {g for base in bases for g in sp.Mul.make_args(base) if g.is_Add and g.free_symbols == {time}}
    found = [Touch(g, time, samples) for g in sorted(factors, key=str) if not g.is_positive]
    periods = [common_period(each.g, time) for each in found]
    return [
        each
        for each, period in zip(found, periods, strict=True)
        if period is None or len(each.times(0, 2 * period, period, kinks=True))
    ]


def _sampled_at(a: sampled, time: sp.Symbol, samples: Mapping[str, Samples], t: np.ndarray) -> np.ndarray:
    return samples[a.name_of_samples](_values([time], [a.at])(t)[0], a.order)


def refuse_deltas(argument: str, f: sp.Basic, names: Mapping[sp.Symbol, str] | None = None) -> None:
    """Raise a ValueError if an expression holds delta functions, of states or where no impulses are taken."""
    for delta in f.atoms(sp.DiracDelta):
        raise ValueError(
            f"`{argument}` holds {_named(delta, names)}, and only impulses DiracDelta(t - a)*W(q), in H and of a named "
            "time, have kicks: no step resolves any other. Write it as a narrow smooth function, such as "
            "exp(-(q/w)**2/2)/(w*sqrt(2*pi))."
        )


def _named(f: sp.Basic, names: Mapping[sp.Symbol, str] | None) -> sp.Basic:
    """An expression with the names that its symbols have for the user."""
    return f.xreplace({s: sp.Symbol(name) for s, name in (names or {}).items()})


# impulses ------------------------------------------------------------------------------------------


class Impulse(sp.Function):
    """δ(g(t)) in a Hamiltonian: no library has a function for it, so that nothing can leave it out."""

    nargs = 1
    is_real = True

    def _eval_derivative(self, s: sp.Symbol) -> sp.Expr:
        return (
            sp.S.Zero
            if s not in self.args[0].free_symbols
            else sp.DiracDelta(self.args[0], 1) * sp.diff(self.args[0], s)
        )

    def _sympystr(self, printer: Any) -> str:
        return f"DiracDelta({printer._print(self.args[0])})"


def split_impulses(
    argument: str, H: sp.Expr, time: sp.Symbol | None, q: Iterable[sp.Symbol], p: Iterable[sp.Symbol]
) -> tuple[sp.Expr, dict[sp.Expr, sp.Expr]]:
    """H without its delta functions of t, and the potential W(q, t) that each of them, δ(g(t)), multiplies, by g."""
    q, p = set(q), set(p)
    rest: list[sp.Expr] = []
    found: dict[sp.Expr, sp.Expr] = {}
    for delta in H.atoms(sp.DiracDelta):
        if time is None or delta.args[0].free_symbols != {time}:
            refuse_deltas(argument, delta)
        if delta.args[1:] not in ((), (0,)):
            raise ValueError(f"`{argument}` holds {delta}, a derivative of a delta function: use DiracDelta itself.")
    dummies = {delta: sp.Dummy() for delta in H.atoms(sp.DiracDelta)}  # whose arguments stay as they are
    deltas_of = {dummy: delta for delta, dummy in dummies.items()}
    summands = [each.xreplace(dummies) for each in sp.Add.make_args(H)]
    terms = [term for each in summands for term in sp.Add.make_args(sp.expand(each) if each.has(sp.Dummy) else each)]
    terms = [term.xreplace(deltas_of) for term in terms]
    for term in terms:
        if not term.has(sp.DiracDelta):
            rest.append(term)
            continue
        deltas = [a for a in sp.Mul.make_args(term) if isinstance(a, sp.DiracDelta)]
        W = sp.Mul(*[a for a in sp.Mul.make_args(term) if not isinstance(a, sp.DiracDelta)])
        if len(deltas) != 1 or W.has(sp.DiracDelta):
            raise ValueError(
                f"`{argument}` holds {term}, which is not linear in a delta function: write it as "
                "DiracDelta(t - a)*W(q)."
            )
        if W.free_symbols & p:
            raise ValueError(
                f"`{argument}` holds {term}, and an impulse is exact as a kick of p, by DiracDelta(t - a)*W(q) without "
                f"{', '.join(sorted(s.name for s in W.free_symbols & p))}: write it so, or as a narrow pulse of t, "
                "such as exp(-((t - a)/w)**2/2)/(w*sqrt(2*pi))."
            )
        g = deltas[0].args[0]
        found[g] = found.get(g, sp.S.Zero) + W
    return sp.Add(*rest), {g: W for g, W in found.items() if W.free_symbols & q}


def _leaves(f: sp.Basic, time: sp.Symbol, samples: Mapping[str, Samples]) -> Iterator[float]:
    """The periods of the innermost periodic functions of t; inf for a t, and −inf for a rounded one, in no such."""
    if time not in f.free_symbols:
        return
    if f == time:
        yield math.inf
        return
    kinds = {sp.sin: 2 * sp.pi, sp.cos: 2 * sp.pi, sp.sec: 2 * sp.pi, sp.csc: 2 * sp.pi, sp.tan: sp.pi, sp.cot: sp.pi}
    own: Any = kinds.get(type(f))
    argument = f.args[0]
    if isinstance(f, sp.frac):
        own = 1
    elif isinstance(f, sp.Mod) and time not in f.args[1].free_symbols:
        own = f.args[1]
    elif isinstance(f, sampled):
        argument, each = f.at, samples.get(f.name_of_samples)
        own = each.span[1] - each.span[0] if each is not None and each.periodic else None
    if own is not None:
        slope = sp.diff(argument, time)
        if slope.is_number:
            yield float(abs(own / slope))
            return
    if isinstance(f, sp.floor | sp.ceiling):
        yield -math.inf
    for each in f.args:
        yield from _leaves(each, time, samples)


def common_period(f: sp.Expr, time: sp.Symbol) -> float | None:
    """A period of f in t, that of all periodic functions in it, if t is in such alone and they have one."""
    periods = sorted(set(_leaves(f, time, {})))
    if not periods or math.inf in periods or -math.inf in periods:
        return None
    multiple = 1
    for each in periods:
        ratio = Fraction(periods[-1] / each).limit_denominator(LONGEST_MULTIPLE)
        if abs(periods[-1] / each - ratio) > PERIOD_TOLERANCE * ratio:
            return None
        multiple = math.lcm(multiple, ratio.denominator)
    return multiple * periods[-1] if multiple <= LONGEST_MULTIPLE else None


def has_period(
    H: sp.Expr, time: sp.Symbol, states: Iterable[sp.Symbol], samples: Mapping[str, Samples], period: float
) -> bool:
    """Return True if H, up to a function of t alone, has a period: every term of it by its functions of t."""
    rng, states = np.random.default_rng(0), set(states)
    terms: dict[sp.Expr, sp.Expr] = {}
    for term in sp.Add.make_args(H.replace(Impulse, sp.Abs)):
        if time in term.free_symbols and term.free_symbols & states:
            alone = all(map(math.isfinite, _leaves(term, time, samples)))  # t and floor(t) are periodic together
            key = term if alone else term.as_independent(*states, as_Add=False)[1]
            terms[key] = terms.get(key, sp.S.Zero) + term
    for term in terms.values():
        leaves = list(_leaves(term, time, samples))
        if -math.inf not in leaves:
            if math.inf in leaves:
                return False
            turns = period / np.array(leaves)
            if (np.round(turns) > 0).all() and (np.abs(turns - np.round(turns)) <= PERIOD_TOLERANCE * turns).all():
                continue
        factor, rest = sp.factor_terms(term).as_independent(*states, as_Add=False)
        [f], symbols = with_symbols([term if time in rest.free_symbols else factor])
        variables = sorted(f.free_symbols - {time} - set(symbols.values()), key=str)
        values = _values([time, *symbols.values(), *variables], [f])
        tried = [_tried(s, (64,), rng)[:, None] for s in variables]
        t = period * rng.uniform(-50, 50, 400)
        before, after = (
            values(s[None], *(_sampled_at(a, time, samples, s)[None] for a in symbols), *tried)[0]
            for s in (t, t + period)
        )
        with np.errstate(all="ignore"):
            seen = np.isfinite(before) & np.isfinite(after)
            before, after = np.where(seen, before, 0.0), np.where(seen, after, 0.0)
            width = before.max(-1) - before.min(-1)
            if not (width > 0).any() or (np.abs(after - before).max(-1) > 1e-8 * width).any():
                return False
    return True
