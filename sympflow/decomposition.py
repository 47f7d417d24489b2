"""H as a sum of parts that are solved exactly: found in its terms, or given."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sympflow.linear_part import LinearPart, linear_part, read_off
from sympflow.parts import LINEAR, ExactParts, PartFunctions, RestOfPotential
from sympflow.symbolic import SymbolicHamiltonian, parse

if TYPE_CHECKING:
    import sympy as sp

    from sympflow.system import HamiltonianSystem


def linear_and_rest(system: HamiltonianSystem) -> ExactParts:
    """The linear part and U(q), for the kicks and exact linear flows of Nyström splittings.

    Raises
    ------
    ValueError
        If the system has no linear part, or more than a potential beside it.
    """
    linear = system.linear_part
    parts = exact_parts(system)
    if any(not functions.of_positions for functions in parts.rest) or len(parts.rest) > 1:
        raise ValueError(
            f"`system` {system.name!r} has {len(parts)} parts, not just a linear one and U(q): use 'strang_parts'."
        )
    return ExactParts(linear, parts.rest, system.ndof)


def exact_parts(system: HamiltonianSystem, expressions: Sequence[str] | None = None) -> ExactParts:
    """H as a sum of parts that are solved exactly.

    Parameters
    ----------
    system : HamiltonianSystem
        Symbolic, or given by functions with a `stiffness_matrix`.
    expressions : sequence of str, optional
        The parts, in the symbols of the system, in the order of the splitting, the last innermost. The default is as
        few as the terms of H allow, potentials first, and at the end the linear part, if there is one.

    Raises
    ------
    ValueError
        If a part is not solved exactly, or the parts do not add up to H.
    """
    if system.symbols is None:
        if expressions is not None:
            raise ValueError("`parts` are read as symbols, which the system has not: define it with from_sympy.")
        linear = system.linear_part
        return ExactParts(linear, [RestOfPotential(system, linear)], system.ndof)
    if expressions is None:
        return _detected(system)
    return _given(system, tuple(expressions))


def _detected(system: HamiltonianSystem) -> ExactParts:
    import sympy as sp

    symbols = system.symbols
    assert symbols is not None
    try:
        linear = linear_part(system)
        rest = linear.potential
        assert rest is not None
    except ValueError:
        linear, rest = None, symbols.H
    if _groups(rest, symbols) is None:
        rest = sp.expand(rest)
    groups = _groups(rest, symbols)
    if groups is None:
        raise ValueError(
            f"`system` {system.name!r} does not split into parts that are solved exactly: a term holds a coordinate "
            "and its momentum. Use an implicit or a Runge–Kutta method, or train a SympFlow."
        )
    rest = [PartFunctions(g, symbols.q, symbols.p) for g in groups]
    return ExactParts(linear, sorted(rest, key=lambda part: not part.of_positions), system.ndof)


def _groups(H: sp.Expr, symbols: SymbolicHamiltonian) -> list[sp.Expr] | None:
    """The terms of H in as few groups without conjugate pairs as come about greedily, or None."""
    import sympy as sp

    groups: list[tuple[set[sp.Symbol], list[sp.Expr]]] = []
    terms = [t for t in sp.Add.make_args(H) if t.free_symbols]
    for term in sorted(terms, key=lambda t: -len(t.free_symbols)):
        if _has_pair(term.free_symbols, symbols):
            return None
        for variables, members in groups:
            if not _has_pair(variables | term.free_symbols, symbols):
                variables.update(term.free_symbols)
                members.append(term)
                break
        else:
            groups.append((set(term.free_symbols), [term]))
    return [sp.Add(*members) for _, members in groups]


def _has_pair(variables: set[sp.Symbol], symbols: SymbolicHamiltonian) -> bool:
    return any(q in variables and p in variables for q, p in zip(symbols.q, symbols.p, strict=True))


def _given(system: HamiltonianSystem, expressions: tuple[str, ...]) -> ExactParts:
    import sympy as sp

    symbols = system.symbols
    assert symbols is not None
    parts = [_parsed(expression, system) for expression in expressions]
    difference = sp.expand(sp.Add(*parts) - symbols.H)
    probes = np.random.default_rng(0).uniform(0.3, 0.9, (8, 2 * system.ndof))
    H = PartFunctions(symbols.H, symbols.q, symbols.p).hamiltonian(probes)
    with np.errstate(all="ignore"):
        excess = PartFunctions(difference, symbols.q, symbols.p).hamiltonian(probes) if difference.free_symbols else 0.0
    if not np.allclose(np.ptp(excess), 0, atol=1e-12 * np.abs(H).max()):
        raise ValueError(f"`parts` do not add up to the Hamiltonian: they leave out {-difference}.")
    linear: LinearPart | None = None
    rest: list[PartFunctions] = []
    sequence = []
    for expression, part in zip(expressions, parts, strict=True):
        if not _has_pair(part.free_symbols, symbols):
            rest.append(PartFunctions(part, symbols.q, symbols.p))
            sequence.append(len(rest))
            continue
        candidate = read_off(part, symbols.q, symbols.p, abs(system.t_span[1] - system.t_span[0]))
        if linear is not None or candidate is None or getattr(candidate.potential, "free_symbols", None):
            raise ValueError(
                f"`parts` has {expression!r}, which is not solved exactly: it holds a coordinate and its momentum and "
                "is not the one quadratic part. Split it further."
            )
        linear = candidate
        sequence.append(LINEAR)
    return ExactParts(linear, rest, system.ndof, sequence)


def _parsed(expression: str, system: HamiltonianSystem) -> sp.Expr:
    """A part in the symbols q1 … pd of the system."""
    assert system.symbols is not None
    if not isinstance(expression, str):
        raise ValueError(f"`parts` must be expressions as text; got {expression!r}.")
    words = set(re.findall(r"[A-Za-z_]\w*", expression))
    try:
        part = parse(expression, {name: value for name, value in system.params.items() if name in words})
    except (ValueError, TypeError) as error:
        raise ValueError(f"`parts` has one that is not admissible: {error}") from None
    known = {s.name for s in (*system.symbols.q, *system.symbols.p)} | {"q", "p"}
    if foreign := {s.name for s in part.free_symbols} - known:
        raise ValueError(f"`parts` has {', '.join(sorted(foreign))}, which the system has not: leave it out.")
    first = {"q": system.symbols.q[0], "p": system.symbols.p[0]}
    return part.xreplace({s: first[s.name] for s in part.free_symbols if s.name in first})
