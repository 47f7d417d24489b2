"""Kinetic energies ½ pᵀM(q)⁻¹p whose masses depend on the coordinates, as of pendulums that hang on each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy

from sympflow.learning.parts import Linear, Part, Waves


class Inertia(Part):
    """½ pᵀM(q)⁻¹p, M symmetric, its entries sums Σ_k θ_k f_k(q) of given functions.

    With v = M⁻¹p Lagrange's equations p = M v and p' = ½ vᵀ(∂M/∂q)v − ∂V/∂q are linear in θ, which gives a start.
    """

    of, linear, inertial, terms = "y", False, True, True

    def __init__(self, functions: Waves, entries: np.ndarray | None = None, unit: np.ndarray | None = None) -> None:
        d = functions.waves.shape[1]
        self.functions, self.unit = functions, unit
        self.pairs = [(i, j) for i in range(d) for j in range(i, d)]
        self._constant = (functions.waves == 0).all(axis=1) & (functions.powers.exponents == 0).all(axis=1)
        if entries is None:
            whole = np.array([(k, i, j) for i, j in self.pairs for k in range(functions.n)])
            entries = whole[(unit is None) | ~self._constant[whole[:, 0]] | (whole[:, 2] > 0)]
        self.entries, self.n = entries, len(entries)
        self._pair = np.array([self.pairs.index((i, j)) for i, j in entries[:, 1:].tolist()], dtype=int)
        self._shift = np.zeros(self.n)  # of functions, which then are 0 where M₁₁ is 1
        if unit is not None:
            there = functions.functions(unit[:, None])[:, 0]
            self._shift = np.where(self._pair == 0, there[entries[:, 0]], 0.0)
        self._double = np.array([1.0 if i == j else 2.0 for i, j in self.pairs])

    def subset(self, kept: np.ndarray) -> Inertia:
        return Inertia(self.functions, self.entries[kept], self.unit)

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """The unit matrix, where it can be written."""
        k, i, j = self.entries.T
        return (self._constant[k] & (i == j)).astype(float)

    def _coefficients(self, theta: np.ndarray) -> np.ndarray:
        """θ as a matrix (pairs, functions)."""
        C = np.zeros((len(self.pairs), self.functions.n))
        C[self._pair, self.entries[:, 0]] = theta
        if self.unit is not None:
            C[0, self._constant] = 1 - self._shift @ theta
        return C

    def _matrices(self, entries: np.ndarray) -> np.ndarray:
        """Symmetric matrices (d, d, N) of entries (pairs, N)."""
        d = self.functions.waves.shape[1]
        M = np.empty((d, d, entries.shape[1]))
        for (i, j), row in zip(self.pairs, entries, strict=True):
            M[i, j] = M[j, i] = row
        return M

    def _products(self, v: np.ndarray) -> np.ndarray:
        """The derivatives (pairs, N) of vᵀMv by the entries of M."""
        return np.stack([v[i] * v[j] for i, j in self.pairs]) * self._double[:, None]

    @staticmethod
    def _inverse(M: np.ndarray) -> np.ndarray:
        """M⁻¹ (d, d, N) of M (d, d, N), NaN where there is none."""
        try:
            return np.moveaxis(np.linalg.inv(np.moveaxis(M, -1, 0)), 0, -1)
        except np.linalg.LinAlgError:
            return np.full_like(M, np.nan)

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        m, N = x.shape
        d, C = m // 2, self._coefficients(theta)
        f, (first, second) = self.functions.functions(x[:d]), self.functions.derivatives(x[:d])
        W = self._inverse(self._matrices(C @ f))
        v = np.einsum("ijn,jn->in", W, x[d:])
        products = self._products(v)
        moved = [C @ rows for rows in first]  # the entries of ∂M/∂q_k
        value = np.concatenate([np.stack([-0.5 * (rows * products).sum(axis=0) for rows in moved]), v])
        if not slope and not by_parameters:
            return Linear(value)
        u = np.stack([np.einsum("ijn,jn->in", self._matrices(rows), v) for rows in moved])  # (∂M/∂q_k) v
        slopes = by = None
        if slope:
            Wu = np.einsum("ijn,kjn->kin", W, u)
            slopes = np.empty((m, m, N))
            slopes[d:, d:] = W
            slopes[d:, :d] = -Wu.transpose(1, 0, 2)
            slopes[:d, d:] = -Wu
            for (i, j), used, rows in second:
                curved = -0.5 * ((C[:, used] @ rows) * products).sum(axis=0) + (u[i] * Wu[j]).sum(axis=0)
                slopes[i, j] = slopes[j, i] = curved
        if by_parameters:
            by = np.empty((m, self.n, N))
            k = self.entries[:, 0]
            pair = self._pair
            g = f[k] - self._shift[:, None]
            pulled = np.stack([W[:, i] * v[j] + (W[:, j] * v[i] if i != j else 0.0) for i, j in self.pairs], axis=1)
            for i in range(d):
                by[d + i] = -g * pulled[i][pair]
                turned = np.einsum("jn,jan->an", u[i], pulled)
                by[i] = g * turned[pair] - 0.5 * first[i][k] * products[pair]
        return Linear(value, slopes, by)

    def momenta(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        d, N = q.shape
        f, first = self.functions.functions(q), self.functions.derivatives(q)[0]
        k, pair = self.entries[:, 0], self._pair
        g = f[k] - self._shift[:, None]
        made = np.zeros((2 * d, self.n, N))
        for place, (i, j) in enumerate(self.pairs):
            own = pair == place
            made[i, own] = g[own] * v[j]
            made[j, own] = g[own] * v[i]
        products = self._products(v)
        for i in range(d):
            made[d + i] = 0.5 * first[i][k] * products[pair]
        value = np.zeros((2 * d, N))
        value[0] = v[0] if self.unit is not None else 0.0
        return value, made

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        d = len(x) // 2
        W = self._inverse(self._matrices(self._coefficients(theta) @ self.functions.functions(x[:d])))
        return 0.5 * np.einsum("in,ijn,jn->n", x[d:], W, x[d:])

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        d = len(x) // 2
        M = sympy.zeros(d, d)
        for (i, j), row in zip(self.pairs, self._coefficients(theta), strict=True):
            M[i, j] = M[j, i] = self.functions.expression(row, x[:d])
        p = sympy.Matrix(list(x[d:]))
        return (p.T * M.adjugate() * p)[0] / (2 * M.det(method="berkowitz"))
