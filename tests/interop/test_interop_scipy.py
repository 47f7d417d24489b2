"""Our methods inside `solve_ivp`: the same numbers as `solve`, and all that SciPy's driver asks of a solver."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from conftest import KINDS, refusals
from scipy.integrate import solve_ivp

from sympflow import HamiltonianSystem, SympFlow, available, get, solve, systems
from sympflow.arrays import stack
from sympflow.integrators.base import FixedStep
from sympflow.interop.scipy import as_scipy

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long for method .euler.:RuntimeWarning")

HH, OSCILLATOR, PENDULUM = systems.henon_heiles(), systems.harmonic_oscillator(), systems.pendulum()
EPS = np.finfo(float).eps
METHODS = [
    name
    for name in available()
    if issubclass(get(name), FixedStep) and get(name).on_grid and getattr(get(name), "splitting", "") != "kepler"
]
OF_EACH_KIND = [name for name in METHODS if name in KINDS]
TRAINED = ("sympflow", "mlp")
BLOW_UP = [0.0, 0.0, 0.0, 0.7]


def solver(method, **options):
    return as_scipy(method, HH, **({} if method in TRAINED else {"dt": 0.1}), **options)


def same(method, t_span, y0=HH.y0, **arguments):
    extra = {} if method in TRAINED else {"dt": 0.1}
    return solve(HH, method, t_span, y0=y0, on_domain_exit="ignore", **extra, **arguments)


@pytest.mark.parametrize(
    ("method", "t_span"),
    [*((m, (0.5, 7.77)) for m in METHODS), *((m, t) for m in OF_EACH_KIND for t in ((0.0, 10.0), (3.0, -4.2)))],
)
def test_steps_and_states_are_those_of_solve(method, t_span):
    if method == "mlp" and t_span[1] < t_span[0]:
        return  # it has no inverse
    ours, theirs = same(method, t_span), solve_ivp(HH, t_span, HH.y0, method=solver(method))
    np.testing.assert_allclose(theirs.t, ours.t, rtol=4 * EPS)
    np.testing.assert_allclose(theirs.y, ours.y, atol=200 * EPS)
    assert (theirs.status, theirs.success, theirs.message) == (0, True, ours.message)


@pytest.mark.parametrize("method", OF_EACH_KIND)
class TestEveryKind:
    def test_t_eval_and_dense_output(self, method):
        times = np.array([0.0, 0.3, 1.0, 2.345, 5.0])
        theirs = solve_ivp(HH, (0, 5), HH.y0, method=solver(method), t_eval=times, dense_output=True)
        np.testing.assert_allclose(theirs.y, same(method, (0, 5), t_eval=times).y, atol=200 * EPS)
        np.testing.assert_allclose(theirs.sol(times), theirs.y, atol=200 * EPS)
        every = solve_ivp(HH, (0, 5.5), HH.y0, method=solver(method), dense_output=True)
        np.testing.assert_allclose(every.sol(every.t), every.y, atol=200 * EPS)

    def test_events(self, method):
        def section(t, y):
            return y[0]

        def third(t, y):
            return y[1] - 0.1

        section.direction, third.terminal = 1, 3
        for t_span in ((0, 60), (0, -60))[: 1 if method == "mlp" else 2]:
            theirs = solve_ivp(HH, t_span, HH.y0, method=solver(method), events=[section, third])
            ours = same(method, t_span, events=[section, third])
            assert theirs.status == ours.status
            assert (theirs.status == 1) or method == "mlp"  # whose energy drifts
            for i in range(2):
                np.testing.assert_allclose(theirs.t_events[i], ours.t_events[i], rtol=1e-10)
                np.testing.assert_allclose(theirs.y_events[i], ours.y_events[i], atol=1e-9)

    def test_max_step_samples_the_same_run(self, method):
        coarse = solve_ivp(HH, (0, 3), HH.y0, method=solver(method))
        fine = solve_ivp(HH, (0, 3), HH.y0, method=solver(method), max_step=0.04, dense_output=True)
        n = round((len(fine.t) - 1) / (len(coarse.t) - 1))
        assert n == np.ceil(np.diff(coarse.t)[0] / 0.04 - 1e-9)
        np.testing.assert_allclose(fine.y[:, ::n], coarse.y, atol=200 * EPS)
        np.testing.assert_allclose(fine.sol(fine.t), fine.y, atol=200 * EPS)
        none = solve_ivp(HH, (2, 2), HH.y0, method=solver(method), dense_output=True)
        np.testing.assert_array_equal([none.y[:, -1], none.sol(2.0)], [HH.y0, HH.y0])


@pytest.fixture
def counting():
    """Hénon–Heiles by functions that count the forces that are evaluated."""
    evaluated = []

    def gradient(q):
        evaluated.append(math.prod(q.shape) // 2)
        return stack([q[..., 0] + 2 * q[..., 0] * q[..., 1], q[..., 1] + q[..., 0] ** 2 - q[..., 1] ** 2])

    system = HamiltonianSystem(lambda q: 0 * q[..., 0], ndof=2, gradient=gradient, y0=HH.y0, check=False)
    return system, lambda: sum(evaluated)


def terminal(t, y):
    return y[0] - 0.2


terminal.terminal = 3


@pytest.mark.parametrize("method", ["verlet", "kahan_li8", "rk4"])
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"t_eval": np.linspace(0, 9.99, 77)},
        {"dense_output": True, "max_step": 0.04},
        {"events": [terminal, lambda t, y: y[1]]},
    ],
)
def test_every_evaluation_of_a_force_is_counted(method, arguments, counting):
    """Steps, those computed ahead, outputs and events between them, `fun`, and its comparison with the method."""
    system, evaluated = counting
    sol = solve_ivp(system, (0, 9.99), HH.y0, method=as_scipy(method, system, dt=0.1), **arguments)
    assert sol.nfev == evaluated()
    before, of_fun = evaluated(), []

    def fun(t, y):
        of_fun.append(t)
        return HH(t, y)

    other = solve_ivp(fun, (0, 9.99), HH.y0, method=as_scipy(method, system, dt=0.1), **arguments)
    assert other.nfev == evaluated() - before + len(of_fun)
    assert len(of_fun) < 20


def test_a_blow_up_ends_with_status_minus_one():
    sol = solve_ivp(HH, (0, 20), BLOW_UP, method=as_scipy("verlet", HH, dt=0.01))
    assert (sol.status, sol.success) == (-1, False)
    assert "non-finite after t = 5." in sol.message
    assert np.isfinite(sol.y).all()


class TestAnotherSystem:
    """A right-hand side that is not what the method solves is refused, wherever it differs: here 1e-6 and more."""

    @pytest.mark.parametrize("turn", [1.2, 2.2, 2.45])
    def test_that_differs_only_where_the_run_comes_to(self, turn):
        """The states around the start and those of the domain do not tell; the run itself does."""

        def fun(t, y):
            return [y[1], -np.sin(y[0]) - (y[0] - turn if y[0] > turn else 0.0)]

        with pytest.raises(ValueError, match=r"^`fun` is not the system that method 'verlet' solves: at t = \d"):
            solve_ivp(fun, (0, 60), [0.0, 1.9], method=as_scipy("verlet", PENDULUM))

    @pytest.mark.parametrize("strength", [lambda t: 0.01 * t, np.sin, lambda t: 31 < t < 36, lambda t: t > 99.6])
    def test_that_depends_on_the_time(self, strength):
        """It agrees at t0: what changes later, for a while or at the end, is seen."""

        def fun(t, y):
            return [y[1], -np.sin(y[0]) * (1 + strength(t))]

        with pytest.raises(ValueError, match=r"^`fun` depends on the time: .* method 'verlet' solves an autonomous"):
            solve_ivp(fun, (0, 100), [0.0, 1.9], method=as_scipy("verlet", PENDULUM))


def test_a_flow_and_a_name_without_system():
    by_flow = solve_ivp(HH, (0, 5), HH.y0, method=as_scipy(get("sympflow")().flow_for(HH)))
    np.testing.assert_array_equal(by_flow.y, solve_ivp(HH, (0, 5), HH.y0, method=as_scipy("sympflow")).y)
    by_name = solve_ivp(HH, (0, 1), HH.y0, method=as_scipy("verlet", dt=0.1))
    np.testing.assert_allclose(by_name.y, same("verlet", (0, 1)).y, atol=8 * EPS)


class TestBadInput:
    @pytest.mark.parametrize(
        ("fun", "y0", "error", "message"),
        [
            (HH, np.zeros((4, 1)), ValueError, "`y0` must be 1-dimensional"),
            (HH, np.array(HH.y0, dtype=complex), ValueError, "complex"),
            (HH, [1.0, 0.0], ValueError, r"^`y0` must have length 4"),
            (HH, [np.nan, 0.0, 0.0, 0.0], ValueError, "`y0` must be finite"),
            (lambda t, y: y[:2], HH.y0, ValueError, r"^`fun` must return shape \(4,\)"),
        ],
    )
    def test_of_states_and_right_hand_sides(self, fun, y0, error, message):
        with pytest.raises(error, match=message):
            solve_ivp(fun, (0, 1), y0, method=as_scipy("verlet", HH))

    def test_of_options_and_times(self):
        verlet = as_scipy("verlet", HH)
        with pytest.warns(UserWarning, match="atol, rtol have no effect"):
            solve_ivp(HH, (0, 1), HH.y0, method=verlet, rtol=1e-3, atol=1e-6)
        with pytest.warns(UserWarning, match=r"dt have no effect .*; dt is an option of as_scipy"):
            solve_ivp(HH, (0, 1), HH.y0, method=verlet, dt=0.1)


def driven(method, fun=HH, span=(0, 1), y0=HH.y0, **options):
    return lambda: solve_ivp(fun, span, y0, method=method() if callable(method) else method, **options)


test_refusals = refusals(
    (lambda: as_scipy("rk45", HH), TypeError, "^`method` 'rk45' is not a fixed-step map"),
    (lambda: as_scipy("nothing", HH), "^`method` 'nothing' is unknown"),
    (lambda: as_scipy("verlet", lambda t, y: y), TypeError, "^`system` must be a HamiltonianSystem; got function"),
    (lambda: as_scipy("verlet", HH, rtol=1e-3), TypeError, "^`rtol` is not an option"),
    (lambda: as_scipy(SympFlow(1), HH), "^`system` .* degrees of freedom"),
    (lambda: as_scipy("sympflow", systems.harmonic_oscillator(3.7)), "no shipped sympflow flow"),
    (lambda: as_scipy("log_leapfrog", systems.kepler()), TypeError, "^`method` .* takes steps that are not equal in t"),
    (driven("sympflow"), "^`method` must be one of .* or OdeSolver class"),
    (driven(lambda: SympFlow(2)), "^`method` must be one of .* or OdeSolver class"),
    (driven(lambda: as_scipy("verlet", HH), max_step="a"), "^`max_step` must be positive; got 'a'"),
    (driven(lambda: as_scipy("verlet", HH), max_step=-1), "^`max_step` must be positive"),
    (driven(lambda: as_scipy("verlet", HH), first_step=-1), "^`first_step` must be positive"),
    (driven(lambda: as_scipy("verlet", HH), first_step=100), "^`first_step` 100 exceeds the interval"),
    (driven(lambda: as_scipy("verlet"), lambda t, y: y), TypeError, "^`system` is needed for method 'verlet'"),
    (driven(lambda: as_scipy("mlp", HH), span=(1, 0)), (TypeError, ValueError), "inverse|negative"),
    (driven(lambda: as_scipy("verlet", PENDULUM), y0=HH.y0[:2]), "is not the system .*: their Hamilt"),
    (
        driven(lambda: as_scipy(SympFlow.primed(PENDULUM).to(torch.float32)), PENDULUM, y0=[1.0, 0.0]),
        TypeError,
        "^`y0` is torch.float64, but .*float32",
    ),
    (lambda: solve_ivp(HH, (0, 1), HH.y0, vectorized=True), "^`y` must have shape .*leave `vectorized` out"),
)


def test_an_infinite_end_without_an_event_says_so(monkeypatch):
    monkeypatch.setattr("sympflow.interop.scipy.open_end", lambda t0, t1, dt: t0 + np.copysign(1000 * dt, t1))
    verlet = as_scipy("verlet", OSCILLATOR, dt=0.005)
    for end, t in ((np.inf, 5.0), (-np.inf, -5.0)):
        result = solve_ivp(OSCILLATOR, (0.0, end), [1.0, 0.0], method=verlet)
        assert (result.status, result.t[-1]) == (-1, pytest.approx(t, abs=1e-12))
        assert result.message.startswith("No terminal event ended the run within 1,000 steps, up to t = ")
    for span in ((0.0, np.nan), (-np.inf, np.inf), (np.nan, 1.0)):
        with pytest.raises(ValueError, match=r"^`t_span` must start at a finite time"):
            solve_ivp(OSCILLATOR, span, [1.0, 0.0], method=verlet)


def test_solutions_and_solvers_are_pickled_and_copied():
    method = as_scipy("kahan_li8", OSCILLATOR, dt=0.3)
    assert pickle.loads(pickle.dumps(method)).integrator == method.integrator
    result = solve_ivp(OSCILLATOR, (0, 1), [1.0, 0.0], method=method, dense_output=True)
    for again in (pickle.loads(pickle.dumps(result.sol)), copy.deepcopy(result.sol)):
        np.testing.assert_array_equal(again(0.4321), result.sol(0.4321))
    solver = method(OSCILLATOR, 0.0, [1.0, 0.0], 3.0)
    solver.step()
    twin = copy.deepcopy(solver)
    for each in (solver, twin, twin):
        each.step()
    np.testing.assert_allclose(solver.y, [np.cos(0.6), -np.sin(0.6)], atol=1e-8)
    np.testing.assert_allclose(twin.y, [np.cos(0.9), -np.sin(0.9)], atol=1e-8)


def test_two_events_within_a_step_are_seen_with_max_step(rotation):
    arguments = {"events": lambda t, y: (t - 0.2) * (t - 0.8), "method": as_scipy(rotation)}
    assert solve_ivp(OSCILLATOR, (0, 2), [1.0, 0.0], **arguments).t_events[0].size == 0
    assert solve_ivp(OSCILLATOR, (0, 2), [1.0, 0.0], max_step=0.3, **arguments).t_events[0].size == 2
