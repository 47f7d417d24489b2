"""The logarithmic Hamiltonian: a system in a new time that runs with the strength of its forces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sympflow.arguments import real_number
from sympflow.arrays import Array, concatenate, library
from sympflow.arrays import like as as_like
from sympflow.hamiltonian.definition import Definition
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem, Parameters, Scene
from sympflow.lazy import lately_kept

LARGEST_SHIFT = 1e100


def time_transformed(
    system: HamiltonianSystem, shift: float | None = None, domain: Domain | None = None
) -> HamiltonianSystem:
    """The logarithmic Hamiltonian of a separable system, with the physical time t as one more coordinate.

    Λ(q, t, p, B) = log(T(p) + B) − log(c − V(q)), in a new time s. B, conjugate to t, is constant; from a state with
    B = c − H(q, p), Λ is 0 and its flow runs along the solutions of the system with dt/ds = 1/(c − V(q)): slowly where
    the force is strong. Λ is separable, so splitting methods apply to it, and the leapfrog follows a Kepler ellipse
    exactly, with an error in the time alone.

    Parameters
    ----------
    system : HamiltonianSystem
        Separable.
    shift : float, optional
        c, larger than V along the motion, as every number above the energy is. The default is `default_shift(system)`.
    domain : Domain, optional
        Ω of the new system, for `train`: a set of states [q, t, p, B], such as ``Tube(sol.states, radius)`` around a
        solution of the new system.

    Returns
    -------
    HamiltonianSystem
        Of d + 1 degrees of freedom and states [q, t, p, B], to be solved, trained and compared like any other; its
        independent variable is s, and ``sol.y[d]`` is the physical time. Its y0, t_span and dt correspond to the
        system's. The methods "log_leapfrog", "log_blanes_moan4" and "log_kahan_li8" solve it in the physical time.

    Raises
    ------
    ValueError
        If the system is not separable, or has friction; if `shift` is not finite, or not above V at the system's y0.

    References
    ----------
    .. [1] S. Mikkola, K. Tanikawa, "Explicit symplectic algorithms for time-transformed Hamiltonians", Celest. Mech.
       Dyn. Astron. 74 (1999) 287–295.
    .. [2] M. Preto, S. Tremaine, "A class of symplectic integrators with adaptive time step for separable Hamiltonian
       systems", Astron. J. 118 (1999) 2532–2541.
    .. [3] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006), VIII.2.

    Examples
    --------
    >>> import sympflow
    >>> stretched = time_transformed(sympflow.systems.kepler(0.9))
    >>> sol = sympflow.solve(stretched, "leapfrog")
    >>> bool(sol.y[2, -1] > 600)  # the physical time
    True
    """
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    system.check_conservative(
        "and no Hamiltonian in another time", "solve it in the physical time, by 'verlet' or 'dop853' for instance"
    )
    system.check_autonomous(
        "and a time transformation needs an energy E that is constant",
        "solve it in the physical time, by 'kahan_li8' or 'dop853' for instance",
    )
    if not system.separable:
        raise ValueError(
            f"`system` {system.name!r} is not separable, so its logarithmic Hamiltonian is not either: use an implicit "
            "method such as 'gauss_legendre4'."
        )
    c = default_shift(system) if shift is None else checked_shift(shift)
    symbols = system.written if system.local is None else system.local.spelled  # with all terms one by one
    name = system.scene.name and f"log_{system.name}"
    if symbols is not None:
        import sympy as sp

        from sympflow.hamiltonian.removable import exact

        H = sp.log(symbols.T + sp.Symbol(f"p{symbols.ndof + 1}", real=True)) - sp.log(exact(c) - symbols.V)
        transformed = HamiltonianSystem.from_sympy(H, name=name, energy_scale=1.0)
        transformed._params = Parameters({**system.params, "shift": c})
    else:
        transformed = HamiltonianSystem.__new__(HamiltonianSystem)
        scene = Scene(name, dt=0.05, energy_scale=1.0)
        transformed._make(_Logarithmic(system, c), None, False, {**system.params, "shift": c}, scene)
    if system.y0 is None:
        return transformed.with_scene(domain=domain)
    scale = time_scale(system, c)
    span = (0.0, (system.t_span[1] - system.t_span[0]) * scale)
    return transformed.with_scene(domain=domain, y0=lifted(system, system.y0, c), dt=system.dt * scale, t_span=span)


def default_shift(system: HamiltonianSystem) -> float:
    """c = E + |E| with the energy E of the system's y0: 0 for a bound system whose V vanishes far out, else 2E."""
    E = 0.0 if system.y0 is None else _energy(system, system.y0.tobytes())
    return E + abs(E) if math.isfinite(E) else 0.0


@lately_kept
def _energy(system: HamiltonianSystem, y0: bytes) -> float:
    """H at the system's y0, kept: every run asks for it several times."""
    return float(system.hamiltonian(np.frombuffer(y0).copy()))


def checked_shift(shift: Any) -> float:
    """The shift as a float; beside one of 1e16 times the energies these would be lost already."""
    if type(shift) is float and abs(shift) <= LARGEST_SHIFT:
        return shift
    if not real_number(shift) or not abs(shift) <= LARGEST_SHIFT:
        raise ValueError(
            f"`shift` must be a finite number, above the energy and at most {LARGEST_SHIFT:g}; got {shift!r}."
        )
    return float(shift)


def time_scale(system: HamiltonianSystem, c: float) -> float:
    """ds/dt where the kinetic energy equals B = c − E, at the energy E of the system's y0: 2B."""
    if system.y0 is None:
        return 1.0
    B = c - _energy(system, system.y0.tobytes())
    scale = 2 * B if B > 0 else c - float(system.potential(system.y0[: system.ndof]))
    if not scale > 0:
        raise ValueError(
            f"`shift` {c:g} does not exceed the potential at y0 of {system.name!r}: give one above the energy."
        )
    return scale


def lifted(system: HamiltonianSystem, y: Array, c: float, B: Array | None = None) -> Array:
    """States [q, t, p, B] (..., 2d + 2) of states [q, p] (..., 2d), with t = 0 and B = c − H unless it is given."""
    d = system.ndof
    B = c - system.hamiltonian(y) if B is None else B
    return concatenate([y[..., :d], 0 * y[..., :1], y[..., d:], B[..., None]])


def projected(x: Array) -> Array:
    """[q, p] of states [q, t, p, B]."""
    d = x.shape[-1] // 2 - 1
    return concatenate([x[..., :d], x[..., d + 1 : -1]])


class _Logarithmic(Definition):
    """log(T(p) + B) and −log(c − V(q)), with derivatives, for a system that is given by functions."""

    separable = True

    def __init__(self, system: HamiltonianSystem, c: float) -> None:
        self.ndof, self._system, self._c = system.ndof + 1, system, c
        self.given = system.functions_given

    def check(self, states: np.ndarray, like: Array, n_given: int, times: Sequence[float] = ()) -> None:
        self._system.check_functions(projected(as_like(states[:n_given], like)) if n_given else None)

    def kinetic(self, P: Array) -> Array:
        return library(P).log(self._system.kinetic(P[..., :-1]) + P[..., -1])

    def kinetic_gradient(self, P: Array) -> Array:
        p, B = P[..., :-1], P[..., -1:]
        weight = 1 / (self._system.kinetic(p)[..., None] + B)
        return concatenate([weight * self._system.velocity(p), weight])

    def kinetic_hessian(self, P: Array) -> Array:
        p = P[..., :-1]
        weight = (1 / (self._system.kinetic(p) + P[..., -1]))[..., None, None]
        g = self.kinetic_gradient(P)
        return _bordered(weight * (self._system.kinetic_hessian(p) + 0 * weight)) - g[..., :, None] * g[..., None, :]

    def potential(self, Q: Array) -> Array:
        return -library(Q).log(self._c - self._system.potential(Q[..., :-1]))

    def potential_gradient(self, Q: Array) -> Array:
        q = Q[..., :-1]
        slope = -self._system.force(q) / (self._c - self._system.potential(q))[..., None]
        return concatenate([slope, 0 * Q[..., -1:]])

    def potential_hessian(self, Q: Array) -> Array:
        q = Q[..., :-1]
        weight = (1 / (self._c - self._system.potential(q)))[..., None, None]
        g = self.potential_gradient(Q)
        return _bordered(weight * self._system.potential_hessian(q)) + g[..., :, None] * g[..., None, :]


def _bordered(S: Array) -> Array:
    """S (..., d, d) with a row and a column of zeros added."""
    wide = concatenate([S, 0 * S[..., :1]])
    return concatenate([wide, 0 * wide[..., :1, :]], -2)
