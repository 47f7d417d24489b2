"""The arithmetic of the comparison with other packages, and a tiny run of it. Nothing here judges a time."""
# ruff: noqa: E402  (the benchmarks are no package that is installed)

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
if not BENCHMARKS.exists():
    pytest.skip("the benchmarks are not part of the source distribution", allow_module_level=True)
sys.path.insert(0, str(BENCHMARKS))

import again
import primed
from contenders import loops, ours, tables
from contenders.contender import Scene, Skipped
from contenders.measurement import Results, Row, goals, measure
from measuring import race as at_equal_error

from sympflow.schemes import SCHEMES
from sympflow.systems import pendulum

pytestmark = pytest.mark.slow

TINY = Scene(t_end=20.0, n_instants=20, trajectories=70)  # more than a block of the hand-written loops, and not two


def row(package, label, seconds, trajectories=1, target=1e-6, control="dt"):
    return Row(label, package, trajectories, target, control, 0.1, 1e-7, 1e-5, 10, 10, 0, seconds, 0.0, 1.0)


# the step or tolerance for a target -------------------------------------------------------------------


# errors -----------------------------------------------------------------------------------------------


# every loop takes the steps of our methods ------------------------------------------------------------


# targets and page -------------------------------------------------------------------------------------


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


# training, drift, planets -----------------------------------------------------------------------------


# a third party's method both ways ----------------------------------------------------------------------


# H that is not separable ------------------------------------------------------------------------------


SMALL = {
    "own_systems": ["duffing", "--quick"],
    "through_solve": ["--quick"],
    "training_starts": ["--quick"],
    "training_step": ["--points", "20", "--rounds", "1"],
    "driven": ["--only", "cost", "--rounds", "1"],
    "friction": ["--steps", "1000", "--rounds", "1"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_benchmarks_of_parts_run(name):
    """Benchmarks in miniature. Some use internal parts of the package."""
    script = Path(again.__file__).with_name(f"{name}.py")
    done = subprocess.run([sys.executable, str(script), *SMALL[name]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
