"""The shipped flows of FPUT: as good between steps, up to the very end of a step, as on the grid."""

import numpy as np
import pytest

from sympflow import solve
from sympflow.flow.shipped import shipped
from sympflow.systems import fput
from sympflow.training.shipped.judges import PHASES


@pytest.mark.parametrize("omega", [50.0, 1000.0])
def test_energy_at_every_phase_of_a_step(omega):
    system = fput(omega=omega)
    flow = shipped(system)
    n = round(200 / flow.dt) - 1
    t = np.unique(np.linspace(0, n, 300).round())[:, None] + np.array([0.0, *PHASES])
    sol = solve(system, flow, t_eval=t.ravel() * flow.dt)
    assert len(PHASES) >= 20
    assert max(PHASES) > 0.99
    error = np.abs(sol.energy() / system.hamiltonian(system.y0) - 1).max()
    assert error <= 1e-4
    assert error <= flow.figures["between_steps"] * 1.05 + 1e-12  # the figure in the file hides no phase
