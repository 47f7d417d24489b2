"""The compiled passes over outputs say what the arrays say."""

import numpy as np
import pytest

from sympflow.integrators.grid import EPS, Grid
from sympflow.kernels.output_loops import all_between, all_finite, place


@pytest.mark.parametrize(("t0", "t1", "dt"), [(0.0, 10.0, 0.1), (3.0, -4.0, 0.3), (1e6, 1e6 + 7.0, 0.7)])
def test_times_are_placed_as_by_arrays(t0, t1, dt):
    """On the grid, an ulp beside it, and between its points, some of them in the same step."""
    grid = Grid(t0, t1, dt)
    on = t0 + np.arange(grid.n_steps + 1) * grid.h
    t = np.sort(np.concatenate([on, np.nextafter(on[1:-1], t1), np.linspace(t0, t1, 57)]))
    t = t if t1 > t0 else t[::-1].copy()
    remainder, count, position = place(t, grid.t0, grid.h, 4 * EPS)
    expected = grid.locate(t, bounded=False)
    assert (np.diff(count) > 0).all()
    assert np.array_equal(count[position], expected[0])
    assert np.array_equal(remainder, expected[1])
    remainder, count, position = place(on, grid.t0, grid.h, 4 * EPS)
    assert np.array_equal(count, np.arange(len(on)))
    assert position is None
    assert not remainder.any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 2.5])
@pytest.mark.parametrize("where", [(0, 0), (2, 16), (1, 100)])
def test_one_number_that_is_out_is_found(value, where):
    x = np.random.default_rng(0).uniform(-1, 1, (3, 101))
    low, high = np.full(3, -1.0), np.array([1.0, 1.0, 1.0])
    assert all_finite(x)
    assert all_finite(x.T)
    assert all_between(x, low, high)
    x[where] = value
    assert all_finite(x) == all_finite(x.T) == np.isfinite(value)
    assert not all_between(x, low, high)
