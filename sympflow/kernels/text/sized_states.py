"""The loops of splitting methods on systems of any size, by states that are changed in place. Source text for `lattice`
and `pairs`, after `aligned`.

A state is an array X (sets, fields, size): q, p and, if `COMPENSATED`, their errors. What is pasted with it, `lattice`
or `pairs`, defines ``load``, ``pack``, ``workspace``, and ``in_one(X, table, j, n_stages, single, work, geometry,
sites, values)``, which makes so many stages from column j on, of a run or a `single` map, in place, and returns the
column after them. The shape of the system, and the values of its parameters, are arguments.
"""
# ruff: noqa: F821
# mypy: ignore-errors

import math

import numpy as np
from numba import njit

CHECK_EVERY = 1024  # steps between two looks for a non-finite state, where nothing is saved
PAGE, NEAR = 512, 64  # numbers

# What `in_one` is called with: a literal has a type of its own, for which it and all that it calls were compiled again.
ZERO, ONE, SINGLE, RUNNING = np.int64(0), np.int64(1), np.bool_(True), np.bool_(False)


@njit(**OPTIONS)
def zero_state(n_sets, size):
    """Vectors of 0, for each field so many, the first of them where a register's load may begin."""
    return aligned_zeros(n_sets * N_FIELDS * size).reshape((n_sets, N_FIELDS, size))


@njit(**OPTIONS)
def zero_running(size):
    """A state of 0, its vectors longer where two of them would begin about a number of pages apart, if `SPACED`.

    Some processors keep but one of such two streams in their cache: a stage on a thousand sites takes up to six times
    as long, in one run and not in the next.
    """
    n = N_SETS * N_FIELDS
    if SPACED and n * size > PAGE:
        for k in range(1, n):
            apart = k * size % PAGE
            if apart < NEAR or apart > PAGE - NEAR:
                return zero_state(N_SETS, size + (NEAR - size) % PAGE)
    return zero_state(N_SETS, size)


@njit(**OPTIONS)
def copy_state(source, target):
    a, b = source.reshape(-1), target.reshape(-1)
    for i in range(len(a)):
        b[i] = a[i]


@njit(**OPTIONS)
def is_finite(x):
    flat, total = x.reshape(-1), 0.0
    for i in range(len(flat)):
        total += 0.0 * flat[i]
    return total == 0.0


@njit(**OPTIONS)
def finite_numbers(X):
    return is_finite(X[:2])


@njit(**OPTIONS)
def close(X, end_X, table, work, geometry, sites, values):
    """The end of a step into `end_X`, from the running state before its last stage."""
    copy_state(X, end_X)
    in_one(end_X, table, table.shape[1] - 1, ONE, SINGLE, work, geometry, sites, values)


@njit(**OPTIONS)
def rollout(table, y0, n_steps, save, out, stop, first, running, single, geometry, size, sites, values):
    """The steps from `first` to `n_steps` from `y0` (2d,), the states after ``save[i]`` steps into ``out[i]``.

    Of a system in one piece; otherwise as in the text `loops`. If `single`, the columns of the table are one map,
    whose value goes into ``out[0]``: a function of its own for that would be compiled as long as this one.
    """
    link = table.shape[1] - 2
    work = workspace(size, geometry, sites)
    X, width = zero_running(size), len(y0)
    if single:
        load(y0, X, 0, geometry)
        in_one(X, table, ZERO, table.shape[1], SINGLE, work, geometry, sites, values)
        pack(X, 0, out[0], geometry)
        return 0
    start_X, end_X = zero_running(size), zero_running(size)
    if first > 0:
        load(running[:width], X, 0, geometry)
        if COMPENSATED:
            load(running[width:], X, 2, geometry)
    else:
        load(y0, X, 0, geometry)
    n, saved, j, longest = first, 0, link if first > 0 else 0, CHECK_EVERY
    while saved < len(save) and save[saved] <= 0:
        pack(X, 0, out[saved], geometry)
        saved += 1
    while n < n_steps and stop[0] == 0:
        block = min(longest, n_steps - n)
        if saved < len(save):
            block = min(block, save[saved] - n)
        copy_state(X, start_X)
        before = j
        j = in_one(X, table, j, block * link, RUNNING, work, geometry, sites, values)
        close(X, end_X, table, work, geometry, sites, values)
        if not finite_numbers(end_X):
            if block == 1:
                for i in range(saved, out.shape[0]):
                    for k in range(width):
                        out[i, k] = math.nan
                running[:] = math.nan
                return n
            copy_state(start_X, X)
            j, longest = before, 1  # again, step by step
            continue
        n += block
        while saved < len(save) and save[saved] == n:
            pack(end_X, 0, out[saved], geometry)
            saved += 1
    if len(running) > 0:
        pack(X, 0, running[:width], geometry)
        if COMPENSATED:
            pack(X, 2, running[width:], geometry)
    return n_steps
