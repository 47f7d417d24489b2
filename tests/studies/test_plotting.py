"""Figures: they show what was measured, and leave matplotlib's global state alone."""

import subprocess
import sys

import numpy as np
import pytest

from sympflow import compare, get, poincare_section, systems
from sympflow.show.style import labelled, legend_above, new_figure
from sympflow.studies.figures import _annotate, overview, save_comparison


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
    bold = [line for line in report.figure("energy").axes[0].lines if line.get_linewidth() > 1]
    assert bold[0].get_ydata()[-1] == report.rows[0].energy_error
    assert (np.diff(bold[0].get_ydata()) >= 0).all()


def test_labels_cover_neither_markers_nor_each_other():
    """As in the demo: a long name right of two points that lie close together, another pair of these."""
    names = ["leapfrog", "verlet", "sympflow:flow=henon_heiles-sympflow", "mlp", "rk45"]
    points = list(zip([1.4e-4, 2.5e-4, 1.8e-3, 1.1e-1, 1.5e-1], [7e-2, 6e-2, 4e-3, 2.5e-1, 1.1], names, strict=True))
    figure = new_figure(4.7, 3.6)
    ax = figure.subplots()
    ax.set(xscale="log", yscale="log", xlim=(3e-5, 1.0), ylim=(1e-12, 1e2))
    _annotate(ax, points, {name: ("k", "o") for name in names})
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in ax.texts]
    assert [text.get_text() for text in ax.texts] == names
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert not any(box.contains(*ax.transData.transform((x, y))) for x, y, _ in points)


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


@pytest.mark.parametrize("method", ["kahan_li8", "explicit_adams", "dopri5"])
def test_portraits_of_two_degrees_of_freedom_are_sections(method):
    """The points are those of `poincare_section`, for every method."""
    system = systems.henon_heiles()
    options = {"rtol": 1e-7, "atol": 1e-9} if method == "dopri5" else {"dt": 0.01}
    report = compare(system, [get(method)(**options)], ["energy"], t_span=(0, 30), n_outputs=40, repeats=1)
    reference, points = report.figure("portrait").axes[0].lines
    section = poincare_section(system, "kahan_li8", (0, 30), dt=0.01)
    assert len(section) > 3
    np.testing.assert_allclose(reference.get_xydata(), section.states[:, [1, 3]], atol=1e-9)
    np.testing.assert_allclose(points.get_xydata(), section.states[:, [1, 3]], atol=1e-3)


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


@pytest.mark.slow
def test_the_portrait_of_a_flow_in_another_time_is_that_of_its_physical_time():
    system = systems.kepler(0.6)
    flow = get("sympflow")(flow="kepler-log-1")
    report = compare(system, [flow], ["energy"], t_span=(0, 50), n_outputs=40, repeats=1)
    points = report.figure("portrait").axes[0].lines[1].get_xydata()
    section = poincare_section(system, flow, (0, 50))
    np.testing.assert_allclose(points, section.states[:, [1, 3]], atol=1e-10)
    np.testing.assert_allclose(section.states[:, 1], -0.64, atol=1e-6)  # every orbit crosses at the same place


@pytest.mark.parametrize("number", [1, 3, 12])
@pytest.mark.parametrize("width", [3.0, 12.0])
def test_legends_are_as_wide_as_the_figure_at_most_and_take_nothing_from_the_panels(number, width):
    figure = new_figure(width, 3.0)
    ax = figure.subplots()
    for k in range(number):
        ax.plot([0, 1], [k, k], label=f"sympflow:flow=henon_heiles-sympflow number {k}")
    legend_above(figure, labelled([ax]), 7)
    figure.canvas.draw()
    box, panel = figure.legends[0].get_window_extent(), ax.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    assert 0 <= box.y0 < box.y1 <= figure.bbox.height
    assert panel.height > 1.7 * figure.dpi
