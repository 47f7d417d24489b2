"""Gauss–Newton training of primed flows: the numbers of a splitting table, fitted to the exact flow of a system.

In three stages. First the table frozen at Δt, a dozen or two numbers, from many random starts, each followed for a
few iterations: the cost has many local minima. Then the best of these to the end of their narrow valleys. Then the
polynomials in t, from the best of these tables, to labels at several times in (0, Δt].
"""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from sympflow.domain import Domain
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.collocation import Stream, states, stream_seed
from sympflow.training.labels import Labels
from sympflow.training.levenberg_marquardt import Minimum
from sympflow.training.progress import progress as make_progress
from sympflow.training.run import Path
from sympflow.training.table_fit import Table, TableFit
from sympflow.training.table_jacobian import TableStep

FINALISTS = 4  # tables of the search that are followed to the end
FITTED = 2  # tables from which the polynomials are fitted
SEARCH_STEPS = 60  # iterations from each start
SEARCH_SHARE, FROZEN_SHARE = 0.4, 0.7  # of a time budget, that the search, and all work on frozen tables, may use
FRACTIONAL_TIMES = 50
FEWEST_POINTS, MOST_POINTS, COORDINATES = 40, 250, 1000


@dataclass(frozen=True)
class GaussNewtonConfig:
    """The choices of a Gauss–Newton run; with the seed they determine the trained weights.

    Parameters
    ----------
    points : int, optional
        Number of labelled states, drawn from the domain: by default 250, and fewer for more than 4 degrees of freedom.
    label_times : int
        Number of equidistant times in (0, Δt] at which the states are labelled.
    frozen_weight : float
        Weight of the residuals at t = Δt, which alone are composed over many steps; those at other times have 1.
    restarts : int
        Starts of the frozen search: the flow as it is, then random tables.
    steps : int
        The most iterations of each of the final fits.
    seed : int
    reference_states : int
        Held-out states of the figures.
    """

    points: int | None = None
    label_times: int = 8
    frozen_weight: float = 1.0
    restarts: int = 24
    steps: int = 1000
    seed: int = 0
    reference_states: int = 100

    def __post_init__(self) -> None:
        for name in ("points", "label_times", "restarts", "steps", "reference_states"):
            value = getattr(self, name)
            if name == "points" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"`{name}` must be a positive integer; got {value!r}.")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer; got {self.seed!r}.")
        if not 0 < self.frozen_weight < math.inf:
            raise ValueError(f"`frozen_weight` must be positive and finite; got {self.frozen_weight!r}.")

    def to_dict(self) -> dict[str, Any]:
        return {"optimizer": "gauss-newton", "loss": "labels", **asdict(self)}


@dataclass
class GaussNewtonRun:
    """The state of a run, and what acts on it."""

    flow: PrimedFlow
    system: HamiltonianSystem
    domain: Domain
    scaling: Scaling
    config: GaussNewtonConfig
    frozen: TableFit
    whole: TableFit
    held_out: Labels
    minima: list[Minimum] = field(default_factory=list)
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0

    @classmethod
    def start(
        cls,
        flow: PrimedFlow,
        system: HamiltonianSystem,
        domain: Domain,
        scaling: Scaling,
        config: GaussNewtonConfig,
    ) -> GaussNewtonRun:
        step, table = TableStep(system, flow.sequence, flow.gradients is not None), Table(flow)
        points = config.points or min(MOST_POINTS, max(FEWEST_POINTS, COORDINATES // system.ndof))
        x = states(domain, points, config.seed, Stream.RESIDUAL)
        t = flow.dt * np.arange(1, config.label_times + 1) / config.label_times
        labels = Labels.of(system, x, t)
        if len(labels.x) == 0:
            raise ValueError("`domain` holds no states whose solution exists up to `dt`: shrink one of them.")
        at_end = Labels(labels.t[-1:], labels.x, labels.y[-1:])
        unit, weight = np.array(scaling.x), np.where(t < t[-1], 1.0, config.frozen_weight)
        frozen = TableFit(step, at_end, *table.frozen(flow.dt), unit, np.ones(1))
        whole = TableFit(step, labels, *table.polynomial(t), unit, weight)
        x = states(domain, config.reference_states, config.seed, Stream.REFERENCE)
        t = flow.dt * (np.arange(FRACTIONAL_TIMES) + 0.5) / FRACTIONAL_TIMES
        held_out = Labels.of(system, x, np.append(t, flow.dt))
        return cls(flow, system, domain, scaling, config, frozen, whole, held_out)

    def go(
        self,
        checkpoint: Path | None,
        time_budget: float | None,
        progress: bool | None,
        callback: Callable[[int, dict[str, float]], None] | None,
    ) -> str | None:
        """Run to the end; why it ended early, if it did. The flow is then the best that was found."""
        begin, before, reason = time.perf_counter(), self.seconds, None
        table = Table(self.flow)
        given = table.parameters()

        def spent(share: float = 1.0) -> bool:
            self.seconds = before + time.perf_counter() - begin
            return time_budget is not None and time.perf_counter() - begin > share * time_budget

        def search_is_spent() -> bool:
            return spent(SEARCH_SHARE)

        def frozen_is_spent() -> bool:
            return spent(FROZEN_SHARE)

        label = f"{self.system.name} {self.flow.kind}"
        try:
            with make_progress(progress, self.config.restarts, label, len(self.minima)) as bar:
                while len(self.minima) < self.config.restarts and not search_is_spent():
                    steps = min(SEARCH_STEPS, self.config.steps)
                    minimum = self.frozen.minimize(self._start(table, given), steps, search_is_spent)
                    self.minima.append(minimum)
                    best = min(self.minima, key=lambda m: m.cost)
                    table.assign(table.continued(self.frozen.design[0] @ best.x))
                    figures = self._record(minimum)
                    bar.advance(len(self.minima), minimum.cost)
                    bar.validated(len(self.minima), figures)
                    if callback is not None:
                        callback(len(self.minima), dict(figures))
                    if checkpoint is not None:
                        self.save(checkpoint)
        except KeyboardInterrupt:
            reason = "it was interrupted"
        if len(self.minima) < self.config.restarts and reason is None:
            reason = "the time budget was used up"

        finalists = [
            self.frozen.minimize(m.x, self.config.steps, frozen_is_spent, thorough=True)
            for m in _distinct(self.minima)[:FINALISTS]
        ]
        tables = [self.frozen.design[0] @ m.x for m in _distinct(finalists)[:FITTED]]
        starts = [given, *(table.continued(t) for t in tables)]
        fitted = [self.whole.minimize(theta, self.config.steps, spent, thorough=True) for theta in starts]
        best = min(fitted, key=lambda m: m.cost)
        if not math.isfinite(best.cost):
            raise FloatingPointError("The residuals are not finite from any start: shrink `domain` or `dt`.")
        table.assign(best.x)
        self._record(best)
        spent()
        return reason

    def _start(self, table: Table, given: np.ndarray) -> np.ndarray:
        """Where the next search begins: the flow as it was given, then random tables."""
        restart = len(self.minima)
        coefficients = self.whole.offset[-1] + self.whole.design[-1] @ given
        if restart:
            coefficients = table.random(
                np.random.default_rng([stream_seed(self.config.seed, Stream.RESTARTS), restart])
            )
        return np.linalg.lstsq(self.frozen.design[0], coefficients, rcond=None)[0]

    def _record(self, minimum: Minimum) -> dict[str, float]:
        figures = {
            "step": len(self.minima),
            "loss": minimum.cost,
            "iterations": minimum.iterations,
            **errors(self.flow, self.whole.step, self.held_out),
        }
        self.history.append(figures)
        return figures

    def finish(self, reason: str | None) -> PrimedFlow:
        """The flow with its record."""
        if reason is not None:
            warnings.warn(
                f"Training ended after {len(self.minima)} of {self.config.restarts} starts because {reason}. "
                "The best state so far is returned.",
                RuntimeWarning,
                stacklevel=3,
            )
        flow, last = self.flow, self.history[-1]
        flow.requires_grad_(False)
        flow.domain = self.domain
        earlier = float(flow.figures.get("training_seconds", 0.0))
        stage = {
            **self.config.to_dict(),
            "restarts_taken": len(self.minima),
            "iterations": sum(int(h["iterations"]) for h in self.history),
            "ended_early": reason,
        }
        flow.recipe = {
            "stages": [*flow.recipe.get("stages", []), stage],
            "scaling": self.scaling.to_dict(),
            "torch": torch.__version__,
        }
        flow.figures = {k: v for k, v in last.items() if k not in ("step", "loss", "iterations")}
        flow.figures["training_seconds"] = round(earlier + self.seconds, 3)
        flow.history = self.history
        return flow

    # checkpoints ------------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, Any]:
        return {
            "config": json.dumps(self.config.to_dict()),
            "architecture": json.dumps({"kind": self.flow.kind, "dt": self.flow.dt, **self.flow.architecture()}),
            "fingerprint": list(self.system.fingerprint),
        }

    def save(self, path: Path) -> None:
        """The searches so far, each with its end; `best` is the flow that the best of them gives."""
        state = self.flow.state_dict()
        ends = torch.as_tensor(np.stack([m.x for m in self.minima]))
        searches = {
            "x": ends,
            "cost": [m.cost for m in self.minima],
            "iterations": [m.iterations for m in self.minima],
        }
        checkpoints.write(
            path,
            {
                **self._identity(),
                "step": len(self.minima),
                "flow": state,
                "best": state,
                "optimizer": searches,
                "history": self.history,
                "seconds": self.seconds,
            },
        )

    def load(self, path: Path) -> None:
        state, mine = checkpoints.read(path), self._identity()
        for name in ("config", "architecture", "fingerprint"):
            if state[name] != mine[name]:
                raise ValueError(f"`resume` is a run with another {name}: pass the same arguments as then.")
        searches = state["optimizer"]
        self.minima = [
            Minimum(x.numpy(), cost, iterations, "it was resumed")
            for x, cost, iterations in zip(searches["x"], searches["cost"], searches["iterations"], strict=True)
        ]
        self.seconds, self.history = state["seconds"], state["history"]


def _distinct(minima: list[Minimum]) -> list[Minimum]:
    """The minima from the lowest, without those that are one before again, to 1 % of the cost."""
    kept: list[Minimum] = []
    for m in sorted(minima, key=lambda m: m.cost):
        if not kept or m.cost > 1.01 * kept[-1].cost:
            kept.append(m)
    return kept


def errors(flow: PrimedFlow, step: TableStep, labels: Labels) -> dict[str, float]:
    """‖ψ̄_t(x) − φ_H,t(x)‖ at the labels: mean and largest at Δt, the last time; mean over the times before it."""
    table = Table(flow)
    offset, design = table.polynomial(labels.t)
    coefficients = offset + design @ table.parameters()
    psi = np.stack([step(c[:, None], labels.x.T).T for c in coefficients])
    error = np.linalg.norm(psi - labels.y, axis=-1)
    return {
        "one_step_error": float(error[-1].mean()),
        "one_step_error_max": float(error[-1].max()),
        "fractional_error": float(error[:-1].mean()),
    }
