"""The properties that SciPy's suite asks of its own solvers (`scipy/integrate/_ivp/tests/test_ivp.py`), asked of ours.

Its systems are not Hamiltonian; here they are the oscillator, whose solution is known, and the fall of a cannon ball.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, systems
from sympflow.interop.scipy import as_scipy

OSCILLATOR = systems.harmonic_oscillator()
SPANS = ((5.0, 9.0), (5.0, 1.0))
Y0 = [np.cos(5.0), -np.sin(5.0)]
SOLVERS = {
    name: as_scipy(name, OSCILLATOR, **options)
    for name, options in {
        "verlet": {"dt": 0.005},
        "kahan_li8": {"dt": 0.3},
        "rk4": {"dt": 0.05},
        "sympflow": {},
    }.items()
}
by_solver = pytest.mark.parametrize("method", SOLVERS.values(), ids=SOLVERS.keys())
by_span = pytest.mark.parametrize("t_span", SPANS, ids=["forward", "backward"])


def exact(t):
    return np.array([np.cos(t), -np.sin(t)])


def fun(t, y):
    return [y[1], -y[0]]


def check(result, t_span, tolerance=1e-5):
    assert (result.t[0], result.t[-1]) == t_span
    assert (result.status, result.success, result.t_events, result.njev, result.nlu) == (0, True, None, 0, 0)
    np.testing.assert_allclose(result.y, exact(result.t), atol=tolerance)
    for t in (np.linspace(*t_span), np.mean(t_span)):
        np.testing.assert_allclose(result.sol(t), exact(t), atol=tolerance)
    np.testing.assert_allclose(result.sol(result.t), result.y, rtol=1e-15, atol=1e-15)


@by_span
@by_solver
class TestIntegration:
    def test_both_directions_and_dense_output(self, method, t_span):
        check(solve_ivp(fun, t_span, Y0, method=method, dense_output=True), t_span)

    def test_max_step(self, method, t_span):
        result = solve_ivp(fun, t_span, Y0, method=method, max_step=0.11, dense_output=True)
        check(result, t_span)
        assert np.abs(np.diff(result.t)).max() <= 0.11 + 1e-14
        with pytest.raises(ValueError, match="`max_step` must be positive"):
            method(fun, t_span[0], Y0, t_span[1], max_step=-1)
        solver = method(fun, t_span[0], Y0, t_span[1], max_step=1e-20)
        message = solver.step()
        assert solver.status == "failed"
        assert message.startswith("Required step size is less than spacing between numbers. Raise `max_step`")
        with pytest.raises(RuntimeError, match="on a failed"):
            solver.step()

    def test_first_step(self, method, t_span):
        """It has no effect, and is looked at all the same."""
        for wrong in (-1, 0, np.nan, 5):
            with pytest.raises(ValueError, match=r"^`first_step`"):
                method(fun, t_span[0], Y0, t_span[1], first_step=wrong)
        with pytest.warns(UserWarning, match="first_step have no effect"):
            check(solve_ivp(fun, t_span, Y0, method=method, first_step=0.1, dense_output=True), t_span)

    def test_t_eval(self, method, t_span):
        way = t_span[1] - t_span[0]
        for part in (np.linspace(0, 1, 10), [0, 0.0025, 0.5, 0.75, 0.7525, 1], [0.0025, 0.5, 0.75, 0.7525]):
            t = t_span[0] + way * np.array(part)
            for dense in (False, True):
                result = solve_ivp(fun, t_span, Y0, method=method, t_eval=t, dense_output=dense)
                np.testing.assert_array_equal(result.t, t)
                np.testing.assert_allclose(result.y, exact(t), atol=1e-5)
        with pytest.raises(ValueError, match="not within `t_span`"):
            solve_ivp(fun, t_span, Y0, method=method, t_eval=[t_span[0] - way, t_span[0]])

    def test_events(self, method, t_span):
        """Zeros of q and of p, in each direction, and one that ends the run."""

        def q(t, y):
            return y[0]

        def p(t, y):
            return y[1]

        def end(t, y):
            return t - t_span[0] - 0.6 * (t_span[1] - t_span[0])

        def found(direction, *more):
            q.direction = p.direction = direction
            result = solve_ivp(fun, t_span, Y0, method=method, events=(q, p, *more), dense_output=True)
            for times, states in zip(result.t_events, result.y_events, strict=True):
                if len(times):
                    np.testing.assert_allclose(states, exact(times).T, atol=2e-5)
            return result

        def zeros(low):
            times = low + np.pi * np.arange(-5, 6)
            return sorted(times[(times - t_span[0]) * (times - t_span[1]) < 0], key=lambda t: abs(t - t_span[0]))

        both = found(0)
        assert both.status == 0
        np.testing.assert_allclose(both.t_events[0], zeros(np.pi / 2), atol=2e-5)
        np.testing.assert_allclose(both.t_events[1], zeros(0.0), atol=2e-5)
        up, down = found(1), found(-1)
        for a, b, whole in zip(up.t_events, down.t_events, both.t_events, strict=True):
            np.testing.assert_allclose(sorted([*a, *b]), sorted(whole), atol=1e-9)
        end.terminal = True
        ended = found(0, end)
        assert (ended.status, ended.message) == (1, "A termination event occurred.")
        assert ended.t[-1] == pytest.approx(t_span[0] + 0.6 * (t_span[1] - t_span[0]), abs=1e-12)
        t = np.linspace(t_span[0], ended.t[-1])  # that an event ends the run breaks no interpolant
        np.testing.assert_allclose(ended.sol(t), exact(t), atol=1e-5)

    def test_an_event_before_the_first_output(self, method, t_span):
        middle = np.mean(t_span)

        def early(t, y):
            return t - middle

        early.terminal = True
        late = np.linspace(middle + 0.1 * (t_span[1] - middle), t_span[1], 5)
        result = solve_ivp(fun, t_span, Y0, method=method, t_eval=late, events=early)
        assert (result.status, result.success, len(result.t), len(result.y)) == (1, True, 0, 0)
        np.testing.assert_array_equal(result.t_events, [[middle]])

    def test_the_class(self, method, t_span):
        for bound in (t_span[1], np.copysign(np.inf, t_span[1] - t_span[0])):
            solver = method(fun, t_span[0], Y0, bound)
            assert (solver.n, solver.status, solver.t_bound, solver.t, solver.t_old) == (2, "running", bound, 5.0, None)
            assert solver.direction == np.sign(bound - 5.0)
            assert solver.step_size is None
            assert (solver.njev, solver.nlu) == (0, 0)
            with pytest.raises(RuntimeError, match="successful step"):
                solver.dense_output()
            assert solver.step() is None
            assert (solver.t_old, solver.step_size) == (5.0, abs(solver.t - 5.0))
            np.testing.assert_allclose(solver.dense_output()(solver.t), solver.y, atol=1e-15)
            np.testing.assert_allclose(solver.y, exact(solver.t), atol=1e-5)

    def test_nothing_is_evaluated_beyond_the_interval(self, method, t_span):
        def within(t, y):
            assert min(t_span) <= t <= max(t_span)
            return fun(t, y)

        assert solve_ivp(within, t_span, Y0, method=method, max_step=0.3, dense_output=True).success

    def test_an_infinite_end_with_a_terminal_event(self, method, t_span):
        def fifth(t, y):
            return y[0]

        fifth.terminal = 5
        endless = (t_span[0], np.copysign(np.inf, t_span[1] - t_span[0]))
        result = solve_ivp(fun, endless, Y0, method=method, events=fifth, dense_output=True)
        assert (result.status, len(result.t_events[0])) == (1, 5)
        np.testing.assert_allclose(np.cos(result.t_events[0]), 0, atol=1e-4)
        np.testing.assert_allclose(result.sol(result.t), result.y, atol=1e-12)


def test_a_cannon_ball_that_is_back_within_a_few_samples():
    """Steps so short that times might repeat, an infinite end, and the state before and after the event."""
    fall = HamiltonianSystem(lambda q: 9.80665 * q[..., 0], ndof=1, gradient=lambda q: np.full_like(q, 9.80665))

    def hit_ground(t, y):
        return y[0]

    hit_ground.terminal, hit_ground.direction = True, -1
    result = solve_ivp(
        lambda t, y: [y[1], -9.80665],
        [0, np.inf],
        [0, 0.01],
        method=as_scipy("verlet", fall, dt=0.05),
        max_step=0.05 * 0.001 / 9.80665,
        events=hit_ground,
        dense_output=True,
    )
    assert (result.status, result.success) == (1, True)
    np.testing.assert_allclose(result.t_events, [[0.02 / 9.80665]], rtol=1e-9)
    np.testing.assert_allclose(result.y_events, [[[0.0, -0.01]]], atol=1e-12)
    np.testing.assert_allclose(result.sol(0.01), [0.0001 - 9.80665 * 0.01**2 / 2, 0.01 - 0.0980665], rtol=1e-9)


@by_solver
def test_no_integration(method):
    result = solve_ivp(fun, [4, 4], [2, 3], method=method, dense_output=True)
    np.testing.assert_array_equal(result.sol(4), [2, 3])
    np.testing.assert_array_equal(result.sol([4, 5, 6]), [[2, 2, 2], [3, 3, 3]])
    solver = method(fun, 0.0, [1.0, 0.0], 0.0)
    solver.step()
    assert (solver.status, solver.step_size) == ("finished", 0.0)
    np.testing.assert_array_equal(solver.dense_output()(0.0), [1.0, 0.0])


@pytest.mark.parametrize("n", [3, 4])
def test_the_event_of_a_number_ends_the_run(n):
    def zero(t, y):
        return y[0]

    zero.terminal = n
    result = solve_ivp(fun, (0, 100), [1, 0], method=SOLVERS["kahan_li8"], events=zero)
    assert len(result.t_events[0]) == len(result.y_events[0]) == n
    np.testing.assert_allclose(result.y_events[0][:, 0], 0, atol=1e-13)
    for wrong in (-1, 3.5):
        zero.terminal = wrong
        with pytest.raises(ValueError, match="`terminal` attribute"):
            solve_ivp(fun, (0, 100), [1, 0], method=SOLVERS["kahan_li8"], events=zero)


def test_args_reach_the_function_and_the_events():
    def scaled(t, y, omega, level):
        return [y[1], -(omega**2) * y[0]]

    def at_level(t, y, omega, level):
        return y[0] - level

    at_level.direction = -1
    method = SOLVERS["kahan_li8"]
    result = solve_ivp(scaled, (0, 8), [1.0, 0.0], method=method, args=(1.0, 0.5), events=at_level)
    np.testing.assert_allclose(result.t_events[0], [np.pi / 3, np.pi / 3 + 2 * np.pi], atol=1e-7)
    with pytest.raises(ValueError, match=r"^`fun` is not the system"):
        solve_ivp(scaled, (0, 5), [1.0, 0.0], method=method, args=(1.1, 0.5))
    with pytest.raises(TypeError, match="Supplied 'args' cannot be unpacked"):
        solve_ivp(scaled, (0, 5), [1.0, 0.0], method=method, args=-1)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_the_initial_state_must_be_finite(wrong):
    with pytest.raises(ValueError, match="must be finite"):
        solve_ivp(fun, [0, 1], [wrong, 0.0], method=SOLVERS["verlet"])
