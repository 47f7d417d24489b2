"""Galley's doubling: any force as a Hamiltonian system in twice the variables."""

import pickle

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import sympflow
from sympflow import HamiltonianSystem, doubled, solve, systems

RATE = 0.5


@pytest.fixture(scope="module")
def oscillator():
    """The oscillator with friction −λp, doubled."""
    return doubled(systems.harmonic_oscillator(), "-lam*p", params={"lam": RATE})


@pytest.fixture(scope="module")
def pendulum():
    """A pendulum with drag that is quadratic in p, doubled."""
    return doubled(systems.pendulum(), "-0.3*p*abs(p)")


def exact(t, rate=RATE):
    """The damped oscillator from q = 1, p = 0: (2, n)."""
    W = np.sqrt(1 - rate**2 / 4)
    c, s = np.cos(W * t), np.sin(W * t) / W
    return np.exp(-rate * t / 2) * np.stack([c + rate / 2 * s, -s])


class TestHamiltonian:
    def test_of_a_quadratic_system_it_is_the_difference_of_the_copies_less_k(self, oscillator):
        x = oscillator.domain.sample(20, 1)
        q, dq, dp, p = x.T
        H = lambda q, p: (p**2 + q**2) / 2  # noqa: E731
        copies = H(q + dq / 2, p + dp / 2) - H(q - dq / 2, p - dp / 2) + RATE * dq * p
        np.testing.assert_allclose(oscillator.hamiltonian(x), copies, atol=1e-14)

    def test_the_physical_part_of_the_field_has_the_force(self, pendulum):
        y = systems.pendulum().domain.sample(20, 4)
        x = pendulum.lift(y)
        x[:, 1:3] = 0.3  # H is linear in the difference, so that it moves nothing of the mean
        field, (q, p) = pendulum.physical.vector_field(y), y.T
        np.testing.assert_array_equal(pendulum.physical_limit(pendulum.vector_field(x)), field)
        np.testing.assert_allclose(field, np.stack([p, -np.sin(q) - 0.3 * p * abs(p)], axis=-1), atol=1e-15)

    def test_it_agrees_with_the_copies_to_second_order_in_their_difference(self):
        base = systems.henon_heiles()
        system = doubled(base, ["-p1/5", "-p2**3"])
        y = base.domain.sample(5, 2)
        z = np.random.default_rng(3).normal(size=y.shape)
        gaps = []
        for size in (1e-2, 1e-3):
            x = np.concatenate([y[:, :2], size * z[:, :2], size * z[:, 2:], y[:, 2:]], axis=1)
            copies = base.hamiltonian(y + size * z / 2) - base.hamiltonian(y - size * z / 2)
            K = size * (z[:, 0] * -y[:, 2] / 5 + z[:, 1] * -(y[:, 3] ** 3))
            gaps.append(abs(system.hamiltonian(x) - (copies - K)).max())
        assert gaps[1] < 2e-3 * gaps[0]

    def test_damping_is_taken_over(self, oscillator):
        damped = doubled(systems.damped_oscillator(damping=RATE))
        assert sp.expand(damped.symbols.H - oscillator.symbols.H) == 0
        assert damped.physical.external_force is None


class TestPhysicalSolution:
    @pytest.mark.parametrize("method", ["gauss_legendre6", "rk4", "dop853", "dopri5", "projected"])
    def test_the_difference_stays_zero(self, oscillator, method):
        fixed = sympflow.get(method).options()
        options = {"dt": 0.05} if "dt" in fixed else {"rtol": 1e-9, "atol": 1e-9}
        options |= {"of": "tao4"} if method == "projected" else {}
        sol = solve(oscillator, method, (0, 20), **options).physical()
        assert sol.stats["difference"] == 0
        np.testing.assert_allclose(sol.y, exact(sol.t), atol=2e-6)

    def test_tao_leaves_it_by_its_error_and_says_so(self, oscillator):
        sol = solve(oscillator, "tao4", (0, 20), dt=0.1)
        with pytest.warns(RuntimeWarning, match="left the physical limit"):
            assert 0 < sol.physical().stats["difference"] < 1e-3
        np.testing.assert_allclose(sol.y[[0, 3]], exact(sol.t), atol=1e-6)

    def test_y0_is_lifted_by_its_width(self, oscillator, pendulum):
        np.testing.assert_array_equal(oscillator.y0, [1.0, 0.0, 0.0, 0.0])
        sol = solve(oscillator, "gauss_legendre6", (0, 1), [[1.0, 2.0], [3.0, 4.0]], dt=0.1)
        assert sol.y0.shape == (2, 4)
        np.testing.assert_array_equal(sol.physical().y0, [[1.0, 2.0], [3.0, 4.0]])
        full = solve(oscillator, "gauss_legendre6", (0, 1), [1.0, 0.1, 0.0, 2.0], dt=0.1)
        assert full.y[1, -1] != 0
        with pytest.raises(ValueError, match=r"`y0` must have shape \(..., 2\) .* or \(..., 4\)"):
            solve(pendulum, "rk4", (0, 1), [1.0, 2.0, 3.0])
        import torch

        tensor = torch.tensor([1.0, 0.5], dtype=torch.float64, requires_grad=True)
        solve(pendulum, "implicit_midpoint", (0, 1), tensor, dt=0.1).physical().y[0, -1].backward()
        assert tensor.grad[0] != 0

    @pytest.mark.parametrize(
        "metric", ["energy_error", "max_energy_error", "volume_error", "symplecticity_defect", "conformal_defect"]
    )
    def test_what_is_not_kept_names_the_metric_that_holds(self, pendulum, metric):
        sol = solve(pendulum, "gauss_legendre6", (0, 1), dt=0.1).physical()
        with pytest.raises(ValueError, match="reference_error"):
            getattr(sympflow, metric)(sol)

    def test_methods_that_do_not_take_the_force_refuse_the_physical_system(self, pendulum):
        for method in ("verlet", "gauss_legendre6", "tao4"):
            with pytest.raises(ValueError, match=r"which method .* does not take: .*doubled system"):
                solve(pendulum.physical, method, (0, 1))
        sol = solve(pendulum.physical, "dop853", (0, 5), rtol=1e-10, atol=1e-10)
        assert sympflow.reference_error(sol).max() < 1e-8

    def test_a_system_that_is_no_doubled_one_refuses(self):
        sol = solve(systems.pendulum(), "verlet", (0, 1))
        with pytest.raises(ValueError, match="is not doubled"):
            sol.physical()
        with pytest.raises(ValueError, match="is not doubled"):
            solve(systems.pendulum(), "projected", (0, 1), of="verlet")

    def test_projected_steps_stay(self, oscillator):
        sol = solve(oscillator, "projected", (0, 20), of="tao4", dt=0.1).physical()
        assert sol.stats["difference"] == 0
        np.testing.assert_allclose(sol.y, exact(sol.t), atol=1e-6)

    def test_the_doubled_flow_is_symplectic(self, pendulum):
        sol = solve(pendulum, "gauss_legendre6", (0, 5), dt=0.1)
        assert sympflow.symplecticity_defect(sol) < 1e-12

    def test_outputs_are_those_of_the_physical_states(self, pendulum):
        event = lambda t, y: y[0]  # noqa: E731
        sol = solve(pendulum, "gauss_legendre6", (0, 10), [0.5, 0.2], dt=0.1, dense_output=True, events=event)
        physical = sol.physical()
        assert physical.system is pendulum.physical
        assert physical.y.shape == (2, 101)
        assert physical.sol(1.23).shape == (2,)
        assert physical.sol([0.1, 0.2, 0.3]).shape == (2, 3)
        assert physical.y_events[0].shape[1] == 2
        true = solve_ivp(pendulum.physical, (0, 10), [0.5, 0.2], rtol=1e-11, atol=1e-11, dense_output=True)
        np.testing.assert_allclose(physical.sol(sol.t), true.sol(sol.t), atol=1e-7)
        assert sympflow.reference_error(physical).max() < 1e-7
        assert pickle.loads(pickle.dumps(physical)).system.external_force is not None


@pytest.mark.parametrize(
    ("force", "options", "error", "message"),
    [
        ("-g*p", {}, ValueError, "`force` holds g without a value: give it in `params`"),
        (["-p", "-p"], {}, ValueError, "`force` must have 1 components"),
        ("-p*cos(t)", {}, ValueError, "depends on the time t"),
        ("-p2", {}, ValueError, "`force` holds p2, but the system has the coordinates"),
        ("-p +", {}, ValueError, "`force` cannot be parsed"),
        (2j, {}, TypeError, "`force` must be real expressions"),
        (None, {}, TypeError, "`force` is needed"),
        ("-p", {"params": {"c": 1.0}}, ValueError, "`params` has 'c', which the force does not use"),
        (lambda q, p: -p, {"params": {"c": 1.0}}, TypeError, "`params` are for a `force` by symbols"),
    ],
)
def test_bad_forces(force, options, error, message):
    with pytest.raises(error, match=message):
        doubled(systems.pendulum(), force, **options)


def test_bad_systems_and_forces_of_potentials(oscillator):
    with pytest.raises(TypeError, match="`system` must be a HamiltonianSystem"):
        doubled("pendulum", "-p")
    with pytest.raises(TypeError, match="is of a doubling"):
        doubled(oscillator, ["-p1", "-p2"])
    with pytest.raises(TypeError, match="by functions"):
        doubled(HamiltonianSystem(lambda q: (q**2).sum(-1), ndof=1), "-p")
    with pytest.warns(UserWarning, match="derives from a potential"):
        doubled(systems.pendulum(), "-q**3")
