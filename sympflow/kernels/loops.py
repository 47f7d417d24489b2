"""The loops of a splitting method: a step, a run. Source text, pasted after the algebra of a system.

The algebra that comes before says what a state is: q and p are tuples held in registers (a symbolic system) or
arrays changed in place (Numba functions). It defines ``unpack``, ``pack``, ``copy``, ``is_finite``, ``move``,
``no_error``, ``kick``, ``gradient_kick``, ``drift``, ``workspace``, and for a symbolic system ``curvature_kick``. A
``gradient_kick`` has two parts, which are added one after the other, the second only where `COUPLED`. Where
`SCHEDULED`, ``kicked``, ``gradient_kicked`` and ``curvature_kicked`` give the new p at once, and ``drifted`` the new q,
in an order of operations that is fast, and stand for these; ``fill_coefficients`` prepares them.

A run executes the table [opening, inner …, link, closing] of stages (kick, then drift). A step is the link (the
first step, the opening) and the inner stages; consecutive steps share their common kick or drift in the link, and
an output is the closing stage applied to a copy, so that what is saved never changes the trajectory. The constants
`FORCE_GRADIENTS`, `CURVATURES`, `POLYNOMIALS`, `COMPENSATED` and `SCHEDULED` are known when it is compiled: Numba
leaves dead branches out. Where `POLYNOMIALS`, every kick has one: ``polynomial_kick``, or ``polynomial_kicked``; a row
of `curvatures` then holds its coefficients, and c is that row.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

CHECK_EVERY = 1024  # steps between two looks for a non-finite state, where nothing is saved


@njit(**OPTIONS)
def prepared(kicks, gradients, curvatures):
    """What the stages work with; where `SCHEDULED`, the products of their coefficients, which no state waits for."""
    if SCHEDULED:
        table = np.empty((len(kicks), N_COEFFICIENTS))
        for j in range(len(kicks)):
            fill_coefficients(kicks[j], gradients[j], curvatures[j], table[j])
        return table
    return workspace()


@njit(**OPTIONS, forceinline=True)
def stage(q, p, q_error, p_error, b, g, c, a, j, work):
    """Kick by b (and g and c), then drift by a."""
    if POLYNOMIALS:
        return polynomial_stage(q, p, q_error, p_error, b, c, a, j, work)
    if CURVATURES and c != 0.0:
        return curvature_stage(q, p, q_error, p_error, b, g, c, a, j, work)
    if FORCE_GRADIENTS and g != 0.0:
        return gradient_stage(q, p, q_error, p_error, b, g, a, j, work)
    return plain_stage(q, p, q_error, p_error, b, a, j, work)


@njit(**OPTIONS)
def called_stage(q, p, q_error, p_error, b, g, c, a, j, work):
    """`stage` where few are run. In the loops of a run it stands as it is: a call costs as much as a small kick."""
    return stage(q, p, q_error, p_error, b, g, c, a, j, work)


@njit(**OPTIONS, forceinline=True)
def drift_by(q, p, q_error, a, work):
    if SCHEDULED:
        return drifted(q, p, a), q_error
    return move(q, q_error, drift(p, a, work))


@njit(**OPTIONS, forceinline=True)
def plain_stage(q, p, q_error, p_error, b, a, j, work):
    if SCHEDULED:
        p = kicked(q, p, work, j)
    else:
        p, p_error = move(p, p_error, kick(q, b, work))
    q, q_error = drift_by(q, p, q_error, a, work)
    return q, p, q_error, p_error


@njit(**OPTIONS, forceinline=True)
def gradient_stage(q, p, q_error, p_error, b, g, a, j, work):
    if FORCE_GRADIENTS and SCHEDULED:
        p = gradient_kicked(q, p, work, j)
    elif FORCE_GRADIENTS:
        first, second = gradient_kick(q, b, g, work)
        p, p_error = move(p, p_error, first)
        if COUPLED:
            p, p_error = move(p, p_error, second)
    q, q_error = drift_by(q, p, q_error, a, work)
    return q, p, q_error, p_error


@njit(**OPTIONS, forceinline=True)
def curvature_stage(q, p, q_error, p_error, b, g, c, a, j, work):
    if CURVATURES and SCHEDULED:
        p = curvature_kicked(q, p, work, j)
    elif CURVATURES:
        p, p_error = move(p, p_error, curvature_kick(q, b, g, c, work))
    q, q_error = drift_by(q, p, q_error, a, work)
    return q, p, q_error, p_error


@njit(**OPTIONS, forceinline=True)
def polynomial_stage(q, p, q_error, p_error, b, c, a, j, work):
    if POLYNOMIALS and SCHEDULED:
        p = polynomial_kicked(q, p, work, j)
    elif POLYNOMIALS:
        p, p_error = move(p, p_error, polynomial_kick(q, b, c, work))
    q, q_error = drift_by(q, p, q_error, a, work)
    return q, p, q_error, p_error


@njit(**OPTIONS)
def close(q, p, q_error, p_error, kicks, drifts, gradients, curvatures, work):
    """The end of a step, from the running state before its last stage, which is left as it is."""
    q, p, q_error, p_error = copy(q), copy(p), copy(q_error), copy(p_error)
    q, p, _, _ = called_stage(
        q, p, q_error, p_error, kicks[-1], gradients[-1], curvatures[-1], drifts[-1], len(kicks) - 1, work
    )
    return q, p


@njit(**OPTIONS)
def first_non_finite(q, p, kicks, drifts, gradients, curvatures, first, n_steps, work):
    """The first of `n_steps` steps from a running state whose end is not finite; `n_steps` if none is."""
    link = len(kicks) - 2
    q_error, p_error = no_error(q), no_error(p)
    j = first
    for n in range(1, n_steps):
        for _ in range(link):
            q, p, q_error, p_error = called_stage(
                q, p, q_error, p_error, kicks[j], gradients[j], curvatures[j], drifts[j], j, work
            )
            j = j + 1 if j < link else 1
        end_q, end_p = close(q, p, q_error, p_error, kicks, drifts, gradients, curvatures, work)
        if not is_finite(end_q, end_p):
            return n
    return n_steps


@njit(**OPTIONS)
def fill_with_nan(rows, first):
    for i in range(first, rows.shape[0]):
        for j in range(rows.shape[1]):
            rows[i, j] = math.nan


@njit(**OPTIONS)
def rollout(kicks, drifts, gradients, curvatures, y0, n_steps, save, out, stop):
    """`n_steps` steps from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``.

    Returns the index of the last step that ends in a finite state; rows of later steps are NaN. Ends early, with
    rows unset, when another thread sets ``stop[0]``.
    """
    link = len(kicks) - 2
    work = prepared(kicks, gradients, curvatures)
    q, p = unpack(y0)
    q_error, p_error = no_error(q), no_error(p)
    n = saved = j = 0
    while saved < len(save) and save[saved] <= 0:
        pack(q, p, out[saved])
        saved += 1
    while n < n_steps and stop[0] == 0:
        block = min(CHECK_EVERY, n_steps - n)
        if saved < len(save):
            block = min(block, save[saved] - n)
        start_q, start_p, begin = copy(q), copy(p), j
        for _ in range(block * link):
            b, g, c, a = kicks[j], gradients[j], curvatures[j], drifts[j]
            q, p, q_error, p_error = stage(q, p, q_error, p_error, b, g, c, a, j, work)
            j = j + 1 if j < link else 1
        end_q, end_p = close(q, p, q_error, p_error, kicks, drifts, gradients, curvatures, work)
        if not is_finite(end_q, end_p):
            fill_with_nan(out, saved)
            return n - 1 + first_non_finite(start_q, start_p, kicks, drifts, gradients, curvatures, begin, block, work)
        n += block
        while saved < len(save) and save[saved] == n:
            pack(end_q, end_p, out[saved])
            saved += 1
    return n_steps


@njit(**OPTIONS)
def rollout_each(kicks, drifts, gradients, curvatures, y0, n_steps, save, out, n_finite, stop):
    """`rollout` of every row of `y0` (N, 2d) by itself."""
    for i in range(y0.shape[0]):
        n_finite[i] = rollout(kicks, drifts, gradients, curvatures, y0[i], n_steps, save, out[i], stop)


@njit(**OPTIONS)
def polynomial(coefficients, x):
    total = 0.0
    for k in range(len(coefficients) - 1, -1, -1):
        total = total * x + coefficients[k]
    return total


@njit(**OPTIONS)
def step_each(kicks, drifts, gradients, curvatures, x, h, y, out):
    """One step of length ``h[i]`` from every row of `y` (N, 2d).

    The coefficients (m, K) of stage j are those for h = 1, polynomials Σ_k kicks[j, k] x^k of ``x[i]``.
    """
    work = prepared(kicks[:, 0], gradients[:, 0], curvatures[:, 0])
    for i in range(y.shape[0]):
        q, p = unpack(y[i])
        q_error, p_error = no_error(q), no_error(p)
        for j in range(len(kicks)):
            b, a = h[i] * polynomial(kicks[j], x[i]), h[i] * polynomial(drifts[j], x[i])
            g, c = h[i] ** 3 * polynomial(gradients[j], x[i]), h[i] ** 5 * polynomial(curvatures[j], x[i])
            q, p, q_error, p_error = called_stage(q, p, q_error, p_error, b, g, c, a, j, work)
        pack(q, p, out[i])


@njit(**OPTIONS)
def map_each(numbers, more, y, out):
    """Maps of fixed numbers, kicks, drifts and gradients as rows and `more` as curvatures, of every row of `y`."""
    kicks, drifts, gradients = numbers[0], numbers[1], numbers[2]
    work = prepared(kicks, gradients, more)
    for i in range(y.shape[0]):
        q, p = unpack(y[i])
        q_error, p_error = no_error(q), no_error(p)
        for j in range(len(kicks)):
            q, p, q_error, p_error = called_stage(
                q, p, q_error, p_error, kicks[j], gradients[j], more[j], drifts[j], j, work
            )
        pack(q, p, out[i])


map_rows, rollout_rows = map_each, rollout_each
