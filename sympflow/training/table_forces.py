"""What a splitting step and its derivatives need of a system, and the Jacobians of these.

F = −∇V, G = ∇²V v and C = −∇(½ v·∇²V v), with v = M⁻¹∇V; or after F the −∇q^m of each monomial.

Arrays are feature-major: q and F, G, C are (d, P), Jacobians (d, d, P).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

ALONG = 1e-4  # length of the difference, relative to q, that gives the third derivative of V along M⁻¹∇V


class Forces(Protocol):
    """The terms of a kick and their Jacobians, as many as the kicks have: F, G, C."""

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        """F, G and C."""

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """These, and their Jacobians."""


def forces_of(system: HamiltonianSystem, level: int, monomials: Monomials = ()) -> Forces:
    """The forces of a separable system with T = ½ pᵀM⁻¹p: from its symbols, its Numba functions, or its own arrays."""
    if system.symbols is not None:
        return SymbolicForces(system.symbols, level, monomials)
    if system.numba_functions is not None and system.numba_functions[2] is not None:
        return NumbaForces(system, level)
    return CallableForces(system, level)


class SymbolicForces:
    """All derivatives in closed form, generated from the symbols."""

    def __init__(self, symbols: Any, level: int, monomials: Monomials) -> None:
        import sympy as sp

        slope = sp.Matrix([sp.diff(symbols.V, s) for s in symbols.q])
        terms = [-slope]
        if level in (FORCE_GRADIENT, CURVATURE):
            terms.append(sp.hessian(symbols.V, symbols.q) * symbols.inverse_mass * slope)
        if level == CURVATURE:
            terms.append(sp.Matrix([-sp.diff(symbols.W, s) for s in symbols.q]))
        products = [sp.Mul(*map(sp.Pow, symbols.q, m)) for m in monomials]
        terms += [sp.Matrix([-sp.diff(product, s) for s in symbols.q]) for product in products]
        values = [f for term in terms for f in term]
        self._d, self._n = symbols.ndof, len(terms)
        self._values = _generated(symbols.q, values)
        self._all = _generated(symbols.q, [*values, *(f for term in terms for f in term.jacobian(symbols.q))])

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        return self._values(q).reshape(self._n, self._d, q.shape[1])  # type: ignore[return-value]

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        d, n = self._d, self._n
        rows = self._all(q)
        return rows[: n * d].reshape(n, d, -1), rows[n * d :].reshape(n, d, d, -1)  # type: ignore[return-value]


class CallableForces:
    """From the system's gradients and Hessians of arrays.

    The Jacobian of G(q) = ∇²V(q) v(q), v = M⁻¹∇V, is ∇²V M⁻¹ ∇²V and the derivative of ∇²V along v, a central
    difference of two Hessians: third derivatives of V are never asked for, so there is no C.
    """

    def __init__(self, system: HamiltonianSystem, level: int) -> None:
        assert level < CURVATURE
        self.system, self.force_gradient = system, level >= FORCE_GRADIENT

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        F = self.system.force(q.T)
        if not self.force_gradient:
            return (F.T,)
        return F.T, self.system.hessian_vector(q.T, -self.system.velocity(F)).T

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        F = self.system.force(q.T)
        hessian = self.system.potential_hessian(q.T)  # (P, d, d)
        DF = np.moveaxis(-hessian, 0, -1)
        if not self.force_gradient:
            return (F.T,), (DF,)
        v = -self.system.velocity(F)
        G = (hessian @ v[..., None])[..., 0]
        largest = np.abs(v).max(-1, keepdims=True)
        step = ALONG * np.maximum(np.abs(q.T).max(-1, keepdims=True), 1e-300) / np.where(largest > 0, largest, 1.0)
        ends = [self.system.potential_hessian(q.T + sign * step * v) for sign in (1, -1)]
        along = (ends[0] - ends[1]) / (2 * step[..., None])
        inverse_mass = self.system.kinetic_hessian(np.zeros(self.system.ndof))
        DG = along + hessian @ inverse_mass @ hessian
        return (F.T, G.T), (DF, np.moveaxis(DG, 0, -1))


class NumbaForces(CallableForces):
    """`CallableForces` in one compiled loop over the states, around the user's functions of one state."""

    def __init__(self, system: HamiltonianSystem, level: int) -> None:
        super().__init__(system, level)
        assert system.numba_functions is not None
        _, gradient, hessian_vector = system.numba_functions
        self._loops = _compiled(gradient, hessian_vector)
        self._inverse_mass = system.kinetic_hessian(np.zeros(system.ndof))

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        rows = np.ascontiguousarray(q.T)
        F, G = np.empty_like(rows), np.empty_like(rows)
        self._loops[0](rows, self._inverse_mass, self.force_gradient, F, G)
        return (F.T, G.T) if self.force_gradient else (F.T,)

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        d, n = q.shape
        F, G, DF, DG = np.empty((n, d)), np.empty((n, d)), np.empty((n, d, d)), np.empty((n, d, d))
        rows = np.ascontiguousarray(q.T)
        self._loops[1](rows, self._inverse_mass, ALONG if self.force_gradient else 0.0, F, G, DF, DG)
        if self.force_gradient:
            DG += DF @ self._inverse_mass @ DF
        forces, jacobians = ([np.moveaxis(a, 0, -1) for a in pair] for pair in ((F, G), (DF, DG)))
        n_terms = 2 if self.force_gradient else 1
        return forces[:n_terms], jacobians[:n_terms]


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
