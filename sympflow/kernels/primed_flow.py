"""The kernel of a primed SympFlow: the splitting kernel of its system, run with the flow's table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sympflow.integrators.schemes import Scheme
from sympflow.kernels.splitting import splitting_kernel
from sympflow.system import HamiltonianSystem

if TYPE_CHECKING:
    from sympflow.flow.primed import PrimedFlow

__all__ = ["PrimedFlowKernel"]


class PrimedFlowKernel:
    """Compiled loops of a primed flow on its system; states are [q, p], float64.

    Parameters
    ----------
    flow : PrimedFlow
        In float64 on the CPU.
    system : HamiltonianSystem
        The flow's, one that can be compiled.
    """

    def __init__(self, flow: PrimedFlow, system: HamiltonianSystem) -> None:
        if str(flow.dtype) != "torch.float64" or flow.device.type != "cpu":
            raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
        self.flow, self._splitting = flow, splitting_kernel(system)

    def _table(self, h: float) -> Scheme:
        """ψ̄_h as a scheme of step |h|, and for h < 0 the inverse of ψ̄_|h|."""
        scheme = self.flow.scheme(abs(h))
        return scheme if h > 0 else scheme.inverse()

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> tuple[np.ndarray, int]:
        """`n_steps` times ψ̄_h, or for h < 0 the inverse of ψ̄_|h|: see `SplittingKernel.run`."""
        return self._splitting.run(self._table(h), abs(h), y0, n_steps, save)

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d): see `SplittingKernel.run_batch`."""
        if len(y0) == 1:
            Y, n_finite = self.run(h, y0[0], n_steps, save)
            return Y[None], np.array([n_finite])
        return self._splitting.run_batch(self._table(h), abs(h), y0, n_steps, save, threads=threads)

    def step(self, h: ArrayLike, y: np.ndarray) -> np.ndarray:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,): every distinct h is a table of its own."""
        h = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        out = np.array(y, dtype=np.float64)
        for value in np.unique(h[h != 0]):
            rows = h == value
            out[rows] = self._splitting.step(self._table(value), abs(value), y[rows])
        return out
