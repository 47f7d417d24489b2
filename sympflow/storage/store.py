"""Stores: named arrays with dimensions and attributes in a folder, in the format of zarr, version 2.

A store is written here and not by the zarr library because of three guarantees:

- A chunk is a file of its own, written beside its place and moved there: it is complete or absent, and different
  processes write different chunks. Each has a checksum (zlib's, of data that it stores as they are).
- Arrays grow, and attributes change, by the replacement of one file, ``.zmetadata``, the consolidated metadata that
  readers take: `Store.commit`. A program that is killed at any moment leaves the store of the last commit.
- Nothing is imported for it: a worker that writes chunks needs neither zarr nor xarray.

A store is not trusted: names in it are never used as paths, no folder of it may be a link, its contents are compared
with the call that opens it, and nothing is unpacked beyond the size of that call.

`xarray.open_zarr(path)` and `zarr.open_group(path)` read a store.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import re
import shutil
import uuid
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import product
from math import prod
from operator import attrgetter
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from sympflow.arguments import put_file
from sympflow.storage.identity import Known

__all__ = ["Appender", "Field", "Store", "StoreError"]

METADATA, ATTRIBUTES, ARRAY = ".zmetadata", ".zattrs", ".zarray"
KEPT = "sympflow_state"  # the attribute that names the file of the state which was kept at the last commit
TOLD = 90  # characters of what differs between two calls
STATE = re.compile(r"\.state-([1-9]\d{0,17})\.npz")
MOST_METADATA = 2**26  # bytes
MOST_STATES = 64  # bytes that are kept to go on, over those of a chunk of each array
STORABLE = "biufc"  # kinds of dtypes that a store takes: truth values and numbers


class StoreError(OSError):
    """A store that cannot be read or written, as on a full disk; committed data are kept."""


@dataclass(frozen=True)
class Field:
    """An array of a store, of numbers or truth values; fields that share a dimension have the same length along it.

    `chunks` is by default the whole array. `missing` is the number where nothing has been written, which a reader of
    zarr may show as NaN; the default is NaN, or 0 of other numbers than floats.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: Any = float
    chunks: tuple[int, ...] | Any = None  # None for the whole array
    attributes: Mapping[str, Any] = field(default_factory=dict)
    missing: int | None = None

    def __post_init__(self) -> None:
        if not len(self.dims) == len(self.shape) == len(self.chunks or self.shape):
            raise ValueError(f"`dims` {self.dims}, `shape` {self.shape} and `chunks` {self.chunks} must agree.")
        if np.dtype(self.dtype).kind not in STORABLE:
            raise TypeError(f"`dtype` {np.dtype(self.dtype)} is not numeric, and a store takes numbers: convert them.")
        if not all(isinstance(n, int | np.integer) and n >= 0 for n in (*self.shape, *(self.chunks or ()))):
            raise ValueError(f"`shape` {self.shape} and `chunks` {self.chunks} must be whole numbers, 0 or more.")
        chunks = self.shape if self.chunks is None else self.chunks
        object.__setattr__(self, "dtype", np.dtype(self.dtype).newbyteorder("<"))
        object.__setattr__(self, "chunks", tuple(max(1, int(n)) for n in chunks))

    @property
    def grid(self) -> tuple[int, ...]:
        """The number of chunks along each dimension."""
        return tuple(-(-n // size) for n, size in zip(self.shape, self.chunks, strict=True))

    def region(self, index: tuple[int, ...]) -> tuple[slice, ...]:
        """Return where in the array a chunk lies."""
        ends = zip(index, self.chunks, self.shape, strict=True)
        return tuple(slice(i * size, min((i + 1) * size, n)) for i, size, n in ends)

    def metadata(self) -> dict[str, Any]:
        """Return the array as zarr describes it."""
        return {
            "zarr_format": 2,
            "shape": list(self.shape),
            "chunks": list(self.chunks or ()),
            "dtype": self.dtype.str,
            "compressor": {"id": "zlib", "level": 0},
            "fill_value": "NaN" if self.dtype.kind == "f" else self.missing,
            "order": "C",
            "filters": None,
        }

    @classmethod
    def read(cls, metadata: Mapping[str, Any], attributes: Mapping[str, Any]) -> Field:
        """Return the field that zarr describes so."""
        own = {name: value for name, value in attributes.items() if name != "_ARRAY_DIMENSIONS"}
        shape, chunks = tuple(metadata["shape"]), tuple(metadata["chunks"])
        fill = metadata["fill_value"]
        missing = fill if isinstance(fill, int) else None
        known = cls(tuple(attributes["_ARRAY_DIMENSIONS"]), shape, np.dtype(metadata["dtype"]), chunks, own, missing)
        own_layout = {"dimension_separator": ".", **known.metadata()}
        if any(metadata.get(key, ".") != value for key, value in own_layout.items()):
            raise ValueError("an array is laid out otherwise than here")
        return known

    @property
    def filled(self) -> float:
        """The number where nothing has been written."""
        return np.nan if self.dtype.kind == "f" else self.missing or 0


class Store:
    """A store that exists, with fields and attributes of its last commit: make one by `create`, or `open` it."""

    def __init__(self, path: Path, fields: dict[str, Field], attributes: dict[str, Any]) -> None:
        self.path, self.fields, self.attributes = path, fields, attributes

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        fields: Mapping[str, Field],
        attributes: Mapping[str, Any],
        values: Mapping[str, np.ndarray] | None = None,
    ) -> Store:
        """Make a store, with the values of some arrays of one chunk; the others have none.

        It is written under another name and renamed: it is complete or absent.
        """
        place = Path(path)
        for name in fields:
            if not is_name(name):
                raise ValueError(f"`store` cannot have an array {name!r}: rename it, to letters, digits and _.")
        exists = FileExistsError(f"`store` {str(place)!r} exists.")
        if _is_taken(place):
            raise exists
        unfinished = place.with_name(f".{place.name}.{uuid.uuid4().hex[:8]}.new")
        store = cls(unfinished, dict(fields), {})
        try:
            with _told(place):
                unfinished.mkdir(parents=True)
                for name in fields:
                    (unfinished / name).mkdir()
                put_file(unfinished / ".zgroup", b'{"zarr_format": 2}')
                for name, array in (values or {}).items():
                    store.write(name, (0,) * np.ndim(array), array)
                store.commit(attributes=attributes)
                os.rename(unfinished, place)
        except OSError as error:
            shutil.rmtree(unfinished, ignore_errors=True)
            if _is_taken(place):  # by another process, meanwhile
                raise exists from None
            with _told(place):
                raise (error.__cause__ if isinstance(error.__cause__, OSError) else error) from None
        store.path = place
        return store

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Store:
        """Open a store as its last commit left it."""
        place = Path(path)
        try:
            found = json.loads(_read(place / METADATA, MOST_METADATA))["metadata"]
            names = [key.removesuffix(f"/{ARRAY}") for key in found if key.endswith(f"/{ARRAY}")]
            fields = {name: Field.read(found[f"{name}/{ARRAY}"], found[f"{name}/{ATTRIBUTES}"]) for name in names}
            attributes = dict(found[ATTRIBUTES])
            strange = [name for name in names if not is_name(name)]
            if strange or not STATE.fullmatch(attributes.get(KEPT, ".state-1.npz")):
                raise ValueError(f"a path in place of a name, {(strange or [attributes.get(KEPT)])[0]!r}")
            with os.scandir(place) as entries:
                if links := [entry.name for entry in entries if entry.is_symlink() and entry.is_dir()]:
                    raise ValueError(f"{links[0]!r} is a link to elsewhere")
            return cls(place, fields, attributes)
        except FileNotFoundError:
            if (place / ".zgroup").exists():
                raise ValueError(
                    f"`store` {str(place)!r} has no {METADATA}, the metadata of all its arrays, which sympflow writes: "
                    "write it by zarr.consolidate_metadata(path), or give another place."
                ) from None
            if place.exists():
                raise ValueError(f"`store` {str(place)!r} is not a store of sympflow: give another place.") from None
            raise FileNotFoundError(f"`store` {str(place)!r} does not exist.") from None
        except (ValueError, KeyError, TypeError, AttributeError, NotADirectoryError, RecursionError) as error:
            raise ValueError(f"`store` {str(place)!r} is not a store of sympflow: give another place.") from error

    def check_same(self, key: str, mine: Known, asked: str, kind: str, remedy: str, same: bool) -> None:
        """Check that a store belongs to the call that opens it."""
        try:
            theirs = json.loads(self.attributes[key])
        except (KeyError, TypeError, ValueError):
            theirs = None
        if not isinstance(theirs, dict):
            article = "an" if kind[0] in "aeiou" else "a"
            raise ValueError(f"`store` {asked!r} is not a store of {article} {kind}: name another folder.")
        known = {name: text for name, text in mine.texts.items() if not (same and name in mine.python)}
        if other := difference(theirs, known):
            name = other.split("`")[1]
            vouched = f" If the code of `{name}` means the same, pass same=True." * (name in mine.python)
            raise ValueError(f"`store` {asked!r} is of another {kind}: {other}. {remedy}{vouched}")
        if mine.untold and not same:
            name, part = next(iter(mine.untold.items()))
            raise ValueError(
                f"`store` {asked!r} may be of another {kind}: `{name}` holds {part}, which cannot be distinguished "
                "from others. Pass same=True if all is the same, or name another folder."
            )

    def check_made_of(self, fields: Mapping[str, Field]) -> None:
        """Check that the arrays belong to the call that opens the store."""
        alike = attrgetter("dims", "shape", "dtype", "chunks")
        for name in {**fields, **self.fields}:
            if name in self.fields and not (name in fields and alike(fields[name]) == alike(self.fields[name])):
                raise self.damaged(f"its array {name!r} is not one that the call makes")
            if name not in self.fields or not (self.path / name).is_dir():
                raise self.damaged(f"its array {name!r} is missing")

    def damaged(self, why: str) -> StoreError:
        """Return the error that describes the damage of the store."""
        return StoreError(f"`store` {str(self.path)!r} is damaged: {why}. Give another place, or a copy of it.")

    def _file(self, name: str, index: tuple[int, ...]) -> Path:
        return self.path / name / (".".join(map(str, index)) or "0")

    def has(self, name: str, index: tuple[int, ...]) -> bool:
        """Return True if a chunk has been written."""
        return self._file(name, index).exists()

    def write(self, name: str, index: tuple[int, ...], values: np.ndarray) -> None:
        """Write one chunk; at the edge of the array, or of one that is to grow, `values` may be smaller than a chunk.

        Raises
        ------
        ValueError
            If the values do not fit into the chunk.
        StoreError
            If they cannot be written, as on a full disk.
        """
        known, values = self.fields[name], np.asarray(values)
        if values.ndim != len(known.chunks) or (np.array(values.shape) > known.chunks).any():
            raise ValueError(f"`values` of shape {values.shape} are not a chunk of {name!r}, of shape {known.chunks}.")
        if values.shape == known.chunks:
            chunk = np.ascontiguousarray(values, dtype=known.dtype)
        else:
            chunk = np.full(known.chunks, known.filled, dtype=known.dtype)
            chunk[tuple(map(slice, values.shape))] = values
        with _told(self.path):
            put_file(self._file(name, index), zlib.compress(chunk.data, 0))

    def write_text(self, name: str, text: str) -> None:
        """Write a file beside the arrays, whole or not at all."""
        with _told(self.path):
            put_file(self.path / name, text.encode())

    def read(self, name: str, index: tuple[int, ...] | None = None) -> np.ndarray:
        """Return a chunk, or the whole array; `Field.filled` where nothing has been written."""
        known = self.fields[name]
        if index is None:
            whole = np.empty(known.shape, known.dtype)
            for i in product(*map(range, known.grid)):
                whole[known.region(i)] = self.read(name, i)
            return whole
        shape = tuple(part.stop - part.start for part in known.region(index))
        size = prod(known.chunks) * known.dtype.itemsize
        try:
            unpacked = zlib.decompressobj()
            data = unpacked.decompress(_read(self._file(name, index), size + size // 64 + 1024), size + 1)
            if len(data) != size or not unpacked.eof:
                raise ValueError("another length")
        except FileNotFoundError:
            return np.full(shape, known.filled, dtype=known.dtype)
        except (zlib.error, ValueError) as error:
            raise self.damaged(f"{self._file(name, index).name} of {name!r} ({error})") from None
        return np.frombuffer(data, known.dtype).reshape(known.chunks)[tuple(map(slice, shape))]

    def committed(self, name: str, index: tuple[int, ...]) -> np.ndarray:
        """Return a chunk that a commit has counted; see `read`."""
        if not self.has(name, index):
            raise self.damaged(f"{self._file(name, index).name} of {name!r} is missing")
        return self.read(name, index)

    def commit(
        self,
        lengths: Mapping[str, int] | None = None,
        attributes: Mapping[str, Any] | None = None,
        state: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Set the lengths of dimensions, attributes, and the state to go on from, all at once or not at all."""
        fields, lengths = dict(self.fields), lengths or {}
        for name, known in fields.items():
            shape = tuple(lengths.get(dim, n) for dim, n in zip(known.dims, known.shape, strict=True))
            fields[name] = replace(known, shape=shape)
        changed = self.attributes | dict(attributes or {})
        before = self.attributes.get(KEPT)
        with _told(self.path):
            if state is not None:
                last = STATE.fullmatch(before or "")
                changed[KEPT] = f".state-{1 + int(last[1]) if last else 1}.npz"
                buffer = io.BytesIO()
                np.savez(buffer, **dict(state))  # type: ignore[arg-type]
                put_file(self.path / changed[KEPT], buffer.getvalue())
            described: dict[str, Any] = {".zgroup": {"zarr_format": 2}, ATTRIBUTES: changed}
            for name, known in fields.items():
                described[f"{name}/{ARRAY}"] = known.metadata()
                described[f"{name}/{ATTRIBUTES}"] = {"_ARRAY_DIMENSIONS": list(known.dims), **known.attributes}
            put_file(self.path / METADATA, _json({"metadata": described, "zarr_consolidated_format": 1}))
            self.fields, self.attributes = fields, changed
            for key, value in described.items():  # for readers that do not take consolidated metadata
                put_file(self.path / key, _json(value), durable=False)
            if state is not None and before:
                (self.path / before).unlink(missing_ok=True)

    def complete(self, name: str) -> None:
        """Note that all of an array has been written."""
        if self.fields[name].missing is not None:
            self.fields[name] = replace(self.fields[name], missing=None)
            self.commit()

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays that the last commit kept; {} if it kept none."""
        name = self.attributes.get(KEPT)
        if name is None:
            return {}
        try:
            held = sum(prod(known.chunks or ()) * known.dtype.itemsize for known in self.fields.values())
            return read_arrays(self.path / name, MOST_METADATA + MOST_STATES * held)
        except (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
            raise self.damaged(f"its state cannot be read ({error})") from None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing a store that grows; the system takes the lock of one that is killed."""
        try:
            import fcntl
        except ImportError:  # Windows, where an open file is not replaced anyway
            yield
            return
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
        with _told(self.path):
            opened = os.open(self.path / ".lock", flags, 0o644)
        with open(opened, "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(
                    f"`store` {str(self.path)!r} is being written by another process: wait for it, or give another "
                    "place."
                ) from None
            except OSError:  # a file system without locks
                pass
            yield

    def remove(self) -> None:
        """Delete the store."""
        shutil.rmtree(self.path)


class Appender:
    """Records that are appended to a store along one dimension; a chunk that is not full yet is kept in memory."""

    def __init__(self, store: Store, dim: str) -> None:
        self.store, self.dim = store, dim
        self.axes = {name: known.dims.index(dim) for name, known in store.fields.items() if dim in known.dims}
        name, axis = next(iter(self.axes.items()))
        known = store.fields[name]
        self.size, self.length = known.chunks[axis], known.shape[axis]
        self.tails: dict[str, list[np.ndarray]] = {name: [] for name in self.axes}
        self.held = self.length % self.size
        if self.held:  # the last chunk, up to what was committed
            for name in self.axes:
                self.tails[name].append(store.committed(name, self._index(name, self.length // self.size)))

    def _index(self, name: str, k: int) -> tuple[int, ...]:
        """The chunk k along the dimension; along the others there is one."""
        axis = self.axes[name]
        return tuple(k if i == axis else 0 for i in range(len(self.store.fields[name].dims)))

    def append(self, records: Mapping[str, np.ndarray]) -> None:
        """Append arrays, one for each field that grows, of one length along the dimension."""
        n = next(records[name].shape[axis] for name, axis in self.axes.items())
        for name in self.axes:
            self.tails[name].append(np.asarray(records[name]))
        self.held += n
        self.length += n
        if self.held >= self.size:
            self._write(self.held // self.size)

    def _write(self, n_chunks: int) -> None:
        """Write full chunks, and keep what is left."""
        first = (self.length - self.held) // self.size
        for name, axis in self.axes.items():
            ends = range(self.size, n_chunks * self.size + 1, self.size)
            *full, rest = np.split(np.concatenate(self.tails[name], axis=axis), ends, axis=axis)
            for k, part in enumerate(full):
                self.store.write(name, self._index(name, first + k), part)
            self.tails[name] = [rest.copy()]
        self.held -= n_chunks * self.size

    def commit(
        self, attributes: Mapping[str, Any] | None = None, state: Mapping[str, np.ndarray] | None = None
    ) -> None:
        """Write what is in memory, and commit the store with its new length: see `Store.commit`."""
        if self.held:
            k = self.length // self.size
            for name, axis in self.axes.items():
                tail = np.concatenate(self.tails[name], axis=axis)
                self.tails[name] = [tail]
                self.store.write(name, self._index(name, k), tail)
        self.store.commit({self.dim: self.length}, attributes, state)


def is_name(name: Any) -> bool:
    """Return True for a name of an array: no path, and not hidden."""
    if not isinstance(name, str) or name.startswith(".") or not name.isprintable():
        return False
    return PurePath(name).name == name != "" and "\\" not in name


def read_arrays(file: Path, most: int) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file; neither the file nor one of its arrays is larger than so many bytes."""
    arrays = {}
    if file.stat().st_size > most:
        raise ValueError(f"more than {most:,} bytes")
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{member.filename} is packed")
            content = io.BytesIO(archive.read(member))
            if np.lib.format.read_magic(content) != (1, 0):
                raise ValueError("an array of another format")
            shape, _, dtype = np.lib.format.read_array_header_1_0(content)
            if prod(shape) * dtype.itemsize != member.file_size - content.tell():
                raise ValueError(f"{member.filename} has another length")
            content.seek(0)
            arrays[member.filename.removesuffix(".npy")] = np.load(content, allow_pickle=False)
    return arrays


def difference(theirs: Mapping[str, str], mine: Mapping[str, str]) -> str:
    """Return what differs first between the texts of a store and of a call, cut to where it does; "" if nothing."""
    for name, text in mine.items():
        other = theirs.get(name, text)
        if other != text:
            same = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(other, text, strict=False)))
            start = max(0, same - TOLD // 2) if max(len(other), len(text)) > TOLD else 0
            told = (f"{'...' * (start > 0)}{x[start : start + TOLD]}" for x in (other, text))
            return f"its `{name}` is {', not '.join(told)}"
    return ""


def _json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False, indent=1).encode()


def _read(path: Path, most: int) -> bytes:
    """The content of a file; a ValueError if it has more bytes than that."""
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"more than {most:,} bytes")
    return content


def _is_taken(place: Path) -> bool:
    return place.exists() and (not place.is_dir() or any(place.iterdir()))


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Say which store could not be written."""
    try:
        yield
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(
            f"`store` {str(path)!r} cannot be written ({error.strerror or error}): what was committed is kept. Free "
            "some space, or remove that cause, and resume."
        ) from error
