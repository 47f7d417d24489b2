"""The Sun and the five outer planets."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from sympflow.system import HamiltonianSystem
from sympflow.systems.pairs import OPTIONS, pair_functions
from sympflow.tube import Tube

G = 2.95912208286e-4
"""Gravitational constant in AU³ per day² and solar mass."""

BODIES = ("Sun", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")

MASSES = np.array(
    [1.00000597682, 0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449, 1 / 1.3e8]
)
"""In solar masses; the Sun's includes the inner planets."""

POSITIONS = np.array(
    [
        [0.0, 0.0, 0.0],
        [-3.5023653, -3.8169847, -1.5507963],
        [9.0755314, -3.0458353, -1.6483708],
        [8.3101420, -16.2901086, -7.2521278],
        [11.4707666, -25.7294829, -10.8169456],
        [-15.5387357, -25.2225594, -3.1902382],
    ]
)
"""Heliocentric, in astronomical units, on 5 September 1994 at 0 h."""

VELOCITIES = np.array(
    [
        [0.0, 0.0, 0.0],
        [0.00565429, -0.00412490, -0.00190589],
        [0.00168318, 0.00483525, 0.00192462],
        [0.00354178, 0.00137102, 0.00055029],
        [0.00288930, 0.00114527, 0.00039677],
        [0.00276725, -0.00170702, -0.00136504],
    ]
)
"""Heliocentric, in astronomical units per day."""

_PERIOD = 90_600.0  # of Pluto, in days: the longest
_THICKNESS = 0.2  # of the tube, relative to each planet's distance and speed


def outer_solar_system() -> HamiltonianSystem:
    """H = Σ|p_i|²/(2m_i) − G Σ_{i<j} m_i m_j/|q_i − q_j|, d = 18: Sun, Jupiter, Saturn, Uranus, Neptune, Pluto.

    Lengths are in astronomical units, times in days, masses in solar masses; q and p list the bodies' three coordinates
    one body after the other. It is given by Numba functions.

    Notes
    -----
    y0 holds the book's data, which has the Sun at rest at the origin, as seen from the centre of mass: so the bodies
    stay where they are. Known truths: the total momentum is 0 and the angular momentum constant; Jupiter's period is
    4332 days.

    The domain is a `Tube` around the orbit over one period of Pluto, in which each body is near its own path, at any
    phase; the orbit stays in it for 1e5 years. The default interval is the book's, (0, 200000) days, the default step
    50 days.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., Springer 2006, I.2.4: data from
       "Ahnerts Kalender für Sternfreunde 1994", Johann Ambrosius Barth Verlag 1993.
    """
    q, v = (x - MASSES @ x / MASSES.sum() for x in (POSITIONS, VELOCITIES))
    y0 = np.concatenate([q.ravel(), (MASSES[:, None] * v).ravel()])
    return HamiltonianSystem(
        **_gravity(),
        mass=np.repeat(MASSES, 3),
        name="outer_solar_system",
        domain=_tube(q, v),
        y0=y0,
        t_span=(0.0, 200_000.0),
        dt=50.0,
    )


@cache
def _gravity() -> dict[str, Any]:
    from numba import njit

    @njit(**OPTIONS)
    def attraction(s: Any) -> Any:
        r = np.sqrt(s)
        return -1 / r, 0.5 / (s * r), -0.75 / (s * s * r)

    return pair_functions(attraction, G * np.outer(MASSES, MASSES), 3)


def _tube(q: np.ndarray, v: np.ndarray) -> Tube:
    """Around the path of each body, found by leapfrog: it is off by far less than the thickness."""
    h, n = 100.0, int(_PERIOD / 100)
    states = []
    for k in range(n):
        q = q + h / 2 * v
        away = q[:, None] - q
        cubes = (away**2).sum(-1, keepdims=True) ** 1.5 + np.eye(6)[..., None]
        v = v - h * G * (MASSES[:, None] * away / cubes).sum(1)
        q = q + h / 2 * v
        if k % 4 == 0:
            states.append([q, MASSES[:, None] * v])
    orbit = np.array(states)  # (n, 2, body, axis)
    size = np.sqrt((orbit**2).sum(-1).mean(0))  # (2, body)
    radius = np.repeat(np.where(np.arange(6) == 0, 1.0, _THICKNESS) * size, 3)
    groups = [[*range(3 * i, 3 * i + 3), *range(18 + 3 * i, 21 + 3 * i)] for i in range(6)]
    digits = np.vectorize(lambda x: float(f"{x:.5g}"))  # a domain is kept in the files of flows
    return Tube(digits(orbit.reshape(len(orbit), 36)), digits(radius), groups)
