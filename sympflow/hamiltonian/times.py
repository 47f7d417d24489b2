"""Times at which functions of a driven system are evaluated: numbers, or arrays of one time a state."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from sympflow.arrays import Array, as_array, beside, of_library, to_numpy


def stage_time(t: Any, c: float, h: Any) -> Any:
    """t + c·h in double precision, of t and h a number or (...): states may be of less, times never are."""
    return t + c * h if isinstance(h, float) else beside(t, h) + c * beside(h, h)


def checked_time(t: Any, x: Array, batch: tuple[int, ...]) -> Any:
    """Return a time as a float, or as doubles of the library of x with the shape of the batch; checked."""
    if isinstance(t, float):
        return t
    given = as_array(t)
    if not re.match(r"(torch\.)?(u?int|b?float)", str(given.dtype)):
        raise TypeError(f"`t` must be a real number, or an array of them; got {t!r}.")
    if given.ndim and tuple(given.shape) != tuple(batch):
        raise ValueError(
            f"`t` must be a number, or have the shape {tuple(batch)} of the batch, one time a state; got "
            f"{tuple(given.shape)}."
        )
    return beside(of_library(given, x), x)


PROBED = np.array([0.0, 0.1327, 0.3819, 0.7211])
"""Parts of a length of time at which functions of the time are probed: at the beginning, and none a simple fraction."""
PERIOD_TOLERANCE = 1e-8  # share of the largest change of H in time at a state by which it may differ a period later
PERIODS, LATEST = 24, 1000.0  # times at which a period is tested: in the first one, and later up to so many periods


def probe_times(t0: float, t1: float) -> np.ndarray:
    """Times (n,) within an interval, the first its beginning."""
    return t0 + PROBED * (t1 - t0)


def check_period(H: Callable[[np.ndarray, float], Any], ndof: int, y0: np.ndarray | None, period: float) -> None:
    """Test H(y, t), up to a function of t alone, at states of all sizes, at times and a period later."""
    rng = np.random.Generator(np.random.PCG64(20260104))
    states = rng.uniform(-1, 1, (1, 5, 2 * ndof)) * 10.0 ** np.arange(-3, 4)[:, None, None]
    states = states.reshape(-1, 2 * ndof)
    if y0 is not None:
        states = np.concatenate([y0[None], y0 * (1 + 0.1 * states[15:20]), states])
    first = rng.uniform(0, 1, PERIODS)
    times = period * np.concatenate([first, first * LATEST ** rng.uniform(0, 1, PERIODS)])
    with np.errstate(all="ignore"):
        before, after = (
            np.stack([to_numpy(H(states, float(t))).astype(float) for t in moments])
            for moments in (times, times + period)
        )
        size = np.maximum(np.abs(before), np.abs(after)).max(0)
        size = np.maximum(size, size[0])
        before, after = before - before[:, :1], after - after[:, :1]
        width = np.maximum(before.max(0) - before.min(0), after.max(0) - after.min(0))
        rounding = 64 * np.finfo(float).eps * (1 + np.abs(times[:, None]) / period) * width
        allowed = PERIOD_TOLERANCE * width + 16 * np.finfo(float).eps * size + rounding
        change = np.where(np.isfinite(allowed), np.abs(after - before) - allowed, 0.0)
    if (change > 0).any():
        i, j = np.unravel_index(change.argmax(), change.shape)
        raise ValueError(
            f"`period` {period!r} is not a period of H, which differs by {abs(after - before)[i, j]:.3g} a period "
            f"after t = {times[i]:.6g} at a state: give the period of the drive, such as 2*pi/w."
        )
