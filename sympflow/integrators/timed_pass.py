"""A run whose steps are equal in another time, made in one compiled pass where all goes well."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.integrators.base import FINISHED, Outcome, Problem
from sympflow.integrators.grid import Grid

if TYPE_CHECKING:
    from sympflow.integrators.logarithmic import Logarithmic

MOST_EXPECTED = 1e9  # steps, beyond which the run by chunks says whether they are too many
LONGEST_STRIDE = 64  # steps from one look at the time to the next, where few outputs are wanted


def timed_pass(integrator: Logarithmic, problem: Problem) -> Outcome | None:
    """The outcome of a run, or None where there is no compiled pass for it or it did not reach its end.

    None for dense output, for outputs at every step, and for whatever is an error: `PhysicalRun` says what it is.
    """
    system, y0, times = problem.system, problem.y0, problem.t_eval
    length, dt = abs(problem.t1 - problem.t0), integrator.step_length(system)
    if problem.dense_output or problem.backend == "array" or y0.dtype != np.float64 or system.symbols is None:
        return None
    far = max(abs(problem.t0), abs(problem.t1))
    if not length or length > MOST_EXPECTED * dt or far + dt == far:
        return None
    if times is None:
        if y0.ndim == 1:
            return None
        times = Grid(problem.t0, problem.t1, dt).outputs(None, problem.save_every)[0]
    sign = 1.0 if problem.t1 > problem.t0 else -1.0
    elapsed = sign * (times - problem.t0)
    if not len(elapsed) or not elapsed[-1]:
        return None
    first = 0 if elapsed[0] else int(elapsed.searchsorted(0.0, "right"))

    transformed = integrator.transformed(system)
    from sympflow.kernels.timed_loops import lifted_rows

    start = lifted_rows(system, y0.reshape(-1, y0.shape[-1]), transformed.params["shift"])
    if start is None:
        return None
    expected = float(elapsed[-1]) / dt
    stride = int(min(max(1.0, (length / dt / (len(elapsed) + 1)) ** 0.5), LONGEST_STRIDE))
    h = sign * integrator.new_step(system)
    found = integrator.reach_times(transformed, h, start, elapsed[first:], stride, expected, problem.backend)
    if found is None:
        return None
    Y, counts = found
    if first:
        initial = y0.reshape(1, -1, y0.shape[-1])
        Y = np.concatenate([np.broadcast_to(initial, (first, *initial.shape[1:])), Y])
    if y0.ndim == 1:
        n_steps, n_extra = counts[0].tolist()
        status: Any = 0
    else:
        n_steps, n_extra = int(counts[:, 0].max()), int(counts[:, 1].sum())
        status = np.zeros(y0.shape[:-1], dtype=int)
    stats = {
        "dt": dt,
        "n_steps": n_steps,
        **integrator.compiled_evaluations(system, n_steps, n_extra),
        "backend": "compiled",
    }
    return Outcome(times, Y.reshape(len(times), *y0.shape), status, FINISHED, stats, finite=True)
