"""The mathematical pendulum."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem

_H = "p**2/2 + 1 - cos(q)"


def pendulum() -> HamiltonianSystem:
    """H = p²/2 + 1 − cos q, libration: the domain is H < 1.8 around q = 0 (the separatrix is H = 2)."""
    q, p = math.acos(1 - 1.8), math.sqrt(2 * 1.8)
    return HamiltonianSystem.from_sympy(
        _H,
        name="pendulum",
        domain=EnergySublevel(1.8, Box([-q, -p], [q, p])),
        y0=[1.5, 0.0],
        t_span=(0.0, 100.0),
        dt=0.05,
    )


def pendulum_separatrix(energy: float = 2.0) -> HamiltonianSystem:
    """H = p²/2 + 1 − cos q from the bottom, q = 0, with the energy of the separatrix or any other.

    Parameters
    ----------
    energy : float
        H(y0) > 0: below 2 the pendulum swings, above it turns over.

    Notes
    -----
    Known truth: on the separatrix q(t) = 4 arctan(eᵗ) − π, p(t) = 2 sech t: it never reaches the top, while any error
    grows with exp(t). The domain is H < 2.5 in −π ≤ q ≤ π.

    References
    ----------
    .. [1] V. I. Arnold, "Mathematical Methods of Classical Mechanics", 2nd ed., Springer 1989, § 4.
    """
    if not (isinstance(energy, int | float) and 0 < energy < math.inf):
        raise ValueError(f"`energy` must be positive and finite; got {energy!r}.")
    p = math.sqrt(5.0)
    return HamiltonianSystem.from_sympy(
        _H,
        name="pendulum_separatrix",
        domain=EnergySublevel(2.5, Box([-math.pi, -p], [math.pi, p])),
        y0=[0.0, math.sqrt(2 * energy)],
        t_span=(0.0, 100.0),
        dt=0.05,
    )
