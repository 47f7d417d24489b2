"""What a fit says of how far its flow is from the exact one at held-out states."""

import warnings

import numpy as np
import pytest

from sympflow import Box, HamiltonianSystem, SympFlow, systems, train
from sympflow.training.labels import Labels
from sympflow.training.levenberg_marquardt import Minimum
from sympflow.training.table_errors import USELESS, shares_missed
from sympflow.training.table_fit import TableFit

PENDULUM = systems.pendulum()
FEW = {"restarts": 1, "steps": 8, "points": 40, "reference_states": 20, "progress": False}


def test_shares_of_what_a_step_moves_are_the_same_in_all_units():
    rng = np.random.default_rng(0)
    x, y, unit = rng.normal(size=(20, 4)), rng.normal(size=(20, 4)), np.array([1e11, 1e11, 1e-20, 1e-20])
    labels = Labels(np.ones(1), x * unit, (y * unit)[None])
    assert shares_missed((x - y) * unit, labels, unit) == (1.0, 1.0)  # the identity
    assert shares_missed(0.25 * (x - y) * unit, labels, unit) == pytest.approx((0.25, 0.25), rel=1e-14)
    assert shares_missed(0 * y, labels, unit) == (0.0, 0.0)
    assert shares_missed(np.full_like(y, np.nan), labels, unit) == (np.inf, np.inf)


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


def test_a_flow_that_follows_a_step_comes_without_one():
    """Two leapfrog steps of ω Δt = ½ among them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for flow in (SympFlow.primed(PENDULUM, 3, dt=1.0), SympFlow.primed(PENDULUM, 2, force_gradient=False)):
            train(PENDULUM, flow=flow, **FEW)
    assert USELESS == 0.1  # as the documentation says


def test_fits_far_from_any_flow_end_without_the_warnings_of_numpy(monkeypatch):
    """Energies of 1e160, whose squares overflow: what is not finite is rejected, and only the remark remains."""
    system = HamiltonianSystem.from_sympy("p**2/2 + exp(q**2)", domain=Box([-20, -1], [20, 1]))
    monkeypatch.setattr(TableFit, "minimize", lambda self, theta, *_, **__: Minimum(theta, 1.0, 0, ""))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        flow = SympFlow.primed(system, 3, dt=1e-3, processor=2)
        train(system, flow=flow, **FEW)
    assert [w.category for w in caught] == [UserWarning]
