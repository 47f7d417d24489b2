"""Linear stability: the steps at which a method keeps small oscillations bounded.

A step h of a splitting of H = (p² + ω²q²)/2 is a linear map of determinant 1 that depends on z = hω alone. Its orbits
are bounded where |½ tr| < 1, and grow by a factor a step where |½ tr| > 1 [1]_, [2]_. With kicks and drifts ½ tr is a
polynomial in z², the *stability polynomial*, with rational coefficients: those of the table. It finds windows of
instability that are too narrow for any list of steps.

Of any other method the step is differentiated at an equilibrium: there the spectral radius is tested at closely spaced
steps.

References
----------
.. [1] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006), I.5 and VIII.
.. [2] S. Blanes, F. Casas, A. Murua, "On the linear stability of splitting methods", Found. Comput. Math. 8 (2008)
   357–393.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sympflow.hamiltonian.scales import weights
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator
from sympflow.integrators.registry import build
from sympflow.metrics.crossings import bisected
from sympflow.schemes import POLYNOMIAL, Scheme

DIGITS = 100  # of the arithmetic in which roots are found
ROUNDING = 2.0**-52  # of a coefficient of a table
STEPS_TRIED = 2048  # at which a method without a table is differentiated
WIDEST = 20.0  # z up to which it is
GROWS = 1e-5  # beyond 1, of a spectral radius that is not rounding: that of a double eigenvalue is √ε
TURNS = 1e-5  # imaginary part of an eigenvalue that is simple, whose rounding is ε
NEWTON_STEPS = 50
SCALES = (0.1, 1.0, 10.0, 100.0)  # of the states at which Hessians are compared, in units of y0

series: Any = np.polynomial.polynomial  # of fractions and decimals, which its stubs do not know
Polynomial = Any  # a sequence or an array of coefficients, the constant one first


class Window(NamedTuple):
    """Steps between which orbits grow, and the largest factor by which they do so in a step."""

    start: float
    stop: float
    growth: float


@dataclass(frozen=True)
class LinearStability:
    """The steps, or the z = hω, for which a method keeps small oscillations bounded.

    Attributes
    ----------
    windows : tuple of Window
        Where it does not: (start, stop, growth), in order and disjoint; the stop and the growth of the last are inf if
        it has no end.
    resonances : tuple of float
        Stable steps at which ½ tr touches ±1 without an exit: a perturbation, such as the nonlinear part of the force,
        may open a window there.
    """

    windows: tuple[Window, ...]
    resonances: tuple[float, ...] = ()

    @property
    def limit(self) -> float:
        """The first exit: all shorter steps are stable, though for the resonances. inf if there is none."""
        return self.windows[0].start if self.windows else math.inf

    @property
    def intervals(self) -> tuple[tuple[float, float], ...]:
        """The intervals (from, to) of stability, in order."""
        starts, stops = [0.0, *(w.stop for w in self.windows)], [*(w.start for w in self.windows), math.inf]
        return tuple((a, b) for a, b in zip(starts, stops, strict=True) if a < b)

    def window_of(self, step: float) -> Window | None:
        """Return the window that holds a step, its ends included; None for a stable one."""
        return next((w for w in self.windows if w.start <= step <= w.stop), None)

    def in_steps(self, frequencies: Sequence[float] | np.ndarray) -> LinearStability:
        """Return the steps h for oscillations of several frequencies ω, from those in z = hω."""
        rates = sorted({float(w) for w in frequencies if w > 0})
        windows = sorted(Window(w.start / rate, w.stop / rate, w.growth) for rate in rates for w in self.windows)
        joint: list[Window] = []
        for w in windows:
            if joint and w.start <= joint[-1].stop:
                last = joint.pop()
                w = Window(last.start, max(last.stop, w.stop), max(last.growth, w.growth))  # noqa: PLW2901
            joint.append(w)
        apart = LinearStability(tuple(joint))
        touching = sorted(z / rate for rate in rates for z in self.resonances)
        return LinearStability(apart.windows, tuple(h for h in touching if apart.window_of(h) is None))


def linear_stability(method: Any) -> LinearStability:
    """Return the intervals of z = dt·ω in which a splitting method is stable on the oscillator H = (p² + ω²q²)/2.

    Parameters
    ----------
    method : str, Integrator or Scheme
        A method whose steps are kicks by −∇V and drifts by ∇T, with or without force gradients and curvature terms.

    Raises
    ------
    ValueError
        For a method of another kind, and for a table with polynomial kicks.

    Notes
    -----
    The trace is computed in rational numbers from the coefficients of the table, its extrema in 100 digits. An extremum
    that exceeds ±1 by no more than the rounding of the coefficients counts as touching: a resonance. The instability of
    a scheme of high order near z = π is narrow, because ½ tr = cos z + O(z^(order + 2)), but it exists.

    Examples
    --------
    >>> linear_stability("verlet").limit
    2.0
    >>> [round(z, 4) for interval in linear_stability("mclachlan4").intervals for z in interval]
    [0.0, 3.0355, 3.2973, 6.819]
    """
    scheme = method if isinstance(method, Scheme) else build(method, {}).kicks_and_drifts
    if scheme is None or scheme.level == POLYNOMIAL:
        raise ValueError(
            f"`method` {getattr(method, 'name', method)!r} has no table of kicks and drifts by T and V: its stability "
            "on an oscillator is not a polynomial. Use stability() on a system."
        )
    return _of_table(scheme)


@lru_cache(maxsize=64)
def _of_table(scheme: Scheme) -> LinearStability:
    exact = half_trace(scheme)
    with localcontext() as context:
        context.prec = DIGITS
        p = [Decimal(c.numerator) / Decimal(c.denominator) for c in exact]
        turns = _positive_roots(series.polyder(p))
        points, values = [Decimal(0)], [Decimal(1)]
        resonances: list[Decimal] = []
        for x in turns:
            value = series.polyval(x, p)
            if abs(abs(value) - 1) <= Decimal(ROUNDING * _sensitivity(scheme, float(x))):
                value = Decimal(1).copy_sign(value)
                resonances.append(x)
            points.append(x)
            values.append(value)
        last = points[-1] + 1
        while len(p) > 1 and series.polyval(last, p) * Decimal(1).copy_sign(p[-1]) <= 1:
            last *= 2  # from the last extremum on it is monotone
        points.append(last)
        values.append(series.polyval(last, p))
        windows = _windows(p, points, values)
        inside = LinearStability(windows)
        return LinearStability(windows, tuple(z for x in resonances if not inside.window_of(z := math.sqrt(x))))


def _windows(p: Polynomial, points: list[Decimal], values: list[Decimal]) -> tuple[Window, ...]:
    """The windows of z, from points x = z² between which p is monotone, and its values there."""
    windows: list[Window] = []
    start, peak = None, Decimal(0)
    if len(p) < 2 or p[1] >= 0:  # unstable from the beginning
        start, peak = Decimal(0), abs(values[1])
    for (a, b), (u, v) in zip(pairwise(points), pairwise(values), strict=True):
        for level in sorted((Decimal(1), Decimal(-1)), reverse=u > v):
            if start is None and (u - level) * level <= 0 < (v - level) * level:  # leaves through this level
                start, peak = _crossing(p, level, a, b), abs(v)
            elif start is not None and (v - level) * level <= 0 < (u - level) * level:  # comes back
                stop = _crossing(p, level, a, b) if v != level else b
                growth = peak + (peak * peak - 1).sqrt()
                windows.append(Window(math.sqrt(start), math.sqrt(stop), float(growth)))
                start = None
        if start is not None:
            peak = max(peak, abs(v))
    if start is not None:
        windows.append(Window(math.sqrt(start), math.inf, math.inf))
    return tuple(windows)


def half_trace(scheme: Scheme) -> tuple[Fraction, ...]:
    """Return the coefficients of the stability polynomial ½ tr in x = z², exactly as the table has them.

    The rows of the matrix are those of q and hp, in which its entries are polynomials in x.
    """
    q: list[Polynomial] = [[Fraction(1)], [Fraction(0)]]
    p: list[Polynomial] = [[Fraction(0)], [Fraction(1)]]
    for kind, b, g, c, *_ in scheme.substeps:
        if kind == "drift":
            q = [series.polyadd(mine, series.polymul([Fraction(b)], other)) for mine, other in zip(q, p, strict=True)]
        else:  # a kick by −(b x − g x² + c x³) q
            kick = [Fraction(0), Fraction(-b), Fraction(g), Fraction(-c)]
            p = [series.polyadd(mine, series.polymul(kick, other)) for mine, other in zip(p, q, strict=True)]
    trace = [x / 2 for x in series.polyadd(q[0], p[1])]
    while len(trace) > 1 and trace[-1] == 0:
        trace.pop()
    return tuple(trace)


def _sensitivity(scheme: Scheme, x: float) -> float:
    """The sum over the coefficients of |change of ½ tr| at x for a relative change of each by 1, and 1 for the sums."""
    maps, changes = [], []
    for kind, b, g, c, *_ in scheme.substeps:
        terms = np.array([b]) if kind == "drift" else np.array([-b * x, g * x**2, -c * x**3])
        entry = (0, 1) if kind == "drift" else (1, 0)
        one, change = np.eye(2), np.zeros((2, 2))
        one[entry], change[entry] = terms.sum(), np.abs(terms).sum()
        maps.append(one)
        changes.append(change)
    before, after = [np.eye(2)], [np.eye(2)]
    for one, other in zip(maps, reversed(maps), strict=True):
        before.append(one @ before[-1])
        after.append(after[-1] @ other)
    after.reverse()
    parts = zip(after[1:], changes, before, strict=False)
    return 1.0 + sum(abs(float(np.trace(left @ change @ right))) / 2 for left, change, right in parts)


def _positive_roots(p: Polynomial) -> list[Decimal]:
    """The positive roots at which a polynomial changes its sign, in order: between those of its derivative."""
    p = list(p)
    while p and p[-1] == 0:
        p.pop()
    if len(p) < 2:
        return []
    bound = 1 + max(abs(c / p[-1]) for c in p[:-1])  # Cauchy's
    points = [Decimal(0), *_positive_roots(series.polyder(p)), bound]
    values = [series.polyval(x, p) for x in points]
    found = []
    for (a, b), (u, v) in zip(pairwise(points), pairwise(values), strict=True):
        if u * v < 0:
            found.append(_crossing(p, Decimal(0), a, b))
        elif v == 0 and b != bound:
            found.append(b)
    return found


def _crossing(p: Polynomial, level: Decimal, a: Decimal, b: Decimal) -> Decimal:
    """The x between a and b where p, monotone there, passes a level, to half of the digits."""
    rising = series.polyval(b, p) > series.polyval(a, p)
    slope = series.polyder(p)
    x = (a + b) / 2
    while b - a > b * Decimal(10) ** (-DIGITS // 2):
        off, steep = series.polyval(x, p) - level, series.polyval(x, slope)
        a, b = (a, x) if (off > 0) == rising else (x, b)
        newton = x - off / steep if steep else a
        if a < newton < b and abs(newton - x) <= b * Decimal(10) ** (-DIGITS // 2):
            return newton
        x = newton if a < newton < b and abs(newton - x) < (b - a) / 4 else (a + b) / 2
    return (a + b) / 2


@dataclass(frozen=True)
class SmallOscillations:
    """The frequencies of the linear part of a system.

    Attributes
    ----------
    frequencies : ndarray (d,)
        ω of the normal modes, 0 where nothing oscillates.
    equilibrium : ndarray (2d,) or None
        Where they are those of small oscillations; None if they are the largest found along an orbit.
    everywhere : bool
        True if H is quadratic, so that they are those of every orbit.
    """

    frequencies: np.ndarray
    equilibrium: np.ndarray | None
    everywhere: bool = False

    @property
    def fastest(self) -> float:
        return float(self.frequencies.max(initial=0.0))


def small_oscillations(
    system: HamiltonianSystem, y0: np.ndarray, orbit: Callable[[], np.ndarray]
) -> SmallOscillations | None:
    """Return the frequencies about a stable equilibrium, else the largest along an orbit; None if there are none.

    Parameters
    ----------
    system : HamiltonianSystem
    y0 : ndarray (2d,)
        The equilibrium, of no higher energy, is sought from the origin and from there.
    orbit : callable
        Gives states (n, 2d) along the orbit, which are looked at where there is no equilibrium.
    """
    with np.errstate(all="ignore"):
        try:
            center = _equilibrium(system, y0)
            if center is not None:
                return SmallOscillations(_frequencies(system, center), center, _quadratic(system, y0))
            rates = [_frequencies(system, y) for y in orbit()]
        except Exception:  # the system's functions have no second derivatives there
            return None
    fastest = max(rates, key=lambda w: float(w.max(initial=0.0)))
    return SmallOscillations(fastest, None) if fastest.max(initial=0.0) > 0 else None


def _equilibrium(system: HamiltonianSystem, y0: np.ndarray) -> np.ndarray | None:
    """A minimum of H, of no higher energy than y0, by Newton's method in the variables (s q, p/s)."""
    scale = weights(system)
    of_y0 = float(np.linalg.norm(scale * y0))

    def derivatives(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(system.gradient(y)) / scale, np.asarray(system.hessian(y)) / np.outer(scale, scale)

    def size_of(y: np.ndarray) -> float:
        return of_y0 + float(np.linalg.norm(scale * y))

    for start in (np.zeros_like(y0), y0):
        y, size = start.astype(float), math.inf
        for _ in range(NEWTON_STEPS):
            slope, S = derivatives(y)
            if not (np.isfinite(slope).all() and np.isfinite(S).all()):
                break
            change = np.linalg.lstsq(S, slope, rcond=1e-12)[0]
            y, size = y - change / scale, float(np.linalg.norm(change))
            if size <= 1e-12 * size_of(y):
                break
        if not size <= 1e-9 * size_of(y):
            continue
        slope, S = derivatives(y)
        curvatures = np.linalg.eigvalsh((S + S.T) / 2)
        at_rest = np.linalg.norm(slope) <= 1e-8 * np.abs(S).max() * size_of(y)
        higher = system.hamiltonian(y) - system.hamiltonian(y0)
        rounding = 1e-9 * (np.abs(S).max() * of_y0**2 + abs(higher))
        if at_rest and curvatures[0] >= -1e-9 * curvatures[-1] and not higher > rounding:
            return y
    return None


def _frequencies(system: HamiltonianSystem, y: np.ndarray) -> np.ndarray:
    """ω (d,) of the linear part at a state, 0 for a mode that does not oscillate."""
    S, d = np.asarray(system.hessian(y)), system.ndof
    if system.separable:
        squares = np.linalg.eigvals(S[d:, d:] @ S[:d, :d])
        oscillates = np.abs(squares.imag) <= 1e-9 * np.abs(squares).max(initial=1e-300)
        return np.sort(np.sqrt(np.where(oscillates, np.maximum(squares.real, 0.0), 0.0)))
    rates = np.linalg.eigvals(np.concatenate([S[d:], -S[:d]]))
    return np.sort(np.where(np.abs(rates.real) <= 1e-7 * np.abs(rates), rates.imag, 0.0))[d:]


def _quadratic(system: HamiltonianSystem, y0: np.ndarray) -> bool:
    """True if the Hessian of H is the same at states of all sizes."""
    rng, scale = np.random.default_rng(0), weights(system)
    size = float(np.abs(scale * y0).max()) or 1.0
    states = np.concatenate([size * s * rng.standard_normal((8, y0.size)) / scale for s in SCALES])
    hessians = np.asarray(system.hessian(states)) / np.outer(scale, scale)
    return bool(np.abs(hessians - hessians[0]).max() <= 1e-12 * np.abs(hessians[0]).max())


def of_method(
    integrator: Integrator, system: HamiltonianSystem, small: SmallOscillations, longest: float
) -> LinearStability | None:
    """Return the steps, up to `longest`, that keep small oscillations of a system bounded.

    Exact for kicks and drifts; for another method with steps on a grid its step at the equilibrium is differentiated,
    at 2048 steps, and windows narrower than their distance may be missed. None where neither can be.
    """
    scheme = integrator.kicks_and_drifts
    if scheme is not None and scheme.level != POLYNOMIAL:
        return _of_table(scheme).in_steps(small.frequencies)
    y = small.equilibrium
    if y is None or not integrator.on_grid or integrator.in_another_time or not small.fastest > 0:
        return None
    steps = np.linspace(0.0, min(longest, WIDEST / small.fastest), STEPS_TRIED + 1)[1:]
    try:
        growth = _growth(integrator, system, y, steps)
    except Exception:  # a method that cannot be differentiated there, or a plug-in's step
        return None
    windows = _found(growth, steps, lambda h: _growth(integrator, system, y, h))
    if windows and not integrator.symplectic and _grows_slowly(integrator, system, y, windows[0].start / 2):
        windows[0] = windows[0]._replace(start=0.0)
    return LinearStability(tuple(windows))


def _grows_slowly(integrator: Integrator, system: HamiltonianSystem, y: np.ndarray, h: float) -> bool:
    """True if some oscillation grows at a step h at all, as by explicit Runge–Kutta methods such as Euler's."""
    _, A = integrator.tangent(system, 0.0, y[None], np.array([h]))
    values = np.linalg.eigvals(A[0])
    return bool((np.abs(values[np.abs(values.imag) > TURNS]) > 1 + GROWS**2).any())


def _growth(integrator: Integrator, system: HamiltonianSystem, y: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """The spectral radius of each step's derivative at y, (n,)."""
    with np.errstate(all="ignore"):
        _, A = integrator.tangent(system, 0.0, np.broadcast_to(y, (len(steps), y.size)).copy(), steps)
        finite = np.isfinite(A).all((-1, -2))
        radius = np.abs(np.linalg.eigvals(np.where(finite[:, None, None], A, 0.0))).max(-1)
    return np.where(finite, radius, np.inf)


def _found(growth: np.ndarray, steps: np.ndarray, at: Callable[[np.ndarray], np.ndarray]) -> list[Window]:
    """The windows in a list of steps, their ends by bisection."""
    bad, grid = np.concatenate([[False], growth > 1 + GROWS]), np.concatenate([[0.0], steps])
    edges = np.flatnonzero(bad[1:] != bad[:-1])
    if not len(edges):
        return []
    low, high = bisected(grid[edges], grid[edges + 1], lambda h: (at(h) > 1 + GROWS) == bad[edges], 30)
    ends = [*((low + high) / 2).tolist(), math.inf]
    windows = []
    for i in range(0, len(edges), 2):
        last = edges[i + 1] if i + 1 < len(edges) else len(steps)
        top = float(growth[edges[i] : last].max())
        windows.append(Window(ends[i], ends[i + 1], math.inf if ends[i + 1] == math.inf else top))
    return windows
