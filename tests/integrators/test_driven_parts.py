"""Driven systems in exactly solvable parts, exact linear flows and coupled copies: with which part the time moves."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sympflow import HamiltonianSystem, get, solve

made = HamiltonianSystem.from_sympy
SCENE = {"time": "t", "t_span": (0.3, 2.3), "dt": 0.05}
COPIES = made("(p**2 + 1)*(q**2 + 1)/2*(1 + 0.3*cos(1.3*t)) + 0.2*q*sin(t)", y0=[0.7, 0.3], **SCENE)
LINEAR = made(
    "p1**2/2 + p2**2/2 + 8*q1**2 + q2**2/2 + q1*q2*cos(1.3*t) + q1**4/4*(1 + sin(t)) + q2**4/4",
    y0=[0.3, 0.5, 0.2, -0.1],
    **SCENE,
)
POLAR = made(
    "p1**2/2*(1 + 0.2*sin(t)) + p2**2/(2*(1 + q1**2)) + q1**2/2 + q2**2/2*(1 + a)",
    params={"a": CubicSpline(np.arange(6), [0.0, 0.5, 0.2, -0.3, 0.1, 0.4])},
    y0=[0.3, 0.5, 0.2, -0.1],
    **SCENE,
)
TERMS = ("q1**2/2 + q2**2/2*(1 + a)", "p2**2/(2*(1 + q1**2))", "p1**2/2*(1 + 0.2*sin(t))")
CASES = [
    (COPIES, "tao2", {}),
    (COPIES, "tao4", {}),
    (COPIES, "tao8", {}),
    (LINEAR, "impulse", {}),
    (LINEAR, "mollified_impulse", {}),
    (LINEAR, "linear_srkn6b", {}),
    (LINEAR, "linear_omelyan4", {}),
    (POLAR, "strang_parts", {}),
    (POLAR, "kahan_li6_parts", {}),
    (POLAR, "kahan_li6_parts", {"parts": TERMS}),
    (POLAR, "kahan_li6_parts", {"parts": TERMS[::-1]}),
]


@pytest.mark.parametrize(("system", "method", "options"), CASES)
def test_every_splitting_keeps_its_order(system, method, options):
    order = get(method).order
    assert order is not None
    end = system.t_span[1]
    if system is POLAR:  # the third derivative of its spline jumps at t = 1 and 2
        end = 0.95
    truth = solve(system, "dop853", (0.3, end), t_eval=[end], rtol=1e-13, atol=1e-15).y
    steps = (end - 0.3) / np.array([5, 10] if order > 4 else [20, 40])
    errors = [
        np.abs(solve(system, method, (0.3, end), dt=dt, t_eval=[end], backend="array", **options).y - truth).max()
        for dt in steps
    ]
    assert np.log2(errors[0] / errors[1]) > order - 0.35


@pytest.mark.parametrize(("system", "method"), [(LINEAR, "linear_omelyan4"), (POLAR, "strang_parts")])
def test_a_step_has_its_inverse_at_its_time(system, method):
    integrator, t = get(method)(), np.array([0.4, 1.3])
    y = np.stack([system.y0, 1.1 * np.asarray(system.y0)])
    end = integrator.step(system, t, y, 0.1)
    assert np.abs(end[1] - integrator.step(system, 1.3, y[1], 0.1)).max() < 1e-15
    assert np.abs(integrator.inverse(system, t, end, 0.1) - y).max() < 1e-15
