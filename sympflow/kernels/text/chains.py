"""The stages of splitting methods on chains, in vector registers. Source text, pasted as `lattice` is, after `vectors`.

A chain is cut into `VECTOR` segments of as many sites, which run side by side: element ``(row + GHOSTS) * VECTOR +
lane`` of a vector is that of site ``start_of(lane) + row``. So the neighbours of `VECTOR` sites are `VECTOR` numbers
as well, and what neighbours need stays in registers from row to row: a state passes through memory once in a stage,
with a force gradient too. Segments overlap where their sum is not the number of sites. What two of them hold is
computed twice, with the same bits.

Each segment has `GHOSTS` rows before and behind. `COPIED` of them are copies from the segment beside it or from the
other end of a ring. Beyond walls they are 0, and what must not act there is left out.

Large chains are executed in tiles, as `lattice` says.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def rows_of(n):
    """The sites of a segment of n sites."""
    return (n + VECTOR - 1) // VECTOR


@njit(**OPTIONS)
def start_of(lane, n):
    """The first site of a segment."""
    return lane * (n - rows_of(n)) // (VECTOR - 1)


@njit(**OPTIONS)
def place_of(site, n):
    """Where a site is."""
    lane = VECTOR - 1
    while start_of(lane, n) > site:
        lane -= 1
    return (site - start_of(lane, n) + GHOSTS) * VECTOR + lane


@njit(**OPTIONS)
def width_of(n):
    """The numbers of a vector of n sites."""
    return (rows_of(n) + 2 * GHOSTS) * VECTOR


@njit(**OPTIONS)
def segments_of(n, low_end, high_end, whole):
    """The ghosts of n sites and what they are copies of, and which sites there are.

    `low_end` and `high_end` say whether the chain ends there. The ghosts are rows (place, source), those next to the
    segments first, and the number of these. Sites that there are have a 1, those beyond an end a 0; where ends are
    free, it is the bonds from each site to the next.
    """
    rows, n_ghosts, nearest = rows_of(n), 0, 0
    ghosts, there = np.empty((2 * GHOSTS * VECTOR, 2), dtype=np.int64), aligned_zeros(width_of(n))
    first, last = (0, n - 1) if FREE else (0, n)
    for row in range(-GHOSTS, rows + GHOSTS):
        for lane in range(VECTOR):
            site = start_of(lane, n) + row
            within = (site >= first or not low_end) and (site < last or not high_end)
            there[(row + GHOSTS) * VECTOR + lane] = 1.0 if within else 0.0
    for distance in range(1, COPIED + 1):
        for row in (-distance, rows - 1 + distance):
            for lane in range(VECTOR):
                site = start_of(lane, n) + row
                if PERIODIC and whole:
                    site = site % n
                if 0 <= site < n:
                    ghosts[n_ghosts, 0] = (row + GHOSTS) * VECTOR + lane
                    ghosts[n_ghosts, 1] = place_of(site, n)
                    n_ghosts += 1
        if distance == 1:
            nearest = n_ghosts
    return ghosts[:n_ghosts], nearest, there


@njit(**OPTIONS)
def parameters_of(sites, first, n):
    """The parameters of n sites, the first of which is given, and of their ghosts."""
    found = aligned_zeros(len(sites) * width_of(n)).reshape((len(sites), width_of(n)))
    for lane in range(VECTOR):
        for row in range(-GHOSTS, rows_of(n) + GHOSTS):
            site = min(max(first + start_of(lane, n) + row, 0), sites.shape[1] - 1)
            for i in range(len(sites)):
                found[i, (row + GHOSTS) * VECTOR + lane] = sites[i, site]
    return found


@njit(**OPTIONS)
def load(y, X, first, geometry):
    """A row [q, p] into two sets of X, the first of which is given."""
    n = geometry[5]
    for k in range(2 * N_FIELDS):
        to_lanes(y, k * n, X[first + k // N_FIELDS, k % N_FIELDS], n)


@njit(**OPTIONS)
def pack(X, first, y, geometry):
    """The inverse of `load`."""
    n = geometry[5]
    for k in range(2 * N_FIELDS):
        from_lanes(X[first + k // N_FIELDS, k % N_FIELDS], n, 0, n, y, k * n)


@njit(**OPTIONS)
def to_lanes(x, first, to, n):
    """n numbers into a vector."""
    for lane in range(VECTOR):
        start = first + start_of(lane, n)
        for row in range(rows_of(n)):
            to[(row + GHOSTS) * VECTOR + lane] = x[start + row]


@njit(**OPTIONS)
def from_lanes(x, n, low, high, to, first):
    """The numbers low … high of a vector of n sites."""
    for lane in range(VECTOR):
        start = start_of(lane, n)
        for row in range(max(0, low - start), min(rows_of(n), high - start)):
            to[first + start + row - low] = x[(row + GHOSTS) * VECTOR + lane]


@njit(**OPTIONS)
def workspace(size, geometry, sites):
    n = geometry[5]
    ghosts, nearest, there = segments_of(n, True, True, True)
    return ghosts, nearest, there, parameters_of(sites, geometry[4], n)


@njit(**OPTIONS)
def in_one(X, table, j, n_stages, single, work, geometry, sites, values):
    """`stages` of a chain in one piece."""
    return stages(X, table, j, n_stages, single, work, rows_of(geometry[5]), values)


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
        low_end, high_end = not PERIODIC and begin == 0, not PERIODIC and end == n_sites
        ghosts, nearest, there = segments_of(n, low_end, high_end, False)
        work = ghosts, nearest, there, parameters_of(sites, margin + begin, n)
        local = zero_state(N_SETS, width_of(n))
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                to_lanes(X[s, f], margin + begin, local[s, f], n)
        stages(local, table, j, n_stages, single, work, rows_of(n), values)
        for s in range(N_SETS):
            for f in range(N_FIELDS):
                from_lanes(local[s, f], n, low - begin, high - begin, to[s, f], margin + low)
