"""Compiled runs of every kind come near the solution, found by SciPy from equations written by hand, at their order."""

import math

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, solve
from sympflow.kernels import terms
from sympflow.kernels.array_splittings import ArrayCode
from sympflow.kernels.splitting_loops import splitting_loops

RNG = np.random.default_rng(7)


def separable(force):
    """The rates of H = ½p² + V(q) with the force −∇V(q)."""
    return lambda t, y: np.concatenate([y[len(y) // 2 :], force(t, y[: len(y) // 2])])


def ring(t, q):
    r = np.roll(q, -1) - q
    tension = r + r**3
    return tension - np.roll(tension, 1)


def softened(t, q):
    x = q.reshape(-1, 2)
    d = x[None] - x[:, None]
    return (d / ((d**2).sum(-1, keepdims=True) + 0.5) ** 1.5).sum(1).ravel()


def of(H, y0, **more):
    return HamiltonianSystem.from_sympy(H, y0=y0, **more)


BODIES = HamiltonianSystem.pairs("-1/sqrt(r**2 + 1/2)", masses=np.ones(7), dim=2, y0=RNG.normal(0, 1, 28))
CASES = {  # a system, its rates, a method and its order, the longer of two steps
    "written out": (
        of("(p1**2 + p2**2)/2 + q1**4/4 + q1*q2**2 + q2**2", [0.3, 0.2, 0.1, -0.2]),
        separable(lambda t, q: np.array([-(q[0] ** 3) - q[1] ** 2, -2 * q[0] * q[1] - 2 * q[1]])),
        ("kahan_li8", 8, 0.25),
    ),
    "driven": (
        of("p**2/2 + q**4/4 - q*cos(1.3*t)", [0.5, 0.2], time="t"),
        separable(lambda t, q: -(q**3) + math.cos(1.3 * t)),
        ("kahan_li8", 8, 0.25),
    ),
    "terms": (
        of(
            sp.sympify("(p1**2 + p2**2 + p3**2)/2 + (q1 - q2)**4/4 + (q2 - q3)**4/3 + q3**2"),
            [0.3, -0.4, 0.5, 0.1, 0.2, -0.2],
        ),
        separable(
            lambda t, q: np.array(
                [
                    -((q[0] - q[1]) ** 3),
                    (q[0] - q[1]) ** 3 - 4 / 3 * (q[1] - q[2]) ** 3,
                    4 / 3 * (q[1] - q[2]) ** 3 - 2 * q[2],
                ]
            )
        ),
        ("kahan_li8", 8, 0.25),
    ),
    "lattice": (
        HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=12, y0=RNG.uniform(-0.5, 0.5, 24)),
        separable(ring),
        ("kahan_li8", 8, 0.125),
    ),
    "pairs": (BODIES, separable(softened), ("kahan_li8", 8, 0.125)),
    "implicit": (
        of("(1 + q**2)*p**2/2 + q**4/4", [0.5, 0.4]),
        lambda t, y: np.array([(1 + y[0] ** 2) * y[1], -y[0] * y[1] ** 2 - y[0] ** 3]),
        ("gauss_legendre6", 6, 0.25),
    ),
    "linear part": (
        of("p**2/2 + 2*q**2 + q**4/4", [0.5, 0.4]),
        separable(lambda t, q: -4 * q - q**3),
        ("linear_kahan_li6", 6, 0.25),
    ),
    "explicit, damped": (
        of("p**2/2 + q**4/4 - q*cos(1.3*t)", [0.5, 0.2], time="t", damping=0.1),
        lambda t, y: np.array([y[1], -(y[0] ** 3) + math.cos(1.3 * t) - 0.1 * y[1]]),
        ("rk4", 4, 0.0625),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_compiled_runs_come_near_the_solution_at_their_order(name, monkeypatch):
    system, rates, (method, order, dt) = CASES[name]
    if name == "terms":
        monkeypatch.setattr(terms, "MOST_WRITTEN_OUT", 0)
        monkeypatch.setattr(terms, "MOST_OPERATIONS", 0)
        assert isinstance(splitting_loops(system).functions(0, False), ArrayCode)
    exact = solve_ivp(rates, (0, 4), system.y0, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    ends = [solve(system, method, (0, 4), dt=dt / n, backend="compiled").y[:, -1] for n in (1, 2)]
    coarse, fine = (np.abs(y - exact).max() for y in ends)
    assert math.log2(coarse / fine) > order - 0.5
