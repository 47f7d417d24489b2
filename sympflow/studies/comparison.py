"""compare(): several methods on one system, at the same instants, against one reference; and its report."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_dt, check_t_eval, check_t_span
from sympflow.arrays import to_numpy
from sympflow.hamiltonian.scales import started
from sympflow.hamiltonian.system import HamiltonianSystem, parameters_text
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.problems import check_y0
from sympflow.metrics.accuracy import check_problem, states_of
from sympflow.metrics.energy import max_energy_error
from sympflow.metrics.energy_balance import kept_by
from sympflow.metrics.reference import Reference
from sympflow.metrics.reference import reference as compute_reference
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.studies import attempts
from sympflow.studies.attempts import (
    CELLS,
    MEASURES,
    OF_MEASURES,
    Attempt,
    Candidate,
    Row,
    candidates,
    interleaved,
    tolerance_of,
)
from sympflow.studies.figures import Compared, comparison_figure, save_comparison
from sympflow.studies.reports import Column, described, seconds, text_table
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METRICS = ("error", *MEASURES)
MATCHES = ("time", "evaluations", "energy_error")
PAPER = ("sympflow", "mlp", "verlet", "leapfrog", "rk45")


def compare(
    system: GivenSystem,
    methods: Sequence[Any] = PAPER,
    metrics: Sequence[str] | None = None,
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

    A method that does not apply, or fails, gets a row with the reason.

    Parameters
    ----------
    system : HamiltonianSystem
    methods : sequence
        Each a name, a configured integrator such as ``get("verlet")(dt=0.01)``, a trained flow, or a pair
        (label, any of these).
    metrics : sequence of str, optional
        Any of "error", "energy", "drift", "volume", "symplecticity" and "reversal"; of a driven system "balance", the
        energy balance, in place of "energy" and "drift"; of a damped one "conformal" in place of metrics of conserved
        quantities. By default those that apply to the system, without "reversal".
    t_span, y0 : optional
        Interval and initial state (or batch); the system's by default.
    dt : float, optional
        Step of the fixed-step classical methods that are given by name; `system.dt` by default.
    n_outputs : int
        Number of instants: one in each of `n_outputs` equal parts of the interval, placed so that all phases of an
        oscillation occur, the last at the end.
    repeats : int
        Number of timed runs, interleaved over the methods, after one that is not timed. Compilation is measured
        separately, as `compile_time`.
    match : "time", "evaluations" or "energy_error", optional
        Tune the steps and tolerances of the other methods until they equal the first method in this quantity.
        By default each method runs at its stated step or tolerance.
    reference : Reference, Solution or array_like (..., 2d, n_outputs), optional
        States at the instants that are compared: its own times; for an array `n_outputs` equally spaced ones that end
        at the end of the interval. By default it is computed: exact, or 100 times as accurate as the smallest error as
        far as float64 allows.
    backend : "auto", "compiled" or "array"
        As for `solve`; a method without that backend gets a row with the reason.
    progress : callable, optional
        Called with a line of text at the start of each part.

    Returns
    -------
    Comparison
        With `.rows`, `.table()`, `.to_csv()`, `.to_json()` and `.plot()`.

    Notes
    -----
    The run time is the time of `solve`, with everything that the outputs need.

    Examples
    --------
    >>> import sympflow
    >>> report = sympflow.compare(sympflow.systems.pendulum(), ["verlet", "rk45"], ("energy",), repeats=1)
    >>> [row.status for row in report.rows]
    ['ok', 'ok']
    """
    system = given_system(system)
    asked = default_metrics(system) if metrics is None else _check_metrics(metrics)
    check_counts(n_outputs=n_outputs, repeats=repeats)
    check_dt(dt)
    _check_apply(system, asked, match)
    if match is not None and match not in MATCHES:
        raise ValueError(f"`match` must be one of {', '.join(map(repr, MATCHES))}, or None; got {match!r}.")
    t0, t1 = check_t_span(system.t_span if t_span is None else t_span)
    if t0 == t1:
        raise ValueError("`t_span` has length zero, so there is nothing to compare: choose a later end.")
    start = check_y0(system, system.y0 if y0 is None else y0, None)
    system = started(system, to_numpy(start))
    t = _instants(reference, t0, t1, n_outputs, dt or system.dt)
    attempts.check_progress(progress)
    given = None if reference is None else _given(reference, system, t0, start, t)
    say = progress or (lambda text: None)

    def run(integrator: Any, t_span: tuple[float, float] = (t0, t1), times: np.ndarray = t) -> Solution:
        return solve(system, integrator, t_span, start, t_eval=times, backend=backend)

    runs = [Attempt(c, Row(_identify(system), c.method, c.label)) for c in candidates(methods, dt)]
    for one in runs:
        say(f"{system.name}: running {one.candidate.label}")
        one.warm_up(run, t, t0, system.dt)
        one.run(run)
    if match is not None:
        _match(runs, match, run, system, repeats, say)
    for one in runs if any(one.row.backend == "compiled" for one in runs) else ():
        if one.row.backend == "torch":
            one.note("Runs in eager torch, while others run compiled: the run times are not like for like.")
    ready = [one for one in runs if one.row.status == "ok"]
    say(f"{system.name}: timing")
    times = interleaved([partial(run, one.candidate.integrator) for one in ready], repeats)
    for one, run_time in zip(ready, times, strict=True):
        one.fill(run_time=run_time.median, run_time_spread=run_time.spread)
    truth = None
    if "error" in asked and any(one.sol is not None for one in runs):
        say(f"{system.name}: reference")
        truth = _errors([one for one in runs if one.sol is not None], system, (t0, t1), start, t, given)
    for one in runs:
        if one.sol is not None:
            say(f"{system.name}: measuring {one.candidate.label}")
            one.measure([metric for metric in asked if metric in MEASURES])
    return Comparison(system, (t0, t1), start, t, asked, tuple(runs), repeats, match, truth)


def default_metrics(system: HamiltonianSystem) -> tuple[str, ...]:
    """The metrics of the conserved quantities of a system."""
    if system.between_impulses is not system:
        return ("error",)
    if system.conservative:
        what = "energy" if system.shows_energy else kept_by(system).replace("energy", "")
        kept = {"energy": ("energy", "drift"), "balance": ("balance",)}.get(what, ())
        return ("error", *kept, "volume", "symplecticity")
    shrinks_evenly = system.external_force is None and system.friction.isotropic
    return ("error", "conformal") if shrinks_evenly else ("error",)


def _check_apply(system: HamiltonianSystem, asked: Sequence[str], match: str | None) -> None:
    """Refuse metrics of quantities that are not conserved."""
    unkept = [m for m in asked if m != "error" and MEASURES[m].conserved]
    if unkept or match == "energy_error":
        what = f"which `metrics` {', '.join(map(repr, unkept))}" if unkept else "which `match` 'energy_error'"
        remedy = f"leave `metrics` out, or pass {list(default_metrics(system))}, and match by 'time'"
        system.check_conservative(f"{what} would measure is not conserved", remedy)
        if match == "energy_error" or not {"energy", "drift"}.isdisjoint(unkept):
            system.check_autonomous("so that its energy is not conserved", f"{remedy}: 'balance' is that of its energy")


def _identify(system: HamiltonianSystem) -> str:
    params = parameters_text(system.params)
    return f"{system.name}({params})" if params else system.name


def _instants(reference: object, t0: float, t1: float, n: int, dt: float) -> np.ndarray:
    """The times that are compared: those of a reference that tells them, else such as meet all phases."""
    if isinstance(reference, Reference | Solution) and len(reference.t) == n:
        return check_t_eval(reference.t, t0, t1)
    return attempts.instants(t0, t1, n, dt) if reference is None else np.linspace(t0, t1, n + 1)[1:]


def _given(
    reference: Reference | Solution | ArrayLike, system: HamiltonianSystem, t0: float, y0: np.ndarray, t: np.ndarray
) -> Reference:
    """The reference that was given, if it is one and fits."""
    if isinstance(reference, Reference | Solution):
        if len(reference.t) != len(t):
            raise ValueError(f"`reference` must be at the {len(t)} instants that are compared: pass its `n_outputs`.")
        found = reference if isinstance(reference, Reference) else Reference(t, states_of(reference.y), "given", None)
    else:
        found = Reference(t, states_of(reference), "given", None)
    if found.y.shape != (*y0.shape, len(t)):
        raise ValueError(f"`reference` must have the shape {(*y0.shape, len(t))} of the states; got {found.y.shape}.")
    check_problem(reference, system, t0, y0)
    return found


def _check_metrics(metrics: Sequence[str]) -> tuple[str, ...]:
    if not isinstance(metrics, Iterable):
        raise TypeError(f"`metrics` must be a list of names from {', '.join(METRICS)}; got {metrics!r}.")
    asked = (metrics,) if isinstance(metrics, str) else tuple(metrics)
    unknown = [m for m in asked if m not in METRICS]
    if unknown:
        raise ValueError(f"`metrics` has no {unknown[0]!r}: choose from {', '.join(METRICS)}; times are `t_span`.")
    return asked


def _errors(
    runs: Sequence[Attempt],
    system: HamiltonianSystem,
    t_span: tuple[float, float],
    y0: np.ndarray,
    t: np.ndarray,
    given: Reference | None,
) -> Reference | None:
    """Fill in the errors; tighten a computed reference until it is 100 times better than the best of them."""
    target = 1e-8 * float(np.abs(y0).max(initial=0.0))
    for _ in range(2):
        try:
            truth = given or compute_reference(system, t_span, y0, t, target)
        except (ValueError, RuntimeError) as problem:
            for one in runs:
                one.note(f"No error: {problem}")
            return None
        for one in runs:
            attempts.accuracy(one, truth)
        target = min([one.row.error for one in runs if one.row.error is not None], default=math.inf) / 100
        if truth.accuracy is None or given is not None or truth.accuracy <= target:
            break
    for one in runs:
        if truth.accuracy is not None and one.row.error is not None and one.row.error < 3 * truth.accuracy:
            one.note("The error is no larger than the uncertainty of the reference.")
    return truth


_CLOSE = math.log(1.05)
_LONGEST_JUMP = math.log(16.0)
_ROUNDS = 12


def _match(
    runs: Sequence[Attempt],
    what: str,
    run: Callable[[Any], Solution],
    system: HamiltonianSystem,
    repeats: int,
    say: Callable[[str], None],
) -> None:
    """Tune every method that can be to the first one that ran and has the figure."""

    def figure(integrator: Any) -> float:
        trial = Attempt(Candidate("", "", integrator), Row(system.name, "", ""))
        trial.run(run)
        sol = trial.sol
        if sol is None or not sol.success:
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
        integrator = one.candidate.integrator
        if integrator.trained or not (isinstance(integrator, FixedStep) or tolerance_of(integrator) is not None):
            one.note(f"Not matched: {one.candidate.label} has no step to tune.")
            continue
        say(f"{system.name}: matching {one.candidate.label}")
        integrator, reached = matched(integrator, system, figure, target, what == "energy_error")
        one.candidate = replace(one.candidate, integrator=integrator)
        row = Row(_identify(system), one.candidate.method, one.candidate.label)
        one.row = replace(row, compile_time=one.row.compile_time)
        one.run(run)
        if not abs(math.log(reached / target)) < 0.1:
            one.note(f"Matched only to {reached:.2g} where {anchor.candidate.label} has {target:.2g}.")


def tuned(integrator: Integrator, system: HamiltonianSystem, factor: float) -> Integrator:
    """Multiply the integrator's step, or both its tolerances, by `factor`."""
    options: dict[str, Any]
    if isinstance(integrator, FixedStep):
        options = {"dt": integrator.step_length(system) * factor}
    else:
        options = {name: getattr(integrator, name) * factor for name in ("rtol", "atol")}
        options["rtol"] = min(max(options["rtol"], 2.5e-14), 0.1)  # the least that SciPy takes, and the most of any use
    return replace(integrator, **options)  # type: ignore[type-var]


def matched(
    integrator: Integrator,
    system: HamiltonianSystem,
    measure: Callable[[Integrator], float],
    target: float,
    grows: bool,
) -> tuple[Integrator, float]:
    """Tune the integrator until `measure` is within 5 % of `target`; return the nearest found, and its figure.

    Parameters
    ----------
    measure : callable
        A positive figure of a run; inf if the run fails, so that smaller steps are tried.
    grows : bool
        True if the figure grows with the step (an error), False if it falls (a cost).

    Notes
    -----
    The secant method on the logarithms, safeguarded by the nearest points found on either side.
    """
    x, slope = 0.0, (2.0 if grows else -1.0)
    below: tuple[float, float] | None = None  # (x, f) with too small a step, and with too large a one
    above: tuple[float, float] | None = None
    best: tuple[float, Integrator, float] = (math.inf, integrator, math.nan)
    for _ in range(_ROUNDS):
        candidate = tuned(integrator, system, math.exp(x))
        value = measure(candidate)
        f = math.log(value / target) if 0 < value < math.inf else math.inf
        if not math.isfinite(f):
            above = (x, math.inf)
            x = x - 1.0 if below is None else (x + below[0]) / 2
            continue
        if abs(f) < best[0]:
            best = (abs(f), candidate, value)
        if abs(f) < _CLOSE:
            break
        if (f > 0) == grows:
            above = (x, f)
        else:
            below = (x, f)
        if below is not None and above is not None and math.isfinite(above[1]):
            slope = (above[1] - below[1]) / (above[0] - below[0])
        x = x + max(-_LONGEST_JUMP, min(_LONGEST_JUMP, -f / slope))
        if below is not None and above is not None:
            margin = 0.05 * (above[0] - below[0])
            x = min(max(x, below[0] + margin), above[0] - margin)
    return best[1], best[2]


@dataclass(frozen=True, repr=False)
class Comparison(Compared):
    """Methods side by side on one system.

    Attributes
    ----------
    system, t_span, y0
        The problem.
    t : ndarray (n,)
        The instants.
    metrics : tuple of str
    repeats : int
    match : str or None
    reference : Reference or None
        The reference of the errors, if these were requested.
    rows : tuple of Row
    runs : tuple
        Behind each row: its solution (`.sol`) and the energy and volume errors over time (`.energy`, `.volume`).
    """

    columns: ClassVar[tuple[str, ...]] = (
        *("system", "method", "label", "status", "reason", "dt", "tolerance", "backend", "run_time", "run_time_spread"),
        *("compile_time", "force_evaluations", "hessian_evaluations", "error", *OF_MEASURES, "training_time"),
    )

    repeats: int
    match: str | None
    reference: Reference | None

    @property
    def rows(self) -> tuple[Row, ...]:
        return tuple(run.row for run in self.runs)

    def table(self, width: int | None = None) -> str:
        """The rows as text, with the settings above and the reasons below.

        Where `width` characters do not hold them, the methods are columns.
        """
        return combined_table([self], width)

    def settings(self) -> dict[str, Any]:
        return {
            "system": described(self.system),
            "t_span": list(self.t_span),
            "y0": self.y0.tolist(),
            "n_outputs": len(self.t),
            "repeats": self.repeats,
            "match": self.match,
            "reference": None if self.reference is None else self.reference.summary(),
        }

    def figure(self, kind: str = "overview") -> Figure:
        """A matplotlib figure: "overview", "energy", "volume", "error" (against run time) or "portrait"."""
        return comparison_figure(self, kind)

    def plot(self, path: str | os.PathLike[str] | None = None, kind: str = "overview", prefix: str = "") -> Figure:
        """The figure, by default the overview; with a path it is also saved.

        Parameters
        ----------
        path : path-like, optional
            A file (.png, .pdf or .svg); or a folder, in which the overview saves every kind to a file of its own.
        kind : str
            As for `figure`.
        prefix : str
            Beginning of the names of the files in a folder; the kinds follow.
        """
        figure = self.figure(kind)
        if path is not None:
            save_comparison(self, path, kind, prefix)
        return figure


def combined_table(comparisons: Sequence[Comparison], width: int | None = None) -> str:
    """The rows of several comparisons as one table, with the settings above and the reasons below.

    Where `width` characters do not hold it, there is a table for each system with the methods as columns.
    """
    rows = [row for c in comparisons for row in c.rows]
    several = len(comparisons) > 1
    names = [c.title for c in comparisons for _ in c.rows]
    first = [i == 0 for c in comparisons for i in range(len(c.rows))]
    systems = [n if f and several else "" for n, f in zip(names, first, strict=True)]
    columns = [Column("system", systems, left=True), *_columns(rows)]
    notes = [
        f"  {f'{name}, ' if several else ''}{row.label}: {row.reason}"
        for name, row in zip(names, rows, strict=True)
        if row.reason
    ]
    below = ["", "Notes", *notes] if notes else []
    table = text_table(columns)
    if width is None or max(map(len, table.splitlines())) <= width:
        return "\n".join([*map(_settings, comparisons), "", table, *below])
    blocks = [line for c in comparisons for line in (_settings(c), "", _upright(_columns(c.rows)), "")]
    return "\n".join([*blocks[:-1], *below])


def _upright(columns: Sequence[Column]) -> str:
    """The table turned round: a line for each of its columns."""
    names, *others = [c for c in columns if any(c.cells)]
    titles = Column("", [c.title for c in others], left=True)
    cells = [Column(name, [c.cells[i] for c in others]) for i, name in enumerate(names.cells)]
    return text_table([titles, *cells])


def _columns(rows: Sequence[Row]) -> list[Column]:
    titles = [title for title in CELLS if title not in ("batch", "rtol", "±", "steps", "leaves domain at t")]
    own: dict[str, Callable[[Row], str]] = {
        "step": lambda row: (
            CELLS["step"](row) if row.dt is not None or row.tolerance is None else f"rtol {CELLS['rtol'](row)}"
        ),
        "run time": lambda row: (
            f"{seconds(row.run_time)} ± {100 * row.run_time_spread / row.run_time:2.0f} %"
            if row.run_time and row.run_time_spread is not None
            else ""
        ),
    }
    return attempts.columns(rows, titles, own)


def _settings(c: Comparison) -> str:
    batch = f", batch of {int(np.prod(c.y0.shape[:-1]))}" if c.y0.ndim > 1 else ""
    text = f"{c.title}: t = {c.t_span[0]:g} … {c.t_span[1]:g}{batch}, {len(c.t)} instants, median of {c.repeats} runs"
    if c.match:
        text += f", matched in {c.match.replace('_', ' ')}"
    if c.reference is not None:
        text += f"; reference: {c.reference.described()}"
    return text
