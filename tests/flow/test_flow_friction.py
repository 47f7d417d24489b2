"""Primed flows of damped systems: fitted with their friction, conformally symplectic, refused for any other."""

import numpy as np
import pytest
import torch

import sympflow
from sympflow import SympFlow, solve
from sympflow.systems import damped_pendulum, pendulum

DT = 0.8


@pytest.fixture(scope="module")
def system():
    return damped_pendulum(0.3)


@pytest.fixture(scope="module")
def conservative():
    """The flow that ships for the system without friction, with this Δt."""
    return next(f for f in sympflow.shipped_flows(pendulum()) if f.name == "pendulum-primed-3-0.8").load(pendulum())


@pytest.fixture(scope="module")
def flow(system):
    start = SympFlow.primed(system, 2, processor=3, dt=DT)
    return sympflow.train(
        system, flow=start, restarts=3, steps=40, points=60, label_times=3, reference_states=20, progress=False
    )


def end(system, method, x, **options):
    return solve(system, method, (0, 8.0), x, t_eval=[8.0], **options).y[..., -1]


@pytest.mark.slow
def test_a_flow_is_fitted_to_the_damped_system(system, flow, conservative):
    x = system.domain.sample(10, seed=1)
    truth = end(system, "dop853", x, rtol=1e-12, atol=1e-12)
    error, start, taken = (
        np.abs(end(system, each, x) - truth).max()
        for each in (flow, SympFlow.primed(system, 2, dt=DT), conservative.transferred(system))
    )
    assert error < start / 30
    assert taken > 20 * np.abs(end(pendulum(), conservative, x) - end(pendulum(), "kahan_li8", x, dt=0.1)).max()


def test_a_file_knows_the_friction(system, flow, tmp_path):
    flow.save(tmp_path / "flow.safetensors")
    again = sympflow.load(tmp_path / "flow.safetensors", system=system)
    x = torch.tensor(system.domain.sample(3, seed=0))
    assert torch.equal(again(2.0, x), flow(2.0, x))
    for other in (damped_pendulum(0.31), pendulum()):
        with pytest.raises(ValueError, match="is not the one that this flow was trained for"):
            sympflow.load(tmp_path / "flow.safetensors", system=other)
