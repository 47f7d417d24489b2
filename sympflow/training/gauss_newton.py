"""Gauss–Newton training of primed flows: the numbers of a splitting table, fitted to the exact flow of a system.

In three stages. First the table frozen at Δt, a dozen or two numbers, from many random starts, each followed for a
few iterations: the cost has many local minima. Then the best of these to the end of their narrow valleys. Then the
polynomials in t, from the best of these tables, to labels at several times in (0, Δt].

Other losses (the residual of the flow, Hamiltonian matching) join in the last stage. Without labels there is that stage
alone, from each start.
"""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from sympflow.domain import Domain
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.collocation import PointSource, Stream, states, stream_seed
from sympflow.training.labels import Labels
from sympflow.training.levenberg_marquardt import Minimum
from sympflow.training.losses import Loss, Objective
from sympflow.training.progress import progress as make_progress
from sympflow.training.run import Path
from sympflow.training.table_fit import Fit, LossFit, StackedFit, Table, TableFit
from sympflow.training.table_jacobian import TableStep

FINALISTS = 4  # tables of the search that are followed to the end
FITTED = 2  # tables from which the polynomials are fitted
SEARCH_STEPS = 60  # iterations from each start
SEARCH_SHARE, FROZEN_SHARE = 0.4, 0.7  # of a time budget, that the search, and all work on frozen tables, may use
FRACTIONAL_TIMES = 50
CLOSE = 1.1  # held-out errors that differ by less are the same for a warning
OUT_OF_TIME = "the time budget was used up"
FEWEST_POINTS, MOST_POINTS, COORDINATES = 40, 250, 1000
FITTED_POINTS = 120  # that are enough for the polynomials: at each of several times


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
    label_weight, residual_weight, matching_weight : float
        Weights of the labels, of ‖d/dt ψ̄_t(x) − J∇H‖² and of (𝓗 − H − c(t))²; 0 leaves a loss out.
    loss_points, matching_times : int
        Points of each of the last two, and the number of times in the last.
    data : str, optional
        Checksum of labels that were handed in.
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
    label_weight: float = 1.0
    residual_weight: float = 0.0
    matching_weight: float = 0.0
    loss_points: int = 300
    matching_times: int = 10
    data: str | None = None
    restarts: int = 24
    steps: int = 1000
    seed: int = 0
    reference_states: int = 100

    def __post_init__(self) -> None:
        positive = ("points", "label_times", "restarts", "steps", "reference_states", "loss_points", "matching_times")
        for name in positive:
            value = getattr(self, name)
            if name == "points" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"`{name}` must be a positive integer; got {value!r}.")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer; got {self.seed!r}.")
        if not 0 < self.frozen_weight < math.inf:
            raise ValueError(f"`frozen_weight` must be positive and finite; got {self.frozen_weight!r}.")
        weights = [getattr(self, f"{name}_weight") for name in ("label", "residual", "matching")]
        if not (all(0 <= weight < math.inf for weight in weights) and any(weights)):
            raise ValueError(
                "`label_weight`, `residual_weight` and `matching_weight` must be finite and at least 0, one of them "
                f"positive; got {weights}."
            )

    def to_dict(self) -> dict[str, Any]:
        named = {"labels": self.label_weight, "residual": self.residual_weight, "matching": self.matching_weight}
        loss = "+".join(name for name, weight in named.items() if weight)
        record = {"optimizer": "gauss-newton", "loss": loss, **asdict(self)}
        return {name: value for name, value in record.items() if value is not None}


@dataclass
class GaussNewtonRun:
    """The state of a run, and what acts on it."""

    flow: PrimedFlow
    system: HamiltonianSystem
    domain: Domain
    scaling: Scaling
    config: GaussNewtonConfig
    step: TableStep
    frozen: TableFit | None
    whole: Fit
    held_out: Labels
    minima: list[Minimum] = field(default_factory=list)
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0
    kept_start: bool = False

    @classmethod
    def start(
        cls,
        flow: PrimedFlow,
        system: HamiltonianSystem,
        domain: Domain,
        scaling: Scaling,
        config: GaussNewtonConfig,
        data: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> GaussNewtonRun:
        """A run for labels made on the spot, or for `data`: times (n,), states and where they go, (n, 2d)."""
        step, table = TableStep(system, flow.sequence, flow.gradients is not None), Table(flow)
        unit = np.array(scaling.x)
        parts: list[tuple[float, Fit]] = []
        frozen = None
        if config.label_weight and data is None:
            points = config.points or min(MOST_POINTS, max(FEWEST_POINTS, COORDINATES // system.ndof))
            x = states(domain, points, config.seed, Stream.RESIDUAL)
            t = flow.dt * np.arange(1, config.label_times + 1) / config.label_times
            labels = Labels.of(system, x, t)
            if len(labels.x) == 0:
                raise ValueError("`domain` holds no states whose solution exists up to `dt`: shrink one of them.")
            frozen = TableFit(step, labels.at(-1), *table.frozen(flow.dt), unit, np.ones(1))
            weight = np.where(t < t[-1], 1.0, config.frozen_weight)
            labels = labels.first(FITTED_POINTS)
            parts.append((config.label_weight, TableFit(step, labels, *table.polynomial(t), unit, weight)))
        elif config.label_weight and data is not None:
            at_end = np.abs(data[0] - flow.dt) <= 1e-9 * flow.dt
            if not (at_end.any() or config.residual_weight or config.matching_weight):
                raise ValueError(
                    f"`data` has no labels at Δt = {flow.dt:g}, where the flow is used most: its times end at "
                    f"{data[0].max():g}, beyond which the fit would be arbitrary. Label states at Δt as well, make the "
                    f"flow with dt={data[0].max():g}, or add the residual by loss='labels+residual'."
                )
            if 2 * system.ndof * at_end.sum() >= 2 * table.n:
                labels = Labels(data[0][at_end][-1:], data[1][at_end], data[2][at_end][None])
                frozen = TableFit(step, labels, *table.frozen(flow.dt), unit, np.ones(1))
        if config.residual_weight or config.matching_weight or data is not None:
            rest = config.label_weight if data is not None else 0.0
            loss = Loss(system, scaling, config.residual_weight, config.matching_weight, rest)
            shape = (flow.dt, config.loss_points, config.matching_times, config.seed, flow.dtype, flow.device)
            points_at = replace(PointSource(domain, *shape, block=1)(0), labels=_tensors(data) if rest else None)
            parts.append((1.0, LossFit(table, Objective(loss, flow, points_at))))
        x = states(domain, config.reference_states, config.seed, Stream.REFERENCE)
        t = flow.dt * (np.arange(FRACTIONAL_TIMES) + 0.5) / FRACTIONAL_TIMES
        held_out = Labels.of(system, x, np.append(t, flow.dt))
        whole = parts[0][1] if len(parts) == 1 else StackedFit(*parts)  # one weight changes nothing
        return cls(flow, system, domain, scaling, config, step, frozen, whole, held_out)

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
        at_start = errors(self.flow, self.step, self.held_out)

        def spent(share: float = 1.0) -> bool:
            self.seconds = before + time.perf_counter() - begin
            return time_budget is not None and time.perf_counter() - begin > share * time_budget

        def search_is_spent() -> bool:
            return spent(SEARCH_SHARE)

        def frozen_is_spent() -> bool:
            return spent(FROZEN_SHARE)

        label = f"{self.system.name} {self.flow.kind}"
        try:
            if checkpoint is not None and not self.minima:  # a first search may be long
                self.save(checkpoint)
            with make_progress(progress, self.config.restarts, label, len(self.minima)) as bar:
                while len(self.minima) < self.config.restarts and not search_is_spent():
                    steps = min(SEARCH_STEPS, self.config.steps)
                    start = self._start(table, given)
                    minimum = (self.frozen or self.whole).minimize(start, steps, search_is_spent)
                    self.minima.append(minimum)
                    table.assign(self._continued(table, min(self.minima, key=lambda m: m.cost)))
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
            reason = OUT_OF_TIME

        finalists = _distinct(self.minima)[:FINALISTS]
        if self.frozen is not None:
            fit = self.frozen
            finalists = [fit.minimize(m.x, self.config.steps, frozen_is_spent, thorough=True) for m in finalists]
        starts = [given, *(self._continued(table, m) for m in _distinct(finalists)[:FITTED])]
        fitted = [self.whole.minimize(theta, self.config.steps, spent, thorough=True) for theta in starts]
        best = min(fitted, key=lambda m: m.cost)
        if not math.isfinite(best.cost):
            raise FloatingPointError("The residuals are not finite from any start: shrink `domain` or `dt`.")
        table.assign(best.x)
        self._keep_better(table, given, at_start)
        self._record(best)
        spent()
        return reason

    def _keep_better(self, table: Table, given: np.ndarray, at_start: dict[str, float]) -> None:
        """Go back to where the run began if that is nearer to the exact flow at the held-out states."""
        before, after = (_distance(e) for e in (at_start, errors(self.flow, self.step, self.held_out)))
        if after <= before or not math.isfinite(before):
            return
        table.assign(given)
        self.kept_start = True
        if after < CLOSE * before:  # as when a fit is fitted again
            return
        warnings.warn(
            f"The fit has a larger held-out error ({after:.1e}) than the flow that it started from ({before:.1e}), "
            "which is returned: its data are too few, too far from Δt, or not of this system.",
            RuntimeWarning,
            stacklevel=4,
        )

    def _start(self, table: Table, given: np.ndarray) -> np.ndarray:
        """Where the next search begins: the flow as it was given, then random tables."""
        restart = len(self.minima)
        offset, design = table.polynomial(np.array([table.dt]))
        coefficients = offset[0] + design[0] @ given
        if restart:
            coefficients = table.random(
                np.random.default_rng([stream_seed(self.config.seed, Stream.RESTARTS), restart])
            )
        if self.frozen is None:
            return table.continued(coefficients) if restart else given
        return np.linalg.lstsq(self.frozen.design[0], coefficients, rcond=None)[0]

    def _continued(self, table: Table, minimum: Minimum) -> np.ndarray:
        """The parameters that a minimum of the search gives."""
        return minimum.x if self.frozen is None else table.continued(self.frozen.design[0] @ minimum.x)

    def _record(self, minimum: Minimum) -> dict[str, float]:
        figures = {
            "step": len(self.minima),
            "loss": minimum.cost,
            "iterations": minimum.iterations,
            **errors(self.flow, self.step, self.held_out),
        }
        self.history.append(figures)
        return figures

    def finish(self, reason: str | None, expected: bool = False) -> PrimedFlow:
        """The flow with its record; an expected end is only recorded."""
        if reason is not None and not (expected and reason == OUT_OF_TIME):
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
            **({"kept_start": True} if self.kept_start else {}),
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
        ends = torch.as_tensor(np.stack([m.x for m in self.minima]) if self.minima else np.empty((0, 0)))
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


def _tensors(data: tuple[np.ndarray, ...] | None) -> Any:
    return None if data is None else tuple(torch.as_tensor(a, dtype=torch.float64) for a in data)


def _distance(figures: dict[str, float]) -> float:
    """Of a flow from the exact one, at Δt and before it; infinite if anything is not a number."""
    both = figures["one_step_error"] + figures["fractional_error"]
    return both if math.isfinite(both) else math.inf


def errors(flow: PrimedFlow, step: TableStep, labels: Labels) -> dict[str, float]:
    """‖ψ̄_t(x) − φ_H,t(x)‖ at the labels: mean, median and largest at Δt, the last time; mean before it."""
    table = Table(flow)
    offset, design = table.polynomial(labels.t)
    coefficients = offset + design @ table.parameters()
    psi = np.stack([step(c[:, None], labels.x.T).T for c in coefficients])
    error = np.linalg.norm(psi - labels.y, axis=-1)
    return {
        "one_step_error": float(error[-1].mean()),
        "one_step_error_median": float(np.median(error[-1])),
        "one_step_error_max": float(error[-1].max()),
        "fractional_error": float(error[:-1].mean()),
    }
