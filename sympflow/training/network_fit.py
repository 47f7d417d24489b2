"""The fit of a network, or of any other flow, by losses at points: steps of an optimizer, validated at intervals."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from sympflow.arguments import warn
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.flow.weights import check_memory
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.fits import Adam, Resolved, Solver
from sympflow.training.losses import Loss, Objective
from sympflow.training.optimizers import MEMORY, STEPS
from sympflow.training.points import (
    BLOCK,
    Labelled,
    Labels,
    Points,
    PointSource,
    Stream,
    parted,
    shares_missed,
    start_times,
    states,
    unlabelled,
)
from sympflow.training.runs import INTERRUPTED, LABEL_SHARE, OUT_OF_TIME, Advance, Run
from sympflow.training.session import Deadline, OutOfTime, Session

PROBE = 32  # held-out points whose time tells how many there is time for
VALIDATION_SHARE = 0.1  # of the time left, that a validation may take
BACKWARD = 2.0  # times what a point takes in a validation, that it takes in a step at least


class LossRun(Run):
    """The state of such a fit, and what acts on it."""

    scaling: Scaling
    step = 0
    ended = False
    reason: str | None = None
    step_seconds = 0.0

    UNIT: ClassVar[str] = "steps"

    def prepare(self, deadline: Deadline) -> None:
        """Draw fresh points."""
        flow, system, domain, fit, solver = self.flow, self.system, self.domain, self.fit, self.solver
        self.best: dict[str, Tensor] = {}
        self.optimizer = STEPS[solver.name](flow, solver)
        _check_memory(flow, fit, solver)
        data: Labelled | None = fit.data
        self.loss = Loss(system, self.scaling, fit.residual_weight, fit.matching_weight, fit.label_weight)
        labels = unseen = None
        if fit.label_weight:
            if data is None:
                labels, unseen = _labels(system, domain, flow.dt, fit, deadline.part(LABEL_SHARE))
            else:
                labels, unseen = parted(data, fit.seed)
            if not (fit.residual_weight or fit.matching_weight):
                self.unfitted = unlabelled((labels if data is None else data)[0], flow.dt)
        common = (fit.matching_times, fit.seed, flow.dtype, flow.device)
        block = 1 if solver.refresh is None else BLOCK
        self.source = PointSource(domain, flow.dt, fit.points, *common, block=block, labels=labels, system=system)
        streams = (Stream.VALIDATION, Stream.VALIDATION)
        self.held_out = PointSource(
            domain, flow.dt, fit.validation_points, *common, streams=streams, block=1, labels=unseen, system=system
        )(0)
        start = states(domain, fit.reference_states, fit.seed, Stream.REFERENCE)
        t0 = start_times(system, flow.dt, len(start), fit.seed, Stream.REFERENCE)
        try:
            end = reference_step(system, start, flow.dt, check=deadline.part(LABEL_SHARE).check, t0=t0)
        except OutOfTime:  # then the error of a step is not known
            end = np.full_like(start, np.nan)
            warn(
                f"There was no time to follow {len(start)} held-out states to dt = {flow.dt:g}: the one-step error of "
                "the flow is not known. Give a longer `time_budget`, a shorter `dt`, or fewer `reference_states`.",
                RuntimeWarning,
            )
        exists = np.isfinite(end).all(-1)
        known = (start, end) if t0 is None else (start, end, t0)
        self.reference = tuple(torch.as_tensor(a[exists], dtype=flow.dtype, device=flow.device) for a in known)
        self.tangents = flow.tangents() if self.optimizer.needs_residuals else None

    @property
    def done(self) -> int:
        return self.step

    @property
    def planned(self) -> int:
        return self.solver.steps

    def begin(self, session: Session) -> None:
        self.held_out = self._affordable(session.deadline)
        self.work_end = session.deadline
        if self.history:
            return
        began = session.passed
        self._validate()
        self.closing = session.passed - began
        self.work_end = session.deadline.before(self.closing)
        if self.work_end.end < math.inf:
            began = session.passed
            with torch.no_grad():
                self.loss.terms(self.flow, self.held_out)
            each = (session.passed - began) / len(self.held_out.residual[0])
            self.step_seconds = BACKWARD * each * max(self.fit.points - PROBE, 0)
        if not math.isfinite(self.history[0]["loss"]):
            raise FloatingPointError(
                "The loss is not finite at the first validation: the system's H or its gradient is not finite "
                "on the domain, or the flow leaves it; shrink `domain` or `dt`."
            )

    def over(self, session: Session) -> bool:
        if self.step == 0 and not self._fits():
            self.ended, self.reason = True, OUT_OF_TIME
            if not session.cut:
                self.reason = f"a step takes about {self.step_seconds:.2g} s, for which the time budget is too short"
        return self.ended

    def _fits(self) -> bool:
        """Return whether there is time for another step; those of Adam are one piece, others can be cut."""
        in_time = not isinstance(self.solver, Adam) or self.step_seconds <= self.work_end.left
        return not self.work_end.over() and in_time

    def advance(self, session: Session) -> Advance:
        solver = self.solver
        index = 0 if solver.refresh is None else self.step // solver.refresh
        began = session.passed
        objective = Objective(self.loss, self.flow, self.source(index), index, self.work_end.check, self.tangents)
        try:
            value = self.optimizer.step(self.step, objective)
        except OutOfTime:
            self.ended, self.reason = True, OUT_OF_TIME
            at_end = self._validate()
            return Advance(at_end["loss"], at_end, False)  # half a step is not gone on with
        self.step_seconds = max(self.step_seconds if self.step else 0.0, session.passed - began)
        self.step += 1
        if not math.isfinite(value):
            self.ended, self.reason = True, f"the loss was not finite at step {self.step}: lower `learning_rate`"
            return Advance(value, None, False)
        last = self.step == self.planned or (solver.refresh is None and self.optimizer.finished is not None)
        self.ended = last or not self._fits()
        if self.ended and not last:
            self.reason = OUT_OF_TIME
        figures = self._validate() if self.ended or self.step % solver.validate_every == 0 else None
        return Advance(value, figures, self.ended or self.step % solver.checkpoint_every == 0)

    def end(self, session: Session) -> str | None:
        return INTERRUPTED if session.interruption.asked else self.reason

    def achieved(self) -> dict[str, float]:
        """The figures of the best state, which the flow takes over."""
        self.flow.load_state_dict(self.best)
        return self._best_figures()

    def missed(self) -> tuple[float, float] | None:
        x, _, *t0 = self.reference
        return self._share(self.flow.psi(self.flow.dt, x, *t0).detach()) if len(x) else None

    def missed_by_verlet(self) -> tuple[float, float] | None:
        x, _, *t0 = self.reference
        if not (len(x) and self.system.separable):
            return None
        (q, p), dt = x.chunk(2, -1), self.flow.dt
        middle = [t + dt / 2 for t in t0]
        q = q + dt / 2 * self.system.velocity(p, *middle)
        p = p + dt * self.system.force(q, *middle)
        return self._share(torch.cat([q + dt / 2 * self.system.velocity(p, *middle), p], -1).detach())

    def _share(self, end: Tensor) -> tuple[float, float]:
        x, y = (states.cpu().double().numpy() for states in self.reference[:2])
        labels = Labels(np.array([self.flow.dt]), x, y[None])
        return shares_missed(end.cpu().double().numpy() - y, labels, np.array(self.scaling.x))

    @property
    def remedy(self) -> str:
        more = "Train longer, with optimizer='gauss-newton', a shorter `dt`, or a smaller `domain`."
        if self.system.separable and self.system.quadratic_kinetic:
            return f"kind='primed' is far better where H = ½ pᵀM⁻¹p + V(q). {more}"
        return more

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
        if figures["loss"] < min((f["loss"] for f in self._finite()), default=math.inf):
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
        x, y, *t0 = self.reference
        if len(x):
            error = torch.linalg.vector_norm(self.flow.psi(self.flow.dt, x, *t0) - y, dim=-1)
            figures |= {"one_step_error": float(error.mean()), "one_step_error_max": float(error.max())}
        return figures

    def _affordable(self, deadline: Deadline) -> Points:
        """The held-out points, or fewer where a validation of all takes more than its share of the time."""
        points, n = self.held_out, len(self.held_out.residual[0])
        if deadline.end == math.inf or n <= PROBE:
            return points
        m, session = PROBE, deadline.session
        while 2 * m < n:
            began = session.passed
            with torch.no_grad():
                self.loss.terms(self.flow, _first(points, m))
            if 2 * (session.passed - began) > VALIDATION_SHARE * deadline.left:
                return _first(points, m)
            m *= 2
        return points

    def _finite(self) -> list[dict[str, float]]:
        return [figures for figures in self.history if math.isfinite(figures["loss"])]

    def _best_figures(self) -> dict[str, float]:
        return min(self._finite(), key=lambda figures: figures["loss"])


def _check_memory(flow: FlowMap, fit: Resolved, solver: Solver) -> None:
    """Raise ValueError where the points, or what the optimizer keeps, are more than the memory of the machine."""
    n, width = flow.n_parameters, 2 * flow.ndof
    points = max(fit.points, fit.validation_points, fit.reference_states)
    of_points = points * width * (1 if solver.refresh is None else BLOCK)
    if fit.label_weight and fit.data is None:
        of_points += (fit.points + fit.validation_points) * fit.label_times * width
    check_memory(f"`points` {fit.points} and `validation_points`", of_points, "take fewer")
    kept = {"lbfgs": 2 * MEMORY * n, "bfgs": 3 * n**2, "gauss-newton": 3 * n * (fit.points * width + n)}
    smaller = "take fewer `points`, a smaller network, or optimizer='adam'"
    check_memory(f"`optimizer` {solver.name!r} of {n} parameters", kept.get(solver.name, 4 * n), smaller)


def _first(points: Points, n: int) -> Points:
    """The first n points, and of the other losses as large a share."""
    t, x, *t0 = points.matching
    m = max(2, x.shape[1] * n // len(points.residual[0]))
    labels = None if points.labels is None else tuple(a[:n] for a in points.labels)
    return Points(tuple(a[:n] for a in points.residual), (t, x[:, :m], *t0), labels)


def _labels(
    system: HamiltonianSystem, domain: Domain, dt: float, fit: Resolved, deadline: Deadline
) -> tuple[Labelled, Labelled]:
    """Labels to train on, and held-out ones, at equidistant times; of a driven system with the times of the states."""
    t = dt * np.arange(1, fit.label_times + 1) / fit.label_times
    unseen = max(1, fit.validation_points // fit.label_times)
    sets = []
    for n, stream in ((fit.points, Stream.LABELS), (unseen, Stream.VALIDATION)):
        labels = Labels.drawn(system, domain, n, fit.seed, stream, t, deadline)
        x = np.broadcast_to(labels.x, labels.y.shape).reshape(-1, labels.x.shape[1])
        begun = () if labels.t0 is None else (np.tile(labels.t0, len(t)),)
        sets.append((np.repeat(t, len(labels.x)), x, labels.y.reshape(x.shape), *begun))
    return sets[0], sets[1]
