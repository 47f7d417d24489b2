"""GridRun: the one driver of runs on the grid t0 + k·dt: at once, in windows, with events, or into a store."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from sympflow.arrays import (
    Array,
    concatenate,
    finite_states,
    is_tensor,
    lanes,
    like,
    stack,
    unfollowed,
)
from sympflow.events import EventSearch
from sympflow.integrators.contract import (
    ENDED,
    FINISHED,
    INTERRUPTED,
    Failure,
    Outcome,
    Problem,
    finished,
    interrupted,
)
from sympflow.integrators.grid import Grid, Outputs, distinct
from sympflow.integrators.interpolants import DenseOutput
from sympflow.integrators.steppers import Stepper, shorter_steps
from sympflow.integrators.windows import ARRAY_STEPS, MOST_SAVED, ONE, Pace, Pieces, Saved, first_window
from sympflow.kernels.protocol import RunCheckpoint

if TYPE_CHECKING:
    from sympflow.storage.runs import Place, RunStore

FIRST_CHUNK, LAST_CHUNK = 8, 1024  # steps between two looks at the events
MOST_SAMPLES = 65536  # of the events, in a chunk
COUNTED = ("force_evaluations", "hessian_evaluations", "curvature_evaluations", "newton_iterations")
"""Statistics of which those of a run that goes on are added to the earlier ones, where it counts them itself."""
DONE = ("saved", "within", "counted", "last")
"""Counts of a stored run: states that were saved, outputs within steps, the step of the last, and whether within it."""
UNDER_WAY = "The run had reached t = {t:.15g}: make the same call with resume=True to go on."


class GridRun:
    """One run on the grid: the steps, the outputs among and within them, the events, and what is not finite."""

    def __init__(self, integrator: Any, problem: Problem) -> None:
        self.integrator, self.problem = integrator, problem
        self.grid = Grid(problem.t0, problem.t1, integrator.step_length(problem.system))
        self.stepper = integrator.stepper(problem)

    def outcome(self) -> Outcome:
        """Run: at once, or, with events, in chunks of steps; into a store in windows."""
        if self.problem.store is not None:
            return self._stored(self.problem.store)
        search = self.problem.events
        outcome = self._whole() if search is None else self._streamed(search)
        outcome.message += self.stepper.remark
        return outcome

    def _whole(self) -> Outcome:
        problem, grid, stepper = self.problem, self.grid, self.stepper
        t, remainder, save, place = self._placed()
        asked = last = int(save[-1]) if save.size else 0
        first = first_window(stepper, problem, last, len(save))
        if first:
            saved, finite, last = self._in_windows(first, last, save)
            if last < asked:
                save = save[: len(saved)]
                outputs = len(save) if place is None else int(place.searchsorted(len(save)))
                t, remainder, place = t[:outputs], remainder[:outputs], None if place is None else place[:outputs]
        else:
            saved, finite = stepper.rollout(problem.y0, grid.h, last, save, problem.t0)

        y = saved if place is None else saved[place]
        extra = remainder.nonzero()[0]
        if extra.size:
            y = shorter_steps(stepper, grid, y, save if place is None else save[place], remainder)
        n_steps = min(last, int(finite.max() if finite.ndim else finite) + 1)
        end = len(save) if n_steps == last else int(save.searchsorted(n_steps, "right"))
        n_saved = end - int(end > 0 and save[0] == 0)
        at_end = int(bool(extra.size) and extra[-1] == len(t) - 1 and t[-1] == grid.t1)
        outcome = Outcome(t, y, 0, finished(problem), self.stats(n_steps + at_end, n_steps, n_saved, int(extra.size)))
        if problem.dense_output:
            reached = grid if last == asked else Grid(grid.t0, grid.time(last), abs(grid.h))
            outcome.sol = GridSolution(stepper, reached, saved)
        outcome.finite = stepper.compiled and stepper.saves_finite and not extra.size
        self.report_failures(outcome, finite, last)
        if last < asked:
            raise interrupted(outcome, grid.time(last))
        return outcome

    def _in_windows(self, first: int, n_steps: int, save: np.ndarray) -> tuple[Array, np.ndarray, int]:
        """`Stepper.rollout` in windows: also the step that was reached, less than n_steps where Ctrl-C ended it."""
        problem, h = self.problem, self.grid.h
        pieces, pace, saved = (
            Pieces(self.stepper, problem, h, RunCheckpoint()),
            Pace(first),
            Saved(len(save), problem.y0),
        )
        most = max(2, MOST_SAVED // math.prod(problem.y0.shape))
        k = row = 0
        try:
            while k < n_steps and not pieces.ended:
                to = k + pace.steps(n_steps - k)
                end = int(save.searchsorted(to, "right"))
                if end - row > most:
                    to, end = int(save[row + most - 1]), row + most
                saved.put(row, pieces.to(to, save[row:end]))
                pace.took(to - k)
                row, k = end, to
                if problem.progress is not None and k < n_steps:
                    problem.progress(abs(k * h))
        except KeyboardInterrupt:
            n_steps = k
        finite = np.zeros(problem.y0.shape[:-1], dtype=int) if pieces.finite is None else pieces.finite
        return saved.up_to(row, int(save.searchsorted(n_steps, "right"))), finite, n_steps

    # a store: windows whose outputs are written --------------------------------------------------------------------

    def _stored(self, store: RunStore) -> Outcome:
        """The same outputs, taken by a store: see `StoredRun`."""
        if not self.stepper.takes_carry:
            raise ValueError(
                f"`store` needs a run that can be cut, and the loops of method {self.integrator.name!r} cannot: use "
                "another fixed-step method, or leave `store` out."
            )
        with store.opened():
            return StoredRun(self, store).outcome()

    def within(self, y: Array, count: np.ndarray, remainder: np.ndarray) -> Array:
        """`shorter_steps`, none of which depends on how many there are in a window, as those of arrays do."""
        if self.stepper.compiled:
            return shorter_steps(self.stepper, self.grid, y, count, remainder)
        for i in remainder.nonzero()[0].tolist():
            one = slice(i, i + 1)
            shorter_steps(self.stepper, self.grid, y[one], count[one], remainder[one])
        return y

    def stats(self, n_told: int, n_steps: int, n_saved: int, n_extra: int) -> dict[str, Any]:
        stepper = self.stepper
        return {
            "dt": abs(self.grid.h),
            "n_steps": n_told,
            **stepper.evaluations(n_steps, n_saved, n_extra),
            "backend": stepper.backend + stepper.why,
            **stepper.more_stats(),
        }

    def _placed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Output times and their remainders, the counts whose states are to be saved, and where among these each is."""
        problem, grid = self.problem, self.grid
        t, count, remainder = grid.outputs(problem.t_eval, problem.save_every)
        if problem.dense_output:
            return t, remainder, np.arange(grid.n_steps + 1), count
        once = problem.t_eval is None and not grid.remainder  # the step that is shorter begins at an output
        return t, remainder, *((count, None) if once else distinct(count))

    # events: the run in chunks of steps, each searched before the next is computed ----------------------------------

    def _streamed(self, search: EventSearch) -> Outcome:
        """The same steps for a single trajectory with events, never more than a chunk of them in memory."""
        problem, grid, stepper = self.problem, self.grid, self.stepper
        system, y = problem.system, problem.y0
        times, count, remainder = grid.outputs(problem.t_eval, problem.save_every)
        outputs: list[Array] = [y[None][:0]]
        kept: list[Array] = []
        chunk, k, shorter, delivered, failed = FIRST_CHUNK, 0, 0, 0, False
        largest = max(1, min(LAST_CHUNK, MOST_SAMPLES // search.parts(grid.h, system.dt)))
        progress = problem.progress

        stopped, done = False, (0, 0, 1, 0)
        try:
            while True:
                n = min(chunk, largest, grid.n_steps - k)
                states, finite = stepper.rollout(y, grid.h, n, np.arange(n + 1), grid.time(k))
                good = min(n, int(finite))
                failed = good < n
                last = k + n == grid.n_steps or failed

                taken, ended = self._search(search, k, states[: good + 1])
                if not ended and last and not failed and grid.remainder:
                    shorter = 1
                    ended = self._search_remainder(search, states[good])

                # outputs before the end of this chunk; a state at its end belongs to the next, unless there is none
                due = delivered + int(np.searchsorted(count[delivered:], k + good, "right" if last else "left"))
                chosen = slice(delivered, due)
                y_due = states[count[chosen] - k]
                outputs.append(shorter_steps(stepper, grid, y_due, count[chosen], remainder[chosen]))
                delivered = due
                if problem.dense_output:
                    kept.append(states[: good + 1] if last or ended else states[:good])
                if ended or last:
                    k += taken if ended else good
                    break
                y, k, chunk = states[n], k + n, 2 * chunk
                done = k, delivered, len(outputs), len(kept)
                if progress is not None:
                    progress(abs(k * grid.h))
        except KeyboardInterrupt:
            stopped = True
            k, delivered, n_outputs, n_kept = done
            outputs, kept = outputs[:n_outputs], [*kept[:n_kept], y[None]]
            search.forget_after(grid.time(k), grid.h)

        t, y_out = times[:delivered], concatenate(outputs, 0)
        finite_outputs = finite_states(y_out)  # a shorter step may overflow too
        failed = failed or not finite_outputs.all()
        t_end = search.end[0] if search.end else grid.time(k) if failed or stopped else grid.t1
        keep = finite_outputs & ((t - t_end) * np.sign(grid.h) <= 0)
        n_keep = len(t) if keep.all() else int(np.argmin(keep))
        t, y_out = t[:n_keep], y_out[:n_keep]
        if search.end and problem.t_eval is None and not (len(t) and t[-1] == t_end):
            t, y_out = np.append(t, t_end), concatenate([y_out, search.end[1][None]], 0)

        n_extra = search.n_dense + int(np.count_nonzero(remainder[:delivered]))
        stats = self.stats(k + shorter, k, k, n_extra)
        outcome = Outcome(t, y_out, int(search.end is not None), ENDED if search.end else FINISHED, stats)
        if failed and not search.end:
            outcome.status = -1
            outcome.stats["failed_at"] = t_end
            outcome.message = self._failure(t_end, k)
        if problem.dense_output:
            outcome.sol = GridSolution(stepper, Grid(grid.t0, t_end, abs(grid.h)), concatenate(kept, 0))
        if stopped:
            raise interrupted(outcome, t_end)
        return outcome

    def _search(self, search: EventSearch, k: int, states: Array) -> tuple[int, bool]:
        """Search the steps between `states`, which begin at grid point k: the number searched; does the run end?"""
        grid, stepper = self.grid, self.stepper
        inner = self._samples(search, k, states[:-1], grid.h)
        for j in range(len(states) - 1):
            t, y = grid.time(k + j), states[j]

            def dense(s: float, t: float = t, y: Array = y) -> Array:
                return stepper.shorter(y, s - t, t)

            if search.step(t, y, grid.time(k + j + 1), states[j + 1], dense, inner[j]):
                return j + 1, True
        return len(states) - 1, False

    def _samples(self, search: EventSearch, k: int, states: Array, h: float) -> Array:
        """States (n, parts − 1, 2d) that divide steps of length h, all computed at once."""
        parts = search.parts(h, self.problem.system.dt)
        search.n_dense += len(states) * (parts - 1)
        lengths = h * np.arange(1, parts) / parts * np.ones((len(states), 1))
        if parts == 1 or not len(states):
            return states[:, None][:, :0]
        t = (self.grid.t0 + (k + np.arange(len(states))) * self.grid.h)[:, None] * np.ones_like(lengths)
        repeated = stack([unfollowed(states)] * (parts - 1), axis=1)
        with np.errstate(all="ignore"):
            return self.stepper.shorter(repeated, like(lengths, repeated), t)

    def _search_remainder(self, search: EventSearch, y: Array) -> bool:
        """Search the last, shorter step of an interval that dt does not divide."""
        grid = self.grid
        t = grid.time(grid.n_steps)

        def dense(s: float) -> Array:
            return self.stepper.shorter(y, s - t, t)

        y_end = dense(grid.t1)
        search.n_dense += 1
        if not finite_states(y_end):
            return False
        inner = self._samples(search, grid.n_steps, y[None], grid.remainder)
        return bool(search.step(t, y, grid.t1, y_end, dense, inner[0]))

    # failures -----------------------------------------------------------------------------------------------------

    def _failure(self, t: float, step: int) -> str:
        what, remedy = self.integrator.breakdown.value
        return f"{what} after t = {t:.15g} (step {step + 1} of {self.grid.n_steps}). {remedy}, or end `t_span` earlier."

    def report_failures(self, outcome: Outcome, finite: np.ndarray, n_run: int) -> None:
        """Set status −1, the time and the message where a trajectory cannot go on; cut a single trajectory there."""
        grid = self.grid
        done = bool((finite >= n_run).all()) if finite.ndim else int(finite) >= n_run
        outcome.finite = done and (outcome.finite or _all_finite(outcome.y))
        if outcome.finite:
            if finite.ndim:
                outcome.status = np.zeros(finite.shape, dtype=int)
            return
        ok = finite_states(outcome.y)  # (n, ...): shorter steps may overflow too
        if is_tensor(outcome.y) and lanes(outcome.y):
            if not ok.all():
                report_lanes(outcome, ok, self.integrator.breakdown)
        elif finite.ndim:
            outcome.status = np.where((finite < n_run) | ~ok.all(0), -1, 0)
            failed = np.argwhere(outcome.status)
            if failed.size:
                what, remedy = self.integrator.breakdown.value
                i = tuple(failed[0].tolist())
                times = grid.t0 + np.minimum(finite, grid.n_steps) * grid.h
                outcome.stats["failed_at"] = np.where(outcome.status < 0, times, np.nan)
                outcome.message = (
                    f"{len(failed)} of {finite.size} trajectories failed, the first of them (index "
                    f"{', '.join(map(str, i))}) after t = {grid.time(int(finite[i])):.15g}. {what}. {remedy}."
                )
        elif finite < n_run or not ok.all():
            last = int(finite) if finite < n_run else int(grid.locate(outcome.t[~ok][:1])[0][0])
            outcome.status = -1
            outcome.stats["failed_at"] = grid.time(last)
            outcome.message = self._failure(grid.time(last), last)
            keep = int(np.argmin(ok)) if not ok.all() else len(ok)
            outcome.t, outcome.y = outcome.t[:keep], outcome.y[:keep]


def report_lanes(outcome: Outcome, ok: np.ndarray, breakdown: Failure) -> None:
    """Flag a run under `torch.func.vmap` of which some lane failed: `ok` (n, ...) is False where one is not finite."""
    what, remedy = breakdown.value
    bad = ~ok.all(0)
    outcome.status = np.where(bad, -1, 0) if bad.ndim else -1
    outcome.stats["failed_at"] = float(outcome.t[int(np.argmin(ok.reshape(len(ok), -1).all(1)))])
    outcome.message = (
        f"{what} in some lane of torch.func.vmap before t = {outcome.stats['failed_at']:.15g}. {remedy}, or pass the "
        "states as a batch, whose trajectories are told apart."
    )


class GridSolution(DenseOutput):
    """Dense output of a fixed-step method: a shorter step from the last grid point before t."""

    def __init__(self, stepper: Stepper, grid: Grid, states: Array) -> None:
        self.stepper, self.grid, self.kept = stepper, grid, states
        self.t_min, self.t_max = sorted((grid.t0, grid.t1))

    def __getstate__(self) -> dict[str, Any]:
        """The choice of the method in place of its run, whose compiled loops belong to a process."""
        stepper = self.stepper
        return {
            "integrator": stepper.integrator,
            "system": stepper.system,
            "grid": self.grid,
            "states": self.kept,
            "backend": stepper.backend,
            "parameter_values": stepper.problem.parameter_values,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        integrator, grid, states = state["integrator"], state["grid"], state["states"]
        backend = "auto" if state["backend"] == "compiled" else "array"
        problem = Problem(
            state["system"],
            grid.t0,
            grid.t1,
            states[0],
            backend=backend,
            parameter_values=state.get("parameter_values"),
        )
        GridSolution.__init__(self, integrator.stepper(problem), grid, states)

    def states(self, times: np.ndarray) -> Array:
        count, remainder = self.grid.locate(times)
        return shorter_steps(self.stepper, self.grid, self.kept[count], count, remainder)


def _all_finite(y: Array) -> bool:
    """True if an array is finite all over; of tensors that is found out elsewhere."""
    return not is_tensor(y) and bool(np.isfinite(y).all())


# a store: windows whose outputs are written as they come --------------------------------------------------------------


class StoredRun:
    """One run whose outputs a store takes; the outcome has none. A run that was stored before goes on."""

    def __init__(self, run: GridRun, store: RunStore) -> None:
        self.run, self.store = run, store
        self.problem, self.grid, self.stepper = run.problem, run.grid, run.stepper
        self.outputs = Outputs(run.grid, run.problem.t_eval, run.problem.save_every)
        shape = run.problem.y0.shape
        self.row, self.most = 0, max(2, MOST_SAVED // math.prod(shape))
        self.state: Array = run.problem.y0
        self.failed = np.zeros(shape[:-1], dtype=bool)
        self.done: dict[str, int] = dict.fromkeys(DONE, 0)
        self.earlier: dict[str, Any] = {}
        self.pieces: Pieces
        self.before: tuple[Any, ...] | None = None
        """The beginning of the window that is under way; None between windows."""

    def outcome(self) -> Outcome:
        """Run up to the end, a failure or Ctrl-C."""
        problem, grid, store, outputs = self.problem, self.grid, self.store, self.outputs
        place = store.place()
        if place is not None and store.ended and problem.y0.ndim == 1 and store.status() < 0:
            return self._read(place)  # it cannot go on
        n_before = store.length
        self.row = self._agreed(place)
        if place is not None and place.steps == outputs.last and self.row == outputs.n and store.ended:
            return self._read(place)
        self._begin(place, self.row < n_before)
        pace = Pace(ARRAY_STEPS if not self.stepper.compiled else max(1, ONE // math.prod(problem.y0.shape)))
        piece = Outcome(problem.y0[:0], problem.y0[:0], 0, finished(problem), {})
        try:
            while self.row < outputs.n or self.pieces.carry.steps < outputs.last:
                piece = self._window(pace)
                if piece.status:
                    break
                t = grid.time(self.pieces.carry.steps)
                if store.due:
                    store.commit(self._reached(), {"message": UNDER_WAY.format(t=t), "ended": 0, "status": -1})
                if problem.progress is not None:
                    problem.progress(abs(self.pieces.carry.steps * grid.h))
        except KeyboardInterrupt:
            if self.before is not None:  # the steps of a window without their outputs are of no use
                self.pieces.carry, self.pieces.finite, self.failed = self.before
            t = grid.time(self.pieces.carry.steps)
            if store.consistent and store.length == self.row:  # else what was committed last stands
                store.commit(self._reached(), {"message": INTERRUPTED.format(t=t), "ended": 0, "status": -1})
            raise interrupted(Outcome(*self._nothing, -1, "", self._reached().counts["stats"]), t) from None
        return self._finished(piece)

    @property
    def _nothing(self) -> tuple[np.ndarray, Array]:
        """No times and no states, as of an outcome whose outputs are in a store."""
        return np.empty(0), self.problem.y0[None][:0]

    def _begin(self, place: Place | None, cut: bool) -> None:
        """Take up the run at a place; `cut` if the last output of the store was left out."""
        carry, finite = RunCheckpoint(), None
        if place is not None:
            self.state, self.failed = place.state, place.failed
            self.done = {name: place.counts[name] for name in DONE}
            if place.steps:
                carry, finite = RunCheckpoint(place.steps, place.running), place.finite
            if cut:  # it was within a step
                self.done["within"] -= self.done["last"]
            if self.stepper.counts_itself:
                self.earlier = place.counts["stats"]
        self.pieces = Pieces(self.stepper, self.problem, self.grid.h, carry, finite)

    def _window(self, pace: Pace) -> Outcome:
        """Make the steps of a window, and store the outputs in it."""
        problem, outputs, pieces, done = self.problem, self.outputs, self.pieces, self.done
        self.before = (pieces.carry, pieces.finite, self.failed)
        k = pieces.carry.steps
        to = k + pace.steps(outputs.last - k)
        end = outputs.up_to(to)
        if end - self.row > self.most:
            end = self.row + self.most
            to = max(k, int(outputs.part(end - 1, end)[1][0]))
        t, count, remainder = outputs.part(self.row, end)
        save, _ = distinct(np.append(count[count > k], to) if to > k else count[:0])
        states = pieces.to(to, save) if to > k else self.state[None][:0]
        pace.took(to - k)
        y = np.concatenate([self.state[None], states])[np.append(k, save).searchsorted(count)]
        y = self.run.within(y, count, remainder)
        piece = Outcome(t, y, 0, finished(problem), {})
        if problem.y0.ndim == 1:
            self.run.report_failures(piece, np.asarray(to) if pieces.finite is None else pieces.finite, to)
        else:
            self.failed = self.failed | ~finite_states(y).all(0)
        self.store.append(piece.t, piece.y)
        if pieces.finite is not None:  # what was saved, up to where the last trajectory ends
            count = count[count <= int(np.max(pieces.finite)) + 1]
        done = {
            "saved": done["saved"] + len(distinct(count[count > done["counted"]])[0]),
            "within": done["within"] + int(np.count_nonzero(remainder)),
            "counted": int(count[-1]) if len(count) else done["counted"],
            "last": int(remainder[-1] != 0) if len(count) else done["last"],
        }
        last = states[-1] if to > k else self.state
        self.row, self.state, self.done, self.before = end, last, done, None
        return piece

    def _reached(self) -> Place:
        """The place where the run is."""
        from sympflow.storage.runs import Place

        y0, pieces, outputs, done = self.problem.y0, self.pieces, self.outputs, self.done
        k, row = pieces.carry.steps, self.row
        last = k if pieces.finite is None else min(k, int(np.max(pieces.finite)) + 1)
        at_end = int(
            row == outputs.n > 0 and bool(self.grid.remainder) and outputs.part(row - 1, row)[0][0] == self.grid.t1
        )
        stats = self.run.stats(last + at_end, last, done["saved"], done["within"])
        stats |= {name: stats[name] + self.earlier[name] for name in COUNTED if name in self.earlier}
        counts = done | {"stats": stats}
        if pieces.finite is None:
            return Place(0, y0, np.zeros(y0.shape[:-1], int), self.state, self.failed, counts)
        return Place(k, pieces.carry.running, pieces.finite, self.state, self.failed, counts)

    def _finished(self, piece: Outcome) -> Outcome:
        """Close the store of a run that is over; `piece` is its last window."""
        problem, store, place = self.problem, self.store, self._reached()
        if problem.y0.ndim > 1:
            piece.t, piece.y = np.zeros(1), np.where(self.failed[..., None], np.nan, 0.0)[None]
            self.run.report_failures(piece, place.finite, place.steps)
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
            message = store.noted["passed"] + " What the store holds after that means nothing."
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
                f"`t_span` ends at t = {self.grid.t1:.17g}, and `store` {store.asked!r} has reached t = "
                f"{self.grid.t0 + k * self.grid.h:.17g}: give an end at that or later."
            )
        if n > outputs.n + 1:
            raise store.store.damaged(f"it tells of {n:,} outputs, and its {k:,} steps have none such")
        if n and not (n <= outputs.n and store.times(n - 1)[0] == outputs.part(n - 1, n)[0][0]):
            n -= 1
            store.truncate(n)
        return n
