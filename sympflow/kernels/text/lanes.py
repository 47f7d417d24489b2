"""Many trajectories at once: their states side by side, so that one instruction moves several of them.

Source text, pasted after the kicks of a symbolic system and `loops`, by the functions of `lane_blocks`. A block holds
`LANES` trajectories, in a run `MANY_LANES`, component first, as an array (2d, LANES) that stays in the first-level
cache; the compiler turns the loop over the lanes of a stage into vector instructions. Lanes never mix: one that
overflows leaves the others as they are. `sympflow.kernels.stages` writes ``stage_lanes`` and ``stage_each``, a kick and
a drift of all lanes. Where they say `OWN`, what depends on the parameters of a lane alone is computed once for a run.

Where `N_VALUES` is not 0, trajectories have parameters of their own: so many values of each stand after its state, in
the rows of y0 (N, 2d + `N_VALUES`) as in those of the blocks.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

FIRST_COLUMN = np.int64(0)  # a literal has a type of its own, for which `take_values` would be compiled again


@njit(**OPTIONS)
def take_values(table, work, Y, lane, first):
    """Let the columns of a table from `first` on, and their coefficients, have the values of a lane."""
    if N_VALUES > 0:
        for j in range(first, table.shape[1]):
            for k in range(N_VALUES):
                table[FIRST_VALUE + k, j] = Y[2 * NDOF + k, lane]
            if SCHEDULED:
                fill_coefficients(numbers_of(table, j), work[j])


@njit(**OPTIONS)
def empty_own(table):
    """Room for what depends on the parameters of a lane alone, of each stage of a run; None where all are alike."""
    if OWN:
        n = table.shape[1] - 1
        return aligned_zeros(n * N_OWN * MANY_LANES).reshape((n, N_OWN, MANY_LANES))
    return None


@njit(**OPTIONS)
def fill_lanes_own(Y, table, width, own):
    if OWN:
        for j in range(len(own)):
            common, row = numbers_of(table, j), own[j]
            for lane in range(width):
                fill_own(numbers_of_lane(Y, common, lane), row, lane)


@njit(**OPTIONS)
def advance_own(Y, width, table, own, first, n_stages):
    """Stages of lanes with parameters of their own, the first of them that of column `first` of the table."""
    widest_vectors()
    link, j = table.shape[1] - 2, first
    for _ in range(n_stages // 2):  # two at a time: what is loaded and stored takes as long as half of a stage
        k = j + 1 if j < link else 1
        common, after = numbers_of(table, j), numbers_of(table, k)
        two_own_stages_lanes(Y, width, common, drift_of(table, j), own[j], after, drift_of(table, k), own[k])
        j = k + 1 if k < link else 1
    if n_stages % 2:
        own_stage_lanes(Y, width, numbers_of(table, j), drift_of(table, j), own[j])


@njit(**OPTIONS)
def first_non_finite(q, p, table, first, k, n_steps, work):
    """The first of `n_steps` steps from a running state, that of step k, whose end is not finite, or `n_steps`."""
    link = columns_of(table) - 2
    q_error, p_error = no_error(q), no_error(p)
    j = first
    for n in range(1, n_steps):
        for _ in range(link):
            q, p, q_error, p_error = called_stage(
                q, p, q_error, p_error, numbers_of(table, j, k), drift_of(table, j), j, work
            )
            j = j + 1 if j < link else 1
            k = k + 1 if j == link else k
        end_q, end_p = close(q, p, q_error, p_error, table, k, work)
        if not is_finite(end_q, end_p):
            return n
    return n_steps


@njit(**OPTIONS)
def close_lane(Y, error, lane, table, k, work):
    q, p = unpack_lane(Y, lane)
    q_error, p_error = no_error(q), no_error(p)
    if COMPENSATED:
        q_error, p_error = unpack_lane(error, lane)
    return close(q, p, q_error, p_error, table, k, work)


@njit(**OPTIONS)
def rollout_lanes(table, y0, n_steps, save, out, n_finite, stop, first, running, closed=True):
    """`rollout` of every row of `y0` (N, 2d), `MANY_LANES` at a time; outputs as in `rollout_each`."""
    widest_vectors()
    if N_VALUES > 0:
        table = table.copy()  # of this thread
    link = table.shape[1] - 2
    work, own = prepared(table), empty_own(table)
    Y, start, error = empty_lanes(), empty_lanes(), empty_lanes()
    for block_start in range(0, y0.shape[0], MANY_LANES):
        count = min(MANY_LANES, y0.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(width):
            i = block_start + min(lane, count - 1)
            q, p = unpack(y0[i])
            pack_lane(q, p, Y, lane)
            pack_lane(q, p, start, lane)
            for k in range(2 * NDOF, 2 * NDOF + N_VALUES):
                Y[k, lane] = y0[i, k]
            n_finite[i] = n_steps
            for row in range(len(save)):
                if save[row] > 0:
                    break
                pack(q, p, out[i, row])
        fill_lanes_own(Y, table, width, own)
        zero_lanes(error)
        n, saved, begin = first, 0, 0
        if first > 0:
            begin = link
            go_on(Y, start, error, running, block_start, count, width)
        while saved < len(save) and save[saved] <= 0:
            saved += 1
        n_alive = count
        while n < n_steps and n_alive > 0 and stop[0] == 0:
            block = min(CHECK_EVERY, n_steps - n)
            if saved < len(save):
                block = min(block, save[saved] - n)
            if OWN:
                advance_own(Y, width, table, own, begin, block * link)
            else:
                j, k = begin, n
                for _ in range(block * link):
                    stage_lanes(Y, error, width, common_of(table, j, k), drift_of(table, j))
                    j = j + 1 if j < link else 1
                    k = k + 1 if j == link else k
            next_saved = saved
            while next_saved < len(save) and save[next_saved] == n + block:
                next_saved += 1
            for lane in range(count):
                i = block_start + lane
                if n_finite[i] < n_steps:
                    continue
                take_values(table, work, Y, lane, link + 1)
                if closed:
                    q, p = close_lane(Y, error, lane, table, n + block, work)
                else:
                    q, p = unpack_lane(Y, lane)
                if not is_finite(q, p):
                    take_values(table, work, Y, lane, FIRST_COLUMN)
                    q, p = unpack_lane(start, lane)
                    before = first_non_finite(q, p, table, begin, n, block, work) - 1
                    n_finite[i] = n + before
                    n_alive -= 1
                    fill_with_nan(out[i], saved)
                else:
                    for row in range(saved, next_saved):
                        pack(q, p, out[i, row])
            copy_lanes(Y, start)
            n, saved, begin = n + block, next_saved, link
        if running.shape[1] > 0:
            keep_lanes(Y, error, running, block_start, count, n_finite, n_steps)


@njit(**OPTIONS)
def step_lanes(table, x, h, t, y, out):
    """`step_each`, `LANES` rows at a time, of systems that do not depend on the time.

    All numbers lie in one array: of several the compiler would have to find out that they do not overlap.
    """
    widest_vectors()
    rows = NUMBERS + N_NUMBERS + N_VALUES
    Y = aligned_zeros(rows * MANY_LANES).reshape((rows, MANY_LANES))
    for block_start in range(0, y.shape[0], MANY_LANES):
        count = min(MANY_LANES, y.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        if N_VALUES > 0:
            for lane in range(width):
                i = block_start + min(lane, count - 1)
                q, p = unpack(y[i])
                pack_lane(q, p, Y, lane)
                for k in range(N_VALUES):
                    Y[NUMBERS + N_NUMBERS + k, lane] = y[i, 2 * NDOF + k]
        else:
            load_rows(y, block_start, count, Y)
        for lane in range(width):
            i = block_start + min(lane, count - 1)
            Y[X, lane], Y[H, lane], Y[H3, lane], Y[H5, lane] = x[i], h[i], h[i] ** 3, h[i] ** 5
        for j in range(table.shape[1]):
            stage_each(Y, width, table, j)
        store_rows(Y, block_start, count, out)


@njit(**OPTIONS)
def map_lanes(table, steps, y, out):
    """`map_each`, `MANY_LANES` rows at a time, of systems that do not depend on the time."""
    widest_vectors()
    Y, error = empty_lanes(), empty_lanes()
    for block_start in range(0, y.shape[0], MANY_LANES):
        count = min(MANY_LANES, y.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        if COMPENSATED:
            zero_lanes(error)
        load_rows(y, block_start, count, Y)
        for j in range(table.shape[1]):
            stage_lanes(Y, error, width, numbers_of(table, j), drift_of(table, j))
        store_rows(Y, block_start, count, out)


@njit(**OPTIONS)
def map_lanes_at(table, steps, y, out):
    """`map_each`, `MANY_LANES` rows at a time, of systems that depend on the time; not of compensated sums."""
    widest_vectors()
    Y, counts = empty_lanes(), aligned_zeros(MANY_LANES)
    for block_start in range(0, y.shape[0], MANY_LANES):
        count = min(MANY_LANES, y.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(width):
            counts[lane] = steps[(block_start + min(lane, count - 1)) % len(steps)]
        load_rows(y, block_start, count, Y)
        for j in range(table.shape[1]):
            stage_lanes_at(Y, width, table, j, counts)
        store_rows(Y, block_start, count, out)


if not DRIVEN:
    map_rows = map_lanes
elif SCHEDULED:
    map_rows = map_lanes_at
rollout_rows = rollout_lanes
