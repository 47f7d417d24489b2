"""How far a table's flow is from the exact one at held-out states: as figures, and beside what a step moves a state."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np

from sympflow.flow.primed import PrimedFlow
from sympflow.training.labels import Labels
from sympflow.training.table_fit import Table
from sympflow.training.table_jacobian import TableStep

USELESS = 0.1  # of what a step moves a state: leapfrog at ω Δt = 1 misses a hundredth, the identity all of it


@np.errstate(all="ignore")  # of flows that are far from the exact one
def differences(flow: PrimedFlow, step: TableStep, labels: Labels) -> np.ndarray:
    """ψ̄_t(x) − φ_H,t(x) at the labels: (J, N, 2d)."""
    table = Table(flow)
    offset, design = table.polynomial(labels.t)
    coefficients = offset + design @ table.parameters()
    return np.stack([step(c[:, None], labels.x.T).T for c in coefficients]) - labels.y


@np.errstate(all="ignore")
def errors(difference: np.ndarray) -> dict[str, float]:
    """Of `differences`, ‖·‖: mean, median and largest at Δt, the last time; mean before it."""
    error = np.linalg.norm(difference, axis=-1)
    return {
        "one_step_error": float(error[-1].mean()),
        "one_step_error_median": float(np.median(error[-1])),
        "one_step_error_max": float(error[-1].max()),
        "fractional_error": float(error[:-1].mean()),
    }


@np.errstate(all="ignore")
def distance(difference: np.ndarray, unit: np.ndarray) -> float:
    """Of a flow from the exact one, in units (2d,), at Δt and before it; infinite if anything is not a number."""
    figures = errors(difference / unit)
    both = figures["one_step_error"] + figures["fractional_error"]
    return both if math.isfinite(both) else math.inf


@np.errstate(all="ignore")
def shares_missed(difference: np.ndarray, labels: Labels, unit: np.ndarray) -> tuple[float, float]:
    """How much of what a step of Δt moves a state is missed, mean of all states over mean, and median over median.

    They are 1 for the identity, and the same in all units of q, p and t; infinite if anything is not a number.

    Parameters
    ----------
    difference : (N, 2d)
        ψ̄_Δt(x) − φ_H,Δt(x).
    labels : Labels
        The last time is Δt.
    unit : (2d,)
        In which coordinates and momenta are measured: their spread over Ω.
    """
    error, moved = (np.linalg.norm(v / unit, axis=-1) for v in (difference, labels.y[-1] - labels.x))
    return _share(error.mean(), moved.mean()), _share(np.median(error), np.median(moved))


def _share(error: Any, of: Any) -> float:
    share = float(error / of) if error != 0 else 0.0
    return share if math.isfinite(share) else math.inf


def warn_of_useless_flow(shares: tuple[float, float], dt: float, stacklevel: int) -> None:
    """If in the mean over the states a tenth or more of what a step moves them is missed."""
    mean, median = shares
    if mean < USELESS:
        return
    warnings.warn(
        f"The flow is far from the exact one: at held-out states its error in one step of dt = {dt:g} is {mean:.1e} "
        f"times what a step moves them (in the median {median:.1e} times). Take a smaller `domain`, without states "
        "where H is singular or nearly so, a shorter `dt`, or another `flow`, with more kicks.",
        UserWarning,
        stacklevel=stacklevel + 1,
    )
