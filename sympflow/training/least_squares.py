"""Levenberg–Marquardt: least squares by Gauss–Newton steps, damped where the linear model fails.

There is one method, `descend`, of the steps of `damped_step`, and a `LinearModel` for each way to solve the linear
problem of a step: QR factorizations of a few numbers, Cholesky's factors of the weights of a flow, and in
`sympflow.learning.shooting` elimination of the initial states of orbits.

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
from sympflow.kernels.gauss_newton import damped, factored, geodesic_acceleration
from sympflow.training.losses import Objective
from sympflow.training.session import Deadline, OutOfTime

PROBE = 0.1  # share of a step over which the residuals' curvature is measured
CURVED = 0.75  # largest ratio of the second-order correction to the step
FIRST_DAMPING = 1e-3
STOPPED = "it was stopped"

Check = Callable[[], None]
Stop = Callable[[], bool]


def never() -> bool:
    """Return False, of work that nothing stops."""
    return False


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


class LinearModel(ABC):
    """Residuals r with their Jacobian J at a point x, and a solver of JᵀJ + λD², D the scales of the parameters."""

    @abstractmethod
    def trial(self, damping: float) -> tuple[Any, float] | None:
        """The point to try, and the decrease of ‖r‖² that the model predicts there; None if it cannot be solved."""


def damped_step(
    model: LinearModel, cost: Callable[[Any, int], float], before: float, damping: Damping, tries: int
) -> tuple[Any, float] | None:
    """The point after one of so many `tries` that lowers the cost from `before`, and the cost there; else None."""
    for attempt in range(tries):
        found = model.trial(damping.value)
        if found is not None:
            trial, predicted = found
            after = cost(trial, attempt)
            gain = (before - after) / predicted if predicted > 0 and math.isfinite(after) else -1.0
            if gain > 0:
                damping.accepted(gain)
                return trial, after
        damping.rejected()
    return None


def converged(costs: Sequence[float], patience: int, gain: float) -> bool:
    """Return whether `patience` steps together lowered the cost by less than this share of it."""
    return len(costs) > patience and costs[-1] > (1 - gain) * costs[-1 - patience]


def descend(
    x: Any,
    costs: list[float],
    model_at: Callable[[Any], LinearModel],
    cost: Callable[[Any, int], float],
    *,
    damping: Damping,
    tries: int,
    iterations: int,
    patience: int,
    gain: float,
    stop: Stop,
) -> tuple[Any, str]:
    """Levenberg and Marquardt's steps from x, of which `costs` has the cost; the end, and its reason."""
    try:
        for _ in range(iterations):
            if stop():
                return x, STOPPED
            found = damped_step(model_at(x), cost, costs[-1], damping, tries)
            if found is None:
                return x, "no step lowers the cost"
            x, after = found
            costs.append(after)
            if converged(costs, patience, gain):
                return x, "it has converged"
    except OutOfTime:
        return x, STOPPED
    return x, "the iterations were used up"


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
    stop: Stop = never,
) -> Minimum:
    """Minimize ‖r(x)‖² by QR factorizations, steps corrected by the geodesic acceleration of [3]_."""

    scale = np.zeros(len(x))

    def cost_at(x: np.ndarray, attempt: int = 0) -> float:
        r = residuals(x)
        return float(r @ r)

    def model_at(x: np.ndarray) -> _Factored:
        nonlocal scale
        model = _Factored(x, *linearized(x), scale, residuals)
        scale = model.scale
        return model

    level = Damping(damping, LEAST_DAMPING)
    costs = [cost_at(x)]
    if not math.isfinite(costs[0]):
        return Minimum(x, math.inf, 0, "the residuals are not finite at the start")
    options: Any = {"damping": level, "tries": MAX_REJECTED, "iterations": iterations, "patience": patience}
    x, reason = descend(x, costs, model_at, cost_at, gain=gain, stop=stop, **options)
    return Minimum(x, costs[-1], len(costs) - 1, reason)


@dataclass(frozen=True)
class Blocks:
    """A Jacobian in blocks of rows, each some columns of its own times a matrix."""

    columns: np.ndarray
    matrices: np.ndarray

    def whole(self) -> np.ndarray:
        """J (m, n)."""
        parts = np.split(self.columns, len(self.matrices), axis=1)
        return np.concatenate([part.T @ matrix for part, matrix in zip(parts, self.matrices, strict=True)])


NO_BLOCKS = np.empty((0, 0, 0))


class _Factored(LinearModel):
    """A linear model in compiled code, by QR factorizations of [J r] and, for each λ, of [R; √λ D]."""

    def __init__(
        self,
        x: np.ndarray,
        r: np.ndarray,
        J: np.ndarray | Blocks,
        scale: np.ndarray,
        residuals: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self.x, self.r, self.residuals = x, np.ascontiguousarray(r), residuals
        self.J = J if isinstance(J, Blocks) else Blocks(np.ascontiguousarray(J.T), NO_BLOCKS)
        self._R, self.scale = factored(self.J.columns, self.J.matrices, self.r, scale)
        self.D = np.where(self.scale > 0, self.scale, 1.0)

    def trial(self, damping: float) -> tuple[np.ndarray, float]:
        triangle, step, decrease = damped(self._R, self.D, damping)
        probed = self.residuals(self.x + PROBE * step)
        given = self.J.columns, self.J.matrices, self.r, probed, PROBE, step, triangle, self.D, CURVED
        return self.x + step + geodesic_acceleration(*given), decrease


class Problem:
    """Residuals of parameters θ whose sum of squares is to be small."""

    compiled = False

    def residuals(self, theta: np.ndarray, check: Check = lambda: None) -> np.ndarray:
        """(m,); `check` is called within, and may raise."""
        raise NotImplementedError

    def linearized(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray]:
        """The residuals and their Jacobian, (m, f)."""
        raise NotImplementedError

    def model(self, theta: np.ndarray, check: Check = lambda: None) -> tuple[np.ndarray, np.ndarray | Blocks]:
        """The same, the Jacobian in blocks where these are smaller."""
        return self.linearized(theta, check)

    def own(self) -> Problem:
        """The same for one thread alone; one that changes nothing is that already."""
        return self

    def minimize(self, theta: np.ndarray, iterations: int, deadline: Deadline, thorough: bool = False) -> Minimum:
        """Least squares from θ, evaluated even past the deadline; a thorough one goes on where little is gained."""
        at_start = self.residuals(theta)
        return levenberg_marquardt(
            lambda x: at_start if x is theta else self.residuals(x, deadline.check),
            lambda x: self.model(x, deadline.check),
            theta,
            iterations=iterations,
            patience=20 if thorough else 10,
            gain=1e-3 if thorough else 1e-2,
            stop=deadline.over,
        )


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


def check_parameters(flow: FlowMap, keeps: str) -> None:
    """Raise ValueError where a flow has too many parameters for a dense matrix."""
    if flow.n_parameters > MAX_PARAMETERS:
        raise ValueError(
            f"`optimizer` {keeps} and takes at most {MAX_PARAMETERS} parameters; the flow has {flow.n_parameters}: use "
            "'lbfgs' or 'adam'."
        )


class GaussNewtonSteps:
    """Levenberg–Marquardt on the residuals of a flow, one accepted step at a time; it trains networks best.

    To r belongs a tiny multiple of the weights: a neuron that is saturated at all points may else run off to a step of
    any slope. The steps end where `PATIENCE` of them on the same points lower the loss by less than 1 %, or none does.
    """

    needs_residuals: ClassVar[bool] = True

    def __init__(self, flow: FlowMap) -> None:
        check_parameters(flow, "'gauss-newton' keeps a dense Jacobian")
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
            raise ValueError(f"`state` has a scale of shape {tuple(scale.shape)}, not {(n,)}: start a new run.")
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

        def cost_at(x: Tensor, attempt: int) -> float:
            return float(residuals(x).square().sum()) + PULL * float(x @ x)

        model = _Normal(x, r, J, self.scale, residuals)
        self.scale = model.scale
        found = damped_step(model, cost_at, cost, self.damping, TRIES)
        if found is None:
            put_weights(self.parameters, x)
            self.damping = Damping(FIRST_DAMPING, LEAST_DAMPING_OF_WEIGHTS)
            self.finished = "no step lowers the loss"
            return loss
        self.costs = [*self.costs[-PATIENCE:], found[1]]
        if converged(self.costs, PATIENCE, GAIN):
            self.finished = "it has converged"
        return loss


class _Normal(LinearModel):
    """A linear model in torch by Cholesky's factors of JᵀJ + λD²; where λ is small, by one QR factorization of J."""

    def __init__(
        self, x: Tensor, r: Tensor, J: Tensor, scale: Tensor | None, residuals: Callable[[Tensor], Tensor]
    ) -> None:
        self.x, self.r, self.J, self.residuals = x, r, J, residuals
        self._G, self._g = gram(J), J.T @ r + PULL * x
        self._G.diagonal().add_(PULL)
        squares = self._G.diagonal()
        self.scale = squares.clone() if scale is None else torch.maximum(scale, squares)
        self.D = torch.where(self.scale > 0, self.scale, 1.0).sqrt()
        self._in_units = self._G / self.D / self.D[:, None]
        self._triangle: Tensor | None = None

    def trial(self, damping: float) -> tuple[Tensor, float]:
        R = self._triangle_of(damping)

        def solved(w: Tensor) -> Tensor:
            """(JᵀJ + λD²)⁻¹ w."""
            return torch.cholesky_solve((w / self.D)[:, None], R, upper=True)[:, 0] / self.D

        step = -solved(self._g)
        decrease = -float(step @ (self._G @ step + 2 * self._g))
        curvature = (self.residuals(self.x + PROBE * step) - self.r - PROBE * (self.J @ step)) / PROBE**2
        acceleration = -solved(self.J.T @ curvature)
        norms = (torch.linalg.vector_norm(self.D * v) for v in (acceleration, step))
        small = 2 * next(norms) <= CURVED * next(norms)  # NaN is not small
        return self.x + (step + acceleration if small else step), decrease

    def _triangle_of(self, damping: float) -> Tensor:
        """R of JᵀJ + λD² in units of D."""
        if damping > WELL_CONDITIONED:
            shifted = self._in_units.clone()
            shifted.diagonal().add_(damping)
            R, failed = torch.linalg.cholesky_ex(shifted, upper=True)
            if not failed:
                return R
        if self._triangle is None:
            self._triangle = torch.linalg.qr(self.J, mode="r")[1] / self.D
        below = (damping + PULL / self.D**2).sqrt().diag()
        return torch.linalg.qr(torch.cat([self._triangle, below]), mode="r")[1]


def gram(J: Tensor) -> Tensor:
    """JᵀJ, by half of the products where the numbers are on the CPU."""
    if J.device.type != "cpu":
        return J.T @ J
    columns, transposed = (J.T, 0) if J.is_contiguous() else (J, 1)
    upper = torch.from_numpy(dsyrk(1.0, columns.numpy(), trans=transposed))
    return upper.triu() + upper.triu(1).T
