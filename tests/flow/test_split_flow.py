"""SympFlows of exact flows of parts: compiled, and fitted; for their laws see `test_families`."""

import numpy as np
import pytest
import torch

from sympflow import Box, HamiltonianSystem, SympFlow, get, solve
from sympflow.systems import double_well, fput, harmonic_oscillator
from sympflow.systems.chains import oscillatory_energies
from sympflow.training.trainer import train

FAST = "(p1**2 + p2**2)/2 + 1e6*q1**2/2 + (q1 - q2)**4/4"  # an oscillator and a free particle
MIXED = "(p1**2 + p2**2)/2 + (q1**2 + q2**2 + 3*(q1 - q2)**2)/2 + q1**4/4"


@pytest.mark.parametrize(
    "make",
    [double_well, lambda: HamiltonianSystem.from_sympy(FAST), lambda: HamiltonianSystem.from_sympy(MIXED)],
    ids=["hyperbolic", "turns_far", "mixed_modes"],
)
@pytest.mark.slow
def test_compiled_steps_of_any_lengths_are_the_flow(make):
    """Lengths from nearly 0 to Δt, for which ωt is up to 300, that is known to its rounding, 3e-14; and back."""
    system = make()
    flow = SympFlow.split(system, 2, dt=0.3, terms=4).requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    for w in flow.parameters():
        w.add_(torch.randn(w.shape, generator=generator, dtype=w.dtype), alpha=0.05)
    x = np.random.default_rng(0).uniform(-0.3, 0.3, (70, 2 * system.ndof))
    t = np.linspace(1e-3, 1, 70) * flow.dt
    kernel = flow.kernel_for(system)
    y = kernel.step(t, x).states
    expected = flow.psi(torch.as_tensor(t), torch.as_tensor(x)).numpy()
    scale = np.abs(expected).max()
    assert np.abs(y - expected).max() < 1e-12 * scale
    signs = np.where(np.arange(70) % 3, -1.0, 1.0)
    back = flow.psi_inverse(torch.as_tensor(t), torch.as_tensor(x)).numpy()
    assert np.abs(kernel.step(signs * t, x).states - np.where(signs[:, None] > 0, y, back)).max() < 1e-12 * scale


def test_untrained_it_is_the_impulse_method():
    system = fput(omega=50.0)
    flow = SympFlow.split(system, 1, dt=0.1, terms=1, filters=False, force_gradient=False, linear_outside=False)
    x = torch.as_tensor(system.y0)
    y = get("impulse")(dt=0.1).step(system, 0.0, system.y0, 0.1)
    assert np.abs(flow(0.1, x).detach().numpy() - y).max() < 1e-14


def harmonic_pair():
    """A fast oscillator coupled to a slow particle."""
    return HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 + 200*q2**2 + (q1 - q2)**4/4", domain=Box([-1, -0.05, -1, -1], [1, 0.05, 1, 1])
    )


@pytest.mark.slow
def test_a_fit_lowers_the_error_at_all_times():
    system = harmonic_pair()
    start = SympFlow.split(system, 2, dt=0.25, terms=4)
    x = torch.as_tensor(system.domain.sample(50, 99))
    t = torch.linspace(0.05, 0.25, 5, dtype=torch.float64)[:, None]
    from sympflow.hamiltonian.exact_flow import reference_step

    exact = np.stack([reference_step(system, x.numpy(), float(s)) for s in t[:, 0]])
    before = np.linalg.norm(start(t, x).detach().numpy() - exact, axis=-1).mean(1)
    flow = train(system, flow=start, points=20, label_times=4, restarts=1, steps=20)
    after = np.linalg.norm(flow(t, x).numpy() - exact, axis=-1).mean(1)
    assert after[-1] < 0.1 * before[-1]
    assert (after < before).all()
    again = train(system, flow=start, points=20, label_times=4, restarts=1, steps=20)
    assert all(torch.equal(a, b) for a, b in zip(flow.parameters(), again.parameters(), strict=True))


@pytest.mark.slow
def test_the_shipped_flow_of_fput_reaches_its_figures():
    system = fput(omega=50.0)
    sol = solve(system, t_eval=np.linspace(0, 200, 1001))
    assert sol.stats["dt"] * 50 >= 5
    assert np.abs(sol.energy_error()).max() < 1e-4
    assert np.abs(oscillatory_energies(system, sol.y.T).sum(-1) - 1).max() < 0.08
    between = solve(system, t_eval=np.linspace(0, 200, 301)[1:] - 0.05)
    assert np.abs(between.energy_error()).max() < 1e-4


@pytest.mark.parametrize("turn", [20.0, 1e3])
def test_the_oscillator_for_a_million_steps(turn):
    system = harmonic_oscillator(100.0)
    flow = SympFlow.split(system, 1, dt=turn / 100)
    sol = solve(system, flow, (0, 1e6 * flow.dt), save_every=1000, on_domain_exit="ignore")
    assert np.abs(sol.energy_error()).max() < 1e-11
