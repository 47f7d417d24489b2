"""Hints where no Hamiltonian explains the data: friction, a drive, velocities, columns in another order, none at all.

Each is a regression of the smoothed slopes with more freedom, or with rows in another order, against the same without.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from sympflow.learning.library import Library, library_for, polynomials
from sympflow.learning.models import Force, drags, frictions, turns
from sympflow.learning.parts import Drive, Polynomial
from sympflow.learning.smoothing import Smooth
from sympflow.learning.trajectories import Trajectories

BETTER = 0.5
"""Share of the misfit that another reading of the data must leave at most, to be worth a word."""
MUCH_BETTER = 0.1
"""The same of a vector field that is not Hamiltonian: a sum that has more terms leaves less by itself."""
ALIKE = 1.2
"""Factor by which a reading may leave more than the best, and is named if it stands before it."""
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
PER_NUMBER = 4
"""Values of half of the trajectories that there are at least for a number of a fit with a drive."""
FREQUENCIES = 1000
"""Halves of the angular frequency π over the longest time, up to which that of a drive is looked for."""


def hint(
    library: Library,
    smooth: Smooth,
    data: Trajectories,
    otherwise: str,
    force: Force | None = None,
    drive: Drive | None = None,
) -> str:
    """The likeliest reason why the terms do not explain the data, with the remedy; else what is said otherwise.

    A force and a drive that the model has already are no reason; beside any force friction is none.
    """
    d, scales = data.ndof, data.scales
    x, v = smooth.points, smooth.slopes
    X = library.fields(x)
    if force is not None:
        X = np.concatenate([X, fields_of(force, x)], 2)
    if drive is not None:
        X = _with_drive(X, smooth, drive, drive.frequency)
    left = _left(X, v, scales)[0]
    found: list[tuple[float, str]] = []
    whole = library_for(None, d, 4, x)[0]
    widest = _left(whole.fields(x), v, scales)[0]
    if not {*whole.expressions} <= {*library.expressions}:
        found.append((widest, "Terms outside of the library fit much better: leave `terms` out, or give others."))
    for cause, said in ((frictions, FRICTION), (turns, TURNED), (drags, DRAG)):
        if cause is force or (cause is frictions and force is not None) or (cause is turns and d == 1):
            continue
        pushes = fields_of(cause, x)
        rest, theta = _left(np.concatenate([X, pushes], 2), v, scales)
        found.append((rest, said.format(_said(theta[-pushes.shape[2] :]))))
    if d > 1:
        pairs = [*range(0, 2 * d, 2), *range(1, 2 * d, 2)]
        with np.errstate(all="ignore"):
            other = library.fields(x[:, pairs])
        if np.isfinite(other).all():
            found.append(
                (
                    _left(other, v[:, pairs], scales[pairs])[0],
                    'The columns look like q1, p1, q2, p2, …: pass order="pairs".',
                )
            )
        rest, masses = _masses(library, x, v, scales, d)
        said = " : ".join(f"{m:.3g}" for m in masses)
        found.append(
            (
                rest,
                f"The second half looks like velocities, of masses {said}: pass velocity_mass=[…], by which p = M v.",
            )
        )
    if drive is None:
        rest, frequency = _driven(X, smooth, scales, Drive(Polynomial.up_to(2, "q", scales[:d]), 1.0))
        found.append((rest * left, DRIVEN.format(*2 * [f"{frequency:.5g}"])))
    least = min(found)[0]
    best = next(one for one in found if one[0] <= ALIKE * least)
    if best[0] < BETTER * left:
        return best[1]
    free = Library(polynomials(d, 3), d)
    columns = np.concatenate([np.ones((len(x), 1)), free.values(x)], 1)
    if 4 * columns.shape[1] < len(x):
        squares = 0.0
        for i in range(2 * d):
            c = np.linalg.lstsq(columns, v[:, i], rcond=None)[0]
            squares += float((((v[:, i] - columns @ c) / scales[i]) ** 2).sum())
        if squares < MUCH_BETTER * min(left, widest):
            return (
                "A vector field of cubic polynomials that is not Hamiltonian fits much better: the data are no motion "
                "of a Hamiltonian in these coordinates, or these are not canonical."
            )
    return otherwise


def _said(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)


def fields_of(force: Force, x: np.ndarray) -> np.ndarray:
    """The fields (n, 2d, k) of a force at states (n, 2d)."""
    return np.moveaxis(force(x.T)[0], -1, 0)


def drive_frequency(X: np.ndarray, smooth: Smooth, scales: np.ndarray, drive: Drive) -> float:
    """The angular frequency at which a drive explains most of what the fields X (n, 2d, K) leave of slopes.

    The peaks of the periodograms with each of its terms are compared by a fit of all, and the best is refined.
    """
    t, d, residuals = smooth.times, X.shape[1] // 2, smooth.slopes - X @ _left(X, smooth.slopes, scales)[1]
    longest = max(np.ptp(t[smooth.owner == i]) for i in np.unique(smooth.owner))
    steps = np.diff(t)
    most = min(int(2 * longest / np.median(steps[steps > 0])), FREQUENCIES)
    frequencies = np.pi / longest * np.arange(0.5, max(most, 2) / 2, 0.25)
    pushes = drive.base.gradient(np.zeros(drive.base.n), smooth.points.T[:d], False, True).by_parameters
    assert pushes is not None
    pushes = pushes / scales[d:, None, None]
    terms = np.einsum("ikn,ni->nk", pushes, residuals[:, d:] / scales[d:])
    power = np.abs(np.stack([np.exp(-1j * w * t) @ terms for w in frequencies])) ** 2 / (pushes**2).sum(axis=(0, 2))

    def rest(frequency: float) -> float:
        return _left(_with_drive(X, smooth, drive, frequency), smooth.slopes, scales)[0]

    best = min(frequencies[np.unique(power.argmax(axis=0))], key=rest)
    near = 0.5 * np.pi / longest
    found = minimize_scalar(rest, bounds=(max(best - near, near / 2), best + near), method="bounded")
    return float(found.x if found.fun < rest(best) else best)


def _with_drive(X: np.ndarray, smooth: Smooth, drive: Drive, frequency: float) -> np.ndarray:
    """Fields (n, 2d, K) with those of the terms of a drive."""
    d = X.shape[1] // 2
    here = Drive(drive.base, frequency, smooth.times)
    by = here.gradient(np.zeros(here.n), smooth.points.T[:d], False, True).by_parameters
    assert by is not None
    forces = np.moveaxis(-by[:, :-1], -1, 0)
    return np.concatenate([X, np.concatenate([np.zeros_like(forces), forces], axis=1)], axis=2)


def _driven(X: np.ndarray, smooth: Smooth, scales: np.ndarray, drive: Drive) -> tuple[float, float]:
    """The share of squares that a drive leaves, and its ω; of other trajectories than those that it was fitted to.

    One trajectory cannot tell a drive from its own motion: infinite.
    """
    first = smooth.owner % 2 == 0
    if first.all() or first.sum() * X.shape[1] < PER_NUMBER * (X.shape[2] + drive.n):
        return np.inf, 0.0
    frequency, v = drive_frequency(X, smooth, scales, drive), smooth.slopes
    fits = [(A, _left(A[first], v[first], scales)[1]) for A in (_with_drive(X, smooth, drive, frequency), X)]
    theirs, mine = (float(((((v - A @ c) / scales)[~first]) ** 2).sum()) for A, c in fits)
    return theirs / mine if mine > 0 else np.inf, frequency


def _left(X: np.ndarray, v: np.ndarray, scales: np.ndarray) -> tuple[float, np.ndarray]:
    """The sum of squares that the fields (n, 2d, K) leave of slopes (n, 2d), and their coefficients."""
    A, y = (X / scales[:, None]).reshape(-1, X.shape[2]), (v / scales).ravel()
    lengths = np.linalg.norm(A, axis=0)
    lengths[lengths == 0] = 1.0
    theta = np.linalg.lstsq(A / lengths, y, rcond=1e-10)[0]
    return float(((y - A / lengths @ theta) ** 2).sum()), theta / lengths


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
    lengths = np.linalg.norm(A, axis=0)
    lengths[lengths == 0] = 1.0
    theta = np.linalg.lstsq(A / lengths, (target / scales[d:]).ravel(), rcond=1e-10)[0] / lengths
    masses = np.concatenate([[1.0], theta[len(of_q) :]])
    force = -(V @ theta[: len(of_q)])
    with np.errstate(all="ignore"):
        rest = ((force / masses - v[:, d:]) / scales[d:]) ** 2
    moving = ((x[:, d:] - v[:, :d]) / scales[:d]) ** 2
    total = float(rest.sum() + moving.sum())
    return (total if np.isfinite(total) and (masses > 0).all() else np.inf), masses
