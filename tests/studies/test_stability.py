"""stability(): the limits that are known, blow-ups told apart, and what is refused."""

import csv
import json
import math
import re

import numpy as np
import pytest
import torch

import sympflow
from sympflow import HamiltonianSystem, max_energy_error, solve, stability, systems
from sympflow.studies.step_stability import blow_up, initial_states

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

SINGULARITY = 5.450984210235402  # of Hénon–Heiles from q = 0, p = (0, 0.7)


@pytest.mark.parametrize(("method", "omega"), [("verlet", 1.0), ("leapfrog", 1e3), ("verlet", 1e6)])
def test_the_limit_of_an_oscillator_is_two_at_every_frequency(method, omega):
    report = stability(systems.harmonic_oscillator(omega), [method], steps=[1 / omega, 3 / omega], metrics=("energy",))
    (limit,) = report.limits
    assert abs(limit.stable * omega - 2) < 0.02
    assert abs(limit.unstable * omega - 2) < 0.02


@pytest.mark.parametrize(
    ("method", "first"), [("omelyan4", 3.1393), ("mclachlan4", 3.0355), ("srkn14a", 3.1409), ("yoshida6", 2.2691)]
)
def test_the_first_loss_of_stability_is_found_whatever_the_steps(method, first):
    """At ω = 3 the energy is lost from 1.047 on with omelyan4; a sweep that doubles its steps calls 1.788 stable."""
    system = systems.harmonic_oscillator(3.0)
    few = {"metrics": ("energy",), "max_steps": 5000}
    found = [stability(system, [method], steps=steps, **few).limits[0] for steps in ([0.1], [0.3, 1.6], [4.0, 5.0])]
    assert found[0] == found[1] == found[2]
    assert 3 * found[0].stable == pytest.approx(first, abs=6e-5)
    assert found[0].stable < found[0].unstable < found[0].intervals[1][0]
    assert found[0].frequency == pytest.approx(3)


def test_an_overflow_is_never_a_small_error():
    (row,) = stability(systems.harmonic_oscillator(), ["verlet"], steps=[2.5], metrics=("energy",), limits=False).rows
    assert row.status == "unstable"
    assert row.energy_error == np.inf
    assert not row.singular
    assert "grows by a factor 4 a step" in row.reason  # z²/2 − 1 + √((z²/2 − 1)² − 1) at z = 2.5
    assert row.blow_up == solve(systems.harmonic_oscillator(), "verlet", (0, 2500), dt=2.5).stats["failed_at"]


@pytest.mark.parametrize(
    ("method", "dt"),
    [
        *(("verlet", dt) for dt in (0.2, 0.1, 0.02)),
        *(("leapfrog", 0.1), ("kahan_li8", 0.2), ("implicit_midpoint", 0.02), ("gauss_legendre4", 0.2), ("rk4", 0.02)),
    ],
)
def test_a_singularity_is_found_within_a_step(method, dt):
    sol = solve(systems.henon_heiles_escape(), method, (0.0, 10.0), dt=dt)
    assert sol.status == -1
    end = blow_up(sol)
    assert end.singular
    assert end.time == sol.stats["blow_up_time"]
    assert abs(end.time - SINGULARITY) < dt
    assert f"becomes infinite, at about t = {end.time:.10g}" in sol.message


def test_what_is_no_singularity_is_not_called_one():
    """A step beyond the limit, a force that ends, a collision that p survives, and one that it does not."""
    unstable = solve(systems.harmonic_oscillator(), "verlet", (0, 1e4), dt=2.01)
    wall = HamiltonianSystem.from_sympy("p**2/2 + sqrt(q)", y0=[1.0, 0.0], dt=0.01)
    ended = [solve(wall, method, (0, 20)) for method in ("verlet", "rk45")]
    for sol in (unstable, *ended):
        assert sol.status == -1
        assert "blow_up_time" not in sol.stats
        assert "infinite" not in sol.message
    falling = solve(systems.kepler(0.9), "rk45", (0, 10), [1.0, 0, 0, 0])
    assert abs(falling.stats["blow_up_time"] - np.pi / 2**1.5) < 1e-8
    well = solve(systems.harmonic_oscillator(), "verlet", (0, 10), dt=0.1)
    assert "blow_up_time" not in well.stats


def test_a_flow_outside_its_domain_is_not_called_stable():
    """The solution does not exist beyond t*; the flow goes on, finite and wrong, outside Ω."""
    arguments = {"steps": [0.1], "t_span": (0.0, 20.0), "y0": [[0.0, 0.0, 0.0, 0.7]], "min_steps": 1}
    network = sympflow.get("sympflow")(flow="henon_heiles-sympflow")
    report = stability(systems.henon_heiles(), [network], metrics=("energy",), **arguments)
    (row,), (limit,) = report.rows, report.limits
    assert row.status == "outside"
    assert re.search(r"Left the flow's domain at t = [\d.]+, outside of which the flow is not valid\.", row.reason)
    assert limit.stable is None
    assert limit.reached == "none: the solution leaves the flow's domain"


def test_a_map_of_a_family(tmp_path):
    pytest.importorskip("matplotlib")
    family = [systems.harmonic_oscillator(omega) for omega in (1.0, 10.0)]
    report = stability(family, ["verlet", "implicit_midpoint"], steps=[0.1, 1.0], metrics=("energy",), limits=False)
    assert [(row.value, row.status) for row in report.rows if row.label == "verlet"] == [
        (1, "stable"),
        (1, "stable"),
        (10, "stable"),
        (10, "unstable"),
    ]
    for kind in ("map", "steps"):
        report.plot(tmp_path / f"{kind}.png", kind)
        assert (tmp_path / f"{kind}.png").stat().st_size > 5000
    first = report.figure("map").axes[0]
    assert [label.get_text() for label in first.get_yticklabels()] == ["1", "10"]  # not 6×10⁰ and its like
    assert [label.get_text() for label in first.get_xticklabels()] == ["0.1", "1"]
    with pytest.raises(ValueError, match=r"^`kind` must be 'steps' or 'map'"):
        report.figure("pie")
    with pytest.raises(ValueError, match=r"^`kind` 'map' needs several systems"):
        stability(family[0], ["verlet"], steps=[0.1], limits=False).figure("map")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": [0.1, -1]}, r"^`steps` must be positive and finite"),
        ({"steps": 0.1}, r"^`steps` must be a list"),
        ({"bound": "a"}, r"^`bound` must be positive and finite"),
        ({"bound": 1j}, r"^`bound` must be positive and finite"),
        ({"bound": None}, r"^`bound` must be positive and finite"),
        ({"metrics": "energy"}, r"^`metrics` must be a list"),
        ({"metrics": ["speed"]}, r"^`metrics` must be a list of names from"),
        ({"dtypes": ["float16"]}, r"^`dtypes` must be"),
        ({"dtypes": []}, r"^`dtypes` must be"),
        ({"steps": [True]}, r"^`steps` must be a list"),
        ({"steps": "0.1"}, r"^`steps` must be a list"),
        ({"progress": 3}, r"^`progress` must be a function"),
        ({"y0": torch.tensor([1.0, 0.0])}, r"^`y0` is a tensor, but every method of the study"),
        ({"bound": np.nan}, r"^`bound` must be positive"),
        ({"min_steps": 0}, r"^`min_steps` must be a positive integer"),
        ({"t_span": (1, 1)}, r"^`t_span` has length zero"),
        ({"y0": np.zeros((2, 2, 2))}, r"^`y0` must have shape"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        stability(systems.pendulum(), ["verlet"], **arguments)
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem; got int"):
        stability([1], ["verlet"])


def test_a_limit_that_is_not_found_is_explained_and_progress_names_every_step():
    said, methods = [], ["verlet", "impulse", "rk45"]
    family = [systems.harmonic_oscillator(w) for w in (1.0, 2.0)]
    report = stability(family, methods, steps=[0.5, 3.0], metrics=("energy",), progress=said.append)
    notes = report.without_limit()
    assert notes == [
        "No limit of impulse on harmonic oscillator, ω = 1, 2: stable: all up to the length of the interval.",
        "No limit of rk45 on harmonic oscillator, ω = 1, 2: an adaptive method.",
    ]
    assert all(note in report.table() for note in notes)
    assert "No limit of impulse" in report.figure("map").get_supxlabel()
    for text in (
        "harmonic oscillator, ω = 2: verlet, float64, dt = 3",
        "ω = 1: verlet, float64, longest stable step: dt",
    ):
        assert any(text in line for line in said)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        *(("verlet", options) for options in ({}, {"t_eval": [9.0]}, {"backend": "array"}, {"dense_output": True})),
        *(("rk45", {}), ("rk45", {"dense_output": True})),
    ],
)
def test_each_trajectory_of_a_batch_has_its_blow_up_time(method, options):
    """Both ways in time, whatever is asked for: the estimate is that of the trajectory alone."""
    system = systems.henon_heiles()
    y0 = np.array([[0, 0, 0, 0.7], system.y0, [0, 0, 0, 0.71]])
    sol = solve(system, method, (0, 9), y0, **options)
    assert sol.status.tolist() == [-1, 0, -1]
    times = sol.stats["blow_up_time"]
    assert np.isnan(times[1])
    assert abs(times[0] - SINGULARITY) < 1e-8
    alone = solve(system, method, (0, 9), y0[2], **options)
    assert abs(alone.stats["blow_up_time"] - times[2]) < 1e-8
    assert "The solution of trajectory 0 itself becomes infinite" in sol.message
    y0[:, 2:] *= -1  # time runs backwards
    back = solve(system, method, (9, 0), y0, **{**options, "t_eval": [0.0]})
    np.testing.assert_allclose(9 - back.stats["blow_up_time"], times, rtol=0, atol=1e-8)


def test_a_flow_in_another_time_is_run_at_fractions_of_its_own_step():
    flow = sympflow.get("sympflow")(flow="kepler-log-1")
    report = stability(systems.kepler(0.6), [flow], metrics=("energy",), min_steps=20, max_steps=200)
    dt = solve(systems.kepler(0.6), flow, (0, 1)).stats["dt"]
    assert [(row.dt, row.status) for row in report.rows] == [(dt * f, "stable") for f in (0.25, 0.5, 1.0)]
    assert report.limits[0].stable == dt


def test_json_holds_the_rows_and_the_limits(tmp_path):
    report = stability(systems.harmonic_oscillator(), ["verlet"], steps=[1.0, 3.0], metrics=("energy",))
    content = json.loads(report.to_json(tmp_path / "x.json").read_text(), parse_constant=pytest.fail)
    assert content["systems"] == [{"name": "harmonic_oscillator", "params": {"omega": 1.0}}]
    assert [row["status"] for row in content["rows"]] == ["stable", "unstable"]
    assert content["rows"][1]["energy_error"] == "inf"
    assert content["limits"][0]["stable"] == report.limits[0].stable


@pytest.mark.parametrize(
    "method", ["srkn6b", *(pytest.param(m, marks=pytest.mark.slow) for m in ("kahan_li8", "gauss_legendre4"))]
)
def test_the_limit_of_a_nonlinear_system_does_not_depend_on_the_steps(method):
    few = {"metrics": ("energy",), "max_steps": 5000, "min_steps": 200, "t_span": (0.0, 20.0)}
    limits = {
        stability(systems.henon_heiles(), [method], steps=steps, **few).limits[0].stable
        for steps in ([0.05], [0.31, 0.32], [0.06, 7.0])
    }
    assert len(limits) == 1


def test_windows_below_the_limit_are_named_where_the_runs_bear_them():
    """Near its equilibrium the pendulum grows by kahan_li8 at dt = 3.12, to 1e2 times its energy and no more."""
    few = {"steps": [0.5], "metrics": ("energy",), "max_steps": 5000, "min_steps": 500}
    (limit,) = stability(systems.pendulum(), ["kahan_li8"], y0=[0.01, 0.01], **few).limits
    assert limit.stable > 4
    assert limit.linear == pytest.approx(3.0964, abs=1e-4)
    assert limit.reached == "below the bound, though small oscillations grow at 3.0964 to 3.1402"


def test_two_is_unstable_though_one_state_does_not_show_it():
    oscillator = systems.harmonic_oscillator()
    alone = solve(oscillator, "verlet", (0.0, 2e3), dt=2.0)
    assert sympflow.max_energy_error(alone) == 0
    kinds = {}
    for z in (1.98, 2.0, 2.02):
        report = stability(oscillator, ["verlet"], steps=[z], metrics=("energy",), limits=False)
        kinds[z] = report.rows[0].status
    assert kinds == {1.98: "bounded", 2.0: "unstable", 2.02: "unstable"}


@pytest.mark.parametrize(
    ("method", "options"), [("verlet", {"dt": 0.5}), ("implicit_midpoint", {"dt": 0.5}), ("rk45", {}), ("dop853", {})]
)
def test_a_singularity_is_found_whatever_the_step_or_the_tolerance(method, options):
    system = systems.henon_heiles_escape()
    end = blow_up(solve(system, method, (0.0, 20.0), on_domain_exit="ignore", **options))
    assert end.singular
    assert abs(end.time - SINGULARITY) < 1e-8
    assert "grows" not in str(end)


def test_an_escape_after_a_long_run_is_that_of_the_orbit_that_ran():
    """Too far for the solution from y0: it is followed from a state that the run has stored, or reaches once more."""
    system = systems.henon_heiles_escape(1 / 6 + 1e-3)
    # Orbits near a chaotic one: when each of them escapes depends on the rounding, that some do so late does not.
    y0 = np.array([0.138, 0.04, 0.554, -0.076]) * (1 + 1e-6 * np.arange(16)[:, None])
    for options in ({}, {"t_eval": [1e4]}):
        sol = solve(system, "kahan_li8", (0, 1e4), y0, dt=0.1, **options)
        late = sol.stats["failed_at"] > 1000
        assert late.any()
        assert np.abs(sol.stats["blow_up_time"] - sol.stats["failed_at"])[late].max() < 2 * 0.1
    for options in ({"t_eval": [1e4]}, {"save_every": 999}):
        runs = (solve(system, "kahan_li8", (0, 1e4), start, dt=0.1, **options) for start in y0)
        stats = next(sol.stats for sol in runs if sol.stats.get("failed_at", 0) > 1000)
        assert abs(stats["blow_up_time"] - stats["failed_at"]) < 2 * 0.1


def test_an_energy_error_above_one_is_bounded_rather_than_stable():
    oscillator = systems.harmonic_oscillator()
    (row,) = stability(oscillator, ["leapfrog"], steps=[1.99], metrics=("energy",), limits=False).rows
    assert row.status == "bounded"
    assert row.energy_error > 1  # (z²/4)/(1 − z²/4) is 99
    assert "but reaches" in row.reason


def test_the_bound_is_missed_where_the_orbit_of_the_map_has_a_short_period():
    """Verlet's step turns the oscillator by θ, cos θ = 1 − z²/2: for θ = 2π/n the error is max_k sin²(kθ)·z²/4."""
    for n in (3, 5, 6, 7, 8):
        z = 2 * math.sin(math.pi / n)
        sol = solve(systems.harmonic_oscillator(), "verlet", (0.0, 100 * n * z), [1.0, 0.0], dt=z)
        share = max(math.sin(2 * math.pi * k / n) ** 2 for k in range(n))
        assert max_energy_error(sol) == pytest.approx(share * z**2 / 4, rel=1e-10)


def test_initial_states_lie_on_one_orbit():
    system = systems.kepler(0.9)
    states = initial_states(system, None)
    assert states.shape == (4, 4)
    np.testing.assert_array_equal(states[0], system.y0)
    np.testing.assert_allclose(system.hamiltonian(states), -0.5, rtol=1e-8)
    given = np.ones((3, 4))
    np.testing.assert_array_equal(initial_states(system, given), given)


@pytest.mark.parametrize(
    ("method", "span"),
    [
        ("verlet", {}),
        pytest.param(
            "gauss_legendre4",
            {"t_span": (0.0, 20.0), "min_steps": 200},
            marks=pytest.mark.slow,  # by arrays: dear
        ),
    ],
)
def test_both_precisions_and_every_metric(tmp_path, method, span):
    report = stability(systems.pendulum(), [method], steps=[0.1], dtypes=["float64", "float32"], **span)
    double, single = report.rows
    assert (double.dtype, single.dtype) == ("float64", "float32")
    assert double.symplecticity_defect < 1e-14 < single.symplecticity_defect < 1e-5
    assert double.volume_error < 1e-12 < single.volume_error < 1e-3
    assert double.status == single.status == "stable"
    assert abs(double.energy_drift) < 5 * double.energy_drift_error + 1e-9
    path = report.to_csv(tmp_path / "rows.csv")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["energy_error"]) for row in rows] == [row.energy_error for row in report.rows]
    assert "longest stable step" in report.table()


def test_a_flow_is_run_up_to_its_dt_and_refused_beyond():
    report = stability(systems.pendulum(), ["sympflow"], metrics=("energy", "domain"))
    dt = solve(systems.pendulum(), "sympflow", (0, 1)).stats["dt"]
    assert [row.dt for row in report.rows] == [dt / 4, dt / 2, dt]
    assert report.limits[0].stable == dt
    assert report.limits[0].reached == "all up to the flow's Δt"
    (row,) = stability(systems.pendulum(), ["sympflow"], steps=[2 * dt]).rows
    assert row.status == "not applicable"
    assert row.reason.startswith("`dt` must be at most the flow's Δt")
