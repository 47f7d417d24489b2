"""What `solve` must give with every integrator."""
# ruff: noqa: PT018

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.integrators.base import FixedStep, Integrator
from sympflow.integrators.check_setting import (
    EPS,
    T_END,
    NotApplicable,
    assert_close,
    default_system,
    exact,
    run,
    start,
    states,
)
from sympflow.integrators.checks_of_steps import DIFFERENCES, bare_step
from sympflow.system import HamiltonianSystem


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
    try:
        run(integrator, system, (0.0, 0.01), y0)
    except TypeError as error:
        raise NotApplicable(f"it takes no tensors ({error})") from error
    y0.requires_grad_(True)
    sol = run(integrator, system, (0.0, 0.1), y0, t_eval=[0.05, 0.1])
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

    def total(y: np.ndarray) -> np.ndarray:
        return run(integrator, system, (0.0, 0.1), y, t_eval=[0.05, 0.1]).y.sum((-2, -1))

    columns = []
    for i in range(y0.shape[-1]):
        e = np.zeros(y0.shape[-1])
        e[i] = 0.01
        columns.append(sum(c * (total(y0 + k * e) - total(y0 - k * e)) for k, c in DIFFERENCES) / e[i])
    return np.stack(columns, axis=-1)


def dense_output_equals_the_outputs(integrator: Integrator, system: HamiltonianSystem) -> None:
    """sol(t) == y at the output times, and t_eval gives these states too."""
    sol = run(integrator, system, (0.0, T_END), dense_output=True)
    assert sol.sol is not None, "there is no dense output"
    assert_close(sol.sol(sol.t), sol.y, 1e3 * EPS, "sol(t) differs from y")
    inside = np.array([0.0, 0.123, 0.5 * T_END, T_END])
    at = run(integrator, system, (0.0, T_END), t_eval=inside, dense_output=True)
    assert at.sol is not None, "there is no dense output with `t_eval`"
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
    assert sol.sol is not None and np.array_equal(sol.sol(1.0), start(system)), "sol(t0) is not y0"


def a_blow_up_is_status_minus_one(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A run that becomes non-finite ends with status −1, keeps what was computed, and says when."""
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
    assert sol.y_events is not None and sol.sol is not None, "there is no dense output"
    assert sol.status == 1 and sol.t[-1] == sol.t_events[0][0], f"status {sol.status}, t ends at {sol.t[-1]}"
    assert abs(sol.t[-1] - 0.777) < 8 * EPS, f"the event at 0.777 was located at {sol.t[-1]!r}"
    assert_close(sol.sol(sol.t[-1]), sol.y_events[0][0], 1e3 * EPS, "sol(t) differs from the state of the event")


def statistics(integrator: Integrator, system: HamiltonianSystem) -> None:
    """n_steps, force_evaluations, hessian_evaluations and backend are reported, as counts and a word."""
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
    longer = run(integrator, system, (0.0, 3 * T_END)).stats
    for key in ("n_steps", "force_evaluations", "hessian_evaluations"):
        assert longer[key] >= stats[key], f"stats count fewer {key} in a longer run"


ALL: tuple[Callable[[Integrator, HamiltonianSystem], None], ...] = (
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
