"""Implicit midpoint and Gauss–Legendre of order 4, 6 and 8: symplectic for any Hamiltonian, separable or not."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, concatenate, is_tensor, library, per_state, stack, to_numpy, values
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.times import stage_time
from sympflow.integrators.base import KernelStepper, OwnStepper, Problem, Stepper, compiled_loops, rollout
from sympflow.integrators.contract import Failure

if TYPE_CHECKING:
    from sympflow.kernels.carry import Carry
    from sympflow.kernels.implicit_loops import ImplicitKernel, Tableau

MOST_ITERATIONS = 50
DIFFERENTIATED = 3
"""Iterations in the graph, and so the orders of derivatives that are right."""
TRACED_ITERATIONS = 8
"""Newton's iterations in a graph that `torch.compile` traces; from K = 0 some five converge where dt is sensible."""
_BUTCHER = "J. C. Butcher, Implicit Runge–Kutta processes, Math. Comp. 18 (1964) 50–64"
_SYMPLECTIC = (
    "symplectic by J. M. Sanz-Serna, Runge–Kutta schemes for Hamiltonian systems, BIT 28 (1988) 877–883; any H"
)


@dataclass(frozen=True)
class Gauss(OwnStepper):
    """A Gauss method: K_i = h f(y + Σ_j a_ij K_j), y + Σ_i b_i K_i, solved by Newton's method with the Hessian of H.

    The coefficients satisfy b_i a_ij + b_j a_ji = b_i b_j without rounding, for which from three stages on the unknowns
    are b_i K_i [3]_: rounded coefficients would make the energy drift, a part in 1e16 with each step.

    The iteration runs until the increments are rounding, so that a step is symplectic and reversible to rounding; an
    iteration that stops at a tolerance would make the energy drift [2]_. A step that has no solution, or whose
    iteration does not find it, ends the solution with status −1.

    With friction −Γp a step is one in q and P = e^{Γτ}p, τ from its beginning: P' = −e^{Γτ}∂H/∂q has no friction, and
    for Γ = γ these are the equations of e^{γτ}H(q, e^{−γτ}P), of which a Gauss method is symplectic. So the step is
    conformally symplectic, of the same order, for any H.

    Parameters
    ----------
    dt : float, optional
        Step length; the default is `system.dt`.
    compensated : bool
        Whether to sum with Kahan's compensation [1]_, which slows the growth of round-off. Compiled only.

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
    breakdown: ClassVar[Failure] = Failure.UNSOLVED
    tableau: ClassVar[Tableau]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("compensated", self.compensated)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.counted_step(system, t, y, h)[0]

    def counted_step(self, system: HamiltonianSystem, t: Any, y: Array, h: float | Array) -> tuple[Array, int]:
        """The step, and the iterations that it took, in sum over the states."""
        K, iterations = self._stages(system, y, per_state(h, y), self.stage_times(system, t, y, h))
        return self._advanced(system, y, K, per_state(h, y)), iterations

    def stage_times(self, system: HamiltonianSystem, t: Any, y: Array, h: Any) -> Any:
        """The times t + c_i h of the stages, (..., s), of a driven system; None of another."""
        if system.autonomous:
            return None
        nodes, batch = stage_nodes(self.tableau), y.shape[:-1]
        times = [stage_time(t, c, h) for c in nodes]
        if is_tensor(y):
            import torch

            times = [torch.as_tensor(s, dtype=torch.float64, device=y.device).expand(batch) for s in times]
        return stack(times if is_tensor(y) else [np.broadcast_to(s, batch) for s in times], axis=-1)

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.step(system, stage_time(t, 1.0, h), y, -h)  # the methods are symmetric

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        """The step and its Jacobian, by differentiating the equations that the K of the step solve."""
        y = to_numpy(y)
        times, h = self.stage_times(system, t, y, h), np.asarray(h, dtype=y.dtype)[..., None]
        K, _ = self._stages(system, y, h, times)
        A, b, scale = (np.array(c, dtype=y.dtype) for c in self.tableau)
        M, D = _newton_matrix(system, y[..., None, :] + A @ K, h, times, A, scale)
        s, n = K.shape[-2:]
        slopes = (h[..., None, None] * scale[:, None, None] * D).reshape(*y.shape[:-1], s * n, n)
        dK = _solved(M, slopes).reshape(*y.shape[:-1], s, n, n)
        J = np.eye(n, dtype=y.dtype) + np.einsum("i,...ijk->...jk", b, dK)
        if system.friction is not None:
            E = _decays(system, h[..., 0])
            J = np.concatenate([J[..., : n // 2, :], E @ J[..., n // 2 :, :]], axis=-2)
        return self._advanced(system, y, K, h), J

    @property
    def takes_friction(self) -> bool:
        return True

    @property
    def takes_driving(self) -> bool:
        return True

    def own_stepper(self, problem: Problem) -> CompiledGauss | ArrayGauss:
        from sympflow.kernels.implicit_loops import implicit_kernel

        kernel = compiled_loops(
            lambda: implicit_kernel(problem.system, self.tableau, bool(self.compensated)),
            problem.y0,
            problem.backend,
            self.compensated,
        )
        return ArrayGauss(self, problem) if kernel is None else CompiledGauss(self, problem, kernel)

    def _advanced(self, system: HamiltonianSystem, y: Array, K: Array, h: Any) -> Array:
        end = y + sum(b * K[..., i, :] for i, b in enumerate(self.tableau[1]))
        if system.friction is None:
            return end
        d = system.ndof
        return concatenate([end[..., :d], system.friction.drift(end[..., d:], h)[1]])

    def _stages(self, system: HamiltonianSystem, y: Array, h: Any, times: Any) -> tuple[Array, int]:
        """The K (..., s, 2d) of a step, NaN where the step was not solved; and the iterations, over all states."""
        if is_tensor(y):
            return self._tensor_stages(system, y, h, times)
        A, _, scale = (np.array(c, dtype=y.dtype) for c in self.tableau)
        eps = float(np.finfo(y.dtype).eps)
        K = np.zeros((*y.shape[:-1], len(A), y.shape[-1]), dtype=y.dtype)
        done = np.zeros(y.shape[:-1], dtype=bool)
        before = np.full(y.shape[:-1], np.inf)
        iteration = 0
        with np.errstate(all="ignore"):
            while not done.all() and iteration < MOST_ITERATIONS:
                iteration += 1
                M, residual = _equations(system, y, K, h, times, A, scale)
                change = _solved(M, residual[..., None])[..., 0].reshape(K.shape)
                K = np.where(done[..., None, None], K, K - change)
                size = _relative_size(change, y, K, system.ndof)
                small = (size <= eps**0.7) | ((size <= eps**0.57) & (size >= before / 2))
                lost = ~(size < np.inf) & ~done
                K[lost] = np.nan
                done, before = done | small | lost, size
        K[~done] = np.nan
        return K, iteration * done.size

    def _tensor_stages(self, system: HamiltonianSystem, y: Array, h: Any, times: Any) -> tuple[Array, int]:
        """`_stages` of tensors: solved without a graph, then three more iterations in it, which give it derivatives.

        They are Newton's with the matrix of the solution held fixed: each makes derivatives of one more order right.
        """
        import torch

        A, _, scale = (torch.as_tensor(c, dtype=y.dtype, device=y.device) for c in self.tableau)
        with torch.no_grad():
            start, length = y.detach(), h.detach() if is_tensor(h) else h
            K, iterations = _solved_tensors(system, start, length, times, A, scale)
            M, _ = _newton_matrix(system, start[..., None, :] + A @ K, length, times, A, scale)
            inverse = torch.linalg.inv_ex(M)[0]
        for _ in range(DIFFERENTIATED):
            K = K - (inverse @ _residual(system, y, K, h, times, A, scale)[..., None])[..., 0].reshape(K.shape)
        return K, iterations


def _solved_tensors(system: HamiltonianSystem, y: Any, h: Any, times: Any, A: Any, scale: Any) -> tuple[Any, int]:
    """The K of `Gauss._stages` for tensors, by the same iteration, and its count over all states.

    Under `torch.func.vmap` it runs until the last lane has converged; where a graph is traced, which cannot depend on
    values, `TRACED_ITERATIONS` times.
    """
    import torch

    eps = torch.finfo(y.dtype).eps
    K = y[..., None, :] * torch.zeros_like(A[:, :1])
    before = y[..., 0] * 0 + torch.inf
    done = before < 0
    for iteration in range(1, MOST_ITERATIONS + 1):
        M, residual = _equations(system, y, K, h, times, A, scale)
        change = torch.linalg.solve_ex(M, residual[..., None])[0][..., 0].reshape(K.shape)
        K = torch.where(done[..., None, None], K, K - change)
        size = _relative_size(change, y, K, system.ndof)
        small = (size <= eps**0.7) | ((size <= eps**0.57) & (size >= before / 2))
        lost = ~(size < torch.inf) & ~done
        K = torch.where(lost[..., None, None], torch.nan, K)
        done, before = done | small | lost, size
        found = values(done)
        if iteration == TRACED_ITERATIONS if found is None else found.all():
            break
    return torch.where(done[..., None, None], K, torch.nan), iteration * done.numel()


class _Counts:
    """Counts of a run of a Gauss method: Newton's iterations, each with the force and the Hessian at every stage."""

    gauss: Gauss
    iterations: int
    counts_itself: ClassVar[bool] = True

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int) -> dict[str, int]:
        n = self.iterations * len(self.gauss.tableau[1])
        return {"force_evaluations": n, "hessian_evaluations": n}

    def more_stats(self) -> dict[str, int]:
        return {"newton_iterations": self.iterations}


class CompiledGauss(_Counts, KernelStepper):
    """A run of a Gauss method in compiled loops."""

    def __init__(self, gauss: Gauss, problem: Problem, kernel: ImplicitKernel) -> None:
        super().__init__(gauss, problem, kernel)
        self.gauss = gauss


class ArrayGauss(_Counts, Stepper):
    """A run of a Gauss method by array operations."""

    takes_carry = True

    def __init__(self, gauss: Gauss, problem: Problem) -> None:
        super().__init__(gauss, problem)
        self.gauss, self.iterations = gauss, 0

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: Carry | None = None
    ) -> tuple[Array, np.ndarray]:
        return rollout(lambda k, y: self.shorter(y, h, t0 + k * h), y0, n_steps, save, carry=carry)

    def shorter(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        y_next, iterations = self.gauss.counted_step(self.system, t, y, h)
        self.iterations += iterations
        return y_next


def stage_nodes(tableau: Tableau) -> tuple[float, ...]:
    """The nodes c_i of the stages, in steps."""
    A, _, scale = tableau
    return tuple(float(np.dot(row, scale)) for row in A)


def _equations(
    system: HamiltonianSystem, y: Array, K: Array, h: Any, times: Any, A: Array, scale: Array
) -> tuple[Array, Array]:
    """Newton's matrix (..., s·2d, s·2d) and the residuals of `_residual`."""
    M, _ = _newton_matrix(system, y[..., None, :] + A @ K, h, times, A, scale)
    return M, _residual(system, y, K, h, times, A, scale)


def _residual(system: HamiltonianSystem, y: Array, K: Array, h: Any, times: Any, A: Array, scale: Array) -> Array:
    """K_i − h scale_i f(Y_i), (..., s·2d)."""
    outer = h[..., None] if getattr(h, "ndim", 0) else h
    residual = K - outer * scale[:, None] * _field(system, y[..., None, :] + A @ K, h, times, A, scale)
    return residual.reshape(*residual.shape[:-2], -1)


def _field(system: HamiltonianSystem, Y: Array, h: Any, times: Any, A: Array, scale: Array) -> Array:
    """f of the stages Y (..., s, 2d); with friction of [q, P], [∂H/∂p, −e^{Γτ}∂H/∂q] at p = e^{−Γτ}P."""
    friction, d = system.friction, system.ndof
    if friction is None:
        return system.vector_field(Y, times)
    tau = (A @ scale * h)[..., None]
    slope = system.gradient(concatenate([Y[..., :d], friction.drift(Y[..., d:], tau)[1]]), times)
    return concatenate([slope[..., d:], -friction.drift(slope[..., :d], -tau)[1]])


def _decays(system: HamiltonianSystem, s: Any) -> Array:
    """e^{−Γs} for times s, a number or (...): (..., d, d)."""
    friction = system.friction
    assert friction is not None
    identity = np.eye(system.ndof)
    if is_tensor(s):
        import torch

        return friction.drift(torch.as_tensor(identity, dtype=s.dtype, device=s.device), s[..., None, None])[1]
    s = np.asarray(s)
    return friction.drift(identity.astype(s.dtype), s[..., None, None])[1]


def _newton_matrix(
    system: HamiltonianSystem, Y: Array, h: Any, times: Any, A: Array, scale: Array
) -> tuple[Array, Array]:
    """M = I − h (scale_i A_ij f'(Y_i)), (..., s·2d, s·2d), and f'(Y), (..., s, 2d, 2d)."""
    d, (s, n) = system.ndof, Y.shape[-2:]
    tau: Any = None
    if system.friction is not None:
        tau = A @ scale * h
        p = system.friction.drift(Y[..., d:], tau[..., None])[1]
        Y = concatenate([Y[..., :d], p])
    S = system.hessian(Y, times)
    D = concatenate([S[..., d:, :].swapaxes(-1, -2), -S[..., :d, :].swapaxes(-1, -2)]).swapaxes(-1, -2)
    if tau is not None:
        by_P, grown = D[..., d:] @ _decays(system, tau), _decays(system, -tau)
        D = concatenate([D[..., :d], by_P])
        lower = grown @ D[..., d:, :]
        D = concatenate([D[..., :d, :].swapaxes(-1, -2), lower.swapaxes(-1, -2)]).swapaxes(-1, -2)
    outer = h[..., None, None, None] if getattr(h, "ndim", 0) else h
    blocks = outer * (scale[:, None] * A)[:, None, :, None] * D[..., :, :, None, :]
    M = -blocks.reshape(*Y.shape[:-2], s * n, s * n)
    if is_tensor(M):
        import torch

        return M + torch.eye(s * n, dtype=M.dtype, device=M.device), D
    return M + np.eye(s * n, dtype=M.dtype), D


def _solved(M: np.ndarray, x: np.ndarray) -> np.ndarray:
    """M⁻¹x, NaN where M is singular."""
    try:
        return np.linalg.solve(M, x)
    except np.linalg.LinAlgError:
        out = np.full(x.shape, np.nan, dtype=x.dtype)
        for i in np.ndindex(M.shape[:-2]):
            if np.isfinite(M[i]).all() and np.linalg.matrix_rank(M[i]) == len(M[i]):
                out[i] = np.linalg.solve(M[i], x[i])
        return out


def _relative_size(change: Array, y: Array, K: Array, d: int) -> Array:
    """The larger of ‖ΔK_q‖/(‖q‖ + ‖K_q‖) and ‖ΔK_p‖/(‖p‖ + ‖K_p‖), (...)."""
    xp = library(y)
    ratios = []
    for part in (slice(0, d), slice(d, None)):
        top = xp.amax(abs(change[..., part]), (-2, -1))
        scale = xp.amax(abs(y[..., part]) + xp.amax(abs(K[..., part]), -2), -1)
        ratios.append(xp.where(top == 0, 0 * top, top / xp.where(scale == 0, 1 + 0 * scale, scale)))
    return xp.maximum(*ratios)


def gauss_legendre(stages: int) -> Tableau:
    """The Gauss–Legendre method of s stages, order 2s, symplectic without rounding.

    With the Legendre polynomials P_k, orthonormal on [0, 1], and ξ_k = 1/(2√(4k² − 1)),

        a_ij/b_j = ½ + Σ_k ξ_k (P_k(c_i) P_{k−1}(c_j) − P_{k−1}(c_i) P_k(c_j)),   k = 1 … s − 1,

    of which a_ij/b_j + a_ji/b_i = 1 is plain. The larger of the two lies in [1/2, 2], so that the other is computed
    without rounding.

    References
    ----------
    .. [1] E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, 2nd ed. (Springer 1996), theorem IV.5.6.
    """
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    P = np.polynomial.legendre.legvander(nodes, stages - 1) * np.sqrt(2 * np.arange(stages) + 1)
    S = np.zeros((stages, stages))
    for k in range(1, stages):
        S += (np.outer(P[:, k], P[:, k - 1]) - np.outer(P[:, k - 1], P[:, k])) / (2 * sqrt(4 * k * k - 1))
    larger = 0.5 + np.abs(S)
    ratios = np.where(S >= 0, larger, 1 - larger)
    half = [0.5 * w for w in weights.tolist()]
    if stages <= 2:  # equal weights, powers of two
        return _rows(ratios * half), tuple(half), (1.0,) * stages
    return _rows(ratios), (1.0,) * stages, tuple(half)


def _rows(A: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in A.tolist())


@dataclass(frozen=True)
class ImplicitMidpoint(Gauss):
    """The implicit midpoint rule, y₁ = y + h f((y + y₁)/2): order 2, symplectic, symmetric, A-stable.

    Parameters
    ----------
    dt, compensated
        As for `Gauss`.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006), (I.1.7), VI.4.
    """

    name: ClassVar[str] = "implicit_midpoint"
    source: ClassVar[str] = f"The implicit midpoint rule, y₁ = y + h f((y + y₁)/2); {_SYMPLECTIC}"
    order: ClassVar[int | None] = 2
    tableau: ClassVar[Tableau] = gauss_legendre(1)


def _gauss_legendre_method(stages: int, count: str) -> type[Gauss]:
    """The integrator class of the Gauss–Legendre method of so many stages."""
    summary = f"The Gauss–Legendre method of {count} stages: order {2 * stages}, symplectic, symmetric, A-stable."
    namespace: dict[str, Any] = {
        "name": f"gauss_legendre{2 * stages}",
        "source": f"{_BUTCHER}, the Gauss method of {count} stages; {_SYMPLECTIC}",
        "order": 2 * stages,
        "tableau": gauss_legendre(stages),
        "__doc__": f"{summary}\n\n{Gauss.__doc__}",
        "__module__": __name__,
    }
    return dataclass(frozen=True)(type(f"GaussLegendre{2 * stages}", (Gauss,), namespace))


GaussLegendre4 = _gauss_legendre_method(2, "two")
GaussLegendre6 = _gauss_legendre_method(3, "three")
GaussLegendre8 = _gauss_legendre_method(4, "four")
