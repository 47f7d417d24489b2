"""Dual numbers: values with their rates of change, which functions of them have too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sympflow.compiler.control import Rows
from sympflow.compiler.functions import FUNCTIONS, apply, fma
from sympflow.compiler.numbers import Number

__all__ = ["Dual", "DualRows"]


class Dual(Number):
    """A number and its rate, both numbers of another kind, or a float."""

    __slots__ = ("rate", "value")

    def __init__(self, value: Any, rate: Any) -> None:
        self.value, self.rate = value, rate

    def apply(self, name: str, args: Sequence[Any]) -> Any:
        values = [x.value if isinstance(x, Dual) else x for x in args]
        y, rule = apply(name, *values), FUNCTIONS[name].partials
        total: Any = 0.0
        if rule is not None:
            terms = zip(args, rule(y, *values), strict=True)
            rates = [(x.rate, slope) for x, slope in terms if isinstance(x, Dual) and not _is(slope, 0.0)]
            for rate, slope in sorted(rates, key=lambda term: not _is(term[1], 1.0)):
                if _is(total, 0.0):
                    total = rate if _is(slope, 1.0) else rate * slope
                else:
                    total = total + rate if _is(slope, 1.0) else fma(rate, slope, total)
        return Dual(y, total)


def _is(x: Any, number: float) -> bool:
    return isinstance(x, float) and x == number


class DualRows:
    """Dual numbers in memory."""

    def __init__(self, values: Rows, rates: Rows) -> None:
        self.values, self.rates = values, rates

    def __getitem__(self, i: Any) -> Dual:
        return Dual(self.values[i], self.rates[i])

    def __setitem__(self, i: Any, x: Any) -> None:
        self.values[i], self.rates[i] = (x.value, x.rate) if isinstance(x, Dual) else (x, 0.0)

    def add(self, i: Any, *products: tuple[Any, Any]) -> None:
        """Add products to number i."""
        total: Any = self[i]
        for x, y in products:
            total = fma(x, y, total)
        self[i] = total

    def part(self, i: Any) -> DualRows:
        """The numbers from i on."""
        return DualRows(self.values.part(i), self.rates.part(i))
