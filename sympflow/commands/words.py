"""The words of a command line: scenes with parameters, methods with options, states; and options of many commands."""

from __future__ import annotations

import difflib
import inspect
import keyword
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, overload

import numpy as np
import typer
from typer import Option

from sympflow.arguments import check_t_span, is_number_word
from sympflow.commands import completion
from sympflow.hamiltonian.expression import FUNCTIONS
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.registry import available as available_methods
from sympflow.integrators.registry import build
from sympflow.systems import SYSTEMS, harmonic_oscillator
from sympflow.systems import available as available_systems
from sympflow.systems import get as system_named
from sympflow.systems.given import FILE
from sympflow.systems.user_files import factory as file_factory

Text = str | None
Number = float | None
Count = int | None
File = Path | None


class Usage(ValueError):
    """An error in a word of the command line; the message quotes it."""


def _systems(incomplete: str) -> list[str]:
    """Names of systems, and files that may hold one, for completion in the shell."""
    return [*completion.of(scene_names())(incomplete), *completion.files(incomplete, (".toml", ".py"))]


Systems = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="SYSTEM",
        help="A name that `sympflow systems` lists, or file.py:name, file.toml, a formula; parameters as --omega 100.",
        show_default=False,
        autocompletion=_systems,
    ),
]
Own = Annotated[
    list[str] | None,
    Option(
        "--system",
        metavar="SYSTEM",
        help="A system, given like the argument; repeat it for several systems.",
        autocompletion=_systems,
    ),
]
OneMethod = Annotated[
    Text,
    Option(
        "--method",
        "--methods",
        help="A name, name:option=value, or a .safetensors file. Default: one that suits the system.",
        autocompletion=completion.one_method,
    ),
]
TStart = Annotated[Number, Option(help="Start of the interval. Default: the system's.")]
TEnd = Annotated[Number, Option(help="End of the interval. Default: the system's.")]
State = Annotated[Text, Option("--y0", help="Initial state q,p: 0.3,-0.3,0.3,0.15. Default: the system's.")]
Step = Annotated[Number, Option(help="Step of fixed-step methods. Default: the system's, the flow's Δt.")]
BACKENDS = ("auto", "compiled", "array")


def _backend(word: str) -> str:
    if word not in BACKENDS:
        raise typer.BadParameter(f"{word!r} is not one of {', '.join(BACKENDS)}.")
    return word


Backend = Annotated[
    str, Option(help="auto, compiled or array.", callback=_backend, autocompletion=completion.of(BACKENDS))
]


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
    """The system of a scene; an ImportError if a plug-in's cannot be loaded or makes something else."""
    system = factory_of(scene)(**params)
    if not isinstance(system, HamiltonianSystem):
        what = type(system).__name__
        raise ImportError(
            f"`system` {scene!r} must make a HamiltonianSystem; it makes a {what}: report this to its author."
        )
    return system


@dataclass(frozen=True)
class NamedSystem:
    """A system as named by the user.

    Attributes
    ----------
    key : str
        Names its files.
    system : HamiltonianSystem
    t_end : float or None
        The end of the run, if given.
    factory : callable
        Makes the system of other parameters.
    params : dict
        The given parameters.
    """

    key: str
    system: HamiltonianSystem
    t_end: float | None
    factory: Callable[..., HamiltonianSystem]
    params: dict[str, Any]


def parameters(scene: str) -> dict[str, Any]:
    """Parameters of a scene with their default values."""
    return _defaults(factory_of(scene))


def _defaults(factory: Callable[..., HamiltonianSystem]) -> dict[str, Any]:
    return {name: p.default for name, p in inspect.signature(factory).parameters.items()}


def scenes(words: Sequence[str] | None, own: Sequence[str] | None = None) -> list[NamedSystem]:
    """Scenes from words such as ``henon-heiles``, ``harmonic-oscillator:omega=10:t_end=5`` and ``--omega 100``.

    A parameter behind two dashes holds for every scene that has it. A scene may be one of a file: ``file.toml``,
    ``file.py:name``. `own` are more of them.

    Raises
    ------
    ValueError
        For a scene or a parameter that does not exist.
    """
    names, shared = _split(words or ())
    names += own or ()
    if not names:
        raise Usage(f"`system` is missing: {SYSTEM}.")
    try:
        parted = [_parted(name) for name in names]
        known = {p for _, factory, _ in parted for p in _defaults(factory)}
        for name in shared:
            if name not in known:
                if name in ("param", "params", "parameter", "parameters") and "=" in shared[name]:
                    raise Usage(f"`--{name}` is not an option: write --{' '.join(shared[name].split('=', 1))}.")
                if name in (*OF_METHODS, "flow"):
                    given = f"{name}={shared[name]}"
                    raise Usage(
                        f"`--{name}` is an option of some methods: give it behind the name, --method NAME:{given}."
                    )
                takes = f"its parameters are {', '.join(sorted(known))}" if known else "it has no parameters"
                option, by_case = name.replace("_", "-"), {p.lower(): p for p in known}
                meant = MEANT.get(name.lower()) or by_case.get(name.lower())
                meant = meant or next(iter(difflib.get_close_matches(name, known, n=1)), "")
                raise Usage(
                    f"`--{option}` is neither an option nor a parameter of {', '.join(names)} ({takes}): "
                    + (f"did you mean --{meant}?" if meant else "see --help.")
                )
        return _told_apart([_scene(name, factory, pairs, shared) for name, factory, pairs in parted])
    except (ValueError, TypeError) as error:  # of what the system is made of, not of an option of the command
        raise Usage(str(error)) from error


def _told_apart(found: list[NamedSystem]) -> list[NamedSystem]:
    """The scenes with keys that differ, so that none overwrites the files of another."""
    keys = [scene.key for scene in found]
    nth = [keys[:i].count(key) + 1 for i, key in enumerate(keys)]
    return [scene if n == 1 else replace(scene, key=f"{scene.key}-{n}") for scene, n in zip(found, nth, strict=True)]


def shown(value: Any) -> str:
    """A parameter's value as it is written on a command line."""
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def one_scene(words: Sequence[str] | None, own: Sequence[str] | None = None) -> NamedSystem:
    """The scene of a command that takes one system."""
    found = scenes(words, own)
    if len(found) != 1:
        raise ValueError(f"`system` must be one; got {', '.join(s.key for s in found)}.")
    return found[0]


def interval(scene: NamedSystem, t_start: float | None, t_end: float | None) -> tuple[float, float]:
    """From the given start, or the scene's, to the end: with the scene, by --t-end, or its own."""
    start, end = scene.system.t_span
    asked = [at for at in (scene.t_end, t_end) if at is not None]
    if not asked and t_start is not None and (end - t_start) * (end - start) <= 0:
        raise Usage(f"`--t-start` {t_start:g} is not before the end, {end:g}: give --t-end too.")
    return check_t_span((start if t_start is None else t_start, asked[0] if asked else end))


def _split(words: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Names, and the parameters given as --name value or --name=value."""
    names: list[str] = []
    shared: dict[str, str] = {}
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("-") or is_number_word(word):
            names.append(word)
            continue
        name, equals, value = word.partition("=")
        if not name.startswith("--"):
            raise ValueError(f"`{name}` is not an option: see --help. A formula must not begin with -.")
        if not equals:
            if not rest:
                raise ValueError(f"`{name}` is not an option, or lacks its value: see --help.")
            value = rest.pop(0)
        key = name[2:].replace("-", "_")
        if key in shared:
            raise Usage(f"`{name}` is given twice: give it once.")
        shared[key] = value
    return names, shared


SYSTEM = "name a scene, of those that `sympflow systems` lists, an own one, file.py:name or file.toml, or write H"
MEANT = {  # options by the names that users try
    **dict.fromkeys(("solver", "integrator", "scheme"), "method"),
    **dict.fromkeys(("steps", "n_steps", "step", "h", "stepsize", "step_size"), "dt"),
    **dict.fromkeys(("t", "tmax", "t_max", "tend", "t_span", "time", "duration", "end"), "t-end"),
    **dict.fromkeys(("t0", "start"), "t-start"),
    **dict.fromkeys(("q0", "p0", "x0", "q", "p", "initial", "ic"), "y0"),
    **dict.fromkeys(("output", "save", "plot", "file", "csv", "o"), "out"),
    **dict.fromkeys(("budget", "timeout", "max_time"), "time-budget"),
}
OF_METHODS = (
    "rtol",
    "atol",
    "max_step",
    "max_steps",
    "first_step",
    "splitting",
    "clock",
    "shift",
    "compensated",
    "corrector",
)
"""Options of methods, which are written behind the name of one."""
FORMULA = re.compile(r"\*|[²³]|(?<![A-Za-z])[qp]\d*\s*[-+/^]")  # a word that is H, and not the name of a scene


def _formula(text: str) -> Callable[..., HamiltonianSystem]:
    """The function that makes a system of H as text, by the values of its other symbols."""
    if "=" in text:
        left, _, _ = text.partition("=")
        raise Usage(f"`system` {text!r} is an equation: write its right side alone, without {left}=.")
    known = {*FUNCTIONS, "pi"}
    symbols = re.sub(r"(?<![\w.])(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[²³]", " ", text)
    words = dict.fromkeys(w for w in re.findall(r"[A-Za-z_]\w*", symbols) if w not in known)

    def make(**values: float) -> HamiltonianSystem:
        params, time = dict.fromkeys(names, 1.0) | values, "t" if "t" in words else None
        system = HamiltonianSystem.from_sympy(text, params=params, time=time)  # which says what is not understood
        if missing := [f"--{name}" for name in names if name not in values]:
            raise Usage(f"`{missing[0]}` is missing, the value of a symbol in {text!r}: give it, as in {missing[0]} 1.")
        return system

    coordinates = [word for word in words if re.fullmatch(r"[qp]\d*", word)]
    names = [word for word in words if word not in coordinates and word != "t"]
    if names and not coordinates:
        raise Usage(
            f"`system` {text!r} has no coordinates: they are q and p, or q1 … qd and p1 … pd. Write it with these in "
            f"place of {', '.join(names)}."
        )
    if reserved := [name for name in names if keyword.iskeyword(name)]:
        raise Usage(f"`system` has a symbol {reserved[0]!r}, which is a word of Python: give it another name.")
    given = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=float) for name in names]
    make.__signature__ = inspect.Signature(given)  # type: ignore[attr-defined]
    return make


def _parted(word: str) -> tuple[str, Callable[..., HamiltonianSystem], list[str]]:
    """The name of a scene, the function that makes it, and its parameters, of a word such as ``pendulum:t_end=5``."""
    if match := FILE.fullmatch(word):
        path, rest = Path(match["path"]), (match["rest"] or "").split(":")
        name = rest.pop(0) if rest[0] and "=" not in rest[0] else None
        return "-".join(filter(None, (path.stem, name))), file_factory(path, name), [pair for pair in rest if pair]
    if FORMULA.search(word):
        return "formula", _formula(word), []
    name, *pairs = word.split(":")
    name = name.replace("_", "-")
    if name not in scene_names():
        key, equals, value = word.partition("=")
        if equals:
            raise Usage(f"`system` {word!r} is not a system: give a parameter as --{key} {value}.")
        if word in available_methods():
            raise Usage(f"`system` {word!r} is a method: give it as --method {word}, several with commas.")
        files = [str(path) for path in map(Path, (f"{word}.py", f"{word}.toml")) if path.is_file()]
        last = name.rpartition(".")[2].lower()
        close = files or difflib.get_close_matches(last, scene_names(), n=1, cutoff=0.5)
        hint = f"Did you mean {close[0]!r}? Else {SYSTEM}" if close else f"{SYSTEM[0].upper()}{SYSTEM[1:]}"
        raise ValueError(f"`system` {name!r} is unknown. {hint}.")
    make: Any = wraps(factory_of(name))(partial(made, name))  # with the parameters that the scene has
    return name, make, [pair for pair in pairs if pair]


def _scene(
    name: str, factory: Callable[..., HamiltonianSystem], pairs: list[str], shared: dict[str, str]
) -> NamedSystem:
    own = dict(_pairs(pairs))
    t_end = _float("t_end", own.pop("t_end")) if "t_end" in own else None
    known = inspect.signature(factory).parameters
    unknown = [key for key in own if key not in known]
    if unknown:
        raise ValueError(f"`{unknown[0]}` is not a parameter of {name}, which takes {', '.join((*known, 't_end'))}.")
    asked = {f"--{key}": value for key, value in shared.items() if key in known and key not in own} | own
    params = {key.lstrip("-"): _value(key, word, known[key.lstrip("-")]) for key, word in asked.items()}
    key = "-".join([name, *(f"{k}={shown(v)}" for k, v in params.items())])
    return NamedSystem(key, factory(**params), t_end, factory, params)


def _value(name: str, word: str, parameter: inspect.Parameter) -> Any:
    """A parameter's value: of the type that it is annotated with, or that its default has; a number else."""
    kind = parameter.annotation
    if kind in (str, "str") or isinstance(parameter.default, str):
        return word
    if kind in (bool, "bool") or isinstance(parameter.default, bool):
        if word.lower() not in ("true", "false"):
            raise ValueError(f"`{name}` must be true or false; got {word!r}.")
        return word.lower() == "true"
    number = _float(name, word)
    if kind in (int, "int") or (kind is parameter.empty and isinstance(parameter.default, int)):
        if number != int(number):
            raise ValueError(f"`{name}` must be a whole number; got {word!r}.")
        return int(number)
    return number


def varied(scene: NamedSystem, words: str) -> tuple[str, list[Any]]:
    """A parameter of a scene and its values, from ``omega=1,10,100``."""
    name, equals, values = words.partition("=")
    if not (equals and values):
        raise ValueError(f"`--vary` must be a parameter and its values, such as omega=1,10,100; got {words!r}.")
    known = inspect.signature(scene.factory).parameters
    if name not in known:
        takes = ", ".join(known) or "none"
        raise ValueError(f"`--vary` names {name!r}, which is not a parameter of {scene.key}; it has {takes}.")
    return name, [_value("--vary", word, known[name]) for word in values.split(",")]


def listed(words: str) -> list[str]:
    """Words that are separated by commas."""
    return [word.strip() for word in words.split(",") if word.strip()]


def methods(words: str) -> list[Any]:
    """Methods from a list such as ``verlet,rk45:rtol=1e-8,flow.safetensors``, for `compare`."""
    entries = listed(words)
    if not entries:
        raise ValueError("`--methods` is empty: give names separated by commas, such as verlet,rk45.")
    return [method(word) for word in entries]


def method(word: str) -> Any:
    """One method: a name, with options or without, such as ``sympflow:flow=pendulum-sympflow``, or a flow's file."""
    if word.endswith(".safetensors"):
        from sympflow.flow.files import load

        return Path(word).stem, load(word)
    name, *pairs = word.split(":")
    options = {key: _option(value) for key, value in _pairs(pairs)}
    if not options:
        return name
    try:
        return word, build(name, options)
    except (TypeError, ValueError) as error:
        raise Usage(str(error)) from error


def configured(word: str) -> Any:
    """One method as `solve` takes it: without the label that `compare` shows."""
    chosen = method(word)
    return chosen[1] if isinstance(chosen, tuple) else chosen


def _option(word: str) -> Any:
    """A number, true or false, or a text: what the method takes, it says."""
    if word.lower() in ("true", "false"):
        return word.lower() == "true"
    try:
        return int(word)
    except ValueError:
        return float(word) if is_number_word(word) else word


def _pairs(words: Sequence[str]) -> list[tuple[str, str]]:
    found: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (key and equals and value):
            raise Usage(f"`{word}` behind a colon is not an option with a value: write name:{key or 'option'}=value.")
        if key in found:
            raise Usage(f"`{key}` is given twice: give it once.")
        found[key] = value
    return list(found.items())


@overload
def state(words: str) -> np.ndarray: ...


@overload
def state(words: None) -> None: ...


def state(words: str | None) -> np.ndarray | None:
    """A state from ``0.3,-0.3,0.3,0.15``; None without any words."""
    if words is None:
        return None
    return np.array([_float("--y0", word) for word in re.split(r"\s*[,\s]\s*", words.strip("[]() "))])


def parsed(option: str, words: str | None, read: Callable[[str], Any], what: str) -> Any:
    """The value of an option's words, None without any; a ValueError says what they must be."""
    try:
        return None if words is None else read(words)
    except ValueError as error:
        raise ValueError(f"`{option}` must be {what}; got {words!r}.") from error


def numbers(words: str, kind: Callable[[str], Any] = float) -> list[Any]:
    """Numbers that are separated by commas."""
    return [kind(word) for word in words.split(",")]


def _float(name: str, word: str) -> float:
    return parsed(name, word, float, "a number")
