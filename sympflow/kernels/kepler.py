"""Compiled runs of planets about a star: Kepler's motion | interaction, the planets side by side in registers.

A state has, for each group of eight planets, their three coordinates and three velocities, a register each. A column
is a kick and the drift after it. The drift guesses X by a series of third order and corrects it twice by Halley's
method, with addition theorems in place of new series; where that is not enough, which is tested, the general solver
does it.

References
----------
.. [1] J. Wisdom, M. Holman, "Symplectic maps for the n-body problem", Astron. J. 102 (1991) 1528–1538.
.. [2] H. Rein, D. Tamayo, "WHFast: a fast and unbiased implementation of a symplectic Wisdom–Holman integrator for
   long-term gravitational simulations", Mon. Not. R. Astron. Soc. 452 (2015) 376–388.
.. [3] P. Javaheri, H. Rein, D. Tamayo, "WHFast512: a symplectic N-body integrator for planetary systems optimized with
   AVX512 instructions", Open J. Astrophys. 6 (2023), arXiv:2307.05683.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler.control import Code, Type, Value
from sympflow.compiler.functions import where
from sympflow.hamiltonian.kepler import coefficients, dot, kepler_flow, moved, series
from sympflow.hamiltonian.planets import Frame
from sympflow.kernels.protocol import Batch, Kernel, Run, Steps, Task, run_states
from sympflow.kernels.rollouts import Columns, Rollouts, zeros
from sympflow.kernels.runs import Numbers, Room

__all__ = ["KeplerKernel", "Substeps"]

LANES, LANES_SHIFT = 8, 3
AXES = 3
NUMBERS = 2 * AXES * LANES  # of a group of planets
MOST_GROUPS = 4  # whose pairs are written out
TERMS, LONGEST = 9, 2.0  # of the series of a drift, and the βX² up to which they do
AWAY = 1e3  # of the largest orbit: where lanes without a planet are
WORK = 250  # nanoseconds of a stage
ONE = np.ones(1, dtype=np.int64)
ROWS = ("Gm", "mu", "weight", "ratio", "over", "mass", "star", "share")
"""Constants of each planet: Gm, μ, its share in the mass up to it, that mass over the one before, 1 over that, m, the
G m of the star, its mass as a part of the star's."""

Substeps = Sequence[tuple[float, float]]
"""Kicks and the drifts after them, one after the other, of a step or a processor, times its length."""
Vectors = list[Value]


class KeplerCode(Rollouts):
    """The stages of a frame with so many groups of planets."""

    lanes, fewest = 1, 1

    def __init__(self, frame: Frame) -> None:
        self.light = places_of_light(frame)
        self.groups = -(-(len(frame.order) + bool(self.light)) // LANES)  # with one lane behind all planets
        whole = NUMBERS * (self.groups + len(self.light))
        super().__init__(whole, whole)
        self.planets = len(frame.order)
        self.jacobi, self.watches = frame.jacobi, frame.encounter is not None
        planets = LANES * self.groups
        self.room, self.size = 3 * AXES * planets, 2
        table, limits = constants(frame, self.groups)
        self.report = zeros(AXES * (planets + LANES) + 1)
        inside = np.array([frame.inside[group[0]] for group in self.light])
        of_light = np.stack([frame.G * frame.sums[inside], 1 / frame.sums[inside], inside]) if len(inside) else zeros(1)
        near = np.zeros(planets)
        near[: len(frame.order)] = ((frame.encounter or 0.0) * frame.hill_radii(frame.order, frame.order, 0.0)) ** 2
        self.data = (table, limits, self.report, np.ascontiguousarray(of_light), near)

    def stage(self, room: Room, numbers: Numbers, kind: Value, step: Value) -> None:  # type: ignore[override]
        """A kick and a drift, which may be of length 0."""
        code, type = room.code, Type("double", LANES)
        kick, drift = (code.splat(numbers(i), LANES) for i in range(2))
        table = room.data(0)
        known = [
            [code.load(table, (len(ROWS) * g + i) * LANES, type) for i in range(len(ROWS))] for g in range(self.groups)
        ]
        c = [dict(zip(ROWS, rows, strict=True)) for rows in known]
        state = [
            [code.load(room.state, NUMBERS * g + LANES * i, type) for i in range(2 * AXES)] for g in range(self.groups)
        ]
        x, v = ([group[k : k + AXES] for group in state] for k in (0, AXES))
        if not self.jacobi:
            x = self._jumped(x, v, c, 0.5 * kick)
        roots = [sqrt(dot(each, each)) for each in x]
        inverses = [1.0 / r for r in roots]
        v, kick = self._kicked(room, x, v, c, kick, inverses)
        if not self.jacobi:
            x = self._jumped(x, v, c, 0.5 * kick)
            roots = [sqrt(dot(each, each)) for each in x]
            inverses = [1.0 / r for r in roots]
        for g in range(self.groups):
            new = drifted(x[g], v[g], c[g]["mu"], drift, roots[g], inverses[g])
            for i, value in enumerate([*new[0], *new[1]]):
                code.store(value, room.state, NUMBERS * g + LANES * i)
        if len(self.light):
            with code.over(len(self.light)) as turn:
                self._light(room, turn, kick, drift, c[0]["star"])

    def _light(self, room: Room, g: Value, kick: Value, drift: Value, star: Value) -> None:
        """The same of a group of bodies without mass, which have the same planets inside their orbits."""
        code, type, light = room.code, Type("double", LANES), len(self.light)
        place = code.at(room.state, (g + self.groups) * NUMBERS)
        x, v = ([code.load(place, LANES * (k + i), type) for i in range(AXES)] for k in (0, AXES))
        mu, over, inside = (code.splat(code.load(room.data(3), g + light * i), LANES) for i in range(3))
        inside = code.convert("fptosi", code.lane(inside, 0), "i64")
        planets = LANES * self.groups

        def vector(which: int, j: Any) -> Vectors:
            start = AXES * planets * which
            return [code.splat(code.load(room.work, j + (start + planets * i)), LANES) for i in range(AXES)]

        h = [y + p for y, p in zip(x, vector(1, inside), strict=True)]
        square, own = dot(h, h), dot(x, x)
        pull, r = star / (square * sqrt(square)), sqrt(own)
        inverse = 1.0 / r
        a = [over * p - pull * y for p, y in zip(vector(2, inside), h, strict=True)]

        def added(j: Value, total: list[Value]) -> list[Value]:
            d = [p - y for p, y in zip(vector(0, j), h, strict=True)]
            distance = dot(d, d)
            w = code.splat(code.load(room.data(0), self._of_mass(j)), LANES) / (distance * sqrt(distance))
            limit = code.splat(code.load(room.data(4), j), LANES)
            return [
                code.apply("min", (total[0], distance - limit)),
                *(p + w * q for p, q in zip(total[1:], d, strict=True)),
            ]

        start = code.splat(code.constant(float("inf")), LANES)
        near, *a = code.loop(self.planets, [start, *a], added)
        if self.watches:
            kick = kick + self._met(room, code.any(near < 0.0), [h], kick, g)
        own = mu * inverse * inverse * inverse
        v = [q + kick * (p + own * y) for q, p, y in zip(v, a, x, strict=True)]
        new = drifted(x, v, mu, drift, r, inverse)
        for i, value in enumerate([*new[0], *new[1]]):
            code.store(value, place, LANES * i)

    def _of_mass(self, j: Value) -> Value:
        """Where G m of planet j stands in the table."""
        group = j >> LANES_SHIFT
        return j + group * (LANES * (len(ROWS) - 1))

    def _kicked(
        self, room: Room, x: list[Vectors], v: list[Vectors], c: list[dict[str, Value]], t: Value, inverses: Vectors
    ) -> tuple[list[Vectors], Value]:
        """The velocities after a kick, and its length, which is NaN where planets met."""
        code, groups, zero = room.code, range(self.groups), room.code.constant(0.0, x[0][0].type)
        h = self._heliocentric(x, c) if self.jacobi else x
        a = [[zero] * AXES for _ in groups]
        close = None
        limits = room.data(1)
        for one in groups:
            for other in range(one, self.groups):
                turns = range(1, LANES // 2 + 1) if one == other else range(LANES)
                for k in turns:
                    to, back = ([(i + s * k) % LANES for i in range(LANES)] for s in (1, -1))
                    d = [code.shuffle(z, z, to) - y for y, z in zip(h[one], h[other], strict=True)]
                    square = dot(d, d)
                    w = 1.0 / (square * sqrt(square))
                    mine = w * code.shuffle(c[other]["Gm"], zero, to)
                    a[one] = [p + q * mine for p, q in zip(a[one], d, strict=True)]
                    if one != other or k < LANES // 2:
                        theirs = w * c[one]["Gm"]
                        a[other] = [p - code.shuffle(q * theirs, zero, back) for p, q in zip(a[other], d, strict=True)]
                    if self.watches:
                        near = square < code.load(
                            limits, ((one * self.groups + other) * LANES + k) * LANES, square.type
                        )
                        close = near if close is None else close | near
        if close is not None:
            t = t + self._met(room, code.any(close), h, t)
        new = []
        if not self.jacobi:
            return [[p + t * q for p, q in zip(v[g], a[g], strict=True)] for g in groups], t
        behind = [zero] * AXES
        for g in reversed(groups):
            star, own = (c[g][name] for name in ("star", "mu"))
            square = dot(h[g], h[g])
            pull = star / (square * sqrt(square))
            a[g] = [p - pull * y for p, y in zip(a[g], h[g], strict=True)]
            own = own * inverses[g] * inverses[g] * inverses[g]
            weighted = [c[g]["mass"] * p for p in a[g]]
            outer = [_suffix(code, p, zero) + q for p, q in zip(weighted, behind, strict=True)]
            behind = (
                [q + code.splat(code.total(p), LANES) for p, q in zip(weighted, behind, strict=True)] if g else behind
            )
            change = [c[g]["ratio"] * p + c[g]["over"] * q + own * y for p, q, y in zip(a[g], outer, x[g], strict=True)]
            new.append([p + t * q for p, q in zip(v[g], change, strict=True)])
            if len(self.light):
                before = [y - z for y, z in zip(h[g], x[g], strict=True)]
                all_behind = [p + q for p, q in zip(weighted, outer, strict=True)]
                for which, vector in enumerate((h[g], before, all_behind)):
                    for i, value in enumerate(vector):
                        start = LANES * (self.groups * (AXES * which + i) + g)
                        code.store(value, room.work, start)
        return new[::-1], t

    def _heliocentric(self, x: list[Vectors], c: list[dict[str, Value]]) -> list[Vectors]:
        """Places as seen from the star, of those from the centre of all inside."""
        code, h = x[0][0].code, []
        zero = code.constant(0.0, x[0][0].type)
        before = [zero] * AXES
        for g, group in enumerate(x):
            weighted = [c[g]["weight"] * y for y in group]
            h.append([y + (_prefix(code, w, zero) + b) for y, w, b in zip(group, weighted, before, strict=True)])
            if g + 1 < self.groups:
                before = [b + code.splat(code.total(w), LANES) for w, b in zip(weighted, before, strict=True)]
        return h

    def _jumped(self, x: list[Vectors], v: list[Vectors], c: list[dict[str, Value]], t: Value) -> list[Vectors]:
        """Places moved with the star, whose momentum is that of the planets reversed."""
        code = t.code
        jump = []
        for k in range(AXES):
            parts = [code.splat(code.total(c[g]["share"] * v[g][k]), LANES) for g in range(self.groups)]
            jump.append(t * sum(parts[1:], parts[0]))
        return [[y + j for y, j in zip(group, jump, strict=True)] for group in x]

    def _met(self, room: Room, met: Value, h: list[Vectors], like: Value, light: Value | None = None) -> Value:
        """NaN where two planets met, whose places are then written down; else 0."""
        code = room.code

        def told() -> Vectors:
            group = code.constant(-1.0) if light is None else code.convert("sitofp", light, "double")
            code.store(group, room.data(2), len(self.report) - 1)
            places = [y for group in h for y in group]
            if light is not None:
                turns = [(g, i) for g in range(self.groups) for i in range(AXES)]
                planets = [code.load(room.work, LANES * (self.groups * i + g), like.type) for g, i in turns]
                places = [*planets, *places]
            for i, value in enumerate(places):
                code.store(value, room.data(2), LANES * i)
            return [code.constant(float("nan"), like.type)]

        return code.when(met, told, lambda: [code.constant(0.0, like.type)], rare=True)[0]


def sqrt(x: Any) -> Any:
    return x.apply("sqrt", (x,))


def _prefix(code: Code, x: Value, zero: Value) -> Value:
    """The sum of all lanes before each."""
    s = code.shuffle(x, zero, [LANES, *range(LANES - 1)])
    for k in (1, 2, 4):
        s = s + code.shuffle(s, zero, [LANES] * k + [*range(LANES - k)])
    return s


def _suffix(code: Code, x: Value, zero: Value) -> Value:
    """The sum of all lanes behind each."""
    s = code.shuffle(x, zero, [*range(1, LANES), LANES])
    for k in (1, 2, 4):
        s = s + code.shuffle(s, zero, [*range(k, LANES)] + [LANES] * k)
    return s


def drifted(x: Vectors, v: Vectors, mu: Value, t: Value, r: Value, inverse: Value) -> tuple[Vectors, Vectors]:
    """Kepler's motion of all lanes: a few steps that suit short times, or the general solver where they do not."""
    code = t.code
    eta = dot(x, v)
    beta = 2.0 * mu * inverse - dot(v, v)
    zeta = mu - beta * r
    u = t * inverse
    a, b = eta * inverse, zeta * inverse
    X = u * (1.0 - u * (0.5 * a - u * (0.5 * a * a - b * (1 / 6))))
    G = series(X, beta, TERMS)
    errors = []
    for terms, most in ((4, 1e2), (2, 1e6)):
        G0, G1, G2, G3 = G
        f, slope, bend = r * X + (eta * G2 + zeta * G3) - t, r + (eta * G1 + zeta * G2), eta * G0 + zeta * G1
        d = -(f * slope) / (slope * slope - 0.5 * (f * bend))
        g0, g1, g2, g3 = series(d, beta, terms)
        X = X + d
        G = G0 * g0 - beta * (G1 * g1), G1 * g0 + G0 * g1, G2 + (G1 * g1 + G0 * g2), G3 + (G2 * d + (G1 * g2 + G0 * g3))
        errors.append(most * (d * d))
    *c, d, _ = coefficients(X, G, r, inverse, eta, zeta, mu, t)
    fast = [y for group in moved(x, v, c) for y in group]
    square = X * X
    worst = code.apply("max", (code.apply("max", (errors[0], errors[1])), 1e16 * (d * d)))
    size = code.apply("abs", (beta * square,))
    late = 2.0 * code.apply("abs", (t - c[1],))
    bad = (square < worst) | (size > LONGEST) | (code.apply("abs", (t,)) < late)

    def again() -> Vectors:
        types = [value.type for value in (*x, *v, mu, t)]
        packed = Type(f"{{ {', '.join(str(y.type) for y in fast)} }}")

        def body(*given: Value) -> Value:
            new = kepler_flow(given[:3], given[3:6], given[6], given[7])
            return code_of(given).pack([*new[0], *new[1]])

        exact = code.unpack(code.outlined("kepler", [*x, *v, mu, t], body, packed, rare=True), types[:6])
        return [where(bad, y, z) for y, z in zip(exact, fast, strict=True)]

    new = code.when(code.any(bad), again, lambda: fast, rare=True)
    return new[:3], new[3:]


def code_of(values: Sequence[Value]) -> Code:
    return values[0].code


def places_of_light(frame: Frame) -> list[np.ndarray]:
    """The bodies without mass in groups of eight, or fewer, with the same planets inside of their orbits."""
    order = np.argsort(frame.inside, kind="stable")
    classes = np.split(order, np.flatnonzero(np.diff(frame.inside[order])) + 1) if len(order) else []
    return [members[k : k + LANES] for members in classes for k in range(0, len(members), LANES)]


def constants(frame: Frame, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """The `ROWS` of each group, and the squares of distances at which lanes meet, for each two groups and turn."""
    n, masses, G = len(frame.order), frame.masses, frame.G
    table = np.zeros((len(ROWS), groups * LANES))
    m, S = masses[frame.order], frame.sums
    table[:, :] = np.array([0.0, G * S[-1], 0.0, 1.0, 0.0, 0.0, G * masses[0], 0.0])[:, None]
    table[:, :n] = [
        G * m,
        frame.mu[:n],
        m / S[1:],
        S[1:] / S[:-1],
        1 / S[:-1],
        m,
        np.full(n, G * masses[0]),
        m / masses[0],
    ]
    limits = np.zeros((groups * LANES, groups * LANES))
    i, j = np.triu_indices(n, 1)
    limits[i, j] = limits[j, i] = frame.limits
    met = np.zeros((groups, groups, LANES, LANES))
    lane = np.arange(LANES)
    for one in range(groups):
        for other in range(groups):
            for k in range(LANES):
                met[one, other, k] = limits[one * LANES + lane, other * LANES + (lane + k) % LANES]
    ordered = table.reshape(len(ROWS), groups, LANES).swapaxes(0, 1)
    return np.ascontiguousarray(ordered).ravel(), met.ravel()


class KeplerLoops:
    """The states of a frame as the registers of its code, and back."""

    def __init__(self, frame: Frame) -> None:
        n = len(frame.order)
        if not n or n > MOST_GROUPS * LANES - 1 or (len(frame.test) and not frame.jacobi):
            raise ValueError(
                f"`system` has {n} planets with a mass, and compiled code is for 1 to {MOST_GROUPS * LANES - 1}, with "
                "bodies without mass in Jacobi's coordinates only: use backend='array'."
            )
        self.frame, self.code = frame, KeplerCode(frame)
        size = AWAY * frame.size.max()
        spare = LANES * self.code.groups - n
        self._spare = np.zeros((spare, 2 * AXES))
        self._spare[:, 0] = size * (1 + np.arange(spare))
        self._spare[:, AXES + 1] = np.sqrt(frame.G * frame.sums[-1] / self._spare[:, 0])

        lanes = np.arange(LANES)
        light = [n + group[np.minimum(lanes, len(group) - 1)] for group in self.code.light]
        self._given = np.concatenate(
            [np.arange(n), np.arange(n + len(frame.test), n + len(frame.test) + spare), *light]
        )
        self._found = np.zeros(n + len(frame.test), dtype=int)
        self._found[:n] = np.arange(n)
        for g, group in enumerate(self.code.light):
            self._found[n + group] = LANES * (self.code.groups + g) + lanes[: len(group)]

    def rows(self, y: np.ndarray) -> np.ndarray:
        """The running states (N, n_values) of states (N, 2d)."""
        x, v, *_ = self.frame.into(y)
        planets = np.concatenate([x, v], axis=-1)
        planets = np.concatenate([planets, np.broadcast_to(self._spare, (len(y), *self._spare.shape))], axis=1)
        groups = planets[:, self._given].reshape(len(y), -1, LANES, 2 * AXES).swapaxes(-1, -2)
        return np.ascontiguousarray(groups).reshape(len(y), -1)

    def states(self, rows: np.ndarray, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states (..., n, 2d) after times (n,) of running ones, of runs from y0 (..., 2d)."""
        y = self.moved(rows, y0[..., None, :], times)
        y[..., times == 0, :] = y0[..., None, :]
        return y

    def moved(self, rows: np.ndarray, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states of running ones (..., n_values), after times since those y0 (..., 2d)."""
        *_, Q, U = self.frame.into(y0)
        groups = len(self._given) // LANES
        planets = rows.reshape(*rows.shape[:-1], groups, 2 * AXES, LANES).swapaxes(-1, -2)
        planets = planets.reshape(*rows.shape[:-1], groups * LANES, 2 * AXES)[..., self._found, :]
        centre = Q + times[..., None] * U
        return self.frame.out(planets[..., :AXES], planets[..., AXES:], centre, U + 0 * centre)


class KeplerKernel(Kernel):
    """The compiled loops of a scheme of kicks by the interaction and Kepler's drifts, with or without a processor.

    Parameters
    ----------
    loops : KeplerLoops
    substeps : Substeps
        Of a step of length 1.
    before, after : Substeps
        The processor and its inverse; empty for none.
    """

    def __init__(self, loops: KeplerLoops, substeps: Substeps, before: Substeps = (), after: Substeps = ()) -> None:
        self.loops, self.before, self.after, self.step_itself = loops, before, after, [*before, *substeps, *after]
        *rest, last = substeps
        first = rest[0] if rest else last
        ends = first[0] == 0 or last[1] == 0  # with what the next step begins with
        inner, end = (rest[1:], last) if ends else ([*rest[1:], last], (0.0, 0.0))
        link = (end[0] + first[0], end[1] + first[1])
        self.columns = np.array([first, *inner, link, end])

    def _table(self, h: Any, columns: Any) -> Columns:
        entries = np.asarray(h, dtype=float)[..., None, None] * np.asarray(columns)
        return np.ascontiguousarray(entries), np.zeros(len(columns), dtype=np.int64)

    def runs(self, task: Task) -> Run:
        loops, columns, start = self.loops, self._table(task.h, self.columns), self.loops.rows(task.y0)
        if self.before:
            after = self._table(task.h, [self.columns[-1], *self.after])
            run = partial(loops.code.run_processed, self._table(task.h, self.before), columns, after)
        else:
            run = partial(loops.code.run, columns)
        rows, n_finite, _ = run_states(run, task._replace(y0=start), start.shape[1], WORK * len(self.columns))
        self.remark = self._pair() if len(start) == 1 and n_finite[0] < task.n_steps else ""
        return Run(loops.states(rows, task.y0, task.save * task.h), n_finite)

    def _pair(self) -> str:
        """A sentence on the bodies that met."""
        frame, code = self.loops.frame, self.loops.code
        if frame.encounter is None or not code.report.any():
            return ""
        *places, group = code.report
        x = np.reshape(places, (-1, AXES, LANES)).swapaxes(1, 2).reshape(-1, AXES)
        one, other = frame.pairs
        start, end = np.triu_indices(code.planets, 1)
        share = 1.0
        if group >= 0:  # a planet and one of a group of bodies without mass
            members = code.light[int(group)]
            start, end = (z.ravel() for z in np.indices((code.planets, len(members))))
            one, other, share = frame.order[start], frame.test[members[end]], 0.0
            end = end + LANES * code.groups
        distance = np.linalg.norm(x[start] - x[end], axis=-1)
        radii = distance / frame.hill_radii(one, one if share == 0 else other, share)
        k = int(np.argmin(radii))
        first, second = sorted((int(one[k]), int(other[k])))
        return f" Bodies {first} and {second} were {distance[k]:.4g} apart, {radii[k]:.3g} Hill radii."

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        columns = [*self.step_itself, (0.0, 0.0), (0.0, 0.0)]
        rows = self.loops.rows(y)
        start = np.concatenate([rows, np.arange(len(y), dtype=float)[:, None]], axis=1)
        batch = Batch.whole(start, 1, ONE, rows.shape[1])
        self.loops.code.run(self._table(lengths, columns), batch, False)
        return Steps(self.loops.moved(batch.out[:, 0], y, lengths))
