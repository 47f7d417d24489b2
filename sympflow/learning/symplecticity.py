"""The test whether any Hamiltonian explains the data, which takes a second and stands before all fits.

Fields are compared by increments: y(t) − ∫ f(y) dt along a smoothed trajectory is constant if f is its field. Of an f
that is linear in its numbers that is linear least squares, and no orbit is computed.

References
----------
.. [1] D. A. Messenger, D. M. Bortz, Weak SINDy: Galerkin-based data-driven model selection, Multiscale Model. Simul. 19
   (2021) 1474–1497, for integrals in place of derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from sympflow.learning.diagnosis import DRAG, TURNED, driven_by
from sympflow.learning.lagrangian import lagrangian_start
from sympflow.learning.models import FreeField, Model, drags, frictions, turns
from sympflow.learning.orbits import Field
from sympflow.learning.parts import Drive
from sympflow.learning.reading import Run
from sympflow.learning.shooting import increments_left, matched
from sympflow.learning.trajectories import Trajectories
from sympflow.training.least_squares import Stop, never

DEGREES = (1, 2, 3)  # Degrees of the polynomial fields that need not be Hamiltonian
DOUBTFUL, DAMPED = 0.6, 0.9
"""Share of the squares of increments, left by another reading of the data, or by forces beside those of H, below which
orbits are to decide."""
PLAINER = 1.5
"""Factor by which friction or another order of columns may leave more than a field without any structure, and one that
stands before another in the list may leave more."""
POINTS = 24  # Number of points of a piece whose increments are compared
LONG = 10  # Such pieces in a part of a trajectory that is smoothed
COMPARED = 2000  # Points of trajectories that are compared
PER_NUMBER = 3.0  # Values that there are at least for a number of a model
MOST_NUMBERS = 400
LIKELY = 8  # Models beside which forces are tried


class Cause(Enum):
    """Reasons why no H(q, p) explains data, each in words and with advice that has a place for the factors of forces.

    The plainest come first.
    """

    FRICTION = (
        "the best H with friction p' = -γp",
        "There is friction, γ = {}: areas of phase space shrink as exp(-γt). Pass damping=True to `learn`.",
    )
    TURNED = "the best H with a force that turns p", TURNED
    DRAG = "the best H with a drag p' = -c|p|p", DRAG
    PAIRS = "the same in the order q1, p1, q2, p2, … of columns", 'The columns look like that: pass order="pairs".'
    DRIVE = "the best H with a drive", ""
    FREE = "a vector field of polynomials that need not be Hamiltonian", ""

    def __init__(self, said: str, advice: str) -> None:
        self.said, self.advice = said, advice


DISSIPATIVE = (Cause.FRICTION, Cause.DRAG)


@dataclass(frozen=True)
class Reading:
    """Another explanation of the data than a Hamiltonian in the coordinates as they are."""

    cause: Cause
    field: Field
    rows: tuple[int, ...]  # The order in which it takes the coordinates
    numbers: slice | None = None  # The places of the factors of forces beside those of H
    share: float = math.inf  # Squares of held-out increments that it leaves, over those of the best Hamiltonian

    def of(self, data: Trajectories) -> Trajectories:
        """The data with the coordinates in this order."""
        if self.cause is not Cause.PAIRS:
            return data
        names = tuple(data.names[i] for i in self.rows)
        return replace(data, runs=tuple(Run(run.t, run.y[[*self.rows]]) for run in data.runs), names=names)

    @property
    def limit(self) -> float:
        """The share below which orbits are to decide."""
        return DAMPED if self.numbers else DOUBTFUL

    def factors(self, theta: np.ndarray) -> np.ndarray:
        """The factors of the forces."""
        return theta[self.numbers or slice(0)]

    def remedy(self, theta: np.ndarray) -> str:
        """Advice, with the factors of the forces that were found."""
        if self.cause is Cause.DRIVE:
            return driven_by(self.field.frequencies(theta))
        return self.cause.advice.format(", ".join(f"{factor:.3g}" for factor in self.factors(theta)))

    def possible(self, theta: np.ndarray) -> bool:
        """True unless friction or drag would feed energy."""
        return self.cause not in DISSIPATIVE or bool(self.factors(theta).sum() > 0)

    def test(self, theta: np.ndarray, states: np.ndarray, scales: np.ndarray) -> tuple[float, float]:
        """LᵀJ + JL over twice JL, 0 for any H, at states (2d, n) in the order of the reading; the rate of volumes."""
        slopes = self.field.field(theta, states, True, False).slope
        assert slopes is not None
        back = np.argsort(self.rows)
        slopes = slopes[np.ix_(back, back)]
        d = len(scales) // 2
        ratio = np.sqrt(scales[:d] / scales[d:])
        units = np.concatenate([ratio, 1 / ratio])  # in which dq∧dp remains as it is
        L = slopes * (units / units[:, None])[..., None]
        JL = np.concatenate([L[d:], -L[:d]])
        defect = float(np.linalg.norm(JL - JL.transpose(1, 0, 2)) / (2 * np.linalg.norm(JL)))
        return defect, float(np.einsum("iin->n", slopes).mean())


def forced(model: Model, drives: Sequence[Drive] = ()) -> list[Reading]:
    """The model with forces that no H(q, p) gives: friction, what turns p, quadratic drag, drives; from plain to rich.

    Of a model that has a force only a drive is of interest.
    """
    rows = tuple(range(2 * model.ndof))
    forces = [(frictions, Cause.FRICTION), (turns, Cause.TURNED), (drags, Cause.DRAG)]
    made = []
    for force, cause in forces[: 1 if model.velocities else 3]:  # among those of velocities are magnetic fields
        if model.force is None and (force is not turns or model.ndof > 1):
            with_force = replace(model, force=force)
            made.append(Reading(cause, with_force, rows, slice(model.n, with_force.n)))
    if drives and not model.drives:
        driven = replace(model, parts=(*model.parts, *drives))
        numbers = slice(driven.places[len(model.parts)].start, driven.places[-1].stop)
        made.append(Reading(Cause.DRIVE, driven, rows, numbers))
    return made


def free_reading(scales: np.ndarray, degree: int) -> Reading:
    """A field of polynomials that need not be Hamiltonian."""
    return Reading(Cause.FREE, FreeField(scales, degree), tuple(range(len(scales))))


def best_by_increments(
    data: Trajectories,
    held: Trajectories,
    models: Sequence[Model],
    drives: Sequence[Drive] = (),
    stop: Stop = never,
) -> tuple[int, Reading | None, dict[int, float]] | None:
    """The place of the model that explains held-out increments best, a doubt, if any, and the squares by places.

    The doubt is a reading of the data that leaves much less than all models. None in place of all for too few points.
    """
    scales, d = data.scales, data.ndof
    fitted, others = sample(data), sample(held)
    affordable = [k for k, model in enumerate(models) if affords(fitted, model)]
    if not affordable or not others.runs:
        return None
    squares = {k: _left(models[k], fitted, others, scales) for k in affordable if not stop()}
    if not squares:
        return None
    best = min(squares, key=lambda k: squares[k])
    if not 0 < squares[best] < math.inf:
        return best, None, squares
    readings = [free_reading(scales, degree) for degree in DEGREES]
    likely = sorted(squares, key=lambda k: squares[k])[:LIKELY]
    readings += [reading for k in likely for reading in forced(models[k], drives)]
    readings = [reading for reading in readings if affords(fitted, reading.field)]
    if d > 1 and not data.velocities:
        turned = (*range(0, 2 * d, 2), *range(1, 2 * d, 2))
        readings += [Reading(Cause.PAIRS, models[k], turned) for k in squares]
    likeliest: dict[Cause, Reading] = {}
    for reading in readings:
        if stop() and reading.cause is not Cause.FREE:
            continue
        left = _left(reading.field, reading.of(fitted), reading.of(others), scales[[*reading.rows]])
        if reading.cause not in likeliest or left / squares[best] < likeliest[reading.cause].share:
            likeliest[reading.cause] = replace(reading, share=left / squares[best])
    least = min((reading.share for reading in likeliest.values()), default=math.inf)
    ordered = [likeliest[cause] for cause in Cause if cause in likeliest]  # the plainest that is about as good
    doubt = next((r for r in ordered if r.share <= (1.0 if r.cause is Cause.FREE else PLAINER) * least), None)
    return best, doubt if doubt is not None and doubt.share < doubt.limit else None, squares


def affords(data: Trajectories, model: Field) -> bool:
    """Return True if there are numbers enough for a model."""
    return model.n <= MOST_NUMBERS and PER_NUMBER * model.n < data.n_values


def _left(model: Field, data: Trajectories, held: Trajectories, scales: np.ndarray) -> float:
    """The squares that a model which was fitted to increments leaves of held-out ones; infinite where it diverges."""
    theta, moved = np.zeros(model.n), data
    if model.velocities or model.lagrangian:
        assert isinstance(model, Model)
        theta, moved = lagrangian_start(model, data, model.start(np.random.default_rng(0)))
    if model.linear:
        theta = matched(model, theta, moved, 1 / moved.scales)
    squares = increments_left(model, theta, held, 1 / scales)
    return squares if math.isfinite(squares) else math.inf


def sample(data: Trajectories) -> Trajectories:
    """Return pieces of smoothed trajectories, evenly chosen."""
    pieces = data.pieces(LONG * POINTS)
    n = max(1, min(len(pieces.runs), COMPARED * len(pieces.runs) // max(pieces.n_points, 1)))
    some = pieces.subset(np.unique(np.linspace(0, len(pieces.runs) - 1, n).astype(int)).tolist())
    runs = tuple(Run(run.t, y) for run, y in zip(some.runs, some.smooth.states, strict=True) if run.n_points > 1)
    return replace(some, runs=runs).pieces(POINTS)
