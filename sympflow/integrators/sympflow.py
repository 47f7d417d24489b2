"""The methods "sympflow" and "mlp": a SympFlow, chosen by `tol`, and the unconstrained MLP it is compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, is_tensor
from sympflow.domain_exit import check_start
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Outcome, Problem
from sympflow.integrators.flows import FlowIntegrator, known

SEARCH, SEARCH_OF_EACH = 50_000, 2_000
"""Forces that take as long as finding the outputs of a run, or of each trajectory in a batch, by their times."""


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
        the domain of that flow there is no such figure, and a ValueError says so. It says nothing of a smaller `dt`.
    compensated : bool
        Whether to sum with Kahan's compensation, which slows the growth of round-off. Compiled primed flows only.

    References
    ----------
    .. [1] P. Canizares, D. Murari, C.-B. Schönlieb, F. Sherry, Z. Shumaylov, "Hamiltonian matching for symplectic
       neural integrators" (2024).
    """

    tol: float | None = None
    compensated: bool = False

    name: ClassVar[str] = "sympflow"
    symplectic: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("compensated", self.compensated)
        if self.tol is None:
            return
        if not isinstance(self.tol, Real) or isinstance(self.tol, bool) or not 0 < self.tol < math.inf:
            raise ValueError(
                f"`tol` must be a positive number, a relative energy error; got {self.tol!r}: take 1e-6, for instance."
            )
        for name in ("flow", "dt"):
            if getattr(self, name) is not None:
                raise ValueError(f"`tol` chooses the flow and its Δt, but `{name}` is given: leave out one of them.")

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float) -> FixedStep:
        """What runs: with `tol`, and over a `length` that is worth it, a flow in another time, by `LogSympFlow`.

        So does a flow in another time of this system that is given. A `tol` that no other meets is worth any length.
        """
        if self.flow is not None:
            return self._given_in_another_time(system)
        if self.tol is None or self.compensated or is_tensor(y0) or y0.dtype != np.float64:
            return self
        name, tol = self.name, self.tol
        other = known(("in another time", name, system.fingerprint, tol), lambda: _in_another_time(system, name, tol))
        if other is None:
            return self
        flow, shift, saved = other
        trajectories = y0.size // y0.shape[-1]
        if trajectories * length * saved < SEARCH + SEARCH_OF_EACH * trajectories:
            return self
        from sympflow.integrators.log_sympflow import LogSympFlow

        check_start(flow, system, y0, False)
        return LogSympFlow(flow=flow, shift=shift)

    def _given_in_another_time(self, system: HamiltonianSystem) -> FixedStep:
        origin = (self.flow.recipe or {}).get("transforms")
        if origin is None:
            return self
        from sympflow.flow.base import same_system

        if not same_system(origin["fingerprint"], system.fingerprint):
            return self
        from sympflow.integrators.log_sympflow import LogSympFlow

        if self.compensated:
            raise ValueError("`compensated` sums are not for a flow in another time: leave it out.")
        return LogSympFlow(flow=self.flow, shift=origin["shift"], dt=self.dt)

    def _flow_and_kernel(self, problem: Problem) -> tuple[Any, Any]:
        flow, kernel = super()._flow_and_kernel(problem)
        if not self.compensated:
            return flow, kernel
        if kernel is None or not hasattr(flow, "kernel_scheme"):
            raise ValueError(
                "`compensated` sums need the compiled loops of a primed flow, on NumPy float64 states: leave "
                "it out, or take a flow of SympFlow.primed."
            )
        from sympflow.kernels.primed_flow import PrimedFlowKernel

        return flow, PrimedFlowKernel(flow, problem.system, compensated=True)


def _in_another_time(system: HamiltonianSystem, kind: str, tol: float) -> tuple[Any, float, float] | None:
    """The flow that meets `tol`, if it is one in another time: it, its shift, and the forces that it saves."""
    from sympflow.flow.shipped import choose, forces_saved

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
    symplectic: ClassVar[bool] = False

    def run(self, problem: Problem) -> Outcome:
        if problem.t1 < problem.t0:
            raise ValueError(
                "`t_span` runs backwards, but method 'mlp' has no inverse: use a symplectic method for backward time."
            )
        return super().run(problem)

    def inverse(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        raise TypeError("`method` 'mlp' has no exact inverse: use a symplectic method.")
