"""Compiled steps of implicit Gauss methods over traced numbers: Newton's iteration with the Hessian of a symbolic H.

The unknowns are K_i = h scale_i f(y + Σ_j A_ij K_j), in which the coefficients are exact where it matters for the long
run, and y + Σ B_i K_i needs no further evaluation of f. With friction they are those of q and P = e^{γτ}p, τ from the
beginning of the step. A few unknowns are eliminated in registers, for trajectories in lanes too; more of them in
memory, where gradient and Hessian stand in the code once, in a loop over the stages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, reduce
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from sympflow.compiler.control import BOOL, DOUBLE, INT, Code, Type, Value
from sympflow.compiler.functions import fma, where
from sympflow.compiler.program import Program, gradient, traced
from sympflow.hamiltonian.collocation import MOST_ITERATIONS, Tableau, stage_nodes
from sympflow.hamiltonian.driving import with_letters
from sympflow.hamiltonian.recorded import evaluator
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.kernels.protocol import Carry, Kernel, Run, Steps, run_states
from sympflow.kernels.rollouts import Columns, Rollouts
from sympflow.kernels.runs import Numbers, step_function
from sympflow.kernels.samples import check_samples, sampled_value
from sympflow.kernels.stage_times import letters_of_time
from sympflow.kernels.terms import families, is_large
from sympflow.kernels.threads import given

__all__ = ["ImplicitKernel", "implicit_kernel"]

TOLERANCE = 1e-11  # of a relative increment: convergence is quadratic, so what is left is below rounding
ROUNDING = 1e-9  # increments below this that no longer shrink are rounding
SMALLEST = 1e-150  # of a size whose reciprocal is multiplied by other numbers
MOST_IN_REGISTERS = 4  # unknowns
ABREAST = 4  # numbers of a row of a matrix that are changed together
LONG = 4e6  # operations between two looks for a stop


def implicit_kernel(system: HamiltonianSystem, tableau: Tableau, compensated: bool = False) -> ImplicitKernel:
    """The compiled loops of a method on a symbolic system, built once.

    Raises
    ------
    ValueError
        If the system cannot be compiled, with the reason.
    """
    kernels = _KERNELS.setdefault(system, {})
    if (tableau, compensated) not in kernels:
        kernels[tableau, compensated] = ImplicitKernel(system, tableau, compensated)
    return kernels[tableau, compensated]


_KERNELS: WeakKeyDictionary[HamiltonianSystem, dict[tuple[Tableau, bool], ImplicitKernel]] = WeakKeyDictionary()


class ImplicitKernel(Kernel):
    """Compiled loops of an implicit Runge–Kutta method on one system, a `Kernel`.

    Parameters
    ----------
    system : HamiltonianSystem
        Symbolic.
    tableau : (A, B, scale)
        As tuples of numbers: see `Tableau`.
    compensated : bool
        Sum with Kahan's compensation in runs.
    """

    saves_finite = False

    def __init__(self, system: HamiltonianSystem, tableau: Tableau, compensated: bool = False) -> None:
        if system.symbols is None:
            raise ValueError(
                "`system` cannot be compiled: its Hessian is not symbolic. Use HamiltonianSystem.from_sympy, "
                "or use backend='array'."
            )
        friction = system.friction
        if friction is not None and compensated:
            raise ValueError(
                "`compensated` sums are for systems without friction, which forgets round-off: leave it out."
            )
        if friction is not None and friction.damping.ndim == 2:
            raise ValueError("`damping` is a matrix, whose decay is not compiled here: use backend='array'.")
        self._rates = None if friction is None else np.broadcast_to(friction.rates, system.ndof)
        self._nodes = np.array(stage_nodes(tableau))
        symbols = system.symbols if is_large(system.symbols) else system.symbols.parametric
        for name in symbols.samples:
            check_samples(symbols.samples[name])
        self._values, self._driven = symbols.values, symbols.time is not None
        self._code = newton_code(symbols, tableau, compensated, friction is not None)

    def _numbers(self, h: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The numbers (n, size) of steps of lengths h (n,), at the times t (n,) less those of whole steps before."""
        given = [h[:, None], np.broadcast_to(self._values, (len(h), len(self._values)))]
        if self._driven:
            given.append(t[:, None])
        if self._rates is not None:
            exponents = np.append(self._nodes, 1.0)[:, None] * self._rates
            decays = -h[:, None] * exponents.ravel()
            given.append(np.exp(np.concatenate([-decays, decays], axis=1)))
        return np.concatenate(given, axis=1)

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
        Y, n_finite, iterations = self._rollout(h, t0, y0[None], n_steps, save, None, carry)
        return Run(Y[0], n_finite[0], iterations)

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
        """`run` for every row of `y0` (N, 2d), where it pays on several threads."""
        return self._rollout(h, t0, y0, n_steps, save, threads, carry)

    def _rollout(
        self,
        h: float,
        t0: float,
        y0: np.ndarray,
        n_steps: int,
        save: np.ndarray,
        threads: int | None,
        carry: Carry | None,
    ) -> Run:
        code, counts = self._code, np.zeros(len(y0))
        code.check_memory()
        columns = np.repeat(self._numbers(np.array([h]), np.array([t0])), 3, axis=0), np.zeros(3, dtype=np.int64)

        def rows(i: slice, *rest: Any) -> None:
            code.rollout_batch(columns, *rest, False, counts[i])

        Y, n_finite, _ = run_states(rows, y0, n_steps, save, threads, carry, code.n_values, code.work)
        return Run(Y, n_finite, int(counts.sum()))

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,): see `Kernel`."""
        y = given(y)
        h, t = (given(np.broadcast_to(x, y.shape[:1])) for x in (h, t))
        self._code.check_memory()
        return Steps(*self._code.steps(y, self._numbers(h, t)))


@lru_cache(maxsize=256)
def newton_code(symbols: SymbolicHamiltonian, tableau: Tableau, compensated: bool, damped: bool) -> NewtonCode:
    """The code of a method on a symbolic system; systems that differ in their parameters alone share it."""
    return NewtonCode(symbols, tableau, compensated, damped)


class NewtonCode(Rollouts):
    """Steps of an implicit method on a symbolic system, whose count is of Newton's iterations.

    The numbers of a column are h, the system's parameters, the time t0 of the run's beginning where H depends on it
    and, with friction, e^{γτ} at the stages and at the end of a step, then their reciprocals. What depends on t alone
    is computed once a step, for each stage, and follows them.

    Attributes
    ----------
    work : int
        About how many nanoseconds a step takes.
    """

    counted = True

    def __init__(self, symbols: SymbolicHamiltonian, tableau: Tableau, compensated: bool, damped: bool) -> None:
        self._symbols, self._tableau, self._compensated, self._damped = symbols, tableau, compensated, damped
        self._driven = symbols.time is not None
        self._parameters = len(symbols.parameters)
        self._nodes = stage_nodes(tableau)
        self.ndof, self.stages, n = symbols.ndof, len(tableau[1]), 2 * symbols.ndof
        self.unknowns = n * self.stages
        self._large = is_large(symbols)
        self._in_registers = not self._large and self.unknowns <= MOST_IN_REGISTERS
        self.lanes = 8 if self._in_registers else 1
        self.work = 4 * self.unknowns**3
        self.block = int(min(max(LONG / self.unknowns**3, 1), Rollouts.block))
        super().__init__(n * (1 + compensated), n)

    def __reduce__(self) -> tuple[Any, ...]:
        return newton_code, (self._symbols, self._tableau, self._compensated, self._damped)

    def check_memory(self) -> None:
        """Raise a MemoryError where the matrix of the equations has no room."""
        if self.unknowns > 1000:
            np.empty((self.unknowns, self._wide))

    @cached_property
    def size(self) -> int:
        damped = 2 * self.ndof * (self.stages + 1) if self._damped else 0
        return 1 + self._parameters + self._driven + damped

    def prepared(self, table: Columns) -> Columns:
        return table

    def made(self, name: str, width: int) -> Callable[..., None]:
        if name != "step":
            return super().made(name, width)
        # All numbers follow the states in their rows, which have the count behind them.
        n = self.n_out + 1
        return step_function(n, n, [0] * self.size, self.size, lambda *numbers: numbers, self.stage, width)

    def steps(self, y: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, int]:
        """One step from every row of `y` (N, 2d) by its own numbers (N, size); Newton's iterations in sum."""
        rows = np.concatenate([y, np.zeros((len(y), 1)), numbers], axis=1)
        out, nothing = np.empty((len(y), self.n_out + 1)), np.zeros((self.size, 1, 1))
        step = self.function("step", 1 if len(y) == 1 else self.lanes)
        arrays = nothing, rows[:, 0].copy(), rows, out
        table, x, rows_at, out_at = (a.ctypes.data for a in arrays)
        step(table, 1, 1, x, x, x, rows_at, len(y), out_at)
        return out[:, :-1].copy(), int(out[:, -1].sum())

    def stage(self, values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
        """One step: y, the errors of compensated sums, and the count of iterations."""
        code, n = values[0].code, self.n_out
        y, errors, count = values[:n], values[n:-1], values[-1]
        width = y[0].type.width
        column = [numbers(i) for i in range(self.size)]
        if self._driven:  # the time at which the step begins
            at = 1 + self._parameters
            column[at] = column[at] + code.splat(code.convert("sitofp", step, "double"), width) * column[0]
        iterate = self._iterate_in_registers if self._in_registers else self._iterate_in_memory
        changes, taken, lost = iterate(code, y, column)
        state, errors = self._advanced(y, errors, changes, column)
        nan = code.constant(float("nan"), y[0].type)
        return [*(code.select(lost, nan, x) for x in state), *errors, count + taken]

    def _advanced(
        self, y: Sequence[Value], errors: Sequence[Value], changes: Sequence[Value], column: Sequence[Value]
    ) -> tuple[list[Value], list[Value]]:
        """y plus its changes, by Kahan's compensated sum or with the decay of p."""
        if self._compensated:
            changes = [change - error for change, error in zip(changes, errors, strict=True)]
        state = [a + b for a, b in zip(y, changes, strict=True)]
        if self._compensated:
            errors = [(new - old) - change for new, old, change in zip(state, y, changes, strict=True)]
        if self._damped:
            decay = column[self.size - self.ndof :]
            state = [*state[: self.ndof], *(p * e for p, e in zip(state[self.ndof :], decay, strict=True))]
        return state, list(errors)

    # H ------------------------------------------------------------------------------------------------------------

    @cached_property
    def _lettered(self) -> tuple[sp.Expr, dict[sp.Symbol, sp.Expr]]:
        """H with letters for what depends on t and on parameters alone, and these."""
        found: dict[sp.Expr, sp.Symbol] = {}
        H, t = self._symbols.H, self._symbols.time
        if t is not None:
            H = letters_of_time(H, t, {*self._symbols.parameters}, found, "letter")
        return H, {s: f for f, s in found.items()}

    def _letters(self, t: Value, parameters: Sequence[Value]) -> list[Value]:
        """The letters at a time."""
        _, letters = self._lettered
        expressions, sampled = with_letters(list(letters.values()))
        of_time = evaluator({self._symbols.time: t, **dict(zip(self._symbols.parameters, parameters, strict=True))})
        values = [
            sampled_value(self._symbols.samples[each.name_of_samples], each.order, of_time(each.at)) for each in sampled
        ]
        inputs = (self._symbols.time, *self._symbols.parameters, *sampled.values())
        return [t.code.operand(x, t.type) for x in _recorded(expressions, inputs)(t, *parameters, *values)]

    @cached_property
    def _slopes(self) -> Program:
        """∇H and the upper triangle of ∇²H, row by row, from q, p, the parameters and the letters."""
        H, letters = self._lettered
        program = _recorded([H], (*self._symbols.q, *self._symbols.p, *self._symbols.parameters, *letters))
        y = program.inputs[: self.n_out]
        slope = gradient(program.outputs[0], y)
        rows = [gradient(x, y[i:]) for i, x in enumerate(slope)]
        return Program(program.inputs, [*slope, *(entry for row in rows for entry in row)])

    def _gradient_and_hessian(
        self, Y: Sequence[Any], column: Sequence[Any], stage: int
    ) -> tuple[list[Any], list[list[Any]]]:
        """∇H and ∇²H at a stage, with friction of [q, P] as the equations hold them."""
        d, n, letters = self.ndof, self.n_out, len(self._lettered[1])
        start = self.size + stage * letters
        given = [*column[1 : 1 + self._parameters], *column[start : start + letters]]
        if not self._damped:
            return self._square(self._slopes(*Y, *given))
        growths = column[self.size - 2 * d * (self.stages + 1) :]
        grown, shrunk = (growths[d * (i * (self.stages + 1) + stage) :][:d] for i in range(2))
        Y = [*Y[:d], *(P * e for P, e in zip(Y[d:], shrunk, strict=True))]
        g, S = self._square(self._slopes(*Y, *given))
        row, entry = [*grown, *[1.0] * d], [*[1.0] * d, *shrunk]
        g = [a * x for a, x in zip(row, g, strict=True)]
        return g, [[row[i] * S[i][j] * entry[j] for j in range(n)] for i in range(n)]

    def _square(self, outputs: list[Any]) -> tuple[list[Any], list[list[Any]]]:
        """∇H, and ∇²H of its upper triangle."""
        n = self.n_out
        g, rest = outputs[:n], iter(outputs[n:])
        S = [[0.0] * n for _ in range(n)]
        for i in range(n):
            for j in range(i, n):
                S[i][j] = S[j][i] = next(rest)
        return g, S

    # in registers -------------------------------------------------------------------------------------------------

    def _iteration(self, y: Sequence[Any], K: Sequence[Any], column: Sequence[Any], sizes: Sequence[Any]) -> list[Any]:
        """One of Newton's iterations: the new K, the relative size of the change, and the sizes of the variables."""
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
                size = where(size > 0.0, size, where(top > 0.0, top, 1.0))
                weights.append(1.0 / where(size < SMALLEST, SMALLEST, size))
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
        n, N, size = self.n_out, self.unknowns, self.size + self.stages * len(self._lettered[1])

        def first(*numbers: Any) -> list[Any]:
            return self._iteration(numbers[:n], [0.0] * N, numbers[n:], ())

        def other(*numbers: Any) -> list[Any]:
            y, column, K, sizes = (numbers[i:j] for i, j in pairwise([0, n, n + size, n + size + N, None]))
            return self._iteration(y, K, column, sizes)[: N + 1]

        names = [f"{letter}_{i}" for letter, m in (("y", n), ("c", size), ("K", N), ("w", n)) for i in range(m)]
        return traced(first, *names[: n + size]), traced(other, *names)

    def _iterate_in_registers(
        self, code: Code, y: Sequence[Value], column: Sequence[Value]
    ) -> tuple[list[Value], Value, Value]:
        """The changes of y, the iterations taken, and where they were in vain."""
        N, type = self.unknowns, y[0].type
        first, other = self._iterations
        if self._driven:
            parameters, (t, h) = column[1 : 1 + self._parameters], (column[1 + self._parameters], column[0])
            column = [*column, *(x for c in self._nodes for x in self._letters(t + c * h, parameters))]
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
        return self._changes([x.value for x in K]), taken.value, ~small.value

    def _changes(self, K: Sequence[Value]) -> list[Value]:
        """Σ B_i K_i."""
        B, n = self._tableau[1], self.n_out
        return [_total([b * K[i * n + m] for i, b in enumerate(B)]) for m in range(n)]

    # in memory ----------------------------------------------------------------------------------------------------

    @property
    def _wide(self) -> int:
        """Numbers of a row of the matrix: the last ones the residual, and what fills up registers."""
        return -(-(self.unknowns + 1) // ABREAST) * ABREAST

    def _iterate_in_memory(
        self, code: Code, y: Sequence[Value], column: Sequence[Value]
    ) -> tuple[list[Value], Value, Value]:
        """The changes of y, the iterations taken, and whether they were in vain."""
        n, N = self.n_out, self.unknowns
        letters = len(self._lettered[1])
        state, K, numbers = code.memory(n), code.memory(N), code.memory(self.size + self.stages * letters)
        M, Y, g, S, sizes = (code.memory(m) for m in (N * self._wide, n, n, n * n, N))
        for place, values in ((state, y), (numbers, column)):
            for i, x in enumerate(values):
                code.store(x, place, i)
        _fill(code, K, N)
        _fill(code, S, n * n)
        if letters:
            with code.over(self.stages) as i:
                t = column[1 + self._parameters] + code.load(code.array("nodes", self._nodes), i) * column[0]
                for k, x in enumerate(self._letters(t, column[1 : 1 + self._parameters])):
                    code.store(x, numbers, i * letters + (self.size + k))
        arguments = [state, K, numbers, M, Y, g, S, sizes]

        def iteration(values: list[Value]) -> tuple[Value, list[Value]]:
            before, taken, _ = values
            size = code.outlined("iteration", arguments, self._iterated, DOUBLE, rare=False)
            small = (size <= TOLERANCE) | ((size <= ROUNDING) & (0.5 * before <= size))
            taken = taken + 1.0
            return ~small & (size < np.inf) & (taken < MOST_ITERATIONS), [size, taken, small]

        start = [code.constant(np.inf), code.constant(0.0), code.constant(0, BOOL)]
        _, taken, small = code.repeat(start, iteration)
        return self._changes([code.load(K, i) for i in range(N)]), taken, ~small

    def _iterated(self, *arguments: Value) -> Value:
        """One of Newton's iterations in memory; the relative size of the change."""
        state, K, numbers, M, Y, g, S, sizes = arguments
        code, n, d, N, wide = K.code, self.n_out, self.ndof, self.unknowns, self._wide
        A, scale = code.array("A", np.ravel(self._tableau[0])), code.array("scale", self._tableau[2])
        h = code.load(numbers)
        with code.over(self.stages) as i:
            with code.over(n) as m:

                def moved(j: Value, values: list[Value], i: Value = i, m: Value = m) -> list[Value]:
                    return [values[0] + code.load(A, i * self.stages + j) * code.load(K, j * n + m)]

                code.store(code.loop(self.stages, [code.load(state, m)], moved)[0], Y, m)
            if self._damped:
                grown, shrunk = self._growths(code, numbers, i)
                with code.over(d) as m:
                    code.store(code.load(Y, m + d) * code.load(shrunk, m), Y, m + d)
            self._fill_slopes(code, numbers, Y, g, S, i)
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
                for k in range(N + 1, wide):
                    code.store(code.constant(0.0), row, k)
                with code.over(self.stages) as j:
                    entry = -(signed * code.load(A, i * self.stages + j))
                    type = Type("double", ABREAST if n % ABREAST == 0 else 2)
                    with code.over(n // type.width) as k:
                        entries = entry * code.load(S, other * n + k * type.width, type)
                        code.store(entries, row, j * n + k * type.width)
                code.store(code.load(row, unknown) + 1.0, row, unknown)
        self._fill_sizes(code, state, K, M, sizes)
        code.outlined("solve", [M, sizes], self._solve, rare=False)
        with code.over(N) as i:
            code.store(code.load(K, i) - code.load(M, i * wide + N), K, i)
        return self._relative_size_in_memory(code, state, K, M)

    def _growths(self, code: Code, numbers: Value, i: Value) -> tuple[Value, Value]:
        """The places of e^{γτ} of a stage, and of their reciprocals."""
        d, start = self.ndof, self.size - 2 * self.ndof * (self.stages + 1)
        return code.at(numbers, i * d + start), code.at(numbers, (i + self.stages + 1) * d + start)

    def _fill_slopes(self, code: Code, numbers: Value, Y: Value, g: Value, S: Value, i: Value) -> None:
        """∇H into g and ∇²H into S, of a stage."""
        n, letters = self.n_out, len(self._lettered[1])
        given = [code.load(numbers, 1 + k) for k in range(self._parameters)]
        given += [code.load(numbers, i * letters + (self.size + k)) for k in range(letters)]
        if self._large:
            self._add_terms(code, given, Y, g, S)
            return
        slope, hessian = self._square(self._slopes(*(code.load(Y, m) for m in range(n)), *given))
        for m, x in enumerate(slope):
            code.store(code.operand(x, DOUBLE), g, m)
        for j, row in enumerate(hessian):
            for k, x in enumerate(row):
                if not _is_zero(x):
                    code.store(code.operand(x, DOUBLE), S, j * n + k)

    def _add_terms(self, code: Code, given: Sequence[Value], Y: Value, g: Value, S: Value) -> None:
        """The same by a loop over the terms of each kind."""
        n, symbols, (H, letters) = self.n_out, self._symbols, self._lettered
        _fill(code, g, n)
        _fill(code, S, n * n)
        for number, family in enumerate(families(H, (*symbols.q, *symbols.p))):
            coordinates = code.array(f"coordinates_{number}", family.coordinates.ravel(), INT)
            constants = code.array(f"constants_{number}", family.constants.ravel())
            program = _recorded([family.f], (*family.x, *family.c, *symbols.parameters, *letters))
            x = program.inputs[: len(family.x)]
            slope = gradient(program.outputs[0], x)
            both = Program(program.inputs, [*slope, *(entry for s in slope for entry in gradient(s, x))])
            with code.over(len(family.coordinates)) as term:
                places = [code.load(coordinates, term * len(x) + j, INT) for j in range(len(x))]
                values = [code.load(Y, place) for place in places]
                values += [code.load(constants, term * len(family.c) + j) for j in range(len(family.c))]
                outputs = iter(both(*values, *given))
                targets = [(g, place) for place in places] + [
                    (S, row * n + column) for row in places for column in places
                ]
                for target, place in targets:
                    value = next(outputs)
                    if not _is_zero(value):
                        code.store(code.load(target, place) + value, target, place)

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
                with code.given(~code.apply("eq", (factor, 0.0))):
                    with code.over((wide // ABREAST) - start) as j:
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
            with code.over(k) as i:
                other = code.at(M, i * wide)
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
            if _is_zero(rows[i][k]):
                continue
            better = abs(rows[i][k]) * rows[i][-1] > abs(rows[k][k]) * rows[k][-1]
            for j in range(k, n + 2):
                a, b = rows[k][j], rows[i][j]
                rows[k][j], rows[i][j] = where(better, b, a), where(better, a, b)
        inverse = 1.0 / rows[k][k]
        for row in rows[k + 1 :]:
            if _is_zero(row[k]):
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


def _recorded(expressions: Sequence[sp.Expr], inputs: Sequence[sp.Symbol]) -> Program:
    """Expressions as a program of symbols."""

    def values(*numbers: Any) -> list[Any]:
        return list(map(evaluator(dict(zip(inputs, numbers, strict=True))), expressions))

    return traced(values, *(s.name for s in inputs))


def _total(terms: Sequence[Any]) -> Any:
    total: Any = 0.0
    for x in terms:
        total = x if _is_zero(total) else total + x
    return total


def _larger(a: Any, b: Any) -> Any:
    return where(a < b, b, a)


def _largest(values: Sequence[Any]) -> Any:
    """The largest absolute value."""
    moving = [abs(x) for x in values if not _is_zero(x)]
    return reduce(_larger, moving) if moving else 0.0


def _is_zero(x: Any) -> bool:
    return isinstance(x, float) and x == 0.0


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
