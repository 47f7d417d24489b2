"""Labels: where the exact flow takes sampled states, at several times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem

TOLERANCE = 1e-13


@dataclass(frozen=True)
class Labels:
    """φ_H,t(x) of N states at J times.

    Attributes
    ----------
    t : (J,), ascending, positive
    x : (N, 2d)
    y : (J, N, 2d)
    """

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, system: HamiltonianSystem, x: np.ndarray, t: np.ndarray) -> Labels:
        """Made by DOP853 at rtol = 1e-13, all states in one integration from each time to the next.

        States whose solution ends before the last time are left out.
        """
        y, reached = [x], 0.0
        for time in t:
            after = reference_step(system, y[-1], float(time - reached), TOLERANCE)
            exists = np.isfinite(after).all(-1)
            y, reached = [states[exists] for states in (*y, after)], time
        return cls(np.asarray(t), y[0], np.stack(y[1:]))

    def at(self, j: int) -> Labels:
        """Those at the j-th time alone."""
        return Labels(self.t[[j]], self.x, self.y[[j]])

    def first(self, n: int) -> Labels:
        """Those of the first n states."""
        return Labels(self.t, self.x[:n], self.y[:, :n])
