"""The fit of a network, or of any other flow, by losses at points: steps of an optimizer, validated at intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from sympflow.flow.flow_map import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.losses import Loss, Objective
from sympflow.training.optimizers import Optimizer, optimizer
from sympflow.training.options import LossOptions
from sympflow.training.points import BLOCK, Labelled, Labels, Points, PointSource, Stream, parted, states
from sympflow.training.runs import INTERRUPTED, OUT_OF_TIME, Advance, Run
from sympflow.training.session import Session


@dataclass
class LossRun(Run):
    """The state of such a fit, and what acts on it.

    Attributes
    ----------
    held_out, reference
        Points of the losses that are never trained on; states, and where the exact flow takes them in Δt.
    step : int
        Steps taken.
    best : dict
        The weights with the least held-out loss so far.
    """

    scaling: Scaling
    options: LossOptions
    loss: Loss
    source: PointSource
    held_out: Points
    reference: tuple[Tensor, Tensor]
    optimizer: Optimizer
    step: int = 0
    best: dict[str, Tensor] = field(default_factory=dict)
    ended: bool = field(default=False, init=False)
    reason: str | None = field(default=None, init=False)

    UNIT: ClassVar[str] = "steps"

    @classmethod
    def start(
        cls,
        flow: FlowMap,
        system: HamiltonianSystem,
        domain: Domain,
        scaling: Scaling,
        options: LossOptions,
        data: Labelled | None = None,
    ) -> LossRun:
        """A run of a flow with fresh points; labels are made where they have a weight and none are handed in."""
        loss = Loss(system, scaling, options.residual_weight, options.matching_weight, options.label_weight)
        labels = unseen = None
        if options.label_weight:
            labels, unseen = _labels(system, domain, flow.dt, options) if data is None else parted(data, options.seed)
        common = (options.matching_times, options.seed, flow.dtype, flow.device)
        block = 1 if options.refresh is None else BLOCK
        source = PointSource(domain, flow.dt, options.points, *common, block=block, labels=labels)
        streams = (Stream.VALIDATION, Stream.VALIDATION)
        held_out = PointSource(
            domain, flow.dt, options.validation_points, *common, streams=streams, block=1, labels=unseen
        )(0)
        start = states(domain, options.reference_states, options.seed, Stream.REFERENCE)
        end = reference_step(system, start, flow.dt)
        exists = np.isfinite(end).all(-1)
        x, y = (torch.as_tensor(a[exists], dtype=flow.dtype, device=flow.device) for a in (start, end))
        return cls(flow, system, domain, scaling, options, loss, source, held_out, (x, y), optimizer(flow, options))

    @property
    def done(self) -> int:
        return self.step

    @property
    def planned(self) -> int:
        return self.options.steps

    def begin(self, session: Session) -> None:
        if self.history:
            return
        self._validate()
        if not math.isfinite(self.history[0]["loss"]):
            raise FloatingPointError(
                "The loss is not finite at the first validation: the system's H or its gradient is not finite "
                "on the domain, or the flow leaves it; shrink `domain` or `dt`."
            )

    def over(self, session: Session) -> bool:
        return self.ended

    def advance(self, session: Session) -> Advance:
        options = self.options
        index = 0 if options.refresh is None else self.step // options.refresh
        value = self.optimizer.step(self.step, Objective(self.loss, self.flow, self.source(index), index))
        self.step += 1
        if not math.isfinite(value):
            self.ended, self.reason = True, f"the loss was not finite at step {self.step}: lower `learning_rate`"
            return Advance(value, None, False)
        last = self.step == options.steps or (options.refresh is None and self.optimizer.finished is not None)
        self.ended = last or session.spent()
        if self.ended and not last:
            self.reason = OUT_OF_TIME
        figures = self._validate() if self.ended or self.step % options.validate_every == 0 else None
        return Advance(value, figures, self.ended or self.step % options.checkpoint_every == 0)

    def end(self, session: Session) -> str | None:
        return INTERRUPTED if session.interruption.asked else self.reason

    def achieved(self) -> dict[str, float]:
        """The figures of the best state, which the flow takes over."""
        self.flow.load_state_dict(self.best)
        return self._best_figures()

    def remarks(self, reason: str | None) -> dict[str, Any]:
        return {
            "steps_taken": self.step,
            "ended_early": reason,
            "finished": self.optimizer.finished,
            "best_step": self._best_figures()["step"],
        }

    def kept(self) -> dict[str, Any]:
        return {"best": self.best, "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        self.flow.load_state_dict(state["flow"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.best = {name: state["best"][name].to(self.flow.device) for name in self.flow.state_dict()}
        self.step = state["step"]

    def _validate(self) -> dict[str, float]:
        figures = {"step": self.step, **self._figures()}
        if math.isfinite(figures["loss"]) and figures["loss"] < min(self._losses(), default=math.inf):
            self.best = {name: value.detach().clone() for name, value in self.flow.state_dict().items()}
        self.history.append(figures)
        return figures

    @torch.no_grad()
    def _figures(self) -> dict[str, float]:
        """Losses on the held-out points; mean and largest ‖ψ̄_Δt(x) − φ_H,Δt(x)‖ over the held-out states."""
        terms = self.loss.terms(self.flow, self.held_out)
        figures = {"loss": float(self.loss.total(terms))}
        for name, term in zip(("residual_loss", "matching_loss", "label_loss"), terms, strict=True):
            if term is not None:
                figures[name] = float(term)
        x, y = self.reference
        if len(x):
            error = torch.linalg.vector_norm(self.flow.psi(self.flow.dt, x) - y, dim=-1)
            figures |= {"one_step_error": float(error.mean()), "one_step_error_max": float(error.max())}
        return figures

    def _losses(self) -> list[float]:
        return [figures["loss"] for figures in self.history if math.isfinite(figures["loss"])]

    def _best_figures(self) -> dict[str, float]:
        return min((f for f in self.history if math.isfinite(f["loss"])), key=lambda f: f["loss"])


def _labels(system: HamiltonianSystem, domain: Domain, dt: float, options: LossOptions) -> tuple[Labelled, Labelled]:
    """Labels to train on, and held-out ones, at equidistant times."""
    t = dt * np.arange(1, options.label_times + 1) / options.label_times
    unseen = max(1, options.validation_points // options.label_times)
    sets = []
    for n, stream in ((options.points, Stream.LABELS), (unseen, Stream.VALIDATION)):
        labels = Labels.needed(system, states(domain, n, options.seed, stream), t)
        x = np.broadcast_to(labels.x, labels.y.shape).reshape(-1, labels.x.shape[1])
        sets.append((np.repeat(t, len(labels.x)), x, labels.y.reshape(x.shape)))
    return sets[0], sets[1]
