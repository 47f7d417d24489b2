"""HamiltonianSystem: H, from symbols or functions, with the scene it is usually solved in."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import floats, real_number
from sympflow.arrays import Array
from sympflow.hamiltonian import matrices
from sympflow.hamiltonian.domain import Domain, EnergySublevel
from sympflow.hamiltonian.fingerprint import fingerprint
from sympflow.hamiltonian.hamiltonian import Hamiltonian

if TYPE_CHECKING:
    import sympy

    from sympflow.hamiltonian.linear_part import LinearPart

MOST_DEGREES = 1_000_000


class Parameters(dict[str, float]):
    """The parameters of a system: a dictionary that cannot be changed, for the code of H holds their values."""

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError(
            "`params` of a system are to be read only, for its forces would not change: make a system with other "
            "parameters, by its scene's function or by HamiltonianSystem.from_sympy(..., params=...)."
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return Parameters, (dict(self),)


class HamiltonianSystem(Hamiltonian):
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
        from sympflow.hamiltonian.callables import CallableHamiltonian

        number = isinstance(ndof, int | float | np.number) and not isinstance(ndof, bool) and 1 <= ndof <= MOST_DEGREES
        if ndof is None or not number or int(ndof) != ndof:
            raise ValueError(
                f"`ndof` must be a positive integer, at most {MOST_DEGREES:,}, the degrees of freedom; got {ndof!r}."
            )
        definition = CallableHamiltonian(int(ndof), potential, hamiltonian, gradient, hessian_vector)
        if definition.separable:
            super().__init__(name, definition, matrices.inverse_mass(mass, int(ndof)), True)
        elif mass is not None:
            raise TypeError("`mass` only goes with `potential`: leave it out, it is part of `hamiltonian`.")
        else:
            super().__init__(name, definition, None, False)
        if stiffness_matrix is not None:
            if not definition.separable:
                raise TypeError("`stiffness_matrix` only goes with `potential`: leave it out.")
            self.stiffness_matrix = matrices.stiffness_matrix(stiffness_matrix, definition.ndof)
            self.stiffness_matrix.setflags(write=False)
        self._set_scene({}, domain, y0, t_span, dt, energy_scale)

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
            In a text `pi` is a constant and every other name that is no function a symbol: so are `E` and `I`;
            Euler's number is exp(1).
        params : mapping of str to float, optional
            Values of the other symbols: finite real numbers. A name that is given here is a symbol whatever it means
            otherwise. `system.params` holds them, to be read only.
        name, domain, y0, t_span, dt, energy_scale
            As for the class.

        Raises
        ------
        ValueError, TypeError
            If the expression cannot be parsed, has symbols without a value, or depends on t.
        """
        from sympflow.hamiltonian.symbolic import SymbolicHamiltonian, checked_params

        params = checked_params(params)
        symbols = SymbolicHamiltonian(expression, params)
        self = cls.__new__(cls)
        M = symbols.inverse_mass
        inverse_mass = None if M is None else matrices.simplest(np.array(M.tolist(), dtype=float))
        Hamiltonian.__init__(self, name, symbols, inverse_mass, M is not None)
        self.symbols = symbols
        self._set_scene(params, domain, y0, t_span, dt, energy_scale)
        return self

    def _set_scene(
        self,
        params: dict[str, float],
        domain: Domain | None,
        y0: ArrayLike | None,
        t_span: tuple[float, float],
        dt: float,
        energy_scale: float | None,
    ) -> None:
        self._params = Parameters(params)
        if not real_number(dt) or not 0 < dt < 1e100:
            raise ValueError(f"`dt` must be positive and finite; got {dt!r}.")
        try:
            t0, t1 = (float(t) for t in t_span)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"`t_span` must be two finite numbers, start and end; got {t_span!r}.") from error
        if not math.isfinite(t1 - t0):
            raise ValueError(f"`t_span` must be two finite numbers, start and end; got {t_span!r}.")
        self.t_span, self.dt = (t0, t1), float(dt)
        if energy_scale is not None and not (real_number(energy_scale) and 0 < energy_scale <= sys.float_info.max):
            raise ValueError(f"`energy_scale` must be positive and finite; got {energy_scale!r}.")
        self.energy_scale = energy_scale
        self.y0 = None if y0 is None else self._checked_y0(y0)
        if domain is not None and not isinstance(domain, Domain):
            raise TypeError(f"`domain` must be a domain such as sympflow.Box(low, high); got {type(domain).__name__}.")
        self.domain = domain.attach(self.hamiltonian) if isinstance(domain, EnergySublevel) else domain
        if self.domain is not None and self.domain.sample(1).shape != (1, 2 * self.ndof):
            raise ValueError(f"`domain` must be a set of states [q, p] of length {2 * self.ndof}.")

    def _checked_y0(self, y0: ArrayLike) -> np.ndarray:
        """The default initial state: a copy of floats."""
        try:
            state = floats("y0", y0)
        except OverflowError:
            raise ValueError("`y0` must be finite: it has an integer that no float is near.") from None
        if state.shape != (2 * self.ndof,):
            raise ValueError(f"`y0` must have shape ({2 * self.ndof},), [q, p]; got {state.shape}.")
        return state

    @property
    def params(self) -> Mapping[str, float]:
        """The values of the parameters, to be read only: they are part of H, from which all code is generated.

        A system with others is made by `HamiltonianSystem.from_sympy`, or by the function of its scene.
        """
        return self._params

    # structure --------------------------------------------------------------------------------------

    @cached_property
    def linear_part(self) -> LinearPart:
        """The quadratic part of H, with K, its frequencies, what remains (U) and the `stiffness`.

        Raises
        ------
        ValueError
            If there is none, or its stiff direction turns, with the reason.
        """
        from sympflow.hamiltonian.linear_part import linear_part

        return linear_part(self)

    # identity -------------------------------------------------------------------------------------

    @cached_property
    def fingerprint(self) -> tuple[float, ...]:
        """H at 8 fixed states less H at a ninth: what tells a trained flow whether this is its system."""
        return fingerprint(self)

    def __repr__(self) -> str:
        params = ", ".join(f"{k}={v:g}" for k, v in self.params.items())
        kind = "separable" if self.separable else "not separable"
        return f"<HamiltonianSystem {self.name}({params}): {self.ndof} degree(s) of freedom, {kind}>"
