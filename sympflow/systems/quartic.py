"""Two coupled quartic oscillators."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def quartic() -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 + (q₁⁴ + q₂⁴)/4 + 3 q₁²q₂²/10 + q₁²/5.

    The domain is H < 0.6, which is bounded. From y0 the energy is 0.419025.

    References
    ----------
    .. [1] A. Carnegie, I. C. Percival, "Regular and chaotic motion in some quartic potentials", J. Phys. A 17 (1984)
       801–813; with a quadratic term added.
    """
    energy = 0.6
    q1 = math.sqrt(2 * (math.sqrt(0.04 + energy) - 0.2))  # q₁⁴/4 + q₁²/5 = 0.6
    q2, p = (4 * energy) ** 0.25, math.sqrt(2 * energy)
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (q1**4 + q2**4)/4 + 3*q1**2*q2**2/10 + q1**2/5",
        name="quartic",
        domain=EnergySublevel(energy, Box([-q1, -q2, -p, -p], [q1, q2, p, p])),
        y0=[0.8, 0.5, 0.3, -0.4],
        t_span=(0.0, 100.0),
        dt=0.05,
    )
