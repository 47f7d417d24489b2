"""torchdiffeq's solvers behind `solve`: the same numbers as torchdiffeq, and the contract of every method."""

import re

import numpy as np
import pytest
import torch
from torchdiffeq import odeint

from sympflow import HamiltonianSystem, get, solve, systems, volume_error
from sympflow.integrators.tableaux import ADAPTIVE, FIXED

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
MULTISTEP = ["explicit_adams", "implicit_adams"]
EPS = np.finfo(float).eps


@pytest.mark.parametrize("method", FIXED)
def test_fixed_methods_are_torchdiffeqs(method):
    times = torch.arange(0.0, 1.01, 0.125, dtype=torch.float64)
    theirs = odeint(HH, torch.tensor(HH.y0), times, method=method)
    sol = solve(HH, method, (0.0, 1.0), dt=0.125)
    np.testing.assert_allclose(sol.y.T, theirs.numpy(), atol=16 * EPS)
    y = HH.y0
    for _ in range(8):
        y = get(method)().step(HH, 0.0, y, 0.125)
    np.testing.assert_allclose(sol.y[:, -1], y, atol=16 * EPS)
    assert abs(volume_error(sol)) > 1e-12  # the Runge–Kutta methods are not symplectic, and the metric sees it


@pytest.mark.parametrize("t_end", [3.0, -3.0])
def test_the_interpolation_of_dopri5_is_torchdiffeqs(t_end):
    """Between the steps, which are long here, to rounding: at output times, and by the dense output."""
    method, times = "dopri5", np.linspace(0, t_end, 20)
    loose = {"rtol": 1e-3, "atol": 1e-5}
    theirs = odeint(HH, torch.tensor(HH.y0), torch.as_tensor(times), method=method, **loose).numpy().T
    sol = solve(HH, method, (0, t_end), t_eval=times, dense_output=True, **loose)
    np.testing.assert_allclose(sol.y, theirs, rtol=0, atol=256 * EPS)
    np.testing.assert_allclose(sol.sol(times), theirs, rtol=0, atol=256 * EPS)
    np.testing.assert_allclose(sol.sol(times[7]), theirs[:, 7], rtol=0, atol=256 * EPS)
    batch = solve(HH, method, (0, t_end), np.stack([HH.y0, HH.y0]), dense_output=True, **loose)
    np.testing.assert_allclose(batch.sol(times), [theirs, theirs], rtol=0, atol=256 * EPS)
    assert batch.sol(times[3]).shape == (2, 4)
    with pytest.raises(ValueError, match=r"^`t` must lie in"):
        sol.sol(1.1 * t_end)


@pytest.mark.parametrize(
    ("method", "rtol"), [("bosh3", 1e-3), ("fehlberg2", 1e-4), ("adaptive_heun", 1e-2), ("dopri8", 1e-6)]
)
def test_states_between_long_steps_are_as_exact_as_those_at_their_ends(method, rtol):
    """torchdiffeq's own interpolation is twice as far off between those of "bosh3", and 200 times of "dopri8"."""
    times = np.linspace(0, 10, 501)
    oscillator = HamiltonianSystem.from_sympy("p**2/2 + q**2/2")
    sol = solve(oscillator, method, (0, 10), [1.0, 0.0], t_eval=times, dense_output=True, rtol=rtol, atol=rtol / 100)

    def error(t):
        return np.abs(sol.sol(t) - [np.cos(t), -np.sin(t)]).max()

    ends = np.array([step.t1 for step in sol.sol.steps[:-1]])
    assert len(ends) < 250
    assert error(times) < 1.1 * error(ends)
    np.testing.assert_array_equal(sol.y, sol.sol(times))


@pytest.mark.parametrize("method", ADAPTIVE)
def test_one_step_of_the_tableau_is_torchdiffeqs(method):
    """Against an accepted first step of prescribed length."""
    h, loose = 0.3, {"rtol": 1e3, "atol": 1e3}
    t = torch.tensor([0.0, h], dtype=torch.float64)
    theirs = odeint(HH, torch.tensor(HH.y0), t, method=method, options={"first_step": h}, **loose)[-1]
    np.testing.assert_allclose(get(method)().step(HH, 0.0, HH.y0, h), theirs.numpy(), atol=64 * EPS)


@pytest.mark.parametrize("method", MULTISTEP)
def test_multistep_methods_are_torchdiffeqs_and_have_no_step(method):
    options, ends = {"step_size": 0.02, "max_order": 4}, torch.tensor([0.0, 1.0], dtype=torch.float64)
    theirs = odeint(HH, torch.tensor(HH.y0), ends, method=method, options=options)
    np.testing.assert_allclose(solve(HH, method, (0, 1), dt=0.02).y[:, -1], theirs[-1].numpy(), atol=1e-9)
    with pytest.raises(TypeError, match=r"^`method` .* cannot be stepped by itself"):
        get(method)().step(HH, 0.0, HH.y0, 0.1)


def test_a_batch_of_which_one_fails_keeps_the_dense_output_of_the_others():
    y0 = np.array([HH.y0, [0, 0, 0, 0.7]])
    sol = solve(HH, "dopri5", (0, 8), y0, t_eval=[4.0, 7.0], rtol=1e-4, dense_output=True)
    assert sol.status.tolist() == [0, -1]
    assert "Trajectory 1: torchdiffeq stopped after t = 5.4" in sol.message
    np.testing.assert_allclose(sol.sol(4.0), sol.y[..., 0], atol=64 * EPS)
    assert np.isnan(sol.y[1, :, 1]).all()


def test_methods_that_carry_a_slope_have_no_volume_to_measure():
    with pytest.raises(TypeError, match="not a one-step map"):
        volume_error(solve(HH, "adaptive_heun", (0, 1), rtol=1e-3, atol=1e-3))


def test_gradients_flow_through_the_dense_output():
    y0 = torch.tensor([1.0, 0.2], dtype=torch.float64)
    for method in ("dopri5", "explicit_adams"):

        def state(y, method=method):
            return solve(PENDULUM, method, (0, 2), y, dense_output=True).sol(1.234)

        exact = torch.autograd.functional.jacobian(
            lambda y: solve(PENDULUM, "kahan_li8", (0, 2), y, t_eval=[1.234]).y[:, 0], y0
        )
        torch.testing.assert_close(torch.autograd.functional.jacobian(state, y0), exact, atol=1e-3, rtol=0)


@pytest.mark.parametrize("y0", [HH.y0, np.stack([HH.y0, 0.5 * HH.y0])], ids=["single", "batch"])
def test_a_run_of_too_many_steps_ends_with_what_it_has(y0):
    t = np.linspace(0, 6, 41)
    sol = solve(HH, "bosh3", (0, 6), y0, t_eval=t, max_num_steps=100, dense_output=True)
    assert np.all(sol.status == -1)
    assert re.match(
        r"After `max_num_steps` = 100 steps t = [\d.]+ is reached, and at this pace the end needs about [\de+.]+ "
        r"more\. Raise `max_num_steps` or the tolerances, or end `t_span` earlier\.",
        sol.message,
    )
    whole = solve(HH, "bosh3", (0, 6), y0, t_eval=t, max_num_steps=5000)
    reached = np.max(sol.stats["failed_at"])
    done = np.count_nonzero(t <= reached)
    assert 1 < done < len(t)
    np.testing.assert_array_equal(sol.y[..., :done], whole.y[..., :done])
    assert np.isnan(sol.y[..., done:]).all()
    assert sol.y.shape[-1] == (done if y0.ndim == 1 else len(t))
    np.testing.assert_allclose(sol.sol(t[done - 1]), whole.y[..., done - 1], rtol=0, atol=256 * EPS)
    with pytest.raises(ValueError, match=r"^`max_num_steps` must be a positive integer"):
        get("bosh3")(max_num_steps=True)
