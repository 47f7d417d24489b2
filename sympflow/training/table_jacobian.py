"""A splitting step and its derivatives with respect to the numbers of its table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sympflow.system import HamiltonianSystem


class TableStep:
    """The map of alternating kicks p += w F(q) + g ∇²V M⁻¹∇V(q) and drifts q += a M⁻¹p of a symbolic system.

    Arrays are feature-major: states y (2d, P). A coefficient is a row of P numbers, one a state, so that states may
    be at different times: c (n, P), or (n, 1).

    Parameters
    ----------
    system : HamiltonianSystem
        Symbolic and separable, with T = ½ pᵀM⁻¹p.
    sequence : sequence of "kick" or "drift"
    force_gradient : bool
        Whether the kicks have the term g.
    """

    def __init__(self, system: HamiltonianSystem, sequence: Sequence[str], force_gradient: bool) -> None:
        if system.symbols is None or not system.quadratic_kinetic:
            raise ValueError(
                f"`system` {system.name!r} must be symbolic with a kinetic energy ½ pᵀM⁻¹p for Gauss–Newton training: "
                "define it by HamiltonianSystem.from_sympy, or use optimizer='bfgs'."
            )
        self.ndof, self.sequence, self.force_gradient = system.ndof, tuple(sequence), force_gradient
        self._inverse_mass = system.kinetic_hessian(np.zeros(system.ndof))
        self._forces = _Forces(system.symbols, force_gradient)
        n = len(sequence)
        kicks = [i for i in range(n) if sequence[i] == "kick"]
        self.n_coefficients = n + (len(kicks) if force_gradient else 0)
        self._gradient_of = {kick: n + j for j, kick in enumerate(kicks)}  # where g stands among the coefficients

    def __call__(self, c: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The step: coefficients c in the order of the sequence, then the g of each kick."""
        q, p = y[: self.ndof], y[self.ndof :]
        for i, kind in enumerate(self.sequence):
            if kind == "drift":
                q = q + c[i] * (self._inverse_mass @ p)
            else:
                F, G = self._forces.values(q)
                p = p + c[i] * F
                if self.force_gradient:
                    p = p + c[self._gradient_of[i]] * G
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
                F, G, DF, DG = self._forces.all(q)
                change, slope = c[i] * F, c[i] * DF
                if self.force_gradient:
                    g = c[self._gradient_of[i]]
                    change, slope = change + g * G, slope + g * DG
                passed.append((F, G, slope))
                p = p + change
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
                F, G, slope = passed[i]
                J[i] = _apply(after_p, F)
                if self.force_gradient:
                    J[self._gradient_of[i]] = _apply(after_p, G)
                for k in range(d):
                    after_q += after_p[:, k, None] * slope[k]
        return np.concatenate([q, p]), J


def _apply(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A (r, k, P) times v (k, P): (r, P)."""
    result = A[:, 0] * v[0]
    for k in range(1, len(v)):
        result += A[:, k] * v[k]
    return result


class _Forces:
    """F = −∇V, G = ∇²V M⁻¹∇V and their Jacobians, generated from the symbols: (d, P) and (d, d, P)."""

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

    def all(self, q: np.ndarray) -> tuple[np.ndarray, ...]:
        d, n = self._d, self._n
        rows = self._all(q)
        jacobians = rows[n:].reshape(-1, d, q.shape[1])
        return rows[:d], rows[d:n], jacobians[:d], jacobians[d:]


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
