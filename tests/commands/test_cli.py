"""The command line: what it prints, what it writes, how it ends."""

import csv
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sympflow.commands import app
from sympflow.commands.console import in_options

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
    shown = run("methods", "kepler_takahashi_imada").output  # its sources are long
    assert "H. Rein, D. Tamayo" in shown
    assert max(map(len, shown.splitlines())) <= 120


def test_one_system_is_shown_with_its_flows(tmp_path):
    result = run("systems", "henon-heiles")
    assert result.exit_code == 0, result.output
    assert "p1**2/2 + p2**2/2 + q1**2*q2" in result.output
    assert "henon_heiles-sympflow" in result.output
    own = tmp_path / "quartic.toml"
    own.write_text("hamiltonian = 'p**2/2 + q**4'")
    assert "trained flows: none" in run("systems", own).output


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


def test_solve_goes_on_from_a_store_to_a_later_end(tmp_path):
    words = [
        "henon-heiles",
        "--method",
        "verlet",
        "--dt",
        0.1,
        "--store",
        tmp_path / "run.zarr",
        "--checkpoint-every",
        5,
    ]
    first = run("solve", *words, "--t-end", 1, "--progress")
    assert first.exit_code == 0, first.output
    assert "11 outputs in" in " ".join(first.output.split())
    assert "100 %  t = 1 of 1" in first.stderr
    refused = run("solve", *words, "--t-end", 2)
    assert refused.exit_code == 2
    assert "exists: pass" in " ".join(refused.output.split())
    later = run("solve", *words, "--t-end", 2, "--resume")
    assert "21 outputs in" in " ".join(later.output.split()), later.output


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
    assert 'pip install matplotlib, or in the clone of sympflow pip install ".[plot]"' in result.stderr
    assert not computed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "henon-hiles"], "Did you mean 'henon-heiles'"),
        (["compare", "henon-heiles", "--omega", "1"], "`--omega` is neither an option nor a parameter of henon-heiles"),
        (["train", "pendulum", "--budget", "2"], "did you mean --time-budget"),
        (["compare", "henon-heiles", "--t-ned", "1"], "`--t-ned` is neither an option nor a parameter"),
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
        (["train", "pendulum", "--checkpoint", "."], "`--checkpoint` '.' is a folder"),
        (["train", "pendulum", "--resume", "none.pt"], "is not a file: pass the path that was given as `--checkpoint`"),
        (["learn", "data.csv", "--observed", "p"], "`--observed` must be one of qp, qv, q; got 'p'"),
        (["solve"], "`system` is missing"),
        (["solve", "px**2/2 + x**2/2", "--y0", "1,0"], "they are q and p, or q1 … qd and p1 … pd"),
        (["solve", "harmonic-oscillator:omega=1:omega=2"], "`omega` is given twice"),
        (["solve", "harmonic-oscillator", "--omega", "1", "--omega", "2"], "`--omega` is given twice"),
        (["solve", "pendulum", "--method", "verlet:"], "behind a colon is not an option with a value"),
        (["solve", "pendulum", "--method", "sympflow:flow=nope"], "flows from other files are named by their path"),
        (["bench", "pendulum", "--methods", "verlet", "--t-end", 1, "--batch", 10**12], "`--batch` must be at most"),
        (["solve", "pendulum", "-x"], "`-x` is not an option"),
        (["solve", "pendulum", "--method", "verlet", "--n-outputs", "0"], "`--n-outputs` must be a positive integer"),
        (["solve", "pendulum", "--method", "verlet", "--n-outputs", "-3"], "`--n-outputs` must be a positive integer"),
        (["solve", "pendulum", "--method", "verlet", "--n-outputs", 10**12], "`--n-outputs` must be less than 1e+09"),
        (["solve", "pendulum", "--method", "verlet", "--save-every", "0"], "`--save-every` must be a positive integer"),
        (["solve", "pendulum", "--method", "verlet", "--t-end", "inf"], "`--t-end` must be finite"),
        (["solve", "pendulum", "--method", "verlet", "--y0", "1"], "`--y0` must have shape"),
        (["solve", "pendulum", "--method", "none.safetensors"], "`--method` 'none.safetensors' is not a file: name a"),
        (["solve", "pendulum", "--method", "rk45:dt=0.1"], "`dt` is not an option of method 'rk45'"),  # as written
        (["solve", "nonseparable", "--method", "verlet"], "use an implicit method such as 'gauss_legendre6'"),
        (["compare", "pendulum", "--backend", "fast"], "'fast' is not one of auto, compiled, array"),
        (["bench", "own.toml"], "`system` 'own.toml': there is no such file"),
        (["section", "pendulum", "--direction", "left"], "`--direction` must be one of up, down, both"),
        (["section", "pendulum", "--axes", "q"], "`--axes` must be two of q, p"),
        (
            ["section", "kicked", "--period", "2", "--level", "0"],
            "`--period` and `--level` choose two kinds of section",
        ),
        (["section", "pendulum", "--coordinate", "z"], "`--coordinate` must be one of q, p"),
        (["section", "pendulum", "--orbits", "2", "--y0", "1,0"], "`--orbits` and `--y0` both choose"),
        (["section", "pendulum", "--y0", "1,0", "--y0", "1"], "`--y0` must have the same number of components"),
        (["certificate", "pendulum", "--flow", "none"], "`--flow` 'none' does not name a flow that ships"),
        (["certificate", "pendulum", "--flow", "pendulum-mlp"], "`--flow` is an unconstrained network"),
        (["certificate", "pendulum", "--held-out", "0"], "`--held-out` must be an integer and at least 1"),
        (["certificate", "pendulum", "--out", "c.txt"], "`--out` must end in .json or .safetensors"),
        (["certificate", "quartic:t_end=0.01"], "`--t-end` must be finite and at least Δt"),
    ],
)
def test_wrong_usage_ends_with_a_remedy_and_not_with_a_traceback(words, message):
    result = run(*words)
    assert result.exit_code in (1, 2)
    assert message in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("observed", "columns", "velocities"), [("qp", "q,p", False), ("qv", "q,v", True), ("q", "q", True)]
)
def test_learn_reads_what_was_observed(observed, columns, velocities, tmp_path, monkeypatch):
    read = []

    def learned(data, **options):
        read.append(data)
        raise ValueError("`data` was read.")

    monkeypatch.setattr("sympflow.learning.learner.learn", learned)
    rows = [",".join(map(str, (t, *np.arange(t, t + len(columns.split(",")))))) for t in range(5)]
    (tmp_path / "data.csv").write_text("\n".join([f"t,{columns}", *rows]))
    result = run("learn", tmp_path / "data.csv", "--observed", observed, "--out", tmp_path / "flow.safetensors")
    assert "was read" in result.stderr
    assert (read[0].velocities, read[0].ndof, read[0].n_points) == (velocities, 1, 5)
    assert np.isnan(read[0].runs[0].y[1]).all() == (observed == "q")


def test_a_run_that_is_too_long_names_options_that_there_are():
    result = run("solve", "pendulum", "--method", "verlet", "--t-end", 1e9)
    assert result.exit_code == 2
    named = set(re.findall(r"--[\w-]+", result.stderr))
    assert named == {"--n-outputs", "--save-every"}
    assert named <= set(re.findall(r"--[\w-]+", run("solve", "--help").output))
    thinned = run("solve", "pendulum", "--method", "verlet", "--save-every", 100)
    assert "21 outputs" in thinned.stdout


def test_a_run_that_stops_says_what_to_raise_in_options():
    result = run("solve", "pendulum", "--method", "dopri5:max_num_steps=3")
    assert result.exit_code == 1
    assert "or end `--t-end` earlier" in result.stdout


def test_a_backticked_argument_is_the_option_of_the_command_that_runs():
    said = "`t_eval` and `hidden`: use backend='array' or `dt=0.1`, or flow.save(path=3); `rtol` stays."
    said += ' Pass damping=True and order="pairs".'
    here = "`--n-outputs` and `hidden`: use `--backend array` or `--dt 0.1`, or flow.save(path=3); `rtol` stays."
    here += " Pass `--damping` and `--order pairs`."
    contexts = []

    def command(
        ctx: typer.Context,
        n_outputs: int = 1,
        backend: str = "",
        dt: float = 1.0,
        damping: bool = False,
        order: str = "",
    ) -> None:
        contexts.append(ctx)

    app = typer.Typer()
    app.command()(command)
    assert CliRunner().invoke(app, []).exit_code == 0
    assert in_options(said, contexts[0]) == here


def test_a_section_is_printed_and_written(tmp_path):
    words = ("henon-heiles", "--method", "kahan_li8", "--t-end", 60, "--dt", 0.1)
    result = run("section", *words, "--orbits", 2, "--seed", 1, "--out", tmp_path, "--limit", 3)
    assert result.exit_code == 0, result.output
    with (tmp_path / "henon-heiles-section.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["trajectory"] for row in rows} == {"0", "1"}
    assert all(abs(float(row["q1"])) < 1e-12 for row in rows)
    assert all(float(row["p1"]) > 0 for row in rows)  # upwards
    assert (tmp_path / "henon-heiles-section.png").stat().st_size > 1000
    assert json.loads((tmp_path / "henon-heiles-section.json").read_text())["coordinate"] == "q1"
    assert f"… {len(rows) - 3} more" in result.stdout
    words = ("duffing", "--method", "rk4", "--dt", 0.3, "--t-end", 40, "--since", 10, "--turn", 3, "--force", 0.2)
    result = run("section", *words, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    with next(tmp_path.glob("duffing*.csv")).open() as file:
        times = [float(row["t"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose(times, 2 * np.pi * np.arange(2, 7))  # after each period
    failed = run("section", "henon-heiles", "--method", "verlet", "--y0", "0,0,0,0.7", "--t-end", 20)
    assert failed.exit_code == 1
    assert "became non-finite" in failed.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("solve hen", {"henon-heiles", "henon-heiles-escape"}),
        ("compare pendulum --methods verlet,gauss", {f"verlet,gauss_legendre{order}" for order in (4, 6, 8)}),
        ("section pendulum --method strang", {"strang_parts"}),
        ("section pendulum --direction b", {"both"}),
        ("solve --system qua", {"quartic", "quartic.toml"}),
        ("certificate pendulum --flow pendulum-m", {"pendulum-mlp"}),
        ("compare pendulum --metrics energy,vol", {"energy,volume"}),
    ],
)
def test_the_shell_completes_systems_methods_and_flows(words, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "quartic.toml").write_text("")
    asked = {"_SYMPFLOW_COMPLETE": "complete_bash", "COMP_WORDS": f"sympflow {words}"}
    asked["COMP_CWORD"] = str(len(words.split()))
    result = CliRunner().invoke(app, [], prog_name="sympflow", env=asked)
    assert set(result.stdout.split()) == expected


def test_without_the_extra_the_message_says_what_to_install():
    code = "import sys; sys.modules['typer'] = None; from sympflow.cli import main; main()"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert 'pip install ".[cli]"' in result.stderr


def test_solve_takes_a_tolerance():
    result = run("solve", "kepler", "--tol", 1e-5, "--t-end", 20)
    assert result.exit_code == 0
    assert float(re.search(r"largest energy error (\S+)", result.output)[1]) <= 1e-5
    refused = run("solve", "kepler", "--method", "rk45", "--tol", 1e-5)
    assert refused.exit_code != 0
    assert "`--tol` chooses the step of a method with fixed steps" in " ".join(refused.output.split())


ANSWERED = {
    "an option twice": (["solve", "pendulum", "--dt", "1", "--dt", "2"], "given 2 times: give it once"),
    "methods twice": (["compare", "pendulum", "--method", "rk4", "--method", "rk45"], "its values separated by"),
    "tolerance of rk45": (["solve", "pendulum", "--method", "rk45", "--tol", "1e-6"], "`rk45:rtol=1e-06`"),
    "a method as a system": (["solve", "pendulum", "verlet"], "give it as --method verlet"),
    "a parameter without --": (["solve", "harmonic-oscillator", "omega=3"], "as --omega 3"),
    "an equation": (["solve", "H = p**2/2"], "right side alone, without H ="),
    "a missing sign": (["solve", "p^2/2m"], r"write 2\*m"),
    "a driven formula without a value": (["solve", "p**2/2 + a*q*cos(t)"], "`--a` is missing"),
    "an end of a driven formula": (["solve", "p**2/2 + q*cos(t)", "--t", "3"], "did you mean --t-end"),
    "a keyword": (["solve", "p^2/2 + lambda*q"], "'lambda', which is a word of Python"),
    "a foreign option": (["solve", "pendulum", "--solver", "verlet"], "did you mean --method"),
    "a parameter of others": (["solve", "kepler", "--param", "e=0.3"], "`--param` is not an option: write --e 0.3"),
    "an option of a method": (["solve", "kepler", "--rtol", "1e-8"], "behind the name, --method NAME:rtol=1e-8"),
    "a late start": (
        ["solve", "pendulum", "--t-start", "200"],
        "`--t-start` 200 is not before the end, 100: give --t-end",
    ),
    "methods as words": (["compare", "pendulum", "--methods", "verlet", "rk45"], "--method rk45, several with commas"),
    "a capital": (["solve", "kepler", "--E", "0.3"], "did you mean --e"),
    "a path of Python": (["solve", "sympflow.systems.pendulum"], "Did you mean 'pendulum'"),
    "no Python": (["solve", "pendulum", "--method", "x"], "All are listed by `sympflow methods`"),
    "no lists": (["compare", "damped-pendulum", "--metrics", "energy"], "or pass error,conformal"),
}


@pytest.mark.parametrize(("words", "answer"), ANSWERED.values(), ids=ANSWERED)
def test_first_mistakes_are_answered_in_words_of_the_command_line(words, answer):
    result = run(*words)
    said = " ".join(result.output.replace("│", " ").split())
    assert result.exit_code == 2
    assert re.search(answer, said), said
    assert not re.search(r"sympflow\.[a-z]+\(|HamiltonianSystem|SymPy", said), said


def test_a_system_without_flows_is_told():
    assert "No flow ships for H = " in run("flows", "p**2/2 + q**6").output


@pytest.mark.parametrize("y0", ["1,0", "[1, 0]", "1 0"])
def test_a_start_time_and_a_driven_formula(y0):
    words = ["solve", "p**2/2 + q**2/2 - t*q", "--y0", y0, "--t-start", "2", "--t-end", "5", "--tol", "1e-9"]
    said = run(*words).output
    q, p = 5 - np.cos(3.0) - np.sin(3.0), 1 + np.sin(3.0) - np.cos(3.0)  # q = t − cos(t − 2) − sin(t − 2)
    found = re.search(r"y\(5\) = \[(.*), (.*)\]", said)
    np.testing.assert_allclose([float(x) for x in found.groups()], [q, p], atol=1e-7)


def test_solve_that_fails_ends_with_status_one():
    result = run("solve", "henon-heiles", "--method", "verlet", "--y0", "0,0,0,0.7", "--t-end", 20)
    assert result.exit_code == 1
    assert "became non-finite after t = 5." in result.output


@pytest.mark.slow
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


def test_quiet_prints_errors_alone(tmp_path):
    words = ("solve", "pendulum", "--method", "verlet", "--t-end", 1, "--out", tmp_path / "y.csv")
    quiet = run(*words, "--quiet")
    assert (quiet.exit_code, quiet.output) == (0, "")
    assert (tmp_path / "y.csv").exists()
    assert "outputs" in run(*words).stdout  # it is not kept for the next command
    for command in (("compare", "--metrics", "energy", *FAST), ("section", "--t-end", 5), ("flows",), ("systems",)):
        names = () if command[0] == "systems" else ("pendulum",)
        methods = {"compare": ("--methods", "verlet"), "section": ("--method", "verlet")}.get(command[0], ())
        assert run(command[0], *names, *methods, *command[1:], "-q").output == ""
    refused = run("solve", "pendulum", "--method", "vertel", "-q")
    assert refused.stdout == ""
    assert "Did you mean 'verlet'" in refused.stderr


def test_solve_takes_a_formula_and_the_values_of_its_symbols():
    formula = ("p**2/2 + k*q**4/4", "--k", 3)
    result = run("solve", *formula, "--y0", "1,0", "--t-end", 5, "--methods", "srkn11b", "--tol", 1e-9)
    assert result.exit_code == 0
    assert float(re.search(r"largest energy error ([0-9.e-]+)", result.output)[1]) <= 1e-9
    stiff = run("solve", "p**2/2 + 1e6*q**2/2 + .5e-3*q", "--y0", "1,0", "--t-end", "0.01")
    assert stiff.exit_code == 0
    missing = run("solve", "p**2/2 + k*q**4/4", "--y0", "1,0")
    assert missing.exit_code == 2
    assert "`--k` is missing" in missing.output


@pytest.mark.parametrize("locale", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}], ids=str)
def test_the_command_line_writes_utf_8(locale, tmp_path):
    env = os.environ | {"PYTHONCOERCECLOCALE": "0", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | locale
    words = ["compare", "pendulum", "--methods", "verlet", "--t-end", "1", "--out", str(tmp_path)]
    for call in (words, ["methods"]):
        ended = subprocess.run([sys.executable, "-m", "sympflow.cli", *call], capture_output=True, check=False, env=env)
        assert ended.returncode == 0, ended.stderr
        text = ended.stdout.decode("utf-8")
        assert not text.isascii() or call[0] == "methods"
    assert (tmp_path / "pendulum.csv").read_text(encoding="utf-8").startswith("system,")
