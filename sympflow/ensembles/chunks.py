"""Chunks of an ensemble: some of its orbits, run together, each with its status and its message."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.base import FixedStep
from sympflow.integrators.contract import Failure, Integrator, Problem
from sympflow.integrators.grid import Grid
from sympflow.integrators.impulses import landings
from sympflow.integrators.steppers import Stepper
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.solver import solve

BLOCK = 64
"""Rows that array operations take together: what they round depends on their number, and on a row's place in them."""
MOST_VALUES = 1 << 21  # values of states that are held at a time, of 16 MB
FAILED = -1
LONGEST_MESSAGE = 400


@dataclass
class Chunk:
    """Some orbits of an ensemble, one after another in its order; a reduction makes its fields of them.

    `t_eval` (m,) are the times of the states that a reduction is given, None for every step; `y0` is (n, 2d);
    `params` are values (n,) of the parameters of each orbit, where they are others than the system's; `first` is the
    number of the first orbit within the ensemble. `status` (n,) is 0, or −1 for a failed orbit, `messages` say why.
    """

    system: HamiltonianSystem
    integrator: Integrator
    t_span: tuple[float, float]
    t_eval: np.ndarray | None
    y0: np.ndarray
    params: Mapping[str, np.ndarray] = field(default_factory=dict)
    backend: str = "auto"
    first: int = 0
    status: np.ndarray = field(init=False)
    messages: dict[int, str] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.status = np.zeros(len(self.y0), dtype=np.int8)

    def __len__(self) -> int:
        return len(self.y0)

    def rows(self, start: int, stop: int) -> Chunk:
        """A chunk of the rows start … stop alone."""
        params = {name: values[start:stop] for name, values in self.params.items()}
        return replace(self, y0=self.y0[start:stop], params=params, first=self.first + start)

    def take(self, part: Chunk) -> None:
        """Take over what became of the orbits of `part`, some rows of this chunk."""
        shift = part.first - self.first
        self.status[shift : shift + len(part)] = part.status
        self.messages |= {shift + i: text for i, text in part.messages.items()}

    def fail(self, row: int, message: str) -> None:
        """Note that the orbit of a row failed."""
        self.status[row] = FAILED
        self.messages[row] = message[:LONGEST_MESSAGE]

    @cached_property
    def compiled(self) -> bool:
        """True if the steps run in compiled loops, in which no orbit depends on its neighbours."""
        return self._stepper is not None and self._stepper.compiled

    @cached_property
    def _stepper(self) -> Stepper | None:
        """A run with fixed steps; None with a method that chooses them, and of one in pieces."""
        system = self.system
        if not isinstance(self.integrator, FixedStep) or system.between_impulses is not system:
            return None
        if landings(self.integrator, system, *self.t_span)[1]:
            return None
        return self.integrator.stepper(Problem(self.system, *self.t_span, self.y0[:1], backend=self.backend))

    @cached_property
    def times(self) -> np.ndarray:
        """The times (m,) of the states that a reduction is given."""
        if self.t_eval is not None:
            return self.t_eval
        length = self.integrator.step_length(self.system) if self.integrator.on_grid else None
        if length is None:
            raise ValueError(
                f"`t_eval` is needed: each orbit has steps of its own with method {self.integrator.name!r}. Give the "
                "times to report."
            )
        return Grid(*self.t_span, length).outputs(None, 1)

    def windows(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The states along the orbits, in bounded memory: times (m,) and states (n, 2d, m), one window after another.

        States of an orbit from where it failed are NaN.
        """
        times, stepper = self.times, self._stepper
        most = max(1, MOST_VALUES // self.y0.size)
        alike = self.t_eval is None and not self.params
        kernel = None if stepper is None else stepper.kernel
        if len(times) <= most or not alike or stepper is None or kernel is None or len(self) == 1:
            yield times, self.states(times)
            return
        grid = Grid(*self.t_span, stepper.integrator.step_length(self.system))
        carry, last = RunCheckpoint(), np.full(len(self), grid.n_steps)
        for start in range(0, grid.n_steps + 1, most):
            save = np.arange(start, min(start + most, grid.n_steps + 1))
            y, last, _ = kernel.run(grid.h, self.y0, int(save[-1]), save, carry, grid.t0)
            ran_out = np.flatnonzero((last < save[-1]) & (self.status == 0))
            for row in ran_out.tolist():
                self.fail(row, self._reason(grid.time(int(last[row])), ""))
            yield times[save], y.swapaxes(1, 2)
        if grid.remainder:
            with np.errstate(all="ignore"):
                end = stepper.shorter(y[:, -1], np.full(len(self), grid.remainder), grid.time(grid.n_steps))
                yield times[-1:], end[..., None]

    def orbits(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield the row of each orbit, the times (m,), and its states (2d, m), NaN from where it failed."""
        most = max(1, MOST_VALUES // (self.times.size * self.y0.shape[1] or 1))
        for start in range(0, len(self), most):
            part = self.rows(start, start + most)
            y = part.states(self.times)
            self.take(part)
            for i in range(len(part)):
                yield start + i, self.times, y[i]

    def states(self, times: np.ndarray) -> np.ndarray:
        """The states (n, 2d, m) at some times, NaN where an orbit has failed, which is noted."""
        y = np.full((*self.y0.shape, len(times)), np.nan)
        together = self.integrator.on_grid and self.compiled
        for rows in self.blocks(together):
            alone = together and len(rows) == 1  # of which loops round otherwise
            self._run(y, times, np.zeros(2, dtype=int) if alone else rows)
        return y

    def blocks(self, together: bool) -> Iterator[np.ndarray]:
        """Rows that run together: all, or those that by array operations have the same neighbours in any chunk."""
        n = len(self)
        if together:
            yield np.arange(n)
        elif not self.integrator.on_grid:
            yield from np.arange(n)[:, None]
        else:
            for start in range(-(self.first % BLOCK), n, BLOCK):
                yield np.clip(np.arange(start, start + BLOCK), 0, n - 1)

    def _run(self, y: np.ndarray, times: np.ndarray, rows: np.ndarray) -> None:
        """Fill the states of some rows, each of them perhaps more than once."""
        try:
            options: dict[str, Any] = {"t_eval": times, "backend": self.backend, "on_domain_exit": "ignore"}
            options["params"] = {name: values[rows] for name, values in self.params.items()} or None
            options["diagnose"] = len(rows) == 1  # else the messages are those of each orbit, without it
            sol = solve(self.system, self.integrator, self.t_span, self.y0[rows], **options)
        except (KeyboardInterrupt, MemoryError):
            raise
        except Exception as error:  # of one orbit, most likely, which is then found
            several = np.unique(rows)
            if len(several) == 1:
                self.fail(int(rows[0]), f"{type(error).__name__}: {error}")
                return
            for half in np.array_split(several, 2):  # in their places, which those of the other half take too
                self._run(y, times, np.where(np.isin(rows, half), rows, half[0]))
            return
        shape = y.shape[1:]
        values = sol.y if sol.y.shape[1:] == shape else np.full((len(rows), *shape), np.nan)
        if sol.y.shape[1:] != shape:  # the steps of one orbit ended before its outputs did
            values[..., : sol.y.shape[-1]] = sol.y
        y[rows] = values
        failed = np.flatnonzero(np.asarray(sol.status) < 0)
        if not failed.size:
            return
        when = np.broadcast_to(sol.stats.get("failed_at", math.nan), (len(rows),))
        for i in failed.tolist():
            self.fail(int(rows[i]), self._reason(float(when[i]), sol.message if len(rows) == 1 else ""))

    def _reason(self, t: float, message: str) -> str:
        """Why an orbit failed: after t in the words of the method, or in those of its run."""
        if not isinstance(self.integrator, FixedStep) or math.isnan(t):
            return message or Failure.NON_FINITE.value[0] + "."
        what, remedy = self.integrator.breakdown.value
        return f"{what} after t = {t:.15g}. {remedy}, or end `t_span` earlier."
