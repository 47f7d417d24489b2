"""The instants at which methods are compared meet all phases of an oscillation, on the grid of the steps."""

import numpy as np
import pytest

from sympflow import HamiltonianSystem, compare, solve, systems, work_precision
from sympflow.studies.attempts import instants


@pytest.mark.parametrize("span", [(0.0, 100.0), (3.0, -97.0), (0.0, 5069.138371433539), (1e6, 1e6 + 0.37)])
@pytest.mark.parametrize("n", [1, 7, 1000])
@pytest.mark.parametrize("dt", [0.1, 30.0])
def test_they_are_ordered_inside_the_interval_and_end_with_it(span, n, dt):
    t = instants(*span, n, dt)
    assert len(t) == n
    assert t[-1] == span[1]
    steps = np.diff([span[0], *t]) * np.sign(span[1] - span[0])
    assert (steps >= 0).all()
    assert (steps[1:] > 0).all()


def test_a_reference_tells_its_own_times():
    system, t = systems.pendulum(), np.linspace(0, 10, 31)[1:]
    truth = solve(system, "kahan_li8", (0, 10), t_eval=t)
    how = {"t_span": (0, 10), "n_outputs": 30, "repeats": 1}
    of_solution, of_array = (compare(system, ["verlet"], ["error"], reference=r, **how) for r in (truth, truth.y))
    np.testing.assert_array_equal(of_solution.t, t)
    assert of_solution.rows[0].error == of_array.rows[0].error
    with pytest.raises(ValueError, match=r"^`reference` must be at the 20 instants"):
        compare(system, ["verlet"], ["error"], reference=truth, **{**how, "n_outputs": 20})


BONDS = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2 + p3**2)/2 + (q2 - q1)**2/2 + (q3 - q2)**2/2", y0=[0.0, 0.3, 0.0, 0.0, 0.0, 0.0], name="bonds"
)


PERIOD = 2 * np.pi / np.sqrt(3)  # of the mode (1, −2, 1), in which they move


@pytest.mark.parametrize("periods", [100, 101.37])
@pytest.mark.parametrize("n", [100, 1000])
def test_the_largest_error_does_not_depend_on_how_the_interval_fits_the_period(periods, n):
    span = (0.0, periods * PERIOD)
    every = np.abs(solve(BONDS, "verlet", span, dt=0.1, backend="array").energy_error()).max()
    how = {"t_span": span, "n_outputs": n, "repeats": 1, "backend": "array"}
    (row,) = compare(BONDS, ["verlet"], ["energy", "drift"], dt=0.1, **how).rows
    (point,) = work_precision(BONDS, ["verlet"], steps=[0.1], **how).rows
    assert every == pytest.approx((0.1 * np.sqrt(3)) ** 2 / 4, rel=1e-3)  # (hω)²/4
    assert 0.9 * every < row.energy_error <= every
    assert 0.9 * every < point.energy_error <= every
    assert abs(row.energy_drift) < 5 * row.energy_drift_error


def test_an_interval_whose_parts_add_up_to_more_is_compared():
    (row,) = compare(systems.pendulum(), ["verlet"], ["energy"], t_span=(0, 5069.138371433539), repeats=1).rows
    assert row.status == "ok"


def test_they_are_ends_of_steps_where_these_are_short():
    steps = instants(0.0, 100.0, 1000, 0.01) / 0.01
    np.testing.assert_allclose(steps, np.rint(steps), rtol=0, atol=1e-9)
