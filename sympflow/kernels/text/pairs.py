"""The stages of splitting methods on bodies that interact in pairs.

Source text, pasted after `sized_states`, `barrier` and sums.

A state is an array X (sets, `DIM`, size) of that text, the coordinates of all bodies in rows. `sites` has `DIM` rows of
1/m, then what else a pair depends on; `values` are ε², the largest s, the box and the parameters; `geometry` the number
of bodies, and that of the chunks in which sums are taken, 0 for few bodies.

A kick is a few phases. In each a sum over pairs is taken, moves the momenta, and may be kept, times 1/m, as a velocity
for the sums that follow. The sums are ``gradient``, ``hessian_vector`` and ``bend``, written by
`sympflow.kernels.pair_forces` from the text `pair_sums`. Those over many bodies are taken in chunks, each by itself,
and added up in the order of these: so threads may share them, and the result does not depend on the threads.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

# Of each phase: its sum, the row of a table with its factor, the sign of that, the velocity in the sum, and where the
# sum is kept as a velocity, 0 for nowhere. A plain kick, one with a force gradient, and one with curvature terms.
SUMS = (0, 0, 1, 0, 1, 2, 1)
ROWS = (1, 1, 2, 1, 2, 3, 3)
SIGNS = (-1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0)
ALONG = (0, 0, 1, 0, 1, 1, 2)
KEPT = (0, 1, 0, 1, 2, 0, 0)


@njit(**OPTIONS)
def phases_of(table, column):
    """The first phase of the kick of a stage, and the one after its last."""
    if HAS_CURVATURE and table[3, column] != 0.0:
        return 3, 7
    if HAS_GRADIENT and table[2, column] != 0.0:
        return 1, 3
    if table[1, column] != 0.0:
        return 0, 1
    return 0, 0


@njit(**OPTIONS)
def load(y, X, first, geometry):
    """A row [q, p] into two sets of X, the first of which is given."""
    n = geometry[0]
    for s in range(2):
        for i in range(n):
            for k in range(DIM):
                X[first + s, k, i] = y[(s * n + i) * DIM + k]


@njit(**OPTIONS)
def pack(X, first, y, geometry):
    """The inverse of `load`."""
    n = geometry[0]
    for s in range(2):
        for i in range(n):
            for k in range(DIM):
                y[(s * n + i) * DIM + k] = X[first + s, k, i]


@njit(**OPTIONS)
def room(F, meeting, size, geometry):
    """Sums and velocities; the sums of chunks; bodies in blocks, their order, and a sum in that; where threads meet."""
    blocks = size if geometry[1] > 0 else 0
    A, P, total = np.zeros((N_HELPERS, DIM, size)), np.zeros(WIDTH * blocks), np.zeros(DIM * blocks)
    return A, F, P, np.arange(geometry[0]), total, meeting


@njit(**OPTIONS)
def workspace(size, geometry, sites):
    """The same of one thread."""
    return room(np.zeros((1, geometry[1], DIM * size)), np.zeros(3, dtype=np.int64), size, geometry)


@njit(**OPTIONS)
def chunk_begin(chunk, n, n_chunks, in_cells):
    """The first place of a chunk; of all pairs, the places are those of two bodies each."""
    return (n if in_cells else (n + 1) // 2) * chunk // n_chunks


@njit(**OPTIONS)
def fill_rows(P, row, n_rows, source, first, order):
    """Rows of the blocks, by rows of an array from `first` on."""
    for k in range(n_rows):
        if not CUT:  # in the order that they have
            for block in range(source.shape[1] // LANES):
                for lane in range(LANES):
                    P[(block * WIDTH + row + k) * LANES + lane] = source[first + k, block * LANES + lane]
            continue
        for i in range(len(order)):
            P[(i // LANES * WIDTH + row + k) * LANES + i % LANES] = source[first + k, order[i]]


@njit(**OPTIONS)
def fill_blocks(phase, first, X, work, starts, shape, sites, values):
    """Put the bodies into blocks, once in a kick, and the velocity of a phase; returns what `sorted_cells` does."""
    A, P, order = work[0], work[2], work[3]
    if phase == first:
        if CUT:
            starts, shape = sorted_cells(X[0], values, order)
        fill_rows(P, 0, DIM, X[0], 0, order)
        fill_rows(P, DIM, COLUMNS, sites, DIM, order)
    if HAS_GRADIENT and ALONG[phase] > 0:
        fill_rows(P, DIM + COLUMNS, DIM, A[ALONG[phase]], 0, order)
    return starts, shape


@njit(**OPTIONS)
def sum_chunk(kind, chunk, F, P, starts, shape, geometry, values):
    """The part of a chunk in a sum."""
    if kind == 0:
        gradient_of_chunk(chunk, P, F, starts, shape, values, geometry)
    if HAS_GRADIENT and kind == 1:
        hessian_vector_of_chunk(chunk, P, F, starts, shape, values, geometry)
    if HAS_CURVATURE and kind == 2:
        bend_of_chunk(chunk, P, F, starts, shape, values, geometry)


@njit(**OPTIONS)
def sum_of_few(kind, X, along, work, geometry, sites, values):
    n, A = geometry[0], work[0]
    if kind == 0:
        gradient_of_few(n, X, A, along, sites, values)
    if HAS_GRADIENT and kind == 1:
        hessian_vector_of_few(n, X, A, along, sites, values)
    if HAS_CURVATURE and kind == 2:
        bend_of_few(n, X, A, along, sites, values)


@njit(**OPTIONS)
def sum_of_chunks(F, work):
    """Add the sums of chunks up, in the order of the bodies."""
    A, order, total = work[0], work[3], work[4]
    for k in range(len(total)):
        total[k] = F[0, k]
    for chunk in range(1, F.shape[0]):
        for k in range(len(total)):
            total[k] += F[chunk, k]
    for k in range(DIM):
        if not CUT:
            for block in range(A.shape[2] // LANES):
                for lane in range(LANES):
                    A[0, k, block * LANES + lane] = total[(block * DIM + k) * LANES + lane]
            continue
        for i in range(len(order)):
            A[0, k, order[i]] = total[(i // LANES * DIM + k) * LANES + i % LANES]


@njit(**OPTIONS, forceinline=True)
def add(X, s, k, i, change):
    """Add a change to number i of a row of q or p."""
    if COMPENSATED:
        corrected = change - X[2 + s, k, i]
        total = X[s, k, i] + corrected
        X[2 + s, k, i] = (total - X[s, k, i]) - corrected
        X[s, k, i] = total
    else:
        X[s, k, i] += change


@njit(**OPTIONS)
def kick(X, table, column, phase, work, sites):
    """The kick after the sums of a phase."""
    A, factor, kept = work[0], SIGNS[phase] * table[ROWS[phase], column], KEPT[phase]
    for k in range(DIM):
        for i in range(np.uint64(X.shape[2])):
            add(X, 1, k, i, factor * A[0, k, i])
    if HAS_GRADIENT and kept > 0:
        for k in range(DIM):
            for i in range(np.uint64(X.shape[2])):
                A[kept, k, i] = sites[k, i] * A[0, k, i]


@njit(**OPTIONS)
def drift(X, table, column, sites):
    a = table[DRIFT, column]
    for k in range(DIM):
        for i in range(np.uint64(X.shape[2])):
            add(X, 0, k, i, a * (sites[k, i] * X[1, k, i]))
            if DAMPED:
                X[1, k, i] *= table[DRIFT + 1, column]


@njit(**OPTIONS)
def stages(member, members, X, table, column, n_stages, single, work, geometry, sites, values):
    """Stages by one of so many threads, each of which has all bodies, and makes its part of the chunks of each sum.

    All else each of them does as well, so that they meet once in a sum. Others may still add up the sums of chunks when
    one begins the next: it has other room for these.
    """
    link, n_chunks, sums, turn = table.shape[1] - 2, geometry[1], work[1], 0
    starts, shape = np.empty(0, dtype=np.int64), np.ones(3, dtype=np.int64)
    for _ in range(n_stages):
        first, last = phases_of(table, column)
        for phase in range(first, last):
            if n_chunks == 0:
                sum_of_few(SUMS[phase], X, ALONG[phase], work, geometry, sites, values)
            else:
                starts, shape = fill_blocks(phase, first, X, work, starts, shape, sites, values)
                turn = (turn + 1) % sums.shape[0]
                for chunk in range(n_chunks * member // members, n_chunks * (member + 1) // members):
                    sum_chunk(SUMS[phase], chunk, sums[turn], work[2], starts, shape, geometry, values)
                if not meet(work[5], members):
                    return column
                sum_of_chunks(sums[turn], work)
            kick(X, table, column, phase, work, sites)
        drift(X, table, column, sites)
        column = column + 1 if single or column < link else 1
    return column


@njit(**OPTIONS)
def in_one(X, table, column, n_stages, single, work, geometry, sites, values):
    return stages(ZERO, ONE, X, table, column, n_stages, single, work, geometry, sites, values)


@njit(**OPTIONS)
def in_team(member, members, sums, meeting, X, table, column, n_stages, single, geometry, size, sites, values):
    """The same by one of so many threads."""
    work = room(sums, meeting, size, geometry)
    return stages(member, members, X, table, column, n_stages, single, work, geometry, sites, values)


@njit(**OPTIONS)
def loaded(y, X, first, geometry):
    load(y, X, first, geometry)


@njit(**OPTIONS)
def packed(X, first, y, geometry):
    pack(X, first, y, geometry)
