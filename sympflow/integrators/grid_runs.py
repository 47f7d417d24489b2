"""Runs of steps, by one driver: outputs in memory, with events, or into a store, on the grid t0 + k·dt.

A long run is made in windows of a fraction of a second, which give the same bits as the run in one piece. Between two
of them progress is reported, outputs are stored, and Ctrl-C can end the run.
"""

from __future__ import annotations

import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import (
    Array,
    concatenate,
    finite_states,
    known_finite,
    lanes,
    like,
    readable,
    rows_of_nan,
    stack,
    unfollowed,
)
from sympflow.events import EventSearch
from sympflow.integrators.contract import ENDED, FINISHED, INTERRUPTED, Failure, Outcome, Problem, finished, interrupted
from sympflow.integrators.grid import Grid, Outputs, distinct
from sympflow.integrators.interpolants import DenseOutput
from sympflow.integrators.steppers import Stepper, shorter_steps
from sympflow.kernels.protocol import RunCheckpoint

if TYPE_CHECKING:
    from sympflow.storage.runs import Place, RunStore

SECONDS = 0.2  # the time that a window is to take
GROWTH = 16  # of a window, over the one before
FEW_STEPS = 512  # below which a run is never cut
ARRAY_STEPS = 256  # of array operations, in the first window
ONE, MANY = 2**18, 2**22
"""Numbers of the states after the steps of a first window, of one trajectory and of a batch: a millisecond or so."""
LEAST = 16  # steps of the first window of a batch, whose states are loaded and stored in each
DENSE, LARGE = 16, 2**26
"""A run that saves one of so many steps or more is in one piece unless it has as many numbers: windows are copied."""
MOST_SAVED = 2**21  # numbers that a window saves, at most
FIRST_CHUNK, LAST_CHUNK = 8, 1024  # steps between two looks at the events
MOST_SAMPLES = 65536  # of the events, in a chunk
COUNTED = ("force_evaluations", "hessian_evaluations", "curvature_evaluations", "newton_iterations")
"""Statistics of which those of a run that goes on are added to the earlier ones, where it counts them itself."""
UNDER_WAY = "The run had reached t = {t:.15g}: make the same call with resume=True to go on."


class Run(ABC):
    """One run of a method with fixed steps, on any clock: windows, progress, Ctrl-C, statistics and failures."""

    stepper: Stepper

    def __init__(self, integrator: Any, problem: Problem, dt: float) -> None:
        self.integrator, self.problem, self.dt, self.stopped = integrator, problem, dt, False

    @abstractmethod
    def windows(self) -> Iterator[float]:
        """Make the steps, window by window; yield the time that has elapsed after each."""

    @abstractmethod
    def taken(self) -> Outcome:
        """Return the outcome of the windows that were made."""

    @property
    @abstractmethod
    def reached(self) -> float:
        """The time that the windows have reached."""

    def stop(self) -> None:
        """Note that Ctrl-C ended the run, and go back to the end of the last window that is over."""
        self.stopped = True

    def outcome(self) -> Outcome:
        """Run to the end, a failure or Ctrl-C."""
        progress, begun = self.problem.progress, self.problem.store is not None
        try:
            for elapsed in self.windows():
                begun = True
                if progress is not None:
                    progress(elapsed)
        except KeyboardInterrupt:
            if not begun:
                raise
            self.stop()
        outcome = self.taken()
        if self.stopped:
            raise interrupted(outcome, self.reached) from None
        return outcome

    def stats(self, n_told: int, n_steps: int, n_saved: int, n_extra: int) -> dict[str, Any]:
        """Return the statistics of n_steps steps, n_saved states and n_extra shorter steps."""
        stepper, arrays = self.stepper, self.stepper.arrays
        stats: dict[str, Any] = {"dt": self.dt, "n_steps": n_told, **stepper.evaluations(n_steps, n_saved, n_extra)}
        stats["backend"] = stepper.backend + stepper.why
        return stats | {"newton_iterations": arrays.iterations} if arrays.stages else stats


class GridRun(Run):
    """A run on the grid t0 + k·h: its steps in windows, the outputs among and within them, and non-finite states."""

    def __init__(self, integrator: Any, problem: Problem) -> None:
        self.grid = Grid(problem.t0, problem.t1, integrator.step_length(problem.system))
        super().__init__(integrator, problem, abs(self.grid.h))
        self.stepper = integrator.stepper(problem)
        self.outputs = Outputs(self.grid, problem.t_eval, problem.save_every)
        self.checkpoint = self._before = RunCheckpoint(), None
        """Where the steps are, with the last finite step of each trajectory; and where the window before began."""
        self.done = self.row = 0
        """The steps of the windows that are over, and the number of outputs, or of states saved, in them."""

    checkpoint: tuple[RunCheckpoint, np.ndarray | None]
    _before: tuple[RunCheckpoint, np.ndarray | None]

    @property
    def reached(self) -> float:
        return self.grid.time(self.done)

    def stop(self) -> None:
        super().stop()
        if self.checkpoint[0].steps > self.done:
            self.checkpoint = self._before

    def advance(self, k: int, save: np.ndarray) -> Array:
        """Go on to step k; return the states after the steps `save`, all of them steps of this window."""
        problem, h, (before, known) = self.problem, self.grid.h, self.checkpoint
        if self.stepper.takes_carry:
            after = RunCheckpoint(before.steps, before.running, self._before[0].running)
            states, finite = self.stepper.rollout(problem.y0, h, k, save, problem.t0, carry=after)
        else:  # from the state with which the window before ended
            done = before.steps
            start = problem.y0 if before.running is None else before.running
            states, finite = self.stepper.rollout(start, h, k - done, save - done, self.grid.time(done))
            after, finite = RunCheckpoint(k, states[-1]), finite + done
        if known is not None:
            finite = np.where(known < before.steps, known, finite)
        self._before, self.checkpoint = self.checkpoint, (after, np.asarray(finite))
        return states

    @property
    def finite(self) -> np.ndarray:
        """The last finite step of each trajectory, of the steps made so far."""
        steps, finite = self.checkpoint
        return np.full(self.problem.y0.shape[:-1], steps.steps) if finite is None else finite

    def counted(self, row: int, last: int) -> dict[str, Any]:
        """Return the statistics after `last` steps, with so many outputs."""
        outputs, remainder = self.outputs, self.grid.remainder
        at_end = remainder and row == outputs.n > 0 and outputs.part(row - 1, row)[0][0] == self.grid.t1
        n_saved, n_within = outputs.counts(row, last)
        return self.stats(last + bool(at_end), last, last if self.problem.dense_output else n_saved, n_within)

    def report_failures(self, outcome: Outcome, finite: np.ndarray, n_run: int) -> None:
        """Set status −1, the time and the message where a trajectory cannot go on; cut a single trajectory there."""
        done = bool((finite >= n_run).all()) if finite.ndim else int(finite) >= n_run
        outcome.finite = done and (outcome.finite or known_finite(outcome.y))
        if outcome.finite:
            if finite.ndim:
                outcome.status = np.zeros(finite.shape, dtype=int)
            return
        grid, reason = self.grid, self.integrator.breakdown
        ok = finite_states(outcome.y)  # (n, ...): shorter steps may overflow too
        if lanes(outcome.y):
            if not ok.all():
                report_lanes(outcome, ok, reason)
        elif finite.ndim:
            outcome.status = np.where((finite < n_run) | ~ok.all(0), -1, 0)
            failed = np.argwhere(outcome.status)
            if failed.size:
                times = grid.t0 + np.minimum(finite, grid.n_steps) * grid.h
                outcome.stats["failed_at"] = np.where(outcome.status < 0, times, np.nan)
                t = grid.time(int(finite[tuple(failed[0].tolist())]))
                outcome.message = broken_off(reason, t, failed=failed, of=finite.size)
        elif finite < n_run or not ok.all():
            k = int(finite) if finite < n_run else int(grid.locate(outcome.t[~ok][:1])[0][0])
            outcome.status = -1
            outcome.stats["failed_at"] = grid.time(k)
            outcome.message = broken_off(reason, grid.time(k), f" (step {k + 1} of {grid.n_steps})")
            keep = int(np.argmin(ok)) if not ok.all() else len(ok)
            outcome.t, outcome.y = outcome.t[:keep], outcome.y[:keep]


def grid_run(integrator: Any, problem: Problem) -> GridRun:
    """Return the run of a problem: in memory, with events, or into its store."""
    if problem.store is not None:
        return StoredRun(integrator, problem, problem.store)
    return MemoryRun(integrator, problem) if problem.events is None else SearchedRun(integrator, problem)


def broken_off(
    reason: Failure, t: float, step: str = "", failed: np.ndarray | None = None, of: int = 1, **numbers: Any
) -> str:
    """Return the message of a run, or of trajectories `failed` (n, k) of a batch, that cannot go on after time t."""
    what, remedy = (part.format(**numbers) for part in reason.value)
    if failed is None:
        return f"{what} after t = {t:.15g}{step}. {remedy}, or end `t_span` earlier."
    index = ", ".join(map(str, failed[0].tolist()))
    return (
        f"{len(failed)} of {of} trajectories failed, the first of them (index {index}) after t = {t:.15g}. "
        f"{what}. {remedy}."
    )


def report_lanes(outcome: Outcome, ok: np.ndarray, breakdown: Failure) -> None:
    """Flag a run under `torch.func.vmap` in which a lane failed: `ok` (n, ...) is False where one is not finite."""
    what, remedy = breakdown.value
    bad = ~ok.all(0)
    outcome.status = np.where(bad, -1, 0) if bad.ndim else -1
    outcome.stats["failed_at"] = float(outcome.t[int(np.argmin(ok.reshape(len(ok), -1).all(1)))])
    outcome.message = (
        f"{what} in some lane of torch.func.vmap before t = {outcome.stats['failed_at']:.15g}. {remedy}, or pass the "
        "states as a batch, whose trajectories are distinguished."
    )


class GridSolution(DenseOutput):
    """Dense output of a fixed-step method: a shorter step from the last grid point before t."""

    def __init__(self, stepper: Stepper, grid: Grid, states: Array) -> None:
        self.stepper, self.grid, self.kept = stepper, grid, states
        self.t_min, self.t_max = sorted((grid.t0, grid.t1))

    def __getstate__(self) -> dict[str, Any]:
        """The choice of the method in place of its run, whose compiled loops belong to a process."""
        stepper, problem = self.stepper, self.stepper.problem
        backend = "auto" if stepper.backend == "compiled" else "array"
        again = Problem(
            stepper.system,
            self.grid.t0,
            self.grid.t1,
            self.kept[0],
            backend=backend,
            parameter_values=problem.parameter_values,
        )
        return {"integrator": stepper.integrator, "problem": again, "grid": self.grid, "states": self.kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        GridSolution.__init__(self, state["integrator"].stepper(state["problem"]), state["grid"], state["states"])

    def states(self, times: np.ndarray) -> Array:
        count, remainder = self.grid.locate(times)
        return shorter_steps(self.stepper, self.grid, self.kept[count], count, remainder)


class Pace:
    """The lengths of windows, by the time that the last one took."""

    def __init__(self, first: int) -> None:
        self.n = first
        self.started = time.perf_counter()

    def steps(self, left: int) -> int:
        """Return the steps of the next window, of those that are left."""
        self.started = time.perf_counter()
        return left if left <= 1.5 * self.n else self.n

    def took(self, n: int) -> None:
        """Note that the window, of n steps, has ended."""
        elapsed = time.perf_counter() - self.started
        self.n = max(1, min(GROWTH * n, int(n * SECONDS / elapsed) if elapsed > 0 else GROWTH * n))


# outputs in memory ----------------------------------------------------------------------------------------------------


def first_window(stepper: Stepper, problem: Problem, n_steps: int, n_saved: int) -> int:
    """Return the steps of the first window of a run of n_steps; 0 for a run in one piece."""
    if n_steps <= (FEW_STEPS if problem.progress is None else 0):
        return 0
    if not stepper.takes_carry or not readable(problem.y0):
        return 0
    size = math.prod(problem.y0.shape)
    if not stepper.compiled:
        return ARRAY_STEPS if problem.progress is not None or n_steps > 2 * ARRAY_STEPS else 0
    first = ONE if problem.y0.ndim == 1 else MANY
    long = n_steps * size > max(2 * first, min(DENSE * n_saved * size, LARGE))
    least = 1 if problem.y0.ndim == 1 else LEAST
    return max(least, first // size) if long or problem.progress is not None else 0


class MemoryRun(GridRun):
    """A run whose outputs are kept in memory: in one piece, or the states that its windows save put together."""

    def __init__(self, integrator: Any, problem: Problem) -> None:
        super().__init__(integrator, problem)
        outputs = self.outputs
        self.t, count, self.remainder = outputs.part(0, outputs.n)
        self.save, self.place = count, None
        """The steps after which states are saved, and for each output its place among them, unless that is the same."""
        if problem.dense_output:
            self.save, self.place = np.arange(self.grid.n_steps + 1), count
        elif problem.t_eval is not None or self.grid.remainder:  # the step that is shorter begins at an output
            self.save, self.place = distinct(count)
        self.last = int(self.save[-1]) if self.save.size else 0
        self.saved: Any = None

    save: np.ndarray
    place: np.ndarray | None

    def windows(self) -> Iterator[float]:
        problem, save, last = self.problem, self.save, self.last
        first = first_window(self.stepper, problem, last, len(save))
        if not first:
            self.saved, finite = self.stepper.rollout(problem.y0, self.grid.h, last, save, problem.t0)
            self.checkpoint = self.checkpoint[0], finite
            return
        pace, most = Pace(first), max(2, MOST_SAVED // math.prod(problem.y0.shape))
        self.saved = rows_of_nan(len(save), problem.y0)
        while self.done < last and (self.finite == self.done).any():
            k, row = self.done, self.row
            to = k + pace.steps(last - k)
            end = int(save.searchsorted(to, "right"))
            if end - row > most:
                to, end = int(save[row + most - 1]), row + most
            self.saved[row:end] = self.advance(to, save[row:end])
            pace.took(to - k)
            self.done, self.row = to, end
            if to < last:
                yield abs(to * self.grid.h)

    def taken(self) -> Outcome:
        problem, grid, stepper, save, place = self.problem, self.grid, self.stepper, self.save, self.place
        t, remainder, finite = self.t, self.remainder, self.finite
        last = self.done if self.stopped else self.last
        if last < self.last:
            save = save[: save.searchsorted(last, "right")]
            n = len(save) if place is None else int(place.searchsorted(len(save)))
            t, remainder, place = t[:n], remainder[:n], None if place is None else place[:n]
        saved = self.saved if last == self.last else self.saved[: len(save)]
        y = saved if place is None else saved[place]
        within = (problem.t_eval is not None or grid.remainder) and bool(remainder.any())
        if within:
            y = shorter_steps(stepper, grid, y, save if place is None else save[place], remainder)
        n_steps = min(last, int(finite.max() if finite.ndim else finite) + 1)
        outcome = Outcome(t, y, 0, finished(problem), self.counted(len(t), n_steps))
        if problem.dense_output:
            reached = Grid(grid.t0, grid.time(last), self.dt) if last < self.last else grid
            outcome.sol = GridSolution(stepper, reached, saved)
        outcome.finite = stepper.compiled and stepper.saves_finite and not within
        self.report_failures(outcome, finite, last)
        outcome.message += stepper.remark
        return outcome


class SearchedRun(GridRun):
    """A run of one trajectory with events: the steps of each window are searched before the next is computed."""

    def __init__(self, integrator: Any, problem: Problem) -> None:
        super().__init__(integrator, problem)
        assert problem.events is not None
        self.search: EventSearch = problem.events
        self.t, self.count, self.remainder = self.outputs.part(0, self.outputs.n)
        self.parts, self.kept = [problem.y0[None][:0]], [problem.y0[None][:0]]
        """The outputs of windows, and for the dense output their states but the last."""
        self.state, self.shorter = problem.y0, 0
        """The state after the windows that are over, and whether the last, shorter step was made."""

    def windows(self) -> Iterator[float]:
        grid, search, count = self.grid, self.search, self.count
        chunk, ended, last = FIRST_CHUNK, False, False
        largest = max(1, min(LAST_CHUNK, MOST_SAMPLES // search.parts(grid.h, self.problem.system.dt)))
        while not (ended or last):
            k = self.done
            n = min(chunk, largest, grid.n_steps - k)
            states = self.advance(k + n, np.arange(k + (k > 0), k + n + 1))
            states = concatenate([self.state[None], states], 0) if k else states
            good = min(n, int(self.finite) - k)
            last = k + n == grid.n_steps or good < n

            times = [grid.time(j) for j in range(k, k + good + 1)]
            taken, ended = self._search(states, times, grid.h)
            if not ended and last and good == n and grid.remainder:
                self.shorter, y = 1, states[good]
                y_end = self.stepper.shorter(y, grid.remainder, times[-1])
                search.n_dense += 1
                if finite_states(y_end):
                    ended = self._search(stack([y, y_end], axis=0), [times[-1], grid.t1], grid.remainder)[1]

            # outputs before the end of this window; a state at its end belongs to the next, unless there is none
            due = self.row + int(np.searchsorted(count[self.row :], k + good, "right" if last else "left"))
            chosen = slice(self.row, due)
            y = shorter_steps(self.stepper, grid, states[count[chosen] - k], count[chosen], self.remainder[chosen])
            self.parts.append(y)
            if self.problem.dense_output:
                self.kept.append(states[: good + (last or ended)])
            self.state, self.row, self.done = states[n], due, k + (taken if ended else good)
            chunk *= 2
            if not (last or ended):
                yield abs(self.done * grid.h)

    def taken(self) -> Outcome:
        grid, search, k, sign = self.grid, self.search, self.done, np.sign(self.grid.h)
        if self.stopped:
            search.forget_after(self.reached, grid.h)
        problem, t, y = self.problem, self.t[: self.row], concatenate(self.parts, 0)[: self.row]
        n_extra = search.n_dense + int(np.count_nonzero(self.remainder[: self.row]))
        outcome = Outcome(t, y, 0, FINISHED, self.stats(k + self.shorter, k, k, n_extra))
        if search.end is not None:
            t_end, y_end = search.end
            n = int(np.count_nonzero((t - t_end) * sign <= 0))
            t, y = t[:n], y[:n]
            if problem.t_eval is None and not (n and t[-1] == t_end):
                t, y = np.append(t, t_end), concatenate([y, y_end[None]], 0)
            outcome.t, outcome.y, outcome.status, outcome.message = t, y, 1, ENDED
        elif not self.stopped:
            self.report_failures(outcome, self.finite, self.checkpoint[0].steps)
        if problem.dense_output:
            t_end = search.end[0] if search.end else self.reached if self.stopped or outcome.status else grid.t1
            kept = concatenate(self.kept, 0)
            kept = concatenate([kept[:k], self.state[None]], 0) if self.stopped else kept
            outcome.sol = GridSolution(self.stepper, Grid(grid.t0, t_end, self.dt), kept)
        outcome.message += self.stepper.remark
        return outcome

    def _search(self, states: Array, times: list[float], h: float) -> tuple[int, bool]:
        """Search steps of length h between states at times: the number that was searched; does the run end?"""
        inner = self._samples(states[: len(times) - 1], times, h)
        for j, (t, end) in enumerate(itertools.pairwise(times)):

            def dense(s: float, t: float = t, y: Array = states[j]) -> Array:
                return self.stepper.shorter(y, s - t, t)

            if self.search.step(t, states[j], end, states[j + 1], dense, inner[j]):
                return j + 1, True
        return len(times) - 1, False

    def _samples(self, states: Array, times: list[float], h: float) -> Array:
        """States (n, parts − 1, 2d) that divide steps of length h, all computed at once."""
        n, parts = len(states), self.search.parts(h, self.problem.system.dt)
        self.search.n_dense += n * (parts - 1)
        if parts == 1 or not n:
            return states[:, None][:, :0]
        lengths = h * np.arange(1, parts) / parts * np.ones((n, 1))
        t = np.array(times[:n])[:, None] * np.ones_like(lengths)
        repeated = stack([unfollowed(states)] * (parts - 1), axis=1)
        with np.errstate(all="ignore"):
            return self.stepper.shorter(repeated, like(lengths, repeated), t)


class StoredRun(GridRun):
    """A run whose outputs a store takes; the outcome has none. A run that was stored before goes on."""

    def __init__(self, integrator: Any, problem: Problem, store: RunStore) -> None:
        super().__init__(integrator, problem)
        if not self.stepper.takes_carry:
            raise ValueError(
                f"`store` needs a run that can be cut, and the loops of method {integrator.name!r} cannot: use "
                "another fixed-step method, or leave `store` out."
            )
        shape = problem.y0.shape
        self._nothing = np.empty(0), problem.y0[None][:0]  # of an outcome whose outputs are in a store
        self.store, self.most = store, max(2, MOST_SAVED // math.prod(shape))
        self.state: Array = problem.y0
        self.failed = np.zeros(shape[:-1], dtype=bool)
        self.earlier: dict[str, Any] = {}
        self.piece = Outcome(problem.y0[:0], problem.y0[:0], 0, finished(problem), {})

    def outcome(self) -> Outcome:
        """Run up to the end, a failure or Ctrl-C, from where the store is."""
        problem, store, outputs = self.problem, self.store, self.outputs
        with store.opened():
            place = store.place()
            if place is not None and store.ended and problem.y0.ndim == 1 and store.status() < 0:
                return self._read(place)  # it cannot go on
            self.row = self._agreed(place)
            if place is not None and place.steps == outputs.last and self.row == outputs.n and store.ended:
                return self._read(place)
            if place is not None:
                self._begin(place)
            return super().outcome()

    def _begin(self, place: Place) -> None:
        """Take up the run at a place."""
        self.state, self.failed = place.state, place.failed
        if place.steps:
            self.checkpoint, self.done = (RunCheckpoint(place.steps, place.running), place.finite), place.steps
        if self.stepper.counts_itself:
            self.earlier = place.counts["stats"]

    def windows(self) -> Iterator[float]:
        store, outputs = self.store, self.outputs
        pace = Pace(ARRAY_STEPS if not self.stepper.compiled else max(1, ONE // math.prod(self.problem.y0.shape)))
        while self.row < outputs.n or self.done < outputs.last:
            self.piece = self._window(pace)
            if self.piece.status:
                break
            if store.due:
                store.commit(self._reached(), _unfinished(UNDER_WAY, self.reached))
            yield abs(self.done * self.grid.h)

    def _window(self, pace: Pace) -> Outcome:
        """Make the steps of a window, and store the outputs in it."""
        problem, outputs, k = self.problem, self.outputs, self.done
        to = k + pace.steps(outputs.last - k)
        end = outputs.up_to(to)
        if end - self.row > self.most:
            end = self.row + self.most
            to = max(k, int(outputs.part(end - 1, end)[1][0]))
        t, count, remainder = outputs.part(self.row, end)
        save, _ = distinct(np.append(count[count > k], to) if to > k else count[:0])
        states = np.concatenate([self.state[None], self.advance(to, save)] if to > k else [self.state[None]])
        pace.took(to - k)
        y = self._within(states[np.append(k, save).searchsorted(count)], count, remainder)
        piece, failed = Outcome(t, y, 0, finished(problem), {}), self.failed
        if problem.y0.ndim == 1:
            self.report_failures(piece, self.finite, to)
        else:
            failed = failed | ~finite_states(y).all(0)
        self.store.append(piece.t, piece.y)
        self.row, self.done, self.state, self.failed = end, to, states[-1], failed
        return piece

    def _within(self, y: Array, count: np.ndarray, remainder: np.ndarray) -> Array:
        """`shorter_steps`; of arrays one by one, so that none depends on how many there are in a window."""
        if self.stepper.compiled:
            return shorter_steps(self.stepper, self.grid, y, count, remainder)
        for i in remainder.nonzero()[0].tolist():
            one = slice(i, i + 1)
            shorter_steps(self.stepper, self.grid, y[one], count[one], remainder[one])
        return y

    def _reached(self) -> Place:
        """The place where the run is."""
        from sympflow.storage.runs import Place

        checkpoint, known = self.checkpoint
        last = checkpoint.steps if known is None else min(checkpoint.steps, int(np.max(known)) + 1)
        stats = self.counted(self.row, last)
        stats |= {name: stats[name] + self.earlier[name] for name in COUNTED if name in self.earlier}
        running = self.problem.y0 if known is None else checkpoint.running
        return Place(checkpoint.steps, running, self.finite, self.state, self.failed, {"stats": stats})

    def taken(self) -> Outcome:
        """Close the store of a run that is over, or commit what Ctrl-C left."""
        problem, store, piece, place = self.problem, self.store, self.piece, self._reached()
        if self.stopped:
            if store.consistent and store.length == self.row:  # else what was committed last stands
                store.commit(place, _unfinished(INTERRUPTED, self.reached))
            return Outcome(*self._nothing, -1, "", place.counts["stats"])
        if problem.y0.ndim > 1:
            piece.t, piece.y = np.zeros(1), np.where(self.failed[..., None], np.nan, 0.0)[None]
            self.report_failures(piece, place.finite, place.steps)
        stats = {**place.counts["stats"], **piece.stats}
        message = piece.message
        if "domain_exit" in store.noted:
            stats["domain_exit"] = store.noted["domain_exit"]
            message += store.noted["warning"]
        if "passed" in store.noted:
            at = np.array(store.noted["failed_at"], dtype=float)
            before = np.asarray(stats.get("failed_at", np.nan), dtype=float)
            at = np.fmin(at, before) if problem.t1 > problem.t0 else np.fmax(at, before)
            passed = np.where(np.isnan(at), piece.status, -1)
            piece.status, stats["failed_at"] = (passed, at) if at.ndim else (int(passed), float(at))
            message = store.noted["passed"] + " The contents of the store after that are meaningless."
        place.counts["stats"] = stats
        store.finish(place, piece.status, message)
        return Outcome(*self._nothing, piece.status, message, stats, finite=True)

    def _read(self, place: Place) -> Outcome:
        """The outcome of a run that has ended, from its store."""
        store = self.store
        stats = {name: np.array(x) if isinstance(x, list) else x for name, x in place.counts["stats"].items()}
        return Outcome(*self._nothing, store.status(), store.message, stats, finite=True)

    def _agreed(self, place: Place | None) -> int:
        """The number of outputs of the store that are those of this run; the end of a shorter one is left out there."""
        store, outputs = self.store, self.outputs
        n, k = store.length, 0 if place is None else place.steps
        if self.problem.t_eval is not None:
            if n > outputs.n or not np.array_equal(store.times(), self.problem.t_eval[:n]):
                raise ValueError(
                    f"`t_eval` does not begin with the {n} times that `store` {store.asked!r} holds: give them, and "
                    "later ones after them, or name another folder."
                )
            return n
        if k > outputs.last:
            raise ValueError(
                f"`t_span` ends at t = {self.grid.t1:.15g}, and `store` {store.asked!r} has reached t = "
                f"{self.grid.t0 + k * self.grid.h:.15g}: give an end at that or later."
            )
        if n > outputs.n + 1:
            raise store.store.damaged(f"it reports {n:,} outputs, more than its {k:,} steps have")
        if n and not (n <= outputs.n and store.times(n - 1)[0] == outputs.part(n - 1, n)[0][0]):
            n -= 1
            store.truncate(n)
        return n


def _unfinished(message: str, t: float) -> dict[str, Any]:
    """The attributes of a store of a run that has reached time t."""
    return {"message": message.format(t=t), "ended": 0, "status": -1}
