"""The loops of an implicit Gauss method: Newton's iteration, a step, a run. Source text for `implicit`.

What comes before are the text `newton_steps` and the system's ``gradient_and_hessian(y, g, S, t)``, which leaves the
entries of S that are always zero as they are.

The unknowns are K_i = h SCALE_i f(y + Σ_j A_ij K_j), in which the coefficients are exact where it matters for the long
run, and y + Σ B_i K_i needs no further evaluation of f.

With friction they are those of q and P = e^{γτ}p, τ from the beginning of the step.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

TOLERANCE = 1e-11  # of a relative increment: convergence is quadratic, so what is left is below rounding
ROUNDING = 1e-9  # increments below this that no longer shrink are rounding
MOST_ITERATIONS = 50


@njit(**OPTIONS)
def stages(y, h, t, work):
    """The K of a step of length h from y, at the time t, by Newton's iteration from 0.

    Returns the iterations taken, negative if in vain.
    """
    K, change, M, Y, g, S, growth, sizes = work
    for m in range(len(K)):
        K[m] = 0.0
    if DAMPED:
        fill_growth(h, growth)
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
        fill_sizes(y, K, change, sizes)
        if not solve_in_place(M, change, sizes):
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
def rollout_one(h, t0, y0, n_steps, save, out, work, stop, first, running):
    """`n_steps` steps from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``; later rows are NaN.

    Where `first` steps are made already, it goes on from the `running` state (2d or, if `COMPENSATED`, 4d), which is
    written at the end unless it is empty.

    Returns the index of the last step that was solved and ends in a finite state, and the iterations taken. Ends early,
    with rows unset, when another thread sets ``stop[0]``.
    """
    y, error = np.empty(SIZE), np.zeros(SIZE)
    copy_numbers(y0, y)
    if first > 0:
        copy_numbers(running[:SIZE], y)
        if COMPENSATED:
            copy_numbers(running[SIZE:], error)
    saved = iterations = 0
    while saved < len(save) and save[saved] <= 0:
        copy_numbers(y, out[saved])
        saved += 1
    for n in range(first + 1, n_steps + 1):
        if stop[0] != 0:
            break
        taken = stages(y, h, t0 + (n - 1) * h, work)
        iterations += abs(taken)
        if taken < 0 or not advance(y, h, error, work[0]):
            fill_with_nan(out, saved)
            set_nan(running)
            return n - 1, iterations
        while saved < len(save) and save[saved] == n:
            copy_numbers(y, out[saved])
            saved += 1
    if len(running) > 0:
        copy_numbers(y, running[:SIZE])
        if COMPENSATED:
            copy_numbers(error, running[SIZE:])
    return n_steps, iterations


@njit(**OPTIONS)
def rollout_each(h, t0, y0, n_steps, save, out, n_finite, iterations, stop, first, running):
    """`rollout_one` of every row of `y0` (N, 2d)."""
    work = workspace()
    for i in range(y0.shape[0]):
        n_finite[i], iterations[i] = rollout_one(h, t0, y0[i], n_steps, save, out[i], work, stop, first, running[i])


@njit(**OPTIONS)
def step_each(h, t, y, out, iterations):
    """One step of length ``h[i]`` from every row of `y` (N, 2d), at the time ``t[i]``; NaN where it has no solution."""
    work, error = workspace(), np.zeros(SIZE)
    for i in range(y.shape[0]):
        copy_numbers(y[i], out[i])
        taken = stages(y[i], h[i], t[i], work)
        iterations[i] = abs(taken)
        for m in range(SIZE):
            error[m] = 0.0
        if taken < 0 or not advance(out[i], h[i], error, work[0]):
            set_nan(out[i])
