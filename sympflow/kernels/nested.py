"""Polynomials in the form that is known soonest: nested, what is known late taken in last."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import sympy as sp

from sympflow.kernels.scheduling import ALWAYS, FUSED, MULTIPLY

__all__ = ["nested"]

FEW_TERMS = 8  # of which more ways to split them are tried
MOST_FORMS = 1000  # of sums and parts of them; after so many the next ones are split in one way only

_Powers = tuple[int, ...]
_Term = tuple[_Powers, int]  # exponents, and which coefficient
_Sum = frozenset[_Term]


class _Form(NamedTuple):
    """When a sum is known, at how many operations, and how it is split: m, and the terms that are divided by it."""

    time: float
    operations: float
    split: tuple[_Powers, _Sum] | None = None


def nested(first: sp.Symbol, terms: Iterable[sp.Expr], known: dict[sp.Symbol, float], last: bool = False) -> sp.Expr:
    """`first` + Σ `terms` as nested sums of products m·A + B, of all such forms the one that is known soonest.

    m is a product of arguments, A what is left of terms that it divides, B the other terms. Forms are compared by the
    latencies of `sympflow.kernels.scheduling`, then by their operations.

    Parameters
    ----------
    first : Symbol
    terms : iterable of Expr
        Products of a coefficient and powers of the arguments, whose exponents are positive integers.
    known : dict of Symbol to float
        When `first` and the arguments are known, in cycles; what is not in it is a coefficient, known always.
    last : bool
        Which of equally good forms: the first found, or the last. They share different products with other sums.
    """
    x = [symbol for symbol in known if symbol != first]
    coefficients: list[sp.Expr] = []
    exponents: list[_Powers] = []
    for term in terms:
        coefficient, product = term.as_independent(*x, as_Add=False)
        powers = product.as_powers_dict()
        coefficients.append(coefficient)
        exponents.append(tuple(int(powers.get(s, 0)) for s in x))
    times = [known[s] for s in x]
    few = len(exponents) <= FEW_TERMS
    found: dict[tuple[_Sum, bool], _Form] = {}

    def best(terms: _Sum, with_first: bool) -> _Form:
        key = terms, with_first
        if key not in found:
            tried = list(forms(terms, with_first))
            found[key] = min(reversed(tried) if last else tried, key=lambda form: form[:2])
        return found[key]

    def forms(terms: _Sum, with_first: bool) -> Iterator[_Form]:
        if not any(any(powers) for powers, _ in terms):
            yield _Form(known[first] if with_first else ALWAYS, float(len(terms)))
        elif len(terms) == 1 and not with_first:
            ((powers, _),) = terms
            yield _Form(_product_known(times, powers, ALWAYS), sum(powers))
        else:
            splits = _splits(terms, few)
            for m, inside in splits if len(found) < MOST_FORMS else itertools.islice(splits, 1):
                inner, outside = best(_divided(inside, m), False), terms - inside
                ready = max(inner.time, _product_known(times, m))
                operations = inner.operations + (1.0 if sum(m) == 1 else 1.5)  # a product of x may be shared
                if outside or with_first:
                    rest = best(outside, with_first)
                    ready = max(ready, rest.time)
                    yield _Form(ready + FUSED if ready > ALWAYS else ALWAYS, operations + rest.operations, (m, inside))
                else:
                    yield _Form(ready + MULTIPLY, operations, (m, inside))

    def built(terms: _Sum, with_first: bool) -> sp.Expr:
        split = best(terms, with_first).split
        if split is None:
            values = [_times(coefficients[i], _monomial(x, n)) for n, i in sorted(terms)]
            return sp.Add(*([first] if with_first else []), *values, evaluate=len(values) > 1)
        m, inside = split
        product = _times(built(_divided(inside, m), False), _monomial(x, m))
        if inside == terms and not with_first:
            return product
        return sp.Add(*sp.Add.make_args(built(terms - inside, with_first)), product, evaluate=False)

    return built(frozenset(zip(exponents, range(len(exponents)), strict=True)), True)


def _splits(terms: _Sum, few: bool) -> Iterator[tuple[_Powers, _Sum]]:
    """Each m with all terms that it divides and, of few terms, with those of them that another m does not divide."""
    divisors = {m for powers, _ in terms for m in itertools.product(*(range(n + 1) for n in powers)) if any(m)}
    divided = {m: frozenset(t for t in terms if all(map(int.__ge__, t[0], m))) for m in sorted(divisors)}
    for m, all_of_them in divided.items():
        sums = {all_of_them: None}  # a set in order
        if few:
            sums |= dict.fromkeys(all_of_them - others for others in divided.values())
        for inside in sums:
            if inside:
                yield m, inside


def _divided(terms: _Sum, m: _Powers) -> _Sum:
    return frozenset((tuple(map(int.__sub__, powers, m)), i) for powers, i in terms)


def _product_known(times: Sequence[float], powers: Sequence[int], *others: float) -> float:
    """When the product of these powers of arguments known at `times`, and of others, is."""
    factors = sorted([*others, *(time for time, n in zip(times, powers, strict=True) for _ in range(n))])
    while len(factors) > 1:
        _, later, *factors = factors
        bisect.insort(factors, later + MULTIPLY)
    return factors[0]


def _monomial(x: Sequence[sp.Symbol], powers: _Powers) -> sp.Expr:
    return sp.Mul(*[s**n for s, n in zip(x, powers, strict=True)])


def _times(f: sp.Expr, monomial: sp.Expr) -> sp.Expr:
    return f if monomial == 1 else sp.Mul(f, *sp.Mul.make_args(monomial), evaluate=False)
