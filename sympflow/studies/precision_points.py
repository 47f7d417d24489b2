"""The points of a work–precision diagram, and what is read off them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise


@dataclass(frozen=True)
class Point:
    """One method at one step or tolerance.

    Attributes
    ----------
    system, method, label : str
    trajectories : int
        1, or the size of the batch.
    dt, tolerance : float or None
    status, reason : str
        As for `sympflow.studies.comparison.Row`; "uncertain" if the error is not 100 times the reference's own.
    backend : str
    run_time, run_time_spread : float
        Of all trajectories together, in seconds: median and interquartile range of `repeats` runs.
    repeats : int
    force_evaluations, hessian_evaluations : float
        For one trajectory.
    error, energy_error : float
        Largest over the instants; the median over a batch.
    training_time : float or None
    break_even : float or None
        Of a trained flow: how many units of time must be solved until its training has paid for itself, against the
        cheapest untrained method that is as accurate in energy. inf if it never does.
    """

    system: str
    method: str
    label: str
    trajectories: int = 1
    dt: float | None = None
    tolerance: float | None = None
    status: str = "ok"
    reason: str = ""
    backend: str | None = None
    run_time: float | None = None
    run_time_spread: float | None = None
    repeats: int = 0
    force_evaluations: float | None = None
    hessian_evaluations: float | None = None
    error: float | None = None
    energy_error: float | None = None
    training_time: float | None = None
    break_even: float | None = None


def break_even(points: list[Point], length: float) -> list[Point]:
    """Fill in when the training of each flow has paid for itself."""
    done = [p for p in points if p.run_time and p.energy_error is not None and math.isfinite(p.energy_error)]
    untrained = [p for p in done if p.training_time is None and p.method not in ("sympflow", "mlp")]
    filled = []
    for point in points:
        if point in done and point.training_time is not None and untrained:
            labels = {p.label for p in untrained}
            rival = min(cost_at([p for p in untrained if p.label == n], point.energy_error or 0.0) for n in labels)
            if math.isinf(rival):  # no untrained point is as accurate: nothing to compare with
                reason = "No break-even: no untrained method was run at a step that reaches this energy error."
                filled.append(replace(point, reason=f"{point.reason} {reason}".strip()))
                continue
            saved = (rival - (point.run_time or 0.0)) / length
            point = replace(point, break_even=point.training_time / saved if saved > 0 else math.inf)  # noqa: PLW2901
        filled.append(point)
    return filled


def cost_at(points: Sequence[Point], error: float, cost: str = "run_time", measure: str = "energy_error") -> float:
    """What one method costs for an error: between two of its points by interpolation of the logarithms.

    The cheapest point that is more accurate is taken where that costs less; inf if no point is accurate enough.
    """
    known = [(getattr(p, measure), getattr(p, cost)) for p in points]
    known = sorted((e, c) for e, c in known if e and c and math.isfinite(e))
    enough = min((c for e, c in known if e <= error), default=math.inf)
    for (e0, c0), (e1, c1) in pairwise(known):
        if e0 <= error <= e1 and e0 < e1:
            share = math.log(error / e0) / math.log(e1 / e0)
            enough = min(enough, c0 * (c1 / c0) ** share)
    return enough
