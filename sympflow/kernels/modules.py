"""Generated source as importable modules, kept in a per-user folder so that Numba's disk cache applies."""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.registry import CPUDispatcher

__all__ = [
    "OPTIONS",
    "cache_folder",
    "compiling_alone",
    "constants_source",
    "elementary",
    "imports_source",
    "load_algebra",
    "load_module",
    "template",
]

OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
"""Options of the compiler: 1/0 is inf, a·b + c may be fused; nothing else about rounding or NaN is relaxed."""

_INNER = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # options of functions that only others call
_CALLED = {"rollout", "rollout_rows"}  # functions that others call, and Python as well


def template(name: str) -> str:
    """The text of loops of that name: see `sympflow.kernels.text`."""
    return files(__package__).joinpath("text", f"{name}.py").read_text(encoding="utf-8")


def cache_folder() -> Path:
    """Folder of the generated modules.

    The first that is set of $SYMPFLOW_CACHE_DIR, $NUMBA_CACHE_DIR/sympflow, $XDG_CACHE_HOME/sympflow and the
    platform's folder for caches.
    """
    if folder := os.environ.get("SYMPFLOW_CACHE_DIR"):
        return Path(folder)
    for variable in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        if folder := os.environ.get(variable):
            return Path(folder) / "sympflow"
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "sympflow"


def constants_source(cache: bool = True, **constants: Any) -> str:
    """The beginning of a source: imports, the options of the compiler, and constants."""
    lines = [f"{name} = {value}" for name, value in {"OPTIONS": OPTIONS | {"cache": cache}, **constants}.items()]
    return "import math\n\nfrom numba import njit\n\n" + "\n".join(lines)


def elementary(*sources: str) -> list[str]:
    """The source of elementary functions, where one of these calls them: for `load_module` to share."""
    called = any("fast_" in source or "fused_multiply_add" in source for source in sources)
    return [f"{constants_source()}\n\n\n{template('elementary')}"] if called else []


def load_algebra(algebra: str, loops: Sequence[str] = (), shared: Sequence[str] = (), **constants: Any) -> ModuleType:
    """The module of a system's algebra: constants before it, after it `loops`; `elementary` is shared."""
    source = "\n\n\n".join([constants_source(**constants), algebra, *map(template, loops)])
    return load_module(source, (*elementary(algebra), *shared))


def load_module(source: str, shared: Sequence[str] = ()) -> ModuleType:
    """Import `source`, written once to `cache_folder` under a name made from its contents.

    Where that folder cannot be written, a temporary one serves for the life of the process. Only what Python may call
    is in the module that is returned: see `_callable_part`.

    Parameters
    ----------
    source : str
    shared : sequence of str
        Sources of what it has in common with others: modules of their own, so that their functions are compiled once
        for all. All names of theirs are known in `source`, and in those after them. Python calls none of them.
    """
    with _loading:
        return _loaded(source, tuple(shared))


@cache
def _loaded(source: str, shared: tuple[str, ...]) -> ModuleType:
    return _callable_part(_imported(source, shared))


def imports_source(shared: Sequence[str]) -> str:
    """The beginning of a source that knows the names of `shared` ones: see `load_module`."""
    shared = tuple(shared)
    with _loading:
        modules = [_shared(text, shared[:i]) for i, text in enumerate(shared)]
    return "".join(f"from {module.__name__} import *\n" for module in modules)


@cache
def _shared(source: str, before: tuple[str, ...]) -> ModuleType:
    module = _imported(source, before)
    for f in _functions(module).values():
        f.targetoptions.update(_INNER)
    return module


def _imported(source: str, shared: tuple[str, ...]) -> ModuleType:
    source = imports_source(shared) + source
    versions = f"{numba.__version__} {sys.version} {_INNER}"
    key = hashlib.sha256(f"{versions}\n{source}".encode()).hexdigest()[:24]
    name = f"sympflow_kernel_{key}"
    try:
        path = _write_once(cache_folder(), name, source)
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        path = _write_once(_temporary_folder(), name, source)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Numba looks a function's module up by name
    spec.loader.exec_module(module)
    for f in _functions(module).values():
        if isinstance(f._cache, FunctionCache):
            f._cache = _Cache(f.py_func)
    return module


def _functions(module: ModuleType) -> dict[str, CPUDispatcher]:
    """The compiled functions that a module defines, without those that it imports."""
    found = {name: f for name, f in vars(module).items() if isinstance(f, CPUDispatcher)}
    return {name: f for name, f in found.items() if f.py_func.__module__ == module.__name__}


class _Cache(FunctionCache):
    """Numba's cache on disk, for processes that compile the same shared functions at once.

    Numba reads the index of what is there, writes a file beside it, and then the index: two processes in between each
    other would give two files one name.
    A file that cannot be read, such as one that was cut where the disk was full, is compiled again.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever a damaged pickle raises
            with _locked(".index-lock"), suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with _locked(".index-lock"):
            super().save_overload(sig, data)


def _callable_part(module: ModuleType) -> ModuleType:
    """The constants, and the compiled functions that Python may call: those of `_CALLED` or that no other one names.

    The others are compiled without an entry from Python, which for functions as small as these is a third of the time
    that compilation takes. Such a function must not be called: so the part has none. C calls none of them.
    """
    functions = _functions(module)
    part = ModuleType(module.__name__)
    for name, value in vars(module).items():
        if not isinstance(value, CPUDispatcher):
            setattr(part, name, value)
    inner = {name for f in functions.values() for name in f.py_func.__code__.co_names if name != f.__name__}
    for name, f in functions.items():
        if name in inner - _CALLED:
            f.targetoptions.update(_INNER)
        else:
            f.targetoptions["no_cfunc_wrapper"] = True
            setattr(part, name, f)
    return part


@contextmanager
def compiling_alone() -> Iterator[None]:
    """Keep other processes that say so from compiling what is inside: the next one finds it in the cache on disk."""
    with _locked(".lock"):
        yield


@contextmanager
def _locked(name: str) -> Iterator[None]:
    """Keep other processes from what is inside, by a file of that name in `cache_folder`."""
    try:
        import fcntl

        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = open(folder / name, "w")  # noqa: SIM115
    except (ImportError, OSError, RuntimeError):  # Windows; no folder that can be written
        yield
        return
    with file:
        with suppress(OSError):  # of a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


@cache
def _temporary_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="sympflow-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _write_once(folder: Path, name: str, source: str) -> Path:
    """The file with this source, written atomically unless it is there already, unchanged.

    It must not be rewritten: Numba takes a file with a new date for a new file. Numba's own files beside it must
    be writable as well.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(folder)
    path = folder / f"{name}.py"
    if not (path.exists() and path.read_text(encoding="utf-8") == source):
        handle, unfinished = tempfile.mkstemp(dir=folder, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(source)
        os.replace(unfinished, path)
    return path


_loading = threading.RLock()
"""Held while modules are made: another thread would see one of which some names are there."""
