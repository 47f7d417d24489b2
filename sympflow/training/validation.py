"""Held-out figures: the losses at points never trained on, and the error of one step against a tight reference."""

from __future__ import annotations

import numpy as np
import torch

from sympflow.flow.base import FlowMap
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.collocation import Points
from sympflow.training.losses import Loss


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
