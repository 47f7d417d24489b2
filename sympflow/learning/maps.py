"""Flow maps that are fitted to trajectories themselves: SympFlows with neural potentials, of no H that is written down.

ψ_t of a trajectory is ψ̄_{t−kΔt} ∘ (ψ̄_Δt)^k, as in every run of the flow: its weights are fitted, with the latent
initial states, by the same shooting as the numbers of an H.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.kernels.network_tangents import NetworkTangents
from sympflow.learning.models import VectorField
from sympflow.learning.orbits import Orbit, Over, Stepper

ON_TIME = 1e-9  # Share of Δt by which a time may exceed it and still counts as Δt


@dataclass(frozen=True)
class OwnSteps(Stepper):
    """The steps of a flow map that is fitted itself: Δt, and the rest at each point."""

    longest: float
    cost = 1.0

    def step(
        self, model: Any, theta: np.ndarray, x: np.ndarray, X: np.ndarray | None, h: np.ndarray, t: np.ndarray
    ) -> Any:
        return model.psi(theta, h, x, X)

    def orbit(self, over: Over, x: np.ndarray, X: np.ndarray | None, gaps: np.ndarray, t: np.ndarray) -> Orbit:
        passed = np.zeros(x.shape[1])  # since the last whole step
        for gap in gaps:
            passed = passed + gap
            while (late := passed > self.longest * (1 + ON_TIME)).any():
                some = None if X is None else X[..., late]
                end, slopes = over(x[:, late], some, np.full(int(late.sum()), self.longest), t[late])
                x = x.copy()
                x[:, late] = end
                if X is not None:
                    X = X.copy()
                    X[..., late] = slopes
                passed[late] -= self.longest
            yield over(x, X, passed, t) if passed.any() else (x, X)


class NetworkFlow(VectorField):
    """A SympFlow with neural potentials, its weights θ the numbers of a model.

    Palindromic, ψ_t = φ_{t/2} ∘ φ_{−t/2}⁻¹, so that ψ_{−t} = ψ_t⁻¹, it has twice the layers of φ and the weights of φ.
    """

    separable = nystrom = lagrangian = linear = False
    forces = 0
    parts = places = drives = ()

    def __init__(self, scaling: Scaling, pairs: int, width: int, palindromic: bool) -> None:
        self.scaling, self.pairs, self.width, self.palindromic = scaling, pairs, width, palindromic
        self.ndof, self.dt = len(scaling.q), scaling.t
        self.of_layer = width * (self.ndof + 3)
        self.n = 2 * pairs * self.of_layer
        self.prior = np.zeros(self.n)
        self.stepper = OwnSteps(scaling.t)

    def start(self, rng: np.random.Generator) -> np.ndarray:
        options: dict[str, Any] = {"dt": self.dt, "scale": self.scaling, "seed": int(rng.integers(2**31))}
        flow = SympFlow(self.ndof, self.pairs, [self.width], **options)
        return torch.cat([w.detach().reshape(-1) for w in flow.parameters()]).numpy()

    @cached_property
    def _layers(self) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
        """The place in θ and the factor of each weight of the flow, and the layers of φ that its own are."""
        order = tuple(range(2 * self.pairs))
        places = np.arange(self.n).reshape(2 * self.pairs, -1)
        if not self.palindromic:
            return places.ravel(), np.ones(self.n), order
        first = self.width * self.ndof  # then the factors of t, then those of the output
        half, inverse = np.ones(self.of_layer), np.ones(self.of_layer)
        half[first : first + self.width] = 0.5
        inverse[first : first + self.width] = -0.5
        inverse[first + self.width : first + 2 * self.width] = -1.0
        factors = np.concatenate([np.tile(inverse, 2 * self.pairs), np.tile(half, 2 * self.pairs)])
        return np.concatenate([places[::-1].ravel(), places.ravel()]), factors, (*order[::-1], *order)

    @cached_property
    def _tangents(self) -> NetworkTangents:
        made = self.flow(np.zeros(self.n)).tangents()
        assert made is not None
        return made

    def flow(self, theta: np.ndarray) -> SympFlow:
        """The flow with these weights."""
        places, factors, order = self._layers
        layers = [(Drift if i % 2 else Kick)(self._potential(i % 2 == 1)) for i in order]
        flow = SympFlow.from_layers(layers, self.dt)
        values = torch.from_numpy(theta[places] * factors)
        at = 0
        with torch.no_grad():
            for w in flow.parameters():
                w.copy_(values[at : at + w.numel()].view_as(w))
                at += w.numel()
        return flow.requires_grad_(False)

    def _potential(self, of_p: bool) -> MLPPotential:
        unit = self.scaling.p if of_p else self.scaling.q
        return MLPPotential(self.ndof, [self.width], scale=unit, tau=self.dt, gain=self.scaling.action)

    def psi(self, theta: np.ndarray, t: np.ndarray, x: np.ndarray, X: np.ndarray | None) -> Any:
        """ψ̄_t of columns x (2d, N), t (N,), and the derivatives (2d, c, N) of its end from those X of x."""
        places, factors, _ = self._layers
        weights, states, none = theta[places] * factors, np.ascontiguousarray(x.T), np.empty((0, x.shape[1]))
        end = self._tangents.values(weights, t, states, none, False)[0].T
        if X is None:
            return end, None
        m, N = x.shape
        P = np.empty((m, m, N))
        J = self._tangents.jacobian(weights, t, states, none, np.broadcast_to(np.eye(m), (N, m, m)).copy(), by_start=P)
        moved = np.einsum("ijn,jcn->icn", P, X)
        if X.shape[1] > m:
            J = J * factors[:, None, None]
            if self.palindromic:
                back = J[: self.n].reshape(2 * self.pairs, -1, m, N)[::-1]
                J = J[self.n :] + back.reshape(self.n, m, N)
            moved[:, m:] += J.transpose(1, 0, 2)
        return end, moved
