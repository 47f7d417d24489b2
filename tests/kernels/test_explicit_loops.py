"""Compiled explicit Runge–Kutta steps and vector fields: those of arrays, to rounding, for H of every kind."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sympflow import HamiltonianSystem, doubled, systems
from sympflow.kernels.explicit_loops import compiled_field

made, EPS = HamiltonianSystem.from_sympy, np.finfo(float).eps
T, CHAIN = np.linspace(0, 9, 30), range(1, 20)
TURNING = "(p1**2 + p2**2)*(1 + q1**2 + q2**2)/2 + k*(q1**2 + q2**2)**2/4"
BONDS = "+".join(["p20**2/2", *(f"p{i}**2/2 + (q{i + 1} - q{i})**2/2 + 0.{i}*(q{i + 1} - q{i})**4" for i in CHAIN)])
DRIVEN = made(
    "p**2/2 + q**4/4 - a*q*cos(w*t) + p*q*sin(t)", params={"a": 0.3, "w": 1.3}, time="t", y0=[0.3, 0.1], dt=0.02
)
SYSTEMS = {
    "separable": systems.henon_heiles(),
    "not separable": made(TURNING, params={"k": 0.7}, y0=[0.6, 0.1, -0.2, 0.5], dt=0.02),
    "driven": DRIVEN,
    "sampled": made("p**2/2 + q**4/4 - q*b", params={"b": CubicSpline(T, np.sin(T))}, time="t", y0=[0.3, 0.1], dt=0.02),
    "damped": made(TURNING, params={"k": 0.7}, y0=[0.6, 0.1, -0.2, 0.5], dt=0.02, damping=[[0.3, 0.1], [0.1, 0.2]]),
    "forced": doubled(DRIVEN, "-0.1*p*abs(p) + cos(2*t)").physical,
    "many terms": made(f"{BONDS} + cos(q1)", y0=np.linspace(-0.3, 0.3, 40), dt=0.02),
    "many, driven and damped": made(
        f"{BONDS} - q1*cos(1.3*t)", time="t", y0=np.linspace(-0.3, 0.3, 40), dt=0.02, damping=np.linspace(0, 0.2, 20)
    ),
}


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_the_compiled_field_is_the_vector_field(system):
    field, rng = compiled_field(system), np.random.default_rng(0)
    for t in (0.0, 0.7, 5.3):
        y = rng.normal(0, 0.5, 2 * system.ndof)
        expected = system.vector_field(y, t)
        np.testing.assert_allclose(field(t, y), expected, rtol=0, atol=50 * EPS * (1 + np.abs(expected).max()))
