"""The networks that ship: SympFlows with MLP potentials, and unconstrained baselines of as many parameters."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sympflow.hamiltonian.domain import Box, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.systems import harmonic_oscillator, henon_heiles, pendulum
from sympflow.training.figures import measure, one_step_errors
from sympflow.training.ladder import certify
from sympflow.training.trainer import train

KINDS = ("sympflow", "mlp")


@dataclass(frozen=True)
class NetworkRecipe:
    """How a scene's networks are trained, the same for both architectures: by Gauss–Newton, in two stages.

    Parameters
    ----------
    system : HamiltonianSystem
    initial : callable
        The 100 initial states of the figures, drawn with seed 0.
    dt : float
        Δt.
    omega : float
        The frequency in whose units the figures are (see `measure`).
    points, steps : (int, int)
        Collocation points and steps of the stages.
    margin : float
        How much wider than the system's the domain is that is trained on, in energy: what a network does beyond its
        domain is arbitrary, and orbits at the edge come there.
    """

    system: HamiltonianSystem
    initial: Callable[[], np.ndarray]
    dt: float = 1.0
    omega: float = 1.0
    points: tuple[int, int] = (1000, 2500)
    steps: tuple[int, int] = (150, 100)
    margin: float = 1.0

    def train(self, kind: str, **options: Any) -> Any:
        """The flow, with its figures, and a certificate if it is symplectic."""
        first, second = zip(self.points, self.steps, strict=True)
        newton: dict[str, Any] = {"optimizer": "gauss-newton", "domain": self.domain, **options}
        before = time.process_time()
        flow = train(self.system, self.dt, kind=kind, points=first[0], steps=first[1], **newton)
        flow = train(self.system, flow=flow, points=second[0], steps=second[1], seed=1, **newton)
        flow.figures["training_cpu_seconds"] = round(time.process_time() - before, 3)
        self.judge(flow)
        return flow

    def judge(self, flow: Any) -> dict[str, Any]:
        """Its figures, measured (again), with a certificate if it is symplectic."""
        flow.figures |= self.measure(flow)
        at_end, between = one_step_errors(flow, self.system, self.initial(), omega=self.omega)
        flow.figures |= {"error_at_dt": at_end, "fractional_error": between}
        if flow.kind == "sympflow":
            certify(flow, self.system)
        return flow.figures

    @property
    def domain(self) -> EnergySublevel:
        """The domain that is trained on."""
        own = self.system.domain
        assert isinstance(own, EnergySublevel)
        low, high = np.array(own.box.low), np.array(own.box.high)
        middle, half = (low + high) / 2, (high - low) / 2 * max(1.0, self.margin)
        box = Box(middle - half, middle + half) if self.margin != 1.0 else own.box
        return EnergySublevel(self.margin * own.energy, box).attach(self.system.hamiltonian)

    def measure(self, flow: Any, steps: int = 1000) -> dict[str, Any]:
        """`measure` from the initial states of the recipe."""
        return measure(flow, self.system, self.initial(), steps=steps, omega=self.omega)


def _square(omega: float) -> np.ndarray:
    """(q, p/ω) uniform in [−1.2, 1.2]²."""
    return np.random.default_rng(0).uniform(-1.2, 1.2, (100, 2)) * np.array([1.0, omega])


def _well(energy: float) -> np.ndarray:
    """Uniform in the Hénon–Heiles well below an energy."""
    system = henon_heiles()
    assert isinstance(system.domain, EnergySublevel)
    return EnergySublevel(energy, system.domain.box).attach(system.hamiltonian).sample(100, 0)


def recipes() -> dict[str, NetworkRecipe]:
    """The recipes, by the name of the scene."""
    swing = pendulum()
    assert swing.domain is not None
    return {
        "henon_heiles": NetworkRecipe(henon_heiles(), lambda: _well(1 / 8), points=(1000, 4000)),
        "harmonic_oscillator": NetworkRecipe(harmonic_oscillator(), lambda: _square(1.0), margin=1.1),
        "pendulum": NetworkRecipe(swing, lambda: swing.domain.sample(100, 0), margin=1.03, steps=(40, 160)),  # type: ignore[union-attr]
        "harmonic_oscillator_100": NetworkRecipe(
            harmonic_oscillator(100.0), lambda: _square(100.0), dt=0.01, omega=100.0, margin=1.1
        ),
    }
