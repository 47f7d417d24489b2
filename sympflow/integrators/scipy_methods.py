"""SciPy's explicit Runge–Kutta methods as integrators."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, Self

import numpy as np
from scipy.integrate import DOP853 as ScipyDOP853
from scipy.integrate import RK45 as ScipyRK45
from scipy.integrate import OdeSolution

from sympflow.arguments import MAX_SAVED_VALUES, as_float, check_counts
from sympflow.arrays import Array
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import Recorder
from sympflow.integrators.contract import (
    ENDED,
    FINISHED,
    Interrupted,
    Outcome,
    Problem,
    Steps,
    interrupted,
    method_class,
)
from sympflow.integrators.grid import MOST_OPEN_STEPS, Grid
from sympflow.integrators.impulses import pieces_of
from sympflow.integrators.interpolants import Batch, Piecewise
from sympflow.integrators.runge_kutta import RungeKutta, hopeless

MOST_STEPS = 10_000_000


@dataclass(frozen=True)
class _Scipy(RungeKutta):
    """A SciPy solver, trajectory by trajectory.

    Parameters
    ----------
    rtol, atol : float
        The local error is kept below atol + rtol·|y|; the defaults are SciPy's.
    max_step : float
        Longest step; where a sampled parameter jumps, also the shortest time between two jumps.
    first_step : float, optional
        Length of the first step, at most that of the interval; the solver chooses it by default.
    max_steps : int, optional
        Most steps of a trajectory; then it ends with status −1, and keeps what it has. So it does as soon as it is seen
        that it needs ten times as many. The default is 10 million, a quarter of an hour, and one million to an
        infinite end.
    """

    max_step: float = math.inf
    first_step: float | None = None
    max_steps: int | None = None
    solver: ClassVar[Any]
    finds_events: ClassVar[bool] = True
    takes_infinite_end: ClassVar[bool] = True
    one_by_one: ClassVar[bool] = True
    arrays_only: ClassVar[str] = "is SciPy's and runs on NumPy arrays: pass y0.numpy(), or use method='dopri5'"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not as_float(self.max_step) > 0:
            raise ValueError(f"`max_step` must be positive; got {self.max_step!r}.")
        if self.first_step is not None and not 0 < as_float(self.first_step) < math.inf:
            raise ValueError(f"`first_step` must be positive and finite; got {self.first_step!r}.")
        if self.max_steps is not None:
            check_counts(max_steps=self.max_steps)

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float, n_times: int = 0) -> Self:
        if self.first_step is not None and self.first_step > length > 0:
            raise ValueError(
                f"`first_step` {self.first_step:g} exceeds the interval, of length {length:g}: reduce it, or leave it "
                "out."
            )
        return self

    def output_step(self, problem: Problem) -> float | None:
        return problem.system.dt if problem.y0.ndim > 1 else None

    def most_steps(self, t1: float, size: int) -> int:
        """Return the most steps to t1, of a trajectory of `size` numbers."""
        if self.max_steps is not None:
            return int(self.max_steps)
        return MOST_STEPS if math.isfinite(t1) else min(MOST_OPEN_STEPS, max(MAX_SAVED_VALUES // size, 1))

    def _start(self, system: HamiltonianSystem, t0: float, t1: float, y0: np.ndarray, backend: str = "auto") -> Any:
        """The SciPy solver at t0, or None if the vector field or the first step is not finite there."""
        first = None if self.first_step is None else min(self.first_step, abs(t1 - t0))
        field: Any = system
        if backend != "array":
            with suppress(ValueError):  # of a system without a compiled form
                field = self.compiled(system, "compiled_field")
        with np.errstate(all="ignore"):
            longest = min(self.max_step, system.shortest_piece)
            atol = self.tolerance_of(system, y0)
            solver = self.solver(field, t0, y0, t1, longest, self.rtol, atol, first_step=first)
        return solver if np.isfinite(solver.f).all() and 0 < solver.h_abs < math.inf else None

    def _no_start(self, system: HamiltonianSystem, t0: float, y0: np.ndarray) -> str:
        """The message of a trajectory that has no first step."""
        with np.errstate(all="ignore"):
            finite = bool(np.isfinite(system.vector_field(y0.astype(float), t0)).all())
        if finite and self.atol == 0 and (y0 == 0).any():
            return (
                f"There is no first step from t = {t0:.15g}: `atol` is 0, and `y0` has components that are 0, "
                "for which a relative error has no meaning. Give an `atol`, such as `rtol` times the size of the state."
            )
        what = "first step" if finite else "vector field"
        return f"The {what} is not finite at t = {t0:.15g}. Check `y0` and its scale{', or raise `atol`' * finite}."

    def run(self, problem: Problem) -> Outcome:
        self.check_library(problem.y0)
        if problem.y0.ndim == 1:
            return self._run_one(problem, problem.y0, problem.t_eval)
        batch = problem.y0.shape[:-1]
        t_eval = problem.t_eval
        if t_eval is None:  # the trajectories take different steps: report on a common grid
            t_eval = Grid(problem.t0, problem.t1, problem.system.dt).outputs(None, problem.save_every)
        runs, problem = [], replace(problem, progress=None)
        try:
            for y0 in problem.y0.reshape(-1, problem.y0.shape[-1]):
                runs.append(self._run_one(problem, y0, t_eval))
        except Interrupted as stop:  # of one trajectory of a batch
            raise KeyboardInterrupt from stop
        y = np.full((len(t_eval), len(runs), problem.y0.shape[-1]), np.nan)
        for i, run in enumerate(runs):
            y[: len(run.y), i] = run.y
        failed = [i for i, run in enumerate(runs) if run.status]
        stats = {key: sum(run.stats[key] for run in runs) for key in ("n_steps", "force_evaluations")}
        stats |= {"hessian_evaluations": 0, "backend": "scipy"}
        if problem.t_eval is None:
            stats["output_step"] = problem.system.dt
        if failed:
            stats["failed_at"] = np.reshape([run.stats.get("failed_at", np.nan) for run in runs], batch)
        message = FINISHED if not failed else f"Trajectory {failed[0]} failed: {runs[failed[0]].message}"
        status = np.array([run.status for run in runs]).reshape(batch)
        outcome = Outcome(t_eval, y.reshape(len(t_eval), *problem.y0.shape), status, message, stats)
        if problem.dense_output:
            outcome.sol = Batch([(run.sol, 0) for run in runs], batch, (problem.t0, problem.t1))
        return outcome

    def _run_one(self, problem: Problem, y0: np.ndarray, t_eval: np.ndarray | None) -> Outcome:
        """SciPy's driver loop for one trajectory: every step, or the dense output at `t_eval`."""
        t0, t1 = problem.t0, problem.t1
        stats: dict[str, Any] = {"n_steps": 0, "force_evaluations": 0, "hessian_evaluations": 0, "backend": "scipy"}
        times, states, interpolants = [t0], [y0], []
        solver = self._start(problem.system, t0, t1, y0.astype(float), problem.backend) if t1 != t0 else None
        failure = None
        if t1 != t0 and solver is None:
            failure = self._no_start(problem.system, t0, y0)
        record = Recorder(replace(problem, y0=y0), np.empty(0) if t_eval is None else t_eval)
        if t1 == t0:
            record.empty(t0, y0)
        y_old, reached, most, stopped = y0, t0, self.most_steps(t1, y0.size), False
        with np.errstate(all="ignore"):
            try:
                while solver is not None and solver.status == "running":
                    failure = solver.step()
                    if solver.status == "failed":
                        failure = f"{failure} The solver stopped at t = {solver.t:.15g}."
                        break
                    if not np.isfinite(solver.y).all():
                        failure = f"The solution became non-finite after t = {solver.t_old:.15g}. End `t_span` earlier."
                        break
                    stats["n_steps"] += 1
                    dense: Any = cache(solver.dense_output)  # built when first needed: DOP853's costs evaluations

                    def within(s: float, dense: Any = dense) -> np.ndarray:
                        return dense()(s)

                    t_new, y_new = record.take(solver.t_old, y_old, solver.t, solver.y, within)
                    if problem.dense_output:
                        interpolants.append(dense())
                    if t_eval is None or problem.dense_output:
                        times.append(t_new)
                        states.append(y_new)
                    if record.end is not None:
                        break
                    y_old, reached = y_new, t_new
                    if problem.progress is not None:
                        problem.progress(abs(reached - t0))
                    failure = hopeless(stats["n_steps"], t0, solver.t, t1, most)
                    if failure:
                        break
            except KeyboardInterrupt:
                stopped = True
        stats["force_evaluations"] = 0 if solver is None else int(solver.nfev)
        if t_eval is None:
            del times[len(states) :]  # Ctrl-C may come between the two
            keep = sorted({*range(0, len(times), problem.save_every), len(times) - 1})
            t, y = np.array(times)[keep], np.array(states)[keep]
        else:
            t, y = t_eval[: len(record.outputs)], np.array(record.outputs).reshape(-1, len(y0))
        outcome = Outcome(t, y.astype(y0.dtype), -1 if failure else 0, failure or FINISHED, stats)
        if record.end is not None:
            outcome.status, outcome.message = 1, ENDED
        elif failure:
            stats["failed_at"] = float(reached)
        if problem.dense_output:
            outcome.sol = OdeSolution(times, interpolants) if interpolants else Piecewise([], y0, t0, t0)
        if stopped:
            raise interrupted(outcome, float(reached))
        return outcome

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        """The realised steps. Trajectories of a batch advance in parallel; those that have ended get h = 0."""
        y, going = np.array(y0, dtype=float), np.full(y0.shape[:-1], t_span[0] != t_span[1]).reshape(-1)
        for piece in pieces_of(self, system, *t_span):
            y = yield from self._steps(system, piece, y, going)

    def _steps(
        self, system: HamiltonianSystem, t_span: tuple[float, float], y0: np.ndarray, going: np.ndarray
    ) -> Generator[tuple[np.ndarray, np.ndarray, np.ndarray], None, np.ndarray]:
        """The steps of trajectories that have not ended, `going`; and the states at the end."""
        batch = y0.shape[:-1]
        starts = y0.reshape(-1, y0.shape[-1])
        solvers = [self._start(system, *t_span, y) if on else None for y, on in zip(starts, going, strict=True)]
        t = np.full(len(starts), t_span[0], dtype=float)
        y, n_steps, most = starts.copy(), 0, self.most_steps(t_span[1], y0.shape[-1])
        made: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        while any(solver is not None and solver.status == "running" for solver in solvers):
            h, y_next = np.zeros(len(starts)), y.copy()
            for i, solver in enumerate(solvers):
                if solver is None or solver.status != "running":
                    continue
                with np.errstate(all="ignore"):
                    solver.step()
                if solver.status == "failed" or not np.isfinite(solver.y).all():
                    solvers[i] = None
                    continue
                h[i], y_next[i] = solver.t - t[i], solver.y
                if hopeless(n_steps + 1, t_span[0], solver.t, t_span[1], most):
                    solvers[i] = None
            made.append((t.reshape(batch), y.reshape(y0.shape), h.reshape(batch)))
            if len(made) * y.size >= TOGETHER:
                yield _together(made)
                made = []
            t, y, n_steps = t + h, y_next, n_steps + 1
        if made:
            yield _together(made)
        going[:] = [solver is not None for solver in solvers]
        return y.reshape(y0.shape)


TOGETHER = 4096  # numbers of states of the steps that are told at once


def _together(steps: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    times, states, lengths = (np.stack(column) for column in zip(*steps, strict=True))
    return times, states, lengths


def _scipy_method(solver: Any, order: int, source: str) -> type[_Scipy]:
    own = {"name": solver.__name__.lower(), "solver": solver, "A": solver.A, "B": solver.B}
    return method_class(_Scipy, solver.__name__, __name__, order=order, source=source, **own)


RK45 = _scipy_method(ScipyRK45, 5, "Dormand–Prince 5(4), SciPy's `RK45`: the paper's ODE45, at the default tolerances.")
DOP853 = _scipy_method(ScipyDOP853, 8, "Dormand–Prince 8(5,3), SciPy's `DOP853`.")
