"""Kicks and drifts of a symbolic system as stages over traced numbers, and the compiled functions of any scheme.

A kick is p − b∇V + g∇²V v − c∇(½ v·∇²V v) with v = M⁻¹∇V, or p − b∇V − Σ_m e_m ∇q^m; the drift after it q + a∇T.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from sympflow.compiler.arrange import Arrangement
from sympflow.compiler.control import Type, Value, assign
from sympflow.compiler.functions import FUNCTIONS, added, dot, is_zero, times
from sympflow.compiler.program import Program, Traced, adjoint, derivatives, gradient, traced
from sympflow.hamiltonian.formulas import evaluator
from sympflow.hamiltonian.monomials import Monomials
from sympflow.kernels.rollouts import Columns, SplittingRollouts
from sympflow.kernels.runs import Numbers, Room, step_function
from sympflow.kernels.stages import Kick, kick_of
from sympflow.lazy import lately_kept
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

if TYPE_CHECKING:
    from sympflow.hamiltonian.formulas import TracedDriving
    from sympflow.kernels.approximations import OnInterval, Ranges
    from sympflow.kernels.stage_times import Driving

__all__ = ["Shape", "Splitting", "SplittingCode", "WithinRange"]

LONG = 64  # operations of a stage, beyond which products of sums may better be left
CLOCK = 3  # numbers of the time in a column
EARLY = -4  # when momenta are known before the positions, in cycles


class Formulas(Protocol):
    """V and T with their coefficients: a SymbolicHamiltonian, a TracedHamiltonian, or `FewSymbols` of a few bodies."""

    ndof: int
    samples: Mapping[str, Any]

    @property
    def H(self) -> Any: ...
    @property
    def V(self) -> Any: ...
    @property
    def T(self) -> Any: ...
    @property
    def q(self) -> tuple[Any, ...]: ...
    @property
    def p(self) -> tuple[Any, ...]: ...
    @property
    def parameters(self) -> tuple[Any, ...]: ...
    @property
    def values(self) -> tuple[float, ...]: ...
    @property
    def inverse_mass(self) -> Any: ...


@dataclass(frozen=True)
class Splitting:
    """The kicks and drifts of one separable system, of a level, with what else they have.

    `friction` are the dimensions of Γ; of a driven system `symbols` have coefficients for what depends on the time. In
    `ranges` of one position kicks are polynomials, equal but for rounding; parameters are then in V, else numbers of a
    table.
    """

    symbols: Formulas
    level: int
    monomials: Monomials = ()
    compensated: bool = False
    friction: int | None = None
    driving: Driving | TracedDriving | None = None
    ranges: Ranges = ()

    @property
    def key(self) -> tuple[Any, ...]:
        """Same for systems that share their code: those that differ in the values of parameters alone."""
        of_system = self.symbols.H, self.symbols.parameters, self.symbols.q, self.symbols.p
        driving = None if self.driving is None else self.driving.key
        return *of_system, self.level, self.monomials, self.compensated, self.friction, driving, self.ranges

    @property
    def ndof(self) -> int:
        return self.symbols.ndof

    @property
    def parameters(self) -> Sequence[Any]:
        """Coefficients whose values are numbers of a table, or made of the time."""
        return self.symbols.parameters

    @property
    def own(self) -> int:
        """How many of them each trajectory may have of its own."""
        return len(self.symbols.values if self.timed else self.parameters)

    @property
    def timed(self) -> bool:
        return self.driving is not None

    def values_at(self, time: Any, length: Any, fixed: Sequence[Any]) -> list[Any]:
        """The coefficients at a time, of a driven system: see `Driving`."""
        assert self.driving is not None
        return self.driving.values_at(time, length, fixed)

    @property
    def polynomial(self) -> bool:
        """True if stages are sums and products alone."""
        symbols = self.symbols
        V, T = symbols.V, symbols.T
        return bool(V is not None and T is not None and V.is_polynomial(*symbols.q) and T.is_polynomial(*symbols.p))

    @property
    def full_kick(self) -> Kick:
        return kick_of(self.level, len(self.monomials))

    @property
    def kick_numbers(self) -> tuple[str, ...]:
        return self.full_kick.numbers

    @property
    def numbers(self) -> list[str]:
        """The names of the numbers of a column that are given, in the order of a table's rows."""
        d = self.ndof
        damped = 0 if self.friction is None else d**self.friction
        of_friction = [f"{name}_{i}" for name in ("mean", "decay") for i in range(damped)]
        return ["a", *self.kick_numbers, *of_friction, *(s.name for s in self.parameters)]

    @property
    def terms(self) -> list[int]:
        """Terms of the kicks of each kind of stage: one, two, …; a polynomial has all of its own."""
        return [1, 2, 3][: 1 + {FORCE_GRADIENT: 1, CURVATURE: 2}.get(self.level, 0)]

    def kick(self, terms: int, slopes: bool = False) -> Program:
        """The change of p by a kick, from q, its numbers and the parameters; its slopes, row by row to the diagonal."""
        symbols, n = self.symbols, self.symbols.ndof
        names = [*(s.name for s in symbols.q), *self.kick_numbers, *(s.name for s in symbols.parameters)]

        def changes(*numbers: Any) -> list[Any]:
            q, kicks, values = numbers[:n], numbers[n:][: len(self.kick_numbers)], numbers[n + len(self.kick_numbers) :]
            known = evaluator(dict(zip((*symbols.q, *symbols.parameters), (*q, *values), strict=True)))
            found = _kick_changes(symbols, q, kicks, known, terms, self.monomials)
            return [*found, *(x for i, y in enumerate(found if slopes else ()) for x in gradient(y, q)[: i + 1])]

        return traced(changes, *names)

    def kinds(self) -> Sequence[Stage | WithinRange]:
        """The stages, those with the fewest terms first."""
        return [self._within_range(terms) if self.ranges else self._arranged(terms) for terms in self.terms]

    @property
    def cycles(self) -> float:
        """About how long a single trajectory takes for a stage with all terms, in cycles."""
        stage = self.kinds()[-1]
        body = stage.near.body if isinstance(stage, WithinRange) else stage.body
        known: dict[int, int] = {}
        for x in body.operations:
            ready = max((known.get(a.order, 0) for a in x.args if isinstance(a, Traced)), default=0)
            known[x.order] = ready + FUNCTIONS[x.name].cost
        return max(known.values(), default=0) + len(body) / 2

    def _within_range(self, terms: int) -> Stage | WithinRange:
        """The stage as a polynomial in its range, if there is one."""
        from sympflow.kernels.approximations import on_interval

        near = on_interval(_of_kick(self.symbols, terms), *self.ranges[0])
        if near is None:
            return self._arranged(terms)
        arranged = NearShape(self, terms, near).arranged()[1]
        return WithinRange(arranged, self._arranged(terms), near.low, near.high)

    def _arranged(self, terms: int) -> Stage:
        """The stage as a program: products of sums multiplied out, or where that makes it long, the better shape."""
        cost, shape = Shape(self, terms, True).arranged()
        if terms > 1 and len(shape.body) > LONG:
            other_cost, other = Shape(self, terms, False).arranged()
            return shape if cost <= other_cost else other
        return shape


class Stage(NamedTuple):
    """A kick and a drift as programs: see `Arranged`; `plain`, equal up to rounding, is the one to differentiate."""

    table: Program
    body: Program
    plain: Program


class Shape:
    """One way to write a stage: products of sums multiplied out, or left."""

    def __init__(self, splitting: Splitting, terms: int, expand: bool) -> None:
        symbols = splitting.symbols
        self.splitting, self.symbols, self.terms, self.d = splitting, symbols, terms, symbols.ndof
        names = [(s.name, 0) for s in symbols.q] + [(s.name, EARLY) for s in symbols.p]
        errors = [(f"error_{name}", EARLY) for name, _ in names if splitting.compensated]
        self.made = made = Arrangement([*names, *errors], splitting.numbers, expand)
        self.q, self.p, self.more = made.states[: self.d], made.states[self.d : 2 * self.d], made.states[2 * self.d :]
        self.number = dict(zip(splitting.numbers, made.constants, strict=True))
        self.values = [self.number[s.name] for s in symbols.parameters]
        self.plain: list[Any] = []

    def arranged(self) -> tuple[int, Stage]:
        """The cost of the stage, and its programs."""
        made, d = self.made, self.d
        errors: list[Any] = []
        if self.splitting.compensated:
            changes = [made.written(x) for x in self._changes()]
            momenta, errors_p = self._compensated(self.p, changes, self.more[d:])
            moves = [made.written(x) for x in self._velocity(momenta, self.number["a"])]
            positions, errors_q = self._compensated(self.q, moves, self.more[:d])
            errors = [*errors_q, *errors_p]
        else:
            positions, momenta = self._drifted(self._kicked())
        outputs = [*positions, *momenta, *errors]
        table, body = made.finish(outputs)
        plain = Program(body.inputs, [*self.plain, *momenta, *errors]) if self.plain else body
        return 2 * max(made.depth(x) for x in outputs) + 3 * len(body), Stage(table, body, plain)

    def _kicked(self) -> list[Any]:
        """The momenta after a kick, numbers of the body."""
        return [self.made.written(p + x) for p, x in zip(self.p, self._changes(), strict=True)]

    def _changes(self) -> list[Any]:
        """The change of p by a kick."""
        return [self.made.number(x) for x in self._by_kick(self.splitting.kick(self.terms))]

    def _by_kick(self, program: Program) -> list[Any]:
        """The outputs of a program of positions, the numbers of a kick, and the parameters."""
        return program(*self.q, *(self.number[name] for name in self.splitting.kick_numbers), *self.values)

    def _by_mass(self, v: Sequence[Any]) -> list[Any]:
        """M⁻¹v."""
        M, entry = self.symbols.inverse_mass, self._of_parameters
        return [dot([entry(M[i, j]) for j in range(self.d)], v) for i in range(self.d)]

    def _of_parameters(self, f: Any) -> Any:
        return evaluator(dict(zip(self.symbols.parameters, self.values, strict=True)))(f)

    def _velocity(self, momenta: Sequence[Any], a: Any) -> list[Any]:
        """a∇T of momenta, numbers of the body."""
        p = [self.made.letter(x) for x in momenta]
        if self.symbols.inverse_mass is not None:
            return [self.made.number(a * x) for x in self._by_mass(p)]
        numbers = zip((*self.symbols.p, *self.symbols.parameters), (*p, *self.values), strict=True)
        kinetic = evaluator(dict(numbers))
        return [self.made.number(a * kinetic(self.symbols.T.diff(s))) for s in self.symbols.p]

    def _drifted(self, momenta: list[Any]) -> tuple[list[Any], list[Any]]:
        """Positions and momenta after the drift."""
        made, M, d = self.made, self.symbols.inverse_mass, self.d
        if self.splitting.friction is not None:
            mean, end = (self._damped(name, momenta) for name in ("mean", "decay"))
            moves = self._velocity([made.written(x) for x in mean], 1.0)
            return [made.written(q + x) for q, x in zip(self.q, moves, strict=True)], [made.written(x) for x in end]
        if M is None:
            moves = self._velocity(momenta, self.number["a"])
            return [made.written(q + x) for q, x in zip(self.q, moves, strict=True)], momenta
        rows = [[M[i, j] for j in range(d)] for i in range(d)]
        entries = [[times(self.number["a"], self._of_parameters(x)) if x != 0 else 0.0 for x in row] for row in rows]
        return self._displaced([[made.written(made.number(x)) for x in row] for row in entries], momenta), momenta

    def _displaced(self, factors: Sequence[Sequence[Any]], momenta: Sequence[Any]) -> list[Any]:
        """q + A p, numbers of the body for each."""
        made, positions = self.made, [self.made.node(q) for q in self.q]
        self.plain = [*positions]
        for i, row in enumerate(factors):
            for factor, p in zip(row, momenta, strict=True):
                if not is_zero(factor):
                    positions[i] = made.moved(positions[i], factor, p)
                    self.plain[i] = made.operation("fma", factor, p, self.plain[i])
        return positions

    def _damped(self, name: str, momenta: Sequence[Any]) -> list[Any]:
        """One of the two linear maps of a drift with friction."""
        p = [self.made.letter(x) for x in momenta]
        return [self.made.number(dot(row, p)) for row in self._friction(name)]

    def _friction(self, name: str) -> list[list[Any]]:
        """One of these maps as a matrix."""
        d, numbers = self.d, [x for key, x in self.number.items() if key.startswith(f"{name}_")]
        if self.splitting.friction == 2:
            return [numbers[i * d :][:d] for i in range(d)]
        return [[numbers[i if self.splitting.friction else 0] if i == j else 0.0 for j in range(d)] for i in range(d)]

    def _compensated(
        self, x: Sequence[Any], changes: Sequence[Any], errors: Sequence[Any]
    ) -> tuple[list[Any], list[Any]]:
        """x + change by Kahan's compensated sum, and the new errors."""
        op, node = self.made.operation, self.made.node
        pairs = zip(map(node, x), changes, map(node, errors), strict=True)
        sums, left = zip(*(added(value, op("sub", change, error), op) for value, change, error in pairs), strict=True)
        return list(sums), list(left)


class NearShape(Shape):
    """A stage of one position whose kick is a polynomial on an interval, with coefficients in the table."""

    def __init__(self, splitting: Splitting, terms: int, near: OnInterval) -> None:
        super().__init__(splitting, terms, True)
        self._near = near

    def _changes(self) -> list[Any]:
        made, near = self.made, self._near
        factors = [self.number[name] for name in self.splitting.kick_numbers[: self.terms]]
        x = self.q[0] if near.center == 0 else made.letter(made.written(self.q[0] - near.center))
        total = made.number(0.0)
        for k, column in enumerate(near.coefficients.T.tolist()):
            for sign, factor, c in zip((-1.0, 1.0, -1.0), factors, column, strict=False):
                total = total + (sign * c) * factor * x**k
        return [total]


class WithinRange:
    """A stage in two ways: as a polynomial for positions in a range, exact for others; the same for all lanes."""

    def __init__(self, near: Stage, exact: Stage, low: float, high: float) -> None:
        self.near, self._exact, self._low, self._high = near, exact, low, high
        inputs = near.table.inputs
        self.table = traced(lambda *x: [*near.table(*x), *exact.table(*x)], *map(repr, inputs))

    def body(self, q: Value, *rest: Value) -> list[Value]:
        """The state after the stage."""
        n, code = len(self.near.body.inputs) - len(self.near.table.outputs) - 1, q.code
        state, column = (q, *rest[:n]), rest[n:]
        here = len(self.near.table.outputs)
        inside = (self._low <= q) & (q <= self._high)
        near = self.near.body(*state, *column[:here])

        def exact() -> list[Value]:
            values = self._exact.body(*state, *column[here:])
            return [code.select(inside, x, y) for x, y in zip(near, values, strict=True)]

        return code.when(code.any(~inside), exact, lambda: near, rare=True)

    def plain(self, *numbers: Any) -> list[Any]:
        """The exact state after the stage."""
        here, n = len(self.near.table.outputs), len(numbers) - len(self.table.outputs)
        return self._exact.plain(*numbers[:n], *numbers[n + here :])


def _of_kick(symbols: Any, terms: int) -> Program:
    """V′, V″M⁻¹V′ and (½ V′M⁻¹V″M⁻¹V′)′ of one position, as many as there are terms."""

    def values(q: Traced) -> list[Any]:
        known = evaluator({symbols.q[0]: q})
        (slope,) = gradient(known(symbols.V), [q])
        if terms == 1 or symbols.inverse_mass is None:
            return [slope]
        v = known(symbols.inverse_mass[0, 0]) * slope
        product = gradient(slope, [q])[0] * v
        return [slope, product, *gradient(v * product * 0.5, [q])][:terms]

    return traced(values, symbols.q[0].name)


def _kick_changes(
    symbols: Any, q: Sequence[Any], kicks: Sequence[Any], known: Any, terms: int, monomials: Monomials
) -> list[Any]:
    """The change of p by a kick of so many terms, of recorded numbers; `known` evaluates expressions."""
    slope, M, d = gradient(known(symbols.V), q), symbols.inverse_mass, len(q)
    changes = [-times(kicks[0], x) for x in slope]

    def by_mass(v: Sequence[Any]) -> list[Any]:
        return [dot([known(M[i, j]) for j in range(d)], v) for i in range(d)]

    if terms > 1:
        hessian, v = derivatives(slope, q), by_mass(slope)
        product = [dot(row, v) for row in hessian]
        changes = [x + times(kicks[1], y) for x, y in zip(changes, product, strict=True)]
    if terms > 2:
        again = [dot(row, by_mass(product)) for row in hessian]
        third = [dot([dot(row, v) for row in derivatives(rows, q)], v) for rows in hessian]
        changes = [x - times(kicks[2], y + 0.5 * z) for x, y, z in zip(changes, again, third, strict=True)]
    for e, powers in zip(kicks[1:] if monomials else (), monomials, strict=True):
        monomial: Any = 1.0
        for x, n in zip(q, powers, strict=True):
            monomial = monomial * x**n
        changes = [x - e * y for x, y in zip(changes, gradient(monomial, q), strict=True)]
    return changes


class SplittingCode(SplittingRollouts):
    """The compiled functions of splitting schemes on one system; `chunked` by default if no polynomials."""

    def __init__(self, splitting: Splitting, chunked: bool | None = None) -> None:
        self._splitting, self._given = splitting, (splitting,)
        super().__init__(2 * splitting.ndof * (1 + splitting.compensated), 2 * splitting.ndof)
        self.timed = splitting.timed
        self.chunked = self.timed or not splitting.polynomial if chunked is None else chunked
        self.lanes = 8 if self.chunked else 16  # chunks need not wait for each other, registers side by side do
        self.given, self.own = len(splitting.numbers), splitting.own

    @cached_property
    def _kinds(self) -> Sequence[Any]:
        return self._splitting.kinds()

    @cached_property
    def size(self) -> int:
        """Numbers of a column that the code reads."""
        if self.timed:
            coefficients = len(self._splitting.parameters) - self.own
            return len(self._splitting.numbers) - coefficients + CLOCK
        return max(len(kind.table.outputs) for kind in self._kinds)

    def stage(self, values: Any, numbers: Numbers, kind: Value, step: Value) -> Any:
        """A kick and a drift, of the kind that a column has, of values or of a state in memory."""
        if isinstance(values, Room):
            for k in self.given_kind(kind):
                self._executed(k, values, self._column(k, values.type, numbers, step))
            return None
        if self.kinds == 1:  # through variables the optimizer would order batches anew, 7 % slower
            return self._executed(0, values, self._column(0, values[0].type, numbers, step))
        results = [step.code.variable(x) for x in values]
        for k in self.given_kind(kind):
            assign(results, self._executed(k, values, self._column(k, values[0].type, numbers, step)))
        return [x.value for x in results]

    def over(self, each: Callable[..., None], numbers: Numbers, kind: Value, step: Value) -> None:
        type = numbers(0).type
        for k in self.given_kind(kind):
            column = self._column(k, type, numbers, step)
            each(lambda values, k=k, column=column: self._executed(k, values, column))

    def _executed(self, k: int, values: Any, column: Sequence[Value]) -> Any:
        return self._kinds[k].body(*values, *column)

    def _column(self, k: int, type: Type, numbers: Numbers, step: Value) -> list[Value]:
        """The numbers that a stage of a kind reads."""
        table = self._kinds[k].table
        if not self.timed:
            return [numbers(i) for i in range(len(table.outputs))]
        code, given = step.code, [numbers(i, lone=True) for i in range(self.size)]
        time = self._time(given, code.convert("sitofp", step, "double"))
        return [code.operand(x, type) for x in table(*self._lettered(time, given))]

    def _time(self, given: Sequence[Any], step: Any) -> Any:
        before, first, length = given[self._clock]
        return first + (step * length + before)

    @cached_property
    def _clock(self) -> slice:
        """The places of the numbers of the time in a column: when the kick is, when step 0 begins, how long one is."""
        end = self.size - self.own
        return slice(end - CLOCK, end)

    def _lettered(self, time: Any, given: Sequence[Any]) -> list[Any]:
        """The numbers of a column of a driven system, of those that are given, with its coefficients at a time."""
        clock = self._clock
        fixed = given[clock.stop :]
        return [*given[: clock.start], *fixed, *self._splitting.values_at(time, given[0], fixed)]

    # the reverse --------------------------------------------------------------------------------------------------

    @property
    def kinds(self) -> int:  # type: ignore[override]
        return len(self._kinds)

    def plain(self, kind: int, state: Sequence[Any], column: Sequence[Any], step: Any) -> Sequence[Any]:
        body, table = self._kinds[kind].plain, self._kinds[kind].table
        if self.timed:
            return body(*state, *table(*self._lettered(self._time(column, step), column)))
        return body(*state, *column[: len(table.outputs)])

    def check_reverse(self) -> None:
        """All stages have a reverse."""

    def of_values(self, given: Sequence[Value], cotangents: Sequence[Value], kind: Value) -> list[Value]:
        if self.timed:
            return [*cotangents[self.size - self.own :]]
        code, type = kind.code, cotangents[0].type
        found = [code.variable(code.constant(0.0, type)) for _ in range(self.own)]
        for k in self.given_kind(kind):
            program = self._of_tables[k]
            of_values = program(*given, *cotangents[: len(program.inputs) - len(given)])
            assign(found, [code.operand(x, type) for x in of_values])
        return [x.value for x in found]

    @cached_property
    def _of_tables(self) -> list[Program]:
        """From the numbers of a table, and cotangents of those of a column, to cotangents of the values."""
        programs = [adjoint(kind.table) for kind in self._kinds]
        return [Program(each.inputs, each.outputs[len(each.outputs) - self.own :]) for each in programs]

    def stepped(self, numbers: np.ndarray, y: Any, h: Any, t: Any, values: Sequence[Any]) -> Any:
        """A step h at t from tensors (..., 2d), by columns `numbers` (n, m) for h = 1 and values of parameters."""
        import torch

        state = [*y.unbind(-1), *[torch.zeros_like(y[..., 0])] * (self.n_values - self.n_out)]
        kinds, powers = self._kinds_of(numbers), [1, *self._splitting.full_kick.powers]
        for k, column in zip(kinds, numbers.T.tolist(), strict=True):
            given = [c * h**power for c, power in zip(column, powers, strict=False)]
            if self.timed:
                given = self._lettered(
                    torch.as_tensor(t, dtype=y.dtype) + column[len(powers)] * h, [*given, 0.0, 0.0, 0.0, *values]
                )
            else:
                given += values
            state = self._kinds[k].plain(*state, *self._kinds[k].table(*given))
        return torch.stack([x.expand(y.shape[:-1]) for x in state[: self.n_out]], dim=-1)

    def step_made(self, width: int, own: bool) -> Callable[..., None]:
        powers = [1, *self._splitting.full_kick.powers, *((1, 0, 0) if self.timed else ()), *[0] * self.own]
        last, table = len(self._kinds) - 1, self._kinds[-1].table

        def column(time: Value, *given: Value) -> list[Any]:
            if not self.timed:
                return table(*given)
            at = time + given[self._clock][0]
            return [time.code.operand(x, time.type) for x in table(*self._lettered(at, given))]

        def stage(values: list[Value], numbers: Numbers, kind: Value, step: Value) -> list[Value]:
            return self._executed(last, values, [numbers(i) for i in range(len(table.outputs))])

        own_numbers = self.own if own else 0
        return step_function(self.n_values, self.n_out, powers, own_numbers, column, stage, width, self.place)

    # tables -------------------------------------------------------------------------------------------------------

    def unclosed(self, table: np.ndarray, more: int = 0) -> np.ndarray:
        """A table of a run whose outputs are not closed; with two `more` columns, which are idle, that of a map."""
        table, n = np.concatenate([table, *[table[:, -1:]] * more], axis=1), len(self._splitting.kick_numbers)
        table[: 1 + n, table.shape[1] - max(more, 1) :] = 0.0
        return table

    def shifted(self, table: np.ndarray, steps: np.ndarray) -> Columns:
        """The columns (n, m, size) of a driven system after whole steps (n,), and their kinds."""
        columns, kinds = self.columns(table)
        columns, at = np.repeat(columns[None], len(steps), axis=0), self._clock.start
        columns[..., at + 1] += steps[:, None] * columns[..., at + 2]
        return columns, kinds

    def prepared(self, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The numbers (m, size) that the code reads, of a table (n, m) of given ones, and the kinds (m,) of columns."""
        if self.timed:
            return self.columns(table)
        return self._known_columns(table.tobytes(), len(table))

    @lately_kept
    def _known_columns(self, numbers: bytes, n: int) -> Columns:
        return self.columns(np.frombuffer(numbers).reshape(n, -1))

    def columns(self, table: np.ndarray) -> Columns:
        kinds = self._kinds_of(table)
        return np.ascontiguousarray(table.T if self.timed else self._entries(table, kinds)), kinds

    def _kinds_of(self, table: np.ndarray) -> np.ndarray:
        kinds = np.zeros(table.shape[1], dtype=np.int64)
        for k in range(1, len(self._kinds)):
            kinds[table[1 + k] != 0] = k
        return kinds

    def _entries(self, table: Any, kinds: np.ndarray, shape: tuple[int, ...] = ()) -> np.ndarray:
        """The numbers (m, size, *shape) of rows, each (m,) or (m, *shape)."""
        if self.timed:
            return np.stack([np.broadcast_to(row, (len(kinds), *shape)) for row in table], axis=1)
        entries = np.zeros((len(kinds), self.size, *shape))
        for k in range(len(self._kinds)):
            columns = slice(None) if len(self._kinds) == 1 else kinds == k
            with np.errstate(all="ignore"):
                rows = self._kinds[k].table(*(row[columns] for row in table))
            for i, row in enumerate(rows):
                entries[columns, i] = row
        return entries

    def own_entries(self, table: Any, values: np.ndarray) -> Columns:
        """The numbers of the columns of trajectories with their own values of the parameters."""
        kinds, n = self._kinds_of(table), len(table) - self.own
        values = np.broadcast_to(values.T[:, None], (values.shape[1], len(kinds), len(values)))
        rows = [*table[:n, :, None], *values]
        return np.moveaxis(self._entries(rows, kinds, values.shape[2:]), -1, 0), kinds

    def step_rows(
        self, table: np.ndarray, x: np.ndarray, h: np.ndarray, t: np.ndarray, y: np.ndarray, out: np.ndarray
    ) -> None:
        """One step of length ``h[i]`` from every row of `y`, by numbers that are polynomials of ``x[i]``."""
        own = " own" if y.shape[1] > self.n_out else ""
        table, width = np.ascontiguousarray(table), 1 if len(y) == 1 else self.lanes
        self.call("step" + own, width, table, table.shape[1], table.shape[2], x, h, t, y, len(y), out)
