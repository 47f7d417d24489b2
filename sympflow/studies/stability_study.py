"""One method on one system in one precision: its runs with a range of steps, and what is measured."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sympflow.arguments import MAX_SAVED_VALUES
from sympflow.domain_exit import domain_of
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.metrics.energy import energy_drift, max_energy_error
from sympflow.metrics.symplectic import symplecticity_defect, volume_error
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.studies.candidates import Candidate
from sympflow.studies.comparison_report import title
from sympflow.studies.singularities import blow_up, failure_times
from sympflow.studies.stability_report import StabilityRow

STEPS = tuple(2.0**k for k in range(-1, 7))
"""Default steps of classical methods, times the system's; those of a trained flow are fractions of its Δt."""
FRACTIONS = (0.25, 0.5, 1.0)
MOST_OUTPUTS, TANGENT_STEPS = 20_000, 256
FEW_STARTS = 16  # up to so many, a compiled method runs one by one: the kernel for batches takes longer to compile
ARRAYS_SLOWER = 200  # times, by which runs on arrays are shortened
STABLE = ("stable", "bounded")


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
    say: Callable[[str], None] = lambda text: None  # what is being done, for a line of progress

    @property
    def has_steps(self) -> bool:
        return isinstance(self.candidate.integrator, FixedStep)

    def lengths(self, asked: list[float] | None) -> list[float | None]:
        """The steps to run; None for an adaptive method."""
        integrator = self.candidate.integrator
        if not isinstance(integrator, FixedStep):
            return [None]
        if integrator.trained:
            try:
                longest = integrator.step_length(self.system)
            except ValueError:  # there is no flow: the row says so
                return [self.system.dt]
            return [longest * fraction for fraction in FRACTIONS] if asked is None else [*asked]
        return [integrator.step_length(self.system) * f for f in STEPS] if asked is None else [*asked]

    def with_step(self, h: float | None) -> Integrator:
        integrator = self.candidate.integrator
        return integrator if h is None else replace(integrator, dt=h)

    def span(self, h: float | None) -> tuple[float, float]:
        """The interval, extended or shortened to between `min_steps` and `max_steps` steps."""
        t0, t1 = self.t_span
        if h is None:
            return t0, t1
        length = min(max(abs(t1 - t0), h * self.min_steps), h * self.most_steps)
        return t0, t0 + math.copysign(length, t1 - t0)

    @property
    def compiled(self) -> bool:
        return self.candidate.integrator.compiles and self.dtype == "float64"

    @property
    def most_steps(self) -> int:
        return self.max_steps if self.compiled else max(1, self.max_steps // ARRAYS_SLOWER)

    def runs(
        self, integrator: Integrator, h: float | None, y0: np.ndarray, span: tuple[float, float] | None = None
    ) -> list[Solution]:
        """Solutions that hold every step, or equally many of them, of each state."""
        span = self.span(h) if span is None else span
        together = isinstance(integrator, FixedStep) and integrator.finds_events  # steps on a common grid
        together &= not (self.compiled and len(y0) <= FEW_STARTS)
        width = y0.size if together else y0.shape[1]
        most = min(MOST_OUTPUTS, MAX_SAVED_VALUES // (2 * width))
        every = 1 if h is None else max(1, math.ceil(abs(span[1] - span[0]) / h / most))
        batches = [y0] if together else list(y0)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", RuntimeWarning)
            return [
                solve(self.system, integrator, span, b, save_every=every, dtype=self.dtype, on_domain_exit="ignore")
                for b in batches
            ]

    def stable(self, h: float) -> tuple[bool, float]:
        """Whether all runs with this step stay below the bound and in a flow's domain, and their largest error.

        Most unstable steps show in the first `min_steps` of them.
        """
        self.say(f"longest stable step: dt = {h:.6g}")
        t0, t1 = self.span(h)
        try:
            integrator = self.with_step(h)
            if abs(t1 - t0) > 4 * h * self.min_steps:
                early = (t0, t0 + math.copysign(h * self.min_steps, t1 - t0))
                error = _largest_error(self.runs(integrator, h, self.starts, early))
                if not error <= self.bound:
                    return False, error
            sols = self.runs(integrator, h, self.starts)
        except (ValueError, ArithmeticError):  # such as a step above Δt
            return False, math.inf
        error = _largest_error(sols)
        return self._status(error, integrator, sols)[0] in STABLE, error

    def _status(self, error: float, integrator: Integrator, sols: list[Solution]) -> tuple[str, str]:
        """The status of runs with this largest energy error, and what is to be said."""
        exit_time = self._exit(integrator, sols) if integrator.trained else None
        left = (
            "" if exit_time is None else f"Left the flow's domain at t = {exit_time:.6g}, where the flow says nothing."
        )
        if left or not error <= self.bound:
            return ("unstable" if not error <= self.bound else "outside"), left
        return (
            ("stable", "") if error <= 1 else ("bounded", f"The energy error stays bounded, but reaches {error:.3g}.")
        )

    def row(self, h: float | None) -> StabilityRow:
        """Everything that is asked for at one step."""
        self.say("" if h is None else f"dt = {h:.6g}")
        c, span = self.candidate, self.span(h)
        params = self.system.params
        row = StabilityRow(
            system=title(self.system),
            parameter=next(iter(params), None),
            value=next(iter(params.values()), None),
            method=c.method,
            label=c.label,
            dtype=self.dtype,
            dt=h,
            t_end=span[1],
        )
        try:
            if c.problem:
                raise ImportError(c.problem)
            integrator = self.with_step(h)
            sols = self.runs(integrator, h, self.starts)
        except (ValueError, TypeError, ImportError, NotImplementedError) as error:
            return replace(row, status="not applicable", reason=str(error))
        worst = _largest_error(sols)
        status, words = self._status(worst, integrator, sols)
        failure = next((s.message for s in sols if not s.success), "")
        row = replace(
            row,
            status=status,
            n_steps=max(int(s.stats["n_steps"]) for s in sols),
            energy_error=worst,
            reason=" ".join(x for x in (failure, words) if x),
        )
        row = self._blow_up(row, sols)
        for metric in self.metrics:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore", RuntimeWarning)
                row = getattr(self, f"_{metric}")(row, integrator, sols)
        return row

    def _blow_up(self, row: StabilityRow, sols: list[Solution]) -> StabilityRow:
        """The time and manner of the first failure, of the first state that fails."""
        for sol in sols:
            failed = np.isfinite(failure_times(sol))
            if failed.any():
                end = blow_up(sol, int(np.argmax(failed)))
                words = "" if end.singular and "infinite" in row.reason else str(end)
                return replace(row, blow_up=end.time, singular=end.singular, reason=f"{row.reason} {words}".strip())
        return row

    def _energy(self, row: StabilityRow, integrator: Integrator, sols: list[Solution]) -> StabilityRow:
        return row

    def _drift(self, row: StabilityRow, integrator: Integrator, sols: list[Solution]) -> StabilityRow:
        if row.status == "unstable" or len(sols[0].t) < 40:
            return row
        drifts = [energy_drift(s) for s in sols]
        slope = np.concatenate([np.ravel(d.slope) for d in drifts])
        error = np.concatenate([np.ravel(d.standard_error) for d in drifts])
        middle = int(np.argsort(slope)[len(slope) // 2])
        return replace(row, energy_drift=float(slope[middle]), energy_drift_error=float(error[middle]))

    def _volume(self, row: StabilityRow, integrator: Integrator, sols: list[Solution]) -> StabilityRow:
        return self._of_tangents(row, integrator, "volume_error", lambda sol: abs(float(volume_error(sol))))

    def _symplecticity(self, row: StabilityRow, integrator: Integrator, sols: list[Solution]) -> StabilityRow:
        return self._of_tangents(
            row, integrator, "symplecticity_defect", lambda sol: float(symplecticity_defect(sol, relative=True))
        )

    def _of_tangents(
        self, row: StabilityRow, integrator: Integrator, name: str, measure: Callable[[Solution], float]
    ) -> StabilityRow:
        """A metric of the first steps from the first state."""
        t0, t1 = self.span(row.dt)
        h = self.system.dt if row.dt is None else row.dt
        t1 = t0 + math.copysign(min(abs(t1 - t0), TANGENT_STEPS * h), t1 - t0)
        y0 = self._typed(self.starts[0])
        try:
            sol = solve(self.system, integrator, (t0, t1), y0, dtype=self.dtype, on_domain_exit="ignore")
            measured: dict[str, Any] = {name: measure(sol)}
            return replace(row, **measured)
        except (TypeError, ValueError, np.linalg.LinAlgError) as error:
            return replace(row, reason=f"{row.reason} No {name.replace('_', ' ')}: {error}".strip())

    def _domain(self, row: StabilityRow, integrator: Integrator, sols: list[Solution]) -> StabilityRow:
        return replace(row, domain_exit=self._exit(integrator, sols))

    def _exit(self, integrator: Integrator, sols: list[Solution]) -> float | None:
        """When the first trajectory leaves the domain of the flow, or of the system."""
        flow = getattr(integrator, "flow_for", lambda system: None)(self.system)
        domain = domain_of(flow, self.system)
        if domain is None:
            return None
        slack = float(getattr(flow, "figures", {}).get("energy_error_max") or 0.0)
        times = []
        for sol in sols:
            thin = max(1, len(sol.t) // 2000)
            states = np.asarray(sol.states)[..., ::thin, :]
            outside = ~domain.contains(states, slack=slack) & np.isfinite(states).all(-1)
            outside = outside.reshape(-1, outside.shape[-1]).any(0)
            if outside.any():
                times.append(float(sol.t[::thin][int(np.argmax(outside))]))
        return min(times) if times else None

    def _typed(self, y: np.ndarray) -> np.ndarray:
        return y.astype(self.dtype)


def _largest_error(sols: list[Solution]) -> float:
    """Over states and outputs, inf where a run failed or is not finite."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        worst = [float(np.max(max_energy_error(s))) for s in sols]
    return math.inf if any(math.isnan(x) for x in worst) else max(worst)
