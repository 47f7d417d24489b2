"""States of lattices at an energy density: a domain that is the same for every size of the lattice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.hamiltonian.local_states import LocalStates, Rest

if TYPE_CHECKING:
    from sympflow.hamiltonian.hamiltonian import Hamiltonian


@dataclass(frozen=True)
class LatticeStates(LocalStates):
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

    @classmethod
    def checked(cls, system: Hamiltonian) -> Any:
        if system.local is None or not system.local.shape:
            raise ValueError(
                f"`domain` LatticeStates is of lattices, and the system {system.name!r} is none: take a sympflow.Box."
            )
        return system.local

    @classmethod
    def rest_of(cls, system: Hamiltonian, near: np.ndarray | None = None) -> Rest:
        lattice = cls.checked(system)
        positions = np.stack([np.repeat(well, lattice.sites) for well in lattice.wells()])
        energy = system.energy_density(np.concatenate([positions[0], np.zeros(lattice.ndof)]))
        block = tuple(min(n, m) for n, m in zip(lattice.shape, lattice.few(), strict=True))
        return _LatticeAtRest(system, lattice.sites, positions, lattice.moves, energy, block)


@dataclass(frozen=True)
class _LatticeAtRest(Rest):
    """A lattice at rest, all sites in one of the wells."""

    energy: np.ndarray
    block: tuple[int, ...]

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
