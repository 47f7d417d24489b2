"""Trajectories as they are measured: each with its own times, some values missing, from arrays, tables and Datasets."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import MAX_ASKED_VALUES, checked_count, floats, plain, warn
from sympflow.flow.scaling import Scaling
from sympflow.learning import reading
from sympflow.learning.reading import OBSERVED, Run
from sympflow.learning.smoothing import Smooth, smoothed
from sympflow.show.cards import Answering, Card
from sympflow.show.pictures import MOST_LINES, trajectory_figure
from sympflow.show.style import saved
from sympflow.storage.layout import imported

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEW = 8
"""Trajectories from which some are held out for good; of fewer each is left out in turn, or in one of three parts."""
HELD_LEAST = PARTS = 3
JUMP, STEP = 0.75, 0.3
"""Shares of a period: steps of an angle that was wrapped are longer than the first, or shorter than the second."""
FAR, LARGEST = 1e3, 1e60
"""Mean of a coordinate in its spread, from which powers of it lose digits; and the largest value that has powers."""
POINTS, LONG = 24, 10
"""Points of a piece by which models are compared, and such pieces in a part of a trajectory that is smoothed."""
COMPARED = 2000  # Points in all such pieces
ANGLES = {"2*np.pi": 2 * np.pi, "360": 360.0}  # periods of angles that are looked for


@dataclass(frozen=True, repr=False)
class Trajectories(Answering):
    """Trajectories of one system, from which it is learned; made by `Trajectories.read`.

    Attributes
    ----------
    runs : tuple of Run
    names : tuple of str, length 2d
        The names of q1 … qd, p1 … pd in the data.
    velocities : bool
        True if the second half are velocities q', with an unknown mass.
    """

    runs: tuple[Run, ...]
    names: tuple[str, ...]
    velocities: bool = False

    def __post_init__(self) -> None:
        if not all(isinstance(run, Run) for run in self.runs):
            raise TypeError("`runs` are made from data by Trajectories.read, as in Trajectories.read((t, y)).")

    @classmethod
    def read(
        cls,
        data: Any,
        ndof: int | None = None,
        *,
        order: str | Sequence[int] = "halves",
        time: str | None = None,
        run: str | None = None,
        q: str | Sequence[str] | None = None,
        p: str | Sequence[str] | None = None,
        units: Mapping[str, str | float] | None = None,
        velocity_mass: ArrayLike | None = None,
        observed: str = "qp",
        period: ArrayLike | None = None,
    ) -> Trajectories:
        """Read trajectories.

        Parameters
        ----------
        data : Trajectories, sequence, DataFrame, Dataset, Solution or path
            - A list of (t, y), t (n,) and y (2d, n), each with its own times and length.
            - A pair of arrays: t (n,) or (N, n) and y (N, 2d, n), or (2d, n).
            - Three arrays, x (N, 2d), t (N,) or a number, y (N, 2d): the states y a time t after x.
            - A dictionary of arrays, or an .npz file of one: t with y as above, or with q and p, each (d, n) or
              (N, d, n); or columns (n,) as of a table.
            - An object with `t` and `y`: a solution, an ensemble, the result of `scipy.integrate.solve_ivp`; a list
              of these.
            - A table of pandas with a row for each time, or a CSV or Parquet file of one: columns for the trajectory,
              the time and the coordinates.
            - A Dataset of xarray as `to_xarray` makes it, or a NetCDF file or zarr store of one.
            - A list of dictionaries or tables, one or more trajectories each; or of dictionaries of a row each.

            NaN marks a value that is missing. Points without any value are left out. A trajectory whose times all
            descend is turned around.
        ndof : int, optional
            Degrees of freedom d; by default found from the data. If given, the columns of a table may have any names,
            in the given `order`.
        order : {"halves", "pairs"} or sequence of int
            The order of the rows of y, or of columns whose names are not those of coordinates: q1 … qd, p1 … pd; q1,
            p1, q2, p2, …; or the places of q1 … qd, p1 … pd.
        time, run : str, optional
            Columns of the time and of the trajectory; else those of common names ("t", "time"; "orbit", "run", …).
        q, p : str or sequence of str, optional
            Columns of the coordinates and momenta; else q1 … qd, p1 … pd, or q and p.
        units : mapping of str to str or float, optional
            The units of columns by their names, of all "q" or "p", and of the time, "t": {"t": "ms", "q": "deg",
            "p": "deg/ms"}, or factors. The data are converted to those of the SI, and to radians.
        velocity_mass : float or array_like of shape (d,) or (d, d), optional
            M, if the data have velocities in place of momenta: then p = M v.
        observed : {"qp", "qv", "q"}
            The rows of states: positions and momenta; positions and velocities, with an unknown mass that may depend on
            q; or positions only, y (d, n), in columns q1 … qd.
        period : float or array_like of shape (d,), optional
            Period of each q that is an angle, in the converted units; infinite or NaN for the others. A wrapped angle,
            which jumps by more than half a period from one point to the next, is made continuous.

        Raises
        ------
        ValueError
            If times repeat or go back, widths differ or are odd, a trajectory or a coordinate has no values, or
            columns are not recognized.
        TypeError
            If `data` is of another kind.
        ImportError
            If a file needs pandas or xarray and it is not installed.

        Examples
        --------
        >>> t = np.linspace(0, 1, 5)
        >>> Trajectories.read((t, np.stack([np.cos(t), -np.sin(t)]))).ndof
        1
        """
        if ndof is not None:
            checked_count("ndof", ndof, 1, MAX_ASKED_VALUES, "a positive integer, the degrees of freedom, or left out")
        if observed not in OBSERVED:
            raise ValueError(f"`observed` must be one of {', '.join(OBSERVED)}; got {observed!r}.")
        if observed != "qp" and velocity_mass is not None:
            raise ValueError("`velocity_mass` makes momenta of velocities: leave out `observed`, or the mass.")
        given: dict[str, Any] = {"order": order, "time": time, "run": run, "q": q, "p": p, "observed": observed}
        converted: dict[str, Any] = {"units": units, "velocity_mass": velocity_mass, "period": period}
        if isinstance(data, Trajectories):
            found, names = [(f"trajectory {i}", run.t, run.y) for i, run in enumerate(data.runs)], data.names
            observed = "qv" if data.velocities else observed
        elif isinstance(data, Mapping) and not _is_a("xarray", "Dataset", data):
            return cls.read(reading.of_mapping(data, ndof, time, q, p, observed), ndof, **given, **converted)
        elif _is_a("pandas", "DataFrame", data):
            found, names = reading.of_table(data, ndof, order, time, run, q, p, velocity_mass is not None, observed)
            order = "halves"
        elif _is_a("xarray", "Dataset", data):
            found = reading.of_dataset(data)
            names = ()
            order = "halves"
        elif isinstance(data, str | Path):
            return cls.read(reading.opened(Path(data)), ndof, **given, **converted)
        elif (
            isinstance(data, list | tuple)
            and data
            and all(isinstance(one, Mapping) or _is_a("pandas", "DataFrame", one) for one in data)
        ):
            if not any(np.ndim(value) for one in data for value in dict(one).values()):  # a row each
                return cls.read(imported("pandas", "Reading rows").DataFrame(data), ndof, **given, **converted)
            parts = [cls.read(one, ndof, **given, **converted) for one in data]
            if len({part.names for part in parts}) > 1:
                said = "; ".join(sorted({", ".join(part.names) for part in parts}))
                raise ValueError(f"`data` has parts with different coordinates, {said}: give all the same names.")
            return replace(parts[0], runs=tuple(run for part in parts for run in part.runs))
        else:
            found, names = list(reading.of_arrays(data)), ()
        if not found:
            raise ValueError("`data` has no trajectories: give at least one, (t, y).")
        if observed == "q":
            found = [(label, t, np.concatenate([y, np.full_like(y, np.nan)])) for label, t, y in found]
        width = reading.width_of(found, ndof)
        rows = reading.rows_of(order, width)
        plainly = tuple(f"{letter}{i + 1}" for letter in f"q{OBSERVED[observed]}" for i in range(width // 2))
        names = (*names, *plainly[len(names) :])  # of velocities that are missing
        names = plainly if names == plainly else tuple(names[i] for i in rows)
        factors, of_time = reading.factors_of(units, names)
        runs = []
        for label, times, states in found:
            t, y = reading.checked(label, times, states)
            y = y[rows] * factors[:, None]
            if velocity_mass is not None:
                y = np.concatenate([y[: width // 2], reading.momenta_of(velocity_mass, y[width // 2 :])])
            runs.append(Run(np.ascontiguousarray(t) * of_time, np.ascontiguousarray(y)))
        for i, name in enumerate(names if observed == "qp" else names[: width // 2]):
            if all(np.isnan(one.y[i]).all() for one in runs):
                raise ValueError(
                    f"`data` has no value of {name} in any trajectory: drop the degree of freedom, or add it."
                )
        read = cls(tuple(runs), names, observed != "qp")
        return read if period is None else read.unwrapped(periods_of(period, width // 2))

    @property
    def ndof(self) -> int:
        return len(self.names) // 2

    @property
    def n_points(self) -> int:
        return sum(run.n_points for run in self.runs)

    @property
    def n_values(self) -> int:
        """The number of values that are not missing."""
        return int(sum(np.isfinite(run.y).sum() for run in self.runs))

    @property
    def begins(self) -> np.ndarray:
        """The indices (N,) of the first points of the trajectories among all points."""
        return np.concatenate([[0], np.cumsum([run.n_points for run in self.runs])[:-1]])

    @cached_property
    def states(self) -> np.ndarray:
        """The states of all points without missing values: (n, 2d)."""
        points = np.concatenate([run.y.T for run in self.runs])
        return points[np.isfinite(points).all(1)]

    @cached_property
    def scales(self) -> np.ndarray:
        """The spread of each coordinate, (2d,): its standard deviation, 1 where it does not change.

        For missing velocities it is the spread of difference quotients.
        """
        values = np.concatenate([run.y for run in self.runs], axis=1)
        missing = np.isnan(values).all(axis=1)
        spread = np.nanstd(np.where(missing[:, None], 0.0, values), axis=1)
        if missing.any():
            rates = np.concatenate([np.diff(run.y) / np.diff(run.t) for run in self.runs], axis=1)
            spread[missing] = np.nanstd(np.roll(rates, self.ndof, axis=0)[missing], axis=1)
        return np.where(spread > 0, spread, 1.0)

    @cached_property
    def smooth(self) -> Smooth:
        """Smooth curves through the trajectories, with their slopes, and the noise."""
        return smoothed(self.runs, self.velocities)

    @cached_property
    def sample(self) -> Trajectories:
        """Some short pieces of smooth curves, evenly chosen, on which models are compared."""
        pieces = self.pieces(LONG * POINTS)
        n = max(1, min(len(pieces.runs), COMPARED * len(pieces.runs) // max(pieces.n_points, 1)))
        some = pieces.subset(np.unique(np.linspace(0, len(pieces.runs) - 1, n).astype(int)).tolist())
        runs = tuple(Run(run.t, y) for run, y in zip(some.runs, some.smooth.states, strict=True) if run.n_points > 1)
        return replace(some, runs=runs).pieces(POINTS)

    @cached_property
    def time_scale(self) -> float:
        """The median time from one point to the next."""
        return float(np.median(np.concatenate([np.diff(run.t) for run in self.runs])))

    @property
    def scaling(self) -> Scaling:
        """Units in which states and steps are of size one, and dq∧dp is multiplied by a constant.

        All products of the units of q_i and p_i agree, so that the equations stay Hamiltonian.
        """
        d = self.ndof
        q, p = self.scales[:d], self.scales[d:]
        action, ratio = np.exp(np.mean(np.log(q * p))), np.sqrt(q / p)
        return Scaling(tuple(np.sqrt(action) * ratio), tuple(np.sqrt(action) / ratio), self.time_scale)

    def scaled(self, scaling: Scaling) -> Trajectories:
        """The trajectories in other units, without a shift of the origin."""
        units = np.array(scaling.x)[:, None]
        return replace(self, runs=tuple(Run(run.t / scaling.t, run.y / units) for run in self.runs))

    def unwrapped(self, periods: np.ndarray) -> Trajectories:
        """Trajectories with angles of these periods (d,) made continuous where they jump by more than half a period."""
        return replace(self, runs=tuple(Run(run.t, _unwrapped(run.y, periods)) for run in self.runs))

    def check_angles(self, none: np.ndarray | None = None) -> None:
        """Raise ValueError if a coordinate jumps like a wrapped angle, unless it is marked (d,) as not an angle."""
        for i, name in enumerate(self.names[: self.ndof]):
            if none is not None and none[i]:
                continue
            rows = [run.y[i][np.isfinite(run.y[i])] for run in self.runs]
            steps, spread = np.concatenate([np.diff(row) for row in rows]), float(np.ptp(np.concatenate(rows)))
            for text, P in ANGLES.items():
                size = np.abs(steps) / P
                jumps = size > JUMP
                if spread <= P * (1 + 1e-9) and jumps.any() and not (~jumps & (size > STEP)).any():
                    at = next(k for k, row in enumerate(rows) if (np.abs(np.diff(row)) > JUMP * P).any())
                    raise ValueError(
                        f"`trajectories` have {int(jumps.sum())} jumps of {name} by about {text}, the first in "
                        f"trajectory {at}, as of an angle that was wrapped: pass period={text}, by which it is "
                        f"continued; or period=np.inf if {name} is not an angle."
                    )

    def check_moving(self) -> None:
        """Raise ValueError if a coordinate is constant or its powers overflow; warn of one that is far from 0."""
        for i, name in enumerate(self.names):
            values = np.concatenate([run.y[i] for run in self.runs])
            seen = values[np.isfinite(values)]
            if seen.size and seen.min() == seen.max():
                raise ValueError(
                    f"`trajectories` have the same {name} at all points, {seen[0]:g}: nothing can be learned "
                    "of it; drop this degree of freedom, or add trajectories in which it changes."
                )
            if seen.size and not 1 / LARGEST < np.abs(seen).max() < LARGEST:
                raise ValueError(
                    f"`trajectories` have {name} up to {np.abs(seen).max():.1g}, whose powers overflow or vanish: "
                    "give `units`, or numbers nearer to 1."
                )
            if seen.size and abs(seen.mean()) > FAR * seen.std() > 0:
                warn(
                    f"`trajectories` have {name} about {seen.mean():.3g}, {abs(seen.mean()) / seen.std():.1g} times "
                    "its spread, by which powers of it lose their digits: subtract that from it."
                )

    def split(self, share: float = 0.2, seed: int = 0) -> tuple[Trajectories, Trajectories]:
        """Two disjoint sets of whole trajectories, the second with that share of them, drawn at random.

        Points of one trajectory are never divided: a model that knows the ends of an orbit would be tested on its
        middle.

        Raises
        ------
        ValueError
            If there is one trajectory only, or `share` is not between 0 and 1.
        """
        if not 0 < share < 1:
            raise ValueError(f"`share` must lie between 0 and 1; got {share!r}: 0.2 keeps a fifth for the test.")
        if len(self.runs) < 2:
            raise ValueError(
                "`data` has one trajectory only, of which none can be held out: add others, or cut it by `.pieces`, "
                "which shows less, because its pieces lie on one orbit."
            )
        count = min(max(round(share * len(self.runs)), 1), len(self.runs) - 1)
        drawn = set(np.random.default_rng(seed).permutation(len(self.runs))[:count].tolist())
        return self.subset(i for i in range(len(self.runs)) if i not in drawn), self.subset(sorted(drawn))

    def folds(self, share: float = 0.2, seed: int = 0) -> list[tuple[Trajectories, Trajectories]]:
        """Divisions as by `split`: one, with at least three held-out trajectories; or of few trajectories those of a
        threefold or leave-one-out cross-validation.

        Raises
        ------
        ValueError
            If there is one trajectory only.
        """
        n = len(self.runs)
        if n >= FEW:
            return [self.split(max(share, HELD_LEAST / n), seed)]
        self.split(share, seed)  # of one trajectory that is refused
        parts = [range(i, n, PARTS) for i in range(min(n, PARTS))]
        return [(self.subset(j for j in range(n) if j not in part), self.subset(part)) for part in parts]

    def subset(self, index: Any) -> Trajectories:
        """The trajectories with these indices, which may repeat, as in a bootstrap."""
        return replace(self, runs=tuple(self.runs[i] for i in index))

    def pieces(self, points: int | None = None, span: float = np.inf) -> Trajectories:
        """The trajectories cut into disjoint pieces, each of which is a trajectory.

        Parameters
        ----------
        points : int, optional
            The most points of a piece, at least 2. A last piece of one point is joined to the piece before.
        span : float
            The longest time of a piece, which has at least two points. For chaotic orbits choose one or two Lyapunov
            times.
        """
        most = sys.maxsize if points is None else plain(points)
        if isinstance(most, bool) or not isinstance(most, int) or most < 2:
            raise ValueError(f"`points` must be an integer, 2 or more; got {points!r}.")
        if not span > 0:
            raise ValueError(f"`span` must be positive; got {span!r}.")
        return replace(self, runs=tuple(piece for run in self.runs for piece in _cut(run, most, span)))

    def card(self) -> Card:
        spans = [run.span for run in self.runs]
        facts = {
            "points": f"{self.n_points:,}",
            "coordinates": ", ".join(self.names),
            "durations": f"{min(spans):.3g} … {max(spans):.3g}",
            "second half": "velocities" if self.velocities else "momenta",
        }
        return Card(f"{len(self.runs):,} trajectories", facts)

    def preview(self) -> Figure | None:
        return self.plot()

    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the samples of 16 trajectories at most: q₁ against q₂, or q over t, and q₁ against the second half.

        With a `path` (.png, .pdf or .svg) the figure is saved too; matplotlib is needed.
        """
        runs, d = self.runs[:MOST_LINES], self.ndof
        most = max(run.n_points for run in runs)
        t, y = np.full((len(runs), most), np.nan), np.full((len(runs), 2 * d, most), np.nan)
        for k, run in enumerate(runs):
            t[k, : run.n_points], y[k, :, : run.n_points] = run.t, run.y
        return saved(trajectory_figure(t, y, None, f"{len(self.runs):,} trajectories", marker="."), path)


def periods_of(period: Any, ndof: int) -> np.ndarray:
    """The period of each q (d,), infinite where there is none; a ValueError if it is not positive."""
    given = floats("period", period)
    if given.shape not in ((), (ndof,)) or (given <= 0).any():
        raise ValueError(f"`period` must be positive, one for all q or one for each of {ndof}; got {period!r}.")
    return np.broadcast_to(np.where(np.isnan(given), np.inf, given), ndof)


def _unwrapped(y: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """States (2d, n) whose angles make no step of more than half their period."""
    y = y.copy()
    for row, P in zip(y, periods, strict=False):
        seen = np.isfinite(row)
        if np.isfinite(P):
            row[seen] = np.unwrap(row[seen], period=P)
    return y


def _cut(run: Run, points: int, span: float) -> Iterator[Run]:
    start, n = 0, run.n_points
    while start < n:
        reached = int(np.searchsorted(run.t, run.t[start] + span * (1 + 1e-12), "right"))
        stop = min(max(reached, start + 2), start + points, n)
        if n - stop == 1:
            stop = n
        yield run.part(start, stop)
        start = stop


def _is_a(library: str, kind: str, data: Any) -> bool:
    """True of an object of a library, which then is imported already."""
    return library in sys.modules and isinstance(data, getattr(sys.modules[library], kind))
