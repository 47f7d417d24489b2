"""Functions that are the same at all points of the data: there (g − g₀)² has no effect, and H is not determined."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
import sympy as sp

from sympflow.hamiltonian.domain import Tube
from sympflow.learning.parts import Part, Polynomial
from sympflow.learning.reading import Run

SAME = 1e-3
"""Variance of a function over the data, in that over a box around them, below which it is the same at all points."""
CHANCE = 3.0  # Variance of a function, in that which the errors of the states make, up to which it may be all chance
MOST_SQUARES = 12  # Coordinates up to which functions of degree 2 are looked at, beside those of degree 1
SLIGHT = 0.05  # Share of the largest term of a function, below which another is left out of its text
SAMPLED = 4000
RADIUS = 0.1  # Radius of a domain around a trajectory, in the spread of each coordinate


def unseen(states: np.ndarray, errors: np.ndarray, columns: Sequence[int], part: Part | None = None) -> list[sp.Expr]:
    """Functions of some coordinates that are the same at all states: linear ones, or else quadratic ones.

    Of q and p together only linear ones: of few orbits some sum of the integrals of motion always has one value.
    """
    d, x = states.shape[1] // 2, states[:, [*columns]].T
    names = [sp.Symbol(f"{'qp'[i // d]}{i % d + 1}", real=True) for i in columns]
    low, high = x.min(axis=1), x.max(axis=1)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9 * np.abs(x).max(axis=1) + np.finfo(float).tiny)
    if part is not None:
        return _same(part, x, errors[[*columns]], names, np.zeros(len(x)), half)
    for degree in (1, 2) if 1 < len(x) <= min(d, MOST_SQUARES) else (1,):
        found = _same(Polynomial.up_to(degree, "y", half), x, errors[[*columns]], names, middle, half)
        if found:
            return found
    return []


def _same(
    part: Part, x: np.ndarray, errors: np.ndarray, names: list[sp.Symbol], middle: np.ndarray, half: np.ndarray
) -> list[sp.Expr]:
    """The sums of terms of a part, at coordinates (m, N) less their middle, that are the same at all points."""
    centre = (x.min(axis=1) + x.max(axis=1)) / 2
    box = centre[:, None] + half[:, None] * np.random.default_rng(0).uniform(-1, 1, (len(x), SAMPLED))
    units = np.eye(part.n)

    def covariance(at: np.ndarray) -> np.ndarray:
        values = np.stack([part.value(unit, at - middle[:, None]) for unit in units])
        return np.cov(values).reshape(part.n, part.n)

    slopes = part.gradient(np.zeros(part.n), x - middle[:, None], False, True).by_parameters * errors[:, None, None]
    chance = CHANCE * np.einsum("ikn,iln->kl", slopes, slopes, optimize=True) / x.shape[1]
    shares, vectors = scipy.linalg.eigh(covariance(x) - chance, covariance(box))
    same = vectors[:, shares < SAME].T
    if not len(same):
        return []
    pivots = scipy.linalg.qr(same, pivoting=True)[2][: len(same)]  # each function by few terms
    sizes = dict(zip(names, np.abs(x).max(axis=1).tolist(), strict=True))
    made = []
    for row in np.linalg.solve(same[:, pivots], same):
        g = sp.expand(part.expression(row, [v - sp.Float(c) for v, c in zip(names, middle.tolist(), strict=True)]))
        terms = [(c, f) for f, c in sorted(g.as_coefficients_dict(*names).items(), key=str) if f.free_symbols]
        weights = [abs(float((c * f).subs(sizes))) for c, f in terms]
        kept = [(c, f) for (c, f), w in zip(terms, weights, strict=True) if w > SLIGHT * max(weights)]
        unit = kept[0][0]
        made.append(sp.Add(*(_short(c / unit) * f for c, f in kept)))
    return made


def _short(number: sp.Expr) -> sp.Expr:
    """Two digits of a number."""
    value = float(f"{float(number):.2g}")
    return sp.Integer(int(value)) if value.is_integer() else sp.Float(value, 2)


def remark_on(functions: Sequence[sp.Expr]) -> str:
    """The same in words."""
    listed = ", ".join(map(str, functions[:3]))
    return (
        f"The data do not determine H elsewhere: at all of their points, within the noise, {listed} "
        f"{'is' if len(functions) == 1 else 'are'} the same, so that H elsewhere is a guess. The domain is a "
        "tube around the longest trajectory. Add trajectories in which that differs."
    )


def tube(states: np.ndarray, runs: Sequence[Run], scales: np.ndarray) -> Tube:
    """The domain around the longest of trajectories, whose states (n, 2d) follow each other."""
    longest = max(range(len(runs)), key=lambda i: runs[i].n_points)
    start = sum(run.n_points for run in runs[:longest])
    return Tube(states[start : start + runs[longest].n_points], RADIUS * scales)
