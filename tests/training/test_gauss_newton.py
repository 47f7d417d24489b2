"""Gauss–Newton training: labels, derivatives of a table, the least-squares search, and the flows that come of it."""

import math

import numpy as np
import pytest
import torch

import sympflow
from sympflow import HamiltonianSystem, SympFlow, get, solve, systems, train
from sympflow.flow.scaling import Scaling
from sympflow.training import trainer
from sympflow.training.fits import PrimedFit
from sympflow.training.least_squares import levenberg_marquardt
from sympflow.training.points import Labels, Stream, states
from sympflow.training.table_fit import Table, TableFit, TableRun
from sympflow.training.table_step import TableStep

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
MASSES = HamiltonianSystem.from_sympy(
    "p1**2/4 + p1*p2/5 + p2**2 + q1**4/4 + q1*q2/3 + q2**2/2 + p3**2 + q3**2*q1**2/2",
    name="masses",
    domain=sympflow.Ball([0.0] * 6, 1.0),
)
QUICK = {
    "optimizer": "gauss-newton",
    "restarts": 3,
    "steps": 100,
    "points": 60,
    "reference_states": 30,
    "progress": False,
}


# labels ----------------------------------------------------------------------------------------------------------


def test_labels_are_the_exact_flow_of_the_oscillator():
    omega, t = 3.0, np.array([0.2, 0.7, 1.3])
    x = np.random.default_rng(0).normal(size=(20, 2))
    labels = Labels.of(systems.harmonic_oscillator(omega), x, t)
    c, s = np.cos(omega * t)[:, None], np.sin(omega * t)[:, None]
    q, p = x.T
    np.testing.assert_allclose(labels.y[..., 0], c * q + s / omega * p, atol=1e-12)
    np.testing.assert_allclose(labels.y[..., 1], c * p - s * omega * q, atol=3e-12)


# the step of a table and its derivatives --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["srkn6b", "omelyan6", "chin4a"])
def test_a_table_step_is_the_splitting_step(name):
    scheme, h, y = sympflow.get(name).scheme, 0.2, HH.domain.sample(5, 0)
    sequence = [kind for kind, *_ in scheme.substeps]
    c = [h * b for _, b, *_ in scheme.substeps] + [h**3 * s.three for s in scheme.substeps if s.kind == "kick"]
    step = TableStep(HH, sequence, True)
    np.testing.assert_allclose(step(np.array(c)[:, None], y.T).T, get(name)().step(HH, 0.0, y, h), atol=1e-15)


@pytest.mark.parametrize("force_gradient", [True, False])
@pytest.mark.parametrize("system", [HH, PENDULUM, MASSES], ids=lambda s: s.name)
@pytest.mark.parametrize("first", ["kick", "drift"])
def test_derivatives_by_the_table(system, force_gradient, first):
    """Against autodiff of the same step written in torch, each state with coefficients of its own."""
    sequence = [first, *["drift", "kick"] * 2][:5] if first == "kick" else ["drift", "kick"] * 2
    step = TableStep(system, sequence, force_gradient)
    y = system.domain.sample(4, 0).T
    c = np.random.default_rng(0).uniform(0.1, 0.3, (step.n_coefficients, y.shape[1]))
    end, J = step.with_jacobian(c, y)
    np.testing.assert_allclose(end, step(c, y), atol=1e-14)
    compiled, n = TableStep(system, sequence, force_gradient, compiled=True), len(c)
    zero = np.zeros((len(y), 16))
    errors = compiled.errors(y, None, zero, zero + 1, zero[:0], np.tile(np.eye(n), (4, 1, 1)))
    J_compiled = errors(c[compiled.order].T, linearized=True)[1].reshape(n, 4, len(y), 4)

    def executed(c, y):
        q, p = y.chunk(2, -1)
        kicks = iter(range(len(sequence), step.n_coefficients))
        for i, kind in enumerate(sequence):
            if kind == "drift":
                q = q + c[i] * system.velocity(p)
            else:
                F = system.force(q)
                p = p + c[i] * F
                if force_gradient:
                    p = p - c[next(kicks)] * (system.potential_hessian(q) @ system.velocity(F)[..., None])[..., 0]
        return torch.cat([q, p], -1)

    for k in range(y.shape[1]):
        expected = torch.func.jacfwd(executed)(torch.tensor(c[:, k]), torch.tensor(y[:, k]))
        exact, differences = {"rtol": 1e-12, "atol": 1e-13}, {"rtol": 1e-7, "atol": 1e-8}  # of ∇²V along M⁻¹∇V
        np.testing.assert_allclose(J[:, :, k].T, expected, **(differences if force_gradient else exact))
        np.testing.assert_allclose(J_compiled[:, k, :, k].T, expected[:, compiled.order], **exact)


# the search -----------------------------------------------------------------------------------------------------


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def box(x):
    t = np.arange(1, 11) / 10
    return np.exp(-t * x[0]) - np.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10 * t))


def freudenstein(x):  # with a local minimum of 48.98, from 0.5, -2
    return np.array([-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]])


@pytest.mark.parametrize(
    ("r", "start", "cost"),
    [(rosenbrock, [-1.2, 1.0], 0.0), (box, [0.0, 10.0, 20.0], 0.0), (freudenstein, [0.5, -2.0], 48.98425)],
)
def test_the_search_finds_the_minima_of_more_garbow_and_hillstrom(r, start, cost):
    def linearized(x):
        x = torch.tensor(x)
        e = 1e-6
        columns = [(r((x + e * d).numpy()) - r((x - e * d).numpy())) / (2 * e) for d in torch.eye(len(x))]
        return r(x.numpy()), np.stack(columns, 1)

    found = levenberg_marquardt(r, linearized, np.array(start))
    assert found.cost == pytest.approx(cost, rel=1e-5, abs=1e-15)
    assert found.iterations < 40


A, B = np.random.default_rng(0).normal(size=(30, 4)), np.ones(30)
TINY = {"damping": 1e-12}
SEARCHES = {  # residuals, their Jacobian, a start, its damping, and what is found
    "a linear problem": (lambda x: A @ x - B, lambda x: A, np.zeros(4), {}, np.linalg.lstsq(A, B, rcond=None)[0]),
    "where residuals are finite": (lambda x: np.log(x) - 1.0, lambda x: 1 / x[:, None], np.array([9.0]), {}, [math.e]),
    # a Gauss–Newton step from −6 goes to 396, where e^x is finite and its square is not
    "squares that overflow": (lambda x: np.exp(x) - 1.0, lambda x: np.diag(np.exp(x)), -np.full(1, 6.0), TINY, [0.0]),
    "a degenerate direction": (
        lambda x: x[:1] + x[1] - 2.0,
        lambda x: np.array([[1.0, 1.0, 0.0]]),
        np.zeros(3),
        {},
        [1, 1, 0],
    ),
}


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.filterwarnings("ignore:invalid value encountered in log")
def test_the_search_stops_by_itself_at_the_minimum(name):
    r, jacobian, start, options, minimum = SEARCHES[name]
    found = levenberg_marquardt(r, lambda x: (r(x), jacobian(x)), start, **options)
    np.testing.assert_allclose(found.x, minimum, rtol=1e-6, atol=1e-8)
    assert found.iterations < 30


# processed flows --------------------------------------------------------------------------------------------------


# training --------------------------------------------------------------------------------------------------------


def test_labels_may_be_handed_in():
    """At any times; those at Δt serve the search of the frozen table. A flow of other labels is another flow."""
    x, t = PENDULUM.domain.sample(40, 5), np.array([0.3, 0.7, 1.0])
    labels = Labels.of(PENDULUM, x, t)
    data = (np.repeat(t, 40), np.tile(x, (3, 1)), labels.y.reshape(-1, 2))
    arguments = {name: value for name, value in QUICK.items() if name != "points"}
    flow = train(PENDULUM, flow=SympFlow.primed(PENDULUM, 2), data=data, **arguments)
    assert flow.figures["one_step_error"] < 3e-3
    fewer = tuple(a[40:] for a in data)
    other = train(PENDULUM, flow=SympFlow.primed(PENDULUM, 2), data=fewer, **{**arguments, "restarts": 1})
    assert other.figures["fractional_error"] < 1e-3
    assert other.recipe["stages"][0]["data"] != flow.recipe["stages"][0]["data"]


def test_without_force_gradients_the_search_finds_negative_coefficients():
    """With positive ones, to which equal leapfrog steps lead, no order above 2 is possible."""
    flow = train(HH, flow=SympFlow.primed(HH, 7, dt=0.5, force_gradient=False), **{**QUICK, "restarts": 12})
    assert flow.figures["one_step_error"] < 1e-6
    assert min(*flow.scheme().kicks, *flow.scheme().drifts) < 0


# what a fit must not do -----------------------------------------------------------------------------------------


def test_a_fit_returns_nothing_worse_than_its_start():
    """Labels at Δt of another system: the flow as it was given is nearer to the exact one at the held-out states."""
    start = SympFlow.primed(PENDULUM, 2, dt=0.5, processor=2)
    x = PENDULUM.domain.sample(60, 0)
    t, y = np.full(60, 0.5), solve(PENDULUM, "kahan_li8", (0.0, 0.5), y0=x, dt=0.0125, t_eval=[0.5]).y[..., 0]
    with (
        pytest.warns(UserWarning, match=r"^`data` are not labels of the system 'pendulum'"),
        pytest.warns(RuntimeWarning, match=r"^The fit has a larger held-out error .* started from"),
    ):
        flow = train(PENDULUM, flow=start, data=(t, x, 2 * y), restarts=2, steps=8, progress=False)
    for name, value in start.state_dict().items():
        torch.testing.assert_close(flow.state_dict()[name], value, rtol=0, atol=1e-15)
    assert flow.recipe["stages"][-1]["kept_start"] is True
    assert flow.figures["one_step_error"] < 0.05


def test_a_checkpoint_is_there_before_the_first_search_ends(tmp_path, monkeypatch):
    """A run that is killed in its first search can be resumed, and ends as one that was not."""
    path = tmp_path / "run.pt"
    options = {"restarts": 2, "steps": 6, "points": 30, "reference_states": 10, "progress": False}
    start = SympFlow.primed(PENDULUM, 2, dt=0.5)
    whole = train(PENDULUM, flow=start, **options)

    class Killed(BaseException):
        pass

    def kill(*_, **__):
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(TableFit, "minimize", kill)
        train(PENDULUM, flow=start, checkpoint=path, **options)
    resumed = train(PENDULUM, flow=start, resume=path, **options)
    assert all(torch.equal(v, resumed.state_dict()[k]) for k, v in whole.state_dict().items())


FEW = PrimedFit(points=5, label_times=3, frozen_weight=1.0, energy_weight=7.0)


LABELS = Labels.of(PENDULUM, states(PENDULUM.domain, 5, 0, Stream.RESIDUAL), 0.8 * np.arange(1, 4) / 3)


def check_derivatives(problem, theta, tolerance):
    """The residuals of a problem, whose Jacobian is compared with differences."""
    r, J = problem.linearized(theta)
    np.testing.assert_allclose(r, problem.residuals(theta), atol=1e-15)
    for i, e in enumerate(1e-6 * np.eye(len(theta))):
        slope = (problem.residuals(theta + e) - problem.residuals(theta - e)) / 2e-6
        np.testing.assert_allclose(J[:, i], slope, atol=tolerance)
    return r


def errors_of(psi):
    """The residuals by definition, of coordinates and of the energy, for ψ̄ at labels (3, 5, 2) of the pendulum."""
    y = LABELS.y
    spread = np.std(PENDULUM.hamiltonian(LABELS.x))
    energy = math.sqrt(7.0) / spread * (PENDULUM.gradient(y) * (psi - y)).sum(-1)
    return np.concatenate([np.moveaxis(psi - y, -1, -2), energy[:, None]], axis=1).ravel() / math.sqrt(15)


@pytest.mark.parametrize("options", [{}, {"palindromic": False}, {"processor": 2}], ids=str)
def test_the_fits_derivatives(options):
    """Residuals and Jacobian by the flow's parameters, against the flow itself."""
    flow = SympFlow.primed(PENDULUM, 2, degree=3, dt=0.8, **options).requires_grad_(False)
    run = TableRun(flow, PENDULUM, PENDULUM.domain, Scaling.unit(1), FEW)
    table = Table(flow)
    theta = table.parameters() + 0.02 * np.random.default_rng(0).normal(size=flow.n_parameters)
    r = check_derivatives(run.whole, theta, 1e-9)
    table.assign(theta)
    executed = torch.stack([flow.psi(float(t), torch.as_tensor(LABELS.x)) for t in LABELS.t])
    np.testing.assert_allclose(r, errors_of(executed.numpy()), atol=1e-14)


@pytest.mark.parametrize("system", [HH, PENDULUM], ids=["henon-heiles", "pendulum"])
def test_labels_agree_with_another_method(system):
    """DOP853 against Kahan–Li of order 8 with 400 tiny steps, whose truncation is below rounding."""
    x, t = system.domain.sample(30, 0), np.array([0.5, 1.0])
    other = solve(system, "kahan_li8", (0.0, 1.0), y0=x, dt=1 / 400, t_eval=t).y
    np.testing.assert_allclose(Labels.of(system, x, t).y, np.moveaxis(other, -1, 0), atol=2e-13)


def test_a_processor_pays():
    """At every time, and at no cost over a long run."""
    processed, plain = (
        train(HH, flow=SympFlow.primed(HH, 2, processor=c), **{**QUICK, "steps": 40}).figures for c in (3, 0)
    )
    assert processed["one_step_error"] < plain["one_step_error"] / 5
    assert processed["fractional_error"] < 10 * processed["one_step_error"]


def test_residuals_of_a_loss_are_those_of_the_flow():
    """The whole fit against Loss: the sum of squares is the loss, and the Jacobian its derivative."""
    flow = SympFlow.primed(PENDULUM, 2, degree=3, processor=1)
    config = PrimedFit(loss="residual+matching", residual_weight=2.0, matching_weight=3.0, loss_points=20)
    run = TableRun(flow, PENDULUM, PENDULUM.domain, Scaling.unit(1), config)
    theta = Table(flow).parameters() + np.random.default_rng(0).normal(0, 0.02, flow.n_parameters)
    r = check_derivatives(run.whole, theta, 1e-8)
    Table(flow).assign(theta)
    objective = run.whole.objective
    assert r @ r == pytest.approx(float(objective.loss(flow, objective.points).detach()), rel=1e-12)


def weights(flow):
    return torch.cat([w.reshape(-1) for w in flow.state_dict().values()])


@pytest.mark.parametrize(("symbolic", "starts"), [(True, 72), (False, 24)])
def test_nothing_said_means_the_same_flow_on_every_machine(monkeypatch, clock, symbolic, starts):
    """However long its starts and labels take there, none is left out; only a budget that is given ends them."""
    monkeypatch.setattr(trainer.trials, "can_try", lambda system: symbolic)
    monkeypatch.setattr(trainer, "STARTS", 3)
    monkeypatch.setattr(trainer, "SOME", 3)
    few = {"points": 60, "reference_states": 20, "progress": False}
    flows = [train(PENDULUM, **few)]
    clock.costs_seconds(TableRun, "next_minimum", 1000.0)
    clock.costs_seconds(Labels, "of", 1000.0)
    flows.append(train(PENDULUM, **few))
    one, other = (weights(flow) for flow in flows)
    assert torch.equal(one, other)
    assert flows[1].recipe["stages"] == flows[0].recipe["stages"]
    assert clock.now > 3000.0
    seen = []
    monkeypatch.undo()
    monkeypatch.setattr(trainer.trials, "can_try", lambda system: symbolic)
    monkeypatch.setattr(TableRun, "go", lambda self, session: seen.append(self.planned) or 1 / 0)
    for options in ({}, {"restarts": 5}, {"time_budget": 7.0}):
        with pytest.raises(ZeroDivisionError):
            train(PENDULUM, points=30, reference_states=5, dt=0.5, **options)
    assert seen == [starts, 5, trainer.BOUGHT if symbolic else 24]


def test_a_free_flow_is_no_worse_than_a_palindrome():
    half, full = (
        train(PENDULUM, flow=SympFlow.primed(PENDULUM, 2, palindromic=p), **QUICK).history[-1]["loss"]
        for p in (True, False)
    )
    assert full < 1.05 * half


def test_the_weight_at_dt_counts():
    def errors(weight):
        flow = SympFlow.primed(HH, 2, degree=1)  # one table for all t: a compromise
        return train(HH, flow=flow, frozen_weight=weight, energy_weight=0.0, **QUICK).figures["one_step_error"]

    assert errors(100.0) < errors(0.01)
