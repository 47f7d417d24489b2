"""Energy error, its maximum and its drift."""

from dataclasses import replace

import numpy as np
import pytest

from sympflow import HamiltonianSystem, energy_drift, energy_error, max_energy_error, solve, systems
from sympflow.metrics.energy import energy_scale

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")


@pytest.mark.parametrize(("omega", "z"), [(1.0, 0.1), (1.0, 0.9), (1.0, 1.9), (1e6, 0.9)])
def test_verlet_energy_error_on_the_oscillator_is_bounded_by_a_quarter_of_z_squared(omega, z):
    """Kick–drift–kick keeps p² + ω²q²(1 − z²/4), so from p = 0 the relative error is (z²/4)(q² − 1)."""
    dt = z / omega
    sol = solve(systems.harmonic_oscillator(omega), "verlet", (0, 5000 * dt), [1.0, 0.0], dt=dt)
    assert max_energy_error(sol) <= z**2 / 4 * (1 + 1e-9)
    assert max_energy_error(sol) >= 0.98 * z**2 / 4


def test_error_is_relative_to_the_initial_energy_or_to_the_declared_scale():
    system = systems.henon_heiles()
    declared = HamiltonianSystem.from_sympy(system.symbols.H, y0=system.y0, dt=system.dt, energy_scale=2.0)
    sol, with_scale = (solve(s, "verlet", (0, 10)) for s in (system, declared))
    absolute = energy_error(sol, relative=False)
    H0 = system.hamiltonian(system.y0)
    np.testing.assert_allclose(energy_error(sol), absolute / abs(H0), rtol=1e-13)
    np.testing.assert_allclose(energy_error(with_scale), absolute / 2, rtol=0, atol=1e-15)
    assert energy_scale(sol) == H0
    np.testing.assert_array_equal(sol.energy_error(), energy_error(sol))


def test_error_from_a_state_without_energy_is_absolute_and_says_so():
    sol = solve(systems.harmonic_oscillator(), "verlet", (0, 1), [[0.0, 0.0], [1.0, 0.0]])
    assert np.isnan(energy_scale(sol)).tolist() == [True, False]
    with pytest.warns(RuntimeWarning, match="energy error is absolute where"):
        error = energy_error(sol)
    assert (error[0] == 0).all()
    assert error.shape == (2, len(sol.t))


def test_drift_finds_the_slope_of_a_line_and_is_zero_on_it():
    """y = (t, 0) under H = p + q: the energy grows by exactly 1 per unit time; block means lie on the line."""
    system = HamiltonianSystem.from_sympy("p**2/2 + q", y0=[1.0, 0.0], energy_scale=4.0)
    sol = solve(system, "verlet", t_eval=np.linspace(0, 100, 1001))
    drift = energy_drift(replace(sol, y=np.stack([sol.t + 1, 0 * sol.t])))
    assert drift.slope == pytest.approx(0.25, rel=1e-12)
    assert drift.standard_error < 1e-13
    assert drift.means.shape == (20,)


def test_drift_wants_blocks_and_outputs():
    sol = solve(systems.harmonic_oscillator(), "verlet", (0, 0.5))
    with pytest.raises(ValueError, match="`sol` has 11 outputs, fewer than the 20 blocks"):
        energy_drift(sol)
    with pytest.raises(ValueError, match="`blocks` must be at least 20"):
        energy_drift(sol, blocks=5)
    with pytest.raises(TypeError, match="`blocks` must be an integer"):
        energy_drift(sol, blocks=25.5)


def test_the_error_is_infinite_where_the_energy_is_beyond_floats():
    """H of a state of 1e160 overflows: inf − inf would be NaN, which says nothing."""
    sol = solve(systems.harmonic_oscillator(), "verlet", (0, 1), [[1e160, 0.0], [1.0, 0.0]])
    assert sol.status.tolist() == [0, 0]
    assert np.isposinf(sol.energy_error()[0]).all()
    assert np.isfinite(sol.energy_error()[1]).all()
    np.testing.assert_array_equal(np.isinf(max_energy_error(sol)), [True, False])


def test_one_nan_is_not_hidden_by_the_maximum():
    sol = solve(systems.harmonic_oscillator(), "verlet", (0, 1))
    y = sol.y.copy()
    y[:, 3] = np.nan
    assert max_energy_error(replace(sol, y=y)) == np.inf


@pytest.mark.filterwarnings("ignore:`rtol` is too large for method .rk45.:RuntimeWarning")
def test_drift_of_verlet_is_insignificant_and_that_of_rk45_is_not():
    system, t = systems.henon_heiles(), np.linspace(0, 400, 4001)
    verlet, rk45 = (energy_drift(solve(system, method, (0, 400), t_eval=t)) for method in ("verlet", "rk45"))
    assert abs(verlet.slope) < 4 * verlet.standard_error
    assert rk45.slope < -10 * rk45.standard_error


def test_standard_error_of_the_drift_is_that_of_white_noise():
    """For independent samples of deviation σ over [0, T] the slope has deviation √12 σ / (T √n)."""
    n, T, sigma, runs = 4000, 10.0, 0.3, 400
    system = HamiltonianSystem.from_sympy("p**2/2 + q", energy_scale=1.0)
    noise = np.random.default_rng(0).normal(0, sigma, (runs, n))
    sol = solve(system, "verlet", (0, T), np.zeros((runs, 2)), t_eval=np.linspace(0, T, n), backend="array")
    drift = energy_drift(replace(sol, y=np.stack([noise, 0 * noise], axis=1)))
    expected = np.sqrt(12 / n) * sigma / T
    assert drift.slope.std() == pytest.approx(expected, rel=0.12)  # the deviation of 400 draws is known to 3.5 %
    assert np.sqrt((drift.standard_error**2).mean()) == pytest.approx(expected, rel=0.06)
