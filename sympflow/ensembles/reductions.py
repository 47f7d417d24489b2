"""Reductions: what an ensemble keeps of each orbit instead of its states.

A reduction is a row of `REDUCTIONS`, an instance of a `Reduction` with options, or a user's function of one orbit. It
gets a `Chunk` of orbits, and steps along them by `chunk.windows()`, or runs loops of its own from `chunk.y0`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import any_array, did_you_mean
from sympflow.ensembles.chunks import Chunk
from sympflow.hamiltonian.scales import known_scale, size_of_terms
from sympflow.hamiltonian.system import HamiltonianSystem

Fields = dict[str, tuple[tuple[int, ...], np.dtype]]
"""Names of what is kept of each orbit, with the shape of one orbit and the dtype."""

REDUCTIONS: dict[str, str] = {
    "final": "ensembles.reductions:Final",
    "energy_error": "ensembles.reductions:EnergyError",
    "lyapunov": "ensembles.dynamics:Lyapunov",
    "sali": "ensembles.dynamics:Sali",
    "gali": "ensembles.dynamics:Gali",
    "frequencies": "ensembles.dynamics:Lines",
    "escape": "ensembles.dynamics:Escape",
    "crossings": "ensembles.dynamics:PlaneCrossings",
}
"""The names that `reduce` takes: "module:Class" below sympflow, called without arguments."""

EXACT = 2**53
"""The largest of the integers that floats hold exactly."""
MOST_TRIED = 64
"""First orbits of which a user's function is tried on the first that does not fail."""


class Reduction(ABC):
    """The part of each orbit that is kept.

    The result of an orbit must not depend on the others of its chunk, so that it is the same whatever the chunks.
    """

    in_python: ClassVar[bool] = False
    """True if Python code runs for each orbit, so that threads would wait for each other."""
    state: ClassVar[str] = ""
    """The field that holds states [q, p] along its first axis, which a Dataset has as q and p."""
    takes_params: ClassVar[bool] = False
    """True if the orbits of a chunk may have different parameters, those of `chunk.params`."""
    own_loops: ClassVar[bool] = False
    """True if it walks along the orbits by loops of its own, from `chunk.y0`."""

    def check(self, system: HamiltonianSystem) -> None:  # noqa: B027
        """Raise ValueError if it has no meaning for a system, in a grid for each value of the parameters."""

    @abstractmethod
    def fields(self, problem: Chunk) -> Fields:
        """Return the fields of one orbit, for a problem that is given as a chunk of some first orbits."""

    @abstractmethod
    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """Return the fields of all orbits of a chunk, (n, ...) each; NaN where an orbit failed.

        Orbits that fail are noted by `chunk.fail`, as `chunk.windows()` does.
        """


@dataclass(frozen=True)
class States(Reduction):
    """The states at the times of `t_eval`, or after each step: `y`, (2d, m) of each orbit."""

    state: ClassVar[str] = "y"
    takes_params: ClassVar[bool] = True

    def fields(self, problem: Chunk) -> Fields:
        return {"y": ((problem.y0.shape[1], problem.times.size), np.dtype(float))}

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        return {"y": chunk.states(chunk.times)}


@dataclass(frozen=True)
class Final(Reduction):
    """The state at the end of `t_span`: `final`, (2d,) of each orbit."""

    state: ClassVar[str] = "final"
    takes_params: ClassVar[bool] = True

    def fields(self, problem: Chunk) -> Fields:
        return {"final": ((problem.y0.shape[1],), np.dtype(float))}

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        return {"final": chunk.states(np.array(chunk.t_span[1:]))[..., 0]}


@dataclass(frozen=True)
class EnergyError(Reduction):
    """The largest relative energy error |H(y(t)) − H(y0)| / |H(y0)| along each orbit: `energy_error`.

    It is relative to the `energy_scale` of `sympflow.metrics.energy`, and absolute where that is missing.
    """

    def check(self, system: HamiltonianSystem) -> None:
        system.check_conservative("so a loss of energy is not an error", "use another `reduce`, such as 'final'")
        system.check_autonomous("so its energy is not conserved", "use another `reduce`, such as 'final'")

    def fields(self, problem: Chunk) -> Fields:
        return {"energy_error": ((), np.dtype(float))}

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        system = chunk.system
        with np.errstate(all="ignore"):
            H0 = np.asarray(system.hamiltonian(chunk.y0))
            worst, last = np.zeros(len(chunk)), chunk.y0
            for _, y in chunk.windows():
                H = np.asarray(system.hamiltonian(y.swapaxes(1, 2)))
                worst = np.maximum(worst, np.abs(H - H0[:, None]).max(axis=1, initial=0.0))
                last = y[..., -1] if y.shape[-1] else last
            ends = np.stack([chunk.y0, last])
            sizes = size_of_terms(system, ends, chunk.t_span[0])
            scale = np.nan_to_num(known_scale(system, np.asarray(system.hamiltonian(ends)), sizes), nan=1.0)
        return {"energy_error": np.where(chunk.status < 0, np.nan, worst / scale)}


@dataclass(frozen=True)
class OfFunction(Reduction):
    """A user's function of (t (m,), y (2d, m)) of one orbit, which returns a number, an array, or a dict of such.

    The shapes are those of the first orbit, and numbers are complex if its are. An orbit fails, with that message, if
    the function raises, returns another shape, or imaginary parts where the first has none.
    """

    function: Callable[[np.ndarray, np.ndarray], Any]
    found: Fields = field(default_factory=dict, compare=False)

    in_python: ClassVar[bool] = True
    takes_params: ClassVar[bool] = True

    def fields(self, problem: Chunk) -> Fields:
        """Find out the fields by the first orbit that does not fail; a ValueError or TypeError where there are none."""
        for i, t, y in problem.rows(0, MOST_TRIED).orbits():
            if not np.isfinite(y).all():
                continue
            try:
                value = self.function(t, y.copy())
            except Exception as error:
                raise ValueError(
                    f"`reduce` raises {type(error).__name__}: {error}, for orbit {i}: it is called with the times "
                    f"{t.shape} and the states {y.shape} of one orbit."
                ) from error
            try:
                self.found.update({name: (v.shape, v.dtype) for name, v in _arrays(value).items()})
            except ValueError as error:
                raise ValueError(f"`reduce` cannot be kept: {error}") from None
            return dict(self.found)
        raise ValueError(
            f"`reduce` cannot be tried: the first {len(problem)} orbits all fail. Reduce `dt`, or correct `y0`."
        )

    def reduce(self, chunk: Chunk) -> dict[str, np.ndarray]:
        out = {name: np.full((len(chunk), *shape), np.nan, dtype) for name, (shape, dtype) in self.found.items()}
        for i, t, y in chunk.orbits():
            if chunk.status[i] < 0:
                continue
            try:
                values = _arrays(self.function(t, y))
                if {name: v.shape for name, v in values.items()} != {name: s for name, (s, _) in self.found.items()}:
                    raise ValueError(f"`reduce` returns {_described(values)}, but {_described(out, 1)} for the first")
                for name, v in values.items():
                    if v.dtype.kind == "c" and out[name].dtype.kind != "c":
                        if v.imag.any():
                            raise ValueError(
                                f"`reduce` returns complex {name}, and real ones for the first orbit: return complex "
                                "numbers for all"
                            )
                        values[name] = v.real
            except Exception as error:
                chunk.fail(i, f"`reduce` failed: {type(error).__name__}: {error}.")
                continue
            for name, v in values.items():
                out[name][i] = v
        return out


def _described(values: Mapping[str, np.ndarray], skip: int = 0) -> str:
    return ", ".join(f"{name} of shape {v.shape[skip:]}" for name, v in values.items())


def _arrays(value: Any) -> dict[str, np.ndarray]:
    """The value of a user's function as arrays of floats (or complex numbers) by name."""
    named = value if isinstance(value, Mapping) else {"reduced": value}
    arrays = {}
    for name, v in named.items():
        if np.ma.is_masked(v):
            v = v.astype(np.result_type(v.dtype, float)).filled(np.nan)  # noqa: PLW2901
        array = any_array(v)
        whole = array.dtype.kind in "iu" or (array.dtype == object and all(isinstance(x, int) for x in array.flat))
        if whole and array.size and max(-int(array.min()), int(array.max())) > EXACT:
            raise ValueError(
                f"{name} has an integer beyond 2**53, which floats would change: return its parts, or a float"
            )
        if array.dtype.kind not in "biufc" or not isinstance(name, str):
            raise TypeError(
                f"`reduce` must return numbers, an array of them, or a dict of such by name; got {type(v).__name__}."
            )
        arrays[name] = array.astype(complex if array.dtype.kind == "c" else float)
    return arrays


def reduction(reduce: Any) -> Reduction:
    """Return the reduction that `reduce` means: None for the states, a name, a Reduction, or a function of (t, y)."""
    if reduce is None:
        return States()
    if isinstance(reduce, Reduction):
        return reduce
    if isinstance(reduce, str):
        if reduce in REDUCTIONS:
            module, _, name = REDUCTIONS[reduce].partition(":")
            return getattr(import_module(f"sympflow.{module}"), name)()
        hint = did_you_mean(reduce.lower(), REDUCTIONS)
        raise ValueError(f"`reduce` {reduce!r} is unknown.{hint} Choose one of {', '.join(REDUCTIONS)}.")
    if isinstance(reduce, type) and issubclass(reduce, Reduction):
        raise TypeError(f"`reduce` is the class {reduce.__name__}: pass an instance of it.")
    if callable(reduce):
        return OfFunction(reduce)
    raise TypeError(
        f"`reduce` must be a name ({', '.join(REDUCTIONS)}), a Reduction, or a function of (t, y); got "
        f"{type(reduce).__name__}."
    )
