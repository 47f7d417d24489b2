"""Expressions as straight-line code in an order that suits the machine: short chains for one trajectory.

A single trajectory waits for its longest chain of operations that need each other's results, not for their number; a
batch, whose lanes fill the machine, for their number. `Schedule` writes sums and products, which SymPy holds without
an order, so that what is known early is used early, sums of products as multiplications fused with additions; it
estimates both costs, by which the shapes that one expression may take are compared.
"""

from __future__ import annotations

import bisect
import heapq
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from typing import NamedTuple

import sympy as sp

__all__ = ["Schedule", "nested"]

ADD, MULTIPLY, FUSED = 3.0, 3.0, 4.0  # cycles from operands to result, on current x86-64 and AArch64 cores
DIVIDE, ROOT, FUNCTION, OTHER = 13.0, 17.0, 60.0, 80.0
THROUGHPUT = {DIVIDE: 10.0, ROOT: 12.0, FUNCTION: 30.0, OTHER: 60.0}
"""Their cost in a batch, in units of an addition."""
SUMS, PRODUCTS, DIVISIONS = "sums", "products", "divisions"  # units
ALWAYS = -1000.0  # when constants are known
UNITS = 2  # that start a multiplication each cycle, and as many for additions, on current x86-64 cores
MOST_AHEAD = 5  # operations of a value that `Schedule.moved` takes apart
BETWEEN_STAGES, OVERLAPPED, MANY = 2.0, 1.3, 20.0
"""Costs of overlapping stages: cycles added to the longest chain, operations a cycle, and what these delay the
chain; a fit to measured kicks of 11 to 33 operations."""
MOST_CHAINS = 3  # sums are split into up to so many chains, added at their ends
FEW_TERMS = 8  # of a polynomial, of which more ways to split it are tried
MOST_FORMS = 1000  # of sums and parts of them; after so many the next ones are split in one way only

_Item = tuple[float, str]  # when a value is known, and its name or literal


class Schedule:
    """Lines of code that compute expressions, each value once.

    Parameters
    ----------
    known : dict of Symbol to float
        When the arguments are known, in cycles; what is not in it is known always.
    printed : callable
        Source text of a SymPy expression, for what is neither a sum, a product nor a power.
    prefix : str
        Names of the values begin with it.
    fused : str, optional
        The function of a, b and c that is a·b + c, where the compiler is not to choose what is fused: of a sum of two
        products it takes either for c, the one known late as well, and a product that is used twice it fuses nowhere.
    few : bool
        Write sums with few operations, as one chain each, however long these become: for many trajectories at once.

    add : float
        Cycles of a sum of two.

    Attributes
    ----------
    early, lines : list of str
        The assignments: of what is known always, and of the rest.
    busy : dict of str to float
        How long the rest occupies units of each kind, in cycles of one unit.
    """

    def __init__(
        self,
        known: dict[sp.Symbol, float],
        printed: Callable[[sp.Expr], str],
        prefix: str = "s_",
        fused: str | None = None,
        few: bool = False,
        add: float = ADD,
    ) -> None:
        self.early: list[str] = []
        self.lines: list[str] = []
        self.busy = {SUMS: 0.0, PRODUCTS: 0.0, DIVISIONS: 0.0}
        self.ready: dict[str, float] = {symbol.name: time for symbol, time in known.items()}
        self._printed, self._prefix, self._few, self._add = printed, prefix, few, add
        self._fused = "{2} + {0}*{1}" if fused is None else fused + "({0}, {1}, {2})"
        self._names: dict[str, str] = {}
        self._values: dict[sp.Expr, _Item] = {}
        self._made_of: dict[str, tuple[tuple[_Item, ...], tuple[_Item, ...]]] = {}  # factors, and what is added

    @property
    def operations(self) -> float:
        """The cost of the lines in a batch, in units of an addition."""
        return sum(self.busy.values())

    def cycles(self, results: Iterable[str]) -> float:
        """The cost of the lines in one trajectory: the time that these results wait, or that units are busy."""
        return max([*(self.ready.get(name, ALWAYS) for name in results), *(n / UNITS for n in self.busy.values())])

    def paced(self, results: Iterable[str]) -> float:
        """The cost of the lines in one trajectory whose stages overlap: of the chains and of the operations.

        Where a chain is hardly longer than the units are busy, it waits for what else these have begun.
        """
        return _paced(max(self.ready.get(name, ALWAYS) for name in results), self.operations)

    def define(self, symbol: sp.Symbol, expression: sp.Expr) -> None:
        """Let the symbol, of a common subexpression, stand for the value of the expression."""
        self._values[symbol] = self.value(expression)

    def value(self, expression: sp.Expr) -> _Item:
        """When the expression is known, and its name."""
        if expression not in self._values:
            self._values[expression] = self._compute(expression)
        return self._values[expression]

    def moved(self, places: Sequence[tuple[str, Sequence[tuple[str, str]]]]) -> list[str]:
        """x + Σ factor·value for each (x, [(factor, value), …]), by names, known early.

        Where a value is made as a·b + c, x + factor·value is (factor·a)·b + (x + factor·c) as well, which does not wait
        for the value. Numbers alone are never multiplied by the factor before: their product would be rounded alike in
        each step, and the errors would add up.
        """
        found = []
        for x, terms in places:
            plans = [_Plan(self.ready.get(x, ALWAYS), 0.0, partial(self._item, x))]
            for factor, value in sorted(terms, key=lambda term: self._item(term[1])):
                plans = _best(p for plan in plans for p in self._plans(plan, factor, self._item(value)))
            found.append(plans)
        begun, ways = self.operations, []
        for by in {plan.time for plans in found for plan in plans}:
            if all(plans[0].time <= by for plans in found):
                way = [max((p for p in plans if p.time <= by), key=lambda p: p.time) for plans in found]
                ways.append((_paced(by, begun + sum(plan.operations for plan in way)), by, way))
        return [plan.written()[1] for plan in min(ways, key=lambda way: way[:2])[2]]

    def _item(self, name: str) -> _Item:
        return self.ready.get(name, ALWAYS), name

    def _plans(self, base: _Plan, factor: str, value: _Item, depth: int = MOST_AHEAD) -> list[_Plan]:
        """Ways to write base + factor·value."""
        return _best(self._all_plans(base, factor, value, depth))

    def _all_plans(self, base: _Plan, factor: str, value: _Item, depth: int) -> Iterator[_Plan]:
        scale = ALWAYS, factor

        def after(start: _Plan, a: Callable[[], _Item], b: _Item, operations: float, *times: float) -> _Plan:
            time = max(start.time, b[0], *times) + FUSED
            return _Plan(time, start.operations + operations, lambda: self._fused_sum(a(), b, start.written()))

        yield after(base, lambda: scale, value, 1.0)
        factors, added = self._made_of.get(value[1], ((), ()))
        if not depth:
            return
        for one, other in itertools.permutations(factors or added, 2):
            if not factors:
                for plan in self._plans(base, factor, one, depth - 1):
                    yield from self._plans(plan, factor, other, depth - 1)
            elif one[0] > ALWAYS:
                starts = self._plans(base, factor, added[0], depth - 1) if added else [base]
                for plan in starts:
                    yield after(plan, partial(self._times, scale, one), other, 2.0, one[0] + MULTIPLY)

    def _compute(self, f: sp.Expr) -> _Item:
        if f.is_Symbol:
            return self.ready.get(f.name, ALWAYS), f.name
        if f.is_number:
            return ALWAYS, self._printed(f)
        if f.is_Add:
            return self._sum(f.args)
        if f.is_Mul:
            return self._product([self.value(factor) for factor in _factors(f)])
        if f.is_Pow:
            return self._power(f.base, f.exp, f)
        if isinstance(f, sp.Function) and len(f.args) == 1 and not isinstance(f, sp.Piecewise):
            time, name = self.value(f.args[0])
            text = self._printed(f.func(sp.Symbol(name, real=True), evaluate=False)) if f.args[0] != 0 else ""
            return self._line(text or self._printed(f), time, FUNCTION)
        return self._whole(f)

    def _whole(self, f: sp.Expr) -> _Item:
        """Printed as it stands, its symbols put in place."""
        values = {s: self.value(s) for s in f.free_symbols}
        text = self._printed(f.xreplace({s: sp.Symbol(name, real=True) for s, (_, name) in values.items()}))
        return self._line(text, max([time for time, _ in values.values()], default=ALWAYS), OTHER)

    def _power(self, base: sp.Expr, exponent: sp.Expr, f: sp.Expr) -> _Item:
        """xⁿ by squares, 1/xⁿ as (1/x)ⁿ; half a power by a root, which waits for no division."""
        if not exponent.is_Rational or exponent.q > 2 or abs(exponent) > 16:
            return self._whole(f)
        x = self.value(base)
        n = int(sp.floor(exponent))
        factors: list[_Item] = []
        if exponent.q == 2:
            factors.append(self._line(f"math.sqrt({x[1]})", x[0], ROOT, DIVISIONS))
        if n > 0:
            factors.append(self._whole_power(x, n))
        elif n < 0:
            inverse = self._line(f"1.0/{x[1]}", x[0], DIVIDE, DIVISIONS)
            factors.append(self._whole_power(inverse, -n))
        return self._product(factors) if factors else (ALWAYS, "1.0")

    def _whole_power(self, x: _Item, n: int) -> _Item:
        if n == 1:
            return x
        return self._times(self._whole_power(x, n - n // 2), self._whole_power(x, n // 2))

    def _times(self, a: _Item, b: _Item) -> _Item:
        for one, other in ((a, b), (b, a)):
            if one[1] == "1.0":
                return other
        first, second = sorted((a[1], b[1]))
        product = self._line(f"{first}*{second}", max(a[0], b[0]), MULTIPLY)
        self._made_of.setdefault(product[1], ((a, b), ()))
        return product

    def _pair(self, factors: Sequence[_Item]) -> tuple[_Item, _Item] | tuple[_Item]:
        """The product of factors as one of two, those known first multiplied first."""
        heap = sorted(factors)
        while len(heap) > 2:
            a, b = heapq.heappop(heap), heapq.heappop(heap)
            heapq.heappush(heap, self._times(a, b))
        return tuple(sorted(heap))  # type: ignore[return-value]

    def _product(self, factors: Sequence[_Item]) -> _Item:
        pair = self._pair(factors)
        return pair[0] if len(pair) == 1 else self._times(*pair)

    def _sum(self, terms: Iterable[sp.Expr]) -> _Item:
        """Σ as chains of multiplications fused with additions, what is known first at their beginnings."""
        items: list[tuple[float, tuple[_Item, ...]]] = []
        for term in terms:
            if term in self._values or not term.is_Mul:
                item: tuple[_Item, ...] = (self.value(term),)
            else:
                item = self._pair([self.value(factor) for factor in _factors(term)])
                if item[0][1] == "1.0":
                    item = item[1:]
            items.append((max(time for time, _ in item), item))
        if self._few:  # what is no product begins the chain, so that all products are fused
            items.sort(key=lambda entry: (len(entry[1]), entry[0]))
        else:
            items.sort(key=lambda entry: (entry[0], len(entry[1])))
        most = 1 if self._few else min(MOST_CHAINS, len(items))
        best = min(range(1, most + 1), key=lambda n: (_chains(items, n, self._add)[0], n))
        ends: list[_Item] = []
        for chain in _chains(items, best, self._add)[1]:
            total: _Item | None = None
            for _, item in chain:
                if total is None:
                    total = item[0] if len(item) == 1 else self._times(*item)
                elif len(item) == 1:
                    total = self._added(total, item[0])
                elif item[0][1] == "-1.0":
                    total = self._line(f"{total[1]} - {item[1][1]}", max(total[0], item[1][0]), self._add, SUMS)
                else:
                    total = self._fused_sum(item[0], item[1], total)
            assert total is not None
            heapq.heappush(ends, total)
        while len(ends) > 1:
            heapq.heappush(ends, self._added(heapq.heappop(ends), heapq.heappop(ends)))
        return ends[0]

    def _added(self, a: _Item, b: _Item) -> _Item:
        total = self._line(f"{a[1]} + {b[1]}", max(a[0], b[0]), self._add, SUMS)
        self._made_of.setdefault(total[1], ((), (a, b)))
        return total

    def _fused_sum(self, a: _Item, b: _Item, c: _Item) -> _Item:
        """a·b + c."""
        total = self._line(self._fused.format(a[1], b[1], c[1]), max(a[0], b[0], c[0]), FUSED)
        self._made_of.setdefault(total[1], ((a, b), (c,)))
        return total

    def _line(self, text: str, start: float, latency: float, unit: str = PRODUCTS) -> _Item:
        if text not in self._names:
            name = f"{self._prefix}{len(self._names)}"
            (self.lines if start > ALWAYS else self.early).append(f"{name} = {text}")
            self._names[text] = name
            self.ready[name] = start + latency if start > ALWAYS else ALWAYS
            if start > ALWAYS:  # the compiler takes the rest out of loops over lanes
                self.busy[unit] += THROUGHPUT.get(latency, 1.0)
        name = self._names[text]
        return self.ready[name], name


class _Plan(NamedTuple):
    """A way to make a value: when it is known, at how many operations, and what writes its lines."""

    time: float
    operations: float
    written: Callable[[], _Item]


def _paced(time: float, operations: float) -> float:
    return max(time + BETWEEN_STAGES, operations / OVERLAPPED) + operations / MANY


def _best(plans: Iterable[_Plan]) -> list[_Plan]:
    """The plans to which no other is equal or better in both costs, the one known soonest first."""
    best: list[_Plan] = []
    for plan in sorted(plans, key=lambda plan: plan[:2]):
        if not best or plan.operations < best[-1].operations:
            best.append(plan)
    return best


def _factors(product: sp.Expr) -> list[sp.Expr]:
    """Factors, small powers as such of their own: the ones that are known early go with the coefficient."""
    factors: list[sp.Expr] = []
    for factor in sp.Mul.make_args(product):
        base, exponent = factor.as_base_exp()
        if base.is_Symbol and exponent.is_Integer and 2 <= exponent <= 4:
            factors += [base] * int(exponent)
        else:
            factors.append(factor)
    return factors


def _chains(items: Sequence[tuple[float, tuple[_Item, ...]]], n: int, add: float) -> tuple[float, list[list]]:
    """When the sum is known if it is dealt out to n chains, and these."""
    chains: list[list] = [[] for _ in range(n)]
    ends = [ALWAYS] * n
    for ready, item in items:
        # The latest chain that does not make the item wait, else the one that is free first.
        free = [k for k in range(n) if ends[k] <= ready]
        k = max(free, key=lambda k: (bool(chains[k]), ends[k])) if free else min(range(n), key=ends.__getitem__)
        if not chains[k]:
            ends[k] = ready + (MULTIPLY if len(item) == 2 and ready > ALWAYS else 0.0)
        else:
            start = max(ends[k], ready)
            ends[k] = start + (FUSED if len(item) == 2 else add) if start > ALWAYS else ALWAYS
        chains[k].append((ready, item))
    ends = sorted(end for end, chain in zip(ends, chains, strict=True) if chain)
    chains = [chain for chain in chains if chain]
    while len(ends) > 1:
        a, b = heapq.heappop(ends), heapq.heappop(ends)
        heapq.heappush(ends, max(a, b) + add)
    return ends[0], chains


# polynomials in the form that is known soonest: nested, what is known late taken in last -------------------------

_Term = tuple[int, int]  # exponents, packed, and which coefficient
_Sum = frozenset[_Term]


class _Packing:
    """Exponents of a product, each less than `most`, as digits of one number, with a bit to spare above each.

    Numbers are in the order of the exponents, and a product over one that divides it is their difference.
    """

    def __init__(self, most: int, length: int) -> None:
        self._shifts = [k * (most.bit_length() + 1) for k in reversed(range(length))]
        self._mask = (1 << most.bit_length()) - 1
        self._spare = sum((self._mask + 1) << shift for shift in self._shifts)

    def packed(self, exponents: Iterable[int]) -> int:
        return sum(n << shift for n, shift in zip(exponents, self._shifts, strict=True))

    def exponents(self, powers: int) -> list[int]:
        return [powers >> shift & self._mask for shift in self._shifts]

    def divides(self, m: int, powers: int) -> bool:
        return (powers | self._spare) - m & self._spare == self._spare  # no digit borrows

    def divisors(self, powers: int) -> Iterator[int]:
        """All but 1."""
        choices = [
            range(0, (n + 1) << shift, 1 << shift)
            for n, shift in zip(self.exponents(powers), self._shifts, strict=True)
        ]
        return filter(None, map(sum, itertools.product(*choices)))


class _Form(NamedTuple):
    """When a sum is known, at how many operations, and how it is split: m, and the terms that are divided by it."""

    time: float
    operations: float
    split: tuple[int, _Sum] | None = None


def nested(
    first: sp.Symbol | None, terms: Iterable[sp.Expr], known: dict[sp.Symbol, float], last: bool = False
) -> sp.Expr:
    """`first`, if any, + Σ `terms` as nested sums of products m·A + B, of all such forms the one that is known soonest.

    m is a product of arguments, A what is left of terms that it divides, B the other terms. Forms are compared by the
    latencies of these operations, then by their operations.

    Parameters
    ----------
    first : Symbol or None
    terms : iterable of Expr
        Products of a coefficient and powers of the arguments, whose exponents are positive integers.
    known : dict of Symbol to float
        When `first` and the arguments are known, in cycles; what is not in it is a coefficient, known always.
    last : bool
        Take the last of equally good forms, not the first. They share different products with other sums.
    """
    x = [symbol for symbol in known if symbol != first]
    coefficients: list[sp.Expr] = []
    exponents: list[tuple[int, ...]] = []
    for term in terms:
        coefficient, product = term.as_independent(*x, as_Add=False)
        powers = product.as_powers_dict()
        coefficients.append(coefficient)
        exponents.append(tuple(int(powers.get(s, 0)) for s in x))
    times = [known[s] for s in x]
    packing = _Packing(1 + max((n for powers in exponents for n in powers), default=0), len(x))
    few = len(exponents) <= FEW_TERMS
    found: dict[tuple[_Sum, bool], _Form] = {}
    splits_of = cache(partial(_splits, packing=packing, few=few))
    degree = cache(lambda powers: sum(packing.exponents(powers)))
    product_known = cache(lambda powers, *others: _product_known(times, packing.exponents(powers), *others))

    def best(terms: _Sum, with_first: bool) -> _Form:
        key = terms, with_first
        if key not in found:
            tried = list(forms(terms, with_first))
            found[key] = min(reversed(tried) if last else tried, key=lambda form: form[:2])
        return found[key]

    def forms(terms: _Sum, with_first: bool) -> Iterator[_Form]:
        if not any(powers for powers, _ in terms):
            yield _Form(known[first] if with_first and first is not None else ALWAYS, float(len(terms)))
        elif len(terms) == 1 and not with_first:
            ((powers, _),) = terms
            yield _Form(product_known(powers, ALWAYS), degree(powers))
        else:
            splits = splits_of(terms)
            for m, inside in splits if len(found) < MOST_FORMS else splits[:1]:
                inner, outside = best(_divided(inside, m), False), terms - inside
                ready = max(inner.time, product_known(m))
                operations = inner.operations + (1.0 if degree(m) == 1 else 1.5)  # a product of x may be shared
                if outside or with_first:
                    rest = best(outside, with_first)
                    ready = max(ready, rest.time)
                    yield _Form(ready + FUSED if ready > ALWAYS else ALWAYS, operations + rest.operations, (m, inside))
                else:
                    yield _Form(ready + MULTIPLY, operations, (m, inside))

    def monomial(powers: int) -> sp.Expr:
        return sp.Mul(*[s**n for s, n in zip(x, packing.exponents(powers), strict=True)])

    def built(terms: _Sum, with_first: bool) -> sp.Expr:
        split = best(terms, with_first).split
        if split is None:
            values = [_times(coefficients[i], monomial(n)) for n, i in sorted(terms)]
            return sp.Add(*([first] if with_first else []), *values, evaluate=len(values) > 1)
        m, inside = split
        product = _times(built(_divided(inside, m), False), monomial(m))
        if inside == terms and not with_first:
            return product
        return sp.Add(*sp.Add.make_args(built(terms - inside, with_first)), product, evaluate=False)

    return built(frozenset(zip(map(packing.packed, exponents), range(len(exponents)), strict=True)), first is not None)


def _splits(terms: _Sum, packing: _Packing, few: bool) -> list[tuple[int, _Sum]]:
    """Each m with all terms that it divides and, of few terms, with those of them that another m does not divide."""
    divisors = {m for powers, _ in terms for m in packing.divisors(powers)}
    divided = {m: frozenset(t for t in terms if packing.divides(m, t[0])) for m in sorted(divisors)}
    splits: list[tuple[int, _Sum]] = []
    for m, all_of_them in divided.items():
        sums = {all_of_them: None}  # a set in order
        if few:
            sums |= dict.fromkeys(all_of_them - others for others in divided.values())
        splits += [(m, inside) for inside in sums if inside]
    return splits


def _divided(terms: _Sum, m: int) -> _Sum:
    return frozenset((powers - m, i) for powers, i in terms)


def _product_known(times: Sequence[float], powers: Sequence[int], *others: float) -> float:
    """When the product of these powers of arguments known at `times`, and of others, is."""
    factors = sorted([*others, *(time for time, n in zip(times, powers, strict=True) for _ in range(n))])
    while len(factors) > 1:
        _, later, *factors = factors
        bisect.insort(factors, later + MULTIPLY)
    return factors[0]


def _times(f: sp.Expr, monomial: sp.Expr) -> sp.Expr:
    return f if monomial == 1 else sp.Mul(f, *sp.Mul.make_args(monomial), evaluate=False)
