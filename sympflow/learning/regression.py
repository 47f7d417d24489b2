"""Sparse linear regression by its normal equations: terms are added while a criterion falls, then dropped."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sympflow.learning.library import Library
from sympflow.learning.smoothing import Smooth

CORRELATED = 4
"""Smoothed slopes that count as one, for their errors are correlated."""


class Regression:
    """y ≈ X θ for few of the columns of X (n, K), of whose n errors some count as independent."""

    def __init__(self, X: np.ndarray, y: np.ndarray, independent: float) -> None:
        self.lengths = np.linalg.norm(X, axis=0)
        self.lengths[self.lengths == 0] = 1.0
        X = X / self.lengths
        self.G, self.b, self.yy = X.T @ X, X.T @ y, float(y @ y)
        self.n = independent
        self.count = len(y)

    @classmethod
    def of_slopes(cls, library: Library, smooth: Smooth, scales: np.ndarray) -> Regression:
        """ẋ ≈ Σ θ_k J∇f_k(x) at smoothed states, each coordinate in its spread."""
        X = library.fields(smooth.points) / scales[:, None]
        y = (smooth.slopes / scales).ravel()
        return cls(X.reshape(len(y), -1), y, len(y) / CORRELATED)

    @classmethod
    def of_values(cls, library: Library, x: np.ndarray, values: np.ndarray) -> Regression:
        """H ≈ Σ θ_k f_k + const at states x."""
        X = library.values(x)
        return cls(X - X.mean(0), values - values.mean(), len(values))

    def _solve(self, active: list[int]) -> tuple[np.ndarray, float]:
        theta = np.linalg.lstsq(self.G[np.ix_(active, active)], self.b[active], rcond=1e-13)[0]
        left = self.yy - 2 * theta @ self.b[active] + theta @ self.G[np.ix_(active, active)] @ theta
        return theta, max(float(left), 1e-16 * self.yy)

    def coefficients(self, active: list[int]) -> np.ndarray:
        return self._solve(active)[0] / self.lengths[active]

    def errors(self, active: list[int]) -> np.ndarray:
        """Standard errors of the coefficients."""
        variance = self._solve(active)[1] / max(self.n - len(active), 1)
        return np.sqrt(variance * np.diag(np.linalg.pinv(self.G[np.ix_(active, active)]))) / self.lengths[active]

    def misfit(self, active: list[int]) -> float:
        """Root mean square of what is left."""
        return math.sqrt(self._solve(active)[1] / self.count)

    def criterion(self, active: list[int]) -> float:
        penalty = math.log(max(self.n, 3)) + 2 * math.log(len(self.b))
        return self.n * math.log(self._solve(active)[1] / self.yy) + len(active) * penalty

    def forward(self, most: int, among: Sequence[int] | None = None) -> list[int]:
        """Terms added one at a time, each the one that leaves least, and dropped again while the criterion falls."""
        active: list[int] = []
        usable = range(len(self.b)) if among is None else among
        for _ in range(min(most, len(usable))):
            wider = min(([*active, k] for k in usable if k not in active), key=lambda a: self._solve(a)[1])
            if active and self.criterion(wider) >= self.criterion(active):
                break
            active = wider
            while len(active) > 1:
                fewer = self._fewer(active)
                if self.criterion(fewer) >= self.criterion(active):
                    break
                active = fewer
        return active

    def backward(self, most: int, among: Sequence[int] | None = None) -> list[int]:
        """Terms dropped one at a time from all of them, while the criterion falls or there are more than `most`."""
        active = [*range(len(self.b))] if among is None else [*among]
        while len(active) > 1:
            theta, _ = self._solve(active)
            inverse = np.linalg.pinv(self.G[np.ix_(active, active)], rcond=1e-13)
            least = int(np.argmin(theta**2 / np.maximum(np.diag(inverse), 1e-300)))
            fewer = active[:least] + active[least + 1 :]
            if len(active) <= most and self.criterion(fewer) >= self.criterion(active):
                break
            active = fewer
        return active

    def _fewer(self, active: list[int]) -> list[int]:
        """The model without the term that is missed least."""
        return min(([j for j in active if j != k] for k in active), key=lambda a: self._solve(a)[1])

    def nested(self, active: list[int]) -> list[list[int]]:
        """Models of one term to all, each with one dropped from the next."""
        path = [active]
        while len(path[0]) > 1:
            path.insert(0, self._fewer(path[0]))
        return path
