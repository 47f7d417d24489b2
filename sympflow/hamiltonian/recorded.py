"""SymPy expressions as calculations with numbers of any kind: recorded, they are programs of the compiler."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import add
from typing import Any

import sympy as sp
from sympy.core.relational import Relational

from sympflow.compiler import NotCompiled, arrays_only
from sympflow.compiler.functions import MOST_DERIVATIVES, apply, where
from sympflow.compiler.program import Program, Traced, traced
from sympflow.hamiltonian.removable import (
    Max,
    Min,
    bose,
    elliptic_e,
    elliptic_k,
    expit,
    hyp2f1,
    logcosh,
    removed,
    softplus,
    triangle,
)


class NotRecorded(NotCompiled):
    """A function in an expression is in no table of the compiler."""


def _reciprocal(name: str) -> Callable[[Any], Any]:
    return lambda x: 1.0 / apply(name, x)


def _folded(name: str) -> Callable[..., Any]:
    def function(*args: Any) -> Any:
        value, *rest = args
        for x in rest:
            value = apply(name, value, x)
        return value

    return function


def _sinc(x: Any) -> Any:
    """sin(x)/x, near 0 by its series, whose derivatives do not cancel there."""
    near, squared = abs(x) < 1.0, x * x
    series: Any = 0.0
    for k in range(10, -1, -1):
        series = series * squared + (-1.0) ** k / math.factorial(2 * k + 1)
    far = where(near, 1.0, x)
    return where(near, series, apply("sin", far) / far)


_SAME = (
    *("exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh"),
    *("atanh", "erf", "erfc", "sign", "floor", "gamma", "sech", "csch"),
)
"""Functions of the same name here and there."""
# fmt: off
_OTHER = {
    "jv": sp.besselj, "yv": sp.bessely, "iv": sp.besseli, "kv": sp.besselk, "ellipk": elliptic_k,
    "ellipe": elliptic_e, "hyp2f1": hyp2f1, "expi": sp.Ei,
    "expit": expit, "bose": bose, "softplus": softplus, "logcosh": logcosh,
    "mod": sp.Mod, "lt": sp.StrictLessThan, "le": sp.LessThan, "eq": sp.Equality, "not": sp.Not,
}
"""SymPy's functions of those that have other names."""
_BOTH: dict[str, Any] = {name: getattr(sp, name) for name in _SAME} | _OTHER
_RULES: dict[type, Callable[..., Any]] = {
    **{function: partial(apply, name) for name, function in _BOTH.items()},
    sp.cot: _reciprocal("tan"), sp.sec: _reciprocal("cos"), sp.csc: _reciprocal("sin"),
    sp.acot: lambda x: apply("atan", 1.0 / x), sp.Abs: abs,
    sp.coth: _reciprocal("tanh"),
    triangle: lambda x: math.pi / 2 - abs(apply("mod", x + math.pi / 2, 2 * math.pi) - math.pi),
    sp.loggamma: lambda x: where(x > 0.0, apply("lgamma", x), float("nan")),
    sp.lowergamma: lambda s, x: apply("gamma", s) * apply("gammainc", s, x),
    sp.uppergamma: lambda s, x: apply("gamma", s) * apply("gammaincc", s, x),
    sp.polygamma: lambda n, x: apply(f"polygamma{int(n)}" if n else "digamma", x), sp.sinc: _sinc,
    Max: _folded("max"), Min: _folded("min"), sp.And: _folded("and"), sp.Or: _folded("or"),
    sp.StrictGreaterThan: lambda x, y: apply("lt", y, x), sp.GreaterThan: lambda x, y: apply("le", y, x),
    sp.Unequality: lambda x, y: apply("not", apply("eq", x, y)),
}
# fmt: on
EXACT = 2.0**53
# fmt: off
_SYMBOLS: dict[str, Callable[..., sp.Expr]] = _BOTH | {
    "add": lambda x, y: x + y, "sub": lambda x, y: x - y, "mul": lambda x, y: x * y, "times": lambda x, y: x * y,
    "div": lambda x, y: x / y, "neg": lambda x: -x, "fma": lambda x, y, z: x * y + z,
    "pow": lambda x, n: x ** (sp.nsimplify(n) if n.is_Float and 2 * n % 1 == 0 else n), "sqrt": sp.sqrt,
    "abs": sp.Abs, "min": Min, "max": Max, "and": sp.And, "or": sp.Or,
    "where": lambda c, x, y: sp.Piecewise((x, c), (y, True)), "expm1": lambda x: sp.exp(x) - 1,
    "log1p": lambda x: sp.log(1 + x),
}
# fmt: on


def _heaviside(x: Any, at_zero: Any = 0.5) -> Any:
    return where(apply("eq", x, 0.0), at_zero, where(x > 0.0, 1.0, 0.0))


def can_be_recorded(f: sp.Expr) -> bool:
    """True if `calculated` has a rule for every function in an expression."""
    functions = f.atoms(sp.Function, sp.logic.boolalg.Boolean) - f.atoms(sp.Symbol)
    known = (sp.Piecewise, sp.Heaviside, removed, sp.logic.boolalg.BooleanAtom)
    return all(a.func in _RULES or isinstance(a, known) for a in functions) and all(_takes_order(a) for a in functions)


def _takes_order(f: sp.Basic) -> bool:
    """False of a special function of arguments, or an order, for which there is no rule."""
    if isinstance(f, elliptic_e):
        return len(f.args) == 1
    if isinstance(f, sp.polygamma):
        return f.args[0] in range(MOST_DERIVATIVES + 1)
    ordered = (sp.besselj, sp.bessely, sp.besseli, sp.besselk, sp.lowergamma, sp.uppergamma)
    return not isinstance(f, ordered) or bool(f.args[0].is_number)


def check_recorded(f: sp.Expr) -> None:
    """Raise a ValueError with the term of an expression that has a function without a rule in `calculated`."""
    for term in sp.Add.make_args(f):
        if not can_be_recorded(term):
            raise arrays_only(f"`system` has the term {term}, and there is no compiled function for it")


def calculated(f: sp.Basic, value: Callable[[sp.Basic], Any]) -> Any:
    """The value of an expression, by a function that gives those of its parts."""
    if isinstance(f, sp.logic.boolalg.BooleanAtom):
        return 1.0 if f else 0.0
    if f.is_number and f.is_extended_real:
        return float(f)
    if f.is_Add:
        return reduce(add, map(value, f.args))
    if f.is_Mul:
        return _product(f, value)
    if f.is_Pow:
        base, exponent = f.args
        if base == sp.E:
            return apply("exp", value(exponent))
        return apply("pow", value(base), value(exponent))
    if isinstance(f, sp.Piecewise):
        return _piecewise(f, value)
    if isinstance(f, removed):
        return value(f.written_out)
    if isinstance(f, sp.Heaviside):
        return _heaviside(*(value(x) for x in f.args))
    rule = _RULES.get(f.func)
    if rule is None:
        raise NotRecorded(f"{f.func.__name__} is in no table of the compiler.")
    return rule(*(value(x) for x in f.args))


def recorded(f: sp.Expr, variables: Sequence[sp.Symbol]) -> Program:
    """An expression as a program of variables; NotRecorded where a function has no rule."""

    def output(*numbers: Any) -> list[Any]:
        known: dict[sp.Basic, Any] = dict(zip(variables, numbers, strict=True))

        def value(part: sp.Basic) -> Any:
            if part not in known:
                known[part] = calculated(part, value)
            return known[part]

        return [value(f)]

    return traced(output, *(s.name for s in variables))


def in_symbols(program: Program) -> sp.Expr:
    """The one output of a program as an expression in real symbols; NotRecorded where an operation has no such form."""
    known: dict[int, Any] = {x.order: sp.Symbol(repr(x), real=True) for x in program.inputs}

    def given(x: Any) -> sp.Expr:
        if isinstance(x, Traced):
            return known[x.order]
        return sp.Integer(int(x)) if math.isfinite(x) and x % 1 == 0 and abs(x) < EXACT else sp.Float(x)

    for x in program.operations:
        rule = _SYMBOLS.get(x.name)
        if rule is None:
            raise NotRecorded(f"{x.name} has no form in symbols.")
        args = [*map(given, x.args)]
        if x.name not in ("and", "or", "not"):
            args = [a if x.name == "where" and i == 0 else _as_number(a) for i, a in enumerate(args)]
        known[x.order] = rule(*args)
    return given(program.outputs[0])


def _as_number(f: Any) -> Any:
    """1 and 0 for a condition that is calculated with."""
    conditions = Relational | sp.logic.boolalg.BooleanFunction | sp.logic.boolalg.BooleanAtom
    return sp.Piecewise((1, f), (0, True)) if isinstance(f, conditions) else f


def _product(f: sp.Mul, value: Callable[[sp.Basic], Any]) -> Any:
    """A product: the factors above and below the line apart, the number last."""
    number, rest = f.as_coeff_Mul()
    above: Any = None
    for x in sp.Mul.make_args(rest):
        factor = value(x)
        above = factor if above is None else above * factor
    return above if number == 1 else float(number) * above


def _piecewise(f: sp.Piecewise, value: Callable[[sp.Basic], Any]) -> Any:
    """The branches from the last to the first; NaN where no condition holds."""
    *rest, (expression, condition) = f.args
    last = value(expression)
    result = last if condition == sp.true else where(value(condition), last, float("nan"))
    for expression, condition in reversed(rest):
        result = where(value(condition), value(expression), result)
    return result
