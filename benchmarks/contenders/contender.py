"""The comparison with other packages: its scene, and how a method is run and looked at on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from sympflow import HamiltonianSystem
from sympflow.metrics.reference import reference
from sympflow.systems import henon_heiles

SAMPLE = 64
"""The number of trajectories of a batch that its step or tolerance is calibrated on."""


@dataclass(frozen=True)
class Scene:
    """q₀ = (0.3, −0.3), p₀ = (0.3, 0.15), solved to `t_end`; the batch is uniform within `spread` of that state."""

    t_end: float = 1000.0
    n_instants: int = 1000
    trajectories: int = 1000
    spread: float = 0.01

    @cached_property
    def system(self) -> HamiltonianSystem:
        return henon_heiles()

    @cached_property
    def y0(self) -> np.ndarray:
        return np.array([0.3, -0.3, 0.3, 0.15])

    @cached_property
    def batch(self) -> np.ndarray:
        rng = np.random.default_rng(0)
        return self.y0 + rng.uniform(-self.spread, self.spread, (self.trajectories, 4))

    def start(self, trajectories: int) -> np.ndarray:
        """The initial state (4,), or the batch (trajectories, 4)."""
        return self.y0 if trajectories == 1 else self.batch

    def sample(self, trajectories: int) -> np.ndarray:
        """The states that errors are judged on: the initial state, or the first of the batch."""
        return self.y0 if trajectories == 1 else self.batch[:SAMPLE]

    def instants(self, t_end: float) -> np.ndarray:
        """The equally spaced times in (0, t_end] at which the energy is looked at."""
        return t_end * np.arange(1, self.n_instants + 1) / self.n_instants

    def energy_error(self, states: np.ndarray, start: np.ndarray) -> float:
        """max over time of |H − H₀|/|H₀|; of a batch, the median over the trajectories. States: (n, ..., 4)."""
        with np.errstate(all="ignore"):
            H0 = self.system.hamiltonian(start)
            worst = np.abs(self.system.hamiltonian(states) / H0 - 1).max(axis=0)  # NaN stays NaN
        return float(np.median(np.where(np.isnan(worst), np.inf, worst)))

    @cached_property
    def _ends(self) -> dict[int, np.ndarray]:
        times = np.array([self.t_end])
        return {
            n: reference(self.system, (0.0, self.t_end), self.sample(n), times).y[..., 0]
            for n in {1, self.trajectories}
        }

    def state_error(self, final: np.ndarray, trajectories: int) -> float:
        """‖y(t_end) − y_ref‖; of a batch, the median over the sample."""
        return float(np.median(np.linalg.norm(final - self._ends[trajectories], axis=-1)))


def whole_steps(t_end: float, dt: float) -> int:
    """The number of steps that a fixed step is rounded to."""
    return max(1, round(t_end / dt))


@dataclass(frozen=True)
class Work:
    """The cost of one trajectory, whatever the machine. None where the method has no such thing."""

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
    control : "dt", "tol" or "flow"
        What its accuracy is set by: a step, a tolerance, or the flow of a ladder, by its Δt.
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
    choices : tuple of float
        The settings that there are, of which the fastest is taken; without them any number is one.
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
    choices: tuple[float, ...] = ()
    short: tuple[float, ...] = ()


@dataclass(frozen=True)
class Skipped:
    """A package that is not there, and why."""

    package: str
    reason: str
