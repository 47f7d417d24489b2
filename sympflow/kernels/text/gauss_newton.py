"""Linear algebra of Gauss–Newton steps: small dense matrices, on one thread. Source text.

The Jacobian comes by columns, (n, m): each is contiguous. It is factored in chunks of rows that stay in the cache:
Householder reflections fold one chunk after the other into the triangle above it.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

CHUNK = 128


@njit(**OPTIONS)
def dot(x, y):
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


@njit(**OPTIONS)
def subtract(y, factor, x):
    """y −= factor x."""
    for i in range(len(x)):
        y[i] -= factor * x[i]


@njit(**OPTIONS)
def fold(R, columns, first, last, triangular):
    """Let R be the triangle of the QR factorization of [R; A], A the rows first … last of the columns, which are lost.

    A `triangular` A is an upper triangle.
    """
    for k in range(len(columns)):
        end = min(last, first + k + 1) if triangular else last
        x = columns[k, first:end]
        square = dot(x, x)
        if square == 0.0:
            continue
        norm = math.sqrt(R[k, k] * R[k, k] + square)
        norm = -norm if R[k, k] > 0.0 else norm
        head = R[k, k] - norm
        R[k, k] = norm
        for j in range(k + 1, len(columns)):
            y = columns[j, first:end]
            product = -(dot(x, y) + head * R[k, j]) / (norm * head)
            R[k, j] -= product * head
            subtract(y, product, x)


@njit(**OPTIONS)
def fold_chunks(R, columns, first, last):
    for start in range(first, last, CHUNK):
        fold(R, columns, start, min(start + CHUNK, last), False)


@njit(**OPTIONS)
def factored(columns, blocks, r, scale):
    """The triangle R (n + 1, n + 1) of [J r], and the larger of `scale` (n,) and the norms of the columns of J.

    J is given by columns (n, m); or in as many blocks of rows as `blocks` (B, k, n) are, each the rows of the columns
    (k, m) times its block: then it is these that are factored first, where k is less than n.
    """
    k, m = columns.shape
    n = blocks.shape[2] if len(blocks) > 0 else k
    whole = np.empty((k + 1, m))
    for i in range(k):
        for j in range(m):
            whole[i, j] = columns[i, j]
    for j in range(m):
        whole[k, j] = r[j]
    R = np.zeros((n + 1, n + 1))
    if len(blocks) > 0:
        size, rows = m // len(blocks), np.zeros((n + 1, k + 1))
        for b in range(len(blocks)):
            inner = np.zeros((k + 1, k + 1))
            fold_chunks(inner, whole, b * size, (b + 1) * size)
            for row in range(k + 1):
                for i in range(n):
                    rows[i, row] = 0.0
                for j in range(row, k):
                    for i in range(n):
                        rows[i, row] += inner[row, j] * blocks[b, j, i]
                rows[n, row] = inner[row, k]
            fold(R, rows, 0, k + 1, False)
    else:
        fold_chunks(R, whole, 0, m)
    larger = np.empty(n)
    for i in range(n):
        square = 0.0
        for j in range(i + 1):
            square += R[j, i] * R[j, i]
        norm = math.sqrt(square)
        larger[i] = scale[i] if scale[i] > norm else norm
    return R, larger


@njit(**OPTIONS)
def solved(S, b):
    """S⁻¹b of a triangle S, whose last column is not used."""
    n = len(b)
    x = b.copy()
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= S[i, k] * x[k]
        x[i] /= S[i, i]
    return x


@njit(**OPTIONS)
def solved_transposed(S, b):
    n = len(b)
    x = b.copy()
    for i in range(n):
        x[i] /= S[i, i]
        for k in range(i + 1, n):
            x[k] -= S[i, k] * x[i]
    return x


@njit(**OPTIONS)
def damped(R, D, damping):
    """The triangle S of [R; √λ D], the s that minimizes ‖J s + r‖² + λ‖D s‖², and the decrease of ‖J s + r‖²."""
    n = len(D)
    S, root = R.copy(), math.sqrt(damping)
    columns = np.zeros((n + 1, n))
    for i in range(n):
        columns[i, i] = root * D[i]
    fold(S, columns, 0, n, True)
    step = solved(S, S[:n, n])
    decrease = 0.0
    for i in range(n):
        step[i] = -step[i]
    for i in range(n):
        linear = R[i, n]
        for k in range(i, n):
            linear += R[i, k] * step[k]
        decrease += R[i, n] * R[i, n] - linear * linear
    return S, step, decrease


@njit(**OPTIONS)
def bent(columns, blocks, r, probed, probe, step, S, D, curved):
    """The geodesic acceleration, from the errors `probed` a share `probe` of the step away; 0 if it is too large."""
    k, m = columns.shape
    n = len(D)
    n_blocks = max(len(blocks), 1)
    size = m // n_blocks
    curvature, slope, inner = probed - r, np.zeros(n), step
    for b in range(n_blocks):
        part = curvature[b * size : (b + 1) * size]
        if len(blocks) > 0:
            inner = np.empty(k)
            for i in range(k):
                inner[i] = dot(blocks[b, i], step)
        for i in range(k):
            subtract(part, probe * inner[i], columns[i, b * size : (b + 1) * size])
        for i in range(k):
            along = dot(columns[i, b * size : (b + 1) * size], part) / (probe * probe)
            if len(blocks) > 0:
                subtract(slope, along, blocks[b, i])
            else:
                slope[i] -= along
    bend = solved(S, solved_transposed(S, slope))
    of_bend = of_step = 0.0
    for i in range(n):
        of_bend += (D[i] * bend[i]) ** 2
        of_step += (D[i] * step[i]) ** 2
    if 2.0 * math.sqrt(of_bend) <= curved * math.sqrt(of_step):  # NaN is not small
        return bend
    return 0.0 * step
