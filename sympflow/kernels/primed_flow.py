"""The kernel of a primed SympFlow: the splitting kernel of its system, run with the flow's tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sympflow.integrators.scheme import CURVATURE, Scheme
from sympflow.kernels.splitting import splitting_kernel, step_table
from sympflow.system import HamiltonianSystem

if TYPE_CHECKING:
    from sympflow.flow.primed import PrimedFlow

__all__ = ["PrimedFlowKernel"]


class PrimedFlowKernel:
    """Compiled loops of a primed flow on its system; states are [q, p], float64.

    A flow with a processor, ψ̄ = χ ∘ K ∘ χ⁻¹, starts a run by χ⁻¹, makes its steps by K, and applies χ to each output.

    Parameters
    ----------
    flow : PrimedFlow
        In float64 on the CPU, with the numbers that it has now.
    system : HamiltonianSystem
        The flow's, one that can be compiled.
    compensated : bool
        Whether runs sum with Kahan's compensation.
    """

    def __init__(self, flow: PrimedFlow, system: HamiltonianSystem, compensated: bool = False) -> None:
        tables = flow.tables
        if not tables.compilable:
            raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
        if tables.level == CURVATURE and system.symbols is None:
            raise ValueError(
                f"`system` {system.name!r} has no symbols, from which curvature terms are compiled: use "
                "backend='array'."
            )
        self._tables, self._splitting, self._compensated = tables, splitting_kernel(system), compensated
        self.evaluations = tables.evaluations
        self.saves_finite = not tables.processed  # what a processor makes of finite states may not be

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> tuple[np.ndarray, int]:
        """`n_steps` times ψ̄_h, or for h < 0 the inverse of ψ̄_|h|: see `SplittingKernel.run`."""
        start = self._prepared(abs(h), y0[None])[0]
        Y, n_finite = self._splitting.run(self._kernel(h), abs(h), start, n_steps, save, self._compensated)
        return self._finished(abs(h), y0[None], Y[None], save)[0], n_finite

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d): see `SplittingKernel.run_batch`."""
        if len(y0) == 1:
            Y, n_finite = self.run(h, y0[0], n_steps, save)
            return Y[None], np.array([n_finite])
        start = self._prepared(abs(h), y0)
        scheme = self._kernel(h)
        Y, finite = self._splitting.run_batch(scheme, abs(h), start, n_steps, save, self._compensated, threads)
        return self._finished(abs(h), y0, Y, save), finite

    def step(self, h: ArrayLike, y: np.ndarray) -> np.ndarray:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,); its numbers are polynomials in h."""
        h = np.asarray(h, dtype=np.float64)
        h = h.repeat(len(y)) if h.ndim == 0 else h
        if len(h) == 1 and h[0] != 0:
            back = bool(h[0] < 0)
            return self._stepped(-h if back else h, y, back)
        forwards = h > 0
        if forwards.all():
            return self._stepped(h, y, False)
        if (h < 0).all():
            return self._stepped(-h, y, True)
        out = np.array(y, dtype=np.float64)
        for rows, back in ((forwards, False), (h < 0, True)):
            if rows.any():
                out[rows] = self._stepped(np.abs(h[rows]), y[rows], back)
        return out

    def _stepped(self, t: np.ndarray, y: np.ndarray, back: bool) -> np.ndarray:
        tables = self._tables
        return self._splitting.step_rows(tables.polynomials(back), tables.level, tables.variable(t), t, y)

    def _kernel(self, h: float) -> Scheme:
        """K_h, or for h < 0 its inverse."""
        return self._tables.scheme("primed kernel", abs(h), back=h < 0)

    def _prepared(self, t: float, y: np.ndarray) -> np.ndarray:
        """χ_t⁻¹ of the rows of y."""
        if not self._tables.processed:
            return y
        return self._processed(t, y, True)

    def _finished(self, t: float, y0: np.ndarray, Y: np.ndarray, save: np.ndarray) -> np.ndarray:
        """χ_t of the outputs Y (N, n, 2d); what is saved before the first step are the initial states themselves."""
        if not self._tables.processed:
            return Y
        out = self._processed(t, Y.reshape(-1, Y.shape[-1]), False).reshape(Y.shape)
        if len(save) and save[0] == 0:
            out[:, : int(np.searchsorted(save, 0, "right"))] = y0[:, None]
        return out

    def _processed(self, t: float, y: np.ndarray, back: bool) -> np.ndarray:
        """χ_t of the rows of y, or its inverse."""
        tables = self._tables
        numbers = tables.kept(
            ("processor", t, back), lambda: step_table(tables.scheme("primed processor", t, back=back))
        )
        lengths = np.full(len(y), t)
        return self._splitting.step_rows(numbers, tables.level, lengths, lengths, y)
