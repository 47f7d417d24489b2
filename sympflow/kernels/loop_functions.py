"""Compiled functions of splitting schemes on one system: generated code before a text of loops.

There is a maker for each way in which a system is given: by symbols, few terms or many, autonomous or driven; by Numba
functions; by one piece, as of lattices and pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.modules import (
    constants_source,
    elementary,
    load_algebra,
    load_around,
    load_module,
    template,
)
from sympflow.kernels.stages import (
    DampedDrift,
    Kick,
    TimeAlone,
    TimedNumbers,
    kicks_of,
    lanes_source,
    numbers_source,
    stages_source,
    step_constants,
    takes_values,
)
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL

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


def family_loops(
    system: HamiltonianSystem, friction: DampedDrift | None, level: int, compensated: bool, monomials: Monomials
) -> LoopFunctions:
    """The loops of a symbolic system of many terms, around loops over these: see `sympflow.kernels.terms`."""
    from sympflow.kernels.codegen import polynomial_slope_source
    from sympflow.kernels.terms import bend_source, gradient_source, product_source, warn_if_long

    symbols, driving = system.symbols, None
    assert symbols is not None
    if symbols.time is not None:
        from sympflow.kernels.stage_times import driven_form

        driving = driven_form(symbols)
        if driving.means:
            raise ValueError("`system` has many terms and a kinetic energy that depends on t: use backend='array'.")
        symbols = driving.form
    letters = symbols.parameters
    warn_if_long(symbols.V, symbols.q, system.name)
    sources = ["import numpy as np", _given_functions(level, bool(letters))]
    sources.append(gradient_source(symbols.V, symbols.q, "gradient", letters))
    if level in (FORCE_GRADIENT, CURVATURE):
        sources.append(product_source(symbols.V, symbols.q, "hessian_vector", letters))
    if level == CURVATURE:
        sources.append(bend_source(symbols.V, symbols.q, "bend", letters))
    if level == POLYNOMIAL:
        sources.append(polynomial_slope_source(symbols, monomials))
    M = system.inverse_mass
    if system.quadratic_kinetic and (M is None or M.ndim == 1):
        sources.append(_inverse_mass_source(M))
        sources.append("" if M is None else f"INVERSE_MASS = np.array({M.tolist()})")
    else:
        sources.append(gradient_source(symbols.T, symbols.p, "kinetic_gradient"))
        sources.append("@njit(**OPTIONS)\ndef apply_inverse_mass(v, out, work):\n    kinetic_gradient(v, out)")
    kinds = kicks_of(level, len(monomials))
    source, shared = _around_arrays(sources, symbols.ndof, kinds, compensated, friction, driving)
    return _array_functions(load_module(source, shared))


def _around_arrays(
    sources: Sequence[str],
    ndof: int,
    kinds: Sequence[Kick],
    compensated: bool,
    friction: DampedDrift | None = None,
    driving: TimedNumbers | None = None,
    cache: bool = True,
) -> tuple[str, list[str]]:
    """The source of loops around functions of a system whose states are arrays, and those that systems share."""
    of_states = [constants_source(COMPENSATED=compensated, NDOF=ndof)]
    of_states += map(template, ("array_states", "running_states"))
    shared, numbers = ["\n\n\n".join(of_states)], numbers_source(kinds, friction, 0, driving)
    own = [constants_source(cache, SCHEDULED=False, N_VALUES=0, DRIVEN=driving is not None), *sources]
    if driving is None:
        shared.append(f"{constants_source()}\n\n\n{numbers}")
    else:
        own.append(numbers)
    own += [stages_source(kinds, False, friction, 0, driving), *map(template, ("array_kicks", "loops"))]
    return "\n\n\n".join(own), [*elementary(*own), *shared]


_INVERSE_MASS_TIMES_V = {
    0: "out[i] = v[i]",
    1: "out[i] = INVERSE_MASS[i] * v[i]",
    2: "out[i] = 0.0\n        for j in range(NDOF):\n            out[i] += INVERSE_MASS[i, j] * v[j]",
}


def _inverse_mass_source(inverse_mass: np.ndarray | None) -> str:
    rows = _INVERSE_MASS_TIMES_V[0 if inverse_mass is None else inverse_mass.ndim]
    return f"@njit(**OPTIONS)\ndef apply_inverse_mass(v, out, work):\n    for i in range(NDOF):\n        {rows}"


def functions_of(level: int) -> tuple[str, ...]:
    """The functions of the system that kicks of a level call."""
    return ("gradient", "hessian_vector", "bend")[: 1 + {FORCE_GRADIENT: 1, CURVATURE: 2}.get(level, 0)]


def _given_functions(level: int, driven: bool, time_first: bool = False) -> str:
    """``gradient_at(q, numbers, out)`` and the others that the text `array_states` calls, by functions of a system.

    Those of a driven one take the letters of `numbers` after their arguments, or the time before them.
    """
    sources = []
    for name in functions_of(level):
        arguments = "q, out" if name == "gradient" else "q, v, out"
        call = f"{name}({arguments})"
        if driven:
            call = f"{name}(numbers[-1], {arguments})" if time_first else f"{name}({arguments}, numbers)"
        given = arguments.removesuffix("out") + "numbers, out"
        sources.append(f"@njit(**OPTIONS)\ndef {name}_at({given}):\n    {call}")
    return "\n\n\n".join(sources)


def _array_functions(module: ModuleType) -> LoopFunctions:
    names = ("rollout", "rollout_each", "rollout_processed", "rollout_processed_rows", "step_each")
    return LoopFunctions(*(getattr(module, name) for name in names))


def array_loops(
    ndof: int,
    gradient: Any,
    hessian_vector: Any | None,
    inverse_mass: np.ndarray | None,
    driven: bool,
    friction: DampedDrift | None,
    level: int,
    compensated: bool,
    monomials: Monomials,
) -> LoopFunctions:
    """The loops around the user's Numba functions; compiled for this process only."""
    sources = [_inverse_mass_source(inverse_mass), _given_functions(level, driven, time_first=True)]
    given = kicks_of(level), compensated, friction, TimeAlone() if driven else None
    source, shared = _around_arrays(sources, ndof, *given, cache=False)
    functions = {"INVERSE_MASS": inverse_mass, "gradient": gradient, "hessian_vector": hessian_vector}
    return _array_functions(load_around(source, shared, **functions))


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
