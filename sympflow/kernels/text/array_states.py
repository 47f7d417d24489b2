"""States as arrays, changed in place: systems given by Numba functions, or of many terms.

Source text, before `running_states`, with which it is shared by systems. The constants `NDOF` and `COMPENSATED` are
known.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def unpack(y):
    q, p = np.empty(NDOF), np.empty(NDOF)
    for i in range(NDOF):
        q[i], p[i] = y[i], y[NDOF + i]
    return q, p


@njit(**OPTIONS)
def pack(q, p, y):
    for i in range(NDOF):
        y[i], y[NDOF + i] = q[i], p[i]


@njit(**OPTIONS)
def copy(x):
    duplicate = np.empty(NDOF)
    for i in range(NDOF):
        duplicate[i] = x[i]
    return duplicate


@njit(**OPTIONS)
def is_finite(q, p):
    total = 0.0
    for i in range(NDOF):
        total += 0.0 * q[i] + 0.0 * p[i]
    return total == 0.0


@njit(**OPTIONS)
def no_error(x):
    return np.zeros(NDOF)


@njit(**OPTIONS)
def move(x, error, change):
    """x + change; if `COMPENSATED` by Kahan's compensated sum."""
    for i in range(NDOF):
        if COMPENSATED:
            corrected = change[i] - error[i]
            total = x[i] + corrected
            error[i] = (total - x[i]) - corrected
            x[i] = total
        else:
            x[i] += change[i]
    return x, error


@njit(**OPTIONS)
def workspace(table):
    return np.empty(NDOF), np.empty(NDOF), np.empty(NDOF), np.empty(NDOF)


@njit(**OPTIONS)
def forget(x):
    """NaN: what a user's function does not write then ends the run."""
    for i in range(NDOF):
        x[i] = np.nan
