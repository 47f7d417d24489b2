"""Messages of `train` and its flows on arguments that they cannot take: the argument, and the remedy."""

import inspect

import numpy as np
import pytest
import torch

import sympflow
from sympflow import HamiltonianSystem, SympFlow, systems, train
from sympflow.training import checkpoint as checkpoints
from sympflow.training import trials
from sympflow.training.fits import (
    BFGS,
    KINDS,
    SOLVERS,
    Adam,
    ClockedFit,
    GaussNewton,
    LossFit,
    NetworkFit,
    PrimedFit,
    SplitFit,
    keywords,
)
from sympflow.training.table_fit import TableRun

HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
BOX = sympflow.Box([-1.0, -1.0], [1.0, 1.0])
RELATIVISTIC = HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**2/2", name="relativistic", domain=BOX)
WHOLE = HamiltonianSystem(hamiltonian=lambda q, p: (q * q + p * p).sum(-1) / 2, ndof=1, name="whole", domain=BOX)


@pytest.mark.parametrize("maker", [SympFlow.primed, SympFlow.split])
def test_options_of_flows_are_told_from_those_of_training(maker):
    of_train = {*inspect.signature(train).parameters, *keywords()}
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
    assert PrimedFit(points=np.int64(30), energy_weight=np.float32(10)) == PrimedFit(points=30)
    assert GaussNewton(np.int64(2), np.int64(1)) == GaussNewton(steps=2, restarts=1)
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


def test_unknown_options_are_refused_with_those_that_there_are():
    for name in ("nonsense", "stagse"):
        with pytest.raises(TypeError, match=rf"^`{name}` is not an option of train\(\): .*stages, .*learning_rate"):
            train(HH, **{name: 3})
    for kind in KINDS:
        for solver in SOLVERS:
            other = "pairs" if kind == "primed" and solver == "gauss-newton" else "runs"
            with pytest.raises(TypeError, match=rf"^`{other}` is not an option of .*: leave it out"):
                train(HH, kind=kind, optimizer=solver, **{other: 2})


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"fit": PrimedFit(), "stages": 3}, TypeError, "^`stages` was given beside `fit`"),
        ({"fit": "primed"}, TypeError, "^`fit` must be a fit of sympflow.training"),
        ({"fit": PrimedFit(), "solver": Adam()}, TypeError, "^`solver` of PrimedFit is GaussNewton; .*LossFit"),
        ({"fit": PrimedFit(), "solver": "adam"}, TypeError, "^`solver` must be GaussNewton"),
        ({"budget": 1.0, "time_budget": 1.0}, TypeError, "^`budget` and `time_budget` are the same limit"),
        ({"budget": -1.0}, ValueError, "^`budget` must be a positive number of seconds; got -1"),
        ({"fit": LossFit()}, TypeError, "^`flow` is missing, which LossFit trains further"),
        ({"fit": NetworkFit(), "flow": SympFlow(2)}, TypeError, "^`fit` NetworkFit is not one of a given SympFlow"),
        ({"fit": SplitFit(), "flow": SympFlow(2)}, TypeError, "^`fit` SplitFit is not one of a given SympFlow"),
        ({"solver": GaussNewton(), "steps": 3}, TypeError, "^`steps` was given beside `solver`"),
    ],
)
def test_fits_and_solvers_that_do_not_go_together_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        train(HH, **options)


QUICK = {"points": 30, "label_times": 2, "reference_states": 5}


@pytest.mark.parametrize(
    ("system", "fit", "solver", "keywords"),
    [
        (
            PENDULUM,
            PrimedFit(0.5, stages=2, processor=1, **QUICK),
            GaussNewton(steps=3, restarts=2),
            {"dt": 0.5, "stages": 2, "processor": 1, "steps": 3, "restarts": 2, **QUICK},
        ),
        (
            PENDULUM,
            NetworkFit(0.5, pairs=1, hidden=(4,), points=30, validation_points=30),
            Adam(steps=3, learning_rate=1e-3),
            {"dt": 0.5, "pairs": 1, "hidden": (4,), "points": 30, "validation_points": 30, "steps": 3}
            | {"learning_rate": 1e-3},
        ),
        (
            PENDULUM,
            NetworkFit(hidden=(4,), points=30, validation_points=30, baseline=True),
            BFGS(steps=1),
            {"kind": "mlp", "hidden": (4,), "points": 30, "validation_points": 30, "steps": 1, "optimizer": "bfgs"},
        ),
    ],
    ids=["primed", "network", "baseline"],
)
def test_keywords_say_what_fits_and_solvers_say(system, fit, solver, keywords):
    objects = train(system, fit, solver=solver, progress=False)
    plain = train(system, **keywords, progress=False)
    assert objects.recipe == plain.recipe
    assert all(torch.equal(v, plain.state_dict()[name]) for name, v in objects.state_dict().items())


@pytest.mark.parametrize(
    ("cls", "name"), [(SplitFit, "points"), (ClockedFit, "points"), (PrimedFit, "label_times"), (Adam, "steps")]
)
def test_none_is_refused_where_no_choice_is_left_open(cls, name):
    with pytest.raises(ValueError, match=f"^`{name}` must be a positive integer; got None: give 1 or more"):
        cls(**{name: None})
    assert PrimedFit(points=None).points is Adam(refresh=None).refresh is None


def test_a_fit_makes_its_own_split_flow_or_clock():
    spring = systems.spring_pendulum(1e3, coordinates="polar")
    flow = train(spring, SplitFit(dt=0.05, stages=1, terms=2, **QUICK), solver=GaussNewton(1, 1), progress=False)
    assert (type(flow).__name__, flow.dt, flow.recipe["stages"][0]["restarts"]) == ("SplitFlow", 0.05, 1)
    flow = train(systems.kepler(0.6), ClockedFit(0.5, points=20, label_times=3, terms=4))
    assert (type(flow).__name__, flow.figures["step"]) == ("ClockedFlow", 0.5)


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
