"""How many whole steps Δt a time holds: an integer count, robust to rounding, not a floating floor."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

MAX_STEPS = 10_000_000


def whole_steps(t: float, dt: float) -> tuple[int, float]:
    """k = ⌊t/Δt⌋ and r = t − kΔt ∈ [0, Δt) for t ≥ 0, counting a multiple of Δt up to rounding as one: 0.3/0.1 is 3.

    Raises
    ------
    ValueError
        If k would exceed ten million.
    """
    ratio = t / dt
    if ratio > MAX_STEPS:
        raise _too_many_steps(t, dt)
    near = round(ratio)
    if abs(ratio - near) <= 2 * np.finfo(float).eps * near:
        return near, 0.0
    k = math.floor(ratio)
    return k, min(max(t - k * dt, 0.0), dt)


def whole_steps_of_each(t: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """The same for a tensor of times t ≥ 0, each to the rounding of its dtype: integer k and float64 r.

    Gradients flow through r to t.
    """
    eps = torch.finfo(t.dtype).eps if t.is_floating_point() else 0.0
    t = t.to(torch.float64)
    ratio = t.detach() / dt
    near = ratio.round()
    exact = (ratio - near).abs() <= 2 * eps * near
    k = torch.where(exact, near, ratio.floor())
    if k.numel() and k.max() > MAX_STEPS:
        raise _too_many_steps(float(t.detach().max()), dt)
    r = t - k * dt
    return k.to(torch.int64), torch.where(exact, r - r.detach(), r).clamp(0.0, dt)


def _too_many_steps(t: float, dt: float) -> ValueError:
    return ValueError(f"`t` = {t:g} needs more than {MAX_STEPS:,} steps of dt = {dt:g}: use sympflow.solve.")
