"""The harmonic oscillator, the paper's first system and the simplest stiff one."""

from __future__ import annotations

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def harmonic_oscillator(omega: float = 1.0) -> HamiltonianSystem:
    """H = (p² + ω²q²)/2; period 2π/ω.

    Parameters
    ----------
    omega : float
        Angular frequency ω > 0, from 1e-100 to 1e100, so that ω² is a floating-point number.

    Notes
    -----
    The domain is the ellipse H < ω²·1.7²/2, that is |q| < 1.7: with ω = 1 it contains [−1.2, 1.2]². The default
    interval is 100 units of 1/ω and the default step 0.05/ω.
    """
    if not (isinstance(omega, int | float) and 1e-100 <= omega <= 1e100):
        raise ValueError(f"`omega` must be positive and finite, from 1e-100 to 1e100; got {omega!r}.")
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
