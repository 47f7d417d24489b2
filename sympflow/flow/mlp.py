"""MLPFlow: the paper's baseline, a neural flow map without structure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sympflow.flow.activations import activation as activation_named
from sympflow.flow.base import FlowMap
from sympflow.flow.potentials import hidden_widths, outer
from sympflow.flow.scaling import Scaling


class MLPFlow(FlowMap):
    """ψ̄_t(x) = x + s · tanh(t/τ) N(x/s, t/τ), N a multilayer perceptron: exactly the identity at t = 0, not symplectic.

    Parameters
    ----------
    ndof, dt, dtype, device, seed, scale
        As for `SympFlow`.
    hidden : sequence of int
        Widths of the hidden layers. `MLPFlow.matching` picks them to have as many parameters as a SympFlow.
    activation : str
    """

    kind = "mlp"
    weight_t: nn.Parameter
    scale: Tensor
    center: Tensor
    tau: Tensor

    def __init__(
        self,
        ndof: int,
        hidden: Sequence[int] = (25, 25),
        activation: str = "tanh",
        dt: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        seed: int = 0,
        scale: Scaling | None = None,
    ) -> None:
        super().__init__(ndof, dt)
        self.hidden, self.activation = hidden_widths(hidden), activation
        self._sigma = activation_named(activation)
        scale = Scaling.unit(ndof, dt) if scale is None else scale
        generator = torch.Generator().manual_seed(seed)

        def uniform(*shape: int, fan_in: int) -> nn.Parameter:
            w = (2 * torch.rand(*shape, dtype=torch.float64, generator=generator) - 1) / fan_in**0.5
            return nn.Parameter(w.to(dtype=dtype, device=device))

        widths = (2 * ndof, *self.hidden, 2 * ndof)
        fans = (2 * ndof + 1, *self.hidden)
        self.weights = nn.ParameterList(
            uniform(n, m, fan_in=fan) for m, n, fan in zip(widths[:-1], widths[1:], fans, strict=True)
        )
        self.biases = nn.ParameterList(uniform(n, fan_in=fan) for n, fan in zip(widths[1:], fans, strict=True))
        self.weight_t = uniform(self.hidden[0], fan_in=2 * ndof + 1)

        def constant(value: Any) -> Tensor:
            return torch.as_tensor(value, dtype=dtype, device=device)

        self.register_buffer("scale", constant(list(scale.x)))
        self.register_buffer("center", constant([*(scale.q_center or ()), *(scale.p_center or ())]))
        self.register_buffer("tau", constant(scale.t))

    @classmethod
    def matching(cls, flow: FlowMap, seed: int = 0, scale: Scaling | None = None) -> MLPFlow:
        """An MLPFlow of two hidden layers whose parameters number those of `flow`, within 2 %."""
        d, target = flow.ndof, flow.n_parameters
        counts = {
            (m, n): (2 * d + 2) * m + (m + 1) * n + (n + 1) * 2 * d
            for m in range(1, 2 * int(target**0.5) + 2)
            for n in range(max(1, m - 6), m + 7)
        }
        m, n = min(counts, key=lambda widths: (abs(counts[widths] - target), abs(widths[0] - widths[1])))
        if abs(counts[m, n] - target) > 0.02 * target:
            raise ValueError(
                f"`flow` has only {target} parameters, which no MLPFlow matches within 2 %: use a larger flow."
            )
        return cls(d, (m, n), dt=flow.dt, dtype=flow.dtype, device=flow.device, seed=seed, scale=scale)

    def architecture(self) -> dict[str, Any]:
        return {"ndof": self.ndof, "hidden": list(self.hidden), "activation": self.activation}

    def forward(self, t: float | Tensor, x: Tensor) -> Tensor:
        """ψ_t(x) for t ≥ 0, extended beyond Δt as SympFlow is; for t < 0 a ValueError, for want of an inverse."""
        checked = self._checked(t, x)
        negative = checked < 0 if isinstance(checked, float) else bool((checked < 0).any())
        if negative:
            raise ValueError("`t` must not be negative: an MLPFlow has no exact inverse; use a SympFlow to go back.")
        return super().forward(t, x)

    def inverse(self, t: float | Tensor, x: Tensor) -> Tensor:
        """Not available: an unconstrained network need not be invertible."""
        raise TypeError("`inverse` does not exist for an MLPFlow, which need not be invertible: use a SympFlow.")

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        s = self.scale[:, None]
        tau_t = t / self.tau
        h = torch.addmm(self.biases[0][:, None], self.weights[0], (y - self.center[:, None]) / s)
        h = self._sigma.value(h + outer(self.weight_t, tau_t))
        for W, b in zip(self.weights[1:-1], self.biases[1:-1], strict=True):
            h = self._sigma.value(torch.addmm(b[:, None], W, h))
        return y + s * (torch.tanh(tau_t) * torch.addmm(self.biases[-1][:, None], self.weights[-1], h))

    def _map_inverse(self, t: float | Tensor, y: Tensor) -> Tensor:
        return self.inverse(t, y)

    def _map_tangent(self, t: float | Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        s, k = self.scale[:, None], self.weight_t
        tau_t = t / self.tau
        a = torch.addmm(self.biases[0][:, None], self.weights[0], (y - self.center[:, None]) / s)
        h, slope = self._sigma.slope(a + outer(k, tau_t))
        dh = slope * k[:, None]
        for W, b in zip(self.weights[1:-1], self.biases[1:-1], strict=True):
            h, slope = self._sigma.slope(torch.addmm(b[:, None], W, h))
            dh = slope * (W @ dh)
        N = torch.addmm(self.biases[-1][:, None], self.weights[-1], h)
        ramp = torch.tanh(tau_t)
        dN = (1 - ramp * ramp) * N + ramp * (self.weights[-1] @ dh)
        return y + s * (ramp * N), s / self.tau * dN
