"""Friction p' = −Γp, alone and with the drift q' = M⁻¹p: linear fields with exact flows."""

from __future__ import annotations

from typing import Any

import numpy as np

from sympflow.arrays import Array, as_array, library, like
from sympflow.compiler import NotCompiled


class Friction:
    """The friction of a damped system, p' = −∂H/∂q − Γp."""

    def __init__(self, damping: np.ndarray | None = None) -> None:
        self.damping = damping
        self.rates, self._modes = np.zeros(()) if damping is None else damping, None
        self.rates.setflags(write=False)
        if damping is not None and damping.ndim == 2:
            rates, self._modes = np.linalg.eigh(damping)
            self.rates = np.maximum(rates, 0.0)  # −0 and what rounding leaves below it
        self.kind = None if damping is None else damping.ndim  # the axes of Γ, by which code for it is made
        self.isotropic = self.rates.ndim == 0  # Γ = γ: the flow is conformally symplectic
        self.largest = float(self.rates.max())

    def __reduce__(self) -> tuple[Any, ...]:
        return Friction, (None if self.damping is None else self.damping.copy(),)

    def __bool__(self) -> bool:
        return self.damping is not None

    def check_sums(self, compensated: bool) -> None:
        """Refuse compensated sums where there is friction."""
        if compensated and self:
            raise NotCompiled(
                "`compensated` sums are for systems without friction, where rounding errors decay: leave it out."
            )

    def matrix(self, ndof: int) -> np.ndarray:
        """Γ as a matrix (d, d)."""
        if self.damping is not None and self.damping.ndim == 2:
            return self.damping
        return np.diag(np.broadcast_to(self.rates, ndof))

    def force(self, p: Array) -> Array:
        """−Γp: (..., d) to (..., d)."""
        G = like(self.rates if self.damping is None else self.damping, p)
        return -(p @ G) if G.ndim == 2 else -(G * p)

    def added(self, force: Array, p: Array) -> Array:
        """A force with −Γp added to it."""
        return force + self.force(p) if self else force

    def drift(self, p: Array, s: Any) -> tuple[Array, Array]:
        """∫₀ˢ e^{−Γu}p du and e^{−Γs}p, for p (..., d) and times s: a number, or one that broadcasts against p."""
        if not self:
            return s * p, p
        rates = like(self.rates, p)
        mean, decay = _factors(rates, s)
        if self._modes is None:
            return mean * p, decay * p
        Q = like(self._modes, p)
        z = p @ Q
        return (mean * z) @ Q.T, (decay * z) @ Q.T

    def factors(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The two linear maps of `drift` for times s (m,), as numbers: (m, 1), diagonals (m, d) or matrices (m, d²)."""
        mean, decay = _factors(self.rates, s if self.rates.ndim == 0 else s[:, None])
        if self._modes is None:
            return mean.reshape(len(s), -1), decay.reshape(len(s), -1)
        Q = self._modes
        return tuple((Q * each[:, None, :] @ Q.T).reshape(len(s), -1) for each in (mean, decay))


def _factors(rates: Array, s: Any) -> tuple[Array, Array]:
    """(1 − e^{−γs})/γ and e^{−γs}, the first s where γs is 0."""
    x = rates * s
    xp = library(x)
    x = as_array(x)
    still = x == 0
    safe = xp.where(still, 1.0 + 0.0 * x, x)
    return s * xp.where(still, 1.0 + 0.0 * x, -xp.expm1(-safe) / safe), xp.exp(-x)


FRICTIONLESS = Friction()  # no friction, of systems that are not damped
