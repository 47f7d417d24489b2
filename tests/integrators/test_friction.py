"""Friction p' = −∂H/∂q − Γp: exact drifts, orders, conformal symplecticity; what leaves it out refuses it."""

import numpy as np
import pytest
import scipy.linalg
import torch

import sympflow
from sympflow import HamiltonianSystem, solve
from sympflow.hamiltonian.friction import Friction
from sympflow.schemes import SCHEMES
from sympflow.systems import damped_pendulum

EVERY_SCHEME = pytest.mark.parametrize("name", SCHEMES)
MATRIX = np.array([[0.5, 0.3], [0.3, 0.4]])
COUPLED = HamiltonianSystem.from_sympy(
    "p1**2/2 + p2**2/4 + p1*p2/5 + 1 - cos(q1 - q2) + q2**2/2 + q1**4/4", damping=MATRIX, y0=[0.7, -0.2, 0.3, 0.4]
)
"""Γ and M⁻¹ that do not commute."""


# the system --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("damping", "error", "says"),
    [
        (-0.1, ValueError, "not negative"),
        (float("nan"), ValueError, "finite"),
        (float("inf"), ValueError, "finite"),
        (1j, TypeError, "real numbers"),
        ("much", TypeError, "real numbers"),
        ([0.1, 0.2, 0.3], ValueError, r"shape \(2,\)"),
        ([0.1, -0.2], ValueError, "not negative"),
        ([[1.0, 0.1], [0.2, 1.0]], ValueError, "symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], ValueError, "positive semi-definite"),
        ([[1.0, np.nan], [np.nan, 1.0]], ValueError, "finite"),
        (np.eye(3), ValueError, "shape"),
        (True, TypeError, "a rate"),
    ],
)
def test_a_wrong_damping_is_refused(damping, error, says):
    with pytest.raises(error, match=rf"^`damping` .*{says}"):
        HamiltonianSystem.from_sympy("p1**2/2 + p2**2/2 + q1**2 + q2**2", damping=damping)
    with pytest.raises(error, match=rf"^`damping` .*{says}"):
        HamiltonianSystem(lambda q: (q**2).sum(-1), ndof=2, damping=damping)


# the drift ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damping", [0.7, [0.7, 0.0], MATRIX, [[1.0, 1.0], [1.0, 1.0]], 1e-300, 1e4])
@pytest.mark.parametrize("s", [0.4, -0.4, 0.0])
def test_the_drift_is_exact(damping, s):
    damping = np.asarray(damping, dtype=float)
    if damping.max() > 1e3 and s < 0:
        return  # grows beyond all floats, as the solution does
    G = damping if damping.ndim == 2 else np.diag(np.broadcast_to(damping, 2))
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), -G]])
    p = np.array([0.3, -1.1])
    whole = scipy.linalg.expm(A * s) @ np.concatenate([np.zeros(2), p])
    mean, end = Friction(damping).drift(p, s)
    np.testing.assert_allclose(np.concatenate([mean, end]), whole, rtol=1e-12, atol=1e-14)
    one, two = Friction(damping).factors(np.array([s]))
    shape = {1: lambda m: m[0] * np.eye(2), 2: np.diag, 4: lambda m: m.reshape(2, 2)}[one.shape[1]]
    np.testing.assert_allclose(shape(one[0]) @ p, mean, rtol=1e-13, atol=1e-16)
    np.testing.assert_allclose(shape(two[0]) @ p, end, rtol=1e-13, atol=1e-16)


# schemes -----------------------------------------------------------------------------------------------------------


def slope(system, name, truth, steps):
    errors = [np.abs(solve(system, name, (0, 2.0), dt=2.0 / n, backend="array").y[:, -1] - truth).max() for n in steps]
    return np.log2(errors[0] / errors[1]), errors[1]


@EVERY_SCHEME
def test_the_order_is_the_slope(name):
    """On Γ and M⁻¹ that do not commute, where T + V are coupled too: all brackets of the order conditions are there."""
    truth = solve(COUPLED, "dop853", (0, 2.0), rtol=1e-13, atol=1e-14).y[:, -1]
    n = 12 if SCHEMES[name].order < 6 else 6
    found, error = slope(COUPLED, name, truth, (n, 2 * n))
    assert found > SCHEMES[name].order - 0.35
    assert error < 1e-2


@EVERY_SCHEME
def test_steps_are_conformally_symplectic(name):
    sol = solve(damped_pendulum(0.3), name, (0, 5.0), dt=0.1, backend="array")
    assert sympflow.conformal_defect(sol) < 1e-13
    assert sympflow.conformal_defect(solve(damped_pendulum(0.3), "rk4", (0, 5.0), dt=0.1)) > 1e-9


@pytest.mark.parametrize("system", [COUPLED, damped_pendulum(0.4)], ids=["matrix", "number"])
@pytest.mark.parametrize("name", ["verlet", "kahan_li8", "chin4c", "srkn14a"])
def test_inverse_tangent_and_gradients(system, name):
    method = sympflow.get(name)(dt=0.2)
    y = np.stack([system.y0, 0.5 * system.y0])
    h = np.array([0.2, -0.1])
    y_next = method.step(system, 0.0, y, h)
    np.testing.assert_allclose(method.inverse(system, 0.0, y_next, h), y, atol=1e-14)
    stepped, A = method.tangent(system, 0.0, y, h)
    np.testing.assert_allclose(stepped, y_next, atol=1e-15)
    rows = [torch.func.jacrev(lambda x, s=s: method.step(system, 0.0, x, s)) for s in h.tolist()]
    for i in range(2):
        np.testing.assert_allclose(A[i], rows[i](torch.tensor(y[i])).numpy(), atol=1e-13)
    single = method.step(system, 0.0, torch.tensor(y, dtype=torch.float32), 0.2)
    assert single.dtype == torch.float32


def test_drifts_back_in_time_bound_the_step():
    stiff = damped_pendulum(1000.0)
    with pytest.raises(ValueError, match=r"^`dt` 0.05 is too long .* at most 0.00285, .*'verlet' or 'chin4c'"):
        solve(stiff, "yoshida4", (0, 0.1))
    solve(stiff, "yoshida4", (0, 0.1), dt=0.0028, backend="array").raise_for_status()
    for name in ("verlet", "leapfrog", "chin4a", "chin4c", "omelyan4"):  # no such drifts
        assert np.abs(solve(stiff, name, (0, 5.0), backend="array").y).max() < 1.6


# every method --------------------------------------------------------------------------------------------------------


# implicit methods, of any H ------------------------------------------------------------------------------------------

TURNING = HamiltonianSystem.from_sympy(
    "p**2/2*(1 + q**2/3) + q**2/2 + q*cos(2*t)", damping=0.3, time="t", period=np.pi, y0=[0.7, -0.2], t_span=(0, 2)
)
"""Not separable, driven and damped."""
GAUSS = {"implicit_midpoint": 2, "gauss_legendre4": 4, "gauss_legendre6": 6, "gauss_legendre8": 8}


@pytest.fixture(scope="module")
def ends():
    """Where DOP853 ends, of one rate, of two, and of a matrix, at t = 2."""
    two = HamiltonianSystem.from_sympy(
        "p1**2/2*(1 + q2**2/3) + p2**2/4 + 1 - cos(q1 - q2) + q1**4/4", damping=[0.5, 0.2], y0=COUPLED.y0
    )
    return [
        (system, solve(system, "dop853", (0, 2.0), rtol=1e-13, atol=1e-14).y[:, -1])
        for system in (TURNING, two, COUPLED)
    ]


@pytest.mark.parametrize(("name", "order"), GAUSS.items())
def test_gauss_methods_keep_their_order_with_friction(name, order, ends):
    for system, end in ends:
        errors = [
            np.abs(solve(system, name, (0, 2.0), dt=dt, backend="array").y[:, -1] - end).max() for dt in (0.4, 0.2)
        ]
        assert order - 0.2 < np.log2(errors[0] / errors[1]) < order + 0.5


@pytest.mark.parametrize(
    "name",
    [n if n in ("gauss_legendre4", "gauss_legendre8") else pytest.param(n, marks=pytest.mark.slow) for n in GAUSS],
)
def test_gauss_methods_are_conformally_symplectic_for_any_h(name):
    sol = solve(TURNING, name, (0, 20.0), dt=0.4, backend="array")
    assert sympflow.conformal_defect(sol) < 1e-14


# what does not hold, or is for later --------------------------------------------------------------------------------
