"""Code of stages of lattices as passes over sites, of which LLVM makes vector instructions: see the text `lattice`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import sympy as sp

from sympflow.hamiltonian.lattice import LatticeHamiltonian
from sympflow.kernels.codegen import statements, vectorised
from sympflow.kernels.lattice_sites import (
    Row,
    drifted,
    field,
    indented,
    moved,
    products_of,
    slopes_of,
    value_lines,
    vectors_of,
    velocity_lines,
)
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

__all__ = ["curvatures_of", "stages_in_passes"]


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


def _along(f: sp.Expr, x: Sequence[sp.Symbol], v: Sequence[sp.Symbol]) -> sp.Expr:
    return sp.Add(*[s * sp.diff(f, z) for z, s in zip(x, v, strict=True)])


def _bent(f: sp.Expr, x: Sequence[sp.Symbol], lattice: LatticeHamiltonian) -> list[sp.Expr]:
    """∇²V w + ½ ∇³V(v, v)."""
    twice = _along(_along(f, x, lattice.v), x, lattice.v) / 2
    return slopes_of(_along(f, x, lattice.w) + twice, x, lattice)


KICK = _Pass(("q",), slopes_of)
ACCELERATION = _Pass(("q",), slopes_of, 0, opens=True)
PRODUCT = _Pass(("q", "v"), products_of, turns=True)
TURN = _Pass(("q", "v"), products_of, 1, turns=True)
BEND = _Pass(("q", "v", "w"), _bent)
_LETTERS = {"q": "x", "v": "v", "w": "w"}


class _Single(Row):
    """The same of single elements, where a loop begins."""

    def at(self, vector: str, start: str) -> str:
        return f"{vector}[{start}]"

    def put(self, vector: str, start: str, value: str) -> str:
        return f"{vector}[{start}] = {value}"


def _rows_source(lattice: LatticeHamiltonian, body: Sequence[str]) -> list[str]:
    """A loop over rows: their first sites `s`, their lengths `n`, and the ends of the lattice along them."""
    if len(lattice.shape) == 1:
        return ["s, n, first, last = low, high - low, begin, end", *body]
    reach = max(lattice.bonds, default=0)
    row = [f"s = i * geometry[1] + {reach}", "n = geometry[0]", "first, last = s, s + n"]
    if len(lattice.shape) == 2:
        return ["for i in range(low, high):", *indented([*row, *body])]
    row[0] = f"s = i * geometry[1] + (k + {reach}) * geometry[2] + {reach}"
    return ["for i in range(low, high):", "    for k in range(geometry[3]):", *indented(indented([*row, *body]))]


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
    row = Row(lattice)
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
        own, stored, taken = _withcurvatures_of(lattice, kind, "onsite")
        all_own = [*own, *stored.values()]
        used = set().union(*(f.free_symbols for f in all_own))
        for vector in kind.vectors:
            for f, s in enumerate(getattr(lattice, _LETTERS[vector])):
                if s in used:
                    read(s, row.at(field(vector, f), "s"))
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
            more = _across(lattice, kind, axis, k, V, row, read, body, lines)
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
            lines += moved(row, "p", f, [*turned, f"-b*g_{f}"], compensated)
    if kind.keeps is not None:
        lines += velocity_lines(lattice, row, [f"g_{f}" for f in fields], "u")
        lines += [row.put(f"{'vw'[kind.keeps]}_of_{f}", "s", f"u_{f}") for f in fields]
    if drifts:
        lines += drifted(lattice, row, [f"new_p_{f}" for f in fields], compensated)
    free = bool(nearest.fields) and lattice.boundary[-1] == "free"
    loop = [*row.lines, *nearest.before, f"m = {'min(n, last - 1 - s)' if free else 'n'}"]
    loop += ["for j in range(np.uint64(m)):", *indented([*nearest.lines, *lines])]
    if free:  # the last site has no bond ahead
        none = [f"ahead_{f} = 0.0" for f in nearest.fields]
        loop += ["for j in range(np.uint64(m), np.uint64(n)):", *indented([*none, *lines])]
    return _rows_source(lattice, [*body, *loop])


def curvatures_of(lattice: LatticeHamiltonian) -> list[tuple[str, int, int, sp.Expr]]:
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


def _withcurvatures_of(
    lattice: LatticeHamiltonian, kind: _Pass, name: str
) -> tuple[list[sp.Expr], dict[str, sp.Expr], dict[sp.Symbol, str]]:
    """The slopes of a potential in a pass, with what it stores of each array of curvatures, and what it takes of them.

    Parameters
    ----------
    name : {"onsite", "bond"}
    """
    V, x = (lattice.U, lattice.x) if name == "onsite" else (lattice.bonds[1], lattice.r)
    slopes = kind.slopes(V, x, lattice)
    kept = [(f"curvature_{k}", *of) for k, (potential, *of) in enumerate(curvatures_of(lattice)) if potential == name]
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
    def of(cls, lattice: LatticeHamiltonian, kind: _Pass, row: Row) -> _Nearest:
        if 1 not in lattice.bonds:
            return cls([], [], [])
        found, stored, taken = _withcurvatures_of(lattice, kind, "bond")
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
                f"{s} = {at(field(vector, f), f'{start} + 1')} - {at(field(vector, f), start)}"
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
        if lattice.boundary[-1] == "free" and first:
            first = [*(f"behind_{f} = 0.0" for f in wanted), "if s > first:", *indented(first)]
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
    row = Row(lattice)
    lines = [
        f"{s} = {row.at(field(vector, f), f'u + {k}')} - {row.at(field(vector, f), 'u')}"
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
    body = [*head, *row.lines, "for j in range(np.uint64(m)):", *indented(lines)]
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
    row: Row,
    read: Callable[[sp.Symbol, str], sp.Symbol],
    body: list[str],
    lines: list[str],
) -> list[sp.Expr]:
    """The slopes of sites by the bonds of length k to the rows before and behind, along another axis.

    Where an end is free, that of a missing bond is left out: it may be anything, and 0 times it no number.
    """
    stride = f"geometry[{1 if axis == 0 else 2}]"
    free = lattice.boundary[axis] == "free"
    position, low, high = ("i", "begin", "end") if axis == 0 else ("k", "0", "geometry[3]")
    total: list[sp.Expr] = [sp.S.Zero] * len(lattice.fields)
    for side, sign in (("up", -1), ("down", 1)):
        tag = f"{side}_{axis}_{k}"
        start = "s" if side == "up" else f"s - {k} * {stride}"
        found = kind.slopes(V, lattice.r, lattice)
        renamed: dict[sp.Symbol, sp.Symbol] = {}
        for vector, f, s in _differences(lattice, kind, found):
            far, near = row.at(field(vector, f), f"{start} + {k} * {stride}"), row.at(field(vector, f), start)
            renamed[s] = read(sp.Symbol(f"{s}_{tag}", real=True), f"{far} - {near}")
        for s, element in row.parameters(found, start).items():
            renamed[s] = read(sp.Symbol(f"{s}_{tag}", real=True), element)
        slopes = [slope.xreplace(renamed) for slope in found]
        if free:
            there = f"{position} + {k} < {high}" if side == "up" else f"{position} - {k} >= {low}"
            body.append(f"there_{tag} = {there}")
            names = [f"slope_{tag}_{f}" for f in range(len(slopes))]
            lines += statements(names, vectorised(slopes))
            lines += [f"{name} = {name} if there_{tag} else 0.0" for name in names]
            slopes = [sp.Symbol(name, real=True) for name in names]
        total = [a + sign * slope for a, slope in zip(total, slopes, strict=True)]
    return total


def _impulse(lattice: LatticeHamiltonian, row: Row, velocities: Sequence[str]) -> list[str]:
    """Lines for Mv of one site, where T = ½ pᵀM⁻¹p."""
    letters = [sp.Symbol(f"velocity_{f}", real=True) for f in range(len(velocities))]
    found = list(sp.hessian(lattice.T, lattice.p).inv() * sp.Matrix(letters))
    masses = row.parameters(found, "s")
    put = {s: sp.Symbol(f"{s}_of_v", real=True) for s in masses}
    lines = [f"{s} = {v}" for s, v in zip(letters, velocities, strict=True)]
    lines += [f"{put[s]} = {element}" for s, element in masses.items()]
    return lines + statements([f"impulse_{f}" for f in range(len(letters))], [f.xreplace(put) for f in found])


def _drift_lines(lattice: LatticeHamiltonian, compensated: bool) -> list[str]:
    """q += drift × ∇T(p)."""
    row, fields = Row(lattice), range(len(lattice.fields))
    lines = [f"old_{f} = {row.at(field('p', f), 's')}" for f in fields]
    lines += drifted(lattice, row, [f"old_{f}" for f in fields], compensated)
    return _rows_source(lattice, [*row.lines, "for j in range(np.uint64(n)):", *indented(lines)])


def _decay_lines(lattice: LatticeHamiltonian) -> list[str]:
    """p *= b."""
    row = Row(lattice)
    lines = [row.put(field("p", f), "s", f"b*{row.at(field('p', f), 's')}") for f in range(len(lattice.fields))]
    return _rows_source(lattice, [*row.lines, "for j in range(np.uint64(n)):", *indented(lines)])


def stages_in_passes(lattice: LatticeHamiltonian, level: int, compensated: bool, rate: bool) -> str:
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
        lines += [f"{'elif' if k else 'if'} {condition}:", *indented(body)]
    lines += [f"{'elif' if fused else 'if'} drift != 0.0:", *indented(drifts)]
    if rate:
        lines += [f"b, {inside.replace(' = ', f' = table[{row + 1}, column], ')}", *_decay_lines(lattice)]
    lines += ["column = column + 1 if single or column < link else 1"]
    arguments = "X, table, column, n_stages, single, work, whole, lo, hi, begin, end, geometry, sites, offset, values"
    head = [f"@njit(**OPTIONS)\ndef stages({arguments}):", "link = table.shape[1] - 2", "A, T, C = work"]
    used = [f"{name} = {place}" for name, place in vectors_of(lattice).items() if any(name in line for line in lines)]
    return "\n    ".join(
        [*head, *value_lines(lattice), *used, "for _ in range(n_stages):", *indented(lines), "return column"]
    )


def _refreshed(lattice: LatticeHamiltonian, vector: str) -> list[str]:
    """The ghosts of a vector of each field, before a pass over planes low … high."""
    if len(lattice.shape) > 1:
        place = {"q": "X, 0", "v": "A, 0", "w": "A, 1"}[vector]
        return [f"refresh({place}, low, high, begin, end, whole, geometry)"]
    if lattice.boundary[0] != "periodic":
        return []
    lines = [
        f"{field(vector, f)}[np.uint64({place})] = {field(vector, f)}[np.uint64({other})]"
        for f in range(len(lattice.fields))
        for k in range(max(lattice.bonds, default=0))
        for place, other in ((f"begin - {k + 1}", f"end - {k + 1}"), (f"end + {k}", f"begin + {k}"))
    ]
    return ["if whole:", *indented(lines)] if lines else []
