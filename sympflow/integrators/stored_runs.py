"""Runs into a store: windows whose outputs are written as they come, and that go on from the last commit."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from sympflow.arrays import Array, finite_states
from sympflow.integrators.contract import INTERRUPTED, Outcome, Problem, finished, interrupted
from sympflow.integrators.grid import Grid, Outputs, distinct
from sympflow.integrators.windows import ARRAY_STEPS, MOST_SAVED, ONE, Pace, Pieces, Steps
from sympflow.kernels.carry import Carry
from sympflow.storage.runs import Place, RunStore

COUNTED = ("force_evaluations", "hessian_evaluations", "curvature_evaluations", "newton_iterations")
"""Statistics of which those of a run that goes on are added to the earlier ones, where it counts them itself."""
DONE = ("saved", "within", "counted", "last")
"""Counts of a stored run: states that were saved, outputs within steps, the step of the last, and whether within it."""
UNDER_WAY = "The run had reached t = {t:.17g}: make the same call with resume=True to go on."


class CountingSteps(Steps, Protocol):
    """Steps that may count their evaluations themselves: see `base.Stepper`."""

    @property
    def counts_itself(self) -> bool:
        """True if `evaluations` tells those that were made so far, whatever the steps."""
        ...


class Driver(Protocol):
    """The run on a grid whose outputs are stored: see `base.GridRun`."""

    problem: Problem
    grid: Grid

    @property
    def stepper(self) -> CountingSteps:
        """The steps of the run."""
        ...

    def stats(self, n_told: int, n_steps: int, n_saved: int, n_extra: int) -> dict[str, Any]:
        """Statistics after so many steps, saved states and shorter steps."""
        ...

    def within(self, y: Array, count: np.ndarray, remainder: np.ndarray) -> Array:
        """Replace the states y, those at grid points `count`, by those a remainder later."""
        ...

    def report_failures(self, outcome: Outcome, finite: np.ndarray, n_run: int) -> None:
        """Set status −1, the time and the message where a trajectory cannot go on."""
        ...


class StoredRun:
    """One run whose outputs a store takes; the outcome has none. A run that was stored before goes on."""

    def __init__(self, run: Driver, store: RunStore) -> None:
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
        """Where the window that is under way began; None between windows."""

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
        carry, finite = Carry(), None
        if place is not None:
            self.state, self.failed = place.state, place.failed
            self.done = {name: place.counts[name] for name in DONE}
            if place.steps:
                carry, finite = Carry(place.steps, place.running), place.finite
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
