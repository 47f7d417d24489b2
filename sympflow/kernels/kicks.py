"""Kicks of a symbolic system as code: of the shapes that their sums may take, the fastest, alone and in a batch."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import sympy as sp

from sympflow.kernels.codegen import printed
from sympflow.kernels.scheduling import FUSED, Schedule
from sympflow.symbolic import SymbolicHamiltonian, printable

__all__ = ["kicks_source"]

PRODUCT = "fused_multiply_add"  # of `elementary`
MOST_OPERATIONS = 400  # of a kick whose shapes are tried: rewriting longer ones takes longer than it saves
MOST_TERMS = 120  # of a sum multiplied out
CROWDED = 0.4  # cycles by which each operation of a single trajectory delays the others, as measured
B, G, C = sp.symbols("b g c", real=True)
UNTOUCHED = (sp.Piecewise, sp.Max, sp.Min, sp.Abs, sp.Heaviside, sp.sign)
"""What holds one of these is taken as it is."""


@dataclass(frozen=True)
class _Kick:
    """One shape of a kick: the body of its function without the lines of its coefficients, and its costs."""

    coefficients: list[str]
    lines: list[str]
    results: list[str]
    latency: float
    operations: float

    @property
    def cycles(self) -> float:
        """From one kick to the next of a single trajectory, a drift between them."""
        return self.latency + CROWDED * self.operations


def kicks_source(symbols: SymbolicHamiltonian, level: int) -> str:
    """The new p after a kick, p − b∇V + g∇²V v − c∇(½ v·∇²V v), v = M⁻¹∇V, each in two shapes, equal but for rounding.

    ``kicked(q, p, table, j)``, from `level` 1 on ``gradient_kicked`` and from 2 on ``curvature_kicked``, are the
    fastest for one trajectory; what depends on b, g and c alone is in row j of the table, which ``fill_coefficients(b,
    g, c, row)`` computes. ``kicked_lane(q, p, b)``, ``gradient_kicked_lane(q, p, b, g)`` and
    ``curvature_kicked_lane(q, p, b, g, c)`` have the fewest operations, for many trajectories at once.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    functions: list[str] = []
    fill: list[str] = []
    stored: list[str] = []
    for terms, name in enumerate(("kicked", "gradient_kicked", "curvature_kicked")[: level + 1], 1):
        numbers = ("b", "g", "c")[:terms]
        shapes = list(_shapes(symbols, terms))
        tried = [_scheduled(symbols, s, f"{name[0]}_", common) for s in shapes for common in (True, False)]
        one = min(tried, key=lambda kick: (kick.cycles, kick.operations))
        many = min(tried, key=lambda kick: (kick.operations, kick.latency))
        used = [n for n in _names(one.coefficients) if any(_mentions(line, n) for line in [*one.lines, *one.results])]
        loads = [f"{n} = table[j, {len(stored) + i}]" for i, n in enumerate(used)]
        fill += one.coefficients
        stored += used
        taken = [v for v in numbers if any(_mentions(line, v) for line in [*one.lines, *one.results])]
        loads += [f"{v} = table[j, -{3 - i}]" for i, v in enumerate(numbers) if v in taken]
        functions.append(_function(symbols, name, "q, p, table, j", [*loads, *one.lines], one.results))
        arguments = ", ".join(("q", "p", *numbers))
        functions.append(_function(symbols, f"{name}_lane", arguments, [*many.coefficients, *many.lines], many.results))
    rows = [*fill, *(f"row[{i}] = {name}" for i, name in enumerate([*stored, "b", "g", "c"]))]
    filled = "\n    ".join(["@njit(**OPTIONS)\ndef fill_coefficients(b, g, c, row):", *rows])
    return "\n\n\n".join([f"N_COEFFICIENTS = {len(stored) + 3}", filled, *functions]) + "\n"


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
    shape = [_numbered(f, {*symbols.q, *symbols.p}, numbers) for f in shape]
    for coefficient, symbol in numbers.items():  # as one: what is common to several would else be taken out of them
        schedule.define(symbol, coefficient)
    if common:
        shared, shape = sp.cse(shape, symbols=sp.numbered_symbols("common_", real=True), list=True, order="none")
        for symbol, expression in shared:
            schedule.define(symbol, expression)
    results = [schedule.value(f) for f in shape]
    latency = max(time for time, _ in results)
    return _Kick(schedule.early, schedule.lines, [name for _, name in results], latency, schedule.operations)


def _numbered(f: sp.Expr, states: set[sp.Symbol], numbers: dict[sp.Expr, sp.Symbol]) -> sp.Expr:
    """The expression with a symbol for the part of each product that depends on b, g and c alone."""
    if not f.args or not f.free_symbols & {B, G, C}:
        return f
    if f.is_Mul:
        fixed = [a for a in f.args if not a.free_symbols & states]
        if any(a.free_symbols for a in fixed) and len(fixed) < len(f.args):
            coefficient = sp.Mul(*fixed)
            if not coefficient.is_Symbol:
                symbol = numbers.setdefault(coefficient, sp.Symbol(f"number_{len(numbers)}", real=True))
                f = sp.Mul(symbol, *[a for a in f.args if a.free_symbols & states], evaluate=False)
    return f.func(*[_numbered(a, states, numbers) for a in f.args], evaluate=False)


def _shapes(symbols: SymbolicHamiltonian, terms: int) -> Iterator[list[sp.Expr]]:
    """Ways to write the new momenta, equal but for rounding, of kicks with one term to three."""
    q, p, d = symbols.q, symbols.p, symbols.ndof
    slope = [sp.diff(symbols.V, s) for s in q]
    if terms == 1:
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
        W = [_dot(slope, velocity) / 2, _dot(velocity, products) / 2][: terms - 1]
        if any(f.has(*UNTOUCHED) or sp.count_ops(f) > MOST_OPERATIONS for f in W):
            return
        W = [sp.factor(sp.powsimp(f)) for f in W]
        changes = [
            -B * slope[i] + sp.Add(*[c * sp.diff(f, q[i]) for c, f in zip((G, -C), W, strict=False)]) for i in range(d)
        ]
    if any(f.has(*UNTOUCHED) or sp.count_ops(f) > MOST_OPERATIONS for f in changes):
        return
    yield [printable(p[i] + f) for i, f in enumerate(changes)]
    factored = [sp.factor(f) for f in changes]
    yield [printable(p[i] + _collected(f, q)) for i, f in enumerate(factored)]
    expanded = [_expanded(f, q) for f in changes]
    if sum(len(f.args) for f in expanded) <= MOST_TERMS:
        yield [printable(sp.Add(p[i], *sp.Add.make_args(f))) for i, f in enumerate(expanded)]
        yield [printable(p[i] + _by_common_factors(f, q)) for i, f in enumerate(expanded)]


def _dot(x: Sequence[sp.Expr], y: Sequence[sp.Expr]) -> sp.Expr:
    return sp.Add(*[a * b for a, b in zip(x, y, strict=True)])


def _number(value: float) -> sp.Expr:
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
    counts = {s: sum(term.has(s) and (term / s).is_polynomial(s) for term in terms) for s in q}
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
