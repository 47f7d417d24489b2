"""Kicks and drifts of states that are arrays, changed in place. Source text for `loops`, after `array_states`.

What comes before defines the system's ``gradient_at(q, numbers, out)`` and ``hessian_vector_at(q, v, numbers, out)``,
and ``apply_inverse_mass(v, out, work)``; where kicks have curvature terms or polynomials, ``bend_at(q, v, numbers,
out)`` and ``polynomial_slope(q, numbers, out)`` too.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import njit

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
