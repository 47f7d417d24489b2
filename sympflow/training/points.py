"""The points of a fit: a function of the seed and the step alone, so that a run resumes; and labels at them.

Labels say where the exact flow takes sampled states, at several times. They are made on the spot, or handed in.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sympflow.arguments import warn
from sympflow.arrays import to_numpy
from sympflow.flow.sympflow import Drive
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.exact_flow import reference_step
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.session import Deadline, OutOfTime

BLOCK = 32  # steps drawn at once: a rejection-sampled domain then costs little
LABEL_TOLERANCE = 1e-13
HELD_OUT_SHARE = 0.1  # of the labels that are handed in
LABELS_APART = 8  # intervals without labels that are as long as a fraction of Δt are remembered
LABELS_COMPARED, COMPARED_TO = 8, 1e-8  # of the labels that are handed in, and the tolerance of their exact flow
USELESS = 0.1  # of what a step moves a state: leapfrog at ω Δt = 1 misses a hundredth, the identity all of it

Labelled = tuple[np.ndarray, ...]
"""Times (n,), states (n, 2d), where the flow takes them (n, 2d), and of a driven system the times t0 (n,)."""


class Stream(IntEnum):
    """Independent random streams of one seed."""

    RESIDUAL = 0
    MATCHING = 1
    VALIDATION = 2
    REFERENCE = 3
    SCALING = 4
    RESTARTS = 5
    LABELS = 6
    TIMES = 7
    RUNS = 8


class Points(NamedTuple):
    """Points of the losses: times, states, of labels where the flow takes these, and of a driven system times t0.

    Those of the residual are t (N,) and x (N, 2d); of the matching few times (m, 1), with many states each (m, n, 2d).
    """

    residual: tuple[Tensor, ...]
    matching: tuple[Tensor, ...]
    labels: tuple[Tensor, ...] | None = None


def stream_seed(seed: int, stream: Stream, block: int = 0) -> int:
    """An integer seed of its own for each stream and block."""
    return int(np.random.SeedSequence([seed, int(stream), block]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def states(domain: Domain, n: int, seed: int, stream: Stream, block: int = 0) -> np.ndarray:
    """n states (n, 2d) of the domain."""
    return domain.sample(n, stream_seed(seed, stream, block))


def start_times(
    system: HamiltonianSystem, dt: float, n: int, seed: int, stream: Stream, block: int = 0
) -> np.ndarray | None:
    """Random times (n,) at which steps of a driven system begin, in its period or its `t_span`; None for another."""
    if Drive.of(system) is None:
        return None
    low, high = 0.0, system.period
    if high is None:
        low, high = min(system.t_span), max(system.t_span)
        system.check_times(low, high)
        if high - low <= dt:
            raise ValueError(
                f"`system` {system.name!r} is driven, without a `period` and for t from {low:g} to {high:g}, and there "
                f"no step of dt = {dt:g} begins and ends: give it the period of the drive, or a longer `t_span`."
            )
        high -= dt
    rng = np.random.default_rng([stream_seed(seed, stream, block), int(Stream.TIMES)])
    return low + (high - low) * rng.random(n)


@dataclass
class PointSource:
    """Draws the points of a step, uniform in Ω and one time from each of equal cells; driven, at random times t0."""

    domain: Domain
    dt: float
    points: int
    times: int
    seed: int
    dtype: torch.dtype
    device: torch.device
    streams: tuple[Stream, Stream] = (Stream.RESIDUAL, Stream.MATCHING)
    block: int = BLOCK
    labels: tuple[Any, ...] | None = None
    system: HamiltonianSystem | None = None

    def __post_init__(self) -> None:
        self._drawn: tuple[int, list[tuple[Tensor, ...]]] = -1, []
        if self.labels is not None:
            self.labels = self._tensors(self.labels)

    def _tensors(self, arrays: Iterable[Any]) -> tuple[Tensor, ...]:
        return tuple(torch.as_tensor(a, dtype=self.dtype, device=self.device) for a in arrays)

    def __call__(self, index: int) -> Points:
        """The points of the `index`-th draw."""
        block, i = divmod(index, self.block)
        if block != self._drawn[0]:
            self._drawn = block, self._draw(block)
        residual, matching = (tuple(a[i] for a in arrays) for arrays in self._drawn[1])
        return Points(residual, matching, self._labelled(index))

    def _labelled(self, index: int) -> Any:
        """All labels, or as many as there are points, drawn anew for each index."""
        labels = self.labels
        if labels is None or len(labels[0]) <= self.points:
            return labels
        rng = np.random.default_rng([stream_seed(self.seed, Stream.LABELS), index])
        rows = torch.as_tensor(rng.permutation(len(labels[0]))[: self.points], device=self.device)
        return tuple(a[rows] for a in labels)

    def _draw(self, block: int) -> list[tuple[Tensor, ...]]:
        """The times, states and t0 of the residual and the matching, for each of the draws of a block."""
        m, k = self.times, self.block
        n = self.points // m
        x = states(self.domain, k * self.points, self.seed, self.streams[0], block).reshape(k, self.points, -1)
        xm = states(self.domain, k * m * n, self.seed, self.streams[1], block).reshape(k, m, n, -1)
        # A stream of its own for the times: the domain's generator started from the same integer.
        rng = np.random.default_rng([stream_seed(self.seed, self.streams[0], block), 1])
        t = self.dt * (np.arange(self.points) + rng.random((k, self.points))) / self.points
        tm = self.dt * (np.arange(m) + rng.random((k, m))) / m
        drawn = [[t, x], [tm[..., None], xm]]
        for stream, arrays in zip(self.streams, drawn if self.system is not None else (), strict=False):
            t0 = start_times(self.system, self.dt, arrays[0].size, self.seed, stream, block)  # type: ignore[arg-type]
            arrays.extend([] if t0 is None else [t0.reshape(arrays[0].shape)])
        return [self._tensors(arrays) for arrays in drawn]


# labels ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _WithWork:
    """The vector field of a driven system, with ∂H/∂t as one more component."""

    system: HamiltonianSystem

    def vector_field(self, y: np.ndarray, t: np.ndarray) -> np.ndarray:
        x = y[:, :-1]
        return np.concatenate([self.system.vector_field(x, t), self.system.time_derivative(x, t)[:, None]], axis=1)


@dataclass(frozen=True)
class Labels:
    """φ_H,t(x) (J, N, 2d) of N states x at J ascending times t; of a driven system the states are at times t0 (N,).

    `work` is ∫ ∂H/∂t dt (J, N) from t0, of a driven system without friction.
    """

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    t0: np.ndarray | None = None
    work: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        system: HamiltonianSystem,
        x: np.ndarray,
        t: np.ndarray,
        deadline: Deadline | None = None,
        t0: np.ndarray | None = None,
    ) -> Labels:
        """Make labels by DOP853 at rtol = 1e-13; states whose solution ends before the last time are left out."""
        width, field = x.shape[1], system
        if t0 is not None and system.conservative:
            x, field = np.concatenate([x, np.zeros((len(x), 1))], axis=1), _WithWork(system)  # type: ignore[assignment]
        y, reached = [x], 0.0
        for time in t:
            check = (lambda: None) if deadline is None else deadline.check
            try:
                begun = None if t0 is None else t0 + reached
                after = reference_step(field, y[-1], float(time - reached), LABEL_TOLERANCE, check, begun)
            except OutOfTime:
                raise OutOfTime(
                    f"the exact solution was followed from {len(y[-1])} states to t = {reached:.3g} of {t[-1]:.3g} only"
                    f"{_fast_part(system, y[0][:, :width], float(t[-1]), t0)}"
                ) from None
            exists = np.isfinite(after).all(-1)
            y, reached = [states[exists] for states in (*y, after)], time
            t0 = None if t0 is None else t0[exists]
        ends = np.stack(y[1:])
        work = None if field is system else ends[..., width]
        return cls(np.asarray(t), y[0][:, :width], ends[..., :width], t0, work)

    @classmethod
    def drawn(
        cls,
        system: HamiltonianSystem,
        domain: Domain,
        n: int,
        seed: int,
        stream: Stream,
        t: np.ndarray,
        deadline: Deadline,
        needed: bool = True,
    ) -> Labels:
        """Labels of n states of a domain, driven at random times, which a fit cannot do without if they are needed."""
        t0 = start_times(system, float(t[-1]), n, seed, stream)
        labels = cls.of(system, states(domain, n, seed, stream), t, deadline, t0)
        if needed and not len(labels.x):
            raise ValueError("`domain` holds no states whose solution exists up to `dt`: shrink one of them.")
        return labels

    def part(self, n: int | None = None, last: bool = False) -> Labels:
        """The labels of the first n states, or at the last time alone."""
        times = slice(-1 if last else None, None)
        t0, work = (None if a is None else a[..., :n] for a in (self.t0, self.work))
        return Labels(self.t[times], self.x[:n], self.y[times, :n], t0, None if work is None else work[times])

    @property
    def times(self) -> np.ndarray | None:
        """The times of the states y (J, N), of a driven system."""
        return None if self.t0 is None else self.t[:, None] + self.t0


@np.errstate(all="ignore")
def _fast_part(system: HamiltonianSystem, x: np.ndarray, t: float, t0: np.ndarray | None) -> str:
    """The states that would cross all others in the time t, in words that go on, with a box without them."""
    velocity = np.asarray(system.vector_field(x) if t0 is None else system.vector_field(x, t0))
    fast = ~(np.abs(velocity) * t <= np.ptp(x, axis=0)).all(1)
    box = box_without(x[~fast], x[fast])
    if box is None:
        return ""
    return (
        f"; at {fast.sum()} of them the motion is so fast that it would leave `domain` in that time, as near a "
        f"singularity or on the way to infinity, and none of these is in Box({box[0]}, {box[1]})"
    )


def box_without(good: np.ndarray, bad: np.ndarray) -> tuple[list[float], list[float]] | None:
    """The corners, rounded, of a box of states (n, 2d) with none of the bad ones and a tenth of the good; else None."""
    if not (len(good) and len(bad)):
        return None
    low, high = np.minimum(good.min(0), bad.min(0)), np.maximum(good.max(0), bad.max(0))
    n_good, n_bad = len(good), len(bad)
    while len(bad):
        best, cut = -np.inf, (0, 0.0, True)
        for k in range(bad.shape[1]):
            for value in bad[:, k]:
                for below in (True, False):
                    lost = [np.mean(x[:, k] <= value if below else x[:, k] >= value) for x in (bad, good)]
                    if (gain := lost[0] * len(bad) / n_bad - lost[1] * len(good) / n_good) > best:
                        best, cut = gain, (k, value, below)
        k, value, below = cut
        good, bad = ((x[x[:, k] > value] if below else x[x[:, k] < value]) for x in (good, bad))
        if len(good) < 0.1 * n_good or not len(good):
            return None
        (low if below else high)[k] = good[:, k].min() if below else good[:, k].max()
    digits = (2 - np.floor(np.log10(np.maximum(high - low, np.finfo(float).tiny)))).astype(int).tolist()
    lower = [round(math.ceil(v * 10.0**n) / 10.0**n, max(n, 0)) for v, n in zip(low, digits, strict=True)]
    upper = [round(math.floor(v * 10.0**n) / 10.0**n, max(n, 0)) for v, n in zip(high, digits, strict=True)]
    return lower, upper


@np.errstate(all="ignore")
def step_errors(difference: np.ndarray) -> dict[str, float]:
    """Figures of ψ̄_t(x) − φ_H,t(x), (J, N, 2d): mean, median and largest norm at Δt, the last time; mean before it."""
    error = np.linalg.norm(difference, axis=-1)
    return {
        "one_step_error": float(error[-1].mean()),
        "one_step_error_median": float(np.median(error[-1])),
        "one_step_error_max": float(error[-1].max()),
        "fractional_error": float(error[:-1].mean()),
    }


@np.errstate(all="ignore")
def shares_missed(difference: np.ndarray, labels: Labels, unit: np.ndarray) -> tuple[float, float]:
    """The error of a step of Δt relative to the displacement: mean over mean, median over median; 1 for x ↦ x."""
    error, moved = (np.linalg.norm(v / unit, axis=-1) for v in (difference, labels.y[-1] - labels.x))
    return _share(error.mean(), moved.mean()), _share(np.median(error), np.median(moved))


def _share(error: Any, of: Any) -> float:
    share = float(error / of) if error != 0 else 0.0
    return share if math.isfinite(share) else math.inf


def handed_in(data: Any, system: HamiltonianSystem, dt: float) -> Labelled:
    """The labels that were handed in, as float64 arrays."""
    system.check_autonomous("and `data` tell no time at which a step begins", "leave them out")
    if not isinstance(data, tuple | list) or len(data) != 3:
        raise TypeError(
            "`data` must be three arrays, times (n,), states (n, 2d) and where they go (n, 2d): pass a tuple."
        )
    t, x, y = (np.asarray(to_numpy(a), dtype=float) for a in data)
    width = 2 * system.ndof
    if t.ndim != 1 or x.shape != (len(t), width) or y.shape != x.shape or len(t) < 2:
        raise ValueError(
            f"`data` must have shapes (n,), (n, {width}) and (n, {width}), n ≥ 2; got {t.shape}, {x.shape} and "
            f"{y.shape}: give one row for each label."
        )
    if not (np.isfinite(t).all() and np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("`data` must be finite: remove the labels with NaN or infinity.")
    if t.min() < 0 or t.max() > dt * (1 + 1e-12):
        raise ValueError(
            f"`data` has times from {t.min():g} to {t.max():g}, beyond [0, dt] = [0, {dt:g}]: change `dt`."
        )
    return t, x, y


def unlabelled(t: np.ndarray, dt: float) -> tuple[tuple[float, float], ...]:
    """The intervals of [0, Δt], longer than Δt/8, in which no label is."""
    ends = np.unique(np.concatenate([[0.0], t, [dt]]))
    long = np.flatnonzero(np.diff(ends) > dt / LABELS_APART * (1 + 1e-9))
    return tuple((float(ends[i]), float(ends[i + 1])) for i in long)


def warn_of_another_system(data: Labelled, system: HamiltonianSystem) -> None:
    """Warn if the exact flow of the system takes a few of the labelled states elsewhere than the labels say."""
    t, x, y = data
    rows = np.linspace(0, len(t) - 1, min(len(t), LABELS_COMPARED)).astype(int)
    with np.errstate(all="ignore"):
        exact = np.concatenate([reference_step(system, x[[i]], float(t[i]), COMPARED_TO) for i in rows])
        unit = np.ptp(np.concatenate([x, y]), axis=0)
        unit = np.where(unit > 0, unit, 1.0)
        away = np.linalg.norm((exact - y[rows]) / unit, axis=-1)
        moved = np.linalg.norm((y[rows] - x[rows]) / unit, axis=-1)
    away = away[np.isfinite(away)]
    if len(away) and np.median(away) >= 0.1 * np.median(moved) and np.median(away) > COMPARED_TO:
        warn(
            f"`data` are not labels of the system {system.name!r}: they differ from its exact flow, "
            f"in the median {np.median(away) / max(np.median(moved), 1e-300):.1e} times as much as the states move. "
            "Figures "
            "such as one_step_error compare with H of the system, and do not describe your data: pass the system that "
            "they come from."
        )


def parted(data: Labelled, seed: int) -> tuple[Labelled, Labelled]:
    """Labels that were handed in: those to train on, and the held-out ones."""
    order = np.random.default_rng([stream_seed(seed, Stream.LABELS), 0]).permutation(len(data[0]))
    first = math.ceil(HELD_OUT_SHARE * len(order))
    t, x, y = data
    held, rest = order[:first], order[first:]
    return (t[rest], x[rest], y[rest]), (t[held], x[held], y[held])
