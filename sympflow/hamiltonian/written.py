"""H as a text whose program is read off the grammar; SymPy is imported once its symbols are asked for."""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property, reduce
from operator import mul
from typing import Any

import numpy as np

from sympflow.arrays import Array
from sympflow.compiler.functions import apply
from sympflow.compiler.program import Program, Recording, Traced, gradient, reached, traced
from sympflow.hamiltonian.definition import Definition
from sympflow.hamiltonian.formulas import TracedHamiltonian, TracedPoles, kinetic_matrix
from sympflow.hamiltonian.grammar import COORDINATE, chain, parsed

FUNCTIONS = {name: name for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "atan")}
FUNCTIONS["ln"] = "log"
ARITHMETIC = {"input", "add", "sub", "mul", "div", "neg", "pow", "times", "fma"}
MOST_DEGREES, MOST_OPERATIONS = 16, 100  # of the slopes of H, written out
MOST_POWER, MOST_BITS = 64, 2000


class NotPlain(Exception):
    """The text is left to SymPy, which simplifies and judges its parts, and says what is wrong in it."""


class _Reader:
    """A text with numbers of a recording: fractions and floats stay such, whatever depends on coordinates is traced."""

    def __init__(self, coordinates: dict[str, Traced]) -> None:
        self.coordinates = coordinates
        self.infinite = set[int]()  # the numbers that are infinite somewhere, by what they divide by

    def value(self, node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return Fraction(number)
            case ast.Name(id="pi"):
                return Fraction(math.pi)
            case ast.Name(id=name) if name in self.coordinates:
                return self.coordinates[name]
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
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
                return self._call(FUNCTIONS[name], self.value(argument))
        raise NotPlain

    def _sum(self, members: Sequence[Any]) -> Any:
        numbers = [x for x in members if isinstance(x, Fraction)]
        moving = [x for x in members if isinstance(x, Traced)]
        if not moving:
            return sum(numbers)
        if sum(x.order in self.infinite for x in moving) > 1:  # a difference may have a finite limit
            raise NotPlain
        total = self._marked(sum(moving[1:], moving[0]), moving)
        return total + float(sum(numbers)) if numbers else total

    def _product(self, factors: Sequence[Any]) -> Any:
        number = reduce(mul, (x for x in factors if isinstance(x, Fraction)), Fraction(1))
        moving = [x for x in factors if isinstance(x, Traced)]
        if not moving:
            return number
        if len(moving) > 1 and any(x.order in self.infinite for x in moving):  # a quotient may have a finite limit
            raise NotPlain
        return self._marked(float(number) * reduce(mul, moving), moving)

    def _power(self, base: Any, exponent: Any) -> Any:
        if not isinstance(exponent, Fraction) or abs(exponent) > MOST_POWER:
            raise NotPlain
        if isinstance(base, Fraction) and max(base.numerator.bit_length(), base.denominator.bit_length()) > MOST_BITS:
            raise NotPlain
        whole = exponent.denominator == 1
        if isinstance(base, Fraction):
            return base ** int(exponent) if whole else Fraction(float(base) ** float(exponent))
        if base.name in ("sqrt", "pow", "div") and not (base.name == "sqrt" and exponent == -1):  # joined by SymPy
            raise NotPlain
        if not whole and base.name not in ("input", "add", "sub"):  # as √x², which is |x|
            raise NotPlain
        if not (whole and exponent > 0) and not ARITHMETIC.issuperset(x.name for x in reached([base])):
            raise NotPlain  # functions may overflow, or cancel, as 1 − cos x
        x = apply("pow", base.args[0], -0.5) if base.name == "sqrt" else apply("pow", base, float(exponent))
        return self._marked(x, [base], exponent < 0)

    def _call(self, name: str, x: Any) -> Any:
        if isinstance(x, Fraction):
            return Fraction(getattr(math, name)(x))
        if name == "sqrt":
            return self._power(x, Fraction(1, 2))
        known = {each.name for each in reached([x])}
        if x.order in self.infinite or (name == "log" and known - ARITHMETIC) or (name == "exp" and "log" in known):
            raise NotPlain
        return self._marked(apply(name, x), [x], name == "log")

    def _marked(self, x: Any, made_of: Sequence[Traced], infinite: bool = False) -> Any:
        if not isinstance(x, Traced):  # terms that cancel
            raise NotPlain
        if infinite or any(part.order in self.infinite for part in made_of):
            self.infinite.add(x.order)
        return x


def _form(text: str) -> tuple[TracedHamiltonian, np.ndarray | None]:
    """The program of H = ½ pᵀM⁻¹p + V(q), a text of few terms."""
    tree = parsed(text, FUNCTIONS)
    used = {x.id for x in ast.walk(tree) if isinstance(x, ast.Name) and COORDINATE.fullmatch(x.id)}
    d = max((int(name[1:] or 1) for name in used), default=0)
    numbered = all(len(name) > 1 for name in used)
    if not 0 < d <= MOST_DEGREES or not (numbered or used <= {"q", "p"}):
        raise NotPlain
    recording = Recording()
    inputs = [recording.input(f"{letter}{i + 1}") for letter in "qp" for i in range(d)]
    known = dict(zip(map(repr, inputs) if numbered else "qp", inputs, strict=True))
    H = _Reader(known).value(tree)
    _, quadratic, inverse_mass = kinetic_matrix(H, inputs, d)
    if not quadratic or len(Program(inputs, gradient(H, inputs))) > MOST_OPERATIONS:
        raise NotPlain
    rest = [0.0] * d
    V = traced(lambda *q: Program(inputs, [H])(*q, *rest), *map(repr, inputs[:d]))
    if not isinstance(V.outputs[0], Traced):
        raise NotPlain
    return TracedHamiltonian(d, V, True, inverse_mass, text=text), inverse_mass


class WrittenHamiltonian(Definition):
    """H = ½ pᵀM⁻¹p + V(q) as a text, by its program; `symbols` are made of the text when they are asked for."""

    separable = has_third_derivative = True

    def __init__(self, form: TracedHamiltonian) -> None:
        self.form, self.ndof, self.text = form, form.ndof, form.text

    @property
    def name(self) -> str:
        return self.symbols.name

    @property
    def symbols(self) -> Any:
        return self.form.written

    @cached_property
    def poles(self) -> Any:
        return self.symbols.poles if TracedPoles(self.form) else None

    _generated = ("poles",)

    def potential(self, q: Array) -> Array:
        return self.form.value(q)

    def potential_gradient(self, q: Array) -> Array:
        return self.form.gradient(q)

    def potential_hessian(self, q: Array) -> Array:
        return self.form.hessian(q)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        return self.form.hessian_vector(q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        return self.form.third_derivative(q, v, w)


def written(text: str) -> tuple[WrittenHamiltonian, np.ndarray | None] | None:
    """The definition by the program of a text, and M⁻¹; None where the text is left to SymPy."""
    try:
        form, inverse_mass = _form(text)
    except (NotPlain, ArithmeticError, ValueError, TypeError, RecursionError):
        return None
    return WrittenHamiltonian(form), inverse_mass
