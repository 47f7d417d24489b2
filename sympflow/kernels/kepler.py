"""Compiled runs of planets about a star: Kepler's motion | interaction, the planets side by side in registers.

A state has, for each group of eight planets, their three coordinates and three velocities, a register each. A column
is a kick and the drift after it. The drift guesses X by a series of third order and corrects it twice by Halley's
method, the first time with addition theorems in place of new series; where that is not enough, which is tested, the
general solver does it. A number is a register, or a dual one, of a register and its rate along a deviation vector.

References
----------
.. [1] J. Wisdom, M. Holman, "Symplectic maps for the n-body problem", Astron. J. 102 (1991) 1528–1538.
.. [2] H. Rein, D. Tamayo, "WHFast: a fast and unbiased implementation of a symplectic Wisdom–Holman integrator for
   long-term gravitational simulations", Mon. Not. R. Astron. Soc. 452 (2015) 376–388.
.. [3] P. Javaheri, H. Rein, D. Tamayo, "WHFast512: a symplectic N-body integrator for planetary systems optimized with
   AVX512 instructions", Open J. Astrophys. 6 (2023), arXiv:2307.05683.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import NotCompiled, arrays_only
from sympflow.compiler.control import INT, Type, Value
from sympflow.compiler.dual import Dual
from sympflow.compiler.functions import fma, where
from sympflow.hamiltonian.kepler import coefficients, dot, kepler_changes, moved, series, varied
from sympflow.hamiltonian.planets import Frame
from sympflow.kernels.protocol import Batch, Kernel, Run, Steps, Task, run_states
from sympflow.kernels.reverse import Chained
from sympflow.kernels.rollouts import Columns, Rollouts, zeros
from sympflow.kernels.runs import Numbers, Room
from sympflow.kernels.tangents import EVERY, TangentKernel, exponent_of
from sympflow.kernels.threads import run_in_threads, threads_for
from sympflow.lazy import kept
from sympflow.schemes import Substeps

__all__ = ["KeplerFlowKernel", "KeplerKernel", "KeplerLoops", "KeplerTangents", "kepler_loops"]

LANES, LANES_SHIFT = 8, 3
AXES = 3
NUMBERS = 2 * AXES * LANES  # of a group of planets
MOST_GROUPS = 4  # whose pairs are written out
TERMS, ROUGH, LONGEST = 9, 6, 2.0  # of the series of a drift, of the first one, and the βX² up to which they do
NUDGE = 1e-12  # of X, which the linear step after it takes back: where that is lost in rounding, there is a bias
AWAY = 1e3  # of the largest orbit: where lanes without a planet are
WORK = 250  # nanoseconds of a stage
REGISTER = Type("double", LANES)
POWERS = np.array([1, 1, 3])  # of the step, with which the numbers of a column grow
ROWS = ("Gm", "mu", "weight", "ratio", "over", "mass", "star", "share")
"""Constants of each planet: Gm, μ, its share in the mass up to it, that mass over the one before, 1 over that, m, the
G m of the star, its mass as a part of the star's."""

Vectors = list[Any]


class Form(NamedTuple):
    """Contents of a run: deviation vectors, which may grow without bound, force gradients, compensated sums."""

    vectors: int = 0
    grows: bool = False
    gradients: bool = False
    compensated: bool = False


class Sum:
    """A number that is changed often; with an error that is the part of the changes which rounding left out."""

    __slots__ = ("error", "value")

    def __init__(self, value: Any, error: Value | None) -> None:
        self.value, self.error = value, error

    def add(self, change: Any) -> None:
        if self.error is None:
            self.value = self.value + change
            return
        change = change + self.error
        new = self.value + change
        self.error = change - (new - self.value)
        self.value = new


class KeplerCode(Rollouts):
    """The stages of a frame with so many groups of planets."""

    lanes, fewest = 1, 1

    def __init__(self, frame: Frame, form: Form, part: slice = slice(None)) -> None:
        self.light = places_of_light(frame)[part]
        self.groups = -(-(len(frame.order) + bool(self.light)) // LANES)  # with one lane behind all planets
        self.form, self.whole = form, NUMBERS * (self.groups + len(self.light))
        n_values = self.whole * (1 + form.vectors + form.compensated) + form.vectors * form.grows
        super().__init__(n_values, self.whole if form.compensated else n_values)
        self.every = EVERY if form.grows else None
        self.planets = len(frame.order)
        self.jacobi, self.watches = frame.jacobi, frame.encounter is not None
        planets = LANES * self.groups
        self.told = 3 * AXES * planets  # numbers that bodies without mass need of the planets, without their rates
        self.room, self.size = (2 if form.vectors else 1) * self.told, 3 if form.gradients else 2
        table, limits = constants(frame, self.groups)
        self.report = zeros(AXES * (planets + LANES) + 1)
        inside = np.array([frame.inside[group[0]] for group in self.light])
        heavy = frame.sums[inside if frame.jacobi else 0 * inside] if len(inside) else zeros(0)
        of_light = np.stack([frame.G * heavy, 1 / heavy, inside]) if len(inside) else zeros(1)
        near = np.zeros(planets)
        near[: len(frame.order)] = ((frame.encounter or 0.0) * frame.hill_radii(frame.order, frame.order, 0.0)) ** 2
        self.extra = frame.extra
        values = zeros(1) if self.extra is None else np.array(self.extra[1])
        self.data = (table, limits, self.report, np.ascontiguousarray(of_light), near, values)

    def stage(self, room: Room, numbers: Numbers, kind: Value, step: Value) -> None:  # type: ignore[override]
        """A kick and a drift, which may be of length 0."""
        given = [room.place, room.work.place, room.places, *(numbers(i) for i in range(self.size))]
        room.code.outlined("stage", given, self._stage)

    def _stage(self, state: Value, work: Value, places: Value, *numbers: Value) -> None:
        code = state.code
        room = Room(state, 1, work, code.constant(self.n_values, INT), places)
        lengths = [code.splat(x, LANES) for x in numbers]
        table = room.data(0)
        known = [
            [code.load(table, (len(ROWS) * g + i) * LANES, REGISTER) for i in range(len(ROWS))]
            for g in range(self.groups)
        ]
        c = [dict(zip(ROWS, rows, strict=True)) for rows in known]

        def moved(vector: Value | None = None) -> None:
            kick = self._moved(room, c, lengths, vector)
            if len(self.light):
                with code.over(len(self.light)) as turn:
                    self._light(room, turn, kick, lengths[1], c[0]["star"], vector)

        if self.form.vectors:
            with code.over(self.form.vectors) as k:
                moved(code.at(state, (k + 1) * self.whole))
        moved()

    def _moved(
        self, room: Room, c: list[dict[str, Value]], lengths: Sequence[Value], vector: Value | None = None
    ) -> Value:
        """Move the planets, or in their place a deviation vector by the derivative of that, and return the kick."""
        code, groups = room.code, range(self.groups)
        (kick, drift, *third) = lengths
        state = [self._read(room, code.at(room.place, NUMBERS * g), vector, NUMBERS * g) for g in groups]
        if not self.jacobi:
            self._jump(room, state, c, 0.5 * kick, 1)
        x = [values(group[:AXES]) for group in state]
        roots = [sqrt(dot(each, each)) for each in x]
        inverses = [1.0 / r for r in roots]
        looks = self.watches and vector is None
        watch = (lambda near, h: kick + self._met(room, code.any(near), h, kick)) if looks else None
        a, kick = self._accelerations(room, x, c, inverses, kick, watch)
        changes = [kick * y for group in a for y in group]
        if third:

            def bent() -> Vectors:
                again = [[Dual(y, b) for y, b in zip(*z, strict=True)] for z in zip(x, a, strict=True)]
                rates, _ = self._accelerations(room, again, c, [1.0 / sqrt(dot(y, y)) for y in again], kick)
                found = [y.rate for group in rates for y in group]
                return [y + third[0] * z for y, z in zip(changes, found, strict=True)]

            # the kicks of a processor may have force gradients where those of a step have none
            bends = code.any(third[0] < 0.0) | code.any(third[0] > 0.0)
            changes = code.when(bends, bent, lambda: changes) if vector is None else bent()
        for k, change in enumerate(changes):
            state[k // AXES][AXES + k % AXES].add(change)
        if not self.jacobi:
            self._jump(room, state, c, 0.5 * kick, 2)
            x = [values(group[:AXES]) for group in state]
            roots = [sqrt(dot(each, each)) for each in x]
            inverses = [1.0 / r for r in roots]
        for g in groups:
            v = values(state[g][AXES:])
            changes = drifted(x[g], v, c[g]["mu"], drift, roots[g], inverses[g])
            for y, change in zip(state[g], changes, strict=True):
                y.add(change)
            self._write(room, code.at(room.place, NUMBERS * g), state[g], vector, NUMBERS * g)
        return kick

    def _read(self, room: Room, place: Value, vector: Value | None = None, at: Any = 0) -> list[Sum]:
        """The numbers of a group, with their errors, or with those of a vector as rates."""
        code, turns = room.code, [LANES * i for i in range(2 * AXES)]
        found = [code.load(place, i, REGISTER) for i in turns]
        if vector is not None:
            return [Sum(Dual(x, code.load(vector, at + i, REGISTER)), None) for x, i in zip(found, turns, strict=True)]
        if not self.form.compensated:
            return [Sum(x, None) for x in found]
        return [Sum(x, code.load(place, self.whole + i, REGISTER)) for x, i in zip(found, turns, strict=True)]

    def _write(self, room: Room, place: Value, group: list[Sum], vector: Value | None = None, at: Any = 0) -> None:
        for i, x in enumerate(group):
            if vector is not None:
                room.code.store(x.value.rate, vector, at + LANES * i)
                continue
            room.code.store(x.value, place, LANES * i)
            if x.error is not None:
                room.code.store(x.error, place, self.whole + LANES * i)

    def _light(self, room: Room, g: Value, kick: Value, drift: Value, star: Value, vector: Value | None = None) -> None:
        """The same of a group of bodies without mass, which have the same planets inside their orbits."""
        code, light, at = room.code, len(self.light), (g + self.groups) * NUMBERS
        place = code.at(room.place, at)
        state = self._read(room, place, vector, at)
        x = values(state[:AXES])
        mu, over, inside = (code.splat(code.load(room.data(3), g + light * i), LANES) for i in range(3))
        inside = code.convert("fptosi", code.lane(inside, 0), "i64")
        planets = LANES * self.groups

        def told(which: int, j: Any) -> Vectors:
            """One of the three vectors of a planet, in all lanes."""
            starts = [planets * (AXES * which + i) for i in range(AXES)]
            found, *rates = (
                [code.splat(code.load(room.work.place, j + (start + more)), LANES) for start in starts]
                for more in ([0] if vector is None else [0, self.told])
            )
            return [Dual(y, z) for y, z in zip(found, *rates, strict=True)] if rates else found

        def jumped(which: int) -> None:
            for y, change in zip(state, told(which, code.constant(0, INT)), strict=False):
                y.add(change)

        if self.jacobi:
            h = [y + p for y, p in zip(x, told(1, inside), strict=True)]
            square, over_r = dot(h, h), 1.0 / sqrt(dot(x, x))
            pull, own = star / (square * sqrt(square)), mu * over_r * over_r * over_r
            a = [over * p - pull * y + own * z for p, y, z in zip(told(2, inside), h, x, strict=True)]
        else:
            jumped(1)
            h = values(state[:AXES])
            zero = code.constant(0.0, REGISTER)
            a = [zero if vector is None else Dual(zero, zero)] * AXES
        a = self._with_extra(room, a, h)

        def added(j: Value, total: list[Value]) -> list[Value]:
            d = [p - y for p, y in zip(told(0, j), h, strict=True)]
            distance = dot(d, d)
            place = j + (j >> LANES_SHIFT) * (LANES * (len(ROWS) - 1))  # of G m in the table
            w = code.splat(code.load(room.data(0), place), LANES) / (distance * sqrt(distance))
            near, changes = total[0], parts_of([w * q for q in d])
            if vector is None:
                limit = code.splat(code.load(room.data(4), j), LANES)
                near = code.apply("min", (near, distance - limit))
            return [near, *(p + q for p, q in zip(total[1:], changes, strict=True))]

        start = code.splat(code.constant(float("inf")), LANES)
        near, *sums = code.loop(self.planets, [start, *parts_of(a)], added)
        a = sums if vector is None else [Dual(y, z) for y, z in zip(sums[:AXES], sums[AXES:], strict=True)]
        if self.watches and vector is None:
            kick = kick + self._met(room, code.any(near < 0.0), [h], kick, g)
        for i in range(AXES):
            state[AXES + i].add(kick * a[i])
        if not self.jacobi:
            jumped(2)
        x = values(state[:AXES])
        r = sqrt(dot(x, x))
        for y, change in zip(state, drifted(x, values(state[AXES:]), mu, drift, r, 1.0 / r), strict=True):
            y.add(change)
        self._write(room, place, state, vector, at)

    def _with_extra(self, room: Room, a: Vectors, h: Vectors) -> Vectors:
        """Accelerations of bodies at places h from the star, with those by the extra potential."""
        if self.extra is None:
            return a
        program, numbers = self.extra
        given = [room.code.splat(room.code.load(room.data(5), i), LANES) for i in range(len(numbers))]
        return [p - q for p, q in zip(a, program(*h, *given), strict=True)]

    def _accelerations(
        self,
        room: Room,
        x: list[Vectors],
        c: list[dict[str, Value]],
        inverses: Vectors,
        kick: Value,
        watch: Callable[[Value, list[Vectors]], Value] | None = None,
    ) -> tuple[list[Vectors], Value]:
        """The accelerations by the interaction, and the length of the kick, which is NaN where planets met."""
        code, groups, zero = room.code, range(self.groups), room.code.constant(0.0, REGISTER)
        h = self._heliocentric(x, c) if self.jacobi else x
        a: list[Vectors] = [[zero] * AXES for _ in groups]
        close = None
        for one in groups:
            for other in range(one, self.groups):
                turns = range(1, LANES // 2 + 1) if one == other else range(LANES)
                for k in turns:
                    to, back = ([(i + s * k) % LANES for i in range(LANES)] for s in (1, -1))
                    d = [turned(z, to) - y for y, z in zip(h[one], h[other], strict=True)]
                    square = dot(d, d)
                    w = 1.0 / (square * sqrt(square))
                    mine = w * turned(c[other]["Gm"], to)
                    a[one] = [p + q * mine for p, q in zip(a[one], d, strict=True)]
                    if one != other or k < LANES // 2:
                        theirs = w * c[one]["Gm"]
                        a[other] = [p - turned(q * theirs, back) for p, q in zip(a[other], d, strict=True)]
                    if watch is not None:
                        place = ((one * self.groups + other) * LANES + k) * LANES
                        near = square < code.load(room.data(1), place, REGISTER)
                        close = near if close is None else close | near
        if watch is not None and close is not None:
            kick = watch(close, h)
        a = [self._with_extra(room, each, y) for each, y in zip(a, h, strict=True)]
        if not self.jacobi:
            for g in groups if len(self.light) else ():
                self._tell(room, h[g], 0, g)
            return a, kick
        new: list[Vectors] = []
        behind: Vectors = [zero] * AXES
        for g in reversed(groups):
            star, own = (c[g][name] for name in ("star", "mu"))
            square = dot(h[g], h[g])
            pull = star / (square * sqrt(square))
            a[g] = [p - pull * y for p, y in zip(a[g], h[g], strict=True)]
            own = own * inverses[g] * inverses[g] * inverses[g]
            weighted = [c[g]["mass"] * p for p in a[g]]
            outer = [of_lanes(partial(_running, back=True), p) + q for p, q in zip(weighted, behind, strict=True)]
            behind = [q + of_lanes(_whole, p) for p, q in zip(weighted, behind, strict=True)] if g else behind
            new.append(
                [c[g]["ratio"] * p + c[g]["over"] * q + own * y for p, q, y in zip(a[g], outer, x[g], strict=True)]
            )
            if len(self.light):
                before = [y - z for y, z in zip(h[g], x[g], strict=True)]
                all_behind = [p + q for p, q in zip(weighted, outer, strict=True)]
                for which, vector in enumerate((h[g], before, all_behind)):
                    self._tell(room, vector, which, g)
        return new[::-1], kick

    def _tell(self, room: Room, vector: Vectors, which: int, g: int) -> None:
        """Write down one of three vectors of a group of planets, for the bodies without mass."""
        for i, value in enumerate(parts_of(vector)):
            start = self.told * (i // AXES) + LANES * (self.groups * (AXES * which + i % AXES) + g)
            room.code.store(value, room.work.place, start)

    def _heliocentric(self, x: list[Vectors], c: list[dict[str, Value]]) -> list[Vectors]:
        """Places as seen from the star, of those from the centre of all inside."""
        h: list[Vectors] = []
        before: Vectors = []
        for g, group in enumerate(x):
            weighted = [c[g]["weight"] * y for y in group]
            inner = [of_lanes(partial(_running, back=False), w) for w in weighted]
            if g:
                inner = [p + b for p, b in zip(inner, before, strict=True)]
            h.append([y + p for y, p in zip(group, inner, strict=True)])
            if g + 1 < self.groups:
                total = [of_lanes(_whole, w) for w in weighted]
                before = [b + t for b, t in zip(before, total, strict=True)] if g else total
        return h

    def _jump(self, room: Room, state: list[list[Sum]], c: list[dict[str, Value]], t: Value, which: int) -> None:
        """Move places with the star, whose momentum is that of the planets reversed."""
        jumps = []
        for k in range(AXES):
            parts = [of_lanes(_whole, c[g]["share"] * group[AXES + k].value) for g, group in enumerate(state)]
            jumps.append(t * sum(parts[1:], parts[0]))
            for group in state:
                group[k].add(jumps[k])
        if len(self.light):
            self._tell(room, jumps, which, 0)

    def look(self, room: Room) -> None:
        """Divide vectors by the power of two next to their lengths, whose exponents are added up."""
        code, count = room.code, self.form.vectors
        with code.over(count) as k:
            vector, last = code.at(room.place, (k + 1) * self.whole), (count + 1) * self.whole + k
            registers = self.whole // LANES

            def grown(i: Value, total: list[Value]) -> list[Value]:
                return [total[0] + abs(code.load(vector, LANES * i, REGISTER))]

            (size,) = code.loop(registers, [code.constant(0.0, REGISTER)], grown)
            n, factor = exponent_of(code.total(size))
            with code.over(registers) as i:
                code.store(code.load(vector, LANES * i, REGISTER) * code.splat(factor, LANES), vector, LANES * i)
            code.store(code.load(room.place, last) + n, room.place, last)

    def _met(self, room: Room, met: Value, h: list[Vectors], like: Value, light: Value | None = None) -> Value:
        """NaN where two planets met, whose places are then written down; else 0."""
        code = room.code

        def told() -> Vectors:
            group = code.constant(-1.0) if light is None else code.convert("sitofp", light, "double")
            code.store(group, room.data(2), len(self.report) - 1)
            places = [y for group in h for y in group]
            if light is not None:
                turns = [(g, i) for g in range(self.groups) for i in range(AXES)]
                planets = [code.load(room.work.place, LANES * (self.groups * i + g), like.type) for g, i in turns]
                places = [*planets, *places]
            for i, value in enumerate(places):
                code.store(value, room.data(2), LANES * i)
            return [code.constant(float("nan"), like.type)]

        return code.when(met, told, lambda: [code.constant(0.0, like.type)], rare=True)[0]


def sqrt(x: Any) -> Any:
    return x.apply("sqrt", (x,))


def values(sums: Sequence[Sum]) -> Vectors:
    return [x.value for x in sums]


def parts_of(x: Vectors) -> list[Value]:
    """The values of numbers and then, of dual ones, their rates."""
    return [*(y.value for y in x), *(y.rate for y in x)] if isinstance(x[0], Dual) else x


def of_lanes(function: Callable[[Value], Value], x: Any) -> Any:
    """A linear function of the lanes of a register, and of the rates of a dual number."""
    return Dual(of_lanes(function, x.value), of_lanes(function, x.rate)) if isinstance(x, Dual) else function(x)


def turned(x: Any, lanes: Sequence[int]) -> Any:
    """The lanes of a number in another order; that of index 8 is 0."""
    return of_lanes(lambda y: y.code.shuffle(y, y.code.constant(0.0, y.type), lanes), x)


def _running(x: Value, back: bool) -> Value:
    """The sum of all lanes before each, or behind it."""

    def moved(y: Value, k: int) -> Value:
        return turned(y, [*range(k, LANES), *[LANES] * k] if back else [*[LANES] * k, *range(LANES - k)])

    s = moved(x, 1)
    for k in (1, 2, 4):
        s = s + moved(s, k)
    return s


def _whole(x: Value) -> Value:
    """The sum of all lanes, in each."""
    return x.code.splat(x.code.total(x), LANES)


def drifted(x: Vectors, v: Vectors, mu: Value, t: Value, r: Any, inverse: Any) -> Vectors:
    """Changes by Kepler's motion of all lanes: a few steps that suit short times, or the general solver."""
    code, rates = t.code, []
    if isinstance(r, Dual):
        rates = [y.rate for y in (*x, *v)]
        x, v, r, inverse = [y.value for y in x], [y.value for y in v], r.value, inverse.value
    eta = dot(x, v)
    beta = 2.0 * mu * inverse - dot(v, v)
    zeta = mu - beta * r
    u = t * inverse
    a, b = eta * inverse, zeta * inverse
    X = u * (1.0 - u * (0.5 * a - u * (0.5 * a * a - b * (1 / 6))))
    G = series(X, beta, ROUGH, True)
    errors = []
    for last, most in ((False, 1e2), (True, 1e6)):
        G0, G1, G2, G3 = G
        f, slope, bend = r * X + (eta * G2 + zeta * G3) - t, r + (eta * G1 + zeta * G2), eta * G0 + zeta * G1
        d = -(f * slope) / (slope * slope - 0.5 * (f * bend))
        X = fma(X, 1.0 + NUDGE, d) if last else X + d
        errors.append(most * (d * d))
        if last:  # sums that went before would leave a bias of a hundredth of a unit in the last place
            G = series(X, beta, TERMS)
        else:
            g0, g1, g2, g3 = series(d, beta, 4, True)
            G = (
                G0 * g0 - beta * (G1 * g1),
                G1 * g0 + G0 * g1,
                G2 + (G1 * g1 + G0 * g2),
                G3 + (G2 * d + (G1 * g2 + G0 * g3)),
            )
    *c, d, _ = coefficients(X, G, r, inverse, eta, zeta, mu, t)
    fast = moved(x, v, c)
    if rates:
        fast += varied((x, v), rates, c, (inverse, eta, beta, zeta, mu, r), (X, G, d))
    square = X * X
    worst = code.apply("max", (code.apply("max", (errors[0], errors[1])), 1e16 * (d * d)))
    size = code.apply("abs", (beta * square,))
    late = 2.0 * code.apply("abs", (t - c[1],))
    good = (worst <= square) & (size <= LONGEST) & (late <= code.apply("abs", (t,)))  # False of NaN
    bad = code.apply("not", (good,))

    def again() -> Vectors:
        given = [*x, *v, mu, t, *rates]
        types = [y.type for y in fast]
        packed = Type(f"{{ {', '.join(map(str, types))} }}")

        def body(*given: Value) -> Value:
            return given[0].code.pack(kepler_changes(given[:3], given[3:6], given[6], given[7], given[8:]))

        name = "kepler_rates" if rates else "kepler"
        exact = code.unpack(code.outlined(name, given, body, packed, rare=True), types)
        return [where(bad, y, z) for y, z in zip(exact, fast, strict=True)]

    new = code.when(code.any(bad), again, lambda: fast, rare=True)
    return [Dual(y, z) for y, z in zip(new[:6], new[6:], strict=True)] if rates else new


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
    heliocentric = np.full(n, G * masses[0]), m / masses[0]
    table[:, :n] = [G * m, frame.mu[:n], m / S[1:], S[1:] / S[:-1], 1 / S[:-1], m, *heliocentric]
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
        n, light = len(frame.order), places_of_light(frame)
        if not n or n > MOST_GROUPS * LANES - 1:
            raise arrays_only(
                f"`system` has {n} planets with a mass, and compiled code is for 1 to {MOST_GROUPS * LANES - 1}"
            )
        self.frame, self._light = frame, light
        groups = self.code(Form()).groups
        spare = LANES * groups - n
        self._spare = np.zeros((spare, 2 * AXES))
        self._spare[:, 0] = AWAY * frame.size.max() * (1 + np.arange(spare))
        self._spare[:, AXES + 1] = np.sqrt(frame.G * frame.sums[-1] / self._spare[:, 0])

        lanes = np.arange(LANES)
        places = [n + group[np.minimum(lanes, len(group) - 1)] for group in light]
        self._given = np.concatenate(
            [np.arange(n), np.arange(n + len(frame.test), n + len(frame.test) + spare), *places]
        )
        self._found = np.zeros(n + len(frame.test), dtype=int)
        self._found[:n] = np.arange(n)
        for g, group in enumerate(light):
            self._found[n + group] = LANES * (groups + g) + lanes[: len(group)]

    def code(self, form: Form) -> KeplerCode:
        """The compiled functions of a form, made once; raises NotCompiled if there are none."""
        if self._light and form.gradients:
            raise NotCompiled(
                "`system` has bodies without mass, and compiled force gradients are for bodies with mass: use "
                "backend='array'."
            )
        return self._made(form, 0, 1)

    def parts(self, form: Form, threads: int) -> list[tuple[KeplerCode, np.ndarray]]:
        """Codes of parts of the bodies without mass, all with the planets, and the places of their running states."""
        found, whole, start = [], self.code(form).whole, NUMBERS * self.code(form).groups
        for k in range(threads):
            code = self._made(form, k, threads)
            own = start + NUMBERS * self._ends(k, threads)[0] + np.arange(code.whole - start)
            places = np.concatenate([np.arange(start), own])
            found.append((code, np.concatenate([places, whole + places]) if form.compensated else places))
        return found

    def _ends(self, k: int, threads: int) -> tuple[int, int]:
        n = len(self._light)
        return n * k // threads, n * (k + 1) // threads

    @kept
    def _made(self, form: Form, k: int, threads: int) -> KeplerCode:
        return KeplerCode(self.frame, form, slice(*self._ends(k, threads)))

    def rows(self, y: np.ndarray, spare: float = 1.0) -> np.ndarray:
        """The running states (..., n_values) of states (..., 2d); of deviation vectors with a `spare` of 0."""
        x, v, *_ = self.frame.into(y)
        planets = np.concatenate([x, v], axis=-1)
        more = np.broadcast_to(spare * self._spare, (*planets.shape[:-2], *self._spare.shape))
        planets = np.concatenate([planets, more], axis=-2)[..., self._given, :]
        n = len(self._given)
        groups = planets.reshape(*y.shape[:-1], n // LANES, LANES, 2 * AXES).swapaxes(-1, -2)
        return np.ascontiguousarray(groups).reshape(*y.shape[:-1], 2 * AXES * n)

    def states(self, rows: np.ndarray, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states (..., n, 2d) after times (n,) of running ones, of runs from y0 (..., 2d)."""
        y = self.moved(rows, y0[..., None, :], times)
        y[..., times == 0, :] = y0[..., None, :]
        return y

    def moved(self, rows: np.ndarray, y0: np.ndarray, times: np.ndarray, size: Any = 1.0) -> np.ndarray:
        """The states, or vectors, of running ones (..., n_values), after times since those size·y0 (..., 2d)."""
        *_, Q, U = self.frame.into(y0)
        groups = len(self._given) // LANES
        planets = rows.reshape(*rows.shape[:-1], groups, 2 * AXES, LANES).swapaxes(-1, -2)
        planets = planets.reshape(*rows.shape[:-1], groups * LANES, 2 * AXES)[..., self._found, :]
        centre = size * (Q + times[..., None] * U)
        return self.frame.out(planets[..., :AXES], planets[..., AXES:], centre, size * U + 0 * centre)


@kept
def kepler_loops(frame: Frame) -> KeplerLoops:
    """Return the loops of a frame, made once."""
    return KeplerLoops(frame)


class KeplerKernel(Kernel):
    """The compiled loops of a scheme of kicks by the interaction and Kepler's drifts, with or without a processor.

    `before` and `after` are the processor and its inverse; empty for none.
    """

    def __init__(
        self,
        loops: KeplerLoops,
        substeps: Substeps,
        before: Substeps = (),
        after: Substeps = (),
        compensated: bool = False,
    ) -> None:
        self.loops, self.before, self.substeps, self.after = loops, before, substeps, after
        thirds = [third for *_, third in (*before, *substeps, *after)]
        self.form = Form(gradients=any(thirds), compensated=compensated)
        self.code = loops.code(self.form)
        *rest, last = np.array(substeps)
        first = rest[0] if rest else last
        ends = first[0] == 0 or last[1] == 0  # with what the next step begins with
        inner, end = (rest[1:], last) if ends else ([*rest[1:], last], 0 * last)
        self.columns = np.array([first, *inner, end + first, end])

    def _table(self, h: Any, *pieces: Any) -> Columns:
        """The columns of pieces in turn; every second one is of the processor, always for a step forwards."""
        h = np.asarray(h, dtype=float)[..., None, None]
        made = [
            (abs(h) if k % 2 else h) ** POWERS * np.reshape(piece, (-1, len(POWERS))) for k, piece in enumerate(pieces)
        ]
        entries = np.concatenate(made, axis=-2)
        return np.ascontiguousarray(entries[..., : self.code.size]), np.zeros(entries.shape[-2], dtype=np.int64)

    def rollout(self, code: KeplerCode, h: float) -> Callable[[Batch], None]:
        """The runs of batches, with steps of a length."""
        columns = self._table(h, self.columns)
        if not self.before:
            return partial(code.run, columns)
        after = self._table(h, self.columns[-1:], self.after)
        return partial(code.run_processed, self._table(h, (), self.before), columns, after)

    def runs(self, task: Task) -> Run:
        loops, code, start = self.loops, self.code, self.loops.rows(task.y0)
        light = len(code.light)
        work = WORK * len(self.columns) * (code.groups + light)
        threads = threads_for(light, (task.n_steps - (task.carry.steps if task.carry else 0)) * work, task.threads)
        given = task._replace(y0=start)
        if len(start) == 1 < threads:
            rows, n_finite, code = self._in_parts(given, threads)
        else:
            rows, n_finite, _ = run_states(self.rollout(code, task.h), given, code.n_values, work)
        self.remark = self._pair(code) if len(start) == 1 and n_finite[0] < task.n_steps else ""
        return Run(loops.states(rows, task.y0, task.save * task.h), n_finite)

    def _in_parts(self, task: Task, threads: int) -> tuple[np.ndarray, np.ndarray, KeplerCode]:
        """A run of one state by threads that share the bodies without mass, with the code that ended first."""
        carry, whole = task.carry, self.code.whole
        save = np.ascontiguousarray(task.save, dtype=np.int64)
        parts = self.loops.parts(self.form, threads)
        running = np.zeros((1, self.code.n_values)) if carry is None or carry.running is None else carry.running
        running = running.reshape(1, -1)
        first, batches = 0 if carry is None else carry.steps, []
        for code, places in parts:
            start, ended = task.y0[:, places[: code.whole]], np.empty(1, dtype=np.int64)
            out, kept = np.empty((1, len(save), code.n_out)), running[:, places if carry is not None else []]
            batches.append(Batch(start, task.n_steps, save, out, ended, first, kept))

        def run(code: KeplerCode, own: Batch, stop: np.ndarray) -> None:
            self.rollout(code, task.h)(own._replace(stop=stop))

        run_in_threads([partial(run, code, own) for (code, _), own in zip(parts, batches, strict=True)])
        rows, new = np.empty((1, len(save), whole)), np.empty_like(running)
        for (code, places), own in zip(parts, batches, strict=True):
            rows[..., places[: code.whole]] = own.out
            if carry is not None:
                new[:, places] = own.running
        steps = [int(own.n_finite[0]) for own in batches]
        rows[:, save > min(steps)] = np.nan
        if carry is not None:
            carry.advance(task.n_steps, new)
        return rows, np.array([min(steps)]), parts[int(np.argmin(steps))][0]

    def _pair(self, code: KeplerCode) -> str:
        """A sentence on the bodies that met."""
        frame = self.loops.frame
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

    def check_reverse(self) -> None:
        self.loops.code(self.form._replace(vectors=1))

    def recorded(self, task: Task) -> Chained:
        return Chained(self, task)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        return Steps(self.jvp(h, y)[0])

    def tangents(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.jvp(h, y, np.broadcast_to(np.eye(y.shape[-1]), (*y.shape, y.shape[-1])))

    def jvp(self, h: ArrayLike, y: np.ndarray, W: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The steps from rows of `y` (N, 2d), and vectors W (N, 2d, k) moved by their derivatives."""
        vectors = y[..., None, :][:, :0] if W is None else W.swapaxes(-1, -2)
        N, k, _ = vectors.shape
        code = self.loops.code(self.form._replace(vectors=k, compensated=False))
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), (N,))
        rows = np.concatenate([self.loops.rows(y), self.loops.rows(vectors, 0.0).reshape(N, k * code.whole)], axis=1)
        columns = self._table(lengths, (), self.before, self.substeps, self.after)
        rows = code.single_steps(*columns, rows).reshape(N, 1 + k, code.whole)
        moved = self.loops.moved(rows[:, 1:], vectors, lengths[:, None])
        return self.loops.moved(rows[:, 0], y, lengths), moved.swapaxes(-1, -2)


class KeplerFlowKernel(Kernel):
    """The compiled loops of a flow that is trained at Δt, where `at_dt` of a step is True, and a scheme before it."""

    def __init__(self, at_dt: Callable[[Any], Any], trained: KeplerKernel, between: KeplerKernel) -> None:
        self.at_dt, self.trained, self.between = at_dt, trained, between

    def runs(self, task: Task) -> Run:
        kernel = self.trained if self.at_dt(task.h) else self.between
        found = kernel.runs(task)
        self.remark = kernel.remark
        return found

    def check_reverse(self) -> None:
        for kernel in (self.trained, self.between):
            kernel.check_reverse()

    def recorded(self, task: Task) -> Chained:
        return Chained(self, task)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        return Steps(self._moved(h, y, False)[0])

    def tangents(self, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._moved(h, y, True)

    def _moved(self, h: ArrayLike, y: np.ndarray, tangents: bool) -> tuple[np.ndarray, np.ndarray]:
        lengths, n = np.broadcast_to(np.asarray(h, dtype=float), (len(y),)), y.shape[-1]
        whole = self.at_dt(lengths)
        ends, jacobians = np.empty_like(y), np.empty((*y.shape, n if tangents else 0))
        for kernel, rows in ((self.trained, whole), (self.between, ~whole)):
            if rows.any():
                given = lengths[rows], y[rows]
                ends[rows], jacobians[rows] = kernel.tangents(*given) if tangents else kernel.jvp(*given)
        return ends, jacobians


class KeplerTangents(TangentKernel):
    """The same with k deviation vectors, whose lengths are those of inertial states."""

    _code: KeplerCode

    def __init__(self, kernel: KeplerKernel, vectors: int) -> None:
        self.vectors, self._kernel = vectors, kernel
        self._code = kernel.loops.code(kernel.form._replace(vectors=vectors, grows=True))

    def _begun(self, y0: np.ndarray, w0: np.ndarray) -> np.ndarray:
        loops, n = self._kernel.loops, len(y0)
        vectors = np.broadcast_to(loops.rows(w0, 0.0).reshape(-1), (n, self.vectors * self._code.whole))
        return np.concatenate([loops.rows(y0), vectors, np.zeros((n, self.vectors))], axis=1)

    def _rollout(self, h: float) -> tuple[Callable[[Batch], None], float]:
        return self._kernel.rollout(self._code, h), WORK * len(self._kernel.columns) * (1 + 4 * self.vectors)

    def _vectors(self, states: np.ndarray, times: np.ndarray, w0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k, whole = self.vectors, self._code.whole
        rows, exponents = states[..., whole:-k].reshape(*states.shape[:-1], k, whole), states[..., -k:]
        size = np.exp2(-exponents)[..., None]
        return self._kernel.loops.moved(rows, w0, times[:, None] + 0 * exponents, size), exponents
