"""Carry: the place where a run is cut. A module of its own, for drivers of runs load no compiler."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["Carry"]


@dataclass
class Carry:
    """The place where a run is cut: with it, pieces of a run give the same bits as the run in one piece.

    The states that a run saves are not enough for that: consecutive steps share a kick or a drift, so that the running
    state is another one, and compensated sums have errors. A run that is given a carry goes on from it, and leaves in
    it where it ends; one that is interrupted leaves it as it was.

    Attributes
    ----------
    steps : int
        The steps made so far; 0 before a run.
    running : ndarray of shape (K,), or (N, K) of a batch; or None
        The kernel's own; None before a run. NaN where a trajectory has ended. Of array operations the states (..., K),
        an array or a tensor.
    spare : ndarray, optional
        An array that the next running state of a batch may be written into, where it fits: that before the last one.
    """

    steps: int = 0
    running: Any = None
    spare: Any = None

    def advance(self, steps: int, running: Any) -> None:
        """Take the place after so many steps."""
        self.steps, self.running = steps, running
