"""Functions of many terms as code: a loop over the terms of each kind, in place of code for every one.

Pairs of bodies and springs of a chain differ in their coordinates and constants only. Written out, their derivatives
take minutes to compile; as tables of coordinates and constants, and one formula for each kind of term, the same time
however many there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from sympflow.compiler import NotCompiled
from sympflow.compiler.arrange import Arrangement
from sympflow.compiler.control import INT, Rows, Value
from sympflow.compiler.functions import is_zero
from sympflow.compiler.program import Program, gradient, tangent, traced
from sympflow.hamiltonian.formulas import evaluator
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.lazy import kept
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

__all__ = ["Family", "Terms", "families", "is_large", "is_long", "written_out"]

MOST_WRITTEN_OUT = 200  # operations of a gradient
MOST_IN_REGISTERS = 16  # degrees of freedom of states that are tuples of numbers
MOST_COMPILED = 50_000  # operations of the slopes of all formulas, which take some ten seconds
MOST_TOGETHER = 75  # operations of terms that stand alone in one loop
MOST_OPERATIONS = 450  # of V, of which the slopes are written out


def is_large(symbols: SymbolicHamiltonian) -> bool:
    """True of a system whose terms are better looped over than written out."""
    return symbols.ndof > MOST_IN_REGISTERS or written_out(symbols.H, symbols.q + symbols.p) > MOST_WRITTEN_OUT


@kept
def is_long(symbols: SymbolicHamiltonian, level: int) -> bool:
    """True where kicks of a level have more operations than are written out, common subexpressions counted once."""
    known, operations, variables, terms = set(symbols.q), set(), 0, sp.Add.make_args(symbols.V)
    for term in terms:
        nodes = set(sp.preorder_traversal(term))
        variables += len(nodes & known)
        operations |= {node for node in nodes if node.args}
        if len(operations) > MOST_OPERATIONS:
            return True
    each = 4 * variables / len(terms)  # by how much a further derivative is longer
    return bool(len(operations) * each ** {FORCE_GRADIENT: 1, CURVATURE: 2}.get(level, 0) > MOST_OPERATIONS)


@lru_cache(maxsize=64)
def written_out(f: sp.Expr, variables: tuple[sp.Symbol, ...]) -> int:
    """Operations of ∇f, roughly: those of each term as often as it has variables."""
    known = set(variables)
    return sum(sp.count_ops(term) * len(term.free_symbols & known) for term in sp.Add.make_args(f))


class Family(NamedTuple):
    """Terms Σ_n f(x = q[coordinates[n]], c = constants[n]), f in the symbols x and c."""

    f: sp.Expr
    x: tuple[sp.Symbol, ...]
    c: tuple[sp.Symbol, ...]
    coordinates: np.ndarray
    constants: np.ndarray


def families(f: sp.Expr, variables: Sequence[sp.Symbol]) -> list[Family]:
    """The terms of f by their kinds; those of which there is one each, together, up to `MOST_TOGETHER`."""
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
        if chunk and size + cost > MOST_TOGETHER:
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
    """A term in an order without names of coordinates and values of constants, which are its leaves."""

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
        branches = sorted(
            (_Tree("c", a, (), (a,)) if a.is_Number and a != -1 else _tree(a, place) for a in f.args),
            key=lambda tree: tree.text,
        )
    elif f.is_Pow and f.exp.is_number:
        branches = [_tree(f.base, place), _Tree(sp.srepr(f.exp), f.exp, (), ())]
    else:
        branches = [_tree(a, place) for a in f.args]
    text = f"{type(f).__name__}({','.join(branch.text for branch in branches)})"
    return _Tree(text, f, tuple(branches), tuple(leaf for branch in branches for leaf in branch.leaves))


# derivatives as loops ---------------------------------------------------------------------------------------------


class Terms:
    """A function as the terms of each kind, with derivatives summed in loops over these; `parameters` are numbers.

    `data` has how many terms each kind has, then the coordinates and the constants of each kind.
    """

    def __init__(self, f: sp.Expr, variables: Sequence[sp.Symbol], parameters: Sequence[sp.Symbol] = ()) -> None:
        self._given = f, tuple(variables), tuple(parameters)
        self._families, self._parameters = families(f, variables), tuple(parameters)
        self.data = [np.array([len(family.coordinates) for family in self._families], dtype=np.int64)]
        for family in self._families:
            self.data += [family.coordinates.astype(np.int64), family.constants]

    def __reduce__(self) -> tuple[Any, ...]:
        return Terms, self._given

    def check(self) -> Terms:
        """The terms, refused where the formulas of all kinds have too many operations."""
        n = sum(4 * sp.count_ops(family.f) for family in self._families)
        if n > MOST_COMPILED:
            raise NotCompiled(
                f"`system` has so many terms of different kinds, about {n:,} operations, that it is not compiled. Give "
                "it by Numba functions that loop over its terms: HamiltonianSystem(V, ndof=…, gradient=…, "
                "hessian_vector=…), or use backend='array'."
            )
        return self

    @kept
    def derivatives(self, times: int, with_hessian: bool = False) -> list[Program]:
        """∇f, ∇²f v or ½ ∇³f(v, v) of a term of each kind, by the `times` along v, with their slopes if asked."""
        return [self._derived(family, times, with_hessian) for family in self._families]

    def _derived(self, family: Family, times: int, with_hessian: bool) -> Program:
        """∇f, that often differentiated along v, and divided by the factorial; with its own derivatives."""
        n, along = len(family.x), [f"v_{j}" for j in range(len(family.x) if times else 0)]
        given = (*family.x, *family.c, *self._parameters)

        def slopes(*numbers: Any) -> list[Any]:
            x, v, rest = numbers[:n], numbers[n : n + len(along)], numbers[n + len(along) :]
            slope = gradient(evaluator(dict(zip(given, (*x, *rest), strict=True)))(family.f), x)
            for k in range(times):
                slope = [y / (k + 1) for y in tangent(slope, x, v)]
            return [*slope, *(entry for s in slope for entry in gradient(s, x))] if with_hessian else slope

        names = [s.name for s in given]
        names[n:n] = along
        made = Arrangement([(name, 0) for name in names])
        found = traced(slopes, *names)(*made.states)
        return made.finish([made.written(made.number(y)) for y in found]).body

    def add(
        self,
        data: Sequence[Value],
        derivatives: Sequence[Program],
        given: Sequence[Rows],
        parameters: Sequence[Any],
        targets: Callable[[list[Value]], list[tuple[Rows, Value]]],
    ) -> None:
        """Add derivatives of the terms of each kind, at numbers of `given`, to ``targets(places)``."""
        code, type = given[0].code, given[0].type
        for k, (family, program) in enumerate(zip(self._families, derivatives, strict=True)):
            (coordinates, constants), n, m = data[1 + 2 * k :][:2], len(family.x), len(family.c)
            with code.over(code.load(data[0], k, INT)) as term:
                places = [code.load(coordinates, term * n + j, INT) for j in range(n)]
                values = [x[place] for x in given for place in places]
                values += [code.splat(code.load(constants, term * m + j), type.width) for j in range(m)]
                for (rows, place), y in zip(targets(places), program(*values, *parameters), strict=True):
                    if not is_zero(y):
                        rows[place] = rows[place] + y
