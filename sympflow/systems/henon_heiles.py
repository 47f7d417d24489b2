"""The Hénon–Heiles system, the paper's second: two degrees of freedom, regular and chaotic orbits."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def henon_heiles() -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 + (q₁² + q₂²)/2 + q₁²q₂ − q₂³/3.

    The domain is the bounded well below the escape energy 1/6. Its configuration part is the equilateral triangle with
    the saddles (0, 1), (±√3/2, −1/2) as corners, so the box that encloses it picks the bounded component.

    References
    ----------
    .. [1] M. Hénon, C. Heiles, "The applicability of the third integral of motion: some numerical experiments",
       Astron. J. 69 (1964) 73–79.
    """
    q1, p = math.sqrt(3) / 2, 1 / math.sqrt(3)
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + q1**2*q2 - q2**3/3",
        name="henon_heiles",
        domain=EnergySublevel(1 / 6, Box([-q1, -0.5, -p, -p], [q1, 1.0, p, p])),
        y0=[0.3, -0.3, 0.3, 0.15],
        t_span=(0.0, 100.0),
        dt=0.05,
    )
