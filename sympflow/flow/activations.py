"""Activation functions σ with their derivatives, by name.

A potential must be C² (Canizares et al. 2024, section 2.1), so every σ here is smooth. Each is given by what the sweeps
through a network need of it, which shares more than separate derivatives would.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


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


def activation(name: str) -> Activation:
    """The activation of that name.

    Raises
    ------
    ValueError
        If there is none.
    """
    if not isinstance(name, str) or name not in ACTIVATIONS:
        raise ValueError(f"`activation` {name!r} is unknown: choose one of {', '.join(ACTIVATIONS)}.")
    return ACTIVATIONS[name]
