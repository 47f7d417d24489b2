"""What a run on a grid says where trajectories cannot go on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sympflow.arrays import Array, all_finite, is_tensor, to_numpy
from sympflow.integrators.grid import Grid

if TYPE_CHECKING:
    from sympflow.integrators.base import Outcome

__all__ = ["report_failures"]


def report_failures(outcome: Outcome, grid: Grid, finite: np.ndarray, n_run: int, breakdown: tuple[str, str]) -> None:
    """Set status −1, the time and the message where a trajectory cannot go on; cut a single trajectory there.

    `stats["failed_at"]` is the time of the last finite state on the grid, in a batch an array with NaN for those that
    reached their end.
    """
    what, remedy = breakdown
    done = bool((finite >= n_run).all()) if finite.ndim else int(finite) >= n_run
    outcome.finite = done and (outcome.finite or _all_finite(outcome.y, outcome.stats["backend"]))
    if outcome.finite:
        if finite.ndim:
            outcome.status = np.zeros(finite.shape, dtype=int)
        return
    ok = to_numpy(all_finite(outcome.y))  # (n, ...): shorter steps may overflow too
    if finite.ndim:
        outcome.status = np.where((finite < n_run) | ~ok.all(0), -1, 0)
        failed = np.argwhere(outcome.status)
        if failed.size:
            i = tuple(failed[0].tolist())
            times = grid.t0 + np.minimum(finite, grid.n_steps) * grid.h
            outcome.stats["failed_at"] = np.where(outcome.status < 0, times, np.nan)
            outcome.message = (
                f"{len(failed)} of {finite.size} trajectories failed, the first of them (index "
                f"{', '.join(map(str, i))}) after t = {grid.time(int(finite[i])):.17g}. {what}. {remedy}."
            )
        return
    if finite < n_run or not ok.all():
        last = int(finite) if finite < n_run else int(grid.locate(outcome.t[~ok][:1])[0][0])
        outcome.status = -1
        outcome.stats["failed_at"] = grid.time(last)
        outcome.message = (
            f"{what} after t = {grid.time(last):.17g} (step {last + 1} of {grid.n_steps}). "
            f"{remedy}, or end `t_span` earlier."
        )
        keep = int(np.argmin(ok)) if not ok.all() else len(ok)
        outcome.t, outcome.y = outcome.t[:keep], outcome.y[:keep]


def _all_finite(y: Array, backend: str) -> bool:
    """Whether an array is known to be finite all over, by the means of a run of that backend."""
    if is_tensor(y):
        return False
    if backend != "compiled" or y.dtype != np.float64 or not (y.flags.c_contiguous or y.flags.f_contiguous):
        return bool(np.isfinite(y).all())
    from sympflow.kernels.output_loops import all_finite

    return all_finite(y)
