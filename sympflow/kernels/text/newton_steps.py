"""The algebra of Newton's iteration for Gauss methods. Source text for `newton`, which systems share, compiled.

What comes before defines `NDOF`, `COMPENSATED`, and the tableau `A`, `B`, `C` and `SCALE` of `STAGES` stages as tuples.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

SIZE = 2 * NDOF


@njit(**OPTIONS)
def copy_numbers(source, target):
    """target[:] = source, which so written takes Numba long to compile."""
    for m in range(len(source)):
        target[m] = source[m]


@njit(**OPTIONS)
def workspace():
    n = STAGES * SIZE
    return np.zeros(n), np.zeros(n), np.zeros((n, n)), np.zeros(SIZE), np.zeros(SIZE), np.zeros((SIZE, SIZE))


@njit(**OPTIONS)
def solve_in_place(M, x):
    """M⁻¹x into x by Gaussian elimination with partial pivoting; M is overwritten. False if a pivot vanishes."""
    n = len(x)
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(M[i, k]) > abs(M[pivot, k]):
                pivot = i
        if not abs(M[pivot, k]) > 0.0:
            return False
        if pivot != k:
            for j in range(k, n):
                M[k, j], M[pivot, j] = M[pivot, j], M[k, j]
            x[k], x[pivot] = x[pivot], x[k]
        for i in range(k + 1, n):
            factor = M[i, k] / M[k, k]
            if factor != 0.0:
                for j in range(k + 1, n):
                    M[i, j] -= factor * M[k, j]
                x[i] -= factor * x[k]
    for k in range(n - 1, -1, -1):
        total = x[k]
        for j in range(k + 1, n):
            total -= M[k, j] * x[j]
        x[k] = total / M[k, k]
    return True


@njit(**OPTIONS)
def relative_size(change, y, K):
    """The largest of ‖Δq‖/(‖q‖ + ‖K_q‖) and ‖Δp‖/(‖p‖ + ‖K_p‖), maxima over components and stages; NaN stays NaN."""
    worst = 0.0
    for part in range(2):
        top, scale = 0.0, 0.0
        for m in range(part * NDOF, (part + 1) * NDOF):
            largest = 0.0
            for i in range(STAGES):
                value = abs(change[i * SIZE + m])
                if not value <= top:
                    top = value
                largest = max(largest, abs(K[i * SIZE + m]))
            scale = max(scale, abs(y[m]) + largest)
        ratio = 0.0 if top == 0.0 else top / scale
        if not ratio <= worst:
            worst = ratio
    return worst


@njit(**OPTIONS)
def advance(y, error, K):
    """y + Σ b_i K_i in place; if `COMPENSATED` by Kahan's compensated sum. True if the result is finite."""
    total = 0.0
    for m in range(SIZE):
        change = 0.0
        for i in range(STAGES):
            change += B[i] * K[i * SIZE + m]
        if COMPENSATED:
            change -= error[m]
            new = y[m] + change
            error[m] = (new - y[m]) - change
            y[m] = new
        else:
            y[m] += change
        total += 0.0 * y[m]
    return total == 0.0
