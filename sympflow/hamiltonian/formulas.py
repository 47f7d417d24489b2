"""Formulas: functions of variables that programs are recorded of, of an H by symbols or by Python functions.

A form describes the structure of H. That of symbols is `SymbolicHamiltonian`, whose expressions are SymPy's; that of
Python functions is `TracedHamiltonian`, whose expressions are programs. Kernels take either, and no more than they
share.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, assemble, beside, is_tensor
from sympflow.compiler.arrange import Arrangement
from sympflow.compiler.functions import apply, is_zero, where
from sympflow.compiler.program import (
    CONDITIONS,
    Program,
    Recording,
    Traced,
    derivatives,
    gradient,
    reached,
    tangent,
    traced,
)
from sympflow.hamiltonian.quantities import Formula, Variable

if TYPE_CHECKING:
    from sympflow.hamiltonian.poles import Poles
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian


MOST_IN_SYMBOLS = 300  # operations
MOST_COMPILED = 5000  # operations of a gradient
DOUBLE = 1e-6  # share by which two roots of a polynomial that are one may differ
_JUMPING = {"sign", "floor", "mod", "where", "lt", "le", "eq", "atan2"}
_BENDING = {"abs", "min", "max", "asin", "acos", "acosh", "sqrt", "pow"}
_OF_FIRST = "pow log log1p tan sqrt acos asin acosh atanh gamma lgamma digamma ellipk bose csch"
_SINGULAR = {"div": 1} | dict.fromkeys(_OF_FIRST.split(), 0)
"""The argument by which an operation is infinite or no number."""
_AS_THEIR_ARGUMENTS = {"abs", "neg", "sqrt", "pow", "mul", "times"}


class Entries:
    """The entries of a matrix of numbers, in place of a matrix of symbols."""

    free_symbols: frozenset[Any] = frozenset()

    def __init__(self, rows: Sequence[Sequence[Any]]) -> None:
        self._rows = rows

    def __getitem__(self, place: tuple[int, int]) -> Any:
        return self._rows[place[0]][place[1]]


class TracedHamiltonian:
    """The form of a system of Python functions, as `SymbolicHamiltonian` is that of a system of symbols.

    The program is V of q, if it is `separable`, or H of q and p; of a driven system the time comes first, and
    `parameters`, which V and the rows of M⁻¹ may have, are last.
    """

    samples: Mapping[str, Any] = MappingProxyType({})
    text: str | None = None

    def __init__(
        self,
        ndof: int,
        program: Program,
        separable: bool,
        inverse_mass: np.ndarray | list[list[Any]] | None = None,
        timed: bool = False,
        kinetic: Program | None = None,
        parameters: Sequence[Variable] = (),
        values: Sequence[float] = (),
    ) -> None:
        self.ndof, self.program, self.separable, self._timed = ndof, program, separable, timed
        self.parameters, self.values = tuple(parameters), tuple(values)
        self.q = tuple(Variable(f"q{i + 1}") for i in range(ndof))
        self.p = tuple(Variable(f"p{i + 1}") for i in range(ndof))
        self.time = Variable("t") if timed else None
        times = (self.time,) if self.time else ()
        self.V: Any = None
        self.T: Any = None
        self.inverse_mass: Entries | None = None
        if not separable:
            self.H = Formula(program, (*times, *self.q, *self.p, *self.parameters))
            return
        variables = (*self.p, *self.parameters)
        if kinetic is None:
            M = np.ones(ndof) if inverse_mass is None else inverse_mass
            rows = M if isinstance(M, list) else [[*row] for row in (np.diag(M) if M.ndim == 1 else M).astype(object)]
            self.inverse_mass = Entries(rows)

            def energy(*numbers: Any) -> list[Any]:
                known = evaluator(dict(zip(variables, numbers, strict=True)))
                return [_kinetic([[known(x) for x in row] for row in rows], numbers[:ndof])]

            kinetic = traced(energy, *(s.name for s in variables))
        self.T = Formula(kinetic, variables[: len(kinetic.inputs)])
        self._set_potential(Formula(program, (*times, *self.q, *self.parameters)[: len(program.inputs)]))

    def named(self, names: Sequence[str]) -> TracedHamiltonian:
        """The same with entries of M⁻¹ as parameters of these names: those of the diagonal, or all, row by row.

        A form that has parameters of these names is itself returned.
        """
        if tuple(names) == tuple(s.name for s in self.parameters):
            return self
        d, letters = self.ndof, [*map(Variable, names)]
        rows: list[list[Any]] = [letters[i * d : (i + 1) * d] for i in range(d)]
        if len(names) == d:
            rows = [[s if i == j else 0.0 for j in range(d)] for i, s in enumerate(letters)]
        return TracedHamiltonian(d, self.program, True, rows, self._timed, None, letters, (1.0,) * len(names))

    def _set_potential(self, V: Formula) -> None:
        T, together = self.T, dict.fromkeys((*V.variables, *self.T.variables))
        variables = *(s for s in together if s not in self.parameters), *self.parameters

        def total(*numbers: Any) -> list[Any]:
            known = dict(zip(variables, numbers, strict=True))
            return [V.value(known) + T.value(known)]

        self.V, self.H = V, Formula(traced(total, *(s.name for s in variables)), variables)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "written"}

    @property
    def parametric(self) -> TracedHamiltonian:
        return self

    @property
    def may_bend(self) -> bool:
        """True if some operation jumps, or has a kink."""
        return any(x.name in _JUMPING | _BENDING for x in self.program.operations)

    def check_continuous(self, argument: str) -> None:
        """Refuse a function that jumps in q or p."""
        if not any(x.name in _JUMPING for x in self.program.operations) or len(self.program) > MOST_IN_SYMBOLS:
            return
        from sympflow.hamiltonian.jumps import check_continuous
        from sympflow.hamiltonian.recorded import NotRecorded, in_symbols

        with suppress(NotRecorded):
            f = in_symbols(self.program)
            check_continuous(argument, f, [s for s in f.free_symbols if self.time is None or s.name != self.time.name])

    @cached_property
    def written(self) -> SymbolicHamiltonian | None:
        """The same in symbols, for methods that look for parts of H; None of a long one."""
        if len(self.H) > MOST_IN_SYMBOLS:
            return None
        from sympflow.hamiltonian.recorded import NotRecorded, in_symbols
        from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

        try:
            symbols = SymbolicHamiltonian(in_symbols(self.H.program), time="t" if self.time else None)
        except (NotRecorded, ValueError, TypeError):
            return None
        return symbols if symbols.ndof == self.ndof and symbols.separable >= self.separable else None

    @cached_property
    def size(self) -> int:
        """Operations of ∇V, or of ∇H."""
        n = len(self.program)
        return len(self._slope) if n <= MOST_COMPILED else n

    @cached_property
    def driving(self) -> TracedDriving:
        """The form with coefficients for what depends on the time alone."""
        (V,), coefficients = without_time([self.V], self.time, self.parameters)
        form = copy.copy(self)
        form.time, form.parameters = None, (*self.parameters, *coefficients)
        form._set_potential(V)
        return TracedDriving(form, coefficients, (self.time, *self.parameters))

    # arrays, of V in q or of H in [q, p] --------------------------------------------------------------------------

    def _states(self, program: Program, both: bool) -> tuple[Traced, ...]:
        """The inputs of a program that are q, or `both` q and p."""
        first = self.time is not None
        return program.inputs[first : first + self.ndof * (1 + both)]

    @cached_property
    def _slope(self) -> Program:
        x = self._states(self.program, not self.separable)
        return Program(self.program.inputs, gradient(self.program.outputs[0], x))

    @cached_property
    def _hessian(self) -> Program:
        """The Hessian row by row to the diagonal."""
        x, slopes = self._states(self.program, not self.separable), self._slope.outputs
        return Program(self.program.inputs, [entry for i, s in enumerate(slopes) for entry in gradient(s, x[: i + 1])])

    @cached_property
    def _along(self) -> tuple[Program, Program]:
        """∇²V·v and ∇³V(v, w), of the inputs and vectors."""
        inputs = [repr(x) for x in self.program.inputs]
        n, d = len(inputs), self.ndof
        names = [*inputs, *(f"{letter}{i}" for letter in "vw" for i in range(d))]

        def products(*numbers: Any) -> list[Any]:
            x = numbers[n - d : n]
            v, w = numbers[n : n + d], numbers[n + d :]
            product = tangent(self._slope(*numbers[:n]), x, v)
            return [*product, *tangent(product, x, w)]

        both = traced(products, *names)
        return Program(both.inputs[: n + d], both.outputs[:d]), Program(both.inputs, both.outputs[d:])

    def hamiltonian(self, y: Array, *t: Any, numbers: Sequence[Any] = ()) -> Array:
        """H of y (..., 2d), with `numbers` for the parameters: (...)."""
        return self._assembled(self.H.program, y, *t, numbers=numbers)[..., 0]

    def hamiltonian_gradient(self, y: Array, *t: Any, numbers: Sequence[Any] = ()) -> Array:
        """∇H of y (..., 2d), with `numbers` for the parameters."""
        return self._assembled(self._whole_slope, y, *t, numbers=numbers)

    @cached_property
    def _whole_slope(self) -> Program:
        program = self.H.program
        return Program(program.inputs, gradient(program.outputs[0], self._states(program, True)))

    def value(self, x: Array, *t: Any) -> Array:
        """V of q (..., d), or H of y (..., 2d): (...)."""
        return self._assembled(self.program, x, *t)[..., 0]

    def gradient(self, x: Array, *t: Any) -> Array:
        """Its gradient, (..., n)."""
        return self._assembled(self._slope, x, *t)

    def hessian(self, x: Array, *t: Any) -> Array:
        """Its Hessian, (..., n, n)."""
        n = x.shape[-1]
        rows = self._assembled(self._hessian, x, *t)
        pairs = [(max(i, j), min(i, j)) for i in range(n) for j in range(n)]
        return rows[..., [i * (i + 1) // 2 + j for i, j in pairs]].reshape(*x.shape[:-1], n, n)

    def hessian_vector(self, q: Array, v: Array, *t: Any) -> Array:
        """∇²V·v, (..., d)."""
        return self._assembled(self._along[0], q, *t, more=(v,))

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Any) -> Array:
        """∇³V(v, w), (..., d)."""
        return self._assembled(self._along[1], q, *t, more=(v, w))

    @cached_property
    def _in_time(self) -> Program:
        inputs = self.program.inputs
        return Program(inputs, gradient(self.program.outputs[0], inputs[:1]))

    def time_derivative(self, x: Array, t: Any) -> Array:
        """∂V/∂t or ∂H/∂t, (...)."""
        return self._assembled(self._in_time, x, t)[..., 0]

    def _assembled(
        self, program: Program, x: Array, *t: Any, more: Sequence[Array] = (), numbers: Sequence[Any] = ()
    ) -> Array:
        arrays = (x, *more)
        columns = [a[..., i] for a in arrays for i in range(a.shape[-1])]
        times = t[: self.time is not None]
        if is_tensor(x):  # torch.compile knows no errstate
            values = program(*(beside(s, x) for s in times), *columns, *numbers)
        else:
            with np.errstate(all="ignore"):
                values = program(*times, *columns, *numbers)
        return assemble(values, sum(columns[:: max(x.shape[-1], 1)]) if more else columns[0])


class TracedPoles:
    """The places of H as it was traced: divisors and the like, and once a run may have passed one, those in symbols."""

    def __init__(self, form: TracedHamiltonian) -> None:
        self._form, program = form, form.H.program
        inputs, self._vanishing = form._states(program, True), dict[int, Traced]()
        for x in program.operations:
            if x.name in _SINGULAR and not (x.name == "pow" and _is_whole(x.args[1])):
                self._add(x.args[_SINGULAR[x.name]])
        if self._vanishing:
            H = program.outputs[0]
            T: Any = 0.0
            for x, slope in zip(
                inputs[form.separable * form.ndof :], gradient(H, inputs)[form.separable * form.ndof :], strict=True
            ):
                T = T + abs(x * slope)
            cells = [_cell(g) for g in self._vanishing.values()]
            self._program = Program(program.inputs, [*cells, H, T])

    def __bool__(self) -> bool:
        return bool(self._vanishing)

    def _add(self, g: Any) -> None:
        """Add what changes its sign where a divisor vanishes."""
        if isinstance(g, Traced):
            if g.name in _AS_THEIR_ARGUMENTS:
                for x in g.args:
                    self._add(x)
            elif (ends := _between_roots(g) or self._at_roots(g)) is not None:
                self._vanishing |= {x.order: x for x in ends}
            elif _least(g) < POSITIVE:
                self._vanishing[g.order] = g
                within = {x.order for x in reached([g])}
                used = [x for x in self._form.H.program.inputs if x.order in within]
                if len(used) == 1 and g is not used[0]:
                    with np.errstate(all="ignore"):
                        at_zero = Program(used, [g])(np.float64(0.0))[0]
                    if at_zero == 0.0:  # which it may touch
                        self._add(used[0])

    def _at_roots(self, g: Traced) -> list[Traced] | None:
        """The x − a of the real roots a of a polynomial in one number, None of what is none."""
        within = {x.order for x in reached([g])}
        x, *others = [x for x in self._form.H.program.inputs if x.order in within]
        polynomial = Program([x], [g])
        if others or not Formula(polynomial, [Variable(repr(x))]).is_polynomial():
            return None
        made = Arrangement([(repr(x), 0)])
        terms = {sum(e for _, e in m): c for m, c in made.number(polynomial(*made.states)[0]).terms.items()}
        roots = np.roots([terms.get(n, 0.0) for n in range(max(terms, default=0), -1, -1)])
        real = roots.real[np.abs(roots.imag) <= DOUBLE * np.abs(roots)]  # two that are one come in a pair
        return [x - a for a in np.unique(real).tolist()]

    def may_pass(self, y: np.ndarray) -> bool:
        """Return True: signs and H are looked at in all runs."""
        return True

    def look(self, y: np.ndarray, t: Any, numbers: Sequence[Any] = ()) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        times = () if self._form.time is None else (np.broadcast_to(t, y.shape[:-1]),)
        found = self._program(*times, *np.moveaxis(y, -1, 0), *numbers)
        values = np.stack([np.broadcast_to(x, y.shape[:-1]) for x in found], axis=-1)
        return values[..., :-2], values[..., -2], values[..., -1]

    def sizes(self, y: np.ndarray, t: Any) -> np.ndarray:
        """The values (..., m) that vanish at the places, of those that can be written in symbols."""
        return self.exact.sizes(y, t) if self.exact else np.empty((*y.shape[:-1], 0))

    @property
    def exact(self) -> Poles | None:
        """The places in symbols, None if they cannot be written."""
        written = self._form.written
        return None if written is None else written.poles


def _between_roots(g: Traced) -> tuple[Any, Any] | None:
    """The x − a and x + a of x² − a²."""
    square, number = g.args if g.name == "sub" else (g.args[1], -g.args[0]) if _is_sum_with_number(g) else (None, 0.0)
    if not (isinstance(number, float) and number > 0 and isinstance(square, Traced) and square.name in ("pow", "mul")):
        return None
    x, other = square.args
    is_square = other is x if square.name == "mul" else isinstance(other, float) and other == 2
    return (x - math.sqrt(number), x + math.sqrt(number)) if is_square else None


def _is_sum_with_number(g: Traced) -> bool:
    return g.name == "add" and isinstance(g.args[0], float)


_TOUCHING = {"cos": (math.pi, 0.0), "sin": (math.pi / 2, -math.pi / 2), "cosh": (0.0, 0.0)}
"""Shifts of the arguments at which 1 + f and 1 − f of waves vanish."""


def _cell(g: Traced) -> Any:
    """A number that changes at a place where g vanishes, of 1 ± cos a too, which touches 0."""
    parts = [x for x in g.args if isinstance(x, Traced)] if g.name in ("add", "sub") else []
    number = [x for x in g.args if isinstance(x, float)]
    if len(parts) != 1 or parts[0].name not in _TOUCHING or [abs(x) for x in number] != [1.0]:
        return apply("sign", g)
    wave, (a,) = parts[0].name, parts[0].args
    opposite = (number[0] < 0) == (g.name == "add")
    return apply("sign", a) if wave == "cosh" else apply("floor", (a + _TOUCHING[wave][opposite]) / (2 * math.pi))


def _is_whole(x: Any) -> bool:
    return isinstance(x, float) and x >= 0 and x % 1 == 0


POSITIVE, NOT_NEGATIVE, ANY = 2, 1, 0


def _least(x: Any) -> int:
    """The sign that a number has whatever the variables are, as 1 + q² has."""
    if isinstance(x, float):
        return POSITIVE if x > 0 else NOT_NEGATIVE if x == 0 else ANY
    if x.name in ("exp", "cosh"):
        return POSITIVE
    if x.name == "abs" or (x.name == "pow" and _is_whole(x.args[1]) and x.args[1] % 2 == 0):
        return max(NOT_NEGATIVE, _least(x.args[0]))
    if x.name in ("sqrt", "pow"):
        return _least(x.args[0])
    signs = [_least(a) for a in x.args[:2]] if x.name in ("mul", "times", "div", "fma", "add") else [ANY]
    sign = max(signs) if x.name == "add" and min(signs) else min(signs)
    if x.name != "add" and len(signs) > 1 and x.args[0] is x.args[1]:
        sign = max(NOT_NEGATIVE, sign)
    if x.name == "fma":
        other = _least(x.args[2])
        sign = max(sign, other) if min(sign, other) else ANY
    return sign


class TracedDriving:
    """Coefficients of a traced V that depend on the time alone, and V in these; those of T, `means`, are none."""

    means: tuple[()] = ()

    def __init__(self, form: TracedHamiltonian, coefficients: Mapping[Variable, Formula], given: Sequence[Any]) -> None:
        self.form, self._coefficients, self._given = form, coefficients, given

    @property
    def key(self) -> tuple[Any, ...]:
        return tuple(self._coefficients.items())

    def values_at(self, time: Any, length: Any, fixed: Sequence[Any]) -> list[Any]:
        """The coefficients at a time, of `fixed` parameters."""
        return _at_time(self._coefficients, self._given, (time, *fixed))

    def check(self) -> None:
        """Do nothing: all that was traced has a compiled form."""


class TracedCoefficients:
    """Formulas with coefficients for what depends on the time alone, `given` those of parameters too."""

    def __init__(self, form: TracedHamiltonian, expressions: Sequence[Formula]) -> None:
        self.symbols, self.expressions, self.time_coefficients = form, list(expressions), dict[Variable, Formula]()
        if form.time is not None:
            self.expressions, self.time_coefficients = without_time(expressions, form.time, form.parameters)
        self.given = (*form.parameters, *self.time_coefficients)

    def at(self, t: Any, parameters: Sequence[Any]) -> list[Any]:
        """The coefficients at times t."""
        return _at_time(self.time_coefficients, (self.symbols.time, *self.symbols.parameters), (t, *parameters))


def _at_time(coefficients: Mapping[Variable, Formula], given: Sequence[Any], numbers: Sequence[Any]) -> list[Any]:
    """Values of coefficients at a time, with numbers for the parameters, common operations once."""

    def values(*x: Any) -> list[Any]:
        known = dict(zip(given, x, strict=True))
        return [f.value(known) for f in coefficients.values()]

    return traced(values, *(s.name for s in given))(*numbers)


def without_time(
    formulas: Sequence[Formula], time: Any, parameters: Sequence[Variable]
) -> tuple[list[Formula], dict[Variable, Formula]]:
    """Formulas with coefficients for the largest parts that depend on the time, or parameters, alone."""
    found: dict[Variable, Formula] = {}
    return [without(f, [time, *parameters], found, "letter") for f in formulas], found


def without(
    f: Formula,
    fixed: Sequence[Variable],
    found: dict[Variable, Formula],
    prefix: str,
    number: Callable[[Formula], float | None] = lambda part: None,
) -> Formula:
    """A formula with letters for its largest parts of `fixed` variables alone, or numbers, where there are such."""
    program = f.program
    own_inputs = dict(zip(f.variables, program.inputs, strict=True))
    fixed = [s for s in fixed if s in own_inputs]
    given = {own_inputs[s].order for s in fixed}
    moving = {x.order for x in program.inputs if x.order not in given}
    for x in program.operations:
        if any(isinstance(a, Traced) and a.order in moving for a in x.args):
            moving.add(x.order)
    used = [a for x in program.operations if x.order in moving for a in x.args] + list(program.outputs)
    own, of = dict[int, Variable](), dict[int, Any]()
    conditions = {a.order for a in used if isinstance(a, Traced) and a.name in CONDITIONS}
    for a in used:
        if isinstance(a, Traced) and a.order not in moving and a.order not in own and a.order not in of:
            within = {x.order for x in reached([a])}
            names = [s for s in fixed if own_inputs[s].order in within]
            value = where(a, 1.0, 0.0) if a.order in conditions else a
            part = Formula(Program([own_inputs[s] for s in names], [value]), names)
            if (known := number(part)) is None:
                own[a.order] = Variable(f"{prefix}_{len(found)}")
                found[own[a.order]] = part
            else:
                of[a.order] = known
    others = [(s, x) for s, x in own_inputs.items() if s not in fixed]
    recording = Recording()
    inputs = [recording.input(s.name) for s, _ in others]
    of |= {x.order: new for (_, x), new in zip(others, inputs, strict=True)}
    letters = {order: recording.input(coefficient.name) for order, coefficient in own.items()}
    of |= {order: letter > 0.5 if order in conditions else letter for order, letter in letters.items()}
    for x in program.operations:
        if x.order in moving:
            of[x.order] = apply(x.name, *(of[a.order] if isinstance(a, Traced) else a for a in x.args))
    (y,) = program.outputs
    return Formula(
        Program([*inputs, *letters.values()], [of[y.order] if isinstance(y, Traced) else y]),
        (*(s for s, _ in others), *own.values()),
    )


def _kinetic(M: Sequence[Sequence[Any]], p: Sequence[Any]) -> Any:
    """½ pᵀM⁻¹p."""
    total: Any = 0.0
    for i, row in enumerate(M):
        for j, entry in enumerate(row):
            if not is_zero(entry):
                total = total + (0.5 * entry) * (p[i] ** 2.0 if i == j else p[i] * p[j])
    return total


def kinetic_matrix(
    H: Any, inputs: Sequence[Traced], d: int, letters: Sequence[Traced] = (), numbers: Sequence[float] = ()
) -> tuple[bool, list[list[Any]] | None]:
    """True of a sum T(p) + V of the last d inputs and the others; the rows of M⁻¹, which may have letters, of ½ pᵀM⁻¹p.

    They are None for another T, or where M⁻¹ is not positive by the `numbers` of the letters.
    """
    p = inputs[-d:]
    velocity = gradient(H, p)
    if {x.order for x in inputs[:-d]} & {x.order for x in reached(velocity)}:
        return False, None
    rows = derivatives(velocity, p)
    entries = [x for row in rows for x in row]
    if {x.order for x in p} & {x.order for x in reached(entries)}:
        return True, None
    with np.errstate(all="ignore"):
        found = Program([*p, *letters], [*velocity, *entries])(*np.zeros(d), *map(np.float64, numbers))
    M = np.array(found[d:]).reshape(d, d)
    return True, rows if not any(found[:d]) and np.linalg.eigvalsh(M)[0] > 0 else None


def evaluator(numbers: Mapping[Any, Any]) -> Callable[[Any], Any]:
    """Return a function of expressions that calculates with these numbers, or raises NotRecorded."""
    known: dict[Any, Any] = dict(numbers)

    def value(f: Any) -> Any:
        if isinstance(f, float):
            return f
        if f not in known:
            if isinstance(f, Formula):
                known[f] = f.value(known)
            else:
                from sympflow.hamiltonian.recorded import calculated

                known[f] = calculated(f, value)
        return known[f]

    return value


def recorded(expressions: Sequence[Any], inputs: Sequence[Any]) -> Program:
    """Expressions as a program of variables or symbols."""

    def values(*numbers: Any) -> list[Any]:
        return list(map(evaluator(dict(zip(inputs, numbers, strict=True))), expressions))

    return traced(values, *(s.name for s in inputs))


def without_overflow(program: Program) -> Program:
    """The program; one that divides by exponentials, or takes their logarithm, by functions that do not overflow."""
    large, divides = set[int](), False
    for x in program.operations:
        deep = [isinstance(a, Traced) and a.order in large for a in x.args]
        if any(deep) or x.name in ("exp", "cosh", "sinh"):
            large.add(x.order)
        inverse = x.name == "pow" and isinstance(x.args[1], float) and x.args[1] < 0
        divides |= deep[-1] if x.name == "div" else (inverse or x.name in ("log", "log1p")) and deep[0]
    if divides and len(program) <= MOST_IN_SYMBOLS:
        import sympy as sp

        from sympflow.hamiltonian.recorded import NotRecorded, in_symbols
        from sympflow.hamiltonian.removable import with_own_functions

        with suppress(NotRecorded, ValueError, TypeError):
            f = in_symbols(program)
            written = with_own_functions(f)
            if written != f:
                return recorded([written], [sp.Symbol(repr(x), real=True) for x in program.inputs])
    return program
