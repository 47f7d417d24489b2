"""The contract between `solve` and an integrator.

An integrator is a frozen dataclass whose fields are its options (`dt`, `rtol`, …). Its duties:

1. `step(system, t, y, h)` maps states y (..., 2d) over a step h, negative or not, of shape () or y.shape[:-1].
2. `order` (None if trained), `symplectic` and `trained` are class attributes that tell the truth.
3. `check(system)` raises a ValueError with the reason where the method does not apply.
4. `run(problem)` produces the states that were asked for, and no others, as an `Outcome`.
5. `steps(system, t_span, y0)` executes the same run again as a stream of the steps that it takes, and
6. `tangent(system, t, y, h)` differentiates such a step, so that metrics judge the map that was really executed.
7. `inverse(system, t, y, h)` undoes `step(system, t, y, h)` exactly, or raises a TypeError.
8. `finds_events` is False, and `solve` seeks events on the dense output afterwards; or `run` hands every step to
   `problem.events`, if there are any, and ends where that says.

`FixedStep` does 4, 5, 6 and 8 for any integrator that has a step: a new one needs duties 1 to 3 only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from sympflow.arguments import check_dt
from sympflow.arrays import Array, is_tensor, to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.array_rollout import checked_state, rollout
from sympflow.integrators.grid import EPS, Grid
from sympflow.integrators.grid_failures import report_failures

if TYPE_CHECKING:
    from sympflow.events import EventSearch

Steps = Iterator[tuple[np.ndarray, Array, np.ndarray]]
"""Chunks of executed steps: times (n,), states at their beginnings (n, ..., 2d), signed lengths (n,) or (n, ...)."""


@dataclass(frozen=True)
class Problem:
    """What `solve` asks of an integrator, validated."""

    system: HamiltonianSystem
    t0: float
    t1: float
    y0: Array
    t_eval: np.ndarray | None = None
    save_every: int = 1
    dense_output: bool = False
    backend: str = "auto"
    events: EventSearch | None = None


@dataclass
class Outcome:
    """What an integrator answers. `y` has time first: (n, ..., 2d)."""

    t: np.ndarray
    y: Array
    status: int | np.ndarray
    message: str
    stats: dict[str, Any]
    sol: Callable[[Any], Array] | None = None
    finite: bool = False
    """Whether `y` has been looked at and is finite all over; `solve` looks again where this is not said."""


FEW = 8
"""Outputs that are placed on the grid by NumPy: a compiled pass is worth its loading for more."""

FINISHED = "The solver successfully reached the end of the integration interval."


class Integrator:
    """Base class of all integrators. See the module's docstring for the contract."""

    name: ClassVar[str]
    order: ClassVar[int | None]
    symplectic: ClassVar[bool]
    trained: ClassVar[bool] = False
    compiles: ClassVar[bool] = False
    finds_events: ClassVar[bool] = False
    tangent_holds: ClassVar[str] = ""
    """What `tangent` holds fixed though a step from a neighbouring state would change it; "" for nothing."""

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """The names of the options that this method takes."""
        return _field_names(cls)  # type: ignore[arg-type]

    def check(self, system: HamiltonianSystem) -> None:
        """Raise a ValueError with the reason if the method does not apply to the system."""

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        """One step of signed length h from the states y (..., 2d)."""
        raise TypeError(f"`method` {self.name!r} has no bare step: use solve().")

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        """The state from which `step(system, t, ·, h)` leads to y."""
        raise TypeError(f"`method` {self.name!r} has no exact inverse: use a symplectic method.")

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step from y (..., 2d) and its Jacobian A (..., 2d, 2d), by forward-mode differentiation of `step`."""
        import torch

        from sympflow.arrays import jvp

        def step(x: torch.Tensor) -> torch.Tensor:
            return self.step(system, t, x, torch.as_tensor(h, dtype=x.dtype))

        x = torch.as_tensor(to_numpy(y))
        columns = []
        for i in range(x.shape[-1]):
            direction = torch.zeros_like(x)
            direction[..., i] = 1
            y_next, column = jvp(step, x, direction)
            columns.append(column)
        return to_numpy(y_next), to_numpy(torch.stack(columns, dim=-1))

    def run(self, problem: Problem) -> Outcome:
        """Solve the problem."""
        raise NotImplementedError(f"{type(self).__name__} must define run().")

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        """Execute the run again as a stream of its steps."""
        raise NotImplementedError(f"{type(self).__name__} must define steps().")


@dataclass(frozen=True)
class FixedStep(Integrator):
    """An integrator on the grid t0 + k·dt.

    Between grid points, at the times that `t_eval` or the dense output ask for, and at the end of an interval that dt
    does not divide, the state is a shorter step from the last grid point: ψ_t = ψ_{t−k·dt} ∘ (ψ_dt)^k.

    Parameters
    ----------
    dt : float, optional
        Step length, positive; the default is `system.dt`.
    """

    dt: float | None = None

    finds_events: ClassVar[bool] = True
    on_grid: ClassVar[bool] = True
    """Whether the steps are those of the grid t0 + k·dt, as a peer that drives them presumes."""
    saves_finite: ClassVar[bool] = False
    """Whether the states that a compiled `rollout` saves up to the last finite one are known to be finite."""
    breakdown: ClassVar[tuple[str, str]] = ("The solution became non-finite", "Reduce `dt`")
    """What it means when the run cannot go on, and the remedy: for the message of status −1."""

    def __post_init__(self) -> None:
        check_dt(self.dt)

    def step_length(self, system: HamiltonianSystem) -> float:
        """The step that is used for a system."""
        return float(self.dt if self.dt is not None else system.dt)

    def counting(self, system: HamiltonianSystem) -> Self:
        """The integrator whose `evaluations` hold for one run on the system: a copy, where it must keep count."""
        return self

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Force and force-gradient evaluations of n_steps steps, n_saved saved states, n_extra shorter steps."""
        return {"force_evaluations": 0, "hessian_evaluations": 0}

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        """States after the steps `save` (sorted counts in 0 … n_steps): (len(save), ..., 2d).

        Also the index of the last finite state of each trajectory, and the backend that ran.
        """
        states, finite = rollout(
            lambda k, y: self.step(problem.system, problem.t0 + k * h, y, h), problem.y0, n_steps, save
        )
        return states, finite, "torch" if is_tensor(problem.y0) else "numpy"

    def run(self, problem: Problem) -> Outcome:
        if problem.events is not None:
            from sympflow.integrators.grid_events import run_with_events

            return run_with_events(self, problem, problem.events)
        system = problem.system
        grid = Grid(problem.t0, problem.t1, self.step_length(system))
        t, remainder, save, place = self._placed(problem, grid)
        last = int(save[-1]) if save.size else 0
        saved, finite, backend = self.rollout(problem, grid.h, last, save)

        y = saved if place is None else saved[place]
        extra = remainder.nonzero()[0]
        if extra.size:
            y = self.shorter_steps(system, y, extra, remainder[extra], backend)
        n_steps = min(last, int(finite.max() if finite.ndim else finite) + 1)
        end = len(save) if n_steps == last else int(save.searchsorted(n_steps, "right"))
        n_saved = end - int(save.searchsorted(0, "right") if end and save[0] <= 0 else 0)
        at_end = int(bool(extra.size) and extra[-1] == len(t) - 1 and t[-1] == grid.t1)
        stats = {
            "dt": abs(grid.h),
            "n_steps": n_steps + at_end,
            **self.evaluations(n_steps, n_saved, int(extra.size), backend),
            "backend": backend,
        }
        outcome = Outcome(t, y, 0, FINISHED, stats)
        if problem.dense_output:
            from sympflow.integrators.grid_solution import GridSolution

            outcome.sol = GridSolution(self, system, grid, saved, backend)
        outcome.finite = backend == "compiled" and self.saves_finite and not extra.size
        report_failures(outcome, grid, finite, last, self.breakdown)
        return outcome

    def _placed(self, problem: Problem, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Output times and their remainders, the counts whose states are to be saved, and where among these each is.

        The last is None where every output is a state of its own.
        """
        t, y0, system = problem.t_eval, problem.y0, problem.system
        compiled = self.compiles and problem.backend != "array" and type(y0) is np.ndarray and y0.dtype == np.float64
        compiled = compiled and (system.symbols is not None or system.numba_functions is not None)
        if compiled and t is not None and len(t) > FEW and not problem.dense_output:
            from sympflow.kernels.outputs import place

            return t, *place(t, grid.t0, grid.h, 4 * EPS)
        t, count, remainder = grid.outputs(t, problem.save_every)
        save, position = (np.arange(grid.n_steps + 1), count) if problem.dense_output else distinct(count)
        return t, remainder, save, position

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str) -> Array:
        """`step` on the backend of the run that it belongs to."""
        return self.step(system, 0.0, y, h)

    def shorter_steps(
        self, system: HamiltonianSystem, y: Array, extra: np.ndarray, h: np.ndarray, backend: str
    ) -> Array:
        """Replace the states y[extra] by those a step h later."""
        first, last = int(extra[0]), int(extra[-1])
        together = last - first == len(extra) - 1  # nearly always, and a slice is copied ten times sooner
        rows: Any = slice(first, last + 1) if together and not is_tensor(y) else extra
        states = y[rows]
        lengths = h if y.ndim == 2 else np.broadcast_to(h.reshape(-1, *[1] * (y.ndim - 2)), states.shape[:-1]).copy()
        if not is_tensor(y):
            with np.errstate(all="ignore"):
                advanced = self.substep(system, states, lengths.astype(y.dtype), backend)
                y[rows] = checked_state(advanced, states)
            return y
        import torch

        h_extra = torch.as_tensor(lengths, dtype=y.dtype, device=y.device)
        advanced = checked_state(self.substep(system, states, h_extra, backend), states)
        return y.index_copy(0, torch.as_tensor(extra, device=y.device), advanced)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        grid = Grid(*t_span, self.step_length(system))
        chunk, y, k = 256, y0, 0
        while k < grid.n_steps:
            n = min(chunk, grid.n_steps - k)
            piece = Problem(system, grid.time(k), grid.time(k + n), y)
            states, finite, _ = self.rollout(piece, grid.h, n, np.arange(n + 1))
            good = int(finite.max()) if finite.max() < n else n
            if good:
                yield grid.t0 + np.arange(k, k + good) * grid.h, states[:good], np.full(good, grid.h)
            if good < n:
                return
            y, k = states[n], k + n
        if grid.remainder:
            yield np.array([grid.time(k)]), y[None], np.array([grid.remainder])


def distinct(count: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """The distinct ones of sorted counts, and where among them each is; None where all are distinct."""
    if len(count) < 2:
        return count, None
    new = np.empty(len(count), dtype=bool)
    new[0] = True
    np.not_equal(count[1:], count[:-1], out=new[1:])
    return (count, None) if new.all() else (count[new], np.cumsum(new) - 1)


@cache
def _field_names(cls: type) -> tuple[str, ...]:
    return tuple(f.name for f in fields(cls))
