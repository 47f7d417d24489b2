"""The stages of splitting methods on lattices of any size. Source text, pasted after ``stages`` and `sized_states`.

A state is an array X (sets, fields, size) of that text, each field of the lattice's shape with `REACH` ghost sites at
both ends of every axis but the first, and more at those of the first axis. A pass runs over the planes lo … hi of the
first axis and never beyond the lattice, begin … end. Before a pass the ghosts are refreshed: where an axis is periodic
they are copies of sites, at walls they stay 0.

A large lattice is executed in tiles, slabs of planes that fit into the cache: each is loaded with a margin of planes at
both ends, several stages are made in place, of which each loses `REACH` planes of the margin or more, and what is left
is stored. So a state passes through memory once in many stages, tiles are independent, and what is computed of a site
does not depend on the threads. The tiles are those of the lattice alone.

``stages(X, table, j, n_stages, single, work, whole, lo, hi, begin, end, geometry, sites, offset, values)`` makes so
many stages from column j on, of a run or a `single` map, in place, and returns the column after them. It is written by
`sympflow.kernels.lattice_loops`, with the constants.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit, types
from numba.extending import intrinsic


def apart(builder, access, k):
    """Say of a load or a store that it is one of vector k, which shares no memory with the others."""
    module = builder.module
    scopes = [module.add_metadata([f"vector {i}", module.add_metadata(["lattice"])]) for i in range(N_VECTORS)]
    access.set_metadata("alias.scope", module.add_metadata([scopes[k]]))
    access.set_metadata("noalias", module.add_metadata(scopes[:k] + scopes[k + 1 :]))
    return access


@intrinsic(prefer_literal=True)
def element(typing_context, k, x, i):
    """x[i] of vector number k, in loops that are to become vector instructions."""

    def generate(context, builder, signature, arguments):
        place = builder.gep(context.make_array(x)(context, builder, arguments[1]).data, [arguments[2]])
        return apart(builder, builder.load(place, align=8), k.literal_value)

    return types.float64(k, x, i), generate


@intrinsic(prefer_literal=True)
def set_element(typing_context, k, x, i, value):
    """x[i] = value, of the same."""

    def generate(context, builder, signature, arguments):
        place = builder.gep(context.make_array(x)(context, builder, arguments[1]).data, [arguments[2]])
        apart(builder, builder.store(arguments[3], place, align=8), k.literal_value)
        return context.get_dummy_value()

    return types.void(k, x, i, types.float64), generate


@njit(**OPTIONS, forceinline=True)
def refresh_plane(x, s, f, plane, geometry):
    """The ghosts of a plane on the axes after the first."""
    n_last, stride, row, n_rows = geometry[0], geometry[1], geometry[2], geometry[3]
    if N_AXES > 1 and PERIODIC[-1]:
        for k in range(n_rows):
            start = plane * stride + (k + REACH) * row if N_AXES > 2 else plane * stride
            for j in range(REACH):
                x[s, f, start + j] = x[s, f, start + n_last + j]
                x[s, f, start + REACH + n_last + j] = x[s, f, start + REACH + j]
    if N_AXES > 2 and PERIODIC[min(1, N_AXES - 1)]:
        start, width = plane * stride, REACH * row
        for j in range(width):
            x[s, f, start + j] = x[s, f, start + n_rows * row + j]
            x[s, f, start + width + n_rows * row + j] = x[s, f, start + width + j]


@njit(**OPTIONS, forceinline=True)
def refresh(x, s, lo, hi, begin, end, whole, geometry):
    """The ghosts of the fields of set s of x, for a pass over the planes lo … hi; `whole` at the ends too."""
    for f in range(N_FIELDS):
        if N_AXES > 1:
            for plane in range(lo, hi):
                refresh_plane(x, s, f, plane, geometry)
        if PERIODIC[0] and whole:
            stride = geometry[1]
            width, n = REACH * stride, (end - begin) * stride
            before = begin * stride - width
            for j in range(width):
                x[s, f, before + j] = x[s, f, before + n + j]
                x[s, f, before + width + n + j] = x[s, f, before + width + j]


@njit(**OPTIONS)
def rows_of(geometry):
    """The planes, the rows of each and the sites of a row; a lattice of one axis is one row."""
    if N_AXES == 1:
        return 1, 1, geometry[5]
    return geometry[5], geometry[3], geometry[0]


@njit(**OPTIONS)
def row_start(i, k, geometry):
    """The place of the first site of row k of plane i."""
    start = (geometry[4] + i) * geometry[1]
    if N_AXES > 1:
        start += REACH
    if N_AXES > 2:
        start += (k + REACH) * geometry[2]
    return start


@njit(**OPTIONS)
def load(y, X, first, geometry):
    """A row [q, p] into two sets of X, the first of which is given."""
    planes, rows, n = rows_of(geometry)
    at = 0
    for s in range(first, first + 2):
        for f in range(N_FIELDS):
            for i in range(planes):
                for k in range(rows):
                    start = row_start(i, k, geometry)
                    a, b = X[s, f, start : start + n], y[at : at + n]
                    for j in range(n):
                        a[j] = b[j]
                    at += n


@njit(**OPTIONS)
def pack(X, first, y, geometry):
    """The inverse of `load`."""
    planes, rows, n = rows_of(geometry)
    at = 0
    for s in range(first, first + 2):
        for f in range(N_FIELDS):
            for i in range(planes):
                for k in range(rows):
                    start = row_start(i, k, geometry)
                    a, b = X[s, f, start : start + n], y[at : at + n]
                    for j in range(n):
                        b[j] = a[j]
                    at += n


@njit(**OPTIONS)
def copy_tile(source, first, target, to, n):
    """n numbers of each field, from one place of a state on to another place of another."""
    for s in range(N_SETS):
        for f in range(N_FIELDS):
            a, b = source[s, f, first : first + n], target[s, f, to : to + n]
            for i in range(n):
                b[i] = a[i]


@njit(**OPTIONS)
def row_size(size, geometry):
    return size if N_AXES == 1 else geometry[0]


@njit(**OPTIONS)
def workspace(size, geometry, sites):
    row = row_size(size, geometry)
    C = aligned_zeros(N_CURVATURES * size).reshape((N_CURVATURES, size))
    return zero_state(N_HELPERS, size), np.empty((N_BONDS, row + 2 * REACH)), C


@njit(**OPTIONS)
def in_one(X, table, j, n_stages, single, work, geometry, sites, values):
    """`stages` of a lattice in one piece."""
    begin = geometry[4]
    end = begin + geometry[5]
    return stages(X, table, j, n_stages, single, work, True, begin, end, begin, end, geometry, sites, 0, values)


@njit(**OPTIONS)
def wrap_ends(X, geometry):
    """The planes before and behind a periodic lattice, the whole margin of them."""
    if PERIODIC[0]:
        stride, margin, n_planes = geometry[1], geometry[4], geometry[5]
        copy_tile(X, n_planes * stride, X, 0, margin * stride)
        copy_tile(X, margin * stride, X, (margin + n_planes) * stride, margin * stride)


@njit(**OPTIONS)
def sweep(X, to, table, j, n_stages, single, planes, first, last, geometry, sites, values):
    """`n_stages` stages of the tiles first … last of a state X, `planes` of them each, into the state `to`.

    From column j of a run on, or of a `single` map. The margins of X are wrapped.
    """
    stride, margin, n_planes = geometry[1], geometry[4], geometry[5]
    size = (planes + 2 * margin) * stride
    work, local = workspace(size, geometry, sites), zero_running(size)
    for tile in range(first, last):
        low = tile * planes
        n = min(planes, n_planes - low)
        copy_tile(X, low * stride, local, 0, (n + 2 * margin) * stride)
        begin, end = -size, 2 * size
        if not PERIODIC[0]:
            begin, end = margin - low, margin - low + n_planes
            for vector in work[0]:  # at a wall they are 0, where another tile had sites
                vector[:, max(end, 0) * stride :] = 0.0
        hi, offset = n + 2 * margin, low * stride
        stages(local, table, j, n_stages, single, work, False, 0, hi, begin, end, geometry, sites, offset, values)
        copy_tile(local, margin * stride, to, (low + margin) * stride, n * stride)
