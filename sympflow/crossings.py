"""Where a trajectory crosses a plane of phase space: the points of a Poincaré section."""

from __future__ import annotations

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.solution import Solution


def section_crossings(sol: Solution, coordinate: int = 0, level: float = 0.0) -> np.ndarray:
    """The states (m, 2d) at which y[coordinate] passes `level` upwards.

    Parameters
    ----------
    sol : Solution
        Of one trajectory or a batch, with outputs so close that no crossing falls between two of them unseen.
    coordinate : int
        Index into [q, p].
    level : float

    Notes
    -----
    Between two outputs a time h apart the trajectory is the cubic Hermite interpolant with the system's vector field at
    both ends, in error by O(h⁴); its crossing is found by bisection.
    """
    y = np.moveaxis(to_numpy(sol.y).astype(float), -1, 0)  # (n, ..., 2d)
    with np.errstate(invalid="ignore"):
        upwards = (y[:-1, ..., coordinate] < level) & (y[1:, ..., coordinate] >= level)
    a, b = y[:-1][upwards], y[1:][upwards]
    h = np.broadcast_to(np.diff(sol.t).reshape(-1, *[1] * (y.ndim - 2)), upwards.shape)[upwards][:, None]
    va, vb = h * sol.system.vector_field(a), h * sol.system.vector_field(b)

    def state(x: np.ndarray) -> np.ndarray:
        s = x[:, None]
        return (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * va + s**2 * (3 - 2 * s) * b - s**2 * (1 - s) * vb

    low, high = np.zeros(len(a)), np.ones(len(a))
    for _ in range(50):
        middle = (low + high) / 2
        below = state(middle)[:, coordinate] < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return state((low + high) / 2)
