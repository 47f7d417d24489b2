"""Expressions as source text, and the algebra of tuples of numbers."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError
from sympy.printing.pycode import PythonCodePrinter

from sympflow.hamiltonian.driving import sampled
from sympflow.hamiltonian.symbolic import printable

__all__ = [
    "printed",
    "sampled_name",
    "statements",
    "tuple_algebra",
]

_MAX_POWER = 16  # integer powers up to this are written as products


class fast_exp(sp.Function):  # as the compiled function of the text `elementary`
    """exp as arithmetic, in loops that are to become vector instructions."""


class _KernelPrinter(PythonCodePrinter):
    """Python for Numba: float literals, and products and square roots in place of small powers."""

    def _print_Integer(self, expr: sp.Integer) -> str:
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: sp.Rational) -> str:
        return repr(float(expr))

    def _print_Float(self, expr: sp.Float) -> str:
        return repr(float(expr))

    def _print_Heaviside(self, expr: sp.Heaviside) -> str:
        return "(1.0 if {0} > 0.0 else (0.5 if {0} == 0.0 else 0.0))".format(self._print(expr.args[0]))

    def _print_Piecewise(self, expr: sp.Piecewise) -> str:
        return super()._print_Piecewise(expr).replace(" else None)", " else math.nan)")

    def _print_sin(self, expr: sp.sin) -> str:
        return f"fast_sin({self._print(expr.args[0])})"

    def _print_cos(self, expr: sp.cos) -> str:
        return f"fast_cos({self._print(expr.args[0])})"

    def _print_tanh(self, expr: sp.tanh) -> str:
        return f"fast_tanh({self._print(expr.args[0])})"

    def _print_fast_exp(self, expr: fast_exp) -> str:
        return f"fast_exp({self._print(expr.args[0])})"

    def _print_sampled(self, expr: sampled) -> str:
        return f"{sampled_name(expr.name_of_samples, expr.order)}({self._print(expr.at)})"

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        base, exponent = expr.as_base_exp()
        if exponent.is_negative is True and exponent.is_number:
            return f"(1.0/{self._print_Pow(sp.Pow(base, -exponent, evaluate=False))})"
        factor = self.parenthesize(base, 100)
        if exponent.is_Integer and 1 <= exponent <= _MAX_POWER:
            return f"({_product(factor, int(exponent))})"
        if exponent.is_Rational and exponent.q == 2 and exponent.p <= _MAX_POWER:
            root = f"math.sqrt({self._print(base)})"
            whole = int(exponent.p) // 2
            return f"({_product(factor, whole)}*{root})" if whole else root
        return f"{factor}**{self.parenthesize(exponent, 100)}"


def sampled_name(name: str, order: int) -> str:
    """The compiled function of samples of that name, or of a derivative of it; −1 is the antiderivative."""
    return f"sampled_{name}_{order}".replace("-", "m")


_PRINTER = _KernelPrinter({"fully_qualified_modules": True, "human": True})


def printed(f: sp.Expr) -> str:
    """Source text of an expression.

    Raises
    ------
    ValueError
        If a function in it has no counterpart in compiled code.
    """
    try:
        return _PRINTER.doprint(f)
    except PrintMethodNotImplementedError:
        raise ValueError(
            f"`system` has the term {f}, for which there is no compiled function: use backend='array'."
        ) from None


def statements(targets: Sequence[str], expressions: Sequence[sp.Expr]) -> list[str]:
    """``target = expression`` for each, after the common subexpressions s_0, s_1, … that they share.

    Raises
    ------
    ValueError
        As `printed`.
    """
    code = [printable(f) for f in expressions]
    shared, reduced = sp.cse(code, symbols=sp.numbered_symbols("s_", real=True), list=True)
    named = [(symbol.name, f) for symbol, f in shared]
    return [f"{target} = {printed(f)}" for target, f in [*named, *zip(targets, reduced, strict=True)]]


def _product(factor: str, power: int) -> str:
    """x·x·… with few multiplications: x⁴ as (x·x)·(x·x)."""
    if power == 1:
        return factor
    half = _product(factor, power // 2)
    square = f"({half}*{half})" if power > 3 else f"{half}*{half}"
    return f"{square}*{factor}" if power % 2 else square


def tuple_algebra(d: int) -> str:
    """Componentwise operations on tuples of length d, written out."""

    def each(pattern: str) -> str:
        return "(" + "".join(pattern.format(i=i, j=i + d) + ", " for i in range(d)) + ")"

    finite = " + ".join(f"0.0*q[{i}] + 0.0*p[{i}]" for i in range(d))
    stores = "\n".join(f"    y[{i}] = q[{i}]\n    y[{i + d}] = p[{i}]" for i in range(d))
    lane_stores = "\n".join(f"    Y[{i}, lane] = q[{i}]\n    Y[{i + d}, lane] = p[{i}]" for i in range(d))
    return f'''@njit(**OPTIONS)
def unpack(y):
    return {each("y[{i}]")}, {each("y[{j}]")}


@njit(**OPTIONS)
def pack(q, p, y):
{stores}


@njit(**OPTIONS)
def unpack_lane(Y, lane):
    return {each("Y[{i}, lane]")}, {each("Y[{j}, lane]")}


@njit(**OPTIONS)
def pack_lane(q, p, Y, lane):
{lane_stores}


@njit(**OPTIONS)
def copy(x):
    return x


@njit(**OPTIONS)
def is_finite(q, p):
    return {finite} == 0.0


@njit(**OPTIONS)
def workspace(table):
    return None


@njit(**OPTIONS)
def no_error(x):
    if COMPENSATED:
        return {each("0.0")}
    return None


@njit(**OPTIONS)
def plus(x, y):
    return {each("x[{i}] + y[{i}]")}


@njit(**OPTIONS)
def minus(x, y):
    return {each("x[{i}] - y[{i}]")}


@njit(**OPTIONS)
def move(x, error, change):
    """x + change; if `COMPENSATED` by Kahan's compensated sum."""
    if COMPENSATED:
        corrected = minus(change, error)
        total = plus(x, corrected)
        return total, minus(minus(total, x), corrected)
    return plus(x, change), None'''
