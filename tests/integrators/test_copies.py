"""Methods for any H on two copies of phase space."""

import pickle

import numpy as np
import pytest
import torch

import sympflow
from sympflow import systems

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

H = "(q**2 + 1)*(p**2 + 1)/2"


@pytest.fixture(scope="module")
def system():
    return systems.nonseparable()


def test_events_and_dense_output_are_of_the_mean_of_the_copies(system):
    sol = sympflow.solve(system, "tao6", (0, 5), dt=0.02, events=lambda t, y: y[0], dense_output=True)
    exact = sympflow.solve(system, "dop853", (0, 5), events=lambda t, y: y[0], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(sol.t_events[0], exact.t_events[0], atol=1e-7)
    assert sol.y_events[0].shape == (len(sol.t_events[0]), 2)
    assert np.abs(sol.y_events[0][:, 0]).max() < 1e-12
    np.testing.assert_allclose(sol.sol(sol.t), sol.y, rtol=0, atol=1e-14)


def test_lanes_of_vmap_run_as_they_do_alone_and_are_told_likewise(system):
    lanes = torch.tensor(system.y0) * torch.linspace(0.7, 1.3, 3, dtype=torch.float64)[:, None]

    def end(y, omega=4.0):
        return sympflow.solve(system, "tao4", (0, 1), y, dt=0.05, omega=omega).y[..., -1]

    torch.testing.assert_close(torch.vmap(end)(lanes), torch.stack([end(y) for y in lanes]), rtol=0, atol=1e-14)
    with pytest.warns(RuntimeWarning, match="^The two copies"):
        torch.vmap(lambda y: sympflow.solve(system, "tao2", (0, 10), y, dt=0.2, omega=0.5).y)(lanes[:2])


def test_a_run_goes_back_is_thinned_and_pickled(system):
    forward = sympflow.solve(system, "tao4", (0, 2), dt=0.05, dense_output=True)
    back = sympflow.solve(system, "tao4", (2, 0), forward.y[:, -1], dt=0.05)
    # the copies start anew at the end, where they were apart
    assert np.abs(back.y[:, -1] - system.y0).max() < 100 * forward.stats["copy_distance"]
    thin = sympflow.solve(system, "tao4", (0, 2), dt=0.05, save_every=8)
    np.testing.assert_array_equal(thin.y, forward.y[:, ::8])
    same = pickle.loads(pickle.dumps(forward))
    t = np.linspace(0, 2, 7)
    np.testing.assert_array_equal(same.sol(t), forward.sol(t))
    assert sympflow.symplecticity_defect(same) < 1e-13


@pytest.mark.slow
def test_a_run_is_symplectic_on_the_two_copies_and_keeps_the_energy(system):
    sol = sympflow.solve(system, "tao4", (0, 200), dt=0.05, t_eval=np.linspace(0, 200, 401))
    assert sympflow.symplecticity_defect(sol) < 1e-13
    assert abs(sympflow.volume_error(sol)) < 1e-10
    error = np.abs(sol.energy_error())
    assert error.max() < 1e-4
    assert error[200:].max() < 2 * error[:200].max()  # no drift
    assert sol.stats["copy_distance"] < 1e-2
