"""Tube: a domain around an orbit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import Array
from sympflow.domain_arguments import checked_states, floats, sample_count

_AT_ONCE = 2**20  # numbers in one block of distances


@dataclass(frozen=True, eq=False)
class Tube:
    """The states near an orbit: within `radius` of the broken line through its states.

    Parameters
    ----------
    orbit : array_like, shape (n, 2d)
        States along the orbit, n ≥ 2: of a `Solution`, ``sol.states``. They should lie closer to each other than the
        radius, so that the broken line follows the orbit.
    radius : float or array_like of shape (2d,)
        Positive. Distances are Euclidean in the coordinates divided by it: one number where [q, p] are of one scale,
        else one for each coordinate.
    groups : sequence of sequences of int, optional
        Coordinates that are near the orbit together; the default is all of them. Several groups give the product of
        tubes, each about the orbit's projection: for planets, say, each near its own ellipse, at any relative phase.
        They must hold every one of 0 … 2d−1 once.

    Notes
    -----
    A sample is a state of the broken line, drawn uniformly in the orbit's own time, plus a uniform draw from the
    ellipsoid about it; with several groups the times are drawn independently.
    """

    orbit: ArrayLike
    radius: float | ArrayLike
    groups: Sequence[Sequence[int]] | None = None

    def __post_init__(self) -> None:
        orbit = floats("orbit", self.orbit)
        if orbit.ndim != 2 or len(orbit) < 2 or orbit.shape[1] == 0 or orbit.shape[1] % 2:
            raise ValueError(f"`orbit` must have shape (n, 2d), n ≥ 2 states [q, p]; got {orbit.shape}.")
        if not np.isfinite(orbit).all():
            raise ValueError("`orbit` must be finite; it holds NaN or infinity: end it before the blow-up.")
        width = orbit.shape[1]
        radius = floats("radius", self.radius)
        if radius.shape not in ((), (width,)):
            raise ValueError(f"`radius` must be a number or have shape ({width},); got {radius.shape}.")
        if not ((radius > 0) & (radius < np.inf)).all():
            raise ValueError(f"`radius` must be positive and finite; got {self.radius!r}.")
        try:
            groups = [list(range(width))] if self.groups is None else [[*group] for group in self.groups]
        except TypeError:
            groups = []
        whole = all(isinstance(i, int | np.integer) and not isinstance(i, bool) for group in groups for i in group)
        groups = [[int(i) for i in group] for group in groups] if whole else []
        if sorted(i for group in groups for i in group) != list(range(width)):
            raise ValueError(f"`groups` must hold each of 0 … {width - 1} once; got {self.groups!r}.")
        orbit.setflags(write=False)
        radius.setflags(write=False)
        object.__setattr__(self, "orbit", orbit)
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "groups", tuple(tuple(group) for group in groups))

    def __repr__(self) -> str:
        n, width = np.shape(self.orbit)
        return f"Tube(orbit of {n} states of length {width}, radius={np.asarray(self.radius).tolist()})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tube) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((np.asarray(self.orbit).tobytes(), np.asarray(self.radius).tobytes(), self.groups))

    def _parts(self) -> list[tuple[list[int], np.ndarray, np.ndarray]]:
        """For each group its indices, and the orbit and radii of these coordinates."""
        orbit = np.asarray(self.orbit)
        radius = np.broadcast_to(np.asarray(self.radius), orbit.shape[1:])
        assert self.groups is not None
        return [(list(group), orbit[:, list(group)], radius[list(group)]) for group in self.groups]

    @property
    def width(self) -> int:
        return np.shape(self.orbit)[1]

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        x = np.empty((sample_count(n), np.shape(self.orbit)[1]))
        for indices, orbit, radius in self._parts():
            time = rng.random(n) * (len(orbit) - 1)
            k = time.astype(int)
            centre = orbit[k] + (time - k)[:, None] * (orbit[k + 1] - orbit[k])
            direction = rng.standard_normal((n, len(indices)))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            # a hair inside, so that rounding never puts a sample outside
            x[:, indices] = centre + radius * direction * (1 - 1e-12) * rng.random((n, 1)) ** (1 / len(indices))
        return x

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        x = checked_states(x, np.shape(self.orbit)[1])
        flat = x.reshape(-1, x.shape[-1]).astype(float)
        inside = np.isfinite(flat).all(1)
        for indices, orbit, radius in self._parts():
            block = max(1, _AT_ONCE // orbit.size)
            for start in range(0, len(flat), block):
                rows = slice(start, start + block)
                inside[rows] &= _distance(flat[rows][:, indices] / radius, orbit / radius) <= 1
        return inside.reshape(x.shape[:-1])

    def to_dict(self) -> dict[str, Any]:
        return {
            "kind": "Tube",
            "orbit": np.asarray(self.orbit).tolist(),
            "radius": np.asarray(self.radius).tolist(),
            "groups": [list(group) for group in self.groups or ()],
        }


def _distance(x: np.ndarray, orbit: np.ndarray) -> np.ndarray:
    """Distance of the points x (m, k) to the broken line through orbit (n, k): (m,)."""
    start, along = orbit[:-1], np.diff(orbit, axis=0)
    length = (along**2).sum(1)
    away = x[:, None, :] - start
    with np.errstate(all="ignore"):
        position = (away * along).sum(-1) / np.where(length > 0, length, 1)
        away = away - position.clip(0, 1)[..., None] * along
        return np.sqrt((away**2).sum(-1).min(1))
