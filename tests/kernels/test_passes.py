"""Compiled products of rows of states with a matrix; for domains see `tests/hamiltonian/test_domain.py`."""

import numpy as np
import pytest

from sympflow.kernels.passes import row_products


@pytest.mark.parametrize("shape", [(7,), (1, 7), (64, 7), (3, 5, 7)])
def test_products_with_a_matrix_do_not_depend_on_how_many_there_are(shape):
    rng = np.random.default_rng(1)
    A, x = rng.standard_normal((7, 7)), rng.standard_normal(shape)
    products = row_products(A, x)
    assert np.abs(products - x @ A.T).max() <= 7 * np.finfo(float).eps * np.abs(A).sum(1).max() * np.abs(x).max()
    for row, product in zip(x.reshape(-1, 7), products.reshape(-1, 7), strict=True):
        assert np.array_equal(row_products(A, row), product)
