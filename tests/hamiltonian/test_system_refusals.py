"""Definitions and states that systems refuse, and what they say."""

import sys

import numpy as np
import pytest
import torch
from conftest import refusals
from test_pairs import gravity
from test_system import SYSTEMS, numba_pendulum

from sympflow import HamiltonianSystem, solve, systems, time_transformed
from sympflow.systems.pairs import pair_functions

lattice, made = HamiltonianSystem.lattice, HamiltonianSystem.from_sympy
TURNING = r"its stiff directions turn, by .*such as polar"
STRAIGHT = made("(p1**2 + p2**2)/2 + 1e6*(1 - cos(q1)) + q1*q2**3 + q2**2/2", y0=[1e-3, 0.5, 0, 0])
MAGNETIC = made("(p1 + q2)**2/2 + (p2 - q1)**2/2 + 30*q1**2 + q2**4", y0=[1, 0, 0, 0])
OPAQUE = HamiltonianSystem(lambda q: -1 / (torch.cummax(q, -1).values ** 2).sum(-1) ** 0.5, ndof=2, y0=[1, 0, 0, 1])
PRODUCT = HamiltonianSystem(hamiltonian=lambda q, p: (p**2).sum(-1) * (1 + (q**2).sum(-1)), ndof=2, y0=[0.1] * 4)
TIMELESS = r"^`time` is for systems that are written out.*from_sympy"
EACH_RATE = gravity(4, damping=np.linspace(0.1, 0.2, 12))

test_refused = refusals(
    (lambda: lattice(bond="r**2/2", shape=8, time="t"), TypeError, TIMELESS),
    (lambda: HamiltonianSystem.pairs("1/r", masses=np.ones(3), time="t"), TypeError, TIMELESS),
    (lambda: HamiltonianSystem.schroedinger(shape=8, time="t"), TypeError, TIMELESS),
    (lambda: lattice(bond="r**2/2", shape=10**6).potential_hessian(np.zeros(10**6)), "dense"),
    (lambda: systems.pendulum().energy_density(np.zeros(2)), "no energy density"),
    (lambda: numba_pendulum(False).potential_hessian(np.zeros(2)), "^`hessian_vector` is needed here"),
    (lambda: numba_pendulum(False).potential_hessian(torch.zeros(2)), "^`hessian_vector` is needed here"),
    (lambda: solve(PRODUCT, "verlet", (0, 1)), "'H of a function' is not: use an implicit method"),
    (lambda: solve(EACH_RATE, "verlet", backend="compiled"), "`system` .pairs. has friction, and its loops"),
    (lambda: solve(systems.spring_pendulum(1e4), "impulse", (0, 1), dt=0.01), TURNING),
    (lambda: systems.spring_pendulum(1e2).linear_part, TURNING),
    (lambda: solve(systems.pendulum(), "mollified_impulse", (0, 1)), "its potential has no quadratic terms"),
    (lambda: OPAQUE.linear_part, "pass stiffness_matrix=K"),
    (lambda: time_transformed(OPAQUE).linear_part, "^`system` .* whose linear part is not known"),
    (lambda: STRAIGHT.linear_part, r"do not turn, but its quadratic .* do not hold them.*stiffness_matrix=K"),
    (lambda: MAGNETIC.linear_part, r"quadratic terms alone\. Use 'implicit_midpoint'"),
    (lambda: SYSTEMS["harmonic"].with_params(b=1.0), "^`params` has 'b'"),
)


def test_without_numba_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ImportError, match=r"^`pair` must be a Numba function.*pip install numba"):
        pair_functions(lambda s: (s, s, s), np.ones((2, 2)), 2)


def test_what_is_better_a_lattice_is_told_so():
    terms = " + ".join(f"p{i}**2/2 + q{i}**2/2" for i in range(1, 402))
    with pytest.warns(UserWarning, match=r"401 coordinates.*HamiltonianSystem.lattice"):
        made(terms)
