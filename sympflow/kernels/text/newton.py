"""The loops of an implicit Gauss method: Newton's iteration, a step, a run. Source text for `implicit`.

What comes before defines `NDOF`, `COMPENSATED`, the tableau `A`, `B`, `C` and `SCALE` of `STAGES` stages as tuples, and
the system's ``gradient_and_hessian(y, g, S, t)``, which leaves the entries of S that are always zero as they are; and
the `RATES` of friction, one for each p, none without.

The unknowns are K_i = h SCALE_i f(y + Σ_j A_ij K_j), in which the coefficients are exact where it matters for the long
run, and y + Σ B_i K_i needs no further evaluation of f.

With friction they are those of q and P = e^{γτ}p, τ from the beginning of the step.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

SIZE = 2 * NDOF
DAMPED = len(RATES) > 0
TOLERANCE = 1e-11  # of a relative increment: convergence is quadratic, so what is left is below rounding
ROUNDING = 1e-9  # increments below this that no longer shrink are rounding
MOST_ITERATIONS = 50


@njit(**OPTIONS)
def workspace():
    n = STAGES * SIZE
    growth = np.ones((STAGES, NDOF))
    return np.zeros(n), np.zeros(n), np.zeros((n, n)), np.zeros(SIZE), np.zeros(SIZE), np.zeros((SIZE, SIZE)), growth


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
def scale_slopes(g, S, growth):
    """∇H and ∇²H at (q, p) into those of [q, P] as the equations hold them: rows e^{γτ} ∂H/∂q, columns ∂p/∂P."""
    for m in range(NDOF):
        g[m] *= growth[m]
        for n in range(NDOF):
            S[m, n] *= growth[m]
            S[m, NDOF + n] *= growth[m] / growth[n]
            S[NDOF + m, NDOF + n] /= growth[n]


@njit(**OPTIONS)
def stages(y, h, t, work):
    """The K of a step of length h from y, at the time t, by Newton's iteration from 0.

    Returns the iterations taken, negative if in vain.
    """
    K, change, M, Y, g, S, growth = work
    K[:] = 0.0
    if DAMPED:
        for i in range(STAGES):
            for m in range(NDOF):
                growth[i, m] = math.exp(RATES[m] * C[i] * h)
    before = np.inf
    for iteration in range(1, MOST_ITERATIONS + 1):
        for i in range(STAGES):
            row = i * SIZE
            for m in range(SIZE):
                Y[m] = y[m]
                for j in range(STAGES):
                    Y[m] += A[i][j] * K[j * SIZE + m]
            if DAMPED:
                for m in range(NDOF):
                    Y[NDOF + m] /= growth[i, m]
            gradient_and_hessian(Y, g, S, t + C[i] * h)
            if DAMPED:
                scale_slopes(g, S, growth[i])
            for m in range(SIZE):
                sign = 1.0 if m < NDOF else -1.0  # J∇H = (∂H/∂p, −∂H/∂q)
                other = m + NDOF if m < NDOF else m - NDOF
                change[row + m] = K[row + m] - h * sign * SCALE[i] * g[other]
                for j in range(STAGES):
                    factor = h * sign * SCALE[i] * A[i][j]
                    for n in range(SIZE):
                        M[row + m, j * SIZE + n] = -factor * S[other, n]
                M[row + m, row + m] += 1.0
        if not solve_in_place(M, change):
            return -iteration
        for m in range(len(K)):
            K[m] -= change[m]
        size = relative_size(change, y, K)
        if size <= TOLERANCE or (size <= ROUNDING and size >= 0.5 * before):
            return iteration
        if not size < np.inf:
            return -iteration
        before = size
    return -MOST_ITERATIONS


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


@njit(**OPTIONS)
def rollout(h, t0, y0, n_steps, save, out, work, stop, first, running):
    """`n_steps` steps from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``; later rows are NaN.

    Where `first` steps are made already, it goes on from the `running` state (2d or, if `COMPENSATED`, 4d), which is
    written at the end unless it is empty.

    Returns the index of the last step that was solved and ends in a finite state, and the iterations taken. Ends early,
    with rows unset, when another thread sets ``stop[0]``.
    """
    y, error = y0.copy(), np.zeros(SIZE)
    if first > 0:
        y[:] = running[:SIZE]
        if COMPENSATED:
            error[:] = running[SIZE:]
    saved = iterations = 0
    while saved < len(save) and save[saved] <= 0:
        out[saved] = y
        saved += 1
    for n in range(first + 1, n_steps + 1):
        if stop[0] != 0:
            break
        taken = stages(y, h, t0 + (n - 1) * h, work)
        iterations += abs(taken)
        if taken < 0 or not advance(y, h, error, work[0]):
            out[saved:] = np.nan
            running[:] = np.nan
            return n - 1, iterations
        while saved < len(save) and save[saved] == n:
            out[saved] = y
            saved += 1
    if len(running) > 0:
        running[:SIZE] = y
        if COMPENSATED:
            running[SIZE:] = error
    return n_steps, iterations


@njit(**OPTIONS)
def rollout_each(h, t0, y0, n_steps, save, out, n_finite, iterations, stop, first, running):
    """`rollout` of every row of `y0` (N, 2d)."""
    work = workspace()
    for i in range(y0.shape[0]):
        n_finite[i], iterations[i] = rollout(h, t0, y0[i], n_steps, save, out[i], work, stop, first, running[i])


@njit(**OPTIONS)
def step_each(h, t, y, out, iterations):
    """One step of length ``h[i]`` from every row of `y` (N, 2d), at the time ``t[i]``; NaN where it has no solution."""
    work, error = workspace(), np.zeros(SIZE)
    for i in range(y.shape[0]):
        out[i] = y[i]
        taken = stages(y[i], h[i], t[i], work)
        iterations[i] = abs(taken)
        error[:] = 0.0
        if taken < 0 or not advance(out[i], h[i], error, work[0]):
            out[i] = np.nan
