"""Bodies sorted into cells, so that those within the cut-off of one are in the cells around its own.

Source text for `pairs`. `DIM` is the number of coordinates, and `PERIODIC` True if there is a box. Cells have three
axes, with one cell along those that bodies do not have.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit


@njit(**OPTIONS)
def sorted_cells(x, values, order):
    """Sort the bodies by their cells; the place of the first of each, and the cells along each axis; none if few."""
    n = len(order)
    shape, nothing = np.ones(3, dtype=np.int64), np.empty(0, dtype=np.int64)
    low, size = np.zeros(3), np.ones(3)
    length = math.sqrt(values[1] - values[0])
    for k in range(DIM):
        if PERIODIC:
            low[k], extent = 0.0, values[2 + k]
        else:
            low[k] = high = x[k, 0]
            for i in range(n):
                low[k], high = min(low[k], x[k, i]), max(high, x[k, i])
            extent = high - low[k]
        if not extent < math.inf:
            return nothing, shape
        most = int(2.0 * n ** (1.0 / DIM)) + 1  # no more cells than pay
        shape[k] = max(1, min(most, int(min(extent / length, 1e6))))
        size[k] = extent / shape[k]
        if PERIODIC and shape[k] < 3:
            return nothing, shape
    cells, starts = np.empty(n, dtype=np.int64), np.zeros(shape[0] * shape[1] * shape[2] + 1, dtype=np.int64)
    for i in range(n):
        cell, stride = 0, 1
        for k in range(DIM):
            place = x[k, i] - low[k]
            if PERIODIC:
                place -= values[2 + k] * math.floor(place / values[2 + k])
            if not abs(place) < math.inf:
                return nothing, shape
            cell += stride * (min(shape[k] - 1, int(place / size[k])) if size[k] > 0.0 else 0)
            stride *= shape[k]
        cells[i] = cell
        starts[cell + 1] += 1
    for cell in range(len(starts) - 1):
        starts[cell + 1] += starts[cell]
    places = starts.copy()
    for i in range(n):
        order[places[cells[i]]] = i
        places[cells[i]] += 1
    return starts, shape


@njit(**OPTIONS)
def rows_around(cell, i, starts, shape, rows):
    """The ranges [first, last) of the bodies that the body at place i of a cell meets: each pair of bodies once."""
    x, y, z = cell % shape[0], cell // shape[0] % shape[1], cell // (shape[0] * shape[1])
    found = 0
    for k in range(5):  # its own row of cells, and half of the rows around it
        dy = (0, 1, -1, 0, 1)[k]
        dz = (0, 0, 1, 1, 1)[k]
        row_y, row_z = y + dy, z + dz
        if PERIODIC:
            row_y, row_z = row_y % shape[1], row_z % shape[2]
        if (k > 0 and DIM < 2) or (dz > 0 and DIM < 3):
            continue
        if row_y < 0 or row_y >= shape[1] or row_z >= shape[2]:
            continue
        row = shape[0] * (row_y + shape[1] * row_z)
        begin, end = (x if k == 0 else x - 1), x + 1
        first = i + 1 if k == 0 else starts[row + max(begin, 0)]
        rows[2 * found], rows[2 * found + 1] = first, starts[row + min(end, shape[0] - 1) + 1]
        found += 1
        if PERIODIC and begin < 0:
            rows[2 * found], rows[2 * found + 1] = starts[row + shape[0] - 1], starts[row + shape[0]]
            found += 1
        if PERIODIC and end >= shape[0]:
            rows[2 * found], rows[2 * found + 1] = starts[row], starts[row + 1]
            found += 1
    return found


@njit(**OPTIONS)
def met_by(i, cell, starts, shape, rows, n_rows):
    """The number of ranges that the body at place i meets, and its cell; without cells all bodies after it."""
    if len(starts) == 0:
        return n_rows, cell
    while i >= starts[cell + 1]:
        cell += 1
    return rows_around(cell, i, starts, shape, rows), cell
