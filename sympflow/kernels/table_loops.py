"""Compiled errors of a splitting step at labels, and their derivatives by the numbers of its table.

The kicks are generated from the derivatives of V up to the fourth. The force gradient, the curvature term and their
slopes are sums of products of these, written out without the factors that are 0; so the source is short whatever V is.
A driven system has the time as one more position, with the work of the drive as its momentum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import sympy as sp

from sympflow.hamiltonian.friction import Friction
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.kernels.codegen import as_factor, statements, vectorised
from sympflow.kernels.modules import load_algebra
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

__all__ = ["LabelErrors", "TableLoops", "table_loops"]

Entry = str | None
"""The name or the text of a number; None for 0."""

MOST_LINES = 600  # of a kick, beyond which compiling takes too long
MOST_SHARED = 120  # of one with curvature terms that serves where there are none
LANES = 64  # as in the text `table_rows`
ROUNDING = 1e-14  # of rows that are in proportion
BLOCKS = 256  # of lanes, some milliseconds, between two looks at the clock


class TableLoops:
    """The compiled errors of labels for one system, one sequence of maps and one kind of kicks.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
        Separable, with T = ½ pᵀM⁻¹p; its values of parameters are those of the loops.
    kicks : sequence of bool
        The sequence: True for a kick, False for a drift.
    level, monomials
        Of the kicks: see `sympflow.schemes.Scheme.level`.
    friction : Friction, optional

    Attributes
    ----------
    n_numbers : int
        Those that the loops take, which may have more terms in kicks than are asked for.
    places : ndarray of int
        Where the numbers that are asked for stand among these, in the order of the stages.
    drifts : ndarray of int
        Where those of drifts stand.

    Raises
    ------
    ValueError
        If a function in H has no counterpart in compiled code, or the code would be too long.
    """

    def __init__(
        self,
        symbols: SymbolicHamiltonian,
        kicks: Sequence[bool],
        level: int,
        monomials: Monomials,
        friction: Friction | None,
    ) -> None:
        self._given = symbols, tuple(kicks), level, monomials, friction
        form, d = symbols.parametric, symbols.ndof
        self.kicks, self.friction = np.array(kicks, dtype=bool), friction
        self.values = np.array(form.values, dtype=np.float64)
        self.width, self._driven = d + (symbols.time is not None), symbols.time is not None
        self._inverse_mass = np.array(symbols.inverse_mass, dtype=np.float64)
        damping = None if friction is None else tuple(tuple(map(float, row)) for row in friction.matrix(d))
        self.rows, terms = _compiled(form, level, monomials, damping)
        ends = np.cumsum([terms if kick else 1 for kick in kicks])
        given = [1 + (len(monomials) or level) if kick else 1 for kick in kicks]
        starts = ends - [terms if kick else 1 for kick in kicks]
        self.n_numbers, self.drifts = int(ends[-1]), starts[~self.kicks]
        self.places = np.concatenate([start + np.arange(n) for start, n in zip(starts, given, strict=True)])

    def __reduce__(self) -> tuple[Any, ...]:
        return TableLoops, self._given

    def errors(self, *arguments: Any) -> LabelErrors:
        """See `LabelErrors`."""
        return LabelErrors(self, *arguments)

    def steps(self, c: np.ndarray, y: np.ndarray, t0: np.ndarray | None, n_rows: int) -> np.ndarray:
        """The first rows of the states after steps by each of the numbers c (J, n), (J, n_rows, N)."""
        zero, no_slope = np.zeros((n_rows, len(c) * y.shape[1])), np.empty((0, len(c) * y.shape[1]))
        errors = LabelErrors(self, y, t0, zero, zero + 1.0, no_slope, np.empty((*c.shape, 0)))
        return errors(c)[0].reshape(len(c), n_rows, y.shape[1])

    def opened(self, y: np.ndarray, t0: np.ndarray | None) -> np.ndarray:
        """States (2d, N) with the times (N,) of a driven system after the positions, and its work after the momenta."""
        if not self._driven:
            return np.ascontiguousarray(y)
        assert t0 is not None
        d = len(y) // 2
        return np.concatenate([y[:d], t0[None], y[d:], 0 * t0[None]])

    def motions(self, s: np.ndarray) -> np.ndarray:
        """The linear maps of drifts of times s (J, m), with friction: (J, m, 2 d²), else (J, m, 0)."""
        if self.friction is None:
            return np.empty((*s.shape, 0))
        M = self._inverse_mass
        mean, end = (
            part if part.shape[1] == M.size else part.reshape(len(part), -1, 1) * np.eye(len(M))
            for part in self.friction.factors(s.ravel())
        )
        mean, end = mean.reshape(-1, *M.shape), end.reshape(-1, *M.shape)
        return np.stack([M @ mean, end], axis=1).reshape(*s.shape, -1)


class LabelErrors:
    """Weighted errors of labels after a step, and their derivatives by parameters on which its numbers depend affinely.

    Errors are in the order of the label times, of the components, of the states.

    Parameters
    ----------
    loops : TableLoops
    x : (2d, N)
        States at the start.
    t0 : (N,) or None
        Their times, of a driven system.
    y : (R, J N)
        Where they go, times first: of a driven system with its work, or without.
    scale : (R, J N)
        Weights of the errors of the first components.
    slope : (R', J N)
        Weights of one more error, a sum over the components; none with R' = 0.
    design : (J, n, f)
        The derivatives of the numbers, in the order of the stages, by the parameters.

    Attributes
    ----------
    matrices : (J, k, f)
        The derivatives by the parameters, at each time, of k numbers to which all others are in proportion.
    """

    def __init__(
        self,
        loops: TableLoops,
        x: np.ndarray,
        t0: np.ndarray | None,
        y: np.ndarray,
        scale: np.ndarray,
        slope: np.ndarray,
        design: np.ndarray,
    ) -> None:
        self._loops = loops
        self._labels = tuple(map(np.ascontiguousarray, (loops.opened(x, t0), y, scale, slope)))
        leaders, leader, factors = _in_proportion(design.swapaxes(0, 1).reshape(design.shape[1], -1))
        self.matrices = np.ascontiguousarray(design[:, leaders])
        used = np.flatnonzero(factors)
        used = used[np.argsort(leader[used], kind="stable")]
        self._places = np.stack([leader[used], loops.places[used]], axis=1)
        self._design = np.tile(factors[used], (len(design), 1))
        self._n_blocks = len(design) * -(-x.shape[1] // LANES)
        self._shape = len(leaders), len(design) * x.shape[1] * (len(scale) + bool(len(slope)))

    def __call__(
        self, c: np.ndarray, check: Callable[[], None] = lambda: None, linearized: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """The errors (m,) for numbers c (J, n), and if they are asked for their derivatives by the k numbers, (k, m).

        Those by the parameters are these, of each time, times its matrix.

        `check` is called now and then, and may raise.
        """
        loops, (n_parameters, m) = self._loops, self._shape
        r, J = np.empty(m), np.empty((n_parameters if linearized else 0, m))
        numbers = np.zeros((len(c), loops.n_numbers))
        numbers[:, loops.places] = c
        motions = loops.motions(numbers[:, loops.drifts])
        common = (loops.kicks, numbers, motions, loops.values, *self._labels, self._places, self._design)
        for first in range(0, self._n_blocks, BLOCKS):
            check()
            loops.rows(*common, first, min(first + BLOCKS, self._n_blocks), r, J)
        return r, J


def _in_proportion(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (k,) such that each of all rows (n,) is a factor (n,) times the one of a place (n,) among them.

    Factors of rows of zeros are 0.
    """
    leaders: list[int] = []
    leader, factors = np.zeros(len(rows), dtype=np.int64), np.zeros(len(rows))
    for i, row in enumerate(rows):
        if not row.any():
            continue
        for place, other in enumerate(leaders):
            largest = np.argmax(np.abs(rows[other]))
            factor = row[largest] / rows[other, largest]
            if np.abs(row - factor * rows[other]).max() <= ROUNDING * np.abs(row).max():
                leader[i], factors[i] = place, factor
                break
        else:
            leader[i], factors[i] = len(leaders), 1.0
            leaders.append(i)
    return np.array(leaders, dtype=np.int64), leader, factors


def table_loops(
    symbols: SymbolicHamiltonian, kicks: Sequence[bool], level: int, monomials: Monomials, friction: Friction | None
) -> TableLoops | None:
    """The loops; None of a system that has no compiled form, or one too long."""
    if symbols.samples:
        return None
    try:
        return TableLoops(symbols, kicks, level, monomials, friction)
    except ValueError:
        return None


@lru_cache(maxsize=64)
def _compiled(
    form: SymbolicHamiltonian, level: int, monomials: Monomials, friction: tuple[tuple[float, ...], ...] | None
) -> tuple[Any, int]:
    """``table_rows`` and the terms of its kicks.

    Loops for force gradients have curvature terms as well where these are short: `train` tries both, and the time that
    it takes is for the most part that of compiling.
    """
    source = _Source(form, level, monomials, friction)
    text = source.text()
    if level == FORCE_GRADIENT:
        both = _Source(form, CURVATURE, monomials, friction)
        if both.length() <= MOST_SHARED:
            source, text = both, both.text()
    width, d = source.width, form.ndof
    outputs = (*range(d), *range(width, width + d), *range(width + d, 2 * width))
    constants: dict[str, Any] = {"WIDTH": width, "TERMS": source.terms, "TAPE": source.tape, "OUTPUTS": outputs}
    return load_algebra(text, ("aligned", "table_rows"), **constants).table_rows, source.terms


class _Source:
    """The source of ``kick_lanes``, ``kick_taped``, ``kick_back``, ``drift_lanes`` and ``drift_back``."""

    def __init__(
        self, form: SymbolicHamiltonian, level: int, monomials: Monomials, friction: Sequence[Sequence[float]] | None
    ) -> None:
        assert form.inverse_mass is not None
        self.form, self.level, self.friction = form, level, friction
        self.q = form.q if form.time is None else (*form.q, form.time)
        self.width, self.d = len(self.q), form.ndof
        self.products = [sp.Mul(*map(sp.Pow, form.q, m)) for m in monomials]
        self.terms = 1 + (len(monomials) or level)
        self.pairs = list(combinations_with_replacement(range(self.width), 2))
        self.tape = max(self.terms * self.width + len(self.pairs), 2 * self.width)
        n = range(self.d)
        self.mass = [[_entry(form.inverse_mass[i, j]) for j in n] for i in n]

    def length(self) -> int:
        """Lines of the longest function."""
        return len(self._kick(taped=True)[1])

    def text(self) -> str:
        functions = [
            self._function("kick_lanes", "W, c, values, width", *self._kick(taped=False)),
            self._function("kick_taped", "W, T, c, values, width", *self._kick(taped=True)),
            self._function("kick_back", "A, T, B, width", [], self._kick_back()),
            self._function("drift_lanes", "W, T, a, motion, values, width", self._motion(), self._drift()),
            self._function("drift_back", "A, T, B, a, motion, values, width", self._motion(), self._drift_back()),
        ]
        return "\n\n\n".join(functions) + "\n"

    def _function(self, name: str, arguments: str, before: list[str], body: list[str]) -> str:
        if len(body) > MOST_LINES:
            raise ValueError(f"`system` has a kick of {len(body)} lines.")
        if "values" in arguments:
            before = [*(f"{s} = values[{i}]" for i, s in enumerate(self.form.parameters)), *before]
        lines = [*before, "for lane in range(width):", *(f"    {line}" for line in body)]
        return "\n    ".join([f"@njit(**OPTIONS)\ndef {name}({arguments}):", *lines])

    # kicks ------------------------------------------------------------------------------------------------------

    def _kick(self, taped: bool) -> tuple[list[str], list[str]]:
        """Lines before the loop over lanes, and in it."""
        numbers = [f"c_{k}" for k in range(self.terms)]
        before = [f"{name} = c[{k}]" for k, name in enumerate(numbers)]
        body = [f"{s} = W[{i * LANES} + lane]" for i, s in enumerate(self.q)]
        order = 1 + taped
        if not self.products and self.level >= FORCE_GRADIENT:
            order += min(self.level, CURVATURE)
        algebra = _Algebra(self, order)
        forces, slopes = algebra.forces(), algebra.slopes(numbers) if taped else {}
        body += algebra.lines
        for k, force in enumerate(forces):
            body += [f"T[{(k * self.width + i) * LANES} + lane] = {f or '0.0'}" for i, f in enumerate(force) if taped]
        first = self.terms * self.width
        if taped:
            body += [f"T[{(first + n) * LANES} + lane] = {slopes[ij] or '0.0'}" for n, ij in enumerate(self.pairs)]
        for i in range(self.width):
            change = _sum([_product(c, force[i]) for c, force in zip(numbers, forces, strict=True)])
            if change is not None:
                body.append(f"W[{(self.width + i) * LANES} + lane] += {change}")
        return before, body

    def _kick_back(self) -> list[str]:
        w, first = self.width, self.terms * self.width
        lines = [f"b_{i} = A[{(w + i) * LANES} + lane]" for i in range(w)]
        for k in range(self.terms):
            terms = [f"b_{i} * T[{(k * w + i) * LANES} + lane]" for i in range(w)]
            lines.append(f"B[{k * LANES} + lane] = {' + '.join(terms)}")
        places = {ij: first + n for n, ij in enumerate(self.pairs)}
        for i in range(w):
            terms = [f"T[{places[min(i, j), max(i, j)] * LANES} + lane] * b_{j}" for j in range(w)]
            lines.append(f"A[{i * LANES} + lane] += {' + '.join(terms)}")
        return lines

    # drifts -----------------------------------------------------------------------------------------------------

    def _motion(self) -> list[str]:
        d = self.d
        if self.friction is None:
            return []
        names = [(i, j, f"motion[{part * d * d + i * d + j}]") for part in (0, 1) for i in range(d) for j in range(d)]
        return [f"{'me'[n // (d * d)]}_{i}_{j} = {text}" for n, (i, j, text) in enumerate(names)]

    def _drift(self) -> list[str]:
        """The tape holds M⁻¹p and −Γp at the end."""
        d, w, friction = self.d, self.width, self.friction
        lines = [f"y_{i} = W[{(w + i) * LANES} + lane]" for i in range(d)]
        if friction is not None:
            lines += [f"change_{i} = {' + '.join(f'm_{i}_{j} * y_{j}' for j in range(d))}" for i in range(d)]
            lines += [f"end_{i} = {' + '.join(f'e_{i}_{j} * y_{j}' for j in range(d))}" for i in range(d)]
            lines += [f"y_{i} = end_{i}" for i in range(d)]
            lines += [f"W[{(w + i) * LANES} + lane] = y_{i}" for i in range(d)]
            for i in range(d):
                slowing = [_product(_number(-friction[i][j]), f"y_{j}") for j in range(d)]
                lines.append(f"T[{(w + i) * LANES} + lane] = {_sum(slowing) or '0.0'}")
        for i in range(w):
            velocity = "1.0"  # of the time
            if i < d:
                velocity = _sum([_product(self.mass[i][j], f"y_{j}") for j in range(d)]) or "0.0"
            lines += [f"v_{i} = {velocity}", f"T[{i * LANES} + lane] = v_{i}"]
            change = f"change_{i}" if friction is not None and i < d else f"a * v_{i}"
            lines.append(f"W[{i * LANES} + lane] += {change}")
        return lines

    def _drift_back(self) -> list[str]:
        d, w = self.d, self.width
        lines = [f"a_{i} = A[{i * LANES} + lane]" for i in range(w)]
        by_time = [f"a_{i} * T[{i * LANES} + lane]" for i in range(w)]
        if self.friction is None:
            for j in range(d):
                change = _sum([_product(self.mass[i][j], f"a_{i}") for i in range(d)])
                if change is not None:
                    lines.append(f"A[{(w + j) * LANES} + lane] += a * ({change})")
        else:
            lines += [f"b_{i} = A[{(w + i) * LANES} + lane]" for i in range(d)]
            by_time += [f"b_{i} * T[{(w + i) * LANES} + lane]" for i in range(d)]
            for j in range(d):
                change = " + ".join(f"m_{i}_{j} * a_{i} + e_{i}_{j} * b_{i}" for i in range(d))
                lines.append(f"A[{(w + j) * LANES} + lane] = {change}")
        return [*lines, f"B[lane] = {' + '.join(by_time)}"]


class _Algebra:
    """The forces of a kick and their slopes, by sums of products of the derivatives of V up to an order."""

    def __init__(self, source: _Source, order: int) -> None:
        self.source, self.n = source, range(source.width)
        d = source.d
        self.mass = [[source.mass[i][j] if max(i, j) < d else None for j in self.n] for i in self.n]
        self.known: dict[tuple[int, ...], Entry] = {}
        wanted: dict[str, sp.Expr] = {}
        derivatives: dict[tuple[int, ...], sp.Expr] = {(): source.form.V}
        for length in range(1, order + 1):
            for place in combinations_with_replacement(self.n, length):
                f = derivatives.get(place[:-1])
                f = None if f is None else sp.diff(f, source.q[place[-1]])
                if f is None or f == 0:
                    self.known[place] = None
                    continue
                derivatives[place] = f
                self.known[place] = "V_" + "_".join(map(str, place))
                wanted[str(self.known[place])] = f
        self.by_product: list[dict[tuple[int, ...], Entry]] = []
        for k, product in enumerate(source.products):
            entries: dict[tuple[int, ...], Entry] = {}
            for length in range(1, order + 1):
                for place in combinations_with_replacement(self.n, length):
                    f = sp.diff(product, *(source.q[i] for i in place))
                    entries[place] = None if f == 0 else f"P_{k}_" + "_".join(map(str, place))
                    if f != 0:
                        wanted[str(entries[place])] = f
            self.by_product.append(entries)
        self.lines = statements([*wanted], vectorised([*wanted.values()]))

    def _V(self, *place: int) -> Entry:
        return self.known[tuple(sorted(place))]

    def _named(self, name: str, value: Entry) -> Entry:
        """A line for a sum that is used several times."""
        if value is None or value.isidentifier():
            return value
        self.lines.append(f"{name} = {value}")
        return name

    def _vector(self, name: str, entry: Any) -> list[Entry]:
        return [self._named(f"{name}_{i}", entry(i)) for i in self.n]

    def _symmetric(self, name: str, entry: Any) -> list[list[Entry]]:
        found = {(i, j): self._named(f"{name}_{i}_{j}", entry(i, j)) for i, j in self.source.pairs}
        return [[found[min(i, j), max(i, j)] for j in self.n] for i in self.n]

    def forces(self) -> list[list[Entry]]:
        """−∇V, ∇²V v and −∇W, v = M⁻¹∇V, W = ½ v·∇²V v, as many as the kicks have; or −∇V and the −∇q^m."""
        n, source = self.n, self.source
        result = [[_negative(self._V(i)) for i in n]]
        if source.products:
            return result + [[_negative(entries[i,]) for i in n] for entries in self.by_product]
        if source.level >= FORCE_GRADIENT:
            self.v = self._vector("v", lambda i: _sum([_product(self.mass[i][j], self._V(j)) for j in n]))
            self.G = self._vector("G", lambda i: _sum([_product(self._V(i, j), self.v[j]) for j in n]))
            result.append(self.G)
        if source.level >= CURVATURE:
            self.u = self._vector("u", lambda i: _sum([_product(self.mass[i][j], self.G[j]) for j in n]))
            self.third = self._symmetric("third", lambda i, j: _sum([_product(self._V(i, j, k), self.v[k]) for k in n]))

            def bend(i: int) -> Entry:
                third = _sum([_product(self.third[i][j], self.v[j]) for j in n])
                return _sum([_product("0.5", third), *[_product(self._V(i, j), self.u[j]) for j in n]])

            result.append([_negative(self._named(f"W_{i}", bend(i))) for i in n])
        return result

    def slopes(self, numbers: Sequence[str]) -> dict[tuple[int, int], Entry]:
        """The derivatives of the forces by the positions, times the numbers of the kick, in the upper triangle."""
        n, source = self.n, self.source
        total = {ij: [_product(_negative(self._V(*ij)), numbers[0])] for ij in source.pairs}
        for number, entries in zip(numbers[1:], self.by_product, strict=False):
            for ij in source.pairs:
                total[ij].append(_product(_negative(entries[ij]), number))
        if not source.products and source.level >= FORCE_GRADIENT:
            if source.level < CURVATURE:
                self.third = self._symmetric(
                    "third", lambda i, j: _sum([_product(self._V(i, j, k), self.v[k]) for k in n])
                )
            # A = M⁻¹∇²V: the slope of v
            A = [
                [self._named(f"A_{k}_{j}", _sum([_product(self.mass[k][m], self._V(m, j)) for m in n])) for j in n]
                for k in n
            ]

            def gradient(i: int, j: int) -> Entry:
                return _sum([self.third[i][j], *[_product(self._V(i, k), A[k][j]) for k in n]])

            slope = self._symmetric("slope", gradient)
            for i, j in source.pairs:
                total[i, j].append(_product(slope[i][j], numbers[1]))
        if not source.products and source.level >= CURVATURE:

            def bent(i: int, j: int) -> Entry:
                along = [_product(_sum([_product(self._V(i, j, k, m), self.v[m]) for m in n]), self.v[k]) for k in n]
                return _sum(
                    [
                        _product("0.5", _sum(along)),
                        *[_product(self.third[i][k], A[k][j]) for k in n],
                        *[_product(A[k][i], slope[k][j]) for k in n],
                        *[_product(self._V(i, j, k), self.u[k]) for k in n],
                    ]
                )

            for i, j in source.pairs:
                total[i, j].append(_product(_negative(bent(i, j)), numbers[2]))
        return {ij: _sum(terms) for ij, terms in total.items()}


def _entry(number: sp.Expr) -> Entry:
    return None if number == 0 else as_factor(number)


def _number(value: float) -> Entry:
    return None if value == 0 else repr(value)


def _sum(terms: Sequence[Entry]) -> Entry:
    there = [term for term in terms if term is not None]
    return " + ".join(there) if there else None


def _product(*factors: Entry) -> Entry:
    if any(f is None for f in factors):
        return None
    there = [f if f.isidentifier() else f"({f})" for f in factors if f is not None and f != "1.0"]
    return " * ".join(there) or "1.0"


def _negative(value: Entry) -> Entry:
    return None if value is None else f"-{value}" if value.isidentifier() else f"-({value})"
