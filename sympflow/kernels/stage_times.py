"""Systems whose H depends on t as code: what depends on t alone is computed once a stage, outside loops over states.

The extended Hamiltonian T(p, t) + E + V(q, t) is split into a drift, which moves q and t, and a kick at a fixed time.
Let the degree of E be 2 and that of p be 1: the drift raises the degree of a polynomial in p by at most 1, a kick
lowers it by 1. So all brackets that vanish by their degree where H does not depend on t vanish here, those of Nyström
and force-gradient schemes among them, and the kicks of these are taken at a fixed time as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from sympflow.compiler import NotCompiled
from sympflow.compiler.functions import apply, where
from sympflow.compiler.tables import Table
from sympflow.hamiltonian.driving import DURATION, drift, with_symbols
from sympflow.hamiltonian.formulas import evaluator, recorded
from sympflow.hamiltonian.parameters import Samples
from sympflow.hamiltonian.recorded import check_recorded
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

__all__ = ["Driving", "SymbolicCoefficients", "coefficients_of_time", "driven_form"]


@dataclass(frozen=True)
class Driving:
    """A system whose H depends on t, written with parameters that change from stage to stage.

    The parameters of `form` are constants, then `time_coefficients`, functions of t and of these, then `means` over a
    drift: a function of t and its integral over a `DURATION`. `samples` are by their names.
    """

    form: SymbolicHamiltonian
    time: sp.Symbol
    time_coefficients: Mapping[sp.Symbol, sp.Expr]
    means: Mapping[sp.Symbol, tuple[sp.Expr, sp.Expr]]
    samples: Mapping[str, Samples]

    @property
    def key(self) -> tuple[Any, ...]:
        """Same for systems that share their code: names of samples have their digests."""
        return self.time, *self.time_coefficients.items(), *self.means.items()

    def values_at(self, time: Any, length: Any, fixed: Sequence[Any]) -> list[Any]:
        """The coefficients at a time, and their means over a length from there, in compiled code."""
        parameters = dict(zip(self.form.parameters, fixed, strict=False))
        values = _values(self._expressions, {self.time: time, DURATION: length, **parameters}, self.samples)
        means, first = list[Any](), len(self.time_coefficients)
        for f, integral in zip(values[first::2], values[first + 1 :: 2], strict=True):
            means.append(where(apply("eq", length, 0.0), f, integral / length))
        return [*values[:first], *means]

    @property
    def _expressions(self) -> list[sp.Expr]:
        return [*self.time_coefficients.values(), *(f for pair in self.means.values() for f in pair)]

    def check(self) -> None:
        """Raise a ValueError for expressions without a compiled form."""
        _check((self.form.V, self.form.T, *self._expressions))


def driven_form(symbols: SymbolicHamiltonian) -> Driving:
    """The driven form of a separable H; NotCompiled if T is not a sum of f(t) g(p) with elementary ∫f dt."""
    t = symbols.time
    assert t is not None
    assert symbols.T is not None
    values = dict(zip(symbols.parameters, map(sp.Float, symbols.values), strict=True))
    of_V: dict[sp.Expr, sp.Symbol] = {}
    V = coefficients_of_time(symbols.V, t, {*symbols.parameters}, of_V, "letter")
    T, of_T = _kinetic(symbols, symbols.T.xreplace(values) if symbols.T.has(t) else symbols.T)
    coefficients = {s: f for f, s in of_V.items()}
    means = {s: (f, drift((f,), t)[0]) for f, s in of_T.items()}
    form = symbols.like(T + V)
    form.parameters, form.values = (*symbols.parameters, *coefficients, *means), symbols.values
    return Driving(form, t, coefficients, means, symbols.samples)


def _kinetic(symbols: SymbolicHamiltonian, T: sp.Expr) -> tuple[sp.Expr, dict[sp.Expr, sp.Symbol]]:
    """T with coefficients for functions of t, in which it is linear; these coefficients."""
    for expression in (T, sp.expand(T)):
        found: dict[sp.Expr, sp.Symbol] = {}
        moving = [term for term in sp.Add.make_args(expression) if term.free_symbols & {*symbols.p}]
        lettered = coefficients_of_time(sp.Add(*moving), symbols.time, set(), found, "mean")
        coefficients = {*found.values()}
        if not any(sp.diff(lettered, s).free_symbols & coefficients for s in coefficients):
            return lettered, found
    raise NotCompiled(
        f"`system` has the kinetic energy {symbols.T}, which is not a sum of products of functions of {symbols.time} "
        "and of p: use an implicit method such as 'gauss_legendre6'."
    )


class SymbolicCoefficients:
    """Expressions in q, p and `given`: the parameters, and coefficients that depend on these and the time."""

    def __init__(self, symbols: SymbolicHamiltonian, expressions: Sequence[sp.Expr]) -> None:
        _check(expressions)
        found: dict[sp.Expr, sp.Symbol] = {}
        time, fixed = symbols.time, {*symbols.parameters}
        self.expressions = list(expressions)
        if time is not None:
            self.expressions = [coefficients_of_time(f, time, fixed, found, "letter") for f in expressions]
        self.symbols, self.time_coefficients = symbols, {s: f for f, s in found.items()}
        self.given = (*symbols.parameters, *self.time_coefficients)

    def at(self, t: Any, parameters: Sequence[Any]) -> list[Any]:
        """The coefficients at times t."""
        known = {self.symbols.time: t, **dict(zip(self.symbols.parameters, parameters, strict=True))}
        return _values(self.time_coefficients.values(), known, self.symbols.samples)


def _check(expressions: Iterable[sp.Expr]) -> None:
    """Refuse what has no compiled form."""
    for f in with_symbols(list(expressions))[0]:
        check_recorded(f)


def _values(expressions: Iterable[sp.Expr], known: dict[Any, Any], samples: Mapping[str, Samples]) -> list[Any]:
    """The values of expressions, in compiled code, for those of their symbols."""
    without, found = with_symbols(list(expressions))
    at = evaluator(known)
    values = [sampled_value(samples[f.name_of_samples], f.order, at(f.at)) for f in found]
    return recorded(without, (*known, *found.values()))(*known.values(), *values)


def coefficients_of_time(
    f: sp.Expr, t: sp.Symbol, fixed: set[sp.Symbol], found: dict[sp.Expr, sp.Symbol], prefix: str
) -> sp.Expr:
    """The expression with symbols for its parts that depend on t and on fixed symbols alone; these in `found`."""
    if t not in f.free_symbols:
        return f
    known = {t, *fixed}
    if f.free_symbols <= known and isinstance(f, sp.Expr):
        number, part = f.as_coeff_Mul()
        return number * found.setdefault(part, sp.Symbol(f"{prefix}_{len(found)}", real=True))
    if f.is_Add or f.is_Mul:
        alone = [a for a in f.args if a.free_symbols <= known]
        others = [coefficients_of_time(a, t, fixed, found, prefix) for a in f.args if not a.free_symbols <= known]
        return f.func(coefficients_of_time(f.func(*alone), t, fixed, found, prefix), *others)
    return f.func(*[coefficients_of_time(a, t, fixed, found, prefix) if isinstance(a, sp.Basic) else a for a in f.args])


# functions of the time that are given by samples ----------------------------------------------------------------------


def sampled_value(samples: Samples, order: int, t: Any) -> Any:
    """A derivative of samples, of order −1 the antiderivative, at times t: the polynomial of the interval of each."""
    c, x = samples.polynomials(order), samples.x
    first, last = float(x[0]), float(x[-1])
    turns: Any = 0.0
    if samples.periodic:
        turns = apply("floor", (t - first) / (last - first))
        t = t - turns * (last - first)
    times, coefficients, k = Table(x), Table(c.T), len(c)
    i = apply("interval", times, t)
    s = t - apply("entry", times, i, 0.0)
    total = apply("entry", coefficients, i * float(k), 0.0)
    for j in range(1, k):
        total = total * s + apply("entry", coefficients, i * float(k), float(j))
    if order < 0:
        total = total + turns * float(np.polyval(c[:, -1], last - float(x[-2])))
    return total
