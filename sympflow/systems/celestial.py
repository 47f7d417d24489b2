"""Celestial scenes: the Kepler problem and its relativistic twin, the Pythagorean three-body problem, the planets."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from sympflow.arguments import checked_number
from sympflow.hamiltonian.domain import Box, Domain, EnergySublevel, Tube
from sympflow.hamiltonian.doubling import DoubledSystem, doubled
from sympflow.hamiltonian.system import HamiltonianSystem

_WIDEST = 0.9  # above it a uniform draw hardly ever meets the thin shell of the family


def kepler(e: float = 0.6) -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 − 1/√(q₁² + q₂²): motion about a unit mass, on an ellipse of eccentricity e.

    Parameters
    ----------
    e : float
        Eccentricity, 0 ≤ e < 1, of the ellipse that starts from y0, at its pericentre q = (1 − e, 0). Its semi-major
        axis is 1, its period 2π.

    Notes
    -----
    Known truths: H = −1/2 and q₁p₂ − q₂p₁ = √(1 − e²) from y0, and y(2πk) = y0.

    The domain is the shell of all orbits, at any angle and in both senses, with a semi-major axis from 0.95 to 1.05 and
    an angular momentum from 0.9625 to 1.075 times that of the ellipse; for e > 0.9 a `Tube` around the ellipse. The
    default interval is 100 periods, the default step a thousandth of one.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., Springer 2006, I.2.
    """
    checked_number("e", e, "an eccentricity, 0 ≤ e < 1", lambda x: 0 <= x < 1)
    period = 2 * math.pi
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)",
        name="kepler",
        domain=_shell(e) if e <= _WIDEST else Tube(kepler_ellipse(e, np.linspace(0, period, 1025)), 0.05 * (1 - e)),
        y0=[1 - e, 0.0, 0.0, math.sqrt((1 + e) / (1 - e))],
        t_span=(0.0, 100 * period),
        dt=period / 1000,
    )


def kepler_ellipse(e: float, anomaly: np.ndarray) -> np.ndarray:
    """States [q, p] on the ellipse at eccentric anomalies E, (...) to (..., 4); the time there is E − e·sin E."""
    c, s, b = np.cos(anomaly), np.sin(anomaly), math.sqrt(1 - e * e)
    r = 1 - e * c
    return np.stack([c - e, b * s, -s / r, b * c / r], axis=-1)


def decaying_orbit(drag: float = 0.002, e: float = 0.3) -> DoubledSystem:
    """H = (p₁² + p₂²)/2 − 1/√(q₁² + q₂²) with the drag −k p/(q₁² + q₂²), doubled: an orbit that falls inwards.

    Drag of this form, through dust whose density falls with 1/r², has an exact solution.

    Parameters
    ----------
    drag : float
        k, 0 < k ≤ 0.003.
    e : float
        Eccentricity, 0 ≤ e ≤ 0.6, of the ellipse without drag that starts as this orbit does, at q = (1 − e, 0).

    Notes
    -----
    Known truth: with the polar angle φ the angular momentum is L = √(1 − e²) − kφ, and u = 1/r solves
    u'' + u = 1/L(φ)², a linear equation; so L = 0 would be reached after √(1 − e²)/(2πk) turns. The default interval is
    five turns of the ellipse without drag, the default step 1/500 of one.

    The states are [q₁, q₂, q₁₋, q₂₋, p₁₋, p₂₋, p₁, p₂], see `sympflow.doubled`; `y0` may be a physical one. The domain
    is a box about the orbits, which the physical part of the default run does not leave.

    References
    ----------
    .. [1] D. Mittleman, D. Jezewski, "An analytic solution to the classical two-body problem with drag", Celest. Mech.
       28 (1982) 401–413.
    """
    checked_number("drag", drag, "positive, at most 0.003", lambda x: 0 < x <= 0.003)
    checked_number("e", e, "an eccentricity, 0 ≤ e ≤ 0.6", lambda x: 0 <= x <= 0.6)
    orbit = kepler(e)
    p = 1.25 * math.sqrt((1 + e) / (1 - e))
    high = np.array([1.2 * (1 + e), 1.2 * (1 + e), 0.1, 0.1, 0.1, 0.1, p, p])
    return doubled(
        HamiltonianSystem.from_sympy(
            orbit.symbols.H,
            name="kepler",
            y0=orbit.y0,
            t_span=(0.0, 10 * math.pi),
            dt=2 * math.pi / 500,
        ),
        ["-k*p1/(q1**2 + q2**2)", "-k*p2/(q1**2 + q2**2)"],
        params={"k": drag},
        domain=Box(-high, high),
        name="decaying_orbit",
    )


def _shell(e: float) -> Domain:
    low, high = -1 / (2 * 0.95), -1 / (2 * 1.05)  # the energy of a semi-major axis a is −1/(2a)
    L = math.sqrt(1 - e * e)
    momentum = 0.9625 * L, 1.075 * L
    widest = math.sqrt(1 + 2 * high * momentum[0] ** 2)
    q, p = 1.05 * (1 + widest), (1 + widest) / momentum[0]  # apocentre, and speed at pericentre
    return EnergySublevel(high, Box([-q, -q, -p, -p], [q, q, p, p]), above=low, angular_momentum=momentum)


def schwarzschild(semilatus: float = 12.0, e: float = 0.5) -> HamiltonianSystem:
    """H = [(1 − 2/r) p_r² + p_φ²/r² − E²/(1 − 2/r)]/2: a test particle about a black hole of unit mass, G = c = 1.

    q = (r, φ) and p = (p_r, p_φ) in the plane of the orbit, in Schwarzschild's coordinates; the coordinate time is
    eliminated by its constant momentum −E, and t is the proper time. On the orbit H = −1/2.

    Parameters
    ----------
    semilatus : float
        ℓ > 6 + 2e, up to 1e6: the orbit from y0 goes from r = ℓ/(1 + e), where it starts with φ = 0, to ℓ/(1 − e).
    e : float
        Eccentricity, 0 ≤ e ≤ 0.95.

    Notes
    -----
    Known truths: H = −1/2, p_φ = ℓ/√(ℓ − 3 − e²), E² = ((ℓ − 2)² − 4e²)/(ℓ(ℓ − 3 − e²)); from one perihelion to the
    next φ grows by `perihelion_angle`, which is 2π for Kepler's ellipse and about 2π + 6π/ℓ far out.

    The domain holds the orbits of the same E with |H + 1/2| < 0.01/ℓ near this one, and φ of the default interval. That
    is 20 periods of the ellipse with the same ends; the default step is a 500th of one.

    References
    ----------
    .. [1] C. Darwin, "The gravity field of a particle", Proc. R. Soc. Lond. A 249 (1959) 180–194.
    .. [2] S. Chandrasekhar, "The Mathematical Theory of Black Holes", Oxford 1983, § 19.
    """
    _check_orbit(semilatus, e)
    L = semilatus / math.sqrt(semilatus - 3 - e * e)
    E2 = ((semilatus - 2) ** 2 - 4 * e * e) / (semilatus * (semilatus - 3 - e * e))
    period = 2 * math.pi * (semilatus / (1 - e * e)) ** 1.5
    inner, outer = semilatus / (1 + e), semilatus / (1 - e)
    widest = 21 * perihelion_angle(semilatus, e)
    p_r = 2 * (e + 0.1) / math.sqrt(semilatus - 6 - 2 * e)
    return HamiltonianSystem.from_sympy(
        "((1 - 2/q1)*p1**2 + p2**2/q1**2 - E2/(1 - 2/q1))/2",
        params={"E2": E2},
        name="schwarzschild",
        domain=EnergySublevel(
            -0.5 + 0.01 / semilatus,
            Box([0.98 * inner, -1.0, -p_r, 0.99 * L], [1.02 * outer, widest, p_r, 1.01 * L]),
            above=-0.5 - 0.01 / semilatus,
        ),
        y0=[inner, 0.0, 0.0, L],
        t_span=(0.0, 20 * period),
        dt=period / 500,
    )


def perihelion_angle(semilatus: float, e: float) -> float:
    """The angle φ from one perihelion to the next of an orbit of `schwarzschild`: 4√(ℓ/μ) K(4e/μ), μ = ℓ − 6 + 2e.

    K is the complete elliptic integral of the first kind of the parameter m. What exceeds 2π is the advance of the
    perihelion.

    Raises
    ------
    ValueError
        If there is no such orbit.
    """
    _check_orbit(semilatus, e)
    mu = semilatus - 6 + 2 * e
    a, b = 1.0, math.sqrt(1 - 4 * e / mu)  # K is π/2 over their arithmetic–geometric mean
    while abs(a - b) > 1e-15 * a:
        a, b = (a + b) / 2, math.sqrt(a * b)
    return 2 * math.pi * math.sqrt(semilatus / mu) / a


def _check_orbit(semilatus: float, e: float) -> None:
    checked_number("e", e, "an eccentricity, 0 ≤ e ≤ 0.95", lambda x: 0 <= x <= 0.95)
    if not (isinstance(semilatus, int | float) and 6 + 2 * e < semilatus <= 1e6):
        raise ValueError(
            f"`semilatus` must be above 6 + 2e = {6 + 2 * e:g}, within which no orbit is bound and stable, and at most "
            f"1e6; got {semilatus!r}."
        )


MASSES = (3, 4, 5)


def three_body() -> HamiltonianSystem:
    """H = Σ|p_i|²/(2m_i) − Σ_{i<j} m_i m_j/|q_i − q_j|, d = 6, in a plane.

    Masses of 3, 4 and 5 are at rest at the corners of a triangle, each opposite the side of its own length. q and p
    list the bodies' two coordinates one body after the other.

    Notes
    -----
    Known truths: H(y0) = −769/60 = −12.81666…; momentum and angular momentum are 0. After many close encounters, the
    closest of them to 4.14e-4 at t = 15.8299, the lightest body is thrown out. At t = 70 the bodies are at
    (6.933464, 20.261804), (−2.003006, −6.872463), (−2.557673, −6.659112), where hardly a method gets: energy errors say
    little here.

    The domain is a box that holds the bodies until t = 70, except for the momenta of close encounters: it is not
    suitable for training. The default interval is (0, 70), the default step 1e-4.

    References
    ----------
    .. [1] C. Burrau, "Numerische Berechnung eines Spezialfalles des Dreikörperproblems", Astron. Nachr. 195 (1913)
       113–118.
    .. [2] V. Szebehely, C. F. Peters, "Complete solution of a general problem of three bodies", Astron. J. 72 (1967)
       876–883.
    """
    kinetic = " + ".join(f"(p{2 * i + 1}**2 + p{2 * i + 2}**2)/{2 * m}" for i, m in enumerate(MASSES))
    attraction = " - ".join(
        f"{MASSES[i] * MASSES[j]}/sqrt((q{2 * i + 1} - q{2 * j + 1})**2 + (q{2 * i + 2} - q{2 * j + 2})**2)"
        for i, j in combinations(range(3), 2)
    )
    high = [25.0] * 6 + [50.0] * 6
    return HamiltonianSystem.from_sympy(
        f"{kinetic} - {attraction}",
        name="three_body",
        domain=Box([-x for x in high], high),
        y0=[1.0, 3.0, -2.0, -1.0, 1.0, -1.0, *[0.0] * 6],
        t_span=(0.0, 70.0),
        dt=1e-4,
    )


G = 2.95912208286e-4
"""Gravitational constant in AU³ per day² and solar mass."""

BODIES = ("Sun", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")

PLANET_MASSES = np.array(
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
    one body after the other.

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
    q, v = (x - PLANET_MASSES @ x / PLANET_MASSES.sum() for x in (POSITIONS, VELOCITIES))
    y0 = np.concatenate([q.ravel(), (PLANET_MASSES[:, None] * v).ravel()])
    return HamiltonianSystem.pairs(
        "-G*m1*m2/r",
        masses=PLANET_MASSES,
        params={"G": G},
        name="outer_solar_system",
        domain=_tube(q, v),
        y0=y0,
        t_span=(0.0, 200_000.0),
        dt=50.0,
    )


def digits(x: np.ndarray) -> np.ndarray:
    """Numbers with five digits: a domain is kept in the files of flows."""
    return np.vectorize(lambda number: float(f"{number:.5g}"))(x)


def _tube(q: np.ndarray, v: np.ndarray) -> Tube:
    """Around the path of each body, found by leapfrog: it is off by far less than the thickness."""
    h, n = 100.0, int(_PERIOD / 100)
    states = []
    for k in range(n):
        q = q + h / 2 * v
        away = q[:, None] - q
        cubes = (away**2).sum(-1, keepdims=True) ** 1.5 + np.eye(6)[..., None]
        v = v - h * G * (PLANET_MASSES[:, None] * away / cubes).sum(1)
        q = q + h / 2 * v
        if k % 4 == 0:
            states.append([q, PLANET_MASSES[:, None] * v])
    orbit = np.array(states)  # (n, 2, body, axis)
    size = np.sqrt((orbit**2).sum(-1).mean(0))  # (2, body)
    radius = np.repeat(np.where(np.arange(6) == 0, 1.0, _THICKNESS) * size, 3)
    groups = [[*range(3 * i, 3 * i + 3), *range(18 + 3 * i, 21 + 3 * i)] for i in range(6)]
    return Tube(digits(orbit.reshape(len(orbit), 36)), digits(radius), groups)
