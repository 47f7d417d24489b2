"""Kicks of a symbolic system as code: of the shapes that their sums may take, the fastest, alone and in a batch."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.kernels.codegen import printed
from sympflow.kernels.kick_shapes import polynomial_letters, shapes
from sympflow.kernels.pipeline import Operation, cycles_per_turn
from sympflow.kernels.scheduling import FUSED, PRODUCTS, Schedule

__all__ = ["kick_cycles", "kicks_source"]

PRODUCT = "fused_multiply_add"  # of `elementary`
MOST_KEPT = 200  # sources
BEST, MOST_MIXED = 3, 2  # shapes that are mixed, and momenta up to which they are
BEFORE = "before_"  # the name of a position before a drift begins with it


@dataclass(frozen=True)
class _Kick:
    """One shape of a kick: the body of its function without the lines of its coefficients, and its costs.

    These are the cycles from one kick of a single trajectory to the next, a drift between them, and the operations, in
    units of an addition, that a batch pays.
    """

    coefficients: list[str]
    lines: list[str]
    results: list[str]
    cycles: float
    operations: float


def kicks_source(symbols: SymbolicHamiltonian, level: int, monomials: Monomials = ()) -> str:
    """The new p after a kick, p − b∇V + g∇²V v − c∇(½ v·∇²V v), v = M⁻¹∇V, each in two shapes, equal but for rounding.

    ``kicked(q, p, table, j)``, from `level` 1 on ``gradient_kicked`` and from 2 on ``curvature_kicked``, are the
    fastest for one trajectory; what depends on b, g and c alone is in row j of the table, which ``fill_coefficients(b,
    g, c, row)`` computes. ``kicked_lane(q, p, b)``, ``gradient_kicked_lane(q, p, b, g)`` and
    ``curvature_kicked_lane(q, p, b, g, c)`` have the fewest operations, for many at once; ``drifted(q, p, a)``
    is for both. With monomials there are ``polynomial_kicked`` and ``polynomial_kicked_lane(q, p, b, c)`` alone, c
    the coefficients of the polynomial.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    key = symbols.H, level, monomials
    if key not in _SOURCES:
        if len(_SOURCES) >= MOST_KEPT:
            del _SOURCES[next(iter(_SOURCES))]
        _SOURCES[key] = _source(symbols, level, monomials)
    return _SOURCES[key]


def kick_cycles(symbols: SymbolicHamiltonian, level: int) -> float:
    """Cycles of a kick and the drift before it in a single trajectory, as its terms are first written down.

    That is not the fastest way to write them, for which the compiler looks much longer (`kicks_source`); but
    kicks of one system with more or fewer terms compare alike.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
    level : int
        0 for the force alone, 1 with a force gradient, 2 with a curvature term too.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    shape = next(iter(shapes(symbols, level + 1)))
    return min(_scheduled(symbols, shape, "kick_", common).cycles for common in (True, False))


_SOURCES: dict[tuple[sp.Expr, int, Monomials], str] = {}
"""By H: systems are often made again, and the search takes a tenth of a second or more."""


def _source(symbols: SymbolicHamiltonian, level: int, monomials: Monomials) -> str:
    functions: list[str] = []
    fill: list[str] = []
    stored: list[str] = []
    letters = [e.name for e in polynomial_letters(monomials)]
    unpacked = [f"{e} = c[{m}]" for m, e in enumerate(letters)]
    kept = ["b", *letters] if monomials else ["b", "g", "c"]
    names = ("kicked", "gradient_kicked", "curvature_kicked")[: level + 1] if not monomials else ("polynomial_kicked",)
    for terms, name in enumerate(names, 1):
        tried = _tried(symbols, terms, f"{name[0]}_", monomials)
        one = min(tried, key=lambda kick: (kick.cycles, kick.operations))
        many = min(tried, key=lambda kick: (kick.operations, kick.cycles))
        used = [n for n in _names(one.coefficients) if any(_mentions(line, n) for line in [*one.lines, *one.results])]
        loads = [f"{n} = table[j, {len(stored) + i}]" for i, n in enumerate(used)]
        fill += one.coefficients
        stored += used
        taken = [v for v in kept if any(_mentions(line, v) for line in [*one.lines, *one.results])]
        loads += [f"{v} = table[j, -{len(kept) - kept.index(v)}]" for v in taken]
        functions.append(_function(symbols, name, "q, p, table, j", [*loads, *one.lines], one.results))
        arguments = ", ".join(("q", "p", *(("b", "c") if monomials else kept[:terms])))
        lines = [*unpacked, *many.coefficients, *many.lines]
        functions.append(_function(symbols, f"{name}_lane", arguments, lines, many.results))
    rows = [*unpacked, *fill, *(f"row[{i}] = {name}" for i, name in enumerate([*stored, *kept]))]
    filled = "\n    ".join(["@njit(**OPTIONS)\ndef fill_coefficients(b, g, c, row):", *rows])
    drifts = _drift_source(symbols)
    return "\n\n\n".join([f"N_COEFFICIENTS = {len(stored) + len(kept)}", filled, *functions, drifts]) + "\n"


def _drift_source(symbols: SymbolicHamiltonian) -> str:
    """``drifted(q, p, a)``, q + a M⁻¹p or q + a∇T, the products with a, for which no state waits, made first."""
    M, d = symbols.inverse_mass, symbols.ndof
    if M is None:
        lines = ["v = drift(p, a, None)"]
        moved = [f"{s} + v[{i}]" for i, s in enumerate(symbols.q)]
    else:
        lines, moved = [], []
        for i in range(d):
            at = symbols.q[i].name
            for j in range(d):
                if M[i, j] != 0:
                    factor = "a" if M[i, j] == 1 else f"(a*{float(M[i, j])!r})"
                    at = f"{PRODUCT}({factor}, {symbols.p[j]}, {at})"
            moved.append(at)
    return _function(symbols, "drifted", "q, p, a", lines, moved)


def _names(assignments: Sequence[str]) -> list[str]:
    return [line.partition(" = ")[0] for line in assignments]


def _mentions(code: str, name: str) -> bool:
    return re.search(rf"\b{name}\b", code) is not None


def _function(
    symbols: SymbolicHamiltonian, name: str, arguments: str, lines: Sequence[str], results: Sequence[str]
) -> str:
    unpacked = [f"{', '.join(s.name for s in v)}, = {x}" for v, x in ((symbols.q, "q"), (symbols.p, "p"))]
    returned = f"return ({''.join(f'{value}, ' for value in results)})"
    return "\n    ".join([f"@njit(**OPTIONS, forceinline=True)\ndef {name}({arguments}):", *unpacked, *lines, returned])


def _scheduled(symbols: SymbolicHamiltonian, shape: Sequence[sp.Expr], prefix: str, common: bool = True) -> _Kick:
    """The shape as code. Momenta are known before positions, whose drift waited for them.

    Without `common` only whole factors and terms are shared, not products within products, which may be known later.
    """
    known = {**dict.fromkeys(symbols.q, 0.0), **dict.fromkeys(symbols.p, -FUSED)}
    schedule = Schedule(known, printed, prefix, PRODUCT)
    numbers: dict[sp.Expr, sp.Symbol] = {}
    states = {*symbols.q, *symbols.p}
    shape = [_numbered(f, states, numbers) for f in shape]
    for coefficient, symbol in numbers.items():  # as one: what is common to several would else be taken out of them
        schedule.define(symbol, coefficient)
    if common:
        shared, shape = sp.cse(shape, symbols=sp.numbered_symbols("common_", real=True), list=True, order="none")
        for symbol, expression in shared:
            schedule.define(symbol, expression)
    results = [schedule.value(f)[1] for f in shape]
    turn = [*_drift(symbols), *schedule.steps]
    carried = {f"{BEFORE}{s}": s.name for s in symbols.q} | dict(zip((s.name for s in symbols.p), results, strict=True))
    return _Kick(schedule.early, schedule.lines, results, cycles_per_turn(turn, carried), schedule.operations)


def _drift(symbols: SymbolicHamiltonian) -> list[Operation]:
    """The drift that comes before a kick."""
    operations = []
    for q, p in zip(symbols.q, symbols.p, strict=True):
        velocity = sp.diff(symbols.T, p)
        moving = [s.name for s in symbols.p if s == p or velocity.has(s)]
        at = f"{BEFORE}{q}"
        for i, moved in enumerate(moving, 1):
            name = q.name if i == len(moving) else f"{BEFORE}{q}_{i}"
            operations.append(Operation(name, (at, moved), FUSED, PRODUCTS))
            at = name
    return operations


def _tried(symbols: SymbolicHamiltonian, terms: int, prefix: str, monomials: Monomials) -> list[_Kick]:
    """Every shape; and of the best, every choice of one for each momentum."""

    def both(shape: Sequence[sp.Expr]) -> list[_Kick]:
        return [_scheduled(symbols, shape, prefix, common) for common in (True, False)]

    made = [(shape, both(shape)) for shape in shapes(symbols, terms, monomials)]
    made.sort(key=lambda entry: min((kick.cycles, kick.operations) for kick in entry[1]))
    kicks = [kick for _, each in made for kick in each]
    best = [shape for shape, _ in made[:BEST]]
    if 1 < symbols.ndof <= MOST_MIXED:
        mixed = dict.fromkeys(itertools.product(*zip(*best, strict=True)))  # a set in order
        kicks += [kick for shape in mixed if list(shape) not in best for kick in both(shape)]
    return kicks


def _numbered(f: sp.Expr, states: set[sp.Symbol], numbers: dict[sp.Expr, sp.Symbol]) -> sp.Expr:
    """The expression with a symbol for the part of each product that depends on b, g and c, or b and e, alone."""
    if not f.args or not f.free_symbols - states:
        return f
    if f.is_Mul:
        fixed = [a for a in f.args if not a.free_symbols & states]
        if any(a.free_symbols for a in fixed) and len(fixed) < len(f.args):
            coefficient = sp.Mul(*fixed)
            if not coefficient.is_Symbol:
                symbol = numbers.setdefault(coefficient, sp.Symbol(f"number_{len(numbers)}", real=True))
                f = sp.Mul(symbol, *[a for a in f.args if a.free_symbols & states], evaluate=False)
    return f.func(*[_numbered(a, states, numbers) for a in f.args], evaluate=False)
