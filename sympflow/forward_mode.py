"""Forward-mode derivatives by torch, without the warnings that its own set-up gives."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor


def jvp(f: Callable[[Tensor], Tensor], x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """f(x), and its derivative at x along v."""
    _set_up()
    y, dy = torch.func.jvp(f, (x,), (v,))[:2]
    return y, dy


@cache
def _set_up() -> None:
    """The first forward-mode derivative of a process makes torch import modules that warn of its own deprecations."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        x = torch.zeros(1)
        torch.func.jvp(torch.sin, (x,), (x,))
