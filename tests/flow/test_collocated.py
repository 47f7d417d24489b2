"""Collocated flows: symplectic, reversible, and the exact flow of the mean of H over their stages."""

import numpy as np
import pytest
import torch

import sympflow
from sympflow import Box, HamiltonianSystem, SympFlow, conformal_defect, solve
from sympflow.flow.collocated import TOLERANCE

WHOLE = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", domain=Box([-1, -1], [1, 1]), y0=[0.4, 0.3])
DAMPED = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", damping=0.2, y0=[0.4, 0.3])


def test_steps_are_as_many_as_the_tolerance_takes():
    flow = SympFlow.collocated(WHOLE, dt=1.0)
    x = WHOLE.domain.sample(50, 1)
    fine = solve(WHOLE, "gauss_legendre8", (0, 1), x, dt=0.02).y[:, :, -1]
    error = np.abs(solve(WHOLE, flow, (0, 1), x).y[:, :, -1] - fine) / x.std(axis=0)
    assert flow.steps > 1
    assert np.quantile(error, 0.95) < 2 * TOLERANCE
    assert SympFlow.collocated(WHOLE, dt=1.0, states=1e-3 * x).steps < flow.steps


def test_newtons_iterations_are_counted(tmp_path):
    flow = SympFlow.collocated(WHOLE, dt=0.5, stages=2)
    compiled = solve(WHOLE, flow, (0, 5.3))
    assert compiled.stats["force_evaluations"] == 2 * compiled.stats["newton_iterations"] > 0
    flow.save(tmp_path / "flow.safetensors")
    with pytest.raises(ValueError, match="made of steps with the H of a system, which is not in its file"):
        sympflow.load(tmp_path / "flow.safetensors").psi(0.1, torch.zeros(2, dtype=torch.float64))
    x = torch.as_tensor(WHOLE.y0)
    expected = flow(0.7, x)
    torch.testing.assert_close(flow.float()(0.7, x.float()).double(), expected, rtol=0, atol=1e-6)


def test_with_friction_it_is_conformally_symplectic_and_the_flow_of_no_hamiltonian():
    flow = SympFlow.collocated(DAMPED, dt=0.5, steps=1)
    sol = solve(DAMPED, flow, (0, 5))
    assert np.max(conformal_defect(sol)) < 1e-13
    with pytest.raises(ValueError, match="so `flow` has no Hamiltonian"):
        flow.hamiltonian(0.1, torch.as_tensor(DAMPED.y0))


@pytest.mark.slow
def test_gradients_of_runs_are_those_of_differences():
    flow = SympFlow.collocated(WHOLE, dt=0.5, stages=2)
    x = torch.tensor([0.4, 0.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: flow(1.2, x), x)
