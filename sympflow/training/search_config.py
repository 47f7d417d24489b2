"""The choices of a Gauss–Newton search for the numbers of a primed or a split flow."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from sympflow.training.choices import (
    check_counts,
    check_positive,
    check_seed,
    check_weights,
    is_number,
    to_plain_numbers,
)


@dataclass(frozen=True)
class SearchConfig:
    """What all searches choose; with the seed it determines the trained weights.

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
        to_plain_numbers(self)
        counts = ("points", "label_times", "restarts", "steps", "reference_states")
        check_counts(**{name: getattr(self, name) for name in counts})
        check_seed(self.seed)
        check_positive(frozen_weight=self.frozen_weight)

    @property
    def loss(self) -> str:
        """What is fitted."""
        return "labels"

    def to_dict(self) -> dict[str, Any]:
        record = {"optimizer": "gauss-newton", "loss": self.loss, **asdict(self)}
        return {name: value for name, value in record.items() if value is not None}


@dataclass(frozen=True)
class TableConfig(SearchConfig):
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

    @property
    def loss(self) -> str:
        named = {"labels": self.label_weight, "residual": self.residual_weight, "matching": self.matching_weight}
        return "+".join(name for name, weight in named.items() if weight)


@dataclass(frozen=True)
class SplitConfig(SearchConfig):
    """The choices for a split flow, whose label times are Δt sin(πj/2J).

    These are dense towards Δt, where polynomials between labels are worst.
    """

    points: int = 150
    label_times: int = 16
    frozen_weight: float = 30.0
    restarts: int = 8
    steps: int = 150
