"""Events: zeros of functions of t and y along the solution, for every method, with SciPy's attributes."""

import tracemalloc

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, SympFlow, get, solve, systems
from sympflow.integrators.base import Integrator
from sympflow.integrators.tableaux import ADAPTIVE as TORCHDIFFEQ_ADAPTIVE

OSCILLATOR, HH = systems.harmonic_oscillator(), systems.henon_heiles()
ADAPTIVE = ["rk45", "dop853", *TORCHDIFFEQ_ADAPTIVE]
METHODS = ["verlet", "srkn6b", "chin4a", "euler", "rk4", *ADAPTIVE]  # every kind; the splittings share one driver
START = [1.0, 0.0]  # q = cos t, p = −sin t
T_STAR = 5.450984210235402  # where this orbit of Hénon–Heiles becomes singular
EPS = np.finfo(float).eps


def options(method):
    tight = 1e-5 if (get(method).order or 0) < 5 else 1e-8
    return {"rtol": tight, "atol": 0.01 * tight} if method in ADAPTIVE else {"dt": 0.01}


def tolerance(method):
    """Of event times up to t = 12, from the order."""
    return {1: 0.2, 2: 1e-2, 3: 1e-2}.get(get(method).order, 1e-5)


def event(function, terminal=None, direction=None):
    """A fresh function with attributes."""

    def g(t, y):
        return function(t, y)

    if terminal is not None:
        g.terminal = terminal
    if direction is not None:
        g.direction = direction
    return g


def zero_q(t, y):
    return y[0]


@pytest.mark.parametrize("method", METHODS)
class TestEveryMethod:
    def test_zeros_of_cos_t(self, method):
        sol = solve(OSCILLATOR, method, (0, 12), START, events=zero_q, t_eval=[], **options(method))
        np.testing.assert_allclose(sol.t_events[0], np.pi * (np.arange(4) + 0.5), atol=tolerance(method))
        assert sol.y_events[0].shape == (4, 2)
        assert np.abs(sol.y_events[0][:, 0]).max() < 1e-13  # at the zero of the dense output, to rounding
        assert (sol.status, sol.t.size) == (0, 0)

    def test_a_terminal_event_ends_the_solution_there(self, method):
        falling = event(zero_q, terminal=True, direction=-1)
        for t_end in (12, -12):
            sol = solve(OSCILLATOR, method, (0, t_end), START, events=falling, dense_output=True, **options(method))
            expected = 0.5 * np.pi if t_end > 0 else -0.5 * np.pi
            assert sol.t[-1] == sol.t_events[0][-1] == pytest.approx(expected, abs=tolerance(method))
            np.testing.assert_allclose(sol.y[:, -1], sol.y_events[0][-1], atol=4 * EPS)
            np.testing.assert_allclose(sol.sol(sol.t[-1]), sol.y[:, -1], atol=1e-3 if method in ADAPTIVE else 8 * EPS)
            assert (sol.status, sol.success, sol.message) == (1, True, "A termination event occurred.")
            assert (np.diff(sol.t) * np.sign(t_end) > 0).all()

    def test_the_run_is_the_one_without_events(self, method):
        times = np.linspace(0, 5, 7)
        with_events = solve(HH, method, (0, 5), t_eval=times, events=zero_q, **options(method))
        without = solve(HH, method, (0, 5), t_eval=times, **options(method))
        np.testing.assert_allclose(with_events.y, without.y, atol=1e3 * EPS)

    def test_output_times_beyond_a_terminal_event_are_dropped(self, method):
        at_one = event(lambda t, y: t - 1.0, terminal=True)
        sol = solve(OSCILLATOR, method, (0, 2), START, t_eval=[0.0, 0.5, 1.5], events=at_one, **options(method))
        np.testing.assert_array_equal(sol.t, [0.0, 0.5])
        assert sol.t_events[0] == pytest.approx(1.0, abs=1e-14)

    def test_events_before_a_blow_up_are_kept(self, method):
        arguments = {"y0": [0, 0, 0, 0.7], "events": lambda t, y: t - 2.0, "t_eval": [1.0, 10.0]}
        sol = solve(HH, method, (0, 20), **arguments, **options(method))
        assert sol.status == -1
        assert sol.t.tolist() == [1.0]
        assert sol.t_events[0] == pytest.approx([2.0])


@pytest.mark.parametrize("method", ["rk45", "dop853"])
def test_the_results_are_scipys(method):
    """Times, states, statuses and outputs of `solve_ivp` itself, with all attributes at once."""
    events = [event(zero_q, direction=1), event(lambda t, y: y[1], terminal=3), event(lambda t, y: y[0] - 0.1)]
    for t_span in ((0, 30), (0, -30)):
        theirs = solve_ivp(HH, t_span, HH.y0, method=method.upper(), events=events, dense_output=True)
        ours = solve(HH, method, t_span, events=events, dense_output=True)
        assert (ours.status, ours.message) == (theirs.status, theirs.message)
        np.testing.assert_allclose(ours.t, theirs.t, rtol=8 * EPS)
        np.testing.assert_allclose(ours.y, theirs.y, atol=8 * EPS)
        for i in range(3):
            np.testing.assert_allclose(ours.t_events[i], theirs.t_events[i], rtol=8 * EPS)
            np.testing.assert_allclose(ours.y_events[i], theirs.y_events[i], atol=8 * EPS)
        assert ours.to_scipy().t_events is ours.t_events


def test_directions():
    def count(direction):
        g = event(lambda t, y: y[0], direction=direction)
        return len(solve(OSCILLATOR, "verlet", (0, 20), START, events=g).t_events[0])

    assert (count(0), count(1), count(-1), count(0.5)) == (6, 3, 3, 3)


@pytest.mark.parametrize("terminal", [1, 2, 4])
def test_the_solution_ends_at_the_occurrence_of_that_number(terminal):
    sol = solve(OSCILLATOR, "kahan_li8", (0, 100), START, events=event(zero_q, terminal=terminal))
    assert sol.t_events[0] == pytest.approx(np.pi * (np.arange(terminal) + 0.5), abs=1e-12)


def test_of_several_events_in_a_step_the_first_terminal_one_counts():
    """One step of length 1; zeros at 0.3, 0.5 and 0.7, given out of order."""
    events = [
        event(lambda t, y: t - 0.7, terminal=True),
        event(lambda t, y: t - 0.5, terminal=True),
        lambda t, y: t - 0.3,
        lambda t, y: t - 0.6,
    ]
    sol = solve(OSCILLATOR, "verlet", (0, 3), START, dt=1.0, events=events)
    assert [t.tolist() for t in sol.t_events] == [[], [pytest.approx(0.5)], [pytest.approx(0.3)], []]
    assert sol.y_events[0].shape == (0, 2)


def test_a_zero_on_a_step_counts_once_and_a_zero_at_the_start_counts():
    sol = solve(OSCILLATOR, "verlet", (0, 1), START, dt=0.25, events=[lambda t, y: t - 0.5, lambda t, y: t])
    assert [t.tolist() for t in sol.t_events] == [[0.5], [0.0]]


def test_two_zeros_within_a_step_are_found_with_event_step():
    def arc(t, y):
        return (t - 0.2) * (t - 0.8)

    coarse = {"t_span": (0, 2), "y0": START, "dt": 1.0, "events": arc}
    assert solve(OSCILLATOR, "verlet", **coarse).t_events[0].size == 0
    fine = solve(OSCILLATOR, "verlet", event_step=0.3, **coarse)
    np.testing.assert_allclose(fine.t_events[0], [0.2, 0.8], atol=1e-15)
    np.testing.assert_array_equal(fine.y, solve(OSCILLATOR, "verlet", (0, 2), START, dt=1.0).y)  # the same run


def test_all_zeros_of_cos_t_with_the_exact_flow(rotation):
    """The three shears of a rotation, Δt = 1: the 64 zeros of cos t in [0, 200], each to 1e-10."""
    sol = solve(OSCILLATOR, rotation, (0, 200), START, t_eval=[], events=zero_q, on_domain_exit="ignore")
    assert sol.stats["n_steps"] == 200
    np.testing.assert_allclose(sol.t_events[0], np.pi * (np.arange(64) + 0.5), rtol=0, atol=1e-10)
    back = solve(OSCILLATOR, rotation, (0, -200), START, t_eval=[], events=zero_q, on_domain_exit="ignore")
    np.testing.assert_allclose(back.t_events[0], -sol.t_events[0], rtol=0, atol=1e-10)


def test_events_of_tensors():
    y0 = torch.tensor(START, dtype=torch.float64, requires_grad=True)
    for method in ("verlet", "dopri5", "rk4", SympFlow(1).requires_grad_(False)):
        sol = solve(OSCILLATOR, method, (0, 3), y0, events=lambda t, y: y[0] - 0.5, on_domain_exit="ignore")
        assert isinstance(sol.y_events[0], torch.Tensor)
        assert sol.y_events[0].shape[1] == 2
    assert torch.autograd.grad(sol.y.sum(), y0)[0].isfinite().all()


def test_no_state_is_stored_for_events():
    run = {"t_span": (0, 500), "y0": START, "dt": 0.005, "events": zero_q, "t_eval": []}
    solve(OSCILLATOR, "verlet", **run)
    tracemalloc.start()
    sol = solve(OSCILLATOR, "verlet", **run)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (sol.stats["n_steps"], sol.t_events[0].size) == (100_000, 159)
    assert peak < 1e6  # every state would take 1.6 MB


class Unwatched(Integrator):
    name, order, symplectic = "unwatched", None, False

    @classmethod
    def options(cls):
        return ()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"events": 3}, TypeError, r"^`events` must be a function g\(t, y\) or a list"),
        ({"events": [zero_q, "q"]}, TypeError, r"^`events\[1\]` must be a function"),
        ({"events": event(zero_q, terminal=0.5)}, ValueError, r"^`events` has `terminal` = 0.5"),
        ({"events": event(zero_q, terminal=-1)}, ValueError, r"^`events` has `terminal`"),
        ({"events": event(zero_q, direction="up")}, ValueError, r"^`events` has `direction` = 'up'"),
        ({"events": lambda t, y: y}, TypeError, r"^`events` must return one number"),
        ({"events": zero_q, "event_step": 0}, ValueError, r"^`event_step` must be a positive"),
        ({"event_step": 0.1}, ValueError, r"^`event_step` samples events, but there are none"),
        ({"events": zero_q, "y0": [START, START]}, ValueError, r"^`events` are found along one trajectory"),
        ({"events": zero_q, "method": "explicit_adams"}, ValueError, r"^`events` are not found by method"),
        ({"events": zero_q, "method": Unwatched()}, ValueError, r"^`events` are not found by method 'unwatched'"),
    ],
)
def test_bad_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message) as raised:
        solve(OSCILLATOR, **{"method": "verlet", "t_span": (0, 1), "y0": START, **arguments})
    assert str(raised.value).endswith(".")


def test_an_empty_list_of_events_is_an_empty_list_of_results():
    sol = solve(OSCILLATOR, "verlet", (0, 1), events=[])
    assert (sol.t_events, sol.y_events) == ([], [])
    assert solve(OSCILLATOR, "verlet", (0, 1)).t_events is None
    fixed = HamiltonianSystem.from_sympy("p**2/2 + q**2/2", y0=START)
    assert solve(fixed, "verlet", (2, 2), events=lambda t, y: y[1]).t_events[0].size == 0
