"""Dense output on a grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sympflow.arrays import Array, is_tensor
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.grid import Grid

if TYPE_CHECKING:
    from sympflow.integrators.base import FixedStep

__all__ = ["GridSolution"]


class GridSolution:
    """Dense output of a fixed-step method: a shorter step from the last grid point before t.

    Call it with a time or an array of times (n,); the result has shape (..., 2d) or (..., 2d, n).
    """

    def __init__(
        self, integrator: FixedStep, system: HamiltonianSystem, grid: Grid, states: Array, backend: str
    ) -> None:
        self.integrator, self.system, self.grid = integrator, system, grid
        self.states, self.backend = states, backend
        self.t_min, self.t_max = sorted((grid.t0, grid.t1))

    def __call__(self, t: float | np.ndarray) -> Array:
        times = np.atleast_1d(np.asarray(t, dtype=float))
        count, remainder = self.grid.locate(times)
        y = self.states[count]
        extra = np.flatnonzero(remainder)
        if extra.size:
            y = self.integrator.shorter_steps(self.system, y, extra, remainder[extra], self.backend)
        y = y.movedim(0, -1) if is_tensor(y) else np.moveaxis(y, 0, -1)
        return y[..., 0] if np.ndim(t) == 0 else y
