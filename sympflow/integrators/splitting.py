"""The one stepper that runs any splitting scheme on a separable system."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, concatenate, is_tensor, per_state, to_numpy
from sympflow.hamiltonian.monomials import Monomials, gradient
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Problem
from sympflow.schemes import SCHEMES, Scheme, Substep, scheme_evaluations

if TYPE_CHECKING:
    from sympflow.kernels.splitting import SplittingKernel


@dataclass(frozen=True)
class Splitting(FixedStep):
    """Kicks p += b h F(q) and drifts q += a h ∇T(p) in the order and with the coefficients of a `Scheme`.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    compensated : bool
        Whether to sum with Kahan's compensation, which slows the growth of round-off over many steps. Compiled only.
        The sums begin anew with each piece of a run that is executed in pieces: with events, within SciPy's
        `solve_ivp`, and where the metrics execute it again.
    """

    compensated: bool = False

    scheme: ClassVar[Scheme]
    symplectic: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    saves_finite: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("compensated", self.compensated)

    def check(self, system: HamiltonianSystem) -> None:
        if not system.separable:
            raise ValueError(
                f"`method` {self.name!r} needs a separable system, H = T(p) + V(q), and {system.name!r} is not: use a "
                "Runge–Kutta method or train a SympFlow."
            )
        if (self.scheme.nystrom or self.scheme.level) and not system.quadratic_kinetic:
            raise ValueError(
                f"`method` {self.name!r} needs a kinetic energy ½ pᵀM⁻¹p, which {system.name!r} has not: use a scheme "
                "for any separable system, such as 'kahan_li8'."
            )

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        self.check(system)
        q, p = y[..., : system.ndof], y[..., system.ndof :]
        h = per_state(h, y)
        for substep in self.scheme.substeps:
            if substep.kind == "drift":
                q = q + (substep.one * h) * system.velocity(p)
            else:
                p = p + _kick(system, q, substep, h, self.scheme.monomials)
        return concatenate([q, p])

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        self.check(system)
        q, p = y[..., : system.ndof], y[..., system.ndof :]
        h = per_state(h, y)
        for substep in reversed(self.scheme.substeps):
            if substep.kind == "drift":
                q = q - (substep.one * h) * system.velocity(p)
            else:
                p = p - _kick(system, q, substep, h, self.scheme.monomials)
        return concatenate([q, p])

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        if self.scheme.level:  # would need third derivatives of V: differentiate the step itself
            return super().tangent(system, t, y, h)
        d = system.ndof
        y = to_numpy(y)
        q, p, h = y[..., :d], y[..., d:], np.asarray(h, dtype=y.dtype)[..., None]
        A = np.broadcast_to(np.eye(2 * d, dtype=y.dtype), (*y.shape, 2 * d)).copy()
        for kind, c, *_ in self.scheme.substeps:
            if kind == "drift":
                q = q + c * h * system.velocity(p)
                A[..., :d, :] += c * h[..., None] * (system.kinetic_hessian(p) @ A[..., d:, :])
            else:
                A[..., d:, :] -= c * h[..., None] * (system.potential_hessian(q) @ A[..., :d, :])
                p = p + c * h * system.force(q)
        return np.concatenate([q, p], axis=-1), A

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        self.check(problem.system)
        kernel = self._kernel(problem.system, problem.y0, problem.backend)
        if kernel is None:
            return super().rollout(problem, h, n_steps, save)
        y0 = problem.y0
        if y0.ndim == 1:
            states, last = kernel.run(self.scheme, h, y0, n_steps, save, self.compensated)
            return states, np.asarray(last), "compiled"
        rows = y0.reshape(-1, y0.shape[-1])
        states, finite = kernel.run_batch(self.scheme, h, rows, n_steps, save, self.compensated)
        return states.swapaxes(0, 1).reshape(len(save), *y0.shape), finite.reshape(y0.shape[:-1]), "compiled"

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str) -> Array:
        if backend != "compiled":
            return self.step(system, 0.0, y, h)
        from sympflow.kernels.splitting import splitting_kernel

        rows = np.ascontiguousarray(y).reshape(-1, y.shape[-1])
        lengths = np.broadcast_to(h, y.shape[:-1]).reshape(-1)
        return splitting_kernel(system).step(self.scheme, lengths, rows).reshape(y.shape)

    def reach_times(
        self,
        system: HamiltonianSystem,
        h: float,
        y0: np.ndarray,
        times: np.ndarray,
        stride: int,
        expected: float,
        backend: str,
    ) -> Any:
        """`kernels.timed.reach_times` of the scheme; None where it does not apply."""
        if self.compensated or system.symbols is None or self._kernel(system, y0, backend) is None:
            return None
        from sympflow.kernels.timed import reach_times

        return reach_times(system, self.scheme, h, y0, times, stride, expected)

    def _kernel(self, system: HamiltonianSystem, y0: Array, backend: str) -> SplittingKernel | None:
        """The compiled loops for such states, or None where these need, or the call asks for, array operations."""
        reason = None
        if backend == "array":
            reason = "`backend` is 'array': choose 'auto'."
        elif is_tensor(y0):
            reason = "`y0` is a tensor: pass a NumPy array, or use backend='array'."
        elif y0.dtype != np.float64:
            reason = f"`y0` is {y0.dtype}: use float64, or backend='array'."
        elif system.symbols is None and system.numba_functions is None:
            reason = f"`system` {system.name!r} is given by plain functions: use backend='array'."
        if reason is None:
            from sympflow.kernels.splitting import splitting_kernel

            try:
                return splitting_kernel(system)
            except ValueError as error:  # H holds a function that has no compiled form
                reason = str(error)
        if backend == "compiled":
            raise ValueError(f"`backend` 'compiled' does not apply. {reason}")
        if self.compensated:
            raise ValueError(f"`compensated` sums need compiled loops. {reason}")
        return None

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return scheme_evaluations(self.scheme, n_steps, n_saved, n_extra, backend)


def _kick(system: HamiltonianSystem, q: Array, kick: Substep, h: Any, monomials: Monomials) -> Array:
    """What a kick adds to p, where the scheme has it the force gradient, the curvature or the polynomial too."""
    force = system.force(q)
    change = (kick.one * h) * force
    if kick.three:
        change = change - (kick.three * h**3) * system.hessian_vector(q, system.velocity(force))
    if kick.five:
        change = change - (kick.five * h**5) * system.curvature_gradient(q)
    if kick.polynomial:
        change = change - h**3 * gradient(monomials, kick.polynomial, q)
    return change


def __getattr__(name: str) -> type[Splitting]:
    """The integrator classes as attributes of the module, where pickle looks for them."""
    if name in SCHEMES:
        return splitting(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def splitting(name: str) -> type[Splitting]:
    """The integrator class of the scheme of that name."""
    scheme = SCHEMES[name]
    namespace = {
        "name": name,
        "order": scheme.order,
        "scheme": scheme,
        "__doc__": f"{name}: order {scheme.order}, {scheme.source}\n\n{Splitting.__doc__}",
        "__module__": __name__,
    }
    return dataclass(frozen=True)(type(name, (Splitting,), namespace))
