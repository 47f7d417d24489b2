"""Expressions as straight-line code in an order that suits the machine: short chains for one trajectory.

A single trajectory waits for its longest chain of operations that need each other's results, not for their number; a
batch, whose lanes fill the machine, for their number; on machines that add on units of their own, for the number of
multiplications. `Schedule` writes sums and products, which SymPy holds without
an order, so that what is known early is used early, sums of products as multiplications fused with additions; it
estimates both costs, by which the shapes that one expression may take are compared.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterable, Sequence

import llvmlite.binding
import sympy as sp

from sympflow.kernels.pipeline import Operation

__all__ = ["Schedule"]

ADD, MULTIPLY, FUSED = 3.0, 3.0, 4.0  # cycles from operands to result, on current x86-64 and AArch64 cores
DIVIDE, ROOT, FUNCTION, OTHER = 13.0, 17.0, 60.0, 80.0
THROUGHPUT = {DIVIDE: 10.0, ROOT: 12.0, FUNCTION: 30.0, OTHER: 60.0}
"""What these cost in a batch, in units of an addition."""
SUMS, PRODUCTS, DIVISIONS = "sums", "products", "divisions"  # units
SUMS_ASIDE = llvmlite.binding.get_host_cpu_name().startswith("znver")
"""Whether additions have units of their own, so that beside as many multiplications they cost nothing: AMD's Zen."""
ALWAYS = -1000.0  # when constants are known
MOST_CHAINS = 3  # sums are split into up to so many chains, added at their ends

NAME = re.compile(r"[A-Za-z_]\w*")

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

    Attributes
    ----------
    early, lines : list of str
        The assignments: of what is known always, and of the rest.
    operations : float
        Of the rest, in a batch, in units of an addition; see `SUMS_ASIDE`.
    steps : list of Operation
        The rest, as `sympflow.kernels.pipeline` has it.
    """

    def __init__(
        self,
        known: dict[sp.Symbol, float],
        printed: Callable[[sp.Expr], str],
        prefix: str = "s_",
        fused: str | None = None,
    ) -> None:
        self.early: list[str] = []
        self.lines: list[str] = []
        self._occupied = {SUMS: 0.0, PRODUCTS: 0.0}
        self.steps: list[Operation] = []
        self.ready: dict[str, float] = {symbol.name: time for symbol, time in known.items()}
        self._printed, self._prefix = printed, prefix
        self._fused = "{2} + {0}*{1}" if fused is None else fused + "({0}, {1}, {2})"
        self._names: dict[str, str] = {}
        self._values: dict[sp.Expr, _Item] = {}

    @property
    def operations(self) -> float:
        return max(self._occupied.values()) if SUMS_ASIDE else sum(self._occupied.values())

    def define(self, symbol: sp.Symbol, expression: sp.Expr) -> None:
        """Let the symbol, of a common subexpression, stand for the value of the expression."""
        self._values[symbol] = self.value(expression)

    def value(self, expression: sp.Expr) -> _Item:
        """When the expression is known, and its name."""
        if expression not in self._values:
            self._values[expression] = self._compute(expression)
        return self._values[expression]

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
        if isinstance(f, sp.Function) and len(f.args) == 1:
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
        return self._line(f"{first}*{second}", max(a[0], b[0]), MULTIPLY)

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
        items.sort(key=lambda entry: (entry[0], len(entry[1])))
        best = min(range(1, min(MOST_CHAINS, len(items)) + 1), key=lambda n: (_chains(items, n)[0], n))
        ends: list[_Item] = []
        for chain in _chains(items, best)[1]:
            total: _Item | None = None
            for time, item in chain:
                if total is None:
                    total = item[0] if len(item) == 1 else self._times(*item)
                elif len(item) == 1:
                    total = self._added(total, item[0])
                elif item[0][1] == "-1.0":
                    total = self._line(f"{total[1]} - {item[1][1]}", max(total[0], item[1][0]), ADD, SUMS)
                else:
                    text = self._fused.format(item[0][1], item[1][1], total[1])
                    total = self._line(text, max(total[0], time), FUSED)
            assert total is not None
            heapq.heappush(ends, total)
        while len(ends) > 1:
            heapq.heappush(ends, self._added(heapq.heappop(ends), heapq.heappop(ends)))
        return ends[0]

    def _added(self, a: _Item, b: _Item) -> _Item:
        return self._line(f"{a[1]} + {b[1]}", max(a[0], b[0]), ADD, SUMS)

    def _line(self, text: str, start: float, latency: float, unit: str = PRODUCTS) -> _Item:
        if text not in self._names:
            name = f"{self._prefix}{len(self._names)}"
            (self.lines if start > ALWAYS else self.early).append(f"{name} = {text}")
            self._names[text] = name
            self.ready[name] = start + latency if start > ALWAYS else ALWAYS
            if start > ALWAYS:  # the compiler takes the rest out of loops over lanes
                occupied = THROUGHPUT.get(latency, 1.0)
                self._occupied[SUMS if unit == SUMS else PRODUCTS] += occupied
                operands = tuple(x for x in NAME.findall(text) if x in self.ready)
                self.steps.append(Operation(name, operands, latency, unit, int(occupied)))
        name = self._names[text]
        return self.ready[name], name


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


def _chains(items: Sequence[tuple[float, tuple[_Item, ...]]], n: int) -> tuple[float, list[list]]:
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
            ends[k] = start + (FUSED if len(item) == 2 else ADD) if start > ALWAYS else ALWAYS
        chains[k].append((ready, item))
    ends = sorted(end for end, chain in zip(ends, chains, strict=True) if chain)
    chains = [chain for chain in chains if chain]
    while len(ends) > 1:
        a, b = heapq.heappop(ends), heapq.heappop(ends)
        heapq.heappush(ends, max(a, b) + ADD)
    return ends[0], chains
