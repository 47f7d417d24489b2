"""Fingerprints of users' functions, by which the store of an ensemble knows its `reduce` again."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from functools import partial
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from sympflow.integrators.provenance import digest

ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


def fingerprint(function: Any) -> str:
    """Return the name of a callable, and a digest of its code and of the values that it computes with.

    Values are those of its defaults, its closure, the object that it is a method of, and the globals of its own module;
    functions of other modules count by their code. It is the same in another process.
    """
    name = getattr(function, "__qualname__", type(function).__qualname__)
    try:
        return f"{name} {digest(_Contents(getattr(function, '__module__', '')).of(function))}"
    except RecursionError:  # of a list that holds itself
        return str(name)


class _Contents:
    """What values are made of, as JSON has it: each function or object once."""

    def __init__(self, module: str) -> None:
        self.module = module
        self.seen: dict[int, Any] = {}

    def of(self, value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return [str(value.dtype), np.shape(value), digest(np.asarray(value))]
        if isinstance(value, CodeType):
            return [value.co_code.hex(), value.co_names, self.of(value.co_consts)]
        if isinstance(value, list | tuple):
            return [self.of(item) for item in value]
        if isinstance(value, set | frozenset):
            return sorted(json.dumps(self.of(item)) for item in value)
        if isinstance(value, type | ModuleType | BuiltinFunctionType):
            return [getattr(value, "__module__", ""), value.__name__]
        if value is None or isinstance(value, str | bytes | int | float | complex):
            return repr(value)
        if id(value) in self.seen:
            return "again"
        self.seen[id(value)] = value  # which also keeps its id from being another's
        if isinstance(value, Mapping):
            return self.of(list(value.items()))
        if isinstance(value, FunctionType):
            made_with = [value.__code__, value.__defaults__, *(value.__kwdefaults__ or {}).items()]
            return self.of([*made_with, *_closure(value), *self._globals(value)])
        if isinstance(value, MethodType):
            return self.of([value.__func__, value.__self__])
        if isinstance(value, partial):
            return self.of([value.func, value.args, *value.keywords.items()])
        if type(value).__repr__ is object.__repr__:
            call = vars(type(value)).get("__call__")
            return [type(value).__qualname__, self.of([call, *getattr(value, "__dict__", {}).items()])]
        return [ADDRESS.sub("", repr(value)), self.of(getattr(value, "py_func", ()))]  # of Numba's, the function

    def _globals(self, function: FunctionType) -> Iterator[tuple[str, Any]]:
        if function.__module__ == self.module:
            named = function.__globals__
            yield from ((name, named[name]) for name in sorted(set(_names(function.__code__))) if name in named)


def _names(code: CodeType) -> Iterator[str]:
    """The names that a code looks up, those of functions within it too."""
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names(inner)


def _closure(function: FunctionType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            yield name, cell.cell_contents
        except ValueError:  # not assigned yet
            yield name, None
