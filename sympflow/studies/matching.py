"""Tuning a method's step or tolerance until it costs, or errs, as much as another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep, Integrator

_CLOSE = math.log(1.05)
_LONGEST_JUMP = math.log(16.0)
_ROUNDS = 12


def tunable(integrator: Integrator) -> bool:
    """Whether the method has a step or a tolerance that may be changed; a trained flow is what it is."""
    return not integrator.trained and (isinstance(integrator, FixedStep) or "rtol" in integrator.options())


def tuned(integrator: Integrator, system: HamiltonianSystem, factor: float) -> Integrator:
    """The integrator with its step, or both its tolerances, multiplied by `factor`."""
    options: dict[str, Any]
    if isinstance(integrator, FixedStep):
        options = {"dt": integrator.step_length(system) * factor}
    else:
        options = {name: getattr(integrator, name) * factor for name in ("rtol", "atol")}
        options["rtol"] = min(max(options["rtol"], 2.5e-14), 0.1)  # the least that SciPy takes, and the most of any use
    return replace(integrator, **options)  # type: ignore[type-var]


def match(
    integrator: Integrator,
    system: HamiltonianSystem,
    measure: Callable[[Integrator], float],
    target: float,
    grows: bool,
) -> tuple[Integrator, float]:
    """The integrator tuned so that `measure` is within 5 % of `target`, and what was measured; or the nearest found.

    Parameters
    ----------
    measure : callable
        A positive figure of a run; inf if the run fails, which asks for smaller steps.
    grows : bool
        Whether the figure grows with the step (an error), or falls (a cost).

    Notes
    -----
    The secant method on the logarithms, safeguarded by the nearest points found on either side.
    """
    x, slope = 0.0, (2.0 if grows else -1.0)
    below: tuple[float, float] | None = None  # (x, f) with too small a step, and with too large a one
    above: tuple[float, float] | None = None
    best: tuple[float, Integrator, float] = (math.inf, integrator, math.nan)
    for _ in range(_ROUNDS):
        candidate = tuned(integrator, system, math.exp(x))
        value = measure(candidate)
        f = math.log(value / target) if 0 < value < math.inf else math.inf
        if not math.isfinite(f):
            above = (x, math.inf)
            x = x - 1.0 if below is None else (x + below[0]) / 2
            continue
        if abs(f) < best[0]:
            best = (abs(f), candidate, value)
        if abs(f) < _CLOSE:
            break
        if (f > 0) == grows:
            above = (x, f)
        else:
            below = (x, f)
        if below is not None and above is not None and math.isfinite(above[1]):
            slope = (above[1] - below[1]) / (above[0] - below[0])
        x = x + max(-_LONGEST_JUMP, min(_LONGEST_JUMP, -f / slope))
        if below is not None and above is not None:
            margin = 0.05 * (above[0] - below[0])
            x = min(max(x, below[0] + margin), above[0] - margin)
    return best[1], best[2]
