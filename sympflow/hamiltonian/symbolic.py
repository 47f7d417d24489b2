"""One symbolic definition of H, and the NumPy and torch functions generated from it."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from itertools import islice
from operator import add
from types import MappingProxyType
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from sympflow.arrays import Array, assemble, beside, concatenate, library_name
from sympflow.compiler import NotCompiled
from sympflow.compiler.functions import apply
from sympflow.compiler.program import Program
from sympflow.compiler.program import gradient as slopes
from sympflow.hamiltonian.definition import Definition
from sympflow.hamiltonian.driving import (
    DURATION,
    drift,
    sampled,
    sampled_parameter,
    with_symbols,
)
from sympflow.hamiltonian.expression import COORDINATE, FUNCTIONS, complex_part, of_sympy, stated
from sympflow.hamiltonian.jumps import (
    MOST_IMPULSES,
    MOST_POINTS,
    Impulse,
    Switch,
    Touch,
    Zeros,
    borders,
    check_continuous,
    has_period,
    refuse_deltas,
    split_impulses,
    touches,
)
from sympflow.hamiltonian.parameters import LARGEST, Samples, check_span, checked_params
from sympflow.hamiltonian.poles import Poles, SymbolicPoles
from sympflow.hamiltonian.quantities import Formula, Variable, revalued, values_of
from sympflow.hamiltonian.recorded import recorded
from sympflow.hamiltonian.removable import BOUNDED, Max, cancelling, exact, may_cancel, removed, with_values
from sympflow.show.cards import cut

TINY = 1e-150
MOST_LEFT_OUT = 100  # degrees of freedom up to the last one that a formula may do without
LONGEST_NAME = 40  # in messages
MOST_WRITTEN = 16  # variables of a Hessian whose entries are written out
MOST_COORDINATES = 10_000  # degrees of freedom of an H that is written out
FAR = 1000.0
"""The time before and after 0 in which it is looked if H jumps, where that is at no zeros of linear functions."""


@dataclass(frozen=True)
class Kick:
    """The impulses of H at a time: with terms δ(g(t))·W(q, t) the flow p −= Σ ∇W(q, t)/|g'(t)|."""

    t: float
    potentials: tuple[tuple[float, SymbolicHamiltonian], ...]

    def __call__(self, y: Array, sign: float = 1.0) -> Array:
        """Return the states (..., 2d) after the kick, for those before; with a sign of −1 the reverse."""
        d = y.shape[-1] // 2
        q, p = y[..., :d], y[..., d:]
        for strength, W in self.potentials:
            p = p - (sign * strength) * W.gradient(y, self.t)[..., :d]
        return concatenate([q, p])


def _evaluation(name: str, order: int) -> Callable[..., Array]:
    """Return a method: an expression, its gradient or its Hessian at arrays (..., n), and at times."""

    def evaluate(self: SymbolicHamiltonian, x: Array, *t: Array, **numbers: Any) -> Array:
        return self._derivative(name, order)(x, *t, **numbers)

    return evaluate


class SymbolicHamiltonian(Definition):
    """H(q, p) as a SymPy expression; its derivatives; array functions of them.

    H, V and T are expressions in the symbols `q`, `p` and `time`; V and T are None unless H = T(p) + V(q), each of t
    too. A `parametric` form has `parameters`, symbols for parts of H that depend on parameters alone, with their
    `values` and, by the parameters of H as it was written, their `meanings`. `samples` are the functions of t that are
    given by samples, by the names that `driving.sampled` has in H.
    """

    symbolic = True
    parameters: tuple[sp.Symbol, ...] = ()
    values: tuple[float, ...] = ()
    meanings: tuple[Formula, ...] = ()
    left_out: sp.Expr = sp.S.Zero
    """The terms of H without coordinates, in its parameters, which a form does not have."""
    _written: tuple[sp.Expr, dict[sp.Symbol, sp.Expr]] | None = None
    """H as it was written, and the values of its parameters; None without any."""
    time: Any = None
    named_time: sp.Symbol | None = None
    """The time as it was given; `time` is None where H, by the values of its parameters, does not depend on it."""
    samples: Mapping[str, Samples] = MappingProxyType({})
    impulses: tuple[tuple[Zeros, SymbolicHamiltonian], ...] = ()
    """The zeros of g, and W, of the terms δ(g(t))·W(q, t) of H."""
    _rest: SymbolicHamiltonian | None = None  # H without its impulses, where it has some

    def __init__(
        self, expression: str | sp.Expr, params: Mapping[str, Any] | None = None, time: str | sp.Symbol | None = None
    ) -> None:
        params = checked_params(params)
        self.time = self.named_time = named_time(time, params)
        written, values = _read(expression, params, self.time)
        H = _valued(written, values, self.time)
        if self.time is not None and self.time in written.free_symbols - H.free_symbols:
            self.time = None
        if time is None and self.time is not None:
            _check_samples(written, values)
        if self.time is not None:
            if self.time not in H.free_symbols:
                raise ValueError(f"`time` is {self.time.name!r}, which H does not depend on: leave it out.")
            self.samples = {
                found.name_of_samples: params[symbol.name]
                for symbol, found in values.items()
                if isinstance(found, sampled)
            }
        used = {_index(s) for s in H.free_symbols} - {0}
        ndof = max(used, default=0)
        if ndof == 0:
            raise ValueError("`expression` must depend on q1 … qd and p1 … pd (or q and p).")
        if ndof - len(used) > MOST_LEFT_OUT:
            raise ValueError(
                f"`expression` has coordinates numbered up to {str(ndof)[:20]}, and depends on {len(used)} degrees of "
                "freedom: number them from 1, q1 … qd and p1 … pd."
            )
        if ndof > MOST_COORDINATES:
            raise ValueError(
                f"`expression` has {ndof:,} coordinates by its highest index, more than {MOST_COORDINATES:,}: give a "
                "system that large by one site and one bond, HamiltonianSystem.lattice, or by one pair, "
                "HamiltonianSystem.pairs."
            )
        plain = {sp.Symbol("q", real=True), sp.Symbol("p", real=True)} & H.free_symbols
        if plain and (ndof > 1 or any(sp.Symbol(f"{s.name}1", real=True) in H.free_symbols for s in plain)):
            raise ValueError("`expression` mixes q, p with numbered coordinates: write q1, p1.")
        self.ndof = ndof
        self.q = tuple(sp.symbols(f"q1:{ndof + 1}", real=True))
        self.p = tuple(sp.symbols(f"p1:{ndof + 1}", real=True))
        numbered = {sp.Symbol("q", real=True): self.q[0], sp.Symbol("p", real=True): self.p[0]}
        if values:
            _check_values(H, values)
            self._written = written.xreplace(numbered), values
        H = H.xreplace(numbered)
        if H.has(sp.DiracDelta):
            rest, potentials = split_impulses("expression", H, self.time, self.q, self.p)
            self._rest = self.like(rest)
            self.impulses = tuple((Zeros(g, self.time), self.like(W)) for g, W in potentials.items())
            if self.time not in rest.free_symbols:
                self._rest.time = None
            H = H.replace(sp.DiracDelta, lambda g, *_: Impulse(g))
        self._set(H)
        _check_real(self.H)

    def _set(self, H: sp.Expr) -> None:
        self.H: sp.Expr = _with_numeric_constants(H)
        self.V, self.T = _split(self.H, self.q, self.p)
        self.separable = self.V is not None

    def like(self, H: sp.Expr) -> SymbolicHamiltonian:
        """Another H in the same coordinates and time, and with the same samples."""
        form = SymbolicHamiltonian.__new__(SymbolicHamiltonian)
        form.ndof, form.q, form.p, form.time = self.ndof, self.q, self.p, self.time
        form.named_time = self.named_time
        if self.samples:
            form.samples = self.samples
        form._set(H)
        return form

    @cached_property
    def parametric(self) -> SymbolicHamiltonian:
        """H with symbols for what depends on parameters alone: one for all values that leave its structure as it is."""
        if self._written is None:
            return self
        written, values = self._written
        samples = {s: value for s, value in values.items() if isinstance(value, sampled)}
        symbols = _ParameterSymbols({s: value for s, value in values.items() if s not in samples})
        try:
            H = symbols.put_into(written.xreplace(samples))
        except (TypeError, OverflowError):  # a value that is not a real number
            return self
        states = {*self.q, *self.p}
        terms = sp.Add.make_args(H)
        form = self.like(sp.Add(*[term for term in terms if term.free_symbols & states]))
        constant = sp.Add(*[term for term in terms if not term.free_symbols & states])
        form.left_out = constant.xreplace({symbol: part for part, symbol in symbols.found.items()})
        used = form.H.free_symbols - states - {self.time}
        kept = {symbol: part for part, symbol in symbols.found.items() if symbol in used}
        try:
            form.parameters, form.meanings = tuple(kept), tuple(map(_formula, kept.values()))
        except NotCompiled:
            return self
        form.values = tuple(values_of(form.meanings, self.numbers))
        alike = (
            used == {*form.parameters}
            and form.separable == self.separable
            and (form.inverse_mass is None) == (self.inverse_mass is None)
            and cancelling(form.H) == cancelling(self.H)
        )
        return form if kept and alike and all(map(math.isfinite, form.values)) else self

    @property
    def numbers(self) -> dict[str, float]:
        """The values of the parameters that are numbers."""
        return {s.name: float(value) for s, value in self.written[1].items() if not isinstance(value, sampled)}

    def named(self, names: Sequence[str]) -> SymbolicHamiltonian:
        """H with these parameters as symbols, whatever their values: the form by which it is differentiated by them."""
        key = tuple(names)
        if key not in self._named:
            written, values = self.written
            symbols = {name: sp.Symbol(f"parameter_{i}", real=True) for i, name in enumerate(names)}
            H = written.xreplace({s: symbols.get(s.name, value) for s, value in values.items()})
            form = self.like(H)
            form.parameters = tuple(symbols.values())
            form.values = tuple(self.numbers.get(name, 0.0) for name in names)  # 0 of one that H does not have
            self._named[key] = form
        return self._named[key]

    @cached_property
    def _named(self) -> dict[tuple[str, ...], SymbolicHamiltonian]:
        return {}

    @cached_property
    def name(self) -> str:
        return cut(f"H = {self.written[0]}", 60)

    def revalued(self, params: Mapping[str, float]) -> Revalued | None:
        """The same H with other values of its parameters, by the functions and the code of this one.

        None where H may have another structure with these, which is then to be found anew.
        """
        form, (written, before) = self.parametric, self.written
        if form is self or self.time is not None or self.impulses or form.may_cancel:
            return None
        values = {s: exact(params[s.name]) for s in before}
        numbers = revalued(*self.parametric_parts, form.meanings, self.numbers, params)
        return None if numbers is None else Revalued(self, form, written, values, numbers)

    @cached_property
    def may_cancel(self) -> bool:
        """True if parts of H may cancel by the values of its `parameters`."""
        return may_cancel(self.H, {*self.parameters})

    @property
    def written(self) -> tuple[sp.Expr, dict[sp.Symbol, sp.Expr]]:
        """H as it was written, in the numbered coordinates, and the values of its parameters."""
        return (self.H, {}) if self._written is None else self._written

    @cached_property
    def parametric_parts(self) -> tuple[list[Formula], set[str]]:
        symbols = _ParameterSymbols(self.written[1])
        symbols.put_into(self.written[0])
        return [*map(_formula, (*symbols.found, *symbols.numbers))], {s.name for s in symbols.replaced}

    @property
    def source(self) -> sp.Expr:
        return self.written[0]

    @property
    def symbols(self) -> SymbolicHamiltonian:
        return self

    @property
    def form(self) -> SymbolicHamiltonian:
        return self

    @property
    def structure(self) -> SymbolicHamiltonian:
        """H with the values with which it was first given: the source of all that does not depend on these values."""
        return self

    @property
    def timed(self) -> bool:  # type: ignore[override]
        return self.time is not None

    @cached_property
    def kinetic_timed(self) -> bool:  # type: ignore[override]
        """True if T depends on the time."""
        return self.time is not None and self.T is not None and self.time in self.T.free_symbols

    @cached_property
    def shortest_piece(self) -> float:  # type: ignore[override]
        return min((samples.shortest_piece for samples in self.samples.values()), default=math.inf)

    @cached_property
    def jumps(self) -> bool:
        """True if H jumps at some times: of samples, of a function of the time that jumps, or of impulses."""
        if self.impulses or self.shortest_piece < math.inf:
            return True
        return any(each.at_root or len(each.times(-FAR, FAR, FAR / MOST_POINTS)) for each in self._switches)

    @cached_property
    def may_jump(self) -> bool:  # type: ignore[override]
        return bool(self.samples or self._switches)

    @cached_property
    def _switches(self) -> list[Switch | Touch]:
        """Places at which H may jump, or have a kink, in t alone."""
        if self.time is None:
            return []
        own = [border for border in borders(self.H, [self.time], kinks=True) if border.g.free_symbols == {self.time}]
        jumping = [Switch(border, self.time, self.samples) for border in own]
        return [*jumping, *touches(self.H, self.time, self.samples)]

    def jump_times(self, low: float, high: float, step: float, kinks: bool = False) -> np.ndarray:
        found = [samples.jump_times(low, high, kinks) for samples in self.samples.values()]
        found += [each.times(low, high, step, kinks) for each in self._switches]
        times = np.unique(np.concatenate(found)) if found else np.zeros(0)
        return times[np.diff(times, prepend=-np.inf) > 8 * sys.float_info.epsilon * np.abs(times)]

    def check_continuous(self) -> None:
        """Raise a ValueError where H jumps in q or p, at the borders of its pieces."""
        check_continuous("expression", self.between_impulses.H, (*self.q, *self.p))

    @property
    def between_impulses(self) -> SymbolicHamiltonian:
        """H without its impulses."""
        return self if self._rest is None else self._rest

    def kicks(self, low: float, high: float, step: float) -> list[Kick]:
        found: dict[float, list[tuple[float, SymbolicHamiltonian]]] = {}
        for zeros, W in self.impulses:
            times = zeros.within(low, high, step, MOST_IMPULSES)
            rates = zeros.slopes(times, step)
            met = W.jump_times(low, high, step)
            refused = {
                f"more than {MOST_IMPULSES:,} of them: take a shorter one": len(times) > MOST_IMPULSES,
                "one of infinite weight, a double zero: write it as DiracDelta(t - a)": not rates.all(),
                "a factor that jumps at one: leave that out": np.isclose(times[:, None], met, rtol=1e-12, atol=0).any(),
            }
            for what in (what for what, is_so in refused.items() if is_so):
                raise ValueError(f"`t_span` ({low:g}, {high:g}) has impulses DiracDelta({zeros.g}), and {what}.")
            for t, rate in zip(times.tolist(), rates.tolist(), strict=True):
                found.setdefault(t, []).append((1 / abs(rate), W))
        return [Kick(t, tuple(found[t])) for t in sorted(found)]

    def has_period(self, period: float) -> bool:
        """Return True if H, up to a function of t alone, has a period in t."""
        return has_period(self.H, self.time, (*self.q, *self.p), self.samples, period)

    @cached_property
    def Ht(self) -> sp.Expr:
        """∂H/∂t."""
        return sp.diff(self.H, self.time)

    @cached_property
    def drift(self) -> tuple[sp.Expr, ...]:
        """∫_t^{t+s} ∇T(p, u) du in p, t and s, which is `driving.DURATION`."""
        return drift(tuple(gradient(self.T, self.p)), self.time)

    @cached_property
    def inverse_mass(self) -> Any:
        """M⁻¹ if T = ½ pᵀM⁻¹p exactly, else None."""
        if self.T is None or not self.T.is_polynomial(*self.p):
            return None
        M = hessian(self.T, self.p)
        terms = [entry * self.p[i] * self.p[j] / 2 for (i, j), entry in M.todok().items()]
        if M.free_symbols & {*self.p, self.time} or sp.expand(self.T - sp.Add(*terms)) != 0:
            return None
        return M

    @cached_property
    def slope(self) -> tuple[sp.Expr, ...]:
        """∇V."""
        return tuple(sp.diff(self.V, s) for s in self.q)

    @cached_property
    def force_gradient(self) -> sp.Expr:
        """−½|∇V|²_{M⁻¹}."""
        slope = sp.Matrix(self.slope)
        return -(slope.T * self.inverse_mass * slope)[0] / 2

    @cached_property
    def W(self) -> sp.Expr:
        """½ v·∇²V v with v = M⁻¹∇V."""
        slope = sp.Matrix(self.slope)
        v = self.inverse_mass * slope
        return (v.T * sp.hessian(self.V, self.q) * v)[0] / 2

    @cached_property
    def poles(self) -> Poles | None:
        return SymbolicPoles(self) or None

    # array functions, state y = [q, p] on the last axis -------------------------------------------

    hamiltonian = _evaluation("H", 0)
    hessian = _evaluation("H", 2)
    time_derivative = _evaluation("Ht", 0)
    potential = _evaluation("V", 0)
    potential_gradient = _evaluation("V", 1)
    potential_hessian = _evaluation("V", 2)
    curvature = _evaluation("W", 0)
    curvature_gradient = _evaluation("W", 1)
    kinetic = _evaluation("T", 0)
    kinetic_gradient = _evaluation("T", 1)
    kinetic_hessian = _evaluation("T", 2)

    def gradient(self, y: Array, *t: Array, **numbers: Any) -> Array:
        if self.separable:
            q, p = y[..., : self.ndof], y[..., self.ndof :]
            return concatenate([self.potential_gradient(q, *t, **numbers), self.kinetic_gradient(p, *t, **numbers)])
        return self._derivative("H", 1)(y, *t, **numbers)

    def evaluated(self, name: str, expressions: list[sp.Expr]) -> Callable[..., Array]:
        """A function of y (..., 2d), and of t, that gives the values (..., n) of expressions, kept under a name."""
        return self._function(name, lambda: expressions, assemble)

    def drifted(self, p: Array, t: Array, s: Array) -> Array:
        """`drift` for times t and durations s, numbers or (...): (..., d) to (..., d)."""
        return self._function("drift", lambda: list(self.drift), assemble)(p, t, s)

    def drift_jacobian(self, p: Array, t: Array, s: Array) -> Array:
        """The derivatives of `drift` in p: (..., d) to (..., d, d)."""
        return self._function("drift'", lambda: list(sp.Matrix(self.drift).jacobian(self.p)), _square)(p, t, s)

    @property
    def text(self) -> str:  # type: ignore[override]
        """H, whatever the name of the time in t."""
        return str(self.H if self.time is None else self.H.xreplace({self.time: sp.Symbol("t", real=True)}))

    @property
    def span(self) -> tuple[float, float] | None:
        """The times that all samples cover; None without samples, or where all are periodic."""
        spans = [samples.span for samples in self.samples.values() if not samples.periodic]
        return (max(a for a, _ in spans), min(b for _, b in spans)) if spans else None

    def check_times(self, t0: float, t1: float) -> None:
        """Raise a ValueError where an interval leaves the times of samples."""
        check_span({name.rpartition("_")[0]: samples for name, samples in self.samples.items()}, t0, t1)

    def identity_parts(self) -> Any:
        """H, and the samples in it; the time has one name."""
        H = self.H if self.time is None else self.H.xreplace({self.time: sp.Symbol("t", real=True)})
        return [self.ndof, H, {name: samples.digest for name, samples in self.samples.items()}]

    def _variables(self, name: str) -> tuple[sp.Symbol, ...]:
        return {"V": self.q, "T": self.p, "W": self.q, "drift": self.p}.get(name, self.q + self.p)

    def _derivative(self, name: str, order: int) -> Callable[..., Array]:
        """A function of arrays: an expression, its gradient or its Hessian, by the order."""
        key = name + "'" * order
        if key in self._functions:
            return self._functions[key]

        def expressions() -> list[sp.Expr]:
            f, x = getattr(self, name), self._variables(name)
            return [f] if order == 0 else gradient(f, x) if order == 1 else list(hessian(f, x))

        n = len(self._variables(name))
        if order == 2 and n > MOST_WRITTEN:
            return self._function(key, lambda: [getattr(self, name)], _square, partial(_hessian_by_program, n))
        return self._function(key, expressions, (_single, assemble, _square)[order])

    def _function(
        self,
        key: str,
        expressions: Callable[[], list[sp.Expr]],
        collect: Callable[[Sequence[Array], Array], Array],
        make: Callable[..., Callable[..., list[Any]]] | None = None,
    ) -> Callable[..., Array]:
        """A function of an array (..., n), and of the time, made for NumPy or torch when first called with one."""
        if key in self._functions:
            return self._functions[key]
        make = generate if make is None else make
        name = key.rstrip("'")
        variables = self._variables(name)
        n, timed = len(variables), self.kinetic_timed if name in ("T", "drift") else self.timed
        moving = (self.time,) * timed + (DURATION,) * (name == "drift")
        generated: dict[str, Callable[..., list[Any]]] = {}
        values_of_samples: list[tuple[sampled, Callable[..., Any]]] = []

        def function(x: Array, *times: Array, numbers: Sequence[Any] = ()) -> Array:
            library = library_name(x)
            if library not in generated:
                wanted, sample_symbols = with_symbols([printable(f) for f in expressions()])
                values_of_samples[:] = [(a, sp.lambdify(moving, a.at, modules=[])) for a in sample_symbols]
                generated[library] = make(
                    wanted, (*variables, *moving, *self.parameters, *sample_symbols.values()), library
                )
            columns = [x[..., i] for i in range(n)]
            times = times[: len(moving)]
            times = tuple(beside(t, x) for t in times)
            sampled_values = [self.samples[a.name_of_samples](at(*times), a.order) for a, at in values_of_samples]
            try:
                values = generated[library](*columns, *times, *numbers, *sampled_values)
            except (NameError, AttributeError, TypeError) as error:
                raise TypeError(
                    f"`expression` cannot be evaluated with {library} ({error}): write it with functions that "
                    f"{library} has."
                ) from error
            return collect(values, columns[0])

        self._functions[key] = function
        return function

    _generated: tuple[str, ...] = ("_functions", "_switches", "poles")

    @cached_property
    def _functions(self) -> dict[str, Callable[[Array], Array]]:
        return {}


class Revalued(SymbolicHamiltonian):
    """H with other values of parameters: they are numbers of functions that are generated once for all of them.

    H, V and T with these values are made at first use, because few runs need them.
    """

    def __init__(
        self,
        like: SymbolicHamiltonian,
        form: SymbolicHamiltonian,
        written: sp.Expr,
        values: dict[sp.Symbol, sp.Expr],
        numbers: tuple[float, ...],
    ) -> None:
        self.ndof, self.q, self.p, self.separable = like.ndof, like.q, like.p, like.separable
        self._root: SymbolicHamiltonian = like.structure
        self._written = written, values
        self._form = copy(form)
        self._form.values, self._form._functions, self._form.inverse_mass = numbers, form._functions, form.inverse_mass

    @property
    def parametric(self) -> SymbolicHamiltonian:
        return self._form

    @property
    def structure(self) -> SymbolicHamiltonian:
        return self._root

    @cached_property
    def H(self) -> sp.Expr:
        written, values = self.written
        return _with_numeric_constants(_valued(written, values, None))

    @cached_property
    def _parts(self) -> tuple[Any, Any]:
        return _split(self.H, self.q, self.p)

    @property
    def V(self) -> Any:
        return self._parts[0]

    @property
    def T(self) -> Any:
        return self._parts[1]

    @cached_property
    def inverse_mass(self) -> Any:
        M = self._form.inverse_mass
        return M if M is None or not M.free_symbols else M.xreplace(dict(zip(*self._letters, strict=True)))

    @property
    def _letters(self) -> tuple[Sequence[sp.Symbol], Sequence[sp.Expr]]:
        return self._form.parameters, [*map(sp.Float, self._form.values)]

    @property
    def poles(self) -> Poles | None:
        return self._own_poles if self._root.poles else None

    @cached_property
    def _own_poles(self) -> Poles:
        return SymbolicPoles(self)

    @cached_property
    def _left_out(self) -> float:
        return float(self._form.left_out.xreplace(self.written[1]))

    def _derivative(self, name: str, order: int) -> Callable[..., Array]:
        function, numbers = self._form._derivative(name, order), self._form.values
        constant = self._left_out if order == 0 and name in ("H", "V") else 0.0

        def derivative(x: Array, *t: Array, **_: Any) -> Array:
            value = function(x, *t, numbers=numbers)
            return value + constant if constant else value

        return derivative

    _generated = (*SymbolicHamiltonian._generated, "_own_poles")


def _single(values: Sequence[Array], like: Array) -> Array:
    return assemble(values, like)[..., 0]


def _square(values: Sequence[Array], like: Array) -> Array:
    """Entries of a square matrix, row by row, as arrays: (..., n, n)."""
    flat, n = assemble(values, like), math.isqrt(len(values))
    return flat.reshape(*flat.shape[:-1], n, n)


VELOCITY_LIKE = re.compile(r"(d(q|x|y|z|r|theta|phi)|\w+_?dot|qd)\d*")
COORDINATE_LIKE = re.compile(r"[pqv]?[xyzr]\d?|[PQX]\d*|v|[pq]_?\w|[vpq]?_?(theta|phi)\d?")
"""Names of parameters that are coordinates elsewhere."""


def renamed(expression: str | sp.Expr, q: Any, p: Any) -> sp.Expr:
    """H in q1 … qd, p1 … pd, of an expression in the coordinates of these names, symbols or functions of the time."""
    rows = [[x] if isinstance(x, str | sp.Basic) else list(x or ()) for x in (q, p)]
    names = [str(x.func if isinstance(x, sp.Function) else x) for row in rows for x in row]
    if len(rows[0]) != len(rows[1]) or len(set(names)) < len(names) or not names:
        raise ValueError(
            f"`q` and `p` must name d coordinates each, all different, as in q=['x', 'y'], p=['px', 'py']; got {q!r} "
            f"and {p!r}."
        )
    if isinstance(expression, str):
        f = stated("expression", expression, {*names, *_AMBIGUOUS})
    else:
        given = dict(zip((x for row in rows for x in row), names, strict=True))
        motions = {x: sp.Symbol(name) for x, name in given.items() if isinstance(x, sp.Function | sp.Derivative)}
        f = of_sympy(expression.xreplace(motions), names)
    own = [sp.Symbol(f"{letter}{i + 1}", real=True) for letter in "qp" for i in range(len(rows[0]))]
    f = f.xreplace({sp.Symbol(name, real=True): symbol for name, symbol in zip(names, own, strict=True)})
    d = len(rows[0])
    for i in range(d):
        if not f.free_symbols & {own[i], own[d + i]}:
            raise ValueError(
                f"`q` and `p` name {names[i]!r} and {names[d + i]!r}, on which H does not depend: leave both out, or "
                "add their terms to H."
            )
    return f


def named_time(time: str | sp.Symbol | None, params: Mapping[str, Any]) -> sp.Symbol | None:
    """The symbol of the time, "t" if a parameter is sampled and no time is named; None without."""
    if time is None:
        if not any(isinstance(value, Samples) for value in params.values()):
            return None
        time = "t"
    name = time.name if isinstance(time, sp.Symbol) else time
    if not isinstance(name, str):
        raise TypeError(f"`time` must be the name of the time in H, such as 't'; got {time!r}.")
    if not name.isidentifier() or COORDINATE.fullmatch(name) or name in params or name in FUNCTIONS or name == "pi":
        what = (
            "a parameter"
            if name in params
            else "a coordinate"
            if COORDINATE.fullmatch(name)
            else "not the name of a symbol"
        )
        raise ValueError(f"`time` {name!r} is {what}: name the time otherwise, as time='t'.")
    return sp.Symbol(name, real=True)


def gradient(f: sp.Expr, x: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """∂f/∂x of each x, of a sum by the terms that hold it: of many terms and variables few do."""
    holding: dict[sp.Symbol, list[sp.Expr]] = {s: [] for s in x}
    for term in sp.Add.make_args(f):
        for s in term.free_symbols & holding.keys():
            holding[s].append(term)
    return [sp.Add(*[sp.diff(term, s) for term in holding[s]]) for s in x]


def hessian(f: sp.Expr, x: Sequence[sp.Symbol]) -> sp.Matrix:
    """∇²f, as `sympy.hessian`, by the terms that are not zero."""
    place, entries = {s: i for i, s in enumerate(x)}, {}
    for i, slope in enumerate(gradient(f, x)):
        later = sorted(j for s in slope.free_symbols if (j := place.get(s, -1)) >= i)
        for j, entry in zip(later, gradient(slope, [x[j] for j in later]), strict=True):
            entries[i, j] = entries[j, i] = entry
    return sp.SparseMatrix(len(x), len(x), entries)


def parse(expression: str | sp.Expr, params: Mapping[str, Any], time: sp.Symbol | None = None) -> sp.Expr:
    """The expression in real symbols, its parameters replaced by their values, samples by functions of the time."""
    return _valued(*_read(expression, checked_params(params), time), time)


TABULATED = "Give a potential by a function, HamiltonianSystem(lambda q: V(q[..., 0]), ndof=1)"


def _read(
    expression: str | sp.Expr, params: Mapping[str, Any], time: sp.Symbol | None
) -> tuple[sp.Expr, dict[sp.Symbol, sp.Expr]]:
    """The expression in real symbols, and the numbers, or functions of t, for those that are parameters."""
    names = {name: sp.Symbol(name, real=True) for name in params}
    meant = {*params, *(() if time is None else (time.name,))}
    known, given = {*meant, *_AMBIGUOUS} if isinstance(expression, str) else meant, params.values()
    remedy = {"remedy": TABULATED} if any(isinstance(value, Samples) for value in given) else {}
    H = stated("expression", expression, known, **remedy)
    _check_real(H)
    for name in params:
        if names[name] not in H.free_symbols:
            raise ValueError(f"`params` has {name!r}, which the expression does not use: remove it.")
    is_sampled = {name: isinstance(value, Samples) and time is not None for name, value in params.items()}
    return H, {
        names[name]: sampled_parameter(name, value, time) if is_sampled[name] else exact(value)
        for name, value in params.items()
    }


def _valued(H: sp.Expr, values: Mapping[sp.Symbol, sp.Expr], time: sp.Symbol | None) -> sp.Expr:
    """The expression, its parameters replaced by their values."""
    H = with_values(H, values)
    unknown = sorted(s.name for s in H.free_symbols if not COORDINATE.fullmatch(s.name) and s != time)
    if functions := sorted(map(str, H.atoms(AppliedUndef))):
        raise TypeError(
            f"`expression` holds {', '.join(functions)}: name what are coordinates, and which momentum belongs to "
            "which, as in from_sympy(H, q=[x], p=[p_x]); give the others a value."
        )
    if "t" in unknown:
        raise TypeError('`expression` depends on the time t: name it by time="t", for a system that is driven.')
    if unknown:
        shown = [name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}…" for name in unknown]
        meant = "".join(f" {_AMBIGUOUS[name]}." for name in unknown if name in _AMBIGUOUS)
        if any(COORDINATE_LIKE.fullmatch(name) for name in unknown):
            meant += (
                " Coordinates are q and p, or q1 … qd and p1 … pd: other names are given by "
                "from_sympy(H, q=['x', 'y'], p=['px', 'py'])."
            )
        if velocity := next((name for name in unknown if VELOCITY_LIKE.fullmatch(name)), ""):
            meant += (
                f" H is a function of momenta: if {velocity} is a velocity q', write p, which is ∂L/∂q', such as m*q',"
                " in its place."
            )
        raise ValueError(f"`expression` holds {', '.join(shown)} without a value: give it in `params`.{meant}")
    return H


def _check_real(H: sp.Expr) -> None:
    if (part := complex_part(H)) is not None:
        remedy = "leave the imaginary unit I out" if part == sp.I else f"write {part} with a positive base"
        raise ValueError(f"`expression` is complex: a Hamiltonian must be real, so {remedy}.")


def _check_values(H: sp.Expr, values: Mapping[sp.Symbol, sp.Expr]) -> None:
    """Refuse values with which H is not finite or not real, as a mass of 0 or the root of a negative number."""
    numbers = [abs(a) for a in H.atoms(sp.Number)]
    if H.has(sp.zoo, sp.nan, sp.oo) or complex_part(H) is not None or any(a > LARGEST for a in numbers):
        shown = ", ".join(f"{s} = {float(value):.9g}" for s, value in values.items() if value.is_number)
        raise ValueError(f"`params` has {shown}, but then the expression is not a finite real one: change them.")


def _check_samples(written: sp.Expr, values: Mapping[sp.Symbol, sp.Expr]) -> None:
    """Refuse samples that stand beside all coordinates, as those of a V(q) would, where no time is named."""
    terms = sp.Add.make_args(sp.expand(written))
    for symbol, value in values.items():
        if isinstance(value, sampled) and all(term.free_symbols <= values.keys() for term in terms if term.has(symbol)):
            raise ValueError(
                f"`params` has {symbol.name}, a spline, which is a function of the time: in a term without q and p it "
                f"moves nothing. {TABULATED}; where it is the time that is meant, pass time='t'."
            )


def _formula(part: sp.Expr) -> Formula:
    """A part of H that depends on parameters alone, as a program of these."""
    used = sorted(part.free_symbols, key=str)
    return Formula(recorded(part, used), [Variable(s.name) for s in used])


class _ParameterSymbols:
    """Symbols for the parts of H that depend on parameters alone."""

    def __init__(self, values: Mapping[sp.Symbol, sp.Expr]) -> None:
        self.values = values
        self.found: dict[sp.Expr, sp.Symbol] = {}
        self.numbers: dict[sp.Expr, float] = {}
        self.replaced: set[sp.Symbol] = set()

    def put_into(self, f: sp.Expr) -> sp.Expr:
        """The expression with these symbols."""
        parameters = self.values.keys()
        if not f.free_symbols & parameters:
            return f
        if f.free_symbols <= parameters:
            number, part = f.as_coeff_Mul()
            if part not in self.found:
                value = float(part.xreplace(self.values))
                if value in (0, 1, -1):
                    self.numbers[part] = value
                    return number * int(value)
                self.found[part] = sp.Symbol(f"parameter_{len(self.found)}", real=True)
            return number * self.found[part]
        if f.is_Add or f.is_Mul:  # in an order that is the same in each process
            ordered = sorted(f.args, key=sp.default_sort_key)
            coefficient = f.func(*[a for a in f.args if a.free_symbols <= parameters])
            moving = [self.put_into(a) for a in ordered if not a.free_symbols <= parameters]
            coefficient = self.put_into(coefficient)
            if f.is_Mul and len(moving) == 1 and moving[0].is_Add:  # as SymPy does it with a number
                return sp.Add(*[coefficient * a for a in moving[0].args])
            return f.func(coefficient, *moving)
        if f.is_Pow and f.base.free_symbols & parameters and (f.exp.is_Integer or not f.base.is_Mul):
            return self.put_into(f.base) ** self._replaced(f.exp)
        if isinstance(f, sp.Function) and len(f.args) == 1:
            return f.func(self.put_into(f.args[0]))
        return self._replaced(f)

    def _replaced(self, f: sp.Expr) -> sp.Expr:
        self.replaced |= f.free_symbols & self.values.keys()
        return f.xreplace(self.values)


_AMBIGUOUS = {
    "E": "Euler's number is written exp(1)",
    "I": "The imaginary unit has no place in a Hamiltonian, which must be real",
}
"""Names that are constants for SymPy, but in the text of a Hamiltonian more likely an energy, a moment of inertia."""


def _index(symbol: sp.Symbol) -> int:
    """1 for q1, p1, q and p; 2 for q2, p2; …, of very long ones the beginning."""
    return int(symbol.name[1:20] or 1) if COORDINATE.fullmatch(symbol.name) else 0


def _with_numeric_constants(H: sp.Expr) -> sp.Expr:
    """H with constants such as √2 or π as floating-point numbers: torch has no functions of Python numbers."""
    constants = [a for a in sp.preorder_traversal(H) if a.is_number and not a.is_Rational and not a.is_Float]
    return H.xreplace({a: a.evalf(17) for a in constants})


def printable(f: sp.Expr) -> sp.Expr:
    """A derivative as code needs it: numbers, series written out, the δ of a kink's second one left out."""
    f = without_deltas(f).replace(removed, lambda *args: removed(*args).written_out)
    if f.has(Max) and f.has(sp.Heaviside):
        f = f.replace(lambda e: e.is_Mul and e.has(sp.Heaviside), _bounded_below)
    return _with_numeric_constants(f)


def _bounded_below(f: sp.Mul) -> sp.Expr:
    """A product with Heaviside(x) and a negative power of Max(x, 0), which is 0/0 in arrays, as 0 for x ≤ 0."""
    steps = {x.as_base_exp()[0].args[0] for x in f.args if isinstance(x.as_base_exp()[0], sp.Heaviside)}
    for x in f.args:
        base, exponent = x.as_base_exp()
        if exponent.is_negative and isinstance(base, Max) and (held := [s for s in steps if base == Max(s, 0)]):
            return sp.Piecewise((f.xreplace({base: Max(held[0], TINY)}), held[0] > 0), (0, True))
    return f


def without_deltas(f: sp.Expr) -> sp.Expr:
    """A derivative as arrays need it: the δ of a kink, which no state meets, left out."""
    return f.replace(sp.DiracDelta, lambda *arguments: sp.S.Zero) if f.has(sp.DiracDelta) else f


def _split(H: sp.Expr, q: tuple[sp.Symbol, ...], p: tuple[sp.Symbol, ...]) -> tuple[Any, Any]:
    """V(q) and T(p) with H = T + V, or (None, None). Constants go to V."""
    qs, ps = set(q), set(p)
    terms = sp.Add.make_args(H)
    mixed = [t for t in terms if t.free_symbols & qs and t.free_symbols & ps]
    if mixed and _is_mixed(sp.Add(*mixed), q, p):
        return None, None
    if mixed:
        terms = sp.Add.make_args(sp.expand(H))
    if any(t.free_symbols & qs and t.free_symbols & ps for t in terms):
        return None, None
    T = sp.Add(*[t for t in terms if t.free_symbols & ps])
    V = sp.Add(*[t for t in terms if not t.free_symbols & ps])
    return V, T


def _is_mixed(f: sp.Expr, q: Sequence[sp.Symbol], p: Sequence[sp.Symbol]) -> bool:
    """True if f is not a sum of a function of q and one of p, by its values at four states; False where these fail."""
    others = sorted(f.free_symbols - {*q, *p}, key=str)
    rng = np.random.default_rng(0)
    a, b, c, d, t = (rng.uniform(0.3, 0.9, n).tolist() for n in (*(len(q),) * 4, len(others)))
    try:
        value = generate([f], (*q, *p, *others), "numpy")
        with np.errstate(all="ignore"):
            near, far, *crossed = (float(value(*x, *y, *t)[0]) for x, y in ((a, c), (b, d), (a, d), (b, c)))
    except (TypeError, NameError, ArithmeticError):  # of a function that NumPy has not
        return False
    size = abs(near) + abs(far) + sum(map(abs, crossed))
    return math.isfinite(size) and abs(near + far - sum(crossed)) > 1e-9 * size


LONGEST_SUM = 500
_MAX_POWER = 16  # integer powers up to this are made of products
_INTEGER_POWER = sp.Function("integer_power", real=True)


def generate(expressions: Sequence[sp.Expr], variables: Sequence[sp.Symbol], library: str) -> Callable[..., list[Any]]:
    """The values of the expressions, as a function of the variables' arrays of "numpy" or "torch"."""
    code = []
    for f in expressions:
        large = [n for n in f.atoms(sp.Integer) if abs(n) >= 2**63]  # which no 64 bits hold
        written = f.xreplace({n: sp.Float(int(n)) for n in large})
        for of, reciprocal in _RECIPROCALS.items():
            written = written.replace(of, reciprocal) if written.has(of) else written
        code.append(_by_products(written) if library == "numpy" else written.replace(sp.erfc, tensor_erfc))
    n = LONGEST_SUM  # Python's compiler nests sums as deep as they have terms
    sums = [[sp.Add(*f.args[i : i + n]) for i in range(0, len(f.args), n)] if f.is_Add else [f] for f in code]
    pieces = [piece for f in sums for piece in f]
    try:
        function = sp.lambdify(variables, pieces, modules=_modules(library, code), cse=True)
    except (PrintMethodNotImplementedError, ValueError, KeyError) as error:
        raise TypeError(
            f"`expression` has no derivative that {library} could evaluate: write it with smooth functions."
        ) from error
    if len(pieces) == len(code):
        return function

    def summed(*columns: Any) -> list[Any]:
        values = iter(function(*columns))
        return [reduce(add, islice(values, len(f))) for f in sums]

    return summed


def _hessian_by_program(
    n: int, expressions: Sequence[sp.Expr], variables: Sequence[sp.Symbol], library: str
) -> Callable[..., list[Any]]:
    """∇²f by the first n variables, row by row: the program of f is differentiated sooner than its expression."""
    (f,) = expressions
    try:
        program = recorded(f, variables)
    except NotCompiled:
        return generate([printable(entry) for entry in hessian(f, variables[:n])], variables, library)
    x = program.inputs[:n]
    rows = [slopes(s, x[: i + 1]) for i, s in enumerate(slopes(program.outputs[0], x))]
    return Program(program.inputs, [rows[max(i, j)][min(i, j)] for i in range(n) for j in range(n)])


def _by_products(f: sp.Expr) -> sp.Expr:
    """Integer powers beyond squares by a function that multiplies: NumPy raises to them by logarithms."""

    def is_large(e: sp.Expr) -> bool:
        return e.is_Pow and e.exp.is_Integer and 2 < abs(e.exp) <= _MAX_POWER

    def product(e: sp.Expr) -> sp.Expr:
        power = _INTEGER_POWER(e.base, abs(e.exp))
        return power if e.exp > 0 else 1 / power

    return f.replace(is_large, product)


class tensor_erfc(sp.Function):
    """erfc, which SymPy does not write for torch."""

    def _torchcode(self, printer: Any) -> str:
        return f"tensor_erfc({printer._print(self.args[0])})"


_RECIPROCALS: dict[Any, Callable[[Any], Any]] = {
    sp.sec: lambda x: 1 / sp.cos(x),
    sp.csc: lambda x: 1 / sp.sin(x),
    sp.cot: lambda x: 1 / sp.tan(x),
    sp.sech: lambda x: 1 / sp.cosh(x),
    sp.csch: lambda x: 1 / sp.sinh(x),
    sp.coth: lambda x: 1 / sp.tanh(x),
    sp.acot: lambda x: sp.atan(1 / x, evaluate=False),
}
"""Functions that torch has not, and that SymPy writes for NumPy by exponentials, which cancel near 0 and overflow."""


def _integer_power(x: np.ndarray, n: int) -> np.ndarray:
    half = x if n < 4 else _integer_power(x, n // 2)
    return half * half * x if n % 2 else half * half


def _special_functions() -> dict[str, Callable[..., Any]]:
    """Functions that SciPy's printer does not know, or has complex: NaN where they are not real."""
    from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc, lambertw

    def real_lambertw(x: Any, k: Any = 0) -> Any:
        w = lambertw(x, k)
        return np.where(w.imag == 0, w.real, np.nan)

    def elliptic_e(*x: Any) -> Any:
        return (ellipe if len(x) == 1 else ellipeinc)(*x)

    return {"elliptic_k": ellipk, "elliptic_f": ellipkinc, "elliptic_e": elliptic_e, "LambertW": real_lambertw}


def _modules(library: str, code: list[sp.Expr]) -> list[Any]:
    """Modules of the functions in the generated code; SciPy is brought in for special functions only."""
    from sympy.printing.numpy import NumPyPrinter

    known = {name for name, code in NumPyPrinter().known_functions.items() if code.startswith("numpy")}
    if library == "torch":
        known |= {"erf", "tensor_erfc"}
    names = {type(f).__name__ for expression in code for f in expression.atoms(sp.Function)} - {"integer_power"}
    special = sorted(names - known - {"Max", "Min", "Abs", "Heaviside", "sign", "Piecewise", *BOUNDED})
    if library == "numpy":
        own = {"integer_power": _integer_power, "Heaviside": np.heaviside}
        return [own | _special_functions(), "scipy", np] if special else [own, np]  # by its name SymPy loads all of it
    if special:
        raise TypeError(
            f"`expression` holds {', '.join(special)}, which torch does not have: solve on NumPy states, with a method "
            "that does not need tensors."
        )
    import torch

    def pairwise(choose: Any) -> Any:
        def function(*values: Any) -> Any:
            like = next(v for v in values if isinstance(v, torch.Tensor))
            return reduce(choose, (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in values))

        return function

    def heaviside(x: Any, value: float) -> Any:
        return torch.heaviside(x.detach(), torch.as_tensor(value, dtype=x.dtype, device=x.device))  # of slope 0

    return [
        {
            **{name: partial(apply, name) for name in ("bose", "softplus", "logcosh")},
            "triangle": lambda x: x.sin().asin(),
            "expit": torch.special.expit,
            "tensor_erfc": torch.special.erfc,
            "heaviside": heaviside,
            "max": pairwise(torch.maximum),
            "min": pairwise(torch.minimum),
        },
        "torch",
    ]


class SymbolicForce:
    """F(q, p) by expressions, one for each momentum."""

    def __init__(self, system: Any, force: Any, params: Mapping[str, float] | None) -> None:
        symbols = system.symbols
        self.q, self.p, self.time = symbols.q, symbols.p, symbols.time
        self.form = symbols.like(symbols.H)  # with functions of its own
        d = system.ndof
        several = isinstance(force, Sequence | np.ndarray | sp.MatrixBase) and not isinstance(force, str)
        written = list(force) if several else [force]
        if len(written) != d:
            raise ValueError(
                f"`force` must have {d} components, one for each momentum of {system.name!r}; got {len(written)}."
            )
        values = {**system.params, **checked_params(params)}
        read_ones = [stated("force", each, values) for each in written]
        if any(complex_part(f) is not None for f in read_ones):
            raise TypeError("`force` must be real expressions, texts or SymPy's, or a function F(q, p).")
        for name in params or {}:
            if not any(sp.Symbol(name, real=True) in f.free_symbols for f in read_ones):
                raise ValueError(f"`params` has {name!r}, which the force does not use: remove it.")
        self.expressions = [self._valued(f, values) for f in read_ones]
        for f in self.expressions:
            refuse_deltas("force", f)

    def _valued(self, f: sp.Expr, values: Mapping[str, float]) -> sp.Expr:
        """The expression in the system's coordinates, its parameters replaced by their values."""
        d = len(self.q)
        known: dict[sp.Symbol, sp.Expr] = {sp.Symbol(name, real=True): exact(value) for name, value in values.items()}
        if d == 1:
            known |= {sp.Symbol("q", real=True): self.q[0], sp.Symbol("p", real=True): self.p[0]}
        f = f.xreplace(known)
        unknown = sorted(s.name for s in f.free_symbols - {*self.q, *self.p, self.time})
        beyond = [name for name in unknown if COORDINATE.fullmatch(name)]
        if beyond:
            raise ValueError(
                f"`force` holds {', '.join(beyond)}, but the system has the coordinates {self.q[0]} … {self.p[-1]}: "
                "write it in these."
            )
        if "t" in unknown:
            raise ValueError(
                "`force` depends on the time t, but the system does not: leave t out, or name the time of the system."
            )
        if unknown:
            raise ValueError(f"`force` holds {', '.join(unknown)} without a value: give it in `params`.")
        return f

    def __call__(self, q: Array, p: Array, *t: Any) -> Array:
        return self.form.evaluated("force", self.expressions)(concatenate([q, p]), *t)

    def jacobian(self, q: Array, p: Array, *t: Any) -> Array:
        x = (*self.q, *self.p)
        slopes = [sp.diff(f, s) for f in self.expressions for s in x]
        return self.form.evaluated("force 1", slopes)(concatenate([q, p]), *t).reshape(*p.shape, len(x))

    @property
    def has_potential(self) -> bool:
        """True if F is −∇U(q)."""
        F, q = self.expressions, self.q
        if any(f.free_symbols & {*self.p} for f in F):
            return False
        return all(sp.expand(sp.diff(F[i], q[j]) - sp.diff(F[j], q[i])) == 0 for i in range(len(q)) for j in range(i))


def doubled_hamiltonian(system: Any, force: SymbolicForce) -> sp.Expr:
    """p₋·∂H/∂p + q₋·(∂H/∂q + Γp − F) in q1 … q2d, p1 … p2d, which are q₊, q₋ and p₋, p₊."""
    symbols = system.symbols
    d = system.ndof
    q, p = (sp.symbols(f"{letter}1:{2 * d + 1}", real=True) for letter in "qp")
    G = system.friction.matrix(d)
    mean = dict(zip((*symbols.q, *symbols.p), (*q[:d], *p[d:]), strict=True))
    terms = []
    for i, F in enumerate(force.expressions):
        drag = sp.Add(*[exact(g) * s for g, s in zip(G[i], symbols.p, strict=True) if g])
        terms.append(p[i] * sp.diff(symbols.H, symbols.p[i]).xreplace(mean))
        terms.append(q[d + i] * (sp.diff(symbols.H, symbols.q[i]) + drag - F).xreplace(mean))
    return printable(sp.Add(*terms))
