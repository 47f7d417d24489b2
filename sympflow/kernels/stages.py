"""Stages of splitting methods, a kick and a drift each: their numbers as tables, and the code that executes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL, Scheme

if TYPE_CHECKING:
    from sympflow.hamiltonian.system import HamiltonianSystem

__all__ = [
    "DampedDrift",
    "Kick",
    "StageTable",
    "TimedNumbers",
    "damped_drift",
    "kicks_of",
    "lanes_source",
    "numbers_of_kicks",
    "numbers_source",
    "run_table",
    "single_table",
    "stages_source",
    "step_constants",
    "step_table",
    "takes_values",
    "time_lines",
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
    """The table [opening, inner …, link, closing] of a run whose steps are h: see `text/loops.py`."""
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


def takes_values(level: int) -> bool:
    """True of kicks whose code is the same for all values of parameters.

    In those with force gradients sums such as g ω⁴ − b ω² would round in another way than with numbers in the code.
    """
    return level not in (FORCE_GRADIENT, CURVATURE)


# kinds of kick as code --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kick:
    """A kind of kick as code.

    Attributes
    ----------
    name : str
        Its function where kicks are scheduled: ``name(q, p, work, j)``, and for lanes ``name_lane(q, p, numbers)``.
    numbers : tuple of str
        Its numbers, the rows 1, 2, … of a table. A kick applies where the last one is not 0, else one with fewer.
    powers : tuple of int
        The powers of the step length with which they grow.
    unscheduled : tuple of str
        The lines of one application where kicks are not scheduled, with a workspace `{work}`.
    """

    name: str
    numbers: tuple[str, ...]
    powers: tuple[int, ...]
    unscheduled: tuple[str, ...]

    def application(self, scheduled: bool, lane: bool) -> list[str]:
        """The lines that change p once, of a single trajectory or of a lane; q is left as it is."""
        if scheduled:
            return [f"p = {self.name}_lane(q, p, numbers)" if lane else f"p = {self.name}(q, p, work, j)"]
        return [line.format(work="None" if lane else "work") for line in self.unscheduled]


def _added(change: str) -> tuple[str, ...]:
    return (f"p, p_error = move(p, p_error, {change}(q, numbers, {{work}}))",)


PLAIN = Kick("kicked", ("b",), (1,), _added("kick"))
GRADIENT = Kick(
    "gradient_kicked",
    ("b", "g"),
    (1, 3),
    (
        "first, second = gradient_kick(q, numbers, {work})",
        "p, p_error = move(p, p_error, first)",
        "if COUPLED:",
        "    p, p_error = move(p, p_error, second)",
    ),
)
CURVED = Kick("curvature_kicked", ("b", "g", "c"), (1, 3, 5), _added("curvature_kick"))
KICKS = {0: (PLAIN,), FORCE_GRADIENT: (GRADIENT, PLAIN), CURVATURE: (CURVED, GRADIENT, PLAIN)}
"""The kinds of kick of a level, that with most numbers first."""


def kicks_of(level: int, n_monomials: int = 0) -> tuple[Kick, ...]:
    """The kinds of kick of a level, that with most numbers first; a polynomial of n monomials stands alone."""
    if level != POLYNOMIAL:
        return KICKS[level]
    letters = tuple(f"e_{m}" for m in range(n_monomials))
    powers = (1,) + (3,) * n_monomials
    return (Kick("polynomial_kicked", ("b", *letters), powers, _added("polynomial_kick")),)


# drifts with friction as code ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DampedDrift:
    """A drift with friction as code: its numbers are the linear maps p ↦ ∫e^{−Γu}p du and p ↦ e^{−Γs}p.

    They are the last rows of a table: one number each for Γ = γ, d for a diagonal Γ, d² for a matrix.

    Attributes
    ----------
    ndim : int
        Of Γ: 0, 1 or 2.
    ndof : int
    in_place : bool
        True if states are arrays, changed in place, as in the text `array_states`.
    """

    ndim: int
    ndof: int
    in_place: bool

    @property
    def size(self) -> int:
        """The numbers of one of the maps."""
        return int(self.ndof**self.ndim)

    def source(self, first: int) -> str:
        """``drift_of``, ``spread``, the integral, and ``damped``, the new p; `first` is the row of the numbers."""
        n, d = self.size, self.ndof
        if self.in_place:
            assert self.ndim < 2
            number = "a[0]", "a[1]"
            if self.ndim:
                number = "a[i]", f"a[{d} + i]"
            return f"""@njit(**OPTIONS, forceinline=True)
def drift_of(table, j):
    return table[{first}:, j]


@njit(**OPTIONS)
def spread(p, a, work):
    for i in range(NDOF):
        work[1][i] = {number[0]} * p[i]
    return work[1]


@njit(**OPTIONS)
def damped(p, a):
    for i in range(NDOF):
        p[i] *= {number[1]}
    return p"""

        def times(offset: int) -> str:
            if self.ndim == 2:
                sums = (" + ".join(f"a[{offset + d * i + k}]*p[{k}]" for k in range(d)) for i in range(d))
            else:
                sums = (f"a[{offset + (i if self.ndim else 0)}]*p[{i}]" for i in range(d))
            return "(" + "".join(f"{each}, " for each in sums) + ")"

        return f"""@njit(**OPTIONS, forceinline=True)
def drift_of(table, j):
    return ({"".join(f"table[{first + i}, j], " for i in range(2 * n))})


@njit(**OPTIONS, forceinline=True)
def spread(p, a, work):
    return {times(0)}


@njit(**OPTIONS, forceinline=True)
def damped(p, a):
    return {times(n)}"""

    def drifted(self, move: str) -> list[str]:
        """The lines of a drift, of those of one without friction: of q by ``{p}`` over ``{a}``."""
        if self.ndim == 0:  # the integral is a drift over another time
            return [move.format(p="p", a="a[0]"), "p = damped(p, a)"]
        spread = "spread(p, a, work)" if self.in_place else "spread(p, a, None)"
        return [move.format(p=spread, a="1.0"), "p = damped(p, a)"]


MOST_COUPLED = 6
"""Degrees of freedom of a damping matrix in compiled loops, where the two maps of each drift are 2d² numbers."""


def damped_drift(system: HamiltonianSystem, in_place: bool) -> DampedDrift | None:
    """The drift of a system with friction as code; None without."""
    if system.damping is None:
        return None
    if system.damping.ndim == 2 and (in_place or system.ndof > MOST_COUPLED):
        raise ValueError(
            f"`system` {system.name!r} has a damping matrix, which is compiled for symbolic systems of up to "
            f"{MOST_COUPLED} degrees of freedom: use backend='array'."
        )
    return DampedDrift(system.damping.ndim, system.ndof, in_place)


_DRIFT_OF = """@njit(**OPTIONS, forceinline=True)
def drift_of(table, j):
    return table[0, j]"""
_TABLE = """@njit(**OPTIONS, forceinline=True)
def columns_of(table):
    return table.shape[1]


@njit(**OPTIONS)
def first_coefficients(table):
    return table[:, :, 0]


@njit(**OPTIONS)
def drift_at(table, j, x):
    return polynomial(table[0, j], x)"""


class TimedNumbers(Protocol):
    """The numbers of kicks and drifts as code, where they depend on the time."""

    def source(self, kinds: Sequence[Kick], n_rows: int) -> str:
        """``numbers_of`` and ``numbers_at`` of `numbers_source`, of tables as `StageTable.timed_rows` makes them.

        `n_rows` are the rows of a table before those of the values of parameters and of the time.
        """
        ...


class LaneNumbers(Protocol):
    """The numbers of lanes as code, where they depend on the time."""

    def lane_source(self, kinds: Sequence[Kick], n_rows: int) -> str:
        """``common_of(table, j, k)`` and ``numbers_of_lane(Y, common, lane)`` of `lanes_source`, of varied lanes."""
        ...

    def later_source(self, kinds: Sequence[Kick], n_rows: int) -> str:
        """``timed_numbers(table, j)``, and ``numbers_after(common, k)`` of these, the numbers of kick j of step k."""
        ...


def time_lines(row: int) -> tuple[str, str]:
    """The time of kick j of step k of a run, and in a step h from t on; `row` is the first of those of the time."""
    return (
        f"time = table[{row + 1}, j] + (k * table[{row + 2}, j] + table[{row}, j])",
        f"time = t + h * polynomial(table[{row}, j], x)",
    )


def numbers_of_kicks(kinds: Sequence[Kick]) -> tuple[list[str], list[str]]:
    """The numbers of kicks as code: those of a run, and those of a step h by polynomials in x."""
    rows = range(1, 1 + len(kinds[0].numbers))
    steps = {1: "h", 3: "h ** 3", 5: "h ** 5"}
    values = [f"{steps[n]} * polynomial(table[{i}, j], x)" for i, n in zip(rows, kinds[0].powers, strict=True)]
    return [f"table[{i}, j]" for i in rows], values


def _numbers_source(kinds: Sequence[Kick], n_parameters: int, n_rows: int) -> str:
    """``numbers_of`` and ``numbers_at`` of `numbers_source`, of a system that does not depend on the time."""
    numbers, values = numbers_of_kicks(kinds)
    constant = range(n_rows, n_rows + n_parameters)
    numbers += [f"table[{i}, j]" for i in constant]
    values += [f"table[{i}, j, 0]" for i in constant]
    return f"""@njit(**OPTIONS)
def numbers_of(table, j, k=0):
    return ({", ".join(numbers)}, )


@njit(**OPTIONS)
def numbers_at(table, j, x, h, t):
    return ({", ".join(values)}, )"""


def numbers_source(
    kinds: Sequence[Kick],
    friction: DampedDrift | None = None,
    n_parameters: int = 0,
    driving: TimedNumbers | None = None,
) -> str:
    """The functions of the text `loops` that read the numbers of stages; without `driving` systems may share them.

    ``numbers_of(table, j, k)`` are the numbers of kick j of step k, ``numbers_at(table, j, x, h, t)`` those of a step h
    by polynomials in x that begins at the time t; the values of the parameters of H come after them. ``drift_of(table,
    j)`` are those of a drift. `FIRST_VALUE` is the row of a table with the first of the values.
    """
    first, n_rows = 1 + len(kinds[0].numbers), _rows_before_values(kinds, friction)
    numbers = _numbers_source(kinds, n_parameters, n_rows) if driving is None else driving.source(kinds, n_rows)
    return f"""FIRST_VALUE = {n_rows}


{numbers}


{_TABLE}


{_DRIFT_OF if friction is None else friction.source(first)}"""


def stages_source(
    kinds: Sequence[Kick],
    scheduled: bool,
    friction: DampedDrift | None = None,
    n_parameters: int = 0,
    driving: TimedNumbers | None = None,
    joined: bool = False,
) -> str:
    """``stage`` of the text `loops`, a kick and a drift of one trajectory; `joined`, these are one function."""
    head = "@njit(**OPTIONS, forceinline=True)\ndef stage(q, p, q_error, p_error, numbers, a, j, work):\n    "
    if joined:
        bodies = [[f"q, p = {k.name}_and_drifted(q, p, work, j, a)", "return q, p, q_error, p_error"] for k in kinds]
        return head + _cases(kinds, "numbers[{0}] != 0.0", bodies)
    given = "numbers, " if n_parameters else ""
    move = f"q, q_error = move(q, q_error, drift({{p}}, {{a}}, {given}work))"
    if scheduled:
        move = f"q = drifted(q, {{p}}, {given}{{a}})"
    moved = [move.format(p="p", a="a")] if friction is None else friction.drifted(move)
    end = [*moved, "return q, p, q_error, p_error"]
    begin = ["fill_coefficients(numbers, work[j])"] if driving is not None and scheduled else []
    return head + _cases(
        kinds, "numbers[{0}] != 0.0", [[*begin, *kick.application(scheduled, False), *end] for kick in kinds]
    )


def _rows_before_values(kinds: Sequence[Kick], friction: DampedDrift | None) -> int:
    """The rows of a table before those of the values of a system's parameters."""
    return 1 + len(kinds[0].numbers) + (0 if friction is None else 2 * friction.size)


def _drifted_lane(friction: DampedDrift | None, n_parameters: int) -> list[str]:
    """The drift of a lane without compensated sums."""
    move = f"q, _ = move(q, None, drift({{p}}, {{a}}, {'numbers, ' if n_parameters else ''}None))"
    return [move.format(p="p", a="a")] if friction is None else friction.drifted(move)


def lanes_source(
    kinds: Sequence[Kick],
    scheduled: bool,
    friction: DampedDrift | None = None,
    n_parameters: int = 0,
    varied: bool = False,
    driving: LaneNumbers | None = None,
) -> str:
    """The functions of the text `lanes` that depend on the kinds of kick; not scheduled, sums are compensated.

    ``stage_lanes`` is a kick and a drift of all lanes by the same numbers, ``stage_each`` of each lane by its own, by
    column j of a table. `varied` lanes have their own values of the parameters in both, and take the rest from
    ``common_of(table, j, k)``; where there is one kind of kick and no time, scheduled ones take what depends on these
    values from a table in ``own_stages``, which makes two stages: `OWN`. With `driving` there is ``stage_lanes_at``
    too, whose lanes are at times of their own.
    """

    given = "numbers, " if n_parameters else ""
    n_numbers, values = len(kinds[0].numbers), range(n_parameters)

    def together(kick: Kick) -> list[str]:
        taken = ["numbers = numbers_of_lane(Y, common, lane)"] if varied else []
        kicked = [*taken, *kick.application(scheduled, lane=True)]
        if scheduled:
            return _over_lanes([*kicked, *_drifted_lane(friction, n_parameters)])
        drifted = f"q, q_error = move(q, q_error, drift(p, a, {given}None))"
        errors, stored = "q_error, p_error = unpack_lane(error, lane)", "pack_lane(q_error, p_error, error, lane)"
        return _over_lanes([errors, *kicked, drifted, stored])

    def each(kick: Kick) -> list[str]:
        taken = [] if varied else [f"value_{i} = table[FIRST_VALUE + {i}, j, 0]" for i in values]
        value = "Y[NUMBERS + N_NUMBERS + {0}, lane], " if varied else "value_{0}, "
        numbers = "".join(
            [f"Y[NUMBERS + {i}, lane], " for i in range(len(kick.numbers))] + [value.format(i) for i in values]
        )
        drifted = f"q, _ = move(q, None, drift(p, Y[A, lane], {given}None))"
        return [*taken, *_over_lanes([f"numbers = ({numbers})", *kick.application(True, lane=True), drifted])]

    # Kinds are told apart outside the loops: a loop with a branch in it, once it is long, is no longer made of vector
    # instructions.
    passed = "common" if varied else "numbers"
    own = varied and scheduled and driving is None and len(kinds) == 1
    before = f"OWN = {own}\nN_NUMBERS = {n_numbers}\n\n\n"
    if not varied or driving is None:
        before += "common_of = numbers_of\n\n\n"
    if varied:
        n_rows = _rows_before_values(kinds, friction)
        of_lane = _lane_source(n_numbers, n_parameters) if driving is None else driving.lane_source(kinds, n_rows)
        before += f"{of_lane}\n\n\n"
    source = f"""{before}@njit(**OPTIONS, inline="always")  # called, the loop over the lanes takes five times as long
def stage_lanes(Y, error, width, {passed}, a):
    {_cases(kinds, passed + "[{0}] != 0.0", [together(kick) for kick in kinds])}"""
    if not scheduled:
        return source
    if driving is not None:
        later = driving.later_source(kinds, _rows_before_values(kinds, friction))
        source += f"\n\n\n{later}\n\n\n{_stages_at_source(kinds, friction, n_parameters)}"
    if own:
        source += "\n\n\n" + _own_stages_source(friction, n_parameters)
    return f"""{source}


@njit(**OPTIONS, inline="always")
def stage_each(Y, width, table, j):
    n = fill_lanes(Y, width, table, j)
    {_cases(kinds, "n == {1}", [each(kick) for kick in kinds])}"""


def step_constants(kinds: Sequence[Kick]) -> dict[str, Any]:
    """The constants of the text `lane_numbers`."""
    powers = (1, *kinds[0].powers)  # of the step length, those of the drift and of the numbers of kicks
    return {"N_NUMBERS": len(kinds[0].numbers), "FEWEST": len(kinds[-1].numbers), "STEP_POWERS": powers}


def _lane_source(n_numbers: int, n_parameters: int) -> str:
    """``numbers_of_lane``, those of a kick with the values of the parameters of a lane."""
    numbers = [f"common[{i}], " for i in range(n_numbers)]
    numbers += [f"Y[2 * NDOF + {i}, lane], " for i in range(n_parameters)]
    return f"@njit(**OPTIONS)\ndef numbers_of_lane(Y, common, lane):\n    return ({''.join(numbers)})"


def _own_stages_source(friction: DampedDrift | None, n_parameters: int) -> str:
    """``own_stages`` of `lanes_source`: one stage, and two in one pass, which loads and stores the states once."""

    def lines(numbers: str, a: str, own: str) -> list[str]:
        given = f"numbers, a = numbers_of_lane(Y, {numbers}, lane), {a}"
        return [given, f"p = kicked_by_own(q, p, numbers, {own}, lane)", *_drifted_lane(friction, n_parameters)]

    one, other = lines("common_1", "a_1", "own_1"), lines("common_2", "a_2", "own_2")
    head = '@njit(**OPTIONS, inline="always")\ndef '
    return "\n\n\n".join(
        f"{head}{name}(Y, width, {taken}):\n    " + "\n    ".join(_over_lanes(body))
        for name, taken, body in (
            ("own_stage_lanes", "common_1, a_1, own_1", one),
            ("two_own_stages_lanes", "common_1, a_1, own_1, common_2, a_2, own_2", [*one, *other]),
        )
    )


def _stages_at_source(kinds: Sequence[Kick], friction: DampedDrift | None, n_parameters: int) -> str:
    """``stage_lanes_at``, the kick and the drift of column j of a table, of lanes after so many steps of their own."""

    def lines(kick: Kick) -> list[str]:
        numbers = "numbers = numbers_after(common, counts[lane])"
        return _over_lanes([numbers, *kick.application(True, lane=True), *_drifted_lane(friction, n_parameters)])

    return f"""@njit(**OPTIONS, inline="always")
def stage_lanes_at(Y, width, table, j, counts):
    common, a = timed_numbers(table, j), drift_of(table, j)
    {_cases(kinds, "common[{0}] != 0.0", [lines(kick) for kick in kinds])}"""


def _over_lanes(lines: Sequence[str]) -> list[str]:
    body = ["q, p = unpack_lane(Y, lane)", *lines, "pack_lane(q, p, Y, lane)"]
    return ["for lane in range(width):", *(f"    {line}" for line in body)]


def _cases(kinds: Sequence[Kick], condition: str, bodies: Sequence[list[str]]) -> str:
    """The body of the first kind whose condition holds, else that of the last one."""
    lines: list[str] = []
    for kick, body in zip(kinds[:-1], bodies, strict=False):
        n = len(kick.numbers)
        lines += [f"{'elif' if lines else 'if'} {condition.format(n - 1, n)}:", *(f"    {line}" for line in body)]
    lines += ["else:", *(f"    {line}" for line in bodies[-1])] if lines else bodies[-1]
    return "\n    ".join(lines)
