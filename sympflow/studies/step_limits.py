"""The longest stable step of one method, between the steps that were run and by bisection."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sympflow.studies.comparison_report import title
from sympflow.studies.stability_report import StabilityRow, StepLimit
from sympflow.studies.stability_study import STABLE, Study

PRECISION = 1.002  # the shortest unstable step found, in units of the longest stable one


def step_limit(study: Study, rows: Sequence[StabilityRow]) -> StepLimit:
    """The longest stable step, from the rows and by bisection below the first unstable one."""
    tried = [row for row in rows if row.dt is not None and row.status != "not applicable"]
    ran = [(row.dt, row.status in STABLE) for row in tried if row.dt is not None]
    first_bad = next((i for i, (_, good) in enumerate(ran) if not good), len(ran))
    low = ran[first_bad - 1][0] if first_bad else None
    high = ran[first_bad][0] if first_bad < len(ran) else None
    reached = ""
    if high is None and low is not None:
        low, high, reached = _longer(study, low)
    elif low is None and any(row.singular for row in tried):
        reached = "none: the solution is singular"  # no step helps
    elif low is None and tried and all(row.status == "outside" for row in tried):
        reached = "none: the solution leaves the flow's domain"
    elif low is None and high is not None:
        low, high = _shorter(study, high)
    error = None
    while low is not None and high is not None and high / low > PRECISION:
        middle = math.sqrt(low * high)
        good, error_there = study.stable(middle)
        low, high, error = (middle, high, error_there) if good else (low, middle, error)
    if low is not None and error is None:
        error = study.stable(low)[1]
    c, params = study.candidate, study.system.params
    return StepLimit(
        title(study.system),
        next(iter(params), None),
        next(iter(params.values()), None),
        c.method,
        c.label,
        study.dtype,
        low,
        high,
        error,
        reached,
    )


def _longer(study: Study, low: float) -> tuple[float, float | None, str]:
    """Double a stable step until it is unstable, refused, or as long as the interval."""
    longest = abs(study.t_span[1] - study.t_span[0])
    if study.candidate.integrator.trained:
        top = study.candidate.integrator.step_length(study.system)
        if low >= top * (1 - 1e-12):
            return low, None, "all up to the flow's Δt"
        good, _ = study.stable(top)
        return (top, None, "all up to the flow's Δt") if good else (low, top, "")
    while low < longest:
        if not study.stable(2 * low)[0]:
            return low, 2 * low, ""
        low = 2 * low
    return low, None, "all up to the length of the interval"


def _shorter(study: Study, high: float) -> tuple[float | None, float]:
    for _ in range(12):
        if study.stable(high / 2)[0]:
            return high / 2, high
        high = high / 2
    return None, high
