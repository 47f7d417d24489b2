"""Sizes of q and p: the factors that make them comparable, whatever units they are written in."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from sympflow.hamiltonian.definition import bare_copy
from sympflow.lazy import kept, lately_kept

STATES = 64  # states of a domain at which Hessians are taken, where there is no y0
MOST_DENSE = 200  # degrees of freedom of lattices and pairs up to which steps and Hessians are matrices
SLOW = 0.1  # radians in a step of the system, the rate where nothing in H gives one
STEP = 0.05  # radians of the fastest motion in a default step
MOST_RATES = 16  # states of a batch at which rates are taken
SMALLEST_SCALE = 1e-3  # the scale of energy errors, at least, in units of the size of the terms of H along an orbit


def natural_scale(scene: Any) -> np.ndarray:
    """Factors s (d,) such that s q and p/s are of one size: for an oscillator of frequency ω and mass m, s = √(mω)."""
    return _natural_scale(scene.between_impulses).copy()


@kept
def _natural_scale(system: Any) -> np.ndarray:
    with np.errstate(all="ignore"):
        try:
            large = system.local is not None and system.ndof > MOST_DENSE
            s = _of_large(system) if large else _of_hessians(system)
        except (ArithmeticError, ValueError, TypeError):  # singular at the origin, or no second derivatives
            s = np.ones(system.ndof)
        return np.where(np.isfinite(s) & (s > 0), s, 1.0)


def weights(system: Any) -> np.ndarray:
    """[s, 1/s], (2d,): the factors that make a state [q, p] one of numbers of a size."""
    s = natural_scale(system)
    return np.concatenate([s, 1 / s])


def distance(system: Any, change: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return ‖y − y'‖ of differences of states along an axis, each pᵢ divided by sᵢ²: in units of q."""
    s = natural_scale(system)
    shape = [1] * change.ndim
    shape[axis] = -1
    return np.linalg.norm(change * np.concatenate([np.ones_like(s), s**-2]).reshape(shape), axis=axis)


def smallest_size(scene: Any, y0: np.ndarray) -> float:
    """A size that neither all q nor all p of an orbit from the states y0 (..., 2d) are less than; never 0."""
    system = scene.between_impulses
    scale = weights(system)
    size = np.abs(scale * y0).max(initial=0.0)
    if size == 0:
        slopes = [np.asarray(system.vector_field(y0, t)) for t in system.probe_times()]
        size = np.abs(scale * slopes).max(initial=0.0) * system.dt
    found = float(size / scale.max())
    return found if 0 < found < np.inf else 1.0


def _of_hessians(system: Any) -> np.ndarray:
    d, t0 = system.ndof, system.t_span[0]
    try:
        diagonal = np.diagonal(np.asarray(system.hessian(np.zeros(2 * d), t0)))
        s = (diagonal[:d] / diagonal[d:]) ** 0.25
    except (ZeroDivisionError, OverflowError):  # a Hamiltonian that is singular at the origin
        s = diagonal = np.full(2 * d, np.nan)
    good = np.isfinite(s[:d]) & (s[:d] > 0) & (diagonal[d:] > 0)
    rate = None if good.all() else fastest_rate(system)
    found = np.empty((0, 0, 0)) if rate is None else _hessians(system, t0)
    if not len(found):
        return np.where(good, s[:d], 1.0)
    curvatures = np.median(np.abs(np.diagonal(found, axis1=-2, axis2=-1)), axis=0)
    squares = np.where(curvatures[d:] > 0, rate / curvatures[d:], curvatures[:d] / rate)
    return np.where(good, s[:d], np.sqrt(squares))


def _of_large(system: Any) -> np.ndarray:
    d = system.ndof
    if not (system.separable and system.quadratic_kinetic and system.has_hessian_vector):
        return np.ones(d)
    inverse_mass = np.ones(d) if system.inverse_mass is None else np.asarray(system.inverse_mass)
    q = np.zeros(d) if system.y0 is None else system.y0[:d]
    v = np.sqrt(inverse_mass) * np.random.default_rng(0).standard_normal(d) / np.sqrt(d)
    rate = np.linalg.norm(np.sqrt(inverse_mass) * np.asarray(system.hessian_vector(q, v, system.t_span[0]))) ** 0.5
    return np.sqrt((rate or SLOW / system.dt) / inverse_mass)


def fastest_rate(system: Any) -> float | None:
    """The largest |λ| of J∇²H at y0, or the median over the domain; `SLOW`/dt where that is 0, None without states."""
    if system.y0 is None and system.domain is None:
        return None
    rates = [_rates(system, t) for t in system.probe_times(system.period)]
    return max(float(np.median(each)) if len(each) else 0.0 for each in rates) or SLOW / system.dt


def default_step(scene: Any, y: np.ndarray | None = None) -> float:
    """`STEP` over the largest rate at states y (..., 2d), by default y0 or those of the domain, to two digits."""
    return _step_at(scene.between_impulses, None if y is None else _few(y).tobytes())


def _few(y: np.ndarray) -> np.ndarray:
    """At most `MOST_RATES` or so of the states y (..., 2d), as rows of floats."""
    rows = y.reshape(-1, y.shape[-1])
    return rows[:: max(1, len(rows) // MOST_RATES)].astype(float)


@lately_kept
def _step_at(system: Any, states: bytes | None) -> float:
    y = None if states is None else np.frombuffer(states).reshape(-1, 2 * system.ndof)
    rate = max(_fastest_at(system, t, y) for t in system.probe_times())
    return float(f"{STEP / rate:.2g}") if 0 < STEP / max(rate, 1e-300) < 1e100 and np.isfinite(rate) else STEP


def _fastest_at(system: Any, t: float, y: np.ndarray | None) -> float:
    """The largest rate at states y (..., 2d) at t; 0 where it is not known."""
    with np.errstate(all="ignore"), suppress(ArithmeticError, ValueError, TypeError, np.linalg.LinAlgError):
        return float(_rates(system, t, y).max(initial=0.0)) if system.ndof <= MOST_DENSE else 0.0
    return 0.0


def rate_of_motion(system: Any, times: Sequence[float], states: Sequence[np.ndarray]) -> float:
    """The rate √(|(J∇²H)² ẏ|/|ẏ|) of the motion at states (..., 2d) of times, ω of an oscillation; 0 if not known.

    Modes that do not move, such as the highest ones of a grid, have no part in it.
    """
    sizes = np.zeros((2, 1))
    with np.errstate(all="ignore"), suppress(ArithmeticError, ValueError, TypeError):
        for t, y in zip(times, map(_few, states), strict=True) if system.ndof <= MOST_DENSE else ():
            A, v = _linear(np.asarray(system.hessian(y, t))), np.asarray(system.vector_field(y, t))[..., None]
            sizes = np.append(sizes, np.linalg.norm([v, A @ (A @ v)], axis=2)[..., 0], axis=1)
        slow, fast = np.nanmax(sizes, axis=1)
        return float(np.nan_to_num(np.sqrt(fast / slow), posinf=0.0))
    return 0.0


def _linear(S: np.ndarray) -> np.ndarray:
    """J∇²H of Hessians (n, 2d, 2d)."""
    d = S.shape[1] // 2
    return np.concatenate([S[:, d:], -S[:, :d]], axis=1)


def _rates(system: Any, t: float, y: np.ndarray | None = None) -> np.ndarray:
    """The largest |λ| of J∇²H at each of the states, of those where it is finite."""
    return np.abs(np.linalg.eigvals(_linear(_hessians(system, t, y)))).max(-1, initial=0.0)


def _hessians(system: Any, t: float, y: np.ndarray | None = None) -> np.ndarray:
    """The finite Hessians (n, 2d, 2d) at states y, or at y0, or at states of the domain."""
    if y is None:
        y = system.y0
    if y is not None:
        y = _few(y)
    elif system.domain is not None:
        y = system.domain.sample(STATES, 0)
    else:
        y = np.empty((0, 2 * system.ndof))
    with np.errstate(all="ignore"):
        S = np.asarray(system.hessian(y, t))
    return S[np.isfinite(S).all((-1, -2))]


def started(system: Any, y0: np.ndarray) -> Any:
    """Return the system; without a y0 of its own, a copy with dt, and the state of highest energy of y0 (..., 2d)."""
    if system.y0 is not None:
        return system
    rows, highest = y0.reshape(-1, y0.shape[-1]).astype(float), 0
    dt = default_step(system, rows) if system.step_is_open else system.dt
    if len(rows) > 1:
        with np.errstate(all="ignore"):
            H = system.between_impulses.hamiltonian(rows, system.t_span[0])
            highest = int(np.argmax(np.nan_to_num(H, nan=-np.inf, posinf=-np.inf)))
    return _started(system, dt, rows[highest].tobytes())


@lately_kept
def _started(system: Any, dt: float, y0: bytes) -> Any:
    other = bare_copy(system)
    other._scene = replace(system._scene, dt=dt, y0=np.frombuffer(y0).copy())
    return other


def size_of_terms(system: Any, y: np.ndarray, t: Any) -> np.ndarray:
    """½ Σ|y_i ∂H/∂y_i| of states y (..., 2d) at times t: the energy of an oscillator, whatever constant H has."""
    with np.errstate(all="ignore"):
        return 0.5 * np.abs(y * np.asarray(system.gradient(y, t))).sum(-1)


def known_scale(system: Any, H: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The scale of energy errors, (...), of H and the sizes of its terms at the start and along an orbit, (n, ...).

    It is the system's `energy_scale`, else |H| at the start or, where that is about 0, `SMALLEST_SCALE` of the largest
    size of states that kept H. It is NaN where all are 0.
    """
    if system.energy_scale is not None:
        return np.full_like(H[0], system.energy_scale)
    with np.errstate(all="ignore"):
        kept = np.isfinite(sizes) & (np.abs(H - H[0]) <= SMALLEST_SCALE * sizes)
        scale = np.fmax(np.abs(H[0]), SMALLEST_SCALE * np.max(np.where(kept, sizes, 0.0), axis=0))
    return np.where(scale == 0, np.nan, scale)
