"""Code of stages of lattices of one and two axes in vector registers: see the texts `segments`, `chains`, `sheets`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import llvmlite.binding
import sympy as sp

from sympflow.hamiltonian.lattice import LatticeHamiltonian
from sympflow.kernels.codegen import statements
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
)
from sympflow.schemes import CURVATURE

__all__ = ["VECTOR", "constants_of", "in_registers", "size_in_registers", "stages_in_registers"]

VECTOR = 8 if llvmlite.binding.get_host_cpu_features().get("avx512f", False) else 4
"""Numbers side by side in a register."""
HIGHEST_POWER = 16
"""Lower powers are products."""


def in_registers(lattice: LatticeHamiltonian, level: int) -> bool:
    """True for chains and sheets with bonds to the next site, of sums, products and ratios, that fill a register.

    Other functions are faster in loops that LLVM turns into vector instructions, which is where most of the time goes.
    """
    if len(lattice.shape) > 2 or lattice.shape[-1] < VECTOR or set(lattice.bonds) != {1} or level == CURVATURE:
        return False
    terms = {lattice.U: lattice.x, lattice.bonds[1]: lattice.r, lattice.T: lattice.p}
    derived = [f for V, x in terms.items() for f in _derivatives(V, x, 2 if level else 1)]
    powers = set[sp.Expr]().union(*(f.atoms(sp.Pow) for f in derived))
    rational = all(f.is_rational_function(*f.free_symbols) for f in terms)
    return rational and all(abs(power.exp) < HIGHEST_POWER for power in powers)


def _derivatives(f: sp.Expr, x: Sequence[sp.Symbol], order: int) -> list[sp.Expr]:
    """The first derivatives of f, and those up to an order."""
    found = [sp.diff(f, s) for s in x]
    return found + [g for each in found for g in _derivatives(each, x, order - 1)] if order > 1 else found


def constants_of(lattice: LatticeHamiltonian, level: int) -> dict[str, Any]:
    """The constants of the text `chains` or `sheets`."""
    first, last = lattice.boundary[0], lattice.boundary[-1]
    found = {"ARRAYS": not lattice.uniform, "PERIODIC": first == "periodic", "FREE": first == "free"}
    if len(lattice.shape) == 1:
        return found | {"GHOSTS": 3 if level else 1}
    row = {"ROW_PERIODIC": last == "periodic", "ROW_FREE": last == "free"}
    return found | row | {"GHOSTS": 1, "BEYOND": 2 if level else 1, "N_KEPT": len(_KEPT) if level else 1}


def size_in_registers(lattice: LatticeHamiltonian, level: int) -> int:
    """The length of a vector of all sites."""
    constants, n = constants_of(lattice, level), lattice.shape[-1]
    width = (n - (VECTOR - 1) * (n // VECTOR) + 2 * constants["GHOSTS"]) * VECTOR
    return width if len(lattice.shape) == 1 else (lattice.shape[0] + 2 * constants["BEYOND"]) * width


def stages_in_registers(lattice: LatticeHamiltonian, level: int, compensated: bool, rate: bool) -> str:
    """``stages`` of the text `chains` or `sheets`."""
    row, fields = _LaneRow(lattice), range(len(lattice.fields))
    is_chain = len(lattice.shape) == 1
    kick, each = (_chain_lines, _each_of_chain) if is_chain else (_sheet_lines, _each_of_sheet)
    cases = [("table[1, column] != 0.0", ["b = table[1, column]", *kick(lattice, 0, compensated)])]
    if level:
        numbers = ["force, b = table[1, column], -table[2, column]"]
        cases.insert(0, ("table[2, column] != 0.0", [*numbers, *kick(lattice, level, compensated)]))
    old = [f"old_{f} = {row.at(field('p', f), 's')}" for f in fields]
    cases.append(("drift != 0.0", each([*old, *drifted(lattice, row, [f"old_{f}" for f in fields], compensated)])))
    lines = [f"drift = table[{2 + level if rate else 0}, column]"]
    for k, (condition, body) in enumerate(cases):
        lines += [f"{'elif' if k else 'if'} {condition}:", *indented(body)]
    if rate:
        decay = [row.put(field("p", f), "s", f"b*{row.at(field('p', f), 's')}") for f in fields]
        lines += [f"b = table[{3 + level}, column]", *each(decay)]
    lines += ["column = column + 1 if single or column < link else 1"]
    shape, work = ("n", "there, sites") if is_chain else ("n_rows, n", "there, there_of_rows, sites, kept")
    head = [
        f"@njit(**OPTIONS)\ndef stages(X, table, column, n_stages, single, work, {shape}, ring, values):",
        "link, n_places = table.shape[1] - 2, rows_of(n)",
        f"{work} = work",
    ]
    if not is_chain:
        head.append("width = width_of(n)")
    kept = {f"kept_{name}_{f}": f"kept[{k}, {f}]" for k, name in enumerate(_KEPT) for f in fields}
    vectors = vectors_of(lattice) | kept
    used = [f"{name} = {place}" for name, place in vectors.items() if any(name in line for line in lines)]
    return "\n    ".join(
        [*head, *value_lines(lattice), *used, "for _ in range(n_stages):", *indented(lines), "return column"]
    )


class _LaneRow(Row):
    """Sites side by side: the present ones are those at "s", the next ones of a row those at "s + VECTOR"."""

    def at(self, vector: str, start: str) -> str:
        return f"lanes_at({vector}, {start.replace('s', 'place')})"

    def put(self, vector: str, start: str, value: str) -> str:
        return f"put_lanes({vector}, {start.replace('s', 'place')}, {value})"

    def parameters(self, f: Sequence[sp.Expr], start: str) -> dict[sp.Symbol, str]:
        return self._parameters(f, start)

    def code(
        self,
        f: Sequence[sp.Expr],
        names: Sequence[str],
        start: str,
        letters: dict[sp.Symbol, sp.Symbol] | None = None,
    ) -> list[str]:
        """The lines of expressions whose parameters are those of sites."""
        elements = self.parameters(f, start)
        own = {s: sp.Symbol(f"{s}_here", real=True) for s in elements}
        lines = [f"{own[s]} = {element}" for s, element in elements.items()]
        return lines + statements(names, [each.xreplace((letters or {}) | own) for each in f])


def _tagged(symbols: Sequence[sp.Symbol], tag: str) -> dict[sp.Symbol, sp.Symbol]:
    return {s: sp.Symbol(f"{s}_{tag}", real=True) for s in symbols}


def _symbols(name: str, n: int) -> list[sp.Symbol]:
    return [sp.Symbol(name.format(f), real=True) for f in range(n)]


def _named(name: str, numbers: Iterable[int]) -> list[str]:
    return [f"{name}_{k}" for k in numbers]


@dataclass(frozen=True)
class _Bond:
    """The expressions of a bond: its tension, which is its slopes, and how it turns p along a direction.

    They are in the differences r of q along it, and ``relative`` of that direction. Its bends are second derivatives,
    those that are no constants being named ``bent``.

    Attributes
    ----------
    tensions, turns : dict of int to Expr
        By the field that they act on.
    bends : dict of int to Expr
        By their number, those that are no constants.
    """

    tensions: dict[int, sp.Expr]
    bends: dict[int, sp.Expr]
    turns: dict[int, sp.Expr]

    @classmethod
    def of(cls, lattice: LatticeHamiltonian, level: int) -> _Bond:
        n, forces = len(lattice.fields), slopes_of(lattice.bonds[1], lattice.r, lattice)
        tensions = {f: force for f, force in enumerate(forces) if force != 0}
        if not level:
            return cls(tensions, {}, {})
        bends = [sp.diff(f, s) for f in forces for s in lattice.r]
        named = {k: f for k, f in enumerate(bends) if f.free_symbols & set(lattice.r)}
        matrix = [sp.Symbol(f"bent_{k}", real=True) if k in named else f for k, f in enumerate(bends)]
        products = sp.Matrix(n, n, matrix) * sp.Matrix(_symbols("relative_{}", n))
        return cls(tensions, named, {f: turn for f, turn in enumerate(products) if turn != 0})


def _balance(own: Sequence[sp.Expr], acted: Iterable[int], plus: Sequence[str], minus: Sequence[str]) -> list[sp.Expr]:
    """What acts on a site by itself, and what its bonds add to that of some fields."""
    total = list(own)
    for f in acted:
        for there, here in zip(plus, minus, strict=True):
            total[f] += sp.Symbol(there.format(f), real=True) - sp.Symbol(here.format(f), real=True)
    return total


def _left_out(there: str, names: Sequence[str], away: bool) -> list[str]:
    """The lines that leave out what is beyond an end."""
    return [f"{name} = lanes_where({there}, {name})" for name in names] if away else []


def _next(names: Sequence[str]) -> list[str]:
    return [f"{name}_next" for name in names]


def _in_lanes(names: Sequence[str]) -> list[str]:
    """Spread over lanes what may be a number, of bonds whose slope is one."""
    return [f"{name} = all_lanes({name})" for name in names]


def _handed_on(names: Sequence[str]) -> list[str]:
    """What goes over to the next site."""
    return [f"{name} = all_lanes({name}_next)" for name in names]


# chains -----------------------------------------------------------------------------------------------------------


def _each_of_chain(lines: Sequence[str]) -> list[str]:
    return ["for k in range(n_places):", "    place = START + k * VECTOR", *indented(lines)]


def _chain_lines(lattice: LatticeHamiltonian, level: int, compensated: bool) -> list[str]:
    """Lines of a stage with a kick: sites one after the other, first those before the segments, of which none moves.

    The force of the bond to the next site is its tension. With a force gradient, slopes and M⁻¹ × these are made one
    site ahead of the kicks, and a bond turns p along the difference of these. What ends in ``_next`` goes over to the
    next site.
    """
    row, bond, fields = _LaneRow(lattice), _Bond.of(lattice, level), range(len(lattice.fields))
    free, fixed = (lattice.boundary[0] == end for end in ("free", "fixed"))
    ahead, beyond = ("s + VECTOR", "s + 2 * VECTOR") if level else ("s", "s + VECTOR")
    tensions, bends, turns = _named("tension", bond.tensions), _named("bent", bond.bends), _named("turn", bond.turns)
    slopes, velocities = _named("slope", fields), _named("v", fields)
    lines = [f"x_{f}_next = {row.at(field('q', f), beyond)}" for f in fields]
    lines += [f"r_{f} = x_{f}_next - x_{f}_ahead" for f in fields]
    lines += row.code([*bond.tensions.values(), *bond.bends.values()], _next([*tensions, *bends]), ahead)
    lines += _left_out(row.at("there", ahead), _next(tensions), free)
    total = _balance(slopes_of(lattice.U, lattice.x, lattice), bond.tensions, ["tension_{}"], ["tension_{}_next"])
    lines += row.code(total, _next(slopes), ahead, _tagged(lattice.x, "ahead"))
    moves: list[str] = []
    changes, windows = ["-b*slope_{}_next"], tensions
    if level:
        put = dict(zip(lattice.p, _symbols("slope_{}_next", len(fields)), strict=True))
        lines += row.code(slopes_of(lattice.T, lattice.p, lattice), _next(velocities), ahead, put)
        lines += _left_out(row.at("there", ahead), _next(velocities), fixed)
        lines += [f"relative_{f} = v_{f}_next - v_{f}" for f in fields]
        lines += row.code(list(bond.turns.values()), _next(turns), "s")
        lines += _left_out(row.at("there", "s"), _next(turns), free)
        total = _balance(products_of(lattice.U, lattice.x, lattice), bond.turns, ["turn_{}"], ["turn_{}_next"])
        moves += row.code(total, _named("g", fields), "s", _tagged(lattice.x, "here"))
        changes, windows = ["-force*slope_{}", "-b*g_{}"], [*tensions, *bends, *slopes, *velocities, *turns]
    for f in fields:
        moves += moved(row, "p", f, [change.format(f) for change in changes], compensated)
    moves += drifted(lattice, row, [f"new_p_{f}" for f in fields], compensated)
    here = [f"x_{f}_here" for f in fields] if level else []
    handed = [*_handed_on(windows), *(f"{x} = x_{f}_ahead" for f, x in enumerate(here))]
    handed += [f"x_{f}_ahead = x_{f}_next" for f in fields]
    before = 3 if level else 1
    return [
        *(f"refresh_row({field('q', f)}, START, n, {2 if level else 1}, ring)" for f in fields),
        *(f"{name} = all_lanes(0.0)" for name in [*windows, *here]),
        f"place = START - {before} * VECTOR",
        *(f"x_{f}_ahead = {row.at(field('q', f), ahead)}" for f in fields),
        f"for k in range(-{before}, 0):",
        "    place = START + k * VECTOR",
        *indented([*lines, *handed]),
        *_each_of_chain([*lines, *moves, *handed]),
    ]


# sheets -----------------------------------------------------------------------------------------------------------

_KEPT = "pull", "v", "across", "slope"
"""What is kept of each site of a row, in vectors of that length: the first by kicks without force gradient."""


def _each_of_sheet(
    lines: Sequence[str], rows: str = "n_rows", opening: Sequence[str] = (), closing: Sequence[str] = ()
) -> list[str]:
    return [
        f"for i in range({rows}):",
        "    start = start_of(i, n)",
        *indented(opening),
        "    for k in range(n_places):",
        "        place = start + k * VECTOR",
        *indented(indented(lines)),
        *indented(closing),
    ]


def _sheet_lines(lattice: LatticeHamiltonian, level: int, compensated: bool) -> list[str]:
    """Lines of a stage with a kick: rows one after the other, first those before the sheet, of which none moves.

    Along a row as `_chain_lines`. The bond of a site to the row behind has a pull on it, that to the row before a
    strain. With a force gradient, slopes and M⁻¹ × these are made one row ahead of the kicks. What ends in ``_ahead``
    is of that row.
    """
    row, bond, fields = _LaneRow(lattice), _Bond.of(lattice, level), range(len(lattice.fields))
    free, fixed = ([b == end for b in lattice.boundary] for end in ("free", "fixed"))
    ahead, beyond = ("s + width", "s + 2 * width") if level else ("s", "s + width")
    tensions, bends, turns = _named("tension", bond.tensions), _named("bent", bond.bends), _named("turn", bond.turns)
    pulls, strains, across = (
        _named("pull", bond.tensions),
        _named("strain", bond.tensions),
        _named("across", bond.turns),
    )
    slopes, velocities = _named("slope", fields), _named("v", fields)

    def differences(near: str, far: Sequence[str]) -> list[str]:
        return [f"r_{f} = {near.format(f)} - {x}" for f, x in enumerate(far)]

    def at(start: str) -> list[str]:
        return [row.at(field("q", f), start) for f in fields]

    def tension(names: Sequence[str], start: str, window: str) -> list[str]:
        """Of bonds along the row ahead, from their differences."""
        lines = row.code(list(bond.tensions.values()), names, start)
        return lines + _left_out(f"lanes_at(there, {window})", names, free[1])

    def turn(names: Sequence[str], start: str, window: str) -> list[str]:
        """Of bonds along the present row, from theirs."""
        lines = row.code(list(bond.bends.values()), bends, start) + row.code(list(bond.turns.values()), names, start)
        return lines + _left_out(f"lanes_at(there, {window})", names, free[1])

    opening = ["place = start", *(f"x_{f}_ahead = {x}" for f, x in enumerate(at(ahead)))]
    opening += [*differences("x_{}_ahead", at(f"{ahead} - VECTOR")), *tension(tensions, f"{ahead} - VECTOR", "0")]
    opening += _in_lanes(tensions)
    lines = ["window = (GHOSTS + k) * VECTOR", *(f"x_{f}_next = {x}" for f, x in enumerate(at(f"{ahead} + VECTOR")))]
    lines += differences("x_{}_next", [f"x_{f}_ahead" for f in fields]) + tension(_next(tensions), ahead, "window")
    lines += differences("x_{}_ahead", at(beyond))  # the other way round, in which what is loaded is subtracted
    lines += row.code([-f.xreplace({r: -r for r in lattice.r}) for f in bond.tensions.values()], pulls, ahead)
    lines += _left_out("there_ahead", pulls, free[0])
    if level:
        lines += differences("x_{}_ahead", [f"x_{f}_here" for f in fields])
        lines += row.code([*bond.tensions.values(), *bond.bends.values()], [*strains, *bends], "s")
        lines += _left_out("there_here", strains, free[0])
        lines += [f"strain_{f} = -strain_{f}" for f in bond.tensions]
    else:
        lines += [f"strain_{f} = lanes_at(kept_pull_{f}, window)" for f in bond.tensions]
    total = _balance(
        slopes_of(lattice.U, lattice.x, lattice),
        bond.tensions,
        ["tension_{}", "pull_{}"],
        ["tension_{}_next", "strain_{}"],
    )
    lines += row.code(total, [f"{slope}_ahead" for slope in slopes], ahead, _tagged(lattice.x, "ahead"))
    moves: list[str] = []
    kept = {pull: pull for pull in pulls}
    handed = [*_handed_on(tensions), *(f"x_{f}_ahead = x_{f}_next" for f in fields)]
    changes, closing = ["-b*slope_{}_ahead"], list[str]()
    if level:
        velocity = slopes_of(lattice.T, lattice.p, lattice)
        put = dict(zip(lattice.p, _symbols("slope_{}_ahead", len(fields)), strict=True))
        lines += row.code(velocity, [f"{v}_ahead" for v in velocities], ahead, put)
        lines += _left_out("there_ahead", [f"{v}_ahead" for v in velocities], fixed[0])
        lines += [f"relative_{f} = v_{f} - v_{f}_ahead" for f in fields]
        lines += row.code(list(bond.turns.values()), across, "s")
        lines += _left_out("there_here", across, free[0])
        lines += [f"{v}_next = lanes_at(kept_{v}, window + VECTOR)" for v in velocities]
        lines += [f"x_{f}_beside = {x}" for f, x in enumerate(at("s + VECTOR"))]
        kept = {name: name for name in across} | {v: f"{v}_ahead" for v in velocities}
        changes = ["-force*v_{}", "-b*g_{}"]
        if velocity != list(lattice.p):
            kept |= {slope: f"{slope}_ahead" for slope in slopes}
            moves += [f"{slope} = lanes_at(kept_{slope}, window)" for slope in slopes]
            changes[0] = "-force*slope_{}"
        opening += [f"x_{f}_here = {x}" for f, x in enumerate(at("s"))] + differences("x_{}_here", at("s - VECTOR"))
        opening += [f"{v} = lanes_at(kept_{v}, GHOSTS * VECTOR)" for v in velocities]
        opening += [f"relative_{f} = v_{f} - lanes_at(kept_v_{f}, 0)" for f in fields]
        opening += [*turn(turns, "s - VECTOR", "0"), *_in_lanes(turns)]
        moves += differences("x_{}_beside", [f"x_{f}_here" for f in fields])
        moves += [f"relative_{f} = v_{f}_next - v_{f}" for f in fields]
        moves += turn(_next(turns), "s", "window")
        moves += [f"{name}_before = lanes_at(kept_{name}, window)" for name in across]
        total = _balance(
            products_of(lattice.U, lattice.x, lattice),
            bond.turns,
            ["turn_{}", "across_{}"],
            ["turn_{}_next", "across_{}_before"],
        )
        moves += row.code(total, _named("g", fields), "s", _tagged(lattice.x, "here"))
        moves += _handed_on(turns)
        handed += [*_handed_on(velocities), *(f"x_{f}_here = x_{f}_beside" for f in fields)]
        closing = [f"refresh_row(kept_{v}, GHOSTS * VECTOR, n, 1, ROW_PERIODIC)" for v in velocities]
    for f in fields:
        moves += moved(row, "p", f, [change.format(f) for change in changes], compensated)
    moves += drifted(lattice, row, [f"new_p_{f}" for f in fields], compensated)
    handed = [*(f"put_lanes(kept_{name}, window, all_lanes({value}))" for name, value in kept.items()), *handed]
    before = 2 if level else 1
    if True in (free[0], fixed[0]):
        opening[:0] = [
            "there_here = all_lanes(there_of_rows[BEYOND + i])",
            f"there_ahead = all_lanes(there_of_rows[BEYOND + i + {before - 1}])",
        ]
    return [
        *(f"refresh({field('q', f)}, n_rows, n, {before}, ring)" for f in fields),
        *_each_of_sheet([*lines, *handed], f"-{before}, 0", opening, closing),
        *_each_of_sheet([*lines, *moves, *handed], "n_rows", opening, closing),
    ]
