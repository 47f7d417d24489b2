"""The kernel of a flow with a trained clock: the loops of its scheme, and the time that the clock adds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.splitting import splitting_kernel
from sympflow.kernels.timed import reach_times

if TYPE_CHECKING:
    from sympflow.flow.clocked import ClockedFlow

__all__ = ["ClockedFlowKernel"]


class ClockedFlowKernel:
    """Compiled loops of a `ClockedFlow`; states are [q, t, p, B], float64.

    B is constant and nothing depends on t, so n steps of the clock are n times one, added where a state is kept.

    Parameters
    ----------
    flow : ClockedFlow
        In float64 on the CPU.
    system : HamiltonianSystem
        The transformed one, one that can be compiled.
    """

    def __init__(self, flow: ClockedFlow, system: HamiltonianSystem) -> None:
        if str(flow.dtype) != "torch.float64" or flow.device.type != "cpu":
            raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
        self.system = system
        self.flow, self._splitting, self._scheme = flow, splitting_kernel(system), flow.scheme

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> tuple[np.ndarray, int]:
        """`n_steps` times ψ̄_h, or for h < 0 the inverse of ψ̄_|h|: see `SplittingKernel.run`."""
        Y, n_finite = self._splitting.run(self._scheme, h, y0, n_steps, save)
        Y[:, self.flow.ndof - 1] += np.asarray(save) * self.flow.advance(float(h), float(y0[-1]))
        return Y, n_finite

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d): see `SplittingKernel.run_batch`."""
        Y, n_finite = self._splitting.run_batch(self._scheme, h, y0, n_steps, save, threads=threads)
        Y[:, :, self.flow.ndof - 1] += np.asarray(save) * self.flow.advance(h, y0[:, -1])[:, None]
        return Y, n_finite

    def step(self, h: ArrayLike, y: np.ndarray) -> np.ndarray:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,)."""
        out = self._splitting.step(self._scheme, h, y)
        if len(out) == 1:  # as plain numbers, ten times faster
            out[0, self.flow.ndof - 1] += self.flow.advance(float(np.ravel(h)[0]), float(y[0, -1]))
        else:
            out[:, self.flow.ndof - 1] += self.flow.advance(np.asarray(h, dtype=np.float64), y[:, -1])
        return out

    def reach_times(
        self,
        h: float,
        y0: np.ndarray,
        times: np.ndarray,
        stride: int,
        expected: float,
        numbers: tuple[float, ...] | None = None,
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The states of rows of `y0` (N, 2d) at elapsed times: see `timed.reach_times`.

        `numbers` are those of the clock, if they have been asked for.
        """
        numbers = self.flow.numbers() if numbers is None else numbers
        return reach_times(self.system, self._scheme, h, y0, times, stride, expected, numbers)
