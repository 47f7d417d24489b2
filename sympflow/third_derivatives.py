"""∇³V(v, w) by differences, for systems whose own functions end at ∇²V·v, and the step of such differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, is_tensor

if TYPE_CHECKING:
    from sympflow.hamiltonian import Hamiltonian


def third_derivative(system: Hamiltonian, q: Array, v: Array, w: Array) -> Array:
    """∇³V(q)(v, w), the derivative of ∇²V·w along v: (..., d), each, to (..., d).

    Good to ε^⅘ of ∇³V, 1e-12 of it in float64, where the force changes on lengths ℓ like |q|; where ℓ is far below |q|
    the rounding of q itself leaves (ε|q|/ℓ)^⅘.
    """
    along, other = direction(v), direction(w)
    with np.errstate(all="ignore"):
        h = step(q, length_of_change(system, q, along, other))
        change = derivative(lambda x: system.hessian_vector(x, other), q, along, h)
    return _largest(v) * _largest(w) * change


def derivative(f: Callable[[Array], Array], q: Array, along: Array, h: Array) -> Array:
    """That of f at q along unit vectors, by the central difference of order 4 with steps h (..., 1)."""
    near = f(q + h * along) - f(q - h * along)
    far = f(q + 2 * h * along) - f(q - 2 * h * along)
    return (8 * near - far) / (12 * h)


def direction(v: Array) -> Array:
    """v over its largest component; 0 for 0."""
    size = _largest(v)
    return v / (size + (size == 0))


def length_of_change(system: Hamiltonian, q: Array, along: Array, other: Array) -> Array:
    """ℓ = ‖∇V‖ / ‖∇²V v̂‖, on which the force changes along unit vectors v̂: (..., d) to (..., 1).

    It does not depend on where the origin lies, as |q| does. Where ∇²V v̂ nearly vanishes it says nothing: then it is
    (‖∇V‖ / ‖∇³V(v̂, ŵ)‖)^½, which is less. It is kept between √ε|q| and |q|, or 1 where that is more.
    """
    xp = _library(q)
    force, change = _largest(system.force(q)), _largest(system.hessian_vector(q, along))
    first = _bounded(xp.where(change > 0, force / (change + (change == 0)), np.inf), q)
    h = xp.finfo(q.dtype).eps ** (1 / 3) * first
    twice = system.hessian_vector(q + h * along, other) - system.hessian_vector(q - h * along, other)
    bend = _largest(twice) / (2 * h)
    second = xp.sqrt(force / (bend + (bend == 0)))
    return _bounded(xp.where((bend > 0) & (second < first), second, first), q)


def step(q: Array, length: Array) -> Array:
    """The h for which the truncation of `derivative`, (h/ℓ)⁴, and the rounding, ε max(|q|, ℓ)/h, are even."""
    eps, xp = _library(q).finfo(q.dtype).eps, _library(q)
    return length * (eps * xp.maximum(_largest(q) / length, 0 * length + 1)) ** 0.2


def _bounded(length: Array, q: Array) -> Array:
    xp = _library(q)
    size = _largest(q)
    size = size + (size == 0)
    return xp.minimum(xp.maximum(length, xp.finfo(q.dtype).eps ** 0.5 * size), xp.maximum(size, 0 * size + 1))


def _largest(x: Array) -> Array:
    return abs(x).amax(-1, True) if is_tensor(x) else abs(x).max(-1, keepdims=True)


def _library(x: Array) -> Any:
    if is_tensor(x):
        import torch

        return torch
    return np
