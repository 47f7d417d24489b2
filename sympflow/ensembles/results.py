"""The result of an ensemble: the fields of each orbit, in memory or in a store, and their xarray Dataset."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sympflow.ensembles.orbits import Drawn, Given
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.contract import Integrator, method_text
from sympflow.show.cards import Answering, Card, numbers
from sympflow.show.pictures import histogram_figure, points_figure
from sympflow.show.style import saved
from sympflow.storage import layout as names
from sympflow.storage.layout import DOF, ORBIT, TIME, axis_name, halves, imported
from sympflow.storage.store import STORABLE, Field, is_name

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

    from sympflow.ensembles.reductions import Fields

Index = tuple[int, ...]


@dataclass(frozen=True)
class Block:
    """A block of the grid of parameters and orbits: its ranges, one an axis; in C order its orbits are consecutive."""

    ranges: tuple[tuple[int, int], ...]
    first: int

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def index(self) -> tuple[slice, ...]:
        return tuple(slice(*ends) for ends in self.ranges)

    @property
    def shape(self) -> Index:
        return tuple(stop - start for start, stop in self.ranges)


def chunk_shape(shape: Index, chunk: int) -> Index:
    """The shape of a block of at most `chunk` orbits: whole axes at the end, a part of one before them."""
    lengths, left = [], chunk
    for length in reversed(shape):
        lengths.append(min(length, max(1, left)))
        left = left // length
    return tuple(reversed(lengths))


def blocks(shape: Index, sizes: Index) -> list[Block]:
    """The blocks of a grid, in C order."""
    axes = [[(i, min(i + k, n)) for i in range(0, n, k)] for n, k in zip(shape, sizes, strict=True)]
    places = ((ranges, np.ravel_multi_index([start for start, _ in ranges], shape)) for ranges in product(*axes))
    return [Block(ranges, int(place)) for ranges, place in places]


@dataclass(frozen=True)
class Done:
    """The fields (n, ...) of the orbits of a block, their statuses (n,), and the messages of those that failed."""

    fields: dict[str, np.ndarray]
    status: np.ndarray
    messages: dict[int, str]


@dataclass(frozen=True)
class Variable:
    """An array of a Dataset or a store: a field of each orbit, or some rows of it."""

    name: str
    field: str
    rows: slice | None
    dims: tuple[str, ...]
    shape: Index
    dtype: np.dtype

    def of(self, values: np.ndarray, leading: int) -> np.ndarray:
        """Return its part of the values of its field, with so many axes before those of an orbit."""
        return values if self.rows is None else values[(slice(None),) * leading + (self.rows,)]


@dataclass(frozen=True)
class Layout:
    """The axes of an ensemble, `n` orbits at each of their values, and the fields that are kept of each orbit.

    `state` is the field that holds states [q, p] along its first axis; "" if there is none.
    """

    axes: dict[str, np.ndarray]
    n: int
    ndof: int
    times: np.ndarray | None
    fields: Fields
    state: str

    def __post_init__(self) -> None:
        own = {*names.RESERVED, *self.axes, *dir(Ensemble), *Ensemble.__dataclass_fields__}
        taken = [name for name in self.fields if name in own]
        if taken:
            raise ValueError(f"`reduce` returns {taken[0]!r}, a name that the result has already: take another one.")

    @property
    def shape(self) -> Index:
        return (*(len(values) for values in self.axes.values()), self.n)

    @property
    def dims(self) -> tuple[str, ...]:
        return (*map(axis_name, self.axes), ORBIT)

    def variables(self) -> list[Variable]:
        """Return the arrays that hold the fields: states as q and p, with dimensions dof and time."""
        found = []
        for name, (shape, dtype) in self.fields.items():
            if name == self.state:
                more = (TIME,) * (len(shape) - 1)
                for letter, rows in halves(self.ndof):
                    inner = (self.ndof, *shape[1:])
                    found.append(Variable(letter, name, rows, (*self.dims, DOF, *more), inner, dtype))
            else:
                inner_dims = tuple(f"{name}_{i}" for i in range(len(shape)))
                found.append(Variable(name, name, None, (*self.dims, *inner_dims), shape, dtype))
        return found

    def coordinates(self) -> dict[str, np.ndarray]:
        """Return the values along dimensions, by the names of these."""
        found = {**{axis_name(name): values for name, values in self.axes.items()}, DOF: names.dofs(self.ndof)}
        if self.state and len(self.fields[self.state][0]) == 2 and self.times is not None:
            found[TIME] = self.times
        return found

    def stored(self, sizes: Index) -> dict[str, Field]:
        """Return the arrays of a store with chunks of such a shape along the axes."""
        for name, (_, dtype) in self.fields.items():
            if not is_name(name):
                raise ValueError(
                    f"`reduce` returns {name!r}, which cannot be the name of an array in a `store`: rename it."
                )
            if dtype.kind not in STORABLE:
                raise TypeError(f"`reduce` returns {name!r} of {dtype}, and a `store` takes numbers: convert them.")
        made = {v.name: (v.dims, (*self.shape, *v.shape), v.dtype, (*sizes, *v.shape)) for v in self.variables()}
        for name in ("q0", "p0"):
            made[name] = ((ORBIT, DOF), (self.n, self.ndof), np.dtype(float), (sizes[-1], self.ndof))
        made["status"] = (self.dims, self.shape, np.dtype(np.int8), sizes)
        for name, values in self.coordinates().items():
            made[name] = ((name,), values.shape, values.dtype, values.shape)
        told: dict[str, Any] = {name: {"attributes": names.NAMED.get(name, {})} for name in made}
        told["status"]["missing"] = NOT_RUN
        return {name: Field(*array, **told[name]) for name, array in made.items()}


MOST_SHOWN = 10_000_000  # numbers of an ensemble beyond which a notebook shows no figure of it
NOT_RUN = 2  # the status of orbits of a store that have not been run yet


class Keeper(Protocol):
    """The place where the fields of an ensemble are kept."""

    @property
    def fields(self) -> Mapping[str, np.ndarray]: ...
    @property
    def status(self) -> np.ndarray: ...
    @property
    def messages(self) -> Mapping[Index, str]: ...
    def place(self, block: Block, done: Done) -> None:
        """Put the orbits of a block where they belong."""

    def finish(self) -> None:
        """Note that all orbits are there."""

    def is_done(self, block: Block) -> bool:
        """True if the orbits of a block are there already."""

    def dataset(self) -> xarray.Dataset: ...


class Memory:
    """Fields in the memory of this process."""

    def __init__(self, layout: Layout, orbits: Given | Drawn, attributes: Callable[[], Mapping[str, Any]]) -> None:
        self.layout, self.orbits, self.attributes = layout, orbits, attributes
        self.fields = {name: np.empty((*layout.shape, *s), dtype) for name, (s, dtype) in layout.fields.items()}
        self.status = np.zeros(layout.shape, dtype=np.int8)
        self.messages: dict[Index, str] = {}

    def finish(self) -> None:
        """Note that all orbits are there."""

    def is_done(self, block: Block) -> bool:
        return False

    def place(self, block: Block, done: Done) -> None:
        for name, values in done.fields.items():
            self.fields[name][block.index] = values.reshape(*block.shape, *values.shape[1:])
        self.status[block.index] = done.status.reshape(block.shape)
        for row, text in done.messages.items():
            index = np.unravel_index(block.first + row, self.layout.shape)
            self.messages[tuple(map(int, index))] = text

    def dataset(self) -> xarray.Dataset:
        xr, layout = imported("xarray", "to_xarray()"), self.layout
        leading = len(layout.shape)
        data = {v.name: (v.dims, v.of(self.fields[v.field], leading)) for v in layout.variables()}
        data["status"] = (layout.dims, self.status)
        y0 = self.orbits.states(0, layout.n)
        data |= {f"{letter}0": ((ORBIT, DOF), y0[:, rows]) for letter, rows in halves(layout.ndof)}
        coords = {name: (name, values) for name, values in layout.coordinates().items()}
        return xr.Dataset(names.described(data), coords=names.described(coords), attrs=dict(self.attributes()))


@dataclass(repr=False)
class Ensemble(Answering):
    """The result of `ensemble`.

    Every field that was kept of the orbits is an attribute: `y` without `reduce`, else the fields of `reduce`. An
    axis stands in front of that of the orbits for each of `params` that is an array. From a `store` a field is read at
    each access.

    Attributes
    ----------
    t : ndarray of shape (m,) or None
        The times of `t_eval`, or of every step.
    y : ndarray of shape (..., N, 2d, m)
        The states, where nothing was reduced.
    params : dict of str to ndarray
        The axes of the grid of parameters.
    system, integrator, t_span
        The problem that was solved, and the method.
    wall_time : float
        Seconds of this call.
    """

    t: np.ndarray | None
    params: dict[str, np.ndarray]
    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    orbits: Given | Drawn
    keeper: Keeper
    wall_time: float = 0.0

    @property
    def fields(self) -> Mapping[str, np.ndarray]:
        """The kept part of each orbit, by name: arrays (..., N, ...)."""
        return self.keeper.fields

    @property
    def status(self) -> np.ndarray:
        """0, −1 for an orbit that failed, or 2 for one that has not been run yet: int8 of shape (..., N).

        The rows of the latter two are NaN.
        """
        return self.keeper.status

    @property
    def messages(self) -> Mapping[Index, str]:
        """Messages of the orbits that failed, by their indices."""
        return self.keeper.messages

    def __getattr__(self, name: str) -> np.ndarray:
        fields = {} if "keeper" not in self.__dict__ else self.keeper.fields
        if name in fields:
            return fields[name]
        raise AttributeError(f"the ensemble has no {name!r}: of each orbit it has {', '.join(fields) or 'nothing'}.")

    @property
    def y0(self) -> np.ndarray:
        """The initial states (N, 2d)."""
        return self.orbits.states(0, len(self.orbits))

    @property
    def success(self) -> bool:
        """True if all orbits have been run, and none failed."""
        return not self.status.any()

    @property
    def message(self) -> str:
        """The outcome of the orbits, in words."""
        status = self.status
        failed, waiting = np.count_nonzero(status < 0), np.count_nonzero(status == NOT_RUN)
        parts = []
        if waiting:
            parts.append(f"{waiting:,} of {status.size:,} orbits have not been run yet: call again with resume=True.")
        if failed:
            index, text = min(self.messages.items())
            parts.append(f"{failed:,} of {status.size:,} orbits failed, the first of them {list(index)}: {text}")
        return " ".join(parts) or f"All {status.size:,} orbits reached the end."

    def card(self) -> Card:
        facts = {
            "method": method_text(self.integrator, self.integrator.step_length(self.system)),
            "t_span": f"{self.t_span[0]:g} … {self.t_span[1]:g}",
            "orbits": " × ".join(f"{n:,}" for n in self.status.shape),
            "parameters": ", ".join(f"{name} = {numbers(values)}" for name, values in self.params.items()),
            "kept": ", ".join(f"{name} {values.shape}" for name, values in self.fields.items()),
            "run": f"{self.wall_time:.3g} s",
        }
        return Card(f"Ensemble of {self.system.title}", facts, self.message)

    def preview(self) -> Figure | None:
        return self.plot() if sum(x.size for x in self.fields.values()) <= MOST_SHOWN else None

    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the results: states in the plane of q₁ and p₁, the last ones where there are several; else histograms.

        With a `path` (.png, .pdf or .svg) the figure is saved too; matplotlib is needed.

        Raises
        ------
        ValueError
            If nothing was kept that is a number for each orbit.
        """
        d, kept = self.system.ndof, self.fields
        state = next((x for name, x in kept.items() if name in ("y", "final")), None)
        if state is not None:
            last = state[..., -1] if state.ndim == self.status.ndim + 2 else state
            q, p = last[..., 0].reshape(-1), last[..., d].reshape(-1)
            title = f"{self.system.title}, t = {(self.t_span[1] if self.t is None else self.t[-1]):g}"
            return saved(points_figure(q, p, ("q", "p") if d == 1 else ("q₁", "p₁"), title), path)
        values = {name: np.ravel(x).astype(float) for name, x in kept.items() if x.shape == self.status.shape}
        if not values:
            raise ValueError(f"`reduce` kept no number for each orbit, but {', '.join(kept)}: draw these yourself.")
        return saved(histogram_figure(values, self.system.title), path)

    def to_xarray(self) -> xarray.Dataset:
        """The fields as an `xarray.Dataset`; from a store it is read when it is used.

        States are `q` and `p` with the dimensions (..., orbit, dof, time), the initial ones `q0` and `p0`. The
        attributes describe how the data were made.

        Raises
        ------
        ImportError
            If xarray is not installed.
        """
        return self.keeper.dataset()

    def to_dataframe(self) -> pandas.DataFrame:
        """The fields as a `pandas.DataFrame`, with a row for each orbit, and each time where states are kept in time.

        Columns are the parameters that are axes, the orbit, the time, then the fields: of states q1 … qd and p1 … pd;
        of arrays name_0, name_1. `status` is that of the orbit. Without times q1_0 … pd_0 are its initial state.

        Raises
        ------
        ImportError
            If pandas or xarray is not installed.
        """
        imported("pandas", "to_dataframe()")
        return names.table(self.to_xarray(), (*map(axis_name, self.params), ORBIT, TIME))
