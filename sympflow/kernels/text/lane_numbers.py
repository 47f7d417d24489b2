"""The numbers of single steps of lanes, each of a length of its own. Source text for `lanes`, after `lane_blocks`.

`STEP_POWERS` are the powers of the step length by which the drift and the numbers of kicks grow. Systems that have such
kicks share it, compiled.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import njit

# Rows of what a step of lanes needs beside the states: the variable of the polynomials, powers of the step length, the
# drift and the numbers of the kick.
X, H, H3, H5, A, NUMBERS = [2 * NDOF + i for i in range(6)]
POWERS = tuple([{1: H, 3: H3, 5: H5}[power] for power in STEP_POWERS])


@njit(**OPTIONS)
def numbers_that_apply(table, j):
    """The numbers of the kick of stage j: that with most of them whose last one is not 0 for all x, or `FEWEST`."""
    n = N_NUMBERS
    while n > FEWEST:
        for k in range(table.shape[2]):
            if table[n, j, k] != 0.0:
                return n
        n -= 1
    return n


@njit(**OPTIONS)
def fill_lanes(Y, width, table, j):
    """The drift of stage j and the numbers of its kick for all lanes, Σ_k table[i, j, k] x^k times a power of h.

    There are one or at least three terms. Returns how many numbers the kick has.
    """
    widest_vectors()
    last, n = table.shape[2] - 1, numbers_that_apply(table, j)
    for i in range(n + 1):
        row, factor, c0 = A + i, POWERS[i], table[i, j, 0]
        if last == 0:
            for lane in range(width):
                Y[row, lane] = c0 * Y[factor, lane]
            continue
        c1, c2 = table[i, j, 1], table[i, j, 2]
        if last == 2:
            for lane in range(width):
                Y[row, lane] = ((c2 * Y[X, lane] + c1) * Y[X, lane] + c0) * Y[factor, lane]
            continue
        for lane in range(width):
            Y[row, lane] = table[i, j, last]
        for k in range(last - 1, 2, -1):
            for lane in range(width):
                Y[row, lane] = Y[row, lane] * Y[X, lane] + table[i, j, k]
        for lane in range(width):
            Y[row, lane] = (((Y[row, lane] * Y[X, lane] + c2) * Y[X, lane] + c1) * Y[X, lane] + c0) * Y[factor, lane]
    return n
