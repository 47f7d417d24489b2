"""The built-in scenes."""

from collections.abc import Callable

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.systems.celestial import kepler, kepler_ellipse, outer_solar_system, three_body
from sympflow.systems.chains import fput, lax_eigenvalues, lennard_jones, oscillatory_energies, toda_lattice
from sympflow.systems.textbook import (
    double_well,
    harmonic_oscillator,
    henon_heiles,
    henon_heiles_escape,
    nonseparable,
    pendulum,
    pendulum_separatrix,
    quartic,
    spring_pendulum,
)

SYSTEMS: dict[str, Callable[..., HamiltonianSystem]] = {
    "harmonic-oscillator": harmonic_oscillator,
    "henon-heiles": henon_heiles,
    "henon-heiles-escape": henon_heiles_escape,
    "pendulum": pendulum,
    "pendulum-separatrix": pendulum_separatrix,
    "double-well": double_well,
    "quartic": quartic,
    "kepler": kepler,
    "three-body": three_body,
    "outer-solar-system": outer_solar_system,
    "fput": fput,
    "spring-pendulum": spring_pendulum,
    "toda-lattice": toda_lattice,
    "lennard-jones": lennard_jones,
    "nonseparable": nonseparable,
}
"""The scenes by the name that the command line uses."""

__all__ = ["SYSTEMS", "kepler_ellipse", "lax_eigenvalues", "oscillatory_energies"]
__all__ += [factory.__name__ for factory in SYSTEMS.values()]
