"""The natural units of a problem, which make a stiff or ill-scaled system look like any other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Scaling:
    """Units of q, p and t in which the states of a domain are of size one.

    The change of variables q/s_q, p/s_p multiplies dq∧dp by 1/(s_q s_p), a constant where all the products agree
    (it is conformal-symplectic then); a potential written in such units is a potential all the same, so a SympFlow
    is symplectic whatever the scaling.

    Parameters
    ----------
    q, p : tuple of d floats
        Spread (standard deviation) of each coordinate and momentum over the domain.
    t : float
        Unit of time, Δt.
    q_center, p_center : tuple of d floats, optional
        Mean of each over the domain; it enters the first biases at initialisation.
    """

    q: tuple[float, ...]
    p: tuple[float, ...]
    t: float = 1.0
    q_center: tuple[float, ...] | None = None
    p_center: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("q", "p", "q_center", "p_center"):
            value = getattr(self, name)
            if value is None:
                value = (0.0,) * len(self.q)
            value = tuple(float(v) for v in value)
            if len(value) != len(self.q) or not np.isfinite(value).all():
                raise ValueError(f"`{name}` must be {len(self.q)} finite numbers; got {value}.")
            object.__setattr__(self, name, value)
        if min(*self.q, *self.p, self.t) <= 0 or not np.isfinite(self.t):
            raise ValueError(f"`q`, `p` and `t` must be positive units; got {self.q}, {self.p}, {self.t}.")

    @classmethod
    def unit(cls, ndof: int, t: float = 1.0) -> Scaling:
        """q, p in the units they come in."""
        return cls((1.0,) * ndof, (1.0,) * ndof, t)

    @classmethod
    def of_samples(cls, x: np.ndarray, t: float) -> Scaling:
        """The scaling of states x (n, 2d) of a domain, and a time step t."""
        ndof = x.shape[-1] // 2
        center, spread = x.mean(0), x.std(0)
        spread = np.where(spread > 0, spread, 1.0)
        # A mean below its own sampling error is the zero of a symmetric domain.
        center = np.where(np.abs(center) > 4 * spread / np.sqrt(len(x)), center, 0.0)
        q, p, q_center, p_center = (tuple(v) for a in (spread, center) for v in (a[:ndof], a[ndof:]))
        return cls(q, p, t, q_center, p_center)

    @property
    def action(self) -> float:
        """The unit of action: the geometric mean of the products s_q s_p. Energies are of size action / t."""
        return float(np.exp(np.mean(np.log(np.multiply(self.q, self.p)))))

    @property
    def x(self) -> tuple[float, ...]:
        """Units of the state [q, p]: 2d floats."""
        return (*self.q, *self.p)

    def to_dict(self) -> dict[str, Any]:
        return {
            "q": list(self.q),
            "p": list(self.p),
            "t": self.t,
            "q_center": list(self.q_center or ()),
            "p_center": list(self.p_center or ()),
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> Scaling:
        return cls(**description)
