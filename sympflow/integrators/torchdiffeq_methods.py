"""torchdiffeq's methods as integrators: batches in one tensor, gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.integrate import RK45 as ScipyRK45

from sympflow.arrays import Array, is_tensor, to_numpy
from sympflow.integrators.base import FINISHED, Outcome, Problem, Steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.runge_kutta import RungeKutta
from sympflow.system import HamiltonianSystem


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
