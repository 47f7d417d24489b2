"""Any force, not only those of a Hamiltonian: Galley's doubling of the variables.

The motion q' = ∂H/∂p, p' = −∂H/∂q + F(q, p) has no Hamiltonian in general, but two copies of the system have one. In
the mean of the copies and their difference, q₊, p₊ and q₋, p₋, it is

    A = p₋·∂H/∂p(q₊, p₊) + q₋·(∂H/∂q(q₊, p₊) − F(q₊, p₊)),

with positions (q₊, q₋) and momenta (p₋, p₊), in this order: the partner of q₊ is p₋. These are H(1) − H(2) − K of the
copies with K = q₋·F, to first order in the difference, which is all that the physical limit q₋ = p₋ = 0 keeps. There
(q₊, p₊) moves as above, and the difference stays 0.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sympflow.arguments import warn
from sympflow.arrays import Array, as_tensor, concatenate, jacobian, library_name, of_library
from sympflow.hamiltonian.domain import Box, Domain
from sympflow.hamiltonian.system import HamiltonianSystem

Force = Callable[[Array, Array], Array]
THIN = 0.1  # width of the default domain in q₋ and p₋, over that in q and p
_DRAWN = 1000  # states that find the extent of a domain


class DoubledSystem(HamiltonianSystem):
    """A Hamiltonian system in twice the variables whose physical limit has friction and any other force: see `doubled`.

    `physical` is the system of the limit, with F as its `external_force`, which Runge–Kutta methods integrate as it is.
    """

    _continuous = False
    shows_energy = False
    physical: HamiltonianSystem

    def as_doubled(self) -> DoubledSystem:
        return self

    def lift(self, y: Array) -> Array:
        """[q, 0, 0, p], the state for a physical state y = [q, p]: (..., 2d) to (..., 4d)."""
        d = self.ndof // 2
        if y.ndim == 0 or y.shape[-1] != 2 * d:
            raise ValueError(
                f"`y0` must have shape (..., {2 * d}) for {self.name!r}, a physical state [q, p] with {d} each, or "
                f"(..., {4 * d}), [q₊, q₋, p₋, p₊]; got {tuple(y.shape)}."
            )
        return concatenate([y[..., :d], 0 * y[..., :d], 0 * y[..., d:], y[..., d:]])

    def physical_limit(self, y: Array) -> Array:
        """[q₊, p₊] of states [q₊, q₋, p₋, p₊]: (..., 4d) to (..., 2d)."""
        d = self.ndof // 2
        return concatenate([y[..., :d], y[..., 3 * d :]])

    def difference(self, y: Array) -> Array:
        """[q₋, p₋] of states [q₊, q₋, p₋, p₊], 0 in the physical limit: (..., 4d) to (..., 2d)."""
        d = self.ndof // 2
        return y[..., d : 3 * d]


def doubled(
    system: HamiltonianSystem,
    force: Any = None,
    *,
    params: Mapping[str, float] | None = None,
    domain: Domain | None = None,
    name: str | None = None,
) -> DoubledSystem:
    """The Hamiltonian system in twice the variables whose physical limit is q' = ∂H/∂p, p' = −∂H/∂q − Γp + F(q, p).

    Its states are [q₊, q₋, p₋, p₊], of 4d numbers: the mean and the difference of two copies of the system, p₋ being
    the momentum of q₊, and p₊ that of q₋. A physical state [q, p] is [q, 0, 0, p]; `solve` lifts a `y0` of 2d numbers
    itself, and `Solution.physical()` converts back. See `sympflow.hamiltonian.doubling` for H.

    H is linear in q₋ and p₋. So if they are 0 they stay 0 exactly, with every Runge–Kutta, implicit and splitting
    method; and for any values of them (q₊, p₊) obeys the physical equations. It is separable, so that splitting methods
    apply, if the system is and F depends on q alone.

    Parameters
    ----------
    system : HamiltonianSystem
        A system of d degrees of freedom; its damping, −Γp, is included.
    force : str, sympy.Expr, a list of d of these, or callable
        F in q1 … qd, p1 … pd (or q and p), one expression for each momentum: "-c*p*abs(p)", or
        ["-c*p1/(q1**2 + q2**2)", "-c*p2/(q1**2 + q2**2)"]; or F(q, p) written with torch functions, (..., d), each, to
        (..., d), with which the system is not compiled. The default is 0, for a system with damping.
    params : mapping of str to float, optional
        Values of the other symbols of F; those of `system.params` are known.
    domain : Domain, optional
        Ω of states [q₊, q₋, p₋, p₊]. The default is a box about the domain of the system, a tenth as wide in q₋ and p₋.
    name : str, optional

    Returns
    -------
    DoubledSystem
        Of 2d degrees of freedom, with `lift`, `physical_limit`, `difference` and `physical`, the system of the limit.

    Raises
    ------
    TypeError
        If `system` is not a HamiltonianSystem, or `force` is neither text, expression nor function.
    ValueError
        If `force` has another number of components, cannot be parsed, or holds symbols without values.

    Warns
    -----
    UserWarning
        If the force derives from a potential: add that to H instead.

    References
    ----------
    .. [1] C. R. Galley, "Classical mechanics of nonconservative systems", Phys. Rev. Lett. 110 (2013) 174301.
    .. [2] D. Tsang, C. R. Galley, L. C. Stein, A. Turner, Astrophys. J. Lett. 809 (2015) L9.

    Examples
    --------
    >>> import sympflow
    >>> fall = sympflow.HamiltonianSystem.from_sympy("p**2/2 + q", y0=[0.0, 0.0])
    >>> sol = sympflow.solve(sympflow.doubled(fall, "-p*abs(p)"), "gauss_legendre6", (0, 10), dt=0.1)
    >>> round(float(sol.physical().y[1, -1]), 6)
    -1.0
    """
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    if isinstance(system, DoubledSystem) or system.external_force is not None:
        raise TypeError(f"`system` {system.name!r} is of a doubling: add the forces, and double what was doubled.")
    if force is None and system.conservative:
        raise TypeError("`force` is needed: a system without friction is Hamiltonian as it is.")
    named = (system.scene.name and f"{system.name}_doubled") if name is None else name
    scene: dict[str, Any] = {"name": named, "t_span": system.t_span, "dt": system.dt}
    scene["domain"] = _thin_box(system) if domain is None else domain
    scene["energy_scale"] = _energy_scale(system)
    made: DoubledSystem
    sympy = sys.modules.get("sympy")
    given = callable(force) and not (sympy is not None and isinstance(force, sympy.Basic))  # a Symbol is callable
    if given or system.symbols is None or system.symbols.samples:
        system.check_autonomous(
            "by functions of t, or samples, or with a force by a function, which are not doubled",
            "give H and the force by symbols, with the time named, or solve system.vector_field by 'dop853'",
        )
    if given and params is not None:
        raise TypeError("`params` are for a `force` by symbols: write their values into the function.")
    if given or system.symbols is None:
        if not given and force is not None:
            raise TypeError(
                f"`force` is given by symbols, but `system` {system.name!r} by functions: give it as a function "
                "F(q, p), written with torch."
            )
        F: Any = GivenForce(force if given else lambda q, p: 0 * p)
        made = DoubledSystem(hamiltonian=_DoubledFunctions(system, F), ndof=2 * system.ndof, check=False, **scene)
    else:
        from sympflow.hamiltonian.symbolic import SymbolicForce, doubled_hamiltonian

        F = SymbolicForce(system, [0] * system.ndof if force is None else force, params)
        if system.conservative and F.has_potential:
            warn(
                "`force` derives from a potential, so that an energy is kept: put it into H, and solve that system.",
                UserWarning,
            )
        time = None if system.symbols.time is None else {"time": system.symbols.time, "period": system.period}
        made = DoubledSystem.from_sympy(doubled_hamiltonian(system, F), **scene, **(time or {}))  # type: ignore[assignment]
    made.physical = system if force is None else system.with_force(F)
    return made if system.y0 is None else made.with_scene(y0=made.lift(system.y0))  # type: ignore[return-value]


class GivenForce:
    """F(q, p) of a user, written with torch functions."""

    expressions: Sequence[Any] = ()

    def __init__(self, force: Force) -> None:
        self.force = force

    def __call__(self, q: Array, p: Array, *t: Any) -> Array:
        value = self.force(as_tensor(q), as_tensor(p))
        got = tuple(value.shape) if library_name(value) == "torch" else type(value).__name__
        if got != tuple(p.shape):
            raise ValueError(
                f"`force` must return a tensor of the shape of p, {tuple(p.shape)}; got {got}: write it with torch "
                "functions, for states on the last axis."
            )
        return of_library(value, p)

    def jacobian(self, q: Array, p: Array, *t: Any) -> Array:
        d, x = p.shape[-1], as_tensor(concatenate([q, p]))
        return of_library(jacobian(lambda z: self(z[..., :d], z[..., d:]), x)[1], p)


class _DoubledFunctions:
    """A of a system that is given by functions, or has a force that is."""

    def __init__(self, system: HamiltonianSystem, force: Any) -> None:
        self.system, self.force = system, force

    def __call__(self, Q: Array, P: Array) -> Array:
        d = self.system.ndof
        q, p = Q[..., :d], P[..., d:]
        field = self.system.vector_field(concatenate([q, p]))
        slope = -field[..., d:] - self.force(q, p)
        return (P[..., :d] * field[..., :d]).sum(-1) + (Q[..., d:] * slope).sum(-1)


def _energy_scale(system: HamiltonianSystem) -> float | None:
    """The energy of the physical system, for that of the doubled one is 0."""
    if system.energy_scale is not None or system.y0 is None:
        return system.energy_scale
    with np.errstate(all="ignore"):
        size = float(abs(system.hamiltonian(system.y0, system.t_span[0])))
    return size if np.finfo(float).tiny < size < np.inf else None


def _thin_box(system: HamiltonianSystem) -> Box | None:
    """The box about the domain of a system, and about q₋ and p₋ of a tenth of its widths."""
    if system.domain is None:
        return None
    d, x = system.ndof, system.domain.sample(_DRAWN, 0)
    low, high = x.min(0), x.max(0)
    thin = THIN * np.maximum((high - low) / 2, np.finfo(float).tiny)
    low, high = (np.concatenate([b[:d], s * thin, b[d:]]) for b, s in ((low, -1), (high, 1)))
    return Box(low, high)
