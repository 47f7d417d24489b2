"""Compiled runs of SympFlows whose potentials are multilayer perceptrons.

A layer adds ∓(∇V(t, x) − ∇V(0, x)) to p or to q. V(t, ·) and V(0, ·) share K x and run side by side through

    a₁ = K x + b₁ (+ k t),  z_l = σ(a_l),  a_{l+1} = W_l z_l + b_{l+1},      V = w · z_n,
    r_n = w σ'(a_n),  r_l = σ'(a_l) W_lᵀ r_{l+1},                          ∇V = Kᵀ r₁.

Weights are read from memory, so that a trained network is compiled once. Of one trajectory the features of a level are
lanes, of several the trajectories are. Both add up in one order, so that they give the same bits: of the features in
Kᵀ r₁ each fourth one by itself, then these four sums.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import NotCompiled, arrays_only
from sympflow.compiler.control import DOUBLE, INT, POINTER, Type, Value
from sympflow.compiler.functions import fma
from sympflow.compiler.program import traced
from sympflow.kernels.activations import SIGMAS, activation_program
from sympflow.kernels.protocol import Kernel, Run, Steps, Task, both_ways, run_states
from sympflow.kernels.reverse import Chained
from sympflow.kernels.rollouts import ONE, Columns, Rollouts, aligned
from sympflow.kernels.runs import Numbers, Room
from sympflow.lazy import needed

if TYPE_CHECKING:
    from sympflow.kernels.network_tangents import NetworkTangents

__all__ = ["MLPFlowKernel", "NetworkLayer"]

FEATURES = 4  # side by side in a register
REGISTERS = 4  # of features, at most, that are computed together
STEP = 1000  # about how many nanoseconds one takes


@dataclass(frozen=True, eq=False)
class NetworkLayer:
    """The weights of a kick or a drift, whose potential is V(t, x) = w · σ(… σ(K x + k t + b_1) …).

    K is (h_1, d), k (h_1,), the biases (h_l,), the weights (h_{l+1}, h_l), w (h_n,). `slopes` returns σ(a) and σ'(a).
    """

    is_kick: bool
    activation: str
    K: np.ndarray
    k: np.ndarray
    biases: Sequence[np.ndarray]
    weights: Sequence[np.ndarray]
    w: np.ndarray
    slopes: Callable[[float], Any] | None = None


class MLPFlowKernel(Kernel):
    """Compiled loops of one SympFlow, of layers of one depth and activation; a step h < 0 is the inverse of ψ̄_|h|."""

    saves_finite = False

    def __init__(self, ndof: int, layers: Sequence[NetworkLayer]) -> None:
        depths, activations = {len(layer.biases) for layer in layers}, {layer.activation for layer in layers}
        slopes = layers[0].slopes
        if len(depths) > 1 or len(activations) > 1 or not (activations <= set(SIGMAS) or slopes is not None):
            raise arrays_only(
                f"`flow` must have potentials of one depth with one activation out of {', '.join(SIGMAS)}, or one "
                "that was registered with `compiled`, to be compiled"
            )
        self._given = ndof, layers
        self._rollouts = _NetworkRollouts(ndof, layers)
        self._widths = {tuple(map(len, layer.biases)) for layer in layers}

    def __reduce__(self) -> tuple[Any, ...]:
        return MLPFlowKernel, self._given

    def runs(self, task: Task) -> Run:
        """`n_steps` times ψ̄_h from every row: see `Kernel`."""
        return run_states(partial(self._rollouts.run, task.h, closed=False), task, task.y0.shape[1], STEP)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """ψ̄_h of each row of `y` (N, 2d), each with its own h (N,), negative for the inverse."""
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), len(y))

        def one_way(rows: Any, back: bool) -> np.ndarray:
            start, sign = np.concatenate([y[rows], np.abs(lengths[rows])[:, None]], axis=1), -1.0 if back else 1.0
            rollout, task = partial(self._rollouts.run, sign, closed=False), Task(0.0, y[rows], 1, ONE)
            return run_states(rollout, task, y.shape[1], STEP, start).states[:, 0]

        return Steps(both_ways(one_way, lengths, y))

    def check_reverse(self) -> None:
        if self._derivatives is None:
            raise NotCompiled(
                "`flow` has networks of several sizes, or an activation of its own, which have no compiled reverse: "
                "use backend='array'."
            )

    def recorded(self, task: Task) -> Chained:
        return Chained(self, task)

    def tangents(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        if self._derivatives is None:
            return None
        made, weights = self._derivatives
        N, m = y.shape
        out, by_start = self.step(h, y).states, np.empty((m, m, N))
        starts = np.where(h[:, None] < 0, out, y)  # of the inverse those of ψ̄ from where it leads, A⁻¹ = −ΩAᵀΩ
        by_state = np.broadcast_to(np.eye(m), (N, m, m))
        made.jacobian(weights, abs(h), starts, np.empty((0, N)), by_state, by_start=by_start, weights=False)
        A = by_start.transpose(2, 0, 1)
        d = m // 2
        inverse = np.block([[A[:, d:, d:], -A[:, d:, :d]], [-A[:, :d, d:], A[:, :d, :d]]]).swapaxes(1, 2)
        return out, np.where(h[:, None, None] < 0, inverse, A)

    @cached_property
    def _derivatives(self) -> tuple[NetworkTangents, np.ndarray] | None:
        """The compiled derivatives of layers that are alike, with the weights as these take them."""
        from sympflow.kernels.network_tangents import NetworkTangents, TrainedNetwork

        ndof, layers = self._given
        if len(self._widths) > 1 or layers[0].activation not in SIGMAS:
            return None
        weights = [
            np.concatenate([np.ravel(x) for x in (one.K, one.k, one.w, *one.biases, *one.weights)]) for one in layers
        ]
        (widths,) = self._widths
        networks = [TrainedNetwork(ndof, widths, layers[0].activation, np.ones(len(x))) for x in weights]
        return NetworkTangents(ndof, [layer.is_kick for layer in layers], networks), np.concatenate(weights)


class _Layout(NamedTuple):
    """Sizes of levels, all as the widest: k, w (h,), b (n, h), K (d, h), W (n − 1, from, to) and Wᵀ, 0 elsewhere."""

    ndof: int
    depth: int
    used: int
    registers: int

    @classmethod
    def of(cls, ndof: int, depth: int, width: int) -> _Layout:
        needed = -(-width // FEATURES)
        registers = min(range(1, REGISTERS + 1), key=lambda g: (-(-needed // g) * g, -g))
        return cls(ndof, depth, width, registers)

    @property
    def h(self) -> int:
        """Features of a level, in whole groups of registers."""
        group = self.registers * FEATURES
        return -(-self.used // group) * group

    @property
    def starts(self) -> list[int]:
        """Where k, w, b, K, W and Wᵀ begin, and where they end."""
        h, squares = self.h, (self.depth - 1) * self.h**2
        return [int(x) for x in np.cumsum([0, h, h, self.depth * h, self.ndof * h, squares, squares])]

    def weights(self, layer: NetworkLayer) -> np.ndarray:
        h, n = self.h, self.depth
        shapes = (h,), (h,), (n, h), (self.ndof, h), (n - 1, h, h), (n - 1, h, h)
        arrays = [np.zeros(shape) for shape in shapes]
        k, w, b, K, W, transposed = arrays
        pairs = [(k, layer.k), (w, layer.w), (K, layer.K.T), *zip(b, layer.biases, strict=True)]
        pairs += zip(W, (M.T for M in layer.weights), strict=True)
        pairs += zip(transposed, layer.weights, strict=True)
        for target, values in pairs:
            target[tuple(map(slice, values.shape))] = values
        return np.concatenate([a.ravel() for a in arrays])


_compiled: dict[Any, dict[Any, Callable[..., None]]] = {}
"""The functions of networks of the same sizes and activations."""


class _NetworkRollouts(Rollouts):
    """The compiled functions of networks: a column is a layer, by its number and whether it is a kick."""

    fewest, size = 8, 2

    def __init__(self, ndof: int, layers: Sequence[NetworkLayer]) -> None:
        super().__init__(2 * ndof, 2 * ndof)
        first = layers[0]
        width, depth = max(len(b) for layer in layers for b in layer.biases), len(first.biases)
        self._layout = layout = _Layout.of(ndof, depth, width)
        self._kinds = np.array([2 * i + layer.is_kick for i, layer in enumerate(layers)])
        self.room, weights = 6 * depth * layout.h, aligned(len(layers) * layout.starts[-1])
        weights[:] = np.concatenate([layout.weights(layer) for layer in layers])
        self._slopes, address = _slopes(first)
        self.data = [weights, np.array([address])]
        self._functions = _compiled.setdefault((layout, first.activation, first.slopes), {})

    def prepared(self, table: Any) -> Columns:
        """The columns of steps of a length h: signs and times."""
        entries, kinds = self.own_entries(table, np.array([[abs(table)]]))
        return entries[0], kinds

    def own_entries(self, table: Any, values: np.ndarray) -> Columns:
        """The columns (N, layers + 2, 2) of trajectories with their own |h|, and the sign of `table`."""
        kinds = self._kinds[::-1] if table < 0 else self._kinds
        kinds = np.concatenate([kinds, kinds[:1], kinds[:1]])
        entries = np.empty((len(values), len(kinds), 2))
        entries[:, :, 0], entries[:, :, 1] = np.where(kinds % 2 == (table < 0), 1.0, -1.0), values
        return entries, kinds

    def stage(self, room: Any, numbers: Numbers, kind: Value, step: Value) -> Any:
        """One layer, in place."""
        code, layout = room.code, self._layout
        kick = code.apply("eq", (kind & 1, 1))
        q, p = code.constant(0, INT), code.constant(layout.ndof, INT)
        x, target = room.part(code.select(kick, q, p)).place, room.part(code.select(kick, p, q)).place
        weights = code.at(room.data(0), (kind >> 1) * layout.starts[-1])
        sigma = self._slopes
        if sigma is None:
            sigma = partial(_called, code.load(room.data(1), 0, POINTER))
        _Impulse(layout, room, weights, sigma).add(numbers(0), numbers(1), x, target)


class _Impulse:
    """The code of one layer. Registers hold features of one trajectory, or one feature of several."""

    def __init__(self, layout: _Layout, room: Room, weights: Value, slopes: Callable[[Value], Any]) -> None:
        self.layout, self.code, self.width, self._weights, self.slopes = layout, room.code, room.width, weights, slopes
        self.side = FEATURES if room.width == 1 else 1  # features in a register
        self.type = Type("double", FEATURES if room.width == 1 else room.width)
        self.block = layout.registers * FEATURES if room.width == 1 else 1
        self.z, self.s, self.r = (room.work.part(2 * i * layout.depth * layout.h).place for i in range(3))

    def weights(self, first: Any, count: int) -> list[Value]:
        """Registers of as many weights, from one on."""
        if self.width == 1:
            return [self.code.load(self._weights, first + i, self.type) for i in range(0, count, FEATURES)]
        return [self.code.splat(self.code.load(self._weights, first + i), self.width) for i in range(count)]

    def features(self, place: Value, first: Any, count: int) -> list[Value]:
        return [self.code.load(place, (first + i) * self.width, self.type) for i in range(0, count, self.side)]

    def put(self, registers: Sequence[Value], place: Value, first: Any) -> None:
        for i, x in enumerate(registers):
            self.code.store(self.code.operand(x, self.type), place, (first + i * self.side) * self.width)

    def feature(self, place: Value, i: Any) -> Value:
        """One feature, or coordinate, for all weights."""
        x = self.code.load(place, i * self.width, self.type if self.width > 1 else DOUBLE)
        return self.code.operand(x, self.type)

    def blocks(self, n: int) -> Iterator[Value]:
        """The first of the features that are computed together."""
        with self.code.over(-(-n // self.block)) as i:
            yield i * self.block

    def add(self, sign: Value, t: Value, x: Value, target: Value) -> None:
        """target += sign · (∇V(t, x) − ∇V(0, x))."""
        layout, code = self.layout, self.code
        h, used, top = layout.h, layout.used, layout.depth - 1
        k, w, b, K, W, transposed, _ = layout.starts
        zero, t = code.constant(0.0, self.type), code.operand(t, self.type)
        for first in self.blocks(used):
            start = self.weights(first + b, self.block)
            (a,) = self.products(layout.ndof, first + K, start, 1, lambda j: [self.feature(x, j)])
            moved = [fma(factor, t, y) for factor, y in zip(self.weights(first + k, self.block), a, strict=True)]
            self.activate(first, moved, a)
        with code.over(top) as level:
            for first in self.blocks(used):
                start = self.weights((level + 1) * h + first + b, self.block)
                both = self.products(used, level * (h * h) + first + W, start, 2, self.both(self.z, level * (2 * h)))
                self.activate((level + 1) * (2 * h) + first, *both)
        for first in self.blocks(used):
            factors = self.weights(first + w, self.block)
            for column in (0, h):
                slope = self.features(self.s, first + (top * 2 * h + column), self.block)
                self.put([x * y for x, y in zip(factors, slope, strict=True)], self.r, first + column)
        with code.over(top) as down:
            level, source, out = (top - 1) - down, (down & 1) * (2 * h), ((down + 1) & 1) * (2 * h)
            for first in self.blocks(used):
                start = [zero] * (self.block // self.side)
                R = self.products(used, level * (h * h) + first + transposed, start, 2, self.both(self.r, source))
                for column, total in zip((0, h), R, strict=True):
                    slope = self.features(self.s, level * (2 * h) + first + column, self.block)
                    self.put([x * y for x, y in zip(total, slope, strict=True)], self.r, out + first + column)
        end = (top & 1) * 2 * h
        for first in self.blocks(used):
            ends = [self.features(self.r, first + (end + column), self.block) for column in (0, h)]
            self.put([x - y for x, y in zip(*ends, strict=True)], self.r, first + end)
        if self.width > 1:
            with code.over(h - used) as i:
                self.put([zero], self.r, i + (end + used))
        with code.over(layout.ndof) as j:

            def more(i: Value, sums: Sequence[Value]) -> list[Value]:
                factors = self.weights(j * h + i * FEATURES + K, FEATURES)
                given = self.features(self.r, i * FEATURES + end, FEATURES)
                return [fma(x, y, total) for x, y, total in zip(factors, given, sums, strict=True)]

            sums = code.loop(h // FEATURES, [zero] * (FEATURES // self.side), more)
            each = sums if self.width > 1 else [code.lane(sums[0], i) for i in range(FEATURES)]
            change = (each[0] + each[1]) + (each[2] + each[3])
            y = code.load(target, j * self.width, change.type)
            code.store(fma(sign, change, y), target, j * self.width)

    def both(self, place: Value, level: Value) -> Callable[[Value], list[Value]]:
        """A feature of a level in the columns t and 0."""
        return lambda i: [self.feature(place, level + i), self.feature(place, level + (i + self.layout.h))]

    def products(
        self, count: int, first: Value, start: list[Value], columns: int, given: Callable[[Value], list[Value]]
    ) -> list[list[Value]]:
        """start + Σᵢ xᵢ Mᵢ of a block of features, for the x of each column; a row of M is as long as a level."""
        h, size = self.layout.h, len(start)

        def more(i: Value, totals: Sequence[Value]) -> list[Value]:
            factors = self.weights(first + i * h, self.block)
            return [
                fma(factor, x, totals[column * size + v])
                for column, x in enumerate(given(i))
                for v, factor in enumerate(factors)
            ]

        totals = self.code.loop(count, start * columns, more)
        return [totals[i : i + size] for i in range(0, len(totals), size)]

    def activate(self, first: Value, *columns: Sequence[Value]) -> None:
        """σ and σ' of both columns of a block."""
        for place, a in zip((first, first + self.layout.h), columns, strict=True):
            values, slopes = zip(*map(self.slopes, a), strict=True)
            self.put(values, self.z, place)
            self.put(slopes, self.s, place)


def _slopes(layer: NetworkLayer) -> tuple[Callable[[Any], Any] | None, int]:
    """σ and σ' as a function of numbers; or None, and the address of a function of the user's that cannot be traced."""
    if layer.activation in SIGMAS:
        return activation_program(layer.activation, 1), 0
    function: Any = layer.slopes
    try:
        return traced(getattr(function, "py_func", function), "a"), 0
    except (TypeError, ValueError, AttributeError) as reason:
        return None, _by_numba(function, str(reason)).address


@cache
def _by_numba(function: Any, reason: str) -> Any:
    """A function (n, a, values, slopes) of addresses, of one that cannot be traced for a reason."""
    try:
        from numba import carray, cfunc, njit, types
        from numba.extending import is_jitted
    except ImportError as error:
        raise NotCompiled(
            "`compiled`, with which the activation of the flow was registered, cannot be traced, so that Numba must "
            f"compile it ({reason.rstrip('.')}): {needed('numba', 'numba')}, or write it by operators."
        ) from error

    compiled = function if is_jitted(function) else njit(error_model="numpy")(function)
    numbers = types.CPointer(types.float64)

    @cfunc(types.void(types.int64, numbers, numbers, numbers))
    def both(n: Any, a: Any, values: Any, slopes: Any) -> None:
        a, values, slopes = carray(a, n), carray(values, n), carray(slopes, n)
        for i in range(n):
            values[i], slopes[i] = compiled(a[i])

    return both


def _called(address: Value, a: Value) -> tuple[Value, Value]:
    """σ and σ' by an address."""
    code, n = a.code, a.type.width
    given, values, slopes = (code.memory(1, a.type) for _ in range(3))
    code.store(a, given)
    code.call(address.name, [code.constant(n, INT), given, values, slopes])
    return code.load(values, 0, a.type), code.load(slopes, 0, a.type)
