"""Kernel: the one protocol of compiled loops, for steps of every kind."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Kernel", "Run", "Steps"]


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


class Steps(NamedTuple):
    """The states (N, 2d) after single steps, and Newton's iterations that they took together."""

    states: np.ndarray
    iterations: int = 0


class Kernel(Protocol):
    """Compiled loops of a method on one system; states are [q, p], float64.

    Attributes
    ----------
    saves_finite : bool
        True if all states that a run saves up to its last finite step are finite numbers.
    """

    saves_finite: bool

    def run(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray) -> Run:
        """`n_steps` steps from one state.

        Parameters
        ----------
        h : float
            Step, negative to go back.
        y0 : ndarray of shape (2d,)
        n_steps : int
        save : ndarray of int64, sorted, in 0 … n_steps
            The steps whose states are kept.
        """
        ...

    def run_batch(self, h: float, y0: np.ndarray, n_steps: int, save: np.ndarray, threads: int | None = None) -> Run:
        """`run` for every row of `y0` (N, 2d); `threads` is the number of threads, by default as many as pay."""
        ...

    def step(self, h: ArrayLike, y: np.ndarray) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,)."""
        ...

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

        See `timed_loops.reach_times`. None where there is no such pass.
        """
        return None
