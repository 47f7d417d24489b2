"""Splittings with the exact linear flow, and into any number of exactly solvable parts."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, max_energy_error, solve
from sympflow.hamiltonian.parts import sheared, shears
from sympflow.systems import fput, harmonic_oscillator, spring_pendulum
from sympflow.systems.chains import oscillatory_energies


def test_fput_figures():
    """The known figures at hω = 5, T = 200, and the adiabatic invariant."""
    system = fput(omega=50.0)
    known = {"impulse": 1.6e-1, "mollified_impulse": 1.1e-2, "implicit_explicit": 1.0e-2, "linear_srkn11b": 5.7e-5}
    for name, figure in known.items():
        backend = "array" if name == "mollified_impulse" else "auto"
        long = pytest.warns(RuntimeWarning, match=r"`dt` 0\.1 is too long") if name == "impulse" else nullcontext()
        with long:
            sol = solve(system, name, dt=0.1, backend=backend)
        assert np.abs(sol.energy_error()).max() == pytest.approx(figure, rel=0.05)
    drift = np.abs(oscillatory_energies(system, sol.y.T).sum(-1) - 1).max()
    assert drift < 0.08


def test_parts_given_by_the_user():
    system = spring_pendulum(1e4, coordinates="polar")
    parts = ("-g*q1*cos(q2)", "p2**2/(2*q1**2)", "p1**2/2 + k*(q1 - 1)**2/2")
    run = {"t_span": (0, 1), "dt": 0.05, "backend": "array"}
    detected = solve(system, "strang_parts", **run)
    given = solve(system, "strang_parts", parts=parts, **run)
    assert np.abs(given.y - detected.y).max() < 1e-13
    other = solve(system, "strang_parts", parts=parts[::-1], **run)
    assert np.abs(other.y - detected.y).max() > 1e-8


@pytest.mark.parametrize(("backend", "n"), [("compiled", 1_000_000), ("array", 5_000)])
@pytest.mark.parametrize("turns", [0.25, 0.5, 1.0, 10.75, 1000.0])
def test_whole_quarter_turns_leave_no_rounding_to_add_up(turns, backend, n):
    """The reduced angle is the rounding of hω alone, and would turn the state the same way in every step."""
    h, n = 2 * np.pi * turns, 4 * n
    oscillator = harmonic_oscillator(1.0)
    sol = solve(oscillator, "impulse", (0.0, n * h), [1.0, 0.3], dt=h, t_eval=[(n - 4) * h, n * h], backend=backend)
    assert np.abs(sol.energy_error()).max() < 1e-15
    np.testing.assert_allclose(sol.y[:, -1], [1.0, 0.3], rtol=1e-15)


@pytest.mark.parametrize(("name", "of_step", "of_kicks"), [("aba864", 8, 1), ("aba1064", 6, 2), ("aba104", 4, 2)])
def test_schemes_for_nearly_integrable_systems(name, of_step, of_kicks):
    """The terms that lead at these steps, in the energy: εh⁸ of ABA (8, 6, 4), ε²h⁶ of (10, 6, 4), ε²h⁴ of (10, 4)."""
    nearly = "p1**2/2 + p2**2/2 + q1**2/2 + 0.7*q2**2 + e*(q1**2*q2 - q2**3/3 + q1**4)"
    strong = {"aba864": 1e-3, "aba1064": 1e-2, "aba104": 1e-3}[name]

    def error(strength, h):
        system = HamiltonianSystem.from_sympy(nearly, params={"e": strength})
        y0 = np.array([0.5, 0.4, 0.1, 0.3])
        return max_energy_error(solve(system, f"linear_{name}", (0, 24), y0, dt=h, backend="array"))

    errors = error(strong, 0.5), error(strong, 0.375), error(strong / 4, 0.5)
    assert np.log(errors[0] / errors[1]) / np.log(4 / 3) == pytest.approx(of_step, abs=0.8)
    assert np.log(errors[0] / errors[2]) / np.log(4) == pytest.approx(of_kicks, abs=0.3)


@pytest.mark.parametrize(("backend", "n"), [("compiled", 1_000_000), ("array", 10_000)])
@pytest.mark.parametrize("turn", [20.0, 1e3, np.pi / 3, 2 * np.pi / 5, np.pi / 2 + 1e-6, np.pi / 3 + 1e-6])
def test_rounding_of_the_turn_is_a_random_walk(turn, backend, n):
    """√n of the half ulp that each of three shears may be off; where the state recurs every step adds up instead."""
    y0 = np.random.default_rng(0).normal(size=(8, 2))
    sol = solve(harmonic_oscillator(), "impulse", (0, n * turn), y0, dt=turn, t_eval=[n * turn], backend=backend)
    eps = np.finfo(float).eps
    # a sixth of a turn is the worst of the simple fractions: a recurring error of less than eps/3 a step
    assert np.abs(sol.energy_error()).max() < (n / 3 if turn == np.pi / 3 else 3 * np.sqrt(n)) * eps


def test_the_angle_of_a_turn_is_that_of_the_exact_product():
    """Ω s is kept to twice the precision: at hω = 1000 its rounding alone would be 1e-13 of a radian a step."""
    from fractions import Fraction

    t, sigma, c, d = shears(["oscillator"], np.array([1000.1]), np.array([1.0003]))
    theta = Fraction(1000.1) * Fraction(1.0003)
    pi = Fraction(31415926535897932384626433832795028841971693993751, 10**49)
    quarters = round(theta / (pi / 2))
    r = float(theta - quarters * pi / 2)
    assert (c[0], d[0]) == [(1, 0), (0, 1), (-1, 0), (0, -1)][quarters % 4]
    assert sigma[0] == pytest.approx(np.sin(r), rel=4e-16)
    assert t[0] == pytest.approx(np.tan(r / 2), rel=4e-16)


@pytest.mark.parametrize("theta", [0.3, 1.0, 2.5, np.pi / 2, np.pi, -7.0])
def test_the_turn_is_differentiable_in_its_angle_at_whole_quarters_too(theta):
    angle = torch.tensor([theta], dtype=torch.float64, requires_grad=True)
    rate, X, Y = torch.ones(1, dtype=torch.float64), torch.tensor([0.3]).double(), torch.tensor([-0.8]).double()
    x, y = sheared(X, Y, shears(["oscillator"], rate, angle))
    slopes = [torch.autograd.grad(value.sum(), angle, retain_graph=True)[0] for value in (x, y)]
    torch.testing.assert_close(torch.stack(slopes), torch.stack([y, -x]).detach(), rtol=0, atol=1e-14)
