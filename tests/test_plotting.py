"""Figures: they show what was measured, and leave matplotlib's global state alone."""

import subprocess
import sys

import numpy as np
import pytest

from sympflow import compare, get, solve, systems
from sympflow.crossings import section_crossings
from sympflow.plotting import overview, save_comparison
from sympflow.portraits import section_figure


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


def test_energy_panel_shows_the_running_maximum(report):
    ax = report.figure("energy").axes[0]
    bold = [line for line in ax.lines if line.get_linewidth() > 1]
    assert bold[0].get_ydata()[-1] == report.rows[0].energy_error
    assert (np.diff(bold[0].get_ydata()) >= 0).all()


def test_overview_has_a_row_for_each_system(report):
    pendulum = compare(systems.pendulum(), ["verlet"], t_span=(0, 10), n_outputs=40, repeats=1)
    figure = overview([report, pendulum])
    assert len(figure.axes) == 6
    assert [ax.get_title(loc="left") for ax in figure.axes[::3]] == ["Hénon–Heiles", "pendulum"]


def test_figures_of_what_was_not_measured_are_refused(report, tmp_path):
    energy_only = compare(systems.pendulum(), ["verlet"], ["energy"], t_span=(0, 10), n_outputs=40, repeats=1)
    with pytest.raises(ValueError, match="`kind` 'volume' shows what was not measured"):
        energy_only.figure("volume")
    with pytest.raises(ValueError, match="`kind` must be one of"):
        report.figure("pie")
    with pytest.raises(ValueError, match="`path` must be a folder or end in"):
        report.plot(tmp_path / "figure.bmp")


def test_section_lies_in_the_plane_and_on_the_energy_surface():
    system = systems.henon_heiles()
    sol = solve(system, "kahan_li8", (0, 300), t_eval=np.linspace(0, 300, 6001))
    points = section_crossings(sol)
    assert len(points) > 30
    assert np.abs(points[:, 0]).max() < 1e-12
    assert (points[:, 2] > 0).all()
    energies = system.hamiltonian(points)
    assert (
        np.abs(energies - system.hamiltonian(system.y0)).max() < 1e-6
    )  # Hermite interpolation at h = 0.05: h⁴ · 1/384
    halved = section_crossings(solve(system, "kahan_li8", (0, 300), t_eval=np.linspace(0, 300, 12001)))
    assert np.abs(points - halved).max() < 1e-6


def test_section_of_a_batch_is_that_of_its_trajectories():
    system = systems.henon_heiles()
    y0, t = system.domain.sample(3, 1), np.linspace(0, 100, 2001)
    together = section_crossings(solve(system, "verlet", (0, 100), y0, t_eval=t))
    apart = np.concatenate([section_crossings(solve(system, "verlet", (0, 100), y, t_eval=t)) for y in y0])
    np.testing.assert_allclose(np.sort(together, axis=0), np.sort(apart, axis=0), atol=1e-12)
    assert section_figure([("verlet", solve(system, "verlet", (0, 100), y0, t_eval=t))], energy=0.1).axes
    with pytest.raises(ValueError, match="`sections` are of two degrees of freedom"):
        section_figure([("pendulum", solve(systems.pendulum(), "verlet", (0, 1)))])


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
    assert 'pip install "sympflow[plot]"' in str(error)
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code], check=True)
