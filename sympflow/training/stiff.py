"""The flows that ship for stiff systems: SympFlows of the exact flows of their parts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sympflow.flow.split import SplitFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Box, Domain, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.solver import solve
from sympflow.systems import fput, spring_pendulum
from sympflow.training.ladder import cost
from sympflow.training.trainer import train

PHASES = (
    *(k / 20 for k in range(1, 20)),
    0.97,
    0.98,
    0.99,
    0.995,
)  # of a step, at which figures between steps are taken
CERTIFICATE = {"states": 500, "times": 17, "held_out": 20}  # smaller than the default: a state costs dear
HELD_OUT, SEED = 20, 20_261_121  # states of the energy figure, from a seed that no training uses


@dataclass(frozen=True)
class StiffRecipe:
    """How a flow for a stiff system is made.

    Parameters
    ----------
    system : HamiltonianSystem
    domain : Domain
        Ω.
    turn : float
        Δt times the fastest frequency.
    structure : dict
        Arguments of `SympFlow.split`.
    fit : dict
        Arguments of `train`.
    """

    system: HamiltonianSystem
    domain: Domain
    turn: float
    structure: dict[str, Any]
    fit: dict[str, Any] = field(default_factory=dict)

    def train(self) -> SplitFlow:
        """The flow, with its figures and its certificate."""
        dt = self.turn / float(self.system.linear_part.frequencies.max())
        before = time.process_time()
        start = SympFlow.split(self.system, dt=dt, **self.structure)
        flow: SplitFlow = train(self.system, flow=start, domain=self.domain, **self.fit)
        flow.figures["training_cpu_seconds"] = round(time.process_time() - before, 3)
        self.measure(flow)
        return flow

    def measure(self, flow: SplitFlow) -> dict[str, Any]:
        """Put largest energy errors over the system's interval, which is `t_end`, into the figures; certify it.

        `orbit_energy_error` from y0 at every step, `between_steps` the largest at `PHASES` of 500 steps, relative; of
        held-out states of Ω at every tenth step, `energy_error` and `energy_error_max` in units of H, the mean over the
        states and the largest, and `energy_error_95`, the 95 % quantile, relative, by which a flow is chosen. With it
        `cost`, see `sympflow.training.ladder.cost`.
        """
        system, flow = self.system, flow.bound(self.system)
        on_grid = solve(system, flow, on_domain_exit="ignore")
        n = round((system.t_span[1] - system.t_span[0]) / flow.dt) - 1
        t = np.unique(np.linspace(0, n, 500).round())[:, None] + np.array(PHASES)
        between = solve(system, flow, on_domain_exit="ignore", t_eval=t.ravel() * flow.dt + system.t_span[0])
        x = self.domain_of(system).sample(HELD_OUT, SEED)
        steps = np.arange(0.0, system.t_span[1] + flow.dt / 2, flow.dt)[::10]
        many = solve(system, flow, y0=x, t_eval=steps[steps <= system.t_span[1]], on_domain_exit="ignore")
        H = np.asarray(many.energy())
        drift = np.abs(H - H[..., :1]).max(-1)
        scale = np.abs(H[..., 0]) if system.energy_scale is None else system.energy_scale
        flow.figures |= {
            "orbit_energy_error": float(np.abs(on_grid.energy_error()).max()),
            "between_steps": float(np.abs(between.energy() / system.hamiltonian(system.y0) - 1).max()),
            "energy_error": float(drift.mean()),
            "energy_error_max": float(drift.max()),
            "energy_error_95": float(np.quantile(drift / scale, 0.95, method="higher")),
            "t_end": system.t_span[1],
            "cost": round(cost(flow), 3),
        }
        flow.certificate(system, t_end=system.t_span[1], **CERTIFICATE)
        return flow.figures

    def domain_of(self, system: HamiltonianSystem) -> Domain:
        attached = isinstance(self.domain, EnergySublevel)
        return self.domain.attach(system.hamiltonian) if attached else self.domain  # type: ignore[attr-defined]


def low_energies(omega: float, energy: float = 2.5) -> EnergySublevel:
    """The states of `fput` with H < 2.5 (y0 has 2.0012), in the smallest box that holds them."""
    p, root = math.sqrt(2 * energy), energy**0.25
    slow = [1.42 * root, 2 * root, 1.42 * root]  # where the four quartic springs alone have the energy
    high = np.array([*slow, *[p / omega] * 3, *[p] * 6]) * 1.001
    return EnergySublevel(energy, Box(-high, high))


def recipes() -> dict[str, Callable[[], StiffRecipe]]:
    """The recipes, by the name of the file."""
    return {
        "fput_50": lambda: StiffRecipe(
            fput(omega=50.0),
            low_energies(50.0),
            10.0,
            {"stages": 6, "terms": 10, "force_gradient": (0, 5)},
            {"label_times": 24, "frozen_weight": 3.0},
        ),
        "fput_1000": lambda: StiffRecipe(
            fput(omega=1000.0),
            low_energies(1000.0),
            20.0,
            {"stages": 4, "terms": 16, "force_gradient": False},
            {"label_times": 40, "frozen_weight": 3.0},
        ),
        "spring_pendulum_1e6": lambda: _spring_pendulum(1e6),
    }


def _spring_pendulum(k: float) -> StiffRecipe:
    system = spring_pendulum(k, coordinates="polar")
    assert system.domain is not None
    structure = {"stages": 1, "terms": 8}
    return StiffRecipe(system, system.domain, 10.0, structure, {"label_times": 20, "frozen_weight": 3.0})
