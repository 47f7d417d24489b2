"""The weights of a flow: their precision and device, their checksum, and what is kept while they do not change."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from sympflow.arrays import to_numpy
from sympflow.compiler import NotCompiled
from sympflow.flow.records import numbers_checksum

T = TypeVar("T")

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def checked_dtype(dtype: Any) -> torch.dtype:
    """Return `dtype` as that of torch: float32 or float64, by torch's, NumPy's or a plain name."""
    name = str(dtype).removeprefix("torch.")
    if not isinstance(dtype, (torch.dtype, str)) and dtype is not None:
        try:
            name = np.dtype(dtype).name
        except TypeError:
            name = ""
    if name not in _DTYPES:
        raise TypeError(f"`dtype` must be float32 or float64; got {dtype!r}: use torch.float32 or torch.float64.")
    return _DTYPES[name]


def checked_device(device: Any) -> torch.device | None:
    """Return `device` as that of torch, once a tensor was put there; None stands for torch's default."""
    if device is None:
        return None
    if isinstance(device, bool) or not isinstance(device, (torch.device, str, int)):
        raise TypeError(f"`device` must be a torch.device or its name; got {device!r}: use 'cpu' or 'cuda'.")
    try:
        there = torch.device(device)
        torch.empty(0, device=there)
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        reason = str(error).splitlines()[0].rstrip(". ") if str(error) else type(error).__name__
        raise ValueError(f"`device` {str(device)!r} is not available here ({reason}): use device='cpu'.") from None
    return there


def check_memory(what: str, numbers: float, remedy: str) -> None:
    """Raise ValueError where so many float64 numbers are more than the memory of the machine."""
    needed, there = 8.0 * numbers, _machine_memory()
    if needed > there:
        raise ValueError(
            f"{what} would take {needed / 2**30:.3g} GiB of memory, and this machine has {there / 2**30:.3g} GiB: "
            f"{remedy}."
        )


def _machine_memory() -> float:
    """Bytes; where the system does not say, 64 GiB."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 64.0 * 2**30


def check_compilable(dtype: torch.dtype, device: torch.device) -> None:
    """Raise a ValueError unless the numbers of a flow are float64 on the CPU, which compiled loops need."""
    if dtype != torch.float64 or device.type != "cpu":
        raise NotCompiled(f"`flow` is {dtype} on {device}: compiled flows are float64 on the CPU.")


def doubles(values: Tensor) -> np.ndarray:
    """The values as an array of float64."""
    return to_numpy(values).astype(float)


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of the tensors by name: their names, dtypes, shapes and little-endian bytes."""
    return numbers_checksum({name: value.detach().cpu().numpy() for name, value in tensors.items()})


class Kept(Generic[T]):
    """An object made of tensors in some modules' dictionaries, and made anew when one of them has changed.

    Their values are read from memory in microseconds, edits through `.data` included.
    """

    def __init__(self, tensors: Iterable[Mapping[str, Tensor | None]]) -> None:
        self._tensors = [d for d in tensors if d]
        self._addresses: list[int] = []
        self._views: list[np.ndarray] = []
        self._shared = False  # True where the views are the memory of the tensors, which lie on the CPU
        self._known: tuple[bytes, T] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_known": None}  # copies and pickles make their own

    def _all(self) -> Iterator[Tensor]:
        return (w for d in self._tensors for w in d.values() if w is not None)

    def first(self) -> Tensor:
        """Return one of the tensors."""
        return next(self._all())

    def current(self, make: Callable[[], T]) -> T:
        """Return what `make` gave for the weights as they are now."""
        snapshot = self._snapshot()
        if self._known is None or self._known[0] != snapshot:
            self._known = snapshot, make()
        return self._known[1]

    def _snapshot(self) -> bytes:
        """The bytes of all numbers."""
        tensors = list(self._all())
        try:
            addresses = [w.data_ptr() for w in tensors]
        except RuntimeError:  # handed in by functional_call inside torch.func: they have no memory of their own
            self._shared = False
            return b"".join(np.ascontiguousarray(to_numpy(w)) for w in tensors)  # type: ignore[misc]
        if addresses != self._addresses or not self._shared:
            self._views = [np.ascontiguousarray(to_numpy(w)) for w in tensors]
            self._addresses, self._shared = addresses, all(w.device.type == "cpu" for w in tensors)
        return b"".join(self._views)  # type: ignore[arg-type]
