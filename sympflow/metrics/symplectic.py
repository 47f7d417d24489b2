"""Phase-space volume, the symplectic form and transported area, judged on the map as it was executed.

The run is executed again from y0 as a stream of its steps (`Integrator.steps`), each is differentiated
(`Integrator.tangent`) at its state; the method is not assumed to be symplectic. The memory is that of a few hundred
steps. The Jacobian of the whole run is never formed: on a chaotic orbit its determinant is rounding noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import check_counts, warn
from sympflow.arrays import jvp, to_numpy
from sympflow.hamiltonian.scales import MOST_DENSE, natural_scale
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.metrics.energy import failed, of_groups
from sympflow.solution import Solution, check_solution


def step_tangents(sol: Solution) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The steps of a run as a stream of chunks: t and h (n, ...), Jacobians (n, ..., k, k); k = 2d but if extended."""
    return sol.integrator.executed(sol.system, sol.t_span, sol.y0)


@of_groups
def volume_error(sol: Solution, over_time: bool = False) -> np.floating | np.ndarray:
    """Σ log|det A_k| over the executed steps: the logarithm of the factor by which phase-space volume changed.

    0 for a map that preserves volume, and at rounding level (about 1e-16 a step, 1e-7 in float32) for every symplectic
    method. inf for a trajectory that became non-finite or could not be continued.

    Parameters
    ----------
    sol : Solution
    over_time : bool
        True for the running sum at the times `sol.t`, (..., n), instead of its last value, (...).

    Warns
    -----
    RuntimeWarning
        If a determinant is zero or negative in a run that reached its end: the map folds phase space there. The error
        is inf from that step on, since the logarithm would hide the sign.

    Raises
    ------
    TypeError
        If `sol` is not a Solution.
    """
    _check_kept(sol, "volume")
    batch, lost = sol.y.shape[:-2], failed(sol)
    total, series = np.zeros(batch), np.zeros((len(sol.t), *batch))
    direction = 1 if sol.t_span[1] >= sol.t_span[0] else -1
    first_fold = None
    n_steps = 0
    for t, h, A in step_tangents(sol):
        finite = np.isfinite(A).all((-2, -1))
        sign, logarithm = np.linalg.slogdet(np.where(finite[..., None, None], A, 0.0))
        bad = ~(sign > 0)
        logarithm[bad] = np.inf
        folds = bad & ~lost
        if first_fold is None and folds.any():
            k = int(folds.reshape(len(folds), -1).any(1).argmax())
            here = folds[k]
            first_fold = (n_steps + k, float(t[k].flat[0]), float(sign[k][here].flat[0]), bool(finite[k][here].flat[0]))
        running = total + np.cumsum(logarithm, axis=0)
        if over_time:
            _hold(series, direction * (t + h), running, direction * sol.t)
        total = running[-1]
        n_steps += len(t)
    if first_fold is not None:
        k, time, sign_there, is_finite = first_fold
        what = "not finite" if not is_finite else "zero" if sign_there == 0 else "negative"
        warn(
            f"The determinant of step {k + 1}, from t = {time:.9g}, is {what}: the volume error is infinite. "
            "Reduce `dt`, or take a method that preserves volume.",
            RuntimeWarning,
        )
    if not over_time:
        return np.where(lost, np.inf, total)[()]
    gone = lost[..., None] & ~np.isfinite(to_numpy(sol.states)).all(-1)
    return np.where(gone, np.inf, np.moveaxis(series, 0, -1))


def _check_kept(sol: Solution, what: str) -> None:
    sol.system.check_conservative(
        f"by which phase-space {what} shrinks and is not kept", "use sympflow.conformal_defect(sol)"
    )


def _hold(series: np.ndarray, ends: np.ndarray, values: np.ndarray, t: np.ndarray) -> None:
    """Write to `series` at each time t the value after the last step that has ended by then. Later calls overwrite."""
    tolerance = 1e-12 * np.maximum(np.abs(t), np.ptp(ends))
    if (ends.reshape(len(ends), -1) == ends.reshape(len(ends), -1)[:, :1]).all():  # all trajectories step together
        index = np.searchsorted(ends.reshape(len(ends), -1)[:, 0], t + tolerance, side="right")
        series[index > 0] = values[index[index > 0] - 1]
        return
    for end, value in zip(ends, values, strict=True):
        np.copyto(series, value, where=(t + tolerance).reshape(-1, *[1] * end.ndim) >= end)


@of_groups
def symplecticity_defect(
    sol: Solution, relative: bool = False, scale: ArrayLike | None = None
) -> np.floating | np.ndarray:
    """max over the executed steps of ‖AᵀJA − J‖₂, (...); divided by ‖A‖₂² if `relative`.

    A symplectic step has defect 0 up to the rounding of A, in the precision of the run, which is proportional to ‖A‖².
    The Jacobian A is taken in the variables (s q, p/s), which keep the form J and remove the imbalance of a stiff
    oscillator, or of units. The defect is inf for a trajectory that became non-finite or could not be continued. For
    lattices and pairs of more than 200 degrees of freedom it is the value of `symplecticity_estimate`, which also gives
    the error, unless `relative` or `scale` is given. For bodies without mass the form is that of momenta per unit mass,
    at given motion of the other bodies: derivatives by those are left out.

    Parameters
    ----------
    sol : Solution
    relative : bool
    scale : array_like (d,) or float, optional
        The factors s > 0. The default is √(mω) for an oscillator of frequency ω and mass m, and for another system is
        found from its second derivatives at q = p = 0, or else at y0.

    Raises
    ------
    TypeError
        If `sol` is not a Solution, or `scale` is not a number or an array of numbers.
    ValueError
        If `scale` is not positive and finite, or has another shape.
    """
    sol.system.check_conservative(
        "by which its flow is not symplectic", "use sympflow.conformal_defect(sol), which is 0 for the exact flow"
    )
    if sol.system.local is not None and sol.system.ndof > MOST_DENSE and not relative and scale is None:
        return symplecticity_estimate(sol).value
    return _form_defect(sol, 0.0, relative, scale)


class Estimate(NamedTuple):
    """A norm that is estimated by random directions, and its standard error: (...) each."""

    value: np.floating | np.ndarray
    error: np.floating | np.ndarray


def symplecticity_estimate(sol: Solution, directions: int = 8, seed: int = 0) -> Estimate:
    """max over the executed steps of an estimate of ‖AᵀJA − J‖_F / √(2d), for systems too large for their Jacobians.

    For random vectors u and v of independent standard normal numbers (uᵀEv)² has the mean ‖E‖_F² of any matrix E. Every
    step is differentiated along `directions` vectors, at the cost of as many steps by array operations, and the mean is
    taken over their pairs. ‖E‖_F/√(2d) is the mean defect of a direction; ‖E‖₂, which `symplecticity_defect` gives for
    small systems, is between it and √(2d) times it.

    Parameters
    ----------
    sol : Solution
    directions : int
        At least 3.
    seed : int

    Returns
    -------
    Estimate
        Its `value` and the standard error, found from the differences among the pairs at the step of the maximum.

    Raises
    ------
    TypeError
        If `sol` is not a Solution, or its method runs on NumPy arrays alone.
    ValueError
        If there are fewer than 3 directions, or the system has friction.
    """
    check_solution(sol)
    check_counts(directions=directions)
    if directions < 3:
        raise ValueError(f"`directions` must be at least 3, whose pairs tell the error; got {directions}.")
    sol.system.check_conservative("by which its flow is not symplectic", "use sympflow.conformal_defect(sol)")
    import torch

    system, integrator = sol.system, sol.integrator
    d = system.ndof
    U = torch.from_numpy(np.random.default_rng(seed).standard_normal((directions, 2 * d)))
    felt = _felt(system, d)
    i, j = np.triu_indices(directions, 1)
    worst, error = np.zeros(sol.y.shape[:-2]), np.zeros(sol.y.shape[:-2])
    for times, states, lengths in integrator.steps(system, sol.t_span, sol.y0):
        for t, y, h in zip(times, to_numpy(states), lengths, strict=True):
            x, step = torch.tensor(y), torch.as_tensor(h)
            u = U.to(x.dtype)

            def one_step(z: Any, t: float = t, step: Any = step) -> Any:
                return integrator.step(system, t, z, step)

            def along(v: Any, x: Any = x, one_step: Any = one_step) -> np.ndarray:
                return to_numpy(jvp(one_step, x, v.expand_as(x))[1])

            moved = [along(v) for v in u]
            if not felt.all():
                moved = [w - ~felt * along(v * torch.from_numpy(felt)) for v, w in zip(u, moved, strict=True)]
            before = _form(u.numpy()[i], u.numpy()[j]).reshape(-1, *[1] * (y.ndim - 1))
            squares = (_form(np.stack(moved)[i], np.stack(moved)[j]) - before).astype(float) ** 2 / (2 * d)
            mean = np.where(np.isfinite(squares).all(0), squares.mean(0), np.inf)
            value = np.sqrt(mean)
            with np.errstate(all="ignore"):
                spread = np.nan_to_num(squares.std(0, ddof=1) / np.sqrt(len(i)) / (2 * value))
            error = np.where(value > worst, spread, error)
            worst = np.maximum(worst, value)
    lost = failed(sol)
    return Estimate(np.where(lost, np.inf, worst)[()], np.where(lost, np.inf, error)[()])


def _form(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """uᵀJv: (..., 2d), each, to (...)."""
    d = u.shape[-1] // 2
    return (u[..., :d] * v[..., d:] - u[..., d:] * v[..., :d]).sum(-1)


@of_groups
def conformal_defect(sol: Solution, relative: bool = False, scale: ArrayLike | None = None) -> np.floating | np.ndarray:
    """max over the executed steps of ‖AᵀJA − e^{−γh}J‖₂, (...), of a system with the friction −γp.

    The flow of such a system is conformally symplectic: it shrinks the symplectic form by e^{−γh} in a time h [1]_, and
    phase-space volume by e^{−dγh}. So is every step that is composed of kicks and of drifts with friction, up to
    the rounding of A. Without friction it is `symplecticity_defect`.

    Parameters
    ----------
    sol : Solution
    relative, scale
        As for `symplecticity_defect`.

    Raises
    ------
    TypeError
        If `sol` is not a Solution, or `scale` is not a number or an array of numbers.
    ValueError
        If momenta have different rates of friction, so that the flow is not conformally symplectic; if `scale` is not
        positive and finite, or has another shape.

    References
    ----------
    .. [1] R. McLachlan, M. Perlmutter, "Conformal Hamiltonian systems", J. Geom. Phys. 39 (2001) 276–300.
    """
    if sol.system.external_force is not None:
        sol.system.check_conservative("by which its flow is not conformally symplectic", "")
    friction = sol.system.friction
    if not friction.isotropic:
        raise ValueError(
            f"`sol` is of {sol.system.name!r}, whose momenta have different rates of friction: its flow is not "
            "conformally symplectic. Use sympflow.reference_error(sol)."
        )
    return _form_defect(sol, friction.largest, relative, scale)


def _form_defect(sol: Solution, rate: float, relative: bool, scale: ArrayLike | None) -> np.floating | np.ndarray:
    """max over the executed steps of ‖AᵀJA − e^{−γh}J‖₂, γ the rate, in the variables (s q, p/s)."""
    d = sol.system.ndof
    s = natural_scale(sol.system) if scale is None else _factors(scale, d)
    if not (np.isfinite(s) & (s > 0)).all():
        raise ValueError(f"`scale` must be positive and finite, one factor for each q; got {s.tolist()}.")
    worst = np.zeros(sol.y.shape[:-2])
    for _, h, A in step_tangents(sol):
        n = A.shape[-1] // 2
        felt = _felt(sol.system, n)
        B = np.where(felt[:, None] | ~felt, A, 0.0)
        weights = np.concatenate([np.tile(s, n // d), np.tile(1 / s, n // d)])
        J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
        with np.errstate(all="ignore"):
            scaled = weights[:, None] * B / weights
            finite = np.isfinite(scaled).all((-2, -1))
            scaled = np.where(finite[..., None, None], scaled, 0.0)
            kept = J if rate == 0 else np.exp(-rate * h)[..., None, None] * J
            form = scaled.swapaxes(-1, -2) @ J @ scaled - kept
            finite &= np.isfinite(form).all((-2, -1))
            defect = np.linalg.norm(np.where(finite[..., None, None], form, 0.0), 2, axis=(-2, -1))
            if relative:
                defect /= np.linalg.norm(scaled, 2, axis=(-2, -1)) ** 2
        worst = np.maximum(worst, np.where(finite, defect, np.inf).max(0))
    return np.where(failed(sol), np.inf, worst)[()]


def _felt(system: HamiltonianSystem, n: int) -> np.ndarray:
    """False of the numbers (2n,) of bodies without mass, which no other one feels."""
    felt = None if system.local is None else system.local.felt
    return np.ones(2 * n, dtype=bool) if felt is None else np.tile(felt > 0, 2 * n // len(felt))


def _factors(scale: ArrayLike, d: int) -> np.ndarray:
    """`scale` as an array (d,)."""
    try:
        s = np.asarray(scale, dtype=float)
    except (TypeError, ValueError):
        raise TypeError(f"`scale` must be a number or {d} of them, one for each q; got {scale!r}.") from None
    if s.shape not in ((), (1,), (d,)):
        raise ValueError(f"`scale` must be a number or {d} of them, one for each q; got the shape {s.shape}.")
    return np.broadcast_to(s, (d,))


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
    TypeError
        If `sol` is not a Solution.
    ValueError
        If the initial states do not form a loop.
    """
    check_solution(sol)
    _check_kept(sol, "area")
    if sol.rows is not None and any((values != values[..., :1]).any() for values in sol.rows.values.values()):
        raise ValueError("`sol` has other parameters at each point of a loop, whose area no flow keeps: give them one.")
    if sol.system.ndof != 1:
        raise ValueError(f"`sol` must have one degree of freedom for a loop in the plane; it has {sol.system.ndof}.")
    y0 = to_numpy(sol.y0).astype(float)
    if y0.ndim < 2 or y0.shape[-2] < 8:
        raise ValueError("`sol` must start from a loop: pass a `y0` of shape (m, 2) with at least 8 points of it.")
    loops = np.moveaxis(to_numpy(sol.y).astype(float), -1, -3)  # (..., n, m, 2)
    start = loop_area(y0)
    if (start == 0).any():
        raise ValueError("`sol` starts from a loop without area: pass the points of a closed curve in order.")
    spectrum = np.abs(np.fft.rfft(loops, axis=-2))[..., 1:, :]
    tail = spectrum[..., 2 * spectrum.shape[-2] // 3 :, :].max((-2, -1))
    if (tail > 1e-3 * spectrum.max((-2, -1))).any():
        warn(
            f"The loop of {y0.shape[-2]} points has become too stretched to be resolved: its area is uncertain. "
            "Start from more points.",
            RuntimeWarning,
        )
    return loop_area(loops) / np.asarray(start)[..., None] - 1
