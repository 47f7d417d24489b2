"""Trained flows on the logarithmic Hamiltonian, in the physical time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from sympflow.arrays import Array
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import checked_shift, default_shift, time_scale
from sympflow.integrators.base import FixedStep
from sympflow.integrators.flows import kernel_of
from sympflow.integrators.logarithmic import Logarithmic
from sympflow.integrators.sympflow import SympFlowIntegrator
from sympflow.integrators.time_search import physical_length, step_of_length

Lengths = tuple[HamiltonianSystem, float, float, tuple[float, ...]]


@dataclass(frozen=True)
class LogSympFlow(Logarithmic):
    """A SympFlow trained on `sympflow.time_transformed(system)`, in the physical time.

    Parameters
    ----------
    dt : float, optional
        As for `Logarithmic`, by the flow's own clock where it has one; the step in s that it means is at most the
        flow's Δ, which is the default.
    shift : float, optional
        The one of the transformed system that the flow was trained on, which a flow that ships knows.
    flow : SympFlow or str, optional
        Trained on, or primed with, the transformed system; or the name of one that ships. `solve` takes by default
        the one that ships for the system. ``solve(system, "sympflow", flow=...)`` comes here by itself.
    """

    flow: Any = field(default=None, repr=False)

    name: ClassVar[str] = "log_sympflow"
    order: ClassVar[int | None] = None
    trained: ClassVar[bool] = True
    within: ClassVar[FixedStep | None] = None
    """Of one whose `inner` has been asked for: that."""
    checked: ClassVar[Lengths | None] = None
    """Of one that was checked: what it found."""

    def __post_init__(self) -> None:
        super().__post_init__()
        flow = self.flow
        if isinstance(flow, str):
            from sympflow.flow.shipped import named

            self.__dict__["flow"] = flow = named(flow).load()
        if flow is None:
            return
        if getattr(flow, "kind", None) != "sympflow":
            raise TypeError(
                f"`flow` must be a SympFlow of the transformed system, or the name of one; got {type(flow).__name__}."
            )
        if self.shift is None and (origin := (flow.recipe or {}).get("transforms")) is not None:
            self.__dict__["shift"] = checked_shift(origin["shift"])

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("within", "checked")}

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float) -> LogSympFlow:
        """With the flow that ships for the system unless one is given, and its shift."""
        if self.flow is not None:
            return self
        from sympflow.flow.shipped import shipped_flows

        found = [f for f in shipped_flows(system, "sympflow") if f.shift is not None]
        if not found:
            raise ValueError(
                f"`flow` is needed, for none in another time ships for {system.name!r}: train one on "
                "sympflow.time_transformed(system), or prime one with it, and pass it; or use 'log_leapfrog'."
            )
        return replace(self, flow=found[0].load(system), shift=found[0].shift if self.shift is None else self.shift)

    def inner(self, system: HamiltonianSystem) -> FixedStep:
        if self.within is not None:
            return self.within
        if self.flow is None:
            raise ValueError(
                "`flow` is needed: train one on sympflow.time_transformed(system), or prime one with it, and pass it."
            )
        within = object.__new__(SympFlowIntegrator)  # the flow has been checked
        within.__dict__.update(flow=self.flow, dt=None, tol=None, compensated=False)
        self.__dict__["within"] = within
        return within

    def reach_times(
        self,
        transformed: HamiltonianSystem,
        h: float,
        start: np.ndarray,
        times: np.ndarray,
        stride: int,
        expected: float,
        backend: str,
    ) -> Any:
        kernel = kernel_of(transformed, self.flow.bound(transformed), start, backend)
        reach_times = getattr(kernel, "reach_times", None)
        if reach_times is None:
            return None
        return reach_times(h, start, times, stride, expected, None if self.checked is None else self.checked[3])

    def compiled_evaluations(self, system: HamiltonianSystem, n_steps: int, n_extra: int) -> dict[str, int]:
        return self.flow.evaluations(n_steps, n_steps, n_extra, "compiled")

    def step_length(self, system: HamiltonianSystem) -> float:
        return self._lengths(system)[1]

    def new_step(self, system: HamiltonianSystem) -> float:
        return self._lengths(system)[2]

    def check(self, system: HamiltonianSystem) -> None:
        flow = self.flow
        if flow is None:
            self.inner(system)  # says so
        flow.check_system(self.transformed(system))
        self.__dict__["checked"] = checked = self._found(system)
        if not checked[2] <= flow.dt * (1 + 1e-12):
            longest = replace(self, dt=None)._found(system)[1]
            raise ValueError(f"`dt` must be at most {longest:g}, where the step in s is the flow's Δ; got {self.dt:g}.")

    def _lengths(self, system: HamiltonianSystem) -> Lengths:
        checked = self.checked
        return checked if checked is not None and checked[0] is system else self._found(system)

    def _found(self, system: HamiltonianSystem) -> Lengths:
        """The system, the physical length of a step, its length in s, and the numbers of the clock, if there is one.

        Where the kinetic energy is B, ds/dt is the scale. Without y0 no B is known, by which the clock advances.
        """
        flow, shift, dt = self.flow, self.shift, self.dt
        scale = time_scale(system, default_shift(system) if shift is None else shift)
        numbers = flow.numbers() if hasattr(flow, "numbers") else ()
        clock = () if system.y0 is None else numbers
        if dt is None:
            return system, physical_length(flow.dt, scale, clock), flow.dt, numbers
        return system, float(dt), step_of_length(float(dt), scale, clock), numbers
