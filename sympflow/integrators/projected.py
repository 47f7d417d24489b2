"""Steps on a doubled system, each projected to the physical limit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from sympflow.arrays import Array
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.contract import Integrator
from sympflow.integrators.registry import build, check_applies


@dataclass(frozen=True)
class Projected(FixedStep):
    """Another method `of` a doubled system, with q₋ = p₋ = 0 put back after every step.

    A trained flow leaves the physical limit by its error, and the doubled flow then carries q₋, p₋ away as fast as
    friction takes energy out: e^{γt}. With this projection the physical states (q₊, p₊) are mapped by themselves.
    """

    of: Any = field(default=None, repr=False)
    name: ClassVar[str] = "projected"
    order: ClassVar[int | None] = None
    symplectic: ClassVar[bool] = False
    source: ClassVar[str] = "another method, projected to the physical limit of a doubled system after every step"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.of is None:
            raise TypeError("`of` is needed: the method, or trained flow, whose steps are projected.")
        object.__setattr__(self, "of", build(self.of, {}))

    @property
    def inner(self) -> Integrator:
        """The method whose steps are projected."""
        return self.of

    @property
    def label(self) -> str:
        return f"{self.inner.label}, projected"

    @property
    def takes_driving(self) -> bool:  # type: ignore[override]
        return self.inner.takes_driving

    def forces_at_ends(self, system: HamiltonianSystem) -> bool:
        return self.inner.forces_at_ends(system)

    def forces_beyond(self, system: HamiltonianSystem) -> bool:
        return self.inner.forces_beyond(system)

    def check(self, system: HamiltonianSystem) -> None:
        system.as_doubled()
        check_applies(self.inner, system)

    def step_length(self, system: HamiltonianSystem) -> float:
        return float(self.dt if self.dt is not None else self.inner.step_length(system) or system.dt)

    def step(self, system: HamiltonianSystem, t: float, y: Array, h: float | Array) -> Array:
        doubled = system.as_doubled()
        return doubled.lift(doubled.physical_limit(self.inner.step(system, t, y, h)))
