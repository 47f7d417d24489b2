"""Levenberg–Marquardt: least squares by Gauss–Newton steps, damped where the linear model fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import solve_triangular

MAX_REJECTED = 30
PROBE = 0.1  # share of a step over which the residuals' curvature is measured
STOPPED = "it was stopped"
CURVED = 0.75  # largest ratio of the second-order correction to the step


@dataclass(frozen=True)
class Minimum:
    """Where a search ended: parameters (n,), sum of squares, iterations, and why."""

    x: np.ndarray
    cost: float
    iterations: int
    reason: str


@np.errstate(over="ignore", invalid="ignore")  # of trials that go too far; what is not finite is rejected
def levenberg_marquardt(
    residuals: Callable[[np.ndarray], np.ndarray],
    linearized: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    x: np.ndarray,
    *,
    iterations: int = 200,
    patience: int = 10,
    gain: float = 1e-2,
    damping: float = 1e-3,
    stop: Callable[[], bool] = lambda: False,
) -> Minimum:
    """Minimize ‖r(x)‖².

    A step solves min ‖J s + r‖² + λ‖D s‖² by QR factorizations, never by normal equations; D holds the largest norms
    that the columns of J had. λ follows the gain ratio, actual over predicted decrease, as in [2]_. The step is bent
    by the geodesic acceleration of [3]_, which follows the curved valleys of such problems.

    Parameters
    ----------
    residuals : callable
        r(x), (m,); not finite where x is not admissible.
    linearized : callable
        r(x) and its Jacobian J(x), (m, n).
    x : ndarray, shape (n,)
        The start.
    iterations : int
        The most accepted steps.
    patience, gain : int, float
        The search ends when `patience` steps together lower the cost by less than this share of it.
    damping : float
        The first λ.
    stop : callable
        Asked before each step whether to end here.

    References
    ----------
    .. [1] J. J. Moré, The Levenberg–Marquardt algorithm: implementation and theory, Lect. Notes Math. 630 (1978).
    .. [2] H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05 (1999).
    .. [3] M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg–Marquardt algorithm for nonlinear least-squares
       minimization, arXiv:1201.5885 (2012).
    """
    r = residuals(x)
    cost = float(r @ r)
    if not np.isfinite(cost):
        return Minimum(x, np.inf, 0, "the residuals are not finite at the start")
    costs, scale, growth = [cost], np.zeros(len(x)), 2.0
    for iteration in range(iterations):
        if stop():
            return Minimum(x, cost, iteration, STOPPED)
        r, J = linearized(x)
        R = _qr(np.column_stack([J, r]), "r")[1]
        R, projected = R[: len(x), : len(x)], R[: len(x), -1]
        scale = np.maximum(scale, np.linalg.norm(R, axis=0))
        D = np.where(scale > 0, scale, 1.0)
        for _ in range(MAX_REJECTED):
            solve = _Damped(R, np.sqrt(damping) * D)
            step = -solve(projected)
            linear = projected + R @ step
            predicted = projected @ projected - linear @ linear
            curvature = (residuals(x + PROBE * step) - r - PROBE * (J @ step)) / PROBE**2
            bend = -solve.seminormal(J.T @ curvature) if np.isfinite(curvature).all() else np.inf * step
            if not 2 * np.linalg.norm(D * bend) <= CURVED * np.linalg.norm(D * step):
                bend = np.zeros_like(step)
            trial = x + step + bend
            r_trial = residuals(trial)
            cost_trial = float(r_trial @ r_trial)
            ratio = (cost - cost_trial) / predicted if predicted > 0 else -1.0
            if np.isfinite(cost_trial) and ratio > 0:
                damping = max(damping * max(1 / 5, 1 - (2 * min(ratio, 1.0) - 1) ** 3), 1e-20)
                growth = 2.0
                x, cost = trial, cost_trial
                break
            damping, growth = damping * growth, growth * 2
        else:
            return Minimum(x, cost, iteration, "no step lowers the cost")
        costs.append(cost)
        if len(costs) > patience and cost > (1 - gain) * costs[-1 - patience]:
            return Minimum(x, cost, iteration + 1, "it has converged")
    return Minimum(x, cost, iterations, "the iterations were used up")


class _Damped:
    """v → the s that minimizes ‖R s − v‖² + ‖D s‖², for several v."""

    def __init__(self, R: np.ndarray, D: np.ndarray) -> None:
        Q, self._R = _qr(np.concatenate([R, np.diag(D)]), "reduced")
        self._Q = Q[: len(R)]

    def __call__(self, v: np.ndarray) -> np.ndarray:
        return solve_triangular(self._R, self._Q.T @ v, check_finite=False)

    def seminormal(self, w: np.ndarray) -> np.ndarray:
        """(RᵀR + D²)⁻¹ w."""
        return solve_triangular(
            self._R, solve_triangular(self._R, w, trans="T", check_finite=False), check_finite=False
        )


def _qr(A: np.ndarray, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Q and R, on one thread: where others are at work too, several wait for each other a hundred times as long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        Q, R = torch.linalg.qr(torch.from_numpy(A), mode=mode)
    finally:
        torch.set_num_threads(threads)
    return Q.numpy(), R.numpy()
