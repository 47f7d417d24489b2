"""The test whether any Hamiltonian explains the data, before fits: friction, another order of columns, no H at all."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sympflow.learning.diagnosis import ALIKE, Cause, best_by_increments, forced, hint
from sympflow.learning.families import FAMILIES
from sympflow.learning.fitting import Setting
from sympflow.learning.learner import constraints_of
from sympflow.learning.library import library_for
from sympflow.learning.models import drags, friction, frictions
from sympflow.learning.parts import Drive, Polynomial
from sympflow.learning.search import Search
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


def turning(t, y):
    """An isotropic oscillator in a magnetic field, whose states are those of an H in the order q1, p1, q2, p2 too."""
    return [y[2], y[3], -y[0] + 0.8 * y[3], -y[1] - 0.8 * y[2]]


def driven(t, y):
    return [y[1], -np.sin(y[0]) + 0.3 * np.cos(1.7 * t)]


def driven_twice(t, y):
    return [y[1], -np.sin(y[0]) + 0.3 * np.cos(1.7 * t) + 0.2 * np.sin(2.9 * t)]


def dragged(t, y):
    return [y[1], -y[0] - 0.2 * abs(y[1]) * y[1]]


def in_pairs(runs):
    return [(t, y[[0, 2, 1, 3]]) for t, y in runs]


CASES = {
    "pendulum": (lambda: runs(lambda t, y: [y[1], -np.sin(y[0])], 1, width=1.5), None),
    "Hénon-Heiles": (lambda: runs(henon_heiles, 2, width=0.3), None),
    "not separable": (lambda: runs(lambda t, y: [y[1] * (1 + y[0] ** 2), -y[0] * (1 + y[1] ** 2)], 1), None),
    "a walk": (walks, None),
    "friction": (lambda: runs(lambda t, y: [y[1], -np.sin(y[0]) - 0.2 * y[1]], 1), Cause.FRICTION),
    "pairs": (lambda: in_pairs(runs(henon_heiles, 2, width=0.3)), Cause.PAIRS),
    "velocities": (lambda: runs(lambda t, y: [y[2], y[3], y[1] - 2 * y[0], (y[0] - 2 * y[1]) / 3], 2), Cause.FREE),
    "little friction": (lambda: runs(lambda t, y: [y[1], -np.sin(y[0]) - 0.01 * y[1]], 1, span=12.0), Cause.FRICTION),
    "quadratic drag": (lambda: runs(lambda t, y: [y[1], -np.sin(y[0]) - 0.2 * abs(y[1]) * y[1]], 1), Cause.DRAG),
    "a magnetic field": (lambda: runs(turning, 2, points=61), Cause.TURNED),
    "a limit cycle": (lambda: runs(lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0]], 1), Cause.FREE),
}


def candidates(data):
    about = constraints_of(data, None, None, False, None, None)
    return [c.model for family in FAMILIES.values() if family.linear for c in family.models(about)]


@pytest.mark.parametrize("name", CASES)
def test_increments_tell_data_of_no_hamiltonian(name):
    make, cause = CASES[name]
    data = Trajectories.read(make())
    _, reading, _ = best_by_increments(*data.split(), candidates(data))
    assert (None if reading is None else reading.cause) is cause


@pytest.mark.parametrize(
    ("field", "d", "known", "said"),
    [
        (lambda t, y: [y[1], -y[0] - 0.2 * y[1]], 1, {}, "Friction p' = -γp with γ = 0.2"),
        (dragged, 1, {"force": frictions}, "Quadratic drag p' = -c|p|p with c = 0.2"),
        (dragged, 1, {"force": drags}, "None"),
        (driven, 1, {"drives": [Drive(Polynomial.up_to(1, "q", [1.0]), 1.7)]}, "None"),
        (driven, 1, {}, "angular frequency 1.7"),
        (driven_twice, 1, {}, "angular frequencies 1.7"),
        (driven_twice, 1, {"drives": [Drive(Polynomial.up_to(1, "q", [1.0]), 1.7)]}, "angular frequencies 1.7 and 2."),
        (turning, 2, {}, "magnetic field, by which p_i' = B p_j, p_j' = -B p_i with B = 0.8"),
        (lambda t, y: [y[1], -np.sin(y[0])], 1, {}, "None"),
    ],
)
def test_hints_name_the_reason_and_its_size(field, d, known, said):
    data = Trajectories.read(runs(field, d, points=61, noise=1e-3))
    smooth = data.smooth
    found = hint(library_for(None, d, 4, smooth.points)[0], smooth, data, **known)
    assert said in str(found)
    one = data.subset([0])
    assert "driven" not in str(hint(library_for(None, d, 4, one.smooth.points)[0], one.smooth, data, **known))


def test_columns_in_the_wrong_order_are_told_before_any_other_model():
    data = Trajectories.read(in_pairs(runs(henon_heiles, 2, n=5, width=0.3, span=4.0, points=21)))
    search = Search(data, data.folds(), constraints_of(data, None, None, False, None, None), Setting(), 0)
    search.run([*FAMILIES], Session())
    assert len(search.history) == 1
    assert search.reading is not None
    (freedom,) = search.tested
    assert freedom.share < 0.1
    assert freedom.defect > 0.1
    assert freedom.rate == pytest.approx(0, abs=1e-10)  # the order of coordinates changes no volume
    with pytest.warns(UserWarning, match=r'No symplectic map explains.*pass order="pairs"'):
        search.diagnose(Session())


@pytest.mark.parametrize("force", [friction, frictions])
def test_drag_is_told_from_friction_that_was_learned(force):
    """Drag in the place of friction explains more of quadratic drag, with as many numbers."""
    data = Trajectories.read(runs(dragged, 1, span=8.0, points=81))
    model = replace(candidates(data)[2], force=force)
    best, reading, _ = best_by_increments(*data.split(), [model])
    assert best == 0
    assert reading.cause is Cause.DRAG
    assert reading.factors(reading.theta) == pytest.approx([0.2], rel=0.05)
    assert not forced(replace(model, force=drags))


def test_friction_of_one_percent_is_named():
    """It leaves more than half of the squares of a model without it, for most of them are noise."""
    data = Trajectories.read(
        runs(lambda t, y: [y[1], -np.sin(y[0]) - 0.01 * y[1]], 1, span=24.0, points=41, noise=0.02)
    )
    search = Search(data, [data.split(0.2, 0)], constraints_of(data, None, None, False, 2 * np.pi, None), Setting(), 0)
    search.run(["waves"], Session())
    with pytest.warns(UserWarning, match=r"There is friction, γ = 0\.01\d*: .* Pass damping=True"):
        search.diagnose(Session())
    assert search.tested[0].rate == pytest.approx(-0.01, rel=0.2)


def test_the_plainest_model_stands_for_those_that_are_as_good():
    data = Trajectories.read(runs(dragged, 1, span=8.0, points=81))
    models = candidates(data)
    best, _, squares = best_by_increments(*data.split(), models)
    alike = [k for k in squares if squares[k] <= ALIKE * min(squares.values())]
    assert len(alike) > 1
    assert models[best].n == min(models[k].n for k in alike)
