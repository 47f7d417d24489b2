"""Elementary functions by arithmetic alone: the same operations in a scalar as in every lane of a register.

Each function reduces its argument by an identity, which a comment states, and evaluates a polynomial by Estrin's rule.
What few arguments need, very large ones for instance, is given by the C library, one lane after the other, behind a
branch that others never take.

Errors in units in the last place, for all arguments: below 1 for exp and log, 3 for tanh, 2 for expm1, log1p, atan and
powers; up to `FAR` 2 for sin, cos and tan, 3 on machines without fused operations. Angles beyond `FAR` have the errors
of the C library, and so have the functions that are its own: with glibc below 1 for angles, up to 16 where a sine or
cosine is below 1e-18, and below 4 for the functions. digamma, trigamma: 16 units of their largest term.
Constant powers differ from those of C in this: a half power of −∞ is NaN, x^(−3/2) is 0 where it would be subnormal.

Polynomials of sin, cos and log are those of fdlibm (Sun Microsystems, 1993, free to use with this notice); the others
interpolate at Chebyshev's points. Products after Dekker (1971).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from numpy.polynomial import Polynomial

from sympflow.compiler.control import DOUBLE, LOWERED, Type, Value
from sympflow.compiler.functions import COMPOSED, MOST_DERIVATIVES, OF_SCIPY, SPECIAL, fma, where
from sympflow.compiler.tables import Table

__all__ = ["LOWERED"]

INFINITY, TINY = math.inf, 2.0**-1022
ROUND = 1.5 * 2.0**52  # added and subtracted again, it leaves the nearest whole number; its last bits hold that
SIGN, FRACTION = -(2**63), 2**52 - 1


def _pattern(x: float) -> int:
    """The bits of a double."""
    return int(struct.unpack("<q", struct.pack("<d", x))[0])


ONE, WHOLE, NEAREST, ROOT_HALF = map(_pattern, (1.0, 2.0**52, ROUND, math.sqrt(0.5)))


INLINE, ALWAYS = 3, 1_000_000  # how often a function's operations are copied into a module before it is called


def _lowered(name: str, inline: int = INLINE) -> Callable[[Callable[..., Value]], Callable[..., Value]]:
    """Register machine code for a function of the table, copied in so many times; further uses call it."""

    def register(build: Callable[..., Value]) -> Callable[..., Value]:
        def lowered(*args: Any) -> Value:
            x: Value = args[0]
            full = f"{name}.{x.type.suffix}"
            if x.code.module.used(full) <= inline:
                return build(*args)
            return x.code.outlined(full, args, build, x.type)

        LOWERED[name] = lowered
        return build

    return register


def _constant(x: Value, c: float) -> Value:
    return x.code.constant(c, x.type)


def _compare(how: str, x: Value, y: Any) -> Value:
    """A comparison of another kind than those of numbers: `u…` holds for NaN too."""
    return x.code.op(f"fcmp {how}", x.type.of("i1"), x, x.code.operand(y, x.type))


def _signed(x: Value, sign: Value) -> Value:
    """|x| with the sign of another number."""
    return x.code.intrinsic("llvm.copysign", x, sign)


def _by_library(*args: Value, name: str) -> Value:
    """The value that the C library gives, lane by lane."""
    code, type = args[0].code, args[0].type
    return code.lanes(lambda *lane: code.external(name, lane, DOUBLE), args, type)


def _guarded(name: str, far: Value, fast: Value, *args: Value, slow: Callable[..., Value] | None = None) -> Value:
    """The fast value, or where it does not hold that of a function of its own, by default of the C library."""
    code, type = fast.code, fast.type

    def then() -> list[Value]:
        y = code.outlined(f"{name}.far.{type.suffix}", args, slow or partial(_by_library, name=name), type, rare=True)
        return [code.select(far, y, fast)]

    return code.when(code.any(far), then, lambda: [fast], rare=True)[0]


def _estrin(c: Sequence[Any], z: Value) -> Value:
    """Σ cᵢ zⁱ in few dependent steps: pairs, pairs of pairs …"""
    while len(c) > 1:
        c = [fma(c[i + 1], z, c[i]) if i + 1 < len(c) else c[i] for i in range(0, len(c), 2)]
        if len(c) > 1:
            z = z * z
    value: Value = c[0]
    return value


def _product(x: Value, y: Value) -> tuple[Value, Value]:
    """x·y rounded, and what rounding left."""
    p = x * y
    if x.code.module.fused:
        return p, fma(x, y, -p)
    halves = []
    for a in (x, y):
        high = ((a.bits + 2**26) & -(2**27)).real
        halves.append((high, a - high))
    (a, b), (c, d) = halves
    return p, ((a * c - p) + a * d + b * c) + b * d


def _rest(x: Value, y: Value, z: Value) -> Value:
    """z − x·y for a product close to z."""
    if x.code.module.fused:
        return fma(-x, y, z)
    p, e = _product(x, y)
    return (z - p) - e


# exp, expm1, tanh: eˣ = 2ⁿ eʳ with n the whole number nearest to x/ln 2, so that |r| ≤ ln 2 / 2 -----------------------

LOG2_E = 1.4426950408889634
LN2 = (0.6931471805598903, 5.497923018708371e-14)  # 42 bits, exact times n, and the rest
EXP = (  # (eʳ − 1 − r)/r²
    0.5, 0.16666666666666669, 0.041666666666666664, 0.008333333333330039, 0.0013888888888886537,
    0.00019841269863171557, 2.4801587317228724e-05, 2.7557268276905696e-06, 2.7557282838800484e-07,
    2.5100472505694996e-08, 2.09112987659402e-09,
)  # fmt: skip


def _exponential(x: Value, tail: Value | None = None, exact: bool = True) -> tuple[Value, Value]:
    """n in the last bits of a number, and eʳ − 1, of x + tail; `exact` keeps what rounding r leaves."""
    s = fma(x, LOG2_E, ROUND)
    n = s - ROUND
    r = fma(n, -LN2[0], x)
    if not exact:
        r = fma(n, -LN2[1], r)
        return s.bits, fma(r * r, _estrin(EXP, r), r)
    low = n * -LN2[1] if tail is None else fma(n, -LN2[1], tail)
    first, r = r, r + low
    return s.bits, r + fma(r * r, _estrin(EXP, r), (first - r) + low)


def _power_of_two(n: Value) -> Value:
    """2ⁿ of the whole number in the last bits of n, −1022 to 1023."""
    return ((n << 52) + ONE).real


def _exp_far(x: Value, n: Value, e: Value) -> Value:
    """2ⁿ (1 + e) in two factors, the first of which cannot overflow; 0 and infinity."""
    k = n - NEAREST
    half = x.code.op("ashr", k.type, k, x.code.constant(1, k.type))
    first = _power_of_two(half)
    y = fma(first, e, first) * _power_of_two(k - half)
    return where(x > 710.0, INFINITY, where(x < -746.0, 0.0, y))


@_lowered("exp")
def _exp(x: Value) -> Value:
    n, e = _exponential(x, exact=False)
    p = _power_of_two(n)
    return _guarded("exp", _compare("ugt", abs(x), 708.0), fma(p, e, p), x, n, e, slow=_exp_far)


@_lowered("expm1")
def _expm1(x: Value) -> Value:
    n, e = _exponential(x)
    p = _power_of_two(n)
    far = _compare("ugt", abs(x), 708.0)
    y = _guarded("expm1", far, fma(p, e, p - 1.0), x, n, e, slow=lambda *args: _exp_far(*args) - 1.0)
    return _signed(y, x)


@_lowered("tanh")
def _tanh(x: Value) -> Value:
    """E/(E + 2) with E = e²ˣ − 1."""
    a = abs(x)
    n, e = _exponential(a + a)
    p = _power_of_two(n)
    y = fma(p, e, p - 1.0)
    return _signed(where(a > 22.0, 1.0, y / (y + 2.0)), x)


# log, log1p, pow: x = 2ᵏ (1 + f) with √½ ≤ 1 + f < √2, and ln(1 + f) = 2 artanh s with s = f/(2 + f) -----------------

LOG = (  # fdlibm, of s²: (ln(1 + f)/s − 2)/s²
    6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
    1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01,
)  # fmt: skip


def _binary(x: Value) -> tuple[Value, Value, Value]:
    """k as a double, k + 1023 and 1 + f of a positive normal number; of others |k| > 1021.5."""
    i = x.bits + (ONE - ROOT_HALF)
    k = i >> 52
    return (k | WHOLE).real - (2.0**52 + 1023), k, ((i & FRACTION) + ROOT_HALF).real


def _logarithm(k: Value, f: Value) -> Value:
    """k ln 2 + ln(1 + f)."""
    s = f / (f + 2.0)
    z = s * s
    square = (f * f) * 0.5
    t = fma(s, fma(z, _estrin(LOG, z), square), k * LN2[1])
    return fma(k, LN2[0], -((square - t) - f))


@_lowered("log")
def _log(x: Value) -> Value:
    k, _, m = _binary(x)
    return _guarded("log", abs(k) > 1021.5, _logarithm(k, m - 1.0), x)


@_lowered("log1p")
def _log1p(x: Value) -> Value:
    """ln u with u = 1 + x rounded; what that left is added to f."""
    u = x + 1.0
    b = u - 1.0
    left = (1.0 - (u - b)) + (x - b)
    k, i, m = _binary(u)
    f = fma(left, ((2046 - i) << 52).real, m - 1.0)
    return _signed(_guarded("log1p", abs(k) > 1021.5, _logarithm(k, f), x), x)


ARTANH = (  # ((2 artanh s / s − 2)/s² − 2/3)/s², of s²
    0.4, 0.28571428571429364, 0.22222222221656232, 0.18181818335314404, 0.15384594970895457, 0.13334804238225345,
    0.11706248540922386, 0.11723051028097753,
)  # fmt: skip
TWO_THIRDS = (0.6666666666666666, 3.700743415417188e-17)


def _long_logarithm(x: Value) -> tuple[Value, Value, Value]:
    """k, and ln x as the sum of two numbers, to some 66 bits."""
    k, _, m = _binary(x)
    f = m - 1.0
    d = f + 2.0
    inverse = 1.0 / d
    s = f * inverse
    s_low = (_rest(s, d, f) - s * (f - (d - 2.0))) * inverse
    z, z_low = _product(s, s)
    z_low = fma(s + s, s_low, z_low)
    q_low = fma(z, _estrin(ARTANH, z), TWO_THIRDS[1])
    q = q_low + TWO_THIRDS[0]
    q_low = (TWO_THIRDS[0] - q) + q_low
    r, r_low = _long_product((z, z_low), (q, q_low))
    w = r + 2.0
    y, y_low = _long_product((s, s_low), (w, ((2.0 - w) + r) + r_low))
    whole = k * LN2[0]
    total = whole + y
    low = ((whole - total) + y) + fma(k, LN2[1], y_low)
    high = total + low
    return k, high, (total - high) + low


def _long_product(x: tuple[Value, Value], y: tuple[Value, Value]) -> tuple[Value, Value]:
    """The product of two numbers, each the sum of two."""
    p, e = _product(x[0], y[0])
    return p, fma(x[0], y[1], fma(x[1], y[0], e))


@_lowered("pow")
def _pow(x: Value, y: Value) -> Value:
    """e^(y ln x), the logarithm in double length."""
    k, high, low = _long_logarithm(x)
    p, left = _product(y, high)
    n, e = _exponential(p, fma(y, low, left))
    scale = _power_of_two(n)
    far = (abs(k) > 1021.5) | _compare("ugt", abs(p), 708.0)
    return _guarded("pow", far, fma(scale, e, scale), x, y)


def _floor(x: Value) -> Value:
    return x.code.intrinsic("llvm.floor", x)


@_lowered("power", inline=ALWAYS)
def _power(x: Value, n: float) -> Value:
    """xⁿ for a constant n: products for whole and half numbers up to 16, in double length where three would add up."""
    m = abs(n)
    if m == 0:
        return _constant(x, 1.0)
    if m > 16.5 or m % 0.5:
        if n % 1:
            return LOWERED["pow"](x, _constant(x, n))
        y = LOWERED["pow"](abs(x), _constant(x, n))
        return _signed(y, x) if n % 2 else y
    if n in (-0.5, -1.5):
        return 1.0 / _power(x, m)
    if m % 1:
        x = x + 0.0  # −0 is 0
    b = 1.0 / x if n < 0 else x
    if n in (1, 2, 3, 4, 0.5, 1.5, -1, -2):
        y = b if m >= 1 else _root(x)
        for _ in range(int(m) - 1):
            y = y * b
        if n == 4:
            return (b * b) * (b * b)
        return y * _root(x) if n == 1.5 else y
    return _long_power(b, _rest(b, x, _constant(x, 1.0)) * b if n < 0 else _constant(x, 0.0), m)


def _root(x: Value) -> Value:
    return x.code.intrinsic("llvm.sqrt", x)


def _long_power(b: Value, low: Value, m: float) -> Value:
    """(b + low)ᵐ."""
    square, whole = (b, low), int(m)
    y: tuple[Value, Value] | None = None
    if m % 1:
        root = _root(b)
        y = root, (_rest(root, root, b) + low) * (0.5 / root)
    while whole:
        if whole & 1:
            y = square if y is None else _long_product(y, square)
        whole >>= 1
        if whole:
            square = _long_product(square, square)
    assert y is not None
    return where(abs(y[1]) < INFINITY, _signed(y[0] + y[1], y[0]), y[0])


# sin, cos, tan: x = n π/2 + r with |r| ≤ π/4 --------------------------------------------------------------------------

SIN = (  # fdlibm, of r²: (sin r − r)/r³
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
COS = (  # fdlibm, of r²: (cos r − 1)/r²
    -0.5, 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
HALF_PI = {  # π/2 in parts, subtracted with one rounding each; without fused operations of 33 bits, exact times n < 2²⁰
    True: (1.5707963267948966, 6.123233995736766e-17, -1.4973849048591698e-33),
    False: (1.5707963267341256, 6.077100506303966e-11, 2.0222662487111665e-21, 8.4784276603689e-32),
}
FAR = {True: 1e9, False: 1.6e6}


def _quarters(x: Value, exact: bool = False) -> tuple[Value, Value, Value]:
    """n in the last bits of a number, r and, if it is wanted, what rounding r left; x ≥ 0."""
    s = fma(x, 2.0 / math.pi, ROUND)
    n = s - ROUND
    first, *parts = HALF_PI[x.code.module.fused]
    r = fma(n, -first, x)
    low = _constant(x, 0.0)
    for part in parts:
        before = r
        if exact:
            product, left = _product(n, _constant(n, part))
            r = before - product
            low = low + (((before - r) - product) - left)
        else:
            r = fma(n, -part, before)
    return s.bits, r, low


def _is_far(x: Value) -> Value:
    return abs(x) > FAR[x.code.module.fused]


def _odd(n: Value) -> Value:
    return (n << 63) < 0


def _circle(x: Value) -> list[Value]:
    """sin x and cos x: those of r, exchanged and negated by the quarter."""
    n, r, _ = _quarters(abs(x))
    z = r * r
    s, c = fma(r * z, _estrin(SIN, z), r), fma(z, _estrin(COS, z), 1.0)
    odd = _odd(n)
    sine, cosine = where(odd, c, s), where(odd, s, c)
    return [(sine.bits ^ (((n << 62) ^ x.bits) & SIGN)).real, (cosine.bits ^ (((n + 1) << 62) & SIGN)).real]


def _circle_far(x: Value) -> Value:
    """Both packed, where some angles are large."""
    far, pairs = _is_far(x), zip(("sin", "cos"), _circle(x), strict=True)
    return x.code.pack([where(far, _by_library(x, name=name), y) for name, y in pairs])


def _circle_once(x: Value) -> list[Value]:
    """Both from one calculation, since a force and its slope want both."""
    code, name = x.code, f"circle.{x.type.suffix}"
    types, both = [x.type, x.type], Type(f"{{ {x.type}, {x.type} }}")

    def far(x: Value) -> list[Value]:
        return x.code.unpack(x.code.outlined(f"{name}.far", [x], _circle_far, both, rare=True), types)

    def any_size(x: Value) -> list[Value]:
        return x.code.when(x.code.any(_is_far(x)), lambda: far(x), lambda: _circle(x), rare=True)

    def make() -> list[Value]:
        if code.module.used(name) <= INLINE:
            return any_size(x)
        return code.unpack(code.outlined(name, [x], lambda x: x.code.pack(any_size(x)), both), types)

    return code.once(("circle", x.name), make)


@_lowered("sin", inline=ALWAYS)
def _sin(x: Value) -> Value:
    return _circle_once(x)[0]


@_lowered("cos", inline=ALWAYS)
def _cos(x: Value) -> Value:
    return _circle_once(x)[1]


@_lowered("tan")
def _tan(x: Value) -> Value:
    """The quotient of sin r and cos r, each with what rounding left of it, or of −cos r and sin r."""
    n, r, low = _quarters(abs(x), exact=True)
    z = r * r
    square = _estrin(COS, z)
    c = fma(z, square, 1.0)
    c_low = fma(z, square, 1.0 - c) - r * low
    cube = fma(r * z, _estrin(SIN, z), low)
    s = r + cube
    s_low = (r - s) + cube
    odd = _odd(n)
    a, a_low = where(odd, -c, s), where(odd, -c_low, s_low)
    b, b_low = where(odd, s, c), where(odd, s_low, c_low)
    inverse = 1.0 / b
    y = a * inverse
    y = fma((_rest(y, b, a) + a_low) - y * b_low, inverse, y)
    return _guarded("tan", _is_far(x), (y.bits ^ (x.bits & SIGN)).real, x)


# atan -----------------------------------------------------------------------------------------------------------------

ATAN = (  # (atan t − t)/t³, of t² ≤ 1/4
    -0.33333333333333326, 0.199999999999916, -0.14285714284106285, 0.11111110990139533, -0.09090904370311348,
    0.07692198451257941, -0.06665052856794013, 0.058664967492257074, -0.05157516225552972, 0.04283578705573422,
    -0.02895352123252625, 0.011152908092096216,
)  # fmt: skip


@_lowered("atan")
def _atan(x: Value) -> Value:
    """atan x = π/4 + atan((x − 1)/(x + 1)) from 1/2 to 2, π/2 + atan(−1/x) beyond."""
    a = abs(x)
    middle, outer = a > 0.5, a > 2.0
    t = where(outer, -1.0, where(middle, a - 1.0, a)) / where(outer, a, where(middle, a + 1.0, 1.0))
    base = where(outer, math.pi / 2, where(middle, math.pi / 4, 0.0))
    left = where(outer, HALF_PI[True][1], where(middle, HALF_PI[True][1] / 2, 0.0))
    z = t * t
    return _signed(base + (t + fma(t * z, _estrin(ATAN, z), left)), x)


# sign, min, max, mod --------------------------------------------------------------------------------------------------


@_lowered("sign", inline=ALWAYS)
def _sign(x: Value) -> Value:
    return where(x > 0.0, 1.0, where(x < 0.0, -1.0, x))


@_lowered("min", inline=ALWAYS)
def _min(x: Value, y: Value) -> Value:
    return where(_compare("uno", x, x), x, where(x < y, x, y))


@_lowered("max", inline=ALWAYS)
def _max(x: Value, y: Value) -> Value:
    return where(_compare("uno", x, x), x, where(x > y, x, y))


@_lowered("mod")
def _mod(x: Value, y: Value) -> Value:
    """x − ⌊x/y⌋ y, of the sign of y, as in Python."""
    q = _floor(x / y)
    far = _compare("uge", abs(q), 2.0**52) | _compare("oeq", abs(y), INFINITY)
    return _guarded("mod", far, _mod_of(_rest(q, y, x), y), x, y, slow=_mod_far)


def _mod_of(r: Value, y: Value) -> Value:
    """The remainder of the sign of y."""
    other = ((r.bits ^ y.bits) < 0) & _compare("une", r, 0.0)
    return _signed(where(other, r + y, r), y)


def _mod_far(x: Value, y: Value) -> Value:
    return _mod_of(_by_library(x, y, name="fmod"), y)


# the C library, lane by lane ------------------------------------------------------------------------------------------


for _name in ("asin", "acos", "atan2", "sinh", "cosh", "asinh", "acosh", "atanh", "erf", "erfc", "lgamma"):
    _lowered(_name, inline=0)(partial(_by_library, name=_name))


def _by_scipy(*args: Value, name: str) -> Value:
    """The value that SciPy gives, lane by lane, with a number after the arguments that Cython's functions have."""
    code, type = args[0].code, args[0].type
    symbol = f"{SPECIAL}{name}"
    return code.lanes(lambda *lane: code.external(symbol, lane, DOUBLE, "i32 0"), args, type)


for _name in OF_SCIPY:
    _lowered(_name, inline=0)(partial(_by_scipy, name=_name))


for _name, _composed in COMPOSED.items():
    _lowered(_name)(_composed.value)

# numbers of tables ----------------------------------------------------------------------------------------------------


def _entry(table: Table, i: Value, offset: float) -> Value:
    code = i.code
    return code.gathered(code.table(table), code.convert("fptosi", i, "i64") + int(offset))


def _interval(table: Table, x: Value) -> Value:
    code, last = x.code, len(table) - 2
    if width := table.spacing:
        place = _floor((x - float(table.values[0])) * (1.0 / width))
        place = where(place >= 0.0, place, 0.0)
        return where(place <= float(last), place, float(last))
    start, type = code.table(table), x.type.of("i64")

    def halved(k: Value, values: Sequence[Value]) -> list[Value]:
        """Go on by a step, where the number there is not above x; then half of it."""
        at, step = values
        further = code.apply("min", (at + step, code.constant(last, type)))
        return [code.select(code.gathered(start, further) <= x, further, at), step >> 1]

    begin = code.constant(0, type), code.constant(1 << (last.bit_length() - 1) if last else 0, type)
    return code.convert("sitofp", code.loop(last.bit_length(), [*begin], halved)[0], "double")


LOWERED |= {"entry": _entry, "interval": _interval}

# the derivatives of ln Γ, which C has not: Abramowitz and Stegun (1964), 6.3.18 and 6.4.11 from 16 on, below by
# recurrence, below 1/2 by reflection --------------------------------------------------------------------------------

DIGAMMA = (1 / 12, -1 / 120, 1 / 252, -1 / 240, 1 / 132, -691 / 32760, 1 / 12)
BERNOULLI = (1 / 6, -1 / 30, 1 / 42, -1 / 30, 5 / 66, -691 / 2730, 7 / 6)


def _raised(x: Value, term: Callable[[Value], Value]) -> tuple[Value, Value, Value, Value]:
    """The condition x < 1/2; 1/z of z ≥ 16 above x or 1 − x, the sum of the terms between, πx less whole turns."""

    def step(k: Value, values: Sequence[Value]) -> list[Value]:
        z, total = values
        small = z < 16.0
        return [where(small, z + 1.0, z), total + where(small, term(1.0 / z), 0.0)]

    below = x < 0.5
    z, total = x.code.loop(16, [where(below, 1.0 - x, x), _constant(x, 0.0)], step)
    return below, 1.0 / z, total, (x - _floor(x + 0.5)) * math.pi


@_lowered("digamma", inline=0)
def _digamma(x: Value) -> Value:
    below, w, total, angle = _raised(x, lambda w: w)
    z = w * w
    y = ((-LOWERED["log"](w) - 0.5 * w) - z * _estrin(DIGAMMA, z)) - total
    return where(below, y - math.pi / LOWERED["tan"](angle), y)


def _polygamma(x: Value, n: int) -> Value:
    """The n-th derivative of digamma, (−1)ⁿ⁺¹ n! Σ (x + k)⁻ⁿ⁻¹; by reflection with that of π cot πx."""
    below, w, total, angle = _raised(x, lambda w: math.prod([w] * n, start=w))
    series = [b * math.comb(2 * k + n - 1, n - 1) / n for k, b in enumerate(BERNOULLI, 1)]
    y = total + math.prod([w] * n, start=1 / n + w * (0.5 + w * _estrin(series, w * w)))
    slope = Polynomial([0.0, 1.0])
    for k in range(1, n + 1):
        slope = Polynomial([-1.0, 0.0, -1.0]) * slope.deriv() * (math.pi / k)
    reflected = y + math.pi * _estrin(slope.coef.tolist(), 1.0 / LOWERED["tan"](angle))
    return where(below, -math.factorial(n) * reflected, (-1.0) ** (n + 1) * math.factorial(n) * y)


for _n in range(1, MOST_DERIVATIVES + 1):
    _lowered(f"polygamma{_n}", inline=0)(partial(_polygamma, n=_n))
