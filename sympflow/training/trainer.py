"""train(): from a Hamiltonian system to a flow, without data."""

from __future__ import annotations

import copy
import json
import math
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sympflow.domain import Domain, EnergySublevel
from sympflow.flow.base import FlowMap
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.collocation import PointSource, Stream, states
from sympflow.training.config import TrainingConfig
from sympflow.training.losses import Loss
from sympflow.training.optimizers import optimizer as make_optimizer
from sympflow.training.progress import progress as make_progress
from sympflow.training.validation import Validation

Path = str | os.PathLike[str]
SCALING_SAMPLES = 4096


def train(
    system: HamiltonianSystem,
    dt: float | None = None,
    *,
    kind: str = "sympflow",
    flow: FlowMap | None = None,
    domain: Domain | None = None,
    pairs: int = 3,
    hidden: Sequence[int] = (10, 10),
    activation: str = "tanh",
    dtype: torch.dtype = torch.float64,
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
    checkpoint: Path | None = None,
    checkpoint_every: int | None = None,
    resume: Path | None = None,
    time_budget: float | None = None,
    progress: bool | None = None,
    callback: Callable[[int, dict[str, float]], None] | None = None,
) -> Any:
    """Train a flow map of `system` on [0, dt] by its residual and by Hamiltonian matching.

    Any system will do, separable or not: a SympFlow with MLP potentials is symplectic all the same.

    Parameters
    ----------
    system : HamiltonianSystem
    dt : float, optional
        Δt, the longest time of the map; the default is 1, or that of `flow`.
    kind : {"sympflow", "mlp"}
        The architecture: a SympFlow of `pairs` pairs with potentials of `hidden` widths and `activation`, or the
        unconstrained baseline with as many parameters.
    flow : FlowMap, optional
        Train a copy of this flow further (a second stage, say, with another optimizer) in place of a new one.
    domain : Domain, optional
        Ω; the default is that of the system.
    dtype, device
        Of the flow.
    optimizer, steps, points, residual_weight, matching_weight, matching_times, learning_rate, schedule, clip, refresh,
    seed, validate_every, validation_points, reference_states, checkpoint_every
        See `TrainingConfig`. What is left out gets the optimizer's own default: 20,000 steps on 700 fresh points
        for Adam, 200 on 4000 fixed points for BFGS. A baseline has no Hamiltonian, so its matching weight is 0.
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
    domain = _domain(system, domain)
    if flow is None:
        dt = 1.0 if dt is None else dt
    elif dt is not None and dt != flow.dt:
        raise ValueError(f"`dt` is {dt!r} but the flow has {flow.dt!r}: leave `dt` out to train it further.")
    else:
        dt, kind = flow.dt, flow.kind
    if not (isinstance(dt, (int, float)) and 0 < dt < math.inf):
        raise ValueError(f"`dt` must be a positive finite number; got {dt!r}.")
    if kind not in ("sympflow", "mlp"):
        raise ValueError(f"`kind` {kind!r} is unknown: choose sympflow or mlp.")
    if kind == "mlp" and matching_weight:
        raise ValueError("`matching_weight` needs a Hamiltonian, which an MLP flow has not: leave it out.")
    if matching_weight is None:
        matching_weight = 0.0 if kind == "mlp" else 1.0
    adam = optimizer != "bfgs"
    config = TrainingConfig(
        optimizer=optimizer,
        steps=steps if steps is not None else 20_000 if adam else 200,
        points=points if points is not None else 700 if adam else 4000,
        residual_weight=residual_weight,
        matching_weight=matching_weight,
        matching_times=matching_times,
        learning_rate=learning_rate,
        schedule=schedule,
        clip=clip,
        refresh=refresh if refresh is not None else 1 if adam else None,
        seed=seed,
        validate_every=validate_every if validate_every is not None else 500 if adam else 5,
        validation_points=validation_points,
        reference_states=reference_states,
        checkpoint_every=checkpoint_every if checkpoint_every is not None else 1000 if adam else 5,
    )
    scaling = Scaling.of_samples(states(domain, SCALING_SAMPLES, seed, Stream.SCALING), float(dt))
    if flow is not None:
        flow.check_system(system)
        flow = copy.deepcopy(flow)
    else:
        flow = SympFlow(system.ndof, pairs, hidden, activation, float(dt), dtype, device, seed, scaling)
        if kind == "mlp":
            flow = MLPFlow.matching(flow, seed, scaling)
    flow.requires_grad_(True)
    run = _Run.start(flow, system, domain, scaling, config)
    if resume is not None:
        run.load(resume)
    reason = run.go(checkpoint, time_budget, progress, callback)
    return run.finish(reason)


def _domain(system: HamiltonianSystem, domain: Domain | None) -> Domain:
    domain = system.domain if domain is None else domain
    if domain is None:
        raise ValueError(
            f"`domain` is not known for the system {system.name!r}: pass the states to train on, as by "
            "domain=sympflow.Box(low, high), sympflow.Ball(center, radius) or sympflow.EnergySublevel(energy, box)."
        )
    if isinstance(domain, EnergySublevel):
        domain = domain.attach(system.hamiltonian)
    width = domain.sample(1, 0).shape[-1]
    if width != 2 * system.ndof:
        raise ValueError(f"`domain` has states of length {width}, the system {2 * system.ndof}: give [q, p].")
    return domain


@dataclass
class _Run:
    """The state of a run, and what acts on it."""

    flow: FlowMap
    system: HamiltonianSystem
    domain: Domain
    scaling: Scaling
    config: TrainingConfig
    loss: Loss
    validation: Validation
    source: PointSource
    optimizer: Any
    step: int = 0
    seconds: float = 0.0
    best: dict[str, Tensor] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)

    @classmethod
    def start(
        cls,
        flow: FlowMap,
        system: HamiltonianSystem,
        domain: Domain,
        scaling: Scaling,
        config: TrainingConfig,
    ) -> _Run:
        loss = Loss(system, scaling, config.residual_weight, config.matching_weight)
        common = (flow.dt, config.points, config.matching_times, config.seed, flow.dtype, flow.device)
        source = PointSource(domain, *common, block=1 if config.refresh is None else 32)
        held_out = PointSource(
            domain,
            flow.dt,
            config.validation_points,
            *common[2:],
            streams=(Stream.VALIDATION, Stream.VALIDATION),
            block=1,
        )
        x = states(domain, config.reference_states, config.seed, Stream.REFERENCE)
        validation = Validation(system, loss, held_out(0), x, flow.dt, flow)
        return cls(flow, system, domain, scaling, config, loss, validation, source, make_optimizer(flow, config))

    def go(
        self,
        checkpoint: Path | None,
        time_budget: float | None,
        progress: bool | None,
        callback: Callable[[int, dict[str, float]], None] | None,
    ) -> str | None:
        """Run to the end; why it ended early, if it did."""
        config, flow, begin = self.config, self.flow, time.perf_counter()
        before = self.seconds
        if not self.history:
            self._validate()
            if not math.isfinite(self.history[0]["loss"]):
                raise FloatingPointError(
                    "The loss is not finite at the first validation: the system's H or its gradient is not finite "
                    "on the domain, or the flow leaves it; shrink `domain` or `dt`."
                )
        try:
            with make_progress(progress, config.steps, f"{self.system.name} {flow.kind}", self.step) as bar:
                while self.step < config.steps:
                    index = 0 if config.refresh is None else self.step // config.refresh
                    points = self.source(index)
                    value = self.optimizer.step(self.step, lambda points=points: self.loss(flow, points))
                    self.step += 1
                    self.seconds = before + time.perf_counter() - begin
                    if not math.isfinite(value):
                        return f"the loss was not finite at step {self.step}: lower `learning_rate`"
                    bar.advance(self.step, value)
                    last = self.step == config.steps
                    spent = time_budget is not None and self.seconds - before > time_budget
                    if last or spent or self.step % config.validate_every == 0:
                        figures = self._validate()
                        bar.validated(self.step, figures)
                        if callback is not None:
                            callback(self.step, dict(figures))
                    if checkpoint is not None and (last or spent or self.step % config.checkpoint_every == 0):
                        self.save(checkpoint)
                    if spent and not last:
                        return "the time budget was used up"
        except KeyboardInterrupt:
            return "it was interrupted"
        return None

    def _validate(self) -> dict[str, float]:
        figures = {"step": self.step, **self.validation(self.flow)}
        if math.isfinite(figures["loss"]) and figures["loss"] < self._best_loss():
            self.best = {name: value.detach().clone() for name, value in self.flow.state_dict().items()}
        self.history.append(figures)
        return figures

    def _best_loss(self) -> float:
        return min((f["loss"] for f in self.history if math.isfinite(f["loss"])), default=math.inf)

    def finish(self, reason: str | None) -> FlowMap:
        """The flow in its best state, with its record."""
        if reason is not None:
            warnings.warn(
                f"Training ended after {self.step} of {self.config.steps} steps because {reason}. "
                "The best state so far is returned.",
                RuntimeWarning,
                stacklevel=3,
            )
        flow = self.flow
        flow.load_state_dict(self.best)
        flow.requires_grad_(False)
        flow.zero_grad(set_to_none=True)
        flow.domain, flow.fingerprint, flow.system_name = (
            self.domain,
            self.system.fingerprint,
            self.system.name,
        )
        best = min((f for f in self.history if math.isfinite(f["loss"])), key=lambda f: f["loss"])
        earlier = float(flow.figures.get("training_seconds", 0.0))
        stage = {
            **self.config.to_dict(),
            "steps_taken": self.step,
            "ended_early": reason,
            "best_step": best["step"],
        }
        flow.recipe = {
            "stages": [*flow.recipe.get("stages", []), stage],
            "scaling": self.scaling.to_dict(),
            "torch": torch.__version__,
        }
        flow.figures = {k: v for k, v in best.items() if k not in ("step", "loss")}
        flow.figures["training_seconds"] = round(earlier + self.seconds, 3)
        flow.history = self.history  # type: ignore[assignment]
        return flow

    # checkpoints ------------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        return {
            "config": json.dumps(self.config.to_dict()),
            "architecture": json.dumps({"kind": self.flow.kind, "dt": self.flow.dt, **self.flow.architecture()}),
            "fingerprint": list(self.system.fingerprint),
        }

    def save(self, path: Path) -> None:
        checkpoints.write(
            path,
            {
                **self._identity(),
                "step": self.step,
                "flow": self.flow.state_dict(),
                "best": self.best,
                "optimizer": self.optimizer.state_dict(),
                "history": self.history,
                "seconds": self.seconds,
            },
        )

    def load(self, path: Path) -> None:
        state, mine = checkpoints.read(path), self._identity()
        differing = self.config.differences(json.loads(state["config"]))
        if differing:
            raise ValueError(f"`resume` is a run with another {', '.join(differing)}: pass the same arguments as then.")
        for name in ("architecture", "fingerprint"):
            if state[name] != mine[name]:
                raise ValueError(f"`resume` is a run with another {name}: pass the same system and flow as then.")
        try:
            self.flow.load_state_dict(state["flow"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.best = {name: state["best"][name].to(self.flow.device) for name in self.flow.state_dict()}
        except (RuntimeError, KeyError, ValueError) as error:
            raise ValueError(f"`resume` {str(path)!r} does not fit the flow: start afresh.") from error
        self.step, self.seconds, self.history = state["step"], state["seconds"], state["history"]
