"""Rollouts: states in memory run as states in registers do, and looks change what they know of alone."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from sympflow import systems
from sympflow.kernels.protocol import RunCheckpoint, Task, run_states
from sympflow.kernels.splittings import Splitting, SplittingCode
from sympflow.kernels.stages import run_table, single_table, step_table
from sympflow.schemes import scheme_named


class InMemory(SplittingCode):
    """The same stages, of states in memory."""

    room = 0

    def stage(self, values, numbers, kind, step):
        return self._through(values, lambda x: super(InMemory, self).stage(x, numbers, kind, step))

    def _through(self, room, stage):
        for i, x in enumerate(stage([room.load(i) for i in range(self.n_values)])):
            room.store(x, i)

    def _executed(self, k, values, numbers):
        if isinstance(values, list):
            return super()._executed(k, values, numbers)
        return self._through(values, lambda x: super(InMemory, self)._executed(k, x, numbers))


@pytest.mark.parametrize(("name", "compensated"), [("verlet", False), ("verlet", True), ("chin4c", False)])
def test_states_in_memory_run_as_those_in_registers(name, compensated):
    scheme = scheme_named(name)
    splitting = Splitting(systems.henon_heiles().symbols.parametric, scheme.level, (), compensated)
    values = systems.henon_heiles().symbols.parametric.values
    table, y0 = run_table(scheme, 0.1).rows(values), np.random.default_rng(0).normal(0, 0.1, (37, 4))
    y0[5] = 40.0  # leaves to infinity
    save, found = np.array([0, 3, 1500, 2000]), []
    for code in (SplittingCode(splitting), InMemory(splitting)):
        carry, pieces = RunCheckpoint(), []
        for some, end in ((save[:2], 40), (save[2:], 2000)):
            task = Task(0.1, y0, end, some, carry, threads=1)
            run = run_states(partial(code.run, table), task, code.n_values, 1)
            pieces += [run.states.copy(), run.n_finite.copy()]
        one = run_states(partial(code.run, table), Task(0.1, y0[5:6], 2000, save), 4, 1)
        mapped = np.empty_like(y0)
        code.mapped(single_table(scheme, 0.1).rows(values), y0, mapped)
        stepped, h = np.empty_like(y0), np.full(len(y0), 0.1)
        code.step_rows(step_table(scheme).rows(values), h, h, h, y0, stepped)
        found.append([*pieces, one.states[0], one.n_finite[0], mapped, stepped])
    for a, b in zip(*found, strict=True):
        assert np.array_equal(a, b, equal_nan=True)
    assert found[0][1][5] == found[0][5] < 40


def test_runs_without_outputs_reach_their_end():
    code = SplittingCode(Splitting(systems.henon_heiles().symbols.parametric, 0))
    values = systems.henon_heiles().symbols.parametric.values
    table, y0 = run_table(scheme_named("verlet"), 0.1).rows(values), np.full((37, 4), 0.1)
    carry = RunCheckpoint()
    run = run_states(partial(code.run, table), Task(0.1, y0, 50, np.zeros(0, int), carry, threads=1), 4, 1)
    assert (run.n_finite == 50).all()
    assert np.isfinite(carry.running).all()
