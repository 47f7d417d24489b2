"""Floquet multipliers of periodic orbits, against what is known of them."""

import math

import numpy as np
import pytest

from sympflow import floquet_multipliers, systems


def test_of_an_orbit_of_kepler_all_are_one():
    found = floquet_multipliers(systems.kepler(0.3), period=2 * math.pi)
    np.testing.assert_allclose(found.multipliers, 1, atol=1e-5)  # a double eigenvalue moves by the root of rounding
    assert found.stable
    assert found.mismatch < 1e-11
    assert found.pairing < 1e-14


@pytest.mark.parametrize("method", ["kahan_li8", "gauss_legendre6", "rk4"])
def test_of_an_equilibrium_they_are_the_exponentials_of_its_rates(method):
    """The pendulum on its head has the rates ±1."""
    found = floquet_multipliers(systems.pendulum(), [math.pi, 0.0], period=2.0, method=method, dt=0.02)
    np.testing.assert_allclose(found.multipliers, [math.exp(2), math.exp(-2)], rtol=1e-6)
    np.testing.assert_allclose(found.exponents, [1, -1], atol=1e-6)
    assert not found.stable


def test_with_friction_their_product_is_that_of_the_areas():
    rate, period = 0.2, 3.0
    found = floquet_multipliers(systems.damped_pendulum(rate), [0.0, 0.0], period=period)
    np.testing.assert_allclose(np.prod(found.multipliers), math.exp(-rate * period), rtol=1e-13)
    assert found.pairing < 1e-13
    np.testing.assert_allclose(found.exponents[0], -rate / 2 + 1j * math.sqrt(1 - rate**2 / 4), atol=1e-10)


def test_an_orbit_that_is_not_periodic_is_told():
    with pytest.warns(RuntimeWarning, match=r"not periodic: after 1 it is 1\.08 from `y0`"):
        floquet_multipliers(systems.pendulum(), period=1.0)


def test_steps_that_are_too_long_for_deviations_are_told():
    with pytest.warns(RuntimeWarning, match="not in pairs, to .* 'rk4' are too long"):
        floquet_multipliers(systems.pendulum(), [0.0, 0.0], period=6.0, method="rk4", dt=2.0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({}, ValueError, "`period` is needed"),
        ({"period": -1.0}, ValueError, "`period` must be positive"),
        ({"period": 1.0, "t0": math.inf}, ValueError, "`t0` must be a finite number"),
        ({"period": 1.0, "y0": [[0.0, 0.0]]}, ValueError, "`y0` must be one state"),
        *(
            ({"period": 1.0, "method": method}, ValueError, f"^`method` '{method}' chooses its steps by the error of")
            for method in ("dop853", "rk45", "dopri5", "adaptive_heun")
        ),
        ({"period": 1.0, "method": "tao4"}, ValueError, "^`method` 'tao4' keeps the second copy"),
        ({"period": 1.0, "method": "verlett"}, ValueError, "Did you mean 'verlet'"),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        floquet_multipliers(systems.pendulum(), **arguments)
    with pytest.raises(TypeError, match="`system` must be a HamiltonianSystem"):
        floquet_multipliers(3, period=1.0)
