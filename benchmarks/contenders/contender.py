"""What the comparison needs to know of a method: how to run it, and how to look at what it computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


def whole_steps(t_end: float, dt: float) -> int:
    """The number of steps that a fixed step is rounded to."""
    return max(1, round(t_end / dt))


@dataclass(frozen=True)
class Work:
    """What one trajectory costs, whatever the machine. None where the method has no such thing."""

    steps: int
    force_evaluations: int | None
    hessian_evaluations: int | None = 0


@dataclass(frozen=True)
class Outputs:
    """States (n, ..., 4) that a method stepped on, never interpolated ones, and what it gives at the end (..., 4)."""

    states: np.ndarray
    final: np.ndarray
    work: Work


@dataclass(frozen=True)
class Contender:
    """One method of one package.

    Attributes
    ----------
    label, package : str
    trajectories : int
        How many one run integrates.
    control : "dt" or "tol"
        What its accuracy is set by.
    run : callable
        run(control, t_end): integrate to t_end, keeping the last state only; this is what is timed.
    outputs : callable or None
        outputs(control, t_end) of the sample, on which the errors are judged. None for a loop that takes the very
        steps of another method, `same_steps_as`.
    guesses : mapping of target to control
        Where the search begins; it also says which targets are tried.
    order : float
        Of the energy error as a function of the control.
    window : float
        The search ends at an error between window × target and the target.
    short : tuple of targets
        Those that are calibrated over a tenth of the interval, since the energy error of a Runge–Kutta method grows
        linearly and a whole run would take minutes.
    """

    label: str
    package: str
    trajectories: int
    control: str
    run: Callable[[float, float], Any]
    outputs: Callable[[float, float], Outputs] | None = None
    same_steps_as: str | None = None
    guesses: Mapping[float, float] = field(default_factory=dict)
    order: float = 1.0
    window: float = 0.8
    short: tuple[float, ...] = ()


@dataclass(frozen=True)
class Skipped:
    """A package that is not there, and why."""

    package: str
    reason: str
