"""Forces between pairs of bodies as code: the sums over pairs of a `PairsHamiltonian`, for any number of bodies.

Few bodies are met one by one. Many stand in blocks of `LANES`, so that one body meets a block at a time in vector
registers; with a cut-off they are sorted into cells, and each meets the blocks of the cells around its own. The forces
on both bodies of a pair are the same number, added to one and taken from the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sympflow.hamiltonian.bodies import PairsHamiltonian
from sympflow.kernels.codegen import statements
from sympflow.kernels.modules import template

__all__ = ["pair_data", "pair_source"]

KINDS = {"gradient": (1,), "hessian_vector": (1, 2), "bend": (2, 3)}
"""The derivatives of V by s that are in ∇V, ∇²V·v and ∇³V(v, v)."""
LANES = 16
FEW = 24
"""Bodies from which blocks pay."""


def pair_data(local: PairsHamiltonian) -> np.ndarray:
    """The numbers that the functions read: ε², the largest s, the box, the parameters, and the columns of bodies."""
    end = np.inf if local.cutoff is None else local.cutoff**2 + local.softening**2
    box = np.zeros(local.dim) if local.box is None else local.box
    numbers = [local.softening**2, end, *box, *local.constants]
    return np.concatenate([np.array(numbers), local.columns.ravel()])


def pair_source(local: PairsHamiltonian, kinds: Sequence[str]) -> str:
    """``gradient(q, out, data)``, ``hessian_vector(q, v, out, data)`` and ``bend(q, v, out, data)``, as text.

    The code is the same for all numbers of bodies, masses and parameters.
    """
    constants = {
        "DIM": local.dim,
        "COLUMNS": len(local.first),
        "NUMBERS": 2 + local.dim + len(local.c),
        "CUT": local.cutoff is not None,
        "PERIODIC": local.box is not None,
        "LANES": LANES,
        "FEW": FEW,
    }
    header = "\n".join(f"{name} = {value}" for name, value in constants.items())
    cells = [] if local.cutoff is None else [template("cells")]
    return "\n\n\n".join([header, *cells, *(_functions(local, kind) for kind in kinds)])


def _functions(local: PairsHamiltonian, kind: str) -> str:
    """The sum over pairs of one kind: `kind`, and for it one body with a row of others, in blocks, and few bodies."""
    sums = _Sums(local, kind)
    text = template("pairs").partition("# ---\n")[2]
    for name, value in {"KIND": kind, "WIDTH": str(len(sums.own)), "(vectors, ": f"({sums.arguments}, "}.items():
        text = text.replace(name, value)
    lines = {
        "# numbers": sums.numbers(),
        "# own": [f"{name} = Xi[{row} * LANES + lane]" for row, name in enumerate(sums.own)],
        "# other": [f"{name} = Xj[{row} * LANES + lane]" for row, name in enumerate(sums.other)],
        "# own of few": [f"{name} = {place}" for name, place in zip(sums.own, sums.places("i"), strict=True)],
        "# other of few": [f"{name} = {place}" for name, place in zip(sums.other, sums.places("j"), strict=True)],
        "# packed": [f"X[at + {row} * LANES] = {place}" for row, place in enumerate(sums.places("j"))],
        "# slopes": sums.slopes(),
        "# masked": [f"{g} = {g} if inside else 0.0" for g in sums.g],
        "# force": sums.force(),
        "# begin": [f"total_{k} = 0.0" for k in sums.axes],
        "# both lanes": [f"mine[{k} * LANES + lane] += f_{k}" for k in sums.axes]
        + [f"Fj[{k} * LANES + lane] -= f_{k}" for k in sums.axes],
        "# both": [f"total_{k} += f_{k}" for k in sums.axes]
        + [f"out[{_few(k, 'j', local)}] -= f_{k}" for k in sums.axes],
        "# end": [f"out[{_few(k, 'i', local)}] += total_{k}" for k in sums.axes],
    }
    return _filled(text, lines)


def _few(k: int, body: str, local: PairsHamiltonian) -> str:
    """The place of coordinate k of a body, in unsigned integers, of which Numba asks no sign."""
    return f"np.uint64({local.dim}) * {body} + np.uint64({k})"


def _filled(text: str, lines: dict[str, list[str]]) -> str:
    """The text with lines in the place of comments, indented as these are."""
    filled = []
    for line in text.splitlines():
        key = line.strip()
        indent = line[: len(line) - len(line.lstrip())]
        filled += [indent + new for new in lines[key]] if key in lines else [line]
    return "\n".join(filled)


class _Sums:
    """Lines of code for the pairs of one kind of sum.

    Attributes
    ----------
    own, other : list of str
        Names of the numbers of the first body and the second: coordinates, those of v, columns.
    g : list of str
        Names of the derivatives of V.
    """

    def __init__(self, local: PairsHamiltonian, kind: str) -> None:
        self.local, self.kind, self.axes = local, kind, range(local.dim)
        self.vector = kind != "gradient"
        self.arguments = "q, v" if self.vector else "q"
        moved = ["x", "w"] if self.vector else ["x"]
        self.own = [f"{x}_{k}" for x in moved for k in self.axes] + [a.name for a in local.first]
        self.other = [f"{x}_{k}_j" for x in moved for k in self.axes] + [b.name for b in local.second]
        self.g = [f"g_{k}" for k in range(len(KINDS[kind]))]

    def numbers(self) -> list[str]:
        """The numbers of the system."""
        local = self.local
        lines = ["softening, end = data[0], data[1]"]
        if local.box is not None:
            lines += [f"box_{k} = data[{2 + k}]" for k in self.axes]
        return lines + [f"{c.name} = data[{2 + local.dim + i}]" for i, c in enumerate(local.c)]

    def places(self, body: str) -> list[str]:
        """The numbers of a body in the arrays that are given."""
        arrays = ["q", "v"] if self.vector else ["q"]
        columns = [f"data[np.uint64(NUMBERS) + np.uint64({k}) * n + {body}]" for k in range(len(self.local.first))]
        return [f"{x}[{_few(k, body, self.local)}]" for x in arrays for k in self.axes] + columns

    def slopes(self) -> list[str]:
        """The differences d_k and u_k, s, and the derivatives of V there."""
        lines = [f"d_{k} = x_{k} - x_{k}_j" for k in self.axes]
        if self.local.box is not None:
            lines += [f"d_{k} -= box_{k} * math.floor(d_{k} / box_{k} + 0.5)" for k in self.axes]
        if self.vector:
            lines += [f"u_{k} = w_{k} - w_{k}_j" for k in self.axes]
        lines.append("s = " + " + ".join([*(f"d_{k} * d_{k}" for k in self.axes), "softening"]))
        return lines + statements(self.g, [self.local.slopes[k] for k in KINDS[self.kind]])

    def force(self) -> list[str]:
        """The part f_k of a pair in the sum of its first body."""
        if not self.vector:
            return [f"f_{k} = g_0 * d_{k}" for k in self.axes]
        lines = ["e = " + " + ".join(f"d_{k} * u_{k}" for k in self.axes)]
        if self.kind == "hessian_vector":
            lines.append("along, beside = g_1 * e, g_0")
        else:
            square = " + ".join(f"u_{k} * u_{k}" for k in self.axes)
            lines.append(f"along, beside = g_1 * e * e + g_0 * ({square}), 2.0 * g_0 * e")
        return lines + [f"f_{k} = along * d_{k} + beside * u_{k}" for k in self.axes]
