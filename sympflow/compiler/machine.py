"""From text of LLVM IR to machine code: kept in memory and on disk, called without the interpreter's lock."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import threading
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np

from sympflow.compiler import elementary  # noqa: F401  (code of functions, which texts are made of)
from sympflow.compiler.functions import SPECIAL
from sympflow.compiler.tables import SYMBOL, TABLES

__all__ = ["Host", "address", "compiled", "host"]


class Host(NamedTuple):
    """The processor that code is made for: `cpu` and `features` as LLVM names them.

    It is `fused` if it multiplies and adds in one instruction; a `register` holds so many doubles.
    """

    cpu: str
    features: str
    fused: bool
    register: int


@cache
def host() -> Host:
    """Return the processor of this machine."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    has = llvm.get_host_cpu_features()
    wide = 8 if has.get("avx512f") else 4 if has.get("avx") else 2
    arm = llvm.get_process_triple().startswith(("aarch64", "arm64"))
    return Host(llvm.get_host_cpu_name(), has.flatten(), bool(has.get("fma")) or arm, wide)


def _target() -> Any:
    machine = host()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=machine.cpu, features=machine.features, opt=2)


_LOCK = threading.RLock()
_LOADED: dict[str, Any] = {}
_RESOLVED: set[str] = set()


def compiled(text: str, name: str, signature: Any) -> Any:
    """Return a function of a text of LLVM IR, to be called by ctypes, which lets other threads run meanwhile.

    The machine code is kept in this process, and in a folder for the next one: the first of SYMPFLOW_CACHE_DIR and the
    user's cache directory that can be written. A file there begins with the digest of the rest.
    """
    key = hashlib.sha256("\0".join([text, *map(str, host()), llvm.llvm_version_info.__repr__()]).encode()).hexdigest()
    with _LOCK:
        if SPECIAL in text:
            _resolve(set(re.findall(rf"@({SPECIAL}\w+)\(", text)))
        for symbol in re.findall(rf"@({SYMBOL}\w+) = external", text) if SYMBOL in text else ():
            llvm.add_symbol(symbol, TABLES[symbol].values.ctypes.data)
        engine = _LOADED.get(key)
        if engine is None:
            code = _stored(key)
            if code is None:
                code = _object_code(text)
                _store(key, code)
            engine = _LOADED[key] = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target())
            engine.add_object_file(llvm.ObjectFileRef.from_data(code))
            engine.finalize_object()
    return signature(engine.get_function_address(name))


def _resolve(names: set[str]) -> None:
    """Tell the linker where functions of `scipy.special` are, of the names that a text has."""
    from scipy.special import cython_special

    capsules = cython_special.__pyx_capi__
    for symbol in names - _RESOLVED:
        name = symbol.removeprefix(SPECIAL)
        capsule = capsules[f"__pyx_fuse_1{name}" if f"__pyx_fuse_1{name}" in capsules else name]
        ctypes.pythonapi.PyCapsule_GetName.restype = ctypes.c_char_p
        ctypes.pythonapi.PyCapsule_GetPointer.restype = ctypes.c_void_p
        kind = ctypes.pythonapi.PyCapsule_GetName(ctypes.py_object(capsule))
        place = ctypes.pythonapi.PyCapsule_GetPointer(ctypes.py_object(capsule), ctypes.c_char_p(kind))
        llvm.add_symbol(symbol, place)
        _RESOLVED.add(symbol)


def address(array: Any) -> int:
    """Return where the numbers of a NumPy array lie in memory, of an empty one too, where code may look."""
    try:
        return _PLACE(_BYTE(array))  # a third of the time of what follows
    except (TypeError, ValueError, BufferError):  # not to be written, or empty
        return int(array.ctypes.data)


def given(arguments: Sequence[Any]) -> list[Any]:
    """Return arguments as compiled code takes them: the places of arrays, and numbers."""
    try:
        return [_PLACE(_BYTE(x)) if isinstance(x, np.ndarray) else x for x in arguments]
    except (TypeError, ValueError, BufferError):  # one of them is as above
        return [address(x) if isinstance(x, np.ndarray) else x for x in arguments]


_BYTE: Any = ctypes.c_char.from_buffer
_PLACE = ctypes.addressof


def _object_code(text: str) -> bytes:
    module = llvm.parse_assembly(text)
    target = _target()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = options.loop_vectorization = False
    options.loop_unrolling = options.loop_interleaving = False
    builder = llvm.create_pass_builder(target, options)
    passes = llvm.create_new_function_pass_manager()
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)
    return target.emit_object(module)


def _folder() -> Path | None:
    """The folder of machine code, if there is one that can be written."""
    places = [os.environ.get("SYMPFLOW_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME", "~/.cache")]
    for i, place in enumerate(places):
        if not place:
            continue
        folder = Path(place).expanduser() / ("code" if i == 0 else "sympflow/code")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return None


def _stored(key: str) -> bytes | None:
    folder = _folder()
    if folder is None:
        return None
    try:
        data = (folder / f"{key}.o").read_bytes()
    except OSError:
        return None
    code = data[32:]
    return code if hashlib.sha256(code).digest() == data[:32] else None


def _store(key: str, code: bytes) -> None:
    folder = _folder()
    if folder is None:
        return
    part = folder / f"{key}.{os.getpid()}.part"
    try:
        part.write_bytes(hashlib.sha256(code).digest() + code)
        os.replace(part, folder / f"{key}.o")
    except OSError:
        part.unlink(missing_ok=True)


def _held_across_forks() -> None:
    """A child that is forked while another thread compiles would wait for ever for llvmlite's own lock."""
    lock = getattr(getattr(llvm.ffi, "lib", None), "_lock", None)
    for held in (lock, _LOCK):  # taken from the last to the first
        if held is not None and hasattr(os, "register_at_fork"):
            release = held.__exit__
            os.register_at_fork(
                before=held.__enter__,
                after_in_parent=lambda release=release: release(None, None, None),
                after_in_child=lambda release=release: release(None, None, None),
            )


_held_across_forks()
