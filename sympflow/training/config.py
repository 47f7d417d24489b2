"""TrainingConfig: every choice of a training run that its result depends on."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from sympflow.training.choices import check_counts, check_positive, check_seed, check_weights, to_plain_numbers

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
        to_plain_numbers(self)
        for name, value, known in (
            ("optimizer", self.optimizer, OPTIMIZERS),
            ("schedule", self.schedule, SCHEDULES),
        ):
            if value not in known:
                raise ValueError(f"`{name}` {value!r} is unknown: choose one of {', '.join(known)}.")
        counts = ["steps", "points", "matching_times", "label_times", "refresh", "validate_every", "validation_points"]
        counts += ["reference_states", "checkpoint_every"]
        check_counts(**{name: getattr(self, name) for name in counts})
        check_seed(self.seed)
        check_weights(
            **{f"{name}_weight": getattr(self, f"{name}_weight") for name in ("residual", "matching", "label")}
        )
        check_positive(learning_rate=self.learning_rate, clip=self.clip)
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
