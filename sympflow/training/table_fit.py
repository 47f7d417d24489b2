"""The fit of a primed flow: the numbers of its splitting table, fitted to the exact flow of a system by Gauss–Newton.

In three stages. First the table frozen at Δt, a dozen or two numbers, from many random starts, each followed for a
few iterations: the cost has many local minima. Then the best of these are iterated to convergence, at last with the
weight of the energy, which makes minima harder to find. Then the polynomials in t, from the best of these tables, to
labels at several times in (0, Δt].

Other losses (the residual of the flow, Hamiltonian matching) join in the last stage. Without labels there is that stage
alone, from each start.

Where long runs count, those of a lattice for instance, the best few tables are fitted to these in the end. The best of
them is the table at Δt, and the polynomials are fitted to the labels before it, if there are as many times as powers.

Every part of it has a deadline, which each evaluation checks.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.linalg import null_space

from sympflow.arguments import warn
from sympflow.flow.coefficients import Coefficients
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.weights import check_memory, doubles
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.fits import Resolved
from sympflow.training.least_squares import Blocks, Check, Minimum, Problem, put_weights
from sympflow.training.losses import Loss, Objective
from sympflow.training.points import (
    USELESS,
    Labels,
    PointSource,
    Stream,
    box_without,
    shares_missed,
    states,
    step_errors,
    stream_seed,
    unlabelled,
)
from sympflow.training.runs import LABEL_SHARE, SearchRun, descended
from sympflow.training.session import Deadline, Session
from sympflow.training.table_step import TableStep

SPREAD = 0.25  # of random coefficients about those of equal steps
WIDE_SPREAD = 2.0  # without force gradients, where an order above 2 needs negative ones
PROCESSOR_SPREAD = 0.1
STIFFNESS = 1e-3  # how reluctantly a table is made to vary with t where that is not called for
FINALISTS = 4  # tables of the search that are followed to the end
LABEL_WEIGHT, RUN_STEPS = 1e-3, 40  # weight of the labels at Δt beside long runs, and most iterations of that fit
FITTED = 2  # tables from which the polynomials are fitted
FITTED_STEPS = 200  # iterations of that at most: each takes as long as ten of a table, and more gain a few per cent
HOPELESS = 100.0  # times the cost of the best table at Δt: polynomials are not fitted from there
SEARCH_STEPS = 60  # iterations from each start
FROZEN_SHARE = 0.7  # of a time budget, that all work on frozen tables may use
FRACTIONAL_TIMES = 50  # of the held-out labels; as many as of the fit where these would take longer than
HELD_OUT_SHARE = 0.1  # of the time left
LAST_EVALUATIONS = 3  # times what the held-out figures take, for what is left to do when the time is up
LOST = 0.02  # share of the states of a domain from which no solution may exist without a warning
CLOSE = 1.1  # held-out errors that differ by less are the same for a warning
FEWEST_POINTS, MOST_POINTS, COORDINATES = 16, 250, 1000
FITTED_POINTS = 120  # that are enough for the polynomials in t: at each of several times
RESIDUALS = 10  # at least, at Δt, for each number of the table; half as many for the polynomials in t


# the run ------------------------------------------------------------------------------------------------------------


class TableRun(SearchRun):
    """The state of such a fit, and what acts on it: to labels made on the spot, or the `data` of the fit."""

    flow: PrimedFlow
    scaling: Scaling
    kept_start = False

    SEARCH_SHARE: ClassVar[float] = 0.4

    def __init__(self, *given: Any, tried: PrimedFlow | None = None, made_runs: MadeRuns | None = None) -> None:
        self.tried, self._made_runs = tried, made_runs
        super().__init__(*given)

    def prepare(self, deadline: Deadline) -> None:
        flow, system, domain, scaling, options = self.flow, self.system, self.domain, self.scaling, self.fit
        self.table = table = Table(flow)
        self.given = table.parameters()
        fractions = FRACTIONAL_TIMES
        data: Any = options.data
        if data is not None and options.losses == "labels":
            self.unfitted = unlabelled(data[0], flow.dt)
        self.step = step = TableStep(system, flow.sequence, flow.tables.level, flow.monomials, compiled=True)
        unit = np.array(scaling.x)
        if options.residual_weight or options.matching_weight or data is not None:
            system.check_autonomous("and only its own labels say when a step begins", "leave out `loss` and `data`")
        parts: list[tuple[float, Problem]] = []
        self.frozen: TableFit | None = None
        self.weighted: TableFit | None = None
        if options.label_weight and data is None:
            numbers = table.frozen(flow.dt)[1].shape[-1]
            enough = math.ceil(RESIDUALS * numbers / (2 * system.ndof))
            points = options.points or max(enough, min(MOST_POINTS, max(FEWEST_POINTS, COORDINATES // system.ndof)))
            _check_memory(points, options, step.n_coefficients, system.ndof)
            t = flow.dt * np.arange(1, options.label_times + 1) / options.label_times
            began = deadline.session.passed
            drawn = system, domain, points, options.seed, Stream.RESIDUAL, t, deadline.part(LABEL_SHARE)
            labels = Labels.drawn(*drawn)
            if (deadline.session.passed - began) / len(t) * fractions > HELD_OUT_SHARE * deadline.left:
                fractions = min(fractions, len(t))
            slope = energy_slope(system, labels, options.energy_weight)
            self._fit_frozen(labels.part(last=True), slope)
            weight = np.where(t < t[-1], 1.0, options.frozen_weight)
            labels = labels.part(fewer := max(FITTED_POINTS, enough // 2))
            slope = None if slope is None else slope[:, :fewer]
            parts.append((options.label_weight, TableFit(step, labels, *table.polynomial(t), unit, weight, slope)))
        elif options.label_weight and data is not None:
            at_end = np.abs(data[0] - flow.dt) <= 1e-9 * flow.dt
            if not (at_end.any() or options.residual_weight or options.matching_weight):
                raise ValueError(
                    f"`data` has no labels at Δt = {flow.dt:g}, where the flow is used most: its times end at "
                    f"{data[0].max():g}, beyond which the fit would be arbitrary. Label states at Δt as well, make the "
                    f"flow with dt={data[0].max():g}, or add the residual by loss='labels+residual'."
                )
            if 2 * system.ndof * at_end.sum() >= 2 * table.n:
                labels = Labels(data[0][at_end][-1:], data[1][at_end], data[2][at_end][None])
                slope = energy_slope(system, labels, options.energy_weight)
                self._fit_frozen(labels, slope)
        if options.residual_weight or options.matching_weight or data is not None:
            rest = options.label_weight if data is not None else 0.0
            loss = Loss(system, scaling, options.residual_weight, options.matching_weight, rest)
            shape = (flow.dt, options.loss_points, options.matching_times, options.seed, flow.dtype, flow.device)
            points_at = PointSource(domain, *shape, block=1)(0)
            if rest:
                points_at = points_at._replace(labels=tuple(torch.as_tensor(a, dtype=torch.float64) for a in data))
            parts.append((1.0, LossProblem(table, Objective(loss, flow, points_at))))
        t = np.append(flow.dt * (np.arange(fractions) + 0.5) / fractions, flow.dt)
        unseen = system, domain, options.reference_states, options.seed, Stream.REFERENCE, t
        self.held_out = Labels.drawn(*unseen, deadline.part(LABEL_SHARE), needed=False)
        self.whole = parts[0][1] if len(parts) == 1 else StackedFit(*parts)  # one weight changes nothing
        self.runs = None if self._made_runs is None else self._made_runs(flow)
        began = deadline.session.passed
        self.at_start = self.differences()
        self.closing = LAST_EVALUATIONS * (deadline.session.passed - began)

    def _fit_frozen(self, labels: Labels, slope: np.ndarray | None) -> None:
        """Fits of a frozen table without a weight of the energy, by which valleys are found, and with it."""
        given = self.step, labels, *self.table.frozen(self.flow.dt), np.array(self.scaling.x), np.ones(1)
        self.frozen = TableFit(*given)
        self.weighted = None if slope is None else TableFit(*given, slope[-1:])

    def begin(self, session: Session) -> None:
        super().begin(session)
        self._frozen_end = self.whole_end.part(FROZEN_SHARE)

    def searched(self) -> Problem:
        return self.frozen or self.whole

    @property
    def search_steps(self) -> int:
        return min(SEARCH_STEPS, self.solver.steps)

    def found(self, minimum: Minimum) -> dict[str, float]:
        self.table.assign(self._continued(min(self.minima, key=lambda m: m.cost)))
        return self._record(minimum)

    def complete(self, session: Session) -> None:
        finalists, frozen, steps = _distinct(self.minima)[:FINALISTS], self.frozen, self.solver.steps
        if frozen is not None:
            for fit in filter(None, (frozen, self.weighted)):
                common = (fit, steps, self._frozen_end, True)
                found = [m.x for m in finalists]
                finalists = list(session.each(descended, common, found, self._frozen_end, fit.compiled))
            if self.runs is not None and self._completed_by_runs(session, self.runs, finalists):
                return
        starts = [self._continued(m) for m in _distinct(finalists)[:FITTED]]
        if not finalists or frozen is None or self._frozen_cost(self.given) < HOPELESS * min(m.cost for m in finalists):
            starts.insert(0, self.given)
        whole = self.whole, min(steps, FITTED_STEPS) if frozen is not None else steps, self.whole_end, True
        fitted = list(session.each(descended, whole, starts, self.whole_end, self.whole.compiled))
        best = min(fitted, key=lambda m: m.cost)
        if not math.isfinite(best.cost):
            raise FloatingPointError("The residuals are not finite from any start: shrink `domain` or `dt`.")
        self.table.assign(best.x)
        self._record(best, self._keep_better(session))

    def _completed_by_runs(self, session: Session, runs: RunsFit, finalists: list[Minimum]) -> bool:
        """Fit the finalists to long runs and take the best; False, with a warning, where there are none to compare."""
        labels = self.weighted or self.frozen
        assert labels is not None
        both = StackedFit((1.0, runs), (LABEL_WEIGHT, labels))
        tables = [m.x for m in _distinct(finalists) if np.isfinite(both.residuals(m.x)).all()]
        late = self.whole_end.over()
        if late or not tables:
            reason = "the time was up" if late else "those of the flow do not stay finite: take a shorter `dt`"
            warn(f"The flow was not fitted to `runs`, because {reason}.", RuntimeWarning)
            self.runs = None
            return False
        common = both, min(self.solver.steps, RUN_STEPS), self.whole_end, False
        best = min(session.each(descended, common, tables, self.whole_end, both.compiled), key=lambda m: m.cost)
        theta = runs.parameters(best.x)
        if self.fit.label_times >= self.flow.shape.degree:  # fewer would leave the polynomials open in between
            between = Restricted(self.whole, theta, self.table.free_at_dt())
            theta = between.point(between.minimize(between.start, RUN_STEPS, self.whole_end).x)
        self.table.assign(theta)
        self._record(best)
        return True

    @property
    def remedy(self) -> str:
        return (
            f"{self._spoiled()}Take a smaller `domain`, without states where H is singular, nearly so, or has a kink, "
            "a shorter `dt`, or another `flow`, with more kicks."
        )

    @np.errstate(all="ignore")
    def _spoiled(self) -> str:
        """The held-out states at which the flow is nothing, in words, with a smaller domain that has none of them."""
        x, known, lost = self._asked(), self.held_out.x, self._lost()
        unit = np.array(self.scaling.x)
        error, moved = (np.linalg.norm(v / unit, axis=-1) for v in (self.at_end[-1], self.held_out.y[-1] - known))
        defined = np.isfinite(self.system.hamiltonian(known, self.held_out.t0))
        good = defined & (error < USELESS * np.median(moved[defined]))
        if 10 * good.sum() < len(x):  # spoiled everywhere
            return ""
        box = box_without(known[good], np.concatenate([lost, known[~good]]))
        words = f"At {(~good).sum()} of {len(x)} held-out states it misses a tenth of what a step moves most states"
        if len(lost):
            words += f", and from {len(lost)} no solution exists up to `dt`"
        if box is None:
            return f"{words}. "
        return f"{words}; none of these is in Box({box[0]}, {box[1]}). "

    def _asked(self) -> np.ndarray:
        """The held-out states that were drawn."""
        return states(self.domain, self.fit.reference_states, self.fit.seed, Stream.REFERENCE)

    def _lost(self) -> np.ndarray:
        """The drawn states from which no solution exists up to Δt."""
        labelled = {row.tobytes() for row in self.held_out.x}
        return np.array([row for row in self._asked() if row.tobytes() not in labelled]).reshape(
            -1, len(self.scaling.x)
        )

    def left_out(self) -> str | None:
        lost, known = self._lost(), self.held_out.x
        if len(lost) <= LOST * (len(lost) + len(known)):
            return None
        words = (
            f"From {len(lost)} of {len(lost) + len(known)} held-out states of `domain` no solution exists up to dt = "
            f"{self.flow.dt:g}, and the flow was fitted to the others alone: H is not defined there, or orbits run "
            "into a singularity or escape. "
        )
        box = box_without(known, lost)
        return words + ("Shrink `domain`." if box is None else f"Take a smaller `domain`: Box({box[0]}, {box[1]}).")

    def missed(self) -> tuple[float, float]:
        return shares_missed(self.at_end[-1], self.held_out, np.array(self.scaling.x))

    def _frozen_cost(self, theta: np.ndarray) -> float:
        """The cost of parameters at Δt; infinite if they lead to no finite states."""
        fit = self.weighted or self.frozen
        assert fit is not None
        offset, design = self.table.polynomial(np.array([self.table.dt]))
        r = fit.residuals(self.table.frozen_parameters(offset[0] + design[0] @ theta))
        with np.errstate(over="ignore"):
            return float(r @ r) if np.isfinite(r).all() else math.inf

    def remarks(self, reason: str | None) -> dict[str, Any]:
        kept = {"kept_start": True} if self.kept_start else {}
        return super().remarks(reason) | kept | ({} if self.runs is None else self.runs.record)

    def _keep_better(self, session: Session) -> np.ndarray:
        """Go back to the start, or `tried`, if that is nearer to the exact flow; the differences at held-out states."""
        if session.cut and self.tried is not None:
            self.given = Table(self.tried).parameters()
            self.at_start = differences(self.tried, self.step, self.held_out)
        unit = np.array(self.scaling.x)
        at_end = self.differences()
        before, after = (distance(e, unit) for e in (self.at_start, at_end))
        if after <= before or not math.isfinite(before):
            return at_end
        self.table.assign(self.given)
        self.kept_start = True
        if session.interruption.asked or after < CLOSE * before:  # as when a fit is fitted again
            return self.at_start
        warn(
            f"The fit has a larger held-out error ({after:.1e}, in units of the spread of `domain`) than the flow that "
            f"it started from ({before:.1e}), which is returned: its data are too few, too far from Δt, or not of this "
            "system; or H is singular in `domain`, nearly so, or has a kink: shrink that.",
            RuntimeWarning,
        )
        return self.at_start

    def start_of(self, restart: int) -> np.ndarray:
        """The start of a search: the flow as it was given, then random tables."""
        table, given = self.table, self.given
        offset, design = table.polynomial(np.array([table.dt]))
        coefficients = offset[0] + design[0] @ given
        if restart:
            coefficients = table.random(np.random.default_rng([stream_seed(self.fit.seed, Stream.RESTARTS), restart]))
        if self.frozen is None:
            return table.continued(coefficients) if restart else given
        return table.frozen_parameters(coefficients)

    def _continued(self, minimum: Minimum) -> np.ndarray:
        """The parameters that a minimum of the search gives."""
        return minimum.x if self.frozen is None else self.table.continued(self.frozen.coefficients(minimum.x)[0])

    def differences(self) -> np.ndarray:
        """The differences from the exact flow, at the held-out states and times."""
        return differences(self.flow, self.step, self.held_out)

    def _record(self, minimum: Minimum, differences: np.ndarray | None = None) -> dict[str, float]:
        self.at_end = self.differences() if differences is None else differences
        figures = {
            "step": len(self.minima),
            "loss": minimum.cost,
            "iterations": minimum.iterations,
            **step_errors(self.at_end),
        }
        self.history.append(figures)
        return figures


def _check_memory(points: int, fit: Resolved, numbers: int, ndof: int) -> None:
    """Raise ValueError where the labels and the Jacobian of a fit are more than the memory of the machine."""
    labels = max(points, min(points, FITTED_POINTS) * fit.label_times, fit.reference_states * FRACTIONAL_TIMES)
    check_memory(
        f"`points` {points}, `label_times` {fit.label_times} and `reference_states` {fit.reference_states}",
        2 * ndof * labels * 3 * numbers,
        "take fewer",
    )


def energy_slope(system: HamiltonianSystem, labels: Labels, weight: float) -> np.ndarray | None:
    """∇H at the labels (J, N, 2d), driven that of E + H, over the spread of H; None if it is to count nothing."""
    spread = float(np.std(system.hamiltonian(labels.x, labels.t0)))
    if not (weight > 0 and 0 < spread < math.inf):
        return None
    slope = system.gradient(labels.y, labels.times)
    if labels.work is not None:
        slope = np.concatenate([slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
    return math.sqrt(weight) / spread * slope


def _distinct(minima: list[Minimum]) -> list[Minimum]:
    """The minima from the lowest, without those that are one before again, to 1 % of the cost."""
    kept: list[Minimum] = []
    for m in sorted(minima, key=lambda m: m.cost):
        if not kept or m.cost > 1.01 * kept[-1].cost:
            kept.append(m)
    return kept


# least squares ------------------------------------------------------------------------------------------------------


class StackedFit(Problem):
    """Several fits of the same parameters, with a weight each."""

    def __init__(self, *parts: tuple[float, Problem]) -> None:
        self.parts = parts
        self.compiled = all(fit.compiled for _, fit in parts)

    def own(self) -> Problem:
        return StackedFit(*((weight, fit.own()) for weight, fit in self.parts))

    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        return np.concatenate([math.sqrt(weight) * fit.residuals(theta, check) for weight, fit in self.parts])

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        pieces = [(math.sqrt(weight), *fit.linearized(theta, check)) for weight, fit in self.parts]
        return np.concatenate([w * r for w, r, _ in pieces]), np.concatenate([w * J for w, _, J in pieces])


class RunsFit(Problem, ABC):
    """Errors in long runs by the frozen parameters of a table."""

    record: dict[str, Any]

    @abstractmethod
    def parameters(self, theta: np.ndarray) -> np.ndarray:
        """The flow's parameters that make the table of `theta` at Δt."""


MadeRuns = Callable[[PrimedFlow], RunsFit]


class Restricted(Problem):
    """A fit of parameters that are a point and some directions (f, k) times what is to be found, (k,)."""

    def __init__(self, fit: Problem, point: np.ndarray, directions: np.ndarray) -> None:
        self._fit, self._origin, self._directions = fit, point, directions
        self.start = np.zeros(directions.shape[1])

    def point(self, z: np.ndarray) -> np.ndarray:
        """The parameters."""
        return self._origin + self._directions @ z

    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        return self._fit.residuals(self.point(theta), check)

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        r, J = self._fit.linearized(self.point(theta), check)
        return r, J @ self._directions


class LossProblem(Problem):
    """The residuals of a `Loss` (the flow's residual, Hamiltonian matching, labels at any times) at given points."""

    def __init__(self, table: Table, objective: Objective) -> None:
        self.table, self.objective = table, objective

    def own(self) -> Problem:  # the parameters are put into the flow
        return copy.deepcopy(self)

    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        self.table.assign(theta)
        return replace(self.objective, check=check).residuals().numpy()

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        self.table.assign(theta)
        r, J = replace(self.objective, check=check).linearized()
        return r.detach().numpy(), J.detach().numpy()


class TableFit(Problem):
    """The labels' residuals as a function of parameters on which the table at each time depends affinely."""

    def __init__(
        self,
        step: TableStep,
        labels: Labels,
        offset: np.ndarray,
        design: np.ndarray,
        unit: np.ndarray,
        weight: np.ndarray,
        slope: np.ndarray | None = None,
    ) -> None:
        self.step, self.offset, self.design = step, offset, np.ascontiguousarray(design)
        times, count = len(labels.t), len(labels.x)
        y = labels.y if labels.work is None else np.concatenate([labels.y, -labels.work[..., None]], axis=-1)
        # The sum of squares is a mean over states and times.
        each = np.repeat(weight, count) / math.sqrt(times * count)
        slopes = np.empty((0, len(each))) if slope is None else each * slope.reshape(-1, slope.shape[-1]).T
        ends = np.ascontiguousarray(y.reshape(-1, y.shape[-1]).T)
        of_numbers = self.design[:, step.order]
        self.errors = step.errors(labels.x.T, labels.t0, ends, each / unit[:, None], slopes, of_numbers)
        self.compiled = step.loops is not None

    def coefficients(self, theta: np.ndarray) -> np.ndarray:
        """(J, n)."""
        return self.offset + self.design @ theta

    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        return self.errors(self.coefficients(theta)[:, self.step.order], check)[0]

    def model(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, Blocks]:
        r, columns = self.errors(self.coefficients(theta)[:, self.step.order], check, linearized=True)
        return r, Blocks(columns, self.errors.matrices)

    @np.errstate(all="ignore")  # what is not finite is rejected
    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        r, blocks = self.model(theta, check)
        return r, blocks.whole()


# a table ------------------------------------------------------------------------------------------------------------


class Table:
    """A primed flow's parameters θ as one vector, and its table at any t as an affine function of them.

    The coefficients are those of `TableStep`; one of the processor stands in χ and with the opposite sign in χ⁻¹.
    """

    def __init__(self, flow: PrimedFlow) -> None:
        self.dt, self.flow = flow.dt, flow
        kicks = [i for i, kind in enumerate(flow.sequence) if kind == "kick"]
        n = len(flow.sequence)
        self.n = n + flow.terms * len(kicks)
        named = dict(flow.columns())
        self.columns = [*named.values()]
        self._kernel = sum(not name.startswith("processor_") for name in named)
        self._places = [np.zeros((self.n, c.offset.shape[0])) for c in self.columns]
        index = {id(c): place for c, place in zip(self.columns, self._places, strict=True)}
        for i, substep in enumerate(flow.substeps):
            for term, entry in enumerate(substep.entries):
                row = n + (term - 1) * len(kicks) + kicks.index(i) if term else i
                index[id(entry.column)][row, entry.row] = entry.sign

    def polynomial(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Offset (J, n) and design (J, n, f) of the coefficients at the times t by the flow's parameters."""
        return self._assembled(self.columns, t)

    def frozen(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """The same for a table at one time that is bound by nothing but the palindrome, and friction's total time."""
        return self._assembled(self._unbound(), np.array([t]))

    def frozen_parameters(self, coefficients: np.ndarray) -> np.ndarray:
        """The parameters of `frozen` at Δt of the nearest table to (n,), each column by itself and in powers of τ."""
        return np.concatenate(
            [
                np.linalg.lstsq(
                    doubles(c.basis)[:, 0],
                    self._column(coefficients, place) / self.dt**c.power - doubles(c.offset)[:, 0],
                    rcond=None,
                )[0]
                for c, place in zip(self._unbound(), self._places, strict=True)
            ]
        )

    def _unbound(self) -> list[Coefficients]:
        """The columns of `frozen`."""
        return [
            Coefficients(
                c.n,
                (0,),
                c.power,
                self.flow.palindromic and j < self._kernel,
                "always" if c.total == "always" else None,
                c.present,
                dt=self.dt,
            )
            for j, c in enumerate(self.columns)
        ]

    def _assembled(self, columns: list[Coefficients], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offset, blocks = np.zeros((len(t), self.n)), []
        for c, place in zip(columns, self._places, strict=True):
            constant, design = c.affine(t)
            blocks.append(place @ design)
            offset += constant @ place.T
        return offset, np.concatenate(blocks, axis=-1)

    def free_at_dt(self) -> np.ndarray:
        """Directions (f, k) of the parameters along which the table at Δt stays as it is."""
        design = self.polynomial(np.array([self.dt]))[1][0]
        sizes = np.abs(design).max(0)
        sizes[sizes == 0] = 1.0
        return null_space(design / sizes) / sizes[:, None]

    def continued(self, coefficients: np.ndarray) -> np.ndarray:
        """The parameters for which the table at Δt is the given one (n,), and varies with t as little as may be."""
        parts = []
        for c, place in zip(self.columns, self._places, strict=True):
            basis, offset = doubles(c.basis), doubles(c.offset)
            A = np.concatenate([basis.sum(1), *np.moveaxis(STIFFNESS * basis[:, 1:], 1, 0)])
            b = np.zeros(len(A))
            b[: len(offset)] = self._column(coefficients, place) / self.dt**c.power - offset.sum(1)
            parts.append(np.linalg.lstsq(A, b, rcond=None)[0])
        return np.concatenate(parts)

    @staticmethod
    def _column(coefficients: np.ndarray, place: np.ndarray) -> np.ndarray:
        """The entries of a column in a table."""
        return place.T @ coefficients / np.abs(place).sum(0)

    def parameters(self) -> np.ndarray:
        return np.concatenate([doubles(c.free) for c in self.columns])

    def assign(self, theta: np.ndarray) -> None:
        """Put the parameters into the flow."""
        put_weights([c.free for c in self.columns], torch.as_tensor(theta))

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """A frozen table about that of equal steps, with or without the force gradients of Takahashi and Imada."""
        flow = self.flow
        spread = SPREAD if flow.terms else WIDE_SPREAD
        table, kicks = np.zeros(self.n), np.zeros(0)
        for c, place in zip(self.columns[:2], self._places[:2], strict=True):
            values = rng.normal(1, spread, c.offset.shape[0])
            values = values + values[::-1] if flow.palindromic else values
            values = self.dt * values / values.sum()
            kicks = values if c is flow.kicks else kicks
            table += place @ values
        if flow.gradients is not None:
            table += self._places[2] @ (rng.choice([0.0, 1 / 12]) * np.abs(kicks) ** 3)
        elif flow.polynomials is not None:
            size = rng.choice([0.0, 1 / 12]) * np.abs(kicks) ** 3
            for place, e in zip(self._places[2 : self._kernel], flow.force_gradient_coefficients(), strict=True):
                table += place @ (size * e)
        for c, place in zip(self.columns[self._kernel :], self._places[self._kernel :], strict=True):
            if c.power == 1:
                table += place @ rng.normal(0, PROCESSOR_SPREAD * self.dt, c.offset.shape[0])
        return table


# errors at held-out states ------------------------------------------------------------------------------------------


@np.errstate(all="ignore")  # of flows that are far from the exact one
def differences(flow: PrimedFlow, step: TableStep, labels: Labels) -> np.ndarray:
    """ψ̄_t(x) − φ_H,t(x) at the labels: (J, N, 2d)."""
    table = Table(flow)
    offset, design = table.polynomial(labels.t)
    coefficients = offset + design @ table.parameters()
    width = labels.x.shape[1]
    return step.by_each(coefficients, labels.x.T, labels.t0)[:, :width].swapaxes(1, 2) - labels.y


@np.errstate(all="ignore")
def distance(difference: np.ndarray, unit: np.ndarray) -> float:
    """The mean error of a flow at Δt and before it, in units (2d,); infinite if anything is not a number."""
    figures = step_errors(difference / unit)
    both = figures["one_step_error"] + figures["fractional_error"]
    return both if math.isfinite(both) else math.inf
