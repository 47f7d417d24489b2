"""Elementary functions by arithmetic alone: the same operations in a scalar as in every lane of a register."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sympflow.compiler.control import Value

__all__ = ["LOWERED"]


def power(x: Value, n: float) -> Value:
    """xⁿ for a constant n: products for whole and half numbers."""
    if n < 0:
        return 1.0 / power(x, -n)
    if n % 1 == 0.5:
        root = x.code.apply("sqrt", (x,))
        return root if n == 0.5 else power(x, n - 0.5) * root
    if n % 1:
        return LOWERED["pow"](x, x.code.constant(n, x.type))
    whole, result = int(n), None
    while whole:
        if whole & 1:
            result = x if result is None else result * x
        whole >>= 1
        if whole:
            x = x * x
    assert result is not None
    return result


LOWERED: dict[str, Callable[..., Any]] = {"power": power}
