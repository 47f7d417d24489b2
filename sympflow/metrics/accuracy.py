"""Accuracy: the distance from the true solution, and from the start after going there and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import Array, masked, to_numpy
from sympflow.hamiltonian.scales import distance, weights
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.energy import failed, of_groups
from sympflow.metrics.reference import Reference
from sympflow.metrics.reference import reference as compute_reference
from sympflow.solution import Solution, check_solution, gathered
from sympflow.solver import solve


def reference_error(sol: Solution, reference: Reference | Solution | ArrayLike | None = None) -> np.ndarray:
    """‖y(t) − y_ref(t)‖₂ at the times `sol.t`, in units of q: (..., n).

    Each momentum counts as its amplitude in q, pᵢ/sᵢ², where s² = mω is the system's natural scale, 1 for an oscillator
    with m = ω = 1: so the ranking of methods does not depend on units.

    Parameters
    ----------
    sol : Solution
    reference : Reference, Solution or array_like (..., 2d, n), optional
        States at the same times. The default computes them with `sympflow.metrics.reference.reference`, which is exact
        for a quadratic H and otherwise has attributes for its method and its accuracy.

    Raises
    ------
    TypeError
        If `sol` is not a Solution, or `reference` does not hold states.
    ValueError
        If the reference is not at the times of the solution, or is a solution of another problem.
    """
    check_solution(sol)
    if sol.varied and reference is None:
        return gathered(sol, reference_error)
    if reference is not None and not sol.varied:
        check_problem(reference, sol.system, sol.t_span[0], to_numpy(sol.y0))
    y = to_numpy(sol.y).astype(float)
    if reference is None:
        reference = compute_reference(sol.system, sol.t_span, to_numpy(sol.y0), sol.t)
    if isinstance(reference, Reference | Solution):
        if len(reference.t) < len(sol.t) or not np.allclose(reference.t[: len(sol.t)], sol.t, rtol=1e-12, atol=0):
            raise ValueError("`reference` must be at the times of `sol`: solve both with the same `t_eval`.")
        reference = reference.y[..., : len(sol.t)]
    y_ref = states_of(reference)
    if y_ref.shape != y.shape:
        raise ValueError(f"`reference` must have the shape {y.shape} of `sol.y`; got {y_ref.shape}.")
    with np.errstate(all="ignore"):
        return distance(sol.system, y - y_ref, axis=-2)


OTHER_ENERGY = 1e-2  # of the energy's scale: what no reference of a problem is off by
SAMPLED = 32  # states at which vector fields are compared


def check_problem(reference: object, system: HamiltonianSystem, t0: float, y0: np.ndarray) -> None:
    """Raise a ValueError if a reference belongs to another problem: another system, another y0, another energy.

    A Solution has its system, whose vector field is compared along it, and its y0. Of states alone the energy is all
    that can be looked at, where it is kept.
    """
    if isinstance(reference, Solution):
        if reference.system is not system and not _same_field(reference, system):
            raise ValueError(
                f"`reference` is a solution of another system, {reference.system.name!r}: pass one of {system.name!r}."
            )
        start = to_numpy(reference.y0)
        eps = max(1e-12, *(4 * float(np.finfo(y.dtype).eps) for y in (start, y0)))
        scale = weights(system)
        same = start.shape == y0.shape and np.abs(scale * (start - y0)).max() <= eps * np.abs(scale * y0).max()
        if reference.t_span[0] == t0 and not same:
            raise ValueError("`reference` is a solution from another `y0`: solve from the one that is compared.")
        return
    states = states_of(reference.y if isinstance(reference, Reference) else reference)
    if states.shape[:-1] != y0.shape or not system.keeps_energy:
        return  # the shape is refused where it is needed
    with np.errstate(all="ignore"):
        H0, H = to_numpy(system.hamiltonian(y0)), to_numpy(system.hamiltonian(np.moveaxis(states, -1, 0)))
        scale = np.maximum(np.abs(H0), np.abs(y0 * to_numpy(system.gradient(y0))).sum(-1))
        off = np.abs(H - H0).max(0) > OTHER_ENERGY * scale
    if np.all(off):
        raise ValueError("`reference` has another energy than `y0`: it does not solve this problem from there.")


def _same_field(sol: Solution, system: HamiltonianSystem) -> bool:
    """True if the vector fields agree along a solution."""
    if sol.system.ndof != system.ndof:
        return False
    y = to_numpy(sol.y).astype(float)
    states = np.moveaxis(y, -2, -1).reshape(-1, y.shape[-2])
    every = max(1, len(states) // SAMPLED)
    t = np.broadcast_to(sol.t, (*y.shape[:-2], len(sol.t))).reshape(-1)[::every]
    states = states[::every]
    with np.errstate(all="ignore"):
        mine, other = (to_numpy(s.vector_field(states, t)) for s in (system, sol.system))
    scale = weights(system)
    mine, other = scale * mine, scale * other
    size = np.abs(other[np.isfinite(other)]).max(initial=0.0)
    return np.allclose(mine, other, rtol=0, atol=1e-9 * size, equal_nan=True)


def states_of(reference: object) -> np.ndarray:
    """The states that were given as a reference, in float64."""
    try:
        states = to_numpy(reference).astype(float)
    except (TypeError, ValueError):
        states = np.zeros(())
    if states.ndim < 2:
        what = f"an array of shape {reference.shape}" if isinstance(reference, np.ndarray) else type(reference).__name__
        raise TypeError(
            f"`reference` must be a Reference, a Solution or an array of states (..., 2d, n); got {what}. "
            "Leave it out to have one computed."
        )
    return states


@of_groups
def time_reversal_error(sol: Solution) -> np.floating | np.ndarray:
    """‖y − y0‖₂, as in `reference_error`, after the run forwards to its end and the same method back from there, (...).

    On a grid that divides the interval it is at rounding level for a method with Φ(−h) = Φ(h)⁻¹, and for one that goes
    back by its exact inverse, as a SympFlow does. inf for a trajectory that fails on the way.

    Raises
    ------
    TypeError
        If `sol` is not a Solution, or its method cannot run backwards.
    """
    (t0, t1), y0 = sol.t_span, sol.y0
    there = _end(sol, (t0, t1), y0)
    finite = np.isfinite(to_numpy(there)).all(-1)
    if not finite.all():
        there = masked(there, ~finite[..., None], y0)
    try:
        back = _end(sol, (t1, t0), there)
    except (ValueError, TypeError, NotImplementedError) as refused:  # it ran forwards, so it is the direction
        raise TypeError(
            f"`sol` is of method {sol.integrator.name!r}, which cannot run backwards in time: use a symplectic method."
        ) from refused
    with np.errstate(all="ignore"):
        error = distance(sol.system, to_numpy(back).astype(float) - to_numpy(y0))
    return np.where(finite & np.isfinite(error) & ~failed(sol), error, np.inf)[()]


def _end(sol: Solution, t_span: tuple[float, float], y0: Array) -> Array:
    """The last state, NaN if the run did not reach it."""
    dtype = y0.dtype if isinstance(y0, np.ndarray) else None
    end = solve(sol.system, sol.integrator, t_span, y0, t_eval=[t_span[1]], dtype=dtype, on_domain_exit="ignore")
    return end.y[..., -1] if len(end.t) else y0 * np.nan
