"""A splitting step and its derivatives with respect to the numbers of its table.

The step needs the forces of a system and their Jacobians: F = −∇V, G = ∇²V v and C = −∇(½ v·∇²V v), with v = M⁻¹∇V; or
after F the −∇q^m of each monomial. Arrays are feature-major: q and F, G, C are (d, P), Jacobians (d, d, P).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

ALONG = 1e-4  # length of the difference, relative to q, that gives the third derivative of V along M⁻¹∇V


class TableStep:
    """The map of kicks p += w F(q) + g ∇²V v − c ∇(½ v·∇²V v), v = M⁻¹∇V(q), and drifts q += a M⁻¹p of a system.

    Arrays are feature-major: states y (2d, P). A coefficient is a row of P numbers, one a state, so that states may
    be at different times: c (n, P), or (n, 1).

    Parameters
    ----------
    system : HamiltonianSystem
        Separable, with T = ½ pᵀM⁻¹p.
    sequence : sequence of "kick" or "drift"
    level : int
        What the kicks have beside the force: nothing, g, g and c, or a polynomial.
    monomials
        Of the polynomial.
    """

    def __init__(
        self, system: HamiltonianSystem, sequence: Sequence[str], level: int, monomials: Monomials = ()
    ) -> None:
        if not system.quadratic_kinetic:
            raise ValueError(
                f"`system` {system.name!r} must have a kinetic energy ½ pᵀM⁻¹p for its table to be fitted by "
                "Gauss–Newton steps: use optimizer='bfgs'."
            )
        self.ndof, self.sequence = system.ndof, tuple(sequence)
        self._inverse_mass = system.kinetic_hessian(np.zeros(system.ndof))
        self._forces = forces_of(system, level, monomials)
        n, terms = len(sequence), len(monomials) or level
        kicks = [i for i in range(n) if sequence[i] == "kick"]
        self.n_coefficients = n + terms * len(kicks)
        # where w, g and c, or w and the polynomial's, stand among the coefficients
        self._places = {
            kick: [kick, *(n + term * len(kicks) + j for term in range(terms))] for j, kick in enumerate(kicks)
        }

    def __call__(self, c: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The step: coefficients c in the order of the sequence, then of each further term those of the kicks."""
        q, p = y[: self.ndof], y[self.ndof :]
        for i, kind in enumerate(self.sequence):
            if kind == "drift":
                q = q + c[i] * (self._inverse_mass @ p)
            else:
                for place, F in zip(self._places[i], self._forces.values(q), strict=True):
                    p = p + c[place] * F
        return np.concatenate([q, p])

    def with_jacobian(self, c: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The step, and its derivatives by each coefficient: (n, 2d, P).

        The states are stored on the way, and the derivative of the map after each is built on the way back: with few
        degrees of freedom that is cheaper than a tangent for each coefficient.
        """
        d = self.ndof
        q, p = y[:d], y[d:]
        passed: list[tuple[np.ndarray, ...]] = []
        for i, kind in enumerate(self.sequence):
            if kind == "drift":
                velocity = self._inverse_mass @ p
                passed.append((velocity,))
                q = q + c[i] * velocity
            else:
                forces, jacobians = self._forces.all(q)
                weights = [c[place] for place in self._places[i]]
                passed.append((sum(w * D for w, D in zip(weights, jacobians, strict=True)), *forces))
                p = p + sum(w * F for w, F in zip(weights, forces, strict=True))
        J = np.empty((self.n_coefficients, *y.shape))
        after_q, after_p = np.zeros((2 * d, d, y.shape[1])), np.zeros((2 * d, d, y.shape[1]))
        after_q[np.arange(d), np.arange(d)] = 1.0
        after_p[np.arange(d, 2 * d), np.arange(d)] = 1.0
        for i in reversed(range(len(self.sequence))):
            if self.sequence[i] == "drift":
                (velocity,) = passed[i]
                J[i] = _apply(after_q, velocity)
                after_p += c[i] * np.einsum("rkP,kj->rjP", after_q, self._inverse_mass)
            else:
                slope, *forces = passed[i]
                for place, F in zip(self._places[i], forces, strict=True):
                    J[place] = _apply(after_p, F)
                for k in range(d):
                    after_q += after_p[:, k, None] * slope[k]
        return np.concatenate([q, p]), J


def _apply(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A (r, k, P) times v (k, P): (r, P)."""
    result = A[:, 0] * v[0]
    for k in range(1, len(v)):
        result += A[:, k] * v[k]
    return result


# forces ---------------------------------------------------------------------------------------------------------


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
