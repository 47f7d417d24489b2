"""Trained flows on the logarithmic Hamiltonian, in the physical time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from sympflow.arrays import Array
from sympflow.integrators.base import FixedStep
from sympflow.integrators.logarithmic import Logarithmic
from sympflow.integrators.time_search import physical_length, step_of_length
from sympflow.system import HamiltonianSystem
from sympflow.time_transformation import checked_shift, time_scale


@dataclass(frozen=True)
class LogSympFlow(Logarithmic):
    """A SympFlow trained on `sympflow.time_transformed(system)`, in the physical time.

    Parameters
    ----------
    dt : float, optional
        As for `Logarithmic`, by the flow's own clock where it has one; the step in s that it means is at most the
        flow's Δ, which is the default.
    shift : float, optional
        The one of the transformed system that the flow was trained on; a flow that ships knows it.
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
    checked: ClassVar[tuple[HamiltonianSystem, float] | None] = None
    """Of one that was checked: the system, and the step in s."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.flow, str):
            from sympflow.flow.shipped import named

            object.__setattr__(self, "flow", named(self.flow).load())
        if self.flow is not None and getattr(self.flow, "kind", None) != "sympflow":
            raise TypeError(
                f"`flow` must be a SympFlow of the transformed system, or the name of one; got "
                f"{type(self.flow).__name__}."
            )

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("within", "checked")}

    def resolved(self, system: HamiltonianSystem, y0: Array, length: float) -> LogSympFlow:
        """With the flow that ships for the system unless one is given, and its shift."""
        if self.flow is None:
            from sympflow.flow.shipped import shipped_flows

            found = [f for f in shipped_flows(system, "sympflow") if f.shift is not None]
            if not found:
                raise ValueError(
                    f"`flow` is needed, for none in another time ships for {system.name!r}: train one on "
                    "sympflow.time_transformed(system), or prime one with it, and pass it; or use 'log_leapfrog'."
                )
            return replace(self, flow=found[0].load(system), shift=found[0].shift if self.shift is None else self.shift)
        origin = (getattr(self.flow, "recipe", None) or {}).get("transforms")
        if self.shift is not None or origin is None:
            return self
        resolved = object.__new__(type(self))  # the fields have been checked
        vars(resolved).update(vars(self), shift=checked_shift(origin["shift"]))
        return resolved

    def inner(self, system: HamiltonianSystem) -> FixedStep:
        if self.within is not None:
            return self.within
        if self.flow is None:
            raise ValueError(
                "`flow` is needed: train one on sympflow.time_transformed(system), or prime one with it, and pass it."
            )
        from sympflow.integrators.sympflow import SympFlowIntegrator

        within = object.__new__(SympFlowIntegrator)  # the flow has been checked
        vars(within).update(flow=self.flow, dt=None, tol=None, compensated=False)
        object.__setattr__(self, "within", within)
        return within

    def step_length(self, system: HamiltonianSystem) -> float:
        return self._longest(system) if self.dt is None else float(self.dt)

    def new_step(self, system: HamiltonianSystem) -> float:
        if self.dt is None:
            return float(self.flow.dt)
        if self.checked is not None and self.checked[0] is system:
            return self.checked[1]
        return step_of_length(float(self.dt), *self._pace(system))

    def check(self, system: HamiltonianSystem) -> None:
        if self.flow is None:
            self.inner(system)  # says so
        self.flow.check_system(self.transformed(system))
        object.__setattr__(self, "checked", None)
        h = self.new_step(system)
        object.__setattr__(self, "checked", (system, h))
        if not h <= self.flow.dt * (1 + 1e-12):
            longest = self._longest(system)
            raise ValueError(f"`dt` must be at most {longest:g}, where the step in s is the flow's Δ; got {self.dt:g}.")

    def _longest(self, system: HamiltonianSystem) -> float:
        return physical_length(float(self.flow.dt), *self._pace(system))

    def _pace(self, system: HamiltonianSystem) -> tuple[float, tuple[float, ...]]:
        """ds/dt where the kinetic energy is B, and the numbers of the clock, if there is one and B is known."""
        scale = time_scale(system, self.transformed(system).params["shift"])
        return scale, self.flow.numbers() if system.y0 is not None and hasattr(self.flow, "numbers") else ()
