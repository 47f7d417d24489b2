"""Splitting methods on bodies that interact in pairs: forces of any potential of one pair, over traced numbers.

A few bodies are a symbolic system whose pairs are written out. Of more, states stand in memory, and one body meets a
register of others at a time; with a cut-off bodies are sorted into cells, and each meets those of the cells around its
own. Each pair is met once: its force is added to one body and taken from the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import sympy as sp

from sympflow.compiler.arrange import Arranged, Arrangement
from sympflow.compiler.control import INT, POINTER, Code, Rows, Type, Value, assign
from sympflow.compiler.functions import apply, fma, summed
from sympflow.compiler.machine import address
from sympflow.hamiltonian.bodies import PairsHamiltonian
from sympflow.hamiltonian.formulas import evaluator
from sympflow.kernels.array_splittings import ARRAYS, ArrayCode, Forces, FunctionSplitting
from sympflow.kernels.cells import MOST_RANGES, Cells, most_along, most_cells
from sympflow.kernels.rollouts import aligned, zeros
from sympflow.kernels.runs import Numbers, Room, Values, begun, finished
from sympflow.kernels.splittings import Shape, Splitting, Stage
from sympflow.kernels.teams import Member, SharedMemory, SharedRollouts, meet
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

if TYPE_CHECKING:
    from sympflow.hamiltonian.monomials import Monomials

__all__ = ["PairCode", "PairForces", "few"]

KINDS = {"gradient": (1,), "hessian_vector": (1, 2), "third_derivative": (2, 3)}
"""The derivatives of V by s that are in ∇V, ∇²V·v and ½ ∇³V(v, v)."""
SHIFT = 3
LANES = 1 << SHIFT
"""Bodies that one meets at a time."""
CHUNKS, WORTH_CHUNKS = 8, 100_000
"""Chunks of a sum, which threads share, and about how many nanoseconds a sum takes from which there are more than one:
threads wait for each other after each sum."""


def slopes_of(local: PairsHamiltonian, kinds: Sequence[int]) -> Arranged:
    """The derivatives of V by s, with factors 2ᵏ: a program of s, columns of both bodies, constants."""
    states = [(local.s.name, 0), *((a.name, -40) for a in local.first), *((b.name, -20) for b in local.second)]
    made = Arrangement(states, [c.name for c in local.c])
    symbols = (local.s, *local.first, *local.second, *local.c)
    value = evaluator(dict(zip(symbols, (*made.states, *made.constants), strict=True)))
    return made.finish([made.written(made.number(value(local.slopes[k]))) for k in kinds])


class Pair(NamedTuple):
    """A body and its partners: the differences d of positions and u of velocities, and the derivatives of V."""

    d: list[Value]
    u: list[Value]
    g: list[Value]


class PairLaw:
    """The forces of one pair, of one kind of sum, with these derivatives of V."""

    def __init__(self, local: PairsHamiltonian, kinds: Sequence[int]) -> None:
        self.columns = len(local.first)
        self.dim, self.cut, self.periodic = local.dim, local.cutoff is not None, local.box is not None
        self.program = slopes_of(local, kinds)
        self.n_numbers = 2 + 2 * local.dim + len(self.program.table.outputs)
        self._local = local

    def numbers(self) -> np.ndarray:
        """ε², the largest s, the sides of the box and their inverses, and what the derivatives need."""
        local = self._local
        end = math.inf if local.cutoff is None else local.cutoff**2 + local.softening**2
        box = np.zeros(local.dim) if local.box is None else local.box
        inverse = np.zeros(local.dim) if local.box is None else 1 / local.box
        return np.array([local.softening**2, end, *box, *inverse, *self.program.table(*local.constants)])

    def met(self, numbers: Values, own: Values, other: Values, columns: Values, inside: Value | None = None) -> Pair:
        """A body with positions, and velocities behind them, and its partners, which are `inside`; 0 for others."""
        code, dim = own[0].code, self.dim
        softening, end, rest = numbers[0], numbers[1], numbers[2 + 2 * dim :]
        d, u = ([a - b for a, b in zip(own[k:][:dim], other[k:][:dim], strict=True)] for k in (0, dim))
        if self.periodic:
            box, inverse = numbers[2:][:dim], numbers[2 + dim :][:dim]
            d = [
                x - side * code.apply("floor", (code.fma(x, over, code.operand(0.5, x.type)),))
                for x, side, over in zip(d, box, inverse, strict=True)
            ]
        s = summed(softening, d, d)
        if self.cut:
            inside = s < end if inside is None else inside & (s < end)
        g = self.program.body(s, *columns, *rest)
        if inside is not None:
            g = [code.apply("where", (inside, code.operand(x, s.type), 0.0)) for x in g]
        return Pair(d, u, g)


def parts(kind: str, d: Sequence[Any], u: Sequence[Any], g: Sequence[Any]) -> list[tuple[Any, Sequence[Any]]]:
    """Factors of vectors, whose sum is the part of a pair in the sum of its first body: see `Pair`."""
    if kind == "gradient":
        return [(g[0], d)]
    e = summed(0.0, d, u)
    if kind == "hessian_vector":
        return [(g[1] * e, d), (g[0], u)]
    return [(0.5 * fma(g[1] * e, e, g[0] * summed(0.0, u, u)), d), (g[0] * e, u)]


def with_parts(total: Any, parts: Sequence[tuple[Any, Sequence[Any]]], axis: int, sign: float = 1.0) -> Any:
    """A sum with the part of a pair along an axis."""
    return summed(total, (factor if sign > 0 else -factor for factor, _ in parts), (x[axis] for _, x in parts))


# a few bodies: their pairs written out ------------------------------------------------------------------------------


class FewSymbols:
    """A few bodies in the place of a symbolic Hamiltonian, whose parameters are all that a pair depends on."""

    H = T = None
    samples: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, local: PairsHamiltonian) -> None:
        named = local.parameter_values({})
        self.local, self.ndof = local, local.ndof
        self.values, self.parameters = tuple(named.values()), tuple(map(sp.Symbol, named))
        self.q, self.p = (tuple(sp.Symbol(f"{x}{i + 1}") for i in range(self.ndof)) for x in "qp")
        self.inverse_mass = sp.diag(*(sp.Symbol(f"w_{i // local.dim}") for i in range(self.ndof)))

    @property
    def parametric(self) -> FewSymbols:
        return self

    @cached_property
    def V(self) -> sp.Expr:
        local, number = self.local, sp.Symbol
        columns = [[number(f"column_{c}_{i}") for i in range(local.n_bodies)] for c in range(len(local.columns))]
        box = [number(f"box_{k}") for k in range(0 if local.box is None else local.dim)]
        return local.written_potential(self.q, number("softening"), columns, {c: number(c.name) for c in local.c}, box)


def few(local: PairsHamiltonian) -> tuple[Callable[..., Splitting] | None, tuple[float, ...]]:
    """The splitting of a few bodies, None of more, and the values that it reads."""
    if not local.is_few:
        return None, ()
    symbols = FewSymbols(local)
    return partial(FewSplitting, symbols), symbols.values


@dataclass(frozen=True)
class FewSplitting(Splitting):
    """The kicks and drifts of a few bodies."""

    symbols: FewSymbols
    polynomial = False

    @property
    def key(self) -> tuple[Any, ...]:
        local = self.symbols.local
        pair = local.V, local.first, local.c, local.cutoff is None, local.box is None
        return *pair, local.n_bodies, local.dim, self.level, self.compensated, self.friction

    def _arranged(self, terms: int) -> Stage:
        return FewShape(self, terms, True).arranged()[1]


class FewShape(Shape):
    """A stage of a few bodies: both of a pair share its square root, its division and all else."""

    @property
    def _local(self) -> PairsHamiltonian:
        assert isinstance(self.symbols, FewSymbols)
        return self.symbols.local

    def _kicked(self) -> list[Any]:
        return self._moved([self.made.node(p) for p in self.p])

    def _changes(self) -> list[Any]:
        return [self.made.letter(x) for x in self._moved([0.0] * self.d)]

    def _moved(self, momenta: list[Any]) -> list[Any]:
        """Momenta, numbers of the body, after the kick."""
        made = self.made
        b, *more = (self.number[name] for name in self.splitting.kick_numbers)
        if self.terms == 1:
            return self._sum("gradient", [], momenta, -b)
        nothing: list[Any] = [0.0] * self.d

        def moved(by: Any, x: Sequence[Any]) -> list[Any]:
            return [fma(made.written(by), a, p) for a, p in zip(x, momenta, strict=True)]

        slope = self._sum("gradient", [], nothing)
        momenta = moved(-b, slope)
        v = self._velocities(slope)
        product = self._sum("hessian_vector", v, nothing)
        momenta = moved(more[0], product)
        if self.terms > 2:
            third = self._sum("third_derivative", v, self._sum("hessian_vector", self._velocities(product), nothing))
            momenta = moved(-more[1], third)
        return momenta

    def _velocities(self, x: Sequence[Any]) -> list[Any]:
        return [self.made.written(y) for y in self._by_mass([self.made.letter(y) for y in x])]

    def _sum(self, kind: str, v: Sequence[Any], start: Sequence[Any], factor: Any = None) -> list[Any]:
        """A sum over all pairs of numbers of the body, behind others, of a kind of `KINDS` along v."""
        dim, total = self._local.dim, list(start)
        for (i, j), (d, s) in self._pairs.items():
            g = [self._slope(i, j, s, k, factor) for k in KINDS[kind]]
            of_pair = parts(kind, d, [v[dim * i + k] - v[dim * j + k] for k in range(dim if v else 0)], g)
            for k in range(dim):
                total[dim * i + k] = with_parts(total[dim * i + k], of_pair, k)
                total[dim * j + k] = with_parts(total[dim * j + k], of_pair, k, -1.0)
        return total

    @cached_property
    def _pairs(self) -> dict[tuple[int, int], tuple[list[Any], Any]]:
        """The differences of the coordinates of each two bodies, and s."""
        local, made = self._local, self.made
        pairs = {}
        for i in range(local.n_bodies):
            for j in range(i + 1, local.n_bodies):
                d = [made.written(self.q[local.dim * i + k] - self.q[local.dim * j + k]) for k in range(local.dim)]
                if local.box is not None:
                    for k, x in enumerate(map(made.letter, d)):
                        image = apply("floor", self.number[f"over_box_{k}"] * x + 0.5)
                        d[k] = made.written(x - self.number[f"box_{k}"] * image)
                pairs[i, j] = d, summed(made.written(self.number["softening"]), d, d)
        return pairs

    def _slope(self, i: int, j: int, s: Any, kind: int, factor: Any) -> Any:
        """A derivative of V by s, times a factor."""
        local, made = self._local, self.made
        columns = [self.number[f"column_{c}_{body}"] for body in (i, j) for c in range(len(local.columns))]
        letter = made.letter(s)
        symbols = (local.s, *local.first, *local.second, *local.c)
        values = (letter, *columns, *(self.number[c.name] for c in local.c))
        slope = evaluator(dict(zip(symbols, values, strict=True)))(local.slopes[kind])
        slope = made.written(slope if factor is None else factor * slope)
        if local.cutoff is None:
            return slope
        return apply("where", s < made.written(self.number["end"]), slope, 0.0)


# more bodies than a few: states in memory ---------------------------------------------------------------------------

FIELDS = [
    *("bodies", "size", "chunks", "member", "members", "sites", "numbers", "work", "sorted", "order", "cells"),
    *("most_cells", "sums", "turn", "meeting", "stop", "block"),
]
"""Numbers of a context: sizes, addresses, the sums that are in turn, and the steps between two looks."""
_LANES = Type("double", LANES)


def field(context: Value, name: str) -> Value:
    return context.code.load(context, FIELDS.index(name), INT)


def place(context: Value, name: str) -> Value:
    return context.code.address(field(context, name))


class BodiesInMemory(SharedMemory):
    """A state as arrays (sets, dim, size) of q, p and, compensated, their errors."""

    def __init__(self, dim: int, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._dim = dim

    def block(self, every: int) -> Value:
        return field(self._context, "block")

    def copied(self, room: Room, rows: Value, row: Value, sets: int, loads: bool) -> None:
        code, n, size = self.code, field(self._context, "bodies"), field(self._context, "size")
        start = code.at(rows, row * (n * (sets * self._dim)))
        writes = code.apply("eq", (field(self._context, "member"), 0))  # which one thread does
        for s in range(sets):
            with code.over(n) as i, nullcontext() if loads else code.given(writes):
                for k in range(self._dim):
                    at, place = size * (s * self._dim + k) + i, (n * s + i) * self._dim + k
                    if loads:
                        code.store(code.load(start, place), room.place, at)
                    else:
                        code.store(code.load(room.place, at), start, place)


class PairSums(Forces):
    """The code of sums over all pairs, of velocities, of stages: a `Room` is as wide as the bodies that one meets."""

    def __init__(self, local: PairsHamiltonian, level: int, compensated: bool, damped: bool) -> None:
        super().__init__(None)
        self.dim, self.columns, self.data = local.dim, len(local.first), []
        self.splitting = FunctionSplitting(level, (), compensated, 0 if damped else None)
        self._stages = ArrayCode(self.splitting, self)
        kinds = tuple(KINDS)[: len(self.splitting.terms)]
        self.laws = {kind: PairLaw(local, KINDS[kind]) for kind in kinds}
        self.cells = None if local.cutoff is None else Cells(local.dim, local.box is not None)

    def numbers(self) -> np.ndarray:
        """The numbers of all laws."""
        return np.concatenate([law.numbers() for law in self.laws.values()])

    def stage(self, context: Value, state: Value, kind: Value, numbers: Sequence[Value]) -> None:
        """A kick, plain (1), with a force gradient (2) or with curvature terms too (3), or none (0); and a drift."""
        state.code.outlined("stage", (state, context, kind, *numbers), self._stage)

    def _stage(self, state: Value, context: Value, kind: Value, *numbers: Value) -> None:
        code, column = state.code, [state.code.splat(x, LANES) for x in numbers]
        blocks = (field(context, "size") * (self.dim * (4 if self.splitting.compensated else 2))) >> SHIFT
        room = Room(state, LANES, place(context, "work"), blocks, context)
        for k, terms in enumerate(self.splitting.terms):
            with code.given(code.apply("eq", (kind, k + 1))):
                self._stages.kicked(room, terms, column)
        self._stages.drifted(room, column)

    def velocity(self, room: Room, p: Rows, out: Rows, d: Value, coefficients: Sequence[Any]) -> None:
        code, sites, count = room.code, place(room.places, "sites"), field(room.places, "size") >> SHIFT
        with code.over(count) as i:
            w = code.load(sites, i << SHIFT, _LANES)
            for k in range(self.dim):
                at = count * k + i
                out[at] = w * p[at]

    def sum(
        self, order: int, room: Room, given: Sequence[Rows], out: Rows, d: Value, coefficients: Sequence[Any]
    ) -> None:
        kind = tuple(KINDS)[order]
        room.code.outlined(f"sum_{kind}", (room.places, room.place, given[-1].place, out.place), self._sum(kind))

    @contextmanager
    def _blocks(self, size: Value) -> Iterator[Value]:
        with size.code.over(size >> SHIFT) as k:
            yield k << SHIFT

    # a sum ------------------------------------------------------------------------------------------------------------

    def _sum(self, kind: str) -> Callable[[Value, Value, Value, Value], None]:
        """The sum over all pairs, of this thread's chunks and, when all threads are here, of all chunks."""

        def summed_up(context: Value, state: Value, along: Value, out: Value) -> None:
            code, dim = state.code, self.dim
            n, size, chunks, member, members = (field(context, name) for name in FIELDS[:5])
            rows = self._rows(kind, context, state, along)
            turn = code.constant(1, INT) - field(context, "turn")
            code.store(turn, context, FIELDS.index("turn"))
            sums = code.at(place(context, "sums"), turn * (chunks * (size * dim)))
            begin, end = (code.op("sdiv", INT, chunks * m, members) for m in (member, member + 1))
            with code.over(end - begin) as k:
                chunk = begin + k
                F = code.at(sums, chunk * (size * dim))
                with self._blocks(size * dim) as i:
                    code.store(code.constant(0.0, _LANES), F, i)
                self._chunk(kind, context, rows, F, chunk, chunks, n)
            meet(field(context, "meeting"), members, field(context, "stop"))
            order = place(context, "order")
            to = out if self.cells is None else code.at(place(context, "sorted"), size * dim)
            with self._blocks(size * dim) as i:
                total = code.variable(code.load(sums, i, _LANES))
                with code.over(chunks - 1) as k:
                    total.value = total.value + code.load(sums, (k + 1) * (size * dim) + i, _LANES)
                code.store(total.value, to, i)
            if self.cells:
                with code.over(n) as i:
                    body = code.load(order, i, INT)
                    for axis in range(dim):
                        code.store(code.load(to, size * axis + i), out, size * axis + body)

        return summed_up

    def _rows(self, kind: str, context: Value, state: Value, along: Value) -> list[Value]:
        """Coordinates, velocities along which a sum is taken, columns; in the order of cells, if there are some."""
        code, dim = state.code, self.dim
        size, sites = field(context, "size"), place(context, "sites")
        places = (state, 0, dim), (along, 0, 0 if kind == "gradient" else dim), (sites, 1, self.columns)
        x, v, c = ([code.at(first, size * (k + shift)) for k in range(n)] for first, shift, n in places)
        if self.cells is None:
            return [*x, *v, *c]
        n, order, ready = field(context, "bodies"), place(context, "order"), place(context, "sorted")
        to = [code.at(ready, size * k) for k in range(2 * dim + self.columns)]
        moved = list(zip(v, to[dim:], strict=False))
        if kind == "gradient":
            law = self.laws[kind]
            numbers = place(context, "numbers")
            end, softening = code.load(numbers, 1), code.load(numbers)
            cutoff = code.apply("sqrt", (end - softening,))
            box = [code.load(numbers, 2 + k) for k in range(dim)] if law.periodic else []
            self.cells.sort(state, n, size, field(context, "most_cells"), cutoff, box, order, place(context, "cells"))
            moved = list(zip([*x, *c], [*to[:dim], *to[2 * dim :]], strict=True))
        with code.over(n) as i:
            at = code.load(order, i, INT)
            for source, target in moved:
                code.store(code.load(source, at), target, i)
        return [*to[:dim], *to[dim:][: len(v)], *to[2 * dim :]]

    def _chunk(
        self, kind: str, context: Value, rows: Sequence[Value], F: Value, chunk: Value, chunks: Value, n: Value
    ) -> None:
        """The pairs of each body of a chunk: of one in so many."""
        code, law, dim = F.code, self.laws[kind], self.dim
        size, moved = field(context, "size"), len(rows) - self.columns
        start = sum(self.laws[k].n_numbers for k in [*self.laws][: [*self.laws].index(kind)])
        given = place(context, "numbers")
        numbers = [code.splat(code.load(given, start + i), LANES) for i in range(law.n_numbers)]
        lanes, zero = code.lane_numbers(LANES), code.constant(0.0, _LANES)
        found, cell = code.memory(2 * MOST_RANGES, INT), code.variable(code.constant(0, INT))
        cells = None if self.cells is None else place(context, "cells")
        with code.over(code.op("sdiv", INT, n - chunk + (chunks - 1), chunks)) as turn:
            i = chunk + turn * chunks
            mine = [code.splat(code.load(row, i), LANES) for row in rows]
            totals = [code.variable(zero) for _ in range(dim)]

            def meets(first: Value, last: Value) -> None:
                bounds = code.splat(first - 1, LANES), code.splat(last, LANES)

                def block(k: Value, sums: Sequence[Value]) -> list[Value]:
                    j = ((first >> SHIFT) + k) << SHIFT
                    number = code.splat(j, LANES) + lanes
                    other = [code.load(row, j, _LANES) for row in rows]
                    columns, inside = [*mine[moved:], *other[moved:]], (bounds[0] < number) & (number < bounds[1])
                    of_pair = parts(kind, *law.met(numbers, mine[:moved], other[:moved], columns, inside))
                    for axis in range(dim):
                        at = size * axis + j
                        code.store(with_parts(code.load(F, at, _LANES), of_pair, axis, -1.0), F, at)
                    return [with_parts(total, of_pair, axis) for axis, total in enumerate(sums)]

                count = ((last + (LANES - 1)) >> SHIFT) - (first >> SHIFT)
                assign(totals, code.loop(count, [x.value for x in totals], block))

            if cells is None or self.cells is None:
                meets(i + 1, n)
            else:
                with code.over(self.cells.ranges(code, i, n, cell, cells, found)) as k:
                    meets(code.load(found, k * 2, INT), code.load(found, k * 2 + 1, INT))
            for axis, variable in enumerate(totals):
                at = size * axis + i
                code.store(code.load(F, at) + code.total(variable.value), F, at)


class PairCode(SharedRollouts):
    """The compiled functions of schemes on bodies, `damped` by −γp: the potential alone is part of the code."""

    def __init__(
        self, local: PairsHamiltonian, damped: bool, level: int, compensated: bool, monomials: Monomials = ()
    ) -> None:
        self._given = local, damped, level, compensated
        self._local = local
        self._stages = PairSums(local, level, compensated, damped)
        self._sets = 4 if compensated else 2
        self.memory = partial(BodiesInMemory, local.dim, self._sets)
        self.work, self.terms = local.work, len(self._stages.splitting.terms)
        self.pieces = CHUNKS if local.work >= WORTH_CHUNKS else 1
        self._numbers = self._stages.numbers()
        n = local.n_bodies
        self._sites = zeros((1 + len(local.columns)) * (-(-n // LANES) * LANES)).reshape(1 + len(local.columns), -1)
        self._sites[0, :n], self._sites[1:, :n] = 1 / local.masses, local.columns
        super().__init__(2 * local.ndof * (1 + compensated), 2 * local.ndof)

    @cached_property
    def size(self) -> int:
        return len(self._stages.splitting.numbers)

    def stage(self, room: Any, numbers: Numbers, kind: Value, step: Value) -> Any:
        self._stages.stage(room.places, room.place, kind, [numbers(i) for i in range(self.size)])

    def members(self, meeting: np.ndarray, stop: np.ndarray, threads: int, block: int) -> Callable[[int], Member]:
        local, stages = self._local, self._stages
        n, dim, size, chunks = local.n_bodies, local.dim, self._sites.shape[1], self.pieces
        sums, sets, sorts = aligned(2 * chunks * dim * size), self._sets, stages.cells is not None
        shared = {"sites": self._sites, "numbers": self._numbers, "sums": sums, "meeting": meeting, "stop": stop}
        sizes = {"bodies": n, "size": size, "chunks": chunks, "members": threads, "turn": 0}
        sizes |= {"most_cells": most_along(n, dim), "block": block}

        def member(k: int) -> Member:
            ready = zeros((2 * dim + stages.columns) * size * sorts)
            order, cells = np.arange(n), np.zeros(most_cells(n, dim) * sorts, dtype=np.int64)
            arrays = shared | {"sorted": ready, "order": order, "cells": cells}
            arrays["work"] = zeros(ARRAYS * dim * size)
            numbers = sizes | {"member": k} | {name: address(x) for name, x in arrays.items()}
            context = np.array([numbers[name] for name in FIELDS], dtype=np.int64)
            return Member(aligned(3 * sets * dim * size), context, arrays)

        return member


# forces at many states ------------------------------------------------------------------------------------------------


DIRECTIONS = 16
"""Directions along which derivatives are taken together."""


class PairForces:
    """F = −∇V and G = ∇²V M⁻¹∇V at states q (d, P), and their derivatives along (K, d, P), for the fits of tables."""

    def __init__(self, local: PairsHamiltonian, level: int) -> None:
        assert level < CURVATURE
        self._given, self._has_gradient = (local, level), level >= FORCE_GRADIENT
        self._law = PairLaw(local, (1, 2, 3))
        self._numbers = self._law.numbers()
        self._sites = np.concatenate([1 / local.masses[None], local.columns])

    def __reduce__(self) -> tuple[Any, ...]:
        return PairForces, self._given

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        """F and G."""
        P, q = q.shape[1], _in_registers(q)
        F, G = np.zeros_like(q), np.zeros_like(q)
        self._forces(*self._given_arrays(q, F, G))
        return (F[:, :P], G[:, :P])[: 1 + self._has_gradient]

    def along(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """These, and their derivatives along directions."""
        P, q, v = q.shape[1], _in_registers(q), _in_registers(v)
        F, G, DF, DG = np.zeros_like(q), np.zeros_like(q), np.zeros_like(v), np.zeros_like(v)
        self._forces(*self._given_arrays(q, F, G))
        self._products(*self._given_arrays(q, F, v, DF, DG), len(v))
        values, changes = ([x[..., :P] for x in pair][: 1 + self._has_gradient] for pair in ((F, G), (DF, DG)))
        return values, changes

    def _given_arrays(self, *arrays: np.ndarray) -> tuple[int, ...]:
        return self._sites.shape[1], arrays[0].shape[1], *map(address, (self._sites, self._numbers, *arrays))

    @cached_property
    def _forces(self) -> Callable[..., None]:
        """The function of (n, P, sites, numbers, q, F, G) that adds F and G at P states to zeros."""
        code = begun("forces", [INT, INT, *[POINTER] * 5])
        *_, F, G = code.arguments
        states = _States(self._law, code)
        with states.groups():
            for i, j, pair in states.pairs():
                states.add(F, (i, j), parts("gradient", *pair), -1.0)
            if self._has_gradient:
                for i, j, pair in states.pairs(F):
                    states.add(G, (i, j), parts("hessian_vector", *pair), 1.0)
        return finished(code)

    @cached_property
    def _products(self) -> Callable[..., None]:
        """The function of (n, P, sites, numbers, q, F, v, DF, DG, K) that adds derivatives along K directions."""
        code = begun("products", [INT, INT, *[POINTER] * 7, INT])
        *_, F, v, DF, DG, K = code.arguments
        states = _States(self._law, code)
        with states.groups(), states.some(K) as (first, count):
            for i, j, (d, a, g) in states.pairs(F):
                da = summed(0.0, d, a)
                with code.over(count) as k:
                    m = first + k
                    u = [x - y for x, y in zip(states.vector(v, i, m), states.vector(v, j, m), strict=True)]
                    along, across = summed(0.0, d, u), summed(0.0, a, u)
                    states.add(DF, (i, j), [(g[1] * along, d), (g[0], u)], -1.0, m)
                    if self._has_gradient:
                        straight = g[2] * da * along + g[1] * across
                        states.add(DG, (i, j), [(straight, d), (g[1] * along, a), (g[1] * da, u)], 1.0, m)
            if self._has_gradient:
                for i, j, (d, _, g) in states.pairs():
                    with code.over(count) as k:
                        m = first + k
                        u = states.between(DF, i, j, m)
                        states.add(DG, (i, j), parts("hessian_vector", d, u, g), 1.0, m)
        return finished(code)


class _States:
    """The code of loops over states side by side, and over the pairs of each."""

    def __init__(self, law: PairLaw, code: Code) -> None:
        self._law, self._code, self._dim = law, code, law.dim
        self._n, self._P, self._sites, numbers, self._q = code.arguments[:5]
        self._numbers = [code.splat(code.load(numbers, i), LANES) for i in range(law.n_numbers)]

    @contextmanager
    def groups(self) -> Iterator[None]:
        with self._code.over(self._P >> SHIFT) as k:
            self._begin = k << SHIFT
            yield

    @contextmanager
    def some(self, K: Value) -> Iterator[tuple[Value, Value]]:
        """The first of some directions and their number, so few that what is made of them stays near."""
        code = self._code
        with code.over((K + (DIRECTIONS - 1)) >> 4) as b:
            first = b << 4
            yield first, code.apply("min", (K - first, code.constant(DIRECTIONS, INT)))

    def pairs(self, F: Value | None = None) -> Iterator[tuple[Value, Value, Pair]]:
        """Two bodies, of whom velocities are those of −M⁻¹F: the code written next is that of all pairs."""
        code = self._code
        with code.over(self._n) as i:
            x, columns = self.vector(self._q, i), self._columns(i)
            with code.over(self._n - 1 - i) as k:
                j = i + 1 + k
                pair = self._law.met(self._numbers, x, self.vector(self._q, j), [*columns, *self._columns(j)])
                yield i, j, pair if F is None else pair._replace(u=self.between(F, i, j))

    def between(self, F: Value, i: Value, j: Value, m: Value | None = None) -> list[Value]:
        """The difference of the −M⁻¹F of two bodies."""
        w_i, w_j = (self._site(0, body) for body in (i, j))
        return [b * w_j - a * w_i for a, b in zip(self.vector(F, i, m), self.vector(F, j, m), strict=True)]

    def vector(self, x: Value, i: Value, m: Value | None = None) -> list[Value]:
        """The numbers of a body, of direction m where there are directions."""
        return [self._code.load(x, self._place(i, k, m), _LANES) for k in range(self._dim)]

    def add(
        self, x: Value, ends: tuple[Value, Value], of_pair: Sequence[Any], sign: float, m: Value | None = None
    ) -> None:
        """Add the part of a pair to that of its first body, and take it from the second; with a sign of −1 reversed."""
        for body, part in zip(ends, (sign, -sign), strict=True):
            for axis, value in enumerate(self.vector(x, body, m)):
                self._code.store(with_parts(value, of_pair, axis, part), x, self._place(body, axis, m))

    def _place(self, i: Value, axis: int, m: Value | None) -> Value:
        row = i * self._dim + axis
        if m is not None:
            row = row + m * (self._n * self._dim)
        return row * self._P + self._begin

    def _site(self, row: int, i: Value) -> Value:
        return self._code.splat(self._code.load(self._sites, self._n * row + i), LANES)

    def _columns(self, i: Value) -> list[Value]:
        return [self._site(1 + k, i) for k in range(self._law.columns)]


def _in_registers(x: np.ndarray) -> np.ndarray:
    """Arrays (…, P) with the last column again where they do not fill registers."""
    P = x.shape[-1]
    full = np.empty((*x.shape[:-1], -(-P // LANES) * LANES))
    full[..., :P], full[..., P:] = x, x[..., -1:]
    return full
