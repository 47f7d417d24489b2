"""Compiled loops of splitting schemes on lattices of any size, generated from one site and one bond.

Their code does not depend on the size: shapes, and the values of parameters, are arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from types import ModuleType
from typing import Any

import numpy as np

from sympflow.hamiltonian.lattice import LatticeHamiltonian
from sympflow.kernels.lattice_passes import curvatures_of, stages_in_passes
from sympflow.kernels.lattice_registers import (
    VECTOR,
    constants_of,
    in_registers,
    size_in_registers,
    stages_in_registers,
)
from sympflow.kernels.lattice_sites import vectors_of
from sympflow.kernels.modules import constants_source, load_algebra, template
from sympflow.kernels.sized_loops import SizedLoops, Team
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL

__all__ = ["LatticeLoops"]

TILE = 4096
"""Sites of a tile of a lattice of one axis, whose vectors fit into the cache of a core."""
LARGER_TILE = 16384
"""Sites of a tile of other lattices."""
MARGIN = 32
"""A tile has so many times as many planes as one of its margins, so that little is computed twice."""
ALIGNED = 8
"""The first site of a chain, and the first of its momenta, are at multiples of so many numbers."""
FEWEST_TILES = 8
"""Lattices of fewer tiles are executed in one piece."""


class LatticeLoops(SizedLoops):
    """The functions that `SplittingLoops` asks for, of one lattice and one kind of kicks: large ones in tiles.

    Parameters
    ----------
    lattice : LatticeHamiltonian
    level : int
        See `Scheme`.
    compensated : bool
    rate : bool
        True if there is friction −γp, whose numbers are the last two rows of a table.
    """

    def __init__(self, lattice: LatticeHamiltonian, level: int, compensated: bool, rate: bool) -> None:
        if level == POLYNOMIAL:
            raise ValueError(
                "`scheme` has polynomials, which are of systems by their coordinates one by one: use backend='array'."
            )
        self._lattice, self._level = lattice, level
        self._reach = max(lattice.bonds, default=0)
        values = np.array([v for v in lattice.params.values() if not isinstance(v, np.ndarray)], dtype=float)
        planes = lattice.shape[0]
        plane = math.prod(lattice.shape[1:])
        of_a_stage = self._reach * {0: 1, FORCE_GRADIENT: 2, CURVATURE: 3}[level]
        tile = max((TILE if len(lattice.shape) == 1 else LARGER_TILE) // plane, 8 * of_a_stage)
        self._tiled = of_a_stage > 0 and planes >= FEWEST_TILES * tile
        self._planes = tile
        self._of_a_stage = of_a_stage
        margin = max(of_a_stage, tile // MARGIN) if self._tiled else of_a_stage
        unit = ALIGNED if len(lattice.shape) == 1 else 1
        self._margin = -(-margin // unit) * unit
        padded = -(-(planes + 2 * self._margin) // unit) * unit
        self._padded = (padded, *(n + 2 * self._reach for n in lattice.shape[1:]))
        self._size = math.prod(self._padded)
        last, row = lattice.shape[-1], self._padded[-1]
        self._geometry = np.array(
            [last, self._size // self._padded[0], row, self._padded_rows(), self._margin, planes], dtype=np.int64
        )
        self._shared = self._geometry, self._padded_parameters(), values
        registers = in_registers(lattice, level) and not (self._tiled and len(lattice.shape) == 2)
        module = _module(_definition(lattice), registers, level, compensated, rate)
        size = size_in_registers(lattice, level) if registers else self._size
        arguments = (self._geometry, size, *self._shared[1:])
        super().__init__(module, compensated, lattice.ndof, -(-planes // tile), arguments)

    def _padded_rows(self) -> int:
        return self._lattice.shape[1] if len(self._lattice.shape) == 3 else 1

    def _padded_parameters(self) -> np.ndarray:
        """The values of parameters of sites, with ghosts: at walls those of the first and last site."""
        arrays = [v for v in self._lattice.params.values() if isinstance(v, np.ndarray)]
        found, margins = np.zeros((len(arrays), self._size)), self._margins()
        for row, values in zip(found, arrays, strict=True):
            padded = values
            for axis, boundary in enumerate(self._lattice.boundary):
                widths = [(0, 0)] * values.ndim
                widths[axis] = margins[axis], self._padded[axis] - margins[axis] - values.shape[axis]
                padded = np.pad(padded, widths, mode="wrap" if boundary == "periodic" else "edge")
            row[:] = padded.ravel()
        return found

    def _in_pieces(self, threads: int) -> bool:
        return self._tiled

    def _advanced(
        self, team: Team, states: tuple[np.ndarray, np.ndarray], table: np.ndarray, j: int, count: int, single: bool
    ) -> tuple[tuple[np.ndarray, np.ndarray], int]:
        here, there = states
        module, tiles = self._module, self._n_pieces
        link, at_once = table.shape[1] - 2, self._margin // self._of_a_stage
        while count:
            n = min(count, at_once)
            module.wrap_ends(here, self._geometry)
            sweep = partial(module.sweep, here, there, table, j, n, single, self._planes)
            team(lambda lo, hi, sweep=sweep: sweep(lo, hi, *self._shared), tiles)  # type: ignore[misc]
            here, there, count = there, here, count - n
            j = j + n if single else (j - 1 + n) % link + 1
        return (here, there), j

    def _margins(self) -> tuple[int, ...]:
        return (self._margin, *(self._reach,) * (len(self._lattice.shape) - 1))

    def _states(self) -> np.ndarray:
        return np.zeros((4 if self._compensated else 2, len(self._lattice.fields), self._size))

    def _inner(self, X: np.ndarray, first: int) -> np.ndarray:
        """A view of two sets without ghosts."""
        n, shape = len(self._lattice.fields), self._lattice.shape
        inside = tuple(slice(m, m + k) for m, k in zip(self._margins(), shape, strict=True))
        return X[first : first + 2].reshape(2, n, *self._padded)[(slice(None), slice(None), *inside)]

    def _load(self, y: np.ndarray, X: np.ndarray, first: int) -> None:
        inner = self._inner(X, first)
        inner[...] = y.reshape(inner.shape)

    def _pack(self, X: np.ndarray, first: int, y: np.ndarray) -> None:
        inner = self._inner(X, first)
        y.reshape(inner.shape)[...] = inner


@dataclass(frozen=True)
class _Code:
    """Key of the code of a lattice: all that the code depends on."""

    lattice: LatticeHamiltonian
    key: tuple[Any, ...]

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Code) and self.key == other.key


def _definition(lattice: LatticeHamiltonian) -> _Code:
    bonds = tuple((k, lattice.bonds[k]) for k in sorted(lattice.bonds))
    arrays = tuple(isinstance(value, np.ndarray) for value in lattice.params.values())
    return _Code(lattice, (lattice.U, lattice.T, bonds, lattice.boundary, len(lattice.fields), arrays))


@lru_cache(maxsize=64)
def _module(code: _Code, registers: bool, level: int, compensated: bool, rate: bool) -> ModuleType:
    lattice = code.lattice
    constants: dict[str, Any] = {
        "N_FIELDS": len(lattice.fields),
        "N_SETS": 4 if compensated else 2,
        "SPACED": True,
        "COMPENSATED": compensated,
    }
    if registers:
        own = constants_of(lattice, level)
        shared = {"VECTOR": VECTOR, "GHOSTS": own["GHOSTS"]}
        return load_algebra(
            "import numpy as np\n\n\n" + stages_in_registers(lattice, level, compensated, rate),
            ("aligned", "sized_states", "chains" if len(lattice.shape) == 1 else "sheets"),
            (
                f"{constants_source(VECTOR=VECTOR)}\n\n\n{template('vectors')}",
                f"{constants_source(**shared)}\n\n\n{template('segments')}",
            ),
            VECTOR=VECTOR,
            **own,
            **constants,
        )
    return load_algebra(
        "import numpy as np\n\n\n" + stages_in_passes(lattice, level, compensated, rate),
        ("aligned", "sized_states", "lattice"),
        N_VECTORS=len(vectors_of(lattice)),
        N_AXES=len(lattice.shape),
        N_HELPERS={0: 0, FORCE_GRADIENT: 1, CURVATURE: 2}[level],
        N_CURVATURES=len(curvatures_of(lattice)) if level else 0,
        N_BONDS=sum(k > 1 for k in lattice.bonds) * len(lattice.fields),
        REACH=max(lattice.bonds, default=0),
        PERIODIC=tuple(b == "periodic" for b in lattice.boundary),
        **constants,
    )
