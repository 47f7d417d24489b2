"""Implicit midpoint and Gauss–Legendre of order 4, 6 and 8: symplectic for any Hamiltonian, separable or not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, to_numpy
from sympflow.hamiltonian import collocation
from sympflow.hamiltonian.collocation import Tableau, gauss_legendre
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.times import stage_time
from sympflow.integrators.base import FixedStep
from sympflow.integrators.contract import Failure, Problem, method_class
from sympflow.integrators.loops import stepper_of
from sympflow.integrators.steppers import ArraySteps, Stepper

_BUTCHER = "J. C. Butcher, Implicit Runge–Kutta processes, Math. Comp. 18 (1964) 50–64"
_SYMPLECTIC = (
    "symplectic by J. M. Sanz-Serna, Runge–Kutta schemes for Hamiltonian systems, BIT 28 (1988) 877–883; any H"
)


@dataclass(frozen=True)
class Gauss(FixedStep):
    """A Gauss method: K_i = h f(y + Σ_j a_ij K_j), y + Σ_i b_i K_i, solved by Newton's method with the Hessian of H.

    The coefficients satisfy b_i a_ij + b_j a_ji = b_i b_j without rounding; for that the unknowns are, from three
    stages on, b_i K_i [3]_: rounded coefficients would make the energy drift, a part in 1e16 with each step.

    The iteration runs until the increments are rounding, so that a step is symplectic and reversible to rounding; an
    iteration that stops at a tolerance would make the energy drift [2]_. A step that has no solution, or whose
    iteration does not find it, ends the solution with status −1.

    With friction −Γp a step is one in q and P = e^{Γτ}p, τ from its beginning: P' = −e^{Γτ}∂H/∂q has no friction, and
    for Γ = γ these are the equations of e^{γτ}H(q, e^{−γτ}P), for which a Gauss method is symplectic. So the step is
    conformally symplectic, of the same order, for any H.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    compensated : bool
        True to sum with Kahan's compensation [1]_, which slows the growth of round-off. Compiled only.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006): II.1.3 (the
       methods), VI.4 (symplecticity), VIII.5 (compensated sums), VIII.6 (Newton's iteration).
    .. [2] E. Hairer, R. I. McLachlan, A. Razakarivony, "Achieving Brouwer's law with implicit Runge–Kutta methods", BIT
       48 (2008) 231–243.
    .. [3] M. Antoñana, J. Makazaga, A. Murua, "Reducing and monitoring round-off error propagation for symplectic
       implicit Runge–Kutta schemes", Numer. Algorithms 76 (2017) 861–880.
    """

    compensated: bool = False
    symplectic: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    takes_friction: ClassVar[bool] = True
    takes_driving: ClassVar[bool] = True
    follows: ClassVar[bool] = True
    breakdown: ClassVar[Failure] = Failure.UNSOLVED
    tableau: ClassVar[Tableau]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("compensated", self.compensated)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return collocation.counted_step(system, self.tableau, t, y, h)[0]

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.step(system, stage_time(t, 1.0, h), y, -h)  # the methods are symmetric

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step and its Jacobian, by differentiating the equations that the K of the step solve."""
        y = to_numpy(y)
        times = collocation.stage_times(self.tableau, t, y, h)
        h = np.asarray(h, dtype=y.dtype)[..., None]
        K, _ = collocation.stages(system, self.tableau, y, h, times)
        A, b, scale = (np.array(c, dtype=y.dtype) for c in self.tableau)
        M, D = collocation.newton_matrix(system, y[..., None, :] + A @ K, h, times, A, scale)
        s, n = K.shape[-2:]
        slopes = (h[..., None, None] * scale[:, None, None] * D).reshape(*y.shape[:-1], s * n, n)
        sizes = collocation.variable_sizes(y, K, 0 * M[..., 0])
        dK = collocation.solved(M, slopes, sizes).reshape(*y.shape[:-1], s, n, n)
        J = np.eye(n, dtype=y.dtype) + np.einsum("i,...ijk->...jk", b, dK)
        E = collocation.decays(system, h[..., 0])
        J = np.concatenate([J[..., : n // 2, :], E @ J[..., n // 2 :, :]], axis=-2)
        return collocation.advanced(system, self.tableau, y, K, h), J

    def own_stepper(self, problem: Problem) -> Stepper:
        from sympflow.kernels.newton import implicit_kernel

        make = partial(implicit_kernel, problem.system, self.tableau, bool(self.compensated))
        return stepper_of(self, problem, GaussSteps(problem.system, self.tableau), make, self.compensated)


class GaussSteps(ArraySteps):
    """Steps of a Gauss method by array operations, with the count of Newton's iterations."""

    def __init__(self, system: HamiltonianSystem, tableau: Tableau) -> None:
        self.system, self.tableau, self.stages = system, tableau, len(tableau[1])

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        y_next, iterations = collocation.counted_step(self.system, self.tableau, t, y, h)
        self.iterations += iterations
        return y_next


def _gauss_method(name: str, class_name: str, stages: int, source: str) -> type[Gauss]:
    """The integrator class of the Gauss method of so many stages."""
    own: dict[str, Any] = {"order": 2 * stages, "tableau": gauss_legendre(stages), "source": f"{source}; {_SYMPLECTIC}"}
    return method_class(Gauss, class_name, __name__, name=name, **own)


ImplicitMidpoint = _gauss_method(
    "implicit_midpoint", "ImplicitMidpoint", 1, "The implicit midpoint rule, y₁ = y + h f((y + y₁)/2)"
)
GaussLegendre4, GaussLegendre6, GaussLegendre8 = (
    _gauss_method(
        f"gauss_legendre{2 * s}", f"GaussLegendre{2 * s}", s, f"{_BUTCHER}, the Gauss method of {count} stages"
    )
    for s, count in ((2, "two"), (3, "three"), (4, "four"))
)
