"""A batch of a method of torchdiffeq of which some trajectories fail: in parts, so that the others reach their end."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import stack, to_numpy
from sympflow.integrators.contract import FINISHED, Outcome, Problem
from sympflow.integrators.interpolants import Batch

if TYPE_CHECKING:
    from sympflow.integrators.torchdiffeq_driver import Trace, Watched

COUNTS = ("n_steps", "force_evaluations", "hessian_evaluations")


def run_in_parts(method: Watched, problem: Problem, joint: Outcome, trace: Trace) -> Outcome:
    """The outcome of a batch that failed when run jointly.

    A part that fails is divided, until what fails is one trajectory: the fast ones from the others where some are much
    faster, as before a singularity, else into halves. So a few that fail cost a few runs, not one run a trajectory.
    The steps of all parts count against one bound, the method's; where it is
    met, what had been computed is kept, of the part or of what it is a half of, whichever came further.
    """
    batch, times = problem.y0.shape[:-1], joint.t
    rows = problem.y0.reshape(-1, problem.y0.shape[-1])
    n = len(rows)
    whole = replace(joint, y=joint.y.reshape(len(times), *rows.shape))
    source: list[tuple[Outcome, int]] = [
        (whole, i) for i in range(n)
    ]  # of each trajectory its run, and its place there
    reached = np.full(n, trace.reached)
    done, unfinished = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    counts = {key: joint.stats[key] for key in COUNTS}
    left = None if method.most_steps is None else method.most_steps - trace.n_tried
    parts = deque(_divided(problem, np.arange(n), trace))
    while parts:
        part = parts.popleft()
        if left is not None and left <= 0:
            unfinished[part] = True
            continue
        outcome, trace = method.run_jointly(replace(problem, y0=rows[part], t_eval=times), times, left)
        left = None if left is None else left - trace.n_tried
        counts = {key: counts[key] + outcome.stats[key] for key in COUNTS}
        if not trace.failed or abs(trace.reached - problem.t0) >= abs(reached[part[0]] - problem.t0):
            reached[part] = trace.reached
            for j, i in enumerate(part.tolist()):
                source[i] = outcome, j
        done[part] = not trace.failed
        unfinished[part] = trace.failed and trace.spent
        if trace.failed and not trace.spent:
            parts.extend(_divided(problem, part, trace))

    stats: dict[str, Any] = {**counts, "backend": "torchdiffeq"}
    if not done.all():
        stats["failed_at"] = np.where(done, np.nan, reached).reshape(batch)
    outcome = Outcome(
        times,
        stack([run.y[:, j] for run, j in source], axis=1).reshape(len(times), *problem.y0.shape),
        np.where(done, 0, -1).reshape(batch),
        _message(method, batch, source, done, unfinished, reached),
        stats,
    )
    if problem.dense_output:
        outcome.sol = Batch(source, batch, (problem.t0, problem.t1))
    return outcome


def _divided(problem: Problem, part: np.ndarray, trace: Trace) -> list[np.ndarray]:
    """Two parts of one, by the rates |f|/|y| of its trajectories in the last state before it failed."""
    if len(part) < 2:
        return []
    y = trace.last
    rates = np.zeros(len(part))
    if y is not None:
        with np.errstate(all="ignore"):
            f = to_numpy(problem.system.vector_field(y)).reshape(len(part), -1)
            rates = np.nan_to_num(np.abs(f).max(-1) / np.abs(to_numpy(y)).reshape(f.shape).max(-1), nan=np.inf)
    order = np.argsort(rates, kind="stable")
    with np.errstate(all="ignore"):
        gaps = np.nan_to_num(rates[order[1:]] / rates[order[:-1]], nan=1.0)
    cut = int(np.argmax(gaps)) + 1 if gaps.max() > 10 else len(part) // 2
    return [np.sort(part[order[:cut]]), np.sort(part[order[cut:]])]


def _message(
    method: Watched,
    batch: tuple[int, ...],
    source: list[tuple[Outcome, int]],
    done: np.ndarray,
    unfinished: np.ndarray,
    reached: np.ndarray,
) -> str:
    said = []
    failed = np.flatnonzero(~done & ~unfinished)
    if len(failed):
        said.append(f"Trajectory {_index(failed[0], batch)}: {source[failed[0]][0].message}")
    if unfinished.any():
        first = np.argmax(unfinished)
        said.append(
            f"`max_num_steps` = {method.most_steps} steps, in sum over the batch and the parts that it was run in "
            f"because some of its trajectories fail, ended before {unfinished.sum()} of {len(done)} trajectories: they "
            f"are kept up to where they were, trajectory {_index(first, batch)} up to t = {reached[first]:.17g}. Raise "
            "`max_num_steps`, or solve those that fail in another call, or end `t_span` before they do."
        )
    return " ".join(said) or FINISHED


def _index(i: Any, batch: tuple[int, ...]) -> str:
    return ", ".join(str(k) for k in np.unravel_index(int(i), batch))
