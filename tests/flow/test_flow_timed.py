"""Networks of driven systems: SympFlows whose potentials take the time of the state, and their training."""

from math import pi

import numpy as np
import pytest
import torch

import sympflow
from sympflow import Box, HamiltonianSystem, SympFlow, solve
from sympflow.flow.sympflow import Drive

DT, W = 0.4, 2.7


def driven(H="p**2/2 - cos(q)*(1 + a*cos(w*t))", a=0.3, **more):
    given = {"params": {"a": a, "w": W}, "period": 2 * pi / W, "y0": [0.5, 0.1], "domain": Box([-1, -1], [1, 1])}
    return HamiltonianSystem.from_sympy(H, time="t", **given | more)


@pytest.fixture(scope="module")
def system():
    return driven()


@pytest.fixture(scope="module")
def trained(system):
    return sympflow.train(
        system, kind="sympflow", pairs=2, hidden=(8,), dt=DT, optimizer="gauss-newton", steps=40, points=150,
        matching_weight=0.1, label_weight=0.1, label_times=2, validation_points=100, reference_states=30,
        progress=False,
    )  # fmt: skip


def test_training_fits_it_at_all_times_of_the_drive(system, trained):
    assert (type(trained), trained.drive) == (SympFlow, Drive.of(system))
    start, end = trained.history[0], trained.figures
    assert end["one_step_error"] < start["one_step_error"] / 30
    assert end["residual_loss"] < start["residual_loss"] / 1000
    assert end["matching_loss"] < start["matching_loss"] / 100
    x = system.domain.sample(20, 7) / 2
    for t0 in (0.2, 1.0, 1.9):  # states and times that are in no fit
        truth = solve(system, "dop853", (t0, t0 + 1.2), x, rtol=1e-11, atol=1e-11).y[..., -1]
        still = np.abs(x - truth).max()
        assert np.abs(trained(1.2, torch.tensor(x), t0=t0).numpy() - truth).max() < still / 20
    moved = trained.transferred(driven(a=0.2))
    assert torch.equal(moved(1.2, torch.tensor(x), t0=0.2), trained(1.2, torch.tensor(x), t0=0.2))
    sol = solve(system, trained, (0.3, 8.3))
    assert sympflow.energy_balance_error(sol).max() < 0.05
    assert sympflow.symplecticity_defect(sol).max() < 1e-13


def test_networks_take_any_hamiltonian_and_drives_without_a_period():
    system = driven("p**2*(1 + q**2/4)/2 + q**2/2 + a*q*tanh(w*t)", period=None, t_span=(0, 4))
    flow = sympflow.train(
        system, pairs=2, hidden=(8,), dt=DT, optimizer="gauss-newton", steps=20, points=200, validation_points=60,
        reference_states=20, progress=False,
    )  # fmt: skip
    assert flow.drive == Drive(None, (0.0, 4.0))
    assert flow.figures["one_step_error"] < flow.history[0]["one_step_error"] / 5
    solve(system, flow, (0, 4))
    with pytest.warns(UserWarning, match="a drive without a period"):
        solve(system, flow, (0, 5))


X = torch.tensor([[0.5, 0.1], [-0.3, 0.8], [0.9, -0.6]], dtype=torch.float64)


@pytest.fixture(scope="module")
def hardly(system):
    """Trained for a few steps that compile nothing: it is a flow of this drive, and not a good one."""
    few = {"points": 20, "validation_points": 20, "reference_states": 5, "label_weight": 0.0, "progress": False}
    return sympflow.train(system, kind="sympflow", pairs=2, hidden=(8,), dt=DT, optimizer="adam", steps=3, **few)


def test_a_file_holds_it_with_its_drive(system, hardly, tmp_path):
    hardly.save(tmp_path / "flow.safetensors")
    again = sympflow.load(tmp_path / "flow.safetensors", system=system)
    torch.testing.assert_close(again(1.7, X, t0=0.3), hardly(1.7, X, t0=0.3), rtol=0, atol=0)
    assert (again.drive, again.period) == (hardly.drive, system.period)
    with pytest.raises(ValueError, match="was trained with another drive"):
        solve(driven(a=0.2), again, (0, 1))
    other = again.transferred(driven(a=0.2))
    torch.testing.assert_close(other(1.7, X, t0=0.3), hardly(1.7, X, t0=0.3), rtol=0, atol=0)
    solve(driven(a=0.2), other, (0, 1))
