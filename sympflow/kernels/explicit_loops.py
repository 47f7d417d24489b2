"""Compiled explicit Runge–Kutta steps, and the compiled vector field of a symbolic system for solvers of others."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import DOUBLE, POINTER, Rows, Value
from sympflow.compiler.program import Program, gradient
from sympflow.hamiltonian.formulas import recorded
from sympflow.hamiltonian.quantities import Variable
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.one_steps import (
    OneStep,
    OneStepKernel,
    is_large,
    lettered,
    parametric,
    shared_code,
    spelled,
    terms_of,
)
from sympflow.kernels.runs import Numbers, Room, begun, finished
from sympflow.lazy import kept

__all__ = ["CompiledField", "compiled_field", "explicit_kernel"]

MOST_REVERSED = 500  # operations of a step whose reverse is compiled


class Tableau(Protocol):
    """Stages K_i = f(t + c_i h, y + h Σ_j A_ij K_j) and the step y + h Σ_i B_i K_i."""

    A: Any
    B: Any


@kept
def explicit_kernel(system: HamiltonianSystem, tableau: Tableau, names: tuple[str, ...] = ()) -> OneStepKernel:
    """The compiled loops of a method, with parameters of these names as numbers of columns, or a NotCompiled."""
    field = field_of(system, names)
    kind = _InMemory if field.large else _InRegisters
    A = tuple(tuple(map(float, row)) for row in tableau.A)
    B = tuple(map(float, tableau.B))
    form = field.lettered.symbols
    plain = not (field.data or field.rates or len(field.lettered.expressions) > 1)
    code = shared_code(form, (A, B), lambda: kind(field, A, B)) if plain else kind(field, A, B)
    return OneStepKernel(code, code, form.values, field.more)


def compiled_field(system: HamiltonianSystem) -> CompiledField:
    """The vector field of a symbolic system, compiled, for one solver; a ValueError says why there is none."""
    return CompiledField(field_of(system))


class Field:
    """J∇H less Γp plus a force by symbols, as code; if `large` by loops over terms, which read `data`, then Γ."""

    def __init__(self, system: HamiltonianSystem, names: tuple[str, ...] = ()) -> None:
        force = system.external_force
        symbols = spelled(system, names) if force is None else system.symbols
        forces = () if force is None else force.expressions
        if force is not None and not (forces and symbols):
            raise NotCompiled("`system` has a force by a function, which is not compiled: use backend='array'.")
        assert symbols is not None
        self.large = is_large(symbols) and force is None
        if force is not None and names:
            raise NotCompiled("`system` has a force that does not derive from H.")
        symbols = parametric(symbols, names)
        self.lettered = lettered(symbols, [symbols.H, *forces])
        self.ndof = system.ndof
        self._damping = system.friction.matrix(self.ndof) if system.friction else None
        self.rates = [] if self._damping is None else self._damping[self._damped].tolist()
        self._terms = terms_of(self.lettered) if self.large else None
        self.data = [] if self._terms is None else [*self._terms.data]
        if self._damping is not None:
            self.data.append(np.ascontiguousarray(self._damping))

    @property
    def _damped(self) -> Any:
        """The entries of Γ that are numbers of a column."""
        assert self._damping is not None
        return np.nonzero(np.zeros_like(self._damping) if self.large else self._damping)

    def more(self, h: np.ndarray) -> np.ndarray:
        """The numbers of Γ in the columns of steps."""
        return np.broadcast_to(np.array(self.rates), (len(h), len(self.rates)))

    @cached_property
    def program(self) -> Program:
        """f, from q, p, the parameters, the coefficients and the numbers of Γ."""
        symbols, d, n = self.lettered.symbols, self.ndof, 2 * self.ndof
        rates = [Variable(f"rate_{i}") for i in range(len(self.rates))]
        inputs = (*symbols.q, *symbols.p, *self.lettered.given, *rates)
        found = recorded([*self.lettered.expressions, *rates], inputs)
        slope = gradient(found.outputs[0], found.inputs[:n])
        more = found.outputs[1 : len(self.lettered.expressions)] or [0.0] * d
        forces = [-x + F for x, F in zip(slope[:d], more, strict=True)]
        if rates:
            for i, j, rate in zip(*self._damped, found.inputs[len(inputs) - len(rates) :], strict=True):
                forces[i] = forces[i] - rate * found.inputs[d + j]
        return Program(found.inputs, [*slope[d:], *forces])

    @cached_property
    def function(self) -> Callable[..., None]:
        """f compiled: of addresses (y, out, time, numbers, room, data)."""
        code, lettered = begun("field_at", [POINTER] * 6), self.lettered
        y, out, time, numbers, room, data = code.arguments
        k, n = len(lettered.symbols.parameters), 2 * self.ndof
        given = [code.load(numbers, i) for i in range(k)]
        if lettered.time_coefficients:
            given += lettered.at(code.load(time), given)
        if self.large:
            coefficients = code.at(room, n)
            for i, x in enumerate(given):
                code.store(code.operand(x, DOUBLE), coefficients, i)
            arrays = [code.load(data, i, POINTER) for i in range(len(self.data))]
            code.outlined("field", [y, out, room, coefficients, *arrays], self.fill, rare=False)
        else:
            rates = [code.load(numbers, k + i) for i in range(len(self.rates))]
            for i, x in enumerate(self.program(*(code.load(y, i) for i in range(n)), *given, *rates)):
                code.store(code.operand(x, DOUBLE), out, i)
        return finished(code)

    def fill(self, y: Value, out: Value, g: Value, coefficients: Value, *data: Value) -> None:
        """f(y) into `out` by loops over the terms of each kind; `g` is room for ∇H."""
        code, d, n = y.code, self.ndof, 2 * self.ndof
        given = [code.load(coefficients, k) for k in range(len(self.lettered.given))]
        with code.over(n) as m:
            code.store(code.constant(0.0), g, m)
        slope = Rows(g, DOUBLE)
        assert self._terms is not None
        slopes = self._terms.derivatives(0)
        self._terms.add(data, slopes, [Rows(y, DOUBLE)], given, lambda places: [(slope, m) for m in places])
        with code.over(d) as m:
            code.store(code.load(g, m + d), out, m)
            force = -code.load(g, m)
            if self._damping is not None:
                moved = code.variable(force)
                with code.over(d) as j:
                    moved.value = moved.value - code.load(data[-1], m * d + j) * code.load(y, j + d)
                force = moved.value
            code.store(force, out, m + d)


field_of = kept(Field)


class _Explicit(OneStep):
    """Steps of an explicit Runge–Kutta method."""

    def __init__(self, field: Field, A: tuple[tuple[float, ...], ...], B: tuple[float, ...]) -> None:
        super().__init__(field.lettered, 2 * field.ndof, len(field.rates))
        self._given = field, A, B
        self.field, self.A, self.B = field, A[: len(B)], B
        self.work = 4.0 * len(B) * field.ndof


class _InRegisters(_Explicit):
    """Steps with every number in a register."""

    lanes = 8

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        code, type = step.code, values[0].type
        column, whole = [numbers(i) for i in range(self.size)], code.convert("sitofp", step, "double")
        return [code.operand(x, type) for x in self.plain(0, values, column, whole)]

    def plain(self, kind: int, state: Sequence[Any], column: Sequence[Any], step: Any) -> Sequence[Any]:
        column = self.begun(column, step)
        given, rates = column[1 : 1 + self.parameters], column[self.size - len(self.field.rates) :]
        K: list[list[Any]] = []
        for row in self.A:
            coefficients = self.coefficients_at(column, sum(row))
            K.append(self.field.program(*_moved(state, column[0], row, K), *given, *coefficients, *rates))
        return _moved(state, column[0], self.B, K)

    @property
    def reversible(self) -> bool:  # type: ignore[override]
        return len(self.field.program) * len(self.A) <= MOST_REVERSED


class _InMemory(_Explicit):
    """Steps in memory, of a large system."""

    lanes = 1

    def __init__(self, field: Field, A: tuple[tuple[float, ...], ...], B: tuple[float, ...]) -> None:
        super().__init__(field, A, B)
        self.room = self.n_out * (len(B) + 2) + len(self.lettered.given)
        self.data = field.data

    def stage(self, room: Room, numbers: Numbers, kind: Value, step: Value) -> None:  # type: ignore[override]
        code, n, s = room.code, self.n_out, len(self.B)
        column = self.column(code, numbers, step)
        *K, Y, g, coefficients = (room.work.part(n * i) for i in range(s + 3))
        data = [room.data(i) for i in range(len(self.data))]
        for i, row in enumerate(self.A):
            for k, x in enumerate([*column[1 : 1 + self.parameters], *self.coefficients_at(column, sum(row))]):
                coefficients[k] = x
            self._move(room, Y, column[0], row, K)
            places = [x.place for x in (Y, K[i], g, coefficients)]
            code.outlined("field", [*places, *data], self.field.fill, rare=False)
        self._move(room, room, column[0], self.B, K)

    def _move(self, room: Room, to: Rows, h: Value, weights: Sequence[float], K: Sequence[Rows]) -> None:
        with room.code.over(self.n_out) as m:
            (to[m],) = _moved([room[m]], h, weights, [[k[m]] for k in K[: len(weights)]])


def _moved(y: Sequence[Any], h: Any, weights: Sequence[float], K: Sequence[Sequence[Any]]) -> list[Any]:
    """y + h Σ weights_i K_i."""
    moved = []
    for m, x in enumerate(y):
        total: Any = None
        for w, k in zip(weights, K, strict=False):
            if w:
                total = w * k[m] if total is None else total + w * k[m]
        moved.append(x if total is None else x + h * total)
    return moved


class CompiledField:
    """The vector field y' = f(t, y) of one state, to be called as ``field(t, y)``, by one thread at a time."""

    def __init__(self, field: Field) -> None:
        self._field, n = field, 2 * field.ndof
        symbols = field.lettered.symbols
        self._y, self._out, self._time = np.empty(n), np.empty(n), np.zeros(1)
        self._numbers = np.array([*symbols.values, *field.rates])
        self._room = np.empty(n + len(field.lettered.given))
        self._data = np.array([x.ctypes.data for x in field.data], dtype=np.int64)
        arrays = self._y, self._out, self._time, self._numbers, self._room, self._data
        self._places = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
        self._function = field.function

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self._y[:] = y
        self._time[0] = t
        self._function(*self._places)
        return self._out.copy()
