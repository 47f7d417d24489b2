"""How a training starts: the run of a flow and its optimizer, with the choices that it takes."""

from __future__ import annotations

import copy
from typing import Any

import torch

from sympflow.flow.base import FlowMap
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.split import SplitFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.architecture import (
    NOT_OF_SEARCHES,
    OF_GRADIENTS,
    OF_LOSSES,
    OF_SEARCHES,
    new_network,
    refuse_options,
)
from sympflow.training.arguments import digest, labels_of, weights_of
from sympflow.training.collocation import Stream, states
from sympflow.training.config import TrainingConfig
from sympflow.training.gauss_newton import GaussNewtonRun
from sympflow.training.run import Labelled, Run
from sympflow.training.search_config import SplitConfig, TableConfig
from sympflow.training.split_run import SplitRun

SCALING_SAMPLES = 4096


def start(
    system: HamiltonianSystem, domain: Domain, kind: str, flow: FlowMap | None, given: dict[str, Any]
) -> Run | GaussNewtonRun | SplitRun:
    """The run of a copy of a flow, or of a new network if there is none; `given` are the arguments of `train`."""
    optimizer, dtype = given["optimizer"], given["dtype"]
    if optimizer is None:
        optimizer = "gauss-newton" if kind in ("primed", "split") else "adam"
    single = dtype not in (None, torch.float64) or (flow is not None and flow.dtype != torch.float64)
    if optimizer == "gauss-newton" and single:
        raise TypeError("`optimizer` 'gauss-newton' fits flows in float64: leave out `dtype`, or use 'adam'.")
    if flow is not None:
        flow = copy.deepcopy(flow).bound(system)
        flow.certified = None  # of the numbers as they were
    if optimizer == "gauss-newton" and isinstance(flow, PrimedFlow):
        return _of_primed(system, domain, flow, given)
    if optimizer == "gauss-newton" and isinstance(flow, SplitFlow):
        return _of_split(system, domain, flow, given)
    return _of_gradients(system, domain, kind, flow, optimizer, given)


def check_fit(given: dict[str, Any]) -> None:
    """Raise if the fit of a new primed flow cannot be as the arguments of `train` say."""
    if given["optimizer"] in (None, "gauss-newton"):
        _table_config(given, None)


def _table_config(given: dict[str, Any], handed: Labelled | None) -> TableConfig:
    what, loss = "optimizer 'gauss-newton' for primed flows", given["loss"]
    refuse_options(given, NOT_OF_SEARCHES, what)
    if loss is None:
        refuse_options(given, OF_LOSSES, f"{what} without a `loss`")
    names = ("points", "steps", "restarts", "label_times", "frozen_weight", "energy_weight", "matching_times")
    return TableConfig(
        **_chosen(given, (*names, "seed", "reference_states")),
        **_weights("labels" if loss is None else loss, given),
        data=None if handed is None else digest(handed),
    )


def _of_primed(system: HamiltonianSystem, domain: Domain, flow: PrimedFlow, given: dict[str, Any]) -> GaussNewtonRun:
    handed = None if given["data"] is None else labels_of(given["data"], system, flow.dt)
    config = _table_config(given, handed)
    return GaussNewtonRun.start(flow, system, domain, _scaling(domain, flow.dt, config.seed), config, handed)


def _of_split(system: HamiltonianSystem, domain: Domain, flow: SplitFlow, given: dict[str, Any]) -> SplitRun:
    if given["loss"] not in (None, "labels"):
        raise ValueError(f"`loss` {given['loss']!r} is not one that Gauss–Newton fits split flows by: use 'labels'.")
    others = (*NOT_OF_SEARCHES, *OF_LOSSES, "data", "energy_weight")
    refuse_options(given, others, "optimizer 'gauss-newton' for split flows")
    names = ("points", "steps", "restarts", "label_times", "frozen_weight", "seed", "reference_states")
    return SplitRun.start(flow, system, domain, SplitConfig(**_chosen(given, names)))


def _of_gradients(
    system: HamiltonianSystem,
    domain: Domain,
    kind: str,
    flow: FlowMap | None,
    optimizer: str,
    given: dict[str, Any],
) -> Run:
    refuse_options(given, OF_SEARCHES, f"optimizer {optimizer!r} for flows of kind {kind!r}")
    if optimizer != "adam":
        refuse_options(given, OF_GRADIENTS, f"optimizer {optimizer!r}")
    names = ("residual_weight", "matching_weight", "label_weight")
    weights = {n: given[n] for n in names} if given["loss"] is None else _weights(given["loss"], given)
    if kind == "mlp" and weights["matching_weight"]:
        raise ValueError("`matching_weight` needs a Hamiltonian, which an MLP flow has not: leave it out.")
    dt = flow.dt if flow is not None else 1.0 if given["dt"] is None else float(given["dt"])
    labels = None if given["data"] is None else labels_of(given["data"], system, dt)
    if weights["matching_weight"] is None:
        weights["matching_weight"] = 0.0 if kind == "mlp" or optimizer == "gauss-newton" else 1.0
    if weights["label_weight"] is None:
        weights["label_weight"] = 0.0 if labels is None else 1.0
    own = ["steps", "points", "refresh", "validate_every", "checkpoint_every", "matching_times", "label_times", "seed"]
    own += ["validation_points", "reference_states", *OF_GRADIENTS]
    choices = {**{name: given[name] for name in own}, **weights}
    if choices["label_times"] is None:
        del choices["label_times"]
    config = TrainingConfig.of(optimizer, data=None if labels is None else digest(labels), **choices)
    scaling = _scaling(domain, dt, config.seed)
    if flow is None:
        flow = new_network(system, kind, dt, scaling, given)
    return Run.start(flow.requires_grad_(True), system, domain, scaling, config, labels)


def _weights(loss: str, given: dict[str, Any]) -> dict[str, Any]:
    names = ("residual_weight", "matching_weight", "label_weight")
    if given["data"] is not None and isinstance(loss, str) and "labels" not in loss.split("+"):
        raise ValueError(
            f"`data` has labels, which `loss` {loss!r} does not use: add +labels to it, or leave `data` out."
        )
    return dict(zip(names, weights_of(loss, *(given[name] for name in names)), strict=True))


def _chosen(given: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: given[name] for name in names if given[name] is not None}


def _scaling(domain: Domain, dt: float, seed: int) -> Scaling:
    return Scaling.of_samples(states(domain, SCALING_SAMPLES, seed, Stream.SCALING), dt)
