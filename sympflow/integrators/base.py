"""Integrators of fixed steps on the grid t0 + k·dt, and the one driver of their runs.

`FixedStep` is the choice of a method; `Stepper` is one run of it, with its kernel or arrays and its counts; `GridRun`
walks the grid, finds what is not finite, places the outputs and looks for events.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import check_dt, check_not_followed
from sympflow.arrays import (
    Array,
    differentiable,
    finite_states,
    full_of_nan,
    is_tensor,
    join,
    lanes,
    stack,
    transformed,
)
from sympflow.events import EventSearch
from sympflow.hamiltonian.system import HamiltonianSystem, counting_view
from sympflow.integrators.contract import (
    ENDED,
    FINISHED,
    Failure,
    Integrator,
    Outcome,
    Problem,
    Steps,
    finished,
    interrupted,
)
from sympflow.integrators.grid import Grid, distinct
from sympflow.integrators.impulses import pieces_of
from sympflow.integrators.windows import MOST_SAVED, Pace, Pieces, Saved, first_window
from sympflow.kernels.carry import Carry

if TYPE_CHECKING:
    from sympflow.kernels.protocol import Kernel
    from sympflow.storage.runs import RunStore

__all__ = [
    "FINISHED",
    "CountingStepper",
    "FixedStep",
    "Integrator",
    "KernelStepper",
    "Outcome",
    "OwnStepper",
    "Problem",
    "Recorder",
    "Stepper",
    "Steps",
    "checked_state",
    "compiled_loops",
    "rollout",
    "run_and_search",
]

FIRST_CHUNK, LAST_CHUNK = 8, 1024  # steps between two looks at the events
"""The values of `stats["backend"]` of compiled loops."""
MOST_SAMPLES = 65536  # of the events, in a chunk


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
    breakdown: ClassVar[Failure] = Failure.NON_FINITE
    """The meaning of a run that cannot go on."""

    def __post_init__(self) -> None:
        check_dt(self.dt)

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

    def stepper(self, problem: Problem) -> Stepper:
        """Return the stepper of one run, for states such as the problem's y0."""
        self.check_library(problem.y0)
        counted = _is_counted(type(self))  # type: ignore[arg-type]
        return (CountingStepper if counted else Stepper)(self, problem)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Force and force-gradient evaluations of n_steps steps, n_saved saved states, n_extra shorter steps.

        A class that does not say, for the `step` that it defines, has them counted while it runs.
        """
        return {"force_evaluations": 0, "hessian_evaluations": 0}

    def checked_step(self, system: HamiltonianSystem, t: Any, y: Array, h: Any) -> Array:
        """`step`, whose failure on tensors is told from one on arrays."""
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
        states, finite = rollout(
            lambda k, y: self.checked_step(problem.system, problem.t0 + k * h, y, h), problem.y0, n_steps, save
        )
        return states, finite, "torch" if is_tensor(problem.y0) else "numpy"

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str, t: Any = 0.0) -> Array:
        """`step` on the backend of the run that it belongs to; t, a number or one for each state, of driven systems."""
        return self.checked_step(system, t, y, h)

    def run(self, problem: Problem) -> Outcome:
        return GridRun(self, problem).outcome()

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
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
                y = y if grid.t1 == t_span[1] else stepper.shorter_from(grid.time(k), y, grid.remainder)


@dataclass(frozen=True)
class OwnStepper(FixedStep):
    """A fixed-step integrator with a stepper of its own; a subclass that overrides a duty of `FixedStep` is asked."""

    def own_stepper(self, problem: Problem) -> Stepper:
        """Return the stepper of one run, for states such as the problem's y0."""
        raise NotImplementedError(f"{type(self).__name__} must define own_stepper().")

    @classmethod
    def overrides(cls, duty: str) -> bool:
        """Tell whether a subclass of a built-in class defines a duty anew, such as "step"."""
        return duty in _overridden(cls)  # type: ignore[arg-type]

    def stepper(self, problem: Problem) -> Stepper:
        asked = _overridden(type(self))  # type: ignore[arg-type]
        return super().stepper(problem) if asked else self.own_stepper(problem)

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        if self.overrides("step"):
            return super().rollout(problem, h, n_steps, save)
        stepper = self.own_stepper(problem)
        states, finite = stepper.rollout(problem.y0, h, n_steps, save, problem.t0)
        return states, finite, stepper.backend

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str, t: Any = 0.0) -> Array:
        if self.overrides("step"):
            return super().substep(system, y, h, backend, t)
        asked = "auto" if backend == "compiled" else "array"
        return self.own_stepper(Problem(system, 0.0, 0.0, y, backend=asked)).shorter_from(t, y, h)


@cache
def _overridden(cls: type[OwnStepper]) -> frozenset[str]:
    """Return the duties that a subclass of a built-in class defines anew: its stepper must ask them."""
    duties = ("step", "rollout", "substep", "evaluations")
    return frozenset(name for name in duties if not _definer(cls, name).__module__.startswith("sympflow."))


def _definer(cls: type, name: str) -> type:
    """Return the class of which an attribute is inherited."""
    return next(base for base in cls.__mro__ if name in vars(base))


@cache
def _steps_one_by_one(cls: type[FixedStep]) -> bool:
    """True if the `rollout` of a class calls its `step`, and nothing else."""
    return _definer(cls, "rollout") in (FixedStep, OwnStepper)


@cache
def _is_counted(cls: type[FixedStep]) -> bool:
    """True if the class does not say how many forces its step evaluates: if `evaluations` is of a class above it."""
    return cls.__mro__.index(_definer(cls, "evaluations")) > cls.__mro__.index(_definer(cls, "step"))


# one run of a method -------------------------------------------------------------------------------


_ADVICE = re.compile(r"(, or use|: use|\. Use) backend='array'\.$")


class Stepper:
    """One run of a fixed-step integrator: all that a run changes or counts is here.

    This one runs array operations, by the integrator's own `rollout`, `substep` and `evaluations`.

    Attributes
    ----------
    backend : str
        The means of the run, for `stats["backend"]`: "compiled", "numpy", "torch", or the name of another library.
    compiled : bool
        True if the steps run in compiled loops.
    saves_finite : bool
        True if the states that `rollout` saves up to the last finite one are known to be finite.
    """

    compiled: bool = False
    saves_finite: bool = False
    counts_itself: ClassVar[bool] = False
    """True if `evaluations` tells those that were made so far, whatever the steps."""
    why: str = ""
    """Why functions of Python run as such, to be read after the backend."""
    remark: str = ""
    """Why a run of a formula is not compiled, for its message."""

    def __init__(self, integrator: FixedStep, problem: Problem, told: Sequence[str] = ()) -> None:
        if (
            problem.backend == "auto"
            and not is_tensor(problem.y0)
            and problem.y0.dtype == np.float64
            and problem.system.untraced
        ):
            name = "potential" if problem.system.separable else "hamiltonian"
            self.why = f": `{name}` could not be traced, for {problem.system.untraced}"
        if told and problem.system.symbols is not None:
            self.remark = f" Its steps were array operations: {_ADVICE.sub('.', told[0])}"
        self.integrator, self.system, self.problem = integrator, problem.system, problem
        self.backend = "torch" if is_tensor(problem.y0) else "numpy"

    @property
    def takes_carry(self) -> bool:
        """True if `rollout` takes a carry: unless the steps are those of a `rollout` that a class has of its own."""
        return _steps_one_by_one(type(self.integrator))  # type: ignore[arg-type]

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: Carry | None = None
    ) -> tuple[Array, np.ndarray]:
        """Return the states (len(save), ..., 2d) after the steps `save` (sorted counts in 0 … n_steps) of length h.

        Also the index of the last finite state of each trajectory, of shape y0.shape[:-1]. With a `carry` the run from
        y0 goes on from there: see `kernels.protocol.Kernel.run`.
        """
        if carry is not None:
            integrator, system = self.integrator, self.problem.system
            return rollout(
                lambda k, y: integrator.checked_step(system, t0 + k * h, y, h), y0, n_steps, save, carry=carry
            )
        whole = y0 is self.problem.y0 and t0 == self.problem.t0
        seen = self.problem
        piece = seen if whole else Problem(seen.system, t0, t0 + n_steps * h, y0, backend=seen.backend)
        states, finite, self.backend = self.integrator.rollout(piece, h, n_steps, save)
        return states, finite

    def shorter(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        """Return the states a step of length h, a number or one for each state, after y (..., 2d).

        `t` is the time of y, a number or one for each state, which the functions of a driven system take.
        """
        system = self.problem.system
        times = () if system.autonomous else (t,)
        return self.integrator.substep(system, y, h, self.backend, *times)

    def shorter_from(self, t: Any, y: Array, h: Any) -> Array:
        """`shorter`, by one of a class that may not know the time, which is then not needed."""
        return self.shorter(y, h) if self.system.autonomous else self.shorter(y, h, t)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int]:
        """Evaluations of the force and its derivatives so far, if it made so many steps, saves and shorter steps."""
        return self.integrator.evaluations(n_steps, n_saved, n_extra, self.backend)

    def more_stats(self) -> dict[str, int]:
        """Further entries of the statistics."""
        return {}


class CountingStepper(Stepper):
    """A run whose forces are counted, on a view of the system; of a batch together as one, as everywhere."""

    counts_itself = True

    def __init__(self, integrator: FixedStep, problem: Problem) -> None:
        super().__init__(integrator, problem)
        self.counts = {"force_evaluations": 0, "hessian_evaluations": 0}
        self.problem = replace(problem, system=counting_view(problem.system, self._count))

    def _count(self, what: str, x: Array) -> None:
        together = math.prod(self.problem.y0.shape[:-1])
        self.counts[what] = self.counts.get(what, 0) + max(1, math.prod(x.shape[:-1]) // together)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int]:
        return dict(self.counts)


class KernelStepper(Stepper):
    """A run in compiled loops."""

    compiled = True

    def __init__(self, integrator: FixedStep, problem: Problem, kernel: Kernel) -> None:
        self.integrator, self.system, self.problem = integrator, problem.system, problem
        self.kernel, self.backend, self.saves_finite = kernel, kernel.backend, kernel.saves_finite
        self.driven = self.system is not None and not self.system.autonomous  # a flow alone steps without a system
        self.iterations = 0

    @property
    def takes_carry(self) -> bool:
        """False where torch follows the run, which it cannot from piece to piece."""
        return not is_tensor(self.problem.y0) or not differentiable(self.problem.y0, *self.problem.followed.values())

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: Carry | None = None
    ) -> tuple[Array, np.ndarray]:
        if is_tensor(y0):
            from sympflow.integrators.tensors import rolled_out

            return rolled_out(self, y0, h, n_steps, save, t0, carry)
        if y0.ndim == 1:
            states, last, iterations = self.kernel.run(h, y0, n_steps, save, carry, t0)
            self.iterations, self.remark = self.iterations + iterations, self.kernel.remark
            return states, np.asarray(last)
        rows = y0.reshape(-1, y0.shape[-1])
        states, finite, iterations = self.kernel.run(h, rows, n_steps, save, carry, t0)
        self.iterations += iterations
        return states.swapaxes(0, 1).reshape(len(save), *y0.shape), np.asarray(finite).reshape(y0.shape[:-1])

    def by_arrays(self, y: Array, h: Any, t: Any, *followed: Any) -> Array:
        """A step of tensors by tensor operations, which torch follows: of `Problem.followed` too."""
        return self.integrator.checked_step(self.system, t, y, h)

    def shorter(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        if is_tensor(y):
            from sympflow.integrators.tensors import stepped

            return stepped(self, y, h, t)
        start = (np.broadcast_to(t, y.shape[:-1]).reshape(-1),) if self.driven else ()
        if y.ndim == 2 and np.shape(h) == (len(y),):
            states, iterations = self.kernel.step(h, y, *start)
        else:
            rows = np.ascontiguousarray(y).reshape(-1, y.shape[-1])
            states, iterations = self.kernel.step(np.broadcast_to(h, y.shape[:-1]).reshape(-1), rows, *start)
        self.iterations += iterations
        return states.reshape(y.shape)


def compiled_loops(
    make: Callable[[], Any],
    y0: Array,
    backend: str,
    compensated: bool = False,
    reason: str | None = None,
    told: list[str] | None = None,
    system: HamiltonianSystem | None = None,
) -> Any:
    """Return the compiled loops that `make` gives, or None where the call needs, or asks for, array operations."""
    if backend == "array":
        reason = "`backend` is 'array': choose 'auto'."
    elif is_tensor(y0):
        reason = reason or _no_loops_for(y0, system)
    elif y0.dtype != np.float64:
        reason = f"`y0` is {y0.dtype}: use float64, or backend='array'."
    asked = reason is None
    if reason is None:
        try:
            loops = make()
            if is_tensor(y0) and differentiable(y0):
                loops.check_reverse()
            return loops
        except ValueError as error:
            reason = str(error)
    if backend == "compiled":
        raise ValueError(f"`backend` {backend!r} does not apply. {reason}") from None
    if compensated:
        needed = "" if reason.startswith("`compensated`") else "`compensated` sums need compiled loops. "
        raise ValueError(needed + reason) from None
    if told is not None and backend == "auto" and asked:
        told.append(reason)
    return None


def _no_loops_for(y0: Array, system: HamiltonianSystem | None) -> str | None:
    """Why a tensor needs array operations, if it does."""
    if system is None:
        return "`y0` is a tensor: pass a NumPy array, or use backend='array'."
    if y0.device.type != "cpu":
        return f"`y0` is on {y0.device}: move it to the CPU, or use backend='array'."
    if transformed(y0):
        return "`y0` is followed by torch.func, forward mode or torch.compile: use backend='array'."
    if system.learns(y0):
        return "`system` has numbers that torch follows: use backend='array'."
    return None


def rollout(
    step: Callable[[int, Array], Array],
    y: Array,
    n_steps: int,
    save: np.ndarray,
    block: int = 64,
    carry: Carry | None = None,
) -> tuple[Array, np.ndarray]:
    """States at the counts `save` of n_steps times `step(k, y)`, and the last finite count of each trajectory."""
    k = 0
    if carry is not None and carry.running is not None:
        k, y = carry.steps, carry.running
    tensor = is_tensor(y)
    out: Any = [] if tensor else np.full((len(save), *y.shape), np.nan, dtype=y.dtype)
    wanted = save.tolist()
    position = 0
    finite = np.where(finite_states(y, in_any_lane=True), n_steps, -1)
    if wanted and wanted[0] == 0:
        out.append(y) if tensor else out.__setitem__(0, y)
        position = 1
    with np.errstate(all="ignore"):
        while k < n_steps and (finite == n_steps).any():
            start, y_start = k, y
            for k in range(start, min(start + block, n_steps)):
                y = checked_state(step(k, y), y)
                if position < len(wanted) and wanted[position] == k + 1:
                    if tensor:
                        out.append(y)
                    else:
                        out[position] = y
                    position += 1
            k += 1
            failed = (finite == n_steps) & ~finite_states(y, in_any_lane=True)
            if failed.any():
                z = y_start
                for j in range(start, k):
                    z = step(j, z)
                    first = failed & (finite == n_steps) & ~finite_states(z, in_any_lane=True)
                    finite = np.where(first, j, finite)
    if carry is not None:
        carry.advance(n_steps, y)
    if tensor:
        out += [full_of_nan(y)] * (len(wanted) - len(out))
        out = stack(out, axis=0) if out else y[None][:0]
    return out, np.asarray(finite)


def checked_state(y_next: Any, y: Array) -> Array:
    """Return the result of a step from y, checked to be of the same kind, shape and dtype: it may be a plug-in's."""
    shape, tensor = getattr(y_next, "shape", None), is_tensor(y)
    if shape == y.shape and y_next.dtype == y.dtype and is_tensor(y_next) == tensor:
        if tensor and y.requires_grad and not y_next.requires_grad and _gradients_are_on():
            raise TypeError(
                "`step` loses the gradient of the tensors that it is given: pass NumPy arrays, or y0.detach(). A class "
                "whose step takes arrays only says so by `arrays_only`."
            )
        return y_next
    what = "" if shape is None else f" of {y_next.dtype} and shape {tuple(shape)}"
    raise TypeError(
        f"`step` must return states as those that it is given, of {y.dtype} and shape {tuple(y.shape)}; got "
        f"{type(y_next).__name__}{what}. Mend the integrator: check_integrator tests it."
    )


def _gradients_are_on() -> bool:
    import torch

    return torch.is_grad_enabled()


def shorter_steps(stepper: Stepper, grid: Grid, y: Array, count: np.ndarray, remainder: np.ndarray) -> Array:
    """Replace the states y, those at grid points `count`, by those a step later where the remainder h is not 0."""
    extra = remainder.nonzero()[0]
    if not extra.size:
        return y
    h = remainder[extra]
    first, last = int(extra[0]), int(extra[-1])
    together = last - first == len(extra) - 1  # nearly always, and a slice is copied ten times sooner
    rows: Any = slice(first, last + 1) if together and not is_tensor(y) else extra
    states = y[rows]
    lengths, t = h, np.zeros(())
    if y.ndim != 2:
        lengths = np.broadcast_to(h.reshape(-1, *[1] * (y.ndim - 2)), states.shape[:-1]).copy()
    if not stepper.system.autonomous:
        start = grid.t0 + count[extra] * grid.h
        t = np.broadcast_to(start.reshape(-1, *[1] * (y.ndim - 2)), states.shape[:-1]).copy()
    if not is_tensor(y):
        with np.errstate(all="ignore"):
            y[rows] = checked_state(stepper.shorter_from(t, states, lengths.astype(y.dtype)), states)
        return y
    import torch

    h_extra = torch.as_tensor(lengths, dtype=y.dtype, device=y.device)
    advanced = checked_state(stepper.shorter_from(t, states, h_extra), states)
    return y.index_copy(0, torch.as_tensor(extra, device=y.device), advanced)


# the driver ----------------------------------------------------------------------------------------


class GridRun:
    """One run on the grid: the steps, the outputs among and within them, the events, and what is not finite."""

    def __init__(self, integrator: FixedStep, problem: Problem) -> None:
        self.integrator, self.problem = integrator, problem
        self.grid = Grid(problem.t0, problem.t1, integrator.step_length(problem.system))
        self.stepper = integrator.stepper(problem)

    def outcome(self) -> Outcome:
        """Run: at once, or, with events, in chunks of steps; into a store in windows."""
        if self.problem.store is not None:
            return self._stored(self.problem.store)
        search = self.problem.events
        outcome = self._whole() if search is None else self._streamed(search)
        outcome.message += self.stepper.remark
        return outcome

    def _whole(self) -> Outcome:
        problem, grid, stepper = self.problem, self.grid, self.stepper
        t, remainder, save, place = self._placed()
        asked = last = int(save[-1]) if save.size else 0
        first = first_window(stepper, problem, last, len(save))
        if first:
            saved, finite, last = self._in_windows(first, last, save)
            if last < asked:
                save = save[: len(saved)]
                outputs = len(save) if place is None else int(place.searchsorted(len(save)))
                t, remainder, place = t[:outputs], remainder[:outputs], None if place is None else place[:outputs]
        else:
            saved, finite = stepper.rollout(problem.y0, grid.h, last, save, problem.t0)

        y = saved if place is None else saved[place]
        extra = remainder.nonzero()[0]
        if extra.size:
            y = shorter_steps(stepper, grid, y, save if place is None else save[place], remainder)
        n_steps = min(last, int(finite.max() if finite.ndim else finite) + 1)
        end = len(save) if n_steps == last else int(save.searchsorted(n_steps, "right"))
        n_saved = end - int(save.searchsorted(0, "right") if end and save[0] <= 0 else 0)
        at_end = int(bool(extra.size) and extra[-1] == len(t) - 1 and t[-1] == grid.t1)
        outcome = Outcome(t, y, 0, finished(problem), self.stats(n_steps + at_end, n_steps, n_saved, int(extra.size)))
        if problem.dense_output:
            reached = grid if last == asked else Grid(grid.t0, grid.time(last), abs(grid.h))
            outcome.sol = GridSolution(stepper, reached, saved)
        outcome.finite = stepper.compiled and stepper.saves_finite and not extra.size
        self.report_failures(outcome, finite, last)
        if last < asked:
            raise interrupted(outcome, grid.time(last))
        return outcome

    def _in_windows(self, first: int, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, int]:
        """`Stepper.rollout` in windows: also the step that was reached, less than n_steps where Ctrl-C ended it."""
        problem, h = self.problem, self.grid.h
        pieces, pace, saved = Pieces(self.stepper, problem, h, Carry()), Pace(first), Saved(len(save), problem.y0)
        most = max(2, MOST_SAVED // math.prod(problem.y0.shape))
        k = row = 0
        try:
            while k < n_steps and not pieces.ended:
                to = k + pace.steps(n_steps - k)
                end = int(save.searchsorted(to, "right"))
                if end - row > most:
                    to, end = int(save[row + most - 1]), row + most
                saved.put(row, pieces.to(to, save[row:end]))
                pace.took(to - k)
                row, k = end, to
                if problem.progress is not None and k < n_steps:
                    problem.progress(abs(k * h))
        except KeyboardInterrupt:
            n_steps = k
        finite = np.zeros(problem.y0.shape[:-1], dtype=int) if pieces.finite is None else pieces.finite
        return saved.up_to(row, int(save.searchsorted(n_steps, "right"))), finite, n_steps

    # a store: windows whose outputs are written --------------------------------------------------------------------

    def _stored(self, store: RunStore) -> Outcome:
        """The same outputs, taken by a store: see `StoredRun`."""
        if not self.stepper.takes_carry:
            raise ValueError(
                f"`store` needs a run that can be cut, and the loops of method {self.integrator.name!r} cannot: use "
                "another fixed-step method, or leave `store` out."
            )
        from sympflow.integrators.stored_runs import StoredRun

        with store.opened():
            return StoredRun(self, store).outcome()

    def within(self, y: Array, count: np.ndarray, remainder: np.ndarray) -> Array:
        """`shorter_steps`, none of which depends on how many there are in a window, as those of arrays do."""
        if self.stepper.compiled:
            return shorter_steps(self.stepper, self.grid, y, count, remainder)
        for i in remainder.nonzero()[0].tolist():
            one = slice(i, i + 1)
            shorter_steps(self.stepper, self.grid, y[one], count[one], remainder[one])
        return y

    def stats(self, n_told: int, n_steps: int, n_saved: int, n_extra: int) -> dict[str, Any]:
        stepper = self.stepper
        return {
            "dt": abs(self.grid.h),
            "n_steps": n_told,
            **stepper.evaluations(n_steps, n_saved, n_extra),
            "backend": stepper.backend + stepper.why,
            **stepper.more_stats(),
        }

    def _placed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Output times and their remainders, the counts whose states are to be saved, and where among these each is."""
        problem, grid = self.problem, self.grid
        t = problem.t_eval
        t, count, remainder = grid.outputs(t, problem.save_every)
        save, position = (np.arange(grid.n_steps + 1), count) if problem.dense_output else distinct(count)
        return t, remainder, save, position

    # events: the run in chunks of steps, each searched before the next is computed ----------------------------------

    def _streamed(self, search: EventSearch) -> Outcome:
        """The same steps for a single trajectory with events, never more than a chunk of them in memory."""
        problem, grid, stepper = self.problem, self.grid, self.stepper
        system, y = problem.system, problem.y0
        times, count, remainder = grid.outputs(problem.t_eval, problem.save_every)
        outputs: list[Array] = [y[None][:0]]
        kept: list[Array] = []
        chunk, k, shorter, delivered, failed = FIRST_CHUNK, 0, 0, 0, False
        largest = max(1, min(LAST_CHUNK, MOST_SAMPLES // search.parts(grid.h, system.dt)))
        progress = problem.progress

        stopped, done = False, (0, 0, 1, 0)
        try:
            while True:
                n = min(chunk, largest, grid.n_steps - k)
                states, finite = stepper.rollout(y, grid.h, n, np.arange(n + 1), grid.time(k))
                good = min(n, int(finite))
                failed = good < n
                last = k + n == grid.n_steps or failed

                taken, ended = self._search(search, k, states[: good + 1])
                if not ended and last and not failed and grid.remainder:
                    shorter = 1
                    ended = self._search_remainder(search, states[good])

                # outputs before the end of this chunk; a state at its end belongs to the next, unless there is none
                due = delivered + int(np.searchsorted(count[delivered:], k + good, "right" if last else "left"))
                chosen = slice(delivered, due)
                y_due = states[count[chosen] - k]
                outputs.append(shorter_steps(stepper, grid, y_due, count[chosen], remainder[chosen]))
                delivered = due
                if problem.dense_output:
                    kept.append(states[: good + 1] if last or ended else states[:good])
                if ended or last:
                    k += taken if ended else good
                    break
                y, k, chunk = states[n], k + n, 2 * chunk
                done = k, delivered, len(outputs), len(kept)
                if progress is not None:
                    progress(abs(k * grid.h))
        except KeyboardInterrupt:
            stopped = True
            k, delivered, n_outputs, n_kept = done
            outputs, kept = outputs[:n_outputs], [*kept[:n_kept], y[None]]
            search.forget_after(grid.time(k), grid.h)

        t, y_out = times[:delivered], join(outputs)
        finite_outputs = finite_states(y_out)  # a shorter step may overflow too
        failed = failed or not finite_outputs.all()
        t_end = search.end[0] if search.end else grid.time(k) if failed or stopped else grid.t1
        keep = finite_outputs & ((t - t_end) * np.sign(grid.h) <= 0)
        n_keep = len(t) if keep.all() else int(np.argmin(keep))
        t, y_out = t[:n_keep], y_out[:n_keep]
        if search.end and problem.t_eval is None and not (len(t) and t[-1] == t_end):
            t, y_out = np.append(t, t_end), join([y_out, search.end[1][None]])

        n_extra = search.n_dense + int(np.count_nonzero(remainder[:delivered]))
        stats = self.stats(k + shorter, k, k, n_extra)
        outcome = Outcome(t, y_out, int(search.end is not None), ENDED if search.end else FINISHED, stats)
        if failed and not search.end:
            outcome.status = -1
            outcome.stats["failed_at"] = t_end
            outcome.message = self._failure(t_end, k)
        if problem.dense_output:
            outcome.sol = GridSolution(stepper, Grid(grid.t0, t_end, abs(grid.h)), join(kept))
        if stopped:
            raise interrupted(outcome, t_end)
        return outcome

    def _search(self, search: EventSearch, k: int, states: Array) -> tuple[int, bool]:
        """Search the steps between `states`, which begin at grid point k: the number searched; does the run end?"""
        grid, stepper = self.grid, self.stepper
        inner = self._samples(search, k, states[:-1], grid.h)
        for j in range(len(states) - 1):
            t, y = grid.time(k + j), states[j]

            def dense(s: float, t: float = t, y: Array = y) -> Array:
                return stepper.shorter_from(t, y, s - t)

            if search.step(t, y, grid.time(k + j + 1), states[j + 1], dense, inner[j]):
                return j + 1, True
        return len(states) - 1, False

    def _samples(self, search: EventSearch, k: int, states: Array, h: float) -> Array:
        """States (n, parts − 1, 2d) that divide steps of length h, all computed at once."""
        parts = search.parts(h, self.problem.system.dt)
        search.n_dense += len(states) * (parts - 1)
        lengths = h * np.arange(1, parts) / parts * np.ones((len(states), 1))
        if parts == 1 or not len(states):
            return states[:, None][:, :0]
        t = (self.grid.t0 + (k + np.arange(len(states))) * self.grid.h)[:, None] * np.ones_like(lengths)
        if is_tensor(states):
            import torch

            with torch.no_grad():
                repeated = states[:, None].expand(-1, parts - 1, -1)
                return self.stepper.shorter_from(t, repeated, torch.as_tensor(lengths).to(repeated))
        with np.errstate(all="ignore"):
            repeated = np.repeat(states[:, None], parts - 1, axis=1)
            return self.stepper.shorter_from(t, repeated, lengths.astype(states.dtype))

    def _search_remainder(self, search: EventSearch, y: Array) -> bool:
        """Search the last, shorter step of an interval that dt does not divide."""
        grid = self.grid
        t = grid.time(grid.n_steps)

        def dense(s: float) -> Array:
            return self.stepper.shorter_from(t, y, s - t)

        y_end = dense(grid.t1)
        search.n_dense += 1
        if not finite_states(y_end):
            return False
        inner = self._samples(search, grid.n_steps, y[None], grid.remainder)
        return bool(search.step(t, y, grid.t1, y_end, dense, inner[0]))

    # failures -----------------------------------------------------------------------------------------------------

    def _failure(self, t: float, step: int) -> str:
        what, remedy = self.integrator.breakdown.value
        return f"{what} after t = {t:.17g} (step {step + 1} of {self.grid.n_steps}). {remedy}, or end `t_span` earlier."

    def report_failures(self, outcome: Outcome, finite: np.ndarray, n_run: int) -> None:
        """Set status −1, the time and the message where a trajectory cannot go on; cut a single trajectory there."""
        grid = self.grid
        done = bool((finite >= n_run).all()) if finite.ndim else int(finite) >= n_run
        outcome.finite = done and (outcome.finite or _all_finite(outcome.y))
        if outcome.finite:
            if finite.ndim:
                outcome.status = np.zeros(finite.shape, dtype=int)
            return
        ok = finite_states(outcome.y)  # (n, ...): shorter steps may overflow too
        if is_tensor(outcome.y) and lanes(outcome.y):
            if not ok.all():
                report_lanes(outcome, ok, self.integrator.breakdown)
        elif finite.ndim:
            outcome.status = np.where((finite < n_run) | ~ok.all(0), -1, 0)
            failed = np.argwhere(outcome.status)
            if failed.size:
                what, remedy = self.integrator.breakdown.value
                i = tuple(failed[0].tolist())
                times = grid.t0 + np.minimum(finite, grid.n_steps) * grid.h
                outcome.stats["failed_at"] = np.where(outcome.status < 0, times, np.nan)
                outcome.message = (
                    f"{len(failed)} of {finite.size} trajectories failed, the first of them (index "
                    f"{', '.join(map(str, i))}) after t = {grid.time(int(finite[i])):.17g}. {what}. {remedy}."
                )
        elif finite < n_run or not ok.all():
            last = int(finite) if finite < n_run else int(grid.locate(outcome.t[~ok][:1])[0][0])
            outcome.status = -1
            outcome.stats["failed_at"] = grid.time(last)
            outcome.message = self._failure(grid.time(last), last)
            keep = int(np.argmin(ok)) if not ok.all() else len(ok)
            outcome.t, outcome.y = outcome.t[:keep], outcome.y[:keep]


def report_lanes(outcome: Outcome, ok: np.ndarray, breakdown: Failure) -> None:
    """Flag a run under `torch.func.vmap` of which some lane failed: `ok` (n, ...) is False where one is not finite."""
    what, remedy = breakdown.value
    bad = ~ok.all(0)
    outcome.status = np.where(bad, -1, 0) if bad.ndim else -1
    outcome.stats["failed_at"] = float(outcome.t[int(np.argmin(ok.reshape(len(ok), -1).all(1)))])
    outcome.message = (
        f"{what} in some lane of torch.func.vmap before t = {outcome.stats['failed_at']:.17g}. {remedy}, or pass the "
        "states as a batch, whose trajectories are told apart."
    )


class GridSolution:
    """Dense output of a fixed-step method: a shorter step from the last grid point before t."""

    def __init__(self, stepper: Stepper, grid: Grid, states: Array) -> None:
        self.stepper, self.grid, self.states = stepper, grid, states
        self.t_min, self.t_max = sorted((grid.t0, grid.t1))

    def __getstate__(self) -> dict[str, Any]:
        """The choice of the method in place of its run, whose compiled loops belong to a process."""
        stepper = self.stepper
        return {
            "integrator": stepper.integrator,
            "system": stepper.system,
            "grid": self.grid,
            "states": self.states,
            "backend": stepper.backend,
            "letters": stepper.problem.letters,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        integrator, grid, states = state["integrator"], state["grid"], state["states"]
        backend = "auto" if state["backend"] == "compiled" else "array"
        problem = Problem(state["system"], grid.t0, grid.t1, states[0], backend=backend, letters=state.get("letters"))
        GridSolution.__init__(self, integrator.stepper(problem), grid, states)

    def __call__(self, t: float | np.ndarray) -> Array:
        check_not_followed("t", t)
        times = np.atleast_1d(np.asarray(t, dtype=float))
        count, remainder = self.grid.locate(times)
        y = shorter_steps(self.stepper, self.grid, self.states[count], count, remainder)
        y = y.movedim(0, -1) if is_tensor(y) else np.moveaxis(y, 0, -1)
        return y[..., 0] if np.ndim(t) == 0 else y


def _all_finite(y: Array) -> bool:
    """True if an array is finite all over; of tensors that is found out elsewhere."""
    return not is_tensor(y) and bool(np.isfinite(y).all())


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


# events of integrators that do not look for them themselves ------------------------------------------


def run_and_search(integrator: Integrator, problem: Problem, search: EventSearch) -> Outcome:
    """Run an integrator that does not look for events itself: they are sought on its dense output afterwards."""
    full = integrator.run(replace(problem, t_eval=None, save_every=1, dense_output=True, events=None))
    if full.sol is None:
        raise ValueError(
            f"`events` are located on the dense output, which method {integrator.name!r} does not give: use another "
            "method."
        )
    sign = 1 if problem.t1 >= problem.t0 else -1
    search.max_interval = search.max_interval or problem.system.dt
    if len(full.t) == 1:
        search.step(full.t[0], full.y[0], full.t[0], full.y[0], full.sol)
    for k in range(len(full.t) - 1):
        if search.step(float(full.t[k]), full.y[k], float(full.t[k + 1]), full.y[k + 1], full.sol):
            break
    t_end = search.end[0] if search.end else float(full.t[-1]) if full.status else problem.t1
    if problem.t_eval is not None:
        t = problem.t_eval[(problem.t_eval - t_end) * sign <= 0]
        y = stack([full.sol(s) for s in t.tolist()], axis=0) if t.size else problem.y0[None][:0]
    else:
        keep = np.unique([*range(0, len(full.t), problem.save_every), len(full.t) - 1])
        keep = keep[(full.t[keep] - t_end) * sign <= 0]
        t, y = full.t[keep], full.y[keep]
        if search.end and t[-1] != t_end:
            t, y = np.append(t, t_end), stack([*y, search.end[1]], axis=0)
    if search.end:
        full.status, full.message = 1, ENDED
    return replace(full, t=t, y=y, sol=full.sol if problem.dense_output else None)
