"""States as arrays, changed in place: systems given by Numba functions, or of many terms.

Source text for `loops`. What comes before defines the constants of `loops`, the system's ``gradient_at(q, numbers,
out)`` and ``hessian_vector_at(q, v, numbers, out)``, and ``apply_inverse_mass(v, out, work)``; where kicks have
curvature terms or polynomials, ``bend_at(q, v, numbers, out)`` and ``polynomial_slope(q, numbers, out)`` too; and
`NDOF`.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def unpack(y):
    q, p = np.empty(NDOF), np.empty(NDOF)
    for i in range(NDOF):
        q[i], p[i] = y[i], y[NDOF + i]
    return q, p


@njit(**OPTIONS)
def pack(q, p, y):
    for i in range(NDOF):
        y[i], y[NDOF + i] = q[i], p[i]


@njit(**OPTIONS)
def copy(x):
    duplicate = np.empty(NDOF)
    for i in range(NDOF):
        duplicate[i] = x[i]
    return duplicate


@njit(**OPTIONS)
def is_finite(q, p):
    total = 0.0
    for i in range(NDOF):
        total += 0.0 * q[i] + 0.0 * p[i]
    return total == 0.0


@njit(**OPTIONS)
def no_error(x):
    return np.zeros(NDOF)


@njit(**OPTIONS)
def move(x, error, change):
    """x + change; if `COMPENSATED` by Kahan's compensated sum."""
    for i in range(NDOF):
        if COMPENSATED:
            corrected = change[i] - error[i]
            total = x[i] + corrected
            error[i] = (total - x[i]) - corrected
            x[i] = total
        else:
            x[i] += change[i]
    return x, error


@njit(**OPTIONS)
def workspace(table):
    return np.empty(NDOF), np.empty(NDOF), np.empty(NDOF), np.empty(NDOF), table


@njit(**OPTIONS)
def forget(x):
    """NaN: what a user's function does not write then ends the run."""
    for i in range(NDOF):
        x[i] = np.nan


COUPLED = True


@njit(**OPTIONS)
def kick(q, numbers, work):
    slope = work[0]
    forget(slope)
    gradient_at(q, numbers, slope)
    for i in range(NDOF):
        slope[i] *= -numbers[0]
    return slope


@njit(**OPTIONS)
def gradient_kick(q, numbers, work):
    b, g = numbers[0], numbers[1]
    slope, velocity, product = work[0], work[1], work[2]
    forget(slope)
    gradient_at(q, numbers, slope)
    apply_inverse_mass(slope, velocity, work)
    forget(product)
    hessian_vector_at(q, velocity, numbers, product)
    for i in range(NDOF):
        slope[i] *= -b
        product[i] *= g
    return slope, product


@njit(**OPTIONS)
def curvature_kick(q, numbers, work):
    """−b∇V + g ∇²V v − c (∇²V M⁻¹∇²V v + ½ ∇³V(v, v)), v = M⁻¹∇V."""
    b, g, c = numbers[0], numbers[1], numbers[2]
    change, velocity, product, bent = work[0], work[1], work[2], work[3]
    gradient_at(q, numbers, change)
    apply_inverse_mass(change, velocity, work)
    hessian_vector_at(q, velocity, numbers, product)
    bend_at(q, velocity, numbers, bent)
    for i in range(NDOF):
        change[i] = g * product[i] - b * change[i] - c * bent[i]
    apply_inverse_mass(product, velocity, work)
    hessian_vector_at(q, velocity, numbers, product)
    for i in range(NDOF):
        change[i] -= c * product[i]
    return change


@njit(**OPTIONS)
def polynomial_kick(q, numbers, work):
    change = kick(q, numbers, work)
    polynomial_slope(q, numbers, work[1])
    for i in range(NDOF):
        change[i] -= work[1][i]
    return change


@njit(**OPTIONS)
def drift(p, a, work):
    velocity = work[0]
    apply_inverse_mass(p, velocity, work)
    for i in range(NDOF):
        velocity[i] *= a
    return velocity
