"""torchdiffeq's adaptive Runge–Kutta methods."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sympflow.arrays import Array, to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import Problem, Steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.interpolants import Interpolant, quartic
from sympflow.integrators.runge_kutta import RungeKutta, weighted
from sympflow.integrators.tableaux import Tableau
from sympflow.integrators.torchdiffeq_driver import TooManyStepsError, Trace, Visit, Watched


@dataclass(frozen=True)
class Adaptive(Watched, RungeKutta):
    """An adaptive Runge–Kutta method of torchdiffeq.

    The trajectories of a batch share their steps; if that fails, it is run in parts, so that those of its trajectories
    that can reach their end do. Without `t_eval` the
    states are reported every `system.dt`. Between the steps, for outputs, events and the dense output alike, the state
    is torchdiffeq's interpolation: the quartic through both ends, their slopes and the state at the middle of the step.

    Parameters
    ----------
    rtol, atol : float
        The local error, in the root mean square over the batch, is kept below atol + rtol·|y|; torchdiffeq's defaults.
    max_num_steps : int
        Most steps of a call, those that are tried and rejected included, in sum over the parts of a batch; then it ends
        with status −1. torchdiffeq's own default, 2³¹ − 1, is none: before a singularity a method of order 2 takes
        minutes.
    """

    rtol: float = 1e-7
    atol: float = 1e-9
    max_num_steps: int = 5_000

    tableau: ClassVar[Tableau]

    def __post_init__(self) -> None:
        super().__post_init__()
        most = self.max_num_steps
        if isinstance(most, bool) or not isinstance(most, int | np.integer) or not 0 < most < 2**31:
            raise ValueError(f"`max_num_steps` must be a positive integer below 2**31; got {most!r}.")

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        if self.tableau.carries_slope:
            raise TypeError(
                f"`method` {self.name!r} is no one-step map in torchdiffeq, which carries a slope from step to step: "
                "volume and symplecticity have no meaning for it. Use 'heun2', or 'dopri5'."
            )
        return super().tangent(system, t, y, h)

    def outputs(self, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
        if problem.t_eval is not None:
            return problem.t_eval, {}
        dt = problem.system.dt
        return Grid(problem.t0, problem.t1, dt).outputs(None, problem.save_every)[0], {"output_step": dt}

    @property
    def most_steps(self) -> int:
        return int(self.max_num_steps)

    def make_trace(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array, visit: Visit) -> Trace:
        return _Stages(self.tableau, system, t_span, y0, visit)

    def integrate(self, trace: Trace, y: Any, length: float) -> None:
        import torch
        from torchdiffeq import odeint

        s = torch.tensor([0.0, length], dtype=torch.float64, device=y.device)
        assert isinstance(trace, _Stages)
        most = trace.most_steps or self.max_num_steps
        options = {"max_num_steps": most}
        try:
            odeint(trace, y, s, rtol=self.rtol, atol=self.atol, method=self.name, options=options)
        except AssertionError:
            if trace.n_tried < most:
                raise
            (t0, t1), t = trace.t_span, trace.reached
            more = most * abs(t1 - t) / abs(t - t0) if t != t0 else math.inf
            raise TooManyStepsError(
                f"After `max_num_steps` = {self.max_num_steps} steps t = {t:.17g} is reached, and at this pace the end "
                f"needs about {more:.2g} more. Raise `max_num_steps` or the tolerances, or end `t_span` earlier."
            ) from None

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        y0, steps = to_numpy(y0), []

        def visit(step: Interpolant) -> bool:
            steps.append(step)
            return False

        self.watch(system, t_span, y0, visit)
        for step in steps:
            yield np.array([step.t0]), step.y0[None], np.full((1, *y0.shape[:-1]), step.t1 - step.t0)


class _Stages(Trace):
    """Collects the slopes of each step: torchdiffeq interpolates from them."""

    def __init__(self, tableau: Tableau, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.tableau = tableau
        self.first: Any = None
        self.slopes: list[Any] = []

    def evaluated(self, y: Any, f: Any) -> None:
        self.slopes.append(f)

    def callback_step(self, s: Any, y: Any, dt: Any) -> None:
        """A step is tried. Its first slope is the last of the step before, or at the start that of the state."""
        self.n_tried += 1
        self.first = self.slopes[0] if self.first is None else self.first
        self.slopes.clear()

    def callback_accept_step(self, s: Any, y: Any, dt: Any) -> None:
        K, y = [self.array(f) for f in (self.first, *self.slopes)], self.array(y)
        if not (s.requires_grad or dt.requires_grad):
            s, dt = float(s), float(dt)
        t0, t1 = (self.t_span[0] + self.direction * x for x in (s, s + dt))
        h = self.direction * dt
        y1, middle = (y + h * weighted(weights, K) for weights in (self.tableau.B, self.tableau.middle))
        self.first = self.slopes[-1]
        self.announce(quartic(t0, t1, y, y1, middle, K[0], K[-1]))
