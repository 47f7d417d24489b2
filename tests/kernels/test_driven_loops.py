"""Compiled loops of driven systems, H(t, q, p): orders, the times of the stages, samples, friction."""

import math
from functools import cache

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, get, solve
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import SCHEMES

W = 1.7
PENDULUM = HamiltonianSystem.from_sympy(
    "p**2/2 - cos(q)*(1 + a*cos(w*t))", time="t", params={"a": 0.3, "w": W}, period=2 * math.pi / W
)
START, T0 = np.array([1.0, 0.3]), 0.4
IN_DRIFT = HamiltonianSystem.from_sympy(
    "(p - A*sin(w*t))**2/2*exp(-t/3) + cos(q)*(2 + cos(t))", time="t", params={"A": 0.5, "w": 2.0}
)


@cache
def exact(system, t=T0 + 4):
    """The state at the time t, to rounding."""
    return solve_ivp(system, (T0, t), START, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


def slope(system, scheme):
    """The order by the errors of two runs of 4 units of time."""
    kernel, n = splitting_loops(system).kernel(scheme), 10 if scheme.order >= 6 else 20
    errors = [
        np.abs(kernel.run(4 / m, START, m, np.array([m]), t0=T0).states[-1] - exact(system)).max() for m in (n, 2 * n)
    ]
    return math.log2(errors[0] / errors[1])


@pytest.mark.parametrize("name", [n for n, s in SCHEMES.items() if not (s.nystrom or s.level)])
def test_schemes_keep_their_order_where_the_kinetic_energy_depends_on_the_time(name):
    assert slope(IN_DRIFT, SCHEMES[name]) > SCHEMES[name].order - 0.35


@pytest.mark.parametrize("method", ["kahan_li8", "chin4c", "gauss_legendre6"])
def test_a_step_has_its_inverse_and_its_jacobian_at_its_time(method):
    integrator, t, h = get(method)(dt=0.1), 1.3, 0.1
    y = np.stack([START, START + 0.1])
    end = integrator.step(PENDULUM, t, y, h)
    assert np.abs(integrator.inverse(PENDULUM, t, end, h) - y).max() < 1e-14
    found, A = integrator.tangent(PENDULUM, t, y, np.full(2, h))
    apart = [1e-6 * e for e in np.eye(2)]
    slopes = [(integrator.step(PENDULUM, t, y + e, h) - integrator.step(PENDULUM, t, y - e, h)) / 2e-6 for e in apart]
    assert np.abs(A - np.stack(slopes, -1)).max() < 1e-8
    assert np.abs(found - end).max() < 1e-14
    assert np.abs(np.linalg.det(A) - 1).max() < 1e-13


def test_numba_functions_with_the_time_first():
    @numba.njit
    def potential(t, q):
        return -np.cos(q[0]) * (1 + 0.3 * np.cos(W * t))

    @numba.njit
    def gradient(t, q, out):
        out[0] = np.sin(q[0]) * (1 + 0.3 * np.cos(W * t))

    system = HamiltonianSystem(potential, ndof=1, gradient=gradient, time=True)
    found = solve(system, "kahan_li8", t_span=(T0, T0 + 4), y0=START, dt=0.1, backend="compiled")
    assert np.abs(found.y[:, -1] - exact(PENDULUM)).max() < 1e-11
