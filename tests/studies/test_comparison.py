"""compare(): rows, files, and methods matched to each other."""

import csv
import json
import math

import numpy as np
import pytest

from sympflow import HamiltonianSystem, compare, get, reference_error, solve, systems
from sympflow.metrics.reference import Reference
from sympflow.studies.attempts import Row, interleaved
from sympflow.studies.comparison import matched

QUICK = {"n_outputs": 50, "repeats": 1}


@pytest.fixture(scope="module")
def report():
    methods = ["verlet", "rk45", ("fine", get("verlet")(dt=0.01)), "kahan_li8", "verlet"]
    metrics = ("error", "energy", "drift", "volume", "symplecticity", "reversal")
    return compare(systems.henon_heiles(), methods, metrics, t_span=(0, 20), **QUICK)


def test_every_method_has_a_row_in_order_under_its_own_label(report):
    assert [row.label for row in report.rows] == ["verlet", "rk45", "fine", "kahan_li8", "verlet #2"]
    assert {row.status for row in report.rows} == {"ok"}
    assert [row.dt for row in report.rows] == [0.05, None, 0.01, 0.05, 0.05]
    assert report.rows[1].tolerance == 1e-3


def test_rows_hold_what_the_metrics_say(report):
    verlet, rk45, fine, kahan_li, again = report.rows
    sol = solve(systems.henon_heiles(), "verlet", (0, 20), t_eval=report.t)
    assert verlet.error == pytest.approx(reference_error(sol).max(), rel=1e-6)
    assert verlet.energy_error == np.abs(sol.energy_error()).max()
    assert verlet.error / fine.error == pytest.approx(25, rel=0.1)
    assert kahan_li.error < 1e-12
    assert rk45.volume_error < -1e-3
    assert rk45.symplecticity_defect > 1e-4
    assert rk45.time_reversal_error > 1e-3
    for row in (verlet, fine, kahan_li, again):
        assert abs(row.volume_error) < 1e-12
        assert row.symplecticity_defect < 1e-14
        assert row.time_reversal_error < 1e-12
    assert all(row.run_time > 0 and row.run_time_spread == 0 for row in report.rows)
    assert report.reference.accuracy < verlet.error / 100
    assert report.t[-1] == 20
    assert len(report.t) == 50


def test_methods_that_do_not_apply_or_fail_are_rows_with_the_reason():
    system = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", y0=[0.5, 0.0], t_span=(0, 5))
    report = compare(system, ["verlet", "sympflow", "rk45"], ["energy", "volume"], **QUICK)
    assert [row.status for row in report.rows] == ["not applicable", "not applicable", "ok"]
    assert "needs a separable system" in report.rows[0].reason
    assert "no shipped sympflow flow" in report.rows[1].reason
    unstable = compare(systems.harmonic_oscillator(), [get("verlet")(dt=2.1), "verlet"], t_span=(0, 5000), **QUICK)
    bad, good = unstable.rows
    assert bad.status == "failed"
    assert "non-finite" in bad.reason
    assert bad.energy_error == bad.error == math.inf
    assert bad.run_time is None
    assert good.status == "ok"
    assert "non-finite" in unstable.table()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("batch", [False, True], ids=["single", "batch"])
def test_a_blow_up_is_infinite_in_every_column(batch):
    lost = np.array([0.0, 0.0, 0.0, 0.7])
    y0 = np.stack([lost, lost, systems.henon_heiles().y0]) if batch else lost
    metrics = ("energy", "drift", "volume", "symplecticity", "reversal")
    methods = [get("verlet")(dt=0.01), "kahan_li8", "rk45"]
    for row in compare(systems.henon_heiles(), methods, metrics, y0=y0, t_span=(0, 20), **QUICK).rows:
        assert (row.energy_error, row.energy_drift, row.volume_error, row.symplecticity_defect) == (math.inf,) * 4
        assert row.time_reversal_error == math.inf
        assert "encountered" not in row.reason


def test_a_reference_of_another_problem_is_refused():
    system = systems.pendulum()
    few = {"metrics": ["error"], "t_span": (0, 10), **QUICK}
    t = np.linspace(0.2, 10, 50)
    other = HamiltonianSystem.from_sympy("p**2/2 + q**2/2 - 1", y0=system.y0)
    with pytest.raises(ValueError, match=r"^`reference` is a solution of another system, 'H = .*': pass one of 'pen"):
        compare(system, ["verlet"], reference=solve(other, "dop853", (0, 10), t_eval=t), **few)
    elsewhere = solve(system, "dop853", (0, 10), [0.3, 0.1], t_eval=t)
    with pytest.raises(ValueError, match=r"^`reference` is a solution from another `y0`"):
        compare(system, ["verlet"], reference=elsewhere, **few)
    for states in (elsewhere.y, Reference(t, elsewhere.y, "mine", 1e-9)):
        with pytest.raises(ValueError, match=r"^`reference` has another energy than `y0`"):
            compare(system, ["verlet"], reference=states, **few)
    same = HamiltonianSystem.from_sympy("p**2/2 - cos(q)", name="mine", y0=system.y0)  # the same vector field
    report = compare(system, ["verlet"], reference=solve(same, "dop853", (0, 10), t_eval=t, rtol=1e-12), **few)
    assert report.reference.accuracy is None
    assert "reference: given, of unknown accuracy" in report.table()
    assert report.to_dict()["reference"] == {"method": "given", "accuracy": None}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"methods": "verlet"}, "`methods` must be a list"),
        ({"methods": []}, "`methods` is empty"),
        ({"methods": ["vertel"]}, "`method` 'vertel' is unknown"),
        ({"methods": ["verlet"], "metrics": ["enegry"]}, "`metrics` has no 'enegry'"),
        ({"methods": ["verlet"], "repeats": 0}, "`repeats` must be a positive integer"),
        ({"methods": ["verlet"], "n_outputs": 2.5}, "`n_outputs` must be a positive integer"),
        ({"methods": ["verlet"], "match": "cost"}, "`match` must be one of"),
        ({"methods": ["verlet"], "t_span": (1, 1)}, "`t_span` has length zero"),
        ({"methods": ["verlet"], "y0": [1.0]}, "`y0` must have shape"),
        ({"methods": ["verlet"], "dt": -1.0}, "`dt` must be a positive"),
        ({"methods": ["verlet"], "metrics": 3}, "`metrics` must be a list of names"),
        ({"methods": ["verlet"], "reference": 3}, "`reference` must be a Reference, a Solution or an array.*; got int"),
        ({"methods": ["verlet"], "reference": "exact"}, "`reference` must be a Reference, a Solution or an array"),
        ({"methods": ["verlet"], "reference": np.zeros((2, 7))}, r"`reference` must have the shape \(2, 1000\)"),
        ({"methods": ["verlet"], "reference": solve(systems.pendulum())}, "`reference` must be at the 1000 instants"),
    ],
)
def test_bad_arguments_are_refused_at_once(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        compare(systems.pendulum(), **arguments)


@pytest.mark.parametrize(
    ("scene", "metrics"),
    [
        (systems.driven_pendulum, ("error", "balance", "volume", "symplecticity")),
        (systems.duffing, ("error", "conformal")),
    ],
)
def test_the_default_metrics_are_those_of_what_a_system_keeps(scene, metrics, tmp_path):
    report = compare(scene(), ["verlet", "rk4", "sympflow"], t_span=(0, 10), n_outputs=20, repeats=1)
    assert report.metrics == metrics
    verlet, rk4, flow = report.rows
    assert flow.status == ("ok" if "balance" in metrics else "not applicable")  # one ships for the driven pendulum
    assert verlet.error < 0.01
    kept = "balance_error" if "balance" in metrics else "conformal_defect"
    limit = 1e-3 if kept == "balance_error" else 1e-15
    assert 0 < getattr(verlet, kept) < limit
    assert getattr(rk4, kept) > 1e-12
    assert ("not applicable" in report.table()) == (flow.status == "not applicable")
    report.plot(tmp_path)
    assert (tmp_path / "portrait.png").exists()
    assert (tmp_path / "energy.png").exists() == (kept == "balance_error")


def test_a_batch_is_summed_up_by_its_median_and_its_worst():
    system = systems.henon_heiles()
    y0 = system.domain.sample(5, 0)
    report = compare(system, ["verlet", "rk45"], y0=y0, t_span=(0, 5), **QUICK)
    alone = [compare(system, ["rk45"], y0=y, t_span=(0, 5), **QUICK).rows[0] for y in y0]
    rk45 = report.rows[1]
    assert rk45.error == pytest.approx(np.median([row.error for row in alone]), rel=1e-6)
    assert rk45.volume_error == pytest.approx(max((row.volume_error for row in alone), key=abs), rel=1e-9)


def test_matching_finds_the_step_of_a_power_law():
    system = systems.pendulum()
    for power, grows in ((2.0, True), (-1.0, False), (6.0, True)):
        found, value = matched(get("verlet")(dt=0.1), system, lambda m, n=power: m.dt**n, 0.003**power, grows)
        assert value == pytest.approx(0.003**power, rel=0.05)
        assert found.dt == pytest.approx(0.003, rel=0.06)
    found, _ = matched(get("verlet")(dt=1.0), system, lambda m: math.inf if m.dt > 0.5 else m.dt**2, 0.2**2, grows=True)
    assert found.dt == pytest.approx(0.2, rel=0.05)


def test_files_hold_every_figure(report, tmp_path):
    with report.to_csv(tmp_path / "new" / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["label"] for row in rows] == [row.label for row in report.rows]
    assert float(rows[0]["energy_error"]) == report.rows[0].energy_error
    assert rows[0]["training_time"] == ""
    content = json.loads(report.to_json(tmp_path / "rows.json").read_text())
    assert content["rows"][0]["energy_error"] == report.rows[0].energy_error
    assert content["reference"]["method"].startswith("Kahan–Li 8")


def test_metrics_that_were_not_asked_for_are_none():
    row = compare(systems.pendulum(), ["verlet"], ["energy"], **QUICK).rows[0]
    assert row.energy_error > 0
    assert (row.error, row.energy_drift, row.volume_error, row.symplecticity_defect, row.training_time) == (None,) * 5


def test_the_repr_of_a_row_shows_what_is_filled_in():
    row = Row("pendulum", "verlet", "verlet", run_time=1.5, figures={"energy_error": 0.0})
    assert repr(row) == (
        "Row(system='pendulum', method='verlet', label='verlet', status='ok', run_time=1.5, energy_error=0.0)"
    )


def test_a_row_lists_its_figures_for_completion():
    row = Row("pendulum", "verlet", "verlet", figures={"energy_error": 1e-3})
    assert row.energy_error == 1e-3
    assert row.volume_error is None
    assert {"energy_error", "volume_error", "run_time"} <= set(dir(row))


@pytest.mark.parametrize("what", ["evaluations", "energy_error"])
def test_methods_are_matched_to_the_first(what):
    report = compare(systems.pendulum(), ["verlet", "yoshida4", "rk45"], match=what, t_span=(0, 50), **QUICK)
    cost = [row.force_evaluations if what == "evaluations" else row.energy_error for row in report.rows]
    assert cost[1] == pytest.approx(cost[0], rel=0.1)
    assert cost[2] == pytest.approx(cost[0], rel=0.15)


def test_a_solution_may_be_the_reference():
    system, t = systems.pendulum(), np.arange(1, 51) / 5
    truth = solve(system, "kahan_li8", (0, 10), t_eval=t)
    report = compare(system, ["verlet"], ["error"], t_span=(0, 10), reference=truth, **QUICK)
    verlet = solve(system, "verlet", (0, 10), t_eval=t)
    assert report.rows[0].error == reference_error(verlet, truth).max()
    assert report.reference.method == "given"


def test_json_is_strict_where_a_run_blew_up(tmp_path):
    report = compare(systems.harmonic_oscillator(), [get("verlet")(dt=2.1)], ["energy"], t_span=(0, 5000), **QUICK)
    content = json.loads(report.to_json(tmp_path / "rows.json").read_text(), parse_constant=pytest.fail)
    assert content["rows"][0]["energy_error"] == "inf"


def test_repeats_are_interleaved():
    order = []
    times = interleaved([lambda: order.append("a"), lambda: order.append("b")], 3)
    assert order == list("ababab")
    assert len(times) == 2
