"""Compiled loops of flows that are made of a system: primed, split and clocked ones, by the loops of their systems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import arrays_only
from sympflow.flow.tables import Tables
from sympflow.hamiltonian.collocation import Tableau
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import Kernel, Run, RunCheckpoint, Steps, Task, begun_in, both_ways, run_states
from sympflow.kernels.splitting_loops import SplittingKernel, splitting_loops
from sympflow.kernels.stages import StageTable, run_table, single_table, with_last_stage
from sympflow.schemes import CURVATURE, Scheme

if TYPE_CHECKING:
    from sympflow.hamiltonian.parts import ExactParts
    from sympflow.kernels.reverse import Between, Chained, Recorded
    from sympflow.kernels.rollouts import SplittingRollouts

ONE = np.ones(1, dtype=np.int64)

__all__ = ["ClockedFlowKernel", "CollocatedFlowKernel", "PrimedFlowKernel", "SplitFlowKernel"]


class PrimedFlowKernel(Kernel):
    """Compiled loops of a primed flow on its system; a step h < 0 is the inverse of ψ̄_|h|.

    A flow with a processor, ψ̄ = χ ∘ K ∘ χ⁻¹, starts a run by χ⁻¹, makes its steps by K, and applies χ to each output.
    """

    def __init__(self, tables: Tables, system: HamiltonianSystem, compensated: bool = False) -> None:
        system.friction.check_sums(compensated)
        known = system.form is not None or (tables.level == CURVATURE and system.local is not None)
        if tables.level >= CURVATURE and not known:
            raise arrays_only(
                f"`system` {system.name!r} has no symbols, and curvature terms and polynomials are compiled from these"
            )
        self.system = system
        self._tables, self._splitting, self._compensated = tables, splitting_loops(system), compensated
        self._ranges = None if system.friction else self._splitting.ranges(tables.level, compensated)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int]:
        return self._tables.evaluations(n_steps, n_saved, n_extra, "compiled")

    def runs(self, task: Task) -> Run:
        if not self._tables.processed:
            return self._kernel(task.h).runs(task._replace(h=abs(task.h)))
        tables, (N, size) = self._processed(task.h, task.t0), task.y0.shape
        stages = tables[1].shape[1] + tables[2].shape[1] * -(-len(task.save) // max(task.n_steps, 1))
        work = stages * size / 2 / (self._splitting.abreast if N > 1 else 1.0)
        rollout = partial(self._functions().run_processed, *tables)
        return run_states(rollout, task, size * (1 + self._compensated), work)

    def check_reverse(self) -> None:
        self._functions().check_reverse()
        if self._tables.processed and self._splitting.friction:
            super().check_reverse()

    def recorded(self, task: Task) -> Between | Chained | Recorded:
        if not self._tables.processed:
            return self._kernel(task.h).recorded(task._replace(h=abs(task.h)))
        from sympflow.kernels.reverse import Between, Recorded

        code: Any = self._functions()
        later = task.save[begun_in(task.save) :]
        tables, size = self._processed(task.h, task.t0), task.y0.shape[1]
        before, after = (code.unclosed(tables[i], 2) for i in (0, 2))
        work = self._splitting.work
        first = Recorded(code, before, task.y0, 1, ONE, before.shape[1] * work)
        steps = code.unclosed(tables[1])
        run = Recorded(code, steps, first.states[:, 0], task.n_steps, later, steps.shape[1] * work)
        rows = run.states.reshape(-1, size)
        if self._splitting.driven:
            after = code.shifted(after, later)
            rows = np.column_stack([rows, np.tile(np.arange(float(len(later))), len(task.y0))])
        last = Recorded(code, after, rows, 1, ONE, work)

        def out(x: np.ndarray) -> np.ndarray:
            return last.pulled(x.reshape(-1, 1, size), False)[0].reshape(x.shape)

        states = last.states.reshape(run.states.shape)
        return Between(task, run, states, out, lambda x: first.pulled(x[:, None], False)[0])

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,), of a driven system at the times t."""
        lengths, times = (np.broadcast_to(np.asarray(x, dtype=np.float64), len(y)) for x in (h, t))

        def one_way(rows: Any, back: bool) -> np.ndarray:
            return self._stepped(np.abs(lengths[rows]), y[rows], back, times[rows])

        return Steps(both_ways(one_way, lengths, y))

    def tangents(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        from sympflow.kernels.tangents import step_tangents

        tables, out, A = self._tables, y.copy(), np.broadcast_to(np.eye(y.shape[1]), (*y.shape, y.shape[1])).copy()
        for back, rows in ((False, h > 0), (True, h < 0)):
            if rows.any():
                t = np.abs(h[rows])
                table = tables.kept(("polynomials", back), partial(tables.polynomials, back))
                found = step_tangents(self.system, table, tables.variable(t), t, y[rows], tables.monomials)
                if found is None:
                    return None
                out[rows], A[rows] = found
        return out, A

    def _stepped(self, h: np.ndarray, y: np.ndarray, back: bool, t: ArrayLike) -> np.ndarray:
        tables, loops = self._tables, self._splitting

        def make() -> tuple[StageTable, np.ndarray]:
            table = tables.polynomials(back)
            return table, loops.rows(table, ranges=self._ranges)

        table, rows = tables.kept(("rows", back, loops.values), make)
        return loops.step_rows(table, tables.variable(h), h, y, tables.monomials, t, ranges=self._ranges, rows=rows)

    def _kernel(self, h: float) -> SplittingKernel:
        """K_h, or for h < 0 its inverse."""
        scheme = self._tables.scheme("primed kernel", abs(h), back=h < 0)
        return self._splitting.kernel(scheme, self._compensated, self._ranges)

    def _functions(self) -> SplittingRollouts:
        """The compiled functions for the kicks of the flow."""
        tables = self._tables
        return self._splitting.functions(tables.level, self._compensated, tables.monomials, ranges=self._ranges)

    def _processed(self, h: float, t0: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The tables of χ⁻¹, of a run of K, and of χ from the last stage of K on; for h < 0 of the inverse."""
        loops = self._splitting

        def stages() -> tuple[StageTable, StageTable, StageTable]:
            t, tables = abs(h), self._tables
            kernel = run_table(tables.scheme("primed kernel", t, back=h < 0), t)
            before, after = (single_table(tables.scheme("primed processor", t, back=back), t) for back in (True, False))
            # The loops read the numbers of all terms, of maps that lack some too.
            before, kernel, after = (replace(table, level=tables.level) for table in (before, kernel, after))
            return before, kernel, with_last_stage(kernel, after)

        if loops.driven:
            before, kernel, after = self._tables.kept(("stages", h), stages)
            start = t0 + float(before.drifts.sum())  # the time moves with the drifts of χ⁻¹ too
            return loops.rows(before, h, t0), loops.rows(kernel, abs(h), start), loops.rows(after, h, start)

        def make() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            before, kernel, after = (loops.rows(table, ranges=self._ranges) for table in stages())
            return before, kernel, after

        return self._tables.kept(("processed", h, loops.values), make)


class SplitFlowKernel(Kernel):
    """Compiled loops of a flow made of exact flows of parts, by its `KeptMaps`; h < 0 is the inverse of ψ̄_|h|."""

    def __init__(self, maps: Any, parts: ExactParts, dt: float) -> None:
        from sympflow.kernels.parts_loops import parts_loops

        self.parts, self._maps, self._dt = parts, maps, dt
        self._loops = parts_loops(parts)
        self._kernel = self._loops.kernel(lambda h: maps.maps(float(h)))

    def runs(self, task: Task) -> Run:
        return self._kernel.runs(task)

    def check_reverse(self) -> None:
        self._kernel.check_reverse()

    def recorded(self, task: Task) -> Between:
        return self._kernel.recorded(task)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])

        def one_way(rows: Any, back: bool) -> np.ndarray:
            maps = self._maps.coefficients(back)
            return self._loops.step_by_coefficients(maps, self._dt, np.abs(lengths[rows]), y[rows])

        return Steps(both_ways(one_way, lengths, y))


class ClockedFlowKernel(Kernel):
    """Compiled loops of a flow with a trained clock, of states [q, t, p, B] of the transformed system.

    B is constant and nothing depends on t, so n steps of the clock are n times one, added where a state is kept:
    ``advance(s, B)`` of steps s.
    """

    saves_finite = False

    def __init__(self, scheme: Scheme, system: HamiltonianSystem, advance: Callable[[Any, Any], Any]) -> None:
        self._kernel = splitting_loops(system).kernel(scheme)
        self._advance, self._time = advance, system.ndof - 1

    def runs(self, task: Task) -> Run:
        Y, n_finite, _ = self._kernel.runs(task)
        Y[:, :, self._time] += np.asarray(task.save) * np.reshape(self._advances(task.h, task.y0), (-1, 1))
        return Run(Y, n_finite)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        out = self._kernel.step(h, y).states
        out[:, self._time] += self._advances(h, y)
        return Steps(out)

    def _advances(self, h: ArrayLike, y: np.ndarray) -> Any:
        if len(y) == 1:  # as plain numbers, ten times faster
            return self._advance(float(np.ravel(h)[0]), float(y[0, -1]))
        return self._advance(np.asarray(h, dtype=np.float64), y[:, -1])


class CollocatedFlowKernel(Kernel):
    """Compiled loops of a flow of so many equal `steps` of a Gauss method, a `Kernel`."""

    saves_finite = False

    def __init__(self, system: HamiltonianSystem, tableau: Tableau, steps: int) -> None:
        from sympflow.kernels.newton import implicit_kernel

        self._kernel, self._steps = implicit_kernel(system, tableau), steps

    def runs(self, task: Task) -> Run:
        m, carry = self._steps, task.carry
        inner = None if carry is None else RunCheckpoint(m * carry.steps, carry.running, carry.spare)
        asked = self._inner(task)._replace(carry=inner)
        states, n_finite, iterations = self._kernel.runs(asked)
        if carry is not None and inner is not None:
            carry.advance(task.n_steps, inner.running)
        return Run(states, n_finite // m, iterations)

    def _inner(self, task: Task) -> Task:
        """The steps of the Gauss method that a task asks for."""
        m = self._steps
        return task._replace(h=task.h / m, n_steps=m * task.n_steps, save=m * np.asarray(task.save))

    def check_reverse(self) -> None:
        self._kernel.check_reverse()

    def recorded(self, task: Task) -> Between:
        from sympflow.kernels.reverse import Between

        run = self._kernel.recorded(self._inner(task._replace(save=task.save[begun_in(task.save) :])))
        found = Between(task, run, run.states, lambda x: x, lambda x: x)
        found.n_finite //= self._steps
        return found

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        share, iterations = np.asarray(h, dtype=np.float64) / self._steps, 0
        for _ in range(self._steps):
            y, taken = self._kernel.step(share, y)
            iterations += taken
        return Steps(y, iterations)
