"""Which primed flow to fit to a system of which nothing else is said: its Δt, its kicks, its processor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem

if TYPE_CHECKING:
    from sympflow.flow.primed import PrimedFlow

SAMPLES, SEED = 1000, 0
QUANTILE = 0.99
PHASE = 1.0  # ω Δt of the default flow: energy errors of 1e-8 to 1e-5, where its gain in time is the largest
KICK_PHASE = 0.25  # ω Δt for each kick of the kernel
MOST_STAGES = 24
BUDGET = 60.0  # seconds of a fit of which nothing else is said


@dataclass(frozen=True)
class PrimedRecipe:
    """A primed flow to be fitted, and how.

    Parameters
    ----------
    dt : float
        Δt.
    stages : int
        Kicks of the kernel K.
    processor : int
        Kicks of the processor χ.
    degree : int, optional
        Of the polynomials in t.
    force_gradient : bool, optional
        Whether kicks have a force gradient; by default where T is quadratic.
    restarts, seed : int
        Starts of the search, and its seed.
    time_budget : float, optional
        Seconds after which the fit ends with the best so far.
    curvature : bool
        Whether kicks have curvature terms.
    """

    dt: float
    stages: int = 3
    processor: int = 6
    degree: int | None = None
    force_gradient: bool | None = None
    restarts: int = 24
    seed: int = 0
    time_budget: float | None = None
    curvature: bool = False

    def flow(self, system: HamiltonianSystem) -> PrimedFlow:
        """The flow to start from."""
        from sympflow.flow.sympflow import SympFlow

        return SympFlow.primed(
            system,
            self.stages,
            dt=self.dt,
            processor=self.processor,
            degree=self.degree,
            force_gradient=self.force_gradient,
            curvature=self.curvature,
        )

    def options(self) -> dict[str, Any]:
        """The arguments of `train` that go with it."""
        return {
            "optimizer": "gauss-newton",
            "restarts": self.restarts,
            "seed": self.seed,
            "time_budget": self.time_budget,
        }


def default_recipe(
    system: HamiltonianSystem, domain: Domain | None = None, dt: float | None = None, phase: float = PHASE
) -> PrimedRecipe:
    """Three kicks and a processor of six, with Δt such that ω Δt is about 1; for a given Δt as many kicks as it needs.

    ω is the fastest frequency of the linearized motion, √ of the largest eigenvalue of M⁻¹∇²V, that 99 % of the states
    of the domain stay below. After 60 s the fit ends with the best so far. The processor costs nothing over a long run,
    and is larger than the kernel for that.

    Parameters
    ----------
    system : HamiltonianSystem
        Separable.
    domain : Domain, optional
        Ω; the default is that of the system.
    dt : float, optional
        Δt.
    phase : float
        Another ω Δt, where no Δt is given.
    """
    omega = frequency(system, system.domain if domain is None else domain)
    if dt is None:
        return PrimedRecipe(dt=_rounded(phase / omega), time_budget=BUDGET)
    stages = min(max(2, math.ceil(omega * dt / KICK_PHASE - 1e-9)), MOST_STAGES)
    return PrimedRecipe(dt=float(dt), stages=stages, time_budget=BUDGET)


def frequency(system: HamiltonianSystem, domain: Domain | None) -> float:
    """The fastest frequency of the linearized motion that 99 % of the states of the domain stay below."""
    if domain is None:
        raise ValueError(f"`domain` is not known for the system {system.name!r}: pass one.")
    y = domain.sample(SAMPLES, SEED)
    q, p = y[:, : system.ndof], y[:, system.ndof :]
    product = system.kinetic_hessian(p) @ system.potential_hessian(q)
    squares = np.linalg.eigvals(product).real.max(-1)
    squares = squares[np.isfinite(squares)]
    omega = math.sqrt(max(float(np.quantile(squares, QUANTILE)), 0.0)) if len(squares) else 0.0
    if omega == 0.0:  # nowhere bound: what a state needs to cross the domain
        speed = np.linalg.norm(system.velocity(p), axis=-1)
        omega = float(np.quantile(speed, QUANTILE) / max(float(q.std(0).max()), np.finfo(float).tiny)) or 1.0
    return omega


def _rounded(dt: float) -> float:
    """The largest of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 and 8 times a power of ten that is no longer, to 2 %."""
    unit = 10.0 ** math.floor(math.log10(dt * 1.02))
    return float(f"{max(m for m in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if m * unit <= dt * 1.02) * unit:.3g}")
