"""Flows as steppers: solve gives ψ_t for every t, and metrics see a symplectic map."""

import numpy as np
import pytest
import torch

from sympflow import Box, HamiltonianSystem, MLPFlow, SympFlow, solve, systems, train

HH = systems.henon_heiles()
EPS = np.finfo(float).eps


def random_flow(cls=SympFlow, seed=0, **options):
    """An untrained flow with O(1) weights: all structure, no accuracy."""
    flow = cls(2, hidden=(6, 5), dt=0.5, seed=seed, **options)
    return flow.requires_grad_(False)


FLOW, MLP = random_flow(), random_flow(MLPFlow)
Y0 = HH.domain.sample(6, 0).reshape(2, 3, 4)


@pytest.mark.parametrize("flow", [FLOW, MLP], ids=["sympflow", "mlp"])
def test_solve_is_the_flow_at_every_t(flow):
    times = np.array([0.0, 0.1, 0.5, 0.77, 1.5, 2.3])
    sol = solve(HH, flow.kind, (0.0, 2.3), y0=Y0, flow=flow, t_eval=times, dense_output=True, on_domain_exit="ignore")
    for i, t in enumerate(times):
        np.testing.assert_allclose(sol.y[..., i], flow(float(t), torch.tensor(Y0)).numpy(), atol=32 * EPS)
    np.testing.assert_array_equal(sol.sol(times), sol.y)
    assert sol.stats["dt"] == 0.5
    assert sol.stats["n_steps"] == 5  # four of Δt and a shorter one
    shorter = solve(HH, flow, (0.0, 0.5), Y0, dt=0.25, on_domain_exit="ignore")  # another map
    twice = flow(0.25, flow(0.25, torch.tensor(Y0)))
    np.testing.assert_allclose(shorter.y[..., -1], twice.numpy(), atol=32 * EPS)


def test_tensors_and_gradients_to_state_and_weights():
    flow = random_flow(seed=1).requires_grad_(True)
    y0 = torch.tensor(HH.y0, requires_grad=True)

    def final(y, *weights):
        return solve(HH, flow, (0.0, 1.2), y0=y, t_eval=[0.7, 1.2], on_domain_exit="ignore").y

    assert torch.autograd.gradcheck(final, (y0, *list(flow.parameters())[:2]))


def test_a_shipped_flow_takes_the_precision_of_the_state():
    for y0 in (HH.y0.astype(np.float32), torch.tensor(HH.y0, dtype=torch.float32)):
        sol = solve(HH, "sympflow", (0.0, 2.0), y0=y0, **({"dtype": "float32"} if isinstance(y0, np.ndarray) else {}))
        assert sol.y.dtype == y0.dtype
        assert np.abs(np.asarray(sol.y) - solve(HH, "sympflow", (0.0, 2.0)).y).max() < 1e-5


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"flow": FLOW, "dt": 1.0}, ValueError, r"^`dt` must be at most the flow's Δt = 0.5"),
        ({"flow": MLP}, TypeError, r"^`flow` must be a trained flow of kind 'sympflow'; got MLPFlow"),
        ({"flow": "henon_heiles"}, ValueError, r"^`flow` 'henon_heiles' does not name a flow that ships. Is it"),
        ({"flow": "henon_heiles-mlp"}, TypeError, r"^`flow` must be a trained flow of kind 'sympflow'; got MLPFlow"),
        ({"flow": SympFlow(1)}, ValueError, r"^`system` .* degrees of freedom"),
        ({"flow": FLOW, "dtype": "float32"}, TypeError, r"^`y0` is .*float32, but the flow's weights .* pass flow.to"),
        ({"flow": FLOW, "y0": torch.zeros(4)}, TypeError, r"^`y0` is torch.float32"),
    ],
)
def test_bad_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        solve(HH, "sympflow", (0.0, 1.0), **arguments)


def test_a_flow_that_is_wrong_outside_its_domain_warns():
    box = Box([-1.0, -1.0], [1.0, 1.0])
    system = HamiltonianSystem.from_sympy("p**2/2 + q**2/2 + q**4/4", domain=box)
    flow = train(system, restarts=1, steps=5, points=40)
    assert "left the domain" in solve(system, flow, (0, 50), [0.9, 0.9]).message  # and is right there
    for y0 in ([3.0, 3.0], torch.tensor([3.0, 3.0], dtype=torch.float64, requires_grad=True)):
        with pytest.warns(RuntimeWarning, match=r"^The state left the domain .* the flow has an error in one step of"):
            solve(system, flow, (0, 50), y0)


@pytest.mark.parametrize("flow", ["henon_heiles-mlp", "henon_heiles-sympflow"])
@pytest.mark.parametrize("batch", [False, True])
def test_a_network_outside_its_domain_says_that_it_means_nothing_there(flow, batch):
    """Networks stay finite past the singularity at t* = 5.45: the message says that the state is outside the domain."""
    outside = np.array([0.0, 0.0, 0.0, 0.7])
    y0 = np.stack([outside, HH.y0]) if batch else outside
    method = flow.rpartition("-")[2]
    with pytest.warns(RuntimeWarning, match="^The state left the domain of the flow at t = 0, and the relative"):
        sol = solve(HH, method, (0, 7), y0, flow=flow)
    assert np.all(sol.status == 0)
    assert sol.stats["domain_exit"] == 0.0
    assert "where its network was not trained" in sol.message
    assert "meaningless from that time on. Start inside the domain" in sol.message
    assert "means nothing" not in solve(HH, method, (0, 7), 0.5 * HH.y0, flow=flow).message
    stopped = solve(HH, method, (0, 7), y0, flow=flow, on_domain_exit="stop")
    np.testing.assert_array_equal(stopped.status, [-1, 0] if batch else -1)
    assert "domain" not in solve(HH, method, (0, 7), y0, flow=flow, on_domain_exit="ignore").message


def test_a_network_that_ships_runs_by_its_numbers_as_by_its_module():
    oscillator = systems.harmonic_oscillator()
    y0 = oscillator.domain.sample(20, 0)
    sol, named = (
        solve(oscillator, "sympflow", (0.0, 7.3), y0=y0, flow=flow) for flow in (None, "harmonic_oscillator-sympflow")
    )
    np.testing.assert_array_equal(sol.y, named.y)
    tensors = solve(oscillator, "sympflow", (0.0, 7.3), y0=torch.tensor(y0))
    np.testing.assert_allclose(tensors.y.numpy(), sol.y, atol=1e3 * EPS)
    with pytest.raises(ValueError, match="`compensated` sums need the compiled loops of a primed flow"):
        solve(oscillator, "sympflow", (0.0, 1.0), compensated=True)


def test_a_smaller_step_composes_another_map():
    sol = solve(HH, FLOW, (0.0, 1.0), dt=0.25, on_domain_exit="ignore")
    y = torch.tensor(HH.y0)
    for _ in range(4):
        y = FLOW(0.25, y)
    np.testing.assert_allclose(sol.y[:, -1], y.numpy(), atol=32 * EPS)


def test_float32():
    flow = random_flow(dtype=torch.float32)
    sol = solve(HH, flow, (0.0, 2.0), dtype="float32", on_domain_exit="ignore")
    assert sol.y.dtype == np.float32
    assert solve(HH, flow, (0, 1), y0=torch.tensor(HH.y0, dtype=torch.float32)).y.dtype == torch.float32
