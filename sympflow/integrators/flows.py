"""Trained flows as integrators: the methods "sympflow" and "mlp", and flows in another time."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, as_tensor, is_tensor, learnable, to_numpy, untransformed
from sympflow.flow.known import UNCOMPENSATED, KnownFlow
from sympflow.flow.shipped import check_tol, choose, forces_saved, named, shipped_flows
from sympflow.hamiltonian.fingerprint import Identity
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import checked_shift
from sympflow.integrators.base import FixedStep
from sympflow.integrators.clocks import (
    ARRAYS_ONLY,
    LogarithmicClock,
    physical_length,
    scale_of,
    step_of_length,
    transformed_system,
)
from sympflow.integrators.contract import Failure, Integrator, Outcome, Problem, Steps
from sympflow.integrators.domain_exit import check_start
from sympflow.integrators.grid_runs import grid_run
from sympflow.integrators.loops import compiled_loops, with_loops
from sympflow.integrators.registry import is_flow
from sympflow.integrators.steppers import ArraySteps, Stepper, rollout
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.lazy import kept

if TYPE_CHECKING:  # and torch, which compiled runs of flows that ship do without
    from sympflow.flow.flow_map import FlowMap

T = TypeVar("T")
SEARCH, SEARCH_OF_EACH = 60_000, 2_000
"""Forces that take as long as what a run in another time needs besides, and each trajectory in a batch."""
AT_A_TIME, AT_A_TIME_OF_EACH = 100, 600
"""Forces that take as long as finding the state of one trajectory, or of each in a batch, at a physical time."""
_KNOWN: dict[tuple[Any, ...], Any] = {}


def known(key: tuple[Any, ...], make: Callable[[], T]) -> T:
    """Return the result of `make`, made once in a process for each key: files that ship are read once."""
    if key not in _KNOWN:
        inside = nullcontext() if "torch" not in sys.modules else untransformed()
        with inside:  # what is kept must not be a tensor of a transform that ends
            _KNOWN[key] = make()
    return _KNOWN[key]


@kept
def kind_of(system: HamiltonianSystem) -> tuple[Any, ...]:
    """The formula, and flows that are kept together for all systems with it."""
    return system.fingerprint, system.definition.text, tuple(f.name for f in shipped_flows(system))


@kept
def _shipped(system: HamiltonianSystem, name: str, tolerance: float | None) -> KnownFlow:
    """The flow of a kind that ships for a system."""
    return known((name, kind_of(system), tolerance), lambda: choose(system, name, tolerance).known(system))


def checked_flow(flow: Any, kind: str, what: str) -> Any:
    """The flow that was given, or the one that ships under that name; a TypeError for anything else."""
    if isinstance(flow, str):
        name = flow
        flow = known((name,), lambda: named(name).load())
    if flow is not None and not (is_flow(flow) and flow.kind == kind):
        raise TypeError(
            f"`flow` must be {what}; got {type(flow).__name__}. Load one with sympflow.load or train one with "
            "sympflow.train."
        )
    return flow


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
    tol: ClassVar[float | None] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "flow", checked_flow(self.flow, self.name, f"a trained flow of kind {self.name!r}"))
        if self.flow is not None:
            self._check_dt(self.flow)

    def _check_dt(self, flow: KnownFlow) -> None:
        if self.dt is not None and self.dt > flow.dt * (1 + 1e-12):
            raise ValueError(
                f"`dt` must be at most the flow's Δt = {flow.dt:g}, beyond which ψ̄ was not trained; got {self.dt:g}."
            )

    @property
    def given_flow(self) -> FlowMap | None:
        return self.flow

    def flow_for(self, system: HamiltonianSystem) -> FlowMap:
        """Return the flow that is used for a system: the one given, else the one shipped."""
        return self.known_flow(system).thawed

    def known_flow(self, system: HamiltonianSystem) -> KnownFlow:
        return _shipped(system, self.name, self.tol) if self.flow is None else self.flow.bound(system)

    def on_extended(self, system: HamiltonianSystem, extended: HamiltonianSystem) -> FlowIntegrator | None:
        flow = self.flow_for(system).on_extended(extended)
        return None if flow is None else type(self)(flow=flow, dt=self.dt)

    def check(self, system: HamiltonianSystem) -> None:
        if self.flow is not None:
            self.flow.check_system(system)
        flow = self.known_flow(system)
        self._check_dt(flow)
        if self.dt is not None:
            flow.warn_of_times(self.dt)

    def step_length(self, system: HamiltonianSystem) -> float:
        return float(self.dt if self.dt is not None else self.known_flow(system).dt)

    def flow_like(self, system: HamiltonianSystem, y: Array) -> FlowMap:
        """Return the flow for states such as y: a shipped one in their dtype and on their device."""
        import torch

        flow = self.flow_for(system)
        if y.dtype == np.float64 and flow.dtype == torch.float64 and flow.device.type == "cpu":
            return flow
        tensor = as_tensor(y[..., :0])
        if tensor.dtype == flow.dtype and tensor.device == flow.device:
            return flow
        if self.flow is None:
            dtype, device = tensor.dtype, tensor.device
            key = (self.name, kind_of(system), self.tol, dtype, device)
            return known(key, lambda: copy.deepcopy(flow).to(dtype=dtype, device=device))
        if tensor.dtype != flow.dtype:
            raise TypeError(
                f"`y0` is {tensor.dtype}, but the flow's weights are {flow.dtype}: pass flow.to({tensor.dtype}), or "
                f"states in {flow.dtype}."
            )
        raise ValueError(f"`y0` is on {tensor.device}, but the flow is on {flow.device}: move one of them.")

    def kernel(self, flow: KnownFlow, problem: Problem) -> Any:
        """The compiled loops of the flow, or None where the call needs array operations or `backend` chooses them."""
        system = None
        if str(problem.y0.dtype) == "torch.float64":  # for float32 there is another flow
            system = None if learnable(*cast(Any, flow).parameters()) else problem.system
        return compiled_loops(lambda: flow.kernel_for(problem.system), problem.y0, problem.backend, system=system)

    def own_stepper(self, problem: Problem) -> Stepper:
        flow = self.known_flow(problem.system)
        flow.warn_of_drive(problem.t0, problem.t1 - problem.t0)
        if type(problem.y0) is np.ndarray and problem.y0.dtype == np.float64:  # a kernel tells the flow's own dtype
            kernel = self.kernel(flow, problem)
            if kernel is not None:
                return with_loops(self, problem, FlowSteps(flow, True), kernel)
        flow = self.flow_like(problem.system, problem.y0)
        kernel = self.kernel(flow, problem)
        return with_loops(self, problem, FlowSteps(flow, kernel is not None), kernel)

    def run(self, problem: Problem) -> Outcome:
        run = grid_run(self, problem)
        if self.tol is not None:
            check_start(self.known_flow(problem.system), problem.system, problem.y0, run.stepper.compiled)
        return run.outcome()

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.own_stepper(Problem(system, t, t, y)).shorter(y, h, t)

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return _apply(self.flow_like(system, y).inverse, y, h, t)

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        flow, x = self.flow_for(system), to_numpy(y)  # files cannot be read inside a function transform
        kernel = compiled_loops(lambda: flow.kernel_for(system), x, "auto") if x.size else None
        if kernel is not None:
            lengths = np.broadcast_to(h, x.shape[:-1]).astype(float).ravel()
            found = kernel.tangents(lengths, np.ascontiguousarray(x.reshape(-1, x.shape[-1])))
            if found is not None:
                return found[0].reshape(x.shape), found[1].reshape(*x.shape, x.shape[-1])
        return super().tangent(system, t, y, h)


class FlowSteps(ArraySteps):
    """Steps of a flow by tensor operations: of ψ̄ = χ ∘ K ∘ χ⁻¹ the χ between two steps cancel."""

    def __init__(self, flow: KnownFlow, compiled: bool) -> None:
        self.flow: Any = flow
        self.stages = flow.iterated if compiled else 0
        self.backend = "compiled" if compiled else "torch"

    def rollout(
        self, y0: Array, h: float, n_steps: int, save: np.ndarray, t0: float = 0.0, carry: RunCheckpoint | None = None
    ) -> tuple[Array, np.ndarray]:
        import torch

        if not is_tensor(y0):
            if carry is not None and carry.running is not None:
                carry.running = as_tensor(carry.running)
            with torch.no_grad():
                states, finite = self.rollout(as_tensor(y0), h, n_steps, save, t0, carry)
            return to_numpy(states), finite
        flow, t = self.flow, abs(h)
        if not flow.symplectic:  # without an inverse: the call says so where h < 0
            return rollout(lambda k, y: flow(h, y), y0, n_steps, save, carry=carry)
        start_state = flow.prepare(t, flow.lift(y0, t0))

        def step(k: int, y: Array) -> Array:
            if flow.driven:
                y = flow.at_time(y, start_state[..., flow.ndof] + k * h)
            return flow.kernel_step(t, y, h < 0)

        states, finite = rollout(step, start_state, n_steps, save, carry=carry)
        states = flow.project(flow.finish(t, states))
        start = int(np.count_nonzero(save == 0))  # `save` is sorted
        return torch.cat([y0.expand(start, *y0.shape), states[start:]]), finite

    def step(self, y: Array, h: Any, t: Any = 0.0) -> Array:
        return _apply(self.flow, y, h, t)

    def check_lengths(self, h: Any) -> None:
        self.flow.warn_of_times(h)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return self.flow.evaluations(n_steps, n_saved, n_extra, backend)


def _apply(function: Any, y: Array, h: float | Array, t: Any) -> Array:
    """function(h, y, t) of tensors, for tensors or arrays."""
    if is_tensor(y):
        return function(h, y, t)
    import torch

    with torch.no_grad():
        length = torch.from_numpy(np.array(h)) if np.ndim(h) else float(h)
        return to_numpy(function(length, torch.from_numpy(np.ascontiguousarray(y)), t))


@dataclass(frozen=True)
class SympFlowIntegrator(FlowIntegrator):
    """A trained SympFlow: symplectic for every step length, with an exact inverse.

    Parameters
    ----------
    dt : float, optional
        Step length, at most the flow's Δt, which is the default. A smaller one composes ψ̄_dt, which is another map.
    flow : SympFlow or str, optional
        A flow, or the name of one that ships, as `sympflow.shipped_flows()` lists them. The default is, of those that
        ship for the system, the cheapest whose figure is at most 1e-6, or else the most accurate.
    tol : float, optional
        Take the cheapest shipped flow whose relative energy error up to T = 1000, the 95 % quantile over held-out
        states, is at most this; `sympflow.shipped_flows(system)` lists them, and a T that differs. Where y0 is outside
        the domain of that flow there is no such figure, which is a ValueError. It does not hold for a smaller `dt`.
    compensated : bool
        True to sum with Kahan's compensation, which slows the growth of round-off. Compiled primed flows only.

    References
    ----------
    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, "Hamiltonian matching for symplectic
       neural integrators" (2024).
    """

    tol: float | None = None  # type: ignore[misc]
    compensated: bool = False
    name: ClassVar[str] = "sympflow"
    source: ClassVar[str] = "A trained SympFlow: symplectic for every step length, with an exact inverse."
    symplectic: ClassVar[bool] = True
    takes_friction: ClassVar[bool] = True  # of the system that a flow was made for; it refuses every other
    takes_driving: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("compensated", self.compensated)
        if self.tol is None:
            return
        check_tol(self.tol)
        for name in ("flow", "dt"):
            if getattr(self, name) is not None:
                raise ValueError(f"`tol` chooses the flow and its Δt, but `{name}` is given: leave out one of them.")

    @property
    def in_another_time(self) -> bool:  # type: ignore[override]
        """True for a flow that was given and is one in another time."""
        return self.flow is not None and self.flow.origin is not None

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float, n_times: int = 0) -> FixedStep:
        """Return the integrator that runs: with `tol`, over a `length` that is worth it, a flow in another time."""
        if self.flow is not None:
            origin = self.flow.origin
            if origin is None or not origin.is_of(system):
                return self
            if self.compensated:
                raise ValueError("`compensated` sums are not for a flow in another time: leave it out.")
            return LogSympFlow(flow=self.flow, shift=origin.shift, dt=self.dt)
        if self.tol is None or self.compensated or y0.dtype != np.float64:
            return self
        name, tol = self.name, self.tol
        other = known(("in another time", name, kind_of(system), tol), lambda: _in_another_time(system, name, tol))
        if other is None:
            return self
        flow, shift, saved = other
        trajectories = y0.size // y0.shape[-1]
        of_each = SEARCH_OF_EACH + n_times * (AT_A_TIME if trajectories == 1 else AT_A_TIME_OF_EACH)
        if trajectories * length * saved < SEARCH + of_each * trajectories:
            return self
        check_start(flow, system, y0, False)
        return LogSympFlow(flow=flow, shift=shift)

    def kernel(self, flow: KnownFlow, problem: Problem) -> Any:
        if not self.compensated:
            return super().kernel(flow, problem)
        kernel = compiled_loops(lambda: flow.kernel_for(problem.system, True), problem.y0, problem.backend)
        if kernel is None:
            raise ValueError(UNCOMPENSATED)
        return kernel


def _in_another_time(system: HamiltonianSystem, kind: str, tol: float) -> tuple[FlowMap, float, float] | None:
    """The flow that meets `tol`, if it is one in another time: it, its shift, and the forces that it saves."""
    chosen = choose(system, kind, tol, transformed=True)
    if chosen.shift is None:
        return None
    return chosen.load(system), chosen.shift, forces_saved(chosen, system, tol)


@dataclass(frozen=True)
class MLPIntegrator(FlowIntegrator):
    """The paper's baseline: an unconstrained neural flow map. Not symplectic; no inverse, so no backward time.

    Parameters
    ----------
    dt : float, optional
        Step length, at most the flow's Δt, which is the default.
    flow : MLPFlow or str, optional
        A flow, or the name of one that ships. The default is the one shipped for the system.
    """

    name: ClassVar[str] = "mlp"
    source: ClassVar[str] = (
        "The paper's baseline: an unconstrained neural flow map. Not symplectic; no inverse, so no backward time."
    )
    symplectic: ClassVar[bool] = False

    inverse = Integrator.inverse

    def run(self, problem: Problem) -> Outcome:
        _check_forwards(problem.t0, problem.t1)
        return super().run(problem)

    def steps(self, system: HamiltonianSystem, t_span: tuple[float, float], y0: Array) -> Steps:
        _check_forwards(*t_span)
        return super().steps(system, t_span, y0)


def _check_forwards(t0: float, t1: float) -> None:
    """Raise a ValueError for a run backward in time."""
    if t1 < t0:
        raise ValueError(
            "`t_span` runs backwards, but method 'mlp' has no inverse: use a symplectic method for backward time."
        )


@dataclass(frozen=True)
class LogSympFlow(FixedStep):
    """A SympFlow trained on `sympflow.time_transformed(system)`, in the physical time.

    Parameters
    ----------
    dt : float, optional
        The physical length of a step where the kinetic energy is B = c − E, at the energy E of the system's y0, by the
        flow's own clock where it has one; the step in s that it means is at most the flow's Δ, which is the default.
    shift : float, optional
        c of the transformed system that the flow was trained on, which a flow that ships knows.
    flow : SympFlow or str, optional
        Trained on, or primed with, the transformed system; or the name of one that ships. `solve` takes by default
        the one that ships for the system. ``solve(system, "sympflow", flow=...)`` comes here by itself.
    """

    shift: float | None = None
    flow: Any = field(default=None, repr=False)
    name: ClassVar[str] = "log_sympflow"
    order: ClassVar[int | None] = None
    symplectic: ClassVar[bool] = True
    trained: ClassVar[bool] = True
    compiles: ClassVar[bool] = True
    source: ClassVar[str] = "A SympFlow trained on `sympflow.time_transformed(system)`, in the physical time."
    finds_events: ClassVar[bool] = False  # they are sought on the dense output
    on_grid: ClassVar[bool] = False
    in_another_time: ClassVar[bool] = True
    arrays_only: ClassVar[str] = ARRAYS_ONLY
    tangent_holds: ClassVar[str] = "the realised step in s, and B,"
    breakdown: ClassVar[Failure] = Failure.CLOCK

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shift is not None:
            checked_shift(self.shift)
        what = "a SympFlow of the transformed system, or the name of one"
        object.__setattr__(self, "flow", checked_flow(self.flow, "sympflow", what))

    @property
    def clock_shift(self) -> float | None:
        """c: the one given, else the one of the system that the flow was trained on."""
        if self.shift is not None or self.flow is None or self.flow.origin is None:
            return self.shift
        return checked_shift(self.flow.origin.shift)

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float, n_times: int = 0) -> LogSympFlow:
        """Return the integrator with the flow that ships for the system unless one is given, and its shift."""
        if self.flow is not None:
            return self
        found = [f for f in shipped_flows(system, "sympflow") if f.shift is not None]
        if not found:
            raise ValueError(
                f"`flow` is needed: no flow in another time ships for {system.name!r}: train one on "
                "sympflow.time_transformed(system), or prime one with it, and pass it; or use 'log_leapfrog'."
            )
        return replace(self, flow=found[0].load(system), shift=found[0].shift if self.shift is None else self.shift)

    def on_clock(self, system: HamiltonianSystem) -> LogarithmicClock:
        """Return the flow on its clock."""
        flow: FlowMap = self.flow
        if flow is None:
            raise ValueError(
                "`flow` is needed: train one on sympflow.time_transformed(system), or prime one with it, and pass it."
            )
        transformed = transformed_system(system, self.clock_shift)
        scale, numbers = scale_of(system, transformed.params["shift"]), flow.clock_numbers()
        clock = () if system.y0 is None else numbers
        if self.dt is None:
            dt, new_step = physical_length(flow.dt, scale, clock), flow.dt
        else:
            dt, new_step = float(self.dt), step_of_length(float(self.dt), scale, clock)
        return LogarithmicClock(self, system, transformed, dt, new_step)

    @property
    def inner(self) -> FixedStep:
        """The flow on the transformed system."""
        return SympFlowIntegrator(flow=self.flow)

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        """Count evaluations on the transformed system: see `LogarithmicClock`."""
        return self.flow.evaluations(n_steps, n_saved, n_extra, backend)

    def identity_for(self, system: HamiltonianSystem) -> Identity | None:
        origin = None if self.flow is None else self.flow.origin
        return None if origin is None else origin.identity

    def figures(self, system: HamiltonianSystem) -> Mapping[str, Any]:
        return {} if self.flow is None else self.flow.figures

    def step_length(self, system: HamiltonianSystem) -> float:
        return self.on_clock(system).dt

    def check(self, system: HamiltonianSystem) -> None:
        if self.flow is not None:
            self.flow.check_system(transformed_system(system, self.clock_shift))
            if self.dt is None:
                return
        clock = self.on_clock(system)
        if not clock.new_step <= self.flow.dt * (1 + 1e-12):
            longest = replace(self, dt=None).on_clock(system).dt
            raise ValueError(f"`dt` must be at most {longest:g}, where the step in s is the flow's Δ; got {self.dt:g}.")

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.on_clock(system).step(y, h)

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        return self.on_clock(system).inverse(y, h)

    def tangent(self, system: HamiltonianSystem, t: float, y: Array, h: Array) -> tuple[np.ndarray, np.ndarray]:
        return self.on_clock(system).tangent(y, h)
