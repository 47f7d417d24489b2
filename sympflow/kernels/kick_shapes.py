"""The ways to write a kick of a symbolic system, equal but for rounding."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import sympy as sp

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, printable
from sympflow.kernels.codegen import printed
from sympflow.kernels.nested import nested
from sympflow.kernels.scheduling import FUSED, Schedule

__all__ = ["B", "C", "G", "polynomial_letters", "shapes"]

MOST_OPERATIONS = 400  # of a kick whose shapes are tried: rewriting longer ones takes longer than it saves
MOST_TERMS = 120  # of a sum multiplied out
MOST_NESTED = 12  # of a momentum's sum that is nested
B, G, C = sp.symbols("b g c", real=True)
UNTOUCHED = (sp.Piecewise, sp.Max, sp.Min, sp.Abs, sp.Heaviside, sp.sign)
"""What holds one of these is taken as it is."""


def polynomial_letters(monomials: Monomials) -> list[sp.Symbol]:
    """e_0, e_1, …, the coefficients of the monomials."""
    return [sp.Symbol(f"e_{m}", real=True) for m in range(len(monomials))]


def shapes(symbols: SymbolicHamiltonian, terms: int, monomials: Monomials = ()) -> Iterator[list[sp.Expr]]:
    """Ways to write the new momenta, equal but for rounding, of kicks with one term to three, or with a polynomial."""
    q, p, d = symbols.q, symbols.p, symbols.ndof
    slope = [sp.diff(symbols.V, s) for s in q]
    if monomials:
        letters = polynomial_letters(monomials)
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
        if max(len(f.args) for f in expanded) <= MOST_NESTED:
            for sums, last in itertools.product((False, True), repeat=2):
                yield [_nested(symbols, p[i], f, sums, last) for i, f in enumerate(expanded)]


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


def _nested(symbols: SymbolicHamiltonian, p: sp.Symbol, f: sp.Expr, sums: bool, last: bool) -> sp.Expr:
    """p + f, an expanded sum, in the form that is known soonest; with `sums`, terms of one coefficient c as c·m·(Σ)."""
    groups: dict[sp.Expr, list[sp.Expr]] = {}
    for term in sp.Add.make_args(f):
        coefficient, function = term.as_independent(*symbols.q, as_Add=False)
        number, letters = coefficient.as_content_primitive() if coefficient.free_symbols else (sp.S.One, coefficient)
        groups.setdefault(letters, []).append(number * function)
    if sums:
        groups = {letters: [sp.gcd_terms(sp.Add(*functions))] for letters, functions in groups.items()}
    times = dict.fromkeys(symbols.q, 0.0)
    schedule = Schedule(dict(times), printed)
    stand_ins: dict[sp.Expr, sp.Dummy] = {}

    def stand_in(factor: sp.Expr) -> sp.Expr:
        """A symbol for what is no power of a position."""
        base, exponent = factor.as_base_exp()
        if base in symbols.q and exponent.is_Integer and exponent > 0:
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
