"""Our steps of driven systems, H(t, q, p), inside SciPy, torchdiffeq and torchode: they are told the time."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from sympflow import HamiltonianSystem, SympFlow, solve
from sympflow.interop import torchdiffeq as ours
from sympflow.interop.scipy import as_scipy

TEXT = "p**2/2*(1 + 0.2*sin(t)) - cos(q)*(1 + a*cos(w*t))"
DRIVEN = HamiltonianSystem.from_sympy(TEXT, time="t", params={"a": 0.3, "w": 1.7}, y0=[1, 0.2], dt=0.1)
OTHER = HamiltonianSystem.from_sympy(TEXT, time="t", params={"a": 0.3, "w": 1.9}, y0=[1, 0.2], dt=0.1)
Y = torch.tensor([1.0, 0.2], dtype=torch.float64)
SPANS = [(1.3, 3.05), (2.0, 0.17)]
CLOSE = {"rtol": 1e-13, "atol": 1e-13}


@pytest.mark.parametrize("t_span", SPANS)
def test_every_peer_makes_the_steps_of_solve(t_span):
    method = "kahan_li8"
    t = np.linspace(*t_span, 6)
    sol = solve(DRIVEN, method, t_span, t_eval=t, dense_output=True)
    scipy = solve_ivp(DRIVEN, t_span, Y.numpy(), method=as_scipy(method, DRIVEN), t_eval=t, dense_output=True)
    between = 0.7 * t[:-1] + 0.3 * t[1:]
    np.testing.assert_allclose(scipy.y, sol.y, **CLOSE)
    np.testing.assert_allclose(scipy.sol(between), sol.sol(between), **CLOSE)
    times = torch.tensor(t)
    np.testing.assert_allclose(ours.odeint(DRIVEN, Y, times, method=method).T, sol.y, **CLOSE)
    dense = ours.odeint_dense(DRIVEN, Y, times[0], times[-1], method=method)
    np.testing.assert_allclose(dense(torch.tensor(between)).T, sol.sol(between), **CLOSE)


def test_events_are_found_at_the_time():
    event = solve(DRIVEN, "kahan_li8", (0.3, 5), events=lambda t, y: y[0] - 0.1 * t).t_events[0][0]

    def g(t, y):
        return y[0] - 0.1 * t

    g.terminal = True
    arguments = {"method": as_scipy("kahan_li8", DRIVEN), "events": g}
    np.testing.assert_allclose(solve_ivp(DRIVEN, (0.3, 5), [1, 0.2], **arguments).t[-1], event, **CLOSE)
    t0 = torch.tensor(0.3, dtype=torch.float64)
    for make in (ours.odeint, ours.odeint_adjoint):
        found, _ = ours.odeint_event(DRIVEN, Y, t0, event_fn=g, method="kahan_li8", odeint_interface=make)
        np.testing.assert_allclose(found, event, **CLOSE)


def total(t, method):
    return float((solve(DRIVEN, method, (t[0], t[-1]), t_eval=t[1:], backend="array").y ** 2).sum())


@pytest.mark.parametrize("method", ["kahan_li8", "gauss_legendre6"])
@pytest.mark.parametrize("odeint", [ours.odeint, ours.odeint_adjoint])
def test_gradients_reach_all_times_the_first_too(odeint, method):
    t = torch.tensor([0.3, 1.04, 2.07], dtype=torch.float64, requires_grad=True)
    (odeint(DRIVEN, Y.clone().requires_grad_(True), t, method=method)[1:] ** 2).sum().backward()
    for i in range(3):
        step = 1e-5 * np.eye(3)[i]
        central = (total(t.detach().numpy() + step, method) - total(t.detach().numpy() - step, method)) / 2e-5
        assert float(t.grad[i]) == pytest.approx(central, rel=1e-8)


def as_function(system):
    return lambda t, y: 1 * system(t, y)


def test_a_flow_of_a_driven_system_is_told_the_time():
    system = HamiltonianSystem.from_sympy(
        "p**2/2 - cos(q)*(1 + a*cos(w*t))", time="t", params={"a": 0.3, "w": 1.7}, period=2 * np.pi / 1.7, y0=[1, 0.2]
    )
    flow = SympFlow.primed(system, 2, processor=3, dt=0.8)
    times = np.array([2.9, 1.75, 1.35])
    expected = solve(system, flow, (2.9, 1.35), t_eval=times).y
    scipy = solve_ivp(system, (2.9, 1.35), [1, 0.2], method=as_scipy(flow), t_eval=times)
    np.testing.assert_allclose(scipy.y, expected, **CLOSE)
    t, gradients = torch.tensor(times, requires_grad=True), []
    for ask in (ours.odeint, ours.odeint_adjoint):
        y = ask(system, Y, t, method=flow)
        np.testing.assert_allclose(y.detach().T, expected, **CLOSE)
        gradients += torch.autograd.grad(y[1:].square().sum(), t)
    ends = [solve(system, flow, (s, 1.35), t_eval=times[1:]).y for s in (2.9 + 1e-5, 2.9 - 1e-5)]
    slope = ((ends[0] ** 2).sum() - (ends[1] ** 2).sum()) / 2e-5
    np.testing.assert_allclose([float(g[0]) for g in gradients], slope, rtol=1e-8)


def test_another_drive_is_refused_whoever_asks():
    arguments = {"method": as_scipy("verlet", DRIVEN)}
    for fun in (OTHER, as_function(OTHER)):
        with pytest.raises(ValueError, match="`fun` is not the system that method 'verlet' solves"):
            solve_ivp(fun, (0, 3), [1, 0.2], **arguments)
    assert solve_ivp(as_function(DRIVEN), (0, 3), [1, 0.2], **arguments).success
    t = torch.tensor([0.0, 3.0], dtype=torch.float64)
    with pytest.raises(ValueError, match="`func` is not the system that method 'verlet' solves"):
        ours.odeint(as_function(OTHER), Y, t, method="verlet", options={"system": DRIVEN})


SAMPLED = HamiltonianSystem.from_sympy(
    "p**2/2 - a*cos(q)", time="t", params={"a": CubicSpline([0, 1, 2, 3], [1, 2, 1, 3])}, y0=[1, 0.2], dt=0.1
)


def test_torchode_has_a_time_for_each_sample():
    torchode = pytest.importorskip("torchode", reason="torchode is an optional peer: pip install torchode")
    from sympflow.interop.torchode import register

    register("driven_verlet", DRIVEN, "verlet")
    t = torch.tensor([[0.0, 0.55, 2.0], [1.0, 1.3, 3.21]], dtype=torch.float64)
    arguments = {"method": "driven_verlet", "controller": torchode.FixedStepController()}
    dt0 = torch.full((2,), 0.1, dtype=torch.float64)
    found = torchode.solve_ivp(DRIVEN, Y.expand(2, 2), t, dt0=dt0, **arguments).ys
    for states, times in zip(found, t.numpy(), strict=True):
        sol = solve(DRIVEN, "verlet", (times[0], times[-1]), t_eval=times)
        np.testing.assert_allclose(states.T, sol.y, **CLOSE)
    register("sampled_verlet", SAMPLED, "verlet")
    with pytest.raises(ValueError, match="leaves the samples"):
        torchode.solve_ivp(SAMPLED, Y[None], t[1:], dt0=dt0[1:], **{**arguments, "method": "sampled_verlet"})
