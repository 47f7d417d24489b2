"""Messages of `train` and its flows on arguments that they cannot take: the argument, and the remedy."""

import inspect

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, SympFlow, systems, train
from sympflow.training import checkpoint as checkpoints
from sympflow.training import trials
from sympflow.training.options import NewFit, NewFlow, TableOptions, plain_numbers
from sympflow.training.table_fit import TableRun

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
BOX = sympflow.Box([-1.0, -1.0], [1.0, 1.0])
RELATIVISTIC = HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**2/2", name="relativistic", domain=BOX)
WHOLE = HamiltonianSystem(hamiltonian=lambda q, p: (q * q + p * p).sum(-1) / 2, ndof=1, name="whole", domain=BOX)


@pytest.mark.parametrize("maker", [SympFlow.primed, SympFlow.split])
def test_options_of_flows_are_told_from_those_of_training(maker):
    of_train = inspect.signature(train).parameters
    alone = [name for name in inspect.signature(maker).parameters if name not in of_train]
    assert alone
    for name in alone:
        with pytest.raises(TypeError, match=rf"^`{name}` is an option of SympFlow\.\w+: pass flow=SympFlow\.\w+\(.*=6"):
            train(HH, **{name: 6})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"time_budget": "60"}, ValueError, "^`time_budget` must be a positive number of seconds; got '60'"),
        ({"time_budget": True}, ValueError, "^`time_budget` must be a positive number"),
        ({"callback": 5}, TypeError, "^`callback` must be a function .*; got 5: leave it out"),
        ({"checkpoint": 5}, TypeError, "^`checkpoint` must be the path of a file; got 5"),
        ({"resume": 5}, TypeError, "^`resume` must be the path of a file; got 5"),
        ({"dt": "1"}, ValueError, "^`dt` must be a positive finite number; got '1'"),
        ({"stages": 2, "energy_weight": "1"}, ValueError, "^`energy_weight` must be finite and at least 0; got '1'"),
        ({"stages": 2, "frozen_weight": "1"}, ValueError, "^`frozen_weight` must be positive and finite; got '1'"),
    ],
)
def test_what_is_of_another_type_is_named(arguments, error, message):
    with pytest.raises(error, match=message):
        train(PENDULUM, **arguments)


def test_where_no_checkpoint_can_be_written_is_said_at_once(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "run.ckpt"):
        with pytest.raises(ValueError, match=r"^`checkpoint` .* cannot be written \(.*\): name a file that can be"):
            train(PENDULUM, checkpoint=path)


def test_what_is_no_system_or_scheme_is_named(tmp_path):
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem; got float"):
        train(2.0)
    SympFlow.primed(PENDULUM, 2).save(tmp_path / "flow.safetensors")
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem; got str"):
        sympflow.load(tmp_path / "flow.safetensors", system="pendulum")
    with pytest.raises(TypeError, match=r"^`scheme` must be a Scheme or the name of one; got 3: choose one of"):
        SympFlow.primed(PENDULUM, scheme=3)


def test_numbers_may_be_numpys(tmp_path):
    """They are recorded as Python's, so that a checkpoint of such a run can be compared with one of another."""
    flow = SympFlow.primed(PENDULUM, np.int64(2), dt=np.float32(0.5), processor=np.int32(1))
    assert (flow.dt, flow.architecture()) == (0.5, SympFlow.primed(PENDULUM, 2, dt=0.5, processor=1).architecture())
    assert SympFlow(np.int64(1), pairs=np.int64(2), hidden=(np.int64(3), 4), dt=np.float32(0.5)).dt == 0.5
    asked = NewFit(points=np.int64(30), restarts=np.int64(1), steps=np.int64(2), energy_weight=np.float32(10))
    assert TableOptions.of(plain_numbers(asked)) == TableOptions(points=30, restarts=1, steps=2)
    plain = {"dt": 0.5, "stages": 2, "points": 30, "restarts": 1, "steps": 2, "reference_states": 5}
    path = tmp_path / "run.ckpt"
    train(PENDULUM, checkpoint=path, progress=False, **{k: np.asarray(v)[()] for k, v in plain.items()})
    assert train(PENDULUM, resume=path, progress=False, **plain).dt == 0.5
    for refused in (True, np.bool_(True), np.float64(2.5), np.array([2])):
        with pytest.raises(ValueError, match=r"^`stages` must be a positive integer"):
            SympFlow.primed(PENDULUM, refused)


@pytest.mark.parametrize(
    ("system", "arguments", "message"),
    [
        (RELATIVISTIC, {"stages": 3}, r"^`stages` asks for .* T = ½ pᵀM⁻¹p.* leave out `stages` .* optimizer='bfgs'"),
        (
            RELATIVISTIC,
            {"kind": "primed", "processor": 2},
            "^`kind` and `processor` .*leave out `kind` and `processor`",
        ),
        (WHOLE, {"kind": "primed"}, r"^`kind` asks for .* one function H, .*: leave out `kind` for a network"),
        (WHOLE, {"stages": 3}, "^`stages` asks for .*: leave out `stages` for a network"),
    ],
)
def test_systems_without_a_primed_flow_are_told_what_to_leave_out(system, arguments, message):
    with pytest.raises(ValueError, match=message):
        train(system, **arguments)


def test_the_remedies_work():
    quick = {"steps": 1, "points": 20, "validation_points": 20, "reference_states": 2, "progress": False}
    assert train(RELATIVISTIC, stages=1, optimizer="bfgs", **quick).kind == "sympflow"
    assert train(WHOLE, pairs=1, hidden=(3,), **quick).kind == "sympflow"


def test_the_defaults_of_the_options_are_those_of_train():
    arguments = inspect.signature(train).parameters
    for asked in (NewFlow(), NewFit()):
        assert {name: arguments[name].default for name in vars(asked)} == vars(asked)
    surroundings = {"system", "dt", "flow", "domain", "checkpoint", "resume", "time_budget", "progress", "callback"}
    assert set(arguments) == {*vars(NewFlow()), *vars(NewFit()), *surroundings, "workers", "unknown"}


class Started(Exception):
    pass


def test_a_run_of_trials_is_resumed_whatever_else_is_said_now(monkeypatch, tmp_path):
    """A short budget, and the default of its fit, say nothing of its flow."""
    path, start = tmp_path / "run.ckpt", trials.tried_starts(HH, HH.domain)[-1]

    def kill(*_):
        raise Started

    with monkeypatch.context() as patch, pytest.raises(Started):
        patch.setattr(TableRun, "next_minimum", kill)
        train(HH, flow=start.flow(HH), checkpoint=path, progress=False)
    assert checkpoints.read(path)["step"] == 0
    monkeypatch.setattr(TableRun, "go", kill)
    for options in ({}, {"time_budget": 30.0}, {"time_budget": 30.0, "loss": "labels"}, {"time_budget": 90.0}):
        with pytest.raises(Started):
            train(HH, resume=path, progress=False, **options)
    with pytest.raises(ValueError, match=r"^`resume` is a run with another restarts"):
        train(HH, resume=path, restarts=3, progress=False)
    with pytest.raises(ValueError, match=r"^`resume` is a run with another architecture: .* arguments of the flow"):
        train(HH, stages=2, resume=path, progress=False)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"seed": -1}, ValueError, r"^`seed` must be a non-negative integer; got -1"),
        ({"reference_states": 0}, ValueError, r"^`reference_states` must be a positive integer; got 0"),
        ({"kind": "primed", "clip": 2.0}, TypeError, r"^`clip` is not an option of the optimizer 'gauss-newton'"),
    ],
)
def test_options_are_checked_before_trials(monkeypatch, arguments, error, message):
    monkeypatch.setattr(trials, "chosen_trial", None)
    with pytest.raises(error, match=message):
        train(HH, **arguments)
