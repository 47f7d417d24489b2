"""The built-in scenes."""

from collections.abc import Callable

from sympflow.system import HamiltonianSystem
from sympflow.systems.double_well import double_well
from sympflow.systems.fput import fput, oscillatory_energies
from sympflow.systems.harmonic_oscillator import harmonic_oscillator
from sympflow.systems.henon_heiles import henon_heiles, henon_heiles_escape
from sympflow.systems.kepler import kepler, kepler_ellipse
from sympflow.systems.lennard_jones import lennard_jones
from sympflow.systems.nonseparable import nonseparable
from sympflow.systems.outer_solar_system import outer_solar_system
from sympflow.systems.pendulum import pendulum, pendulum_separatrix
from sympflow.systems.quartic import quartic
from sympflow.systems.spring_pendulum import spring_pendulum
from sympflow.systems.three_body import three_body
from sympflow.systems.toda import lax_eigenvalues, toda_lattice

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
