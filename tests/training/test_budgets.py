"""Limits of a training: a time budget that every piece of it keeps, memory, and a Δt that can be learnt."""

import math

import numpy as np
import pytest
import torch

from sympflow import Box, HamiltonianSystem, SympFlow, systems, train
from sympflow.flow.primed import PrimedFlow
from sympflow.hamiltonian.hamiltonian import Hamiltonian
from sympflow.training import starts, trials
from sympflow.training.least_squares import STOPPED, levenberg_marquardt
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


def ended_early(flow):
    return flow.recipe["stages"][-1]["ended_early"]


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
    with pytest.warns(RuntimeWarning, match="of 60 s the share for trials ended, .* after 3 of"):
        assert trials.chosen_trial(HH, HH.domain, session).start in (first, second)
    assert len(taken) == 4
    clock.now = 59.5
    with pytest.warns(RuntimeWarning, match="of 1 s the share for trials ended"):
        assert trials.chosen_trial(HH, HH.domain, Session(time_budget=1.0)).start in (first, second)


# networks -----------------------------------------------------------------------------------------------------


# a step that can be learnt ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [None, "primed", "sympflow", "mlp"])
def test_a_step_far_beyond_the_periods_is_refused_at_once(monkeypatch, kind):
    monkeypatch.setattr(Labels, "of", None)
    message = r"^`dt` = 1e\+06 is far beyond the periods of the system 'pendulum', 1\.3e\+05 .*take dt=1"
    with pytest.raises(ValueError, match=message):
        train(PENDULUM, 1e6, kind=kind, time_budget=10.0)
    with pytest.raises(ValueError, match=r"^`dt` = 100000 is far beyond"):
        train(PENDULUM, flow=SympFlow.primed(PENDULUM, 2, dt=1e5))


def test_a_domain_whose_squares_overflow_is_refused():
    with pytest.raises(ValueError, match=r"^`domain` has states as large as 1\.\d*e\+200, whose squares overflow"):
        train(PENDULUM, 0.1, domain=Box([-1e200, -1e200], [1e200, 1e200]), restarts=1)


# primed flows of every H = ½ pᵀM⁻¹p + V(q) --------------------------------------------------------------------


# what a flow is worth -----------------------------------------------------------------------------------------


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
