"""Code that sorts bodies into cells of three axes: those within the cut-off are in the cells around their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sympflow.compiler.control import INT, Code, Value, Variable

__all__ = ["MOST_RANGES", "Cells", "most_along", "most_cells"]

MOST_RANGES = 10
ROWS = ((0, 0), (1, 0), (-1, 1), (0, 1), (1, 1))
"""A cell's own row of cells, along x, and half of the rows around it, by y and z."""
FAR = 1e6
SHAPE, STARTS = 0, 4
"""Places in the memory of cells: how many along each axis and, from there on, the first body of each cell."""


def most_along(n: int, dim: int) -> int:
    """The number of cells along an axis beyond which more do not reduce the time."""
    return int(2.0 * n ** (1.0 / dim)) + 1


def most_cells(n: int, dim: int) -> int:
    """The whole numbers that `Cells` needs memory for."""
    return STARTS + 2 * (most_along(n, dim) ** dim + 1) + n


class Cells:
    """The code of cells in so many dimensions, `periodic` if there is a box."""

    def __init__(self, dim: int, periodic: bool) -> None:
        self.dim, self.periodic = dim, periodic

    def sort(
        self,
        x: Value,
        n: Value,
        size: Value,
        most: Value,
        cutoff: Value,
        box: Sequence[Value],
        order: Value,
        work: Value,
    ) -> None:
        """Write code that sorts bodies (dim, size) by their cells into `order`; one cell where more are of no use."""
        code = x.code
        zero, one = code.constant(0, INT), code.constant(1, INT)
        useful = code.variable(one < most)
        axes: list[tuple[Value, Value, Value]] = []  # the lowest coordinate, the cells and their size
        for k in range(self.dim):
            place = code.at(x, size * k)
            if self.periodic:
                low, extent = code.constant(0.0), box[k]
            else:
                first = code.load(place)

                def further(i: Value, ends: Sequence[Value], place: Value = place) -> list[Value]:
                    x = code.load(place, i)
                    return [_lesser(ends[0], x), -_lesser(-ends[1], -x)]

                low, high = code.loop(n, (first, first), further)
                extent = high - low
            useful.value = useful.value & (extent < float("inf"))
            count = _whole(_lesser(extent / cutoff, code.constant(FAR)))
            count = code.apply("max", (one, code.apply("min", (most, count))))
            if self.periodic:
                useful.value = useful.value & (count > 2)
            axes.append((low, count, extent / code.convert("sitofp", count, "double")))
        starts = code.at(work, STARTS, "i64")
        counts = [code.select(useful.value, count, one) for _, count, _ in axes]
        for k in range(3):
            code.store(counts[k] if k < self.dim else one, work, SHAPE + k)
        total = one
        for count in counts:
            total = total * count
        code.store(code.select(useful.value, total, zero), work, 3)
        places, cells = code.at(starts, total + 1, "i64"), code.at(starts, (total + 1) * 2, "i64")
        with code.over(total + 1) as c:
            code.store(zero, starts, c)
        good = code.variable(useful.value)
        with code.over(n) as i:
            cell, stride = zero, one
            for k, (low, _, side) in enumerate(axes):
                count, at = counts[k], code.load(code.at(x, size * k), i) - low
                if self.periodic:
                    at = at - box[k] * code.apply("floor", (at / box[k],))
                good.value = good.value & (abs(at) < float("inf"))
                step = _whole(code.select(good.value & (side > 0.0), at / side, code.constant(0.0)))
                step = code.apply("max", (zero, code.apply("min", (count - 1, step))))
                cell, stride = cell + stride * step, stride * count
            code.store(cell, cells, i)
            code.store(code.load(starts, cell + 1, INT) + 1, starts, cell + 1)
        code.store(code.select(good.value, total, zero), work, 3)
        code.store(zero, places)
        with code.over(total) as c:
            code.store(code.load(starts, c + 1, INT) + code.load(starts, c, INT), starts, c + 1)
            code.store(code.load(starts, c + 1, INT), places, c + 1)
        with code.over(n) as i:
            cell = code.load(cells, i, INT)
            at = code.load(places, cell, INT)
            code.store(i, order, at)
            code.store(at + 1, places, cell)

    def ranges(self, code: Code, i: Value, n: Value, cell: Variable, work: Value, found: Value) -> Value:
        """Write the ranges [first, last) of the bodies that the one at place i meets, each pair once; how many."""
        one, zero = code.constant(1, INT), code.constant(0, INT)
        starts = code.at(work, STARTS, "i64")
        n_found = code.variable(zero)

        def add(first: Any, last: Value, condition: Value) -> None:
            with code.given(condition):
                code.store(first, found, n_found.value * 2)
                code.store(last, found, n_found.value * 2 + 1)
                n_found.value = n_found.value + 1

        sorted_ = code.load(work, 3, INT) > 1
        add(i + 1, n, ~sorted_)
        with code.given(sorted_):
            nx, ny, nz = (code.load(work, SHAPE + k, INT) for k in range(3))
            with code.during(lambda: i >= code.load(starts, cell.value + 1, INT)):
                cell.value = cell.value + 1
            x, rest = code.op("srem", INT, cell.value, nx), code.op("sdiv", INT, cell.value, nx)
            y, z = code.op("srem", INT, rest, ny), code.op("sdiv", INT, rest, ny)
            for k, (dy, dz) in enumerate(ROWS):
                if (k and self.dim < 2) or (dz and self.dim < 3):
                    continue
                row_y, row_z = y + dy, z + dz
                if self.periodic:
                    row_y, row_z = code.op("srem", INT, row_y + ny, ny), code.op("srem", INT, row_z + nz, nz)
                there = (zero <= row_y) & (row_y < ny) & (row_z < nz)
                row = nx * (row_y + ny * row_z)
                begin, end = (x if k == 0 else x - 1), x + 1
                with code.given(there):
                    first = i + 1 if k == 0 else code.load(starts, row + code.apply("max", (begin, zero)), INT)
                    last = code.load(starts, row + code.apply("min", (end, nx - 1)) + 1, INT)
                    add(first, last, one > zero)
                    if self.periodic:
                        row_ends = (row + nx - 1, row + nx), (row, row + 1)
                        for (a, b), beyond in zip(row_ends, (begin < zero, end >= nx), strict=True):
                            with code.given(beyond):
                                add(code.load(starts, a, INT), code.load(starts, b, INT), one > zero)
        return n_found.value


def _lesser(a: Value, b: Value) -> Value:
    """The smaller of two, NaN if one of them is."""
    code = a.code
    return code.select((a < b) | ~code.apply("eq", (a, a)), a, b)


def _whole(x: Value) -> Value:
    """A number that is not negative as a whole one; 0 where it is NaN."""
    code = x.code
    return code.convert("fptosi", code.select(x < FAR * FAR, x, code.constant(0.0)), "i64")
