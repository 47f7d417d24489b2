"""Potentials V(t, x) with closed-form derivatives: the Hamiltonians that a SympFlow is composed of.

Arrays here are feature-major: points x have shape (d, N), hidden features (h, N), one column a point. Products with
the small weight matrices are several times faster that way round. A time t is a float or a tensor of shape () or (N,).

A potential must be C² (Canizares et al. 2024, section 2.1), so every activation σ is smooth. Each is given by what the
sweeps through a network need of it, which shares more than separate derivatives would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.arguments import plain
from sympflow.flow.weights import check_memory, checked_device, checked_dtype

if TYPE_CHECKING:  # Numba and SymPy, which a flow needs only to be compiled
    from sympflow.kernels.network_loops import NetworkLayer

Time = float | Tensor

NO_NETWORK = "`flow` has layers other than kicks and drifts with MLP potentials: use backend='array'."


class Activation:
    """σ, and its derivatives as the sweeps need them."""

    def value(self, a: Tensor) -> Tensor:
        """σ(a)."""
        return self.slope(a)[0]

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """σ(a) and σ'(a)."""
        raise NotImplementedError

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """σ(a) and σ'(a), then their derivatives σ'(a) ȧ and σ''(a) ȧ along ȧ."""
        raise NotImplementedError


class Tanh(Activation):
    """tanh a."""

    def value(self, a: Tensor) -> Tensor:
        return torch.tanh(a)

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        h = torch.tanh(a)
        return h, 1 - h * h

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h, slope = self.slope(a)
        dh = slope * da
        return h, slope, dh, -2 * h * dh


class Sin(Activation):
    """sin a."""

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return torch.sin(a), torch.cos(a)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h, slope = self.slope(a)
        return h, slope, slope * da, -h * da


class Sigmoid(Activation):
    """1 / (1 + exp(−a))."""

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        h = torch.sigmoid(a)
        return h, h * (1 - h)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h, slope = self.slope(a)
        dh = slope * da
        return h, slope, dh, (1 - 2 * h) * dh


class Softplus(Activation):
    """log(1 + exp a)."""

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return torch.logaddexp(a, torch.zeros_like(a)), torch.sigmoid(a)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h, slope = self.slope(a)
        dh = slope * da
        return h, slope, dh, (1 - slope) * dh


class LogCosh(Activation):
    """log cosh a, whose derivative is tanh a."""

    def slope(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return torch.logaddexp(a, -a) - math.log(2), torch.tanh(a)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h, slope = self.slope(a)
        return h, slope, slope * da, (1 - slope * slope) * da


ACTIVATIONS: dict[str, Activation] = {
    "tanh": Tanh(),
    "sin": Sin(),
    "sigmoid": Sigmoid(),
    "softplus": Softplus(),
    "logcosh": LogCosh(),
}


def activation_named(name: str) -> Activation:
    """Return the activation of that name.

    Raises
    ------
    ValueError
        If there is none.
    """
    if not isinstance(name, str) or name not in ACTIVATIONS:
        raise ValueError(f"`activation` {name!r} is unknown: choose one of {', '.join(ACTIVATIONS)}.")
    return ACTIVATIONS[name]


class Potential(nn.Module):
    """V(t, x), of which layers need three combinations; a new kind of potential provides these.

    Duties
    ------
    1. `impulse(t, x)`: ∇V(t, x) − ∇V(0, x), shape (d, N).
    2. `impulse_and_rate(t, x)`: the impulse, and ∂_tV(t, x) of shape (N,).
    3. `impulse_and_tangent(t, x, dx)`: the impulse, and its derivative along a curve x(t) with velocity dx.
    4. `to_dict()`: its architecture, JSON-able, from which its family builds it again.
    """

    ndof: int

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        raise NotImplementedError

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        raise NotImplementedError

    def network(self, is_kick: bool) -> NetworkLayer:
        """Return the weights of a kick or drift of it for compiled loops; ValueError if there are none."""
        raise ValueError(NO_NETWORK)


class MLPPotential(Potential):
    """V(t, x) = c · N(t/τ, x/s), N a multilayer perceptron of any depth whose input is x with t appended.

    N(t, x) = w · σ(W_n σ(… σ(K x + k t + b_1) …) + b_n). It has no output bias: a constant in V moves nothing.
    Its x- and t-derivatives come from one forward and one reverse sweep through the layers, ∂_t∇V from carrying a
    tangent along both, and the evaluations at t and at 0 share K x.

    Parameters
    ----------
    ndof : int
        d, the size of x.
    hidden : sequence of int
        Widths of the hidden layers; the published architecture is (10, 10).
    activation : str
        σ, a name in `sympflow.flow.potentials.ACTIVATIONS`.
    scale, center : sequence of d floats, optional
        s, and the mean of x that the initial biases allow for.
    tau, gain : float
        τ and c.
    generator : torch.Generator, optional
        Source of the initial weights, uniform in ±1/√(fan in).

    Attributes
    ----------
    weight_x : (h_1, d), weight_t : (h_1,), biases : n × (h_l,), weights : (n−1) × (h_{l+1}, h_l), weight_out : (h_n,)
        The parameters K, k, b, W, w.
    scale : (d,), tau : (), gain : ()
        The buffers s, τ, c. `folded()` gives the weights with these multiplied in.

    References
    ----------
    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, Hamiltonian matching for symplectic
       neural integrators, 2024, section 2.1.
    """

    weight_x: nn.Parameter
    weight_t: nn.Parameter
    weight_out: nn.Parameter
    scale: Tensor
    tau: Tensor
    gain: Tensor

    def __init__(
        self,
        ndof: int,
        hidden: Sequence[int] = (10, 10),
        activation: str = "tanh",
        *,
        scale: Sequence[float] | None = None,
        center: Sequence[float] | None = None,
        tau: float = 1.0,
        gain: float = 1.0,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        hidden, dtype, device = hidden_widths(hidden), checked_dtype(dtype), checked_device(device)
        check_memory(f"`hidden` {hidden!r}", count_weights(ndof, hidden), "take narrower layers")
        self.ndof, self.hidden, self.activation = int(ndof), hidden, activation
        self._sigma = activation_named(activation)

        def uniform(*shape: int, fan_in: int) -> nn.Parameter:
            # Drawn in float64 on the CPU, so that a seed means the same flow in every dtype and on every device.
            w = (2 * torch.rand(*shape, dtype=torch.float64, generator=generator) - 1) / fan_in**0.5
            return nn.Parameter(w.to(dtype=dtype, device=device))

        self.weight_x = uniform(hidden[0], ndof, fan_in=ndof + 1)
        self.weight_t = uniform(hidden[0], fan_in=ndof + 1)
        fans = (ndof + 1, *hidden[:-1])
        self.biases = nn.ParameterList(uniform(h, fan_in=fan) for h, fan in zip(hidden, fans, strict=True))
        self.weights = nn.ParameterList(uniform(h, fan, fan_in=fan) for fan, h in pairwise(hidden))
        self.weight_out = uniform(hidden[-1], fan_in=hidden[-1])

        def constant(value: Any) -> Tensor:
            return torch.as_tensor(value, dtype=dtype, device=device)

        self.register_buffer("scale", constant([1.0] * ndof if scale is None else list(scale)))
        self.register_buffer("tau", constant(tau))
        self.register_buffer("gain", constant(gain))
        if center is not None:
            with torch.no_grad():
                self.biases[0] -= self.weight_x @ (constant(list(center)) / self.scale)

    def to_dict(self) -> dict[str, Any]:
        return {"type": "mlp", "hidden": list(self.hidden), "activation": self.activation}

    def folded(self) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor], Tensor]:
        """The weights (K/s, k/τ, [b_l], [W_l], c·w): V(t, x) = c·w · σ(… σ((K/s) x + (k/τ) t + b_1) …)."""
        K, k, w = self.weight_x / self.scale, self.weight_t / self.tau, self.gain * self.weight_out
        return K, k, list(self.biases), list(self.weights), w

    def network(self, is_kick: bool) -> NetworkLayer:
        from sympflow.kernels.network_loops import NetworkLayer

        K, k, b, W, w = self.folded()

        def array(weight: Tensor) -> np.ndarray:
            return weight.detach().cpu().numpy()

        return NetworkLayer(is_kick, self.activation, array(K), array(k), [*map(array, b)], [*map(array, W)], array(w))

    # V and its derivatives at one time ---------------------------------------------------------------

    def value(self, t: Time, x: Tensor) -> Tensor:
        """V(t, x): (N,)."""
        K, k, b, W, w = self.folded()
        h = self._sigma.value(K @ x + outer(k, t) + b[0][:, None])
        for W_l, b_l in zip(W, b[1:], strict=True):
            h = self._sigma.value(W_l @ h + b_l[:, None])
        return w @ h

    def gradient(self, t: Time, x: Tensor) -> Tensor:
        """∇V(t, x): (d, N)."""
        K, r = self._sensitivity(t, x)[:2]
        return K.T @ r

    def rate(self, t: Time, x: Tensor) -> Tensor:
        """∂_tV(t, x): (N,)."""
        _, r, k = self._sensitivity(t, x)
        return k @ r

    def gradient_tangent(self, t: Time, x: Tensor, dt: float, dx: Tensor) -> Tensor:
        """The derivative of ∇V along the direction (dt, dx): (d, N). With dx = 0, dt = 1 it is ∂_t∇V."""
        K, k, b, W, w = self.folded()
        a = K @ x + outer(k, t) + b[0][:, None]
        _, dr = self._sweeps_tangent(a, K @ dx + dt * k[:, None], b, W, w)
        return K.T @ dr

    def hessian(self, t: Time, x: Tensor) -> Tensor:
        """∇²V(t, x): (d, d, N)."""
        basis = torch.eye(self.ndof, dtype=x.dtype, device=x.device)
        return torch.stack([self.gradient_tangent(t, x, 0.0, e[:, None].expand_as(x)) for e in basis], 1)

    # the combinations that the layers use: t and 0 in one sweep -------------------------------------------

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        K, k, b, W, w = self.folded()
        r = self._sweeps(self._both_times(t, K @ x + b[0][:, None], k), b, W, w)
        r_t, r_0 = r.chunk(2, 1)
        return K.T @ (r_t - r_0)

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        K, k, b, W, w = self.folded()
        r = self._sweeps(self._both_times(t, K @ x + b[0][:, None], k), b, W, w)
        r_t, r_0 = r.chunk(2, 1)
        return K.T @ (r_t - r_0), k @ r_t

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        K, k, b, W, w = self.folded()
        a = self._both_times(t, K @ x + b[0][:, None], k)
        da = K @ dx
        r, dr = self._sweeps_tangent(a, torch.cat([da + k[:, None], da], 1), b, W, w)
        (r_t, r_0), (dr_t, dr_0) = r.chunk(2, 1), dr.chunk(2, 1)
        return K.T @ (r_t - r_0), K.T @ (dr_t - dr_0)

    # sweeps ---------------------------------------------------------------------------------------------

    def _sensitivity(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """K, r = ∂V/∂a (h_1, N) for the first pre-activation a, and k."""
        K, k, b, W, w = self.folded()
        return K, self._sweeps(K @ x + outer(k, t) + b[0][:, None], b, W, w), k

    @staticmethod
    def _both_times(t: Time, a: Tensor, k: Tensor) -> Tensor:
        """Pre-activations at t beside those at 0: (h_1, 2N)."""
        return torch.cat([a + outer(k, t), a], 1)

    def _sweeps(self, a: Tensor, b: list[Tensor], W: list[Tensor], w: Tensor) -> Tensor:
        """∂V/∂a (h_1, N), by a sweep forward through the layers and one back."""
        h, slope = self._sigma.slope(a)
        slopes = [slope]
        for W_l, b_l in zip(W, b[1:], strict=True):
            h, slope = self._sigma.slope(torch.addmm(b_l[:, None], W_l, h))
            slopes.append(slope)
        r = slopes[-1] if W else w[:, None] * slopes[-1]
        for W_l, slope in zip(_backward_weights(W, w), reversed(slopes[:-1]), strict=True):
            r = slope * (W_l.T @ r)
        return r

    def _sweeps_tangent(
        self, a: Tensor, da: Tensor, b: list[Tensor], W: list[Tensor], w: Tensor
    ) -> tuple[Tensor, Tensor]:
        """∂V/∂a and its derivative along da, both (h_1, N): the same two sweeps with a tangent beside."""
        h, slope, dh, dslope = self._sigma.tangent(a, da)
        slopes = [(slope, dslope)]
        for W_l, b_l in zip(W, b[1:], strict=True):
            h, slope, dh, dslope = self._sigma.tangent(torch.addmm(b_l[:, None], W_l, h), W_l @ dh)
            slopes.append((slope, dslope))
        r, dr = slopes[-1] if W else (w[:, None] * slope, w[:, None] * dslope)
        for W_l, (slope, dslope) in zip(_backward_weights(W, w), reversed(slopes[:-1]), strict=True):
            r, dr = W_l.T @ r, W_l.T @ dr
            r, dr = slope * r, torch.addcmul(dslope * r, slope, dr)
        return r, dr


def _backward_weights(W: list[Tensor], w: Tensor) -> list[Tensor]:
    """The weights as the reverse sweep meets them, w multiplied into the first: cheaper than into the features."""
    return [w[:, None] * W[-1], *reversed(W[:-1])] if W else []


def outer(k: Tensor, t: Time) -> Tensor:
    """k t: (h, 1) for one time, (h, N) for a time for each point."""
    return k[:, None] * t


def count_weights(inputs: int, hidden: Sequence[int]) -> int:
    """The number of weights of a network of these widths with one output, with those of the time."""
    fans = (inputs + 1, *hidden[:-1])
    return sum(h * fan + h for h, fan in zip(hidden, fans, strict=True)) + hidden[-1]


def hidden_widths(hidden: Sequence[int]) -> tuple[int, ...]:
    """Return `hidden`, checked."""
    widths = tuple(map(plain, hidden)) if isinstance(hidden, Sequence) else ()
    if not widths or any(isinstance(h, bool) or not isinstance(h, int) or h < 1 for h in widths):
        raise ValueError(f"`hidden` must be the widths of one or more hidden layers, such as (10, 10); got {hidden!r}.")
    return widths
