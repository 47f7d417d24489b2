"""Activations σ with their slopes σ', written so that loops over them become vector instructions. Source text.

The library's tanh is called for one number at a time, ten times slower; this one is arithmetic only.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LOG2_E = 1.4426950408889634
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # log 2, the first with 21 zero bits
ROUND = 6755399441055744.0  # 1.5·2⁵²: adding and subtracting it rounds to an integer, left in the low bits
ONE_BITS = 0x3FF0000000000000


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


@njit(**OPTIONS)
def fast_tanh(x):
    """tanh x = E/(E + 2), E = exp(2x) − 1, to 3 units in the last place; NaN stays NaN.

    With 2x = n log 2 + r, |r| ≤ ½ log 2, E is 2ⁿ (exp r − 1) + (2ⁿ − 1), and exp r − 1 is its Taylor polynomial of
    degree 13 (truncation 1e-17, relative).
    """
    y = 2.0 * x
    y = 44.0 if y > 44.0 else y  # where tanh is ±1 to the last bit
    y = -44.0 if y < -44.0 else y
    shifted = y * LOG2_E + ROUND
    n = shifted - ROUND
    r = (y - n * LN2_HIGH) - n * LN2_LOW
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
def tanh(a):
    value = fast_tanh(a)
    return value, 1.0 - value * value


@njit(**OPTIONS)
def sin(a):
    return math.sin(a), math.cos(a)


@njit(**OPTIONS)
def sigmoid(a):
    value = 0.5 + 0.5 * fast_tanh(0.5 * a)
    return value, value * (1.0 - value)


@njit(**OPTIONS)
def softplus(a):
    return max(a, 0.0) + math.log1p(math.exp(-abs(a))), 0.5 + 0.5 * fast_tanh(0.5 * a)


@njit(**OPTIONS)
def logcosh(a):
    return abs(a) + math.log1p(math.exp(-2.0 * abs(a))) - LN2_HIGH - LN2_LOW, fast_tanh(a)
