"""Shooting from latent initial states: what a Hamiltonian predicts along trajectories, and the fit of both.

Each piece of a trajectory has an initial state that is a parameter, because the measured one is as noisy as all others.
The predictions are those of the Gauss–Legendre scheme with two stages, of order 4, which is symplectic for any H; their
tangents are exact. In a Gauss–Newton step the initial states of a piece are eliminated by a Schur complement, so that
its cost grows linearly with the number of trajectories.

References
----------
.. [1] H. G. Bock, Recent advances in parameter identification techniques for O.D.E., Numerical Treatment of Inverse
   Problems in Differential and Integral Equations, Birkhäuser 1983, 95–121.
.. [2] E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer 2006, II.1.3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sympflow.learning.library import Library
from sympflow.learning.trajectories import Trajectories

A = np.array([[1 / 4, 1 / 4 - np.sqrt(3) / 6], [1 / 4 + np.sqrt(3) / 6, 1 / 4]])
NEWTON_STEPS = 12
NEWTON_TOLERANCE = 1e-11
LARGEST = 1e6
"""Size of a state, in the spread of the data, beyond which a prediction has diverged."""
STEPS = 40
CONVERGED = 1e-7
LARGEST_DAMPING = 1e9


@dataclass
class Normal:
    """The blocks of the normal equations: of initial states (P, 2d, 2d), of both (P, 2d, K), of parameters (K, K)."""

    cost: float
    squares: np.ndarray
    """Sum of squares of the residuals of each coordinate, (2d,)."""
    xx: np.ndarray
    xk: np.ndarray
    kk: np.ndarray
    gx: np.ndarray
    gk: np.ndarray

    def reduced(self, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The Schur complement (K, K) and gradient (K,) without the initial states; and xx⁻¹ [gx, xk]."""
        n = self.xx.shape[1]
        diagonal = np.einsum("pii->pi", self.xx)
        xx = self.xx + (np.maximum(diagonal * damping, 1e-12 * diagonal.max()))[:, :, None] * np.eye(n)
        solved = np.linalg.solve(xx, np.concatenate([self.gx[:, :, None], self.xk], axis=2))
        S = self.kk - np.einsum("pnk,pnl->kl", self.xk, solved[:, :, 1:])
        return (
            S + damping * np.diag(np.diag(self.kk)),
            self.gk - np.einsum("pnk,pn->k", self.xk, solved[:, :, 0]),
            solved,
        )


@dataclass
class Fit:
    """A fitted model: coefficients (K,), their covariance (K, K), initial states (P, 2d), noise (2d,).

    `sigma` are the weights of the fit, `noise` is what the model leaves.
    """

    theta: np.ndarray
    covariance: np.ndarray
    x0: np.ndarray
    sigma: np.ndarray
    noise: np.ndarray
    squares: np.ndarray
    cost: float
    """Σ (r/σ)²."""


class Shooting:
    """The trajectories of one set, ready to be compared with predictions.

    Parameters
    ----------
    data : Trajectories
    starts : ndarray, shape (P, 2d)
        First guess of the state at the start of each.
    step : float
        The longest step of the scheme.
    """

    def __init__(self, data: Trajectories, starts: np.ndarray, step: float) -> None:
        runs, n = data.runs, 2 * data.ndof
        most = max(run.n_points for run in runs)
        self.starts = starts
        self.spans = np.zeros((most - 1, len(runs)))
        self.y = np.full((most, len(runs), n), np.nan)
        for i, run in enumerate(runs):
            self.spans[: run.n_points - 1, i] = np.diff(run.t)
            self.y[: run.n_points, i] = run.y.T
        self.seen = np.isfinite(self.y)
        self.counts = self.seen.sum((0, 1))
        self.scales = data.scales
        self.step = step

    @property
    def n_values(self) -> int:
        return int(self.counts.sum())

    def normal(
        self, library: Library, theta: np.ndarray, x0: np.ndarray, sigma: np.ndarray, others: Library | None = None
    ) -> Normal:
        """The normal equations at a point.

        Parameters
        ----------
        library : Library
            The terms of H.
        theta, x0, sigma : ndarray
            Coefficients (K,), initial states (P, 2d) and noise (2d,).
        others : Library, optional
            The terms by whose coefficients is differentiated, if these are others; H has none of them beside its own.
        """
        followed = library if others is None else others
        P, n = x0.shape
        K = len(followed)
        xx, xk, kk = np.zeros((P, n, n)), np.zeros((P, n, K)), np.zeros((K, K))
        gx, gk, squares = np.zeros((P, n)), np.zeros(K), np.zeros(n)
        tangent = np.zeros((P, n, n + K))
        tangent[:, :, :n] = np.eye(n)
        for i, x, moved in self._points(library, theta, x0, tangent, followed):
            seen = self.seen[i]
            r = np.where(seen, x - np.where(seen, self.y[i], 0.0), 0.0)
            squares += (r**2).sum(0)
            weighted = moved * (seen / sigma)[:, :, None]
            e = r / sigma
            X, T = weighted[:, :, :n], weighted[:, :, n:]
            Xt = X.transpose(0, 2, 1)
            xx += Xt @ X
            xk += Xt @ T
            gx += (Xt @ e[:, :, None])[:, :, 0]
            flat = T.reshape(P * n, K)
            kk += flat.T @ flat
            gk += flat.T @ e.ravel()
        return Normal(float((squares / sigma**2).sum()), squares, xx, xk, kk, gx, gk)

    def squares(self, library: Library, theta: np.ndarray, x0: np.ndarray) -> np.ndarray:
        """Sum of squares of the residuals of each coordinate, (2d,); not finite where a prediction diverges."""
        total = np.zeros(x0.shape[1])
        for i, x, _ in self._points(library, theta, x0, None, library):
            total += (np.where(self.seen[i], x - np.where(self.seen[i], self.y[i], 0.0), 0.0) ** 2).sum(0)
        return total

    def predictions(self, library: Library, theta: np.ndarray, x0: np.ndarray) -> np.ndarray:
        """The predicted states (n, P, 2d)."""
        return np.stack([x for _, x, _ in self._points(library, theta, x0, None, library)])

    def _points(
        self, library: Library, theta: np.ndarray, x: np.ndarray, tangent: np.ndarray | None, followed: Library
    ) -> Iterator[tuple[int, np.ndarray, Any]]:
        """The predicted states at each point of the trajectories, and their tangents."""
        yield 0, x, tangent
        for i, spans in enumerate(self.spans):
            count = max(int(np.ceil(spans.max() / self.step * (1 - 1e-12))), 1)
            for _ in range(count):
                x, tangent = gauss_step(library, theta, x, spans / count, tangent, followed)
            if not (np.abs(x) <= LARGEST * self.scales + np.abs(self.starts).max()).all():
                x = np.full_like(x, np.nan)
                yield i + 1, x, tangent
                return
            yield i + 1, x, tangent

    # fits ---------------------------------------------------------------------------------------------------------

    def fit(
        self,
        library: Library,
        theta: np.ndarray,
        x0: np.ndarray,
        sigma: np.ndarray,
        free: bool = True,
        steps: int = STEPS,
    ) -> Fit | None:
        """The minimum of Σ (r/σ)² over coefficients and initial states, by Levenberg–Marquardt; None if it diverges.

        Parameters
        ----------
        library : Library
        theta, x0, sigma : ndarray
            The start, and the noise.
        free : bool
            False keeps the coefficients, as for trajectories that were held out.
        steps : int
            The most steps.
        """
        with np.errstate(all="ignore"):
            try:
                return self._fit(library, theta, x0, sigma, free, steps)
            except np.linalg.LinAlgError:
                return None

    def _fit(
        self, library: Library, theta: np.ndarray, x0: np.ndarray, sigma: np.ndarray, free: bool, steps: int
    ) -> Fit | None:
        followed = library if free else library.subset([])
        damping, now = 1e-3, self.normal(library, theta, x0, sigma, followed)
        if not np.isfinite(now.cost):
            return None
        for _ in range(steps):
            before = now.cost
            while damping < LARGEST_DAMPING:
                S, g, solved = now.reduced(damping)
                step = -np.linalg.solve(S, g) if free else np.empty(0)
                moved = x0 - solved[:, :, 0] - solved[:, :, 1:] @ step
                changed = theta + step if free else theta
                cost = float((self.squares(library, changed, moved) / sigma**2).sum())
                if cost < before:
                    theta, x0, damping = changed, moved, damping / 8
                    break
                damping *= 6
            else:
                break
            now = self.normal(library, theta, x0, sigma, followed)
            if before - now.cost <= CONVERGED * before:
                break
        covariance = np.linalg.pinv(now.reduced()[0]) if free else np.zeros((0, 0))
        freed = (x0.size + len(theta)) / len(self.counts)
        noise = np.sqrt(now.squares / np.maximum(self.counts - freed, 0.1 * self.counts))
        return Fit(theta, covariance, x0, sigma, noise, now.squares, now.cost)

    def gains(self, library: Library, fit: Fit, others: Library) -> np.ndarray:
        """Decrease of Σ (r/σ)² by each of other terms beside those of H, by the linear model."""
        both = Library.joined(library, others)
        with np.errstate(all="ignore"):
            S, g, _ = self.normal(library, fit.theta, fit.x0, fit.sigma, both).reduced()
            a = len(library)
            solved = np.linalg.solve(S[:a, :a], np.column_stack([S[:a, a:], g[:a]]))
            curvature = np.diag(S[a:, a:]) - np.einsum("ak,ak->k", S[:a, a:], solved[:, :-1])
            slope = g[a:] - S[a:, :a] @ solved[:, -1]
            usable = curvature > 1e-10 * np.diag(S[a:, a:])
            return np.where(usable, slope**2 / np.where(usable, curvature, 1.0), 0.0)


def gauss_step(
    library: Library, theta: np.ndarray, x: np.ndarray, h: np.ndarray, tangent: np.ndarray | None, followed: Library
) -> tuple[np.ndarray, np.ndarray | None]:
    """One step of each trajectory, and of its tangent (P, 2d, 2d + K) by initial state and coefficients.

    Parameters
    ----------
    library : Library
    theta : ndarray, shape (K,)
    x : ndarray, shape (P, 2d)
    h : ndarray, shape (P,)
    tangent : ndarray or None
    followed : Library
        The terms whose coefficients the tangent is by.
    """
    P, n = x.shape
    ha = h[:, None, None] * A
    slope = library.fields(x) @ theta
    k = np.stack([slope, slope], axis=1)
    for _ in range(NEWTON_STEPS):
        Z = (x[:, None] + ha @ k).reshape(-1, n)
        defect = (k.reshape(-1, n) - library.fields(Z) @ theta).reshape(P, 2 * n)
        M = _matrix(library.field_jacobian(theta, Z).reshape(P, 2, n, n), ha)
        change = np.linalg.solve(M, defect[:, :, None])[:, :, 0].reshape(P, 2, n)
        k = k - change
        if not np.abs(h[:, None, None] * change).max() > NEWTON_TOLERANCE * (np.abs(x).max() + 1e-300):
            break
    new = x + h[:, None] * (k[:, 0] + k[:, 1]) / 2
    if tangent is None:
        return new, None
    Z = (x[:, None] + ha @ k).reshape(-1, n)
    F = library.field_jacobian(theta, Z).reshape(P, 2, n, n)
    right = F @ tangent[:, None]
    if len(followed):
        right[..., n:] += followed.fields(Z).reshape(P, 2, n, -1)
    dk = np.linalg.solve(_matrix(F, ha), right.reshape(P, 2 * n, -1)).reshape(P, 2, n, -1)
    return new, tangent + h[:, None, None] * (dk[:, 0] + dk[:, 1]) / 2


def _matrix(F: np.ndarray, ha: np.ndarray) -> np.ndarray:
    """1 − h A ⊗ F, (P, 4d, 4d)."""
    P, _, n, _ = F.shape
    M = -(ha[:, :, None, :, None] * F[:, :, :, None, :]).reshape(P, 2 * n, 2 * n)
    M.reshape(P, -1)[:, :: 2 * n + 1] += 1.0
    return M
