"""Windows: a long run in pieces of a fraction of a second, which give the same bits as the run in one piece.

Between two of them progress is told, outputs are stored, and Ctrl-C finds what was computed so far.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from sympflow.arrays import Array, concatenate, full_of_nan, is_tensor, readable
from sympflow.integrators.contract import Problem
from sympflow.integrators.steppers import Stepper
from sympflow.kernels.protocol import RunCheckpoint

SECONDS = 0.2
"""The time that a window is to take."""
GROWTH = 16  # of a window, over the one before
FEW_STEPS = 512  # below which a run is never cut
ARRAY_STEPS = 256  # of array operations, in the first window
ONE, MANY = 2**18, 2**22
"""Numbers of the states after the steps of a first window, of one trajectory and of a batch: a millisecond or so."""
LEAST = 16  # steps of the first window of a batch, whose states are loaded and stored in each
DENSE, LARGE = 16, 2**26
"""A run that saves one of so many steps or more is in one piece unless it has as many numbers: windows are copied."""
MOST_SAVED = 2**21
"""Numbers that a window saves, at most."""


def first_window(stepper: Stepper, problem: Problem, n_steps: int, n_saved: int) -> int:
    """Return the steps of the first window of a run of n_steps; 0 for a run in one piece."""
    if n_steps <= FEW_STEPS and problem.progress is None:
        return 0
    if not stepper.takes_carry or not readable(problem.y0):
        return 0
    size = math.prod(problem.y0.shape)
    if not stepper.compiled:
        return ARRAY_STEPS if problem.progress is not None or n_steps > 2 * ARRAY_STEPS else 0
    first = ONE if problem.y0.ndim == 1 else MANY
    long = n_steps * size > max(2 * first, min(DENSE * n_saved * size, LARGE))
    least = 1 if problem.y0.ndim == 1 else LEAST
    return max(least, first // size) if long or problem.progress is not None else 0


class Pace:
    """The lengths of windows, by the time that the last one took."""

    def __init__(self, first: int, seconds: float = SECONDS) -> None:
        self.n, self.seconds = first, seconds
        self.started = time.perf_counter()

    def steps(self, left: int) -> int:
        """Return the steps of the next window, of those that are left."""
        self.started = time.perf_counter()
        return left if left <= 1.5 * self.n else self.n

    def took(self, n: int) -> None:
        """Note that the window, of n steps, has ended."""
        elapsed = time.perf_counter() - self.started
        self.n = max(1, min(GROWTH * n, int(n * self.seconds / elapsed) if elapsed > 0 else GROWTH * n))


class Pieces:
    """A run in pieces."""

    def __init__(
        self, stepper: Stepper, problem: Problem, h: float, carry: RunCheckpoint, finite: np.ndarray | None = None
    ) -> None:
        self.stepper, self.problem, self.h = stepper, problem, h
        self.carry, self.finite = carry, finite
        self._spare: Any = None  # the running state before that of the carry, which an interrupted run does not need

    def to(self, k: int, save: np.ndarray) -> Array:
        """Go on to step k; return the states after the steps `save`."""
        before = self.carry
        carry = RunCheckpoint(before.steps, before.running, self._spare)
        problem = self.problem
        states, finite = self.stepper.rollout(problem.y0, self.h, k, save, problem.t0, carry=carry)
        if self.finite is not None:
            finite = np.where(self.finite < before.steps, self.finite, finite)
        self.carry, self.finite, self._spare = carry, np.asarray(finite), before.running
        return states

    @property
    def ended(self) -> bool:
        """True if no trajectory can go on."""
        return self.finite is not None and bool((self.finite < self.carry.steps).all())


class Saved:
    """The states that the windows of a run have saved, as one array (n, ..., 2d)."""

    def __init__(self, n: int, y0: Array) -> None:
        self.n, self.y0 = n, y0
        self.parts: list[Array] = []
        self.whole: Any = None
        if not is_tensor(y0):  # the trajectories first, as compiled loops have them
            self.whole = np.moveaxis(np.empty((*y0.shape[:-1], n, y0.shape[-1]), dtype=y0.dtype), -2, 0)

    def put(self, first: int, states: Array) -> None:
        """Put states in place, the first of them at an index."""
        if self.whole is None:
            self.parts.append(states)
        else:
            self.whole[first : first + len(states)] = states

    def up_to(self, known: int, n: int) -> Array:
        """Return the first n states: those that are known, and NaN after them."""
        if self.whole is not None:
            self.whole[known:] = np.nan
            return self.whole[:n]
        unknown = [full_of_nan(self.y0)[None]] * (n - known)
        return concatenate([self.y0[None][:0], *self.parts, *unknown], 0)[:n]
