"""Implicit midpoint and Gauss–Legendre 4, 6, 8: any H, quadratic invariants, failure of Newton's iteration."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, get, max_energy_error, solve, systems
from sympflow.integrators.implicit import gauss_legendre
from sympflow.testing.checks import check_integrator

METHODS = ("implicit_midpoint", "gauss_legendre4", "gauss_legendre6", "gauss_legendre8")
EPS = np.finfo(float).eps

TURNING = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2)*(1 + q1**2 + q2**2)/2 + (q1**2 + q2**2)**2/4", y0=[0.6, 0.1, -0.2, 0.5], dt=0.05
)


@pytest.mark.parametrize("method", [METHODS[0], *(pytest.param(m, marks=pytest.mark.slow) for m in METHODS[1:])])
def test_the_contract_holds_where_h_does_not_split(method):
    names = check_integrator(get(method), TURNING)
    assert {"the_order_is_the_slope", "symplecticity_as_declared", "the_inverse_undoes_the_step"} <= set(names)


@pytest.mark.parametrize("stages", [1, 2, 3, 4])
def test_the_coefficients_are_those_of_gauss_and_symplectic_without_rounding(stages):
    A, B, scale = gauss_legendre(stages)
    a = [[A[i][j] * scale[j] for j in range(stages)] for i in range(stages)]
    b = [B[i] * scale[i] for i in range(stages)]
    c = [sum(row) for row in a]
    for k in range(1, 2 * stages + 1):  # the quadrature has order 2s, each stage order s (Hairer and Wanner, IV.5)
        assert abs(sum(b[i] * c[i] ** (k - 1) for i in range(stages)) - 1 / k) < 4 * EPS
        for i in range(stages if k <= stages else 0):
            assert abs(sum(a[i][j] * c[j] ** (k - 1) for j in range(stages)) - c[i] ** k / k) < 4 * EPS
    exact = [[Fraction(A[i][j]) / Fraction(B[j]) for j in range(stages)] for i in range(stages)]
    for i in range(stages):
        for j in range(stages):
            assert exact[i][j] + exact[j][i] == 1  # b_i a_ij + b_j a_ji = b_i b_j
            assert exact[i][j] == exact[-1 - j][-1 - i]  # symmetric, so reversible
        assert scale[i] == scale[-1 - i]


@pytest.mark.parametrize("method", METHODS)
def test_quadratic_invariants_are_conserved_to_rounding(method):
    n, dt = 2000, 0.1 if get(method).order <= 4 else 0.5
    sol = solve(TURNING, method, (0.0, dt * n), dt=dt)
    q1, q2, p1, p2 = sol.y
    momentum = q1 * p2 - q2 * p1  # HLW, theorem IV.2.1
    assert np.abs(momentum - momentum[0]).max() < EPS * n
    assert max_energy_error(sol) > 1e3 * EPS * n  # H itself is none


@pytest.mark.parametrize(("method", "backend"), [(METHODS[0], "array"), (METHODS[1], "auto")])
def test_newtons_failure_is_status_minus_one_with_the_time(method, backend):
    hh = systems.henon_heiles()
    sol = solve(hh, method, (0.0, 10.0), y0=[0.0, 0.0, 0.0, 0.7], dt=0.05, backend=backend)
    assert sol.status == -1
    assert sol.message.startswith("The implicit step could not be solved: Newton's iteration did not converge after t")
    assert np.isfinite(sol.y).all()
    assert sol.t[-1] == sol.stats["failed_at"]
    assert abs(sol.t[-1] - 5.450984210235402) < 5 * 0.05  # the solution is singular there
    batch = solve(hh, method, (0.0, 10.0), y0=[hh.y0, [0.0, 0.0, 0.0, 0.7]], dt=0.05, backend=backend)
    assert batch.status.tolist() == [0, -1]
    assert np.isnan(batch.stats["failed_at"][0])
    assert batch.stats["failed_at"][1] == sol.t[-1]
    np.testing.assert_allclose(batch.y[1, :, : len(sol.t)], sol.y, rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_first_and_second_derivatives_pass_through_a_step(method):
    integrator = get(method)()

    def step(y):
        return integrator.step(TURNING, 0.0, y, 0.2)

    y = torch.tensor(TURNING.y0, requires_grad=True)
    assert torch.autograd.gradcheck(step, y)
    assert torch.autograd.gradgradcheck(step, y)


@pytest.mark.slow
def test_compensated_sums_need_compiled_loops_and_lower_the_rounding():
    pendulum = systems.pendulum()
    rms = []
    for compensated in (False, True):
        sol = solve(pendulum, "gauss_legendre4", (0.0, 200.0), dt=0.001, compensated=compensated, save_every=20)
        error = sol.energy_error()
        rms.append(np.sqrt(np.mean(error[len(error) // 2 :] ** 2)))
    assert rms[1] < 0.5 * rms[0]
    with pytest.raises(ValueError, match=r"^`compensated` sums need compiled loops"):
        solve(pendulum, "gauss_legendre4", (0.0, 1.0), compensated=True, backend="array")


@pytest.mark.parametrize("method", ["gauss_legendre6", "gauss_legendre8"])
def test_the_energy_error_of_many_steps_is_rounding_without_drift(method):
    n = 50_000
    error = solve(TURNING, method, (0.0, 0.02 * n), dt=0.02, save_every=50).energy_error()
    truncation = 0 if get(method).order == 8 else 1e-14
    assert np.abs(error).max() < 10 * EPS * np.sqrt(n) + truncation


@pytest.mark.parametrize(
    ("method", "backend"),
    [
        *zip(METHODS, ["compiled", "array"] * 2, strict=True),
        *(pytest.param(m, "compiled", marks=pytest.mark.slow) for m in METHODS[1::2]),
    ],
)
@pytest.mark.parametrize("z", [20.0, 1e3])
def test_no_step_is_too_long_for_an_oscillator(method, backend, z):
    omega, n = 1e6, {"compiled": 10_000, "array": 300}[backend]
    sol = solve(systems.harmonic_oscillator(omega), method, (0.0, n * z / omega), dt=z / omega, backend=backend)
    assert max_energy_error(sol) < 100 * EPS * np.sqrt(n)
    assert sol.stats["newton_iterations"] == 2 * n  # a linear system is solved at once; the second finds nothing left
