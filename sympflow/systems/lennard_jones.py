"""A small crystal of argon atoms that attract and repel each other."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from sympflow.system import HamiltonianSystem
from sympflow.systems.pairs import OPTIONS, pair_functions
from sympflow.tube import Tube

EPSILON = 119.8
"""Depth of the potential in kelvin (times Boltzmann's constant)."""

SIGMA = 0.341
"""Where the potential is zero, in nanometres."""

MASS = 66.34e-27 / 1.380658e-23
"""Of an atom, in K·ns²/nm²: kilograms over Boltzmann's constant, 1 nm/ns being 1 m/s."""

POSITIONS = np.array(
    [[0.0, 0.0], [0.02, 0.39], [0.34, 0.17], [0.36, -0.21], [-0.02, -0.40], [-0.35, -0.16], [-0.31, 0.21]]
)
"""In nanometres: one atom in the middle, six around it."""

VELOCITIES = np.array(
    [[-30.0, -20.0], [50.0, -90.0], [-70.0, -60.0], [90.0, 40.0], [80.0, 90.0], [-40.0, 100.0], [-80.0, -60.0]]
)
"""In nanometres per nanosecond."""


def lennard_jones() -> HamiltonianSystem:
    """H = Σ|p_i|²/(2m) + Σ_{i<j} 4ε[(σ/r_ij)¹² − (σ/r_ij)⁶], d = 14: seven argon atoms in a plane, nearly frozen.

    Lengths are in nanometres, times in nanoseconds, energies in kelvin (divided by Boltzmann's constant); q and p list
    the atoms' two coordinates one atom after the other. It is given by Numba functions.

    Notes
    -----
    Known truths: H(y0) = −1260.2 K; total momentum and angular momentum are constant, the first is 0.

    The domain is an ellipsoid about the crystal at rest, with half-axes of 0.15 nm and 3.5 K·ns/nm: the crystal turns,
    and so leaves it, but H does not change with its direction. The default interval is the book's, 0.2 ns, the default
    step its smallest for the Störmer–Verlet method, 40 fs.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., Springer 2006, I.4.2.
    .. [2] J. J. Biesiadecki, R. D. Skeel, "Dangers of multiple time step methods", J. Comput. Phys. 109 (1993) 318–328.
    """
    y0 = np.concatenate([POSITIONS.ravel(), MASS * VELOCITIES.ravel()])
    rest = np.concatenate([POSITIONS.ravel(), np.zeros(14)])
    return HamiltonianSystem(
        **_attraction_and_repulsion(),
        mass=MASS,
        name="lennard_jones",
        domain=Tube([rest, rest], np.repeat([0.15, 3.5], 14)),
        y0=y0,
        t_span=(0.0, 0.2),
        dt=4e-5,
    )


@cache
def _attraction_and_repulsion() -> dict[str, Any]:
    from numba import njit

    @njit(**OPTIONS)
    def potential(s: Any) -> Any:
        x = SIGMA * SIGMA / s
        x3 = x * x * x
        u6, u12 = -4 * EPSILON * x3, 4 * EPSILON * x3 * x3
        return u6 + u12, -(3 * u6 + 6 * u12) / s, (12 * u6 + 42 * u12) / (s * s)

    return pair_functions(potential, np.ones((7, 7)), 2)
