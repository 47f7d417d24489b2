"""Energy: its error over time, the largest, its drift with an honest uncertainty, and its growth by round-off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.solution import Solution, check_solution, energy_change, gathered

MIN_BLOCKS = 20
WINDOWS_PER_DECADE = 3

P = ParamSpec("P")


def of_groups(metric: Callable[Concatenate[Solution, P], Any]) -> Callable[Concatenate[Solution, P], Any]:
    """Make a metric check its solution, and measure each group of trajectories that have the same parameters."""

    @wraps(metric)
    def measured(sol: Solution, *args: P.args, **options: P.kwargs) -> Any:
        check_solution(sol)
        if sol.varied:
            return gathered(sol, lambda part: metric(part, *args, **options))
        return metric(sol, *args, **options)

    return measured


def energy_error(sol: Solution, relative: bool = True) -> np.ndarray:
    """H(y(t)) − H(y0), relative to `energy_scale(sol)`, at the times `sol.t`: (..., n), in float64, signed.

    The largest magnitude over the run is `max_energy_error(sol)`.

    Where the state is finite but H overflows, the error is inf. It is NaN where the state is: after the end of a
    trajectory in a batch.

    Parameters
    ----------
    sol : Solution
    relative : bool
        True to divide by the scale.

    Warns
    -----
    RuntimeWarning
        If the scale of a trajectory is 0 (see `energy_scale`), so that its error is absolute.

    Raises
    ------
    TypeError
        If `sol` is not a Solution.
    """
    check_solution(sol)
    return energy_change(sol, relative)


def energy_scale(sol: Solution) -> np.ndarray:
    """Return the scale of the energy errors of each trajectory, (...): `system.energy_scale`, else |H(y0)|.

    Where H(y0) is about 0, as on a parabola or a separatrix, it is a thousandth of the size of the terms of H, the
    largest ½ Σ|y_i ∂H/∂y_i| along the orbit. It is NaN where these are 0 too: there `energy_error` is absolute, and
    warns.
    """
    check_solution(sol)
    return sol.energy_scale()


def max_energy_error(sol: Solution, relative: bool = True) -> np.floating | np.ndarray:
    """max over `sol.t` of |energy_error|, (...).

    It is inf for a trajectory that became non-finite or could not be continued, even if few of its outputs were stored:
    a blow-up never looks small.
    """
    return largest(np.abs(energy_error(sol, relative)), sol)[()]


def largest(series: np.ndarray, sol: Solution) -> np.ndarray:
    """Maxima over time of a non-negative series, inf for trajectories that failed."""
    return np.where(failed(sol), np.inf, np.where(np.isnan(series), np.inf, series).max(axis=-1, initial=0.0))


def failed(sol: Solution) -> np.ndarray:
    """Tell which trajectories did not reach their end, (...); stopping at the edge of the domain is not a failure."""
    stopped_on_request = "domain_exit" in sol.stats and bool(np.isfinite(to_numpy(sol.y)).all())
    return (np.asarray(sol.status) < 0) & (not stopped_on_request)


@dataclass(frozen=True)
class EnergyDrift:
    """The linear trend of the energy error.

    Attributes
    ----------
    slope : float or ndarray (...)
        Change of the energy error per unit of time; inf for a trajectory that became non-finite or could not be
        continued.
    standard_error : float or ndarray (...)
        Of the slope, from the scatter of the block means about the line; inf where the slope is.
    t, means : ndarray (blocks,), (..., blocks)
        The block means of time and energy error that the line was fitted to.
    """

    slope: np.ndarray
    standard_error: np.ndarray
    t: np.ndarray = field(repr=False)
    means: np.ndarray = field(repr=False)


def energy_drift(sol: Solution, blocks: int = MIN_BLOCKS, relative: bool = True) -> EnergyDrift:
    """Slope of the energy error per unit of time, with its standard error, from means over blocks of the outputs.

    Neighbouring samples of an energy error are correlated, so a least-squares line through them always looks
    significant. Means over blocks much longer than the correlation time are nearly independent [1]_: the line is fitted
    to them and its uncertainty comes from their scatter.

    Parameters
    ----------
    sol : Solution
        With outputs at regular times, at least one for each block; ten are better.
    blocks : int
        Number of blocks, at least 20.

    Raises
    ------
    TypeError
        If `sol` is not a Solution, or `blocks` no integer.
    ValueError
        For fewer than 20 blocks, or fewer outputs than blocks.

    References
    ----------
    .. [1] C. J. Geyer, "Practical Markov chain Monte Carlo", Statist. Sci. 7 (1992) 473–483 (batch means).
    """
    check_solution(sol)
    if isinstance(blocks, bool) or not isinstance(blocks, int | np.integer):
        raise TypeError(f"`blocks` must be an integer; got {blocks!r}. Use {MIN_BLOCKS} or more.")
    if blocks < MIN_BLOCKS:
        raise ValueError(f"`blocks` must be at least {MIN_BLOCKS} for a meaningful standard error; got {blocks}.")
    n, lost = len(sol.t), failed(sol)
    if n < blocks and not lost.all():
        raise ValueError(
            f"`sol` has {n} outputs, fewer than the {blocks} blocks of the fit: ask for more with `t_eval`."
        )
    batch = sol.y.shape[:-2]
    if n < blocks:
        infinite = np.full(batch, np.inf)[()]
        return EnergyDrift(infinite, infinite, np.full(blocks, np.nan), np.full((*batch, blocks), np.nan))
    edges = np.linspace(0, n, blocks + 1).astype(int)
    count = np.diff(edges)
    t = np.add.reduceat(sol.t, edges[:-1]) / count
    with np.errstate(all="ignore"):
        means = np.add.reduceat(energy_error(sol, relative), edges[:-1], axis=-1) / count
        centred = t - t.mean()
        slope = (means @ centred) / (centred @ centred)
        residual = means - means.mean(-1, keepdims=True) - slope[..., None] * centred
        error = np.sqrt((residual**2).sum(-1) / (blocks - 2) / (centred @ centred))
    lost = lost | ~np.isfinite(slope) | ~np.isfinite(error)
    return EnergyDrift(np.where(lost, np.inf, slope)[()], np.where(lost, np.inf, error)[()], t, means)


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
        between them; the error is inf for a single trajectory, whose random walk cannot be distinguished from a drift.
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
        Of a fixed-step method, preferably a batch of at least eight trajectories, with regular outputs (`save_every`).
    first : float
        Number of the first step whose output is used.

    Raises
    ------
    TypeError
        If `sol` is not a Solution.
    ValueError
        If it has no fixed step, has failed, or is shorter than a decade beyond `first`.

    Notes
    -----
    The slope through the origin, Σ eₖtₖ/Σ tₖ², is fitted to each trajectory.

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
    drift_error = float(slopes.std(ddof=1) / np.sqrt(len(slopes))) if len(slopes) > 1 else np.inf
    return EnergyGrowth(steps, rms, exponent, exponent_error, float(slopes.mean()), drift_error)
