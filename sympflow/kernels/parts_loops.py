"""Compiled loops of splittings into exactly solvable parts, in the normal modes of the linear one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from sympflow.hamiltonian.parts import LINEAR, ExactParts, Map, PartFunctions, shears
from sympflow.kernels.codegen import tuple_algebra
from sympflow.kernels.modules import constants_source, load_algebra, template
from sympflow.kernels.parts_codegen import IDLE, TURN_WIDTH, WITH_GRADIENT, parts_source
from sympflow.kernels.passes import row_products
from sympflow.kernels.protocol import NOTHING, Carry, Kernel, Run, Steps, run_state, run_states
from sympflow.kernels.terms import MOST_IN_REGISTERS, MOST_WRITTEN_OUT, written_out
from sympflow.kernels.threads import NEVER, given

__all__ = ["Maps", "PartsKernel", "PartsLoops", "parts_loops"]

ONE = np.ones(1, dtype=np.int64)
TIME_WIDTH = 3  # numbers of a row for its time
SAME_TIME = 1e-12  # of a step: rounding of sums of weights
KNOWN_TABLES = 64  # run tables that are kept: those of the steps in use

Maps = Callable[[np.ndarray], Sequence[Map]]
"""The maps of a step of length h (...), their entries of that batch shape."""


def states_source(ndof: int) -> str:
    """The source of states that are tuples, one by one and in lanes, which systems share."""
    constants = constants_source(COMPENSATED=False, NDOF=ndof, N_VALUES=0)
    texts = map(template, ("running_states", "aligned", "lane_blocks"))
    return "\n\n\n".join([constants, tuple_algebra(ndof), *texts])


@dataclass(frozen=True)
class LoopFunctions:
    """The compiled functions of one variant (with or without filters and force gradients)."""

    rollout: Callable[..., int]
    rollout_batch: Callable[..., None]
    step_each: Callable[..., None]
    step_lanes: Callable[..., None]
    fill_rows: Callable[..., None]
    row_width: int


def parts_loops(parts: ExactParts) -> PartsLoops:
    """The compiled loops of the parts of a system, made once.

    Raises
    ------
    ValueError
        If the parts cannot be compiled, with the reason.
    """
    loops = _LOOPS.get(parts)
    if loops is None:
        loops = _LOOPS[parts] = PartsLoops(parts)
    return loops


_LOOPS: WeakKeyDictionary[ExactParts, PartsLoops] = WeakKeyDictionary()


class PartsLoops:
    """Compiled loops over the maps of any splitting of one system; states are [q, p], float64.

    The linear part's modes rotate by three shears, each with determinant 1 whatever its number, by at most an eighth of
    a turn, after exact quarter turns; the run stays in the modes. So rounding is none at whole quarter turns, and a
    random walk elsewhere, but at some simple fractions of a turn, such as a sixth: the state comes back to nearly
    the same numbers, whose rounding repeats, and the energy drifts by up to 5e-17 of it with each step.

    Parameters
    ----------
    parts : ExactParts
        Of a symbolic system.

    Raises
    ------
    ValueError
        If the parts are plain functions, or H holds a function that has no compiled form.
    """

    def __init__(self, parts: ExactParts) -> None:
        if parts.linear is not None and not parts.linear.dense:
            raise ValueError("`system` has its normal modes by fast transforms, on arrays: use backend='array'.")
        if not all(isinstance(part, PartFunctions) for part in parts.rest):
            raise ValueError("`system` is given by plain functions: define it with from_sympy, or use backend='array'.")
        rest = sum(written_out(part.H, (*part.q, *part.p)) for part in parts.rest)
        if parts.ndof > MOST_IN_REGISTERS or rest > MOST_WRITTEN_OUT:
            raise ValueError(
                f"`system` is too large for compiled normal modes: {parts.ndof} degrees of freedom, about {rest:,} "
                f"operations in its gradient, at most {MOST_IN_REGISTERS} and {MOST_WRITTEN_OUT}. Use backend='array'."
            )
        parts_source(parts, False, False)
        self.parts = parts
        self._variants: dict[tuple[bool, bool], LoopFunctions] = {}
        self.driven = parts.driven
        self.mixed = not parts.diagonal  # modes that are sums of coordinates: transformed outside the loops
        self._coefficients: dict[int, tuple[Sequence[Map], np.ndarray, np.ndarray]] = {}
        self._tables: dict[int, tuple[Sequence[Map], tuple[np.ndarray, np.ndarray], LoopFunctions]] = {}

    def kernel(self, maps: Maps) -> PartsKernel:
        """The loops of one splitting, whose step of length h is `maps(h)`.

        The tables of runs are kept by the identity of what `maps` returns.
        """
        return PartsKernel(self, maps)

    def step_by_coefficients(self, sequence: Sequence[Map], dt: float, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One step from each row of y (N, 2d), each of its own length t (N,) > 0, by maps that are functions of t.

        Parameters
        ----------
        sequence : sequence of Map
            With coefficients (K, …) in place of numbers: of 1 and τ² T_k(2τ² − 1), k = 0 … K−2, where τ = t/dt and T_k
            are Chebyshev's polynomials; lengths are t and force gradients t³ times these sums.
        """
        known = self._coefficients.get(id(sequence))
        if known is None or known[0] is not sequence:
            if len(self._coefficients) >= KNOWN_TABLES:
                self._coefficients.clear()
            known = self._coefficients[id(sequence)] = sequence, *self._coefficient_table(sequence)
        out = np.empty(y.shape)
        functions, t = self.functions(sequence), given(t)
        functions.step_lanes(*known[1:], dt, t, self.modes(y), self.mixed, out)
        return self.states(out)

    def _coefficient_table(self, sequence: Sequence[Map]) -> tuple[np.ndarray, np.ndarray]:
        """Codes (m,) and coefficients (m, 2 + F, K): lengths, or a weight, a force gradient and filters."""
        F, terms = self.parts.n_classes, len(sequence[0].length)
        codes, table = np.empty(len(sequence), dtype=np.int64), np.zeros((len(sequence), 2 + F, terms))
        for j, m in enumerate(sequence):
            codes[j] = m.part + WITH_GRADIENT * has_gradient(m)
            if m.part == LINEAR:
                table[j, :F] = m.length.T
                continue
            table[j, 0], table[j, 1] = m.length, m.gradient
            if m.filters is not None:
                table[j, 2:] = m.filters.T
        return codes, table

    def step_modes(self, sequence: Sequence[Map], modes: np.ndarray) -> np.ndarray:
        """The maps applied once to every row [X, Y] of `modes` (N, 2d), which stay modes."""
        functions = self.functions(sequence)
        out, n_finite = np.empty((len(modes), 1, modes.shape[1])), np.empty(len(modes), dtype=np.int64)
        functions.rollout_batch(*self.run_table(sequence), modes, True, 1, ONE, out, n_finite, NEVER, 0, NOTHING[1])
        return out[:, 0]

    def modes(self, y: np.ndarray) -> np.ndarray:
        """The input of the loops: modes where these are mixed, else states."""
        y = given(y)
        if not self.mixed:
            return y
        parts, d = self.parts, self.parts.ndof
        X = row_products(parts.inverse_C, y[..., :d] - parts.center)
        return np.concatenate([X, row_products(parts.C.T, y[..., d:])], axis=-1)

    def states(self, out: np.ndarray, save: np.ndarray | None = None, y0: np.ndarray | None = None) -> np.ndarray:
        """The output of the loops as states."""
        if not self.mixed:
            return out
        parts, d = self.parts, self.parts.ndof
        X, Y = row_products(parts.C, out[..., :d]), row_products(parts.inverse_C.T, out[..., d:])
        states = np.concatenate([parts.center + X, Y], axis=-1)
        if save is not None and len(save) and save[0] <= 0:
            states[..., : np.searchsorted(save, 0, "right"), :] = y0
        return states

    def functions(self, sequence: Sequence[Map]) -> LoopFunctions:
        known = self._tables.get(id(sequence))
        if known is not None and known[0] is sequence:
            return known[2]
        filters, gradients = any(m.filters is not None for m in sequence), any(map(has_gradient, sequence))
        if gradients and not self.parts.has_force_gradient:
            raise ValueError("`scheme` has force gradients, which need H = linear part + U(q): take one without them.")
        if (filters, gradients) not in self._variants:
            algebra = parts_source(self.parts, filters, gradients)
            module = load_algebra(algebra, ["part_maps"], [states_source(self.parts.ndof)])
            self._variants[filters, gradients] = LoopFunctions(
                module.rollout,
                module.rollout_lanes,
                module.step_each,
                module.step_lanes,
                module.fill_rows,
                module.ROW_WIDTH,
            )
        return self._variants[filters, gradients]

    def table(self, sequence: Sequence[Map], n: int, functions: LoopFunctions) -> tuple[np.ndarray, np.ndarray]:
        """Codes (m,) and coefficients (n, m, W), those of the time, of a driven system, still 0: see `timed`."""
        width = functions.row_width + TIME_WIDTH * self.driven
        codes, tables = np.empty(len(sequence), dtype=np.int64), np.zeros((n, len(sequence), width))
        F = TURN_WIDTH * self.parts.n_classes
        for j, m in enumerate(sequence):
            codes[j] = m.part + WITH_GRADIENT * has_gradient(m)
            if m.part == LINEAR:
                tables[:, j, :F] = self._turns(np.asarray(m.length)).reshape(-1, F)
                continue
            tables[:, j, 0], tables[:, j, 1] = m.length, m.gradient
            if m.filters is not None:
                scale = np.diag(self.parts.C) if self.parts.diagonal else 1.0
                tables[:, j, 2 : 2 + self.parts.ndof] = self.parts.by_class(np.asarray(m.filters)) * scale
        functions.fill_rows(codes, tables)
        return codes, tables

    def timed(self, sequence: Sequence[Map], tables: np.ndarray, t: Any, h: Any) -> np.ndarray:
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

    def run_table(self, sequence: Sequence[Map], h: float = 0.0, t0: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Codes and rows of [opening, inner …, link, closing], of steps h from t0 on: see `text/part_maps.py`."""
        known = self._tables.get(id(sequence))
        if known is None or known[0] is not sequence:
            rows, functions = self._rows(sequence), self.functions(sequence)
            codes, table = self.table(rows, 1, functions)
            if len(self._tables) >= KNOWN_TABLES:
                self._tables.clear()
            known = self._tables[id(sequence)] = sequence, (codes, np.ascontiguousarray(table[0])), functions
        if not self.driven:
            return known[1]
        codes, table = known[1]
        return codes, self.timed(self._rows(sequence), table, t0, h)

    def _rows(self, sequence: Sequence[Map]) -> list[Map]:
        """The maps of a step in the order of `run_table`."""
        idle = Map(IDLE, 0.0)
        first, last = sequence[0], sequence[-1]
        merged = self._merged(last, first) if len(sequence) > 1 else None
        return [idle, *sequence, idle, idle] if merged is None else [first, *sequence[1:-1], merged, last]

    def _merged(self, last: Map, first: Map) -> Map | None:
        """The last map of a step and the first of the next, if they are one: of parts that move at the same time."""
        together = not self.parts.timed(last.part) or abs(last.at - 1 - first.at) < SAME_TIME
        return merge(last, first) if together else None


class PartsKernel(Kernel):
    """The compiled loops of one splitting of a system into parts, a `Kernel`: see `PartsLoops.kernel`."""

    saves_finite = True

    def __init__(self, loops: PartsLoops, maps: Maps) -> None:
        self.loops, self.maps = loops, maps

    def run(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        carry: Carry | None = None,
        t0: float = 0.0,
    ) -> Run:
        """`n_steps` steps of length `h` from one state: see `Kernel`."""
        loops, sequence = self.loops, self.maps(np.asarray(h, dtype=float))
        rollout, mixed = loops.functions(sequence).rollout, loops.mixed
        codes, table = loops.run_table(sequence, h, t0)

        def steps(start: np.ndarray, n_steps: int, save: np.ndarray, out: np.ndarray, *rest: Any) -> int:
            return rollout(codes, table, start, mixed, n_steps, save, out.T, *rest)  # one type, of a single output too

        out = np.empty((len(y0), len(save))).T  # each component in one piece, as a solution has them
        start, work = loops.modes(y0), len(codes) * loops.parts.ndof
        Y, n_finite, _ = run_state(steps, start, n_steps, save, carry, len(start), work, out)
        return Run(loops.states(Y, save, y0), n_finite)

    def run_batch(
        self,
        h: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None = None,
        carry: Carry | None = None,
        t0: float = 0.0,
    ) -> Run:
        """`run` for every row of `y0` (N, 2d), in vector lanes and, where it pays, on several threads."""
        loops, sequence = self.loops, self.maps(np.asarray(h, dtype=float))
        rollout, mixed = loops.functions(sequence).rollout_batch, loops.mixed
        codes, table = loops.run_table(sequence, h, t0)

        def rows(_: slice, start: np.ndarray, *rest: Any) -> None:
            rollout(codes, table, start, mixed, *rest)

        start, work = loops.modes(y0), len(codes) * loops.parts.ndof
        Y, n_finite, _ = run_states(rows, start, n_steps, save, threads, carry, start.shape[1], work)
        return Run(loops.states(Y, save, y0[:, None]), n_finite)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,)."""
        lengths = np.broadcast_to(np.asarray(h, dtype=np.float64), y.shape[:1])
        loops, sequence = self.loops, self.maps(lengths)
        functions = loops.functions(sequence)
        out = np.empty(y.shape)
        codes, tables = loops.table(sequence, len(y), functions)
        tables = loops.timed(sequence, tables, t, lengths)
        functions.step_each(codes, tables, loops.modes(y), loops.mixed, out)
        return Steps(loops.states(out))


def has_gradient(m: Map) -> bool:
    return bool(np.any(m.gradient))


def merge(one: Map, other: Map) -> Map | None:
    """The map that is `other` after `one`, if it is one map."""
    if one.part != other.part:
        return None
    if one.part != LINEAR and not _same(one.filters, other.filters):
        return None
    return Map(one.part, one.length + other.length, one.gradient + other.gradient, one.filters)


def _same(a: Any, b: Any) -> bool:
    return (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))
