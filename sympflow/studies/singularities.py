"""How and when a run blew up: at a singularity of the solution, or by a step beyond the method's limit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.integrators.base import FixedStep
from sympflow.solution import Solution
from sympflow.solver import solve

TAIL = 20  # steps before the end whose growth is looked at


@dataclass(frozen=True)
class BlowUp:
    """The end of a run that could not go on.

    Attributes
    ----------
    time : float
        Of the singularity, as `solve` estimates it; or of the last finite state, where there is none.
    singular : bool
        Whether the solution itself becomes infinite.
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
    """How trajectory i of a solution ended that could not go on."""
    y0 = to_numpy(sol.y0).reshape(-1, 2 * sol.system.ndof)
    failed_at = float(failure_times(sol)[i])
    time = float(np.ravel(sol.stats.get("blow_up_time", np.full(len(y0), np.nan)))[i])
    growth = _growth(sol, y0[i], failed_at)
    return BlowUp(time, True, growth) if np.isfinite(time) else BlowUp(failed_at, False, growth)


def _growth(sol: Solution, y0: np.ndarray, failed_at: float) -> float | None:
    if not (isinstance(sol.integrator, FixedStep) and sol.integrator.on_grid):
        return None
    t0, h = sol.t_span[0], np.copysign(sol.stats["dt"], sol.t_span[1] - sol.t_span[0])
    n = int(np.rint((failed_at - t0) / h))
    if n < 1:
        return 1.0
    times = np.clip(t0 + h * np.arange(max(0, n - TAIL), n + 1), min(t0, failed_at), max(t0, failed_at))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        tail = solve(sol.system, sol.integrator, (t0, failed_at), y0, t_eval=times, on_domain_exit="ignore").y
        change = np.diff(np.log(np.abs(tail).max(0)))
    return float(np.exp(np.median(change))) if len(change) and np.isfinite(change).all() else 1.0
