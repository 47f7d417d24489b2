"""Starts by Lagrange's equations of motion, which are linear in the masses where the field of H is not.

Of smoothed curves q(t) with velocities v, p = ∂L/∂v, and p(t) − ∫ ∂L/∂q dt + Γ ∫ p dt is constant. Where momenta are
observed they are the p of both equations. Where velocities are, L is known but for a factor: the constant of M₁₁ is 1.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sympflow.learning.models import Model, Network, Part, Polynomial
from sympflow.learning.shooting import integrals
from sympflow.learning.smoothing import smoothed
from sympflow.learning.trajectories import Run, Trajectories

POINTS = 24
"""Number of points of a piece along which p is followed."""
PASSES = 3
"""Solutions for velocities, each with the friction and the masses of the one before."""
LIKELY = 1e-2
"""Weight of p = v, beside equations of motion that need not tell the masses of all motions apart."""
DEGREE = 4
"""Degree of the polynomial in place of a potential that is not linear in its numbers."""


def lagrangian_start(model: Model, data: Trajectories, theta: np.ndarray) -> tuple[np.ndarray, Trajectories]:
    """θ by Lagrange's equations where they are linear in it, else as it was; and the data with momenta."""
    smooth, d = smoothed(data), data.ndof
    runs = [Run(run.t, y) for run, y in zip(data.runs, smooth.states, strict=True)]

    def with_momenta(states: list[np.ndarray]) -> Trajectories:
        made = (Run(run.t, y) for run, y in zip(runs, states, strict=True))
        return replace(data, runs=tuple(made), velocities=False)

    if data.velocities and all(part.of == "q" or not part.n for part in model.parts):  # the masses are known
        return theta, with_momenta([model.states(theta, run.y) for run in runs])
    velocities = [run.y[d:] if data.velocities else rates[:d] for run, rates in zip(runs, smooth.rates, strict=True)]
    equations = Equations(
        replace(model, parts=tuple(map(_linear, model.parts))),
        replace(data, runs=tuple(Run(r.t, np.concatenate([r.y, v])) for r, v in zip(runs, velocities, strict=True))),
    )
    found = equations.solved()
    if not data.velocities:
        return found, data
    masses = equations.masses(found)
    if not (np.isfinite(masses).all() and (np.linalg.eigvalsh(masses) > 0).all()):
        return theta, with_momenta([run.y for run in runs])
    unit = 1.0 if model.lagrangian else np.linalg.inv(masses.mean(axis=0))[0, 0]  # of H (M⁻¹)₁₁ is 1
    states = [np.concatenate([run.y[:d], unit * equations.momenta(found, run.y[:d], run.y[d:])]) for run in runs]
    return found if model.lagrangian else theta, with_momenta(states)


def _linear(part: Part) -> Part:
    """A polynomial in place of a network."""
    return Polynomial.up_to(DEGREE, part.of, part.scales) if isinstance(part, Network) else part


class Equations:
    """Lagrange's equations of a model along curves with rows q, p or v as observed, and v.

    Parameters
    ----------
    model : Model
    curves : Trajectories
    """

    def __init__(self, model: Model, curves: Trajectories) -> None:
        self.model, self.d, self.observed = model, model.ndof, not curves.velocities
        self.pieces = curves.pieces(POINTS).runs
        self.q, self.second, self.v = np.split(np.concatenate([run.y for run in self.pieces], axis=1), 3)
        self.n = model.n - model.rates
        self.value, self.by = model.momenta(self.q, self.v)
        self.scales = curves.scales[self.d : 2 * self.d, None]

    def momenta(self, theta: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """p (d, N) at q and v."""
        value, by = self.model.momenta(q, v)
        return value[: self.d] + np.einsum("ikn,k->in", by[: self.d], theta[: self.n])

    def masses(self, theta: np.ndarray) -> np.ndarray:
        """M (N, d, d) at all points."""
        units = [np.broadcast_to(unit[:, None], self.q.shape) for unit in (np.zeros(self.d), *np.eye(self.d))]
        rest, *columns = (self.momenta(theta, self.q, unit) for unit in units)
        return np.stack([column - rest for column in columns], axis=1).T

    def solved(self) -> np.ndarray:
        """θ by linear least squares."""
        theta, p = np.zeros(self.model.n), self.second
        weights = np.diag(1 / self.scales[:, 0])
        for _ in range(1 if self.observed else PASSES):
            rows, right = self._rows(p, weights)
            lengths = np.linalg.norm(rows, axis=0)
            lengths[lengths == 0] = 1.0
            theta = np.linalg.lstsq(rows / lengths, right, rcond=1e-10)[0] / lengths
            if not self.observed:
                p = self.momenta(theta, self.q, self.v)
                inverse = np.linalg.pinv(self.masses(theta).mean(axis=0))
                weights = inverse / self.scales
        return theta

    def _rows(self, p: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The equations, rows (R, n) and right sides (R,), with the friction of momenta p (d, N) and weights (d, d)."""
        d, rates = self.d, self.model.rates
        friction = np.zeros((d, rates, p.shape[1]))
        for i in range(d if rates else 0):
            friction[i, i if rates > 1 else 0] = p[i]
        near = (1.0 if self.observed else LIKELY) / self.scales
        wide = np.concatenate([self.by[:d], np.zeros_like(friction)], axis=1)
        rows, right = [wide * near[..., None]], [(self.second - self.value[:d]) * near]
        at = 0
        for run in self.pieces:
            here = slice(at, at := at + run.n_points)
            pushes = np.concatenate(
                [self.value[d:, None, here], self.by[d:, :, here], -friction[..., here]], axis=1
            )
            moved = integrals(run.t, pushes)
            top = self.second[:, None, here] if self.observed else self.value[:d, None, here]
            columns = np.zeros_like(wide[..., here]) if self.observed else wide[..., here]
            whole = np.concatenate([top, columns], axis=1) - moved
            whole = np.einsum("ij,jkn->ikn", weights, whole - whole.mean(axis=-1, keepdims=True))
            rows.append(whole[:, 1:])
            right.append(-whole[:, 0])
        stacked = np.concatenate([part.transpose(0, 2, 1).reshape(-1, self.model.n) for part in rows])
        return stacked, np.concatenate([part.ravel() for part in right])
