"""The table of functions: of each its value with arrays and tensors, its derivatives, its cost.

Machine code of each is in `control` (one instruction) or `elementary` (several). A function that is in no table cannot
be traced. Derivatives are written with numbers of any kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.numbers import Number
from sympflow.compiler.tables import Table, entry_of, interval_of

__all__ = ["FUNCTIONS", "Function", "added", "apply", "dot", "fma", "is_zero", "summed", "times", "where"]


@dataclass(frozen=True)
class Function:
    """A function of real numbers: of arrays by `numpy`, of tensors by its name in torch or a function of these.

    ``partials(y, *x)``, with its value y: the derivative by each argument, 0.0 where there is none. `cost` is its
    latency in cycles of a typical processor: the same on every machine, so that programs are the same too. `infix` is
    its sign between two arguments, as a program prints it.
    """

    numpy: Callable[..., Any]
    tensor: str | Callable[..., Any]
    partials: Callable[..., tuple[Any, ...]] | None = None
    cost: int = 1
    infix: str = ""

    def torch(self, *args: Any) -> Any:
        """Return the value of tensors and floats."""
        import torch

        function = getattr(torch, self.tensor) if isinstance(self.tensor, str) else self.tensor
        if function is torch.pow and isinstance(args[1], float):
            return torch.pow(*args)  # an exponent that is a tensor makes the gradient of a jvp NaN where x ≤ 0
        return function(*_alike(args))


def _alike(args: tuple[Any, ...]) -> list[Any]:
    """The arguments as tensors of the device and dtype of those that are, float64 if these are conditions."""
    import torch

    tensors = [x for x in args if isinstance(x, torch.Tensor)]
    dtype = next((x.dtype for x in tensors if x.dtype != torch.bool), torch.float64)
    return [x if isinstance(x, torch.Tensor | Table) else tensors[0].new_tensor(x, dtype=dtype) for x in args]


def _special(name: str) -> Callable[..., Any]:
    """A function of scipy.special, which is loaded by its first call."""

    def function(*args: Any) -> Any:
        from scipy import special

        return getattr(special, name)(*args)

    return function


def _multiply_add(a: Any, b: Any, c: Any) -> Any:
    return a * b + c


def _sign(x: Any) -> Any:
    """The sign of tensors, NaN where they are NaN."""
    return x.sign().where(~x.isnan(), x)


def _polygamma(n: int) -> Function:
    """The n-th derivative of the digamma function."""

    def of_tensors(x: Any) -> Any:
        import torch

        return (-1.0) ** (n + 1) * math.factorial(n) * torch.special.zeta(n + 1.0, x)  # torch.polygamma has few digits

    def partials(y: Any, x: Any) -> tuple[Any]:
        if n == MOST_DERIVATIVES:
            raise NotCompiled(
                f"`polygamma` of the order {n} has no derivative here: use a method with fewer derivatives of H, such "
                "as 'kahan_li8'."
            )
        return (apply(f"polygamma{n + 1}", x),)

    return Function(lambda x: _special("polygamma")(n, x), of_tensors, partials, 160)


def _choice(y: Any, c: Any, a: Any, b: Any) -> tuple[Any, Any, Any]:
    """Derivatives of a choice; of one between a function and no number these are none either."""
    none_a, none_b = (x if isinstance(x, float) and math.isnan(x) else 0.0 for x in (a, b))
    return 0.0, apply("where", c, 1.0, none_b), apply("where", c, none_a, 1.0)


def _power_rule(y: Any, x: Any, n: Any) -> tuple[Any, Any]:
    by_n = 0.0 if isinstance(n, float | int) else apply("mul", y, apply("log", x))
    return apply("mul", n, apply("pow", x, n - 1.0)), by_n


def _quotient_rule(y: Any, a: Any, b: Any) -> tuple[Any, Any]:
    return (1.0 / b, -(y / b)) if not isinstance(a, float | int) else (0.0, -(y * y) * (1.0 / a))


def _chosen(sign: float) -> Callable[..., tuple[Any, Any]]:
    """Derivatives of the larger (1) or smaller (−1) of two; at a tie those of the first."""

    def partials(y: Any, a: Any, b: Any) -> tuple[Any, Any]:
        first = apply("le", b, a) if sign > 0 else apply("le", a, b)
        return apply("where", first, 1.0, 0.0), apply("where", first, 0.0, 1.0)

    return partials


def _no_tensors(name: str) -> Callable[..., Any]:
    """The function of tensors, which there is not."""

    def function(*args: Any) -> Any:
        raise TypeError(f"{name} is not a function of tensors: pass NumPy arrays.")

    return function


def _by_last(name: str, slope: Callable[..., Any]) -> Callable[..., tuple[Any, Any]]:
    """Derivatives of a function of an order, which is constant, and of x."""

    def partials(y: Any, order: Any, x: Any) -> tuple[Any, Any]:
        if not isinstance(order, float | int):
            raise NotCompiled(f"`{name}` has no derivative by its order, its first argument: make that a number.")
        return 0.0, slope(y, order, x)

    return partials


def _bessel(name: str, before: float, after: float) -> Callable[..., Any]:
    """The derivative of a Bessel function, half of a sum of those of the orders before and after."""
    return lambda y, n, x: 0.5 * (before * apply(name, n - 1.0, x) + after * apply(name, n + 1.0, x))


MOST_DERIVATIVES = 6
"""The highest order of `polygamma`: third derivatives of the third of ln Γ."""
_TWO_OVER_ROOT_PI = 2.0 / np.sqrt(np.pi)

# fmt: off
FUNCTIONS: dict[str, Function] = {
    "add": Function(np.add, "add", lambda y, a, b: (1.0, 1.0), 3, "+"),
    "sub": Function(np.subtract, "sub", lambda y, a, b: (1.0, -1.0), 3, "-"),
    "mul": Function(np.multiply, "mul", lambda y, a, b: (b, a), 3, "*"),
    "times": Function(np.multiply, "mul", lambda y, a, b: (b, a), 3, "*"),
    "div": Function(np.divide, "div", _quotient_rule, 13, "/"),
    "neg": Function(np.negative, "neg", lambda y, a: (-1.0,), 1),
    "fma": Function(_multiply_add, _multiply_add, lambda y, a, b, c: (b, a, 1.0), 4),
    "pow": Function(np.power, "pow", _power_rule, 120, "**"),
    "sqrt": Function(np.sqrt, "sqrt", lambda y, x: (0.5 * y * (1.0 / x),), 20),
    "abs": Function(np.abs, "abs", lambda y, x: (apply("sign", x),), 1),
    "sign": Function(np.sign, _sign, lambda y, x: (0.0,), 4),
    "min": Function(np.minimum, "minimum", _chosen(-1.0), 3),
    "max": Function(np.maximum, "maximum", _chosen(1.0), 3),
    "floor": Function(np.floor, "floor", lambda y, x: (0.0,), 8),
    "mod": Function(np.mod, "remainder", lambda y, a, b: (1.0, -apply("floor", a / b)), 30),
    "lt": Function(np.less, "lt", None, 4, "<"),
    "le": Function(np.less_equal, "le", None, 4, "<="),
    "eq": Function(np.equal, "eq", None, 4, "=="),
    "and": Function(np.logical_and, "logical_and", None, 1, "&"),
    "or": Function(np.logical_or, "logical_or", None, 1, "|"),
    "not": Function(np.logical_not, "logical_not", None, 1),
    "where": Function(np.where, "where", _choice, 2),
    "entry": Function(entry_of, entry_of, lambda y, table, i, offset: (0.0, 0.0, 0.0), 8),
    "interval": Function(interval_of, interval_of, lambda y, table, x: (0.0, 0.0), 20),
    "exp": Function(np.exp, "exp", lambda y, x: (y,), 45),
    "expm1": Function(np.expm1, "expm1", lambda y, x: (y + 1.0,), 48),
    "log": Function(np.log, "log", lambda y, x: (1.0 / x,), 55),
    "log1p": Function(np.log1p, "log1p", lambda y, x: (1.0 / (1.0 + x),), 60),
    "sin": Function(np.sin, "sin", lambda y, x: (apply("cos", x),), 50),
    "cos": Function(np.cos, "cos", lambda y, x: (-apply("sin", x),), 50),
    "tan": Function(np.tan, "tan", lambda y, x: (1.0 + y * y,), 65),
    "atan": Function(np.arctan, "atan", lambda y, x: (1.0 / (1.0 + x * x),), 65),
    "tanh": Function(np.tanh, "tanh", lambda y, x: (1.0 - y * y,), 60),
    "asin": Function(np.arcsin, "asin", lambda y, x: (1.0 / apply("sqrt", (1.0 - x) * (1.0 + x)),), 160),
    "acos": Function(np.arccos, "acos", lambda y, x: (-1.0 / apply("sqrt", (1.0 - x) * (1.0 + x)),), 160),
    "atan2": Function(np.arctan2, "atan2", lambda y, a, b: (b / (a * a + b * b), -(a / (a * a + b * b))), 160),
    "sinh": Function(np.sinh, "sinh", lambda y, x: (apply("cosh", x),), 160),
    "cosh": Function(np.cosh, "cosh", lambda y, x: (apply("sinh", x),), 160),
    "asinh": Function(np.arcsinh, "asinh", lambda y, x: (1.0 / apply("sqrt", 1.0 + x * x),), 160),
    "acosh": Function(np.arccosh, "acosh", lambda y, x: (1.0 / apply("sqrt", (x - 1.0) * (x + 1.0)),), 160),
    "atanh": Function(np.arctanh, "atanh", lambda y, x: (1.0 / ((1.0 - x) * (1.0 + x)),), 160),
    "erf": Function(_special("erf"), "erf", lambda y, x: (_TWO_OVER_ROOT_PI * apply("exp", -(x * x)),), 160),
    "erfc": Function(_special("erfc"), "erfc", lambda y, x: (-_TWO_OVER_ROOT_PI * apply("exp", -(x * x)),), 160),
    "lgamma": Function(_special("gammaln"), "lgamma", lambda y, x: (apply("digamma", x),), 160),
    "digamma": Function(_special("psi"), "digamma", lambda y, x: (apply("polygamma1", x),), 160),
    **{f"polygamma{n}": _polygamma(n) for n in range(1, MOST_DERIVATIVES + 1)},
    "gamma": Function(_special("gamma"), _no_tensors("gamma"), lambda y, x: (y * apply("digamma", x),), 160),
    "gammainc": Function(_special("gammainc"), _no_tensors("gammainc"), _by_last(
        "gammainc", lambda y, s, x: apply("pow", x, s - 1.0) * apply("exp", -x) / apply("gamma", s)), 200),
    "gammaincc": Function(_special("gammaincc"), _no_tensors("gammaincc"), _by_last(
        "gammaincc", lambda y, s, x: -(apply("pow", x, s - 1.0) * apply("exp", -x)) / apply("gamma", s)), 200),
    "jv": Function(_special("jv"), _no_tensors("jv"), _by_last("jv", _bessel("jv", 1.0, -1.0)), 300),
    "yv": Function(_special("yv"), _no_tensors("yv"), _by_last("yv", _bessel("yv", 1.0, -1.0)), 300),
    "iv": Function(_special("iv"), _no_tensors("iv"), _by_last("iv", _bessel("iv", 1.0, 1.0)), 300),
    "kv": Function(_special("kv"), _no_tensors("kv"), _by_last("kv", _bessel("kv", -1.0, -1.0)), 300),
    "ellipk": Function(_special("ellipk"), _no_tensors("ellipk"), lambda y, m: (
        math.pi / 8.0 * apply("hyp2f1", 1.5, 1.5, 2.0, m),), 200),
    "ellipe": Function(_special("ellipe"), _no_tensors("ellipe"), lambda y, m: (
        -math.pi / 8.0 * apply("hyp2f1", 0.5, 1.5, 2.0, m),), 200),
    "hyp2f1": Function(_special("hyp2f1"), _no_tensors("hyp2f1"), lambda y, a, b, c, x: (
        0.0, 0.0, 0.0, a * b / c * apply("hyp2f1", a + 1.0, b + 1.0, c + 1.0, x)), 300),
    "expi": Function(_special("expi"), _no_tensors("expi"), lambda y, x: (apply("exp", x) / x,), 200),
    "exp1": Function(_special("exp1"), _no_tensors("exp1"), lambda y, x: (-(apply("exp", -x) / x),), 200),
    "dawsn": Function(_special("dawsn"), _no_tensors("dawsn"), lambda y, x: (1.0 - 2.0 * x * y,), 200),
}
# fmt: on


class Composed(NamedTuple):
    """A function of x made of others: its `value`, and ``slope(y, x)``, its derivative with its value y."""

    value: Callable[[Any], Any]
    slope: Callable[[Any, Any], Any]

    def function(self) -> Function:
        return Function(self.value, self.value, lambda y, x: (self.slope(y, x),), 160)


COMPOSED = {
    "expit": Composed(lambda x: 1.0 / (1.0 + apply("exp", -x)), lambda y, x: y * apply("expit", -x)),
    "bose": Composed(lambda x: 1.0 / apply("expm1", x), lambda y, x: y * apply("bose", -x)),
    "softplus": Composed(
        lambda x: apply("max", x, 0.0) + apply("log1p", apply("exp", -abs(x))),
        lambda y, x: apply("expit", x),
    ),
    "logcosh": Composed(
        lambda x: abs(x) + (apply("log1p", apply("exp", -2.0 * abs(x))) - math.log(2.0)),
        lambda y, x: apply("tanh", x),
    ),
    "sech": Composed(lambda x: 1.0 / apply("cosh", x), lambda y, x: -(y * apply("tanh", x))),
    "csch": Composed(lambda x: 1.0 / apply("sinh", x), lambda y, x: -(y / apply("tanh", x))),
}
"""Functions of others, whose derivatives do not overflow where parts of them do."""
FUNCTIONS |= {name: composed.function() for name, composed in COMPOSED.items()}
OF_SCIPY = (
    *("gamma", "gammainc", "gammaincc", "jv", "yv", "iv", "kv"),
    *("ellipk", "ellipe", "hyp2f1", "expi", "exp1", "dawsn"),
)
"""Functions of `scipy.special` that compiled code calls, at their addresses."""
SPECIAL = "scipy_special_"  # with which their names in code begin


def apply(name: str, *args: Any) -> Any:
    """Return the value of a function of the table, of numbers of any one kind, arrays, tensors or floats."""
    for x in args:
        if isinstance(x, Number):
            return x.apply(name, args)
    function = FUNCTIONS[name]
    if all(isinstance(x, float | int | np.ndarray | np.generic | Table) for x in args):
        return function.numpy(*args)
    return function.torch(*args)


def added(x: Any, change: Any, op: Callable[..., Any] = apply) -> tuple[Any, Any]:
    """Return x + change, and its rounding error by Kahan's compensated sum: subtract it from the next change."""
    total = op("add", x, change)
    return total, op("sub", op("sub", total, x), change)


def fma(x: Any, y: Any, z: Any) -> Any:
    """Return x·y + z, in compiled code rounded once."""
    return apply("fma", x, y, z)


def times(x: Any, y: Any) -> Any:
    """Return x·y, a product of sums that may be multiplied out."""
    return apply("times", x, y)


def dot(x: Iterable[Any], y: Iterable[Any]) -> Any:
    """Return Σ xᵢ yᵢ of as many as there are of both, products that may be multiplied out."""
    total: Any = 0.0
    for a, b in zip(x, y, strict=False):
        total = total + times(a, b)
    return total


def is_zero(x: Any) -> bool:
    """Return True of the float 0, which need not be added or multiplied."""
    return isinstance(x, float) and x == 0.0


def summed(total: Any, x: Iterable[Any], y: Iterable[Any]) -> Any:
    """Return total + Σ xᵢ yᵢ of as many as there are of both, in compiled code rounded once for each."""
    for a, b in zip(x, y, strict=False):
        if not is_zero(a):
            total = a * b if is_zero(total) else fma(a, b, total)
    return total


def where(condition: Any, x: Any, y: Any) -> Any:
    """Return x where the condition holds, else y."""
    return apply("where", condition, x, y)
