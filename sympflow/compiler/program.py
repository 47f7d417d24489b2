"""Program: operations recorded in order, shared where they are the same; differentiated, called, printed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from sympflow.compiler.functions import FUNCTIONS, apply
from sympflow.compiler.numbers import Number
from sympflow.compiler.tables import Table

__all__ = ["Program", "Traced", "adjoint", "derivatives", "fused", "gradient", "tangent", "traced"]


_LOGICAL = {"and", "or", "not"}
CONDITIONS = {"lt", "le", "eq", *_LOGICAL}
"""Operations whose value is true or false."""


class Traced(Number):
    """A number that is known by its operation only; it can be combined with others of its recording."""

    __slots__ = ("args", "name", "order", "recording")

    def __init__(self, recording: Recording, name: str, args: tuple[Any, ...], order: int) -> None:
        self.recording, self.name, self.args, self.order = recording, name, args, order

    def apply(self, name: str, args: Sequence[Any]) -> Any:
        if any(isinstance(x, np.ndarray) for x in args):  # of objects
            arrays = [np.asarray(x, dtype=object) for x in args]
            return np.frompyfunc(lambda *x: apply(name, *x), len(args), 1)(*arrays)
        return self.recording.record(name, args)

    def __repr__(self) -> str:
        return str(self.args[0]) if self.name == "input" else f"v{self.order}"


def _is_condition(x: Any) -> bool:
    return isinstance(x, Traced) and x.name in CONDITIONS


class Recording:
    """The numbers recorded together; the same operation of the same numbers is the same number."""

    def __init__(self) -> None:
        self._known: dict[Any, Traced] = {}

    def __len__(self) -> int:
        return len(self._known)

    def input(self, name: str) -> Traced:
        """Return a number that is given when the program is called."""
        return self._number("input", (name,))

    def record(self, name: str, args: Sequence[Any]) -> Any:
        """Return the number of an operation, simplified where that is exact."""
        args = tuple(x if isinstance(x, Traced | Table) else _constant(x) for x in args)
        for x in args:
            if isinstance(x, Traced) and x.recording is not self:
                raise ValueError("numbers of two recordings cannot be combined: trace the functions together.")
        if name == "where" and all(map(_is_condition, args[1:])):
            c, x, y = args
            return self.record("or", (self.record("and", (c, x)), self.record("and", (self.record("not", (c,)), y))))
        if name not in _LOGICAL:  # a condition is calculated with as 1 or 0
            first = name == "where"
            args = (*args[:first], *(self._as_number(x) for x in args[first:]))
        if not any(isinstance(x, Traced) for x in args):
            with np.errstate(all="ignore"):
                return float(FUNCTIONS[name].numpy(*args))
        simpler = _SIMPLER.get(name)
        if simpler is not None:
            found = simpler(*args)
            if found is not None:
                return found
        if name in _COMMUTE:
            args = tuple(sorted(args, key=_place))
        return self._number(name, args)

    def _as_number(self, x: Any) -> Any:
        return self.record("where", (x, 1.0, 0.0)) if _is_condition(x) else x

    def _number(self, name: str, args: tuple[Any, ...]) -> Traced:
        key = name, *(x.order if isinstance(x, Traced) else (x, math.copysign(1.0, x) if x == 0 else 0) for x in args)
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = Traced(self, name, args, len(self._known))
        return found


def _constant(x: Any) -> float:
    if isinstance(x, float | int | np.generic) and not isinstance(x, complex | np.complexfloating):
        return float(x)
    raise TypeError(f"a number that is traced cannot be combined with {type(x).__name__}: give floats.")


def _place(x: Any) -> tuple[int, float]:
    """The place of an argument among others: numbers first, then what is traced, in its order."""
    return (1, x.order) if isinstance(x, Traced) else (0, x)


MOST_DERIVED = 5000  # operations through which derivatives of single outputs are taken
MOST_ROOTS = 8.5  # powers that are written as powers of a root
_COMMUTE = {"add", "mul", "times", "min", "max", "eq", "and", "or"}


def _sum(a: Any, b: Any) -> Any:
    return b if _is(a, 0.0) else a if _is(b, 0.0) else None


def _difference(a: Any, b: Any) -> Any:
    return a if _is(b, 0.0) else -b if _is(a, 0.0) else 0.0 if a is b else None


def _product(a: Any, b: Any, name: str = "mul") -> Any:
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float):
            if x in (0.0, 1.0):
                return y if x else 0.0
            if x == -1.0:
                return -y
            if isinstance(y, Traced) and y.name == "neg":
                return apply(name, -x, y.args[0])
            factor = y.args[0] if isinstance(y, Traced) and y.name == "mul" else None
            if isinstance(factor, float) and (_halves(x) or _halves(factor)):  # exact
                return (x * factor) * y.args[1]
        if isinstance(x, Traced) and x.name == "neg":
            return -apply(name, x.args[0], y)
    return None


def _quotient(a: Any, b: Any) -> Any:
    if isinstance(b, float) and b != 0:
        return a * (1.0 / b) if _halves(b) else None  # exact
    return 0.0 if _is(a, 0.0) else None


def _negative(a: Any) -> Any:
    return a.args[0] if a.name == "neg" else a.args[1] - a.args[0] if a.name == "sub" else None


def _power(x: Any, n: Any) -> Any:
    if not isinstance(n, float) or not isinstance(x, Traced):
        return None
    if n in (0.0, 1.0):
        return x if n else 1.0
    if n == -1.0:
        return 1.0 / x
    if n == 0.5:
        return apply("sqrt", x)
    if n % 1 == 0.5 and abs(n) <= MOST_ROOTS:  # of the root, and of the reciprocal, which need not wait for it
        root = apply("sqrt", x)
        return root ** (2 * n) if n > 0 else root * (1.0 / x) ** (0.5 - n)
    return (1.0 / x) ** -n if n < 0 and n % 1 == 0 else None


def _fused(a: Any, b: Any, c: Any) -> Any:
    if _is(c, 0.0):
        return a * b
    return a * b + c if any(_is(x, n) for x in (a, b) for n in (0.0, 1.0, -1.0)) else None


def _choice(condition: Any, a: Any, b: Any) -> Any:
    if isinstance(condition, float):
        return a if condition else b
    return a if a is b or (isinstance(a, float) and isinstance(b, float) and a == b) else None


_SIMPLER: dict[str, Callable[..., Any]] = {
    "add": _sum,
    "sub": _difference,
    "mul": _product,
    "times": lambda a, b: _product(a, b, "times"),
    "div": _quotient,
    "neg": _negative,
    "pow": _power,
    "fma": _fused,
    "where": _choice,
}


def _halves(x: float) -> bool:
    """True of a power of two, with which products are exact."""
    return math.frexp(x)[0] in (0.5, -0.5)


def _is(x: Any, value: float) -> bool:
    return isinstance(x, float) and x == value


def reached(outputs: Sequence[Any]) -> list[Traced]:
    """Return the numbers that outputs depend on, themselves too, in an order in which they can be computed."""
    seen: dict[int, Traced] = {}
    stack = [x for x in outputs if isinstance(x, Traced)]
    while stack:
        x = stack.pop()
        if x.order not in seen:
            seen[x.order] = x
            stack += [a for a in x.args if isinstance(a, Traced)]
    return [seen[k] for k in sorted(seen)]


class Program:
    """Inputs, the operations on them, and outputs. To be called with numbers of any kind, and printed."""

    def __init__(self, inputs: Sequence[Traced], outputs: Sequence[Any]) -> None:
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self.operations = [x for x in reached(self.outputs) if x.name != "input"]

    def __call__(self, *values: Any) -> list[Any]:
        """Return the outputs for values of the inputs, in their order: arrays, tensors, numbers of one kind."""
        of = {x.order: value for x, value in zip(self.inputs, values, strict=True)}
        arrays = all(isinstance(x, np.ndarray | float) for x in values)
        for x in self.operations:
            args = [of[a.order] if isinstance(a, Traced) else a for a in x.args]
            of[x.order] = FUNCTIONS[x.name].numpy(*args) if arrays else apply(x.name, *args)
        return [of[x.order] if isinstance(x, Traced) else x for x in self.outputs]

    def __len__(self) -> int:
        return len(self.operations)

    def __reduce__(self) -> tuple[Any, ...]:
        """The operations in a row: a graph of them may be too deep to be pickled."""
        place = {x.order: i for i, x in enumerate((*self.inputs, *self.operations))}

        def plain(args: Sequence[Any]) -> list[Any]:
            return [place[a.order] if isinstance(a, Traced) else a for a in args]

        operations = [(x.name, plain(x.args)) for x in self.operations]
        return _restored, ([repr(x) for x in self.inputs], operations, plain(self.outputs))

    def __str__(self) -> str:
        lines = [f"{x!r} = {_written(x)}" for x in self.operations]
        return "\n".join(
            [f"({', '.join(map(repr, self.inputs))}) →", *lines, f"→ ({', '.join(map(repr, self.outputs))})"]
        )


def _restored(names: Sequence[str], operations: Sequence[Any], outputs: Sequence[Any]) -> Program:
    recording = Recording()
    numbers: list[Any] = [recording.input(name) for name in names]
    inputs = list(numbers)

    def given(args: Sequence[Any]) -> list[Any]:
        return [numbers[a] if isinstance(a, int) else a for a in args]

    for name, args in operations:
        numbers.append(recording.record(name, given(args)))
    return Program(inputs, given(outputs))


def _written(x: Traced) -> str:
    args = [repr(a) for a in x.args]
    infix = FUNCTIONS[x.name].infix
    return f"{args[0]} {infix} {args[1]}" if infix else f"{x.name}({', '.join(args)})"


def fused(program: Program) -> Program:
    """Return the program with products that are used once joined to the sums that use them, in the same recording."""
    used = Counter(a.order for x in program.operations for a in x.args if isinstance(a, Traced))
    used.update(x.order for x in program.outputs if isinstance(x, Traced))
    of: dict[int, Any] = {x.order: x for x in program.inputs}

    def new(x: Any) -> Any:
        return of[x.order] if isinstance(x, Traced) else x

    def is_product(x: Any) -> bool:
        return isinstance(x, Traced) and x.name in ("mul", "times") and used[x.order] == 1

    for x in program.operations:
        a, b, *_ = (*x.args, None)
        if x.name == "add" and (is_product(a) or is_product(b)):
            product, rest = (a, b) if is_product(a) else (b, a)
            of[x.order] = apply("fma", *map(new, product.args), new(rest))
        elif x.name == "sub" and is_product(a):
            of[x.order] = apply("fma", *map(new, a.args), -new(b))
        elif x.name == "sub" and is_product(b):
            first, second = map(new, b.args)
            of[x.order] = apply("fma", -first, second, new(a))
        else:
            of[x.order] = apply(x.name, *map(new, x.args))
    return Program(program.inputs, [new(x) for x in program.outputs])


def traced(function: Callable[..., Sequence[Any]], *names: str) -> Program:
    """Record a function of as many numbers as there are names; it returns a sequence of numbers."""
    recording = Recording()
    inputs = [recording.input(name) for name in names]
    return Program(inputs, list(function(*inputs)))


def _partials(x: Traced) -> Iterator[tuple[Traced, Any]]:
    base, *rest = x.args
    if x.name == "pow" and isinstance(base, Traced) and base.name == "sqrt" and isinstance(rest[0], float):
        # finite where the derivative of the root alone is not
        yield base.args[0], 0.5 * rest[0] * base ** (rest[0] - 2.0)
        return
    rule = FUNCTIONS[x.name].partials
    if rule is None:
        return
    for a, slope in zip(x.args, rule(x, *x.args), strict=True):
        if isinstance(a, Traced) and not _is(slope, 0.0):
            yield a, slope


def _through(slope: Any, partial: Any) -> Any:
    """The product of two derivatives: 0 where a choice makes one of them 0, even where the other is NaN or infinite."""
    for x, y in ((slope, partial), (partial, slope)):
        if isinstance(x, Traced) and x.name == "where":
            condition, a, b = x.args
            if _is(a, 0.0):
                return apply("where", condition, 0.0, _through(b, y))
            if _is(b, 0.0):
                return apply("where", condition, _through(a, y), 0.0)
    return slope * partial


def gradient(y: Any, x: Sequence[Traced]) -> list[Any]:
    """Return ∂y/∂x of recorded numbers, in the same recording, by the reverse mode."""
    if not isinstance(y, Traced):
        return [0.0] * len(x)
    moved = _moved([y], x)
    depends = {number.order for number in moved}
    slopes: dict[int, Any] = {y.order: 1.0}
    for number in reversed(moved):
        slope = slopes.get(number.order)
        if slope is None or number.name == "input":
            continue
        for a, partial in _partials(number):
            if a.order in depends:
                slopes[a.order] = slopes.get(a.order, 0.0) + _through(slope, partial)
    return [slopes.get(s.order, 0.0) for s in x]


def tangent(outputs: Sequence[Any], x: Sequence[Traced], v: Sequence[Any]) -> list[Any]:
    """Return Σ ∂y/∂xᵢ vᵢ of each output, in the same recording, by the forward mode."""
    dots: dict[int, Any] = {a.order: b for a, b in zip(x, v, strict=True)}
    for number in _moved(outputs, x):
        if number.order not in dots:
            total: Any = 0.0
            for a, partial in _partials(number):
                if a.order in dots:
                    total = total + _through(partial, dots[a.order])
            dots[number.order] = total
    return [dots.get(y.order, 0.0) if isinstance(y, Traced) else 0.0 for y in outputs]


def adjoint(program: Program) -> Program:
    """Return the program from the inputs, and from cotangents of the outputs behind them, to those of the inputs.

    In the reverse mode, number by number, or with the derivatives of each output by the inputs and by other outputs
    that it is made of, which do not wait for cotangents: the better one.
    """
    recording, n = program.inputs[0].recording, len(program.outputs)
    cotangents = [recording.input(f"of_{i}") for i in range(n)]
    of: dict[int, Any] = {}
    for a, y in zip(cotangents, program.outputs, strict=True):
        if isinstance(y, Traced):
            of[y.order] = of.get(y.order, 0.0) + a
    found, marks = [], [{x.order for x in program.operations}]
    if n * len(program) <= MOST_DERIVED:
        marks.append(set(of))
    for within in marks:
        slopes = dict(of)
        for number in reversed(program.operations):
            if number.order in within and number.order in slopes:
                for a, partial in _slopes_of(number, within):
                    slopes[a.order] = slopes.get(a.order, 0.0) + _through(slopes[number.order], partial)
        found.append(fused(Program([*program.inputs, *cotangents], [slopes.get(x.order, 0.0) for x in program.inputs])))
    return min(found, key=lambda each: 2 * _waiting(each, cotangents) + 3 * len(each))


def _slopes_of(y: Traced, ends: set[int]) -> Iterator[tuple[Traced, Any]]:
    """The derivatives of a number by others it is made of, down to inputs and the numbers at which it `ends`."""
    slopes: dict[int, Any] = {y.order: 1.0}
    known: dict[int, Traced] = {y.order: y}
    while known:
        number = known.pop(max(known))
        slope = slopes[number.order]
        if number is not y and (number.name == "input" or number.order in ends):
            yield number, slope
            continue
        for a, partial in _partials(number):
            slopes[a.order], known[a.order] = slopes.get(a.order, 0.0) + _through(slope, partial), a


def _waiting(program: Program, late: Sequence[Traced]) -> int:
    """The time that outputs wait for inputs that are known late, in cycles."""
    known = {x.order: 0 for x in late}
    for x in program.operations:
        ready = [known[a.order] for a in x.args if isinstance(a, Traced) and a.order in known]
        if ready:
            known[x.order] = max(ready) + FUNCTIONS[x.name].cost
    return max((known.get(y.order, 0) for y in program.outputs if isinstance(y, Traced)), default=0)


def derivatives(outputs: Sequence[Any], x: Sequence[Traced]) -> list[list[Any]]:
    """Return the matrix ∂yᵢ/∂xⱼ, in the same recording."""
    return [gradient(y, x) for y in outputs]


def _moved(outputs: Sequence[Any], x: Sequence[Traced]) -> list[Traced]:
    """The numbers that depend on x among those that outputs depend on."""
    found = {s.order for s in x}
    kept = []
    for number in reached(outputs):
        if number.order in found or any(isinstance(a, Traced) and a.order in found for a in number.args):
            found.add(number.order)
            kept.append(number)
    return kept
