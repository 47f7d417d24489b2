"""What an integrator says twice must agree: run and steps, states within a step, other start times, all events."""
# ruff: noqa: PT018

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from sympflow.integrators.base import FixedStep, Integrator, Problem
from sympflow.integrators.check_setting import (
    EPS,
    T_END,
    NotApplicable,
    assert_close,
    run,
    start,
    states,
)
from sympflow.integrators.checks_of_steps import bare_step
from sympflow.system import HamiltonianSystem

OMEGA, SHIFT = 5.3, 0.9  # of g(t) = sin(OMEGA t − SHIFT), whose zeros are known


def the_run_is_its_steps(integrator: Integrator, system: HamiltonianSystem) -> None:
    """steps() gives the states and lengths of the very run, and step() leads from each to the next."""
    sol = run(integrator, system, (0.0, T_END), dense_output=True)
    t, y, h = _steps(integrator, system)
    assert sol.sol is not None, "there is no dense output"
    assert_close(y[0], start(system), 0.0, "steps() does not begin at y0, but away")
    assert_close(t[1:], (t + h)[:-1], 1e3 * EPS, "a step of steps() does not begin where the last ended, but away")
    assert t[0] == 0.0 and t[-1] + h[-1] > T_END - 1e3 * EPS, f"steps() runs from {t[0]} to {t[-1] + h[-1]}"
    assert_close(y, np.moveaxis(np.asarray(sol.sol(t)), -1, 0), 1e4 * EPS, "states of steps() differ from the run's")
    if bare_step(integrator, system) is not None or integrator.tangent_holds:
        return
    with np.errstate(all="ignore"):
        stepped = np.asarray(integrator.step(system, 0.0, y, h))
    tolerance = 1e4 * EPS if isinstance(integrator, FixedStep) else max(1e4 * EPS, 0.1 * _rtol(integrator))
    assert_close(stepped[:-1], y[1:], tolerance, "step() does not give the next state of the run, but differs")
    if isinstance(integrator, FixedStep):
        assert_close(
            stepped[-1], sol.y[:, -1], 1e4 * EPS, "step() does not give the last state of the run, but differs"
        )


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
    assert sol.sol is not None, "there is no dense output"
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
    from sympflow.solver import solve

    reference = solve(system, "dop853", (0.0, T_END), start(system), dense_output=True, rtol=1e-12, atol=1e-14).sol
    assert reference is not None
    error = np.abs(inside - reference(times[within]).T).max()
    allowed = np.abs(sol.y - reference(sol.t)).max()
    assert error <= 20 * allowed + 1e-3 * np.abs(sol.y).max(), f"within steps it is wrong by {error:.1e}"


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
            assert sol.t_events is not None and sol.y_events is not None and sol.sol is not None, "there are no events"
            found = sol.t_events[0]
            what = f"of direction {direction} towards t = {t_end}"
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
    """The run of a batch, some of which blow up, has status −1 for these and 0 for the others."""
    bad = 1e150 * np.ones(2 * system.ndof)
    y0, times = np.stack([start(system), bad]), np.array([0.0, 8.0])
    with np.errstate(all="ignore"):
        outcome = integrator.run(Problem(system, 0.0, 8.0, y0, t_eval=times))
    finite = np.isfinite(np.asarray(outcome.y)).all(axis=(0, 2))
    status = np.broadcast_to(outcome.status, (2,))
    for i, name in ((0, "an ordinary state"), (1, "a state that may blow up")):
        wanted = 0 if finite[i] else -1
        assert status[i] == wanted, f"run() gives {name} of a batch status {status[i]}; its outputs call for {wanted}"


ALL: tuple[Callable[[Integrator, HamiltonianSystem], None], ...] = (
    the_run_is_its_steps,
    states_within_a_step_belong_to_it,
    the_start_time_does_not_matter,
    every_event_is_found,
    save_every_thins_the_outputs,
    a_batch_reports_its_failures,
)
