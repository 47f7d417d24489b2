"""H as a text whose program is read off the grammar; SymPy is imported once its symbols are asked for."""

from __future__ import annotations

import ast
import copy
import math
import unicodedata
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cached_property, reduce
from operator import mul
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sympflow.arrays import Array
from sympflow.compiler.functions import apply
from sympflow.compiler.program import Program, Recording, Traced, gradient, reached, traced
from sympflow.hamiltonian.definition import Definition
from sympflow.hamiltonian.formulas import TracedHamiltonian, TracedPoles, evaluator, kinetic_matrix, without
from sympflow.hamiltonian.grammar import COORDINATE, chain, parsed
from sympflow.hamiltonian.linear_part import simplest
from sympflow.hamiltonian.quantities import KINDS, Formula, Variable, revalued, values_of

if TYPE_CHECKING:
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

FUNCTIONS = {name: name for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "atan")}
FUNCTIONS["ln"] = "log"
ARITHMETIC = {"input", "add", "sub", "mul", "div", "neg", "pow", "times", "fma"}
MOST_DEGREES, MOST_OPERATIONS = 16, 100  # of the slopes of H, written out
MOST_POWER, MOST_BITS = 64, 2000


class NotPlain(Exception):
    """The text is left to SymPy, which simplifies and judges its parts, and says what is wrong in it."""


class _Reader:
    """A text with numbers of a recording: numbers are fractions, and what depends on names is traced.

    What depends on `parameters` alone is taken together, and their numerical factors apart.
    """

    def __init__(self, coordinates: dict[str, Traced], parameters: dict[str, Traced]) -> None:
        self.names = coordinates | parameters
        self.parameters = parameters
        self.fixed = {x.order for x in parameters.values()}
        self.infinite = set[int]()  # the numbers that are infinite somewhere, by what they divide by

    def value(self, node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return Fraction(number)
            case ast.Name(id=name) if name in self.names:
                return self.names[name]
            case ast.Name(id="pi"):
                return Fraction(math.pi)
            case ast.UnaryOp(op=ast.USub()):
                return self._product([self.value(node.operand), Fraction(-1)])
            case ast.BinOp(op=ast.Add() | ast.Sub()):
                members = [(self.value(each), minus) for each, minus in chain(node, (ast.Add, ast.Sub))]
                return self._sum([self._product([x, Fraction(-1)]) if minus else x for x, minus in members])
            case ast.BinOp(op=ast.Mult() | ast.Div()):
                factors = [(self.value(each), divides) for each, divides in chain(node, (ast.Mult, ast.Div))]
                return self._product([self._power(x, Fraction(-1)) if divides else x for x, divides in factors])
            case ast.BinOp(op=ast.Pow()):
                return self._power(self.value(node.left), self.value(node.right))
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if (
                name in FUNCTIONS.keys() - self.parameters
            ):
                return self._call(FUNCTIONS[name], self.value(argument))
        raise NotPlain

    def _sum(self, members: Sequence[Any]) -> Any:
        numbers = [x for x in members if isinstance(x, Fraction)]
        fixed, moving = self._parted(members)
        if not (fixed or moving):
            return sum(numbers)
        orders = {x.order for x in (*fixed, *moving)}
        if any(x.name == "neg" and x.args[0].order in orders for x in (*fixed, *moving)):  # terms that cancel
            raise NotPlain
        if sum(x.order in self.infinite for x in moving) > 1:  # a difference may have a finite limit
            raise NotPlain
        constant = [self._marked(sum(fixed[1:], fixed[0]) + float(sum(numbers)), fixed)] if fixed else []
        if not moving:
            return constant[0]
        total = self._marked(sum(moving[1:], moving[0]), moving)
        return self._marked(total + (constant[0] if fixed else float(sum(numbers))), moving)

    def _product(self, factors: Sequence[Any]) -> Any:
        number = reduce(mul, (x for x in factors if isinstance(x, Fraction)), Fraction(1))
        fixed, moving = self._parted(factors)
        if not (fixed or moving):
            return number
        for i, x in enumerate(fixed):
            if x.name == "mul" and isinstance(x.args[0], float):
                number, fixed[i] = number * Fraction(x.args[0]), x.args[1]
            elif x.name == "neg":
                number, fixed[i] = -number, x.args[0]
        if len(moving) > 1 and any(x.order in self.infinite for x in moving):  # a quotient may have a finite limit
            raise NotPlain
        constant = [self._marked(reduce(mul, fixed), fixed)] if fixed else []
        return self._marked(float(number) * reduce(mul, [*constant, *moving]), [*constant, *moving])

    def _parted(self, members: Sequence[Any]) -> tuple[list[Traced], list[Traced]]:
        """The members that depend on parameters alone, and those that depend on coordinates."""
        traced = [x for x in members if isinstance(x, Traced)]
        return [x for x in traced if x.order in self.fixed], [x for x in traced if x.order not in self.fixed]

    def _power(self, base: Any, exponent: Any) -> Any:
        if not isinstance(exponent, Fraction) or abs(exponent) > MOST_POWER:
            raise NotPlain
        if isinstance(base, Fraction) and max(base.numerator.bit_length(), base.denominator.bit_length()) > MOST_BITS:
            raise NotPlain
        whole = exponent.denominator == 1
        if isinstance(base, Fraction):
            return base ** int(exponent) if whole else Fraction(float(base) ** float(exponent))
        if whole and base.name == "mul":  # as SymPy, which spreads powers over products
            factors = [Fraction(x) if isinstance(x, float) else x for x in base.args]
            if exponent > 0 or len(self._parted(factors)[1]) < 2:
                return self._product([self._power(x, exponent) for x in factors])
        if base.order in self.fixed:
            return self._marked(apply("pow", base, float(exponent)), [base])
        if base.name in ("sqrt", "pow", "div") and not (base.name == "sqrt" and exponent == -1):  # joined by SymPy
            raise NotPlain
        if not whole and base.name not in ("input", "add", "sub"):  # as √x², which is |x|
            raise NotPlain
        self._check_smooth_in_time(base, whole and exponent > 0)
        radicand, exponent = (base.args[0], exponent / 2) if base.name == "sqrt" else (base, exponent)
        if not (whole and exponent > 0) and not ARITHMETIC.issuperset(x.name for x in reached([radicand])):
            raise NotPlain  # functions may overflow, or cancel, as 1 − cos x
        x = apply("pow", radicand, float(exponent))
        return self._marked(x, [base], exponent < 0)

    def _call(self, name: str, x: Any) -> Any:
        if isinstance(x, Fraction):
            return Fraction(getattr(math, name)(x))
        if name == "sqrt":
            return self._power(x, Fraction(1, 2))
        if x.order in self.fixed:
            return self._marked(apply(name, x), [x])
        self._check_smooth_in_time(x, name not in ("log", "tan"))
        known = {each.name for each in reached([x])}
        if x.order in self.infinite or (name == "log" and known - ARITHMETIC) or (name == "exp" and "log" in known):
            raise NotPlain
        return self._marked(apply(name, x), [x], name == "log")

    def _check_smooth_in_time(self, x: Traced, smooth: bool) -> None:
        """Leave what may jump, or have a kink, at some times to SymPy, which finds these."""
        if not smooth and "t" in self.names and self.names["t"] in reached([x]):
            raise NotPlain

    def _marked(self, x: Any, made_of: Sequence[Traced], infinite: bool = False) -> Any:
        if not isinstance(x, Traced):  # terms that cancel
            raise NotPlain
        if all(part.order in self.fixed for part in made_of):
            self.fixed.add(x.order)
        elif infinite or any(part.order in self.infinite for part in made_of):
            self.infinite.add(x.order)
        return x


class _Read(NamedTuple):
    """H of a text in t, q1 … pd and letters for parts that depend on parameters alone; those that are 0, ±1 in H."""

    timed: bool
    ndof: int
    H: Formula
    letters: dict[Variable, Formula]
    lasting: list[Formula]


def _read(text: str, params: Mapping[str, float], timed: bool, names: Sequence[str] | None = None) -> _Read:
    """Read a text, `timed` if t is in it; of `names` the letters are these parameters, whatever their values."""
    tree = parsed(text, FUNCTIONS)
    used = {x.id for x in ast.walk(tree) if isinstance(x, ast.Name)}
    spelled = [unicodedata.normalize("NFKC", name) for name in params]
    coordinates = {name for name in used if COORDINATE.fullmatch(name)}
    d = max((int(name[1:] or 1) for name in coordinates), default=0)
    numbered = all(len(name) > 1 for name in coordinates)
    if not 0 < d <= MOST_DEGREES or not (numbered or coordinates <= {"q", "p"}) or not used.issuperset(spelled):
        raise NotPlain
    recording = Recording()
    times = [recording.input("t")] if timed else []
    states = [recording.input(f"{letter}{i + 1}") for letter in "qp" for i in range(d)]
    own = [recording.input(name) for name in params]
    known = dict(zip(map(repr, states) if numbered else "qp", states, strict=True))
    known |= dict(zip(["t"], times, strict=False))
    y = _Reader(known, dict(zip(spelled, own, strict=True))).value(tree)
    within = {x.order for x in reached([y])}
    unused = [i for i in range(d) if within.isdisjoint({states[i].order, states[d + i].order})]
    if unused or not within.issuperset(x.order for x in (*times, *own)):
        raise NotPlain
    variables = [Variable(name) for name in (*map(repr, (*times, *states)), *params)]
    parameters, lasting, found = variables[timed + 2 * d :], list[Formula](), dict[Variable, Formula]()

    def value(part: Formula) -> float:
        (number,) = values_of([part], params)
        if not math.isfinite(number):
            raise NotPlain
        return number

    def fixed(part: Formula) -> float | None:
        number = value(part)
        if number not in KINDS:
            return None
        lasting.append(part)
        return number

    H = Formula(Program([*times, *states, *own], [y]), variables)
    if names is None:
        return _Read(timed, d, without(H, parameters, found, "parameter", fixed), found, lasting)
    found = {s: Formula(Program([x], [x]), [s]) for s, x in zip(parameters, own, strict=True) if s.name in names}
    return _Read(timed, d, without(H, [s for s in parameters if s not in found], {}, "", value), found, lasting)


def _lettered(read: _Read, params: Mapping[str, float]) -> TracedHamiltonian:
    """The form of H = ½ pᵀM⁻¹p + V(q) with its letters as parameters."""
    (H,), inputs, d, n = read.H.program.outputs, read.H.program.inputs, read.ndof, read.timed + 2 * read.ndof
    values = values_of([*read.letters.values()], params)
    letters = [Variable(f"parameter_{i}") for i in range(len(values))]  # "a" is that of a drift
    own, within = inputs[n:], {x.order for x in reached([H])}
    _, M = kinetic_matrix(H, inputs[:n], d, own, values)
    if M is None or len(Program(inputs, gradient(H, inputs[read.timed : n]))) > MOST_OPERATIONS:
        raise NotPlain
    if read.timed and inputs[0].order not in within:  # by the values of parameters
        raise NotPlain
    rows = [[Formula(Program(own, [x]), letters) if isinstance(x, Traced) else x for x in row] for row in M]
    rest = [0.0] * d
    V = traced(lambda *x: read.H.program(*x[: n - d], *rest, *x[n - d :]), *map(repr, (*inputs[: n - d], *own)))
    if not isinstance(V.outputs[0], Traced):
        raise NotPlain
    return TracedHamiltonian(d, V, True, rows, read.timed, parameters=letters, values=values)


class TextForm(TracedHamiltonian):
    """The form of a text, by the values of its parameters; the `parametric` one has letters in their place."""

    def __init__(self, of: WrittenHamiltonian) -> None:
        lettered, numbers = of.lettered, of.lettered.values
        names = map(repr, lettered.program.inputs[: of.timed + of.ndof])
        V = traced(lambda *x: lettered.program(*x, *numbers), *names)
        super().__init__(of.ndof, V, True, of.inverse_mass, of.timed)
        self._of, self.text = of, of.text

    @property
    def parametric(self) -> TracedHamiltonian:
        return self._of.lettered if self._of.lettered.parameters else self

    def named(self, names: Sequence[str]) -> TracedHamiltonian:
        """The form with these parameters as letters, whatever their values."""
        first = {name: self._of.params[name] for name in names}  # in their order
        params = {**first, **self._of.params}
        return _lettered(_read(self._of.source, params, self._of.timed, names), params)

    @cached_property
    def written(self) -> SymbolicHamiltonian:
        from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

        root, own = self._of.root.form, self._of
        found = None if root is self else root.written.revalued(own.params)
        return SymbolicHamiltonian(own.text, own.params, own.named_time) if found is None else found


class Lettered:
    """The functions of H with numbers for its letters, and the `meanings` of these."""

    def __init__(self, form: TracedHamiltonian, meanings: Sequence[Formula] = ()) -> None:
        self.meanings, self.hamiltonian, self.gradient = meanings, form.hamiltonian, form.hamiltonian_gradient
        self.poles = TracedPoles(form) or None


class WrittenHamiltonian(Definition):
    """H = ½ pᵀM⁻¹p + V(q, t) as a text, by its program; `symbols` are made of the text when they are asked for."""

    separable = has_third_derivative = symbolic = True

    def __init__(
        self,
        text: str,
        params: Mapping[str, float],
        lettered: TracedHamiltonian,
        meanings: Sequence[Formula],
        lasting: Sequence[Formula],
        root: WrittenHamiltonian | None = None,
    ) -> None:
        self.text = self.source = text
        self.params, self.lettered, self.ndof = params, lettered, lettered.ndof
        self.timed = lettered.time is not None
        self.named_time = "t" if self.timed else None
        self._meanings, self._lasting, self.root = tuple(meanings), lasting, self if root is None else root
        M, d = lettered.inverse_mass, self.ndof
        assert M is not None
        known = evaluator(dict(zip(lettered.parameters, lettered.values, strict=True)))
        self.inverse_mass = simplest(np.array([[known(M[i, j]) for j in range(d)] for i in range(d)], dtype=float))
        self.form = TextForm(self)

    @property
    def name(self) -> str:
        return self.symbols.name

    @property
    def symbols(self) -> Any:
        return self.form.written

    @cached_property
    def poles(self) -> TracedPoles | None:
        return TracedPoles(self.form) or None

    _generated = ("poles", "parametric")

    @cached_property
    def parametric(self) -> Any:
        """The functions with numbers for the letters; the definition itself, where it has none."""
        return Lettered(self.lettered, self._meanings) if self._meanings else self

    @property
    def meanings(self) -> tuple[Formula, ...]:
        return self._meanings

    @property
    def parametric_parts(self) -> tuple[list[Formula], set[str]]:
        return [*self._meanings, *self._lasting], set()

    def named(self, names: Sequence[str]) -> Lettered:
        """The functions with numbers for these parameters."""
        return Lettered(self.form.named(names))

    def revalued(self, params: Mapping[str, float]) -> WrittenHamiltonian | None:
        """The same H with other values of its parameters; None where it may have another structure."""
        numbers = revalued(*self.parametric_parts, self._meanings, self.params, params)
        if numbers is None or not self._meanings:
            return None
        lettered = copy.copy(self.lettered)
        lettered.values = numbers
        found = WrittenHamiltonian(self.source, params, lettered, self._meanings, self._lasting, self.root)
        M = np.eye(self.ndof) if found.inverse_mass is None else found.inverse_mass
        return found if np.linalg.eigvalsh(np.diag(M) if M.ndim == 1 else M)[0] > 0 else None

    def potential(self, q: Array, *t: Array) -> Array:
        return self.form.value(q, *t)

    def potential_gradient(self, q: Array, *t: Array) -> Array:
        return self.form.gradient(q, *t)

    def potential_hessian(self, q: Array, *t: Array) -> Array:
        return self.form.hessian(q, *t)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        return self.form.hessian_vector(q, v, *t)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        return self.form.third_derivative(q, v, w, *t)

    def time_derivative(self, y: Array, t: Array) -> Array:
        """∂V/∂t, of which T has no part."""
        return self.form.time_derivative(y[..., : self.ndof], t)


def written(
    text: str, params: Mapping[str, Any] = MappingProxyType({}), timed: bool = False
) -> WrittenHamiltonian | None:
    """The definition by the program of a text, `timed` if it depends on t; None where the text is left to SymPy."""
    try:
        read = _read(text, params, timed)
        lettered = _lettered(read, params)
    except (NotPlain, ArithmeticError, ValueError, TypeError, RecursionError):
        return None
    return WrittenHamiltonian(text, params, lettered, [*read.letters.values()], read.lasting)
