"""How and when a run blows up: at a singularity of the solution, or by a step beyond the method's limit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from sympflow.integrators.base import Integrator
from sympflow.solver import solve
from sympflow.system import HamiltonianSystem

TAIL = 400  # steps before the end that are looked at
RTOL = 1e-11  # of the reference, an adaptive method of order 8 whose step underflows at a singularity
AHEAD = 4  # steps beyond the end that the reference may take: an implicit method gives up before a singularity


@dataclass(frozen=True)
class BlowUp:
    """The end of a run that could not go on.

    Attributes
    ----------
    time : float
        Of the singularity, by the reference; or of the last finite state, where there is none.
    singular : bool
        Whether the solution itself becomes infinite, as a reference at tight tolerance does.
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


def blow_up(
    system: HamiltonianSystem, integrator: Integrator, t_span: tuple[float, float], y0: np.ndarray, failed_at: float
) -> BlowUp:
    """How the run from y0 ended that could not go on after t = `failed_at`.

    The method's own last states tell little of when: a step leaps over a singularity, and a step beyond the method's
    limit grows without one. So dop853 at a relative tolerance of 1e-11 goes over the last `TAIL` steps again (over all
    of them if there were fewer, and then from y0), from a state that still has the energy of y0. The solution is
    singular where the reference too comes to an end, its state having grown without bound.

    Parameters
    ----------
    system, integrator, t_span, y0
        The run, of one trajectory.
    failed_at : float
        The time of its last finite state, `stats["failed_at"]`.
    """
    length = getattr(integrator, "step_length", None)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        times = _tail(system, integrator, t_span[0], failed_at)
        sol = solve(system, integrator, (t_span[0], failed_at), y0, t_eval=times, on_domain_exit="ignore")
        finite = np.isfinite(sol.y).all(0)
        t, y = sol.t[finite][-TAIL - 1 :], sol.y[:, finite].T[-TAIL - 1 :].astype(float)
        growth = None
        if length is not None:
            change = np.diff(np.log(np.abs(y).max(-1))) if len(y) else np.empty(0)
            growth = float(np.exp(np.median(change[-20:]))) if len(change) else 1.0
        if not len(t):
            t, y = np.array([t_span[0]]), np.asarray(y0, dtype=float)[None]
        missing = np.abs(system.hamiltonian(y[0]) - system.hamiltonian(np.asarray(y0, dtype=float)))
        if missing < 0.1 * np.abs((y[0] * system.gradient(y[0])).sum()) or missing == 0:
            ahead = AHEAD * (length(system) if length is not None else abs(failed_at - t[0]) / len(t))
            time = _singularity(system, float(t[0]), failed_at + np.copysign(ahead, t_span[1] - t_span[0]), y[0])
            if time is not None:
                return BlowUp(time, True, growth)
    return BlowUp(failed_at, False, growth)


def _singularity(system: HamiltonianSystem, t0: float, t1: float, y0: np.ndarray) -> float | None:
    """Where the solution from y0 becomes infinite before t1, if it does."""
    sol = solve(system, "dop853", (t0, t1), y0, rtol=RTOL, atol=RTOL, on_domain_exit="ignore")
    if sol.status == 0 or len(sol.t) < 3:
        return None
    size = np.abs(sol.y).max(0)
    stuck = abs(sol.t[-1] - sol.t[-2]) < 1e-9 * abs(sol.t[-1] - sol.t[0])  # else it was too slow, not at an end
    return float(sol.t[-1]) if stuck and size[-1] > 100 * size[0] else None


def _tail(system: HamiltonianSystem, integrator: Integrator, t0: float, t1: float) -> np.ndarray | None:
    length = getattr(integrator, "step_length", None)
    if length is None or t1 == t0:  # an adaptive method: its own steps
        return None
    h = np.sign(t1 - t0) * length(system)
    n = int(np.rint((t1 - t0) / h))
    return np.clip(t0 + h * np.arange(max(0, n - TAIL), n + 1), min(t0, t1), max(t0, t1))
