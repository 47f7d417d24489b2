"""The kernel of a SympFlow made of exact flows of parts: the loops of its parts, run with the flow's maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sympflow.hamiltonian.parts import Map
from sympflow.integrators.exact_maps import kernel_of
from sympflow.kernels.parts import PartsKernel

if TYPE_CHECKING:
    from sympflow.flow.split import SplitFlow

__all__ = ["SplitFlowKernel"]


class SplitFlowKernel:
    """Compiled loops of a split flow on its system; states are [q, p], float64.

    Parameters
    ----------
    flow : SplitFlow
        Bound to a system that can be compiled, in float64 on the CPU.
    """

    saves_finite = True

    def __init__(self, flow: SplitFlow) -> None:
        self._frozen = flow.frozen()
        if not self._frozen.compilable:
            raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
        self.parts, self._dt = flow.parts, flow.dt
        self._kernel: PartsKernel = kernel_of(self.parts, PartsKernel)
        self._kernel.source()
        self.evaluations = self._frozen.evaluations

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> tuple[np.ndarray, int]:
        """`n_steps` times ψ̄_h, or for h < 0 the inverse of ψ̄_|h|: see `PartsKernel.run`."""
        return self._kernel.run(self._maps, h, y0, n_steps, save)

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d): see `PartsKernel.run_batch`."""
        if len(y0) == 1:
            Y, n_finite = self.run(h, y0[0], n_steps, save)
            return Y[None], np.array([n_finite])
        return self._kernel.run_batch(self._maps, h, y0, n_steps, save, threads=threads)

    def _maps(self, h: np.ndarray) -> Sequence[Map]:
        """The maps of one length, the same object while no weight changes, whose table the loops then know."""
        return self._frozen.maps(float(h))

    def step(self, h: ArrayLike, y: np.ndarray) -> np.ndarray:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,)."""
        h = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        out = np.array(y, dtype=np.float64)
        for back, rows in ((False, h > 0), (True, h < 0)):
            sequence, dt = self._frozen.coefficients(back), self._dt
            if rows.all():
                return self._kernel.step_by_coefficients(sequence, dt, np.abs(h), y)
            if rows.any():
                out[rows] = self._kernel.step_by_coefficients(sequence, dt, np.abs(h[rows]), y[rows])
        return out
