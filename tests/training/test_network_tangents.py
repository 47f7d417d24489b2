"""Compiled residuals and Jacobians of networks: the same as those of torch, and what takes them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, MLPFlow, SympFlow, systems, train
from sympflow.flow.layers import Kick
from sympflow.flow.potentials import ACTIVATIONS, MLPPotential, Potential
from sympflow.flow.scaling import Scaling
from sympflow.kernels.activations import SIGMAS, activation_program
from sympflow.training.least_squares import gram
from sympflow.training.losses import Loss, Objective
from sympflow.training.points import Points

SCALING = Scaling((0.3, 0.4), (0.5, 0.6), 0.7, (0.1, -0.2), (0.3, 0.0))
DRIVEN = HamiltonianSystem.from_sympy("p**2/2*(1 + q**2) + q**2/2*(1 + cos(t)/3)", time="t", period=2 * np.pi)


def objective(flow, system, weights, n=37):
    """More points than one block of lanes, and not a multiple of it."""
    rng = np.random.default_rng(0)
    x, y = (torch.tensor(0.3 * rng.normal(size=(n, 2 * system.ndof))) for _ in range(2))
    t = torch.tensor(rng.random(n)) * flow.dt
    t0 = () if system.autonomous else (torch.tensor(6.0 * rng.random(n)),)
    points = Points((t, x, *t0), (t[:1], x[None]), (t, x, y, *t0))
    scaling = SCALING if system.ndof == 2 else Scaling((0.3,), (0.5,), 0.7)
    return Objective(Loss(system, scaling, *weights), flow, points, tangents=flow.tangents())


def by_points(values, n):
    """From all points of a coordinate after another to all coordinates of a point after another."""
    return values.unflatten(0, (-1, n)).transpose(0, 1).flatten(0, 1)


FLOWS = {
    "two layers": (systems.double_pendulum(), lambda: SympFlow(2, hidden=(4, 3), seed=1, scale=SCALING)),
    "three": (systems.double_pendulum(), lambda: SympFlow(2, 1, hidden=(2, 5, 3), seed=1, scale=SCALING)),
    "one": (systems.henon_heiles(), lambda: SympFlow(2, hidden=(7,), seed=1)),
    "driven": (DRIVEN, lambda: SympFlow.timed(DRIVEN, 2, hidden=(4, 3), seed=1)),
}


@pytest.mark.parametrize("weights", [(2.0, 0.0, 0.0), (0.0, 0.0, 0.5)], ids=["residual", "labels"])
@pytest.mark.parametrize("name", FLOWS)
def test_as_torch(name, weights):
    system, make = FLOWS[name]
    target = objective(make(), system, weights)
    arrays = replace(target, tangents=None)
    r, J = target.linearized()
    expected_r, expected_J = arrays.linearized()
    torch.testing.assert_close(by_points(r, 37), expected_r, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(by_points(J, 37), expected_J, rtol=1e-11, atol=1e-14)
    assert torch.equal(target.residuals(), r)


def test_two_losses_at_once():
    """The Jacobian of one is no longer the buffer of the other, of as many points."""
    system, make = FLOWS["two layers"]
    target = objective(make(), system, (1.0, 0.0, 3.0))
    r, J = target.linearized()
    g = torch.autograd.grad(replace(target, tangents=None)(), list(target.flow.parameters()))
    torch.testing.assert_close(2 * J.T @ r, torch.cat([w.reshape(-1) for w in g]), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", SIGMAS)
def test_three_derivatives_of_activations(name):
    a = torch.linspace(-30, 30, 121, dtype=torch.float64, requires_grad=True)
    value = ACTIVATIONS[name].value(a)
    for each in activation_program(name, 3)(a.detach().numpy()):
        np.testing.assert_allclose(each, value.detach(), rtol=1e-12, atol=1e-14)
        (value,) = torch.autograd.grad(value.sum(), a, create_graph=True)


def test_half_of_the_products():
    J = torch.tensor(np.random.default_rng(0).normal(size=(20, 6)))
    for each in (J, J.T.contiguous().T):
        torch.testing.assert_close(gram(each), J.T @ J)


class Cubic(Potential):
    """A potential that is no network."""

    ndof = 1

    def __init__(self):
        super().__init__()
        self.c = torch.nn.Parameter(torch.ones(1, dtype=torch.float64))

    def impulse(self, t, x):
        return self.c * t * x**2


def test_what_has_none():
    of = MLPPotential
    assert SympFlow(1, activation="sin").tangents() is not None
    assert SympFlow(1, dtype=torch.float32).tangents() is None
    assert MLPFlow(1).tangents() is None
    assert SympFlow.primed(systems.pendulum(), 2).tangents() is None
    assert SympFlow.from_layers([Kick(Cubic())], 1.0).tangents() is None
    assert SympFlow.from_layers([Kick(of(1, (3,))), Kick(of(1, (4,)))], 1.0).tangents() is None


@pytest.mark.filterwarnings("ignore:The flow is far from the exact one:UserWarning")
def test_training_takes_them(monkeypatch):
    """The same seed trains to the same weights with and without, up to rounding."""
    system = systems.nonseparable(0.5)
    options = {"kind": "sympflow", "pairs": 2, "hidden": (3, 3), "points": 60, "validation_points": 20, "steps": 12}
    options |= {"optimizer": "gauss-newton", "reference_states": 4, "progress": False}
    compiled = train(system, 0.2, **options)
    monkeypatch.setattr(SympFlow, "tangents", lambda self: None)
    arrays = train(system, 0.2, **options)
    assert compiled.history[-1]["loss"] < compiled.history[0]["loss"] / 2
    assert compiled.history[-1]["loss"] == pytest.approx(arrays.history[-1]["loss"], rel=1e-6)
