"""Run times that can be compared: medians of repeats that are interleaved over the candidates."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RunTime:
    """Median and interquartile range of the repeats, in seconds."""

    median: float
    spread: float


def interleaved(calls: Sequence[Callable[[], object]], repeats: int) -> list[RunTime]:
    """Time every call `repeats` times, going round over all of them, so that a slow spell of the machine hits each.

    The calls should have run before: nothing is warmed up here.
    """
    seconds = np.empty((repeats, len(calls)))
    for r in range(repeats):
        for i, call in enumerate(calls):
            start = time.perf_counter()
            call()
            seconds[r, i] = time.perf_counter() - start
    low, median, high = np.quantile(seconds, [0.25, 0.5, 0.75], axis=0)
    return [RunTime(float(m), float(h - lo)) for lo, m, h in zip(low, median, high, strict=True)]
