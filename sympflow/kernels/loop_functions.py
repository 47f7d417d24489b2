"""Generated code of splitting schemes before a text of loops: of lattices, parts and GPUs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.modules import (
    constants_source,
    template,
)

if TYPE_CHECKING:
    from sympflow.kernels.sized_loops import SizedLoops


@dataclass(frozen=True)
class LoopFunctions:
    """The compiled functions of one variant (what kicks have, with or without compensated sums)."""

    rollout: Callable[..., int]
    rollout_batch: Callable[..., None]
    rollout_processed: Callable[..., int]
    rollout_processed_batch: Callable[..., None]
    step_rows: Callable[..., None]


def states_source(ndof: int, compensated: bool = False, n_values: int = 0) -> str:
    """The source of states that are tuples, one by one and in lanes, which systems share."""
    from sympflow.kernels.codegen import tuple_algebra

    constants = constants_source(COMPENSATED=compensated, NDOF=ndof, N_VALUES=n_values)
    texts = map(template, ("running_states", "aligned", "lane_blocks"))
    return "\n\n\n".join([constants, tuple_algebra(ndof), *texts])


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
