"""Metrics of a run that blew up, and of arguments that are not runs."""

import numpy as np
import pytest

import sympflow
from sympflow import solve, systems
from sympflow.metrics.energy import energy_scale

HH, LOST = systems.henon_heiles(), [0.0, 0.0, 0.0, 0.7]  # singular at t = 5.45
OPTIONS = {"verlet": {"dt": 0.01}, "kahan_li8": {"dt": 0.01}, "chin4a": {"dt": 0.01}, "rk45": {}, "dop853": {}}
METRICS = {
    "largest energy error": sympflow.max_energy_error,
    "drift": lambda sol: sympflow.energy_drift(sol).slope,
    "error of the drift": lambda sol: sympflow.energy_drift(sol).standard_error,
    "volume": sympflow.volume_error,
    "symplecticity": sympflow.symplecticity_defect,
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("method", OPTIONS)
def test_a_run_that_blew_up_has_infinite_errors_alone_and_in_a_batch(method):
    """Without a warning of NumPy, whatever was stored of it."""
    stored = ((LOST, None), ([LOST], None), ([LOST, LOST], [10.0, 20.0]), (LOST, [0.0, 20.0]))
    lost = [solve(HH, method, (0, 20), y0, t_eval=t_eval, **OPTIONS[method]) for y0, t_eval in stored]
    both = solve(HH, method, (0, 20), [HH.y0, LOST], **OPTIONS[method])
    for name, metric in METRICS.items():
        assert all(np.all(metric(sol) == np.inf) for sol in lost), name
        good, bad = metric(both)
        assert np.isfinite(good), name
        assert bad == np.inf, name
    series = sympflow.volume_error(both, over_time=True)
    assert np.isfinite(series[0]).all()
    assert not np.isnan(series).any()
    assert series[1, -1] == np.inf


OF_SOLUTIONS = [
    *(sympflow.energy_error, sympflow.max_energy_error, energy_scale, sympflow.energy_drift),
    sympflow.volume_error,
    *(sympflow.symplecticity_defect, sympflow.loop_area_error, sympflow.reference_error),
    *(sympflow.time_reversal_error, sympflow.energy_growth, sympflow.energy_balance_error),
]


@pytest.mark.parametrize("metric", OF_SOLUTIONS)
@pytest.mark.parametrize("wrong", [3, None, np.zeros((4, 10))], ids=["number", "none", "array"])
def test_what_is_no_solution_is_refused(metric, wrong):
    with pytest.raises(TypeError, match=r"^`sol` must be a Solution; got .*\. Pass what solve"):
        metric(wrong)


@pytest.mark.parametrize("wrong", [3, "exact", np.zeros(3)], ids=["number", "word", "array"])
def test_what_is_no_reference_is_refused(wrong):
    with pytest.raises(TypeError, match=r"^`reference` must be a Reference, a Solution or an array.*Leave it out"):
        sympflow.reference_error(solve(systems.pendulum(), "verlet", (0, 1)), wrong)
