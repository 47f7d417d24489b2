"""The ladders of primed flows that ship: from a few kicks to many, so that there is a cheap one for every accuracy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from sympflow.flow.primed import PrimedFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.integrators.schemes import SCHEMES
from sympflow.system import HamiltonianSystem
from sympflow.systems import SYSTEMS
from sympflow.timing import interleaved
from sympflow.training.trainer import train

REPEATS = 15
FORCES = 200_000  # that a timed run evaluates, or thereabouts


@dataclass(frozen=True)
class Rung:
    """A flow of a ladder.

    Parameters
    ----------
    stages, dt, processor
        See `SympFlow.primed`.
    restarts : int
        Starts of the search.
    options : dict
        Other options of `train`.
    """

    stages: int
    dt: float
    processor: int = 6
    restarts: int = 12
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of its file, after that of the scene."""
        return f"primed-{self.stages}-{self.dt:g}"

    def train(self, system: HamiltonianSystem, t_end: float, **options: Any) -> PrimedFlow:
        """The flow with its certificate and figures."""
        start = SympFlow.primed(system, self.stages, dt=self.dt, processor=self.processor)
        flow = train(system, flow=start, **{"restarts": self.restarts, **self.options, **options})
        certify(flow, system, t_end)
        return flow


@dataclass(frozen=True)
class Ladder:
    """The flows of a system.

    Parameters
    ----------
    make : callable
        The system.
    rungs : tuple of Rung
    t_end : float
        T of the energy errors.
    """

    make: Callable[[], HamiltonianSystem]
    rungs: tuple[Rung, ...]
    t_end: float = 1000.0

    def flows(self, rung: str | None = None, **options: Any) -> Iterator[tuple[Rung, PrimedFlow]]:
        """Each rung and its flow, as they are made; or one rung only, by its name."""
        system = self.make()
        for each in self.rungs:
            if rung in (None, each.name):
                yield each, each.train(system, self.t_end, **options)

    def measure(self, flow: PrimedFlow) -> dict[str, Any]:
        """The figures by which flows are chosen, measured again."""
        certify(flow, self.make(), self.t_end)
        return flow.figures


def certify(flow: SympFlow, system: HamiltonianSystem, t_end: float = 1000.0) -> None:
    """Compute the certificate, and from it the figures by which flows are chosen."""
    certificate = flow.certificate(system, t_end=t_end)
    flow.figures |= {
        "energy_error_median": certificate.relative_energy_error.median,
        "energy_error_95": certificate.relative_energy_error.q95,
        "t_end": t_end,
        "cost": round(cost(flow, system), 3),
    }


def cost(flow: SympFlow, system: HamiltonianSystem) -> float:
    """Time for a unit of time in force evaluations: against Störmer–Verlet in the same compiled loops, in turn."""
    from sympflow.kernels.mlp_flow import mlp_flow_kernel
    from sympflow.kernels.primed_flow import PrimedFlowKernel
    from sympflow.kernels.splitting import splitting_kernel

    kernel: Any = PrimedFlowKernel(flow, system) if isinstance(flow, PrimedFlow) else mlp_flow_kernel(flow)
    verlet, y0 = splitting_kernel(system), system.y0
    if y0 is None:
        assert system.domain is not None
        y0 = system.domain.sample(1, 0)[0]
    per_step = flow.kernel_scheme().force_evaluations if isinstance(flow, PrimedFlow) else 100
    n = max(1, FORCES // per_step)
    h = system.dt / 10  # the length of a step does not matter, but the orbit must stay finite
    calls = [
        partial(kernel.run, flow.dt, y0, n, np.array([n])),
        partial(verlet.run, SCHEMES["verlet"], h, y0, FORCES, np.array([FORCES])),
    ]
    for call in calls:
        call()
    own, forces = (time.median for time in interleaved(calls, REPEATS))
    return (own / (n * flow.dt)) / (forces / FORCES)


def ladders() -> dict[str, Ladder]:
    """The ladders, by the name of the scene."""
    sizes = {  # kicks and Δt
        "henon-heiles": ((2, 1.5), (2, 1.0), (3, 1.0), (3, 0.8), (3, 0.6), (3, 0.4)),
        "pendulum": ((2, 2.0), (2, 1.5), (3, 1.5), (3, 1.0), (3, 0.75), (3, 0.6)),
        "quartic": ((2, 1.0), (2, 0.75), (3, 0.75), (3, 0.6), (3, 0.5), (3, 0.3)),
        "kepler": ((2, 0.25), (2, 0.15), (3, 0.2), (3, 0.15), (3, 0.1), (3, 0.06)),
    }
    return {
        scene.replace("-", "_"): Ladder(SYSTEMS[scene], tuple(Rung(stages, dt) for stages, dt in rungs))
        for scene, rungs in sizes.items()
    }
