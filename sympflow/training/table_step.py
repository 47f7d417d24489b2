"""A splitting step and its derivatives with respect to the numbers of its table.

The step needs the forces of a system and their Jacobians: F = −∇V, G = ∇²V v and C = −∇(½ v·∇²V v), with v = M⁻¹∇V; or
after F the −∇q^m of each monomial. Arrays are feature-major: q and F, G, C are (d, P), Jacobians (d, d, P).

A driven system is the autonomous one of positions (q, t, s) and momenta (p, 1, E), with V(q, t + s), M⁻¹ extended by 1
for the velocity of t in drifts, by 0 in v and for s, which stays 0, and the forces (−∂V/∂q, 0, −∂V/∂t). So the
derivatives by the drifts hold those by the times of kicks, and E is less the work of the drive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.hamiltonian.friction import Friction
from sympflow.hamiltonian.hamiltonian import derivative
from sympflow.hamiltonian.monomials import Monomials, gradient
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.schemes import CURVATURE, FORCE_GRADIENT
from sympflow.training.least_squares import Check

if TYPE_CHECKING:
    from sympflow.kernels.pairs import PairForces
    from sympflow.kernels.table_loops import LabelErrors, TableLoops

ALONG = 1e-4  # length of the difference, relative to q, that gives the third derivative of V along M⁻¹∇V
PRODUCT = 1e-3  # length of the difference, relative to q, that gives ∇²V·v where it is not known

Product = Callable[[np.ndarray, np.ndarray], np.ndarray]


class TableStep:
    """The map of kicks p += w F(q) + g ∇²V v − c ∇(½ v·∇²V v), v = M⁻¹∇V(q), and drifts q += a M⁻¹p of a system.

    Arrays are feature-major: states y (2d, P). A coefficient is a row of P numbers, one a state, so that states may be
    at different times: c (n, P), or (n, 1), in the places `order` one map after the other. The states of a driven
    system begin at times t0 (P,); those at the end have a row more, E, if `balanced`, without friction. `loops` is what
    is compiled.
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
        self._times_inverse_mass, self._friction = partial(_velocity, system, 1.0), system.friction
        if self._driven and system.friction:
            self._friction = Friction(np.pad(system.friction.matrix(system.ndof), (0, 2)))  # none of t and s
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
        if compiled and system.form is not None:
            from sympflow.kernels.table_loops import table_loops

            each = [kind == "kick" for kind in self.sequence]
            self.loops = table_loops(system.form, each, int(level), monomials, system.friction)

    @cached_property
    def _forces(self) -> ArrayForces | PairForces:
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
        """The step: coefficients in the order of the sequence, then of each further term; `check` may raise."""
        if self.loops is not None and c.shape[1] == 1:
            check()
            return self.loops.steps(c[self.order].T, y, t0, 2 * self.ndof + self.balanced)[0]
        q, p = self._opened(y, t0)
        for i, kind in enumerate(self.sequence):
            if kind == "drift":
                change, p = self._drifted(p, c[i])
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

    def _drifted(self, p: np.ndarray, s: np.ndarray) -> Any:
        """The change of q and the p after drifts of times s (P,) or (1,), of momenta (..., d, P)."""
        if not self._friction:
            return s * self._velocity(p), p
        mean, end = self._friction.drift(p.swapaxes(-1, -2), s[:, None])
        return self._velocity(mean.swapaxes(-1, -2)), end.swapaxes(-1, -2)

    def errors(self, *given: Any) -> LabelErrors | ArrayErrors:
        """Weighted errors of labels after a step: see `LabelErrors`."""
        return ArrayErrors(self, *given) if self.loops is None else self.loops.errors(*given)

    def with_jacobian(
        self, c: np.ndarray, y: np.ndarray, check: Check = lambda: None, t0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The step, and its derivatives by each coefficient, tangents carried along: (n, 2d, P); `check` as above."""
        q, p = self._opened(y, t0)
        by_q, by_p = np.zeros((2, self.n_coefficients, *q.shape))
        moved: list[int] = []  # the coefficients that were met
        for i, kind in enumerate(self.sequence):
            check()
            if kind == "drift":
                change, by_p[moved] = self._drifted(by_p[moved], c[i])
                by_q[moved] += change
                change, p = self._drifted(p, c[i])
                q = q + change
                by_q[i] += self._velocity(p)
                if self._friction:
                    by_p[i] += self._friction.force(p.T).T
                moved.append(i)
            else:
                forces, changes = self._changes(q, by_q[moved])
                for place, F, change in zip(self._places[i], forces, changes, strict=True):
                    by_p[moved] += c[place] * change
                    by_p[place] += F
                    p = p + c[place] * F
                moved += self._places[i]
        return self._closed(q, p), self._closed(by_q, by_p)

    def _changes(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """The terms of a kick and their derivatives along directions v (k, D, P), by Jacobians if k > D."""
        if len(v) <= len(q):
            return self._forces.along(q, v)
        forces, slopes = self._forces.along(q, np.broadcast_to(np.eye(len(q))[..., None], (len(q), *q.shape)))
        return forces, [sum(v[:, j, None] * slope[j] for j in range(len(q))) for slope in slopes]

    def _velocity(self, p: np.ndarray) -> np.ndarray:
        """M⁻¹p: (..., d, P)."""
        return self._times_inverse_mass(p.swapaxes(-1, -2)).swapaxes(-1, -2)


class ArrayErrors:
    """Weighted errors of labels after a step of arrays: see `LabelErrors`."""

    def __init__(self, step: TableStep, x: np.ndarray, t0: Any, *given: np.ndarray) -> None:
        self.step, self._count = step, x.shape[1]
        self._y, self._scale, self._slope, self.matrices = given
        self._times = len(self.matrices)
        self._x = np.tile(x, (1, self._times))
        self._t0 = None if t0 is None else np.tile(t0, self._times)

    @np.errstate(all="ignore")
    def __call__(self, c: np.ndarray, check: Check = lambda: None, linearized: bool = False) -> Any:
        """The errors (m,) for numbers c (J, n), and if requested their derivatives by these, (n, m)."""
        order = self.step.order
        c = np.repeat(c[:, np.argsort(order)].T, self._count, axis=1)
        if not linearized:
            return self._rows(self.step(c, self._x, check, self._t0) - self._y), np.empty((0, 0))
        y, J = self.step.with_jacobian(c, self._x, check, self._t0)
        return self._rows(y - self._y), self._rows(J[order])

    def _rows(self, change: np.ndarray) -> np.ndarray:
        """The errors of changes (..., R, J N), times first: (..., m)."""
        parts = [change[..., : len(self._scale), :] * self._scale]
        if len(self._slope):
            parts.append((change * self._slope).sum(-2, keepdims=True))
        errors = np.concatenate(parts, axis=-2)
        split = errors.reshape(*errors.shape[:-1], self._times, self._count)
        return split.swapaxes(-2, -3).reshape(*errors.shape[:-2], -1)


def _velocity(system: HamiltonianSystem, of_time: float, p: np.ndarray) -> np.ndarray:
    """M⁻¹p of rows (..., D), that of t times a number, and 0 for s."""
    d = system.ndof
    return np.concatenate([system.velocity(p[..., :d]), of_time * p[..., d : d + 1], 0 * p[..., d + 1 :]], axis=-1)


# forces ---------------------------------------------------------------------------------------------------------


def forces_of(
    system: HamiltonianSystem, level: int, monomials: Monomials = (), compiled: bool = False
) -> ArrayForces | PairForces:
    """The forces of a separable system with T = ½ pᵀM⁻¹p: compiled ones of pairs, else those of its functions."""
    if compiled and system.local is not None and system.local.loops == "pairs":
        from sympflow.kernels.pairs import PairForces

        return PairForces(system.local, level)  # type: ignore[arg-type]
    return ArrayForces(system, level, monomials)


class ArrayForces:
    """The terms of a kick by the functions of a system; derivatives of ∇²V along v = M⁻¹∇V, and of C, are differences.

    They are as many as the kicks have: F, then G and C, or those of monomials.
    """

    def __init__(self, system: HamiltonianSystem, level: int, monomials: Monomials = ()) -> None:
        self._given = system, level, monomials
        self._ndof, self._terms = system.ndof, [partial(_of_monomial, m) for m in monomials]
        if level == CURVATURE:
            self._terms = [partial(_curvature, system)]
        self._has_gradient = level in (FORCE_GRADIENT, CURVATURE)
        self._velocity = partial(_velocity, system, 0.0)
        self._gradient, self._product = _row_functions(system)

    def __reduce__(self) -> tuple[Any, ...]:
        return ArrayForces, self._given

    def values(self, q: np.ndarray) -> Sequence[np.ndarray]:
        """The terms: (d, P) each."""
        rows = np.ascontiguousarray(q.T)
        slope = self._gradient(rows)
        G = [self._product(rows, self._velocity(slope)).T] if self._has_gradient else []
        return [-slope.T, *G, *(-term(rows).T for term in self._terms)]

    def along(self, q: np.ndarray, v: np.ndarray) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
        """The terms, and their derivatives along directions v (k, d, P), of the same shape."""
        rows, directions = np.ascontiguousarray(q.T), np.ascontiguousarray(v.swapaxes(-1, -2))  # (k, P, d)
        slope, changes = self._gradient(rows), [-self._product(rows, directions)]
        if self._has_gradient:
            acceleration = self._velocity(slope)
            ends, length = self._ends(rows, acceleration)
            DG = (self._product(ends[0], directions) - self._product(ends[1], directions)) / (2 * length)
            changes.append(DG - self._product(rows, self._velocity(changes[0])))
        changes += [-_differences_of(term, self._ndof)(rows, directions) for term in self._terms]
        return self.values(q), [change.swapaxes(-1, -2) for change in changes]

    def _ends(self, rows: np.ndarray, v: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """The states on both sides of each row along v (P, D), and their distance from it over that of v (P, 1)."""
        largest = np.abs(v).max(-1, keepdims=True)
        size = np.abs(rows[:, : self._ndof]).max(-1, keepdims=True)
        length = ALONG * np.maximum(size, 1e-300) / np.where(largest > 0, largest, 1.0)
        return (rows + length * v, rows - length * v), length


def _of_monomial(exponents: tuple[int, ...], rows: np.ndarray) -> np.ndarray:
    """∇q^m of rows (..., d), with 0 for t and s."""
    slope = gradient((exponents,), np.ones(1), rows[..., : len(exponents)])
    return np.concatenate([slope, 0 * rows[..., len(exponents) :]], axis=-1)


def _curvature(system: HamiltonianSystem, rows: np.ndarray) -> np.ndarray:
    """The gradient of W = ½ v·∇²V v of rows (..., d), of a driven system with 0 for t and ∂W/∂t for s."""
    d = system.ndof
    q, t = rows[..., :d], rows[..., d] if rows.shape[-1] > d else None
    slope, of_time = system.curvature_gradient(q, t), []
    if t is not None:
        of_time = [0 * t[..., None], _by_time(lambda t: system.curvature(q, t), t, _short(system))[..., None]]
    return np.concatenate([slope, *of_time], axis=-1)


def _row_functions(system: HamiltonianSystem) -> tuple[Callable[[np.ndarray], np.ndarray], Product]:
    """∇V of rows (..., P, d), and ∇²V·v of rows and v, by differences of ∇V where it is not given."""

    def slopes(rows: np.ndarray) -> np.ndarray:
        return -system.force(rows)

    if not system.autonomous:
        return _functions_in_time(system)
    if system.numba_functions is None:
        return slopes, system.hessian_vector if system.has_hessian_vector else _differences_of(slopes, system.ndof)
    _, slope, hessian_vector = system.numba_functions
    compiled = _compiled(slope, 1)
    return compiled, _differences_of(compiled, system.ndof) if hessian_vector is None else _compiled(hessian_vector, 2)


def _functions_in_time(system: HamiltonianSystem) -> tuple[Callable[[np.ndarray], np.ndarray], Product]:
    """The same of a driven system, rows being (..., P, d + 2), with t and s; by the time from differences."""
    d, short = system.ndof, _short(system)

    def rate(q: np.ndarray, t: np.ndarray) -> np.ndarray:
        return system.time_derivative(np.concatenate([q, 0 * q], axis=-1), t)

    def slopes(rows: np.ndarray) -> np.ndarray:
        q, t = rows[..., :d], rows[..., d]
        return np.concatenate([-system.force(q, t), 0 * t[..., None], rate(q, t)[..., None]], axis=-1)

    def product(rows: np.ndarray, v: np.ndarray) -> np.ndarray:
        rows, v = np.broadcast_arrays(rows, v)
        q, t = rows[..., :d], rows[..., d]
        if system.has_hessian_vector:
            change = system.hessian_vector(q, v[..., :d], t)
        else:
            change = _differences_of(lambda x: -system.force(x, t), d)(q, v[..., :d])
        by_time = -_by_time(lambda t: system.force(q, t), t, short)
        of_rate = (by_time * v[..., :d]).sum(-1) + _by_time(lambda t: rate(q, t), t, short) * v[..., d]
        return np.concatenate([change + by_time * v[..., d : d + 1], 0 * t[..., None], of_rate[..., None]], axis=-1)

    return slopes, product


def _short(system: HamiltonianSystem) -> float:
    """The length of differences in t."""
    return PRODUCT * (1.0 if system.period is None else system.period / (2 * np.pi))


def _by_time(f: Callable[[np.ndarray], np.ndarray], t: np.ndarray, h: float) -> np.ndarray:
    return (8 * (f(t + h) - f(t - h)) - f(t + 2 * h) + f(t - 2 * h)) / (12 * h)


def _differences_of(slopes: Callable[[np.ndarray], np.ndarray], ndof: int) -> Product:
    """The derivative of a function of rows, whose first columns are positions, along v."""

    def product(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        q, v = np.broadcast_arrays(q, v)
        largest = np.abs(v).max(-1, keepdims=True)
        length = PRODUCT * np.maximum(np.abs(q[..., :ndof]).max(-1, keepdims=True), 1e-300)
        return largest * derivative(slopes, q, v / np.where(largest > 0, largest, 1.0), length)

    return product


def _compiled(f: Any, n: int) -> Callable[..., np.ndarray]:
    """A Numba function of one row or two, and what it writes, as one of arrays (..., P, d)."""
    from numba import njit

    @njit(error_model="numpy")
    def of_one(Q: Any, out: Any) -> None:
        for s in range(Q.shape[0]):
            f(Q[s], out[s])

    @njit(error_model="numpy")
    def of_two(Q: Any, V: Any, out: Any) -> None:
        for s in range(Q.shape[0]):
            f(Q[s], V[s], out[s])

    def function(*arrays: np.ndarray) -> np.ndarray:
        shape = np.broadcast_shapes(*(a.shape for a in arrays))
        rows = [np.array(np.broadcast_to(a, shape)).reshape(-1, shape[-1]) for a in arrays]
        out = np.empty_like(rows[0])
        (of_one if n == 1 else of_two)(*rows, out)
        return out.reshape(shape)

    return function
