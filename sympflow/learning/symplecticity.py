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

import numpy as np

from sympflow.learning.diagnosis import DRAG, DRIVEN, TURNED
from sympflow.learning.lagrangian import lagrangian_start
from sympflow.learning.models import FreeField, Model, drags, frictions, turns
from sympflow.learning.orbits import Field
from sympflow.learning.parts import Drive
from sympflow.learning.reading import Run
from sympflow.learning.shooting import increments_left, matched
from sympflow.learning.smoothing import Smooth, smoothed
from sympflow.learning.trajectories import Trajectories
from sympflow.training.least_squares import Stop, never

DEGREES = (1, 2, 3)
"""Degrees of the polynomial fields that need not be Hamiltonian."""
DOUBTFUL, DAMPED = 0.6, 0.9
"""Share of the squares of increments, left by another reading of the data, or by forces beside those of H, below which
orbits are to decide."""
PLAINER = 1.5
"""Factor by which friction or another order of columns may leave more than a field without any structure, and one that
stands before another in the list may leave more."""
POINTS = 24
"""Number of points of a piece whose increments are compared."""
LONG = 10
"""Such pieces in a part of a trajectory that is smoothed."""
COMPARED = 2000
"""Points of trajectories that are compared."""
PER_NUMBER = 3.0
"""Values that there are at least for a number of a model."""
MOST_NUMBERS = 400


@dataclass(frozen=True)
class Reading:
    """Another explanation of the data than a Hamiltonian in the coordinates as they are."""

    field: Field
    rows: tuple[int, ...]  # The order in which it takes the coordinates
    share: float  # Squares of held-out increments that it leaves, over those of the best Hamiltonian
    said: str  # The explanation in words
    advice: str = ""  # What to do then, with a place for the numbers of the forces
    numbers: slice | None = None  # The places of the factors of forces beside those of H

    def of(self, data: Trajectories) -> Trajectories:
        """The data with the coordinates in this order."""
        names = tuple(data.names[i] for i in self.rows)
        return replace(data, runs=tuple(Run(run.t, run.y[[*self.rows]]) for run in data.runs), names=names)

    def remedy(self, theta: np.ndarray) -> str:
        """Advice, with the factors of the forces that were found."""
        if self.said == DRIVE[0]:
            return self.advice.format(*2 * [f"{self.field.frequency(theta):.5g}"])
        return self.advice.format(", ".join(f"{factor:.3g}" for factor in theta[self.numbers or slice(0)]))

    def possible(self, theta: np.ndarray) -> bool:
        """True unless friction or drag would feed energy."""
        return self.said not in (FRICTION[0], DRAG_SAID[0]) or bool(theta[self.numbers or slice(0)].sum() > 0)

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


FRICTION = (
    "the best H with friction p' = -γp",
    "There is friction, γ = {}: areas of phase space shrink as exp(-γt). Pass damping=True to `learn`.",
)
DRAG_SAID = "the best H with a drag p' = -c|p|p", DRAG
TURNED_SAID = "the best H with a force that turns p", TURNED
DRIVE = "the best H with a drive", DRIVEN
PAIRS = ("the same in the order q1, p1, q2, p2, … of columns", 'The columns look like that: pass order="pairs".')


def forced(model: Model, drive: Drive | None = None) -> list[Reading]:
    """The model with forces that no H(q, p) gives: friction, what turns p, quadratic drag, a drive; from plain to rich.

    Of a model that has a force only a drive is of interest.
    """
    d = model.ndof
    rows = tuple(range(2 * d))
    forces = [(frictions, FRICTION), (turns, TURNED_SAID), (drags, DRAG_SAID)]
    made = []
    for force, said in forces[: 1 if model.velocities else 3]:  # among those of velocities are magnetic fields
        if model.force is None and (force is not turns or d > 1):
            with_force = replace(model, force=force)
            made.append(Reading(with_force, rows, math.inf, *said, slice(model.n, with_force.n)))
    if drive is not None and model.drive is None:
        driven = replace(model, parts=(*model.parts, drive))
        made.append(Reading(driven, rows, math.inf, *DRIVE, driven.places[-1]))
    return made


def free_reading(scales: np.ndarray, degree: int) -> Reading:
    """A field of polynomials that need not be Hamiltonian."""
    said = "a vector field of polynomials that need not be Hamiltonian"
    return Reading(FreeField(scales, degree), tuple(range(len(scales))), math.inf, said)


def best_by_increments(
    data: Trajectories,
    held: Trajectories,
    models: Sequence[Model],
    drive: Drive | None = None,
    stop: Stop = never,
) -> tuple[int, Reading | None, dict[int, float]] | None:
    """The place of the model that explains held-out increments best, a doubt, if any, and the squares by places.

    The doubt is a reading of the data that leaves much less than all models. None in place of all for too few points.
    """
    scales, d = data.scales, data.ndof
    fitted, others = _smooth(data), _smooth(held)
    affordable = [k for k, model in enumerate(models) if _affords(fitted, model)]
    if not affordable or not others.runs:
        return None
    smooth = smoothed(fitted) if any(model.velocities or model.lagrangian for model in models) else None
    squares = {k: _left(models[k], fitted, others, scales, smooth) for k in affordable if not stop()}
    if not squares:
        return None
    best = min(squares, key=lambda k: squares[k])
    if not 0 < squares[best] < math.inf:
        return best, None, squares

    def compared(reading: Reading) -> Reading:
        a, b = reading.of(fitted), reading.of(others)
        return replace(
            reading,
            share=_left(reading.field, a, b, scales[[*reading.rows]], smooth if reading.advice != PAIRS[1] else None)
            / squares[best],
        )

    free = [free_reading(scales, degree) for degree in DEGREES]
    found = [compared(reading) for reading in free if _affords(fitted, reading.field)]
    plain = [reading for k in squares for reading in forced(models[k], drive) if _affords(fitted, reading.field)]
    if d > 1 and not data.velocities:
        turned = (*range(0, 2 * d, 2), *range(1, 2 * d, 2))
        plain += [Reading(models[k], turned, math.inf, *PAIRS) for k in squares]
    plain = [compared(reading) for reading in plain if not stop()]
    least, freest = (min((reading.share for reading in some), default=math.inf) for some in (plain, found))
    kinds = {kind: [r for r in plain if r.said == kind] for kind, _ in (FRICTION, TURNED_SAID, DRAG_SAID, PAIRS, DRIVE)}
    for some in kinds.values():  # the plainest that is about as good as the best
        likeliest = min(some, key=lambda reading: reading.share, default=None)
        if likeliest is not None and likeliest.share <= min(PLAINER * least, PLAINER * freest):
            return best, (likeliest if likeliest.share < (DAMPED if likeliest.numbers else DOUBTFUL) else None), squares
    likeliest = min(found, key=lambda reading: reading.share, default=None)
    return best, (likeliest if likeliest is not None and likeliest.share < DOUBTFUL else None), squares


def _affords(data: Trajectories, model: Field) -> bool:
    return model.n <= MOST_NUMBERS and PER_NUMBER * model.n < data.n_values


def _left(
    model: Field, data: Trajectories, held: Trajectories, scales: np.ndarray, smooth: Smooth | None = None
) -> float:
    """The squares that a model which was fitted to increments leaves of held-out ones; infinite where it diverges."""
    theta, moved = np.zeros(model.n), data
    if model.velocities or model.lagrangian:
        assert isinstance(model, Model)
        theta, moved = lagrangian_start(model, data, model.start(np.random.default_rng(0)), smooth)
    if model.linear:
        theta = matched(model, theta, moved, 1 / moved.scales)
    squares = increments_left(model, theta, held, 1 / scales)
    return squares if math.isfinite(squares) else math.inf


def _smooth(data: Trajectories) -> Trajectories:
    """Pieces of smoothed trajectories, evenly chosen."""
    pieces = data.pieces(LONG * POINTS)
    n = max(1, min(len(pieces.runs), COMPARED * len(pieces.runs) // max(pieces.n_points, 1)))
    some = pieces.subset(np.unique(np.linspace(0, len(pieces.runs) - 1, n).astype(int)).tolist())
    curves = smoothed(some).states
    runs = tuple(Run(run.t, y) for run, y in zip(some.runs, curves, strict=True) if run.n_points > 1)
    return replace(some, runs=runs).pieces(POINTS)
