"""Fits of flows and their solvers: the fields of these frozen dataclasses are the options of `train`.

    train(system, PrimedFit(stages=3, processor=6), solver=GaussNewton(restarts=24), budget=15)

A fit describes the flow and the data to which it is fitted, a solver the method of the fit. None stands for a choice
that is left open. With the seed both determine the trained numbers. `from_keywords` makes them of plain keywords.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, check_one_of, check_positive, plain, real_number
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.mlp import MLPFlow, matching_widths
from sympflow.flow.primed import PrimedFlow
from sympflow.flow.scaling import Scaling
from sympflow.flow.split import SplitFlow
from sympflow.flow.sympflow import Drive, SympFlow
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem

Data = tuple[ArrayLike, ArrayLike, ArrayLike]
Resolved = Any
"""A fit or a solver in which no choice is left open."""
Which = bool | tuple[int, ...]

LOSSES = ("residual", "matching", "labels")
WEIGHTS = ("residual_weight", "matching_weight", "label_weight")


# checks ---------------------------------------------------------------------------------------------------------


def check_weights(**weights: Any) -> None:
    """Weights of the losses: some may be 0, but not all."""
    for name, value in weights.items():
        weight(name, value)
    if not any(weights.values()):
        *most, last = (f"`{name}`" for name in weights)
        raise ValueError(f"{', '.join(most)} and {last} are all 0: give one of them a positive value.")


Check = Callable[[str, Any], None]
"""Raises an error unless an option of that name may have the value."""


def count(name: str, value: Any) -> None:
    check_counts(**{name: plain(value)})


def one_of(*known: str) -> Check:
    return lambda name, value: check_one_of(name, value, known)


def weight(name: str, value: Any, what: str = "loss") -> None:
    """A weight; 0 leaves the loss out."""
    if not (real_number(value) and 0 <= value < math.inf):
        raise ValueError(f"`{name}` must be finite and at least 0; got {value!r}: 0 leaves the {what} out.")


def seed_number(name: str, value: Any) -> None:
    seed = plain(value)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"`{name}` must be a non-negative integer; got {value!r}: give 0 or more.")


def duration(name: str, value: Any) -> None:
    if not (real_number(value) and 0 < value < math.inf):
        raise ValueError(f"`{name}` must be a positive finite number; got {value!r}: leave it out for the default.")


def option(check: Check | None = None, default: Any = None, *, left_open: bool = False, of_flow: bool = False) -> Any:
    """Return a field: its check, if None is a choice too, and if it describes a new flow."""
    return field(default=default, metadata={"check": check, "open": left_open or default is None, "of_flow": of_flow})


class _Options:
    """A frozen dataclass of options, whose fields hold their checks."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            check, value = f.metadata.get("check"), getattr(self, f.name)
            if check is not None and not (value is None and f.metadata["open"]):
                check(f.name, value)

    @classmethod
    def names(cls) -> list[str]:
        """The names of the options."""
        return [f.name for f in fields(cls)]  # type: ignore[arg-type]

    @classmethod
    def of_flow(cls) -> list[str]:
        """The options that describe the new flow."""
        return [f.name for f in fields(cls) if f.metadata.get("of_flow")]  # type: ignore[arg-type]

    def given(self) -> list[str]:
        """The options that have another value than their default."""
        return [f.name for f in fields(self) if getattr(self, f.name) is not f.default != getattr(self, f.name)]  # type: ignore[arg-type]

    def but(self, **values: Any) -> Self:
        """The same with other values where a choice was left open."""
        return replace(self, **{n: v for n, v in values.items() if getattr(self, n) is None})  # type: ignore[type-var]


# solvers --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GaussNewton(_Options):
    """Damped Gauss–Newton steps on residuals; the iteration stops by itself.

    Parameters
    ----------
    steps : int, optional
        The most steps: by default 1000 of each fit of a primed flow, 150 of a split one, 200 of a network.
    restarts : int, optional
        Number of starts of the search for a primed or a split flow: the untrained flow, then random tables. By default
        24 and 8. Without `budget` a new primed flow has 72 in up to three degrees of freedom of a symbolic system, and
        fewer than 24 beyond six degrees of freedom.
    refresh, validate_every, checkpoint_every : int
        For other flows, in steps: how long the same points are used, None for the whole run; how often held-out errors
        are measured; how often a checkpoint is written.
    """

    steps: int | None = option(count)
    restarts: int | None = option(count)
    refresh: int | None = option(count)
    validate_every: int = option(count, 5)
    checkpoint_every: int = option(count, 10)

    name: ClassVar[str] = "gauss-newton"
    POINTS: ClassVar[int] = 1500


@dataclass(frozen=True)
class Adam(_Options):
    """Adam (Kingma & Ba 2015), one gradient step on fresh points at a time.

    Parameters
    ----------
    steps : int
    learning_rate : float
        The largest of the schedule.
    schedule : {"one-cycle", "cosine", "constant"}
        "one-cycle": cosine up over the first 5 % and down to 1e-3 of the peak; "cosine": only down; "constant": no
        schedule.
    clip : float or None
        Largest norm of the gradient.
    refresh, validate_every, checkpoint_every
        See `GaussNewton`.
    """

    steps: int = option(count, 20_000)
    learning_rate: float = option(check_positive, 5e-3)
    schedule: str = option(one_of("one-cycle", "cosine", "constant"), "one-cycle")
    clip: float | None = option(check_positive, 1.0, left_open=True)
    refresh: int | None = option(count, 1, left_open=True)
    validate_every: int = option(count, 500)
    checkpoint_every: int = option(count, 1000)

    name: ClassVar[str] = "adam"
    POINTS: ClassVar[int] = 700

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


@dataclass(frozen=True)
class BFGS(_Options):
    """BFGS with a dense matrix, 20 iterations in each of `steps` on the points of the step: see `GaussNewton`."""

    steps: int = option(count, 200)
    refresh: int | None = option(count)
    validate_every: int = option(count, 5)
    checkpoint_every: int = option(count, 5)

    name: ClassVar[str] = "bfgs"
    POINTS: ClassVar[int] = 4000


@dataclass(frozen=True)
class LBFGS(BFGS):
    """Limited-memory BFGS, see `BFGS`; for networks of more than 8000 parameters."""

    steps: int = option(count, 500)

    name: ClassVar[str] = "lbfgs"


Solver = GaussNewton | Adam | BFGS
SOLVERS: dict[str, type[Solver]] = {cls.name: cls for cls in (Adam, BFGS, LBFGS, GaussNewton)}
"""The solvers by the names that the keyword `optimizer` takes."""


# fits -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit(_Options):
    """The options that all fits have.

    Parameters
    ----------
    dt : float, optional
        Δt of a new flow, the longest time of its map.
    points : int, optional
        Number of states, drawn from the domain.
    label_times : int
        Number of times in (0, Δt] at which states are labelled by the exact flow.
    seed : int
        Of the points, the starts, and the initial weights.
    reference_states : int
        Held-out states of the figures.
    """

    dt: float | None = option(duration, of_flow=True)
    _: KW_ONLY
    points: int | None = option(count)
    label_times: int = option(count, 8)
    seed: int = option(seed_number, 0)
    reference_states: int = option(count, 100)

    kind: ClassVar[str]
    OPEN: ClassVar[dict[str, int]] = {}
    """The numbers of a solver that leaves them open."""

    @property
    def of_a_given_flow(self) -> Self:
        """The same without what describes the new flow."""
        described: Any = {f.name: f.default for f in fields(self) if f.name in self.of_flow()}
        return replace(self, **described)

    def resolved(self, solver: Solver, kind: str) -> Self:
        """The same with numbers for what is left open, of a flow of that kind."""
        return self

    def flow(self, system: HamiltonianSystem, domain: Domain, earlier: FlowMap | None = None) -> Any:
        """The untrained flow; `earlier` is one that was trained before, whose numbers it may take over."""
        raise NotImplementedError

    @property
    def losses(self) -> str:
        """The losses that are fitted, joined by +."""
        return "labels"

    def record(self, solver: Solver) -> dict[str, Any]:
        """The record of a recipe and a checkpoint: what determines the trained numbers."""
        mine = {name: getattr(self, name) for name in self.names() if name not in (*self.of_flow(), "data", "loss")}
        mine |= {name: getattr(solver, name) for name in solver.names()}
        found = {"optimizer": solver.name, "loss": self.losses, **mine}
        return {name: plain(value) for name, value in found.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class _LossFit(Fit):
    """The options of fits by losses at points."""

    loss: str | None = None
    residual_weight: float | None = None
    matching_weight: float | None = None
    label_weight: float | None = None
    matching_times: int = option(count, 10)
    data: Data | None = field(default=None, repr=False, compare=False)

    def record(self, solver: Solver) -> dict[str, Any]:
        told = super().record(solver)
        if self.data is not None:
            content = b"".join(np.ascontiguousarray(array).tobytes() for array in self.data)
            told["data"] = hashlib.sha256(content).hexdigest()
        return told

    def _named(self, loss: Any) -> dict[str, Any]:
        """The weights of the losses that are named, 0 for those that are left out."""
        if self.data is not None and isinstance(loss, str) and "labels" not in loss.split("+"):
            raise ValueError(
                f"`data` has labels, which `loss` {loss!r} does not use: add +labels to it, or leave `data` out."
            )
        names = loss.split("+") if isinstance(loss, str) else []
        if not names or not set(names) <= set(LOSSES):
            raise ValueError(f"`loss` {loss!r} is unknown: join some of residual, matching and labels by +.")
        if len(set(names)) < len(names):
            raise ValueError(
                f"`loss` {loss!r} names a loss twice: name it once, and give it more weight by its `_weight`."
            )
        given = dict(zip(LOSSES, (getattr(self, weight) for weight in WEIGHTS), strict=True))
        each = {name: (1.0 if value is None else value) if name in names else 0.0 for name, value in given.items()}
        return dict(zip(WEIGHTS, each.values(), strict=True))

    @property
    def losses(self) -> str:
        weights = dict(zip(LOSSES, (getattr(self, weight) for weight in WEIGHTS), strict=True))
        return "+".join(name for name in ("labels", "residual", "matching") if weights[name])


@dataclass(frozen=True, kw_only=True)
class PrimedFit(_LossFit):
    """A primed flow: the system's own V and T times functions of t, fitted to the exact flow.

    Parameters
    ----------
    dt : float, optional
        Δt; by default it follows from the frequencies on Ω, or from short trials.
    stages, processor, curvature, polynomial, first, scheme, force_gradient, dtype, device
        Of the new flow, see `SympFlow.primed`. By default trials choose them, or else 3 kicks, or as many as a given
        `dt` needs, and a processor of 6.
    points : int, optional
        Labelled states: by default 250, fewer for more than 4 degrees of freedom.
    label_times : int
        Number of equidistant times in (0, Δt] at which they are labelled.
    frozen_weight : float
        Weight of the residuals at t = Δt, which only are composed over many steps; at other times it is 1.
    energy_weight : float
        Weight of the labels' errors in the energy, (∇H·δ)² in units of the spread of H over Ω, in addition to those of
        the coordinates; 1000 if only the energy of a run matters, 0 for none.
    loss : str, optional
        Some of "residual", "matching" and "labels", joined by "+"; "labels" by default.
    residual_weight, matching_weight, label_weight : float, optional
        Weights of ‖d/dt ψ̄_t(x) − J∇H‖², of (𝓗 − H − c(t))² and of the labels, for the named losses 1.
    loss_points, matching_times : int
        Number of points of the residual and of the matching loss, and number of times of the latter.
    data : (array (n,), array (n, 2d), array (n, 2d)), optional
        Labels of your own: times in [0, Δt], states, and where the exact flow takes them.
    runs : int, optional
        For a lattice: after the search the numbers are fitted further to the energy errors of this number of long runs
        of a larger ring; 48 is usual.
    seed, reference_states
        See `Fit`.
    """

    stages: int | None = option(of_flow=True)
    processor: int | None = option(of_flow=True)
    curvature: Which = option(default=False, of_flow=True)
    polynomial: int | None = option(of_flow=True)
    first: str = option(default="drift", of_flow=True)
    scheme: str | None = option(of_flow=True)
    force_gradient: Which | None = option(of_flow=True)
    dtype: torch.dtype = option(default=torch.float64, of_flow=True)
    device: torch.device | str | None = option(of_flow=True)
    frozen_weight: float = option(check_positive, 1.0)
    energy_weight: float = option(partial(weight, what="energy"), 10.0)
    loss_points: int = option(count, 300)
    runs: int | None = option(count)

    kind: ClassVar[str] = "primed"
    OPEN: ClassVar[dict[str, int]] = {"restarts": 24, "steps": 1000}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss is None:
            for name in (name for name in WEIGHTS if getattr(self, name) is not None):
                raise TypeError(
                    f"`{name}` is not an option of primed flows without a `loss`: leave it out, or name the losses."
                )
        check_weights(**{name: self.weights[name] for name in sorted(WEIGHTS)})

    @property
    def weights(self) -> dict[str, Any]:
        """The weights of the losses."""
        return self._named("labels" if self.loss is None else self.loss)

    def resolved(self, solver: Solver | None = None, kind: str = "primed") -> PrimedFit:
        """The same fit with values for all weights."""
        return replace(self, loss="labels" if self.loss is None else self.loss, **self.weights)

    @property
    def levels(self) -> list[int]:
        """The terms of each kick of a step, see `sympflow.schemes.Scheme.level`; one that steps share counts once."""
        stages = 3 if self.stages is None else self.stages
        n = stages + (self.first == "kick")

        def having(which: Which | None) -> Iterable[int]:
            return which if isinstance(which, tuple) else range(n if which or which is None else 0)

        levels = [(i in having(self.force_gradient)) * (1 + (i in having(self.curvature))) for i in range(n)]
        return levels if self.first == "drift" else levels[:-1]

    def flow(self, system: HamiltonianSystem, domain: Domain | None = None, earlier: FlowMap | None = None) -> Any:
        shape: Any = {name: getattr(self, name) for name in self.of_flow()}
        shape["dt"] = 1.0 if self.dt is None else float(self.dt)
        shape["processor"] = 6 if self.processor is None else self.processor
        if self.scheme is None and self.stages is None:
            shape["stages"] = 3
        flow = SympFlow.primed(system, **shape)
        if earlier is not None:
            assert isinstance(earlier, PrimedFlow)
            flow.take_over(earlier)
        return flow


@dataclass(frozen=True, kw_only=True)
class SplitFit(Fit):
    """A split flow of a stiff system, of the exact flows of the parts of H, fitted to the exact flow.

    The label times Δt sin(πj/2J) are dense towards Δt, where polynomials are least accurate between labels.

    Parameters
    ----------
    dt, turn : float
        Δt, or, where it is left out, Δt times the fastest frequency.
    stages, terms, force_gradient
        Of the new flow, see `SympFlow.split`.
    frozen_weight : float
        Weight of the residuals at t = Δt; those at other times have 1.
    loss : str, optional
        "labels", the only one.
    points, label_times, seed, reference_states
        See `Fit`.
    """

    points: int = option(count, 150)
    label_times: int = option(count, 16)
    turn: float = option(check_positive, 10.0, of_flow=True)
    stages: int = option(default=4, of_flow=True)
    terms: int = option(default=8, of_flow=True)
    force_gradient: Which | None = option(of_flow=True)
    frozen_weight: float = option(check_positive, 30.0)
    loss: str | None = None

    kind: ClassVar[str] = "split"
    OPEN: ClassVar[dict[str, int]] = {"restarts": 8, "steps": 150}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loss not in (None, "labels"):
            raise ValueError(f"`loss` {self.loss!r} is not one that Gauss–Newton fits split flows by: use 'labels'.")

    def flow(self, system: HamiltonianSystem, domain: Domain | None = None, earlier: FlowMap | None = None) -> Any:
        dt = self.turn / float(system.linear_part.frequencies.max()) if self.dt is None else self.dt
        return SympFlow.split(system, self.stages, dt=dt, terms=self.terms, force_gradient=self.force_gradient)


@dataclass(frozen=True, kw_only=True)
class LossFit(_LossFit):
    """Any flow, trained further by losses at points, step by step: `train(system, LossFit(), flow=flow)`.

    Parameters
    ----------
    points : int, optional
        Collocation points of each of the first two losses, in a step; by default 700 for Adam, 1500 for Gauss–Newton,
        4000 for BFGS.
    loss : str, optional
        Some of "residual", "matching" and "labels", joined by "+"; the others get the weight 0.
    residual_weight, matching_weight, label_weight : float, optional
        Weights of the residual of the flow, Hamiltonian matching, and labels; 0 leaves a loss out. The defaults are 1,
        1 (0 for Gauss–Newton and for a baseline, which has no Hamiltonian), and 0, 1 with `data`.
    matching_times : int
        Number of distinct times in the second, each with points / matching_times states (to remove 𝓗's free c(t)).
    label_times : int
        Number of equidistant times in (0, Δt]; at each of them `points` states are labelled. Each step uses `points` of
        these labels.
    data : (array (n,), array (n, 2d), array (n, 2d)), optional
        Labels of your own; a tenth is held out.
    validation_points : int
        Held-out points of the losses.
    seed, reference_states
        See `Fit`.
    """

    validation_points: int = option(count, 2000)

    kind: ClassVar[str] = "losses"
    OPEN: ClassVar[dict[str, int]] = {"steps": 200}

    def resolved(self, solver: Solver, kind: str) -> Self:
        if self.loss is not None:
            weights = self._named(self.loss)
        else:
            matched = kind != "mlp" and not isinstance(solver, GaussNewton)
            defaults = 1.0, float(matched), float(self.data is not None)
            given = (getattr(self, name) for name in WEIGHTS)
            weights = {n: d if w is None else w for n, w, d in zip(WEIGHTS, given, defaults, strict=True)}
        if kind == "mlp" and weights["matching_weight"]:
            raise ValueError("`matching_weight` needs a Hamiltonian, which an MLP flow does not have: leave it out.")
        check_weights(**weights)
        found = replace(self, points=self.points or solver.POINTS, loss=None, **weights)
        if found.matching_times > min(found.points or 0, found.validation_points) // 2:
            raise ValueError("`matching_times` must leave two points for each time: make it at most half of `points`.")
        return found


@dataclass(frozen=True, kw_only=True)
class NetworkFit(LossFit):
    """A new SympFlow with MLP potentials, or the unconstrained baseline, trained on losses at points.

    Parameters
    ----------
    dt : float, optional
        Δt, 1 by default.
    pairs, hidden, activation, dtype, device
        See `SympFlow`; a baseline has as many parameters as the SympFlow that they describe.
    baseline : bool
        True for an `MLPFlow`.
    points, loss, residual_weight, matching_weight, label_weight, matching_times, label_times, data, validation_points,
    seed, reference_states
        See `LossFit`.
    """

    pairs: int = option(default=3, of_flow=True)
    hidden: Sequence[int] = option(default=(10, 10), of_flow=True)
    activation: str = option(default="tanh", of_flow=True)
    dtype: torch.dtype = option(default=torch.float64, of_flow=True)
    device: torch.device | str | None = option(of_flow=True)
    baseline: bool = option(default=False, of_flow=True)

    @property
    def kind(self) -> str:  # type: ignore[override]
        return "mlp" if self.baseline else "sympflow"

    def network(self, system: HamiltonianSystem, dt: float, scaling: Scaling) -> FlowMap:
        """The network in these units.

        Raises
        ------
        ValueError
            If no baseline has as many parameters.
        """
        like: Any = {"dtype": self.dtype, "device": self.device, "seed": self.seed, "scale": scaling}
        drawn: Any = {"hidden": self.hidden, "activation": self.activation, "dt": dt, "drive": Drive.of(system)}
        flow = SympFlow(system.ndof, self.pairs, **drawn, **like)
        if not self.baseline:
            return flow
        if matching_widths(flow.ndof, flow.n_parameters) is None:
            raise ValueError(
                f"`hidden` and `pairs` describe a SympFlow of only {flow.n_parameters} parameters, which no "
                "MLPFlow matches within 2 %: give wider layers or more pairs."
            )
        return MLPFlow.matching(flow, self.seed, scaling, self.activation)


@dataclass(frozen=True, kw_only=True)
class ClockedFit(Fit):
    """A splitting scheme on the logarithmic Hamiltonian, with a trained clock: see `sympflow.flow.clocked`.

    Parameters
    ----------
    dt : float, optional
        The physical length of the longest step, as the `dt` of methods by the clock "logarithmic"; 1 by default.
    scheme, terms
        See `ClockedFlow`.
    points, label_times : int
        Seeded states of the domain, and steps at which each is labelled.
    seed, reference_states
        See `Fit`.
    """

    points: int = option(count, 100)
    label_times: int = option(count, 12)
    scheme: str = option(default="leapfrog", of_flow=True)
    terms: int = option(default=10, of_flow=True)

    kind: ClassVar[str] = "clocked"


@dataclass(frozen=True, kw_only=True)
class KeplerFit(Fit):
    """A flow of planets: Wisdom–Holman steps in trained coordinates, see `sympflow.flow.planetary`.

    Parameters
    ----------
    dt : float, optional
        Δt; by default the longest up to a quarter of the shortest period with an error of at most `tol`.
    tol : float
        Relative energy error, where `dt` is left out.
    reach, gradients : int
        The processor takes `reach` steps to either side of a state, and has this number of force gradients.
    points : int
        States along the orbit of `y0`, at random times.
    orbits : float
        The time over which the points are spread, in periods of the innermost planet.
    seed
        Of these times.
    """

    points: int = option(count, 1500)
    tol: float = option(check_positive, 1e-8)
    reach: int = option(count, 64, of_flow=True)
    gradients: int = option(default=8, of_flow=True)
    orbits: float = option(check_positive, 30_000.0)

    kind: ClassVar[str] = "kepler"

    def __post_init__(self) -> None:
        super().__post_init__()
        if type(plain(self.gradients)) is not int or not 0 <= self.gradients <= 2 * self.reach:
            raise ValueError(f"`gradients` must be an integer from 0 to twice `reach`; got {self.gradients!r}: take 8.")
        if self.points < 2 * self.reach + self.gradients:
            raise ValueError(f"`points` {self.points!r} are fewer than the numbers to fit: take 1500.")
        for name in ("label_times", "reference_states"):
            if name in self.given():
                raise TypeError(f"`{name}` is for fits to labels, and those of planets have none: leave it out.")


# plain keywords -------------------------------------------------------------------------------------------------

KINDS: dict[str, type[Fit]] = {"primed": PrimedFit, "sympflow": NetworkFit, "mlp": NetworkFit}
"""The fits of new flows, by the names that the keyword `kind` takes."""

FITTED: tuple[tuple[type[FlowMap], type[Fit]], ...] = ((PrimedFlow, PrimedFit), (SplitFlow, SplitFit))
"""The fits of given flows by Gauss–Newton; any other flow is trained on losses."""

DEFAULTS: dict[str, Any] = {"residual_weight": 1.0} | {
    f.name: f.default
    for cls in (LossFit, Adam)
    for f in fields(cls)
    if f.name
    in ("matching_times", "seed", "validation_points", "reference_states", "learning_rate", "schedule", "clip")
}
"""Values that mean the same as a keyword that is left out, for every fit and solver."""

OF_NETWORKS = [n for n in NetworkFit.of_flow() if n not in (*PrimedFit.of_flow(), "baseline")]
OF_PRIMED = [n for n in PrimedFit.of_flow() if n not in NetworkFit.of_flow()]
OF_SEARCHES = ("restarts", "frozen_weight", "energy_weight", "runs")


def keywords() -> list[str]:
    """All keywords that some fit or solver takes."""
    of_fits = [name for cls in (PrimedFit, NetworkFit, KeplerFit) for name in cls.names() if name != "baseline"]
    return list(dict.fromkeys(["kind", "optimizer", *of_fits, *(n for cls in SOLVERS.values() for n in cls.names())]))


def said(options: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords with an effect: not those that are None or equal to the default."""
    kept = {name: plain(value) for name, value in options.items() if value is not None or name == "clip"}
    return {name: value for name, value in kept.items() if name not in DEFAULTS or value != DEFAULTS[name]}


def from_keywords(options: Mapping[str, Any], kind: str, by: str | None, flow: FlowMap | None) -> tuple[Fit, Solver]:
    """The fit and the solver, named `by` the keyword `optimizer`, of a new flow of a kind, or of a given one."""
    searches = by in (None, GaussNewton.name)
    made = KINDS[kind] if flow is None else LossFit
    if searches and flow is not None:
        made = next((fit for family, fit in FITTED if isinstance(flow, family)), LossFit)
    elif not searches and kind == "primed":
        made = LossFit
    search = issubclass(made, PrimedFit | SplitFit)
    name = by or (GaussNewton.name if search else Adam.name)
    check_one_of("optimizer", name, SOLVERS)
    solver = SOLVERS[name]
    of_solver = ["steps", "restarts"] if search else [n for n in solver.names() if n != "restarts"]
    of_fit = [n for n in made.names() if n != "baseline"]
    what = f"the optimizer {name!r} for {f'{kind} flows' if search else f'flows of kind {kind!r}'}"
    for each in (n for n in options if n not in (*of_fit, *of_solver)):
        raise TypeError(
            f"`{each}` is not an option of {what}: leave it out. There are {', '.join(of_solver + of_fit)}."
        )
    more = {"baseline": True} if kind == "mlp" and flow is None else {}
    fit = made(**{n: v for n, v in options.items() if n in of_fit}, **more)
    return fit, solver(**{n: v for n, v in options.items() if n in of_solver})
