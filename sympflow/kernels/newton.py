"""Newton's iteration of implicit Gauss methods over traced numbers, with the gradient and Hessian of a symbolic H.

The unknowns are K_i = h scale_i f(y + Σ_j A_ij K_j), in which the coefficients are exact where it matters for the long
run, and y + Σ B_i K_i needs no further evaluation of f. With friction they are those of q and P = e^{γτ}p, τ from the
beginning of the step. A few unknowns are eliminated in registers, for trajectories in lanes too; more of them in
memory, where gradient and Hessian stand in the code once, in a loop over the stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, reduce
from itertools import pairwise
from operator import mul
from typing import Any

import numpy as np

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import BOOL, DOUBLE, INT, Code, Rows, Type, Value
from sympflow.compiler.functions import added, fma, is_zero, where
from sympflow.compiler.program import Program, gradient, traced
from sympflow.hamiltonian.collocation import MOST_ITERATIONS, Tableau, stage_nodes
from sympflow.hamiltonian.formulas import recorded
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.one_steps import Lettered, OneStep, OneStepKernel, is_large, parametric, terms_of
from sympflow.kernels.one_steps import lettered as with_letters
from sympflow.kernels.rollouts import Rollouts
from sympflow.kernels.runs import Numbers, Room
from sympflow.lazy import kept

__all__ = ["implicit_kernel", "newton_code"]

TOLERANCE = 1e-11  # of a relative increment: convergence is quadratic, so what is left is below rounding
ROUNDING = 1e-9  # increments below this that no longer shrink are rounding
SMALLEST = 1e-150  # of a size whose reciprocal is multiplied by other numbers
MOST_IN_REGISTERS = 4  # unknowns
ABREAST = 4  # numbers of a row of a matrix that are changed together
MOST_REVERSED = 40  # numbers of a state whose cotangents are in registers
LONG = 4e6  # operations between two looks for a stop


@kept
def implicit_kernel(
    system: HamiltonianSystem, tableau: Tableau, compensated: bool = False, names: tuple[str, ...] = ()
) -> OneStepKernel:
    """The compiled loops of a method on a symbolic system, built once; `compensated` sums are Kahan's, in runs.

    With `names` these parameters are numbers of columns. NotCompiled says why there are none.
    """
    written = system.spelled
    if written is None:
        raise NotCompiled(
            "`system` cannot be compiled: its Hessian is not symbolic. Use HamiltonianSystem.from_sympy, "
            "or use backend='array'."
        )
    friction = system.friction
    if friction and compensated:
        raise NotCompiled("`compensated` sums are for systems without friction, which forgets round-off: leave it out.")
    if friction.kind == 2:
        raise NotCompiled("`damping` is a matrix, whose decay is not compiled here: use backend='array'.")
    symbols = parametric(written, names)
    of_time = with_letters(symbols, [symbols.H])
    code = newton_code(of_time, tableau, compensated, bool(friction))
    single = newton_code(of_time, tableau, False, False) if compensated else code
    if not friction:
        return OneStepKernel(code, single)
    rates = np.broadcast_to(friction.rates, system.ndof)
    exponents = np.outer([*stage_nodes(tableau), 1.0], rates).ravel()

    def growths(h: np.ndarray) -> np.ndarray:
        """e^{γτ} at the stages and the end of steps, and their reciprocals."""
        return np.exp(np.concatenate([h[:, None] * exponents, -h[:, None] * exponents], axis=1))

    return OneStepKernel(code, single, growths)


def newton_code(lettered: Lettered, tableau: Tableau, compensated: bool, damped: bool) -> NewtonCode:
    """The code of a method for H, `lettered`."""
    symbols = lettered.symbols
    few = 2 * symbols.ndof * len(tableau[1]) <= MOST_IN_REGISTERS and not is_large(symbols)
    return (_InRegisters if few else _InMemory)(lettered, tableau, compensated, damped)


class NewtonCode(OneStep):
    """Steps of an implicit method on a symbolic system, whose count is of Newton's iterations.

    With friction the last numbers of a column are e^{γτ} at the stages and at the end of a step, then their
    reciprocals. What depends on t alone is computed once a step, for each stage, and follows them.
    """

    counted = True

    @property
    def reversible(self) -> bool:  # type: ignore[override]
        return self.n_out <= MOST_REVERSED and not self.data

    def __init__(self, lettered: Lettered, tableau: Tableau, compensated: bool, damped: bool) -> None:
        self._given = lettered, tableau, compensated, damped
        self._tableau, self._compensated, self._damped = tableau, compensated, damped
        self._nodes, self.stages = stage_nodes(tableau), len(tableau[1])
        n = 2 * lettered.symbols.ndof
        super().__init__(lettered, n * (1 + compensated) + 1, n * (self.stages + 1) * damped)
        self.unknowns = n * self.stages
        self.work = 4 * self.unknowns**3
        self.block = int(min(max(LONG / self.unknowns**3, 1), Rollouts.block))

    def _changes(self, K: Sequence[Value]) -> Value:
        """Σ B_i K_i of one variable."""
        return _total([b * x for b, x in zip(self._tableau[1], K, strict=True)])

    # H ------------------------------------------------------------------------------------------------------------

    @cached_property
    def slopes(self) -> Program:
        """∇H and the upper triangle of ∇²H, row by row, from q, p, the parameters and the letters."""
        symbols = self.lettered.symbols
        program = recorded(self.lettered.expressions, (*symbols.q, *symbols.p, *self.lettered.given))
        y = program.inputs[: self.n_out]
        slope = gradient(program.outputs[0], y)
        rows = [gradient(x, y[i:]) for i, x in enumerate(slope)]
        return Program(program.inputs, [*slope, *(entry for row in rows for entry in row)])

    @cached_property
    def _field_reversed(self) -> Program:
        """The derivatives of J∇H·μ by the parameters, from q, p, the parameters and the letters, and from μ."""
        symbols, n, d = self.lettered.symbols, self.n_out, self.ndof
        program = recorded(self.lettered.expressions, (*symbols.q, *symbols.p, *self.lettered.given))
        recording, slope = program.inputs[0].recording, gradient(program.outputs[0], program.inputs[:n])
        mu = [recording.input(f"mu_{m}") for m in range(n)]
        total = _total([*map(mul, mu[:d], slope[d:]), *(-(x * y) for x, y in zip(mu[d:], slope[:d], strict=True))])
        parameters = program.inputs[n : n + self.parameters]
        return Program([*program.inputs, *mu], gradient(total, parameters))

    @cached_property
    def _leftover(self) -> list[float]:
        """Numbers c with Σ_i c_i A_ij = 1."""
        return [float(x) for x in np.linalg.solve(np.array(self._tableau[0], dtype=float), np.ones(self.stages))]

    def _leftovers(self, end: Sequence[Any], mu: Sequence[Any]) -> list[Any]:
        """The cotangents of the state before a step: those of its end, λ, and Σ_i v_i, of which Aᵀv = μ − Bλ."""
        n, pairs = self.n_out, [*zip(self._leftover, self._tableau[1], strict=True)]
        return [x + _total([c * (mu[i * n + m] - b * x) for i, (c, b) in enumerate(pairs)]) for m, x in enumerate(end)]

    def _square(self, outputs: list[Any]) -> tuple[list[Any], list[list[Any]]]:
        """∇H, and ∇²H of its upper triangle."""
        n = self.n_out
        g, rest = outputs[:n], iter(outputs[n:])
        S = [[0.0] * n for _ in range(n)]
        for i in range(n):
            for j in range(i, n):
                S[i][j] = S[j][i] = next(rest)
        return g, S


class _InRegisters(NewtonCode):
    """Newton's iteration with every number in a register, of trajectories side by side too."""

    lanes = 8

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        """One step: y, the errors of compensated sums, and the count of iterations."""
        code, n, d = values[0].code, self.n_out, self.ndof
        y, errors, count = values[:n], values[n:-1], values[-1]
        column = self.column(code, numbers, step)
        K, taken, lost, *_ = self._iterated(code, y, column)
        changes = [self._changes(K[m::n]) for m in range(n)]
        if self._compensated:
            sums = [added(old, change - error) for old, change, error in zip(y, changes, errors, strict=True)]
            state, errors = [total for total, _ in sums], [error for _, error in sums]
        else:
            state = [old + change for old, change in zip(y, changes, strict=True)]
        if self._damped:
            decay = column[self.size - d :]
            state = [*state[:d], *(p * e for p, e in zip(state[d:], decay, strict=True))]
        nan = code.constant(float("nan"), y[0].type)
        return [*(code.select(lost, nan, x) for x in state), *errors, count + taken]

    def _gradient_and_hessian(
        self, Y: Sequence[Any], column: Sequence[Any], stage: int
    ) -> tuple[list[Any], list[list[Any]]]:
        """∇H and ∇²H at a stage, with friction of [q, P] as the equations hold them."""
        d, n, letters = self.ndof, self.n_out, len(self.lettered.letters)
        start = self.size + stage * letters
        given = [*column[1 : 1 + self.parameters], *column[start : start + letters]]
        if not self._damped:
            return self._square(self.slopes(*Y, *given))
        growths = column[self.size - 2 * d * (self.stages + 1) :]
        grown, shrunk = (growths[d * (i * (self.stages + 1) + stage) :][:d] for i in range(2))
        Y = [*Y[:d], *(P * e for P, e in zip(Y[d:], shrunk, strict=True))]
        g, S = self._square(self.slopes(*Y, *given))
        row, entry = [*grown, *[1.0] * d], [*[1.0] * d, *shrunk]
        g = [a * x for a, x in zip(row, g, strict=True)]
        return g, [[row[i] * S[i][j] * entry[j] for j in range(n)] for i in range(n)]

    def _equations(self, y: Sequence[Any], K: Sequence[Any], column: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """The residuals of the equations for K, and the rows of their derivatives by K."""
        A, _, scale = self._tableau
        n, d, h, rows, residual = self.n_out, self.ndof, column[0], [], []
        for i in range(self.stages):
            Y = [y[m] + _total([A[i][j] * K[j * n + m] for j in range(self.stages)]) for m in range(n)]
            g, S = self._gradient_and_hessian(Y, column, i)
            f, J = [*g[d:], *(-x for x in g[:d])], [*S[d:], *([-x for x in row] for row in S[:d])]
            for m in range(n):
                residual.append(K[i * n + m] - h * scale[i] * f[m])
                row = [-(h * (scale[i] * A[i][j])) * J[m][k] for j in range(self.stages) for k in range(n)]
                row[i * n + m] = 1.0 + row[i * n + m]
                rows.append(row)
        return residual, rows

    def _iteration(self, y: Sequence[Any], K: Sequence[Any], column: Sequence[Any], sizes: Sequence[Any]) -> list[Any]:
        """One of Newton's iterations: the new K, the relative size of the change, and the sizes of the variables."""
        residual, rows = self._equations(y, K, column)
        sizes = sizes or self._sizes(y, residual)
        change = _eliminated(rows, residual, list(sizes) * self.stages)
        new = [k - x for k, x in zip(K, change, strict=True)]
        return [*new, self._relative_size(change, y, new), *sizes]

    def _sizes(self, y: Sequence[Any], residual: Sequence[Any]) -> list[Any]:
        """The reciprocal size of each variable, or of the largest of its kind where that is 0."""
        n, d = self.n_out, self.ndof
        own = [_largest([y[m], *(residual[i * n + m] for i in range(self.stages))]) for m in range(n)]
        weights = []
        for part in (own[:d], own[d:]):
            top = _largest(part)
            for size in part:
                found = where(size > 0.0, size, where(top > 0.0, top, 1.0))
                weights.append(1.0 / where(found < SMALLEST, SMALLEST, found))
        return weights

    def _relative_size(self, change: Sequence[Any], y: Sequence[Any], K: Sequence[Any]) -> Any:
        """The largest of ‖Δq‖/(‖q‖ + ‖K_q‖) and ‖Δp‖/(‖p‖ + ‖K_p‖), maxima over components and stages."""
        n, d = self.n_out, self.ndof
        ratios = []
        for part in (range(d), range(d, n)):
            top = _largest([change[i * n + m] for i in range(self.stages) for m in part])
            scale = _largest([abs(y[m]) + _largest([K[i * n + m] for i in range(self.stages)]) for m in part])
            ratios.append(where(top > 0.0, top / scale, top))
        return where(ratios[0] <= ratios[1], ratios[1], ratios[0])

    @cached_property
    def _iterations(self) -> tuple[Program, Program]:
        """The first iteration, of y and the column's numbers, and the others, of K and the sizes too."""
        n, N, size = self.n_out, self.unknowns, self.size + self.stages * len(self.lettered.letters)

        def first(*numbers: Any) -> list[Any]:
            return self._iteration(numbers[:n], [0.0] * N, numbers[n:], ())

        def other(*numbers: Any) -> list[Any]:
            y, column, K, sizes = (numbers[i:j] for i, j in pairwise([0, n, n + size, n + size + N, None]))
            return self._iteration(y, K, column, sizes)[: N + 1]

        names = [f"{letter}_{i}" for letter, m in (("y", n), ("c", size), ("K", N), ("w", n)) for i in range(m)]
        return traced(first, *names[: n + size]), traced(other, *names)

    @cached_property
    def _pull(self) -> Program:
        """The cotangents of a state, and the μ, from it, the numbers, K, the sizes, and those of the state after it."""
        n, N, size, s = self.n_out, self.unknowns, self.size + self.stages * len(self.lettered.letters), self.stages

        def pulled(*numbers: Any) -> list[Any]:
            y, column, K, sizes, end = (numbers[i:j] for i, j in pairwise([0, n, n + size, n + size + N, -n, None]))
            if self._damped:
                decay = column[self.size - self.ndof : self.size]
                end = (*end[: n - self.ndof], *map(mul, end[n - self.ndof :], decay))
            rows = self._equations(y, K, column)[1]
            transposed = [[row[i] for row in rows] for i in range(N)]
            mu = _eliminated(transposed, [b * x for b in self._tableau[1] for x in end], [1.0 / w for w in sizes] * s)
            return [*self._leftovers(end, mu), *mu]

        names = [
            f"{letter}_{i}" for letter, m in (("y", n), ("c", size), ("K", N), ("w", n), ("e", n)) for i in range(m)
        ]
        return traced(pulled, *names)

    def adjoint(
        self,
        values: list[Value],
        cotangents: list[Value],
        numbers: Numbers,
        kind: Value,
        step: Value,
        slopes: bool,
        *room: Room,
    ) -> tuple[list[Value], list[Value]]:
        code, type, n, y = step.code, values[0].type, self.n_out, values[: self.n_out]
        K, *_, sizes, column = self._iterated(code, y, self.column(code, numbers, step))
        found = [code.operand(x, type) for x in self._pull(*y, *column, *K, *sizes, *cotangents[:n])]
        zero, of_stages = code.constant(0.0, type), []
        for i in range(self.stages if slopes else 0):
            Y = [y[m] + _total([a * K[j * n + m] for j, a in enumerate(self._tableau[0][i])]) for m in range(n)]
            of_stages.append(self._pulled_field(Y, column, i, found[(1 + i) * n :][:n]))
        of_numbers = [code.operand(_total(each), type) for each in zip(*of_stages, strict=True)]
        return [*found[:n], *[zero] * (self.n_values - n)], of_numbers

    def _pulled_field(self, Y: Sequence[Any], column: Sequence[Any], stage: int, mu: Sequence[Any]) -> list[Any]:
        """The cotangents of the parameters for those, μ, of the residuals of a stage."""
        d, letters = self.ndof, len(self.lettered.letters)
        start = self.size + stage * letters
        if self._damped:
            growths = column[self.size - 2 * d * (self.stages + 1) :]
            grown, shrunk = (growths[d * (i * (self.stages + 1) + stage) :][:d] for i in range(2))
            Y, mu = [*Y[:d], *map(mul, Y[d:], shrunk)], [*mu[:d], *map(mul, mu[d:], grown)]
        factor = column[0] * self._tableau[2][stage]
        given = [*column[1 : 1 + self.parameters], *column[start : start + letters]]
        return [factor * x for x in self._field_reversed(*Y, *given, *mu)]

    def _iterated(
        self, code: Code, y: Sequence[Value], column: list[Value]
    ) -> tuple[list[Value], Value, Value, list[Value], list[Value]]:
        """The K of a step, the iterations taken, where they were in vain, the sizes, and all numbers."""
        N, type = self.unknowns, y[0].type
        first, other = self._iterations
        if self.driven:
            column = [*column, *(x for c in self._nodes for x in self.letters_at(column, c))]
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
            for variable, x in zip(K, new, strict=True):
                variable.value = x
            taken.value, small.value, size.value = count, done, found
            active.value = now & ~done & (found < np.inf) & (count < MOST_ITERATIONS)
        return [x.value for x in K], taken.value, ~small.value, sizes, column


class _InMemory(NewtonCode):
    """The same with arrays in memory, one trajectory after the other."""

    lanes = 1

    def __init__(self, lettered: Lettered, tableau: Tableau, compensated: bool, damped: bool) -> None:
        super().__init__(lettered, tableau, compensated, damped)
        symbols = lettered.symbols
        self._terms = terms_of(lettered) if is_large(symbols) else None
        self.data = [] if self._terms is None else self._terms.data
        n, N = self.n_out, self.unknowns
        self._numbers = self.size + self.stages * len(self.lettered.letters)
        self._sizes = [N, self._numbers, N * self._wide, n, n, n * n, N]
        self.room = sum(self._sizes)

    @property
    def _wide(self) -> int:
        """Numbers of a row of the matrix: the last ones the residual, and what fills up registers."""
        return -(-(self.unknowns + 1) // ABREAST) * ABREAST

    def stage(self, room: Room, numbers: Numbers, kind: Value, step: Value) -> None:  # type: ignore[override]
        """One step in place: y, the errors of compensated sums, and the count of iterations."""
        code, n = room.code, self.n_out
        taken, small, arguments = self._solved(room, numbers, step)
        K, column = arguments[1:3]
        with code.over(n) as m:
            self._advance(room, K, m, small)
        if self._damped:
            with code.over(self.ndof) as m:
                room.store(room.load(m + self.ndof) * code.load(column, m + (self.size - self.ndof)), m + self.ndof)
        room.add(taken, room.size - 1)

    def _solved(self, room: Room, numbers: Numbers, step: Value) -> tuple[Value, Value, list[Value]]:
        """The iterations of a step, if they were not in vain, and the arguments of `_iterated`."""
        code, n, N = room.code, self.n_out, self.unknowns
        K, column, M, Y, g, S, sizes = (room.part(sum(self._sizes[:i]), room.work) for i in range(7))
        given = self.column(code, numbers, step)
        for i, x in enumerate(given):
            code.store(x, column, i)
        self._store_letters(code, given, column)
        _fill(code, K, N)
        _fill(code, S, n * n)
        data = [room.data(i) for i in range(len(self.data))]
        arguments = [room.state, K, column, M, Y, g, S, sizes, *data]

        def iteration(values: list[Value]) -> tuple[Value, list[Value]]:
            before, taken, _ = values
            size = code.outlined("iteration", arguments, self._iterated, DOUBLE, rare=False)
            small = (size <= TOLERANCE) | ((size <= ROUNDING) & (0.5 * before <= size))
            taken = taken + 1.0
            return ~small & (size < np.inf) & (taken < MOST_ITERATIONS), [size, taken, small]

        start = [code.constant(np.inf), code.constant(0.0), code.constant(0, BOOL)]
        _, taken, small = code.repeat(start, iteration)
        return taken, small, arguments

    def adjoint(
        self,
        values: list[Value],
        cotangents: list[Value],
        numbers: Numbers,
        kind: Value,
        step: Value,
        slopes: bool,
        *room: Room,
    ) -> tuple[list[Value], list[Value]]:
        code, n, d, N, wide, zero = step.code, self.n_out, self.ndof, self.unknowns, self._wide, step.code.constant(0.0)
        for k, x in enumerate(values[:n]):
            room[0].store(x, k)
        *_, arguments = self._solved(room[0], numbers, step)
        state, K, column, M, Y, _, _, sizes, *_ = arguments
        end = cotangents[:n]
        if self._damped:
            end = [*end[:d], *(x * code.load(column, self.size - d + k) for k, x in enumerate(end[d:]))]
        code.outlined("filled", arguments, self._filled)
        with code.over(N) as i:
            code.store(1.0 / code.load(sizes, i), sizes, i)
            with code.over(i) as j:
                a, b = code.load(M, i * wide + j), code.load(M, j * wide + i)
                code.store(b, M, i * wide + j)
                code.store(a, M, j * wide + i)
        for k, weight in enumerate(self._tableau[1]):
            for r, x in enumerate(end):
                code.store(weight * x, M, (k * n + r) * wide + N)
        code.outlined("solve", [M, sizes], self._solve, rare=False)
        mu = [code.load(M, k * wide + N) for k in range(N)]
        totals = [code.variable(zero) for _ in range(self.parameters if slopes else 0)]
        if slopes:
            letters, A = len(self.lettered.letters), code.array("A", np.ravel(self._tableau[0]))
            scale = code.array("scale", self._tableau[2])
            with code.over(self.stages) as i:
                self._fill_stage(code, state, K, column, Y, A, i)
                weights = [code.load(M, (i * n + m) * wide + N) for m in range(n)]
                if self._damped:
                    grown = self._growths(code, column, i)[0]
                    weights = [*weights[:d], *(x * code.load(grown, m) for m, x in enumerate(weights[d:]))]
                given = [code.load(column, 1 + k) for k in range(self.parameters)]
                given += [code.load(column, i * letters + (self.size + k)) for k in range(letters)]
                found = self._field_reversed(*(code.load(Y, m) for m in range(n)), *given, *weights)
                factor = code.load(column) * code.load(scale, i)
                for total, x in zip(totals, found, strict=True):
                    total.value = total.value + factor * x
        found = self._leftovers(end, mu)
        return [*found, *[zero] * (self.n_values - n)], [x.value for x in totals]

    def _store_letters(self, code: Code, given: Sequence[Value], column: Value) -> None:
        """The letters of all stages, behind the numbers of the column."""
        letters = len(self.lettered.letters)
        if letters:
            nodes = code.array("nodes", self._nodes)
            with code.over(self.stages) as i:
                for k, x in enumerate(self.letters_at(given, code.load(nodes, i))):
                    code.store(x, column, i * letters + (self.size + k))

    def _advance(self, room: Room, K: Value, m: Value, small: Value) -> None:
        """A variable plus its change, by Kahan's compensated sum; NaN where the step was not solved."""
        code, n = room.code, self.n_out
        change, old = self._changes([code.load(K, m + i * n) for i in range(self.stages)]), room.load(m)
        if self._compensated:
            new, error = added(old, change - room.load(m + n))
            room.store(error, m + n)
        else:
            new = old + change
        room.store(where(small, new, float("nan")), m)

    def _iterated(self, *arguments: Value) -> Value:
        """One of Newton's iterations in memory; the relative size of the change."""
        state, K, _, M, _, _, _, sizes, *_ = arguments
        code, N, wide = K.code, self.unknowns, self._wide
        self._filled(*arguments)
        code.outlined("solve", [M, sizes], self._solve, rare=False)
        with code.over(N) as i:
            code.store(code.load(K, i) - code.load(M, i * wide + N), K, i)
        return self._relative_size_in_memory(code, state, K, M)

    def _fill_stage(self, code: Code, state: Value, K: Value, numbers: Value, Y: Value, A: Value, i: Value) -> None:
        """The state of a stage into Y."""
        n, d = self.n_out, self.ndof
        with code.over(n) as m:
            x = code.variable(code.load(state, m))
            with code.over(self.stages) as j:
                x.value = x.value + code.load(A, i * self.stages + j) * code.load(K, j * n + m)
            code.store(x.value, Y, m)
        if self._damped:
            shrunk = self._growths(code, numbers, i)[1]
            with code.over(d) as m:
                code.store(code.load(Y, m + d) * code.load(shrunk, m), Y, m + d)

    def _filled(self, *arguments: Value) -> None:
        """The equations for K into M, and the sizes of the unknowns."""
        state, K, numbers, M, Y, g, S, sizes, *data = arguments
        code, n, d, N, wide = K.code, self.n_out, self.ndof, self.unknowns, self._wide
        A, scale = code.array("A", np.ravel(self._tableau[0])), code.array("scale", self._tableau[2])
        h = code.load(numbers)
        with code.over(self.stages) as i:
            self._fill_stage(code, state, K, numbers, Y, A, i)
            grown, shrunk = self._growths(code, numbers, i) if self._damped else (Y, Y)
            self._fill_slopes(code, numbers, Y, g, S, i, data)
            if self._damped:
                _scale_slopes(code, d, grown, shrunk, g, S)
            factor = h * code.load(scale, i)
            with code.over(n) as m:
                first = m < d
                other = code.select(first, m + d, m - d)  # J∇H = (∂H/∂p, −∂H/∂q)
                signed = code.select(first, factor, -factor)
                unknown = i * n + m
                row = code.at(M, unknown * wide)
                code.store(code.load(K, unknown) - signed * code.load(g, other), row, N)
                for filling in range(N + 1, wide):
                    code.store(code.constant(0.0), row, filling)
                with code.over(self.stages) as j:
                    entry = -(signed * code.load(A, i * self.stages + j))
                    type = Type("double", ABREAST if n % ABREAST == 0 else 2)
                    with code.over(n // type.width) as k:
                        entries = entry * code.load(S, other * n + k * type.width, type)
                        code.store(entries, row, j * n + k * type.width)
                code.store(code.load(row, unknown) + 1.0, row, unknown)
        self._fill_sizes(code, state, K, M, sizes)

    def _growths(self, code: Code, numbers: Value, i: Value) -> tuple[Value, Value]:
        """The places of e^{γτ} of a stage, and of their reciprocals."""
        d, start = self.ndof, self.size - 2 * self.ndof * (self.stages + 1)
        return code.at(numbers, i * d + start), code.at(numbers, (i + self.stages + 1) * d + start)

    def _fill_slopes(
        self, code: Code, numbers: Value, Y: Value, g: Value, S: Value, i: Value, data: Sequence[Value]
    ) -> None:
        """∇H into g and ∇²H into S, of a stage."""
        n, letters = self.n_out, len(self.lettered.letters)
        given = [code.load(numbers, 1 + k) for k in range(self.parameters)]
        given += [code.load(numbers, i * letters + (self.size + k)) for k in range(letters)]
        if self._terms is not None:  # a loop over the terms of each kind
            _fill(code, g, n)
            _fill(code, S, n * n)
            slope, rows = Rows(g, DOUBLE), Rows(S, DOUBLE)

            def targets(places: list[Value]) -> list[tuple[Rows, Value]]:
                return [(slope, m) for m in places] + [(rows, i * n + j) for i in places for j in places]

            self._terms.add(data, self._terms.derivatives(0, True), [Rows(Y, DOUBLE)], given, targets)
            return
        slopes, hessian = self._square(self.slopes(*(code.load(Y, m) for m in range(n)), *given))
        for m, x in enumerate(slopes):
            code.store(code.operand(x, DOUBLE), g, m)
        for j, row in enumerate(hessian):
            for k, x in enumerate(row):
                if not is_zero(x):
                    code.store(code.operand(x, DOUBLE), S, j * n + k)

    def _fill_sizes(self, code: Code, state: Value, K: Value, M: Value, sizes: Value) -> None:
        """The reciprocal size of each unknown: of its variable, or of the largest of its kind where that is 0."""
        n, d, N, wide, zero = self.n_out, self.ndof, self.unknowns, self._wide, code.constant(0.0)
        for part in range(2):

            def own(m: Value, values: list[Value], part: int = part) -> list[Value]:
                def largest(i: Value, values: list[Value]) -> list[Value]:
                    row = i * n + m + part * d
                    return [_larger(_larger(values[0], abs(code.load(K, row))), abs(code.load(M, row * wide + N)))]

                (size,) = code.loop(self.stages, [abs(code.load(state, m + part * d))], largest)
                code.store(size, sizes, m + part * d)
                return [_larger(values[0], size)]

            (top,) = code.loop(d, [zero], own)
            top = where(top > 0.0, top, 1.0)
            with code.over(d) as m:
                size = code.load(sizes, m + part * d)
                size = 1.0 / _larger(where(size > 0.0, size, top), code.constant(SMALLEST))
                with code.over(self.stages) as i:
                    code.store(size, sizes, i * n + m + part * d)

    def _relative_size_in_memory(self, code: Code, state: Value, K: Value, M: Value) -> Value:
        """The same as `_relative_size`."""
        n, d, N, wide, zero = self.n_out, self.ndof, self.unknowns, self._wide, code.constant(0.0)
        ratios = []
        for part in range(2):

            def variable(m: Value, values: list[Value], part: int = part) -> list[Value]:
                def stage(i: Value, values: list[Value]) -> list[Value]:
                    row = i * n + m + part * d
                    change, size = abs(code.load(M, row * wide + N)), abs(code.load(K, row))
                    return [where(change <= values[0], values[0], change), _larger(values[1], size)]

                top, largest = code.loop(self.stages, [values[0], zero], stage)
                return [top, _larger(values[1], abs(code.load(state, m + part * d)) + largest)]

            top, scale = code.loop(d, [zero, zero], variable)
            ratios.append(where(top > 0.0, top / scale, top))
        return where(ratios[1] <= ratios[0], ratios[0], ratios[1])

    def _solve(self, M: Value, sizes: Value) -> None:
        """Eliminate the unknowns in place: the last column of M becomes the solution.

        Pivots are the largest of their column in units of the sizes of the unknowns, whose reciprocals `sizes` go
        along.
        """
        code, N, wide, type = M.code, self.unknowns, self._wide, Type("double", ABREAST)
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
                groups = (
                    code.select(code.apply("eq", (factor, 0.0)), start, code.constant(wide // ABREAST, INT)) - start
                )
                with code.over(groups) as j:
                    place = (j + start) * ABREAST
                    x = code.fma(
                        code.splat(factor, ABREAST), code.load(row, place, type), code.load(other, place, type)
                    )
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
    return where(a < b, b, a)


def _largest(values: Sequence[Any]) -> Any:
    """The largest absolute value."""
    moving = [abs(x) for x in values if not is_zero(x)]
    return reduce(_larger, moving) if moving else 0.0


def _fill(code: Code, place: Value, count: int) -> None:
    with code.over(count) as i:
        code.store(code.constant(0.0), place, i)


def _scale_slopes(code: Code, d: int, grown: Value, shrunk: Value, g: Value, S: Value) -> None:
    """∇H and ∇²H at (q, p) into those of [q, P]: rows e^{γτ} ∂H/∂q, columns ∂p/∂P."""
    n = 2 * d
    with code.over(d) as m:
        up = code.load(grown, m)
        code.store(code.load(g, m) * up, g, m)
        with code.over(d) as k:
            down = code.load(shrunk, k)
            for place, factor in ((m * n + k, up), (m * n + k + d, up * down), ((m + d) * n + k + d, down)):
                code.store(code.load(S, place) * factor, S, place)
