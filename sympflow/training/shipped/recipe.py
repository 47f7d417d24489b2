"""Recipe: how a flow that ships is made and judged."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Protocol

import torch

from sympflow.flow.flow_map import FlowMap
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.fingerprint import Identity
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.hamiltonian.time_transformation import time_transformed
from sympflow.training.clock_fit import train_clock
from sympflow.training.fits import ClockedFit, Fit, GaussNewton, LossFit, NetworkFit, Solver
from sympflow.training.session import Session
from sympflow.training.trainer import fit_flow
from sympflow.workers import WorkerPool


class Judge(Protocol):
    """A measurement of a trained flow; `certifies` says if it gives those that are symplectic a certificate."""

    certifies: ClassVar[bool]

    def __call__(self, flow: Any, system: HamiltonianSystem) -> None:
        """Put the figures by which flows are chosen, and a certificate, into the flow."""


@dataclass(frozen=True)
class Recipe:
    """A flow that ships."""

    scene: str
    name: str
    system: Callable[[], HamiltonianSystem]
    fit: Fit
    judge: Judge
    solver: Solver = field(default_factory=GaussNewton)
    further: tuple[tuple[LossFit, Solver], ...] = ()
    domain: Callable[[HamiltonianSystem], Domain] | None = None
    after: str | None = None

    @property
    def kind(self) -> str:
        """The kind of flow, by which the command chooses."""
        return "primed" if isinstance(self.fit, ClockedFit) else self.fit.kind  # it is one of a ladder

    def domain_of(self, system: HamiltonianSystem) -> Domain:
        """The states that are trained on."""
        domain = system.domain if self.domain is None else self.domain(system)
        assert domain is not None
        return domain

    def fitted(
        self, system: HamiltonianSystem, earlier: FlowMap | None = None, progress: bool | None = None
    ) -> FlowMap:
        """The trained flow, not judged yet; `earlier` is that of the recipe `after` which it comes."""
        before = time.process_time()
        domain = self.domain_of(system)
        if isinstance(self.fit, ClockedFit):
            return train_clock(system, self.fit, domain)
        start = None if isinstance(self.fit, NetworkFit) else self.fit.flow(system, domain, earlier)
        first = self.fit if start is None else self.fit.of_a_given_flow
        flow = fit_flow(system, start, first, self.solver, domain, Session(progress=progress))
        for fit, solver in self.further:
            flow = fit_flow(system, flow, fit, solver, domain, Session(progress=progress))
        flow.figures["training_cpu_seconds"] = round(time.process_time() - before, 3)
        return flow

    def identify(self, flow: FlowMap) -> None:
        """Put the identity of its system into the flow: H all over the domain."""
        system = self.system()
        if flow.origin is None:
            flow.identify(system, flow.domain)
            return
        flow.identify(time_transformed(system, flow.origin.shift))
        made = {**flow.recipe["transforms"], "identity": Identity.of(system, self.domain_of(system)).to_dict()}
        flow.recipe = {**flow.recipe, "transforms": made}

    def measure(self, flow: FlowMap) -> dict[str, Any]:
        """The figures by which flows are chosen, measured again."""
        self.judge(flow, self.system())
        return flow.figures


def made(
    recipes: Sequence[Recipe],
    earlier: Callable[[Recipe, str], FlowMap] | None = None,
    progress: bool | None = None,
    workers: Any = 1,
) -> Iterator[tuple[Recipe, FlowMap]]:
    """The recipes and their flows, trained and judged; those that come `after` others when these are made."""
    flows: dict[tuple[str, str], FlowMap] = {}
    left = list(recipes)
    with WorkerPool(workers) as pool:
        while left:
            names = {(recipe.scene, recipe.name) for recipe in left}
            ready = [recipe for recipe in left if (recipe.scene, recipe.after) not in names]
            left = [recipe for recipe in left if recipe not in ready]
            items = [(recipe, _before(recipe, flows, earlier)) for recipe in ready]
            for recipe, flow in zip(ready, pool.map(_made, progress, items), strict=True):
                flows[recipe.scene, recipe.name] = flow
                yield recipe, flow


def _before(
    recipe: Recipe, flows: Mapping[tuple[str, str], FlowMap], earlier: Callable[[Recipe, str], FlowMap] | None
) -> FlowMap | None:
    """The flow that a recipe starts from, if it comes after another one."""
    if recipe.after is None:
        return None
    before = flows.get((recipe.scene, recipe.after))
    if before is None and earlier is None:
        raise ValueError(f"`rung` {recipe.name!r} starts from {recipe.after!r}: make that first, or all of them.")
    return earlier(recipe, recipe.after) if before is None and earlier is not None else before


def _made(progress: bool | None, item: tuple[Recipe, FlowMap | None]) -> FlowMap:
    """The flow of a recipe, as a piece of work."""
    torch.set_num_threads(1)  # the arrays are small, and one thread is reproducible
    recipe, before = item
    system = _system(recipe.system)
    flow = recipe.fitted(system, None if before is None else before.bound(system), progress)
    recipe.judge(flow, system)
    return flow


@lru_cache(maxsize=1)
def _system(make: Callable[[], HamiltonianSystem]) -> HamiltonianSystem:
    """The system of a scene, which its recipes share."""
    return make()


def file_of(recipe: Recipe, folder: Path) -> Path:
    """The file of a recipe's flow."""
    return folder / f"{recipe.scene}-{recipe.name}.safetensors"


def scenes(recipes: Iterable[Recipe]) -> list[str]:
    """The names of the scenes."""
    return list(dict.fromkeys(recipe.scene for recipe in recipes))
