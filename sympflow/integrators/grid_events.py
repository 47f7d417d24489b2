"""Events of fixed-step methods: the run in chunks of steps, each searched before the next is computed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sympflow.arrays import Array, all_finite, is_tensor, to_numpy
from sympflow.events import ENDED, EventSearch
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FINISHED, FixedStep, Outcome, Problem
from sympflow.integrators.grid import Grid
from sympflow.integrators.grid_solution import GridSolution

FIRST_CHUNK, LAST_CHUNK = 8, 1024
MOST_SAMPLES = 65536  # in a chunk


def run_with_events(integrator: FixedStep, problem: Problem, search: EventSearch) -> Outcome:
    """`FixedStep.run` of a single trajectory with events: the same steps, never more than a chunk of them in memory."""
    system, y = problem.system, problem.y0
    grid = Grid(problem.t0, problem.t1, integrator.step_length(system))
    times, count, remainder = grid.outputs(problem.t_eval, problem.save_every)
    outputs: list[Array] = [y[None][:0]]
    kept: list[Array] = []
    chunk, k, shorter, delivered, failed, backend = FIRST_CHUNK, 0, 0, 0, False, ""
    largest = max(1, min(LAST_CHUNK, MOST_SAMPLES // search.parts(grid.h, system.dt)))

    while True:
        n = min(chunk, largest, grid.n_steps - k)
        piece = Problem(system, grid.time(k), grid.time(k + n), y, backend=problem.backend)
        states, finite, backend = integrator.rollout(piece, grid.h, n, np.arange(n + 1))
        good = min(n, int(finite))
        failed = good < n
        last = k + n == grid.n_steps or failed

        taken, ended = _search(integrator, problem, search, grid, k, states[: good + 1], backend)
        if not ended and last and not failed and grid.remainder:
            shorter = 1
            ended = _search_remainder(integrator, problem, search, grid, states[good], backend)

        # outputs before the end of this chunk; a state at its end belongs to the next, unless there is none
        due = delivered + int(np.searchsorted(count[delivered:], k + good, "right" if last else "left"))
        chosen = slice(delivered, due)
        y_due, extra = states[count[chosen] - k], np.flatnonzero(remainder[chosen])
        if extra.size:
            y_due = integrator.shorter_steps(system, y_due, extra, remainder[chosen][extra], backend)
        outputs.append(y_due)
        delivered = due
        if problem.dense_output:
            kept.append(states[: good + 1] if last or ended else states[:good])
        if ended or last:
            k += taken if ended else good
            break
        y, k, chunk = states[n], k + n, 2 * chunk

    t, y_out = times[:delivered], _join(outputs)
    finite_outputs = to_numpy(all_finite(y_out))  # a shorter step may overflow too
    failed = failed or not finite_outputs.all()
    t_end = search.end[0] if search.end else grid.time(k) if failed else grid.t1
    keep = finite_outputs & ((t - t_end) * np.sign(grid.h) <= 0)
    n_keep = len(t) if keep.all() else int(np.argmin(keep))
    t, y_out = t[:n_keep], y_out[:n_keep]
    if search.end and problem.t_eval is None and not (len(t) and t[-1] == t_end):
        t, y_out = np.append(t, t_end), _join([y_out, search.end[1][None]])

    n_extra = search.n_dense + int(np.count_nonzero(remainder[:delivered]))
    stats = {
        "dt": abs(grid.h),
        "n_steps": k + shorter,
        **integrator.evaluations(k, k, n_extra, backend),
        "backend": backend,
    }
    outcome = Outcome(t, y_out, int(search.end is not None), ENDED if search.end else FINISHED, stats)
    if failed and not search.end:
        outcome.status = -1
        what, remedy = integrator.breakdown
        outcome.stats["failed_at"] = t_end
        outcome.message = (
            f"{what} after t = {t_end:.17g} (step {k + 1} of {grid.n_steps}). {remedy}, or end `t_span` earlier."
        )
    if problem.dense_output:
        outcome.sol = GridSolution(integrator, system, Grid(grid.t0, t_end, abs(grid.h)), _join(kept), backend)
    return outcome


def _search(
    integrator: FixedStep, problem: Problem, search: EventSearch, grid: Grid, k: int, states: Array, backend: str
) -> tuple[int, bool]:
    """Search the steps between `states`, which begin at grid point k: the number searched, and whether the run ends."""
    inner = _samples(integrator, problem.system, search, states[:-1], grid.h, backend)
    for j in range(len(states) - 1):
        t, y = grid.time(k + j), states[j]

        def dense(s: float, t: float = t, y: Array = y) -> Array:
            return integrator.substep(problem.system, y, s - t, backend)

        if search.step(t, y, grid.time(k + j + 1), states[j + 1], dense, inner[j]):
            return j + 1, True
    return len(states) - 1, False


def _samples(
    integrator: FixedStep, system: HamiltonianSystem, search: EventSearch, states: Array, h: float, backend: str
) -> Array:
    """States (n, parts − 1, 2d) that divide the steps of length h from `states` (n, 2d), all computed at once."""
    parts = search.parts(h, system.dt)
    search.n_dense += len(states) * (parts - 1)
    lengths = h * np.arange(1, parts) / parts * np.ones((len(states), 1))
    if parts == 1 or not len(states):
        return states[:, None][:, :0]
    if is_tensor(states):
        import torch

        with torch.no_grad():
            repeated = states[:, None].expand(-1, parts - 1, -1)
            return integrator.substep(system, repeated, torch.as_tensor(lengths).to(repeated), backend)
    with np.errstate(all="ignore"):
        repeated = np.repeat(states[:, None], parts - 1, axis=1)
        return integrator.substep(system, repeated, lengths.astype(states.dtype), backend)


def _search_remainder(
    integrator: FixedStep, problem: Problem, search: EventSearch, grid: Grid, y: Array, backend: str
) -> bool:
    """Search the last, shorter step of an interval that dt does not divide."""
    t = grid.time(grid.n_steps)

    def dense(s: float) -> Array:
        return integrator.substep(problem.system, y, s - t, backend)

    y_end = dense(grid.t1)
    search.n_dense += 1
    if not to_numpy(all_finite(y_end)):
        return False
    inner = _samples(integrator, problem.system, search, y[None], grid.remainder, backend)
    return bool(search.step(t, y, grid.t1, y_end, dense, inner[0]))


def _join(parts: Sequence[Array]) -> Array:
    if is_tensor(parts[0]):
        import torch

        return torch.cat(list(parts))
    return np.concatenate(parts)
