"""Run: the state of a training run, its loop, its checkpoints and its end."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from sympflow.flow.base import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.collocation import PointSource, Stream, states, stream_seed
from sympflow.training.config import TrainingConfig
from sympflow.training.labels import Labels
from sympflow.training.losses import Loss, Objective
from sympflow.training.optimizers import optimizer as make_optimizer
from sympflow.training.outcome import INTERRUPTED, OUT_OF_TIME, recorded, warn_of_early_end
from sympflow.training.progress import progress as make_progress
from sympflow.training.validation import Validation

Path = str | os.PathLike[str]
Labelled = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Times (n,), states (n, 2d), and where the flow takes them (n, 2d)."""

HELD_OUT_SHARE = 0.1  # of the labels that are handed in


@dataclass
class Run:
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
        data: Labelled | None = None,
    ) -> Run:
        loss = Loss(system, scaling, config.residual_weight, config.matching_weight, config.label_weight)
        labels = unseen = None
        if config.label_weight:
            labels, unseen = _labels(system, domain, flow.dt, config) if data is None else _parted(data, config.seed)
        common = (flow.dt, config.points, config.matching_times, config.seed, flow.dtype, flow.device)
        source = PointSource(domain, *common, block=1 if config.refresh is None else 32, labels=labels)
        held_out = PointSource(
            domain,
            flow.dt,
            config.validation_points,
            *common[2:],
            streams=(Stream.VALIDATION, Stream.VALIDATION),
            block=1,
            labels=unseen,
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
                    value = self.optimizer.step(self.step, Objective(self.loss, flow, self.source(index), index))
                    self.step += 1
                    self.seconds = before + time.perf_counter() - begin
                    if not math.isfinite(value):
                        return f"the loss was not finite at step {self.step}: lower `learning_rate`"
                    bar.advance(self.step, value)
                    last = self.step == config.steps or (config.refresh is None and self._finished() is not None)
                    spent = time_budget is not None and self.seconds - before > time_budget
                    if last or spent or self.step % config.validate_every == 0:
                        figures = self._validate()
                        bar.validated(self.step, figures)
                        if callback is not None:
                            callback(self.step, dict(figures))
                    if checkpoint is not None and (last or spent or self.step % config.checkpoint_every == 0):
                        self.save(checkpoint)
                    if last:
                        break
                    if spent:
                        return OUT_OF_TIME
        except KeyboardInterrupt:
            return INTERRUPTED
        return None

    def _finished(self) -> str | None:
        """Why the optimizer wants no more steps, if it does not."""
        return getattr(self.optimizer, "finished", None)

    def _validate(self) -> dict[str, float]:
        figures = {"step": self.step, **self.validation(self.flow)}
        if math.isfinite(figures["loss"]) and figures["loss"] < self._best_loss():
            self.best = {name: value.detach().clone() for name, value in self.flow.state_dict().items()}
        self.history.append(figures)
        return figures

    def _best_loss(self) -> float:
        return min((f["loss"] for f in self.history if math.isfinite(f["loss"])), default=math.inf)

    def finish(self, reason: str | None, expected: bool = False) -> FlowMap:
        """The flow in its best state, with its record; an expected end does not warn."""
        if reason is not None and not (expected and reason == OUT_OF_TIME):
            warn_of_early_end(reason, self.step, self.config.steps, "steps")
        self.flow.load_state_dict(self.best)
        best = min((f for f in self.history if math.isfinite(f["loss"])), key=lambda f: f["loss"])
        stage = {
            **self.config.to_dict(),
            "steps_taken": self.step,
            "ended_early": reason,
            "finished": self._finished(),
            "best_step": best["step"],
        }
        shape = (self.flow, self.system, self.domain, self.scaling)
        return recorded(*shape, stage, self.history, best, self.seconds)

    # checkpoints ------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        checkpoints.write(
            path,
            {
                **checkpoints.identity(self.flow, self.system, self.config.to_dict()),
                "step": self.step,
                "flow": self.flow.state_dict(),
                "best": self.best,
                "optimizer": self.optimizer.state_dict(),
                "history": self.history,
                "seconds": self.seconds,
            },
        )

    def load(self, path: Path) -> None:
        state = checkpoints.read_same(path, checkpoints.identity(self.flow, self.system, self.config.to_dict()))
        try:
            self.flow.load_state_dict(state["flow"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.best = {name: state["best"][name].to(self.flow.device) for name in self.flow.state_dict()}
        except (RuntimeError, KeyError, ValueError) as error:
            raise ValueError(f"`resume` {str(path)!r} does not fit the flow: start afresh.") from error
        self.step, self.seconds, self.history = state["step"], state["seconds"], state["history"]


def _labels(system: HamiltonianSystem, domain: Domain, dt: float, config: TrainingConfig) -> tuple[Labelled, Labelled]:
    """Labels to train on, and held-out ones, at equidistant times."""
    t = dt * np.arange(1, config.label_times + 1) / config.label_times
    unseen = max(1, config.validation_points // config.label_times)
    sets = []
    for n, stream in ((config.points, Stream.LABELS), (unseen, Stream.VALIDATION)):
        labels = Labels.of(system, states(domain, n, config.seed, stream), t)
        if not len(labels.x):
            raise ValueError("`domain` holds no states whose solution exists up to `dt`: shrink one of them.")
        x = np.broadcast_to(labels.x, labels.y.shape).reshape(-1, labels.x.shape[1])
        sets.append((np.repeat(t, len(labels.x)), x, labels.y.reshape(x.shape)))
    return sets[0], sets[1]


def _parted(data: Labelled, seed: int) -> tuple[Labelled, Labelled]:
    """Labels that were handed in: those to train on, and the held-out ones."""
    order = np.random.default_rng([stream_seed(seed, Stream.LABELS), 0]).permutation(len(data[0]))
    first = math.ceil(HELD_OUT_SHARE * len(order))
    t, x, y = data
    held, rest = order[:first], order[first:]
    return (t[rest], x[rest], y[rest]), (t[held], x[held], y[held])
