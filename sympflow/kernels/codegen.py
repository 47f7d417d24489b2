"""From a symbolic system to the source of its algebra: kicks and drifts on tuples of numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence

import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError
from sympy.printing.pycode import PythonCodePrinter

from sympflow.hamiltonian.driving import sampled
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, printable

__all__ = [
    "algebra_source",
    "as_factor",
    "curvature_kick_source",
    "gradient_kick_source",
    "parameter_lines",
    "polynomial_kick_source",
    "polynomial_slope_source",
    "printed",
    "sampled_name",
    "statements",
    "tuple_algebra",
    "vectorised",
]

_MAX_POWER = 16  # integer powers up to this are written as products


class fast_exp(sp.Function):  # as the compiled function of the text `elementary`
    """exp as arithmetic, in loops that are to become vector instructions."""


def vectorised(expressions: Sequence[sp.Expr]) -> list[sp.Expr]:
    """Expressions for loops over sites, whose exponentials are arithmetic too."""
    return [f.replace(sp.exp, fast_exp) for f in expressions]


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


def algebra_source(symbols: SymbolicHamiltonian) -> str:
    """The kick and the drift that `loops` ask for, for H = T(p) + V(q), calling `elementary`; states are tuples.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code.
    """
    q, p, d = symbols.q, symbols.p, symbols.ndof
    velocity = [sp.diff(symbols.T, s) for s in p]
    slope = [sp.diff(symbols.V, s) for s in q]
    parts = [
        _function(symbols, "kick", "q, numbers, work", [-s for s in slope], [f"b*{{{i}}}" for i in range(d)], "b"),
        _drift(symbols, velocity),
    ]
    return "\n\n\n".join(parts) + "\n"


def _drift(symbols: SymbolicHamiltonian, velocity: list[sp.Expr]) -> str:
    numbers = "numbers, " if symbols.parameters else ""
    results = [f"a*{{{i}}}" for i in range(symbols.ndof)]
    return _function(symbols, "drift", f"p, a, {numbers}work", velocity, results)


def gradient_kick_source(symbols: SymbolicHamiltonian) -> str:
    """−b∇V + g ∇²V M⁻¹∇V in two parts, those of the Hessian's diagonal and of what is beside it.

    The Hessian's upper triangle is computed, the products are taken with numbers: g times its entries does not wait
    for ∇V, so that of what follows ∇V two fused operations are left.

    Raises
    ------
    ValueError
        As `algebra_source`.
    """
    q, d, M = symbols.q, symbols.ndof, symbols.inverse_mass
    assert M is not None
    slope = [sp.diff(symbols.V, s) for s in q]
    triangle = [(i, j) for i in range(d) for j in range(i, d)]
    entries = [sp.diff(slope[i], q[j]) for i, j in triangle]
    position = {ij: d + n for n, ij in enumerate(triangle) if entries[n] != 0}

    def velocity(j: int) -> str:
        terms = [f"{as_factor(M[j, k])}*{{{k}}}" if M[j, k] != 1 else f"{{{k}}}" for k in range(d) if M[j, k] != 0]
        return terms[0] if len(terms) == 1 else f"({' + '.join(terms)})"

    own, other = [], []
    for i in range(d):
        row = {j: n for j in range(d) if (n := position.get((min(i, j), max(i, j)))) is not None}
        if i not in row:
            own.append(f"-b*{{{i}}}")
        elif M[i, i] == 1 and velocity(i) == f"{{{i}}}":
            own.append(f"(g*{{{row[i]}}} - b)*{{{i}}}")
        else:
            own.append(f"(g*{{{row[i]}}}*{velocity(i)} - b*{{{i}}})")
        other.append(" + ".join(f"(g*{{{n}}})*{velocity(j)}" for j, n in row.items() if j != i) or "0.0")
    results = [f"({', '.join(change)},)" for change in (own, other)]
    coupled = f"COUPLED = {any(term != '0.0' for term in other)}"
    return (
        f"{coupled}\n\n\n"
        + _function(symbols, "gradient_kick", "q, numbers, work", [*slope, *entries], results, "bg")
        + "\n"
    )


def curvature_kick_source(symbols: SymbolicHamiltonian) -> str:
    """−b∇V + g ∇²V v − c ∇(½ v·∇²V v), v = M⁻¹∇V.

    Raises
    ------
    ValueError
        As `algebra_source`.
    """
    q, d, M = symbols.q, symbols.ndof, symbols.inverse_mass
    slope = sp.Matrix([sp.diff(symbols.V, s) for s in q])
    products = sp.hessian(symbols.V, q) * M * slope
    bent = [sp.diff(symbols.W, s) for s in q]
    results = [f"((g*{{{d + i}}} - b*{{{i}}}) - c*{{{2 * d + i}}})" for i in range(d)]
    return _function(symbols, "curvature_kick", "q, numbers, work", [*slope, *products, *bent], results, "bgc") + "\n"


def polynomial_kick_source(symbols: SymbolicHamiltonian, monomials: Monomials) -> str:
    """−b∇V − Σ_m e_m ∇q^m, e the coefficients of the polynomial.

    Raises
    ------
    ValueError
        As `algebra_source`.
    """
    q, d = symbols.q, symbols.ndof
    products = [sp.Mul(*map(sp.Pow, q, m)) for m in monomials]
    slopes = [sp.diff(symbols.V, s) for s in q]
    places: list[list[str]] = [[f"-b*{{{i}}}"] for i in range(d)]
    for i, s in enumerate(q):
        for m, product in enumerate(products):
            if (slope := sp.diff(product, s)) != 0:
                places[i].append(f" - numbers[{m + 1}]*{{{len(slopes)}}}")
                slopes.append(slope)
    results = ["".join(terms) for terms in places]
    return _function(symbols, "polynomial_kick", "q, numbers, work", slopes, results, "b") + "\n"


def polynomial_slope_source(symbols: SymbolicHamiltonian, monomials: Monomials) -> str:
    """``polynomial_slope(q, numbers, out)``: Σ_m e_m ∇q^m into out, of arrays."""
    q = symbols.q
    letters = [sp.Symbol(f"e_{m}", real=True) for m in range(len(monomials))]
    P = sp.Add(*[e * sp.Mul(*map(sp.Pow, q, m)) for e, m in zip(letters, monomials, strict=True)])
    lines = ["@njit(**OPTIONS)", "def polynomial_slope(q, numbers, out):"]
    lines += [f"    {s} = q[{i}]" for i, s in enumerate(q) if P.has(s)]
    lines += [f"    {e} = numbers[{m + 1}]" for m, e in enumerate(letters)]
    slopes = statements([f"out[{i}]" for i in range(len(q))], [sp.diff(P, s) for s in q])
    return "\n".join([*lines, *(f"    {line}" for line in slopes)])


def as_factor(number: sp.Expr) -> str:
    """Source text of a number, of M⁻¹ for instance, or of an expression in parameters, as a factor."""
    return f"({printed(number)})" if number.free_symbols else repr(float(number))


def parameter_lines(symbols: SymbolicHamiltonian, lines: Sequence[str]) -> list[str]:
    """Assignments of the parameters that occur in lines of code; their values are the last ones of `numbers`."""
    words, n = set(re.findall(r"\w+", " ".join(lines))), len(symbols.parameters)
    return [f"{s} = numbers[-{n - i}]" for i, s in enumerate(symbols.parameters) if s.name in words]


def _function(
    symbols: SymbolicHamiltonian,
    name: str,
    arguments: str,
    expressions: list[sp.Expr],
    results: list[str],
    letters: str = "",
) -> str:
    """A jitted function that returns the tuple `results`, ``{n}`` in them standing for the n-th expression.

    Its first argument, q or p, holds the variables; `numbers` begin with those called by the `letters`.
    """
    variables = symbols.q if arguments[0] == "q" else symbols.p
    names = [f"v_{n}" for n in range(len(expressions))]
    lines = ["@njit(**OPTIONS)", f"def {name}({arguments}):"]
    lines.append(f"    {', '.join(s.name for s in variables)}, = {arguments[0]}")
    lines += [f"    {letter} = numbers[{i}]" for i, letter in enumerate(letters)]
    body = statements(names, expressions)
    body.append(f"return ({''.join(result.format(*names) + ', ' for result in results)})")
    lines += [f"    {line}" for line in [*parameter_lines(symbols, body), *body]]
    return "\n".join(lines)


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
