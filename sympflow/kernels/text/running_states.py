"""The running state of a run, and its outputs. Source text for `loops`, after the algebra of states.

Nothing in it depends on a system: systems whose states are alike share it, compiled.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

from numba import njit


@njit(**OPTIONS)
def fill_with_nan(rows, first):
    for i in range(first, rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[i, j] = math.nan


@njit(**OPTIONS)
def set_nan(running):
    """Make a running state NaN: as `running[:] = math.nan` that takes three times as long to compile."""
    for i in range(len(running)):
        running[i] = math.nan


@njit(**OPTIONS)
def opened(y0, first, running):
    """The running state after `first` steps, and its errors."""
    q, p = unpack(y0)
    q_error, p_error = no_error(q), no_error(p)
    if first > 0:
        end = len(running) // (1 + COMPENSATED)
        q, p = unpack(running[:end])
        if COMPENSATED:
            q_error, p_error = unpack(running[end:])
    return q, p, q_error, p_error


@njit(**OPTIONS)
def keep(q, p, q_error, p_error, running):
    """Write the running state, if it is asked for."""
    if len(running) > 0:
        end = len(running) // (1 + COMPENSATED)
        pack(q, p, running[:end])
        if COMPENSATED:
            pack(q_error, p_error, running[end:])


@njit(**OPTIONS)
def polynomial(coefficients, x):
    total = 0.0
    for k in range(len(coefficients) - 1, -1, -1):
        total = total * x + coefficients[k]
    return total


@njit(**OPTIONS)
def up_to_finite(out, save, n_finite):
    """Let a run end before an output (n, 2d) that is not finite though the state that it is made of is."""
    finite = True
    flat = out.reshape(-1)
    for i in range(len(flat)):
        finite &= abs(flat[i]) < math.inf
    row = 0
    while not finite and row < len(save) and save[row] <= n_finite:
        finite_row = True
        for j in range(out.shape[1]):
            finite_row &= abs(out[row, j]) < math.inf
        if not finite_row:
            fill_with_nan(out, row)
            return save[row] - 1
        row += 1
    return n_finite
