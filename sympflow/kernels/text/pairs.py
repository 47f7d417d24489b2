"""Sums over pairs of bodies: the text of one kind of sum, see `sympflow.kernels.pair_forces`.

Comments alone on their lines stand for code that depends on the potential, and `KIND`, `WIDTH` and `vectors` for names.
A block holds `LANES` bodies, as rows of coordinates and of what else a pair depends on.
"""
# ruff: noqa: B007, F821, F841
# mypy: ignore-errors

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
def KIND_of_few(vectors, out, data):
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
def KIND(vectors, out, data):
    if len(q) < FEW * DIM:
        KIND_of_few(vectors, out, data)
        return
    n = np.uint64(len(q) // DIM)
    n_blocks = (len(q) // DIM + LANES - 1) // LANES
    X, F, mine = np.zeros(n_blocks * WIDTH * LANES), np.zeros(n_blocks * DIM * LANES), np.empty(DIM * LANES)
    order = np.arange(len(q) // DIM)
    if CUT:
        starts, shape = sorted_cells(q, data, order)
    for place in range(n):
        j = np.uint64(order[place])
        at = place // np.uint64(LANES) * np.uint64(WIDTH * LANES) + place % np.uint64(LANES)
        # packed
    rows, n_rows, cell = np.empty(20, dtype=np.int64), 1, 0
    for i in range(len(order)):
        rows[0], rows[1] = i + 1, len(order)
        if CUT:
            n_rows, cell = met_by(i, cell, starts, shape, rows, n_rows)
        for k in range(n_rows):
            KIND_with_row(i, rows[2 * k], rows[2 * k + 1], X, F, mine, data)
    for place in range(n):
        j = np.uint64(order[place])
        at = place // np.uint64(LANES) * np.uint64(DIM * LANES) + place % np.uint64(LANES)
        for k in range(DIM):
            out[np.uint64(DIM) * j + np.uint64(k)] = F[at + np.uint64(k) * np.uint64(LANES)]
