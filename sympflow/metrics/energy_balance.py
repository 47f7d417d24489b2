"""The energy balance of driven systems: H(t, x) against the work of the drive, ∫ ∂H/∂t dt, of the run as executed."""

from __future__ import annotations

from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.lazy import kept
from sympflow.metrics.energy import of_groups
from sympflow.solution import Solution
from sympflow.solver import solve

__all__ = ["energy_balance_error"]

NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)
"""Gauss–Legendre quadrature of the integral over a step, where the method cannot run on the extended system."""


@of_groups
def energy_balance_error(sol: Solution, relative: bool = False) -> np.ndarray:
    """|H(t, x) − H(t0, x0) − ∫ ∂H/∂t dt| at the times `sol.t`: (..., n), in float64.

    The integral is computed by the method itself: −E, the momentum of the time in the extended system
    E + H(t, x), which is autonomous. Its energy E + H is nearly conserved by a symplectic method in the long run. A
    kick by b h V(q, t) at its fixed time t adds b h ∂V/∂t to the integral, force gradients add the derivative of their
    term; Runge–Kutta and implicit methods take ∂H/∂t at their stages, by their weights. For this the run is repeated,
    compiled if it was, with E as an additional momentum; it needs memory for the outputs only. Methods that choose
    their steps then control the error of E too.

    For systems without symbols, T(p, t) in splitting methods, splittings other than "kinetic", and trained flows that
    are not primed, it is the integral of ∂H/∂t along the steps as executed, by Gauss–Legendre quadrature of 6 nodes
    within each.

    Parameters
    ----------
    sol : Solution
    relative : bool
        True to divide by the system's `energy_scale`, else the largest |H| of the trajectory.

    Raises
    ------
    TypeError
        If `sol` is not a Solution.
    ValueError
        For a system with friction, whose losses are not part of the balance; for one whose H jumps in t, where there
        is no ∂H/∂t.

    References
    ----------
    .. [1] E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. (Springer 2006), VI.10 and IX.3.
    """
    sol.system.check_conservative(
        "so that its energy is also lost to friction", "use sympflow.reference_error(sol), or solve it without damping"
    )
    sol.system.check_impulses("at which its energy jumps", "use sympflow.reference_error(sol)")
    if not kept_by(sol.system):
        raise ValueError(
            f"`sol` is of {sol.system.name!r}, whose H jumps at some times, where ∂H/∂t is not finite: use "
            "sympflow.reference_error(sol), sympflow.symplecticity_defect(sol)."
        )
    with np.errstate(all="ignore"):
        H, work = _balanced(sol)
        start = np.asarray(sol.system.hamiltonian(to_numpy(sol.y0).astype(float), sol.t_span[0]))
        error = np.abs((H - start[..., None]) - work)
        if relative:
            error = error / (sol.system.energy_scale or np.nanmax(np.abs(H), axis=-1, keepdims=True))
    return np.where(np.isnan(error) & np.isfinite(H), np.inf, error)


def kept_by(system: HamiltonianSystem) -> str:
    """The conserved quantity of a system: its "energy", or the "balance" of a drive, or "" for none."""
    if system.keeps_energy:
        return "energy"
    return "balance" if system.conservative and not system.definition.jumps else ""


def _balanced(sol: Solution) -> tuple[np.ndarray, np.ndarray]:
    """H and ∫ ∂H/∂t dt at the outputs, (..., n) each."""
    system = sol.system
    y = to_numpy(sol.states).astype(float)  # (..., n, 2d)
    H = np.asarray(system.hamiltonian(y, np.broadcast_to(sol.t, y.shape[:-1])))
    if system.keeps_energy:
        return H, np.zeros(H.shape)
    extended = None if system.definition.may_jump else extended_system(system)  # whose steps meet no kinks
    integrator = None if extended is None else sol.integrator.on_extended(system, extended)
    if extended is None or integrator is None:
        return H, _quadrature(sol)
    y0, d = to_numpy(sol.y0).astype(float), system.ndof
    zero = np.zeros((*y0.shape[:-1], 1))
    start = np.concatenate([y0[..., :d], zero, y0[..., d:], zero], axis=-1)
    run = solve(extended, integrator, sol.t_span, start, t_eval=sol.t)
    states = np.moveaxis(run.y, -2, -1)
    n, own = len(run.t), [i for i in range(2 * d + 2) if i not in (d, 2 * d + 1)]
    H[..., :n] = system.hamiltonian(states[..., own], np.broadcast_to(run.t, states.shape[:-1]))
    work = np.full(H.shape, np.nan)
    work[..., :n] = -states[..., -1]
    return H, work


@kept
def extended_system(system: HamiltonianSystem) -> HamiltonianSystem | None:
    """H(t + s, q, p) in [q, s, p, E], in which s stays 0 and E' = −∂H/∂t; None where it cannot be written so."""
    symbols = system.symbols
    if symbols is None or symbols.samples or system.kinetic_timed:
        return None
    d, time = system.ndof, symbols.time
    s = type(time)(f"q{d + 1}", real=True)
    H, values = symbols.written
    return HamiltonianSystem.from_sympy(
        H.xreplace({time: time + s}),
        params={symbol.name: system.params[symbol.name] for symbol in values},
        time=time,
        name=f"{system.name} with the work of the drive",
        y0=np.zeros(2 * d + 2),
        t_span=system.t_span,
        dt=system.dt,
    )


def _quadrature(sol: Solution) -> np.ndarray:
    """∫ ∂H/∂t dt along the executed steps, at the outputs."""
    system = sol.system
    integrator = sol.integrator
    batch = to_numpy(sol.y0).shape[:-1]
    direction = 1 if sol.t_span[1] >= sol.t_span[0] else -1
    work, total, done = np.zeros((len(sol.t), *batch)), np.zeros(batch), 0
    for times, states, lengths in integrator.steps(system, sol.t_span, sol.y0):
        y = to_numpy(states).astype(float)
        t, h = (np.broadcast_to(x.reshape(-1, *[1] * len(batch)), y.shape[:-1]) for x in (times, lengths))
        running = total + np.concatenate([np.zeros((1, *batch)), np.cumsum(_along(sol, t, y, h), axis=0)])
        ends = times + lengths
        due = done + int(np.searchsorted(direction * sol.t[done:], direction * ends[-1], side="right"))
        if due > done:
            index = np.clip(np.searchsorted(direction * times, direction * sol.t[done:due], "right") - 1, 0, None)
            rest = (sol.t[done:due] - times[index]).reshape(-1, *[1] * len(batch))
            work[done:due] = running[index] + _along(sol, t[index], y[index], np.broadcast_to(rest, t[index].shape))
        total, done = running[-1], due
    work[done:] = total
    return np.moveaxis(work, 0, -1)


def _along(sol: Solution, t: Any, y: np.ndarray, h: np.ndarray) -> np.ndarray:
    """∫ ∂H/∂t over steps of lengths h (n, ...) from the states y (n, ..., 2d)."""
    total = np.zeros(h.shape)
    for c, weight in zip((1 + NODES) / 2, WEIGHTS / 2, strict=True):
        state = to_numpy(sol.integrator.step(sol.system, t, y, c * h))
        total += weight * h * np.asarray(sol.system.time_derivative(state, t + c * h))
    return total
