"""The layout of results outside of sympflow: names, dimensions and attributes of Datasets, stores and tables.

A state [q, p] is two arrays, `q` and `p`, with the dimensions (…, dof, time), those of a batch in front; `q0` and `p0`
are the initial ones, `status` is that of each orbit. `dof` counts from 1, as q1 … qd do. `time` has no attribute
"units", by which xarray would take it for dates. The attributes of the whole are flat: texts and numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.lazy import needed

if TYPE_CHECKING:
    import pandas
    import xarray

ORBIT, DOF, TIME = "orbit", "dof", "time"
RESERVED = ("q", "p", "q0", "p0", "status", ORBIT, DOF, TIME)
"""Names of the arrays and dimensions that each Dataset has, or may have."""
NAMED = {  # the attributes of arrays, by their names
    "q": {"long_name": "positions"},
    "p": {"long_name": "momenta"},
    "q0": {"long_name": "initial positions"},
    "p0": {"long_name": "initial momenta"},
    "energy": {"long_name": "H along the solution"},
    "status": {"long_name": "0: the end was reached, 1: an event ended it, 2: not run yet, -1: failed"},
    DOF: {"long_name": "i of q_i and p_i"},
}
UNITS = "those of the system's definition"  # the units of all numbers, which no system states


def halves(ndof: int) -> tuple[tuple[str, slice], tuple[str, slice]]:
    """Return the letters of a state's two halves, and the rows of each."""
    return ("q", slice(0, ndof)), ("p", slice(ndof, None))


def batch_dims(shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names of the dimensions of a batch."""
    return (ORBIT,) if len(shape) == 1 else tuple(f"{ORBIT}_{i}" for i in range(len(shape)))


def dofs(ndof: int) -> np.ndarray:
    """Return the coordinates along `dof`."""
    return np.arange(1, ndof + 1)


def axis_name(name: str) -> str:
    """The coordinate of a parameter: its name, unless that is one of the result's own."""
    return f"param_{name}" if name in (*RESERVED, "energy") or name.startswith(f"{ORBIT}_") else name


def described(arrays: Mapping[str, tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
    """Return arrays (dims, values) with their attributes, as a Dataset takes them."""
    return {name: (dims, values, NAMED.get(name, {})) for name, (dims, values) in arrays.items()}


def imported(library: str, what: str) -> Any:
    """Import a library of the extra "data"."""
    try:
        return import_module(library)
    except ImportError as error:
        raise ImportError(f"{what} needs {library}: {needed(library, 'data')}.") from error


def table(data: xarray.Dataset, rows: Iterable[str]) -> pandas.DataFrame:
    """Return the arrays of a Dataset as columns, with a row for each index along some dimensions.

    The columns are these dimensions, what is known along them, and of arrays with more dimensions one for each entry:
    q1 … qd along `dof`, else name_0, name_1, name_0_1. Arrays without any of the `rows` are left out, and where these
    are times the initial states. `attrs` are those of the Dataset.
    """
    pd = imported("pandas", "to_dataframe()")
    dims = [dim for dim in rows if dim in data.sizes]
    shape = tuple(data.sizes[dim] for dim in dims)
    columns: dict[str, Any] = {}
    for dim in dims:
        along = data[dim].values if dim in data.coords else np.arange(data.sizes[dim])
        columns[dim] = _spread(along, [dim], dims, shape)
    for name, array in [*data.coords.items(), *data.data_vars.items()]:
        own = [dim for dim in dims if dim in array.dims]
        if name in data.sizes or (dims and not own) or (TIME in dims and name in ("q0", "p0")):
            continue
        inner = [dim for dim in array.dims if dim not in dims]
        values = array.transpose(*own, *inner).values
        for label, entry in _entries(str(name), values.reshape(*values.shape[: len(own)], -1), array, inner):
            columns[label] = _spread(entry, own, dims, shape)
    made = pd.DataFrame(columns)
    made.attrs.update(data.attrs)
    return made


def _entries(name: str, values: np.ndarray, array: Any, inner: list[Any]) -> Iterator[tuple[str, np.ndarray]]:
    """The columns of an array whose last axis counts the entries along its inner dimensions."""
    lengths = tuple(array.sizes[dim] for dim in inner)
    for k, index in enumerate(np.ndindex(*lengths)):
        if inner == [DOF]:
            letter, initial = (name[:-1], "_0") if name in ("q0", "p0") else (name, "")
            yield f"{letter}{index[0] + 1}{initial}", values[..., k]
        else:
            yield "_".join([name, *map(str, index)]), values[..., k]


def _spread(values: np.ndarray, own: list[Any], dims: list[str], shape: tuple[int, ...]) -> np.ndarray:
    """Values along some of the dimensions, for each row."""
    wide = values.reshape([n if dim in own else 1 for dim, n in zip(dims, shape, strict=True)])
    return np.broadcast_to(wide, shape).ravel()
