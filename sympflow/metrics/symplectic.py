"""Phase-space volume, the symplectic form and transported area, judged on the map as it was executed.

The run is executed again from y0 as a stream of its steps (`Integrator.steps`), each of which is differentiated
(`Integrator.tangent`) where it was taken; nothing presumes that the method is symplectic. The memory is that of a few
hundred steps. The Jacobian of the whole run is never formed: on a chaotic orbit its determinant is rounding noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arrays import to_numpy
from sympflow.solution import Solution
from sympflow.system import HamiltonianSystem


def step_tangents(sol: Solution) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The steps of a run as a stream of chunks: t and h (n, ...), Jacobians A (n, ..., 2d, 2d).

    The states are those of the run; the Jacobians are float64 (of a trained flow: in the dtype of its weights).
    """
    system, integrator = sol.system, sol.integrator
    for times, states, lengths in integrator.steps(system, sol.t_span, sol.y0):
        y = to_numpy(states)
        if not integrator.trained:
            y = y.astype(float)
        batch = y.shape[:-1]
        t, h = (np.broadcast_to(x.reshape(*x.shape, *[1] * (len(batch) - x.ndim)), batch) for x in (times, lengths))
        with np.errstate(all="ignore"):
            _, A = integrator.tangent(system, float(t.flat[0]), y, h.astype(y.dtype))
        yield t, h, A.astype(float)


def volume_error(sol: Solution, over_time: bool = False) -> np.floating | np.ndarray:
    """Σ log|det A_k| over the executed steps: the logarithm of the factor by which phase-space volume changed.

    0 for a map that keeps volume, and at rounding level (about 1e-16 a step) for every symplectic method.

    Parameters
    ----------
    sol : Solution
    over_time : bool
        Whether to return the running sum at the times `sol.t`, (..., n), instead of its last value, (...).

    Warns
    -----
    RuntimeWarning
        If a determinant is zero or negative: the map folds phase space there. The error is inf from that step on, since
        the logarithm would hide the sign.
    """
    batch = sol.y.shape[:-2]
    total = np.zeros(batch)
    series = np.zeros((len(sol.t), *batch))
    direction = 1 if sol.t_span[1] >= sol.t_span[0] else -1
    first_fold = None
    n_steps = 0
    for t, h, A in step_tangents(sol):
        sign, logarithm = np.linalg.slogdet(A)
        bad = ~(sign > 0)
        if bad.any():
            if first_fold is None:
                k = int(bad.reshape(len(bad), -1).any(1).argmax())
                first_fold = (n_steps + k, float(t[k].flat[0]), float(sign[k][bad[k]].flat[0]))
            logarithm = np.where(bad, np.inf, logarithm)
        running = total + np.cumsum(logarithm, axis=0)
        if over_time:
            _hold(series, direction * (t + h), running, direction * sol.t)
        total = running[-1]
        n_steps += len(t)
    if first_fold is not None:
        k, time, sign_there = first_fold
        what = "not finite" if np.isnan(sign_there) else "zero" if sign_there == 0 else "negative"
        warnings.warn(
            f"The determinant of step {k + 1}, from t = {time:.9g}, is {what}: the volume error is infinite. "
            "Reduce `dt`, or take a method that preserves volume.",
            RuntimeWarning,
            stacklevel=2,
        )
    return np.moveaxis(series, 0, -1) if over_time else total[()]


def _hold(series: np.ndarray, ends: np.ndarray, values: np.ndarray, t: np.ndarray) -> None:
    """Write to `series` at each time t the value after the last step that has ended by then. Later calls overwrite."""
    tolerance = 1e-12 * np.maximum(1.0, np.abs(t))
    if (ends.reshape(len(ends), -1) == ends.reshape(len(ends), -1)[:, :1]).all():  # all trajectories step together
        index = np.searchsorted(ends.reshape(len(ends), -1)[:, 0], t + tolerance, side="right")
        series[index > 0] = values[index[index > 0] - 1]
        return
    for end, value in zip(ends, values, strict=True):
        passed = (t + tolerance).reshape(-1, *[1] * end.ndim) >= end
        np.copyto(series, value, where=passed)


def symplecticity_defect(
    sol: Solution, relative: bool = False, scale: ArrayLike | None = None
) -> np.floating | np.ndarray:
    """max over the executed steps of ‖AᵀJA − J‖₂, (...); divided by ‖A‖₂² if `relative`.

    A symplectic step has defect 0 up to the rounding of AᵀJA, which is proportional to ‖A‖². The Jacobian A is taken in
    the variables (s q, p/s), which keep the form J and remove the imbalance of a stiff oscillator.

    Parameters
    ----------
    sol : Solution
    relative : bool
    scale : array_like (d,) or float, optional
        The factors s > 0. The default is `natural_scale(system)`, √ω for an oscillator of frequency ω.
    """
    d = sol.system.ndof
    s = natural_scale(sol.system) if scale is None else np.broadcast_to(np.asarray(scale, dtype=float), (d,))
    if not (np.isfinite(s) & (s > 0)).all():
        raise ValueError(f"`scale` must be positive and finite, one factor for each q; got {s.tolist()}.")
    weights = np.concatenate([s, 1 / s])
    J = np.block([[np.zeros((d, d)), np.eye(d)], [-np.eye(d), np.zeros((d, d))]])
    worst = np.zeros(sol.y.shape[:-2])
    for _, _, A in step_tangents(sol):
        scaled = weights[:, None] * A / weights
        finite = np.isfinite(scaled).all((-2, -1))
        scaled = np.where(finite[..., None, None], scaled, 0.0)
        with np.errstate(all="ignore"):
            form = scaled.swapaxes(-1, -2) @ J @ scaled - J
            finite &= np.isfinite(form).all((-2, -1))
            defect = np.linalg.norm(np.where(finite[..., None, None], form, 0.0), 2, axis=(-2, -1))
            if relative:
                defect /= np.linalg.norm(scaled, 2, axis=(-2, -1)) ** 2
        worst = np.maximum(worst, np.where(finite, defect, np.inf).max(0))
    return worst[()]


def natural_scale(system: HamiltonianSystem) -> np.ndarray:
    """Factors s (d,) such that (s q, p/s) are balanced near q = p = 0: s_i⁴ = ∂²H/∂q_i² / ∂²H/∂p_i², or 1.

    For an oscillator of frequency ω and unit mass s = √ω. Where the two second derivatives at the origin are not both
    positive and finite, there is no natural scale and s_i = 1.
    """
    d = system.ndof
    try:
        with np.errstate(all="ignore"):
            diagonal = np.diagonal(np.asarray(system.hessian(np.zeros(2 * d))))
            s = (diagonal[:d] / diagonal[d:]) ** 0.25
    except (ZeroDivisionError, OverflowError):  # a Hamiltonian that is singular at the origin
        return np.ones(d)
    good = np.isfinite(s) & (s > 0) & (diagonal[d:] > 0)
    return np.where(good, s, 1.0)


def loop_area(loop: ArrayLike) -> np.floating | np.ndarray:
    """∮ p dq of closed loops (..., n, 2) in the phase plane, given at n equidistant values of a parameter.

    q is differentiated as a trigonometric polynomial and the integral is the trapezoidal sum, so for a smooth loop the
    error falls faster than any power of n. Signed: positive for a loop that runs clockwise in the (q, p) plane.
    """
    loop = np.asarray(loop, dtype=float)
    n = loop.shape[-2]
    wave_number = 1j * np.arange(n // 2 + 1)
    if n % 2 == 0:
        wave_number[-1] = 0  # the derivative of the highest cosine vanishes at the points
    q, p = loop[..., 0], loop[..., 1]
    slope = np.fft.irfft(wave_number * np.fft.rfft(q, axis=-1), n, axis=-1)
    return (p * slope).mean(-1) * 2 * np.pi


def loop_area_error(sol: Solution) -> np.ndarray:
    """Relative change of the phase-space area ∮ p dq of a transported loop, at the times `sol.t`: (..., n).

    Parameters
    ----------
    sol : Solution
        Of a system with one degree of freedom, from a batch y0 of shape (..., m, 2): m points of a closed curve, in
        order, at equidistant values of a smooth parameter (the last is not the first again).

    Warns
    -----
    RuntimeWarning
        If the loop has become too stretched for its points: the area is then uncertain, not wrong.

    Raises
    ------
    ValueError
        If the solution is not one of a loop.
    """
    if sol.system.ndof != 1:
        raise ValueError(f"`sol` must have one degree of freedom for a loop in the plane; it has {sol.system.ndof}.")
    y0 = to_numpy(sol.y0).astype(float)
    if y0.ndim < 2 or y0.shape[-2] < 8:
        raise ValueError("`sol` must start from a loop: pass a `y0` of shape (m, 2) with at least 8 points of it.")
    loops = np.moveaxis(to_numpy(sol.y).astype(float), -1, -3)  # (..., n, m, 2)
    start = loop_area(y0)
    if (np.abs(start) < 1e-300).any():
        raise ValueError("`sol` starts from a loop without area: pass the points of a closed curve in order.")
    spectrum = np.abs(np.fft.rfft(loops, axis=-2))[..., 1:, :]
    tail = spectrum[..., 2 * spectrum.shape[-2] // 3 :, :].max((-2, -1))
    if (tail > 1e-3 * spectrum.max((-2, -1))).any():
        warnings.warn(
            f"The loop of {y0.shape[-2]} points has become too stretched to be resolved: its area is uncertain. "
            "Start from more points.",
            RuntimeWarning,
            stacklevel=2,
        )
    return loop_area(loops) / np.asarray(start)[..., None] - 1
