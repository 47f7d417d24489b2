"""Stages of splitting methods, a kick and a drift each: their numbers as tables, and the code that executes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL, Scheme

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem

__all__ = [
    "Kick",
    "StageTable",
    "check_damping",
    "kicks_of",
    "run_table",
    "single_table",
    "step_table",
    "with_last_stage",
]


@dataclass(frozen=True, eq=False)
class StageTable:
    """The numbers of m stages, for fixed steps (m,) or as coefficients of polynomials in a variable (m, K).

    Attributes
    ----------
    level : int
        The terms of kicks: see `sympflow.schemes.Scheme.level`.
    kicks, drifts, gradients, curvatures : ndarray of shape (m,) or (m, K)
        b, a, g and c.
    polynomials : ndarray of shape (m, M) or (m, M, K)
        e of the M monomials, none for other kicks.
    times : ndarray of shape (m,) or (m, K), optional
        When each kick is, counted from the beginning of the step; the default is the sum of the drifts before it.
    direction : float
        Steps by which the time moves on with a step of the table: −1 of an inverse.
    more : ndarray of shape (n, m), optional
        Further rows: those of friction.
    """

    level: int
    kicks: np.ndarray
    drifts: np.ndarray
    gradients: np.ndarray
    curvatures: np.ndarray
    polynomials: np.ndarray
    times: np.ndarray | None = None
    direction: float = 1.0
    more: np.ndarray | None = None

    @cached_property
    def packed(self) -> np.ndarray:
        """The numbers that loops read, as rows of one array (1 + n, m) or (1 + n, m, K): a, then those of the kicks."""
        of_kicks = [self.kicks, *self.polynomials.swapaxes(0, 1)]
        if self.level != POLYNOMIAL:
            of_kicks = [self.kicks, self.gradients, self.curvatures][: 1 + self.level]
        return np.ascontiguousarray(np.stack([self.drifts, *of_kicks, *(() if self.more is None else self.more)]))

    def rows(self, values: tuple[float, ...]) -> np.ndarray:
        """`packed`, and for each of the values of a system's parameters a row, the same for all stages."""
        if not values:
            return self.packed
        rows = self._with_values.get(values)
        if rows is None:
            more = np.zeros((len(values), *self.packed.shape[1:]))
            (more if more.ndim == 2 else more[..., 0])[:] = np.array(values)[:, None]
            rows = np.concatenate([self.packed, more])
            self._with_values.clear()  # systems with other values come one after the other
            self._with_values[values] = rows
        return rows

    def timed_rows(self, values: tuple[float, ...], h: float, t0: float) -> np.ndarray:
        """`rows`, before the values the times of the kicks, that of step 0 and the step of the time."""
        of_kicks = np.cumsum(self.drifts, axis=0) - self.drifts if self.times is None else self.times
        clock = np.zeros((2, *of_kicks.shape))
        (clock if clock.ndim == 2 else clock[..., 0])[:] = np.array([t0, self.direction * h])[:, None]
        rows, n = self.rows(values), len(self.packed)
        return np.concatenate([rows[:n], of_kicks[None], clock, rows[n:]])

    @cached_property
    def _with_values(self) -> dict[tuple[float, ...], np.ndarray]:
        return {}

    def scaled(self, h: float) -> StageTable:
        """The numbers of steps h, of those for h = 1."""
        return StageTable(
            self.level,
            h * self.kicks,
            h * self.drifts,
            _times_power(self.gradients, h, 3),
            _times_power(self.curvatures, h, 5),
            _times_power(self.polynomials, h, 3),
            None if self.times is None else h * self.times,
            self.direction,
        )


def _times_power(numbers: np.ndarray, h: float, n: int) -> np.ndarray:
    """hⁿ times numbers, of which those that are 0 stay 0 even where hⁿ is beyond what a float can hold."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(numbers == 0, 0.0, np.float64(h) ** n * numbers)


# the numbers of a scheme ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Stage:
    kick: float = 0.0
    gradient: float = 0.0
    curvature: float = 0.0
    polynomial: tuple[float, ...] = ()
    drift: float = 0.0

    @property
    def kicks(self) -> bool:
        return bool(self.kick or self.gradient or self.curvature or any(self.polynomial))

    def kicked_by(self, other: _Stage) -> _Stage:
        """This stage, whose kick is followed by that of the other one."""
        return replace(
            self,
            kick=self.kick + other.kick,
            gradient=self.gradient + other.gradient,
            curvature=self.curvature + other.curvature,
            polynomial=tuple(a + b for a, b in zip(self.polynomial, other.polynomial, strict=True)),
        )


def _stages(scheme: Scheme) -> list[_Stage]:
    """The scheme as kick-drift pairs without idle maps, except a zero kick in front or a zero drift at the end."""
    none = _Stage(polynomial=(0.0,) * len(scheme.monomials) if scheme.polynomials else ())
    stages: list[_Stage] = []
    for kind, one, three, five, e in scheme.substeps:
        if kind == "kick":
            stages.append(_Stage(one, three, five, e))
        elif stages and stages[-1].drift == 0.0:
            stages[-1] = replace(stages[-1], drift=one)
        else:
            stages.append(replace(none, drift=one))
    return stages or [none]


def _table(
    scheme: Scheme, stages: Sequence[_Stage], times: Sequence[float] | None = None, direction: float = 1.0
) -> StageTable:
    columns = zip(*((s.kick, s.drift, s.gradient, s.curvature) for s in stages), strict=True)
    kicks, drifts, gradients, curvatures = (np.array(column, dtype=float) for column in columns)
    polynomials = np.array([s.polynomial for s in stages], dtype=float)
    known = None if times is None else np.array(times)
    return StageTable(scheme.level, kicks, drifts, gradients, curvatures, polynomials, known, direction)


@lru_cache(maxsize=256)
def step_table(scheme: Scheme) -> StageTable:
    """The stages of one step by itself, for h = 1, as constant polynomials (m, 1)."""
    table = _table(scheme, _stages(scheme))
    kicks, drifts, gradients = (column[..., None] for column in (table.kicks, table.drifts, table.gradients))
    return StageTable(table.level, kicks, drifts, gradients, table.curvatures[..., None], table.polynomials[..., None])


def single_table(scheme: Scheme, h: float) -> StageTable:
    """The stages of one step h by itself, (m,)."""
    return _table(scheme, _stages(scheme)).scaled(h)


@lru_cache(maxsize=256)
def run_table(scheme: Scheme, h: float) -> StageTable:
    """The table [opening, inner …, link, closing] of a run whose steps are h: see `runs.run_function`."""
    stages = _stages(scheme)
    first, last = stages[0], stages[-1]
    opening = replace(
        first, kick=0.0, gradient=0.0, curvature=0.0, drift=0.0, polynomial=(0.0,) * len(first.polynomial)
    )
    inner, link = stages[:-1], last
    if len(stages) > 1 and last.drift == 0.0:  # kick … kick: the last kick and the next first stage are one
        opening, inner, link = first, stages[1:-1], replace(last.kicked_by(first), drift=first.drift)
    elif len(stages) > 1 and not first.kicks:  # drift … drift
        opening, inner, link = first, stages[1:-1], replace(last, drift=last.drift + first.drift)
    before_inner = opening.drift + np.cumsum([0.0, *(s.drift for s in inner)])
    # The link begins with the last kick of the step before; an output is closed after so many whole steps.
    times = [0.0, *before_inner[: len(inner)].tolist(), -last.drift, -last.drift]
    direction = float(round(sum(s.drift for s in stages)))
    return _table(scheme, [opening, *inner, link, last], times, direction).scaled(h)


def with_last_stage(run: StageTable, after: StageTable) -> StageTable:
    """The stages of a map of the ends of a run, whose last stage is before them; two drifts in a row are one."""
    assert run.times is not None
    of_kicks = np.cumsum(after.drifts) - after.drifts if after.times is None else after.times
    names = ("kicks", "drifts", "gradients", "curvatures", "polynomials")
    last = {name: np.array(getattr(run, name)[-1]) for name in names}
    merged = int(not any(getattr(after, name)[0].any() for name in names if name != "drifts"))
    if merged:
        last["drifts"] = last["drifts"] + after.drifts[0]
    columns: dict[str, Any] = {
        name: np.concatenate([last[name][None], getattr(after, name)[merged:]]) for name in names
    }
    return replace(after, **columns, times=np.concatenate([run.times[-1:], of_kicks[merged:]]))


# kinds of kick --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kick:
    """A kind of kick.

    Attributes
    ----------
    numbers : tuple of str
        Its numbers, the rows 1, 2, … of a table. A kick applies where the last one is not 0, else one with fewer.
    powers : tuple of int
        The powers of the step length with which they grow.
    """

    numbers: tuple[str, ...]
    powers: tuple[int, ...]


PLAIN, GRADIENT, CURVED = Kick(("b",), (1,)), Kick(("b", "g"), (1, 3)), Kick(("b", "g", "c"), (1, 3, 5))
KICKS = {0: (PLAIN,), FORCE_GRADIENT: (GRADIENT, PLAIN), CURVATURE: (CURVED, GRADIENT, PLAIN)}
"""The kinds of kick of a level, that with most numbers first."""


def kicks_of(level: int, n_monomials: int = 0) -> tuple[Kick, ...]:
    """The kinds of kick of a level, that with most numbers first; a polynomial of n monomials stands alone."""
    if level != POLYNOMIAL:
        return KICKS[level]
    return (Kick(("b", *(f"e_{m}" for m in range(n_monomials))), (1,) + (3,) * n_monomials),)


MOST_COUPLED = 6
"""Degrees of freedom of a damping matrix in compiled loops, where the two maps of each drift are 2d² numbers."""


def check_damping(system: HamiltonianSystem, in_memory: bool) -> None:
    """Refuse a damping matrix that compiled loops do not take.

    Raises
    ------
    ValueError
    """
    if system.damping is not None and system.damping.ndim == 2 and (in_memory or system.ndof > MOST_COUPLED):
        raise ValueError(
            f"`system` {system.name!r} has a damping matrix, which is compiled for symbolic systems of up to "
            f"{MOST_COUPLED} degrees of freedom: use backend='array'."
        )
