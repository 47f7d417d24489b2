"""HamiltonianSystem: H, its structure, its derivatives, and the scene it is usually solved in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow import matrices
from sympflow.arrays import Array, concatenate, is_tensor, to_numpy
from sympflow.domain import Domain, EnergySublevel

if TYPE_CHECKING:
    import sympy

    from sympflow.linear_part import LinearPart
    from sympflow.symbolic import SymbolicHamiltonian

MOST_DEGREES = 1_000_000


class HamiltonianSystem:
    """A Hamiltonian system x' = J∇H(x), x = [q, p], with H autonomous.

    Parameters
    ----------
    potential : callable, optional
        V(q), q of shape (..., d), returning (...). Then H = ½ pᵀM⁻¹p + V(q) is separable. Without `gradient`
        it must be written with torch functions, and is differentiated automatically. With Numba functions
        (`potential`, `gradient` and `hessian_vector`) the system runs compiled. A function that writes into q is a
        ValueError; of a Numba function that cannot be told, and it would corrupt the run: it may write into `out` only.
    hamiltonian : callable, optional
        H(q, p), written with torch functions, for a system that is not separable. Give this or `potential`.
    ndof : int
        Degrees of freedom d.
    mass : float or array_like of shape (d,) or (d, d), optional
        M, symmetric positive definite; the default is 1. Only with `potential`.
    gradient : callable, optional
        ∇V(q), (..., d) to (..., d); as a Numba function: gradient(q, out).
    hessian_vector : callable, optional
        ∇²V(q)·v, (..., d), (..., d) to (..., d); as a Numba function: hessian_vector(q, v, out).
    stiffness_matrix : array_like of shape (d, d), optional
        A symmetric K, part ½ qᵀKq of the potential, that methods with an exact linear flow take as their `linear_part`.
        Only with `potential`; of a symbolic system it is read off.
    name : str
    domain : Domain, optional
        Ω, where flows are trained. Classical methods never need one.
    y0 : array_like of shape (2d,), optional
        Default initial state.
    t_span : (float, float)
        Default interval.
    dt : float
        Default step of the fixed-step classical methods.
    energy_scale : float, optional
        What energy errors are relative to; the default is |H(y0)|.

    Attributes
    ----------
    separable : bool
        Whether H = T(p) + V(q).
    quadratic_kinetic : bool
        Whether T = ½ pᵀM⁻¹p.
    inverse_mass : None or ndarray of shape (d,) or (d, d)
        M⁻¹, None when it is the identity or T is not quadratic.
    symbols : SymbolicHamiltonian or None
        The symbolic definition, if there is one.

    Examples
    --------
    >>> system = HamiltonianSystem.from_sympy("p**2/2 + 1 - cos(q)")
    >>> system.force(np.array([0.0]))
    array([-0.])
    """

    def __init__(
        self,
        potential: Callable[..., Array] | None = None,
        *,
        hamiltonian: Callable[..., Array] | None = None,
        ndof: int | None = None,
        mass: float | ArrayLike | None = None,
        gradient: Callable[..., Any] | None = None,
        hessian_vector: Callable[..., Any] | None = None,
        stiffness_matrix: ArrayLike | None = None,
        name: str = "custom",
        domain: Domain | None = None,
        y0: ArrayLike | None = None,
        t_span: tuple[float, float] = (0.0, 100.0),
        dt: float = 0.05,
        energy_scale: float | None = None,
    ) -> None:
        from sympflow.callables import CallableHamiltonian

        number = isinstance(ndof, int | float | np.number) and not isinstance(ndof, bool) and 1 <= ndof <= MOST_DEGREES
        if ndof is None or not number or int(ndof) != ndof:
            raise ValueError(
                f"`ndof` must be a positive integer, at most {MOST_DEGREES:,}, the degrees of freedom; got {ndof!r}."
            )
        definition = CallableHamiltonian(int(ndof), potential, hamiltonian, gradient, hessian_vector)
        if definition.separable:
            self._set(definition, matrices.inverse_mass(mass, int(ndof)), True)
        elif mass is not None:
            raise TypeError("`mass` only goes with `potential`: leave it out, it is part of `hamiltonian`.")
        else:
            self._set(definition, None, False)
        if stiffness_matrix is not None and not definition.separable:
            raise TypeError("`stiffness_matrix` only goes with `potential`: leave it out.")
        self.stiffness_matrix: np.ndarray | None = (
            None if stiffness_matrix is None else matrices.stiffness_matrix(stiffness_matrix, definition.ndof)
        )
        self._set_scene(name, {}, domain, y0, t_span, dt, energy_scale)

    @classmethod
    def from_sympy(
        cls,
        expression: str | sympy.Expr,
        *,
        params: Mapping[str, float] | None = None,
        name: str = "custom",
        domain: Domain | None = None,
        y0: ArrayLike | None = None,
        t_span: tuple[float, float] = (0.0, 100.0),
        dt: float = 0.05,
        energy_scale: float | None = None,
    ) -> HamiltonianSystem:
        """A system from one symbolic definition of H in q1 … qd, p1 … pd (or q, p).

        NumPy, torch and Numba functions for H, its gradients and Hessians are generated from it.

        Parameters
        ----------
        expression : str or sympy.Expr
        params : mapping of str to float, optional
            Values of the other symbols.
        name, domain, y0, t_span, dt, energy_scale
            As for the class.

        Raises
        ------
        ValueError, TypeError
            If the expression cannot be parsed, has symbols without a value, or depends on t.
        """
        from sympflow.symbolic import SymbolicHamiltonian

        symbols = SymbolicHamiltonian(expression, params)
        self = cls.__new__(cls)
        M = symbols.inverse_mass
        inverse_mass = None if M is None else matrices.simplest(np.array(M.tolist(), dtype=float))
        self._set(symbols, inverse_mass, M is not None)
        self.symbols, self.stiffness_matrix = symbols, None
        self._set_scene(name, dict(params or {}), domain, y0, t_span, dt, energy_scale)
        return self

    def _set(self, definition: Any, inverse_mass: np.ndarray | None, quadratic_kinetic: bool) -> None:
        self._definition = definition
        self.symbols: SymbolicHamiltonian | None = None
        self.ndof: int = definition.ndof
        self.separable: bool = definition.separable
        self.inverse_mass = inverse_mass
        self.quadratic_kinetic = quadratic_kinetic

    def _set_scene(
        self,
        name: str,
        params: dict[str, float],
        domain: Domain | None,
        y0: ArrayLike | None,
        t_span: tuple[float, float],
        dt: float,
        energy_scale: float | None,
    ) -> None:
        self.name, self.params = name, params
        if not (isinstance(dt, int | float | np.number) and 0 < dt < 1e100):
            raise ValueError(f"`dt` must be positive and finite; got {dt!r}.")
        try:
            self.t_span = (float(t_span[0]), float(t_span[1]))
        except (TypeError, ValueError, IndexError, KeyError) as error:
            raise ValueError(f"`t_span` must be two numbers, start and end; got {t_span!r}.") from error
        self.dt = float(dt)
        scale = isinstance(energy_scale, int | float | np.number)
        if energy_scale is not None and not (scale and 0 < energy_scale < np.inf):
            raise ValueError(f"`energy_scale` must be positive and finite; got {energy_scale!r}.")
        self.energy_scale = energy_scale
        self.y0 = None if y0 is None else np.array(y0, dtype=float)
        if self.y0 is not None and self.y0.shape != (2 * self.ndof,):
            raise ValueError(f"`y0` must have shape ({2 * self.ndof},), [q, p]; got {self.y0.shape}.")
        if domain is not None and not isinstance(domain, Domain):
            raise TypeError(f"`domain` must be a domain such as sympflow.Box(low, high); got {type(domain).__name__}.")
        self.domain = domain.attach(self.hamiltonian) if isinstance(domain, EnergySublevel) else domain
        if self.domain is not None and self.domain.sample(1).shape != (1, 2 * self.ndof):
            raise ValueError(f"`domain` must be a set of states [q, p] of length {2 * self.ndof}.")

    # H and its derivatives ------------------------------------------------------------------------

    def hamiltonian(self, y: Array) -> Array:
        """H(y): (..., 2d) to (...)."""
        if self.separable:
            q, p = y[..., : self.ndof], y[..., self.ndof :]
            return self.kinetic(p) + self.potential(q)
        return self._definition.hamiltonian(y)

    def gradient(self, y: Array) -> Array:
        """∇H(y): (..., 2d) to (..., 2d)."""
        if self.separable:
            return concatenate([-self.force(y[..., : self.ndof]), self.velocity(y[..., self.ndof :])])
        return self._definition.gradient(y)

    def hessian(self, y: Array) -> Array:
        """∇²H(y): (..., 2d) to (..., 2d, 2d)."""
        if not self.separable:
            return self._definition.hessian(y)
        d = self.ndof
        A, B = self.potential_hessian(y[..., :d]), self.kinetic_hessian(y[..., d:])
        B = B + 0 * A
        return concatenate([_rows(A, 0 * A), _rows(0 * B, B)]).swapaxes(-1, -2)

    def vector_field(self, y: Array) -> Array:
        """J∇H(y) = [∇_pH, −∇_qH]: (..., 2d) to (..., 2d)."""
        d = self.ndof
        if self.separable:
            return concatenate([self.velocity(y[..., d:]), self.force(y[..., :d])])
        g = self._definition.gradient(y)
        return concatenate([g[..., d:], -g[..., :d]])

    def __call__(self, t: float, y: Array) -> Array:
        """The right-hand side fun(t, y) of `scipy.integrate.solve_ivp` and `torchdiffeq.odeint`."""
        if y.shape[-1:] != (2 * self.ndof,):
            raise ValueError(
                f"`y` must have shape (..., {2 * self.ndof}), [q, p] on the last axis; got {tuple(y.shape)}. In "
                "solve_ivp leave `vectorized` out, which asks for states in columns."
            )
        return self.vector_field(y)

    # separable systems: V(q) and T(p) -------------------------------------------------------------

    def potential(self, q: Array) -> Array:
        """V(q): (..., d) to (...)."""
        return self._separable()._definition.potential(q)

    def force(self, q: Array) -> Array:
        """−∇V(q): (..., d) to (..., d)."""
        return -self._separable()._definition.potential_gradient(q)

    def potential_hessian(self, q: Array) -> Array:
        """∇²V(q): (..., d) to (..., d, d)."""
        return self._separable()._definition.potential_hessian(q)

    def hessian_vector(self, q: Array, v: Array) -> Array:
        """∇²V(q)·v, by the function given for it if there is one: (..., d), (..., d) to (..., d)."""
        product = getattr(self._separable()._definition, "hessian_vector", None)
        return (self.potential_hessian(q) @ v[..., None])[..., 0] if product is None else product(q, v)

    def curvature(self, q: Array) -> Array:
        """½ v·∇²V(q) v, the curvature of V along the acceleration v = M⁻¹∇V(q): (..., d) to (...).

        Raises
        ------
        ValueError
            If T is not ½ pᵀM⁻¹p.
        """
        symbols = self._with_acceleration().symbols
        if symbols is not None:
            return symbols.curvature(q)
        v = self.velocity(self.force(q))
        return (v * self.hessian_vector(q, v)).sum(-1) / 2

    def curvature_gradient(self, q: Array) -> Array:
        """The gradient of `curvature`, ∇²V M⁻¹∇²V v + ½ ∇³V(v, v): (..., d) to (..., d).

        Without symbols the third derivative is that of ∇²V v along v: of tensors by automatic differentiation, of
        arrays and of Numba functions by a central difference.
        """
        symbols = self._with_acceleration().symbols
        if symbols is not None:
            return symbols.curvature_gradient(q)
        v = -self.velocity(self.force(q))
        return self.hessian_vector(q, self.velocity(self.hessian_vector(q, v))) + self._third_derivative(q, v) / 2

    def _third_derivative(self, q: Array, v: Array) -> Array:
        """∇³V(q)(v, v), for a system without symbols."""
        if is_tensor(q) and self.numba_functions is None:
            from sympflow.forward_mode import jvp

            return jvp(lambda x: self.hessian_vector(x, v), q, v)[1]
        size, length = (abs(x).amax(-1, True) if is_tensor(x) else abs(x).max(-1, keepdims=True) for x in (q, v))
        h = 6e-6 * (size + (size == 0)) / (length + (length == 0))  # ε^⅓
        return (self.hessian_vector(q + h * v, v) - self.hessian_vector(q - h * v, v)) / (2 * h)

    def _with_acceleration(self) -> HamiltonianSystem:
        if not self._separable().quadratic_kinetic:
            raise ValueError(
                f"`system` {self.name!r} has no curvature terms, which are for a kinetic energy ½ pᵀM⁻¹p: leave them "
                "out."
            )
        return self

    def kinetic(self, p: Array) -> Array:
        """T(p): (..., d) to (...)."""
        if self._separable().quadratic_kinetic:
            return (p * self.velocity(p)).sum(-1) / 2
        return self._definition.kinetic(p)

    def velocity(self, p: Array) -> Array:
        """∇T(p): (..., d) to (..., d)."""
        if not self._separable().quadratic_kinetic:
            return self._definition.kinetic_gradient(p)
        if self.inverse_mass is None:
            return p
        M = _like(self.inverse_mass, p)
        return p * M if M.ndim == 1 else p @ M

    def kinetic_hessian(self, p: Array) -> Array:
        """∇²T(p): (..., d) to (..., d, d); M⁻¹ of shape (d, d) when T is quadratic."""
        if not self._separable().quadratic_kinetic:
            return self._definition.kinetic_hessian(p)
        M = np.ones(self.ndof) if self.inverse_mass is None else self.inverse_mass
        return _like(np.diag(M) if M.ndim == 1 else M, p)

    def _separable(self) -> HamiltonianSystem:
        if not self.separable:
            raise ValueError(
                f"`system` {self.name!r} is not separable: H does not split into T(p) + V(q), so splitting methods do "
                "not apply. Use a Runge–Kutta method or train a SympFlow."
            )
        return self

    @property
    def numba_functions(self) -> tuple[Any, Any, Any] | None:
        """(potential, gradient, hessian_vector) if the system was given by Numba functions, else None."""
        return getattr(self._definition, "numba_functions", None)

    # structure --------------------------------------------------------------------------------------

    @cached_property
    def linear_part(self) -> LinearPart:
        """The quadratic part of H, with K, its frequencies, what remains (U) and the `stiffness`.

        Raises
        ------
        ValueError
            If there is none, or its stiff direction turns, with the reason.
        """
        from sympflow.linear_part import linear_part

        return linear_part(self)

    # identity -------------------------------------------------------------------------------------

    @cached_property
    def fingerprint(self) -> tuple[float, ...]:
        """H at 8 fixed states less H at a ninth: what tells a trained flow whether this is its system."""
        probes = np.random.Generator(np.random.PCG64(20260101)).random((9, 2 * self.ndof)) * 0.9 - 0.35
        with np.errstate(all="ignore"):
            H = to_numpy(self.hamiltonian(probes))
        return tuple((H[1:] - H[0]).tolist())

    def __repr__(self) -> str:
        params = ", ".join(f"{k}={v:g}" for k, v in self.params.items())
        kind = "separable" if self.separable else "not separable"
        return f"<HamiltonianSystem {self.name}({params}): {self.ndof} degree(s) of freedom, {kind}>"


def _rows(left: Array, right: Array) -> Array:
    return concatenate([left, right]).swapaxes(-1, -2)


def _like(constant: np.ndarray, x: Array) -> Array:
    """A constant array in the library, dtype and device of `x`."""
    if is_tensor(x):
        import torch

        return torch.as_tensor(constant, dtype=x.dtype, device=x.device)
    return constant.astype(x.dtype, copy=False)
