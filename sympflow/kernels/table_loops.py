"""Compiled errors of a splitting step at labels, and their derivatives by the numbers of its table.

Labels are the lanes of registers. On the way a tape keeps the forces of each kick, their slope, and the velocities of
each drift; on the way back the cotangent of an error times the tape is its derivative by the numbers of a stage, one
way back for each error of a label. A driven system has the time as one more position, with its work as momentum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import INT, POINTER, Rows, Type, Value
from sympflow.compiler.functions import dot, fma, summed
from sympflow.compiler.machine import address
from sympflow.compiler.program import Program, fused, gradient, reached, tangent, traced
from sympflow.hamiltonian.formulas import TracedHamiltonian, evaluator
from sympflow.hamiltonian.friction import Friction
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.kernels.rollouts import aligned, filled
from sympflow.kernels.runs import begun, finished
from sympflow.lazy import kept
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

__all__ = ["LabelErrors", "TableLoops", "table_loops"]

MOST_OPERATIONS = 2000  # of a kick, beyond which compiling takes too long
LANES = 16
REGISTER = Type("double", LANES)
ROUNDING = 1e-14  # of rows that are in proportion
NONE = np.empty(0)
Form = SymbolicHamiltonian | TracedHamiltonian
BLOCKS = 2048  # of lanes, some milliseconds, between two looks at the clock


class TableLoops:
    """The compiled errors of labels for a system with T = ½ pᵀM⁻¹p, a sequence of `kicks` (True) and drifts.

    `drifts` are the indices of their numbers among those of all stages. Raises NotCompiled if there are none.
    """

    def __init__(
        self, symbols: Form, kicks: Sequence[bool], level: int, monomials: Monomials, friction: Friction
    ) -> None:
        self._given = symbols, tuple(kicks), level, monomials, friction
        form, d = symbols.parametric, symbols.ndof
        self.kicks, self.friction = np.array(kicks, dtype=np.int64), friction
        self.values = np.array([*form.values, 0.0], dtype=np.float64)
        self._driven = symbols.time is not None
        mass = symbols.inverse_mass
        assert mass is not None
        self._inverse_mass = np.array([[mass[i, j] for j in range(d)] for i in range(d)], dtype=np.float64)
        damping = tuple(tuple(map(float, row)) for row in friction.matrix(d)) if friction else None
        self.maps = _maps(form, level, monomials, damping)
        sizes = [self.maps.terms if kick else 1 for kick in kicks]
        self.drifts = (np.cumsum(sizes) - sizes)[self.kicks == 0]

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
            return y
        assert t0 is not None
        d = len(y) // 2
        return np.concatenate([y[:d], t0[None], y[d:], 0 * t0[None]])

    def motions(self, c: np.ndarray) -> np.ndarray:
        """The linear maps of the drifts in numbers c (J, n), with friction: (J, m, 2 d²), else none."""
        if not self.friction:
            return NONE
        M, s = self._inverse_mass, c[:, self.drifts]
        mean, end = (
            part if part.shape[1] == M.size else part.reshape(len(part), -1, 1) * np.eye(len(M))
            for part in self.friction.factors(s.ravel())
        )
        mean, end = mean.reshape(-1, *M.shape), end.reshape(-1, *M.shape)
        return np.stack([M @ mean, end], axis=1).reshape(*s.shape, -1)


class LabelErrors:
    """Weighted errors of labels after a step, and their derivatives by parameters on which its numbers depend affinely.

    States x (2d, N) start, of a driven system at times t0 (N,), and go to y (R, J N), times first: of a driven system
    with its work, or without. `scale` (R, J N) are weights of the errors of the first components, `slope` (R', J N)
    those of one more error, a sum over the components; `design` (J, n, f) the derivatives of the numbers, in the order
    of the stages, by the parameters. Errors are in the order of the label times, of the components, of the states.
    `matrices` (J, k, f) are the derivatives by the parameters, at each time, of k numbers to which all others are in
    proportion.
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
        self._loops, self._count, self._given = loops, x.shape[1], (x, t0, y, scale, slope, design)
        times = len(design)
        leaders, leader, factors = _in_proportion(design.swapaxes(0, 1).reshape(design.shape[1], -1))
        self.matrices = np.ascontiguousarray(design[:, leaders])
        used = np.flatnonzero(factors)
        used = used[np.argsort(leader[used], kind="stable")]
        given = [filled(loops.opened(x, t0), LANES), *(filled(a, LANES, times) for a in (y, scale, slope))]
        places = np.concatenate([np.searchsorted(leader[used], np.arange(len(leaders) + 1)), used])
        arrays = (*given, places, factors[used])
        self._arrays = [loops.kicks, loops.values, *map(np.ascontiguousarray, arrays)]
        n_errors, n, n_numbers = len(scale) + bool(len(slope)), given[0].shape[1], design.shape[1]
        self._shape = times, n_errors, n
        sizes = len(loops.kicks), len(loops.drifts), times, n, n_numbers, len(scale), len(slope), len(leaders)
        self._plan = np.array([*map(address, self._arrays), *sizes])

    def __reduce__(self) -> tuple[Any, ...]:
        return LabelErrors, (self._loops, *self._given)

    def __call__(
        self, c: np.ndarray, check: Callable[[], None] = lambda: None, linearized: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """The errors (m,) for numbers c (J, n), and if `linearized` their derivatives by the k numbers, (k, m).

        Those by the parameters are these, of each time, times its matrix.

        `check` is called now and then, and may raise.
        """
        loops, (times, _, n) = self._loops, self._shape
        r, J = np.empty(self._shape), np.empty((self.matrices.shape[1] if linearized else 0, *self._shape))
        maps = loops.maps
        memory, function = aligned(maps.memory(len(loops.kicks), c.shape[1])), maps.function(linearized)
        arrays = self._plan, np.ascontiguousarray(c), loops.motions(c), r, J, memory
        addresses, n_blocks = [address(a) for a in arrays], times * -(-n // LANES)
        for first in range(0, n_blocks, BLOCKS):
            check()
            function(*addresses, first, min(first + BLOCKS, n_blocks))
        errors, J = r[..., : self._count].ravel(), J[..., : self._count]
        return errors, np.ascontiguousarray(J).reshape(len(J), len(errors))


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
    symbols: Form, kicks: Sequence[bool], level: int, monomials: Monomials, friction: Friction
) -> TableLoops | None:
    """The loops; None of a system that has no compiled form, or one too long."""
    if symbols.samples:
        return None
    try:
        return TableLoops(symbols, kicks, level, monomials, friction)
    except NotCompiled:
        return None


class _Maps:
    """The kicks and drifts of a system, with what their derivatives need, and the functions that are made of them."""

    def __init__(
        self, form: Form, level: int, monomials: Monomials, friction: Sequence[Sequence[float]] | None
    ) -> None:
        assert form.inverse_mass is not None
        self.form, self.level, self.monomials, self.friction = form, level, monomials, friction
        self._mass = form.inverse_mass
        self.d, self.width = form.ndof, form.ndof + (form.time is not None)
        self.terms = 1 + (len(monomials) or level)
        self.pairs = list(combinations_with_replacement(range(self.width), 2))
        self.tape = max(self.terms * self.width + len(self.pairs), 2 * self.width)
        n_symbols = self.width + len(form.parameters)
        numbers = [f"x_{i}" for i in range(n_symbols)] + [f"c_{k}" for k in range(self.terms)]
        self.kick = fused(traced(self._kick, *numbers))
        _check_length(len(self.kick))

    def _kick(self, *numbers: Any) -> list[Any]:
        """The change of p, then the forces of each term, then the upper triangle of the slope of the change."""
        form, width = self.form, self.width
        q, c = numbers[:width], numbers[len(numbers) - self.terms :]
        times = () if form.time is None else (form.time,)
        of = evaluator(dict(zip((*form.q, *times, *form.parameters), numbers, strict=False)))
        slope = gradient(of(form.V), q)
        terms = [slope]
        if self.monomials:
            for powers in self.monomials:
                product = 1.0
                for x, n in zip(q, powers, strict=False):
                    product = product * x**n
                terms.append(gradient(product, q))
        elif self.level >= FORCE_GRADIENT:
            M = [[of(self._mass[i, j]) for j in range(self.d)] for i in range(self.d)]
            rest = [0.0] * (width - self.d)
            v = [*_product(M, slope), *rest]
            along = tangent(slope, q, v)
            terms.append([-x for x in along])
            if self.level >= CURVATURE:
                again = tangent(slope, q, [*_product(M, along), *rest])
                terms.append([0.5 * (x + y) for x, y in zip(tangent(along, q, v), again, strict=True)])
        forces = [[-x for x in term] for term in terms]
        changes = [dot(c, [force[i] for force in forces]) for i in range(width)]
        _check_length(len(reached(changes)))
        slopes = [gradient(change, q) for change in changes]
        return [*changes, *(x for force in forces for x in force), *(slopes[i][j] for i, j in self.pairs)]

    def mass(self, values: Sequence[Any]) -> list[list[Any]]:
        """M⁻¹ for values of the parameters."""
        of = evaluator(dict(zip(self.form.parameters, values, strict=True)))
        return [[of(self._mass[i, j]) for j in range(self.d)] for i in range(self.d)]

    def memory(self, n_stages: int, n_numbers: int) -> int:
        return LANES * (4 * self.width + n_numbers + n_stages * self.tape)

    @kept
    def function(self, linearized: bool) -> Callable[..., None]:
        """The compiled function: see `_Errors`."""
        return _Errors(self, linearized).compiled()


_maps = lru_cache(maxsize=64)(_Maps)


def _check_length(n: int) -> None:
    if n > MOST_OPERATIONS:
        raise NotCompiled(f"`system` has a kick of {n} operations.")


def _product(A: Sequence[Sequence[Any]], x: Sequence[Any]) -> list[Any]:
    return [dot(row, x) for row in A]


class _Errors:
    """The function of the errors r of labels, and of their derivatives J.

    Its arguments are the addresses of

    - a plan: the addresses of the kinds of stages (S,), 1 for a kick, and of the values of parameters; of the states X
      (2D, N) at the start, of a driven system with t and a work of 0; of the labels Y and the weights of their errors
      (R, J N), and those of one more (R', J N), a sum over components; of the derivatives of numbers by parameters that
      are not 0 where those of each parameter begin (k + 1,), then the numbers (m,), and of their values (m,); then S,
      the number of drifts, J, N, n, R, R', k;
    - the numbers c (J, n) at each time, and with friction the motions (J, drifts, 2 d²) of drifts;
    - r (J, errors, N), J (k, J, errors, N), and memory;

    then the first and the last block of labels.
    """

    def __init__(self, maps: _Maps, linearized: bool) -> None:
        self.maps, self.linearized = maps, linearized
        self.code = code = begun("errors", [*[POINTER] * 6, INT, INT])
        plan, self.c, self.motions, self.r, self.J, memory, self.first, self.last = code.arguments
        (
            self.kinds, self.values, self.X, self.Y, self.scale, self.slope, self.places, self.design,
        ) = (code.load(plan, i, POINTER) for i in range(8))  # fmt: skip
        (
            self.n_stages, self.n_drifts, self.n_times, self.n_states, self.n_numbers, self.n_rows, self.n_slopes,
            self.n_parameters,
        ) = (code.load(plan, i, INT) for i in range(8, 16))  # fmt: skip
        w = maps.width
        self.W, self.A, self.B = (Rows(code.at(memory, i * w * LANES), REGISTER) for i in (0, 2, 4))
        self.tape = self.B.part(self.n_numbers)
        self.zero = code.constant(0.0, REGISTER)

    def compiled(self) -> Callable[..., None]:
        code, n = self.code, self.n_states
        integer = code.constant(LANES, INT)
        per_time = code.op("sdiv", INT, n + (LANES - 1), integer)
        n_errors = self.n_rows + code.apply("min", (self.n_slopes, code.constant(1, INT)))
        self.parameters = [code.splat(code.load(self.values, i), LANES) for i in range(len(self.maps.form.parameters))]
        self.mass = self.maps.mass(self.parameters)
        with code.over(self.last - self.first) as k:
            block = self.first + k
            j = code.op("sdiv", INT, block, per_time)
            start = code.apply("min", ((block - j * per_time) * LANES, n - LANES))
            self.label, self.n_labels = j * n + start, self.n_times * n
            self.numbers, self.time = code.at(self.c, j * self.n_numbers), j
            with code.over(2 * self.maps.width) as i:
                self.W[i] = code.load(self.X, i * n + start, REGISTER)
            with self.stages() as (kick, number, drift, tape):
                with code.given(kick):
                    self.kicked(number, tape)
                with code.given(~kick):
                    self.drifted(number, drift, tape)
            with code.over(self.n_rows) as row:
                error = self.error(row) * self.weight(self.scale, row)
                code.store(error, self.r, (j * n_errors + row) * n + start)
            with code.over(n_errors - self.n_rows):
                total = code.variable(self.zero)
                with code.over(self.n_slopes) as m:
                    total.value = fma(self.error(m), self.weight(self.slope, m), total.value)
                code.store(total.value, self.r, (j * n_errors + self.n_rows) * n + start)
            if self.linearized:
                with code.over(n_errors) as row:
                    self.back(row)
                    self.derivatives((j * n_errors + row) * n + start, self.n_times * n_errors * n)
        return finished(code)

    @contextmanager
    def stages(self, back: bool = False) -> Iterator[tuple[Value, Value, Value, Rows]]:
        """Each stage: whether it is a kick, where its numbers begin, which drift it is, its tape."""
        code, terms = self.code, self.maps.terms
        none = code.constant(0, INT)
        number, drift = (code.variable(x if back else none) for x in (self.n_numbers, self.n_drifts))
        with code.over(self.n_stages) as k:
            s = self.n_stages - 1 - k if back else k
            kick = code.apply("eq", (code.load(self.kinds, s, INT), 1))
            size = code.select(kick, code.constant(terms, INT), code.constant(1, INT))
            one = code.select(kick, none, code.constant(1, INT))
            if back:
                number.value, drift.value = number.value - size, drift.value - one
            yield kick, number.value, drift.value, self.tape.part(s * self.maps.tape)
            if not back:
                number.value, drift.value = number.value + size, drift.value + one

    def number(self, i: Value) -> Value:
        return self.code.splat(self.code.load(self.numbers, i), LANES)

    def weight(self, array: Value, row: Value) -> Value:
        """The numbers of a row (…, J N) for the labels of this block."""
        return self.code.load(array, row * self.n_labels + self.label, REGISTER)

    def place(self, row: Value) -> Value:
        """The place of a row of labels in a state: positions, momenta, the work."""
        d, w = self.maps.d, self.maps.width
        return row if d == w else self.code.select(row < d, row, row + (w - d))

    def error(self, row: Value) -> Value:
        return self.W[self.place(row)] - self.weight(self.Y, row)

    # the way there ----------------------------------------------------------------------------------------------------

    def kicked(self, number: Value, tape: Rows) -> None:
        maps, w = self.maps, self.maps.width
        program = maps.kick if self.linearized else Program(maps.kick.inputs, maps.kick.outputs[:w])
        c = [self.number(number + k) for k in range(maps.terms)]
        changes = program(*(self.W[i] for i in range(w)), *self.parameters, *c)
        for i, x in enumerate(changes[w:]):
            tape[i] = x
        for i, x in enumerate(changes[:w]):
            self.W[w + i] = self.W[w + i] + x

    def drifted(self, number: Value, drift: Value, tape: Rows) -> None:
        """The tape holds M⁻¹p and −Γp at the end."""
        d, w, friction = self.maps.d, self.maps.width, self.maps.friction
        a, y = self.number(number), [self.W[w + i] for i in range(d)]
        moves = None
        if friction is not None:
            mean, end = self.motion(drift)
            moves, y = _product(mean, y), _product(end, y)
            for i, x in enumerate(_product(friction, y)):
                self.W[w + i] = y[i]
                if self.linearized:
                    tape[w + i] = -x
        velocity = [*_product(self.mass, y), *[self.code.constant(1.0, REGISTER)] * (w - d)]  # of the time: 1
        for i, v in enumerate(velocity):
            if self.linearized:
                tape[i] = v
            self.W[i] = self.W[i] + moves[i] if moves is not None and i < d else fma(a, v, self.W[i])

    def motion(self, drift: Value) -> list[list[list[Value]]]:
        """The linear maps of a drift with friction, from p to what it adds to q, and to p."""
        d, code = self.maps.d, self.code
        start = (self.time * self.n_drifts + drift) * (2 * d * d)
        entry = [code.splat(code.load(self.motions, start + k), LANES) for k in range(2 * d * d)]
        return [[entry[part + i * d :][:d] for i in range(d)] for part in (0, d * d)]

    # the way back -----------------------------------------------------------------------------------------------------

    def back(self, row: Value) -> None:
        """The derivatives of an error by the numbers of all stages, into B."""
        code, w = self.code, self.maps.width
        for i in range(2 * w):
            self.A[i] = self.zero
        single = row < self.n_rows
        with code.given(single):
            self.A[self.place(row)] = self.weight(self.scale, row)
        with code.given(~single), code.over(self.n_slopes) as k:
            self.A[self.place(k)] = self.weight(self.slope, k)
        with self.stages(back=True) as (kick, number, drift, tape):
            with code.given(kick):
                self.kick_back(number, tape)
            with code.given(~kick):
                self.drift_back(number, drift, tape)

    def kick_back(self, number: Value, tape: Rows) -> None:
        w, terms = self.maps.width, self.maps.terms
        b = [self.A[w + i] for i in range(w)]
        for k in range(terms):
            self.B[number + k] = summed(0.0, b, [tape[k * w + i] for i in range(w)])
        slope = {ij: tape[terms * w + n] for n, ij in enumerate(self.maps.pairs)}
        for i in range(w):
            self.A[i] = summed(self.A[i], b, [slope[min(i, j), max(i, j)] for j in range(w)])

    def drift_back(self, number: Value, drift: Value, tape: Rows) -> None:
        d, w = self.maps.d, self.maps.width
        a = [self.A[i] for i in range(w)]
        by_time = summed(0.0, a, [tape[i] for i in range(w)])
        if self.maps.friction is None:
            time = self.number(number)
            for j, x in enumerate(_product([list(column) for column in zip(*self.mass, strict=True)], a)):
                self.A[w + j] = fma(time, x, self.A[w + j])
        else:
            b = [self.A[w + i] for i in range(d)]
            by_time = summed(by_time, b, [tape[w + i] for i in range(d)])
            mean, end = self.motion(drift)
            for j in range(d):
                change = summed(0.0, [row[j] for row in mean], a)
                self.A[w + j] = summed(change, [row[j] for row in end], b)
        self.B[number] = by_time

    def derivatives(self, place: Value, stride: Value) -> None:
        """The derivatives by the parameters, into J."""
        code = self.code
        with code.over(self.n_parameters) as f:
            begin, end = (code.load(self.places, f + i, INT) for i in range(2))
            total = code.variable(self.zero)
            with code.over(end - begin) as k:
                number = code.load(self.places, self.n_parameters + 1 + begin + k, INT)
                total.value = fma(code.splat(code.load(self.design, begin + k), LANES), self.B[number], total.value)
            code.store(total.value, self.J, f * stride + place)
