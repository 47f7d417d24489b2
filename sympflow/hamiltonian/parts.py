"""H as a sum of parts that are solved exactly, two or more, and their flows on arrays.

A part is solved exactly if it is quadratic, ½ pᵀBp + ½ (q − c)ᵀK(q − c) (the *linear* part, in its normal modes), or
if no two of the variables that it depends on are conjugate to each other: then these variables do not move, and its
flow over a time s is x + s J∇H_k(x). V(q) and T(p) are of this kind, and so is p_θ²/(2r²). A part may also bring a flow
of its own, `turned`, and says so by `turns`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array, concatenate, detached, library, like, stack
from sympflow.hamiltonian.linear_part import (
    LinearPart,
    RestOfPotential,
    check_parts_conservative,
    form_of_parts,
    linear_part,
    read_off,
)
from sympflow.hamiltonian.scales import fastest_rate, natural_scale
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, parse
from sympflow.hamiltonian.times import stage_time
from sympflow.lazy import kept

if TYPE_CHECKING:
    import sympy as sp

    from sympflow.hamiltonian.system import HamiltonianSystem

LINEAR = 0
"""The number of the linear part; the others are 1, 2, …"""


@dataclass(frozen=True)
class SubFlow:
    """The exact flow of a part, in units of absolute time; every entry may have a batch shape in front."""

    part: int
    length: Any  # how long it acts: (...), or (..., F), a time for each of the F frequencies of the linear part
    gradient: Any = 0.0  # g (...): adds −g ½|∇H_k|²_{M⁻¹} to the Hamiltonian of a part H_k(q), times 1
    filters: Any = None  # φ (..., F): the part acts at c + C φ X in place of q = c + C X
    at: float = 0.0  # share of a step after which a part that depends on t acts, at that time

    @property
    def has_gradient(self) -> bool:
        """True if there is a force gradient."""
        return self.gradient != 0.0 if isinstance(self.gradient, float) else bool(np.any(self.gradient))

    def inverse(self) -> SubFlow:
        return SubFlow(self.part, -self.length, -self.gradient, self.filters, self.at)


class PartFunctions(SymbolicHamiltonian):
    """A part H_k(q, p) as a SymPy expression, with array functions of states [q, p], and of t where `whole` has it."""

    turns = False

    def __init__(
        self, H: sp.Expr, q: tuple[sp.Symbol, ...], p: tuple[sp.Symbol, ...], whole: SymbolicHamiltonian
    ) -> None:
        self.H, self.q, self.p, self.ndof = H, q, p, len(q)
        self.V = self.T = None
        self.separable = False
        self.of_positions = not H.has(*p)  # once, for torch cannot follow SymPy
        self.time = whole.time if whole.time in H.free_symbols else None
        self.parameters, self.values = whole.parameters, whole.values
        if whole.samples:
            self.samples = whole.samples

    def _derivative(self, name: str, order: int) -> Callable[..., Array]:
        return partial(super()._derivative(name, order), numbers=self.values)

    def hessian_vector(self, y: Array, v: Array, *t: Any) -> Array:
        """∇²_q H_k(y)·v: (..., 2d), (..., d) to (..., d)."""
        return (self.hessian(y, *t)[..., : self.ndof, : self.ndof] @ v[..., None])[..., 0]


class ExactParts:
    """The parts of a system, and their flows in the normal modes (X, Y) of the linear one.

    `rest` are the parts 1, 2, …; `sequence` is the order of a splitting, the last innermost: kicks outside by default.
    """

    def __init__(self, linear: Any, rest: Sequence[Any], ndof: int, sequence: Sequence[int] | None = None) -> None:
        self.linear, self.rest, self.ndof = linear, tuple(rest), ndof
        self.sequence = tuple(range(1, len(self.rest) + 1)) + (LINEAR,) * (linear is not None)
        if sequence is not None:
            self.sequence = tuple(sequence)
        self.diagonal: bool = linear is None or linear.diagonal  # each mode is a coordinate
        self.driven = any(functions.timed for functions in self.rest)
        self.center = linear.center if linear else np.zeros(ndof)
        self.classes = linear.classes if linear else np.zeros(ndof, dtype=int)
        self.n_classes = linear.n_classes if linear else 1

    @cached_property
    def C(self) -> np.ndarray:
        """The modes as a matrix (d, d)."""
        return self.linear.modes if self.linear else np.eye(self.ndof)

    @cached_property
    def inverse_C(self) -> np.ndarray:
        return self.linear.inverse_modes if self.linear else np.eye(self.ndof)

    def __len__(self) -> int:
        return len(self.rest) + (self.linear is not None)

    def timed(self, part: int) -> bool:
        """True if a part depends on the time, at which it then acts."""
        return part != LINEAR and bool(self.rest[part - 1].timed)

    def check_filters(self, part: int) -> None:
        """Raise unless the part, filtered, is still solved exactly: it must not come to hold a conjugate pair."""
        if not (self.diagonal or self.rest[part - 1].of_positions):
            raise ValueError("`filters` cannot act on a part that depends on momenta where modes are mixed: leave out.")

    def to_modes(self, y: Array) -> tuple[Array, Array]:
        """X = C⁻¹(q − c), Y = Cᵀp."""
        linear, q, p = self.linear, y[..., : self.ndof], y[..., self.ndof :]
        return (q, p) if linear is None else (linear.coordinates(q - like(self.center, y)), linear.slopes(p))

    def from_modes(self, X: Array, Y: Array) -> Array:
        """[c + C X, C⁻ᵀY]."""
        return concatenate([self._positions(X), Y if self.linear is None else self.linear.momenta(Y)])

    def _positions(self, X: Array) -> Array:
        return X if self.linear is None else like(self.center, X) + self.linear.positions(X)

    def by_class(self, values: Array) -> Array:
        """Values for each frequency (..., F) as values for each mode (..., d)."""
        return values[..., self.classes]

    def apply(self, maps: Sequence[SubFlow], X: Array, Y: Array, t: Any = 0.0, h: Any = 0.0) -> tuple[Array, Array]:
        """The maps of a step one after another, the first first; those of parts that move in a step h from t on."""
        for m in maps:
            if m.part == LINEAR:
                X, Y = self.linear_flow(X, Y, m.length)
                continue
            time = (stage_time(t, m.at, h),) if self.timed(m.part) else ()
            if self.rest[m.part - 1].turns:  # its change alone is transformed, so that transforms add no drift
                y = self.from_modes(X, Y)
                change = self.rest[m.part - 1].turned(y, each_mode(m.length)) - y
                dX, dY = change[..., : self.ndof], change[..., self.ndof :]
                if self.linear is not None:
                    dX, dY = self.linear.coordinates(dX), self.linear.slopes(dY)
                X, Y = X + dX, Y + dY
                continue
            dX, dY = self.slopes(m.part, X, Y, m.filters, *time)
            length = each_mode(m.length)
            X, Y = (X, Y - length * dX) if dY is None else (X + length * dY, Y - length * dX)
            if not (isinstance(m.gradient, float) and m.gradient == 0.0):
                Y = Y + each_mode(m.gradient) * self.force_gradient(m.part, X, m.filters, *time)
        return X, Y

    def jvp(
        self, maps: Sequence[SubFlow], x: tuple[Array, Array], w: tuple[Array, Array], t: Any = 0.0, h: Any = 0.0
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]] | None:
        """The modes (..., d) after the maps, and vectors (..., k, d) moved by the derivative of these.

        None where that takes more than second derivatives of potentials: of force gradients, filters and other parts.
        """
        (X, Y), (U, P), linear, d = x, w, self.linear, self.ndof
        if linear is None:
            return None
        for m in maps:
            if m.part == LINEAR:
                (X, Y), (U, P) = self.linear_flow(X, Y, m.length), self.linear_flow(U, P, m.length[..., None, :])
                continue
            of, plain = self.rest[m.part - 1], isinstance(m.gradient, float) and m.gradient == 0.0
            if of.turns or not of.of_positions or m.filters is not None or not plain:
                return None
            time = (stage_time(t, m.at, h),) if self.timed(m.part) else ()
            y, length = self._state(m.part, X, Y, None), each_mode(m.length)
            Y = Y - length * linear.slopes(of.gradient(y, *time)[..., :d])
            P = P - each_mode(length) * linear.slopes(of.hessian_vector(y[..., None, :], linear.positions(U), *time))
        return (X, Y), (U, P)

    def linear_flow(self, X: Array, Y: Array, s: Any) -> tuple[Array, Array]:
        """The linear part over the times s (..., F), or by the shears that `prepared` has put in their place."""
        return sheared(X, Y, s if isinstance(s, tuple) else self._shears(s, X))

    def prepared(self, maps: Sequence[SubFlow], X: Array) -> list[SubFlow]:
        """The maps for repeated use on states of the kind of X: the shears of the linear ones computed once."""
        return [replace(m, length=self._shears(m.length, X)) if m.part == LINEAR else m for m in maps]

    def _shears(self, s: Any, X: Array) -> tuple[Array, Array, Array, Array]:
        return shears(self.linear.kinds, like(self.linear.rates, X), self.by_class(like(s, X)))

    def linear_energies(self, X: Array, Y: Array) -> Array:
        """Energy of the linear part in each frequency: (..., F)."""
        sign = {"oscillator": 1.0, "hyperbolic": -1.0, "free": 0.0, "idle": 0.0}
        squares = like(np.array([sign[k] for k in self.linear.kinds]), X) * X * X + Y * Y
        energies = like(self.linear.rates, X) * squares / 2
        return stack([energies[..., self.classes == f].sum(-1) for f in range(self.n_classes)])

    def value(self, part: int, X: Array, Y: Array, filters: Array | None) -> Array:
        """H_k: (...)."""
        return self.rest[part - 1].hamiltonian(self._state(part, X, Y, filters))

    def slopes(self, part: int, X: Array, Y: Array, filters: Array | None, *t: Any) -> tuple[Array, Array | None]:
        """∂H_k/∂X and ∂H_k/∂Y, (..., d) each; None for what is zero. `t` follows for a part that depends on it."""
        functions, d = self.rest[part - 1], self.ndof
        g = functions.gradient(self._state(part, X, Y, filters), *t)
        linear = self.linear
        dX = g[..., :d] if linear is None else linear.slopes(g[..., :d])
        dX = dX if filters is None else self.by_class(like(filters, X)) * dX
        if functions.of_positions:
            return dX, None
        return dX, g[..., d:] if linear is None else linear.coordinates(g[..., d:])

    def force_gradient(self, part: int, X: Array, filters: Array | None, *t: Any) -> Array:
        """½ ∇|∇U|²_{M⁻¹} of U(X) = H_k(c + C φ X): (..., d)."""
        functions, d, linear = self.rest[part - 1], self.ndof, self.linear
        y = self._state(part, X, 0 * X, filters)
        phi = 1.0 if filters is None else self.by_class(like(filters, X))
        v = self.inverse_masses(X) * phi * linear.slopes(functions.gradient(y, *t)[..., :d])
        v = linear.positions(phi * v)
        return phi * linear.slopes(functions.hessian_vector(y, v, *t))

    def inverse_masses(self, X: Array) -> Array:
        """The diagonal M⁻¹ of the modes: Ω of each."""
        return like(self.linear.rates, X)

    def _state(self, part: int, X: Array, Y: Array, filters: Array | None) -> Array:
        """[q, p] at which a part acts; of one of positions with p = 0, which it does not see."""
        X = X if filters is None else self.by_class(like(filters, X)) * X
        if not self.rest[part - 1].of_positions:
            return self.from_modes(X, Y)
        q = self._positions(X)
        return concatenate([q, 0 * q])

    @cached_property
    def has_force_gradient(self) -> bool:
        """True if kicks may carry force gradients: every momentum must enter by the linear part."""
        return (
            self.linear is not None
            and "idle" not in self.linear.kinds
            and all(functions.of_positions for functions in self.rest)
        )


def each_mode(value: Any) -> Any:
    """A number for each state as one that broadcasts against (..., d)."""
    return value[..., None] if getattr(value, "ndim", 0) else value


SPLITTER = 134217729.0  # 2²⁷ + 1


# The exact flow of a normal mode (X, Y) as three shears, of determinant 1 whatever their rounding, after quarter turns:
# it turns by θ = kπ/2 + r with |r| ≤ π/4, the k quarter turns swap X and Y and are exact, and
#     X ← X + tan(r/2) Y,   Y ← Y − sin(r) X,   X ← X + tan(r/2) Y
# is the rest. A matrix of cosines and sines would have the rounded determinant cos² + sin², and an energy that drifts.


def shears(kinds: Sequence[str], rates: Array, s: Array) -> tuple[Array, Array, Array, Array]:
    """t, σ, c, d (..., n) of modes of these kinds and rates Ω (n,) over the times s (..., n), in the library of s.

    The flow is X ← cX + dY, Y ← cY − dX, where c and d are 0 or ±1, then X ← X + tY, Y ← Y − σX, X ← X + tY.
    """
    module = library(s)
    theta = rates * s
    k, r = _reduced(theta, _low(rates, s, theta), module)
    one, zero = 1 + 0 * theta, 0 * theta
    c = module.where(k == 0, one, zero) - module.where(abs(k) == 2, one, zero)
    d = module.where(k == 1, one, zero) - module.where(k == -1, one, zero)
    t, sigma = module.tan(r / 2), module.sin(r)
    others = {
        "hyperbolic": lambda: (module.tanh(theta / 2), -module.sinh(theta)),
        "free": lambda: (theta / 2, zero),
        "idle": lambda: (zero, zero),
    }
    for kind in set(kinds) & set(others):
        here = np.asarray(kinds) == kind
        here = here if module is np else module.as_tensor(here, device=s.device)
        own_t, own_sigma = others[kind]()
        t, sigma = module.where(here, own_t, t), module.where(here, own_sigma, sigma)
        c, d = module.where(here, one, c), module.where(here, zero, d)
    return t, sigma, c, d


def sheared(X: Array, Y: Array, coefficients: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
    """The flow of `shears` on modes (..., n)."""
    t, sigma, c, d = coefficients
    X, Y = c * X + d * Y, c * Y - d * X
    X = X + t * Y
    Y = Y - sigma * X
    return X + t * Y, Y


def _reduced(theta: Array, low: Any, module: Any) -> tuple[Array, Array]:
    """θ + `low` as k quarter turns, −2 … 2, and the rest r, each to its own rounding: the library reduces θ exactly."""
    sine, cosine = module.sin(theta), module.cos(theta)
    k = module.round(module.arctan2(sine, cosine) / (np.pi / 2))
    s = module.where(abs(k) == 1, -k * cosine, module.where(k == 0, sine, -sine))
    c = module.where(abs(k) == 1, k * sine, module.where(k == 0, cosine, -cosine))
    r = module.arctan2(s, c) + low
    # what rounding of Ω s leaves of whole quarter turns is none: its shears would round one way in every step
    none = abs(r) <= 4 * float(module.finfo(theta.dtype).eps) * abs(theta)
    return k, module.where(none, r - detached(r), r)


def _low(a: Array, b: Array, product: Array) -> Array:
    """The part that rounding took from the product a·b, exactly [Dekker 1971]; 0 where it overflows, or in float32."""
    xp = library(product)
    if product.dtype != xp.float64:
        return xp.zeros_like(product)
    with np.errstate(all="ignore"):
        a_high, b_high = (SPLITTER * x - (SPLITTER * x - x) for x in (a, b))
        a_low, b_low = a - a_high, b - b_high
        low = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return xp.where(xp.isfinite(low), low, 0.0)


@kept
def linear_and_rest(system: HamiltonianSystem) -> ExactParts:
    """The linear part and U(q), for the kicks and exact linear flows of Nyström splittings."""
    linear = system.linear_part
    parts = exact_parts(system)
    if len(parts.rest) > 1 or any(not (functions.of_positions or functions.turns) for functions in parts.rest):
        raise ValueError(
            f"`system` {system.name!r} has {len(parts)} parts, not just a linear one and U(q): use 'strang_parts'."
        )
    return ExactParts(linear, parts.rest, system.ndof)


def exact_parts(system: HamiltonianSystem, expressions: Sequence[str] | None = None) -> ExactParts:
    """H as a sum of parts that are solved exactly: given as texts, the last innermost, or as few as its terms allow.

    By default potentials come first, and at the end the linear part, if there is one.
    """
    check_parts_conservative(system)
    by_arrays = system.local is not None or (system.stiffness_matrix is not None and expressions is None)
    if system.written is None or by_arrays:
        if expressions is not None:
            raise ValueError("`parts` are read as symbols, and the system has none: define it with from_sympy.")
        if system.local is not None:
            local, rest = system.local.linear_and_rest(abs(system.t_span[1] - system.t_span[0]))
            return ExactParts(local, rest, system.ndof)
        linear = system.linear_part
        return ExactParts(linear, [RestOfPotential(system.definition, linear)], system.ndof)
    if expressions is None:
        return _detected(system)
    return _given(system, tuple(expressions))


def _detected(system: HamiltonianSystem) -> ExactParts:
    symbols = form_of_parts(system)
    try:
        linear = linear_part(system)
        rest = linear.potential
    except ValueError:
        linear, rest = None, symbols.H
    groups = _groups(rest, symbols.q, symbols.p)
    if groups is None:
        raise ValueError(
            f"`system` {system.name!r} does not split into parts that are solved exactly: a term holds a coordinate "
            "and its momentum. Use an implicit or a Runge–Kutta method, or train a SympFlow."
        )
    rest = [PartFunctions(g, symbols.q, symbols.p, symbols) for g in groups]
    return ExactParts(linear, sorted(rest, key=lambda part: not part.of_positions), system.ndof)


@lru_cache(maxsize=64)
def _groups(H: sp.Expr, q: tuple[sp.Symbol, ...], p: tuple[sp.Symbol, ...]) -> list[sp.Expr] | None:
    """The terms of H in as few groups without conjugate pairs as come about greedily, expanded if need be, or None."""
    import sympy as sp

    for f in (H, sp.expand(H)):
        groups: list[tuple[set[sp.Symbol], list[sp.Expr]]] = []
        terms = [(t.free_symbols & {*q, *p}, t) for t in sp.Add.make_args(f)]
        for found, term in sorted(terms, key=lambda each: -len(each[0])):
            if not found:
                continue
            for variables, members in groups:
                if not _has_pair(variables | found, q, p):
                    variables.update(found)
                    members.append(term)
                    break
            else:
                groups.append((set(found), [term]))
        if not any(_has_pair(variables, q, p) for variables, _ in groups):
            return [sp.Add(*members) for _, members in groups]
    return None


def _has_pair(variables: set[sp.Symbol], q: Sequence[sp.Symbol], p: Sequence[sp.Symbol]) -> bool:
    return any(a in variables and b in variables for a, b in zip(q, p, strict=True))


def _given(system: HamiltonianSystem, expressions: tuple[str, ...]) -> ExactParts:
    import sympy as sp

    symbols = system.written
    parts = [_parsed(expression, system) for expression in expressions]
    difference = sp.expand(sp.Add(*parts) - symbols.H)
    probes = np.random.default_rng(0).uniform(0.3, 0.9, (8, 2 * system.ndof))
    whole, missing = (PartFunctions(f, symbols.q, symbols.p, symbols) for f in (symbols.H, difference))
    for t in system.probe_times():
        with np.errstate(all="ignore"):
            excess = missing.hamiltonian(probes, t) if difference.free_symbols else 0.0
            size = np.abs(whole.hamiltonian(probes, t)).max()
        if not np.allclose(np.ptp(excess), 0, atol=1e-12 * size):
            raise ValueError(f"`parts` do not add up to the Hamiltonian: they leave out {-difference}.")
    linear: LinearPart | None = None
    rest: list[PartFunctions] = []
    sequence = []
    for expression, part in zip(expressions, parts, strict=True):
        if not _has_pair(part.free_symbols, symbols.q, symbols.p):
            rest.append(PartFunctions(part, symbols.q, symbols.p, symbols))
            sequence.append(len(rest))
            continue
        held = PartFunctions(part, symbols.q, symbols.p, symbols)
        candidate = read_off(held, abs(system.t_span[1] - system.t_span[0]))
        if linear is not None or candidate is None or getattr(candidate.potential, "free_symbols", None):
            raise ValueError(
                f"`parts` has {expression!r}, which is not solved exactly: it holds a coordinate and its momentum and "
                "is not the one quadratic part. Split it further."
            )
        linear = candidate
        sequence.append(LINEAR)
    return ExactParts(linear, rest, system.ndof, sequence)


def _parsed(expression: str, system: HamiltonianSystem) -> sp.Expr:
    """A part in the symbols q1 … pd of the system."""
    symbols = system.written
    if not isinstance(expression, str):
        raise ValueError(f"`parts` must be expressions as text; got {expression!r}.")
    words, time = set(re.findall(r"[A-Za-z_]\w*", expression)), symbols.time
    try:
        part = parse(expression, {name: value for name, value in system.params.items() if name in words}, time)
    except (ValueError, TypeError) as error:
        raise ValueError(f"`parts` has one that is not admissible: {error}") from None
    known = {s.name for s in (*symbols.q, *symbols.p)} | {"q", "p", getattr(time, "name", "q")}
    if foreign := {s.name for s in part.free_symbols} - known:
        raise ValueError(f"`parts` has {', '.join(sorted(foreign))}, which the system does not have: leave it out.")
    first = {"q": symbols.q[0], "p": symbols.p[0]}
    return part.xreplace({s: first[s.name] for s in part.free_symbols if s.name in first})


def map_evaluations(maps: Sequence[SubFlow], n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
    """Evaluations of slopes and force gradients, as `FixedStep.evaluations`; linear flows cost none."""
    counts = [sum(m.part != LINEAR for m in maps), sum(m.has_gradient for m in maps)]
    counts = [count * (n_steps + n_extra) for count in counts]
    if backend == "compiled" and len(maps) > 1 and maps[0].part == maps[-1].part:
        last = maps[-1].part != LINEAR, maps[-1].has_gradient  # it is the next step's first one
        counts = [count - (n_steps - n_saved) * one for count, one in zip(counts, last, strict=True)]
    return {"force_evaluations": int(counts[0]), "hessian_evaluations": int(counts[1])}


# two copies of phase space --------------------------------------------------------------------


class Coupling(LinearPart):
    """The coupling of the copies; its normal modes are the sums and differences of s q and s x over √2."""

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d, K, B = self.ndof // 2, self.stiffness_matrix, self.inverse_mass
        s = np.diag((np.diag(K) / np.diag(B))[:d] ** 0.25)
        C, inverse = (np.block([[one, one], [one, -one]]) / math.sqrt(2) for one in (np.linalg.inv(s), s))
        return np.repeat([np.nan, 4 * K[0, 0] * B[0, 0]], d), C, inverse


class FunctionsOfCopies:
    """H(q, y), or H(x, p), of a system that is given by functions."""

    of_positions, turns = False, False

    def __init__(self, system: HamiltonianSystem, first: bool) -> None:
        self.system, self.first, self.ndof = system, first, 2 * system.ndof
        self.timed = system.definition.timed

    def hamiltonian(self, x: Array, *t: Any) -> Array:
        return self.system.hamiltonian(self._state(x), *t)

    def gradient(self, x: Array, *t: Any) -> Array:
        d, g = self.system.ndof, self.system.gradient(self._state(x), *t)
        zero = 0 * g[..., :d]
        return concatenate([g[..., :d], zero, zero, g[..., d:]] if self.first else [zero, g, zero])

    def _state(self, x: Array) -> Array:
        d = self.system.ndof
        return concatenate([x[..., :d], x[..., 3 * d :]]) if self.first else x[..., d : 3 * d]


@kept
def two_copies(system: HamiltonianSystem, omega: float | None) -> ExactParts:
    """Any H on two copies of phase space, (q, p) and (x, y), as three parts with exact flows of states [q, x, p, y].

    H(q, y) + H(x, p) + ω Σ_i (s_i² (q_i − x_i)² + (p_i − y_i)²/s_i²)/2 has the solutions of H where the copies agree
    [1]_, [2]_. The last part is the innermost, and moves the time; s = √(mω) is `natural_scale`, 1 in Tao's paper. ω is
    by default the fastest rate of the motion.

    References
    ----------
    .. [1] P. Pihajoki, "Explicit methods in extended phase space for inseparable Hamiltonian problems", Celest. Mech.
       Dyn. Astron. 121 (2015) 211–231.
    .. [2] M. Tao, "Explicit symplectic approximation of nonseparable Hamiltonians: algorithm and long time
       performance", Phys. Rev. E 94 (2016) 043303.
    """
    omega = fastest_rate(system) if omega is None else float(omega)
    if omega is None:
        raise ValueError(
            f"`system` {system.name!r} has neither a `y0` of its own nor a domain to take the coupling from: give "
            "`omega`, or the system one of these."
        )
    check_parts_conservative(system)
    d = system.ndof
    squares = np.diag(natural_scale(system) ** 2)
    B, K = (omega * np.block([[one, -one], [-one, one]]) for one in (np.linalg.inv(squares), squares))
    coupling = Coupling(B, K, np.zeros(2 * d))
    if system.written is None:
        return ExactParts(coupling, [FunctionsOfCopies(system, first) for first in (True, False)], 2 * d)
    symbols = form_of_parts(system)
    q, p, copies = _copies(symbols.H, symbols.q, symbols.p)
    return ExactParts(coupling, [PartFunctions(H, q, p, symbols) for H in copies], 2 * d)


@lru_cache(maxsize=64)
def _copies(H: sp.Expr, q: tuple[sp.Symbol, ...], p: tuple[sp.Symbol, ...]) -> tuple[Any, Any, list[sp.Expr]]:
    """The symbols of two copies, and H of the positions of one and the momenta of the other."""
    import sympy as sp

    d = len(q)
    Q, P = (tuple(sp.symbols(f"{letter}1:{2 * d + 1}", real=True)) for letter in "qp")
    pairs = (*Q[:d], *P[d:]), (*Q[d:], *P[:d])
    return Q, P, [H.xreplace(dict(zip((*q, *p), these, strict=True))) for these in pairs]


def both(y: Array, d: int) -> Array:
    """[q, q, p, p] of states [q, p]: (..., 2d) to (..., 4d)."""
    return concatenate([y[..., :d], y[..., :d], y[..., d:], y[..., d:]])


def mean(x: Array, d: int) -> Array:
    """The mean of the two copies, (..., 4d) to (..., 2d): their difference cancels to first order."""
    return concatenate([(x[..., :d] + x[..., d : 2 * d]) / 2, (x[..., 2 * d : 3 * d] + x[..., 3 * d :]) / 2])


def distance(x: Array, s: np.ndarray) -> Array:
    """The largest |s(q − x)| or |(p − y)/s|, and the largest of these variables: (..., 4d) to (..., 2)."""
    d = len(s)
    x = x * like(np.concatenate([s, s, 1 / s, 1 / s]), x)
    apart = concatenate([x[..., :d] - x[..., d : 2 * d], x[..., 2 * d : 3 * d] - x[..., 3 * d :]])
    xp = library(x)
    return stack([xp.amax(abs(apart), -1), xp.amax(abs(x), -1)], axis=-1)
