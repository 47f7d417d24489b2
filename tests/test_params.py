"""Batches whose trajectories have parameters of their own: `solve(..., params=...)`."""

import pickle

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, solve

LAM = np.array([0.3, 0.0, 0.7, 0.3])


@pytest.fixture(scope="module")
def system():
    H = "(p1**2 + p2**2)/(2*m) + (q1**2 + q2**2)/2 + lam*(q1**2*q2 - q2**3/3) + 2"
    return HamiltonianSystem.from_sympy(H, params={"lam": 0.9, "m": 1.3}, y0=[0.1, 0.2, 0.3, 0.1], name="hh")


@pytest.fixture(scope="module")
def y0():
    return 0.2 * np.random.default_rng(0).normal(size=(len(LAM), 4))


def own(system, method, y0, i, **options):
    """The same trajectory on a system that is made with its values, as a batch of one."""
    return solve(system.with_params(lam=LAM[i]), method, (0, 3), y0[i : i + 1], **options)


OF_CODE = ("chin4c", "gauss_legendre4", "linear_srkn11b")  # compiled anew for the values of each trajectory


class TestTrajectories:
    @pytest.mark.parametrize(
        "method", [*("verlet", "dop853", "rk4"), *(pytest.param(m, marks=pytest.mark.slow) for m in OF_CODE)]
    )
    def test_each_is_that_of_its_own_system(self, system, y0, method):
        options = {"t_eval": [0, 0.55, 3]} | ({} if method == "dop853" else {"dt": 0.25})
        sol = solve(system, method, (0, 3), y0, params={"lam": LAM}, **options)
        assert sol.success
        assert sol.system is system
        for i in range(len(LAM)):
            if method == "chin4c":  # to rounding
                alone = own(system, method, y0, i, backend="array", **options).y[0]
                np.testing.assert_allclose(sol.y[i], alone, rtol=0, atol=1e-14)
            else:
                np.testing.assert_array_equal(sol.y[i], own(system, method, y0, i, **options).y[0])

    def test_tensors_keep_their_gradient(self, system, y0):
        import torch

        start = torch.tensor(y0, requires_grad=True)
        sol = solve(system, "verlet", (0, 1), start, params={"lam": LAM}, dt=0.25)
        (gradient,) = torch.autograd.grad(sol.y[3, 0, -1], start)
        assert gradient[3].abs().min() > 0
        assert gradient[:3].abs().max() == 0
        arrays = solve(system, "verlet", (0, 1), y0, params={"lam": LAM}, dt=0.25)
        np.testing.assert_array_equal(sol.y.detach().numpy(), arrays.y)

    def test_numbers_are_another_system(self, system, y0):
        sol = solve(system, "verlet", (0, 1), params={"lam": 0.5}, dt=0.25, events=lambda t, y: y[0])
        alone = solve(system.with_params(lam=0.5), "verlet", (0, 1), dt=0.25)
        np.testing.assert_array_equal(sol.y, alone.y)
        assert sol.params == {"lam": 0.5, "m": 1.3}
        assert sol.system.params == sol.params

    def test_a_failure_is_of_its_trajectory_alone(self, system, y0):
        y0 = y0.copy()
        y0[2] = 1e3
        sol = solve(system, "verlet", (0, 3), y0, params={"lam": LAM}, dt=0.25)
        assert sol.status.tolist() == [0, 0, -1, 0]
        assert "the first at 2 (lam = 0.7)" in sol.message
        assert np.isfinite(sol.stats["failed_at"][2])
        np.testing.assert_array_equal(sol.y[3], own(system, "verlet", y0, 3, dt=0.25).y[0])

    def test_friction_is_no_parameter(self):
        damped = HamiltonianSystem.from_sympy("p**2/2 - g*cos(q)", params={"g": 1.0}, damping=0.1)
        with pytest.raises(
            ValueError, match=r"'damping', which is not .* `damping` is not one: make a system for each value"
        ):
            solve(damped, "verlet", (0, 1), [1.0, 0.0], params={"damping": [0.1, 0.2]}, dt=0.1)


class TestMetrics:
    @pytest.mark.parametrize(
        "metric",
        [
            sympflow.energy_error,
            sympflow.max_energy_error,
            sympflow.volume_error,
            sympflow.symplecticity_defect,
            sympflow.reference_error,
            sympflow.time_reversal_error,
        ],
    )
    def test_each_trajectory_is_judged_by_its_own_system(self, system, y0, metric):
        sol = solve(system, "verlet", (0, 1), y0, params={"lam": LAM}, dt=0.25)
        each = [
            metric(solve(system.with_params(lam=x), "verlet", (0, 1), y, dt=0.25)) for x, y in zip(LAM, y0, strict=True)
        ]
        np.testing.assert_allclose(metric(sol), each, rtol=1e-9, atol=1e-14)


class TestRefusals:
    @pytest.mark.parametrize(
        ("params", "error", "words"),
        [
            ({"x": 1.0}, ValueError, "not a parameter of 'hh', which has lam, m"),
            ({"lam": "a"}, TypeError, "finite real numbers"),
            ({"lam": [True]}, TypeError, "finite real numbers"),
            ({"lam": [1.0, np.nan]}, ValueError, r"lam = nan at \(1,\)"),
            ({"lam": np.ones(3)}, ValueError, r"broadcast with the batch \(4,\)"),
            ({"lam": []}, ValueError, "no values of lam"),
            ({}, ValueError, "empty"),
            (3, TypeError, "a mapping"),
            ({"m": [1.0, 1.0, 1.0, 0.0]}, ValueError, r"m = 0 \(trajectory 3\)"),
        ],
    )
    def test_bad_values(self, system, y0, params, error, words):
        with pytest.raises(error, match=f"`params`.*{words}"):
            solve(system, "verlet", (0, 1), y0, params=params, dt=0.25)

    def test_systems_without_parameters(self, y0):
        with pytest.raises(ValueError, match="which has none"):
            solve(sympflow.systems.henon_heiles(), "verlet", params={"lam": 1.0})
        functions = HamiltonianSystem(lambda q: (q**2).sum(-1), ndof=1, y0=[1.0, 0.0])
        with pytest.raises(TypeError, match="given by functions"):
            solve(functions, "verlet", params={"lam": 1.0})

    def test_a_trained_flow_holds_for_its_own_parameters(self):
        system = sympflow.systems.spring_pendulum()
        name, value = next(iter(system.params.items()))
        with pytest.raises(ValueError, match=f"`params` changes {name}, and a trained flow"):
            solve(system, "sympflow", params={name: [value, 7.0]})
        with pytest.raises(ValueError, match=f"`params` changes {name}, and a trained flow"):
            sympflow.ensemble(system, "sympflow", params={name: [value, 7.0]})


@pytest.mark.parametrize("values", [{"k": 0.0}, {"k": 1.0}, {"k": -1.0}, {"n": 3}])
def test_values_with_another_structure_are_a_formula_of_their_own(values):
    H, params = "p**2/2 + k*q**2/2 + b*q**n", {"k": 0.5, "b": 0.3, "n": 4}
    system = HamiltonianSystem.from_sympy(H, params=params).with_params(**values)
    expected = HamiltonianSystem.from_sympy(H, params=params | values)
    assert system.expression == expected.expression
    q = np.linspace(-1.0, 1.0, 5)[:, None]
    np.testing.assert_array_equal(system.potential(q), expected.potential(q))


def test_values_without_a_meaning_are_refused():
    system = HamiltonianSystem.from_sympy("p**2/(2*m) + sqrt(k)*q**2", params={"m": 2.0, "k": 2.0})
    for values in ({"m": 0.0}, {"k": -2.0}):
        with pytest.raises(ValueError, match=r"is not a finite real one|must be real"):
            system.with_params(**values)


def test_a_driven_system_keeps_its_period_with_its_driving():
    H = "p**2/2 - k*cos(q)*(1 + cos(w*t)/3)"
    driven = HamiltonianSystem.from_sympy(H, time="t", period=np.pi, params={"w": 2.0, "k": 1.5})
    assert driven.with_params(w=3.0).period is None
    assert driven.with_params(k=2.0).period == np.pi  # the strength of the drive
    still = HamiltonianSystem.from_sympy("p**2/2 - k*cos(q) + q*cos(2*t)", time="t", period=np.pi, params={"k": 1.5})
    assert still.with_params(k=2.0).period == np.pi


def test_a_drive_of_amplitude_zero_is_none():
    driven = HamiltonianSystem.from_sympy(
        "p**2/2 + q**2/2 + a*q*cos(w*t)", time="t", params={"a": 0.3, "w": 2.0}, period=np.pi, y0=[1.0, 0.0]
    )
    free = HamiltonianSystem.from_sympy("p**2/2 + q**2/2", y0=[1.0, 0.0])
    still = pickle.loads(pickle.dumps(driven.with_params(a=0)))
    assert still.autonomous
    assert still.period is None
    again = still.with_params(a=0.3)
    assert again.period == driven.period
    assert again.hamiltonian(driven.y0, 0.7) == driven.hamiltonian(driven.y0, 0.7)
    options = {"dt": 0.1, "backend": "array"}
    sol = solve(driven, "gauss_legendre4", (0, 1), driven.y0, params={"a": [0.0, 0.3]}, **options)
    np.testing.assert_array_equal(sol.y[0], solve(free, "gauss_legendre4", (0, 1), [free.y0], **options).y[0])
    with pytest.raises(ValueError, match="with the values of `system` it does not"):
        solve(still, "verlet", (0, 1), params={"a": [0.0, 0.3]}, dt=0.1)
    with pytest.raises(ValueError, match="`time` is 't', which H does not depend on"):
        HamiltonianSystem.from_sympy("p**2/2 + q**2/2", time="t")
