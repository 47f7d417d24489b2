"""The few array operations that NumPy and torch spell differently.

Dispatch is on the type of the argument, so that NumPy calls never import torch.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

Array = Any
"""A NumPy array or a torch tensor."""


def is_tensor(x: object) -> bool:
    """Return True for a torch tensor, decided without importing torch."""
    kind = type(x)
    return kind is not np.ndarray and kind.__module__.partition(".")[0] == "torch" and hasattr(x, "requires_grad")


def concatenate(parts: Sequence[Array]) -> Array:
    """Join arrays along the last axis."""
    if is_tensor(parts[0]):
        import torch

        return torch.cat(tuple(parts), dim=-1)
    return np.concatenate(parts, axis=-1)


def stack(parts: Sequence[Array], axis: int = -1) -> Array:
    """Join arrays along a new axis."""
    if is_tensor(parts[0]):
        import torch

        return torch.stack(tuple(parts), dim=axis)
    return np.stack(parts, axis=axis)


def assemble(values: Sequence[Any], like: Array) -> Array:
    """Stack numbers and arrays of shape `like.shape` along a new last axis, in the dtype of `like`."""
    if is_tensor(like):
        import torch

        return torch.stack([v + torch.zeros_like(like) if is_number(v) else v for v in values], dim=-1)
    out = np.empty((*np.shape(like), len(values)), dtype=like.dtype)
    for i, value in enumerate(values):
        out[..., i] = value
    return out


def is_number(x: object) -> bool:
    """Return True for a Python scalar rather than an array (generated code returns these for constants)."""
    return isinstance(x, int | float)


def per_state(h: Any, y: Array) -> Any:
    """`h` of shape y.shape[:-1] (one value a state) made to broadcast against (..., k); numbers pass."""
    return h[..., None] if getattr(h, "ndim", 0) else h


def to_numpy(x: Array) -> np.ndarray:
    """A NumPy view or copy of `x`, detached from any graph."""
    return x.detach().cpu().numpy() if is_tensor(x) else np.asarray(x)


def all_finite(y: Array) -> Array:
    """Return True for each of the states y (..., k) that is finite: (...) booleans."""
    if is_tensor(y):
        import torch

        return torch.isfinite(y).all(-1)
    return np.isfinite(y).all(-1)


def full_of_nan(y: Array) -> Array:
    """NaN in the shape, dtype and library of `y`, and in no graph."""
    if is_tensor(y):
        import torch

        return torch.full_like(y, np.nan, requires_grad=False)
    return np.full_like(y, np.nan)


def jvp(f: Callable[[Array], Array], x: Array, v: Array) -> tuple[Array, Array]:
    """Return f(x) and its derivative at the tensor x along v, by torch, without the warnings that its set-up gives."""
    import torch

    _set_up()
    y, dy = torch.func.jvp(f, (x,), (v,))[:2]
    return y, dy


@cache
def _set_up() -> None:
    """The first forward-mode derivative of a process makes torch import modules that warn of its own deprecations."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        x = torch.zeros(1)
        torch.func.jvp(torch.sin, (x,), (x,))
