"""The Hénon–Heiles system, the paper's second: two degrees of freedom, regular and chaotic orbits."""

from __future__ import annotations

import math

from sympflow.domain import Box, EnergySublevel
from sympflow.system import HamiltonianSystem


def henon_heiles() -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 + (q₁² + q₂²)/2 + q₁²q₂ − q₂³/3.

    The domain is the bounded well below the escape energy 1/6. Its configuration part is the equilateral triangle with
    the saddles (0, 1), (±√3/2, −1/2) as corners, so the box that encloses it picks the bounded component.

    References
    ----------
    .. [1] M. Hénon, C. Heiles, "The applicability of the third integral of motion: some numerical experiments",
       Astron. J. 69 (1964) 73–79.
    """
    return _scene("henon_heiles", [0.3, -0.3, 0.3, 0.15])


def henon_heiles_escape(energy: float = 0.245) -> HamiltonianSystem:
    """The same H from the centre of the well, q = 0, straight towards the saddle at (0, 1), whose energy is 1/6.

    Parameters
    ----------
    energy : float
        H(y0) > 0. Up to 1/6 the orbit stays on the axis q₁ = 0 within the well, above it escapes.

    Notes
    -----
    Known truth: above 1/6 the solution ends in finite time, t* = ∫₀^∞ dq/√(2·energy − q² + 2q³/3): at
    5.450984210235402 for 0.245, that is p = (0, 0.7). Near t* it is q₂ = 6/(t* − t)² to leading order.

    The domain is the bounded well below 1/6, as for `henon_heiles`.
    """
    if not (isinstance(energy, int | float) and 0 < energy < math.inf):
        raise ValueError(f"`energy` must be positive and finite; got {energy!r}.")
    return _scene("henon_heiles_escape", [0.0, 0.0, 0.0, math.sqrt(2 * energy)])


def _scene(name: str, y0: list[float]) -> HamiltonianSystem:
    q1, p = math.sqrt(3) / 2, 1 / math.sqrt(3)
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + q1**2*q2 - q2**3/3",
        name=name,
        domain=EnergySublevel(1 / 6, Box([-q1, -0.5, -p, -p], [q1, 1.0, p, p])),
        y0=y0,
        t_span=(0.0, 100.0),
        dt=0.05,
    )
