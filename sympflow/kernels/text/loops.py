"""The loops of a splitting method: a step, a run. Source text, pasted after the algebra of a system and its kicks.

The algebra says what a state is: q and p are tuples held in registers (a symbolic system) or arrays changed in place
(Numba functions). It defines ``unpack``, ``pack``, ``copy``, ``is_finite``, ``move``, ``no_error``, ``drift``,
``workspace``, and functions for each kind of kick; the text `running_states` follows it. `sympflow.kernels.stages`
writes what depends on the kinds of kick: ``numbers_of`` and ``numbers_at``, which read the numbers of a kick from a
table and, where H depends on t, compute what depends on that, ``drift_of`` and ``drift_at``, which read those of a
drift, ``columns_of`` and ``first_coefficients`` of a table, and ``stage``, a kick and a drift.
Where `SCHEDULED`, kicks and ``drifted`` run in an order of operations that is fast, and ``fill_coefficients`` prepares
their coefficients.

A table has a column for each stage, and may be the first of several arrays; its first row holds the drifts, the others
hold the numbers of the kicks, and with friction those of the drifts (`stages.DampedDrift`). A run executes the columns
[opening, inner …, link, closing]. A step is the link (the first step, the opening) and the inner stages; consecutive
steps share their common kick or drift in the link, and an output is the closing stage applied to a copy, so that what
is saved never changes the trajectory.
A run may be cut: it then begins after `first` steps, from the `running` state (with the errors of compensated sums)
that it left there, and counts on from `first`; where nobody asks for that, `running` is empty. It is left NaN where a
run has ended in what is not finite.
The constants `COMPENSATED` and `SCHEDULED` are known when it is compiled: Numba leaves dead branches out.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import numpy as np
from numba import njit

CHECK_EVERY = 1024  # steps between two looks for a non-finite state, where nothing is saved


@njit(**OPTIONS)
def prepared(table):
    """The workspace of the stages; where `SCHEDULED`, the products of their coefficients, which no state waits for."""
    if SCHEDULED:
        work = np.empty((columns_of(table), N_COEFFICIENTS))
        for j in range(columns_of(table)):
            fill_coefficients(numbers_of(table, j), work[j])
        return work
    return workspace(table)


@njit(**OPTIONS)
def called_stage(q, p, q_error, p_error, numbers, a, j, work):
    """`stage` where few are run. In the loops of a run it stands as it is: a call costs as much as a small kick."""
    return stage(q, p, q_error, p_error, numbers, a, j, work)


@njit(**OPTIONS)
def close(q, p, q_error, p_error, table, k, work):
    """The end of step k, from the running state before its last stage, which is left as it is."""
    q, p, q_error, p_error = copy(q), copy(p), copy(q_error), copy(p_error)
    last = columns_of(table) - 1
    q, p, _, _ = stage(q, p, q_error, p_error, numbers_of(table, last, k), drift_of(table, last), last, work)
    return q, p


@njit(**OPTIONS)
def rollout(table, y0, n_steps, save, out, stop, first, running, closed=True):
    """The steps from `first` to `n_steps` from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``.

    Returns the index of the last step that ends in a finite state; rows of later steps are NaN. Ends early, with
    rows unset, when another thread sets ``stop[0]``. Not `closed`, the states are those before the last stage.
    """
    link = columns_of(table) - 2
    work = prepared(table)
    q, p, q_error, p_error = opened(y0, first, running)
    n, saved, j, longest = first, 0, link if first > 0 else 0, CHECK_EVERY
    while saved < len(save) and save[saved] <= 0:
        pack(q, p, out[saved])
        saved += 1
    while n < n_steps and stop[0] == 0:
        block = min(longest, n_steps - n)
        if saved < len(save):
            block = min(block, save[saved] - n)
        start_q, start_p, begin = copy(q), copy(p), j
        start_q_error, start_p_error = copy(q_error), copy(p_error)
        k = n
        for _ in range(block * link):
            q, p, q_error, p_error = stage(q, p, q_error, p_error, numbers_of(table, j, k), drift_of(table, j), j, work)
            j = j + 1 if j < link else 1
            k = k + 1 if j == link else k
        if closed or longest == 1:
            end_q, end_p = close(q, p, q_error, p_error, table, k, work)
        else:
            end_q, end_p = copy(q), copy(p)
        if not is_finite(end_q, end_p):
            if block == 1:
                fill_with_nan(out, saved)
                set_nan(running)
                return n
            q, p, j, longest = start_q, start_p, begin, 1  # again, step by step, and each to its end
            q_error, p_error = start_q_error, start_p_error
            continue
        n += block
        while saved < len(save) and save[saved] == n:
            pack(end_q, end_p, out[saved])
            saved += 1
    keep(q, p, q_error, p_error, running)
    return n_steps


@njit(**OPTIONS)
def rollout_each(table, y0, n_steps, save, out, n_finite, stop, first, running, closed=True):
    """`rollout` of every row of `y0` (N, 2d) by itself."""
    for i in range(y0.shape[0]):
        n_finite[i] = rollout(table, y0[i], n_steps, save, out[i], stop, first, running[i], closed)


@njit(**OPTIONS)
def step_each(table, x, h, t, y, out):
    """One step of length ``h[i]`` from every row of `y` (N, 2d), which is at the time ``t[i]``.

    The numbers (1 + n, m, K) of stage j are those for h = 1, polynomials Σ_k table[:, j, k] x^k of ``x[i]``.
    """
    if N_VALUES > 0:
        table = table.copy()  # of this thread
    work = prepared(first_coefficients(table))
    for i in range(y.shape[0]):
        if N_VALUES > 0:
            for k in range(N_VALUES):
                table[FIRST_VALUE + k, :, 0] = y[i, 2 * NDOF + k]
        q, p = unpack(y[i])
        q_error, p_error = no_error(q), no_error(p)
        for j in range(columns_of(table)):
            numbers, a = numbers_at(table, j, x[i], h[i], t[i]), h[i] * drift_at(table, j, x[i])
            q, p, q_error, p_error = called_stage(q, p, q_error, p_error, numbers, a, j, work)
        pack(q, p, out[i])


@njit(**OPTIONS)
def map_each(table, steps, y, out):
    """A map of fixed numbers, the columns of a table, of every row of `y`, after so many `steps`, told in turn."""
    work = prepared(table)
    for i in range(y.shape[0]):
        q, p = unpack(y[i])
        k = steps[i % len(steps)]
        q_error, p_error = no_error(q), no_error(p)
        for j in range(columns_of(table)):
            q, p, q_error, p_error = called_stage(
                q, p, q_error, p_error, numbers_of(table, j, k), drift_of(table, j), j, work
            )
        pack(q, p, out[i])


map_rows, rollout_rows = map_each, rollout_each  # where there are lanes, theirs stand for these


# Runs in other coordinates, χ ∘ Kⁿ ∘ χ⁻¹: χ⁻¹ is executed once, and χ for each output. The tables of χ⁻¹ and χ are
# those of single maps, see `map_each`, that of K is that of a run. The table of χ begins with the last stage of K: so
# that is executed for many outputs at once, and the run does not wait for it.


@njit(**OPTIONS)
def rollout_processed(before, run, after, y0, n_steps, save, out, stop, first, running):
    """`rollout` from `y0` (2d,) in other coordinates, `before` into them and `after` out of them."""
    start = np.empty((1, len(y0)))
    if first == 0:
        map_rows(before, np.zeros(1, np.int64), y0.reshape((1, len(y0))), start)
    n_finite = rollout(run, start[0], n_steps, save, out, stop, first, running, False)
    at_start = 0
    while at_start < len(save) and save[at_start] <= 0:
        q, p = unpack(y0)
        pack(q, p, out[at_start])
        at_start += 1
    map_rows(after, save[at_start:], out[at_start:], out[at_start:])
    return up_to_finite(out, save, n_finite)


@njit(**OPTIONS)
def rollout_processed_rows(before, run, after, y0, n_steps, save, out, n_finite, stop, first, running):
    """The same of every row of `y0` (N, 2d)."""
    start = np.empty(y0.shape)
    if first == 0:
        map_rows(before, np.zeros(1, np.int64), y0, start)
    rollout_rows(run, start, n_steps, save, out, n_finite, stop, first, running, False)
    outputs = out.reshape((-1, y0.shape[1]))
    map_rows(after, save, outputs, outputs)
    for i in range(len(y0)):
        for row in range(len(save)):
            if save[row] > 0:
                break
            q, p = unpack(y0[i])
            pack(q, p, out[i, row])
        n_finite[i] = up_to_finite(out[i], save, n_finite[i])
