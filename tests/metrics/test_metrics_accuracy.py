"""Errors against references, and time reversal."""

import numpy as np
import pytest

from sympflow import HamiltonianSystem, reference_error, solve, systems, time_reversal_error
from sympflow.metrics.reference import reference


def test_reference_of_a_quadratic_hamiltonian_is_exact():
    omega, t = 100.0, np.linspace(0, 10, 101)
    exact = reference(systems.harmonic_oscillator(omega), (0, 10), np.array([[1.0, 0.0], [0.0, omega]]), t)
    assert exact.method == "exact (linear flow)"
    c, s = np.cos(omega * t), np.sin(omega * t)
    truth = np.array([[c, -omega * s], [s, omega * c]])
    assert np.abs(exact.y - truth).max() <= exact.accuracy <= 1e-9


@pytest.mark.parametrize(
    ("system", "method"),
    [
        (systems.henon_heiles(), "Kahan–Li 8"),
        (HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", y0=[1.0, 0.0]), "DOP853"),
        (HamiltonianSystem.from_sympy("p**2/2 + q", y0=[1.0, 0.0]), "Kahan–Li 8"),
    ],
    ids=["separable", "not separable", "not definite"],
)
def test_reference_says_how_it_was_made_and_how_accurate_it_is(system, method):
    t = np.linspace(0, 10, 11)
    ref = reference(system, (0, 10), system.y0, t)
    assert ref.method.startswith(method)
    assert ref.accuracy < 1e-10
    other = solve(system, "dop853", (0, 10), t_eval=t, rtol=3e-14, atol=1e-15)
    assert np.linalg.norm(ref.y - other.y, axis=0).max() < 1e-10


def test_reference_may_be_given_and_must_fit():
    system, t = systems.henon_heiles(), np.linspace(0, 10, 11)
    sol, better = (solve(system, m, (0, 10), t_eval=t) for m in ("verlet", "kahan_li8"))
    np.testing.assert_allclose(reference_error(sol, better), reference_error(sol), rtol=1e-6)
    np.testing.assert_array_equal(reference_error(sol, better.y), reference_error(sol, better))
    assert (reference_error(sol, sol) == 0).all()
    with pytest.raises(ValueError, match="`reference` must be at the times"):
        reference_error(sol, solve(system, "verlet", (0, 10), t_eval=t[::2]))
    with pytest.raises(ValueError, match="`reference` must have the shape"):
        reference_error(sol, better.y[:, :5])


def test_a_solution_of_another_problem_is_no_reference():
    t = np.linspace(0, 10, 11)
    sol = solve(systems.henon_heiles(), "verlet", (0, 10), t_eval=t)
    with pytest.raises(ValueError, match=r"^`reference` is a solution of another system, 'kepler'"):
        reference_error(sol, solve(systems.kepler(0.6), "verlet", (0, 10), t_eval=t))
    with pytest.raises(ValueError, match=r"^`reference` is a solution from another `y0`"):
        reference_error(sol, solve(systems.henon_heiles(), "verlet", (0, 10), sol.y0 + 1e-9, t_eval=t))
    single = solve(systems.henon_heiles(), "verlet", (0, 10), t_eval=t, dtype="float32")
    assert reference_error(single, sol).max() < 1e-4  # the same start, in another precision
    assert reference_error(sol, single).max() < 1e-4


def test_reference_of_a_solution_that_ends_in_finite_time_is_refused():
    with pytest.raises(ValueError, match="no reference converges"):
        reference(systems.henon_heiles(), (0, 6), np.array([0.0, 0.0, 0.0, 0.7]), np.array([6.0]))


def test_a_method_without_backward_time_is_named():
    sol = solve(systems.henon_heiles(), "mlp", (0, 5))
    with pytest.raises(TypeError, match=r"^`sol` is of method 'mlp', which cannot run backwards.*: use a symplectic"):
        time_reversal_error(sol)


def test_reference_of_coupled_oscillators_satisfies_the_equations():
    system = HamiltonianSystem.from_sympy("p1**2/2 + p2**2/4 + p1*p2/5 + q1**2 + 3*q2**2 + q1*q2")
    t = np.linspace(0, 3, 61)
    y0 = np.array([1.0, -0.5, 0.2, 0.7])
    exact = reference(system, (0, 3), y0, t)
    assert exact.method.startswith("exact")
    sol = solve(system, "dop853", (0, 3), y0, t_eval=t, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(exact.y, sol.y, atol=1e-11)
