"""Our methods inside torchode: per-sample times, the numbers of `solve`, gradients."""

import numpy as np
import pytest
import torch
from conftest import KINDS

torchode = pytest.importorskip("torchode", reason="torchode is an optional peer: pip install torchode")

from sympflow import SympFlow, get, solve, systems  # noqa: E402
from sympflow.integrators.base import FixedStep  # noqa: E402
from sympflow.interop.torchode import register, step_method  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long for method .euler.:RuntimeWarning")

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
EPS = np.finfo(float).eps


def run(method, y0, t_eval, dt, **arguments):
    return torchode.solve_ivp(
        HH if y0.shape[1] == 4 else PENDULUM,
        y0,
        t_eval,
        method=method,
        controller=torchode.FixedStepController(),
        dt0=torch.as_tensor(dt, dtype=torch.float64).expand(len(y0)),
        **arguments,
    )


CLASSICAL = [name for name in KINDS if issubclass(get(name), FixedStep) and get(name).on_grid and not get(name).trained]


@pytest.mark.parametrize(("name", "dt"), [*((name, 0.1) for name in CLASSICAL), ("kahan_li8", 0.25), ("sympflow", 1.0)])
def test_each_sample_has_its_own_times(name, dt):
    register(name, HH)
    y0 = torch.tensor(HH.domain.sample(3, 0))
    t_eval = torch.tensor([[0.0, 0.55, 2.0], [1.0, 1.3, 4.21], [-0.5, 0.0, 0.25]], dtype=torch.float64)
    sol = run(name, y0, t_eval, dt)
    assert (sol.status == 0).all()
    for i, t in enumerate(t_eval.numpy()):
        ours = solve(HH, name, (t[0], t[-1]), y0=y0[i].numpy(), t_eval=t, on_domain_exit="ignore", dt=dt)
        np.testing.assert_allclose(sol.ys[i].numpy(), ours.y.T, atol=200 * EPS)


def test_a_step_away_from_the_end_is_refused():
    register("verlet", HH)
    y0 = torch.tensor(HH.domain.sample(2, 0))
    t_eval = torch.tensor([[0.0, 0.5], [0.0, -0.5]], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"^`dt0` must have the sign of the direction"):
        run("verlet", y0, t_eval, 0.1)
    sol = run("verlet", y0, t_eval, [0.1, -0.1])
    ours = solve(HH, "verlet", (0.0, -0.5), y0=y0[1].numpy(), t_eval=[-0.5], dt=0.1)
    np.testing.assert_allclose(sol.ys[1, -1].numpy(), ours.y[:, -1], atol=200 * EPS)


def pendulum(t, y):
    return torch.stack([y[:, 1], -torch.sin(y[:, 0])], -1)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (systems.harmonic_oscillator(), "is not the system that method 'verlet' solves: their Hamiltonians differ"),
        (lambda t, y: torch.stack([y[:, 1], -y[:, 0]], -1), "is not the system that method 'verlet' solves: at t = "),
        (lambda t, y: pendulum(t, y) * (1 + 0.01 * torch.sin(t))[:, None], "depends on the time"),
        (lambda t, y: pendulum(t, y) * (1 + (t > 19.7))[:, None], "depends on the time"),
        (lambda t, y: pendulum(t, y) * (1 + (y[:, :1] > 2.4)), "is not the system that method 'verlet' solves: at t"),
    ],
)
def test_a_term_that_is_another_system_is_refused(term, message):
    """It agrees at the start: there q = 0 and t = 0."""
    y0 = torch.tensor([[0.0, 1.9], [0.0, 1.8]], dtype=torch.float64)
    t_eval = torch.tensor([[0.0, 20.0], [0.0, 13.0]], dtype=torch.float64)
    arguments = {
        "method": step_method("verlet", PENDULUM),
        "controller": torchode.FixedStepController(),
        "dt0": torch.full((2,), 0.1, dtype=torch.float64),
    }
    with pytest.raises(ValueError, match=rf"^`term` {message}"):
        torchode.solve_ivp(term, y0, t_eval, **arguments)
    for same in (pendulum, systems.pendulum(), PENDULUM):
        assert (torchode.solve_ivp(same, y0, t_eval[:, [0]] + t_eval / 10, **arguments).status == 0).all()


def test_bad_arguments_are_named():
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem"):
        register("verlet", lambda t, y: y)
    with pytest.raises(TypeError, match=r"^`dt` is not an option here"):
        step_method("verlet", HH, dt=0.1)
    with pytest.raises(TypeError, match=r"^`method` 'dopri5' is not a fixed-step map"):
        step_method("dopri5", HH)
    with pytest.raises(ValueError, match=r"^`system` .* degrees of freedom"):
        step_method(SympFlow(1), HH)
    flow = get("sympflow")().flow_for(HH)
    y0, t_eval = torch.tensor(HH.y0)[None], torch.tensor([0.0, 3.0], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"^`dt0` must be at most the flow's Δt = 1"):
        run(step_method(flow, HH), y0, t_eval, 2.0)
    with pytest.raises(ValueError, match=r"^`y0` must have shape \(batch, 4\)"):
        run(step_method("verlet", HH), y0[:, :2], t_eval, 0.1)


def test_backward_time():
    register("verlet", HH)
    y0 = torch.tensor(HH.domain.sample(2, 0))
    sol = run("verlet", y0, torch.tensor([[2.0, 1.0, 0.05], [0.0, -0.3, -1.0]], dtype=torch.float64), -0.1)
    ours = solve(HH, "verlet", (2.0, 0.05), y0=y0[0].numpy(), t_eval=[2.0, 1.0, 0.05], dt=0.1)
    np.testing.assert_allclose(sol.ys[0].numpy(), ours.y.T, atol=200 * EPS)


def test_gradients_to_y0_t_and_weights():
    flow = SympFlow(1, hidden=(2,), dt=0.5)
    y0 = torch.tensor([[1.0, 0.2], [0.3, -0.4]], dtype=torch.float64, requires_grad=True)
    t = torch.tensor([[0.0, 0.3, 0.83], [0.1, 0.45, 1.33]], dtype=torch.float64, requires_grad=True)
    for method in (step_method("verlet", PENDULUM), step_method(flow, PENDULUM)):
        weights = tuple(method.parameters())
        assert bool(weights) == (method.flow is not None)

        def states(y, t, *w, method=method):
            return run(method, y, t, 0.4).ys

        assert torch.autograd.gradcheck(states, (y0, t, *weights))
