"""The two losses of the paper, in units in which every well-posed problem looks alike; and a third, of labels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from sympflow.flow.flow_map import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.network_tangents import NetworkTangents
from sympflow.training.points import Points

Terms = tuple[Tensor | None, Tensor | None, Tensor | None]


@dataclass(frozen=True)
class Loss:
    """L = w_1 L1 + w_2 L2 + w_3 L3 [1]_; the first two need no data, and one of weight 0 is not evaluated.

    L1 = mean ‖d/dt ψ̄_t(x) − J∇H(ψ̄_t(x))‖², the residual of the flow; L2 = mean (𝓗(ψ̄)(t, x) − H(x))², Hamiltonian
    matching, less its mean over x at each t, as 𝓗 is defined up to a function of t; L3 = mean ‖ψ̄_t(x) − φ_H,t(x)‖² at
    labelled points. All are divided by the units of the scaling: x by its spread over Ω, t by Δt, H by action / Δt.
    Of a driven system x is a state at t0, and the field and H are those at t0 + t.

    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, Hamiltonian matching for symplectic
       neural integrators, 2024, section 2.3.
    """

    system: HamiltonianSystem
    scaling: Scaling
    residual_weight: float = 1.0
    matching_weight: float = 1.0
    label_weight: float = 0.0

    def __post_init__(self) -> None:
        if self.matching_weight:
            self.system.check_conservative(
                "and a damped flow is not Hamiltonian, so there is nothing to match",
                "pass matching_weight=0, or fit by the labels",
            )

    def residual(self, flow: FlowMap, t: Tensor, x: Tensor, *t0: Tensor) -> Tensor:
        """(d/dt ψ̄_t(x) − J∇H(ψ̄_t(x))) Δt/s: (..., 2d)."""
        y, velocity = flow.psi_and_velocity(t, x, *t0)
        unit = torch.tensor(self.scaling.x, dtype=y.dtype, device=y.device) / self.scaling.t
        return (velocity - self.system.vector_field(y, *_later(t, y, *t0))) / unit

    def mismatch(self, flow: SympFlow, t: Tensor, x: Tensor, *t0: Tensor) -> Tensor:
        """(𝓗(ψ̄)(t, x) − H(x)) Δt/action, not yet less c(t): (...)."""
        H = flow.hamiltonian_unchecked(t, x, *t0)
        return (H - self.system.hamiltonian(x, *_later(t, x, *t0))) * (self.scaling.t / self.scaling.action)

    def label_error(self, flow: FlowMap, t: Tensor, x: Tensor, y: Tensor, *t0: Tensor) -> Tensor:
        """(ψ̄_t(x) − y)/s: (..., 2d)."""
        unit = torch.tensor(self.scaling.x, dtype=y.dtype, device=y.device)
        return (flow.psi(t, x, *t0) - y) / unit

    def terms(self, flow: FlowMap, points: Points) -> Terms:
        """L1, L2 and L3, None where the weight is 0."""
        L1 = L2 = L3 = None
        if self.residual_weight:
            L1 = self.residual(flow, *points.residual).square().sum(-1).mean()
        if self.matching_weight:
            assert isinstance(flow, SympFlow)  # train refuses a matching weight for any other
            L2 = _less_mean(self.mismatch(flow, *points.matching)).square().mean()
        if self.label_weight:
            assert points.labels is not None
            L3 = self.label_error(flow, *points.labels).square().sum(-1).mean()
        return L1, L2, L3

    def total(self, terms: Terms) -> Tensor:
        """w_1 L1 + w_2 L2 + w_3 L3."""
        weights = (self.residual_weight, self.matching_weight, self.label_weight)
        weighted = [w * L for w, L in zip(weights, terms, strict=True) if L is not None]
        return weighted[0] if len(weighted) == 1 else torch.stack(weighted).sum()

    def __call__(self, flow: FlowMap, points: Points) -> Tensor:
        """L at the points."""
        return self.total(self.terms(flow, points))


def _later(t: Tensor, x: Tensor, *t0: Tensor) -> list[Tensor]:
    """t0 + t of states x, nothing of a system that is not driven."""
    return [(start + t).expand(x.shape[:-1]) for start in t0]


def never() -> None:
    """The check that ends nothing."""


@dataclass(frozen=True)
class Objective:
    """A loss of a flow at given points, as a number, or as the residuals whose sum of squares it is."""

    loss: Loss
    flow: FlowMap
    points: Points
    draw: int = 0
    check: Callable[[], None] = never
    tangents: NetworkTangents | None = None

    def __call__(self) -> Tensor:
        self.check()
        return self.loss(self.flow, self.points)

    @torch.no_grad()
    def residuals(self) -> Tensor:
        """The residuals (m,)."""
        self.check()
        return torch.cat([block.residuals() for block in self._blocks()])

    def linearized(self) -> tuple[Tensor, Tensor]:
        """The residuals (m,) and their Jacobian (m, n) by the parameters, which the next call may overwrite."""
        rows = [block.linearized(self.check) for block in self._blocks()]
        if len(rows) == 1:
            return rows[0]
        return torch.cat([r for r, _ in rows]), torch.cat([J for _, J in rows])

    def _blocks(self) -> list[_Block | _Compiled]:
        """The losses that count."""
        loss, points, flow, tangents = self.loss, self.points, self.flow, self.tangents
        blocks: list[_Block | _Compiled] = []
        if loss.residual_weight and tangents is not None:
            blocks.append(_CompiledResidual(loss.residual_weight, loss, flow, tangents, *points.residual))
        elif loss.residual_weight:
            blocks.append(_Block(loss.residual_weight, flow, loss.residual, points.residual))
        if loss.matching_weight:
            t, x, *t0 = points.matching
            t, *t0 = (s.expand(x.shape[:2]).reshape(-1) for s in (t, *t0))
            matched = (t, x.flatten(0, 1), *t0)
            blocks.append(_Block(loss.matching_weight, flow, loss.mismatch, matched, x.shape[:2]))
        if loss.label_weight:
            assert points.labels is not None
            t, x, y, *t0 = points.labels
            if tangents is not None:
                blocks.append(_CompiledLabels(loss.label_weight, loss, flow, tangents, t, x, *t0, ends=y))
            else:
                blocks.append(_Block(loss.label_weight, flow, loss.label_error, points.labels))
        return blocks


@dataclass(frozen=True)
class _Block:
    """A loss that counts, its points one a row; with `times`, their shape, values at each time are less their mean."""

    weight: float
    flow: FlowMap
    function: Callable[..., Tensor]
    points: tuple[Tensor, ...]
    times: torch.Size | None = None

    def residuals(self) -> Tensor:
        """The residuals (m,)."""
        return self._reduced(self.function(self.flow, *self.points))

    def linearized(self, check: Callable[[], None]) -> tuple[Tensor, Tensor]:
        """The residuals (m,) and their Jacobian (m, n)."""
        r, J = jacobian(self.flow, self.function, self.points, check)
        return self._reduced(r), self._reduced(J.movedim(-1, 0), 1).T

    def _reduced(self, values: Tensor, leading: int = 0) -> Tensor:
        """(..., N, ...) after `leading` axes as (..., m), so weighted that the sum of squares is the loss."""
        weight = (self.weight / values.shape[leading]) ** 0.5
        if self.times is not None:
            values = _less_mean(values.unflatten(leading, self.times))
        return weight * values.flatten(leading)


class _Compiled(ABC):
    """A loss of a flow of networks by compiled loops, one point a row; errors are in units of x over `unit`."""

    by_velocity: ClassVar[bool]
    """True if d/dt ψ̄_t(x) counts."""

    def __init__(
        self,
        weight: float,
        unit: float,
        loss: Loss,
        flow: FlowMap,
        tangents: NetworkTangents,
        t: Tensor,
        x: Tensor,
        *t0: Tensor,
    ) -> None:
        assert isinstance(flow, SympFlow)  # others have no tangents
        self.system, self.tangents, self.t, self.t0 = loss.system, tangents, t, t0
        self.weights = (weight / len(t)) ** 0.5 * unit / np.array(loss.scaling.x)
        self._parameters = torch.cat([w.detach().reshape(-1) for w in flow.parameters()]).numpy()
        arrays = t, x, flow.step_constants(x, *t0)
        self._points = tuple(np.ascontiguousarray(a.detach().numpy()) for a in arrays)

    def residuals(self) -> Tensor:
        """The residuals (m,), all points of a coordinate after those of the one before."""
        return self._weighted(self._errors(*self._values()))

    def linearized(self, check: Callable[[], None]) -> tuple[Tensor, Tensor]:
        """The residuals (m,) and their Jacobian (m, n), which the next call for as many points overwrites."""
        check()
        y, velocity = self._values()
        J = self.tangents.jacobian(self._parameters, *self._points, *self._factors(y))
        return self._weighted(self._errors(y, velocity)), torch.from_numpy(J.reshape(len(J), -1)).T

    def _values(self) -> tuple[np.ndarray, np.ndarray]:
        """ψ̄_t(x), and d/dt ψ̄_t(x) where it counts."""
        t, x, constants = self._points
        return self.tangents.values(self._parameters, t, x, constants, self.by_velocity)

    def _weighted(self, errors: np.ndarray) -> Tensor:
        return torch.from_numpy((errors * self.weights).T.reshape(-1))

    @abstractmethod
    def _errors(self, y: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """The errors (N, 2d) of y = ψ̄_t(x) and its velocity d/dt ψ̄_t(x)."""

    @abstractmethod
    def _factors(self, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """The derivatives of the residuals by y (N, 2d, 2d), and by the velocity (2d,) if it counts."""


class _CompiledResidual(_Compiled):
    """d/dt ψ̄_t(x) − J∇H(ψ̄_t(x))."""

    by_velocity = True

    def __init__(self, weight: float, loss: Loss, *given: Any) -> None:
        super().__init__(weight, loss.scaling.t, loss, *given)

    def _errors(self, y: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return velocity - self._field("vector_field", y)

    def _factors(self, y: np.ndarray) -> tuple[np.ndarray, ...]:
        return np.ascontiguousarray(-self._field("field_jacobian", y) * self.weights[:, None]), self.weights

    def _field(self, name: str, y: np.ndarray) -> np.ndarray:
        """The vector field or its Jacobian at the ends, as torch has it, which any H can do."""
        states = torch.from_numpy(y)
        return getattr(self.system, name)(states, *_later(self.t, states, *self.t0)).detach().numpy()


class _CompiledLabels(_Compiled):
    """ψ̄_t(x) − y of labels y."""

    by_velocity = False

    def __init__(self, weight: float, loss: Loss, *given: Any, ends: Tensor) -> None:
        super().__init__(weight, 1.0, loss, *given)
        self.ends = ends.detach().numpy()

    def _errors(self, y: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return y - self.ends

    def _factors(self, y: np.ndarray) -> tuple[np.ndarray, ...]:
        return (np.repeat(np.diag(self.weights)[None], len(y), 0),)


class _Evaluation(nn.Module):
    """`function(flow, *arguments)` as a module, whose parameters may be replaced."""

    def __init__(self, flow: FlowMap, function: Callable[..., Tensor]) -> None:
        super().__init__()
        self.flow, self.function = flow, function

    def forward(self, *arguments: Tensor) -> Tensor:
        return self.function(self.flow, *arguments)


AT_ONCE = 2**24  # numbers of a Jacobian that are made at once: 128 MiB


def jacobian(
    flow: FlowMap,
    function: Callable[..., Tensor],
    arguments: tuple[Tensor, ...],
    check: Callable[[], None] = lambda: None,
) -> tuple[Tensor, Tensor]:
    """function(flow, *arguments) of N points, (N, ...), and its derivatives by the n parameters, (N, ..., n)."""
    evaluation = _Evaluation(flow, function)
    parameters = {name: w.detach() for name, w in evaluation.named_parameters()}

    def value(parameters: dict[str, Tensor], *point: Tensor) -> tuple[Tensor, Tensor]:
        result = torch.func.functional_call(evaluation, parameters, point)
        return result, result

    each = (None, *(0 for _ in arguments))
    outputs = torch.func.vmap(value, each)(parameters, *arguments)[0][0].numel()
    derivative = torch.func.jacrev if outputs <= flow.n_parameters else torch.func.jacfwd
    differentiated = torch.func.vmap(derivative(value, has_aux=True), each)
    blocks = []
    for points in zip(*(a.split(max(1, AT_ONCE // (outputs * flow.n_parameters))) for a in arguments), strict=True):
        check()
        J, values = differentiated(parameters, *points)
        blocks.append((values, torch.cat([J[name].flatten(values.ndim) for name in parameters], -1)))
    return blocks[0] if len(blocks) == 1 else tuple(torch.cat(parts) for parts in zip(*blocks, strict=True))  # type: ignore[return-value]


def _less_mean(values: Tensor) -> Tensor:
    return values - values.mean(-1, keepdim=True)
