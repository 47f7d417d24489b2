"""Limits of a training: a time budget that every piece of it keeps, memory, and a Δt that can be learnt."""

import math
import re
import warnings

import numpy as np
import pytest
import torch

import sympflow
from sympflow import Box, HamiltonianSystem, SympFlow, systems, train
from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.hamiltonian import Hamiltonian
from sympflow.kernels.network_tangents import NetworkTangents
from sympflow.training import checkpoint as checkpoints
from sympflow.training import starts, trials
from sympflow.training.least_squares import STOPPED, levenberg_marquardt
from sympflow.training.losses import Loss
from sympflow.training.points import Labels
from sympflow.training.session import LEAST_PART, OutOfTime, Session
from sympflow.training.table_fit import TableFit, TableRun

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
FLOW = SympFlow.primed(PENDULUM, 2, dt=0.5, processor=2)
QUICK = {"restarts": 4, "steps": 30, "points": 40, "reference_states": 10, "label_times": 2, "progress": False}
NETWORK = {"pairs": 1, "hidden": (4,), "points": 60, "validation_points": 60, "reference_states": 5, "progress": False}


# the deadline -------------------------------------------------------------------------------------------------


def test_a_deadline_is_asked_between_steps_and_within_one(clock):
    session = Session(time_budget=10.0)
    whole = session.deadline
    part, early = whole.part(0.5), whole.before(2.0)
    assert (whole.left, part.left, early.left) == (10.0, 5.0, 8.0)
    clock.now = 5.0
    assert part.over()
    assert session.cut
    with pytest.raises(OutOfTime):
        part.check()
    assert not early.over()
    assert whole.part(0.01).left == LEAST_PART
    assert Session().deadline.part(0.1).left == math.inf


def test_ctrl_c_ends_every_piece():
    session = Session()
    session.interruption.asked = True
    with pytest.raises(OutOfTime):
        session.deadline.part(0.5).check()


def test_least_squares_that_are_cut_keep_what_they_have():
    calls = []

    def residuals(x):
        calls.append(x)
        if len(calls) > 7:
            raise OutOfTime
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def linearized(x):
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])

    found = levenberg_marquardt(residuals, linearized, np.array([-1.2, 1.0]))
    assert found.reason == STOPPED
    assert found.cost < 24.2
    assert found.iterations >= 1


# primed flows -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", [(TableFit, "residuals", 0.2), (TableFit, "model", 3.0)])
def test_the_search_for_a_primed_flow_keeps_its_budget(clock, what):
    """However much its steps or their Jacobians take: to 20 % and the evaluations that compare what there is."""
    clock.costs_seconds(*what)
    with pytest.warns(RuntimeWarning, match="because the time budget was used up"):
        flow = train(PENDULUM, flow=FLOW, time_budget=100.0, **QUICK)
    assert 50.0 < clock.now < 120.0
    assert flow.figures["training_seconds"] == pytest.approx(clock.now)
    assert flow.figures["one_step_error"] <= 1e-3


@pytest.mark.parametrize("kind", ["primed", "sympflow"])
def test_labels_that_take_too_long_are_a_message_with_what_was_reached(clock, kind):
    """And the flow as it was; a network does without, and is trained."""
    clock.costs_seconds(Hamiltonian, "vector_field", 0.2)
    if kind == "primed":
        with pytest.warns(
            RuntimeWarning, match=r"^Training did not start because its labels .* share .*: the exact solution"
        ):
            flow = train(PENDULUM, flow=FLOW, time_budget=20.0, **QUICK)
        assert all(torch.equal(v, FLOW.state_dict()[k]) for k, v in flow.state_dict().items())
        assert ended_early(flow).startswith(
            "its labels were not known in their share of the time budget: the exact solution was followed from 40"
        )
        assert "missed_share" not in flow.figures
    else:
        with pytest.warns(RuntimeWarning, match=r"^There was no time to follow 5 held-out states to dt = 1"):
            flow = train(PENDULUM, time_budget=20.0, steps=2, residual_weight=0.0, **NETWORK)
        assert "one_step_error" not in flow.figures
        assert flow.recipe["stages"][-1]["steps_taken"] == 2
    assert clock.now < 24.0


@pytest.mark.parametrize("dt", [1.0, None], ids=["at dt", "with trials"])
def test_no_time_for_labels_is_told_where_nothing_else_is_said(clock, dt):
    """A search that its time ends is what is meant then, but not a flow that was never fitted."""
    clock.costs_seconds(Hamiltonian, "vector_field", 0.2)
    with pytest.warns(RuntimeWarning) as told:
        flow = train(PENDULUM, dt, time_budget=20.0, progress=False)
    assert re.match(r"Training did not start .* kink", str(told[-1].message))
    assert ["share for trials" in str(w.message) for w in told[:-1]] == ([True] if dt is None else [])
    assert ended_early(flow).startswith("its labels were not known")


def ended_early(flow):
    return flow.recipe["stages"][-1]["ended_early"]


def test_labels_of_a_network_are_cut_too(clock):
    clock.costs_seconds(Hamiltonian, "vector_field", 0.2)
    with pytest.warns(RuntimeWarning, match=r"^Training did not start"):
        flow = train(PENDULUM, time_budget=20.0, steps=2, label_weight=1.0, label_times=3, **NETWORK)
    assert clock.now < 24.0
    assert isinstance(flow, SympFlow)
    assert "training_seconds" in flow.figures


def test_a_run_without_time_for_labels_goes_on_from_its_checkpoint(clock, tmp_path):
    path = tmp_path / "run.ckpt"
    whole = train(PENDULUM, flow=FLOW, checkpoint=path, **QUICK)
    best = checkpoints.read(path)["best"]
    clock.costs_seconds(Hamiltonian, "vector_field", 0.5)
    with pytest.warns(RuntimeWarning, match=r"^Training did not start"):
        flow = train(PENDULUM, flow=FLOW, resume=path, time_budget=20.0, **QUICK)
    assert all(torch.equal(v, best[k]) for k, v in flow.state_dict().items())
    assert whole.figures["one_step_error"] < 1e-3


def test_trials_take_at_most_two_thirds_of_the_time(clock, monkeypatch):
    """The trials made so far choose; without any it is the shortest Δt."""
    taken = []

    def trial(start, system, domain, deadline):
        clock.now += 12.0
        taken.append(start)
        return trials.Trial(start, 1e-3)

    monkeypatch.setattr(trials, "trial", trial)
    first, second, *_ = trials.tried_starts(HH, HH.domain)
    session = Session(time_budget=60.0)
    with pytest.warns(RuntimeWarning, match="trials of 60 s was over, .* after 3 of"):
        assert trials.chosen_trial(HH, HH.domain, session).start in (first, second)
    assert len(taken) == 4
    clock.now = 59.5
    with pytest.warns(RuntimeWarning, match="trials of 1 s was over"):
        assert trials.chosen_trial(HH, HH.domain, Session(time_budget=1.0)).start in (first, second)


# networks -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["adam", "bfgs", "lbfgs", "gauss-newton"])
def test_the_training_of_a_network_keeps_its_budget(clock, optimizer):
    """Each evaluation of the loss takes a second: a step of a quasi-Newton method tens of them."""
    clock.costs_seconds(Loss, "residual", 1.0)
    clock.costs_seconds(NetworkTangents, "values", 1.0)
    loss = {"matching_weight": 0.0}
    with pytest.warns(RuntimeWarning, match="because the time budget was used up"):
        flow = train(PENDULUM, time_budget=30.0, optimizer=optimizer, **loss, **NETWORK)
    assert 15.0 < clock.now < 36.0
    assert flow.figures["residual_loss"] < flow.history[0]["residual_loss"]


def test_a_step_for_which_there_is_no_time_is_not_begun(clock, monkeypatch):
    """A step is expected to take as long as the longest before it."""
    clock.costs_seconds(Loss, "residual", 8.0)
    with pytest.warns(RuntimeWarning, match=r"after [1-9] of 20000 steps because the time budget"):
        train(PENDULUM, time_budget=50.0, matching_weight=0.0, **NETWORK)
    assert clock.now <= 50.0
    clock.now = 0.0
    with pytest.warns(RuntimeWarning, match=r"after 0 of 20000 steps because a step takes about 1\.6e\+03 s, .* short"):
        train(PENDULUM, time_budget=60.0, matching_weight=0.0, **{**NETWORK, "points": 6000})


def test_validations_take_a_tenth_of_the_time(clock, monkeypatch):
    whole = Loss.residual

    def slow(self, flow, t, x):
        clock.now += 0.01 * len(t)
        return whole(self, flow, t, x)

    monkeypatch.setattr(Loss, "residual", slow)
    with pytest.warns(RuntimeWarning, match="because the time budget was used up"):
        train(PENDULUM, time_budget=30.0, matching_weight=0.0, **{**NETWORK, "validation_points": 20_000})
    assert 20.0 < clock.now < 36.0  # all points would take 200 s


# a step that can be learnt ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [None, "primed", "sympflow", "mlp"])
def test_a_step_far_beyond_the_periods_is_refused_at_once(monkeypatch, kind):
    monkeypatch.setattr(Labels, "of", None)
    message = r"^`dt` = 1e\+06 is far beyond the periods of the system 'pendulum', 1\.3e\+05 .*take dt=1"
    with pytest.raises(ValueError, match=message):
        train(PENDULUM, 1e6, kind=kind, time_budget=10.0)
    with pytest.raises(ValueError, match=r"^`dt` = 100000 is far beyond"):
        train(PENDULUM, flow=SympFlow.primed(PENDULUM, 2, dt=1e5))


def test_periods_of_any_hamiltonian_are_known():
    box = Box([-1.0, -1.0], [1.0, 1.0])
    whole = HamiltonianSystem(hamiltonian=lambda q, p: 50 * (q * q + p * p).sum(-1), ndof=1, name="whole", domain=box)
    with pytest.raises(ValueError, match=r"^`dt` = 10 is far beyond the periods of the system 'whole', 1\.6e\+02"):
        train(whole, 10.0)
    starts.check_step(whole, box, 1.0)
    free = HamiltonianSystem.from_sympy("p**2/2", domain=box)
    starts.check_step(free, box, 1e6)  # it has no period


def test_a_domain_whose_squares_overflow_is_refused():
    with pytest.raises(ValueError, match=r"^`domain` has states as large as 1\.\d*e\+200, whose squares overflow"):
        train(PENDULUM, 0.1, domain=Box([-1e200, -1e200], [1e200, 1e200]), restarts=1)


# primed flows of every H = ½ pᵀM⁻¹p + V(q) --------------------------------------------------------------------


class Began(Exception):
    pass


def array(q):
    """Numbers of NumPy alone, so that the functions below are not traced."""
    return np.asarray(q, dtype=float)


def pendulum_by(what):
    arguments = {"ndof": 1, "domain": PENDULUM.domain}
    if what == "torch":
        return HamiltonianSystem(lambda q: (1 - torch.cos(q)).sum(-1), **arguments)

    def V(q):
        return (1 - np.cos(array(q))).sum(-1)

    def gradient(q):
        return np.sin(array(q))

    if what == "a gradient alone":
        return HamiltonianSystem(V, gradient=gradient, **arguments)
    return HamiltonianSystem(V, gradient=gradient, hessian_vector=lambda q, v: np.cos(array(q)) * v, **arguments)


@pytest.mark.parametrize("what", ["torch", "a gradient alone", "NumPy"])
def test_functions_are_primed_by_default(monkeypatch, what):
    """A gradient alone has no force gradients."""
    few = {"points": 5, "label_times": 1, "reference_states": 2, "progress": False}

    def began(self, session):
        raise Began(self.flow)

    monkeypatch.setattr(TableRun, "go", began)
    with pytest.raises(Began) as run:
        train(pendulum_by(what), **few)
    flow = run.value.args[0]
    assert isinstance(flow, PrimedFlow)
    assert (flow.gradients is None) == (what == "a gradient alone")
    assert flow.dt == starts.default_primed(PENDULUM).dt


@pytest.mark.parametrize("what", ["a gradient alone", "NumPy"])
def test_primed_flows_of_functions_of_arrays_are_fitted_and_run(what):
    """∇²V·v are differences where a gradient is all there is."""
    system = pendulum_by(what)
    flow = train(system, points=20, restarts=2, steps=6, label_times=1, reference_states=5, progress=False)
    assert flow.figures["missed_share"] < 0.02
    y0 = np.array([1.0, 0.0])
    end = sympflow.solve(system, flow, (0.0, 5.0), y0=y0).y[:, -1]
    exact = sympflow.solve(PENDULUM, "kahan_li8", (0.0, 5.0), y0=y0, dt=0.1).y[:, -1]
    np.testing.assert_allclose(end, exact, atol=0.1)
    with pytest.raises(TypeError, match=r"^`system` .* has functions of NumPy arrays, and gradients do not flow"):
        flow(flow.dt, torch.tensor(y0, requires_grad=True))


def test_many_degrees_of_freedom_are_fitted():
    """A chain of twenty, given by a gradient and its products."""
    d = 20

    def bonds(q):
        zero = np.zeros((*q.shape[:-1], 1))
        return np.diff(np.concatenate([zero, q, zero], axis=-1), axis=-1)

    chain = HamiltonianSystem(
        lambda q: (bonds(q) ** 2 / 2 + bonds(q) ** 4 / 16).sum(-1),
        gradient=lambda q: -np.diff(bonds(q) + bonds(q) ** 3 / 4, axis=-1),
        hessian_vector=lambda q, v: -np.diff((1 + 0.75 * bonds(q) ** 2) * bonds(v), axis=-1),
        ndof=d,
        domain=Box([-1.0] * 2 * d, [1.0] * 2 * d),
    )
    omega = starts.frequency(chain, chain.domain)
    q = chain.domain.sample(starts.FEWER_SAMPLES, starts.SEED)[:, :d]
    exact = np.sqrt(np.linalg.eigvalsh(chain.potential_hessian(q)).max(-1))
    assert omega == pytest.approx(np.quantile(exact, starts.QUANTILE), rel=0.05)
    flow = SympFlow.primed(chain, 2, dt=0.25)
    few = {"restarts": 1, "steps": 8, "points": 4, "reference_states": 4, "label_times": 2, "progress": False}
    assert train(chain, flow=flow, **few).figures["missed_share"] < 1e-3


# what a flow is worth -----------------------------------------------------------------------------------------


def test_a_network_that_is_no_better_than_a_verlet_step_comes_with_a_warning():
    with pytest.warns(UserWarning, match=r"far from .*, no better than one Verlet step .* kind='primed' is far better"):
        flow = train(PENDULUM, steps=2, **NETWORK)
    assert flow.figures["missed_share"] > flow.figures["verlet_missed_share"] > 0
    x = torch.as_tensor(PENDULUM.domain.sample(50, 1))
    q, p = x.chunk(2, -1)
    q = q + p / 2
    p = p - torch.sin(q)
    exact = train(PENDULUM, 1.0, stages=4, restarts=1, steps=60, points=60, reference_states=20, progress=False)
    y = exact(1.0, x)
    verlet = (torch.cat([q + p / 2, p], -1) - y).norm(dim=-1).mean() / (y - x).norm(dim=-1).mean()
    assert flow.figures["verlet_missed_share"] == pytest.approx(float(verlet), rel=0.5)


def test_a_network_that_follows_a_step_comes_without_one():
    options = {**NETWORK, "pairs": 2, "hidden": (8,), "points": 300}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flow = train(systems.harmonic_oscillator(), 1.0, optimizer="gauss-newton", kind="sympflow", steps=40, **options)
    assert flow.figures["missed_share"] < flow.figures["verlet_missed_share"]
