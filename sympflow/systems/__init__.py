"""The scenes by name: built in, registered at run time, or from installed plug-ins."""

import inspect
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

from sympflow.arguments import did_you_mean, told
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.lazy import announced, distribution, load_announced
from sympflow.systems.celestial import (
    decaying_orbit,
    kepler,
    kepler_ellipse,
    outer_solar_system,
    perihelion_angle,
    schwarzschild,
    three_body,
)
from sympflow.systems.chains import fput, lax_eigenvalues, lennard_jones, oscillatory_energies, toda_lattice
from sympflow.systems.driven import driven_pendulum, duffing, fodo_cell, fodo_matrices, kicked, paul_trap
from sympflow.systems.planets import solar_system
from sympflow.systems.textbook import (
    charged_particle,
    damped_oscillator,
    damped_pendulum,
    double_pendulum,
    double_well,
    harmonic_oscillator,
    henon_heiles,
    henon_heiles_escape,
    magnetic_moment,
    nonseparable,
    pendulum,
    pendulum_separatrix,
    quartic,
    spring_pendulum,
)
from sympflow.systems.user_files import from_toml
from sympflow.systems.waves import fput_beta, grid, nonlinear_schroedinger, phi4, sine_gordon, toda_chain, wave_equation

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "sympflow.systems"
"""The entry-point group in which a distribution announces its systems: `name = "package.module:factory"`."""

_BUILT_IN: tuple[Callable[..., HamiltonianSystem], ...] = (
    *(harmonic_oscillator, henon_heiles, henon_heiles_escape, pendulum, pendulum_separatrix, double_well),
    *(quartic, kepler, three_body, outer_solar_system, solar_system, fput, spring_pendulum, toda_lattice),
    *(lennard_jones, nonseparable, double_pendulum, schwarzschild, charged_particle, damped_oscillator),
    *(damped_pendulum, decaying_orbit, driven_pendulum, paul_trap, duffing, fodo_cell, kicked, wave_equation),
    *(sine_gordon, phi4, nonlinear_schroedinger, toda_chain, fput_beta),
)
SYSTEMS = {f.__name__.replace("_", "-"): f for f in _BUILT_IN}
"""The built-in scenes by the names that the command line uses."""

_registered: dict[str, Callable[..., HamiltonianSystem]] = {}


def available() -> list[str]:
    """The names of all scenes: built in, registered, and from plug-ins. Nothing is imported to list them."""
    return [*SYSTEMS, *_registered, *sorted(_plugins())]


def get(name: str) -> Callable[..., HamiltonianSystem]:
    """The function that makes the system of a name; call it with its parameters: ``get("fput")(omega=100)``.

    Parameters
    ----------
    name : str
        With hyphens or underscores.

    Raises
    ------
    ValueError
        If there is no such scene.
    ImportError
        If the plug-in that provides it cannot be loaded.
    """
    if not isinstance(name, str):
        raise TypeError(f"`name` must be that of a scene, such as 'henon-heiles'; got {type(name).__name__}.")
    key = _key(name)
    if key in SYSTEMS:
        return SYSTEMS[key]
    if key in _registered:
        return _registered[key]
    if key in _plugins():
        return _load(key, _plugins()[key])
    hint = did_you_mean(key, available())
    raise ValueError(f"`name` {name!r} is not a known scene.{hint} Choose one of {', '.join(available())}.")


def register(name: str, factory: Callable[..., HamiltonianSystem]) -> None:
    """Make a scene available under a name, on the command line's lists too, in this process.

    Parameters
    ----------
    name : str
        With hyphens or underscores.
    factory : callable
        Makes the system; all its parameters have defaults.

    Raises
    ------
    ValueError
        If the name is empty, or that of a built-in scene or of an installed plug-in.
    TypeError
        If `name` is not a string, or `factory` cannot be called without arguments.
    """
    if not isinstance(name, str):
        raise TypeError(f"`name` must be a string, such as 'my-scene'; got {type(name).__name__}.")
    key = _key(name)
    if not key.strip() or set(key) & set(":=, "):
        raise ValueError(f"`name` must be a word without spaces or any of : = ,; got {name!r}. Choose another one.")
    if key in SYSTEMS:
        raise ValueError(f"`name` {name!r} is a built-in scene, which cannot be replaced: choose another name.")
    if key in _plugins():
        raise ValueError(
            f"`name` {name!r} belongs to the plug-in {distribution(_plugins()[key])}, which would be replaced: choose "
            "another name."
        )
    if isinstance(factory, HamiltonianSystem) or not _makes_a_default(factory):
        raise TypeError(
            f"`factory` must be a function that makes the system, with a default for every parameter; got {factory!r}."
        )
    _registered[key] = factory


@cache
def _plugins() -> dict[str, "EntryPoint"]:
    taken = {*SYSTEMS, *(name.replace("-", "_") for name in SYSTEMS)}
    return {_key(name): point for name, point in announced(GROUP, "system", taken).items()}


@cache
def _load(key: str, point: "EntryPoint") -> Callable[..., HamiltonianSystem]:
    factory = load_announced(point, "system")
    if isinstance(factory, HamiltonianSystem) or not _makes_a_default(factory):
        raise ImportError(
            f"`system` {key!r} of the plug-in {distribution(point)} is not a function with a default for every "
            "parameter: report this to its author."
        )
    return factory


def _makes_a_default(factory: Any) -> bool:
    """True for a callable that needs no arguments."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return False
    return not any(p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters)


def _key(name: str) -> str:
    return name.replace("_", "-")


__all__ = ["SYSTEMS", "available", "from_toml", "get", "register"]
__all__ += ["fodo_matrices", "grid", "kepler_ellipse", "lax_eigenvalues", "magnetic_moment", "oscillatory_energies"]
__all__ += ["perihelion_angle"]
__all__ += [factory.__name__ for factory in SYSTEMS.values()]


def __dir__() -> list[str]:
    return sorted(__all__)


for _key_of, _factory in SYSTEMS.items():
    SYSTEMS[_key_of] = globals()[_factory.__name__] = told(_factory)
    SYSTEMS[_key_of].__module__ = __name__  # where pickles find it


def __getattr__(name: str) -> Any:
    hint = did_you_mean(name, [key.replace("-", "_") for key in SYSTEMS], 0.5)
    raise AttributeError(f"module 'sympflow.systems' has no attribute {name!r}.{hint}")
