"""Runs on a GPU, a thread for each orbit. Source text, pasted after the algebra of a system, its kicks and `loops`.

The loops are those of the CPU; what they call is compiled for the device.
"""
# ruff: noqa: F821
# mypy: ignore-errors

from numba import cuda


@cuda.jit
def rollout_orbits(tables, y0, n_steps, save, out, n_finite, stop, first, running):
    """`rollout` of every row of `y0` (N, 2d) by its own table, of `tables` (N, R, m), or by the one of (1, R, m)."""
    i = cuda.grid(1)
    if i < y0.shape[0]:
        table = tables[i % tables.shape[0]]
        n_finite[i] = rollout(table, y0[i], n_steps, save, out[i], stop, first, running[i], True)
