"""train(): from a Hamiltonian system to a flow, without data."""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from sympflow.domain import Domain, EnergySublevel
from sympflow.flow.base import FlowMap
from sympflow.flow.mlp import MLPFlow, matching_widths
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.system import HamiltonianSystem
from sympflow.training.collocation import Stream, states
from sympflow.training.config import TrainingConfig
from sympflow.training.gauss_newton import GaussNewtonConfig, GaussNewtonRun
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
    optimizer: str = "adam",
    steps: int | None = None,
    points: int | None = None,
    residual_weight: float = 1.0,
    matching_weight: float | None = None,
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
    """Train a flow map of `system` on [0, dt] by its residual and by Hamiltonian matching, or by labels.

    Any system will do, separable or not: a SympFlow with MLP potentials is symplectic all the same. For a separable
    symbolic one, optimizer="gauss-newton" fits a primed flow (`SympFlow.primed`) to the exact flow in seconds.

    Parameters
    ----------
    system : HamiltonianSystem
    dt : float, optional
        Δt, the longest time of the map; the default is 1, or that of `flow`.
    kind : {"sympflow", "mlp"}, optional
        The architecture: a SympFlow (the default) or the unconstrained baseline with as many parameters as the
        SympFlow that `pairs` and `hidden` describe.
    pairs, hidden, activation, dtype, device
        Of a new flow, see `SympFlow`; the defaults are 3, (10, 10), "tanh" and float64 on the CPU.
    flow : FlowMap, optional
        Train a copy of this flow further (a second stage, say, with another optimizer) in place of a new one.
    domain : Domain, optional
        Ω; the default is that of the system.
    optimizer, steps, points, residual_weight, matching_weight, matching_times, learning_rate, schedule, clip, refresh,
    seed, validate_every, validation_points, reference_states, checkpoint_every
        See `TrainingConfig`. What is left out gets the optimizer's own default: 20,000 steps on 700 fresh points
        for Adam, 200 on 4000 fixed points for BFGS. A baseline has no Hamiltonian, so its matching weight is 0.
    restarts, label_times, frozen_weight
        Only for "gauss-newton", which takes of those above `steps`, `points`, `seed` and `reference_states`: see
        `GaussNewtonConfig`.
    checkpoint : path, optional
        Write the state of the run there every `checkpoint_every` steps, atomically.
    resume : path, optional
        Go on from this checkpoint, given the same arguments otherwise; the weights end bit-identical to those of a
        run that was not interrupted.
    time_budget : float, optional
        Stop after so many seconds.
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
    FloatingPointError
        If the loss is not finite from the start.
    """
    given = dict(locals())
    domain = _domain(system, domain)
    if time_budget is not None and not 0 < time_budget < math.inf:
        raise ValueError(f"`time_budget` must be a positive number of seconds; got {time_budget!r}.")
    new = {"kind": kind, "pairs": pairs, "hidden": hidden, "activation": activation, "dtype": dtype, "device": device}
    if flow is not None:
        if not isinstance(flow, FlowMap):
            raise TypeError(f"`flow` must be a SympFlow or an MLPFlow; got {flow!r}: leave it out for a new one.")
        for name, value in new.items():
            if value is not None:
                raise ValueError(f"`{name}` describes a new flow, but `flow` is given: leave out one of them.")
        if dt is not None and dt != flow.dt:
            raise ValueError(f"`dt` is {dt!r} but the flow has {flow.dt!r}: leave `dt` out to train it further.")
        dt, kind = flow.dt, flow.kind
        flow.check_system(system)
    dt, kind = 1.0 if dt is None else dt, "sympflow" if kind is None else kind
    if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 < dt < math.inf:
        raise ValueError(f"`dt` must be a positive finite number; got {dt!r}.")
    if kind not in ("sympflow", "mlp"):
        raise ValueError(f"`kind` {kind!r} is unknown: choose sympflow or mlp.")
    of_labels = {"restarts": restarts, "label_times": label_times, "frozen_weight": frozen_weight}
    if optimizer == "gauss-newton":
        _refuse_options(given, _NOT_GAUSS_NEWTON, optimizer)
        choices: dict[str, Any] = {"points": points, "steps": steps, **of_labels}
        choices = {name: value for name, value in choices.items() if value is not None}
        labelled = GaussNewtonConfig(seed=seed, reference_states=reference_states, **choices)
        if flow is None:
            flow = SympFlow.primed(system, dt=float(dt), dtype=torch.float64 if dtype is None else dtype, device=device)
        if not isinstance(flow, PrimedFlow) or flow.dtype != torch.float64:
            raise TypeError(
                "`optimizer` 'gauss-newton' fits primed flows in float64: pass flow=SympFlow.primed(system, dt=...)."
            )
        flow = copy.deepcopy(flow).bound(system)
        flow.certified = None
        scaling = Scaling.of_samples(states(domain, SCALING_SAMPLES, seed, Stream.SCALING), flow.dt)
        search = GaussNewtonRun.start(flow, system, domain, scaling, labelled)
        if resume is not None:
            search.load(resume)
        return search.finish(search.go(checkpoint, time_budget, progress, callback))
    _refuse_options(given, tuple(of_labels), optimizer)
    if kind == "mlp" and matching_weight:
        raise ValueError("`matching_weight` needs a Hamiltonian, which an MLP flow has not: leave it out.")
    config = TrainingConfig.of(
        optimizer,
        steps=steps,
        points=points,
        refresh=refresh,
        validate_every=validate_every,
        checkpoint_every=checkpoint_every,
        residual_weight=residual_weight,
        matching_weight=matching_weight if matching_weight is not None else 0.0 if kind == "mlp" else 1.0,
        matching_times=matching_times,
        learning_rate=learning_rate,
        schedule=schedule,
        clip=clip,
        seed=seed,
        validation_points=validation_points,
        reference_states=reference_states,
    )
    scaling = Scaling.of_samples(states(domain, SCALING_SAMPLES, seed, Stream.SCALING), float(dt))
    if flow is None:
        flow = SympFlow(
            system.ndof,
            3 if pairs is None else pairs,
            (10, 10) if hidden is None else hidden,
            "tanh" if activation is None else activation,
            float(dt),
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
    flow = copy.deepcopy(flow).requires_grad_(True)
    flow.certified = None  # of the weights as they were
    run = Run.start(flow, system, domain, scaling, config)
    if resume is not None:
        run.load(resume)
    return run.finish(run.go(checkpoint, time_budget, progress, callback))


_NOT_GAUSS_NEWTON = (
    "kind",
    "pairs",
    "hidden",
    "activation",
    "residual_weight",
    "matching_weight",
    "matching_times",
    "learning_rate",
    "schedule",
    "clip",
    "refresh",
    "validate_every",
    "validation_points",
    "checkpoint_every",
)


def _refuse_options(given: dict[str, Any], names: Sequence[str], optimizer: str) -> None:
    """Raise if one of the named arguments of `train` has another value than its default."""
    defaults = inspect.signature(train).parameters
    for name in names:
        if given[name] != defaults[name].default:
            raise TypeError(f"`{name}` is not an option of the optimizer {optimizer!r}: leave it out.")


def _domain(system: HamiltonianSystem, domain: Domain | None) -> Domain:
    domain = system.domain if domain is None else domain
    if domain is None:
        raise ValueError(
            f"`domain` is not known for the system {system.name!r}: pass the states to train on, as by "
            "domain=sympflow.Box(low, high), sympflow.Ball(center, radius) or sympflow.EnergySublevel(energy, box)."
        )
    if not isinstance(domain, Domain):
        raise TypeError(
            f"`domain` must be a domain of phase space; got {domain!r}: use sympflow.Box(low, high), "
            "sympflow.Ball(center, radius) or sympflow.EnergySublevel(energy, box)."
        )
    if isinstance(domain, EnergySublevel):
        domain = domain.attach(system.hamiltonian)
    width = domain.sample(1, 0).shape[-1]
    if width != 2 * system.ndof:
        raise ValueError(f"`domain` has states of length {width}, the system {2 * system.ndof}: give [q, p].")
    return domain
