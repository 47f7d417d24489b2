"""Sums over pairs of bodies: the text of one kind of sum, see `sympflow.kernels.pair_forces`.

Comments alone on their lines stand for code that depends on the potential, and `SUM` for a name. `x` (DIM, size) are
coordinates, `A[v]` the vector of the sum, of the same shape, `sites` what else a pair depends on; with a cut-off all of
them are in the order of the cells.
"""
# ruff: noqa: B007, F821, F841
# mypy: ignore-errors

import numpy as np
from numba import njit


# ---
@njit(**OPTIONS)
def SUM_with_row(i, first, last, x, A, v, sites, F, mine, values):
    """Add the pairs of the body i with those from `first` to `last` to `F` (DIM, size), in blocks of `LANES`."""
    # numbers
    # own
    for k in range(DIM * LANES):
        mine[k] = 0.0
    for block in range(first // LANES, (last + LANES - 1) // LANES):
        start = np.uint64(block * LANES)
        for lane in range(np.uint64(LANES)):
            j = start + lane
            # other
            # slopes
            inside = (j >= np.uint64(first)) & (j < np.uint64(last))
            if CUT:
                inside &= s < end
            # masked
            # force
            # both lanes
    for k in range(DIM):
        total = 0.0
        for lane in range(LANES):
            total += mine[k * LANES + lane]
        F[k, i] += total


@njit(**OPTIONS)
def SUM_of_few(n, X, A, v, sites, values):
    """The sum over few bodies, which are met one by one, into ``A[0]``."""
    # numbers
    for k in range(DIM):
        for i in range(n):
            A[0, k, i] = 0.0
    for i in range(np.uint64(n)):
        # own of few
        # begin
        for j in range(i + np.uint64(1), np.uint64(n)):
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
def SUM_of_chunk(chunk, x, A, v, sites, F, starts, shape, values, geometry):
    """The part of the sum over many bodies that a chunk of these has, into ``F[chunk]``."""
    n, n_chunks = geometry[0], geometry[1]
    G, mine = F[chunk], np.empty(DIM * LANES)
    for k in range(DIM):
        for i in range(G.shape[1]):
            G[k, i] = 0.0
    rows, n_rows = np.empty(20, dtype=np.int64), 1
    cell = 0
    for i in range(chunk_begin(chunk, n, n_chunks, starts), chunk_begin(chunk + 1, n, n_chunks, starts)):
        rows[0], rows[1] = i + 1, n
        if CUT:
            n_rows, cell = met_by(i, cell, starts, shape, rows, n_rows)
        for k in range(n_rows):
            SUM_with_row(np.uint64(i), rows[2 * k], rows[2 * k + 1], x, A, v, sites, G, mine, values)
