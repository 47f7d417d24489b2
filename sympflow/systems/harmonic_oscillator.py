"""The harmonic oscillator, the paper's first system and the simplest stiff one."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def harmonic_oscillator(omega: float = 1.0) -> HamiltonianSystem:
    """H = (p² + ω²q²)/2; period 2π/ω.

    Parameters
    ----------
    omega : float
        Angular frequency ω > 0.

    Notes
    -----
    The domain is the ellipse H < ω²·1.7²/2, that is |q| < 1.7: with ω = 1 it contains [−1.2, 1.2]². The default
    interval is 100 units of 1/ω and the default step 0.05/ω.
    """
    if not (isinstance(omega, int | float) and 0 < omega < math.inf):
        raise ValueError(f"`omega` must be positive and finite; got {omega!r}.")
    amplitude = 1.7
    return HamiltonianSystem.from_sympy(
        "(p**2 + omega**2*q**2)/2",
        params={"omega": omega},
        name="harmonic_oscillator",
        domain=EnergySublevel(
            (omega * amplitude) ** 2 / 2,
            Box([-amplitude, -omega * amplitude], [amplitude, omega * amplitude]),
        ),
        y0=[1.0, 0.0],
        t_span=(0.0, 100.0 / omega),
        dt=0.05 / omega,
    )
