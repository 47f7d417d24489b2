"""The laws of a training, whatever is fitted and by what: resumption to the bit, early ends, and its record."""

import math

import pytest
import torch

import sympflow
from sympflow import Box, HamiltonianSystem, SympFlow, systems, train
from sympflow.training import checkpoint as checkpoints

HH = systems.henon_heiles()
PAIR = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2)/2 + 200*q2**2 + (q1 - q2)**4/4", domain=Box([-1, -0.05, -1, -1], [1, 0.05, 1, 1])
)
FEW = {"points": 60, "validation_points": 60, "reference_states": 5, "progress": False}
SEARCH = {"restarts": 4, "steps": 10, "points": 30, "reference_states": 10, "label_times": 3, "progress": False}
NEW = {"pairs": 1, "hidden": (5,)}
STEPS = {"adam": 40, "bfgs": 8, "lbfgs": 8, "gauss-newton": 8}
ROWS = {
    "primed": (HH, SEARCH | {"flow": SympFlow.primed(HH, 3)}, 4),
    "split": (PAIR, SEARCH | {"flow": SympFlow.split(PAIR, 1, dt=0.2, terms=3)}, 4),
    **{
        f"{kind} by {optimizer}": (
            HH,
            {"kind": kind, "optimizer": optimizer, "steps": n, "refresh": 3, "validate_every": n // 8, **NEW, **FEW}
            | {"checkpoint_every": n // 4},
            n,
        )
        for kind in ("sympflow", "mlp")
        for optimizer, n in STEPS.items()
    },
}
EACH = pytest.mark.parametrize("row", ROWS)
SOME = pytest.mark.parametrize("row", ["primed", "split", "sympflow by adam"])


def weights(flow):
    return torch.cat([w.reshape(-1) for w in flow.state_dict().values()])


class Killed(Exception):
    pass


def at(step, exception):
    """A callback that ends a run at a step."""

    def callback(k, figures):
        if k >= step:
            raise exception

    return callback


@EACH
def test_a_resumed_run_ends_bit_identical(row, tmp_path):
    system, options, last = ROWS[row]
    path, whole = tmp_path / "run.ckpt", train(system, **options)
    with pytest.raises(Killed):
        train(system, checkpoint=path, callback=at(last * 3 // 4 - (last > 4), Killed), **options)
    assert 0 < checkpoints.read(path)["step"] < last
    resumed = train(system, checkpoint=path, resume=path, **options)
    assert torch.equal(weights(resumed), weights(whole))
    assert resumed.history == whole.history
    assert not torch.equal(weights(train(system, seed=1, **options)), weights(whole))
    with pytest.raises(ValueError, match="`resume` is a run with another seed"):
        train(system, resume=path, seed=1, **options)
    other = {"flow": SympFlow.primed(HH, 4)} if row == "primed" else {"hidden": (10,)} if "flow" not in options else {}
    if other:
        with pytest.raises(ValueError, match="`resume` is a run with another architecture"):
            train(system, resume=path, **options | other)


@SOME
def test_a_time_budget_ends_the_run(row, clock):
    system, options, _ = ROWS[row]
    clock.tick = 1e-3
    many = {"restarts" if "restarts" in options else "steps": 10**6}
    with pytest.warns(RuntimeWarning, match="the time budget was used up"):
        flow = train(system, time_budget=5.0 if "flow" in options else 0.1, **options | many)
    stage = flow.recipe["stages"][-1]
    assert stage.get("restarts_taken", stage.get("steps_taken")) < 10**6
    assert math.isfinite(flow.figures["one_step_error"])


@SOME
def test_a_given_flow_is_copied_and_its_stages_are_recorded(row, tmp_path):
    system, options, _ = ROWS[row]
    first = train(system, **options)
    before, further = weights(first), {n: v for n, v in options.items() if n not in (*NEW, "kind", "flow", "restarts")}
    second = train(system, **further | {"flow": first, "seed": 1})
    assert torch.equal(weights(first), before)
    assert [stage["seed"] for stage in second.recipe["stages"]] == [0, 1]
    assert second.dt == first.dt
    assert second.figures["training_seconds"] >= first.figures["training_seconds"]
    assert not any(w.requires_grad for w in second.parameters())
    second.save(tmp_path / "flow.safetensors")
    loaded = sympflow.load(tmp_path / "flow.safetensors", system=system)
    assert (loaded.recipe, loaded.figures) == (second.recipe, second.figures)


@SOME
def test_progress_shows_only_when_asked(row, capsys):
    system, options, _ = ROWS[row]
    train(system, **options)
    assert capsys.readouterr() == ("", "")
    train(system, **options | {"progress": True})
    assert capsys.readouterr().err


LARGEST = {"primed": ("one_step_error", 1e-4), "split": ("missed_share", 0.1)}  # after half of the starts


@SOME
def test_an_interrupted_run_returns_its_best_state(row):
    system, options, last = ROWS[row]
    half = last // 2
    with pytest.warns(RuntimeWarning, match=rf"after {half} of {last} (steps|starts) because it was interrupted"):
        flow = train(system, callback=at(half, KeyboardInterrupt), **options)
    stage = flow.recipe["stages"][-1]
    assert stage.get("steps_taken", stage.get("restarts_taken")) == half
    assert stage["ended_early"] == "it was interrupted"
    name, bound = LARGEST.get(row, ("residual_loss", flow.history[0].get("residual_loss")))
    assert flow.figures[name] < bound
