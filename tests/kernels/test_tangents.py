"""Compiled derivatives of kicks and drifts: those of the same steps differentiated by tensors."""

from __future__ import annotations

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, systems
from sympflow.integrators.contract import forward_tangent
from sympflow.integrators.registry import build
from sympflow.kernels import tangents
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.kernels.stages import single_table, step_table
from sympflow.kernels.tangents import step_tangents, tangent_code
from sympflow.schemes import scheme_named


def coupled(**more):
    H = "p1**2/(2*m) + p2**2/3 + p1*p2/8 + w*(q1**2 + q2**2)/2 + sin(q1)*q2 + (1 + q1**2 + q2**2)**(-3/2)"
    return HamiltonianSystem.from_sympy(H, params={"m": 1.5, "w": 0.8}, y0=[0.3, -0.2, 0.4, 0.1], **more)


def relativistic():
    return HamiltonianSystem.from_sympy("sqrt(1 + p1**2 + p2**2) + q1**4/4 + q1*q2**2", y0=[0.3, -0.2, 0.4, 0.1])


def shapes():
    yield from (
        (system, name) for system in (systems.henon_heiles, coupled) for name in ("verlet", "chin4c", "srkn11b")
    )
    yield systems.pendulum, "kahan_li8"
    yield systems.kepler, "kahan_li8"
    yield relativistic, "kahan_li8"


@pytest.mark.parametrize("room", [False, True], ids=["registers", "memory"])
@pytest.mark.parametrize(("make", "name"), [*shapes()])
def test_steps_and_their_jacobians_are_those_of_differentiated_steps(make, name, room, monkeypatch):
    monkeypatch.setattr(tangents, "MOST_WRITTEN_OUT", 0 if room else 10**6)
    monkeypatch.setattr("sympflow.kernels.rollouts._CODES", {})
    system, integrator = make(), build(name, {})
    rng = np.random.default_rng(0)
    y = system.y0 + 0.1 * rng.standard_normal((21, 2 * system.ndof))
    h = rng.uniform(-0.1, 0.1, 21)
    found = integrator.tangent(system, 0.0, y, h)
    expected = forward_tangent(lambda x, s: integrator.step(system, 0.0, x, s), y, h)
    assert tangent_code(system, scheme_named(name).level, (), y.shape[1], False).room == (0 if room else None)
    for a, b in zip(found, expected, strict=True):
        assert np.abs(a - b).max() < 2e-14 * max(1.0, np.abs(b).max())


MATRIX = [[0.2, 0.1], [0.1, 0.3]]


@pytest.mark.parametrize(("damping", "room"), [(0.1, True), ([0.1, 0.3], False), (MATRIX, False), (MATRIX, True)])
def test_friction_shrinks_vectors(damping, room, monkeypatch):
    monkeypatch.setattr(tangents, "MOST_WRITTEN_OUT", 0 if room else 10**6)
    monkeypatch.setattr("sympflow.kernels.rollouts._CODES", {})
    system, integrator = coupled(damping=damping), build("chin4c", {})
    code = tangent_code(system, integrator.kicks_and_drifts.level, (), 4, False)
    rows = np.concatenate([system.y0, np.eye(4).reshape(-1)])[None].repeat(3, 0)
    out = np.empty_like(rows)
    code.mapped(splitting_loops(system).rows(single_table(integrator.kicks_and_drifts, 0.1)), rows, out)
    h = np.full(3, 0.1)
    y, A = forward_tangent(lambda x, s: integrator.step(system, 0.0, x, s), rows[:, :4], h)
    assert np.abs(out[:, :4] - y).max() < 1e-14
    assert np.abs(out[:, 4:].reshape(-1, 4, 4).swapaxes(1, 2) - A).max() < 1e-14


def test_systems_without_compiled_vectors_say_so():
    driven = HamiltonianSystem.from_sympy("p**2/2 + q**2/2 + q*cos(t)", time="t", y0=[1.0, 0.0])
    with pytest.raises(ValueError, match=r"`system` .* depends on t"):
        tangent_code(driven, 0, (), 1, True)
    y = np.ones((2, 2))
    assert step_tangents(driven, step_table(scheme_named("verlet")), y[0], y[0], y) is None
    assert sympflow.lyapunov(driven, "verlet", (0, 1), dt=0.1).success
