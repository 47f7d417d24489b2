"""The linear stability limit, at every frequency: the bounds of the energy error are met and never exceeded."""

import numpy as np
import pytest

from sympflow import max_energy_error, solve, systems

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

BOUNDS = {"verlet": lambda z: z**2 / 4, "leapfrog": lambda z: z**2 / 4 / (1 - z**2 / 4)}


@pytest.mark.parametrize("method", BOUNDS)
@pytest.mark.parametrize("omega", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("z", [0.1, 1.9, 1.99])
def test_the_energy_error_approaches_its_bound_and_stays_below(method, omega, z):
    system = systems.harmonic_oscillator(omega)
    error = max_energy_error(solve(system, method, (0.0, 1e5 * z / omega), dt=z / omega))
    bound = BOUNDS[method](z)
    # rounding of 1e5 steps, amplified by the eccentricity of the ellipse that the iterates lie on
    assert 0.99 * bound < error < bound * (1 + 1e5 * np.finfo(float).eps / (2 - z))


@pytest.mark.parametrize("method", BOUNDS)
def test_beyond_the_limit_the_state_grows_by_the_known_factor(method):
    z, n = 2.01, 100
    sol = solve(systems.harmonic_oscillator(), method, (0.0, n * z), dt=z)
    growth = abs(sol.q[0, -1] / sol.q[0, -2])
    assert growth == pytest.approx(z**2 / 2 - 1 + np.sqrt((z**2 / 2 - 1) ** 2 - 1), rel=1e-6)  # 1.2213
    assert solve(systems.harmonic_oscillator(), method, (0.0, 1e4 * z), dt=z).status == -1
