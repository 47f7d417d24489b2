"""Driven scenes, H(t, q, p): of these no energy is known, but the map of a period."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from sympflow.arguments import NOT_NEGATIVE, check_positive, checked_count, checked_number, not_negative
from sympflow.hamiltonian.domain import Box
from sympflow.hamiltonian.system import HamiltonianSystem


def driven_pendulum(amplitude: float = 0.3, frequency: float = 2.7) -> HamiltonianSystem:
    """H = p²/2 − (1 + a cos wt) cos q, a pendulum whose pivot shakes up and down.

    Parameters
    ----------
    amplitude : float
        a > 0 of the drive.
    frequency : float
        w > 0, its angular frequency; that of small oscillations without drive is 1.

    Notes
    -----
    Known truth: small deviations x from rest follow Mathieu's equation x'' + (α − 2β cos 2τ)x = 0 in τ = wt/2, with
    α = 4/w² about q = 0 and −4/w² about q = π, and |β| = 2a/w² for both. So q = 0 is unstable where α lies between
    Mathieu's characteristic values b_n(β) and a_n(β), near w = 2/n; and q = π, upright, is stable where −4/w² > a₀(β),
    for large w where a > √2 w.

    The domain is a box about the regular orbits; those near the separatrix are chaotic. The default interval is
    (0, 100), the default step the largest up to 0.05 that divides the period 2π/w.

    References
    ----------
    .. [1] L. D. Landau, E. M. Lifshitz, "Mechanics", 3rd ed., Pergamon 1976, § 27 and § 30.
    """
    period = 2 * math.pi / positive("frequency", frequency)
    return HamiltonianSystem.from_sympy(
        "p**2/2 - (1 + a*cos(w*t))*cos(q)",
        params={"a": positive("amplitude", amplitude), "w": frequency},
        time="t",
        period=period,
        name="driven_pendulum",
        domain=Box([-2.0, -1.6], [2.0, 1.6]),
        y0=[1.0, 0.0],
        dt=_dividing(period, 0.05),
    )


def paul_trap(a: float = 0.0, q: float = 0.4) -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 + (a − 2q cos 2t)(q₁² − q₂²)/2, an ion in a linear quadrupole trap, or mass filter.

    Parameters
    ----------
    a, q : float
        Mathieu's parameters, of the constant and of the oscillating voltage, q not 0. In H and in `system.params` the
        latter is called `drive`, for q is a position.

    Notes
    -----
    Known truth: q₁'' + (a − 2q cos 2t)q₁ = 0 is Mathieu's equation, and so is that of q₂ with −a and −q. The trap holds
    the ion where both are stable, for small a and q where |a| < −a₀(q) and |a| < b₁(q): with a = 0 up to
    q = 0.9080463337, where b₁(q) = 0; the tip of this region is at q = 0.7060, a = 0.2370. Where a is the
    characteristic value a₀(q), q₁ = ce₀(t, q) is a periodic orbit.

    The unit of time is 2/Ω, with Ω the angular frequency of the voltage: H has the period π. The default interval is
    (0, 100), the default step π/64.

    References
    ----------
    .. [1] W. Paul, "Electromagnetic traps for charged and neutral particles", Rev. Mod. Phys. 62 (1990) 531–540.
    .. [2] NIST Digital Library of Mathematical Functions, chapter 28, https://dlmf.nist.gov/28.
    """
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + (a - 2*drive*cos(2*t))*(q1**2 - q2**2)/2",
        params={"a": checked_number("a", a), "drive": _not_zero("q", q)},
        time="t",
        period=math.pi,
        name="paul_trap",
        domain=Box([-2.0] * 4, [2.0] * 4),
        y0=[1.0, 0.5, 0.0, 0.0],
        dt=math.pi / 64,
        energy_scale=1.0,
    )


def duffing(
    damping: float = 0.25, force: float = 0.3, frequency: float = 1.0, alpha: float = -1.0, beta: float = 1.0
) -> HamiltonianSystem:
    """Duffing's oscillator, q'' = −αq − βq³ − δq' + F cos wt: H = p²/2 + αq²/2 + βq⁴/4 − Fq cos wt with friction.

    Parameters
    ----------
    damping : float
        δ ≥ 0; 0 for the conservative oscillator.
    force, frequency : float
        F, not 0, and w > 0, of the drive.
    alpha, beta : float
        The spring: α < 0 makes two wells; β > 0.

    Notes
    -----
    Known truth: areas shrink by e^{−δt}; so the two Floquet multipliers of every periodic orbit have the product
    e^{−δT}, T = 2π/w, and the two Lyapunov exponents the sum −δ. The default values are those of the strange attractor
    in [1]_, on which |q| < 1.6 and |p| < 1.1, about.

    The domain is a box about the attractor. The default interval is (0, 100), the default step the largest up to 0.05
    that divides the period.

    References
    ----------
    .. [1] J. Guckenheimer, P. Holmes, "Nonlinear Oscillations, Dynamical Systems, and Bifurcations of Vector Fields",
       Springer 1983, 2.2.
    """
    period = 2 * math.pi / positive("frequency", frequency)
    return HamiltonianSystem.from_sympy(
        "p**2/2 + alpha*q**2/2 + beta*q**4/4 - F*q*cos(w*t)",
        params={
            "alpha": checked_number("alpha", alpha),
            "beta": positive("beta", beta),
            "F": _not_zero("force", force),
            "w": frequency,
        },
        time="t",
        period=period,
        damping=checked_number("damping", damping, NOT_NEGATIVE, not_negative),
        name="duffing",
        domain=Box([-1.8, -1.3], [1.8, 1.3]),
        y0=[1.0, 0.0],
        dt=_dividing(period, 0.05),
        energy_scale=1.0,
    )


def fodo_cell(strength: float = 0.8, quadrupole: float = 0.5, drift: float = 2.0) -> HamiltonianSystem:
    """H = (p₁² + p₂²)/2 + K(t)(q₁² − q₂²)/2, a periodic lattice of quadrupoles; the time is the path length.

    A cell is half a focusing quadrupole, a drift, a defocusing quadrupole, a drift, and half a focusing one:
    K = k, 0, −k, 0, k. `system.params` has the strength k, and the signs of K as a spline of SciPy, `lattice`.

    Parameters
    ----------
    strength : float
        k > 0, in 1/m².
    quadrupole, drift : float
        Lengths in m. The step has to divide half a quadrupole and a drift, so that their ratio must be that of whole
        numbers, not too large ones.

    Notes
    -----
    Known truth: `fodo_matrices`, the transfer matrices M of a cell. Its phase advance in a plane is μ, cos μ = ½ tr M:
    the Floquet multipliers are e^{±iμ}, and the lattice is stable where |½ tr M| < 1. For thin quadrupoles it is
    sin(μ/2) = (quadrupole + drift)·k·quadrupole/2.

    K jumps at the ends of quadrupoles. A method keeps its order there if its steps end there, as those of the default
    do, at most a 40th of the cell, and if it takes no force at the ends of a step: `leapfrog`, `kahan_li8`, `chin4c`,
    `gauss_legendre6`, but neither `verlet` nor `rk4`, which are of first order here.

    References
    ----------
    .. [1] E. D. Courant, H. S. Snyder, "Theory of the alternating-gradient synchrotron", Ann. Phys. 3 (1958) 1–48.
    """
    from scipy.interpolate import PPoly

    half, between = _exact("quadrupole", quadrupole) / 2, _exact("drift", drift)
    cell = 4 * half + 2 * between
    step = Fraction(
        math.gcd(half.numerator * between.denominator, between.numerator * half.denominator),
        half.denominator * between.denominator,
    )
    if cell / step > MOST_PIECES:
        raise ValueError(
            f"`drift` {drift!r} and half the `quadrupole` {quadrupole!r} have no step in common of {MOST_PIECES} to a "
            "cell: make one a multiple of the other."
        )
    step /= math.ceil(step / (cell / 40))
    ends = np.cumsum([0, half, between, 2 * half, between, half]).astype(float)
    lattice = PPoly(np.array([[1.0, 0.0, -1.0, 0.0, 1.0]]), ends, extrapolate="periodic")
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + k*lattice*(q1**2 - q2**2)/2",
        params={"k": positive("strength", strength), "lattice": lattice},
        time="t",
        period=float(cell),
        name="fodo_cell",
        domain=Box([-2.0] * 4, [2.0] * 4),
        y0=[1.0, 1.0, 0.0, 0.0],
        t_span=(0.0, 20 * float(cell)),
        dt=float(step),
        energy_scale=1.0,
    )


MOST_PIECES = 1000
"""Steps of a cell beyond which the lengths in it have no step in common."""


def fodo_matrices(strength: float = 0.8, quadrupole: float = 0.5, drift: float = 2.0) -> np.ndarray:
    """The transfer matrices of `fodo_cell`, from its beginning to its end: (2, 2, 2), of [q₁, p₁] and of [q₂, p₂].

    Parameters
    ----------
    strength, quadrupole, drift : float
        As of `fodo_cell`.

    References
    ----------
    .. [1] E. D. Courant, H. S. Snyder, "Theory of the alternating-gradient synchrotron", Ann. Phys. 3 (1958) 1–48.
    """
    wave = math.sqrt(positive("strength", strength))
    half, between = float(_exact("quadrupole", quadrupole)) / 2, float(_exact("drift", drift))

    def lens(sign: int, length: float) -> np.ndarray:
        angle = wave * length
        if sign > 0:
            c, s = math.cos(angle), math.sin(angle)
            return np.array([[c, s / wave], [-wave * s, c]])
        c, s = math.cosh(angle), math.sinh(angle)
        return np.array([[c, s / wave], [wave * s, c]])

    free = np.array([[1.0, between], [0.0, 1.0]])
    return np.stack([lens(x, half) @ free @ lens(-x, 2 * half) @ free @ lens(x, half) for x in (1, -1)])


def kicked(K: float = 0.97, modes: int = 3) -> HamiltonianSystem:
    """H = p²/2 + K cos q·(1 + 2 Σ cos 2πnt), n = 1 … modes: a particle in waves of the same size.

    With more and more modes the force becomes a kick at every whole t, and the map of a period the standard map.

    Parameters
    ----------
    K : float
        Strength of a kick, not 0. Beyond K = 0.971635 no invariant curve of the standard map separates its orbits in p.
    modes : int
        M from 1 to 100, waves of each direction.

    Notes
    -----
    Known truth: the steps of `verlet` with dt = 1/(2M + 1), the default, are the standard map

        p ← p + K sin q,    q ← q + p,

    where half of a kick is made before and half after: all other kicks vanish, as the sum over the waves does at
    t = k/(2M + 1). Symmetries: q and q + 2π are the same state, and so are, in the standard map, p and p + 2π.

    The domain is a box of one period in q. The default interval is (0, 100).

    References
    ----------
    .. [1] B. V. Chirikov, "A universal instability of many-dimensional oscillator systems", Phys. Rep. 52 (1979)
       263–379.
    .. [2] J. M. Greene, "A method for determining a stochastic transition", J. Math. Phys. 20 (1979) 1183–1201.
    """
    modes = checked_count("modes", modes, 1, 100, "a whole number from 1 to 100")
    waves = " + ".join(f"cos({2 * n}*pi*t)" for n in range(1, modes + 1))
    return HamiltonianSystem.from_sympy(
        f"p**2/2 + K*cos(q)*(1 + 2*({waves}))",
        params={"K": _not_zero("K", K)},
        time="t",
        period=1.0,
        name="kicked",
        domain=Box([0.0, -math.pi], [2 * math.pi, math.pi]),
        y0=[2.0, 0.0],
        dt=1 / (2 * modes + 1),
    )


def _dividing(period: float, longest: float) -> float:
    """The longest step up to `longest` that divides the period."""
    return period / math.ceil(period / longest)


def _not_zero(name: str, value: float) -> float:
    if checked_number(name, value) == 0:
        raise ValueError(
            f"`{name}` must not be 0, for H would not depend on t: define it with from_sympy, without time."
        )
    return value


def positive(name: str, value: float) -> float:
    """The value, if it is a positive number whose square is one too."""
    return float(check_positive(name, value, most=1e100))


def _exact(name: str, length: float) -> Fraction:
    """A length as the fraction that was written, such as 1/10 for 0.1."""
    return Fraction(repr(float(positive(name, length))))
