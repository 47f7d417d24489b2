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
