"""compare(): several methods on one system, at the same instants, against one reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_t_span
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.accuracy import reference_error, states_of
from sympflow.metrics.energy import failed, max_energy_error
from sympflow.metrics.reference import Reference
from sympflow.metrics.reference import reference as compute_reference
from sympflow.solution import Solution
from sympflow.solver import check_y0, solve
from sympflow.studies.candidates import candidates
from sympflow.studies.comparison_report import Comparison
from sympflow.studies.matching import match as match_to
from sympflow.studies.matching import tunable
from sympflow.studies.measurements import MEASURES, Row, Run, largest, measure, note_backends
from sympflow.timing import interleaved

METRICS = tuple(MEASURES)
MATCHES = ("time", "evaluations", "energy_error")
PAPER = ("sympflow", "mlp", "verlet", "leapfrog", "rk45")


def compare(
    system: HamiltonianSystem,
    methods: Sequence[Any] = PAPER,
    metrics: Sequence[str] = METRICS[:5],
    *,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    dt: float | None = None,
    n_outputs: int = 1000,
    repeats: int = 5,
    match: str | None = None,
    reference: Reference | Solution | ArrayLike | None = None,
    backend: str = "auto",
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Run every method on the system and measure it, at the same instants and against one reference.

    A method that does not apply, or fails, gets a row that says why.

    Parameters
    ----------
    system : HamiltonianSystem
    methods : sequence
        Each a name, a configured integrator such as ``get("verlet")(dt=0.01)``, a trained flow, or a pair
        (label, any of these).
    metrics : sequence of str
        Any of "error", "energy", "drift", "volume", "symplecticity" and "reversal". Others are not computed.
    t_span, y0 : optional
        Interval and initial state (or batch); the system's by default.
    dt : float, optional
        Step of the fixed-step classical methods that are given by name; `system.dt` by default.
    n_outputs : int
        Number of instants, equally spaced and ending at the end of the interval.
    repeats : int
        Runs that are timed, interleaved over the methods, after one that is not.
    match : "time", "evaluations" or "energy_error", optional
        Tune the steps and tolerances of the methods after the first until they equal it in this.
        By default each method runs at its stated step or tolerance.
    reference : Reference, Solution or array_like (..., 2d, n_outputs), optional
        States at the instants that are compared.
        Computed by default: exact, or tighter than the smallest error by a factor of 100 where float64 can hold that.
    backend : "auto", "compiled" or "array"
        As for `solve`; a method that lacks the backend asked for gets a row that says so.
    progress : callable, optional
        Called with a line of text when something begins.

    Returns
    -------
    Comparison
        With `.rows`, `.table()`, `.to_csv()`, `.to_json()` and `.plot()`.

    Notes
    -----
    The run time is that of `solve`, with everything that the outputs need.

    Examples
    --------
    >>> import sympflow
    >>> report = sympflow.compare(sympflow.systems.pendulum(), ["verlet", "rk45"], ("energy",), repeats=1)
    >>> [row.status for row in report.rows]
    ['ok', 'ok']
    """
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    asked = _check_metrics(metrics)
    check_counts(n_outputs=n_outputs, repeats=repeats)
    if match is not None and match not in MATCHES:
        raise ValueError(f"`match` must be one of {', '.join(map(repr, MATCHES))}, or None; got {match!r}.")
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    if t0 == t1:
        raise ValueError("`t_span` has length zero, so there is nothing to compare: choose a later end.")
    start = check_y0(system, system.y0 if y0 is None else y0, None)
    t = t0 + (t1 - t0) * np.arange(1, n_outputs + 1) / n_outputs
    given = None if reference is None else _given(reference, start, t)
    say = progress or (lambda text: None)

    def run(integrator: Any) -> Solution:
        return solve(system, integrator, (t0, t1), start, t_eval=t, backend=backend)

    runs = [Run(c, Row(_identify(system), c.method, c.label)) for c in candidates(methods, dt)]
    for one in runs:
        say(f"{system.name}: running {one.candidate.label}")
        _first_run(one, run)
    if match is not None:
        _match(runs, match, run, system, repeats, say)
    note_backends(runs)
    ready = [one for one in runs if one.row.status == "ok"]
    say(f"{system.name}: timing")
    times = interleaved([partial(run, one.candidate.integrator) for one in ready], repeats) if ready else []
    for one, run_time in zip(ready, times, strict=True):
        one.row = replace(one.row, run_time=run_time.median, run_time_spread=run_time.spread)
    truth = None
    if "error" in asked and any(one.sol is not None for one in runs):
        say(f"{system.name}: reference")
        truth = _errors(runs, system, (t0, t1), start, t, given)
    for one in runs:
        if one.sol is not None:
            say(f"{system.name}: measuring {one.candidate.label}")
            measure(one, one.sol, asked)
    return Comparison(system, (t0, t1), start, t, asked, repeats, match, truth, tuple(runs))


def _identify(system: HamiltonianSystem) -> str:
    params = ", ".join(f"{k}={v:g}" for k, v in system.params.items())
    return f"{system.name}({params})" if params else system.name


def _given(reference: Reference | Solution | ArrayLike, y0: np.ndarray, t: np.ndarray) -> Reference:
    """The reference that was given, if it is one and fits."""
    if isinstance(reference, Reference | Solution):
        if len(reference.t) != len(t) or not np.allclose(reference.t, t, rtol=1e-12, atol=0):
            raise ValueError(f"`reference` must be at the {len(t)} instants that are compared: see `.t` of the result.")
        found = reference if isinstance(reference, Reference) else Reference(t, states_of(reference.y), "given", 0.0)
    else:
        found = Reference(t, states_of(reference), "given", 0.0)
    if found.y.shape != (*y0.shape, len(t)):
        raise ValueError(f"`reference` must have the shape {(*y0.shape, len(t))} of the states; got {found.y.shape}.")
    return found


def _check_metrics(metrics: Sequence[str]) -> tuple[str, ...]:
    if not isinstance(metrics, Iterable):
        raise TypeError(f"`metrics` must be a list of names from {', '.join(METRICS)}; got {metrics!r}.")
    asked = (metrics,) if isinstance(metrics, str) else tuple(metrics)
    unknown = [m for m in asked if m not in METRICS]
    if unknown:
        raise ValueError(f"`metrics` has no {unknown[0]!r}: choose from {', '.join(METRICS)}.")
    return asked


def _first_run(one: Run, run: Callable[[Any], Solution]) -> None:
    """Run once, which also compiles; note what the solution says, or why there is none."""
    integrator = one.candidate.integrator
    try:
        if one.candidate.problem:
            raise ImportError(one.candidate.problem)
        sol = run(integrator)
    except (ValueError, TypeError, ImportError, NotImplementedError) as error:
        one.row = replace(one.row, status="not applicable", reason=str(error))
        return
    except Exception as error:
        one.row = replace(one.row, status="failed", reason=f"{type(error).__name__}: {error}")
        return
    stats = sol.stats
    one.sol = sol
    one.row = replace(
        one.row,
        status="failed" if failed(sol).all() or (sol.y.ndim == 2 and not sol.success) else "ok",
        reason="" if sol.success else sol.message,
        dt=stats.get("dt"),
        tolerance=getattr(integrator, "rtol", None),
        backend=stats.get("backend"),
        force_evaluations=int(stats["force_evaluations"]),
        hessian_evaluations=int(stats["hessian_evaluations"]),
    )
    if sol.success and "domain_exit" in stats:
        one.note(f"The state left the flow's domain at t = {stats['domain_exit']:.4g}.")
    ran: Any = sol.integrator  # with `tol` it may be another than was asked for: see `SympFlowIntegrator.resolved`
    if ran.trained:
        flow = getattr(ran, "flow", None)
        figures = (ran.flow_for(sol.system) if flow is None else flow).figures
        one.row = replace(one.row, training_time=figures.get("training_seconds"))


def _match(
    runs: list[Run],
    what: str,
    run: Callable[[Any], Solution],
    system: HamiltonianSystem,
    repeats: int,
    say: Callable[[str], None],
) -> None:
    """Tune every method that can be to the first one that ran and has the figure."""

    def figure(integrator: Any) -> float:
        sol = run(integrator)
        if not sol.success:
            return math.inf
        if what == "energy_error":
            return float(np.median(max_energy_error(sol)))
        if what == "evaluations":
            return float(sol.stats["force_evaluations"] + sol.stats["hessian_evaluations"])
        return interleaved([partial(run, integrator)], min(repeats, 3))[0].median

    targets = ((one, figure(one.candidate.integrator)) for one in runs if one.row.status == "ok")
    anchor, target = next(((one, x) for one, x in targets if 0 < x < math.inf), (None, math.nan))
    for one in runs:
        if anchor is None or one is anchor or one.row.status == "not applicable":
            continue
        if not tunable(one.candidate.integrator):
            one.note(f"Not matched: {one.candidate.label} has no step to tune.")
            continue
        say(f"{system.name}: matching {one.candidate.label}")
        integrator, reached = match_to(one.candidate.integrator, system, figure, target, what == "energy_error")
        one.candidate = replace(one.candidate, integrator=integrator)
        one.row = Row(_identify(system), one.candidate.method, one.candidate.label)
        _first_run(one, run)
        if not abs(math.log(reached / target)) < 0.1:
            one.note(f"Matched only to {reached:.2g} where {anchor.candidate.label} has {target:.2g}.")


def _errors(
    runs: list[Run],
    system: HamiltonianSystem,
    t_span: tuple[float, float],
    y0: np.ndarray,
    t: np.ndarray,
    given: Reference | None,
) -> Reference | None:
    """Fill in the errors; tighten a computed reference until it is 100 times better than the best of them."""
    measured = [(one, one.sol) for one in runs if one.sol is not None]
    target = 1e-8
    for _ in range(2):
        try:
            truth = given or compute_reference(system, t_span, y0, t, target)
        except (ValueError, RuntimeError) as problem:
            for one, _ in measured:
                one.note(f"No error: {problem}")
            return None
        for one, sol in measured:
            error = largest(reference_error(sol, truth), sol)
            one.row = replace(one.row, error=float(np.median(error)))
        target = min((one.row.error for one, _ in measured if one.row.error is not None), default=math.inf) / 100
        if given is not None or truth.accuracy <= target:
            break
    for one, _ in measured:
        if one.row.error is not None and one.row.error < 3 * truth.accuracy:
            one.note("The error is no larger than the uncertainty of the reference.")
    return truth
