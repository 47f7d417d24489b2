"""SearchRun: many starts, each followed to a minimum, and what is made of the best of them."""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from sympflow.flow.base import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.interruption import Interruption
from sympflow.training.levenberg_marquardt import STOPPED, Minimum
from sympflow.training.outcome import INTERRUPTED, OUT_OF_TIME, recorded, warn_of_early_end
from sympflow.training.progress import progress as make_progress
from sympflow.training.search_config import SearchConfig

Callback = Callable[[int, dict[str, float]], None]
Stop = Callable[[], bool]


@dataclass
class SearchRun(ABC):
    """The state of a run: the minima that were found, and how long that took.

    Duties of a subclass
    --------------------
    1. `next_minimum(stop)`: follow the next start, of number len(minima).
    2. `found(minimum)`: note it; its figures.
    3. `complete(spent)`: make the flow of the minima, and its last entry in `history`. `spent(share)` says whether this
       share of the time is used up, or the run is to end at once; it may be called again after an interruption.

    Attributes
    ----------
    interruption : Interruption
        Which asks the run to end.
    tried : FlowMap or None
        A flow like this one that is there already, which the result of an interrupted run is to be no worse than.
    """

    flow: FlowMap
    system: HamiltonianSystem
    domain: Domain
    config: SearchConfig
    scaling: Scaling | None
    minima: list[Minimum] = field(default_factory=list, kw_only=True)
    history: list[dict[str, float]] = field(default_factory=list, kw_only=True)
    seconds: float = field(default=0.0, kw_only=True)
    interruption: Interruption = field(default_factory=Interruption, kw_only=True)
    tried: FlowMap | None = field(default=None, kw_only=True)

    SEARCH_SHARE: ClassVar[float] = 1.0  # of a time budget

    @abstractmethod
    def next_minimum(self, stop: Stop) -> Minimum:
        """Follow the next start."""

    @abstractmethod
    def found(self, minimum: Minimum) -> dict[str, float]:
        """Note a minimum; its figures."""

    @abstractmethod
    def complete(self, spent: Callable[..., bool]) -> None:
        """Make the flow of the minima."""

    def remarks(self) -> dict[str, Any]:
        """What else the recipe says."""
        return {}

    def go(
        self,
        checkpoint: str | os.PathLike[str] | None,
        time_budget: float | None,
        progress: bool | None,
        callback: Callback | None,
    ) -> str | None:
        """Run to the end; why it ended early, if it did. The flow is then the best that was found."""
        begin, before, interruption, cut = time.perf_counter(), self.seconds, self.interruption, False

        def spent(share: float = 1.0) -> bool:
            nonlocal cut
            passed = time.perf_counter() - begin
            self.seconds = before + passed
            over = interruption.asked or (time_budget is not None and passed > share * time_budget)
            cut = cut or over
            return over

        def search_is_spent() -> bool:
            return spent(self.SEARCH_SHARE)

        planned, label = self.config.restarts, f"{self.system.name} {self.flow.kind}"
        try:
            if checkpoint is not None and not self.minima:  # a first search may be long
                self.save(checkpoint)
            interruption.armed = True
            with make_progress(progress, planned, label, len(self.minima)) as bar:
                while len(self.minima) < planned and not search_is_spent():
                    minimum = self.next_minimum(search_is_spent)
                    self.minima.append(minimum)
                    figures = self.found(minimum)
                    bar.advance(len(self.minima), minimum.cost)
                    bar.validated(len(self.minima), figures)
                    if callback is not None:
                        callback(len(self.minima), dict(figures))
                    if checkpoint is not None and minimum.reason != STOPPED:  # it is followed to its end another time
                        self.save(checkpoint)
        except KeyboardInterrupt:  # of the callback, a handler of the program's own, or a second one
            interruption.asked = True
        try:
            try:
                self.complete(spent)
            except KeyboardInterrupt:
                if interruption.asked:
                    raise
                interruption.asked = True
                self.complete(spent)  # at once: all that is left to do is to take the best
        except FloatingPointError:
            if interruption.asked:  # before there was anything
                raise KeyboardInterrupt from None
            raise
        self.seconds = before + time.perf_counter() - begin
        return INTERRUPTED if interruption.asked else OUT_OF_TIME if cut else None

    def finish(self, reason: str | None, expected: bool = False) -> Any:
        """The flow with its record; an expected end is only recorded."""
        if reason is not None and not (expected and reason == OUT_OF_TIME):
            warn_of_early_end(reason, len(self.minima), self.config.restarts, "starts")
        stage = {
            **self.config.to_dict(),
            "restarts_taken": len(self.minima),
            "iterations": sum(int(h["iterations"]) for h in self.history),
            "ended_early": reason,
            **self.remarks(),
        }
        shape = (self.flow, self.system, self.domain, self.scaling)
        return recorded(*shape, stage, self.history, self.history[-1], self.seconds)

    # checkpoints ------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """The searches so far, each with its end; `best` is the flow that the best of them gives."""
        state = self.flow.state_dict()
        searches = {
            "x": torch.as_tensor(np.stack([m.x for m in self.minima]) if self.minima else np.empty((0, 0))),
            "cost": [m.cost for m in self.minima],
            "iterations": [m.iterations for m in self.minima],
        }
        run = {"step": len(self.minima), "flow": state, "best": state, "optimizer": searches}
        run |= {"history": self.history, "seconds": self.seconds}
        checkpoints.write(path, checkpoints.identity(self.flow, self.system, self.config.to_dict()) | run)

    def load(self, path: str | os.PathLike[str]) -> None:
        mine = checkpoints.identity(self.flow, self.system, self.config.to_dict())
        state = checkpoints.read_same(Path(path), mine)
        searches = state["optimizer"]
        self.minima = [
            Minimum(x.numpy(), cost, iterations, "it was resumed")
            for x, cost, iterations in zip(searches["x"], searches["cost"], searches["iterations"], strict=True)
        ]
        self.seconds, self.history = state["seconds"], state["history"]
