"""Compiled passes over the outputs of a run: of a thousand states each takes a microsecond or two."""

from __future__ import annotations

from functools import cache
from types import ModuleType

import numpy as np

from sympflow.kernels.modules import OPTIONS, load_module, template

__all__ = ["all_between", "all_finite", "place", "row_products"]


@cache
def _loops() -> ModuleType:
    options = {name: value for name, value in OPTIONS.items() if name != "fastmath"} | {"cache": True}
    return load_module(f"OPTIONS = {options}\n\n\n{template('passes')}")


def place(t: np.ndarray, t0: float, h: float, rounding: float) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Remainders (n,) of ordered times, as `Grid.locate`, their distinct counts, and where among these each time is.

    The last is None where all counts are distinct.
    """
    n = len(t)
    count, position, remainder = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty(n)
    distinct = _loops().place(t, t0, h, rounding, count, remainder, position)
    return remainder, count[:distinct], position if distinct < n else None


def row_products(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A x of all vectors x (..., n), of which none depends on how many there are, as the products of a library do."""
    rows = np.ascontiguousarray(x, dtype=np.float64).reshape(-1, x.shape[-1])
    out = np.empty_like(rows)
    _loops().row_products(np.ascontiguousarray(A), rows, out)
    return out.reshape(x.shape)


def all_finite(y: np.ndarray) -> bool:
    """True if all of an array of float64, contiguous in either order, is finite."""
    return _loops().all_finite((y if y.flags.c_contiguous else y.T).reshape(-1))


def all_between(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """True if all of x (w, N), contiguous, lies between `low` and `high` (w,)."""
    return _loops().all_between(x, low, high)
