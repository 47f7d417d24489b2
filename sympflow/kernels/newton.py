"""Newton's iteration of implicit Gauss methods over traced numbers, with the gradient and Hessian of a symbolic H.

The unknowns are K_i = h scale_i f(y + Σ_j A_ij K_j), in which the coefficients are exact where it matters for the long
run, and y + Σ B_i K_i needs no further evaluation of f. With friction they are those of q and P = e^{γτ}p, τ from the
beginning of the step. A few unknowns are eliminated in registers, more of them in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise
from operator import mul
from types import SimpleNamespace
from typing import Any

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import BOOL, DOUBLE, INT, Code, Rows, Type, Value, assign
from sympflow.compiler.functions import added, fma, is_zero, where
from sympflow.compiler.program import Program, gradient, traced
from sympflow.hamiltonian.collocation import MOST_ITERATIONS, Tableau, stage_nodes
from sympflow.hamiltonian.formulas import recorded
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.one_steps import (
    Lettered,
    OneStep,
    OneStepKernel,
    is_large,
    parametric,
    shared_code,
    spelled,
    terms_of,
)
from sympflow.kernels.one_steps import lettered as with_coefficients
from sympflow.kernels.rollouts import Rollouts
from sympflow.kernels.runs import Numbers, Room, Values
from sympflow.lazy import kept

__all__ = ["implicit_kernel", "newton_code"]

TOLERANCE = 1e-11  # of a relative increment: convergence is quadratic, so what is left is below rounding
ROUNDING = 1e-9  # increments below this that no longer shrink are rounding
SMALLEST = 1e-150  # of a size whose reciprocal is multiplied by other numbers
MOST_IN_REGISTERS = 4  # unknowns
ABREAST = 4  # numbers of a row of a matrix that are changed together
MOST_REVERSED = 40  # numbers of a state whose cotangents are in registers
LONG = 4e6  # operations between two looks for a stop

Cells = Any
"""Numbers by their places: a list, or `Rows` in memory."""


@kept
def implicit_kernel(
    system: HamiltonianSystem, tableau: Tableau, compensated: bool = False, names: tuple[str, ...] = ()
) -> OneStepKernel:
    """The compiled loops of a method, with parameters of these names as numbers of columns, or a NotCompiled."""
    written = spelled(system, names)
    if written is None:
        raise NotCompiled(
            "`system` cannot be compiled: its Hessian is not symbolic. Use HamiltonianSystem.from_sympy, "
            "or use backend='array'."
        )
    friction = system.friction
    friction.check_sums(compensated)
    if friction.kind == 2:
        raise NotCompiled("`damping` is a matrix, whose decay is not compiled here: use backend='array'.")
    if names and written.time is not None:
        raise NotCompiled("`system` depends on t: use a splitting method.")
    symbols = parametric(written, names)
    of_time = with_coefficients(symbols, [symbols.H])

    def made(*kind: bool) -> NewtonCode:
        return shared_code(symbols, (tableau, kind), lambda: newton_code(of_time, tableau, *kind))

    code = made(compensated, bool(friction))
    single = made(False, False) if compensated else code
    if not friction:
        return OneStepKernel(code, single, symbols.values)
    rates = np.broadcast_to(friction.rates, system.ndof)
    exponents = np.outer([*stage_nodes(tableau), 1.0], rates).ravel()

    def growths(h: np.ndarray) -> np.ndarray:
        """e^{γτ} at the stages and the end of steps, and their reciprocals."""
        return np.exp(np.concatenate([h[:, None] * exponents, -h[:, None] * exponents], axis=1))

    return OneStepKernel(code, single, symbols.values, growths)


def newton_code(lettered: Lettered, tableau: Tableau, compensated: bool, damped: bool) -> NewtonCode:
    """The code of a method for H, `lettered`."""
    symbols = lettered.symbols
    few = 2 * symbols.ndof * len(tableau[1]) <= MOST_IN_REGISTERS and not is_large(symbols)
    return (_InRegisters if few else _InMemory)(lettered, tableau, compensated, damped)


class NewtonCode(OneStep):
    """Steps of an implicit method on a symbolic system, whose count is of Newton's iterations.

    With friction the last numbers of a column are e^{γτ} at the stages and the end of a step, then their reciprocals.
    """

    counted = True

    @property
    def reversible(self) -> bool:  # type: ignore[override]
        return self.n_out <= MOST_REVERSED and not self.data

    def __init__(self, lettered: Lettered, tableau: Tableau, compensated: bool, damped: bool) -> None:
        self._given = lettered, tableau, compensated, damped
        self.tableau, self.compensated, self.damped = tableau, compensated, damped
        self.nodes, self.stages = stage_nodes(tableau), len(tableau[1])
        n = 2 * lettered.symbols.ndof
        super().__init__(lettered, n * (1 + compensated) + 1, n * (self.stages + 1) * damped)
        self.unknowns = n * self.stages
        self.work = 4 * self.unknowns**3
        self.block = int(min(max(LONG / self.unknowns**3, 1), Rollouts.block))

    @cached_property
    def slopes(self) -> Program:
        """∇H and the upper triangle of ∇²H, row by row, from q, p, the parameters and the coefficients."""
        symbols = self.lettered.symbols
        program = recorded(self.lettered.expressions, (*symbols.q, *symbols.p, *self.lettered.given))
        y = program.inputs[: self.n_out]
        slope = gradient(program.outputs[0], y)
        rows = [gradient(x, y[i:]) for i, x in enumerate(slope)]
        return Program(program.inputs, [*slope, *(entry for row in rows for entry in row)])

    @cached_property
    def field_reversed(self) -> Program:
        """The derivatives of J∇H·μ by the parameters, from q, p, the parameters and the coefficients, and from μ."""
        symbols, n, d = self.lettered.symbols, self.n_out, self.ndof
        program = recorded(self.lettered.expressions, (*symbols.q, *symbols.p, *self.lettered.given))
        recording, slope = program.inputs[0].recording, gradient(program.outputs[0], program.inputs[:n])
        mu = [recording.input(f"mu_{m}") for m in range(n)]
        total = _total([*map(mul, mu[:d], slope[d:]), *(-(x * y) for x, y in zip(mu[d:], slope[:d], strict=True))])
        parameters = program.inputs[n : n + self.parameters]
        return Program([*program.inputs, *mu], gradient(total, parameters))

    @cached_property
    def leftover(self) -> list[float]:
        """The solution c of A c = 1, so that Σ_i v_i = c·Aᵀv."""
        return [float(x) for x in np.linalg.solve(np.array(self.tableau[0], dtype=float), np.ones(self.stages))]


class _Iteration:
    """One of Newton's iterations, written out over lists; M has rows with the residual behind the unknowns."""

    def __init__(self, method: NewtonCode, wide: int, *numbers: Cells) -> None:
        self.method, self.wide = method, wide
        self.n, self.d, self.s, self.N = method.n_out, method.ndof, method.stages, method.unknowns
        self.y, self.K, self.column, self.M, self.Y, self.g, self.S, self.sizes = numbers
        self.A, self.scale = self.array("A", np.ravel(method.tableau[0])), self.array("scale", method.tableau[2])

    each: Any = staticmethod(range)
    """``each(n)``: execute what follows for 0 … n − 1."""

    def cell(self, x: Any) -> Any:
        """A place of one number, its `value`."""
        return SimpleNamespace(value=x)

    def array(self, name: str, values: Any) -> Cells:
        """Numbers that do not change."""
        return [float(x) for x in values]

    def fill_row(self, factor: Any, i: Any, j: Any) -> None:
        """Write a factor times n numbers of S, from i on, to M, from j on."""
        self.M[j : j + self.n] = [factor * x for x in self.S[i : i + self.n]]

    def solve(self) -> None:
        """Put M⁻¹ times the residual in its place."""
        N, M = self.N, self.M
        M[N :: self.wide] = _eliminated(
            [M[i : i + N] for i in range(0, len(M), self.wide)], M[N :: self.wide], self.sizes
        )

    def execute(self, sized: bool = False) -> Any:
        """Change K; the relative size of the change. `sized` if the sizes of the unknowns are known."""
        self.fill(sized)
        self.solve()
        return self._moved()

    def fill(self, sized: bool = False) -> None:
        """The equations for K into M, and the sizes."""
        for i in self.each(self.s):
            self._assemble(i)
        if not sized:
            self._fill_sizes()

    def _fill_stage(self, i: Any) -> None:
        """The state of a stage into Y."""
        for m in self.each(self.n):
            x = self.cell(self.y[m])
            for j in self.each(self.s):
                x.value = x.value + self.A[i * self.s + j] * self.K[j * self.n + m]
            self.Y[m] = x.value
        for m in self.each(self.d) if self.method.damped else ():
            self.Y[m + self.d] = self.Y[m + self.d] * self._growth(i + self.s + 1, m)

    def _assemble(self, i: Any) -> None:
        """The equations of a stage."""
        n, d, s = self.n, self.d, self.s
        self._fill_stage(i)
        self.fill_slopes(i)
        for m in self.each(d) if self.method.damped else ():  # rows e^{γτ} ∂H/∂q, columns ∂p/∂P
            up = self._growth(i, m)
            self.g[m] = self.g[m] * up
            for k in self.each(d):
                down = self._growth(i + s + 1, k)
                for place, factor in ((m * n + k, up), (m * n + k + d, up * down), ((m + d) * n + k + d, down)):
                    self.S[place] = self.S[place] * factor
        factor = self.column[0] * self.scale[i]
        for part, signed in enumerate((factor, -factor)):  # J∇H = (∂H/∂p, −∂H/∂q)
            for m in self.each(d):
                other, unknown = m + (1 - part) * d, i * n + m + part * d
                row = unknown * self.wide
                self.M[row + self.N] = self.K[unknown] - signed * self.g[other]
                for filling in range(self.N + 1, self.wide):
                    self.M[row + filling] = 0.0
                for j in self.each(s):
                    self.fill_row(-(signed * self.A[i * s + j]), other * n, row + j * n)
                self.M[row + unknown] = self.M[row + unknown] + 1.0

    def pulled(self, end: Sequence[Any], slopes: bool) -> list[Any]:
        """The cotangents of y, and with `slopes` of the parameters, for those λ of the state after the step.

        The transposed equations give μ; the cotangents of y are λ + Σ_i v_i, where Aᵀv = μ − Bλ.
        """
        n, d, N, wide, method = self.n, self.d, self.N, self.wide, self.method
        weights = method.tableau[1]
        if method.damped:
            end = [*end[:d], *(x * self.column[method.size - d + k] for k, x in enumerate(end[d:]))]
        self.fill()
        for i in self.each(N):
            self.sizes[i] = 1.0 / self.sizes[i]
            for j in self.each(i):
                a, b = i * wide + j, j * wide + i
                self.M[a], self.M[b] = self.M[b], self.M[a]
        for k, x in enumerate(b * x for b in weights for x in end):
            self.M[k * wide + N] = x
        self.solve()
        mu = [self.M[k * wide + N] for k in range(N)]
        pairs = [*enumerate(zip(method.leftover, weights, strict=True))]
        found = [x + _total([c * (mu[i * n + m] - b * x) for i, (c, b) in pairs]) for m, x in enumerate(end)]
        totals = [self.cell(0.0) for _ in range(method.parameters if slopes else 0)]
        for i in self.each(self.s) if slopes else ():
            self._fill_stage(i)
            of_stage = [self.M[(i * n + m) * wide + N] for m in range(n)]
            if method.damped:
                of_stage[d:] = [x * self._growth(i, m) for m, x in enumerate(of_stage[d:])]
            factor = self.column[0] * self.scale[i]
            by_parameters = method.field_reversed(*(self.Y[m] for m in range(n)), *self.given_at(i), *of_stage)
            for total, x in zip(totals, by_parameters, strict=True):
                total.value = total.value + factor * x
        return [*found, *(total.value for total in totals)]

    def _growth(self, i: Any, m: Any) -> Any:
        """e^{γτ} at stage i, and its reciprocal at i + s + 1."""
        return self.column[i * self.d + m + (self.method.size - 2 * self.d * (self.s + 1))]

    def fill_slopes(self, i: Any) -> None:
        """∇H into g and ∇²H into S, whose entries that are always 0 are that already, of a stage."""
        n, method = self.n, self.method
        outputs = method.slopes(*(self.Y[m] for m in range(n)), *self.given_at(i))
        for m, x in enumerate(outputs[:n]):
            self.g[m] = x
        upper = ((j, k) for j in range(n) for k in range(j, n))
        for (j, k), x in zip(upper, outputs[n:], strict=True):
            if not is_zero(x):
                self.S[j * n + k] = self.S[k * n + j] = x

    def given_at(self, i: Any) -> list[Any]:
        """The parameters, and the coefficients of a stage."""
        method, count = self.method, len(self.method.lettered.time_coefficients)
        places = [*range(1, 1 + method.parameters), *(i * count + (method.size + k) for k in range(count))]
        return [self.column[place] for place in places]

    def _fill_sizes(self) -> None:
        """The reciprocal size of each unknown: of its variable, or of the largest of its kind where that is 0."""
        for part in range(2):
            top = self.cell(0.0)
            for m in self.each(self.d):
                row = m + part * self.d
                own = self.cell(abs(self.y[row]))
                for i in self.each(self.s):
                    u = i * self.n + row
                    own.value = _larger(_larger(own.value, abs(self.K[u])), abs(self.M[u * self.wide + self.N]))
                self.sizes[row] = own.value
                top.value = _larger(top.value, own.value)
            largest = where(top.value > 0.0, top.value, 1.0)
            for m in self.each(self.d):
                row = m + part * self.d
                size = where(self.sizes[row] > 0.0, self.sizes[row], largest)
                size = 1.0 / where(size < SMALLEST, SMALLEST, size)
                for i in self.each(self.s):
                    self.sizes[i * self.n + row] = size

    def _moved(self) -> Any:
        """Change K; the larger of ‖ΔK_q‖/(‖q‖ + ‖K_q‖) and ‖ΔK_p‖/(‖p‖ + ‖K_p‖), maxima over components and stages."""
        ratios = []
        for part in range(2):
            top, scale = self.cell(0.0), self.cell(0.0)
            for m in self.each(self.d):
                row, largest = m + part * self.d, self.cell(0.0)
                for i in self.each(self.s):
                    u = i * self.n + row
                    change = self.M[u * self.wide + self.N]
                    new = self.K[u] - change
                    self.K[u] = new
                    top.value = _top(top.value, abs(change))
                    largest.value = _larger(largest.value, abs(new))
                scale.value = _larger(scale.value, abs(self.y[row]) + largest.value)
            ratios.append(where(top.value > 0.0, top.value / scale.value, top.value))
        return where(ratios[1] <= ratios[0], ratios[0], ratios[1])

    def fill_coefficients(self) -> None:
        """The coefficients, which depend on t alone, of all stages into the column, behind its numbers."""
        method, count = self.method, len(self.method.lettered.time_coefficients)
        nodes = self.array("nodes", method.nodes)
        for i in self.each(self.s) if count else ():
            for k, x in enumerate(method.coefficients_at([self.column[j] for j in range(method.size)], nodes[i])):
                self.column[i * count + (method.size + k)] = x

    def advance(self, solved: Value) -> None:
        """y plus its change, by Kahan's compensated sums, with the errors behind; NaN where K was not solved."""
        n, method = self.n, self.method
        for m in self.each(n):
            change, old = _total([b * self.K[m + i * n] for i, b in enumerate(method.tableau[1])]), self.y[m]
            new = old + change
            if method.compensated:
                new, self.y[m + n] = added(old, change - self.y[m + n])
            self.y[m] = new
        for m in self.each(self.d) if method.damped else ():
            self.y[m + self.d] = self.y[m + self.d] * self.column[m + (method.size - self.d)]
        for m in self.each(n):
            self.y[m] = where(solved, self.y[m], float("nan"))


class _Looped(_Iteration):
    """The same in machine code, over numbers in memory; terms of a kind are looped over too, by the arrays `data`."""

    def __init__(self, method: _InMemory, wide: int, *places: Value) -> None:
        self.code, self.places, self.data = places[0].code, places, places[8:]
        super().__init__(method, wide, *(Rows(x, DOUBLE) for x in places[:8]))
        self.looped, self.terms = method, method.terms

    def each(self, n: int) -> Iterator[Value]:
        with self.code.over(n) as i:
            yield i

    def cell(self, x: Any) -> Any:
        return self.code.variable(self.code.operand(x, DOUBLE))

    def array(self, name: str, values: Any) -> Cells:
        return Rows(self.code.array(name, values), DOUBLE)

    def fill(self, sized: bool = False) -> None:
        def filled(*places: Value) -> None:
            _Iteration.fill(_Looped(self.looped, self.wide, *places))

        self.code.outlined("filled", self.places, filled)

    def fill_row(self, factor: Any, i: Any, j: Any) -> None:
        type = Type("double", ABREAST if self.n % ABREAST == 0 else 2)
        with self.code.over(self.n // type.width) as k:
            at = k * type.width
            self.code.store(factor * self.code.load(self.S.place, i + at, type), self.M.place, j + at)

    def solve(self) -> None:
        places = [self.M.place, self.sizes.place]
        self.code.outlined("solve", places, partial(_solve, N=self.N, wide=self.wide), rare=False)

    def fill_slopes(self, i: Any) -> None:
        if self.terms is None:
            super().fill_slopes(i)
            return
        self.clear(self.g, self.n)
        self.clear(self.S, self.n**2)

        def targets(places: list[Value]) -> list[tuple[Rows, Value]]:
            return [(self.g, m) for m in places] + [(self.S, i * self.n + j) for i in places for j in places]

        self.terms.add(self.data, self.terms.derivatives(0, True), [self.Y], self.given_at(i), targets)

    def clear(self, x: Cells, count: int) -> None:
        for i in self.each(count):
            x[i] = 0.0


class _InRegisters(NewtonCode):
    """Newton's iteration with every number in a register, of trajectories side by side too."""

    lanes = 8

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        """One step: y, the errors of compensated sums, and the count of iterations."""
        found, taken, solved = self._solved(values[:-1], numbers, step)
        found.advance(solved)
        return [*found.y, values[-1] + taken]

    def _solved(self, y: list[Value], numbers: Numbers, step: Value) -> tuple[_Iteration, Value, Value]:
        """A step whose K are known, the iterations taken, and where they converged."""
        code, coefficients = y[0].code, self.stages * len(self.lettered.time_coefficients)
        column: list[Any] = [*self.column(code, numbers, step), *[0.0] * coefficients]
        found = self._iteration(y, [0.0] * self.unknowns, column)
        found.fill_coefficients()
        found.K, taken, solved = self._iterated(code, y[: self.n_out], column)
        return found, taken, solved

    def adjoint(
        self, values: Values, cotangents: Values, numbers: Numbers, kind: Value, step: Value, slopes: bool, *room: Room
    ) -> tuple[Values, Values]:
        code, type, n = step.code, values[0].type, self.n_out
        found, *_ = self._solved(values[:n], numbers, step)
        given = [*found.y, *found.column, *found.K, *cotangents[:n]]
        ends = 0, n, n + len(found.column), len(given) - n, None

        def pulled(*numbers: Any) -> list[Any]:
            y, column, K, end = (numbers[i:j] for i, j in pairwise(ends))
            return self._iteration(y, K, [*column]).pulled(end, slopes)

        results = traced(pulled, *(f"x_{i}" for i in range(len(given))))(*given)
        results = [code.operand(x, type) for x in results]
        zero = code.constant(0.0, type)
        return [*results[:n], *[zero] * (self.n_values - n)], [zero, *results[n:]]

    def _iteration(
        self, y: Sequence[Any], K: Sequence[Any], column: list[Any], sizes: Sequence[Any] = ()
    ) -> _Iteration:
        """One of Newton's iterations, of new lists for what it changes."""
        n, N, wide = self.n_out, self.unknowns, self.unknowns + 1
        rooms = [0.0] * (N * wide), [0.0] * n, [0.0] * n, [0.0] * n**2
        return _Iteration(self, wide, list(y), list(K), column, *rooms, [*sizes] * self.stages or [0.0] * N)

    @cached_property
    def _iterations(self) -> tuple[Program, Program]:
        """The first iteration, of y and the column's numbers, and the others, of K and the sizes too."""
        n, N, size = self.n_out, self.unknowns, self.size + self.stages * len(self.lettered.time_coefficients)

        def first(*numbers: Any) -> list[Any]:
            found = self._iteration(numbers[:n], [0.0] * N, [*numbers[n:]])
            of_change = found.execute()
            return [*found.K, of_change, *found.sizes[:n]]

        def other(*numbers: Any) -> list[Any]:
            y, column, K, sizes = (numbers[i:j] for i, j in pairwise([0, n, n + size, n + size + N, None]))
            found = self._iteration(y, K, [*column], sizes)
            of_change = found.execute(sized=True)
            return [*found.K, of_change]

        names = [f"{letter}_{i}" for letter, m in (("y", n), ("c", size), ("K", N), ("w", n)) for i in range(m)]
        return traced(first, *names[: n + size]), traced(other, *names)

    def _iterated(self, code: Code, y: Sequence[Value], column: Sequence[Value]) -> tuple[list[Value], Value, Value]:
        """The K of a step, the iterations taken, and where they converged."""
        N, type = self.unknowns, y[0].type
        first, other = self._iterations
        (*outputs,) = (code.operand(x, type) for x in first(*y, *column))
        K, size, sizes = [code.variable(x) for x in outputs[:N]], code.variable(outputs[N]), outputs[N + 1 :]
        taken, small = code.variable(code.constant(1.0, type)), code.variable(size.value <= TOLERANCE)
        active = code.variable(~small.value & (size.value < np.inf))
        with code.during(lambda: code.any(active.value)):
            now, before = active.value, [x.value for x in K]
            *new, found = (code.operand(x, type) for x in other(*y, *column, *before, *sizes))
            done = (found <= TOLERANCE) | ((found <= ROUNDING) & (0.5 * size.value <= found))
            count = taken.value + 1.0
            if type.width > 1:
                new = [code.select(now, a, b) for a, b in zip(new, before, strict=True)]
                count, done = code.select(now, count, taken.value), code.select(now, done, small.value)
            assign(K, new)
            taken.value, small.value, size.value = count, done, found
            active.value = now & ~done & (found < np.inf) & (count < MOST_ITERATIONS)
        return [x.value for x in K], taken.value, small.value


class _InMemory(NewtonCode):
    """The same with arrays in memory, one trajectory after the other."""

    lanes = 1

    def __init__(self, lettered: Lettered, tableau: Tableau, compensated: bool, damped: bool) -> None:
        super().__init__(lettered, tableau, compensated, damped)
        self.terms = terms_of(lettered) if is_large(lettered.symbols) else None
        self.data = [] if self.terms is None else self.terms.data
        n, N, numbers = self.n_out, self.unknowns, self.size + self.stages * len(lettered.time_coefficients)
        self._wide = -(-(N + 1) // ABREAST) * ABREAST  # the last ones fill up registers
        self._sizes = [N, numbers, N * self._wide, n, n, n * n, N]
        self.room = sum(self._sizes)

    def stage(self, room: Room, numbers: Numbers, kind: Value, step: Value) -> None:  # type: ignore[override]
        """One step in place: y, the errors of compensated sums, and the count of iterations."""
        found, taken, solved = self._solved(room, numbers, step)
        found.advance(solved)
        count = room.size - 1
        room[count] = room[count] + taken

    def _solved(self, room: Room, numbers: Numbers, step: Value) -> tuple[_Iteration, Value, Value]:
        """The same as in registers."""
        code = room.code
        rooms = [room.work.part(sum(self._sizes[:i])).place for i in range(7)]
        found = _Looped(self, self._wide, room.place, *rooms, *(room.data(i) for i in range(len(self.data))))
        for i, x in enumerate(self.column(code, numbers, step)):
            found.column[i] = x
        found.fill_coefficients()
        found.clear(found.K, self.unknowns)
        found.clear(found.S, self.n_out**2)

        def iteration(values: list[Value]) -> tuple[Value, list[Value]]:
            before, taken, _ = values
            size = found.execute()
            small = (size <= TOLERANCE) | ((size <= ROUNDING) & (0.5 * before <= size))
            taken = taken + 1.0
            return ~small & (size < np.inf) & (taken < MOST_ITERATIONS), [size, taken, small]

        start = [code.constant(np.inf), code.constant(0.0), code.constant(0, BOOL)]
        _, taken, small = code.repeat(start, iteration)
        return found, taken, small

    def adjoint(
        self, values: Values, cotangents: Values, numbers: Numbers, kind: Value, step: Value, slopes: bool, *room: Room
    ) -> tuple[Values, Values]:
        n, zero = self.n_out, step.code.constant(0.0)
        for k, x in enumerate(values[:n]):
            room[0][k] = x
        found, *_ = self._solved(room[0], numbers, step)
        results = found.pulled(cotangents[:n], slopes)
        return [*results[:n], *[zero] * (self.n_values - n)], [zero, *results[n:]]


def _solve(M: Value, sizes: Value, N: int, wide: int) -> None:
    """Eliminate the unknowns in place: the last column of M becomes the solution.

    Pivots are the largest of their column in units of the sizes of the unknowns; their reciprocals are `sizes`.
    """
    code, type = M.code, Type("double", ABREAST)
    with code.over(N) as k:
        row = code.at(M, k * wide)

        def better(i: Value, values: list[Value], k: Value = k) -> list[Value]:
            i = i + k + 1
            size = abs(code.load(M, i * wide + k)) * code.load(sizes, i)
            larger = values[0] < size
            return [code.select(larger, size, values[0]), code.select(larger, i, values[1])]

        _, best = code.loop((N - 1) - k, [abs(code.load(row, k)) * code.load(sizes, k), k], better)
        start = k >> 2
        with code.given(k < best):
            other = code.at(M, best * wide)
            with code.over((wide // ABREAST) - start) as j:
                place = (j + start) * ABREAST
                a, b = code.load(row, place, type), code.load(other, place, type)
                code.store(b, row, place)
                code.store(a, other, place)
            a, b = code.load(sizes, k), code.load(sizes, best)
            code.store(b, sizes, k)
            code.store(a, sizes, best)
        inverse = 1.0 / code.load(row, k)
        code.store(inverse, row, k)
        start = (k + 1) >> 2
        with code.over((N - 1) - k) as i:
            other = code.at(M, (i + k + 1) * wide)
            factor = code.load(other, k) * -inverse
            groups = code.select(code.apply("eq", (factor, 0.0)), start, code.constant(wide // ABREAST, INT)) - start
            with code.over(groups) as j:
                place = (j + start) * ABREAST
                x = code.fma(code.splat(factor, ABREAST), code.load(row, place, type), code.load(other, place, type))
                code.store(x, other, place)
    with code.over(N) as i:
        k = (N - 1) - i
        row = code.at(M, k * wide)
        x = code.load(row, N) * code.load(row, k)
        code.store(x, row, N)
        with code.over(k) as j:
            other = code.at(M, j * wide)
            code.store(code.fma(-code.load(other, k), x, code.load(other, N)), other, N)


def _eliminated(M: list[list[Any]], x: Sequence[Any], weights: Sequence[Any]) -> list[Any]:
    """M⁻¹x by elimination; pivots are the largest of their column times the weights of the rows."""
    n = len(M)
    if n == 2:  # by Cramer's rule, which waits for one division only
        (a, b), (c, d) = M
        inverse = 1.0 / fma(a, d, -(b * c))
        return [fma(d, x[0], -(b * x[1])) * inverse, fma(a, x[1], -(c * x[0])) * inverse]
    rows = [[*row, value, weight] for row, value, weight in zip(M, x, weights, strict=True)]
    for k in range(n):
        for i in range(k + 1, n):
            if is_zero(rows[i][k]):
                continue
            better = abs(rows[i][k]) * rows[i][-1] > abs(rows[k][k]) * rows[k][-1]
            for j in range(k, n + 2):
                a, b = rows[k][j], rows[i][j]
                rows[k][j], rows[i][j] = where(better, b, a), where(better, a, b)
        inverse = 1.0 / rows[k][k]
        for row in rows[k + 1 :]:
            if is_zero(row[k]):
                continue
            factor = -(row[k] * inverse)
            for j in range(k + 1, n + 1):
                row[j] = fma(factor, rows[k][j], row[j])
        rows[k][k] = inverse
    solution: list[Any] = [0.0] * n
    for k in reversed(range(n)):
        total = rows[k][n]
        for j in range(k + 1, n):
            total = fma(-rows[k][j], solution[j], total)
        solution[k] = total * rows[k][k]
    return solution


def _total(terms: Sequence[Any]) -> Any:
    total: Any = 0.0
    for x in terms:
        total = x if is_zero(total) else total + x
    return total


def _larger(a: Any, b: Any) -> Any:
    return b if is_zero(a) else a if is_zero(b) else where(a < b, b, a)


def _top(a: Any, b: Any) -> Any:
    """The larger of two that are not negative, NaN if the second is."""
    return b if is_zero(a) else where(b <= a, a, b)
