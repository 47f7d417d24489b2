"""Limits of a training: a time budget that every piece of it keeps, memory, and a Δt that can be learnt."""

import math

import pytest
import torch

from sympflow import Box, SympFlow, systems, train
from sympflow.hamiltonian.hamiltonian import Hamiltonian
from sympflow.training import trials
from sympflow.training.points import Labels
from sympflow.training.session import LEAST_PART, OutOfTime, Session
from sympflow.training.table_fit import TableFit

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
    with pytest.warns(RuntimeWarning, match="trials of 60 s was over, .* after 3 of"):
        assert trials.chosen_trial(HH, HH.domain, session).start in (first, second)
    assert len(taken) == 4
    clock.now = 59.5
    with pytest.warns(RuntimeWarning, match="trials of 1 s was over"):
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
