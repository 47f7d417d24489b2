"""Sums over pairs of bodies: the text of one kind of sum, see `sympflow.kernels.pair_forces`.

Comments alone on their lines stand for code that depends on the potential, and `KIND`, `WIDTH` and `vectors` for names.
A block holds `LANES` bodies, as rows of coordinates and of what else a pair depends on.
"""
# ruff: noqa: F821, F841, N816
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

# ---
@njit(**OPTIONS)
def KIND_with_row(i, first, last, X, F, mine, data):
    """Add the pairs of the body i with those from `first` to `last` to the blocks `F`."""
    # numbers
    lane = i % LANES
    Xi = X[i // LANES * WIDTH * LANES : (i // LANES + 1) * WIDTH * LANES]
    # own
    for k in range(DIM * LANES):
        mine[k] = 0.0
    for block in range(first // LANES, (last + LANES - 1) // LANES):
        Xj = X[block * WIDTH * LANES : (block + 1) * WIDTH * LANES]
        Fj = F[block * DIM * LANES : (block + 1) * DIM * LANES]
        for lane in range(LANES):
            j = block * LANES + lane
            # other
            # slopes
            inside = (j >= first) & (j < last)
            if CUT:
                inside &= s < end
            # masked
            # force
            # both lanes
    Fi = F[i // LANES * DIM * LANES : (i // LANES + 1) * DIM * LANES]
    for k in range(DIM):
        total = 0.0
        for lane in range(LANES):
            total += mine[k * LANES + lane]
        Fi[k * LANES + i % LANES] += total


@njit(**OPTIONS)
def KIND_of_few(vectors, data, out):
    # numbers
    n = np.uint64(len(q) // DIM)
    for k in range(len(q)):
        out[k] = 0.0
    for i in range(n):
        # own of few
        # begin
        for j in range(i + np.uint64(1), n):
            # other of few
            # slopes
            inside = True
            if CUT:
                inside = s < end
            # masked
            # force
            # both
        # end


@njit(**OPTIONS)
def KIND(vectors, data, out):
    if len(q) < FEW * DIM:
        KIND_of_few(vectors, data, out)
        return
    n = np.uint64(len(q) // DIM)
    n_blocks = (len(q) // DIM + LANES - 1) // LANES
    X, F, mine = np.zeros(n_blocks * WIDTH * LANES), np.zeros(n_blocks * DIM * LANES), np.empty(DIM * LANES)
    order, starts, shape = sorted_cells(q, data)
    for place in range(n):
        j = np.uint64(order[place])
        at = place // np.uint64(LANES) * np.uint64(WIDTH * LANES) + place % np.uint64(LANES)
        # packed
    if len(starts) == 0:
        for i in range(len(order)):
            KIND_with_row(i, i + 1, len(order), X, F, mine, data)
    else:
        rows = np.empty(20, dtype=np.int64)
        cell = 0
        for i in range(len(order)):
            while i >= starts[cell + 1]:
                cell += 1
            n_rows = rows_around(cell, i, starts, shape, rows)
            for k in range(n_rows):
                KIND_with_row(i, rows[2 * k], rows[2 * k + 1], X, F, mine, data)
    for place in range(n):
        j = np.uint64(order[place])
        at = place // np.uint64(LANES) * np.uint64(DIM * LANES) + place % np.uint64(LANES)
        for k in range(DIM):
            out[np.uint64(DIM) * j + np.uint64(k)] = F[at + np.uint64(k) * np.uint64(LANES)]
