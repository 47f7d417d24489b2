"""The exact flow φ_H,t of a system, to a tight tolerance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from sympflow.hamiltonian.system import HamiltonianSystem


def reference_step(
    system: HamiltonianSystem,
    x: np.ndarray,
    t: float,
    rtol: float = 1e-12,
    check: Callable[[], None] = lambda: None,
    t0: np.ndarray | None = None,
) -> np.ndarray:
    """φ_H,t(x) by DOP853, for states x (n, 2d): (n, 2d), with NaN where the solution does not exist."""
    scale = np.abs(x).max(0)
    scale = np.where(scale > 0, scale, 1.0)

    def integrate(x: np.ndarray, t0: np.ndarray | None) -> np.ndarray | None:
        def velocity(s: float, y: np.ndarray) -> np.ndarray:
            check()
            v = system.vector_field(y.reshape(x.shape), None if t0 is None else t0 + s).ravel()
            if not np.isfinite(v).all():
                raise FloatingPointError  # SciPy would go on for ever
            return v

        atol = np.broadcast_to(0.1 * rtol * scale, x.shape).ravel()
        try:
            with np.errstate(all="ignore"):
                run = solve_ivp(velocity, (0.0, t), x.ravel(), "DOP853", t_eval=[t], rtol=rtol, atol=atol)
        except FloatingPointError:
            return None
        return run.y[:, -1].reshape(x.shape) if run.status == 0 else None

    together = integrate(x, t0)
    if together is not None:
        return together
    alone = (integrate(x[[i]], None if t0 is None else t0[[i]]) for i in range(len(x)))
    return np.concatenate([np.full((1, x.shape[1]), np.nan) if row is None else row for row in alone])
