"""Compiled loops of splitting methods on bodies that interact in pairs, any number of them, by sums over pairs.

Few bodies are met one by one. Many stand in blocks of `LANES`, so that one body meets a block at a time in vector
registers; with a cut-off they are sorted into cells, and each meets the blocks of the cells around its own. The forces
on both bodies of a pair are the same number, added to one and taken from the other.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import sympy as sp

from sympflow.hamiltonian.bodies import PairsHamiltonian
from sympflow.kernels.codegen import statements
from sympflow.kernels.modules import load_algebra, template
from sympflow.kernels.sized_loops import SizedLoops, Team
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL

__all__ = ["PairForces", "PairLoops"]

KINDS = {"gradient": (1,), "hessian_vector": (1, 2), "bend": (2, 3)}
"""The derivatives of V by s that are in ∇V, ∇²V·v and ½ ∇³V(v, v)."""
LANES = 16
FEW = 24
"""Bodies from which blocks pay."""
CHUNKS, WORTH_CHUNKS = 8, 100_000
"""Chunks of a sum, which threads share, and about how many nanoseconds a sum takes from which there are more than one:
threads wait for each other after each sum."""
LONG = 2_000_000
"""The same, of a run that is made stage by stage even in one thread, so that it may be interrupted soon."""


class PairLoops(SizedLoops):
    """The functions that `SplittingLoops` asks for, of one system of bodies and one kind of kicks.

    Parameters
    ----------
    local : PairsHamiltonian
    level : int
        See `Scheme`.
    compensated : bool
    rate : bool
        True if there is friction −γp, whose numbers are the last two rows of a table.
    """

    def __init__(self, local: PairsHamiltonian, level: int, compensated: bool, rate: bool) -> None:
        if level == POLYNOMIAL:
            raise ValueError("`scheme` has polynomials, which need a symbolic system: take one without them.")
        n, few = local.n_bodies, local.n_bodies < FEW
        n_chunks = CHUNKS if local.work >= WORTH_CHUNKS else 1
        self._size = n if few else -(-n // LANES) * LANES
        self._geometry = np.array([n, 0 if few else n_chunks], dtype=np.int64)
        self._values = _numbers(local)
        self._sites = np.zeros((local.dim + len(local.columns), self._size))
        self._sites[: local.dim, :n], self._sites[local.dim :, :n] = 1 / local.masses, local.columns
        self._dim = local.dim
        arguments = (self._geometry, self._size, self._sites, self._values)
        module = _module(_Code(local), level, compensated, rate)
        super().__init__(module, compensated, local.work, n_chunks, arguments)

    def _in_pieces(self, threads: int) -> bool:
        return threads > 1 or self._work > LONG

    def _team(self, stages: int, threads: int | None) -> Team:
        return super()._team(stages, threads if os.name == "posix" else 1)  # else threads cannot leave a core

    def _states(self) -> np.ndarray:
        return np.zeros((4 if self._compensated else 2, self._dim, self._size))

    def _load(self, y: np.ndarray, X: np.ndarray, first: int) -> None:
        self._module.loaded(y, X, first, self._geometry)

    def _pack(self, X: np.ndarray, first: int, y: np.ndarray) -> None:
        self._module.packed(X, first, y, self._geometry)

    def _advanced(
        self, team: Team, states: tuple[np.ndarray, np.ndarray], table: np.ndarray, j: int, count: int, single: bool
    ) -> tuple[tuple[np.ndarray, np.ndarray], int]:
        before, X = states
        X[...] = before
        sums = np.zeros((2, self._n_pieces, self._dim * self._size))
        meeting = np.zeros(3, dtype=np.int64)

        def member(k: int) -> int:
            own = before.copy() if k else X
            given = (sums, meeting, own, table, j, count, single)
            return self._module.in_team(k, team.threads, *given, *self._arguments)

        return (X, before), team.together(member, meeting)


class PairForces:
    """F = −∇V and G = ∇²V M⁻¹∇V of bodies at many states, and their derivatives, for the fits of tables.

    States q are (d, P), directions (K, d, P), Jacobians (d, d, P), as in `sympflow.training.table_step`.

    Parameters
    ----------
    local : PairsHamiltonian
    level : int
        See `Scheme`; there are no curvature terms.
    """

    def __init__(self, local: PairsHamiltonian, level: int) -> None:
        assert level < CURVATURE
        self._given, self._has_gradient = (local, level), level >= FORCE_GRADIENT
        self._values = _numbers(local)
        masses = np.broadcast_to(1 / local.masses, (local.dim, local.n_bodies))
        self._sites = np.concatenate([masses, local.columns])
        self._module = _rows_module(_Code(local))

    def __reduce__(self) -> tuple[Any, ...]:
        return PairForces, self._given

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        """F and G."""
        rows = np.ascontiguousarray(q.T)
        F, G = np.empty_like(rows), np.empty_like(rows)
        self._module.force_rows(rows, self._sites, self._values, self._has_gradient, F, G)
        return (F.T, G.T)[: 1 + self._has_gradient]

    def along(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """These, and their derivatives along directions."""
        values = self.values(q)
        rows, F, W = (np.ascontiguousarray(x.T) for x in (q, values[0], v))  # (P, d), (P, d, K)
        DF, DG = np.empty_like(W), np.empty_like(W)
        self._module.product_rows(rows, F, W, self._sites, self._values, self._has_gradient, DF, DG)
        return values, (DF.T, DG.T)[: 1 + self._has_gradient]

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """These, and their Jacobians."""
        d, P = q.shape
        values, changes = self.along(q, np.broadcast_to(np.eye(d)[..., None], (d, d, P)))
        return values, [change.swapaxes(0, 1) for change in changes]


class _Code:
    """Key of the code of bodies in pairs: all that the code depends on."""

    def __init__(self, local: PairsHamiltonian) -> None:
        self.local = local
        self.key = local.V, local.dim, local.first, local.c, local.cutoff is None, local.box is None

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Code) and self.key == other.key


@lru_cache(maxsize=64)
def _module(code: _Code, level: int, compensated: bool, rate: bool) -> ModuleType:
    local = code.local
    kinds = tuple(KINDS)[: 1 + {FORCE_GRADIENT: 1, CURVATURE: 2}.get(level, 0)]
    cells = [] if local.cutoff is None else [template("cells")]
    return load_algebra(
        "\n\n\n".join([*cells, *(_functions(local, kind) for kind in kinds)]),
        ("aligned", "sized_states", "barrier", "pairs"),
        N_SETS=4 if compensated else 2,
        SPACED=False,  # passes over all numbers of a vector
        N_FIELDS=local.dim,
        N_HELPERS={0: 1, FORCE_GRADIENT: 2, CURVATURE: 3}[level],
        DRIFT=0 if not rate else {0: 2, FORCE_GRADIENT: 3, CURVATURE: 4}[level],
        DAMPED=rate,
        HAS_GRADIENT=level > 0,
        HAS_CURVATURE=level == CURVATURE,
        COMPENSATED=compensated,
        DIM=local.dim,
        COLUMNS=len(local.first),
        WIDTH=local.dim * (1 + (level > 0)) + len(local.first),
        CUT=local.cutoff is not None,
        PERIODIC=local.box is not None,
        LANES=LANES,
    )


def _numbers(local: PairsHamiltonian) -> np.ndarray:
    """The numbers of a system that `_Sums.numbers` names."""
    end = np.inf if local.cutoff is None else local.cutoff**2 + local.softening**2
    box = np.zeros(local.dim) if local.box is None else local.box
    return np.array([local.softening**2, end, *box, *local.constants])


@lru_cache(maxsize=64)
def _rows_module(code: _Code) -> ModuleType:
    local = code.local
    lines = _Sums(local, "gradient").numbers()
    for letters, body in ((local.first, "i"), (local.second, "j")):
        lines += [f"{letter.name} = sites[{local.dim + k}, {body}]" for k, letter in enumerate(letters)]
    lines += [*_slopes(local, ["g_1", "g_2", "g_3"], (1, 2, 3)), "return g_1, g_2, g_3"]
    head = "@njit(**OPTIONS)\ndef slopes(i, j, s, sites, values):\n"
    source = head + "\n".join("    " + line for line in lines)
    cut, periodic = local.cutoff is not None, local.box is not None
    return load_algebra(source, ("pair_rows",), DIM=local.dim, CUT=cut, PERIODIC=periodic)


def _slopes(local: PairsHamiltonian, names: Sequence[str], kinds: Sequence[int]) -> list[str]:
    """The derivatives of V by s: negative powers of s by one division, which takes as long as all else of a pair."""
    s, slopes = local.s, [local.slopes[k] for k in kinds]
    powers = {
        f for g in slopes for f in g.atoms(sp.Pow) if f.base == s and f.exp.is_negative and (2 * f.exp).is_integer
    }
    if len(powers) < 2:
        return statements(names, slopes)
    root = 2 if any(not f.exp.is_integer for f in powers) else 1
    inverse = sp.Symbol("inverse", positive=True)
    slopes = [g.xreplace({f: inverse ** (-root * f.exp) for f in powers}) for g in slopes]
    slopes = [sp.horner(g, wrt=inverse) if g.is_polynomial(inverse) else g for g in slopes]
    return statements(["inverse"], [s ** sp.Rational(-1, root)]) + statements(names, slopes)


def _functions(local: PairsHamiltonian, kind: str) -> str:
    """The sum over pairs of one kind: of a chunk of many bodies, in blocks, and of few bodies."""
    sums = _Sums(local, kind)
    text = template("pair_sums").partition("# ---\n")[2].replace("SUM", kind)
    lines = {
        "# numbers": sums.numbers(),
        "# own": sums.in_block("Pi", sums.own),
        "# other": sums.in_block("Pj", sums.other),
        "# own of few": sums.of_few("i", sums.own),
        "# other of few": sums.of_few("j", sums.other),
        "# slopes": sums.slopes(),
        "# masked": [f"{g} = {g} if inside else 0.0" for g in sums.g],
        "# force": sums.force(),
        "# begin": [f"total_{k} = 0.0" for k in sums.axes],
        "# both lanes": [f"mine[{k} * LANES + lane] += f_{k}" for k in sums.axes]
        + [f"Fj[{k} * LANES + lane] -= f_{k}" for k in sums.axes],
        "# both": [f"total_{k} += f_{k}" for k in sums.axes] + [f"A[0, {k}, j] -= f_{k}" for k in sums.axes],
        "# end": [f"A[0, {k}, i] += total_{k}" for k in sums.axes],
    }
    return _filled(text, lines)


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
        self.own = self._names([a.name for a in local.first], "")
        self.other = self._names([b.name for b in local.second], "_j")
        self.g = [f"g_{k}" for k in range(len(KINDS[kind]))]

    def numbers(self) -> list[str]:
        """The numbers of the system."""
        local = self.local
        lines = ["softening, end = values[0], values[1]"]
        if local.box is not None:
            lines += [f"box_{k} = values[{2 + k}]" for k in self.axes]
        return lines + [f"{c.name} = values[{2 + local.dim + i}]" for i, c in enumerate(local.c)]

    def _names(self, columns: list[str], end: str) -> list[str]:
        moved = [[f"{x}_{k}{end}" for k in self.axes] for x in "xw"]
        return [*moved[0], *columns, *(moved[1] if self.vector else [])]

    def in_block(self, block: str, names: Sequence[str]) -> list[str]:
        """The numbers of a body in a block, by their names."""
        return [f"{name} = {block}[{row} * LANES + lane]" for row, name in enumerate(names)]

    def of_few(self, index: str, names: Sequence[str]) -> list[str]:
        """The numbers of one of few bodies, by their names."""
        places = [f"X[0, {k}, {index}]" for k in self.axes]
        places += [f"sites[{self.local.dim + k}, {index}]" for k in range(len(self.local.first))]
        places += [f"A[v, {k}, {index}]" for k in self.axes] if self.vector else []
        return [f"{name} = {place}" for name, place in zip(names, places, strict=True)]

    def slopes(self) -> list[str]:
        """The differences d_k and u_k, s, and the derivatives of V there."""
        lines = [f"d_{k} = x_{k} - x_{k}_j" for k in self.axes]
        if self.local.box is not None:
            lines += [f"d_{k} -= box_{k} * math.floor(d_{k} / box_{k} + 0.5)" for k in self.axes]
        if self.vector:
            lines += [f"u_{k} = w_{k} - w_{k}_j" for k in self.axes]
        lines.append("s = " + " + ".join([*(f"d_{k} * d_{k}" for k in self.axes), "softening"]))
        return lines + _slopes(self.local, self.g, KINDS[self.kind])

    def force(self) -> list[str]:
        """The part f_k of a pair in the sum of its first body."""
        if not self.vector:
            return [f"f_{k} = g_0 * d_{k}" for k in self.axes]
        lines = ["e = " + " + ".join(f"d_{k} * u_{k}" for k in self.axes)]
        if self.kind == "hessian_vector":
            lines.append("along, beside = g_1 * e, g_0")
        else:
            square = " + ".join(f"u_{k} * u_{k}" for k in self.axes)
            lines.append(f"along, beside = 0.5 * (g_1 * e * e + g_0 * ({square})), g_0 * e")
        return lines + [f"f_{k} = along * d_{k} + beside * u_{k}" for k in self.axes]
