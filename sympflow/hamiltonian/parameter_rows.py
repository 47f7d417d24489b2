"""Values of the parameters of a system for each trajectory of a batch."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.arrays import differentiable, expanded, transformed, without_torch
from sympflow.compiler import NotCompiled
from sympflow.hamiltonian.quantities import Formula
from sympflow.hamiltonian.scales import size_of_terms
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.lazy import lately_kept

MOST_SHOWN = 4  # values of a row, in messages


@lately_kept
def _of_values(system: HamiltonianSystem, **values: float) -> HamiltonianSystem:
    return system.with_params(**values)


class Rows(NamedTuple):
    """Trajectories that one run takes together."""

    places: np.ndarray
    system: HamiltonianSystem
    parameter_values: np.ndarray | None = None


class ParameterRows:
    """The parameters of each trajectory of a batch; `followed` are the tensors of those whose gradients are wanted."""

    def __init__(
        self,
        system: HamiltonianSystem,
        values: Mapping[str, np.ndarray],
        uniform: bool = False,
        followed: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.system, self.values, self.uniform, self.followed = system, dict(values), uniform, followed
        self.shape = next(iter(self.values.values())).shape

    @cached_property
    def _columns(self) -> dict[str, np.ndarray]:
        return {name: np.ravel(value) for name, value in self.values.items()}

    def system_of(self, row: int) -> HamiltonianSystem:
        """The system of a trajectory, by its place in the flattened batch."""
        values = {name: float(column[row]) for name, column in self._columns.items()}
        try:
            return _of_values(self.system, **values)
        except (ValueError, TypeError) as error:
            where = ", ".join(map(str, np.unravel_index(row, self.shape)))
            raise ValueError(
                f"`params` has {self.shown(row)} (trajectory {where}), for which there is no system: {error} Leave "
                "these values out."
            ) from error

    def shown(self, row: int) -> str:
        """The values of a trajectory, in words."""
        return ", ".join(f"{name} = {column[row]:.9g}" for name, column in [*self._columns.items()][:MOST_SHOWN])

    def distinct(self) -> Iterator[Rows]:
        """The trajectories by their values, each with its own system."""
        for index in _groups([*self._columns.values()]):
            yield Rows(index, self.system_of(int(index[0])))

    def by_form(self) -> Iterator[Rows]:
        """The trajectories by the `parametric` form of H; those whose values belong to the code, by their values."""
        definition = self.system.definition
        if not definition.symbolic:
            yield from self.distinct()
            return
        try:
            parts, replaced = definition.parametric_parts
        except (TypeError, OverflowError, NotCompiled):
            yield from self.distinct()
            return
        kinds = [_kind(self._part(part)) for part in parts if self._swept(part)]
        kinds += [column for name, column in self._columns.items() if name in replaced]
        for index in _groups(kinds) if kinds else [np.arange(math.prod(self.shape))]:
            rows = self.taken(index)
            system = self._formed(tuple(float(kind[index[0] if len(kind) > 1 else 0]) for kind in kinds), int(index[0]))
            form = system.definition.parametric
            parameters = [rows._part(part) for part in form.meanings]
            swept = any(self._swept(part) for part in form.meanings)
            if form is system.definition or not swept or not all(np.isfinite(each).all() for each in parameters):
                yield from (Rows(index[few], own) for few, own, _ in rows.distinct())
                continue
            yield Rows(index, system, np.stack([np.broadcast_to(x, index.shape) for x in parameters]))

    def _formed(self, kinds: tuple[float, ...], row: int) -> HamiltonianSystem:
        """A system of the form of a row, made once; with parameter values of its own the form alone counts."""
        known = _FORMED.setdefault(self.system, {})
        key = tuple(self.values), kinds
        if key not in known:
            known[key] = self.system_of(row)
        return known[key]

    def taken(self, index: np.ndarray) -> ParameterRows:
        """The rows of some trajectories, by their places in the flattened batch."""
        if len(index) == math.prod(self.shape):
            return self
        return ParameterRows(self.system, {name: column[index] for name, column in self._columns.items()})

    def _swept(self, part: Formula) -> bool:
        return any(s.name in self._columns for s in part.variables)

    def _part(self, part: Formula) -> np.ndarray:
        """The values of a part of H that depends on parameters alone; NaN where they are not real."""
        params = {name: float(value) for name, value in self.system.params.items()} | self._columns
        with np.errstate(all="ignore"):
            return np.atleast_1d(part.value({s: params[s.name] for s in part.variables}))

    def hamiltonian(self, y: np.ndarray, t: Any) -> np.ndarray:
        """H of each trajectory at its states y (*shape, ..., 2d) at times that broadcast to these: (*shape, ...)."""
        return self._evaluated(y, t, _energy, lambda system, y, t: system.hamiltonian(y, t))

    def sizes_of_terms(self, y: np.ndarray, t: Any) -> np.ndarray:
        """½ Σ|y_i ∂H/∂y_i| of each trajectory, at states and times as those of `hamiltonian`."""
        return self._evaluated(y, t, _size, size_of_terms)

    def _evaluated(
        self, y: np.ndarray, t: Any, function: Callable[..., Any], of_system: Callable[..., Any]
    ) -> np.ndarray:
        """A function of H with its parameters as numbers, or else that of the system of each value, at states."""
        definition = self.system.definition
        if not definition.symbolic or definition.samples or definition.impulses:
            each = (y, np.broadcast_to(t, y.shape[:-1]))
            states, at = (x.reshape(math.prod(self.shape), *x.shape[len(self.shape) :]) for x in each)
            found = np.empty(states.shape[:-1])
            for index, system, _ in self.distinct():
                found[index] = of_system(system, states[index], at[index])
            return found.reshape(y.shape[:-1])
        more = (1,) * (y.ndim - 1 - len(self.shape))
        numbers = [value.reshape(*self.shape, *more) for value in self.values.values()]
        form = definition.named(tuple(self.values))
        times = (np.broadcast_to(t, y.shape[:-1]),) if definition.timed else ()
        values = function(form, y, *times, numbers=numbers)
        return np.broadcast_to(values, y.shape[:-1])

    def __getstate__(self) -> dict[str, Any]:
        """The definition alone: functions cannot be pickled."""
        of_run = {"uniform": self.uniform, "followed": {}}
        return {"system": self.system, "values": self.values, "shape": self.shape, **of_run}


_Key = tuple[tuple[str, ...], tuple[float, ...]]
_FORMED: WeakKeyDictionary[HamiltonianSystem, dict[_Key, HamiltonianSystem]] = WeakKeyDictionary()


def _energy(form: Any, y: np.ndarray, *t: Any, numbers: Sequence[Any]) -> np.ndarray:
    return form.hamiltonian(y, *t, numbers=numbers)


def _size(form: Any, y: np.ndarray, *t: Any, numbers: Sequence[Any]) -> np.ndarray:
    return 0.5 * np.abs(y * form.gradient(y, *t, numbers=numbers)).sum(-1)


def _kind(values: np.ndarray) -> np.ndarray:
    """The values where they are 0, 1 or −1, else 2, or 3 of those that are not finite."""
    kinds = np.where(np.isfinite(values), 2, 3)
    for number in (0, 1, -1):
        kinds[values == number] = number
    return kinds


def _groups(columns: list[np.ndarray]) -> list[np.ndarray]:
    """The indices of equal rows of columns (N,), groups in the order of their first ones."""
    key = np.zeros(len(columns[0]), dtype=np.int64)
    for column in columns:
        if (column == column[0]).all():
            continue
        _, own = np.unique(column, return_inverse=True)
        _, key = np.unique(key * (int(own.max()) + 1) + own.reshape(-1), return_inverse=True)
    order = np.argsort(key, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(key[order])) + 1)
    return sorted(groups, key=lambda index: int(index[0]))


def checked_rows(system: HamiltonianSystem, params: Any, batch: tuple[int, ...]) -> ParameterRows:
    """The values of `params` for each trajectory of a batch of states, broadcast as NumPy does."""
    if not isinstance(params, Mapping):
        raise TypeError(f"`params` must be a mapping of names to numbers or arrays; got {type(params).__name__}.")
    if not params:
        raise ValueError("`params` is empty: give values for parameters of the system, or leave it out.")
    if system.local is not None:
        params = system.local.number_columns(params)
    system.check_parameters(params)
    arrays = {name: _checked_values(name, value) for name, value in params.items()}
    try:
        shape = np.broadcast_shapes(batch, *(array.shape for array in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(
            f"`params` must have shapes that broadcast with the batch {batch} of `y0`, as numbers or arrays of one "
            f"value for each trajectory; got {shapes}."
        ) from None
    followed = {name: value for name, value in params.items() if differentiable(value)}
    numbers = not followed and not any(array.ndim for array in arrays.values())
    values = {name: expanded(array, shape) for name, array in arrays.items()}
    return ParameterRows(system, values, numbers, followed)


def _checked_values(name: str, given: Any) -> np.ndarray:
    if transformed(given):
        raise TypeError(
            f"`params` has {name} that torch.func, forward mode or torch.compile follows, which solve does not "
            "take: use torch.autograd.grad, or detach it."
        )
    given = without_torch(given)
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "iuf":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(
            f"`params` has {name} = {reprlib.repr(given)}: give finite real numbers, one or an array."
        ) from None
    if type(given) is not np.ndarray and np.ma.is_masked(given):
        raise ValueError(f"`params` has {name} with masked entries: fill them, or leave these trajectories out.")
    if not array.size:
        raise ValueError(f"`params` has no values of {name}: give one at least.")
    if not np.isfinite(array).all():
        where = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        raise ValueError(
            f"`params` has {name} = {array[where]} at {where}: give finite numbers, or leave these trajectories out."
        )
    return array
