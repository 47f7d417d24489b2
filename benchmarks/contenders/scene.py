"""The scene of the comparison: a Hénon–Heiles orbit, and a cloud of a thousand around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.reference import reference
from sympflow.systems import henon_heiles

SAMPLE = 64
"""How many trajectories of a batch its step or tolerance is calibrated on."""


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
