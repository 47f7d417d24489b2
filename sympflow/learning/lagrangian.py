"""Starts by Lagrange's equations of motion, which are linear in the masses where the field of H is not.

Of smoothed curves q(t) with velocities v, p = ∂L/∂v, and p(t) − ∫ (∂L/∂q + F(p)) dt is constant. Where momenta are
observed they are the p of both equations. Where velocities are, L is known but for a factor: the constant of M₁₁ is 1.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, partial
from typing import Self

import numpy as np

from sympflow.learning.models import Model
from sympflow.learning.orbits import integrals
from sympflow.learning.parts import Network, Polynomial
from sympflow.learning.reading import Run
from sympflow.learning.trajectories import Trajectories

POINTS = 24  # Number of points of a piece along which p is followed
STEPS, HALVINGS, SETTLED = 12, 6, 1e-2
"""Gauss–Newton steps for masses, halvings of one, and the gain of a step that ends them."""
CORRELATED = 4  # Residuals along smooth curves that count as one
DEGREE = 4  # Degree of the polynomial in place of a potential that is not linear in its numbers


def lagrangian_start(model: Model, data: Trajectories, theta: np.ndarray) -> tuple[np.ndarray, Trajectories]:
    """θ by Lagrange's equations where they are linear in it, else as it was; and the data, smooth, with momenta."""
    d = data.ndof
    runs = [Run(run.t, y) for run, y in zip(data.runs, data.smooth.states, strict=True)]

    def with_momenta(states: list[np.ndarray]) -> Trajectories:
        made = (Run(run.t, y) for run, y in zip(runs, states, strict=True))
        return replace(data, runs=tuple(made), velocities=False)

    if data.velocities and all(part.of == "q" or not part.n for part in model.parts):  # the masses are known
        return theta, with_momenta([model.states(theta, run.y) for run in runs])
    polynomial = partial(Polynomial.up_to, DEGREE)  # in place of a network
    parts = (polynomial(part.of, part.scales) if isinstance(part, Network) else part for part in model.parts)
    equations = Equations.of(replace(model, parts=tuple(parts)), data)
    found, *_ = equations.solved()
    if not data.velocities:
        return found, data
    masses = equations.masses(found)
    if not (np.isfinite(masses).all() and (np.linalg.eigvalsh(masses) > 0).all()):
        return theta, with_momenta([run.y for run in runs])
    unit = 1.0 if model.lagrangian else np.linalg.inv(masses.mean(axis=0))[0, 0]  # of H (M⁻¹)₁₁ is 1
    states = [np.concatenate([run.y[:d], unit * equations.momenta(found, run.y[:d], run.y[d:])]) for run in runs]
    return found if model.lagrangian else theta, with_momenta(states)


def told(model: Model, data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """θ (n,) by Lagrange's equations, which are linear in it, and one over their covariance (n, n)."""
    theta, left, J = Equations.of(model, data).solved()
    variance = CORRELATED * (left @ left) / max(len(left) - len(theta), 1)
    return theta, J.T @ J / max(float(variance), np.finfo(float).tiny)


class Equations:
    """Lagrange's equations of a model along curves with rows q, p or v as observed, and v."""

    def __init__(self, model: Model, curves: Trajectories) -> None:
        self.model, self.d, self.observed = model, model.ndof, not curves.velocities
        self.pieces = curves.pieces(POINTS).runs
        self.q, self.second, self.v = np.split(np.concatenate([run.y for run in self.pieces], axis=1), 3)
        self.n = model.n - model.forces
        self.value, self.by = model.at(np.concatenate([run.t for run in self.pieces])).momenta(self.q, self.v)
        self.scales = curves.scales[self.d : 2 * self.d, None]

    @classmethod
    def of(cls, model: Model, data: Trajectories) -> Self:
        """The equations along smooth curves through data."""
        smooth, d = data.smooth, data.ndof
        curves = [
            Run(run.t, np.concatenate([y, y[d:] if data.velocities else rates[:d]]))
            for run, y, rates in zip(data.runs, smooth.states, smooth.rates, strict=True)
        ]
        return cls(model, replace(data, runs=tuple(curves)))

    def momenta(self, theta: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """p (d, N) at q and v."""
        value, by = self.model.momenta(q, v)
        return value[: self.d] + np.einsum("ikn,k->in", by[: self.d], theta[: self.n])

    def masses(self, theta: np.ndarray) -> np.ndarray:
        """M (N, d, d) at all points."""
        known, by = self.by_mass
        return (known + np.einsum("ijkn,k->ijn", by, theta[: self.n])).T

    def solved(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """θ, residuals and J by least squares: linear where momenta are observed, else by steps from M = 1.

        Residuals are infinite, and J is 0, where curves whose velocities are not independent allow no such start.
        """
        likely = self._stacked(self.by[: self.d] / self.scales[..., None])
        theta = np.zeros(self.model.n)
        right = ((self.second - self.value[: self.d]) / self.scales).ravel()
        if self.observed:
            rest, rows = self._rows(self.second)
            rows, rest = self._stacked(rows / self.scales[..., None]), (rest / self.scales).ravel()
            wide = np.concatenate([likely, np.zeros((len(likely), self.model.forces))], axis=1)
            J, right = np.concatenate([wide, rows]), np.concatenate([right, -rest])
            theta = least(J, right)
            return theta, right - J @ theta, J
        for part, place in zip(self.model.parts, self.model.places, strict=True):
            if part.inertial:
                theta[place] = part.start(np.random.default_rng(0))
        theta[: self.n] += least(likely, right - likely @ theta[: self.n])  # p = v
        left, J = self._left(theta)
        if not np.isfinite(left).all():
            return theta, left, J
        forces = np.arange(self.model.n) >= self.n  # first those alone
        forces[: self.n] = ~self.by_mass[1].any(axis=(0, 1, 3))
        for attempt in range(STEPS):
            step = least(J if attempt else J * forces, -left)
            for _ in range(HALVINGS):
                after, K = self._left(theta + step)
                if after @ after < left @ left:
                    break
                step = step / 2
            else:
                break
            gained = 1 - (after @ after) / (left @ left)
            theta, left, J = theta + step, after, K
            if gained < SETTLED:
                break
        return theta, left, J

    def _left(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M⁻¹ times what the equations leave, and the derivative by θ; infinite where M is not positive definite."""
        rest, rows = self._rows(self.momenta(theta, self.q, self.v))
        M = self.masses(theta)
        if not (np.isfinite(M).all() and (np.linalg.eigvalsh(M) > 0).all()):
            return np.full(rest.size, np.inf), np.zeros((rest.size, self.model.n))
        W = np.linalg.inv(M)
        r = np.einsum("nij,jn->in", W, rest + np.einsum("ikn,k->in", rows, theta))
        rows[:, : self.n] -= np.einsum("ijkn,jn->ikn", self.by_mass[1], r)
        return (r / self.scales).ravel(), self._stacked(np.einsum("nij,jkn->ikn", W / self.scales, rows))

    @cached_property
    def by_mass(self) -> tuple[np.ndarray, np.ndarray]:
        """M (d, d, N) for θ = 0, and its derivative by θ, (d, d, n, N)."""
        units = (unit[:, None] * np.ones_like(self.q) for unit in (np.zeros(self.d), *np.eye(self.d)))
        none, *columns = (self.model.momenta(self.q, v) for v in units)
        known, by = (np.stack([c[k] - none[k] for c in columns], axis=1)[: self.d] for k in (0, 1))
        return known, by

    @staticmethod
    def _stacked(rows: np.ndarray) -> np.ndarray:
        """Rows (d, n, N) as a matrix (d N, n)."""
        return rows.transpose(0, 2, 1).reshape(-1, rows.shape[1])

    def _along(self, top: np.ndarray, pushes: np.ndarray) -> np.ndarray:
        """Momenta less the integrals of what pushes them, (…, N), less their mean over a piece."""
        ends = np.cumsum([run.n_points for run in self.pieces])[:-1]
        parts = zip(self._weights, np.split(top, ends, axis=-1), np.split(pushes, ends, axis=-1), strict=True)
        made = [a - b @ weights for weights, a, b in parts]
        return np.concatenate([rows - rows.mean(axis=-1, keepdims=True) for rows in made], axis=-1)

    @cached_property
    def _weights(self) -> list[np.ndarray]:
        """The integrals (k, k) of what is 1 at one of the points of a piece, of each piece."""
        return [integrals(run.t, np.eye(run.n_points)) for run in self.pieces]

    @cached_property
    def _conservative(self) -> np.ndarray:
        """p(t) − ∫ ∂L/∂q dt for θ = 0, and its derivatives by θ but for friction: (d, 1 + n, N)."""
        whole = np.concatenate([self.value[:, None], self.by], axis=1)
        top, pushes = whole[: self.d], whole[self.d :]
        if self.observed:
            top = np.concatenate([self.second[:, None], np.zeros_like(top[:, 1:])], axis=1)
        return self._along(top, pushes)

    def _rows(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """p(t) − ∫ (∂L/∂q + F) dt for θ = 0, (d, N), and its derivatives (d, n, N), with these momenta p."""
        whole, force = self._conservative, self.model.force
        if force is None:
            return whole[:, 0], whole[:, 1:].copy()
        pushes = force(np.concatenate([self.q, p]))[0][self.d :]
        return whole[:, 0], np.concatenate([whole[:, 1:], self._along(np.zeros_like(pushes), pushes)], axis=1)


def least(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of least squares, its columns in their lengths; the shortest where there are many."""
    lengths = np.linalg.norm(rows, axis=0)
    lengths[lengths == 0] = 1.0
    return np.linalg.lstsq(rows / lengths, right, rcond=1e-10)[0] / lengths
