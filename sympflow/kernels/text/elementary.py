"""Elementary functions by arithmetic alone, so that loops over them become vector instructions. Source text.

The library's functions take one number at a time and are called, ten times slower.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

ROUND = 6755399441055744.0  # 1.5·2⁵²: adding and subtracting it rounds to an integer, left in the low bits
ONE_BITS = 0x3FF0000000000000
LN2 = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # log 2, the first part with 21 zero bits
HALF_PI = 1.5707963267948966, 6.123233995736766e-17, -1.4973849048591698e-33  # π/2 to 160 bits

QUARTER_PI = 0.78539816339745  # a bit above π/4, for the rounding of n


@intrinsic
def float_to_bits(typing_context, x):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def bits_to_float(typing_context, x):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


@intrinsic
def fused_multiply_add(typing_context, a, b, c):
    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


@njit(**OPTIONS)
def fast_tanh(x):
    """tanh x = E/(E + 2), E = exp(2x) − 1, to 3 units in the last place; NaN stays NaN.

    With 2x = n log 2 + r, |r| ≤ ½ log 2, E is 2ⁿ (exp r − 1) + (2ⁿ − 1), and exp r − 1 is its Taylor polynomial of
    degree 13 (truncation 1e-17, relative).
    """
    y = 2.0 * x
    y = 44.0 if y > 44.0 else y  # where tanh is ±1 to the last bit
    y = -44.0 if y < -44.0 else y
    shifted = y * (1.0 / math.log(2.0)) + ROUND
    n = shifted - ROUND
    r = (y - n * LN2[0]) - n * LN2[1]
    s = 1.0 / 6227020800.0
    s = s * r + 1.0 / 479001600.0
    s = s * r + 1.0 / 39916800.0
    s = s * r + 1.0 / 3628800.0
    s = s * r + 1.0 / 362880.0
    s = s * r + 1.0 / 40320.0
    s = s * r + 1.0 / 5040.0
    s = s * r + 1.0 / 720.0
    s = s * r + 1.0 / 120.0
    s = s * r + 1.0 / 24.0
    s = s * r + 1.0 / 6.0
    s = s * r + 0.5
    power = bits_to_float((float_to_bits(shifted) << 52) + ONE_BITS)
    E = power * (s * (r * r) + r) + (power - 1.0)
    return E / (E + 2.0)


@njit(**OPTIONS)
def reduced(x):
    """r and n with x = n π/2 + r, |r| ≤ π/4, n as the low bits of an integer.

    For |x| < 1e12 the first of the three fused multiply-adds is exact: n π/2 cancels against x. Far beyond, r is what
    rounding leaves, kept within ±π/4 so that sine and cosine stay within ±1; NaN and ±∞ become NaN.
    """
    shifted = x * (2.0 / math.pi) + ROUND
    n = shifted - ROUND
    r = fused_multiply_add(-n, HALF_PI[0], x)
    r = fused_multiply_add(-n, HALF_PI[1], r)
    r = fused_multiply_add(-n, HALF_PI[2], r)
    r = QUARTER_PI if r > QUARTER_PI else r
    r = -QUARTER_PI if r < -QUARTER_PI else r
    return r, float_to_bits(shifted)


@njit(**OPTIONS)
def sin_of_quadrant(r, n):
    """sin(n π/2 + r), with the minimax polynomials of fdlibm (Sun Microsystems, 1993)."""
    z = r * r
    s = 1.58969099521155010221e-10
    s = s * z - 2.50507602534068634195e-08
    s = s * z + 2.75573137070700676789e-06
    s = s * z - 1.98412698298579493134e-04
    s = s * z + 8.33333333332248946124e-03
    s = s * z - 1.66666666666666324348e-01
    s = r + r * z * s
    c = -1.13596475577881948265e-11
    c = c * z + 2.08757232129817482790e-09
    c = c * z - 2.75573143513906633035e-07
    c = c * z + 2.48015872894767294178e-05
    c = c * z - 1.38888888888741095749e-03
    c = c * z + 4.16666666666666019037e-02
    half = 0.5 * z
    w = 1.0 - half
    c = w + (((1.0 - w) - half) + z * z * c)
    value = c if n & 1 else s
    return -value if n & 2 else value


@njit(**OPTIONS)
def fast_sin(x):
    """sin x to 2 units in the last place for |x| < 1e12; where doubles are far apart, a number in [−1, 1]."""
    r, n = reduced(x)
    return sin_of_quadrant(r, n)


@njit(**OPTIONS)
def fast_cos(x):
    """cos x, as `fast_sin`."""
    r, n = reduced(x)
    return sin_of_quadrant(r, n + 1)


@njit(**OPTIONS)
def fast_exp(x):
    """exp x to 2 units in the last place, 0 and inf where it is; NaN stays NaN.

    With x = n log 2 + r it is 2ⁿ exp r, of which the Taylor polynomial has degree 13 as in `fast_tanh`; 2ⁿ in two
    factors, each of which a number can hold.
    """
    y = 710.0 if x > 710.0 else x
    y = -746.0 if y < -746.0 else y
    shifted = y * (1.0 / math.log(2.0)) + ROUND
    n = shifted - ROUND
    r = (y - n * LN2[0]) - n * LN2[1]
    s = 1.0 / 6227020800.0
    s = s * r + 1.0 / 479001600.0
    s = s * r + 1.0 / 39916800.0
    s = s * r + 1.0 / 3628800.0
    s = s * r + 1.0 / 362880.0
    s = s * r + 1.0 / 40320.0
    s = s * r + 1.0 / 5040.0
    s = s * r + 1.0 / 720.0
    s = s * r + 1.0 / 120.0
    s = s * r + 1.0 / 24.0
    s = s * r + 1.0 / 6.0
    s = s * r + 0.5
    whole = float_to_bits(shifted) - float_to_bits(ROUND)
    half = whole >> 1
    first, second = bits_to_float((half << 52) + ONE_BITS), bits_to_float(((whole - half) << 52) + ONE_BITS)
    return (1.0 + (s * (r * r) + r)) * first * second
