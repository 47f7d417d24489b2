"""Kicks and drifts of a symbolic system as stages over traced numbers, and the compiled functions of any scheme."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.compiler.arrange import Arrangement, Arranged, Polynomial
from sympflow.compiler.control import Code, Value
from sympflow.compiler.numbers import fma, times
from sympflow.compiler.program import Program, derivatives, gradient, traced
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.recorded import evaluator
from sympflow.kernels.runs import Numbers, map_function, run_function, step_function
from sympflow.kernels.stages import kicks_of
from sympflow.schemes import CURVATURE, FORCE_GRADIENT, POLYNOMIAL

if TYPE_CHECKING:
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

__all__ = ["SplittingCode"]


class _Kind:
    """One kind of kick, with the drift that follows: how numbers of a column become those that its code reads."""

    def __init__(self, arranged: Arranged) -> None:
        self.table, self.body = arranged
        self.size = len(self.table.outputs)


def _slopes(symbols: SymbolicHamiltonian, terms: int) -> Program:
    """∇V, and its second and third derivatives, as many orders as there are terms; rows of the tensors one by one."""
    d, names = symbols.ndof, [s.name for s in (*symbols.q, *symbols.parameters)]

    def potential(*numbers: Any) -> list[Any]:
        return [evaluator(dict(zip((*symbols.q, *symbols.parameters), numbers, strict=True)))(symbols.V)]

    recorded = traced(potential, *names)
    q, V = recorded.inputs[:d], recorded.outputs[0]
    orders = [gradient(V, q)]
    for _ in range(1, terms):
        orders.append([x for row in derivatives(orders[-1], q) for x in row])
    return Program(recorded.inputs, [x for order in orders for x in order])


def _kind(symbols: SymbolicHamiltonian, numbers: Sequence[str], terms: int, monomials: Monomials) -> _Kind:
    """p − b∇V + g∇²V v − c∇(½ v·∇²V v), v = M⁻¹∇V, or p − b∇V − Σ_m e_m ∇q^m, and then q + a∇T."""
    d, M = symbols.ndof, symbols.inverse_mass
    names = [s.name for s in symbols.parameters]
    states = [*((s.name, 0) for s in symbols.q), *((s.name, -1) for s in symbols.p)]
    made = Arrangement(states, ["a", *numbers, *names])
    q, p = made.states[:d], made.states[d:]
    a, b, *more = made.constants[: 1 + len(numbers)]
    values = made.constants[1 + len(numbers) :]
    orders = [made.number(x) for x in _slopes(symbols, terms)(*q, *values)]
    slope, hessian = orders[:d], np.array(orders[d : d + d * d], dtype=object).reshape(-1, d)
    changes = [p[i] - times(b, slope[i]) for i in range(d)]
    if terms > 1:
        product = [_dot(row, _by_mass(M, slope, values, symbols)) for row in hessian]
        changes = [x + times(more[0], y) for x, y in zip(changes, product, strict=True)]
    if terms > 2:
        third, v = np.array(orders[d + d * d :], dtype=object).reshape(d, d, d), _by_mass(M, slope, values, symbols)
        again = [_dot(row, _by_mass(M, product, values, symbols)) for row in hessian]
        bent = [_dot([_dot(row, v) for row in rows], v) for rows in third]
        changes = [x - times(more[1], y + 0.5 * z) for x, y, z in zip(changes, again, bent, strict=True)]
    for e, powers in zip(more if monomials else (), monomials, strict=False):
        for i in range(d):
            changes[i] = changes[i] - e * _slope_of_monomial(powers, i, q)
    momenta = [made.written(x) for x in changes]
    if M is None:
        kinetic = evaluator(dict(zip((*symbols.p, *symbols.parameters), [*map(made.letter, momenta), *values], strict=True)))
        positions = [made.written(q[i] + a * made.number(kinetic(symbols.T.diff(s)))) for i, s in enumerate(symbols.p)]
    else:
        positions = [made.node(x) for x in q]
        entry = evaluator(dict(zip(symbols.parameters, values, strict=True)))
        for i in range(d):
            for j in range(d):
                if M[i, j] != 0:
                    factor = made.written(times(a, made.number(entry(M[i, j]))))
                    positions[i] = made.moved(positions[i], factor, momenta[j])
    return _Kind(made.finish([*positions, *momenta]))


def _dot(x: Sequence[Any], y: Sequence[Any]) -> Any:
    total: Any = 0.0
    for a, b in zip(x, y, strict=True):
        total = total + times(a, b)
    return total


def _by_mass(M: Any, v: Sequence[Any], values: Sequence[Any], symbols: SymbolicHamiltonian) -> list[Any]:
    """M⁻¹v."""
    entry = evaluator(dict(zip(symbols.parameters, values, strict=True)))
    d = len(v)
    return [_dot([entry(M[i, j]) for j in range(d) if M[i, j] != 0], [v[j] for j in range(d) if M[i, j] != 0]) for i in range(d)]


def _slope_of_monomial(powers: Sequence[int], i: int, q: Sequence[Any]) -> Any:
    """∂/∂qᵢ of Π q^powers."""
    if not powers[i]:
        return 0.0
    value: Any = float(powers[i])
    for j, n in enumerate(powers):
        if n - (i == j):
            value = value * q[j] ** (n - (i == j))
    return value


class SplittingCode:
    """The compiled functions of splitting schemes on one autonomous symbolic system: see `LoopFunctions`.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
        Separable; its parameters are numbers of the table.
    level, monomials
        Of the kicks: see `sympflow.schemes.Scheme`.
    """

    def __init__(self, symbols: SymbolicHamiltonian, level: int, monomials: Monomials = ()) -> None:
        self._symbols, self._level, self._monomials = symbols, level, monomials
        self._numbers = ["a", *kicks_of(level, len(monomials))[0].numbers, *(s.name for s in symbols.parameters)]
        self._size = 2 * symbols.ndof
        self._functions: dict[tuple[str, int], Callable[..., None]] = {}
        self._tables: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        self._lock = threading.RLock()
        polynomial = symbols.V.is_polynomial(*symbols.q)
        self.width = 8 if polynomial else 16

    @cached_property
    def _kinds(self) -> list[_Kind]:
        """The kinds of kick, that with fewest numbers first."""
        if self._level == POLYNOMIAL:
            return [_kind(self._symbols, self._numbers[1 : 2 + len(self._monomials)], 1, self._monomials)]
        terms = 1 + {FORCE_GRADIENT: 1, CURVATURE: 2}.get(self._level, 0)
        return [_kind(self._symbols, ("b", "g", "c")[: k + 1], k + 1, ()) for k in range(terms)]

    @cached_property
    def _columns(self) -> int:
        """Numbers of a column that the code reads."""
        return max(kind.size for kind in self._kinds)

    def _stage(self, code: Code, values: list[Value], numbers: Numbers, kind: Value) -> list[Value]:
        """A kick and a drift, of the kind that a column has."""
        if len(self._kinds) == 1 or not kind.name.startswith("%"):
            only = self._kinds[0 if len(self._kinds) == 1 else int(kind.name)]
            return only.body(*values, *[numbers(i) for i in range(only.size)])
        results = [code.variable(x) for x in values]
        for k, each in enumerate(self._kinds):
            with code.given(code.apply("eq", (kind, k))):
                new = each.body(*values, *[numbers(i) for i in range(each.size)])
                for variable, x in zip(results, new, strict=True):
                    variable.value = x
        return [x.value for x in results]

    def _function(self, name: str, width: int) -> Callable[..., None]:
        found = self._functions.get((name, width))
        if found is None:
            with self._lock:
                if name == "map":
                    found = map_function(self._size, self._columns, self._stage, width)
                elif name == "step":
                    found = self._step_function(width, 0)
                else:
                    found = run_function(self._size, self._columns, self._stage, width, name == "run own")
                self._functions[name, width] = found
        return found

    def _step_function(self, width: int, own: int) -> Callable[..., None]:
        kick = kicks_of(self._level, len(self._monomials))[0]
        powers = [1, *kick.powers, *(0 for _ in self._symbols.parameters)]
        last = self._kinds[-1]
        return step_function(self._size, powers, own, last.table, self._stage, len(self._kinds) - 1, width)

    def _prepared(self, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The numbers (m, size) that the code reads, of a table (1 + n, m) of given ones, and the kinds (m,)."""
        key = table.tobytes()
        found = self._tables.get(key)
        if found is None:
            kinds = np.zeros(table.shape[1], dtype=np.int64)
            for k in range(1, len(self._kinds)):
                kinds[table[1 + k] != 0] = k
            entries = np.zeros((table.shape[1], self._columns))
            n = len(self._symbols.parameters)
            for k, kind in enumerate(self._kinds):
                own = table[: len(table) - n] if self._level == POLYNOMIAL else table[: 2 + k]
                given = [*own, *table[len(table) - n :]]
                for i, row in enumerate(kind.table(*given)):
                    entries[kinds == k, i] = np.broadcast_to(row, kinds.shape)[kinds == k]
            if len(self._tables) > 64:
                self._tables.clear()
            found = self._tables[key] = entries, kinds
        return found

    # the functions of `LoopFunctions` -----------------------------------------------------------------------------

    def rollout(
        self,
        table: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        closed: bool = True,
    ) -> int:
        """The steps from `first` to `n_steps` from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``."""
        finite = np.empty(1, dtype=np.int64)
        self._run(table, y0[None], n_steps, save, out[None], finite, stop, first, running[None], closed, 1)
        return int(finite[0])

    def rollout_batch(
        self,
        table: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        closed: bool = True,
    ) -> None:
        """`rollout` of every row of `y0` (N, 2d), in the lanes of registers."""
        width = self.width if len(y0) > 1 else 1
        self._run(table, y0, n_steps, save, out, n_finite, stop, first, running, closed, width)
        for i in np.flatnonzero(n_finite < n_steps) if width > 1 else ():
            n_finite[i] = self.rollout(table, y0[i], n_steps, save, out[i], stop, first, running[i], closed)

    def _run(
        self,
        table: np.ndarray,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        out: np.ndarray,
        n_finite: np.ndarray,
        stop: np.ndarray,
        first: int,
        running: np.ndarray,
        closed: bool,
        width: int,
    ) -> None:
        run = self._function("run", width)
        entries, kinds = self._prepared(table)
        keeps = int(running.shape[-1] > 0)
        begun = int(np.searchsorted(save, first, side="right")) if len(save) and save[0] <= first else 0
        if begun:
            out[:, :begun] = y0[:, None]
        states = running if first > 0 else y0
        later = save[begun:]
        target = out if not begun else np.empty((len(y0), len(later), self._size))
        run(
            entries.ctypes.data, kinds.ctypes.data, len(kinds) - 2, int(closed), states.ctypes.data, len(y0), first, n_steps,
            later.ctypes.data, len(later), target.ctypes.data, n_finite.ctypes.data, running.ctypes.data, keeps, stop.ctypes.data,
        )
        if begun:
            out[:, begun:] = target
        if width == 1:
            for i in np.flatnonzero(n_finite < n_steps):
                out[i, np.searchsorted(save, n_finite[i], side="right") :] = np.nan
                running[i] = np.nan

    def rollout_processed(self, before: np.ndarray, run: np.ndarray, after: np.ndarray, y0: np.ndarray, *rest: Any) -> int:
        """`rollout` in other coordinates: `before` into them, and `after`, which begins with the last stage, out."""
        n_steps, save, out, stop, first, running = rest
        finite = np.empty(1, dtype=np.int64)
        self.rollout_processed_batch(
            before, run, after, y0[None], n_steps, save, out[None], finite, stop, first, running[None]
        )
        return int(finite[0])

    def rollout_processed_batch(self, before: np.ndarray, run: np.ndarray, after: np.ndarray, y0: np.ndarray, *rest: Any) -> None:
        """The same of every row of `y0` (N, 2d)."""
        n_steps, save, out, n_finite, stop, first, running = rest
        start = self._mapped(before, y0, np.empty_like(y0)) if first == 0 else y0
        self.rollout_batch(run, start, n_steps, save, out, n_finite, stop, first, running, False)
        flat = out.reshape(-1, self._size)
        self._mapped(after, flat, flat)
        at_start = int(np.searchsorted(save, 0, side="right"))
        out[:, :at_start] = y0[:, None]
        good = np.isfinite(out).all(-1)
        for i in np.flatnonzero(~good.all(-1)):
            row = int(np.argmin(good[i]))
            if save[row] <= n_finite[i]:
                out[i, row:], n_finite[i] = np.nan, save[row] - 1

    def _mapped(self, table: np.ndarray, y: np.ndarray, out: np.ndarray) -> np.ndarray:
        entries, kinds = self._prepared(table)
        function = self._function("map", 1 if len(y) == 1 else self.width)
        function(entries.ctypes.data, kinds.ctypes.data, len(kinds), y.ctypes.data, len(y), out.ctypes.data)
        return out

    def step_rows(
        self, table: np.ndarray, x: np.ndarray, h: np.ndarray, t: np.ndarray, y: np.ndarray, out: np.ndarray
    ) -> None:
        """One step of length ``h[i]`` from every row of `y`, by numbers that are polynomials of ``x[i]``."""
        step = self._function("step", 1 if len(y) == 1 else self.width)
        table = np.ascontiguousarray(table)
        step(table.ctypes.data, table.shape[1], table.shape[2], x.ctypes.data, h.ctypes.data, y.ctypes.data, len(y), out.ctypes.data)
