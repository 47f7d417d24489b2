"""Definition: the functions that define H, whether from symbols or a user's."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import Array

if TYPE_CHECKING:
    from sympflow.hamiltonian.poles import Places

ASIDE = 64 * float(np.finfo(float).eps)
"""Share of the times between which a run goes on from a jump, or ends before it, so that H is that of one side."""


def bare_copy(x: Any) -> Any:
    """Return a copy of an object without its cached properties."""
    other = copy.copy(x)
    for name in [name for name in vars(other) if isinstance(getattr(type(x), name, None), cached_property)]:
        del vars(other)[name]
    return other


class Definition:
    """The functions of H(q, p); a subclass has, by `separable`, those of V and T or those of H itself.

    If `separable`, `potential(q)`, `potential_gradient(q)` and `potential_hessian(q)`, and where T is not quadratic
    `kinetic(p)`, `kinetic_gradient(p)` and `kinetic_hessian(p)`; else `hamiltonian(y)`, `gradient(y)` and `hessian(y)`.
    If `timed`, each takes t, a number or (...), after the states, and there is `time_derivative(y, t)`; if
    `kinetic_timed`, `drifted(p, t, s)` and `drift_jacobian(p, t, s)`.
    """

    ndof: int
    separable: bool
    symbols: Any = None  # the definition itself, if it is a SymbolicHamiltonian
    symbolic: bool = False  # True of H as a text or an expression, which has `symbols` once they are asked for
    numba_functions: tuple[Any, Any, Any] | None = None  # V, gradient, hessian_vector
    differentiates_itself: bool = False  # by torch alone, in which the functions are written
    has_hessian_vector: bool = True  # of arrays: not where a gradient was given without it
    takes_tensors: bool = True  # not if the functions take NumPy arrays alone
    given: bool = False  # by a user, so that derivatives may be wrong: `check` tests them
    timed: bool = False
    kinetic_timed: bool = False
    shortest_piece: float = inf  # the shortest time between two jumps of H in t
    may_jump: bool = False  # at times, which `jump_times` lists
    jumps: Any = False  # True of a symbolic H that does
    has_third_derivative: bool = False  # `third_derivative` of all arrays; else by differences
    loops: str = ""  # the compiled loops of a definition by one site or pair: see `sympflow.hamiltonian.local`
    leaps: bool = False  # bodies may meet, over which a step may leap: then there is `leapt`
    impulses: tuple[Any, ...] = ()  # DiracDelta in t: then there are `between_impulses` and `kicks`
    form: Any = None  # what programs are recorded of: see `sympflow.hamiltonian.formulas`
    text: str | None = None  # H, where that is a text, or an expression in symbols
    samples: Mapping[str, Any] = MappingProxyType({})  # functions of t by samples, of symbols
    layered: Any = None  # V with layers whose weights torch follows: see `sympflow.hamiltonian.layered`
    followed: Any = None  # the form with numbers that torch follows as parameters, of functions that hold some
    untraced: str = ""  # the reason for which they could not, a clause, known after `form`
    given_functions: bool = False  # of Python, which are traced where that is possible
    instead: str = "an implicit method such as 'gauss_legendre6', or a Runge–Kutta method"
    _generated: tuple[str, ...] = ("_functions",)  # what cannot be pickled, and is made again

    @property
    def name(self) -> str:
        """The name of a system without a given name."""
        return ""

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in self._generated}

    def jump_times(self, low: float, high: float, step: float, kinks: bool = False) -> np.ndarray:
        """The times (n,) between two others at which H is known to jump; the rest as of `Hamiltonian.jump_times`."""
        return np.zeros(0)

    @property
    def between_impulses(self) -> Any:
        """The definition without its impulses: itself, where it has none."""
        return self

    @property
    def poles(self) -> Places | None:
        """The places where H is infinite or not a number, over which steps may leap."""
        return None

    def kicks(self, low: float, high: float, step: float) -> list[Any]:
        """The impulses within two times, in their order; `step` as of `jump_times`."""
        return []

    def has_period(self, period: float) -> bool | None:
        """Return True if H, up to a function of t alone, has a period in t; None where its values are to be tried."""
        return None

    def place(self, y0: Any, domain: Any, inverse_mass: np.ndarray | None, t_span: tuple[float, float]) -> None:
        """Take the scene of the system, at whose states functions are traced."""

    def check_unchanged(self) -> None:
        """Raise a ValueError if a function has another value than when it was traced."""

    def check(self, states: np.ndarray, like: Array, n_given: int, times: Sequence[float] = ()) -> None:
        """Test the functions of a user at states (n, 2d): see `sympflow.hamiltonian.function_checks`."""

    def learns(self, y: Array) -> bool:
        """Return True if torch follows numbers within the functions at the states y (..., 2d), such as weights."""
        return False

    def potential_hessian(self, q: Array, *t: Array) -> Array:
        """∇²V(q): (..., d) to (..., d, d)."""
        raise NotImplementedError(f"{type(self).__name__} must define potential_hessian().")

    def hessian_vector(self, q: Array, v: Array, *t: Array) -> Array:
        """∇²V(q)·v: (..., d), each, to (..., d)."""
        return (self.potential_hessian(q, *t) @ v[..., None])[..., 0]

    def leapt(self, starts: np.ndarray, ends: np.ndarray, n_steps: int | np.ndarray, conserves: bool) -> np.ndarray:
        """Return True for each run of steps from states (n, 2d) to others that leapt over an infinite V: (n,)."""
        raise NotImplementedError(f"{type(self).__name__} must define leapt().")

    def leap(self, y: np.ndarray, start: np.ndarray) -> str:
        """Remark on a state (2d,) of a run from a start (2d,) that leapt over such a place: a clause."""
        raise NotImplementedError(f"{type(self).__name__} must define leap().")

    def remark(self, q: np.ndarray) -> str:
        """Remark on the last positions (d,) of a run that could not go on: a clause, or nothing."""
        return ""

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        """∇³V(q)(v, w): (..., d), each, to (..., d)."""
        raise NotImplementedError(f"{type(self).__name__} must define third_derivative().")
