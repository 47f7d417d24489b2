"""States of lattices at an energy density: a domain that is the same for every size of the lattice."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arguments import checked_states, real_number, sample_count
from sympflow.arrays import Array

if TYPE_CHECKING:
    from sympflow.hamiltonian.hamiltonian import Hamiltonian

SPREAD, CALM = 8.0, 2.0
"""How many times the density of the densest few neighbours may exceed the upper one, and fall below the lower one; and
how many times it does in a calm lattice, where no density is known but theirs."""
RELAXED, PHASE = 60, 0.3
"""Verlet steps by which drawn states are relaxed, and their length times the fastest frequency."""
HALVINGS, POWERS = 60, 12
DRAWN = 200
"""States of another domain from which densities are taken."""
SHARE = 0.05
"""Share of these that is left out at either end."""


@dataclass(frozen=True)
class LatticeStates:
    """The states that a lattice takes at an energy density, whatever its size.

    A state is drawn as in thermal equilibrium: its energy from a gamma distribution, as that of as many oscillators at
    one temperature, positions and momenta at random, then relaxed by the lattice's own dynamics. So a few sites are as
    often as far from rest as any few neighbours in a large lattice are.

    A state belongs to the set if the densest block of as many neighbours as `HamiltonianSystem.piece` has by default
    has at most 8 times the upper density, and at least an eighth of the lower one: so a wave alone in a lattice at rest
    is judged by itself.

    Parameters
    ----------
    density : float or (float, float)
        H per site above that of the lattice at rest; two bounds, for densities that are drawn between them.
    system : Hamiltonian, optional
        The lattice. A `HamiltonianSystem` puts itself in.

    Examples
    --------
    >>> ring = HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=64, domain=sympflow.LatticeStates(0.2))
    """

    density: float | tuple[float, float]
    system: Hamiltonian | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        given = self.density
        bounds = tuple(given) if isinstance(given, tuple | list | np.ndarray) else (given, given)
        if len(bounds) != 2 or not all(real_number(x) and 0 < x < math.inf for x in bounds) or bounds[0] > bounds[1]:
            raise ValueError(
                f"`density` must be positive, the energy of a site above rest, or two such bounds, low ≤ high; got "
                f"{given!r}."
            )
        object.__setattr__(self, "density", (float(bounds[0]), float(bounds[1])))

    @property
    def bounds(self) -> tuple[float, float]:
        """The lower and the upper density."""
        low, high = self.density  # type: ignore[misc]
        return low, high

    @classmethod
    def of_states(cls, system: Hamiltonian, states: np.ndarray) -> LatticeStates:
        """The set that states (..., 2d) of a lattice are of: their densities, and those of their densest blocks.

        Raises
        ------
        ValueError
            If they have no energy above that of the lattice at rest.
        """
        rest = _Rest.of(system)
        means, blocks = rest.densities(states.reshape(-1, 2 * system.ndof))
        low = float(np.quantile(means, SHARE, method="lower"))
        high = max(float(np.quantile(means, 1 - SHARE, method="higher")), float(np.median(blocks)) / CALM)
        if not 0 < low <= high < math.inf:
            raise ValueError(
                f"`y0` has an energy density of {low:.3g} above that of the lattice at rest, from which no states "
                "follow: pass `domain`, sympflow.LatticeStates(density)."
            )
        return cls((low, high), system)

    def of(self, system: Hamiltonian) -> LatticeStates:
        """The same set, of a lattice: itself where it is of one of that shape already, or of that by its coordinates.

        Raises
        ------
        ValueError
            If the system is none.
        """
        if self.system is not None and system.symbols is not None and system.ndof == self.system.ndof:
            return self
        lattice = _Rest.check(system)
        if self.system is not None:
            mine: Any = self.system.local
            if mine is lattice or (mine.shape, mine.boundary, mine.terms) == (
                lattice.shape,
                lattice.boundary,
                lattice.terms,
            ):
                return self
        return replace(self, system=system)

    @cached_property
    def _rest(self) -> _Rest:
        if self.system is None:
            raise ValueError(
                "`system` is not known to these LatticeStates: pass them to HamiltonianSystem.lattice as its `domain`."
            )
        return _Rest.of(self.system)

    @property
    def width(self) -> int | None:
        """The length of its states; None without a lattice, for any."""
        return None if self.system is None else 2 * self.system.ndof

    @property
    def at_rest(self) -> np.ndarray:
        """The lattice at rest: (2d,)."""
        return self._rest.state

    def sample(self, n: int, seed: int = 0) -> np.ndarray:
        n, rest, rng = sample_count(n), self._rest, np.random.default_rng(seed)
        accepted: list[np.ndarray] = []
        found = tried = 0
        while found < n:
            x = rest.drawn(n - found, self.bounds, rng)
            x = x[self.contains(x)]
            accepted.append(x)
            found, tried = found + len(x), tried + 1
            if tried > 20 and found < n / 100:
                raise ValueError(
                    f"`density` {self.bounds} is one at which no states were found: they are not bound, or H is not "
                    "finite there. Take a lower one."
                )
        return np.concatenate(accepted)

    def contains(self, x: Array, slack: float = 0.0) -> np.ndarray:
        rest, (low, high) = self._rest, self.bounds
        x = checked_states(x, 2 * rest.system.ndof)
        with np.errstate(all="ignore"):
            _, blocks = rest.densities(x.reshape(-1, x.shape[-1]).astype(float))
        room = slack / rest.sites
        inside = (blocks >= low / SPREAD - room) & (blocks <= SPREAD * high + room)
        return inside.reshape(x.shape[:-1])

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "LatticeStates", "density": list(self.bounds)}


@dataclass(frozen=True)
class _Rest:
    """A lattice at rest: its energy, and what is drawn about it.

    Attributes
    ----------
    system : Hamiltonian
    sites : int
    positions : list of ndarray (F,)
        The values of the fields of a site at rest, of all wells that are as deep.
    state : ndarray (2d,)
        The lattice in the first of these wells.
    energy : ndarray
        Of each site, that of its bonds among it.
    block : tuple of int
        Sites along each axis of which densities are taken together.
    moves : bool
        True if nothing holds the lattice at its place, so that the sum of the momenta is left out.
    """

    system: Hamiltonian
    sites: int
    positions: list[np.ndarray]
    state: np.ndarray
    energy: np.ndarray
    block: tuple[int, ...]
    moves: bool

    @staticmethod
    def check(system: Hamiltonian) -> Any:
        """The definition of a lattice.

        Raises
        ------
        ValueError
            If the system is none.
        """
        if system.local is None or not system.local.shape:
            raise ValueError(
                f"`domain` LatticeStates is of lattices, and the system {system.name!r} is none: take a sympflow.Box."
            )
        return system.local

    @classmethod
    def of(cls, system: Hamiltonian) -> _Rest:
        lattice = cls.check(system)
        positions = lattice.wells()
        still = np.concatenate([np.repeat(positions[0], lattice.sites), np.zeros(lattice.ndof)])
        block = tuple(min(n, m) for n, m in zip(lattice.shape, lattice.few(), strict=True))
        return cls(system, lattice.sites, positions, still, system.energy_density(still), block, lattice.moves)

    def densities(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energies of states (n, 2d) above rest, per site: of the whole lattice, and of the densest block (n,)."""
        above = self.system.energy_density(x) - self.energy
        axes = tuple(range(1, above.ndim))
        means = above.mean(axes)
        for axis, size in zip(axes, self.block, strict=True):
            total = np.cumsum(above, axis=axis)
            n = above.shape[axis]
            ends = np.take(total, range(size - 1, n), axis)
            starts = np.take(total, range(n - size), axis)
            ends[(slice(None),) * axis + (slice(1, None),)] -= starts
            above = ends / size
        return means, above.max(axes)

    def drawn(self, n: int, bounds: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
        """States (n, 2d), of which some may be far beyond the bounds, or not finite."""
        system, d = self.system, self.system.ndof
        energy = self.sites * rng.uniform(*bounds, n) * rng.gamma(d, 1 / d, n)
        rest = np.stack([np.repeat(each, self.sites) for each in self.positions])[
            rng.integers(len(self.positions), size=n)
        ]
        away, p = rng.standard_normal((2, n, d))
        if self.moves:
            away, p = (v - _mean(v, self.sites) for v in (away, p))
        if system.inverse_mass is not None:
            p = p / np.sqrt(np.abs(system.inverse_mass))
        with np.errstate(all="ignore"):
            still = system.kinetic(0 * p[0])
            q = rest + _scaled(lambda s: system.potential(rest + s * away) - system.potential(rest), energy / 2) * away
            p = _scaled(lambda s: system.kinetic(s * p) - still, energy / 2) * p
            q, p = self._relaxed(q, p)
            left = energy - (system.potential(q) - system.potential(rest))
            p = _scaled(lambda s: system.kinetic(s * p) - still, left) * p
        return np.concatenate([q, p], axis=-1)

    def _relaxed(self, q: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States after a while of the lattice's own motion."""
        system = self.system
        v = np.ones_like(q) * (-1.0) ** np.arange(q.shape[1]) + 0.1 * p
        square = np.ones((len(q), 1))
        for _ in range(POWERS):
            v = system.velocity(system.hessian_vector(q, v / np.linalg.norm(v, axis=-1, keepdims=True)))
            square = np.linalg.norm(v, axis=-1, keepdims=True)
        h = PHASE / np.sqrt(square)
        F = system.force(q)
        for _ in range(RELAXED):
            p = p + h / 2 * F
            q = q + h * system.velocity(p)
            F = system.force(q)
            p = p + h / 2 * F
        return q, p


def _mean(v: np.ndarray, sites: int) -> np.ndarray:
    """The mean of each field over the sites, at each of them."""
    fields = v.reshape(len(v), -1, sites)
    return np.broadcast_to(fields.mean(-1, keepdims=True), fields.shape).reshape(v.shape)


def _scaled(energy: Callable[[np.ndarray], np.ndarray], target: np.ndarray) -> np.ndarray:
    """The smallest scales s (n, 1) at which an energy that rises from 0 has the values (n,)."""
    low, high = np.zeros((len(target), 1)), np.full((len(target), 1), 1e-3)
    for _ in range(HALVINGS):
        below = energy(high) < target
        if not below.any():
            break
        low, high = np.where(below[:, None], high, low), np.where(below[:, None], 1.2 * high, high)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        below = (energy(middle) < target)[:, None]
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high
