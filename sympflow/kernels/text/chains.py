"""The stages of splitting methods on chains, in vector registers. Source text, pasted as `lattice`, after `segments`.

A chain is one row of the text `segments`. What neighbours need stays in registers from site to site of the segments: a
state passes through memory once in a stage, with a force gradient too.

Large chains are executed in tiles, as `lattice` says. What must not act beyond walls is left out.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import njit

START = GHOSTS * VECTOR  # of the row


@njit(**OPTIONS)
def work_of(sites, first, n, low_end, high_end):
    """What `stages` of n sites, the first of which is given, need beside the state: see `mark_there`; parameters."""
    there = aligned_zeros(width_of(n))
    if not PERIODIC:
        mark_there(there, START, n, low_end, high_end, FREE)
    found = aligned_zeros(len(sites) * width_of(n)).reshape((len(sites), width_of(n)))
    if ARRAYS:
        for i in range(len(sites)):
            parameters_to_lanes(sites[i], first, found[i], START, n)
    return there, found


@njit(**OPTIONS)
def load(y, X, first, geometry):
    """A row [q, p] into two sets of X, the first of which is given."""
    n = geometry[5]
    for k in range(2 * N_FIELDS):
        to_lanes(y, k * n, X[first + k // N_FIELDS, k % N_FIELDS], START, n)


@njit(**OPTIONS)
def pack(X, first, y, geometry):
    """The inverse of `load`."""
    n = geometry[5]
    for k in range(2 * N_FIELDS):
        from_lanes(X[first + k // N_FIELDS, k % N_FIELDS], START, n, 0, n, y, k * n)


@njit(**OPTIONS)
def workspace(size, geometry, sites):
    return work_of(sites, geometry[4], geometry[5], True, True)


@njit(**OPTIONS)
def in_one(X, table, j, n_stages, single, work, geometry, sites, values):
    """`stages` of a chain in one piece."""
    return stages(X, table, j, n_stages, single, work, geometry[5], PERIODIC, values)


@njit(**OPTIONS)
def wrap_ends(X, geometry):
    """The sites before and behind a ring, the whole margin of them."""
    if PERIODIC:
        margin, n = geometry[4], geometry[5]
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                x = X[s, f]
                for j in range(margin):
                    x[j], x[margin + n + j] = x[n + j], x[margin + j]


@njit(**OPTIONS)
def sweep(X, to, table, j, n_stages, single, planes, first, last, geometry, sites, values):
    """`n_stages` stages of the tiles first … last of a state X, `planes` sites of them each, into the state `to`.

    From column j of a run on, or of a `single` map. The margins of X are wrapped; X and `to` are sites in a row.
    """
    margin, n_sites = geometry[4], geometry[5]
    for tile in range(first, last):
        low = tile * planes
        high = min(low + planes, n_sites)
        begin, end = low - margin, high + margin
        if not PERIODIC:
            begin, end = max(begin, 0), min(end, n_sites)
        n = end - begin
        work = work_of(sites, margin + begin, n, begin == 0, end == n_sites)
        local = zero_running(width_of(n))
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                to_lanes(X[s, f], margin + begin, local[s, f], START, n)
        stages(local, table, j, n_stages, single, work, n, False, values)
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                from_lanes(local[s, f], START, n, low - begin, high - begin, to[s, f], margin + low)
