"""Stages of splitting methods, a kick and a drift each: their numbers as tables, and the code that executes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.lazy import lately_kept
from sympflow.schemes import POLYNOMIAL, Scheme

if TYPE_CHECKING:
    from sympflow.hamiltonian.friction import Friction
    from sympflow.hamiltonian.system import HamiltonianSystem

__all__ = ["StageTable", "check_damping", "kick_of", "run_table", "single_table", "step_table", "with_last_stage"]


@dataclass(frozen=True, eq=False)
class StageTable:
    """The numbers of m stages, for fixed steps (m,) or as coefficients of polynomials in a variable (m, K).

    `numbers` (n, m) or (n, m, K) are a of the drifts, then of the kicks b and e of each monomial, or b, g and c; `more`
    are rows of friction. `times` are those of the kicks, by default the sum of the drifts before. The time moves on by
    `direction` steps with a step of the table: −1 of an inverse.
    """

    level: int
    numbers: np.ndarray
    times: np.ndarray | None = None
    direction: float = 1.0
    more: np.ndarray | None = None

    @property
    def drifts(self) -> np.ndarray:
        return np.asarray(self.numbers[0])

    @cached_property
    def kick_times(self) -> np.ndarray:
        """`times`, or their default."""
        return np.cumsum(self.drifts, axis=0) - self.drifts if self.times is None else self.times

    @cached_property
    def packed(self) -> np.ndarray:
        """The numbers that loops read: of a kick as many as its level has; those of friction behind them."""
        n = len(self.numbers) if self.level == POLYNOMIAL else 2 + self.level
        return np.ascontiguousarray(np.concatenate([self.numbers[:n], *(() if self.more is None else [self.more])]))

    @lately_kept
    def rows(self, values: tuple[float, ...]) -> np.ndarray:
        """`packed`, and for each of the values of a system's parameters a row, the same for all stages."""
        return self.with_constants(values)

    def with_constants(self, values: Sequence[Any]) -> np.ndarray:
        """`packed`, and rows of these values."""
        return np.concatenate([self.packed, self._constant(values)]) if values else self.packed

    def timed_rows(self, values: Sequence[Any], h: Any, t0: Any) -> np.ndarray:
        """`rows`, before the values the times of the kicks, that of step 0 and the step of the time."""
        clock = self._constant((t0, self.direction * h))
        return np.concatenate([self.packed, self.kick_times[None], clock, self._constant(values)])

    def _constant(self, values: Sequence[Any]) -> np.ndarray:
        """Rows of numbers that are the same for all stages."""
        rows = np.zeros((len(values), *self.packed.shape[1:]))
        for row, value in zip(rows if rows.ndim == 2 else rows[..., 0], values, strict=True):
            row[:] = value
        return rows

    def valued(self, x: np.ndarray, h: np.ndarray) -> StageTable:
        """The numbers of steps of lengths h (N,) by the polynomials of x (N,): of each stage all rows, (m N,)."""
        numbers, times = (evaluated(c, x).reshape(*c.shape[:-2], -1) for c in (self.numbers, self.kick_times))
        return replace(self, numbers=numbers, times=times).scaled(np.tile(h, len(self.drifts)))

    def damped(self, friction: Friction) -> StageTable:
        """The table with the rows of drifts with friction."""
        parts = (part.T.reshape(-1, *self.drifts.shape) for part in friction.factors(self.drifts.ravel()))
        return replace(self, more=np.concatenate([*parts]))

    def scaled(self, h: Any) -> StageTable:
        """The numbers of steps h, of those for h = 1; those that are 0 stay 0 even where hⁿ is not finite."""
        powers = (1, 1, *([3] * len(self.numbers) if self.level == POLYNOMIAL else (3, 5)))[: len(self.numbers)]
        with np.errstate(over="ignore", invalid="ignore"):
            factors = np.array([np.asarray(h, dtype=float) ** n for n in powers]).reshape(len(powers), -1)
            numbers = np.where(self.numbers == 0, 0.0, factors * self.numbers)
        return replace(self, numbers=numbers, times=None if self.times is None else h * self.times)


def evaluated(coefficients: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Polynomials (…, K) at each x (N,): (…, N)."""
    total = np.zeros((*coefficients.shape[:-1], len(x)))
    for k in range(coefficients.shape[-1] - 1, -1, -1):
        total = total * x + coefficients[..., k, None]
    return total


# the numbers of a scheme ------------------------------------------------------------------------------------------


def _stages(scheme: Scheme) -> list[np.ndarray]:
    """The scheme as kick-drift pairs without idle maps, except a zero kick in front or a zero drift at the end."""
    stages: list[np.ndarray] = []
    nothing = np.zeros(2 + (len(scheme.monomials) if scheme.polynomials else 2))
    for kind, one, three, five, e in scheme.substeps:
        if kind == "kick":
            stages.append(np.array([0.0, one, *(e if scheme.polynomials else (three, five))]))
            continue
        if not stages or stages[-1][0] != 0.0:
            stages.append(nothing.copy())
        stages[-1][0] = one
    return stages or [nothing]


def _table(scheme: Scheme, stages: Sequence[np.ndarray], *times: Any) -> StageTable:
    return StageTable(scheme.level, np.stack(stages, axis=1), *times)


@lru_cache(maxsize=256)
def step_table(scheme: Scheme) -> StageTable:
    """The stages of one step by itself, for h = 1, as constant polynomials (m, 1)."""
    table = _table(scheme, _stages(scheme))
    return replace(table, numbers=table.numbers[..., None])


def single_table(scheme: Scheme, h: float) -> StageTable:
    """The stages of one step h by itself, (m,)."""
    return _table(scheme, _stages(scheme)).scaled(h)


@lru_cache(maxsize=256)
def run_table(scheme: Scheme, h: float) -> StageTable:
    """The table [opening, inner …, link, closing] of a run whose steps are h: see `runs.run_function`."""
    stages = _stages(scheme)
    first, last = stages[0], stages[-1]
    opening, inner, link = 0 * first, stages[:-1], last
    if len(stages) > 1 and (last[0] == 0.0 or not first[1:].any()):  # kick … kick, or drift … drift: two are one
        opening, inner, link = first, stages[1:-1], last + first
    before_inner = opening[0] + np.cumsum([0.0, *(s[0] for s in inner)])
    # The link begins with the last kick of the step before; an output is closed after so many whole steps.
    times = np.array([0.0, *before_inner[: len(inner)], -last[0], -last[0]])
    direction = float(round(sum(s[0] for s in stages)))
    return _table(scheme, [opening, *inner, link, last], times, direction).scaled(h)


def with_last_stage(run: StageTable, after: StageTable) -> StageTable:
    """The stages of a map of the ends of a run, whose last stage is before them; two drifts in a row are one."""
    assert run.times is not None
    last, merged = run.numbers[:, -1:].copy(), int(not after.numbers[1:, 0].any())
    if merged:
        last[0] += after.drifts[0]
    numbers = np.concatenate([last, after.numbers[:, merged:]], axis=1)
    return replace(after, numbers=numbers, times=np.concatenate([run.times[-1:], after.kick_times[merged:]]))


# kicks --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kick:
    """A kick, its `numbers`, rows 1, 2, … of a table, and the `powers` of the step with which they grow."""

    numbers: tuple[str, ...]
    powers: tuple[int, ...]


def kick_of(level: int, n_monomials: int = 0) -> Kick:
    """The kick of a level with all its terms, of a polynomial with n monomials."""
    if level == POLYNOMIAL:
        return Kick(("b", *(f"e_{m}" for m in range(n_monomials))), (1,) + (3,) * n_monomials)
    return Kick(("b", "g", "c")[: 1 + level], (1, 3, 5)[: 1 + level])


MOST_COUPLED = 6
"""Degrees of freedom of a damping matrix in compiled loops, where the two maps of each drift are 2d² numbers."""


def check_damping(system: HamiltonianSystem, in_memory: bool) -> None:
    """Refuse a damping matrix that compiled loops do not take, by a ValueError."""
    if system.damping is not None and system.damping.ndim == 2 and (in_memory or system.ndof > MOST_COUPLED):
        raise NotCompiled(
            f"`system` {system.name!r} has a damping matrix, which is compiled for symbolic systems of up to "
            f"{MOST_COUPLED} degrees of freedom: use backend='array'."
        )
