"""The algebra of Newton's iteration for Gauss methods. Source text for `newton`, which systems share, compiled.

What comes before defines `NDOF`, `COMPENSATED`, the tableau `A`, `B`, `C` and `SCALE` of `STAGES` stages as tuples, and
the `RATES` of friction, one for each p, none without.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

SIZE = 2 * NDOF
SMALLEST = 1e-150  # of a size whose reciprocal is multiplied by other numbers
DAMPED = len(RATES) > 0


@njit(**OPTIONS)
def copy_numbers(source, target):
    """target[:] = source, which so written takes Numba long to compile."""
    for m in range(len(source)):
        target[m] = source[m]


@njit(**OPTIONS)
def workspace():
    n = STAGES * SIZE
    growth = np.ones((STAGES, NDOF))
    state, S = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    return np.zeros(n), np.zeros(n), np.zeros((n, n)), state, np.zeros(SIZE), S, growth, np.ones(n)


@njit(**OPTIONS)
def fill_sizes(y, K, change, sizes):
    """The reciprocal size of each unknown (n,): of its variable, or of the largest of its kind where that is 0."""
    for part in range(2):
        top = 0.0
        for m in range(part * NDOF, (part + 1) * NDOF):
            sizes[m] = abs(y[m])
            for i in range(STAGES):
                sizes[m] = max(sizes[m], abs(K[i * SIZE + m]), abs(change[i * SIZE + m]))
            top = max(top, sizes[m])
        for m in range(part * NDOF, (part + 1) * NDOF):
            size = sizes[m] if sizes[m] > 0.0 else top
            for i in range(STAGES):
                sizes[i * SIZE + m] = 1.0 / max(size, SMALLEST) if size > 0.0 else 1.0


@njit(**OPTIONS)
def solve_in_place(M, x, sizes):
    """M⁻¹x into x by Gaussian elimination; M is overwritten. False if a pivot vanishes.

    Pivots are the largest of their column in units of the sizes of the unknowns, whose reciprocals `sizes` go along.
    """
    n = len(x)
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(M[i, k]) * sizes[i] > abs(M[pivot, k]) * sizes[pivot]:
                pivot = i
        if not abs(M[pivot, k]) > 0.0:
            return False
        if pivot != k:
            for j in range(k, n):
                M[k, j], M[pivot, j] = M[pivot, j], M[k, j]
            x[k], x[pivot] = x[pivot], x[k]
            sizes[k], sizes[pivot] = sizes[pivot], sizes[k]
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
def fill_growth(h, growth):
    """e^{γτ} at the stages of a step of length h."""
    for i in range(STAGES):
        for m in range(NDOF):
            growth[i, m] = math.exp(RATES[m] * C[i] * h)


@njit(**OPTIONS)
def scale_slopes(g, S, growth):
    """∇H and ∇²H at (q, p) into those of [q, P] as the equations hold them: rows e^{γτ} ∂H/∂q, columns ∂p/∂P."""
    for m in range(NDOF):
        g[m] *= growth[m]
        for n in range(NDOF):
            S[m, n] *= growth[m]
            S[m, NDOF + n] *= growth[m] / growth[n]
            S[NDOF + m, NDOF + n] /= growth[n]


@njit(**OPTIONS)
def advance(y, h, error, K):
    """y + Σ b_i K_i in place, if `COMPENSATED` by Kahan's compensated sum; a damped p decays over h.

    True if the result is finite.
    """
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
        if DAMPED and m >= NDOF:
            y[m] *= math.exp(-RATES[m - NDOF] * h)
        total += 0.0 * y[m]
    return total == 0.0
