"""Parts of an unknown H: functions of q, of p or of both, with some numbers θ to be learned."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import combinations, combinations_with_replacement, product
from typing import Any, NamedTuple

import numpy as np
import sympy

STEEP = 5.0
"""Size of the weights and biases of neurons, in the spread of the coordinates, beyond which they would be steps."""


class Linear(NamedTuple):
    """A function f(θ, x) of columns x (m, N) with its derivatives, None for those not requested."""

    value: np.ndarray  # (m, N)
    slope: np.ndarray | Any = None  # (m, m, N): ∂f/∂x
    by_parameters: np.ndarray | Any = None  # (m, n, N): ∂f/∂θ


Curvature = Iterable[tuple[tuple[int, int], Any, np.ndarray]]
"""Second derivatives (k, N) of some functions by pairs of coordinates, with the places of these functions."""


class Part(ABC):
    """A function of q, p or y = [q, p], with n numbers θ."""

    of: str
    n: int
    quadratic: bool = False  # True if it is known to be a quadratic form
    linear: bool = True  # True if it is linear in θ
    terms: bool | np.ndarray = False  # True if `subset` leaves terms out; or the numbers (n,) that it may leave out
    inertial: bool = False  # True of a kinetic energy whose masses depend on q, linear in θ in Lagrange's form

    @abstractmethod
    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        """The gradient at columns x (m, N), with its derivatives."""

    @abstractmethod
    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The values (N,)."""

    @abstractmethod
    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        """The function in symbols."""

    def start(self, rng: np.random.Generator) -> np.ndarray:
        """θ before anything is known."""
        return np.zeros(self.n)

    @property
    def prior(self) -> np.ndarray:
        """One over the size (n,) that each number is expected to have, 0 for any."""
        return np.zeros(self.n)

    def subset(self, kept: np.ndarray) -> Part:
        """The part with some of its numbers (n,), where it is a sum of terms, one for each; else the part itself."""
        return self

    def at(self, t: np.ndarray) -> Part:
        """The function at times t (N,), one for each column."""
        return self

    def momenta(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """p = ∂L/∂v and p' = ∂L/∂q of a Lagrangian at q and v (d, N), for θ = 0; and their derivatives by θ (2d, n, N).

        L has −V of what depends on q alone. Other parts stand in it with v in place of p, and numbers of their own.
        """
        x = {"q": q, "p": v, "y": np.concatenate([q, v])}[self.of]
        f = self.gradient(np.zeros(self.n), x, False, True)
        return self._mechanics(f.value), self._mechanics(f.by_parameters)

    def _mechanics(self, slopes: np.ndarray) -> np.ndarray:
        """∂L/∂v and ∂L/∂q of slopes (m, …) of a part."""
        none, d = np.zeros_like(slopes), len(slopes) // 2
        rows = {"q": (none, -slopes), "p": (slopes, none), "y": (slopes[d:], slopes[:d])}
        return np.concatenate(rows[self.of])


class Sum(Part):
    """Σ_k θ_k f_k of functions that are given."""

    terms = True

    @property
    @abstractmethod
    def width(self) -> int:
        """How many coordinates it is a function of."""

    @abstractmethod
    def functions(self, x: np.ndarray) -> np.ndarray:
        """The functions (n, N) at columns x (m, N)."""

    @abstractmethod
    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, Curvature]:
        """Their gradients (m, n, N), and one by one their second derivatives, those that are not 0."""

    @cached_property
    def _forms(self) -> np.ndarray:
        """The second derivatives (m, m, n) of quadratic forms."""
        made = np.zeros((self.width, self.width, self.n))
        for (i, j), used, terms in self.derivatives(np.ones((self.width, 1)))[1]:
            made[i, j, used] = made[j, i, used] = terms[:, 0]
        return made

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        m, N = x.shape
        if self.quadratic:
            W = self._forms @ theta
            by = np.tensordot(self._forms, x, ([1], [0])) if by_parameters else None
            return Linear(W @ x, W[..., None] if slope else None, by)
        first, second = self.derivatives(x)
        slopes = np.zeros((m, m, N)) if slope else None
        if slopes is not None:
            for (i, j), used, terms in second:
                slopes[i, j] = slopes[j, i] = theta[used] @ terms
        return Linear(np.stack([theta @ rows for rows in first]), slopes, first if by_parameters else None)

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        return theta @ self.functions(x)


class Polynomial(Sum):
    """Σ_m θ_m Π_i (x_i/s_i)^m_i, of exponents m (n, m) and scales s (m,), of the size of the data: θ are comparable."""

    def __init__(self, of: str, exponents: Any, scales: Any) -> None:
        self.of, self.scales = of, np.asarray(scales, dtype=float)
        self.exponents = np.asarray(exponents, dtype=int).reshape(-1, len(self.scales))
        self.n = len(self.exponents)
        self.quadratic = bool((self.exponents.sum(axis=1) == 2).all())

    @property
    def width(self) -> int:
        return len(self.scales)

    @classmethod
    def up_to(cls, degree: int, of: str, scales: Any) -> Polynomial:
        """All monomials of degree 1 to `degree`."""
        exponents = [e for e in product(range(degree + 1), repeat=len(scales)) if 0 < sum(e) <= degree]
        return cls(of, sorted(exponents, key=lambda e: (sum(e), e[::-1])), scales)

    @cached_property
    def _derivatives(self) -> dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]]:
        """For each list of coordinates, of one or two: the factors and exponents of the derivatives by them."""
        made: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}
        m = self.exponents.shape[1]
        for places in [(i,) for i in range(m)] + [*combinations_with_replacement(range(m), 2)]:
            factor, left = np.ones(self.n), self.exponents.copy()
            for i in places:
                factor, left[:, i] = factor * left[:, i] / self.scales[i], np.maximum(left[:, i] - 1, 0)
            made[places] = factor, left
        return made

    def _monomials(self, x: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Monomials (n, N) at columns x, as a function of exponents (n, m)."""
        powers = []
        for z, most in zip(x / self.scales[:, None], self.exponents.max(axis=0, initial=0), strict=True):
            table = np.ones((most + 1, len(z)))
            for k in range(1, most + 1):
                np.multiply(table[k - 1], z, out=table[k])
            powers.append(table)

        def monomials(exponents: np.ndarray) -> np.ndarray:
            made = powers[0][exponents[:, 0]]
            for table, e in zip(powers[1:], exponents.T[1:], strict=True):
                made *= table[e]
            return made

        return monomials

    def functions(self, x: np.ndarray) -> np.ndarray:
        return self._monomials(x)(self.exponents)

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, Curvature]:
        made, first = self._monomials(x), np.zeros((len(x), self.n, x.shape[1]))
        for row, (factor, left) in zip(first, self._derivatives.values(), strict=False):
            np.multiply(made(left), factor[:, None], out=row)
        second = (
            (places, used, factor[used, None] * made(left[used]))
            for places, (factor, left) in self._derivatives.items()
            if len(places) == 2 and (used := factor != 0).any()
        )
        return first, second

    def subset(self, kept: np.ndarray) -> Polynomial:
        """The polynomial of some of the monomials (n,)."""
        return Polynomial(self.of, self.exponents[kept], self.scales)

    def coefficients(self, theta: np.ndarray) -> np.ndarray:
        """The coefficients of the monomials in x itself."""
        return theta / np.prod(self.scales**self.exponents, axis=1)

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        terms = zip(self.coefficients(theta), self.exponents.tolist(), strict=True)
        return sympy.Add(*(_float(c) * sympy.Mul(*(v**e for v, e in zip(x, m, strict=True))) for c, m in terms if c))


def kinetic(scales: Any) -> Polynomial:
    """Return ½ pᵀM⁻¹p, M⁻¹ symmetric, θ its entries on and above the diagonal."""
    units = np.eye(len(scales), dtype=int)
    return Polynomial("p", [a + b for a, b in combinations_with_replacement(units, 2)], scales)


class Fixed(Part):
    """A function that is known: a sum with numbers that are not learned."""

    def __init__(self, part: Sum, theta: np.ndarray) -> None:
        self.of, self.n, self.part, self.theta, self.quadratic = part.of, 0, part, theta, part.quadratic

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        value, slopes, _ = self.part.gradient(self.theta, x, slope, False)
        return Linear(value, slopes, np.empty((len(x), 0, x.shape[1])) if by_parameters else None)

    def momenta(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not (self.quadratic and self.of == "p"):
            return super().momenta(q, v)
        p = np.linalg.pinv(self.inverse_mass) @ v
        return np.concatenate([p, np.zeros_like(p)]), np.zeros((2 * len(q), 0, q.shape[1]))

    @property
    def inverse_mass(self) -> np.ndarray:
        """M⁻¹ of a kinetic energy ½ pᵀM⁻¹p."""
        return self.part.gradient(self.theta, np.ones((self.part.width, 1)), True, False).slope[..., 0]

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        return self.part.value(self.theta, x)

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        return self.part.expression(self.theta, x)


def known_kinetic(inverse_mass: np.ndarray) -> Fixed:
    """Return ½ pᵀM⁻¹p of a mass matrix that is given."""
    rows, columns = np.triu_indices(len(inverse_mass))
    theta = np.where(rows == columns, 0.5, 1.0) * inverse_mass[rows, columns]
    return Fixed(kinetic(np.ones(len(inverse_mass))), theta)


class Waves(Sum):
    """Σ_m θ_m Π_i (x_i/s_i)^m_i cos(k_m·x + φ_m): Fourier series in angles, with powers of the other coordinates.

    Exponents m and wave vectors k are (n, m), phases φ (n,): 0 for cosines, −π/2 for sines.
    """

    def __init__(self, of: str, exponents: Any, waves: Any, phases: Any, scales: Any) -> None:
        self.of, self.waves, self.phases = of, np.asarray(waves, dtype=float), np.asarray(phases, dtype=float)
        self.powers = Polynomial(of, exponents, scales)
        self.n = len(self.waves)
        self._angles, self._place = np.unique(self.waves, axis=0, return_inverse=True)
        self._place = self._place.ravel()

    @property
    def width(self) -> int:
        return self.waves.shape[1]

    @classmethod
    def up_to(
        cls, harmonics: int, degree: int, of: str, scales: Any, periods: np.ndarray, constant: bool = False
    ) -> Waves:
        """Harmonics to this order of the angles, which have a period, times powers of the others to this degree.

        The constant, which has no effect as a term of H, is the first term if requested.
        """
        angles = np.isfinite(periods)
        span = [range(-harmonics, harmonics + 1) if angle else (0,) for angle in angles]
        reach = [(0,) if angle else range(degree + 1) for angle in angles]
        vectors = [v for v in product(*span) if sum(map(abs, v)) <= harmonics and v >= tuple(-x for x in v)]
        monomials = [e for e in product(*reach) if sum(e) <= degree]
        terms = [
            (e, v, phase)
            for e in sorted(monomials, key=sum)
            for v in sorted(vectors, key=lambda v: sum(map(abs, v)))
            for phase in ((0.0, -np.pi / 2) if any(v) else (0.0,))
            if constant or any(e) or any(v)
        ]
        exponents, chosen, phases = zip(*terms, strict=True)
        return cls(of, exponents, np.array(chosen) * np.where(angles, 2 * np.pi / periods, 0.0), phases, scales)

    def subset(self, kept: np.ndarray) -> Waves:
        exponents = self.powers.exponents[kept]
        return Waves(self.of, exponents, self.waves[kept], self.phases[kept], self.powers.scales)

    def _turns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The cosines of all terms and their derivatives by the angle, (n, N)."""
        u = self._angles @ x
        cos, sin = np.cos(u)[self._place], np.sin(u)[self._place]
        c, s = np.cos(self.phases)[:, None], np.sin(self.phases)[:, None]
        return cos * c - sin * s, -(sin * c + cos * s)

    def functions(self, x: np.ndarray) -> np.ndarray:
        return self.powers.functions(x) * self._turns(x)[0]

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, Curvature]:
        k = self.waves.T[..., None]
        wave, turned = self._turns(x)
        pairs, all_ = [*combinations_with_replacement(range(len(x)), 2)], slice(None)
        if not self.powers.exponents.any():  # of angles alone
            return k * turned, (((i, j), all_, -k[i] * k[j] * wave) for i, j in pairs)
        whole, (first, second) = self.powers.functions(x), self.powers.derivatives(x)

        def curvature() -> Curvature:
            bent = {pair: (used, terms) for pair, used, terms in second}
            for i, j in pairs:
                made = (first[i] * k[j] + first[j] * k[i]) * turned - k[i] * k[j] * whole * wave
                if (i, j) in bent:
                    used, terms = bent[i, j]
                    made[used] += terms * wave[used]
                yield (i, j), all_, made

        return first * wave + k * whole * turned, curvature()

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        made = []
        rows = zip(
            self.powers.coefficients(theta), self.powers.exponents.tolist(), self.waves, self.phases, strict=True
        )
        for c, m, k, phase in rows:
            angle = sympy.Add(*(_float(a) * v for a, v in zip(k, x, strict=True) if a))
            turn = sympy.sin(angle) if phase else sympy.cos(angle)
            made.append(_float(c) * sympy.Mul(*(v**e for v, e in zip(x, m, strict=True))) * turn)
        return sympy.Add(*made)


class Network(Part):
    """Σ_k w_k tanh(a_k·z + b_k), neurons in one layer; z has x_i/s_i, of an angle its cosine and sine."""

    linear = False

    def __init__(self, of: str, width: int, scales: Any, periods: np.ndarray | None = None) -> None:
        self.of, self.width, self.scales = of, width, np.asarray(scales, dtype=float)
        self.periods = np.full(len(self.scales), np.inf) if periods is None else periods
        self.inputs = [
            (i, kind) for i, P in enumerate(self.periods) for kind in (("cos", "sin") if np.isfinite(P) else ("line",))
        ]
        self.n = width * (len(self.inputs) + 2)

    def start(self, rng: np.random.Generator) -> np.ndarray:
        a = rng.normal(size=(self.width, len(self.inputs)))
        a *= rng.uniform(0.5, 1.5, self.width)[:, None] / np.linalg.norm(a, axis=1, keepdims=True)
        w = 0.1 * rng.normal(size=self.width)
        return np.concatenate([w, a.ravel(), rng.uniform(-1.5, 1.5, self.width)])

    @property
    def prior(self) -> np.ndarray:
        return np.concatenate([np.zeros(self.width), np.full(self.n - self.width, 1 / STEEP)])

    def _split(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        K, e = self.width, len(self.inputs)
        return theta[:K], theta[K : K + K * e].reshape(K, e), theta[K + K * e :]

    def _embedded(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The inputs z (e, N), with their first and second derivatives by the coordinate of each."""
        z, first, second = (np.empty((len(self.inputs), x.shape[1])) for _ in range(3))
        for row, (i, kind) in enumerate(self.inputs):
            if kind == "line":
                z[row], first[row], second[row] = x[i] / self.scales[i], 1 / self.scales[i], 0.0
            else:
                k = 2 * np.pi / self.periods[i]
                cos, sin = np.cos(k * x[i]), np.sin(k * x[i])
                z[row], first[row] = (cos, -k * sin) if kind == "cos" else (sin, k * cos)
                second[row] = -k * k * z[row]
        return z, first, second

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        m, N = x.shape
        K = self.width
        w, a, b = self._split(theta)
        z, first, second = self._embedded(x)
        neuron = np.tanh(a @ z + b[:, None])
        s1 = 1 - neuron * neuron
        s2 = -2 * neuron * s1
        rows = [[r for r, (place, _) in enumerate(self.inputs) if place == i] for i in range(m)]
        along = [a[:, r] @ first[r] for r in rows]  # of each coordinate, (K, N)
        value = np.stack([w @ (s1 * v) for v in along])
        slopes = np.empty((m, m, N)) if slope else None
        if slopes is not None:
            for i in range(m):
                for j in range(i, m):
                    slopes[i, j] = slopes[j, i] = w @ (s2 * along[i] * along[j])
                slopes[i, i] += w @ (s1 * (a[:, rows[i]] @ second[rows[i]]))
        if not by_parameters:
            return Linear(value, slopes)
        by, e = np.empty((m, self.n, N)), len(self.inputs)
        for i in range(m):
            np.multiply(s1, along[i], out=by[i, :K])
            bent = (w[:, None] * s2) * along[i]
            by[i, K + K * e :] = bent
            for r in range(e):
                column = by[i, K + r : K + K * e : e]
                np.multiply(bent, z[r], out=column)
                if r in rows[i]:
                    column += (w[:, None] * s1) * first[r]
        return Linear(value, slopes, by)

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        w, a, b = self._split(theta)
        return w @ np.tanh(a @ self._embedded(x)[0] + b[:, None])

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        w, a, b = self._split(theta)
        inputs = []
        for i, kind in self.inputs:
            angle = _float(2 * np.pi / self.periods[i]) * x[i]
            inputs.append(x[i] / _float(self.scales[i]) if kind == "line" else getattr(sympy, kind)(angle))
        made = []
        for weight, row, bias in zip(w, a, b, strict=True):
            sum_ = sympy.Add(_float(bias), *(_float(c) * z for c, z in zip(row, inputs, strict=True)))
            made.append(_float(weight) * sympy.tanh(sum_))
        return sympy.Add(*made)


class Distances(Part):
    """Σ_k θ_k (r_k/s)^e_k, of distances r between two bodies, or of one from the origin; log(r/s) where e is 0.

    `bodies` (n_bodies, dim) are places in q, `terms` two bodies, or one and None for the origin, and e.
    """

    of = "q"
    terms = True

    def __init__(self, bodies: np.ndarray, terms: Sequence[tuple[int, int | None, int]], scale: float) -> None:
        self.bodies, self.kinds, self.scale, self.n = bodies, list(terms), scale, len(terms)

    @classmethod
    def between(cls, bodies: np.ndarray, powers: Sequence[int], scale: float, central: bool = False) -> Distances:
        """All powers of the distances of all pairs of bodies, and from the origin if requested."""
        n = len(bodies)
        lines = [*combinations(range(n), 2), *((a, None) for a in range(n) if central)]
        return cls(bodies, [(*line, e) for line in lines for e in powers], scale)

    def subset(self, kept: np.ndarray) -> Distances:
        return Distances(self.bodies, [kind for kind, keep in zip(self.kinds, kept, strict=True) if keep], self.scale)

    def squares(self) -> Distances:
        """The squares of the same distances."""
        return Distances(self.bodies, [(*line, 2) for line in self._lines], 1.0)

    @cached_property
    def _lines(self) -> dict[tuple[int, int | None], list[int]]:
        """The numbers of each distance."""
        made: dict[tuple[int, int | None], list[int]] = {}
        for k, (a, b, _) in enumerate(self.kinds):
            made.setdefault((a, b), []).append(k)
        return made

    def _distance(self, x: np.ndarray, a: int, b: int | None) -> tuple[np.ndarray, np.ndarray]:
        """The line from b to a, and its length, in units of s."""
        line = (x[self.bodies[a]] - (0.0 if b is None else x[self.bodies[b]])) / self.scale
        return line, np.sqrt(np.sum(line * line, axis=0))

    def _functions(self, numbers: list[int], r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """f, f' and f'' of some terms, (k, N)."""
        powers = [self.kinds[k][2] for k in numbers]
        f = np.stack([r**e if e else np.log(r) for e in powers])
        first = np.stack([e * r ** (e - 1.0) if e else 1 / r for e in powers])
        second = np.stack([e * (e - 1) * r ** (e - 2.0) if e else -1 / r**2 for e in powers])
        return f, first, second

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        m, N = x.shape
        value = np.zeros((m, N))
        slopes = np.zeros((m, m, N)) if slope else None
        by = np.zeros((m, self.n, N)) if by_parameters else None
        for (a, b), places in self._lines.items():
            line, r = self._distance(x, a, b)
            unit = line / r
            _, first, second = self._functions(places, r)
            pull = theta[places] @ first
            curved = (theta[places] @ second - pull / r) * unit[:, None] * unit
            curved[np.diag_indices(len(unit))] += pull / r
            ends = [(self.bodies[a], 1.0)] + ([] if b is None else [(self.bodies[b], -1.0)])
            for rows, sign in ends:
                value[rows] += sign / self.scale * pull * unit
                if by is not None:
                    by[np.ix_(rows, places)] += sign / self.scale * unit[:, None] * first
                if slopes is not None:
                    for others, turn in ends:
                        slopes[np.ix_(rows, others)] += sign * turn / self.scale**2 * curved
        return Linear(value, slopes, by)

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        total = np.zeros(x.shape[1])
        for line, places in self._lines.items():
            total += theta[places] @ self._functions(places, self._distance(x, *line)[1])[0]
        return total

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        made = []
        for c, (a, b, e) in zip(theta, self.kinds, strict=True):
            others = [0 if b is None else x[i] for i in self.bodies[a if b is None else b]]
            square = sympy.Add(*((x[i] - other) ** 2 for i, other in zip(self.bodies[a], others, strict=True)))
            if e:
                made.append(_float(c / self.scale**e) * square ** sympy.Rational(e, 2))
            else:
                made.append(_float(c / 2) * sympy.log(square))
        return sympy.Add(*made)


def _float(value: float) -> sympy.Float:
    return sympy.Float(float(value), 17)


class Drive(Part):
    """Σ_k (a_k cos ωt + b_k sin ωt) f_k(q), forces that a clock moves, of about this ω; θ = [a, b, change of ω]."""

    of = "q"

    def __init__(self, base: Part, frequency: float, times: np.ndarray | float = 0.0) -> None:
        self.base, self.frequency, self.times = base, frequency, times
        self.n = 2 * base.n + 1 if base.n else 0

    @property
    def terms(self) -> np.ndarray:  # type: ignore[override]
        return np.arange(self.n) < self.n - 1

    def subset(self, kept: np.ndarray) -> Part:
        """The drive with the terms whose cosine or sine is kept."""
        return Drive(self.base.subset(kept[: self.base.n] | kept[self.base.n : -1]), self.frequency)

    def at(self, t: np.ndarray) -> Drive:
        return Drive(self.base, self.frequency, t)

    def _waves(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = (self.frequency + theta[-1]) * self.times
        return np.cos(angle), np.sin(angle)

    def gradient(self, theta: np.ndarray, x: np.ndarray, slope: bool, by_parameters: bool) -> Linear:
        cos, sin = self._waves(theta)
        a, b = (self.base.gradient(part, x, slope, by_parameters) for part in np.split(theta[:-1], 2))
        slopes = a.slope * cos + b.slope * sin if slope else None
        by = None
        if a.by_parameters is not None:
            turned = self.times * (b.value * cos - a.value * sin)
            by = np.concatenate([a.by_parameters * cos, a.by_parameters * sin, turned[:, None]], axis=1)
        return Linear(a.value * cos + b.value * sin, slopes, by)

    def value(self, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        a, b = np.split(theta[:-1], 2)
        cos, sin = self._waves(theta)
        return self.base.value(a, x) * cos + self.base.value(b, x) * sin

    def expression(self, theta: np.ndarray, x: Sequence[sympy.Symbol]) -> sympy.Expr:
        angle = _float(self.frequency + theta[-1]) * sympy.Symbol("t", real=True)
        a, b = (self.base.expression(part, x) for part in np.split(theta[:-1], 2))
        return a * sympy.cos(angle) + b * sympy.sin(angle)
