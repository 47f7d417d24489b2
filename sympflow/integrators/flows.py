"""Trained flows as integrators: what the methods "sympflow" and "mlp" have in common."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
import torch

from sympflow.arrays import Array, is_tensor
from sympflow.domain_exit import check_start
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.array_rollout import rollout
from sympflow.integrators.base import FixedStep, Outcome, Problem

if TYPE_CHECKING:
    from sympflow.flow.mlp import MLPFlow
    from sympflow.flow.primed import PrimedFlow
    from sympflow.flow.sympflow import SympFlow
    from sympflow.kernels.mlp_flow import MLPFlowKernel
    from sympflow.kernels.primed_flow import PrimedFlowKernel

T = TypeVar("T")

_KNOWN: dict[tuple[Any, ...], Any] = {}


def known(key: tuple[Any, ...], make: Callable[[], T]) -> T:
    """What `make` gives, made once in a process for each key: flows that ship are read from their files once."""
    if key not in _KNOWN:
        _KNOWN[key] = make()
    return _KNOWN[key]


@dataclass(frozen=True)
class FlowIntegrator(FixedStep):
    """A trained flow ψ̄ on the grid t0 + k·Δt: ψ_t = ψ̄_{t−kΔt} ∘ (ψ̄_Δt)^k, and its exact inverse for t < t0.

    Parameters
    ----------
    dt : float, optional
        Step length, at most the flow's Δt, which is the default. A smaller one composes ψ̄_dt, which is another map.
    flow : SympFlow, MLPFlow or str, optional
        A flow, or the name of one that ships. The default is the one shipped for the system.
    """

    flow: Any = field(default=None, repr=False)

    order: ClassVar[int | None] = None
    trained: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    prepared: ClassVar[tuple[Any, Any] | None] = None
    """Of a copy that makes one run: the flow for its states, with the numbers that it has now, and its kernel."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.flow is None:
            return
        if isinstance(self.flow, str):
            object.__setattr__(self, "flow", _named(self.flow))
        if getattr(self.flow, "kind", None) != self.name:
            raise TypeError(
                f"`flow` must be a trained flow of kind {self.name!r}; got {type(self.flow).__name__}. Load one with "
                "sympflow.load or train one with sympflow.train."
            )
        self._check_dt(self.flow)

    def _check_dt(self, flow: Any) -> None:
        if self.dt is not None and self.dt > flow.dt * (1 + 1e-12):
            raise ValueError(
                f"`dt` must be at most the flow's Δt = {flow.dt:g}, beyond which ψ̄ was not trained; got {self.dt:g}."
            )

    def flow_for(self, system: HamiltonianSystem) -> SympFlow | MLPFlow:
        """The flow that is used for a system: the one given, else the one shipped."""
        if self.flow is not None:
            return self.flow.bound(system)
        name, tolerance = self.name, self._tolerance
        return known((name, system.fingerprint, tolerance), lambda: _shipped(system, name, tolerance))

    @property
    def _tolerance(self) -> float | None:
        """The energy error by which the shipped flow is chosen, where there is a choice."""
        return getattr(self, "tol", None)

    def check(self, system: HamiltonianSystem) -> None:
        if self.flow is not None:
            self.flow.check_system(system)
        self._check_dt(self.flow_for(system))

    def step_length(self, system: HamiltonianSystem) -> float:
        return float(self.dt if self.dt is not None else self.flow_for(system).dt)

    def _flow_like(self, system: HamiltonianSystem, y: Array) -> Any:
        """The flow for states such as y: a shipped one in their dtype and on their device, a given one as it is.

        Raises
        ------
        TypeError, ValueError
            If the given flow has another dtype or device.
        """
        flow = self.flow_for(system)
        if not is_tensor(y) and y.dtype == np.float64 and flow.dtype == torch.float64 and flow.device.type == "cpu":
            return flow
        tensor = y if is_tensor(y) else torch.from_numpy(np.empty(0, y.dtype))
        if tensor.dtype == flow.dtype and tensor.device == flow.device:
            return flow
        if self.flow is None:
            dtype, device = tensor.dtype, tensor.device
            key = (self.name, system.fingerprint, self._tolerance, dtype, device)
            return known(key, lambda: copy.deepcopy(flow).to(dtype=dtype, device=device))
        if tensor.dtype != flow.dtype:
            raise TypeError(
                f"`y0` is {tensor.dtype}, but the flow's weights are {flow.dtype}: pass flow.to({tensor.dtype}), or "
                f"states in {flow.dtype}."
            )
        raise ValueError(f"`y0` is on {tensor.device}, but the flow is on {flow.device}: move one of them.")

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.substep(system, y, h, "auto")

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("prepared", "saves_finite")}

    def substep(self, system: HamiltonianSystem, y: Array, h: Any, backend: str) -> Array:
        if self.prepared is not None and backend == "compiled":
            flow, kernel = self.prepared
        else:
            flow = self._flow_like(system, y)
            kernel = kernel_of(system, flow, y, "array" if backend == "torch" else backend)
        if kernel is None:
            return _apply(flow, y, h)
        if y.ndim == 2 and np.shape(h) == (len(y),):
            return kernel.step(h, y)
        rows = np.ascontiguousarray(y).reshape(-1, y.shape[-1])
        lengths = np.broadcast_to(h, y.shape[:-1]).reshape(-1)
        return kernel.step(lengths, rows).reshape(y.shape)

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return _apply(self._flow_like(system, y).inverse, y, h)

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        self.flow_for(system)  # files cannot be read inside a function transform
        return super().tangent(system, t, y, h)

    def run(self, problem: Problem) -> Outcome:
        flow, kernel = prepared = self._flow_and_kernel(problem)
        chosen = object.__new__(type(self))  # with this flow from here on; the fields have been checked
        finite = getattr(kernel, "saves_finite", False)
        vars(chosen).update(vars(self), flow=flow, prepared=prepared, saves_finite=finite)
        if self._tolerance is not None:
            check_start(flow, problem.system, problem.y0, kernel is not None)
            vars(chosen).update(tol=None)
        return super(FlowIntegrator, chosen).run(problem)

    def _flow_and_kernel(self, problem: Problem) -> tuple[Any, Any]:
        """The flow for the states of the problem, and its compiled loops or None."""
        system, y0 = problem.system, problem.y0
        flow = self.flow_for(system)
        if type(y0) is np.ndarray and y0.dtype == np.float64:  # a kernel says itself what flow it is for
            kernel = kernel_of(system, flow, y0, problem.backend)
            if kernel is not None:
                return flow, kernel
        flow = self._flow_like(system, y0)
        return flow, kernel_of(system, flow, y0, problem.backend)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        if self.prepared is not None and hasattr(self.prepared[1], "evaluations"):
            return self.prepared[1].evaluations(n_steps, n_saved, n_extra, backend)
        if not hasattr(self.flow, "evaluations"):  # an MLP flow evaluates no forces
            return super().evaluations(n_steps, n_saved, n_extra, backend)
        return self.flow.evaluations(n_steps, n_saved, n_extra, backend)

    def rollout(self, problem: Problem, h: float, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, str]:
        y0 = problem.y0
        flow, kernel = self._flow_and_kernel(problem) if self.prepared is None else self.prepared
        if kernel is not None:
            if y0.ndim == 1:
                states, last = kernel.run(h, y0, n_steps, save)
                return states, np.asarray(last), "compiled"
            rows = y0.reshape(-1, y0.shape[-1])
            states, finite = kernel.run_batch(h, rows, n_steps, save)
            states = states.swapaxes(0, 1).reshape(len(save), *y0.shape)
            return states, np.asarray(finite).reshape(y0.shape[:-1]), "compiled"
        if isinstance(y0, torch.Tensor) and hasattr(flow, "processor") and flow.processor:
            return *_processed_rollout(flow, h, y0, n_steps, save), "torch"
        if is_tensor(y0):
            return super().rollout(problem, h, n_steps, save)
        with torch.no_grad():
            tensors = Problem(problem.system, problem.t0, problem.t1, torch.from_numpy(np.ascontiguousarray(y0)))
            states, finite, _ = self.rollout(tensors, h, n_steps, save)
        return states.numpy(), finite, "torch"


def _named(name: str) -> Any:
    """The flow that ships under a name."""
    from sympflow.flow.shipped import named

    return known((name,), lambda: named(name).load())


def _shipped(system: HamiltonianSystem, kind: str, tol: float | None) -> Any:
    from sympflow.flow.io import shipped

    return shipped(system, kind, tol)


def _processed_rollout(
    flow: PrimedFlow, h: float, y0: torch.Tensor, n_steps: int, save: np.ndarray
) -> tuple[torch.Tensor, np.ndarray]:
    """A run of ψ̄ = χ ∘ K ∘ χ⁻¹ in which the χ between two steps cancel."""
    t = abs(h)
    states, finite = rollout(lambda k, y: flow.kernel_step(t, y, h < 0), flow.prepare(t, y0), n_steps, save)
    states = flow.finish(t, states)
    start = int(np.count_nonzero(save == 0))  # `save` is sorted
    return torch.cat([y0.expand(start, *y0.shape), states[start:]]), finite


def _apply(function: Any, y: Array, h: float | Array) -> Array:
    """function(h, y) of tensors, for tensors or arrays."""
    if is_tensor(y):
        return function(h, y)
    with torch.no_grad():
        length = torch.from_numpy(np.array(h)) if np.ndim(h) else float(h)
        return function(length, torch.from_numpy(np.ascontiguousarray(y))).numpy()


def kernel_of(system: HamiltonianSystem, flow: Any, y: Array, backend: str) -> MLPFlowKernel | PrimedFlowKernel | None:
    """The compiled loops of the flow, or None where the call needs, or asks for, array operations."""
    if backend == "array":
        return None
    try:
        if is_tensor(y):
            raise ValueError("`y0` is a tensor: pass a NumPy array, or use backend='array'.")
        if flow.kind != "sympflow":
            raise ValueError("`method` 'mlp' has no compiled form: use backend='array'.")
        if hasattr(flow, "kernel_for"):
            return flow.kernel_for(system)
        from sympflow.kernels.mlp_flow import mlp_flow_kernel

        return mlp_flow_kernel(flow)
    except ValueError as reason:
        if backend == "compiled":
            raise ValueError(f"`backend` 'compiled' does not apply. {reason}") from None
        return None
