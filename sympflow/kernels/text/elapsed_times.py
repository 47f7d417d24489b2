"""Runs of equal steps in another time, up to physical times. Source text, pasted after `lanes`.

States are [q, t, p, B] of a logarithmic Hamiltonian; kicks are scheduled, and have no force gradients. Elapsed times
are positive: t is multiplied by the sign of the step. What a clock adds to t at each step, `advance`, is no part of the
running state: it is constant, and added where a time is needed.

A run looks at the time after each `stride` steps, a single one seldomer far from an output. If an output is due since,
they are made again, one by one, and a last step is shortened until its time is the one that is wanted.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

EPS = 2.0**-52
MOST_TRIALS = 80
MOST_AT_ONCE = 1024  # steps between two looks
CLOSE = 1e-3  # of the elapsed time, beyond which a residual means that no step leads to that time
ZERO, ONE = np.int64(0), np.int64(1)  # a literal has a type of its own, for which `deliver` would be compiled again


@njit(**OPTIONS)
def clock_advance(clock, s, B):
    """Σ_k c_k s^(3+2k) B^k, of reversed numbers c."""
    square = s * s * B
    total = 0.0
    for c in clock:
        total = total * square + c
    return s * s * s * total


@njit(**OPTIONS)
def short_step(q, p, step, sigma):
    """A step of length sigma by the table for h = 1."""
    last = step.shape[1] - 1
    for j in range(last):
        p = kicked_lane(q, p, (sigma * step[1, j],))
        q = plus(q, drift(p, sigma * step[0, j], None))
    p = kicked_lane(q, p, (sigma * step[1, last],))
    if step[0, last] != 0.0:  # else a kick alone: the time, for which there are many trials, does not wait for it
        q = plus(q, drift(p, sigma * step[0, last], None))
    return q, p


@njit(**OPTIONS)
def step_to(q, p, before, after, target, h, step, clock):
    """The state after a step from (q, p), whose time is `before`, to the time `target`: secants within brackets.

    Also the steps that were tried, or minus these if none leads there. `after` is the time of a whole step.
    """
    sign = 1.0 if h > 0.0 else -1.0
    B, t = p[NDOF - 1], q[NDOF - 1]
    tolerance = 2.0 * EPS * max(target, before)
    low, high, last_sigma, last_t = 0.0, abs(h), 0.0, before
    sigma = abs(h) * (target - before) / (after - before) if after > before else 0.0
    sigma = min(max(sigma, low), high)
    best_q, best_p, best = q, p, abs(before - target)
    trials = 0
    while trials < MOST_TRIALS and (trials == 0 or best > tolerance):
        trials += 1
        new_q, new_p = short_step(q, p, step, sign * sigma)
        now = before + sign * ((new_q[NDOF - 1] - t) + clock_advance(clock, sign * sigma, B))
        residual = now - target
        if abs(residual) < best:
            best_q, best_p, best = new_q, new_p, abs(residual)
        if residual < 0.0:
            low = sigma
        else:  # NaN counts as too far
            high = sigma
        slope = (now - last_t) / (sigma - last_sigma)
        last_sigma, last_t = sigma, now
        secant = sigma - residual / slope
        inside = slope > 0.0 and slope < math.inf and secant > low and secant < high
        sigma = secant if inside else 0.5 * (low + high)
    found = best <= max(CLOSE * (target - before), 100.0 * tolerance)
    return best_q, best_p, trials if found else -trials


@njit(**OPTIONS)
def deliver(q, p, first, n, block, end, table, work, step, h, advance, clock, targets, saved, out, i):
    """The outputs of row i until the elapsed time `end`, within `block` steps from the running state (q, p) after n.

    How many there are then, the steps that were tried for them, and that in which the last one lies; saved is −1 if
    one of them is not reached.
    """
    sign, link, tried, last = 1.0 if h > 0.0 else -1.0, table.shape[1] - 2, 0, n
    q_error, p_error = no_error(q), no_error(p)
    before_q, before_p = q, p
    if n > 0:
        before_q, before_p = close(q, p, q_error, p_error, table, 0, work)
    for k in range(1, block + 1):
        for j in range(link):
            row = first if j == 0 else j
            q, p, q_error, p_error = called_stage(
                q, p, q_error, p_error, numbers_of(table, row), table[0, row], row, work
            )
        first = link
        after_q, after_p = close(q, p, q_error, p_error, table, 0, work)
        before = sign * (before_q[NDOF - 1] + (n + k - 1) * advance)
        after = sign * (after_q[NDOF - 1] + (n + k) * advance)
        while saved < len(targets) and targets[saved] <= end and (targets[saved] <= after or k == block):
            at_q, at_p = after_q, after_p
            if targets[saved] != after:
                at_q, at_p, trials = step_to(before_q, before_p, before, after, targets[saved], h, step, clock)
                tried += abs(trials)
                if trials < 0:
                    return -1, tried, n
            for j in range(NDOF - 1):
                out[saved, i, j] = at_q[j]
                out[saved, i, NDOF - 1 + j] = at_p[j]
            saved, last = saved + 1, n + k
        if saved == len(targets) or targets[saved] > end:
            break
        before_q, before_p = after_q, after_p
    return saved, tried, last


@njit(**OPTIONS)
def reach_times(table, step, h, clock, y0, targets, stride, most_steps, out, counts, stop):
    """The states [q, p] of one trajectory from ``y0[0]`` at the elapsed times `targets`, into ``out[:, 0]``.

    `table` is that of a run of steps h, `step` that of a single step for h = 1. The steps that were taken, and those
    that were tried to meet the times, go into ``counts[0]``. Returns True if all times are reached: a run ends where a
    state is not finite, where time turns, or after `most_steps`.
    """
    sign, link = 1.0 if h > 0.0 else -1.0, table.shape[1] - 2
    work = prepared(table)
    q, p = unpack(y0[0])
    advance = clock_advance(clock, h, p[NDOF - 1])
    q_error, p_error = no_error(q), no_error(p)
    n, saved, j, now = ZERO, ZERO, ZERO, 0.0
    while saved < len(targets) and stop[0] == 0:
        block = stride
        if now > 0.0:  # far from the next output: half of the steps left, by the pace so far
            block = max(stride, min(MOST_AT_ONCE, int(0.5 * n * (targets[saved] - now) / now)))
        block = min(block, most_steps - n)
        start_q, start_p, begin = q, p, j
        for _ in range(block * link):
            q, p, q_error, p_error = stage(q, p, q_error, p_error, numbers_of(table, j), table[0, j], j, work)
            j = j + 1 if j < link else 1
        end_q, end_p = close(q, p, q_error, p_error, table, 0, work)
        then = sign * (end_q[NDOF - 1] + (n + block) * advance)
        if block <= 0 or not is_finite(end_q, end_p) or not then >= now:
            return False
        if then >= targets[saved]:
            saved, tried, counts[0, 0] = deliver(
                start_q, start_p, begin, n, block, then, table, work, step, h, advance, clock, targets, saved, out, ZERO
            )
            counts[0, 1] += tried
            if saved < 0:
                return False
        n, now = n + block, then
    return stop[0] == 0


@njit(**OPTIONS)
def enter(Y, lane, row, table, work):
    """The running state after the first step from `row`, into a lane."""
    q, p = unpack(row)
    q_error, p_error = no_error(q), no_error(p)
    for j in range(table.shape[1] - 2):
        q, p, q_error, p_error = called_stage(q, p, q_error, p_error, numbers_of(table, j), table[0, j], j, work)
    pack_lane(q, p, Y, lane)


@njit(**OPTIONS)
def reach_times_lanes(table, step, h, clock, y0, begin, end, targets, stride, most_steps, out, counts, stop):
    """`reach_times` of the rows `begin` … `end` of `y0`, in vector lanes; where one has ended the next one enters."""
    sign, link = 1.0 if h > 0.0 else -1.0, table.shape[1] - 2
    work = prepared(table)
    Y, start, error = empty_lanes(), empty_lanes(), empty_lanes()
    row, n = np.zeros(LANES, dtype=np.int64), np.zeros(LANES, dtype=np.int64)
    saved, now, advance = np.zeros(LANES, dtype=np.int64), np.zeros(LANES), np.zeros(LANES)
    count, following = 0, begin
    regular = True
    while regular and stop[0] == 0:
        while count < LANES and following < end:  # their first step: the opening stage is not that of the others
            enter(Y, count, y0[following], table, work)
            row[count], n[count], saved[count], now[count] = following, 1, 0, 0.0
            q, p = close_lane(Y, error, count, table, 0, work)
            advance[count] = clock_advance(clock, h, p[NDOF - 1])
            now[count] = sign * (q[NDOF - 1] + advance[count])
            regular &= is_finite(q, p) and now[count] >= 0.0
            if regular and now[count] >= targets[0]:
                q, p = unpack(y0[following])
                saved[count], tried, counts[following, 0] = deliver(
                    q, p, ZERO, ZERO, ONE, now[count], table, work, step, h, advance[count], clock, targets, ZERO, out,
                    following,
                )  # fmt: skip
                counts[following, 1] += tried
                regular &= saved[count] >= 0
            following += 1
            count += saved[count] < len(targets)
        if count == 0 or not regular:
            break
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(count, width):
            q, p = unpack_lane(Y, count - 1)
            pack_lane(q, p, Y, lane)
        copy_lanes(Y, start)
        j = link
        for _ in range(stride * link):
            stage_lanes(Y, error, width, numbers_of(table, j), table[0, j])
            j = j + 1 if j < link else 1
        lane = 0
        while lane < count:
            i = row[lane]
            q, p = close_lane(Y, error, lane, table, 0, work)
            then = sign * (q[NDOF - 1] + (n[lane] + stride) * advance[lane])
            if not is_finite(q, p) or not then >= now[lane] or n[lane] > most_steps:
                return False
            if then >= targets[saved[lane]]:
                q, p = unpack_lane(start, lane)
                saved[lane], tried, counts[i, 0] = deliver(
                    q, p, link, n[lane], stride, then, table, work, step, h, advance[lane], clock, targets, saved[lane],
                    out, i,
                )  # fmt: skip
                counts[i, 1] += tried
                if saved[lane] < 0:
                    return False
            n[lane], now[lane] = n[lane] + stride, then
            if saved[lane] < len(targets):
                lane += 1
                continue
            count -= 1
            q, p = unpack_lane(Y, count)
            pack_lane(q, p, Y, lane)
            q, p = unpack_lane(start, count)
            pack_lane(q, p, start, lane)
            row[lane], n[lane], saved[lane] = row[count], n[count], saved[count]
            now[lane], advance[lane] = now[count], advance[count]
    return regular and stop[0] == 0
