"""What is measured of one method in a comparison: the row, and the metrics that fill it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sympflow.integrators.registry import naming_plugin
from sympflow.metrics.accuracy import time_reversal_error
from sympflow.metrics.energy import energy_drift, energy_error, failed, max_energy_error
from sympflow.metrics.symplectic import symplecticity_defect, volume_error
from sympflow.solution import Solution
from sympflow.studies.candidates import Candidate


@dataclass(frozen=True)
class Row:
    """What was measured of one method; None where it was not asked for, does not apply or could not be had.

    Errors, drift and defect are inf where the run became non-finite or could not be continued.

    Attributes
    ----------
    system, method, label : str
    status : str
        "ok"; "failed", if it ran and did not reach the end; "not applicable", if it could not run.
    reason : str
        Why it failed, and whatever else should be known.
    dt : float or None
        Step of a fixed-step method; for an adaptive one see `tolerance`.
    tolerance : float or None
        rtol of an adaptive method.
    backend : str
        What ran: "compiled", "numpy", "torch", "scipy" or "torchdiffeq".
    run_time, run_time_spread : float
        Median and interquartile range of the repeats, in seconds.
    force_evaluations, hessian_evaluations : int
        Of one run, all trajectories of a SciPy batch together.
    error : float
        max over the instants of ‖y − y_ref‖; of a batch the median over its trajectories.
    energy_error : float
        max |ΔH| over the instants, relative as in `sympflow.energy_error`; of a batch the median.
    energy_drift, energy_drift_error : float
        Slope of the energy error per unit time, and its standard error; of a batch, those of the median slope.
    volume_error : float
        Σ log|det| over the steps; of a batch the one that is largest in magnitude.
    symplecticity_defect : float
        max ‖AᵀJA − J‖/‖A‖² over the steps and trajectories.
    time_reversal_error : float
        ‖y − y0‖ after there and back; of a batch the median.
    training_time : float
        Seconds that training the flow took.
    """

    system: str
    method: str
    label: str
    status: str = "ok"
    reason: str = ""
    dt: float | None = None
    tolerance: float | None = None
    backend: str | None = None
    run_time: float | None = None
    run_time_spread: float | None = None
    force_evaluations: int | None = None
    hessian_evaluations: int | None = None
    error: float | None = None
    energy_error: float | None = None
    energy_drift: float | None = None
    energy_drift_error: float | None = None
    volume_error: float | None = None
    symplecticity_defect: float | None = None
    time_reversal_error: float | None = None
    training_time: float | None = None


@dataclass
class Run:
    """A candidate on its way to a row."""

    candidate: Candidate
    row: Row
    sol: Solution | None = None
    energy: np.ndarray | None = field(default=None, repr=False)
    volume: np.ndarray | None = field(default=None, repr=False)

    def note(self, text: str) -> None:
        self.row = replace(self.row, reason=f"{self.row.reason} {text}".strip())


def largest(series: np.ndarray, sol: Solution) -> np.ndarray:
    """Maxima over time of a non-negative series, inf for trajectories that failed."""
    worst = np.where(np.isnan(series), np.inf, series).max(axis=-1, initial=0.0)
    return np.where(failed(sol), np.inf, worst)


def note_backends(runs: Sequence[Run]) -> None:
    """Say of a flow that runs in eager torch that others run compiled: its run time is not one of the same kind."""
    if not any(run.row.backend == "compiled" for run in runs):
        return
    for run in runs:
        if run.row.backend == "torch":
            run.note("Runs in eager torch, while others run compiled: the run times are not like for like.")


def measure(one: Run, sol: Solution, asked: tuple[str, ...]) -> None:
    """Compute the metrics asked for; a metric that cannot be had leaves a note."""
    for metric in asked:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RuntimeWarning)
            try:
                with naming_plugin(sol.integrator, passes=(TypeError, ValueError)):  # by which it says that it cannot
                    MEASURES[metric](one, sol)
            except Exception as error:
                one.note(f"No {metric}: {error}")
        for message in dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, RuntimeWarning)):
            if message not in one.row.reason:
                one.note(message)


def _energy(one: Run, sol: Solution) -> None:
    one.energy = np.abs(energy_error(sol))
    one.row = replace(one.row, energy_error=float(np.median(max_energy_error(sol))))


def _drift(one: Run, sol: Solution) -> None:
    if failed(sol).all():
        one.row = replace(one.row, energy_drift=np.inf, energy_drift_error=np.inf)
        return
    drift = energy_drift(sol)
    slope, error = np.ravel(drift.slope), np.ravel(drift.standard_error)
    middle = int(np.argsort(slope)[len(slope) // 2])
    one.row = replace(one.row, energy_drift=float(slope[middle]), energy_drift_error=float(error[middle]))


def _volume(one: Run, sol: Solution) -> None:
    if failed(sol).all():
        one.row = replace(one.row, volume_error=np.inf)
        return
    one.volume = series = np.asarray(volume_error(sol, over_time=True))
    last = np.ravel(np.where(failed(sol), np.inf, series[..., -1]))
    worst = np.argmax(np.abs(last))
    one.row = replace(one.row, volume_error=float(last[worst]))


def _symplecticity(one: Run, sol: Solution) -> None:
    if failed(sol).all():
        one.row = replace(one.row, symplecticity_defect=np.inf)
        return
    one.row = replace(one.row, symplecticity_defect=float(np.max(symplecticity_defect(sol, relative=True))))


def _reversal(one: Run, sol: Solution) -> None:
    try:
        one.row = replace(one.row, time_reversal_error=float(np.median(time_reversal_error(sol))))
    except TypeError:
        one.note(f"No reversal: method {one.row.method!r} cannot run backwards in time.")


MEASURES: dict[str, Callable[[Run, Solution], None]] = {
    "error": lambda one, sol: None,  # filled in with the reference, once for all methods
    "energy": _energy,
    "drift": _drift,
    "volume": _volume,
    "symplecticity": _symplecticity,
    "reversal": _reversal,
}
