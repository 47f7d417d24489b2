"""Recipes of flows: how a flow was made and measured, kept in its file, so that it can be made again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.files import load
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.mlp import MLPFlow
from sympflow.flow.planetary import KeplerFlow
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.split import SplitFlow
from sympflow.hamiltonian.domain import Domain, EnergySublevel
from sympflow.hamiltonian.fingerprint import Identity
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import time_transformed
from sympflow.metrics.energy import max_energy_error
from sympflow.solver import solve
from sympflow.systems import (
    SYSTEMS,
    duffing,
    fput,
    harmonic_oscillator,
    phi4,
    sine_gordon,
    solar_system,
    spring_pendulum,
)
from sympflow.training import fits
from sympflow.training.clock_fit import train_clock
from sympflow.training.fits import (
    ClockedFit,
    Fit,
    GaussNewton,
    KeplerFit,
    LossFit,
    NetworkFit,
    PrimedFit,
    Solver,
    SplitFit,
)
from sympflow.training.planet_fit import can_train, train_planets
from sympflow.training.session import Session
from sympflow.training.shipped.judges import (
    AsPublished,
    ByRuns,
    Judge,
    balance_errors,
    by_certificate,
    of_stiff,
    one_step_errors,
)
from sympflow.training.trainer import fit_flow
from sympflow.workers import WorkerPool

YEAR = 365.25  # days
OF_Y0 = 10_000  # outputs of the run of planets from y0
SITES = 256  # of lattices, on which flows that were fitted on a few are judged

SCENES: dict[str, Callable[[], HamiltonianSystem]] = {
    **{name.replace("-", "_"): make for name, make in SYSTEMS.items()},
    "harmonic_oscillator_100": partial(harmonic_oscillator, 100.0),
    # in one well, without friction and weakly driven: its orbits are regular
    "duffing": partial(duffing, damping=0.0, force=0.1, frequency=2.7, alpha=1.0),
    "toda_chain": partial(SYSTEMS["toda-chain"], n=SITES),
    "fput_beta": partial(SYSTEMS["fput-beta"], n=SITES),
    # the sine-Gordon equation on sites one apart: pendulums coupled by springs
    "sine_gordon": partial(sine_gordon, n=SITES, length=float(SITES), accuracy=2),
    # double wells that springs couple, in a row and in a plane
    "phi4": partial(phi4, n=SITES, length=float(SITES), accuracy=2),
    "phi4_sheet": partial(
        HamiltonianSystem.lattice, onsite="(q**2 - 1)**2/4", bond="r**2/2", shape=(16, 16), name="phi4_sheet"
    ),
    "outer_planets": partial(solar_system, ("Jupiter", "Saturn", "Uranus", "Neptune")),
    "fput_50": partial(fput, omega=50.0),
    "fput_1000": partial(fput, omega=1000.0),
    "spring_pendulum_1e6": partial(spring_pendulum, 1e6, coordinates="polar"),
}
"""The systems of the flows that ship, by the first word of their files' names."""

EARLIER = {
    "quartic-polynomial-8-0.625": "quartic-polynomial-8-1",
    "quartic-polynomial-8-0.5": "quartic-polynomial-8-0.625",
}
"""Flows that start from the numbers of another one, with a longer Δt."""


@lru_cache(maxsize=1)
def scene_named(scene: str) -> HamiltonianSystem:
    """The system of a scene, which its flows share."""
    if scene not in SCENES:
        raise ValueError(
            f"`scene` {scene!r}, the first word of a file's name, is unknown: choose one of {', '.join(SCENES)}."
        )
    return SCENES[scene]()


@dataclass(frozen=True)
class Recipe:
    """The recipe in the file of a flow, which is named scene-name.safetensors."""

    path: Path
    flow: Any

    @classmethod
    def of(cls, path: Path) -> Recipe:
        """Read the recipe of a file."""
        return cls(path, load(path))

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def system(self) -> HamiltonianSystem:
        return scene_named(self.name.partition("-")[0])

    @property
    def domain(self) -> Domain:
        """The states that are trained on."""
        domain = self.flow.domain_for(self.system)
        assert domain is not None
        return domain

    @property
    def kind(self) -> str:
        """The kind of flow, by which the command chooses."""
        kinds: dict[Any, str] = {PrimedFlow: "primed", ClockedFlow: "primed", SplitFlow: "split", KeplerFlow: "kepler"}
        return kinds.get(type(self.flow), self.flow.kind)

    @property
    def stages(self) -> list[tuple[Fit, Solver]]:
        """The fit and the solver of each stage of its training."""
        return [self._stage(told, k) for k, told in enumerate(self.flow.recipe["stages"])]

    def _stage(self, told: dict[str, Any], k: int) -> tuple[Fit, Solver]:
        cls, shape = self._shape()
        cls = LossFit if k and cls is NetworkFit else cls
        left_out = {"data", "loss", *(fits.WEIGHTS if cls is PrimedFit else ())}
        options = {n: told[n] for n in cls.names() if told.get(n) is not None and n not in left_out}
        if cls is PrimedFit:
            options = {"energy_weight": 0.0, **options}  # as before there was one
        if not k:
            options |= shape
        solver = fits.SOLVERS.get(told["optimizer"], GaussNewton)
        return cls(**options), solver(**{n: told[n] for n in solver.names() if told.get(n) is not None})

    def _shape(self) -> tuple[type[Fit], dict[str, Any]]:
        """The fit that makes such a flow, and the options that describe the flow."""
        flow = self.flow
        if isinstance(flow, PrimedFlow):
            shape = flow.shape
            return PrimedFit, {
                "dt": flow.dt,
                "stages": shape.maps // 2,
                "processor": shape.processor,
                "first": shape.first,
                "curvature": shape.curvature if shape.curvature_kicks is None else shape.curvature_kicks,
                "force_gradient": shape.gradient_kicks,
                "polynomial": max(map(sum, shape.monomials), default=None),
            }
        if isinstance(flow, SplitFlow):
            stages = flow.sequence.count(flow.sequence[0]) - 1
            return SplitFit, {
                "dt": flow.dt,
                "stages": stages,
                "terms": flow.terms,
                "force_gradient": flow.gradient_kicks or False,
            }
        if isinstance(flow, ClockedFlow):
            return ClockedFit, {
                "dt": flow.figures["step"],
                "scheme": flow.scheme.name,
                "terms": len(flow.clock.numbers),
            }
        if isinstance(flow, KeplerFlow):
            return KeplerFit, {"dt": flow.dt, "reach": len(flow.kicks) // 2, "gradients": len(flow.gradients)}
        if isinstance(flow, MLPFlow):
            return NetworkFit, {"dt": flow.dt, "baseline": True}
        hidden = flow.layers[0].potential.hidden
        return NetworkFit, {"dt": flow.dt, "pairs": len(flow.layers) // 2, "hidden": hidden}

    @property
    def judge(self) -> Judge:
        """The measurement of the figures by which flows are chosen."""
        flow, certificate = self.flow, self.flow.certified
        scene = self.name.partition("-")[0]
        if isinstance(flow, ClockedFlow):
            return ByRuns()
        if isinstance(flow, SplitFlow):
            return of_stiff
        if isinstance(flow, KeplerFlow):
            return of_planets
        if not isinstance(flow, PrimedFlow):
            return AsPublished(*INITIAL[scene]) if scene in INITIAL else by_certificate
        if scene == "outer_solar_system":
            return ByRuns(states=along_the_orbit, t_end=1e5 * YEAR, t_certified=100 * YEAR)
        if flow.shape.timed:
            return ByRuns(balance_errors)
        if certificate is None:
            return by_certificate
        sizes = {name: getattr(certificate, name) for name in ("t_end", "states", "times", "held_out")}
        return partial(by_certificate, **sizes)

    def fitted(self, progress: bool | None = None) -> FlowMap:
        """The flow made again, not judged yet."""
        before, system = time.process_time(), self.system
        (fit, solver), *further = self.stages
        if isinstance(fit, ClockedFit):
            return train_clock(system, fit, self.domain)
        if isinstance(fit, KeplerFit):
            return train_planets(system, fit, self.domain, Session(progress=progress))
        flow = None
        if not isinstance(fit, NetworkFit):
            earlier = EARLIER.get(self.name)
            found = None if earlier is None else load(self.path.with_name(f"{earlier}.safetensors"), system=system)
            flow, fit = fit.flow(system, self.domain, found), fit.of_a_given_flow
        for stage, by in [(fit, solver), *further]:
            flow = fit_flow(system, flow, stage, by, self.domain, Session(progress=progress))
        assert flow is not None
        flow.figures["training_cpu_seconds"] = round(time.process_time() - before, 3)
        return flow

    def identify(self) -> None:
        """Put the identity of its system into the flow: H all over the domain."""
        flow, system = self.flow, self.system
        if flow.origin is None:
            flow.identify(system, flow.domain)
            return
        flow.identify(time_transformed(system, flow.origin.shift))
        made = {**flow.recipe["transforms"], "identity": Identity.of(system, self.domain).to_dict()}
        flow.recipe = {**flow.recipe, "transforms": made}

    def measure(self) -> None:
        """Measure again the figures by which flows are chosen."""
        self.judge(self.flow, self.system)


def made(recipes: Iterable[Recipe], progress: bool | None = None, workers: Any = 1) -> Iterator[tuple[Recipe, FlowMap]]:
    """The recipes and their flows, trained and judged."""
    recipes = list(recipes)
    with WorkerPool(workers) as pool:
        yield from zip(recipes, pool.map(_made, progress, [recipe.path for recipe in recipes]), strict=True)


def _made(progress: bool | None, path: Path) -> FlowMap:
    """The flow of a file made again, as a task."""
    torch.set_num_threads(1)  # the arrays are small, and one thread is reproducible
    recipe = Recipe.of(path)
    flow = recipe.fitted(progress)
    recipe.judge(flow, recipe.system)
    return flow


# states that flows are judged by --------------------------------------------------------------------------------


def along_the_orbit(system: HamiltonianSystem, n: int = 10, span: float = 1e5 * YEAR, seed: int = 0) -> np.ndarray:
    """States of planets at n random times in 1e5 years of their own orbit, which stays in Ω."""
    t = np.sort(np.random.default_rng(seed).uniform(0, span, n))
    given: dict[str, Any] = {"method": "kahan_li8", "dt": 200.0}
    if can_train(system):
        given = {"method": "kepler_aba1064"}
    return solve(system, t_span=(0.0, float(t[-1])), t_eval=t, **given).states


def of_planets(flow: Any, system: HamiltonianSystem) -> None:
    """Errors of runs over 1e5 years from y0 and states along the orbit, and of steps from these."""
    span = 1e5 * YEAR
    ByRuns(states=along_the_orbit, t_end=span)(flow, system)
    often = max(1, int(span / flow.dt / OF_Y0))
    own = max_energy_error(solve(system, flow, (0.0, span), save_every=often, on_domain_exit="ignore"))
    at_end, between = one_step_errors(flow, system, along_the_orbit(system))
    flow.figures |= {
        "energy_error_95": max(flow.figures["energy_error_95"], float(own)),
        "one_step_error": at_end,
        "fractional_error": between,
    }


def _square(omega: float = 1.0) -> np.ndarray:
    """(q, p/ω) uniform in [−1.2, 1.2]²."""
    return np.random.default_rng(0).uniform(-1.2, 1.2, (100, 2)) * np.array([1.0, omega])


def _of_scene(scene: str, energy: float = math.inf) -> np.ndarray:
    """States of a scene's own domain, with less than an energy."""
    system = scene_named(scene)
    own = system.domain
    assert isinstance(own, EnergySublevel)
    return EnergySublevel(min(energy, own.energy), own.box).attach(system.hamiltonian).sample(100, 0)


INITIAL: dict[str, tuple[Any, ...]] = {
    "harmonic_oscillator": (_square,),
    "harmonic_oscillator_100": (partial(_square, 100.0), 100.0),
    "henon_heiles": (partial(_of_scene, "henon_heiles", 1 / 8),),
    "pendulum": (partial(_of_scene, "pendulum"),),
}
"""The initial states of the published checkpoints, and their ω."""
