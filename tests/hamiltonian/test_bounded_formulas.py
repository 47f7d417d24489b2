"""Formulas that stay finite where parts of them overflow, or are 0/0."""

import mpmath
import numpy as np
import pytest
import sympy as sp
import torch
from scipy.integrate import solve_ivp
from scipy.special import expit

import sympflow as sf
from sympflow import HamiltonianSystem
from sympflow.compiler.program import gradient, traced
from sympflow.hamiltonian.recorded import calculated

BOUNDED = {
    "1/(1 + exp(300*q))": ([-2.0, 0.004, 0.3, 5.0], True),
    "-50/(1 + exp((q - 1.25)/0.001))": ([-3.0, 1.251, 4.0], True),
    "3/(2 + 5*exp(-q))**1.5": ([-200.0, -1.0, 0.2, 900.0], True),
    "exp(q)/(exp(q) + 1)": ([-900.0, 0.3, 50.0, 900.0], True),
    "exp(q)/(exp(q) + 1)**2": ([-900.0, 0.3, 50.0, 900.0], True),
    "log(1 + exp(300*q))/300": ([-5.0, -0.2, 0.01, 5.0], True),
    "log(cosh(200*q))": ([-5.0, 1e-4, 0.01, 5.0], True),
    "1/cosh(50*q)**2": ([-20.0, 1e-9, 0.03, 20.0], True),
    "sech(q)": ([-800.0, 1e-9, 0.3, 30.0, 800.0], True),
    "sinh(q)/cosh(q)": ([-800.0, 0.3, 15.0, 800.0], False),
    "1/sinh(q)": ([-800.0, 0.3, 30.0, 800.0], True),
    "(exp(100*q) - exp(-100*q))/(exp(100*q) + exp(-100*q))": ([-9.0, 0.003, 0.2, 9.0], False),
    "q**3/(exp(q) - 1)": ([-800.0, 1e-5, 0.3, 40.0, 300.0], True),
    "1/(2*exp(q) - 3*exp(-q))": ([-800.0, 1.0, 30.0, 800.0], True),
    "exp(-q)/(1 - exp(-q))**2": ([0.1, 30.0, 400.0], True),
    "elliptic_k(q) + 2*elliptic_e(q)": ([-30.0, -1e-9, 0.0, 1e-8, 1e-3, 0.7], True),
}
"""V; values of q, where parts of it overflow among them; True if its slope is right in all digits, however small."""


def exact(V, q):
    """V, its slope and its curvature at q, to 60 digits, rounded."""
    x = sp.Symbol("q", real=True)
    with mpmath.workdps(60):
        if "elliptic" in V:
            f = sp.lambdify(x, sp.sympify(V, locals={"q": x}), "mpmath")
            return [float(mpmath.diff(f, mpmath.mpf(q), n)) for n in range(3)]
        derivatives = [sp.lambdify(x, sp.diff(sp.sympify(V, locals={"q": x}), x, n), "mpmath") for n in range(3)]
        return [float(f(mpmath.mpf(q))) for f in derivatives]


def recorded(f, known):
    """A SymPy expression in recorded numbers."""
    return known[f] if f in known else calculated(f, lambda part: recorded(part, known))


@pytest.mark.parametrize("V", BOUNDED)
def test_derivatives_are_finite_and_right_where_parts_of_a_formula_overflow(V):
    values, digits = BOUNDED[V]
    system = HamiltonianSystem.from_sympy(f"p**2/2 + {V}")
    form = system.symbols

    def derivatives(q):
        y = recorded(form.V, {form.q[0]: q})
        slope = gradient(y, [q])[0]
        return [y, slope, gradient(slope, [q])[0]]

    program = traced(derivatives, "q")
    for q in values:
        expected = np.array(exact(V, q))
        y = np.array([q, 0.0])
        with np.errstate(all="ignore"):
            arrays = [system.hamiltonian(y), system.gradient(y)[0], system.hessian(y)[0, 0]]
            by_program = np.array(program(np.array([q]))).ravel()
        for found in (arrays, by_program):
            np.testing.assert_allclose(found, expected, rtol=1e-12 if digits else 1e-9, atol=0 if digits else 1e-12)


def test_a_run_far_from_a_steep_wall_and_through_it():
    for q0, p0 in ((5.0, -2.0), (5.0, -1.0), (-5.0, 1.0)):
        system = HamiltonianSystem.from_sympy("p**2/2 - 1/(1 + exp(300*q))")
        sol = sf.solve(system, "kahan_li8", (0, 8), [q0, p0], dt=5e-4)
        assert sol.status == 0
        force = solve_ivp(
            lambda t, y: [y[1], -300 * expit(300 * y[0]) * expit(-300 * y[0])],
            (0, 8), [q0, p0], method="DOP853", rtol=1e-12, atol=1e-13, max_step=2e-3,
        )  # fmt: skip
        np.testing.assert_allclose(sol.y[:, -1], force.y[:, -1], rtol=1e-10)


def test_a_force_that_is_no_number_is_told():
    system = HamiltonianSystem.from_sympy("p**2/2 - q**40/(1 + q**40)")
    sol = sf.solve(system, "verlet", (0, 1), [1e9, 0.0], dt=0.1)
    assert sol.status == -1
    assert "the force is NaN" in sol.message
    assert "Reduce `dt`" not in sol.message


@pytest.mark.parametrize(
    ("V", "slope"),
    [
        (lambda q: -1 / (1 + np.exp(300 * q[..., 0])), lambda q: 300 * expit(300 * q) * expit(-300 * q)),
        (lambda q: -1 / (1 + torch.exp(300 * q[..., 0])), lambda q: 300 * expit(300 * q) * expit(-300 * q)),
        (lambda q: np.log1p(np.exp(-300 * q[..., 0])) / 3, lambda q: -100 * expit(-300 * q)),
        (lambda q: -1 / np.cosh(200 * q[..., 0]) ** 2, lambda q: 400 * np.tanh(200 * q) / np.cosh(200 * q) ** 2),
    ],
)
def test_functions_of_python_are_written_so_too(V, slope):
    with np.errstate(all="ignore"):
        system = HamiltonianSystem(potential=V, ndof=1, y0=[5.0, 1.0])
        q = np.array([5.0, 0.003, -0.004, -2.0])
        y = np.stack([q, 0 * q], axis=-1)
        assert system.gradient(y)[:, 0] == pytest.approx(np.nan_to_num(slope(q)), rel=1e-12, abs=1e-300)
    sol = sf.solve(system, "verlet", (0, 0.01), y, dt=0.01)
    assert sol.stats["backend"] == "compiled"
    with np.errstate(all="ignore"):
        assert sol.y[:, 0, -1] == pytest.approx(q - 5e-5 * np.nan_to_num(slope(q)), rel=1e-13)


@pytest.mark.parametrize("backend", ["auto", "array"])
def test_gradients_flow_through_them(backend):
    y0 = torch.tensor([[5.0, -1.0], [-5.0, 1.0]], dtype=torch.float64, requires_grad=True)
    system = HamiltonianSystem.from_sympy("p**2/2 - 1/(1 + exp(300*q)) + log(1 + exp(300*q))/3e3")
    sf.solve(system, "verlet", (0, 2), y0, dt=0.01, backend=backend).y[:, 0, -1].sum().backward()
    assert y0.grad.numpy() == pytest.approx(np.array([[1.0, 2.0], [1.0, 2.0]]), abs=1e-12)
