"""The points at which the losses are evaluated: a function of the seed and the step alone, so that a run resumes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sympflow.hamiltonian.domain import Domain

BLOCK = 32  # steps drawn at once: a rejection-sampled domain then costs little


class Stream(IntEnum):
    """Independent random streams of one seed."""

    RESIDUAL = 0
    MATCHING = 1
    VALIDATION = 2
    REFERENCE = 3
    SCALING = 4
    RESTARTS = 5
    LABELS = 6


@dataclass(frozen=True)
class Points:
    """Collocation points.

    Attributes
    ----------
    t, x : (N,), (N, 2d)
        Of the residual loss L1.
    matching_t, matching_x : (m, 1), (m, n, 2d)
        Of the matching loss L2: few times with many states each.
    labels : (n,), (n, 2d), (n, 2d), or None
        Times, states and where the exact flow takes them, of the loss L3.
    """

    t: Tensor
    x: Tensor
    matching_t: Tensor
    matching_x: Tensor
    labels: tuple[Tensor, Tensor, Tensor] | None = None


def stream_seed(seed: int, stream: Stream, block: int = 0) -> int:
    """An integer seed of its own for each stream and block."""
    return int(np.random.SeedSequence([seed, int(stream), block]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def states(domain: Domain, n: int, seed: int, stream: Stream, block: int = 0) -> np.ndarray:
    """n states (n, 2d) of the domain."""
    return domain.sample(n, stream_seed(seed, stream, block))


class PointSource:
    """Draws the points of a step: uniform in Ω, and in [0, Δt] one time from each of equal cells."""

    def __init__(
        self,
        domain: Domain,
        dt: float,
        points: int,
        matching_times: int,
        seed: int,
        dtype: torch.dtype,
        device: torch.device,
        streams: tuple[Stream, Stream] = (Stream.RESIDUAL, Stream.MATCHING),
        block: int = BLOCK,
        labels: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self.domain, self.dt, self.seed, self.streams = domain, dt, seed, streams
        self.points, self.times = points, matching_times
        self.block_length = block
        self._like = {"dtype": dtype, "device": device}
        self._labels = None if labels is None else tuple(torch.as_tensor(a, **self._like) for a in labels)  # type: ignore[arg-type]
        self._block = -1
        self._arrays: tuple[Tensor, ...] = ()

    def __call__(self, index: int) -> Points:
        """The points of the `index`-th draw."""
        block, i = divmod(index, self.block_length)
        if block != self._block:
            self._draw(block)
        t, x, matching_t, matching_x = self._arrays
        return Points(t[i], x[i], matching_t[i], matching_x[i], self._labelled(index))

    def _labelled(self, index: int) -> Any:
        """All labels, or as many as there are points, drawn anew for each index."""
        if self._labels is None or len(self._labels[0]) <= self.points:
            return self._labels
        rng = np.random.default_rng([stream_seed(self.seed, Stream.LABELS), index])
        rows = torch.as_tensor(rng.permutation(len(self._labels[0]))[: self.points], device=self._labels[0].device)
        return tuple(a[rows] for a in self._labels)

    def _draw(self, block: int) -> None:
        m, k = self.times, self.block_length
        n = self.points // m
        x = states(self.domain, k * self.points, self.seed, self.streams[0], block).reshape(k, self.points, -1)
        xm = states(self.domain, k * m * n, self.seed, self.streams[1], block).reshape(k, m, n, -1)
        # A stream of its own for the times: the domain's generator started from the same integer.
        rng = np.random.default_rng([stream_seed(self.seed, self.streams[0], block), 1])
        t = self.dt * (np.arange(self.points) + rng.random((k, self.points))) / self.points
        tm = self.dt * (np.arange(m) + rng.random((k, m))) / m
        self._arrays = tuple(torch.as_tensor(a, **self._like) for a in (t, x, tm[..., None], xm))  # type: ignore[arg-type]
        self._block = block
