"""The time grid t0 + k·dt of the fixed-step methods, with integer step counts."""

from __future__ import annotations

import math

import numpy as np

EPS = float(np.finfo(float).eps)
MOST_STEPS = 10**11
"""A run of more is refused: at the 10 ns of the cheapest compiled step it takes a quarter of an hour."""
MOST_OPEN_STEPS = 1_000_000
"""A run whose interval has no end is ended after so many: an event that never comes would be waited for, for ever."""


def open_end(t0: float, t1: float, dt: float) -> float:
    """Return t1, or for an infinite one the end of `MOST_OPEN_STEPS` steps of length dt."""
    return t1 if math.isfinite(t1) else t0 + math.copysign(MOST_OPEN_STEPS * dt, t1)


def no_event(n_steps: int, t: float) -> str:
    """Return the message of a run to an infinite end that no event ended."""
    return (
        f"No terminal event ended the run within {n_steps:,} steps, up to t = {t:.15g}. Check the event, or give "
        "`t_span` a finite end, however late."
    )


class Grid:
    """Times t0 + k·h, k = 0 … n_steps, and a last shorter step of length `remainder` if h does not divide t1 − t0."""

    def __init__(self, t0: float, t1: float, dt: float) -> None:
        self.t0, self.t1 = float(t0), float(t1)
        self.h = math.copysign(dt, t1 - t0)
        quotient = (self.t1 - self.t0) / self.h
        if quotient > 1.000001 * MOST_STEPS:
            raise ValueError(
                f"`dt` {dt:g} needs {quotient:.3g} steps from {t0:g} to {t1:g}, more than the {MOST_STEPS:.0e} that "
                "are run: increase it."
            )
        far = max(abs(self.t0), abs(self.t1))
        if self.t0 != self.t1 and far + abs(self.h) == far:
            raise ValueError(f"`dt` {dt:g} is below the spacing of floating-point numbers at t = {far:g}: increase it.")
        self.n_steps, self.remainder = self.place(self.t1)

    def time(self, k: int) -> float:
        """t0 + k·h, and exactly t1 at the end if h divides the interval."""
        return self.t1 if k == self.n_steps and self.remainder == 0 else self.t0 + k * self.h

    def place(self, t: float) -> tuple[int, float]:
        """`locate` of one time."""
        x = (t - self.t0) / self.h
        nearest = round(x)
        if abs(x - nearest) <= 4 * EPS * (abs(nearest) + (abs(t) + abs(self.t0)) / abs(self.h)):
            return nearest, 0.0
        count = math.floor(x)
        return count, t - (self.t0 + count * self.h)

    def locate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Counts k and signed remainders r with t = t0 + k·h + r, 0 ≤ r/h < 1."""
        x = (t - self.t0) / self.h
        nearest = np.rint(x)
        off, counts = np.abs(x - nearest), np.abs(nearest)
        if (off <= 4 * EPS * counts).all():  # as in most runs: nearer than is allowed
            return nearest.astype(np.int64), np.zeros(len(t))
        on_grid = off <= 4 * EPS * (counts + (np.abs(t) + abs(self.t0)) / abs(self.h))
        count = np.where(on_grid, nearest, np.floor(x)).astype(np.int64)
        return count, np.where(on_grid, 0.0, t - (self.t0 + count * self.h))

    def outputs(self, t_eval: np.ndarray | None, save_every: int) -> np.ndarray:
        """Output times (n,): `t_eval`, or every `save_every`-th step and the end."""
        outputs = Outputs(self, t_eval, save_every)
        return outputs.part(0, outputs.n)[0]


class Outputs:
    """The outputs of a run by their numbers 0 … n − 1; a part of them is made at a time.

    These are the times of `t_eval`, or those of every `save_every`-th step and the end.
    """

    def __init__(self, grid: Grid, t_eval: np.ndarray | None, save_every: int) -> None:
        self.grid, self.t_eval, self.every = grid, t_eval, save_every
        if t_eval is None:
            whole, rest = divmod(grid.n_steps, save_every)
            self.n, self.last = whole + 1 + bool(rest or grid.remainder), grid.n_steps
            return
        if len(t_eval) == 1:
            k, r = grid.place(float(t_eval[0]))
            self.count, self.remainder = np.array([k]), np.array([r])
        else:
            self.count, self.remainder = grid.locate(t_eval)
        self.n, self.last = len(t_eval), int(self.count[-1]) if len(t_eval) else 0

    def up_to(self, k: int) -> int:
        """Return how many there are at step k, within the step after it, and before."""
        if self.t_eval is not None:
            return int(self.count.searchsorted(k, "right"))
        return self.n if k >= self.last else k // self.every + 1

    def part(self, first: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the times, counts and remainders of the outputs from `first` to `end`."""
        if self.t_eval is not None:
            return self.t_eval[first:end], self.count[first:end], self.remainder[first:end]
        grid = self.grid
        count = np.arange(first * self.every, end * self.every, self.every)
        t, remainder = grid.t0 + count * grid.h, np.zeros(end - first)
        if first < end == self.n:
            count[-1], remainder[-1] = grid.n_steps, grid.remainder
            t[-1] = grid.t1 if grid.n_steps or grid.remainder else grid.t0
        return t, count, remainder

    def counts(self, n: int, last: int) -> tuple[int, int]:
        """Return the number of states that the first n outputs take from steps 1 … last, and of those within steps."""
        if self.t_eval is not None:
            if n == 1:
                return int(0 < self.count[0] <= last), int(self.remainder[0] != 0)
            count = self.count[:n]
            count = count[count.searchsorted(0, "right") : count.searchsorted(last, "right")]
            return len(distinct(count)[0]), int(np.count_nonzero(self.remainder[:n]))
        n_steps, at_end = self.grid.n_steps, n == self.n > 0
        multiples = min(max(n - 1, 0), n_steps // self.every, last // self.every)
        rest = at_end and n_steps % self.every > 0 and n_steps <= last
        return multiples + rest, int(at_end and bool(self.grid.remainder))


def distinct(count: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """The distinct ones of sorted counts, and where among them each is; None where all are distinct."""
    if len(count) < 2 or (count[1:] > count[:-1]).all():
        return count, None
    new = np.empty(len(count), dtype=bool)
    new[0] = True
    np.not_equal(count[1:], count[:-1], out=new[1:])
    return count[new], np.cumsum(new) - 1
