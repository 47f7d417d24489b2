"""Friction p' = −∂H/∂q − Γp: exact drifts, orders, conformal symplecticity; what leaves it out refuses it."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import scipy.linalg
import torch

import sympflow
from sympflow import HamiltonianSystem, solve
from sympflow.hamiltonian.friction import Friction
from sympflow.integrators.base import FixedStep
from sympflow.schemes import SCHEMES
from sympflow.systems import damped_oscillator, damped_pendulum, pendulum

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


@pytest.mark.parametrize("damping", [0.3, [0.3, 0.1], MATRIX])
@pytest.mark.parametrize("separable", [True, False])
def test_the_vector_field_has_friction_and_its_jacobian(damping, separable):
    H = "p1**2/2 + p2**2/4 + q1**4/4 + q2**2" + ("" if separable else " + q1*p2")
    damped, plain = HamiltonianSystem.from_sympy(H, damping=damping), HamiltonianSystem.from_sympy(H)
    y = np.linspace(-1, 1, 12).reshape(3, 4)
    G = np.asarray(damping) if np.ndim(damping) == 2 else np.diag(np.broadcast_to(damping, 2))
    expected = plain.vector_field(y) - np.concatenate([np.zeros((3, 2)), y[:, 2:] @ G], axis=1)
    np.testing.assert_allclose(damped(0.0, y), expected, rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(damped.vector_field(torch.tensor(y)).numpy(), expected, rtol=1e-15, atol=1e-15)
    jacobian = torch.func.vmap(torch.func.jacfwd(damped.vector_field))(torch.tensor(y)).numpy()
    np.testing.assert_allclose(damped.field_jacobian(y), jacobian, rtol=1e-14, atol=1e-14)


def oscillator(t, omega, rate, q0, p0):
    """The known truth of `damped_oscillator`."""
    W = np.sqrt(complex(omega**2 - rate**2 / 4))
    A = np.array([[0.0, 1.0], [-(omega**2), -rate]])
    q = np.exp(-rate * t / 2) * (q0 * np.cos(W * t) + (p0 + rate * q0 / 2) * np.sin(W * t) / W)
    np.testing.assert_allclose(scipy.linalg.expm(A * t)[0] @ [q0, p0], q.real, atol=1e-12)
    return scipy.linalg.expm(A * t) @ [q0, p0]


@EVERY_SCHEME
def test_the_damped_oscillator_is_solved_compiled(name):
    system = damped_oscillator(2.0, 0.3)
    sol = solve(system, name, (0, 3.0), dt=0.02)
    assert sol.stats["backend"] == "compiled"
    truth = oscillator(3.0, 2.0, 0.3, 1.0, 0.0)
    close = {2: 2e-3, 4: 1e-4, 6: 1e-8, 8: 1e-11}[SCHEMES[name].order]
    assert np.abs(sol.y[:, -1] - truth).max() < close
    back = solve(system, name, (3.0, 0.0), truth, dt=0.02).y[:, -1]  # back in time it grows
    assert np.abs(back - system.y0).max() < np.exp(0.3 * 3.0) * close
    arrays = solve(system, name, (0, 3.0), dt=0.02, backend="array")
    np.testing.assert_allclose(sol.y, arrays.y, atol=2e-14)


def test_compiled_gauss_methods_with_friction_are_those_of_arrays(ends):
    (turning, _), (two, _), (coupled, _) = ends
    for system in (turning, two):
        y0 = np.stack([system.y0, 0.5 * system.y0])
        compiled, arrays = (
            solve(system, "gauss_legendre4", (0, 4.0), y0, dt=0.2, backend=backend) for backend in ("compiled", "array")
        )
        np.testing.assert_allclose(compiled.y, arrays.y, rtol=0, atol=1e-13)
    back = solve(turning, "gauss_legendre4", (4.0, 0.0), solve(turning, "gauss_legendre4", (0, 4.0)).y[:, -1])
    np.testing.assert_allclose(back.y[:, -1], turning.y0, atol=1e-12)
    assert solve(coupled, "gauss_legendre4", (0, 0.4), dt=0.2).stats["backend"] == "numpy"
    with pytest.raises(ValueError, match="is a matrix"):
        solve(coupled, "gauss_legendre4", (0, 0.4), dt=0.2, backend="compiled")


def test_everything_else_refuses_friction():
    damped, system = damped_pendulum(), pendulum()
    flow = sympflow.shipped_flows(system)[0].load(system)
    y = np.array([1.0, 0.5])
    for use in (
        lambda: sympflow.train(damped, kind="sympflow", steps=1),
        lambda: sympflow.SympFlow.split(damped_oscillator(), 0.5),
        lambda: solve(damped, flow),
        lambda: solve(damped, "sympflow"),
        lambda: solve(damped, "sympflow", flow=flow),
        lambda: flow.check_system(damped),
        lambda: flow.certificate(damped),
        lambda: sympflow.time_transformed(damped),
        lambda: damped_oscillator().linear_part,
        lambda: sympflow.stability(damped, ["verlet"]),
        lambda: sympflow.compare(damped, ["verlet"], ["volume"]),
        lambda: sympflow.get("verlet")(splitting="copies").step(damped, 0.0, y, 0.1),
        lambda: sympflow.get("strang_parts")().step(damped_oscillator(), 0.0, y, 0.1),
        lambda: sympflow.get("log_leapfrog")().step(damped, 0.0, y, 0.1),
    ):
        with pytest.raises(ValueError, match="has friction"):
            use()
    assert not flow.matches(damped)
    assert len(sympflow.shipped_flows(damped)) == 0
    with pytest.raises(ValueError, match=r"^`compensated`"):
        solve(damped, "verlet", compensated=True)
    relativistic = HamiltonianSystem.from_sympy("sqrt(1 + p**2) - cos(q)", damping=0.1, y0=[1.0, 0.0])
    with pytest.raises(ValueError, match=r"kinetic energy is ½ pᵀM⁻¹p"):
        solve(relativistic, "verlet")


@dataclass(frozen=True)
class Stepping(FixedStep):
    """Verlet's steps of another system than the run's."""

    other: HamiltonianSystem = None
    name: ClassVar[str] = "of_another_system"
    order: ClassVar[int] = 2
    symplectic: ClassVar[bool] = False

    def __init__(self, other, dt):
        object.__setattr__(self, "other", other)
        object.__setattr__(self, "dt", dt)

    def step(self, system, t, y, h):
        return sympflow.get("verlet")().step(self.other, t, y, h)


def test_the_conformal_defect_sees_another_rate():
    sol = solve(damped_pendulum(0.3), "verlet", (0, 1.0), dt=0.1)
    other = solve(damped_pendulum(0.31), "verlet", (0, 1.0), dt=0.1)
    mixed = type(sol)(**{**vars(sol), "integrator": Stepping(other.system, dt=0.1)})
    assert sympflow.conformal_defect(mixed) == pytest.approx(np.exp(-0.03) - np.exp(-0.031), rel=1e-6)
    plain = solve(pendulum(), "verlet", (0, 1.0), dt=0.1)
    assert sympflow.conformal_defect(plain) == sympflow.symplecticity_defect(plain)
