"""Code of one site of a lattice, from which that of passes over sites and of stages in registers is made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from sympflow.hamiltonian.lattice import LatticeHamiltonian
from sympflow.kernels.codegen import statements, vectorised

__all__ = [
    "Row",
    "drifted",
    "field",
    "indented",
    "moved",
    "products_of",
    "slopes_of",
    "value_lines",
    "vectors_of",
    "velocity_lines",
]


def slopes_of(f: sp.Expr, x: Sequence[sp.Symbol], lattice: LatticeHamiltonian) -> list[sp.Expr]:
    return [sp.diff(f, s) for s in x]


def products_of(f: sp.Expr, x: Sequence[sp.Symbol], lattice: LatticeHamiltonian) -> list[sp.Expr]:
    """∇²V v."""
    return list(sp.hessian(f, x) * sp.Matrix(lattice.v))


def vectors_of(lattice: LatticeHamiltonian) -> dict[str, str]:
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


class Row:
    """The places in vectors where the rows begin that a loop reads, each computed once.

    They are unsigned: of an index that may be negative no loop of vector instructions is made.
    """

    def __init__(self, lattice: LatticeHamiltonian) -> None:
        self.lines: list[str] = []
        self._names: dict[str, str] = {}
        self._numbers = {name: k for k, name in enumerate(vectors_of(lattice))}
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
        return self._parameters(f, f"offset + {start}")

    def _parameters(self, f: Sequence[sp.Expr], start: str) -> dict[sp.Symbol, str]:
        used = set().union(*(each.free_symbols for each in f))
        return {
            self._letters[name]: self.at(f"parameter_{i}", start)
            for i, name in enumerate(self.arrays)
            if self._letters[name] in used
        }


def value_lines(lattice: LatticeHamiltonian) -> list[str]:
    scalars = [s for s, v in zip(lattice.c, lattice.params.values(), strict=True) if not isinstance(v, np.ndarray)]
    return [f"{s} = values[{i}]" for i, s in enumerate(scalars)]


def indented(lines: Sequence[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def field(vector: str, f: int) -> str:
    return f"{vector}_of_{f}"


def velocity_lines(lattice: LatticeHamiltonian, row: Row, momenta: Sequence[str], name: str) -> list[str]:
    """Lines for ∇T of one site at these momenta."""
    slopes = [sp.diff(lattice.T, s) for s in lattice.p]
    elements = row.parameters(slopes, "s")
    lines = [f"{s}_mass = {element}" for s, element in elements.items()]
    put = {s: sp.Symbol(m, real=True) for s, m in zip(lattice.p, momenta, strict=True)}
    put |= {s: sp.Symbol(f"{s}_mass", real=True) for s in elements}
    return lines + statements(
        [f"{name}_{f}" for f in range(len(slopes))], vectorised([f.xreplace(put) for f in slopes])
    )


def moved(row: Row, vector: str, f: int, changes: Sequence[str], compensated: bool) -> list[str]:
    """Lines that add changes to q or p of field f at one site, and leave its value in ``new_q_f`` or ``new_p_f``."""
    x, error = f"new_{vector}_{f}", f"{vector}_error_of_{f}"
    lines = [f"{x} = {row.at(field(vector, f), 's')}"]
    if not compensated:
        return [*lines, *(f"{x} = {x} + {change}" for change in changes), row.put(field(vector, f), "s", x)]
    lines.append(f"error = {row.at(error, 's')}")
    for change in changes:
        lines += [
            f"corrected = {change} - error",
            f"total = {x} + corrected",
            f"error = (total - {x}) - corrected",
            f"{x} = total",
        ]
    return [*lines, row.put(field(vector, f), "s", x), row.put(error, "s", "error")]


def drifted(lattice: LatticeHamiltonian, row: Row, momenta: Sequence[str], compensated: bool) -> list[str]:
    """Lines for q += drift × ∇T of one site at these momenta."""
    lines = velocity_lines(lattice, row, momenta, "u")
    for f in range(len(momenta)):
        lines += moved(row, "q", f, [f"drift*u_{f}"], compensated)
    return lines
