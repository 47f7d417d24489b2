"""Rows of sites cut into segments that run side by side in vector registers. Source text, for `chains` and `sheets`.

A row of n sites, at least `VECTOR`, is cut into `VECTOR` segments of as many sites. Element ``at + j * VECTOR + lane``
of a vector is that of site ``lane * stride_of(n) + j`` of the row that begins at `at`. So the neighbours of `VECTOR`
sites are `VECTOR` numbers as well. Segments overlap where n is no multiple of `VECTOR`: what two of them hold is
computed twice, with the same bits.

Each segment has `GHOSTS` places before and behind, for copies of sites of the segment beside it. Those of the first and
the last segment are copies from the other end of a ring, or 0 beyond walls.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import njit


@njit(**OPTIONS)
def stride_of(n):
    """The sites from the first of a segment to the first of the next."""
    return n // VECTOR


@njit(**OPTIONS)
def rows_of(n):
    """The sites of a segment of n sites."""
    return n - (VECTOR - 1) * stride_of(n)


@njit(**OPTIONS)
def width_of(n):
    """The numbers of a row of n sites, with ghosts."""
    return (rows_of(n) + 2 * GHOSTS) * VECTOR


@njit(**OPTIONS)
def to_lanes(x, first, to, at, n):
    """n numbers into a row."""
    stride = stride_of(n)
    for j in range(rows_of(n)):
        for lane in range(VECTOR):
            to[at + j * VECTOR + lane] = x[first + lane * stride + j]


@njit(**OPTIONS)
def from_lanes(x, at, n, low, high, to, first):
    """The numbers low … high of a row of n sites."""
    stride, rows = stride_of(n), rows_of(n)
    for lane in range(VECTOR):
        start, its_own = lane * stride, rows if lane == VECTOR - 1 else stride
        for j in range(max(0, low - start), min(its_own, high - start)):
            to[first + start + j - low] = x[at + j * VECTOR + lane]


@njit(**OPTIONS)
def parameters_to_lanes(x, first, to, at, n):
    """The parameters of n sites and of their ghosts into a row."""
    for lane in range(VECTOR):
        for j in range(-GHOSTS, rows_of(n) + GHOSTS):
            site = first + lane * stride_of(n) + j
            to[at + j * VECTOR + lane] = x[min(max(site, 0), len(x) - 1)]


@njit(**OPTIONS)
def mark_there(there, at, n, low_end, high_end, free):
    """A row of 1 where there are sites and 0 beyond the ends of a lattice; if `free`, of bonds to the next sites."""
    first, last = (0, n - 1) if free else (0, n)
    for j in range(-GHOSTS, rows_of(n) + GHOSTS):
        for lane in range(VECTOR):
            site = lane * stride_of(n) + j
            within = (site >= first or not low_end) and (site < last or not high_end)
            there[at + j * VECTOR + lane] = 1.0 if within else 0.0


@njit(**OPTIONS, forceinline=True)
def refresh_row(x, at, n, distance, ring):
    """The ghosts of a row, so many at both ends of each segment."""
    stride, rows, nothing = stride_of(n), rows_of(n), all_lanes(0.0)
    for k in range(1, distance + 1):
        last = lanes_at(x, at + (rows - k) * VECTOR) if ring else nothing
        put_lanes(x, at - k * VECTOR, lanes_behind(lanes_at(x, at + (stride - k) * VECTOR), last))
        first = lanes_at(x, at + (k - 1) * VECTOR) if ring else nothing
        ahead = lanes_at(x, at + (rows - stride + k - 1) * VECTOR)
        put_lanes(x, at + (rows + k - 1) * VECTOR, lanes_ahead(ahead, first))
