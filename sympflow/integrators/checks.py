"""check_integrator: the tests that every integrator, ours or a plug-in's, must pass.

Each check is a function check(integrator, system) that raises an AssertionError which says what is wrong. They judge by
the mathematics: the declared order by slope, the declared symplecticity by the Jacobian of the step that ran.
"""
# ruff: noqa: PT018

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.integrators.base import Integrator
from sympflow.solution import Solution
from sympflow.solver import solve
from sympflow.system import HamiltonianSystem

Factory = Callable[[], Integrator]
EPS = float(np.finfo(float).eps)
T_END = 2.03  # divisible by no ordinary step


@dataclass(frozen=True)
class Check:
    """A named check, and whether it applies to an integrator."""

    run: Callable[[Integrator, HamiltonianSystem], None]
    applies: Callable[[Integrator, HamiltonianSystem], bool]

    @property
    def name(self) -> str:
        return self.run.__name__

    def __call__(self, integrator: Integrator, system: HamiltonianSystem | None = None) -> None:
        self.run(integrator, _default_system() if system is None else system)


CHECKS: list[Check] = []


def check_integrator(factory: Factory, system: HamiltonianSystem | None = None) -> list[str]:
    """Run all checks that apply to an integrator.

    Parameters
    ----------
    factory : callable
        Makes the integrator: its class, or a function without arguments such as ``lambda: MyMethod(dt=0.01)``.
    system : HamiltonianSystem, optional
        A nonlinear system with a domain; the default is Hénon–Heiles. For a trained flow, the one it was trained for.

    Returns
    -------
    list of str
        The names of the checks that were run.

    Raises
    ------
    AssertionError
        At the first check that fails, saying which and why.
    """
    integrator, names = _made(factory), []
    system = _default_system() if system is None else system
    for check in checks_for(integrator, system):
        try:
            check(integrator, system)
        except AssertionError as error:
            raise AssertionError(f"{check.name} of {integrator!r}: {error}") from error
        names.append(check.name)
    return names


def checks_for(integrator: Integrator, system: HamiltonianSystem | None = None) -> Iterator[Check]:
    """The checks that apply to an integrator."""
    system = _default_system() if system is None else system
    return (check for check in CHECKS if check.applies(integrator, system))


def parametrize_with_checks(factories: Iterable[Factory], system: HamiltonianSystem | None = None) -> Any:
    """A pytest decorator: one test for each integrator and check.

    Examples
    --------
    >>> @parametrize_with_checks([MyMethod])  # doctest: +SKIP
    ... def test_contract(integrator, check):
    ...     check(integrator)
    """
    import pytest

    cases = [
        pytest.param(integrator, partial(check, system=system), id=f"{integrator.name}-{check.name}")
        for integrator in map(_made, factories)
        for check in checks_for(integrator, system)
    ]
    return pytest.mark.parametrize(("integrator", "check"), cases)


def _made(factory: Factory) -> Integrator:
    integrator = factory()
    if not isinstance(integrator, Integrator):
        raise TypeError(f"`factory` must make an Integrator; it made {type(integrator).__name__}.")
    return integrator


def _check(applies: Callable[[Integrator, HamiltonianSystem], bool] = lambda integrator, system: True) -> Any:
    def add(function: Callable[[Integrator, HamiltonianSystem], None]) -> Callable[..., None]:
        CHECKS.append(Check(function, applies))
        return function

    return add


# what applies -------------------------------------------------------------------------------------


def has_step(integrator: Integrator, system: HamiltonianSystem) -> bool:
    """Whether there is a bare step of NumPy states."""
    return _tries(lambda: integrator.step(system, 0.0, _states(system, 1), np.full(1, 0.01)))


def has_inverse(integrator: Integrator, system: HamiltonianSystem) -> bool:
    return _tries(lambda: integrator.inverse(system, 0.0, _states(system, 1), np.full(1, 0.01)))


def goes_backward(integrator: Integrator, system: HamiltonianSystem) -> bool:
    return _tries(lambda: _run(integrator, system, (0.01, 0.0)))


def takes_tensors(integrator: Integrator, system: HamiltonianSystem) -> bool:
    import torch

    return _tries(lambda: _run(integrator, system, (0.0, 0.01), torch.from_numpy(_states(system, 1)[0])))


def _tries(call: Callable[[], Any]) -> bool:
    """Whether the call is supported: a method that does not do something raises a TypeError or ValueError."""
    try:
        call()
    except (TypeError, ValueError):
        return False
    return True


# the checks ---------------------------------------------------------------------------------------


@_check()
def declarations(integrator: Integrator, system: HamiltonianSystem) -> None:
    """name, order, symplectic and options are there and of the right type."""
    assert isinstance(integrator.name, str) and integrator.name, "`name` must be a string"
    order = integrator.order
    assert order is None or (isinstance(order, int) and order > 0), f"`order` must be a count or None; got {order!r}"
    assert isinstance(integrator.symplectic, bool), f"`symplectic` must be a bool; got {integrator.symplectic!r}"
    assert set(integrator.options()) <= set(vars(integrator)), "`options` must be the fields of the dataclass"


@_check()
def dtype_and_shape_of_arrays(integrator: Integrator, system: HamiltonianSystem) -> None:
    """y has the shape of y0 with time last, and its dtype; y0 is not written to."""
    for dtype, batch in ((np.float64, ()), (np.float64, (2, 1)), (np.float32, ())):
        y0 = _states(system, 2)[: 2 if batch else 1].reshape(*batch, -1).astype(dtype)
        before = y0.copy()
        try:
            sol = _run(integrator, system, (0.0, 0.1), y0, t_eval=[0.0, 0.05, 0.1], dtype=np.dtype(dtype).name)
        except TypeError:
            assert integrator.trained and dtype == np.float32, "float32 states must be taken"
            continue
        assert sol.y.shape == (*y0.shape, 3), f"y has shape {sol.y.shape} for y0 of shape {y0.shape} and three times"
        assert sol.y.dtype == dtype, f"y is {sol.y.dtype} for y0 of {np.dtype(dtype)}"
        assert np.array_equal(y0, before), "`y0` was written to"
        assert np.array_equal(sol.y[..., 0], y0), "the state at t0 is not y0"


@_check(takes_tensors)
def dtype_device_and_gradient_of_tensors(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A tensor gives a tensor of its dtype and device, with gradients; the numbers are those of arrays."""
    import torch

    y0 = torch.from_numpy(_states(system, 2)).requires_grad_(True)
    sol = _run(integrator, system, (0.0, 0.1), y0, t_eval=[0.05, 0.1])
    assert isinstance(sol.y, torch.Tensor), f"y is a {type(sol.y).__name__} for a tensor"
    assert (sol.y.dtype, sol.y.device) == (y0.dtype, y0.device), f"y is {sol.y.dtype} on {sol.y.device}"
    (gradient,) = torch.autograd.grad(sol.y.sum(), y0)
    assert torch.isfinite(gradient).all() and gradient.abs().sum() > 0, "no gradient reaches y0"
    arrays = _run(integrator, system, (0.0, 0.1), to_numpy(y0), t_eval=[0.05, 0.1])
    _assert_close(to_numpy(sol.y), arrays.y, 1e3 * EPS, "tensors and arrays differ")


@_check()
def dense_output_equals_the_outputs(integrator: Integrator, system: HamiltonianSystem) -> None:
    """sol(t) == y at the output times, and t_eval gives these states too."""
    sol = _run(integrator, system, (0.0, T_END), dense_output=True)
    assert sol.sol is not None, "there is no dense output"
    _assert_close(sol.sol(sol.t), sol.y, 1e3 * EPS, "sol(t) differs from y")
    inside = np.array([0.0, 0.123, 0.5 * T_END, T_END])
    at = _run(integrator, system, (0.0, T_END), t_eval=inside, dense_output=True)
    assert at.sol is not None
    _assert_close(at.sol(inside), at.y, 1e3 * EPS, "sol(t_eval) differs from y")
    _assert_close(sol.sol(inside), at.y, 1e3 * EPS, "the output times change the run")
    assert at.sol(0.123).shape == at.y.shape[:-1], "sol(t) of a number has the wrong shape"


@_check()
def the_end_is_reached(integrator: Integrator, system: HamiltonianSystem) -> None:
    """An interval that the step does not divide ends exactly at its end, near the true state."""
    sol = _run(integrator, system, (0.3, 0.3 + T_END))
    assert sol.t[0] == 0.3 and sol.t[-1] == 0.3 + T_END, f"t runs from {sol.t[0]} to {sol.t[-1]}"
    assert (np.diff(sol.t) > 0).all(), "t is not increasing"
    assert sol.status == 0 and sol.success, f"status is {sol.status}: {sol.message}"
    error = np.abs(sol.y[:, -1] - _exact(system)).max()
    assert error < 0.2 * np.abs(_exact(system)).max(), f"the state at the end is wrong by {error:.1e}"


@_check(goes_backward)
def both_directions(integrator: Integrator, system: HamiltonianSystem) -> None:
    """Backward time returns to y0 within the method's error."""
    there = _run(integrator, system, (0.0, T_END)).y[:, -1]
    back = _run(integrator, system, (T_END, 0.0), there)
    assert back.t[0] == T_END and back.t[-1] == 0.0, f"t runs from {back.t[0]} to {back.t[-1]}"
    error, allowed = np.abs(back.y[:, -1] - _start(system)).max(), np.abs(there - _exact(system)).max()
    assert error <= 20 * allowed + 1e-10, f"backward time misses y0 by {error:.1e}; the method's error is {allowed:.1e}"


@_check()
def an_empty_interval(integrator: Integrator, system: HamiltonianSystem) -> None:
    """t1 = t0 gives y0 and nothing else."""
    sol = _run(integrator, system, (1.0, 1.0), dense_output=True)
    assert sol.t.tolist() == [1.0] and sol.status == 0, f"t is {sol.t}, status {sol.status}"
    assert np.array_equal(sol.y[:, 0], _start(system)), "the state is not y0"
    assert sol.sol is not None and np.array_equal(sol.sol(1.0), _start(system)), "sol(t0) is not y0"


@_check()
def a_blow_up_is_status_minus_one(integrator: Integrator, system: HamiltonianSystem) -> None:
    """A run that becomes non-finite ends with status −1, keeps what was computed, and says when."""
    sol = _run(integrator, system, (0.0, 20.0), 1e150 * np.ones(2 * system.ndof), t_eval=[0.0, 20.0])
    assert np.isfinite(sol.y).all(), "y holds values that are not finite"
    reached = len(sol.t) == 2
    assert sol.status == (0 if reached else -1), f"status is {sol.status} with {len(sol.t)} of 2 outputs"
    assert reached or "t = " in sol.message, f"the message does not say when: {sol.message!r}"


@_check()
def a_batch_is_the_loop(integrator: Integrator, system: HamiltonianSystem) -> None:
    """Each trajectory of a batch is the one that it is alone, up to the tolerance where they share their steps."""
    y0, times = _states(system, 3), [0.5 * T_END, T_END]
    batch = _run(integrator, system, (0.0, T_END), y0, t_eval=times)
    assert np.shape(batch.status) == (3,), f"status has shape {np.shape(batch.status)} for 3 trajectories"
    coupled = 1e3 * getattr(integrator, "rtol", 0.0 if has_step(integrator, system) else 1e-9)
    tolerance = max(1e3 * EPS, float(coupled))
    for i in range(3):
        alone = _run(integrator, system, (0.0, T_END), y0[i], t_eval=times)
        _assert_close(batch.y[i], alone.y, tolerance, f"trajectory {i} of a batch differs from the same alone")


@_check(lambda integrator, system: integrator.order is not None and has_step(integrator, system))
def the_order_is_the_slope(integrator: Integrator, system: HamiltonianSystem) -> None:
    """The error of one step behaves as h^(order + 1)."""
    y, errors, lengths = _states(system, 12), [], [1.6 / 2**k for k in range(12)]
    for h in lengths:
        step = integrator.step(system, 0.0, y, np.full(len(y), h))
        errors.append(float(np.median(np.abs(step - _flow(system, h)).max(-1))))
    slopes = [np.log2(a / b) - 1 for a, b in pairwise(errors) if b > 1e-12]
    assert slopes, "one step is exact to rounding: no order can be measured"
    excess = slopes[-1] - (integrator.order or 0)  # high orders may meet rounding before the slope has settled
    assert -0.6 < excess < 1.5, f"declared {integrator.order}, measured {slopes[-1]:.2f}"


@_check(lambda integrator, system: has_step(integrator, system) and _tries(lambda: _tangent(integrator, system)))
def symplecticity_as_declared(integrator: Integrator, system: HamiltonianSystem) -> None:
    """AᵀJA = J to rounding if and only if the integrator declares it, A being the Jacobian of the step that ran."""
    y, A = _tangent(integrator, system)
    d = system.ndof
    J = np.block([[np.zeros((d, d)), np.eye(d)], [-np.eye(d), np.zeros((d, d))]])
    _assert_close(y, integrator.step(system, 0.0, _states(system, 4), np.full(4, 0.4)), 1e3 * EPS, "tangent() moves y")
    defect = float(np.abs(A.swapaxes(-1, -2) @ J @ A - J).max() / np.abs(A).max() ** 2)
    if integrator.symplectic:
        assert defect < 1e3 * EPS, f"declared symplectic, but AᵀJA − J is {defect:.1e}"
    else:
        assert defect > 1e3 * EPS, f"AᵀJA = J to {defect:.1e}: declare `symplectic = True`"


@_check(has_inverse)
def the_inverse_undoes_the_step(integrator: Integrator, system: HamiltonianSystem) -> None:
    """inverse(step(y, h), h) = y to rounding."""
    y, h = _states(system, 4), np.array([0.3, 0.01, -0.2, 0.4])
    back = integrator.inverse(system, 0.0, integrator.step(system, 0.0, y, h), h)
    _assert_close(back, y, 1e4 * EPS, "inverse() does not undo step()")


@_check(lambda integrator, system: integrator.finds_events)
def events_are_zeros_of_the_dense_output(integrator: Integrator, system: HamiltonianSystem) -> None:
    """An event is located where g vanishes, and a terminal one ends the solution."""

    def g(t: float, y: Any) -> Any:
        return t - 0.777

    g.terminal = True  # type: ignore[attr-defined]
    sol = _run(integrator, system, (0.0, T_END), events=g)
    assert sol.t_events is not None and len(sol.t_events[0]) == 1, f"t_events is {sol.t_events}"
    assert sol.status == 1 and sol.t[-1] == sol.t_events[0][0], f"status {sol.status}, t ends at {sol.t[-1]}"
    assert abs(sol.t[-1] - 0.777) < 8 * EPS, f"the event at 0.777 was located at {sol.t[-1]!r}"


@_check()
def statistics(integrator: Integrator, system: HamiltonianSystem) -> None:
    """n_steps, force_evaluations, hessian_evaluations and backend are reported."""
    stats = _run(integrator, system, (0.0, T_END)).stats
    for key in ("n_steps", "force_evaluations", "hessian_evaluations", "backend"):
        assert key in stats, f"stats lack {key!r}"
    assert stats["n_steps"] > 0, "stats count no step"


# runs and reference states ------------------------------------------------------------------------


@cache
def _default_system() -> HamiltonianSystem:
    from sympflow.systems import henon_heiles

    return henon_heiles()


def _states(system: HamiltonianSystem, n: int) -> np.ndarray:
    """n fixed states of the domain, or around y0."""
    if system.domain is not None:
        return system.domain.sample(n, 7)
    return _start(system) * np.linspace(0.7, 1.0, n)[:, None]


def _start(system: HamiltonianSystem) -> np.ndarray:
    assert system.y0 is not None, "`system` needs a default `y0` for the checks"
    return system.y0


def _run(
    integrator: Integrator, system: HamiltonianSystem, t_span: tuple[float, float], y0: Any = None, **arguments: Any
) -> Solution:
    y0 = _start(system) if y0 is None else y0
    return solve(system, integrator, t_span, y0=y0, on_domain_exit="ignore", **arguments)


def _exact(system: HamiltonianSystem) -> np.ndarray:
    """The state at T_END from y0 at 0, to 12 digits."""
    return solve(system, "dop853", (0.0, T_END), y0=_start(system), t_eval=[T_END], rtol=1e-12, atol=1e-14).y[:, 0]


@cache
def _flow(system: HamiltonianSystem, h: float) -> np.ndarray:
    """The states a time h after `_states(system, 12)`, to 13 digits."""
    sol = solve(system, "dop853", (0.0, h), y0=_states(system, 12), t_eval=[h], rtol=1e-13, atol=1e-15)
    return sol.y[..., 0]


def _tangent(integrator: Integrator, system: HamiltonianSystem) -> tuple[np.ndarray, np.ndarray]:
    return integrator.tangent(system, 0.0, _states(system, 4), np.full(4, 0.4))


def _assert_close(actual: Any, expected: Any, tolerance: float, what: str) -> None:
    error = float(np.abs(np.asarray(actual) - np.asarray(expected)).max(initial=0.0))
    scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
    assert error <= tolerance * scale, f"{what} by {error:.1e}"
