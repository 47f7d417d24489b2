"""The table of functions: values of arrays and tensors, derivatives, machine code of every row."""

from functools import partial

import mpmath
import numpy as np
import pytest
import torch
from test_functions_in_code import run

from sympflow.compiler.functions import FUNCTIONS, MOST_DERIVATIVES, OF_SCIPY, apply
from sympflow.compiler.program import derivatives, traced

TABLES = {"entry", "interval"}
CONDITIONS = {"lt", "le", "eq", "and", "or", "not"}
EXACT = {  # by mpmath, of functions that have another name there
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "times": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "fma": lambda a, b, c: a * b + c,
    "pow": mpmath.power,
    "abs": abs,
    "min": min,
    "max": max,
    "mod": lambda a, b: a - mpmath.floor(a / b) * b,
    "lgamma": mpmath.loggamma,
    "expit": lambda x: 1 / (1 + mpmath.exp(-x)),
    "bose": lambda x: 1 / mpmath.expm1(x),
    "softplus": lambda x: mpmath.log1p(mpmath.exp(x)),
    "logcosh": lambda x: mpmath.log(mpmath.cosh(x)),
    **{f"polygamma{n}": partial(mpmath.polygamma, n) for n in range(1, MOST_DERIVATIVES + 1)},
}
POINTS = {  # where the function is smooth
    "acosh": [(1.3,), (4.0,)],
    "floor": [(0.3,), (-2.7,)],
    "lgamma": [(0.7,), (5.2,)],
    "digamma": [(0.7,), (-2.2,)],
    **{f"polygamma{n}": [(0.7,), (-2.2,), (5.3,)] for n in range(1, MOST_DERIVATIVES + 1)},
    "log": [(0.7,), (20.0,)],
    "sqrt": [(0.7,), (20.0,)],
    "pow": [(0.7, 1.6), (3.0, -0.4)],
    "mod": [(7.3, 2.0), (-7.3, 2.0), (7.3, -1.7)],
}
PLACES = [(0.4, -0.8, 1.7), (-0.7, 0.3, -2.2)]


def points(name):
    count = {"fma": 3}.get(name) or (2 if name in {"add", "sub", "mul", "times", "div", "min", "max", "atan2"} else 1)
    return POINTS.get(name) or [place[:count] for place in PLACES]


def exact(name):
    return EXACT.get(name) or getattr(mpmath, name)


NUMERIC = [name for name in FUNCTIONS if name not in CONDITIONS | TABLES | {"where", *OF_SCIPY}]


@pytest.mark.parametrize("name", NUMERIC)
def test_values_of_arrays_tensors_and_machine_code(name):
    for place in points(name):
        expected = float(exact(name)(*map(mpmath.mpf, place)))
        arrays = [np.array([x, x]) for x in place]
        tensors = [torch.tensor(x, dtype=torch.float64) for x in arrays]
        close = {"rtol": 2e-15 if name != "digamma" else 1e-14, "atol": 0.0}
        np.testing.assert_allclose(apply(name, *place), expected, **close)
        np.testing.assert_allclose(apply(name, *arrays), expected, **close)
        np.testing.assert_allclose(apply(name, *tensors), expected, **close)
        np.testing.assert_allclose(run(lambda *x: apply(name, *x), *arrays, width=2), expected, **close)
        # floats among tensors take their dtype
        for i in range(len(place)):
            mixed = [x.float() if j == i else place[j] for j, x in enumerate(tensors)]
            y = apply(name, *mixed)
            assert y.dtype == torch.float32
            np.testing.assert_allclose(y, expected, rtol=1e-4)


@pytest.mark.parametrize("name", [name for name in NUMERIC if name != f"polygamma{MOST_DERIVATIVES}"])
def test_derivatives(name):
    for place in points(name):
        program = traced(lambda *x: derivatives([apply(name, *x)], x)[0], *"abc"[: len(place)])
        slopes = program(*place)
        for i, slope in enumerate(slopes):

            def along(t, i=i, place=place):
                return exact(name)(*(t if j == i else mpmath.mpf(x) for j, x in enumerate(place)))

            with mpmath.workdps(40):
                expected = float(mpmath.diff(along, mpmath.mpf(place[i])))
            assert slope == pytest.approx(expected, rel=1e-13, abs=1e-14)


ORDERED = {"gammainc", "gammaincc", "jv", "yv", "iv", "kv"}
OF_MPMATH = {
    "gammainc": lambda s, x: mpmath.gammainc(s, 0, x, regularized=True),
    "gammaincc": lambda s, x: mpmath.gammainc(s, x, regularized=True),
    "jv": mpmath.besselj,
    "yv": mpmath.bessely,
    "iv": mpmath.besseli,
    "kv": mpmath.besselk,
    "expi": mpmath.ei,
    "exp1": mpmath.e1,
    "dawsn": lambda x: mpmath.sqrt(mpmath.pi) / 2 * mpmath.exp(-(x**2)) * mpmath.erfi(x),
}


@pytest.mark.parametrize("name", OF_SCIPY)
def test_functions_of_scipy_at_their_addresses(name):
    f = OF_MPMATH.get(name) or getattr(mpmath, name)
    for order, x in ((2.5, 0.7), (1.0, 0.3)):
        place = (order, x) if name in ORDERED else (order, 0.5, 1.5, x) if name == "hyp2f1" else (x,)
        expected = float(f(*map(mpmath.mpf, place)))
        assert apply(name, *place) == pytest.approx(expected, rel=1e-14)
        arrays = [np.full(3, v) for v in place]
        for width in (1, 2, 8):
            found = run(lambda *v: apply(name, *v), *arrays, width=width)
            np.testing.assert_array_equal(found, apply(name, *arrays))
        of_number = partial(apply, name, *place[:-1])
        slope = traced(lambda y, of=of_number: derivatives([of(y)], [y])[0], "y")(x)[0]
        with mpmath.workdps(30):
            of_x = partial(f, *map(mpmath.mpf, place[:-1]))
            exact_slope = float(mpmath.diff(of_x, mpmath.mpf(x)))
        assert slope == pytest.approx(exact_slope, rel=1e-12)
        with pytest.raises(TypeError, match="is not a function of tensors"):
            apply(name, *map(torch.tensor, place))
    with pytest.raises(ValueError, match=r"^`jv` has no derivative by its order"):
        traced(lambda n: derivatives([apply("jv", n, 0.5)], [n])[0], "n")


def test_the_highest_derivative_of_the_logarithm_of_gamma_is_the_last():
    with pytest.raises(ValueError, match=r"^`polygamma` of the order 6 has no derivative here"):
        traced(lambda x: derivatives([apply("polygamma6", x)], [x])[0], "x")


@pytest.mark.parametrize("make", [np.array, torch.tensor])
def test_a_choice_between_two_floats_is_in_double_precision(make):
    y = apply("where", make([True, False]), 0.1, 0.2)
    assert [float(v) for v in y] == [0.1, 0.2]


@pytest.mark.parametrize("n", [2.0, 3.0])
def test_a_power_has_a_gradient_of_its_jvp_where_its_base_is_not_positive(n):
    x = torch.tensor([-0.5, 0.0, 0.3], dtype=torch.float64, requires_grad=True)
    slope = torch.func.jvp(lambda x: apply("pow", x, n), (x,), (torch.ones_like(x),))[1]
    (bend,) = torch.autograd.grad(slope.sum(), x)
    np.testing.assert_allclose(bend.numpy(), n * (n - 1) * x.detach().numpy() ** (n - 2), rtol=1e-15)


def test_not_a_number_goes_through_signs_and_extremes():
    nan = np.array([np.nan, 1.0])
    for x in (nan, torch.tensor(nan)):
        assert np.isnan(float(apply("sign", x)[0]))
        for name in ("min", "max"):
            assert np.isnan(float(apply(name, x, 0.0)[0]))
            assert np.isnan(float(apply(name, 0.0, x)[0]))


def test_the_derivative_of_a_power_by_its_exponent_and_of_a_constant_power():
    (slope,) = traced(lambda x: derivatives([x**2.5], [x])[0], "x")(1.3)
    assert slope == pytest.approx(2.5 * 1.3**1.5, rel=1e-15)
    by_exponent = traced(lambda n: derivatives([2.0**n], [n])[0], "n")(1.5)[0]
    assert by_exponent == pytest.approx(2**1.5 * np.log(2), rel=1e-15)


def test_conditions_and_choices():
    def choose(x, y):
        inside = apply("and", x < y, apply("not", apply("eq", x, 0.0)))
        return apply("where", apply("or", inside, y <= -2.0), x * y, x - y)

    x, y = np.array([1.0, 0.0, 3.0, -3.0]), np.array([2.0, 1.0, 1.0, -4.0])
    expected = [2.0, -1.0, 2.0, 12.0]
    tensors = torch.tensor(x), torch.tensor(y)
    program = traced(lambda x, y: [choose(x, y), *derivatives([choose(x, y)], [x, y])[0]], "x", "y")
    for values in ((x, y), tensors):
        np.testing.assert_array_equal(choose(*values), expected)
        value, by_x, by_y = program(*values)
        np.testing.assert_array_equal(value, expected)
        np.testing.assert_array_equal(by_x, [2.0, 1.0, 1.0, -4.0])
        np.testing.assert_array_equal(by_y, [1.0, -1.0, -1.0, -3.0])
    np.testing.assert_array_equal(run(choose, x, y, width=4), expected)
