"""MLPFlow: the paper's baseline, a neural flow map without structure."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Self

import torch
from torch import Tensor, nn

from sympflow.flow.flow_map import FlowMap, to_values
from sympflow.flow.potentials import activation_named, count_weights, hidden_widths, outer, uniform_weights
from sympflow.flow.records import checked_widths
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.flow.weights import check_memory, checked_device, checked_dtype

MAX_DIFFERENCE = 6  # between the widths of two layers that are about the same


class MLPFlow(FlowMap):
    """ψ̄_t(x) = x + s · tanh(t/τ) N(x/s, t/τ), N a multilayer perceptron: exactly the identity at t = 0, not symplectic.

    Parameters
    ----------
    ndof, dt, dtype, device, seed, scale
        As for `SympFlow`.
    hidden : sequence of int, optional
        Widths of the hidden layers; the default gives as many parameters as the default SympFlow has, within 2 %.
        `MLPFlow.matching` picks them to match any other SympFlow.
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
        hidden: Sequence[int] | None = None,
        activation: str = "tanh",
        dt: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        seed: int = 0,
        scale: Scaling | None = None,
    ) -> None:
        super().__init__(ndof, dt)
        dtype, device = checked_dtype(dtype), checked_device(device)
        if hidden is None:
            hidden = matching_widths(ndof, SympFlow(ndof, device="meta").n_parameters)
        if hidden is None:
            raise ValueError(f"`hidden` has no default for {ndof} degrees of freedom: give the widths, as by (30, 30).")
        self.hidden, self.activation = hidden_widths(hidden), activation
        self._sigma = activation_named(activation)
        weights = count_weights(2 * ndof, self.hidden) - self.hidden[-1] + 2 * ndof * (self.hidden[-1] + 1)
        check_memory(f"`hidden` {self.hidden!r}", weights, "take narrower layers")
        scale = Scaling.unit(ndof, dt) if scale is None else scale
        generator = torch.Generator().manual_seed(seed)
        uniform = partial(uniform_weights, generator=generator, dtype=dtype, device=device)
        widths = (2 * ndof, *self.hidden, 2 * ndof)
        fans = (2 * ndof + 1, *self.hidden)
        self.weights = nn.ParameterList(
            uniform(n, m, fan_in=fan) for m, n, fan in zip(widths[:-1], widths[1:], fans, strict=True)
        )
        self.biases = nn.ParameterList(uniform(n, fan_in=fan) for n, fan in zip(widths[1:], fans, strict=True))
        self.weight_t = uniform(self.hidden[0], fan_in=2 * ndof + 1)
        center = [*scale.q_center, *scale.p_center]
        for name, unit in (("scale", list(scale.x)), ("center", center), ("tau", scale.t)):
            self.register_buffer(name, torch.as_tensor(unit, dtype=dtype, device=device))

    @classmethod
    def matching(cls, flow: FlowMap, seed: int = 0, scale: Scaling | None = None, activation: str = "tanh") -> MLPFlow:
        """An MLPFlow with as many parameters as `flow`, within 2 %."""
        widths = matching_widths(flow.ndof, flow.n_parameters)
        if widths is None:
            raise ValueError(
                f"`flow` has only {flow.n_parameters} parameters, which no MLPFlow matches within 2 %: "
                "use a larger flow."
            )
        return cls(flow.ndof, widths, activation, flow.dt, flow.dtype, flow.device, seed, scale)

    def architecture(self) -> dict[str, Any]:
        return {"ndof": self.ndof, "hidden": list(self.hidden), "activation": self.activation}

    @classmethod
    def from_architecture(cls, ndof: int, plan: dict[str, Any], dt: float, dtype: torch.dtype) -> Self:
        hidden = checked_widths(plan.get("hidden"), 2 * ndof)
        return cls(ndof, hidden, str(plan.get("activation")), dt, dtype)

    def forward(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """ψ_t(x) for t ≥ 0, extended beyond Δt as SympFlow is; t < 0 raises ValueError, since it has no inverse."""
        checked = self._checked_time(t, x)
        negative = checked < 0 if isinstance(checked, float) else bool((to_values(checked) < 0).any())
        if negative:
            raise ValueError("`t` must not be negative: an MLPFlow has no exact inverse; use a SympFlow to go back.")
        return super().forward(t, x)

    def inverse(self, t: float | Tensor, x: Tensor, t0: Any = None) -> Tensor:
        """Not available: an unconstrained network need not be invertible."""
        raise TypeError("`inverse` does not exist for an MLPFlow, which need not be invertible: use a SympFlow.")

    def _map(self, t: float | Tensor, y: Tensor) -> Tensor:
        s = self.scale[:, None]
        tau_t = t / self.tau
        h = torch.addmm(self.biases[0][:, None], self.weights[0], (y - self.center[:, None]) / s)
        h = self._sigma.value(h + outer(self.weight_t, tau_t))
        for W, b in zip(list(self.weights)[1:-1], list(self.biases)[1:-1], strict=True):
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
        for W, b in zip(list(self.weights)[1:-1], list(self.biases)[1:-1], strict=True):
            h, slope = self._sigma.slope(torch.addmm(b[:, None], W, h))
            dh = slope * (W @ dh)
        N = torch.addmm(self.biases[-1][:, None], self.weights[-1], h)
        ramp = torch.tanh(tau_t)
        dN = (1 - ramp * ramp) * N + ramp * (self.weights[-1] @ dh)
        return y + s * (ramp * N), s / self.tau * dN


def matching_widths(ndof: int, target: int) -> tuple[int, ...] | None:
    """Widths of one or two hidden layers of an MLPFlow of `target` parameters within 2 %, None if there are none."""
    d = ndof

    def count(widths: tuple[int, ...]) -> int:
        return (2 * d + 2) * widths[0] + sum((m + 1) * n for m, n in pairwise((*widths, 2 * d)))

    def fits(widths: tuple[int, ...]) -> bool:
        return abs(count(widths) - target) <= 0.02 * target

    alike = [
        (m, n)
        for m in range(1, 2 * int(target**0.5) + 2)
        for n in range(max(1, m - MAX_DIFFERENCE), m + MAX_DIFFERENCE + 1)
    ]
    best: tuple[int, ...] = min(alike, key=lambda widths: (abs(count(widths) - target), abs(widths[0] - widths[1])))
    if fits(best):
        return best
    # For each first width the second that comes closest.
    first = range(1, target // (2 * d + 2) + 1)
    two = [(m, max(1, round((target - (2 * d + 2) * m - 2 * d) / (m + 1 + 2 * d)))) for m in first]
    one = [(max(1, round((target - 2 * d) / (4 * d + 2))),)]
    candidates: list[tuple[int, ...]] = [*filter(fits, two), *filter(fits, one)]
    return min(candidates, key=lambda widths: (-len(widths), abs(widths[0] - widths[-1])), default=None)
