"""The example plug-in, installed as a user would, is found by name and passes its own tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="the plug-in is built with hatchling: pip install hatchling")

PLUGIN = Path(__file__).parents[2] / "examples" / "plugin"


def run(*arguments, path):
    environment = os.environ | {"PYTHONPATH": str(path)}
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment, check=False)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder into which the plug-in was installed, without network."""
    target = tmp_path_factory.mktemp("site")
    pip = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target"]
    result = run(*pip, str(target), str(PLUGIN), path="")
    assert result.returncode == 0, result.stderr
    return target


def test_it_is_listed_without_being_imported_and_solves(installed):
    program = """
import sys
import sympflow
assert {"ruth3", "ruth3_by_steps"} <= set(sympflow.available())
assert "morse" in sympflow.systems.available()
assert "sympflow_ruth" not in sys.modules
system = sympflow.systems.henon_heiles()
for name, backend in (("ruth3", "compiled"), ("ruth3_by_steps", "numpy")):
    sol = sympflow.solve(system, name, (0, 10), dt=0.05, events=lambda t, y: y[0])
    assert sol.success and sol.t_events[0].size
    assert sol.nfev >= 3 * 200
    assert sol.stats["backend"] == backend, sol.stats
assert sympflow.get("ruth3").scheme is sys.modules["sympflow_ruth.schemes"].RUTH3
assert "linear" in repr(sympflow.get("ruth3")(splitting="linear"))
methods = ["ruth3", "ruth3_by_steps", "verlet"]
report = sympflow.compare(system, methods, t_span=(0, 10), metrics=("energy",), repeats=1)
assert [row.method for row in report.rows] == methods
assert report.rows[0].energy_error < report.rows[2].energy_error
assert sympflow.systems.get("morse")(depth=2.0).params["depth"] == 2.0
"""
    result = run("-c", program, path=installed)
    assert result.returncode == 0, result.stderr


def test_the_command_line_knows_its_system_and_its_method(installed):
    pytest.importorskip("typer")
    words = ["solve", "morse:depth=2", "--method", "ruth3", "--t-end", "2"]
    result = run("-m", "sympflow.cli", *words, path=installed)
    assert result.returncode == 0, result.stderr
    assert "backend = compiled" in result.stdout


@pytest.mark.slow
def test_it_passes_its_own_tests(installed):
    result = run("-m", "pytest", "-q", "-p", "no:cacheprovider", str(PLUGIN / "tests"), path=installed)
    assert result.returncode == 0, result.stdout
