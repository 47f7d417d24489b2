"""Functions of NumPy arrays and of tensors, generated from SymPy expressions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import numpy as np
import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError

_MAX_POWER = 16  # integer powers up to this are made of products
_INTEGER_POWER = sp.Function("integer_power", real=True)


def generate(expressions: Sequence[sp.Expr], variables: Sequence[sp.Symbol], library: str) -> Callable[..., list[Any]]:
    """The values of the expressions, as a function of the variables' arrays of "numpy" or "torch".

    Raises
    ------
    TypeError
        If the library has no function for something in the expressions.
    """
    code = [_by_products(f) if library == "numpy" else f for f in expressions]
    try:
        return sp.lambdify(variables, code, modules=_modules(library, code), cse=True)
    except (PrintMethodNotImplementedError, ValueError) as error:
        raise TypeError(
            f"`expression` has no derivative that {library} could evaluate: write it with smooth functions."
        ) from error


def _by_products(f: sp.Expr) -> sp.Expr:
    """Integer powers beyond squares by a function that multiplies: NumPy raises to them by logarithms."""

    def is_large(e: sp.Expr) -> bool:
        return e.is_Pow and e.exp.is_Integer and 2 < abs(e.exp) <= _MAX_POWER

    def product(e: sp.Expr) -> sp.Expr:
        power = _INTEGER_POWER(e.base, abs(e.exp))
        return power if e.exp > 0 else 1 / power

    return f.replace(is_large, product)


def _integer_power(x: np.ndarray, n: int) -> np.ndarray:
    half = x if n < 4 else _integer_power(x, n // 2)
    return half * half * x if n % 2 else half * half


def _modules(library: str, code: list[sp.Expr]) -> list[Any]:
    """Where the generated code finds its functions; SciPy is brought in for special functions only."""
    from sympy.printing.numpy import NumPyPrinter

    known = NumPyPrinter().known_functions
    names = {type(f).__name__ for expression in code for f in expression.atoms(sp.Function)} - {"integer_power"}
    special = sorted(
        n for n in names - known.keys() if n not in ("Max", "Min", "Abs", "Heaviside", "sign", "Piecewise")
    )
    if library == "numpy":
        own = {"integer_power": _integer_power}
        return [own, "scipy", "numpy"] if special else [own, "numpy"]
    if special:
        raise TypeError(
            f"`expression` holds {', '.join(special)}, which torch has not: solve on NumPy states, with a method that "
            "does not need tensors."
        )
    import torch

    def pairwise(choose: Any) -> Any:
        def function(*values: Any) -> Any:
            like = next(v for v in values if isinstance(v, torch.Tensor))
            return reduce(choose, (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in values))

        return function

    def heaviside(x: Any, value: float) -> Any:
        return torch.heaviside(x, torch.as_tensor(value, dtype=x.dtype, device=x.device))

    return [{"heaviside": heaviside, "max": pairwise(torch.maximum), "min": pairwise(torch.minimum)}, "torch"]
