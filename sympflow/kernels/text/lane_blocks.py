"""Blocks of trajectories side by side. Source text for `lanes`, after the tuple algebra of states and `aligned`.

Nothing in it depends on a system: systems whose states are alike share it, compiled.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

from numba import njit, types
from numba.extending import intrinsic

LANES = 64
MANY_LANES = max(LANES, min(256, 512 // NDOF // LANES * LANES))  # the more, the less goes for the start of a stage
VECTOR = 8  # lanes are padded to a multiple of this with copies of the last one


@intrinsic
def widest_vectors(typing_context):
    """Let loops over lanes take vectors of 512 bits where there are some, of which LLVM prefers half by itself.

    These loops keep the multipliers busy, which are twice as many then: they run in two thirds of the time.
    """

    def generate(context, builder, signature, arguments):
        # `add` of the attributes knows those without a value only
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate


@njit(**OPTIONS)
def empty_lanes():
    return aligned_zeros((2 * NDOF + N_VALUES) * MANY_LANES).reshape((2 * NDOF + N_VALUES, MANY_LANES))


@njit(**OPTIONS)
def zero_lanes(block):
    for i in range(block.shape[0]):
        for lane in range(block.shape[1]):
            block[i, lane] = 0.0


@njit(**OPTIONS)
def go_on(Y, start, error, running, block_start, count, width):
    """Take up the running states of a block, where a run was cut."""
    for lane in range(width):
        row = running[block_start + min(lane, count - 1)]
        for m in range(2 * NDOF):
            Y[m, lane] = start[m, lane] = row[m]
            if COMPENSATED:
                error[m, lane] = row[2 * NDOF + m]


@njit(**OPTIONS)
def keep_lanes(Y, error, running, block_start, count, n_finite, n_steps):
    """Write the running states of a block, NaN of those that have ended."""
    for lane in range(count):
        ended = n_finite[block_start + lane] < n_steps
        row = running[block_start + lane]
        for m in range(2 * NDOF):
            row[m] = math.nan if ended else Y[m, lane]
            if COMPENSATED:
                row[2 * NDOF + m] = error[m, lane]
