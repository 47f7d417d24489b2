"""Primed flows of driven systems: fitted with their drive, exactly symplectic, refused for any other."""

import pickle
import warnings
from math import pi

import numpy as np
import pytest
import torch

import sympflow
from sympflow import Box, HamiltonianSystem, SympFlow, solve

DT, T0, W = 0.4, 1.3, 2.7


def driven(a=0.1, w=W, **more):
    return HamiltonianSystem.from_sympy(
        "p**2/2 - cos(q)*(1 + a*cos(w*t))",
        **{
            "name": "driven_pendulum",
            "time": "t",
            "params": {"a": a, "w": w},
            "period": 2 * pi / w,
            "y0": [0.5, 0.1],
            "domain": Box([-1, -1], [1, 1]),
        }
        | more,
    )


@pytest.fixture(scope="module")
def system():
    return driven()


@pytest.fixture(scope="module")
def flow(system):
    start = SympFlow.primed(system, 2, processor=2, dt=DT)
    return sympflow.train(
        system, flow=start, restarts=4, steps=40, points=60, label_times=3, reference_states=20, progress=False
    )


def states(system, n=4):
    return system.domain.sample(n, seed=1)


def test_a_flow_is_fitted_at_all_times_of_the_drive(system, flow):
    x, span = states(system, 10), (T0, T0 + 8.0)
    truth = solve(system, "dop853", span, x, t_eval=span[1:], rtol=1e-12, atol=1e-12).y
    error, start, scheme = (
        np.abs(solve(system, each, span, x, t_eval=span[1:], **more).y - truth).max()
        for each, more in (
            (flow, {}),
            (SympFlow.primed(system, 2, dt=DT), {}),
            ("chin4c", {"dt": DT}),  # three forces and a force gradient a step
        )
    )
    assert error < min(start / 100, scheme / 2)
    assert flow.figures["one_step_error"] < 1e-5
    assert flow.shape.timed


def test_it_is_symplectic_and_goes_back_and_keeps_the_energy_balance(system, flow):
    sol = solve(system, flow, (T0, T0 + 400.0), t_eval=np.linspace(T0, T0 + 400.0, 100))
    assert sol.stats["backend"] == "compiled"
    assert sympflow.symplecticity_defect(solve(system, flow, (T0, T0 + 8.0))).max() < 1e-13
    balance = sympflow.energy_balance_error(sol)
    assert balance.max() < 1e-5
    assert balance[50:].max() < 3 * balance[:50].max()
    back = solve(system, flow, (T0 + 8.0, T0), solve(system, flow, (T0, T0 + 8.0)).y[:, -1])
    np.testing.assert_allclose(back.y[:, -1], system.y0, atol=1e-13)


def test_a_file_knows_the_drive(system, flow, tmp_path):
    flow.save(tmp_path / "flow.safetensors")
    again = sympflow.load(tmp_path / "flow.safetensors", system=system)
    x = torch.tensor(states(system))
    assert torch.equal(again(2.0, x, T0), flow(2.0, x, T0))
    for other in (driven(a=0.11), driven(w=2.8)):
        with pytest.raises(ValueError, match=r"with another drive or none, .* its amplitude, its frequency"):
            sympflow.load(tmp_path / "flow.safetensors", system=other)


def test_runs_beyond_the_times_of_a_drive_without_a_period_warn(tmp_path):
    text = "p**2/2 - cos(q)*(1 + exp(-(t - 2)**2)/2)"
    once = HamiltonianSystem.from_sympy(text, time="t", y0=[0.5, 0.1], t_span=(0, 5), domain=Box([-1, -1], [1, 1]))
    few = {"restarts": 1, "steps": 3, "points": 10, "label_times": 1, "reference_states": 5, "progress": False}
    made = sympflow.train(once, flow=SympFlow.primed(once, 2, dt=DT), **few)
    made.save(tmp_path / "flow.safetensors")
    loaded = sympflow.load(tmp_path / "flow.safetensors", system=once)
    x = torch.tensor(states(once))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solve(once, made, (5, 0))
        made(2.0, x, torch.tensor([0.0, 1.0, 2.0, 3.0]))
    for flow in (made, loaded, pickle.loads(pickle.dumps(made))):
        assert flow.drive_times == (0.0, 5.0)
        for use in (
            lambda flow=flow: solve(once, flow, (4, 6)),
            lambda flow=flow: solve(once, flow, (0, -1), backend="array"),
            lambda flow=flow: flow(2.0, x, t0=4.0),
            lambda flow=flow: flow.inverse(2.0, x, t0=-1.0),
        ):
            with pytest.warns(UserWarning, match=r"for t from 0 to 5, its system's `t_span`, and the run leaves"):
                use()


def test_deviations_and_multipliers_by_a_trained_flow(system, flow):
    """The Jacobians of all steps are made together, each at its own time."""
    y0 = [0.7, 0.2]
    ours, scheme = (
        sympflow.lyapunov(system, method, (T0, T0 + 40.0), y0, deviations=[1.0, 0.0], **more).value
        for method, more in ((flow, {}), ("kahan_li8", {"dt": DT / 4}))
    )
    assert ours == pytest.approx(scheme, abs=1e-4)
    found = sympflow.floquet_multipliers(system, np.zeros(2), method=flow)
    truth = sympflow.floquet_multipliers(system, np.zeros(2))
    np.testing.assert_allclose(found.multipliers, truth.multipliers, atol=1e-4)


@pytest.fixture(scope="module")
def plain():
    return HamiltonianSystem.from_sympy("p**2/2 - cos(q)", y0=[0.5, 0.1], domain=Box([-1, -1], [1, 1]))


def test_a_drive_given_by_samples_is_fitted(plain):
    from scipy.interpolate import CubicSpline

    t = np.linspace(0, 10, 200)
    system = HamiltonianSystem.from_sympy(
        "p**2/2 - cos(q)*(1 + a)",
        params={"a": CubicSpline(t, 0.1 * np.cos(W * t))},
        t_span=(0, 10),
        domain=plain.domain,
    )
    start = SympFlow.primed(system, 2, dt=DT)
    options = {"restarts": 1, "steps": 10, "points": 20, "label_times": 2, "reference_states": 5, "progress": False}
    flow = sympflow.train(system, flow=start, **options)
    assert flow.figures["one_step_error"] < 1e-4
    with pytest.raises(ValueError, match=r"^`system` .* no step of dt = 20 begins and ends: give it the period"):
        sympflow.train(system, flow=SympFlow.primed(system, 2, dt=20.0), **options)


def test_its_hamiltonian_is_near_that_of_the_system(system, flow):
    """Up to a function of t, at all times of a step."""
    y = states(system)
    for t in (0.1, 0.25, DT):
        H = flow.hamiltonian(t, torch.tensor(y), T0).detach().numpy() - system.hamiltonian(y, T0 + t)
        assert np.ptp(H) < 1e-2 * np.ptp(system.hamiltonian(y, T0 + t))


def test_many_outputs_are_those_of_single_ones(system, flow):
    """χ of 300 outputs, more than are made at once and no multiple of those in a vector, each at its own time."""
    x, span = states(system, 3), (T0, T0 + 299 * DT)
    one, rows, arrays = (
        solve(system, flow, span, y0, **more).y for y0, more in ((x[0], {}), (x, {}), (x, {"backend": "array"}))
    )
    assert one.shape == (2, 300)
    np.testing.assert_allclose(rows[0], one, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows, arrays, rtol=0, atol=1e-12)
