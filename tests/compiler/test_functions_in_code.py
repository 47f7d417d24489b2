"""Machine code of elementary functions: as accurate as promised, and the same in a scalar as in every lane."""

import ctypes
import math

import mpmath
import numpy as np
import pytest

from sympflow.compiler.control import INT, POINTER, Module, Type
from sympflow.compiler.elementary import FAR, INLINE
from sympflow.compiler.functions import FUNCTIONS, MOST_DERIVATIVES, apply
from sympflow.compiler.machine import compiled

SPECIAL = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324, -1e-310, 2.3e-308, 1.0, -1.0, 0.5, -5.0, 1e9, -3e300])
HALVES = np.array([float(k * mpmath.pi / 2) for k in range(1, 120)])
WORST = np.array([6381956970095103 * 2.0**797, 2.0**1023, 5.319372648326541e255])  # next to multiples of π/2


@pytest.fixture(autouse=True)
def folder(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("SYMPFLOW_CACHE_DIR", str(tmp_path_factory.getbasetemp()))


def around(x, width, count=600):
    return np.random.default_rng(1).uniform(x - width, x + width, count)


def wide(low, high, count=400):
    """Numbers of all sizes between e^low and e^high."""
    return np.exp(around((low + high) / 2, (high - low) / 2, count))


ANGLES = np.concatenate([around(0, 7), around(0, FAR[False]), around(0, FAR[True]), wide(-740, 20), HALVES])
FAR_ANGLES = np.concatenate([-wide(21, 709), WORST])
LIMITS = np.array([708.0, 708.1, 709.4, 709.78, -708.0, -708.1, -740.0, -745.1, 1e-17])
CASES = {  # points, and the largest errors in units in the last place, with fused operations and without
    "exp": (np.concatenate([around(0, 700), around(0, 1), LIMITS]), 1.0, 1.0),
    "expm1": (np.concatenate([around(0, 50), around(0, 1), wide(-740, 6), LIMITS[:-2]]), 2.0, 2.0),
    "log": (np.concatenate([wide(-744, 709), around(1, 0.5), np.array([5e-324, 2.2250738585072014e-308])]), 1.0, 1.0),
    "log1p": (np.concatenate([wide(-740, 709), -wide(-740, 0), around(0, 0.9)]), 2.0, 2.0),
    "sin": (ANGLES, 2.0, 3.0),
    "cos": (ANGLES, 2.0, 3.0),
    "tan": (ANGLES, 2.0, 3.0),
    "atan": (np.concatenate([around(0, 4), wide(-740, 709), -wide(-2, 2)]), 2.0, 2.0),
    "tanh": (np.concatenate([around(0, 25), around(0, 1), -wide(-740, 6)]), 3.0, 3.0),
}


def run(function, *x, width=1, fused=True):
    """Values of a function of numbers, calculated by machine code for so many lanes, of arrays as long as any."""
    code = Module(fused).function("run", [POINTER] * (len(x) + 1) + [INT])
    *inputs, output, count = code.arguments

    def body(k, _):
        at = k * width
        code.store(function(*[code.load(p, at, Type("double", width)) for p in inputs]), output, at)
        return []

    code.loop(count, [], body)
    code.give()
    call = compiled(str(code.module), "run", ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * (len(x) + 1), ctypes.c_int64))
    count = -(-len(x[0]) // width)
    filled = [np.resize(a, count * width) for a in x]
    result = np.empty_like(filled[0])
    call(*[a.ctypes.data for a in filled], result.ctypes.data, count)
    return result[: len(x[0])]


def of(name):
    return lambda *x: apply(name, *x)


def units(y, exact, *x):
    """The largest error in units in the last place; where the value is not finite it has to be the same."""
    worst = 0.0
    with mpmath.workprec(200):
        for value, *arguments in zip(y, *x, strict=True):
            expected = exact(*map(mpmath.mpf, arguments))
            if not np.isfinite(float(expected)):
                assert value == float(expected)
                continue
            error = abs(mpmath.mpf(float(value)) - expected) / mpmath.mpf(float(np.spacing(abs(float(expected)))))
            worst = max(worst, float(error))
    return worst


def same(a, b):
    """Equal with the signs of zeros, NaN for NaN."""
    return np.array_equal(a, b, equal_nan=True) and np.array_equal(np.signbit(a[a == 0]), np.signbit(b[b == 0]))


@pytest.mark.parametrize("name", CASES)
def test_accuracy_and_the_same_bits_in_all_lanes(name):
    x, bound, _ = CASES[name]
    y = run(of(name), x)
    assert units(y, getattr(mpmath, name), x) < bound
    for width in (8, 16):
        assert same(run(of(name), x, width=width), y)


@pytest.mark.parametrize("name", CASES)
def test_accuracy_without_fused_operations(name):
    x, _, bound = CASES[name]
    assert units(run(of(name), x, width=8, fused=False), getattr(mpmath, name), x) < bound


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("name", ["sin", "cos", "tan"])
def test_angles_of_millions_of_turns_go_to_the_c_library(name, fused):
    expected = np.array([*map(getattr(math, name), FAR_ANGLES)])
    for width in (1, 8):
        assert same(run(of(name), FAR_ANGLES, width=width, fused=fused), expected)
    worst, exact = np.isin(FAR_ANGLES, WORST), getattr(mpmath, name)
    assert units(expected[~worst], exact, FAR_ANGLES[~worst]) < 1.0
    assert units(expected[worst], exact, WORST) < 16.0  # angles less multiples of π/2 are right to 1e-33


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_zeros_infinities_and_subnormal_numbers(name, fused):
    with np.errstate(all="ignore"):
        expected = FUNCTIONS[name].numpy(SPECIAL)
    y = run(of(name), SPECIAL, width=8, fused=fused)
    plain = ~np.isfinite(expected) | (expected == 0)
    assert same(y[plain], expected[plain])
    # NumPy's own error and ours, of which each is below four units
    np.testing.assert_array_almost_equal_nulp(y[~plain], expected[~plain], 7)


# powers ---------------------------------------------------------------------------------------------------------------

BASES = np.concatenate([wide(-20, 20), wide(-700, 700), around(1, 0.3), wide(-744, -708, 20)])
EXPONENTS = around(0, 1, len(BASES))[::-1] * np.minimum(745 / np.abs(np.log(BASES)), 1e300)


@pytest.mark.parametrize("fused", [True, False])
def test_power_of_two_numbers(fused):
    y = run(of("pow"), BASES, EXPONENTS, fused=fused)
    assert units(y, mpmath.power, BASES, EXPONENTS) < 2.0
    for width in (8, 16):
        assert same(run(of("pow"), BASES, EXPONENTS, width=width, fused=fused), y)


def test_power_of_all_kinds_of_numbers():
    values = [*SPECIAL, 2.0, -2.0, 3.0, -3.0, 1 / 3, 1e300, 2.0**53 + 2, 2.0**52 + 1, -(2.0**52) - 1, 1 + 2.0**-52]
    x, n = (a.ravel() for a in np.meshgrid(values, values))
    with np.errstate(all="ignore"):
        expected = x**n
    y = run(of("pow"), x, n, width=8)
    plain = ~np.isfinite(expected) | (expected == 0)
    assert same(y[plain], expected[plain])
    np.testing.assert_array_almost_equal_nulp(y[~plain], expected[~plain], 4)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 7, 12, 13, 16, 17, 100, 0.5, 1.5, 2.5, 6.5, 1 / 3, 20.5])
@pytest.mark.parametrize("sign", [1, -1])
def test_power_of_a_constant_exponent(n, sign):
    n = sign * n
    x = np.concatenate([wide(-300 / max(1, abs(n)), 300 / max(1, abs(n))), around(1.5, 0.5)])
    x = -x if n % 1 == 0 else x
    for fused in (True, False):
        assert units(run(lambda a: a**n, x, width=8, fused=fused), lambda a: a**n, x) < 2.0
    special = SPECIAL[~np.isneginf(SPECIAL)] if n % 1 == 0.5 else SPECIAL  # 1/√x and its kin of −∞ are NaN
    with np.errstate(all="ignore"):
        expected = special**n
        zero = (special == 0) & (n % 1 != 0)
        y = run(lambda a: a**n, special, width=8)
    np.testing.assert_allclose(y[~zero], expected[~zero], rtol=1e-15, atol=5e-324)


# remainders and what is rarer -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mod", "min", "max"])
@pytest.mark.parametrize("fused", [True, False])
def test_of_two_numbers_the_same_as_numpy(name, fused):
    x, y = (a.ravel() for a in np.meshgrid(SPECIAL, [*SPECIAL, 0.1, -7.0, 1e300]))
    x, y = np.append(x, wide(-300, 300) - 1), np.append(y, around(0, 9, 400)[::-1])
    with np.errstate(all="ignore"):
        expected = FUNCTIONS[name].numpy(x, y)
    assert same(run(of(name), x, y, width=8, fused=fused), expected)


def test_sign():
    assert same(run(of("sign"), SPECIAL, width=8) + 0.0, np.sign(SPECIAL) + 0.0)


def both(x):
    return np.concatenate([x, -x])


INSIDE = both(np.concatenate([wide(-740, -0.01), 1 - wide(-36, -1)]))
TWO = both(wide(-300, 300)), both(wide(-300, 300))[::-1].copy()
OF_C = {
    **dict.fromkeys(("asin", "acos", "atanh"), (INSIDE,)),
    **dict.fromkeys(("sinh", "cosh"), (both(np.concatenate([wide(-740, 6.56), around(0, 710)])),)),
    "asinh": (both(wide(-740, 709)),),
    "acosh": (1 + wide(-36, 709),),
    "erf": (both(np.concatenate([wide(-740, 2), around(0, 6)])),),
    "erfc": (np.concatenate([both(wide(-740, 2)), around(10, 17)]),),
    "lgamma": (np.concatenate([wide(-740, 700), around(0, 10)]),),
    "atan2": TWO,
}


@pytest.mark.parametrize("width", [1, 8])
@pytest.mark.parametrize("name", OF_C)
def test_functions_of_the_c_library(name, width):
    exact = {"lgamma": lambda a: mpmath.re(mpmath.loggamma(a))}.get(name) or getattr(mpmath, name)
    assert units(run(of(name), *OF_C[name], width=width), exact, *OF_C[name]) < (2.0 if name == "atan2" else 4.0)


@pytest.mark.parametrize("m", range(MOST_DERIVATIVES + 1))
def test_derivatives_of_the_logarithm_of_gamma(m):
    x = np.concatenate([around(4, 8), wide(-30, 300)])
    exact, slope = (np.array([float(mpmath.polygamma(m + k, a)) for a in x]) for k in (0, 1))
    y = run(of(f"polygamma{m}" if m else "digamma"), x, width=8)
    # sixteen terms of the recurrence, rounded to a unit each; where they cancel, a unit of the largest, or of πx
    assert (np.abs(y - exact) <= 16 * np.finfo(float).eps * (1 + np.abs(exact) + (m > 1) * np.abs(slope))).all()


@pytest.mark.parametrize("name", [*CASES, "pow", "mod"])
@pytest.mark.parametrize("width", [1, 8])
def test_a_call_gives_the_bits_of_the_operations_in_place(name, width):
    x = np.abs(CASES["tanh"][0])

    def often(a):
        more = [] if name in CASES else [1.7]
        values = [apply(name, a * c, *[a.code.constant(m, a.type) for m in more]) for c in range(1, INLINE + 3)]
        assert a.code.module.has(f"{'circle' if name in ('sin', 'cos') else name}.{a.type.suffix}")
        return values[0] + values[-1]

    def once(c):
        return run(lambda a: apply(name, a * float(c), *([] if name in CASES else [a * 0.0 + 1.7])), x)

    assert same(run(often, x, width=width), once(1) + once(INLINE + 2))


def test_what_was_calculated_in_a_branch_is_not_used_after_it():
    def function(a):
        (y,) = a.code.when(a > 100.0, lambda: [apply("sin", a)], lambda: [a])
        return y + apply("cos", a)

    x = around(0, 200)
    np.testing.assert_allclose(run(function, x), np.where(x > 100, np.sin(x), x) + np.cos(x), rtol=1e-13, atol=1e-15)
