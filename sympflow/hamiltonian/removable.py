"""Functions that SymPy has otherwise: sin(x)/x, accurate where x is small, Max and Min, compared with numbers."""

from __future__ import annotations

import math
from functools import lru_cache, reduce
from typing import Any

import sympy as sp
from sympy.core.sorting import ordered

TERMS = 14  # of the series of sin(x)/x, enough for its first derivatives too
SERIES_UP_TO = 2.0


class sinc(sp.Function):
    """The n-th derivative of sin(x)/x: its series where |x| < 2, beyond by n f⁽ⁿ⁻¹⁾ + x f⁽ⁿ⁾ = sin⁽ⁿ⁾ x."""

    nargs = (1, 2)
    is_real = True

    @classmethod
    def eval(cls, x: sp.Expr, n: sp.Expr = sp.S.Zero) -> sp.Expr | None:
        if x.is_number:
            s = sp.Dummy(real=True)
            return sp.sinc(s).diff(s, n).subs(s, x)
        if x.could_extract_minus_sign():
            return (-1) ** n * cls(-x, n)
        return None

    @property
    def order(self) -> int:
        return int(self.args[1]) if len(self.args) == 2 else 0

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return sinc(self.args[0], self.order + 1)

    @property
    def written_out(self) -> sp.Expr:
        """The same in functions that code has, each branch finite wherever it is evaluated."""
        x, n = self.args[0], self.order
        series, beyond = _branches(n)
        far = {_X: Max(abs(x), SERIES_UP_TO / 2)}
        return sp.Piecewise(
            (series.xreplace({_X: Max(Min(x, 2 * SERIES_UP_TO), -2 * SERIES_UP_TO)}), abs(x) < SERIES_UP_TO),
            (beyond.xreplace(far) * (sp.sign(x) if n % 2 else 1), True),
        )

    def _code(self, printer: Any) -> str:
        """The name by which SymPy's printers of code ask."""
        text: str = printer._print(self.written_out)
        return text

    _pythoncode = _numpycode = _torchcode = _mpmathcode = _code


_X = sp.Symbol("x", real=True)


@lru_cache
def _branches(n: int) -> tuple[sp.Expr, sp.Expr]:
    """The series of the n-th derivative by Horner's rule, and its formula beyond."""
    powers = range((n + 1) // 2, TERMS + n)
    factors = [sp.Float((-1) ** k * math.perm(2 * k, n) / math.factorial(2 * k + 1), 17) for k in powers]
    series = reduce(lambda f, c: c + _X**2 * f, reversed(factors))
    beyond = sp.S.Zero
    for m in range(n + 1):
        beyond = ((sp.sin(_X), sp.cos(_X), -sp.sin(_X), -sp.cos(_X))[m % 4] - m * beyond) / _X
    return series * _X ** (n % 2), beyond


class _Extremum:
    """The largest or smallest argument, each compared with numbers alone: SymPy compares all, which takes minutes."""

    above: bool
    identity: Any
    args: tuple[Any, ...]

    def __new__(cls, *args: Any, **_: Any) -> Any:
        constants: dict[sp.Expr, sp.Expr] = {}
        for each in map(sp.sympify, args):
            for a in each.args if isinstance(each, cls) else (each,):
                if a.is_extended_real is False:
                    raise ValueError(f"The argument {a} is not comparable.")
                number, rest = (a, sp.S.Zero) if a.is_number else a.as_coeff_Add()
                if rest not in constants or bool(number > constants[rest]) is cls.above:
                    constants[rest] = number
        bound, kept = constants.pop(sp.S.Zero, None), [number + rest for rest, number in constants.items()]
        if bound is not None:
            over, under = (a for a in ("is_extended_nonnegative", "is_extended_nonpositive")[:: 1 if cls.above else -1])
            held = any(getattr(a - bound, over) for a in kept)
            kept = [a for a in kept if not getattr(a - bound, under)] + [bound] * (not held)
        if len(kept) < 2:
            return kept[0] if kept else cls.identity
        made = sp.Expr.__new__(cls, *ordered(kept))
        made._argset = frozenset(kept)
        return made

    def fdiff(self, argindex: int) -> sp.Expr:
        rest = [a for i, a in enumerate(self.args) if i != argindex - 1]
        return sp.Heaviside((self.args[argindex - 1] - type(self)(*rest)) * (1 if self.above else -1))

    def _torchcode(self, printer: Any) -> str:
        return f"{'max' if self.above else 'min'}({', '.join(map(printer._print, self.args))})"


class Max(_Extremum, sp.Max):
    """The largest of some expressions."""

    above = True


class Min(_Extremum, sp.Min):
    """The smallest of some expressions."""

    above = False


def with_own_functions(f: sp.Expr) -> sp.Expr:
    """An expression by `Max`, `Min`, `sinc` and, of functions that round, floor and Mod."""
    if f.has(sp.ceiling, sp.frac):
        f = f.replace(sp.frac, lambda x: x - sp.floor(x)).replace(sp.ceiling, lambda x: -sp.floor(-x))
    return _with_sinc(_with_extrema(f))


def _with_extrema(f: sp.Basic) -> Any:
    if not f.has(sp.Max, sp.Min):
        return f
    return {sp.Max: Max, sp.Min: Min}.get(f.func, f.func)(*map(_with_extrema, f.args))


def _with_sinc(f: sp.Expr) -> sp.Expr:
    """An expression whose sin(a)/b and (1 − cos a)/b² are written by `sinc`, where a vanishes as b does."""
    if f.has(sp.sinc):
        f = f.replace(sp.sinc, sinc)
    if not any(power.exp.is_negative and f.has(sp.sin, sp.cos) for power in f.atoms(sp.Pow)):
        return f
    f = f.replace(lambda e: e.is_Add and e.has(sp.cos), _joined)
    return f.replace(lambda e: e.is_Mul and e.has(sp.sin, sp.cos), _divided)


def _joined(f: sp.Add) -> sp.Expr:
    """A sum in which x·cos a − x, with x divided by a power, is −2x sin²(a/2)."""
    terms = list(f.args)
    for term in f.args:
        for wave in (a for a in sp.Mul.make_args(term) if isinstance(a, sp.cos)):
            factor = term / wave
            if -factor in terms and term in terms and any(a.is_Pow and a.exp.is_negative for a in factor.atoms(sp.Pow)):
                terms.remove(-factor)
                terms.remove(term)
                terms.append(_divided(factor * (wave - 1)))
    return sp.Add(*terms)


def _divided(f: sp.Mul) -> sp.Expr:
    """A product whose sines are divided by what vanishes with them."""
    for sum_ in f.args:
        square = _as_square(sum_)
        if square is not None:
            again = _divided(f / sum_ * square)
            return f if again.has(*square.atoms(sp.sin)) else again
    for factor in f.args:
        wave, n = factor.as_base_exp()
        if not isinstance(wave, sp.sin) or not (n.is_Integer and n > 0):
            continue
        for power in f.args:
            base, e = power.as_base_exp()
            for m in (sp.S.One, sp.S.Half):
                if e.is_number and e <= -m and (ratio := _ratio(wave.args[0], base**m)) is not None:
                    return _divided(f / wave / base**-m * sinc(wave.args[0]) * ratio)
    return f


def _as_square(f: sp.Expr) -> sp.Expr | None:
    """c − c cos a as 2c sin²(a/2)."""
    if not f.is_Add or len(f.args) != 2:
        return None
    for term, c in (f.args, f.args[::-1]):
        for wave in (a for a in sp.Mul.make_args(term) if isinstance(a, sp.cos)):
            if term == -c * wave:
                return 2 * c * sp.sin(wave.args[0] / 2) ** 2
    return None


def _ratio(a: sp.Expr, b: sp.Expr) -> sp.Expr | None:
    """a/b, if that does not divide by what b holds."""
    if not a.free_symbols & b.free_symbols:
        return None
    ratio = a / b
    if ratio.free_symbols & b.free_symbols and ratio.is_rational_function():
        ratio = sp.cancel(ratio)
    return None if sp.fraction(ratio)[1].free_symbols & b.free_symbols else ratio
