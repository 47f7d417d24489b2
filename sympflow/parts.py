"""H as a sum of parts that are solved exactly, two or more, and their flows on arrays.

A part is solved exactly if it is quadratic, ½ pᵀBp + ½ (q − c)ᵀK(q − c) (the *linear* part, in its normal modes), or
if no two of the variables that it depends on are conjugate to each other: then these variables do not move, and its
flow over a time s is x + s J∇H_k(x). V(q) and T(p) are of this kind, and so is p_θ²/(2r²).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, concatenate, is_tensor, stack
from sympflow.linear_part import LinearPart
from sympflow.shears import sheared, shears
from sympflow.symbolic import SymbolicHamiltonian

if TYPE_CHECKING:
    import sympy as sp

    from sympflow.system import HamiltonianSystem

LINEAR = 0
"""The number of the linear part; the others are 1, 2, …"""


@dataclass(frozen=True)
class Map:
    """The exact flow of a part, in units of absolute time; every entry may have a batch shape in front.

    Attributes
    ----------
    part : int
    length : (...) for the parts 1, 2, …; (..., F) for the linear part
        How long it acts; the linear part has a time for each of its F frequencies.
    gradient : (...)
        g, adds −g ½|∇H_k|²_{M⁻¹} to the Hamiltonian of a part H_k(q), times 1.
    filters : (..., F) or None
        φ: the part acts at c + C φ X in place of q = c + C X, with a factor for each frequency.
    """

    part: int
    length: Any
    gradient: Any = 0.0
    filters: Any = None

    def inverse(self) -> Map:
        return Map(self.part, -self.length, -self.gradient, self.filters)


class PartFunctions(SymbolicHamiltonian):
    """A part H_k(q, p) as a SymPy expression, with array functions of states [q, p]."""

    def __init__(self, H: sp.Expr, q: tuple[sp.Symbol, ...], p: tuple[sp.Symbol, ...]) -> None:
        self.H, self.q, self.p, self.ndof = H, q, p, len(q)
        self.V = self.T = None
        self.separable = False

    @property
    def of_positions(self) -> bool:
        """Whether it is a potential, H_k(q)."""
        return not self.H.has(*self.p)


class RestOfPotential:
    """U(q) = V(q) − ½ (q − c)ᵀK(q − c) of a system given by functions."""

    of_positions = True

    def __init__(self, system: HamiltonianSystem, linear: LinearPart) -> None:
        self.system, self.K, self.center, self.ndof = system, linear.stiffness_matrix, linear.center, system.ndof

    def hamiltonian(self, y: Array) -> Array:
        q = y[..., : self.ndof]
        x = q - like(self.center, q)
        return self.system.potential(q) - (x * (x @ like(self.K, q))).sum(-1) / 2

    def gradient(self, y: Array) -> Array:
        q = y[..., : self.ndof]
        return concatenate([-self.system.force(q) - (q - like(self.center, q)) @ like(self.K, q), 0 * q])

    def hessian_vector(self, y: Array, v: Array) -> Array:
        return self.system.hessian_vector(y[..., : self.ndof], v) - v @ like(self.K, v)


class ExactParts:
    """The parts of a system, and their flows in the normal modes (X, Y) of the linear one.

    Parameters
    ----------
    linear : LinearPart or None
    rest : sequence of PartFunctions
        The parts 1, 2, …
    ndof : int
    sequence : sequence of int, optional
        The parts in the order of a splitting, the last innermost; the default is 1, 2, …, 0: kicks outside.
    """

    def __init__(
        self, linear: LinearPart | None, rest: Sequence[Any], ndof: int, sequence: Sequence[int] | None = None
    ) -> None:
        self.linear, self.rest, self.ndof = linear, tuple(rest), ndof
        self.sequence = tuple(range(1, len(self.rest) + 1)) + (LINEAR,) * (linear is not None)
        if sequence is not None:
            self.sequence = tuple(sequence)
        self.C: np.ndarray = linear.modes if linear else np.eye(ndof)
        self.inverse_C: np.ndarray = linear.inverse_modes if linear else np.eye(ndof)
        self.center = linear.center if linear else np.zeros(ndof)
        self.classes = linear.classes if linear else np.zeros(ndof, dtype=int)
        self.n_classes = linear.n_classes if linear else 1
        self.diagonal = not np.count_nonzero(self.C - np.diag(np.diag(self.C)))

    def __len__(self) -> int:
        return len(self.rest) + (self.linear is not None)

    def check_filters(self, part: int) -> None:
        """Raise unless the part, filtered, is still solved exactly: it must not come to hold a conjugate pair."""
        if not (self.diagonal or self.rest[part - 1].of_positions):
            raise ValueError("`filters` cannot act on a part that depends on momenta where modes are mixed: leave out.")

    # normal modes -------------------------------------------------------------------------------------

    def to_modes(self, y: Array) -> tuple[Array, Array]:
        """X = C⁻¹(q − c), Y = Cᵀp."""
        d = self.ndof
        return self._times(self.inverse_C, y[..., :d] - like(self.center, y)), self._times(self.C.T, y[..., d:])

    def from_modes(self, X: Array, Y: Array) -> Array:
        """[c + C X, C⁻ᵀY]."""
        return concatenate([like(self.center, X) + self._times(self.C, X), self._times(self.inverse_C.T, Y)])

    def _times(self, A: np.ndarray, x: Array) -> Array:
        if self.diagonal:
            return x * like(np.diag(A), x)
        return x @ like(A.T, x)

    def by_class(self, values: Array) -> Array:
        """Values for each frequency (..., F) as values for each mode (..., d)."""
        return values[..., self.classes]

    # flows ----------------------------------------------------------------------------------------------

    def apply(self, maps: Sequence[Map], X: Array, Y: Array) -> tuple[Array, Array]:
        """The maps one after another, the first first."""
        for m in maps:
            if m.part == LINEAR:
                X, Y = self.linear_flow(X, Y, m.length)
                continue
            dX, dY = self.slopes(m.part, X, Y, m.filters)
            length = each_mode(m.length)
            X, Y = (X, Y - length * dX) if dY is None else (X + length * dY, Y - length * dX)
            if not (isinstance(m.gradient, float) and m.gradient == 0.0):
                Y = Y + each_mode(m.gradient) * self.force_gradient(m.part, X, m.filters)
        return X, Y

    def linear_flow(self, X: Array, Y: Array, s: Any) -> tuple[Array, Array]:
        """The linear part over the times s (..., F), or by the shears that `prepared` has put in their place."""
        return sheared(X, Y, s if isinstance(s, tuple) else self._shears(s, X))

    def prepared(self, maps: Sequence[Map], X: Array) -> list[Map]:
        """The maps for repeated use on states of the kind of X: the shears of the linear ones computed once."""
        return [replace(m, length=self._shears(m.length, X)) if m.part == LINEAR else m for m in maps]

    def _shears(self, s: Any, X: Array) -> tuple[Array, Array, Array, Array]:
        assert self.linear is not None
        return shears(self.linear.kinds, like(self.linear.rates, X), self.by_class(matching(s, X)))

    def linear_energies(self, X: Array, Y: Array) -> Array:
        """Energy of the linear part in each frequency: (..., F)."""
        assert self.linear is not None
        sign = {"oscillator": 1.0, "hyperbolic": -1.0, "free": 0.0, "idle": 0.0}
        squares = like(np.array([sign[k] for k in self.linear.kinds]), X) * X * X + Y * Y
        energies = like(self.linear.rates, X) * squares / 2
        return stack([energies[..., self.classes == f].sum(-1) for f in range(self.n_classes)])

    def value(self, part: int, X: Array, Y: Array, filters: Array | None) -> Array:
        """H_k: (...)."""
        return self.rest[part - 1].hamiltonian(self._state(X, Y, filters))

    def slopes(self, part: int, X: Array, Y: Array, filters: Array | None) -> tuple[Array, Array | None]:
        """∂H_k/∂X and ∂H_k/∂Y, (..., d) each; None for what is zero."""
        functions, d = self.rest[part - 1], self.ndof
        g = functions.gradient(self._state(X, Y, filters))
        dX = self._times(self.C.T, g[..., :d])
        dX = dX if filters is None else self.by_class(matching(filters, X)) * dX
        return dX, None if functions.of_positions else self._times(self.inverse_C, g[..., d:])

    def force_gradient(self, part: int, X: Array, filters: Array | None) -> Array:
        """½ ∇|∇U|²_{M⁻¹} of U(X) = H_k(c + C φ X): (..., d)."""
        functions, d = self.rest[part - 1], self.ndof
        y = self._state(X, 0 * X, filters)
        phi = 1.0 if filters is None else self.by_class(matching(filters, X))
        v = self.inverse_masses(X) * phi * self._times(self.C.T, functions.gradient(y)[..., :d])
        v = self._times(self.C, phi * v)
        if hasattr(functions, "hessian_vector"):
            product = functions.hessian_vector(y, v)
        else:
            product = (functions.hessian(y)[..., :d, :d] @ v[..., None])[..., 0]
        return phi * self._times(self.C.T, product)

    def inverse_masses(self, X: Array) -> Array:
        """The diagonal M⁻¹ of the modes: Ω of each."""
        assert self.linear is not None
        return like(self.linear.rates, X)

    def _state(self, X: Array, Y: Array, filters: Array | None) -> Array:
        return self.from_modes(X if filters is None else self.by_class(matching(filters, X)) * X, Y)

    @cached_property
    def has_force_gradient(self) -> bool:
        """Whether kicks may carry force gradients: every momentum must enter by the linear part."""
        return (
            self.linear is not None
            and "idle" not in self.linear.kinds
            and all(functions.of_positions for functions in self.rest)
        )


def each_mode(value: Any) -> Any:
    """A number for each state as one that broadcasts against (..., d)."""
    return value[..., None] if getattr(value, "ndim", 0) else value


def like(constant: np.ndarray, x: Array) -> Array:
    """A constant array in the library, dtype and device of `x`."""
    if is_tensor(x):
        import torch

        return torch.as_tensor(np.array(constant), dtype=x.dtype, device=x.device)
    return constant.astype(x.dtype, copy=False)


def matching(value: Any, x: Array) -> Array:
    """Times or filters in the library, dtype and device of `x`."""
    if is_tensor(value):
        return value.to(dtype=x.dtype, device=x.device)
    return like(np.asarray(value), x)
