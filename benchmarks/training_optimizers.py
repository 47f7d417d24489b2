"""Optimizers of networks at equal architecture and equal training time: Gauss–Newton, Adam, BFGS and L-BFGS.

    python benchmarks/training_optimizers.py                 60 s of processor time each: a quarter of an hour
    python benchmarks/training_optimizers.py --quick         a second each
    python benchmarks/training_optimizers.py --seconds 120

A SympFlow of the published architecture (three pairs, potentials of two hidden layers of 10, float64) and the
unconstrained baseline of as many parameters learn Δt = 1 of the harmonic oscillator and of Hénon–Heiles, from the same
seed and on the same domain, by the residual alone. The errors are means of one step over the 100 states of the
published tests, which no training sees, at Δt and over 50 fractional times. Each training ends after the same processor
time of one thread, its validations included. Gauss–Newton changes to the points of the second stage of the shipped
recipes after half of it; Adam's one-cycle schedule is as long as the time allows, as a trial finds out. The published
figures are those of the released checkpoints (Adam, 10,000 to 50,000 epochs).
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import torch
from measuring import fragments

from sympflow import train
from sympflow.training.pretrained import package_folder
from sympflow.training.shipped.judges import AsPublished, one_step_errors
from sympflow.training.shipped.recipe import Recipe

PUBLISHED = {
    ("harmonic_oscillator", "sympflow"): 3.5e-4,
    ("henon_heiles", "sympflow"): 2.3e-3,
    ("harmonic_oscillator", "mlp"): 1.2e-3,
    ("henon_heiles", "mlp"): 4.2e-2,
}
OPTIMIZERS = ("gauss-newton", "bfgs", "lbfgs", "adam")
MANY = 10**7  # steps of a run that its time ends
TRIAL = 50  # steps of Adam by which the length of its schedule is found


@dataclass(frozen=True)
class Result:
    """One training: its processor time, and the errors of one step."""

    scene: str
    kind: str
    optimizer: str
    parameters: int
    seconds: float
    steps: int
    at_dt: float
    fractional: float


def recipe_of(scene: str, kind: str) -> Recipe:
    """The recipe of a network that ships."""
    return Recipe.of(package_folder() / f"{scene}-{kind}.safetensors")


def trained(recipe: Recipe, optimizer: str, seconds: float) -> Result:
    """A flow that was trained for so many seconds of processor time, and what it achieves."""
    system, judge = recipe.system, recipe.judge
    assert isinstance(judge, AsPublished)
    points = [fit.points for fit, _ in recipe.stages]
    options: dict[str, Any] = {"optimizer": optimizer, "domain": recipe.domain, "matching_weight": 0.0}
    options["steps"] = MANY
    options |= {"progress": False, "validate_every": 1}
    new: dict[str, Any] = {"dt": recipe.flow.dt, "kind": recipe.kind}
    if optimizer == "adam":
        for _ in range(2):  # the first sets up what later steps find
            begin = time.process_time()
            train(system, **new, **(options | {"steps": TRIAL, "validate_every": TRIAL}))
        options["steps"] = max(TRIAL, int(TRIAL * seconds / (time.process_time() - begin)))
        options["validate_every"] = max(1, options["steps"] // 40)
    elif optimizer == "gauss-newton":
        options |= {"validate_every": 5, "points": points[0]}
    else:
        options["points"] = points[1]
    begin = time.process_time()

    def until(share: float) -> Callable[[int, dict[str, float]], None]:
        def stop(step: int, figures: dict[str, float]) -> None:
            if time.process_time() - begin > share * seconds:
                raise KeyboardInterrupt  # `train` returns its best state

        return stop

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that a run was stopped is what is meant
        if optimizer == "gauss-newton":
            flow = train(system, **new, callback=until(0.5), **options)
            flow = train(system, flow=flow, callback=until(1.0), **(options | {"points": points[1]}), seed=1)
        else:
            flow = train(system, **new, callback=until(1.0), **options)
    spent = time.process_time() - begin
    at_dt, fractional = one_step_errors(flow, system, judge.initial())
    steps = sum(stage["steps_taken"] for stage in flow.recipe["stages"])
    return Result(
        recipe.name.partition("-")[0], recipe.kind, optimizer, flow.n_parameters, spent, steps, at_dt, fractional
    )


def row(result: Result) -> str:
    published = PUBLISHED[result.scene, result.kind]
    lower = published / result.at_dt
    return fragments.row(
        [
            f"{result.scene.replace('_', ' ')}, {result.kind} ({result.parameters})",
            result.optimizer,
            f"{result.seconds:.0f} s",
            f"{result.steps:,}",
            f"{result.at_dt:.1e}",
            f"{result.fractional:.1e}",
            f"{published:.1e}",
            f"{lower:.0f}" if lower >= 10 else f"{lower:.1g}",
        ]
    )


def run(seconds: float, scenes: list[str], kinds: list[str], optimizers: list[str]) -> str:
    """The table, its rows printed as they are made."""
    lines = [
        "| network (parameters) | optimizer | time | steps | error at Δt | at fractional t | published | times lower |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for scene in scenes:
        for kind in kinds:
            for optimizer in optimizers:
                lines.append(row(trained(recipe_of(scene, kind), optimizer, seconds)))
                print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a second of training each")
    parser.add_argument("--seconds", type=float, default=60.0, help="processor time of each training")
    parser.add_argument("--scene", action="append", choices=sorted({scene for scene, _ in PUBLISHED}))
    parser.add_argument("--kind", action="append", choices=("sympflow", "mlp"))
    parser.add_argument("--optimizer", action="append", choices=OPTIMIZERS)
    fragments.add_out(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    seconds = 1.0 if options.quick else options.seconds
    scenes = options.scene or ["harmonic_oscillator", "henon_heiles"]
    found = run(seconds, scenes, options.kind or ["sympflow", "mlp"], options.optimizer or list(OPTIMIZERS))
    print("\n" + found)
    fragments.write(options.out, "training-optimizers", found)


if __name__ == "__main__":
    main()
