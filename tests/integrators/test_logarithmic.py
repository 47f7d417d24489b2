"""The logarithmic Hamiltonian: Kepler ellipses followed exactly, outputs at physical times, close encounters."""

import numpy as np
import pytest

from sympflow import (
    ClockedFit,
    HamiltonianSystem,
    get,
    load,
    max_energy_error,
    shipped_flows,
    solve,
    systems,
    time_transformed,
    train,
)
from sympflow.integrators.base import Problem
from sympflow.integrators.clocks import PhysicalRun
from sympflow.integrators.flows import LogSympFlow
from sympflow.interop.scipy import as_scipy
from sympflow.systems.celestial import kepler_ellipse


@pytest.mark.parametrize("e", [0.9, 0.99, 0.999])
def test_the_leapfrog_stays_on_the_ellipse(e):
    kepler = systems.kepler(e)
    sol = solve(kepler, "log_leapfrog")  # 100 periods, 1000 steps each
    assert max_energy_error(sol) < 1e-9
    assert abs(sol.stats["n_steps"] - 100_000) < 100
    q1, q2 = sol.q
    r = np.hypot(q1, q2)
    # r = a(1 − e²)/(1 + e cos φ): on the ellipse, though late or early; rounding at the pericentre is 1/(1 − e) larger
    assert np.abs(r + e * q1 - (1 - e * e)).max() < 1e-9


def test_a_collision_ends_the_run_with_its_time():
    kepler = systems.kepler(0.9)
    with pytest.warns(RuntimeWarning, match=r"about t = 1\.110720734, by a collision"):  # π/√8, into the centre
        sol = solve(kepler, "log_leapfrog", (0.0, 10.0), y0=[1.0, 0.0, 0.0, 0.0])
    assert sol.status in (0, -1)
    assert np.isfinite(sol.y).all()
    escape = solve(systems.henon_heiles(), "log_leapfrog", (0.0, 10.0), y0=[0.0, 0.0, 0.0, 0.7], dt=0.2)
    assert escape.status == -1
    assert "time hardly advances any more" in escape.message
    assert escape.t[-1] <= escape.stats["failed_at"] < 5.450984210235402


# flows with a trained clock ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clocked():
    return train(systems.kepler(), ClockedFit(1.0))


def test_the_clock_learns_how_late_the_leapfrog_is(clocked):
    """2 z³ a^(3/2) (1/3 − z²/5 + z⁴/7 − …), z = s/(2√a), a = 1/(2B): the time that it is ahead of 2 arctan z."""
    np.testing.assert_allclose(clocked.clock.numbers[:3], [-1 / 12, 1 / 40, -1 / 112], rtol=1e-4)
    assert clocked.figures["one_step_error_max"] < 1e-11  # labels to 1e-13, times the speed near the pericentre
    assert clocked.figures["fractional_error"] <= clocked.figures["one_step_error"]


def test_it_is_right_in_the_physical_time(clocked):
    e, kepler = 0.6, systems.kepler()
    anomaly = np.linspace(0.0, 40 * np.pi, 61)
    times = anomaly - e * np.sin(anomaly)
    sol = solve(kepler, LogSympFlow(flow=clocked), (0.0, times[-1]), t_eval=times)
    # rounding in t, 1e-14 a step, times the largest speed, 2, and acceleration, 6
    np.testing.assert_allclose(sol.y.T, kepler_ellipse(e, anomaly), rtol=0, atol=1e-11)
    dense = solve(kepler, LogSympFlow(flow=clocked), (0.0, times[-1]), dense_output=True)
    np.testing.assert_allclose(dense.sol(times).T, kepler_ellipse(e, anomaly), rtol=0, atol=1e-11)


def test_a_flow_in_another_time_is_asked_for_by_name_or_by_a_tolerance_that_no_other_meets():
    kepler = systems.kepler()
    anomaly = np.linspace(0.0, 6 * np.pi, 7)
    times = anomaly - 0.6 * np.sin(anomaly)
    flow = next(f for f in shipped_flows(kepler) if f.shift is not None)
    for options in ({"flow": flow.name}, {"flow": flow.load(kepler)}, {"tol": 1e-10}):
        sol = solve(kepler, "sympflow", (0.0, times[-1]), t_eval=times, **options)
        assert sol.integrator.name == "log_sympflow"
        np.testing.assert_allclose(sol.y.T, kepler_ellipse(0.6, anomaly), rtol=0, atol=1e-11)
    with pytest.raises(ValueError, match=r"^`system` 'kepler' .* in another time: pass time_transformed\(system, 0\)"):
        load(flow.path, system=kepler)
    with pytest.raises(ValueError, match=r"^`compensated`"):
        solve(kepler, "sympflow", (0.0, 1.0), flow=flow.name, compensated=True)
    with pytest.raises(ValueError, match=r"^`tol` 1e-20 is not met by any flow"):
        solve(kepler, "sympflow", (0.0, 1.0), tol=1e-20)


@pytest.mark.parametrize("dt", [None, 0.5])
def test_dt_is_the_mean_physical_step_by_the_clock_of_the_flow(clocked, dt):
    """Over whole periods: the orbit is followed exactly, in equal steps of the eccentric anomaly."""
    t_end = 200 * np.pi
    sol = solve(systems.kepler(), LogSympFlow(flow=clocked, dt=dt), (0.0, t_end), t_eval=[t_end])
    assert abs(sol.stats["n_steps"] - t_end / sol.stats["dt"]) <= 1
    assert dt in (None, sol.stats["dt"])
    with pytest.raises(ValueError, match=r"^`dt` must be at most 0\.92"):  # 2 atan(1/2) of the anomaly
        solve(systems.kepler(), LogSympFlow(flow=clocked, dt=0.95), (0.0, 1.0))


EPS = np.finfo(float).eps


@pytest.mark.parametrize("method", ["log_leapfrog", "log_blanes_moan4", "clocked"])
@pytest.mark.parametrize("t_end", [40.0, -40.0])
def test_few_kept_states_give_the_outputs_of_all(method, t_end, clocked):
    kepler = systems.kepler()
    integrator = LogSympFlow(flow=clocked, shift=0.0, dt=0.3) if method == "clocked" else get(method)(dt=0.3)
    clock = integrator.on_clock(kepler)
    many = kepler.domain.sample(150, 2)  # of energies of different numbers of steps
    few, dense = np.array([0.0, 0.0, t_end]), np.linspace(0.0, t_end, 301)
    for y0, times in ((many[0], few), (many[0], dense), (many, few), (many[:70], dense[:50]), (many[:1], None)):
        run, each = (PhysicalRun(clock, Problem(kepler, 0.0, t_end, y0, times)) for _ in range(2))
        each.stride = 1
        made, expected = run.outcome(), each.outcome()
        assert made.y.shape == expected.y.shape
        np.testing.assert_array_equal(made.t, expected.t)
        # rounding enters at each of about 140 steps, and moves the phase linearly in time
        np.testing.assert_allclose(made.y, expected.y, rtol=0, atol=140**2 * 10 * EPS)
        np.testing.assert_array_equal(made.status, expected.status)
        if times is few:
            assert run.stride > 1
            assert made.stats["n_steps"] == expected.stats["n_steps"]


def test_the_name_that_a_run_in_another_time_reports_is_a_name_to_call_it_by():
    kepler = systems.kepler()
    by_flow = solve(kepler, "sympflow", (0.0, 5.0), flow="kepler-log-1")
    assert by_flow.integrator.name == "log_sympflow"
    assert get("log_sympflow") is type(by_flow.integrator)
    for options in ({}, {"flow": "kepler-log-1"}):  # the flow that ships, with its shift
        np.testing.assert_array_equal(solve(kepler, "log_sympflow", (0.0, 5.0), **options).y, by_flow.y)
    with pytest.raises(ValueError, match=r"^`flow` is needed: no flow in another time ships for 'henon_heiles'"):
        solve(systems.henon_heiles(), "log_sympflow", (0, 1))
    with pytest.raises(TypeError, match=r"^`flow` must be a SympFlow of the transformed system"):
        solve(kepler, "log_sympflow", (0, 1), flow=3)
    with pytest.raises(TypeError, match=r"^`flow` runs in another time.* SciPy cannot drive: use solve\(\)"):
        as_scipy("sympflow", kepler, flow="kepler-log-1")


def test_float32_and_functions_run_with_arrays():
    kepler = systems.kepler(0.6)
    functions = HamiltonianSystem(
        potential=lambda q: -1 / (q**2).sum(-1).sqrt(), ndof=2, y0=kepler.y0, dt=kepler.dt, name="functions"
    )
    times = [0.0, 1.0, 7.0]
    reference = solve(kepler, "log_leapfrog", (0.0, 7.0), dt=0.02, t_eval=times)
    sol = solve(functions, "log_leapfrog", (0.0, 7.0), dt=0.02, t_eval=times)
    np.testing.assert_allclose(sol.y, reference.y, rtol=0, atol=1e-11)
    single = solve(kepler, "log_leapfrog", (0.0, 7.0), dt=0.02, t_eval=times, dtype="float32")
    assert single.y.dtype == np.float32
    np.testing.assert_allclose(single.y, reference.y, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("method", "order"), [("log_leapfrog", 2), ("log_blanes_moan4", 4)])
def test_outputs_are_at_physical_times(method, order):
    e, kepler, period = 0.9, systems.kepler(0.9), 2 * np.pi
    anomaly = np.linspace(0, 2 * np.pi, 9)
    times = anomaly - e * np.sin(anomaly)
    errors = [
        np.abs(solve(kepler, method, (0, period), dt=period / n, t_eval=times).y.T - kepler_ellipse(e, anomaly))
        for n in (400, 800)
    ]
    assert errors[1].max() < errors[0].max() / 2 ** (order - 0.3)


def test_the_time_of_an_output_is_met_to_rounding():
    # where the ellipse is followed exactly, the state tells the time that the leapfrog has for it
    kepler = systems.kepler(0.9)
    transformed = time_transformed(kepler)
    run = solve(transformed, "leapfrog", (0.0, 2.0), dt=0.01)
    t, y = run.y[2], run.y[[0, 1, 3, 4]]
    sol = solve(kepler, "log_leapfrog", (0.0, float(t[-1])), dt=0.01, t_eval=t)  # ds = dt·2|E| = dt
    speed = np.abs(np.diff(y) / np.diff(t)).max()
    assert np.abs(sol.y - y).max() < 1e-12 * speed
    assert np.array_equal(sol.t, t)


METHODS = ("log_leapfrog", "log_blanes_moan4", "log_kahan_li8")


MASSES, PLACES = (3, 4, 5), ((1, 3), (-2, -1), (1, -1))


PYTHAGOREAN = HamiltonianSystem.from_sympy(
    "+".join(f"(p{2 * i + 1}**2 + p{2 * i + 2}**2)/{2 * MASSES[i]}" for i in range(3))
    + "".join(
        f" - {MASSES[i] * MASSES[j]}/sqrt((q{2 * i + 1} - q{2 * j + 1})**2 + (q{2 * i + 2} - q{2 * j + 2})**2)"
        for i in range(3)
        for j in range(i + 1, 3)
    ),
    y0=[*np.ravel(PLACES), *[0.0] * 6],
    t_span=(0.0, 70.0),
    dt=1e-3,
)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_close_binary_and_its_escape(method):
    limits = {"log_leapfrog": (1e-3, None), "log_blanes_moan4": (1e-5, 0.1), "log_kahan_li8": (1e-9, 1e-2)}
    energy, state = limits[method]
    sol = solve(PYTHAGOREAN, method, t_eval=[15.83, 35.0, 70.0])
    assert max_energy_error(sol) < energy
    reference = [6.933464, 20.261804, -2.003006, -6.872463, -2.557673, -6.659112]  # 128-bit arithmetic
    if state is not None:
        assert np.abs(sol.q[:, -1] - reference).max() < state


def test_the_transformed_functions_are_the_derivatives_of_each_other():
    functions = HamiltonianSystem(
        potential=lambda q: -1 / (q**2).sum(-1).sqrt(), ndof=2, y0=systems.kepler(0.6).y0, name="functions"
    )
    symbolic, plain = time_transformed(systems.kepler(0.6)), time_transformed(functions)
    x = np.array([[0.3, 0.4, 1.0, -0.2, 0.9, 0.7], [1.0, 0.2, -3.0, 0.1, 0.4, 0.5]])
    for name in ("hamiltonian", "gradient", "hessian"):
        np.testing.assert_allclose(getattr(plain, name)(x), getattr(symbolic, name)(x), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(symbolic.hamiltonian(symbolic.y0), 0.0, atol=1e-14)


@pytest.mark.parametrize("sign", [1, -1])
def test_events_are_found_in_physical_time(sign):
    """An orbit of period 2π crosses its axis each half of it."""
    sol = solve(systems.kepler(0.9), "log_kahan_li8", (0.0, sign * 20.0), events=lambda t, y: y[1])
    np.testing.assert_allclose(sol.t_events[0], sign * np.pi * np.arange(7), rtol=0, atol=1e-9)


def test_a_trajectory_of_a_batch_is_the_one_alone(monkeypatch):
    kepler, options = systems.kepler(), {"t_span": (0.0, 40.0), "t_eval": [13.0, 40.0], "dt": 0.1}
    y0 = kepler.domain.sample(40, 2)
    alone = [solve(kepler, "log_leapfrog", y0=y, **options).y for y in y0]
    monkeypatch.setattr("sympflow.integrators.clocks.LARGEST_CHUNK", 4000)  # so that chunks are others
    np.testing.assert_array_equal(solve(kepler, "log_leapfrog", y0=y0, **options).y, alone)


@pytest.mark.parametrize("backend", ["array", "auto"])
@pytest.mark.slow
def test_states_of_an_infinite_energy(backend):
    """V that overflows is refused; T that does is a run that fails at its start, whatever is asked of it."""
    system, still = systems.henon_heiles(), [0.0, 0.0, 0.0]
    for y0 in ([0.0, -2e154, 0.0, 0.0], [0.0, -1e200, 0.0, 1e200], [[*still, 0.1], [0.0, -1e308, 0.0, 0.0]]):
        with pytest.raises(ValueError, match=r"^`y0` has the energy inf: give a state of a finite one\."):
            solve(system, "log_leapfrog", (0.0, 0.2), y0=y0, backend=backend)
    for asked in ({}, {"t_eval": [0.1, 0.2]}, {"dense_output": True}):
        sol = solve(system, "log_leapfrog", (0.0, 0.2), y0=[*still, 2e154], backend=backend, **asked)
        assert (sol.status, sol.stats["failed_at"]) == (-1, 0.0)
    batch = solve(system, "log_leapfrog", (0.0, 0.2), y0=[[*still, 0.1], [*still, 2e154]], backend=backend)
    assert batch.status.tolist() == [0, -1]


def test_a_potential_that_is_0_over_0_has_a_logarithm():
    system = HamiltonianSystem.from_sympy("p**2/2 + sin(q)/q", y0=[1.0, 0.1])
    expected = solve(system, "kahan_li8", (0.0, 5.0), dt=0.02).y[:, -1]
    found = solve(system, "log_kahan_li8", (0.0, 5.0), dt=0.02, t_eval=[5.0]).y[:, -1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
