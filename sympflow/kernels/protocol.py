"""Kernel: the one protocol of compiled loops, for steps of every kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import NotCompiled
from sympflow.kernels.threads import NEVER, given, run_rows

__all__ = ["Batch", "Kernel", "Run", "RunCheckpoint", "Steps", "Task", "both_ways", "run_states"]

NOTHING: Any = np.empty(0)


@dataclass
class RunCheckpoint:
    """The place where a run is cut: with it, pieces of a run give the same bits as the run in one piece.

    The states that a run saves are not enough for that: consecutive steps share a kick or a drift, so that the running
    state is another one, and compensated sums have errors.
    A run goes on from a carry and leaves its end there; one that is interrupted leaves it as it was. `steps` are those
    made so far, `running` (K,), or (N, K) of a batch, the kernel's own: None before a run, NaN where a trajectory has
    ended. The next running state of a batch may be written into `spare`.
    """

    steps: int = 0
    running: Any = None
    spare: Any = None

    def advance(self, steps: int, running: Any) -> None:
        """Take the place after so many steps."""
        self.steps, self.running = steps, running


class Task(NamedTuple):
    """The request for a run of states `y0` (N, 2d): see `Kernel.run`."""

    h: float
    y0: np.ndarray
    n_steps: int
    save: np.ndarray
    carry: RunCheckpoint | None = None
    t0: float = 0.0
    threads: int | None = None


class Run(NamedTuple):
    """The outcome of a run of compiled steps.

    `states` (n, 2d), or (N, n, 2d) of a batch, are those after the steps that were to be saved; NaN after the last
    finite one. `n_finite`, or (N,), is the last step that ends in a finite state and, of an implicit method, was
    solved; the number of steps if all do. A run stops there. `iterations` are Newton's, of all trajectories together.
    """

    states: np.ndarray
    n_finite: Any
    iterations: int = 0


class Batch(NamedTuple):
    """Rows of a run for compiled code: what it is given and what it fills.

    `y0` is (N, 2d), or (N, 2d + n) with own values behind each state. The run goes on from `running` (N, K), (N, 0)
    where its end is not needed, after `first` steps, and ends once ``stop[0]`` is not 0. It fills `out` (N, n, 2d),
    `n_finite` (N,) and `counts` (N,) or (0,); `kept` is room for the states before all stages: see `run_function`.
    """

    y0: np.ndarray
    n_steps: int
    save: np.ndarray
    out: np.ndarray
    n_finite: np.ndarray
    first: int
    running: np.ndarray
    counts: np.ndarray = NOTHING
    stop: np.ndarray = NEVER
    kept: np.ndarray | None = None

    def rows(self, begin: int, end: int, stop: np.ndarray | None = None) -> Batch:
        """Some of the rows, and what stops them."""
        stop = self.stop if stop is None else stop
        if begin == 0 and end >= len(self.y0):
            return self if stop is self.stop else self._replace(stop=stop)
        y0, n_steps, save, out, finite, first, running, counts, *_ = self
        i = slice(begin, end)
        return Batch(y0[i], n_steps, save, out[i], finite[i], first, running[i], counts[i], stop)

    @property
    def ended(self) -> Sequence[int]:
        """The rows that ended early."""
        if len(self.n_finite) == 1:
            return (0,) if self.n_finite[0] < self.n_steps else ()
        return np.flatnonzero(self.n_finite < self.n_steps).tolist()


def run_states(
    rollout: Callable[[Batch], None],
    task: Task,
    width: int,
    work: float,
    start: np.ndarray | None = None,
    counts: bool = False,
) -> Run:
    """A run of every row of a task by `rollout(batch)`, which is compiled, on as many threads as pay.

    The running state has `width` numbers, a step takes about `work` nanoseconds; `start` has states with own values.
    """
    y0, save, carry, first = given(task.y0), given(task.save, np.int64), task.carry, 0
    N, before = len(y0), None
    running = np.empty((N, 0))
    if carry is not None:
        first, before, spare, shape = carry.steps, carry.running, carry.spare, (N, width)
        fits = spare is not None and spare.shape == shape
        running = spare if fits else np.empty(shape)  # new memory of many orbits takes as long as some steps
        if before is not None:
            before = _fitting(before, shape)
        _fitting(running, shape)
    out, n_finite = np.empty((N, len(save), y0.shape[1])), np.empty(N, dtype=np.int64)
    counted = np.zeros(N) if counts else NOTHING
    batch = Batch(y0 if start is None else start, task.n_steps, save, out, n_finite, first, running, counted)

    def rows(i: slice, stop: np.ndarray) -> None:
        if before is not None:
            running[i] = before[i]
        rollout(batch.rows(i.start, i.stop, stop))

    run_rows(rows, N, (task.n_steps - first) * work, task.threads)
    if carry is not None:
        carry.advance(task.n_steps, running)
    return Run(out, n_finite, int(counted.sum()) if counts else 0)


def _fitting(running: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The running states as rows; refused where loops would read beyond, as a damaged store may hold."""
    if running.dtype != np.float64 or running.shape not in (shape, shape[1:] if shape[0] == 1 else shape):
        raise ValueError(
            f"`store` is damaged: its run goes on from {running.dtype} of shape {running.shape}, not {shape}. Name "
            "another folder."
        )
    return running.reshape(shape)


class Steps(NamedTuple):
    """The states (N, 2d) after single steps, and Newton's iterations that they took together."""

    states: np.ndarray
    iterations: int = 0


def begun_in(save: np.ndarray) -> int:
    """How many outputs are those after no step."""
    return int(np.searchsorted(save, 0, "right"))


def end_finite(states: np.ndarray, save: np.ndarray, n_finite: np.ndarray) -> None:
    """Let trajectories (N, n, 2d), after the steps `save`, end before the first state that is not finite."""
    good = np.isfinite(states).all(-1)
    for i in np.flatnonzero(~good.all(-1)):
        row = int(np.argmin(good[i]))
        if save[row] <= n_finite[i]:
            states[i, row:], n_finite[i] = np.nan, save[row] - 1


def both_ways(step: Callable[[Any, bool], np.ndarray], h: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rows of `y` (N, 2d) after steps of lengths h (N,): ``step(rows, back)`` is of those that go one way."""
    out = None
    for back, rows in ((False, h > 0), (True, h < 0)):
        if rows.all():
            return step(slice(None), back)
        if rows.any():
            out = np.array(y, dtype=np.float64) if out is None else out
            out[rows] = step(rows, back)
    return np.array(y, dtype=np.float64) if out is None else out


class Kernel(ABC):
    """Compiled loops of a method on one system; states are [q, p], float64. A subclass defines `runs` and `step`.

    `saves_finite` is true if all states that are saved up to the last finite step are finite; `backend` a name for
    `stats`, `tensors` weights in H that torch follows, `remark` a sentence on the end of a run that could not go on.
    """

    saves_finite = True
    backend = "compiled"
    tensors: Sequence[Any] = ()
    remark = ""

    def run(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        carry: RunCheckpoint | None = None,
        t0: float = 0.0,
        threads: int | None = None,
    ) -> Run:
        """`n_steps` steps h, negative to go back, from one state (2d,), or from every row (N, 2d), at the time t0.

        The states after the steps of `save`, sorted int64, are kept. A `carry` says where the run goes on, and is left
        with its end: all counts are from `y0`, with which the first piece began, and `save` begins after
        ``carry.steps``. Without `threads` there are as many as pay.
        """
        if y0.ndim > 1:
            return self.runs(Task(h, y0, n_steps, save, carry, t0, threads))
        found = self.runs(Task(h, y0[None], n_steps, save, carry, t0, threads))
        if carry is not None and carry.running is not None:
            carry.running = carry.running[0]
        return Run(found.states[0], int(found.n_finite[0]), found.iterations)

    @abstractmethod
    def runs(self, task: Task) -> Run:
        """The runs of a task, in vector lanes and, where it pays, on several threads."""

    @abstractmethod
    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,), of a driven system at times t."""

    def check_reverse(self) -> None:
        """Raise a ValueError, with the reason, where runs cannot be differentiated: see `SplittingKernel.recorded`."""
        raise NotCompiled("`y0` requires gradients, and the loops of the method have no reverse: use backend='array'.")

    def recorded(self, task: Task) -> Any:
        """`runs`, as a run whose cotangents can be pulled back, after `check_reverse`: see `reverse.Recorded`."""
        raise NotImplementedError

    @property
    def steps_tensors(self) -> bool:
        """True if `stepped` makes a step by tensor operations, of values of parameters too."""
        return False

    def tangents(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """The `step` from each row of `y` (N, 2d), and its Jacobians (N, 2d, 2d); None where they are not compiled."""
        return None

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int] | None:
        """Count the evaluations of the system's functions in a run; None where the method itself counts them."""
        return None
