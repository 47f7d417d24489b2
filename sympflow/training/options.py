"""The options of `train`: what was asked for, and of each kind of fit the choices that determine its result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, TypeVar

import torch
from numpy.typing import ArrayLike

from sympflow.arguments import plain

KINDS = ("primed", "sympflow", "mlp")
SCHEDULES = ("one-cycle", "cosine", "constant")
WEIGHTS = ("residual_weight", "matching_weight", "label_weight")
OF_LOSSES = (*WEIGHTS, "matching_times")
OF_GRADIENTS = ("learning_rate", "schedule", "clip")
OF_SEARCHES = ("restarts", "frozen_weight", "energy_weight", "runs")

Options = TypeVar("Options")


# checks ---------------------------------------------------------------------------------------------------------


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def check_counts(**values: Any) -> None:
    """Positive integers, or None where a choice is left open."""
    for name, value in values.items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ValueError(f"`{name}` must be a positive integer; got {value!r}: give 1 or more, or leave it out.")


def check_seed(seed: Any) -> None:
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"`seed` must be a non-negative integer; got {seed!r}: give 0 or more.")


def check_positive(**values: Any) -> None:
    """Positive finite numbers, or None where a choice is left open."""
    for name, value in values.items():
        if value is not None and not (is_number(value) and 0 < value < math.inf):
            raise ValueError(f"`{name}` must be positive and finite; got {value!r}: leave it out for the default.")


def check_weights(**weights: Any) -> None:
    """Weights of the losses, of which some may be 0, but not all."""
    for name, value in weights.items():
        if not (is_number(value) and 0 <= value < math.inf):
            raise ValueError(f"`{name}` must be finite and at least 0; got {value!r}: 0 leaves the loss out.")
    if not any(weights.values()):
        *most, last = (f"`{name}`" for name in weights)
        raise ValueError(f"{', '.join(most)} and {last} are all 0: give one of them a positive value.")


# what is asked for ----------------------------------------------------------------------------------------------


def plain_numbers(options: Options) -> Options:
    """The same options, with numbers of NumPy's as Python's, which a checkpoint can compare."""
    return replace(options, **{f.name: plain(getattr(options, f.name)) for f in fields(options)})  # type: ignore[type-var, arg-type]


@dataclass(frozen=True)
class _Asked:
    """Arguments of `train` as they were given; the defaults of the fields are those of its signature."""

    def given(self, names: Sequence[str] | None = None) -> list[str]:
        """The options that have another value than their default, of all or of the named ones."""
        return [
            f.name
            for f in fields(self)
            if (names is None or f.name in names)
            and (value := getattr(self, f.name)) is not f.default
            and (f.default is None or value != f.default)
        ]


@dataclass(frozen=True)
class NewFlow(_Asked):
    """The arguments of `train` that describe a new flow."""

    kind: str | None = None
    stages: int | None = None
    processor: int | None = None
    pairs: int | None = None
    hidden: Sequence[int] | None = None
    activation: str | None = None
    dtype: torch.dtype | None = None
    device: torch.device | str | None = None

    OF_NETWORKS = ("pairs", "hidden", "activation")
    OF_PRIMED = ("stages", "processor")


@dataclass(frozen=True)
class NewFit(_Asked):
    """The arguments of `train` that describe the fit of a flow; each kind of fit takes those it has a field for."""

    optimizer: str | None = None
    loss: str | None = None
    steps: int | None = None
    points: int | None = None
    learning_rate: float = 5e-3
    schedule: str = "one-cycle"
    clip: float | None = 1.0
    refresh: int | None = None
    validate_every: int | None = None
    validation_points: int = 2000
    checkpoint_every: int | None = None
    residual_weight: float = 1.0
    matching_weight: float | None = None
    label_weight: float | None = None
    matching_times: int = 10
    data: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None
    seed: int = 0
    reference_states: int = 100
    restarts: int | None = None
    label_times: int | None = None
    frozen_weight: float | None = None
    energy_weight: float | None = None
    runs: int | None = None

    @property
    def searches(self) -> bool:
        """Gauss–Newton, named or by default: the search for the numbers of a primed or a split flow."""
        return self.optimizer in (None, "gauss-newton")

    def beside(self, kind: type) -> list[str]:
        """The given options that a kind of fit does not take."""
        taken = {"optimizer", "loss", *(f.name for f in fields(kind))}
        return [name for name in self.given() if name not in taken]

    def refuse(self, names: Sequence[str], what: str) -> None:
        """Raise if any of the named options is given; `what` does not take it."""
        for name in self.given(names):
            raise TypeError(f"`{name}` is not an option of the {what}: leave it out.")

    def chosen(self, kind: type, but: Sequence[str] = ()) -> dict[str, Any]:
        """The fields of a kind of fit for which something is said."""
        names = [f.name for f in fields(kind) if f.name not in ("data", *but)]
        return {f.name: value for f in fields(self) if f.name in names and (value := getattr(self, f.name)) is not None}

    def loss_weights(self) -> dict[str, float]:
        """The weights of the losses that `loss` names, by default of the labels: 0 for those that it leaves out."""
        loss = "labels" if self.loss is None else self.loss
        if self.data is not None and isinstance(loss, str) and "labels" not in loss.split("+"):
            raise ValueError(
                f"`data` has labels, which `loss` {loss!r} does not use: add +labels to it, or leave `data` out."
            )
        names = loss.split("+") if isinstance(loss, str) else []
        if not names or not set(names) <= {"residual", "matching", "labels"}:
            raise ValueError(f"`loss` {loss!r} is unknown: join some of residual, matching and labels by +.")
        if len(set(names)) < len(names):
            raise ValueError(
                f"`loss` {loss!r} names a loss twice: name it once, and give it more weight by its `_weight`."
            )
        weights = {"residual": self.residual_weight, "matching": self.matching_weight, "labels": self.label_weight}
        return {
            option: (1.0 if weight is None else weight) if name in names else 0.0
            for option, (name, weight) in zip(WEIGHTS, weights.items(), strict=True)
        }


# Gauss–Newton searches ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SearchOptions:
    """The choices that all searches have; with the seed they determine the trained weights.

    Parameters
    ----------
    points : int, optional
        Number of labelled states, drawn from the domain.
    label_times : int
        Number of times in (0, Δt] at which the states are labelled.
    frozen_weight : float
        Weight of the residuals at t = Δt, which alone are composed over many steps; those at other times have 1.
    restarts : int
        Starts of the frozen search: the flow as it is, then random tables.
    steps : int
        The most iterations of each of the final fits.
    seed : int
    reference_states : int
        Held-out states of the figures.
    """

    points: int | None = None
    label_times: int = 8
    frozen_weight: float = 1.0
    restarts: int = 24
    steps: int = 1000
    seed: int = 0
    reference_states: int = 100

    def __post_init__(self) -> None:
        counts = ("points", "label_times", "restarts", "steps", "reference_states")
        check_counts(**{name: getattr(self, name) for name in counts})
        check_seed(self.seed)
        check_positive(frozen_weight=self.frozen_weight)

    @property
    def loss(self) -> str:
        """The losses that are fitted, joined by +."""
        return "labels"

    def to_dict(self) -> dict[str, Any]:
        """The record of a recipe and a checkpoint."""
        record = {"optimizer": "gauss-newton", "loss": self.loss, **asdict(self)}
        return {name: value for name, value in record.items() if value is not None}


@dataclass(frozen=True)
class TableOptions(SearchOptions):
    """The choices for a primed flow.

    Parameters
    ----------
    points
        By default 250, and fewer for more than 4 degrees of freedom; `label_times` are equidistant.
    energy_weight : float
        Of the labels' errors in the energy, (∇H·δ)² in units of the spread of H over Ω, besides those of the
        coordinates. It is the energy that long runs keep; more than 10 is for those of which only that matters. Where
        `data` are handed in it counts in the search for the table at Δt alone.
    label_weight, residual_weight, matching_weight : float
        Weights of the labels, of ‖d/dt ψ̄_t(x) − J∇H‖² and of (𝓗 − H − c(t))²; 0 leaves a loss out.
    loss_points, matching_times : int
        Points of each of the last two, and the number of times in the last.
    data : str, optional
        Checksum of labels that were handed in.
    """

    energy_weight: float = 10.0
    label_weight: float = 1.0
    residual_weight: float = 0.0
    matching_weight: float = 0.0
    loss_points: int = 300
    matching_times: int = 10
    data: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_counts(loss_points=self.loss_points, matching_times=self.matching_times)
        if not (is_number(self.energy_weight) and 0 <= self.energy_weight < math.inf):
            raise ValueError(
                f"`energy_weight` must be finite and at least 0; got {self.energy_weight!r}: 0 leaves the energy out."
            )
        check_weights(
            **{f"{name}_weight": getattr(self, f"{name}_weight") for name in ("label", "residual", "matching")}
        )

    @classmethod
    def of(cls, asked: NewFit, data: str | None = None) -> TableOptions:
        """The choices that are asked for.

        Raises
        ------
        TypeError, ValueError
            If something else is asked for, or a choice is not admissible.
        """
        what = "optimizer 'gauss-newton' for primed flows"
        asked.refuse(asked.beside(cls), what)
        if asked.loss is None:
            asked.refuse(OF_LOSSES, f"{what} without a `loss`")
        return cls(**asked.chosen(cls, WEIGHTS) | asked.loss_weights() | {"data": data})

    @property
    def loss(self) -> str:
        named = {"labels": self.label_weight, "residual": self.residual_weight, "matching": self.matching_weight}
        return "+".join(name for name, weight in named.items() if weight)


@dataclass(frozen=True)
class SplitOptions(SearchOptions):
    """The choices for a split flow, whose label times are Δt sin(πj/2J).

    These are dense towards Δt, where polynomials between labels are worst.
    """

    points: int = 150
    label_times: int = 16
    frozen_weight: float = 30.0
    restarts: int = 8
    steps: int = 150

    @classmethod
    def of(cls, asked: NewFit) -> SplitOptions:
        """The choices that are asked for; raises as `TableOptions.of` does."""
        if asked.loss not in (None, "labels"):
            raise ValueError(f"`loss` {asked.loss!r} is not one that Gauss–Newton fits split flows by: use 'labels'.")
        asked.refuse(asked.beside(cls), "optimizer 'gauss-newton' for split flows")
        return cls(**asked.chosen(cls))


# losses at points, step by step ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Habit:
    """The choices of an optimizer for which nothing is said, in the terms of `LossOptions`."""

    steps: int
    points: int
    refresh: int | None
    validate_every: int
    checkpoint_every: int


HABITS = {
    "adam": Habit(20_000, 700, 1, 500, 1000),
    "bfgs": Habit(200, 4000, None, 5, 5),
    "lbfgs": Habit(500, 4000, None, 5, 5),
    "gauss-newton": Habit(200, 1500, None, 5, 10),
}
OPTIMIZERS = tuple(HABITS)


@dataclass(frozen=True)
class LossOptions:
    """The choices of a run that lowers losses at points; with the seed they determine the trained weights.

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
        counts = ["steps", "points", "matching_times", "label_times", "refresh", "validate_every", "validation_points"]
        counts += ["reference_states", "checkpoint_every"]
        check_counts(**{name: getattr(self, name) for name in counts})
        check_seed(self.seed)
        check_weights(**{name: getattr(self, name) for name in WEIGHTS})
        check_positive(learning_rate=self.learning_rate, clip=self.clip)
        if self.matching_times > min(self.points, self.validation_points) // 2:
            raise ValueError("`matching_times` must leave two points for each time: make it at most half of `points`.")

    @classmethod
    def of(cls, asked: NewFit, kind: str, data: str | None = None) -> LossOptions:
        """The choices that are asked for, of a flow of that kind; raises as `TableOptions.of` does."""
        optimizer = "adam" if asked.optimizer is None else asked.optimizer
        asked.refuse(asked.beside(cls), f"optimizer {optimizer!r} for flows of kind {kind!r}")
        if optimizer != "adam":
            asked.refuse(OF_GRADIENTS, f"optimizer {optimizer!r}")
        if asked.loss is None:
            weights = {
                "residual_weight": asked.residual_weight,
                "matching_weight": asked.matching_weight,
                "label_weight": asked.label_weight,
            }
        else:
            weights = dict(asked.loss_weights())
        if kind == "mlp" and weights["matching_weight"]:
            raise ValueError("`matching_weight` needs a Hamiltonian, which an MLP flow has not: leave it out.")
        if weights["matching_weight"] is None:
            weights["matching_weight"] = 0.0 if kind == "mlp" or optimizer == "gauss-newton" else 1.0
        if weights["label_weight"] is None:
            weights["label_weight"] = 0.0 if asked.data is None else 1.0
        habit = asdict(HABITS.get(optimizer, HABITS["adam"]))
        others = asked.chosen(cls, (*WEIGHTS, "optimizer", "clip")) | {"clip": asked.clip}
        return cls(**{**habit, **others, **weights, "optimizer": optimizer, "data": data})

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
        """The record of a recipe and a checkpoint."""
        return asdict(self)
