"""Reductions to properties of orbits: chaos indicators, frequencies, escapes, crossings of a plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_counts
from sympflow.compiler import NotCompiled
from sympflow.ensembles.chunks import MOST_VALUES, Chunk
from sympflow.ensembles.reductions import Fields, Reduction
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.chaos import ALIGNED, ALIGNMENT, NONE, VOLUME, check_followed, checked_threshold, indicator
from sympflow.metrics.crossings import Plane, crossings
from sympflow.metrics.escapes import escapes, region_of
from sympflow.metrics.frequencies import Signal, lines, rotations, signals
from sympflow.metrics.orbits import Orbits

NUMBER: tuple[tuple[int, ...], np.dtype] = ((), np.dtype(float))


def _orbits(chunk: Chunk, rows: np.ndarray | slice = slice(None)) -> Orbits:
    return Orbits(chunk.system, chunk.integrator, chunk.t_span, chunk.y0[rows])


class _Indicator(Reduction):
    """A chaos indicator, and the time at which it was read."""

    name: ClassVar[str]
    fixed: ClassVar[dict[str, Any]]  # arguments of `indicator` that are not options
    own_loops: ClassVar[bool] = True

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `indicator`: `k` is the number of vectors."""
        return self.fixed | {"vectors" if name == "k" else name: value for name, value in vars(self).items()}

    def __post_init__(self) -> None:
        checked_threshold(self.arguments["below"])
        check_counts(k=self.arguments["vectors"])

    def fields(self, problem: Chunk) -> Fields:
        check_followed(_orbits(problem))
        return {self.name: NUMBER, f"{self.name}_time": NUMBER}

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        value, time = np.full(len(chunk), np.nan), np.full(len(chunk), np.nan)
        try:
            chunk.integrator.tangent_kernel(chunk.system, self.arguments["vectors"])
            together = chunk.backend != "array"
        except NotCompiled:
            together = False
        for rows in chunk.blocks(together):
            found = indicator(_orbits(chunk, rows), backend=chunk.backend, **self.arguments)
            value[rows], time[rows] = found.value, found.t_end
            for i in set(rows[np.asarray(found.status) < 0].tolist()):
                text = f"The orbit or its deviation vectors ceased to be finite after t = {time[i]:.15g}. Reduce `dt`, "
                chunk.fail(i, f"{text}or end `t_span` earlier.")
        return {self.name: value, f"{self.name}_time": time}


@dataclass(frozen=True)
class Lyapunov(_Indicator):
    """The largest Lyapunov exponent over `t_span`: `lyapunov`, and `lyapunov_time`; see `sympflow.lyapunov`."""

    seed: int = 0
    name: ClassVar[str] = "lyapunov"
    fixed: ClassVar[dict[str, Any]] = {"vectors": 1, "kind": NONE, "below": 0.0}


@dataclass(frozen=True)
class Sali(_Indicator):
    """The smaller alignment index: `sali`, and `sali_time`, at which an orbit ended; see `sympflow.sali`."""

    below: float = ALIGNED
    seed: int = 0
    name: ClassVar[str] = "sali"
    fixed: ClassVar[dict[str, Any]] = {"vectors": 2, "kind": ALIGNMENT}


@dataclass(frozen=True)
class Gali(_Indicator):
    """The generalised alignment index of order k: `gali`, and `gali_time`; see `sympflow.gali`."""

    k: int = 2
    below: float = ALIGNED
    seed: int = 0
    name: ClassVar[str] = "gali"
    fixed: ClassVar[dict[str, Any]] = {"kind": VOLUME}

    def fields(self, problem: Chunk) -> Fields:
        if not 2 <= self.k <= 2 * problem.system.ndof:
            raise ValueError(f"`k` must be from 2 to {2 * problem.system.ndof}, the dimension; got {self.k}.")
        return super().fields(problem)


@dataclass(frozen=True)
class Lines(Reduction):
    """The n strongest lines of signals at `t_eval`: `frequencies` and `amplitudes` (c, n); see `sympflow.frequencies`.

    `t_eval` must be equidistant; the default is every step.
    """

    n: int = 1
    signal: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        check_counts(n=self.n)
        if not (self.signal is None or callable(self.signal)):
            raise TypeError(f"`signal` must be a function of states; got {type(self.signal).__name__}.")

    def _taken(self, system: HamiltonianSystem) -> Signal:
        return rotations(system) if self.signal is None else self.signal

    def fields(self, problem: Chunk) -> Fields:
        times = problem.times
        gaps = np.diff(times)
        if len(times) < 16 or np.ptp(gaps) > 1e-6 * np.abs(gaps).max():
            raise ValueError("`t_eval` must be 16 equidistant times or more, for frequencies: use numpy.linspace.")
        shape = (signals(self._taken(problem.system), problem.y0[:1, :, None], 1).shape[1], self.n)
        return {"frequencies": (shape, np.dtype(float)), "amplitudes": (shape, np.dtype(complex))}

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        times, parts, taken = chunk.times, [], self._taken(chunk.system)
        most = max(1, MOST_VALUES // (len(times) * (chunk.y0.shape[1] + 4 * self.n)))
        for start in range(0, len(chunk), most):
            part = chunk.rows(start, start + most)
            parts.append(lines(signals(taken, part.states(times), len(times)), times, self.n))
            chunk.take(part)
        omega, amplitude = (np.concatenate(found) for found in zip(*parts, strict=True))
        return {"frequencies": omega, "amplitudes": amplitude}


@dataclass(frozen=True)
class Escape(Reduction):
    """The time and the state at which an orbit leaves a region: `escape_time`, inf if it stays, and `escape_state`.

    `outside` as for `sympflow.escape_times`.
    """

    outside: Any = None
    own_loops: ClassVar[bool] = True

    def fields(self, problem: Chunk) -> Fields:
        begin = _orbits(problem)._replace(t_span=(problem.t_span[0],) * 2)
        escapes(begin, region_of(self.outside, problem.system), "auto")
        return {"escape_time": NUMBER, "escape_state": ((problem.y0.shape[1],), np.dtype(float))}

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        region = region_of(self.outside, chunk.system)
        time, state = np.empty(len(chunk)), np.empty(chunk.y0.shape)
        for rows in chunk.blocks(together=False):
            time[rows], state[rows], status = escapes(_orbits(chunk, rows), region, chunk.backend)
            for i in set(rows[status < 0].tolist()):
                chunk.fail(i, "The orbit ceased to be finite before it was seen outside. Reduce `dt`.")
        return {"escape_time": time, "escape_state": state}


@dataclass(frozen=True)
class PlaneCrossings(Reduction):
    """The first crossings of the plane y[coordinate] = level; see `sympflow.poincare_section`.

    They are `n_crossings`, `crossing_times` (most,) and `crossing_states` (most, 2d), NaN where there are
    fewer, and of an orbit that failed.
    """

    coordinate: int = 0
    level: float = 0.0
    direction: int = 1
    most: int = 100
    own_loops: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_counts(most=self.most)
        if self.direction not in (-1, 0, 1):
            raise ValueError(f"`direction` must be 1, -1 or 0, for both; got {self.direction!r}.")

    def fields(self, problem: Chunk) -> Fields:
        width = problem.y0.shape[1]
        if not 0 <= self.coordinate < width:
            raise ValueError(f"`coordinate` must be an index into [q, p], below {width}; got {self.coordinate!r}.")
        return {
            "n_crossings": NUMBER,
            "crossing_times": ((self.most,), np.dtype(float)),
            "crossing_states": ((self.most, width), np.dtype(float)),
        }

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        n, width = chunk.y0.shape
        count, times = np.zeros(n), np.full((n, self.most), np.nan)
        states = np.full((n, self.most, width), np.nan)
        plane = Plane(self.coordinate, float(self.level), self.direction)
        for rows in chunk.blocks(together=False):
            found = crossings(chunk.integrator, chunk.system, chunk.t_span, chunk.y0[rows], plane, chunk.system.dt)
            ends = np.searchsorted(found.trajectory, np.arange(len(rows) + 1))
            for j, i in enumerate(rows.tolist()):
                if found.status[j] < 0:
                    count[i] = np.nan
                    chunk.fail(i, "The orbit ceased to be finite. Reduce `dt`, or end `t_span` earlier.")
                    continue
                own = slice(ends[j], min(ends[j + 1], ends[j] + self.most))
                k = own.stop - own.start
                count[i], times[i, :k], states[i, :k] = ends[j + 1] - ends[j], found.t[own], found.states[own]
        return {"n_crossings": count, "crossing_times": times, "crossing_states": states}
