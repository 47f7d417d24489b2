"""Potentials that are sums over pairs of bodies, as Numba functions: of pairs that no formula gives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sympflow.lazy import needed

OPTIONS = {"error_model": "numpy", "fastmath": {"contract"}}


def pair_functions(pair: Callable[..., Any], strength: np.ndarray, dim: int) -> dict[str, Any]:
    """V, ∇V and ∇²V·v of V(q) = Σ_{i<j} strength_ij·u(|q_i − q_j|²), q = [q_1, …, q_n] in `dim` coordinates each.

    Parameters
    ----------
    pair : Numba function
        s ↦ (u, u′, u″) at s = r².
    strength : ndarray of shape (n, n)
        Its upper triangle is used.
    dim : int

    Returns
    -------
    dict
        The arguments `potential`, `gradient`, `hessian_vector` and `ndof` of `HamiltonianSystem`.

    Raises
    ------
    ImportError
        If Numba is not installed.
    """
    try:
        from numba import njit
    except ImportError as error:
        raise ImportError(
            f"`pair` must be a Numba function, which needs Numba: {needed('numba', 'numba')}, or give the "
            "potential of a pair to HamiltonianSystem.pairs."
        ) from error

    n, D = len(strength), dim
    strength = np.ascontiguousarray(strength, dtype=float)

    @njit(**OPTIONS)
    def potential(q: Any) -> Any:
        V = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                s = 0.0
                for k in range(D):
                    s += (q[D * i + k] - q[D * j + k]) ** 2
                V += strength[i, j] * pair(s)[0]
        return V

    @njit(**OPTIONS)
    def gradient(q: Any, out: Any) -> None:
        for i in range(D * n):
            out[i] = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                s = 0.0
                for k in range(D):
                    s += (q[D * i + k] - q[D * j + k]) ** 2
                slope = 2.0 * strength[i, j] * pair(s)[1]
                for k in range(D):
                    change = slope * (q[D * i + k] - q[D * j + k])
                    out[D * i + k] += change
                    out[D * j + k] -= change

    @njit(**OPTIONS)
    def hessian_vector(q: Any, v: Any, out: Any) -> None:
        for i in range(D * n):
            out[i] = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                s = along = 0.0
                for k in range(D):
                    d = q[D * i + k] - q[D * j + k]
                    s += d * d
                    along += d * (v[D * i + k] - v[D * j + k])
                _, slope, curvature = pair(s)
                slope *= 2.0 * strength[i, j]
                curvature *= 4.0 * strength[i, j] * along
                for k in range(D):
                    change = slope * (v[D * i + k] - v[D * j + k]) + curvature * (q[D * i + k] - q[D * j + k])
                    out[D * i + k] += change
                    out[D * j + k] -= change

    return {"potential": potential, "gradient": gradient, "hessian_vector": hessian_vector, "ndof": D * n}
