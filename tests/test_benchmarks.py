"""The arithmetic of the comparison with other packages, and a tiny run of it. Nothing here judges a time."""
# ruff: noqa: E402  (the benchmarks are no package that is installed)

import argparse
import dataclasses
import importlib.util
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
if not BENCHMARKS.exists():
    pytest.skip("the benchmarks are not part of the source distribution", allow_module_level=True)
sys.path.insert(0, str(BENCHMARKS))

import again
import drift
import nonseparable
import own_systems
import peers
import planets
import plugins
import primed
import primed_ideas
import solar_system
import through_solve
import training_optimizers
from contenders import loops, ours, runge_kutta, tables
from contenders.contender import Scene, Skipped, Work
from contenders.measurement import (
    Goal,
    Judged,
    Results,
    Row,
    check_agreement,
    goals,
    largest_control,
    measure,
    worst_ratio,
)
from measuring import fragments
from measuring import race as at_equal_error

from sympflow import SympFlow, shipped_flows, systems
from sympflow.schemes import SCHEMES
from sympflow.systems import henon_heiles, kepler, pendulum
from sympflow.training.shipped.recipe import SCENES

pytestmark = pytest.mark.slow

TINY = Scene(t_end=20.0, n_instants=20, trajectories=70)  # more than a block of the hand-written loops, and not two


def row(package, label, seconds, trajectories=1, target=1e-6, control="dt"):
    return Row(label, package, trajectories, target, control, 0.1, 1e-7, 1e-5, 10, 10, 0, seconds, 0.0, 1.0)


# the step or tolerance for a target -------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 6, 8])
@pytest.mark.parametrize("guess", [1e-3, 0.4, 30.0])
def test_largest_control_meets_the_target_closely_on_a_power_law(order, guess):
    judged = largest_control(lambda x: Judged(x, x**order, None, Work(1, 1)), 1e-6, guess, order, 0.95)
    assert 0.95e-6 <= judged.energy_error <= 1e-6


def test_largest_control_brackets_where_the_error_is_no_power_law():
    def judge(x):  # in steps, and infinite beyond a stability limit
        return Judged(x, 10.0 ** math.floor(2 * math.log10(x)) if x < 0.5 else math.inf, None, Work(1, 1))

    judged = largest_control(judge, 2e-5, 5.0, 1, 0.999)
    assert judged.energy_error <= 2e-5
    assert 10**-2 * 0.98 < judged.control < 10**-2


def test_largest_control_says_when_the_target_is_out_of_reach():
    assert largest_control(lambda x: Judged(x, 1e-3, None, Work(1, 1)), 1e-6, 0.1, 2, 0.9) is None


# errors -----------------------------------------------------------------------------------------------


def test_energy_error_is_the_largest_and_of_a_batch_the_median():
    scene = Scene(t_end=1.0, n_instants=3, trajectories=3)
    start = np.tile(scene.y0, (3, 1))
    states = np.tile(start, (4, 1, 1))
    states[2, 0] = [0, 0, 0, 0]  # |0 − H₀|/H₀ = 1 in the first trajectory, 0 in the second, a blow-up in the third
    states[1, 2] = np.nan
    assert scene.energy_error(states, start) == 1.0
    assert scene.energy_error(states[:, 1], scene.y0) == 0.0
    assert scene.energy_error(states[:, 2], scene.y0) == math.inf


def test_first_after_takes_the_next_step_or_the_last():
    times = np.array([0.0, 0.4, 1.0, 1.7, 2.0])
    np.testing.assert_array_equal(runge_kutta.first_after(times, np.array([0.5, 1.0, 1.5, 2.0, 2.5])), [2, 2, 3, 4, 4])


# every loop takes the steps of our methods ------------------------------------------------------------


@pytest.mark.parametrize("trajectories", [1, TINY.trajectories])
def test_hand_written_and_interpreted_loops_take_our_steps(trajectories):
    leader = next(c for c in ours.contenders(TINY) if c.label == "verlet" and c.trajectories == trajectories)
    for contender in loops.contenders(TINY):
        if contender.trajectories == trajectories:
            check_agreement(TINY, contender, leader, 0.05)


@pytest.mark.parametrize("trajectories", [1, TINY.trajectories])
def test_hand_written_kahan_li8_takes_our_steps(trajectories):
    by_hand = loops.run_kahan_li8(TINY, trajectories, 0.2, TINY.t_end)
    np.testing.assert_allclose(by_hand, ours.run(TINY, "kahan_li8", trajectories, 0.2, TINY.t_end), atol=1e-13)


def test_a_loop_with_other_steps_is_found_out():
    leader, other = (next(c for c in ours.contenders(TINY) if c.label == name) for name in ("verlet", "suzuki4"))
    with pytest.raises(RuntimeError, match="suzuki4 differs from verlet"):
        check_agreement(TINY, other, leader, 0.05)


@pytest.mark.filterwarnings("default")
def test_diffrax_takes_our_steps_and_judges_its_own():
    pytest.importorskip("diffrax")
    from contenders import diffrax_solvers

    leaders = {c.trajectories: c for c in ours.contenders(TINY) if c.label == "verlet"}
    *leapfrogs, dopri8 = diffrax_solvers.contenders(TINY)
    for leapfrog in leapfrogs:
        check_agreement(TINY, leapfrog, leaders[leapfrog.trajectories], 0.05)
    assert_solves(dopri8)


@pytest.mark.filterwarnings("default")
def test_heyoka_is_judged_on_the_states_of_the_scene():
    pytest.importorskip("heyoka")
    from contenders import heyoka_taylor

    for contender in heyoka_taylor.contenders(TINY):
        assert_solves(contender)


def test_python_runge_kutta_methods_are_judged_on_their_steps():
    for contender in runge_kutta.contenders(TINY):
        assert_solves(contender)


def assert_solves(contender, tol=1e-10):
    """Errors of the size of the tolerance, a hundred steps of growth allowed; what is timed ends where it is judged."""
    outputs = contender.outputs(tol, TINY.t_end)
    assert TINY.energy_error(outputs.states, TINY.sample(contender.trajectories)) < 100 * tol
    interpolated = 1e4 if contender.package == "torchdiffeq" else 1.0  # its state at the end, by a quartic
    assert TINY.state_error(outputs.final, contender.trajectories) < 1000 * tol * interpolated
    assert outputs.work.steps > 10
    run = contender.run(tol, TINY.t_end)
    final = run.y[:, -1] if contender.package == "SciPy" else np.asarray(run)
    np.testing.assert_allclose(final[: len(outputs.final)], outputs.final, atol=1e-12)


# targets and page -------------------------------------------------------------------------------------


def test_verdicts():
    assert Goal("", 1.1, 1.2).verdict == "pass"
    assert Goal("", 1.3, 1.2).verdict == "miss"
    assert Goal("", 7.0, 5.0, at_least=True).verdict == "pass"
    assert Goal("", 4.0, 5.0, at_least=True).verdict == "miss"
    assert Goal("", None, 5.0).verdict == "not measured"


def test_worst_ratio_compares_equal_targets_only():
    results = Results(
        [
            row("sympflow", "verlet", 1.0, target=1e-3),
            row("sympflow", "verlet", 3.0, target=1e-6),
            row("sympflow", "verlet", 100.0, target=1e-9),
            row("diffrax", "leapfrog", 2.0, target=1e-3),
            row("diffrax", "leapfrog", 2.0, target=1e-6),
            row("diffrax", "Dopri8", 0.1, target=1e-9, control="tol"),
        ]
    )
    assert worst_ratio(results, "diffrax", 1) == 1.5
    assert worst_ratio(results, "torch", 1) is None


def test_numbers_are_written_with_three_digits():
    assert [fragments.three(x) for x in (0.001234, 1.0, 12.34, 123.4, 123456.0)] == [
        "0.00123",
        "1.00",
        "12.3",
        "123",
        "123,000",
    ]
    assert [fragments.duration(s) for s in (2.5, 0.0123, 4.56e-5, 3e-9)] == ["2.50 s", "12.3 ms", "45.6 µs", "3.00 ns"]
    assert tables.power(1e-3) == "1e-3"
    assert tables.power(1e-12) == "1e-12"


def test_a_missing_peer_is_a_line_with_the_reason(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    contenders, skipped = peers.gather(TINY)
    assert [s.package for s in skipped] == ["diffrax", "heyoka", "rebound", "pyhamsys", "desolver"]
    assert {c.package for c in contenders} == {"sympflow", "Numba", "NumPy", "torch", "SciPy", "torchdiffeq"}


def test_a_tiny_run_fills_the_fragments_and_survives_json(tmp_path):
    chosen = [c for c in ours.contenders(TINY) if c.label in ("verlet", "kahan_li8", ours.FLOW)]
    contenders = [*chosen, *(c for c in loops.contenders(TINY) if c.package == "Numba")]
    results = measure(TINY, contenders, [1e-3, 1e-6], 1, cap=0.05, step_counts=(1000, 100), note=lambda line: None)
    results.skipped = [Skipped("heyoka", "not installed")]
    results.environment = {"versions": {"python": "3"}, "minutes": 0.1, "repeats": 1, "load": 0.0, "load_after": 0.0}
    assert {(r.label, r.trajectories, r.target) for r in results.rows} == {
        (label, n, target)
        for label in ("verlet", "kahan_li8", ours.FLOW, "Verlet loop")
        for n in (1, TINY.trajectories)
        for target in (1e-3, 1e-6)
    }
    assert all(0.9 * r.target < r.energy_error <= r.target for r in results.rows if r.label == "verlet")
    assert [goal.verdict for goal in goals(results)][-1] == "not measured"
    found = tables.fragments(results)
    assert "| kahan_li8 | sympflow |" in found["peers-one"]
    assert "| heyoka | all | not installed |" in found["peers-left-out"]
    again = Results.from_dict(json.loads(json.dumps(results.to_dict())))
    assert tables.fragments(again) == found
    tables.draw(results, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 0


def test_a_fragment_says_where_it_is_from(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["benchmarks/drift.py", "--quick", "--out", "docs/measured", "--steps", "9"])
    fragments.write(tmp_path / "measured", "one", fragments.table(["a", "b"], [[1, 2]]))
    table, source = (tmp_path / "measured" / "one.md").read_text(encoding="utf-8").strip().split("\n\n")
    assert table == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    assert re.fullmatch(
        r"<small>`python benchmarks/drift.py --quick --steps 9` · .+ · commit .+ · \d{4}-\d\d-\d\d</small>", source
    )
    assert fragments.command_line("--only kepler").endswith("drift.py --quick --steps 9 --only kepler")
    fragments.write(None, "two", "")  # printed only


def test_every_fragment_has_a_command_that_writes_it():
    """The names in the sources; stability, ideas, driven and brought systems put a prefix before their sections."""
    sources = "".join(path.read_text(encoding="utf-8") for path in BENCHMARKS.rglob("*.py"))
    for path in (BENCHMARKS.parent / "docs" / "measured").glob("*.md"):
        if path.stem == "flows":  # the table of `sympflow flows`
            continue
        section = re.sub(r"^(stability|ideas|driven|bring)-", "", path.stem)
        section = re.sub(r"^stiff-fput-\d+", "stiff-fput-", section)
        section = re.sub(r"^peers-(one|batch)", "peers-", section)
        section = re.sub(r"^large-flows-\d+", "large-flows", section)
        stem = section.removesuffix("-against").removesuffix("-flow").removesuffix("-work")
        assert f'"{section}"' in sources or f'"{stem}' in sources, path.name


def test_fragments_are_made_again_by_their_commands(tmp_path, monkeypatch):
    text = "| a |\n\n<small>`python benchmarks/{}` · one thread · commit 1a2b3c4 · 2026-01-01</small>\n"
    for name, command in (("one-a", "one.py --only 'x y'"), ("one-b", "one.py --only 'x y'"), ("two", "two.py")):
        (tmp_path / f"{name}.md").write_text(text.format(command), encoding="utf-8")
    (tmp_path / "flows.md").write_text("| a |\n\n<small>`sympflow flows`</small>\n", encoding="utf-8")
    one = {"python benchmarks/one.py --only 'x y'": {"one-a": "1a2b3c4", "one-b": "1a2b3c4"}}
    assert again.commands(tmp_path, ["one-*"]) == one
    assert again.commands(tmp_path, ["*"]) == {**one, "python benchmarks/two.py": {"two": "1a2b3c4"}}
    assert not again.commands(tmp_path, ["flows"])
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "one.py").write_text("import sys; print(sys.argv[1:])", encoding="utf-8")
    (tmp_path / "benchmarks" / "two.py").write_text("while True: pass", encoding="utf-8")
    monkeypatch.setattr(again, "HOUSE", tmp_path)
    assert again.run(*one, tmp_path, tmp_path / "log", None)
    assert (tmp_path / "log").read_text(encoding="utf-8").strip() == f"['--only', 'x y', '--out', {str(tmp_path)!r}]"
    assert not again.run("python benchmarks/two.py", tmp_path, tmp_path / "log", 0.2)
    assert not again.run("python benchmarks/three.py", tmp_path, tmp_path / "log", None)


# primed flows against schemes -------------------------------------------------------------------------


def test_fewest_steps_are_the_fewest():
    assert primed.fewest_steps(lambda n: (100 / n) ** 4, 1.0, 13) in (100, 101)
    assert primed.fewest_steps(lambda n: (100 / n) ** 4, 1.0, 5000) in (100, 101)
    assert primed.fewest_steps(lambda n: 1.0, 0.5, 10) is None
    assert primed.fewest_steps(lambda n: (100 / n) ** 4, 1.0, 1, least=400) == 400


def arguments(**options):
    given = {"system": ["pendulum"], "ablation": False, "quick": True, "fit": True, "json": None, "out": None}
    given["driven"] = False
    return argparse.Namespace(**{**given, "fit_seconds": None, "repeats": 1, "batch": 16, "seed": 1, **options})


def test_a_tiny_race_of_primed_flows(tmp_path, monkeypatch):
    monkeypatch.setattr(at_equal_error, "TIMED_SPAN", 20.0)
    text = primed.run(arguments(flows=tmp_path, json=tmp_path / "rows.json", out=tmp_path / "measured"))
    assert text.count("| pendulum, ") == 2
    assert (tmp_path / "measured" / "primed-race.md").read_text(encoding="utf-8").count("| pendulum, ") == 2
    for row in json.loads((tmp_path / "rows.json").read_text()):
        assert 0 < row["error"] <= row["target"]
        assert row["dt"] <= 0.8
        assert row["rival"]["one"] in SCHEMES
        assert all(value > 0 for value in row["faster"].values())
    assert len(list(tmp_path.glob("*.safetensors"))) == 1
    system = pendulum()
    again = primed.fitted(system, *primed.FLOWS["pendulum"].starts[0], tmp_path)  # not fitted again, but read
    assert again.recipe["stages"][0]["restarts"] == 2


@pytest.mark.slow
def test_a_tiny_race_of_driven_flows(tmp_path, monkeypatch):
    monkeypatch.setattr(at_equal_error, "TIMED_SPAN", 20.0)
    system = ["driven_pendulum"]
    text = primed.run(arguments(driven=True, system=system, flows=tmp_path, out=tmp_path / "measured"))
    assert text.count("| driven_pendulum, ") == 2
    assert (tmp_path / "measured" / "primed-driven.md").read_text(encoding="utf-8").count("| driven pendulum, ") == 2


def test_a_tiny_ablation():
    lines = primed.run(arguments(ablation=True)).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == [f"| {v.name}" for v in primed.ABLATION[:3]]


def test_own_systems_are_compared_with_schemes(capsys):
    own_systems.main(["duffing", "--quick"])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| duffing")]
    *_, best, kahan_li8 = line.strip("| ").split(" | ")
    times, name = best.split()  # whichever was the faster one
    assert name in SCHEMES
    assert float(times) > 0
    assert float(kahan_li8) > 0


def test_whole_calls_are_timed_beside_their_loops(capsys, monkeypatch):
    monkeypatch.setattr(through_solve, "TURN", {50.0: through_solve.TURN[50.0]})  # one of the two chains
    through_solve.main(["--quick"])
    lines = [line for line in capsys.readouterr().out.splitlines() if "times faster" in line]
    assert len(lines) == 8
    assert all(line.count(" ms") == 2 for line in lines)
    assert sum("loops" in line for line in lines) == 6  # no loops alone where outputs lie between steps


def test_heyoka_solves_any_symbolic_system():
    pytest.importorskip("heyoka")
    from contenders.heyoka_taylor import Taylor

    from sympflow.systems import quartic

    system = quartic()
    taylor, y0 = Taylor.of_system(system), system.domain.sample(5, 0)
    expected = at_equal_error.reference(system, (0.0, 10.0), y0, np.array([10.0])).y[..., 0]
    np.testing.assert_allclose(taylor.run_lanes(1e-9, y0, 10.0), expected, atol=1e-6)
    np.testing.assert_allclose(taylor.run(1e-9, y0[0], 10.0), expected[0], atol=1e-6)
    np.testing.assert_allclose(taylor.grid(1e-9, y0[0], np.array([0.0, 5.0, 10.0]))[-1], expected[0], atol=1e-6)


def test_on_kepler_the_logarithmic_methods_race():
    """They end where the exact flow does, take few steps for it, and no other system has them."""
    system = kepler()
    runners = {r.name: r for r in at_equal_error.transformed(system)}
    assert set(runners) == {"log_leapfrog", "log_blanes_moan4", "log_kahan_li8"}
    assert not at_equal_error.transformed(henon_heiles())
    measure = at_equal_error.Measure(system, "state", 10.0)
    fixed = at_equal_error.Runner.of_scheme("kahan_li8", system)
    assert measure.of(runners["log_kahan_li8"], 100) < 0.1 * measure.of(fixed, 100)
    energy = at_equal_error.Measure(system, "energy", 10.0)
    assert energy.of(runners["log_leapfrog"], 100) < 1e-11
    single = runners["log_kahan_li8"].one(0.1, system.y0, 100, np.array([0, 100]))[0]
    assert single.shape == (2, 4)


# training, drift, planets -----------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", training_optimizers.OPTIMIZERS)
def test_each_optimizer_stops_when_its_time_is_over(optimizer, monkeypatch):
    made = training_optimizers.recipe_of("harmonic_oscillator", "sympflow")
    few = [(dataclasses.replace(fit, points=40), solver) for fit, solver in made.stages]
    monkeypatch.setattr(type(made), "stages", few)
    result = training_optimizers.trained(made, optimizer, 0.05)
    assert result.steps >= 1
    assert 0 < result.at_dt < 10
    assert training_optimizers.row(result).count("|") == 9


def test_a_tiny_search_for_drift():
    found = drift.run(2_000, ["pendulum"])
    n = sum(f.system == "pendulum" for f in shipped_flows(pendulum(), "sympflow"))
    assert len(found) == n
    assert all(d.passed for d in found)
    drifting = drift.Drift("rk4", 100, 1.0, change=1e-3, three_errors=1e-4, rounding=1e-13, seconds=0.0, left=None)
    assert not drifting.passed
    assert "| rk4 | 1.0e-03 | 1.0e-04 | 1.0e+00 |" in drift.failures([*found, drifting])


def test_scenes_of_the_drift_are_those_of_all_flows():
    """But of driven systems, whose energy is not kept and has no drift."""
    scenes = [*drift.scenes(), systems.driven_pendulum(), SCENES["duffing"]()]
    for entry in shipped_flows(kind="sympflow"):
        assert any(entry.is_of(system) for system in scenes), entry.name


def test_the_race_of_planets_on_a_pendulum(monkeypatch):
    """Every racer meets the target, a flow with steps of at most its Δt; the loops of a pendulum compile fast."""
    monkeypatch.setattr(solar_system, "outer_solar_system", pendulum)
    monkeypatch.setattr(solar_system, "YEAR", 1.0)
    table = solar_system.run(years=20.0, target=1e-5, repeats=1, names=("kahan_li8",))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    assert "kahan_li8" in [row[0] for row in rows]
    for name, step, error, *_ in rows:
        assert float(error) <= 1e-5
        if name.startswith("flow"):
            assert float(step.split()[0]) <= float(name.split()[3])


def test_secular_frequencies_of_the_outer_planets():
    """Within what the inner planets add to them of Laskar's: g5 to g8 of perihelia, s6 to s8 of nodes."""
    off = np.abs(planets.secular(planets.OUTER, years=5e6) / list(planets.SECULAR.values()) - 1)
    assert (off < [4e-3, 1e-4, 2e-4, 3e-3, 5e-4, 5e-4, 1e-3]).all()


def test_curvature_terms_come_nearer_at_the_same_step():
    options = {"restarts": 1, "steps": 20, "points": 40, "reference_states": 10}
    table = primed_ideas.curvature(20.0, ("pendulum",), **options)
    without, with_it = (float(row.split("|")[4].split("/")[0]) for row in table.splitlines()[2:])
    assert with_it < without / 3


def test_shorter_times_between_kicks_are_more_accurate():
    options = {"restarts": 1, "steps": 5, "points": 40, "reference_states": 10}
    table = primed_ideas.spacing(10.0, (0.1, 0.4), (2,), n=32, **options)
    short, long = (float(error) for error in table.splitlines()[-1].split("|")[2:4])
    assert 0 < short < long / 10


def test_a_network_on_top_of_a_primed_flow_starts_as_nothing_and_trains():
    system = henon_heiles()
    well = SympFlow.primed(system, 2, dt=0.5, processor=2).requires_grad_(False)
    flow = primed_ideas.with_network(well, (4,))
    assert flow.n_parameters == 2 * (4 * 2 + 4 + 4 + 4)
    x = torch.as_tensor(system.domain.sample(5, 0))
    torch.testing.assert_close(flow.psi(0.3, x).detach(), well.psi(0.3, x), atol=1e-4, rtol=0)
    options = {"optimizer": "gauss-newton", "loss": "labels", "steps": 3, "points": 20}
    table = primed_ideas.network(system, well, 2.0, ((4,),), **options)
    assert table.count("|") == 6 * 4
    errors = [float(row.split("|")[3].split("/")[0]) for row in table.splitlines()[2:]]
    assert errors[1] <= errors[0]


# a third party's method both ways ----------------------------------------------------------------------


def test_a_scheme_and_a_step_are_one_method_and_each_is_timed():
    found = plugins.rows(scale=100, repeats=1)
    assert [name for name, *_ in found] == ["1 trajectory, 20 steps", "10 trajectories, 2 steps"]
    assert all(0 < time < math.inf for _, *times in found for time in times)
    assert plugins.table(found).count("\n") == 3


# H that is not separable ------------------------------------------------------------------------------


def test_a_tiny_race_where_h_does_not_split(tmp_path, monkeypatch):
    small = {"METHODS": ("implicit_midpoint", "gauss_legendre4"), "REFERENCE_STEPS": 2000, "REPEATS": 1}
    for name, value in (small | {"MOST_STEPS": 16384}).items():
        monkeypatch.setattr(nonseparable, name, value)
    nonseparable.race(argparse.Namespace(systems=["nonseparable"], seconds=0.0, out=tmp_path))
    (fragment,) = tmp_path.glob("*.md")  # that of the winners takes all scenes
    midpoint, gauss = fragment.read_text(encoding="utf-8").splitlines()[2:4]
    assert midpoint.count("—") == 2  # too many steps at 1e-8
    cells = gauss.split("|")
    assert all(cells[k].strip().startswith("**") for k in (3, 5))  # the only one there
    assert "—" not in gauss


SMALL = {
    "training_starts": ["--quick"],
    "training_step": ["--points", "20", "--rounds", "1"],
    "driven": ["--only", "cost", "--rounds", "1"],
    "friction": ["--steps", "1000", "--rounds", "1"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_benchmarks_of_parts_run(name):
    """Benchmarks that use internal parts of the package, in miniature."""
    script = Path(again.__file__).with_name(f"{name}.py")
    done = subprocess.run([sys.executable, str(script), *SMALL[name]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
