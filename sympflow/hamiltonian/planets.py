"""Planets about a star: a system that knows its star, and the coordinates in which Kepler's motion is cut.

A frame has the planets in their order from the star, positions x and velocities v of each relative to a centre, about
which its motion is Kepler's with μ, and the rest of H, the interaction: a potential in Jacobi's coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, Self

import numpy as np

from sympflow.arguments import plain, real_number
from sympflow.arrays import Array, concatenate, like, masked, stack, to_numpy
from sympflow.hamiltonian.bodies import PairsHamiltonian
from sympflow.hamiltonian.kepler import elements_of, kepler_flow, states_of

COORDINATES = ("jacobi", "democratic")
ELEMENTS = ("a", "e", "inc", "node", "peri", "M")
"""Names of orbital elements: semi-major axis, eccentricity, inclination, longitude of the ascending node, argument of
the pericentre, mean anomaly; angles in radians."""

SUN = 1.3271244e20
LENGTHS = {"m": 1.0, "km": 1e3, "AU": 149_597_870_700.0}
TIMES = {"s": 1.0, "day": 86_400.0, "year": 365.25 * 86_400.0}
MASSES = {"kg": 6.67430e-11, "solar mass": SUN, "Jupiter mass": 1.2668653e17, "Earth mass": 3.986004e14}
"""Units in SI, masses times G: IAU 2012 B2, IAU 2015 B3, CODATA 2018."""

FEWEST_STEPS = 20  # of a method in the shortest period
MOON = 0.5  # of a Hill radius: bodies that are nearer may be bound


def gravity(units: Any) -> float:
    """Return G in units of length, time and mass, three names such as ("AU", "day", "solar mass")."""
    names = [x.strip() for x in units.split(",")] if isinstance(units, str) else units
    tables = LENGTHS, TIMES, MASSES
    if not isinstance(names, list | tuple) or len(names) != 3:
        raise ValueError(
            f"`units` must be names of a length, a time and a mass, such as 'AU, day, solar mass'; got {units!r}."
        )
    for name, table in zip(names, tables, strict=True):
        if not isinstance(name, str) or name not in table:
            raise ValueError(
                f"`units` has {name!r}, which is none of {', '.join(map(repr, table))}: take one of these."
            )
    length, time, mass = (table[name] for name, table in zip(names, tables, strict=True))
    return mass * time**2 / length**3


class Frame:
    """The coordinates of planets about a star in which the splitting "kepler" makes its steps.

    `order` and `test` are the planets with a mass, by their semi-major axes in y0, and those without; `inside`, for
    each of the latter, how many of the former are inside of its orbit; `mu` belongs to Kepler's motion of each.
    """

    def __init__(
        self,
        local: PairsHamiltonian,
        G: float,
        y0: np.ndarray,
        coordinates: str = "jacobi",
        encounter: float | None = 1.0,
    ) -> None:
        self.local, self.G, self.coordinates, self.encounter = local, G, coordinates, encounter
        masses = self.masses = local.masses
        self.inertia = local.inertia
        q, v = self.states(np.asarray(y0, dtype=float))
        x, u = q[1:] - q[0], v[1:] - v[0]
        self.elements = elements_of(x, u, G * (masses[0] + masses[1:]))
        a, e = self.elements[:, :2].T
        self.size = np.where(e < 1, np.abs(a), np.linalg.norm(x, axis=-1))
        massive = masses[1:] > 0
        by_size = 1 + np.argsort(self.size, kind="stable")
        self.order, self.test = by_size[massive[by_size - 1]], 1 + np.flatnonzero(~massive)
        self.inside = np.searchsorted(self.size[self.order - 1], self.size[self.test - 1])
        self.sums = masses[0] + np.concatenate([[0.0], np.cumsum(masses[self.order])])
        self.jacobi = coordinates == "jacobi"
        heavy, light = (self.sums[1:], self.sums[self.inside]) if self.jacobi else (masses[:1], masses[:1])
        self.mu = G * np.concatenate(
            [np.broadcast_to(heavy, self.order.shape), np.broadcast_to(light, self.test.shape)]
        )
        self.periods = 2 * np.pi * np.sqrt(self.size**3 / (G * (masses[0] + masses[1:])))

    @property
    def longest_step(self) -> float:
        """The longest time between two kicks."""
        return float(self.periods.min()) / FEWEST_STEPS

    @cached_property
    def bodies(self) -> np.ndarray:
        """The bodies in the order of the coordinates."""
        return np.concatenate([self.order, self.test])

    @cached_property
    def weights(self) -> list[float]:
        """The share of each planet in the mass of all up to it."""
        return (self.masses[self.order] / self.sums[1:]).tolist()

    def hill_radii(self, i: Any, j: Any, share: float = 1.0) -> np.ndarray:
        """The mutual Hill radius of bodies; with a share of 0 that of i and bodies without mass."""
        mean = (self.size[i - 1] + self.size[j - 1]) / 2
        return mean * np.cbrt((self.masses[i] + share * self.masses[j]) / (3 * self.masses[0]))

    def states(self, y: Array) -> tuple[Array, Array]:
        """Positions and velocities (..., n, 3)."""
        n = len(self.masses)
        q, p = (x.reshape(*y.shape[:-1], n, 3) for x in (y[..., : 3 * n], y[..., 3 * n :]))
        return q, p / like(self.inertia[:, None], p)

    # transformations ----------------------------------------------------------------------------------------------

    def relative(self, q: Array) -> tuple[Array, Array]:
        """Jacobi's vectors (..., n − 1, 3) of vectors of the bodies (..., n, 3), and that of the centre (..., 3)."""
        R = q[..., 0, :]
        x, centres = [], [R]
        for i, w in zip(self.order.tolist(), self.weights, strict=True):
            x.append(q[..., i, :] - R)
            R = R + w * x[-1]
            centres.append(R)
        planets = stack(x, axis=-2)
        if len(self.test):
            planets = concatenate([planets, q[..., self.test, :] - stack(centres, axis=-2)[..., self.inside, :]], -2)
        return planets, R

    def absolute(self, x: Array, centre: Array) -> Array:
        """The bodies of such vectors."""
        R = 0 * centre
        q, centres = [R], [R]
        for k, w in enumerate(self.weights):
            q.append(x[..., k, :] + R)
            R = R + w * x[..., k, :]
            centres.append(R)
        bodies = stack(q, axis=-2)
        n = len(self.order)
        if len(self.test):
            bodies = concatenate([bodies, x[..., n:, :] + stack(centres, axis=-2)[..., self.inside, :]], -2)
        return (bodies + (centre - R)[..., None, :])[..., self._places, :]

    @cached_property
    def _places(self) -> np.ndarray:
        return np.argsort(np.concatenate([[0], self.bodies]))

    def into(self, y: Array) -> tuple[Array, Array, Array, Array]:
        """x and v of the planets (..., n − 1, 3), and the place and velocity of the centre (..., 3), of states."""
        q, u = self.states(y)
        x, Q = self.relative(q)
        v, U = self.relative(u)
        if not self.jacobi:
            x, v = (q - q[..., :1, :])[..., self.bodies, :], (u - U[..., None, :])[..., self.bodies, :]
        return x, v, Q, U

    def out(self, x: Array, v: Array, Q: Array, U: Array) -> Array:
        """The states (..., 2d) of these."""
        if self.jacobi:
            q, u = self.absolute(x, Q), self.absolute(v, U)
        else:
            share = like((self.masses[self.bodies] / self.masses.sum())[:, None], x)
            q = concatenate([0 * x[..., :1, :], x], -2) + (Q - (share * x).sum(-2))[..., None, :]
            star = -(like((self.masses[self.bodies] / self.masses[0])[:, None], v) * v).sum(-2)
            u = concatenate([star[..., None, :], v], -2) + U[..., None, :]
            q, u = q[..., self._places, :], u[..., self._places, :]
        p = u * like(self.inertia[:, None], u)
        d = self.local.ndof
        return concatenate([q.reshape(*q.shape[:-2], d), p.reshape(*p.shape[:-2], d)])

    # the two flows of the splitting, by array operations ------------------------------------------------------------

    def drift(self, x: Array, v: Array, t: Any) -> tuple[Array, Array]:
        """Move each planet on its orbit for a time t (...)."""
        axes = range(3)
        time = t[..., None] + 0 * x[..., 0]
        new = kepler_flow([x[..., k] for k in axes], [v[..., k] for k in axes], like(self.mu, x), time)
        return stack(new[0]), stack(new[1])

    def kick(self, x: Array, v: Array, t: Any) -> tuple[Array, Array]:
        """Let the planets act on each other for a time t (...)."""
        t, centre = t[..., None, None], 0 * x[..., 0, :]
        share = like((self.masses[self.bodies] / self.masses[0])[:, None], x)
        if not self.jacobi:
            x = x + t / 2 * (share * v).sum(-2, keepdims=True)
        q = self.absolute(x, centre) if self.jacobi else concatenate([0 * x[..., :1, :], x], -2)[..., self._places, :]
        slope = self.local.potential_gradient(q.reshape(*q.shape[:-2], -1)).reshape(q.shape)
        a = -slope / like(self.inertia[:, None], q)
        a = self.relative(a)[0] if self.jacobi else a[..., self.bodies, :]
        square = (x * x).sum(-1, keepdims=True)
        v = v + t * (a + like(self.mu[:, None], x) * x / (square * square**0.5))
        if not self.jacobi:
            x = x + t / 2 * (share * v).sum(-2, keepdims=True)
        near = self.near(q)
        if near is not None:
            x = masked(x, near.any(-1)[..., None, None], math.nan)
        return x, v

    def near(self, q: Array) -> Array | None:
        """True for the pairs of planets with masses (..., P) that are nearer than `encounter`, as `pairs` has them."""
        if self.encounter is None:
            return None
        i, j = self.pairs
        d = q[..., i, :] - q[..., j, :]
        return (d * d).sum(-1) < like(self.limits, d)

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """The pairs of planets that have a mass."""
        i, j = np.triu_indices(len(self.order), 1)
        return self.order[i], self.order[j]

    @cached_property
    def limits(self) -> np.ndarray:
        """The square of the distance of each pair that ends a run."""
        return ((self.encounter or 0.0) * self.hill_radii(*self.pairs)) ** 2

    # what does not suit ---------------------------------------------------------------------------------------------

    def check(self, method: str) -> None:
        """Raise a ValueError where some body is no planet of the star: bound to another one, or not bound at all."""
        masses = self.masses
        if masses[1:].max() >= masses[0]:
            i = 1 + int(np.argmax(masses[1:]))
            raise ValueError(
                f"`method` {method!r} needs the star as body 0, and body {i} is as heavy: put the heaviest first, or "
                "take the splitting 'kinetic', such as 'srkn11b'."
            )
        one, other = self.pairs
        x, v = states_of(self.elements, self.G * (masses[0] + masses[1:]))
        d, u = (y[one - 1] - y[other - 1] for y in (x, v))
        r = np.linalg.norm(d, axis=-1)
        close = r < MOON * np.maximum(self.hill_radii(one, one, 0.0), self.hill_radii(other, other, 0.0))
        bound = close & ((u * u).sum(-1) / 2 < self.G * (masses[one] + masses[other]) / r)
        if bound.any():
            first, second = sorted(int(i[bound][0]) for i in (one, other))
            raise ValueError(
                f"`method` {method!r} has each body on an orbit about the star, and bodies {first} and {second} are "
                "bound to each other: take the splitting 'kinetic', such as 'srkn11b', or one body in place of both."
            )

    def crossing(self) -> tuple[int, int] | None:
        """Two planets with masses whose distances from the star overlap, or None."""
        a, e = self.elements[self.order - 1, :2].T
        for k in range(len(a) - 1):
            if e[k] >= 1 or e[k + 1] >= 1 or a[k] * (1 + e[k]) >= a[k + 1] * (1 - e[k + 1]):
                return int(self.order[k]), int(self.order[k + 1])
        return None


def frame_of(local: Any, y0: Any) -> Frame | None:
    """The frame of planets, or of a star and bodies in pairs that attract each other as these do; None of others."""
    if isinstance(local, PlanetsHamiltonian):
        return local.frame
    G = newtonian(local) if isinstance(local, PairsHamiltonian) else None
    return None if G is None or y0 is None else Frame(local, G, np.asarray(to_numpy(y0)))


def newtonian(local: PairsHamiltonian) -> float | None:
    """G of bodies in space that attract each other by −G m₁m₂/r; None of others."""
    if local.dim != 3 or local.box is not None or local.cutoff is not None or local.softening or len(local.first) != 1:
        return None
    if not np.array_equal(local.columns[0], local.masses):
        return None
    strength = -local.V * local.s**0.5 / (local.first[0] * local.second[0])
    strength = strength.simplify().subs(dict(zip(local.c, local.constants, strict=True)))
    return float(strength) if strength.is_number and strength > 0 else None


class PlanetsHamiltonian(PairsHamiltonian):
    """H = Σ |p_i|²/2m_i − G Σ_{i<j} m_i m_j/r_ij, with a star, body 0: see `HamiltonianSystem.planets`.

    Bodies of mass 0 have momenta per unit mass; they feel the others and are not felt.
    """

    noun = "system of planets"

    def __init__(self, masses: Any, G: float, y0: np.ndarray, coordinates: Any, encounter: Any) -> None:
        if coordinates not in COORDINATES:
            raise ValueError(f"`coordinates` must be 'jacobi' or 'democratic'; got {coordinates!r}.")
        encounter = plain(encounter)
        if encounter is not None and not (real_number(encounter) and 0 < encounter < math.inf):
            raise ValueError(f"`encounter` must be positive, in Hill radii, or None for none; got {encounter!r}.")
        super().__init__("-G*m1*m2/r", masses, 3, None, None, None, {"G": G}, None)
        self.start, self.coordinates, self.encounter = y0, coordinates, encounter

    def _check_masses(self) -> None:
        """Do nothing: bodies may have no mass."""

    @property
    def inertia(self) -> np.ndarray:
        return np.where(self.masses > 0, self.masses, 1.0)

    @cached_property
    def felt(self) -> np.ndarray | None:  # type: ignore[override]
        return None if (self.masses > 0).all() else np.repeat(np.where(self.masses > 0, 1.0, 0.0), 3)

    @property
    def is_few(self) -> bool:
        return self.felt is None and super().is_few

    @cached_property
    def _heavy(self) -> tuple[np.ndarray, PairsHamiltonian]:
        """The bodies that have a mass, and their part of H."""
        heavy = np.flatnonzero(self.masses > 0)
        return heavy, PairsHamiltonian("-G*m1*m2/r", self.masses[heavy], 3, None, None, None, self.params, None)

    def _of_heavy(self, q: Array) -> Array:
        x = q.reshape(*q.shape[:-1], self.n_bodies, 3)[..., self._heavy[0], :]
        return x.reshape(*x.shape[:-2], 3 * len(self._heavy[0]))

    def potential(self, q: Array) -> Array:
        return super().potential(q) if self.felt is None else self._heavy[1].potential(self._of_heavy(q))

    def potential_gradient(self, q: Array) -> Array:
        if self.felt is None:
            return super().potential_gradient(q)
        return self._with_light(self._heavy[1].potential_gradient(self._of_heavy(q)), q)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        if self.felt is None:
            return super().hessian_vector(q, v, *t)
        return self._with_light(self._heavy[1].hessian_vector(self._of_heavy(q), self._of_heavy(v)), q, v)

    def _with_light(self, heavy: Array, q: Array, v: Array | None = None) -> Array:
        """Slopes of the bodies with mass, and per unit mass of all others; along v their derivatives."""
        order, light = self._heavy[0], np.flatnonzero(self.masses == 0)
        x = q.reshape(*q.shape[:-1], self.n_bodies, 3)
        u = None if v is None else v.reshape(*v.shape[:-1], self.n_bodies, 3)
        total: Any = 0 * (x if u is None else x + u)[..., light, :]
        for j in order.tolist():
            d = x[..., light, :] - x[..., j : j + 1, :]
            square = (d * d).sum(-1)[..., None]
            w = self.params["G"] * float(self.masses[j]) / (square * square**0.5)
            if u is None:
                total = total + w * d
            else:
                e = u[..., light, :] - u[..., j : j + 1, :]
                total = total + w * (e - 3 * (d * e).sum(-1)[..., None] / square * d)
        known = heavy.reshape(*heavy.shape[:-1], len(order), 3)
        whole = concatenate([known + 0 * total[..., :1, :], total], -2)
        whole = whole[..., np.argsort(np.concatenate([order, light])), :]
        return whole.reshape(*whole.shape[:-2], self.ndof)

    @cached_property
    def frame(self) -> Frame:
        return Frame(self, self.params["G"], self.start, self.coordinates, self.encounter)

    def remark(self, q: np.ndarray) -> str:
        i, j = self.frame.pairs
        if not len(i):
            return ""
        x = q.reshape(-1, 3)
        distance = np.linalg.norm(x[i] - x[j], axis=-1)
        ratio = distance / self.frame.hill_radii(i, j)
        k = int(np.argmin(ratio))
        one, other = sorted((int(i[k]), int(j[k])))
        return f"the nearest planets, {one} and {other}, are {distance[k]:.4g} apart, {ratio[k]:.3g} Hill radii."

    def with_params(self, values: Mapping[str, Any]) -> Self:
        other = super().with_params(values)
        for name in ("frame", "_heavy"):
            vars(other).pop(name, None)
        return other


def checked_planets(masses: Any, elements: Any, y0: Any, G: Any, units: Any) -> tuple[np.ndarray, float, np.ndarray]:
    """Masses, G and the state y0 that `HamiltonianSystem.planets` is given, tested."""
    G, given = plain(G), masses
    if G is not None and units is not None:
        raise ValueError("`units` tell what `G` is: leave out one of them.")
    if G is not None and not (real_number(G) and 0 < G < math.inf):
        raise ValueError(f"`G` must be positive and finite; got {G!r}.")
    G = 1.0 if G is None and units is None else float(G) if units is None else gravity(units)
    try:
        masses = np.array(to_numpy(masses), dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"`masses` must be an array (n,) of numbers, the star's first; got {given!r}.") from None
    if masses.ndim != 1 or len(masses) < 2:
        raise ValueError(
            f"`masses` must be those of a star and one planet or more, an array (n,); got shape {masses.shape}."
        )
    if not (np.isfinite(masses) & (masses >= 0)).all():
        i = int(np.argmin(np.isfinite(masses) & (masses >= 0)))
        raise ValueError(
            f"`masses` must be positive, or 0 of bodies that are not felt; that of body {i} is {masses[i]:g}: "
            "change it."
        )
    if masses[1:].max() >= masses[0]:
        i = 1 + int(np.argmax(masses[1:]))
        raise ValueError(
            f"`masses` must begin with the star, the heaviest body, and that of body {i} is {masses[i]:g}: put it "
            "first, or make the system by HamiltonianSystem.pairs."
        )
    if (elements is None) == (y0 is None):
        raise ValueError("`elements` or `y0` must be given, one of them: the orbits, or the state [q, p].")
    if y0 is None:
        y0 = placed(masses, G, _checked_elements(elements, len(masses) - 1))
    y0 = np.array(to_numpy(y0), dtype=float)
    if y0.shape != (6 * len(masses),) or not np.isfinite(y0).all():
        raise ValueError(f"`y0` must be a finite state [q, p] of shape ({6 * len(masses)},); got shape {y0.shape}.")
    return masses, G, y0


def _checked_elements(elements: Any, n: int) -> np.ndarray:
    """Orbital elements (n, 6)."""
    if isinstance(elements, Mapping):
        unknown = [name for name in elements if name not in ELEMENTS]
        if unknown or "a" not in elements:
            what = f"has {unknown[0]!r}" if unknown else "must have 'a'"
            raise ValueError(
                f"`elements` {what}: the names are {', '.join(ELEMENTS)}, of which all but a are 0 by default."
            )
        columns: Any = [elements.get(name, 0.0) for name in ELEMENTS]
    else:
        columns = np.moveaxis(np.asarray(elements, dtype=float), -1, 0) if np.ndim(elements) else ()
    try:
        table = np.stack([np.broadcast_to(np.asarray(x, dtype=float), (n,)) for x in columns], axis=-1)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape != (n, 6):
        raise ValueError(
            f"`elements` must give {', '.join(ELEMENTS)} of {n} planets: arrays ({n},), or one of shape ({n}, 6)."
        )
    a, e, inclination = table[:, :3].T
    for bad, name, remedy in (
        (~np.isfinite(table).all(-1), "numbers that are not finite", "give finite ones"),
        ((e < 0) | (e == 1), "an eccentricity that is negative or 1", "take 0 ≤ e < 1, or e > 1 with a < 0"),
        (np.where(e < 1, a <= 0, a >= 0), "a semi-major axis of the wrong sign", "a > 0 for e < 1, a < 0 for e > 1"),
        (np.abs(inclination) > np.pi, "an inclination beyond π", "angles are in radians: np.radians converts degrees"),
    ):
        if bad.any():
            i = int(np.argmax(bad))
            raise ValueError(f"`elements` of planet {i + 1} have {name}: {remedy}.")
    return table


def placed(masses: np.ndarray, G: float, elements: np.ndarray) -> np.ndarray:
    """The states [q, p] of planets with heliocentric elements (..., n, 6), the centre of mass at rest at the origin."""
    share = (masses / masses.sum())[:, None]
    momenta = np.where(masses > 0, masses, 1.0)[:, None]
    whole = []
    for z, factor in zip(states_of(elements, G * (masses[0] + masses[1:])), (1.0, momenta), strict=True):
        bodies = np.concatenate([0 * z[..., :1, :], z], axis=-2)
        bodies = factor * (bodies - (share * bodies).sum(-2, keepdims=True))
        whole.append(bodies.reshape(*bodies.shape[:-2], -1))
    return np.concatenate(whole, axis=-1)
