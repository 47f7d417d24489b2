"""The two losses of the paper, in units in which every well-posed problem looks alike."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sympflow.flow.base import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.system import HamiltonianSystem
from sympflow.training.collocation import Points


@dataclass(frozen=True)
class Loss:
    """L = w_1 L1 + w_2 L2, without data.

    L1 = mean ‖d/dt ψ̄_t(x) − J∇H(ψ̄_t(x))‖², the residual of the flow; L2 = mean (𝓗(ψ̄)(t, x) − H(x))², Hamiltonian
    matching, less its mean over x at each t, as 𝓗 is defined up to a function of t. Both are divided by the units of
    the scaling: x by its spread over Ω, t by Δt, H by action / Δt.

    Parameters
    ----------
    system : HamiltonianSystem
    scaling : Scaling
    residual_weight, matching_weight : float
        w_1, w_2; a loss of weight 0 is not evaluated.

    References
    ----------
    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, Hamiltonian matching for symplectic
       neural integrators, 2024, section 2.3.
    """

    system: HamiltonianSystem
    scaling: Scaling
    residual_weight: float = 1.0
    matching_weight: float = 1.0

    def residual(self, flow: FlowMap, points: Points) -> Tensor:
        """(d/dt ψ̄_t(x) − J∇H(ψ̄_t(x))) Δt/s: (N, 2d)."""
        y, velocity = flow.psi_and_velocity(points.t, points.x)
        unit = torch.tensor(self.scaling.x, dtype=y.dtype, device=y.device) / self.scaling.t
        return (velocity - self.system.vector_field(y)) / unit

    def mismatch(self, flow: SympFlow, points: Points) -> Tensor:
        """(𝓗(ψ̄)(t, x) − H(x) − c(t)) Δt/action: (m, n)."""
        H = flow.hamiltonian_unchecked(points.matching_t, points.matching_x)
        difference = (H - self.system.hamiltonian(points.matching_x)) * (self.scaling.t / self.scaling.action)
        return difference - difference.mean(-1, keepdim=True)

    def terms(self, flow: FlowMap, points: Points) -> tuple[Tensor | None, Tensor | None]:
        """L1 and L2, None where the weight is 0."""
        L1 = self.residual(flow, points).square().sum(-1).mean() if self.residual_weight else None
        L2 = None
        if self.matching_weight:
            assert isinstance(flow, SympFlow)  # train refuses a matching weight for any other
            L2 = self.mismatch(flow, points).square().mean()
        return L1, L2

    def total(self, terms: tuple[Tensor | None, Tensor | None]) -> Tensor:
        """w_1 L1 + w_2 L2."""
        L1, L2 = terms
        weighted = [w * L for w, L in ((self.residual_weight, L1), (self.matching_weight, L2)) if L is not None]
        return weighted[0] if len(weighted) == 1 else weighted[0] + weighted[1]

    def __call__(self, flow: FlowMap, points: Points) -> Tensor:
        """L at the points."""
        return self.total(self.terms(flow, points))
