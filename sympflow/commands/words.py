"""The words of a command line: scenes with parameters, methods with options, states; and options of many commands."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.registry import build
from sympflow.systems import SYSTEMS, harmonic_oscillator
from sympflow.systems import available as available_systems
from sympflow.systems import get as system_named

Systems = Annotated[
    list[str],
    typer.Argument(metavar="SYSTEM...", help="See `sympflow systems`; parameters as --omega 100 or name:omega=100."),
]
TEnd = Annotated[float | None, typer.Option(help="End of the interval, which starts at 0. Default: the system's.")]
State = Annotated[str | None, typer.Option("--y0", help="Initial state q,p: 0.3,-0.3,0.3,0.15. Default: the system's.")]
Step = Annotated[float | None, typer.Option(help="Step of fixed-step methods. Default: the system's, the flow's Δt.")]
Backend = Annotated[str, typer.Option(help="auto, compiled or array.")]


def _stiff_oscillator(omega: float = 100.0) -> HamiltonianSystem:
    """The harmonic oscillator at ω = 100."""
    return harmonic_oscillator(omega)


_ALIASES: dict[str, Callable[..., HamiltonianSystem]] = {"stiff-oscillator": _stiff_oscillator}
"""The scenes that only the command line has."""


def scene_names() -> list[str]:
    """The names of all scenes, those of installed plug-ins among them; none is imported."""
    return list(dict.fromkeys([*SYSTEMS, *_ALIASES, *available_systems()]))


def factory_of(scene: str) -> Callable[..., HamiltonianSystem]:
    """The function that makes a scene."""
    return _ALIASES[scene] if scene in _ALIASES else system_named(scene)


def made(scene: str, **params: Any) -> HamiltonianSystem:
    """The system of a scene; one of a plug-in may fail.

    Raises
    ------
    ImportError
        If a plug-in's cannot be loaded or makes something else.
    """
    system = factory_of(scene)(**params)
    if not isinstance(system, HamiltonianSystem):
        what = type(system).__name__
        raise ImportError(f"`system` {scene!r} makes no HamiltonianSystem but a {what}: report it where it is from.")
    return system


@dataclass(frozen=True)
class Scene:
    """A system as asked for: its key (which names its files), and where it should end, if that was said."""

    key: str
    system: HamiltonianSystem
    t_end: float | None = None


def parameters(scene: str) -> dict[str, Any]:
    """Parameters of a scene with their default values."""
    return {name: p.default for name, p in inspect.signature(factory_of(scene)).parameters.items()}


def scenes(words: Sequence[str]) -> list[Scene]:
    """Scenes from words such as ``henon-heiles``, ``harmonic-oscillator:omega=10:t_end=5`` and ``--omega 100``.

    A parameter behind two dashes holds for every scene that has it.

    Raises
    ------
    ValueError
        For a scene or a parameter that does not exist.
    """
    names, shared = _split(words)
    if not names:
        raise ValueError(f"`system` is missing: name one or more of {', '.join(scene_names())}.")
    found = [_scene(name, shared) for name in names]
    known = {p for name in names for p in parameters(_key(name))}
    for name in shared:
        if name not in known:
            takes = f"its parameters are {', '.join(sorted(known))}" if known else "it has no parameters"
            raise ValueError(f"`--{name}` is no option, nor a parameter of {', '.join(names)} ({takes}): see --help.")
    return found


def shown(value: Any) -> str:
    """A parameter's value as it is written on a command line."""
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def one_scene(words: Sequence[str]) -> Scene:
    """The scene of a command that takes one system."""
    found = scenes(words)
    if len(found) != 1:
        raise ValueError(f"`system` must be one; got {', '.join(s.key for s in found)}.")
    return found[0]


def interval(scene: Scene, t_end: float | None) -> tuple[float, float]:
    """From the scene's start to the end asked for: with the scene, by --t-end, or its own."""
    start, end = scene.system.t_span
    return start, scene.t_end if scene.t_end is not None else t_end if t_end is not None else end


def _split(words: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Names, and the parameters given as --name value or --name=value."""
    names: list[str] = []
    shared: dict[str, str] = {}
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("--"):
            names.append(word)
            continue
        name, equals, value = word[2:].partition("=")
        if not equals:
            if not rest:
                raise ValueError(f"`--{name}` is no option, or lacks its value: see --help.")
            value = rest.pop(0)
        shared[name] = value
    return names, shared


def _key(word: str) -> str:
    """The scene's name in a word such as ``henon-heiles:t_end=5``; `henon_heiles` is the same, as in Python."""
    return word.partition(":")[0].replace("_", "-")


def _scene(word: str, shared: dict[str, str]) -> Scene:
    _, *pairs = word.split(":")
    name = _key(word)
    if name not in scene_names():
        close = difflib.get_close_matches(name, scene_names(), n=1)
        hint = f"Did you mean {close[0]!r}? " if close else ""
        raise ValueError(f"`system` {name!r} is unknown. {hint}Choose from {', '.join(scene_names())}.")
    own = dict(_pairs(pairs))
    t_end = _float("t_end", own.pop("t_end")) if "t_end" in own else None
    known = parameters(name)
    unknown = [key for key in own if key not in known]
    if unknown:
        raise ValueError(f"`{unknown[0]}` is not a parameter of {name}, which takes {', '.join((*known, 't_end'))}.")
    asked = {f"--{key}": value for key, value in shared.items() if key in known and key not in own} | own
    params = {
        key.lstrip("-"): value if isinstance(known[key.lstrip("-")], str) else _float(key, value)
        for key, value in asked.items()
    }
    key = "-".join([name, *(f"{k}={shown(v)}" for k, v in params.items())])
    return Scene(key, made(name, **params), t_end)


def methods(words: str) -> list[Any]:
    """Methods from a list such as ``verlet,rk45:rtol=1e-8,flow.safetensors``, for `compare`.

    Raises
    ------
    ValueError, TypeError
        For an unknown method or option.
    """
    entries = [word.strip() for word in words.split(",") if word.strip()]
    if not entries:
        raise ValueError("`--methods` is empty: give names separated by commas, such as verlet,rk45.")
    return [method(word) for word in entries]


def method(word: str) -> Any:
    """One method: a name, with options or without, such as ``sympflow:flow=pendulum-sympflow``, or a flow's file."""
    if word.endswith(".safetensors"):
        from sympflow.flow.files import load

        return Path(word).stem, load(word)
    name, *pairs = word.split(":")
    options = {key: value if key == "flow" else _float(key, value) for key, value in _pairs(pairs)}
    return (word, build(name, options)) if options else name


def _pairs(words: Sequence[str]) -> list[tuple[str, str]]:
    pairs = [word.partition("=") for word in words]
    for key, equals, value in pairs:
        if not (key and equals and value):
            raise ValueError(f"`{key}` needs a value: write name:{key or 'option'}=number.")
    return [(key, value) for key, _, value in pairs]


def state(words: str | None) -> np.ndarray | None:
    """A state from ``0.3,-0.3,0.3,0.15``."""
    if words is None:
        return None
    return np.array([_float("--y0", word) for word in words.split(",")])


def widths(words: str) -> tuple[int, ...]:
    """Layer widths from ``10,10``."""
    try:
        return tuple(int(word) for word in words.split(","))
    except ValueError as error:
        raise ValueError(f"`--hidden` must be whole numbers separated by commas; got {words!r}.") from error


def _float(name: str, word: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise ValueError(f"`{name}` must be a number; got {word!r}.") from error
