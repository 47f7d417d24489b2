"""Stores of single calls of `solve`: outputs as they come, and the place from which the run goes on.

A store is that of `sympflow.storage.store`, in the layout of `sympflow.storage.layout`; `xarray.open_zarr` reads it
while the run is under way too. Each commit holds the outputs up to the place that it holds, so that a program that is
killed at any moment goes on from the last commit, with the same bits.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sympflow.arguments import check_flag, checked_number
from sympflow.storage.identity import Known
from sympflow.storage.layout import DOF, NAMED, TIME, batch_dims, dofs, halves
from sympflow.storage.store import Appender, Field, Store

KNOWN = "sympflow_run"  # the attribute that says of which run a store is
SECONDS = 10.0  # between two commits, by default
CHUNK = 2**19  # numbers in a chunk of q and p together, about


@dataclass
class Place:
    """The place that a run has reached: steps, the running state of its loops, the last finite steps, and states."""

    steps: int
    running: np.ndarray  # the running state of its loops: see `kernels.protocol.RunCheckpoint`
    finite: np.ndarray  # (…): the last finite step of each trajectory
    state: np.ndarray  # (…, K): the states after `steps` steps, of those that may be saved
    failed: np.ndarray  # (…): true where an output within a step was not finite
    counts: dict[str, Any] = field(default_factory=dict)  # of outputs, of what was saved, and statistics, as JSON

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the place as arrays."""
        own = {name: np.asarray(getattr(self, name)) for name in ("steps", "running", "finite", "state", "failed")}
        return own | {"counts": np.array(json.dumps(self.counts, default=np.ndarray.tolist))}

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray], batch: tuple[int, ...]) -> Place:
        """Return the place that arrays stand for, of trajectories of a batch."""
        steps, counts = int(arrays["steps"]), json.loads(str(arrays["counts"]))
        place = cls(steps, arrays["running"], arrays["finite"], arrays["state"], arrays["failed"], counts)
        kinds = place.running.dtype.kind + place.finite.dtype.kind + place.state.dtype.kind + place.failed.dtype.kind
        shapes = [place.running.shape[:-1], place.finite.shape, place.state.shape[:-1], place.failed.shape]
        if steps < 0 or kinds != "fifb" or any(shape != batch for shape in shapes):
            raise ValueError(f"its arrays do not fit {steps} steps of trajectories {batch}")
        if not (isinstance(counts["stats"], dict) and isinstance(counts["noted"], dict)):
            raise ValueError("its counts are missing")
        return place


class RunStore:
    """The store of one call of `solve`, in the folder `path`; made or opened by `opened`.

    It holds `length` outputs, those among them that are not committed; `consistent` is False while outputs are being
    taken. `project` makes states (..., 2d) of those (..., K) on which steps are made. `noted` are the largest numbers
    that the method noted, and `domain_exit` and `warning` of an output outside the domain.
    """

    def __init__(self, path: Any, resume: Any = False, checkpoint_every: Any = None, same: Any = False) -> None:
        if isinstance(path, bytes) or not isinstance(path, str | os.PathLike):
            raise TypeError(f"`store` must be the path of a folder; got {type(path).__name__}.")
        check_flag("resume", resume)
        check_flag("same", same)
        every = SECONDS if checkpoint_every is None else checkpoint_every
        checked_number("checkpoint_every", every, "a positive number of seconds", lambda x: x > 0)
        self.asked, self.path = str(path), Path(os.path.abspath(os.fspath(path)))
        self.resume, self.same, self.every = bool(resume), bool(same), float(every)
        self.consistent, self.committed = True, time.perf_counter()
        self.noted: dict[str, Any] = {}
        self.attributes: dict[str, Any] = {}
        self._made_of: tuple[Known, np.ndarray, int]
        self.store: Store
        self.appender: Appender
        self.project: Callable[[Any], Any] = _itself
        self.look: Callable[[np.ndarray, np.ndarray], None] = _nothing

    def prepare(self, known: Known, attributes: Mapping[str, Any], y0: np.ndarray, n_outputs: int) -> None:
        """Take what the store is to be made of."""
        self.attributes = dict(attributes)
        self._made_of = known, y0, n_outputs

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Make the store, or open the one that is there, which no other process can write then."""
        known, y0, n_outputs = self._made_of
        try:
            self.store = self._create(known, y0, n_outputs)
        except FileExistsError:
            if not self.resume:
                raise ValueError(
                    f"`store` {self.asked!r} exists: pass resume=True to go on with it, or name another folder."
                ) from None
            self.store = Store.open(self.path)
            remedy = "Nothing of it was changed: name another folder, or make the same call."
            self.store.check_same(KNOWN, known, self.asked, "run", remedy, self.same)
        try:
            with self.store.locked():
                self.store = Store.open(self.path)  # as it is now that nobody else writes it
                self._check(y0)
                self.appender = Appender(self.store, TIME)
                self.committed = time.perf_counter()
                yield
        finally:
            self.look, self.project = _nothing, _itself
            vars(self).pop("appender", None)

    def _check(self, y0: np.ndarray) -> None:
        """Check that all is there that makes a store of a run from y0."""
        store, growing = self.store, self.store.fields.get(TIME)
        missing = [name for name in ("status", "ended", "message") if name not in store.attributes]
        if missing or growing is None or growing.chunks is None or len(growing.shape) != 1:
            raise store.damaged(f"its {(*missing, TIME)[0]} is missing")
        if growing.chunks[0] > max(1, CHUNK // y0.size):
            raise store.damaged(f"its chunks of {growing.chunks[0]:,} times are larger than any of such a run")
        store.check_made_of(_fields(y0, growing.chunks[0], growing.shape[0]))
        for name in (DOF, "status", "q0", "p0"):
            store.committed(name, (0,) * len(store.fields[name].shape))

    def _create(self, known: Known, y0: np.ndarray, n_outputs: int) -> Store:
        """Make the store; a FileExistsError says that there is something in its place."""
        batch, d = y0.shape[:-1], y0.shape[-1] // 2
        made = _fields(y0, max(1, min(CHUNK // y0.size, n_outputs)))
        told = {
            **self.attributes,
            KNOWN: json.dumps(known.texts),
            "status": -1,
            "ended": 0,
            "message": "The run has begun.",
        }
        values = {DOF: dofs(d), "status": np.full(batch, -1)}
        values |= {f"{letter}0": y0[..., rows] for letter, rows in halves(d)}
        return Store.create(self.path, made, told, values)

    @property
    def length(self) -> int:
        return self.appender.length

    @property
    def ended(self) -> bool:
        """True if the run reached its end, or failed."""
        return bool(self.store.attributes["ended"])

    @property
    def message(self) -> str:
        """Message of the run: how it ended, or where it is."""
        return str(self.store.attributes["message"])

    def place(self) -> Place | None:
        """Return the place from which the run goes on; None at its beginning."""
        arrays = self.store.state()
        if not arrays:
            return None
        try:
            place = Place.read(arrays, self.store.fields["status"].shape)
        except (KeyError, TypeError, ValueError) as error:
            raise self.store.damaged(f"its state is not that of a run ({error})") from None
        self.noted = dict(place.counts["noted"])
        return place

    def times(self, first: int = 0) -> np.ndarray:
        """Return the times of the committed outputs from a number on."""
        return self._read((TIME,), (), first)

    def states(self, first: int = 0) -> np.ndarray:
        """Return the states (..., 2d, n) of the committed outputs from a number on."""
        return self._read(("q", "p"), self.store.fields["q0"].shape[:-1], first)

    def status(self) -> Any:
        """Return the status of each trajectory."""
        found = self.store.committed("status", (0,) * len(self.store.fields["status"].shape)).astype(int)
        return found if found.ndim else int(found)

    def _read(self, names: tuple[str, ...], batch: tuple[int, ...], first: int) -> np.ndarray:
        fields = self.store.fields
        n, size = fields[TIME].shape[0], fields[TIME].chunks[0]
        width = () if names == (TIME,) else (sum(fields[name].shape[-2] for name in names),)
        whole = np.empty((*batch, *width, n - first), fields[names[0]].dtype)
        row = 0
        for name in names:
            rows = (slice(row, row + fields[name].shape[-2]),) if width else ()
            for k in range(first // size, -(-n // size)):
                part = self.store.committed(name, (*(0,) * (fields[name].dims.index(TIME)), k))
                a = k * size
                skip = max(0, first - a)
                whole[(..., *rows, slice(a + skip - first, a - first + part.shape[-1]))] = part[..., skip:]
            row += fields[name].shape[-2] if width else 0
        return whole

    def truncate(self, length: int) -> None:
        """Leave out the last outputs, as those of an end that is no longer one."""
        self.store.commit({TIME: length})
        self.appender = Appender(self.store, TIME)

    def append(self, t: np.ndarray, y: np.ndarray) -> None:
        """Take outputs y (n, ..., K) at times t (n,)."""
        if not len(t):
            return
        self.consistent = False
        y = self.project(y)
        self.look(t, y)
        records = {TIME: t} | {v: np.moveaxis(y[..., rows], 0, -1) for v, rows in halves(y.shape[-1] // 2)}
        self.appender.append(records)
        self.consistent = True

    def note(self, **numbers: float) -> None:
        """Keep the largest of numbers by their names."""
        for name, x in numbers.items():
            self.noted[name] = max(x, self.noted.get(name, x))

    @property
    def due(self) -> bool:
        """True if a commit is due."""
        return time.perf_counter() - self.committed >= self.every

    def commit(self, place: Place, attributes: Mapping[str, Any]) -> None:
        """Write what is not written, with the place that the run has reached."""
        place.counts["noted"] = self.noted
        self.appender.commit({**self.attributes, **attributes}, place.arrays())
        self.committed = time.perf_counter()

    def finish(self, place: Place, status: Any, message: str) -> None:
        """Commit the end of the run."""
        known = self.store.fields["status"]
        self.store.write("status", (0,) * len(known.shape), np.broadcast_to(status, known.shape))
        self.commit(place, {"status": int(np.min(status)), "message": message, "ended": 1})


def _fields(y0: np.ndarray, size: int, n: int = 0) -> dict[str, Field]:
    """The arrays of a run of n outputs, with chunks of so many times."""
    batch, d = y0.shape[:-1], y0.shape[-1] // 2
    dims = batch_dims(batch)
    made = {TIME: Field((TIME,), (n,), float, (size,)), DOF: Field((DOF,), (d,), int, attributes=NAMED[DOF])}
    for letter, _ in halves(d):
        made[letter] = Field((*dims, DOF, TIME), (*batch, d, n), y0.dtype, (*batch, d, size), NAMED[letter])
        made[f"{letter}0"] = Field((*dims, DOF), (*batch, d), y0.dtype, attributes=NAMED[f"{letter}0"])
    return made | {"status": Field(dims, batch, np.int8, attributes=NAMED["status"])}


def _itself(y: Any) -> Any:
    return y


def _nothing(t: np.ndarray, y: np.ndarray) -> None:
    return None
