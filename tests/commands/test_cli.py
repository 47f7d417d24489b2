"""The command line: what it prints, what it writes, how it ends."""

import csv
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from sympflow.commands import app
from sympflow.commands.words import method, scenes

FAST = ["--t-end", "5", "--n-outputs", "40", "--repeats", "1"]


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_lists_of_systems_and_methods():
    result = run("systems")
    assert result.exit_code == 0
    assert all(name in result.output for name in ("harmonic-oscillator", "henon-heiles", "stiff-oscillator"))
    result = run("methods")
    assert result.exit_code == 0
    assert "kahan_li8" in result.output
    assert "W. Kahan" in result.output


def test_compare_writes_a_table_figures_and_files(tmp_path):
    result = run("compare", "henon-heiles", "--methods", "verlet,leapfrog,rk45:rtol=1e-6", *FAST, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "rk45:rtol=1e-6" in result.output
    with (tmp_path / "henon-heiles.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)] == ["verlet", "leapfrog", "rk45"]
    assert json.loads((tmp_path / "henon-heiles.json").read_text())["t_span"] == [0, 5]
    assert {p.name for p in tmp_path.glob("*.png")} == {
        "comparison.png",
        *(f"henon-heiles-{kind}.png" for kind in ("error", "energy", "volume", "portrait")),
    }


def test_compare_takes_several_systems_with_their_parameters(tmp_path):
    words = ["harmonic-oscillator", "harmonic-oscillator:omega=10:t_end=1", "stiff-oscillator", "--methods", "verlet"]
    result = run("compare", *words, "--metrics", "energy", *FAST, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    with (tmp_path / "comparison.csv").open() as file:
        found = [row["system"] for row in csv.DictReader(file)]
    assert found == [f"harmonic_oscillator(omega={omega})" for omega in (1, 10, 100)]
    assert (tmp_path / "harmonic-oscillator-omega=10.csv").exists()


def test_compare_survives_methods_that_do_not_apply_but_fails_if_none_does():
    result = run("compare", "harmonic-oscillator", "--omega", "10", "--methods", "sympflow,verlet", *FAST)
    assert result.exit_code == 0
    assert "no shipped sympflow flow" in result.output
    assert run("compare", "harmonic-oscillator", "--omega", "10", "--methods", "sympflow", *FAST).exit_code == 1


def test_solve_writes_csv_and_npz(tmp_path):
    result = run("solve", "henon-heiles", "--method", "verlet", "--t-end", 1, "--dt", 0.1, "--out", tmp_path / "y.csv")
    assert result.exit_code == 0, result.output
    text = (tmp_path / "y.csv").read_text().splitlines()
    assert text[0] == "t,q1,q2,p1,p2"
    assert len(text) == 12
    words = ["pendulum", "--method", "rk45:rtol=1e-8", "--y0", "-1,0.5", "--n-outputs", 10, "--out", tmp_path / "y.npz"]
    assert run("solve", *words).exit_code == 0
    with np.load(tmp_path / "y.npz") as data:
        assert data["y"].shape == (2, 11)
        assert data["y"][:, 0].tolist() == [-1, 0.5]


def test_solve_that_fails_ends_with_status_one():
    result = run("solve", "henon-heiles", "--method", "verlet", "--y0", "0,0,0,0.7", "--t-end", 20)
    assert result.exit_code == 1
    assert "became non-finite after t = 5." in result.output


def test_solve_takes_the_flow_by_default_and_either_spelling_of_a_system():
    result = run("solve", "henon_heiles", "--t-end", 5)
    assert result.exit_code == 0, result.output
    final = [line for line in result.output.splitlines() if line.startswith("y(5) = ")]
    assert final[0] in run("solve", "henon-heiles", "--method", "sympflow", "--t-end", 5).output
    one, other = scenes(["henon_heiles", "harmonic_oscillator:omega=3"])
    assert one.key == "henon-heiles"
    assert other.key == "harmonic-oscillator-omega=3"


@pytest.mark.parametrize("command", ["solve", "compare", "bench", "train"])
def test_an_output_that_cannot_be_written_is_refused_before_anything_is_computed(command, tmp_path, monkeypatch):
    computed = []
    for function in (
        "studies.comparison.compare",
        "studies.precision.work_precision",
        "solver.solve",
        "training.trainer.train",
    ):
        monkeypatch.setattr(f"sympflow.{function}", lambda *args, **options: computed.append(args))
    (tmp_path / "file").write_text("")
    name = {"solve": "y.csv", "train": "flow.safetensors"}.get(command, "folder")
    (tmp_path / "y.csv").mkdir()
    (tmp_path / "flow.safetensors").mkdir()
    for path in (tmp_path / "file" / name, tmp_path / name if "." in name else tmp_path / "file"):
        result = run(command, "pendulum", "--out", path)
        assert result.exit_code == 2
        assert result.stderr.startswith("Error: `--out` ")
        assert "name a" in result.stderr
    assert not computed


@pytest.mark.parametrize("command", ["compare", "bench"])
def test_missing_matplotlib_is_reported_before_anything_is_computed(command, tmp_path, monkeypatch):
    computed = []
    for function in ("studies.comparison.compare", "studies.precision.work_precision"):
        monkeypatch.setattr(f"sympflow.{function}", lambda *args, **options: computed.append(args))
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = run(command, "pendulum", "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert 'pip install "sympflow[plot]"' in result.stderr
    assert not computed


def test_a_blow_up_prints_no_warnings_of_numpy(tmp_path):
    words = ["henon-heiles", "--y0", "0,0,0,0.7", "--methods", "verlet,rk45", "--t-end", "20", "--repeats", "1"]
    code = "from sympflow.cli import main; main()"
    words = ["compare", *words, "--out", str(tmp_path)]
    result = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "Warning" not in result.stderr
    assert "inf" in result.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "henon-hiles"], "Did you mean 'henon-heiles'"),
        (["compare", "henon-heiles", "--omega", "1"], "`--omega` is no option, nor a parameter of henon-heiles"),
        (["compare", "henon-heiles", "--t-ned", "1"], "`--t-ned` is no option"),
        (["compare", "harmonic-oscillator", "--omega", "fast"], "`--omega` must be a number"),
        (["compare", "harmonic-oscillator:mass=2"], "`mass` is not a parameter of harmonic-oscillator"),
        (["compare", "pendulum", "--methods", "vertel"], "Did you mean 'verlet'"),
        (["compare", "pendulum", "--methods", "verlet:rtol=1"], "`rtol` is not an option of method 'verlet'"),
        (["compare", "pendulum", "--metrics", "beauty"], "`--metrics` has no 'beauty'"),
        (["compare", "pendulum", "--methods", "none.safetensors"], "none.safetensors"),
        (["solve", "pendulum", "--method", "verlet", "--y0", "1,a"], "`--y0` must be a number"),
        (["solve", "pendulum", "--method", "verlet", "--out", "y.txt"], "`--out` must end in .csv or .npz"),
        (["solve", "pendulum", "henon-heiles", "--method", "verlet"], "`system` must be one"),
        (["solve", "pendulum", "--method", "verlet", "--dt", "-1"], "`--dt` must be a positive"),
        (["train", "pendulum", "--hidden", "ten"], "`--hidden` must be whole numbers"),
        (["train", "pendulum", "--out", "flow.pt"], "`--out` must end in .safetensors"),
    ],
)
def test_wrong_usage_ends_with_a_remedy_and_not_with_a_traceback(words, message):
    result = run(*words)
    assert result.exit_code in (1, 2)
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_train_makes_a_primed_flow_unless_told_otherwise(tmp_path):
    path = tmp_path / "flow.safetensors"
    small = ("--stages", 1, "--processor", 0, "--dt", 0.4, "--restarts", 1, "--steps", 3, "--points", 20)
    result = run("train", "pendulum", *small, "--out", path)
    assert result.exit_code == 0, result.stderr
    assert "fractional error" in result.stdout
    assert run("solve", "pendulum", "--method", path, "--t-end", 1).exit_code == 0
    refused = run("train", "pendulum", *small, "--pairs", 2, "--out", path)
    assert refused.exit_code == 2
    assert "`--pairs` is not an option of flows of kind 'primed'" in refused.stderr


def test_flows_are_listed():
    everything = run("flows").stdout
    assert "henon_heiles-sympflow" in everything
    own = run("flows", "harmonic-oscillator", "--omega", 100).stdout
    assert "harmonic_oscillator_100-sympflow" in own
    assert "henon_heiles" not in own


def test_train_writes_a_flow_that_solve_takes(tmp_path):
    path = tmp_path / "flow.safetensors"
    small = ["--pairs", 1, "--hidden", "4", "--epochs", 3, "--points", 40, "--seed", 1, "--dt", 0.2]
    result = run("train", "pendulum", *small, "--out", path, "--checkpoint", tmp_path / "run.pt")
    assert result.exit_code == 0, result.output
    assert "one step error" in result.output
    assert run("train", "pendulum", *small, "--out", path, "--resume", tmp_path / "run.pt").exit_code == 0
    result = run("solve", "pendulum", "--method", path, "--t-end", 1, "--out", tmp_path / "y.csv")
    assert result.exit_code == 0, result.output
    assert len((tmp_path / "y.csv").read_text().splitlines()) == 7
    result = run("compare", "pendulum", "--methods", f"{path},verlet", *FAST)
    assert result.exit_code == 0
    assert "flow  " in result.output


def test_parameters_reach_the_system():
    one, other = scenes(["harmonic-oscillator", "pendulum", "--omega=4"])
    assert one.system.params == {"omega": 4.0}
    assert one.key == "harmonic-oscillator-omega=4"
    assert other.system.params == {}
    assert method("verlet:dt=0.1")[1].dt == 0.1


def test_help_has_examples():
    for command in ("solve", "compare", "train"):
        result = run(command, "--help")
        assert result.exit_code == 0
        assert f"sympflow {command} " in result.output


def test_without_the_extra_the_message_says_what_to_install():
    code = "import sys; sys.modules['typer'] = None; from sympflow.cli import main; main()"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert 'pip install "sympflow[cli]"' in result.stderr


def test_bench_writes_the_diagram(tmp_path):
    words = ["pendulum", "--methods", "verlet,kahan_li8", "--t-end", 5, "--batch", 5, "--n-outputs", 5, "--repeats", 1]
    result = run("bench", *words, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert "For an energy error of" in result.output
    assert {p.suffix for p in tmp_path.glob("pendulum-work-precision*")} == {".csv", ".json", ".png"}


def test_solve_takes_a_tolerance():
    result = run("solve", "kepler", "--tol", 1e-5, "--t-end", 20)
    assert result.exit_code == 0
    assert float(re.search(r"largest energy error (\S+)", result.output)[1]) <= 1e-5
    refused = run("solve", "kepler", "--method", "verlet", "--tol", 1e-5)
    assert refused.exit_code != 0
    assert "`--tol` is not an option of" in refused.output
