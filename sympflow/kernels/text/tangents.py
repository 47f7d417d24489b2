"""Orbits with deviation vectors by the exact linearisation of each kick and drift, and what becomes of the vectors.

Source text, pasted after the tuple algebra of an orbit and `VECTORS` vectors as one state of `NDOF` positions and
momenta, its kicks, `loops`, `aligned` and `lanes`. Where `SINGLE`, orbits run one by one in registers; else they stand
in tiles of `LANES`, which are filled up with others once one of them is done. What is known of an orbit does not depend
on its neighbours.

Vectors are scaled by powers of two only, which rounds nothing: a run has the same bits however often that is done.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

POOL = 32  # tiles whose states lie in the second-level cache
ORBIT = NDOF // (1 + VECTORS)  # degrees of freedom of the orbit
ALIGNMENT, VOLUME = 1, 2  # kinds of spread
EXPONENT_BITS, BIAS = 52, 1023
LOG_2 = 0.6931471805599453


@njit(**OPTIONS)
def advance_tile(Y, error, width, table, first, n_steps):
    """Steps of all lanes, the first of them begun with column `first` of the table."""
    widest_vectors()
    link = table.shape[1] - 2
    j = first
    for _ in range(n_steps * link // 2):  # two at a time: what is loaded and stored takes as long as half of a stage
        k = j + 1 if j < link else 1
        numbers, after = numbers_of(table, j), numbers_of(table, k)
        two_stages_lanes(Y, error, width, numbers, drift_of(table, j), after, drift_of(table, k))
        j = k + 1 if k < link else 1
    if n_steps * link % 2:
        stage_lanes(Y, error, width, numbers_of(table, j), drift_of(table, j))


@njit(**OPTIONS)
def advance_each(Y, width, table, first, n_steps, work):
    """`advance_tile`, lane after lane in registers."""
    link = table.shape[1] - 2
    for lane in range(width):
        q, p = unpack_lane(Y, lane)
        j = first
        for _ in range(n_steps * link):
            q, p, _, _ = stage(q, p, None, None, numbers_of(table, j), drift_of(table, j), j, work)
            j = j + 1 if j < link else 1
        pack_lane(q, p, Y, lane)


@njit(**OPTIONS)
def close_tile(Y, Z, error, width, table):
    """The ends of the steps of all lanes, Y left as it is."""
    last = table.shape[1] - 1
    copy_lanes(Y, Z)
    stage_lanes(Z, error, width, numbers_of(table, last), drift_of(table, last))


@njit(**OPTIONS)
def look(Z, scale, width, whole, squares):
    """Into `whole` 0 where a lane is finite, and the squares of the lengths of its vectors (VECTORS, LANES).

    `scale` (2 ORBIT,) weighs the squares of the components.
    """
    for lane in range(width):
        whole[lane] = 0.0
    for i in range(ORBIT):
        for lane in range(width):
            whole[lane] += 0.0 * Z[i, lane] + 0.0 * Z[NDOF + i, lane]
    for k in range(VECTORS):
        for lane in range(width):
            squares[k, lane] = 0.0
        for m in range(ORBIT):
            i = (1 + k) * ORBIT + m
            for lane in range(width):
                squares[k, lane] += scale[m] * Z[i, lane] * Z[i, lane]
                squares[k, lane] += scale[ORBIT + m] * Z[NDOF + i, lane] * Z[NDOF + i, lane]
        for lane in range(width):
            whole[lane] += 0.0 * squares[k, lane]


@njit(**OPTIONS)
def rescale(Y, width, squares, exponents):
    """Divide vectors by the power of two next to their lengths, whose exponents are added up; the squares too."""
    for k in range(VECTORS):
        for lane in range(width):
            n = ((float_to_bits(squares[k, lane]) >> EXPONENT_BITS) - BIAS) >> 1
            factor = bits_to_float((BIAS - n) << EXPONENT_BITS)
            exponents[k, lane] += n
            squares[k, lane] *= factor * factor
            for i in range((1 + k) * ORBIT, (2 + k) * ORBIT):
                Y[i, lane] *= factor
                Y[NDOF + i, lane] *= factor


@njit(**OPTIONS)
def alignment(Z, scale, lane):
    """min(|u + v|, |u − v|) of two vectors made unit vectors u and v."""
    uu = vv = 0.0
    for i in range(ORBIT, 2 * ORBIT):
        j = i + ORBIT
        of_q, of_p = scale[i - ORBIT], scale[i]
        uu += of_q * Z[i, lane] * Z[i, lane] + of_p * Z[NDOF + i, lane] * Z[NDOF + i, lane]
        vv += of_q * Z[j, lane] * Z[j, lane] + of_p * Z[NDOF + j, lane] * Z[NDOF + j, lane]
    a, b = 1.0 / math.sqrt(uu), 1.0 / math.sqrt(vv)
    plus = minus = 0.0
    for i in range(ORBIT, 2 * ORBIT):
        j = i + ORBIT
        u_q, u_p, v_q, v_p = a * Z[i, lane], a * Z[NDOF + i, lane], b * Z[j, lane], b * Z[NDOF + j, lane]
        of_q, of_p = scale[i - ORBIT], scale[i]
        plus += of_q * (u_q + v_q) * (u_q + v_q) + of_p * (u_p + v_p) * (u_p + v_p)
        minus += of_q * (u_q - v_q) * (u_q - v_q) + of_p * (u_p - v_p) * (u_p - v_p)
    return math.sqrt(min(plus, minus))


@njit(**OPTIONS)
def volume(Z, scale, lane, W):
    """Volume of the parallelepiped of the vectors made unit vectors: the product of R's diagonal in W = QR.

    The vectors are made orthogonal one after the other, each twice (`W` (VECTORS, 2 ORBIT) is overwritten).
    """
    total = 1.0
    for k in range(VECTORS):
        for i in range(ORBIT):
            W[k, i] = math.sqrt(scale[i]) * Z[(1 + k) * ORBIT + i, lane]
            W[k, ORBIT + i] = math.sqrt(scale[ORBIT + i]) * Z[NDOF + (1 + k) * ORBIT + i, lane]
        length = row_length(W, k)
        for i in range(2 * ORBIT):
            W[k, i] /= length
        for _ in range(2):
            for m in range(k):
                product = 0.0
                for i in range(2 * ORBIT):
                    product += W[m, i] * W[k, i]
                for i in range(2 * ORBIT):
                    W[k, i] -= product * W[m, i]
        length = row_length(W, k)
        total *= length
        for i in range(2 * ORBIT):
            W[k, i] /= length
        if length == 0.0:
            return 0.0
    return total


@njit(**OPTIONS)
def row_length(W, k):
    square = 0.0
    for i in range(W.shape[1]):
        square += W[k, i] * W[k, i]
    return math.sqrt(square)


@njit(**OPTIONS)
def spread_of(Z, scale, lane, kind, W):
    if kind == ALIGNMENT:
        return alignment(Z, scale, lane)
    if kind == VOLUME:
        return volume(Z, scale, lane, W)
    return math.nan


@njit(**OPTIONS)
def copy_column(source, target, lane, to):
    for i in range(source.shape[0]):
        target[i, to] = source[i, lane]


@njit(**OPTIONS)
def note(i, n, exponents, squares, spread, lane, growth, spreads, row):
    """The logarithms of the lengths of the vectors, and their spread, of orbit i into a row of its outputs."""
    for k in range(VECTORS):
        growth[i, k, row] = LOG_2 * exponents[k, lane] + 0.5 * math.log(squares[k, lane])
    spreads[i, row] = spread


@njit(**OPTIONS)
def rollout_tangents(table, x0, scale, n_steps, every, save, kind, limit, growth, spreads, reached, stop):
    """Run each row of `x0` (N, 2 NDOF), an orbit and its vectors, looked at after each `every` steps.

    Lengths are those of the components weighed by the roots of `scale` (2 ORBIT,).

    After the steps `save` the logarithms of the lengths of the vectors go into `growth` (N, VECTORS, n + 1) and their
    spread, of a kind, into `spreads` (N, n + 1); the last entry is that at the end of the orbit, which is where the
    spread falls below `limit`, or after `n_steps`. `reached` (N,) is the count of steps there; of an orbit that is not
    finite any more it is −1 − n, n the last count at which that was looked at, and the last entries are left as they
    are. Lanes run one by one where `SINGLE`.
    """
    widest_vectors()
    work = prepared(table) if SINGLE else None
    n_tiles = min(POOL, (x0.shape[0] + LANES - 1) // LANES)
    X = aligned_zeros(n_tiles * 2 * NDOF * LANES).reshape((n_tiles, 2 * NDOF, LANES))
    Z = aligned_zeros(2 * NDOF * LANES).reshape((2 * NDOF, LANES))
    exponents = np.zeros((n_tiles, VECTORS, LANES))
    squares, whole, spread = np.zeros((VECTORS, LANES)), np.zeros(LANES), np.zeros(LANES)
    W = np.zeros((VECTORS, 2 * ORBIT))
    index = np.zeros(n_tiles * LANES, dtype=np.int64)
    done = np.zeros(n_tiles * LANES, dtype=np.int64)
    link, end = table.shape[1] - 2, len(save)
    for start in range(0, x0.shape[0], n_tiles * LANES):
        alive = min(n_tiles * LANES, x0.shape[0] - start)
        exponents[:] = 0.0
        for place in range((alive + VECTOR - 1) // VECTOR * VECTOR):
            i = start + min(place, alive - 1)
            index[place] = i
            q, p = unpack(x0[i])
            pack_lane(q, p, X[place // LANES], place % LANES)
        n = saved = first = 0
        while n < n_steps and alive > 0 and stop[0] == 0:
            block = min(every, n_steps - n)
            if saved < len(save):
                block = min(block, save[saved] - n)
            n_done = 0
            for tile in range((alive + LANES - 1) // LANES):
                Y = X[tile]
                count = min(LANES, alive - tile * LANES)
                width = (count + VECTOR - 1) // VECTOR * VECTOR
                if SINGLE:
                    advance_each(Y, count, table, first, block, work)
                else:
                    advance_tile(Y, Z, width, table, first, block)
                close_tile(Y, Z, Z, width, table)
                look(Z, scale, width, whole, squares)
                rescale(Y, width, squares, exponents[tile])
                noted = saved < len(save) and save[saved] == n + block
                last = n + block == n_steps
                if noted or last or limit > 0.0:
                    for lane in range(count):
                        spread[lane] = spread_of(Z, scale, lane, kind, W)
                for lane in range(count):
                    i = index[tile * LANES + lane]
                    if whole[lane] != 0.0:
                        reached[i] = -1 - n
                    else:
                        below = spread[lane] < limit
                        if noted:
                            note(i, n, exponents[tile], squares, spread[lane], lane, growth, spreads, saved)
                        if last or below:
                            note(i, n, exponents[tile], squares, spread[lane], lane, growth, spreads, end)
                            reached[i] = n + block
                        if not below:
                            continue
                    done[n_done] = tile * LANES + lane
                    n_done += 1
            while n_done > 0:  # the last one goes into the place of the last that is done
                n_done -= 1
                alive -= 1
                place = done[n_done]
                if place != alive:
                    copy_column(X[alive // LANES], X[place // LANES], alive % LANES, place % LANES)
                    copy_column(exponents[alive // LANES], exponents[place // LANES], alive % LANES, place % LANES)
                    index[place] = index[alive]
            n, first = n + block, link
            while saved < len(save) and save[saved] <= n:
                saved += 1
