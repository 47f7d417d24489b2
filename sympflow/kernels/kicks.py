"""Kicks of a symbolic system as code: of the shapes that their sums may take, the fastest, alone and in a batch."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import sympy as sp

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, printable
from sympflow.kernels.approximations import UNTOUCHED, Letters, OnInterval, Ranges, on_interval, range_of
from sympflow.kernels.codegen import as_factor, parameter_lines, printed, vectorised
from sympflow.kernels.scheduling import ADD, FUSED, PRODUCTS, Schedule, nested
from sympflow.kernels.stages import kicks_of

__all__ = ["kick_cycles", "kicks_source", "shapes"]

PRODUCT = "fused_multiply_add"  # of `elementary`
NEXT_SUM = 2.0  # cycles of a sum that waits for the result before, in kicks that are joined with drifts
MOST_KEPT = 200  # sources
MOST_OPERATIONS = 400  # of a kick whose shapes are tried: rewriting longer ones takes longer than it saves
MOST_FACTORED = 160  # see `_work_of_factoring`: what takes SymPy a second or two
MOST_MULTIPLIED = 3000  # terms, of what is factored or multiplied out
MOST_TERMS = 120  # of a sum multiplied out
MOST_NESTED = 12  # of a momentum's sum that is nested
NEAR = 4.0  # from 0, where powers multiplied out cancel little
B, G, C = sp.symbols("b g c", real=True)


@dataclass(frozen=True)
class _Kick:
    """One shape of a kick: the body of its function without the lines of its coefficients, and its costs.

    These are the cycles that a single trajectory pays for it and a drift, and the operations, in units of an addition,
    that a batch pays.
    """

    coefficients: list[str]
    lines: list[str]
    results: list[str]
    cycles: float
    operations: float
    condition: str = ""
    """Where the shape holds, of one that holds for some positions only."""
    drift: Sequence[str] = ()
    moved: Sequence[str] = ()
    """The lines of the drift that follows, and the positions after it, where it is joined with the kick."""

    @property
    def calls(self) -> bool:
        """True if it calls the library's exp, which takes the lanes of a batch one by one."""
        return any("math.exp(" in line for line in self.lines)


def kicks_source(
    symbols: SymbolicHamiltonian,
    level: int,
    monomials: Monomials = (),
    varied: bool = False,
    ranges: Ranges = (),
    joined: bool = False,
) -> str:
    """The new p after each kind of kick of a level, each in two shapes, equal but for rounding: see `Kick`.

    It is p − b∇V + g∇²V v − c∇(½ v·∇²V v), v = M⁻¹∇V, or p − b∇V − Σ_m e_m ∇q^m. ``kicked(q, p, table, j)`` is the
    fastest for one trajectory; the products of b, g, c and e alone are in row j of the table, which
    ``fill_coefficients(numbers, row)`` computes. ``kicked_lane(q, p, numbers)`` has the fewest operations, for many
    trajectories at once. ``drifted(q, p, a)`` is the drift of a single one. Where H has parameters, `numbers` end with
    their values, and ``drifted(q, p, numbers, a)`` takes them too.

    Where lanes are `varied`, each with its own values of the parameters, the kick of a lane takes what depends on these
    and on no state from a table: ``fill_own(numbers, own, lane)`` computes `N_OWN` numbers for a lane, and
    ``kicked_by_own(q, p, numbers, own, lane)`` is ``kicked_lane`` with them. There is one kind of kick then.

    With `ranges` of positions functions in V are written as letters, whose powers and products are shared, and those of
    one trajectory may be polynomials that are exact to rounding in these ranges; beyond, ``kicked`` is ``kicked_lane``.

    Kicks may be `joined` with the drift that follows: instead of ``kicked`` there is ``kicked_and_drifted(q, p, table,
    j, a)``, which returns the new q as well. It does not wait for the new p: q + a (p + f·F) is (q + a p) + (a f)·F,
    with as many operations from one q to the next as a kick alone has, and equal but for rounding.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    key = symbols.H, symbols.parameters, level, monomials, ranges, joined
    if key not in _SOURCES:
        if len(_SOURCES) >= MOST_KEPT:
            del _SOURCES[next(iter(_SOURCES))]
        _SOURCES[key] = _source(symbols, level, monomials, ranges, joined)
    source, own = _SOURCES[key]
    return f"{source}\n\n{own}" if varied else source


def kick_cycles(symbols: SymbolicHamiltonian, level: int, ranges: Ranges = (), joined: bool = False) -> float:
    """Cycles of a kick and the drift before it in a single trajectory, as its terms are first written down.

    That is not the fastest way to write them, for which the compiler looks much longer (`kicks_source`); but
    kicks of one system with more or fewer terms compare alike.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
    level : int
        0 for the force alone, 1 with a force gradient, 2 with a curvature term too.
    ranges
        Of positions, where one degree of freedom may have its kick as a polynomial.
    joined : bool
        True where the drift does not wait for the kick: see `kicks_source`.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    shape = next(iter(shapes(symbols, level + 1)))
    tried = [_scheduled(symbols, shape, "kick_", common, joined=joined) for common in (True, False)]
    if ranges and symbols.ndof == 1 and level:
        tried += _whole_polynomials(symbols, _parts(symbols, level + 1), "kick_", ranges, joined)
    return min(kick.cycles for kick in tried)


_SOURCES: dict[tuple[sp.Expr, tuple[sp.Symbol, ...], int, Monomials, Ranges, bool], tuple[str, str]] = {}
"""Sources, and those of varied lanes, by H: systems are often made again, and the search takes a tenth of a second."""


def _source(
    symbols: SymbolicHamiltonian, level: int, monomials: Monomials, ranges: Ranges, joined: bool
) -> tuple[str, str]:
    functions: list[str] = []
    fill: list[str] = []
    stored: list[str] = []
    kinds = kicks_of(level, len(monomials))
    kept = [*kinds[0].numbers, *(s.name for s in symbols.parameters)]
    for kick in reversed(kinds):
        name, terms = kick.name, len(kick.numbers)
        if ranges and isinstance(symbols, SymbolicHamiltonian):
            tried = _tried_in(symbols, terms, f"{name[0]}_", ranges, joined)
        else:
            tried = _tried(symbols, terms, f"{name[0]}_", monomials, joined)
        one = min(tried, key=lambda kick: (kick.cycles, kick.operations))
        lanes = [k for k in tried if not k.condition]
        if isinstance(symbols, SymbolicHamiltonian) and not monomials:
            lanes += _by_products(symbols, terms, f"{name[0]}_")
        many = min(lanes, key=lambda kick: (kick.calls, kick.operations, kick.cycles))
        body = [*one.lines, *one.drift, *one.results, *one.moved]
        used = [n for n in _names(one.coefficients) if any(_mentions(line, n) for line in body)]
        loads = [f"{n} = table[j, {len(stored) + i}]" for i, n in enumerate(used)]
        fill += one.coefficients
        stored += used
        taken = [v for v in kept if any(_mentions(line, v) for line in body)]
        loads += [f"{v} = table[j, -{len(kept) - kept.index(v)}]" for v in taken]
        lines = [*loads, *one.lines, *one.drift]
        given = "q, p, table, j" + (", a" if joined else "")
        if one.condition:
            numbers = "".join(f"table[j, -{n}], " for n in range(len(kept), 0, -1))
            beyond = [f"p = {name}_lane(q, p, ({numbers}))", f"return {'drifted(q, p, a), ' if joined else ''}p"]
            functions.append(f"@njit(**OPTIONS)\ndef {name}_beyond({given}):\n    " + "\n    ".join(beyond))
            lines = [f"if not ({one.condition}):", f"    return {name}_beyond({given})", *lines]
        one_name = f"{name}_and_drifted" if joined else name
        functions.append(_function(symbols, one_name, given, lines, *([one.moved] if joined else []), one.results))
        given_numbers = [f"{v} = numbers[{i}]" for i, v in enumerate(kick.numbers)]
        lines = [*many.coefficients, *many.lines]
        lines = [*given_numbers, *parameter_lines(symbols, [*lines, *many.results]), *lines]
        functions.append(_function(symbols, f"{name}_lane", "q, p, numbers", lines, many.results))
    rows = [f"{', '.join(kept)}, = numbers", *fill, *(f"row[{i}] = {name}" for i, name in enumerate([*stored, *kept]))]
    filled = "\n    ".join(["@njit(**OPTIONS)\ndef fill_coefficients(numbers, row):", *rows])
    drifts = _drift_source(symbols)
    source = "\n\n\n".join([f"N_COEFFICIENTS = {len(stored) + len(kept)}", filled, *functions, drifts]) + "\n"
    return source, _own_source(symbols, kinds[0].name, kinds[0].numbers, many)


def _own_source(symbols: SymbolicHamiltonian, name: str, numbers: Sequence[str], kick: _Kick) -> str:
    """The functions of varied lanes, of a level that has the kick of this name and numbers alone."""
    body = [*kick.lines, *kick.results]
    letters = [s.name for s in symbols.parameters]
    depend = list(letters)
    for line in kick.coefficients:
        if any(_mentions(line.partition(" = ")[2], known) for known in depend):
            depend += _names([line])
    own = [known for known in depend if any(_mentions(line, known) for line in body)]
    given = [f"{v} = numbers[{i}]" for i, v in enumerate(numbers)]
    filled = [f"own[{i}, lane] = {known}" for i, known in enumerate(own)]
    fill = [*given, *parameter_lines(symbols, [*kick.coefficients, *filled]), *kick.coefficients, *filled]
    common = [line for line in kick.coefficients if _names([line])[0] not in depend]
    taken = [f"{known} = own[{i}, lane]" for i, known in enumerate(own)]
    lines = [*given, *common, *taken, *kick.lines]
    filling = "\n    ".join(["@njit(**OPTIONS, forceinline=True)\ndef fill_own(numbers, own, lane):", *fill])
    kicked = _function(symbols, "kicked_by_own", "q, p, numbers, own, lane", lines, kick.results)
    return f"N_OWN = {len(own)}\n\n\n{filling}\n\n\n{kicked}\n"


def _drift_source(symbols: SymbolicHamiltonian) -> str:
    """``drifted(q, p, a)``, q + a M⁻¹p or q + a∇T, the products with a, for which no state waits, made first."""
    M, d = symbols.inverse_mass, symbols.ndof
    numbers = "numbers, " if symbols.parameters else ""
    if M is None:
        lines = [f"v = drift(p, a, {numbers}None)"]
        moved = [f"{s} + v[{i}]" for i, s in enumerate(symbols.q)]
    else:
        moved = []
        for i in range(d):
            at = symbols.q[i].name
            for j in range(d):
                if M[i, j] != 0:
                    a = "a" if M[i, j] == 1 else f"(a*{as_factor(M[i, j])})"
                    at = f"{PRODUCT}({a}, {symbols.p[j]}, {at})"
            moved.append(at)
        lines = parameter_lines(symbols, moved)
    return _function(symbols, "drifted", f"q, p, {numbers}a", lines, moved)


def _names(assignments: Sequence[str]) -> list[str]:
    return [line.partition(" = ")[0] for line in assignments]


def _mentions(code: str, name: str) -> bool:
    return re.search(rf"\b{name}\b", code) is not None


def _function(
    symbols: SymbolicHamiltonian, name: str, arguments: str, lines: Sequence[str], *results: Sequence[str]
) -> str:
    """A compiled function that returns a tuple, or several."""
    unpacked = [f"{', '.join(s.name for s in v)}, = {x}" for v, x in ((symbols.q, "q"), (symbols.p, "p"))]
    returned = "return " + ", ".join(f"({''.join(f'{value}, ' for value in values)})" for values in results)
    return "\n    ".join([f"@njit(**OPTIONS, forceinline=True)\ndef {name}({arguments}):", *unpacked, *lines, returned])


def _scheduled(
    symbols: SymbolicHamiltonian,
    shape: Sequence[sp.Expr],
    prefix: str,
    common: bool = True,
    letters: Mapping[sp.Symbol, sp.Expr] = MappingProxyType({}),
    condition: str = "",
    joined: bool = False,
) -> _Kick:
    """The shape as code. Momenta are known before positions, whose drift waited for them if it is not joined.

    Without `common` only whole factors and terms are shared, not products within products, which may be known later.
    """
    known = {**dict.fromkeys(symbols.q, 0.0), **dict.fromkeys(symbols.p, 0.0 if joined else -FUSED)}
    schedule = Schedule(known, printed, prefix, PRODUCT, add=NEXT_SUM if joined else ADD)
    numbers: dict[sp.Expr, sp.Symbol] = {}
    states = {*symbols.q, *symbols.p, *letters}
    for letter, function in letters.items():
        schedule.define(letter, function)
    shape = [_numbered(f, states, numbers) for f in shape]
    for coefficient, symbol in numbers.items():  # as one: what is common to several would else be taken out of them
        schedule.define(symbol, coefficient)
    if common:
        shared, shape = sp.cse(shape, symbols=sp.numbered_symbols("common_", real=True), list=True, order="none")
        for symbol, expression in shared:
            schedule.define(symbol, expression)
    results = [schedule.value(f)[1] for f in shape]
    operations = schedule.operations + _moving(symbols)
    if joined:
        lines = [*schedule.lines]
        drift, moved = _joined(symbols, schedule, results)
        cycles = schedule.paced([*results, *moved])
        return _Kick(schedule.early, lines, results, cycles, operations, condition, drift, moved)
    schedule.busy[PRODUCTS] += _moving(symbols)
    cycles = schedule.cycles(results) + FUSED  # the drift waits for the kick
    return _Kick(schedule.early, schedule.lines, results, cycles, operations, condition)


def _joined(symbols: SymbolicHamiltonian, schedule: Schedule, momenta: Sequence[str]) -> tuple[list[str], list[str]]:
    """The lines of q + a M⁻¹p after those of p in a schedule, and their results."""
    M, n = symbols.inverse_mass, len(schedule.lines)
    assert M is not None
    numbers: dict[sp.Expr, str] = {}
    rows = [
        (s.name, [(numbers.setdefault(m, f"a_{len(numbers)}"), p) for m, p in zip(row, momenta, strict=True) if m != 0])
        for s, row in zip(symbols.q, M.tolist(), strict=True)
    ]
    moved = schedule.moved(rows)
    factors = [f"{name} = a" if m == 1 else f"{name} = a*{as_factor(m)}" for m, name in numbers.items()]
    return [*factors, *schedule.lines[n:]], moved


def _tried(symbols: SymbolicHamiltonian, terms: int, prefix: str, monomials: Monomials, joined: bool) -> list[_Kick]:
    return [
        _scheduled(symbols, shape, prefix, common, joined=joined)
        for shape in shapes(symbols, terms, monomials)
        for common in (True, False)
    ]


def _numbered(f: sp.Expr, states: set[sp.Symbol], numbers: dict[sp.Expr, sp.Symbol]) -> sp.Expr:
    """The expression with a symbol for the part of each product that depends on b, g and c, or b and e, alone."""
    if not isinstance(f, sp.Expr) or not f.args or not f.free_symbols - states:
        return f
    if f.is_Mul:
        fixed = [a for a in f.args if not a.free_symbols & states]
        if any(a.free_symbols for a in fixed) and len(fixed) < len(f.args):
            coefficient = sp.Mul(*fixed)
            if not coefficient.is_Symbol:
                symbol = numbers.setdefault(coefficient, sp.Symbol(f"number_{len(numbers)}", real=True))
                f = sp.Mul(symbol, *[a for a in f.args if a.free_symbols & states], evaluate=False)
    return f.func(*[_numbered(a, states, numbers) for a in f.args], evaluate=False)


# kicks in ranges of positions -------------------------------------------------------------------------------------


def _tried_in(symbols: SymbolicHamiltonian, terms: int, prefix: str, ranges: Ranges, joined: bool) -> list[_Kick]:
    """Shapes by letters for functions, of arithmetic alone, and in ranges of positions as polynomials."""
    tried = [_scheduled(symbols, next(shapes(symbols, terms)), prefix, joined=joined)]
    parts = _parts(symbols, terms)
    if symbols.ndof == 1:
        tried += _whole_polynomials(symbols, parts, prefix, ranges, joined)
    letters = Letters(symbols.q)
    columns = [letters.put_into(part) for part in parts]
    if not letters.functions:
        return tried
    changes = [
        sp.Add(*[a * f for a, f in zip((-B, G, -C), column, strict=False)]) for column in zip(*columns, strict=True)
    ]
    exact = dict(zip(letters.functions, vectorised(list(letters.functions.values())), strict=True))
    ways = [(exact, "")]
    if len(tried) == 1:  # not in one piece
        ways += filter(None, [_as_polynomials(symbols, letters, ranges)])
    schedule = Schedule(dict.fromkeys(symbols.q, 0.0), printed)
    for letter, function in ways[-1][0].items():
        schedule.define(letter, function)
    known = {**dict.fromkeys(symbols.q, 0.0), **{x: schedule.value(x)[0] for x in letters.symbols}}
    for shape in _forms(symbols, changes, known):
        for meaning, condition in ways:
            tried += [
                _scheduled(symbols, shape, prefix, common, meaning, condition, joined) for common in (True, False)
            ]
    return tried


def _parts(symbols: SymbolicHamiltonian, terms: int) -> list[list[sp.Expr]]:
    """∇V, ∇²V v and ∇(½ v·∇²V v), as many of them as a kick has terms."""
    parts = [-symbols.force_gradient, symbols.W][: terms - 1]
    return [list(symbols.slope), *([sp.diff(f, s) for s in symbols.q] for f in parts)]


def _whole_polynomials(
    symbols: SymbolicHamiltonian, parts: Sequence[Sequence[sp.Expr]], prefix: str, ranges: Ranges, joined: bool
) -> list[_Kick]:
    """The kick of one degree of freedom as one polynomial, whatever V is."""
    (q,), (p,) = symbols.q, symbols.p
    found = on_interval([f for (f,) in parts], q, *ranges[0])
    if found is None:
        return []
    x, letters = _argument(q, found, "position")
    sums = [
        sp.Add(*[a * sp.Float(c) for a, c in zip((-B, G, -C), column, strict=False) if c])
        for column in found.coefficients.T.tolist()
    ]
    change = sp.Add(*[_times(c, x**k) for k, c in enumerate(sums) if c != 0], evaluate=False)
    known, condition = {x: 0.0 if x == q else ADD}, _within(q, found)
    return [
        _scheduled(symbols, [_nested(known, p, change, False, last)], prefix, False, letters, condition, joined)
        for last in (False, True)
    ]


def _as_polynomials(
    symbols: SymbolicHamiltonian, letters: Letters, ranges: Ranges
) -> tuple[dict[sp.Symbol, sp.Expr], str] | None:
    """The letters by polynomials in their arguments, and where these hold; None unless they all have one."""
    meaning: dict[sp.Symbol, sp.Expr] = {}
    conditions: dict[str, None] = {}  # a set in order
    for letter, function in letters.functions.items():
        u = function.args[0]
        between = range_of(u, symbols.q, ranges)
        argument = sp.Dummy(real=True)
        found = None if between is None else on_interval([function.func(argument)], argument, *between)
        if found is None:
            return None
        x, more = _argument(u, found, f"argument_of_{letter}")
        meaning.update(more)
        terms = [sp.Float(c) * x**k for k, c in enumerate(found.coefficients[0].tolist()) if c]
        meaning[letter] = nested(None, terms, {x: 0.0})
        conditions[_within(u, found)] = None
    return meaning, " and ".join(conditions)


def _argument(u: sp.Expr, found: OnInterval, name: str) -> tuple[sp.Symbol, dict[sp.Symbol, sp.Expr]]:
    """The variable of a polynomial, and what it stands for where it is no position."""
    if found.center == 0 and u.is_Symbol:
        return u, {}
    x = sp.Symbol(name, real=True)
    return x, {x: printable(u - sp.Float(found.center))}


def _within(u: sp.Expr, found: OnInterval) -> str:
    return f"{found.low!r} <= {printed(printable(u))} <= {found.high!r}"


# kicks of lanes ---------------------------------------------------------------------------------------------------


def _by_products(symbols: SymbolicHamiltonian, terms: int, prefix: str) -> list[_Kick]:
    """The kick of a lane by values of s = ∇V, v = M⁻¹s and the entries of ∇²V: few operations, in long chains.

    It is p − b s + ∇²V u with u = g v or, with a curvature term, u = g v − c M⁻¹∇²V v, and then less ½ c ∇³V(v, v).
    Written out in positions, as in `shapes`, each momentum would be a sum of its own.
    """
    q, p, d = symbols.q, symbols.p, symbols.ndof
    if _far(symbols):
        return []
    entries: list[dict[tuple[int, ...], sp.Expr]] = [{(i,): sp.diff(symbols.V, q[i]) for i in range(d)}]
    for _ in range(1, terms):
        entries.append({(*at, j): sp.diff(f, q[j]) for at, f in entries[-1].items() for j in range(at[-1], d)})
    functions = [f for order in entries for f in order.values()]
    if any(f.has(*UNTOUCHED) or sp.count_ops(f) > MOST_OPERATIONS or _length(f) > MOST_MULTIPLIED for f in functions):
        return []
    letters = Letters(q, split=False)
    functions = letters.put_into(functions)
    x = (*q, *letters.symbols)
    known = {**dict.fromkeys(q, 0.0), **dict.fromkeys(p, -FUSED)}
    schedule = Schedule(known, printed, prefix, PRODUCT, few=True)
    for letter, f in zip(letters.functions, vectorised(list(letters.functions.values())), strict=True):
        schedule.define(letter, f)
    expanded = [_expanded(f, x) for f in functions]
    if any(len(f.args) > MOST_TERMS for f in expanded):
        return []
    forms = [printable(_by_common_factors(f, x)) for f in expanded]
    shared, forms = sp.cse(forms, symbols=sp.numbered_symbols("common_", real=True), list=True, order="none")
    for symbol, f in shared:
        schedule.define(symbol, f)

    def value(name: str, f: sp.Expr) -> sp.Expr:
        """A symbol for it, of a name that no variable has."""
        if f.is_Symbol or f.is_number:
            return f
        symbol = sp.Symbol(name, real=True)
        schedule.define(symbol, f)
        return symbol

    def applied(name: str, A: list[list[sp.Expr]], y: list[sp.Expr], *factors: sp.Expr) -> list[sp.Expr]:
        """A y, or a multiple of it."""
        return [value(f"{name} {i}", _sum_of([(*factors, a, y[k]) for k, a in enumerate(A[i])])) for i in range(d)]

    places = [at for order in entries for at in order]
    of = {at: value(f"derivative {at}", f) for at, f in zip(places, forms, strict=True)}
    s = [of[i,] for i in range(d)]
    products: list[list[tuple[sp.Expr, ...]]] = [[(p[i],), (-B, s[i])] for i in range(d)]
    if terms > 1:
        M = symbols.inverse_mass
        assert M is not None
        inverse = [[_number(M[i, j]) for j in range(d)] for i in range(d)]
        hessian = [[of[min(i, j), max(i, j)] for j in range(d)] for i in range(d)]
        if terms == 2:
            u = applied("u", inverse, s, G)
        else:
            v = applied("v", inverse, s)
            again = applied("again", inverse, applied("product", hessian, v), -C)
            u = [value(f"u {i}", _sum_of([(G, v[i]), (again[i],)])) for i in range(d)]
        for i in range(d):
            products[i] += [(hessian[i][j], u[j]) for j in range(d)]
    if terms == 3:
        for j, k in itertools.combinations_with_replacement(range(d), 2):
            square = value(f"square {j} {k}", sp.Mul(-C / 2 if j == k else -C, v[j], v[k], evaluate=False))
            for i in range(d):
                products[i].append((of[tuple(sorted((i, j, k)))], square))
    results = [schedule.value(_sum_of(row))[1] for row in products]
    schedule.busy[PRODUCTS] += _moving(symbols)
    return [_Kick(schedule.early, schedule.lines, results, schedule.cycles(results) + FUSED, schedule.operations)]


def _sum_of(products: Sequence[Sequence[sp.Expr]]) -> sp.Expr:
    """Σ of products as they are, of which some are 0."""
    terms = [[f for f in factors if f != 1] for factors in products if all(f != 0 for f in factors)]
    return sp.Add(*[sp.Mul(*factors, evaluate=False) for factors in terms], evaluate=False)


def _moving(symbols: SymbolicHamiltonian) -> int:
    """The products of a drift."""
    return sum(sp.diff(symbols.T, p).has(s) or s == p for p in symbols.p for s in symbols.p)


# the shapes of a kick ---------------------------------------------------------------------------------------------


def shapes(symbols: SymbolicHamiltonian, terms: int, monomials: Monomials = ()) -> Iterator[list[sp.Expr]]:
    """Ways to write the new momenta, equal but for rounding, of kicks with one term to three, or with a polynomial."""
    q, p, d = symbols.q, symbols.p, symbols.ndof
    slope = [sp.diff(symbols.V, s) for s in q]
    if monomials:
        letters = [sp.Symbol(f"e_{m}", real=True) for m in range(len(monomials))]
        P = sp.Add(*[e * sp.Mul(*map(sp.Pow, q, m)) for e, m in zip(letters, monomials, strict=True)])
        changes = [-B * slope[i] - sp.diff(P, q[i]) for i in range(d)]
        if d == 2 and (symbols.V + P).is_polynomial(*q):
            yield from _with_products_of_both(symbols, -B * symbols.V - P)
    elif terms == 1:
        yield [printable(p[i] - B * slope[i]) for i in range(d)]
        changes = [-B * f for f in slope]
    else:
        M = symbols.inverse_mass
        assert M is not None
        velocity = [sp.Add(*[_number(M[j, k]) * slope[k] for k in range(d)]) for j in range(d)]
        hessian = [[sp.diff(f, s) for s in q] for f in slope]
        products = [_dot(row, velocity) for row in hessian]
        changes = [-B * slope[i] + G * products[i] for i in range(d)]
        if terms == 3:
            again = [_dot([_number(M[j, k]) for k in range(d)], products) for j in range(d)]
            bent = [_dot([_dot([sp.diff(h, s) for h in row], velocity) for row in hessian], velocity) for s in q]
            changes = [f - C * (_dot(hessian[i], again) + bent[i] / 2) for i, f in enumerate(changes)]
        yield [printable(p[i] + f) for i, f in enumerate(changes)]
        if _far(symbols):
            return
        W = [_dot(slope, velocity) / 2, _dot(velocity, products) / 2][: terms - 1]
        if any(f.has(*UNTOUCHED) or sp.count_ops(f) > MOST_OPERATIONS for f in W):
            return
        W = [sp.powsimp(f) for f in W]
        several = [len(_denominators(f)) > 1 and d > 1 for f in W]  # whose products SymPy would factor for minutes
        if any(several) or any(_length(f) > MOST_MULTIPLIED for f in W):
            return
        W = [sp.factor(f) for f in W]
        changes = [
            -B * slope[i] + sp.Add(*[c * sp.diff(f, q[i]) for c, f in zip((G, -C), W, strict=False)]) for i in range(d)
        ]
    yield from _forms(symbols, changes, dict.fromkeys(q, 0.0))


def _forms(
    symbols: SymbolicHamiltonian, changes: Sequence[sp.Expr], known: dict[sp.Symbol, float]
) -> Iterator[list[sp.Expr]]:
    """Ways to write p and its changes, functions of arguments that are known at these times."""
    p, q = symbols.p, tuple(known)
    if _far(symbols) or any(f.has(*UNTOUCHED) or sp.count_ops(f) > MOST_OPERATIONS for f in changes):
        return
    yield [printable(p[i] + f) for i, f in enumerate(changes)]
    if any(_work_of_factoring(f) > MOST_FACTORED or _length(f) > MOST_MULTIPLIED for f in changes):
        return
    factored = [sp.factor(f) for f in changes]
    yield [printable(p[i] + _collected(f, q)) for i, f in enumerate(factored)]
    expanded = [_expanded(f, q) for f in changes]
    if sum(len(f.args) for f in expanded) <= MOST_TERMS:
        yield [printable(sp.Add(p[i], *sp.Add.make_args(f))) for i, f in enumerate(expanded)]
        yield [printable(p[i] + _by_common_factors(f, q)) for i, f in enumerate(expanded)]
        if max(len(f.args) for f in expanded) <= MOST_NESTED:
            for sums, last in itertools.product((False, True), repeat=2):
                yield [_nested(known, p[i], f, sums, last) for i, f in enumerate(expanded)]


def _far(symbols: SymbolicHamiltonian) -> bool:
    """Return True for a V by differences from positions that may be far from 0, like (q − 50)⁴.

    Written by powers of q it would be a small difference of large numbers. Parameters may have any value.
    """
    assert symbols.V is not None
    for u in symbols.V.atoms(sp.Add):
        constant, rest = u.as_independent(*symbols.q, as_Add=True)
        if constant == 0 or rest == 0 or not rest.is_polynomial(*symbols.q):
            continue
        slopes = [sp.diff(rest, s) for s in symbols.q if rest.has(s)]
        if any(slope.has(*symbols.q) for slope in slopes):
            continue
        if constant.free_symbols or abs(constant) > NEAR * max(
            abs(slope) if slope.is_number else 1 for slope in slopes
        ):
            return _degree(symbols.V) > 2
    return False


def _with_products_of_both(symbols: SymbolicHamiltonian, W: sp.Expr) -> Iterator[list[sp.Expr]]:
    """p + ∇W, W a polynomial in two coordinates, by what the derivatives of its mixed terms share.

    Let these terms be (q1 q2)^m/m Σ X with X ∝ q1^k1 q2^k2. Of them ∂W/∂q_i has (q1 q2)^m/q_i (Σ X + Σ k_i/m X): the
    products X serve both momenta, and where k_i = m the rest is sums.
    """
    terms = sp.Poly(W, *symbols.q).terms()
    mixed = {powers: c for powers, c in terms if all(powers)}
    least = {min(powers) for powers in zip(*mixed, strict=True)}
    if len(least) != 1:
        return
    m = least.pop()
    rest = {
        (a - m, b - m): _times(m * c, sp.Mul(*map(sp.Pow, symbols.q, (a - m, b - m)))) for (a, b), c in mixed.items()
    }
    L = sp.Add(*rest.values(), evaluate=False)
    shape = []
    for i, (q, other, p) in enumerate(zip(symbols.q, reversed(symbols.q), symbols.p, strict=True)):
        pure = [(powers[i], c) for powers, c in terms if powers[i] and not powers[1 - i]]
        if any(n < m for n, _ in pure):
            return
        more = [x if k[i] == m else sp.Mul(sp.Rational(k[i], m), x, evaluate=False) for k, x in rest.items() if k[i]]
        both = sp.Mul(other**m, sp.Add(L, *more, evaluate=False), evaluate=False)
        alone = _by_common_factors(sp.Add(*[_times(n * c, q ** (n - m)) for n, c in pure]), [q]) if pure else None
        sums = both if alone is None else sp.Add(alone, both, evaluate=False)
        shape.append(sp.Add(p, sp.Mul(q ** (m - 1), sums, evaluate=False), evaluate=False))
    yield shape


def _nested(known: Mapping[sp.Symbol, float], p: sp.Symbol, f: sp.Expr, sums: bool, last: bool) -> sp.Expr:
    """p + f, an expanded sum, in the form that is known soonest; with `sums`, terms of one coefficient c as c·m·(Σ)."""
    groups: dict[sp.Expr, list[sp.Expr]] = {}
    for term in sp.Add.make_args(f):
        coefficient, function = term.as_independent(*known, as_Add=False)
        number, letters = coefficient.as_content_primitive() if coefficient.free_symbols else (sp.S.One, coefficient)
        groups.setdefault(letters, []).append(number * function)
    if sums:
        groups = {letters: [sp.gcd_terms(sp.Add(*functions))] for letters, functions in groups.items()}
    times = dict(known)
    schedule = Schedule(dict(times), printed)
    stand_ins: dict[sp.Expr, sp.Dummy] = {}

    def stand_in(factor: sp.Expr) -> sp.Expr:
        """A symbol for what is no power of a position."""
        base, exponent = factor.as_base_exp()
        if base in known and exponent.is_Integer and exponent > 0:
            return factor
        if factor not in stand_ins:
            symbol = stand_ins[factor] = sp.Dummy(real=True)
            times[symbol] = schedule.value(factor)[0]
        return stand_ins[factor]

    terms = []
    for letters, functions in groups.items():
        for number, function in map(sp.Expr.as_coeff_Mul, functions):
            terms.append(_times(number * letters, sp.Mul(*map(stand_in, sp.Mul.make_args(function)))))
    return _put_back(nested(p, terms, {p: -FUSED, **times}, last), {symbol: f for f, symbol in stand_ins.items()})


def _put_back(f: sp.Expr, back: dict[sp.Dummy, sp.Expr]) -> sp.Expr:
    """`xreplace` without evaluation."""
    if f in back:
        return back[f]
    return f.func(*[_put_back(a, back) for a in f.args], evaluate=False) if f.has(*back) else f


def _dot(x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
    return sp.Add(*[a * b for a, b in zip(x, y, strict=True)])


def _number(value: float | sp.Expr) -> sp.Expr:
    if isinstance(value, sp.Expr) and value.free_symbols:  # of a parameter
        return value
    return sp.Integer(int(value)) if value == int(value) else sp.Float(value)


def _expanded(f: sp.Expr, q: Sequence[sp.Symbol]) -> sp.Expr:
    """Σ coefficient(b, g, c) · product, what is divided by left as it is."""
    kept: dict[sp.Expr, sp.Dummy] = {}

    def keep(power: sp.Expr) -> sp.Expr:
        return kept.setdefault(power, sp.Dummy(real=True))

    f = f.replace(lambda e: e.is_Pow and e.base.is_Add and not (e.exp.is_Integer and e.exp > 0), keep)
    back: dict[sp.Dummy, sp.Expr] = {}
    for power, dummy in kept.items():  # inner powers come before those that hold them
        back[dummy] = power.xreplace(back)
    terms: dict[sp.Expr, sp.Expr] = {}
    for term in sp.Add.make_args(sp.expand(f)):
        coefficient, product = term.as_independent(*q, *back, as_Add=False)
        terms[product] = terms.get(product, sp.S.Zero) + coefficient
    return sp.Add(*[_times(c, product.xreplace(back)) for product, c in terms.items() if c != 0])


def _work_of_factoring(f: sp.Expr) -> int:
    """The degree of what a sum of slopes is divided by, times how many variables and how many denominators it has.

    The time that SymPy takes to factor the sum grows out of all proportion with it: 0.1 s at 100, 1 s at 200 to 300,
    minutes at 450.
    """
    denominators = _denominators(f)
    return sum(denominators.values()) * len(f.free_symbols) * len(denominators)


def _denominators(f: sp.Expr) -> dict[sp.Expr, int]:
    """The sums that f is divided by, with the degrees of their highest powers."""
    degrees: dict[sp.Expr, int] = {}
    for power in f.atoms(sp.Pow):
        base, exponent = power.as_base_exp()
        if base.is_Add and exponent.is_Rational and exponent < 0:
            degrees[base] = max(degrees.get(base, 0), _degree(base) * int(sp.ceiling(-exponent)))
    return degrees


def _length(f: sp.Expr) -> int:
    """About how many terms f has when it is multiplied out; what is divided by counts as one."""
    if f.is_Add:
        return sum(map(_length, f.args))
    if f.is_Mul:
        return math.prod(map(_length, f.args))
    if f.is_Pow and f.exp.is_Integer and f.exp > 0:
        n = _length(f.base)
        return math.comb(int(f.exp) + n - 1, int(f.exp))
    return 1


def _degree(f: sp.Expr) -> int:
    """The degree of the powers in an expression, 1 for what is not polynomial."""
    if f.is_Add:
        return max(map(_degree, f.args))
    if f.is_Mul:
        return sum(map(_degree, f.args))
    if f.is_Pow and f.exp.is_Integer and f.exp > 0:
        return int(f.exp) * _degree(f.base)
    return int(bool(f.free_symbols))


def _times(coefficient: sp.Expr, product: sp.Expr) -> sp.Expr:
    """Their product, a sum in the coefficient kept together."""
    return (
        sp.Mul(coefficient, *sp.Mul.make_args(product), evaluate=False) if coefficient.is_Add else coefficient * product
    )


def _collected(f: sp.Expr, q: Sequence[sp.Symbol]) -> sp.Expr:
    """A product whose sums are written by their coefficients."""
    return sp.Mul(
        *[_expanded(factor, q) if factor.is_Add else factor for factor in sp.Mul.make_args(f)], evaluate=False
    )


def _by_common_factors(f: sp.Expr, q: Sequence[sp.Symbol]) -> sp.Expr:
    """Horner's form: of the factors of the terms that most of them share, one after the other taken out."""
    terms = sp.Add.make_args(f)
    counts = {s: sum(bool(term.has(s) and (term / s).is_polynomial(s)) for term in terms) for s in q}
    symbol = max(q, key=counts.__getitem__)
    if counts[symbol] < 2:
        return f
    inside: list[sp.Expr] = []
    outside: list[sp.Expr] = []
    for term in terms:
        divisible = term.has(symbol) and (term / symbol).is_polynomial(symbol)
        (inside if divisible else outside).append(_divided(term, symbol) if divisible else term)
    inner = _by_common_factors(sp.Add(*inside), q)
    return sp.Add(sp.Mul(symbol, inner, evaluate=False), _by_common_factors(sp.Add(*outside), q) if outside else 0)


def _divided(term: sp.Expr, symbol: sp.Symbol) -> sp.Expr:
    coefficient, product = term.as_independent(symbol, as_Add=False)
    return _times(coefficient, product / symbol) if coefficient.is_Add else coefficient * (product / symbol)


__all__ = ["kick_cycles", "kicks_source"]
