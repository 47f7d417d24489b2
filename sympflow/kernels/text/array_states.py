"""States as arrays, changed in place: systems given by Numba functions, of many terms, or of any size.

Source text, pasted after ``size(x, copies)``, the degrees of freedom by an array x of so many vectors, and
``size_of(table)``; before `running_states`, with which it is shared by systems.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def unpack(y):
    d = size(y, 2)
    q, p = np.empty(d), np.empty(d)
    for i in range(d):
        q[i], p[i] = y[i], y[d + i]
    return q, p


@njit(**OPTIONS)
def pack(q, p, y):
    d = size(y, 2)
    for i in range(d):
        y[i], y[d + i] = q[i], p[i]


@njit(**OPTIONS)
def copy(x):
    duplicate = np.empty(size(x, 1))
    for i in range(size(x, 1)):
        duplicate[i] = x[i]
    return duplicate


@njit(**OPTIONS)
def is_finite(q, p):
    total = 0.0
    for i in range(size(q, 1)):
        total += 0.0 * q[i] + 0.0 * p[i]
    return total == 0.0


@njit(**OPTIONS)
def no_error(x):
    return np.zeros(size(x, 1))


@njit(**OPTIONS)
def move(x, error, change):
    """x + change; if `COMPENSATED` by Kahan's compensated sum."""
    for i in range(size(x, 1)):
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
    d = size_of(table)
    return np.empty(d), np.empty(d), np.empty(d), np.empty(d), table


@njit(**OPTIONS)
def forget(x):
    """NaN: what a user's function does not write then ends the run."""
    for i in range(size(x, 1)):
        x[i] = np.nan
