"""Reductions to chaos indicators, frequencies, escapes and crossings: those of the functions, whatever the chunks."""

import numpy as np
import pytest

import sympflow
from sympflow.ensembles.dynamics import Escape, Gali, PlaneCrossings, Sali
from sympflow.systems import henon_heiles

SYSTEM = henon_heiles()
Y0 = np.random.default_rng(0).uniform(-0.25, 0.25, (70, 4))


@pytest.mark.parametrize(
    "reduce", ["sali", "frequencies", Escape(0.3), PlaneCrossings(most=5), Sali(below=0.3)], ids=lambda r: str(r)[:8]
)
def test_chunks_do_not_matter(reduce):
    whole, parts = (sympflow.ensemble(SYSTEM, "verlet", (0, 50), Y0, dt=0.1, reduce=reduce, chunk=n) for n in (70, 33))
    for name, values in whole.fields.items():
        np.testing.assert_array_equal(values, parts.fields[name])
    assert not whole.status.any()


def test_they_are_those_of_the_functions():
    sali = sympflow.sali(SYSTEM, "verlet", (0, 50), Y0, dt=0.1)
    reduced = sympflow.ensemble(SYSTEM, "verlet", (0, 50), Y0, dt=0.1, reduce="sali")
    np.testing.assert_array_equal(reduced.sali, sali.value)
    section = sympflow.poincare_section(SYSTEM, "verlet", (0, 50), Y0[:3], dt=0.1)
    found = sympflow.ensemble(SYSTEM, "verlet", (0, 50), Y0[:3], dt=0.1, reduce="crossings")
    assert found.n_crossings.sum() == len(section)
    np.testing.assert_allclose(found.crossing_times[1][: int(found.n_crossings[1])], section.t[section.trajectory == 1])


def test_bad_reductions():
    with pytest.raises(ValueError, match="`k` must be from 2 to 4"):
        sympflow.ensemble(SYSTEM, "verlet", (0, 5), Y0, reduce=Gali(k=5))
    with pytest.raises(ValueError, match="equidistant"):
        sympflow.ensemble(SYSTEM, "verlet", (0, 5), Y0, reduce="frequencies", t_eval=[0, 1, 5])
    with pytest.raises(ValueError, match="keeps the second copy"):
        sympflow.ensemble(SYSTEM, "tao4", (0, 5), Y0, reduce="sali")
    with pytest.raises(ValueError, match="`coordinate` must be"):
        sympflow.ensemble(SYSTEM, "verlet", (0, 5), Y0, reduce=PlaneCrossings(coordinate=9))


def test_an_orbit_that_fails_is_a_row():
    y0 = [[0.1, 0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 0.7]]
    for reduce in ("sali", "crossings"):
        result = sympflow.ensemble(SYSTEM, "verlet", (0, 60), y0, dt=0.1, reduce=reduce)
        assert result.status.tolist() == [0, -1]
        assert "finite" in result.messages[1,]


def test_orbits_that_fail_have_no_crossings_whatever_the_chunks():
    system = sympflow.systems.henon_heiles_escape()
    y0 = np.concatenate([[[9.0, 0.1, 0.0, 0.0]], 0.1 * np.random.default_rng(1).standard_normal((5, 4)), [system.y0]])
    how = {"t_span": (0, 20), "dt": 0.05, "reduce": "crossings"}
    whole = sympflow.ensemble(system, "verlet", y0=y0, **how)
    np.testing.assert_array_equal(np.isnan(whole.n_crossings), whole.status < 0)
    assert (whole.status < 0).sum() == 2
    assert np.isnan(whole.crossing_times[whole.status < 0]).all()
    assert np.isnan(whole.crossing_states[whole.status < 0]).all()
    parts = sympflow.ensemble(system, "verlet", y0=y0, chunk=2, **how)
    np.testing.assert_array_equal(whole.n_crossings, parts.n_crossings)
    np.testing.assert_array_equal(whole.crossing_times, parts.crossing_times)
