"""The step or tolerance that reaches a given energy error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from contenders.contender import Contender, Work
from contenders.scene import Scene

SHORT = 0.1
"""Part of the interval over which a `short` calibration runs."""


@dataclass(frozen=True)
class Judged:
    """A method at one setting of its step or tolerance."""

    control: float
    energy_error: float
    state_error: float | None
    work: Work


def largest_control(
    judge: Callable[[float], Judged], target: float, guess: float, order: float, window: float, attempts: int = 14
) -> Judged | None:
    """The largest step or tolerance whose energy error meets the target, by bracketing on the logarithms.

    The next trial is where the error would be just below the target if it went as control^order; once there is a
    bracket, a trial outside it is replaced by its geometric middle. None if no trial met the target.
    """
    best: Judged | None = None
    low, high = 0.0, math.inf  # the largest control known to meet the target, the smallest known not to
    control = guess
    for _ in range(attempts):
        trial = judge(control)
        if trial.energy_error <= target:
            if best is None or control > best.control:
                best, low = trial, control
            if trial.energy_error >= window * target:
                break
        else:
            high = min(high, control)
        if low >= high or high / max(low, 1e-300) < 1.005:
            break
        excess = trial.energy_error / (math.sqrt(window) * target)
        factor = 0.5 if not math.isfinite(excess) else float(np.clip(excess ** (-1 / order), 1 / 16, 16))
        control *= factor
        if not low < control < high:
            control = math.sqrt(low * high)
    return best


def calibrate(scene: Scene, contender: Contender, target: float) -> Judged | None:
    """`largest_control` of a contender; errors are those at the end of the whole interval."""
    assert contender.outputs is not None
    outputs, n = contender.outputs, contender.trajectories
    short = target in contender.short
    part = SHORT if short else 1.0

    def judge(control: float) -> Judged:
        result = outputs(control, part * scene.t_end)
        energy_error = scene.energy_error(result.states, scene.sample(n)) / part
        state_error = None if short else scene.state_error(result.final, n)
        work = result.work
        if short:
            forces = work.force_evaluations
            work = replace(
                work, steps=round(work.steps / part), force_evaluations=None if forces is None else round(forces / part)
            )
        return Judged(control, energy_error, state_error, work)

    return largest_control(judge, target, contender.guesses[target], contender.order, contender.window)
