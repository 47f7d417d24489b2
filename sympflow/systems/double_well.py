"""The double well, with its separatrix."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def double_well(energy: float = 0.25) -> HamiltonianSystem:
    """H = p²/2 + (q² − 1)²/4: wells at q = ±1, a saddle of energy ¼ between them.

    Parameters
    ----------
    energy : float
        H(y0) > 0: y0 is the outer turning point q = √(1 + 2√energy), p = 0. With ¼, the default, it lies on the
        separatrix, below ¼ within the right well.

    Notes
    -----
    Known truth: on the separatrix q(t) = √2 sech t, p(t) = −√2 sech t tanh t. As any error grows with exp(t) there,
    a numerical solution comes back from the saddle after t ≈ ln(1/error). The domain is H < ½.

    References
    ----------
    .. [1] J. Guckenheimer, P. Holmes, "Nonlinear Oscillations, Dynamical Systems, and Bifurcations of Vector Fields",
       Springer 1983, 2.2 and 4.5 (Duffing's equation).
    """
    if not (isinstance(energy, int | float) and 0 < energy < math.inf):
        raise ValueError(f"`energy` must be positive and finite; got {energy!r}.")
    q, p = math.sqrt(1 + math.sqrt(2)), 1.0
    return HamiltonianSystem.from_sympy(
        "p**2/2 + (q**2 - 1)**2/4",
        name="double_well",
        domain=EnergySublevel(0.5, Box([-q, -p], [q, p])),
        y0=[math.sqrt(1 + 2 * math.sqrt(energy)), 0.0],
        t_span=(0.0, 100.0),
        dt=0.05,
        energy_scale=0.25,
    )
