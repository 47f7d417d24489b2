"""Compiled derivatives of SympFlows with MLP potentials by their weights, for Gauss–Newton fits.

With directions e_j of x and the velocity ẋ at the rate 1 of t, dots for derivatives along these,

    a₁ = K x + k t + b₁,  z = σ(a),  a' = W z + b,                V = w · z_n,    r = σ'(a) Wᵀ r',
    z_j = σ' a_j,  ż = σ' ȧ,  ż_j = σ'' a_j ȧ + σ' ȧ_j,           ∂_jV = w · z_j,  d/dt ∂_jV = w · ż_j.

The reverse sweep of w · ż_j meets r for ż_j, ṙ for z_j, A for ż and C for z; that of w · z_j meets r for z_j and A for
z. A state is moved by differences between t and 0. The derivatives P of what is fitted by the state after a layer, and
M by its velocity, are pulled back from layer to layer.

Points are the lanes of registers, all else is loops over memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sympflow.compiler.control import INT, POINTER, Code, Rows, Type, Value
from sympflow.compiler.dual import Dual, DualRows
from sympflow.compiler.functions import fma
from sympflow.kernels.activations import activation_program
from sympflow.kernels.rollouts import filled
from sympflow.kernels.runs import begun, finished
from sympflow.kernels.threads import run_rows

__all__ = ["NetworkTangents", "TrainedNetwork"]

LANES = 16  # points side by side, which divide those that a thread takes
REGISTER = Type("double", LANES)


@dataclass(frozen=True)
class TrainedNetwork:
    """The network of a kick or a drift, V(t, x) = w · σ(… σ(K x + k t + b_1) …), as it is fitted.

    Its `inputs` beside t are x and constants of a step; `units` the derivatives of K (h_1, inputs), k (h_1,), w (h_n,),
    b_1 … b_n, W_1 … W_{n−1}, one after another, by the parameters, each a multiple of its own.
    """

    inputs: int
    widths: tuple[int, ...]
    activation: str
    units: np.ndarray


class NetworkTangents:
    """ψ̄_t of layers with networks that are alike, with d/dt ψ̄_t, and their derivatives by the weights."""

    def __init__(self, ndof: int, is_kick: Sequence[bool], networks: Sequence[TrainedNetwork]) -> None:
        self.ndof = ndof
        self._is_kick = np.array(is_kick, dtype=np.int64)
        self._units = np.concatenate([n.units for n in networks])
        first = networks[0]
        self._sizes = _Sizes(ndof, first.inputs, max(first.widths), len(first.widths))
        self._places, self._activation = self._sizes.places(first.widths), first.activation
        self._kept: dict[tuple[bool, int], np.ndarray] = {}

    def values(
        self, parameters: np.ndarray, t: np.ndarray, x: np.ndarray, constants: np.ndarray, velocity: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """ψ̄_t(x) and, if asked for, d/dt ψ̄_t(x), of states (N, 2d) at times (N,), constants being (inputs − d, N)."""
        y = np.empty((2 * self.ndof * (1 + velocity), max(len(t), LANES)))
        self._run("values", velocity, 1, (parameters, t, x, constants), [y])
        y, dy = y[: 2 * self.ndof, : len(t)], y[2 * self.ndof :, : len(t)]
        return np.ascontiguousarray(y.T), np.ascontiguousarray(dy.T) if velocity else np.empty((0, 0))

    def jacobian(
        self,
        parameters: np.ndarray,
        t: np.ndarray,
        x: np.ndarray,
        constants: np.ndarray,
        by_state: np.ndarray,
        by_velocity: np.ndarray | None = None,
        by_start: np.ndarray | None = None,
        *,
        weights: bool = True,
    ) -> np.ndarray:
        """J (n, 2d, N), the derivatives of 2d functions of ψ̄ and d/dt ψ̄ by the parameters.

        `by_state` (N, 2d, 2d) are the derivatives of the functions by ψ̄_t(x), `by_velocity` (2d,) those of each by its
        component of d/dt ψ̄_t(x), if they depend on that; `by_start` (2d, 2d, N) is filled with those by x, without
        those of constants. The next call for as many points overwrites J: it is tens of megabytes. Without `weights`
        J is not made.
        """
        velocity, m, N = by_velocity is not None, 2 * self.ndof, len(t)
        key, shape = (velocity, N), (len(parameters), m, max(N, LANES))
        if not weights:
            J = np.empty((0, m, N))
        elif key not in self._kept:
            self._kept = {k: J for k, J in self._kept.items() if k[0] != velocity} | {key: np.empty(shape)}
        if weights:
            J = self._kept[key]
        start = np.empty((m, m, shape[2]) if by_start is not None else 0)
        by = np.zeros(m) if by_velocity is None else np.ascontiguousarray(by_velocity)
        factors = [filled(by_state.transpose(1, 2, 0), LANES), by, self._units, self._places, J, start]
        flags = len(self._places) if weights else 0, int(by_start is not None)
        self._run(
            "jacobian" if weights else "by start",
            velocity,
            10 * self.ndof,
            (parameters, t, x, constants),
            factors,
            *flags,
        )
        if by_start is not None:
            by_start[:] = start[..., :N]
        return J[..., :N]

    def _run(
        self, name: str, velocity: bool, factor: int, given: tuple[Any, ...], rest: Sequence[np.ndarray], *flags: int
    ) -> None:
        """Call a function on all blocks of points, on several threads where it pays."""
        parameters, t, x, constants = given
        n_layers, n = len(self._is_kick), len(parameters)
        weights = np.zeros((n_layers, self._sizes.size))
        weights[:, self._places] = (parameters * self._units).reshape(n_layers, -1)
        points = [weights, self._is_kick, *(filled(a, LANES) for a in (t, x.T, constants)), *rest]
        addresses = [a.ctypes.data for a in points]
        function = _compiled(name, self._sizes, self._activation, velocity)

        def rows(i: slice, stop: np.ndarray) -> None:
            work = np.zeros(LANES * (self._sizes.work + (n_layers + 1) * self._sizes.state))
            blocks = i.start // LANES, -(-i.stop // LANES)
            function(*addresses, work.ctypes.data, n_layers, max(len(t), LANES), *blocks, *flags)

        run_rows(rows, len(t), factor * n, None)


class _Sizes(NamedTuple):
    """Sizes of layers, all as wide as the widest: K (h, inputs), k, w (h,), b (n, h), W (n − 1, h, h) in turn."""

    ndof: int
    inputs: int
    h: int
    n: int

    @property
    def starts(self) -> tuple[int, ...]:
        """Where K, k, w, b and W begin, and where they end."""
        h = self.h
        sizes = self.inputs * h, h, h, self.n * h, (self.n - 1) * h * h
        return tuple(int(x) for x in np.cumsum([0, *sizes]))

    @property
    def size(self) -> int:
        return self.starts[-1]

    @property
    def state(self) -> int:
        """Numbers of q, p, q̇ and ṗ, with the constants of a step behind each."""
        return 4 * self.inputs

    @property
    def parts(self) -> dict[str, int]:
        """Numbers of what is kept of a sweep, of a direction, of the derivatives of what is fitted."""
        levels, h, d = self.n * self.h, self.h, self.ndof
        return dict.fromkeys(("z", "s", "u", "R", "r", "aj", "zj"), levels) | {
            "A": h, "RA": h, "G": d * self.size, "H": d * d, "P": 4 * d * d, "M": 4 * d * d,
        }  # fmt: skip

    @property
    def work(self) -> int:
        return 2 * sum(self.parts.values())  # with their rates

    def places(self, widths: Sequence[int]) -> np.ndarray:
        """Where each parameter of networks of these widths stands among the weights."""
        h, (K, k, w, b, W, _) = self.h, self.starts
        rows = [K + np.arange(widths[0] * self.inputs), k + np.arange(widths[0]), w + np.arange(widths[-1])]
        rows += [b + level * h + np.arange(width) for level, width in enumerate(widths)]
        for level, (below, above) in enumerate(pairwise(widths)):
            rows.append((W + (level * h + np.arange(above)[:, None]) * h + np.arange(below)).ravel())
        return np.concatenate(rows)


class _Sweeps:
    """The code of one network: its values, and their derivatives along directions and by the weights `theta`."""

    def __init__(self, code: Code, sizes: _Sizes, activation: str, velocity: bool, theta: Value, work: Value) -> None:
        self.code, self.sizes, self.velocity, self.theta = code, sizes, velocity, theta
        self.activation = activation_program(activation, 2)
        self.K, self.k, self.w, self.b, self.W, _ = sizes.starts
        self.rows: dict[str, Any] = {}
        at = 0
        for name, size in sizes.parts.items():
            place = Rows(code.at(work, at * LANES), REGISTER)
            self.rows[name] = DualRows(place, place.part(size)) if velocity else place
            at += 2 * size

    def weight(self, i: Any) -> Value:
        return self.code.splat(self.code.load(self.theta, i), LANES)

    def product(self, count: int, weight: Callable[[Any], Value], start: Any, row: Callable[[Any], Any]) -> Any:
        """start + Σ_m weight(m) row(m)."""
        if self.velocity and not isinstance(start, Dual):
            start = Dual(start, self.code.constant(0.0, REGISTER))

        def number(x: Sequence[Value]) -> Any:
            return Dual(*x) if self.velocity else x[0]

        def more(m: Value, total: Sequence[Value]) -> list[Value]:
            return _flat(fma(weight(m), row(m), number(total)))

        return number(self.code.loop(count, _flat(start), more))

    def sweep(self, x: Any, t: Any) -> None:
        """z, σ', σ'', and back R = Wᵀr' and r of all levels, at times t."""
        code, h, n, inputs = self.code, self.sizes.h, self.sizes.n, self.sizes.inputs
        z, s, u, R, r = (self.rows[name] for name in ("z", "s", "u", "R", "r"))
        zero = code.constant(0.0, REGISTER)

        def activated(at: Value, a: Any) -> None:
            z[at], s[at], u[at] = self.activation(a)

        def weighted(at: Value, total: Any) -> None:
            R[at], r[at] = total, total * s[at]

        with code.over(h) as i:
            start = fma(self.weight(i + self.k), t, self.weight(i + self.b))
            activated(i, self.product(inputs, lambda m: self.weight(i * inputs + m), start, x.__getitem__))
        with code.over(n - 1) as level, code.over(h) as i:
            row, below, start = (level * h + i) * h + self.W, level * h, self.weight((level + 1) * h + i + self.b)
            a = self.product(h, lambda m: self.weight(row + m), start, lambda m: z[below + m])
            activated((level + 1) * h + i, a)
        with code.over(h) as i:
            weighted(i + (n - 1) * h, self.weight(i + self.w))
        with code.over(n - 1) as down:
            level = (n - 2) - down
            with code.over(h) as m:
                column, above = level * (h * h) + m + self.W, (level + 1) * h
                total = self.product(h, lambda i: self.weight(column + i * h), zero, lambda i: r[above + i])
                weighted(level * h + m, total)

    def add_moved(self, r: Any, sign: Value, target: Any) -> None:
        """target += sign · Kᵀ r."""
        h, inputs = self.sizes.h, self.sizes.inputs
        with self.code.over(self.sizes.ndof) as j:
            zero = self.code.constant(0.0, REGISTER)
            target.add(j, (sign, self.product(h, lambda i: self.weight(i * inputs + j), zero, r.__getitem__)))

    def add_sensitivities(self, x: Any, t: Any, sign: Value, j: Value, weights: bool) -> None:
        """Add sign times the derivatives of ∂_jV by x to H, and by the `weights` to G."""
        code, sizes, rows = self.code, self.sizes, self.rows
        h, n, inputs, d = sizes.h, sizes.n, sizes.inputs, sizes.ndof
        z, s, u, R, r, aj, zj, A, RA = (rows[name] for name in ("z", "s", "u", "R", "r", "aj", "zj", "A", "RA"))
        G, zero = rows["G"].part(j * sizes.size), code.constant(0.0, REGISTER)

        def add(place: Any, *products: Any) -> None:
            if weights:
                G.add(place, *products)

        def along(at: Value, a: Any) -> None:
            aj[at], zj[at] = a, s[at] * a

        with code.over(h) as i:
            along(i, self.weight(i * inputs + j))
            RA[i] = zero
        with code.over(n - 1) as level, code.over(h) as i:
            row, below = (level * h + i) * h + self.W, level * h
            along((level + 1) * h + i, self.product(h, lambda m: self.weight(row + m), zero, lambda m: zj[below + m]))
        with code.over(n) as down:
            level = (n - 1) - down
            with code.over(h) as i:
                at = level * h + i
                A[i] = a = fma(R[at], u[at] * aj[at], RA[i] * s[at])
                add(at + self.b, (sign, a))
            with code.given(level > 0):
                below = (level - 1) * h
                with code.over(h) as i:
                    row, r_i, A_i = (below + i) * h + self.W, sign * r[level * h + i], sign * A[i]
                    with code.over(h if weights else 0) as m:
                        add(row + m, (r_i, zj[below + m]), (A_i, z[below + m]))
                with code.over(h) as m:
                    column = below * h + m + self.W
                    RA[m] = self.product(h, lambda i: self.weight(column + i * h), zero, A.__getitem__)
        with code.over(h) as i:
            A_i = sign * A[i]
            with code.over(inputs if weights else 0) as m:
                add(i * inputs + m, (A_i, x[m]))
            add(i * inputs + j, (sign, r[i]))
            add(i + self.k, (A_i, t))
            add(i + self.w, (sign, zj[i + (n - 1) * h]))
        self.add_moved(A, sign, rows["H"].part(j * d))


def _flat(x: Any) -> list[Value]:
    return [x.value, x.rate] if isinstance(x, Dual) else [x]


class _Points:
    """The code of blocks of points: their way through all layers, and back.

    The function takes the addresses of weights, kinds of layers, times, states, constants, `more` others, then of
    memory; the numbers of layers and of points, the first and the last block, then flags.
    """

    def __init__(self, code: Code, sizes: _Sizes, activation: str, velocity: bool, more: int) -> None:
        self.code, self.sizes, self.velocity = code, sizes, velocity
        self.theta, self.kicks, self.t, self.x, self.constants = code.arguments[:5]
        self.more, self.work = code.arguments[5 : 5 + more], code.arguments[5 + more]
        self.n_layers, self.n_points, self.first, self.last, *self.flags = code.arguments[6 + more :]
        self.states = Rows(code.at(self.work, sizes.work * LANES), REGISTER)
        self._given = sizes, activation, velocity

    def sweeps(self, code: Code, theta: Value, work: Value) -> _Sweeps:
        return _Sweeps(code, *self._given, theta, work)

    def swept(self, theta: Value, states: Rows, x: Value, k: Value, t: Value) -> tuple[_Sweeps, Any, Any]:
        """Call the sweep of a column, which stands in the module once; with its coordinates and times."""
        code = self.code
        rate = code.select(code.apply("eq", (k, 0)), code.constant(1.0), code.constant(0.0))
        place = states.part(x).place

        def given(x: Value, t: Value, rate: Value) -> tuple[Any, Any]:
            coordinates, times, rate = Rows(x, REGISTER), t, x.code.splat(rate, LANES)
            if not self.velocity:
                return coordinates, times * rate
            return DualRows(coordinates, coordinates.part(2 * self.sizes.inputs)), Dual(times * rate, rate)

        def body(theta: Value, x: Value, t: Value, rate: Value, work: Value) -> None:
            self.sweeps(theta.code, theta, work).sweep(*given(x, t, rate))

        code.outlined("sweep", [theta, place, t, rate, self.work], body)
        return self.sweeps(code, theta, self.work), *given(place, t, rate)

    def column(self, place: Value, i: Any, begin: Value) -> Value:
        """The numbers of a row of an array (…, N) at the points from `begin` on."""
        return self.code.load(place, i * self.n_points + begin, REGISTER)

    @contextmanager
    def blocks(self) -> Iterator[Value]:
        """The first point of each block: the last one ends with the last point."""
        with self.code.over(self.last - self.first) as block:
            yield self.code.apply("min", ((self.first + block) * LANES, self.n_points - LANES))

    def layer(self, i: Value) -> tuple[Value, Value, Value]:
        """Its weights, whether it is a kick, and its sign."""
        code = self.code
        kick = code.apply("eq", (code.load(self.kicks, i, INT), 1))
        sign = code.select(kick, code.constant(-1.0), code.constant(1.0))
        return code.at(self.theta, i * self.sizes.size), kick, sign

    def share(self, k: Value) -> Value:
        """The sign of a column."""
        code = self.code
        return code.select(code.apply("eq", (k, 0)), code.constant(1.0), code.constant(-1.0))

    def forward(self, begin: Value) -> Value:
        """The states q, p, q̇, ṗ before each layer and after the last one, and the times."""
        code, sizes, d, inputs = self.code, self.sizes, self.sizes.ndof, self.sizes.inputs
        t = self.column(self.t, 0, begin)
        for half in range(2):
            with code.over(d) as m:
                self.states[m + half * inputs] = self.column(self.x, m + half * d, begin)
                self.states[m + (2 + half) * inputs] = 0.0
            with code.over(inputs - d) as m:
                self.states[m + (half * inputs + d)] = self.column(self.constants, m, begin)
                self.states[m + ((2 + half) * inputs + d)] = 0.0
        with code.over(self.n_layers) as i:
            theta, kick, sign = self.layer(i)
            before, after = self.states.part(i * sizes.state), self.states.part((i + 1) * sizes.state)
            with code.over(sizes.state) as m:
                after[m] = before[m]
            x, target = code.select(kick, 0 * i, 0 * i + inputs), code.select(kick, 0 * i + inputs, 0 * i)
            with code.over(2) as k:  # the columns t and 0
                sweeps, _, _ = self.swept(theta, before, x, k, t)
                end = after.part(target)
                moved = DualRows(end, end.part(2 * inputs)) if self.velocity else end
                sweeps.add_moved(sweeps.rows["r"], code.splat(sign * self.share(k), LANES), moved)
        return t

    def values(self) -> None:
        """Rows (2d or 4d, N) of ψ̄_t(x) and d/dt ψ̄_t(x)."""
        code, d, inputs = self.code, self.sizes.ndof, self.sizes.inputs
        (out,) = self.more
        with self.blocks() as begin:
            self.forward(begin)
            end = self.states.part(self.n_layers * self.sizes.state)
            for part in range(4 if self.velocity else 2):
                with code.over(d) as m:
                    code.store(end[m + part * inputs], out, (m + part * d) * self.n_points + begin)

    def jacobian(self, weights: bool = True) -> None:
        """See `NetworkTangents.jacobian`."""
        code, sizes, d, inputs, size = self.code, self.sizes, self.sizes.ndof, self.sizes.inputs, self.sizes.size
        by_state, by_velocity, units, places, J, by_start = self.more
        n_own, starts = self.flags
        rows = self.sweeps(code, self.theta, self.work).rows
        G, H, (P, M) = rows["G"], rows["H"], (x.values if self.velocity else x for x in (rows["P"], rows["M"]))
        zero = code.constant(0.0, REGISTER)
        with self.blocks() as begin:
            t = self.forward(begin)
            with code.over(2 * d) as row:
                with code.over(2 * d) as m:
                    P[row * (2 * d) + m] = self.column(by_state, row * (2 * d) + m, begin)
                    M[row * (2 * d) + m] = zero
                M[row * (2 * d + 1)] = code.splat(code.load(by_velocity, row), LANES)
            with code.over(self.n_layers) as down:
                i = self.n_layers - 1 - down
                theta, kick, sign = self.layer(i)
                before = self.states.part(i * sizes.state)
                x = code.select(kick, 0 * i, 0 * i + inputs)
                old, new = code.select(kick, 0 * i + d, 0 * i), code.select(kick, 0 * i, 0 * i + d)
                with code.over(d * size if weights else 0) as m:
                    G[m] = zero
                with code.over(d * d) as m:
                    H[m] = zero
                with code.over(2) as k:  # the columns t and 0
                    sweeps, coordinates, times = self.swept(theta, before, x, k, t)
                    with code.over(d) as j:
                        sweeps.add_sensitivities(coordinates, times, code.splat(self.share(k), LANES), j, weights)
                with code.over(n_own) as parameter:
                    place, number = code.load(places, parameter, INT), i * n_own + parameter
                    unit = code.splat(sign * code.load(units, number), LANES)
                    with code.over(2 * d) as row:
                        total = code.variable(zero)
                        with code.over(d) as j:
                            at, slope = row * (2 * d) + old + j, _flat(G[j * size + place])
                            found = fma(P[at], slope[0], total.value)
                            total.value = fma(M[at], slope[1], found) if self.velocity else found
                        code.store(unit * total.value, J, (number * (2 * d) + row) * self.n_points + begin)
                change = code.splat(sign, LANES)
                with code.over(2 * d) as row, code.over(d) as m:
                    of_state, of_velocity = code.variable(zero), code.variable(zero)
                    with code.over(d) as j:
                        at, slope = row * (2 * d) + old + j, _flat(H[j * d + m])
                        of_state.value = fma(P[at], slope[0], of_state.value)
                        if self.velocity:
                            of_state.value = fma(M[at], slope[1], of_state.value)
                            of_velocity.value = fma(M[at], slope[0], of_velocity.value)
                    at = row * (2 * d) + new + m
                    P.add(at, (change, of_state.value))
                    if self.velocity:
                        M.add(at, (change, of_velocity.value))
            with code.over(starts) as _, code.over(4 * d * d) as m:
                code.store(P[m], by_start, m * self.n_points + begin)


@cache
def _compiled(name: str, sizes: _Sizes, activation: str, velocity: bool) -> Callable[..., None]:
    """The function `values`, or `jacobian`, with derivatives by the weights or without ("by start")."""
    more, flags = (1, 0) if name == "values" else (6, 2)
    code = begun("tangents", [*[POINTER] * (6 + more), *[INT] * (4 + flags)])
    points = _Points(code, sizes, activation, velocity, more)
    if name == "values":
        points.values()
    else:
        points.jacobian(name == "jacobian")
    return finished(code)
