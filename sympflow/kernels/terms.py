"""Functions of many terms as code: a loop over the terms of each kind, in place of code for every one.

Pairs of bodies and springs of a chain differ in their coordinates and constants only. Written out, their derivatives
take Numba minutes; as tables of coordinates and constants, and one formula for each kind of term, a second or two
however many there are.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import sympy as sp

from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.kernels.codegen import statements

__all__ = [
    "bend_source",
    "families",
    "gradient_source",
    "is_large",
    "product_source",
    "warn_if_long",
    "written_out",
]

MOST_WRITTEN_OUT = 200  # operations of a gradient: longer ones take Numba more than a few seconds
MOST_IN_REGISTERS = 16  # degrees of freedom of states that are tuples of numbers
MOST_COMPILED = 5000  # operations of all formulas, before a warning
MOST_SEPARATE = 8  # slopes of a formula that have nothing in common
MOST_OPERATIONS = 300  # in one function of terms that stand alone


def is_large(symbols: SymbolicHamiltonian) -> bool:
    """True of a system whose terms are better looped over than written out."""
    return symbols.ndof > MOST_IN_REGISTERS or written_out(symbols.H, symbols.q + symbols.p) > MOST_WRITTEN_OUT


def written_out(f: sp.Expr, variables: Sequence[sp.Symbol]) -> int:
    """Operations of ∇f, roughly: those of each term as often as it has variables."""
    known = set(variables)
    return sum(sp.count_ops(term) * len(term.free_symbols & known) for term in sp.Add.make_args(f))


def warn_if_long(f: sp.Expr, variables: Sequence[sp.Symbol], name: str) -> None:
    """Warn of a function whose formulas, one for each kind of term, take Numba more than half a minute."""
    n = sum(sp.count_ops(family.f) * min(len(family.x), MOST_SEPARATE) for family in families(f, variables))
    if n > MOST_COMPILED:
        warnings.warn(
            f"`system` {name!r} has so many terms of different kinds, about {n:,} operations, that compiling takes "
            "minutes. Give it by Numba functions that loop over its terms: HamiltonianSystem(V, ndof=…, gradient=…, "
            "hessian_vector=…).",
            stacklevel=2,
        )


class Family(NamedTuple):
    """Terms Σ_n f(x = q[coordinates[n]], c = constants[n]).

    Attributes
    ----------
    f : Expr
        In the symbols x and c.
    x, c : tuple of Symbol
    coordinates : ndarray of int, shape (N, k)
    constants : ndarray of shape (N, m)
    """

    f: sp.Expr
    x: tuple[sp.Symbol, ...]
    c: tuple[sp.Symbol, ...]
    coordinates: np.ndarray
    constants: np.ndarray


def families(f: sp.Expr, variables: Sequence[sp.Symbol]) -> list[Family]:
    """The terms of f by their kinds; those of which there is one each, together, up to `MOST_OPERATIONS`."""
    place = {s: i for i, s in enumerate(variables)}
    members: dict[tuple[str, tuple[int, ...]], list[tuple[sp.Expr, _Tree, list[int]]]] = {}
    for term in _terms(f, set(variables)):
        tree = _tree(term, place)
        leaves = [place[s] for s in tree.leaves if s in place]
        coordinates = list(dict.fromkeys(leaves))
        members.setdefault((tree.text, tuple(map(coordinates.index, leaves))), []).append((term, tree, coordinates))
    found, alone = [], []
    for kind in members.values():
        if len(kind) == 1:
            alone.append(kind[0][0])
            continue
        _, tree, coordinates = kind[0]
        x = {variables[place]: sp.Symbol(f"x_{i}", real=True) for i, place in enumerate(coordinates)}
        constants = np.array([[float(leaf) for leaf in tree.leaves if leaf.is_Number] for _, tree, _ in kind])
        c = tuple(sp.Symbol(f"c_{i}", real=True) for i in range(constants.shape[1]))
        formula = tree.rebuilt(x, iter(c))
        found.append(Family(formula, (*x.values(),), c, np.array([places for *_, places in kind]), constants))
    return found + [_together(terms, variables) for terms in _chunks(alone)]


def _terms(f: sp.Expr, variables: set[sp.Symbol]) -> Iterator[sp.Expr]:
    """The terms that depend on the variables, those of a sum times a constant one by one."""
    for term in sp.Add.make_args(f):
        if not term.free_symbols & variables:
            continue
        moving = [a for a in sp.Mul.make_args(term) if a.free_symbols & variables]
        if len(moving) == 1 and moving[0].is_Add:
            factor = sp.Mul(*[a for a in sp.Mul.make_args(term) if a is not moving[0]])
            for part in _terms(moving[0], variables):
                yield factor * part
        else:
            yield term


def _chunks(terms: Sequence[sp.Expr]) -> Iterator[list[sp.Expr]]:
    chunk: list[sp.Expr] = []
    size = 0
    for term in terms:
        cost = sp.count_ops(term)
        if chunk and size + cost > MOST_OPERATIONS // 4:  # slopes are several times as long
            yield chunk
            chunk, size = [], 0
        chunk.append(term)
        size += cost
    if chunk:
        yield chunk


def _together(terms: Sequence[sp.Expr], variables: Sequence[sp.Symbol]) -> Family:
    """Terms as one that stands alone."""
    f = sp.Add(*terms)
    places = [i for i, s in enumerate(variables) if s in f.free_symbols]
    x = tuple(sp.Symbol(f"x_{i}", real=True) for i in range(len(places)))
    f = f.xreplace({variables[place]: s for place, s in zip(places, x, strict=True)})
    return Family(f, x, (), np.array([places]), np.zeros((1, 0)))


class _Tree(NamedTuple):
    """A term without the names of its coordinates and the values of its constants, which are the leaves in order.

    Sums and products are in an order that depends on neither.
    """

    text: str
    head: sp.Basic
    branches: tuple[_Tree, ...]
    leaves: tuple[sp.Basic, ...]

    def rebuilt(self, x: dict[sp.Symbol, sp.Symbol], c: Iterator[sp.Symbol]) -> sp.Expr:
        """The term in other coordinates, its constants replaced one after the other."""
        if self.branches:
            return self.head.func(*[branch.rebuilt(x, c) for branch in self.branches])
        if self.leaves and self.head.is_Number:
            return next(c)
        return x.get(self.head, self.head)


def _tree(f: sp.Basic, place: dict[sp.Symbol, int]) -> _Tree:
    if f in place:
        return _Tree("x", f, (), (f,))
    if not f.args:
        return _Tree(sp.srepr(f), f, (), ())
    if f.is_Add or f.is_Mul:
        branches = sorted((_constant(a) or _tree(a, place) for a in f.args), key=lambda tree: tree.text)
    elif f.is_Pow and f.exp.is_number:
        branches = [_tree(f.base, place), _Tree(sp.srepr(f.exp), f.exp, (), ())]
    else:
        branches = [_tree(a, place) for a in f.args]
    text = f"{type(f).__name__}({','.join(branch.text for branch in branches)})"
    return _Tree(text, f, tuple(branches), tuple(leaf for branch in branches for leaf in branch.leaves))


def _constant(f: sp.Basic) -> _Tree | None:
    return _Tree("c", f, (), (f,)) if f.is_Number and f != -1 else None


# derivatives as loops ---------------------------------------------------------------------------------------------


def gradient_source(f: sp.Expr, variables: Sequence[sp.Symbol], name: str, letters: Sequence[sp.Symbol] = ()) -> str:
    """``name(q, out)``: ∇f into out; with letters in f ``name(q, out, numbers)``, of which the last are theirs."""

    def slopes(family: Family) -> dict[str, sp.Expr]:
        return _each(_slopes(family.f, family.x))

    return _source(f, variables, name, "q, out", "out[:] = 0.0", slopes, letters=letters)


def product_source(f: sp.Expr, variables: Sequence[sp.Symbol], name: str, letters: Sequence[sp.Symbol] = ()) -> str:
    """``name(q, v, out)``: ∇²f v into out."""

    def product(family: Family) -> dict[str, sp.Expr]:
        return _each(_slopes(_along(family.f, family.x), family.x))

    return _source(f, variables, name, "q, v, out", "out[:] = 0.0", product, letters=letters)


def bend_source(f: sp.Expr, variables: Sequence[sp.Symbol], name: str, letters: Sequence[sp.Symbol] = ()) -> str:
    """``name(q, v, out)``: ½ ∇³f(v, v) into out."""

    def bend(family: Family) -> dict[str, sp.Expr]:
        return _each(_slopes(_along(_along(family.f, family.x), family.x) / 2, family.x))

    return _source(f, variables, name, "q, v, out", "out[:] = 0.0", bend, letters=letters)


def _slopes(f: sp.Expr, x: Sequence[sp.Symbol]) -> list[sp.Expr]:
    return [sp.diff(f, s) for s in x]


def _along(f: sp.Expr, x: Sequence[sp.Symbol]) -> sp.Expr:
    """The derivative of f along v."""
    return sp.Add(*[sp.Symbol(f"v_{j}", real=True) * sp.diff(f, s) for j, s in enumerate(x)])


def _each(values: Sequence[sp.Expr]) -> dict[str, sp.Expr]:
    return {f"out[i_{j}]": value for j, value in enumerate(values)}


def _source(
    f: sp.Expr,
    variables: Sequence[sp.Symbol],
    name: str,
    arguments: str,
    before: str,
    values: Callable[[Family], dict[str, sp.Expr]],
    after: str = "",
    letters: Sequence[sp.Symbol] = (),
) -> str:
    """A function that adds up the values of all terms, and one that it calls for each family."""
    parts, calls = [], []
    arguments += ", numbers" if letters else ""
    for k, family in enumerate(families(f, variables)):
        wanted = {target: value for target, value in values(family).items() if value != 0}
        if not wanted:
            continue
        one = f"{name}_{k}"
        n_terms, used = len(family.coordinates), set().union(*(value.free_symbols for value in wanted.values()))
        lines = [f"i_{j} = COORDINATES_{one.upper()}[n, {j}]" for j in range(len(family.x))]
        drawn = "".join(f"    {s} = numbers[{i - len(letters)}]\n" for i, s in enumerate(letters) if s in used)
        lines += [f"{s} = q[i_{j}]" for j, s in enumerate(family.x) if s in used]
        lines += [f"v_{j} = v[i_{j}]" for j in range(len(family.x)) if sp.Symbol(f"v_{j}", real=True) in used]
        lines += [f"{s} = CONSTANTS_{one.upper()}[n, {j}]" for j, s in enumerate(family.c) if s in used]
        lines += statements([f"d_{j}" for j in range(len(wanted))], list(wanted.values()))
        lines += [f"{target} += d_{j}" for j, target in enumerate(wanted)]
        returns = "total" in wanted
        parts.append(f"COORDINATES_{one.upper()} = np.array({family.coordinates.tolist()})")
        if any(s in used for s in family.c):
            parts.append(f"CONSTANTS_{one.upper()} = np.array({family.constants.tolist()})")
        body = "\n        ".join(lines)
        parts.append(
            f"@njit(**OPTIONS)\ndef {one}({arguments}):\n"
            + drawn
            + ("    total = 0.0\n" if returns else "")
            + f"    for n in range({n_terms}):\n        {body}"
            + ("\n    return total" if returns else "")
        )
        calls.append(f"total += {one}({arguments})" if returns else f"{one}({arguments})")
    whole = "\n    ".join([f"@njit(**OPTIONS)\ndef {name}({arguments}):", before, *calls, after or "return"])
    return "\n\n\n".join(["import numpy as np", *parts, whole])
