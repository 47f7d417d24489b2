"""Functions that SymPy has otherwise: sin(x)/x, accurate where x is small, Max and Min, compared with numbers, elliptic
integrals with derivatives at 0, and quotients of exponentials that do not overflow."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, reduce
from typing import Any

import sympy as sp
from sympy.codegen.cfunctions import expm1, log1p
from sympy.core.sorting import ordered

_X = sp.Symbol("x", real=True)
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


class _Smooth(sp.Function):
    """A function of one real number whose derivatives are made of functions that neither overflow nor cancel."""

    nargs = 1
    is_real = True
    written: Any
    slope: Any

    @classmethod
    def eval(cls, x: sp.Expr) -> sp.Expr | None:
        return cls.written(x).rewrite(sp.exp).rewrite(sp.log) if x.is_number else None

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return type(self).slope(self.args[0])

    def _code(self, printer: Any) -> str:
        """The name by which SymPy's printers of code ask."""
        written = type(self).written(sp.Symbol("its_argument", real=True))
        return f"({printer._print(written)})".replace("its_argument", f"({printer._print(self.args[0])})")

    _pythoncode = _numpycode = _mpmathcode = _code

    def _torchcode(self, printer: Any) -> str:
        return f"{type(self).__name__}({printer._print(self.args[0])})"


class expit(_Smooth):
    """1/(1 + exp(−x))."""

    written = staticmethod(lambda x: 1 / (1 + sp.exp(-x)))
    slope = staticmethod(lambda x: expit(x) * expit(-x))


class bose(_Smooth):
    """1/(exp(x) − 1)."""

    written = staticmethod(lambda x: 1 / expm1(x))
    slope = staticmethod(lambda x: bose(x) * bose(-x))


class softplus(_Smooth):
    """log(1 + exp(x))."""

    written = staticmethod(lambda x: Max(x, 0) + log1p(sp.exp(-sp.Abs(x))))
    slope = expit


class logcosh(_Smooth):
    """log(cosh(x))."""

    written = staticmethod(lambda x: sp.Abs(x) + log1p(sp.exp(-2 * sp.Abs(x))) - sp.log(2).evalf(17))
    slope = sp.tanh


class triangle(_Smooth):
    """asin(sin(x)), whose slope is 1 or −1."""

    written = staticmethod(lambda x: sp.asin(sp.sin(x), evaluate=False))
    slope = staticmethod(lambda x: sp.sign(sp.cos(x)))


BOUNDED = {function.__name__: function for function in (expit, bose, softplus, logcosh, triangle)}


class hyp2f1(sp.Function):
    """Gauss's hypergeometric function of three numbers and x, for the derivatives of elliptic integrals."""

    nargs = 4
    is_real = True

    def fdiff(self, argindex: int = 4) -> sp.Expr:
        a, b, c, x = self.args
        return a * b / c * hyp2f1(a + 1, b + 1, c + 1, x)


class elliptic_k(sp.elliptic_k):
    """K(m), whose derivative SymPy has as 0/0 at 0."""

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        return sp.pi / 8 * hyp2f1(sp.Rational(3, 2), sp.Rational(3, 2), 2, self.args[0])


class elliptic_e(sp.elliptic_e):
    """E(m), whose derivative SymPy has as 0/0 at 0, or E(z, m)."""

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        if len(self.args) == 2:
            return sp.elliptic_e(*self.args).fdiff(argindex)
        return -sp.pi / 8 * hyp2f1(sp.Rational(1, 2), sp.Rational(3, 2), 2, self.args[0])


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
    if f.has(sp.asin, sp.acos):
        for wave, shift in ((sp.sin, 0), (sp.cos, sp.pi / 2)):
            for arc, sign in ((sp.asin, 1), (sp.acos, -1)):
                x = sp.Wild("x")
                f = f.replace(arc(wave(x)), sp.pi / 4 * (1 - sign) + sign * triangle(x + shift))
    f = f.replace(sp.elliptic_k, elliptic_k).replace(sp.elliptic_e, elliptic_e)
    return _without_overflow(_with_sinc(_with_extrema(f)))


# quotients of exponentials --------------------------------------------------------------------------------------------


def _without_overflow(f: sp.Expr) -> sp.Expr:
    """An expression whose logarithms, and quotients, of a sum of two exponentials are written by `BOUNDED`."""
    if f.has(sp.log) and f.has(sp.exp, sp.cosh):
        f = f.replace(sp.log, _logarithm)
    divisors = [a.base for a in f.atoms(sp.Pow) if a.exp.could_extract_minus_sign() and a.exp.is_number]
    if not any(base.has(sp.exp, sp.cosh, sp.sinh) for base in divisors):
        return f
    f = f.replace(lambda e: e.is_Pow and e.exp.is_number and e.exp.is_negative, _inverse)
    return f.replace(lambda e: e.is_Mul and e.has(expit, bose, sp.sech, sp.csch), _gathered)


def _two_exponentials(f: sp.Expr) -> tuple[sp.Expr, sp.Expr, sp.Expr, sp.Expr] | None:
    """a, u, b and v of a sum a exp(u) + b exp(v) of two terms with numbers a and b, the second constant if one is."""
    if not f.is_Add or len(f.args) != 2 or not f.has(sp.exp):
        return None
    found = []
    for term in f.args:
        factor, rest = term.as_coeff_Mul()
        number, wave = (factor * rest, sp.S.One) if rest.is_number else (factor, rest)
        if not (wave == 1 or isinstance(wave, sp.exp)):
            return None
        found.append((number, wave.args[0] if wave != 1 else sp.S.Zero))
    (a, u), (b, v) = sorted(found, key=lambda each: each[1] == 0)
    return a, u, b, v


def _logarithm(x: sp.Expr) -> sp.Expr:
    """log x; of a sum of exponentials, or a cosh, without these."""
    factor, wave = x.as_coeff_Mul()
    if factor.is_positive and isinstance(wave, sp.cosh):
        return sp.log(factor) + logcosh(wave.args[0])
    found = _two_exponentials(x)
    if found is None or not (found[0].is_positive and found[2].is_positive):
        return sp.log(x)
    a, u, b, v = found
    return sp.log(b) + v + softplus(u - v + sp.log(a / b))


def _inverse(f: sp.Pow) -> sp.Expr:
    """A negative power of cosh, sinh, or a sum of two exponentials."""
    base, n = f.args
    for wave, other in ((sp.cosh, sp.sech), (sp.sinh, sp.csch)):
        if isinstance(base, wave):
            return other(base.args[0]) ** -n
    found = _two_exponentials(base)
    if found is None:
        return f
    a, u, b, v = found
    shift, even = sp.log(abs(a / b)), (a / b).is_positive
    if not (even or (n.is_Integer and (a / b).is_negative)):
        return f
    if v == 0:
        return ((expit(-u - shift) / b) if even else (bose(u + shift) / -b)) ** -n
    if sp.expand(u + v) == 0:
        return ((sp.sech if even else sp.csch)(u + shift / 2) / (2 * sp.sign(a) * sp.sqrt(abs(a * b)))) ** -n
    return f


def _gathered(f: sp.Mul) -> sp.Expr:
    """A product in which exponentials, sinh and cosh are taken together with what divides by them."""
    sums = [a for a in f.args if a.is_Add and a.has(sp.exp, sp.sinh, sp.cosh)]
    if sums:
        rest = [a for a in f.args if a not in sums]
        return sp.Add(*[_gathered(sp.Mul(term, *rest)) for term in sp.Add.make_args(sp.expand_mul(sp.Mul(*sums)))])
    for factor in f.args if f.is_Mul else ():
        wave, n = factor.as_base_exp()
        for other in f.args:
            inverse, m = other.as_base_exp()
            if (replaced := _together(wave, n, inverse, m)) is not None:
                return _gathered(sp.Mul(replaced, *(a for a in f.args if a not in (factor, other))))
    return f


_TAKEN: dict[tuple[type, int], Callable[[sp.Expr], sp.Expr]] = {
    (expit, -1): lambda x: expit(-x),
    (bose, 1): lambda x: -bose(-x),
    (sp.sech, 1): lambda x: 2 * expit(2 * x),
    (sp.sech, -1): lambda x: 2 * expit(-2 * x),
    (sp.csch, 1): lambda x: -2 * bose(-2 * x),
    (sp.csch, -1): lambda x: 2 * bose(2 * x),
}
"""Products of exp(x) or exp(−x) and what divides by it."""


def _together(wave: sp.Expr, n: sp.Expr, inverse: sp.Expr, m: sp.Expr) -> sp.Expr | None:
    """waveⁿ · inverseᵐ in one expression that does not overflow, where one divides by the other; else None."""
    if not (m.is_number and m.is_positive):
        return None
    if wave == sp.E and isinstance(inverse, expit | bose | sp.sech | sp.csch):  # exp(n)
        (x,) = inverse.args
        ratios = {sp.cancel(n.diff(s) / x.diff(s)) for s in x.free_symbols}
        ratio = ratios.pop()
        taken = _TAKEN.get((type(inverse), 1 if ratio.is_positive else -1))
        if ratios or not ratio.is_number or taken is None or not (ratio.is_Integer or taken(x).has(expit)):
            return None
        r = min(abs(ratio), m)
        return sp.exp(sp.expand(n - sp.sign(ratio) * r * x)) * inverse ** (m - r) * taken(x) ** r
    for above, below, quotient in ((sp.sinh, sp.sech, sp.tanh), (sp.cosh, sp.csch, sp.coth)):
        if isinstance(wave, above) and isinstance(inverse, below) and wave.args == inverse.args and n.is_positive:
            r = min(n, m)
            return wave ** (n - r) * inverse ** (m - r) * quotient(wave.args[0]) ** r
    return None


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
