"""Kepler's motion about a centre, by universal variables, over numbers: arrays, tensors, traced numbers.

With r = |x|, η = x·v and β = 2μ/r − v², the time is t = rX + ηG₂ + ζG₃, ζ = μ − βr, in the universal variable X, of
which the Stumpff functions are Gₙ = Xⁿ Σₖ (−βX²)ᵏ/(n + 2k)!. Nothing here depends on the sign of the energy −β/2.

References
----------
.. [1] K. Stumpff, "Himmelsmechanik", vol. I, Berlin 1959.
.. [2] B. A. Conway, "An improved algorithm due to Laguerre for the solution of Kepler's equation", Celest. Mech. 39
   (1986) 199–211.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from sympflow.arrays import detached
from sympflow.compiler.control import Value
from sympflow.compiler.functions import apply, fma, where

SHORT = 0.25  # βX² up to which a series of so many terms is exact to rounding
TERMS = 7
CLOSE = 1e-8  # of X: a step of Newton's or Laguerre's method after which the next one is below rounding
MOST = 200  # steps of the solver, of which bisection takes a part where nothing else helps
Numbers = list[Any]


def dot(x: Sequence[Any], y: Sequence[Any]) -> Any:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def tail(z: Any, n: int, terms: int, rough: bool = False) -> Any:
    """Σₖ (−z)ᵏ/(n + 2k)!, of so many terms, by Horner's rule; unless rough, without a bias by its rounded numbers."""
    c: Any = 1.0 / math.factorial(n + 2 * terms - 2)
    for k in range(terms - 2, -1, -1):
        number = 1.0 / math.factorial(n + 2 * k)
        rest = float(Fraction(1, math.factorial(n + 2 * k)) - Fraction(number))
        c = number - (z * c - rest) if k < 2 and rest and not rough else number - z * c
    return c


def series(X: Any, beta: Any, terms: int, rough: bool = False) -> tuple[Any, Any, Any, Any]:
    """G₀ to G₃ of a small βX²."""
    square = X * X
    z = square * beta
    G2, G3 = square * tail(z, 2, terms, rough), X * square * tail(z, 3, terms, rough)
    return 1.0 - beta * G2, X - beta * G3, G2, G3


def stumpff(X: Any, beta: Any) -> tuple[Any, Any, Any, Any]:
    """G₀ to G₃ of any X: the series of X halved so often that it is short, and the theorem of the double argument."""

    def halved(part: Any) -> tuple[Any, Numbers]:
        size = apply("abs", beta * part * part)
        large = (size > SHORT) & (size < math.inf)
        return large, [where(large, 0.5 * part, part)]

    def doubled(part: Any, *G: Any) -> tuple[Any, Numbers]:
        G0, G1, G2, G3 = G
        less = apply("abs", part) < apply("abs", X)
        twice = 2.0 * G1 * G1
        new = 2.0 * part, 1.0 - beta * twice, 2.0 * G0 * G1, twice, 2.0 * (G3 + G1 * G2)
        return less, [where(less, a, b) for a, b in zip(new, (part, *G), strict=True)]

    (part,) = repeated(halved, [X])
    _, *G = repeated(doubled, [part, *series(part, beta, TERMS)])
    return tuple(G)


def repeated(body: Callable[..., tuple[Any, Numbers]], values: Numbers) -> Numbers:
    """Apply `body`, which gives a condition and new values, again while the condition holds anywhere."""
    if isinstance(values[0], Value):
        code = values[0].code

        def turn(given: Numbers) -> tuple[Any, Numbers]:
            condition, new = body(*given)
            return code.any(condition), new

        return code.repeat(values, turn)
    with np.errstate(all="ignore"):  # trials of the solver that overflow are taken back
        for _ in range(4 * MOST):
            condition, values = body(*values)
            if not condition.any():
                break
    return values


def falling(x: Sequence[Any], v: Sequence[Any], eta: Any, zeta: Any, beta: Any, mu: Any) -> Numbers:
    """Where a body falls from far out on a hyperbola; √−β = k, A and B of its distance (Aeᵏˣ + Be⁻ᵏˣ − 2μ)/2k²."""
    k = apply("sqrt", where(beta < 0.0, -beta, 1.0))
    turn = [x[i] * v[j] - x[j] * v[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    falls = (beta < 0.0) & (2.0 * k * eta < -zeta)
    B = where(falls, zeta - eta * k, 1.0)
    return [falls, k, (mu * mu + k * k * dot(turn, turn)) / B, B]


def reached(
    X: Any, G: Sequence[Any], r: Any, eta: Any, zeta: Any, mu: Any, t: Any, fall: Sequence[Any] = ()
) -> tuple[Any, Any]:
    """The time of X less t, and the distance there; with those of `falling` without sums that cancel."""
    _, G1, G2, G3 = G
    late, distance = fma(r, X, -t) + (eta * G2 + zeta * G3), r + (eta * G1 + zeta * G2)
    if not fall:
        return late, distance
    falls, k, A, B = fall
    p = apply("exp", where(falls, k * X, 0.0))
    up, down = 0.5 * A * p, 0.5 * B / p
    square = k * k
    return (
        where(falls, ((up - down) / k - (mu * X + eta)) / square - t, late),
        where(falls, (up + down - mu) / square, distance),
    )


def solved(r: Any, eta: Any, zeta: Any, beta: Any, mu: Any, t: Any, *fall: Any) -> Any:
    """The X of a time t ≥ 0 by Laguerre's method, kept between the ends that are known; nearly to rounding."""
    k = apply("sqrt", where(apply("abs", beta) > 0.0, apply("abs", beta), 1.0))
    n = k * k * k / mu
    free = 3.0 + apply("log", (1.0 + 8.0 * n * t) * where(beta < 0.0, zeta / mu, 1.0))  # H is less, as sinh H − H ≤ nt
    most = where(beta > 0.0, n * t + 2.0, where(beta < 0.0, free, math.inf)) / k  # E grows by nt + 2 at most

    def turn(X: Any, low: Any, high: Any, going: Any) -> tuple[Any, Numbers]:
        G = stumpff(X, beta)
        f, slope = reached(X, G, r, eta, zeta, mu, t, fall)
        bend = eta * G[0] + zeta * G[1]
        before = f < 0.0
        low, high = where(before, X, low), where(before, high, X)
        root = apply("sqrt", apply("abs", 16.0 * slope * slope - 20.0 * f * bend))
        new = X - 5.0 * f / (slope + root)
        between = where(high < math.inf, 0.5 * (low + high), 2.0 * X)
        new = where((low <= new) & (new <= high), new, between)
        again = (CLOSE * apply("abs", new) < apply("abs", new - X)) & (going > 0.0)
        return again, [where(going > 0.0, new, X), low, high, where(again, going - 1.0, 0.0)]

    first = apply("min", t / r, most)
    return repeated(turn, [first, 0.0 * first, most + 0.0 * first, 0.0 * first + float(MOST)])[0]


def coefficients(
    X: Any,
    G: Sequence[Any],
    r: Any,
    inverse: Any,
    eta: Any,
    zeta: Any,
    mu: Any,
    t: Any,
    fall: Sequence[Any] = (),
) -> Numbers:
    """f − 1, g, f′, g′ − 1 after a step d of Newton's method from X, so short that it is linear; d; g as rG₁ + ηG₂."""
    G0, G1, G2, G3 = G
    late, distance = reached(X, G, r, eta, zeta, mu, t, fall)
    slope = 1.0 / distance
    d = -(late * slope)
    end = slope - (slope * d) * (slope * (eta * G0 + zeta * G1))  # 1 less a small number is rounded with a bias
    G1, G2, G3 = G1 + d * G0, G2 + d * G1, G3 + d * G2
    a = mu * G2
    f, g, df = -(a * inverse), t - mu * G3, -(mu * G1 * inverse * end)
    dg = -(a * end)
    excess = fma(f, dg, fma(-g, df, f + dg))  # of fg′ − f′g over 1, by rounding; with a bias, if it is not taken back
    dg = dg - where(f > -0.5, fma(f, f - 1.0, 1.0) * excess, 0.0)
    return [f, g, df, dg, d, r * G1 + eta * G2]


def moved(x: Sequence[Any], v: Sequence[Any], c: Sequence[Any]) -> Numbers:
    """Changes of positions and velocities by these coefficients."""
    f, g, df, dg = c
    return [f * a + g * b for a, b in zip(x, v, strict=True)] + [df * a + dg * b for a, b in zip(x, v, strict=True)]


def varied(
    start: tuple[Sequence[Any], Sequence[Any]],
    rates: Sequence[Any],
    c: Sequence[Any],
    known: tuple[Any, Any, Any, Any, Any, Any],
    found: tuple[Any, Sequence[Any], Any],
    late: Any = None,
) -> Numbers:
    """Changes of the rates of x and v over a motion with coefficients c, where those before are six numbers.

    `known` are 1/r, η, β, ζ, μ, r at the start, `found` are X, its Stumpff functions, and a step d that is still to be
    made from X; `late` is the rate of the time by β, where whole periods were left out.
    """
    (x, v), (inverse, eta, beta, zeta, mu, r), (X, (G0, G1, G2, G3), d) = start, known, found
    dx, dv = rates[:3], rates[3:]
    X, G1, G2, G3, G0 = X + d, G1 + d * G0, G2 + d * G1, G3 + d * G2, G0 - d * (beta * G1)
    G4, G5 = next_two(X, beta, G2, G3)
    r_rate = dot(x, dx) * inverse
    eta_rate, beta_rate = dot(dx, v) + dot(x, dv), -2.0 * (mu * inverse * inverse * r_rate + dot(v, dv))
    zeta_rate = -(beta * r_rate) - r * beta_rate
    by_beta = 0.5 * (G3 - X * G2), G4 - 0.5 * (X * G3), 0.5 * (3.0 * G5 - X * G4)  # of G₁, G₂, G₃
    time = 0.0 if late is None else late * beta_rate
    slope = 1.0 / (r + (eta * G1 + zeta * G2))
    X_rate = slope * (
        time - (X * r_rate + G2 * eta_rate + G3 * zeta_rate + (eta * by_beta[1] + zeta * by_beta[2]) * beta_rate)
    )
    first, second, third = (a * X_rate + b * beta_rate for a, b in zip((G0, G1, G2), by_beta, strict=True))
    end = (r_rate + (G1 * eta_rate + G2 * zeta_rate) + (eta * first + zeta * second)) * slope
    relative, whole = r_rate * inverse, mu * inverse
    turned = [
        -(whole * (second - G2 * relative)),
        time - mu * third,
        -(whole * slope * (first - G1 * (relative + end))),
        -(mu * slope * (second - G2 * end)),
    ]
    return [a + b for a, b in zip(moved(dx, dv, c), moved(x, v, turned), strict=True)]


def next_two(X: Any, beta: Any, G2: Any, G3: Any) -> tuple[Any, Any]:
    """G₄ and G₅."""
    square = X * X
    z = beta * square
    short = apply("abs", z) < 1.0
    small, large = where(short, z, 0.0), where(short, 1.0, beta)
    return (
        where(short, square * square * tail(small, 4, TERMS + 1), (0.5 * square - G2) / large),
        where(short, X * square * square * tail(small, 5, TERMS + 1), (X * square * (1 / 6) - G3) / large),
    )


def kepler_flow(x: Sequence[Any], v: Sequence[Any], mu: Any, t: Any) -> tuple[Numbers, Numbers]:
    """Move x and v, three numbers each, over a time t of any sign, about a centre with μ = GM > 0.

    Ellipses, parabolas and hyperbolas of any eccentricity, as exactly as their conditioning allows; whole periods are
    left out first.
    """
    new = [a + b for a, b in zip([*x, *v], kepler_changes(x, v, mu, t), strict=True)]
    return new[:3], new[3:]


def kepler_changes(x: Sequence[Any], v: Sequence[Any], mu: Any, t: Any, rates: Sequence[Any] = ()) -> Numbers:
    """The changes of x and v by `kepler_flow`, and of their rates, where these are given."""
    square = dot(x, x)
    r = apply("sqrt", square)
    inverse, eta = 1.0 / r, dot(x, v)
    beta = 2.0 * mu * inverse - dot(v, v)
    bound = where(beta > 0.0, beta, 1.0)
    period = 2.0 * math.pi * mu / (bound * apply("sqrt", bound))
    left_out = where(beta > 0.0, period * apply("floor", t / period + 0.5), 0.0)
    t = t - left_out
    sign = where(t < 0.0, 0.0 * t - 1.0, 1.0)
    forward, along, zeta = t * sign, eta * sign, mu - beta * r
    fall = falling(x, [sign * a for a in v], along, zeta, beta, mu)
    X = solved(*map(detached, (r, along, zeta, beta, mu, forward, *fall)))
    G = stumpff(X, beta)
    f, g, df, dg, d, other = coefficients(X, G, r, inverse, along, zeta, mu, forward, fall)
    g = where(2.0 * apply("abs", forward - g) < apply("max", forward, -2.0 * along * G[2]), g, other)
    c = [f, sign * g, sign * df, dg]
    if not rates:
        return moved(x, v, c)
    found = sign * X, (G[0], sign * G[1], G[2], sign * G[3]), sign * d
    known = inverse, eta, beta, zeta, mu, r
    return moved(x, v, c) + varied((x, v), rates, c, known, found, 1.5 * left_out / bound)


@np.errstate(all="ignore")
def elements_of(x: np.ndarray, v: np.ndarray, mu: Any) -> np.ndarray:
    """Osculating elements (..., 6) of x and v (..., 3): a, e, inclination, node, argument of pericentre, M.

    Angles are in radians, from 0 to 2π, the inclination to π. Where the node or the pericentre is not defined, the
    angle is 0 and the next one is counted from there. Of a hyperbola a < 0 and M is the hyperbolic mean anomaly.
    """
    mu = np.asarray(mu, dtype=float)
    h = np.cross(x, v)
    r, size = np.linalg.norm(x, axis=-1), np.linalg.norm(h, axis=-1)
    a = 1 / (2 / r - (v * v).sum(-1) / mu)
    towards = np.cross(v, h) / mu[..., None] - x / r[..., None]
    e = np.linalg.norm(towards, axis=-1)
    inclination = np.arctan2(np.hypot(h[..., 0], h[..., 1]), h[..., 2])
    flat = np.hypot(h[..., 0], h[..., 1]) < 1e-15 * size
    node = np.where(flat, 0.0, np.arctan2(h[..., 0], -h[..., 1]))
    along = np.stack([np.cos(node), np.sin(node), 0 * node], axis=-1)
    across = np.cross(h / size[..., None], along)
    round_ = e < 1e-14
    peri = np.where(round_, 0.0, np.arctan2((towards * across).sum(-1), (towards * along).sum(-1)))
    f = np.arctan2((x * across).sum(-1), (x * along).sum(-1)) - peri
    bound, root = e < 1, np.sqrt(np.abs(1 - e) / (1 + e)) * np.tan(f / 2)
    E = np.where(bound, 2 * np.arctan(root), 2 * np.arctanh(np.where(np.abs(root) < 1, root, 0.0)))
    M = np.where(bound, np.mod(E - e * np.sin(E), 2 * np.pi), e * np.sinh(E) - E)
    turn = 2 * np.pi
    return np.stack([a, e, inclination, np.mod(node, turn), np.mod(peri, turn), M], axis=-1)


@np.errstate(all="ignore")
def states_of(elements: np.ndarray, mu: Any) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (..., 3) of elements (..., 6): the pericentre, moved by the time that belongs to M."""
    a, e, inclination, node, peri, M = np.moveaxis(np.asarray(elements, dtype=float), -1, 0)
    mu = np.asarray(mu, dtype=float) + 0 * a
    q = a * (1 - e)
    speed, zero = np.sqrt(mu * (1 + e) / q), 0 * q
    x, v = kepler_flow([q, zero, zero], [zero, speed, zero], mu, M * np.sqrt(np.abs(a) ** 3 / mu))

    def turned(u: Numbers) -> np.ndarray:
        c, s = np.cos(peri), np.sin(peri)
        along, across = c * u[0] - s * u[1], s * u[0] + c * u[1]
        level, up = across * np.cos(inclination), across * np.sin(inclination)
        c, s = np.cos(node), np.sin(node)
        return np.stack([c * along - s * level, s * along + c * level, up], axis=-1)

    return turned(x), turned(v)
