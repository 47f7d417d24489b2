"""Trajectories from arrays, results, tables, Datasets and files, with their checks."""

from __future__ import annotations

import math
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import MAX_ASKED_VALUES, floats, is_number_word
from sympflow.arrays import without_torch
from sympflow.storage.layout import DOF, ORBIT, TIME, imported

UNITS = {  # units in those of the SI, angles in radians
    "1": 1.0, "rad": 1.0, "deg": np.pi / 180, "rev": 2 * np.pi,
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0,
    "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9,
    "kg": 1.0, "g": 1e-3, "mg": 1e-6, "N": 1.0, "J": 1.0,
}  # fmt: skip
TIMES = ("t", "time")
RUNS = (ORBIT, "run", "run_id", "trajectory", "trajectory_id", "traj", "id")
"""Names of the columns of times and of trajectories that are recognized, in lower case."""
BESIDE = ("energy", "status")  # columns of tables of sympflow that are not states
VELOCITY = r"v_?(\d*)|dq_?(\d*)(?:_?dt)?|q_?(\d*)_?dot_?(\d*)"
"""Names of the columns of velocities: v1, dq1, dq1_dt, q1_dot, qdot1."""
ORDERS = ("halves", "pairs")
OBSERVED = {"qp": "p", "qv": "v", "q": "v"}
"""The meaning of the rows of states, with the letter of the second half; velocities of "q" are missing."""


@dataclass(frozen=True)
class Run:
    """One trajectory: ascending times t (n,) and states y (2d, n), NaN where a value is missing."""

    t: np.ndarray
    y: np.ndarray

    @property
    def n_points(self) -> int:
        return len(self.t)

    @property
    def span(self) -> float:
        return float(self.t[-1] - self.t[0])

    def part(self, start: int, stop: int) -> Run:
        """The points from start to stop."""
        return Run(self.t[start:stop], np.ascontiguousarray(self.y[:, start:stop]))


Found = tuple[str, np.ndarray, np.ndarray]
"""The name of a trajectory for messages, its times and states, not checked yet."""


def _numbers(values: Any, name: str) -> np.ndarray:
    """Real numbers as a float64 array of NumPy, NaN where they are masked."""
    try:
        array = without_torch(values)
        if isinstance(array, np.ma.MaskedArray):
            array = np.ma.filled(array.astype(float), np.nan)
        array = np.asarray(array)
        if array.dtype.kind in "mM":
            array = (array - array.ravel()[0]) / np.timedelta64(1, "s")
        if array.dtype.kind in "cb":
            raise TypeError("complex numbers" if array.dtype.kind == "c" else "booleans")
        return array.astype(float)
    except (TypeError, ValueError) as error:
        raise TypeError(f"`data` has {name} that are not real numbers ({error}): give arrays of numbers.") from error


def _is_array(values: Any, ndim: int) -> bool:
    """True of an array, or nested list, of that many axes."""
    if isinstance(values, str | bytes | Mapping) or values is None:
        return False
    try:
        return np.ndim(without_torch(values)) == ndim
    except ValueError:  # lists of different lengths
        return False


def of_arrays(data: Any) -> Iterator[Found]:
    result = _of_result(data)
    if result is not None:
        yield from result
        return
    if not isinstance(data, Sequence) or isinstance(data, str | bytes):
        raise TypeError(
            f"`data` is of the type {type(data).__name__}: give a list of (t, y), a pair of arrays t (n,) and "
            "y (N, 2d, n), three arrays (x, t, y), a dictionary of arrays, a solution, a table or a Dataset."
        )
    if len(data) == 2 and (_is_array(data[0], 1) or (_is_array(data[0], 2) and _is_array(data[1], 3))):
        yield from _of_pair(*data)
    elif len(data) == 3 and _is_array(data[0], 2):
        yield from _of_ends(*data)
    else:
        for i, one in enumerate(data):
            for _, t, y in _of_result(one) or [_of_one(i, one)]:
                yield f"trajectory {i}", t, y


def _of_result(data: Any) -> list[Found] | None:
    """The orbits of a solution, an ensemble or SciPy's result that have states; None of anything else."""
    try:
        t, y = data.t, data.y
    except AttributeError:
        return None
    return [one for one in _of_pair(t, y) if np.isfinite(one[2]).any()]


def _of_one(i: int, one: Any) -> Found:
    if isinstance(one, Run):
        return "", one.t, one.y
    if not (isinstance(one, Sequence) and len(one) == 2):
        raise TypeError(f"`data[{i}]` is not a trajectory: give a pair (t, y) of arrays, t (n,) and y (2d, n).")
    return "", _numbers(one[0], "times"), _numbers(one[1], "states")


def _of_pair(t: Any, y: Any) -> Iterator[Found]:
    t, y = _numbers(t, "times"), _numbers(y, "states")
    if y.ndim < 2:
        raise ValueError(f"`data` has states of shape {y.shape}: give y (2d, n), or (N, 2d, n), with the time last.")
    if y.ndim == 2:
        yield "the trajectory", t, y
        return
    states = y.reshape(math.prod(y.shape[:-2]), *y.shape[-2:])
    if t.ndim == 1:
        yield from ((f"trajectory {i}", t, one) for i, one in enumerate(states))
        return
    times = t.reshape(-1, t.shape[-1]) if t.ndim else t
    if t.shape != (*y.shape[:-2], y.shape[-1]):
        raise ValueError(
            f"`data` has times of shape {t.shape} and states of shape {y.shape}: give t (n,) for all, or (N, n)."
        )
    for i, (own, one) in enumerate(zip(times, states, strict=True)):
        yield f"trajectory {i}", own[kept := np.isfinite(own)], one[:, kept]  # ragged trajectories are padded


def _of_ends(x: Any, t: Any, y: Any) -> Iterator[Found]:
    x, y, t = _numbers(x, "states"), _numbers(y, "states"), _numbers(t, "times")
    t = t[:, 0] if t.ndim == 2 and t.shape[1] == 1 else t
    if x.shape != y.shape or t.shape not in ((), (1,), (len(x),)):
        raise ValueError(
            f"`data` is (x, t, y) of shapes {x.shape}, {t.shape}, {y.shape}: give x (N, 2d), t (N,) and y (N, 2d)."
        )
    for i, (start, later, end) in enumerate(zip(x, np.broadcast_to(t, len(x)), y, strict=True)):
        yield f"pair {i}", np.array([0.0, later]), np.stack([start, end], 1)


def of_mapping(data: Mapping[str, Any], ndof: int | None, time: str | None, q: Any, p: Any, observed: str) -> Any:
    """The pair (t, y) of a dictionary of arrays; of one of columns the table."""
    arrays = {str(name): _numbers(values, f"values of {name}") for name, values in data.items() if np.ndim(values)}
    of_time = _column([*arrays], time, TIMES, "time")
    said = f"`data` has {', '.join(f'{name} {a.shape}' for name, a in arrays.items()) or 'no arrays'}"
    if of_time is None:
        raise ValueError(f"{said}, and no times: give them as t, or name them by `time`.")
    t, several = arrays[of_time], isinstance(q, Sequence) and not isinstance(q, str)
    if "y" in arrays and q is None:
        return t, arrays["y"]
    names = ["q" if q is None else str(q), OBSERVED[observed] if p is None else str(p)]
    halves = [arrays.get(name) for name in names[: len(observed)]]
    if several or all(a.ndim == 1 for a in arrays.values()):
        if len({a.shape for a in arrays.values()}) > 1:
            raise ValueError(f"{said}: columns must be of one length.")
        return imported("pandas", "Reading columns").DataFrame(arrays)
    if len({() if half is None else half.shape for half in halves}) > 1 or halves[0] is None:
        raise ValueError(f"{said}: give t with y (N, 2d, n), or with q and p of one shape, (N, d, n) or (d, n).")
    runs = t.ndim == 2 or ndof == 1  # q (N, n) of one degree of freedom
    made = [a[:, None] if a.ndim == 2 and runs else a for a in halves if a is not None]
    if made[0].ndim == 2 and ndof is None:
        raise ValueError(
            f"{said}: it is ambiguous whether q of shape (k, n) holds k coordinates or k trajectories: pass `ndof`."
        )
    return t, np.concatenate(made, axis=-2)


def of_dataset(data: Any) -> list[Found]:
    missing = [name for name in ("q", "p") if name not in data] + [TIME] * (TIME not in data.variables)
    if missing:
        raise ValueError(
            f"`data` has no {' and no '.join(missing)}: a Dataset needs q and p of dimensions (…, {DOF}, {TIME}) and "
            f"the coordinate {TIME}, as to_xarray() makes them; rename its variables."
        )
    outer = [dim for dim in data.q.dims if dim not in (DOF, TIME)]
    q, p = (
        _numbers((part if DOF in part.dims else part.expand_dims(DOF)).transpose(*outer, DOF, TIME).values, "states")
        for part in (data.q, data.p)
    )
    times = data[TIME].transpose(*[dim for dim in outer if dim in data[TIME].dims], ...).values
    each = (-1, *q.shape[-2:])
    times = np.broadcast_to(_numbers(times, "times"), (*q.shape[:-2], q.shape[-1])).reshape(-1, q.shape[-1])
    return [*_of_pair(times, np.concatenate([q.reshape(each), p.reshape(each)], axis=1))]


def opened(path: Path) -> Any:
    """The table or Dataset of a file."""
    if not path.exists():
        raise FileNotFoundError(f"`data` names the file {str(path)!r}, which does not exist: check the path.")
    try:
        return _of_file(path)
    except (ValueError, OSError, MemoryError, EOFError, zipfile.BadZipFile) as error:
        if str(error).startswith("`data`"):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"`data` names the file {str(path)!r}, which cannot be read ({reason}): check that it is whole, "
            "a text in UTF-8 with as many columns in each row, or arrays of numbers."
        ) from error


def _of_file(path: Path) -> Any:
    ending = path.suffix.lower()
    if ending in (".csv", ".tsv", ".txt"):
        pandas = imported("pandas", "Reading a table")
        separators = _separators(path) if ending == ".csv" else {"sep": None if ending == ".txt" else "\t"}
        with warnings.catch_warnings():  # of another engine for separators that are found
            warnings.simplefilter("ignore")
            options = {**separators, "comment": "#", **_header(path)}
            if "names" not in options:  # else pandas gives the second of two columns of one name another
                first = pandas.read_csv(path, **options, header=None, nrows=1, dtype=str)
                _check_different(first.iloc[0].dropna().str.strip().tolist() if len(first) else [])
            return pandas.read_csv(path, **options)
    if ending == ".npz":
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    if ending in (".parquet", ".pq"):
        pandas = imported("pandas", "Reading a table")
        try:
            return pandas.read_parquet(path)
        except ImportError as error:
            raise ImportError(
                "`data` is a Parquet file, which pandas reads by pyarrow: pip install pyarrow, or give a CSV file."
            ) from error
    xarray = imported("xarray", "Reading a Dataset")
    if ending == ".zarr":
        return _loaded(xarray.open_zarr(path, consolidated=False, chunks=None))
    if ending in (".nc", ".netcdf"):
        with xarray.open_dataset(path) as data:
            return _loaded(data)
    raise ValueError(
        f"`data` names a file {ending or 'without an ending'}: .csv, .parquet, .npz, .nc and .zarr are read."
    )


def _header(path: Path) -> dict[str, Any]:
    """Options of pandas for a file whose names stand in a comment before its numbers; none where a row has them."""
    comment: list[str] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            words = re.split(r"[,;\s]+", line.strip().lstrip("#").strip())
            if line.startswith("#"):
                comment = words
            elif line.strip():
                break
        else:
            return {}
    if not all(is_number_word(word) for word in words) or words == [str(i) for i in range(len(words))]:
        return {}
    if len(comment) == len(words) and not any(is_number_word(word) for word in comment):
        return {"names": comment}
    raise ValueError(
        f"`data` names the file {str(path)!r}, whose first row has numbers in place of the names of its columns: write "
        "them above, as t,q1,p1 and so on."
    )


def _check_different(names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"`data` has more than one column {', '.join(twice)}: drop one of them, or name them apart.")


def _loaded(data: Any) -> Any:
    """The Dataset in memory, unless what its file tells of would not fit there."""
    if data.nbytes > 8 * MAX_ASKED_VALUES:
        raise ValueError(
            f"`data` has {data.nbytes / 2**30:.3g} GiB, more than {MAX_ASKED_VALUES:.0e} numbers: give a part."
        )
    return data.load()


def _separators(path: Path) -> dict[str, str]:
    """Options of pandas for a CSV file; semicolons separate columns where numbers have decimal commas."""
    with path.open(encoding="utf-8", errors="replace") as file:
        names = next((line for line in file if line.strip() and not line.startswith("#")), "")
        decimal = "," if any("," in line for line in file) else "."
        return {"sep": ";", "decimal": decimal} if ";" in names else {"sep": ","}


def of_table(
    table: Any,
    ndof: int | None,
    order: str | Sequence[int],
    time: str | None,
    run: str | None,
    q: Any,
    p: Any,
    velocities: bool,
    observed: str,
) -> tuple[list[Found], tuple[str, ...]]:
    if any(name is not None for name in table.index.names):
        table = table.reset_index()
    columns = [str(c) for c in table.columns]
    _check_different(columns)
    table = table.set_axis(columns, axis=1)
    of_time = _column(columns, time, TIMES, "time")
    if of_time is None:
        raise ValueError(f"`data` has no column of the time among {', '.join(columns)}: name it by `time`.")
    ids = [c for c in columns if re.fullmatch(rf"{ORBIT}_\d+", c)] if run is None else []
    one = _column(columns, run, RUNS, "run")
    ids = ids or ([] if one is None else [one])
    rest = [c for c in columns if c not in (*ids, of_time, *BESIDE)]
    if observed == "q":
        names = _positions(rest, ndof, q)
    else:
        names = _coordinates(rest, ndof, order, q, p, velocities or observed == "qv")
    groups = [("the trajectory", table)]
    if ids:
        grouped = table.groupby(ids if len(ids) > 1 else ids[0], sort=False, dropna=False)
        groups = [(f"{', '.join(ids)} {key}", rows) for key, rows in grouped]
    found = []
    for label, rows in groups:
        y = np.stack([_numbers(rows[name].to_numpy(), f"values of {name}") for name in names])
        found.append((label, _numbers(rows[of_time].to_numpy(), "times"), y))
    if not ids and (np.diff(found[0][1]) <= 0).any():
        raise ValueError(
            "`data` has times that repeat or go back, and no column of the trajectory is recognized: name it by `run`, "
            "or sort the rows."
        )
    return found, names


def _column(columns: list[str], given: str | None, known: Sequence[str], argument: str) -> str | None:
    if given is None:
        return next((c for word in known for c in columns if c.lower() == word), None)
    if given not in columns:
        raise ValueError(f"`{argument}` is {given!r}, which is not a column: there are {', '.join(columns)}.")
    return given


def _coordinates(
    rest: list[str], ndof: int | None, order: str | Sequence[int], q: Any, p: Any, velocities: bool
) -> tuple[str, ...]:
    """The columns of q1 … qd, p1 … pd."""
    if (q is None) != (p is None):
        raise ValueError("`q` and `p` go together: name the columns of both.")
    if q is not None:
        qs, ps = ([one] if isinstance(one, str) else list(one) for one in (q, p))
        missing = [name for name in (*qs, *ps) if name not in rest]
        if missing or len(qs) != len(ps):
            raise ValueError(f"`q` and `p` must name as many columns each, of {', '.join(rest)}; got {qs} and {ps}.")
        return (*qs, *ps)
    found: dict[str, list[str]] = {letter: _numbered(rest, letter) for letter in "qpv"}
    if found["q"] and len(found["q"]) == len(found["p"]):
        return (*found["q"], *found["p"])
    if found["q"] and len(found["q"]) == len(found["v"]):
        if velocities:
            return (*found["q"], *found["v"])
        raise ValueError(
            f"`data` has velocities, {', '.join(found['v'])}, and no momenta: give the mass matrix as "
            '`velocity_mass`, by which p = M v, or columns p1 …; or pass observed="qv" to `learn`, which finds M.'
        )
    if ndof is not None and len(rest) == 2 * ndof:
        return tuple(rest[i] for i in rows_of(order, len(rest)))
    raise ValueError(
        f"`data` has columns {', '.join(rest)}, of which the coordinates and momenta are not recognized: name them by "
        "`q` and `p`, or give `ndof` if they are all, q's first, or in another `order`; of velocities pass "
        'observed="qv" too.'
    )


def _positions(rest: list[str], ndof: int | None, q: Any) -> tuple[str, ...]:
    """The columns of q1 … qd, where there are no others."""
    named = _numbered(rest, "q") if q is None else [q] if isinstance(q, str) else list(q)
    names = rest if q is None and ndof == len(rest) else named
    if not names or any(name not in rest for name in names):
        raise ValueError(f"`q` must name columns of {', '.join(rest)}; got {names}: or give `ndof` if they are all.")
    return tuple(names)


def _numbered(columns: list[str], letter: str) -> list[str]:
    """The columns letter1, letter2, … in order, or letter alone."""
    form = VELOCITY if letter == "v" else rf"{letter}_?(\d*)"
    found = [(c, re.fullmatch(form, c.lower())) for c in columns]
    numbers = {int("".join(m.groups("")) or 1): c for c, m in found if m}
    return [numbers[i] for i in range(1, len(numbers) + 1)] if sorted(numbers) == [*range(1, len(numbers) + 1)] else []


def width_of(found: list[Found], ndof: int | None) -> int:
    widths: dict[int, str] = {}
    for label, t, y in found:
        if not y.size:
            raise ValueError(f"`data` has no numbers ({label}): give at least two points of each trajectory.")
        if y.ndim != 2 or t.ndim != 1:
            raise ValueError(f"`data` has times of shape {t.shape}, states {y.shape} ({label}): give (n,) and (2d, n).")
        if y.shape[1] != len(t):
            turned = "pass y.T, for time comes last" if y.shape[0] == len(t) else "each time has a state"
            raise ValueError(f"`data` has {len(t)} times and states of shape {y.shape} ({label}): {turned}.")
        widths.setdefault(y.shape[0], label)
    if len(widths) > 1:
        said = ", ".join(f"{width} ({label})" for width, label in widths.items())
        raise ValueError(f"`data` has trajectories of different widths, {said}: give q1 … qd, p1 … pd of one system.")
    (width,) = widths
    if width % 2:
        raise ValueError(
            f"`data` has states of {width} numbers, which is odd: give q1 … qd, p1 … pd, the time apart; of positions "
            'alone pass observed="q".'
        )
    if ndof is not None and 2 * ndof != width:
        raise ValueError(f"`ndof` is {ndof}, but states have {width} numbers: give ndof={width // 2}, or drop columns.")
    return width


def rows_of(order: str | Sequence[int], width: int) -> list[int]:
    """The places of q1 … qd, p1 … pd."""
    if isinstance(order, str):
        if order not in ORDERS:
            raise ValueError(f'`order` must be "halves", "pairs" or the places of q1 … pd; got {order!r}.')
        return [*range(width)] if order == "halves" else [*range(0, width, 2), *range(1, width, 2)]
    rows = [int(i) for i in order]
    if sorted(rows) != [*range(width)]:
        raise ValueError(f"`order` must have each of 0 … {width - 1} once; got {rows}.")
    return rows


def factors_of(units: Mapping[str, str | float] | None, names: tuple[str, ...]) -> tuple[np.ndarray, float]:
    """The factors of the coordinates (2d,) and of the times that convert the units."""
    if units is not None and not isinstance(units, Mapping):
        raise TypeError(f'`units` must be a dictionary such as {{"t": "ms", "q": "deg"}}; got {units!r}.')
    d, factors, of_time = len(names) // 2, np.ones(len(names)), 1.0
    given = {} if units is None else units
    for name in sorted(given, key=lambda name: name in names):  # a column's own unit goes before that of all q or p
        factor = _factor(name, given[name])
        if name in names:
            factors[names.index(name)] = factor
        elif name in ("q", "p"):
            factors[slice(0, d) if name == "q" else slice(d, None)] = factor
        elif name in TIMES:
            of_time = factor
        else:
            raise ValueError(
                f'`units` names {name!r}, which is not a coordinate: "t", "q", "p", {", ".join(names)} are.'
            )
    return factors, of_time


def _factor(name: str, unit: str | float) -> float:
    """A unit such as "deg/ms" or "kg*m^2/s" as a number."""
    if isinstance(unit, str):
        value = 1.0
        for sign, text, power in re.findall(r"([*/·]?)\s*([^\s*/·^]+)(?:\s*(?:\^|\*\*)\s*(-?\d+))?", unit):
            if text not in UNITS:
                raise ValueError(f"`units[{name!r}]` is {unit!r}: {', '.join(UNITS)} are known; else give a factor.")
            value *= UNITS[text] ** (int(power or 1) * (-1 if sign == "/" else 1))
        return value
    if isinstance(unit, bool) or not 0 < float(unit) < np.inf:
        raise ValueError(f"`units[{name!r}]` must be a unit or a positive factor; got {unit!r}.")
    return float(unit)


def momenta_of(mass: ArrayLike, v: np.ndarray) -> np.ndarray:
    """M v."""
    M, d = floats("velocity_mass", mass), len(v)
    if M.shape not in ((), (d,), (d, d)):
        raise ValueError(f"`velocity_mass` must be a number, ({d},) or ({d}, {d}); got the shape {M.shape}.")
    whole = M if M.ndim == 2 else np.diag(np.broadcast_to(M, d))
    if not (np.isfinite(M).all() and np.allclose(whole, whole.T) and (np.linalg.eigvalsh(whole) > 0).all()):
        raise ValueError(
            f"`velocity_mass` must be finite, symmetric and positive definite, by which p = M v; got {mass!r}."
        )
    return M @ v if M.ndim == 2 else (M if M.ndim == 0 else M[:, None]) * v


def checked(label: str, t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and states of the points with values, in ascending order."""
    if not np.isfinite(t).all():
        raise ValueError(f"`data` has times that are not finite ({label}): drop these points.")
    if np.isinf(y).any():
        raise ValueError(f"`data` has infinite values ({label}): mark what is missing by NaN.")
    if len(t) > 1 and (np.diff(t) < 0).all():
        t, y = t[::-1], y[:, ::-1]
    steps = np.diff(t)
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        kind = "repeat" if steps[i] == 0 else "go back"
        raise ValueError(
            f"`data` has times that {kind} ({label}: {t[i + 1]:g} follows {t[i]:g} at point {i + 1}): sort the points, "
            "average those of one time, and give each trajectory apart."
        )
    kept = np.isfinite(y).any(0)
    if not kept.any():
        raise ValueError(f"`data` has no value but NaN ({label}): leave this trajectory out.")
    if kept.sum() < 2:
        raise ValueError(f"`data` has a trajectory with one point only ({label}): two are needed; leave it out.")
    return t[kept], y[:, kept]
