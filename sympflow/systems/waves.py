"""Waves on lattices of any size: field equations on a grid, the Toda and the Fermi–Pasta–Ulam–Tsingou chain.

Each has a solution in closed form, `system.exact`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from sympflow.arguments import check_one_of, checked_count, checked_number
from sympflow.hamiltonian.domain import Box
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.systems.driven import positive

STENCILS: dict[int, dict[int, str]] = {
    2: {1: "r**2/(2*h**2)"},
    4: {1: "2*r**2/(3*h**2)", 2: "-r**2/(24*h**2)"},
    6: {1: "3*r**2/(4*h**2)", 2: "-3*r**2/(40*h**2)", 3: "r**2/(180*h**2)"},
}
"""½ u_x² at a site of a grid of spacing h, by bonds of several lengths, by its order of accuracy in h."""


def grid(system: HamiltonianSystem) -> np.ndarray:
    """The places x of the sites of a chain, from the middle of it on: (n,), in units of the spacing `params["h"]`.

    Raises
    ------
    ValueError
        If the system is not a lattice of one axis and one field.
    """
    from sympflow.hamiltonian.lattice import LatticeHamiltonian
    from sympflow.hamiltonian.wave_functions import WaveFunctionHamiltonian

    local, n = system.local, system.ndof
    if isinstance(local, WaveFunctionHamiltonian) and local.grid == (n,):
        return _grid(n, local.length[0] / n)
    if isinstance(local, LatticeHamiltonian) and local.shape == (n,):
        return _grid(n, float(system.params.get("h", 1.0)))
    raise ValueError(f"`system` must be a lattice of one axis and one field; got {system.name!r}.")


def _grid(n: int, h: float) -> np.ndarray:
    return h * (np.arange(n) - (n - 1) / 2)


def wave_equation(n: int = 256, speed: float = 1.0, width: float = 0.5, accuracy: int = 4) -> HamiltonianSystem:
    """u_tt = c² u_xx on a ring of length 2π: H = Σ [p²/2 + c² u_x²/2] over the sites of a grid.

    Parameters
    ----------
    n : int
        Sites; the spacing is h = 2π/n.
    speed : float
        c > 0.
    width : float
        w > 0 of the pulse exp((cos x − 1)/w²), which runs to the right.
    accuracy : {2, 4, 6}
        Order in h of the stencil for u_x².

    Notes
    -----
    Known truth: `system.exact(t)`, u = f(x − ct), of the equation; on the grid short waves fall behind by O(h²), O(h⁴)
    or O(h⁶). H of a grid is that of the equation divided by h. The domain is a box about the pulse. The default
    interval is one turn around the ring, the default step h/(2c).
    """
    n, h = _sites(n, accuracy), 2 * math.pi / _sites(n, accuracy)
    c, w = positive("speed", speed), positive("width", width)
    high = np.repeat([1.2, 1.2 * c / w], n)
    return _system(
        "wave_equation",
        partial(_pulse, speed=c, width=w),
        _grid(n, h),
        bond={k: f"c**2*({V})" for k, V in STENCILS[accuracy].items()},
        params={"c": c, "h": h},
        domain=Box(-high, high),
        t_span=(0.0, 2 * math.pi / c),
        dt=h / (2 * c),
    )


def _pulse(x: np.ndarray, t: np.ndarray, speed: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    X = x - speed * t
    u = np.exp((np.cos(X) - 1) / width**2)
    return u, u * speed * np.sin(X) / width**2


def sine_gordon(
    wave: str = "breather",
    frequency: float = 0.6,
    velocity: float = 0.0,
    n: int = 512,
    length: float = 80.0,
    accuracy: int = 4,
) -> HamiltonianSystem:
    """u_tt = u_xx − sin u: H = Σ [p²/2 + u_x²/2 + 1 − cos u] over the sites of a grid.

    Parameters
    ----------
    wave : {"breather", "kink"}
        What runs: a pulse that oscillates, on a ring; or a step from 0 to 2π, between free ends.
    frequency : float
        ω of the breather at rest, 0 < ω < 1.
    velocity : float
        v, −1 < v < 1.
    n : int
        Sites.
    length : float
        L; the spacing is h = L/n. The tails of a wave, e^{−√(1 − ω²)|x|} and e^{−|x|}, must end within it.
    accuracy : {2, 4, 6}
        Order in h of the stencil for u_x².

    Notes
    -----
    Known truth: `system.exact(t)`, of the equation on the line, with γ = 1/√(1 − v²) and η = √(1 − ω²):

        breather  u = 4 arctan[(η/ω) sin(ωγ(t − vx)) / cosh(ηγ(x − vt))],  of energy 16ηγ = hH,
        kink      u = 4 arctan exp(γ(x − x₀ − vt)),                        of energy 8γ = hH.

    A kink that moves starts a quarter of the length before the middle, and has passed as much behind it at the end of
    the default interval. The domain is a box about the wave.

    References
    ----------
    .. [1] P. G. Drazin, R. S. Johnson, "Solitons: an Introduction", Cambridge 1989, 3.3 and 4.5.
    """
    n = _sites(n, accuracy)
    h, v = positive("length", length) / n, _velocity(velocity)
    check_one_of("wave", wave, ("breather", "kink"))
    if wave == "breather":
        checked_number("frequency", frequency, "between 0 and 1, of a breather", lambda w: 0 < w < 1)
        shape = partial(_breather, frequency=frequency, velocity=v, length=length)
        boundary, t_end = "periodic", 20 * math.pi / frequency
        top = 4 * math.atan(math.sqrt(1 - frequency**2) / frequency)
        low, high = [-1.1 * top, -4.5], [1.1 * top, 4.5]
    else:
        shape = partial(_kink, velocity=v, start=_start(v, length))
        boundary, t_end = "free", _crossing(v, length)
        low, high = [-1.0, -3.0], [2 * math.pi + 1.0, 3.0]
    scale = np.array([1.0, _gamma(v)])
    return _system(
        "sine_gordon",
        shape,
        _grid(n, h),
        onsite="1 - cos(q)",
        bond=STENCILS[accuracy],
        boundary=boundary,
        params={"h": h},
        domain=Box(np.repeat(low * scale, n), np.repeat(high * scale, n)),
        t_span=(0.0, t_end),
        dt=h / 3,
    )


def _breather(
    x: np.ndarray, t: np.ndarray, frequency: float, velocity: float, length: float
) -> tuple[np.ndarray, np.ndarray]:
    w, v, g, eta = frequency, velocity, _gamma(velocity), math.sqrt(1 - frequency**2)
    X = (x - v * t + length / 2) % length - length / 2
    angle, xi = w * (t / g - g * v * X), eta * g * X
    with np.errstate(over="ignore"):
        envelope = 1 / np.cosh(xi)
    a = eta / w * np.sin(angle) * envelope
    a_t = eta * g * envelope * (np.cos(angle) + eta * v / w * np.sin(angle) * np.tanh(xi))
    return 4 * np.arctan(a), 4 * a_t / (1 + a * a)


def _kink(x: np.ndarray, t: np.ndarray, velocity: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    g = _gamma(velocity)
    X = g * (x - start - velocity * t)
    with np.errstate(over="ignore"):
        return 4 * np.arctan(np.exp(X)), -2 * g * velocity / np.cosh(X)


def phi4(velocity: float = 0.3, n: int = 512, length: float = 80.0, accuracy: int = 4) -> HamiltonianSystem:
    """u_tt = u_xx + u − u³, the Klein–Gordon equation of two wells: H = Σ [p²/2 + u_x²/2 + (u² − 1)²/4] over a grid.

    Parameters
    ----------
    velocity : float
        v of the kink, −1 < v < 1.
    n : int
        Sites, between free ends.
    length : float
        L; the spacing is h = L/n.
    accuracy : {2, 4, 6}
        Order in h of the stencil for u_x².

    Notes
    -----
    Known truth: `system.exact(t)`, the kink u = tanh(γ(x − x₀ − vt)/√2) of the equation on the line, γ = 1/√(1 − v²),
    of energy (2√2/3)γ = hH. Other than those of the sine-Gordon equation two such waves do not pass each other
    unchanged. A kink that moves starts a quarter of the length before the middle, and has passed as much behind it at
    the end of the default interval. The domain is a box about the wave.

    References
    ----------
    .. [1] R. Rajaraman, "Solitons and Instantons", North-Holland 1982, 2.3.
    """
    n = _sites(n, accuracy)
    h, v = positive("length", length) / n, _velocity(velocity)
    high = np.repeat([1.5, 1.5 * _gamma(v)], n)
    return _system(
        "phi4",
        partial(_well_kink, velocity=v, start=_start(v, length)),
        _grid(n, h),
        onsite="(q**2 - 1)**2/4",
        bond=STENCILS[accuracy],
        boundary="free",
        params={"h": h},
        domain=Box(-high, high),
        t_span=(0.0, _crossing(v, length)),
        dt=h / 3,
    )


def _well_kink(x: np.ndarray, t: np.ndarray, velocity: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    g = _gamma(velocity)
    u = np.tanh(g * (x - start - velocity * t) / math.sqrt(2))
    return u, -g * velocity / math.sqrt(2) * (1 - u * u)


def nonlinear_schroedinger(
    amplitude: float = 1.0, velocity: float = 0.5, n: int = 512, length: float = 80.0
) -> HamiltonianSystem:
    """i ψ_t = −½ψ_xx − |ψ|²ψ, the focusing Schrödinger equation, ψ = (q + ip)/√2, on a ring, spectral in x.

    Parameters
    ----------
    amplitude : float
        η > 0 of the soliton.
    velocity : float
        v.
    n : int
        Sites; the spacing is h = L/n.
    length : float
        L; the tails of the soliton, e^{−η|x|}, must end within it.

    Notes
    -----
    Known truth: `system.exact(t)`, the soliton

        ψ = η sech(η(x − x₀ − vt)) exp(i v(x − x₀) + i(η² − v²)t/2),

    with the norm h Σ|ψ|² = 2η and the energy hH = ηv² − η³/3, to rounding where tails and waves fit the grid; around
    the ring it is the image nearest to a site. It starts
    an eighth of the length before the middle, and has passed as much behind it at the end of the default interval. The
    domain is a box about it.

    References
    ----------
    .. [1] V. E. Zakharov, A. B. Shabat, "Exact theory of two-dimensional self-focusing and one-dimensional
       self-modulation of waves in nonlinear media", Sov. Phys. JETP 34 (1972) 62–69.
    """
    n, L = _sites(n, 2), positive("length", length)
    eta, v = positive("amplitude", amplitude), float(checked_number("velocity", velocity))
    x, high = _grid(n, L / n), np.full(2 * n, 1.6 * eta)
    exact = partial(_states, partial(_soliton, amplitude=eta, velocity=v, start=_start(v, L / 2), length=L), x)
    return HamiltonianSystem.schroedinger(
        "-rho**2/2",
        shape=n,
        length=L,
        name="nonlinear_schroedinger",
        domain=Box(-high, high),
        y0=exact(0.0),
        t_span=(0.0, _crossing(v, L / 2)),
        dt=0.02 / eta**2,
        exact=exact,
    )


def _soliton(
    x: np.ndarray, t: np.ndarray, amplitude: float, velocity: float, start: float, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Around the ring: at a site that image of the soliton which is nearest."""
    eta, v = amplitude, velocity
    X = (x - start - v * t + length / 2) % length - length / 2
    with np.errstate(over="ignore"):
        size = math.sqrt(2) * eta / np.cosh(eta * X)
    phase = v * X + (eta**2 + v**2) * t / 2
    return size * np.cos(phase), size * np.sin(phase)


def toda_chain(n: int = 128, kappa: float = 0.5) -> HamiltonianSystem:
    """H = Σ p²/2 + Σ [e^{−r} + r − 1], r = q_{i+1} − q_i, a chain with free ends on which a soliton runs.

    Parameters
    ----------
    n : int
        Sites.
    kappa : float
        κ > 0 of the soliton: its width is 1/κ, its speed sinh κ/κ > 1.

    Notes
    -----
    Known truth: `system.exact(t)`, of the infinite chain, to rounding while the soliton is far from the ends:

        e^{−r} − 1 = sinh² κ / cosh²(κ(i − i₀) − t sinh κ).

    For small κ this is the soliton of the Korteweg–de Vries equation, r = −κ² sech²(κ(i − i₀ − (1 + κ²/6)t)), the limit
    of every chain of such bonds [1]_. The soliton starts a quarter of the chain before its middle and has passed as
    much behind it at the end of the default interval. The domain is a box about it. `toda_lattice` is the ring of few
    particles.

    References
    ----------
    .. [1] M. Toda, "Theory of Nonlinear Lattices", 2nd ed., Springer 1989, 2.2 and 3.4.
    """
    n, k = _sites(n, 2), positive("kappa", kappa)
    checked_number("kappa", k, "at most 20, because otherwise the soliton is narrower than a site", lambda x: x <= 20)
    speed = math.sinh(k) / k
    high = np.repeat([1.5 * k, 3 * k * speed * math.sinh(k) + 1e-3], n)
    return _system(
        "toda_chain",
        partial(_toda_soliton, kappa=k, start=-n / 4),
        _grid(n, 1.0),
        bond="exp(-r) + r - 1",
        boundary="free",
        domain=Box(-high, high),
        t_span=(0.0, n / 2 / speed),
        dt=0.2 / max(1.0, speed),
    )


def _toda_soliton(x: np.ndarray, t: np.ndarray, kappa: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    """By Hirota's τ = cosh θ: q_i = log(τ_{i−1}/τ_i)."""
    theta, rate = kappa * (x - start) - math.sinh(kappa) * t, math.sinh(kappa)
    before = theta - kappa
    size, other = abs(theta), abs(before)
    q = other - size + np.log1p(np.exp(-2 * other)) - np.log1p(np.exp(-2 * size))
    return q, rate * (np.tanh(theta) - np.tanh(before))


def fput_beta(n: int = 64, beta: float = 1.0, amplitude: float = 0.1) -> HamiltonianSystem:
    """H = Σ p²/2 + Σ [r²/2 + βr⁴/4], r = q_{i+1} − q_i, on a ring of any size, in its mode of shortest wavelength.

    Parameters
    ----------
    n : int
        Sites, an even number.
    beta : float
        β > 0.
    amplitude : float
        A > 0: q_i = (−1)^i A at first, with p = 0.

    Notes
    -----
    Known truth: `system.exact(t)`. Neighbours move against each other, q_i = (−1)^i A cn(wt, m) with w² = 4 + 16βA² and
    m = 8βA²/w², an exact solution of the chain for every β. It is unstable where the energy of a site exceeds about
    π²/(3βn²) [1]_: rounding then grows until the energy goes to other modes. The domain is a box about the orbit. The
    default interval is 20 periods.

    References
    ----------
    .. [1] N. Budinsky, T. Bountis, "Stability of nonlinear modes and chaotic properties of 1D Fermi–Pasta–Ulam
       lattices", Physica D 8 (1983) 445–452.
    """
    from scipy.special import ellipk

    n = _sites(n, 2)
    if n % 2:
        raise ValueError(f"`n` must be even, for neighbours on the ring move against each other; got {n}.")
    b, A = positive("beta", beta), positive("amplitude", amplitude)
    w = math.sqrt(4 + 16 * b * A * A)
    period = 4 * float(ellipk(8 * b * A * A / w**2)) / w
    high = np.repeat([2 * A, 2 * A * w], n)
    return _system(
        "fput_beta",
        partial(_shortest, amplitude=A, frequency=w, modulus=8 * b * A * A / w**2, n=n),
        _grid(n, 1.0),
        bond="r**2/2 + beta*r**4/4",
        params={"beta": b},
        domain=Box(-high, high),
        t_span=(0.0, 20 * period),
        dt=period / 40,
    )


def _shortest(
    x: np.ndarray, t: np.ndarray, amplitude: float, frequency: float, modulus: float, n: int
) -> tuple[np.ndarray, np.ndarray]:
    from scipy.special import ellipj

    sn, cn, dn, _ = ellipj(frequency * t, modulus)
    sign = (-1.0) ** np.arange(n)
    return sign * amplitude * cn, -sign * amplitude * frequency * sn * dn


# the parts of a scene ----------------------------------------------------------------------------------------------


def _system(
    name: str, wave: Callable[..., tuple[np.ndarray, np.ndarray]], x: np.ndarray, **definition: Any
) -> HamiltonianSystem:
    """The lattice on which a wave u, u_t = wave(x, t) runs."""
    exact = partial(_states, wave, x)
    return HamiltonianSystem.lattice(shape=len(x), name=name, exact=exact, y0=exact(0.0), **definition)


def _states(wave: Callable[..., tuple[np.ndarray, np.ndarray]], x: np.ndarray, t: Any) -> np.ndarray:
    """The states [u, u_t] at times t: (...) to (..., 2n)."""
    times = np.asarray(t, dtype=float)[..., None]
    u, u_t = np.broadcast_arrays(*wave(x, times))
    return np.concatenate([u, u_t], axis=-1)


def _gamma(velocity: float) -> float:
    return 1 / math.sqrt(1 - velocity**2)


def _start(velocity: float, length: float) -> float:
    return -math.copysign(length / 4, velocity) if velocity else 0.0


def _crossing(velocity: float, length: float) -> float:
    """The time in which a wave crosses half the length, at most 200."""
    return min(200.0, length / 2 / abs(velocity)) if velocity else 50.0


def _velocity(value: float) -> float:
    return checked_number("velocity", value, "a number between −1 and 1, the speed of light", lambda v: -1 < v < 1)


def _sites(n: Any, accuracy: Any) -> int:
    checked_number("accuracy", accuracy, "2, 4 or 6, the order of the stencil", STENCILS.__contains__)
    return checked_count("n", n, 8, sys.maxsize, "a whole number of sites, at least 8")
