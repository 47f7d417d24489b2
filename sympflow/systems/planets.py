"""The solar system: the Sun and its planets, for methods that follow each planet on its orbit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sympflow.hamiltonian.domain import Tube
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.systems.celestial import digits

PLANETS = ("Mercury", "Venus", "Earth", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune")
UNITS = "AU", "day", "solar mass"

SUN_OVER_PLANET = np.array(  # the Sun's mass over that of each planet with its moons, DE405
    [6_023_600.0, 408_523.71, 328_900.561400, 3_098_708.0, 1047.3486, 3497.898, 22_902.98, 19_412.24]
)

STATES = np.array(
    [  # x, y, z in AU and their rates in AU a day, as seen from the Sun
        [-0.1300936030, -0.4472876191, -0.0245983102, 0.021366395652, -0.006447989486, -0.002487863990],
        [-0.7183022959, -0.0326543101, 0.0410141875, 0.000798117567, -0.020295218704, -0.000323451390],
        [-0.1771587879, 0.9672193518, -0.0000011464, -0.017203109043, -0.003163911925, 0.000000024316],
        [1.3907159218, -0.0134163141, -0.0344676652, 0.000671499474, 0.015187248095, 0.000301651653],
        [4.0011768812, 2.9385763339, -0.1017852686, -0.004568313982, 0.006443205813, 0.000075579673],
        [6.4064113390, 6.5699899336, -0.3690746350, -0.004292350203, 0.003890315850, 0.000102947967],
        [14.4318595982, -13.7343123910, -0.2381371059, 0.002678104817, 0.002672697133, -0.000024771979],
        [16.8120559831, -24.9917701761, 0.1272291482, 0.002579275595, 0.001776898889, -0.000095908896],
    ]
)
"""States of DE405 at J2000.0, JD 2451545.0, in the mean ecliptic and equinox of that date, with an obliquity of
84381.448″. The Earth's row is the barycentre of Earth and Moon, each other row that of a planet with its moons."""

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
    Known truths: the total momentum is 0 and the angular momentum constant; the mean periods are 88.0, 224.7, 365.3,
    687, 4333, 10 759, 30 685 and 60 189 days. There is neither relativity nor the Moon; with relativity as the `extra`
    of `HamiltonianSystem.planets` the secular frequencies of the outer planets are those of [2]_ to four digits.

    The domain is a `Tube` about the ellipses. The default interval is 1,000 years, the default step a twentieth of the
    shortest period.

    References
    ----------
    .. [1] E. M. Standish, "JPL planetary and lunar ephemerides, DE405/LE405", JPL Interoffice Memorandum 312.F-98-048,
       1998: states and masses.
    .. [2] J. Laskar and others, "A long-term numerical solution for the insolation quantities of the Earth", Astron.
       Astrophys. 428 (2004) 261–285.
    """
    from sympflow.hamiltonian.kepler import elements_of
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
    G = gravity(UNITS)
    x, v = np.split(STATES[rows], 2, axis=-1)
    elements = elements_of(x, v, G * (1 + masses[1:]))
    phases = np.repeat(elements[None], _PHASES, axis=0)
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
        domain=Tube(digits(orbit), digits(np.repeat(_THICKNESS * size, 3)), groups),
        t_span=(0.0, 365_250.0),
    )
