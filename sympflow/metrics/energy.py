"""Energy: its error over time, the largest, and its drift with an honest uncertainty."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.metrics.arguments import check_solution
from sympflow.solution import Solution

SMALLEST_SCALE = 1e-12
"""|H(y0)| below which an energy error is absolute, unless the system declares its `energy_scale`."""

MIN_BLOCKS = 20


def energy_error(sol: Solution, relative: bool = True) -> np.ndarray:
    """H(y(t)) − H(y0), relative to `energy_scale(sol)`, at the times `sol.t`: (..., n), in float64, signed.

    Where the state is finite and H of it is beyond floats, so that inf − inf would be NaN, the error is inf. NaN is
    left where the state is: after the end of a trajectory in a batch.

    Parameters
    ----------
    sol : Solution
    relative : bool
        Whether to divide by the scale.

    Warns
    -----
    RuntimeWarning
        If the scale is missing (see `energy_scale`), so that the error of some trajectory is absolute.

    Raises
    ------
    TypeError
        If `sol` is not a Solution.
    """
    check_solution(sol)
    with np.errstate(all="ignore"):
        states = to_numpy(sol.states)
        error = _energy(sol, states) - _energy(sol, sol.y0)[..., None]
        if np.isnan(error).any():
            error = np.where(np.isnan(error) & np.isfinite(states).all(-1), np.inf, error)
        if not relative:
            return error
        scale = energy_scale(sol)
        if (absolute := np.isnan(scale)).any():
            warnings.warn(
                f"The energy error is absolute where |H(y0)| < {SMALLEST_SCALE:g}: give the system an `energy_scale`.",
                RuntimeWarning,
                stacklevel=2,
            )
        compared = error / np.where(absolute, 1.0, scale)[..., None]
        return np.where(np.isinf(error), error, compared)  # H(y0) may be infinite itself: inf/inf


def energy_scale(sol: Solution) -> np.ndarray:
    """What the energy errors of each trajectory are relative to, (...): `system.energy_scale`, else |H(y0)|.

    It is NaN where |H(y0)| < 1e-12: there `energy_error` is absolute, and warns.
    """
    check_solution(sol)
    declared = sol.system.energy_scale
    H0 = np.abs(_energy(sol, sol.y0))
    if declared is not None:
        return np.full_like(H0, declared)
    return np.where(H0 < SMALLEST_SCALE, np.nan, H0)


def max_energy_error(sol: Solution, relative: bool = True) -> np.floating | np.ndarray:
    """max over `sol.t` of |energy_error|, (...).

    It is inf for a trajectory that became non-finite or could not be continued, however few of its outputs were stored
    before: a blow-up never looks small.
    """
    error = np.abs(energy_error(sol, relative))
    worst = np.where(np.isnan(error), np.inf, error).max(axis=-1, initial=0.0)
    return np.where(failed(sol), np.inf, worst)[()]


def failed(sol: Solution) -> np.ndarray:
    """Which trajectories did not reach their end, (...); stopping at the edge of the domain is no failure."""
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
        With outputs at regular times, at least one for each block; better ten.
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
        raise ValueError(
            f"`blocks` must be at least {MIN_BLOCKS} for a standard error that means something; got {blocks}."
        )
    n = len(sol.t)
    lost = failed(sol)
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


def _energy(sol: Solution, y: object) -> np.ndarray:
    """H in float64, whatever the precision of the run."""
    with np.errstate(all="ignore"):
        return np.asarray(sol.system.hamiltonian(to_numpy(y).astype(float)))
