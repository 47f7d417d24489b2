"""Steps of Gauss's collocation methods by arrays and tensors: any H, its stages solved by Newton's iteration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sympflow.arrays import (
    Array,
    as_array,
    beside,
    concatenate,
    detached,
    is_tensor,
    library,
    like,
    per_state,
    stack,
    values,
)
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.times import stage_time

Tableau = tuple[tuple[tuple[float, ...], ...], tuple[float, ...], tuple[float, ...]]
"""A, B and scale of the increments K_i = h scale_i f(y + Σ_j A_ij K_j) and the step y + Σ_i B_i K_i.

In Butcher's letters a_ij = A_ij scale_j and b_i = B_i scale_i."""
MOST_ITERATIONS = 50
DIFFERENTIATED = 3  # iterations in the graph, and so the orders of derivatives that are right
TRACED_ITERATIONS = 8
"""Newton's iterations in a graph that `torch.compile` traces; from K = 0 some five converge where dt is sensible."""


def counted_step(system: HamiltonianSystem, tableau: Tableau, t: Any, y: Array, h: float | Array) -> tuple[Array, int]:
    """One step of length h, a number or (...), from states y (..., 2d) at the time t; Newton's iterations in sum."""
    length = per_state(h, y)
    K, iterations = stages(system, tableau, y, length, stage_times(tableau, t, y, h))
    return advanced(system, tableau, y, K, length), iterations


def stage_times(tableau: Tableau, t: Any, y: Array, h: Any) -> Any:
    """The times t + c_i h of the stages, (..., s)."""
    nodes, batch = stage_nodes(tableau), y.shape[:-1]
    times = [stage_time(t, c, h) for c in nodes]
    return stack([library(y).broadcast_to(beside(s, y), batch) for s in times], axis=-1)


def advanced(system: HamiltonianSystem, tableau: Tableau, y: Array, K: Array, h: Any) -> Array:
    """The state at the end of a step of length h (..., 1), or a number, with the increments K (..., s, 2d)."""
    end = y + sum(b * K[..., i, :] for i, b in enumerate(tableau[1]))
    d = system.ndof
    return concatenate([end[..., :d], system.friction.drift(end[..., d:], h)[1]])


def stages(system: HamiltonianSystem, tableau: Tableau, y: Array, h: Any, times: Any) -> tuple[Array, int]:
    """The K (..., s, 2d) of a step, NaN where the step was not solved; and the iterations, over all states.

    Of tensors they are solved without a graph, then by `DIFFERENTIATED` more iterations in it, for their derivatives.
    """
    A, _, scale = (like(c, y) for c in tableau)
    if not is_tensor(y):
        with np.errstate(all="ignore"):
            return _solved_stages(system, y, h, times, A, scale)
    import torch

    with torch.no_grad():
        start, length = y.detach(), detached(h)
        K, iterations = _solved_stages(system, start, length, times, A, scale)
        M, _ = newton_matrix(system, start[..., None, :] + A @ K, length, times, A, scale)
        sizes = _kind_sizes(M, y.shape[-1])
        inverse = sizes[..., :, None] * torch.linalg.inv_ex(_scaled(M, sizes))[0] / sizes[..., None, :]
    for _ in range(DIFFERENTIATED):
        K = K - (inverse @ _residual(system, y, K, h, times, A, scale)[..., None])[..., 0].reshape(K.shape)
    return K, iterations


def _solved_stages(
    system: HamiltonianSystem, y: Array, h: Any, times: Any, A: Array, scale: Array
) -> tuple[Array, int]:
    """The K of `stages` by Newton's iteration, until it is at rounding in every state, and its count over all."""
    xp, eps = library(y), float(library(y).finfo(y.dtype).eps)
    K = y[..., None, :] * xp.zeros_like(A[:, :1])
    before = y[..., 0] * 0 + xp.inf
    done = before < 0
    for iteration in range(1, MOST_ITERATIONS + 1):
        M, _ = newton_matrix(system, y[..., None, :] + A @ K, h, times, A, scale)
        residual = _residual(system, y, K, h, times, A, scale)
        change = solved(M, residual[..., None], variable_sizes(y, K, residual))[..., 0].reshape(K.shape)
        K = xp.where(done[..., None, None], K, K - change)
        size = _relative_size(change, y, K, system.ndof)
        small = (size <= eps**0.7) | ((size <= eps**0.57) & (size >= before / 2))
        lost = ~(size < xp.inf) & ~done
        K = xp.where(lost[..., None, None], xp.nan, K)
        done, before = done | small | lost, size
        found = values(done)
        if iteration == TRACED_ITERATIONS if found is None else found.all():
            break
    return xp.where(done[..., None, None], K, xp.nan), iteration * math.prod(done.shape)


def stage_nodes(tableau: Tableau) -> tuple[float, ...]:
    """The nodes c_i of the stages, in steps."""
    A, _, scale = tableau
    return tuple(float(np.dot(row, scale)) for row in A)


def _residual(system: HamiltonianSystem, y: Array, K: Array, h: Any, times: Any, A: Array, scale: Array) -> Array:
    """K_i − h scale_i f(Y_i), (..., s·2d)."""
    outer = h[..., None] if getattr(h, "ndim", 0) else h
    residual = K - outer * scale[:, None] * _field(system, y[..., None, :] + A @ K, h, times, A, scale)
    return residual.reshape(*residual.shape[:-2], -1)


def _field(system: HamiltonianSystem, Y: Array, h: Any, times: Any, A: Array, scale: Array) -> Array:
    """f of the stages Y (..., s, 2d); with friction of [q, P], [∂H/∂p, −e^{Γτ}∂H/∂q] at p = e^{−Γτ}P."""
    friction, d = system.friction, system.ndof
    if not friction:
        return system.vector_field(Y, times)
    tau = (A @ scale * h)[..., None]
    slope = system.gradient(concatenate([Y[..., :d], friction.drift(Y[..., d:], tau)[1]]), times)
    return concatenate([slope[..., d:], -friction.drift(slope[..., :d], -tau)[1]])


def decays(system: HamiltonianSystem, s: Any) -> Array:
    """e^{−Γs} for times s, a number or (...): (..., d, d)."""
    s = as_array(s)
    return system.friction.drift(like(np.eye(system.ndof), s), s[..., None, None])[1]


def newton_matrix(
    system: HamiltonianSystem, Y: Array, h: Any, times: Any, A: Array, scale: Array
) -> tuple[Array, Array]:
    """M = I − h (scale_i A_ij f'(Y_i)), (..., s·2d, s·2d), and f'(Y), (..., s, 2d, 2d)."""
    d, (s, n) = system.ndof, Y.shape[-2:]
    if system.local is not None:
        system.local.check_dense(float(math.prod(Y.shape)) * s * n, "the matrix of the equations of an implicit step")
    tau: Any = None
    if system.friction:
        tau = A @ scale * h
        p = system.friction.drift(Y[..., d:], tau[..., None])[1]
        Y = concatenate([Y[..., :d], p])
    S = system.hessian(Y, times)
    D = concatenate([S[..., d:, :], -S[..., :d, :]], -2)
    if tau is not None:
        D = concatenate([D[..., :d], D[..., d:] @ decays(system, tau)])
        D = concatenate([D[..., :d, :], decays(system, -tau) @ D[..., d:, :]], -2)
    outer = h[..., None, None, None] if getattr(h, "ndim", 0) else h
    blocks = outer * (scale[:, None] * A)[:, None, :, None] * D[..., :, :, None, :]
    M = -blocks.reshape(*Y.shape[:-2], s * n, s * n)
    return M + like(np.eye(s * n), M), D


def variable_sizes(y: Array, K: Array, residual: Array) -> Array:
    """The size of each unknown of a step, (..., s·2d), as a power of 2: of its own, or of its kind where that is 0."""
    xp, n = library(y), y.shape[-1]
    both = xp.maximum(xp.amax(abs(K), -2), xp.amax(abs(residual).reshape(K.shape), -2))
    own = xp.maximum(abs(y), both).reshape(*y.shape[:-1], 2, n // 2)
    kind = xp.amax(own, -1)[..., None] + 0 * own
    size = xp.where(own > 0, own, xp.where(kind > 0, kind, 1 + 0 * kind))
    most = int(0.4 * math.log2(float(xp.finfo(y.dtype).max)))  # so that their ratios are numbers
    powers = xp.exp2(xp.clip(xp.round(xp.log2(size)), -most, most)).reshape(*y.shape[:-1], 1, n) + 0 * K
    return powers.reshape(*y.shape[:-1], -1)


def _kind_sizes(M: Any, n: int) -> Any:
    """Sizes of q and p, (..., s·2d), by which each moves the other alike; those of a state may be of its rounding."""
    s, d = M.shape[-1] // n, n // 2
    most = abs(M).reshape(*M.shape[:-2], s, 2, d, s, 2, d).amax((-6, -4, -3, -1))
    ratio = (most[..., 1, 0] / most[..., 0, 1]).sqrt()
    ratio = library(M).where((ratio > 0) & (ratio < math.inf), ratio, 1 + 0 * most[..., 0, 0])
    sizes = stack([1 + 0 * ratio, ratio])[..., None, :, None]
    return sizes.expand(*M.shape[:-2], s, 2, d).reshape(*M.shape[:-2], s * n)


def _scaled(M: Array, sizes: Array) -> Array:
    """M for unknowns in units of their sizes."""
    return M * (sizes[..., None, :] / sizes[..., :, None])


def solved(M: Array, x: Array, sizes: Array) -> Array:
    """M⁻¹x by elimination in units of the sizes of the unknowns; of arrays NaN where M is singular."""
    M, x = _scaled(M, sizes), x / sizes[..., None]
    if is_tensor(M):
        return library(M).linalg.solve_ex(M, x)[0] * sizes[..., None]
    try:
        return np.linalg.solve(M, x) * sizes[..., None]
    except np.linalg.LinAlgError:
        out = np.full(x.shape, np.nan, dtype=x.dtype)
        for i in np.ndindex(M.shape[:-2]):
            if np.isfinite(M[i]).all() and np.linalg.matrix_rank(M[i]) == len(M[i]):
                out[i] = np.linalg.solve(M[i], x[i])
        return out * sizes[..., None]


def _relative_size(change: Array, y: Array, K: Array, d: int) -> Array:
    """The larger of ‖ΔK_q‖/(‖q‖ + ‖K_q‖) and ‖ΔK_p‖/(‖p‖ + ‖K_p‖), (...)."""
    xp = library(y)
    ratios = []
    for part in (slice(0, d), slice(d, None)):
        top = xp.amax(abs(change[..., part]), (-2, -1))
        scale = xp.amax(abs(y[..., part]) + xp.amax(abs(K[..., part]), -2), -1)
        ratios.append(xp.where(top == 0, 0 * top, top / xp.where(scale == 0, 1 + 0 * scale, scale)))
    return xp.maximum(*ratios)


def gauss_legendre(stages: int) -> Tableau:
    """The Gauss–Legendre method of s stages, order 2s, symplectic without rounding.

    With the Legendre polynomials P_k, orthonormal on [0, 1], and ξ_k = 1/(2√(4k² − 1)),

        a_ij/b_j = ½ + Σ_k ξ_k (P_k(c_i) P_{k−1}(c_j) − P_{k−1}(c_i) P_k(c_j)),   k = 1 … s − 1,

    so that a_ij/b_j + a_ji/b_i = 1 [Hairer, Wanner, Solving ODEs II, 1996, theorem IV.5.6]. The larger of the two lies
    in [1/2, 2], and the other is computed without rounding.
    """
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    P = np.polynomial.legendre.legvander(nodes, stages - 1) * np.sqrt(2 * np.arange(stages) + 1)
    S = np.zeros((stages, stages))
    for k in range(1, stages):
        S += (np.outer(P[:, k], P[:, k - 1]) - np.outer(P[:, k - 1], P[:, k])) / (2 * math.sqrt(4 * k * k - 1))
    larger = 0.5 + np.abs(S)
    ratios = np.where(S >= 0, larger, 1 - larger)
    half = [0.5 * w for w in weights.tolist()]
    if stages <= 2:  # equal weights, powers of two
        return _rows(ratios * half), tuple(half), (1.0,) * stages
    return _rows(ratios), (1.0,) * stages, tuple(half)


def _rows(A: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in A.tolist())
