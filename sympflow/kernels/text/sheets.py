"""The stages of splitting methods on sheets, in vector registers. Source text, pasted as `lattice`, after `segments`.

Each row of a sheet is one of the text `segments`; there are `BEYOND` of them more before the first and behind the last.
The neighbours of `VECTOR` sites in the rows beside theirs are `VECTOR` numbers too. What a row needs of those before is
kept in vectors of the length of a row, which stay in the cache: a state passes through memory once in a stage, with a
force gradient too.

Large sheets are executed in tiles, as `lattice` says. What must not act beyond walls is left out.
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
def work_of(sites, first, n_rows, low_end, high_end, geometry):
    """What `stages` of so many rows need beside the state, the first of these being row `first` of X.

    Where there are bonds along a row, and rows, as `mark_there` says; parameters; and vectors of the length of a row.
    """
    n, stride = geometry[0], geometry[1]
    there, rows = aligned_zeros(width_of(n)), np.zeros(n_rows + 2 * BEYOND)
    if not ROW_PERIODIC:
        mark_there(there, GHOSTS * VECTOR, n, True, True, ROW_FREE)
    if not PERIODIC:
        last = n_rows - 1 if FREE else n_rows
        for i in range(-BEYOND, n_rows + BEYOND):
            rows[i + BEYOND] = 1.0 if (i >= 0 or not low_end) and (i < last or not high_end) else 0.0
    found = aligned_zeros(len(sites) * size_of(n_rows, n)).reshape((len(sites), size_of(n_rows, n)))
    if ARRAYS:
        for k in range(len(sites)):
            for i in range(-BEYOND, n_rows + BEYOND):
                row = min(max(first + i, 0), sites.shape[1] // stride - 1)
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
def workspace(size, geometry, sites):
    return work_of(sites, geometry[4], geometry[5], True, True, geometry)


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


@njit(**OPTIONS)
def wrap_ends(X, geometry):
    """The rows before and behind a ring of them, the whole margin of them."""
    if PERIODIC:
        stride, margin, n_rows = geometry[1], geometry[4], geometry[5]
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                x = X[s, f]
                for j in range(margin * stride):
                    x[j], x[(margin + n_rows) * stride + j] = x[n_rows * stride + j], x[margin * stride + j]


@njit(**OPTIONS)
def sweep(X, to, table, j, n_stages, single, planes, first, last, geometry, sites, values):
    """`n_stages` stages of the tiles first … last of a state X, `planes` rows of them each, into the state `to`.

    From column j of a run on, or of a `single` map. The margins of X are wrapped; X and `to` are as `lattice` says.
    """
    n, stride, margin, n_rows = geometry[0], geometry[1], geometry[4], geometry[5]
    for tile in range(first, last):
        low = tile * planes
        high = min(low + planes, n_rows)
        begin, end = low - margin, high + margin
        if not PERIODIC:
            begin, end = max(begin, 0), min(end, n_rows)
        work = work_of(sites, margin + begin, end - begin, begin == 0, end == n_rows, geometry)
        local = zero_state(N_SETS, size_of(end - begin, n))
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                for i in range(begin, end):
                    to_lanes(X[s, f], (margin + i) * stride + GHOSTS, local[s, f], start_of(i - begin, n), n)
        stages(local, table, j, n_stages, single, work, end - begin, n, False, values)
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                for i in range(low, high):
                    x, place = local[s, f], (margin + i) * stride + GHOSTS
                    from_lanes(x, start_of(i - begin, n), n, 0, n, to[s, f], place)
