"""SympFlows with neural potentials that are fitted to trajectories themselves."""

import warnings

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import sympflow
from sympflow.flow.scaling import Scaling
from sympflow.learning.learner import learn
from sympflow.learning.maps import NetworkFlow
from sympflow.learning.orbits import Method

DT = 0.8


@pytest.mark.parametrize("palindromic", [False, True])
def test_the_map_is_the_flow_and_its_derivatives_are_right(palindromic):
    random = np.random.default_rng(0)
    model = NetworkFlow(Scaling((1.0, 2.0), (2.0, 1.0), DT), 1, 3, palindromic)
    theta, x, t = model.start(random), random.normal(size=(4, 5)), np.array([0.1, DT, 0.0, 0.3, 0.5])
    X = np.zeros((4, 4 + model.n, 5))
    X[np.arange(4), np.arange(4)] = 1.0
    end, slopes = model.psi(theta, t, x, X)
    flow = model.flow(theta)
    truth = np.stack([flow.psi(float(s), torch.tensor(state)).numpy() for s, state in zip(t, x.T, strict=True)], 1)
    assert np.abs(end - truth).max() < 1e-14
    step = 1e-6
    for k in range(4 + model.n):
        e, f = np.zeros(4 + model.n), step
        e[k] = f
        ends = [model.psi(theta + s * e[4:], t, x + s * e[:4, None], None)[0] for s in (1, -1)]
        assert np.abs((ends[0] - ends[1]) / (2 * step) - slopes[:, k]).max() < 1e-8
    back = np.stack([flow.psi(float(-s), torch.tensor(state)).numpy() for s, state in zip(t, end.T, strict=True)], 1)
    assert (np.abs(back - x).max() < 1e-13) == palindromic  # by formula, not by the inverse


def test_orbits_are_those_of_the_flow():
    model = NetworkFlow(Scaling((1.0,), (1.0,), DT), 1, 3, False)
    theta = model.start(np.random.default_rng(1))
    times = np.array([[0.0, 0.0], [0.3, DT], [1.0, 2 * DT], [3.1, 2 * DT + 0.1]])
    gaps, x = np.diff(times, axis=0, prepend=0.0), np.array([[0.5, -1.0], [0.2, 0.7]])
    orbit = Method(model.stepper, DT).orbit(model, theta, x.copy(), None, gaps, np.zeros(2))
    flow = model.flow(theta)
    for at, (state, _) in zip(times, orbit, strict=True):
        for i in range(2):
            assert state[:, i] == pytest.approx(flow(float(at[i]), torch.tensor(x[:, i])).numpy(), abs=1e-13)


@pytest.fixture(scope="module")
def learned():
    """Trajectories of H = ½p²(1 + q²/2) + ½q² + q⁴/8, which is not separable, and flows that are learned from them."""
    random, t = np.random.default_rng(0), np.linspace(0, 2.4, 13)
    data = []
    for _ in range(24):
        y0 = random.uniform(-0.8, 0.8, 2)
        y = solve_ivp(
            lambda t, y: [y[1] * (1 + 0.5 * y[0] ** 2), -y[0] - 0.5 * y[0] * y[1] ** 2 - 0.5 * y[0] ** 3],
            (0, 2.4), y0, t_eval=t, rtol=1e-10, atol=1e-12,
        ).y  # fmt: skip
        data.append((t, y + 0.02 * random.normal(size=y.shape)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of residuals that are not quite noise
        return data, learn(data, dt=DT, family="sympflow", replicas=2)


def test_a_flow_is_fitted_to_data_without_an_h(learned, tmp_path):
    data, flow = learned
    assert isinstance(flow, sympflow.SympFlow)
    assert flow.figures["held_out_error_1"] < 0.04  # noise included
    assert flow.history[0]["model"].startswith("SympFlow of 2 pairs")
    y0 = data[0][1][:, 0]
    sol = sympflow.solve(flow.system, flow, (0, 2.4), y0, t_eval=data[0][0])
    assert np.abs(sol.y - data[0][1]).max() < 0.1
    low, high = flow.replicas.bands(y0, data[0][0])
    assert np.abs((low + high) / 2 - sol.y).max() < 0.1
    path = tmp_path / "flow.safetensors"
    flow.save(path)
    again = sympflow.load(path)
    assert np.array_equal(sympflow.solve(again.system, again, (0, 2.4), y0, t_eval=data[0][0]).y, sol.y)
    H = [system.hamiltonian(y0) for system in (flow.system, again.system)]
    assert H[0] == H[1]


def test_flows_take_nothing_that_is_known_of_h(learned):
    with pytest.raises(ValueError, match="does not apply"):
        learn(learned[0], family="sympflow", damping=True)
    with pytest.raises(ValueError, match="leave out `separable` or `family`"):
        learn(learned[0], family="sympflow", separable=True)


def test_the_system_of_a_flow_has_the_mean_of_its_own_hamiltonian(learned):
    _, flow = learned
    x = torch.tensor([[0.3, -0.2], [0.1, 0.6]], dtype=torch.float64)
    nodes, weights = np.polynomial.legendre.leggauss(2)
    mean = sum(w / 2 * flow.hamiltonian(DT * (1 + u) / 2, x) for u, w in zip(nodes, weights, strict=True))
    assert flow.system.hamiltonian(x.numpy()) == pytest.approx(mean.numpy(), rel=1e-13)
    e, step = np.array([[1.0, 0.0]]), 1e-5
    slope = (flow.system.hamiltonian(x.numpy() + step * e) - flow.system.hamiltonian(x.numpy() - step * e)) / (2 * step)
    assert flow.system.gradient(x.numpy())[:, 0] == pytest.approx(slope, rel=1e-5)
