"""Round-off: how the energy error grows with the number of steps, once it is rounding alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sympflow.metrics.arguments import check_solution
from sympflow.metrics.energy import energy_error, failed
from sympflow.solution import Solution

WINDOWS_PER_DECADE = 3


@dataclass(frozen=True)
class EnergyGrowth:
    """The growth rms|ΔH| ~ n^exponent of the energy error with the number of steps n, and its drift.

    Attributes
    ----------
    steps : ndarray (w,)
        Numbers of steps, the geometric middles of windows of a third of a decade.
    rms : ndarray (w,)
        Root mean square of the energy error over the outputs of the window and all trajectories.
    exponent, exponent_error : float
        Slope of log rms against log steps, and its standard error. Independent rounding errors give ½ (Brouwer's law),
        a systematic error in each step gives 1, a truncation error above the rounding 0.
    drift, drift_error : float
        Slope of the energy error per step, the mean over the trajectories, and its standard error from the scatter
        between them; the error is inf for a single trajectory, whose random walk cannot be told from a drift.
    """

    steps: np.ndarray = field(repr=False)
    rms: np.ndarray = field(repr=False)
    exponent: float
    exponent_error: float
    drift: float
    drift_error: float


def energy_growth(sol: Solution, first: float = 1000.0) -> EnergyGrowth:
    """Fit the growth of the energy error of a long run with the number of its steps.

    Parameters
    ----------
    sol : Solution
        Of a fixed-step method, better of a batch of eight trajectories or more, with regular outputs (`save_every`).
    first : float
        Steps before which the outputs are not used.

    Raises
    ------
    TypeError
        If `sol` is not a Solution.
    ValueError
        If it has no fixed step, has failed, or is shorter than a decade beyond `first`.

    Notes
    -----
    Of a run at regular times the slope through the origin, Σ eₖtₖ/Σ tₖ², is fitted to each trajectory.

    References
    ----------
    .. [1] D. Brouwer, "On the accumulation of errors in numerical integration", Astron. J. 46 (1937) 149–153.
    .. [2] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006), VIII.5.
    """
    check_solution(sol)
    dt = sol.stats.get("dt")
    if dt is None:
        raise ValueError("`sol` has no fixed step: growth with the number of steps is that of a fixed-step method.")
    if failed(sol).any():
        raise ValueError("`sol` has failed: solve again with a shorter `dt` or interval.")
    n = np.abs(sol.t - sol.t[0]) / dt
    if not (first > 0 and len(n) and n[-1] >= 10 * first):
        raise ValueError(f"`sol` must have at least {10 * first:g} steps, ten times `first`; got {n[-1]:g}.")
    error = energy_error(sol).reshape(-1, len(n))
    windows = max(3, round(WINDOWS_PER_DECADE * np.log10(n[-1] / first)))
    edges = np.geomspace(first, n[-1] * (1 + 1e-9), windows + 1)
    index = np.searchsorted(edges, n, side="right") - 1
    filled = [k for k in range(windows) if (index == k).any()]
    if len(filled) < 3:
        raise ValueError(
            f"`sol` has outputs in {len(filled)} of {windows} windows between {first:g} and {n[-1]:g} steps: leave "
            "`t_eval` out, or give it more times."
        )
    steps = np.sqrt(edges[:-1] * edges[1:])[filled]
    rms = np.array([np.sqrt(np.mean(error[:, index == k] ** 2)) for k in filled])
    x, y = np.log(steps), np.log(np.maximum(rms, np.finfo(float).tiny))
    x = x - x.mean()
    exponent = float(x @ y / (x @ x))
    scatter = y - y.mean() - exponent * x
    exponent_error = float(np.sqrt(scatter @ scatter / max(1, len(x) - 2) / (x @ x)))
    slopes = error @ n / (n @ n)
    several = len(slopes) > 1
    drift_error = float(slopes.std(ddof=1) / np.sqrt(len(slopes))) if several else np.inf
    return EnergyGrowth(steps, rms, exponent, exponent_error, float(slopes.mean()), drift_error)
