"""The instants at which methods are compared meet all phases of an oscillation, on the grid of the steps."""

import numpy as np
import pytest

from sympflow import compare, solve, systems
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
