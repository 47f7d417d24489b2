"""The loops of a splitting into exactly solvable parts. Source text, pasted after the algebra of a system.

The algebra that comes before defines tuples of normal modes x, y (``unpack``, ``pack``, …), ``to_modes`` and
``from_modes``, ``apply_map`` and ``apply_map_lanes``. Where a run is asked to be `in_modes`, it takes and gives modes
instead of states. A step is a list of maps, a code and a row of coefficients each. A run executes the rows
[opening, inner …, link, closing]: a step is the link (the first step, the opening) and the inner maps, so that
consecutive steps share their common map; an output is the closing map applied to a copy. A run may be cut: it then
begins after `first` steps from the `running` modes that it left there; where nobody asks for them, `running` is empty.
A map of a part that depends on t reads the time of its row in step k, counted from the run's beginning.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

CHECK_EVERY = 1024  # steps between two looks for a non-finite state, where nothing is saved
FIRST_STEP = np.int64(0)  # a literal has a type of its own, for which `apply_map` would be compiled again


@njit(**OPTIONS, forceinline=True)  # called, it would take and give its states in memory
def one_step(x, y, codes, table, first, link, k):
    x, y = apply_map(x, y, codes[first], table, first, k)
    for j in range(1, link):
        x, y = apply_map(x, y, codes[j], table, j, k)
    return x, y


@njit(**OPTIONS, forceinline=True)
def closed(x, y, codes, table, in_modes, k):
    """The end of step k, from the running state before its last map."""
    x, y = apply_map(x, y, codes[len(codes) - 1], table, len(codes) - 1, k)
    return (x, y) if in_modes else from_modes(x, y)


@njit(**OPTIONS)
def rollout(codes, table, y0, in_modes, n_steps, save, columns, stop, first, running):
    """`n_steps` steps from `y0` (2d,), the states after ``save[i]`` steps into ``columns[:, i]``.

    Returns the index of the last step that ends in a finite state; rows of later steps are NaN. Ends early, with
    rows unset, when another thread sets ``stop[0]``.
    """
    link, out = len(codes) - 2, columns.T
    x, y = unpack(y0)
    n, saved, begin, longest = first, 0, link if first > 0 else 0, CHECK_EVERY
    while saved < len(save) and save[saved] <= 0:
        pack(x, y, out[saved])
        saved += 1
    if first > 0:
        x, y = unpack(running)
    elif not in_modes:
        x, y = to_modes(x, y)
    while n < n_steps and stop[0] == 0:
        block = min(longest, n_steps - n)
        if saved < len(save):
            block = min(block, save[saved] - n)
        start_x, start_y, start = x, y, begin
        for k in range(n, n + block):
            x, y = one_step(x, y, codes, table, begin, link, k)
            begin = link
        end_x, end_y = closed(x, y, codes, table, in_modes, n + block - 1)
        if not is_finite(end_x, end_y):
            if block == 1:
                fill_with_nan(out, saved)
                set_nan(running)
                return n
            x, y, begin, longest = start_x, start_y, start, 1  # again, step by step
            continue
        n += block
        while saved < len(save) and save[saved] == n:
            pack(end_x, end_y, out[saved])
            saved += 1
    if len(running) > 0:
        pack(x, y, running)
    return n_steps


@njit(**OPTIONS)
def step_each(codes, tables, z, in_modes, out):
    """One step from every row of `z` (N, 2d) by the maps `codes`, each row with its own table (N, n, W)."""
    for i in range(z.shape[0]):
        x, y = unpack(z[i])
        if not in_modes:
            x, y = to_modes(x, y)
        for j in range(len(codes)):
            x, y = apply_map(x, y, codes[j], tables[i], j, FIRST_STEP)
        if not in_modes:
            x, y = from_modes(x, y)
        pack(x, y, out[i])


TABLE = 2 * NDOF  # lines of the row of a map, for each lane; then come its numbers, the time and the basis functions
NUMBERS = TABLE + ROW_WIDTH
TIME = NUMBERS + 2 + N_CLASSES
BASIS = TIME + 1


@njit(**OPTIONS)
def fill_numbers(Z, width, coefficients, j, linear):
    """The numbers of map j: powers of t, times sums of the basis functions with these coefficients.

    The power is 1 of lengths, 3 of a force gradient, the second number of a part, and 0 of filters.
    """
    n = N_CLASSES if linear else 2 + FILTERS * N_CLASSES
    for i in range(n):
        row = NUMBERS + i
        for lane in range(width):
            Z[row, lane] = coefficients[j, i, 0]
        for k in range(1, coefficients.shape[2]):
            for lane in range(width):
                Z[row, lane] += coefficients[j, i, k] * Z[BASIS + k, lane]
        power = 1 if linear or i == 0 else 3 if i == 1 else 0
        for _ in range(power):
            for lane in range(width):
                Z[row, lane] *= Z[TIME, lane]


@njit(**OPTIONS)
def step_lanes(codes, coefficients, dt, t, y, in_modes, out):
    """One step from every row of `y` (N, 2d), each of its own length t[i] > 0, `LANES` rows at a time.

    The numbers of the maps, coefficients (m, numbers, K), are sums of the functions 1 and τ² T_k(2τ² − 1), τ = t/dt,
    with Chebyshev's T_k: lengths times t, force gradients times t³, and filters.
    """
    terms = coefficients.shape[2]
    Z = aligned_zeros((BASIS + max(terms, 3)) * LANES).reshape((BASIS + max(terms, 3), LANES))
    for block_start in range(0, y.shape[0], LANES):
        count = min(LANES, y.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(width):
            i = block_start + min(lane, count - 1)
            q, p = unpack(y[i])
            if not in_modes:
                q, p = to_modes(q, p)
            pack_lane(q, p, Z, lane)
            square = (t[i] / dt) ** 2
            Z[TIME, lane] = t[i]
            Z[BASIS + 1, lane], Z[BASIS + 2, lane] = square, square * (2.0 * square - 1.0)
        for k in range(3, terms):
            for lane in range(width):
                x = 2.0 * (2.0 * Z[BASIS + 1, lane] - 1.0)
                Z[BASIS + k, lane] = x * Z[BASIS + k - 1, lane] - Z[BASIS + k - 2, lane]
        for j in range(len(codes)):
            linear = codes[j] == 0
            fill_numbers(Z, width, coefficients, j, linear)
            if linear:
                fill_turns(Z, width)
            else:
                for lane in range(width):
                    Z[TABLE, lane], Z[TABLE + 1, lane] = Z[NUMBERS, lane], Z[NUMBERS + 1, lane]
                if FILTERS:
                    fill_filters(Z, width)
            apply_map_each(Z, width, codes[j])
        for lane in range(count):
            q, p = unpack_lane(Z, lane)
            if not in_modes:
                q, p = from_modes(q, p)
            pack(q, p, out[block_start + lane])


@njit(**OPTIONS)
def first_non_finite(x, y, codes, table, first, n_steps, in_modes, k):
    """The first of `n_steps` steps, from step k on, whose end is not finite; `n_steps` if none is."""
    link = len(codes) - 2
    for n in range(1, n_steps):
        x, y = one_step(x, y, codes, table, first, link, k + n - 1)
        first = link
        end_x, end_y = closed(x, y, codes, table, in_modes, k + n - 1)
        if not is_finite(end_x, end_y):
            return n
    return n_steps


@njit(**OPTIONS)
def rollout_lanes(codes, table, y0, in_modes, n_steps, save, out, n_finite, stop, first, running):
    """`rollout` of every row of `y0` (N, 2d), `LANES` at a time."""
    link = len(codes) - 2
    Z = aligned_zeros(2 * NDOF * LANES).reshape((2 * NDOF, LANES))
    start = aligned_zeros(2 * NDOF * LANES).reshape((2 * NDOF, LANES))
    for block_start in range(0, y0.shape[0], LANES):
        count = min(LANES, y0.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(width):
            i = block_start + min(lane, count - 1)
            x, y = unpack(y0[i])
            n_finite[i] = n_steps
            for row in range(len(save)):
                if save[row] > 0:
                    break
                pack(x, y, out[i, row])
            if not in_modes:
                x, y = to_modes(x, y)
            pack_lane(x, y, Z, lane)
        n, saved, j0 = first, 0, 0
        if first > 0:
            j0 = link
            for lane in range(width):
                row = running[block_start + min(lane, count - 1)]
                for m in range(2 * NDOF):
                    Z[m, lane] = row[m]
        while saved < len(save) and save[saved] <= 0:
            saved += 1
        n_alive = count
        while n < n_steps and n_alive > 0 and stop[0] == 0:
            copy_lanes(Z, start)
            begin = j0
            block = min(CHECK_EVERY, n_steps - n)
            if saved < len(save):
                block = min(block, save[saved] - n)
            for k in range(n, n + block):
                for i in range(link):
                    j = j0 if i == 0 else i
                    apply_map_lanes(Z, width, codes[j], table, j, k)
                j0 = link
            next_saved = saved
            while next_saved < len(save) and save[next_saved] == n + block:
                next_saved += 1
            for lane in range(count):
                i = block_start + lane
                if n_finite[i] < n_steps:
                    continue
                x, y = unpack_lane(Z, lane)
                x, y = closed(x, y, codes, table, in_modes, n + block - 1)
                if not is_finite(x, y):
                    x, y = unpack_lane(start, lane)
                    n_finite[i] = n - 1 + first_non_finite(x, y, codes, table, begin, block, in_modes, n)
                    n_alive -= 1
                    fill_with_nan(out[i], saved)
                else:
                    for row in range(saved, next_saved):
                        pack(x, y, out[i, row])
            n, saved = n + block, next_saved
        if running.shape[1] > 0:
            for lane in range(count):
                ended = n_finite[block_start + lane] < n_steps
                row = running[block_start + lane]
                for m in range(2 * NDOF):
                    row[m] = np.nan if ended else Z[m, lane]
