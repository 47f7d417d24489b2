"""Derivatives of a SympFlow with MLP potentials by its weights. Source text, pasted after `activation_bends`.

What comes before defines `LANES` (points side by side), `VELOCITY` (whether d/dt ψ̄_t counts too) and `activation`. A
`plan` of the networks is d, the number of inputs beside t (coordinates, then constants of a step), the widths of the
hidden layers, and the places of k, w, b_1 …, W_1 … and of the next network in the array of all weights.

With directions e_j of x and the velocity ẋ at the rate 1 of t, dots for derivatives along these,

    a₁ = K x + k t + b₁,  z = σ(a),  a' = W z + b,                V = w · z_n,    r = σ'(a) Wᵀ r',
    z_j = σ' a_j,  ż = σ' ȧ,  ż_j = σ'' a_j ȧ + σ' ȧ_j,           ∂_jV = w · z_j,  d/dt ∂_jV = w · ż_j.

The reverse sweep of w · ż_j meets r for ż_j, ṙ for z_j, A for ż and C for z; that of w · z_j meets r for z_j and A for
z. A state is moved by differences between t and 0. The derivatives P of what is fitted by the state after a layer, and
M by its velocity, are pulled back from layer to layer.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def clear(x):
    """Make all numbers zero: as `x[:] = 0.0` that takes several times as long to compile."""
    flat = x.reshape(-1)
    for i in range(len(flat)):
        flat[i] = 0.0


@njit(**OPTIONS)
def widest(widths):
    most = widths[0]
    for width in widths:
        most = max(most, width)
    return most


@njit(**OPTIONS)
def multiply(theta, plan, level, z, out):
    """out = W z, W the matrix from a level to the next."""
    k, h, first = plan[2][level], plan[2][level + 1], plan[4][level]
    for i in range(h):
        for c in range(LANES):
            out[i, c] = 0.0
        for m in range(k):
            weight = theta[first + i * k + m]
            for c in range(LANES):
                out[i, c] += weight * z[m, c]


@njit(**OPTIONS)
def multiply_transposed(theta, plan, level, r, out):
    """out = Wᵀ r."""
    k, h, first = plan[2][level], plan[2][level + 1], plan[4][level]
    for m in range(k):
        for c in range(LANES):
            out[m, c] = 0.0
    for i in range(h):
        for m in range(k):
            weight = theta[first + i * k + m]
            for c in range(LANES):
                out[m, c] += weight * r[i, c]


@njit(**OPTIONS)
def sweep(theta, plan, x, dx, t, rate, work):
    """z, σ', σ'', σ''', ż, ȧ, and back R = Wᵀr', r, Ṙ = Wᵀṙ', ṙ of all levels, at times t (LANES,)."""
    z, s, u, v, dz = work[0], work[1], work[2], work[3], work[4]
    da, R, r, dR, dr = work[5], work[6], work[7], work[8], work[9]
    inputs, widths, biases, time, out = plan[1], plan[2], plan[3], plan[5], plan[6]
    depth = len(widths)
    for level in range(depth):
        a, h = r[level], widths[level]
        if level == 0:
            for i in range(h):
                k = theta[time + i]
                for c in range(LANES):
                    a[i, c] = k * t[c]
                    da[0, i, c] = k * rate
                for m in range(inputs):
                    weight = theta[i * inputs + m]
                    for c in range(LANES):
                        a[i, c] += weight * x[m, c]
                        if VELOCITY:
                            da[0, i, c] += weight * dx[m, c]
        else:
            multiply(theta, plan, level - 1, z[level - 1], a)
            if VELOCITY:
                multiply(theta, plan, level - 1, dz[level - 1], da[level])
        for i in range(h):
            b = theta[biases[level] + i]
            for c in range(LANES):
                z[level, i, c], s[level, i, c], u[level, i, c], v[level, i, c] = activation(a[i, c] + b)
                if VELOCITY:
                    dz[level, i, c] = s[level, i, c] * da[level, i, c]
    for level in range(depth - 1, -1, -1):
        if level == depth - 1:
            for i in range(widths[level]):
                for c in range(LANES):
                    R[level, i, c] = theta[out + i]
                    dR[level, i, c] = 0.0
        else:
            multiply_transposed(theta, plan, level, r[level + 1], R[level])
            if VELOCITY:
                multiply_transposed(theta, plan, level, dr[level + 1], dR[level])
        for i in range(widths[level]):
            for c in range(LANES):
                r[level, i, c] = R[level, i, c] * s[level, i, c]
                if VELOCITY:
                    bend = R[level, i, c] * u[level, i, c]
                    dr[level, i, c] = bend * da[level, i, c] + dR[level, i, c] * s[level, i, c]


@njit(**OPTIONS)
def add_moved(theta, plan, r, sign, target):
    """target += sign · Kᵀ r."""
    ndof, inputs, widths = plan[0], plan[1], plan[2]
    for i in range(widths[0]):
        for j in range(ndof):
            weight = sign * theta[i * inputs + j]
            for c in range(LANES):
                target[j, c] += weight * r[i, c]


@njit(**OPTIONS)
def add_sensitivities(theta, plan, x, dx, t, rate, sign, work, own, j, G, dG, H, dH):
    """Add sign times the derivatives of ∂_jV and d/dt ∂_jV by the weights to G and dG, by x to H and dH."""
    z, s, u, v, dz = work[0], work[1], work[2], work[3], work[4]
    da, R, r, dR, dr = work[5], work[6], work[7], work[8], work[9]
    inputs, widths, biases, matrices, time, out = plan[1], plan[2], plan[3], plan[4], plan[5], plan[6]
    depth = len(widths)
    aj, daj, zj, dzj, A, C, RA, RC = own
    for level in range(depth):
        h = widths[level]
        if level == 0:
            for i in range(h):
                for c in range(LANES):
                    aj[0, i, c] = theta[i * inputs + j]
                    daj[0, i, c] = 0.0
        else:
            multiply(theta, plan, level - 1, zj[level - 1], aj[level])
            if VELOCITY:
                multiply(theta, plan, level - 1, dzj[level - 1], daj[level])
        for i in range(h):
            for c in range(LANES):
                zj[level, i, c] = s[level, i, c] * aj[level, i, c]
                if VELOCITY:
                    bend = u[level, i, c] * aj[level, i, c] * da[level, i, c]
                    dzj[level, i, c] = bend + s[level, i, c] * daj[level, i, c]
    for level in range(depth - 1, -1, -1):
        h = widths[level]
        for i in range(h):
            for c in range(LANES):
                bend = u[level, i, c] * aj[level, i, c]
                A[i, c] = R[level, i, c] * bend
                if level < depth - 1:
                    A[i, c] += RA[i, c] * s[level, i, c]
                if VELOCITY:
                    twist = v[level, i, c] * aj[level, i, c] * da[level, i, c] + u[level, i, c] * daj[level, i, c]
                    C[i, c] = R[level, i, c] * twist + dR[level, i, c] * bend
                    if level < depth - 1:
                        C[i, c] += RA[i, c] * u[level, i, c] * da[level, i, c] + RC[i, c] * s[level, i, c]
        for i in range(h):
            at = biases[level] + i
            for c in range(LANES):
                G[at, c] += sign * A[i, c]
                if VELOCITY:
                    dG[at, c] += sign * C[i, c]
        if level > 0:
            k, first, below = widths[level - 1], matrices[level - 1], level - 1
            for i in range(h):
                for m in range(k):
                    at = first + i * k + m
                    for c in range(LANES):
                        G[at, c] += sign * (r[level, i, c] * zj[below, m, c] + A[i, c] * z[below, m, c])
                        if VELOCITY:
                            back = r[level, i, c] * dzj[below, m, c] + A[i, c] * dz[below, m, c]
                            back += dr[level, i, c] * zj[below, m, c] + C[i, c] * z[below, m, c]
                            dG[at, c] += sign * back
            multiply_transposed(theta, plan, below, A, RA)
            if VELOCITY:
                multiply_transposed(theta, plan, below, C, RC)
    for i in range(widths[0]):
        for m in range(inputs):
            at = i * inputs + m
            for c in range(LANES):
                G[at, c] += sign * A[i, c] * x[m, c]
                if VELOCITY:
                    dG[at, c] += sign * (C[i, c] * x[m, c] + A[i, c] * dx[m, c])
        for c in range(LANES):
            G[i * inputs + j, c] += sign * r[0, i, c]
            G[time + i, c] += sign * A[i, c] * t[c]
            if VELOCITY:
                dG[i * inputs + j, c] += sign * dr[0, i, c]
                dG[time + i, c] += sign * (C[i, c] * t[c] + A[i, c] * rate)
    for i in range(widths[depth - 1]):
        for c in range(LANES):
            G[out + i, c] += sign * zj[depth - 1, i, c]
            if VELOCITY:
                dG[out + i, c] += sign * dzj[depth - 1, i, c]
    add_moved(theta, plan, A, sign, H)
    if VELOCITY:
        add_moved(theta, plan, C, sign, dH)


@njit(**OPTIONS)
def pull_back(ndof, P, M, sign, is_kick, H, dH):
    """P and M (2d, 2d, LANES) by the state before a kick or a drift, from those by the state after it."""
    old, new = (ndof, 0) if is_kick else (0, ndof)
    for row in range(2 * ndof):
        for m in range(ndof):
            for j in range(ndof):
                for c in range(LANES):
                    P[row, new + m, c] += sign * P[row, old + j, c] * H[j, m, c]
                    if VELOCITY:
                        P[row, new + m, c] += sign * M[row, old + j, c] * dH[j, m, c]
                        M[row, new + m, c] += sign * M[row, old + j, c] * H[j, m, c]


@njit(**OPTIONS)
def forward(theta, plan, is_kick, t, start, states, zeros, work):
    """The states [x, ẋ] before each layer and after the last into `states` (L + 1, 4, inputs, LANES): q, p, q̇, ṗ."""
    inputs, size = plan[1], plan[7]
    first, given = states[0].reshape(-1), start.reshape(-1)
    for i in range(len(given)):
        first[i] = given[i]
    for layer in range(len(is_kick)):
        before, after = states[layer], states[layer + 1]
        for block in range(4):
            for m in range(inputs):
                for c in range(LANES):
                    after[block, m, c] = before[block, m, c]
        x, target = (0, 1) if is_kick[layer] else (1, 0)
        sign = -1.0 if is_kick[layer] else 1.0
        weights = theta[layer * size : (layer + 1) * size]
        for side in range(2):
            sweep(weights, plan, before[x], before[2 + x], t if side == 0 else zeros, 1.0 - side, work)
            add_moved(weights, plan, work[7][0], sign, after[target])
            if VELOCITY:
                add_moved(weights, plan, work[9][0], sign, after[2 + target])
            sign = -sign


@njit(**OPTIONS)
def load(plan, block, t, x, features, t_lanes, start):
    """The times and states of a block of points into lanes; spare lanes repeat the last point."""
    ndof, inputs = plan[0], plan[1]
    N = len(t)
    for c in range(LANES):
        point = min(block * LANES + c, N - 1)
        t_lanes[c] = t[point]
        for half in range(2):
            for m in range(ndof):
                start[half, m, c] = x[point, half * ndof + m]
            for m in range(inputs - ndof):
                start[half, ndof + m, c] = features[m, point]


@njit(**OPTIONS)
def map_points(theta, plan, is_kick, t, x, features, first, last, y, velocity):
    """ψ̄_t(x) and d/dt ψ̄_t(x) of blocks `first` … `last` of points, into y and velocity (N, 2d)."""
    ndof, inputs, widths = plan[0], plan[1], plan[2]
    depth, width = len(widths), widest(widths)
    work, zeros, t_lanes = np.zeros((10, depth, width, LANES)), np.zeros(LANES), np.zeros(LANES)
    start, states = np.zeros((4, inputs, LANES)), np.zeros((len(is_kick) + 1, 4, inputs, LANES))
    for block in range(first, last):
        load(plan, block, t, x, features, t_lanes, start)
        forward(theta, plan, is_kick, t_lanes, start, states, zeros, work)
        end = states[len(is_kick)]
        for c in range(min(LANES, len(t) - block * LANES)):
            point = block * LANES + c
            for half in range(2):
                for m in range(ndof):
                    y[point, half * ndof + m] = end[half, m, c]
                    if VELOCITY:
                        velocity[point, half * ndof + m] = end[2 + half, m, c]


@njit(**OPTIONS)
def differentiate(theta, plan, is_kick, t, x, features, first, last, units, by_state, by_velocity, J, by_start):
    """The derivatives of what is fitted by the weights, J (n, 2d, N), of blocks `first` … `last` of points.

    ``by_state`` (N, 2d, 2d) and ``by_velocity`` (2d,) are its derivatives by ψ̄ and, one by one, by d/dt ψ̄; `units`
    (n,) those of `theta` by the weights. Its derivatives by x go into ``by_start`` (2d, 2d, N) unless that is empty.
    """
    ndof, inputs, widths, size = plan[0], plan[1], plan[2], plan[7]
    depth, width = len(widths), widest(widths)
    work, zeros, t_lanes = np.zeros((10, depth, width, LANES)), np.zeros(LANES), np.zeros(LANES)
    levels = np.zeros((4, depth, width, LANES))
    flat = np.zeros((4, width, LANES))
    own = levels[0], levels[1], levels[2], levels[3], flat[0], flat[1], flat[2], flat[3]
    start, states = np.zeros((4, inputs, LANES)), np.zeros((len(is_kick) + 1, 4, inputs, LANES))
    P, M = np.zeros((2 * ndof, 2 * ndof, LANES)), np.zeros((2 * ndof, 2 * ndof, LANES))
    G, dG = np.zeros((ndof, size, LANES)), np.zeros((ndof, size, LANES))
    H, dH = np.zeros((ndof, ndof, LANES)), np.zeros((ndof, ndof, LANES))
    total = np.zeros(LANES)
    for block in range(first, last):
        load(plan, block, t, x, features, t_lanes, start)
        forward(theta, plan, is_kick, t_lanes, start, states, zeros, work)
        begin, count = block * LANES, min(LANES, len(t) - block * LANES)
        for row in range(2 * ndof):
            for m in range(2 * ndof):
                for c in range(LANES):
                    P[row, m, c] = by_state[min(begin + c, len(t) - 1), row, m]
                    M[row, m, c] = by_velocity[row] if m == row else 0.0
        for layer in range(len(is_kick) - 1, -1, -1):
            before, weights = states[layer], theta[layer * size : (layer + 1) * size]
            source, old = (0, ndof) if is_kick[layer] else (1, 0)
            sign = -1.0 if is_kick[layer] else 1.0
            clear(G)
            clear(dG)
            clear(H)
            clear(dH)
            for side in range(2):
                times, rate, share = (t_lanes, 1.0, 1.0) if side == 0 else (zeros, 0.0, -1.0)
                sweep(weights, plan, before[source], before[2 + source], times, rate, work)
                for j in range(ndof):
                    add_sensitivities(
                        weights, plan, before[source], before[2 + source], times, rate, share, work, own, j,
                        G[j], dG[j], H[j], dH[j],
                    )  # fmt: skip
            for i in range(size):
                unit = sign * units[layer * size + i]
                for row in range(2 * ndof):
                    for c in range(LANES):
                        total[c] = 0.0
                    for j in range(ndof):
                        for c in range(LANES):
                            total[c] += P[row, old + j, c] * G[j, i, c]
                            if VELOCITY:
                                total[c] += M[row, old + j, c] * dG[j, i, c]
                    target = J[layer * size + i, row]
                    for c in range(count):
                        target[begin + c] = unit * total[c]
            pull_back(ndof, P, M, sign, is_kick[layer], H, dH)
        for row in range(len(by_start)):
            for m in range(2 * ndof):
                for c in range(count):
                    by_start[row, m, begin + c] = P[row, m, c]
