"""The kernel of a primed SympFlow: the splitting kernel of its system, run with the flow's tables."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from sympflow.integrators.schemes import Scheme
from sympflow.kernels.splitting import splitting_kernel
from sympflow.system import HamiltonianSystem

if TYPE_CHECKING:
    from sympflow.flow.coefficients import Entry
    from sympflow.flow.primed import PrimedFlow

__all__ = ["PrimedFlowKernel"]


MOST_KEPT = 64  # step lengths of a flow whose tables are kept

_KNOWN: WeakKeyDictionary[PrimedFlow, tuple[tuple[tuple[int, int], ...], dict[float, tuple[Scheme, ...]]]]
_KNOWN = WeakKeyDictionary()
"""Tables of flows, with the versions of the numbers that they were made from."""


class PrimedFlowKernel:
    """Compiled loops of a primed flow on its system; states are [q, p], float64.

    A flow with a processor, ψ̄ = χ ∘ K ∘ χ⁻¹, starts a run by χ⁻¹, makes its steps by K, and applies χ to each output.

    Parameters
    ----------
    flow : PrimedFlow
        In float64 on the CPU, with the numbers that it has when a table of it is first needed.
    system : HamiltonianSystem
        The flow's, one that can be compiled.
    compensated : bool
        Whether runs sum with Kahan's compensation.
    """

    def __init__(self, flow: PrimedFlow, system: HamiltonianSystem, compensated: bool = False) -> None:
        if str(flow.dtype) != "torch.float64" or flow.device.type != "cpu":
            raise ValueError(f"`flow` is {flow.dtype} on {flow.device}: compiled flows are float64 on the CPU.")
        self.flow, self._splitting, self._compensated = flow, splitting_kernel(system), compensated
        self._weights = tuple(flow.parameters())

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
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,) and, where these differ, its own table."""
        h = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        out = np.array(y, dtype=np.float64)
        for rows in (h > 0, h < 0):
            if not rows.any():
                continue
            t = np.abs(h[rows])
            if (t == t[0]).all():
                scheme = self.flow.scheme(float(t[0]))
                out[rows] = self._splitting.step(scheme if h[rows][0] > 0 else scheme.inverse(), t, out[rows])
            else:
                out[rows] = self._splitting.step_rows(self._tables_at(t, bool(h[rows][0] < 0)), t, out[rows])
        return out

    def _tables_at(self, t: np.ndarray, back: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ψ̄_t, or its inverse, for each t (N,): kicks, drifts and gradients (N, m) of its stages."""
        tables = flow_tables(self.flow, t)
        idle, sign = np.zeros(len(t)), -1.0 if back else 1.0
        columns: tuple[list[np.ndarray], ...] = ([], [], [])  # kicks, drifts, gradients
        before = "drift"
        for kind, c, g in reversed(tables) if back else tables:
            if kind == "drift" and before == "kick":
                columns[1][-1] = sign * c
            else:
                entry = (sign * c, idle, sign * g) if kind == "kick" else (idle, sign * c, idle)
                for column, value in zip(columns, entry, strict=True):
                    column.append(value)
            before = kind
        kicks, drifts, gradients = (np.stack(column, axis=1) for column in columns)
        return kicks, drifts, gradients

    def _kernel(self, h: float) -> Scheme:
        """K_h, or for h < 0 its inverse."""
        return self._schemes(abs(h))[0 if h > 0 else 1]

    def _schemes(self, t: float) -> tuple[Scheme, ...]:
        """K_t and its inverse, and with a processor χ_t and its inverse."""
        weights = tuple((w.data_ptr(), w._version) for w in self._weights)
        known = _KNOWN.get(self.flow)
        if known is None or known[0] != weights or len(known[1]) >= MOST_KEPT:
            known = _KNOWN[self.flow] = weights, {}
        tables = known[1]
        if t not in tables:
            made = [self.flow.kernel_scheme(t)]
            made += [self.flow.processor_scheme(t)] if self.flow.processor else []
            tables[t] = tuple(s for scheme in made for s in (scheme, scheme.inverse()))
        return tables[t]

    def _prepared(self, t: float, y: np.ndarray) -> np.ndarray:
        """χ_t⁻¹ of the rows of y."""
        return self._splitting.step(self._schemes(t)[3], t, y) if self.flow.processor else y

    def _finished(self, t: float, y0: np.ndarray, Y: np.ndarray, save: np.ndarray) -> np.ndarray:
        """χ_t of the outputs Y (N, n, 2d); what is saved before the first step are the initial states themselves."""
        if not self.flow.processor:
            return Y
        rows = Y.reshape(-1, Y.shape[-1])
        out = np.empty_like(rows)
        chi = self._schemes(t)[2]
        if len(rows):
            out = self._splitting.run_batch(chi, t, rows, 1, np.array([1]), threads=1)[0][:, 0]
        out = out.reshape(Y.shape)
        out[:, np.asarray(save) == 0] = y0[:, None]
        return out


def flow_tables(flow: PrimedFlow, t: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Kind, coefficient and force gradient (N,) of the flow's substeps, at every t (N,) in (0, Δt].

    Raises
    ------
    ValueError
        If a t lies outside.
    """
    if not (t <= flow.dt * (1 + 1e-12)).all():
        raise ValueError(f"`t` must lie in (0, dt] = (0, {flow.dt:g}]; got {t.max():g}.")
    values: dict[int, np.ndarray] = {}

    def at(entry: Entry) -> np.ndarray:
        if id(entry.column) not in values:
            values[id(entry.column)] = entry.column.at(t / flow.dt)
        return entry.sign * values[id(entry.column)][entry.row]

    return [(s.kind, at(s.weight), np.zeros(len(t)) if s.gradient is None else at(s.gradient)) for s in flow.substeps]
