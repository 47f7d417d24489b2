"""Many trajectories at once: their states side by side, so that one instruction moves several of them.

Source text, pasted after the tuple algebra of a symbolic system, `loops` and `aligned`. A block holds `LANES`
trajectories, in a run `MANY_LANES`, component first, as an array (2d, LANES) that stays in the first-level cache; the
compiler turns the loop over the lanes of a stage into vector instructions. Lanes never mix: one that overflows leaves
the others as they are.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

LANES = 64
MANY_LANES = max(LANES, min(256, 512 // NDOF // LANES * LANES))  # the more, the less goes for the start of a stage
VECTOR = 8  # lanes are padded to a multiple of this with copies of the last one


@njit(**OPTIONS)
def empty_lanes():
    return aligned_zeros(2 * NDOF * MANY_LANES).reshape((2 * NDOF, MANY_LANES))


@njit(**OPTIONS, forceinline=True)
def plain_lane(q, p, q_error, p_error, b, a):
    if SCHEDULED:
        p = kicked_lane(q, p, b)
        q, q_error = move(q, q_error, drift(p, a, None))
        return q, p, q_error, p_error
    return plain_stage(q, p, q_error, p_error, b, a, 0, None)


@njit(**OPTIONS, forceinline=True)
def gradient_lane(q, p, q_error, p_error, b, g, a):
    if FORCE_GRADIENTS and SCHEDULED:
        p = gradient_kicked_lane(q, p, b, g)
        q, q_error = move(q, q_error, drift(p, a, None))
        return q, p, q_error, p_error
    return gradient_stage(q, p, q_error, p_error, b, g, a, 0, None)


@njit(**OPTIONS, forceinline=True)
def curvature_lane(q, p, q_error, p_error, b, g, c, a):
    if CURVATURES and SCHEDULED:
        p = curvature_kicked_lane(q, p, b, g, c)
        q, q_error = move(q, q_error, drift(p, a, None))
        return q, p, q_error, p_error
    return curvature_stage(q, p, q_error, p_error, b, g, c, a, 0, None)


@njit(**OPTIONS, forceinline=True)
def polynomial_lane(q, p, q_error, p_error, b, c, a):
    if POLYNOMIALS and SCHEDULED:
        p = polynomial_kicked_lane(q, p, b, c)
        q, q_error = move(q, q_error, drift(p, a, None))
        return q, p, q_error, p_error
    return polynomial_stage(q, p, q_error, p_error, b, c, a, 0, None)


@njit(**OPTIONS, inline="always")  # called, the loop over the lanes takes five times as long
def stage_lanes(Y, error, width, b, g, c, a):
    # Asked outside the loops: a loop with a branch in it, once it is long, is no longer made of vector instructions.
    if POLYNOMIALS:
        e = coefficients_of(c)
        for lane in range(width):
            q, p = unpack_lane(Y, lane)
            if COMPENSATED:
                q_error, p_error = unpack_lane(error, lane)
                q, p, q_error, p_error = polynomial_lane(q, p, q_error, p_error, b, e, a)
                pack_lane(q_error, p_error, error, lane)
            else:
                q, p, _, _ = polynomial_lane(q, p, None, None, b, e, a)
            pack_lane(q, p, Y, lane)
    elif CURVATURES and c != 0.0:
        for lane in range(width):
            q, p = unpack_lane(Y, lane)
            if COMPENSATED:
                q_error, p_error = unpack_lane(error, lane)
                q, p, q_error, p_error = curvature_lane(q, p, q_error, p_error, b, g, c, a)
                pack_lane(q_error, p_error, error, lane)
            else:
                q, p, _, _ = curvature_lane(q, p, None, None, b, g, c, a)
            pack_lane(q, p, Y, lane)
    elif FORCE_GRADIENTS and g != 0.0:
        for lane in range(width):
            q, p = unpack_lane(Y, lane)
            if COMPENSATED:
                q_error, p_error = unpack_lane(error, lane)
                q, p, q_error, p_error = gradient_lane(q, p, q_error, p_error, b, g, a)
                pack_lane(q_error, p_error, error, lane)
            else:
                q, p, _, _ = gradient_lane(q, p, None, None, b, g, a)
            pack_lane(q, p, Y, lane)
    else:
        for lane in range(width):
            q, p = unpack_lane(Y, lane)
            if COMPENSATED:
                q_error, p_error = unpack_lane(error, lane)
                q, p, q_error, p_error = plain_lane(q, p, q_error, p_error, b, a)
                pack_lane(q_error, p_error, error, lane)
            else:
                q, p, _, _ = plain_lane(q, p, None, None, b, a)
            pack_lane(q, p, Y, lane)


@njit(**OPTIONS)
def close_lane(Y, error, lane, kicks, drifts, gradients, curvatures, work):
    q, p = unpack_lane(Y, lane)
    q_error, p_error = no_error(q), no_error(p)
    if COMPENSATED:
        q_error, p_error = unpack_lane(error, lane)
    return close(q, p, q_error, p_error, kicks, drifts, gradients, curvatures, work)


@njit(**OPTIONS)
def rollout_lanes(kicks, drifts, gradients, curvatures, y0, n_steps, save, out, n_finite, stop):
    """`rollout` of every row of `y0` (N, 2d), `MANY_LANES` at a time; outputs as in `rollout_each`."""
    link = len(kicks) - 2
    work = prepared(kicks, gradients, curvatures)
    Y, start, error = empty_lanes(), empty_lanes(), empty_lanes()
    for block_start in range(0, y0.shape[0], MANY_LANES):
        count = min(MANY_LANES, y0.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(width):
            i = block_start + min(lane, count - 1)
            q, p = unpack(y0[i])
            pack_lane(q, p, Y, lane)
            pack_lane(q, p, start, lane)
            n_finite[i] = n_steps
            for row in range(len(save)):
                if save[row] > 0:
                    break
                pack(q, p, out[i, row])
        error[:] = 0.0
        n = saved = first = 0
        while saved < len(save) and save[saved] <= 0:
            saved += 1
        n_alive = count
        while n < n_steps and n_alive > 0 and stop[0] == 0:
            block = min(CHECK_EVERY, n_steps - n)
            if saved < len(save):
                block = min(block, save[saved] - n)
            b, g, c, a = kicks[first], gradients[first], curvatures[first], drifts[first]
            for _ in range(block):
                stage_lanes(Y, error, width, b, g, c, a)
                for j in range(1, link):
                    stage_lanes(Y, error, width, kicks[j], gradients[j], curvatures[j], drifts[j])
                b, g, c, a = kicks[link], gradients[link], curvatures[link], drifts[link]
            next_saved = saved
            while next_saved < len(save) and save[next_saved] == n + block:
                next_saved += 1
            for lane in range(count):
                i = block_start + lane
                if n_finite[i] < n_steps:
                    continue
                q, p = close_lane(Y, error, lane, kicks, drifts, gradients, curvatures, work)
                if not is_finite(q, p):
                    q, p = unpack_lane(start, lane)
                    before = first_non_finite(q, p, kicks, drifts, gradients, curvatures, first, block, work) - 1
                    n_finite[i] = n + before
                    n_alive -= 1
                    fill_with_nan(out[i], saved)
                else:
                    for row in range(saved, next_saved):
                        pack(q, p, out[i, row])
            copy_lanes(Y, start)
            n, saved, first = n + block, next_saved, link


X, H, H3, H5, B, G, C, A, E = [
    2 * NDOF + i for i in range(9)
]  # rows of what a stage needs, beside the states: see `step_lanes`


@njit(**OPTIONS, inline="always")
def fill_lanes(Y, width, row, coefficients, factor):
    """Σ_k coefficients[k] x^k, one or at least three, times a factor, into a row."""
    if len(coefficients) == 1:
        for lane in range(width):
            Y[row, lane] = coefficients[0] * Y[factor, lane]
        return
    c0, c1, c2 = coefficients[0], coefficients[1], coefficients[2]
    if len(coefficients) == 3:
        for lane in range(width):
            Y[row, lane] = ((c2 * Y[X, lane] + c1) * Y[X, lane] + c0) * Y[factor, lane]
        return
    last = coefficients[len(coefficients) - 1]
    for lane in range(width):
        Y[row, lane] = last
    for k in range(len(coefficients) - 2, 2, -1):
        for lane in range(width):
            Y[row, lane] = Y[row, lane] * Y[X, lane] + coefficients[k]
    for lane in range(width):
        Y[row, lane] = (((Y[row, lane] * Y[X, lane] + c2) * Y[X, lane] + c1) * Y[X, lane] + c0) * Y[factor, lane]


@njit(**OPTIONS)
def step_lanes(kicks, drifts, gradients, curvatures, x, h, y, out):
    """`step_each`, `LANES` rows at a time; where `POLYNOMIALS`, `curvatures` are (m, M, K).

    All numbers lie in one array: of several the compiler would have to find out that they do not overlap.
    """
    rows = 2 * NDOF + 8 + N_MONOMIALS
    Y = aligned_zeros(rows * LANES).reshape((rows, LANES))
    for block_start in range(0, y.shape[0], LANES):
        count = min(LANES, y.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        for lane in range(width):
            i = block_start + min(lane, count - 1)
            q, p = unpack(y[i])
            pack_lane(q, p, Y, lane)
            Y[X, lane], Y[H, lane], Y[H3, lane], Y[H5, lane] = x[i], h[i], h[i] ** 3, h[i] ** 5
        for j in range(len(kicks)):
            fill_lanes(Y, width, B, kicks[j], H)
            fill_lanes(Y, width, A, drifts[j], H)
            if POLYNOMIALS:
                for m in range(N_MONOMIALS):
                    fill_lanes(Y, width, E + m, curvatures[j, m], H3)
                for lane in range(width):
                    q, p = unpack_lane(Y, lane)
                    e = lane_coefficients(Y, lane)
                    q, p, _, _ = polynomial_lane(q, p, None, None, Y[B, lane], e, Y[A, lane])
                    pack_lane(q, p, Y, lane)
            elif CURVATURES and np.any(curvatures[j] != 0.0):
                fill_lanes(Y, width, G, gradients[j], H3)
                fill_lanes(Y, width, C, curvatures[j], H5)
                for lane in range(width):
                    q, p = unpack_lane(Y, lane)
                    q, p, _, _ = curvature_lane(q, p, None, None, Y[B, lane], Y[G, lane], Y[C, lane], Y[A, lane])
                    pack_lane(q, p, Y, lane)
            elif FORCE_GRADIENTS and np.any(gradients[j] != 0.0):
                fill_lanes(Y, width, G, gradients[j], H3)
                for lane in range(width):
                    q, p = unpack_lane(Y, lane)
                    q, p, _, _ = gradient_lane(q, p, None, None, Y[B, lane], Y[G, lane], Y[A, lane])
                    pack_lane(q, p, Y, lane)
            else:
                for lane in range(width):
                    q, p = unpack_lane(Y, lane)
                    q, p, _, _ = plain_lane(q, p, None, None, Y[B, lane], Y[A, lane])
                    pack_lane(q, p, Y, lane)
        for lane in range(count):
            q, p = unpack_lane(Y, lane)
            pack(q, p, out[block_start + lane])


@njit(**OPTIONS)
def map_lanes(numbers, more, y, out):
    """`map_each`, `MANY_LANES` rows at a time."""
    kicks, drifts, gradients = numbers[0], numbers[1], numbers[2]
    Y, error = empty_lanes(), empty_lanes()
    for block_start in range(0, y.shape[0], MANY_LANES):
        count = min(MANY_LANES, y.shape[0] - block_start)
        width = (count + VECTOR - 1) // VECTOR * VECTOR
        error[:] = 0.0
        for lane in range(width):
            q, p = unpack(y[block_start + min(lane, count - 1)])
            pack_lane(q, p, Y, lane)
        for j in range(len(kicks)):
            stage_lanes(Y, error, width, kicks[j], gradients[j], more[j], drifts[j])
        for lane in range(count):
            q, p = unpack_lane(Y, lane)
            pack(q, p, out[block_start + lane])


map_rows, rollout_rows = map_lanes, rollout_lanes
