"""torchdiffeq's solvers as integrators, by name: batches in one tensor, gradients by backpropagation.

Their loop is watched step by step through torchdiffeq's callbacks.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_dt
from sympflow.arrays import (
    Array,
    as_tensor,
    differentiable,
    full_of_nan,
    of_library,
    readable,
    stack,
    to_numpy,
    transformed,
)
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, OwnSteps, Recorder
from sympflow.integrators.contract import (
    ENDED,
    ByVectorField,
    Integrator,
    Outcome,
    Problem,
    Steps,
    finished,
    method_class,
)
from sympflow.integrators.grid import Grid
from sympflow.integrators.impulses import pieces_of
from sympflow.integrators.interpolants import THIRDS, Batch, Interpolant, Piecewise
from sympflow.integrators.loops import stepper_of
from sympflow.integrators.runge_kutta import ExplicitStep, RungeKutta, hopeless, weighted
from sympflow.integrators.steppers import Stepper
from sympflow.integrators.tableaux import ADAPTIVE, FIXED, MULTISTEP, Tableau

Visit = Callable[[Interpolant], bool]  # takes a step as soon as it is accepted; whether the run ends in it


class Trace:
    """The right-hand side that torchdiffeq is given, in elapsed time: it counts its calls and announces the steps."""

    def __init__(
        self, method: Any, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array, visit: Visit
    ) -> None:
        self.method, self.system, self.visit, self.t_span = method, system, visit, t_span
        self.direction = math.copysign(1.0, t_span[1] - t_span[0])
        self.y0 = y0
        self.evaluations = self.n_steps = 0
        self.reached = t_span[0]
        self.last: Array | None = None  # the state at the beginning of the step that ended there
        self.note = ""  # for the message, when the run ends
        self.most_steps: int | None = None
        self.n_tried = 0  # steps, where they are bounded, with those that were rejected
        self.failed = False
        self.spent = False  # whether it failed because it took too many steps

    def __call__(self, s: Any, y: Any) -> Any:
        self.evaluations += 1
        f = self.system.vector_field(y, self.time(s))
        self.evaluated(y, f)
        return f if self.direction > 0 else -f

    def time(self, s: Any) -> Any:
        """The time at which a time has elapsed."""
        return self.t_span[0] + self.direction * s.double()

    def evaluated(self, y: Any, f: Any) -> None:
        """Called with the slope f at each state y where torchdiffeq evaluates it."""

    def array(self, x: Any) -> Array:
        """A tensor of torchdiffeq's in the form that the user gave."""
        return of_library(x, self.y0)

    def announce(self, step: Interpolant) -> None:
        self.n_steps += 1
        self.reached, self.last = step.t1, step.y0
        if stuck := hopeless(self.n_steps, self.t_span[0], self.reached, self.t_span[1], 2**31):
            raise AssertionError(stuck)
        if self.visit(step):
            raise _EndedError


class _Stages(Trace):
    """Collects the slopes of each step: torchdiffeq interpolates from them."""

    def __init__(self, method: Adaptive, *arguments: Any) -> None:
        super().__init__(method, *arguments)
        self.tableau = method.tableau
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
        if not differentiable(s, dt):
            s, dt = float(s), float(dt)
        t0, t1 = (self.t_span[0] + self.direction * x for x in (s, s + dt))
        self.first = self.slopes[-1]
        self.announce(Interpolant(t0, t1, y, lambda: self._inside(t0, t1, y, K)))

    def _inside(self, t0: Any, t1: Any, y: Array, K: list[Array]) -> tuple[list[Array], list[Array]]:
        """The states and slopes of a step that it is interpolated from."""
        h, tableau = t1 - t0, self.tableau
        states, slopes = [y, y + h * weighted(tableau.B, K)], [K[0], K[-1]]
        if tableau.middle:
            states.append(y + h * weighted(tableau.middle, K))
        elif tableau.order > 3:  # of a cubic
            states += [self.method.step(self.system, t0, y, x * h) for x in THIRDS]
            slopes += [self.system.vector_field(z, t0 + x * h) for x, z in zip(THIRDS, states[2:], strict=True)]
            self.evaluations += len(THIRDS) * (len(tableau.B) + 1)
        return states, slopes


class _Nodes(Trace):
    """Follows the grid: the first slope that is asked for in a step is that at its beginning."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        grid = Grid(*self.t_span, self.method.step_length(self.system))
        self.times = [grid.t0 + k * grid.h for k in range(grid.n_steps + bool(grid.remainder))] + [grid.t1]
        self.before: tuple[Array, Array] | None = None
        self.begins = False

    def callback_step(self, s: Any, y: Any, dt: Any) -> None:
        self.begins = True

    def evaluated(self, y: Any, f: Any) -> None:
        if not self.begins:
            return
        self.begins = False
        if not (y.isfinite().all() and f.isfinite().all()):
            raise AssertionError("the state is not finite; reduce `dt`")
        y, f = self.array(y), self.array(f)
        before, self.before = self.before, (y, f)
        if before is not None:
            k = self.n_steps
            values = (before[0], y), (before[1], f)
            self.announce(Interpolant(self.times[k], self.times[k + 1], before[0], lambda: values))


class _EndedError(Exception):
    """Raised to leave torchdiffeq's loop at a terminal event."""


class TooManyStepsError(Exception):
    """Raised by `integrate` at a limit of the number of steps; the message names the remedy."""


class Watched(ByVectorField):
    """A method of torchdiffeq that interpolates: outputs, events and dense output are one polynomial in each step."""

    finds_events: ClassVar[bool] = True
    trace: ClassVar[type[Trace]]
    max_num_steps: ClassVar[int | None] = None  # of a call, those that are tried and rejected included

    def outputs(self, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
        """The times to report, and the statistics of the steps."""
        raise NotImplementedError

    def integrate(self, trace: Trace, y: Any, length: float) -> None:
        """Run torchdiffeq from the tensor y over an elapsed time."""
        raise NotImplementedError

    def watch(
        self,
        system: HamiltonianSystem,
        t_span: tuple[float, float],
        y0: Array,
        visit: Visit,
        most_steps: int | None = None,
    ) -> tuple[Trace, str | None]:
        """Run and pass every step to `visit` until it returns True; return the reason of a failure, if any."""
        import torch

        trace, failure = self.trace(self, system, t_span, y0, visit), None
        trace.most_steps = self.max_num_steps if most_steps is None else most_steps
        if t_span[0] == t_span[1]:
            return trace, failure
        y = as_tensor(y0)
        with torch.set_grad_enabled(y is y0 and torch.is_grad_enabled()), np.errstate(all="ignore"):
            try:
                self.integrate(trace, y, abs(t_span[1] - t_span[0]))
            except _EndedError:
                pass
            except AssertionError as error:  # torchdiffeq's step underflow, or a state that is not finite
                failure = f"torchdiffeq stopped after t = {trace.reached:.15g} ({error}). End `t_span` earlier."
            except TooManyStepsError as error:
                failure, trace.spent = str(error), True
            except RuntimeError as error:  # their own autograd.Function has derivatives in reverse mode only
                if not transformed(y):
                    raise
                raise TypeError(
                    f"`method` {self.name!r} of torchdiffeq cannot be run in forward mode or inside torch.func: use "
                    "torch.autograd.grad, or a method of fixed steps, such as 'rk4'."
                ) from error
        return trace, failure

    def run(self, problem: Problem) -> Outcome:
        if not readable(problem.y0):
            raise TypeError(
                f"`method` {self.name!r} chooses its steps by the values of the states, which torch.func.vmap and "
                "torch.compile hide: pass the states as a batch y0, or use a method of fixed steps, such as 'rk4'."
            )
        times, stats = self.outputs(problem)
        outcome, trace = self.run_jointly(problem, times)
        if trace.failed and problem.y0.ndim > 1 and not trace.spent:
            outcome = run_in_parts(self, problem, outcome, trace)
        outcome.stats = stats | outcome.stats
        return outcome

    def run_jointly(self, problem: Problem, times: np.ndarray, most_steps: int | None = None) -> tuple[Outcome, Trace]:
        """All trajectories with the same steps, at the times (n,); with NaN in a batch after the last finite state."""
        t0, y0 = problem.t0, problem.y0
        sign = 1 if problem.t1 >= t0 else -1
        everything = problem.t_eval is None or problem.dense_output or problem.events is not None
        t_end = problem.t1 if everything else float(times[-1]) if times.size else t0
        record, kept = Recorder(problem, times), list[Interpolant]()

        def visit(step: Interpolant) -> bool:
            t = step.t1 if (step.t1 - t_end) * sign < 0 else t_end  # the last step reaches beyond the end
            record.take(step.t0, step.y0, t, None, step)
            if problem.dense_output:
                kept.append(step)
            return record.end is not None

        trace, failure = self.watch(problem.system, (t0, t_end), y0, visit, most_steps)
        if t0 == t_end:
            record.empty(t0, y0)
        states = record.outputs
        stats: dict[str, Any] = dict(zip(COUNTS, (trace.n_steps, trace.evaluations, 0), strict=True))
        stats["backend"] = "torchdiffeq"
        ended = record.end is not None
        trace.failed = bool(failure) and not ended
        if trace.failed:
            t_end = trace.reached
            stats["failed_at"] = t_end if y0.ndim == 1 else np.full(y0.shape[:-1], t_end)
        if y0.ndim > 1:
            states += [full_of_nan(y0)] * (len(times) - len(states))
        times = times[: len(states)]
        if record.end is not None:
            t_end = record.end[0]
            if problem.t_eval is None and not (times.size and times[-1] == t_end):
                times, states = np.append(times, t_end), [*states, record.end[1]]
        status: Any = 1 if ended else -int(bool(failure))
        message = (ENDED if status == 1 else failure or finished(problem)) + trace.note
        y = stack(states, axis=0) if states else y0[None][:0]
        outcome = Outcome(times, y, np.full(y0.shape[:-1], status) if y0.ndim > 1 else status, message, stats)
        if problem.dense_output:
            outcome.sol = Piecewise(kept, y0, t0, t_end)
        return outcome, trace


COUNTS = ("n_steps", "force_evaluations", "hessian_evaluations")


def run_in_parts(method: Watched, problem: Problem, joint: Outcome, trace: Trace) -> Outcome:
    """The outcome of a batch that failed when run jointly."""
    batch, times = problem.y0.shape[:-1], joint.t
    rows = problem.y0.reshape(-1, problem.y0.shape[-1])
    n = len(rows)
    whole = replace(joint, y=joint.y.reshape(len(times), *rows.shape))
    source: list[tuple[Outcome, int]] = [
        (whole, i) for i in range(n)
    ]  # of each trajectory its run, and its place there
    reached = np.full(n, trace.reached)
    done, unfinished = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    counts = {key: joint.stats[key] for key in COUNTS}
    left = None if method.max_num_steps is None else method.max_num_steps - trace.n_tried
    parts = deque(_divided(problem, np.arange(n), trace))
    while parts:
        part = parts.popleft()
        if left is not None and left <= 0:
            unfinished[part] = True
            continue
        outcome, trace = method.run_jointly(replace(problem, y0=rows[part], t_eval=times), times, left)
        left = None if left is None else left - trace.n_tried
        counts = {key: counts[key] + outcome.stats[key] for key in COUNTS}
        if not trace.failed or abs(trace.reached - problem.t0) >= abs(reached[part[0]] - problem.t0):
            reached[part] = trace.reached
            for j, i in enumerate(part.tolist()):
                source[i] = outcome, j
        done[part] = not trace.failed
        unfinished[part] = trace.failed and trace.spent
        if trace.failed and not trace.spent:
            parts.extend(_divided(problem, part, trace))

    stats: dict[str, Any] = {**counts, "backend": "torchdiffeq"}
    if not done.all():
        stats["failed_at"] = np.where(done, np.nan, reached).reshape(batch)
    said = []
    if len(failed := np.flatnonzero(~done & ~unfinished)):
        said.append(f"Trajectory {_index(failed[0], batch)}: {source[failed[0]][0].message}")
    if unfinished.any():
        first = np.argmax(unfinished)
        said.append(
            f"`max_num_steps` = {method.max_num_steps} steps, in sum over the batch and the parts that it was run in "
            f"because some of its trajectories fail, ended before {unfinished.sum()} of {n} trajectories: they are "
            f"kept up to where they were, trajectory {_index(first, batch)} up to t = {reached[first]:.15g}. Raise "
            "`max_num_steps`, or solve those that fail in another call, or end `t_span` before they do."
        )
    y = stack([run.y[:, j] for run, j in source], axis=1).reshape(len(times), *problem.y0.shape)
    status = np.where(done, 0, -1).reshape(batch)
    outcome = Outcome(times, y, status, " ".join(said) or finished(problem), stats)
    if problem.dense_output:
        outcome.sol = Batch([(run.sol, j) for run, j in source], batch, (problem.t0, problem.t1))
    return outcome


def _divided(problem: Problem, part: np.ndarray, trace: Trace) -> list[np.ndarray]:
    """Two parts of one, by the rates |f|/|y| of its trajectories in the last state before it failed."""
    if len(part) < 2:
        return []
    y = trace.last
    rates = np.zeros(len(part))
    if y is not None:
        with np.errstate(all="ignore"):
            f = to_numpy(problem.system.vector_field(y, trace.reached)).reshape(len(part), -1)
            rates = np.nan_to_num(np.abs(f).max(-1) / np.abs(to_numpy(y)).reshape(f.shape).max(-1), nan=np.inf)
    order = np.argsort(rates, kind="stable")
    with np.errstate(all="ignore"):
        gaps = np.nan_to_num(rates[order[1:]] / rates[order[:-1]], nan=1.0)
    cut = int(np.argmax(gaps)) + 1 if gaps.max() > 10 else len(part) // 2
    return [np.sort(part[order[:cut]]), np.sort(part[order[cut:]])]


def _index(i: Any, batch: tuple[int, ...]) -> str:
    return ", ".join(str(k) for k in np.unravel_index(int(i), batch))


@dataclass(frozen=True)
class Adaptive(Watched, RungeKutta):
    """An adaptive Runge–Kutta method of torchdiffeq.

    The trajectories of a batch share their steps; if that fails, it is run in parts, so that those of its trajectories
    that can reach their end do. Without `t_eval` the
    states are reported every `system.dt`. Between the steps, for outputs, events and the dense output alike, the state
    is a polynomial through both ends with their slopes: of "dopri5" torchdiffeq's quartic, through the middle as well,
    and of "dopri8" that of degree 7, through steps to the thirds: torchdiffeq's own quartic is far less exact.

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
    max_num_steps: int = 5_000  # type: ignore[misc]
    tableau: ClassVar[Tableau]
    trace: ClassVar[type[Trace]] = _Stages

    def __post_init__(self) -> None:
        super().__post_init__()
        most = self.max_num_steps
        if isinstance(most, bool) or not isinstance(most, int | np.integer) or not 0 < most < 2**31:
            raise ValueError(f"`max_num_steps` must be a positive integer below 2**31; got {most!r}.")

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        if self.tableau.carries_slope:
            raise TypeError(
                f"`method` {self.name!r} is not a one-step map in torchdiffeq, which reuses a slope of the step "
                "before: volume and symplecticity have no meaning for it. Use 'heun2', or 'dopri5'."
            )
        return super().tangent(system, t, y, h)

    def outputs(self, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
        if problem.t_eval is not None:
            return problem.t_eval, {}
        dt = problem.system.dt
        return Grid(problem.t0, problem.t1, dt).outputs(None, problem.save_every), {"output_step": dt}

    def output_step(self, problem: Problem) -> float:
        return problem.system.dt

    def integrate(self, trace: Trace, y: Any, length: float) -> None:
        import torch
        from torchdiffeq import odeint

        s = torch.tensor([0.0, length], dtype=torch.float64, device=y.device)
        most = trace.most_steps or self.max_num_steps
        options: dict[str, Any] = {"max_num_steps": most}
        if trace.system.shortest_piece < math.inf:
            options["max_step"] = trace.system.shortest_piece
        if trace.system.definition.may_jump:
            options["step_t"] = s[1:]  # the last step would be longer, and meet a jump beyond
        atol = self.tolerance_of(trace.system, y)
        try:
            odeint(trace, y, s, rtol=self.rtol, atol=atol, method=self.name, options=options)
        except AssertionError:
            if trace.n_tried < most:
                raise
            (t0, t1), t = trace.t_span, trace.reached
            more = most * abs(t1 - t) / abs(t - t0) if t != t0 else math.inf
            raise TooManyStepsError(
                f"After `max_num_steps` = {self.max_num_steps} steps t = {t:.15g} is reached, and at this pace the end "
                f"needs about {more:.2g} more. Raise `max_num_steps` or the tolerances, or end `t_span` earlier."
            ) from None

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        y0, steps = to_numpy(y0), []

        def visit(step: Interpolant) -> bool:
            steps.append(step)
            return False

        for piece in pieces_of(self, system, *t_span):
            self.watch(system, piece, y0, visit)
            y0 = steps[-1](piece[1]) if steps else y0
        for step in steps:
            yield np.array([step.t0]), step.y0[None], np.full((1, *y0.shape[:-1]), step.t1 - step.t0)


@dataclass(frozen=True)
class Adams(Watched):
    """A multistep method on the grid t0 + k·dt, begun with Runge–Kutta steps; cubic interpolation in between.

    It has no one-step map: there is no bare step, and no volume to measure.

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
    trace: ClassVar[type[Trace]] = _Nodes

    def __post_init__(self) -> None:
        check_dt(self.dt)
        if not isinstance(self.max_order, int | np.integer) or self.max_order not in range(4, 13):
            raise ValueError(f"`max_order` must be an integer from 4 to 12; got {self.max_order!r}.")

    def step_length(self, system: HamiltonianSystem) -> float:
        return float(self.dt if self.dt is not None else system.dt)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        raise TypeError(
            f"`method` {self.name!r} is a multistep method, with no bare step to repeat or differentiate: use a "
            "one-step method."
        )

    def outputs(self, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
        dt = self.step_length(problem.system)
        return Grid(problem.t0, problem.t1, dt).outputs(problem.t_eval, problem.save_every), {"dt": dt}

    def integrate(self, trace: Any, y: Any, length: float) -> None:
        import torch
        from torchdiffeq import odeint

        nodes = torch.as_tensor(np.abs(np.array(trace.times) - trace.times[0]), device=y.device)
        options = {"grid_constructor": lambda f, y0, t: nodes, "max_order": self.max_order}
        smallest = min(
            (float(x) for x in abs(y.detach()).reshape(-1, 2, y.shape[-1] // 2).amax((0, 2)) if x > 0), default=1
        )
        how = {"method": self.name, "rtol": 1e-7, "atol": 1e-9 * smallest}  # of the functional iteration
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always")
            states = odeint(trace, y, nodes[[0, -1]], options=options, **how)
        for warning in raised:
            if str(warning.message).startswith("Functional iteration did not converge"):
                trace.note = " Its functional iteration did not converge in every step: reduce `dt`."
            else:
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        trace.callback_step(None, None, None)
        trace(nodes[-1], states[-1])


@cache
def torchdiffeq_method(name: str) -> type[Integrator]:
    """The integrator class of torchdiffeq's solver of that name."""
    if name in MULTISTEP:
        first = (Adams.__doc__ or "").partition("\n")[0]
        own: dict[str, Any] = {"order": MULTISTEP[name], "source": f"torchdiffeq's `{name}`: {first}"}
        return method_class(Adams, _class_name(name), __name__, name=name, **own)
    tableau = (ADAPTIVE | FIXED)[name]
    base: type[Integrator] = Adaptive if name in ADAPTIVE else FixedGrid
    source = f"torchdiffeq's `{name}`, order {tableau.order}: {tableau.source}"
    own = {"order": tableau.order, "tableau": tableau, "A": tableau.A, "B": tableau.B, "source": source}
    return method_class(base, _class_name(name), __name__, name=name, **own)


def _class_name(method: str) -> str:
    return method.title().replace("_", "")


def __getattr__(name: str) -> type[Integrator]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    for method in (*ADAPTIVE, *FIXED, *MULTISTEP):
        if name == _class_name(method):
            return torchdiffeq_method(method)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@dataclass(frozen=True)
class FixedGrid(ExplicitStep, FixedStep):
    """A fixed-step Runge–Kutta method with torchdiffeq's name and table; compiled for arrays where H is symbolic.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    """

    compiles: ClassVar[bool] = True
    follows: ClassVar[bool] = True
    tableau: ClassVar[Tableau]

    def own_stepper(self, problem: Problem) -> Stepper:
        make = partial(self.compiled, problem.system, "explicit_kernel", self.tableau)
        return stepper_of(self, problem, OwnSteps(self, problem), make)

    def oscillation_error(self, z: np.ndarray) -> np.ndarray:
        K: list[np.ndarray] = []
        for row in self.A[: len(self.B)]:
            K.append(1j * z * (1 + (weighted(row, K) if K else 0.0)))
        return np.abs(1 + weighted(self.B, K) - np.exp(1j * z)) / z

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return {"force_evaluations": len(self.B) * (n_steps + n_extra), "hessian_evaluations": 0}
