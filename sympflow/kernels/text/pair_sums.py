"""Sums over pairs of bodies: the text of one kind of sum, see `sympflow.kernels.pair_forces`.

Comments alone on their lines stand for code that depends on the potential, and `SUM` for a name. Many bodies stand in
blocks of `LANES`, as `WIDTH` rows of what a pair depends on; with a cut-off in the order of the cells.
"""
# ruff: noqa: B007, F821, F841
# mypy: ignore-errors

import numpy as np
from numba import njit


# ---
@njit(**OPTIONS)
def SUM_with_row(i, first, last, P, F, mine, values):
    """Add the pairs of the body i with those from `first` to `last` to the blocks `F`."""
    # numbers
    lane = i % LANES
    Pi = P[i // LANES * WIDTH * LANES : (i // LANES + 1) * WIDTH * LANES]
    # own
    for k in range(DIM * LANES):
        mine[k] = 0.0
    for block in range(first // LANES, (last + LANES - 1) // LANES):
        Pj = P[block * WIDTH * LANES : (block + 1) * WIDTH * LANES]
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
def SUM_of_chunk(chunk, P, F, starts, shape, values, geometry):
    """The part of the sum over many bodies that a chunk of these has, into ``F[chunk]``."""
    n, n_chunks = geometry[0], geometry[1]
    G, mine = F[chunk], np.empty(DIM * LANES)
    for k in range(len(G)):
        G[k] = 0.0
    rows, n_rows = np.empty(20, dtype=np.int64), 1
    cell, in_cells = 0, len(starts) > 0
    begin, end = chunk_begin(chunk, n, n_chunks, in_cells), chunk_begin(chunk + 1, n, n_chunks, in_cells)
    for place in range(begin if in_cells else 2 * begin, end if in_cells else 2 * end):
        i = place
        if not in_cells:  # the first body, the last, the second …: each two of them meet as many
            i = n - 1 - place // 2 if place % 2 else place // 2
            if place % 2 and i == place // 2:
                continue
        rows[0], rows[1] = i + 1, n
        if CUT:
            n_rows, cell = met_by(i, cell, starts, shape, rows, n_rows)
        for k in range(n_rows):
            SUM_with_row(i, rows[2 * k], rows[2 * k + 1], P, G, mine, values)
