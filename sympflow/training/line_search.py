"""A line search for the strong Wolfe conditions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

SUFFICIENT_DECREASE = 1e-4
CURVATURE = 0.9
MAX_TRIALS = 25


@dataclass(frozen=True)
class Trial:
    """A point on the line: step length, loss, slope along the line, gradient."""

    length: float
    loss: float
    slope: float
    gradient: Tensor


def strong_wolfe(along: Callable[[float], Trial], start: Trial, guess: float) -> Trial | None:
    """A step with f(a) ≤ f(0) + 1e-4 a f'(0) and |f'(a)| ≤ 0.9 |f'(0)|, by bracketing and cubic interpolation.

    Where rounding hides the second condition, the lowest point that meets the first; None if there is none.

    References
    ----------
    .. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2006, algorithms 3.5 and 3.6.
    """

    def decreases(trial: Trial) -> bool:
        return trial.loss <= start.loss + SUFFICIENT_DECREASE * trial.length * start.slope

    def accepted(trial: Trial) -> bool:
        return decreases(trial) and abs(trial.slope) <= -CURVATURE * start.slope

    low, high, length = start, None, guess
    for _ in range(MAX_TRIALS):
        trial = along(length)
        if not (math.isfinite(trial.loss) and math.isfinite(trial.slope)):
            high, length = None, low.length + 0.1 * (length - low.length)
            continue
        if accepted(trial):
            return trial
        if not decreases(trial) or trial.loss >= low.loss:
            high = trial
        else:
            if trial.slope * ((high.length if high else math.inf) - trial.length) >= 0:
                high = low
            low = trial
        if high is None:
            length = min(max(1.5 * trial.length, _minimum(start, trial)), 10 * trial.length)  # NaN loses in max
            continue
        width = high.length - low.length
        if abs(width) <= 1e-12 * max(low.length, high.length):
            break
        # Keep off the ends of the bracket, where interpolation stalls.
        inside = (_minimum(low, high) - low.length) / width
        length = low.length + width * (min(max(inside, 0.1), 0.9) if math.isfinite(inside) else 0.5)
    return low if low.length > 0 and decreases(low) else None


def _minimum(a: Trial, b: Trial) -> float:
    """Where the cubic through two points with their slopes is least; NaN if it has no minimum."""
    d1 = a.slope + b.slope - 3 * (a.loss - b.loss) / (a.length - b.length)
    square = d1 * d1 - a.slope * b.slope
    if not square >= 0:
        return math.nan
    d2 = math.copysign(math.sqrt(square), b.length - a.length)
    denominator = b.slope - a.slope + 2 * d2
    return b.length - (b.length - a.length) * (b.slope + d2 - d1) / denominator if denominator else math.nan
