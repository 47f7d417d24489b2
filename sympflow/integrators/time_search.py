"""The length of a step, equal to others in another time, that ends at a given physical time."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np


@lru_cache(maxsize=256)
def physical_length(h: float, scale: float, clock: tuple[float, ...]) -> float:
    """The physical length of a step h in the new time where the kinetic energy is B = scale/2: h/scale.

    To it a trained clock adds Σ_k c_k h^(3+2k) B^k, of the numbers c_k, the last one first.
    """
    square, total = h * h * scale / 2, 0.0
    for c in clock:
        total = total * square + c
    return h / scale + h * h * h * total


@lru_cache(maxsize=256)
def step_of_length(length: float, scale: float, clock: tuple[float, ...]) -> float:
    """The step h of that `physical_length`, if it is at most the one for which the clock was trained."""
    h = length * scale
    for _ in range(100 if clock else 0):  # a contraction, for the clock adds little
        before, h = h, h - scale * (physical_length.__wrapped__(h, scale, clock) - length)
        if abs(h - before) <= 1e-15 * h:
            break
    return h


def reach(
    step: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    longest: np.ndarray,
    target: np.ndarray,
    guess: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The states step(σ), σ from 0 to `longest`, whose time is `target`, and σ: the secant method within brackets."""
    d = start.shape[1] // 2 - 1
    eps = float(np.finfo(start.dtype).eps)
    tolerance = 2 * eps * np.maximum(np.abs(target), np.abs(start[:, d]))
    low, high = np.zeros_like(longest), longest.copy()
    sign = np.sign(longest)
    sigma = np.where((guess - low) * sign < 0, low, np.where((guess - high) * sign > 0, high, guess))
    best, best_sigma, best_residual = start.copy(), np.zeros_like(sigma), np.abs(start[:, d] - target)
    last_sigma, last_t = np.zeros_like(sigma), start[:, d].copy()
    for _ in range(80):
        x = step(sigma)
        residual = x[:, d] - target
        better = np.abs(residual) < best_residual
        best[better], best_sigma[better], best_residual[better] = x[better], sigma[better], np.abs(residual)[better]
        if not (best_residual > tolerance).any():
            break
        beyond = ~(residual * sign < 0)  # NaN counts as too far
        high, low = np.where(beyond, sigma, high), np.where(beyond, low, sigma)
        slope = (x[:, d] - last_t) / (sigma - last_sigma)  # the first time of the chord of the step so far
        rate = np.where(np.isfinite(slope) & (slope > 0), slope, np.inf)
        secant = sigma - residual / rate
        inside = ((secant - low) * sign > 0) & ((high - secant) * sign > 0)
        last_sigma, last_t = sigma, x[:, d].copy()
        sigma = np.where(inside & np.isfinite(secant), secant, (low + high) / 2)
    best[best_residual > np.maximum(1e-3 * np.abs(target - start[:, d]), 100 * tolerance)] = np.nan  # no such σ
    return best, best_sigma
