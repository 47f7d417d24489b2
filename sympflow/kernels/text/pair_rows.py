"""Forces of bodies in pairs at many states, and their derivatives along directions. Source text.

Pasted after `slopes(i, j, s, sites, values)`, the first three derivatives of V by s with factors 2, 4 and 8: see
`sympflow.kernels.pair_forces`. Directions (K, d) of a state stand as (d, K), so that the loops over them become vector
instructions.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def met(i, j, q, sites, values, d):
    """The differences d of the coordinates of two bodies, and the derivatives of V, 0 beyond the cut-off."""
    s = values[0]
    for k in range(DIM):
        d[k] = q[i * DIM + k] - q[j * DIM + k]
        if PERIODIC:
            d[k] -= values[2 + k] * math.floor(d[k] / values[2 + k] + 0.5)
        s += d[k] * d[k]
    if CUT and s >= values[1]:
        return 0.0, 0.0, 0.0
    return slopes(i, j, s, sites, values)


@njit(**OPTIONS)
def force_rows(Q, sites, values, has_gradient, F, G):
    """F = −∇V, and G = ∇²V M⁻¹∇V where it is asked for, at states Q (P, d)."""
    d = np.empty(DIM)
    for state in range(Q.shape[0]):
        q, f, g = Q[state], F[state], G[state]
        f[:] = 0.0
        n = len(q) // DIM
        for i in range(n):
            for j in range(i + 1, n):
                first, _, _ = met(i, j, q, sites, values, d)
                for k in range(DIM):
                    f[i * DIM + k] -= first * d[k]
                    f[j * DIM + k] += first * d[k]
        if not has_gradient:
            continue
        g[:] = 0.0
        for i in range(n):
            for j in range(i + 1, n):
                first, second, _ = met(i, j, q, sites, values, d)
                along = 0.0
                for k in range(DIM):
                    along += d[k] * (sites[k, j] * f[j * DIM + k] - sites[k, i] * f[i * DIM + k])
                for k in range(DIM):
                    u = sites[k, j] * f[j * DIM + k] - sites[k, i] * f[i * DIM + k]
                    h = second * along * d[k] + first * u
                    g[i * DIM + k] += h
                    g[j * DIM + k] -= h


@njit(**OPTIONS)
def product_rows(Q, F, W, sites, values, has_gradient, DF, DG):
    """The derivatives of F and of G along directions W (P, d, K), with F at the states Q (P, d)."""
    d, a = np.empty(DIM), np.empty(DIM)
    K = W.shape[2]
    along, across = np.empty(K), np.empty(K)
    for state in range(Q.shape[0]):
        q, f, w, df, dg = Q[state], F[state], W[state], DF[state], DG[state]
        df[:] = 0.0
        dg[:] = 0.0
        n = len(q) // DIM
        for i in range(n):
            for j in range(i + 1, n):
                first, second, third = met(i, j, q, sites, values, d)
                along[:] = 0.0
                across[:] = 0.0
                da = 0.0
                for k in range(DIM):
                    a[k] = sites[k, j] * f[j * DIM + k] - sites[k, i] * f[i * DIM + k]
                    da += d[k] * a[k]
                    wi, wj = w[i * DIM + k], w[j * DIM + k]
                    for m in range(K):
                        u = wi[m] - wj[m]
                        along[m] += d[k] * u
                        across[m] += a[k] * u
                for k in range(DIM):
                    wi, wj, fi, fj = w[i * DIM + k], w[j * DIM + k], df[i * DIM + k], df[j * DIM + k]
                    for m in range(K):
                        h = second * along[m] * d[k] + first * (wi[m] - wj[m])
                        fi[m] -= h
                        fj[m] += h
                    if has_gradient:
                        gi, gj = dg[i * DIM + k], dg[j * DIM + k]
                        for m in range(K):
                            u = wi[m] - wj[m]
                            h = (third * da * along[m] + second * across[m]) * d[k]
                            h += second * (along[m] * a[k] + da * u)
                            gi[m] += h
                            gj[m] -= h
        if not has_gradient:
            continue
        for i in range(n):
            for j in range(i + 1, n):
                first, second, _ = met(i, j, q, sites, values, d)
                along[:] = 0.0
                for k in range(DIM):
                    fi, fj = df[i * DIM + k], df[j * DIM + k]
                    for m in range(K):
                        along[m] += d[k] * (sites[k, j] * fj[m] - sites[k, i] * fi[m])
                for k in range(DIM):
                    fi, fj, gi, gj = df[i * DIM + k], df[j * DIM + k], dg[i * DIM + k], dg[j * DIM + k]
                    for m in range(K):
                        u = sites[k, j] * fj[m] - sites[k, i] * fi[m]
                        h = second * along[m] * d[k] + first * u
                        gi[m] += h
                        gj[m] -= h
