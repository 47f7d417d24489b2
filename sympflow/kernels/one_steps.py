"""Methods of one stage a step: their columns are the step length, parameters and the time; runs and single steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from sympflow.compiler.control import INT, Code, Value
from sympflow.compiler.program import Program, traced
from sympflow.hamiltonian.driving import with_letters
from sympflow.hamiltonian.recorded import check_recorded, evaluator
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian
from sympflow.kernels.protocol import Kernel, Run, Steps, Task, run_states
from sympflow.kernels.rollouts import Columns, Rollouts
from sympflow.kernels.runs import Numbers, step_function
from sympflow.kernels.samples import check_samples, sampled_value
from sympflow.kernels.stage_times import letters_of_time
from sympflow.kernels.terms import Family
from sympflow.kernels.threads import given

__all__ = ["Lettered", "OneStep", "OneStepKernel", "add_terms", "recorded"]


def recorded(expressions: Sequence[sp.Expr], inputs: Sequence[sp.Symbol]) -> Program:
    """Expressions as a program of symbols."""

    def values(*numbers: Any) -> list[Any]:
        return list(map(evaluator(dict(zip(inputs, numbers, strict=True))), expressions))

    return traced(values, *(s.name for s in inputs))


class Lettered:
    """Expressions of a symbolic system with letters for what depends on the time and on parameters alone.

    Parameters
    ----------
    symbols : SymbolicHamiltonian
    expressions : sequence of Expr
        In its symbols.

    Attributes
    ----------
    expressions : list of Expr
        In q, p, the parameters and the letters: the `given` symbols.
    letters : dict of Symbol to Expr

    Raises
    ------
    ValueError
        If a function in them has no compiled form.
    """

    def __init__(self, symbols: SymbolicHamiltonian, expressions: Sequence[sp.Expr]) -> None:
        for samples in symbols.samples.values():
            check_samples(samples)
        for f in with_letters(list(expressions))[0]:
            check_recorded(f)
        found: dict[sp.Expr, sp.Symbol] = {}
        time, fixed = symbols.time, {*symbols.parameters}
        self.expressions = list(expressions)
        if time is not None:
            self.expressions = [letters_of_time(f, time, fixed, found, "letter") for f in expressions]
        self.symbols, self.letters = symbols, {s: f for f, s in found.items()}
        self.given = (*symbols.parameters, *self.letters)

    def at(self, t: Value, parameters: Sequence[Value]) -> list[Value]:
        """The letters at times t."""
        symbols = self.symbols
        expressions, sampled = with_letters(list(self.letters.values()))
        of_time = evaluator({symbols.time: t, **dict(zip(symbols.parameters, parameters, strict=True))})
        values = [sampled_value(symbols.samples[f.name_of_samples], f.order, of_time(f.at)) for f in sampled]
        program = recorded(expressions, (symbols.time, *symbols.parameters, *sampled.values()))
        return [t.code.operand(x, t.type) for x in program(t, *parameters, *values)]


def add_terms(
    family: Family,
    data: Sequence[Value],
    values: Program,
    y: Value,
    given: Sequence[Value],
    targets: Callable[[list[Value]], list[tuple[Value, Value]]],
) -> None:
    """Add the values of each term of a kind, of its coordinates, constants and the given numbers, in a loop.

    Parameters
    ----------
    data : two addresses
        Of the family's coordinates and constants.
    y : Value
        The address of the state.
    targets : callable
        From the places of a term's coordinates to those of its values: addresses and indices.
    """
    (coordinates, constants), code, k, n = data, y.code, len(family.x), len(family.c)
    with code.over(len(family.coordinates)) as term:
        places = [code.load(coordinates, term * k + j, INT) for j in range(k)]
        numbers = [code.load(y, place) for place in places]
        numbers += [code.load(constants, term * n + j) for j in range(n)]
        for (target, place), x in zip(targets(places), values(*numbers, *given), strict=True):
            if not (isinstance(x, float) and x == 0):
                code.store(code.load(target, place) + x, target, place)


class OneStep(Rollouts):
    """The stage of a method that is a whole step.

    The numbers of a column are h, the system's parameters, the time t0 of the run's beginning where H depends on it,
    and what a method adds.

    Attributes
    ----------
    lettered : Lettered
    driven : bool
    work : float
        About how many nanoseconds a step takes.
    """

    closing = False
    work: float

    def __init__(self, lettered: Lettered, n_values: int, more: int = 0) -> None:
        symbols = lettered.symbols
        self.lettered, self.driven, self.ndof = lettered, symbols.time is not None, symbols.ndof
        self.parameters = len(symbols.parameters)
        self.size = 1 + self.parameters + self.driven + more
        super().__init__(n_values, 2 * symbols.ndof)

    def prepared(self, table: Columns) -> Columns:
        return table

    def made(self, name: str, width: int) -> Callable[..., None]:
        if name != "step":
            return super().made(name, width)
        # All numbers follow the states in their rows, which have the count behind them.
        n, size = self.n_out + self.counted, self.size
        return step_function(n, n, [0] * size, size, lambda _, *numbers: numbers, self.stage, width, self.place)

    def steps(self, y: np.ndarray, numbers: np.ndarray) -> Steps:
        """One step from every row of `y` (N, 2d) by its own numbers (N, size)."""
        n = self.n_out + self.counted
        rows = np.concatenate([y, np.zeros((len(y), int(self.counted))), numbers], axis=1)
        out, nothing, h = np.empty((len(y), n)), np.zeros((self.size, 1, 1)), np.zeros(len(y))
        width = self.lanes if len(y) >= self.fewest else 1
        self.call("step", width, nothing, 1, 1, h, h, h, rows, len(y), out, n_out=n)
        return Steps(out[:, : self.n_out].copy(), int(out[:, -1].sum())) if self.counted else Steps(out)

    def column(self, code: Code, numbers: Numbers, step: Value) -> list[Value]:
        """The numbers of a column, with the time at which the step begins."""
        column = [numbers(i) for i in range(self.size)]
        if self.driven:
            at, width = 1 + self.parameters, column[0].type.width
            column[at] = column[at] + code.splat(code.convert("sitofp", step, "double"), width) * column[0]
        return column

    def letters_at(self, column: Sequence[Value], node: Any) -> list[Value]:
        """The letters at a time in the step, a node or the value of one."""
        if not self.driven:
            return []
        at = 1 + self.parameters
        return self.lettered.at(column[at] + node * column[0], column[1:at])


class OneStepKernel(Kernel):
    """Compiled loops of a method of one stage a step on one system, a `Kernel`.

    Parameters
    ----------
    code, single : OneStep
        Of runs, and of single steps.
    more : callable, optional
        What the method adds to the numbers of steps of lengths h (n,): (n, k).
    """

    def __init__(self, code: OneStep, single: OneStep, more: Callable[[np.ndarray], np.ndarray] | None = None) -> None:
        self._code, self._single, self._more = code, single, more

    def _numbers(self, h: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The numbers (n, size) of steps of lengths h (n,), at the times t (n,) less those of whole steps before."""
        values = self._code.lettered.symbols.values
        numbers = [h[:, None], np.array([values]).repeat(len(h), axis=0)]
        if self._code.driven:
            numbers.append(t[:, None])
        if self._more is not None:
            numbers.append(self._more(h))
        return np.concatenate(numbers, axis=1)

    def runs(self, task: Task) -> Run:
        code, numbers = self._code, self._numbers(np.array([task.h]), np.array([task.t0]))
        columns = np.repeat(numbers, 3, axis=0), np.zeros(3, dtype=np.int64)
        rollout = partial(code.run, columns, closed=False)
        return run_states(rollout, task, code.n_values - code.counted, code.work, counts=code.counted)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,): see `Kernel`."""
        y = given(y)
        h, t = (given(np.broadcast_to(x, y.shape[:1])) for x in (h, t))
        return self._single.steps(y, self._numbers(h, t))
