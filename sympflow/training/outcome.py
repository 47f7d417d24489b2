"""How a run ends: what is said of an early end, and what the flow keeps of the run."""

from __future__ import annotations

import warnings
from typing import Any

import torch

from sympflow.flow.base import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem

OUT_OF_TIME = "the time budget was used up"
INTERRUPTED = "it was interrupted"


def warn_of_early_end(reason: str, done: int, planned: int, unit: str) -> None:
    when = f"after {done} of {planned} {unit}" if done < planned else f"in its last fits, after all {planned} {unit},"
    warnings.warn(
        f"Training ended {when} because {reason}. The best state so far is returned.",
        RuntimeWarning,
        stacklevel=4,
    )


def recorded(
    flow: FlowMap,
    system: HamiltonianSystem,
    domain: Domain,
    scaling: Scaling | None,
    stage: dict[str, Any],
    history: list[dict[str, float]],
    figures: dict[str, float],
    seconds: float,
) -> Any:
    """The flow with the record of its training, `stage` the latest part of it; its parameters without gradient."""
    flow.requires_grad_(False)
    flow.zero_grad(set_to_none=True)
    flow.domain, flow.fingerprint, flow.system_name = domain, system.fingerprint, system.name
    earlier = float(flow.figures.get("training_seconds", 0.0))
    flow.recipe = {
        "stages": [*flow.recipe.get("stages", []), stage],
        **({} if scaling is None else {"scaling": scaling.to_dict()}),
        "torch": torch.__version__,
    }
    flow.figures = {name: value for name, value in figures.items() if name not in ("step", "loss", "iterations")}
    flow.figures["training_seconds"] = round(earlier + seconds, 3)
    flow.history = history
    return flow
