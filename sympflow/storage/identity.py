"""Identities of calls: digests of the call that made a store, by which the same call is recognised in any process.

A digest is of the thing itself: arrays by their bytes, functions by their code with its defaults, its closure and the
globals that it names, classes by their members and bases, objects by their class and state. Code of the standard
library counts by its name, that of an installed package by the file in which it stands.
"""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import sys
import types
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), type(NotImplemented))
NAMED = (
    types.GetSetDescriptorType,
    types.MemberDescriptorType,
    types.MethodDescriptorType,
    types.WrapperDescriptorType,
)
GLOBALS, ATTRIBUTES = ("LOAD_GLOBAL", "LOAD_NAME"), ("LOAD_ATTR", "LOAD_METHOD", "IMPORT_FROM")


@runtime_checkable
class Identified(Protocol):
    """An object that states what it is made of, where that is less than its state."""

    def identity_parts(self) -> Any:
        """Return what it is made of."""


@dataclass
class Known:
    """The identity of a call, by which a store recognises it: texts by the names of arguments and the like.

    `python` are the names of those in which there are functions or objects of Python, and not values alone; `untold`
    those with a part that cannot be compared, and that part.
    """

    texts: dict[str, str] = field(default_factory=dict)
    python: set[str] = field(default_factory=set)
    untold: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, text: str, *values: Any) -> None:
        """Add the text of a part, with the digest of values."""
        contents = _Contents()
        self.texts[name] = f"{text} {contents.of(values)}"
        if contents.python:
            self.python.add(name)
        if contents.untold:
            self.untold[name] = contents.untold[0]


def digest(value: Any) -> str:
    """Return the digest of a value."""
    return _Contents().of(value)


class _Contents:
    """The digests of values, each object once; those that stand in themselves count by how far up they stand."""

    def __init__(self) -> None:
        self.python = False
        self.untold: list[str] = []
        self._done: dict[int, tuple[Any, str]] = {}  # with the values, whose ids are not another's then
        self._open: list[int] = []

    def of(self, value: Any) -> str:
        if type(value) in PLAIN:
            return _digest(type(value).__name__, repr(value))
        if id(value) in self._done:
            return self._done[id(value)][1]
        if id(value) in self._open:
            return _digest("again", str(len(self._open) - self._open.index(id(value))))
        self._open.append(id(value))
        try:
            found = _digest(*self._parts(value))
        except RecursionError:
            found = self._unknown(value)
        finally:
            self._open.pop()
        self._done[id(value)] = value, found
        return found

    def _parts(self, value: Any) -> Iterable[str | bytes | memoryview]:
        kind = type(value)
        if kind is np.ndarray or isinstance(value, np.generic):
            return self._array(np.asarray(value))
        if isinstance(value, _of("torch", "Tensor")):
            return "tensor", str(value.dtype), *self._array(_numbers(value))
        if kind in (dict, OrderedDict, types.MappingProxyType):
            return "mapping", *self._items(value.items())
        if kind in (list, tuple):
            return kind.__name__, *map(self.of, value)
        if kind in (set, frozenset):
            return "set", *sorted(map(self.of, value))
        if isinstance(value, _of("sympy", "Basic")):
            return "sympy", sys.modules["sympy"].srepr(value)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, Identified):
            return "made of", self.of(kind), self.of(value.identity_parts())
        if is_dataclass(value) and kind.__module__.startswith("sympflow."):
            compared = ((f.name, getattr(value, f.name)) for f in fields(value) if f.compare)
            return "made of", self.of(kind), *self._items(compared)
        return self._python(value)

    def _python(self, value: Any) -> Iterable[str]:
        """The parts of what Python code stands for, and of objects of any other kind."""
        self.python = True
        if isinstance(value, types.CodeType):
            own = (value.co_code, value.co_exceptiontable, value.co_flags, value.co_argcount, value.co_kwonlyargcount)
            return "code", *map(self.of, (*own, value.co_names, value.co_varnames, value.co_consts))
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, types.MethodType):
            return "method", self.of(value.__func__), self.of(value.__self__)
        if isinstance(value, staticmethod | classmethod):
            return type(value).__name__, self.of(value.__func__)
        if isinstance(value, property):
            return "property", *map(self.of, (value.fget, value.fset, value.fdel))
        if isinstance(value, functools.cached_property):
            return "property", self.of(value.func)
        if isinstance(value, functools._lru_cache_wrapper):
            return "cached", self.of(value.__wrapped__)
        if isinstance(value, _of("numba.core.registry", "CPUDispatcher")):
            return "compiled", self.of(value.py_func), self.of(dict(value.targetoptions))
        if isinstance(value, NAMED):
            return "member", _name(value.__objclass__), value.__name__
        if isinstance(value, types.BuiltinFunctionType):
            that = value.__self__
            return (
                "built in",
                _name(value),
                "" if that is None or isinstance(that, types.ModuleType) else self.of(that),
            )
        if isinstance(value, types.ModuleType):
            return ("module", value.__name__) if _source(value.__name__) is not None else (self._unknown(value),)
        return self._object(value)

    def _array(self, array: np.ndarray) -> Iterable[str | memoryview]:
        kind = ("array", repr(array.dtype), str(array.shape))
        if array.dtype.hasobject:
            return *kind, self.of(array.tolist())
        return *kind, np.ascontiguousarray(array).reshape(-1).view(np.uint8).data

    def _items(self, items: Iterable[tuple[Any, Any]]) -> Iterator[str]:
        """The digests of names and values, in the order of those of the names."""
        for name, value in sorted(((self.of(name), value) for name, value in items), key=lambda item: item[0]):
            yield name
            yield self.of(value)

    def _object(self, value: Any) -> Iterable[str]:
        """The parts of an object as it is copied and pickled, but for cached properties."""
        try:
            reduce = copyreg.dispatch_table.get(type(value))
            made = value.__reduce_ex__(4) if reduce is None else reduce(value)
        except Exception:  # whatever its class raises
            wrapped = getattr(value, "__wrapped__", None)
            return ("wrapped", self.of(wrapped)) if isinstance(wrapped, types.FunctionType) else (self._unknown(value),)
        if isinstance(made, str):
            if isinstance(value, np.ufunc) and value not in (getattr(np, made, None), _of("scipy.special", made)):
                return (self._unknown(value),)
            return "named", _name(type(value)), made
        function, arguments, state, items, pairs = (*made, None, None, None)[:5]
        states = [
            {name: x for name, x in part.items() if not _is_cached(type(value), name)} if type(part) is dict else part
            for part in (state if isinstance(state, tuple) else (state,))
        ]
        entries = None if pairs is None else dict(pairs)
        return "object", *map(self.of, (type(value), function, arguments, states, list(items or ()), entries))

    def _class(self, cls: type) -> Iterable[str]:
        source = _source(cls.__module__)
        if source is not None:
            return "class", _name(cls), source
        self.python = True
        said = {name for name in vars(cls) if name.startswith("__") or name == "_abc_impl"}  # such as __doc__
        members = ((name, value) for name, value in vars(cls).items() if callable(value) or name not in said)
        return "class", cls.__qualname__, *map(self.of, (type(cls), *cls.__bases__)), *self._items(members)

    def _function(self, f: types.FunctionType) -> Iterable[str]:
        made_with = (f.__code__, f.__defaults__, f.__kwdefaults__)
        attributes = {name for code in _codes(f.__code__) for name in _looked_up(code, ATTRIBUTES)}
        source = _source(f.__module__)
        reached = list(_closure(f))
        if source is None:
            source = ""
            reached += _globals(f)
        own = [x for name, value in reached for x in (name, self._reached(value, frozenset(attributes)))]
        return "function", source, *map(self.of, made_with), self.of(vars(f)), *own

    def _reached(self, value: Any, attributes: frozenset[str]) -> str:
        """The digest of what a function names; of a module of the user, of those of its attributes that are named."""
        if not isinstance(value, types.ModuleType) or _source(value.__name__) is not None:
            return self.of(value)
        if id(value) in self._open:
            return _digest("again", value.__name__)
        self._open.append(id(value))
        named = [(name, vars(value)[name]) for name in sorted(attributes & set(vars(value)))]
        parts = [x for name, part in named for x in (name, self._reached(part, attributes))]
        self._open.pop()
        return _digest("module", value.__name__, *parts)

    def _unknown(self, value: Any) -> str:
        self.python = True
        name = value.__name__ if isinstance(value, types.ModuleType) else _name(type(value)).removeprefix("builtins.")
        self.untold.append(f"the module {name}" if isinstance(value, types.ModuleType) else f"an object of {name}")
        return _digest("unknown", name)


def _digest(*parts: str | bytes | memoryview) -> str:
    whole = hashlib.sha256()
    for part in parts:
        data = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        whole.update(f"{len(data)}:".encode())
        whole.update(data)
    return whole.hexdigest()[:16]


def _numbers(tensor: Any) -> np.ndarray:
    """The numbers of a tensor of any dtype, as bytes where NumPy has none such."""
    kept = tensor.detach().cpu().resolve_conj().resolve_neg().contiguous()
    try:
        return kept.numpy()
    except TypeError:  # such as bfloat16
        torch = sys.modules["torch"]
        return kept.reshape(-1).view(torch.uint8).numpy().reshape(*kept.shape, -1)


def _of(module: str, name: str) -> Any:
    """A class of a library, or nothing where that has not been imported."""
    return getattr(sys.modules.get(module), name, ())


def _name(value: Any) -> str:
    module = getattr(value, "__module__", None)
    return f"{module}.{value.__qualname__}" if isinstance(module, str) else str(value.__qualname__)


def _is_cached(cls: type, name: Any) -> bool:
    return any(isinstance(vars(base).get(name), functools.cached_property) for base in cls.__mro__)


@functools.lru_cache(maxsize=4096)
def _source(module: str | None) -> str | None:
    """The digest of the file of a module that is not the user's own, "" where its name says it all; None of the own."""
    top = (module or "").partition(".")[0]
    if top == "__main__" or not module:
        return None
    if top in sys.stdlib_module_names or top == "sympflow":
        return ""
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None or not {"site-packages", "dist-packages"} & set(Path(file).parts):
        return None
    try:
        return _digest(Path(file).read_bytes()) if file.endswith(".py") else ""
    except OSError:
        return ""


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """A code, and those of functions within it."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from _codes(inner)


def _looked_up(code: types.CodeType, operations: Iterable[str]) -> list[str]:
    return [step.argval for step in dis.get_instructions(code) if step.opname in operations]


def _globals(f: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """The globals that a function names, and the modules that it imports."""
    codes = list(_codes(f.__code__))
    space: Mapping[str, Any] = f.__globals__
    for name in sorted({name for code in codes for name in _looked_up(code, GLOBALS)} & set(space)):
        yield name, space[name]
    for name in sorted({name for code in codes for name in _looked_up(code, ["IMPORT_NAME"])}):
        module = sys.modules.get(name, sys.modules.get(f"{space.get('__package__')}.{name}"))
        if module is not None:
            yield name, module


def _closure(f: types.FunctionType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True):
        try:
            yield name, cell.cell_contents
        except ValueError:  # not assigned yet
            yield name, None
