"""Times at which functions of a driven system are evaluated: numbers, or arrays of one time a state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sympflow.arrays import Array, is_tensor, to_numpy


def stage_time(t: Any, c: float, h: Any) -> Any:
    """t + c·h in double precision, of t and h a number or (...): states may be of less, times never are."""
    if is_tensor(h):
        import torch

        h = h.double()
        t = torch.tensor(t, dtype=torch.float64, device=h.device) if isinstance(t, np.ndarray) else t
    elif isinstance(h, np.ndarray):
        h = h.astype(float, copy=False)
    return t + c * h


def checked_time(t: Any, x: Array, batch: tuple[int, ...]) -> Any:
    """Return a time as a float, or as an array of doubles of the library of x, a number or of the shape of the batch.

    Raises
    ------
    TypeError, ValueError
        If it is no real number, nor an array of them that fits the states.
    """
    if isinstance(t, float):
        return t
    if is_tensor(t) or (is_tensor(x) and np.ndim(t)):
        return _checked_tensor(t, x, batch)
    try:
        given = np.asarray(t)
        if given.dtype.kind not in "iuf":
            raise TypeError
    except (TypeError, ValueError):
        raise TypeError(f"`t` must be a real number, or an array of them; got {t!r}.") from None
    _check_shape(given, batch)
    return given.astype(float, copy=False) if given.ndim else float(given)


def _checked_tensor(t: Any, x: Array, batch: tuple[int, ...]) -> Any:
    import torch

    given = torch.as_tensor(t)
    if given.is_complex():
        raise TypeError(f"`t` must be a real number; got {given.dtype}.")
    _check_shape(given, batch)
    if is_tensor(x):
        return given.to(dtype=torch.float64, device=x.device)
    return to_numpy(given).astype(float)[()]


def _check_shape(t: Any, batch: tuple[int, ...]) -> None:
    if t.ndim and tuple(t.shape) != tuple(batch):
        raise ValueError(
            f"`t` must be a number, or have the shape {tuple(batch)} of the batch, one time a state; got "
            f"{tuple(t.shape)}."
        )


PROBED = np.array([0.0, 0.1327, 0.3819, 0.7211])
"""Parts of a length of time at which functions of the time are probed: at the beginning, and none a simple fraction."""
PERIOD_TOLERANCE = 1e-8
"""Share of the largest change of H among probes by which it may differ a period later."""


def probe_times(t0: float, t1: float) -> np.ndarray:
    """Times (n,) within an interval, the first its beginning."""
    return t0 + PROBED * (t1 - t0)


def check_period(H: Callable[[np.ndarray, float], Any], ndof: int, y0: np.ndarray | None, period: float) -> None:
    """Test H(y, t), up to a function of t alone, at states near y0 or the origin, at times and a period later.

    Raises
    ------
    ValueError
        If it differs: the period is not one of H.
    """
    rng = np.random.Generator(np.random.PCG64(20260104))
    states = rng.uniform(-1, 1, (5, 2 * ndof))
    if y0 is not None:
        states = np.concatenate([y0[None], y0 * (1 + 0.1 * states)])
    with np.errstate(all="ignore"):
        before, after = (
            np.stack([to_numpy(H(states, float(t))).astype(float) for t in times])
            for times in (PROBED * period, PROBED * period + period)
        )
        before, after = before - before[:, :1], after - after[:, :1]
        change = np.abs(after - before)
    change = change[np.isfinite(change)]
    size = np.abs(before[np.isfinite(before)]).max(initial=0.0)
    if change.max(initial=0.0) > PERIOD_TOLERANCE * size:
        raise ValueError(
            f"`period` {period!r} is none of H, which differs by {change.max():.3g} a period later at states near "
            f"{'y0' if y0 is not None else 'the origin'}: give the period of the drive, such as 2*pi/w."
        )
