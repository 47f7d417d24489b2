"""What a splitting step and its derivatives need of a system: F = −∇V, G = ∇²V M⁻¹∇V and their Jacobians.

Arrays are feature-major: q and F, G are (d, P), Jacobians (d, d, P).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from sympflow.system import HamiltonianSystem

ALONG = 1e-4  # length of the difference, relative to q, that gives the third derivative of V along M⁻¹∇V


class Forces(Protocol):
    """F, and G where the step has force gradients."""

    def values(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F and G."""

    def all(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """F, G and their Jacobians."""


def forces_of(system: HamiltonianSystem, force_gradient: bool) -> Forces:
    """The forces of a separable system with T = ½ pᵀM⁻¹p: from its symbols, its Numba functions, or its own arrays."""
    if system.symbols is not None:
        return SymbolicForces(system.symbols, force_gradient)
    if system.numba_functions is not None and system.numba_functions[2] is not None:
        return NumbaForces(system, force_gradient)
    return CallableForces(system, force_gradient)


class SymbolicForces:
    """All derivatives in closed form, generated from the symbols."""

    def __init__(self, symbols: Any, force_gradient: bool) -> None:
        import sympy as sp

        d = symbols.ndof
        slope = sp.Matrix([sp.diff(symbols.V, s) for s in symbols.q])
        G = sp.hessian(symbols.V, symbols.q) * symbols.inverse_mass * slope if force_gradient else sp.zeros(0, 1)
        values = [*(-slope), *G]
        jacobians = [*(-slope).jacobian(symbols.q), *(G.jacobian(symbols.q) if force_gradient else [])]
        self._d, self._n = d, len(values)
        self._values = _generated(symbols.q, values)
        self._all = _generated(symbols.q, [*values, *jacobians])

    def values(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = self._values(q)
        return rows[: self._d], rows[self._d :]

    def all(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        d, n = self._d, self._n
        rows = self._all(q)
        jacobians = rows[n:].reshape(-1, d, q.shape[1])
        return rows[:d], rows[d:n], jacobians[:d], jacobians[d:]


class CallableForces:
    """From the system's gradients and Hessians of arrays.

    The Jacobian of G(q) = ∇²V(q) v(q), v = M⁻¹∇V, is ∇²V M⁻¹ ∇²V and the derivative of ∇²V along v, a central
    difference of two Hessians: third derivatives of V are never asked for.
    """

    def __init__(self, system: HamiltonianSystem, force_gradient: bool) -> None:
        self.system, self.force_gradient = system, force_gradient

    def values(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        F = self.system.force(q.T)
        if not self.force_gradient:
            return F.T, F.T[:0]
        return F.T, self.system.hessian_vector(q.T, -self.system.velocity(F)).T

    def all(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        F = self.system.force(q.T)
        hessian = self.system.potential_hessian(q.T)  # (P, d, d)
        DF = np.moveaxis(-hessian, 0, -1)
        if not self.force_gradient:
            return F.T, F.T[:0], DF, DF[:0]
        v = -self.system.velocity(F)
        G = (hessian @ v[..., None])[..., 0]
        largest = np.abs(v).max(-1, keepdims=True)
        step = ALONG * np.maximum(np.abs(q.T).max(-1, keepdims=True), 1e-300) / np.where(largest > 0, largest, 1.0)
        ends = [self.system.potential_hessian(q.T + sign * step * v) for sign in (1, -1)]
        along = (ends[0] - ends[1]) / (2 * step[..., None])
        inverse_mass = self.system.kinetic_hessian(np.zeros(self.system.ndof))
        DG = along + hessian @ inverse_mass @ hessian
        return F.T, G.T, DF, np.moveaxis(DG, 0, -1)


class NumbaForces(CallableForces):
    """`CallableForces` in one compiled loop over the states, around the user's functions of one state."""

    def __init__(self, system: HamiltonianSystem, force_gradient: bool) -> None:
        super().__init__(system, force_gradient)
        assert system.numba_functions is not None
        _, gradient, hessian_vector = system.numba_functions
        self._loops = _compiled(gradient, hessian_vector)
        self._inverse_mass = system.kinetic_hessian(np.zeros(system.ndof))

    def values(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = np.ascontiguousarray(q.T)
        F, G = np.empty_like(rows), np.empty_like(rows)
        self._loops[0](rows, self._inverse_mass, self.force_gradient, F, G)
        return F.T, G.T if self.force_gradient else G.T[:0]

    def all(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        d, n = q.shape
        F, G, DF, DG = np.empty((n, d)), np.empty((n, d)), np.empty((n, d, d)), np.empty((n, d, d))
        rows = np.ascontiguousarray(q.T)
        self._loops[1](rows, self._inverse_mass, ALONG if self.force_gradient else 0.0, F, G, DF, DG)
        if self.force_gradient:
            DG += DF @ self._inverse_mass @ DF
        last = [np.moveaxis(a, 0, -1) for a in (F, G, DF, DG)]
        keep = None if self.force_gradient else 0
        return last[0], last[1][:keep], last[2], last[3][:keep]


def _compiled(gradient: Any, hessian_vector: Any) -> tuple[Callable[..., None], Callable[..., None]]:
    """The loops over the states (n, d) for `values` and `all`."""
    from numba import njit

    @njit(error_model="numpy")
    def values(Q: Any, inverse_mass: Any, force_gradient: Any, F: Any, G: Any) -> None:
        slope = np.empty(Q.shape[1])
        for s in range(Q.shape[0]):
            gradient(Q[s], slope)
            F[s] = -slope
            if force_gradient:
                hessian_vector(Q[s], inverse_mass @ slope, G[s])

    @njit(error_model="numpy")
    def derivatives(Q: Any, inverse_mass: Any, along: float, F: Any, G: Any, DF: Any, DG: Any) -> None:
        n, d = Q.shape
        slope, e, upper, lower = np.empty(d), np.zeros(d), np.empty(d), np.empty(d)
        for s in range(n):
            q = Q[s].copy()
            gradient(q, slope)
            for i in range(d):
                F[s, i] = -slope[i]
            for j in range(d):
                e[j] = 1.0
                hessian_vector(q, e, upper)
                e[j] = 0.0
                for i in range(d):
                    DF[s, i, j] = -upper[i]
            if along == 0.0:
                continue
            v = inverse_mass @ slope
            size, largest = 1e-300, 0.0
            for i in range(d):
                size, largest = max(size, abs(q[i])), max(largest, abs(v[i]))
            hessian_vector(q, v, upper)
            for i in range(d):
                G[s, i] = upper[i]
            h = along * size / (largest if largest > 0.0 else 1.0)
            q_upper, q_lower = q + h * v, q - h * v
            for j in range(d):
                e[j] = 1.0
                hessian_vector(q_upper, e, upper)
                hessian_vector(q_lower, e, lower)
                e[j] = 0.0
                for i in range(d):
                    DG[s, i, j] = (upper[i] - lower[i]) / (2 * h)

    return values, derivatives


def _generated(variables: Sequence[Any], expressions: list[Any]) -> Callable[[np.ndarray], np.ndarray]:
    """The expressions as one function of (d, P), with common subexpressions shared: (n, P)."""
    import sympy as sp

    function = sp.lambdify(variables, expressions, modules="numpy", cse=True)

    def evaluate(q: np.ndarray) -> np.ndarray:
        values = function(*q)
        out = np.empty((len(values), q.shape[1]))
        for i, value in enumerate(values):
            out[i] = value
        return out

    return evaluate
