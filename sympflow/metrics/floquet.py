"""Floquet multipliers: how small deviations from a periodic orbit grow in a period.

The Jacobian M of the flow over one period, along a periodic orbit, is the *monodromy matrix*; its eigenvalues are the
multipliers. Here M is the product of the Jacobians of the steps that a method really makes, so that it is exact for
that method. For a symplectic step the multipliers come in pairs λ, 1/λ; with the friction −γp in pairs λ, e^{−γT}/λ.

References
----------
.. [1] V. A. Yakubovich, V. M. Starzhinskii, *Linear Differential Equations with Periodic Coefficients*, Wiley 1975.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_positive, checked_number, warn
from sympflow.arrays import to_numpy
from sympflow.hamiltonian.scales import weights
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.metrics.crossings import dividing_step
from sympflow.metrics.orbits import checked_orbits
from sympflow.solver import solve
from sympflow.systems.given import GivenSystem, given_system

GROWS = 1e-5  # excess of a multiplier over 1 that is more than the rounding of a double eigenvalue, √ε
UNPAIRED = 1e-3  # a worse pairing of the multipliers than this is warned of
CLOSED = 1e-6
"""Distance of the end of a period from its start, over the size of y0, up to which an orbit is periodic.

Of q and p in comparable units; the size is at least that of the system's own y0, as an equilibrium may be at 0."""


@dataclass(frozen=True)
class FloquetMultipliers:
    """The multipliers of a periodic orbit.

    Attributes
    ----------
    multipliers : ndarray (2d,), complex
        The largest magnitudes first.
    monodromy : ndarray (2d, 2d)
        M, whose eigenvalues they are.
    period : float
    mismatch : float
        |y(t0 + T) − y0|: 0 of an orbit that is periodic.
    pairing : float
        ‖MᵀJM − e^{−γT}J‖₂/‖M‖₂², in comparable units of q and p; 0 where the multipliers are in pairs λ, e^{−γT}/λ. NaN
        where friction is not a single rate, or a force does not come from H.
    """

    multipliers: np.ndarray
    monodromy: np.ndarray = field(repr=False)
    period: float
    mismatch: float
    pairing: float

    @property
    def stable(self) -> bool:
        """True if no multiplier is larger than 1."""
        return bool(np.abs(self.multipliers[0]) <= 1 + GROWS)

    @property
    def exponents(self) -> np.ndarray:
        """The Floquet exponents log(λ)/T, (2d,), their imaginary parts within ±π/T."""
        return np.log(self.multipliers) / self.period


def floquet_multipliers(
    system: GivenSystem,
    y0: ArrayLike | None = None,
    *,
    period: float | None = None,
    method: Any = "kahan_li8",
    t0: float = 0.0,
    **options: Any,
) -> FloquetMultipliers:
    """The Floquet multipliers of the periodic orbit from y0, by the Jacobians of the steps of a method.

    Parameters
    ----------
    system : HamiltonianSystem
    y0 : array_like of shape (2d,), optional
        A state of the orbit at the time t0; the default is the system's. An equilibrium is periodic too.
    period : float, optional
        T; the default is that of a driven system. A fixed step `dt` need not divide it.
    method : str, Integrator or trained flow
    t0 : float
        The start of the period, for a driven system; the multipliers do not depend on it.
    **options
        Options of the method, such as `dt`; by default the largest below `system.dt` that divides the period.

    Returns
    -------
    FloquetMultipliers

    Raises
    ------
    ValueError, TypeError
        For bad arguments; if no period is known; if y0 is a batch; if the run of a period fails; if the method chooses
        its steps, because it does so by the error of the orbit and not of deviations from it.

    Warns
    -----
    RuntimeWarning
        If the orbit is not periodic: its end is farther than 1e-6 of its size from y0; and if the multipliers are not
        in pairs, to 1e-3, as by an explicit Runge–Kutta method with long steps. The eigenvalues are then unreliable.

    Examples
    --------
    >>> import math, sympflow
    >>> found = floquet_multipliers(sympflow.systems.harmonic_oscillator(), period=math.pi, y0=[0.0, 0.0], dt=0.1)
    >>> bool(abs(found.multipliers + 1).max() < 1e-6)
    True
    """
    system = given_system(system)
    T = system.period if period is None else period
    if T is None:
        raise ValueError(f"`period` is needed: the system {system.name!r} has none of its own.")
    check_positive("period", T)
    checked_number("t0", t0)
    system, integrator, t_span, start = checked_orbits(system, method, (t0, t0 + T), y0, options, "multipliers are of")
    if start.ndim != 1:
        raise ValueError(f"`y0` must be one state, of shape ({2 * system.ndof},); got {start.shape}.")
    if isinstance(integrator, FixedStep) and integrator.dt is None and integrator.step_length(system) == system.dt:
        integrator = replace(integrator, dt=dividing_step(T, system.dt))
    if not (integrator.on_grid or integrator.keeps):
        raise ValueError(
            f"`method` {integrator.name!r} chooses its steps by the error of the orbit, which says nothing of that of "
            "deviations from it: use a method of fixed steps such as 'kahan_li8', or 'rk4' where forces depend on p."
        )
    if integrator.keeps:
        raise ValueError(
            f"`method` {integrator.name!r} keeps {integrator.keeps}, so that its Jacobians are not those of states: "
            "use a splitting method such as 'kahan_li8', or an implicit one such as 'gauss_legendre6'."
        )
    end = solve(system, integrator, t_span, start, t_eval=[t_span[1]]).raise_for_status().y[:, -1]
    mismatch = float(np.linalg.norm(to_numpy(end) - start))
    scale = weights(system)
    sizes = [float(np.abs(scale * y).max()) for y in (start, system.y0) if y is not None]
    if not np.linalg.norm(scale * (to_numpy(end) - start)) <= CLOSED * (max(sizes) or 1.0):
        warn(
            f"The orbit is not periodic: after {T:g} it is {mismatch:.3g} from `y0`. Start from a state of a periodic "
            "orbit, its period, or a smaller `dt`.",
            RuntimeWarning,
        )
    M = np.eye(len(start))
    for _, _, jacobians in integrator.executed(system, t_span, start):
        for A in jacobians:
            M = A @ M
    found = np.linalg.eigvals(M)
    found = found[np.argsort(-np.abs(found), kind="stable")].astype(complex)
    pairing = _pairing(system, scale[:, None] * M / scale, float(T))
    if pairing > UNPAIRED:
        warn(
            f"The multipliers are not in pairs, to {pairing:.2g}: steps of {integrator.name!r} are too long for "
            "deviations from the orbit. Use a splitting method such as 'kahan_li8', or a smaller `dt`.",
            RuntimeWarning,
        )
    return FloquetMultipliers(found, M, float(T), mismatch, pairing)


def _pairing(system: HamiltonianSystem, M: np.ndarray, T: float) -> float:
    """The defect of the form that M keeps, or shrinks: see `FloquetMultipliers`."""
    friction = system.friction
    if system.external_force is not None or not friction.isotropic:
        return math.nan
    rate, d = friction.largest, system.ndof
    J = np.block([[np.zeros((d, d)), np.eye(d)], [-np.eye(d), np.zeros((d, d))]])
    return float(np.linalg.norm(M.T @ J @ M - math.exp(-rate * T) * J, 2) / np.linalg.norm(M, 2) ** 2)
