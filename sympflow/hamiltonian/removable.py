"""Functions that SymPy has otherwise: sin(x)/x, accurate where x is small, Max and Min, compared with numbers, elliptic
integrals with derivatives at 0, and quotients of exponentials that do not overflow."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any

import mpmath
import sympy as sp
from sympy.codegen.cfunctions import expm1, log1p
from sympy.core.sorting import ordered
from sympy.printing.precedence import PRECEDENCE

X = sp.Symbol("x", real=True)
DIGITS, SAMPLES, LOWEST, COEFFICIENTS = 60, 192, 16, 48  # digits, values and powers, that give a series
BESIDE = 300  # digits of values beside a place, which are left where parts of them cancel
CIRCLES = 1.0, 0.25, 2.0**-4, 2.0**-7, 2.0**-10  # radii on which a function is sampled
ALIKE = 1e-8  # relative difference, at most, of values beside a place where the function is finite
NOISE, VANISHING = 1e-50, 1e-20  # of coefficients of a series: of rounding, and of powers that it should not have
TAIL, LONGEST = 1e-20, 2.0  # share that a series leaves out, and the largest radius within which it is taken
MOST_TERMS = 64  # of a sum, each infinite at a place, that are compared with each other


def _bounded(name: str) -> Callable[[Any], Any]:
    """A function of mpmath for which numbers beyond double precision are infinite: of them it would need hours."""
    function, limits = getattr(mpmath, name), _LIMITS.get(name)

    def value(x: Any) -> Any:
        x = mpmath.mpmathify(x)
        if mpmath.im(x) != 0 or not mpmath.isfinite(x) or abs(x) < LARGEST:
            return function(x)
        if limits is None or (limit := limits[x > 0]) is None:
            raise OverflowError(name)
        return mpmath.mpf(limit)

    return value


_LIMITS: dict[str, tuple[float | None, float | None]] = {
    "exp": (0.0, None), "tanh": (-1.0, 1.0), "coth": (-1.0, 1.0), "sech": (0.0, 0.0), "csch": (0.0, 0.0),
}  # fmt: skip
"""Limits at −∞ and ∞; None is infinite."""
LARGEST = mpmath.mpf(2) ** 1024
BOUNDED_VALUES = {name: _bounded(name) for name in ("sin", "cos", "tan", "cot", "sec", "csc", "sinh", "cosh", *_LIMITS)}


class _Formula(sp.Atom):
    """A function of x, which is no part of the expression that holds it."""

    def __new__(cls, f: sp.Expr) -> _Formula:
        made = super().__new__(cls)
        made.f = f
        return made

    def _hashable_content(self) -> tuple[sp.Expr]:
        return (self.f,)

    def _sympystr(self, printer: Any) -> str:
        return f"{type(self).__name__}({printer._print(self.f)})"

    _sympyrepr = _sympystr


class removed(sp.Function):
    """The n-th derivative, at a, of a function of x that is finite at 0, but 0/0 or ∞ − ∞: near 0 by its series."""

    nargs = 3
    is_real = True

    @classmethod
    def eval(cls, formula: _Formula, a: sp.Expr, n: sp.Expr) -> sp.Expr | None:
        if a.is_Pow and a.exp == sp.S.Half and not any(_coefficients(formula.f)[1::2]):
            return cls(_Formula(formula.f.xreplace({X: sp.sqrt(X)})), a.base, n) if n == 0 else None
        if not a.is_number:
            return None
        radius, series = _series(formula.f, int(n))
        return series.xreplace({X: a}) if abs(a) < radius else formula.f.diff(X, n).xreplace({X: a})

    def _eval_derivative(self, s: sp.Symbol) -> sp.Expr:
        formula, a, n = self.args
        return removed(formula, a, n + 1) * a.diff(s)

    @property
    def formula(self) -> sp.Expr:
        """The function of x, whatever its argument is."""
        formula, _, n = self.args
        return _without_overflow(formula.f.diff(X, n))

    @property
    def written_out(self) -> sp.Expr:
        """The same in functions that code has, each branch finite wherever it is evaluated."""
        formula, a, n = self.args
        radius, series = _series(formula.f, int(n))
        near, far = Max(Min(a, radius), -radius), a + (radius - a) * Max(sp.sign(radius - sp.Abs(a)), 0)
        return sp.Piecewise((series.xreplace({X: near}), sp.Abs(a) < radius), (self.formula.xreplace({X: far}), True))

    def _code(self, printer: Any) -> str:
        """The name by which SymPy's printers of code ask."""
        text: str = printer._print(self.written_out)
        return text

    _pythoncode = _numpycode = _torchcode = _mpmathcode = _code

    def _as_formula(self, printer: Any) -> str:
        return printer.parenthesize(self.formula.xreplace({X: self.args[1]}), PRECEDENCE["Func"])

    _sympystr = _latex = _as_formula


@lru_cache
def _series(f: sp.Expr, n: int = 0) -> tuple[float, sp.Expr]:
    """The n-th derivative of the series of f by Horner's rule, and the radius within which it is taken."""
    powers = [(k, c) for k, c in enumerate(_coefficients(f)) if c]
    powers = [(k - n, c * math.perm(k, n)) for k, c in powers if k >= n] or [(0, mpmath.mpf(0))]
    first, leading = powers[0]
    last = [(k - first, abs(c / leading)) for k, c in powers[1:][-4:]]
    radius = min([LONGEST, *(float((TAIL / c) ** (1 / mpmath.mpf(k))) for k, c in last)])
    powers = [(k, c) for k, c in powers if abs(c) * radius ** (k - first) >= TAIL / 1000 * abs(leading)]
    series, above = sp.S.Zero, powers[-1][0]
    for k, c in reversed(powers):
        series, above = sp.Float(c, 17) + X ** (above - k) * series, k
    return radius, series * X**first


@lru_cache
def _coefficients(f: sp.Expr) -> tuple[Any, ...]:
    """The Taylor coefficients of a function at 0, where it is 0/0 or ∞ − ∞; none of any other.

    They are Cauchy's integrals, and those of negative powers must vanish.
    """
    with mpmath.workdps(DIGITS), suppress(ArithmeticError, ValueError, TypeError, NameError):
        function = sp.lambdify(X, f, [BOUNDED_VALUES, "mpmath"])
        with suppress(ZeroDivisionError):
            if mpmath.isfinite(function(mpmath.mpf(0))):
                return ()
        with mpmath.workdps(BESIDE):
            beside = [function(mpmath.mpf(x)) for x in (1e-20, -1e-20, 1e-10)]
        size = max(map(abs, beside))
        if not all(mpmath.isfinite(y) and abs(y - beside[0]) <= ALIKE * (size + 1) for y in beside):
            return ()
        turns = [mpmath.expjpi(j / mpmath.mpf(SAMPLES)) for j in range(2 * SAMPLES)]
        for radius in CIRCLES:
            values = [(j, function(radius * turns[j])) for j in range(1, SAMPLES, 2)]
            size = max(abs(y) for _, y in values)
            means = {
                k: sum((y * turns[-j * k % len(turns)]).real for j, y in values) * 2 / SAMPLES
                for k in range(-LOWEST, COEFFICIENTS)
            }
            if all(abs(means[-k]) <= VANISHING * size for k in range(1, LOWEST)):
                kept = [means[k] if abs(means[k]) > NOISE * size else 0 for k in range(COEFFICIENTS)]
                return tuple(c / mpmath.mpf(radius) ** k for k, c in enumerate(kept))
    return ()


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
    f = _without_overflow(_with_extrema(f.replace(sp.sinc, lambda x: sp.sin(x) / x)))
    f = f.replace(lambda e: _is_root(e) or isinstance(e, sp.log), lambda e: e.func(_square(e.args[0]), *e.args[1:]))
    f = _without_places(_without_places(f), divided=True)
    return f.replace(lambda e: _is_root(e) and e.exp.is_number and float(2 * e.exp) % 2 == 1, _root)


# what vanishes as a square --------------------------------------------------------------------------------------------


def _is_root(f: sp.Expr) -> bool:
    return f.is_Pow and f.base.is_Add and (f.exp.is_integer is False or f.exp.could_extract_minus_sign())


_SQUARES: tuple[tuple[Callable[[Any], sp.Expr], int, Callable[[Any], sp.Expr]], ...] = (
    (sp.cos, 1, lambda a: -2 * sp.sin(a / 2) ** 2),
    (sp.cos, -1, lambda a: 2 * sp.cos(a / 2) ** 2),
    (sp.sin, 1, lambda a: -2 * sp.sin(a / 2 - sp.pi / 4) ** 2),
    (sp.sin, -1, lambda a: 2 * sp.cos(a / 2 - sp.pi / 4) ** 2),
    (sp.cosh, 1, lambda a: 2 * sp.sinh(a / 2) ** 2),
    (lambda a: sp.cos(a) ** 2, 1, lambda a: -(sp.sin(a) ** 2)),
    (lambda a: sp.sin(a) ** 2, 1, lambda a: -(sp.cos(a) ** 2)),
    (lambda a: sp.cosh(a) ** 2, 1, lambda a: sp.sinh(a) ** 2),
)
"""Functions f(a), numbers c that they touch, and f(a) − c as a product."""


def _square(f: sp.Expr) -> sp.Expr:
    """A sum c (f(a) − f₀) as a product, where f touches f₀, as 1 − cos a; any other as it is."""
    if not f.is_Add:
        return f
    f = f.replace(lambda e: e.is_Add, _hyperbolic)
    constant, term = f.as_independent(*(wave for wave in f.atoms(sp.Function)), as_Add=True)
    for wave, touched, product in _SQUARES:
        for a in {each.args[0] for each in term.atoms(sp.cos, sp.sin, sp.cosh)}:
            factor = term / wave(a)
            if not factor.has(sp.Function) and sp.expand(constant + touched * factor) == 0:
                return factor * product(a)
    return f


def _hyperbolic(f: sp.Add) -> sp.Expr:
    """A sum in which c eᵃ + c e⁻ᵃ is 2c cosh a."""
    for wave in f.atoms(sp.exp):
        a = wave.args[0]
        up, down = f.coeff(sp.exp(a)), f.coeff(sp.exp(-a))
        if up != 0 and up == down:
            return f + up * (2 * sp.cosh(a) - sp.exp(a) - sp.exp(-a))
    return f


def _root(f: sp.Pow) -> sp.Expr:
    """A root; of what vanishes as the square of a does with |a| before it, as |a| √((eᵃ − 1 − a)/a²)."""
    base, n = f.args
    if not base.has(sp.Function) and all(power.exp.is_Integer for power in base.atoms(sp.Pow)):
        return f
    arguments = [wave.args[0] for wave in base.atoms(sp.Function)]
    for a in dict.fromkeys((*arguments, *sorted(base.free_symbols, key=str))):
        if isinstance(a, sp.Expr) and (found := _finite([base / a**2], divided=False)) is not None:
            return sp.Abs(a) ** (2 * n) * found**n
    return f


def with_values(f: sp.Expr, values: Mapping[sp.Symbol, Any]) -> Any:
    """An expression with values of parameters, by which parts of it may cancel."""
    found = f.xreplace(values)
    return with_own_functions(found) if may_cancel(f, set(values)) else found


def cancelling(f: sp.Expr) -> tuple[int, int]:
    """The numbers of places where parts of f cancel: of those written by series, and of roots of sums."""
    return len(f.atoms(removed)), sum(_is_root(e) and e.exp.is_integer is False for e in f.atoms(sp.Pow))


def may_cancel(f: sp.Expr, parameters: set[sp.Symbol]) -> bool:
    """Return True if parts of f may cancel by the values of parameters where they are infinite, or under a root."""
    if not f.free_symbols & parameters:
        return False
    places = [e for e in sp.Add.make_args(f) if _divisors(e)]
    sums = [e for e in f.atoms(sp.Add) if e != f and e.has(sp.Function) and e.free_symbols & parameters]
    roots = any(_is_root(e) and e.exp.is_integer is False for e in f.atoms(sp.Pow))
    return _unlike(places) or (bool(sums) and (roots or bool(places)))


def exact(value: float) -> sp.Expr:
    """The number as it stands in an expression: integers as such."""
    return sp.nsimplify(value) if float(value).is_integer() else sp.Float(value)


# quotients of exponentials --------------------------------------------------------------------------------------------


def _without_overflow(f: sp.Expr) -> Any:
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


# what is infinite at a place in parts alone ---------------------------------------------------------------------------


_INFINITE = sp.csch, sp.coth, sp.csc, sp.cot, sp.log, bose


def _divisors(f: sp.Expr) -> list[sp.Expr]:
    """Expressions where f, or a part of it, is infinite if they vanish."""
    powers = [a.base for a in f.atoms(sp.Pow) if a.exp.is_number and a.exp.is_negative]
    return [a for a in (*powers, *(a.args[0] for a in f.atoms(*_INFINITE))) if a.free_symbols]


def _unlike(terms: Sequence[sp.Expr]) -> bool:
    """True if terms that are infinite somewhere are not powers of one divisor alone, which do not cancel."""
    apart = len({a for term in terms for a in _divisors(term)}) > 1
    return len(terms) > 1 and (apart or any(term.has(sp.Function) for term in terms))


def _without_places(f: Any, divided: bool = False) -> Any:
    """An expression whose products and sums that are finite where their parts are not are written by `removed`.

    These are divided by other letters last, as q csch(kq) by k.
    """
    if not f.args or not _divisors(f):
        return f
    if f.is_Mul or f.is_Pow:
        return _finite([f], divided) or f.func(*(_without_places(x, divided) for x in f.args))
    f = f.func(*(_without_places(x, divided) for x in f.args))
    infinite = [term for term in f.args if _divisors(term)] if f.is_Add else []
    if len(infinite) <= MOST_TERMS and _unlike(infinite) and (found := _finite(infinite, divided)) is not None:
        return found + sp.Add(*(term for term in f.args if term not in infinite))
    return f


def _finite(terms: Sequence[sp.Expr], divided: bool) -> sp.Expr | None:
    """The sum of terms, some of them by `removed`; None if there is none that is 0/0 or ∞ − ∞ somewhere, and finite."""
    exact = {term: _exact(term) for term in terms}
    divisors = [b for term in exact.values() for b in _divisors(term)]
    roots = [s for b in divisors if len(b.free_symbols) == 1 for s in b.free_symbols]
    arguments = [
        f.args[0] for term in exact.values() for f in term.atoms(sp.Function) if isinstance(f.args[0], sp.Expr)
    ]
    for a in dict.fromkeys((*arguments, *divisors, *roots)):
        for with_x in _substitutions(a, set().union(*(b.free_symbols for b in divisors))):
            groups: dict[sp.Expr, list[tuple[sp.Expr, sp.Expr]]] = {}
            for term, f in exact.items():
                changed = f.xreplace(with_x).replace(lambda e: e.is_Add and e.free_symbols > {X}, sp.expand)
                alone = [b for b in sp.Mul.make_args(changed) if b.free_symbols <= {X}]
                rest = sp.Mul(*(b for b in sp.Mul.make_args(changed) if b not in alone))
                groups.setdefault(rest, []).append((term, sp.Mul(*alone)))
            sums = {rest: sp.Add(*(alone for _, alone in group)) for rest, group in groups.items()}
            found = {
                rest: f
                for rest, f in sums.items()
                if (divided or not any(b.free_symbols & a.free_symbols for b in _divisors(rest)))
                and not f.as_coeff_Mul()[1].is_Pow
                and _coefficients(f)
            }
            if found:
                kept = [term for rest, group in groups.items() for term, _ in group if rest not in found]
                rests = {rest: _without_places(rest.xreplace({X: a}), divided) for rest in found}
                return sp.Add(*kept, *(rests[rest] * removed(_Formula(f), a, 0) for rest, f in found.items()))
    return None


def _exact(f: sp.Expr) -> sp.Expr:
    """An expression with fractions in place of decimal ones."""
    return f.xreplace({a: sp.Rational(repr(float(a))) for a in f.atoms(sp.Float)})


def _substitutions(a: sp.Expr, symbols: set[sp.Symbol]) -> list[dict[sp.Expr, sp.Expr]]:
    """Replacements by which a is x: of one of the symbols, in which it is linear, or of itself."""
    slopes = {s: a.diff(s) for s in ordered(a.free_symbols & symbols)}
    linear = [{s: sp.expand((X - a) / c) + s} for s, c in slopes.items() if s not in c.free_symbols]
    return linear or [{a: X}] * bool(slopes)
