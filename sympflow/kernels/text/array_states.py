"""States as arrays, changed in place: systems given by Numba functions, of many terms, or of any size.

Source text for `loops`. What comes before defines the constants of `loops`, the system's ``gradient_at(q, numbers,
out)`` and ``hessian_vector_at(q, v, numbers, out)``, and ``apply_inverse_mass(v, out, work)``; where kicks have
curvature terms or polynomials, ``bend_at(q, v, numbers, out)`` and ``polynomial_slope(q, numbers, out)`` too; and
``size(x, copies)``, the degrees of freedom by an array x of so many vectors, and ``size_of(table)``.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit


@njit(**OPTIONS)
def unpack(y):
    d = size(y, 2)
    q, p = np.empty(d), np.empty(d)
    for i in range(d):
        q[i], p[i] = y[i], y[d + i]
    return q, p


@njit(**OPTIONS)
def pack(q, p, y):
    d = size(y, 2)
    for i in range(d):
        y[i], y[d + i] = q[i], p[i]


@njit(**OPTIONS)
def copy(x):
    duplicate = np.empty(size(x, 1))
    for i in range(size(x, 1)):
        duplicate[i] = x[i]
    return duplicate


@njit(**OPTIONS)
def is_finite(q, p):
    total = 0.0
    for i in range(size(q, 1)):
        total += 0.0 * q[i] + 0.0 * p[i]
    return total == 0.0


@njit(**OPTIONS)
def no_error(x):
    return np.zeros(size(x, 1))


@njit(**OPTIONS)
def move(x, error, change):
    """x + change; if `COMPENSATED` by Kahan's compensated sum."""
    for i in range(size(x, 1)):
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
    d = size_of(table)
    return np.empty(d), np.empty(d), np.empty(d), np.empty(d), table


@njit(**OPTIONS)
def forget(x):
    """NaN: what a user's function does not write then ends the run."""
    for i in range(size(x, 1)):
        x[i] = np.nan


COUPLED = True


@njit(**OPTIONS)
def kick(q, numbers, work):
    slope = work[0]
    forget(slope)
    gradient_at(q, numbers, slope)
    for i in range(size(q, 1)):
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
    for i in range(size(q, 1)):
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
    for i in range(size(q, 1)):
        change[i] = g * product[i] - b * change[i] - c * bent[i]
    apply_inverse_mass(product, velocity, work)
    hessian_vector_at(q, velocity, numbers, product)
    for i in range(size(q, 1)):
        change[i] -= c * product[i]
    return change


@njit(**OPTIONS)
def polynomial_kick(q, numbers, work):
    change = kick(q, numbers, work)
    polynomial_slope(q, numbers, work[1])
    for i in range(size(q, 1)):
        change[i] -= work[1][i]
    return change


@njit(**OPTIONS)
def drift(p, a, work):
    velocity = work[0]
    apply_inverse_mass(p, velocity, work)
    for i in range(size(p, 1)):
        velocity[i] *= a
    return velocity
