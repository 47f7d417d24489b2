"""Orbits of a vector field with numbers θ and their derivatives: schemes, and observations side by side."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from sympflow.hamiltonian.collocation import gauss_legendre
from sympflow.learning.models import FreeField, Model, VectorField
from sympflow.learning.parts import Linear
from sympflow.learning.reading import Run
from sympflow.learning.trajectories import Trajectories
from sympflow.schemes import Scheme, scheme_named

Array = np.ndarray
Field = Model | FreeField  # a vector field with numbers θ

MOST_NUMBERS = 2**20  # of the derivatives of a batch, which then stay in the cache
SLOPE_POINTS = 10  # of a piece, that give a velocity which was not observed
SOLVED = 1e-4  # of the error of a scheme, to which its equations are solved

Orbit = Iterator[tuple[Array, Array | None]]
"""States (2d, N) and derivatives (2d, c, N) at one point after another."""
Over = Callable[[Array, Array | None, Array, Array], Any]
"""States and derivatives at the end of gaps (N,), by those at their beginnings t (N,)."""


class Stepper(ABC):
    """One step of a scheme, with the derivatives of its end by the initial state and by θ."""

    cost: float  # cost of a step, in evaluations of the force with its derivatives
    longest: float | None = None  # Δt of a map that is fitted itself, whose steps have no error; None of a scheme

    def within(self, tolerance: Array) -> Stepper:
        """The same scheme, whose equations are solved no better than is needed for an error (2d,) of a step."""
        return self

    @abstractmethod
    def step(self, model: Field, theta: Array, x: Array, X: Array | None, h: Array, t: Array) -> Any:
        """The states (2d, N) and derivatives (2d, c, N) a time h (N,) after x and X at t, which may be overwritten.

        The first 2d columns of X are those by the initial state, the others those by θ, if there are any.
        """

    def orbit(self, over: Over, x: Array, X: Array | None, gaps: Array, t: Array) -> Orbit:
        """States and derivatives after each of the gaps (k, N) between points; the first gap follows t (N,)."""
        for gap in gaps:
            if gap.any():
                x, X = over(x, X, gap, t)
                t = t + gap
            yield x, X


@dataclass(frozen=True)
class Splitting(Stepper):
    """Kicks and drifts of a scheme, for a separable H."""

    scheme: Scheme

    @property
    def cost(self) -> float:  # type: ignore[override]
        return float(self.scheme.force_evaluations)

    def step(self, model: Field, theta: Array, x: Array, X: Array | None, h: Array, t: Array) -> Any:
        d = model.ndof
        q, p = slice(0, d), slice(d, 2 * d)
        wanted = X is not None, X is not None and X.shape[1] > 2 * d
        drifted = 0.0
        for b, a in zip(self.scheme.kicks, self.scheme.drifts, strict=True):
            for weight, of, moved in ((-b, q, p), (a, p, q)):
                if weight:
                    here = model.at(t + drifted * h)
                    self._push(here.gradient(theta, x[of], "qp"[of is p], *wanted), weight * h, x, X, of, moved)
            drifted += a
        return x, X

    @staticmethod
    def _push(f: Linear, w: Array, x: Array, X: Array | None, of: slice, moved: slice) -> None:
        """Add w f of some coordinates to others, and its derivatives."""
        x[moved] += w * f.value
        if X is None or f.slope is None:
            return
        first, by = 2 * len(f.value), X[of]
        if f.slope.shape[-1] == 1:
            X[moved] += w * np.tensordot(f.slope[..., 0], by, 1)
            if f.by_parameters is not None:
                X[moved, first:] += w * f.by_parameters
            return
        for i, rows in enumerate(X[moved]):
            for j, slope in enumerate(f.slope[i]):
                if slope.any():
                    rows[:] += (w * slope) * by[j]
            if f.by_parameters is not None:
                rows[first:] += w * f.by_parameters[i]


@dataclass(frozen=True)
class Gauss(Stepper):
    """Gauss collocation, symplectic for any H, to the tolerance (2d,) of its equations; 0 for rounding."""

    stages: int
    iterations: int = 60
    tolerance: Array | float = field(default=0.0, compare=False)

    @property
    def cost(self) -> float:  # type: ignore[override]
        return 4.0 * self.stages

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """A and b."""
        rows, weights, scale = map(np.array, gauss_legendre(self.stages))
        return rows * scale, weights * scale

    def within(self, tolerance: Array) -> Gauss:
        return replace(self, tolerance=SOLVED * tolerance)

    def step(self, model: Field, theta: Array, x: Array, X: Array | None, h: Array, t: Array) -> Any:
        A, b = self._table
        m, N = x.shape
        s = self.stages
        model = model.at((t + h * A.sum(axis=1)[:, None]).ravel())
        K = np.repeat(model.at(t).field(theta, x, False, False).value[:, None], s, axis=1)  # (m, s, N)
        before, near = math.inf, np.reshape(self.tolerance, (-1, 1, 1))
        for _ in range(self.iterations):
            inner = x[:, None] + h * np.einsum("ij,mjn->min", A, K)
            new = model.field(theta, inner.reshape(m, s * N), False, False).value.reshape(m, s, N)
            moved = np.abs(h * (new - K))
            change = float(moved.max(initial=0.0))
            K = new
            rounding = change >= before and change < 1e-9 * np.abs(x).max()
            if rounding or not math.isfinite(change) or (moved <= near).all():
                break
            before = change
        end = x + h * np.einsum("j,mjn->mn", b, K)
        if X is None:
            return end, None
        inner = x[:, None] + h * np.einsum("ij,mjn->min", A, K)
        c = X.shape[1]
        f = model.field(theta, inner.reshape(m, s * N), True, c > m)
        S = np.broadcast_to(f.slope, (m, m, s * N)).reshape(m, m, s, N)
        rhs = np.einsum("klin,lcn->nikc", S, X, optimize=True)
        if f.by_parameters is not None:
            rhs[..., m:] += f.by_parameters.reshape(m, c - m, s, N).transpose(3, 2, 0, 1)
        matrix = np.einsum("n,ij,klin->nikjl", -h, A, S, optimize=True).reshape(N, s * m, s * m)
        matrix += np.eye(s * m)
        if not np.isfinite(matrix).all():
            return end * np.nan, X
        slopes = np.linalg.solve(matrix, rhs.reshape(N, s * m, c)).reshape(N, s, m, c)
        return end, X + h * np.einsum("j,njkc->kcn", b, slopes)


SPLITTINGS = ("blanes_moan4", "srkn11b", "kahan_li8")
STAGES = (2, 3, 4)


def steppers(model: Field) -> list[Stepper]:
    """The schemes that can follow a model, or its own map."""
    if model.stepper is not None:
        return [model.stepper]
    if not model.separable:
        return [Gauss(s) for s in STAGES]
    return [Splitting(s) for s in map(scheme_named, SPLITTINGS) if model.nystrom or not s.nystrom]


@dataclass(frozen=True)
class Method:
    """A scheme, and its longest step."""

    stepper: Stepper
    longest: float

    def steps(self, gaps: Array) -> int:
        """How many steps lead over gaps (N,)."""
        return max(1, math.ceil(float(np.max(np.abs(gaps), initial=0.0)) / self.longest * (1 - 1e-9)))

    def over(self, model: Field, theta: Array, x: Array, X: Array | None, gaps: Array, t: Array) -> Any:
        """States and derivatives at the end of gaps that begin at t."""
        n = self.steps(gaps)
        for k in range(n):
            x, X = self.stepper.step(model, theta, x, X, gaps / n, t + k * gaps / n)
        return x, X

    def orbit(self, model: Field, theta: Array, x: Array, X: Array | None, gaps: Array, t: Array) -> Orbit:
        """States and derivatives after each of the gaps (k, N) between points; the first gap follows t (N,)."""
        return self.stepper.orbit(partial(self.over, model, theta), x, X, gaps, t)


@dataclass(frozen=True)
class Batch:
    """Pieces of trajectories of about one length, side by side."""

    index: Array  # (N,): Their places among all pieces
    gaps: Array  # (k, N): Times from one point to the next, the first of them 0; 0 beyond a piece's end
    y: Array  # (k, 2d, N): 0 where nothing was observed
    seen: Array  # (k, 2d, N): 1 where there is an observation, 0 elsewhere
    starts: Array  # (N,): Their first times


def batches(runs: Sequence[Run], columns: int) -> list[Batch]:
    """The runs in batches, of lengths that differ by a third at most."""
    order = np.argsort([run.n_points for run in runs], kind="stable")
    m = len(runs[0].y)
    most = max(1, MOST_NUMBERS // (m * columns))
    made: list[Batch] = []
    start = 0
    while start < len(order):
        least, stop = runs[order[start]].n_points, start
        while stop < len(order) and stop - start < most and 3 * runs[order[stop]].n_points <= 4 * least + 3:
            stop += 1
        index = order[start:stop]
        k = runs[index[-1]].n_points
        gaps, y = np.zeros((k, len(index))), np.full((k, m, len(index)), np.nan)
        for column, i in enumerate(index):
            run = runs[i]
            gaps[1 : run.n_points, column] = np.diff(run.t)
            y[: run.n_points, :, column] = run.y.T
        seen = np.isfinite(y)
        starts = np.array([runs[i].t[0] for i in index])
        made.append(Batch(index, gaps, np.where(seen, y, 0.0), seen.astype(float), starts))
        start = stop
    return made


def first_states(data: Trajectories, model: VectorField | None = None, theta: Any = None) -> Array:
    """A guess of the initial states (N, 2d): what was observed first, interpolated where a value is missing.

    Momenta are those of a model where velocities are observed.
    """
    values = np.concatenate([run.y for run in data.runs], axis=1)
    middle = np.nanmean(np.where(np.isnan(values).all(axis=1, keepdims=True), 0.0, values), axis=1)
    states = np.empty((len(data.runs), 2 * data.ndof))
    for state, run in zip(states, data.runs, strict=True):
        for i, row in enumerate(run.y):
            seen = np.isfinite(row)
            if seen.any():
                state[i] = np.interp(run.t[0], run.t[seen], row[seen])
            else:
                state[i] = _first_slope(run, i - data.ndof) if data.velocities and i >= data.ndof else middle[i]
    return states if model is None else model.states(theta, states.T).T


def _first_slope(run: Run, i: int) -> float:
    """The derivative of a coordinate at the first time, by a cubic through the first points."""
    seen = np.flatnonzero(np.isfinite(run.y[i]))[:SLOPE_POINTS]
    t, y = run.t[seen] - run.t[0], run.y[i, seen]
    if len(seen) < 2:
        return 0.0
    powers = np.vander(t / t[-1], min(len(seen), 4), increasing=True)
    return float(np.linalg.lstsq(powers, y, rcond=None)[0][1] / t[-1])


def integrals(t: Array, rates: Array) -> Array:
    """The integrals of rates (…, k) from the first time on, by cubic splines where there are points for them."""
    if not np.isfinite(rates).all():
        return np.full_like(rates, np.nan)
    if len(t) < 4:
        parts = np.diff(t) * (rates[..., 1:] + rates[..., :-1]) / 2
        return np.concatenate([np.zeros((*rates.shape[:-1], 1)), np.cumsum(parts, axis=-1)], axis=-1)
    return CubicSpline(t, rates, axis=-1).antiderivative()(t)
