"""Bodies that interact in pairs, any number of them, by the potential of one pair."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, cached_property, lru_cache
from itertools import combinations
from typing import Any, Self

import numpy as np
import sympy as sp

from sympflow.arguments import check_kept, checked_count, checked_number, plain, real_array
from sympflow.arrays import Array, as_array, is_tensor, like, masked, to_numpy
from sympflow.hamiltonian.jumps import check_continuous
from sympflow.hamiltonian.local import LocalHamiltonian, check_memory, checked_params, named_values, numbered, parsed
from sympflow.hamiltonian.poles import PairsPoles, Poles
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, without_deltas

MOST_AXES = 3
MOST_NEAR = 300  # about how many bodies each is compared with where there are cells
MOST_PAIRS = 1_000_000  # pairs whose values stand in memory at a time
ALL_AT_ONCE = 24
"""Bodies up to which the pairs are met by one product with the matrix of their ends, which is faster than indices."""
SHORTEST, LONGEST, SCANNED = 1e-30, 1e30, 30001  # distances between which a minimum of V is looked for
FAR, REACH = (10.0, 100.0), 2.0
"""Bond lengths at which V must have fallen off faster than bodies grow in number, and which a cut-off must have."""
MOST_WRITTEN = 45  # differences of coordinates of two bodies up to which pairs are written out: six bodies in space
MOST_SPELLED_PAIRS = 400  # pairs up to which H is written in symbols, term by term, for methods that need it so
ASLANT = np.array([1.0, 0.6180339887498949, 0.3247179572447460])  # a direction at which no places differ by accident
STRAIGHT, TINY = 1e-9, float(np.finfo(float).tiny)
"""Share of a velocity that is across the line between two bodies, below which they move along it."""
NEARLY = 1 - 1e-12  # squared cosine of the angle between velocity and line, at least, where that share is looked for
CHEAP_PAIRS, MANY_STEPS = 2016, 1000
"""Pairs up to which the ends of a run are always looked at, and steps beside which it costs nothing."""


class PairsHamiltonian(LocalHamiltonian):
    """H = Σ_i |p_i|²/2m_i + Σ_{i<j} V(r_ij), see `HamiltonianSystem.pairs`."""

    loops, noun = "pairs", "system of bodies"
    quadratic_kinetic = True

    def __init__(
        self,
        potential: str | sp.Expr,
        masses: Any,
        dim: Any,
        box: Any,
        cutoff: Any,
        softening: Any,
        params: Mapping[str, Any] | None,
        bodies: Mapping[str, Any] | None,
    ) -> None:
        self.dim = checked_count("dim", plain(dim), 1, MOST_AXES, "1, 2 or 3, the coordinates of a body")
        self.masses = checked_column("masses", masses)
        self._check_masses()
        self.n_bodies = len(self.masses)
        if self.n_bodies < 2:
            raise ValueError("`masses` must be those of two bodies or more, an array (n,).")
        check_memory(float(self.n_bodies) * self.dim, "`masses`")
        self.ndof = self.n_bodies * self.dim
        self.box, self.cutoff = _checked_box(box, self.dim), _checked_length("cutoff", cutoff)
        self.softening = _checked_length("softening", softening) or 0.0
        if self.cutoff is not None and self.box is not None and self.cutoff > self.box.min() / 2:
            raise ValueError(
                f"`cutoff` {self.cutoff:g} is longer than half the box, {self.box.min() / 2:g}: a body would interact "
                "with another one and with its image. Take a shorter one, or a larger `box`."
            )
        self.signed = self.box is None and not self.softening  # bodies pass at r = 0 if they change places on a line
        self.leaps = not self.softening
        self.is_few = self.n_bodies * (self.n_bodies - 1) // 2 * self.dim <= MOST_WRITTEN  # pairs are written out
        self._all_at_once = self.n_bodies <= ALL_AT_ONCE and self.cutoff is None
        self._set_params(params)
        self._read(potential, {"m": self.masses, **self._checked_bodies(bodies)})
        self._set_inertia()

    def _set_inertia(self) -> None:
        self.inertia = np.where(self.masses > 0, self.masses, 1.0)  # the momentum of each body over its velocity
        mass = np.repeat(1 / self.inertia, self.dim)
        self.inverse_mass = None if (mass == 1).all() else mass

    def _set_params(self, params: Any) -> None:
        remedy = "; what differs from body to body goes to `bodies`"
        self.params = {name: float(value) for name, value in checked_params(params, remedy=remedy).items()}

    def _check_masses(self) -> None:
        if not (self.masses > 0).all():
            i = int(np.argmin(self.masses))
            raise ValueError(f"`masses` must be positive; that of body {i} is {self.masses[i]:g}: change it.")

    def _checked_bodies(self, bodies: Any) -> dict[str, np.ndarray]:
        columns = {}
        for name, given in named_values("bodies", bodies, "arrays").items():
            columns[name] = checked_column(f"bodies[{name!r}]", given)
            if columns[name].shape != self.masses.shape:
                raise ValueError(
                    f"`bodies` has {name} of {columns[name].size} values, and there are {self.n_bodies} `masses`: give "
                    "one for each body."
                )
            if name == "m" and not np.array_equal(columns[name], self.masses):
                raise ValueError("`bodies` has m, which stands for the `masses`: rename it.")
        return columns

    def _read(self, potential: Any, columns: Mapping[str, np.ndarray]) -> None:
        r, self.s = sp.Symbol("r", positive=True), sp.Symbol("s", positive=True)
        first, second = numbered("a", tuple(columns)), numbered("b", tuple(columns))
        c = numbered("c", tuple(self.params))
        names: dict[str, sp.Symbol] = {"r": r}
        for name, a, b in zip(columns, first, second, strict=True):
            names |= {f"{name}1": a, f"{name}2": b}
        for name, letter in zip(self.params, c, strict=True):
            if name in names:
                raise ValueError(
                    f"`params` gives a value to {name!r}, which names a quantity of bodies or pairs: rename it."
                )
            names[name] = letter
        V = parsed("potential", potential, names, "-G*m1*m2/r")
        if r not in V.free_symbols:
            raise ValueError(f"`potential` must depend on r, the distance of two bodies; got {V}.")
        for name, letter in zip(self.params, c, strict=True):
            if letter not in V.free_symbols:
                raise ValueError(f"`params` has {name!r}, which the potential does not use: remove it.")
        used = [bool({a, b} & V.free_symbols) for a, b in zip(first, second, strict=True)]
        for name, is_used in zip(columns, used, strict=True):
            if name != "m" and not is_used:
                raise ValueError(f"`bodies` has {name!r}, and V uses neither {name}1 nor {name}2: remove it.")
        exchanged = V.xreplace(dict(zip((*first, *second), (*second, *first), strict=True)))
        if sp.simplify(V - exchanged) != 0:
            raise ValueError(
                "`potential` must be the same with the two bodies exchanged, those of 1 for those of 2; got "
                f"{potential}. Take a sum or a product of both."
            )
        self.first = tuple(a for a, is_used in zip(first, used, strict=True) if is_used)
        self.second = tuple(b for b, is_used in zip(second, used, strict=True) if is_used)
        self.columns = np.array([x for x, is_used in zip(columns.values(), used, strict=True) if is_used])
        self.columns = self.columns.reshape(-1, self.n_bodies)
        self._has_masses = used[0]  # which the first column is
        self.c, self.constants = c, tuple(self.params.values())
        self.of_distance = V
        V = V.subs(r, sp.sqrt(self.s))
        if self.cutoff is not None:
            end = sp.Symbol("end", positive=True)
            slope = sp.diff(V, self.s).subs(self.s, end)
            V = V - V.subs(self.s, end) - (self.s - end) * slope
            self.c, self.constants = (*self.c, end), (*self.constants, self.cutoff**2 + self.softening**2)
        self.V = V
        self._check_continuous()

    def _check_continuous(self) -> None:
        """Refuse a V that jumps."""
        columns = [*self.columns, *self.columns, *self.params.values()]
        symbols = (*self.first, *self.second, *self.c[: len(self.params)])
        names = dict(zip(self.c, self.params, strict=False))
        distance = [s for s in self.of_distance.free_symbols if s.name == "r"]
        check_continuous("potential", self.of_distance, distance, dict(zip(symbols, columns, strict=True)), names)

    def identity_parts(self) -> Any:
        made_with = (self.dim, self.masses, self.box, self.cutoff, self.softening)
        return [made_with, self.V, self.columns, list(self.params.items())]

    @property
    def _mass_names(self) -> list[str]:
        return [f"masses[{i}]" for i in range(self.n_bodies)]

    def number_columns(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Values of parameters, with those of `masses` (..., n) body by body."""
        found = dict(params)
        if "masses" in found and "masses" not in self.params:
            masses = as_array(found.pop("masses"))
            if masses.ndim == 0 or masses.shape[-1] != self.n_bodies:
                raise ValueError(
                    f"`params` has masses of shape {tuple(masses.shape)}: give one for each of the {self.n_bodies} "
                    "bodies, on the last axis."
                )
            if not (to_numpy(masses) > 0).all():
                raise ValueError("`params` has masses that are not positive: change them.")
            found |= {name: masses[..., i] for i, name in enumerate(self._mass_names)}
        return found

    def check_names(self, names: Iterable[str]) -> None:
        own = self._mass_names
        super().check_names(name for name in names if name not in own)

    def with_params(self, values: Mapping[str, Any]) -> Self:
        return super().with_params(self.number_columns(values))

    def _take(self, params: Mapping[str, Any]) -> None:
        masses = [params.get(name, m) for name, m in zip(self._mass_names, self.masses.tolist(), strict=True)]
        self._set_params({name: value for name, value in params.items() if name in self.params})
        self.constants = (*self.params.values(), *self.constants[len(self.params) :])
        if masses != self.masses.tolist():
            self.masses = checked_column("masses", masses)
            self._check_masses()
            if self._has_masses:
                self.columns = np.concatenate([self.masses[None], self.columns[1:]])
            self._set_inertia()
        self._check_continuous()

    def parameter_values(self, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """All that a pair and the drifts depend on, by symbols: of the parameters and masses in `numbers` these."""
        names = [*self.params, *self.c[len(self.params) :]][: len(self.c)]  # an `extra` potential has more
        found = {c.name: numbers.get(n, x) for n, c, x in zip(names, self.c, self.constants, strict=True)}
        found["softening"] = self.softening**2
        for k, side in enumerate(() if self.box is None else self.box.tolist()):
            found |= {f"box_{k}": side, f"over_box_{k}": 1 / side}
        masses = [numbers.get(name, m) for name, m in zip(self._mass_names, self.masses.tolist(), strict=True)]
        found |= {f"w_{i}": 1 / mass for i, mass in enumerate(masses)}
        for i, column in enumerate(self.columns.tolist()):
            values = masses if i == 0 and self._has_masses else column
            found |= {f"column_{i}_{k}": x for k, x in enumerate(values)}
        return found

    @property
    def work(self) -> int:
        pairs = self.n_bodies * (self.n_bodies - 1) // 2
        return 2 * (pairs if self.cutoff is None else min(pairs, MOST_NEAR * self.n_bodies))

    @property
    def written(self) -> SymbolicHamiltonian | None:  # type: ignore[override]
        return self.spelled if self.is_few else None

    def in_symbols(self) -> SymbolicHamiltonian | None:
        pairs = self.n_bodies * (self.n_bodies - 1) // 2
        if self.box is not None or self.cutoff is not None or pairs > MOST_SPELLED_PAIRS:
            return None
        q, p = (sp.symbols(f"{name}1:{self.ndof + 1}", real=True) for name in "qp")
        values = self.parameter_values({})
        symbols = {name: sp.Symbol(name, real=True) for name in values}
        T = sp.Add(*(symbols[f"w_{i // self.dim}"] * x**2 / 2 for i, x in enumerate(p)))
        columns = [[symbols[f"column_{i}_{k}"] for k in range(self.n_bodies)] for i in range(len(self.columns))]
        softening = symbols["softening"] if self.softening else sp.S.Zero
        V = self.written_potential(q, softening, columns, {c: symbols[c.name] for c in self.c})
        H = T + V
        return SymbolicHamiltonian(H, {name: values[name] for name, s in symbols.items() if s in H.free_symbols})

    def written_potential(
        self,
        q: Sequence[sp.Expr],
        softening: sp.Expr,
        columns: Sequence[Sequence[sp.Expr]],
        c: Mapping[sp.Symbol, sp.Expr],
        box: Sequence[sp.Expr] = (),
    ) -> sp.Expr:
        """V of all pairs, in symbols of positions, ε², columns of bodies, parameters and the sides of the box."""
        terms = []
        for i, j in combinations(range(self.n_bodies), 2):
            d = [q[self.dim * i + k] - q[self.dim * j + k] for k in range(self.dim)]
            for k, side in enumerate(box):
                d[k] -= side * sp.floor(d[k] / side + sp.Rational(1, 2))
            s = sp.Add(*(x**2 for x in d)) + softening
            put = {a: column[i] for a, column in zip(self.first, columns, strict=True)}
            put |= {b: column[j] for b, column in zip(self.second, columns, strict=True)}
            term = self.V.xreplace({**c, **put}).subs(self.s, s)
            if self.cutoff is not None:
                term = sp.Piecewise((term, s < c[self.c[-1]]), (0, True))
            terms.append(term)
        return sp.Add(*terms)

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        return all((x == x[0]).all() for x in (self.masses, *self.columns))

    @property
    def apart(self) -> float:  # type: ignore[override]
        """A power of two near six bonds: bodies nearer than one repel each other, beside which all else is rounding."""
        return (
            1.0 if self.box is not None or self.bond_length is None else 2.0 ** round(math.log2(6 * self.bond_length))
        )

    @cached_property
    def bond_length(self) -> float | None:
        """About how far two bodies rest apart, if V has a minimum and so short a range that only neighbours count."""
        if not self.uniform:
            return None
        r = np.geomspace(SHORTEST, LONGEST, SCANNED)
        V = self._of_distance(r)
        with np.errstate(all="ignore"):
            deep = V[-1] - V
            k = int(np.nanargmax(np.where(np.isfinite(deep), deep, -np.inf))) if np.isfinite(V[-1]) else 0
            if not (0 < k < SCANNED - 1 and deep[k] > 0):
                return None
            far = np.abs(V[-1] - self._of_distance(r[k] * np.array([1.0, *FAR]))) * np.array([1.0, *FAR]) ** self.dim
        if not (np.isfinite(far).all() and far[1] < far[0] and far[2] <= far[1]):
            return None
        if self.cutoff is not None and self.cutoff < REACH * r[k]:
            return None
        return float(r[k])

    def _of_distance(self, r: np.ndarray) -> np.ndarray:
        """V of two bodies at distances (n,), the first two bodies where they differ."""
        return Pairs(self, np.zeros(len(r), int), np.ones(len(r), int), [r[:, None]]).values(0)

    @property
    def numbers(self) -> int:
        return 4 * self.dim * self.n_bodies * (self.n_bodies - 1)

    @property
    def slopes(self) -> list[sp.Expr]:
        """V, 2V′, 4V″ and 8V‴, derivatives by s."""
        return [without_deltas(2**k * sp.diff(self.V, self.s, k)) if k else self.V for k in range(4)]

    # array functions, positions (..., d) ------------------------------------------------------------------------------

    def potential(self, q: Array) -> Array:
        total: Any = 0 * q[..., 0]
        for pairs in self._pairs(q):
            total = total + pairs.values(0).sum(-1)
        return total

    def potential_gradient(self, q: Array) -> Array:
        return self._forces(lambda pairs: pairs.values(1)[..., None] * pairs.x[0], q)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        def product(pairs: Pairs) -> Array:
            x, w = pairs.x
            return pairs.values(1)[..., None] * w + (pairs.values(2) * _dot(x, w))[..., None] * x

        return self._forces(product, q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        def product(pairs: Pairs) -> Array:
            x, a, b = pairs.x
            xa, xb, ab = (_dot(y, z) for y, z in ((x, a), (x, b), (a, b)))
            two, three = pairs.values(2), pairs.values(3)
            along = (three * xa * xb + two * ab)[..., None] * x
            return along + (two * xa)[..., None] * b + (two * xb)[..., None] * a

        return self._forces(product, q, v, w)

    def energy_density(self, y: Array, *t: Array) -> Array:
        q, p = y[..., : self.ndof], self._of_bodies(y[..., self.ndof :])
        masses = like(self.masses, y)
        density = (p * p).sum(-1, keepdims=True) / (2 * masses[:, None])
        for pairs in self._pairs(q):
            half = pairs.values(0)[..., None] / 2
            density = _added(_added(density, pairs.i, half), pairs.j, half)
        return density[..., 0]

    @cached_property
    def poles(self) -> Poles | None:
        return PairsPoles(self) or None

    def met(self, y: np.ndarray, together: bool = False) -> Iterator[tuple[Any, Any, np.ndarray, list[Any]]]:
        """The ends i, j (P,) of pairs, their distances (..., P), and values of symbols.

        A distance has a sign on a line, and in space where a pair moves along the line between both, at all of the
        states if they are taken `together`: it changes as they pass each other.
        """
        q, p = y[..., : self.ndof], y[..., self.ndof :]
        if self.dim == 1 or not self.signed:
            for pairs in self._pairs(q):
                yield pairs.i, pairs.j, pairs.x[0][..., 0] if self.signed else np.sqrt(pairs.s), pairs.symbol_values
            return
        for pairs in self._pairs(q, p / np.repeat(self.inertia, self.dim)):
            x, w = pairs.x
            r, side = np.sqrt(pairs.s), np.sign(x @ ASLANT[: self.dim])
            speed = _dot(w, w)
            across = w - (_dot(x, w) / np.maximum(_dot(x, x), TINY))[..., None] * x
            straight = (speed > 0) & (_dot(across, across) <= STRAIGHT**2 * speed)
            along = straight.all(0, keepdims=True) if together else straight
            yield pairs.i, pairs.j, np.where(along, side, 1.0) * r, pairs.symbol_values

    def may_pass(self, y: np.ndarray) -> bool:
        """Return True if two of not too many bodies move about along their line, in one of the states (..., 2d)."""
        if self.n_bodies * (self.n_bodies - 1) // 2 > CHEAP_PAIRS:
            return False
        states = y.reshape(-1, 2, self.n_bodies, self.dim)
        z = states.transpose(1, 3, 0, 2).astype(float, order="C")  # rounding of single precision would hide such motion
        z[1] /= self.inertia
        for i, j in self._ends([states[:, 0]]):
            ways = z.take(i, -1) - z.take(j, -1)
            products = np.einsum("ak...,bk...->ab...", ways, ways)
            along, speed = products[0, 1], products[1, 1]
            if ((along * along >= NEARLY * products[0, 0] * speed) & (speed > 0)).any():
                return True
        return False

    def values_of(
        self, key: str, expressions: list[sp.Expr], x: sp.Symbol, distances: np.ndarray, symbol_values: list[Any]
    ) -> list[Any]:
        """The values of expressions in a distance and the symbols of two bodies."""
        names = (x, *self.first, *self.second, *self.c)
        with np.errstate(all="ignore"):
            values = self._values(f"potential {key}", lambda: expressions, names, distances, *symbol_values)
        return [np.broadcast_to(value, distances.shape) for value in values]

    def leapt(self, starts: np.ndarray, ends: np.ndarray, n_steps: int | np.ndarray, conserves: bool) -> np.ndarray:
        """By an energy that is off by more than T + |V| of the start, and a T of more than twice that."""
        pairs = self.n_bodies * (self.n_bodies - 1) // 2
        T0, T = np.square(np.array([starts, ends])[..., self.ndof :]) @ np.repeat(0.5 / self.inertia, self.dim)
        found = T > 2 * T0
        if not conserves or not found.any() or (pairs > CHEAP_PAIRS and np.max(n_steps) < MANY_STEPS):
            return np.zeros(len(ends), dtype=bool)
        with np.errstate(all="ignore"):
            V0, V = (self.potential(y[:, : self.ndof]) for y in (starts, ends))
            return found & (np.abs(T + V - T0 - V0) > T0 + np.abs(V0))

    def leap(self, y: np.ndarray, start: np.ndarray) -> str:
        before, after = ((self._of_bodies(x[self.ndof :]) ** 2).sum(-1) / self.inertia for x in (start, y))
        i, j = sorted(np.argsort(after - before)[-2:].tolist())
        return (
            f"the bodies {i} and {j} have gained most energy: they met within one step. Reduce `dt`, take "
            "`softening`, or "
            "a method with a clock of its own, such as 'log_leapfrog'"
        )

    def remark(self, q: np.ndarray) -> str:
        from scipy.spatial import cKDTree

        x = self._in_box(q.reshape(self.n_bodies, self.dim))
        distances, neighbours = cKDTree(x, boxsize=self.box).query(x, 2)
        i = int(np.argmin(distances[:, 1]))
        i, j = sorted({i, *neighbours[i].tolist()})[:2]
        apart = distances[:, 1].min()
        if apart > 0:
            return f"the nearest bodies, {i} and {j}, are {apart:.3g} apart: take shorter steps, or `softening`."
        return f"the bodies {i} and {j} are at one place, r = 0: pass `softening`, or another `y0`."

    def _in_box(self, x: np.ndarray) -> np.ndarray:
        """Places (n, dim) inside of the box."""
        if self.box is None:
            return x
        x = np.mod(x, self.box)
        return np.where(x >= self.box, 0.0, x)  # of a rounding

    # how pairs are met ------------------------------------------------------------------------------------------------

    def _of_bodies(self, q: Array) -> Array:
        return q.reshape(*q.shape[:-1], self.n_bodies, self.dim)

    def _forces(self, value: Callable[[Pairs], Array], *arrays: Array) -> Array:
        """The sum over the pairs of each body of values (..., P, dim), those of its second ends with the other sign."""
        q = arrays[0]
        out: Any = 0 * self._of_bodies(sum(arrays[1:], q))
        for pairs in self._pairs(*arrays):
            f = value(pairs)
            if self._all_at_once:
                *lead, _, dim = f.shape
                sums = f.swapaxes(-1, -2).reshape(-1, len(pairs.i)) @ like(_incidence(self.n_bodies), f)
                out = out + sums.reshape(*lead, dim, self.n_bodies).swapaxes(-1, -2)
                continue
            f, g = self._both_ends(f, pairs)
            out = _added(_added(out, pairs.i, f), pairs.j, -g)
        return out.reshape(*out.shape[:-2], self.ndof)

    def _both_ends(self, f: Array, pairs: Pairs) -> tuple[Array, Array]:
        """Values (..., P, dim) for the first and for the second bodies of pairs."""
        return f, f

    def _pairs(self, *arrays: Array) -> Iterator[Pairs]:
        """The pairs that interact, in pieces that fit into memory; with a cut-off those of any state of a batch."""
        bodies = [self._of_bodies(x) for x in arrays]
        for i, j in self._ends(bodies):
            yield Pairs(self, i, j, [self._between(x, i, j, k == 0) for k, x in enumerate(bodies)])

    def _between(self, x: Array, i: np.ndarray, j: np.ndarray, positions: bool) -> Array:
        if self._all_at_once:
            *lead, n, dim = x.shape
            rows = x.swapaxes(-1, -2).reshape(-1, n) @ like(_incidence(n), x).T
            difference = rows.reshape(*lead, dim, len(i)).swapaxes(-1, -2)
        else:
            difference = x[..., i, :] - x[..., j, :]
        if positions and self.box is not None:
            box = like(self.box, x)
            difference = difference - box * (difference / box).round()
        return difference

    def _ends(self, bodies: Sequence[Array]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Indices i < j of pairs, of all states (..., n, dim) together; the first array holds positions."""
        n = self.n_bodies
        if self.cutoff is not None:
            near, most = self._within_cutoff(to_numpy(bodies[0]).reshape(-1, n, self.dim)), most_pairs(bodies)
            for start in range(0, len(near), most):
                yield near[start : start + most, 0], near[start : start + most, 1]
            return
        rows = n if self._all_at_once else max(1, most_pairs(bodies) // n)
        for start in range(0, n - 1, rows):
            yield _of_triangle(start, min(rows, n - 1 - start), n)

    def _within_cutoff(self, states: np.ndarray) -> np.ndarray:
        """The pairs (P, 2) that are nearer than the cut-off in one of the states (N, n, dim) at least."""
        from scipy.spatial import cKDTree

        found = []
        for x in np.where(np.isfinite(states), states, 0.0):
            found.append(cKDTree(self._in_box(x), boxsize=self.box).query_pairs(self.cutoff, output_type="ndarray"))
        return found[0] if len(found) == 1 else np.unique(np.concatenate(found), axis=0)


class Pairs:
    """Pairs of bodies, with the differences x of several arrays, the first of positions, between their ends."""

    def __init__(self, local: PairsHamiltonian, i: np.ndarray, j: np.ndarray, x: list[Array]) -> None:
        self.local, self.i, self.j, self.x = local, i, j, x
        self.s = _dot(x[0], x[0]) + local.softening**2

    @property
    def symbol_values(self) -> list[Any]:
        """The values of the symbols of V: (P,) of the bodies, and numbers."""
        return [*(column[ends] for ends in (self.i, self.j) for column in self.local.columns), *self.local.constants]

    def values(self, k: int) -> Array:
        """2ᵏ times the k-th derivative of V by s, 0 beyond the cut-off: (..., P)."""
        local, s = self.local, self.s
        given = [like(x, s) for x in self.symbol_values]
        variables = (local.s, *local.first, *local.second, *local.c)
        with np.errstate(all="ignore"):  # bodies at one place
            value = local._values(f"potential {k}", lambda: [local.slopes[k]], variables, s, *given)[0] + 0 * s
        if local.cutoff is None:
            return value
        outside = s >= local.cutoff**2 + local.softening**2
        return masked(value, outside, 0.0)


def most_pairs(bodies: Sequence[Array]) -> int:
    """Pairs of bodies (..., n, dim) that fit into memory at a time."""
    batch = np.broadcast_shapes(*(x.shape[:-2] for x in bodies))
    return max(1, MOST_PAIRS // max(1, math.prod(batch)))


@lru_cache(maxsize=16)
def _of_triangle(start: int, rows: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices above the diagonal, row by row from a start."""
    i, j = np.triu_indices(rows, 1, n - start)
    return i + start, j + start


@cache
def _incidence(n: int) -> np.ndarray:
    """1 at the first and −1 at the second end of each pair of n bodies: (P, n)."""
    i, j = np.triu_indices(n, 1)
    return np.eye(n)[i] - np.eye(n)[j]


def _dot(x: Array, y: Array) -> Array:
    """Products of vectors (..., dim), axis by axis, of which there are too few for a sum along the last."""
    return sum((x[..., k] * y[..., k] for k in range(1, x.shape[-1])), x[..., 0] * y[..., 0])


def _added(out: Array, ends: np.ndarray, values: Array) -> Array:
    """`out` (..., n, k) with values (..., P, k) added at the bodies `ends` (P,)."""
    if is_tensor(out):
        import torch

        return out.index_add(-2, torch.as_tensor(ends, device=out.device), values.expand(*out.shape[:-2], -1, -1))
    *lead, n, k = out.shape
    many = math.prod(lead)
    values = np.broadcast_to(values, (*lead, len(ends), k))
    places = np.add.outer(np.add.outer(n * k * np.arange(many), k * ends), np.arange(k))
    sums = np.bincount(places.ravel(), weights=values.ravel(), minlength=many * n * k)
    return out + sums.reshape(out.shape).astype(out.dtype)


def checked_column(name: str, values: Any) -> np.ndarray:
    check_memory(float(math.prod(getattr(values, "shape", ()))), f"`{name}`")  # before any is taken
    array = real_array(name, values)
    if array.ndim != 1:
        raise ValueError(f"`{name}` must have shape (n,), one number for each body; got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite; that of body {int(np.argmin(np.isfinite(array)))} is not.")
    array.setflags(write=False)
    return array


def _checked_length(name: str, value: Any) -> float | None:
    if value is None:
        return None
    check_kept(name, value)
    low = 0.0 if name == "softening" else math.ulp(0.0)
    return float(checked_number(name, plain(value), "a positive, finite length", lambda x: low <= x < math.inf))


def _checked_box(box: Any, dim: int) -> np.ndarray | None:
    if box is None:
        return None
    try:
        lengths = np.broadcast_to(real_array("box", box), (dim,)).copy()
    except ValueError:
        raise ValueError(f"`box` must be a length, or {dim} of them, one along each axis; got {box!r}.") from None
    if not (np.isfinite(lengths) & (lengths > 0)).all():
        raise ValueError(f"`box` must have positive, finite lengths; got {box!r}.")
    return lengths
