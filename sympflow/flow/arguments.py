"""The arguments of a flow map, times t and states x, checked."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from sympflow.flow.base import FlowMap


def checked_time(flow: FlowMap, t: Any, x: Any) -> float | Tensor:
    """`t` as a finite float or tensor; `x` is checked to be a state for this flow.

    Raises
    ------
    ValueError, TypeError
        If one of them has the wrong type, shape, dtype or device, or t is not finite.
    """
    if not isinstance(x, Tensor):
        raise TypeError(f"`x` must be a torch tensor, not {type(x).__name__}: use torch.as_tensor(x).")
    if x.dtype != flow.dtype:
        raise TypeError(f"`x` is {x.dtype} but the flow is {flow.dtype}: convert one, as by x.to({flow.dtype}).")
    if x.device != flow.device:
        raise ValueError(f"`x` is on {x.device} but the flow on {flow.device}: move one, as by x.to(flow.device).")
    if x.ndim == 0 or x.shape[-1] != 2 * flow.ndof:
        raise ValueError(
            f"`x` must have shape (..., {2 * flow.ndof}), states [q, p]; got {tuple(x.shape)}: "
            "put them on the last axis."
        )
    if isinstance(t, Tensor) and (t.ndim or t.requires_grad):
        if t.dtype == torch.bool or t.is_complex():
            raise TypeError(f"`t` must be real times; got {t.dtype}: use a floating-point tensor.")
        if t.device != x.device:
            raise ValueError(f"`t` is on {t.device} but `x` on {x.device}: move one of them.")
        if not torch.isfinite(t).all():
            raise ValueError("`t` must be finite: remove its NaN and infinite entries.")
        try:
            torch.broadcast_shapes(t.shape, x.shape[:-1])
        except RuntimeError:
            raise ValueError(
                f"`t` of shape {tuple(t.shape)} does not broadcast against the batch shape "
                f"{tuple(x.shape[:-1])} of `x`: add axes, as by t[:, None]."
            ) from None
        return t
    try:
        value = float(t)
    except (TypeError, ValueError):
        raise TypeError(f"`t` must be a number or a tensor of times; got {type(t).__name__}: pass seconds.") from None
    if not math.isfinite(value):
        raise ValueError(f"`t` must be finite; got {value}: pass a finite time.")
    return value


def check_system(system: Any) -> None:
    """Raise unless `system` is a HamiltonianSystem."""
    from sympflow.hamiltonian.system import HamiltonianSystem

    if not isinstance(system, HamiltonianSystem):
        raise TypeError(
            f"`system` must be a HamiltonianSystem; got {type(system).__name__}: take a scene of sympflow.systems, or "
            "define one with HamiltonianSystem.from_sympy."
        )


def bare_time(flow: FlowMap, t: Any, x: Any) -> float | Tensor:
    """`t`, checked to lie in [0, Δt]."""
    t = checked_time(flow, t, x)
    low, high, slack = 0.0, 0.0, 1e-14
    if isinstance(t, float):
        low = high = t
    elif t.numel():
        low, high = float(t.detach().min()), float(t.detach().max())
        slack = 1e-6 if t.dtype == torch.float32 else slack
    if low < 0 or high > flow.dt * (1 + slack):
        raise ValueError(f"`t` must lie in [0, dt] = [0, {flow.dt:g}]; got {low} to {high}: reduce it modulo dt.")
    return t.to(x.dtype) if isinstance(t, Tensor) else t
