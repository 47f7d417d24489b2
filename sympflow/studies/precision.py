"""work_precision(): error against cost, for every method over a sweep of its steps or tolerances."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_t_span
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.metrics.accuracy import reference_error
from sympflow.metrics.energy import failed, max_energy_error
from sympflow.metrics.reference import Reference
from sympflow.metrics.reference import reference as compute_reference
from sympflow.solution import Solution
from sympflow.solver import check_y0, solve
from sympflow.studies.candidates import Candidate, candidates
from sympflow.studies.precision_points import Point, break_even
from sympflow.studies.precision_report import WorkPrecision
from sympflow.timing import interleaved

METHODS = ("verlet", "leapfrog", "blanes_moan4", "srkn11b", "kahan_li8", "rk45", "dop853", "sympflow", "mlp")
TOLERANCES = tuple(10.0**-k for k in range(3, 13))
LARGEST_STEP, N_STEPS = 32, 14  # the default sweep: from 32·system.dt, halving
FLOOR = 1e-12  # energy error from which smaller steps only cost more
SCIPY_SAMPLE = 4  # trajectories of a batch that are run by a method that takes them one by one
MARGIN = 100.0  # by which a reference must be better than an error


def work_precision(
    system: HamiltonianSystem,
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
        Steps of fixed-step methods; by default 32·system.dt, halved until the energy error is at rounding, at most to
        system.dt/256.
    tolerances : sequence of float
        rtol of adaptive methods, with atol = rtol/1000, the ratio of SciPy's defaults.
    n_outputs : int
        Number of instants. Reaching one between two steps costs a method a shorter step, in run time and in
        evaluations: with steps as long as the time between instants it is the outputs that are measured.
    repeats : int
        Timed runs of each point, interleaved over all points of one batch size.
    budget : float
        Seconds that the repeats of one point may take; where one run takes longer, it is not repeated.
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
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    for name, values in (("steps", steps or [1.0]), ("tolerances", tolerances)):
        if not all(0 < x < math.inf for x in values):
            raise ValueError(f"`{name}` must be positive and finite; got {list(values)}.")
    check_counts(n_outputs=n_outputs, repeats=repeats)
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    if t0 == t1:
        raise ValueError("`t_span` has length zero, so there is nothing to measure: choose a later end.")
    starts = [check_y0(system, system.y0 if y0 is None else y0, None)]
    if starts[0].ndim != 1:
        raise ValueError("`y0` must be one state: give several as `batch`.")
    if batch is not None:
        starts.append(_batch(system, batch))
    if steps is None:
        steps = [LARGEST_STEP * system.dt / 2**k for k in range(N_STEPS)]
    swept = [(c, _sweep(c, c.label in methods, steps, tolerances)) for c in candidates(methods)]
    t = t0 + (t1 - t0) * np.arange(1, n_outputs + 1) / n_outputs
    rows: list[Point] = []
    references: list[Reference | None] = []
    for start in starts:
        scene = f"{system.name}, {start.size // start.shape[-1]} trajectories"
        say = partial(_prefixed, progress, scene)
        measured, truth = _measure(system, swept, (t0, t1), start, t, repeats, budget, backend, say)
        rows += break_even(measured, abs(t1 - t0))
        references.append(truth)
    return WorkPrecision(system, (t0, t1), n_outputs, repeats, tuple(references), tuple(rows))


def _prefixed(progress: Callable[[str], None] | None, scene: str, text: str) -> None:
    if progress is not None:
        progress(f"{scene}: {text}")


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


def _sweep(candidate: Candidate, by_name: bool, steps: Sequence[float], tolerances: Sequence[float]) -> list[Any]:
    """The candidate's integrator at each of its steps or tolerances, from coarse to fine."""
    integrator = candidate.integrator
    if integrator is None or not by_name or integrator.trained:
        return [integrator]
    if isinstance(integrator, FixedStep):
        return [replace(integrator, dt=dt) for dt in sorted(steps, reverse=True)]
    if "rtol" in integrator.options():
        return [replace(integrator, rtol=r, atol=r / 1000) for r in sorted(tolerances, reverse=True)]
    return [integrator]


def _measure(
    system: HamiltonianSystem,
    swept: list[tuple[Candidate, list[Any]]],
    t_span: tuple[float, float],
    y0: np.ndarray,
    t: np.ndarray,
    repeats: int,
    budget: float,
    backend: str,
    say: Callable[[str], None],
) -> tuple[list[Point], Reference | None]:
    """All points for one set of initial states."""
    n = len(y0) if y0.ndim > 1 else 1

    def run(integrator: Integrator | None) -> Solution:
        few = y0[:SCIPY_SAMPLE] if _one_by_one(integrator) and n > SCIPY_SAMPLE else y0
        return solve(system, integrator, t_span, few, t_eval=t, backend=backend)

    points: list[Point] = []
    solutions: list[Solution | None] = []
    for candidate, integrators in swept:
        say(candidate.label)
        for integrator in integrators:
            empty = Point(system.name, candidate.method, candidate.label, n)
            sol, point = _first(empty, candidate, partial(run, integrator))
            points.append(point)
            solutions.append(sol)
            if point.status == "not applicable" or (point.energy_error or math.inf) < FLOOR:
                break

    say("timing")
    again = [
        (i, sol)
        for i, (p, sol) in enumerate(zip(points, solutions, strict=True))
        if sol is not None and p.status == "ok" and (p.run_time or 0.0) * repeats <= budget
    ]
    times = interleaved([partial(run, sol.integrator) for _, sol in again], repeats) if again else []
    for (i, _), time in zip(again, times, strict=True):
        points[i] = replace(points[i], run_time=time.median, run_time_spread=time.spread, repeats=repeats)
    points = [
        p if sol is None else _scaled(p, n / (sol.y0.size // sol.y0.shape[-1]))
        for p, sol in zip(points, solutions, strict=True)
    ]
    say("reference")
    return _errors(points, solutions, system, t_span, y0, t)


def _scaled(point: Point, share: float) -> Point:
    """The point of a few trajectories, for all of them."""
    if share == 1:
        return point
    note = f"Timed on {point.trajectories / share:.0f} trajectories, which the method takes one by one."
    run_time, spread = (None if x is None else x * share for x in (point.run_time, point.run_time_spread))
    return replace(point, run_time=run_time, run_time_spread=spread, reason=f"{point.reason} {note}".strip())


def _one_by_one(integrator: Integrator | None) -> bool:
    """Whether the method loops over the trajectories of a batch."""
    return integrator is not None and type(integrator).__module__.endswith("scipy_methods")


def _first(point: Point, candidate: Candidate, run: Callable[[], Solution]) -> tuple[Solution | None, Point]:
    """The first run of a point, which also compiles."""
    try:
        if candidate.problem:
            raise ImportError(candidate.problem)
        sol = run()
    except (ValueError, TypeError, ImportError, NotImplementedError) as error:
        return None, replace(point, status="not applicable", reason=str(error))
    except Exception as error:
        return None, replace(point, status="failed", reason=f"{type(error).__name__}: {error}")
    stats, n = sol.stats, sol.y0[..., 0].size
    integrator: Any = sol.integrator
    share = n if _one_by_one(integrator) else 1
    figures = integrator.flow_for(sol.system).figures if integrator.trained else {}
    lost = bool(np.median(failed(sol)) > 0)
    return sol, replace(
        point,
        dt=stats.get("dt"),
        tolerance=getattr(integrator, "rtol", None),
        status="failed" if lost else "ok",
        reason="" if sol.success else sol.message,
        backend=stats.get("backend"),
        run_time=None if lost else stats["wall_time"],
        repeats=1,
        force_evaluations=stats["force_evaluations"] / share,
        hessian_evaluations=stats["hessian_evaluations"] / share,
        energy_error=float(np.median(max_energy_error(sol))),
        training_time=figures.get("training_seconds"),
    )


def _errors(
    points: list[Point],
    solutions: list[Solution | None],
    system: HamiltonianSystem,
    t_span: tuple[float, float],
    y0: np.ndarray,
    t: np.ndarray,
) -> tuple[list[Point], Reference | None]:
    """Fill in the errors against a reference; mark those that it cannot resolve."""
    try:
        truth = compute_reference(system, t_span, y0, t)
    except (ValueError, RuntimeError) as problem:
        return [replace(p, reason=f"{p.reason} No error: {problem}".strip()) for p in points], None
    filled = []
    for point, sol in zip(points, solutions, strict=True):
        if sol is None or point.status != "ok":
            filled.append(point)
            continue
        y_ref = truth.y if sol.y.shape == truth.y.shape else truth.y[: len(sol.y0)]
        worst = reference_error(sol, y_ref).max(axis=-1)
        error = float(np.median(np.where(np.isnan(worst), np.inf, worst)))
        status = "ok" if error >= MARGIN * truth.accuracy else "uncertain"
        filled.append(replace(point, error=error, status=status))
    return filled, truth
