"""Orbital elements of solutions, and the momenta that systems of bodies conserve."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.bodies import PairsHamiltonian
from sympflow.hamiltonian.kepler import elements_of
from sympflow.hamiltonian.planets import ELEMENTS, Frame, frame_of, placed
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.solution import Solution


class Elements(NamedTuple):
    """Orbital elements of planets, arrays (..., n), time last where they are those of a solution.

    Attributes
    ----------
    a, e : ndarray
        Semi-major axis, negative of a hyperbola, and eccentricity.
    inc, node, peri : ndarray
        Inclination, longitude of the ascending node and argument of the pericentre, in radians.
    M : ndarray
        Mean anomaly, in radians.
    """

    a: np.ndarray
    e: np.ndarray
    inc: np.ndarray
    node: np.ndarray
    peri: np.ndarray
    M: np.ndarray

    def __getitem__(self, name: Any) -> Any:
        return getattr(self, name) if isinstance(name, str) else tuple.__getitem__(self, name)


def elements(solution: Solution | ArrayLike, system: HamiltonianSystem | None = None, about: str = "star") -> Elements:
    """Return the osculating orbital elements of planets.

    Parameters
    ----------
    solution : Solution, or array_like of shape (..., 2d)
        A solution, or states.
    system : HamiltonianSystem, optional
        The system of the states, if these are given: see `HamiltonianSystem.planets`.
    about : {"star", "jacobi"}
        The centre: the star, or the centre of mass of all bodies inside the orbit.

    Returns
    -------
    Elements
        Arrays (..., planets, n) for a solution, (..., planets) for states.

    Raises
    ------
    ValueError, TypeError
        If an argument is wrong, or the system has no star.

    Examples
    --------
    >>> sol = sympflow.solve(sympflow.systems.solar_system(4), t_span=(0, 1000))
    >>> sympflow.elements(sol).e.shape[0]
    4
    """
    y, system, timed = _states(solution, system)
    if about not in ("star", "jacobi"):
        raise ValueError(f"`about` must be 'star' or 'jacobi'; got {about!r}.")
    frame = _frame(system)
    if about == "jacobi":
        frame = frame if frame.jacobi else Frame(frame.local, frame.G, np.asarray(system.y0))
        x, v, *_ = frame.into(y)
        order = np.argsort(frame.bodies)
        x, v, mu = x[..., order, :], v[..., order, :], frame.mu[order]
    else:
        q, u = frame.states(y)
        x, v = q[..., 1:, :] - q[..., :1, :], u[..., 1:, :] - u[..., :1, :]
        mu = frame.G * (frame.masses[0] + frame.masses[1:])
    found = np.moveaxis(elements_of(x, v, np.broadcast_to(mu, x.shape[:-1])), -1, 0)
    return Elements(*(np.moveaxis(found, 1, -1) if timed else found))


def states_of_elements(elements: Elements | Any, system: HamiltonianSystem) -> np.ndarray:
    """Return the states (..., 2d) of heliocentric elements, with the centre of mass at rest at the origin.

    Parameters
    ----------
    elements : Elements, or mapping of "a", "e", "inc", "node", "peri" and "M" to arrays of shape (..., planets)
    system : HamiltonianSystem
    """
    frame = _frame(system)
    columns = elements._asdict() if isinstance(elements, Elements) else dict(elements)
    if set(columns) != set(ELEMENTS):
        raise ValueError(f"`elements` must have {', '.join(ELEMENTS)}; got {', '.join(columns) or 'none'}.")
    table = np.stack(np.broadcast_arrays(*(np.asarray(columns[name], dtype=float) for name in ELEMENTS)), axis=-1)
    if table.ndim < 2 or table.shape[-2] != len(frame.masses) - 1:
        raise ValueError(f"`elements` must be arrays of shape (..., {len(frame.masses) - 1}); got {table.shape[:-1]}.")
    return placed(frame.masses, frame.G, table)


def momentum(solution: Solution | ArrayLike, system: HamiltonianSystem | None = None) -> np.ndarray:
    """Return the total momentum Σ p_i of bodies: (..., dim, n) of a solution, (..., dim) of states.

    Parameters
    ----------
    solution, system
        As in `elements`; any system of `HamiltonianSystem.pairs` or `planets`.
    """
    _, p, timed = _bodies(solution, system)
    total = p.sum(-2)
    return np.moveaxis(total, 0, -1) if timed else total


def angular_momentum(solution: Solution | ArrayLike, system: HamiltonianSystem | None = None) -> np.ndarray:
    """Return the total angular momentum Σ q_i × p_i of bodies in space: (..., 3, n) of a solution, (..., 3) of states.

    Parameters
    ----------
    solution, system
        As in `momentum`, in three dimensions.
    """
    q, p, timed = _bodies(solution, system)
    if q.shape[-1] != 3:
        raise ValueError(
            f"`system` has bodies in {q.shape[-1]} dimensions, and angular momentum is defined in three: use bodies in "
            "three dimensions."
        )
    total = np.cross(q, p).sum(-2)
    return np.moveaxis(total, 0, -1) if timed else total


def _bodies(solution: Any, system: HamiltonianSystem | None) -> tuple[np.ndarray, np.ndarray, bool]:
    """Positions and momenta (..., bodies, dim), without those of bodies that have no mass."""
    y, system, timed = _states(solution, system)
    local = system.local
    if not isinstance(local, PairsHamiltonian):
        raise ValueError(
            f"`system` {system.name!r} has no bodies, whose momenta are added up: it must be one of "
            "HamiltonianSystem.pairs or planets."
        )
    shape = (*y.shape[:-1], local.n_bodies, local.dim)
    felt = local.masses > 0
    q, p = (x.reshape(shape)[..., felt, :] for x in (y[..., : system.ndof], y[..., system.ndof :]))
    return q, p, timed


def _states(solution: Any, system: HamiltonianSystem | None) -> tuple[np.ndarray, HamiltonianSystem, bool]:
    """States (..., 2d), the system, and True for a solution, whose time comes first."""
    if isinstance(solution, Solution):
        return np.moveaxis(to_numpy(solution.y), -1, 0), solution.system, True
    if not isinstance(system, HamiltonianSystem):
        raise TypeError("`system` must be given with states: that of HamiltonianSystem.planets.")
    y = np.asarray(to_numpy(solution), dtype=float)
    if y.ndim == 0 or y.shape[-1] != 2 * system.ndof:
        raise ValueError(f"`solution` must be a Solution, or states (..., {2 * system.ndof}); got shape {y.shape}.")
    return y, system, False


def _frame(system: HamiltonianSystem) -> Frame:
    if not isinstance(system, HamiltonianSystem):
        raise TypeError(f"`system` must be a HamiltonianSystem; got {type(system).__name__}.")
    frame = frame_of(system)
    if frame is None:
        raise ValueError(
            f"`system` {system.name!r} has no planets about a star, whose elements these are: make it by "
            "HamiltonianSystem.planets."
        )
    return frame
