"""Kicks and drifts of states in memory: of many terms, by a loop over those of each kind, or by functions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.compiler.arrange import Arranged
from sympflow.compiler.control import INT, POINTER, Rows, Value
from sympflow.compiler.functions import added, fma
from sympflow.compiler.program import gradient, traced
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.quantities import Variable
from sympflow.kernels.rollouts import SplittingRollouts
from sympflow.kernels.runs import Room
from sympflow.kernels.splittings import Splitting, SplittingCode

if TYPE_CHECKING:
    from sympflow.kernels.terms import Terms

__all__ = ["ARRAYS", "ArrayCode", "Forces", "FunctionSplitting", "function_code", "term_code"]

ARRAYS = 4  # of d numbers that a kick needs: slopes, velocities, products with the Hessian, curvatures


class Forces(ABC):
    """Derivatives of V and T as code, which reads arrays `data`: the inverse mass (d,) or (d, d), if any, last."""

    lanes = 1
    data: list[np.ndarray]

    def __init__(self, inverse_mass: np.ndarray | None) -> None:
        self._mass = inverse_mass

    @abstractmethod
    def sum(
        self, order: int, room: Room, given: Sequence[Rows], out: Rows, d: Value, coefficients: Sequence[Any]
    ) -> None:
        """∇V(q), ∇²V(q) v and ½ ∇³V(q)(v, v) of places q and v in memory, by the order 0, 1, 2, into another one."""

    def velocity(self, room: Room, p: Rows, out: Rows, d: Value, coefficients: Sequence[Any]) -> None:
        """∇T(p)."""
        code, M = room.code, self._mass
        masses = None if M is None else room.data(len(self.data) - 1)
        with code.over(d) as i:
            if masses is None or M is None:
                out[i] = p[i]
            elif M.ndim == 1:
                out[i] = p[i] * code.load(masses, i)
            else:
                out[i] = 0.0
                with code.over(d) as j:
                    out[i] = out[i] + code.load(masses, i * d + j) * p[j]


class TermForces(Forces):
    """Forces by loops over the terms of each kind, those of T too where it is no ½ pᵀM⁻¹p."""

    lanes = 8

    def __init__(self, V: Terms, T: Terms | np.ndarray | None) -> None:
        super().__init__(T if isinstance(T, np.ndarray) else None)
        self._V, self._T = V, T
        self.data = [*V.data, *([] if T is None else [T] if isinstance(T, np.ndarray) else T.data)]

    def sum(
        self, order: int, room: Room, given: Sequence[Rows], out: Rows, d: Value, coefficients: Sequence[Any]
    ) -> None:
        self._add(self._V, 0, order, room, given, out, d, coefficients)

    def velocity(self, room: Room, p: Rows, out: Rows, d: Value, coefficients: Sequence[Any]) -> None:
        if self._T is None or isinstance(self._T, np.ndarray):
            super().velocity(room, p, out, d, coefficients)
        else:
            self._add(self._T, len(self._V.data), 0, room, [p], out, d, coefficients)

    def _add(
        self,
        terms: Terms,
        first: int,
        order: int,
        room: Room,
        given: Any,
        out: Rows,
        d: Value,
        coefficients: Sequence[Any],
    ) -> None:
        """Write derivatives of terms, whose arrays are those from the `first` on, into another place in memory."""
        with room.code.over(d) as i:
            out[i] = 0.0
        data = [room.data(first + k) for k in range(len(terms.data))]
        terms.add(data, terms.derivatives(order), given, coefficients, lambda places: [(out, i) for i in places])


class Functions(Forces):
    """Forces by a user's Numba functions, called at their addresses, of a driven system with the time first."""

    def __init__(
        self, gradient: Any, hessian_vector: Any | None, inverse_mass: np.ndarray | None, driven: bool
    ) -> None:
        super().__init__(inverse_mass)
        self._given = gradient, hessian_vector, inverse_mass, driven
        self._functions = [addressed(gradient, False, driven)]
        if hessian_vector is not None:
            self._functions.append(addressed(hessian_vector, True, driven))
        addresses = np.array([f.address for f in self._functions], dtype=np.int64)
        self.data = [addresses, *([] if inverse_mass is None else [np.ascontiguousarray(inverse_mass)])]

    def __reduce__(self) -> tuple[Any, ...]:
        return Functions, self._given

    def sum(
        self, order: int, room: Room, given: Sequence[Rows], out: Rows, d: Value, coefficients: Sequence[Any]
    ) -> None:
        code = room.code
        with code.over(d) as i:
            out[i] = float("nan")  # what a function does not write ends the run
        address = code.load(room.data(0), order, POINTER)
        time = coefficients[0] if coefficients else code.constant(0.0)
        code.call(address.name, [time, given[0].place, given[-1].place, out.place, d])


def term_code(splitting: Splitting) -> ArrayCode:
    """The compiled functions of a symbolic system of many terms."""
    from sympflow.kernels.terms import Terms

    symbols: Any = splitting.symbols
    M = symbols.inverse_mass
    T: Terms | np.ndarray | None = None
    if M is None or not M.is_diagonal() or M.free_symbols:
        T = Terms(symbols.T, symbols.p, symbols.parameters).check()
    elif any(x != 1 for x in M.diagonal()):
        T = np.array([float(x) for x in M.diagonal()])
    return ArrayCode(splitting, TermForces(Terms(symbols.V, symbols.q, symbols.parameters).check(), T))


def function_code(
    ndof: int,
    gradient: Any,
    hessian_vector: Any | None,
    inverse_mass: np.ndarray | None,
    driven: bool,
    friction: int | None,
    level: int,
    compensated: bool,
    monomials: Monomials,
) -> ArrayCode:
    """The compiled functions of a system that is given by Numba functions, of so many degrees of freedom."""
    forces = Functions(gradient, hessian_vector if level else None, inverse_mass, driven)
    return ArrayCode(FunctionSplitting(level, monomials, compensated, friction, ndof=ndof, timed=driven), forces)


@dataclass(frozen=True)
class FunctionSplitting(Splitting):
    """The kicks and drifts of a system by functions, which has no symbols: of a driven one the letter is the time."""

    symbols: Any = field(default=None, init=False)
    ndof: int = 1
    timed: bool = False
    own = 0

    @property
    def parameters(self) -> Sequence[Any]:
        return [Variable("time")] if self.timed else []

    def values_at(self, time: Any, length: Any, fixed: Sequence[Any]) -> list[Any]:
        return [time]


def addressed(function: Any, along: bool, timed: bool) -> Any:
    """A Numba function of arrays as one that C can call, with t, places q, v, out and their length.

    An exception of the function makes its result NaN. `along` is true of one that takes v, `timed` of one that takes t.
    """
    from numba import carray, cfunc, njit, types

    calls = {
        (False, False): lambda t, q, v, out: function(q, out),
        (True, False): lambda t, q, v, out: function(q, v, out),
        (False, True): lambda t, q, v, out: function(t, q, out),
    }
    call = function if along and timed else njit(calls[along, timed])
    place = types.CPointer(types.float64)

    @cfunc(types.void(types.float64, place, place, place, types.int64))
    def called(t, q, v, out, n):  # type: ignore[no-untyped-def]
        try:
            call(t, carray(q, (n,)), carray(v, (n,)), carray(out, (n,)))
        except Exception:
            out[0] = np.nan

    return called


class ArrayCode(SplittingCode):
    """The compiled functions of splitting schemes of states in memory; see `Splitting` and `Forces`."""

    def __init__(self, splitting: Splitting, forces: Forces) -> None:
        super().__init__(splitting, chunked=False)
        self._given = splitting, forces
        self._forces, self.data, self.lanes = forces, forces.data, forces.lanes
        self.room = ARRAYS * splitting.ndof

    @cached_property
    def _kinds(self) -> list[Arranged]:
        """Stages whose numbers are those that are given."""
        names = self._splitting.numbers
        same = traced(lambda *x: x, *names)
        return [Arranged(same, same) for _ in self._splitting.terms]

    def check_reverse(self) -> None:
        SplittingRollouts.check_reverse(self)

    def _executed(self, k: int, room: Room, column: Sequence[Any]) -> None:
        self.kicked(room, self._splitting.terms[k], column)
        self.drifted(room, column)

    def kicked(self, room: Room, terms: int, given: Sequence[Any]) -> None:
        """Write a kick of so many terms, by the numbers of a column."""
        splitting, code, forces = self._splitting, room.code, self._forces
        d, kicks = self._ndof(room), given[1 : 1 + len(splitting.kick_numbers)]
        coefficients = self._coefficients(given)
        q, p = room, room.part(d)
        slope, velocity, product, third = (room.work.part(d * i) for i in range(ARRAYS))
        forces.sum(0, room, [q], slope, d, coefficients)
        factors = [(-kicks[0], slope)]
        if terms > 1:
            forces.velocity(room, slope, velocity, d, coefficients)
            forces.sum(1, room, [q, velocity], product, d, coefficients)
            factors.append((kicks[1], product))
        if terms > 2:
            forces.sum(2, room, [q, velocity], third, d, coefficients)
            with code.over(d) as i:
                curvature = kicks[2] * third[i]
                change = fma(kicks[1], product[i], -(kicks[0] * slope[i]))
                slope[i] = change - curvature
            forces.velocity(room, product, velocity, d, coefficients)
            forces.sum(1, room, [q, velocity], product, d, coefficients)
            factors = [(1.0, slope), (-kicks[2], product)]
        if splitting.monomials:
            self._store_polynomial(room, velocity, kicks)
            factors.append((-1.0, velocity))
        with code.over(d) as i:
            changes = [(factor, vector[i]) for factor, vector in factors]
            self._move(room, p, i, changes, 3)

    def _store_polynomial(self, room: Room, out: Rows, kicks: Sequence[Any]) -> None:
        """Σ e ∇q^m."""
        splitting, d = self._splitting, self._splitting.ndof

        def slopes(*numbers: Any) -> list[Any]:
            total: Any = 0.0
            for e, powers in zip(numbers[d:], splitting.monomials, strict=True):
                monomial = e
                for x, n in zip(numbers[:d], powers, strict=True):
                    monomial = monomial * x**n
                total = total + monomial
            return gradient(total, numbers[:d])

        names = [*(s.name for s in splitting.symbols.q), *splitting.kick_numbers[1:]]
        for i, x in enumerate(traced(slopes, *names)(*(room[i] for i in range(d)), *kicks[1:])):
            out[i] = x

    def drifted(self, room: Room, given: Sequence[Any]) -> None:
        """Write a drift."""
        splitting, code, forces = self._splitting, room.code, self._forces
        d, a = self._ndof(room), given[0]
        q, p = room, room.part(d)
        spread, velocity = (room.work.part(d * i) for i in range(2))
        moved: Rows = p
        if splitting.friction is not None:
            n = splitting.ndof**splitting.friction
            first = 1 + len(splitting.kick_numbers)
            mean, decay = given[first : first + n], given[first + n : first + 2 * n]
            for i, k in self._each(room, d, n):
                spread[i], p[i] = mean[k] * p[i], decay[k] * p[i]
            moved, a = spread, 1.0
        forces.velocity(room, moved, velocity, d, self._coefficients(given))
        with code.over(d) as i:
            self._move(room, q, i, [(a, velocity[i])], 2)

    def _each(self, room: Room, d: Value, n: int) -> Iterator[tuple[Any, int]]:
        """Each degree of freedom with the place of its rate; a loop where there is one rate."""
        if n > 1:
            yield from ((i, i) for i in range(n))
            return
        with room.code.over(d) as i:
            yield i, 0

    def _move(self, room: Room, x: Rows, i: Value, changes: Sequence[tuple[Any, Value]], errors: int) -> None:
        """Number i of x and Σ factor·change; by Kahan's compensated sum where there are errors, d numbers each."""
        total = old = x[i]
        if not self._splitting.compensated:
            for factor, change in changes:
                total = fma(factor, change, total)
            x[i] = total
            return
        left = room.part(self._ndof(room) * errors)
        corrected = -left[i]
        for factor, change in changes:
            corrected = fma(factor, change, corrected)
        x[i], left[i] = added(old, corrected)

    def _coefficients(self, given: Sequence[Any]) -> Sequence[Any]:
        return given[len(given) - len(self._splitting.parameters) :]

    def _ndof(self, room: Room) -> Value:
        return room.code.op("sdiv", INT, room.size, room.code.constant(2 * (1 + self._splitting.compensated), INT))
