"""The arithmetic-only elementary functions, against arbitrary precision."""

import mpmath
import numpy as np
import pytest

from sympflow.kernels.modules import OPTIONS, load_module, template

RNG = np.random.default_rng(0)
SMALL = np.concatenate([RNG.uniform(-0.4, 0.4, 400), RNG.uniform(-25, 25, 400), 10.0 ** RNG.uniform(-300, 2, 400)])
NEAR_MULTIPLES = np.concatenate([np.nextafter(k * np.pi / 2, [-np.inf, np.inf]) for k in range(-60, 60)])
LARGE = np.concatenate([10.0 ** RNG.uniform(2, 12, 1000), -RNG.uniform(1e11, 1e12, 200), 2.0 ** np.arange(40)])


@pytest.fixture(scope="module")
def elementary():
    return load_module(f"OPTIONS = {OPTIONS | {'cache': True}}\n\n{template('elementary')}")


def units_in_the_last_place(function, exact, points):
    """The largest error over the points, in units in the last place of the result."""
    with mpmath.workprec(200):
        return max(
            float(abs(mpmath.mpf(function(x)) - (value := exact(mpmath.mpf(float(x))))) / np.spacing(abs(float(value))))
            for x in points
        )


def test_tanh(elementary):
    assert units_in_the_last_place(elementary.fast_tanh, mpmath.tanh, SMALL) < 3
    special = [np.inf, -np.inf, 1e308, 0.0, 5e-324]
    assert [elementary.fast_tanh(x) for x in special] == [1.0, -1.0, 1.0, 0.0, 5e-324]
    assert np.isnan(elementary.fast_tanh(np.nan))


@pytest.mark.parametrize("points", [SMALL, NEAR_MULTIPLES, LARGE], ids=["small", "near multiples of π/2", "large"])
@pytest.mark.parametrize("name", ["sin", "cos"])
def test_sine_and_cosine(elementary, name, points):
    assert units_in_the_last_place(getattr(elementary, f"fast_{name}"), getattr(mpmath, name), points) < 2


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_no_direction(elementary, name):
    assert all(np.isnan(getattr(elementary, f"fast_{name}")(x)) for x in (np.inf, -np.inf, np.nan))
