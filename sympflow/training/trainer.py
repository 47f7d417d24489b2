"""train(): from a Hamiltonian system to a flow, without data."""

from __future__ import annotations

import copy
import inspect
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from numpy.typing import ArrayLike

from sympflow.domain import Domain
from sympflow.flow.base import FlowMap
from sympflow.flow.mlp import MLPFlow, matching_widths
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.system import HamiltonianSystem
from sympflow.training.arguments import digest, domain_for, labels_of, weights_of
from sympflow.training.collocation import Stream, states
from sympflow.training.config import TrainingConfig
from sympflow.training.gauss_newton import GaussNewtonConfig, GaussNewtonRun
from sympflow.training.recipes import BUDGET, default_recipe
from sympflow.training.run import Path, Run

SCALING_SAMPLES = 4096


def train(
    system: HamiltonianSystem,
    dt: float | None = None,
    *,
    kind: str | None = None,
    flow: FlowMap | None = None,
    domain: Domain | None = None,
    pairs: int | None = None,
    hidden: Sequence[int] | None = None,
    activation: str | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
    stages: int | None = None,
    processor: int | None = None,
    optimizer: str | None = None,
    loss: str | None = None,
    steps: int | None = None,
    points: int | None = None,
    residual_weight: float = 1.0,
    matching_weight: float | None = None,
    label_weight: float | None = None,
    data: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    matching_times: int = 10,
    learning_rate: float = 5e-3,
    schedule: str = "one-cycle",
    clip: float | None = 1.0,
    refresh: int | None = None,
    seed: int = 0,
    validate_every: int | None = None,
    validation_points: int = 2000,
    reference_states: int = 100,
    restarts: int | None = None,
    label_times: int | None = None,
    frozen_weight: float | None = None,
    checkpoint: Path | None = None,
    checkpoint_every: int | None = None,
    resume: Path | None = None,
    time_budget: float | None = None,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
) -> Any:
    """Train a flow map of `system` on [0, dt]: with nothing else given, the best that is known for it.

    For a separable symbolic system with T = ½ pᵀM⁻¹p that is a primed flow (`SympFlow.primed`), whose few numbers are
    fitted to the exact flow in seconds. For any other it is a SympFlow with MLP potentials, symplectic for every H,
    trained by Adam on its residual and by Hamiltonian matching, without data.

    Parameters
    ----------
    system : HamiltonianSystem
    dt : float, optional
        Δt, the longest time of the map; the default is that of `flow`, for a new primed flow what suits the system's
        frequencies on Ω (see `sympflow.training.recipes`), else 1.
    kind : {"primed", "sympflow", "mlp"}, optional
        The architecture: a SympFlow primed with the system's V and T; one with MLP potentials; or the unconstrained
        baseline with as many parameters as the SympFlow that `pairs` and `hidden` describe. The default is "primed"
        for the systems above, unless an option says that it is to be a network.
    flow : FlowMap, optional
        Train a copy of this flow further (a second stage, say, with another optimizer) in place of a new one.
    domain : Domain, optional
        Ω; the default is that of the system.
    stages, processor
        Of a new primed flow, see `SympFlow.primed`; the defaults are 3 kicks, or as many as a given `dt` needs, and a
        processor of 6.
    pairs, hidden, activation, dtype, device
        Of a new network, see `SympFlow`; the defaults are 3, (10, 10), "tanh" and float64 on the CPU.
    optimizer : {"gauss-newton", "adam", "bfgs", "lbfgs"}, optional
        The default is "gauss-newton" for primed flows, "adam" for networks, which "gauss-newton" trains far better.
    steps, points, residual_weight, matching_weight, label_weight, matching_times, learning_rate, schedule, clip,
    refresh, seed, validate_every, validation_points, reference_states, checkpoint_every
        See `TrainingConfig`. What is left out gets the optimizer's own default: 20,000 steps on 700 fresh points
        for Adam, at most 200 on 1500 fixed points for Gauss–Newton. A baseline has no Hamiltonian, so its matching
        weight is 0; Gauss–Newton leaves matching out as well, unless it is given a weight.
    data : (array (n,), array (n, 2d), array (n, 2d)), optional
        Labels of a network: times in [0, dt], states, and where the exact flow takes them; a tenth is held out.
        `label_weight` is then 1. Without data, labels are made where `label_weight` is given.
    loss : str, optional
        Some of "residual", "matching" and "labels", joined by "+": those that are left out get the weight 0. The
        default is "labels" for primed flows with optimizer="gauss-newton", else what the weights say.
    restarts, label_times, frozen_weight
        Of "gauss-newton" on a primed flow, which takes of those above `steps`, `points`, `seed` and
        `reference_states`: see `GaussNewtonConfig`. `label_times` counts for a network's `label_weight` too.
    checkpoint : path, optional
        Write the state of the run there every `checkpoint_every` steps, atomically.
    resume : path, optional
        Go on from this checkpoint, given the same arguments otherwise; the weights end bit-identical to those of a
        run that was not interrupted.
    time_budget : float, optional
        Stop after so many seconds. The default for a new primed flow is 60, unless `restarts`, `steps` or `resume` is
        given: the search then takes fewer starts than it might, which the recipe records; else there is none.
    progress : bool, optional
        Show a progress bar; the default is on a terminal only.
    callback : callable, optional
        callback(step, figures) after each validation; `figures` has the held-out losses and one-step error.

    Returns
    -------
    SympFlow or MLPFlow
        In its best state by the held-out loss, its parameters without gradient; `recipe` and `figures` tell how it
        was made and what it achieves, `history` the held-out figures over the run. Ctrl-C, a used-up budget and a
        loss that is not finite also end the run with the best state so far; the last two and the first warn.

    Raises
    ------
    ValueError
        If the system has no domain and none is given, or an argument is not admissible.
    TypeError
        If an option is not one of the optimizer's.
    FloatingPointError
        If the loss is not finite from the start.
    """
    given, begin = dict(locals()), time.perf_counter()
    domain = domain_for(system, domain)
    if time_budget is not None and not 0 < time_budget < math.inf:
        raise ValueError(f"`time_budget` must be a positive number of seconds; got {time_budget!r}.")
    new = {
        "kind": kind,
        "stages": stages,
        "processor": processor,
        "pairs": pairs,
        "hidden": hidden,
        "activation": activation,
        "dtype": dtype,
        "device": device,
    }
    if flow is not None:
        if not isinstance(flow, FlowMap):
            raise TypeError(f"`flow` must be a SympFlow or an MLPFlow; got {flow!r}: leave it out for a new one.")
        for name, value in new.items():
            if value is not None:
                raise ValueError(f"`{name}` describes a new flow, but `flow` is given: leave out one of them.")
        if dt is not None and dt != flow.dt:
            raise ValueError(f"`dt` is {dt!r} but the flow has {flow.dt!r}: leave `dt` out to train it further.")
        dt, kind = flow.dt, "primed" if isinstance(flow, PrimedFlow) else flow.kind
        flow.check_system(system)
    if dt is not None and (isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 < dt < math.inf):
        raise ValueError(f"`dt` must be a positive finite number; got {dt!r}.")
    kind = _kind(system, given) if kind is None else kind
    if kind not in KINDS:
        raise ValueError(f"`kind` {kind!r} is unknown: choose one of {', '.join(KINDS)}.")
    if flow is None:
        for name in _OF_NETWORKS if kind == "primed" else ("stages", "processor"):
            if new[name] is not None:
                raise TypeError(f"`{name}` is not an option of flows of kind {kind!r}: leave it out.")
    optimizer = ("gauss-newton" if kind == "primed" else "adam") if optimizer is None else optimizer
    hurried = flow is None and time_budget is None and restarts is None and steps is None and resume is None
    if flow is None and kind == "primed":
        flow = _primed(system, domain, dt, stages, processor, dtype, device)
    dt = flow.dt if flow is not None else 1.0 if dt is None else float(dt)
    single = dtype not in (None, torch.float64) or (flow is not None and flow.dtype != torch.float64)
    if optimizer == "gauss-newton" and single:
        raise TypeError("`optimizer` 'gauss-newton' fits flows in float64: leave out `dtype`, or use 'adam'.")
    if loss is not None or (kind == "primed" and optimizer == "gauss-newton"):
        weights = weights_of("labels" if loss is None else loss, residual_weight, matching_weight, label_weight)
        residual_weight, matching_weight, label_weight = weights
    if optimizer == "gauss-newton" and kind == "primed":
        _refuse_options(given, _NOT_OF_TABLES, f"optimizer {optimizer!r} for primed flows")
        if loss is None:
            _refuse_options(given, _OF_LOSSES, f"optimizer {optimizer!r} for primed flows without a `loss`")
        handed = None if data is None else labels_of(data, system, dt)
        choices: dict[str, Any] = {
            "points": points,
            "steps": steps,
            "restarts": restarts,
            "label_times": label_times,
            "frozen_weight": frozen_weight,
            "residual_weight": residual_weight,
            "matching_weight": matching_weight,
            "label_weight": label_weight,
            "matching_times": matching_times,
            "data": None if handed is None else digest(handed),
        }
        choices = {name: value for name, value in choices.items() if value is not None}
        labelled = GaussNewtonConfig(seed=seed, reference_states=reference_states, **choices)
        assert isinstance(flow, PrimedFlow)
        flow = copy.deepcopy(flow).bound(system)
        flow.certified = None  # of the numbers as they were
        scaling = Scaling.of_samples(states(domain, SCALING_SAMPLES, seed, Stream.SCALING), flow.dt)
        search = GaussNewtonRun.start(flow, system, domain, scaling, labelled, handed)
        if resume is not None:
            search.load(resume)
        if hurried:  # labels and their compilation are part of the minute
            time_budget = max(BUDGET - (time.perf_counter() - begin), 1.0)
        return search.finish(search.go(checkpoint, time_budget, progress, callback), expected=hurried)
    _refuse_options(given, _OF_TABLES, f"optimizer {optimizer!r} for flows of kind {kind!r}")
    if optimizer != "adam":
        _refuse_options(given, ("learning_rate", "schedule", "clip"), f"optimizer {optimizer!r}")
    if kind == "mlp" and matching_weight:
        raise ValueError("`matching_weight` needs a Hamiltonian, which an MLP flow has not: leave it out.")
    labels = None if data is None else labels_of(data, system, dt)
    if matching_weight is None:
        matching_weight = 0.0 if kind == "mlp" or optimizer == "gauss-newton" else 1.0
    config = TrainingConfig.of(
        optimizer,
        steps=steps,
        points=points,
        refresh=refresh,
        validate_every=validate_every,
        checkpoint_every=checkpoint_every,
        residual_weight=residual_weight,
        matching_weight=matching_weight,
        label_weight=(0.0 if data is None else 1.0) if label_weight is None else label_weight,
        matching_times=matching_times,
        label_times=8 if label_times is None else label_times,
        data=None if labels is None else digest(labels),
        learning_rate=learning_rate,
        schedule=schedule,
        clip=clip,
        seed=seed,
        validation_points=validation_points,
        reference_states=reference_states,
    )
    scaling = Scaling.of_samples(states(domain, SCALING_SAMPLES, seed, Stream.SCALING), dt)
    if flow is None:
        flow = SympFlow(
            system.ndof,
            3 if pairs is None else pairs,
            (10, 10) if hidden is None else hidden,
            "tanh" if activation is None else activation,
            dt,
            torch.float64 if dtype is None else dtype,
            device,
            seed,
            scaling,
        )
        if kind == "mlp":
            if matching_widths(flow.ndof, flow.n_parameters) is None:
                raise ValueError(
                    f"`hidden` and `pairs` describe a SympFlow of only {flow.n_parameters} parameters, which no "
                    "MLPFlow matches within 2 %: give wider layers or more pairs."
                )
            flow = MLPFlow.matching(flow, seed, scaling, "tanh" if activation is None else activation)
    flow = copy.deepcopy(flow).bound(system).requires_grad_(True)
    flow.certified = None  # of the weights as they were
    run = Run.start(flow, system, domain, scaling, config, labels)
    if resume is not None:
        run.load(resume)
    return run.finish(run.go(checkpoint, time_budget, progress, callback))


KINDS = ("primed", "sympflow", "mlp")
_OF_NETWORKS = ("pairs", "hidden", "activation")
_OF_TABLES = ("restarts", "frozen_weight")
_OF_LOSSES = ("residual_weight", "matching_weight", "label_weight", "matching_times")
_NOT_OF_TABLES = (
    "learning_rate",
    "schedule",
    "clip",
    "refresh",
    "validate_every",
    "validation_points",
    "checkpoint_every",
)


def _kind(system: HamiltonianSystem, given: dict[str, Any]) -> str:
    """The architecture that is meant where none is named."""
    if _given(given, ("stages", "processor", *_OF_TABLES)):
        return "primed"
    fits = system.separable and system.quadratic_kinetic and system.symbols is not None
    of_networks = (*_OF_NETWORKS, *_NOT_OF_TABLES, *((*_OF_LOSSES, "data") if given["loss"] is None else ()))
    wants_network = given["optimizer"] not in (None, "gauss-newton") or _given(given, of_networks)
    return "primed" if fits and not wants_network else "sympflow"


def _primed(
    system: HamiltonianSystem,
    domain: Domain,
    dt: float | None,
    stages: int | None,
    processor: int | None,
    dtype: torch.dtype | None,
    device: torch.device | str | None,
) -> PrimedFlow:
    """A new primed flow: what is not given is as `default_recipe` has it, Δt in proportion to the kicks."""
    recipe = None
    if system.separable and (dt is None or stages is None or processor is None):
        recipe = default_recipe(system, domain, dt)
        if dt is None:
            dt = recipe.dt if stages is None else float(f"{recipe.dt * stages / recipe.stages:.3g}")
        stages = recipe.stages if stages is None else stages
        processor = recipe.processor if processor is None else processor
    return SympFlow.primed(
        system,
        stages,
        dt=1.0 if dt is None else float(dt),
        processor=0 if processor is None else processor,
        dtype=torch.float64 if dtype is None else dtype,
        device=device,
    )


def _given(given: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Those of the named arguments of `train` that have another value than their default."""
    defaults = inspect.signature(train).parameters
    return [
        name for name in names if given[name] is not defaults[name].default and given[name] != defaults[name].default
    ]


def _differs(value: Any, default: Any) -> bool:
    return value is not default and (default is None or value != default)


def _refuse_options(given: dict[str, Any], names: Sequence[str], what: str) -> None:
    for name in _given(given, names):
        raise TypeError(f"`{name}` is not an option of the {what}: leave it out.")
