"""Gauss–Newton steps on the residuals of a flow, damped as by Levenberg and Marquardt: what trains networks best."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sympflow.flow.flow_map import FlowMap
from sympflow.training.config import TrainingConfig
from sympflow.training.losses import Objective
from sympflow.training.weight_vector import put_weights, weight_vector

MAX_PARAMETERS = 8000
MAX_REJECTED = 20
FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-16
WELL_CONDITIONED = 1e-8  # damping above which (JᵀJ + λD²)s = −Jᵀr loses no more than half the digits
PATIENCE = 20
GAIN = 1e-2
PROBE = 0.1  # share of a step over which the curvature of the residuals is measured
PULL = 1e-16  # towards 0, per squared weight: it costs nothing until a weight runs away
CURVED = 0.75  # largest ratio of the second-order correction to the step


class GaussNewton:
    """Levenberg–Marquardt, one accepted step at a time.

    A step s minimizes ‖J s + r‖² + λ‖D s‖², D the largest norms that the columns of J have had, so that λ bounds
    the condition number: by the normal equations where it is large, else by a QR factorization of J. λ follows the
    gain ratio, actual over predicted decrease, as in [2]_. To r belongs a tiny multiple of the weights: a neuron that
    is saturated at all points may else run off to a step of any slope, which no held-out point sees, but an orbit meets
    after some ten thousand steps. The steps end where `PATIENCE` of them on the same points
    lower the loss by less than 1 %, or none does.

    Attributes
    ----------
    finished : str or None
        Why no more steps are worth while.

    References
    ----------
    .. [1] J. J. Moré, The Levenberg–Marquardt algorithm: implementation and theory, Lect. Notes Math. 630 (1978).
    .. [2] H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05 (1999).
    .. [3] M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg–Marquardt algorithm for nonlinear least-squares
       minimization, arXiv:1201.5885 (2012).
    """

    def __init__(self, flow: FlowMap, config: TrainingConfig) -> None:
        if flow.n_parameters > MAX_PARAMETERS:
            raise ValueError(
                f"`optimizer` 'gauss-newton' keeps a dense Jacobian and takes at most {MAX_PARAMETERS} parameters; the "
                f"flow has {flow.n_parameters}: use 'lbfgs' or 'adam'."
            )
        self.parameters = list(flow.parameters())
        self.damping, self.growth = FIRST_DAMPING, 2.0
        self.scale: Tensor | None = None  # D²
        self.costs: list[float] = []
        self.draw: int | None = None
        self.finished: str | None = None

    def state_dict(self) -> dict[str, Any]:
        return {
            "damping": self.damping,
            "growth": self.growth,
            "scale": self.scale,
            "costs": self.costs,
            "draw": self.draw,
            "finished": self.finished,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        n, scale = sum(w.numel() for w in self.parameters), state["scale"]
        if scale is not None and scale.shape != (n,):
            raise ValueError(f"`state` has a scale of shape {tuple(scale.shape)}, not {(n,)}: start afresh.")
        self.scale = None if scale is None else scale.to(self.parameters[0])
        self.damping, self.growth, self.costs = state["damping"], state["growth"], list(state["costs"])
        self.draw, self.finished = state["draw"], state["finished"]

    def step(self, index: int, objective: Objective) -> float:
        """Take a step; the loss before it."""
        x = weight_vector(self.parameters)
        r, J = objective.linearized()
        loss = float(r @ r)
        r, J = torch.cat([r, PULL**0.5 * x]), torch.cat([J, PULL**0.5 * torch.eye(len(x)).to(J)])
        cost = float(r @ r)
        if not math.isfinite(cost):
            return cost
        if objective.draw != self.draw:
            self.draw, self.costs = objective.draw, []
        G, g = J.T @ J, J.T @ r
        squares = G.diagonal()
        self.scale = squares.clone() if self.scale is None else torch.maximum(self.scale, squares)
        D = torch.where(self.scale > 0, self.scale, 1.0).sqrt()
        for _ in range(MAX_REJECTED):
            solve = self._damped(J, G, D)
            s = -solve(g)
            predicted = -float(s @ (G @ s + 2 * g))
            s = s + self._bend(objective, solve, x, s, r, J, D)
            put_weights(self.parameters, x + s)
            with torch.no_grad():
                after = float(objective()) + PULL * float((x + s) @ (x + s))
            gain = (cost - after) / predicted if predicted > 0 and math.isfinite(after) else -1.0
            if gain > 0:
                shrink = max(1 / 5, 1 - (2 * min(gain, 1.0) - 1) ** 3)
                self.damping, self.growth = max(self.damping * shrink, LEAST_DAMPING), 2.0
                self.costs = [*self.costs[-PATIENCE:], after]
                if len(self.costs) > PATIENCE and after > (1 - GAIN) * self.costs[0]:
                    self.finished = "it has converged"
                return loss
            self.damping, self.growth = self.damping * self.growth, self.growth * 2
        put_weights(self.parameters, x)
        self.damping, self.growth, self.finished = FIRST_DAMPING, 2.0, "no step lowers the loss"
        return loss

    def _damped(self, J: Tensor, G: Tensor, D: Tensor) -> Callable[[Tensor], Tensor]:
        """v → (JᵀJ + λD²)⁻¹ v."""
        identity = torch.eye(len(D), dtype=D.dtype, device=D.device)
        if self.damping > WELL_CONDITIONED:
            R, failed = torch.linalg.cholesky_ex(G / torch.outer(D, D) + self.damping * identity, upper=True)
        if self.damping <= WELL_CONDITIONED or failed:
            R = torch.linalg.qr(torch.cat([J / D, self.damping**0.5 * identity]), mode="r")[1]
        return lambda v: torch.cholesky_solve((v / D)[:, None], R, upper=True)[:, 0] / D

    def _bend(
        self,
        objective: Objective,
        solve: Callable[[Tensor], Tensor],
        x: Tensor,
        s: Tensor,
        r: Tensor,
        J: Tensor,
        D: Tensor,
    ) -> Tensor:
        """The geodesic acceleration of [3]_, by which a step follows a curved valley; 0 where it would lead astray."""
        put_weights(self.parameters, x + PROBE * s)
        probed = torch.cat([objective.residuals(), PULL**0.5 * (x + PROBE * s)])
        curvature = (probed - r - PROBE * (J @ s)) / PROBE**2
        bend = -solve(J.T @ curvature)
        small = 2 * torch.linalg.vector_norm(D * bend) <= CURVED * torch.linalg.vector_norm(D * s)
        return bend if small else torch.zeros_like(s)  # NaN is not small
