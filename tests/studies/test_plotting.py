"""Figures: they show what was measured, and leave matplotlib's global state alone."""

import subprocess
import sys

import pytest

from sympflow import compare, get, systems
from sympflow.studies.figures import save_comparison


@pytest.fixture(scope="module")
def report():
    methods = ["verlet", "leapfrog", "rk45", get("verlet")(dt=2.5)]
    return compare(systems.henon_heiles(), methods, t_span=(0, 30), n_outputs=100, repeats=1)


def test_every_figure_is_saved(report, tmp_path):
    paths = save_comparison(report, tmp_path / "figures", prefix="hh-")
    assert [p.name for p in paths] == ["hh-error.png", "hh-energy.png", "hh-volume.png", "hh-portrait.png"]
    assert all(p.stat().st_size > 5000 for p in paths)
    report.plot(tmp_path / "same", prefix="hh-")
    assert sorted(p.name for p in (tmp_path / "same").iterdir()) == sorted(p.name for p in paths)
    report.plot(tmp_path / "energy", "energy")
    assert [p.name for p in (tmp_path / "energy").iterdir()] == ["energy.png"]


def test_plot_returns_the_figure_and_saves_it_where_a_path_says(report, tmp_path):
    overview_figure = report.plot()
    assert len(overview_figure.axes) == 3
    assert len(report.plot(kind="energy").axes) == 1
    saved = report.plot(tmp_path / "new" / "one.svg")
    assert len(saved.axes) == 3
    assert (tmp_path / "new" / "one.svg").read_text().startswith("<?xml")
    defect_only = compare(systems.pendulum(), ["verlet"], ["symplecticity"], t_span=(0, 5), n_outputs=10, repeats=1)
    assert "reference in grey" in defect_only.plot()._suptitle.get_text()


def test_figures_of_what_was_not_measured_are_refused(report, tmp_path):
    energy_only = compare(systems.pendulum(), ["verlet"], ["energy"], t_span=(0, 10), n_outputs=40, repeats=1)
    with pytest.raises(ValueError, match="`kind` 'volume' shows what was not measured"):
        energy_only.figure("volume")
    with pytest.raises(ValueError, match="`kind` must be one of"):
        report.figure("pie")
    with pytest.raises(ValueError, match="`path` must be a folder or end in"):
        report.plot(tmp_path / "figure.bmp")


def test_pyplot_is_never_imported_and_comparing_needs_no_matplotlib():
    code = """
import sys
import sympflow
report = sympflow.compare(sympflow.systems.pendulum(), ["verlet"], t_span=(0, 5), n_outputs=30, repeats=1)
assert "matplotlib" not in sys.modules and "torch" not in sys.modules
report.figure()
assert "matplotlib.pyplot" not in sys.modules
sys.modules["matplotlib.figure"] = None
try:
    report.figure()
except ImportError as error:
    assert 'pip install matplotlib, or in the clone of sympflow pip install ".[plot]"' in str(error)
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code], check=True)
