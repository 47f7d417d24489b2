"""Systems in a user's own files: a formula in a TOML file, or a name in a Python file."""

from __future__ import annotations

import importlib.util
import inspect
import os
import sys
import tomllib
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from types import ModuleType
from typing import Any

from sympflow.arguments import did_you_mean
from sympflow.hamiltonian.domain import Ball, Box, EnergySublevel, Tube, domain_from_dict
from sympflow.hamiltonian.lattice_states import LatticeStates
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.lazy import lately_kept

DOMAINS: dict[str, tuple[str, ...]] = {  # the kinds of domains in a TOML file, and the keys of each
    "Ball": ("center", "radius"),
    "Box": ("low", "high"),
    "EnergySublevel": ("energy", "box", "above", "angular_momentum"),
    "Tube": ("orbit", "radius", "groups"),
}
KEYS: dict[str, tuple[Any, str]] = {  # the keys of a TOML file: the type of each, and that in words
    "hamiltonian": (str, "a formula in quotes, such as 'p**2/2 - cos(q)'"),
    "params": (dict, "a table of numbers, such as { omega = 2.0 }"),
    "time": (str, "the name of the time in the formula, such as 't'"),
    "period": (float, "a number"),
    "damping": ((float, list), "a number, a list of one for each p, or a matrix as a list of its rows"),
    "name": (str, "a text in quotes"),
    "y0": (list, "a list of numbers, [q…, p…]"),
    "t_span": (list, "two numbers, such as [0, 100]"),
    "dt": (float, "a number"),
    "energy_scale": (float, "a number"),
    "domain": (dict, "a table with a kind, such as { kind = 'Box', low = [-1, -1], high = [1, 1] }"),
}


def from_toml(path: str | os.PathLike[str], **params: float) -> HamiltonianSystem:
    """The system that a TOML file defines by a formula.

    Parameters
    ----------
    path : str or path
        The keys of the file are the arguments of `HamiltonianSystem.from_sympy`: `hamiltonian`, the formula, is needed;
        `params`, `time`, `period`, `damping`, `name`, `y0`, `t_span`, `dt`, `energy_scale` and `domain` are optional. A
        domain has a `kind`, "Box", "Ball", "EnergySublevel" or "Tube", and the arguments of that class.
    **params
        Values of parameters of the file, instead of those in it.

    Raises
    ------
    ValueError
        If the file is missing or no TOML, has a key that is unknown or of the wrong type, or a formula that is not
        understood: the message names the key and the file.

    Examples
    --------
    >>> system = from_toml("quartic.toml", lam=2.0)
    """
    file = Path(path)
    table = _table(file)
    unknown = [name for name in params if name not in table.get("params", {})]
    if unknown:
        has = ", ".join(table.get("params", {})) or "none"
        raise ValueError(f"`{unknown[0]}` is not a parameter of {str(file)!r}, which has {has}: add it under [params].")
    table["params"] = table.get("params", {}) | params
    if "domain" in table:
        table["domain"] = _domain(table["domain"], file)
    expression, name = table.pop("hamiltonian"), table.pop("name", file.stem)
    try:
        return HamiltonianSystem.from_sympy(expression, name=name, **table)
    except (ValueError, TypeError) as error:
        said = str(error).replace("`expression`", "`hamiltonian`", 1).replace(", or pass a SymPy expression", "")
        raise ValueError(f"{said.rstrip('.')} (in {str(file)!r}).") from error


def factory(path: str | os.PathLike[str], name: str | None = None) -> Callable[..., HamiltonianSystem]:
    """The function that makes the system of a file; its parameters are those of the system, with their defaults.

    A .py file is run, as `python file.py` would, but for its ``__main__`` part; the name is that of a HamiltonianSystem
    in it, or of a function that returns one, and may be left out where there is one only.
    """
    file = Path(path)
    if file.suffix == ".toml":
        return _of_toml(file, name)
    _text(file)
    try:
        module = _run(file.resolve())
    except (Exception, SystemExit) as error:
        raise ValueError(f"`system` {str(file)!r} cannot be run ({_described(error, file)}): correct it.") from error
    if name is None:
        names = _candidates(module)
        if len(names) == 1:
            return factory(file, names[0])
        has = f"it has {', '.join(names or _functions(module)) or 'none'}"
        raise ValueError(f"`system` {str(file)!r} lacks the name of a system in it ({has}): write {file.name}:NAME.")
    if name not in vars(module):
        candidates = _candidates(module) or _functions(module)
        hint = did_you_mean(name, candidates)
        has = f"It has {', '.join(candidates)}." if candidates else "It has no system."
        raise ValueError(f"`system` {name!r} is not in {str(file)!r}.{hint} {has}")
    found = vars(module)[name]
    if isinstance(found, HamiltonianSystem):
        return lambda: _named(found, f"{file.name}:{name}")
    if not callable(found):
        raise ValueError(
            f"`system` {name!r} in {str(file)!r} must be a HamiltonianSystem, or a function that returns one; it is "
            f"{type(found).__name__}: name another."
        )
    return _answering(found, name, file)


def _answering(function: Callable[..., Any], name: str, file: Path) -> Callable[..., HamiltonianSystem]:
    """The user's function, whose failures name it and its file."""
    where = f"`system` {name!r} in {str(file)!r}"
    try:
        known = inspect.signature(function).parameters.values()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} has no signature to read its parameters from: write a Python function.") from error
    if any(p.kind in (p.POSITIONAL_ONLY, p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in known):
        raise ValueError(f"{where} must have parameters with names alone, no *args, **kwargs or /: name them.")

    @wraps(function)
    def make(**params: Any) -> HamiltonianSystem:
        missing = [p.name for p in known if p.default is p.empty and p.name not in params]
        if missing:
            raise ValueError(
                f"{where} needs a value of `{missing[0]}`: give it a default in the file, or on the command line write "
                f"{file.name}:{name}:{missing[0]}=number."
            )
        try:
            system = function(**params)
        except (Exception, SystemExit) as error:
            raise ValueError(f"{where} failed ({_described(error, file)}): correct it.") from error
        if not isinstance(system, HamiltonianSystem):
            raise ValueError(
                f"{where} must return a HamiltonianSystem; it returns {type(system).__name__}: correct it."
            )
        return _named(system, f"{file.name}:{name}")

    return make


@lately_kept
def _named(system: HamiltonianSystem, name: str) -> HamiltonianSystem:
    """The system, by the name that it has in its file where it has none of its own."""
    return system if system.scene.name else system.with_scene(name=name)


def _of_toml(file: Path, name: str | None) -> Callable[..., HamiltonianSystem]:
    if name is not None:
        raise ValueError(f"`system` {str(file)!r} is one system, which has no {name!r}: leave the name out.")
    keyword = inspect.Parameter.KEYWORD_ONLY
    params = [inspect.Parameter(p, keyword, default=v) for p, v in _table(file).get("params", {}).items()]

    def make(**params: float) -> HamiltonianSystem:
        return from_toml(file, **params)

    make.__signature__ = inspect.Signature(params)  # type: ignore[attr-defined]
    return make


def _table(file: Path) -> dict[str, Any]:
    """The keys of a file, checked."""
    text = _text(file)
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"`system` {str(file)!r} is nested too deeply: write it in fewer brackets.") from None
    except ValueError as error:  # of its grammar, and of numbers with thousands of digits
        raise ValueError(f"`system` {str(file)!r} is not TOML ({error}): correct it; texts stand in quotes.") from error
    for key, value in table.items():
        if key not in KEYS:
            hint = did_you_mean(key, KEYS)
            raise ValueError(
                f"`{key}` is not a key of a system (in {str(file)!r}).{hint} The keys are {', '.join(KEYS)}."
            )
        kind, words = KEYS[key]
        if not _fits(value, kind) or not all(map(_is_number, _numbers(key, value))):
            raise ValueError(f"`{key}` must be {words}; got {value!r} (in {str(file)!r}).")
    if "hamiltonian" not in table:
        raise ValueError(f"`hamiltonian` is missing in {str(file)!r}: add {KEYS['hamiltonian'][1]}.")
    reserved = [p for p in table.get("params", {}) if p in ("q", "p", "t")]
    if reserved:
        raise ValueError(f"`{reserved[0]}` cannot be the name of a parameter (in {str(file)!r}): choose another.")
    return table


def _fits(value: Any, kind: Any) -> bool:
    """Return True for a value of a type, or of one of several; a whole number is a number too."""
    if isinstance(kind, tuple):
        return any(_fits(value, one) for one in kind)
    return _is_number(value) if kind is float else isinstance(value, kind)


def _numbers(key: str, value: Any) -> list[Any]:
    """The entries of a value that must be numbers."""
    if key == "params":
        return list(value.values())
    if not isinstance(value, list):
        return []
    rows = [row if key == "damping" and isinstance(row, list) else [row] for row in value]
    return [entry for row in rows for entry in row]


def _domain(table: dict[str, Any], file: Path) -> Ball | Box | EnergySublevel | LatticeStates | Tube:
    kind = table.get("kind")
    if kind not in DOMAINS:
        raise ValueError(f"`domain` needs a kind, one of {', '.join(DOMAINS)}; got {kind!r} (in {str(file)!r}).")
    unknown = [key for key in table if key not in ("kind", *DOMAINS[kind])]
    if unknown:
        has = ", ".join(DOMAINS[kind])
        raise ValueError(f"`domain` has a key {unknown[0]!r}, but a {kind} has {has} (in {str(file)!r}): correct it.")
    if isinstance(table.get("box"), dict):
        table = table | {"box": {"kind": "Box"} | table["box"]}
    try:
        return domain_from_dict(table)
    except ValueError as error:
        said = str(error).removeprefix("`description` is not a domain: ").rstrip(".")
        raise ValueError(f"`domain` is not a {kind}: {said} (in {str(file)!r}).") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")  # Windows puts a mark at the beginning
    except FileNotFoundError as error:
        raise ValueError(f"`system` {str(file)!r}: there is no such file. Name one that is there.") from error
    except OSError as error:
        raise ValueError(f"`system` {str(file)!r} cannot be read ({error.strerror}): name a file that can.") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"`system` {str(file)!r} is not a text in UTF-8: save it in UTF-8.") from error


@cache
def _run(file: Path) -> ModuleType:
    """The module of a Python file, run once, with its folder on the path as for a script."""
    name = f"sympflow_user_file_{file.stem}"
    spec: Any = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # pickles and dataclasses look it up
    if str(file.parent) not in sys.path:
        sys.path.insert(0, str(file.parent))
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _described(error: BaseException, file: Path) -> str:
    """An exception with the last line of the file that it passed."""
    if isinstance(error, SyntaxError):
        return f"SyntaxError: {error.msg}, line {error.lineno}"
    line = None
    trace = error.__traceback__
    while trace is not None:
        if Path(trace.tb_frame.f_code.co_filename).name == file.name:
            line = trace.tb_lineno
        trace = trace.tb_next
    return f"{type(error).__name__}: {error}" + (f", line {line}" if line else "")


def _candidates(module: ModuleType) -> list[str]:
    """The names in a module that are systems, or that are functions of its own without needed arguments."""
    public = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    found = [name for name, value in public.items() if isinstance(value, HamiltonianSystem)]
    return found or [name for name in _functions(module) if _returns_a_system(public[name])]


def _functions(module: ModuleType) -> list[str]:
    """The names of the functions that a module defines."""
    found = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    return [name for name, f in found.items() if inspect.isfunction(f) and f.__module__ == module.__name__]


def _returns_a_system(function: Any) -> bool:
    returns = function.__annotations__.get("return")
    return returns is HamiltonianSystem or (isinstance(returns, str) and returns.endswith("HamiltonianSystem"))


__all__ = ["factory", "from_toml"]
