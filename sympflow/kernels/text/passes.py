"""Passes over the times and the states of outputs. Source text for `outputs`; sums and products are not fused here."""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit


@njit(**OPTIONS)
def place(t, t0, h, rounding, count, remainder, position):
    """`Grid.locate` of ordered times: the distinct counts into `count`, where among them each is, and how many.

    Where all counts are distinct, `position` may be left as it is.
    """
    on_grid = True
    for i in range(len(t)):  # in most runs all are; a loop of vector instructions
        x = (t[i] - t0) / h
        nearest = np.rint(x)
        on_grid &= abs(x - nearest) <= rounding * (abs(nearest) + (abs(t[i]) + abs(t0)) / abs(h))
        count[i], remainder[i] = np.int64(nearest), 0.0
    if on_grid:
        for i in range(1, len(t)):
            on_grid &= count[i] != count[i - 1]
        if on_grid:
            return len(t)
    distinct = 0
    for i in range(len(t)):
        x = (t[i] - t0) / h
        nearest = np.rint(x)
        if abs(x - nearest) <= rounding * (abs(nearest) + (abs(t[i]) + abs(t0)) / abs(h)):
            whole, remainder[i] = np.int64(nearest), 0.0
        else:
            whole = np.int64(math.floor(x))
            remainder[i] = t[i] - (t0 + whole * h)
        if distinct == 0 or whole != count[distinct - 1]:
            count[distinct] = whole
            distinct += 1
        position[i] = distinct - 1
    return distinct


@njit(**OPTIONS)
def row_products(A, x, out):
    """A x of every row of x (N, n), each by the same sums in the same order, however many rows there are."""
    for i in range(x.shape[0]):
        for j in range(A.shape[0]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[j, k] * x[i, k]
            out[i, j] = total


@njit(**OPTIONS)
def all_finite(y):
    finite = True
    for i in range(len(y)):
        finite &= abs(y[i]) < math.inf
    return finite


@njit(**OPTIONS)
def all_between(x, low, high):
    """True if all of x (w, N) lies between `low` and `high`."""
    inside = True
    for j in range(x.shape[0]):
        least, most = low[j], high[j]
        for value in x[j]:
            inside &= (value >= least) & (value <= most)
    return inside
