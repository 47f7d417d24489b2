"""Kicks by potentials with linear layers, and drifts: trajectories are lanes, weights are read from memory.

    a_l = W_l x_l + b_l,  x_{l+1} = σ(a_l),      r_l = σ'(a_l) W_{l+1}ᵀ r_{l+1},      ∇V = W_0ᵀ r_0.

The reverse of a kick needs the derivatives of v·∇V(q) along a vector v, by q and by the weights. With dots for
derivatives along v and s for those of v·∇V by a,

    ȧ_l = W_l ẋ_l,  ẋ_{l+1} = σ' ȧ_l,      s_l = σ' W_{l+1}ᵀ s_{l+1} + σ'' ȧ_l W_{l+1}ᵀ r_{l+1},

those by W_l are Σ r_l ẋ_l + s_l x_l, which are added up over stages and trajectories behind the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import INT, Type, Value
from sympflow.compiler.functions import dot, fma
from sympflow.compiler.machine import address
from sympflow.compiler.program import Program
from sympflow.hamiltonian.layered import LayeredPotential
from sympflow.hamiltonian.monomials import Monomials
from sympflow.kernels.rollouts import LINE, Columns, SplittingRollouts, zeros
from sympflow.kernels.runs import Numbers, Room, Values, step_function

__all__ = ["LayeredCode"]

SIDE = 4  # lanes of a sum over trajectories
AT_ONCE = 4  # sums that are made together, of one column


class LayeredCode(SplittingRollouts):
    """The compiled functions of splitting schemes on a potential with layers; a kind is where weights are."""

    lanes = 16
    size = 2

    def __init__(
        self, potential: LayeredPotential, level: int = 0, compensated: bool = False, monomials: Monomials = ()
    ) -> None:
        if compensated:
            raise NotCompiled("`compensated` sums are not compiled for weights that torch follows: leave it out.")
        super().__init__(2 * potential.ndof, 2 * potential.ndof)
        self._potential, self._given = potential, (potential,)

    def prepared(self, table: Any) -> Columns:
        """The columns, whose kinds are followed by the weights and room for sums over trajectories."""
        m, weights = table.shape[1], self._potential.weights
        begin = -(-m // LINE) * LINE
        memory = zeros(begin + len(weights) * (1 + SIDE))
        memory[begin:][: len(weights)] = weights
        kinds = memory[:m].view(np.int64)
        kinds[:] = address(memory) + 8 * begin
        return np.ascontiguousarray(table.T), kinds

    def summed(self, kinds: np.ndarray) -> np.ndarray:
        memory = kinds.base
        assert memory is not None
        begin = (int(kinds[0]) - address(memory)) // 8
        n = self._potential.n_weights
        return np.asarray(memory[begin + n : begin + n * (1 + SIDE)].reshape(n, SIDE).sum(1, keepdims=True))

    def check_reverse(self) -> None:
        """All stages have a reverse."""

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        d, potential = self._potential.ndof, self._potential
        q, p, a, b = values[:d], values[d:], numbers(0), numbers(1)
        slope = _Layers(potential, values[0], kind).slopes(q)
        p = [fma(-b, x, y) for x, y in zip(slope, p, strict=True)]
        return [*self._drifted(q, p, a), *p]

    def _drifted(self, q: Sequence[Value], p: Sequence[Value], a: Value) -> list[Value]:
        return [fma(a, dot(row, p), x) for row, x in zip(self._potential.inverse_mass.tolist(), q, strict=True)]

    def adjoint(
        self, values: Values, cotangents: Values, numbers: Numbers, kind: Value, step: Value, slopes: bool, *room: Room
    ) -> tuple[Values, Values]:
        """The reverse of `stage`, which adds up the derivatives by the weights with `slopes`."""
        d = self._potential.ndof
        of_q, a, b = cotangents[:d], numbers(0), numbers(1)
        of_p = self._drifted(cotangents[d:], of_q, a)  # M⁻¹ is symmetric
        v = [-(b * x) for x in of_p]
        product = _Layers(self._potential, values[0], kind, slopes).slopes(values[:d], v)
        return [*(x + y for x, y in zip(of_q, product, strict=True)), *of_p], []

    def step_made(self, width: int, own: bool) -> Callable[..., None]:
        def stage(values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
            place = numbers(2)
            where = place if width == 1 else place.code.lane(place, 0)
            return self.stage(values, numbers, place.code.convert("fptosi", where, "i64"), step)

        return step_function(self.n_values, self.n_out, [1, 1, 0], 0, lambda time, *given: given, stage, width)

    def step_rows(
        self, table: np.ndarray, x: np.ndarray, h: np.ndarray, t: np.ndarray, y: np.ndarray, out: np.ndarray
    ) -> None:
        width = 1 if len(y) == 1 else self.lanes
        _, kinds = self.prepared(table[..., 0])
        where = np.zeros((1, *table.shape[1:]))
        where[..., 0] = kinds  # addresses are whole numbers that doubles hold
        full = np.concatenate([table, where])
        self.call("step", width, full, full.shape[1], full.shape[2], x, h, t, y, len(y), out)


class _Layers:
    """The code of ∇V, and of its derivatives, of states like a value, with weights at an address."""

    def __init__(self, potential: LayeredPotential, like: Value, kind: Value, sums: bool = False) -> None:
        self.potential, self.code, self.type, self._sums = potential, like.code, like.type, sums
        self.weights = self.code.address(kind)
        self.width, self.sizes = self.type.width, potential.sizes

    def _room(self, n: int) -> Value:
        return self.code.memory(n, self.type)

    def _filled(self, values: Sequence[Any]) -> Value:
        """Room for values, which it has."""
        place = self._room(len(values))
        for i, x in enumerate(values):
            self.code.store(self.code.operand(x, self.type), place, i * self.width)
        return place

    def _get(self, place: Value, i: Any) -> Value:
        return self.code.load(place, i * self.width, self.type)

    def _weight(self, i: Any) -> Value:
        return self.code.splat(self.code.load(self.weights, i), self.width)

    def _blocks(self, n: int, size: int) -> Iterator[tuple[Any, int]]:
        """The first of the numbers that are computed together, and how many."""
        if n >= size:
            with self.code.over(n // size) as k:
                yield k * size, size
        if n % size:
            yield self.code.constant(n - n % size, INT), n % size

    def _products(
        self, k: int, columns: Sequence[Value], then: Callable[[Any, list[Value]], None], back: bool = False
    ) -> None:
        """`then(i, totals)` of W x, or Wᵀ x, of each column; with b in the first one of W x."""
        (come, go), (start, bias) = self.sizes[k], self.potential.starts[k]
        n, m = (go, come) if back else (come, go)
        zero = self.code.constant(0.0, self.type)
        for first, count in self._blocks(m, AT_ONCE // len(columns)):
            totals = [zero] * (count * len(columns))
            if bias is not None and not back:
                totals[:count] = [self._weight(first + (bias + r)) for r in range(count)]

            def more(j: Value, totals: Sequence[Value], first: Any = first, count: int = count) -> list[Value]:
                x = [self._get(column, j) for column in columns]
                places = [j * come + first + r if back else (first + r) * come + j for r in range(count)]
                W = [self._weight(i + start) for i in places]
                return [fma(W[i % count], x[i // count], total) for i, total in enumerate(totals)]

            totals = self.code.loop(n, totals, more)
            for r in range(count):
                then(first + r, totals[r::count])

    def _run(self, program: Program, *values: Value) -> list[Value]:
        return [self.code.operand(x, self.type) for x in program(*values)]

    def slopes(self, q: Sequence[Value], v: Sequence[Value] = ()) -> list[Value]:
        """∇V(q); along a vector ∇²V(q)·v, and derivatives of v·∇V by the weights are added to their sums."""
        potential, last, d, n, m = self.potential, len(self.sizes) - 1, len(q), self.sizes[0][0], self.sizes[-1][1]
        first, at_ends, reverse = potential.first, potential.slopes, potential.first_reversed
        if v:
            first, at_ends, reverse = potential.first_moved, potential.slopes_moved, potential.first_moved_reversed
        start = self._run(first, *q, *v)
        columns = [self._filled(start[i : i + n]) for i in range(0, len(start), n)]  # x, and its derivative along v
        taken, slopes = [], []
        for k, (_, go) in enumerate(self.sizes):
            places = [self._room(go) for _ in range(2 * len(columns))]
            taken.append(columns)
            slopes.append(places[len(columns) :])

            def activated(i: Any, totals: list[Value], k: int = k, places: Sequence[Value] = places) -> None:
                found = totals
                if k < last:
                    found = self._run(potential.activations[k], totals[0])
                    if v:
                        y, slope, bent = found
                        found = [y, slope * totals[1], slope, bent * totals[1]]
                for place, z in zip(places, found, strict=False):
                    self.code.store(z, place, i * self.width)

            self._products(k, columns, activated)
            columns = places[: len(columns)]
        ends = [self._get(place, i) for place in columns for i in range(m)]
        found = self._run(at_ends, *q, *ends[:m], *v, *ends[m:])
        columns = [self._filled(found[-m:]), *([self._filled(found[d : d + m])] if v else [])]  # r and s
        for k in range(last, -1, -1):
            if v and self._sums:
                self._add(k, *columns, *taken[k])
            below = [self._room(self.sizes[k][0]) for _ in columns]

            def pulled(i: Any, totals: list[Value], k: int = k, below: Sequence[Value] = below) -> None:
                if k:
                    slope, *bent = (self._get(place, i) for place in slopes[k - 1])
                    R, *S = totals
                    totals = [slope * R, *(fma(slope, x, b * R) for x, b in zip(S, bent, strict=True))]
                for place, y in zip(below, totals, strict=True):
                    self.code.store(y, place, i * self.width)

            self._products(k, columns, pulled, back=True)
            columns = below
        of_x = [self._get(place, i) for place in columns[::-1] for i in range(n)]
        more = self._run(reverse, *q, *v, *of_x)
        return [x + y for x, y in zip(found[:d], more, strict=False)]

    def _add(self, k: int, r: Value, s: Value, x: Value, moved: Value) -> None:
        """Add the derivatives by a layer to their sums over trajectories."""
        code, (come, go), (start, bias) = self.code, self.sizes[k], self.potential.starts[k]
        side = min(SIDE, self.width)
        type, parts = Type("double", side), range(0, self.width, side)
        sums = code.at(self.weights, self.potential.n_weights)

        def loaded(place: Value, i: Any) -> list[Value]:
            return [code.load(place, i * self.width + lane, type) for lane in parts]

        def add(place: Any, products: Sequence[Sequence[Value]]) -> None:
            total = code.load(sums, place * SIDE, type)
            for factors in products:
                total = fma(factors[0], factors[1], total) if len(factors) == 2 else total + factors[0]
            code.store(total, sums, place * SIDE)

        for first, count in self._blocks(go, 2):
            R, S = ([loaded(place, first + row) for row in range(count)] for place in (r, s))
            with code.over(come) as j:
                X, Y = loaded(x, j), loaded(moved, j)
                for row in range(count):
                    pairs = [*zip(R[row], Y, strict=True), *zip(S[row], X, strict=True)]
                    add((first + row) * come + j + start, pairs)
            if bias is not None:
                for row in range(count):
                    add(first + (row + bias), [(part,) for part in S[row]])
