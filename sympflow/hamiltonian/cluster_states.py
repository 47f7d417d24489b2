"""States of clusters of bodies at an energy for each body: a domain that is the same for any number of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.hamiltonian.local_states import LocalStates, Rest

if TYPE_CHECKING:
    from sympflow.hamiltonian.hamiltonian import Hamiltonian


@dataclass(frozen=True)
class ClusterStates(LocalStates):
    """The states that bodies in pairs take near a minimum of their potential, whatever their number.

    They are those of a cluster that the pair potential holds together, in the minimum of V next to a ball of a
    close packing. States are drawn as in thermal equilibrium: the energy from a gamma
    distribution, positions and momenta at random, then relaxed by the cluster's own motion; the center of mass rests.

    A state belongs to the set if neither H for each body above the minimum nor the energy of any single body, its
    kinetic one and that of the pairs that press it, is more than 8 times the upper density.

    Parameters
    ----------
    density : float or (float, float)
        H for each body above that of the cluster at rest; two bounds, for densities that are drawn between them.
    system : Hamiltonian, optional
        The bodies. A `HamiltonianSystem` puts itself in.

    Examples
    --------
    >>> argon = HamiltonianSystem.pairs(
    ...     "4*(r**-12 - r**-6)", masses=np.ones(55), domain=sympflow.ClusterStates(0.1)
    ... )
    """

    @classmethod
    def checked(cls, system: Hamiltonian) -> Any:
        if system.local is None or system.local.shape or not system.local.has_piece:
            raise ValueError(
                f"`domain` ClusterStates is of like bodies in pairs that their potential holds together, without a "
                f"box, and the system {system.name!r} is none: take a sympflow.Box."
            )
        return system.local

    @classmethod
    def rest_of(cls, system: Hamiltonian, near: np.ndarray | None = None) -> Rest:
        cluster = cls.checked(system)
        positions = cluster.minimum(None if near is None else near[: cluster.ndof])
        energy = float(system.potential(positions))
        return _ClusterAtRest(system, cluster.n_bodies, positions[None], True, energy)


@dataclass(frozen=True)
class _ClusterAtRest(Rest):
    """A cluster in a minimum of V."""

    energy: float

    def densities(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local: Any = self.system.local
        means = (self.system.hamiltonian(x) - self.energy) / self.parts
        return means, np.maximum(means, local.pressed_energy(x).max(-1))

    def mean(self, v: np.ndarray) -> np.ndarray:
        bodies = v.reshape(len(v), self.parts, -1)
        return np.broadcast_to(bodies.mean(1, keepdims=True), bodies.shape).reshape(v.shape)
