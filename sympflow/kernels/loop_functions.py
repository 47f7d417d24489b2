"""Compiled functions of splitting schemes on one system: generated code before a text of loops.

There is a maker for each way in which a system is given: by symbols, few terms or many, autonomous or driven; by Numba
functions; by one piece, as of lattices and pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.modules import (
    constants_source,
    load_algebra,
    template,
)
from sympflow.kernels.stages import (
    DampedDrift,
    Kick,
    kicks_of,
    lanes_source,
    numbers_source,
    stages_source,
    step_constants,
    takes_values,
)
from sympflow.schemes import CURVATURE, POLYNOMIAL

if TYPE_CHECKING:
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
    from sympflow.kernels.approximations import Ranges
    from sympflow.kernels.sized_loops import SizedLoops
    from sympflow.kernels.stage_times import Driving


@dataclass(frozen=True)
class LoopFunctions:
    """The compiled functions of one variant (what kicks have, with or without compensated sums)."""

    rollout: Callable[..., int]
    rollout_batch: Callable[..., None]
    rollout_processed: Callable[..., int]
    rollout_processed_batch: Callable[..., None]
    step_rows: Callable[..., None]


def symbolic_loops(
    symbols: SymbolicHamiltonian,
    friction: DampedDrift | None,
    level: int,
    compensated: bool,
    monomials: Monomials,
    varied: bool = False,
    ranges: Ranges | None = None,
) -> LoopFunctions:
    """The loops of an autonomous symbolic system of few terms; parameters are numbers where `takes_values`."""
    from sympflow.kernels.codegen import algebra_source

    if varied or (friction is None and takes_values(level)):
        symbols = symbols.parametric
    algebra = algebra_source(symbols)
    after = ("loops", "lanes")
    loops = symbolic_module(
        symbols, algebra, level, compensated, after, monomials, friction, varied=varied, ranges=ranges
    )
    processed = loops.rollout_processed, loops.rollout_processed_rows
    return LoopFunctions(loops.rollout, loops.rollout_lanes, *processed, loops.step_lanes)


def driven_loops(
    driving: Driving,
    friction: DampedDrift | None,
    level: int,
    compensated: bool,
    monomials: Monomials,
    varied: bool = False,
) -> LoopFunctions:
    """The loops of a symbolic system whose H depends on t; single steps, each at a time of its own, without lanes."""
    from sympflow.kernels.codegen import algebra_source

    form, after = driving.form, ("loops", "lanes")
    algebra = algebra_source(form)
    loops = symbolic_module(form, algebra, level, compensated, after, monomials, friction, driving, varied)
    processed = loops.rollout_processed, loops.rollout_processed_rows
    return LoopFunctions(loops.rollout, loops.rollout_lanes, *processed, loops.step_each)


def symbolic_module(
    symbols: SymbolicHamiltonian,
    algebra: str,
    level: int,
    compensated: bool,
    after: Sequence[str],
    monomials: Monomials = (),
    friction: DampedDrift | None = None,
    driving: Driving | None = None,
    varied: bool = False,
    ranges: Ranges | None = None,
) -> ModuleType:
    """The algebra of a symbolic system, its kicks and the texts of loops `after` them, as a module.

    In `varied` ones each lane has its own values of the parameters. For `ranges` see `SplittingLoops.functions`.
    """
    from sympflow.kernels.kicks import kicks_source

    kinds, scheduled = kicks_of(level, len(monomials)), not compensated
    n, n_values = len(symbols.parameters), len(symbols.values) if varied else 0
    sources = [algebra] if driving is None else [algebra, numbers_source(kinds, friction, n, driving)]
    joined = ranges is not None and scheduled and friction is None and symbols.inverse_mass is not None
    sources.append(stages_source(kinds, scheduled, friction, n, driving, joined))
    sources.append(lanes_source(kinds, scheduled, friction, n, varied, driving))
    if scheduled:
        sources.append(kicks_source(symbols, level, monomials, varied=varied, ranges=ranges or (), joined=joined))
    else:
        sources += plain_kicks_source(symbols, level, monomials)
    shared = shared_by_lanes(symbols.ndof, kinds, friction, n, compensated, n_values)
    shared = shared if driving is None else shared[:1]
    constants = {"SCHEDULED": scheduled, "DRIVEN": driving is not None}
    return load_algebra("\n\n\n".join(sources), after, shared, **constants)


def shared_by_lanes(
    ndof: int, kinds: Sequence[Kick], friction: DampedDrift | None, n_parameters: int, compensated: bool, n_values: int
) -> list[str]:
    """The sources of the texts `loops` and `lanes` that systems share: of states of this size; of kicks of one kind."""
    numbers = [numbers_source(kinds, friction, n_parameters), template("lane_numbers")]
    of_kicks = [constants_source(**step_constants(kinds)), *numbers]
    return [states_source(ndof, compensated, n_values), "\n\n\n".join(of_kicks)]


def states_source(ndof: int, compensated: bool = False, n_values: int = 0) -> str:
    """The source of states that are tuples, one by one and in lanes, which systems share."""
    from sympflow.kernels.codegen import tuple_algebra

    constants = constants_source(COMPENSATED=compensated, NDOF=ndof, N_VALUES=n_values)
    texts = map(template, ("running_states", "aligned", "lane_blocks"))
    return "\n\n\n".join([constants, tuple_algebra(ndof), *texts])


def plain_kicks_source(symbols: SymbolicHamiltonian, level: int, monomials: Monomials) -> list[str]:
    """The kicks of a level, beside that of the algebra, where they are not scheduled."""
    from sympflow.kernels.codegen import curvature_kick_source, gradient_kick_source, polynomial_kick_source

    if level == POLYNOMIAL:
        return [polynomial_kick_source(symbols, monomials)]
    sources = [gradient_kick_source(symbols)] if level else []
    return [*sources, curvature_kick_source(symbols)] if level == CURVATURE else sources


def _lattice_loops(system: HamiltonianSystem, level: int, compensated: bool) -> SizedLoops:
    """The loops of a lattice, of which only the structure, and not the size, is part of the code."""
    from sympflow.hamiltonian.lattice import LatticeHamiltonian
    from sympflow.kernels.lattice_loops import LatticeLoops

    assert isinstance(system.local, LatticeHamiltonian)
    return LatticeLoops(system.local, level, compensated, system.friction is not None)


LOCAL: dict[str, Callable[..., SizedLoops]] = {"lattice": _lattice_loops}
"""Makers of the loops of systems that are given by one piece."""


def local_loops(system: HamiltonianSystem, level: int, compensated: bool, monomials: Monomials) -> LoopFunctions:
    """The loops of a system that is given by one piece."""
    assert system.local is not None
    loops = LOCAL[system.local.loops](system, level, compensated)
    processed = loops.rollout_processed, loops.rollout_processed_batch
    return LoopFunctions(loops.rollout, loops.rollout_batch, *processed, loops.step_rows)
