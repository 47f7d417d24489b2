"""Planets about a star: a system with a star, and the coordinates of the splitting into Kepler's motion and
interaction.

A frame has the planets in their order from the star, positions x and velocities v of each relative to a centre, about
which its motion is Kepler's with μ, and the rest of H, the interaction: a potential in Jacobi's coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import Any, Self

import numpy as np
import sympy as sp

from sympflow.arguments import plain, real_number
from sympflow.arrays import Array, concatenate, like, masked, stack, to_numpy
from sympflow.compiler.functions import apply
from sympflow.compiler.program import Program, gradient, tangent, traced
from sympflow.hamiltonian.bodies import MOST_SPELLED_PAIRS, Pairs, PairsHamiltonian, checked_column, most_pairs
from sympflow.hamiltonian.formulas import evaluator
from sympflow.hamiltonian.jumps import check_continuous
from sympflow.hamiltonian.kepler import elements_of, kepler_flow, states_of
from sympflow.hamiltonian.local import MOST_SPELLED, checked_params, numbered, parsed
from sympflow.hamiltonian.recorded import NotRecorded
from sympflow.lazy import kept
from sympflow.schemes import Substeps

COORDINATES = ("jacobi", "democratic")
ELEMENTS = ("a", "e", "inc", "node", "peri", "M")
"""Names of orbital elements: semi-major axis, eccentricity, inclination, longitude of the ascending node, argument of
the pericentre, mean anomaly; angles in radians."""
SUN = 1.3271244e20
LENGTHS = {"m": 1.0, "km": 1e3, "AU": 149_597_870_700.0}
TIMES = {"s": 1.0, "day": 86_400.0, "year": 365.25 * 86_400.0}
MASSES = {"kg": 6.67430e-11, "solar mass": SUN, "Jupiter mass": 1.2668653e17, "Earth mass": 3.986004e14}
"""Units in SI, masses times G: IAU 2012 B2, IAU 2015 B3, CODATA 2018."""
PLACE = "x", "y", "z", "r"  # names in an extra potential: the place of a body as seen from the star, and its distance
FEWEST_STEPS = 20  # of a method in the shortest period
MOON = 0.5  # of a Hill radius: bodies that are nearer may be bound


def gravity(units: Any) -> float:
    """Return G in units of length, time and mass, three names such as ("AU", "day", "solar mass"), or "SI"."""
    names = "m, s, kg" if units == "SI" else units
    names = [x.strip() for x in names.split(",")] if isinstance(names, str) else names
    tables = LENGTHS, TIMES, MASSES
    if not isinstance(names, list | tuple) or tuple(names) not in product(*tables):
        known = "; ".join(", ".join(table) for table in tables)
        raise ValueError(
            "`units` must be 'SI', or names of a length, a time and a mass, such as 'AU, day, solar mass'; got "
            f"{units!r}. The names are {known}."
        )
    length, time, mass = (table[name] for name, table in zip(names, tables, strict=True))
    return mass * time**2 / length**3


class Frame:
    """The coordinates of planets about a star in which the splitting "kepler" makes its steps.

    `order` and `test` are the planets with a mass, by their semi-major axes in y0, and those without; `inside`, for
    each of the latter, how many of the former are inside of its orbit; `mu` belongs to Kepler's motion of each.
    """

    def __init__(
        self, local: Any, G: float, y0: np.ndarray, coordinates: str = "jacobi", encounter: float | None = 1.0
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
        self.longest_step = float(self.periods.min()) / FEWEST_STEPS  # between two kicks
        self.bodies = np.concatenate([self.order, self.test])  # in the order of the coordinates
        self._places = np.argsort(np.concatenate([[0], self.bodies]))
        self.weights = (masses[self.order] / self.sums[1:]).tolist()  # of each planet in the mass of all up to it
        one, other = (self.order[i] for i in np.triu_indices(len(self.order), 1))
        self.pairs = one, other  # of planets that have a mass
        self.limits = ((encounter or 0.0) * self.hill_radii(one, other)) ** 2  # of squared distances, which end a run

    def hill_radii(self, i: Any, j: Any, share: float = 1.0) -> np.ndarray:
        """The mutual Hill radius of bodies; with a share of 0 that of i and bodies without mass."""
        mean = (self.size[i - 1] + self.size[j - 1]) / 2
        return mean * np.cbrt((self.masses[i] + share * self.masses[j]) / (3 * self.masses[0]))

    def states(self, y: Array) -> tuple[Array, Array]:
        """Positions and velocities (..., n, 3)."""
        n = len(self.masses)
        q, p = (x.reshape(*y.shape[:-1], n, 3) for x in (y[..., : 3 * n], y[..., 3 * n :]))
        return q, p / like(self.inertia[:, None], p)

    def relative(self, q: Array) -> tuple[Array, Array]:
        """Jacobi's vectors (..., n − 1, 3) of vectors of the bodies (..., n, 3), and that of the centre (..., 3)."""
        R = q[..., 0, :]
        x, centres = [], [R]
        for i, w in zip(self.order.tolist(), self.weights, strict=True):
            x.append(q[..., i, :] - R)
            R = R + w * x[-1]
            centres.append(R)
        planets = stack(x, axis=-2) if x else q[..., :0, :]
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

    def kick(self, x: Array, v: Array, t: Any, third: Any = None) -> tuple[Array, Array]:
        """Let the planets act on each other for a time t (...), with `third` (...) times the force gradient too."""
        t = t[..., None, None]
        share = like((self.masses[self.bodies] / self.masses[0])[:, None], x)
        if not self.jacobi:
            x = x + t / 2 * (share * v).sum(-2, keepdims=True)
        q = self._placed(x)
        a = self._accelerations(q, x)
        v = v + t * a
        if third is not None:
            v = v + third[..., None, None] * self._accelerations(q, x, a)
        if not self.jacobi:
            x = x + t / 2 * (share * v).sum(-2, keepdims=True)
        near = self.near(q)
        if near is not None:
            x = masked(x, near.any(-1)[..., None, None], math.nan)
        return x, v

    def moved(self, y: Array, passed: Any, *pieces: tuple[Substeps, Any]) -> Array:
        """States after pieces of substeps, each with its step (...); the centre moves for the time `passed`."""
        x, v, Q, U = self.into(y)
        for substeps, h in pieces:
            for kick, drift, third in substeps:
                if kick or third:
                    x, v = self.kick(x, v, kick * h, third * h**3 if third else None)
                if drift:
                    x, v = self.drift(x, v, drift * h)
        return self.out(x, v, Q + passed[..., None] * U, U)

    def kepler_energy(self, y: Array) -> Array:
        """The part (...) of H that drifts conserve, in Jacobi's coordinates."""
        x, v, _, U = self.into(y)
        n, sums = len(self.order), self.sums
        x, v, mu = x[..., :n, :], v[..., :n, :], like(self.mu[:n], y)
        each = (v * v).sum(-1) / 2 - mu / (x * x).sum(-1) ** 0.5
        return (like(self.masses[self.order] * sums[:-1] / sums[1:], y) * each).sum(-1) + sums[-1] * (U * U).sum(-1) / 2

    def interaction(self, x: Array, along: Array | None = None) -> Array:
        """Accelerations of planets at x by the interaction; along vectors of theirs, the derivative."""
        return self._accelerations(self._placed(x), x, along)

    def _placed(self, x: Array) -> Array:
        """Places of the bodies, but for that of the centre, or vectors of these, of those of the planets."""
        if self.jacobi:
            return self.absolute(x, 0 * x[..., 0, :])
        return concatenate([0 * x[..., :1, :], x], -2)[..., self._places, :]

    def _accelerations(self, q: Array, x: Array, along: Array | None = None) -> Array:
        """Accelerations by the interaction; along vectors of the planets, their derivative."""
        flat = [u.reshape(*u.shape[:-2], -1) for u in ((q,) if along is None else (q, self._placed(along)))]
        slope = self.local.potential_gradient(*flat) if along is None else self.local.hessian_vector(*flat)
        a = -slope.reshape(q.shape) / like(self.inertia[:, None], q)
        a = self.relative(a)[0] if self.jacobi else a[..., self.bodies, :]
        square = (x * x).sum(-1, keepdims=True)
        pull = like(self.mu[:, None], x) / (square * square**0.5)
        if along is None:
            return a + pull * x
        return a + pull * (along - 3 * (x * along).sum(-1, keepdims=True) / square * x)

    @property
    def extra(self) -> tuple[Program, list[float]] | None:
        """The program of the slope of an extra potential and the numbers behind the place, if there is one."""
        local = self.local
        if not isinstance(local, PlanetsHamiltonian) or local.extra is None:
            return None
        return local.extra_program(1), local.extra_values

    def near(self, q: Array) -> Array | None:
        """True for the pairs of planets with masses (..., P) that are nearer than `encounter`, as `pairs` has them."""
        if self.encounter is None:
            return None
        i, j = self.pairs
        d = q[..., i, :] - q[..., j, :]
        return (d * d).sum(-1) < like(self.limits, d)

    def check(self, method: str) -> None:
        """Raise a ValueError where some body is not a planet of the star: bound to another one, or not bound at all."""
        masses = self.masses
        if masses[1:].max() >= masses[0]:
            i = 1 + int(np.argmax(masses[1:]))
            raise ValueError(
                f"`method` {method!r} needs the star as body 0, and body {i} is as heavy: put the heaviest first, or "
                "take the splitting 'kinetic', such as 'srkn11b'."
            )
        if self.bound_pair is not None:
            first, second = self.bound_pair
            raise ValueError(
                f"`method` {method!r} has each body on an orbit about the star, and bodies {first} and {second} are "
                "bound to each other: take the splitting 'kinetic', such as 'srkn11b', or one body in place of both."
            )

    @cached_property
    def bound_pair(self) -> tuple[int, int] | None:
        """Two bodies that are bound to each other at the start, or None."""
        one, other = self.pairs
        felt = states_of(self.elements[self.order - 1], self.G * (self.masses[0] + self.masses[self.order]))
        near, far = np.triu_indices(len(self.order), 1)
        d, u = (y[near] - y[far] for y in felt)
        r = np.linalg.norm(d, axis=-1)
        close = r < MOON * np.maximum(self.hill_radii(one, one, 0.0), self.hill_radii(other, other, 0.0))
        bound = close & ((u * u).sum(-1) / 2 * r < self.G * (self.masses[one] + self.masses[other]))
        if not bound.any():
            return None
        first, second = sorted(int(i[bound][0]) for i in (one, other))
        return first, second

    def crossing(self) -> tuple[int, int] | None:
        """Two planets with masses whose distances from the star overlap, or None."""
        a, e = self.elements[self.order - 1, :2].T
        for k in range(len(a) - 1):
            if e[k] >= 1 or e[k + 1] >= 1 or a[k] * (1 + e[k]) >= a[k + 1] * (1 - e[k + 1]):
                return int(self.order[k]), int(self.order[k + 1])
        return None


@kept
def frame_of(system: Any) -> Frame | None:
    """The frame of planets, or of a star and bodies in pairs that attract each other so; None for other systems."""
    local = system.local
    if isinstance(local, PlanetsHamiltonian):
        return local.frame
    G = newtonian(local) if isinstance(local, PairsHamiltonian) else None
    return None if G is None or system.y0 is None else Frame(local, G, system.y0)


def newtonian(local: PairsHamiltonian) -> float | None:
    """G of bodies in space that attract each other by −G m₁m₂/r; None for other systems."""
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
    extra: sp.Expr | None = None

    def __init__(
        self, masses: Any, G: float, y0: Any, coordinates: Any, encounter: Any, extra: Any = None, params: Any = None
    ) -> None:
        if coordinates not in COORDINATES:
            raise ValueError(f"`coordinates` must be 'jacobi' or 'democratic'; got {coordinates!r}.")
        encounter = plain(encounter)
        if encounter is not None and not (real_number(encounter) and 0 < encounter < math.inf):
            raise ValueError(f"`encounter` must be positive, in Hill radii, or None for none; got {encounter!r}.")
        super().__init__("-G*m1*m2/r", masses, 3, None, None, None, {"G": G}, None)
        self.felt = None if (self.masses > 0).all() else np.repeat(np.where(self.masses > 0, 1.0, 0.0), 3)
        self.is_few = self.is_few and self.felt is None and extra is None
        self._all_at_once = self._all_at_once and self.felt is None
        self._programs: dict[int, Program] = {}
        self.in_terms = extra is not None
        self.start, self.coordinates, self.encounter = y0, coordinates, encounter
        self.columns = self.inertia[None]  # what bodies without mass feel is per unit mass
        self._take_extra(extra, params)

    def _take_extra(self, extra: Any, params: Any) -> None:
        """Read the potential of each body about the star, and the values of its names."""
        more = checked_params(params)
        if extra is None:
            if more:
                raise ValueError("`params` are those of `extra`, which is not given: leave them out.")
            return
        self._extra_symbols = dict(zip(("G", "m", *more), numbered("c", ("G", "m", *more)), strict=True))
        names = {**{name: sp.Symbol(name, real=True) for name in PLACE}, **self._extra_symbols}
        if len(names) < len(PLACE) + 2 + len(more):
            taken = next(name for name in more if name in (*PLACE, "G", "m"))
            raise ValueError(f"`params` gives a value to {taken!r}, which `extra` has already: rename it.")
        self.extra = parsed("extra", extra, names, "-3*(G*m/(c*r))**2")
        self._places = [names[name] for name in PLACE]
        for name in more:
            if self._extra_symbols[name] not in self.extra.free_symbols:
                raise ValueError(f"`params` has {name!r}, which `extra` does not use: remove it.")
        if not self.extra.free_symbols & {*self._places}:
            raise ValueError(f"`extra` must depend on {', '.join(PLACE)}, the place of a body; got {self.extra}.")
        self.params = {**self.params, **more}
        self._check_continuous()
        self.extra_program(2)  # refuses functions that are in no table

    def _check_continuous(self) -> None:
        if self.extra is not None:
            values = dict(zip(self._extra_symbols.values(), self.extra_values, strict=True))
            names = {letter: name for name, letter in self._extra_symbols.items()}
            check_continuous("extra", self.extra, self._places, values, names)

    @property
    def extra_values(self) -> list[float]:
        """The numbers that `extra_program` takes after the place."""
        given = {**self.params, "m": float(self.masses[0])}
        return [given[name] for name in self._extra_symbols]

    def extra_program(self, order: int) -> Program:
        """The extra potential of a body at x, y, z from the star, with order 0; its slope, and along vectors that.

        The numbers are x, y, z, those of `extra_values`, and the vectors.
        """
        if order not in self._programs:
            names = [*PLACE[:3], *self._extra_symbols, *(f"{name}{k}" for k in range(1, order) for name in PLACE[:3])]

            def values(*numbers: Any) -> list[Any]:
                x, end = numbers[:3], 3 + len(self._extra_symbols)
                r = apply("sqrt", x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
                known = zip([*self._places, *self._extra_symbols.values()], [*x, r, *numbers[3:end]], strict=True)
                found = [1.0 * evaluator(dict(known))(self.extra)]
                if order:
                    found = gradient(found[0], x)
                for k in range(end, len(numbers), 3):
                    found = tangent(found, x, numbers[k : k + 3])
                return found

            try:
                self._programs[order] = traced(values, *names)
            except NotRecorded as error:
                raise ValueError(f"`extra` cannot be differentiated: {error} Write it with other functions.") from error
        return self._programs[order]

    def _of_extra(self, order: int, *arrays: Array) -> Array:
        """The numbers (..., n − 1, 1 or 3) that its program gives of arrays (..., d), per unit mass of a body."""
        q, *vectors = (self._of_bodies(a) for a in arrays)
        x, *along = (u[..., 1:, :] - u[..., :1, :] for u in (q, *vectors))
        first, *more = ([u[..., k] for k in range(3)] for u in (x, *along))
        flat = [a for vector in more for a in vector]
        found = self.extra_program(order)(*first, *self.extra_values, *flat)
        return stack([a + 0 * x[..., 0] for a in found])

    def _with_extra(self, slopes: Array, *arrays: Array) -> Array:
        """Slopes (..., d) with those of the extra potential, which pulls at the star in turn."""
        if self.extra is None:
            return slopes
        found = self._of_extra(len(arrays), *arrays)
        of_bodies = found * like(self.inertia[1:, None], found)
        of_star = -(found * like(self.masses[1:, None], found)).sum(-2, keepdims=True)
        return slopes + concatenate([of_star, of_bodies], -2).reshape(slopes.shape)

    def identity_parts(self) -> Any:
        return super().identity_parts() + ([] if self.extra is None else [self.extra])

    def _check_masses(self) -> None:
        """Do nothing: bodies may have no mass."""

    @property
    def arrays_only(self) -> str:  # type: ignore[override]
        """The reason why methods of other splittings have no compiled kicks; "" if they have."""
        if self.felt is not None:
            return "bodies without mass"
        few = self.ndof <= MOST_SPELLED and self.n_bodies * (self.n_bodies - 1) // 2 <= MOST_SPELLED_PAIRS
        return "" if self.extra is None or few else "an `extra` potential of many bodies"

    def parameter_values(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        own = [] if self.extra is None else [name for name in self._extra_symbols if name not in ("G", "m")]
        return super().parameter_values(numbers) | {f"{name}_": numbers.get(name, self.params[name]) for name in own}

    def written_potential(
        self,
        q: Sequence[sp.Expr],
        softening: sp.Expr,
        columns: Sequence[Sequence[sp.Expr]],
        c: Mapping[sp.Symbol, sp.Expr],
        box: Sequence[sp.Expr] = (),
    ) -> sp.Expr:
        V = super().written_potential(q, softening, columns, c, box)
        if self.extra is None:
            return V
        own = {letter: sp.Symbol(f"{name}_", real=True) for name, letter in self._extra_symbols.items()}
        own |= {self._extra_symbols["G"]: c[self.c[0]], self._extra_symbols["m"]: columns[0][0]}
        for i in range(1, self.n_bodies):
            x = [q[3 * i + k] - q[k] for k in range(3)]
            put = dict(zip(self._places, (*x, sp.sqrt(sp.Add(*(y**2 for y in x)))), strict=True))
            V += columns[0][i] * self.extra.xreplace({**own, **put})
        return V

    def _ends(self, bodies: Sequence[Array]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        if self.felt is None:
            yield from super()._ends(bodies)
            return
        heavy, light = np.flatnonzero(self.masses > 0), np.flatnonzero(self.masses == 0)
        i, j = np.triu_indices(len(heavy), 1)
        yield heavy[i], heavy[j]
        size = max(1, most_pairs(bodies) // len(heavy))
        for k in range(0, len(light), size):
            some = light[k : k + size]
            yield np.tile(some, len(heavy)), np.repeat(heavy, len(some))

    def _both_ends(self, f: Array, pairs: Pairs) -> tuple[Array, Array]:
        return f, f * like(1.0 * (self.masses[pairs.i] > 0)[:, None], f)

    def potential(self, q: Array) -> Array:
        total: Any = 0 * q[..., 0]
        for pairs in self._pairs(q):
            if (self.masses[pairs.i] > 0).all():
                total = total + pairs.values(0).sum(-1)
        if self.extra is not None:
            V = self._of_extra(0, q)[..., 0]
            total = total + (V * like(self.masses[1:], V)).sum(-1)
        return total

    def potential_gradient(self, q: Array) -> Array:
        return self._with_extra(super().potential_gradient(q), q)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        return self._with_extra(super().hessian_vector(q, v, *t), q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        return self._with_extra(super().third_derivative(q, v, w, *t), q, v, w)

    def energy_density(self, y: Array, *t: Array) -> Array:
        density = super().energy_density(y, *t)
        if self.extra is None:
            return density
        V = self._of_extra(0, y[..., : self.ndof])[..., 0]
        return density + concatenate([0 * V[..., :1], V * like(self.masses[1:], V)])

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
        other.constants = (other.params["G"],)
        return other


def checked_planets(masses: Any, elements: Any, y0: Any, G: Any, units: Any) -> tuple[np.ndarray, float, np.ndarray]:
    """Masses, G and the state y0 that `HamiltonianSystem.planets` is given, tested."""
    G = plain(G)
    if G is not None and units is not None:
        raise ValueError("`units` determine `G`: give only one of them.")
    if G is not None and not (real_number(G) and 0 < G < math.inf):
        raise ValueError(f"`G` must be positive and finite; got {G!r}.")
    G = 1.0 if G is None and units is None else float(G) if units is None else gravity(units)
    masses = checked_column("masses", masses)
    if len(masses) < 2:
        raise ValueError(
            f"`masses` must be those of a star and one planet or more, an array (n,); got shape {masses.shape}."
        )
    if not (masses >= 0).all():
        i = int(np.argmin(masses >= 0))
        raise ValueError(
            f"`masses` must be positive, or 0 for bodies that exert no force; that of body {i} is {masses[i]:g}: "
            "change it."
        )
    if masses[1:].max() >= masses[0]:
        i = 1 + int(np.argmax(masses[1:]))
        raise ValueError(
            f"`masses` must begin with the star, the heaviest body, and that of body {i} is {masses[i]:g}: put it "
            "first, or make the system by HamiltonianSystem.pairs."
        )
    if (elements is None) == (y0 is None):
        raise ValueError("`elements` or `y0` must be given, and not both: the orbits, or the state [q, p].")
    if y0 is None:
        y0 = placed(masses, G, _checked_elements(elements, len(masses) - 1))
    y0 = np.array(to_numpy(y0), dtype=float)
    if y0.shape != (6 * len(masses),) or not np.isfinite(y0).all():
        raise ValueError(f"`y0` must be a finite state [q, p] of shape ({6 * len(masses)},); got shape {y0.shape}.")
    places = y0[: 3 * len(masses)].reshape(-1, 3)
    at_star = (places[1:] == places[0]).all(-1)
    if at_star.any():
        raise ValueError(f"`y0` has body {1 + int(np.argmax(at_star))} at the place of the star: move it from there.")
    return masses, G, y0


def _checked_elements(elements: Any, n: int) -> np.ndarray:
    """Orbital elements (n, 6)."""
    if isinstance(elements, Mapping):
        unknown = [name for name in elements if name not in ELEMENTS]
        if unknown or "a" not in elements:
            what = f"has {unknown[0]!r}" if unknown else "must have 'a'"
            raise ValueError(f"`elements` {what}: the names are {', '.join(ELEMENTS)}; all but a are 0 by default.")
        columns: Any = [elements.get(name, 0.0) for name in ELEMENTS]
    else:
        columns = ()
    try:
        columns = columns or np.moveaxis(np.asarray(elements, dtype=float), -1, 0)
        table = np.stack([np.broadcast_to(np.asarray(x, dtype=float), (n,)) for x in columns], axis=-1)
    except (TypeError, ValueError, IndexError):
        table = np.empty((0, 0))
    if table.shape != (n, 6):
        raise ValueError(
            f"`elements` must give {', '.join(ELEMENTS)} of {n} planets: arrays ({n},) by these names, as in "
            f"{{'a': [...], 'e': [...]}}, or one of shape ({n}, 6)."
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
