"""work_precision(): sweeps, references, and what is read off the diagram."""

import csv
import math

import numpy as np
import pytest

from sympflow import HamiltonianSystem, SympFlow, compare, get, systems, work_precision
from sympflow.studies.attempts import Row
from sympflow.studies.precision import break_even, cost_at

pytestmark = pytest.mark.filterwarnings("ignore:`dt` .* is too long:RuntimeWarning")

QUICK = {"t_span": (0, 10), "n_outputs": 10, "repeats": 1}


@pytest.fixture(scope="module")
def report():
    methods = ["verlet", "kahan_li8", "rk45", "sympflow", ("mine", get("verlet")(dt=0.3))]
    return work_precision(systems.henon_heiles(), methods, batch=20, tolerances=(1e-4, 1e-7), **QUICK)


def points(report, label, trajectories=1):
    return [row for row in report.rows if row.label == label and row.trajectories == trajectories]


def test_steps_are_swept_from_coarse_to_the_level_of_rounding(report):
    kahan_li = points(report, "kahan_li8")
    assert [row.dt for row in kahan_li] == [1.6 / 2**k for k in range(len(kahan_li))]
    assert kahan_li[-1].energy_error < 1e-12 < kahan_li[-2].energy_error
    assert [row.dt for row in points(report, "mine")] == [0.3]
    assert [row.tolerance for row in points(report, "rk45")] == [1e-4, 1e-7]
    assert len(points(report, "sympflow")) == 1


def test_an_error_is_at_least_a_hundred_times_that_of_the_reference_or_is_marked(report):
    for row in report.rows:
        reference = report.references[row.trajectories > 1]
        if row.error is not None:
            assert (row.status == "uncertain") == (row.error < 100 * reference.accuracy)


def test_files_table_and_figure(report, tmp_path):
    with report.to_csv(tmp_path / "points.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(report.rows)
    assert report.to_json(tmp_path / "points.json").exists()
    assert "paid after t =" in report.table()
    figure = report.figure()
    assert len(figure.axes) == 4
    assert len(report.plot().axes) == 4
    assert not list(tmp_path.glob("*.png"))
    assert len(report.plot(tmp_path / "figure.png", "error").axes) == 4
    assert (tmp_path / "figure.png").exists()
    with pytest.raises(ValueError, match="`measure` must be one of"):
        report.figure("beauty")


def test_methods_that_do_not_apply_and_unstable_steps_are_rows():
    system = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", y0=[0.5, 0.0])
    row = work_precision(system, ["verlet", SympFlow(2)], **QUICK).rows
    assert [r.status for r in row] == ["not applicable"] * 2
    unstable = work_precision(systems.harmonic_oscillator(), ["verlet"], steps=[2.5, 0.1], t_span=(0, 2000), repeats=1)
    assert [r.status for r in unstable.rows] == ["failed", "ok"]
    assert unstable.rows[0].run_time is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": [0.1, -1]}, "`steps` must be positive"),
        ({"tolerances": [0]}, "`tolerances` must be positive"),
        ({"batch": 0}, "`batch` must be a positive number"),
        ({"batch": [1.0, 0.0]}, "`batch` must be a number, or states"),
        ({"y0": [[1.0, 0.0]]}, "`y0` must be one state"),
        ({"repeats": 0}, "`repeats` must be a positive integer"),
        ({"t_span": (1, 1)}, "`t_span` has length zero"),
        ({"tolerances": []}, "`tolerances` is empty"),
        ({"tolerances": 1e-3}, "`tolerances` must be a list of positive numbers; got 0.001"),
        ({"tolerances": [None]}, "`tolerances` must be a list of positive numbers"),
        ({"tolerances": "1e-3"}, "`tolerances` must be a list of positive numbers"),
        ({"steps": []}, "`steps` is empty"),
        ({"steps": np.array([])}, "`steps` is empty"),
        ({"steps": [10**400]}, "`steps` must be a list of positive numbers"),
        ({"steps": [0.1, np.nan]}, "`steps` must be positive and finite"),
        ({"budget": np.nan}, "`budget` must be a number of seconds"),
        ({"budget": "1"}, "`budget` must be a number of seconds"),
        ({"progress": 3}, "`progress` must be a function"),
        ({"n_outputs": 0}, "`n_outputs` must be a positive integer"),
    ],
)
def test_bad_arguments_are_refused_at_once(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        work_precision(systems.pendulum(), ["verlet"], **arguments)


def test_a_driven_system_is_judged_by_its_energy_balance_and_a_damped_one_by_its_state(tmp_path):
    driven = work_precision(systems.driven_pendulum(), ["verlet"], steps=[0.1, 0.05, 0.025], **QUICK)
    errors = [row.balance_error for row in driven.rows]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert all(row.energy_error is None for row in driven.rows)
    assert "For an energy balance error of" in driven.table()
    assert "energy balance" in driven.plot(tmp_path / "driven.png").axes[0].get_xlabel()
    damped = work_precision(systems.duffing(), ["verlet", "sympflow"], steps=[0.1, 0.05], **QUICK)
    assert damped.measure == "error"
    verlet = [row for row in damped.rows if row.label == "verlet"]
    assert verlet[0].error / verlet[1].error == pytest.approx(4, rel=0.1)
    assert verlet[0].balance_error is verlet[0].energy_error is None
    assert damped.rows[-1].status == "not applicable"


@pytest.mark.parametrize(("label", "order"), [("verlet", 2), ("kahan_li8", 8)])
@pytest.mark.parametrize("trajectories", [1, 20])
def test_errors_fall_with_the_order(report, label, order, trajectories):
    rows = [r for r in points(report, label, trajectories) if r.status == "ok" and r.dt < 0.5]
    slope = np.polyfit(np.log([r.dt for r in rows]), np.log([r.error for r in rows]), 1)[0]
    assert slope == pytest.approx(order, abs=0.6)


def test_evaluations_are_those_of_one_trajectory(report):
    for trajectories in (1, 20):
        row = next(r for r in points(report, "verlet", trajectories) if r.dt == 0.05)
        assert row.force_evaluations == 200 + 10  # an output closes a step that was merged with the next
        assert row.hessian_evaluations == 0
    alone, batch = points(report, "rk45")[0], points(report, "rk45", 20)[0]
    assert batch.force_evaluations == pytest.approx(alone.force_evaluations, rel=0.3)
    assert "Timed on 4 trajectories" in batch.reason


def test_an_error_that_would_be_small_by_chance_is_measured():
    """At dt·ω = 2 Verlet turns an oscillator at rest by half a turn: all its steps have its energy but for rounding."""
    few = {"t_span": (0, 20 / 1.3), "y0": [1.0, 0.0], "n_outputs": 10, "repeats": 1}
    rows = work_precision(systems.harmonic_oscillator(1.3), ["verlet"], steps=[2 / 1.3, 0.4, 0.1], **few).rows
    assert [row.dt for row in rows] == [2 / 1.3, 0.4, 0.1]
    assert 1e-3 < rows[2].energy_error < rows[1].energy_error < rows[0].energy_error


def test_a_flow_in_another_time_is_a_point_as_it_is_a_row_of_compare():
    flow = get("sympflow")(flow="kepler-log-1")
    few = {"t_span": (0, 20), "n_outputs": 20, "repeats": 1}
    verlet, point = work_precision(systems.kepler(0.6), ["verlet", flow], steps=[0.05], **few).rows
    (row,) = compare(systems.kepler(0.6), [flow], ["error", "energy"], dt=0.05, **few).rows
    assert (point.label, point.status, point.dt) == ("sympflow", "uncertain", row.dt)  # better than the reference
    assert point.training_time == row.training_time > 0
    assert point.energy_error == row.energy_error < 1e-6 * verlet.energy_error


def test_training_has_paid_for_itself_when_the_time_saved_is_that_of_training():
    rival = [Row("s", "verlet", "verlet", run_time=0.01 / e, figures={"energy_error": e}) for e in (1e-2, 1e-4)]
    flow = Row("s", "sympflow", "sympflow", run_time=4.0, training_time=60.0, figures={"energy_error": 1e-3})
    slow = Row("s", "sympflow", "slow", run_time=40.0, training_time=60.0, figures={"energy_error": 1e-3})
    *_, quick, never = break_even([*rival, flow, slow], length=100.0)
    assert quick.break_even == pytest.approx(60 / ((10 - 4) / 100))
    assert never.break_even == math.inf


def test_cost_is_interpolated_between_points_of_a_power_law():
    law = [Row("s", "m", "m", run_time=e**-0.5, figures={"energy_error": e}) for e in (1e-2, 1e-4, 1e-6)]
    assert cost_at(law, 1e-3) == pytest.approx(1e-3**-0.5)
    assert cost_at(law, 1.0) == pytest.approx(10)  # nothing cheaper is known
    assert cost_at(law, 1e-7) == math.inf


def test_force_gradients_are_counted_apart():
    row = work_precision(systems.pendulum(), ["chin4a"], steps=[0.1], **QUICK).rows[0]
    assert row.hessian_evaluations == 100
    assert row.force_evaluations == 200 + 10
