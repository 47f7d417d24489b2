"""Smooth curves through noisy trajectories: states, their derivatives, and the noise; the first guess of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sympflow.learning.reading import Run

FEWEST = 6  # Points of a coordinate from which a curve is made; with fewer there are differences
WIDTHS = (5, 7, 9, 13, 19, 27, 39, 55)
"""Points of the windows in which a polynomial is fitted, for the value and the slope in their middle."""
WINDOW, DEGREE = 6, 3  # Points of a window from which the noise is estimated, and the degree of all polynomials


@dataclass(frozen=True)
class Smooth:
    """Curves of all trajectories."""

    states: tuple[np.ndarray, ...]  # (2d, n): The curve of each trajectory at its times, and its derivatives
    rates: tuple[np.ndarray, ...]  # (2d, n)
    points: np.ndarray  # (m, 2d): States and their derivatives where both are known well
    slopes: np.ndarray  # (m, 2d)
    times: np.ndarray  # (m,): Their times, and the places of their trajectories
    owner: np.ndarray  # (m,)
    sigma: np.ndarray  # (2d,): The noise of each coordinate, 0 if the trajectories are too short to tell it
    step: float  # The median time from one of all points to the next

    @cached_property
    def longest(self) -> float:
        """The longest time along one trajectory."""
        return max(float(np.ptp(self.times[self.owner == i])) for i in np.unique(self.owner))

    def some(self, most: int) -> Smooth:
        """The same with so many of the points at most, drawn at random."""
        if len(self.points) <= most:
            return self
        drawn = np.sort(np.random.default_rng(0).permutation(len(self.points))[:most])
        one = self.points[drawn], self.slopes[drawn], self.times[drawn], self.owner[drawn]
        return Smooth(self.states, self.rates, *one, self.sigma, self.step)


def smoothed(runs: Sequence[Run], velocities: bool) -> Smooth:
    """Local cubic polynomials through each coordinate, the width of their windows by leave-one-out cross-validation.

    Of trajectories with fewer than six points the derivatives are differences, at the mean of two states. Velocities
    that are missing are the derivatives of the positions.
    """
    given, runs = runs, [_with_velocities(run) for run in runs] if velocities else runs
    made = [_curve(run) for run in runs]
    middle = np.nanmean(np.concatenate([run.y for run in runs], axis=1), axis=1)
    states = tuple(np.where(np.isfinite(one[0]), one[0], middle[:, None]) for one in made)
    rates = tuple(
        np.where(np.isfinite(one[1]), one[1], np.gradient(y, run.t, axis=1))
        for one, y, run in zip(made, states, runs, strict=True)
    )
    points, slopes = np.concatenate([one[2].T for one in made]), np.concatenate([one[3].T for one in made])
    times = np.concatenate([one[4] for one in made])
    owner = np.repeat(np.arange(len(made)), [len(one[4]) for one in made])
    known = np.isfinite(points).all(1) & np.isfinite(slopes).all(1)
    noise = np.concatenate([_roughness(run) for run in given], axis=1)
    noise[np.isnan(noise).all(axis=1)] = 0.0
    # the median of means of two squared normal numbers is ln 2 of the mean
    sigma = np.zeros(len(noise)) if noise.shape[1] == 0 else np.sqrt(np.nanmedian(noise, axis=1) / np.log(2))
    step = float(np.median(np.concatenate([np.diff(run.t) for run in runs])))
    return Smooth(states, rates, points[known], slopes[known], times[known], owner[known], sigma, step)


def _with_velocities(run: Run) -> Run:
    """The trajectory with derivatives of the positions where velocities were not observed at all."""
    d = len(run.y) // 2
    missing = np.isnan(run.y[d:]).all(axis=1)
    if not missing.any():
        return run
    y = run.y.copy()
    states, rates, *_ = _curve(Run(run.t, run.y[:d][missing]))
    y[d:][missing] = np.where(np.isfinite(rates), rates, np.gradient(states, run.t, axis=1))
    return Run(run.t, y)


def _curve(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The states of a trajectory, smooth, and slopes; points and slopes there or between, and their times."""
    seen = np.isfinite(run.y)
    if seen.sum(1).min() < FEWEST:
        states = np.full(run.y.shape, np.nan)
        for i, (y, has) in enumerate(zip(run.y, seen, strict=True)):
            if has.any():
                states[i] = np.interp(run.t, run.t[has], y[has])
        whole = seen.all(0)
        t = run.t[whole]
        y = run.y[:, whole]
        none = np.full(run.y.shape, np.nan)
        return states, none, (y[:, 1:] + y[:, :-1]) / 2, np.diff(y) / np.diff(t), (t[1:] + t[:-1]) / 2
    best = np.full(len(run.y), np.inf)
    states, slopes = np.zeros(run.y.shape), np.zeros(run.y.shape)
    for width in [w for w in WIDTHS if w <= run.n_points] or [run.n_points]:
        values, rates, error = _windows(run.t, run.y, seen, width)
        better = error < best
        best = np.where(better, error, best)
        states[better], slopes[better] = values[better], rates[better]
    for i, has in enumerate(seen):
        slopes[i, (run.t < run.t[has][0]) | (run.t > run.t[has][-1])] = np.nan
    return states, slopes, states[:, 1:-1], slopes[:, 1:-1], run.t[1:-1]


def _windows(t: np.ndarray, y: np.ndarray, seen: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values and slopes (2d, n) by the polynomial through the nearest points, and the mean square left out (2d,)."""
    n = len(t)
    first = np.clip(np.arange(n) - width // 2, 0, n - width)
    window = first[:, None] + np.arange(width)
    half = np.abs(t[window] - t[:, None]).max(1)
    V = ((t[window] - t[:, None]) / half[:, None])[..., None] ** np.arange(DEGREE + 1)
    has = (seen[:1] if (seen == seen[0]).all() else seen)[:, window]  # what is missing is mostly missing of all
    known = np.where(seen[:, window], y[:, window], 0.0)
    G = np.swapaxes(V * has[..., None], -1, -2) @ V + 1e-10 * np.eye(DEGREE + 1)
    right = np.moveaxis(np.swapaxes(V, 1, 2) @ np.moveaxis(known, 0, -1), -1, 0)
    inverse = np.linalg.inv(G)
    c = (inverse @ right[..., None])[..., 0]
    share = np.minimum(inverse[:, :, 0, 0], 1 - 1e-6)
    left_out = np.where(seen, (c[..., 0] - np.where(seen, y, 0.0)) / (1 - share), 0.0)
    return c[..., 0], c[..., 1] / half, (left_out**2).sum(1)


def _roughness(run: Run) -> np.ndarray:
    """Mean squares of what cubic polynomials leave of six successive points: (2d, m)."""
    if run.n_points < WINDOW:
        return np.empty((len(run.y), 0))
    left = []
    for start in range(0, run.n_points - WINDOW + 1, WINDOW // 2):
        t = run.t[start : start + WINDOW]
        basis = np.linalg.qr(np.vander((t - t[0]) / (t[-1] - t[0]), DEGREE + 1))[0]
        y = run.y[:, start : start + WINDOW]
        rest = y - (y @ basis) @ basis.T
        left.append((rest**2).sum(1) / (WINDOW - DEGREE - 1))
    return np.array(left).T
