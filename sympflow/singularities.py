"""How and when a run blows up: at a singularity of the solution, or by a step beyond the method's limit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from sympflow.integrators.base import Integrator
from sympflow.solver import solve
from sympflow.system import HamiltonianSystem

TAIL = 400  # steps before the end that are looked at


@dataclass(frozen=True)
class BlowUp:
    """The end of a run that could not go on.

    Attributes
    ----------
    time : float
        Of the singularity, extrapolated; or of the last finite state, where there is none.
    singular : bool
        Whether ‖y‖ grows like (t* − t)^−α, as before a singularity of the solution.
    growth : float
        Else the factor by which ‖y‖ grew with each step, the median over the last steps before the overflow.
    """

    time: float
    singular: bool
    growth: float

    def __str__(self) -> str:
        if self.singular:
            return f"The solution becomes infinite at t = {self.time:.6g}."
        if self.growth > 1.001:
            return f"The state grows by a factor {self.growth:.4g} a step until it overflows at t = {self.time:.6g}."
        return f"The run cannot go on after t = {self.time:.6g}."


def blow_up(
    system: HamiltonianSystem, integrator: Integrator, t_span: tuple[float, float], y0: np.ndarray, failed_at: float
) -> BlowUp:
    """How the run from y0 ended that could not go on after t = `failed_at`.

    Before a singularity ‖y‖ ~ (t* − t)^−α, so log‖y‖ changes by α log(τ/(τ − h)) in a step h at the distance τ from it:
    two successive changes give τ and α. They are the last ones that the method still resolves, below a factor e; the
    singularity is believed if the pair before says the same and the energy still holds. A step beyond the method's
    limit makes the state grow by a constant factor instead.

    Parameters
    ----------
    system, integrator, t_span, y0
        The run, of one trajectory.
    failed_at : float
        The time of its last finite state, `stats["failed_at"]`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        times = _tail(system, integrator, t_span[0], failed_at)
        sol = solve(system, integrator, (t_span[0], failed_at), y0, t_eval=times)
        finite = np.isfinite(sol.y).all(0)
        t, y = sol.t[finite], sol.y[:, finite].T.astype(float)
        if len(t) < 4:
            return BlowUp(failed_at, False, 1.0)
        change = np.diff(np.log(np.abs(y).max(-1)))
        energy_holds = np.abs(system.hamiltonian(y) - system.hamiltonian(y0)) < 0.1 * np.abs(
            (y * system.gradient(y)).sum(-1)
        )
    growth = float(np.exp(np.median(change[-20:])))
    resolved = np.flatnonzero((change > 0.02) & (change < 1) & energy_holds[:-1])
    last = int(resolved[-1]) if len(resolved) else 0
    if last >= 2:
        found = [_singularity(t[k - 1 : k + 2], change[k - 1 : k + 1]) for k in (last - 1, last)]
        h = abs(t[last + 1] - t[last])
        if found[0] is not None and found[1] is not None and abs(found[1] - found[0]) < 3 * h:
            return BlowUp(found[1], True, growth)
    return BlowUp(failed_at, False, growth)


def _singularity(t: np.ndarray, change: np.ndarray) -> float | None:
    """Where (t* − t)^−α becomes infinite whose logarithm changes by `change` (2,) between the times t (3,)."""

    def mismatch(beyond: float) -> float:
        tau = abs(t[2] - t[0]) * (1 + beyond) - np.abs(t - t[0])
        steps = np.log(tau[:-1] / tau[1:])
        return float(steps[1] * change[0] - steps[0] * change[1])

    near, far = 1e-6, 30.0
    if not (change[1] > change[0] > 0 and mismatch(near) * mismatch(far) < 0):
        return None
    beyond = brentq(mismatch, near, far)
    return float(t[0] + (t[2] - t[0]) * (1 + beyond))


def _tail(system: HamiltonianSystem, integrator: Integrator, t0: float, t1: float) -> np.ndarray | None:
    length = getattr(integrator, "step_length", None)
    if length is None or t1 == t0:  # an adaptive method: its own steps
        return None
    h = np.sign(t1 - t0) * length(system)
    n = int(np.rint((t1 - t0) / h))
    return np.clip(t0 + h * np.arange(max(0, n - TAIL), n + 1), min(t0, t1), max(t0, t1))
