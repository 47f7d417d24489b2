"""Trials, starts, fits and rungs are shared by workers: the same bits come of it, and Ctrl-C ends it."""

import os
import pickle
import signal
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, SympFlow, systems, train
from sympflow.training import trials
from sympflow.training.fits import PrimedFit
from sympflow.training.session import Session
from sympflow.training.starts import scaling_of
from sympflow.training.table_fit import TableFit, TableRun
from sympflow.workers import WorkerPool

PENDULUM = systems.pendulum()
FLOW = SympFlow.primed(PENDULUM, 2, dt=0.5, processor=0)
QUICK = {"restarts": 3, "steps": 6, "points": 20, "reference_states": 5, "label_times": 2, "progress": False}


def same(flow, other):
    mine, theirs = flow.state_dict(), other.state_dict()
    return all(torch.equal(mine[name], theirs[name]) for name in mine) and flow.history == other.history


def test_searches_are_the_same_whatever_the_workers():
    alone = train(PENDULUM, flow=FLOW, **QUICK)
    with ThreadPoolExecutor(2) as threads:
        assert same(train(PENDULUM, flow=FLOW, workers=threads, **QUICK), alone)
    assert len(alone.history) == QUICK["restarts"] + 1


def test_trials_are_the_same_whatever_the_workers(monkeypatch):
    for name, value in {"STARTS": 2, "STEPS": 5, "FINAL_STEPS": 5, "POINTS": 20, "LENGTH": 5}.items():
        monkeypatch.setattr(trials, name, value)
    alone = trials.chosen_trial(PENDULUM, PENDULUM.domain)
    with ThreadPoolExecutor(2) as threads:
        found = trials.chosen_trial(PENDULUM, PENDULUM.domain, Session(pool=WorkerPool(threads)))
    assert (found.start, found.error) == (alone.start, alone.error)
    assert same(found.flow, alone.flow)


@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends the process there")
def test_ctrl_c_does_not_wait_for_workers(monkeypatch):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    whole, calls = TableFit.minimize, []

    def minimize(self, *arguments, **options):
        calls.append(self)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return whole(self, *arguments, **options)

    monkeypatch.setattr(TableFit, "minimize", minimize)
    try:
        with (
            ThreadPoolExecutor(1) as thread,
            pytest.warns(RuntimeWarning, match="because it was interrupted. The best"),
        ):
            flow = train(PENDULUM, flow=FLOW, workers=thread, **QUICK | {"restarts": 50})
    finally:
        signal.signal(signal.SIGINT, before)
    assert flow.recipe["stages"][-1]["restarts_taken"] < 50


def test_what_cannot_be_pickled_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    system = HamiltonianSystem(potential=lambda q: (q**4).sum(-1) / 4, ndof=1, domain=PENDULUM.domain)
    flow = SympFlow.primed(system, 2, dt=0.1, processor=0)
    with pytest.raises(TypeError, match=r"`system` cannot be sent to `workers` .*define its functions in a module"):
        train(system, flow=flow, workers=2, **QUICK)


def test_fits_are_the_same_in_another_process():
    """Their products are rounded by the order of arrays in memory, which a pickle must not change."""
    few = {"points": 20, "label_times": 3, "reference_states": 5, "loss_points": 10, "matching_times": 2}
    table = PrimedFit(loss="labels+residual", **few)
    run = TableRun(FLOW, PENDULUM, PENDULUM.domain, scaling_of(PENDULUM.domain, FLOW.dt, 0), table)
    theta = run.table.continued(run.frozen.coefficients(run.start_of(1))[0])
    fits = [(run.frozen, run.start_of(1)), (run.weighted, run.start_of(0)), (run.whole, theta)]
    for fit, x in fits:
        for other in (pickle.loads(pickle.dumps(fit)), fit.own()):
            assert all(np.array_equal(a, b) for a, b in zip(fit.linearized(x), other.linearized(x), strict=True))
    run.table.assign(run.given)
    run.whole.own().residuals(theta)
    assert np.array_equal(run.table.parameters(), run.given)
