"""The Pythagorean three-body problem."""

from __future__ import annotations

from itertools import combinations

from sympflow.domain import Box
from sympflow.system import HamiltonianSystem

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

    The domain is a box that holds the bodies until t = 70, but for the momenta of close encounters: nothing to train
    on. The default interval is (0, 70), the default step 1e-4.

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
