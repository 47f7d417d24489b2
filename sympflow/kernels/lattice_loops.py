"""Compiled loops of splitting schemes on lattices of any size: passes over sites, generated from one site and one bond.

Their code does not depend on the size: shapes, and the values of parameters, are arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from types import ModuleType
from typing import Any

import llvmlite.binding
import numpy as np
import sympy as sp

from sympflow.hamiltonian.lattice import LatticeHamiltonian
from sympflow.kernels.codegen import statements, vectorised
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
VECTOR = 8 if llvmlite.binding.get_host_cpu_features().get("avx512f", False) else 4
"""Numbers side by side in a register."""
HIGHEST_POWER = 16
"""Lower powers are products, of derivatives too."""
FEWEST_TILES = 8
"""Lattices of fewer tiles are executed in one piece."""


@dataclass(frozen=True)
class _Pass:
    """A pass over sites: the slopes of a potential, and what is done with them.

    Attributes
    ----------
    vectors : tuple of str
        The vectors of which differences along bonds are taken, of q, v and w.
    slopes : callable
        Of a potential and its letters, to one expression for each field.
    keeps : int or None
        The helper into which M⁻¹ times the slopes go.
    opens : bool
        True for the first pass of a kick with force gradient, which leaves p as it is and keeps costly curvatures.
    turns : bool
        True for the second one: it makes the kick by the force as well, and takes the curvatures that were kept.
    """

    vectors: tuple[str, ...]
    slopes: Callable[[sp.Expr, Sequence[sp.Symbol], LatticeHamiltonian], list[sp.Expr]]
    keeps: int | None = None
    opens: bool = False
    turns: bool = False


def _slopes(f: sp.Expr, x: Sequence[sp.Symbol], lattice: LatticeHamiltonian) -> list[sp.Expr]:
    return [sp.diff(f, s) for s in x]


def _along(f: sp.Expr, x: Sequence[sp.Symbol], v: Sequence[sp.Symbol]) -> sp.Expr:
    return sp.Add(*[s * sp.diff(f, z) for z, s in zip(x, v, strict=True)])


def _product(f: sp.Expr, x: Sequence[sp.Symbol], lattice: LatticeHamiltonian) -> list[sp.Expr]:
    return _slopes(_along(f, x, lattice.v), x, lattice)


def _bent(f: sp.Expr, x: Sequence[sp.Symbol], lattice: LatticeHamiltonian) -> list[sp.Expr]:
    """∇²V w + ½ ∇³V(v, v)."""
    twice = _along(_along(f, x, lattice.v), x, lattice.v) / 2
    return _slopes(_along(f, x, lattice.w) + twice, x, lattice)


KICK = _Pass(("q",), _slopes)
ACCELERATION = _Pass(("q",), _slopes, 0, opens=True)
PRODUCT = _Pass(("q", "v"), _product, turns=True)
TURN = _Pass(("q", "v"), _product, 1, turns=True)
BEND = _Pass(("q", "v", "w"), _bent)
_LETTERS = {"q": "x", "v": "v", "w": "w"}


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
        margin = max(of_a_stage, tile // MARGIN) if self._tiled else self._reach
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
        module = _module(_definition(lattice), level, compensated, rate)
        size = self._size
        if _in_registers(lattice, level):
            size = (-(-planes // VECTOR) + (6 if level else 2)) * VECTOR
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


# code -------------------------------------------------------------------------------------------------------------


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
def _module(code: _Code, level: int, compensated: bool, rate: bool) -> ModuleType:
    lattice = code.lattice
    if _in_registers(lattice, level):
        return load_algebra(
            "import numpy as np\n\n\n" + _chain_source(lattice, level, compensated, rate),
            ("aligned", "sized_states", "chains"),
            (f"{constants_source(VECTOR=VECTOR)}\n\n\n{template('vectors')}",),
            VECTOR=VECTOR,
            GHOSTS=3 if level else 1,
            COPIED=2 if level else 1,
            N_FIELDS=len(lattice.fields),
            N_SETS=4 if compensated else 2,
            PERIODIC=lattice.boundary[0] == "periodic",
            FREE=lattice.boundary[0] == "free",
            COMPENSATED=compensated,
        )
    return load_algebra(
        "import numpy as np\n\n\n" + _stages_source(lattice, level, compensated, rate),
        ("aligned", "sized_states", "lattice"),
        N_VECTORS=len(_vectors(lattice)),
        N_AXES=len(lattice.shape),
        N_FIELDS=len(lattice.fields),
        N_SETS=4 if compensated else 2,
        N_HELPERS={0: 0, FORCE_GRADIENT: 1, CURVATURE: 2}[level],
        N_CURVATURES=len(_curvatures(lattice)) if level else 0,
        N_BONDS=sum(k > 1 for k in lattice.bonds) * len(lattice.fields),
        REACH=max(lattice.bonds, default=0),
        PERIODIC=tuple(b == "periodic" for b in lattice.boundary),
        COMPENSATED=compensated,
    )


def _vectors(lattice: LatticeHamiltonian) -> dict[str, str]:
    """The vectors of a state and of the working arrays: their names in the code, and where they are.

    For each field f, q_f and p_f have the errors of compensated sums, and v_f and w_f are the helpers.
    """
    fields = range(len(lattice.fields))
    arrays = sum(isinstance(value, np.ndarray) for value in lattice.params.values())
    sets = {"q": "X[0", "p": "X[1", "q_error": "X[2", "p_error": "X[3", "v": "A[0", "w": "A[1"}
    found = {f"{name}_of_{f}": f"{of_set}, {f}]" for name, of_set in sets.items() for f in fields}
    found |= {f"curvature_{k}": f"C[{k}]" for k in range(len(fields) * (len(fields) + 1))}
    found |= {f"flux_{k}": f"T[{k}]" for k in range(sum(k > 1 for k in lattice.bonds) * len(fields))}
    return found | {f"parameter_{i}": f"sites[{i}]" for i in range(arrays)}


class _Row:
    """The places in vectors where the rows begin that a loop reads, each computed once.

    They are unsigned: of an index that may be negative no loop of vector instructions is made.
    """

    def __init__(self, lattice: LatticeHamiltonian) -> None:
        self.lines: list[str] = []
        self._names: dict[str, str] = {}
        self._numbers = {name: k for k, name in enumerate(_vectors(lattice))}
        self.arrays = [name for name, value in lattice.params.items() if isinstance(value, np.ndarray)]
        self._letters = dict(zip(lattice.params, lattice.c, strict=True))

    def _element(self, vector: str, start: str) -> str:
        if start not in self._names:
            self._names[start] = f"place_{len(self._names)}"
            self.lines.append(f"{self._names[start]} = np.uint64({start})")
        return f"{self._numbers[vector]}, {vector}, {self._names[start]} + j"

    def at(self, vector: str, start: str) -> str:
        """Element j of a row of a vector that begins at `start`."""
        return f"element({self._element(vector, start)})"

    def put(self, vector: str, start: str, value: str) -> str:
        """The line that sets that element."""
        return f"set_element({self._element(vector, start)}, {value})"

    def parameters(self, f: Sequence[sp.Expr], start: str) -> dict[sp.Symbol, str]:
        """The elements that hold parameters of sites, for expressions at a place."""
        used = set().union(*(each.free_symbols for each in f))
        return {
            self._letters[name]: self.at(f"parameter_{i}", f"offset + {start}")
            for i, name in enumerate(self.arrays)
            if self._letters[name] in used
        }


class _Single(_Row):
    """The same of single elements, where a loop begins."""

    def at(self, vector: str, start: str) -> str:
        return f"{vector}[{start}]"

    def put(self, vector: str, start: str, value: str) -> str:
        return f"{vector}[{start}] = {value}"


def _value_lines(lattice: LatticeHamiltonian) -> list[str]:
    scalars = [s for s, v in zip(lattice.c, lattice.params.values(), strict=True) if not isinstance(v, np.ndarray)]
    return [f"{s} = values[{i}]" for i, s in enumerate(scalars)]


def _rows_source(lattice: LatticeHamiltonian, body: Sequence[str]) -> list[str]:
    """A loop over rows: their first sites `s`, their lengths `n`, and the ends of the lattice along them."""
    if len(lattice.shape) == 1:
        return ["s, n, first, last = low, high - low, begin, end", *body]
    reach = max(lattice.bonds, default=0)
    row = [f"s = i * geometry[1] + {reach}", "n = geometry[0]", "first, last = s, s + n"]
    if len(lattice.shape) == 2:
        return ["for i in range(low, high):", *_indented([*row, *body])]
    row[0] = f"s = i * geometry[1] + (k + {reach}) * geometry[2] + {reach}"
    return ["for i in range(low, high):", "    for k in range(geometry[3]):", *_indented(_indented([*row, *body]))]


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _pass_lines(lattice: LatticeHamiltonian, kind: _Pass, compensated: bool, drifts: bool) -> list[str]:
    """p −= b × the slopes of the sites of planes low … high; of passes that keep M⁻¹ × these, the last one does so.

    That of the accelerations keeps them and leaves p as it is, the next one makes both kicks: p is written once. If it
    `drifts`, q += drift × ∇T(p) follows at each site.
    """
    body: list[str] = []
    n_fields, fields = len(lattice.fields), range(len(lattice.fields))
    places: dict[tuple[int, int], int] = {}
    for k, V in lattice.bonds.items():
        if k > 1:
            body += _fluxes(lattice, kind, k, V, places)
    row = _Row(lattice)
    known: set[sp.Symbol] = set()
    lines: list[str] = []
    stored: dict[str, sp.Expr] = {}
    slopes: list[sp.Expr] = [sp.S.Zero] * n_fields

    def read(symbol: sp.Symbol, element: str) -> sp.Symbol:
        if symbol not in known:
            known.add(symbol)
            lines.append(f"{symbol} = {element}")
        return symbol

    if lattice.U != 0:
        own, stored, taken = _with_curvatures(lattice, kind, "onsite")
        all_own = [*own, *stored.values()]
        used = set().union(*(f.free_symbols for f in all_own))
        for vector in kind.vectors:
            for f, s in enumerate(getattr(lattice, _LETTERS[vector])):
                if s in used:
                    read(s, row.at(_field(vector, f), "s"))
        for s, element in row.parameters(all_own, "s").items():
            read(s, element)
        for s, array in taken.items():
            read(s, row.at(array, "s"))
        slopes = [a + b for a, b in zip(slopes, own, strict=True)]
    for (k, f), place in places.items():
        forward = read(sp.Symbol(f"forward_{place}", real=True), row.at(f"flux_{place}", str(k)))
        backward = read(sp.Symbol(f"backward_{place}", real=True), row.at(f"flux_{place}", "0"))
        slopes[f] += backward - forward
    for axis in range(len(lattice.shape) - 1):
        for k, V in lattice.bonds.items():
            more = _across(lattice, kind, axis, k, V, row, read, body)
            slopes = [a + b for a, b in zip(slopes, more, strict=True)]
    nearest = _Nearest.of(lattice, kind, row)
    for f in nearest.fields:
        slopes[f] += sp.Symbol(f"behind_{f}", real=True) - sp.Symbol(f"ahead_{f}", real=True)
    lines += statements([*(f"g_{f}" for f in fields), *map(_kept, stored)], vectorised([*slopes, *stored.values()]))
    lines += [row.put(array, "s", _kept(array)) for array in stored]
    lines += [f"behind_{f} = ahead_{f}" for f in nearest.fields]
    if kind.turns:
        lines += _impulse(lattice, row, [row.at(f"v_of_{f}", "s") for f in fields])
    if not kind.opens:
        for f in fields:
            turned = [f"-force*impulse_{f}"] if kind.turns else []
            lines += _moved(row, "p", f, [*turned, f"-b*g_{f}"], compensated)
    if kind.keeps is not None:
        lines += _velocity(lattice, row, [f"g_{f}" for f in fields], "u")
        lines += [row.put(f"{'vw'[kind.keeps]}_of_{f}", "s", f"u_{f}") for f in fields]
    if drifts:
        lines += _drifted(lattice, row, [f"new_p_{f}" for f in fields], compensated)
    free = bool(nearest.fields) and lattice.boundary[-1] == "free"
    loop = [*row.lines, *nearest.before, f"m = {'min(n, last - 1 - s)' if free else 'n'}"]
    loop += ["for j in range(np.uint64(m)):", *_indented([*nearest.lines, *lines])]
    if free:  # the last site has no bond ahead
        none = [f"ahead_{f} = 0.0" for f in nearest.fields]
        loop += ["for j in range(np.uint64(m), np.uint64(n)):", *_indented([*none, *lines])]
    return _rows_source(lattice, [*body, *loop])


def _curvatures(lattice: LatticeHamiltonian) -> list[tuple[str, int, int, sp.Expr]]:
    """The second derivatives of the potentials of a site and of a bond to the next one that are worth keeping.

    Of an exponential or a sine one derivative gives the other. A polynomial at a site is computed again in the time
    that it takes to store and load it; that of a bond needs two loads.
    """
    found = []
    for name, V, x in (("onsite", lattice.U, lattice.x), ("bond", lattice.bonds.get(1, sp.S.Zero), lattice.r)):
        for i, a in enumerate(x):
            for j, b in enumerate(x[: i + 1]):
                f = sp.diff(V, a, b)
                if not f.is_polynomial(*x) or (name == "bond" and f.free_symbols & set(x)):
                    found.append((name, i, j, f))
    return found


def _with_curvatures(
    lattice: LatticeHamiltonian, kind: _Pass, name: str
) -> tuple[list[sp.Expr], dict[str, sp.Expr], dict[sp.Symbol, str]]:
    """The slopes of a potential in a pass, with what it stores of each array of curvatures, and what it takes of them.

    Parameters
    ----------
    name : {"onsite", "bond"}
    """
    V, x = (lattice.U, lattice.x) if name == "onsite" else (lattice.bonds[1], lattice.r)
    slopes = kind.slopes(V, x, lattice)
    kept = [(f"curvature_{k}", *of) for k, (potential, *of) in enumerate(_curvatures(lattice)) if potential == name]
    if kind.opens:
        return slopes, {array: f for array, _, _, f in kept}, {}
    if not kind.turns:
        return slopes, {}, {}
    taken: dict[sp.Symbol, str] = {}
    H = sp.hessian(V, x)
    for array, i, j, _ in kept:
        H[i, j] = H[j, i] = sp.Symbol(f"curvature_{name}_{i}_{j}", real=True)
        taken[H[i, j]] = array
    return list(H * sp.Matrix(lattice.v)), {}, taken


@dataclass(frozen=True)
class _Nearest:
    """The bonds to the next site of a row: the slope of each is computed once, and kept for the site at its other end.

    Attributes
    ----------
    fields : list of int
        Those with slopes.
    lines : list of str
        For ``ahead_f``, those of the bond from the present site on.
    before : list of str
        For ``behind_f`` of the first site.
    """

    fields: list[int]
    lines: list[str]
    before: list[str]

    @classmethod
    def of(cls, lattice: LatticeHamiltonian, kind: _Pass, row: _Row) -> _Nearest:
        if 1 not in lattice.bonds:
            return cls([], [], [])
        found, stored, taken = _with_curvatures(lattice, kind, "bond")
        wanted = [f for f, slope in enumerate(found) if slope != 0]
        expressions = [*(found[f] for f in wanted), *stored.values()]

        def lines(
            at: Callable[[str, str], str],
            put: Callable[[str, str, str], str],
            parameters: dict[sp.Symbol, str],
            start: str,
            name: str,
        ) -> list[str]:
            code = [
                f"{s} = {at(_field(vector, f), f'{start} + 1')} - {at(_field(vector, f), start)}"
                for vector, f, s in _differences(lattice, kind, expressions)
            ]
            code += [f"{s} = {element}" for s, element in parameters.items()]
            code += [f"{s} = {at(array, start)}" for s, array in taken.items()]
            targets = [*(f"{name}_{f}" for f in wanted), *map(_kept, stored)]
            code += statements(targets, vectorised(expressions))
            return code + [put(array, start, _kept(array)) for array in stored]

        ahead = lines(row.at, row.put, row.parameters(expressions, "s"), "s", "ahead")
        one = _Single(lattice)
        first = lines(one.at, one.put, one.parameters(expressions, "s - 1"), "s - 1", "behind")
        if lattice.boundary[-1] == "free":
            first = [
                *(f"behind_{f} = 0.0" for f in wanted),
                "if s > first:",
                *_indented(first),
            ]
        return cls(wanted, ahead, first)


def _differences(
    lattice: LatticeHamiltonian, kind: _Pass, slopes: Sequence[sp.Expr]
) -> Iterator[tuple[str, int, sp.Symbol]]:
    """The differences along a bond that its slopes hold: of which vector and field, and their letter."""
    used = set().union(*(slope.free_symbols for slope in slopes))
    for vector in kind.vectors:
        letters = lattice.r if vector == "q" else getattr(lattice, _LETTERS[vector])
        for f, s in enumerate(letters):
            if s in used:
                yield vector, f, s


def _field(vector: str, f: int) -> str:
    return f"{vector}_of_{f}"


def _kept(array: str) -> str:
    return f"kept_{array}"


def _fluxes(
    lattice: LatticeHamiltonian, kind: _Pass, k: int, V: sp.Expr, places: dict[tuple[int, int], int]
) -> list[str]:
    """The slopes of the bonds of length k along a row into rows of T, the first of them that which ends at site s."""
    found = kind.slopes(V, lattice.r, lattice)
    wanted = [(f, slope) for f, slope in enumerate(found) if slope != 0]
    if not wanted:
        return []
    free = lattice.boundary[-1] == "free"
    row = _Row(lattice)
    lines = [
        f"{s} = {row.at(_field(vector, f), f'u + {k}')} - {row.at(_field(vector, f), 'u')}"
        for vector, f, s in _differences(lattice, kind, found)
    ]
    lines += [f"{s} = {element}" for s, element in row.parameters(found, "u").items()]
    lines += statements([f"g_{f}" for f, _ in wanted], vectorised([slope for _, slope in wanted]))
    head = [f"u, m = s - {k}, n + {k}"]
    if free:
        head = [f"u = max(s - {k}, first)", f"m = min(s + n, last - {k}) - u"]
    for f, _ in wanted:
        places[k, f] = len(places)
        start = f"u - s + {k}"
        lines.append(row.put(f"flux_{places[k, f]}", start, f"g_{f}"))
    body = [*head, *row.lines, "for j in range(np.uint64(m)):", *_indented(lines)]
    if free:
        for f, _ in wanted:
            place = places[k, f]
            body += [f"T[{place}, : u - s + {k}] = 0.0", f"T[{place}, u - s + {k} + m : n + {k}] = 0.0"]
    return body


def _across(
    lattice: LatticeHamiltonian,
    kind: _Pass,
    axis: int,
    k: int,
    V: sp.Expr,
    row: _Row,
    read: Callable[[sp.Symbol, str], sp.Symbol],
    body: list[str],
) -> list[sp.Expr]:
    """The slopes of sites by the bonds of length k to the rows before and behind, along another axis.

    Where an end is free and a bond is missing, that of the other side stands for it, times 0.
    """
    stride = f"geometry[{1 if axis == 0 else 2}]"
    free = lattice.boundary[axis] == "free"
    total: list[sp.Expr] = [sp.S.Zero] * len(lattice.fields)
    for side, sign in (("up", -1), ("down", 1)):
        tag = f"{side}_{axis}_{k}"
        start = "s" if side == "up" else f"s - {k} * {stride}"
        factor: sp.Expr = sp.S.One
        if free:
            position, low, high = ("i", "begin", "end") if axis == 0 else ("k", "0", "geometry[3]")
            there = f"{position} + {k} < {high}" if side == "up" else f"{position} - {k} >= {low}"
            other = f"s - {k} * {stride}" if side == "up" else "s"
            body += [f"start_{tag} = {start} if {there} else {other}", f"factor_{tag} = 1.0 if {there} else 0.0"]
            start, factor = f"start_{tag}", sp.Symbol(f"factor_{tag}", real=True)
        found = kind.slopes(V, lattice.r, lattice)
        renamed: dict[sp.Symbol, sp.Symbol] = {}
        for vector, f, s in _differences(lattice, kind, found):
            far, near = row.at(_field(vector, f), f"{start} + {k} * {stride}"), row.at(_field(vector, f), start)
            renamed[s] = read(sp.Symbol(f"{s}_{tag}", real=True), f"{far} - {near}")
        for s, element in row.parameters(found, start).items():
            renamed[s] = read(sp.Symbol(f"{s}_{tag}", real=True), element)
        total = [a + sign * factor * slope.xreplace(renamed) for a, slope in zip(total, found, strict=True)]
    return total


def _velocity(lattice: LatticeHamiltonian, row: _Row, momenta: Sequence[str], name: str) -> list[str]:
    """Lines for ∇T of one site at these momenta."""
    slopes = [sp.diff(lattice.T, s) for s in lattice.p]
    elements = row.parameters(slopes, "s")
    lines = [f"{s}_mass = {element}" for s, element in elements.items()]
    put = {s: sp.Symbol(m, real=True) for s, m in zip(lattice.p, momenta, strict=True)}
    put |= {s: sp.Symbol(f"{s}_mass", real=True) for s in elements}
    return lines + statements(
        [f"{name}_{f}" for f in range(len(slopes))], vectorised([f.xreplace(put) for f in slopes])
    )


def _impulse(lattice: LatticeHamiltonian, row: _Row, velocities: Sequence[str]) -> list[str]:
    """Lines for Mv of one site, where T = ½ pᵀM⁻¹p."""
    letters = [sp.Symbol(f"velocity_{f}", real=True) for f in range(len(velocities))]
    found = list(sp.hessian(lattice.T, lattice.p).inv() * sp.Matrix(letters))
    masses = row.parameters(found, "s")
    put = {s: sp.Symbol(f"{s}_of_v", real=True) for s in masses}
    lines = [f"{s} = {v}" for s, v in zip(letters, velocities, strict=True)]
    lines += [f"{put[s]} = {element}" for s, element in masses.items()]
    return lines + statements([f"impulse_{f}" for f in range(len(letters))], [f.xreplace(put) for f in found])


def _moved(row: _Row, vector: str, f: int, changes: Sequence[str], compensated: bool) -> list[str]:
    """Lines that add changes to q or p of field f at one site, and leave its value in ``new_q_f`` or ``new_p_f``."""
    x, error = f"new_{vector}_{f}", f"{vector}_error_of_{f}"
    lines = [f"{x} = {row.at(_field(vector, f), 's')}"]
    if not compensated:
        return [*lines, *(f"{x} = {x} + {change}" for change in changes), row.put(_field(vector, f), "s", x)]
    lines.append(f"error = {row.at(error, 's')}")
    for change in changes:
        lines += [
            f"corrected = {change} - error",
            f"total = {x} + corrected",
            f"error = (total - {x}) - corrected",
            f"{x} = total",
        ]
    return [*lines, row.put(_field(vector, f), "s", x), row.put(error, "s", "error")]


def _drifted(lattice: LatticeHamiltonian, row: _Row, momenta: Sequence[str], compensated: bool) -> list[str]:
    """Lines for q += drift × ∇T of one site at these momenta."""
    lines = _velocity(lattice, row, momenta, "u")
    for f in range(len(momenta)):
        lines += _moved(row, "q", f, [f"drift*u_{f}"], compensated)
    return lines


def _drift_lines(lattice: LatticeHamiltonian, compensated: bool) -> list[str]:
    """q += drift × ∇T(p)."""
    row, fields = _Row(lattice), range(len(lattice.fields))
    lines = [f"old_{f} = {row.at(_field('p', f), 's')}" for f in fields]
    lines += _drifted(lattice, row, [f"old_{f}" for f in fields], compensated)
    return _rows_source(lattice, [*row.lines, "for j in range(np.uint64(n)):", *_indented(lines)])


def _decay_lines(lattice: LatticeHamiltonian) -> list[str]:
    """p *= b."""
    row = _Row(lattice)
    lines = [row.put(_field("p", f), "s", f"b*{row.at(_field('p', f), 's')}") for f in range(len(lattice.fields))]
    return _rows_source(lattice, [*row.lines, "for j in range(np.uint64(n)):", *_indented(lines)])


def _stages_source(lattice: LatticeHamiltonian, level: int, compensated: bool, rate: bool) -> str:
    """``stages``, the loop over kicks and drifts: see the text `lattice`.

    All passes stand in it as they are: a function that is given arrays counts references to them, which takes as long
    as a pass over a hundred sites.
    """
    inside = "low, high = max(lo, begin), min(hi, end)"
    fused = len(lattice.shape) == 1

    def passed(kind: _Pass, b: str, vector: str, last: bool = False) -> list[str]:
        return [
            "if not whole:",
            "    lo, hi = lo + REACH, hi - REACH",
            f"b, {inside.replace(' = ', f' = {b}, ')}",
            *_refreshed(lattice, vector),
            *_pass_lines(lattice, kind, compensated, last and fused),
        ]

    accelerated = ["force = table[1, column]", *passed(ACCELERATION, "force", "q")]
    cases = [("table[1, column] != 0.0", passed(KICK, "table[1, column]", "q", True))]
    if level:
        turned = [*accelerated, *passed(PRODUCT, "-table[2, column]", "v", True)]
        cases.insert(0, ("table[2, column] != 0.0", turned))
    if level == CURVATURE:
        turned = [*accelerated, *passed(TURN, "-table[2, column]", "v"), *passed(BEND, "table[3, column]", "w", True)]
        cases.insert(0, ("table[3, column] != 0.0", turned))
    row = 0
    if rate:
        row = {0: 2, FORCE_GRADIENT: 3, CURVATURE: 4}[level]
    drifts = [inside, *_drift_lines(lattice, compensated)]
    lines = [f"drift = table[{row}, column]"]
    for k, (condition, body) in enumerate(cases):
        lines += [f"{'elif' if k else 'if'} {condition}:", *_indented(body)]
    lines += [f"{'elif' if fused else 'if'} drift != 0.0:", *_indented(drifts)]
    if rate:
        lines += [f"b, {inside.replace(' = ', f' = table[{row + 1}, column], ')}", *_decay_lines(lattice)]
    lines += ["column = column + 1 if single or column < link else 1"]
    arguments = "X, table, column, n_stages, single, work, whole, lo, hi, begin, end, geometry, sites, offset, values"
    head = [f"@njit(**OPTIONS)\ndef stages({arguments}):", "link = table.shape[1] - 2", "A, T, C = work"]
    used = [f"{name} = {place}" for name, place in _vectors(lattice).items() if any(name in line for line in lines)]
    return "\n    ".join(
        [*head, *_value_lines(lattice), *used, "for _ in range(n_stages):", *_indented(lines), "return column"]
    )


def _refreshed(lattice: LatticeHamiltonian, vector: str) -> list[str]:
    """The ghosts of a vector of each field, before a pass over planes low … high."""
    if len(lattice.shape) > 1:
        place = {"q": "X, 0", "v": "A, 0", "w": "A, 1"}[vector]
        return [f"refresh({place}, low, high, begin, end, whole, geometry)"]
    if lattice.boundary[0] != "periodic":
        return []
    lines = [
        f"{_field(vector, f)}[np.uint64({place})] = {_field(vector, f)}[np.uint64({other})]"
        for f in range(len(lattice.fields))
        for k in range(max(lattice.bonds, default=0))
        for place, other in ((f"begin - {k + 1}", f"end - {k + 1}"), (f"end + {k}", f"begin + {k}"))
    ]
    return ["if whole:", *_indented(lines)] if lines else []


# chains in vector registers -----------------------------------------------------------------------------------------


def _in_registers(lattice: LatticeHamiltonian, level: int) -> bool:
    """True for chains of which the text `chains` makes the stages: bonds to the next site, sums, products and ratios.

    Other functions are faster in loops that LLVM turns into vector instructions, which is where most of the time goes.
    """
    if len(lattice.shape) > 1 or set(lattice.bonds) != {1} or level == CURVATURE:
        return False
    terms = lattice.U, lattice.bonds[1], lattice.T
    powers = set[sp.Expr]().union(*(f.atoms(sp.Pow) for f in terms))
    rational = all(f.is_rational_function(*f.free_symbols) for f in terms)
    return rational and all(abs(power.exp) < HIGHEST_POWER for power in powers)


class _LaneRow(_Row):
    """Rows of sites side by side, see the text `chains`: the present one is "s", those after it "s + 1", "s + 2"."""

    def at(self, vector: str, start: str) -> str:
        return f"lanes_at({vector}, {self._place(start)})"

    def put(self, vector: str, start: str, value: str) -> str:
        return f"put_lanes({vector}, {self._place(start)}, {value})"

    def parameters(self, f: Sequence[sp.Expr], start: str) -> dict[sp.Symbol, str]:
        used = set().union(*(each.free_symbols for each in f))
        return {
            self._letters[name]: self.at(f"parameter_{i}", start)
            for i, name in enumerate(self.arrays)
            if self._letters[name] in used
        }

    @staticmethod
    def _place(start: str) -> str:
        return start.replace("s", "place").replace("1", "VECTOR").replace("2", "2 * VECTOR")


def _chain_lines(lattice: LatticeHamiltonian, level: int, compensated: bool) -> list[str]:
    """Lines of a stage with a kick: rows one after the other, first those before the segments, of which none moves.

    The force of the bond to the next site is its tension. With a force gradient, slopes and M⁻¹ × these are made one
    row ahead of the kicks, and a bond turns p by its second derivatives, its bends, along the difference of these.
    What ends in ``_next`` goes over to the next row.
    """
    fields, row = range(len(lattice.fields)), _LaneRow(lattice)
    free, fixed = (lattice.boundary[0] == end for end in ("free", "fixed"))
    ahead, shift = ("s + 1", 1) if level else ("s", 0)

    def named(symbols: Sequence[sp.Symbol], tag: str) -> dict[sp.Symbol, sp.Symbol]:
        return {s: sp.Symbol(f"{s}_{tag}", real=True) for s in symbols}

    def put(f: Sequence[sp.Expr], names: Sequence[str], start: str, letters: dict[sp.Symbol, sp.Symbol]) -> list[str]:
        """The lines of expressions whose parameters are those of a row."""
        elements = row.parameters(f, start)
        own = {s: sp.Symbol(f"{s}_here", real=True) for s in elements}
        lines = [f"{own[s]} = {element}" for s, element in elements.items()]
        return lines + statements(names, [each.xreplace(letters | own) for each in f])

    forces = _slopes(lattice.bonds[1], lattice.r, lattice)
    bent = [sp.diff(f, s) for f in forces for s in lattice.r] if level else []
    behind = [f for f in fields if forces[f] != 0]
    lines = [f"x_{f}_next = {row.at(_field('q', f), f's + {shift + 1}')}" for f in fields]
    lines += [f"r_{f} = x_{f}_next - x_{f}_ahead" for f in fields]
    kept = [k for k, f in enumerate(bent) if f.free_symbols & set(lattice.r)]
    lines += put(
        [*(forces[f] for f in behind), *(bent[k] for k in kept)],
        [*(f"tension_{f}_next" for f in behind), *(f"bent_{k}_next" for k in kept)],
        ahead,
        {},
    )
    if free:
        lines += [f"tension_{f}_next = lanes_where({row.at('there', ahead)}, tension_{f}_next)" for f in behind]
    own = _slopes(lattice.U, lattice.x, lattice)
    pulled = [
        sp.Symbol(f"tension_{f}", real=True) - sp.Symbol(f"tension_{f}_next", real=True) if f in behind else 0
        for f in fields
    ]
    lines += put(
        [a + b for a, b in zip(own, pulled, strict=True)],
        [f"slope_{f}_next" for f in fields],
        ahead,
        named(lattice.x, "ahead"),
    )
    moved: list[str]
    if not level:
        moved = []
        for f in fields:
            moved += _moved(row, "p", f, [f"-b*slope_{f}_next"], compensated)
    else:
        found = [sp.diff(lattice.T, s) for s in lattice.p]
        put_in = {s: sp.Symbol(f"slope_{f}_next", real=True) for f, s in enumerate(lattice.p)}
        lines += put(found, [f"v_{f}_next" for f in fields], ahead, put_in)
        if fixed:
            lines += [f"v_{f}_next = lanes_where({row.at('there', ahead)}, v_{f}_next)" for f in fields]
        n = len(fields)
        bends = [sp.Symbol(f"bent_{k}", real=True) if k in kept else f for k, f in enumerate(bent)]
        relative = [sp.Symbol(f"relative_{f}", real=True) for f in fields]
        products = list(sp.Matrix(n, n, bends) * sp.Matrix(relative))
        lines += [f"relative_{f} = v_{f}_next - v_{f}" for f in fields]
        turned = [f for f in fields if products[f] != 0]
        lines += put([products[f] for f in turned], [f"turn_{f}_next" for f in turned], "s", {})
        if free:
            lines += [f"turn_{f}_next = lanes_where({row.at('there', 's')}, turn_{f}_next)" for f in turned]
        along = [
            a + (sp.Symbol(f"turn_{f}", real=True) - sp.Symbol(f"turn_{f}_next", real=True) if f in turned else 0)
            for f, a in enumerate(_product(lattice.U, lattice.x, lattice))
        ]
        moved = put(along, [f"g_{f}" for f in fields], "s", named(lattice.x, "here"))
        for f in fields:
            moved += _moved(row, "p", f, [f"-force*slope_{f}", f"-b*g_{f}"], compensated)
    moved += _drifted(lattice, row, [f"new_p_{f}" for f in fields], compensated)
    windows = [f"tension_{f}" for f in behind]
    if level:
        windows += [*(f"bent_{k}" for k in kept), *(f"v_{f}" for f in fields)]
        windows += [*(f"slope_{f}" for f in fields), *(f"turn_{f}" for f in turned)]
    after = [f"{name} = all_lanes({name}_next)" for name in windows]
    if level:
        after += [f"x_{f}_here = x_{f}_ahead" for f in fields]
    after += [f"x_{f}_ahead = x_{f}_next" for f in fields]
    nothing = windows + ([f"x_{f}_here" for f in fields] if level else [])
    rows = 2 * shift + 1
    return [
        f"for i in range({'len(ghosts)' if level else 'nearest'}):",
        *_indented([f"{_field('q', f)}[ghosts[i, 0]] = {_field('q', f)}[ghosts[i, 1]]" for f in fields]),
        *(f"{name} = all_lanes(0.0)" for name in nothing),
        f"place = (GHOSTS - {rows}) * VECTOR",
        *(f"x_{f}_ahead = {row.at(_field('q', f), ahead)}" for f in fields),
        f"for k in range({rows}):",
        f"    place = (GHOSTS - {rows} + k) * VECTOR",
        *_indented([*lines, *after]),
        "for k in range(rows):",
        "    place = (GHOSTS + k) * VECTOR",
        *_indented([*lines, *moved, *after]),
    ]


def _chain_source(lattice: LatticeHamiltonian, level: int, compensated: bool, rate: bool) -> str:
    """``stages`` of the text `chains`."""
    row, fields = _LaneRow(lattice), range(len(lattice.fields))
    cases = [("table[1, column] != 0.0", ["b = table[1, column]", *_chain_lines(lattice, 0, compensated)])]
    if level:
        numbers = ["force, b = table[1, column], -table[2, column]"]
        cases.insert(0, ("table[2, column] != 0.0", [*numbers, *_chain_lines(lattice, level, compensated)]))
    old = [f"old_{f} = {row.at(_field('p', f), 's')}" for f in fields]
    alone = [*old, *_drifted(lattice, row, [f"old_{f}" for f in fields], compensated)]
    each = ["for k in range(rows):", "    place = (GHOSTS + k) * VECTOR"]
    cases.append(("drift != 0.0", [*each, *_indented(alone)]))
    lines = [f"drift = table[{2 + level if rate else 0}, column]"]
    for k, (condition, body) in enumerate(cases):
        lines += [f"{'elif' if k else 'if'} {condition}:", *_indented(body)]
    if rate:
        decay = [row.put(_field("p", f), "s", f"b*{row.at(_field('p', f), 's')}") for f in fields]
        lines += [f"b = table[{3 + level}, column]", *each, *_indented(decay)]
    lines += ["column = column + 1 if single or column < link else 1"]
    head = [
        "@njit(**OPTIONS)\ndef stages(X, table, column, n_stages, single, work, rows, values):",
        "link = table.shape[1] - 2",
        "ghosts, nearest, there, sites = work",
    ]
    used = [f"{name} = {place}" for name, place in _vectors(lattice).items() if any(name in line for line in lines)]
    return "\n    ".join(
        [*head, *_value_lines(lattice), *used, "for _ in range(n_stages):", *_indented(lines), "return column"]
    )
