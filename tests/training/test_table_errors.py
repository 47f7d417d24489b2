"""Errors that a fit reports of its flow at held-out states."""

import numpy as np
import pytest

from sympflow import Box, HamiltonianSystem, SympFlow, train
from sympflow.flow.scaling import Scaling
from sympflow.training.fits import PrimedFit
from sympflow.training.points import Labels, box_without, shares_missed
from sympflow.training.table_fit import TableRun, differences, distance


def test_shares_of_what_a_step_moves_are_the_same_in_all_units():
    rng = np.random.default_rng(0)
    x, y, unit = rng.normal(size=(20, 4)), rng.normal(size=(20, 4)), np.array([1e11, 1e11, 1e-20, 1e-20])
    labels = Labels(np.ones(1), x * unit, (y * unit)[None])
    assert shares_missed((x - y) * unit, labels, unit) == (1.0, 1.0)  # the identity
    assert shares_missed(0.25 * (x - y) * unit, labels, unit) == pytest.approx((0.25, 0.25), rel=1e-14)
    assert shares_missed(0 * y, labels, unit) == (0.0, 0.0)
    assert shares_missed(np.full_like(y, np.nan), labels, unit) == (np.inf, np.inf)


def test_numbers_that_overflow_are_not_finite_without_the_warnings_of_numpy():
    """Trials of a search may be anything: forces of a quartic potential beyond 1e308, and the squares of others."""
    system = HamiltonianSystem.from_sympy("p**2/2 + q**4/4", domain=Box([-1, -1], [1, 1]))
    flow = SympFlow.primed(system, 3, dt=1.0, processor=2).requires_grad_(False)
    run = TableRun(flow, system, system.domain, Scaling.unit(1), PrimedFit(points=5, reference_states=5))
    for size in (1e30, 1e100, 1e200):
        run.table.assign(size * np.random.default_rng(0).normal(size=flow.n_parameters))
        theta = run.table.parameters()
        assert run._frozen_cost(theta) == np.inf
        assert not np.isfinite(run.whole.linearized(theta)[1]).all()
        difference = differences(flow, run.step, run.held_out)
        assert distance(difference, np.ones(2)) == np.inf
        assert shares_missed(difference[-1], run.held_out, np.ones(2)) == (np.inf, np.inf)


def test_part_of_a_domain_that_spoils_a_fit_is_cut_off():
    x = np.random.default_rng(0).uniform([-1, -2, -3, -4], [1, 2, 3, 4], (400, 4))
    bad = (x[:, 1] > 1.5) | (x[:, 2] < -2.0)
    low, high = box_without(x[~bad], x[bad])
    inside = ((low <= x) & (x <= high)).all(1)
    assert not (inside & bad).any()
    assert inside.sum() > 0.9 * (~bad).sum()
    assert 1.4 < high[1] <= 1.5
    assert -2.0 <= low[2] < -1.9
    assert box_without(x, x[:0]) is None


FEW = {"restarts": 1, "steps": 8, "points": 40, "reference_states": 20, "progress": False}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The fit has a larger held-out error")  # than equal steps, which are as bad
def test_a_flow_that_misses_most_of_a_step_comes_with_a_warning():
    """The two-body problem in a box around its singularity, and a kink that Δt = 10 of three periods steps over."""
    collisions = HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)", domain=Box([-1] * 4, [1] * 4)
    )
    kink = HamiltonianSystem.from_sympy("p**2/2 + sqrt(q**2 + 1e-8)", domain=Box([-1, -1], [1, 1]))
    for system, dt in ((collisions, 0.2), (kink, 10.0)):
        with pytest.warns(UserWarning, match="far from the exact one.*smaller `domain`.*shorter `dt`.*another `flow`"):
            flow = train(system, flow=SympFlow.primed(system, 3, dt=dt, processor=2), **FEW)
        assert np.isfinite(flow.figures["one_step_error"])
