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


def _basis(states: Sequence[float], slopes: Sequence[float]) -> np.ndarray:
    """The polynomials, in columns, that are 1 in one of the values at these places in a step and 0 in all others."""
    powers = np.arange(len(states) + len(slopes))
    x, z = np.array(states)[:, None], np.array(slopes)[:, None]
    rows = np.concatenate([x**powers, powers * z ** (powers - 1).clip(0)])
    return np.round(4 * np.linalg.inv(rows)) / 4  # exact


THIRDS = (1 / 3, 2 / 3)
_BASES = {
    (2, 2): _basis((0, 1), (0, 1)),
    (3, 2): _basis((0, 1, 1 / 2), (0, 1)),
    (4, 4): _basis((0, 1, *THIRDS), (0, 1, *THIRDS)),
}


class Interpolant:
    """One step from t0 to t1, between them a polynomial through states and slopes, taken when they are needed.

    Of `values` these are (states, slopes): at both ends; of states at the middle too, or of both at the thirds.
    """

    def __init__(
        self, begin: Time, end: Time, y0: Array, values: Callable[[], tuple[Sequence[Array], Sequence[Array]]]
    ) -> None:
        self.begin, self.end, self.y0, self._values = begin, end, y0, values
        self.t0, self.t1 = (float(detached(t)) for t in (begin, end))

    def __getstate__(self) -> dict[str, Any]:
        """The values in place of the steps that they are taken from."""
        return {**vars(self), "values": self.values, "_values": None}

    @cached_property
    def values(self) -> tuple[np.ndarray, list[Array]]:
        """The polynomials of the values, and these."""
        states, slopes = self._values()
        h = self.end - self.begin
        return _BASES[len(states), len(slopes)], [*states, *(h * f for f in slopes)]

    def __call__(self, t: float) -> Array:
        basis, values = self.values
        x = (float(t) - self.begin) / (self.end - self.begin)
        return _sum(_weights(basis, x), values)


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
    def _stacked(self) -> tuple[Any, Any, np.ndarray, list[Array]]:
        """Beginnings and lengths of all steps (m,), the polynomials of their values, and these, each (m, ..., 2d)."""
        begin, length = zip(*((step.begin, step.end - step.begin) for step in self.steps), strict=True)
        bases, each = zip(*(step.values for step in self.steps), strict=True)
        values = [stack(v, axis=0) for v in zip(*each, strict=True)]
        return stack(begin, axis=0), stack(length, axis=0), bases[0], values

    def states(self, times: np.ndarray) -> Array:
        if not self.steps:
            return stack([self.y0] * len(times), axis=0) if times.size else self.y0[None][:0]
        begin, length, basis, values = self._stacked
        k: Any = np.minimum(np.searchsorted(self.sign * self._ends, self.sign * times), len(self.steps) - 1)
        x = ((beside(times, begin) - begin[k]) / length[k]).reshape(-1, *[1] * self.y0.ndim)
        return _sum([like(w, self.y0) for w in _weights(basis, x)], [v[k] for v in values])


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


def _weights(basis: np.ndarray, x: Any) -> list[Any]:
    """The values of the polynomials at x."""
    found = []
    for column in basis.T.tolist():
        w: Any = 0.0 * x
        for c in column[::-1]:
            w = w * x + c
        found.append(w)
    return found


def _sum(weights: Sequence[Any], values: Sequence[Array]) -> Array:
    total = weights[0] * values[0]
    for w, v in zip(weights[1:], values[1:], strict=True):
        total = total + w * v
    return total
