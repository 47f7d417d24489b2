"""Compiled loops without `solve` around them: the one place where benchmarks reach for the package's kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sympflow import HamiltonianSystem, get

Run = Callable[..., Any]


@dataclass(frozen=True)
class Loops:
    """Compiled loops: `one` runs a state y0 (2d,), `many` a batch (N, 2d) on one thread.

    Both take (h, y0, n, save): n steps of h, of which those numbered in `save` are kept. Both return a tuple that
    begins with the states, time before the last axis.
    """

    one: Run
    many: Run


def scheme_loops(system: HamiltonianSystem, name: str) -> Loops:
    """The loops of a splitting scheme of the package."""
    kernel = get(name)().composed(system).kernel(False)
    return Loops(kernel.run, partial(kernel.run, threads=1))


def flow_loops(system: HamiltonianSystem, flow: Any) -> Loops:
    """The loops of a trained flow, which keep its numbers from call to call."""
    kernel = flow.kernel_for(system)
    return Loops(kernel.run, partial(kernel.run, threads=1))


def method_loops(system: HamiltonianSystem, method: Any) -> Run:
    """The loops of any splitting method, a scheme × a splitting, of one state: (h, y0, n, save)."""
    return method.composed(system).kernel(False).run


def last(n: int) -> np.ndarray:
    """The numbers of the steps to keep: the last alone."""
    return np.array([n])
