"""The solar system: the Sun and its planets, for methods that follow each planet on its orbit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sympflow.hamiltonian.domain import Tube
from sympflow.hamiltonian.system import HamiltonianSystem

PLANETS = ("Mercury", "Venus", "Earth", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune")
UNITS = "AU", "day", "solar mass"

SUN_OVER_PLANET = np.array(  # the Sun's mass over that of each planet with its moons, DE405
    [6_023_600.0, 408_523.71, 328_900.561400, 3_098_708.0, 1047.3486, 3497.898, 22_902.98, 19_412.24]
)

TABLE = np.array(
    [  # a in AU, e, inclination, mean longitude, longitude of the perihelion, longitude of the node in degrees
        [0.38709927, 0.20563593, 7.00497902, 252.25032350, 77.45779628, 48.33076593],
        [0.72333566, 0.00677672, 3.39467605, 181.97909950, 131.60246718, 76.67984255],
        [1.00000261, 0.01671123, -0.00001531, 100.46457166, 102.93768193, 0.0],
        [1.52371034, 0.09339410, 1.84969142, -4.55343205, -23.94362959, 49.55953891],
        [5.20288700, 0.04838624, 1.30439695, 34.39644051, 14.72847983, 100.47390909],
        [9.53667594, 0.05386179, 2.48599187, 49.95424423, 92.59887831, 113.66242448],
        [19.18916464, 0.04725744, 0.77263783, 313.23810451, 170.95427630, 74.01692503],
        [30.06992276, 0.00859048, 1.77004347, -55.12002969, 44.96476227, 131.78422574],
    ]
)
"""At J2000.0, in the mean ecliptic and equinox of it; the Earth's row is the barycentre of Earth and Moon."""

_PHASES = 60  # of each planet's own path in the tube
_THICKNESS = 0.2  # of the tube, relative to each planet's distance and speed


def solar_system(planets: int | Sequence[str] = 8) -> HamiltonianSystem:
    """H = Σ|p_i|²/(2m_i) − G Σ_{i<j} m_i m_j/|q_i − q_j|: the Sun and eight planets, or some of them, from J2000.0 on.

    Lengths are in astronomical units, times in days, masses in solar masses; q and p list the bodies' three coordinates
    one body after the other, the Sun first, with the centre of mass at rest at the origin.

    Parameters
    ----------
    planets : int or sequence of str
        The number of planets from the Sun, 1 to 8, or their names, such as ("Jupiter", "Saturn").

    Notes
    -----
    Known truths: the total momentum is 0 and the angular momentum constant; the periods are 88.0, 224.7, 365.3, 687,
    4333, 10 759, 30 685 and 60 189 days. The planets' elements are mean ones that fit their positions from 1800 to 2050
    to some hundred thousandths of a radian, not the osculating ones of an ephemeris; there is neither relativity nor
    the Moon.

    The domain is a `Tube` about the ellipses. The default interval is 1,000 years, the default step a twentieth of the
    shortest period.

    References
    ----------
    .. [1] E. M. Standish, "Keplerian elements for approximate positions of the major planets", Solar System Dynamics
       Group, Jet Propulsion Laboratory, table 1.
    .. [2] E. M. Standish, "JPL planetary and lunar ephemerides, DE405/LE405", JPL Interoffice Memorandum 312.F-98-048,
       1998: masses.
    """
    from sympflow.hamiltonian.planets import gravity, placed

    names: Sequence[str] = ()
    if isinstance(planets, list | tuple):
        names = planets
    elif isinstance(planets, int) and not isinstance(planets, bool) and 1 <= planets <= len(PLANETS):
        names = PLANETS[:planets]
    if not names or not {*names} <= {*PLANETS} or len({*names}) < len(names):
        raise ValueError(f"`planets` must be a number from 1 to 8, or names of {', '.join(PLANETS)}; got {planets!r}.")
    rows = [PLANETS.index(name) for name in names]
    masses = np.concatenate([[1.0], 1 / SUN_OVER_PLANET[rows]])
    a, e, *angles = TABLE[rows].T
    inclination, longitude, perihelion, node = np.radians(angles)
    elements = np.stack([a, e, inclination, node, perihelion - node, longitude - perihelion], axis=-1)
    elements[:, 2:] = np.where(np.arange(4) > 0, np.mod(elements[:, 2:], 2 * np.pi), elements[:, 2:])
    G, phases = gravity(UNITS), np.repeat(elements[None], _PHASES, axis=0)
    phases[..., 5] += np.linspace(0, 2 * np.pi, _PHASES, endpoint=False)[:, None]
    orbit = placed(masses, G, phases)
    n = len(masses)
    size = np.sqrt((orbit.reshape(_PHASES, 2, n, 3) ** 2).sum(-1).mean(0))
    size[:, 0] = 1.0, 1e-3
    groups = [[*range(3 * i, 3 * i + 3), *range(3 * (n + i), 3 * (n + i) + 3)] for i in range(n)]
    return HamiltonianSystem.planets(
        masses,
        elements=elements,
        units=UNITS,
        name="solar_system",
        domain=Tube(orbit, np.repeat(_THICKNESS * size, 3), groups),
        t_span=(0.0, 365_250.0),
    )
