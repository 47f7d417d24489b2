"""The energy balance of driven systems."""

import math

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, energy_balance_error, solve

W = 1.7
PENDULUM = HamiltonianSystem.from_sympy(
    "p**2/2 - cos(q)*(1 + a*cos(w*t))", time="t", params={"a": 0.3, "w": W}, period=2 * math.pi / W
)
Y0 = np.array([[0.5, 0.1], [0.2, 0.4]])


@pytest.mark.parametrize(("method", "order"), [("verlet", 2), ("chin4c", 4), ("gauss_legendre4", 4), ("rk4", 4)])
def test_the_balance_is_kept_to_the_order_of_the_method(method, order):
    times = np.linspace(0.3, 8.3, 11)
    runs = [
        solve(PENDULUM, method, (0.3, 8.3), Y0, dt=dt, t_eval=times, backend="auto" if method == "verlet" else "array")
        for dt in (0.1, 0.05)
    ]
    errors = [energy_balance_error(run) for run in runs]
    assert errors[0].shape == (2, 11)
    assert (errors[0][:, 0] == 0).all()
    assert math.log2(errors[0].max() / errors[1].max()) > order - 0.4


def test_the_balance_does_not_grow_in_a_long_run():
    sol = solve(PENDULUM, "verlet", (0, 2000 * PENDULUM.period), Y0, dt=PENDULUM.period / 20, save_every=40)
    chaotic, regular = energy_balance_error(sol)
    assert regular[-100:].max() < 1.1 * regular[:100].max()
    assert chaotic[500:].max() < 1.1 * chaotic[:500].max()  # halves: a tenth of a chaotic orbit is a matter of rounding


def test_kinetic_energies_that_depend_on_the_time_and_autonomous_systems():
    system = HamiltonianSystem.from_sympy("(p - A*sin(t))**2/2 + q**2", time="t", params={"A": 0.5})
    sol = solve(system, "kahan_li8", (0.3, 6), Y0, dt=0.1, t_eval=np.linspace(0.3, 6, 7))
    assert energy_balance_error(sol).max() < 1e-11
    alone = solve(sympflow.systems.pendulum(), "verlet", (0, 5), dt=0.1)
    assert np.allclose(energy_balance_error(alone), np.abs(sympflow.energy_error(alone, relative=False)), atol=1e-15)


def test_drives_with_kinks_are_balanced_too():
    system = HamiltonianSystem.from_sympy("p**2/2 + q**2/2 - q*abs(sin(t))", time="t")
    sol = solve(system, "kahan_li8", (0, 20), Y0, dt=0.05)
    assert energy_balance_error(sol).max() < 1e-11
