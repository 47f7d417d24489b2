"""The test whether any Hamiltonian explains the data, before fits: friction, another order of columns, no H at all."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sympflow
from sympflow.learning.families import FAMILIES
from sympflow.learning.fitting import Setting
from sympflow.learning.learner import Search, _said
from sympflow.learning.symplecticity import best_by_increments
from sympflow.learning.trajectories import Trajectories
from sympflow.training.session import Session


def runs(field, d, n=6, span=6.0, points=31, width=1.0, noise=0.005):
    random, t = np.random.default_rng(0), np.linspace(0, span, points)
    made = []
    for _ in range(n):
        y = solve_ivp(field, (0, span), width * random.uniform(-1, 1, 2 * d), t_eval=t, rtol=1e-8, atol=1e-10).y
        made.append((t, y + noise * random.normal(size=y.shape)))
    return made


def henon_heiles(t, y):
    return [y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2]


def walks():
    return [(np.arange(31.0), np.cumsum(y, 1)) for y in np.random.default_rng(0).normal(size=(6, 2, 31))]


def in_pairs(runs):
    return [(t, y[[0, 2, 1, 3]]) for t, y in runs]


CASES = {
    "pendulum": (lambda: runs(lambda t, y: [y[1], -np.sin(y[0])], 1, width=1.5), ""),
    "Hénon-Heiles": (lambda: runs(henon_heiles, 2, width=0.3), ""),
    "not separable": (lambda: runs(lambda t, y: [y[1] * (1 + y[0] ** 2), -y[0] * (1 + y[1] ** 2)], 1), ""),
    "a walk": (walks, ""),
    "friction": (lambda: runs(lambda t, y: [y[1], -np.sin(y[0]) - 0.2 * y[1]], 1), "friction"),
    "pairs": (lambda: in_pairs(runs(henon_heiles, 2, width=0.3)), "q1, p1, q2, p2"),
    "velocities": (
        lambda: runs(lambda t, y: [y[2], y[3], y[1] - 2 * y[0], (y[0] - 2 * y[1]) / 3], 2),
        "need not be Hamiltonian",
    ),
    "a limit cycle": (lambda: runs(lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0]], 1), "need not be Hamiltonian"),
}


@pytest.mark.parametrize("name", CASES)
def test_increments_tell_data_of_no_hamiltonian(name):
    make, said = CASES[name]
    data = Trajectories.read(make())
    about = _said(data, None, None, False, None, None)
    models = [c.model for family in FAMILIES.values() if family.linear for c in family.models(about)]
    _, reading = best_by_increments(*data.split(), models)
    assert (reading is None) == (not said)
    assert reading is None or said in reading.said


def test_columns_in_the_wrong_order_are_told_before_any_other_model():
    data = Trajectories.read(in_pairs(runs(henon_heiles, 2, n=5, width=0.3, span=4.0, points=21)))
    search = Search(data, data.folds(), _said(data, None, None, False, None, None), Setting(), 0)
    search.run([*FAMILIES], Session())
    assert len(search.history) == 1
    assert search.reading is not None
    (freedom,) = search.tested
    assert freedom.share < 0.1
    assert freedom.defect > 0.1
    assert freedom.rate == pytest.approx(0, abs=1e-10)  # the order of coordinates changes no volume
    with pytest.warns(UserWarning, match=r'No symplectic map explains.*pass order="pairs"'):
        search.diagnose(Session())


def test_discover_tells_it_too_and_ends_with_its_time():
    wrong = in_pairs(runs(henon_heiles, 2, n=5, width=0.3, span=4.0, points=21))
    with pytest.warns(UserWarning, match='pass order="pairs"'):
        system = sympflow.discover(wrong)
    assert not system.discovery.explains
    assert len(system.discovery.path) == 1
    right = runs(lambda t, y: [y[1], -np.sin(y[0])], 1, n=5, width=1.5)
    with pytest.warns(UserWarning, match="time budget"):
        system = sympflow.discover(right, time_budget=1e-6)
    assert len(system.discovery.terms) >= 1
    with pytest.raises(ValueError, match="`time_budget` must be a positive"):
        sympflow.discover(right, time_budget=-1)
