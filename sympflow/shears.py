"""The exact flow of a normal mode as three shears, of determinant 1 whatever their rounding, after quarter turns.

A mode (X, Y) turns by θ: θ = kπ/2 + r with |r| ≤ π/4, the k quarter turns swap X and Y and are exact, and

    X ← X + tan(r/2) Y,   Y ← Y − sin(r) X,   X ← X + tan(r/2) Y

is the rest. A matrix of cosines and sines would have the determinant cos² + sin² as rounded, and an energy that drifts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sympflow.arrays import Array, is_tensor

SPLITTER = 134217729.0  # 2²⁷ + 1


def shears(kinds: Sequence[str], rates: Array, s: Array) -> tuple[Array, Array, Array, Array]:
    """t, σ, c, d (..., n) of modes of these kinds and rates Ω (n,) over the times s (..., n), in the library of s.

    The flow is X ← cX + dY, Y ← cY − dX, where c and d are 0 or ±1, then X ← X + tY, Y ← Y − σX, X ← X + tY.
    """
    module: Any = np
    if is_tensor(s):
        import torch

        module = torch
    theta = rates * s
    k, r = _reduced(theta, 0.0 if is_tensor(s) else _low(rates, s, theta), module)
    one, zero = 1 + 0 * theta, 0 * theta
    c = module.where(k == 0, one, zero) - module.where(abs(k) == 2, one, zero)
    d = module.where(k == 1, one, zero) - module.where(k == -1, one, zero)
    t, sigma = module.tan(r / 2), module.sin(r)
    others = {
        "hyperbolic": lambda: (module.tanh(theta / 2), -module.sinh(theta)),
        "free": lambda: (theta / 2, zero),
        "idle": lambda: (zero, zero),
    }
    for kind in set(kinds) & set(others):
        here = np.array([other == kind for other in kinds])
        here = here if module is np else module.as_tensor(here, device=s.device)
        own_t, own_sigma = others[kind]()
        t, sigma = module.where(here, own_t, t), module.where(here, own_sigma, sigma)
        c, d = module.where(here, one, c), module.where(here, zero, d)
    return t, sigma, c, d


def sheared(X: Array, Y: Array, coefficients: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
    """The flow of `shears` on modes (..., n)."""
    t, sigma, c, d = coefficients
    X, Y = c * X + d * Y, c * Y - d * X
    X = X + t * Y
    Y = Y - sigma * X
    return X + t * Y, Y


def _reduced(theta: Array, low: Any, module: Any) -> tuple[Array, Array]:
    """θ + `low` as k quarter turns, −2 … 2, and the rest r, each to its own rounding: the library reduces θ exactly."""
    sine, cosine = module.sin(theta), module.cos(theta)
    k = module.round(module.arctan2(sine, cosine) / (np.pi / 2))
    s = module.where(abs(k) == 1, -k * cosine, module.where(k == 0, sine, -sine))
    c = module.where(abs(k) == 1, k * sine, module.where(k == 0, cosine, -cosine))
    r = module.arctan2(s, c) + low
    # what rounding of Ω s leaves of whole quarter turns is none: its shears would round one way in every step
    none = abs(r) <= 4 * float(module.finfo(theta.dtype).eps) * abs(theta)
    return k, module.where(none, r - r.detach() if is_tensor(r) else 0.0, r)


def _low(a: np.ndarray, b: np.ndarray, product: np.ndarray) -> np.ndarray:
    """What rounding took from the product a·b, exactly [Dekker 1971]; 0 where it overflows, or in float32."""
    if product.dtype != np.float64:
        return np.zeros_like(product)
    with np.errstate(all="ignore"):
        a_high, b_high = (SPLITTER * x - (SPLITTER * x - x) for x in (a, b))
        a_low, b_low = a - a_high, b - b_high
        low = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return np.where(np.isfinite(low), low, 0.0)
