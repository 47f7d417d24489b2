"""Explicit Runge–Kutta methods: one step and its derivative, from the tableau."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import as_float
from sympflow.arrays import Array, per_state, readable, to_numpy
from sympflow.compiler import NotCompiled
from sympflow.hamiltonian.scales import smallest_size
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.times import stage_time
from sympflow.integrators.contract import ByVectorField
from sympflow.integrators.grid import no_event

HIDES = 0.01  # errors of the default tolerance that are so large, in units of q or of p, hide what a run does


class ExplicitStep(ByVectorField):
    """One step of an explicit Runge–Kutta method with the tableau A, B, and its derivative."""

    symplectic: ClassVar[bool] = False
    A: ClassVar[Any]
    B: ClassVar[Any]

    def forces_at_ends(self, system: HamiltonianSystem) -> bool:
        return True

    def step(self, system: HamiltonianSystem, t: Any, y: Array, h: float | Array) -> Array:
        """One step without error control."""
        times, h = self._stage_times(t, h), per_state(h, y)
        K: list[Array] = []
        for row, at in zip(self.A, times, strict=False):
            K.append(system.vector_field(y + h * weighted(row, K) if K else y, at))
        return y + h * weighted(self.B, K)

    @staticmethod
    def compiled(system: HamiltonianSystem, name: str, *arguments: Any) -> Any:
        """Return a function of `kernels.explicit_loops` called for a symbolic system."""
        if system.spelled is None and not arguments[1:]:  # with names there is a form
            raise NotCompiled(
                "`system` cannot be compiled: its vector field is not symbolic. Use HamiltonianSystem.from_sympy, or "
                "use backend='array'."
                if not system.untraced
                else f"`system` cannot be compiled, because its functions could not be traced: {system.untraced}. "
                "Change "
                "them, or use HamiltonianSystem.from_sympy, or use backend='array'."
            )
        from sympflow.kernels import explicit_loops  # SymPy, which other systems do without

        return getattr(explicit_loops, name)(system, *arguments)

    def _stage_times(self, t: Any, h: Any) -> list[Any]:
        """The times t + c_i h of the stages."""
        return [stage_time(t, math.fsum(map(float, row)), h) for row in self.A[: len(self.B)]]

    def tangent(self, system: HamiltonianSystem, t: Any, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step and its Jacobian, the step length held fixed: each stage differentiated as it is executed."""
        y = to_numpy(y)
        times, h = self._stage_times(t, np.asarray(h)), np.asarray(h, dtype=y.dtype)[..., None]
        if not system.has_hessian_vector:
            system.hessian(y, times[0])  # which says so, before anything large is made
        identity = np.eye(y.shape[-1], dtype=y.dtype)
        K: list[np.ndarray] = []
        dK: list[np.ndarray] = []
        for row, at in zip(self.A, times, strict=False):
            Y = y + h * weighted(row, K) if K else y
            dY = identity + h[..., None] * weighted(row, dK) if K else identity
            K.append(system.vector_field(Y, at))
            dK.append(system.field_jacobian(Y, at) @ dY)
        return y + h * weighted(self.B, K), identity + h[..., None] * weighted(self.B, dK)


@dataclass(frozen=True)
class RungeKutta(ExplicitStep):
    """An explicit embedded Runge–Kutta method with step-size control.

    Parameters
    ----------
    rtol, atol : float
        The local error is kept below atol + rtol·|y|. Where `atol` is the default and states are less than a hundred
        times it, in the units of q or p, it is in units of their size.
    """

    rtol: float = 1e-3
    atol: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if not 0 <= as_float(value) < math.inf:
                raise ValueError(f"`{name}` must be a finite number, not negative; got {value!r}.")
        if self.rtol == 0 and self.atol == 0:
            raise ValueError("`rtol` and `atol` are both 0, which no step can meet: make one of them positive.")

    def tolerance_of(self, system: HamiltonianSystem, y0: Array) -> float:
        """Return `atol`, the default one in units of states so small that it would hide their errors."""
        if self.atol != type(self).atol or not readable(y0):
            return float(self.atol)
        y = to_numpy(y0)
        if (HIDES * np.abs(y.reshape(-1, 2, system.ndof)).max((0, 2), initial=0.0) > self.atol).all():
            return float(self.atol)
        size = smallest_size(system, y)
        return max(self.atol * size, sys.float_info.min) if HIDES * size <= self.atol else float(self.atol)


def weighted(weights: Any, K: list[Array]) -> Array:
    """Σ_i weights_i K_i, for as many weights as there are."""
    return sum((float(w) * k for w, k in zip(weights, K, strict=False) if w), 0.0 * K[0])


def hopeless(n_steps: int, t0: float, t: float, t1: float, most: int) -> str | None:
    """Why a run that has taken `n_steps` of `most` to t goes no further, or None."""
    left = abs(t1 - t)
    spent = n_steps >= most and left > 0
    if math.isinf(left):
        return no_event(n_steps, t) if spent else None
    lost = n_steps % 10_000 == 0 and n_steps * left > 10.0 * most * abs(t - t0)
    if not (spent or lost):
        return None
    pace = n_steps * left / abs(t - t0) if t != t0 else math.inf
    return (
        f"After {n_steps:,} steps t = {t:.15g} is reached, and at this pace the end needs about {pace:.1g} more; "
        f"`max_steps` is {most:,}. Raise it, or `max_step` or the tolerances, or end `t_span` earlier; a fixed-step "
        "method may do with fewer steps. Where the motion is slow, such short steps mean that the force is rough: "
        "terms of H that cancel lose digits: rewrite them."
    )
