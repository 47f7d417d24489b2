"""The numbers of a scheme as the loops of splitting methods execute them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from sympflow.schemes import Scheme

__all__ = ["Table", "scaled_run_table", "scaled_step_table", "step_table"]

_Stage = tuple[float, float, Any, float]  # kick b, gradient g, curvature c or polynomial e (M,), drift a
Table = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # kicks, drifts, gradients, curvatures of the stages


def _stages(scheme: Scheme) -> list[_Stage]:
    """The scheme as kick-drift pairs without idle maps, except a zero kick in front or a zero drift at the end."""
    stages: list[_Stage] = []
    none = np.zeros(len(scheme.monomials)) if scheme.polynomials else 0.0
    for kind, one, three, five, e in scheme.substeps:
        if kind == "kick":
            stages.append((one, three, np.array(e) if scheme.polynomials else five, 0.0))
        elif stages and stages[-1][-1] == 0.0:
            stages[-1] = (*stages[-1][:-1], one)
        else:
            stages.append((0.0, 0.0, none, one))
    return stages or [(0.0, 0.0, none, 0.0)]


def _arrays(stages: list[_Stage]) -> Table:
    kicks, gradients, curvatures, drifts = (np.array(column) for column in zip(*stages, strict=True))
    return kicks, drifts, gradients, curvatures


@lru_cache(maxsize=256)
def step_table(scheme: Scheme) -> Table:
    """The stages of one step by itself, for h = 1: (m, 1) each, polynomials (m, M, 1)."""
    kicks, drifts, gradients, curvatures = _arrays(_stages(scheme))
    return kicks[:, None], drifts[:, None], gradients[:, None], curvatures[..., None]


def _run_table(scheme: Scheme) -> Table:
    """The table [opening, inner …, link, closing] of a run, for h = 1: see `loops`."""
    stages = _stages(scheme)
    (b0, g0, c0, a0), (b, g, c, a) = stages[0], stages[-1]
    opening: _Stage = (0.0, 0.0, 0.0 * c, 0.0)
    inner, link, closing = stages[:-1], stages[-1], stages[-1]
    if len(stages) > 1 and a == 0.0:  # kick … kick: the last kick and the next first stage are one
        opening, inner, link = stages[0], stages[1:-1], (b + b0, g + g0, c + c0, a0)
    elif len(stages) > 1 and b0 == g0 == 0.0 and not np.any(c0):  # drift … drift
        opening, inner, link = stages[0], stages[1:-1], (b, g, c, a + a0)
    return _arrays([opening, *inner, link, closing])


@lru_cache(maxsize=256)
def scaled_run_table(scheme: Scheme, h: float) -> Table:
    """The table of a run whose steps are h."""
    return _scaled(_run_table(scheme), scheme, h)


def scaled_step_table(scheme: Scheme, h: float) -> Table:
    """The stages of one step h by itself, (m,) each, polynomials (m, M)."""
    return _scaled(_arrays(_stages(scheme)), scheme, h)


def _scaled(table: Table, scheme: Scheme, h: float) -> Table:
    kicks, drifts, gradients, curvatures = table
    last = 3 if scheme.polynomials else 5
    return h * kicks, h * drifts, _times_power(gradients, h, 3), _times_power(curvatures, h, last)


def _times_power(numbers: np.ndarray, h: float, n: int) -> np.ndarray:
    """hⁿ times numbers, of which those that are 0 stay 0 even where hⁿ is beyond what a float can hold."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(numbers == 0, 0.0, np.float64(h) ** n * numbers)
