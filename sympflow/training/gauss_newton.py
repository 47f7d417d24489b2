"""Gauss–Newton training of primed flows: the numbers of a splitting table, fitted to the exact flow of a system.

In three stages. First the table frozen at Δt, a dozen or two numbers, from many random starts, each followed for a
few iterations: the cost has many local minima. Then the best of these to the end of their narrow valleys, at last with
the weight of the energy, with which these are harder to find. Then the polynomials in t, from the best of these tables,
to labels at several times in (0, Δt].

Other losses (the residual of the flow, Hamiltonian matching) join in the last stage. Without labels there is that stage
alone, from each start.

A flow that misses a tenth of what a step moves a state, or more, in the mean over held-out states and in units of the
spread of each coordinate over Ω, comes with a warning.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch

from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.collocation import PointSource, Stream, states, stream_seed
from sympflow.training.labels import Labels
from sympflow.training.levenberg_marquardt import Minimum
from sympflow.training.losses import Loss, Objective
from sympflow.training.search import SearchRun, Stop
from sympflow.training.search_config import TableConfig
from sympflow.training.table_errors import differences, distance, errors, shares_missed, warn_of_useless_flow
from sympflow.training.table_fit import Fit, LossFit, StackedFit, Table, TableFit
from sympflow.training.table_jacobian import TableStep

FINALISTS = 4  # tables of the search that are followed to the end
FITTED = 2  # tables from which the polynomials are fitted
HOPELESS = 100.0  # times the cost of the best table at Δt: polynomials are not fitted from there
SEARCH_STEPS = 60  # iterations from each start
FROZEN_SHARE = 0.7  # of a time budget, that all work on frozen tables may use
FRACTIONAL_TIMES = 50
CLOSE = 1.1  # held-out errors that differ by less are the same for a warning
FEWEST_POINTS, MOST_POINTS, COORDINATES = 40, 250, 1000
FITTED_POINTS = 120  # that are enough for the polynomials in t: at each of several times
RESIDUALS = 10  # at least, at Δt, for each number of the table; half as many for the polynomials in t


@dataclass
class GaussNewtonRun(SearchRun):
    """The state of a fit of a primed flow, and what acts on it."""

    flow: PrimedFlow
    config: TableConfig
    scaling: Scaling
    step: TableStep
    frozen: TableFit | None
    weighted: TableFit | None
    whole: Fit
    held_out: Labels
    kept_start: bool = field(default=False, init=False)

    SEARCH_SHARE: ClassVar[float] = 0.4

    def __post_init__(self) -> None:
        self.table = Table(self.flow)
        self.given = self.table.parameters()
        self.at_start = self._differences()

    @classmethod
    def start(
        cls,
        flow: PrimedFlow,
        system: HamiltonianSystem,
        domain: Domain,
        scaling: Scaling,
        config: TableConfig,
        data: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> GaussNewtonRun:
        """A run for labels made on the spot, or for `data`: times (n,), states and where they go, (n, 2d)."""
        step, table = TableStep(system, flow.sequence, flow.tables.level, flow.monomials), Table(flow)
        unit = np.array(scaling.x)
        parts: list[tuple[float, Fit]] = []
        frozen = weighted = None
        if config.label_weight and data is None:
            numbers = table.frozen(flow.dt)[1].shape[-1]
            enough = math.ceil(RESIDUALS * numbers / (2 * system.ndof))
            points = config.points or max(enough, min(MOST_POINTS, max(FEWEST_POINTS, COORDINATES // system.ndof)))
            x = states(domain, points, config.seed, Stream.RESIDUAL)
            t = flow.dt * np.arange(1, config.label_times + 1) / config.label_times
            labels = Labels.of(system, x, t)
            if len(labels.x) == 0:
                raise ValueError("`domain` holds no states whose solution exists up to `dt`: shrink one of them.")
            slope = energy_slope(system, labels, config.energy_weight)
            frozen, weighted = _with_and_without(step, labels.at(-1), table.frozen(flow.dt), unit, slope)
            weight = np.where(t < t[-1], 1.0, config.frozen_weight)
            labels = labels.first(fewer := max(FITTED_POINTS, enough // 2))
            slope = None if slope is None else slope[:, :fewer]
            parts.append((config.label_weight, TableFit(step, labels, *table.polynomial(t), unit, weight, slope)))
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
                slope = energy_slope(system, labels, config.energy_weight)
                frozen, weighted = _with_and_without(step, labels, table.frozen(flow.dt), unit, slope)
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
        return cls(flow, system, domain, config, scaling, step, frozen, weighted, whole, held_out)

    def next_minimum(self, stop: Stop) -> Minimum:
        steps = min(SEARCH_STEPS, self.config.steps)
        return (self.frozen or self.whole).minimize(self._start(), steps, stop)

    def found(self, minimum: Minimum) -> dict[str, float]:
        self.table.assign(self._continued(min(self.minima, key=lambda m: m.cost)))
        return self._record(minimum)

    def complete(self, spent: Callable[..., bool]) -> None:
        finalists, frozen, steps = _distinct(self.minima)[:FINALISTS], self.frozen, self.config.steps
        if frozen is not None:
            for fit in filter(None, (frozen, self.weighted)):
                finalists = [fit.minimize(m.x, steps, lambda: spent(FROZEN_SHARE), thorough=True) for m in finalists]
        starts = [self._continued(m) for m in _distinct(finalists)[:FITTED]]
        if not finalists or frozen is None or self._frozen_cost(self.given) < HOPELESS * min(m.cost for m in finalists):
            starts.insert(0, self.given)
        fitted = [self.whole.minimize(theta, steps, spent, thorough=True) for theta in starts]
        best = min(fitted, key=lambda m: m.cost)
        if not math.isfinite(best.cost):
            raise FloatingPointError("The residuals are not finite from any start: shrink `domain` or `dt`.")
        self.table.assign(best.x)
        self._keep_better()
        self._record(best)
        shares = shares_missed(self._differences()[-1], self.held_out, np.array(self.scaling.x))
        warn_of_useless_flow(shares, self.flow.dt, stacklevel=4)

    def _frozen_cost(self, theta: np.ndarray) -> float:
        """What parameters cost at Δt; infinite if they lead to no finite states."""
        fit = self.weighted or self.frozen
        assert fit is not None
        offset, design = self.table.polynomial(np.array([self.table.dt]))
        r = fit.residuals(self.table.frozen_parameters(offset[0] + design[0] @ theta))
        with np.errstate(over="ignore"):
            return float(r @ r) if np.isfinite(r).all() else math.inf

    def remarks(self) -> dict[str, Any]:
        return {"kept_start": True} if self.kept_start else {}

    def _keep_better(self) -> None:
        """Go back to where the run began, or to `tried`, if that is nearer to the exact flow at the held-out states."""
        interrupted = self.interruption.asked
        if interrupted and isinstance(self.tried, PrimedFlow):
            self.given = Table(self.tried).parameters()
            self.at_start = differences(self.tried, self.step, self.held_out)
        unit = np.array(self.scaling.x)
        before, after = (distance(e, unit) for e in (self.at_start, self._differences()))
        if after <= before or not math.isfinite(before):
            return
        self.table.assign(self.given)
        self.kept_start = True
        if interrupted or after < CLOSE * before:  # as when a fit is fitted again
            return
        warnings.warn(
            f"The fit has a larger held-out error ({after:.1e}, in units of the spread of `domain`) than the flow that "
            f"it started from ({before:.1e}), which is returned: its data are too few, too far from Δt, or not of this "
            "system; or H is singular in `domain`, or nearly so: shrink that.",
            RuntimeWarning,
            stacklevel=5,
        )

    def _start(self) -> np.ndarray:
        """Where the next search begins: the flow as it was given, then random tables."""
        restart, table, given = len(self.minima), self.table, self.given
        offset, design = table.polynomial(np.array([table.dt]))
        coefficients = offset[0] + design[0] @ given
        if restart:
            coefficients = table.random(
                np.random.default_rng([stream_seed(self.config.seed, Stream.RESTARTS), restart])
            )
        if self.frozen is None:
            return table.continued(coefficients) if restart else given
        return table.frozen_parameters(coefficients)

    def _continued(self, minimum: Minimum) -> np.ndarray:
        """The parameters that a minimum of the search gives."""
        return minimum.x if self.frozen is None else self.table.continued(self.frozen.design[0] @ minimum.x)

    def _differences(self) -> np.ndarray:
        """From the exact flow, at the held-out states and times."""
        return differences(self.flow, self.step, self.held_out)

    def _record(self, minimum: Minimum) -> dict[str, float]:
        figures = {
            "step": len(self.minima),
            "loss": minimum.cost,
            "iterations": minimum.iterations,
            **errors(self._differences()),
        }
        self.history.append(figures)
        return figures


def energy_slope(system: HamiltonianSystem, labels: Labels, weight: float) -> np.ndarray | None:
    """∇H at the labels (J, N, 2d), divided by the spread of H over Ω: `TableFit`; None if it is to count nothing."""
    spread = float(np.std(system.hamiltonian(labels.x)))
    if not (weight > 0 and 0 < spread < math.inf):
        return None
    return math.sqrt(weight) / spread * system.gradient(labels.y)


def _with_and_without(
    step: TableStep, labels: Labels, table: tuple[np.ndarray, np.ndarray], unit: np.ndarray, slope: np.ndarray | None
) -> tuple[TableFit, TableFit | None]:
    """The fit of a frozen table without a weight of the energy, by which valleys are found, and the one with it."""
    first = TableFit(step, labels, *table, unit, np.ones(1))
    return first, None if slope is None else TableFit(step, labels, *table, unit, np.ones(1), slope[-1:])


def _distinct(minima: list[Minimum]) -> list[Minimum]:
    """The minima from the lowest, without those that are one before again, to 1 % of the cost."""
    kept: list[Minimum] = []
    for m in sorted(minima, key=lambda m: m.cost):
        if not kept or m.cost > 1.01 * kept[-1].cost:
            kept.append(m)
    return kept


def _tensors(data: tuple[np.ndarray, ...] | None) -> Any:
    return None if data is None else tuple(torch.as_tensor(a, dtype=torch.float64) for a in data)
