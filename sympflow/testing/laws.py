"""The laws of every integrator: of a single step, of the results of `solve`, and the consistency of both."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.hamiltonian.system import HamiltonianSystem, counting_view
from sympflow.integrators.base import FixedStep, Integrator, Problem
from sympflow.solution import Solution
from sympflow.solver import solve

EPS = float(np.finfo(float).eps)
T_END = 2.03  # divisible by no ordinary step


class NotApplicable(Exception):
    """Raised by a check where there is nothing to check, with the reason."""


@cache
def default_system() -> HamiltonianSystem:
    from sympflow.systems import henon_heiles

    return henon_heiles()


def states(system: HamiltonianSystem, n: int) -> np.ndarray:
    """n fixed states of the domain, or around y0."""
    if system.domain is not None:
        return system.domain.sample(n, 7)
    return start(system) * np.linspace(0.7, 1.0, n)[:, None]


def start(system: HamiltonianSystem) -> np.ndarray:
    assert system.y0 is not None, "`system` needs a default `y0` for the checks"
    return system.y0


def run(
    integrator: Integrator, system: HamiltonianSystem, t_span: tuple[float, float], y0: Any = None, **arguments: Any
) -> Solution:
    """A solution of the integrator's, from the system's y0 unless another is given."""
    y0 = start(system) if y0 is None else y0
    with warnings.catch_warnings():  # the methods of low order are judged by their laws, at any step
        warnings.filterwarnings("ignore", "`(dt` .*|rtol`) is too", RuntimeWarning)
        return solve(system, integrator, t_span, y0=y0, on_domain_exit="ignore", **arguments)


@cache
def exact(system: HamiltonianSystem, h: float = T_END, n: int = 0, t0: float = 0.0) -> np.ndarray:
    """The states a time h after `states(system, n)`, or after y0 for n = 0, at t0, to 13 digits."""
    y0 = states(system, n) if n else start(system)
    return solve(system, "dop853", (t0, t0 + h), y0=y0, t_eval=[t0 + h], rtol=1e-13, atol=1e-15).y[..., 0]


def assert_close(actual: Any, expected: Any, tolerance: float, what: str) -> None:
    error = float(np.abs(np.asarray(actual) - np.asarray(expected)).max(initial=0.0))
    scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
    assert error <= tolerance * scale, f"{what} by {error:.1e}"


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


def _step(integrator: Integrator, system: HamiltonianSystem, t: float = 0.0) -> Callable[[np.ndarray, Any], np.ndarray]:
    reason = bare_step(integrator, system)
    if reason is not None:
        raise NotApplicable(reason)

    def step(y: np.ndarray, h: np.ndarray | float) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.asarray(integrator.step(system, t, y, h))

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
    """A step from NaN is not finite, so that a blow-up is detected; other states of the batch are not affected."""
    step = _step(integrator, system)
    y = states(system, 3)
    h = np.full(3, 0.05)
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


def _slopes_of_steps(integrator: Integrator, system: HamiltonianSystem, t: float = 0.0, finer: int = 1) -> list[float]:
    """Slopes between steps h and h/2, so many h to an octave, the last at the shortest whose error is no rounding."""
    y, step = states(system, 12), _step(integrator, system, t)
    errors: list[float] = []
    for h in (1.6 / 2 ** (k / finer) for k in range(12 * finer)):
        errors.append(float(np.median(np.abs(step(y, np.full(len(y), h)) - exact(system, h, len(y), t)).max(-1))))
        if errors[-1] < 1e-13:  # as exact as the reference
            break
    return [float(np.log2(a / b)) - 1 for a, b in zip(errors, errors[finer:], strict=False) if b > 1e-12]


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
    differences = [_jacobian(step, y, h, reach) for reach in (0.02, 0.004)]  # the shorter for a step that bends much
    nearest = min(differences, key=lambda one: float(np.abs(one - A).max()))
    assert_close(A, nearest, 1e-7, "tangent() differs from the finite differences of step()")


def symplecticity_as_declared(integrator: Integrator, system: HamiltonianSystem) -> None:
    """AᵀJA = J to rounding if and only if the integrator declares it, A being the Jacobian of the step that ran."""
    if bare_step(integrator, system) is not None:
        assert not integrator.symplectic, "declared symplectic, but there is no bare step that could show it"
    step = _step(integrator, system)
    y = states(system, 16)
    y = np.concatenate([scale * y for scale in ((1.0,) if integrator.trained else (1.0, 0.3, 1.7, 2.5))])
    h = np.resize([H] if integrator.trained else [H, 0.11, H / 2], len(y))
    try:
        A, low, high = integrator.jacobian(system, 0.0, y, h), 1e3 * EPS, 1e3 * EPS
    except Exception:  # whatever keeps it from being differentiated: the step itself can still tell
        A, low, high = _jacobian(step, y, h), 1e-11, 1e-9
    d = A.shape[-1] // 2
    J = np.block([[np.zeros((d, d)), np.eye(d)], [-np.eye(d), np.zeros((d, d))]])
    defect = float(np.abs(A.swapaxes(-1, -2) @ J @ A - J).max() / np.abs(A).max() ** 2)
    if integrator.symplectic:
        assert defect < high, f"declared symplectic, but AᵀJA − J is {defect:.1e}"
    else:
        assert defect > low, f"AᵀJA = J to {defect:.1e}: declare `symplectic = True`"


def _jacobian(step: Callable[[np.ndarray, Any], np.ndarray], y: np.ndarray, h: Any, reach: float = 0.02) -> np.ndarray:
    """The Jacobians (n, ..., 2d) of steps from y (n, 2d), by differences of order 8: to about 1e-12."""
    columns = []
    for i, scale in enumerate(np.abs(y).max(0)):
        e = np.zeros(y.shape[-1])
        e[i] = reach * (scale or 1.0)
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


OF_STEPS: tuple[Callable[[Integrator, HamiltonianSystem], None], ...] = (
    a_step_length_for_each_state,
    what_is_not_finite_stays_so,
    the_order_is_the_slope,
    the_tangent_is_the_derivative_of_the_step,
    symplecticity_as_declared,
    the_inverse_undoes_the_step,
)


# ruff: noqa: PT018


def declarations(integrator: Integrator, system: HamiltonianSystem) -> None:
    """name, order, symplectic and options are there and of the right type."""
    assert isinstance(integrator.name, str) and integrator.name, "`name` must be a string"
    order = integrator.order
    assert order is None or (isinstance(order, int) and order > 0), f"`order` must be a count or None; got {order!r}"
    assert isinstance(integrator.symplectic, bool), f"`symplectic` must be a bool; got {integrator.symplectic!r}"
    assert set(integrator.options()) <= set(vars(integrator)), "`options` must be the fields of the dataclass"


def dtype_and_shape_of_arrays(integrator: Integrator, system: HamiltonianSystem) -> None:
    """y has the shape of y0 with time last, and its dtype; y0 is not written to."""
    for dtype, batch in ((np.float64, ()), (np.float64, (2, 1)), (np.float32, ())):
        y0 = states(system, 2)[: 2 if batch else 1].reshape(*batch, -1).astype(dtype)
        before = y0.copy()
        try:
            sol = run(integrator, system, (0.0, 0.1), y0, t_eval=[0.0, 0.05, 0.1], dtype=np.dtype(dtype).name)
        except TypeError:
            assert integrator.trained and dtype == np.float32, "float32 states must be taken"
            continue
        assert sol.y.shape == (*y0.shape, 3), f"y has shape {sol.y.shape} for y0 of shape {y0.shape} and three times"
        assert sol.y.dtype == dtype, f"y is {sol.y.dtype} for y0 of {np.dtype(dtype)}"
        assert np.array_equal(y0, before), "`y0` was written to"
        assert np.array_equal(sol.y[..., 0], y0), "the state at t0 is not y0"


def dtype_device_and_gradient_of_tensors(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A tensor gives a tensor of its dtype and device, with gradients; the numbers are those of arrays."""
    import torch

    y0 = torch.from_numpy(states(system, 2))
    if integrator.arrays_only:
        try:
            run(integrator, system, (0.0, 0.01), y0)
        except TypeError as error:
            raise NotApplicable(f"it takes NumPy arrays only, as it says ({error})") from error
        raise AssertionError("`arrays_only` is declared, but tensors are taken: leave it out")
    y0.requires_grad_(True)
    try:
        sol = run(integrator, system, (0.0, 0.1), y0, t_eval=[0.05, 0.1])
    except (TypeError, RuntimeError, AttributeError) as error:
        raise AssertionError(
            f"it fails on tensors ({error}): write the step with the functions of sympflow.arrays, or declare "
            "`arrays_only`"
        ) from error
    assert isinstance(sol.y, torch.Tensor), f"y is a {type(sol.y).__name__} for a tensor"
    assert (sol.y.dtype, sol.y.device) == (y0.dtype, y0.device), f"y is {sol.y.dtype} on {sol.y.device}"
    (gradient,) = torch.autograd.grad(sol.y.sum(), y0)
    assert torch.isfinite(gradient).all() and gradient.abs().sum() > 0, "no gradient reaches y0"
    differences = _gradient_by_differences(integrator, system, to_numpy(y0))
    tolerance = max(1e-8, 1e3 * float(getattr(integrator, "rtol", 0.0)))
    assert_close(to_numpy(gradient), differences, tolerance, "the gradient differs from the differences of the run")
    arrays = run(integrator, system, (0.0, 0.1), to_numpy(y0), t_eval=[0.05, 0.1])
    assert_close(to_numpy(sol.y), arrays.y, 1e3 * EPS, "tensors and arrays differ")


def _gradient_by_differences(integrator: Integrator, system: HamiltonianSystem, y0: np.ndarray) -> np.ndarray:
    """The gradient (n, 2d) of the sum of the states at 0.05 and 0.1, from y0 (n, 2d)."""

    def total(y: np.ndarray, h: Any) -> np.ndarray:
        return run(integrator, system, (0.0, 0.1), y, t_eval=[0.05, 0.1]).y.sum((-2, -1))

    return _jacobian(total, y0, None)


def dense_output_equals_the_outputs(integrator: Integrator, system: HamiltonianSystem) -> None:
    """sol(t) == y at the output times, and t_eval gives these states too."""
    sol = run(integrator, system, (0.0, T_END), dense_output=True)
    assert sol.sol, "there is no dense output"
    assert_close(sol.sol(sol.t), sol.y, 1e3 * EPS, "sol(t) differs from y")
    inside = np.array([0.0, 0.123, 0.5 * T_END, T_END])
    at = run(integrator, system, (0.0, T_END), t_eval=inside, dense_output=True)
    assert at.sol, "there is no dense output with `t_eval`"
    assert_close(at.sol(inside), at.y, 1e3 * EPS, "sol(t_eval) differs from y")
    assert_close(sol.sol(inside), at.y, 1e3 * EPS, "the output times change the run")
    assert at.sol(0.123).shape == at.y.shape[:-1], "sol(t) of a number has the wrong shape"


def the_end_is_reached(integrator: Integrator, system: HamiltonianSystem) -> None:
    """An interval that the step does not divide ends exactly at its end, near the true state."""
    sol = run(integrator, system, (0.3, 0.3 + T_END))
    assert sol.t[0] == 0.3 and sol.t[-1] == 0.3 + T_END, f"t runs from {sol.t[0]} to {sol.t[-1]}"
    assert (np.diff(sol.t) > 0).all(), "t is not increasing"
    assert sol.status == 0 and sol.success, f"status is {sol.status}: {sol.message}"
    error = np.abs(sol.y[:, -1] - exact(system)).max()
    assert error < 0.2 * np.abs(exact(system)).max(), f"the state at the end is wrong by {error:.1e}"


def both_directions(integrator: Integrator, system: HamiltonianSystem) -> None:
    """Backward time returns to y0 within the method's error."""
    there = run(integrator, system, (0.0, T_END)).y[:, -1]
    try:
        back = run(integrator, system, (T_END, 0.0), there)
    except (TypeError, ValueError) as error:
        if integrator.symplectic or not integrator.trained:
            raise
        raise NotApplicable(f"it has no backward time ({error})") from error
    assert back.t[0] == T_END and back.t[-1] == 0.0, f"t runs from {back.t[0]} to {back.t[-1]}"
    missed, allowed = np.abs(back.y[:, -1] - start(system)).max(), np.abs(there - exact(system)).max()
    assert missed <= 20 * allowed + 1e-10, (
        f"backward time misses y0 by {missed:.1e}; the method's error is {allowed:.1e}"
    )


def an_empty_interval(integrator: Integrator, system: HamiltonianSystem) -> None:
    """t1 = t0 gives y0 and nothing else."""
    sol = run(integrator, system, (1.0, 1.0), dense_output=True)
    assert sol.t.tolist() == [1.0] and sol.status == 0, f"t is {sol.t}, status {sol.status}"
    assert np.array_equal(sol.y[:, 0], start(system)), "the state is not y0"
    assert sol.sol and np.array_equal(sol.sol(1.0), start(system)), "sol(t0) is not y0"


def a_blow_up_is_status_minus_one(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A run that becomes non-finite ends with status −1, keeps its outputs, and reports the time."""
    starts = [1e150 * np.ones(2 * system.ndof)]
    if system is default_system():
        starts.append(np.array([0.0, 0.0, 0.0, 0.7]))  # singular at t = 5.45
    for y0 in starts:
        sol = run(integrator, system, (0.0, 20.0), y0, t_eval=[0.0, 20.0])
        assert np.isfinite(sol.y).all(), "y holds values that are not finite"
        reached = len(sol.t) == 2
        assert sol.status == (0 if reached else -1), f"status is {sol.status} with {len(sol.t)} of 2 outputs"
        assert reached or "t = " in sol.message, f"the message does not say when: {sol.message!r}"
    if system is default_system() and not integrator.trained:
        assert not reached, f"a singularity is hidden: status {sol.status}, and finite states beyond it"


def a_batch_is_the_loop(integrator: Integrator, system: HamiltonianSystem) -> None:
    """Each trajectory of a batch is the one that it is alone, up to the tolerance where they share their steps."""
    y0, times = states(system, 3), [0.5 * T_END, T_END]
    batch = run(integrator, system, (0.0, T_END), y0, t_eval=times)
    assert np.shape(batch.status) == (3,), f"status has shape {np.shape(batch.status)} for 3 trajectories"
    coupled = 1e3 * getattr(integrator, "rtol", 0.0 if bare_step(integrator, system) is None else 1e-9)
    tolerance = max(1e3 * EPS, float(coupled))
    for i in range(3):
        alone = run(integrator, system, (0.0, T_END), y0[i], t_eval=times)
        assert_close(batch.y[i], alone.y, tolerance, f"trajectory {i} of a batch differs from the same alone")


def events_are_zeros_of_the_dense_output(integrator: Integrator, system: HamiltonianSystem) -> None:
    """An event is located where g vanishes on the dense output, and a terminal one ends the solution there."""

    def g(t: float, y: Any) -> Any:
        return t - 0.777

    g.terminal = True  # type: ignore[attr-defined]
    sol = run(integrator, system, (0.0, T_END), events=g, dense_output=True)
    assert sol.t_events is not None and len(sol.t_events[0]) == 1, f"t_events is {sol.t_events}"
    assert sol.y_events is not None and sol.sol, "there is no dense output"
    assert sol.status == 1 and sol.t[-1] == sol.t_events[0][0], f"status {sol.status}, t ends at {sol.t[-1]}"
    assert abs(sol.t[-1] - 0.777) < 8 * EPS, f"the event at 0.777 was located at {sol.t[-1]!r}"
    assert_close(sol.sol(sol.t[-1]), sol.y_events[0][0], 1e3 * EPS, "sol(t) differs from the state of the event")


def statistics(integrator: Integrator, system: HamiltonianSystem) -> None:
    """n_steps, force_evaluations, hessian_evaluations and backend are reported, as counts and a word.

    Only a trained flow evaluates no forces. The count for one step is that of the step on the system's own functions.
    """
    stats = run(integrator, system, (0.0, T_END)).stats
    for key in ("n_steps", "force_evaluations", "hessian_evaluations", "backend"):
        assert key in stats, f"stats lack {key!r}"
    for key in ("n_steps", "force_evaluations", "hessian_evaluations"):
        count = stats[key]
        whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
        assert whole and count >= 0, f"stats must hold a count of {key}; they hold {count!r}"
    assert isinstance(stats["backend"], str), f"stats must name the backend; they hold {stats['backend']!r}"
    assert stats["n_steps"] > 0, "stats count no step"
    if isinstance(integrator, FixedStep) and integrator.on_grid:
        expected = math.ceil(T_END / integrator.step_length(system))
        assert stats["n_steps"] == expected, f"stats count {stats['n_steps']} steps of {expected}"
    if not integrator.trained:
        assert stats["force_evaluations"] > 0, "stats count no force: count them, or correct `evaluations`"
        _the_count_of_a_step(integrator, system)
    longer = run(integrator, system, (0.0, 3 * T_END)).stats
    for key in ("n_steps", "force_evaluations", "hessian_evaluations"):
        assert longer[key] >= stats[key], f"stats count fewer {key} in a longer run"


def _the_count_of_a_step(integrator: Integrator, system: HamiltonianSystem) -> None:
    """`evaluations` counts for a single step the forces that the step evaluates, where it has them from the system."""
    if not isinstance(integrator, FixedStep) or bare_step(integrator, system) is not None:
        return
    y, made = states(system, 1)[0], Counter[str]()
    if integrator.stepper(Problem(system, 0.0, 0.1, y)).counts_itself:
        return
    with np.errstate(all="ignore"):
        view: Any = counting_view(system, lambda what, x: made.update([what]))
        integrator.step(view, 0.0, y, 0.1)
    told = integrator.evaluations(0, 0, 1, "numpy")["force_evaluations"]
    n = made["force_evaluations"]
    assert n in (0, told), f"`evaluations` states {told} forces a step, but step() evaluates {n}"


OF_RUNS: tuple[Callable[[Integrator, HamiltonianSystem], None], ...] = (
    declarations,
    dtype_and_shape_of_arrays,
    dtype_device_and_gradient_of_tensors,
    dense_output_equals_the_outputs,
    the_end_is_reached,
    both_directions,
    an_empty_interval,
    a_blow_up_is_status_minus_one,
    a_batch_is_the_loop,
    events_are_zeros_of_the_dense_output,
    statistics,
)


OMEGA, SHIFT = 5.3, 0.9  # of g(t) = sin(OMEGA t − SHIFT), whose zeros are known


def the_run_is_its_steps(integrator: Integrator, system: HamiltonianSystem) -> None:
    """steps() gives the states and lengths of the very run, and step() leads from each to the next."""
    sol = run(integrator, system, (0.0, T_END), dense_output=True)
    t, y, h = _steps(integrator, system)
    assert sol.sol, "there is no dense output"
    assert_close(y[0], start(system), 0.0, "steps() does not begin at y0, but away")
    assert_close(t[1:], (t + h)[:-1], 1e3 * EPS, "a step of steps() does not begin where the last ended, but away")
    assert t[0] == 0.0 and t[-1] + h[-1] > T_END - 1e3 * EPS, f"steps() runs from {t[0]} to {t[-1] + h[-1]}"
    assert_close(y, np.moveaxis(np.asarray(sol.sol(t)), -1, 0), 1e4 * EPS, "states of steps() differ from the run's")
    if bare_step(integrator, system) is not None or integrator.tangent_holds or integrator.keeps:
        return
    with np.errstate(all="ignore"):
        stepped = np.asarray(integrator.step(system, 0.0, y, h))
    tolerance = 1e4 * EPS if isinstance(integrator, FixedStep) else max(1e4 * EPS, 0.1 * _rtol(integrator))
    assert_close(stepped[:-1], y[1:], tolerance, "step() does not give the next state of the run, but differs")
    if isinstance(integrator, FixedStep):
        assert_close(stepped[-1], sol.y[:, -1], 1e4 * EPS, "step() does not give the run's last state, but differs")


def _rtol(integrator: Integrator) -> float:
    return float(getattr(integrator, "rtol", 0.0))


def _steps(integrator: Integrator, system: HamiltonianSystem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (n,), states (n, 2d) and lengths (n,) of the steps from y0."""
    try:
        chunks = list(integrator.steps(system, (0.0, T_END), start(system)))
    except TypeError as error:
        if bare_step(integrator, system) is None:
            raise
        raise NotApplicable(str(error)) from error
    assert chunks, "steps() yields nothing"
    t, y, h = (np.concatenate([np.asarray(chunk[i]) for chunk in chunks]) for i in range(3))
    return t.reshape(len(y), -1)[:, 0], y, h.reshape(len(y), -1)[:, 0]


def states_within_a_step_belong_to_it(integrator: Integrator, system: HamiltonianSystem) -> None:
    """Between the steps: the shorter step from the grid point before; of variable steps, not worse than the ends."""
    sol = run(integrator, system, (0.0, T_END), dense_output=True)
    assert sol.sol, "there is no dense output"
    at, y, h = _steps(integrator, system)
    fractions = np.resize([0.31, 0.5, 0.83], len(at))
    times = at + fractions * h
    within = times < T_END
    inside = np.moveaxis(np.asarray(sol.sol(times[within])), -1, 0)
    if isinstance(integrator, FixedStep) and integrator.on_grid and bare_step(integrator, system) is None:
        with np.errstate(all="ignore"):
            expected = np.asarray(integrator.step(system, 0.0, y, fractions * h))[within]
        assert_close(
            inside, expected, 1e4 * EPS, "a state within a step is not the shorter step from its beginning, but away"
        )
        return
    reference = solve(system, "dop853", (0.0, T_END), start(system), dense_output=True, rtol=1e-12, atol=1e-14).sol
    assert reference is not None
    error, allowed = np.abs(inside - reference(times[within]).T).max(), np.abs(sol.y - reference(sol.t)).max()
    assert error <= 20 * allowed + 1e-3 * np.abs(sol.y).max(), f"within steps it is wrong by {error:.1e}"


@cache
def _damped() -> tuple[HamiltonianSystem, np.ndarray, float]:
    """The default system with friction, its state at T_END, and how far friction moves that."""
    system = default_system()
    assert system.symbols is not None
    damped = HamiltonianSystem.from_sympy(system.symbols.H, damping=0.5, y0=system.y0, dt=system.dt, name="damped")
    end = exact(damped)
    return damped, end, float(np.abs(end - exact(system)).max())


def friction_is_in_the_steps(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A method with `takes_friction` solves a damped system: its error is smaller than the effect of friction."""
    if not integrator.takes_friction:
        raise NotApplicable("it does not say that it takes friction, so damped systems are refused for it")
    damped, end, effect = _damped()
    error = _end_error(integrator, damped, 0.0, end, "friction")
    assert error < effect / 4, (
        f"the end of a damped system is wrong by {error:.1e}, and friction moves it by {effect:.1e}: take −Γp into "
        "every step, as system.vector_field does, or do not say `takes_friction`"
    )
    _the_order_is_kept(integrator, damped, 0.0, "friction")


def _end_error(integrator: Integrator, system: HamiltonianSystem, t0: float, end: np.ndarray, what: str) -> float:
    """The error of the state T_END after t0, of the default system with friction or a drive."""
    try:
        integrator.check(system)
    except ValueError as reason:
        raise NotApplicable(f"it does not apply to the default system with {what} ({reason})") from None
    sol = run(integrator, system, (t0, t0 + T_END), t_eval=[t0 + T_END], backend="array")
    return float(np.abs(sol.y[..., 0] - end).max())


def _the_order_is_kept(integrator: Integrator, system: HamiltonianSystem, t0: float, what: str) -> None:
    """The error of one step from t0 falls as fast as declared, of a method that has a bare step and an order."""
    if integrator.order is None or bare_step(integrator, system) is not None:
        return
    slopes = _slopes_of_steps(integrator, system, t0, finer=2)  # high orders settle just before rounding
    assert not slopes or slopes[-1] - integrator.order > -0.6, (
        f"with {what} the order is {slopes[-1]:.2f}, and {integrator.order} is declared"
    )


DRIVEN_FROM = 0.7  # where the drive is neither 0 nor at its largest


@cache
def _driven() -> tuple[HamiltonianSystem, np.ndarray, float]:
    """The default system with a drive, its state T_END after `DRIVEN_FROM`, and how much that moves it."""
    system = default_system()
    assert system.symbols is not None
    scene: dict[str, Any] = {"y0": system.y0, "dt": system.dt, "name": "driven"}
    H = f"{system.symbols.H} + q1*cos(2*t)/5"
    driven = HamiltonianSystem.from_sympy(H, time="t", **scene)
    end = exact(driven, t0=DRIVEN_FROM)
    frozen = [HamiltonianSystem.from_sympy(H.replace("2*t", repr(2 * t)), **scene) for t in (0.0, DRIVEN_FROM)]
    return driven, end, float(min(np.abs(end - exact(other)).max() for other in (system, *frozen)))


def the_drive_is_in_the_steps(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A method with `takes_driving` solves a driven system: its error is smaller than the effect of the drive."""
    if not integrator.takes_driving:
        raise NotApplicable("it does not say that it takes H at its times, so driven systems are refused for it")
    driven, end, effect = _driven()
    error = _end_error(integrator, driven, DRIVEN_FROM, end, "a drive")
    assert error < effect / 4, (
        f"the end of a driven system is wrong by {error:.1e}, and that the drive moves matters by {effect:.1e}: take H "
        "at t + c·h in every stage, as system.vector_field(y, t + c * h) does, or do not say `takes_driving`"
    )
    _the_order_is_kept(integrator, driven, DRIVEN_FROM, "a drive")


def the_start_time_does_not_matter(integrator: Integrator, system: HamiltonianSystem) -> None:
    """The system is autonomous: a run from t0 = 5.25 is that from 0, and so is a step."""
    t0, times = 5.25, np.array([0.5, 1.111, T_END])
    here = run(integrator, system, (0.0, T_END), t_eval=times)
    there = run(integrator, system, (t0, t0 + T_END), t_eval=np.append(t0 + times[:-1], t0 + T_END))
    tolerance = max(1e4 * EPS, 1e-3 * _rtol(integrator))
    assert_close(there.y, here.y, tolerance, f"a run from t0 = {t0} differs from that from 0")
    if bare_step(integrator, system) is None:
        y, h = states(system, 4), np.full(4, 0.1)
        with np.errstate(all="ignore"):
            later, now = (np.asarray(integrator.step(system, t, y, h)) for t in (t0, 0.0))
        assert_close(later, now, 1e3 * EPS, f"a step at t = {t0} differs from one at 0")


def every_event_is_found(integrator: Integrator, system: HamiltonianSystem) -> None:
    """All zeros in both directions of time, by their direction, up to the count that ends the run; zeros in y too."""
    phase = (np.arange(-20, 21) * np.pi + SHIFT) / OMEGA
    ends = [T_END]
    if _goes_backward(integrator, system):
        ends.append(-T_END)
    for t_end in ends:
        zeros = np.sort(phase[(np.sign(t_end) * phase > 0) & (np.abs(phase) < T_END)] * np.sign(t_end)) * np.sign(t_end)
        rises = np.sign(t_end) * np.cos(OMEGA * zeros - SHIFT) > 0
        for direction, expected in ((0, zeros), (1, zeros[rises]), (-1, zeros[~rises])):
            sol = run(integrator, system, (0.0, t_end), events=_wave(direction), event_step=0.1, dense_output=True)
            assert sol.t_events is not None and sol.y_events is not None and sol.sol, "there are no events"
            found, what = sol.t_events[0], f"of direction {direction} towards t = {t_end}"
            assert len(found) == len(expected), f"{len(found)} events {what} are found, there are {len(expected)}"
            assert_close(found, expected, 1e3 * EPS, f"the events {what} are misplaced")
            assert_close(sol.y_events[0], sol.sol(found).T, 1e3 * EPS, "the states of events differ from sol(t)")
            assert sol.status == 0, f"status is {sol.status}: events that are not terminal end the run"
        second = run(integrator, system, (0.0, t_end), events=_wave(0, terminal=2), event_step=0.1)
        assert second.status == 1 and len(second.t_events[0]) == 2, "terminal = 2 does not end at the second event"  # type: ignore[index]
        assert abs(second.t[-1] - zeros[1]) < 1e3 * EPS, f"terminal = 2 ends at {second.t[-1]}, not {zeros[1]}"
    _events_of_states(integrator, system)


def _events_of_states(integrator: Integrator, system: HamiltonianSystem) -> None:
    """The events of q₁ − c are where the dense output crosses c."""
    t = np.linspace(0.0, T_END, 400)
    q = np.asarray(run(integrator, system, (0.0, T_END), dense_output=True).sol(t))[0]  # type: ignore[misc]
    level = float((q.min() + q.max()) / 2)
    expected = [0.5 * (a + b) for (a, b), (u, v) in zip(pairwise(t), pairwise(q - level), strict=True) if u * v < 0]
    sol = run(integrator, system, (0.0, T_END), events=lambda t, y: y[0] - level, event_step=0.1)
    found = sol.t_events[0]  # type: ignore[index]
    assert len(found) == len(expected), f"{len(found)} zeros of q₁ − c are found; sol(t) has {len(expected)}"
    assert_close(found, expected, 1.01 * T_END / 399, "zeros of q₁ − c are not where sol(t) crosses c, but away")
    residual = np.abs(np.asarray(sol.y_events[0])[:, 0] - level).max(initial=0.0)  # type: ignore[index]
    assert residual < 1e4 * EPS * max(1.0, float(np.abs(q).max())), f"q₁ − c is {residual:.1e} at its zeros"


def _wave(direction: int, terminal: int = 0) -> Callable[[float, Any], float]:
    def g(t: float, y: Any) -> float:
        return float(np.sin(OMEGA * t - SHIFT))

    g.direction, g.terminal = direction, terminal  # type: ignore[attr-defined]
    return g


def _goes_backward(integrator: Integrator, system: HamiltonianSystem) -> bool:
    try:
        run(integrator, system, (0.0, -0.1))
    except (TypeError, ValueError):
        if integrator.symplectic or not integrator.trained:
            raise
        return False
    return True


def save_every_thins_the_outputs(integrator: Integrator, system: HamiltonianSystem) -> None:
    """save_every=3 reports every third of the outputs and the end, with and without events."""
    every = run(integrator, system, (0.0, T_END))
    keep = np.unique([*range(0, len(every.t), 3), len(every.t) - 1])
    for extra in ({}, {"events": _wave(0)}):
        third = run(integrator, system, (0.0, T_END), save_every=3, **extra)
        with_or_without = "with events" if extra else "without events"
        if "output_step" in every.stats:  # it reports on a grid of its own, of which the end is always one
            assert len(third.t) == len(keep), f"save_every=3 gives {len(third.t)} outputs {with_or_without}"
        else:
            assert third.t.tolist() == every.t[keep].tolist(), f"save_every=3 reports other times {with_or_without}"
            tolerance = 1e3 * EPS
            assert_close(third.y, every.y[:, keep], tolerance, f"save_every=3 changes the states {with_or_without}")


def a_batch_reports_its_failures(integrator: Integrator, system: HamiltonianSystem) -> None:
    """The run of a batch in which some trajectories blow up has status −1 for these and 0 for the others."""
    y0 = np.stack([start(system), 1e150 * np.ones(2 * system.ndof)])
    times = np.array([0.0, 8.0])
    with np.errstate(all="ignore"):
        outcome = integrator.run(Problem(system, 0.0, 8.0, y0, t_eval=times))
    finite = np.isfinite(np.asarray(outcome.y)).all(axis=(0, 2))
    status = np.broadcast_to(outcome.status, (2,))
    for i, name in ((0, "an ordinary state"), (1, "a state that may blow up")):
        wanted = 0 if finite[i] else -1
        assert status[i] == wanted, f"run() gives {name} of a batch status {status[i]}; its outputs call for {wanted}"


OF_CONSISTENCY: tuple[Callable[[Integrator, HamiltonianSystem], None], ...] = (
    the_run_is_its_steps,
    states_within_a_step_belong_to_it,
    the_start_time_does_not_matter,
    friction_is_in_the_steps,
    the_drive_is_in_the_steps,
    every_event_is_found,
    save_every_thins_the_outputs,
    a_batch_reports_its_failures,
)
