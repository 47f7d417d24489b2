"""Hamiltonian: H, its structure and its derivatives."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sympflow.arrays import (
    Array,
    as_tensor,
    concatenate,
    is_tensor,
    jvp,
    largest,
    library,
    like,
    of_library,
    per_state,
    to_numpy,
)
from sympflow.hamiltonian.definition import bare_copy
from sympflow.hamiltonian.formulas import TracedHamiltonian, recorded
from sympflow.hamiltonian.friction import FRICTIONLESS, Friction
from sympflow.hamiltonian.linear_part import checked_inverse_mass
from sympflow.hamiltonian.times import checked_time
from sympflow.show.cards import Shown

if TYPE_CHECKING:
    from sympflow.compiler.program import Program
    from sympflow.hamiltonian.layered import LayeredPotential
    from sympflow.hamiltonian.local import LocalHamiltonian
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian


NEWTON, FOUND = 20, 1e-12  # steps at most, and the error of a velocity relative to the largest


def _check_array(name: str, x: Any, what: str) -> None:
    """Raise a TypeError unless x is an array or a tensor."""
    if isinstance(x, list | tuple | int | float | str | dict | Shown) and not isinstance(x, np.generic):
        given = type(x).__name__ if isinstance(x, Shown) else repr(x)
        raise TypeError(
            f"`{name}` must be an array or a tensor, {what}; got {given}: pass np.array([...]), or `sol.states` of a "
            "solution."
        )


class Hamiltonian:
    """H(q, p), or H(t, q, p), of d degrees of freedom, by a definition of it.

    Parameters
    ----------
    name : str
    definition : SymbolicHamiltonian or CallableHamiltonian, or like these
        With `ndof` and `separable`; if that is True, with V and T, each with a gradient and a Hessian, T being needed
        only where it is not quadratic; else with H and these of it.
    inverse_mass : ndarray of shape (d,) or (d, d), optional
        M⁻¹; the default is the identity.
    quadratic_kinetic : bool
        Whether T = ½ pᵀM⁻¹p.

    Attributes
    ----------
    separable : bool
        Whether H = T(p) + V(q).
    symbols : SymbolicHamiltonian or None
        The symbolic definition, if there is one.
    stiffness_matrix : ndarray of shape (d, d) or None
        A quadratic part ½ qᵀKq of V that was named, of a definition without symbols.
    functions_given : bool
        True if H is given by functions of a user, which are to be checked.
    friction : Friction
        The flow of −Γp; false without it. Whatever leaves it out must refuse the system: see `check_conservative`.
    autonomous : bool
        False if H depends on t: then every function takes the time after the states, a number or one for each state,
        and whatever leaves it out must refuse the system: see `check_autonomous`.
    period : float or None
        The period of H in t, where one was named.
    """

    friction: Friction = FRICTIONLESS
    period: float | None = None
    energy_scale: float | None = None
    followed_mass: Any = None
    """M as a tensor that torch follows, which may change."""
    external_force: Any = None
    """F(q, p, *t) of a physical limit, p' = −∂H/∂q + F, (..., d), with its `jacobian`; part of `vector_field`."""

    def __init__(self, name: str, definition: Any, inverse_mass: np.ndarray | None, quadratic_kinetic: bool) -> None:
        self._name = name
        self.definition = definition
        self.local: LocalHamiltonian | None = definition if definition.loops else None
        """The definition by one site or one pair, with attributes such as `shape`."""
        self.ndof: int = definition.ndof
        self.separable: bool = definition.separable
        self._inverse_mass = inverse_mass
        if inverse_mass is not None:
            inverse_mass.setflags(write=False)  # a part of H, of which code is generated
        self.quadratic_kinetic = quadratic_kinetic
        self.stiffness_matrix: np.ndarray | None = None
        self.functions_given: bool = definition.given
        self.numba_functions: Any = definition.numba_functions
        self._tested: dict[tuple[type, Any], np.ndarray] = {}  # how far, by the kind of states

    @property
    def symbols(self) -> Any:
        """The symbolic definition of H as text or SymPy's, made at first use; else None."""
        return self.definition.symbols

    @property
    def autonomous(self) -> bool:
        """False if H depends on t."""
        return not self.definition.timed

    @property
    def name(self) -> str:
        """The name that was given; else H as a formula, or the function of a user that defines it."""
        return self._name or self.definition.name

    def hamiltonian(self, y: Array, t: Any = None) -> Array:
        """H(y), or H(t, y): (..., 2d) to (...); a TypeError, as of all functions, where t is missing."""
        self._check_width(y)
        if self.separable:
            q, p = y[..., : self.ndof], y[..., self.ndof :]
            return self.kinetic(p, t) + self.potential(q, t)
        return self.definition.hamiltonian(y, *self._time(t, y))

    def gradient(self, y: Array, t: Any = None) -> Array:
        """∇H(y): (..., 2d) to (..., 2d)."""
        self._check_width(y)
        if self.separable:
            return concatenate([-self.force(y[..., : self.ndof], t), self.velocity(y[..., self.ndof :], t)])
        return self.definition.gradient(y, *self._time(t, y))

    def hessian(self, y: Array, t: Any = None) -> Array:
        """∇²H(y): (..., 2d) to (..., 2d, 2d)."""
        self._check_width(y)
        if not self.separable:
            return self.definition.hessian(y, *self._time(t, y))
        d = self.ndof
        A, B = self.potential_hessian(y[..., :d], t), self.kinetic_hessian(y[..., d:], t)
        B = B + 0 * A
        return concatenate([concatenate([A, 0 * A]), concatenate([0 * B, B])], -2)

    def momenta(self, q: Array, v: Array, t: Any = None) -> Array:
        """p with ∂H/∂p(q, p) = v, (..., d) each, by Newton's method from p = v; a ValueError where none is found."""
        d, p = self.ndof, v
        for _ in range(NEWTON):
            y = concatenate([q, p])
            left = v - self.gradient(y, t)[..., d:]
            if bool((abs(left) <= FOUND * abs(v).max()).all()):
                return p
            try:
                p = p + library(left).linalg.solve(self.hessian(y, t)[..., d:, d:], left[..., None])[..., 0]
            except (np.linalg.LinAlgError, RuntimeError):  # the latter of torch
                break
        raise ValueError("`v`: Newton's method finds no momenta for these velocities; give p itself.")

    def time_derivative(self, y: Array, t: Any = None) -> Array:
        """∂H/∂t of a driven system, 0 of another: (..., 2d) to (...)."""
        self._check_width(y)
        times = self._time(t, y)
        return self.definition.time_derivative(y, *times) if times else 0 * y[..., 0]

    def energy_density(self, y: Array, t: Any = None) -> Array:
        """H at each site of a lattice (..., *shape), or each body of pairs (..., n), which add up to H.

        The energy of a bond or a pair is divided evenly between its ends; that of a bond to a wall is its site's. A
        ValueError for other systems.
        """
        self._check_width(y)
        if self.local is None:
            raise ValueError(
                f"`system` {self.name!r} has no energy density: that is of lattices and pairs, by "
                "HamiltonianSystem.lattice and HamiltonianSystem.pairs."
            )
        return self.local.energy_density(y, *self._time(t, y))

    def vector_field(self, y: Array, t: Any = None) -> Array:
        """J∇H(y) = [∇_pH, −∇_qH], with friction [∇_pH, −∇_qH − Γp]: (..., 2d) to (..., 2d)."""
        self._check_width(y)
        d = self.ndof
        if self.separable:
            velocity, force = self.velocity(y[..., d:], t), self.force(y[..., :d], t)
        else:
            g = self.definition.gradient(y, *self._time(t, y))
            velocity, force = g[..., d:], -g[..., :d]
        force = self.friction.added(force, y[..., d:])
        if self.external_force is not None:
            force = force + self.external_force(y[..., :d], y[..., d:], *self._time(t, y))
        return concatenate([velocity, force])

    def field_jacobian(self, y: Array, t: Any = None) -> Array:
        """The Jacobian of `vector_field`, J∇²H(y), with friction less Γ in the rows and columns of p: (..., 2d, 2d)."""
        d, S = self.ndof, self.hessian(y, t)
        rows = [S[..., d:, :], -S[..., :d, :]]
        A = concatenate(rows, -2)
        if self.friction:
            G = np.zeros((2 * d, 2 * d))
            G[d:, d:] = self.friction.matrix(d)
            A = A - like(G, A)
        if self.external_force is not None:
            F = self.external_force.jacobian(y[..., :d], y[..., d:], *self._time(t, y))
            A = A + concatenate([0 * F, F], -2)
        return A

    def with_force(self, force: Any) -> Self:
        """Return the system with p' = −∂H/∂q − Γp + F(q, p), which its vector field, and no H, holds."""
        forced = bare_copy(self)
        forced._name = self._name and f"{self._name}_forced"
        forced.external_force = force
        return forced

    def as_doubled(self) -> Any:
        """Return the system itself if it is doubled; a ValueError otherwise."""
        raise ValueError(
            f"`system` {self.name!r} is not doubled, so that its states are the physical ones: make one "
            "by sympflow.doubled(system, force), or leave out what asks for its physical limit."
        )

    def lift(self, y: Array) -> Array:
        """The states (..., 2d) for `y` of another width; a ValueError but for doubled systems, which have such."""
        turned = y.ndim > 1 and len(y) == 2 * self.ndof
        remedy = "Transpose it" if turned else "Join q and p along the last axis, np.concatenate([q, p], axis=-1)"
        raise ValueError(
            f"`y0` must have shape (..., {2 * self.ndof}) for {self.name!r}, [q, p] with {self.ndof} each; got "
            f"{tuple(y.shape)}. {remedy}."
        )

    def identity_parts(self) -> Any:
        """Return all that H and the equations of motion are made of; a store recognises the system by it."""
        return [
            self.definition if self.symbols is None else self.symbols,
            self.inverse_mass,
            self.stiffness_matrix,
            self.damping,
            self.external_force,
            self.energy_scale,
        ]

    @property
    def damping(self) -> np.ndarray | None:
        """Γ of the friction −Γp, to be read only: (), one rate γ for all momenta, (d,) or (d, d); None without."""
        return self.friction.damping

    @property
    def conservative(self) -> bool:
        """True without friction or an external force."""
        return not self.friction and self.external_force is None

    @property
    def keeps_energy(self) -> bool:
        """True if H is constant along solutions: without friction, an external force or a drive."""
        return self.conservative and self.autonomous

    @property
    def shows_energy(self) -> bool:
        """True if runs are judged by an energy that is kept: that of a doubled system is 0 in the physical limit."""
        return self.keeps_energy

    def check_conservative(self, what: str, remedy: str) -> None:
        """Refuse a system with friction, by a ValueError with `what` leaves it out, a clause, and the remedy.

        With an external force the remedy is always the same: the vector field, or the doubled system.
        """
        if self.external_force is not None:
            raise ValueError(
                f"`system` {self.name!r} has an external force, p' = −∂H/∂q + F, {what}: solve it by a "
                "Runge–Kutta method such as 'dop853', or its doubled system by any method, and judge the physical "
                "solution by sympflow.reference_error(sol)."
            )
        if self.friction:
            raise ValueError(f"`system` {self.name!r} has friction, p' = −∂H/∂q − Γp, {what}: {remedy}.")

    def check_damped_drifts(self) -> None:
        """Refuse friction of a kinetic energy that is not quadratic, whose drifts with friction are not known."""
        if self.friction and not self.quadratic_kinetic:
            raise ValueError(
                f"`system` {self.name!r} has friction, which drifts hold where the kinetic energy is ½ pᵀM⁻¹p: use a "
                "Runge–Kutta method such as 'dop853'."
            )

    def check_autonomous(self, what: str, remedy: str) -> None:
        """Refuse a driven system, H(t, q, p), by a ValueError with `what` leaves the time out and the remedy."""
        if not self.autonomous:
            raise ValueError(f"`system` {self.name!r} is driven, H depends on t, {what}: {remedy}.")

    @property
    def shortest_piece(self) -> float:
        """The shortest time between two jumps of H in t, those of sampled parameters; inf if there are none.

        An adaptive method may step over a pulse that no stage meets; one with steps no longer than this does not.
        """
        return self.definition.shortest_piece

    def jump_times(self, low: float, high: float, step: float, kinks: bool = False) -> np.ndarray:
        """The times (n,) between two others at which H jumps, or has `kinks`: of samples, and of functions of t.

        Functions that jump are `Heaviside`, `sign`, `floor`, `acot`, `atan2`, an absolute value in a quotient, the
        conditions of pieces, and similar ones. Zeros of arguments that are neither linear nor periodic are resolved to
        `step`. In a long interval with many jumps only the first ones are returned.
        """
        return self.definition.jump_times(low, high, step, kinks)

    @cached_property
    def between_impulses(self) -> Self:
        """The system without its impulses, which it follows between them: itself, where H has none."""
        form = self.definition.between_impulses
        if form is self.definition:
            return self
        between = bare_copy(self)
        Hamiltonian.__init__(between, self._name, form, self.inverse_mass, self.quadratic_kinetic)
        return between

    def check_impulses(self, what: str, remedy: str) -> None:
        """Refuse a system with impulses, DiracDelta in t, by a ValueError with `what` omits them and the remedy."""
        if self.between_impulses is not self:
            raise ValueError(f"`system` {self.name!r} has impulses, DiracDelta in H, {what}: {remedy}.")

    def check_times(self, t0: float, t1: float) -> None:
        """Refuse an interval that leaves the times of sampled parameters, by a ValueError with these."""
        if self.definition.samples:
            self.symbols.check_times(t0, t1)

    def _time(self, t: Any, x: Array) -> tuple[Any, ...]:
        """The time that functions of a driven system take after the states x (..., k), checked; () of another."""
        if not self.definition.timed:
            return ()
        if self.definition.impulses:
            self.check_impulses(
                "so that H and its derivatives are infinite there",
                "solve it by sympflow.solve; or use system.between_impulses, and the kicks of p between by "
                "system.kicks(t0, t1)",
            )
        if t is None:
            raise TypeError(
                f"`t` is missing, the time: `system` {self.name!r} is driven, H depends on t. Give it after the state, "
                "as in system.hamiltonian(y, t)."
            )
        return (checked_time(t, x, x.shape[:-1]),)

    def __call__(self, t: float, y: Array) -> Array:
        """The right-hand side fun(t, y) of `scipy.integrate.solve_ivp` and `torchdiffeq.odeint`.

        Beyond the samples of a parameter its spline is extrapolated: solvers may evaluate past the end of a run.
        """
        if isinstance(y, int | float):
            raise TypeError(f"`y` must be a state; got the number {y}: the time comes first, as in system(t, y).")
        return self.vector_field(y, t)

    def _check_width(self, y: Array) -> None:
        _check_array("y", y, "a state [q, p]")
        if y.shape[-1:] != (2 * self.ndof,):
            raise ValueError(
                f"`y` must have shape (..., {2 * self.ndof}), [q, p] on the last axis; got {tuple(y.shape)}. Of a "
                "solution pass `sol.states`; in solve_ivp leave `vectorized` out, which asks for states in columns."
            )

    # separable systems: V(q) and T(p) -------------------------------------------------------------

    def potential(self, q: Array, t: Any = None) -> Array:
        """V(q): (..., d) to (...)."""
        return self._separable().definition.potential(self._positions(q), *self._time(t, q))

    def force(self, q: Array, t: Any = None) -> Array:
        """−∇V(q): (..., d) to (..., d)."""
        return -self._separable().definition.potential_gradient(self._positions(q), *self._time(t, q))

    def potential_hessian(self, q: Array, t: Any = None) -> Array:
        """∇²V(q): (..., d) to (..., d, d)."""
        return self._separable().definition.potential_hessian(self._positions(q), *self._time(t, q))

    def hessian_vector(self, q: Array, v: Array, t: Any = None) -> Array:
        """∇²V(q)·v, by the function given for it if there is one: (..., d), (..., d) to (..., d)."""
        return self._separable().definition.hessian_vector(self._positions(q), v, *self._time(t, q))

    def curvature(self, q: Array, t: Any = None) -> Array:
        """½ v·∇²V(q) v along the acceleration v = M⁻¹∇V(q): (..., d) to (...); a ValueError if T is not ½ pᵀM⁻¹p."""
        symbols = self._with_acceleration().symbols
        if symbols is not None:
            return symbols.curvature(self._positions(q), *self._time(t, q))
        v = self.velocity(self.force(q, t))
        return (v * self.hessian_vector(q, v, t)).sum(-1) / 2

    def curvature_gradient(self, q: Array, t: Any = None) -> Array:
        """The gradient of `curvature`, ∇²V M⁻¹∇²V v + ½ ∇³V(v, v): (..., d) to (..., d).

        Without symbols the third derivative is that of ∇²V v along v: by automatic differentiation of tensors, and of
        arrays if V is all that was given; of Numba functions and of a user's gradient of arrays by a difference.
        """
        symbols = self._with_acceleration().symbols
        if symbols is not None:
            return symbols.curvature_gradient(self._positions(q), *self._time(t, q))
        v = -self.velocity(self.force(q, t))
        turn = self.hessian_vector(q, self.velocity(self.hessian_vector(q, v, t)), t)
        return turn + self.third_derivative(q, v, v, t) / 2

    def third_derivative(self, q: Array, v: Array, w: Array, t: Any = None) -> Array:
        """∇³V(q)(v, w), for a system without symbols: (..., d), each, to (..., d)."""
        if self.definition.has_third_derivative:
            return self.definition.third_derivative(q, v, w, *self._time(t, q))
        if self.numba_functions is None and (self.definition.differentiates_itself or is_tensor(q)):
            x, along, other = map(as_tensor, (q, v, w))
            return of_library(jvp(lambda z: self.hessian_vector(z, other, t), x, along)[1], q)
        return third_derivative(self, q, v, w, t)

    def _with_acceleration(self) -> Hamiltonian:
        if not self._separable().quadratic_kinetic:
            raise ValueError(
                f"`system` {self.name!r} has no curvature terms, which are for a kinetic energy ½ pᵀM⁻¹p: leave them "
                "out."
            )
        return self

    def _positions(self, q: Array) -> Array:
        _check_array("q", q, "positions")
        if q.shape[-1:] != (self.ndof,):
            raise ValueError(
                f"`q` must have shape (..., {self.ndof}), positions on the last axis; got {tuple(q.shape)}: "
                f"pass y[..., :{self.ndof}] of a state y."
            )
        return q

    def kinetic(self, p: Array, t: Any = None) -> Array:
        """T(p): (..., d) to (...). Like its derivatives it needs no t if T does not depend on it."""
        if self._separable().quadratic_kinetic:
            felt = None if self.local is None else self.local.felt
            return ((p if felt is None else p * like(felt, p)) * self.velocity(p)).sum(-1) / 2
        return self.definition.kinetic(p, *self._kinetic_time(t, p))

    def velocity(self, p: Array, t: Any = None) -> Array:
        """∇T(p): (..., d) to (..., d)."""
        if not self._separable().quadratic_kinetic:
            return self.definition.kinetic_gradient(p, *self._kinetic_time(t, p))
        if self.followed_mass is not None:
            mass = like(of_library(self.followed_mass, p), p)
            return p / mass if mass.ndim < 2 else p @ library(p).linalg.inv(mass).mT
        if self.inverse_mass is None:
            return p
        M = like(self.inverse_mass, p)
        return p * M if M.ndim == 1 else p @ M

    def kinetic_hessian(self, p: Array, t: Any = None) -> Array:
        """∇²T(p): (..., d) to (..., d, d); M⁻¹ of shape (d, d) when T is quadratic."""
        if not self._separable().quadratic_kinetic:
            return self.definition.kinetic_hessian(p, *self._kinetic_time(t, p))
        M = np.ones(self.ndof) if self.inverse_mass is None else self.inverse_mass
        return like(np.diag(M) if M.ndim == 1 else M, p)

    def drift(self, p: Array, t: Any, s: Any) -> Array:
        """∫_t^{t+s} ∇T(p, u) du, by which a drift moves q; s·∇T(p) if T does not depend on t: (..., d) to (..., d).

        t and s, numbers or (...), are its beginning and how long it lasts, with its sign. A ValueError if T depends on
        t and the integral is not elementary.
        """
        if not self.kinetic_timed:
            return per_state(s, p) * self.velocity(p)
        return self.definition.drifted(p, *self._time(t, p), checked_time(s, p, p.shape[:-1]))

    def drifted(self, q: Array, p: Array, t: Any, s: Any, sign: float = 1.0) -> tuple[Array, Array]:
        """The states after the flow of T(p, t) with friction over a time s from t on; `sign` −1 undoes it.

        s is a number, or an array that broadcasts against p (..., d).
        """
        if self.friction:
            mean, end = self.friction.drift(p, sign * s)
            return q + self.velocity(mean), end
        if self.kinetic_timed:
            return q + sign * self.drift(p, t, s[..., 0] if getattr(s, "ndim", 0) else s), p
        return q + (sign * s) * self.velocity(p), p

    def drift_jacobian(self, p: Array, t: Any, s: Any) -> Array:
        """The derivatives of `drift` in p: (..., d) to (..., d, d)."""
        if not self.kinetic_timed:
            return (s[..., None, None] if getattr(s, "ndim", 0) else s) * self.kinetic_hessian(p)
        return self.definition.drift_jacobian(p, *self._time(t, p), checked_time(s, p, p.shape[:-1]))

    @property
    def kinetic_timed(self) -> bool:
        """True if T depends on t: then a drift is an integral over t."""
        return self.definition.kinetic_timed

    def _kinetic_time(self, t: Any, p: Array) -> tuple[Any, ...]:
        return self._time(t, p) if self.kinetic_timed else ()

    def _separable(self) -> Hamiltonian:
        if not self.separable:
            raise ValueError(
                f"`system` {self.name!r} is not separable: H does not split into T(p) + V(q), so splitting methods do "
                f"not apply. Use {self.definition.instead}."
            )
        return self

    @property
    def inverse_mass(self) -> np.ndarray | None:
        """M⁻¹, (d,) or (d, d), as it is now; None when it is the identity or T is not quadratic."""
        if self.followed_mass is None:
            return self._inverse_mass
        return checked_inverse_mass(to_numpy(self.followed_mass), self.ndof)

    @property
    def form(self) -> SymbolicHamiltonian | TracedHamiltonian | None:
        """The definition that programs are recorded of: symbols, or functions that were traced; else None."""
        if self.followed_mass is not None:  # which is a number in programs
            return None
        return self.definition.form

    @property
    def layered(self) -> LayeredPotential | None:
        """V as a chain of linear layers whose weights torch follows, of functions that are one; else None."""
        return None if self.followed_mass is not None else self.definition.layered

    @property
    def numbered(self) -> SymbolicHamiltonian | TracedHamiltonian | None:
        """The form of which `named` makes one with numbers that torch follows as parameters; else None."""
        if self.followed_mass is not None:
            return self.definition.form
        return None if self.definition.followed is None else self.definition.followed.form

    def learns(self, y: Array) -> bool:
        """Return True if torch follows numbers of H at the states y (..., 2d), such as weights or masses."""
        return self.followed_mass is not None or self.definition.learns(y)

    @property
    def untraced(self) -> str:
        """The reason why Python functions could not be traced, a clause; "" if they were, or there are none."""
        if self.followed_mass is not None:
            return "`mass` requires gradients, which flow by tensor operations"
        return "" if self.form is not None else self.definition.untraced

    @property
    def program(self) -> Program:
        """H as the operations that are compiled, of t where it is driven, q1 … qd and p1 … pd: print it.

        A ValueError if there are none: of a lattice or pairs, and of functions that could not be traced, with a reason.
        """
        form = self.form
        if form is None:
            why = (
                f"its functions could not be traced: {self.untraced}"
                if self.untraced
                else "it is given by one site or one pair"
            )
            raise ValueError(f"`system` {self.name!r} has no program, because {why}.")
        times = () if form.time is None else (form.time,)
        return recorded([form.H], (*times, *form.q, *form.p))

    @property
    def written(self) -> Any:
        """The symbolic definition, or that of a few bodies or a traced function, made at first use; else None."""
        if self.local is not None:
            return self.local.written
        form = self.form
        return form.written if isinstance(form, TracedHamiltonian) else form

    @property
    def spelled(self) -> SymbolicHamiltonian | TracedHamiltonian | None:
        """`form`, or that of a lattice or of pairs with all terms one by one, if they are not too many; else None."""
        return self.form if self.local is None else self.local.spelled

    @cached_property
    def expression(self) -> str | None:
        """H as a text, in q1 … qd, p1 … pd, the time t and numbers, of a symbolic system; else None."""
        return None if self.symbols is None else self.symbols.text

    @property
    def few_sites(self) -> Self:
        """A lattice of a few sites, by which a flow for any size recognises it; else the system itself."""
        return self

    @property
    def has_hessian_vector(self) -> bool:
        """False if ∇²V·v of arrays is not to be had, as for a gradient that was given without it."""
        return self.definition.has_hessian_vector


def third_derivative(system: Hamiltonian, q: Array, v: Array, w: Array, t: Any = None) -> Array:
    """∇³V(q)(v, w), the derivative of ∇²V·w along v: (..., d), each, to (..., d)."""
    along, other = direction(v), direction(w)
    with np.errstate(all="ignore"):
        h = step(q, length_of_change(system, q, along, other, t))
        change = derivative(lambda x: system.hessian_vector(x, other, t), q, along, h)
    return largest(v) * largest(w) * change


def derivative(f: Callable[[Array], Array], q: Array, along: Array, h: Array) -> Array:
    """The derivative of f at q along unit vectors, by the central difference of order 4 with steps h (..., 1)."""
    near = f(q + h * along) - f(q - h * along)
    far = f(q + 2 * h * along) - f(q - 2 * h * along)
    return (8 * near - far) / (12 * h)


def direction(v: Array) -> Array:
    """v over its largest component; 0 for 0."""
    size = largest(v)
    return v / (size + (size == 0))


def length_of_change(system: Hamiltonian, q: Array, along: Array, other: Array, t: Any = None) -> Array:
    """ℓ = ‖∇V‖ / ‖∇²V v̂‖, on which the force changes along unit vectors v̂: (..., d) to (..., 1)."""
    xp = library(q)
    force, change = largest(system.force(q, t)), largest(system.hessian_vector(q, along, t))
    first = _bounded(xp.where(change > 0, force / (change + (change == 0)), np.inf), q)
    h = xp.finfo(q.dtype).eps ** (1 / 3) * first
    twice = system.hessian_vector(q + h * along, other, t) - system.hessian_vector(q - h * along, other, t)
    bend = largest(twice) / (2 * h)
    second = xp.sqrt(force / (bend + (bend == 0)))
    return _bounded(xp.where((bend > 0) & (second < first), second, first), q)


def step(q: Array, length: Array) -> Array:
    """The h for which the truncation error of `derivative`, (h/ℓ)⁴, equals the rounding error, ε max(|q|, ℓ)/h."""
    eps, xp = library(q).finfo(q.dtype).eps, library(q)
    return length * (eps * xp.maximum(largest(q) / length, 0 * length + 1)) ** 0.2


def _bounded(length: Array, q: Array) -> Array:
    xp = library(q)
    size = largest(q)
    size = size + (size == 0)
    return xp.minimum(xp.maximum(length, xp.finfo(q.dtype).eps ** 0.5 * size), xp.maximum(size, 0 * size + 1))
