"""Velocities in place of momenta, or positions alone: H is learned with its masses, but for a factor."""

from dataclasses import replace

import numpy as np
import pytest

import sympflow
from sympflow.learning.families import FAMILIES, Constraints, families
from sympflow.learning.fitting import Setting, fitted
from sympflow.learning.lagrangian import lagrangian_start
from sympflow.learning.learner import constraints_of
from sympflow.learning.models import Model, friction
from sympflow.learning.orbits import first_states
from sympflow.learning.parts import Fixed, Polynomial, kinetic, known_kinetic
from sympflow.learning.trajectories import Trajectories
from sympflow.systems import double_pendulum

t = np.linspace(0.0, 2.0, 51)
PENDULUM = sympflow.HamiltonianSystem.from_sympy("p**2 - cos(q)", name="light")  # of mass ½
CARTS = sympflow.HamiltonianSystem.from_sympy("p1**2 + p2**2/3 + q1**2/2 + (q1 - q2)**2 + q2**4/4", name="carts")
CHARGE = sympflow.HamiltonianSystem.from_sympy("(p1 + q2)**2/2 + (p2 - q1)**2/2 + q1**2/2 + q2**4/4", name="charge")


def observations(system, observed, runs=5, noise=0.0):
    """Trajectories with momenta, with velocities, or with neither, and the states."""
    d, rng = system.ndof, np.random.default_rng(0)
    y = sympflow.solve(system, "gauss_legendre8", (0, 2), rng.uniform(-1, 1, (runs, 2 * d)), t_eval=t, dt=0.02).y
    seen = y.copy()
    if observed != "qp":
        seen[:, d:] = np.moveaxis(system.vector_field(np.moveaxis(y, -1, -2)), -1, -2)[:, :d]
    seen += noise * rng.standard_normal(seen.shape)
    return Trajectories.read((t, seen[:, : d if observed == "q" else 2 * d]), observed=observed), y


def accelerations(model, theta, y):
    """q'' of a model at observations (2d, N)."""
    x = model.states(theta, y)
    field = model.field(theta, x, False, False).value
    velocities = replace(model, velocities=True)
    return velocities.observed(theta, x, field[:, None])[1][model.ndof :, 0]


def candidate(name, data, place, period=None):
    return [*FAMILIES[name].models(constraints_of(data, None, None, False, period, None))][place].model


@pytest.mark.parametrize("observed", ["qp", "qv", "q"])
def test_lagranges_equations_give_the_masses_of_a_double_pendulum(observed):
    """Without a start, from smoothed curves: accelerations to the errors of these."""
    data, y = observations(double_pendulum(), observed)
    model = candidate("inertia", data, 1, 2 * np.pi)
    theta, moved = lagrangian_start(model, data, model.start(np.random.default_rng(0)))
    assert not moved.velocities
    v = double_pendulum().vector_field(y[0].T).T
    seen = y[0] if observed == "qp" else np.concatenate([y[0, :2], v[:2]])
    right = np.gradient(v[:2], t, axis=1)[:, 5:-5]
    found = accelerations(model, theta, seen)[:, 5:-5]
    assert np.sqrt(np.mean((found - right) ** 2)) < 0.01 * right.std()


@pytest.mark.parametrize(("period", "spread", "names"), [(None, 1.0, ["radians"]), (None, 50.0, ["degrees"]),
                                                         (None, 1e-3, []), (np.inf, 1.0, [])])  # fmt: skip
def test_angles_that_nobody_told_of_are_tried(period, spread, names):
    data = Trajectories.read([(t, spread * np.stack([np.cos(t + k), -np.sin(t + k)])) for k in range(3)])
    first, *assumed = constraints_of(data, None, None, False, period, None).groups("waves")
    assert not first.models
    assert [group.models[0].name.split()[-1] for group in assumed] == names
    assert all(group.assumed for group in assumed)


@pytest.mark.parametrize("force", [None, friction])
@pytest.mark.parametrize("inertial", [False, True])
def test_what_is_observed_of_a_state_has_the_derivatives_that_are_said(inertial, force):
    data, _ = observations(double_pendulum() if inertial else CARTS, "qv")
    model = candidate("inertia" if inertial else "polynomial", data, 1, 2 * np.pi if inertial else None)
    model = replace(model, force=force)
    rng, h = np.random.default_rng(0), 1e-6
    theta = rng.uniform(0.1, 0.2, model.n)
    y = data.runs[0].y[:, ::20]
    x = model.states(theta, y)
    assert model.observed(theta, x, None)[0] == pytest.approx(y, abs=1e-12)
    X = np.concatenate([np.eye(4), np.zeros((4, model.n))], axis=1)[..., None] * np.ones(x.shape[1])
    found = model.observed(theta, x, X)[1]
    for i, e in enumerate(h * np.eye(4)[:, :, None]):
        ahead, behind = (model.observed(theta, x + s * e, None)[0] for s in (1, -1))
        assert (ahead - behind) / (2 * h) == pytest.approx(found[:, i], abs=1e-7)
    for i, e in enumerate(h * np.eye(model.n)):
        ahead, behind = (model.observed(theta + s * e, x, None)[0] for s in (1, -1))
        assert (ahead - behind) / (2 * h) == pytest.approx(found[:, 4 + i], abs=1e-7)


@pytest.mark.parametrize(
    ("system", "family", "place", "period"),
    [
        (PENDULUM, "waves", 0, 2 * np.pi),
        (CARTS, "polynomial", 2, None),
        (CHARGE, "magnetic", 2, None),
        (double_pendulum(), "inertia", 1, 2 * np.pi),
    ],
    ids=lambda value: getattr(value, "name", None),
)
@pytest.mark.parametrize("observed", ["qv", "q"])
def test_motions_are_found_by_shooting(system, family, place, period, observed):
    """Accelerations at the data, which no gauge changes, of trajectories without noise."""
    data, y = observations(system, observed)
    model = candidate(family, data, place, period)
    found = fitted(model, data, Setting(np.full(2 * system.ndof, 1e-5)))  # as far as they are to be followed
    seen = np.concatenate([y[0, : system.ndof], system.vector_field(y[0].T).T[: system.ndof]])
    right = np.einsum("nij,nj->in", system.field_jacobian(y[0].T), system.vector_field(y[0].T))[: system.ndof]
    assert accelerations(model, found.theta, seen) == pytest.approx(right, abs=1e-3)


def test_friction_is_told_by_velocities():
    system = sympflow.HamiltonianSystem.from_sympy("p**2 + q**2", damping=0.2, name="damped")
    y = [sympflow.solve(system, "dop853", (0, 2), start, t_eval=t, rtol=1e-11, atol=1e-12).y for start in np.eye(2)]
    data = Trajectories.read((t, np.array(y) * np.array([1.0, 2.0])[:, None]), observed="qv")
    found = fitted(replace(candidate("polynomial", data, 0), force=friction), data, Setting())
    assert found.theta[-1] == pytest.approx(0.2, abs=1e-6)


def test_learn_gives_h_and_the_momenta():
    spring = sympflow.HamiltonianSystem.from_sympy("p**2 + q**2", name="spring")
    data, y = observations(spring, "qv", noise=0.005)
    flow = sympflow.learn(data, family="polynomial", dt=0.5)
    v = 2 * y[:, 1, 0]
    p = flow.system.momenta(y[:, :1, 0], v[:, None])
    assert p[:, 0] == pytest.approx(v, abs=1e-12)
    made = sympflow.solve(flow.system, flow, (0, 2), np.stack([y[:, 0, 0], p[:, 0]], 1), t_eval=t).y
    assert np.abs(made[:, 0] - y[:, 0]).max() < 0.01
    assert flow.figures["noise_v1"] == pytest.approx(0.005, rel=0.2)
    assert flow.figures["energy_scatter"] < 0.02


def test_velocities_of_no_momenta_are_refused():
    with pytest.raises(ValueError, match="`v`: Newton's method finds no momenta"):
        sympflow.HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**2").momenta(np.zeros((1, 1)), np.full((1, 1), 2.0))


def test_the_noise_of_velocities_biases_nothing():
    """Within four standard errors; of velocities that nobody observed there is no noise."""
    for observed in ("qv", "q"):
        data, _ = observations(PENDULUM, observed, runs=10, noise=0.01)
        found = fitted(candidate("waves", data, 0, 2 * np.pi), data, Setting())
        error = np.sqrt(found.fit.covariance()[0, 0])
        assert abs(found.theta[0] + 2) < 4 * error < 0.2  # V = −2cos q, with M = 1
        assert found.sigma[0] == pytest.approx(0.01, rel=0.1)


def test_only_the_factor_of_h_is_given():
    """(M⁻¹)₁₁ = 1 beside the numbers of all others."""
    constraints = Constraints(np.ones(4), None, None, None, np.full(4, np.inf), velocities=True, middle=np.zeros(2))
    model = constraints.separated(Polynomial.up_to(2, "q", np.ones(2)))
    assert model.n == kinetic([1.0, 1.0]).n - 1 + 5
    assert isinstance(model.parts[0], Fixed)
    W = model.field(np.ones(model.n), np.eye(4), True, False).slope[:2, 2:]
    assert np.broadcast_to(W, (2, 2, 4))[..., 0] == pytest.approx(np.array([[1.0, 1.0], [1.0, 2.0]]))


@pytest.mark.parametrize(
    ("system", "v"),
    [(PENDULUM, [[0.6]]), (CHARGE, [[0.6, -0.4]]), (double_pendulum(), [[0.6, -0.4]]),
     (sympflow.HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**2"), [[0.6]])],
    ids=lambda value: getattr(value, "name", None),
)  # fmt: skip
def test_momenta_are_those_of_velocities(system, v):
    q = 0.3 * np.ones((1, system.ndof))
    found = system.vector_field(np.concatenate([q, system.momenta(q, np.array(v))], axis=1))[:, : system.ndof]
    assert found == pytest.approx(np.array(v), abs=1e-12)


def test_the_first_velocity_is_the_slope_of_the_positions():
    data, y = observations(PENDULUM, "q")
    starts = first_states(data, Model(1, (known_kinetic(np.eye(1)),), velocities=True), np.zeros(0))
    assert starts[:, 1] == pytest.approx(2 * y[:, 1, 0], abs=0.02)  # of a cubic over 0.36


def test_families_are_those_that_velocities_tell():
    constraints = Constraints(np.ones(4), None, None, None, np.full(4, np.inf), velocities=True, middle=np.zeros(2))
    assert families(constraints, None) == ["central", "pairs", "waves", "polynomial", "network", "inertia", "magnetic"]
    assert "magnetic" not in families(replace(constraints, velocities=False), None)
    with pytest.raises(ValueError, match="`family` 'whole-polynomial' does not apply"):
        families(constraints, "whole-polynomial")
    for known, parts in ((None, 2), (np.eye(2), 1)):
        assert len(replace(constraints, inverse_mass=known).kinetic()) == parts
