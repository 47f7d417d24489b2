"""work_precision(): error against cost, for every method over a sweep of its steps or tolerances; and its report."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_t_span, positive_numbers
from sympflow.arrays import to_numpy
from sympflow.hamiltonian.scales import smallest_size, started
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.problems import check_y0
from sympflow.metrics.energy import failed
from sympflow.metrics.energy_balance import kept_by
from sympflow.metrics.reference import Reference
from sympflow.metrics.reference import reference as compute_reference
from sympflow.show.style import saved
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.studies import attempts
from sympflow.studies.attempts import CELLS, Attempt, Candidate, Row, candidates, counted, interleaved, tolerance_of
from sympflow.studies.reports import Column, Report, described, seconds, text_table
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = ("verlet", "leapfrog", "blanes_moan4", "srkn11b", "kahan_li8", "rk45", "dop853", "sympflow", "mlp")
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
LARGEST_STEP, N_STEPS = 32, 14  # the default sweep: from 32·system.dt, halving
LEVELS = (1e-3, 1e-6, 1e-9)  # energy errors for which the table gives the costs
FLOOR = 1e-12  # error from which smaller steps only cost more
NEAR_FLOOR = 1e-6  # and of the point before it: an error that is small by chance is no end
SAMPLE = 4  # trajectories of a batch that are run by a method that takes them one by one
MARGIN = 100.0  # by which a reference must be better than an error


def work_precision(
    system: GivenSystem,
    methods: Sequence[Any] = METHODS,
    *,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    batch: int | ArrayLike | None = None,
    steps: Sequence[float] | None = None,
    tolerances: Sequence[float] = TOLERANCES,
    n_outputs: int = 100,
    repeats: int = 5,
    budget: float = 20.0,
    backend: str = "auto",
    progress: Callable[[str], None] | None = None,
) -> WorkPrecision:
    """Sweep steps and tolerances, and measure error, run time and evaluations.

    The error is the energy error; for a driven system that of the energy balance, see `energy_balance_error`; for a
    damped one that of the state. The error of the state is always measured as well.

    Parameters
    ----------
    system : HamiltonianSystem
    methods : sequence
        As for `compare`. A method given by name is swept; a configured integrator and a trained flow are one point.
    t_span, y0 : optional
        Interval and state of the run of one trajectory; the system's by default.
    batch : int or array_like (n, 2d), optional
        Also run this many states of the system's domain (seed 0), or these states. By default there is no batch.
    steps : sequence of float, optional
        Steps of fixed-step methods; by default 32·system.dt, halved until the error is at rounding, at most to
        system.dt/256.
    tolerances : sequence of float
        rtol of adaptive methods, with atol = rtol/1000, the ratio of SciPy's defaults, times the size of q and p at y0.
    n_outputs : int
        Number of instants, as for `compare`. An instant between two steps costs a shorter step, in run time and in
        evaluations: for steps as long as the time between instants the outputs dominate the cost.
    repeats : int
        Timed runs of each point, interleaved over all points of one batch size.
    budget : float
        Seconds that the repeats of one point may take; where one run takes longer, it is not repeated. The code of a
        method is compiled before, in `compile_time`.
    backend, progress
        As for `compare`.

    Returns
    -------
    WorkPrecision
        With `.rows`, `.table()`, `.to_csv()`, `.to_json()`, `.figure()` and `.plot()`.

    Notes
    -----
    Errors are against a reference that is 100 times as accurate as the smallest of them, where float64 can hold that;
    points below are marked "uncertain". SciPy's methods take the trajectories of a batch one by one: they are timed on
    a few, and the time is scaled to all.
    """
    system = given_system(system)
    tolerances = positive_numbers("tolerances", tolerances)
    if steps is not None:
        steps = positive_numbers("steps", steps)
    if isinstance(budget, bool) or not isinstance(budget, int | float | np.number) or not budget >= 0:
        raise ValueError(f"`budget` must be a number of seconds; got {budget!r}: pass 0 to repeat nothing.")
    attempts.check_progress(progress)
    check_counts(n_outputs=n_outputs, repeats=repeats)
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    if t0 == t1:
        raise ValueError("`t_span` has length zero, so there is nothing to measure: choose a later end.")
    starts = [check_y0(system, system.y0 if y0 is None else y0, None)]
    system = started(system, to_numpy(starts[0]))
    if starts[0].ndim != 1:
        raise ValueError("`y0` must be one state: give several as `batch`.")
    if batch is not None:
        starts.append(_batch(system, batch))
    dt, size = system.dt if steps is None else steps[0], smallest_size(system, starts[0])
    if steps is None:
        steps = [LARGEST_STEP * system.dt / 2**k for k in range(N_STEPS)]
    swept = [(c, _sweep(c, c.label in methods, steps, tolerances, size)) for c in candidates(methods)]
    t = attempts.instants(t0, t1, n_outputs, dt)
    rows: list[Row] = []
    references: list[Reference | None] = []
    for start in starts:
        conditions = Conditions(system, (t0, t1), start, t, backend)
        measured, truth = _measure(conditions, swept, repeats, budget, progress or (lambda text: None))
        rows += break_even(measured, abs(t1 - t0), measure_of(system))
        references.append(truth)
    return WorkPrecision(system, (t0, t1), n_outputs, repeats, tuple(references), tuple(rows))


def _batch(system: HamiltonianSystem, batch: int | ArrayLike) -> np.ndarray:
    if isinstance(batch, int | np.integer):
        if batch < 1 or isinstance(batch, bool):
            raise ValueError(f"`batch` must be a positive number of states; got {batch!r}.")
        if system.domain is None:
            raise ValueError(f"`batch` cannot be drawn: {system.name!r} has no domain. Pass the states themselves.")
        return system.domain.sample(int(batch), 0)
    states = check_y0(system, batch, None)
    if states.ndim != 2:
        raise ValueError(f"`batch` must be a number, or states of shape (n, {2 * system.ndof}); got {states.shape}.")
    return states


def _sweep(candidate: Candidate, by_name: bool, steps: list[float], tolerances: list[float], size: float) -> list[Any]:
    """The candidate's integrator at each of its steps or tolerances, from coarse to fine; `size` is that of states."""
    integrator = candidate.integrator
    if integrator is None or not by_name or integrator.trained:
        return [integrator]
    if isinstance(integrator, FixedStep):
        return [replace(integrator, dt=dt) for dt in sorted(steps, reverse=True)]
    if tolerance_of(integrator) is not None:
        return [replace(integrator, rtol=r, atol=r / 1000 * size) for r in sorted(tolerances, reverse=True)]
    return [integrator]


def measure_of(system: HamiltonianSystem) -> str:
    """The figure of a row by which methods are compared on a system: the energy error, if its flow conserves energy."""
    return f"{kept_by(system)}_error".removeprefix("_")


@dataclass(frozen=True)
class Conditions:
    """One set of initial states, the interval and the instants, under which every point is run."""

    system: HamiltonianSystem
    t_span: tuple[float, float]
    y0: np.ndarray
    t: np.ndarray
    backend: str

    @property
    def trajectories(self) -> int:
        return self.y0.size // self.y0.shape[-1]

    def run(self, integrator: Any, t_span: tuple[float, float] | None = None, t: np.ndarray | None = None) -> Solution:
        """The solution from all initial states, or of a method that takes them one by one from a few.

        Over another interval if that is given.
        """
        y0 = self.y0[:SAMPLE] if integrator.one_by_one and self.trajectories > SAMPLE else self.y0
        times = self.t if t is None else t
        return solve(self.system, integrator, t_span or self.t_span, y0, t_eval=times, backend=self.backend)


def _measure(
    conditions: Conditions,
    swept: list[tuple[Candidate, list[Any]]],
    repeats: int,
    budget: float,
    say: Callable[[str], None],
) -> tuple[list[Row], Reference | None]:
    """All points for one set of initial states."""
    scene = f"{conditions.system.name}, {conditions.trajectories} trajectories"
    say(f"{scene}: reference")
    truth, problem = _reference(conditions)
    resolved = MARGIN * (0.0 if truth is None or truth.accuracy is None else truth.accuracy)
    floor = FLOOR if kept_by(conditions.system) else max(FLOOR, resolved)
    points: list[Attempt] = []
    for candidate, integrators in swept:
        say(f"{scene}: {candidate.label}")
        error = math.inf
        row = Row(conditions.system.name, candidate.method, candidate.label, trajectories=conditions.trajectories)
        warm = Attempt(replace(candidate, integrator=integrators[-1]), row)
        warm.warm_up(conditions.run, conditions.t, conditions.t_span[0], conditions.system.dt)
        for integrator in integrators:
            point = _first(Attempt(replace(candidate, integrator=integrator), warm.row), conditions)
            points.append(point)
            if truth is None:
                point.note(f"No error: {problem}")
            elif point.row.status == "ok":
                attempts.accuracy(point, truth)
            before = error
            error = _figure(point.row, measure_of(conditions.system))
            if point.row.status == "not applicable" or (error < floor and before < max(NEAR_FLOOR, 1e3 * floor)):
                break
    say(f"{scene}: timing")
    again = [p for p in points if p.row.status == "ok" and (p.row.run_time or 0.0) * repeats <= budget]
    times = interleaved([partial(conditions.run, p.candidate.integrator) for p in again], repeats)
    for point, run_time in zip(again, times, strict=True):
        point.fill(run_time=run_time.median, run_time_spread=run_time.spread, repeats=repeats)
    for point in points:
        if point.sol is not None and (few := point.sol.y0.size // point.sol.y0.shape[-1]) < conditions.trajectories:
            _scale(point, few, conditions.trajectories)
        if point.row.status == "ok" and truth is not None and not (point.row.error or 0.0) >= resolved:
            point.fill(status="uncertain")
    return [point.row for point in points], truth


def _reference(conditions: Conditions) -> tuple[Reference | None, str]:
    """The reference; None and the reason where there is none."""
    try:
        return compute_reference(conditions.system, conditions.t_span, conditions.y0, conditions.t), ""
    except (ValueError, RuntimeError) as problem:
        return None, str(problem)


def _scale(point: Attempt, few: int, all_of_them: int) -> None:
    """Scale the run time of a few trajectories to all of them."""
    times = {"run_time": point.row.run_time, "run_time_spread": point.row.run_time_spread}
    point.fill(**{name: None if x is None else x * (all_of_them / few) for name, x in times.items()})
    point.note(f"Timed on {few} trajectories, which the method takes one by one.")


def _first(point: Attempt, conditions: Conditions) -> Attempt:
    """The point after its first run."""
    point.run(conditions.run)
    if (sol := point.sol) is None:
        return point
    lost = bool(np.median(failed(sol)) > 0)
    share = sol.y0[..., 0].size if sol.integrator.one_by_one else 1
    point.fill(
        status="failed" if lost else "ok",
        run_time=None if lost else sol.stats["wall_time"],
        repeats=1,
        force_evaluations=sol.stats["force_evaluations"] / share,
        hessian_evaluations=sol.stats["hessian_evaluations"] / share,
    )
    if kept := kept_by(conditions.system):
        point.measure([kept])
    return point


SETTINGS = ("dt", "tolerance")  # settings of a method: the largest that reaches an error is the cheapest


def break_even(points: list[Row], length: float, measure: str = "energy_error") -> list[Row]:
    """Fill in when the training of each flow has paid for itself, for runs over an interval of that length."""
    done = [p for p in points if p.run_time and math.isfinite(_figure(p, measure))]
    untrained = [p for p in done if p.training_time is None and p.method not in ("sympflow", "mlp")]
    filled = []
    for point in points:
        if point in done and point.training_time is not None and untrained:
            labels, error = {p.label for p in untrained}, _figure(point, measure)
            rival = min(cost_at([p for p in untrained if p.label == n], error, measure=measure) for n in labels)
            if math.isinf(rival):  # no untrained point is as accurate: nothing to compare with
                reason = "No break-even: no untrained method was run at a step that reaches this error."
                filled.append(replace(point, reason=f"{point.reason} {reason}".strip()))
                continue
            saved = (rival - (point.run_time or 0.0)) / length
            point = replace(point, break_even=point.training_time / saved if saved > 0 else math.inf)  # noqa: PLW2901
        filled.append(point)
    return filled


def _figure(point: Row, measure: str) -> float:
    """A figure of a row, inf where it is missing."""
    figure = getattr(point, measure)
    return math.inf if figure is None else figure


def cost_at(points: Sequence[Row], error: float, cost: str = "run_time", measure: str = "energy_error") -> float:
    """Return the cost of one method for an error: between two of its points by interpolation of the logarithms.

    The cheapest point that is more accurate is taken where that costs less; inf if no point is accurate enough. A step
    or a tolerance is the largest that reaches the error.
    """
    known = [(getattr(p, measure), getattr(p, cost)) for p in points]
    known = sorted((e, c) for e, c in known if e and c and math.isfinite(e))
    best = max if cost in SETTINGS else min
    enough = best((c for e, c in known if e <= error), default=math.inf)
    for (e0, c0), (e1, c1) in pairwise(known):
        if e0 <= error <= e1 and e0 < e1:
            share = math.log(error / e0) / math.log(e1 / e0)
            enough = best(enough, c0 * (c1 / c0) ** share)
    return enough


@dataclass(frozen=True, repr=False)
class WorkPrecision(Report):
    """Error against cost on one system.

    Attributes
    ----------
    system, t_span, n_outputs, repeats
        The scene.
    references : tuple of (Reference or None)
        For one trajectory, and for the batch if there is one.
    rows : tuple of Row
    """

    columns: ClassVar[tuple[str, ...]] = (
        *("system", "method", "label", "trajectories", "dt", "tolerance", "status", "reason", "backend", "run_time"),
        *("run_time_spread", "compile_time", "repeats", "force_evaluations", "hessian_evaluations", "error"),
        *("energy_error", "balance_error", "training_time", "break_even"),
    )

    system: HamiltonianSystem
    t_span: tuple[float, float]
    n_outputs: int
    repeats: int
    references: tuple[Reference | None, ...]
    rows: tuple[Row, ...]

    @property
    def title(self) -> str:
        """The scene in a line."""
        return self.system.title

    @property
    def measure(self) -> str:
        """The error by which methods are judged: "energy_error", "balance_error" or "error"."""
        return measure_of(self.system)

    @property
    def sizes(self) -> list[int]:
        """Numbers of trajectories: 1, and the size of the batch."""
        return sorted({row.trajectories for row in self.rows})

    def table(self, levels: tuple[float, ...] = LEVELS) -> str:
        """Evaluations and run time of each method for each level of the error; then every point."""
        heading = [f"{self.title}: t = {self.t_span[0]:g} … {self.t_span[1]:g}, {self.n_outputs} instants"]
        for size, reference in zip(self.sizes, self.references, strict=True):
            known = "none" if reference is None else reference.described()
            heading.append(f"reference for {_size(size)}: {known}")
        blocks = [
            f"For {_WORDS[self.measure]} of …, {_size(size)} (run time of all, evaluations of one)\n\n"
            + self._at(size, levels)
            for size in self.sizes
        ]
        notes = dict.fromkeys(f"  {row.label}: {row.reason}" for row in self.rows if row.reason)
        below = ["\n".join(["Notes", *notes])] if notes else []
        titles = ("method", "batch", "step", "rtol", "backend", "run time", "±", "forces", "Hessians")
        errors = ("error", "energy error", "energy balance", "status")
        points = text_table(attempts.columns(self.rows, titles + errors))
        return "\n\n".join(["\n".join(heading), *blocks, f"Every point\n\n{points}", *below])

    def _at(self, size: int, levels: tuple[float, ...]) -> str:
        rows = [row for row in self.rows if row.trajectories == size]
        labels = list(dict.fromkeys(row.label for row in rows))
        columns = [Column("method", labels, left=True)]
        for level in levels:
            for cost, show in (("force_evaluations", counted), ("run_time", seconds)):
                found = [cost_at([r for r in rows if r.label == label], level, cost, self.measure) for label in labels]
                head = f"{level:.0e}" if cost == "run_time" else "forces"
                columns.append(Column(head, [show(x) if math.isfinite(x) else "–" for x in found]))
            columns.append(Column("step", [self._setting([r for r in rows if r.label == n], level) for n in labels]))
        first = {row.label: row for row in reversed(rows)}
        trained = {row.label: row for row in rows if row.training_time is not None}
        for title in ("training", "paid after t ="):
            cell = CELLS.get(title, _paid)
            columns.append(Column(title, [cell(trained[n]) if n in trained else "" for n in labels]))
        return text_table([*columns, *attempts.columns([first[n] for n in labels], ["compiled in"])])

    def _setting(self, rows: list[Row], level: float) -> str:
        """The step with which a method reaches a level, or its tolerance."""
        step, rtol = (cost_at(rows, level, setting, self.measure) for setting in SETTINGS)
        return f"rtol {rtol:.0e}" if rtol < math.inf else f"{step:.2g}" if step < math.inf else ""

    def settings(self) -> dict[str, Any]:
        return {
            "system": described(self.system),
            "t_span": list(self.t_span),
            "n_outputs": self.n_outputs,
            "repeats": self.repeats,
            "references": [None if r is None else r.summary() for r in self.references],
        }

    def figure(self, measure: str | None = None) -> Figure:
        """Error against run time and against evaluations, log–log; a row for one trajectory and one for the batch.

        Parameters
        ----------
        measure : "energy_error", "balance_error" or "error", optional
            By default that by which methods are judged.
        """
        from sympflow.studies.figures import precision_figure

        t0, t1 = self.t_span
        return precision_figure(self.rows, f"{self.title}, T = {t1 - t0:g}", measure or self.measure)

    def plot(self, path: str | os.PathLike[str] | None = None, measure: str | None = None) -> Figure:
        """The figure, as `figure`; with a path it is also saved."""
        return saved(self.figure(measure), path)


_WORDS = {"energy_error": "an energy error", "balance_error": "an energy balance error", "error": "an error"}


def _size(n: int) -> str:
    return "one trajectory" if n == 1 else f"a batch of {n:,}"


def _paid(row: Row) -> str:
    x = row.break_even
    return "" if x is None else "never" if x == math.inf else f"{x:.2g}"
