"""Runge–Kutta methods: adapters over SciPy (NumPy) and torchdiffeq (batches and gradients)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.integrate import DOP853 as ScipyDOP853
from scipy.integrate import RK45 as ScipyRK45
from scipy.integrate import OdeSolution

from sympflow.arrays import Array, is_tensor, per_state, to_numpy
from sympflow.integrators.base import FINISHED, Integrator, Outcome, Problem, Steps
from sympflow.integrators.grid import Grid
from sympflow.system import HamiltonianSystem


@dataclass(frozen=True)
class RungeKutta(Integrator):
    """An explicit embedded Runge–Kutta method with step-size control.

    Parameters
    ----------
    rtol, atol : float
        The local error is kept below atol + rtol·|y|.
    """

    rtol: float = 1e-3
    atol: float = 1e-6

    symplectic: ClassVar[bool] = False
    A: ClassVar[np.ndarray]
    B: ClassVar[np.ndarray]

    def __post_init__(self) -> None:
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0 <= value < math.inf):
                raise ValueError(f"`{name}` must be a finite number, not negative; got {value!r}.")
        if self.rtol == 0 and self.atol == 0:
            raise ValueError("`rtol` and `atol` are both 0, which no step can meet: make one of them positive.")

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        """One step without error control."""
        h = per_state(h, y)
        K: list[Array] = []
        for row in self.A[: len(self.B)]:
            K.append(system.vector_field(y + h * _weighted(row, K) if K else y))
        return y + h * _weighted(self.B, K)

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step and its Jacobian, the step length held fixed: each stage differentiated as it is executed."""
        y = to_numpy(y)
        h = np.asarray(h, dtype=y.dtype)[..., None]
        d, identity = system.ndof, np.eye(y.shape[-1], dtype=y.dtype)
        K: list[np.ndarray] = []
        dK: list[np.ndarray] = []
        for row in self.A[: len(self.B)]:
            Y = y + h * _weighted(row, K) if K else y
            dY = identity + h[..., None] * _weighted(row, dK) if K else identity
            K.append(system.vector_field(Y))
            hessian = system.hessian(Y)
            dK.append(np.concatenate([hessian[..., d:, :], -hessian[..., :d, :]], axis=-2) @ dY)
        return y + h * _weighted(self.B, K), identity + h[..., None] * _weighted(self.B, dK)


def _weighted(weights: np.ndarray, K: list[Array]) -> Array:
    return sum((float(w) * k for w, k in zip(weights, K, strict=False) if w), 0.0 * K[0])


@dataclass(frozen=True)
class _Scipy(RungeKutta):
    """A SciPy solver, trajectory by trajectory.

    Parameters
    ----------
    rtol, atol : float
        The local error is kept below atol + rtol·|y|; the defaults are SciPy's.
    max_step : float
        Longest step.
    first_step : float, optional
        Length of the first step; the solver chooses it by default.
    """

    max_step: float = math.inf
    first_step: float | None = None

    solver: ClassVar[Any]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.max_step > 0:
            raise ValueError(f"`max_step` must be positive; got {self.max_step!r}.")
        if self.first_step is not None and not 0 < self.first_step < math.inf:
            raise ValueError(f"`first_step` must be positive and finite; got {self.first_step!r}.")

    def _start(self, system: HamiltonianSystem, t0: float, t1: float, y0: np.ndarray) -> Any:
        """The SciPy solver at t0, or None if the vector field or the first step is not finite there."""
        first = None if self.first_step is None else min(self.first_step, abs(t1 - t0))
        with np.errstate(all="ignore"):
            solver = self.solver(system, t0, y0, t1, self.max_step, self.rtol, self.atol, first_step=first)
        return solver if np.isfinite(solver.f).all() and 0 < solver.h_abs < math.inf else None

    def run(self, problem: Problem) -> Outcome:
        if is_tensor(problem.y0):
            raise TypeError(
                f"`y0` is a tensor, but method {self.name!r} is SciPy's and runs on NumPy arrays: pass y0.numpy(), or "
                "use method='dopri5'."
            )
        if problem.y0.ndim == 1:
            return self._run_one(problem, problem.y0, problem.t_eval)
        batch = problem.y0.shape[:-1]
        t_eval = problem.t_eval
        if t_eval is None:  # the trajectories take different steps: report on a common grid
            t_eval = Grid(problem.t0, problem.t1, problem.system.dt).outputs(None, problem.save_every)[0]
        runs = [self._run_one(problem, y0, t_eval) for y0 in problem.y0.reshape(-1, problem.y0.shape[-1])]
        y = np.full((len(t_eval), len(runs), problem.y0.shape[-1]), np.nan)
        for i, run in enumerate(runs):
            y[: len(run.y), i] = run.y
        failed = [i for i, run in enumerate(runs) if run.status]
        stats = {key: sum(run.stats[key] for run in runs) for key in ("n_steps", "force_evaluations")}
        stats |= {"hessian_evaluations": 0, "backend": "scipy"}
        if problem.t_eval is None:
            stats["output_step"] = problem.system.dt
        message = FINISHED if not failed else f"Trajectory {failed[0]} failed: {runs[failed[0]].message}"
        status = np.array([run.status for run in runs]).reshape(batch)
        outcome = Outcome(t_eval, y.reshape(len(t_eval), *problem.y0.shape), status, message, stats)
        if problem.dense_output:
            outcome.sol = _BatchSolution([run.sol for run in runs], batch)
        return outcome

    def _run_one(self, problem: Problem, y0: np.ndarray, t_eval: np.ndarray | None) -> Outcome:
        """SciPy's driver loop for one trajectory: every step, or the dense output at `t_eval`."""
        t0, t1 = problem.t0, problem.t1
        stats: dict[str, Any] = {
            "n_steps": 0,
            "force_evaluations": 0,
            "hessian_evaluations": 0,
            "backend": "scipy",
        }
        times, states, interpolants = [t0], [y0], []
        solver = self._start(problem.system, t0, t1, y0.astype(float)) if t1 != t0 else None
        failure = None
        if t1 != t0 and solver is None:
            failure = f"The vector field or the first step is not finite at t = {t0:.17g}. Check `y0` and its scale."
        wanted = [] if t_eval is None else t_eval.tolist()
        outputs: list[np.ndarray] = [y0 for t in wanted if t == t0]
        with np.errstate(all="ignore"):
            while solver is not None and solver.status == "running":
                failure = solver.step()
                if solver.status == "failed":
                    failure = f"{failure} The solver stopped at t = {solver.t:.17g}."
                    break
                if not np.isfinite(solver.y).all():
                    failure = f"The solution became non-finite after t = {solver.t_old:.17g}. End `t_span` earlier."
                    break
                stats["n_steps"] += 1
                due = [t for t in wanted[len(outputs) :] if (solver.t - t) * solver.direction >= 0]
                if problem.dense_output or due:
                    interpolants.append(solver.dense_output())
                    outputs += [solver.y if t == solver.t else interpolants[-1](t) for t in due]
                    if not problem.dense_output:
                        interpolants.clear()
                if t_eval is None or problem.dense_output:
                    times.append(solver.t)
                    states.append(solver.y)
        stats["force_evaluations"] = 0 if solver is None else int(solver.nfev)
        if t_eval is None:
            keep = sorted({*range(0, len(times), problem.save_every), len(times) - 1})
            t, y = np.array(times)[keep], np.array(states)[keep]
        else:
            t, y = t_eval[: len(outputs)], np.array(outputs).reshape(-1, len(y0))
        outcome = Outcome(t, y.astype(y0.dtype), -1 if failure else 0, failure or FINISHED, stats)
        if problem.dense_output:
            outcome.sol = OdeSolution(times, interpolants) if interpolants else _Constant(y0)
        return outcome

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        """The realised steps. In a batch the trajectories advance in parallel; one that has ended waits with h = 0."""
        batch = y0.shape[:-1]
        starts = np.asarray(y0, dtype=float).reshape(-1, y0.shape[-1])
        solvers = [self._start(system, *t_span, y) if t_span[0] != t_span[1] else None for y in starts]
        t = np.full(len(starts), t_span[0], dtype=float)
        y = starts.copy()
        while any(solver is not None and solver.status == "running" for solver in solvers):
            h, y_next = np.zeros(len(starts)), y.copy()
            for i, solver in enumerate(solvers):
                if solver is None or solver.status != "running":
                    continue
                with np.errstate(all="ignore"):
                    solver.step()
                if solver.status == "failed" or not np.isfinite(solver.y).all():
                    solvers[i] = None
                else:
                    h[i], y_next[i] = solver.t - t[i], solver.y
            yield t.reshape(1, *batch).copy(), y.reshape(1, *y0.shape), h.reshape(1, *batch)
            t, y = t + h, y_next


class _Constant:
    """Dense output of an interval of length zero."""

    def __init__(self, y: np.ndarray) -> None:
        self.y = y

    def __call__(self, t: Any) -> np.ndarray:
        return self.y if np.ndim(t) == 0 else np.repeat(self.y[:, None], len(t), axis=1)


class _BatchSolution:
    """The dense outputs of the trajectories of a batch, stacked: (..., 2d) or (..., 2d, n)."""

    def __init__(self, solutions: list[Any], batch: tuple[int, ...]) -> None:
        self.solutions, self.batch = solutions, batch

    def __call__(self, t: Any) -> np.ndarray:
        y = np.stack([sol(t) for sol in self.solutions])
        return y.reshape(*self.batch, *y.shape[1:])


@dataclass(frozen=True)
class RK45(_Scipy):
    """Dormand–Prince 5(4), SciPy's `RK45`: the paper's ODE45, at the default tolerances.

    Parameters
    ----------
    rtol, atol, max_step, first_step
        As in `scipy.integrate.solve_ivp`.
    """

    name: ClassVar[str] = "rk45"
    order: ClassVar[int | None] = 5
    solver: ClassVar[Any] = ScipyRK45
    A: ClassVar[np.ndarray] = ScipyRK45.A
    B: ClassVar[np.ndarray] = ScipyRK45.B


@dataclass(frozen=True)
class DOP853(_Scipy):
    """Dormand–Prince 8(5,3), SciPy's `DOP853`.

    Parameters
    ----------
    rtol, atol, max_step, first_step
        As in `scipy.integrate.solve_ivp`.
    """

    name: ClassVar[str] = "dop853"
    order: ClassVar[int | None] = 8
    solver: ClassVar[Any] = ScipyDOP853
    A: ClassVar[np.ndarray] = ScipyDOP853.A
    B: ClassVar[np.ndarray] = ScipyDOP853.B


@dataclass(frozen=True)
class Dopri5(RungeKutta):
    """Dormand–Prince 5(4), torchdiffeq's `dopri5`: batches in one tensor, gradients by backpropagation.

    The trajectories of a batch share their steps, so they also fail together. Without `t_eval` the states are reported
    every `system.dt`; the dense output integrates again up to the times that it is asked for.

    Parameters
    ----------
    rtol, atol : float
        The local error, in the root mean square over the batch, is kept below atol + rtol·|y|; torchdiffeq's defaults.
    """

    rtol: float = 1e-7
    atol: float = 1e-9

    name: ClassVar[str] = "dopri5"
    order: ClassVar[int | None] = 5
    A: ClassVar[np.ndarray] = ScipyRK45.A
    B: ClassVar[np.ndarray] = ScipyRK45.B

    def run(self, problem: Problem) -> Outcome:
        t_eval = problem.t_eval
        stats: dict[str, Any] = {}
        if t_eval is None:
            t_eval = Grid(problem.t0, problem.t1, problem.system.dt).outputs(None, problem.save_every)[0]
            stats["output_step"] = problem.system.dt
        y, record, failure = self._integrate(problem.system, problem.t0, t_eval, problem.y0)
        stats |= {
            "n_steps": record.n_steps,
            "force_evaluations": record.evaluations,
            "hessian_evaluations": 0,
        }
        stats["backend"] = "torchdiffeq"
        failed = failure is not None
        status = np.full(problem.y0.shape[:-1], -int(failed)) if problem.y0.ndim > 1 else -int(failed)
        outcome = Outcome(t_eval[: len(y)], y, status, failure or FINISHED, stats)
        if problem.dense_output:
            outcome.sol = _Again(self, problem)
        return outcome

    def _integrate(
        self, system: HamiltonianSystem, t0: float, times: np.ndarray, y0: Array, keep: bool = False
    ) -> tuple[Array, _Record, str | None]:
        """States at `times` (sorted, repeats allowed), the record of the run, and why it failed if it did."""
        import torch
        from torchdiffeq import odeint

        tensor = is_tensor(y0)
        y_start = y0 if tensor else torch.from_numpy(np.ascontiguousarray(y0))
        sign = 1 if times.size == 0 or times[-1] >= t0 else -1
        distinct, position = np.unique(sign * np.append(t0, times), return_inverse=True)
        distinct = sign * distinct
        record, failure = _Record(system, keep), None
        with torch.set_grad_enabled(tensor and torch.is_grad_enabled()):
            while True:
                if len(distinct) == 1:
                    y = y_start[None]
                    break
                t = torch.as_tensor(distinct, dtype=y_start.dtype, device=y_start.device)
                try:
                    y = odeint(record, y_start, t, rtol=self.rtol, atol=self.atol, method="dopri5")
                    break
                except AssertionError as error:  # torchdiffeq's step underflow, or a state that is not finite
                    reached = t0 if record.reached is None else record.reached
                    failure = (
                        failure or f"torchdiffeq stopped after t = {reached:.17g} ({error}). End `t_span` earlier."
                    )
                    distinct = distinct[(distinct - reached) * sign <= 0][: len(distinct) - 1]
                    record = _Record(system, keep)
        kept = position[1:][position[1:] < len(distinct)]
        y = y[torch.as_tensor(kept)]
        return (y if tensor else y.numpy()), record, failure

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        y0 = to_numpy(y0)
        _, record, _ = self._integrate(system, t_span[0], np.array([t_span[1]]), y0, keep=True)
        for t, y, dt in record.steps:
            h = math.copysign(dt, t_span[1] - t_span[0])
            yield np.array([t]), y[None], np.full((1, *y0.shape[:-1]), h)


class _Record:
    """The right-hand side given to torchdiffeq, counting its calls and recording the accepted steps."""

    def __init__(self, system: HamiltonianSystem, keep: bool = False) -> None:
        self.system, self.keep = system, keep
        self.evaluations = self.n_steps = 0
        self.reached: float | None = None
        self.steps: list[tuple[float, np.ndarray, float]] = []

    def __call__(self, t: Any, y: Any) -> Any:
        self.evaluations += 1
        return self.system.vector_field(y)

    def callback_accept_step(self, t: Any, y: Any, dt: Any) -> None:
        self.n_steps += 1
        self.reached = float(t.detach())
        if self.keep:
            self.steps.append((self.reached, to_numpy(y), abs(float(dt.detach()))))


class _Again:
    """Dense output by integrating again: the states at t are those that `t_eval=t` would have given."""

    def __init__(self, integrator: Dopri5, problem: Problem) -> None:
        self.integrator, self.problem = integrator, problem

    def __call__(self, t: Any) -> Array:
        times = np.atleast_1d(np.asarray(t, dtype=float))
        order = np.argsort(times * (1 if self.problem.t1 >= self.problem.t0 else -1))
        y, _, failure = self.integrator._integrate(self.problem.system, self.problem.t0, times[order], self.problem.y0)
        if failure:
            raise ValueError(f"`t` reaches beyond the solution: {failure}")
        y = y[np.argsort(order)]
        y = y.movedim(0, -1) if is_tensor(y) else np.moveaxis(y, 0, -1)
        return y[..., 0] if np.ndim(t) == 0 else y
