"""The loop of every training: steps or starts, one after another, with its checkpoints, its history and its end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from sympflow.arguments import warn
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import Drive
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.fits import GaussNewton, Resolved
from sympflow.training.least_squares import STOPPED, Minimum, Problem
from sympflow.training.points import USELESS
from sympflow.training.session import Deadline, Path, Session, shown

OUT_OF_TIME = "the time budget was used up"
NO_LABELS = "its labels were not known in their share of the time budget"
INTERRUPTED = "it was interrupted"
LABEL_SHARE = 0.3  # of the time left, that each set of labels may take


@dataclass(frozen=True)
class Advance:
    """A step, or a start, of a run: its loss, the held-out figures after it if it was validated, whether it is kept."""

    loss: float
    figures: dict[str, float] | None
    keep: bool


class Run(ABC):
    """The state of a run, and the loop that acts on it; no choice is left open in its fit and its solver."""

    UNIT: ClassVar[str]

    def __init__(
        self,
        flow: FlowMap,
        system: HamiltonianSystem,
        domain: Domain,
        scaling: Scaling | None,
        fit: Resolved,
        solver: Resolved = GaussNewton(),  # noqa: B008
        deadline: Deadline | None = None,
    ) -> None:
        self.flow, self.system, self.domain, self.scaling = flow, system, domain, scaling
        self.solver = solver.but(**fit.OPEN)
        self.fit = fit.resolved(self.solver, flow.kind)
        self.history: list[dict[str, float]] = []
        self.seconds = self.closing = 0.0
        self.unfitted: tuple[tuple[float, float], ...] = ()
        self.prepare(Session().deadline if deadline is None else deadline)

    @abstractmethod
    def prepare(self, deadline: Deadline) -> None:
        """Make what the run needs beside, as its labels."""

    @property
    def record(self) -> dict[str, Any]:
        """The choices that determine the trained numbers."""
        return self.fit.record(self.solver)

    @property
    def done(self) -> int:
        """Steps, or what else `UNIT` names, that were taken."""
        return 0

    @property
    def planned(self) -> int:
        """The most there may be."""
        return 0

    @abstractmethod
    def begin(self, session: Session) -> None:
        """Get ready for the first; an exception ends the run."""

    def over(self, session: Session) -> bool:
        """Return whether to take no more."""
        return True

    def advance(self, session: Session) -> Advance:
        """Take one."""
        raise NotImplementedError

    @abstractmethod
    def end(self, session: Session) -> str | None:
        """Make the flow that is returned; why the run ended early, if it did."""

    def achieved(self) -> dict[str, float]:
        """The figures of that flow."""
        return dict(self.flow.figures)

    def missed(self) -> tuple[float, float] | None:
        """The error of a step of Δt relative to the displacement, see `shares_missed`; None if unknown."""
        return None

    def missed_by_verlet(self) -> tuple[float, float] | None:
        """The same of one Verlet step of Δt; None if there is none to compare with."""
        return None

    def left_out(self) -> str | None:
        """The words for the part of Ω in which the fit is not valid; None if there is none."""
        return None

    @property
    def remedy(self) -> str:
        """The advice for a flow that is far from the exact one."""
        return "Take a shorter `dt`, a smaller `domain`, or another `flow`, with more kicks."

    @abstractmethod
    def remarks(self, reason: str | None) -> dict[str, Any]:
        """The record of the run, beside its options, in the recipe of the flow."""

    def kept(self) -> dict[str, Any]:
        """The state that a checkpoint keeps: `best` and `optimizer`."""
        raise NotImplementedError

    @abstractmethod
    def restore(self, state: dict[str, Any]) -> None:
        """Take over the state that a checkpoint kept."""

    def go(self, session: Session) -> str | None:
        """Run to the end; why it ended early, if it did. The flow is then the best that was found."""
        before = self.seconds
        self.begin(session)
        try:
            with session.bar(self.planned, f"{self.system.name} {self.flow.kind}", self.done) as bar:
                while self.done < self.planned and not self.over(session):
                    advance = self.advance(session)
                    self.seconds = before + session.passed
                    bar.advance(self.done, advance.loss)
                    if advance.figures is not None:
                        bar.tries(self.done, shown(advance.figures))
                        if session.callback is not None:
                            session.callback(self.done, dict(advance.figures))
                    if session.checkpoint is not None and advance.keep:
                        self.save(session.checkpoint)
        except KeyboardInterrupt:  # of the callback, a handler of the program's own, or a second one
            session.interruption.asked = True
        reason = self.end(session)
        self.seconds = before + session.passed
        return reason

    def ended_early(self, reason: str) -> str:
        """The warning of a run that did not come to its end."""
        when = f"after {self.done} of {self.planned} {self.UNIT}"
        if self.done >= self.planned:
            when = f"in its last fits, after all {self.planned} {self.UNIT},"
        return f"Training ended {when} because {reason}. The best state so far is returned."

    def finish(self, reason: str | None, expected: bool = False) -> Any:
        """The flow with the record of its training, its parameters without gradient.

        An end that is expected does not warn, unless it came before the first of its steps.
        """
        if reason is not None and not (expected and self.done and reason == OUT_OF_TIME):
            warn(self.ended_early(reason), RuntimeWarning)
        flow, figures = self.flow, self.achieved()
        flow.requires_grad_(False)
        flow.zero_grad(set_to_none=True)
        flow.domain = self.domain
        flow.identify(self.system, self.domain)
        drive = Drive.of(self.system)
        flow.drive_times = None if drive is None else drive.times
        earlier = float(flow.figures.get("training_seconds", 0.0))
        stage = {**self.record, **self.remarks(reason)}
        if self.done and not stage.get("kept_start"):
            flow.unfitted = self.unfitted
        flow.recipe = {
            "stages": [*flow.recipe.get("stages", []), stage],
            **({} if self.scaling is None else {"scaling": self.scaling.to_dict()}),
            "torch": torch.__version__,
        }
        flow.figures = {name: value for name, value in figures.items() if name not in ("step", "loss", "iterations")}
        flow.figures["training_seconds"] = round(earlier + self.seconds, 3)
        flow.figures |= self._compared()
        flow.history = self.history
        return flow

    def _compared(self) -> dict[str, float]:
        """Shares missed by the flow and by a Verlet step, with a warning where the flow is worth nothing."""
        missed, verlet = self.missed(), self.missed_by_verlet()
        if missed is None:
            return {}
        mean, median = missed
        no_better = verlet is not None and mean >= verlet[0] > 0
        if mean >= USELESS or no_better:
            beside = f", no better than one Verlet step with {verlet[0]:.1e}" if verlet and no_better else ""
            warn(
                f"The flow is far from the exact one: at held-out states its error in one step of dt = "
                f"{self.flow.dt:g} is {mean:.1e} times what a step moves them (in the median {median:.1e} times)"
                f"{beside}. {self.remedy}"
            )
        elif (words := self.left_out()) is not None:
            warn(words)
        return {"missed_share": mean} | ({} if verlet is None else {"verlet_missed_share": verlet[0]})

    # checkpoints ------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write the state of the run."""
        run = {"step": self.done, "flow": self.flow.state_dict(), **self.kept()}
        run |= {"history": self.history, "seconds": self.seconds}
        checkpoints.write(path, checkpoints.identity(self.flow, self.system, self.record) | run)

    def load(self, path: Path) -> None:
        """Take over the state of a run with the same flow, system and options."""
        state = checkpoints.read_same(path, checkpoints.identity(self.flow, self.system, self.record))
        try:
            self.restore(state)
        except (RuntimeError, KeyError, ValueError) as error:
            raise ValueError(f"`resume` {str(path)!r} does not fit the flow: start a new run.") from error
        self.seconds, self.history = state["seconds"], state["history"]


class Unstarted(Run):
    """A run for which there was no time, because its preparation took longer. The flow stays as it is."""

    UNIT: ClassVar[str] = "steps"

    def __init__(self, *given: Any, reached: str) -> None:
        super().__init__(*given)
        self.reached = reached

    def prepare(self, deadline: Deadline) -> None:
        self.history = list(self.flow.history)

    def begin(self, session: Session) -> None:
        pass

    def end(self, session: Session) -> str | None:
        return INTERRUPTED if session.interruption.asked else NO_LABELS

    def ended_early(self, reason: str) -> str:
        if reason == INTERRUPTED:
            return f"Training did not start because {reason}. The flow that it was to start from is returned."
        return (
            f"Training did not start because {reason}: {self.reached}. The flow that it was to start from is returned. "
            "Give a longer `time_budget`, a shorter `dt`, fewer `points`, `label_times` and `reference_states`, or a "
            "`domain` without states at which H has a kink or is nearly singular, near which exact solutions take long."
        )

    def remarks(self, reason: str | None) -> dict[str, Any]:
        return {"ended_early": f"{reason}: {self.reached}"}

    def restore(self, state: dict[str, Any]) -> None:
        self.flow.load_state_dict(state["best"])


def descended(common: tuple[Problem, int, Deadline, bool], theta: np.ndarray) -> Minimum:
    """The minimum that least squares find from θ: a task for a worker."""
    fit, iterations, deadline, thorough = common
    return fit.own().minimize(theta, iterations, deadline, thorough)


class SearchRun(Run):
    """Many starts, each followed to a minimum, and a flow that is made of the best of them."""

    coming: Generator[Minimum] | None = None
    """The minima of a round of starts, as the pool finds them."""

    UNIT: ClassVar[str] = "starts"
    SEARCH_SHARE: ClassVar[float] = 0.5  # of a time budget
    ROUND: ClassVar[int] = 200  # starts that are drawn at once: a time budget may be given any number

    def __init__(self, *given: Any) -> None:
        self.minima: list[Minimum] = []
        super().__init__(*given)

    @abstractmethod
    def searched(self) -> Problem:
        """The least squares of the search."""

    @abstractmethod
    def start_of(self, restart: int) -> np.ndarray:
        """The start of a number: the flow as it was given, then random ones."""

    @property
    def search_steps(self) -> int:
        """The most iterations from each start."""
        return self.solver.steps

    def next_minimum(self, session: Session, deadline: Deadline) -> Minimum:
        """The minimum of the next start, of number len(minima)."""
        minimum = None if self.coming is None else next(self.coming, None)
        if minimum is None:
            common, n = (self.searched(), self.search_steps, deadline, False), self.done
            starts = [self.start_of(k) for k in range(n, min(n + self.ROUND, self.planned))]
            self.coming = session.each(descended, common, starts, deadline, common[0].compiled)
            minimum = next(self.coming)
        return minimum

    @abstractmethod
    def found(self, minimum: Minimum) -> dict[str, float]:
        """Note a minimum; its figures."""

    @abstractmethod
    def complete(self, session: Session) -> None:
        """Make the flow of the minima, and its last entry in `history`; may be called again when interrupted."""

    @property
    def done(self) -> int:
        return len(self.minima)

    @property
    def planned(self) -> int:
        return self.solver.restarts

    def begin(self, session: Session) -> None:
        if session.checkpoint is not None and not self.minima:  # a first search may be long
            self.save(session.checkpoint)
        session.interruption.armed = True
        self.whole_end = session.deadline.before(self.closing)
        self.search_end = self.whole_end.part(self.SEARCH_SHARE)

    def over(self, session: Session) -> bool:
        return self.search_end.over()

    def advance(self, session: Session) -> Advance:
        minimum = self.next_minimum(session, self.search_end)
        self.minima.append(minimum)
        # a start that was stopped is followed to its end another time
        return Advance(minimum.cost, self.found(minimum), minimum.reason != STOPPED)

    def end(self, session: Session) -> str | None:
        interruption = session.interruption
        if self.coming is not None:
            self.coming.close()
        try:
            try:
                self.complete(session)
            except KeyboardInterrupt:
                if interruption.asked:
                    raise
                interruption.asked = True
                self.complete(session)  # at once: all that is left to do is to take the best
        except FloatingPointError:
            if interruption.asked:  # before there was anything
                raise KeyboardInterrupt from None
            raise
        return INTERRUPTED if interruption.asked else OUT_OF_TIME if session.cut else None

    def achieved(self) -> dict[str, float]:
        return self.history[-1]

    def remarks(self, reason: str | None) -> dict[str, Any]:
        iterations = sum(int(figures["iterations"]) for figures in self.history)
        return {"restarts_taken": len(self.minima), "iterations": iterations, "ended_early": reason}

    def kept(self) -> dict[str, Any]:
        """The searches so far, each with its end; `best` is the flow that the best of them gives."""
        searches = {
            "x": torch.as_tensor(np.stack([m.x for m in self.minima]) if self.minima else np.empty((0, 0))),
            "cost": [m.cost for m in self.minima],
            "iterations": [m.iterations for m in self.minima],
        }
        return {"best": self.flow.state_dict(), "optimizer": searches}

    def restore(self, state: dict[str, Any]) -> None:
        searches = state["optimizer"]
        self.minima = [
            Minimum(x.numpy(), cost, iterations, "it was resumed")
            for x, cost, iterations in zip(searches["x"], searches["cost"], searches["iterations"], strict=True)
        ]
