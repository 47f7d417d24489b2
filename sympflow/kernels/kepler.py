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

LANES = 8
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
        self.groups = -(-len(frame.order) // LANES)
        super().__init__(NUMBERS * self.groups, NUMBERS * self.groups)
        self.jacobi, self.watches = frame.jacobi, frame.encounter is not None
        self.room, self.size = 0, 2
        table, limits = constants(frame, self.groups)
        self.report = zeros(AXES * LANES * self.groups)
        self.data = (table, limits, self.report)

    def prepared(self, table: Columns) -> Columns:
        return table

    def own_columns(self, table: Columns, values: np.ndarray, width: int) -> Columns:
        entries, kinds = table
        return np.ascontiguousarray(entries[values[:, 0].astype(int)]), kinds

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
        v = self._kicked(room, x, v, c, kick, inverses)
        if not self.jacobi:
            x = self._jumped(x, v, c, 0.5 * kick)
            roots = [sqrt(dot(each, each)) for each in x]
            inverses = [1.0 / r for r in roots]
        for g in range(self.groups):
            new = drifted(x[g], v[g], c[g]["mu"], drift, roots[g], inverses[g])
            for i, value in enumerate([*new[0], *new[1]]):
                code.store(value, room.state, NUMBERS * g + LANES * i)

    def _kicked(
        self, room: Room, x: list[Vectors], v: list[Vectors], c: list[dict[str, Value]], t: Value, inverses: Vectors
    ) -> list[Vectors]:
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
            return [[p + t * q for p, q in zip(v[g], a[g], strict=True)] for g in groups]
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
        return new[::-1]

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

    def _met(self, room: Room, met: Value, h: list[Vectors], like: Value) -> Value:
        """NaN where two planets met, whose places are then written down; else 0."""
        code = room.code

        def told() -> Vectors:
            for i, value in enumerate([y for group in h for y in group]):
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
        if len(frame.test) or not len(frame.order) or len(frame.order) > MOST_GROUPS * LANES:
            raise ValueError(
                f"`system` has {len(frame.order)} planets with a mass, and compiled code is for at most "
                f"{MOST_GROUPS * LANES}: use backend='array'."
            )
        self.frame, self.code = frame, KeplerCode(frame)
        n, size = len(frame.order), AWAY * frame.size.max()
        spare = LANES * self.code.groups - n
        self._spare = np.zeros((spare, 2 * AXES))
        self._spare[:, 0] = size * (1 + np.arange(spare))
        self._spare[:, AXES + 1] = np.sqrt(frame.G * frame.sums[-1] / self._spare[:, 0])

    def rows(self, y: np.ndarray) -> np.ndarray:
        """The running states (N, n_values) of states (N, 2d)."""
        x, v, *_ = self.frame.into(y)
        planets = np.concatenate([x, v], axis=-1)
        planets = np.concatenate([planets, np.broadcast_to(self._spare, (len(y), *self._spare.shape))], axis=1)
        groups = planets.reshape(len(y), self.code.groups, LANES, 2 * AXES).swapaxes(-1, -2)
        return np.ascontiguousarray(groups).reshape(len(y), -1)

    def states(self, rows: np.ndarray, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states (..., n, 2d) after times (n,) of running ones, of runs from y0 (..., 2d)."""
        y = self.moved(rows, y0[..., None, :], times)
        y[..., times == 0, :] = y0[..., None, :]
        return y

    def moved(self, rows: np.ndarray, y0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The states of running ones (..., n_values), after times since those y0 (..., 2d)."""
        *_, Q, U = self.frame.into(y0)
        planets = rows.reshape(*rows.shape[:-1], self.code.groups, 2 * AXES, LANES).swapaxes(-1, -2)
        planets = planets.reshape(*rows.shape[:-1], self.code.groups * LANES, 2 * AXES)[..., : len(self.frame.order), :]
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
        """A clause on the planets that met."""
        frame, x = self.loops.frame, self.loops.code.report.reshape(-1, AXES, LANES).swapaxes(1, 2).reshape(-1, AXES)
        i, j = np.triu_indices(len(frame.order), 1)
        distance = np.linalg.norm(x[i] - x[j], axis=-1)
        if frame.encounter is None or not len(i) or not (distance**2 < frame.limits).any():
            return ""
        k = int(np.argmin(distance / np.sqrt(frame.limits)))
        one, other = sorted((int(frame.order[i[k]]), int(frame.order[j[k]])))
        radii = frame.encounter * distance[k] / np.sqrt(frame.limits[k])
        return f" Bodies {one} and {other} were {distance[k]:.4g} apart, {radii:.3g} Hill radii."

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        columns = [*self.step_itself, (0.0, 0.0), (0.0, 0.0)]
        rows = self.loops.rows(y)
        start = np.concatenate([rows, np.arange(len(y), dtype=float)[:, None]], axis=1)
        batch = Batch.whole(start, 1, ONE, rows.shape[1])
        self.loops.code.run(self._table(lengths, columns), batch, False)
        return Steps(self.loops.moved(batch.out[:, 0], y, lengths))
