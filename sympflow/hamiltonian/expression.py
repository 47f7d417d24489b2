"""Text as a SymPy expression, read by a grammar of its own: nothing in the text is ever executed.

`sympy.sympify` evaluates the text as Python, so that a file of weights that names parts of H could run any code, and
`9**9**9**9` would never end. Here numbers, symbols, + − * / **, comparisons inside Piecewise, and the functions in
`FUNCTIONS` are understood, and everything else is refused; sizes are estimated before anything is computed.
"""

from __future__ import annotations

import ast
import math
import re
import unicodedata
from collections.abc import Callable, Collection
from typing import Any

import sympy as sp

from sympflow.hamiltonian.grammar import COORDINATE, MAX_NESTING, Unreadable, chain, parsed
from sympflow.hamiltonian.removable import BOUNDED, Max, Min, with_own_functions

MAX_EXPONENT = 1000.0  # of a power, where it is a number
MAX_BITS = 4096  # of an exact fraction; a longer one is rounded
MAX_TERMS = 50_000  # that the expression may have when it is multiplied out
MAX_ARGUMENT = 1e4  # of a special function of numbers
MAX_ARGUMENTS = 128

# fmt: off
ELEMENTARY = (
    "sqrt", "cbrt", "exp", "log", "sin", "cos", "tan", "cot", "sec", "csc", "asin", "acos", "atan", "acot",
    "atan2", "sinh", "cosh", "tanh", "coth", "sech", "csch", "asinh", "acosh", "atanh", "sinc", "sign",
    "Heaviside",
)
SPECIAL = (
    "erf", "erfc", "gamma", "loggamma", "besselj", "bessely", "besseli", "besselk", "airyai", "airybi",
    "elliptic_k", "elliptic_e", "LambertW", "lowergamma", "uppergamma", "Ei",
)
# fmt: on
FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(sp, name) for name in (*ELEMENTARY, *SPECIAL, "Abs", "Rational", "DiracDelta")},
    **{"Max": Max, "Min": Min, "max": Max, "min": Min, "floor": sp.floor, "ceiling": sp.ceiling, "Mod": sp.Mod},
    "frac": sp.frac,
    **BOUNDED,
    "ln": sp.log,
    "log10": lambda x: sp.log(x) / sp.log(10),
    "log2": lambda x: sp.log(x) / sp.log(2),
    "log1p": lambda x: sp.log(1 + x),
    "expm1": lambda x: sp.exp(x) - 1,
    "hypot": lambda x, y: sp.sqrt(x**2 + y**2),
    "abs": sp.Abs,
}
CONSTANTS = {"pi": sp.pi, "E": sp.E, "I": sp.I}
RELATIONS = {ast.Lt: sp.Lt, ast.LtE: sp.Le, ast.Gt: sp.Gt, ast.GtE: sp.Ge}


def read(text: str, names: Collection[str] = ()) -> sp.Expr:
    """The expression that a text states."""
    value, _ = _Reader(_spelled(names)).visit(parsed(text, FUNCTIONS), 0)
    return value


def stated(
    argument: str,
    expression: Any,
    names: Collection[str] = (),
    remedy: str = "Correct the text, or pass a SymPy expression",
) -> sp.Expr:
    """The expression that an argument states, as text or SymPy's, in real symbols; refused where it cannot be read."""
    try:
        if isinstance(expression, str):
            coordinates = (w for w in re.findall(r"[A-Za-z_]\w*", expression) if COORDINATE.fullmatch(w))
            return of_sympy(read(expression, {*names, *coordinates}), names)
        return of_sympy(sp.sympify(expression, strict=True), names)
    except sp.SympifyError:
        remedy = "; of a function make HamiltonianSystem(hamiltonian=f, ndof=d)" if callable(expression) else ""
        raise ValueError(
            f"`{argument}` must be a scalar expression; got {type(expression).__name__}: pass a string or a SymPy "
            f"expression{remedy}."
        ) from None
    except Unreadable as error:
        if isinstance(expression, str):
            shown = expression if len(expression) <= 200 else expression[:200] + "..."
            raise ValueError(f"`{argument}` cannot be parsed: {shown!r} ({error}). {remedy}.") from None
        raise ValueError(f"`{argument}` must be a scalar expression: {error}.") from None


def of_sympy(expression: sp.Basic, names: Collection[str] = ()) -> sp.Expr:
    """A SymPy expression as `read` gives one of a text: a number, its symbols real; of a matrix with one entry that."""
    shape = getattr(expression, "shape", ())
    if shape == (1, 1):
        expression = expression[0, 0]
    elif shape:
        raise Unreadable(f"it is a matrix of shape {shape}, not a number: take one entry")
    if not isinstance(expression, sp.Expr):
        raise Unreadable(f"it is a {type(expression).__name__}, not a number")
    spelled = _spelled(names)
    f = expression.xreplace(
        {
            s: sp.Symbol(spelled.get(unicodedata.normalize("NFKC", s.name), s.name), real=True)
            for s in expression.free_symbols
        }
    )
    return with_own_functions(f)


def complex_part(f: sp.Expr) -> sp.Expr | None:
    """A part of an expression that is not real, whatever the values of its symbols; None without."""
    if f.has(sp.I):
        return sp.I
    powers = (a for a in f.atoms(sp.Pow) if not a.exp.is_number and a.base.is_negative)
    return min(powers, key=sp.default_sort_key, default=None)


def _spelled(names: Collection[str]) -> dict[str, str]:
    """Names by how Python reads them in code: the micro sign, for instance, as the Greek letter."""
    return {unicodedata.normalize("NFKC", name): name for name in names}


class _Reader:
    """Each method returns a value and the number of terms that it has when multiplied out."""

    def __init__(self, names: dict[str, str]) -> None:
        self.names = names

    def visit(self, node: ast.AST, depth: int) -> tuple[Any, int]:
        if depth > MAX_NESTING:
            raise Unreadable(f"it is nested more than {MAX_NESTING} deep")
        depth += 1
        if isinstance(node, ast.Constant):
            return _literal(node.value), 1
        if isinstance(node, ast.Name):
            return self._name(node.id), 1
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            value, terms = self.visit(node.operand, depth)
            return (-value if isinstance(node.op, ast.USub) else value), terms
        if isinstance(node, ast.BinOp):
            if isinstance(node.op, ast.Add | ast.Sub):
                return self._sum(node, depth)
            if isinstance(node.op, ast.Mult | ast.Div):
                return self._product(node, depth)
            if isinstance(node.op, ast.Pow):
                return self._power(*self.visit(node.left, depth), *self.visit(node.right, depth))
        if isinstance(node, ast.Call):
            return self._call(node, depth)
        raise Unreadable(
            f"{_excerpt(node)} is not understood: numbers, symbols, + - * / **, and {', '.join(sorted(FUNCTIONS))} are"
        )

    def _name(self, name: str) -> sp.Expr:
        if name in CONSTANTS and name not in self.names:
            return CONSTANTS[name]
        return sp.Symbol(self.names.get(name, name), real=True)

    def _sum(self, node: ast.AST, depth: int) -> tuple[sp.Expr, int]:
        values, terms = [], 0
        for member, minus in chain(node, (ast.Add, ast.Sub)):
            value, n = self.visit(member, depth)
            values.append(-value if minus else value)
            terms = _few(terms + n)
        return _checked(sp.Add(*values)), terms

    def _product(self, node: ast.AST, depth: int) -> tuple[sp.Expr, int]:
        value, terms = sp.S.One, 1
        for member, divide in chain(node, (ast.Mult, ast.Div)):
            factor, n = self.visit(member, depth)
            if divide and factor.is_zero:
                raise Unreadable("it divides by zero")
            value, terms = _checked(value / factor if divide else value * factor), _few(terms * n)
        return value, terms

    def _power(self, base: sp.Expr, terms: int, exponent: sp.Expr, _: int) -> tuple[sp.Expr, int]:
        if not exponent.is_number:
            return base**exponent, 1
        size = float(_magnitude(exponent))
        if base.is_number:
            magnitude = float(_magnitude(base))
            if magnitude == 0 and not exponent.is_positive:
                raise Unreadable("it divides by zero")
            if magnitude and abs(math.log10(magnitude)) * size > 300:
                raise Unreadable(f"the number {base}**{exponent} is out of range")
            if base.is_Rational and max(base.p.bit_length(), base.q.bit_length()) * size > MAX_BITS:
                base = base.evalf(17)
            return _checked(base**exponent), 1
        if size > MAX_EXPONENT:
            raise Unreadable(f"an exponent of {exponent} is larger than {MAX_EXPONENT:g}")
        n = math.floor(size)
        largest = max((abs(math.log10(m)) for a in base.atoms(sp.Number) if (m := _magnitude(a))), default=0.0)
        if largest * max(size, 1.0) > 300:
            raise Unreadable(f"an exponent of {exponent} makes its numbers out of range")
        if terms > 1 and n > 1:
            terms = _few(math.comb(n + terms - 1, min(n, terms - 1)))
        return _checked(base**exponent), terms

    def _call(self, node: ast.Call, depth: int) -> tuple[sp.Expr, int]:
        name = node.func.id if isinstance(node.func, ast.Name) else None
        if node.keywords or name is None or name in self.names:
            raise Unreadable(f"{_excerpt(node)} is not understood: a function is called by its name, as in sin(q)")
        if len(node.args) > MAX_ARGUMENTS:
            raise Unreadable(f"{name} has {len(node.args)} arguments, more than {MAX_ARGUMENTS}: give H by functions")
        if name == "Piecewise":
            return _checked(self._piecewise(node, depth)), 1
        if name not in FUNCTIONS:
            raise Unreadable(f"the function {name} is unknown: {', '.join(sorted(FUNCTIONS))} are known")
        values, counts = zip(*(self.visit(a, depth) for a in node.args), strict=True) if node.args else ((), ())
        numbers = all(v.is_number for v in values)
        if name == "Rational" and not (values and all(v.is_Rational for v in values) and not values[-1].is_zero):
            raise Unreadable("Rational takes whole numbers, as in Rational(1, 3)")
        if name in SPECIAL and numbers:
            if any(_magnitude(v) > MAX_ARGUMENT for v in values):
                raise Unreadable(f"{_excerpt(node)} is out of range")
            values = tuple(v.evalf(17) for v in values)  # gamma of a whole number would be exact, and long
        try:
            value = FUNCTIONS[name](*values)
        except (TypeError, ValueError) as error:
            raise Unreadable(f"{_excerpt(node)} is not understood ({' '.join(str(error).split())})") from None
        return _checked(value), max(counts, default=1)

    def _piecewise(self, node: ast.Call, depth: int) -> sp.Expr:
        pieces = []
        for pair in node.args:
            if not (isinstance(pair, ast.Tuple) and len(pair.elts) == 2):
                raise Unreadable("Piecewise takes pairs, as in Piecewise((q, q > 0), (0, True))")
            pieces.append((self.visit(pair.elts[0], depth)[0], self._condition(pair.elts[1], depth)))
        if not pieces:
            raise Unreadable("Piecewise has no pieces")
        return sp.Piecewise(*pieces)

    def _condition(self, node: ast.AST, depth: int) -> Any:
        if isinstance(node, ast.Constant) and isinstance(node.value, bool):
            return node.value
        if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in RELATIONS:
            left, right = self.visit(node.left, depth)[0], self.visit(node.comparators[0], depth)[0]
            return RELATIONS[type(node.ops[0])](left, right)
        if isinstance(node, ast.BinOp | ast.BoolOp) or (isinstance(node, ast.Compare) and len(node.ops) > 1):
            raise Unreadable(
                f"the condition {_excerpt(node)} is not a single comparison: order the pieces, as in "
                "Piecewise((0, q < 0), (q, q < 1), (1, True))"
            )
        raise Unreadable(f"the condition {_excerpt(node)} is not understood: write it as q > 0 or True")


def _literal(value: Any) -> sp.Expr:
    if isinstance(value, int) and not isinstance(value, bool):
        if value.bit_length() > 1000:
            raise Unreadable("it has a number out of range")
        return sp.Integer(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise Unreadable("it has a number out of range")
        return sp.Float(value)
    raise Unreadable(f"{_shortened(repr(value))} is not a number")


def _magnitude(number: sp.Expr) -> float:
    """|x| of a number; refuses a number that is not finite or not real."""
    if number.is_Rational and number.p == 0:
        return 0.0
    try:
        size = float(abs(number.evalf(17)))
    except (TypeError, OverflowError, ValueError):
        size = math.inf
    if not size < 1e305:
        raise Unreadable("it has a number that is infinite or out of range")
    return size


def _checked(value: sp.Expr) -> sp.Expr:
    """A value, if it is a number one of moderate size."""
    if not isinstance(value, sp.Expr) or value.has(sp.zoo, sp.oo, sp.nan):
        raise Unreadable("it has a number that is infinite or undefined")
    if not value.is_number:
        _magnitude(value.as_coeff_Mul()[0])
        return value
    _magnitude(value)
    if value.is_Rational and max(abs(value.p).bit_length(), value.q.bit_length()) > MAX_BITS:
        return value.evalf(17)
    return value


def _few(terms: int) -> int:
    if terms > MAX_TERMS:
        raise Unreadable(f"multiplied out it has more than {MAX_TERMS:,} terms")
    return terms


def _excerpt(node: ast.AST) -> str:
    try:
        return _shortened(ast.unparse(node))
    except RecursionError:
        return "a part of it"


def _shortened(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
