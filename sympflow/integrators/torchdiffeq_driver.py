"""What torchdiffeq's adaptive and multistep methods share: its loop, watched step by step through its callbacks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from sympflow.arrays import Array, full_of_nan, is_tensor, stack
from sympflow.events import ENDED
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FINISHED, Integrator, Outcome, Problem
from sympflow.integrators.interpolants import Interpolant, Piecewise
from sympflow.integrators.runge_kutta import hopeless
from sympflow.integrators.torchdiffeq_batches import run_in_parts

Visit = Callable[[Interpolant], bool]
"""Takes a step as soon as it is accepted; whether the run ends in it."""


class Trace:
    """The right-hand side that torchdiffeq is given, in elapsed time: it counts its calls and announces the steps.

    A subclass makes the interpolant of a step from what torchdiffeq's public callbacks tell.
    """

    def __init__(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array, visit: Visit) -> None:
        self.system, self.visit, self.t_span = system, visit, t_span
        self.direction = math.copysign(1.0, t_span[1] - t_span[0])
        self.tensor = is_tensor(y0)
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
        f = self.system.vector_field(y)
        self.evaluated(y, f)
        return f if self.direction > 0 else -f

    def evaluated(self, y: Any, f: Any) -> None:
        """Called with the slope f at each state y where torchdiffeq asks for it."""

    def array(self, x: Any) -> Array:
        """A tensor of torchdiffeq's as what the user gave."""
        return x if self.tensor else x.numpy()

    def announce(self, step: Interpolant) -> None:
        self.n_steps += 1
        self.reached, self.last = step.t1, step.y0
        if stuck := hopeless(self.n_steps, self.t_span[0], self.reached, self.t_span[1]):
            raise AssertionError(stuck)
        if self.visit(step):
            raise _EndedError


class _EndedError(Exception):
    """Raised to leave torchdiffeq's loop at a terminal event."""


class TooManyStepsError(Exception):
    """Raised by `integrate` where a bound on the number of steps is met: the message says so, and the remedy."""


class Watched(Integrator):
    """A method of torchdiffeq that interpolates: outputs, events and dense output are one polynomial in each step."""

    finds_events: ClassVar[bool] = True

    def outputs(self, problem: Problem) -> tuple[np.ndarray, dict[str, Any]]:
        """The times to report, and what the statistics say of the steps."""
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
        """Run, handing over every step until `visit` says so; and why it failed, if it did."""
        import torch

        trace, failure = self.make_trace(system, t_span, y0, visit), None
        trace.most_steps = self.most_steps if most_steps is None else most_steps
        if t_span[0] == t_span[1]:
            return trace, failure
        y = y0 if is_tensor(y0) else torch.from_numpy(np.ascontiguousarray(y0))
        with torch.set_grad_enabled(is_tensor(y0) and torch.is_grad_enabled()), np.errstate(all="ignore"):
            try:
                self.integrate(trace, y, abs(t_span[1] - t_span[0]))
            except _EndedError:
                pass
            except AssertionError as error:  # torchdiffeq's step underflow, or a state that is not finite
                failure = f"torchdiffeq stopped after t = {trace.reached:.17g} ({error}). End `t_span` earlier."
            except TooManyStepsError as error:
                failure, trace.spent = str(error), True
        return trace, failure

    @property
    def most_steps(self) -> int | None:
        """Most steps of a call, those that are tried and rejected included; None if there is no bound."""
        return None

    def make_trace(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array, visit: Visit) -> Trace:
        raise NotImplementedError

    def run(self, problem: Problem) -> Outcome:
        times, stats = self.outputs(problem)
        outcome, trace = self.run_jointly(problem, times)
        if trace.failed and problem.y0.ndim > 1 and not trace.spent:
            outcome = run_in_parts(self, problem, outcome, trace)
        outcome.stats = stats | outcome.stats
        return outcome

    def run_jointly(self, problem: Problem, times: np.ndarray, most_steps: int | None = None) -> tuple[Outcome, Trace]:
        """All trajectories with the same steps, at the times (n,); with NaN in a batch after the last finite state."""
        t0, y0, search = problem.t0, problem.y0, problem.events
        sign = 1 if problem.t1 >= t0 else -1
        everything = problem.t_eval is None or problem.dense_output or search is not None
        t_end = problem.t1 if everything else float(times[-1]) if times.size else t0
        states = [y0 for t in times.tolist() if t == t0]
        kept: list[Interpolant] = []

        def visit(step: Interpolant) -> bool:
            t = step.t1 if (step.t1 - t_end) * sign < 0 else t_end  # the last step reaches beyond the end
            if search is not None:
                t = (search.step(step.t0, step.y0, t, step(t), step) or (t,))[0]
            while len(states) < len(times) and (times[len(states)] - t) * sign <= 0:
                states.append(step(float(times[len(states)])))
            if problem.dense_output:
                kept.append(step)
            return search is not None and search.end is not None

        trace, failure = self.watch(problem.system, (t0, t_end), y0, visit, most_steps)
        if search is not None and t0 == t_end:
            search.step(t0, y0, t0, y0, lambda t: y0)
        stats: dict[str, Any] = {
            "n_steps": trace.n_steps,
            "force_evaluations": trace.evaluations,
            "hessian_evaluations": 0,
            "backend": "torchdiffeq",
        }
        ended = search is not None and search.end is not None
        trace.failed = bool(failure) and not ended
        if trace.failed:
            t_end = trace.reached
            stats["failed_at"] = t_end if y0.ndim == 1 else np.full(y0.shape[:-1], t_end)
        if y0.ndim > 1:
            states += [full_of_nan(y0)] * (len(times) - len(states))
        times = times[: len(states)]
        if search is not None and search.end is not None:
            t_end = search.end[0]
            if problem.t_eval is None and not (times.size and times[-1] == t_end):
                times, states = np.append(times, t_end), [*states, search.end[1]]
        status: Any = 1 if ended else -int(bool(failure))
        outcome = Outcome(
            times,
            stack(states, axis=0) if states else y0[None][:0],
            np.full(y0.shape[:-1], status) if y0.ndim > 1 else status,
            (ENDED if status == 1 else failure or FINISHED) + trace.note,
            stats,
        )
        if problem.dense_output:
            outcome.sol = Piecewise(kept, y0, t0, t_end)
        return outcome, trace
