"""Levenberg–Marquardt: least squares by Gauss–Newton steps, damped where the linear model fails.

`levenberg_marquardt` minimizes a function of a few numbers in NumPy, `GaussNewtonSteps` trains the weights of a flow,
one step at a time. Both take the steps of `damped_step`; they differ in how they solve the linear problem of a step.

References
----------
.. [1] J. J. Moré, The Levenberg–Marquardt algorithm: implementation and theory, Lect. Notes Math. 630 (1978).
.. [2] H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05 (1999).
.. [3] M. K. Transtrum, J. P. Sethna, Improvements to the Levenberg–Marquardt algorithm for nonlinear least-squares
   minimization, arXiv:1201.5885 (2012).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.linalg.blas import dsyrk
from torch import Tensor

from sympflow.flow.flow_map import FlowMap
from sympflow.kernels.gauss_newton import bent, damped, factored
from sympflow.training.losses import Objective
from sympflow.training.session import OutOfTime

PROBE = 0.1  # share of a step over which the residuals' curvature is measured
CURVED = 0.75  # largest ratio of the second-order correction to the step
FIRST_DAMPING = 1e-3
STOPPED = "it was stopped"

Stop = Callable[[], bool]


# one step ---------------------------------------------------------------------------------------------------------


@dataclass
class Damping:
    """λ, which follows the gain ratio of the steps, actual over predicted decrease, as in [2]_."""

    value: float = FIRST_DAMPING
    least: float = 0.0
    growth: float = 2.0

    def accepted(self, gain: float) -> None:
        self.value = max(self.value * max(1 / 5, 1 - (2 * min(gain, 1.0) - 1) ** 3), self.least)
        self.growth = 2.0

    def rejected(self) -> None:
        self.value, self.growth = self.value * self.growth, self.growth * 2


class Linearized(ABC):
    """Residuals r with their Jacobian J at a point x, and the scales D of the parameters: arrays or tensors."""

    x: Any
    r: Any
    J: Any
    D: Any

    @abstractmethod
    def damp(self, damping: float) -> None:
        """Get ready to solve with JᵀJ + λD²."""

    @abstractmethod
    def newton(self) -> tuple[Any, float]:
        """The s that minimizes ‖J s + r‖² + λ‖D s‖², and the decrease of ‖r‖² that the linear model predicts."""

    @abstractmethod
    def bend(self, residuals: Callable[[Any], Any], step: Any) -> Any:
        """The geodesic acceleration of [3]_, by which a step follows a curved valley; 0 where it would lead astray.

        That of the last damping.
        """

    @abstractmethod
    def moved(self, step: Any, bend: Any) -> Any:
        """x + step + bend."""


def damped_step(
    model: Linearized,
    residuals: Callable[[Any], Any],
    cost: Callable[[Any], float],
    before: float,
    damping: Damping,
    tries: int,
) -> tuple[Any, float] | None:
    """The point after a step that lowers the cost, and the cost there; None if no step of so many does.

    Parameters
    ----------
    model : Linearized
    residuals, cost : callable
        At any point; the cost is not finite where a point is not admissible.
    before : float
        The cost at the point of the model.
    damping : Damping
        It grows until a step is accepted.
    tries : int
    """
    for _ in range(tries):
        model.damp(damping.value)
        step, predicted = model.newton()
        trial = model.moved(step, model.bend(residuals, step))
        after = cost(trial)
        gain = (before - after) / predicted if predicted > 0 and math.isfinite(after) else -1.0
        if gain > 0:
            damping.accepted(gain)
            return trial, after
        damping.rejected()
    return None


# a few numbers ----------------------------------------------------------------------------------------------------

MAX_REJECTED = 30
LEAST_DAMPING = 1e-20


@dataclass(frozen=True)
class Minimum:
    """The end of a search: parameters (n,), sum of squares, iterations, and why it ended."""

    x: np.ndarray
    cost: float
    iterations: int
    reason: str


@np.errstate(over="ignore", invalid="ignore")  # of trials that go too far; what is not finite is rejected
def levenberg_marquardt(
    residuals: Callable[[np.ndarray], np.ndarray],
    linearized: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray | Blocks]],
    x: np.ndarray,
    *,
    iterations: int = 200,
    patience: int = 10,
    gain: float = 1e-2,
    damping: float = FIRST_DAMPING,
    stop: Stop = lambda: False,
) -> Minimum:
    """Minimize ‖r(x)‖².

    A step solves min ‖J s + r‖² + λ‖D s‖² by QR factorizations, never by normal equations; D holds the largest norms
    that the columns of J had. The step is bent by the geodesic acceleration of [3]_, which follows the curved valleys
    of such problems.

    Parameters
    ----------
    residuals : callable
        r(x), (m,); not finite where x is not admissible.
    linearized : callable
        r(x) and its Jacobian J(x), (m, n), or in blocks.
    x : ndarray, shape (n,)
        The start.
    iterations : int
        The most accepted steps.
    patience, gain : int, float
        The search ends when `patience` steps together lower the cost by less than this share of it.
    damping : float
        The first λ.
    stop : callable
        Asked before each step whether to end here. An OutOfTime that r or J raises ends it as well.
    """

    def cost_at(x: np.ndarray) -> float:
        r = residuals(x)
        return float(r @ r)

    costs: list[float] = []
    scale, level = np.zeros(len(x)), Damping(damping, LEAST_DAMPING)
    try:
        costs.append(cost_at(x))
        if not math.isfinite(costs[0]):
            return Minimum(x, math.inf, 0, "the residuals are not finite at the start")
        for iteration in range(iterations):
            if stop():
                return Minimum(x, costs[-1], iteration, STOPPED)
            model = _Factored(x, *linearized(x), scale)
            scale = model.scale
            found = damped_step(model, residuals, cost_at, costs[-1], level, MAX_REJECTED)
            if found is None:
                return Minimum(x, costs[-1], iteration, "no step lowers the cost")
            x, cost = found
            costs.append(cost)
            if len(costs) > patience and cost > (1 - gain) * costs[-1 - patience]:
                return Minimum(x, cost, iteration + 1, "it has converged")
    except OutOfTime:
        return Minimum(x, costs[-1] if costs else math.inf, max(len(costs) - 1, 0), STOPPED)
    return Minimum(x, costs[-1], iterations, "the iterations were used up")


@dataclass(frozen=True)
class Blocks:
    """A Jacobian in blocks of rows, each some columns of its own times a matrix.

    Parameters
    ----------
    columns : (k, m)
    matrices : (B, k, n)
        The b-th of B equal blocks of J is the b-th part of the columns, transposed, times the b-th matrix.
    """

    columns: np.ndarray
    matrices: np.ndarray

    def whole(self) -> np.ndarray:
        """J (m, n)."""
        parts = np.split(self.columns, len(self.matrices), axis=1)
        return np.concatenate([part.T @ matrix for part, matrix in zip(parts, self.matrices, strict=True)])


NO_BLOCKS = np.empty((0, 0, 0))


class _Factored(Linearized):
    """A linear model in compiled code, by QR factorizations of [J r] and, for each λ, of [R; √λ D]."""

    def __init__(self, x: np.ndarray, r: np.ndarray, J: np.ndarray | Blocks, scale: np.ndarray) -> None:
        self.x, self.r = x, np.ascontiguousarray(r)
        J = J if isinstance(J, Blocks) else Blocks(np.ascontiguousarray(J.T), NO_BLOCKS)
        self.J = J
        self._R, self.scale = factored(J.columns, J.matrices, self.r, scale)
        self.D = np.where(self.scale > 0, self.scale, 1.0)

    def damp(self, damping: float) -> None:
        self._damped, step, decrease = damped(self._R, self.D, damping)
        self._newton = step, decrease

    def newton(self) -> tuple[np.ndarray, float]:
        step, decrease = self._newton
        return step, decrease

    def bend(self, residuals: Callable[[np.ndarray], np.ndarray], step: np.ndarray) -> Any:
        probed = residuals(self.x + PROBE * step)
        return bent(self.J.columns, self.J.matrices, self.r, probed, PROBE, step, self._damped, self.D, CURVED)

    def moved(self, step: np.ndarray, bend: np.ndarray) -> np.ndarray:
        return self.x + step + bend


# the weights of a flow --------------------------------------------------------------------------------------------

MAX_PARAMETERS = 8000
TRIES = 20
LEAST_DAMPING_OF_WEIGHTS = 1e-16
WELL_CONDITIONED = 1e-8  # damping above which (JᵀJ + λD²)s = −Jᵀr loses no more than half the digits
PATIENCE = 20
GAIN = 1e-2
PULL = 1e-16  # towards 0, per squared weight: it costs nothing until a weight runs away


def weight_vector(parameters: Sequence[Tensor]) -> Tensor:
    """A copy of the parameters, one after another: (n,)."""
    return torch.cat([w.detach().reshape(-1) for w in parameters])


@torch.no_grad()
def put_weights(parameters: Sequence[Tensor], x: Tensor) -> None:
    """Give the parameters the values x (n,)."""
    for w, part in zip(parameters, x.split([w.numel() for w in parameters]), strict=True):
        w.copy_(part.view_as(w))


class GaussNewtonSteps:
    """Levenberg–Marquardt on the residuals of a flow, one accepted step at a time; it trains networks best.

    A step s minimizes ‖J s + r‖² + λ‖D s‖², D the largest norms that the columns of J have had, so that λ bounds
    the condition number: by the normal equations where it is large, else by a QR factorization of J. To r belongs a
    tiny multiple of the weights: a neuron that is saturated at all points may else run off to a step of any slope,
    which no held-out point sees, but an orbit meets after some ten thousand steps. The steps end where `PATIENCE` of
    them on the same points lower the loss by less than 1 %, or none does.

    Attributes
    ----------
    finished : str or None
        Why no more steps are worth while.
    """

    needs_residuals: ClassVar[bool] = True

    def __init__(self, flow: FlowMap) -> None:
        if flow.n_parameters > MAX_PARAMETERS:
            raise ValueError(
                f"`optimizer` 'gauss-newton' keeps a dense Jacobian and takes at most {MAX_PARAMETERS} parameters; the "
                f"flow has {flow.n_parameters}: use 'lbfgs' or 'adam'."
            )
        self.parameters = list(flow.parameters())
        self.damping = Damping(FIRST_DAMPING, LEAST_DAMPING_OF_WEIGHTS)
        self.scale: Tensor | None = None  # D²
        self.costs: list[float] = []
        self.draw: int | None = None
        self.finished: str | None = None

    def state_dict(self) -> dict[str, Any]:
        return {
            "damping": self.damping.value,
            "growth": self.damping.growth,
            "scale": self.scale,
            "costs": self.costs,
            "draw": self.draw,
            "finished": self.finished,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        n, scale = sum(w.numel() for w in self.parameters), state["scale"]
        if scale is not None and scale.shape != (n,):
            raise ValueError(f"`state` has a scale of shape {tuple(scale.shape)}, not {(n,)}: start afresh.")
        self.scale = None if scale is None else scale.to(self.parameters[0])
        self.damping = Damping(state["damping"], LEAST_DAMPING_OF_WEIGHTS, state["growth"])
        self.costs, self.draw, self.finished = list(state["costs"]), state["draw"], state["finished"]

    def step(self, index: int, objective: Objective) -> float:
        """Take a step; the loss before it. An OutOfTime of the objective leaves the weights as they were."""
        x = weight_vector(self.parameters)
        try:
            return self._step(x, objective)
        except OutOfTime:
            put_weights(self.parameters, x)
            raise

    def _step(self, x: Tensor, objective: Objective) -> float:
        r, J = objective.linearized()
        loss = float(r @ r)
        cost = loss + PULL * float(x @ x)
        if not math.isfinite(cost):
            return cost
        if objective.draw != self.draw:
            self.draw, self.costs = objective.draw, []

        def residuals(x: Tensor) -> Tensor:
            put_weights(self.parameters, x)
            return objective.residuals()

        def cost_at(x: Tensor) -> float:
            return float(residuals(x).square().sum()) + PULL * float(x @ x)

        model = _Normal(x, r, J, self.scale)
        self.scale = model.scale
        found = damped_step(model, residuals, cost_at, cost, self.damping, TRIES)
        if found is None:
            put_weights(self.parameters, x)
            self.damping = Damping(FIRST_DAMPING, LEAST_DAMPING_OF_WEIGHTS)
            self.finished = "no step lowers the loss"
            return loss
        self.costs = [*self.costs[-PATIENCE:], found[1]]
        if len(self.costs) > PATIENCE and found[1] > (1 - GAIN) * self.costs[0]:
            self.finished = "it has converged"
        return loss


class _Normal(Linearized):
    """A linear model in torch, with the pull to 0, by Cholesky's factors of JᵀJ + λD².

    Where λ is small, by a QR factorization of J, once, and one of its triangle for each λ.
    """

    def __init__(self, x: Tensor, r: Tensor, J: Tensor, scale: Tensor | None) -> None:
        self.x, self.r, self.J = x, r, J
        self._G, self._g = gram(J), J.T @ r + PULL * x
        self._G.diagonal().add_(PULL)
        squares = self._G.diagonal()
        self.scale = squares.clone() if scale is None else torch.maximum(scale, squares)
        self.D = torch.where(self.scale > 0, self.scale, 1.0).sqrt()
        self._in_units = self._G / self.D / self.D[:, None]
        self._triangle: Tensor | None = None

    def damp(self, damping: float) -> None:
        if damping > WELL_CONDITIONED:
            damped = self._in_units.clone()
            damped.diagonal().add_(damping)
            R, failed = torch.linalg.cholesky_ex(damped, upper=True)
        if damping <= WELL_CONDITIONED or failed:
            if self._triangle is None:
                self._triangle = torch.linalg.qr(self.J, mode="r")[1] / self.D
            below = (damping + PULL / self.D**2).sqrt().diag()
            R = torch.linalg.qr(torch.cat([self._triangle, below]), mode="r")[1]
        self._R = R

    def newton(self) -> tuple[Tensor, float]:
        s = -self.solve(self._g)
        return s, -float(s @ (self._G @ s + 2 * self._g))

    def solve(self, w: Tensor) -> Tensor:
        """(JᵀJ + λD²)⁻¹ w."""
        return torch.cholesky_solve((w / self.D)[:, None], self._R, upper=True)[:, 0] / self.D

    def bend(self, residuals: Callable[[Tensor], Tensor], step: Tensor) -> Tensor:
        curvature = (residuals(self.x + PROBE * step) - self.r - PROBE * (self.J @ step)) / PROBE**2
        bend = -self.solve(self.J.T @ curvature)
        small = 2 * torch.linalg.vector_norm(self.D * bend) <= CURVED * torch.linalg.vector_norm(self.D * step)
        return bend if small else 0 * step  # NaN is not small

    def moved(self, step: Tensor, bend: Tensor) -> Tensor:
        return self.x + (step + bend)


def gram(J: Tensor) -> Tensor:
    """JᵀJ, by half of the products where the numbers are on the CPU."""
    if J.device.type != "cpu":
        return J.T @ J
    columns, transposed = (J.T, 0) if J.is_contiguous() else (J, 1)
    upper = torch.from_numpy(dsyrk(1.0, columns.numpy(), trans=transposed))
    return upper.triu() + upper.triu(1).T
