"""Flows of planets: one kick a step in trained coordinates."""

import numpy as np
import pytest

from sympflow import HamiltonianSystem, KeplerFit, load, shipped_flows, solve, systems, train
from sympflow.training import ClockedFit, GaussNewton
from sympflow.training.planet_fit import LONGEST, SHORTEST
from sympflow.training.shipped.recipe import Recipe

OUTER = systems.solar_system(("Jupiter", "Saturn", "Uranus", "Neptune"))
LIGHT = HamiltonianSystem.planets([1.0, 1e-3, 0.0], elements={"a": [1.0, 2.0]})
SMALL = {"reach": 16, "points": 400, "orbits": 5000}


@pytest.fixture(scope="module")
def flow():
    return train(OUTER, KeplerFit(228.0, **SMALL))


def test_times_between_steps_are_near_the_exact_solution(flow):
    t = np.array([0.0, 100.0, 228.0, 500.0])
    y = solve(OUTER, flow, (0, 500.0), t_eval=t).y
    right = solve(OUTER, "dop853", (0, 500.0), t_eval=t, rtol=1e-13, atol=1e-16).y
    assert np.abs(y - right)[:, 1].max() < 1e-12
    assert np.abs(y - right).max() < 1e-7  # Wisdom's and Holman's step of 228 days alone misses by 1e-5


def test_a_tolerance_chooses_the_step(capsys):
    masses, orbits = [1.0, 1e-5, 1e-5], {"a": [1.0, 1.6], "e": [0.05, 0.02], "M": [0, 2.0]}
    system = HamiltonianSystem.planets(masses, elements=orbits)
    flow = train(system, tol=1e-6, reach=4, points=100, gradients=0, orbits=300.0, progress=True)
    assert f"Δt {flow.dt:.4g}" in capsys.readouterr().err
    assert flow.figures["energy_error"] <= 1e-6
    period = min(system.local.frame.periods)  # of which the steps that are tried are parts
    assert SHORTEST * period < flow.dt <= LONGEST * period * (1 + 1e-12)


@pytest.mark.parametrize("system", [OUTER, systems.solar_system()])
def test_those_that_ship_are_chosen_by_tolerance(system):
    """Their figures are of 1e5 years; what takes longer is more accurate, and has its recipe."""
    rungs = [f for f in shipped_flows(system) if f.reach]
    errors = [f.energy_error for f in rungs]
    assert len(rungs) > 2
    assert errors == sorted(errors, reverse=True)
    for rung in rungs:
        sol = solve(system, "sympflow", (0, 1e4 * 365.25), tol=rung.energy_error * 1.001, save_every=400)
        assert sol.stats["dt"] == rung.dt
        assert np.abs(sol.energy_error()).max() < 1.1 * rung.energy_error  # at other times
    assert solve(system, t_span=(0, 1000.0)).integrator.name == "wisdom_holman"  # where none is asked for
    made = Recipe.of(rungs[0].path)
    again = made.fitted(progress=False)
    # singular values near the cutoff leave the numbers free, within what the orbits tell
    assert again.figures["energy_error"] == pytest.approx(made.flow.figures["energy_error"], rel=0.05)
    assert made.judge.__name__ == "of_planets"


def test_where_it_does_not_hold(flow):
    other = {"a": [5.2, 9.6, 19.2, 30.1], "e": 0.02, "M": [0, 1.0, 2.0, 3.0]}
    system = HamiltonianSystem.planets(OUTER.local.masses, elements=other, units="AU, day, solar mass")
    with pytest.raises(ValueError, match=r"^`system` .* has body 2 on another orbit, of period"):
        solve(system, flow, (0, 1000.0))


@pytest.mark.parametrize(
    ("system", "options", "message"),
    [
        (OUTER, {"gradients": -1}, "^`gradients` must be an integer from 0"),
        (OUTER, {"gradients": 2.0}, "^`gradients` must be an integer from 0"),
        (OUTER, {"points": 150.5}, "^`points` must be a positive integer"),
        (OUTER, {"reach": 0.5}, "^`reach` must be a positive integer"),
        (OUTER, {"points": 20}, "^`points` 20 are fewer than the numbers"),
        (OUTER, {"tol": 0.0}, "^`tol` must be"),
        (systems.henon_heiles(), {}, "has no planets in Jacobi's coordinates"),
        (LIGHT, {}, "^`system` .* has bodies without mass, .* train a flow of the planets alone"),
    ],
)
def test_bad_arguments(system, options, message):
    with pytest.raises(ValueError, match=message):
        train(system, KeplerFit(1.0, **options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "kepler", "stages": 3}, "^`stages` is not an option of flows of kind 'kepler'"),
        (
            {"kind": "kepler", "solver": GaussNewton()},
            "^`solver` is for fits that run in steps, and KeplerFit does not",
        ),
        ({"callback": print}, "^`callback` is for fits that run in steps, and KeplerFit does not"),
        (
            {"fit": ClockedFit(1.0), "resume": "run.ckpt"},
            "^`resume` is for fits that run in steps, and ClockedFit does not",
        ),
    ],
)
def test_options_of_fits_in_steps_are_refused(options, message):
    with pytest.raises(TypeError, match=message):
        train(OUTER, **options)


def test_trained_coordinates_are_better_than_standard_ones(flow, tmp_path):
    """Over ten times as long as it was trained for; a step is the same, a kick and a drift."""
    given = {"t_span": (0, 3e7), "save_every": 100, "on_domain_exit": "ignore"}
    trained = solve(OUTER, flow, **given)
    with pytest.warns(RuntimeWarning, match="`dt` 228 is long for method 'wisdom_holman'"):
        standard = solve(OUTER, "wisdom_holman", dt=228.0, corrector=17, **given)
    error, of_standard = (np.abs(sol.energy_error()).max() for sol in (trained, standard))
    assert error < 0.75 * of_standard
    assert error < 1.5 * flow.figures["energy_error"]
    flow.save(tmp_path / "flow.safetensors")
    again = load(tmp_path / "flow.safetensors", system=OUTER)
    assert np.array_equal(solve(OUTER, again, **given).y, trained.y)
