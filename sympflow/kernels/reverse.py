"""Gradients of runs: states are kept, all of them or those at the starts of segments, and stages reversed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from sympflow.kernels.protocol import Batch, Kernel, RunCheckpoint, Task, begun_in, end_finite
from sympflow.kernels.rollouts import aligned, zeros
from sympflow.kernels.threads import BLOCK, NEVER, given, run_one, run_rows

__all__ = ["Between", "Chained", "Recorded"]

MOST_KEPT = 2**23  # numbers of the states that are kept from a run, 64 MB
SEGMENT = 2**18  # numbers of the states of a segment, which is run again: 2 MB
ROWS = 256  # that run together, whatever the threads


class Recorded:
    """A run of rows y0 (N, 2d), or with own values behind each, whose cotangents can be pulled back.

    The results are `states` (N, len(save), 2d), and `n_finite` (N,), the last step of each that ends in a finite state.
    """

    def __init__(self, code: Any, table: Any, y0: np.ndarray, n_steps: int, save: np.ndarray, work: float) -> None:
        self._code, self._table, self._y0, self._work = code, table, given(y0), work
        self._n_steps, self._save = n_steps, given(save, np.int64)
        self._link = (len(table[1]) if isinstance(table, tuple) else table.shape[1]) - 2
        self._given, self._n_own = self._y0, (own := y0.shape[1] - code.n_out)
        if own and len(y0) == 1 and not isinstance(table, tuple):  # one of all trajectories, which is prepared once
            self._table, self._y0 = table.copy(), self._y0[:, : code.n_out]
            self._table[len(table) - own :] = y0[0, code.n_out :, None]
        self._own = self._y0.shape[1] > code.n_out
        self.states = np.empty((len(y0), len(save), code.n_out))
        self.n_finite = np.zeros(len(y0), dtype=np.int64)
        size = self._link * code.n_values
        self._whole = n_steps * size * len(y0) <= MOST_KEPT
        steps = n_steps if self._whole else max(1, SEGMENT // size // min(ROWS, len(y0)), int(n_steps**0.5) // ROWS)
        self._ends = [*range(0, n_steps, max(steps, 1)), n_steps]
        self._histories: dict[int, list[np.ndarray]] = {}
        self._each(self._run)

    def _each(self, call: Callable[[slice, np.ndarray], None]) -> None:
        """Call a function of slices of rows, which are the same whatever the threads."""
        n, work = len(self._y0), self._n_steps * self._work
        if n <= ROWS:
            run_one(partial(call, slice(0, n)), n * work)
            return

        def pieces(i: slice, stop: np.ndarray) -> None:
            for k in range(i.start // BLOCK, -(-i.stop // BLOCK)):
                call(slice(k * ROWS, min((k + 1) * ROWS, n)), stop)

        run_rows(pieces, -(-n // ROWS) * BLOCK, work * ROWS / BLOCK, None)

    def _width(self, n_rows: int) -> int:
        return self._code.lanes if n_rows >= self._code.fewest else 1

    def _room(self, n_rows: int, n_steps: int) -> np.ndarray:
        """Memory for the states before all stages."""
        width = self._width(n_rows)
        return aligned(-(-n_rows // width) * width * (n_steps * self._link + 1) * self._code.n_values)

    def _run(self, i: slice, stop: np.ndarray) -> None:
        """Run some rows, segment by segment: each begins with what the one before leaves."""
        code, n = self._code, i.stop - i.start
        history = self._histories[i.start] = []
        running, finite = np.empty((n, 0 if self._whole else code.n_values - code.counted)), self.n_finite[i]
        for first, to in pairwise(self._ends):
            history.append(self._room(n, to) if self._whole else running.copy())
            low, high = self._save.searchsorted((first, to), "right").tolist()
            chosen = slice(low if first else 0, high)  # with the first state
            found, kept = np.empty_like(finite) if first else finite, history[-1] if self._whole else None
            room = self._save[chosen], self.states[i, chosen], found
            batch = Batch(self._y0[i], to, *room, first, running, np.zeros(n), stop, kept)
            code.run(self._table, batch)
            if first:
                finite[:] = np.where(finite < first, finite, found)
        if self._n_steps == 0:
            self.states[i] = self._y0[i, None, : code.n_out]

    def pulled(self, cotangents: np.ndarray, slopes: bool) -> tuple[np.ndarray, np.ndarray]:
        """The cotangents of the states (N, 2d), for those of the outputs (N, len(save), 2d).

        With `slopes` those of the own values of each row too, (n, N), or the sums of `SplittingRollouts.summed`.
        """
        if (self.n_finite < self._n_steps).any():
            return self._pulled_apart(cotangents, slopes)
        if not self._n_steps:
            return cotangents.sum(1), self._nothing()
        pieces: dict[int, tuple[np.ndarray, ...]] = {}

        def piece(i: slice, stop: np.ndarray) -> None:
            pieces[i.start] = self._pulled(i, cotangents[i], slopes, stop)

        self._each(piece)
        rows, values = zip(*(pieces[k] for k in sorted(pieces)), strict=True)
        of_states = rows[0] if len(rows) == 1 else np.concatenate(rows)
        of_states = of_states[:, : self._code.n_out]
        if n := int(self._save.searchsorted(0, "right")):
            of_states = of_states + cotangents[:, :n].sum(1)
        return of_states, np.concatenate(values).T if self._n_own else np.sum(values, axis=0)

    def _nothing(self) -> np.ndarray:
        code = self._code
        return np.zeros((self._n_own, len(self._y0))) if self._n_own else code.summed(code.prepared(self._table)[1])

    def _pulled_apart(self, cotangents: np.ndarray, slopes: bool) -> tuple[np.ndarray, np.ndarray]:
        """`pulled` of the rows that stay finite together, and of others alone up to the last output that is finite."""
        save, finite, given = self._save, self.n_finite, self._given
        of_states, of_values = np.zeros((len(finite), self._code.n_out)), self._nothing()
        good = np.flatnonzero(finite >= self._n_steps)
        parts = [(good, self._n_steps, len(save))] if good.size else []
        for k in np.flatnonzero(finite < self._n_steps).tolist():
            m = int(save.searchsorted(finite[k], "right"))
            parts.append((np.array([k]), int(save[m - 1]) if m else 0, m))
        for rows, n_steps, m in parts:
            part = Recorded(self._code, self._table, given[rows], n_steps, save[:m], self._work)
            of_states[rows], more = part.pulled(cotangents[rows, :m], slopes)
            of_values[..., rows if self._n_own else slice(None)] += more
        return of_states, of_values

    def _pulled(self, i: slice, given: np.ndarray, slopes: bool, stop: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pull cotangents of the outputs of some rows back to their first states, and to own values or weights."""
        code, table, n = self._code, self._table, i.stop - i.start
        width, y0, starts = self._width(n), self._y0[i], self._given[i]
        own = " own" if self._own else ""
        entries, kinds = code.own_columns(table, y0[:, code.n_out :], width) if own else code.prepared(table)
        groups = -(-n // width)
        found = zeros(groups * len(kinds) * code.size * width if slopes and self._n_own else 1)
        numbers = found if isinstance(table, tuple) else table
        rows = np.zeros((groups * width, code.n_values))  # lanes without a trajectory have no cotangents
        values = np.zeros((len(rows), self._n_own))
        if n < len(rows):
            starts = np.concatenate([starts, starts[-1:].repeat(len(rows) - n, axis=0)])
        name = ("slopes" if slopes else "reverse") + own
        for (first, to), before in reversed([*zip(pairwise(self._ends), self._histories[i.start], strict=True)]):
            kept = before
            if not self._whole:
                kept = self._room(n, to - first)
                nothing = np.empty((n, 0, code.n_out)), np.empty(n, dtype=np.int64)
                batch = Batch(y0, to, self._save[:0], *nothing, first, before, np.zeros(n), stop, kept)
                code.run(table, batch, False)
            chosen = slice(*self._save.searchsorted((first, to), "right").tolist())
            later, count = self._save[chosen], chosen.stop - chosen.start
            outputs = np.ascontiguousarray(given[:, chosen])
            if n < len(rows):
                outputs = np.concatenate([outputs, np.zeros((len(rows) - n, *outputs.shape[1:]))])
            if not count:
                later = outputs = NEVER
            sizes = len(rows), first, to, later, count, outputs
            code.call(name, width, entries, kinds, len(kinds) - 2, kept, rows, *sizes, found, numbers, starts, values)
        return rows[:n], values[:n] if self._n_own else code.summed(kinds)


Pull = Callable[[np.ndarray], np.ndarray]


class Between:
    """A run between a map of its initial states and one of its outputs, whose cotangents are pulled back through both.

    `states` (N, m, 2d) are what the second map makes of the last m outputs of a task, which are the run's, and `out`
    pulls their cotangents back to these; `into` pulls those of the run's initial states (N, 2d) back.
    """

    def __init__(self, task: Task, run: Recorded, states: np.ndarray, out: Pull, into: Pull) -> None:
        self._run, self._out, self._into, self._begun = run, out, into, begun_in(task.save)
        self.states = np.concatenate([np.repeat(task.y0[:, None], self._begun, axis=1), states], axis=1)
        self.n_finite = run.n_finite.copy()
        end_finite(self.states, task.save, self.n_finite)

    def pulled(self, cotangents: np.ndarray, slopes: bool) -> tuple[np.ndarray, np.ndarray]:
        """As `Recorded.pulled`."""
        of_states, of_values = self._run.pulled(self._out(cotangents[:, self._begun :]), slopes)
        return self._into(of_states) + cotangents[:, : self._begun].sum(1), of_values


class Chained:
    """A run of an autonomous kernel whose cotangents are pulled back step by step, as of `Recorded`.

    This is done by the Jacobians of its steps, those of a segment together, or by ``pull(states, cotangents)``, where
    states (N, 2d) are those after a step. The place at which each segment begins is kept; where there are several, each
    is run again, with the same bits.
    """

    def __init__(
        self, kernel: Kernel, task: Task, pull: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    ) -> None:
        self._kernel, self._pull = kernel, pull
        self._task = task = task._replace(y0=given(task.y0), save=given(task.save, np.int64))
        n_rows, size = task.y0.shape
        steps = max(1, (SEGMENT // size if pull is None else MOST_KEPT) // (n_rows * size))
        self._ends = [*pairwise([*range(0, task.n_steps, steps), task.n_steps])]
        self._starts, self._places = [task.y0], [RunCheckpoint()]
        self._states: np.ndarray | None = None
        self.n_finite, found = np.full(n_rows, task.n_steps), [task.y0[:, None].repeat(begun_in(task.save), axis=1)]
        for first, to in self._ends:
            states, n_finite = self._run(len(self._places) - 1)
            self.n_finite = np.where(n_finite < to, np.minimum(self.n_finite, n_finite), self.n_finite)
            found.append(states[:, task.save[slice(*self._asked(first, to))] - first - 1])
            self._starts.append(states[:, -1])
            self._states = states if to - first == task.n_steps else None
        self.states = np.concatenate(found, axis=1)

    def _asked(self, first: int, to: int) -> list[int]:
        """Where the outputs after steps in first + 1 … to begin and end."""
        return self._task.save.searchsorted((first, to), "right").tolist()

    def _run(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """The states after all steps of a segment, and the last finite ones; the place after it, if that is new."""
        (first, to), place = self._ends[i], self._places[i]
        carry = RunCheckpoint(place.steps, place.running)
        run = self._kernel.runs(self._task._replace(n_steps=to, save=np.arange(first + 1, to + 1), carry=carry))
        if len(self._places) == i + 1:
            self._places.append(carry)
        return run.states, run.n_finite

    def pulled(self, cotangents: np.ndarray, slopes: bool) -> tuple[np.ndarray, np.ndarray]:
        """The cotangents of the states (N, 2d), for those of the outputs (N, len(save), 2d)."""
        total = np.zeros_like(self._task.y0)
        for i, (first, to) in reversed([*enumerate(self._ends)]):
            states = self._run(i)[0] if self._states is None else self._states
            pull = self._pull or self._by_jacobians(np.concatenate([self._starts[i][:, None], states[:, :-1]], axis=1))
            for n in range(to, first, -1):
                changed = total + cotangents[:, slice(*self._asked(n - 1, n))].sum(1)
                changed = pull(states[:, n - first - 1], changed)
                total = np.where(n <= self.n_finite[:, None], changed, 0.0)
        return total + cotangents[:, : begun_in(self._task.save)].sum(1), np.zeros((0, len(total)))

    def _by_jacobians(self, before: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The reverse of the steps from states (N, m, 2d), the last one first."""
        rows = before.reshape(-1, before.shape[-1])
        made = self._kernel.tangents(np.full(len(rows), self._task.h), rows)
        assert made is not None  # after `check_reverse`
        later = iter(made[1].reshape(*before.shape, -1).transpose(1, 0, 3, 2)[::-1])
        return lambda _, cotangents: np.matmul(next(later), cotangents[..., None])[..., 0]
