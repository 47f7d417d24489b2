"""The built-in scenes."""

from collections.abc import Callable

from sympflow.system import HamiltonianSystem
from sympflow.systems.harmonic_oscillator import harmonic_oscillator
from sympflow.systems.henon_heiles import henon_heiles
from sympflow.systems.pendulum import pendulum

SYSTEMS: dict[str, Callable[..., HamiltonianSystem]] = {
    "harmonic-oscillator": harmonic_oscillator,
    "henon-heiles": henon_heiles,
    "pendulum": pendulum,
}
"""The scenes by the name that the command line uses."""

__all__ = ["SYSTEMS", "harmonic_oscillator", "henon_heiles", "pendulum"]
