"""Reasons why no Hamiltonian explains data: friction, drives, velocities, columns in another order, none at all.

Before all fits fields are compared by increments: y(t) − ∫ f(y) dt along a smoothed trajectory is constant if f is its
field. Of an f that is linear in its numbers that is linear least squares, and no orbit is computed. Hints, where the
best model leaves more than noise, are regressions of smoothed slopes with more freedom, or with rows in another order.

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
from typing import Self

import numpy as np
from scipy.optimize import minimize_scalar

from sympflow.learning.lagrangian import lagrangian_start, least
from sympflow.learning.library import Library, library_for, polynomials
from sympflow.learning.models import Force, FreeField, Model, drags, friction, frictions, turns
from sympflow.learning.orbits import Field
from sympflow.learning.parts import Drive, Polynomial
from sympflow.learning.reading import Run
from sympflow.learning.shooting import increments_left, matched
from sympflow.learning.smoothing import Smooth
from sympflow.learning.trajectories import Trajectories
from sympflow.training.least_squares import Stop, never

DEGREES = (1, 2, 3)  # Degrees of the polynomial fields that need not be Hamiltonian
DOUBTFUL, DAMPED = 0.6, 0.9
"""Share of the squares of increments, left by another reading of the data, or by forces beside those of H, below which
orbits are to decide."""
PLAINER = 1.5
"""Factor by which friction or another order of columns may leave more than a field without any structure, and one that
stands before another in the list may leave more."""
PER_NUMBER = 3.0  # Values that there are at least for a number of a model
MOST_NUMBERS = 400
LIKELY = 8  # Models beside which forces are tried
BETTER = 0.5  # Share of the misfit that another reading of the data must leave at most, to be worth a word
MUCH_BETTER = 0.1  # the same of a vector field that is not Hamiltonian: a sum that has more terms leaves less by itself
ALIKE = 1.2  # Factor by which a reading may leave more than the best, and is named if it stands before it
FRICTION = (
    "Friction p' = -γp with γ = {} would leave much less: the data are dissipative, areas of phase space shrink as "
    "exp(-γt), and no symplectic map explains them. Learn a flow with damping."
)
TURNED = (
    "The second half looks like velocities in a uniform magnetic field, by which p_i' = B p_j, p_j' = -B p_i with "
    "B = {} for i < j. These are not momenta, which with a mass m are p_i - m B q_j/2 and p_j + m B q_i/2: pass "
    'observed="qv" to `learn`, which finds both.'
)
DRAG = 'Quadratic drag p\' = -c|p|p with c = {} would leave much less: pass damping="quadratic" to `learn`.'
DRIVEN = (
    "Forces or stiffnesses of the angular frequency {} would leave much less: the data look driven, by an H(q, p, t). "
    "Pass drive={} to `learn`."
)
NOT_HAMILTONIAN = (
    "A vector field of cubic polynomials that is not Hamiltonian fits much better: the data are not a motion of a "
    "Hamiltonian in these coordinates, or these are not canonical."
)
FREQUENCIES = 1000  # halves of the angular frequency π over the longest time, up to which that of a drive is looked for
MOST_SLOPES = 3000  # Points by which reasons are looked for
MOST_DRIVES, SWEEPS = 2, 2
"""Drives that are looked for, and how often the frequency of each is refined beside the others."""


# by increments --------------------------------------------------------------------------------------------------------


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
    theta: np.ndarray | None = None  # The numbers of its field, fitted to increments

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
        back = np.argsort(self.rows)
        slopes = self.field.field(theta, states, True, False).slope[np.ix_(back, back)]
        d = len(scales) // 2
        ratio = np.sqrt(scales[:d] / scales[d:])
        units = np.concatenate([ratio, 1 / ratio])  # in which dq∧dp remains as it is
        L = slopes * (units / units[:, None])[..., None]
        JL = np.concatenate([L[d:], -L[:d]])
        defect = float(np.linalg.norm(JL - JL.transpose(1, 0, 2)) / (2 * np.linalg.norm(JL)))
        return defect, float(np.einsum("iin->n", slopes).mean())


def forced(model: Model, drives: Sequence[Drive] = ()) -> list[Reading]:
    """The model with forces that no H(q, p) gives: friction, what turns p, quadratic drag, drives; from plain to rich.

    For a model that has a force only drives are tried, and drag in place of friction.
    """
    rows = tuple(range(2 * model.ndof))
    forces = [(frictions, Cause.FRICTION), (drags, Cause.DRAG)]
    if model.ndof > 1 and not model.velocities:  # among the models of velocities are magnetic fields
        forces.insert(1, (turns, Cause.TURNED))
    made = []
    for force, cause in forces:
        if model.force is None or (force is drags and model.force in (friction, frictions)):
            with_force = replace(model, force=force)
            made.append(Reading(cause, with_force, rows, slice(model.n - model.forces, with_force.n)))
    if drives and not model.drives:
        driven = replace(model, parts=(*model.parts, *drives))
        numbers = slice(driven.places[len(model.parts)].start, driven.places[-1].stop)
        made.append(Reading(Cause.DRIVE, driven, rows, numbers))
    return made


def free_reading(scales: np.ndarray, degree: int) -> Reading:
    """A field of polynomials that need not be Hamiltonian."""
    return Reading(Cause.FREE, FreeField(scales, degree), tuple(range(len(scales))))


def best_by_increments(
    data: Trajectories, held: Trajectories, models: Sequence[Model], drives: Sequence[Drive] = (), stop: Stop = never
) -> tuple[int, Reading | None, dict[int, float]] | None:
    """The place of the plainest of the models that explain held-out increments best, a doubt, and squares by places.

    The doubt, if any, is a reading of the data that leaves much less than all models. None in place of all for too few
    points.
    """
    scales, d, fitted, others = data.scales, data.ndof, data.sample, held.sample
    affordable = [k for k, model in enumerate(models) if affords(fitted, model)]
    if not affordable or not others.runs:
        return None
    squares = {k: _left(models[k], fitted, others, scales)[0] for k in affordable if not stop()}
    if not squares:
        return None
    fewest = min(squares.values())
    best = min((k for k in squares if squares[k] <= ALIKE * fewest), key=lambda k: models[k].n)
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
        left, theta = _left(reading.field, reading.of(fitted), reading.of(others), scales[[*reading.rows]])
        if reading.cause not in likeliest or left / squares[best] < likeliest[reading.cause].share:
            likeliest[reading.cause] = replace(reading, share=left / squares[best], theta=theta)
    least = min((reading.share for reading in likeliest.values()), default=math.inf)
    ordered = [likeliest[cause] for cause in Cause if cause in likeliest]  # the plainest that is about as good
    doubt = next((r for r in ordered if r.share <= (1.0 if r.cause is Cause.FREE else PLAINER) * least), None)
    return best, doubt if doubt is not None and doubt.share < doubt.limit else None, squares


def affords(data: Trajectories, model: Field) -> bool:
    """Return True if there are numbers enough for a model."""
    return model.n <= MOST_NUMBERS and PER_NUMBER * model.n < data.n_values


def _left(model: Field, data: Trajectories, held: Trajectories, scales: np.ndarray) -> tuple[float, np.ndarray]:
    """The squares that a model fitted to increments leaves of held-out ones, infinite if it diverges; its numbers."""
    theta, moved = np.zeros(model.n), data
    if model.velocities or model.lagrangian:
        assert isinstance(model, Model)
        theta, moved = lagrangian_start(model, data, model.start(np.random.default_rng(0)))
    if model.linear:
        theta = matched(model, theta, moved, 1 / moved.scales)
    squares = increments_left(model, theta, held, 1 / scales)
    return (squares if math.isfinite(squares) else math.inf), theta


# by slopes -----------------------------------------------------------------------------------------------------------


def hint(
    library: Library, smooth: Smooth, data: Trajectories, force: Force | None = None, drives: Sequence[Drive] = ()
) -> str | None:
    """The likeliest reason why the terms do not explain the data, with the remedy; None for none.

    A force and drives that the model has already are not a reason; nor is friction beside any force.
    """
    d = data.ndof
    scales = data.scales
    smooth = smooth.some(MOST_SLOPES)
    x, v = smooth.points, smooth.slopes
    X = library.fields(x)
    if force is not None:
        X = np.concatenate([X, fields_of(force, x)], 2)
    X = np.concatenate([X, *(fields_of_drive(drive, smooth) for drive in drives)], 2)
    rest = Rest.of(X, v, scales)
    found: list[tuple[float, str]] = []
    whole = library_for(None, d, 4, x)[0]
    widest = Rest.of(whole.fields(x), v, scales).squares
    if not {*whole.expressions} <= {*library.expressions}:
        found.append((widest, "Terms outside of the library fit much better: leave `terms` out, or give others."))
    for cause, said in ((frictions, FRICTION), (turns, TURNED), (drags, DRAG)):
        if cause is force or (cause is frictions and force is not None) or (cause is turns and d == 1):
            continue
        left, theta = rest.beside(fields_of(cause, x))
        found.append((left, said.format(", ".join(f"{number:.3g}" for number in theta))))
    if d > 1:
        pairs = [*range(0, 2 * d, 2), *range(1, 2 * d, 2)]
        with np.errstate(all="ignore"):
            other = library.fields(x[:, pairs])
        if np.isfinite(other).all():
            left = Rest.of(other, v[:, pairs], scales[pairs]).squares
            found.append((left, 'The columns look like q1, p1, q2, p2, …: pass order="pairs".'))
        left, masses = _masses(library, x, v, scales, d)
        said = f"velocities, of masses {' : '.join(f'{m:.3g}' for m in masses)}"
        found.append((left, f"The second half looks like {said}: pass velocity_mass=[…], by which p = M v."))
    share, frequencies = driven(X, smooth, scales, Drive(Polynomial.up_to(2, "q", scales[:d]), 1.0), drives)
    found.append((share * rest.squares, driven_by([*(drive.frequency for drive in drives), *frequencies])))
    least = min(found)[0]
    best = next(one for one in found if one[0] <= ALIKE * least)
    if best[0] < BETTER * rest.squares:
        return best[1]
    free = np.concatenate([np.ones((len(x), 1)), Library(polynomials(d, 3), d).values(x)], 1)
    if 4 * free.shape[1] < len(x):
        c = np.linalg.lstsq(free, v, rcond=None)[0]
        if float((((v - free @ c) / scales) ** 2).sum()) < MUCH_BETTER * min(rest.squares, widest):
            return NOT_HAMILTONIAN
    return None


def driven_by(frequencies: Sequence[float]) -> str:
    """The remedy where drives of these angular frequencies explain the data."""
    said = [f"{frequency:.5g}" for frequency in frequencies]
    if len(said) == 1:
        return DRIVEN.format(*2 * said)
    return DRIVEN.replace("frequency", "frequencies").format(" and ".join(said), f"[{', '.join(said)}]")


def fields_of(force: Force, x: np.ndarray) -> np.ndarray:
    """The fields (n, 2d, k) of a force at states (n, 2d)."""
    return np.moveaxis(force(x.T)[0], -1, 0)


def fields_of_drive(drive: Drive, smooth: Smooth) -> np.ndarray:
    """The fields (n, 2d, k) of the terms of a drive at the points of curves."""
    d = smooth.points.shape[1] // 2
    by = drive.at(smooth.times).gradient(np.zeros(drive.n), smooth.points.T[:d], False, True).by_parameters
    forces = np.moveaxis(-by[:, :-1], -1, 0)
    return np.concatenate([np.zeros_like(forces), forces], axis=1)


@dataclass(frozen=True)
class Rest:
    """Slopes (n, 2d) without the part that fields (n, 2d, K) explain, each coordinate in its spread."""

    basis: np.ndarray  # (2dn, K): Orthonormal, of the fields
    left: np.ndarray  # (2dn,)
    scales: np.ndarray

    @classmethod
    def of(cls, X: np.ndarray, v: np.ndarray, scales: np.ndarray) -> Self:
        """The residuals of least squares."""
        A, y = _columns(X, scales)[0], (v / scales).ravel()
        basis, sizes, _ = np.linalg.svd(A, full_matrices=False)
        basis = basis[:, sizes > 1e-10 * sizes.max(initial=0.0)]
        return cls(basis, y - basis @ (basis.T @ y), scales)

    @property
    def squares(self) -> float:
        """Their sum of squares."""
        return float(self.left @ self.left)

    def beside(self, X: np.ndarray) -> tuple[float, np.ndarray]:
        """The sum of squares that is left where other fields (n, 2d, k) join, and their coefficients (k,)."""
        A, lengths = _columns(X, self.scales)
        A -= self.basis @ (self.basis.T @ A)
        U, sizes, V = np.linalg.svd(A, full_matrices=False)
        U, sizes, V = U[:, sizes > 1e-10], sizes[sizes > 1e-10], V[sizes > 1e-10]
        c = U.T @ self.left
        return float(((self.left - U @ c) ** 2).sum()), V.T @ (c / sizes) / lengths


def _columns(X: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fields (n, 2d, K) as columns (2dn, K) of length 1, each coordinate in its spread, and their lengths."""
    A = (X / scales[:, None]).reshape(-1, X.shape[2])
    lengths = np.linalg.norm(A, axis=0)
    lengths[lengths == 0] = 1.0
    return A / lengths, lengths


def drive_frequency(X: np.ndarray, smooth: Smooth, scales: np.ndarray, drive: Drive) -> float:
    """The angular frequency of the drive that explains most of the residuals of the slopes after the fields X (n, 2d,
    K).

    The peaks of the periodograms with each of its terms are compared by a fit of all, and the best is refined.
    """
    d = X.shape[1] // 2
    most = min(int(2 * smooth.longest / smooth.step), FREQUENCIES)
    frequencies = np.pi / smooth.longest * np.arange(0.5, max(most, 2) / 2, 0.25)
    beside = Rest.of(X, smooth.slopes, scales)
    pushes = drive.base.gradient(np.zeros(drive.base.n), smooth.points.T[:d], False, True).by_parameters
    pushes = pushes / scales[d:, None, None]
    terms = np.einsum("ikn,ni->nk", pushes, beside.left.reshape(len(X), -1)[:, d:])
    power = np.abs(np.exp(-1j * frequencies[:, None] * smooth.times) @ terms) ** 2 / (pushes**2).sum(axis=(0, 2))
    likely = frequencies[np.unique(power.argmax(axis=0))].tolist()
    return _refined(X, smooth, scales, drive, likely, 0.5 * np.pi / smooth.longest)


def _refined(
    X: np.ndarray, smooth: Smooth, scales: np.ndarray, drive: Drive, likely: Sequence[float], near: float
) -> float:
    """The angular frequency of a drive that leaves least, near the best of those that are likely."""
    beside = Rest.of(X, smooth.slopes, scales)

    def rest(frequency: float) -> float:
        return beside.beside(fields_of_drive(Drive(drive.base, frequency), smooth))[0]

    best = min(likely, key=rest)
    found = minimize_scalar(rest, bounds=(max(best - near, near / 2), best + near), method="bounded")
    return float(found.x if found.fun < rest(best) else best)


def driven(
    X: np.ndarray, smooth: Smooth, scales: np.ndarray, drive: Drive, known: Sequence[Drive] = ()
) -> tuple[float, list[float]]:
    """The share of squares that drives leave, and their ω; of other trajectories than those that they were fitted to.

    The share is infinite for one trajectory, whose own motion cannot be distinguished from a drive.
    """
    first, v, near = smooth.owner % 2 == 0, smooth.slopes, 0.5 * np.pi / smooth.longest

    def theirs(A: np.ndarray) -> float:
        c = least((A[first] / scales[:, None]).reshape(-1, A.shape[2]), (v[first] / scales).ravel())
        return float(((((v - A @ c) / scales)[~first]) ** 2).sum())

    def beside(frequencies: Sequence[float]) -> np.ndarray:
        drives = (Drive(drive.base, frequency) for frequency in frequencies)
        return np.concatenate([X, *(fields_of_drive(one, smooth) for one in drives)], axis=2)

    found: list[float] = []
    whole = before = theirs(X) if first.any() and not first.all() else 0.0
    for _ in range(MOST_DRIVES - len(known)):
        wide = X.shape[2] + (1 + len(found)) * drive.n
        if not before > 0 or first.sum() * X.shape[1] < PER_NUMBER * wide:
            break
        wider = [*found, drive_frequency(beside(found), smooth, scales, drive)]
        for k in [*range(len(wider))] * SWEEPS if found else ():  # each beside the others
            others = beside(wider[:k] + wider[k + 1 :])
            wider[k] = _refined(others, smooth, scales, drive, wider[k : k + 1], near)
        left = theirs(beside(wider))
        if found and left > BETTER * before:
            break
        found, before = wider, left
    return (before / whole if found else np.inf), found


def _masses(library: Library, x: np.ndarray, v: np.ndarray, scales: np.ndarray, d: int) -> tuple[float, np.ndarray]:
    """The misfit where q' are the second half itself and m_i v_i' a gradient in q; and m_i in units of m_1."""
    forces = library.gradients(x)[:, :d]
    of_q = [k for k, f in enumerate(library.expressions) if not any(s.name[0] == "p" for s in f.free_symbols)]
    V = forces[:, :, of_q]
    extra = np.zeros((len(x), d, d - 1))
    for i in range(1, d):
        extra[:, i, i - 1] = v[:, d + i]
    A = (np.concatenate([-V, -extra], 2) / scales[d:, None]).reshape(len(x) * d, -1)
    target = np.zeros((len(x), d))
    target[:, 0] = v[:, d]
    theta = least(A, (target / scales[d:]).ravel())
    masses = np.concatenate([[1.0], theta[len(of_q) :]])
    force = -(V @ theta[: len(of_q)])
    with np.errstate(all="ignore"):
        rest = ((force / masses - v[:, d:]) / scales[d:]) ** 2
    moving = ((x[:, d:] - v[:, :d]) / scales[:d]) ** 2
    total = float(rest.sum() + moving.sum())
    return (total if np.isfinite(total) and (masses > 0).all() else np.inf), masses
