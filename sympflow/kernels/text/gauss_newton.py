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
def factored(J, r, scale):
    """The triangle R (n + 1, n + 1) of [J r], J (n, m) by columns, and the larger of `scale` (n,) and their norms."""
    n, m = J.shape
    R, columns = np.zeros((n + 1, n + 1)), np.empty((n + 1, m))
    for i in range(n):
        for j in range(m):
            columns[i, j] = J[i, j]
    for j in range(m):
        columns[n, j] = r[j]
    for first in range(0, m, CHUNK):
        fold(R, columns, first, min(first + CHUNK, m), False)
    larger = np.empty(n)
    for i in range(n):
        square = 0.0
        for k in range(i + 1):
            square += R[k, i] * R[k, i]
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
def bent(J, r, probed, probe, step, S, D, curved):
    """The geodesic acceleration, from the errors `probed` a share `probe` of the step away; 0 if it is too large."""
    n = len(J)
    curvature = probed - r
    for i in range(n):
        subtract(curvature, probe * step[i], J[i])
    slope = np.empty(n)
    for i in range(n):
        slope[i] = -dot(J[i], curvature) / (probe * probe)
    bend = solved(S, solved_transposed(S, slope))
    of_bend = of_step = 0.0
    for i in range(n):
        of_bend += (D[i] * bend[i]) ** 2
        of_step += (D[i] * step[i]) ** 2
    if 2.0 * math.sqrt(of_bend) <= curved * math.sqrt(of_step):  # NaN is not small
        return bend
    return 0.0 * step
