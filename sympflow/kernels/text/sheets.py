"""The stages of splitting methods on sheets, in vector registers. Source text, pasted as `lattice`, after `segments`.

Each row of a sheet is one of the text `segments`; there are `BEYOND` of them more before the first and behind the last.
The neighbours of `VECTOR` sites in the rows beside theirs are `VECTOR` numbers too. What a row needs of those before is
kept in vectors of the length of a row, which stay in the cache: a state passes through memory once in a stage, with a
force gradient too.

What must not act beyond walls is left out. Large sheets, which are executed in tiles, are not in registers: to turn a
tile into segments and back takes longer than the stage or two that it makes.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def start_of(i, n):
    """Where row i begins, of n sites."""
    return (i + BEYOND) * width_of(n) + GHOSTS * VECTOR


@njit(**OPTIONS)
def size_of(n_rows, n):
    """The numbers of so many rows, with those beyond."""
    return (n_rows + 2 * BEYOND) * width_of(n)


@njit(**OPTIONS)
def workspace(size, geometry, sites):
    """What `stages` need beside the state.

    Where there are bonds along a row, and rows, as `mark_there` says; parameters; and vectors of the length of a row.
    """
    n, stride, margin, n_rows = geometry[0], geometry[1], geometry[4], geometry[5]
    there, rows = aligned_zeros(width_of(n)), np.zeros(n_rows + 2 * BEYOND)
    if not ROW_PERIODIC:
        mark_there(there, GHOSTS * VECTOR, n, True, True, ROW_FREE)
    if not PERIODIC:
        rows[BEYOND : BEYOND + (n_rows - 1 if FREE else n_rows)] = 1.0
    found = aligned_zeros(len(sites) * size_of(n_rows, n)).reshape((len(sites), size_of(n_rows, n)))
    if ARRAYS:
        for k in range(len(sites)):
            for i in range(-BEYOND, n_rows + BEYOND):
                row = min(max(margin + i, 0), sites.shape[1] // stride - 1)
                parameters_to_lanes(sites[k], row * stride + GHOSTS, found[k], start_of(i, n), n)
    return there, rows, found, zero_state(N_KEPT, width_of(n))


@njit(**OPTIONS)
def load(y, X, first, geometry):
    """A row [q, p] into two sets of X, the first of which is given."""
    n, n_rows = geometry[0], geometry[5]
    for k in range(2 * N_FIELDS):
        for i in range(n_rows):
            to_lanes(y, (k * n_rows + i) * n, X[first + k // N_FIELDS, k % N_FIELDS], start_of(i, n), n)


@njit(**OPTIONS)
def pack(X, first, y, geometry):
    """The inverse of `load`."""
    n, n_rows = geometry[0], geometry[5]
    for k in range(2 * N_FIELDS):
        for i in range(n_rows):
            x = X[first + k // N_FIELDS, k % N_FIELDS]
            from_lanes(x, start_of(i, n), n, 0, n, y, (k * n_rows + i) * n)


@njit(**OPTIONS)
def in_one(X, table, j, n_stages, single, work, geometry, sites, values):
    """`stages` of a sheet in one piece."""
    return stages(X, table, j, n_stages, single, work, geometry[5], geometry[0], PERIODIC, values)


@njit(**OPTIONS, forceinline=True)
def refresh(x, n_rows, n, distance, ring):
    """The ghosts of all rows, and so many rows before and behind a ring of them."""
    width = width_of(n)
    for i in range(n_rows):
        refresh_row(x, start_of(i, n), n, 1, ROW_PERIODIC)
    if ring:
        first, behind = BEYOND * width, (BEYOND + n_rows) * width
        for k in range(1, distance + 1):
            for j in range(0, width, VECTOR):
                put_lanes(x, first - k * width + j, lanes_at(x, behind - k * width + j))
                put_lanes(x, behind + (k - 1) * width + j, lanes_at(x, first + (k - 1) * width + j))
