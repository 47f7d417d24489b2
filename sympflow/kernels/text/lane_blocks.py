"""Blocks of trajectories side by side. Source text for `lanes`, after the tuple algebra of states and `aligned`.

Nothing in it depends on a system: systems whose states are alike share it, compiled.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

LANES = 64
MANY_LANES = max(LANES, min(256, 512 // NDOF // LANES * LANES))  # the more, the less goes for the start of a stage
VECTOR = 8  # lanes are padded to a multiple of this with copies of the last one
MOST_SHUFFLED = 4  # degrees of freedom, of rows that are turned into lanes by shuffles of vectors


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


def shuffled(builder, order, vector, other=None):
    """The numbers of a vector, or of two one after the other, in an order."""
    indices = ir.Constant(ir.VectorType(ir.IntType(32), len(order)), list(order))
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined) if other is None else other, indices)


def at(builder, address, n):
    """Pointer to n numbers at an address."""
    return builder.inttoptr(address, ir.VectorType(ir.DoubleType(), n).as_pointer())


def at_lanes(builder, address, m):
    """Pointer to `VECTOR` lanes of component m of a block, from the address of those of component 0 on."""
    offset = ir.Constant(ir.IntType(64), 8 * m * MANY_LANES)
    return at(builder, builder.add(address, offset), VECTOR)


@intrinsic
def turn_rows(typing_context, rows, lanes):
    """Copy `VECTOR` rows of states at an address to the lanes of a block at another one."""

    def generate(context, builder, signature, arguments):
        size = 2 * NDOF
        states = builder.load(at(builder, arguments[0], size * VECTOR), align=8)
        for m in range(size):
            component = shuffled(builder, [size * lane + m for lane in range(VECTOR)], states)
            builder.store(component, at_lanes(builder, arguments[1], m), align=8)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), generate


@intrinsic
def turn_lanes(typing_context, lanes, rows):
    """Copy `VECTOR` lanes of a block at an address to rows at another one."""

    def generate(context, builder, signature, arguments):
        size = 2 * NDOF
        parts = [builder.load(at_lanes(builder, arguments[0], m), align=8) for m in range(size)]
        parts += [ir.Constant(parts[0].type, ir.Undefined)] * ((1 << (size - 1).bit_length()) - size)
        while len(parts) > 1:  # one vector of all, by halves
            both = range(2 * parts[0].type.count)
            parts = [shuffled(builder, both, *pair) for pair in zip(parts[::2], parts[1::2], strict=True)]
        states = shuffled(builder, [VECTOR * (i % size) + i // size for i in range(size * VECTOR)], parts[0])
        builder.store(states, at(builder, arguments[1], size * VECTOR), align=8)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), generate


@njit(**OPTIONS)
def load_rows(y, first, count, Y):
    """Set the lanes of a block to `count` rows of y (N, 2d) from `first` on, the last of them as often as need be."""
    widest_vectors()
    whole = count // VECTOR * VECTOR if NDOF <= MOST_SHUFFLED else 0
    if NDOF <= MOST_SHUFFLED:
        rows, lanes = y.ctypes.data + 16 * NDOF * first, Y.ctypes.data
        for lane in range(0, whole, VECTOR):
            turn_rows(rows + 16 * NDOF * lane, lanes + 8 * lane)
    for lane in range(whole, (count + VECTOR - 1) // VECTOR * VECTOR):
        q, p = unpack(y[first + min(lane, count - 1)])
        pack_lane(q, p, Y, lane)


@njit(**OPTIONS)
def store_rows(Y, first, count, out):
    """Write `count` lanes of a block into rows of `out` (N, 2d) from `first` on."""
    widest_vectors()
    whole = count // VECTOR * VECTOR if NDOF <= MOST_SHUFFLED else 0
    if NDOF <= MOST_SHUFFLED:
        rows, lanes = out.ctypes.data + 16 * NDOF * first, Y.ctypes.data
        for lane in range(0, whole, VECTOR):
            turn_lanes(lanes + 8 * lane, rows + 16 * NDOF * lane)
    for lane in range(whole, count):
        q, p = unpack_lane(Y, lane)
        pack(q, p, out[first + lane])
