"""Textbook scenes of one to three degrees of freedom."""

from __future__ import annotations

import math

from sympflow.arguments import NOT_NEGATIVE, check_one_of, check_positive, checked_number, not_negative
from sympflow.arrays import Array
from sympflow.hamiltonian.domain import Box, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem


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
    return _oscillator("harmonic_oscillator", omega)


def damped_oscillator(omega: float = 1.0, damping: float = 0.1) -> HamiltonianSystem:
    """H = (p² + ω²q²)/2 with friction, p' = −ω²q − γp.

    Parameters
    ----------
    omega : float
        Angular frequency ω > 0 without friction, from 1e-100 to 1e100.
    damping : float
        γ ≥ 0: below 2ω the oscillator swings, from there on it creeps.

    Notes
    -----
    Known truth, with Ω² = ω² − γ²/4: q(t) = e^{−γt/2}(q₀ cos Ωt + (p₀ + γq₀/2) sin(Ωt)/Ω), with the hyperbolic
    functions where Ω² is negative; p = q'. The domain is that of `harmonic_oscillator`, which no motion leaves.

    References
    ----------
    .. [1] L. D. Landau, E. M. Lifshitz, "Mechanics", 3rd ed., Pergamon 1976, § 25.
    """
    return _oscillator("damped_oscillator", omega, damping)


def _oscillator(name: str, omega: float, damping: float = 0.0) -> HamiltonianSystem:
    checked_number("omega", omega, "positive and finite, from 1e-100 to 1e100", lambda x: 1e-100 <= x <= 1e100)
    high = [1.7, 1.7 * omega]
    return HamiltonianSystem.from_sympy(
        "(p**2 + omega**2*q**2)/2",
        params={"omega": omega},
        damping=checked_number("damping", damping, NOT_NEGATIVE, not_negative),
        name=name,
        domain=EnergySublevel(high[1] ** 2 / 2, Box([-x for x in high], high)),
        y0=[1.0, 0.0],
        t_span=(0.0, 100.0 / omega),
        dt=0.05 / omega,
    )


def damped_pendulum(damping: float = 0.1) -> HamiltonianSystem:
    """H = p²/2 + 1 − cos q with friction, p' = −sin q − γp.

    Parameters
    ----------
    damping : float
        γ ≥ 0.

    Notes
    -----
    Known truth: the rate of change of the energy is −γp², and of every area in the plane −γ times it: the flow is
    conformally symplectic. The domain is that of `pendulum`, H < 1.8, where all motions end at rest in q = 0.

    References
    ----------
    .. [1] R. McLachlan, M. Perlmutter, "Conformal Hamiltonian systems", J. Geom. Phys. 39 (2001) 276–300.
    """
    return _pendulum("damped_pendulum", 1.8, [1.5, 0.0], damping)


def _pendulum(name: str, energy: float, y0: list[float], damping: float = 0.0) -> HamiltonianSystem:
    """A pendulum in the domain below an energy."""
    q, p = math.acos(max(1 - energy, -1.0)), math.sqrt(2 * energy)
    return HamiltonianSystem.from_sympy(
        "p**2/2 + 1 - cos(q)",
        damping=checked_number("damping", damping, NOT_NEGATIVE, not_negative),
        name=name,
        domain=EnergySublevel(energy, Box([-q, -p], [q, p])),
        y0=y0,
        dt=0.05,
    )


def pendulum() -> HamiltonianSystem:
    """H = p²/2 + 1 − cos q, libration: the domain is H < 1.8 around q = 0 (the separatrix is H = 2)."""
    return _pendulum("pendulum", 1.8, [1.5, 0.0])


def pendulum_separatrix(energy: float = 2.0) -> HamiltonianSystem:
    """H = p²/2 + 1 − cos q from the bottom, q = 0, with the energy of the separatrix or any other.

    Parameters
    ----------
    energy : float
        H(y0) > 0: below 2 the pendulum swings, above it turns over.

    Notes
    -----
    Known truth: on the separatrix q(t) = 4 arctan(eᵗ) − π, p(t) = 2 sech t: it never reaches the top, while any error
    grows with exp(t). The domain is H < 2.5 in −π ≤ q ≤ π.

    References
    ----------
    .. [1] V. I. Arnold, "Mathematical Methods of Classical Mechanics", 2nd ed., Springer 1989, § 4.
    """
    check_positive("energy", energy)
    return _pendulum("pendulum_separatrix", 2.5, [0.0, math.sqrt(2 * energy)])


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
    check_positive("energy", energy)
    q, p = math.sqrt(1 + math.sqrt(2)), 1.0
    return HamiltonianSystem.from_sympy(
        "p**2/2 + (q**2 - 1)**2/4",
        name="double_well",
        domain=EnergySublevel(0.5, Box([-q, -p], [q, p])),
        y0=[math.sqrt(1 + 2 * math.sqrt(energy)), 0.0],
        dt=0.05,
        energy_scale=0.25,
    )


def quartic() -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 + (q₁⁴ + q₂⁴)/4 + 3 q₁²q₂²/10 + q₁²/5.

    The domain is H < 0.6, which is bounded. From y0 the energy is 0.419025.

    References
    ----------
    .. [1] A. Carnegie, I. C. Percival, "Regular and chaotic motion in some quartic potentials", J. Phys. A 17 (1984)
       801–813; with a quadratic term added.
    """
    energy = 0.6
    q1 = math.sqrt(2 * (math.sqrt(0.04 + energy) - 0.2))  # q₁⁴/4 + q₁²/5 = 0.6
    q2, p = (4 * energy) ** 0.25, math.sqrt(2 * energy)
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (q1**4 + q2**4)/4 + 3*q1**2*q2**2/10 + q1**2/5",
        name="quartic",
        domain=EnergySublevel(energy, Box([-q1, -q2, -p, -p], [q1, q2, p, p])),
        y0=[0.8, 0.5, 0.3, -0.4],
        dt=0.05,
    )


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
    check_positive("energy", energy)
    return _scene("henon_heiles_escape", [0.0, 0.0, 0.0, math.sqrt(2 * energy)])


def _scene(name: str, y0: list[float]) -> HamiltonianSystem:
    q1, p = math.sqrt(3) / 2, 1 / math.sqrt(3)
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + q1**2*q2 - q2**3/3",
        name=name,
        domain=EnergySublevel(1 / 6, Box([-q1, -0.5, -p, -p], [q1, 1.0, p, p])),
        y0=y0,
        dt=0.05,
    )


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
    checked_number("k", k, "positive, a stiffness from 1e-6 to 1e30", lambda x: 1e-6 <= x <= 1e30)
    checked_number("radial_energy", radial_energy, NOT_NEGATIVE, not_negative)
    check_one_of("coordinates", coordinates, ("cartesian", "polar"))
    c, s = math.cos(ANGLE), math.sin(ANGLE)
    r, speed = 1 + GRAVITY * c / k, math.sqrt(2 * radial_energy)
    stretch = 2 * (speed / math.sqrt(k) + 3 * GRAVITY / k)  # at the bottom 2g(1 − cos 1) + g pull on the spring
    fast = 2 * (speed + 3 * GRAVITY / math.sqrt(k))
    if coordinates == "polar":
        expression = "p1**2/2 + k*(q1 - 1)**2/2 + p2**2/(2*q1**2) - g*q1*cos(q2)"
        y0 = [r, ANGLE, speed, 0.0]
        low, high = [max(1 - stretch, 0.1), -1.4, -fast, -1.5], [1 + stretch, 1.4, fast, 1.5]
    else:
        expression = "(p1**2 + p2**2)/2 + k*(sqrt(q1**2 + q2**2) - 1)**2/2 + g*q2"
        y0 = [r * s, -r * c, speed * s, -speed * c]
        reach, p = 1 + stretch, 1.5 + fast
        low, high = [-reach, -reach, -p, -p], [reach, 0.1, p, p]
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
    check_positive("amplitude", amplitude)
    widest = 1.1 * amplitude  # of q and of p
    return HamiltonianSystem.from_sympy(
        "(q**2 + 1)*(p**2 + 1)/2",
        name="nonseparable",
        domain=EnergySublevel((1 + widest**2) / 2, Box([-widest] * 2, [widest] * 2)),
        y0=[-amplitude, 0.0],
        dt=0.05 / math.sqrt(1 + amplitude**2),
    )


def double_pendulum() -> HamiltonianSystem:
    """Two unit masses on unit rods with g = 1; the angles q₁ and q₂ are from the downward vertical.

    H = (p₁² + 2p₂² − 2p₁p₂ cos(q₁ − q₂)) / (2(1 + sin²(q₁ − q₂))) − 2 cos q₁ − cos q₂.

    Notes
    -----
    Known truth: small oscillations about the rest have the angular frequencies √(2 ± √2), and the angle of the second
    rod is ∓√2 times that of the first. At rest H is −3. The domain is H < −2, in which no rod turns over; from y0,
    the angles 0.6 and 0.8 at rest, H = −2 cos 0.6 − cos 0.8.

    References
    ----------
    .. [1] L. D. Landau, E. M. Lifshitz, "Mechanics", 3rd ed., Butterworth–Heinemann 1976, § 5 and § 23.
    """
    box = Box(low=[-1.1, -1.65, -2.1, -1.5], high=[1.1, 1.65, 2.1, 1.5])
    return HamiltonianSystem.from_sympy(
        "(p1**2 + 2*p2**2 - 2*p1*p2*cos(q1 - q2))/(2*(1 + sin(q1 - q2)**2)) - 2*cos(q1) - cos(q2)",
        name="double_pendulum",
        domain=EnergySublevel(-2.0, box),
        y0=[0.6, 0.8, 0.0, 0.0],
        dt=0.05,
    )


def charged_particle(field: float = 10.0) -> HamiltonianSystem:
    """H = |p − A(q)|²/2, A = B(1 + q₃²)(−q₂, q₁, 0)/2: a unit charge and mass in a magnetic bottle.

    The field is (−B q₁q₃, −B q₂q₃, B(1 + q₃²)): its strength on the axis doubles from the middle to q₃ = 1, and the
    particle is reflected where it is strong.

    Parameters
    ----------
    field : float
        B from 5 to 100, the strength in the middle and the angular frequency of the gyration there.

    Notes
    -----
    Known truths: the speed √(2H) and q₁p₂ − q₂p₁ are constant. In the plane q₃ = 0 the particle gyrates with frequency
    B; about a gyration around the axis, small oscillations along it have the speed as their frequency. The magnetic
    moment, `magnetic_moment`, is an adiabatic invariant: for large B it is nearly constant.

    From y0, at (½, 0, 0) with a velocity of (0, 1, ½), H = 5/8, and the gyration has a radius of 1/B; it is
    reflected near |q₃| = ½. The domain is H < 0.7 in a box about the bottle. The default interval is (0, 50), the
    default step 0.1/B.

    References
    ----------
    .. [1] T. G. Northrop, "The Adiabatic Motion of Charged Particles", Interscience 1963, chapter 1.
    """
    checked_number("field", field, "positive, a strength from 5 to 100", lambda x: 5 <= x <= 100)
    radius, length = 0.75 + 2 / field, 0.8
    p = math.sqrt(1.4)  # the speed in the domain
    across = p + field * (1 + length**2) * radius / 2
    high = [radius, radius, length, across, across, p]
    return HamiltonianSystem.from_sympy(
        "((p1 + B*(1 + q3**2)*q2/2)**2 + (p2 - B*(1 + q3**2)*q1/2)**2 + p3**2)/2",
        params={"B": field},
        name="charged_particle",
        domain=EnergySublevel(0.7, Box([-x for x in high], high)),
        y0=[0.5, 0.0, 0.0, 0.0, 1 + field / 4, 0.5],
        t_span=(0.0, 50.0),
        dt=0.1 / field,
    )


def magnetic_moment(system: HamiltonianSystem, y: Array) -> Array:
    """The magnetic moment v⊥²/(2|B|) of `charged_particle`, v⊥ across the field: (..., 6) to (...).

    For a solution, y is ``sol.states``.

    Raises
    ------
    ValueError
        If the system is not `charged_particle`.
    """
    if system.name != "charged_particle":
        raise ValueError(f"`system` must be charged_particle(...), whose field is known; got {system.name!r}.")
    B, q1, q2, q3, v3 = system.params["B"], y[..., 0], y[..., 1], y[..., 2], y[..., 5]
    axial = B * (1 + q3**2)
    v1, v2 = y[..., 3] + axial * q2 / 2, y[..., 4] - axial * q1 / 2
    strength2 = axial**2 + (B * q3) ** 2 * (q1**2 + q2**2)
    along = axial * v3 - B * q3 * (q1 * v1 + q2 * v2)
    return (v1**2 + v2**2 + v3**2 - along**2 / strength2) / (2 * strength2**0.5)
