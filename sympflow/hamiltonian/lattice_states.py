"""States of lattices at an energy density: a domain that is the same for every size of the lattice."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sympflow.arguments import checked_states, real_number, sample_count
from sympflow.arrays import Array

if TYPE_CHECKING:
    from sympflow.hamiltonian.hamiltonian import Hamiltonian

SPREAD, CALM = 8.0, 2.0
"""Factor by which the density of the densest few neighbours may exceed the upper one, and fall below the lower one; and
the factor in a calm system, where no density is known but theirs."""
RELAXED, PHASE = 60, 0.3
"""Verlet steps by which drawn states are relaxed, and their length times the fastest frequency."""
HALVINGS, SCALES, POWERS = 60, 400, 12
DRAWN = 200
"""States of another domain from which densities are taken."""
SHARE = 0.05
"""Share of these that is left out at either end."""


@dataclass(frozen=True)
class LatticeStates:
    """The states that a lattice takes at an energy density, whatever its size.

    A state is drawn as in thermal equilibrium: its energy from a gamma distribution, as that of as many oscillators at
    one temperature, positions and momenta at random, then relaxed by the lattice's own dynamics. So the few sites have
    the same distribution of states as a few neighbours in a large lattice.

    Take blocks of as many neighbours as `HamiltonianSystem.subsystem` has sites. A state belongs to the set if the
    densest block has at most 8 times the upper density and at least an eighth of the lower one. So a single wave in a
    lattice at rest is judged by its own energy.

    Parameters
    ----------
    density : float or (float, float)
        H per site above that of the lattice at rest; or two bounds, between which densities are drawn.
    system : Hamiltonian, optional
        The lattice. A `HamiltonianSystem` sets it to itself.

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
                f"`density` must be positive, the energy of a site above rest, or two such bounds, low ≤ high; "
                f"got {given!r}."
            )
        object.__setattr__(self, "density", (float(bounds[0]), float(bounds[1])))

    @classmethod
    def rest_of(cls, system: Hamiltonian, near: np.ndarray | None = None) -> Rest:
        lattice = cls.checked(system)
        positions = np.stack([np.repeat(well, lattice.sites) for well in lattice.wells()])
        energy = system.energy_density(np.concatenate([positions[0], np.zeros(lattice.ndof)]))
        block = tuple(min(n, m) for n, m in zip(lattice.shape, lattice.few(), strict=True))
        return Rest(system, lattice.sites, positions, lattice.moves, energy, block)

    @property
    def bounds(self) -> tuple[float, float]:
        """The lower and the upper density."""
        low, high = self.density  # type: ignore[misc]
        return low, high

    @classmethod
    def of_states(cls, system: Hamiltonian, states: np.ndarray) -> Self:
        """The set to which states (..., 2d) belong; a ValueError if their energy is not above that at rest."""
        states = states.reshape(-1, 2 * system.ndof)
        means, blocks = cls.rest_of(system, states[0]).densities(states)
        low = float(np.quantile(means, SHARE, method="lower"))
        high = max(float(np.quantile(means, 1 - SHARE, method="higher")), float(np.median(blocks)) / CALM)
        if not 0 < low <= high < math.inf:
            raise ValueError(
                f"`y0` has an energy density of {low:.3g} above that of the system at rest, from which no states "
                f"follow: pass `domain`, sympflow.{cls.__name__}(density)."
            )
        return cls((low, high), system)

    def of(self, system: Hamiltonian) -> Self:
        """The same set for a system, unchanged for one of the same shape; a ValueError if it is not a lattice."""
        if self.system is not None and system.symbols is not None and system.ndof == self.system.ndof:
            return self
        other = self.checked(system)
        if self.system is not None:
            mine: Any = self.system.local
            if mine is other or all(getattr(mine, n) == getattr(other, n) for n in ("shape", "ends", "terms", "ndof")):
                return self
        return replace(self, system=system)

    @classmethod
    def checked(cls, system: Hamiltonian) -> Any:
        if system.local is None or not system.local.shape:
            raise ValueError(
                f"`domain` LatticeStates is for lattices, and {system.name!r} is not one: take a sympflow.Box."
            )
        return system.local

    @cached_property
    def _rest(self) -> Rest:
        if self.system is None:
            raise ValueError(
                f"`system` is not known to these {type(self).__name__}: pass them to the system as its `domain`."
            )
        return self.rest_of(self.system)

    @property
    def width(self) -> int | None:
        """The length of its states; None without a system, for any length."""
        return None if self.system is None else 2 * self.system.ndof

    @property
    def at_rest(self) -> np.ndarray:
        """The system at rest: (2d,)."""
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
        room = slack / rest.parts
        inside = (blocks >= low / SPREAD - room) & (blocks <= SPREAD * high + room)
        return inside.reshape(x.shape[:-1])

    def to_dict(self) -> dict[str, Any]:
        return {"kind": type(self).__name__, "density": list(self.bounds)}


@dataclass(frozen=True)
class Rest:
    """A lattice at rest, all sites in one of the wells, and random states about it."""

    system: Hamiltonian
    parts: int  # sites
    positions: np.ndarray  # (n, d), at rest, n of them that are as good
    moves: bool  # nothing holds the lattice at its place, so that the sum of the momenta is left out
    energy: np.ndarray  # of each site, that of its bonds among it
    block: tuple[int, ...]  # sites along each axis of which densities are taken together

    @property
    def state(self) -> np.ndarray:
        """The first of the positions, with momenta of 0: (2d,)."""
        return np.concatenate([self.positions[0], np.zeros(self.system.ndof)])

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

    def mean(self, v: np.ndarray) -> np.ndarray:
        fields = v.reshape(len(v), -1, self.parts)
        return np.broadcast_to(fields.mean(-1, keepdims=True), fields.shape).reshape(v.shape)

    def drawn(self, n: int, bounds: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
        """States (n, 2d); some may be far beyond the bounds, or not finite."""
        system, d = self.system, self.system.ndof
        energy = self.parts * rng.uniform(*bounds, n) * rng.gamma(d, 1 / d, n)
        rest = self.positions[rng.integers(len(self.positions), size=n)]
        away, p = rng.standard_normal((2, n, d))
        if self.moves:
            away, p = (v - self.mean(v) for v in (away, p))
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
        """States after a while of the system's own motion."""
        system = self.system
        v = np.ones_like(q) * (-1.0) ** np.arange(q.shape[1]) + 0.1 * p / np.abs(p).max(-1, keepdims=True)
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


def _scaled(energy: Callable[[np.ndarray], np.ndarray], target: np.ndarray) -> np.ndarray:
    """The smallest scales s (n, 1) at which an energy that rises from 0 has the values (n,)."""
    low, high = np.zeros((len(target), 1)), np.full((len(target), 1), 1e-3)
    for _ in range(SCALES):
        above = energy(high / 2) >= target
        if not above.any():
            break
        high = np.where(above[:, None], high / 2, high)
    for _ in range(SCALES):
        below = energy(high) < target
        if not below.any():
            break
        low, high = np.where(below[:, None], high, low), np.where(below[:, None], 1.2 * high, high)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        below = (energy(middle) < target)[:, None]
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high
