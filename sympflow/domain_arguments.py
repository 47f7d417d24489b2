"""Arguments of domains: numbers, vectors, states and counts of them, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import to_numpy

_MOST_SAMPLES = 100_000_000


def floats(name: str, value: Any) -> np.ndarray:
    """`value` as an array of floats, if it is one of real numbers."""
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"`{name}` must be made of real numbers; got {value!r}.")
    return array.astype(float)


def check_number(name: str, value: Any) -> None:
    """A TypeError unless `value` is a real number."""
    if not isinstance(value, int | float | np.number) or isinstance(value, bool) or np.iscomplexobj(value):
        raise TypeError(f"`{name}` must be a number; got {value!r}.")


def vector(name: str, value: ArrayLike) -> tuple[float, ...]:
    """`value` as the finite numbers of a state [q, p], (2d,)."""
    array = floats(name, value)
    if array.ndim != 1 or array.size == 0 or array.size % 2:
        raise ValueError(f"`{name}` must have shape (2d,), one entry for each of [q, p]; got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite; got {array.tolist()}.")
    return tuple(array.tolist())


def checked_states(x: ArrayLike, width: int) -> np.ndarray:
    """`x`, checked to be numbers of shape (..., width)."""
    try:
        array = to_numpy(x)
    except ValueError:  # rows of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"`x` must be states of real numbers; got {x!r}: pass an array of shape (..., {width}).")
    if array.ndim == 0 or array.shape[-1] != width:
        raise ValueError(
            f"`x` must have shape (..., {width}), states [q, p] of the domain; got {array.shape}: "
            "put them on the last axis."
        )
    return array


def sample_count(n: int) -> int:
    """`n` as an integer, at least one and not more than memory holds."""
    number = isinstance(n, int | float | np.number) and np.isfinite(n)
    if not number or n < 1 or int(n) != n:
        raise ValueError(f"`n` must be a positive integer; got {n!r}.")
    if n > _MOST_SAMPLES:
        raise ValueError(f"`n` must be at most {_MOST_SAMPLES:.0e}; got {n:.3g}: draw in parts, with several seeds.")
    return int(n)
