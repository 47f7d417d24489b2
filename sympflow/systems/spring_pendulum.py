"""The pendulum on a stiff spring: a fast oscillation whose direction turns."""

from __future__ import annotations

import math

from sympflow.domain import Box
from sympflow.system import HamiltonianSystem

GRAVITY = 1.0
ANGLE = 1.0  # of y0 from the downward vertical


def spring_pendulum(k: float = 100.0, coordinates: str = "cartesian", radial_energy: float = 0.0) -> HamiltonianSystem:
    """A unit mass on a spring of length 1 and stiffness k, in a plane, under gravity g = 1.

    In Cartesian coordinates, q₂ upwards, it is separable: H = (p₁² + p₂²)/2 + k(|q| − 1)²/2 + q₂. In polar ones,
    q₁ = r and q₂ = θ from the downward vertical, it is not, but has three parts that are solved exactly (the radial
    oscillator, the rotation, gravity): H = [p₁²/2 + k(q₁ − 1)²/2] + p₂²/(2q₁²) − q₁ cos q₂.

    Parameters
    ----------
    k : float
        Stiffness, from 1e-6 to 1e30; the fast frequency is √k.
    coordinates : "cartesian" or "polar"
    radial_energy : float
        Energy of the fast oscillation in y0: 0 starts on the slow manifold, ½ excites the fast mode.

    Notes
    -----
    y0 is at rest at θ = 1, with the spring drawn out to its instantaneous balance k(r − 1) = cos θ, so that without
    `radial_energy` the fast mode stays at O(1/k³) of the energy. Known truth: H(y0) = −cos(1)(1 + cos(1)/(2k)) plus
    the radial energy, in both coordinates. Errors are relative to g·length = 1. The domain is a box of angles up to 1.4
    and stretches up to twice those of the orbit. The default interval is (0, 20), the default step 0.1/√k.

    References
    ----------
    .. [1] U. M. Ascher, S. Reich, "The midpoint scheme and variants for Hamiltonian systems: advantages and pitfalls",
       SIAM J. Sci. Comput. 21 (1999) 1045–1065.
    """
    if not (isinstance(k, int | float) and 1e-6 <= k <= 1e30):
        raise ValueError(f"`k` must be positive, a stiffness from 1e-6 to 1e30; got {k!r}.")
    if not (isinstance(radial_energy, int | float) and 0 <= radial_energy < math.inf):
        raise ValueError(f"`radial_energy` must be finite and not negative; got {radial_energy!r}.")
    c, s = math.cos(ANGLE), math.sin(ANGLE)
    r, speed = 1 + GRAVITY * c / k, math.sqrt(2 * radial_energy)
    stretch = 2 * (speed / math.sqrt(k) + 3 * GRAVITY / k)  # at the bottom 2g(1 − cos 1) + g pull on the spring
    fast = 2 * (speed + 3 * GRAVITY / math.sqrt(k))
    if coordinates == "polar":
        expression = "p1**2/2 + k*(q1 - 1)**2/2 + p2**2/(2*q1**2) - g*q1*cos(q2)"
        y0 = [r, ANGLE, speed, 0.0]
        low, high = [max(1 - stretch, 0.1), -1.4, -fast, -1.5], [1 + stretch, 1.4, fast, 1.5]
    elif coordinates == "cartesian":
        expression = "(p1**2 + p2**2)/2 + k*(sqrt(q1**2 + q2**2) - 1)**2/2 + g*q2"
        y0 = [r * s, -r * c, speed * s, -speed * c]
        reach, p = 1 + stretch, 1.5 + fast
        low, high = [-reach, -reach, -p, -p], [reach, 0.1, p, p]
    else:
        raise ValueError(f"`coordinates` must be 'cartesian' or 'polar'; got {coordinates!r}.")
    return HamiltonianSystem.from_sympy(
        expression,
        params={"k": k, "g": GRAVITY},
        name="spring_pendulum",
        domain=Box(low, high),
        y0=y0,
        t_span=(0.0, 20.0),
        dt=0.1 / math.sqrt(k),
        energy_scale=GRAVITY,
    )
