"""Methods of one stage a step: their columns are the step length, parameters and the time; runs and single steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.compiler import NotCompiled
from sympflow.compiler.control import Code, Value
from sympflow.hamiltonian.formulas import MOST_COMPILED, TracedCoefficients, TracedHamiltonian
from sympflow.kernels.protocol import Kernel, Run, Steps, Task, run_states
from sympflow.kernels.rollouts import Columns, Rollouts, shared
from sympflow.kernels.runs import Numbers, step_function
from sympflow.kernels.threads import given

if TYPE_CHECKING:
    from sympflow.kernels.reverse import Recorded
    from sympflow.kernels.terms import Terms

__all__ = [
    "Lettered",
    "OneStep",
    "OneStepKernel",
    "check_size",
    "is_large",
    "lettered",
    "parametric",
    "shared_code",
    "spelled",
    "terms_of",
]


Lettered = Any
"""Expressions with coefficients for what depends on the time alone: of symbols, or of functions that were traced."""


def lettered(form: Any, expressions: Sequence[Any]) -> Lettered:
    """Expressions of a form with coefficients; a ValueError names a function in them that has no compiled form."""
    if isinstance(form, TracedHamiltonian):
        check_size(form)
        return TracedCoefficients(form, expressions)
    from sympflow.kernels.stage_times import SymbolicCoefficients

    return SymbolicCoefficients(form, expressions)


def is_large(form: Any) -> bool:
    """True of a system whose terms are better looped over than written out."""
    if isinstance(form, TracedHamiltonian):
        return False
    from sympflow.kernels.terms import is_large

    return is_large(form.structure)


def spelled(system: Any, names: tuple[str, ...]) -> Any:
    """The form of a system; that with numbers that torch follows, where it has `names` for these; or None."""
    return system.spelled if not names or system.spelled is not None else system.numbered


def parametric(form: Any, names: tuple[str, ...]) -> Any:
    """A form whose parameters are numbers of columns: those with these names, whatever their values, or as they may."""
    if names:
        return form.named(names)
    return form if is_large(form) else form.parametric


def shared_code(form: Any, key: Any, make: Callable[[], Any]) -> Any:
    """The code of a form, the same for all values of its parameters."""
    if not form.parameters or form.time is not None:
        return make()
    return shared((form.H, form.parameters, form.q, form.p, key), make)


def terms_of(lettered: Lettered) -> Terms:
    """The terms of the first expression, of a large system."""
    from sympflow.kernels.terms import Terms

    symbols = lettered.symbols
    return Terms(lettered.expressions[0], (*symbols.q, *symbols.p), lettered.given)


def check_size(form: TracedHamiltonian) -> None:
    """Refuse a traced function that would take long to compile, by a ValueError."""
    if form.size > MOST_COMPILED:
        raise NotCompiled(
            f"`system` has {form.size:,} operations in its gradient, more than {MOST_COMPILED:,}, which are not "
            "compiled: write it with HamiltonianSystem.from_sympy, lattice or pairs, or use backend='array'."
        )


class OneStep(Rollouts):
    """The stage of a method that is a whole step, about `work` nanoseconds.

    A column is h, the system's parameters, the time t0 where H depends on it, and what a method adds.
    """

    closing = False
    reversible = False  # there is `adjoint`, see `sympflow.kernels.runs.Adjoint`
    work: float

    def __init__(self, lettered: Lettered, n_values: int, more: int = 0) -> None:
        symbols = lettered.symbols
        self.lettered, self.driven, self.ndof = lettered, symbols.time is not None, symbols.ndof
        self.parameters = len(symbols.parameters)
        self.size = 1 + self.parameters + self.driven + more
        self.given = self.own = self.parameters
        super().__init__(n_values, 2 * symbols.ndof)

    def check_reverse(self) -> None:
        if not self.reversible:
            super().check_reverse()

    def of_values(self, given: Sequence[Value], cotangents: Sequence[Value], kind: Value) -> Sequence[Value]:
        return cotangents[1 : 1 + self.own]

    def own_entries(self, table: Columns, values: np.ndarray) -> Columns:
        """The columns of trajectories with their own values of the parameters."""
        entries = np.repeat(table[0][None], len(values), axis=0)
        entries[:, :, 1 : 1 + self.parameters] = values[:, None]
        return entries, table[1]

    def step_made(self, width: int, own: bool) -> Callable[..., None]:
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
        return self.begun([numbers(i) for i in range(self.size)], code.convert("sitofp", step, "double"))

    def begun(self, column: Sequence[Any], step: Any) -> list[Any]:
        """The same, of the numbers of a column and after how many steps."""
        column, at = list(column), 1 + self.parameters
        if self.driven:
            column[at] = column[at] + step * column[0]
        return column

    def coefficients_at(self, column: Sequence[Any], node: Any) -> list[Any]:
        """The coefficients at a time in the step, a node or the value of one."""
        if not self.driven:
            return []
        at = 1 + self.parameters
        return self.lettered.at(column[at] + node * column[0], column[1:at])


class OneStepKernel(Kernel):
    """Compiled loops of a method of one stage a step: the code of runs, and that of single steps.

    Parameters have `values` (m,), or each trajectory has `own` ones (N, m); ``more(h)`` (n, k) are numbers that a
    method adds to steps h (n,).
    """

    def __init__(
        self,
        code: OneStep,
        single: OneStep,
        values: Sequence[float],
        more: Callable[[np.ndarray], np.ndarray] | None = None,
        own: np.ndarray | None = None,
    ) -> None:
        self._code, self._single, self._values, self._more, self._own = code, single, values, more, own

    def varied(self, values: np.ndarray) -> OneStepKernel:
        """The loops of batches whose trajectories have these values (m, N)."""
        own = np.ascontiguousarray(values.T, dtype=np.float64)
        return OneStepKernel(self._code, self._single, self._values, self._more, own)

    def _numbers(self, h: np.ndarray, t: np.ndarray) -> np.ndarray:
        """The numbers (n, size) of steps of lengths h (n,), at the times t (n,) less those of whole steps before."""
        values = np.array([self._values]) if self._own is None else self._own
        numbers = [h[:, None], values[np.arange(len(h)) % len(values)]]
        if self._code.driven:
            numbers.append(t[:, None])
        if self._more is not None:
            numbers.append(self._more(h))
        return np.concatenate(numbers, axis=1)

    def _columns(self, task: Task) -> Columns:
        numbers = self._numbers(np.array([task.h]), np.array([task.t0]))
        return np.repeat(numbers, 3, axis=0), np.zeros(3, dtype=np.int64)

    def check_reverse(self) -> None:
        self._code.check_reverse()

    def recorded(self, task: Task) -> Recorded:
        """`runs`, as a run whose cotangents can be pulled back: after `check_reverse`."""
        from sympflow.kernels.reverse import Recorded

        y0 = task.y0 if self._own is None else np.concatenate([task.y0, self._own], axis=1)
        return Recorded(self._code, self._columns(task), y0, task.n_steps, task.save, self._code.work)

    def runs(self, task: Task) -> Run:
        code = self._code
        rollout = partial(code.run, self._columns(task), closed=False)
        return run_states(rollout, task, code.n_values - code.counted, code.work, counts=code.counted)

    def step(self, h: ArrayLike, y: np.ndarray, t: ArrayLike = 0.0) -> Steps:
        """One step from each row of `y` (N, 2d), each of its own length `h` (N,): see `Kernel`."""
        y = given(y)
        h, t = (given(np.broadcast_to(x, y.shape[:1])) for x in (h, t))
        return self._single.steps(y, self._numbers(h, t))
