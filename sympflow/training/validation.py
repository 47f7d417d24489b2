"""Held-out figures: the losses at points never trained on, and the error of one step against a tight reference."""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import solve_ivp

from sympflow.flow.base import FlowMap
from sympflow.system import HamiltonianSystem
from sympflow.training.collocation import Points
from sympflow.training.losses import Loss


def reference_step(system: HamiltonianSystem, x: np.ndarray, t: float, rtol: float = 1e-12) -> np.ndarray:
    """φ_H,t(x) by DOP853, for states x (n, 2d): (n, 2d), with NaN where the solution does not exist."""
    scale = np.abs(x).max(0)
    scale = np.where(scale > 0, scale, 1.0)

    def integrate(x: np.ndarray) -> np.ndarray | None:
        def velocity(_: float, y: np.ndarray) -> np.ndarray:
            v = system.vector_field(y.reshape(x.shape)).ravel()
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

    together = integrate(x)
    if together is not None:
        return together
    alone = (integrate(row[None]) for row in x)
    return np.concatenate([np.full((1, x.shape[1]), np.nan) if row is None else row for row in alone])


class Validation:
    """Held-out points and reference steps of one run."""

    def __init__(
        self, system: HamiltonianSystem, loss: Loss, points: Points, x: np.ndarray, dt: float, flow: FlowMap
    ) -> None:
        self.loss, self.points, self.dt = loss, points, dt
        y = reference_step(system, x, dt)
        exists = np.isfinite(y).all(-1)
        self.x, self.y = (torch.as_tensor(a[exists], dtype=flow.dtype, device=flow.device) for a in (x, y))

    @torch.no_grad()
    def __call__(self, flow: FlowMap) -> dict[str, float]:
        """Losses on the held-out points; mean and largest ‖ψ̄_Δt(x) − φ_H,Δt(x)‖ over the held-out states."""
        terms = self.loss.terms(flow, self.points)
        figures = {"loss": float(self.loss.total(terms))}
        for name, term in zip(("residual_loss", "matching_loss", "label_loss"), terms, strict=True):
            if term is not None:
                figures[name] = float(term)
        if len(self.x):
            error = torch.linalg.vector_norm(flow.psi(self.dt, self.x) - self.y, dim=-1)
            figures |= {"one_step_error": float(error.mean()), "one_step_error_max": float(error.max())}
        return figures
