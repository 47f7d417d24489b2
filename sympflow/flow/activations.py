"""Activation functions σ with their first two derivatives, by name.

A potential must be C² (Canizares et al. 2024, section 2.1), and the velocity of the flow needs σ'': so an activation
is a function `ladder(a, order)` that returns (σ, σ', σ'')[: order + 1], sharing what the three have in common.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

Ladder = Callable[[Tensor, int], tuple[Tensor, ...]]


def tanh(a: Tensor, order: int) -> tuple[Tensor, ...]:
    """tanh a."""
    value = torch.tanh(a)
    if order == 0:
        return (value,)
    first = 1 - value * value
    return (value, first) if order == 1 else (value, first, -2 * value * first)


def sin(a: Tensor, order: int) -> tuple[Tensor, ...]:
    """sin a."""
    value = torch.sin(a)
    if order == 0:
        return (value,)
    first = torch.cos(a)
    return (value, first) if order == 1 else (value, first, -value)


def sigmoid(a: Tensor, order: int) -> tuple[Tensor, ...]:
    """1 / (1 + exp(−a))."""
    value = torch.sigmoid(a)
    if order == 0:
        return (value,)
    first = value * (1 - value)
    return (value, first) if order == 1 else (value, first, first * (1 - 2 * value))


def softplus(a: Tensor, order: int) -> tuple[Tensor, ...]:
    """log(1 + exp a)."""
    value = torch.logaddexp(a, torch.zeros_like(a))
    return (value,) if order == 0 else (value, *sigmoid(a, order - 1))


def logcosh(a: Tensor, order: int) -> tuple[Tensor, ...]:
    """log cosh a, whose derivative is tanh a."""
    value = torch.logaddexp(a, -a) - math.log(2)
    return (value,) if order == 0 else (value, *tanh(a, order - 1))


ACTIVATIONS: dict[str, Ladder] = {
    "tanh": tanh,
    "sin": sin,
    "sigmoid": sigmoid,
    "softplus": softplus,
    "logcosh": logcosh,
}


def activation(name: str) -> Ladder:
    """The activation of that name.

    Raises
    ------
    ValueError
        If there is none.
    """
    if not isinstance(name, str) or name not in ACTIVATIONS:
        raise ValueError(f"`activation` {name!r} is unknown: choose one of {', '.join(ACTIVATIONS)}.")
    return ACTIVATIONS[name]
