"""Messages of `train` and its flows on arguments that they cannot take: the argument, and the remedy."""

import inspect
import math

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

HH, PENDULUM, OSCILLATOR = systems.henon_heiles(), systems.pendulum(), systems.harmonic_oscillator()
BOX = sympflow.Box([-1.0, -1.0], [1.0, 1.0])
RELATIVISTIC = HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**2/2", name="relativistic", domain=BOX)
WHOLE = HamiltonianSystem(
    hamiltonian=lambda q, p: ((q * q + 1) * (p * p + 1)).sum(-1) / 2, ndof=1, name="whole", domain=BOX
)


@pytest.mark.parametrize("maker", [SympFlow.primed, SympFlow.split])
def test_options_of_flows_are_told_from_those_of_training(maker):
    of_train = {*inspect.signature(train).parameters, *keywords()}
    alone = [name for name in inspect.signature(maker).parameters if name not in of_train]
    assert alone
    for name in alone:
        with pytest.raises(TypeError, match=rf"^`{name}` is an option of SympFlow\.\w+: pass flow=SympFlow\.\w+\(.*=6"):
            train(HH, **{name: 6})


W, H, P, R, V, T = OSCILLATOR, HH, PENDULUM, RELATIVISTIC, ValueError, TypeError  # of one row a line
SEARCH = {"optimizer": "gauss-newton", "restarts": 3, "steps": 100, "points": 60, "reference_states": 30}
NEW = {"kind": "sympflow", "pairs": 1, "hidden": (5,)}


@pytest.mark.parametrize(
    ("system", "arguments", "error", "message"),
    [
        (W, {"optimizer": "sgd"}, V, f"^`optimizer` must be one of {', '.join(map(repr, SOLVERS))}; got 'sgd'"),
        (W, {"kind": "gan"}, V, "^`kind` must be one of 'primed', 'sympflow', 'mlp', 'kepler'; got 'gan'"),
        (W, {"schedule": "hope"}, V, "^`schedule`"),
        (W, {"dt": 0.0}, V, "^`dt`"),
        (W, {"dt": math.nan}, V, "^`dt`"),
        (W, {"steps": 0}, V, "^`steps`"),
        (W, {"points": 1.5}, V, "^`points`"),
        (W, {"learning_rate": -1.0}, V, "^`learning_rate`"),
        (W, {"clip": math.inf}, V, "^`clip`"),
        (W, {"residual_weight": math.nan}, V, "^`residual_weight`"),
        (W, {"residual_weight": 0.0, "matching_weight": 0.0}, V, "all 0"),
        (W, {"kind": "mlp", "matching_weight": 1.0}, V, "^`matching_weight` needs a Hamiltonian"),
        (W, {"seed": -1}, V, "^`seed`"),
        (W, {"refresh": 0}, V, "^`refresh`"),
        (W, {"matching_times": 400}, V, "^`matching_times`"),
        (W, {"time_budget": 0.0}, V, "^`time_budget`"),
        (W, {"flow": SympFlow(1), "pairs": 3}, V, "^`pairs` describes a new flow"),
        (W, {"flow": SympFlow(1), "kind": "mlp"}, V, "^`kind` describes a new flow"),
        (W, {"restart": 2}, T, r"^`restart` is not an option of train\(\), .*: did you mean `restarts`\?"),
        (W, {"flow": SympFlow.primed(PENDULUM)}, V, "^`system` 'harmonic_oscillator' is not the one that this flow"),
        (P, {"flow": SympFlow.primed(PENDULUM, dt=0.3), "dt": 0.5}, V, "^`dt` is 0.5 but the flow has 0.3"),
        (W, {"domain": 3}, T, r"^`domain` must be a domain of phase space; got 3: use sympflow\.Box"),
        (W, {"device": "foo"}, V, "^`device` 'foo' is not available here"),
        (W, {"device": "cuda:4096"}, V, "^`device` 'cuda:4096' is not available here"),
        (W, {"dtype": torch.int32}, T, "^`dtype` must be float32 or float64"),
        (W, {"optimizer": "gauss-newton", "device": "foo"}, V, "^`device` 'foo' is not available here"),
        (W, {"optimizer": "gauss-newton", "dtype": torch.float32}, T, "^`optimizer` .* in float64"),
        (W, {"flow": 3}, T, "^`flow` must be a SympFlow or an MLPFlow; got 3"),
        (W, {"kind": "mlp", "pairs": 1, "hidden": (2,)}, V, "^`hidden` and .* 16 parameters.*: give wider layers"),
        (H, SEARCH | {"learning_rate": 1e-2}, T, r"^`learning_rate` is not an option of the optimizer 'gauss-newton'"),
        (H, SEARCH | {"pairs": 3}, T, r"^`pairs` is not an option"),
        (H, SEARCH | {"optimizer": "adam"}, T, r"^`restarts` is not an option of the optimizer 'adam'"),
        (H, SEARCH | {"restarts": 0}, V, r"^`restarts` must be a positive integer"),
        (H, SEARCH | {"loss": "energy"}, V, r"^`loss` 'energy' is unknown"),
        (H, SEARCH | {"residual_weight": 2.0}, T, r"^`residual_weight` is not an option .* without a `loss`"),
        (H, SEARCH | {"frozen_weight": math.nan}, V, r"^`frozen_weight` must be positive"),
        (H, SEARCH | {"energy_weight": -1.0}, V, r"^`energy_weight` must be finite and at least 0; got -1.0"),
        (H, SEARCH | {"label_times": 2.0}, V, r"^`label_times` must be"),
        (H, SEARCH | {"seed": -1}, V, r"^`seed` must be"),
        (H, SEARCH | {"flow": SympFlow(2)}, T, r"^`restarts` is not an option of the .* of kind 'sympflow'"),
        (H, SEARCH | {"flow": SympFlow.primed(PENDULUM)}, V, r"^`system` .* degrees of freedom"),
        (P, {"time_budget": "60"}, V, "^`time_budget` must be a positive number of seconds; got '60'"),
        (P, {"time_budget": True}, V, "^`time_budget` must be a positive number"),
        (P, {"callback": 5}, T, "^`callback` must be a function .*; got 5: leave it out"),
        (P, {"checkpoint": 5}, T, "^`checkpoint` must be the path of a file; got 5"),
        (P, {"resume": 5}, T, "^`resume` must be the path of a file; got 5"),
        (P, {"scheme": "yoshida4", "stages": 7}, V, "^`stages` and `scheme` were both given: leave out"),
        (P, {"dt": "1"}, V, "^`dt` must be a positive finite number; got '1'"),
        (P, {"stages": 2, "energy_weight": "1"}, V, "^`energy_weight` must be finite and at least 0; got '1'"),
        (P, {"stages": 2, "frozen_weight": "1"}, V, "^`frozen_weight` must be positive and finite; got '1'"),
        (H, {"fit": PrimedFit(), "stages": 3}, T, "^`stages` was given in addition to `fit`"),
        (H, {"fit": "primed"}, T, "^`fit` must be a fit of sympflow.training"),
        (H, {"fit": PrimedFit(), "solver": Adam()}, T, "^`solver` of PrimedFit is GaussNewton; .*LossFit"),
        (H, {"fit": PrimedFit(), "solver": "adam"}, T, "^`solver` must be GaussNewton"),
        (H, {"budget": 1.0, "time_budget": 1.0}, T, "^`budget` and `time_budget` are the same limit"),
        (H, {"budget": -1.0}, V, "^`budget` must be a positive number of seconds; got -1"),
        (H, {"fit": LossFit()}, T, "^`flow` is missing, which LossFit trains further"),
        (H, {"fit": NetworkFit(), "flow": SympFlow(2)}, T, "^`fit` NetworkFit is not one of a given SympFlow"),
        (H, {"fit": SplitFit(), "flow": SympFlow(2)}, T, "^`fit` SplitFit is not one of a given SympFlow"),
        (H, {"solver": GaussNewton(), "steps": 3}, T, "^`steps` was given in addition to `solver`"),
        (H, {"seed": -1}, V, r"^`seed` must be a non-negative integer; got -1"),
        (H, {"reference_states": 0}, V, r"^`reference_states` must be a positive integer; got 0"),
        (H, {"kind": "primed", "clip": 2.0}, T, r"^`clip` is not an option of the optimizer 'gauss-newton'"),
        (H, NEW | {"optimizer": "lbfgs", "learning_rate": 1e-3}, T, "^`learning_rate` is not .* 'lbfgs'"),
        (H, NEW | {"optimizer": "gauss-newton", "restarts": 3}, T, "^`restarts` is not an .* kind 'sympflow'"),
        (H, NEW | {"stages": 3}, T, "^`stages` is not an option of flows of kind 'sympflow'"),
        (H, {"stages": 3, "pairs": 2}, T, "^`pairs` is not an option of flows of kind 'primed'"),
        (P, {"loss": "labels+labels", "restarts": 1}, V, r"^`loss` 'labels\+labels' names a loss twice"),
        (R, {"flow": SympFlow.primed(RELATIVISTIC)}, V, "^`system` .* must have a kinetic energy"),
        (R, {"restarts": 2}, V, "^`restarts` is of the search .*leave it out for a network, or pass"),
        (P, {"hidden": (10**6, 10**6)}, V, r"^`hidden` \(1000000, 1000000\) with .* 4\.47e\+04 GiB"),
        (P, {"hidden": (10**6, 10**6), "kind": "mlp"}, V, r"^`hidden` .* would take .* GiB of memory"),
        (P, {"pairs": 10**9}, V, r"^`pairs` must be at most 500, as many as a file may hold"),
        (P, {"stages": 10**6}, V, r"^`stages` must be at most 499"),
        (P, {"processor": 10**6}, V, r"^`processor` must be at most 499"),
        (P, {"points": 10**12, "stages": 2, "dt": 0.5}, V, r"^`points` 10{12}, .* would take .* GiB.*: take fewer"),
        (P, {"points": 10**12, "kind": "sympflow"}, V, r"^`points` 1000000000000 .* would take .* GiB.*: take fewer"),
        (P, {"points": 10**10, **NEW, "optimizer": "gauss-newton"}, V, r"^`(points|optimizer)` .* take .* GiB"),
        (P, {"workers": 0}, V, "^`workers` must be a positive number"),
        (P, {"workers": "two"}, T, "^`workers` must be a number, an object with .map"),
        (P, {"workers": 2, "kind": "mlp"}, T, "^`workers` share the starts of a search by 'gauss-newton'"),
        (P, {"workers": 2, "optimizer": "bfgs"}, T, "^`workers` share the starts"),
    ],
)
def test_what_cannot_be_is_named_before_anything_begins(monkeypatch, system, arguments, error, message):
    monkeypatch.setattr(trials, "chosen_trial", None)
    with pytest.raises(error, match=message):
        train(system, **arguments)


def test_what_is_no_system_or_scheme_is_named(tmp_path):
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem; got float"):
        train(2.0)
    SympFlow.primed(PENDULUM, 2).save(tmp_path / "flow.safetensors")
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem; got str"):
        sympflow.load(tmp_path / "flow.safetensors", system="pendulum")
    with pytest.raises(TypeError, match=r"^`scheme` must be a Scheme or the name of one; got 3: choose one of"):
        SympFlow.primed(PENDULUM, scheme=3)


@pytest.mark.parametrize(
    ("system", "arguments", "message"),
    [
        (RELATIVISTIC, {"stages": 3}, r"^`stages` asks for .* T = ½ pᵀM⁻¹p.* leave out `stages` .* optimizer='bfgs'"),
        (RELATIVISTIC, {"kind": "primed", "processor": 2}, "^(`kind` and `processor`) .*leave out \\1"),
        (WHOLE, {"kind": "primed"}, r"^`kind` asks for .* one function H, .*: leave out `kind` for a network"),
        (WHOLE, {"stages": 3}, "^`stages` asks for .*: leave out `stages` for a network"),
    ],
)
def test_systems_without_a_primed_flow_are_told_what_to_leave_out(system, arguments, message):
    with pytest.raises(ValueError, match=message):
        train(system, **arguments)


def test_unknown_options_are_refused_with_those_that_there_are():
    for name in ("nonsense", "stagse"):
        with pytest.raises(TypeError, match=rf"^`{name}` is not an option of train\(\), .*stages, .*learning_rate"):
            train(HH, **{name: 3})
    for kind in KINDS:
        for solver in SOLVERS:
            other = "pairs" if kind == "primed" and solver == "gauss-newton" else "runs"
            with pytest.raises(TypeError, match=rf"^`{other}` is not an option of .*: leave it out"):
                train(HH, kind=kind, optimizer=solver, **{other: 2})


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
            NetworkFit(pairs=1, hidden=(4,), points=30, validation_points=30),
            Adam(steps=3, learning_rate=1e-3),
            {"pairs": 1, "hidden": (4,), "points": 30, "validation_points": 30, "steps": 3, "learning_rate": 1e-3},
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
    assert start.curvature

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
