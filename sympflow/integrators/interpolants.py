"""Dense output by interpolation: a polynomial for each step, of methods whose shorter steps are not their own path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sympflow.arguments import check_not_followed
from sympflow.arrays import Array, beside, detached, last, like, moveaxis, stack

Time = Any  # a number, or a tensor that carries a gradient


class Interpolant:
    """One step from t0 to t1: the polynomial Σ_j c_j x^j in x = (t − t0)/(t1 − t0)."""

    def __init__(self, begin: Time, end: Time, coefficients: Sequence[Array]) -> None:
        self.begin, self.end, self.coefficients = begin, end, coefficients
        self.t0, self.t1 = (float(detached(t)) for t in (begin, end))

    @property
    def y0(self) -> Array:
        """The state at the beginning."""
        return self.coefficients[0]

    def __call__(self, t: float) -> Array:
        return _horner(self.coefficients, (float(t) - self.begin) / (self.end - self.begin))


def quartic(t0: Time, t1: Time, y0: Array, y1: Array, middle: Array, f0: Array, f1: Array) -> Interpolant:
    """The polynomial of degree 4 with these states at the beginning, end and middle, and slopes at both ends."""
    h = t1 - t0
    return Interpolant(
        t0,
        t1,
        [
            y0,
            h * f0,
            h * (f1 - 4 * f0) - 11 * y0 - 5 * y1 + 16 * middle,
            h * (5 * f0 - 3 * f1) + 18 * y0 + 14 * y1 - 32 * middle,
            2 * h * (f1 - f0) - 8 * (y0 + y1) + 16 * middle,
        ],
    )


def hermite(t0: Time, t1: Time, y0: Array, y1: Array, f0: Array, f1: Array) -> Interpolant:
    """The cubic with these states and slopes at both ends."""
    h, rise = t1 - t0, y1 - y0
    return Interpolant(t0, t1, [y0, h * f0, 3 * rise - h * (2 * f0 + f1), h * (f0 + f1) - 2 * rise])


class DenseOutput:
    """A solution as a function of t: a number gives (..., 2d), times (n,) give (..., 2d, n)."""

    t_min: float
    t_max: float

    def states(self, times: np.ndarray) -> Array:
        """Return the states at times (n,) in the interval: (n, ..., 2d)."""
        raise NotImplementedError

    def __call__(self, t: float | np.ndarray) -> Array:
        check_not_followed("t", t)
        times = np.atleast_1d(np.asarray(t, dtype=float))
        if times.size and not (times.min() >= self.t_min and times.max() <= self.t_max):
            raise ValueError(f"`t` must lie in [{self.t_min:g}, {self.t_max:g}], the interval that was solved.")
        y = last(self.states(times))
        return y[..., 0] if np.ndim(t) == 0 else y


@dataclass(frozen=True)
class Mapped:
    """A dense output whose states (..., k) are mapped by a function."""

    sol: Callable[[Any], Array]
    of: Callable[[Array], Array]

    def __call__(self, t: Any) -> Array:
        y = self.sol(t)
        return self.of(y) if np.ndim(t) == 0 else self.of(y.swapaxes(-1, -2)).swapaxes(-1, -2)


class Piecewise(DenseOutput):
    """Dense output: the interpolants of consecutive steps, up to t_end."""

    def __init__(self, steps: Sequence[Interpolant], y0: Array, t0: float, t_end: float) -> None:
        self.steps, self.y0 = steps, y0
        self.sign = 1 if t_end >= t0 else -1
        self.t_min, self.t_max = sorted((t0, t_end))

    @cached_property
    def _ends(self) -> np.ndarray:
        return np.array([step.t1 for step in self.steps])

    @cached_property
    def _stacked(self) -> tuple[Any, Any, list[Array]]:
        """Beginnings, lengths and coefficients of each power of all steps: (m,), (m,), each (m, ..., 2d)."""
        begin, length = zip(*((step.begin, step.end - step.begin) for step in self.steps), strict=True)
        coefficients = [stack(c, axis=0) for c in zip(*(step.coefficients for step in self.steps), strict=True)]
        return stack(begin, axis=0), stack(length, axis=0), coefficients

    def states(self, times: np.ndarray) -> Array:
        if not self.steps:
            return stack([self.y0] * len(times), axis=0) if times.size else self.y0[None][:0]
        begin, length, coefficients = self._stacked
        k: Any = np.minimum(np.searchsorted(self.sign * self._ends, self.sign * times), len(self.steps) - 1)
        x = like((beside(times, begin) - begin[k]) / length[k], self.y0)
        return _horner([c[k] for c in coefficients], x.reshape(-1, *[1] * self.y0.ndim))


class Batch(DenseOutput):
    """The dense output of a batch by those of its parts, NaN after the end of a part.

    `places` are for each trajectory the dense output of the run that it was part of, and its place there.
    """

    def __init__(self, places: Sequence[tuple[Any, int]], batch: tuple[int, ...], t_span: tuple[float, float]):
        self.batch, (self.t_min, self.t_max), self.places = batch, sorted(t_span), places

    def states(self, times: np.ndarray) -> Array:
        found: dict[int, Array] = {}
        for sol, _ in self.places:
            if id(sol) not in found:
                y = sol(times.clip(sol.t_min, sol.t_max))
                y[..., np.flatnonzero((times < sol.t_min) | (times > sol.t_max))] = np.nan
                found[id(sol)] = y.reshape(-1, *y.shape[-2:])
        y = stack([found[id(sol)][j] for sol, j in self.places], axis=0)
        return moveaxis(y.reshape(*self.batch, *y.shape[1:]), -1, 0)


def _horner(coefficients: Sequence[Array], x: Any) -> Array:
    y = coefficients[-1]
    for c in coefficients[-2::-1]:
        y = y * x + c
    return y
