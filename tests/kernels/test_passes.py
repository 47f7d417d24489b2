"""Compiled passes over rows of states: products with a matrix, and boxes; for sublevels see the tests of domains."""

import numpy as np
import pytest

from sympflow import Box, HamiltonianSystem
from sympflow.kernels.parts_loops import row_products
from sympflow.kernels.passes import all_within


@pytest.mark.parametrize("shape", [(7,), (1, 7), (64, 7), (3, 5, 7)])
def test_products_with_a_matrix_do_not_depend_on_how_many_there_are(shape):
    rng = np.random.default_rng(1)
    A, x = rng.standard_normal((7, 7)), rng.standard_normal(shape)
    products = row_products(A, x)
    assert np.abs(products - x @ A.T).max() <= 7 * np.finfo(float).eps * np.abs(A).sum(1).max() * np.abs(x).max()
    for row, product in zip(x.reshape(-1, 7), products.reshape(-1, 7), strict=True):
        assert np.array_equal(row_products(A, row), product)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 2.5])
@pytest.mark.parametrize("where", [(0, 0), (16, 1), (100, 1)])
def test_one_state_that_is_out_of_a_box_is_found(value, where):
    system, box = HamiltonianSystem.from_sympy("(p1**2 + q1**2)/2"), Box([-1.0, -1.0], [1.0, 1.0])
    x = np.random.default_rng(0).uniform(-1, 1, (101, 2))
    assert all_within(system, box, x, 0.0)
    assert all_within(system, box, x[::3], 0.0)
    x[where] = value
    assert not all_within(system, box, x, 0.0)
