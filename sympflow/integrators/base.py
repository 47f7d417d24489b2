"""Integrators of fixed steps on the grid t0 + k·dt, and recorders of runs whose steps the method chooses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_dt
from sympflow.arrays import Array, beside, is_tensor, library_name, stack
from sympflow.events import EventSearch
from sympflow.hamiltonian.system import HamiltonianSystem, counting_view
from sympflow.integrators.contract import ENDED, Failure, Integrator, Interrupted, Outcome, Problem, Steps
from sympflow.integrators.grid import Grid
from sympflow.integrators.grid_runs import grid_run
from sympflow.integrators.impulses import pieces_of
from sympflow.integrators.steppers import ArraySteps, Stepper, rollout
from sympflow.kernels.protocol import RunCheckpoint


@dataclass(frozen=True)
class FixedStep(Integrator):
    """An integrator on the grid t0 + k·dt.

    Between grid points, at the times of `t_eval` or the dense output, and at the end of an interval that dt
    does not divide, the state is a shorter step from the last grid point: ψ_t = ψ_{t−k·dt} ∘ (ψ_dt)^k.

    Parameters
    ----------
    dt : float, optional
        Step length, positive; the default is `system.dt`.
    """

    dt: float | None = None
    finds_events: ClassVar[bool] = True
    on_grid: ClassVar[bool] = True
    follows: ClassVar[bool] = False
    """True if gradients flow to parameters through its compiled loops."""
    breakdown: ClassVar[Failure] = Failure.NON_FINITE
    """The meaning of a run that cannot go on."""

    def __post_init__(self) -> None:
        check_dt(self.dt)

    def check_followed(self, problem: Problem) -> None:
        if not self.follows or self.overrides("step"):
            super().check_followed(problem)

    def check_store(self) -> None:
        if self.in_another_time:
            raise ValueError(
                f"`store` keeps runs of equal steps in t, and those of method {self.name!r} are equal in another time: "
                "use one on the clock 'physical', or leave `store` out."
            )

    def step_length(self, system: HamiltonianSystem) -> float:
        """Return the step that is used for a system."""
        return float(self.dt if self.dt is not None else system.dt)

    def longest_step(self, system: HamiltonianSystem) -> float:
        """Return the longest step that is chosen for a tolerance."""
        return math.inf

    def doubt(self, system: HamiltonianSystem) -> str:
        """Return a warning of the method with its step on a system, or nothing."""
        return ""

    def oscillation_error(self, z: np.ndarray) -> np.ndarray:
        """Return by how much an oscillation of z radians in a step is wrong, (n,); 0 where any z is borne.

        It is the larger of the error of phase and size for each radian, and of the swing of the energy in a period.
        """
        return 0.0 * z

    def stepper(self, problem: Problem) -> Stepper:
        """Return the stepper of one run, for states such as the problem's y0."""
        self.check_library(problem.y0)
        cls = type(self)
        if not _overridden(cls):  # type: ignore[arg-type]
            return self.own_stepper(problem)
        inner = None if _steps_itself(cls) else self.own_stepper(problem)  # type: ignore[arg-type]
        return Stepper(self, problem, OwnSteps(self, problem, inner, _is_counted(cls)))  # type: ignore[arg-type]

    def own_stepper(self, problem: Problem) -> Stepper:
        """Return the stepper of one run of a class whose duties no subclass outside of the package overrides."""
        return Stepper(self, problem, OwnSteps(self, problem, None, _is_counted(type(self))))  # type: ignore[arg-type]

    @classmethod
    def overrides(cls, duty: str) -> bool:
        """Tell whether a class outside of the package defines a duty anew, such as "step"."""
        return duty in _overridden(cls)  # type: ignore[arg-type]

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Force and force-gradient evaluations of n_steps steps, n_saved saved states, n_extra shorter steps.

        A class that does not say, for the `step` that it defines, has them counted while it runs.
        """
        return {"force_evaluations": 0, "hessian_evaluations": 0}

    def checked_step(self, system: HamiltonianSystem, t: Any, y: Array, h: Any) -> Array:
        """`step`, with a specific message if it fails on tensors."""
        try:
            return self.step(system, t, y, h)
        except (TypeError, RuntimeError, AttributeError) as error:
            if not is_tensor(y) or _definer(type(self), "step").__module__.startswith("sympflow."):
                raise
            raise TypeError(
                f"`method` {self.name!r} cannot step the tensors that it is given ({type(error).__name__}: {error}): "
                "pass NumPy arrays. A class whose step takes arrays only says so by `arrays_only`."
            ) from error

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        """States after the steps `save` (sorted counts in 0 … n_steps): (len(save), ..., 2d).

        Also the index of the last finite state of each trajectory, and the backend that ran.
        """
        if not _steps_itself(type(self)):  # type: ignore[arg-type]
            stepper = self.own_stepper(problem)
            return *stepper.rollout(problem.y0, h, n_steps, save, problem.t0), stepper.backend
        states, finite = rollout(
            lambda k, y: self.checked_step(problem.system, problem.t0 + k * h, y, h), problem.y0, n_steps, save
        )
        return states, finite, library_name(problem.y0)

    def on_clock(self, system: HamiltonianSystem) -> Any:
        """Return the method on its clock, where that is not the physical one."""
        return None

    def run(self, problem: Problem) -> Outcome:
        clock = self.on_clock(problem.system)
        return grid_run(self, problem).outcome() if clock is None else clock.run(problem)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        if (clock := self.on_clock(system)) is not None:
            yield from clock.steps(t_span, y0)
            return
        stepper, chunk, y = self.stepper(Problem(system, *t_span, y0)), 256, y0
        for piece in pieces_of(self, system, *t_span):
            grid, k = Grid(*piece, self.step_length(system)), 0
            while k < grid.n_steps:
                n = min(chunk, grid.n_steps - k)
                states, finite = stepper.rollout(y, grid.h, n, np.arange(n + 1), grid.time(k))
                good = int(finite.max()) if finite.max() < n else n
                if good:
                    yield grid.t0 + np.arange(k, k + good) * grid.h, states[:good], np.full(good, grid.h)
                if good < n:
                    return
                y, k = states[n], k + n
            if grid.remainder:
                yield np.array([grid.time(k)]), y[None], np.array([grid.remainder])
                y = y if grid.t1 == t_span[1] else stepper.shorter(y, grid.remainder, grid.time(k))


def _definer(cls: type, name: str) -> type:
    """Return the class of which an attribute is inherited."""
    return next(base for base in cls.__mro__ if name in vars(base))


@cache
def _overridden(cls: type[FixedStep]) -> frozenset[str]:
    """Return the duties that classes outside of the package define: their runs must ask them."""
    duties = ("step", "rollout", "evaluations")
    return frozenset(name for name in duties if not _definer(cls, name).__module__.startswith("sympflow."))


@cache
def _steps_itself(cls: type[FixedStep]) -> bool:
    """True if runs are made of calls of `step`."""
    return "step" in _overridden(cls) or _definer(cls, "own_stepper") is FixedStep  # type: ignore[arg-type]


@cache
def _is_counted(cls: type[FixedStep]) -> bool:
    """True if the class does not say how many forces its step evaluates: if `evaluations` is of a class above it."""
    return cls.__mro__.index(_definer(cls, "evaluations")) > cls.__mro__.index(_definer(cls, "step"))


class OwnSteps(ArraySteps):
    """The steps that an integrator defines by its duties `step`, `rollout` and `evaluations`."""

    def __init__(
        self, integrator: FixedStep, problem: Problem, inner: Stepper | None = None, counted: bool = False
    ) -> None:
        self.integrator, self.problem, self.inner = integrator, problem, inner
        self.takes_carry = _definer(type(integrator), "rollout") is FixedStep
        if counted:
            self.counts = {"force_evaluations": 0, "hessian_evaluations": 0}
            self.problem = replace(problem, system=counting_view(problem.system, self._count))  # type: ignore[arg-type]

    def _count(self, what: str, x: Array) -> None:
        assert isinstance(self.counts, dict)
        together = math.prod(self.problem.y0.shape[:-1])  # of a batch together as one, as everywhere
        self.counts[what] = self.counts.get(what, 0) + max(1, math.prod(x.shape[:-1]) // together)

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        if self.inner is not None:
            return self.inner.shorter(y, h, t)
        t = beside(t, y) if np.ndim(t) else t
        return self.integrator.checked_step(self.problem.system, t, y, h)

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: RunCheckpoint | None = None
    ) -> tuple[Array, np.ndarray]:
        if not self.takes_carry:
            part, end = self.problem, t0 + n_steps * h
            if not (y0 is part.y0 and t0 == part.t0):
                part = Problem(part.system, t0, end, y0, backend=part.backend)
            states, finite, self.backend = self.integrator.rollout(part, h, n_steps, save)
            return states, finite
        if self.inner is None:
            return super().rollout(y0, h, n_steps, save, t0, carry)
        self.backend = self.inner.backend
        return self.inner.rollout(y0, h, n_steps, save, t0, carry)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return self.integrator.evaluations(n_steps, n_saved, n_extra, backend)


# runs whose steps the method chooses -----------------------------------------------------------------


class Recorder:
    """The outputs and events of a run whose steps the method chooses, taken from its steps one by one."""

    def __init__(self, problem: Problem, times: np.ndarray) -> None:
        self.search, self.wanted = problem.events, times.tolist()
        self.sign = 1 if problem.t1 >= problem.t0 else -1
        self.outputs: list[Array] = [problem.y0 for t in self.wanted if t == problem.t0]

    @property
    def end(self) -> tuple[float, Array] | None:
        """The time and state of the event that ended the run, if one did."""
        return None if self.search is None else self.search.end

    def take(self, t_old: float, y_old: Array, t: float, y: Any, dense: Callable[[float], Array]) -> tuple[float, Any]:
        """Take a step; return its end, or the event within it that ends the run."""
        if self.search is not None:
            y = dense(t) if y is None else y
            t, y = self.search.step(t_old, y_old, t, y, dense) or (t, y)
        while (n := len(self.outputs)) < len(self.wanted) and (self.wanted[n] - t) * self.sign <= 0:
            s = self.wanted[n]
            self.outputs.append(dense(s) if y is None or s != t else y)
        return t, y

    def empty(self, t: float, y: Array) -> None:
        """Look for events in an interval of length zero."""
        if self.search is not None:
            self.search.step(t, y, t, y, lambda s: y)


def run_and_search(integrator: Integrator, problem: Problem, search: EventSearch) -> Outcome:
    """Run an integrator that does not look for events itself: they are sought on its dense output afterwards."""
    stopped = False
    try:
        full = integrator.run(replace(problem, t_eval=None, save_every=1, dense_output=True, events=None))
    except Interrupted as stop:
        full, stopped = stop.outcome, True
    if full.sol is None:
        raise ValueError(
            f"`events` are located on the dense output, which method {integrator.name!r} does not give: use another "
            "method."
        )
    search.max_interval = search.max_interval or problem.system.dt
    every, times = full.t.tolist(), problem.t_eval
    if times is None:
        times = full.t[np.unique([*range(0, len(every), problem.save_every), len(every) - 1])]
    record = Recorder(problem, times)
    if len(every) == 1:
        record.empty(every[0], full.y[0])
    for k in range(len(every) - 1):
        record.take(every[k], full.y[k], every[k + 1], full.y[k + 1], full.sol)
        if search.end:
            break
    t, y = times[: len(record.outputs)], record.outputs
    if search.end:
        full.status, full.message = 1, ENDED
        if problem.t_eval is None and t[-1] != search.end[0]:
            t, y = np.append(t, search.end[0]), [*y, search.end[1]]
    y = stack(y, axis=0) if y else problem.y0[None][:0]
    outcome = replace(full, t=t, y=y, sol=full.sol if problem.dense_output else None)
    if stopped and not search.end:
        raise Interrupted(outcome)
    return outcome
