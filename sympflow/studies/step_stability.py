"""stability(): how long a step each method bears on a system, and how it fails beyond; and its report."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import (
    MAX_SAVED_VALUES,
    check_array,
    check_counts,
    check_t_span,
    checked_number,
    positive_numbers,
)
from sympflow.arrays import to_numpy
from sympflow.hamiltonian.scales import smallest_size, started
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.problems import check_y0
from sympflow.metrics.energy import max_energy_error
from sympflow.metrics.linear_stability import LinearStability, SmallOscillations, of_method, small_oscillations
from sympflow.metrics.symplectic import symplecticity_defect, volume_error
from sympflow.show.style import saved
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.studies import attempts
from sympflow.studies.attempts import MEASURES, Attempt, Candidate, Measure, Row, candidates
from sympflow.studies.reports import Column, Report, described, number, plain, records, text_table
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DEFAULT = ("sympflow", "verlet", "leapfrog", "kahan_li8", "implicit_midpoint", "rk4", "rk45")
METRICS = ("energy", "drift", "volume", "symplecticity", "domain")
STEPS = tuple(2.0**k for k in range(-1, 7))
"""Default steps of classical methods, times the system's; those of a trained flow are fractions of its Δt."""
FRACTIONS = (0.25, 0.5, 1.0)
PHASES = (0.0, 3.0, 10.0, 31.0)
"""Places of the initial states along the orbit, in the system's steps: several, for one may hide an instability."""
ORBIT, MOST_OF_ORBIT = 64, 1000  # states along an orbit at which frequencies are looked at, within so many steps
FINE, COARSE = 2 ** (1 / 8), 2 ** (1 / 4)  # ratio of the steps that are tried, compiled and not
OCTAVES = 3  # below the first unstable one of steps that are doubled, in which all of these are tried
HALVINGS = 24
WITHIN = (0.1, 0.5, 0.9, 0.99)  # places in a window of linear instability that are tried, compiled; else its middle
SHOWN_INTERVALS = 3
PRECISION = 1.002  # the shortest unstable step found, in units of the longest stable one
STABLE = ("stable", "bounded")
MOST_OUTPUTS, TANGENT_STEPS, FEWEST_FOR_DRIFT = 20_000, 256, 40
FEW_STARTS = 16  # up to so many, a compiled method runs one by one: the kernel for batches takes longer to compile
ARRAYS_SLOWER = 200  # times, by which runs on arrays are shortened
TAIL = 20  # steps before a blow-up whose growth is looked at


def stability(
    system: GivenSystem | Sequence[GivenSystem],
    methods: Sequence[Any] = DEFAULT,
    *,
    steps: Sequence[float] | None = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    dtypes: Sequence[str] = ("float64",),
    metrics: Sequence[str] = METRICS,
    bound: float = 1e3,
    min_steps: int = 1000,
    max_steps: int = 1_000_000,
    limits: bool = True,
    progress: Callable[[str], None] | None = None,
) -> StabilityReport:
    """Run every method with a range of steps, find the longest stable one, and report how longer ones fail.

    The longest stable step is that of the first loss of stability. If H is quadratic and the method composed of kicks
    and drifts, it is computed from the trace of a step: see `sympflow.metrics.linear_stability`. Else steps are doubled
    from an eighth of that limit for small oscillations, or of the system's `dt`, until one is unstable; in the three
    octaves below it steps at ratios of 2^(1/8) are tried, of 2^(1/4) for methods that are not compiled, and in every
    window of linear instability four steps, or its middle; the first loss is found by bisection, to 0.2 %. The answer
    does not depend on `steps`, unless one of them is unstable below it: then that one counts.

    Parameters
    ----------
    system : HamiltonianSystem or sequence of them
        A sequence is a family, such as one system at several stiffnesses: it gives a stability map.
    methods : sequence
        As for `compare`. A trained flow is run at fractions of its Δt; an adaptive method once, at its tolerance.
    steps : sequence of float, optional
        Steps of the fixed-step methods; by default from half the system's `dt` to 64 times it.
    t_span : (float, float), optional
        The default is the system's. It is extended to hold `min_steps` steps, and shortened to hold `max_steps`.
    y0 : array_like (2d,) or (n, 2d), optional
        Initial states. From one state, by default the system's, three more are taken along its orbit: from a single
        state an instability may not show (for an oscillator at rest at its largest q, at exactly dt·ω = 2).
    dtypes : sequence of "float64", "float32"
    metrics : sequence of str
        Any of "energy", "drift", "volume", "symplecticity" and "domain". The Jacobians for volume and symplecticity
        are those of the first 256 steps.
    bound : float
        A run whose energy error exceeds this bound, or that becomes non-finite, counts as unstable.
    min_steps, max_steps : int
        Limits of the number of steps of a run; if they contradict each other, `max_steps` applies. Methods that run
        with array operations, and float32, take at most `max_steps`/200.
    limits : bool
        True to find the longest stable step.
    progress : callable, optional
        Called with a line of text at the start of each method, each of its steps, and each trial for the longest one.

    Returns
    -------
    StabilityReport
        With `.rows` (one for each system, method, precision and step), `.limits`, `.table()`, `.to_csv()`,
        `.to_json()` and `.plot()`.

    Examples
    --------
    >>> import sympflow
    >>> oscillator = sympflow.systems.harmonic_oscillator(1000.0)
    >>> report = sympflow.stability(oscillator, ["verlet"], steps=[1e-3, 3e-3], metrics=("energy",))
    >>> [row.status for row in report.rows]
    ['stable', 'unstable']
    >>> round(1000 * report.limits[0].stable, 2)
    2.0
    """
    family = tuple(map(given_system, system if isinstance(system, list | tuple) else (system,)))
    if not family:
        raise ValueError("`system` is an empty sequence: give one system, or several.")
    for one in family:
        why = "so its energy error says nothing of stability"
        one.check_conservative(why, "study the system without `damping`, or use sympflow.compare")
        remedy = "use sympflow.compare(system, methods), or floquet_multipliers of a periodic orbit"
        one.check_autonomous(why, remedy)
    unknown = [m for m in metrics if m not in METRICS]
    if isinstance(metrics, str) or unknown:
        raise ValueError(f"`metrics` must be a list of names from {', '.join(METRICS)}; got {metrics!r}.")
    check_counts(min_steps=min_steps, max_steps=max_steps)
    checked_number("bound", bound, "positive and finite, a relative energy error", lambda x: 0 < x < math.inf)
    attempts.check_progress(progress)
    lengths = None if steps is None else positive_numbers("steps", steps)
    unknown = [d for d in dtypes if d not in ("float32", "float64")]
    if isinstance(dtypes, str) or unknown or not len(dtypes):
        raise ValueError(f"`dtypes` must be a list of 'float32' and 'float64'; got {dtypes!r}.")
    rows: list[Row] = []
    found: list[StepLimit] = []
    for given in family:
        one = given if y0 is None else started(given, initial_states(given, y0))
        span = check_t_span(one.t_span if t_span is None else t_span)
        if span[0] == span[1]:
            raise ValueError("`t_span` has length zero, so there is nothing to run: choose a later end.")
        starts = initial_states(one, y0)
        small = small_oscillations(one, starts[0], partial(_orbit, one, starts[0], span)) if limits else None
        for chosen in candidates(methods):
            for dtype in dtypes:
                say = partial(_say, progress, f"{one.title}: {chosen.label}, {dtype}")
                study = Study(one, chosen, dtype, span, starts, tuple(metrics), bound, min_steps, max_steps, say, small)
                say("")
                with attempts.any_step():
                    own = [study.row(h) for h in study.lengths(lengths)]
                    rows += own
                    if limits and study.has_steps and {row.status for row in own} - {"not applicable", "failed"}:
                        found.append(step_limit(study, own))
    return StabilityReport(family, tuple(metrics), float(bound), tuple(rows), tuple(found))


def _say(progress: Callable[[str], None] | None, what: str, detail: str) -> None:
    if progress is not None:
        progress(f"{what}, {detail}" if detail else what)


def initial_states(system: HamiltonianSystem, y0: ArrayLike | None) -> np.ndarray:
    """The states (n, 2d) that runs start from: those given, or one and three more along its orbit."""
    check_array(y0, "every method of the study takes NumPy arrays")
    given = check_y0(system, system.y0 if y0 is None else y0, None)
    if given.ndim > 2:
        raise ValueError(f"`y0` must have shape (2d,) or (n, 2d); got {given.shape}.")
    if given.ndim == 2:
        return given
    system = started(system, given)
    times = system.dt * np.array(PHASES)
    atol = 1e-13 * smallest_size(system, given)
    sol = solve(system, "dop853", (0.0, float(times[-1])), given, t_eval=times, rtol=1e-11, atol=atol)
    return sol.states if sol.success and np.isfinite(sol.y).all() else given[None]


def _orbit(system: HamiltonianSystem, y0: np.ndarray, t_span: tuple[float, float]) -> np.ndarray:
    """States (n, 2d) along the orbit of y0, as far as it is found."""
    length = min(abs(t_span[1] - t_span[0]), MOST_OF_ORBIT * system.dt)
    times = np.linspace(0.0, length, ORBIT)
    with _quiet():
        atol = 1e-8 * smallest_size(system, y0)
        states = solve(system, "dop853", (0.0, length), y0, t_eval=times, rtol=1e-6, atol=atol).states
    return states if len(states) else y0[None]


# one method with a range of steps -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """One method on one system in one precision."""

    system: HamiltonianSystem
    candidate: Candidate
    dtype: str
    t_span: tuple[float, float]
    starts: np.ndarray
    metrics: tuple[str, ...]
    bound: float
    min_steps: int
    max_steps: int
    say: Callable[[str], None] = lambda text: None  # for a line of progress
    small: SmallOscillations | None = None

    @cached_property
    def integrator(self) -> Any:
        """The integrator that runs: a flow in another time is run as such. None if there is none."""
        asked = self.candidate.integrator
        if asked is None:
            return None
        try:
            return asked.resolved(self.system, self.starts[0], abs(self.t_span[1] - self.t_span[0]))
        except Exception:  # the rows say why
            return asked

    @cached_property
    def linear(self) -> LinearStability | None:
        """The steps at which small oscillations are stable, or those of the largest frequency along the orbit."""
        if self.small is None or not self.has_steps:
            return None
        longest = abs(self.t_span[1] - self.t_span[0])
        if self.integrator.trained:
            longest = self.integrator.step_length(self.system)
        return of_method(self.integrator, self.system, self.small, longest)

    @property
    def anchor(self) -> float:
        """The step whose multiples are tried, for any `steps`."""
        limit = 0.0 if self.linear is None else self.linear.limit
        return limit if 0 < limit < math.inf else float(self.system.dt)

    @property
    def known(self) -> bool:
        """True if the linear stability is that of all orbits, known without a run."""
        exact = self.small is not None and self.small.everywhere and self.integrator.kicks_and_drifts is not None
        return exact and self.linear is not None and 0 < self.linear.limit < math.inf

    @property
    def has_steps(self) -> bool:
        return isinstance(self.integrator, FixedStep)

    @property
    def compiled(self) -> bool:
        system = self.system
        known = system.definition.symbolic or system.numba_functions is not None or self.integrator.trained
        return self.integrator.compiles and self.dtype == "float64" and known

    @property
    def most_steps(self) -> int:
        return self.max_steps if self.compiled else max(1, self.max_steps // ARRAYS_SLOWER)

    def lengths(self, asked: list[float] | None) -> list[float | None]:
        """The steps to run; None for an adaptive method."""
        if not self.has_steps:
            return [None]
        if asked is not None and not self.integrator.trained:
            return [*asked]
        try:
            own = self.integrator.step_length(self.system)
        except Exception:  # there is no flow, most likely: the row says so
            return [self.system.dt]
        if asked is not None:
            return [*asked]
        return [own * f for f in (FRACTIONS if self.integrator.trained else STEPS)]

    def with_step(self, h: float | None) -> Integrator:
        return self.integrator if h is None else replace(self.integrator, dt=h)

    def span(self, h: float | None) -> tuple[float, float]:
        """The interval, extended or shortened to between `min_steps` and `max_steps` steps."""
        t0, t1 = self.t_span
        if h is None:
            return t0, t1
        length = min(max(abs(t1 - t0), h * self.min_steps), h * self.most_steps)
        return t0, t0 + math.copysign(length, t1 - t0)

    def runs(self, integrator: Any, h: float | None, span: tuple[float, float]) -> list[Solution]:
        """Solutions that hold every step, or equally many of them, of each state."""
        y0 = self.starts
        together = integrator.on_grid and not (self.compiled and len(y0) <= FEW_STARTS)
        width = y0.size if together else y0.shape[1]
        most = min(MOST_OUTPUTS, MAX_SAVED_VALUES // (2 * width))
        every = 1 if h is None else max(1, math.ceil(abs(span[1] - span[0]) / h / most))
        with _quiet():
            return [
                solve(self.system, integrator, span, y, save_every=every, dtype=self.dtype, on_domain_exit="ignore")
                for y in ([y0] if together else list(y0))
            ]

    @property
    def named(self) -> dict[str, Any]:
        """The system, its first parameter, the method and the precision, as fields of rows and limits."""
        parameter, value = next(iter(self.system.params.items()), (None, None))
        own = {"method": self.candidate.method, "label": self.candidate.label, "dtype": self.dtype}
        return {"system": self.system.title, "parameter": parameter, "value": value, **own}

    def attempt(self, h: float | None, span: tuple[float, float]) -> Attempt:
        """Run all initial states with one step; the row has the largest energy error, and the status."""
        one = Attempt(self.candidate, Row(**self.named, t_end=self.span(h)[1]))
        one.run(lambda _: self.runs(self.with_step(h), h, span))
        one.fill(dt=h)
        if one.sol is not None:
            with one.noting_warnings():
                worst = [float(np.max(max_energy_error(sol))) for sol in one.sols]
                one.enter(energy_error=math.inf if any(map(math.isnan, worst)) else max(worst))
            status, words = self.verdict(one)
            one.fill(status=status, reason=f"{one.row.reason} {words}".strip())
        return one

    def verdict(self, one: Attempt) -> tuple[str, str]:
        """The status of runs, by their largest energy error, and a remark."""
        worst = one.row.energy_error if one.row.energy_error is not None else math.inf
        exit_time = domain_exit(one.sols) if self.integrator.trained else None
        left = (
            ""
            if exit_time is None
            else f"Left the flow's domain at t = {exit_time:.6g}, outside of which the flow is not valid."
        )
        if left or not worst <= self.bound:
            return ("unstable" if not worst <= self.bound else "outside"), left
        return ("stable", "") if worst <= 1 else ("bounded", f"The energy error is bounded, but reaches {worst:.3g}.")

    def stable(self, h: float) -> tuple[bool, float]:
        """Tell whether all runs with this step stay below the bound and in a flow's domain, and their largest error.

        Most unstable steps show in the first `min_steps` of them.
        """
        self.say(f"longest stable step: dt = {h:.6g}")
        t0, t1 = span = self.span(h)
        if abs(t1 - t0) > 4 * h * self.min_steps:
            early = self.attempt(h, (t0, t0 + math.copysign(h * self.min_steps, t1 - t0))).row.energy_error
            if early is None or not early <= self.bound:
                return False, math.inf if early is None else early
        row = self.attempt(h, span).row
        return row.status in STABLE, math.inf if row.energy_error is None else row.energy_error

    def row(self, h: float | None) -> Row:
        """All measurements at one step."""
        self.say("" if h is None else f"dt = {h:.6g}")
        one = self.attempt(h, self.span(h))
        if one.sol is not None:
            _note_blow_up(one)
            one.measure([name for name in self.metrics if name != "energy"], OF_RUNS)
            window = None if h is None or self.linear is None else self.linear.window_of(h)
            if window is not None and one.row.status in STABLE and self.small and self.small.equilibrium is not None:
                by = "without bound" if window.growth == math.inf else f"by up to a factor {window.growth:.5g}"
                one.note(f"Small oscillations are unstable here: they grow {by} a step.")
        return one.row


@contextmanager
def _quiet() -> Iterator[None]:
    """No RuntimeWarnings, nor NumPy's of overflow: a step that is too long is no surprise here."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def domain_exit(sols: Sequence[Solution]) -> float | None:
    """The time at which the first trajectory leaves the domain of the flow, or of the system."""
    system = sols[0].system
    flow = sols[0].integrator.known_flow(system)
    domain = system.domain if flow is None else flow.domain_for(system)
    if domain is None:
        return None
    slack = 0.0 if flow is None else float(flow.figures.get("energy_error_max") or 0.0)
    times = []
    for sol in sols:
        thin = max(1, len(sol.t) // 2000)
        states = np.asarray(sol.states)[..., ::thin, :]
        outside = ~domain.contains(states, slack=slack) & np.isfinite(states).all(-1)
        outside = outside.reshape(-1, outside.shape[-1]).any(0)
        if outside.any():
            times.append(float(sol.t[::thin][int(np.argmax(outside))]))
    return min(times) if times else None


# metrics: those of attempts, of as much of the runs as they need here -----------------------------------------------


def _drift(one: Attempt) -> tuple[float | None, float | None]:
    if one.row.status == "unstable" or len(one.sols[0].t) < FEWEST_FOR_DRIFT:
        return None, None
    return attempts.drift(one)


def _first_steps(one: Attempt) -> Solution:
    """The first steps from the first state, run again."""
    sol = one.sols[0]
    t0, t1 = sol.t_span
    h = sol.system.dt if one.row.dt is None else one.row.dt
    t1 = t0 + math.copysign(min(abs(t1 - t0), TANGENT_STEPS * h), t1 - t0)
    y0 = to_numpy(sol.y0).reshape(-1, 2 * sol.system.ndof)[0]
    with _quiet():
        return solve(sol.system, sol.integrator, (t0, t1), y0, dtype=str(y0.dtype), on_domain_exit="ignore")


OF_RUNS = {  # the energy error is that of every run, for its status depends on it
    "drift": replace(MEASURES["drift"], of=_drift),
    "volume": replace(MEASURES["volume"], of=lambda one: abs(float(volume_error(_first_steps(one))))),
    "symplecticity": replace(
        MEASURES["symplecticity"], of=lambda one: float(symplecticity_defect(_first_steps(one), relative=True))
    ),
    "domain": Measure("leaves domain at t", ("domain_exit",), lambda one: domain_exit(one.sols)),
}


# blow-ups -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BlowUp:
    """The end of a run that could not go on.

    Attributes
    ----------
    time : float
        Of the singularity, as `solve` estimates it; or of the last finite state, where there is none.
    singular : bool
        True if the solution itself becomes infinite.
    growth : float or None
        Else the factor by which ‖y‖ grew with each step, the median over the last steps before the overflow; None for
        an adaptive method, whose steps differ.
    """

    time: float
    singular: bool
    growth: float | None

    def __str__(self) -> str:
        if self.singular:
            return f"The solution becomes infinite at t = {self.time:.6g}."
        if self.growth is not None and self.growth > 1.001:
            return f"The state grows by a factor {self.growth:.4g} a step until it overflows at t = {self.time:.6g}."
        return f"The run cannot go on after t = {self.time:.6g}."


def failure_times(sol: Solution) -> np.ndarray:
    """For each trajectory (n,) the time after which it could not go on, NaN if it did not fail."""
    status = np.atleast_1d(np.asarray(sol.status))
    last = sol.t[-1] if len(sol.t) else sol.t_span[0]
    times = np.broadcast_to(np.asarray(sol.stats.get("failed_at", last), dtype=float), status.shape)
    return np.where(status < 0, times, np.nan).reshape(-1)


def blow_up(sol: Solution, i: int = 0) -> BlowUp:
    """Describe how trajectory i of a solution ended that could not go on."""
    y0 = to_numpy(sol.y0).reshape(-1, 2 * sol.system.ndof)
    failed_at = float(failure_times(sol)[i])
    time = float(np.ravel(sol.stats.get("blow_up_time", np.full(len(y0), np.nan)))[i])
    growth = _growth(sol, y0[i], failed_at)
    return BlowUp(time, True, growth) if np.isfinite(time) else BlowUp(failed_at, False, growth)


def _growth(sol: Solution, y0: np.ndarray, failed_at: float) -> float | None:
    if not sol.integrator.on_grid:
        return None
    t0, h = sol.t_span[0], np.copysign(sol.stats["dt"], sol.t_span[1] - sol.t_span[0])
    n = int(np.rint((failed_at - t0) / h))
    if n < 1:
        return 1.0
    times = np.clip(t0 + h * np.arange(max(0, n - TAIL), n + 1), min(t0, failed_at), max(t0, failed_at))
    with _quiet():
        tail = solve(sol.system, sol.integrator, (t0, failed_at), y0, t_eval=times, on_domain_exit="ignore").y
        change = np.diff(np.log(np.abs(tail).max(0)))
    return float(np.exp(np.median(change))) if len(change) and np.isfinite(change).all() else 1.0


def _note_blow_up(one: Attempt) -> None:
    """Enter the time and manner of the first failure, of the first state that fails."""
    for sol in one.sols:
        lost = np.isfinite(failure_times(sol))
        if lost.any():
            end = blow_up(sol, int(np.argmax(lost)))
            one.fill(blow_up=end.time, singular=end.singular)
            if not (end.singular and "infinite" in one.row.reason):
                one.note(str(end))
            return


# the longest stable step ----------------------------------------------------------------------------------------------


def step_limit(study: Study, rows: Sequence[Row]) -> StepLimit:
    """Find the longest stable step: the first loss of stability."""
    tried = [row for row in rows if row.dt is not None and row.status != "not applicable"]
    stable = [row.dt for row in tried if row.status in STABLE]
    low: float | None = None
    high: float | None = None
    reached = ""
    if not stable and any(row.singular for row in tried):
        reached = "none: the solution is singular"  # no step helps
    elif not stable and tried and all(row.status == "outside" for row in tried):
        reached = "none: the solution leaves the flow's domain"
    else:
        search = Search(study, [row.dt for row in tried if row.dt is not None and row.status not in STABLE])
        low, high, reached = search.known_limit() if study.known else search.limit()
    error = None
    if low is not None:
        error = study.stable(low / PRECISION if study.known else low)[1]
    linear, small = study.linear, study.small
    found: dict[str, Any] = {"stable": low, "unstable": high, "energy_error": error, "reached": reached}
    found["frequency"] = None if small is None else small.fastest
    found["linear"] = None if linear is None or not linear.windows else linear.limit
    if linear is not None and small is not None and small.equilibrium is not None:
        found["intervals"] = linear.intervals
    return StepLimit(**study.named, **found)


@dataclass
class Search:
    """The search for the first step that is unstable.

    Attributes
    ----------
    study : Study
    bad : list of float
        Steps that are known to be unstable.
    found : dict
        The result, stable or not, for each step that was tried.
    """

    study: Study
    bad: list[float]
    found: dict[float, bool] = field(default_factory=dict)

    def stable(self, h: float) -> bool:
        if h not in self.found:
            self.found[h] = h not in self.bad and self.study.stable(h)[0]
        return self.found[h]

    def known_limit(self) -> tuple[float, float, str]:
        """The first exit of the trace, and a step just beyond."""
        linear = self.study.linear
        assert linear is not None
        first = linear.windows[0]
        return first.start, min(first.start * PRECISION, (first.start + first.stop) / 2), ""

    def limit(self) -> tuple[float | None, float | None, str]:
        """The longest stable step and the shortest unstable one, a remark; the steps are None where there is none."""
        study = self.study
        if study.integrator.trained:
            longest = study.integrator.step_length(study.system)
            top, remark, steps = longest, "all up to the flow's Δt", [longest * f for f in FRACTIONS]
        else:
            longest, remark = abs(study.t_span[1] - study.t_span[0]), "all up to the length of the interval"
            start = self._start()
            if start is None:
                return None, min(self.found), ""
            top = start
            while top < longest and self.stable(top):
                top *= 2
            ratio = FINE if study.compiled else COARSE
            below = math.floor(math.log(2**OCTAVES) / math.log(ratio))
            steps = [top / ratio**k for k in range(below, -1, -1)] if not self.stable(top) else [top]
            steps = [start, *(h for h in steps if h > start)]
        inside = [h for h in [*self.bad, *self._in_windows()] if h < top]
        low: float | None = None
        for h in sorted({*steps, *inside}):
            if not self.stable(h):
                low, high = self._bisected(low, h)
                return low, high, "" if low is None else self._passed_over(low)
            low = h
        return low, None, remark

    def _start(self) -> float | None:
        """A stable step well below the limit for small oscillations."""
        h = self.study.anchor / 8
        for _ in range(HALVINGS):
            if self.stable(h):
                return h
            h /= 2
        return None

    def _in_windows(self) -> list[float]:
        """Steps where small oscillations are unstable, a few in each window."""
        linear = self.study.linear
        if linear is None:
            return []
        ends = [(w.start, w.stop if w.stop < math.inf else PRECISION * w.start) for w in linear.windows]
        places = WITHIN if self.study.compiled else (0.5,)
        return [start + place * (stop - start) for start, stop in ends for place in places]

    def _passed_over(self, low: float) -> str:
        """A remark on the windows where small oscillations grow, but no run here above the bound."""
        study = self.study
        if study.linear is None or study.small is None or study.small.equilibrium is None:
            return ""
        passed = [f"{w.start:.5g} to {min(w.stop, low):.5g}" for w in study.linear.windows if w.start < low]
        if not passed:
            return ""
        shown = ", ".join(passed[:SHOWN_INTERVALS]) + (", …" if len(passed) > SHOWN_INTERVALS else "")
        return f"below the bound, though small oscillations grow at {shown}"

    def _bisected(self, low: float | None, high: float) -> tuple[float | None, float]:
        for _ in range(HALVINGS if low is None else 0):
            if self.stable(high / 2):
                low = high / 2
                break
            high /= 2
        while low is not None and high / low > PRECISION:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if self.stable(middle) else (low, middle)
        return low, high


# the report -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StepLimit:
    """The longest stable step of one method on one system: the first loss of stability.

    Attributes
    ----------
    system, parameter, value, method, label, dtype
        As in `Row`.
    stable : float or None
        The longest step that was found stable or bounded, all shorter ones that were tried being so; None if there is
        none. If H is quadratic and the method one of kicks and drifts, the step at which stability is first lost in
        a run of any length.
    unstable : float or None
        The next longer one that was tried, or is known, to be unstable; None if all were stable.
    energy_error : float
        The largest energy error with `stable`, or just below.
    reached : str
        A remark: that all steps are stable, up to the flow's Δt or the length of the interval; that
        the solution itself is singular, or leaves the flow's domain, so that none is; or the windows of steps below
        `stable` where small oscillations grow, though no run here exceeds the bound: longer runs may.
    frequency : float or None
        ω of the fastest small oscillation about the equilibrium, or, where none is found, the largest along the orbit.
    linear : float or None
        The step at which oscillations of these frequencies are first lost; None if they never are, or it is not known.
        The orbits of the study may stay bounded with longer steps, or only with shorter ones.
    intervals : tuple of (float, float)
        All intervals (from, to) of steps at which small oscillations about the equilibrium are stable.
    """

    system: str
    parameter: str | None
    value: float | None
    method: str
    label: str
    dtype: str
    stable: float | None
    unstable: float | None
    energy_error: float | None = None
    reached: str = ""
    frequency: float | None = None
    linear: float | None = None
    intervals: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, repr=False)
class StabilityReport(Report):
    """Methods and steps on a system or a family of them.

    Attributes
    ----------
    systems : tuple of HamiltonianSystem
    metrics : tuple of str
    bound : float
        The energy error above which a run counts as unstable.
    rows : tuple of Row
    limits : tuple of StepLimit
    """

    columns: ClassVar[tuple[str, ...]] = (
        *("system", "parameter", "value", "method", "label", "dtype", "dt", "t_end", "status", "reason", "n_steps"),
        *("energy_error", "energy_drift", "energy_drift_error", "blow_up", "singular", "domain_exit", "volume_error"),
        "symplecticity_defect",
    )

    systems: tuple[HamiltonianSystem, ...] = field(repr=False)
    metrics: tuple[str, ...]
    bound: float
    rows: tuple[Row, ...] = field(repr=False)
    limits: tuple[StepLimit, ...]

    def table(self) -> str:
        """The longest stable steps, and all rows, as text; the reasons below."""
        notes = [
            f"  {row.system}, {row.label}{'' if row.dt is None else f', dt = {plain(row.dt)}'}: {row.reason}"
            for row in self.rows
            if row.reason
        ]
        parts = [text_table(self._limit_columns()), *self.without_limit(), ""] if self.limits else []
        below = ["", "Notes", *dict.fromkeys(notes)] if notes else []
        titles = ("step", "steps", "energy error", "drift per unit t", "blow-up at t", "leaves domain at t")
        more = ("volume error", "sympl. defect", "status")
        columns = [*self._names(self.rows), *attempts.columns(self.rows, titles + more, {"blow-up at t": _end})]
        return "\n".join([*parts, text_table(columns), *below])

    def without_limit(self) -> list[str]:
        """For each method whose longest stable step is not found on some systems, where that is and why: sentences."""
        found = {(x.system, x.label, x.dtype): x for x in self.limits}
        why: dict[tuple[str, str], list[str]] = {}
        for row in self.rows:
            limit = found.get((row.system, row.label, row.dtype))
            if limit is not None and limit.stable is not None and limit.unstable is not None:
                continue
            if limit is not None:
                reason = f"{'stable: ' * (limit.stable is not None)}{limit.reached}" or "none of the steps is stable"
            else:
                reason = "an adaptive method" if row.dt is None else f"{row.status}: see the notes"
            systems = why.setdefault((row.label, reason), [])
            if row.system not in systems:
                systems.append(row.system)
        several = len(self.systems) > 1
        return [
            f"No limit of {label}{f' on {_listed(systems)}' if several else ''}: {reason}."
            for (label, reason), systems in why.items()
        ]

    def settings(self) -> dict[str, Any]:
        return {
            "systems": [described(system) for system in self.systems],
            "metrics": list(self.metrics),
            "bound": self.bound,
            "limits": records(self.limits, [f.name for f in fields(StepLimit)]),
        }

    def figure(self, kind: str | None = None) -> Figure:
        """A matplotlib figure: "steps", the energy error against the step; or "map", step against stiffness.

        The default is the map for a family, else the steps.

        Raises
        ------
        ValueError
            For another kind, or a map of a single system.
        """
        from sympflow.studies.figures import stability_map, step_errors

        kind = kind or ("map" if len(self.systems) > 1 else "steps")
        if kind == "steps":
            return step_errors(self.rows)
        if kind != "map":
            raise ValueError(f"`kind` must be 'steps' or 'map'; got {kind!r}.")
        if len({row.value for row in self.rows}) < 2:
            raise ValueError(
                "`kind` 'map' needs several systems that differ in a parameter: pass a family to stability()."
            )
        lines: dict[str, list[tuple[float, float]]] = {}
        for x in self.limits:
            if x.stable is not None and x.unstable and x.value is not None:
                lines.setdefault(x.label, []).append((x.stable, x.value))
        return stability_map(self.rows, lines, self.without_limit() if self.limits else [])

    def plot(self, path: str | os.PathLike[str] | None = None, kind: str | None = None) -> Figure:
        """The figure, as `figure`; with a path it is also saved."""
        return saved(self.figure(kind), path)

    def _limit_columns(self) -> list[Column]:
        return [
            *self._names(self.limits),
            Column("longest stable step", ["none" if x.stable is None else f"{x.stable:.5g}" for x in self.limits]),
            Column("energy error there", [number(x.energy_error) for x in self.limits]),
            Column("linear limit", ["" if x.linear is None else f"{x.linear:.5g}" for x in self.limits]),
            Column("small oscillations are stable in", [_intervals(x.intervals) for x in self.limits], left=True),
            Column("stable", [x.reached for x in self.limits], left=True),
        ]

    def _names(self, rows: Sequence[Row | StepLimit]) -> list[Column]:
        several, precisions = len(self.systems) > 1, {r.dtype for r in rows}
        return [
            Column("system", [r.system if several else "" for r in rows], left=True),
            Column("method", [r.label for r in rows], left=True),
            Column("dtype", [r.dtype if len(precisions) > 1 else "" for r in rows], left=True),
        ]


def _end(row: Row) -> str:
    return "" if row.blow_up is None else f"{row.blow_up:.6g}{' (singular)' if row.singular else ''}"


def _intervals(intervals: Sequence[tuple[float, float]]) -> str:
    """The first intervals of stability, where there is more than one."""
    if len(intervals) < 2:
        return ""
    shown = [f"{a:.5g} to {b:.5g}" for a, b in intervals[:SHOWN_INTERVALS]]
    return ", ".join(shown) + (", …" if len(intervals) > SHOWN_INTERVALS else "")


def _listed(systems: list[str]) -> str:
    """Names that begin alike, as of a family, once: "oscillator, ω = 1, 100"."""
    first, _, _ = systems[0].rpartition(" = ")
    if first and all(name.startswith(f"{first} = ") for name in systems):
        return f"{first} = {', '.join(name.removeprefix(f'{first} = ') for name in systems)}"
    return "; ".join(systems)
