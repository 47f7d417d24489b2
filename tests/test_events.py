"""Events: zeros of functions of t and y along the solution, for every method, with SciPy's attributes."""

import re

import numpy as np
import pytest
import torch
from conftest import KINDS
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, SympFlow, get, solve, systems
from sympflow.integrators.contract import FINISHED, Integrator, Outcome
from sympflow.integrators.interpolants import Interpolant, Piecewise
from sympflow.integrators.tableaux import ADAPTIVE as TORCHDIFFEQ_ADAPTIVE
from sympflow.kernels.explicit_loops import compiled_field

OSCILLATOR, HH = systems.harmonic_oscillator(), systems.henon_heiles()
ADAPTIVE = ["rk45", "dop853", *TORCHDIFFEQ_ADAPTIVE]
MULTISTEP = ["explicit_adams", "implicit_adams"]
METHODS = ["verlet", "srkn6b", "euler", "rk4", *ADAPTIVE, *MULTISTEP]  # every kind
START = [1.0, 0.0]  # q = cos t, p = −sin t
EPS = np.finfo(float).eps


def options(method):
    tight = 1e-5 if (get(method).order or 0) < 5 else 1e-8
    return {"rtol": tight, "atol": 0.01 * tight} if method in ADAPTIVE else {"dt": 0.01}


def tolerance(method):
    """Tolerance of event times up to t = 12, from the order."""
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


@pytest.mark.parametrize(
    ("method", "options"),
    [("verlet", {}), ("kahan_li8", {"compensated": True}), ("gauss_legendre4", {}), ("verlet", {"backend": "array"})],
)
def test_steps_with_events_are_those_without_bit_for_bit(method, options):
    for t_eval in (None, np.linspace(0, 70, 31)):
        found, plain = (solve(HH, method, (0, 70), dt=0.03, t_eval=t_eval, events=g, **options) for g in (zero_q, None))
        np.testing.assert_array_equal(found.y, plain.y)


@pytest.mark.parametrize("method", METHODS)
class TestEveryMethod:
    def test_zeros_of_cos_t(self, method):
        sol = solve(OSCILLATOR, method, (0, 12), START, events=zero_q, t_eval=[], **options(method))
        np.testing.assert_allclose(sol.t_events[0], np.pi * (np.arange(4) + 0.5), atol=tolerance(method))
        assert sol.y_events[0].shape == (4, 2)
        assert np.abs(sol.y_events[0][:, 0]).max() < 1e-13  # at the zero of the dense output, to rounding
        assert (sol.status, sol.t.size) == (0, 0)

    @pytest.mark.filterwarnings("ignore:`dt` .* is too long")
    def test_a_terminal_event_ends_the_solution_there(self, method):
        falling = event(zero_q, terminal=True, direction=-1)
        for t_end in (12, -12):
            sol = solve(OSCILLATOR, method, (0, t_end), START, events=falling, dense_output=True, **options(method))
            expected = 0.5 * np.pi if t_end > 0 else -0.5 * np.pi
            assert sol.t[-1] == sol.t_events[0][-1] == pytest.approx(expected, abs=tolerance(method))
            np.testing.assert_allclose(sol.y[:, -1], sol.y_events[0][-1], atol=4 * EPS)
            np.testing.assert_allclose(sol.sol(sol.t[-1]), sol.y[:, -1], atol=64 * EPS)
            assert (sol.status, sol.success, sol.message) == (1, True, "A termination event occurred.")
            assert (np.diff(sol.t) * np.sign(t_end) > 0).all()

    def test_output_times_beyond_a_terminal_event_are_dropped(self, method):
        at_one = event(lambda t, y: t - 1.0, terminal=True)
        sol = solve(OSCILLATOR, method, (0, 2), START, t_eval=[0.0, 0.5, 1.5], events=at_one, **options(method))
        np.testing.assert_array_equal(sol.t, [0.0, 0.5])
        assert sol.t_events[0] == pytest.approx(1.0, abs=1e-14)

    @pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
    def test_events_before_a_blow_up_are_kept(self, method):
        arguments = {"y0": [0, 0, 0, 0.7], "events": lambda t, y: t - 2.0, "t_eval": [1.0, 10.0]}
        sol = solve(HH, method, (0, 20), **arguments, **(options(method) | loose(method)))
        assert sol.status == -1
        assert sol.t.tolist() == [1.0]
        assert sol.t_events[0] == pytest.approx([2.0])


@pytest.mark.parametrize("method", ["rk45", "dop853"])
def test_the_results_are_scipys(method):
    """Times, states, statuses and outputs of `solve_ivp` itself, with all attributes at once."""
    events = [event(zero_q, direction=1), event(lambda t, y: y[1], terminal=3), event(lambda t, y: y[0] - 0.1)]
    for t_span in ((0, 30), (0, -30)):
        field = compiled_field(HH)
        theirs = solve_ivp(field, t_span, HH.y0, method=method.upper(), events=events, dense_output=True)
        ours = solve(HH, method, t_span, events=events, dense_output=True)
        assert (ours.status, ours.message) == (theirs.status, theirs.message)
        np.testing.assert_allclose(ours.t, theirs.t, rtol=8 * EPS)
        np.testing.assert_allclose(ours.y, theirs.y, atol=8 * EPS)
        for i in range(3):
            np.testing.assert_allclose(ours.t_events[i], theirs.t_events[i], rtol=8 * EPS)
            np.testing.assert_allclose(ours.y_events[i], theirs.y_events[i], atol=8 * EPS)
        assert ours.to_scipy().t_events is ours.t_events


def test_directions():
    """cos t falls through its first zero."""

    def zeros(direction):
        g = event(lambda t, y: y[0], direction=direction)
        return solve(OSCILLATOR, "verlet", (0, 20), START, events=g).t_events[0].tolist()

    both = zeros(0)
    assert len(both) == 6
    assert zeros(-1) == both[0::2]
    assert zeros(1) == zeros(0.5) == both[1::2]


@pytest.mark.parametrize("terminal", [1, 2, 4, np.True_, np.int64(2), 2.0])
def test_the_solution_ends_at_the_occurrence_of_that_number(terminal):
    sol = solve(OSCILLATOR, "kahan_li8", (0, 100), START, events=event(zero_q, terminal=terminal))
    assert sol.status == 1
    assert sol.t_events[0] == pytest.approx(np.pi * (np.arange(int(terminal)) + 0.5), abs=1e-12)


@pytest.mark.filterwarnings("ignore:`dt` .* is too long")
def test_a_zero_on_a_step_counts_once_and_a_zero_at_the_start_counts():
    sol = solve(OSCILLATOR, "verlet", (0, 1), START, dt=0.25, events=[lambda t, y: t - 0.5, lambda t, y: t])
    assert [t.tolist() for t in sol.t_events] == [[0.5], [0.0]]


@pytest.mark.parametrize("as_tensor", [False, True])
def test_long_steps_are_sampled_within(as_tensor):
    """By default every `system.dt`, so that both of two close zeros are seen; the run stays the same."""

    def arc(t, y):
        return (t - 1.2) * (t - 1.8)

    y0 = torch.tensor(START, dtype=torch.float64) if as_tensor else START
    for t_end, expected in ((2.5, [1.2, 1.8]), (1.9, [1.2, 1.8]), (1.5, [1.2])):
        sols = []
        for more in ({"events": arc}, {}, {"events": arc, "event_step": 1.0}, {"events": arc, "event_step": 0.3}):
            with pytest.warns(RuntimeWarning, match="`dt` 1 is too long"):
                sols.append(solve(OSCILLATOR, "verlet", (0, t_end), y0, dt=1.0, **more))
        sol, plain, coarse, fine = sols
        np.testing.assert_allclose(sol.t_events[0], expected, atol=1e-15)
        np.testing.assert_array_equal(sol.y, plain.y)
        assert coarse.t_events[0].size == expected.count(1.2) * (t_end < 1.8)
        assert fine.t_events[0].size == len(expected)


@pytest.mark.parametrize("method", KINDS)
@pytest.mark.parametrize("t_end", [8.0, -8.0])
@pytest.mark.filterwarnings("ignore:`dt` .* is too long")
def test_the_state_of_an_event_is_the_dense_output_there(method, t_end):
    """For every kind of method; without end and with one."""
    if method == "mlp" and t_end < 0:
        return  # it has no inverse, so no backward time
    for terminal in (None, 2):
        g = event(lambda t, y: y[0] - 0.05, terminal=terminal)
        sol = solve(HH, method, (0, t_end), events=g, dense_output=True, on_domain_exit="ignore", **loose(method))
        assert sol.status == (0 if terminal is None else 1)
        check_states_of_events(sol)


def loose(method):
    return {"rtol": 1e-4, "atol": 1e-6} if method in ADAPTIVE else {}


def check_states_of_events(sol):
    assert sol.t_events[0].size >= 2
    np.testing.assert_allclose(sol.sol(sol.t_events[0]).T, sol.y_events[0], rtol=0, atol=256 * EPS)
    for t, y in zip(sol.t_events[0], sol.y_events[0], strict=True):
        np.testing.assert_allclose(sol.sol(t), y, rtol=0, atol=256 * EPS)
        assert abs(y[0] - 0.05) < 256 * EPS


def test_events_of_tensors():
    y0 = torch.tensor(START, dtype=torch.float64, requires_grad=True)
    for method in ("verlet", "dopri5", "rk4", SympFlow(1).requires_grad_(False)):
        sol = solve(OSCILLATOR, method, (0, 3), y0, events=lambda t, y: y[0] - 0.5, on_domain_exit="ignore")
        assert isinstance(sol.y_events[0], torch.Tensor)
        assert sol.y_events[0].shape[1] == 2
    assert torch.autograd.grad(sol.y.sum(), y0)[0].isfinite().all()


class Unwatched(Integrator):
    """A third party's integrator that looks for no events: the exact rotation, reported every 0.5."""

    name, order, symplectic = "unwatched", None, False
    dense = True

    @classmethod
    def options(cls):
        return ()

    def run(self, problem):
        t = np.linspace(problem.t0, problem.t1, 1 + round(2 * abs(problem.t1 - problem.t0)))
        y = np.stack([np.cos(t), -np.sin(t)], axis=-1)
        f = np.stack([y[:, 1], -y[:, 0]], axis=-1)
        steps = [Interpolant(t[k], t[k + 1], y[k], lambda k=k: (y[k : k + 2], f[k : k + 2])) for k in range(len(t) - 1)]
        sol = Piecewise(steps, problem.y0, problem.t0, problem.t1) if self.dense else None
        return Outcome(t, y, 0, FINISHED, {"force_evaluations": 0}, sol)


@pytest.mark.parametrize("t_end", [8.0, -8.0])
def test_integrators_that_look_for_no_events_are_searched_afterwards(t_end):
    zeros = np.sign(t_end) * np.pi * np.array([0.5, 1.5, 2.5])
    run = {"system": OSCILLATOR, "method": Unwatched(), "t_span": (0, t_end), "y0": START}
    sol = solve(events=event(zero_q), **run)
    np.testing.assert_allclose(sol.t_events[0], zeros, atol=1e-3)
    assert (sol.status, sol.sol, sol.t[-1], len(sol.t)) == (0, None, t_end, 17)
    ends = solve(events=event(zero_q, terminal=2), dense_output=True, **run)
    np.testing.assert_allclose(ends.t_events[0], zeros[:2], atol=1e-3)
    assert (ends.status, ends.t[-1]) == (1, ends.t_events[0][-1])
    np.testing.assert_allclose(ends.sol(ends.t), ends.y, atol=64 * EPS)
    at = solve(events=event(zero_q, terminal=2), t_eval=np.sign(t_end) * np.array([1.0, 2.0, 7.0]), **run)
    np.testing.assert_allclose(at.y[0], np.cos(at.t), atol=1e-3)
    assert len(at.t) == 2


def test_without_dense_output_events_are_refused():
    sparse = type("Sparse", (Unwatched,), {"dense": False})()
    with pytest.raises(
        ValueError, match=r"^`events` are located on the dense output, which method 'unwatched' does not"
    ):
        solve(OSCILLATOR, sparse, (0, 1), START, events=zero_q)


def test_an_empty_list_of_events_is_an_empty_list_of_results():
    sol = solve(OSCILLATOR, "verlet", (0, 1), events=[])
    assert (sol.t_events, sol.y_events) == ([], [])
    assert solve(OSCILLATOR, "verlet", (0, 1)).t_events is None
    fixed = HamiltonianSystem.from_sympy("p**2/2 + q**2/2", y0=START)
    assert solve(fixed, "verlet", (2, 2), events=lambda t, y: y[1]).t_events[0].size == 0


@pytest.mark.parametrize("method", ["verlet", "rk45", "dopri5", "log_leapfrog"])
def test_an_event_function_that_writes_into_its_state_changes_no_result(method):
    def spoils(t, y):
        y[0] = 99.0
        return 1.0

    oscillator = systems.harmonic_oscillator()
    sol = solve(oscillator, method, (0.0, 1.0), events=spoils)
    np.testing.assert_array_equal(sol.y, solve(oscillator, method, (0.0, 1.0), events=lambda t, y: 1.0).y)


class TestAnInfiniteEnd:
    """A terminal event ends a run whose interval has no end; a limit on steps, where it never comes."""

    @pytest.mark.parametrize("sign", [1, -1])
    @pytest.mark.parametrize("method", ["verlet", "sympflow", "rk45", "dopri5", "explicit_adams"])
    def test_the_event_ends_it(self, method, sign):
        def third(t, y):
            return y[0]

        third.terminal = 3
        endless = solve(OSCILLATOR, method, (0, sign * np.inf), [1.0, 0.0], events=third, dense_output=True)
        finite = solve(OSCILLATOR, method, (0, sign * 20), [1.0, 0.0], events=third, dense_output=True)
        assert (endless.status, endless.message) == (1, "A termination event occurred.")
        np.testing.assert_array_equal(endless.t_events[0], finite.t_events[0])
        np.testing.assert_array_equal(endless.y, finite.y)
        np.testing.assert_array_equal(endless.sol(sign * 1.234), finite.sol(sign * 1.234))
        assert endless.t_span == (0.0, endless.t_events[0][-1])  # finite, for what executes the run again

    def test_an_event_that_never_comes(self, monkeypatch):
        def never(t, y):
            return y[0] - 5

        never.terminal = True
        monkeypatch.setattr("sympflow.solver.MOST_OPEN_STEPS", 1000)
        monkeypatch.setattr("sympflow.integrators.scipy_methods.MOST_OPEN_STEPS", 1000)
        for method, n in (("verlet", 1000), ("rk45", 1000)):
            sol = solve(OSCILLATOR, method, (0, np.inf), [1.0, 0.0], events=never)
            assert (sol.status, sol.success, sol.stats["n_steps"]) == (-1, False, n)
            assert re.match(
                r"No terminal event ended the run within 1,000 steps, up to t = [\d.]+\. Check", sol.message
            )
            assert sol.t_span[1] == sol.t[-1]
        blow_up = solve(systems.henon_heiles(), "verlet", (0, np.inf), [0.0, 0.0, 0.0, 0.9], events=never)
        assert "non-finite after t = 4.7" in blow_up.message

    @pytest.mark.parametrize("events", [None, lambda t, y: y[0]])
    def test_without_a_terminal_event_it_is_refused(self, events):
        with pytest.raises(ValueError, match=r"^`t_span` must be finite; .*or pass a terminal event"):
            solve(OSCILLATOR, "rk45", (0, np.inf), [1.0, 0.0], events=events)

    def test_of_a_method_that_is_searched_afterwards(self):
        def third(t, y):
            return y[0]

        third.terminal = 3
        sol = solve(systems.kepler(), "log_leapfrog", (0, np.inf), events=third, t_eval=[1.0, 2.0, 1e6])
        assert (sol.status, sol.t.tolist(), len(sol.t_events[0])) == (1, [1.0, 2.0], 3)
        assert 6 < sol.t_events[0][-1] < 3 * np.pi


@pytest.mark.filterwarnings("ignore:`dt` .* is too long")
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


def test_a_zero_between_the_samples_of_a_flow_is_found(rotation):
    """cos 7t has seven pairs of zeros in three steps of Δt = 1, up to three within one."""
    sol = solve(OSCILLATOR, rotation, (0, 9), START, t_eval=[], events=lambda t, y: np.cos(7 * t) + 0 * y[0])
    np.testing.assert_allclose(sol.t_events[0], np.pi * (np.arange(20) + 0.5) / 7, atol=1e-12)
