"""Runs in other coordinates, χ ∘ Kⁿ ∘ χ⁻¹. Source text, pasted after `loops`, and after `lanes` where these are.

The tables of χ⁻¹ and χ are those of single maps, see `map_each`, that of K is that of a run.
χ⁻¹ is executed once, and χ for each output.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit


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


@njit(**OPTIONS)
def rollout_processed(before, run, after, y0, n_steps, save, out, stop):
    """`rollout` from `y0` (2d,) in other coordinates, `before` into them and `after` out of them."""
    start = np.empty((1, len(y0)))
    map_rows(before, y0.reshape((1, len(y0))), start)
    n_finite = rollout(run, start[0], n_steps, save, out, stop)
    first = 0
    while first < len(save) and save[first] <= 0:
        q, p = unpack(y0)
        pack(q, p, out[first])
        first += 1
    map_rows(after, out[first:], out[first:])
    return up_to_finite(out, save, n_finite)


@njit(**OPTIONS)
def rollout_processed_rows(before, run, after, y0, n_steps, save, out, n_finite, stop):
    """The same of every row of `y0` (N, 2d)."""
    start = np.empty(y0.shape)
    map_rows(before, y0, start)
    rollout_rows(run, start, n_steps, save, out, n_finite, stop)
    outputs = out.reshape((-1, y0.shape[1]))
    map_rows(after, outputs, outputs)
    for i in range(len(y0)):
        for row in range(len(save)):
            if save[row] > 0:
                break
            q, p = unpack(y0[i])
            pack(q, p, out[i, row])
        n_finite[i] = up_to_finite(out[i], save, n_finite[i])
