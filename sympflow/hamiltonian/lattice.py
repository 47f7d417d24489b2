"""Lattices of any size, by the potential of one site and of one bond."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from itertools import product
from typing import Any, Self

import numpy as np
import sympy as sp

from sympflow.arguments import plain
from sympflow.arrays import Array, concatenate, library, like
from sympflow.hamiltonian.definition import bare_copy
from sympflow.hamiltonian.jumps import check_continuous
from sympflow.hamiltonian.linear_part import RestOfPotential, SpectralPart, Transform, dispersion, quadratic_terms
from sympflow.hamiltonian.local import LocalHamiltonian, check_memory, checked_params, numbered, parsed
from sympflow.hamiltonian.poles import LatticePoles, Poles
from sympflow.hamiltonian.removable import exact
from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

Expressions = Callable[[], Sequence[sp.Expr]]
"""Expressions that are made when a function of them is generated, not in each call of it."""
BOUNDARIES = "periodic", "fixed", "free"
MOST_AXES = 3
FEW = 6, 4, 3  # sites along each axis of a subsystem, of lattices of one, two and three axes
MANY = 64, 10, 5  # the same, of a ring of which long runs are made; as many as a subsystem has, if that is more
MOST_JUDGED = 1024  # degrees of freedom of the lattice on which a flow is judged, where it has more
WELLS, FAR = 8, 100.0
"""Starts from which minima of U are looked for, for each field, and how far they may be, in units of U."""
SIZES, LINES = np.geomspace(1e-30, 1e30, 3001), 64
"""Sizes of fields, and lines for each but one of them, at which U is looked at first."""


class LatticeHamiltonian(LocalHamiltonian):
    """H = Σ_sites [T(p) + U(q)] + Σ_bonds V(r), see `HamiltonianSystem.lattice`."""

    loops = noun = "lattice"

    def __init__(
        self, onsite: Any, bond: Any, shape: Any, boundary: Any, kinetic: Any, fields: Any, params: Any
    ) -> None:
        self.shape = checked_shape(shape)
        self.boundary = _checked_boundary(boundary, len(self.shape))
        self.fields = _checked_fields(fields)
        n_sites = self.sites
        check_memory(float(n_sites) * len(self.fields), "`shape`")
        self.ndof = n_sites * len(self.fields)
        self.params = checked_params(params, self.shape)
        self.x, self.p, self.r, self.v, self.w = (numbered(kind, self.fields) for kind in "xprvw")
        self.c = numbered("c", tuple(self.params))
        self._read(onsite, bond, kinetic)
        self._check_continuous()
        self._check_sizes()
        self._set_mass()

    def identity_parts(self) -> Any:
        return [self.shape, self.boundary, self.fields, self.U, self.T, self.bonds, list(self.params.items())]

    def _take(self, params: Mapping[str, Any]) -> None:
        self.params = checked_params(params, self.shape)
        self._check_continuous()
        self._set_mass()

    def subsystem(self, sites: Any = None, boundary: Any = "periodic") -> Self:
        shape = self.few() if sites is None else checked_shape(sites, "sites")
        if len(shape) == 1:
            shape *= len(self.shape)
        if len(shape) != len(self.shape):
            raise ValueError(
                f"`sites` must be a number of sites along every axis, or {len(self.shape)} of them, one for each axis; "
                f"got {sites!r}."
            )
        shape = tuple(min(n, m) for n, m in zip(shape, self.shape, strict=True)) if not self.uniform else shape
        other = bare_copy(self)
        other._functions = self._functions  # of sites and bonds, whatever their number
        other.shape, other.boundary = shape, _checked_boundary(boundary, len(shape))
        other.ndof = math.prod(shape) * len(self.fields)
        first = tuple(slice(n) for n in shape)
        other.params = checked_params(
            {name: value[first] if isinstance(value, np.ndarray) else value for name, value in self.params.items()},
            shape,
        )
        other._check_sizes("sites")
        other._set_mass()
        return other

    has_subsystem = True

    def along_vectors(self) -> Self:
        """The lattice of K = v·∂H/∂q + w·∂H/∂p, which moves states with tangent vectors [v, w].

        Its positions are [q, v] and its momenta [w, p]. A step of a splitting method for K is one for H with its
        derivative.
        """
        other, n = bare_copy(self), len(self.fields)
        other.fields, other.ndof = (*self.fields, *(f"{name}_along" for name in self.fields)), 2 * self.ndof
        other.x, other.p, other.r, other.v, other.w = (numbered(kind, other.fields) for kind in "xprvw")

        def along(f: sp.Expr, own: Sequence[Any], at: Sequence[Any], vector: Sequence[Any]) -> sp.Expr:
            there = dict(zip(own, at, strict=True))
            return sp.Add(*[sp.diff(f, s).xreplace(there) * v for s, v in zip(own, vector, strict=True)])

        other.T = along(self.T, self.p, other.p[n:], other.p[:n])
        other.U = along(self.U, self.x, other.x[:n], other.x[n:])
        other.bonds = {k: along(V, self.r, other.r[:n], other.r[n:]) for k, V in self.bonds.items()}
        other._set_mass()
        return other

    def judged(self) -> tuple[Any, ...]:
        if not self.uniform or self.ndof <= MOST_JUDGED:
            return ()
        least, shape = self.few(), self.shape
        while math.prod(shape) > MOST_JUDGED and shape > least:
            shape = tuple(max(m, (n + 1) // 2) for n, m in zip(shape, least, strict=True))
        return shape, self.boundary

    def many(self) -> tuple[Any, ...]:
        return (tuple(max(MANY[len(self.shape) - 1], n) for n in self.few()),)

    def few(self) -> tuple[int, ...]:
        """The default number of sites along each axis of a subsystem."""
        least = 2 * max(self.bonds, default=0) + 1
        return (max(FEW[len(self.shape) - 1], least),) * len(self.shape)

    @property
    def uniform(self) -> bool:  # type: ignore[override]
        return not any(isinstance(value, np.ndarray) for value in self.params.values())

    @property
    def ends(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.boundary

    @property
    def sites(self) -> int:
        return math.prod(self.shape)

    @property
    def moves(self) -> bool:
        """True if nothing holds the lattice at its place."""
        return self.U == 0 and "fixed" not in self.boundary

    @cached_property
    def terms(self) -> dict[str, str]:  # type: ignore[override]
        """The terms by name, as texts with the values of the parameters in them: what does not depend on the size."""
        names = self.names
        rows = zip((self.x, self.p, self.r), (names["x"], names["p"], names["r"]), strict=True)
        put: dict[Any, Any] = {s: sp.Symbol(name) for row, own in rows for s, name in zip(row, own, strict=True)}
        arrays = {name: v for name, v in self.params.items() if isinstance(v, np.ndarray)}
        for s, (name, value) in zip(self.c, self.params.items(), strict=True):
            put[s] = sp.Symbol(name) if name in arrays else sp.sympify(value)
        found = {"onsite term": self.U, "kinetic energy": self.T}
        found |= {"bond" if k == 1 else f"bond over {k} sites": V for k, V in self.bonds.items()}
        texts = {name: str(f.xreplace(put)) for name, f in found.items()}
        texts |= {"number of axes": str(len(self.shape)), "list of fields": ", ".join(self.fields)}
        return texts | {
            f"array {name!r}": f"one of shape {v.shape} with sum {v.sum():.9g}" for name, v in arrays.items()
        }

    def wells(self) -> list[np.ndarray]:
        """The values of the fields (F,) at which all sites are at rest: the lowest minima of U, 0 without U.

        U is first looked at along straight lines, at fields of all sizes, for the units in which it is minimized.
        """
        n, rng = len(self.fields), np.random.default_rng(0)
        if self.U == 0:
            return [np.zeros(n)]
        from scipy.optimize import minimize

        values = {s: float(np.mean(v)) for s, v in zip(self.c, self.params.values(), strict=True)}
        U = sp.lambdify([self.x], self.U.xreplace(values), np)
        starts = [np.zeros(n), *rng.uniform(-3, 3, (WELLS * n, n))]
        lines = np.concatenate([np.eye(n), -np.eye(n), rng.standard_normal((LINES * (n - 1), n))])
        lines /= np.linalg.norm(lines, axis=1, keepdims=True)
        with np.errstate(all="ignore"):
            low = np.fmin.reduce(U(SIZES * lines.T[..., None]))
            zero = float(U(np.zeros(n, dtype=np.float64)))
            dips = 1 + np.flatnonzero((low[1:-1] < low[:-2]) & (low[1:-1] <= low[2:]) & ~(low[1:-1] >= zero))
            if not len(dips):
                return [np.zeros(n)]
            least = low[dips].min()
            depth = (zero - least if math.isfinite(zero) else abs(least)) or 1.0
            size = SIZES[dips[low[dips] <= least + 0.01 * depth][0]]

            def scaled(x: np.ndarray) -> float:
                return float((U(size * x) - least) / depth)

            found = [minimize(scaled, start) for start in starts if np.isfinite(scaled(start))]
        found = [m for m in found if np.isfinite(m.fun) and np.abs(m.x).max() < FAR]
        if not found:
            return [np.zeros(n)]
        least = min(m.fun for m in found)
        lowest = sorted((m.x for m in found if m.fun <= least + 1e-6), key=lambda x: float(np.linalg.norm(x)))
        near = 1.5 * float(np.linalg.norm(lowest[0])) + 1e-3  # of a periodic U those about 0
        kept: list[np.ndarray] = []
        for x in lowest:
            if np.linalg.norm(x) <= near and all(np.linalg.norm(x - y) > 1e-2 for y in kept):
                kept.append(x)
        return [size * x for x in kept]

    @cached_property
    def poles(self) -> Poles | None:
        return LatticePoles(self) or None

    def remark(self, q: np.ndarray) -> str:
        if not self.poles:
            return ""
        nearest = LatticePoles(self).nearest(q)
        return f"{nearest} is nearest to a place where V is infinite: take shorter steps, or another `y0`."

    def in_symbols(self) -> SymbolicHamiltonian:
        return SymbolicHamiltonian(self.written_out())

    def written_out(self) -> sp.Expr:
        """H by its coordinates one by one, in q1 … qd, p1 … pd, with the values of the parameters."""
        index, n = np.arange(self.sites).reshape(self.shape), self.sites
        q, p = ([sp.Symbol(f"{kind}{i + 1}") for i in range(self.ndof)] for kind in "qp")
        values = [np.broadcast_to(v, self.shape) for v in self.params.values()]

        def at(x: Sequence[sp.Symbol], own: Sequence[Any], site: int) -> dict[Any, Any]:
            return dict(zip((*x, *self.c), (*own, *(exact(float(v.flat[site])) for v in values)), strict=True))

        def fields(of: Sequence[sp.Symbol], site: int | None) -> list[Any]:
            return [sp.S.Zero if site is None else of[f * n + site] for f in range(len(self.fields))]

        terms = [self.T.xreplace(at(self.p, fields(p, i), i)) for i in range(n)]
        if self.U != 0:
            terms += [self.U.xreplace(at(self.x, fields(q, i), i)) for i in range(n)]
        for axis, k in self._kinds():
            lines = np.moveaxis(index, axis, -1).reshape(-1, self.shape[axis])
            m, boundary = self.shape[axis], self.boundary[axis]
            for line in lines.tolist():
                for i in range(-k if boundary == "fixed" else 0, m):
                    first = line[i] if i >= 0 else None
                    last = line[i + k] if i + k < m else line[(i + k) % m] if boundary == "periodic" else None
                    if boundary == "free" and last is None:
                        continue
                    r = [b - a for a, b in zip(fields(q, first), fields(q, last), strict=True)]
                    terms.append(self.bonds[k].xreplace(at(self.r, r, line[0] if first is None else first)))
        return sp.Add(*terms)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of the positions, momenta and differences of the fields."""
        if len(self.fields) == 1:
            return {"x": self.fields, "p": ("p",), "r": ("r",)}
        return {"x": self.fields, **{kind: tuple(f"{kind}_{f}" for f in self.fields) for kind in "pr"}}

    def _read(self, onsite: Any, bond: Any, kinetic: Any) -> None:
        names = self.names
        if onsite is None and (bond is None or bond == {}):
            raise TypeError("`onsite` or `bond` must be given: the potential of one site, of one bond, or both.")
        values = dict(zip(self.params, self.c, strict=True))
        written = [name for row in names.values() for name in row]
        for name in written:
            if name in values:
                raise ValueError(f"`params` gives a value to {name!r}, which is a coordinate: rename the parameter.")
        if len(set(written)) < len(written):
            raise ValueError(
                f"`fields` {self.fields} give the names {', '.join(written)}, not all different: rename one."
            )

        def expression(argument: str, given: Any, kind: str, example: str) -> sp.Expr:
            own = dict(zip(names[kind], getattr(self, kind), strict=True))
            return parsed(argument, given, {**own, **values}, example)

        self.U = sp.S.Zero if onsite is None else expression("onsite", onsite, "x", f"{self.fields[0]}**2/2")
        default = sp.Add(*[s**2 / 2 for s in self.p])
        self.T = default if kinetic is None else expression("kinetic", kinetic, "p", f"{names['p'][0]}**2/2")
        self.bonds = {
            _checked_distance(k): expression("bond", V, "r", f"{names['r'][0]}**2/2")
            for k, V in (bond.items() if isinstance(bond, Mapping) else [(1, bond)] if bond is not None else [])
        }
        for argument, f, own in (("onsite", self.U, self.x), ("kinetic", self.T, self.p)):
            if (argument == "kinetic" or onsite is not None) and not f.free_symbols & set(own):
                raise ValueError(f"`{argument}` must depend on {' or '.join(names[own[0].name[0]])}; got {f}.")
        for s in self.p:
            if s not in self.T.free_symbols:
                raise ValueError(f"`kinetic` must depend on every momentum, {', '.join(names['p'])}; got {kinetic!r}.")
        for V in self.bonds.values():
            if not V.free_symbols & set(self.r):
                raise ValueError(f"`bond` must depend on {' or '.join(names['r'])}, differences along it; got {V}.")
        used = set().union(*(f.free_symbols for f in (self.U, self.T, *self.bonds.values())))
        for name, s in values.items():
            if s not in used:
                raise ValueError(f"`params` has {name!r}, which no expression uses: remove it.")

    def _check_continuous(self) -> None:
        """Refuse U, V and T that jump."""
        values = dict(zip(self.c, self.params.values(), strict=True))
        own = [(s, name) for kind, row in self.names.items() for s, name in zip(getattr(self, kind), row, strict=True)]
        names = dict([*own, *zip(self.c, self.params, strict=True)])
        for argument, f in (("onsite", self.U), ("kinetic", self.T), *(("bond", V) for V in self.bonds.values())):
            check_continuous(argument, f, [s for s, _ in own], values, names)

    def _check_sizes(self, argument: str = "shape") -> None:
        reach = max(self.bonds, default=0)
        for n, boundary in zip(self.shape, self.boundary, strict=True):
            least = {"periodic": 2 * reach + 1, "free": reach + 1, "fixed": reach}[boundary]
            if reach and n < least:
                raise ValueError(
                    f"`{argument}` has an axis of {n} sites, and bonds over a distance of {reach} need at least "
                    f"{least} where the boundary is {boundary!r}: each pair of sites then has one bond."
                )

    def _set_mass(self) -> None:
        """Find out whether T = ½ pᵀM⁻¹p with a diagonal M."""
        T = self.T
        M = sp.hessian(T, self.p)
        half = sp.Add(*[M[i, i] * s**2 / 2 for i, s in enumerate(self.p)])
        self.quadratic_kinetic = (
            not M.free_symbols & set(self.p) and M.is_diagonal() and sp.expand(T - half).equals(0) is True
        )
        self.inverse_mass = None
        if not self.quadratic_kinetic or all(M[i, i] == 1 for i in range(len(self.p))):
            return
        values = dict(zip(self.c, self.params.values(), strict=True))
        columns = []
        for i in range(len(self.p)):
            used = sorted(M[i, i].free_symbols, key=str)
            with np.errstate(all="ignore"):
                value = sp.lambdify(used, M[i, i], np)(*(values[s] for s in used))
            columns.append(np.broadcast_to(np.asarray(value, dtype=float), self.shape).ravel())
        inverse_mass = np.concatenate(columns)
        if not np.isfinite(inverse_mass).all() or not (inverse_mass != 0).all():
            raise ValueError("`kinetic` has a mass that is 0 or infinite with the values in `params`: change them.")
        self.inverse_mass = inverse_mass

    def linear_and_rest(self, interval: float) -> tuple[SpectralPart, list[Any]]:
        """The quadratic terms of sites and bonds as they are written, in normal modes, and U(q), the rest of V."""
        F, n_sites = len(self.fields), math.prod(self.shape)
        inverse_mass = np.ones(F)
        if self.inverse_mass is not None:
            by_field = self.inverse_mass.reshape(F, n_sites)
            inverse_mass = by_field.mean(-1)
            if np.ptp(by_field, axis=-1).any():
                inverse_mass[0] = math.nan
        if not self.quadratic_kinetic or not (inverse_mass > 0).all():
            raise ValueError(
                "`kinetic` must be ½ p²/m with a positive mass that is the same at all sites, for normal modes to be "
                "known: take a method that splits into T and V, such as 'srkn6b'."
            )
        onsite, U = self._quadratic(self.U, self.x)
        periodic = all(name == "periodic" for name in self.boundary)
        couplings, bonds = {}, {}
        for k, V in self.bonds.items():
            if k == 1 or periodic:
                couplings[k], V = self._quadratic(V, self.r)  # noqa: PLW2901
            if V.free_symbols & set(self.r):
                bonds[k] = V
        if not onsite.any() and not any(kappa.any() for kappa in couplings.values()):
            raise ValueError(
                "`onsite` and `bond` have no quadratic terms that are written out, so there is no linear part: "
                "take a method that splits into T and V, such as 'srkn6b'."
            )
        transform = Transform(self.shape, self.boundary)
        waves = [dispersion(couplings, transform.angles(axis)) for axis in range(len(self.shape))] if couplings else []
        K = transform.total(waves) + onsite if waves else np.broadcast_to(onsite, (*self.shape, F, F))
        linear = SpectralPart.of_matrices(transform, inverse_mass, np.ascontiguousarray(K), interval)
        rest = bare_copy(self)
        rest.U, rest.bonds = U if U.free_symbols & set(self.x) else sp.S.Zero, bonds
        return linear, [RestOfPotential(rest)] if rest.U != 0 or bonds else []

    def _quadratic(self, f: sp.Expr, variables: tuple[sp.Symbol, ...]) -> tuple[np.ndarray, sp.Expr]:
        """K (F, F) of the terms ½ xᵀKx of a site or bond, with numbers and means of arrays; and what remains."""
        values = dict(zip(self.c, self.params.values(), strict=True))
        numbers = {s: v for s, v in values.items() if not isinstance(v, np.ndarray)}
        means = {s: float(v.mean()) for s, v in values.items() if isinstance(v, np.ndarray)}
        with_numbers = f.xreplace(numbers)
        quadratic, _ = quadratic_terms(with_numbers.xreplace(means), (*variables, *self.p))
        K = sp.hessian(quadratic, variables)
        own = sp.Add(*[K[i, j] * a * b / 2 for i, a in enumerate(variables) for j, b in enumerate(variables)])
        return np.array(K.tolist(), dtype=float), sp.expand(with_numbers - own) if own != 0 else with_numbers

    # array functions, positions (..., d) ------------------------------------------------------------------------------

    def potential(self, q: Array) -> Array:
        values = [f for _, _, (f,) in self.of_terms("", lambda f, _: [f], q)]
        return sum((_total(f, self.shape) for f in values), start=0.0)

    def of_terms(
        self, key: str, expressions: Callable[[sp.Expr, tuple[sp.Symbol, ...]], list[sp.Expr]], q: Array
    ) -> list[tuple[int | None, int, list[Array]]]:
        """The values of expressions of U and of each bond along each axis, at all sites and bonds."""
        x, found = self._on_sites(q), list[tuple[int | None, int, list[Array]]]()
        if self.U != 0:
            found.append((None, 0, self._at(None, f"onsite {key}", partial(expressions, self.U, self.x), self.x, x)))
        for axis, k in self._kinds():
            of_bond = partial(expressions, self.bonds[k], self.r)
            values = self._at((axis, k), key, of_bond, self.r, self._differences(x, axis, k))
            if self.boundary[axis] == "periodic":  # each bond once
                values = [_cut(value, axis - len(self.shape), k, None) for value in values]
            found.append((axis, k, values))
        return found

    def potential_gradient(self, q: Array) -> Array:
        return self._gathered(q)

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        return self._gathered(q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        return self._gathered(q, v, w)

    def kinetic(self, p: Array) -> Array:
        return _total(self._at(None, "kinetic", lambda: [self.T], self.p, self._on_sites(p))[0], self.shape)

    def kinetic_gradient(self, p: Array) -> Array:
        slopes = self._at(None, "kinetic 1", partial(_slopes, self.T, self.p), self.p, self._on_sites(p))
        return _joined(slopes, len(self.shape))

    def kinetic_hessian(self, p: Array) -> Array:
        """∇²T, dense: (..., d) to (..., d, d)."""
        xp, n, F = library(p), math.prod(self.shape), len(self.fields)
        S = xp.zeros((*p.shape, p.shape[-1]), dtype=p.dtype)

        def entries() -> list[sp.Expr]:
            return [sp.diff(self.T, a, b) for a, b in product(self.p, self.p)]

        values = self._at(None, "kinetic 2", entries, self.p, self._on_sites(p))
        sites = np.arange(n)
        for (i, j), value in zip(product(range(F), range(F)), values, strict=True):
            S[..., i * n + sites, j * n + sites] = value.reshape(*p.shape[:-1], n)
        return S

    def energy_density(self, y: Array, *t: Array) -> Array:
        x, p = self._on_sites(y[..., : self.ndof]), y[..., self.ndof :]
        density = self._at(None, "kinetic", lambda: [self.T], self.p, self._on_sites(p))[0]
        if self.U != 0:
            density = density + self._at(None, "onsite", lambda: [self.U], self.x, x)[0]
        for axis, k in self._kinds():
            (V,) = self._at((axis, k), "", partial(list, [self.bonds[k]]), self.r, self._differences(x, axis, k))
            n, at = self.shape[axis], axis - len(self.shape)
            if self.boundary[axis] == "free":
                V = _padded(V, at, k, "zeros")
            first, second = _cut(V, at, k, k + n), _cut(V, at, 0, n)
            density = density + (first + second) / 2
            if self.boundary[axis] == "fixed":  # the other half of bonds to a wall
                nothing = 0 * _cut(V, at, 0, n - k)
                lower, upper = [_cut(V, at, 0, k), nothing], [nothing, _cut(V, at, n, n + k)]
                density = density + (concatenate(lower, at) + concatenate(upper, at)) / 2
        return density

    # how values of bonds stand: one for each site i from −k to n − 1, that of the bond from i to i + k along an axis;
    # of free ends those from 0 to n − k − 1

    def _kinds(self) -> list[tuple[int, int]]:
        """The axes and distances of bonds."""
        return [(axis, k) for axis in range(len(self.shape)) for k in self.bonds]

    def _gathered(self, *arrays: Array) -> Array:
        """The gradient of V by sites (..., d), along directions after q, of those of one site and one bond."""
        parts, order = [self._on_sites(each) for each in arrays], len(arrays)
        given = (self.v, self.w)[: order - 1]
        out: list[Any] = [0.0] * len(self.fields)
        if self.U != 0:
            slopes = partial(_slopes, self.U, self.x, *given)
            out = self._at(None, f"onsite {order}", slopes, sum(given, self.x), *parts)
        for axis, k in self._kinds():
            slopes = partial(_slopes, self.bonds[k], self.r, *given)
            differences = [self._differences(x, axis, k) for x in parts]
            values = self._at((axis, k), str(order), slopes, sum(given, self.r), *differences)
            n, at = self.shape[axis], axis - len(self.shape)
            for i, value in enumerate(values):
                slope = _padded(value, at, k, "zeros") if self.boundary[axis] == "free" else value
                out[i] = out[i] + _cut(slope, at, 0, n) - _cut(slope, at, k, k + n)
        return _joined(out, len(self.shape))

    def _on_sites(self, q: Array) -> list[Array]:
        """The fields (..., *shape) of positions (..., d)."""
        fields = q.reshape(*q.shape[:-1], len(self.fields), *self.shape)
        rest = (slice(None),) * len(self.shape)
        return [fields[(..., i, *rest)] for i in range(len(self.fields))]

    def _differences(self, x: Sequence[Array], axis: int, k: int) -> list[Array]:
        at = axis - len(self.shape)
        found = []
        for field in x:
            around = _padded(field, at, k, self.boundary[axis])
            n = around.shape[at]
            found.append(_cut(around, at, k, n) - _cut(around, at, 0, n - k))
        return found

    def _at(
        self,
        bond: tuple[int, int] | None,
        key: str,
        expressions: Expressions,
        variables: Sequence[sp.Symbol],
        *arrays: Sequence[Array],
    ) -> list[Array]:
        """Values at all sites, or at the bonds along an axis over a distance."""
        parameters: list[Any] = [*self.params.values()]
        if bond is not None:
            key = f"bond {bond[1]} {key}"
            parameters = [self._of_first_ends(c, *bond) if isinstance(c, np.ndarray) else c for c in parameters]
        given = [x for row in arrays for x in row]
        constants = (like(c, given[0]) for c in parameters)
        values = self._values(key, expressions, (*variables, *self.c), *given, *constants)
        return [value + 0 * given[0] if not getattr(value, "ndim", 0) else value for value in values]

    def _of_first_ends(self, values: np.ndarray, axis: int, k: int) -> np.ndarray:
        """The values of sites at the first ends of bonds, or of the first site where that is a wall."""
        at, n, boundary = axis - len(self.shape), self.shape[axis], self.boundary[axis]
        if boundary == "free":
            return _cut(values, at, 0, n - k)
        before = [_cut(values, at, n - k, n)] if boundary == "periodic" else [_cut(values, at, 0, 1)] * k
        return concatenate([*before, values], at)


def _slopes(f: sp.Expr, x: Sequence[sp.Symbol], *along: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """The gradient of f in x, differentiated along some directions."""
    for v in along:
        f = sp.Add(*[s * sp.diff(f, z) for z, s in zip(x, v, strict=True)])
    return [sp.diff(f, s) for s in x]


def _total(values: Array, shape: tuple[int, ...]) -> Array:
    """The sum over sites or bonds."""
    return values.sum(tuple(range(-len(shape), 0)))


def _cut(x: Array, axis: int, first: int, last: int | None) -> Array:
    """x[first:last] along an axis counted from the end."""
    return x[(..., slice(first, last), *[slice(None)] * (-1 - axis))]


def _padded(x: Array, axis: int, k: int, boundary: str) -> Array:
    """x with k places before and behind, along an axis counted from the end; as it is where the ends are free."""
    n = x.shape[axis]
    if boundary == "free":
        return x
    if boundary == "periodic":
        return concatenate([_cut(x, axis, n - k, n), x, _cut(x, axis, 0, k)], axis)
    shape = [*x.shape]
    shape[axis] = k
    zeros = like(np.zeros(shape), x)
    return concatenate([zeros, x, zeros], axis)


def _joined(fields: Sequence[Array], n_axes: int) -> Array:
    """The fields (..., *shape) as positions (..., d)."""
    if len(fields) > 1:
        shape = np.broadcast_shapes(*(tuple(x.shape) for x in fields))
        fields = [library(x).broadcast_to(x, shape) for x in fields]
    flat = [x.reshape(*x.shape[: x.ndim - n_axes], -1) for x in fields]
    return flat[0] if len(flat) == 1 else concatenate(flat, -1)


def checked_shape(shape: Any, argument: str = "shape") -> tuple[int, ...]:
    """The sites along each axis, of an argument `shape`."""
    sizes = tuple(shape) if isinstance(shape, Sequence | np.ndarray) and not isinstance(shape, str) else (shape,)
    sizes = tuple(map(plain, sizes))
    if not 1 <= len(sizes) <= MOST_AXES or not all(
        isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in sizes
    ):
        raise ValueError(
            f"`{argument}` must be one to {MOST_AXES} positive integers, the sites along each axis, such as (1024,) or "
            f"(64, 64); got {reprlib.repr(shape)}."
        )
    return sizes


def _checked_boundary(boundary: Any, n_axes: int) -> tuple[str, ...]:
    names = (boundary,) * n_axes if isinstance(boundary, str) else boundary
    if not isinstance(names, tuple | list) or len(names) != n_axes or not all(name in BOUNDARIES for name in names):
        raise ValueError(
            f"`boundary` must be one of {', '.join(map(repr, BOUNDARIES))}, or one for each of the {n_axes} axes; got "
            f"{boundary!r}."
        )
    return tuple(names)


def _checked_fields(fields: Any) -> tuple[str, ...]:
    names = (fields,) if isinstance(fields, str) else fields
    if (
        not isinstance(names, tuple | list)
        or not names
        or not all(isinstance(name, str) and name.isidentifier() and name != "t" for name in names)
        or len(set(names)) < len(names)
    ):
        raise ValueError(f"`fields` must be different names, such as ('u', 'v'); got {reprlib.repr(fields)}.")
    return tuple(names)


def _checked_distance(k: Any) -> int:
    k = plain(k)
    if not isinstance(k, int) or isinstance(k, bool) or k < 1:
        raise ValueError(f"`bond` by distances must have the integers 1, 2, … as keys; got {k!r}.")
    return k
