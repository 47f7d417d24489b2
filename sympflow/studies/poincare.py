"""poincare_section(): where trajectories cross a plane of phase space, or where they are after each period."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, make_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_positive, checked_number
from sympflow.hamiltonian.scales import weights
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import Integrator
from sympflow.integrators.registry import name_of
from sympflow.metrics.crossings import Crossings, Plane, bisected, crossings, stroboscopic, whole_periods
from sympflow.metrics.orbits import Orbits, checked_orbits
from sympflow.show.style import saved
from sympflow.studies.reports import Column, Report, described, text_table
from sympflow.systems.given import GivenSystem, given_system

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def poincare_section(
    system: GivenSystem,
    method: Any = None,
    t_span: tuple[float, float] | None = None,
    y0: ArrayLike | None = None,
    *,
    coordinate: int | str | None = None,
    level: float | None = None,
    direction: int | None = None,
    sample: float | None = None,
    period: float | None = None,
    energy: float | None = None,
    n: int | None = None,
    seed: int = 0,
    **options: Any,
) -> PoincareSection:
    """The states in which trajectories cross the plane y[coordinate] = level, or those after each period.

    Each crossing is located to rounding on the dense output of the method, as an event is: with fixed steps by a
    shorter step. Only the crossings are stored.

    Of a driven system the section is *stroboscopic*: the states at t0, t0 + T, t0 + 2T …, which are ends of steps. For
    d = 1 without friction the map from each to the next preserves area.

    Parameters
    ----------
    system : HamiltonianSystem
    method : str, Integrator or trained flow, optional
        By default one that suits the system, as for `solve`.
    t_span : (float, float), optional
        The default is the system's.
    y0 : array_like of shape (..., 2d), optional
        One state, or a batch of them. With fixed steps the trajectories advance together. The default is the system's.
    coordinate : int or str, optional
        Index into [q, p], or a name such as "q1" or "p2"; by default the first. For a driven system it chooses the
        crossings of a plane, instead of one point each period.
    level : float, optional
        By default 0.
    direction : 1, -1 or 0, optional
        Only crossings upwards, the default, only downwards, or both, along the run as for events: in a run backward in
        time the coordinate decreases with t where it is crossed upwards. A start on the plane counts as a crossing, as
        for events.
    sample : float, optional
        Longest time between two samples; two crossings within it are missed. The default is `system.dt`, or the
        method's step where that is shorter.
    period : float, optional
        T, for a stroboscopic section; by default that of a driven system. Not together with a plane. Fixed steps become
        the largest up to `dt` that divides T; trained flows keep theirs.
    energy : float, optional
        In place of `y0`: orbits that start on the plane with this H. For two degrees of freedom the sections of orbits
        with one energy do not intersect.
    n : int, optional
        Orbits of this energy; by default 16.
    seed : int
        Seed of their random initial states.
    **options
        Options of the method.

    Returns
    -------
    PoincareSection
        With `.rows`, `.table()`, `.plot()`, `.to_csv()` and `.to_json()`.

    Raises
    ------
    ValueError, TypeError
        For bad arguments, at once.

    Examples
    --------
    >>> import sympflow
    >>> system = sympflow.systems.henon_heiles()
    >>> section = poincare_section(system, "kahan_li8", (0, 100), energy=0.125, n=5)
    >>> system.hamiltonian(section.y0).round(12).tolist()
    [0.125, 0.125, 0.125, 0.125, 0.125]
    """
    system = given_system(system)
    plane = {"coordinate": coordinate, "level": level, "direction": direction, "sample": sample}
    plane |= {"energy": energy, "n": n}
    T = _checked_period(system, period, [name for name, value in plane.items() if value is not None])
    if T is not None:
        orbits = checked_orbits(system, method, t_span, y0, options, "a stroboscopic section is one of")
        if not whole_periods(orbits.t_span, T):
            t0, t1 = orbits.t_span
            raise ValueError(f"`t_span` ({t0:g}, {t1:g}) is shorter than the period {T:g}: choose a later end.")
        seen = stroboscopic(orbits.integrator, orbits.system, orbits.t_span, orbits.rows, T)
        return _section(orbits, seen, T)
    index = _check_coordinate(0 if coordinate is None else coordinate, system.ndof)
    direction = 1 if direction is None else direction
    if direction not in (-1, 0, 1):
        raise ValueError(f"`direction` must be 1 (upwards), -1 (downwards) or 0 (both); got {direction!r}.")
    level = 0.0 if level is None else level
    checked_number("level", level, "a finite number, the value of the coordinate on the plane")
    if energy is not None:
        if y0 is not None:
            raise ValueError("`energy` and `y0` both choose the initial states: give one of them.")
        y0 = states_of_energy(system, energy, 16 if n is None else n, Plane(index, float(level), direction), seed)
    elif n is not None:
        raise ValueError("`n` orbits are drawn for an `energy`: give it, or the states `y0`.")
    orbits = checked_orbits(system, method, t_span, y0, options, "crossings are located on")
    sample = system.dt if sample is None else sample
    checked_number("sample", sample, "a positive number, a time", lambda x: x > 0)
    where = Plane(index, float(level), direction)
    seen = crossings(orbits.integrator, orbits.system, orbits.t_span, orbits.rows, where, float(sample))
    return _section(orbits, seen, where)


FINE = 1.05 ** np.arange(-150, 280)
"""Distances at which rays are tried, from 1e-3 to 1e6 times the one at which the first of them has the energy."""


def states_of_energy(system: HamiltonianSystem, energy: float, n: int, plane: Plane, seed: int = 0) -> np.ndarray:
    """Return n states (n, 2d) on a plane with H = energy, which cross it in its direction.

    They lie on rays from the lowest of a few states on the plane, within the first place where the energy is reached;
    the coordinate that is conjugate to that of the plane then makes up for the rest of the energy.

    Raises
    ------
    ValueError
        If the system is driven, or no state of this energy is found.
    """
    system.check_autonomous("so that no orbit has a constant `energy`", "pass `y0`")
    checked_number("energy", energy, "a finite number, a value of H")
    check_counts(n=n)
    d, rng, factors = system.ndof, np.random.default_rng(seed), weights(system)
    c, partner = plane.coordinate, (plane.coordinate + d) % (2 * d)

    def H(y: np.ndarray) -> np.ndarray:
        return np.asarray(system.hamiltonian(y))

    def reached(starts: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Distances (n,) along rays at which the energy is first reached; NaN where it is not."""
        coarse = 2.0 ** np.arange(-900.0, 900.0, 2.0)
        exceeded = (H(starts + coarse[:, None, None] * rays) > energy).any(1)
        steps = coarse[exceeded.argmax()] * FINE
        over = H(starts + steps[:, None, None] * rays) > energy
        first = over.argmax(0)
        low, high = np.where(first > 0, steps[np.maximum(first - 1, 0)], 0.0), steps[first]
        low, _ = bisected(low, high, lambda middle: ~(H(starts + middle[:, None] * rays) > energy), 60)
        return np.where(over.any(0), low, np.nan)

    known = [np.zeros(2 * d)] if system.y0 is None else [np.zeros(2 * d), system.y0]
    candidates = np.array(known if system.domain is None else [*known, *system.domain.sample(64, seed)])
    candidates[:, c], candidates[:, partner] = plane.level, 0.0
    with np.errstate(all="ignore"):
        values = H(candidates)
        lowest = candidates[np.nanargmin(values)] if np.isfinite(values).any() else candidates[0]
        if not H(lowest) < energy:
            raise ValueError(
                f"`energy` {energy:g} is below H = {float(H(lowest)):g}, the lowest of the states that were tried on "
                "the plane: raise it, or pass `y0`."
            )
        rays = rng.standard_normal((n, 2 * d))
        rays[:, [c, partner]] = 0.0
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300) * factors
        y = np.broadcast_to(lowest, (n, 2 * d)).copy()
        if d > 1:
            y += (reached(y, rays) * rng.uniform(size=n) ** (1 / (2 * d - 2)))[:, None] * rays
        up = np.zeros((n, 2 * d))
        up[:, partner] = 1 / factors[partner]
        ends, others = (y + reached(y, way)[:, None] * way for way in (up, -up))
        if plane.direction:
            crosses = np.sign(np.asarray(system.vector_field(ends))[:, c]) == plane.direction
            ends = np.where(crosses[:, None], ends, others)
    if not np.isfinite(ends).all():
        raise ValueError(
            f"`energy` {energy:g} does not bound the states on the plane: along a ray no state has it. Lower it, or "
            "pass `y0`."
        )
    return ends


def _checked_period(system: HamiltonianSystem, period: float | None, plane: list[str]) -> float | None:
    """The period of a stroboscopic section; None for one by a plane, of which some arguments were given."""
    if period is not None:
        if plane:
            raise ValueError(
                f"`period` and `{plane[0]}` choose two kinds of section, after each period and in a plane: give one "
                "of them."
            )
        check_positive("period", period)
        return float(period)
    if plane:
        return None
    if system.period is None:
        system.check_autonomous("and has no period of its own", "give `period`, or a plane by `coordinate`")
    return system.period


def _section(orbits: Orbits, seen: Crossings, where: Plane | float) -> PoincareSection:
    """The result, by the plane or by the period."""
    plane = where if isinstance(where, Plane) else None
    return PoincareSection(
        orbits.system,
        orbits.integrator,
        orbits.t_span,
        orbits.rows,
        None if plane is None else plane.coordinate,
        None if plane is None else plane.level,
        None if plane is None else plane.direction,
        seen.trajectory,
        seen.t,
        seen.states,
        seen.status if orbits.batch else int(seen.status[0]),
        seen.message,
        where if isinstance(where, float) else None,
    )


@dataclass(frozen=True, repr=False)
class PoincareSection(Report):
    """The crossings of a plane, or the states after each period; those of each trajectory together, in order of time.

    Attributes
    ----------
    system, integrator, t_span
        The run.
    y0 : ndarray (N, 2d)
        The initial states.
    coordinate, level, direction
        The plane; None of a stroboscopic section.
    trajectory : ndarray (n,)
        The index of the initial state that each crossing belongs to.
    t : ndarray (n,)
    states : ndarray (n, 2d)
    status : int, or ndarray (N,) of a batch
        As of a `Solution`: 0 where the end was reached, −1 where the run failed. Crossings shortly before a failure may
        be those of a solution that is exploding already.
    message : str
        The status in words, with the time and the remedy.
    period : float or None
        T of a stroboscopic section.
    """

    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    y0: np.ndarray = field(repr=False)
    coordinate: int | None
    level: float | None
    direction: int | None
    trajectory: np.ndarray = field(repr=False)
    t: np.ndarray = field(repr=False)
    states: np.ndarray = field(repr=False)
    status: int | np.ndarray
    message: str
    period: float | None = None

    @property
    def success(self) -> bool:
        """True if every trajectory reached the end."""
        return bool(np.all(np.asarray(self.status) >= 0))

    def __len__(self) -> int:
        return len(self.t)

    def since(self, t: float) -> PoincareSection:
        """Return the section from a time on, along the run: without what passes before a damped system settles."""
        checked_number("t", t, "a finite number, a time")
        kept = self.t >= t if self.t_span[1] >= self.t_span[0] else self.t <= t
        return replace(self, trajectory=self.trajectory[kept], t=self.t[kept], states=self.states[kept])

    @cached_property
    def rows(self) -> tuple[Any, ...]:
        """One for each crossing: trajectory, t, and the coordinates q1 … pd."""
        Crossing = make_dataclass("Crossing", self.columns, frozen=True)
        found = zip(self.trajectory, self.t, self.states, strict=True)
        return tuple(Crossing(int(k), float(t), *map(float, y)) for k, t, y in found)

    def table(self, limit: int = 20) -> str:
        """The first `limit` crossings as text, and the message if a trajectory failed."""
        shown = range(min(limit, len(self)))
        columns = [
            Column("trajectory", [str(self.trajectory[i]) for i in shown]),
            Column("t", [f"{self.t[i]:.6f}" for i in shown]),
            *(
                Column(name, [f"{self.states[i, j]:.6f}" for i in shown])
                for j, name in enumerate(names(self.system.ndof))
                if j != self.coordinate
            ),
        ]
        more = f"\n… {len(self) - limit} more" if len(self) > limit else ""
        failure = "" if self.success else f"\n{self.message}"
        return (text_table(columns) + more if len(self) else "no crossing") + failure

    @property
    def columns(self) -> tuple[str, ...]:  # type: ignore[override]
        """The fields of the rows that files hold."""
        return ("trajectory", "t", *names(self.system.ndof))

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write all crossings to a CSV file, numbers to full precision."""
        if not len(self):
            raise ValueError("`section` has no crossing to write: run it longer, or move `level`.")
        return super().to_csv(path)

    def settings(self) -> dict[str, Any]:
        return {
            "system": described(self.system),
            "method": name_of(self.integrator),
            "t_span": list(self.t_span),
            "y0": self.y0.tolist(),
            "coordinate": None if self.coordinate is None else names(self.system.ndof)[self.coordinate],
            "level": self.level,
            "direction": self.direction,
            "period": self.period,
            "status": np.asarray(self.status).tolist(),
            "message": self.message,
        }

    def figure(self, x: int | str | None = None, y: int | str | None = None, turn: float | None = None) -> Figure:
        """The states in the plane of two coordinates, each trajectory in a shade of its own.

        Parameters
        ----------
        x, y : int or str, optional
            The coordinates; the default is the first position, other than that of the plane, or p if there is none, and
            its momentum.
        turn : float, optional
            Length of a turn in x, 2π where it is an angle: it is drawn from −turn/2 to turn/2.

        Raises
        ------
        ImportError
            Without matplotlib.
        """
        from sympflow.studies.figures import section_figure

        d, label = self.system.ndof, names(self.system.ndof)
        position = next((j for j in range(d) if j != self.coordinate), d)
        i = position if x is None else _check_coordinate(x, d)
        j = (position + d if position < d else 0) if y is None else _check_coordinate(y, d)
        points = self.states[:, [i, j]]
        if turn is not None:
            checked_number("turn", turn, "positive and finite, such as 2*pi", lambda x: 0 < x < math.inf)
            points[:, 0] -= turn * np.rint(points[:, 0] / turn)
        heading = f"{self.system.title}, {name_of(self.integrator)}: {self._seen}"
        return section_figure(points, self.trajectory, len(self.y0), (label[i], label[j]), heading)

    @property
    def _seen(self) -> str:
        """The plane, or the times, in words."""
        if self.coordinate is None or self.direction is None:
            return f"after each period T = {self.period:g}"
        name = names(self.system.ndof)[self.coordinate]
        way = {1: f", {name} increasing", -1: f", {name} decreasing", 0: ""}
        in_time = self.direction if self.t_span[1] >= self.t_span[0] else -self.direction
        return f"{name} = {self.level:g}{way[in_time]}"

    def plot(
        self,
        x: int | str | None = None,
        y: int | str | None = None,
        path: str | os.PathLike[str] | None = None,
        turn: float | None = None,
    ) -> Figure:
        """The figure, as `figure`; with a path it is also saved."""
        return saved(self.figure(x, y, turn), path)


def names(ndof: int) -> list[str]:
    """q, p for one degree of freedom; q1 … qd, p1 … pd for more."""
    return [f"{x}{i + 1}" if ndof > 1 else x for x in "qp" for i in range(ndof)]


def _check_coordinate(coordinate: int | str, ndof: int) -> int:
    known = names(ndof)
    if isinstance(coordinate, str) and coordinate in known:
        return known.index(coordinate)
    if isinstance(coordinate, int | np.integer) and not isinstance(coordinate, bool) and 0 <= coordinate < 2 * ndof:
        return int(coordinate)
    raise ValueError(f"`coordinate` must be one of {', '.join(known)}, or an index into them; got {coordinate!r}.")
