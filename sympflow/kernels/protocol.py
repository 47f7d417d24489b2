"""Kernel: the one protocol of compiled loops, for steps of every kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sympflow.kernels.carry import Carry
from sympflow.kernels.threads import given, run_one, run_rows

__all__ = ["Carry", "Kernel", "Run", "Steps", "run_state", "run_states"]

NOTHING = np.empty(0), np.empty((0, 0))
"""The running state of runs that are not cut, of one state and of a batch."""


class Run(NamedTuple):
    """The outcome of a run of compiled steps.

    Attributes
    ----------
    states : ndarray of shape (n, 2d), or (N, n, 2d) of a batch
        The states after the steps that were to be saved; NaN after the last finite one.
    n_finite : int, or ndarray of int64 of shape (N,)
        Index of the last step that ends in a finite state and, of an implicit method, was solved; the number of steps
        if all do. A run stops there.
    iterations : int
        Newton's iterations of all trajectories together; 0 of an explicit method.
    """

    states: np.ndarray
    n_finite: Any
    iterations: int = 0


def run_state(
    rollout: Callable[..., int],
    y0: np.ndarray,
    n_steps: int,
    save: np.ndarray,
    carry: Carry | None,
    width: int,
    work: int,
    out: np.ndarray | None = None,
) -> Run:
    """The run of one state by ``rollout(y0, n_steps, save, out, stop, first, running)``, which is compiled.

    Parameters
    ----------
    rollout : callable
        Returns the index of the last step that ends in a finite state.
    y0 : ndarray of shape (2d,)
    n_steps, save, carry
        See `Kernel.run`.
    width : int
        K, the size of the running state.
    work : int
        About how many nanoseconds a step takes.
    out : ndarray of shape (n, 2d), optional
        Where the states go.
    """
    y0, save = given(y0), given(save, np.int64)
    if out is None:
        out = np.empty((len(save), len(y0)))
    first, running = 0, NOTHING[0]
    if carry is not None:
        first, running = carry.steps, np.empty(width) if carry.running is None else carry.running.copy()
        _check_running(running, (width,))
    n_finite = run_one(lambda stop: rollout(y0, n_steps, save, out, stop, first, running), (n_steps - first) * work)
    if carry is not None:
        carry.advance(n_steps, running)
    return Run(out, n_finite)


def run_states(
    rollout: Callable[..., None],
    y0: np.ndarray,
    n_steps: int,
    save: np.ndarray,
    threads: int | None,
    carry: Carry | None,
    width: int,
    work: float,
) -> Run:
    """`run_state` of every row of `y0` (N, 2d), as many threads as pay.

    `rollout` is called with the rows that it is to run before everything else, and with their `n_finite` after `out`.
    """
    y0, save = given(y0), given(save, np.int64)
    out, n_finite = np.empty((len(y0), len(save), y0.shape[1])), np.empty(len(y0), dtype=np.int64)
    first, running, before = 0, NOTHING[1], None
    if carry is not None:
        first, before, shape = carry.steps, carry.running, (len(y0), width)
        fits = carry.spare is not None and carry.spare.shape == shape
        running = carry.spare if fits else np.empty(shape)  # new memory of many orbits takes as long as some steps
        _check_running(running if before is None else before, shape)

    def rows(i: slice, stop: np.ndarray) -> None:
        if before is not None:
            running[i] = before[i]
        rollout(i, y0[i], n_steps, save, out[i], n_finite[i], stop, first, running[i])

    run_rows(rows, len(y0), (n_steps - first) * work, threads)
    if carry is not None:
        carry.advance(n_steps, running)
    return Run(out, n_finite)


def _check_running(running: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuse what loops would read beyond, as a damaged store may hold."""
    if running.shape != shape or running.dtype != np.float64:
        raise ValueError(
            f"`store` is damaged: its run goes on from {running.dtype} of shape {running.shape}, not {shape}. Name "
            "another folder."
        )


class Steps(NamedTuple):
    """The states (N, 2d) after single steps, and Newton's iterations that they took together."""

    states: np.ndarray
    iterations: int = 0


class Kernel(Protocol):
    """Compiled loops of a method on one system; states are [q, p], float64.

    For a driven system, and for no other, `run` and `run_batch` are given ``t0=``, the time of the states `y0`, and
    `step` has a third argument t (N,), the times of its states.

    Attributes
    ----------
    saves_finite : bool
        True if all states that a run saves up to its last finite step are finite numbers.
    backend : str
        The name of what runs, of `stats["backend"]`.
    remark : str
        A sentence on the end of the last run of a single state that could not go on.
    """

    saves_finite: bool
    backend: str = "compiled"
    remark: str = ""

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, carry: Carry | None = None) -> Run:
        """`n_steps` steps from one state.

        Parameters
        ----------
        h : float
            Step, negative to go back.
        y0 : ndarray of shape (2d,)
        n_steps : int
        save : ndarray of int64, sorted, in 0 … n_steps
            The steps whose states are kept.
        carry : Carry, optional
            Where the run goes on, and leaves its end: of `n_steps` steps those after ``carry.steps`` are made. All
            counts, those of `save` and of the result too, are from `y0`, which is the state that the first piece began
            with; `save` begins after ``carry.steps``.
        """
        ...

    def run_batch(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None = None,
        carry: Carry | None = None,
    ) -> Run:
        """`run` for every row of `y0` (N, 2d); `threads` is the number of threads, by default as many as pay."""
        ...

    def step(self, h: ArrayLike, y: np.ndarray) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,)."""
        ...

    def tangents(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """The `step` from each row of `y` (N, 2d), and its Jacobians (N, 2d, 2d); None where they are not compiled."""
        return None

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int] | None:
        """Count the evaluations of the system's functions in a run; None where the method itself counts them."""
        return None

    def reach_times(
        self,
        h: float,
        y0: np.ndarray,
        times: np.ndarray,
        stride: int,
        expected: float,
        numbers: tuple[float, ...] | None = None,
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The states of rows of `y0` (N, 2d) at elapsed times, of steps that are equal in another time.

        See `elapsed_times.reach_times`. None where there is no such pass.
        """
        return None
