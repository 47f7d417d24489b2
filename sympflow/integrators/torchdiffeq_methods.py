"""torchdiffeq's solvers as integrators: batches in one tensor, gradients by backpropagation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from sympflow.arrays import Array, all_finite, full_of_nan, is_tensor, stack, to_numpy
from sympflow.events import ENDED, EventSearch
from sympflow.integrators.base import FINISHED, FixedStep, Integrator, Outcome, Problem, Steps, check_dt
from sympflow.integrators.grid import Grid
from sympflow.integrators.runge_kutta import ExplicitStep, RungeKutta, hopeless
from sympflow.integrators.tableaux import ADAPTIVE, FIXED, Tableau
from sympflow.system import HamiltonianSystem

MULTISTEP = ("explicit_adams", "implicit_adams")


@cache
def torchdiffeq_method(name: str) -> type[Integrator]:
    """The integrator class of torchdiffeq's solver of that name."""
    if name in MULTISTEP:
        return _named(name, Adams, {"order": 4, "__doc__": f"torchdiffeq's `{name}`: {Adams.__doc__}"})
    tableau = (ADAPTIVE | FIXED)[name]
    base: type[Integrator] = Adaptive if name in ADAPTIVE else FixedGrid
    return _named(
        name,
        base,
        {
            "order": tableau.order,
            "tableau": tableau,
            "A": tableau.A,
            "B": tableau.B,
            "__doc__": f"torchdiffeq's `{name}`, order {tableau.order}: {tableau.source}\n\n{base.__doc__}",
        },
    )


def _named(name: str, base: type[Integrator], namespace: dict[str, Any]) -> type[Integrator]:
    namespace |= {"name": name, "__module__": __name__}
    return dataclass(frozen=True)(type(_class_name(name), (base,), namespace))


def _class_name(method: str) -> str:
    return method.title().replace("_", "")


def __getattr__(name: str) -> type[Integrator]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    for method in (*ADAPTIVE, *FIXED, *MULTISTEP):
        if name == _class_name(method):
            return torchdiffeq_method(method)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


# step-size control --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Adaptive(RungeKutta):
    """An adaptive Runge–Kutta method of torchdiffeq.

    The trajectories of a batch share their steps; if that fails, each is integrated by itself. Without `t_eval` the
    states are reported every `system.dt`; the dense output integrates again up to the times that it is asked for.
    Events are located on a shorter step of the method from the beginning of the step that they fall into.

    Parameters
    ----------
    rtol, atol : float
        The local error, in the root mean square over the batch, is kept below atol + rtol·|y|; torchdiffeq's defaults.
    """

    rtol: float = 1e-7
    atol: float = 1e-9

    tableau: ClassVar[Tableau]
    finds_events: ClassVar[bool] = True

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        if self.tableau.carries_slope:
            raise TypeError(
                f"`method` {self.name!r} is no one-step map in torchdiffeq, which carries a slope from step to step: "
                "volume and symplecticity have no meaning for it. Use 'heun2', or 'dopri5'."
            )
        return super().tangent(system, t, y, h)

    def run(self, problem: Problem) -> Outcome:
        t_eval, search = problem.t_eval, problem.events
        stats: dict[str, Any] = {}
        if t_eval is None:
            t_eval = Grid(problem.t0, problem.t1, problem.system.dt).outputs(None, problem.save_every)[0]
            stats["output_step"] = problem.system.dt
        failure, cost = None, 0
        if search is not None:
            failure, cost = self._search(problem, search)
            if search.end is not None:
                t_eval = t_eval[(t_eval - search.end[0]) * (1 if problem.t1 >= problem.t0 else -1) <= 0]
        y, record, stopped = self._integrate(problem.system, problem.t0, t_eval, problem.y0)
        failure = failure or stopped
        if failure and problem.y0.ndim > 1:
            return self._one_by_one(problem, t_eval, stats)
        stats |= {
            "n_steps": record.n_steps,
            "force_evaluations": record.evaluations + cost,
            "hessian_evaluations": 0,
            "backend": "torchdiffeq",
        }
        status = np.zeros(problem.y0.shape[:-1], dtype=int) if problem.y0.ndim > 1 else -int(bool(failure))
        outcome = Outcome(t_eval[: len(y)], y, status, failure or FINISHED, stats)
        if search is not None and search.end is not None:
            outcome.status, outcome.message = 1, ENDED
            if problem.t_eval is None and not (len(t_eval) and t_eval[-1] == search.end[0]):
                outcome.t = np.append(t_eval, search.end[0])
                outcome.y = _append(y, search.end[1])
        if problem.dense_output:
            outcome.sol = _Again(self, problem)
        return outcome

    def _one_by_one(self, problem: Problem, t_eval: np.ndarray, stats: dict[str, Any]) -> Outcome:
        """A batch, some of whose trajectories fail: each by itself, with NaN after its last finite state."""
        batch = problem.y0.shape[:-1]
        stats |= {"n_steps": 0, "force_evaluations": 0, "hessian_evaluations": 0, "backend": "torchdiffeq"}
        rows, status, message = [], np.zeros(batch, dtype=int), FINISHED
        for index in np.ndindex(batch):
            start = problem.y0[index]
            y, record, failure = self._integrate(problem.system, problem.t0, t_eval, start)
            stats["n_steps"] += record.n_steps
            stats["force_evaluations"] += record.evaluations
            if failure:
                status[index] = -1
                message = message if message != FINISHED else f"Trajectory {', '.join(map(str, index))}: {failure}"
            missing = [full_of_nan(start)] * (len(t_eval) - len(y))
            rows.append(stack([*y, *missing], axis=0))
        y = stack(rows, axis=1).reshape(len(t_eval), *problem.y0.shape)
        outcome = Outcome(t_eval, y, status, message, stats)
        if problem.dense_output:
            outcome.sol = _Again(self, problem)
        return outcome

    def _search(self, problem: Problem, search: EventSearch) -> tuple[str | None, int]:
        """Run once for the events; why it failed, if it did, and the force evaluations that it took."""
        system, t1 = problem.system, problem.t1
        direction = 1 if t1 >= problem.t0 else -1

        def visit(t_old: float, y_old: Array, t: float, y: Array) -> bool:
            if (t - t1) * direction > 0:  # the last step reaches beyond the end
                t, y = t1, self.step(system, t_old, y_old, t1 - t_old)
            return bool(search.step(t_old, y_old, t, y, lambda s: self.step(system, t_old, y_old, s - t_old)))

        _, record, failure = self._integrate(system, problem.t0, np.array([t1]), problem.y0, visit=visit)
        if record.last is not None and search.end is None and not failure:
            t, y, dt = record.last
            visit(t, y, t + math.copysign(dt, direction), y)
        elif t1 == problem.t0:
            search.step(t1, problem.y0, t1, problem.y0, lambda s: problem.y0)
        return (None if search.end else failure), record.evaluations + search.n_dense * len(self.B)

    def _integrate(
        self,
        system: HamiltonianSystem,
        t0: float,
        times: np.ndarray,
        y0: Array,
        keep: bool = False,
        visit: Any = None,
    ) -> tuple[Array, _Record, str | None]:
        """States at `times` (sorted, repeats allowed), the record of the run, and why it failed if it did."""
        import torch
        from torchdiffeq import odeint

        tensor = is_tensor(y0)
        y_start = y0 if tensor else torch.from_numpy(np.ascontiguousarray(y0))
        sign = 1 if times.size == 0 or times[-1] >= t0 else -1
        distinct, position = np.unique(sign * np.append(t0, times), return_inverse=True)
        distinct = sign * distinct
        record, failure = _Record(system, keep, visit, tensor, (t0, float(times[-1]) if times.size else t0)), None
        with torch.set_grad_enabled(tensor and torch.is_grad_enabled()):
            while True:
                if len(distinct) == 1:
                    y = y_start[None]
                    break
                t = torch.as_tensor(distinct, dtype=y_start.dtype, device=y_start.device)
                try:
                    y = odeint(record, y_start, t, rtol=self.rtol, atol=self.atol, method=self.name)
                    break
                except _Ended:
                    return y_start[None], record, None
                except AssertionError as error:  # torchdiffeq's step underflow, or a state that is not finite
                    reached = t0 if record.reached is None else record.reached
                    failure = (
                        failure or f"torchdiffeq stopped after t = {reached:.17g} ({error}). End `t_span` earlier."
                    )
                    if visit is not None:
                        return y_start[None], record, failure
                    distinct = distinct[(distinct - reached) * sign <= 0][: len(distinct) - 1]
                    record = _Record(system, keep, span=(t0, float(distinct[-1])))
        kept = position[1:][position[1:] < len(distinct)]
        y = y[torch.as_tensor(kept)]
        return (y if tensor else y.numpy()), record, failure

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        y0 = to_numpy(y0)
        _, record, _ = self._integrate(system, t_span[0], np.array([t_span[1]]), y0, keep=True)
        for t, y, dt in record.steps:
            h = math.copysign(dt, t_span[1] - t_span[0])
            yield np.array([t]), y[None], np.full((1, *y0.shape[:-1]), h)


class _Ended(Exception):
    """Raised in a callback to leave torchdiffeq's loop at a terminal event."""


class _Record:
    """The right-hand side given to torchdiffeq, counting its calls and following the accepted steps.

    torchdiffeq announces a step by its beginning and length; its end is the beginning of the next.
    """

    def __init__(
        self,
        system: HamiltonianSystem,
        keep: bool = False,
        visit: Any = None,
        tensor: bool = True,
        span: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.span = span
        self.system, self.keep, self.visit, self.tensor = system, keep, visit, tensor
        self.evaluations = self.n_steps = 0
        self.reached: float | None = None
        self.last: tuple[float, Array, float] | None = None
        self.steps: list[tuple[float, np.ndarray, float]] = []

    def __call__(self, t: Any, y: Any) -> Any:
        self.evaluations += 1
        return self.system.vector_field(y)

    def callback_accept_step(self, t: Any, y: Any, dt: Any) -> None:
        self.n_steps += 1
        self.reached = float(t.detach())
        if stuck := hopeless(self.n_steps, self.span[0], self.reached, self.span[1]):
            raise AssertionError(stuck)
        if self.keep:
            self.steps.append((self.reached, to_numpy(y), abs(float(dt.detach()))))
        if self.visit is not None:
            state = y if self.tensor else y.numpy()
            if self.last is not None and self.visit(*self.last[:2], self.reached, state):
                raise _Ended
            self.last = (self.reached, state, abs(float(dt.detach())))


class _Again:
    """Dense output by integrating again: the states at t are those that `t_eval=t` would have given."""

    def __init__(self, integrator: Adaptive, problem: Problem) -> None:
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


def _append(y: Array, last: Array) -> Array:
    if is_tensor(y):
        import torch

        return torch.cat([y, last[None]])
    return np.concatenate([y, last[None]])


# fixed steps --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FixedGrid(ExplicitStep, FixedStep):
    """A fixed-step Runge–Kutta method of torchdiffeq.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    """

    tableau: ClassVar[Tableau]

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        """One call of `odeint` for each stretch between saved states, in the time s = (t − t0)/h, where h is exact."""
        import torch
        from torchdiffeq import odeint

        tensor = is_tensor(problem.y0)
        y = problem.y0 if tensor else torch.from_numpy(np.ascontiguousarray(problem.y0))
        states, k = [], 0
        finite = np.full(y.shape[:-1], n_steps)

        def scaled(s: Any, y: Any) -> Any:
            return h * problem.system.vector_field(y)

        with torch.set_grad_enabled(tensor and torch.is_grad_enabled()):
            for target in save.tolist():
                while k < target:
                    n = min(target - k, 64)
                    if (finite == n_steps).any():
                        block = odeint(scaled, y, torch.arange(n + 1, dtype=y.dtype, device=y.device), method=self.name)
                        ok = to_numpy(all_finite(block))
                        finite = np.where((finite == n_steps) & ~ok[-1], k + np.argmin(ok, axis=0) - 1, finite)
                        y = block[-1]
                    k += n
                states.append(y)
        out = torch.stack(states) if states else y[None][:0]
        return (out if tensor else out.numpy()), finite, "torchdiffeq"

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return {"force_evaluations": len(self.B) * (n_steps + n_extra), "hessian_evaluations": 0}


@dataclass(frozen=True)
class Adams(Integrator):
    """A multistep method on the grid t0 + k·dt, begun with Runge–Kutta steps; cubic interpolation in between.

    It has no one-step map: there is no bare step, no volume to measure, and events are not sought.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    max_order : int
        Highest order that is built up, at least 4; torchdiffeq's own default of 12 is unstable for dt of ordinary size.
    """

    dt: float | None = None
    max_order: int = 4

    symplectic: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_dt(self.dt)
        if self.max_order not in range(4, 13):
            raise ValueError(f"`max_order` must be an integer from 4 to 12; got {self.max_order!r}.")

    def step_length(self, system: HamiltonianSystem) -> float:
        return float(self.dt if self.dt is not None else system.dt)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        raise TypeError(
            f"`method` {self.name!r} is a multistep method, with no bare step to repeat or differentiate: use a "
            "one-step method."
        )

    def run(self, problem: Problem) -> Outcome:
        import torch

        grid = Grid(problem.t0, problem.t1, self.step_length(problem.system))
        times = grid.outputs(problem.t_eval, problem.save_every)[0]
        record = _Record(problem.system)
        tensor = is_tensor(problem.y0)
        with torch.set_grad_enabled(tensor and torch.is_grad_enabled()):
            y = self._integrate(record, problem.y0, grid, times)
        ok = to_numpy(all_finite(y))
        status: Any = -(~ok).any(0).astype(int)
        outcome = Outcome(times, y if tensor else y.numpy(), status if y.ndim > 2 else int(status), FINISHED, {})
        if not ok.all():
            first = int(np.argmin(ok.reshape(len(ok), -1).all(1)))
            since = problem.t0 if first == 0 else float(times[first - 1])
            outcome.message = f"The solution became non-finite after t = {since:.17g}. Reduce `dt`."
            if y.ndim == 2:
                outcome.t, outcome.y = outcome.t[:first], outcome.y[:first]
        outcome.stats = {
            "dt": abs(grid.h),
            "n_steps": grid.n_steps + bool(grid.remainder),
            "force_evaluations": record.evaluations,
            "hessian_evaluations": 0,
            "backend": "torchdiffeq",
        }
        if problem.dense_output:
            outcome.sol = lambda t: self._dense(problem, grid, t)
        return outcome

    def _integrate(self, record: _Record, y0: Array, grid: Grid, times: np.ndarray) -> Any:
        """States at `times`, sorted in the direction of the run, as a tensor."""
        import torch
        from torchdiffeq import odeint

        y = y0 if is_tensor(y0) else torch.from_numpy(np.ascontiguousarray(y0))
        if grid.t1 == grid.t0:
            return y.expand(len(times), *y.shape)
        nodes = np.append(grid.t0 + np.arange(grid.n_steps + bool(grid.remainder)) * grid.h, grid.t1)
        distinct, position = np.unique(np.abs(np.array([grid.t0, *times, grid.t1]) - grid.t0), return_inverse=True)
        sign = math.copysign(1.0, grid.h)
        t, steps = (torch.as_tensor(s, dtype=y.dtype) for s in (distinct, np.abs(nodes - grid.t0)))
        states = odeint(
            lambda s, x: sign * record(s, x),
            y,
            t,
            method=self.name,
            rtol=1e-7,
            atol=1e-9,
            options={"grid_constructor": lambda f, y0, t: steps, "interp": "cubic", "max_order": self.max_order},
        )
        return states[torch.as_tensor(position[1:-1])]

    def _dense(self, problem: Problem, grid: Grid, t: Any) -> Array:
        times = np.atleast_1d(np.asarray(t, dtype=float))
        order = np.argsort(np.abs(times - grid.t0))
        y = self._integrate(_Record(problem.system), problem.y0, grid, times[order])[np.argsort(order)]
        y = y.movedim(0, -1) if is_tensor(problem.y0) else np.moveaxis(y.numpy(), 0, -1)
        return y[..., 0] if np.ndim(t) == 0 else y
