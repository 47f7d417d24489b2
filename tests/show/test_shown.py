"""Objects as text, as HTML and as figures."""

import io
import sys

import matplotlib  # noqa: F401
import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, systems
from sympflow.learning.trajectories import Trajectories
from sympflow.show.cards import legible

HH = systems.henon_heiles()
T = np.linspace(0, 5, 21)
ENERGY = "|energy error|, relative"


def orbits(system=HH, **options):
    return sympflow.solve(system, "verlet", (0, 5), dt=0.1, **options)


RESULTS = {
    "system": (lambda: HH, ["henon_heiles", "2 degrees of freedom"]),
    "solution": (orbits, ["Hénon–Heiles", "verlet, dt = 0.1", "51 times, 0 … 5", "(4, 51)", "e-03, relative"]),
    "batch": (lambda: orbits(y0=HH.domain.sample(3)), ["(3, 4, 51)"]),
    "driven": (lambda: orbits(systems.get("duffing")()), ["duffing"]),
    "flow": (lambda: sympflow.shipped_flows(HH)[0].load(HH), ["PrimedFlow of henon_heiles", "dt=0.82"]),
    "comparison": (lambda: sympflow.compare(HH, ["verlet", "leapfrog"], t_span=(0, 2)), ["Hénon–Heiles", "leapfrog"]),
    "work and precision": (
        lambda: sympflow.work_precision(HH, ["verlet"], t_span=(0, 2), batch=None, repeats=1),
        ["energy error", "step"],
    ),
    "section": (lambda: sympflow.poincare_section(HH, "verlet", (0, 30)), ["trajectory", "q2"]),
    "ensemble": (
        lambda: sympflow.ensemble(HH, "verlet", (0, 5), HH.domain, n=20, reduce="final"),
        ["Hénon–Heiles", "verlet, dt = 0.05", "20", "final (20, 4)"],
    ),
    "numbers of an ensemble": (
        lambda: sympflow.ensemble(HH, "verlet", (0, 5), HH.domain, n=20, reduce=lambda t, y: y[0].max()),
        ["20"],
    ),
    "trajectories": (lambda: Trajectories.read([(T, np.stack([np.sin(T), np.cos(T)]))]), ["1 trajectories", "21"]),
    "indicator": (lambda: sympflow.lyapunov(HH, "verlet", (0, 5), t_eval=[1, 2, 5]), ["value", "reached"]),
    "indicators": (lambda: sympflow.sali(HH, "verlet", (0, 5), HH.domain.sample(20)), ["(20,)"]),
    "frequencies": (lambda: sympflow.frequencies(HH, "verlet", (0, 200), n=3), ["frequencies", "amplitudes"]),
    "escapes": (
        lambda: sympflow.escape_times(HH, "verlet", (0, 20), HH.domain.sample(20), outside=0.4),
        ["time", "state"],
    ),
}


@pytest.mark.parametrize(("make", "told"), RESULTS.values(), ids=RESULTS)
def test_results_are_shown_as_text_html_and_figures(make, told, tmp_path):
    result = make()
    shown, html = repr(result), result._repr_html_()
    for words in told:
        assert words in shown
    assert html.startswith("<div>")
    assert html.endswith("</div>")
    assert ("<img" in html) == (result.preview() is not None)
    if hasattr(result, "plot"):
        figure = result.plot(path=tmp_path / "figure.png")
        assert (tmp_path / "figure.png").stat().st_size > 1000
        assert any(ax.lines or ax.collections or ax.patches for ax in figure.axes)


@pytest.mark.parametrize(
    ("system", "panels"),
    [
        (systems.pendulum(), ["q", "p", ENERGY]),
        (HH, ["q₂", "p₁", ENERGY]),
        (HamiltonianSystem.lattice(shape=16, bond="r**2/2", y0=np.eye(32)[0]), ["coordinate", "p₁", ENERGY, "q"]),
        (systems.get("duffing")(), ["q", "p"]),
    ],
    ids=["one", "two", "many", "driven"],
)
def test_panels_of_a_solution(system, panels):
    labels = [ax.get_ylabel() for ax in orbits(system).plot().axes]
    assert labels == panels
    assert [ax.get_ylabel() for ax in orbits(system).plot(["phase"]).axes] == [panels[1]]


def test_kinds_of_panels_are_checked():
    with pytest.raises(ValueError, match="`kinds` must be some of 'orbit', 'phase', 'energy'"):
        orbits().plot(["oribt"])


def test_systems_list_what_users_need():
    names = dir(HH)
    assert len(names) <= 30  # each is in `api.txt`
    assert {"hamiltonian", "from_sympy", "with_params", "params", "y0", "domain"} <= {*names}
    assert all(hasattr(HH, name) for name in names)


@pytest.mark.parametrize(("dt", "joined"), [(0.1, True), (1.0, True), (2.5, False)])
def test_curves_are_joined_where_they_are_known_between_points(dt, joined):
    line = sympflow.solve("harmonic-oscillator", "kahan_li8", (0, 30), dt=dt).plot("phase")
    assert (line.axes[0].lines[0].get_linestyle() == "-") == joined


@pytest.mark.parametrize(("system", "bodies"), [("solar-system", 9), ("lennard-jones", 7)])
def test_all_bodies_are_drawn(system, bodies):
    orbit, phase = sympflow.solve(system, t_span=(0, 0.01)).plot(["orbit", "phase"]).axes
    assert [text.get_text() for text in orbit.get_legend().texts] == [str(i) for i in range(bodies)]
    assert len(phase.lines) == bodies


def test_a_doubled_system_is_drawn_in_its_physical_limit():
    figure = sympflow.solve("decaying-orbit", t_span=(0, 5)).plot()
    assert len(figure.axes) == 2
    assert np.ptp(figure.axes[1].lines[0].get_ydata()) > 1


@pytest.mark.parametrize(("encoding", "expected"), [("ascii", "omega = 2.5e-06 us +- 1, Henon x -1"), ("utf-8", None)])
def test_what_a_terminal_cannot_print_is_spelled(monkeypatch, encoding, expected):
    text = "ω = 2.5e−06 µs ± 1, Hénon × −1"
    written = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", written)
    assert legible(text) == (expected or text)
    print(sympflow.solve(sympflow.systems.henon_heiles(), "verlet", (0, 1)))
    written.flush()
