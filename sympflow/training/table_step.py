"""A splitting step and its derivatives with respect to the numbers of its table.

The step needs the forces of a system and their Jacobians: F = −∇V, G = ∇²V v and C = −∇(½ v·∇²V v), with v = M⁻¹∇V; or
after F the −∇q^m of each monomial. Arrays are feature-major: q and F, G, C are (d, P), Jacobians (d, d, P).

A driven system is the autonomous one of positions (q, t, s) and momenta (p, 1, E), with V(q, t + s), M⁻¹ extended by 1
for the velocity of t in drifts, by 0 in v and for s, which stays 0, and the forces (−∂V/∂q, 0, −∂V/∂t). So the
derivatives by the drifts hold those by the times of kicks, and E is less the work of the drive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np

from sympflow.hamiltonian.friction import Friction
from sympflow.hamiltonian.hamiltonian import derivative
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE, FORCE_GRADIENT

if TYPE_CHECKING:
    from sympflow.kernels.table_loops import TableLoops

ALONG = 1e-4  # length of the difference, relative to q, that gives the third derivative of V along M⁻¹∇V
DENSE = 16  # degrees of freedom up to which third derivatives of a symbolic V are generated
PRODUCT = 1e-3  # length of the difference, relative to q, that gives ∇²V·v where it is not known

Check = Callable[[], None]
Product = Callable[[np.ndarray, np.ndarray], np.ndarray]


class TableStep:
    """The map of kicks p += w F(q) + g ∇²V v − c ∇(½ v·∇²V v), v = M⁻¹∇V(q), and drifts q += a M⁻¹p of a system.

    Arrays are feature-major: states y (2d, P). A coefficient is a row of P numbers, one a state, so that states may
    be at different times: c (n, P), or (n, 1). The states of a driven system begin at times t0 (P,); those at the end
    have a row more, E, unless there is friction.

    Parameters
    ----------
    system : HamiltonianSystem
        Separable, with T = ½ pᵀM⁻¹p.
    sequence : sequence of "kick" or "drift"
    level : int
        What the kicks have beside the force: nothing, g, g and c, or a polynomial.
    monomials
        Of the polynomial.
    compiled : bool
        Compile the step and its derivatives, where the system has symbols, or the forces of bodies in pairs.

    Attributes
    ----------
    balanced : bool
        True if E is a row of the states at the end.
    order : ndarray of int
        Where the coefficients of one map after the other stand.
    loops : TableLoops or None
        What is compiled.
    """

    def __init__(
        self,
        system: HamiltonianSystem,
        sequence: Sequence[str],
        level: int,
        monomials: Monomials = (),
        compiled: bool = False,
    ) -> None:
        if not system.quadratic_kinetic:
            raise ValueError(
                f"`system` {system.name!r} must have a kinetic energy ½ pᵀM⁻¹p for its table to be fitted by "
                "Gauss–Newton steps: use optimizer='bfgs'."
            )
        self.ndof, self.sequence, self._driven = system.ndof, tuple(sequence), not system.autonomous
        self.balanced = self._driven and not system.friction
        self._inverse_mass = _inverse_mass(system, 1.0)
        self._times_inverse_mass, self._friction = _velocities(system, 1.0), system.friction
        if self._driven and system.friction:
            self._friction = Friction(_extended(system.friction.matrix(system.ndof), 0.0))
        self._forces_of = system, level, monomials, compiled
        n, terms = len(sequence), len(monomials) or level
        kicks = [i for i in range(n) if sequence[i] == "kick"]
        self.n_coefficients = n + terms * len(kicks)
        # where w, g and c, or w and the polynomial's, stand among the coefficients
        self._places = {
            kick: [kick, *(n + term * len(kicks) + j for term in range(terms))] for j, kick in enumerate(kicks)
        }
        self.order = np.concatenate([self._places.get(i, [i]) for i in range(n)])
        self.loops: TableLoops | None = None
        if compiled and system.symbols is not None:
            from sympflow.kernels.table_loops import table_loops

            each = [kind == "kick" for kind in self.sequence]
            self.loops = table_loops(system.symbols, each, int(level), monomials, system.friction)

    @cached_property
    def _forces(self) -> Forces:
        return forces_of(*self._forces_of)

    def _opened(self, y: np.ndarray, t0: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """The positions and momenta on which maps are applied, (q, t, s) and (p, 1, E) in time: (D, P) each."""
        q, p = y[: self.ndof], y[self.ndof :]
        if not self._driven:
            return q, p
        assert t0 is not None
        zero = np.zeros((1, p.shape[1]))
        return np.concatenate([q, t0[None], zero]), np.concatenate([p, zero + 1, zero])

    def _closed(self, q: np.ndarray, p: np.ndarray) -> np.ndarray:
        """The states (..., 2d, P) of these, and E where the step is `balanced`."""
        d = self.ndof
        E = [p[..., d + 1 :, :]] if self.balanced else []
        return np.concatenate([q[..., :d, :], p[..., :d, :], *E], axis=-2)

    def __call__(
        self, c: np.ndarray, y: np.ndarray, check: Check = lambda: None, t0: np.ndarray | None = None
    ) -> np.ndarray:
        """The step: coefficients c in the order of the sequence, then of each further term those of the kicks.

        `check` is called at each kick, or once where the step is compiled, and may raise to end it.
        """
        if self.loops is not None and c.shape[1] == 1:
            check()
            return self.loops.steps(c[self.order].T, y, t0, 2 * self.ndof + self.balanced)[0]
        q, p = self._opened(y, t0)
        for i, kind in enumerate(self.sequence):
            if kind == "drift":
                change, p = self._drifted(p, c[i], self._inverse_mass.__matmul__)
                q = q + change
            else:
                check()
                for place, F in zip(self._places[i], self._forces.values(q), strict=True):
                    p = p + c[place] * F
        return self._closed(q, p)

    def by_each(self, c: np.ndarray, y: np.ndarray, t0: np.ndarray | None = None) -> np.ndarray:
        """The steps of the states (2d, P) by each row of coefficients c (J, n): (J, 2d or 2d + 1, P)."""
        if self.loops is not None:
            return self.loops.steps(c[:, self.order], y, t0, 2 * self.ndof + self.balanced)
        return np.stack([self(row[:, None], y, t0=t0) for row in c])

    def _drifted(self, p: np.ndarray, s: np.ndarray, velocity: Callable[[np.ndarray], np.ndarray]) -> Any:
        """The change of q and the p after drifts of times s (P,) or (1,), of momenta (..., d, P)."""
        if not self._friction:
            return s * velocity(p), p
        mean, end = self._friction.drift(p.swapaxes(-1, -2), s[:, None])
        return velocity(mean.swapaxes(-1, -2)), end.swapaxes(-1, -2)

    def _slowing(self, p: np.ndarray) -> np.ndarray:
        """−Γp of momenta (d, P), their rate in a drift."""
        return np.zeros_like(p) if not self._friction else self._friction.force(p.T).T

    def with_jacobian(
        self, c: np.ndarray, y: np.ndarray, check: Check = lambda: None, t0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The step, and its derivatives by each coefficient: (n, 2d, P); `check` as in the step."""
        return (self._backward if 2 * self.ndof <= self.n_coefficients else self._forward)(c, y, check, t0)

    def _forward(
        self, c: np.ndarray, y: np.ndarray, check: Check, t0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """A tangent for each coefficient is carried along: the cheaper way for many degrees of freedom."""
        q, p = self._opened(y, t0)
        by_q, by_p = np.zeros((2, self.n_coefficients, *q.shape))
        moved: list[int] = []  # the coefficients that were met
        for i, kind in enumerate(self.sequence):
            check()
            if kind == "drift":
                change, by_p[moved] = self._drifted(by_p[moved], c[i], self._velocity)
                by_q[moved] += change
                change, p = self._drifted(p, c[i], self._velocity)
                q = q + change
                by_q[i] += self._velocity(p)
                by_p[i] += self._slowing(p)
                moved.append(i)
            else:
                forces, changes = self._forces.along(q, by_q[moved])
                for place, F, change in zip(self._places[i], forces, changes, strict=True):
                    by_p[moved] += c[place] * change
                    by_p[place] += F
                    p = p + c[place] * F
                moved += self._places[i]
        return self._closed(q, p), self._closed(by_q, by_p)

    def _velocity(self, p: np.ndarray) -> np.ndarray:
        """M⁻¹p: (..., d, P)."""
        return self._times_inverse_mass(p.swapaxes(-1, -2)).swapaxes(-1, -2)

    def _backward(
        self, c: np.ndarray, y: np.ndarray, check: Check, t0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states are stored on the way, and the derivative of the map after each is built on the way back.

        With few degrees of freedom that is cheaper than a tangent for each coefficient.
        """
        d = self.ndof
        q, p = self._opened(y, t0)
        width = len(q)
        passed: list[tuple[np.ndarray, ...]] = []
        for i, kind in enumerate(self.sequence):
            if kind == "drift":
                change, p = self._drifted(p, c[i], self._inverse_mass.__matmul__)
                q = q + change
                passed.append((self._inverse_mass @ p, self._slowing(p)))
            else:
                check()
                forces, jacobians = self._forces.all(q)
                weights = [c[place] for place in self._places[i]]
                passed.append((sum(w * D for w, D in zip(weights, jacobians, strict=True)), *forces))
                p = p + sum(w * F for w, F in zip(weights, forces, strict=True))
        after_q, after_p = np.zeros((2, 2 * d + self.balanced, width, y.shape[1]))  # of the rows that `_closed` gives
        J = np.empty((self.n_coefficients, len(after_q), y.shape[1]))
        after_q[np.arange(d), np.arange(d)] = 1.0
        after_p[np.arange(d, 2 * d), np.arange(d)] = 1.0
        after_p[2 * d :, d + 1 :] = 1.0  # E
        for i in reversed(range(len(self.sequence))):
            if self.sequence[i] == "drift":
                velocity, slowing = passed[i]
                J[i] = _apply(after_q, velocity)
                by_velocity = np.einsum("rkP,kj->rjP", after_q, self._inverse_mass)
                if not self._friction:
                    after_p += c[i] * by_velocity
                    continue
                J[i] += _apply(after_p, slowing)
                # the maps of a drift are symmetric, as Γ is
                after_p = self._drifted(after_p, c[i], _same)[1] + self._drifted(by_velocity, c[i], _same)[0]
            else:
                slope, *forces = passed[i]
                for place, F in zip(self._places[i], forces, strict=True):
                    J[place] = _apply(after_p, F)
                for k in range(width):
                    after_q += after_p[:, k, None] * slope[k]
        return self._closed(q, p), J


def _extended(matrix: np.ndarray, of_time: float) -> np.ndarray:
    """A matrix (d, d) with rows and columns of t and s, 0 but for one entry."""
    d = len(matrix)
    extended = np.zeros((d + 2, d + 2))
    extended[:d, :d], extended[d, d] = matrix, of_time
    return extended


def _inverse_mass(system: HamiltonianSystem, of_time: float) -> np.ndarray:
    """M⁻¹, of a driven system extended by those of t and s."""
    M = system.kinetic_hessian(np.zeros(system.ndof))
    return M if system.autonomous else _extended(M, of_time)


def _velocities(system: HamiltonianSystem, of_time: float) -> Callable[[np.ndarray], np.ndarray]:
    """M⁻¹p of rows (..., D), extended likewise."""
    return system.velocity if system.autonomous else partial(_extended_velocity, system, of_time)


def _extended_velocity(system: HamiltonianSystem, of_time: float, p: np.ndarray) -> np.ndarray:
    d = system.ndof
    return np.concatenate([system.velocity(p[..., :d]), of_time * p[..., d : d + 1], 0 * p[..., d + 1 :]], axis=-1)


def _same(v: np.ndarray) -> np.ndarray:
    return v


def _apply(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A (r, k, P) times v (k, P): (r, P)."""
    result = A[:, 0] * v[0]
    for k in range(1, len(v)):
        result += A[:, k] * v[k]
    return result


# forces ---------------------------------------------------------------------------------------------------------


class Forces(Protocol):
    """The terms of a kick and their Jacobians, as many as the kicks have: F, G, C."""

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        """F, G and C."""

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """These, and their Jacobians."""

    def along(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """These, and their derivatives along directions v (k, d, P), of the same shape."""


def _pair_forces(system: HamiltonianSystem, level: int) -> Forces:
    from sympflow.hamiltonian.bodies import PairsHamiltonian
    from sympflow.kernels.pairs import PairForces

    assert isinstance(system.local, PairsHamiltonian)
    return PairForces(system.local, level)


LOCAL: Mapping[str, Callable[[HamiltonianSystem, int], Forces]] = {"pairs": _pair_forces}
"""Compiled forces of systems that are given by one piece, by the `loops` of these."""


def forces_of(system: HamiltonianSystem, level: int, monomials: Monomials = (), compiled: bool = False) -> Forces:
    """The forces of a separable system with T = ½ pᵀM⁻¹p: from its symbols, its Numba functions, or its own arrays."""
    if compiled and system.local is not None and system.local.loops in LOCAL:
        return LOCAL[system.local.loops](system, level)
    if system.symbols is not None and (system.ndof <= DENSE or level == CURVATURE or monomials):
        return SymbolicForces(system.symbols, level, monomials)
    return ArrayForces(system, level)


class SymbolicForces:
    """All derivatives in closed form, generated from the symbols when first asked for.

    Positions of a driven system are (d + 2, P), with t and s.
    """

    def __init__(self, symbols: Any, level: int, monomials: Monomials) -> None:
        import sympy as sp

        slope = sp.Matrix(symbols.slope)
        self._samples = dict(symbols.samples)
        terms = [-slope]
        if level in (FORCE_GRADIENT, CURVATURE):
            v = symbols.inverse_mass * slope
            terms.append(sp.Matrix([_derivative(f, symbols.q, v) for f in slope]))
        if level == CURVATURE:
            terms.append(sp.Matrix([-sp.diff(symbols.W, s) for s in symbols.q]))
        products = [sp.Mul(*map(sp.Pow, symbols.q, m)) for m in monomials]
        terms += [sp.Matrix([-sp.diff(product, s) for s in symbols.q]) for product in products]
        self._q = symbols.q
        if symbols.time is not None:
            t, s = symbols.time, sp.Dummy("s")
            by_time = [-sp.diff(symbols.V, t)]
            if level in (FORCE_GRADIENT, CURVATURE):
                by_time.append(_derivative(-by_time[0], symbols.q, v))
            if level == CURVATURE:
                by_time.append(-sp.diff(symbols.W, t))
            by_time += [sp.S.Zero] * len(products)
            terms = [term.col_join(sp.Matrix([0, f])) for term, f in zip(terms, by_time, strict=True)]
            self._q = (*symbols.q, t, s)
        self._d, self._n, self._terms = len(self._q), len(terms), terms

    def __getstate__(self) -> dict[str, Any]:
        """The expressions: functions are generated where they are used."""
        return {name: value for name, value in vars(self).items() if name not in ("_values", "_all", "_along")}

    @cached_property
    def _values(self) -> Callable[[np.ndarray], np.ndarray]:
        return _generated(self._q, [f for term in self._terms for f in term], self._samples)

    @cached_property
    def _all(self) -> Callable[[np.ndarray], np.ndarray]:
        values = [f for term in self._terms for f in term]
        slopes = [f for term in self._terms for f in term.jacobian(self._q)]
        return _generated(self._q, [*values, *slopes], self._samples)

    @cached_property
    def _along(self) -> Callable[[np.ndarray], np.ndarray]:
        import sympy as sp

        directions = sp.symbols(f"v1:{self._d + 1}", real=True)
        changes = [_derivative(f, self._q, directions) for term in self._terms for f in term]
        return _generated((*self._q, *directions), changes, self._samples)

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        return self._values(q).reshape(self._n, self._d, q.shape[1])  # type: ignore[return-value]

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        d, n = self._d, self._n
        rows = self._all(q)
        return rows[: n * d].reshape(n, d, -1), rows[n * d :].reshape(n, d, d, -1)  # type: ignore[return-value]

    def along(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        k, d, P = v.shape
        both = np.concatenate([np.broadcast_to(q, v.shape), v], axis=1)  # (k, 2d, P)
        changes = self._along(np.ascontiguousarray(both.swapaxes(0, 1)).reshape(2 * d, k * P))
        return self.values(q), np.moveaxis(changes.reshape(self._n, d, k, P), 2, 1)  # type: ignore[return-value]


def _derivative(f: Any, variables: Sequence[Any], direction: Sequence[Any]) -> Any:
    """The derivative of an expression along a direction: of a sparse one in few operations."""
    import sympy as sp

    there = f.free_symbols
    return sp.Add(*(sp.diff(f, s) * v for s, v in zip(variables, direction, strict=True) if s in there))


class ArrayForces:
    """From the system's gradients and products ∇²V·v of arrays; where these are not known, from differences of ∇V.

    The Jacobian of G(q) = ∇²V(q) v(q), v = M⁻¹∇V, is ∇²V M⁻¹ ∇²V and the derivative of ∇²V along v, a central
    difference of two Hessians: third derivatives of V are never asked for, so there is no C.

    Positions of a driven system are (d + 2, P), with t and s.
    """

    def __init__(self, system: HamiltonianSystem, level: int) -> None:
        assert level < CURVATURE
        self.system, self.force_gradient = system, level >= FORCE_GRADIENT
        self._velocity = _velocities(system, 0.0)
        self._gradient, self._product = _row_functions(system)

    def __reduce__(self) -> tuple[Any, ...]:
        return ArrayForces, (self.system, FORCE_GRADIENT if self.force_gradient else 0)

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        rows = np.ascontiguousarray(q.T)
        slope = self._gradient(rows)
        if not self.force_gradient:
            return (-slope.T,)
        return -slope.T, self._product(rows, self._velocity(slope)).T

    def all(self, q: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        rows = np.ascontiguousarray(q.T)
        slope, hessian = self._gradient(rows), self._hessian(rows)
        F, DF = -slope.T, np.moveaxis(-hessian, 0, -1)
        if not self.force_gradient:
            return (F,), (DF,)
        v = self._velocity(slope)
        ends, length = self._ends(rows, v)
        inverse_mass = _inverse_mass(self.system, 0.0)
        along = (self._hessian(ends[0]) - self._hessian(ends[1])) / (2 * length[..., None])
        DG = along + hessian @ inverse_mass @ hessian
        return (F, (hessian @ v[..., None])[..., 0].T), (DF, np.moveaxis(DG, 0, -1))

    def along(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        rows, directions = np.ascontiguousarray(q.T), np.ascontiguousarray(v.swapaxes(-1, -2))  # (k, P, d)
        slope = self._gradient(rows)
        change = self._product(rows, directions)
        F, DF = -slope.T, -change.swapaxes(-1, -2)
        if not self.force_gradient:
            return (F,), (DF,)
        acceleration = self._velocity(slope)
        ends, length = self._ends(rows, acceleration)
        DG = (self._product(ends[0], directions) - self._product(ends[1], directions)) / (2 * length)
        DG = DG + self._product(rows, self._velocity(change))
        return (F, self._product(rows, acceleration).T), (DF, DG.swapaxes(-1, -2))

    def _hessian(self, rows: np.ndarray) -> np.ndarray:
        """∇²V: (P, d) to (P, d, d)."""
        given = self.system.symbols is not None or self.system.numba_functions is not None or not self.system.autonomous
        if not given and self.system.has_hessian_vector:
            return self.system.potential_hessian(rows)
        basis = np.broadcast_to(np.eye(rows.shape[1])[:, None], (rows.shape[1], *rows.shape))
        return np.moveaxis(self._product(rows, basis), 0, -1)

    def _ends(self, rows: np.ndarray, v: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """The states on both sides of each row along v (P, D), and their distance from it over that of v (P, 1)."""
        largest = np.abs(v).max(-1, keepdims=True)
        size = np.abs(rows[:, : self.system.ndof]).max(-1, keepdims=True)
        length = ALONG * np.maximum(size, 1e-300) / np.where(largest > 0, largest, 1.0)
        return (rows + length * v, rows - length * v), length


def _row_functions(system: HamiltonianSystem) -> tuple[Callable[[np.ndarray], np.ndarray], Product]:
    """∇V of rows (..., P, d), and ∇²V·v of rows and v: of Numba functions in one compiled loop each.

    Where a gradient was given without products, these are differences of it along v.
    """

    def slopes(rows: np.ndarray) -> np.ndarray:
        return -system.force(rows)

    if not system.autonomous:
        return _functions_in_time(system)
    if system.symbols is not None:
        return slopes, _symbolic_product(system.symbols)
    if system.numba_functions is None:
        return slopes, system.hessian_vector if system.has_hessian_vector else _differences_of(slopes)
    _, gradient, hessian_vector = system.numba_functions
    slope_loop, product_loop = _compiled(gradient, hessian_vector)

    def compiled_slopes(q: np.ndarray) -> np.ndarray:
        rows = np.array(q).reshape(-1, q.shape[-1])
        out = np.empty_like(rows)
        slope_loop(rows, out)
        return out.reshape(q.shape)

    if product_loop is None:
        return compiled_slopes, _differences_of(compiled_slopes)

    def compiled_products(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(q.shape, v.shape)
        q, v = (np.array(np.broadcast_to(a, shape)).reshape(-1, shape[-1]) for a in (q, v))
        out = np.empty_like(v)
        product_loop(q, v, out)
        return out.reshape(shape)

    return compiled_slopes, compiled_products


def _functions_in_time(system: HamiltonianSystem) -> tuple[Callable[[np.ndarray], np.ndarray], Product]:
    """The same of a driven system, rows being (..., P, d + 2), with t and s; by the time from differences."""
    d = system.ndof
    short = PRODUCT * (1.0 if system.period is None else system.period / (2 * np.pi))

    def rate(q: np.ndarray, t: np.ndarray) -> np.ndarray:
        return system.time_derivative(np.concatenate([q, 0 * q], axis=-1), t)

    def slopes(rows: np.ndarray) -> np.ndarray:
        q, t = rows[..., :d], rows[..., d]
        return np.concatenate([-system.force(q, t), 0 * t[..., None], rate(q, t)[..., None]], axis=-1)

    def product(rows: np.ndarray, v: np.ndarray) -> np.ndarray:
        rows, v = np.broadcast_arrays(rows, v)
        q, t = rows[..., :d], rows[..., d]

        def slope(x: np.ndarray) -> np.ndarray:
            return -system.force(x, t)

        if system.has_hessian_vector:
            change = system.hessian_vector(q, v[..., :d], t)
        else:
            change = _differences_of(slope)(q, v[..., :d])
        ahead, behind = (system.force(q, t + s) - system.force(q, t - s) for s in (short, 2 * short))
        by_time = (behind - 8 * ahead) / (12 * short)
        ahead, behind = (rate(q, t + s) - rate(q, t - s) for s in (short, 2 * short))
        twice = (8 * ahead - behind) / (12 * short)
        of_rate = (by_time * v[..., :d]).sum(-1) + twice * v[..., d]
        return np.concatenate([change + by_time * v[..., d : d + 1], 0 * t[..., None], of_rate[..., None]], axis=-1)

    return slopes, product


_PRODUCTS: WeakKeyDictionary[Any, Product] = WeakKeyDictionary()


def _symbolic_product(symbols: Any) -> Product:
    """∇²V·v, generated once from the derivatives that do not vanish."""
    import sympy as sp

    if symbols in _PRODUCTS:
        return _PRODUCTS[symbols]
    directions = sp.symbols(f"v1:{symbols.ndof + 1}", real=True)
    changes = [_derivative(f, symbols.q, directions) for f in symbols.slope]
    d, function = symbols.ndof, _generated((*symbols.q, *directions), changes)

    def product(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        both = np.concatenate(np.broadcast_arrays(q, v), axis=-1)
        rows = np.ascontiguousarray(both.reshape(-1, both.shape[-1]).T)
        return function(rows).T.reshape(*both.shape[:-1], d)

    _PRODUCTS[symbols] = product
    return product


def _differences_of(slopes: Callable[[np.ndarray], np.ndarray]) -> Product:
    def product(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        q, v = np.broadcast_arrays(q, v)
        largest = np.abs(v).max(-1, keepdims=True)
        length = PRODUCT * np.maximum(np.abs(q).max(-1, keepdims=True), 1e-300)
        return largest * derivative(slopes, q, v / np.where(largest > 0, largest, 1.0), length)

    return product


def _compiled(gradient: Any, hessian_vector: Any) -> tuple[Callable[..., None], Callable[..., None] | None]:
    """The loops of both over the states (n, d)."""
    from numba import njit

    @njit(error_model="numpy")
    def slopes(Q: Any, out: Any) -> None:
        for s in range(Q.shape[0]):
            gradient(Q[s], out[s])

    if hessian_vector is None:
        return slopes, None

    @njit(error_model="numpy")
    def products(Q: Any, V: Any, out: Any) -> None:
        for s in range(Q.shape[0]):
            hessian_vector(Q[s], V[s], out[s])

    return slopes, products


def _generated(
    variables: Sequence[Any], expressions: list[Any], samples: Mapping[str, Any] = MappingProxyType({})
) -> Callable[[np.ndarray], np.ndarray]:
    """The expressions as one function of (d, P), with common subexpressions shared: (n, P).

    They may hold values of samples at a time that is one of the variables.
    """
    import sympy as sp

    from sympflow.hamiltonian.symbolic import without_deltas

    samples_at: dict[Any, Any] = {}
    expressions = [without_deltas(f) for f in expressions]
    if samples:
        from sympflow.hamiltonian.driving import with_letters

        expressions, samples_at = with_letters(expressions)
    sampled = [(samples[a.name_of_samples], a.order, sp.lambdify(variables, a.at, modules="numpy")) for a in samples_at]
    function = sp.lambdify((*variables, *samples_at.values()), expressions, modules="numpy", cse=True)

    def evaluate(q: np.ndarray) -> np.ndarray:
        values = function(*q, *(each(at(*q), order) for each, order, at in sampled))
        out = np.empty((len(values), q.shape[1]))
        for i, value in enumerate(values):
            out[i] = value
        return out

    return evaluate
