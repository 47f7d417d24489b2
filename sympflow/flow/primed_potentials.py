"""Potentials made of a system's own functions, V(q), T(p), −½|∇V|²_{M⁻¹} and ½v·∇²V v, times functions of t."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from sympflow.flow.potentials import Potential, Time
from sympflow.forward_mode import jvp
from sympflow.third_derivatives import derivative, direction, length_of_change, step

if TYPE_CHECKING:
    from sympflow.system import HamiltonianSystem


class Binding:
    """The system whose V and T a flow is primed with; shared by copies of the flow, stored in no file."""

    def __init__(self, system: HamiltonianSystem | None) -> None:
        self._system = system

    @property
    def known(self) -> bool:
        return self._system is not None

    @property
    def system(self) -> HamiltonianSystem:
        if self._system is None:
            raise ValueError(
                "`flow` is primed with the V and T of a system, which its file does not hold: "
                "give it by sympflow.load(path, system=system) or flow.bind(system)."
            )
        return self._system

    def bind(self, system: HamiltonianSystem) -> None:
        self._system = system

    def __deepcopy__(self, memo: dict[int, Any]) -> Binding:
        return Binding(self._system)


class Factor(Protocol):
    """A function of t that vanishes at 0."""

    def value(self, t: Time) -> Time: ...

    def rate(self, t: Time) -> Time:
        """Its derivative."""
        ...


@dataclass(frozen=True)
class Term:
    """A function U(x) that a system defines, with its gradient; x is (N, d)."""

    value: Callable[[HamiltonianSystem, Tensor], Tensor]
    gradient: Callable[[HamiltonianSystem, Tensor], Tensor]


def _force_gradient_value(system: HamiltonianSystem, q: Tensor) -> Tensor:
    F = system.force(q)
    return -(F * system.velocity(F)).sum(-1) / 2


def _force_gradient(system: HamiltonianSystem, q: Tensor) -> Tensor:
    return system.hessian_vector(q, system.velocity(system.force(q)))


def _curvature(system: HamiltonianSystem, q: Tensor) -> Tensor:
    return system.curvature(q)


def _curvature_gradient(system: HamiltonianSystem, q: Tensor) -> Tensor:
    return system.curvature_gradient(q)


def _potential(system: HamiltonianSystem, q: Tensor) -> Tensor:
    return system.potential(q)


def _potential_gradient(system: HamiltonianSystem, q: Tensor) -> Tensor:
    return -system.force(q)


def _kinetic(system: HamiltonianSystem, p: Tensor) -> Tensor:
    return system.kinetic(p)


def _velocity(system: HamiltonianSystem, p: Tensor) -> Tensor:
    return system.velocity(p)


# Functions with names, by which pickle finds them.
POTENTIAL = Term(_potential, _potential_gradient)
FORCE_GRADIENT = Term(_force_gradient_value, _force_gradient)
"""−½|∇V|²_{M⁻¹}; −∇²V M⁻¹∇V."""
CURVATURE = Term(_curvature, _curvature_gradient)
"""½ v·∇²V v with v = M⁻¹∇V, and its gradient."""
KINETIC = Term(_kinetic, _velocity)


def _gradient_columns(U: Term, system: HamiltonianSystem, x: Tensor) -> Tensor:
    return U.gradient(system, x.T).T


def _gradient_and_change(U: Term, system: HamiltonianSystem, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
    """∇U on columns (d, N), and its derivative along dx.

    Numba functions end at ∇²V·v: what lacks is a difference.
    """
    gradient = partial(_gradient_columns, U, system)
    if U not in (FORCE_GRADIENT, CURVATURE) or system.numba_functions is None:
        return jvp(gradient, x, dx)
    q, v = x.T, dx.T
    if U is FORCE_GRADIENT:
        a = system.velocity(system.force(q))
        turn = system.hessian_vector(q, system.velocity(system.hessian_vector(q, v)))
        change = system.third_derivative(q, v, a) - turn
        return system.hessian_vector(q, a).T, change.T
    along = direction(v)
    h = step(q, length_of_change(system, q, along, along))
    return gradient(x), (derivative(partial(U.gradient, system), q, along, h) * v.abs().amax(-1, True)).T


class PrimedPotential(Potential):
    """V(t, x) = Σ_j c_j(t) U_j(x), with U_j functions of the system and c_j(0) = 0.

    Parameters
    ----------
    ndof : int
    binding : Binding
    terms : sequence of (Term, Factor)
        U_j, and c_j, for instance an entry of a table.
    """

    def __init__(self, ndof: int, binding: Binding, terms: Sequence[tuple[Term, Factor]]) -> None:
        super().__init__()
        self.ndof, self.binding = ndof, binding
        self._terms = terms

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        system = self.binding.system
        return sum(c.value(t) * U.gradient(system, x.T).T for U, c in self._terms)  # type: ignore[return-value]

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        system = self.binding.system
        rate = sum(c.rate(t) * U.value(system, x.T) for U, c in self._terms)
        return self.impulse(t, x), rate  # type: ignore[return-value]

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        system = self.binding.system
        impulse = tangent = torch.zeros_like(x)
        for U, c in self._terms:
            gradient, change = _gradient_and_change(U, system, x, dx)
            impulse = impulse + c.value(t) * gradient
            tangent = tangent + c.rate(t) * gradient + c.value(t) * change
        return impulse, tangent

    def to_dict(self) -> dict[str, Any]:
        return {"type": "primed"}
