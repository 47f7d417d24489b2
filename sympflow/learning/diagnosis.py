"""Hints where no Hamiltonian explains the data: friction, drives, velocities, columns in another order, none at all.

Each is a regression of the smoothed slopes with more freedom, or with rows in another order, against the same without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.optimize import minimize_scalar

from sympflow.learning.library import Library, library_for, polynomials
from sympflow.learning.models import Force, drags, frictions, turns
from sympflow.learning.parts import Drive, Polynomial
from sympflow.learning.smoothing import Smooth
from sympflow.learning.trajectories import Trajectories

BETTER = 0.5  # Share of the misfit that another reading of the data must leave at most, to be worth a word
MUCH_BETTER = 0.1
"""The same of a vector field that is not Hamiltonian: a sum that has more terms leaves less by itself."""
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
    "A vector field of cubic polynomials that is not Hamiltonian fits much better: the data are no motion of a "
    "Hamiltonian in these coordinates, or these are not canonical."
)
PER_NUMBER = 4  # Values of half of the trajectories that there are at least for a number of a fit with a drive
FREQUENCIES = 1000
"""Halves of the angular frequency π over the longest time, up to which that of a drive is looked for."""
MOST_SLOPES = 3000  # Points by which reasons are looked for
MOST_DRIVES, SWEEPS = 2, 2
"""Drives that are looked for, and how often the frequency of each is refined beside the others."""


def hint(
    library: Library,
    smooth: Smooth,
    data: Trajectories,
    force: Force | None = None,
    drives: Sequence[Drive] = (),
) -> str | None:
    """The likeliest reason why the terms do not explain the data, with the remedy; None for none.

    A force and drives that the model has already are no reason; beside any force friction is none.
    """
    d, scales = data.ndof, data.scales
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
        said = " : ".join(f"{m:.3g}" for m in masses)
        found.append(
            (
                left,
                f"The second half looks like velocities, of masses {said}: pass velocity_mass=[…], by which p = M v.",
            )
        )
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
    assert by is not None
    forces = np.moveaxis(-by[:, :-1], -1, 0)
    return np.concatenate([np.zeros_like(forces), forces], axis=1)


@dataclass(frozen=True)
class Rest:
    """What fields (n, 2d, K) leave of slopes (n, 2d), each coordinate in its spread."""

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
    """The angular frequency at which a drive explains most of what the fields X (n, 2d, K) leave of slopes.

    The peaks of the periodograms with each of its terms are compared by a fit of all, and the best is refined.
    """
    d = X.shape[1] // 2
    most = min(int(2 * smooth.longest / smooth.step), FREQUENCIES)
    frequencies = np.pi / smooth.longest * np.arange(0.5, max(most, 2) / 2, 0.25)
    beside = Rest.of(X, smooth.slopes, scales)
    pushes = drive.base.gradient(np.zeros(drive.base.n), smooth.points.T[:d], False, True).by_parameters
    assert pushes is not None
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

    One trajectory cannot tell a drive from its own motion: infinite.
    """
    first, v, near = smooth.owner % 2 == 0, smooth.slopes, 0.5 * np.pi / smooth.longest

    def theirs(A: np.ndarray) -> float:
        columns, lengths = _columns(A[first], scales)
        c = np.linalg.lstsq(columns, (v[first] / scales).ravel(), rcond=1e-10)[0] / lengths
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
