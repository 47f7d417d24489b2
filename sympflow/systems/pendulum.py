"""The mathematical pendulum."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def pendulum() -> HamiltonianSystem:
    """H = p²/2 + 1 − cos q, libration: the domain is H < 1.8 around q = 0 (the separatrix is H = 2)."""
    q, p = math.acos(1 - 1.8), math.sqrt(2 * 1.8)
    return HamiltonianSystem.from_sympy(
        "p**2/2 + 1 - cos(q)",
        name="pendulum",
        domain=EnergySublevel(1.8, Box([-q, -p], [q, p])),
        y0=[1.5, 0.0],
        t_span=(0.0, 100.0),
        dt=0.05,
    )
