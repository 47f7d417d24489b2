"""The loops of a SympFlow with MLP potentials: its map, a run. Source text, pasted after `activations` and `aligned`.

What comes before defines `NDOF`, `DEPTH` (hidden layers), `WIDTH` (of each, narrower ones padded with zero weights),
`CHUNK` (a divisor of it), `STATES` (how many states go side by side) and `activation`.

A layer adds ∓(∇V(t, x) − ∇V(0, x)) to p or to q. V(t, ·) and V(0, ·) share K x and then run side by side through

    a₁ = K x + b₁ (+ k t),  z_l = σ(a_l),  a_{l+1} = W_l z_l + b_{l+1},      V = w · z_n,
    r_n = w σ'(a_n),  r_l = σ'(a_l) W_lᵀ r_{l+1},                          ∇V = Kᵀ r₁,

so a feature is a row of 2·STATES columns, t before 0, all rows in one flat array: loops over it become vector
instructions, for one state as for many. Constant bounds let the compiler unroll the products.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

COLUMNS = 2 * STATES
PADDED = (WIDTH * COLUMNS + 7) // 8 * 8  # whole vectors


@njit(**OPTIONS, inline="always")  # twice as fast for one state: what the arrays are is known then
def multiply(M, z, start, out):
    """out = M z + start, the vector `start` added to every column."""
    for i in range(WIDTH):
        for chunk in range(0, WIDTH, CHUNK):
            for c in range(COLUMNS):
                total = start[i] if chunk == 0 else out[i * COLUMNS + c]
                for k in range(CHUNK):
                    total += M[i, chunk + k] * z[(chunk + k) * COLUMNS + c]
                out[i * COLUMNS + c] = total


@njit(**OPTIONS, inline="always")
def add_impulse(x, t, sign, target, weights, scratch):
    """target += sign · (∇V(t, x) − ∇V(0, x)) with the weights of one layer; x and target are (NDOF · STATES,)."""
    K, k, b, W, W_transposed, w = weights
    z, r, slopes = scratch
    for i in range(WIDTH):
        for s in range(STATES):
            a = b[0, i]
            for j in range(NDOF):
                a += K[j, i] * x[j * STATES + s]
            r[i * COLUMNS + s] = a + k[i] * t[s]
            r[i * COLUMNS + STATES + s] = a
    for m in range(PADDED):
        z[m], slopes[0, m] = activation(r[m])
    for layer in range(1, DEPTH):
        multiply(W[layer - 1], z, b[layer], r)
        for m in range(PADDED):
            z[m], slopes[layer, m] = activation(r[m])
    for i in range(WIDTH):
        for c in range(COLUMNS):
            r[i * COLUMNS + c] = w[i] * slopes[DEPTH - 1, i * COLUMNS + c]
    for layer in range(DEPTH - 2, -1, -1):
        multiply(W_transposed[layer], r, b[DEPTH], z)
        for m in range(PADDED):
            r[m] = z[m] * slopes[layer, m]
    for j in range(NDOF):
        for s in range(STATES):
            total = 0.0
            for i in range(WIDTH):
                total += K[j, i] * (r[i * COLUMNS + s] - r[i * COLUMNS + STATES + s])
            target[j * STATES + s] += sign * total


@njit(**OPTIONS)
def psi(q, p, t, backwards, weights, scratch):
    """ψ̄_t of the states (NDOF · STATES,), or its inverse, in place; a time t for each."""
    is_kick, K, k, b, W, W_transposed, w = weights
    for n in range(len(is_kick)):
        i = len(is_kick) - 1 - n if backwards else n
        x, target = (q, p) if is_kick[i] else (p, q)
        sign = 1.0 if is_kick[i] == backwards else -1.0
        layer = K[i], k[i], b[i], W[i], W_transposed[i], w[i]
        add_impulse(x, t, sign, target, layer, scratch)


@njit(**OPTIONS)
def is_finite(q, p, s):
    total = 0.0
    for j in range(NDOF):
        total += 0.0 * q[j * STATES + s] + 0.0 * p[j * STATES + s]
    return total == 0.0


@njit(**OPTIONS)
def store(q, p, s, row):
    for j in range(NDOF):
        row[j], row[NDOF + j] = q[j * STATES + s], p[j * STATES + s]


@njit(**OPTIONS)
def rollout(weights, backwards, t_steps, y0, n_steps, save, out, n_finite, stop, begin, running):
    """`n_steps` steps of ``t_steps[i] ≥ 0`` from ``y0[i]``, the states after ``save[j]`` steps into ``out[i, j]``.

    Where `begin` steps are made already, they go on from ``running[i]``, which is written at the end unless it is
    empty.

    ``n_finite[i]`` is the last step that ends in a finite state; rows of later steps are NaN. Ends early when
    another thread sets ``stop[0]``.
    """
    q, p, t = aligned_zeros(NDOF * STATES), aligned_zeros(NDOF * STATES), aligned_zeros(STATES)
    scratch = aligned_zeros(PADDED), aligned_zeros(PADDED), aligned_zeros(DEPTH * PADDED).reshape((DEPTH, PADDED))
    for first in range(0, y0.shape[0], STATES):
        count = min(STATES, y0.shape[0] - first)
        for s in range(STATES):
            i = first + min(s, count - 1)  # spare places repeat the last state
            t[s] = t_steps[i]
            row = running[i] if begin > 0 else y0[i]
            for j in range(NDOF):
                q[j * STATES + s], p[j * STATES + s] = row[j], row[NDOF + j]
            n_finite[i] = n_steps
        n_alive = count
        saved = 0
        for n in range(begin, n_steps + 1):
            if n > begin:
                psi(q, p, t, backwards, weights, scratch)
                for s in range(count):
                    if n_finite[first + s] == n_steps and not is_finite(q, p, s):
                        n_finite[first + s] = n - 1
                        n_alive -= 1
            while saved < len(save) and save[saved] == n:
                for s in range(count):
                    if n_finite[first + s] >= n:
                        store(q, p, s, out[first + s, saved])
                    else:
                        out[first + s, saved] = np.nan
                saved += 1
            if n_alive == 0 or stop[0] != 0:
                break
        out[first : first + count, saved:] = np.nan
        if running.shape[1] > 0:
            for s in range(count):
                if n_finite[first + s] == n_steps:
                    store(q, p, s, running[first + s])
                else:
                    running[first + s] = np.nan
