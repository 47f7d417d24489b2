"""The Kepler problem, from round orbits to close encounters."""

from __future__ import annotations

import math

import numpy as np

from sympflow.domain import Box, Domain, EnergySublevel
from sympflow.system import HamiltonianSystem
from sympflow.tube import Tube

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
    if not (isinstance(e, int | float) and 0 <= e < 1):
        raise ValueError(f"`e` must be an eccentricity, 0 ≤ e < 1; got {e!r}.")
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


def _shell(e: float) -> Domain:
    low, high = -1 / (2 * 0.95), -1 / (2 * 1.05)  # the energy of a semi-major axis a is −1/(2a)
    L = math.sqrt(1 - e * e)
    momentum = 0.9625 * L, 1.075 * L
    widest = math.sqrt(1 + 2 * high * momentum[0] ** 2)
    q, p = 1.05 * (1 + widest), (1 + widest) / momentum[0]  # apocentre, and speed at pericentre
    return EnergySublevel(high, Box([-q, -q, -p, -p], [q, q, p, p]), above=low, angular_momentum=momentum)
