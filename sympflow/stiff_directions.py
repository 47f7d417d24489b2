"""Whether the stiff directions of a potential turn, so that no constant matrix follows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sympflow.linear_part import LinearPart
    from sympflow.system import HamiltonianSystem

DRAWN, SAMPLES = 4096, 64  # states drawn, and those of lowest potential at which Hessians are compared
GAP = 10.0  # between the curvatures of a stiff direction and of the others
TURN = 0.1  # radians by which a stiff direction may turn and still count as constant


def inverse_mass(system: HamiltonianSystem) -> np.ndarray:
    """M⁻¹ (d, d)."""
    if not system.quadratic_kinetic:
        raise ValueError("`stiffness_matrix` needs a kinetic energy ½ pᵀM⁻¹p: leave it out.")
    return np.asarray(system.kinetic_hessian(np.zeros(system.ndof)), dtype=float)


def turning(system: HamiltonianSystem, part: LinearPart | None) -> str | None:
    """Why a constant K does not follow the stiff directions of V, or None.

    ∇²V is taken at states of low potential, in the domain or about y0: in the valleys where orbits are. It is stiff if
    at the median state a gap divides its curvatures; then the stiff directions must be those of K at all of them, or,
    where there is no K, those at the first.
    """
    q = _positions(system)
    if q is None or system.ndof < 2:
        return None
    try:
        with np.errstate(all="ignore"):
            hessians = np.asarray(system.potential_hessian(q))
    except (TypeError, ValueError):  # a callable that has no Hessian: nothing can be compared
        return None
    hessians = hessians[np.isfinite(hessians).all((-1, -2))]
    if len(hessians) < 2:
        return None
    L = np.linalg.cholesky(inverse_mass(system))
    curvature, directions = np.linalg.eigh(L.T @ hessians @ L)
    order = np.argsort(-np.abs(curvature), axis=-1)
    typical = np.median(np.abs(np.take_along_axis(curvature, order, -1)), axis=0)
    ratios = typical[:-1] / np.maximum(typical[1:], 1e-12 * typical[0])
    m = int(np.argmax(ratios)) + 1
    if not ratios[m - 1] > GAP:
        return None
    stiff = np.take_along_axis(directions, order[:, None, :m], -1)
    if (angle := _angle(stiff[0], stiff)) > TURN:
        return (
            f"its stiff directions turn, by {np.degrees(angle):.0f}° from one state of the domain to others, so no "
            "constant matrix K follows them. Write it in coordinates in which they do not turn, such as polar ones"
        )
    if part is None:
        return None
    eigenvalues, W = np.linalg.eigh(L.T @ part.stiffness_matrix @ L)
    if (angle := _angle(W[:, np.argsort(-np.abs(eigenvalues))[:m]], stiff)) <= TURN:
        return None
    if system.stiffness_matrix is not None:
        return (
            f"`stiffness_matrix` is stiff in other directions than V, {np.degrees(angle):.0f}° away. Pass ∇²V at a "
            "state of low potential, without what is not stiff in it"
        )
    return (
        f"its stiff directions do not turn, but they are none of its quadratic terms, from the stiffest of which "
        f"they are {np.degrees(angle):.0f}° away. Give the system by functions, HamiltonianSystem(V, ndof=…, "
        "stiffness_matrix=K) with K the curvature ∇²V of the stiff directions"
    )


def _angle(reference: np.ndarray, directions: np.ndarray) -> float:
    """Angle in radians from the span of m orthonormal columns to those of others (n, d, m), exceeded by one in ten."""
    cosines = np.linalg.svd(reference.T @ directions, compute_uv=False)[:, -1]
    return float(np.arccos(np.clip(np.quantile(cosines, 0.1), 0.0, 1.0)))


def _positions(system: HamiltonianSystem) -> np.ndarray | None:
    if system.domain is not None:
        q = system.domain.sample(DRAWN, 0)[:, : system.ndof]
    elif system.y0 is not None:
        center = system.y0[: system.ndof]
        spread = 0.5 * max(float(np.linalg.norm(center)), 1e-3) / np.sqrt(system.ndof)
        q = center + spread * np.random.default_rng(0).standard_normal((DRAWN, system.ndof))
    else:
        return None
    with np.errstate(all="ignore"):
        V = np.asarray(system.potential(q))
    return q[np.argsort(np.where(np.isfinite(V), V, np.inf))[:SAMPLES]]
