"""Poincaré sections: the crossings are on the plane, on the method's map, and all of them."""

import json

import numpy as np
import pytest
import torch
from conftest import KINDS

import sympflow
from sympflow import HamiltonianSystem, poincare_section, solve, systems
from sympflow.integrators.tableaux import ADAPTIVE

HH, OSCILLATOR = systems.henon_heiles(), systems.harmonic_oscillator()


@pytest.mark.filterwarnings("ignore:`dt` 0.05 is too long for method .euler.:RuntimeWarning")
@pytest.mark.parametrize("method", KINDS)
def test_the_crossings_are_those_that_events_find(method):
    def g(t, y):
        return y[0]

    g.direction = 1
    options = {"rtol": 1e-4, "atol": 1e-6} if method in ADAPTIVE else {}
    section = poincare_section(HH, method, (0.0, 20.0), sample=0.1, **options)
    sol = solve(HH, method, (0.0, 20.0), t_eval=[], events=g, event_step=0.1, on_domain_exit="ignore", **options)
    assert len(section) == len(sol.t_events[0]) > 1
    np.testing.assert_allclose(section.t, sol.t_events[0], atol=1e-12)
    np.testing.assert_allclose(section.states, sol.y_events[0], atol=1e-12)
    assert np.abs(section.states[:, 0]).max() < 1e-13


@pytest.mark.parametrize("direction", [-1, 0, 1])
@pytest.mark.parametrize("t_end", [20.0, -20.0])
@pytest.mark.parametrize("method", ["kahan_li8", "dop853"])
def test_a_start_on_the_plane_counts_as_it_does_for_events(method, direction, t_end):
    def g(t, y):
        return y[0]

    g.direction = direction
    y0 = np.array([[0.0, 1.0], [0.0, -1.0], [0.5, 0.1]])  # the first leaves upwards, the second downwards
    section = poincare_section(OSCILLATOR, method, (0, t_end), y0, direction=direction)
    for k in range(3):
        sol = solve(OSCILLATOR, method, (0, t_end), y0[k], t_eval=[], events=g)
        assert (0.0 in sol.t_events[0]) == (k < 2 and direction in (0, (-1) ** k * np.sign(t_end)))
        np.testing.assert_allclose(section.t[section.trajectory == k], sol.t_events[0], atol=1e-12)


ESCAPING = [0.0, 0.1, 1.0, 5.0]


@pytest.mark.parametrize("method", ["verlet", "kahan_li8", "rk45"])
def test_a_blow_up_is_reported_as_solve_reports_it(method):
    options = {} if method == "rk45" else {"dt": 0.05}
    alone = poincare_section(HH, method, (0, 50), ESCAPING, **options)
    sol = solve(HH, method, (0, 50), ESCAPING, on_domain_exit="ignore", **options)
    assert (alone.status, alone.success) == (sol.status, sol.success) == (-1, False)
    assert alone.message == sol.message
    assert alone.table().endswith(alone.message)
    together = poincare_section(HH, method, (0, 50), [HH.y0, ESCAPING], **options)
    assert together.status.tolist() == [0, -1]
    assert together.message.startswith("1 of 2 trajectories failed, the first of them (index 1)")
    fine = poincare_section(HH, method, (0, 5), **options)
    assert (fine.status, fine.success, fine.message) == (0, True, solve(HH, method, (0, 5), **options).message)


def test_a_batch_is_the_loop():
    y0 = HH.domain.sample(5, 1)
    together = poincare_section(HH, "verlet", (0, 50), y0.reshape(5, 1, 4), coordinate="q2", level=0.1)
    for k in range(5):
        alone = poincare_section(HH, "verlet", (0, 50), y0[k], coordinate=1, level=0.1)
        np.testing.assert_allclose(together.t[together.trajectory == k], alone.t, atol=1e-11)
        np.testing.assert_allclose(together.states[together.trajectory == k], alone.states, atol=1e-11)


def test_rows_table_csv_and_figure(tmp_path):
    section = poincare_section(HH, "verlet", (0, 200), HH.domain.sample(3))
    row = section.rows[0]
    assert (row.trajectory, row.t) == (0, section.t[0])
    assert [row.q1, row.q2, row.p1, row.p2] == section.states[0].tolist()
    assert section.table(3).splitlines()[0].split() == ["trajectory", "t", "q2", "p1", "p2"]
    assert section.table(3).splitlines()[-1] == f"… {len(section) - 3} more"
    read = np.genfromtxt(section.to_csv(tmp_path / "section.csv"), delimiter=",", names=True)
    np.testing.assert_array_equal(read["p2"], section.states[:, 3])
    content = json.loads(section.to_json(tmp_path / "section.json").read_text())
    assert (content["system"]["name"], content["method"], content["coordinate"]) == ("henon_heiles", "verlet", "q1")
    assert content["rows"][0] == {"trajectory": 0, "t": row.t, "q1": row.q1, "q2": row.q2, "p1": row.p1, "p2": row.p2}
    figure = section.plot(path=tmp_path / "section.png")
    assert (tmp_path / "section.png").stat().st_size > 5000
    (ax,) = figure.axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("q2", "p2")
    np.testing.assert_array_equal(ax.collections[0].get_offsets(), section.states[:, [1, 3]])
    assert section.plot("q2", "p1").axes[0].get_ylabel() == "p1"


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"coordinate": "q3"}, ValueError, r"^`coordinate` must be one of q1, q2, p1, p2"),
        ({"coordinate": 4}, ValueError, r"^`coordinate` must be one of"),
        ({"direction": 2}, ValueError, r"^`direction` must be 1"),
        ({"sample": 0}, ValueError, r"^`sample` must be a positive"),
        ({"sample": "x"}, ValueError, r"^`sample` must be a positive number, a time; got 'x'"),
        ({"sample": np.nan}, ValueError, r"^`sample` must be a positive"),
        ({"level": np.nan}, ValueError, r"^`level` must be a finite number"),
        ({"level": "a"}, ValueError, r"^`level` must be a finite number.* got 'a'"),
        ({"y0": torch.zeros(4)}, TypeError, r"^`y0` is a tensor"),
        ({"method": "mlp", "t_span": (1, 0)}, ValueError, r"^`t_span` runs backwards, but method 'mlp' has no inverse"),
    ],
)
def test_bad_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        poincare_section(HH, **{"method": "verlet", "t_span": (0, 1), **arguments})


# stroboscopic -------------------------------------------------------------------------------------------------------

DUFFING, KICKED = systems.duffing(), systems.kicked(0.9, 1)


@pytest.mark.parametrize(("method", "options"), [("kahan_li8", {"dt": 0.1}), ("dop853", {"rtol": 1e-9, "atol": 1e-9})])
@pytest.mark.parametrize("n", [3, -1])
def test_a_stroboscopic_section_has_the_states_after_whole_periods(method, options, n):
    """All N trajectories at once, the start among them, from any t0; fixed steps end there."""
    T, t0, sign = DUFFING.period, 0.7, np.sign(n)
    y0 = np.array([[0.5, 0.1], [1.0, -0.2]])
    section = poincare_section(DUFFING, method, (t0, t0 + (n + 0.4 * sign) * T), y0, **options)
    times = t0 + sign * T * np.arange(abs(n) + 1)
    exact = solve(DUFFING, "dop853", (t0, times[-1]), y0, t_eval=times, rtol=1e-12, atol=1e-13)
    assert section.trajectory.tolist() == [0] * len(times) + [1] * len(times)
    np.testing.assert_allclose(section.t, np.tile(times, 2), rtol=1e-14)
    np.testing.assert_allclose(section.states, np.moveaxis(exact.y, -1, -2).reshape(-1, 2), atol=1e-6)
    assert section.success
    assert section.period == T
    assert section.coordinate is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"period": 1.0, "coordinate": 0}, r"^`period` and `coordinate` choose two kinds"),
        ({"period": 1.0, "direction": 1}, r"^`period` and `direction` choose two kinds"),
        ({"period": -1.0}, r"^`period` must be positive"),
        ({"t_span": (0, 1)}, r"^`t_span` \(0, 1\) is shorter than the period"),
    ],
)
def test_bad_stroboscopic_arguments(arguments, words):
    with pytest.raises(ValueError, match=words):
        poincare_section(DUFFING, "verlet", **arguments)


def test_a_driven_system_without_a_period_needs_one():
    system = sympflow.HamiltonianSystem.from_sympy("p**2/2 + q**2*(1 + t**2)/2", time="t", y0=[1.0, 0.0])
    with pytest.raises(ValueError, match=r"is driven, .* no period of its own: give `period`"):
        poincare_section(system, "verlet", (0, 1))
    assert len(poincare_section(system, "leapfrog", (0, 1), period=0.5)) == 3
    assert len(poincare_section(OSCILLATOR, "leapfrog", (0, 20), period=2 * np.pi)) == 4  # of any system


SI = {"m": 1e-27, "w": 1e13, "k": 1e20}
TRAP = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2)/(2*m) + m*w**2*(q1**2 + q2**2)/2 + k*q1**2*q2**2", params=SI, t_span=(0, 1e-11)
)


@pytest.mark.parametrize(
    ("system", "energy", "direction"),
    [
        *((systems.henon_heiles(), 0.125, direction) for direction in (1, -1, 0)),
        *((systems.henon_heiles(), 0.01, 1), (TRAP, 1e-21, -1), (systems.pendulum(), 0.7, 0)),
    ],
)
def test_orbits_of_one_energy_start_on_the_plane(system, energy, direction):
    span = system.t_span if system is TRAP else (0, 20 * system.dt)
    section = poincare_section(system, None, span, energy=energy, n=40, direction=direction)
    np.testing.assert_allclose(system.hamiltonian(section.y0), energy, rtol=1e-13)
    assert (section.y0[:, 0] == 0).all()
    velocities = system.vector_field(section.y0)[:, 0]
    assert (direction * velocities >= 0).all()
    if system.ndof == 2:
        spread = np.abs(section.y0[:, 1]).max() / np.abs(section.y0[:, 1]).min()
        assert spread > 10


def test_all_zeros_of_cos_t_upwards_and_downwards(rotation):
    zeros = np.pi * (np.arange(16) + 0.5)
    for t_end in (50.0, -50.0):
        for direction, expected in ((0, zeros), (-1, zeros[0::2]), (1, zeros[1::2])):
            section = poincare_section(OSCILLATOR, rotation, (0.0, t_end), [1.0, 0.0], direction=direction)
            np.testing.assert_allclose(np.abs(section.t), expected, rtol=0, atol=1e-10)


def test_crossings_at_the_ends_of_steps_are_those_that_events_find():
    """Levels that grid states take to the last bit, those at the ends of chunks among them.

    Not the last state of the run: rounding decides whether a run that ends on the plane has reached it.
    """
    run = solve(HH, "kahan_li8", (0, 60), dt=0.1)
    for k in (*range(1, 600, 97), 55, 255, 256, 257):
        level = float(run.y[0, k])
        section = poincare_section(HH, "kahan_li8", (0, 60), level=level, direction=0, dt=0.1)
        sol = solve(HH, "kahan_li8", (0, 60), dt=0.1, t_eval=[], events=lambda t, y, level=level: y[0] - level)
        assert len(section) == len(sol.t_events[0])
        np.testing.assert_allclose(section.t, sol.t_events[0], atol=1e-11)
        assert np.abs(section.t - run.t[k]).min() < 1e-11


def test_the_section_of_waves_is_the_standard_map():
    """The half-kicked one of verlet, whose default step divides the period."""
    K, n = 0.9, 20
    section = poincare_section(KICKED, "verlet", (0, n))
    q, p = section.states.T
    kick = K / 2 * np.sin(q)
    np.testing.assert_allclose(q[1:], q[:-1] + p[:-1] + kick[:-1], atol=1e-13)
    np.testing.assert_allclose(p[1:] - kick[1:], p[:-1] + kick[:-1], atol=1e-13)
    late = section.since(15)
    assert late.t.tolist() == [15, 16, 17, 18, 19, 20]
    assert len(poincare_section(KICKED, "verlet", (0, n), dt=0.3).states) == n + 1  # steps of ¼


def test_a_plane_in_a_driven_system_is_crossed_at_the_times_that_events_find():
    def g(t, y):
        return y[0]

    g.direction = 1
    section = poincare_section(DUFFING, "kahan_li8", (0.3, 60), coordinate="q", dt=0.2)
    sol = solve(DUFFING, "kahan_li8", (0.3, 60), t_eval=[], events=g, dt=0.2)
    assert len(section) == len(sol.t_events[0]) > 1
    np.testing.assert_allclose(section.t, sol.t_events[0], atol=1e-12)
    np.testing.assert_allclose(section.states, sol.y_events[0], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        ({"energy": -1.0}, "`energy` -1 is below"),
        ({"energy": 0.1, "y0": systems.henon_heiles().y0}, "`energy` and `y0`"),
        ({"n": 4}, "`n` orbits are drawn for an `energy`"),
        ({"energy": np.nan}, "`energy` must be a finite number"),
        ({"energy": 10**400}, "`energy` must be a finite number"),
        ({"energy": 0.1, "period": 1.0}, "`period` and `energy`"),
        ({"n": 4, "period": 1.0}, "`period` and `n`"),
    ],
)
def test_energies_are_checked(arguments, answer):
    with pytest.raises(ValueError, match=answer):
        poincare_section(systems.henon_heiles(), "verlet", (0, 1), **arguments)
