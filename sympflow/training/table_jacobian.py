"""A splitting step and its derivatives with respect to the numbers of its table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.table_forces import forces_of


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
