"""The kernel of a primed SympFlow: the splitting kernel of its system, run with the flow's tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.modules import run_one, run_rows
from sympflow.kernels.splitting import splitting_kernel
from sympflow.kernels.tables import scaled_run_table, scaled_step_table
from sympflow.schemes import CURVATURE, Scheme

if TYPE_CHECKING:
    from sympflow.flow.frozen import Tables
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

    saves_finite = True

    def __init__(self, flow: PrimedFlow, system: HamiltonianSystem, compensated: bool = False) -> None:
        tables = flow.tables
        if not tables.compilable:
            raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
        if tables.level >= CURVATURE and system.symbols is None:
            raise ValueError(
                f"`system` {system.name!r} has no symbols, from which curvature terms and polynomials are compiled: "
                "use backend='array'."
            )
        self.system = system
        self._tables, self._splitting, self._compensated = tables, splitting_kernel(system), compensated
        self.evaluations = tables.evaluations

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> tuple[np.ndarray, int]:
        """`n_steps` times ψ̄_h, or for h < 0 the inverse of ψ̄_|h|: see `SplittingKernel.run`."""
        if not self._tables.processed:
            return self._splitting.run(self._kernel(h), abs(h), y0, n_steps, save, self._compensated)
        numbers = self._numbers(h)
        rollout = self._loops().rollout_processed
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        out = np.empty((len(save), len(y0)))
        work = numbers.work(n_steps, len(save)) * len(y0) // 2
        n_finite = run_one(lambda stop: rollout(*numbers.arrays, y0, n_steps, save, out, stop), work)
        return out, n_finite

    def run_batch(
        self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`run` for every row of `y0` (N, 2d): see `SplittingKernel.run_batch`."""
        if len(y0) == 1:
            Y, last = self.run(h, y0[0], n_steps, save)
            return Y[None], np.array([last])
        if not self._tables.processed:
            return self._splitting.run_batch(self._kernel(h), abs(h), y0, n_steps, save, self._compensated, threads)
        numbers = self._numbers(h)
        rollout = self._loops().rollout_processed_batch
        y0, save = np.ascontiguousarray(y0, dtype=np.float64), np.ascontiguousarray(save, dtype=np.int64)
        out = np.empty((len(y0), len(save), y0.shape[1]))
        n_finite = np.empty(len(y0), dtype=np.int64)

        def rows(i: slice, stop: np.ndarray) -> None:
            rollout(*numbers.arrays, y0[i], n_steps, save, out[i], n_finite[i], stop)

        run_rows(rows, len(y0), numbers.work(n_steps, len(save)) * y0.shape[1] // 2, threads)
        return out, n_finite

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
        return self._splitting.step_rows(
            tables.polynomials(back), tables.level, tables.variable(t), t, y, tables.monomials
        )

    def _kernel(self, h: float) -> Scheme:
        """K_h, or for h < 0 its inverse."""
        return self._tables.scheme("primed kernel", abs(h), back=h < 0)

    def _loops(self) -> Any:
        """The compiled functions for the kicks of the flow."""
        return self._splitting._loops(self._tables.level, self._compensated, self._tables.monomials)

    def _numbers(self, h: float) -> _Processed:
        """The numbers of a run of ψ̄_h with a processor."""
        return self._tables.kept(("processed", h), lambda: _Processed.of(self._tables, h))


@dataclass(frozen=True)
class _Processed:
    """χ⁻¹, K and χ at one step length, as the loops have them.

    Attributes
    ----------
    arrays
        Of each of the three two arrays: kicks, drifts and gradients (3, m), and curvatures (m,) or
        polynomials (m, M). K has the table of a run.
    """

    arrays: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, tables: Tables, h: float) -> _Processed:
        """Steps of |h|, or for h < 0 their inverse."""
        t = abs(h)
        kernel = tables.scheme("primed kernel", t, back=h < 0)
        before, after = (tables.scheme("primed processor", t, back=back) for back in (True, False))
        parts = scaled_step_table(before, t), scaled_run_table(kernel, t), scaled_step_table(after, t)
        arrays = [a for *numbers, more in parts for a in (np.stack(numbers), more)]
        return cls(tuple(arrays))

    def work(self, n_steps: int, n_saved: int) -> int:
        """Stages of a run."""
        return n_steps * self.arrays[2].shape[1] + n_saved * self.arrays[4].shape[1]
