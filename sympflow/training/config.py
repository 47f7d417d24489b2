"""TrainingConfig: every choice of a training run that its result depends on."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

DEFAULTS: dict[str, dict[str, Any]] = {
    "adam": {"steps": 20_000, "points": 700, "refresh": 1, "validate_every": 500, "checkpoint_every": 1000},
    "bfgs": {"steps": 200, "points": 4000, "refresh": None, "validate_every": 5, "checkpoint_every": 5},
    "lbfgs": {"steps": 500, "points": 4000, "refresh": None, "validate_every": 5, "checkpoint_every": 5},
    "gauss-newton": {"steps": 200, "points": 1500, "refresh": None, "validate_every": 5, "checkpoint_every": 10},
}
"""What each optimizer does if not told otherwise."""

OPTIMIZERS = tuple(DEFAULTS)
SCHEDULES = ("one-cycle", "cosine", "constant")


@dataclass(frozen=True)
class TrainingConfig:
    """The choices of a run; with the seed they determine the trained weights.

    Parameters
    ----------
    optimizer : str
        "adam", one gradient step on fresh points at a time; "gauss-newton", whose steps are Gauss–Newton steps on the
        residuals of points that stay for `refresh` steps, each far dearer and far better, and which stops by itself;
        "bfgs" and "lbfgs", whose steps are 20 quasi-Newton iterations on such points.
    steps : int
        Length of the run.
    points : int
        Collocation points of each of the two losses, per step.
    residual_weight, matching_weight, label_weight : float
        Weights of L1, L2 and L3; 0 leaves the loss out.
    matching_times : int
        Number of distinct times in L2, each with points / matching_times states (to remove 𝓗's free c(t)).
    label_times : int
        Number of equidistant times in (0, Δt] at which as many states as there are points are labelled for L3; each
        step takes `points` of these labels.
    data : str or None
        Checksum of the labels that were handed in instead.
    learning_rate : float
        The largest of the schedule.
    schedule : str
        "one-cycle" (cosine up over the first 5 %, cosine down to 1e-3 of the peak), "cosine" (only down) or "constant".
    clip : float or None
        Largest norm of the gradient.
    refresh : int or None
        Number of steps that the points are kept; None keeps them for the whole run.
    seed : int
        Of the points and the initial weights.
    validate_every, checkpoint_every : int
        In steps.
    validation_points, reference_states : int
        Held-out points of the losses, held-out states of the one-step error.
    """

    optimizer: str = "adam"
    steps: int = 20_000
    points: int = 700
    residual_weight: float = 1.0
    matching_weight: float = 1.0
    label_weight: float = 0.0
    matching_times: int = 10
    label_times: int = 8
    data: str | None = None
    learning_rate: float = 5e-3
    schedule: str = "one-cycle"
    clip: float | None = 1.0
    refresh: int | None = 1
    seed: int = 0
    validate_every: int = 500
    validation_points: int = 2000
    reference_states: int = 100
    checkpoint_every: int = 1000

    def __post_init__(self) -> None:
        for name, value, known in (
            ("optimizer", self.optimizer, OPTIMIZERS),
            ("schedule", self.schedule, SCHEDULES),
        ):
            if value not in known:
                raise ValueError(f"`{name}` {value!r} is unknown: choose one of {', '.join(known)}.")
        for name in (
            "steps",
            "points",
            "matching_times",
            "label_times",
            "validate_every",
            "validation_points",
            "reference_states",
            "checkpoint_every",
        ):
            _positive_integer(name, getattr(self, name))
        if self.refresh is not None:
            _positive_integer("refresh", self.refresh)
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer; got {self.seed!r}.")
        for name in ("residual_weight", "matching_weight", "label_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"`{name}` must be finite and at least 0; got {getattr(self, name)!r}.")
        if self.residual_weight == self.matching_weight == self.label_weight == 0:
            raise ValueError(
                "`residual_weight`, `matching_weight` and `label_weight` are all 0: give one of them a positive value."
            )
        for name in ("learning_rate", "clip"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"`{name}` must be positive and finite; got {value!r}.")
        if self.matching_times > min(self.points, self.validation_points) // 2:
            raise ValueError("`matching_times` must leave two points for each time: make it at most half of `points`.")

    @classmethod
    def of(cls, optimizer: str, **choices: Any) -> TrainingConfig:
        """The configuration of an optimizer, with its defaults where `steps` and the like are None."""
        for name, value in DEFAULTS.get(optimizer, DEFAULTS["adam"]).items():
            if choices.get(name) is None:
                choices[name] = value
        return cls(optimizer=optimizer, **choices)

    def rate(self, step: int) -> float:
        """The learning rate of a step."""
        if self.schedule == "constant":
            return self.learning_rate
        rise = 0.05 if self.schedule == "one-cycle" else 0.0
        x = (step + 1) / self.steps
        if x < rise:
            return self.learning_rate * (0.04 + 0.96 * (1 - math.cos(math.pi * x / rise)) / 2)
        fall = (1 + math.cos(math.pi * (x - rise) / (1 - rise))) / 2
        return self.learning_rate * (1e-3 + (1 - 1e-3) * fall)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def differences(self, other: dict[str, Any]) -> list[str]:
        """Names of the choices in which a recorded run differs from this one, intervals of checkpoints aside."""
        mine = self.to_dict()
        names = {f.name for f in fields(self)} | set(other)
        return sorted(n for n in names - {"checkpoint_every"} if n not in other or mine.get(n) != other[n])


def _positive_integer(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"`{name}` must be a positive integer; got {value!r}.")
