"""A Hamiltonian that is not separable, solved by elliptic functions."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def nonseparable(amplitude: float = 3.0) -> HamiltonianSystem:
    """H = (q² + 1)(p² + 1)/2, which does not split into T(p) + V(q).

    Parameters
    ----------
    amplitude : float
        a > 0: y0 is q = −a, p = 0.

    Notes
    -----
    Known truth: q(t) = −a·cn(√(1 + a²) t | m) with the parameter m = a²/(1 + a²), and p = q′/(1 + q²); H = (1 + a²)/2,
    and the period is 4K(m)/√(1 + a²). The domain is H < (1 + 1.1²a²)/2, in which all orbits are closed.

    References
    ----------
    .. [1] M. Tao, "Explicit symplectic approximation of nonseparable Hamiltonians: algorithm and long time
       performance", Phys. Rev. E 94 (2016) 043303.
    """
    if not (isinstance(amplitude, int | float) and 0 < amplitude < math.inf):
        raise ValueError(f"`amplitude` must be positive and finite; got {amplitude!r}.")
    widest = 1.1 * amplitude  # of q and of p
    return HamiltonianSystem.from_sympy(
        "(q**2 + 1)*(p**2 + 1)/2",
        name="nonseparable",
        domain=EnergySublevel((1 + widest**2) / 2, Box([-widest] * 2, [widest] * 2)),
        y0=[-amplitude, 0.0],
        t_span=(0.0, 100.0),
        dt=0.05 / math.sqrt(1 + amplitude**2),
    )
