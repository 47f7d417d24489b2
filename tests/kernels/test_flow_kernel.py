"""The compiled SympFlow against the torch one."""

import pickle

import numpy as np
import pytest
import torch

from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow

ROUNDING = 2e-14  # a few dozen operations on numbers up to 10


def states(n, ndof, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, 2 * ndof))


def step_errors(flow, h, Y):
    """Distance of each state of a run (n, ..., 2d) from torch's step from the one before."""
    with torch.no_grad():
        return np.abs(Y[1:] - flow(h, torch.as_tensor(Y[:-1])).numpy())


def lively(flow):
    """Weights half as large again as at first, so that the activations leave their linear range."""
    with torch.no_grad():
        for parameter in flow.parameters():
            parameter.mul_(1.5)
    return flow


@pytest.fixture(scope="module")
def flow():
    """The published architecture in units that are not 1."""
    scale = Scaling(q=(0.5, 2.0), p=(1.5, 0.7), t=0.8)
    return lively(SympFlow(2, pairs=3, hidden=(10, 10), dt=0.8, scale=scale))


@pytest.mark.parametrize("h", [0.8, 0.3, -0.8, -0.1])
def test_run_agrees_with_torch(flow, h):
    y0 = states(1, 2)[0]
    Y, n_finite, _ = flow.kernel_for(None).run(h, y0, 20, np.arange(21))
    assert n_finite == 20
    assert np.array_equal(Y[0], y0)
    assert step_errors(flow, h, Y).max() < ROUNDING
    sparse, *_ = flow.kernel_for(None).run(h, y0, 20, np.array([0, 3, 3, 20]))
    assert np.array_equal(sparse, Y[[0, 3, 3, 20]])


@pytest.mark.parametrize("n", [1, 5, 32, 100])
def test_batch_agrees_with_torch(flow, n):
    y0 = states(n, 2)
    Y, n_finite, _ = flow.kernel_for(None).run(0.8, y0, 5, np.arange(6), threads=2)
    assert (n_finite == 5).all()
    assert np.array_equal(Y[:, 0], y0)
    assert step_errors(flow, 0.8, Y.swapaxes(0, 1)).max() < ROUNDING


def test_each_state_can_have_its_own_time(flow):
    y = states(50, 2)
    h = np.random.default_rng(1).uniform(-0.8, 0.8, 50)
    with torch.no_grad():
        expected = flow(torch.as_tensor(h), torch.as_tensor(y)).numpy()
    assert np.abs(flow.kernel_for(None).step(h, y).states - expected).max() < ROUNDING
    assert np.array_equal(flow.kernel_for(None).step(0.0, y).states, y)
    assert np.abs(flow.kernel_for(None).step(-h, expected).states - y).max() < ROUNDING


def test_states_that_are_not_finite(flow):
    y0 = states(40, 2)
    y0[3], y0[7, 0], y0[8, 2] = np.nan, np.inf, 1e308
    kernel = pickle.loads(pickle.dumps(flow.kernel_for(None)))
    Y, n_finite, _ = kernel.run(0.8, y0, 4, np.arange(5))
    harmed = np.isin(np.arange(40), [3, 7])
    assert (n_finite[harmed] == 0).all()
    assert np.array_equal(Y[:, 0], y0, equal_nan=True)
    assert np.isnan(Y[harmed, 1:]).all()
    assert (n_finite[~harmed] == 4).all()
    fine = ~harmed & (np.arange(40) != 8)
    assert step_errors(flow, 0.8, Y[fine].swapaxes(0, 1)).max() < ROUNDING


def torch_steps(flow, h, y0, n_steps):
    """Every state of a run, by torch: (n_steps + 1, ..., 2d)."""
    y = [torch.as_tensor(y0)]
    with torch.no_grad():
        for _ in range(n_steps):
            y.append(flow(h, y[-1]))
    return torch.stack(y).numpy()


@pytest.mark.parametrize(("hidden", "activation"), [((4, 7, 3), "logcosh"), ((20, 18), "sin")])
def test_any_depth_and_widths(hidden, activation):
    flow = lively(SympFlow(2, pairs=1, hidden=hidden, activation=activation))
    y0 = states(3, 2)
    Y, *_ = flow.kernel_for(None).run(1.0, y0, 2, np.array([2]))
    assert np.abs(Y[:, 0] - torch_steps(flow, 1.0, y0, 2)[-1]).max() < ROUNDING
    single, *_ = flow.kernel_for(None).run(1.0, y0[0], 2, np.array([2]))
    assert np.array_equal(single[0], Y[0, 0])
    rows, *_ = flow.kernel_for(None).run(1.0, states(40, 2), 2, np.array([2]))
    assert np.array_equal(rows[:3, 0], Y[:, 0])  # features or trajectories in lanes


def test_layers_in_any_order():
    generator = torch.Generator().manual_seed(3)

    def potential(width):
        return MLPPotential(2, (width, width), generator=generator)

    flow = SympFlow.from_layers(
        [Drift(potential(6)), Kick(potential(10)), Kick(potential(3)), Drift(potential(6))], dt=1
    )
    y0 = states(1, 2)[0]
    Y, *_ = flow.kernel_for(None).run(-0.7, y0, 3, np.array([3]))
    assert np.abs(Y[0] - torch_steps(flow, -0.7, y0, 3)[-1]).max() < ROUNDING


def test_new_weights_are_noticed():
    flow = SympFlow(1, pairs=1)
    y = states(2, 1)
    before, kernel = flow.kernel_for(None).step(1.0, y).states, flow.kernel_for(None)
    assert flow.kernel_for(None) is kernel
    flow.layers[0].potential.weight_x.data.mul_(2)  # which leaves no trace in torch's version counter
    after = flow.kernel_for(None).step(1.0, y).states
    assert np.abs(after - before).max() > 1e-3
    flow.load_state_dict({k: 2 * v for k, v in flow.state_dict().items()}, assign=True)
    assert np.abs(flow.kernel_for(None).step(1.0, y).states - torch_steps(flow, 1.0, y, 1)[1]).max() < ROUNDING
