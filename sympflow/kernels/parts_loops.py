"""Compiled loops of splittings into exactly solvable parts, in the normal modes of the linear one.

A column has the numbers of one map: six that turn each frequency; or a weight, a force gradient, the filters of the
modes and what is made of these alone; then of a driven system when the map acts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache, cached_property, lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import NotCompiled
from sympflow.compiler.arrange import Arranged, Arrangement
from sympflow.compiler.control import INT, POINTER, Value
from sympflow.compiler.functions import fma, summed, times
from sympflow.compiler.machine import address
from sympflow.compiler.program import Program, gradient, tangent, traced
from sympflow.hamiltonian.formulas import evaluator
from sympflow.hamiltonian.parts import LINEAR, ExactParts, PartFunctions, SubFlow, shears
from sympflow.kernels.protocol import Kernel, Run, Steps, Task, begun_in, run_states
from sympflow.kernels.rollouts import Columns, Rollouts, shared
from sympflow.kernels.runs import Numbers, begun, finished
from sympflow.kernels.stage_times import SymbolicCoefficients
from sympflow.kernels.terms import MOST_IN_REGISTERS, written_out
from sympflow.kernels.threads import given
from sympflow.lazy import kept

if TYPE_CHECKING:
    from sympflow.kernels.reverse import Between

__all__ = ["Maps", "PartsKernel", "PartsLoops", "parts_loops"]

IDLE = -1  # code of no map
WITH_GRADIENT = 100  # added to the code of a part that carries a force gradient
TURN_WIDTH = 6  # numbers that turn a frequency
TIME_WIDTH = 3  # numbers of a column for its time
EARLY = -4  # when momenta are known before the positions, in cycles
MOST_OPERATIONS = 300  # of all kinds of columns
MOST_WRITTEN_OUT = 1000  # operations of the gradients of all parts
SAME_TIME = 1e-12  # of a step: rounding of sums of weights
KNOWN_TABLES = 64  # run tables that are kept: those of the steps in use

Maps = Callable[[np.ndarray], Sequence[SubFlow]]
"""The maps of a step of length h (...), their entries of that batch shape."""


class Scales:
    """The matrices of the modes by rows, each a scale, which is a number of tables, times what is part of the code.

    So the couplings and modes that differ in their scales alone share their code. `named` are the scales, the centre,
    the masses of the modes and the values of parameters, those that are neither 0 nor 1.
    """

    def __init__(self, parts: ExactParts) -> None:
        self.C, C_scales = _scaled(parts.C)
        self.inverse, inverse_scales = _scaled(parts.inverse_C.T)
        rates = parts.inverse_masses(np.zeros(parts.ndof)) if parts.has_force_gradient else np.zeros(parts.ndof)
        known = {"center": parts.center, "scale": C_scales, "inverse": inverse_scales, "rate": rates}
        self.values = {f"{name}_{i}": float(x) for name, row in known.items() for i, x in enumerate(row)}
        for part in parts.rest:
            self.values |= {s.name: x for s, x in zip(part.parameters, part.values, strict=True)}
        self.named = {name: x for name, x in self.values.items() if x not in (0.0, 1.0)}
        alike = tuple(sorted((name, self.values[name]) for name in self.values.keys() - self.named.keys()))
        self.key = self.C.tobytes(), self.inverse.tobytes(), alike, tuple(self.named)

    def row(self, name: str, known: dict[str, Any]) -> list[Any]:
        """The numbers of a name, of each mode."""
        return [known.get(f"{name}_{i}", self.values[f"{name}_{i}"]) for i in range(len(self.C))]


def _scaled(C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A matrix with rows whose largest entry is 1, up to its sign, and the scales of these."""
    scales = np.abs(C).max(1)
    return C / scales[:, None], scales


class PartMaps:
    """The maps of the parts of a symbolic system as code, with `filters` if they have some."""

    def __init__(self, parts: ExactParts, scales: Scales, filters: bool) -> None:
        self.parts, self.scales, self.ndof, self.filters = parts, scales, parts.ndof, filters
        self.lettered = [SymbolicCoefficients(part, [part.H]) for part in parts.rest]
        self.codes: dict[tuple[tuple[int, ...], ...], PartsCode] = {}

    @kept
    def arranged(self, code: int) -> Arranged:
        """The map of a part, from x, y and coefficients of the time and what its table makes of a column's numbers."""
        with_gradient = code >= WITH_GRADIENT
        shapes = [
            self._part(code % WITH_GRADIENT, with_gradient, expand) for expand in (True, False)[: 1 + with_gradient]
        ]
        return min(shapes, key=lambda shape: shape[0])[1]

    def _part(self, number: int, with_gradient: bool, expand: bool) -> tuple[int, Arranged]:
        """x + b J∇H_k(x), and with a force gradient g ∇²U M⁻¹∇U added to y; its cost before it."""
        d, coefficients = self.ndof, self.lettered[number - 1].time_coefficients
        filters = [f"phi_{j}" for j in range(d) if self.filters]
        states = [*((f"x_{j}", 0) for j in range(d)), *((f"y_{j}", EARLY) for j in range(d))]
        constants = ["b", "g", *filters, *self.scales.named]
        made = Arrangement([*states, *((s.name, EARLY) for s in coefficients)], constants, expand)
        (b, g, *more), program = made.constants, self._slopes(number, with_gradient)
        phi, scales = more[: len(filters)], more[len(filters) :]
        slopes = program(*made.states, *(phi or [made.number(1.0)] * d), *scales)
        changes = [times(b, v) for v in slopes[d : 2 * d]]
        changes += [times(g, w) - times(b, v) for v, w in zip(slopes[:d], slopes[2 * d :] or [0.0] * d, strict=True)]
        new = [made.written(x + made.number(change)) for x, change in zip(made.states, changes, strict=False)]
        arranged = made.finish(new)
        return 2 * max(map(made.depth, new)) + 3 * len(arranged.body), arranged

    def _slopes(self, number: int, with_gradient: bool) -> Program:
        """∂H_k/∂x, ∂H_k/∂y and, where it is needed, ∂²H_k/∂x² M⁻¹∂H_k/∂x, from modes, coefficients and filters."""
        lettered, scales, d = self.lettered[number - 1], self.scales, self.ndof
        part, count = self.parts.rest[number - 1], len(lettered.time_coefficients)

        def slopes(*numbers: Any) -> list[Any]:
            x, y, coefficients, phi = (numbers[i:j] for i, j in pairwise((0, d, 2 * d, 2 * d + count, 3 * d + count)))
            named = dict(zip(scales.named, numbers[3 * d + count :], strict=True))
            filtered = [f * v for f, v in zip(phi, x, strict=True)]
            q, p = (
                [s * summed(0.0, row, v) for s, row in zip(scales.row(name, named), A.tolist(), strict=True)]
                for name, A, v in (("scale", scales.C, filtered), ("inverse", scales.inverse, y))
            )
            q = [center + v for center, v in zip(scales.row("center", named), q, strict=True)]
            given = [named.get(s.name, scales.values[s.name]) for s in part.parameters]
            symbols = *part.q, *part.p, *lettered.given
            known = evaluator(dict(zip(symbols, (*q, *p, *given, *coefficients), strict=True)))
            slope = gradient(known(lettered.expressions[0]), [*x, *y])
            rates = scales.row("rate", named) if with_gradient else []
            along = (
                tangent(slope[:d], x, [rate * v for rate, v in zip(rates, slope, strict=False)])
                if with_gradient
                else []
            )
            return [*slope, *along]

        names = [f"{name}_{j}" for name in ("x", "y") for j in range(d)] + [s.name for s in lettered.time_coefficients]
        return traced(slopes, *names, *(f"phi_{j}" for j in range(d)), *scales.named)

    @cached_property
    def size(self) -> int:
        """Numbers of a map."""
        numbers = range(1, len(self.parts.rest) + 1)
        codes = [*numbers, *(WITH_GRADIENT + k for k in numbers if self.parts.has_force_gradient)]
        made = [len(self.arranged(code).table.outputs) for code in codes]
        return max([TURN_WIDTH * self.parts.n_classes, *made]) + TIME_WIDTH * self.parts.driven

    def operations(self, code: int) -> int:
        """Operations of a map."""
        return TURN_WIDTH * self.ndof if code == LINEAR else 0 if code == IDLE else len(self.arranged(code).body)

    def entries(self, codes: np.ndarray, raw: np.ndarray, named: Sequence[float]) -> np.ndarray:
        """The numbers (n, m, size) of maps, of given ones (n, m, ·): turns; or weights, gradients and filters.

        The `named` numbers are those of `Scales`.
        """
        entries = np.zeros((*raw.shape[:2], self.size))
        for code in np.unique(codes):
            here = codes == code
            if code == LINEAR:
                rows = raw[:, here, : TURN_WIDTH * self.parts.n_classes]
            elif code == IDLE:
                continue
            else:
                table = self.arranged(int(code)).table
                numbers = [raw[:, here, i] for i in range(len(table.inputs) - len(named))]
                with np.errstate(all="ignore"):
                    outputs = [np.broadcast_to(x, numbers[0].shape) for x in table(*numbers, *named)]
                rows = np.stack(outputs, axis=-1) if outputs else raw[:, here, :0]
            entries[:, here, : rows.shape[-1]] = rows
        return entries

    def apply(self, code: int, values: Sequence[Any], numbers: Numbers, step: Any) -> Sequence[Any]:
        """The values after a map."""
        if code == IDLE:
            return values
        return self._linear(values, numbers) if code == LINEAR else self._moved(code, values, numbers, step)

    def _moved(self, k: int, values: Sequence[Any], numbers: Numbers, step: Any) -> list[Any]:
        body, coefficients = self.arranged(k), []
        lettered = self.lettered[k % WITH_GRADIENT - 1]
        if lettered.time_coefficients:
            before, first, length = (numbers(self.size - TIME_WIDTH + i) for i in range(TIME_WIDTH))
            coefficients = lettered.at(first + (step * length + before), [])
        return body.body(*values, *coefficients, *(numbers(i) for i in range(len(body.table.outputs))))

    def _linear(self, values: Sequence[Any], numbers: Numbers) -> list[Any]:
        """Rotations by three shears after exact quarter turns, hyperbolic ones by shears alone, drifts."""
        linear, d = self.parts.linear, self.ndof
        assert linear is not None
        x, y = [*values[:d]], [*values[d:]]
        for j, (kind, f) in enumerate(zip(linear.kinds, linear.classes.tolist(), strict=True)):
            if kind == "idle":
                continue
            t, s, c, e, a, b = (numbers(TURN_WIDTH * f + i) for i in range(TURN_WIDTH))
            if kind == "free":
                x[j] = fma(2.0 * t, y[j], x[j])
            elif kind == "hyperbolic":
                x[j] = fma(t, y[j], x[j])
                y[j] = fma(-s, x[j], y[j])
                x[j] = fma(t, y[j], x[j])
            elif kind == "oscillator":  # of each pair of products that are added first, one is 0 and the other exact
                turned = fma(c, y[j], -(e * x[j]))
                x[j] = fma(b, y[j], a * x[j])  # y comes from a kick, later than x
                y[j] = fma(-s, x[j], turned)
                x[j] = fma(t, y[j], x[j])
        return [*x, *y]


class PartsCode(Rollouts):
    """Groups of maps, by their codes, as stages: a column has the numbers of one map after the other."""

    lanes = 16

    def __init__(self, maps: PartMaps, groups: Sequence[tuple[int, ...]]) -> None:
        super().__init__(2 * maps.ndof, 2 * maps.ndof)
        self.maps, self.groups = self._given = maps, tuple(groups)
        self.size, self.kinds = maps.size * max(map(len, groups)), len(groups)

    def columns(self, groups: Sequence[Sequence[int]], entries: np.ndarray) -> Columns:
        """The columns (n, k, size) of groups of maps, whose numbers are (n, m, size), and their kinds (k,)."""
        n, _, size = entries.shape
        columns, at = np.zeros((n, len(groups), self.size)), 0
        for k, codes in enumerate(groups):
            columns[:, k, : len(codes) * size] = entries[:, at : at + len(codes)].reshape(n, -1)
            at += len(codes)
        return columns, np.array([self.groups.index(tuple(codes)) for codes in groups], dtype=np.int64)

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        """The maps that a column has."""
        code, type = values[0].code, values[0].type
        whole = code.convert("sitofp", step, "double")

        def executed(k: int) -> list[Value]:
            return [code.operand(x, type) for x in self._executed(k, values, numbers, whole)]

        def one_of(kinds: Sequence[int]) -> list[Value]:
            k, *rest = kinds
            if not rest:
                return executed(k)
            return code.when(code.apply("eq", (kind, k)), lambda: executed(k), lambda: one_of(rest))

        return one_of(range(self.kinds))

    def plain(self, kind: int, state: Sequence[Any], column: Sequence[Any], step: Any) -> Sequence[Any]:
        return self._executed(kind, state, column.__getitem__, step)

    def check_reverse(self) -> None:
        """All stages have a reverse."""

    def _executed(self, k: int, values: Sequence[Any], numbers: Numbers, step: Any) -> Sequence[Any]:
        for i, code in enumerate(self.groups[k]):
            values = self.maps.apply(code, values, lambda j, i=i: numbers(i * self.maps.size + j), step)
        return values


@kept
def parts_loops(parts: ExactParts) -> PartsLoops:
    """The compiled loops of the parts of a system, made once; raises NotCompiled if there are none."""
    return PartsLoops(parts)


class PartsLoops:
    """Compiled loops over the maps of any splitting of one symbolic system; states are [q, p], float64.

    The linear part's modes rotate by three shears of determinant 1, by at most an eighth of a turn, after exact quarter
    turns. So rounding is none at whole quarter turns, and a random walk elsewhere, but at some simple fractions of a
    turn, where the state comes back to nearly the same numbers and the energy drifts by up to 5e-17 of it a step.
    """

    def __init__(self, parts: ExactParts) -> None:
        if parts.linear is not None and not parts.linear.dense:
            raise NotCompiled("`system` has its normal modes by fast transforms, on arrays: use backend='array'.")
        if not all(isinstance(part, PartFunctions) for part in parts.rest):
            raise NotCompiled(
                "`system` has parts that are not formulas, and exact flows of parts are compiled of formulas alone: "
                "define it with from_sympy, or use backend='array'."
            )
        rest = sum(_operations(part.H, (*part.q, *part.p)) for part in parts.rest)
        if parts.ndof > MOST_IN_REGISTERS or rest > MOST_WRITTEN_OUT:
            raise NotCompiled(
                f"`system` is too large for compiled flows of its parts: {parts.ndof} degrees of freedom, about "
                f"{rest:,} operations in its gradient, at most {MOST_IN_REGISTERS} and {MOST_WRITTEN_OUT}."
                " Use backend='array'."
            )
        self.parts, self.driven = parts, parts.driven
        self._scales = Scales(parts)
        self._of(())  # which says what has no compiled form
        self._tables: dict[int, tuple[Sequence[SubFlow], _Table]] = {}

    def kernel(self, maps: Maps) -> PartsKernel:
        """The loops of one splitting, whose step of length h is `maps(h)`; tables are kept by the identity of that."""
        return PartsKernel(self, maps)

    def step_by_coefficients(self, sequence: Sequence[SubFlow], dt: float, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One step from each row of y (N, 2d), each of its own length t (N,) > 0, by maps that are functions of t.

        Numbers are coefficients (K, …) of 1 and τ² T_k(2τ² − 1), τ = t/dt, lengths t and force gradients t³ times the
        sums.
        """
        square = (t / dt) ** 2
        terms = max(len(sequence[0].length), 3)
        basis = np.empty((terms, len(t)))
        basis[0], basis[1], basis[2] = 1.0, square, square * (2.0 * square - 1.0)
        for k in range(3, terms):
            basis[k] = 2.0 * (2.0 * square - 1.0) * basis[k - 1] - basis[k - 2]

        def valued(c: Any, power: int) -> np.ndarray:
            c = np.asarray(c)
            total = np.zeros((len(t), *c.shape[1:]))
            for k, each in enumerate(c):  # in this order for any number of rows
                total += np.multiply.outer(basis[k], each)
            return total * (t**power).reshape(-1, *[1] * (c.ndim - 1))

        maps = []
        for m in sequence:
            g = valued(m.gradient, 3) if m.has_gradient else 0.0
            maps.append(SubFlow(m.part, valued(m.length, 1), g, None if m.filters is None else valued(m.filters, 0)))
        return self.stepped(maps, y)

    def stepped(self, sequence: Sequence[SubFlow], y: np.ndarray, t: Any = 0.0, h: Any = 0.0) -> np.ndarray:
        """The maps applied once to every row of `y` (N, 2d), their entries of its own, at the time t in steps h."""
        maps, start = self._of(sequence), self.modes(y)
        codes, entries = self.table(sequence, len(y), maps)
        entries = self.timed(sequence, entries, t, h)
        code = self._singles(maps)
        return self.states(code.single_steps(*code.columns([(k,) for k in codes.tolist()], entries), start))

    def step_modes(self, sequence: Sequence[SubFlow], modes: np.ndarray) -> np.ndarray:
        """The maps applied once to every row [X, Y] of `modes` (N, 2d), which stay modes."""
        maps, out = self._of(sequence), np.empty_like(modes)
        codes, entries = self.table(sequence, 1, maps)
        code = self._singles(maps)
        columns, kinds = code.columns([(k,) for k in codes.tolist()], entries)
        code.mapped((columns[0], kinds), given(modes), out)
        return out

    def modes(self, y: np.ndarray) -> np.ndarray:
        """The modes (N, 2d) of states."""
        y, parts, d = given(y), self.parts, self.parts.ndof
        if parts.diagonal:
            center, factors, _ = self._factors
            return (y - center) * factors
        X = row_products(parts.inverse_C, y[..., :d] - parts.center)
        return np.concatenate([X, row_products(parts.C.T, y[..., d:])], axis=-1)

    def states(self, out: np.ndarray, save: np.ndarray | None = None, y0: np.ndarray | None = None) -> np.ndarray:
        """The states of modes; those after no step are `y0`."""
        parts, d = self.parts, self.parts.ndof
        if parts.diagonal:
            center, _, factors = self._factors
            states = out * factors
            states += center
        else:
            X, Y = row_products(parts.C, out[..., :d]), row_products(parts.inverse_C.T, out[..., d:])
            states = np.concatenate([parts.center + X, Y], axis=-1)
        if save is not None and len(save) and save[0] <= 0:
            states[..., : np.searchsorted(save, 0, "right"), :] = y0
        return states

    @cached_property
    def _factors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The centre (2d,) of states, and the factors (2d,) to modes and back, of modes that are single coordinates."""
        C, inverse = np.diag(self.parts.C), np.diag(self.parts.inverse_C)
        center = np.concatenate([np.broadcast_to(self.parts.center, C.shape), np.zeros_like(C)])
        return center, np.concatenate([inverse, C]), np.concatenate([C, inverse])

    def _of(self, sequence: Sequence[SubFlow]) -> PartMaps:
        """The code of maps with what these have."""
        if any(m.has_gradient for m in sequence) and not self.parts.has_force_gradient:
            raise NotCompiled("`scheme` has force gradients, which need H = linear part + U(q): take one without them.")
        filters, parts, linear = any(m.filters is not None for m in sequence), self.parts, self.parts.linear
        of_rest = tuple((part.H, part.q, part.p, part.time) for part in parts.rest)
        of_linear = None if linear is None else (linear.kinds, linear.classes.tobytes())
        key = PartMaps, filters, of_rest, of_linear, parts.has_force_gradient, self._scales.key
        return shared(key, lambda: PartMaps(parts, self._scales, filters))

    def _code(self, maps: PartMaps, groups: Iterable[tuple[int, ...]]) -> PartsCode:
        key = tuple(sorted({*groups}))
        if key not in maps.codes:
            maps.codes[key] = PartsCode(maps, key)
        return maps.codes[key]

    def _singles(self, maps: PartMaps) -> PartsCode:
        """The code of one map a column."""
        numbers = range(1, len(self.parts.rest) + 1)
        with_gradients = [WITH_GRADIENT + k for k in numbers if self.parts.has_force_gradient]
        return self._code(
            maps, [(k,) for k in (IDLE, *([LINEAR] if self.parts.linear else []), *numbers, *with_gradients)]
        )

    def table(self, sequence: Sequence[SubFlow], n: int, maps: PartMaps) -> tuple[np.ndarray, np.ndarray]:
        """Codes (m,) and numbers (n, m, size), those of the time, of a driven system, still 0: see `timed`."""
        d, F = self.parts.ndof, self.parts.n_classes
        codes = np.array([*map(_code_of, sequence)], dtype=np.int64)
        raw = np.zeros((n, len(sequence), max(TURN_WIDTH * F, 2 + d)))
        raw[..., 2 : 2 + d] = 1.0
        turning = np.flatnonzero(codes == LINEAR).tolist()
        if len(turning):
            lengths = np.empty((n, len(turning), F))
            for k, j in enumerate(turning):
                lengths[:, k] = sequence[j].length
            raw[:, turning, : TURN_WIDTH * F] = self._turns(lengths).reshape(n, len(turning), -1)
        for j in np.flatnonzero(codes > LINEAR).tolist():
            m = sequence[j]
            raw[:, j, 0], raw[:, j, 1] = m.length, m.gradient
            if m.filters is not None:
                raw[:, j, 2 : 2 + d] = self.parts.by_class(np.asarray(m.filters))
        return codes, maps.entries(codes, raw, [*self._scales.named.values()])

    def timed(self, sequence: Sequence[SubFlow], tables: np.ndarray, t: Any, h: Any) -> np.ndarray:
        """Tables (..., m, W) of steps h (...) that begin at t (...): a copy with the times, if the system is driven."""
        if not self.driven:
            return tables
        tables, (t, h) = tables.copy(), np.broadcast_arrays(t, h)
        tables[..., -3] = np.array([m.at for m in sequence]) * h[..., None]
        tables[..., -2], tables[..., -1] = t[..., None], h[..., None]
        return tables

    def _turns(self, s: np.ndarray) -> np.ndarray:
        """Six numbers that turn each frequency by Ω s, (..., F, 6): t, σ, c and d of `shears`, c − td and d + tc."""
        linear = self.parts.linear
        assert linear is not None
        kinds = [linear.kinds[j] for j in linear.representatives]
        t, sigma, c, d = shears(kinds, linear.rates[linear.representatives], s)
        return np.stack([t, sigma, c, d, c - t * d, d + t * c], axis=-1)

    def run_table(self, sequence: Sequence[SubFlow], h: float = 0.0, t0: float = 0.0) -> tuple[PartsCode, Columns]:
        """The code and the columns of a run, of steps h from t0 on."""
        known = self._tables.get(id(sequence))
        if known is None or known[0] is not sequence:
            if len(self._tables) >= KNOWN_TABLES:
                self._tables.clear()
            known = self._tables[id(sequence)] = sequence, self._table(sequence)
        table = known[1]
        if not self.driven:
            return table.code, table.columns
        columns, kinds = table.code.columns(table.groups, self.timed(table.maps, table.entries, t0, h))
        return table.code, (columns[0], kinds)

    def _table(self, sequence: Sequence[SubFlow]) -> _Table:
        """The columns [opening, inner …, link, closing], of as many maps each as the code may hold."""
        of, first, last = self._of(sequence), sequence[0], sequence[-1]
        merged = self._merged(last, first) if len(sequence) > 1 else None
        rest, link, closing = [*sequence[1:]], first, SubFlow(IDLE, 0.0)
        if merged is not None:  # what closes a step is executed after it
            rest, link, closing = [*sequence[1:-1]], merged, replace(last, at=last.at - 1)
        for size in range(len(rest) + 1, 0, -1):
            head, inner = rest[: size - 1], [rest[i : i + size] for i in range(size - 1, len(rest), size)]
            groups = [[first, *head], *inner, [link, *head], [closing]]
            kinds = {tuple(map(_code_of, group)) for group in groups}
            if sum(of.operations(k) for kind in kinds for k in kind) <= MOST_OPERATIONS:
                break
        maps = [m for group in groups for m in group]
        _, entries = self.table(maps, 1, of)
        code, codes = self._code(of, kinds), [tuple(map(_code_of, group)) for group in groups]
        columns, numbers = code.columns(codes, entries)
        return _Table(code, maps, codes, entries, (columns[0], numbers))

    def _merged(self, last: SubFlow, first: SubFlow) -> SubFlow | None:
        """The last map of a step and the first of the next, if they are one: of parts that move at the same time."""
        together = not self.parts.timed(last.part) or abs(last.at - 1 - first.at) < SAME_TIME
        merged = merge(last, first) if together else None
        return None if merged is None else replace(merged, at=first.at)


class _Table(NamedTuple):
    """The tables of a run of a sequence of maps: the maps in groups, their numbers, and the columns of these."""

    code: PartsCode
    maps: list[SubFlow]
    groups: list[tuple[int, ...]]
    entries: np.ndarray
    columns: Columns


class PartsKernel(Kernel):
    """The compiled loops of one splitting of a system into parts, a `Kernel`: see `PartsLoops.kernel`."""

    def __init__(self, loops: PartsLoops, maps: Maps) -> None:
        self.loops, self.maps = loops, maps

    def runs(self, task: Task) -> Run:
        loops, sequence = self.loops, self.maps(np.asarray(task.h, dtype=float))
        (code, columns), start = loops.run_table(sequence, task.h, task.t0), loops.modes(task.y0)
        work = len(sequence) * loops.parts.ndof
        Y, n_finite, _ = run_states(partial(code.run, columns), task._replace(y0=start), start.shape[1], work)
        return Run(loops.states(Y, task.save, task.y0[:, None]), n_finite)

    def check_reverse(self) -> None:
        """All maps have a reverse."""

    def recorded(self, task: Task) -> Between:
        from sympflow.kernels.reverse import Between, Recorded

        loops, sequence = self.loops, self.maps(np.asarray(task.h, dtype=float))
        (code, columns), parts = loops.run_table(sequence, task.h, task.t0), loops.parts
        work, save = len(sequence) * parts.ndof, task.save[begun_in(task.save) :]
        run = Recorded(code, columns, loops.modes(task.y0), task.n_steps, save, work)

        def by(of_q: np.ndarray, of_p: np.ndarray, x: np.ndarray) -> np.ndarray:
            halves = x[..., : parts.ndof], x[..., parts.ndof :]
            return np.concatenate([row_products(A, each) for A, each in zip((of_q, of_p), halves, strict=True)], -1)

        out, into = partial(by, parts.C.T, parts.inverse_C), partial(by, parts.inverse_C.T, parts.C)
        return Between(task, run, loops.states(run.states), out, into)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,)."""
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        return Steps(self.loops.stepped(self.maps(lengths), y, t, lengths))


_operations = lru_cache(maxsize=64)(written_out)


def _code_of(m: SubFlow) -> int:
    return m.part + WITH_GRADIENT * m.has_gradient


def merge(one: SubFlow, other: SubFlow) -> SubFlow | None:
    """The map that is `other` after `one`, if it is one map."""
    if one.part != other.part:
        return None
    filters, others = (np.zeros(0) if m.filters is None else m.filters for m in (one, other))
    if one.part != LINEAR and not np.array_equal(filters, others):
        return None
    return SubFlow(one.part, one.length + other.length, one.gradient + other.gradient, one.filters)


def row_products(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A x of all vectors x (..., n); unlike those of a library, its bits do not depend on how many there are."""
    rows, matrix = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(A)
    out = np.empty_like(rows)
    n = rows.shape[-1]
    _products_function()(address(matrix), n, address(rows), rows.size // n, address(out))
    return out


@cache
def _products_function() -> Callable[..., None]:
    code = begun("products", [POINTER, INT, POINTER, INT, POINTER])
    A, n, x, n_rows, out = code.arguments
    with code.over(n_rows) as i, code.over(n) as j:
        row, start = code.at(A, j * n), code.at(x, i * n)
        total = code.variable(code.constant(0.0))
        with code.over(n) as k:
            total.value = total.value + code.load(row, k) * code.load(start, k)
        code.store(total.value, out, i * n + j)
    return finished(code)
