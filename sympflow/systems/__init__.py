"""The built-in scenes."""

from collections.abc import Callable

from sympflow.system import HamiltonianSystem
from sympflow.systems.fput import fput, oscillatory_energies
from sympflow.systems.harmonic_oscillator import harmonic_oscillator
from sympflow.systems.henon_heiles import henon_heiles
from sympflow.systems.kepler import kepler, kepler_ellipse
from sympflow.systems.pendulum import pendulum
from sympflow.systems.quartic import quartic
from sympflow.systems.spring_pendulum import spring_pendulum

SYSTEMS: dict[str, Callable[..., HamiltonianSystem]] = {
    "harmonic-oscillator": harmonic_oscillator,
    "henon-heiles": henon_heiles,
    "pendulum": pendulum,
    "kepler": kepler,
    "quartic": quartic,
    "fput": fput,
    "spring-pendulum": spring_pendulum,
}
"""The scenes by the name that the command line uses."""

__all__ = ["SYSTEMS", "kepler_ellipse", "oscillatory_energies", *(factory.__name__ for factory in SYSTEMS.values())]  # noqa: PLE0604
