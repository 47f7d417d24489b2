"""The natural units of a problem, which make a stiff or ill-scaled system look like any other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np


class _Units(NamedTuple):
    q: tuple[float, ...]
    p: tuple[float, ...]
    t: float
    q_center: tuple[float, ...]
    p_center: tuple[float, ...]


class Scaling(_Units):
    """Units of q, p and t in which the states of a domain are of size one, and its centers.

    The change of variables q/s_q, p/s_p multiplies dq∧dp by 1/(s_q s_p), a constant where all the products agree; a
    potential written in such units is a potential all the same, so a SympFlow is symplectic whatever the scaling. A
    ValueError if a length differs, a unit is not positive, or a number is not finite.
    """

    def __new__(
        cls,
        q: Sequence[float],
        p: Sequence[float],
        t: float = 1.0,
        q_center: Sequence[float] | None = None,
        p_center: Sequence[float] | None = None,
    ) -> Self:
        vectors = {"q": q, "p": p, "q_center": q_center, "p_center": p_center}
        made: dict[str, tuple[float, ...]] = {}
        for name, value in vectors.items():
            made[name] = (0.0,) * len(q) if value is None else tuple(float(v) for v in value)
            if len(made[name]) != len(q) or not np.isfinite(made[name]).all():
                raise ValueError(f"`{name}` must be {len(q)} finite numbers; got {made[name]}.")
        if min(*made["q"], *made["p"], t) <= 0 or not np.isfinite(t):
            raise ValueError(f"`q`, `p` and `t` must be positive units; got {made['q']}, {made['p']}, {t}.")
        return super().__new__(cls, t=t, **made)

    @classmethod
    def unit(cls, ndof: int, t: float = 1.0) -> Scaling:
        """Return the units in which q and p come."""
        return cls((1.0,) * ndof, (1.0,) * ndof, t)

    @classmethod
    def of_samples(cls, x: np.ndarray, t: float) -> Scaling:
        """Return the scaling of states x (n, 2d) of a domain, and a time step t."""
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
        return {name: list(v) if isinstance(v, tuple) else v for name, v in self._asdict().items()}

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> Scaling:
        return cls(**description)
