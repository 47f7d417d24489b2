"""Which flow `train` is to train: the one that is given, or a new one of the kind that its options describe."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import torch

from sympflow.flow.base import FlowMap
from sympflow.flow.mlp import MLPFlow, matching_widths
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.split import SplitFlow
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training import checkpoint as checkpoints
from sympflow.training.interruption import Interruption
from sympflow.training.recipes import BUDGET, PrimedRecipe, default_recipe
from sympflow.training.watch import Watch

KINDS = ("primed", "sympflow", "mlp")
OF_NETWORKS = ("pairs", "hidden", "activation")
OF_PRIMED = ("stages", "processor")
OF_SEARCHES = ("restarts", "frozen_weight", "energy_weight")
OF_LOSSES = ("residual_weight", "matching_weight", "label_weight", "matching_times")
OF_GRADIENTS = ("learning_rate", "schedule", "clip")
OF_FITS = ("steps", "points", "restarts", "label_times", "frozen_weight", "energy_weight", "loss", "data", *OF_LOSSES)
NOT_OF_SEARCHES = (*OF_GRADIENTS, "refresh", "validate_every", "validation_points", "checkpoint_every")


def kind_of(system: HamiltonianSystem, given: dict[str, Any]) -> str:
    """Of the flow that is given, or of the new one that the arguments of `train` describe; these are checked."""
    flow, kind = given["flow"], given["kind"]
    new = ("kind", *OF_PRIMED, *OF_NETWORKS, "dtype", "device")
    if flow is not None:
        if not isinstance(flow, FlowMap):
            raise TypeError(f"`flow` must be a SympFlow or an MLPFlow; got {flow!r}: leave it out for a new one.")
        for name in new:
            if given[name] is not None:
                raise ValueError(f"`{name}` describes a new flow, but `flow` is given: leave out one of them.")
        return "primed" if isinstance(flow, PrimedFlow) else "split" if isinstance(flow, SplitFlow) else flow.kind
    kind = _meant(system, given) if kind is None else kind
    if kind not in KINDS:
        raise ValueError(f"`kind` {kind!r} is unknown: choose one of {', '.join(KINDS)}.")
    for name in OF_NETWORKS if kind == "primed" else OF_PRIMED:
        if given[name] is not None:
            raise TypeError(f"`{name}` is not an option of flows of kind {kind!r}: leave it out.")
    if kind == "primed":
        _check_primable(system, given)
    return kind


def _check_primable(system: HamiltonianSystem, given: dict[str, Any]) -> None:
    """Raise if a new primed flow of the system cannot be made, or not be fitted by its optimizer."""
    named = " and ".join(f"`{name}`" for name in ("kind", *OF_PRIMED, *OF_SEARCHES) if given[name] is not None)
    needs = f"{named} asks for a flow primed with V and T"
    if not system.separable:
        raise ValueError(
            f"{needs}, but the system {system.name!r} has one function H, not known as T(p) + V(q): leave out {named} "
            "for a network, or define the system with HamiltonianSystem.from_sympy."
        )
    if not system.quadratic_kinetic and given["optimizer"] in (None, "gauss-newton"):
        raise ValueError(
            f"{needs}, whose table Gauss–Newton fits only where T = ½ pᵀM⁻¹p, as it is not in the system "
            f"{system.name!r}: leave out {named} for a network, or pass optimizer='bfgs'."
        )


def check_flow(flow: FlowMap, system: HamiltonianSystem, dt: float | None) -> None:
    if dt is not None and dt != flow.dt:
        raise ValueError(f"`dt` is {dt!r} but the flow has {flow.dt!r}: leave `dt` out to train it further.")
    flow.check_system(system)


def _meant(system: HamiltonianSystem, given: dict[str, Any]) -> str:
    """The architecture that is meant where none is named."""
    searched = [name for name in OF_SEARCHES if given[name] is not None]
    if searched and not (system.separable and system.quadratic_kinetic):
        raise ValueError(
            f"`{searched[0]}` is of the search for primed flows by Gauss–Newton, which needs H = ½ pᵀM⁻¹p + V(q); "
            f"{system.name!r} is of another form: leave it out for a network, or pass kind='primed', optimizer='bfgs'."
        )
    if options_given(given, (*OF_PRIMED, *OF_SEARCHES)):
        return "primed"
    fits = system.separable and system.quadratic_kinetic and system.symbols is not None
    of_networks = (*OF_NETWORKS, *NOT_OF_SEARCHES, *((*OF_LOSSES, "data") if given["loss"] is None else ()))
    wants_network = given["optimizer"] not in (None, "gauss-newton") or options_given(given, of_networks)
    return "primed" if fits and not wants_network else "sympflow"


def new_primed(
    system: HamiltonianSystem, domain: Domain, given: dict[str, Any], interruption: Interruption
) -> tuple[PrimedFlow, PrimedFlow | None]:
    """A new primed flow, and the one that was fitted in a trial if there were any; `given` are `train`'s arguments.

    Where these say nothing of the flow and its fit, it is one that `chosen_recipe` finds by trials; of a run to go on
    with, that one's, if it is one of those that are tried. Else what is not given is as `default_recipe` has it, Δt in
    proportion to the kicks.
    """
    dt, stages, processor, dtype = given["dt"], given["stages"], given["processor"], given["dtype"]
    dtype = torch.float64 if dtype is None else dtype
    untold = not options_given(given, ("dt", *OF_PRIMED, "dtype", "device"))
    if given["resume"] is not None and untold and _tried(system):
        recipe = _recipe_of_run(system, domain, given["resume"])
        if recipe is not None:
            return recipe.flow(system), None
    elif untold and _tried(system) and _fit_is_untold(given):
        from sympflow.training.trials import chosen_recipe

        watch = Watch(interruption, given["progress"])
        recipe = chosen_recipe(system, domain, watch)
        return recipe.flow(system), watch.flows.get(recipe)
    if system.separable and (dt is None or stages is None or processor is None):
        recipe = default_recipe(system, domain, dt)
        if dt is None:
            dt = recipe.dt if stages is None else float(f"{recipe.dt * stages / recipe.stages:.3g}")
        stages = recipe.stages if stages is None else stages
        processor = recipe.processor if processor is None else processor
    dt, processor = 1.0 if dt is None else float(dt), 0 if processor is None else processor
    flow = SympFlow.primed(system, stages, dt=dt, processor=processor, dtype=dtype, device=given["device"])
    return flow, None


def _tried(system: HamiltonianSystem) -> bool:
    """Whether trials apply to the system."""
    from sympflow.training.trials import MOST_NDOF

    return system.separable and system.quadratic_kinetic and system.symbols is not None and system.ndof <= MOST_NDOF


def _fit_is_untold(given: dict[str, Any]) -> bool:
    """Whether nothing is said of the fit of a new flow, and there is time for trials."""
    hurried = given["time_budget"] is not None and given["time_budget"] < BUDGET
    return not (hurried or given["optimizer"] not in (None, "gauss-newton") or options_given(given, OF_FITS))


def _recipe_of_run(system: HamiltonianSystem, domain: Domain, path: Any) -> PrimedRecipe | None:
    """The recipe of the flow in a checkpoint, if it is one of those that are tried."""
    from sympflow.training.trials import tried_recipes

    recipes, theirs = tried_recipes(system, domain), checkpoints.read(path)["architecture"]
    mine = (checkpoints.identity(recipe.flow(system), system, {})["architecture"] for recipe in recipes)
    return next((recipe for recipe, one in zip(recipes, mine, strict=True) if one == theirs), None)


def new_network(system: HamiltonianSystem, kind: str, dt: float, scaling: Scaling, given: dict[str, Any]) -> FlowMap:
    """A SympFlow with MLP potentials, or the baseline of as many parameters."""
    activation = "tanh" if given["activation"] is None else given["activation"]
    flow = SympFlow(
        system.ndof,
        3 if given["pairs"] is None else given["pairs"],
        (10, 10) if given["hidden"] is None else given["hidden"],
        activation,
        dt,
        torch.float64 if given["dtype"] is None else given["dtype"],
        given["device"],
        given["seed"],
        scaling,
    )
    if kind != "mlp":
        return flow
    if matching_widths(flow.ndof, flow.n_parameters) is None:
        raise ValueError(
            f"`hidden` and `pairs` describe a SympFlow of only {flow.n_parameters} parameters, which no "
            "MLPFlow matches within 2 %: give wider layers or more pairs."
        )
    return MLPFlow.matching(flow, given["seed"], scaling, activation)


def options_given(given: dict[str, Any], names: Sequence[str]) -> list[str]:
    """Those of the named arguments of `train` that have another value than their default."""
    from sympflow.training.trainer import train

    defaults = inspect.signature(train).parameters
    return [
        name for name in names if given[name] is not defaults[name].default and given[name] != defaults[name].default
    ]


def refuse_options(given: dict[str, Any], names: Sequence[str], what: str) -> None:
    for name in options_given(given, names):
        raise TypeError(f"`{name}` is not an option of the {what}: leave it out.")
