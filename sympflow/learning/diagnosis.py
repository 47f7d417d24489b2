"""Hints where no Hamiltonian explains the data: friction, velocities, another order of columns, no Hamiltonian at all.

Each is a regression of the smoothed slopes with more freedom, or with rows in another order, against the same without.
"""

from __future__ import annotations

import numpy as np

from sympflow.learning.library import Library, library_for, polynomials
from sympflow.learning.smoothing import Smooth
from sympflow.learning.trajectories import Trajectories

BETTER = 0.5
"""Share of the misfit that another reading of the data must leave at most, to be worth a word."""


def hint(library: Library, smooth: Smooth, data: Trajectories, otherwise: str) -> str:
    """The likeliest reason why the terms do not explain the data, with the remedy; else what is said otherwise."""
    d, scales = data.ndof, data.scales
    x, v = smooth.points, smooth.slopes
    X = library.fields(x)
    left = _left(X, v, scales)[0]
    found: list[tuple[float, str]] = []
    whole = library_for(None, d, 4, x)[0]
    widest = _left(whole.fields(x), v, scales)[0]
    if not {*whole.expressions} <= {*library.expressions}:
        found.append((widest, "Terms outside of the library fit much better: leave `terms` out, or give others."))
    if d > 1:
        pairs = [*range(0, 2 * d, 2), *range(1, 2 * d, 2)]
        with np.errstate(all="ignore"):
            turned = library.fields(x[:, pairs])
        if np.isfinite(turned).all():
            found.append(
                (
                    _left(turned, v[:, pairs], scales[pairs])[0],
                    'The columns look like q1, p1, q2, p2, …: pass order="pairs".',
                )
            )
    friction = np.zeros((*x.shape, d))
    for i in range(d):
        friction[:, d + i, i] = -x[:, d + i]
    rest, theta = _left(np.concatenate([X, friction], 2), v, scales)
    rates = theta[len(library) :]
    found.append(
        (
            rest,
            f"Friction p' = -γp with γ = {', '.join(f'{g:.3g}' for g in rates)} would leave much less: the data are "
            "dissipative, areas of phase space shrink as exp(-γt), and no symplectic map explains them. Learn a flow "
            "with damping.",
        )
    )
    if d > 1:
        rest, masses = _masses(library, x, v, scales, d)
        said = " : ".join(f"{m:.3g}" for m in masses)
        found.append(
            (
                rest,
                f"The second half looks like velocities, of masses {said}: pass velocity_mass=[…], by which p = M v.",
            )
        )
    best = min(found)
    if best[0] < BETTER * left:
        return best[1]
    free = Library(polynomials(d, 3), d)
    columns = np.concatenate([np.ones((len(x), 1)), free.values(x)], 1)
    if 4 * columns.shape[1] < len(x):
        squares = 0.0
        for i in range(2 * d):
            c = np.linalg.lstsq(columns, v[:, i], rcond=None)[0]
            squares += float((((v[:, i] - columns @ c) / scales[i]) ** 2).sum())
        if squares < BETTER * min(left, widest):
            return (
                "A vector field of cubic polynomials that is not Hamiltonian fits much better: the data are no motion "
                "of a Hamiltonian in these coordinates, or these are not canonical."
            )
    return otherwise


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
