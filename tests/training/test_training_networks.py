"""Gauss–Newton training of networks: residuals, Jacobians, the search, labels and data, and what train() chooses."""

import math

import numpy as np
import pytest
import torch

from sympflow import Box, HamiltonianSystem, MLPFlow, SympFlow, load, solve, systems, train
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.training.least_squares import PULL, GaussNewtonSteps
from sympflow.training.losses import Loss, Objective, jacobian
from sympflow.training.points import Labels, PointSource, unlabelled

HH, OSCILLATOR, PENDULUM = systems.henon_heiles(), systems.harmonic_oscillator(), systems.pendulum()
QUICK = {
    "kind": "sympflow",
    "pairs": 1,
    "hidden": (5,),
    "points": 200,
    "validation_points": 60,
    "reference_states": 5,
    "progress": False,
}
CPU = torch.device("cpu")
FLOWS = {
    "sympflow": lambda: SympFlow(2, hidden=(4, 3), seed=1),
    "mlp": lambda: MLPFlow(2, (5, 4), seed=1),
    "primed": lambda: SympFlow.primed(HH, 2),
}


def labels(n=4):
    x = HH.domain.sample(n, 5)
    made = Labels.of(HH, x, np.array([0.4, 1.0]))
    return np.repeat(made.t, n), np.concatenate([x, x]), made.y.reshape(2 * n, 4)


def objective(flow, weights, points=30):
    source = PointSource(HH.domain, 1.0, points, 5, 0, torch.float64, CPU, block=1, labels=labels())
    return Objective(Loss(HH, Scaling((0.3, 0.4), (0.5, 0.6), 0.7), *weights), flow, source(0))


# residuals and their Jacobian -------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [(1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 0.5), (1.0, 2.0, 3.0)])
@pytest.mark.parametrize("name", FLOWS)
def test_the_loss_is_the_sum_of_squares(name, weights):
    if name == "mlp" and weights[1]:
        weights = (weights[0], 0.0, 1.0)
    flow = FLOWS[name]()
    target = objective(flow, weights)
    value = target()
    r, J = target.linearized()
    assert float(r @ r) == pytest.approx(value.item(), rel=1e-13)
    torch.testing.assert_close(target.residuals(), r, rtol=1e-12, atol=1e-14)
    gradient = torch.cat([g.reshape(-1) for g in torch.autograd.grad(value, list(flow.parameters()))])
    torch.testing.assert_close(2 * J.T @ r, gradient, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("weights", [(1.0, 0.0, 0.0), (1.0, 2.0, 3.0)])
def test_the_jacobian_by_differences(weights):
    flow = FLOWS["sympflow"]().requires_grad_(False)
    target = objective(flow, weights)
    J = target.linearized()[1]
    e = 1e-6
    start = torch.nn.utils.parameters_to_vector(flow.parameters())
    direction = torch.tensor(np.random.default_rng(0).normal(size=len(start)))
    ends = []
    for sign in (1, -1):
        torch.nn.utils.vector_to_parameters(start + sign * e * direction, flow.parameters())
        ends.append(target.residuals())
    torch.testing.assert_close(J @ direction, (ends[0] - ends[1]) / (2 * e), rtol=1e-6, atol=1e-8)


# the search ----------------------------------------------------------------------------------------------------------


def module(n):
    result = torch.nn.Module()
    result.x = torch.nn.Parameter(torch.zeros(n, dtype=torch.float64))
    result.n_parameters = n
    return result


# labels and data -------------------------------------------------------------------------------------------------


def test_data_is_used_and_a_tenth_of_it_held_out():
    x = OSCILLATOR.domain.sample(300, 3)
    t = np.random.default_rng(0).random(300)
    c, s = np.cos(t), np.sin(t)
    y = np.stack([c * x[:, 0] + s * x[:, 1], c * x[:, 1] - s * x[:, 0]], -1)
    arguments = {**QUICK, "residual_weight": 0.0, "matching_weight": 0.0, "optimizer": "gauss-newton", "steps": 40}
    arguments |= {"pairs": 2, "points": 300}
    flow = train(OSCILLATOR, data=(t, x, y), **arguments)
    assert flow.figures["one_step_error"] < flow.history[0]["one_step_error"] / 5
    with pytest.warns(UserWarning, match=r"^`data` are not labels of the system 'harmonic_oscillator'"):
        other = train(OSCILLATOR, data=(t, torch.tensor(x), -y), **{**arguments, "steps": 2})
    assert flow.unfitted == other.unfitted == ()  # labels at random times leave no gap
    assert other.recipe["stages"][0]["data"] != flow.recipe["stages"][0]["data"]


@pytest.fixture(scope="module")
def labelled_at_dt():
    """A flow fitted to labels at Δt = 1 and no other time."""
    x = OSCILLATOR.domain.sample(60, 3)
    c, s = np.cos(1.0), np.sin(1.0)
    y = np.stack([c * x[:, 0] + s * x[:, 1], c * x[:, 1] - s * x[:, 0]], -1)
    arguments = {**QUICK, "residual_weight": 0.0, "matching_weight": 0.0, "optimizer": "gauss-newton", "steps": 15}
    return train(OSCILLATOR, data=(np.full(60, 1.0), x, y), **arguments | {"pairs": 2, "points": 60})


class TestLabelsAtFewTimes:
    """A flow that was compared with nothing is given with a warning, wherever it is asked for."""

    def test_the_flow_knows_its_times_and_so_does_its_file(self, labelled_at_dt, tmp_path):
        assert labelled_at_dt.unfitted == ((0.0, 1.0),)
        labelled_at_dt.save(tmp_path / "flow.safetensors")
        assert load(tmp_path / "flow.safetensors").unfitted == ((0.0, 1.0),)
        assert train(OSCILLATOR, flow=labelled_at_dt, steps=1, optimizer="gauss-newton", points=20).unfitted == ()

    @pytest.mark.parametrize(
        "ask",
        [
            lambda f, x: solve(OSCILLATOR, f, (0, 3), t_eval=[0.5, 1.0]),
            lambda f, x: solve(OSCILLATOR, f, (0, 3), t_eval=[0.5, 1.0], backend="array"),
            lambda f, x: solve(OSCILLATOR, f, (0, 2.5)),
            lambda f, x: solve(OSCILLATOR, f, (0, 3), dt=0.5),
            lambda f, x: solve(OSCILLATOR, f, (0, 3), dense_output=True).sol(1.5),
            lambda f, x: f(1.25, x),
            lambda f, x: f(torch.tensor([1.0, 1.25], dtype=x.dtype), x),
            lambda f, x: f.inverse(0.25, x),
        ],
    )
    def test_results_between_them_warn(self, labelled_at_dt, ask):
        message = r"none of them at a time between 0 and 1: its values there were not compared"
        with pytest.warns(UserWarning, match=message):
            ask(labelled_at_dt, torch.tensor(OSCILLATOR.domain.sample(2)))

    @pytest.mark.parametrize(
        ("t", "gaps"),
        [
            ([1.0], ((0.0, 1.0),)),
            ([0.5, 1.0, 0.5], ((0.0, 0.5), (0.5, 1.0))),
            ([0.5], ((0.0, 0.5), (0.5, 1.0))),
            (np.arange(1, 9) / 8, ()),
            (np.linspace(0.5, 1, 50), ((0.0, 0.5),)),
        ],
    )
    def test_gaps_are_longer_than_an_eighth(self, t, gaps):
        assert unlabelled(np.asarray(t), 1.0) == gaps


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (3, TypeError, "^`data` must be three arrays"),
        ((np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2))), ValueError, "^`data` must have shapes"),
        ((np.zeros(3), np.zeros((3, 4)), np.full((3, 4), math.nan)), ValueError, "^`data` must be finite"),
        ((np.full(3, 2.0), np.zeros((3, 4)), np.zeros((3, 4))), ValueError, "^`data` has times from 2 to 2, beyond"),
    ],
)
def test_bad_data_is_refused(data, error, message):
    with pytest.raises(error, match=message):
        train(HH, data=data, **QUICK)


# what train() chooses --------------------------------------------------------------------------------------------


def test_other_systems_get_a_network():
    quick = {"steps": 1, "points": 40, "validation_points": 40, "reference_states": 2, "progress": False}
    box = Box([-1.0, -1.0], [1.0, 1.0])
    coupled = HamiltonianSystem.from_sympy("p**2/2*(1 + q**2) + q**2/2", domain=box)
    quartic = HamiltonianSystem.from_sympy("p**4/4 + p**2/2 + q**2/2", domain=box)
    plain = HamiltonianSystem(lambda q: q.square().sum(-1), ndof=1, domain=box)
    for system in (coupled, quartic, plain):
        flow = train(system, **quick)
        assert isinstance(flow, SympFlow)
        assert not isinstance(flow, PrimedFlow)
        assert flow.recipe["stages"][0]["optimizer"] == "adam"


def test_a_resumed_run_with_other_data_is_refused(tmp_path):
    t, x, y = labels(20)
    train(HH, data=(t, x, y), steps=2, checkpoint=tmp_path / "run.ckpt", optimizer="gauss-newton", **QUICK)
    with pytest.raises(ValueError, match="`resume` is a run with another data"):
        train(HH, data=(t, x, y * (1 + 1e-6)), steps=2, resume=tmp_path / "run.ckpt", optimizer="gauss-newton", **QUICK)


def test_forward_and_reverse_mode_agree():
    """A primed flow of three parameters takes forward mode, one with more of them reverse mode."""
    sample = (torch.tensor([0.3, 0.9]), torch.tensor(HH.domain.sample(2, 0)))
    flow = SympFlow.primed(HH, 1, degree=1)
    assert flow.n_parameters < 4 < FLOWS["sympflow"]().n_parameters
    r, J = jacobian(flow, Loss(HH, Scaling.unit(2)).residual, sample)
    assert (r.shape, J.shape) == ((2, 4), (2, 4, flow.n_parameters))
    value = Loss(HH, Scaling.unit(2)).residual(flow, *sample)
    for i, j in np.ndindex(2, 4):
        slopes = torch.autograd.grad(value[i, j], list(flow.parameters()), retain_graph=True)
        torch.testing.assert_close(J[i, j], torch.cat([s.reshape(-1) for s in slopes]))


class Quadratic:
    """An objective with residuals A x − b, of a module's only parameter x."""

    def __init__(self, module, A, b, draw=0):
        self.module, self.A, self.b, self.draw = module, A, b, draw

    def residuals(self):
        return self.A @ self.module.x.detach() - self.b

    def __call__(self):
        return self.residuals().square().sum()

    def linearized(self):
        return self.residuals(), self.A


@pytest.mark.parametrize("damping", [1e-4, 1e-14], ids=["normal equations", "QR"])
@pytest.mark.parametrize("worst", [1.0, 1e-7])
def test_a_linear_problem_is_solved_at_once(damping, worst):
    """However ill-conditioned: where the normal equations would lose all digits, the QR factorization is taken."""
    rng = np.random.default_rng(0)
    A = torch.tensor(rng.normal(size=(40, 5)))
    A[:, 0] = A[:, 1] + worst * A[:, 0]
    b = A @ torch.arange(1.0, 6.0, dtype=torch.float64)
    target = module(5)
    method = GaussNewtonSteps(target)
    method.damping.value = damping
    cost = [method.step(0, Quadratic(target, A, b)) for _ in range(8)]
    assert cost[-1] < 1e-12 * cost[0]
    if damping == 1e-14:
        pulled = torch.cat([A, PULL**0.5 * torch.eye(5)]), torch.cat([b, torch.zeros(5, dtype=b.dtype)])
        torch.testing.assert_close(target.x.detach(), torch.linalg.lstsq(*pulled).solution, rtol=1e-5, atol=0)


@pytest.mark.slow
def test_it_beats_adam_by_far():
    """Equal architecture and points: 40 steps against 400 gradient steps on fresh points."""
    common = {**QUICK, "pairs": 2, "hidden": (8,), "points": 300, "matching_weight": 0.0}
    adam = train(OSCILLATOR, optimizer="adam", steps=400, learning_rate=1e-2, **common)
    newton = train(OSCILLATOR, optimizer="gauss-newton", steps=40, **common)
    assert newton.figures["one_step_error"] < adam.figures["one_step_error"] / 20
