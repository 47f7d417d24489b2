"""What the bare step of an integrator must do: order, symplecticity, inverse, one step length for each state."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.check_setting import EPS, NotApplicable, assert_close, exact, run, states
from sympflow.system import HamiltonianSystem

H = 0.4  # where a Jacobian is judged: long, so that what is not symplectic shows
DIFFERENCES = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))  # of order 8, central


def bare_step(integrator: Integrator, system: HamiltonianSystem) -> str | None:
    """Why there is no bare step, or None if there is one."""
    try:
        integrator.step(system, 0.0, states(system, 1), np.full(1, 0.01))
    except TypeError as error:
        if isinstance(integrator, FixedStep):
            raise
        return str(error)
    return None


def _step(integrator: Integrator, system: HamiltonianSystem) -> Callable[[np.ndarray, np.ndarray | float], np.ndarray]:
    reason = bare_step(integrator, system)
    if reason is not None:
        raise NotApplicable(reason)

    def step(y: np.ndarray, h: np.ndarray | float) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.asarray(integrator.step(system, 0.0, y, h))

    return step


def a_step_length_for_each_state(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A step of a batch with different h, negative ones as well, is that of each state alone with its own."""
    step = _step(integrator, system)
    h = np.array([0.3, 0.01, 0.05] if integrator.trained and not integrator.symplectic else [0.3, 0.01, -0.2])
    y = states(system, 3)
    together = step(y, h)
    assert together.shape == y.shape, f"a step of states {y.shape} has shape {together.shape}"
    for i in range(3):
        assert_close(
            together[i], step(y[i], h[i]), 1e3 * EPS, f"state {i} of a batch with its own h differs from alone"
        )
        assert_close(together[i], step(y[i], float(h[i])), 1e3 * EPS, "h as a number or an array differs")


def what_is_not_finite_stays_so(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A step from NaN is not finite, so that a blow-up is seen; other states of the batch do not notice."""
    step = _step(integrator, system)
    y, h = states(system, 3), np.full(3, 0.05)
    alone = step(y, h)
    for bad in (np.nan, np.inf):
        spoilt = y.copy()
        spoilt[1] = bad
        result = step(spoilt, h)
        assert not np.isfinite(result[1]).all(), f"a step from {bad} is finite: it would hide a blow-up"
        assert_close(result[[0, 2]], alone[[0, 2]], 1e3 * EPS, f"{bad} in one state of a batch changes the others")


def the_order_is_the_slope(integrator: Integrator, system: HamiltonianSystem) -> None:
    """The error of one step behaves as h^(order + 1); of a method without a bare step, that of a run as dt^order."""
    if integrator.order is None:
        raise NotApplicable("it declares no order")
    if bare_step(integrator, system) is None:
        slopes = _slopes_of_steps(integrator, system)
    elif "dt" in integrator.options():
        slopes = _slopes_of_runs(integrator, system)
    else:
        raise NotApplicable("it has neither a bare step nor a step length `dt`")
    assert slopes, "one step is exact to rounding: no order can be measured"
    excess = slopes[-1] - integrator.order
    settled = len(slopes) > 2 and np.ptp(slopes[-3:]) < 0.25  # high orders may meet rounding before
    assert -0.6 < excess < (0.6 if settled else 1.5), f"declared {integrator.order}, measured {slopes[-1]:.2f}"


def _slopes_of_steps(integrator: Integrator, system: HamiltonianSystem) -> list[float]:
    y, errors, step = states(system, 12), [], _step(integrator, system)
    for h in (1.6 / 2**k for k in range(12)):
        errors.append(float(np.median(np.abs(step(y, np.full(len(y), h)) - exact(system, h, len(y))).max(-1))))
    return [float(np.log2(a / b)) - 1 for a, b in pairwise(errors) if b > 1e-12]


def _slopes_of_runs(integrator: Integrator, system: HamiltonianSystem) -> list[float]:
    errors, t_end = [], 3.2
    for dt in (t_end / 2**k for k in range(4, 9)):
        sol = run(type(integrator)(**{**vars(integrator), "dt": dt}), system, (0.0, t_end), t_eval=[t_end])
        errors.append(float(np.abs(sol.y[:, 0] - exact(system, t_end)).max()))
    return [float(np.log2(a / b)) for a, b in pairwise(errors) if b > 1e-11]


def the_tangent_is_the_derivative_of_the_step(integrator: Integrator, system: HamiltonianSystem) -> None:
    """tangent() gives the step and its Jacobian; the metrics rely on it."""
    step = _step(integrator, system)
    if integrator.tangent_holds:
        raise NotApplicable(f"tangent() holds {integrator.tangent_holds} fixed, which step() does not")
    y, h = states(system, 4), np.full(4, H)
    try:
        y_next, A = integrator.tangent(system, 0.0, y, h)
    except Exception as error:
        raise NotApplicable(
            f"tangent() fails, so volume and symplecticity cannot be measured ({type(error).__name__}: {error})"
        ) from error
    assert_close(y_next, step(y, h), 1e3 * EPS, "the state that tangent() gives differs from step()")
    assert_close(A, _jacobian(step, y, h), 1e-7, "tangent() differs from the finite differences of step()")


def symplecticity_as_declared(integrator: Integrator, system: HamiltonianSystem) -> None:
    """AᵀJA = J to rounding if and only if the integrator declares it, A being the Jacobian of the step that ran."""
    if bare_step(integrator, system) is not None:
        assert not integrator.symplectic, "declared symplectic, but there is no bare step that could show it"
    step = _step(integrator, system)
    d, y = system.ndof, states(system, 16)
    y = np.concatenate([scale * y for scale in ((1.0,) if integrator.trained else (1.0, 0.3, 1.7, 2.5))])
    h = np.resize([H] if integrator.trained else [H, 0.11, H / 2], len(y))
    try:
        A, low, high = integrator.tangent(system, 0.0, y, h)[1], 1e3 * EPS, 1e3 * EPS
    except Exception:  # whatever keeps it from being differentiated: the step itself can still tell
        A, low, high = _jacobian(step, y, h), 1e-11, 1e-9
    J = np.block([[np.zeros((d, d)), np.eye(d)], [-np.eye(d), np.zeros((d, d))]])
    defect = float(np.abs(A.swapaxes(-1, -2) @ J @ A - J).max() / np.abs(A).max() ** 2)
    if integrator.symplectic:
        assert defect < high, f"declared symplectic, but AᵀJA − J is {defect:.1e}"
    else:
        assert defect > low, f"AᵀJA = J to {defect:.1e}: declare `symplectic = True`"


def _jacobian(step: Callable[[np.ndarray, np.ndarray], np.ndarray], y: np.ndarray, h: np.ndarray) -> np.ndarray:
    """The Jacobians (n, 2d, 2d) of steps from y (n, 2d), by differences of order 8: to about 1e-12."""
    columns = []
    for i, scale in enumerate(np.abs(y).max(0)):
        e = np.zeros(y.shape[-1])
        e[i] = 0.02 * (scale or 1.0)
        columns.append(sum(c * (step(y + k * e, h) - step(y - k * e, h)) for k, c in DIFFERENCES) / e[i])
    return np.stack(columns, axis=-1)


def the_inverse_undoes_the_step(integrator: Integrator, system: HamiltonianSystem) -> None:
    """inverse(step(y, h), h) = y to rounding."""
    step = _step(integrator, system)
    y, h = states(system, 4), np.array([0.3, 0.01, -0.2, 0.4])
    try:
        integrator.inverse(system, 0.0, y, h)
    except TypeError as error:
        raise NotApplicable(str(error)) from error
    assert_close(integrator.inverse(system, 0.0, step(y, h), h), y, 1e4 * EPS, "inverse() does not undo step()")


ALL: tuple[Callable[[Integrator, HamiltonianSystem], None], ...] = (
    a_step_length_for_each_state,
    what_is_not_finite_stays_so,
    the_order_is_the_slope,
    the_tangent_is_the_derivative_of_the_step,
    symplecticity_as_declared,
    the_inverse_undoes_the_step,
)
