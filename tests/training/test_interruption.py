"""Early ends of a search for a primed flow: Ctrl-C, at any moment, and a time budget, which counts all of it."""

import math
import os
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from sympflow import SympFlow, systems, train
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.training import checkpoint as checkpoints
from sympflow.training import trials
from sympflow.training.session import Interruption
from sympflow.training.starts import default_primed
from sympflow.training.table_fit import TableFit, TableRun

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends the process there")
PENDULUM = systems.pendulum()
FLOW = SympFlow.primed(PENDULUM, 2, dt=0.5, processor=2)
QUICK = {"restarts": 4, "steps": 30, "points": 40, "reference_states": 10, "label_times": 2, "progress": False}


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(autouse=True)
def _as_in_a_terminal():
    """A job in the background inherits that SIGINT is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def then(monkeypatch, owner, name, act, at=0):
    """Ctrl-C, or what else `act` does, as a function is called for the time of number `at`."""
    whole, calls = getattr(owner, name), []

    def changed(*arguments, **options):
        calls.append(name)
        if len(calls) == at + 1:
            act()
        return whole(*arguments, **options)

    monkeypatch.setattr(owner, name, changed)
    return calls


def error_of(flow):
    """At other states than those of the figures."""
    x = PENDULUM.domain.sample(50, 3)
    exact = reference_step(PENDULUM, x, flow.dt, 1e-12)
    return np.linalg.norm(flow(flow.dt, torch.as_tensor(x)).detach().numpy() - exact, axis=-1).mean()


def test_the_first_asks_and_the_second_raises():
    with Interruption() as interruption:
        with pytest.raises(KeyboardInterrupt):  # there is nothing yet
            interrupt()
        interruption.armed = True
        interrupt()
        assert interruption.asked
        with pytest.raises(KeyboardInterrupt):
            interrupt()


def test_a_handler_of_the_programs_own_is_left():
    noted = []

    def handler(*_):
        noted.append(True)

    signal.signal(signal.SIGINT, handler)
    with Interruption() as interruption:
        interruption.armed = True
        interrupt()
        assert (noted, interruption.asked) == ([True], False)
    assert signal.signal(signal.SIGINT, signal.default_int_handler) is handler


@pytest.mark.parametrize("start", [0, 2])
def test_in_the_search_the_best_so_far_is_returned(monkeypatch, tmp_path, start):
    """The start that is cut short counts, but is followed to its end when the run is resumed."""
    monkeypatch.setattr("sympflow.kernels.table_loops.table_loops", lambda *_: None)  # one start after the other
    path, whole = tmp_path / "run.ckpt", train(PENDULUM, flow=FLOW, **QUICK)
    with monkeypatch.context() as patch:
        then(patch, TableRun, "next_minimum", interrupt, at=start)
        steps = then(patch, TableFit, "linearized", lambda: None)
        with pytest.warns(
            RuntimeWarning, match=rf"after {start + 1} of 4 starts because it was interrupted\. The best"
        ):
            flow = train(PENDULUM, flow=FLOW, checkpoint=path, **QUICK)
    assert len(steps) <= start * QUICK["steps"]
    assert flow.recipe["stages"][-1]["ended_early"] == "it was interrupted"
    if start == 0:
        assert error_of(flow) == pytest.approx(error_of(FLOW), rel=1e-9)
    else:
        assert error_of(flow) < 0.1 * error_of(FLOW)
    assert checkpoints.read(path)["step"] == start
    resumed = train(PENDULUM, flow=FLOW, resume=path, **QUICK)
    assert all(torch.equal(v, resumed.state_dict()[k]) for k, v in whole.state_dict().items())


def test_a_second_one_raises_and_the_checkpoint_stays(monkeypatch, tmp_path):
    path = tmp_path / "run.ckpt"

    def twice():
        interrupt()
        interrupt()

    then(monkeypatch, TableRun, "complete", twice)
    with pytest.raises(KeyboardInterrupt):
        train(PENDULUM, flow=FLOW, checkpoint=path, **QUICK)
    assert checkpoints.read(path)["step"] == QUICK["restarts"]


SHORT = {"STARTS": 2, "STEPS": 10, "FINAL_STEPS": 10, "POINTS": 20, "LENGTH": 10}


def one_step_error(flow):
    return flow.figures["one_step_error"]


def short_trials(monkeypatch):
    for name, value in SHORT.items():
        monkeypatch.setattr(trials, name, value)
    first, *_ = starts = [replace(default_primed(PENDULUM, phase=x), stages=2, processor=2) for x in (0.8, 1.0, 1.25)]
    monkeypatch.setattr(trials, "tried_starts", lambda *_, **__: starts)
    return first


@pytest.mark.parametrize("where", ["next trial", "labels", "search"])
def test_once_a_trial_is_done_its_flow_is_there(monkeypatch, where):
    """The result is the flow that the trial fitted: a start that was cut short found nothing that is nearer."""
    start = short_trials(monkeypatch)
    tried = trials.trial(start, PENDULUM, PENDULUM.domain)
    if where == "next trial":
        then(monkeypatch, trials, "trial", interrupt, at=1)
    else:
        monkeypatch.setattr(trials, "tried_starts", lambda *_, **__: [start])
        monkeypatch.setattr(trials, "DEAREST", 0.0)
        name = {"labels": "prepare", "search": "next_minimum"}[where]
        then(monkeypatch, TableRun, name, interrupt, at=1 if where == "labels" else SHORT["STARTS"])
    with pytest.warns(RuntimeWarning, match=r"^Training .* because it was interrupted"):
        flow = train(PENDULUM, reference_states=10, progress=False)
    assert flow.dt == start.dt
    for name, value in tried.flow.state_dict().items():
        torch.testing.assert_close(flow.state_dict()[name], value, rtol=0, atol=1e-12)
    assert 0 < one_step_error(flow) < 0.1


def test_a_budget_and_the_training_time_count_the_trials(monkeypatch, clock):
    seen = {}

    def chosen(system, domain, session):
        clock.now += 5.0
        return trials.Trial(default_primed(system), 1e-6)

    def go(self, session):
        seen.update(left=session.deadline.left, seconds=session.passed)
        raise KeyboardInterrupt

    monkeypatch.setattr(trials, "chosen_trial", chosen)
    monkeypatch.setattr(TableRun, "go", go)
    for options, whole in (({"time_budget": 70.0}, 70.0), ({}, math.inf)):
        clock.now = 0.0
        with pytest.raises(KeyboardInterrupt):
            train(PENDULUM, progress=False, **options)
        assert seen == {"left": whole - 5.0, "seconds": 5.0}
