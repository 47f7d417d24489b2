"""Attempts: a method run once under the conditions of a study, its failure caught, its measurements a row.

Every study, `compare`, `work_precision` and `stability` alike, makes its rows of attempts. A metric is a line of
`MEASURES`: a function of an attempt, the names of the figures that it gives, and the title of their column.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.registry import build, name_of, naming_plugin
from sympflow.metrics.accuracy import reference_error, time_reversal_error
from sympflow.metrics.energy import energy_drift, energy_error, failed, largest
from sympflow.metrics.energy_balance import energy_balance_error
from sympflow.metrics.reference import Reference
from sympflow.metrics.symplectic import conformal_defect, symplecticity_defect, volume_error
from sympflow.solution import Solution
from sympflow.studies.reports import Column, number, plain, seconds

REFUSALS = (ValueError, TypeError, ImportError, NotImplementedError)
"""Errors by which a method says that it does not apply; any other is a failure."""


def check_progress(progress: object) -> None:
    """Raise unless it is None or can be called with a line of text."""
    if progress is not None and not callable(progress):
        raise TypeError(f"`progress` must be a function of one line of text; got {progress!r}.")


# methods ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Candidate:
    """A method under its label; `problem` says why it has no integrator, if so."""

    label: str
    method: str
    integrator: Any
    problem: str = ""


def candidates(methods: Sequence[Any], dt: float | None = None) -> list[Candidate]:
    """Candidates with distinct labels, of names, integrators, flows, or pairs (label, any of these)."""
    if isinstance(methods, str) or not isinstance(methods, Sequence):
        raise TypeError(f"`methods` must be a list of methods; got {methods!r}. Put it in brackets.")
    if not methods:
        raise ValueError("`methods` is empty: name at least one of sympflow.available().")
    found: list[Candidate] = []
    for entry in methods:
        labelled = isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[0], str)
        label, method = entry if labelled else (None, entry)
        try:
            integrator = build(method, {})
        except ImportError as error:
            name = str(method)
            found.append(Candidate(_distinct(label or name, found), name, None, str(error)))
            continue
        if dt is not None and isinstance(method, str) and isinstance(integrator, FixedStep) and not integrator.trained:
            integrator = replace(integrator, dt=dt)
        name = method if isinstance(method, str) else name_of(integrator)
        found.append(Candidate(_distinct(label or _label(name, method, integrator), found), name, integrator))
    return found


def _label(name: str, method: Any, integrator: Integrator) -> str:
    """The name, with the step or tolerance if the caller configured one."""
    if not isinstance(method, Integrator) or integrator.trained:
        return name
    name = name if integrator.label == integrator.name else integrator.label
    if isinstance(integrator, FixedStep):
        return name if integrator.dt is None else f"{name} (dt={integrator.dt:g})"
    tolerance = tolerance_of(integrator)
    return name if tolerance is None else f"{name} (rtol={tolerance:g})"


def _distinct(label: str, found: list[Candidate]) -> str:
    taken = {c.label for c in found}
    if label not in taken:
        return label
    return next(f"{label} #{k}" for k in range(2, len(found) + 2) if f"{label} #{k}" not in taken)


def tolerance_of(integrator: Any) -> float | None:
    """The rtol of an adaptive method; None for a method without that option."""
    return integrator.rtol if "rtol" in integrator.options() else None


GOLDEN = (math.sqrt(5) - 1) / 2


def instants(t0: float, t1: float, n: int, dt: float) -> np.ndarray:
    """The times (n,) at which methods are compared: one in each n-th of the interval, the last at its end.

    Their places within these parts go on by the golden section, so that they meet all phases of an oscillation even
    where its period divides the parts. They are ends of steps dt where a part holds two of these or more, so that a
    method makes no other steps for them.
    """
    k = np.arange(1, n)
    elapsed = (k - 1 + (GOLDEN * k) % 1) * (abs(t1 - t0) / n)
    if 2 * dt * n <= abs(t1 - t0):
        elapsed = dt * np.rint(elapsed / dt)
    return np.append(t0 + math.copysign(1, t1 - t0) * elapsed, t1)


# rows -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class Row:
    """The measurements of one method; None where a figure was not requested, does not apply or could not be computed.

    Errors, drift and defect are inf where the run became non-finite or could not be continued. The repr shows the
    figures that are there. Those of the metrics are attributes too: they are kept in `figures`, by their names.

    Attributes
    ----------
    system, method, label : str
    status : str
        "ok"; "failed", if the run did not reach the end, or the method broke; "not applicable", if it could not run.
        In work and precision also "uncertain", if the error is not 100 times the reference's own. In a study of
        stability instead of "ok": "stable"; "bounded", as stable, but the energy error exceeds 1, so that the result is
        useless; "outside", if a run of a trained flow left the domain that the flow was trained on, where it is not
        valid; "unstable", if a run became non-finite, could not go on, or its energy error exceeded the bound.
    reason : str
        Why it failed, and whatever else should be known.
    dt : float or None
        Step of a fixed-step method; for an adaptive one see `tolerance`.
    tolerance : float or None
        rtol of an adaptive method.
    trajectories : int
        Size of the batch that was run, or 1.
    dtype : str
        Precision of the states, "float64" or "float32", where a study compares them.
    parameter, value : str, float
        The system's first parameter, such as its stiffness, where a study compares systems.
    t_end : float
        End of the run, where it depends on the step.
    n_steps : int
        Steps that were taken.
    backend : str
        The code that ran: "compiled", "numpy", "torch", "scipy" or "torchdiffeq".
    run_time, run_time_spread : float
        Median and interquartile range of the repeats, of all trajectories together, in seconds.
    compile_time : float
        Seconds by which the first run of the method, over a few steps, took longer than a second one: compiling its
        loops, or loading them from the cache, and imports. They are not part of the run time.
    repeats : int
        Runs that were timed, where their number depends on the row.
    force_evaluations, hessian_evaluations : int or float
        Of one run, all trajectories of a SciPy batch together; in work and precision those of one trajectory.
    error : float
        max over the instants of ‖y − y_ref‖; of a batch the median over its trajectories.
    energy_error : float
        max |ΔH| over the instants, relative as in `sympflow.energy_error`; of a batch the median, in a study of
        stability the largest over all initial states.
    balance_error : float
        Of a driven system, max |H − H(y0) − ∫ ∂H/∂t dt| over the instants, relative as in
        `sympflow.energy_balance_error`; of a batch the median.
    energy_drift, energy_drift_error : float
        Slope of the energy error per unit time, and its standard error by batch means; of a batch, those of the median
        slope.
    blow_up : float
        Time at which a run failed: that of the singularity if the solution has one, else of its last finite state.
    singular : bool
        True if it is a singularity of the solution, rather than an instability of the method.
    domain_exit : float
        Time at which the first trajectory left the domain Ω of the flow, or of the system.
    volume_error : float
        Σ log|det| over the steps; of a batch the one that is largest in magnitude. In a study of stability its
        magnitude, over the first 256 steps.
    symplecticity_defect : float
        max ‖AᵀJA − J‖/‖A‖² over the steps and trajectories; in a study of stability over the first 256 steps.
    conformal_defect : float
        Of a damped system, max ‖AᵀJA − e^{−γh}J‖/‖A‖² over the steps and trajectories.
    time_reversal_error : float
        ‖y − y0‖ after there and back; of a batch the median.
    training_time : float
        Seconds that training the flow took.
    break_even : float
        Of a trained flow in work and precision: how many units of time must be solved until its training has paid for
        itself, against the cheapest untrained method that is as accurate in energy. inf if it never does.
    """

    system: str
    method: str
    label: str
    status: str = "ok"
    reason: str = ""
    dt: float | None = None
    tolerance: float | None = None
    trajectories: int = 1
    dtype: str = ""
    parameter: str | None = None
    value: float | None = None
    t_end: float | None = None
    n_steps: int | None = None
    backend: str | None = None
    run_time: float | None = None
    run_time_spread: float | None = None
    compile_time: float | None = None
    repeats: int = 0
    force_evaluations: float | None = None
    hessian_evaluations: float | None = None
    blow_up: float | None = None
    singular: bool | None = None
    training_time: float | None = None
    break_even: float | None = None
    figures: Mapping[str, float] = field(default_factory=dict)

    def __getattr__(self, name: str) -> float | None:
        if name not in FIGURES:
            raise AttributeError(f"Row has no attribute {name!r}.", name=name, obj=self)
        return self.figures.get(name)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *FIGURES]

    def __repr__(self) -> str:
        known = ((f.name, getattr(self, f.name), f.default) for f in fields(self) if f.name != "figures")
        filled = {name: value for name, value, default in known if name == "status" or value != default}
        return f"Row({', '.join(f'{name}={value!r}' for name, value in (filled | dict(self.figures)).items())})"


@contextmanager
def any_step() -> Iterator[None]:
    """Run without warnings of steps that are too long: studies sweep these, and a row has its energy error."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`(dt` .*|rtol`) is too")
        yield


# attempts ---------------------------------------------------------------------------------------------------------


@dataclass
class Attempt:
    """A candidate on its way to a row: its solutions, and energy and volume errors (..., n) over time, if measured."""

    candidate: Candidate
    row: Row
    sols: tuple[Solution, ...] = field(default=(), repr=False)
    energy: np.ndarray | None = field(default=None, repr=False)
    volume: np.ndarray | None = field(default=None, repr=False)

    @property
    def sol(self) -> Solution | None:
        """The solution, the first if there are several; None if there is none."""
        return self.sols[0] if self.sols else None

    @property
    def lost(self) -> bool:
        """True if no trajectory reached its end."""
        return all(failed(sol).all() for sol in self.sols)

    def note(self, text: str) -> None:
        """Add a sentence to the reason."""
        self.fill(reason=f"{self.row.reason} {text}".strip())

    def fill(self, **figures: Any) -> None:
        """Enter facts in the row."""
        self.row = replace(self.row, **figures)

    def enter(self, **figures: float | None) -> None:
        """Enter figures of metrics in the row, but for those that could not be had."""
        self.fill(figures={**self.row.figures, **{name: x for name, x in figures.items() if x is not None}})

    def run(self, run: Callable[[Any], Solution | Sequence[Solution]]) -> None:
        """Run the candidate's integrator once, and enter its counts; or the reason why there is no solution."""
        integrator = self.candidate.integrator
        try:
            if self.candidate.problem:
                raise ImportError(self.candidate.problem)
            with any_step():
                found = run(integrator)
            self.sols = (found,) if isinstance(found, Solution) else tuple(found)
            sol = self.sols[0]  # `sol.integrator` may be another than was asked for: see `Integrator.resolved`
            trained = sol.integrator.figures(sol.system).get("training_seconds") if sol.integrator.trained else None
        except REFUSALS as error:
            self.sols = ()
            self.fill(status="not applicable", reason=str(error))
            return
        except Exception as error:
            self.sols = ()
            self.fill(status="failed", reason=f"{type(error).__name__}: {error}")
            return
        stats = sol.stats
        self.fill(
            status="failed" if self.lost or (sol.y.ndim == 2 and not sol.success) else "ok",
            reason=next((s.message for s in self.sols if not s.success), ""),
            dt=stats.get("dt"),
            tolerance=tolerance_of(sol.integrator),
            n_steps=max(int(s.stats["n_steps"]) for s in self.sols),
            backend=stats.get("backend", "").partition(":")[0] or None,
            force_evaluations=int(stats["force_evaluations"]),
            hessian_evaluations=int(stats["hessian_evaluations"]),
            training_time=trained,
        )
        if sol.success and "domain_exit" in stats:
            self.note(f"The state left the flow's domain at t = {stats['domain_exit']:.4g}.")

    def warm_up(
        self, run: Callable[[Any, tuple[float, float], np.ndarray], object], t: np.ndarray, t0: float, dt: float
    ) -> None:
        """Compile what the candidate's runs need, and enter the time that it took; a run that fails is left to `run`.

        `dt` is a step of the system, for methods that choose theirs.
        """
        integrator = self.candidate.integrator
        if integrator is None:
            return
        step = (isinstance(integrator, FixedStep) and integrator.dt) or dt
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                self.fill(compile_time=warm_up(lambda span, times: run(integrator, span, times), step, t, t0))
        except Exception:  # the run itself says why
            return

    def measure(self, asked: Sequence[str], metrics: Mapping[str, Measure] | None = None) -> None:
        """Enter the requested metrics; a failure leaves a note, and so does a RuntimeWarning."""
        if self.sol is None:
            return
        for name in asked:
            metric = (metrics or MEASURES)[name]
            with self.noting_warnings():
                try:
                    with naming_plugin(self.sol.integrator, passes=(TypeError, ValueError)):  # these say that it cannot
                        self.enter(**dict(zip(metric.figures, np.atleast_1d(metric.of(self)).tolist(), strict=True)))
                except Exception as error:
                    self.note(f"No {name}: {error}")

    @contextmanager
    def noting_warnings(self) -> Iterator[None]:
        """Turn RuntimeWarnings into notes, each once; NumPy's of overflow and the like are not raised."""
        with warnings.catch_warnings(record=True) as caught, np.errstate(all="ignore"):
            warnings.simplefilter("always", RuntimeWarning)
            yield
        for message in dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, RuntimeWarning)):
            if message not in self.row.reason:
                self.note(message)


# metrics ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measure:
    """A metric of attempts: the title of its column, the names of its figures, and a function that gives these."""

    title: str
    figures: tuple[str, ...]  # the second, if any, is the uncertainty of the first
    of: Callable[[Attempt], Any]
    conserved: bool = True  # False for one that damped systems have too

    def cell(self, row: Row) -> str:
        """The figures of a row in a table."""
        values = zip(map(row.__getattr__, self.figures), (2, 1), strict=False)
        return " ± ".join(number(x, digits) for x, digits in values if x is not None)


def accuracy(attempt: Attempt, truth: Reference) -> None:
    """The distance from a reference, or from the part of it that belongs to the trajectories that were run."""
    (sol,) = attempt.sols
    states = truth if sol.y.shape[:-1] == truth.y.shape[:-1] else truth.y[: len(sol.y0)]
    attempt.enter(error=float(np.median(largest(reference_error(sol, states), sol))))


def energy(attempt: Attempt, of: Callable[[Solution], np.ndarray]) -> float:
    """The error of the energy, or of its balance, over time, and its maximum."""
    (sol,) = attempt.sols
    attempt.energy = series = np.abs(of(sol))
    return float(np.median(largest(series, sol)))


def drift(attempt: Attempt) -> tuple[float, float]:
    """The trend of the energy error: the median slope over all trajectories, with its own standard error."""
    if attempt.lost:
        return np.inf, np.inf
    drifts = [energy_drift(sol) for sol in attempt.sols]
    slope = np.concatenate([np.ravel(d.slope) for d in drifts])
    uncertainty = np.concatenate([np.ravel(d.standard_error) for d in drifts])
    middle = int(np.argsort(slope)[len(slope) // 2])
    return float(slope[middle]), float(uncertainty[middle])


def volume(attempt: Attempt) -> float:
    """The volume error over time, and the last value that is largest in magnitude."""
    (sol,) = attempt.sols
    if attempt.lost:
        return np.inf
    attempt.volume = series = np.asarray(volume_error(sol, over_time=True))
    last = np.ravel(np.where(failed(sol), np.inf, series[..., -1]))
    return float(last[np.argmax(np.abs(last))])


def defect(attempt: Attempt, of: Callable[..., Any]) -> float:
    """The largest defect of a step, relative to the step's norm: of `symplecticity_defect` or `conformal_defect`."""
    (sol,) = attempt.sols
    return np.inf if attempt.lost else float(np.max(of(sol, relative=True)))


def reversal(attempt: Attempt) -> float | None:
    """The error of returning to the start."""
    (sol,) = attempt.sols
    try:
        return float(np.median(time_reversal_error(sol)))
    except TypeError:
        attempt.note(f"No reversal: method {attempt.row.method!r} cannot run backwards in time.")
        return None


MEASURES = {  # the metrics by their names, in the order of their columns
    "energy": Measure("energy error", ("energy_error",), partial(energy, of=energy_error)),
    "balance": Measure(
        "energy balance", ("balance_error",), partial(energy, of=partial(energy_balance_error, relative=True))
    ),
    "drift": Measure("drift per unit t", ("energy_drift", "energy_drift_error"), drift),
    "volume": Measure("volume error", ("volume_error",), volume),
    "symplecticity": Measure("sympl. defect", ("symplecticity_defect",), partial(defect, of=symplecticity_defect)),
    "conformal": Measure("conf. defect", ("conformal_defect",), partial(defect, of=conformal_defect), False),
    "reversal": Measure("reversal", ("time_reversal_error",), reversal, False),
}
OF_MEASURES = tuple(name for measure in MEASURES.values() for name in measure.figures)
FIGURES = {"error", "domain_exit", *OF_MEASURES}
"""The attributes of rows that are figures of metrics."""


# tables -----------------------------------------------------------------------------------------------------------

NEGLIGIBLE = 0.1  # seconds of compilation that tables leave out
CELLS: dict[str, Callable[[Any], str]] = {  # the cells of tables of rows, by the titles of their columns
    "method": lambda row: row.label,
    "batch": lambda row: f"{row.trajectories:,}",
    "step": lambda row: plain(row.dt),
    "rtol": lambda row: "" if row.tolerance is None else f"{row.tolerance:.0e}",
    "backend": lambda row: row.backend or "",
    "run time": lambda row: seconds(row.run_time),
    "±": lambda row: seconds(row.run_time_spread),
    "steps": lambda row: counted(row.n_steps),
    "forces": lambda row: counted(row.force_evaluations),
    "Hessians": lambda row: counted(row.hessian_evaluations),
    "error": lambda row: number(row.error),
    "leaves domain at t": lambda row: plain(row.domain_exit),
    **{measure.title: measure.cell for measure in MEASURES.values()},
    "training": lambda row: seconds(row.training_time),
    "compiled in": lambda row: seconds(row.compile_time) if (row.compile_time or 0.0) >= NEGLIGIBLE else "",
    "status": lambda row: "" if row.status == "ok" else row.status,
}


def counted(x: float | None) -> str:
    """A count: 12,000; empty for none."""
    return f"{x:,.0f}" if x else ""


def columns(rows: Sequence[Any], titles: Sequence[str], own: Mapping[str, Any] | None = None) -> list[Column]:
    """Columns of these titles, with cells of `CELLS` or of their own."""
    cells = CELLS | dict(own or {})
    left = ("method", "backend", "status")
    return [Column(title, [cells[title](row) for row in rows], title in left) for title in titles]


# run times --------------------------------------------------------------------------------------------------------


class RunTime(NamedTuple):
    """Median and interquartile range of the repeats, in seconds."""

    median: float
    spread: float


def interleaved(calls: Sequence[Callable[[], object]], repeats: int) -> list[RunTime]:
    """Time every call `repeats` times, going round over all of them, so that a slow spell of the machine hits each.

    The calls should have run before, or been warmed up: see `warm_up`.
    """
    if not calls:
        return []
    passed = np.empty((repeats, len(calls)))
    with any_step():
        for r in range(repeats):
            for i, call in enumerate(calls):
                start = time.perf_counter()
                call()
                passed[r, i] = time.perf_counter() - start
    low, median, high = np.quantile(passed, [0.25, 0.5, 0.75], axis=0)
    return [RunTime(float(m), float(h - lo)) for lo, m, h in zip(low, median, high, strict=True)]


WARM_STEPS = 3.5  # steps of a run that compiles: whole ones, and the shorter ones of the outputs between them


def warm_up(run: Callable[[tuple[float, float], np.ndarray], object], step: float, t: np.ndarray, t0: float) -> float:
    """Make a run twice over a few steps, so that all that a long one needs is compiled; the seconds of doing so.

    Parameters
    ----------
    run : callable
        Solves over an interval with outputs at some instants.
    step : float
        Length of a step, about.
    t : ndarray (n,)
        The instants of the long run, up to its end: the short one has as many.
    t0 : float
        Its start.

    Returns
    -------
    float
        The time of the first run beyond that of the second.
    """
    length = float(t[-1]) - t0
    short = math.copysign(min(abs(length), WARM_STEPS * step), length)
    times = t0 + (t - t0) * (short / length)
    times[-1] = t0 + short
    passed = []
    for _ in range(2):
        start = time.perf_counter()
        run((t0, t0 + short), times)
        passed.append(time.perf_counter() - start)
    return max(0.0, passed[0] - passed[1])
