"""Stores of ensembles, which `xarray.open_zarr` reads; each chunk is written by the worker that runs it.

A chunk of orbits is one chunk of every array, so that no two writers meet. The statuses are written last: a chunk whose
statuses are there is done, and is not run again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.ensembles.orbits import Drawn, Given
from sympflow.ensembles.results import Block, Done, Index, Layout
from sympflow.integrators.provenance import known_by
from sympflow.storage.identity import Known
from sympflow.storage.layout import halves, imported
from sympflow.storage.store import Store

if TYPE_CHECKING:
    import xarray

    from sympflow.ensembles.reductions import Reduction
    from sympflow.hamiltonian.system import HamiltonianSystem
    from sympflow.integrators.contract import Integrator

MESSAGES = "messages"
"""The folder of the messages of orbits that failed, a file for each chunk with some; readers of zarr pass over it."""
KNOWN = "sympflow_ensemble"  # the attribute that says of which ensemble a store is


def identity(
    system: HamiltonianSystem,
    integrator: Integrator,
    t_span: tuple[float, float],
    t_eval: np.ndarray | None,
    orbits: Given | Drawn,
    axes: Mapping[str, np.ndarray],
    reduction: Reduction,
    backend: str,
) -> Known:
    """The identity of an ensemble."""
    known = known_by(system, integrator, backend)
    known.texts |= {"dt": repr(integrator.step_length(system)), "t_span": f"{t_span[0]!r} to {t_span[1]!r}"}
    known.add("t_eval", "every step" if t_eval is None else f"{len(t_eval)} times", t_eval)
    known.add("y0", f"{len(orbits)} states{orbits.drawn}", *orbits.parts())
    known.add("params", ", ".join(f"{len(v)} values of {name}" for name, v in axes.items()) or "none", axes)
    known.add("reduce", type(reduction).__name__, reduction)
    return known


@dataclass(frozen=True)
class EnsembleStore:
    """The store of an ensemble, with chunks of `sizes`: a path, which is small when it is sent to a worker."""

    path: str
    layout: Layout
    sizes: Index

    @classmethod
    def at(
        cls, path: Any, layout: Layout, sizes: Index, attributes: dict[str, Any], known: Known, resume: bool, same: bool
    ) -> EnsembleStore:
        """Make the store of an ensemble, or, with `resume`, find the one that is there, with chunks of its own."""
        if isinstance(path, bytes) or not isinstance(path, str | os.PathLike):
            raise TypeError(f"`store` must be the path of a folder; got {type(path).__name__}.")
        place = Path(os.path.abspath(os.fspath(path)))
        made, told = layout.stored(sizes), {KNOWN: json.dumps(known.texts), "chunk_shape": list(sizes)}
        try:
            Store.create(place, made, attributes | told, layout.coordinates())
        except FileExistsError:
            if not resume:
                raise ValueError(
                    f"`store` {str(path)!r} exists: pass resume=True to go on with it, or name another folder."
                ) from None
            store = Store.open(place)
            store.check_same(KNOWN, known, str(path), "ensemble", "Name another folder.", same)
            sizes = _chunk_shape(store, layout)
            store.check_made_of(layout.stored(sizes))
            for name, values in layout.coordinates().items():
                if not store.has(name, (0,)):  # as in one of an earlier version that was killed as it made it
                    store.write(name, (0,), values)
        (place / MESSAGES).mkdir(exist_ok=True)
        return cls(str(place), layout, sizes)

    @cached_property
    def _store(self) -> Store:
        return Store.open(self.path)

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("path", "layout", "sizes")}

    def _number(self, block: Block) -> Index:
        """The number of the chunk of a block along each axis."""
        return tuple(start // size for (start, _), size in zip(block.ranges, self.sizes, strict=True))

    def write(self, block: Block, done: Done, y0: np.ndarray) -> None:
        """Write the orbits of a block, their statuses last."""
        store, number = self._store, self._number(block)
        for v in self.layout.variables():
            values = v.of(done.fields[v.field], 1).reshape(*block.shape, *v.shape)
            store.write(v.name, (*number, *(0,) * len(v.shape)), values)
        if not any(number[:-1]):  # each orbit belongs to many values of the parameters, and to one writer
            for letter, rows in halves(self.layout.ndof):
                store.write(f"{letter}0", (number[-1], 0), y0[:, rows])
        if done.messages:
            store.write_text(f"{MESSAGES}/{block.first}.json", json.dumps(done.messages))
        store.write("status", number, done.status.reshape(block.shape))

    def place(self, block: Block, done: Done) -> None:
        """Nothing: the worker has written it."""

    def is_done(self, block: Block) -> bool:
        """True if the orbits of a block have been run, and all that was kept of them is there."""
        store, number = self._store, self._number(block)
        return store.has("status", number) and not self._missing(number)

    def _missing(self, number: Index) -> str:
        """The name of an array of which a chunk that has been run is not there; "" if all are."""
        kept = {v.name: (*number, *(0,) * len(v.shape)) for v in self.layout.variables()}
        if not any(number[:-1]):
            kept |= {f"{letter}0": (number[-1], 0) for letter, _ in halves(self.layout.ndof)}
        return next((name for name, index in kept.items() if not self._store.has(name, index)), "")

    def finish(self) -> None:
        """Note that all orbits have been run."""
        self._store.complete("status")

    @property
    def status(self) -> np.ndarray:
        return self._store.read("status")

    @property
    def fields(self) -> Mapping[str, np.ndarray]:
        return _Read(self)

    def read(self, field: str) -> np.ndarray:
        """Return a field, NaN where orbits have not been run."""
        store = self._store
        for number in np.ndindex(*store.fields["status"].grid):
            if store.has("status", number) and (name := self._missing(number)):
                raise store.damaged(f"a chunk of {name!r} is missing, and is run again by the same call, resume=True")
        arrays = [store.read(v.name) for v in self.layout.variables() if v.field == field]
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=len(self.layout.shape))

    @property
    def messages(self) -> Mapping[Index, str]:
        found = {}
        for file in (Path(self.path) / MESSAGES).glob("*.json"):
            try:
                for row, text in json.loads(file.read_text(encoding="utf-8")).items():
                    index = np.unravel_index(int(file.stem) + int(row), self.layout.shape)
                    found[tuple(map(int, index))] = str(text)
            except (ValueError, AttributeError, RecursionError, OSError) as error:
                raise self._store.damaged(f"its messages {file.name} cannot be read ({error})") from None
        return dict(sorted(found.items()))

    def dataset(self) -> xarray.Dataset:
        imported("zarr", "to_xarray()")
        return imported("xarray", "to_xarray()").open_zarr(self.path, chunks=None)


class _Read(Mapping[str, np.ndarray]):
    """The fields of a store, read when they are asked for."""

    def __init__(self, store: EnsembleStore) -> None:
        self.store, self.layout = store, store.layout

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.layout.fields:
            raise KeyError(name)
        return self.store.read(name)

    def __contains__(self, name: object) -> bool:
        return name in self.layout.fields

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.fields)

    def __len__(self) -> int:
        return len(self.layout.fields)


def _chunk_shape(store: Store, layout: Layout) -> Index:
    """The shape of the chunks of orbits of a store, which is none larger than all orbits."""
    sizes = store.attributes.get("chunk_shape")
    if not isinstance(sizes, list) or len(sizes) != len(layout.shape):
        raise store.damaged("its chunk_shape is missing")
    if not all(isinstance(k, int) and 1 <= k <= n for k, n in zip(sizes, layout.shape, strict=True)):
        raise store.damaged(f"its chunk_shape {sizes} does not fit {layout.shape} orbits")
    return tuple(sizes)
