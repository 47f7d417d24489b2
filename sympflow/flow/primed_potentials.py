"""Potentials made of a system's own functions, V(q), T(p), −½|∇V|²_{M⁻¹} and ½v·∇²V v, times functions of t.

And of polynomials in q, whose coefficients are functions of t.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from sympflow.arrays import Array, jvp
from sympflow.flow.layers import Binding, Drift
from sympflow.flow.potentials import Potential, Time
from sympflow.hamiltonian.hamiltonian import derivative, direction, length_of_change, step
from sympflow.hamiltonian.monomials import Monomials, gradient, value

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem


class Factor(Protocol):
    """A function of t that vanishes at 0."""

    def value(self, t: Time) -> Time: ...

    def rate(self, t: Time) -> Time:
        """Its derivative."""
        ...


def _called(f: Callable[..., Array], system: HamiltonianSystem, q: Tensor, t: Tensor | None) -> Tensor:
    """f(q, t), by way of NumPy where the functions of the system take nothing else."""
    if system.definition.takes_tensors:
        return f(q, t)
    if q.requires_grad:
        raise TypeError(
            f"`system` {system.name!r} has functions of NumPy arrays, and gradients do not flow through these: write "
            "them for tensors too, or use HamiltonianSystem.from_sympy."
        )
    times = None if t is None else t.cpu().numpy()
    return torch.as_tensor(f(q.cpu().numpy(), times), dtype=q.dtype, device=q.device)


def _minus_half_square(system: HamiltonianSystem, q: Tensor, t: Tensor | None) -> Tensor:
    F = _called(system.force, system, q, t)
    return -(F * system.velocity(F)).sum(-1) / 2


_FUNCTIONS: dict[str, tuple[Callable[..., Tensor], Callable[..., Tensor]]] = {
    "potential": (
        lambda system, q, t: _called(system.potential, system, q, t),
        lambda system, q, t: -_called(system.force, system, q, t),
    ),
    "kinetic": (lambda system, p, t: system.kinetic(p, t), lambda system, p, t: system.velocity(p, t)),
    "force gradient": (
        _minus_half_square,
        lambda system, q, t: _called(
            lambda x, s: system.hessian_vector(x, system.velocity(system.force(x, s)), s), system, q, t
        ),
    ),
    "curvature": (lambda system, q, t: system.curvature(q, t), lambda system, q, t: system.curvature_gradient(q, t)),
}


@dataclass(frozen=True)
class Term:
    """A function U(x) that a system defines: x (N, d) and, where the system is driven, the times (N,)."""

    name: str

    def value(self, system: HamiltonianSystem, x: Tensor, t: Tensor | None = None) -> Tensor:
        """U: (N,)."""
        return _FUNCTIONS[self.name][0](system, x, t)

    def gradient(self, system: HamiltonianSystem, x: Tensor, t: Tensor | None = None) -> Tensor:
        """∇U: (N, d)."""
        return _FUNCTIONS[self.name][1](system, x, t)


POTENTIAL, KINETIC = Term("potential"), Term("kinetic")
FORCE_GRADIENT, CURVATURE = Term("force gradient"), Term("curvature")
"""−½|∇V|²_{M⁻¹} and ½ v·∇²V v with v = M⁻¹∇V; the gradient of the first is −∇²V M⁻¹∇V."""


def _apart(system: HamiltonianSystem, x: Tensor) -> tuple[Tensor, Tensor | None]:
    """Columns (d, N), or with the times in a last row (d + 1, N), as rows (N, d), and the times."""
    return (x.T, None) if len(x) == system.ndof else (x[:-1].T, x[-1])


def _gradient_columns(U: Term, system: HamiltonianSystem, x: Tensor) -> Tensor:
    return U.gradient(system, *_apart(system, x)).T


def _gradient_and_change(U: Term, system: HamiltonianSystem, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
    """∇U on columns (d, N), or with the times (d + 1, N), and its derivative along dx; of Numba a difference."""
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


class PrimedDrift(Drift):
    """The drift of a system over s = t a(t/Δt), with friction its exact flow; driven, it moves the times by s."""

    def __init__(self, ndof: int, binding: Binding, time: Factor) -> None:
        super().__init__(PrimedPotential(ndof, binding, [(KINETIC, time)]))
        self._binding, self._time = binding, time

    @property
    def _plain(self) -> bool:
        """True without friction and driving."""
        return self._binding.system.keeps_energy

    def _drifted(self, s: Time, q: Tensor, p: Tensor, passed: Time = 0.0) -> tuple[Tensor, Tensor]:
        """The linear map of a drift over s, and by how much the time moves with it."""
        d = self._binding.system.ndof
        moved, end = self._binding.system.drifted(q[:d].T, p.T, 0.0, _each(s))
        return torch.cat([moved.T, q[d:] + passed]), end.T

    def forward(self, t: Time, q: Tensor, p: Tensor, back: bool = False) -> tuple[Tensor, Tensor]:
        if self._plain:
            return super().forward(t, q, p, back)
        s = -self._time.value(t) if back else self._time.value(t)
        return self._drifted(s, q, p, s)

    def tangent(self, t: Time, q: Tensor, p: Tensor, dq: Tensor, dp: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        if self._plain:
            return super().tangent(t, q, p, dq, dp)
        system = self._binding.system
        s, rate = self._time.value(t), self._time.rate(t)
        q, p = self._drifted(s, q, p, s)
        dq, dp = self._drifted(s, dq, dp, rate)
        d = system.ndof
        dp = dp + rate * system.friction.force(p.T).T
        return q, p, torch.cat([dq[:d] + rate * system.velocity(p.T).T, dq[d:]]), dp

    def pull_back(self, t: Time, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        system = self._binding.system
        system.check_conservative("and a damped flow is not Hamiltonian", "use flow.velocity, or system.hamiltonian")
        return *self.inverse(t, q, p), self._time.rate(t) * system.kinetic(p.T)


def _each(s: Time) -> Time:
    """A time, or one for each state (N,), against momenta (N, d)."""
    return s[:, None] if isinstance(s, Tensor) and s.ndim else s


class PrimedPotential(Potential):
    """V(t, x) = Σ_j c_j(t) U_j(x) + Σ_m e_m(t) x^m, U_j functions of the system; driven, x has the times below.

    Before it the time has moved on by those that have `passed`.
    """

    def __init__(
        self,
        ndof: int,
        binding: Binding,
        terms: Sequence[tuple[Term, Factor]],
        monomials: Monomials = (),
        powers: Sequence[Factor] = (),
        passed: Sequence[Factor] = (),
    ) -> None:
        super().__init__()
        self.ndof, self.binding, self._terms = ndof, binding, terms
        self._monomials, self._powers, self._passed = monomials, powers, passed

    def _polynomial(self, t: Time, x: Tensor, rate: bool = False) -> Tensor:
        """e(t), or its derivative: (M,), or (N, M) for times (N,)."""
        values = [e.rate(t) if rate else e.value(t) for e in self._powers]
        return torch.stack([torch.as_tensor(v, dtype=x.dtype, device=x.device) for v in values], dim=-1)

    def _slope(self, coefficients: Tensor, x: Tensor) -> Tensor:
        """The gradient of the polynomial on columns (d, N)."""
        return gradient(self._monomials, coefficients, x.T).T

    def impulse(self, t: Time, x: Tensor) -> Tensor:
        system = self.binding.system
        q, at = _apart(system, x)
        impulse = sum(c.value(t) * U.gradient(system, q, at).T for U, c in self._terms)
        if self._monomials:
            impulse = impulse + self._slope(self._polynomial(t, x), q.T)
        return impulse  # type: ignore[return-value]

    def impulse_and_rate(self, t: Time, x: Tensor) -> tuple[Tensor, Tensor]:
        system = self.binding.system
        q, at = _apart(system, x)
        rate = sum(c.rate(t) * U.value(system, q, at) for U, c in self._terms)
        if at is not None:
            moved = sum(s.rate(t) for s in self._passed)
            for U, c in self._terms:
                rate = rate + c.value(t) * moved * jvp(partial(U.value, system, q), at, torch.ones_like(at))[1]
        if self._monomials:
            rate = rate + value(self._monomials, self._polynomial(t, x, rate=True), q)
        return self.impulse(t, x), rate  # type: ignore[return-value]

    def impulse_and_tangent(self, t: Time, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        system = self.binding.system
        q, dq = x[: system.ndof], dx[: system.ndof]
        impulse = tangent = torch.zeros_like(q)
        for U, c in self._terms:
            slope, change = _gradient_and_change(U, system, x, dx)
            impulse = impulse + c.value(t) * slope
            tangent = tangent + c.rate(t) * slope + c.value(t) * change
        if self._monomials:
            slope, change = jvp(partial(self._slope, self._polynomial(t, x)), q, dq)
            impulse = impulse + slope
            tangent = tangent + self._slope(self._polynomial(t, x, rate=True), q) + change
        return impulse, tangent
