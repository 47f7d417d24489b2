"""Batches whose trajectories have parameters of their own: `solve(..., params=...)`."""

import importlib
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

    @pytest.mark.parametrize("damping", [None, [0.1, 0.3]])
    def test_one_run_takes_drives_and_friction(self, damping, monkeypatch):
        H = "(p1**2 + p2**2)/(2*m) + (1 + a*cos(w*t))*k*(q1**2 + q2**2)/2 - c*q1*q2"
        drive = {"time": "t"} if damping is None else {}
        params = {"m": 1.3, "a": 0.2, "w": 1.7, "k": 1.1, "c": 0.3}
        if damping is not None:
            H, params = H.replace("(1 + a*cos(w*t))*", ""), {name: params[name] for name in "mkc"}
        system = HamiltonianSystem.from_sympy(H, params=params, damping=damping, **drive)
        values = {"k": np.array([0.4, 2.0, 0.7]), "m": 1.3 + np.arange(3), ("c" if damping else "w"): [0.2, 0.3, 0.6]}
        y0, options = 0.2 * np.random.default_rng(1).normal(size=(3, 4)), {"dt": 0.25, "t_eval": [0, 0.55, 2.9, 3]}
        made, whole = [], HamiltonianSystem.with_params
        monkeypatch.setattr(HamiltonianSystem, "with_params", lambda self, **x: made.append(x) or whole(self, **x))
        sol = solve(system, "verlet", (0, 3), y0, params=values, backend="compiled", **options)
        assert len(made) == 1  # for the form of all
        for i in range(3):
            alone = whole(system, **{name: float(value[i]) for name, value in values.items()})
            expected = solve(alone, "verlet", (0, 3), y0[i], backend="array", **options)
            np.testing.assert_allclose(sol.y[i], expected.y, rtol=0, atol=1e-14)

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore:`dt` .* is too long")
    def test_shapes_broadcast_with_those_of_the_states(self, system, y0):
        grid = {"lam": LAM[:, None], "m": [1.0, 2.0]}
        sol = solve(system, "verlet", (0, 1), params=grid, dt=0.25, dense_output=True)
        assert sol.y.shape == (4, 2, 4, 5)
        assert sol.params["m"].shape == (4, 2)
        np.testing.assert_array_equal(sol.sol(1.0), sol.y[..., -1])
        one = solve(
            system.with_params(lam=LAM[3], m=2.0), "verlet", (0, 1), system.y0[None], dt=0.25, dense_output=True
        )
        np.testing.assert_allclose(sol.sol([0.1, 0.6])[3, 1], one.sol([0.1, 0.6])[0], rtol=0, atol=1e-15)
        again = pickle.loads(pickle.dumps(sol))
        np.testing.assert_array_equal(again.sol(0.6), sol.sol(0.6))

    def test_each_becomes_infinite_at_its_own_time(self, system):
        y0, lam = np.array([[0.0, 3.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.1]]), np.array([0.7, 0.7])
        sol = solve(system, "verlet", (0, 9), y0, params={"lam": lam, "m": [1.2, 1.4]}, dt=0.01)
        assert sol.status.tolist() == [-1, 0]
        alone = solve(system.with_params(lam=0.7, m=1.2), "verlet", (0, 9), y0[:1], dt=0.01)
        np.testing.assert_array_equal(sol.stats["blow_up_time"], [alone.stats["blow_up_time"][0], np.nan])
        assert "itself becomes infinite, at about t = " in sol.message


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
        masses = 1.1 + 0.2 * np.arange(len(LAM))
        sol = solve(system, "verlet", (0, 1), y0, params={"m": masses, "lam": LAM}, dt=0.25)
        systems = [system.with_params(lam=x, m=m) for x, m in zip(LAM, masses, strict=True)]
        each = [metric(solve(own, "verlet", (0, 1), y, dt=0.25)) for own, y in zip(systems, y0, strict=True)]
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


PENDULUMS = "p1**2/(2*m) + p2**2/2 + k*(2 - cos(q1) - cos(q2)) + g*m*(q1 - q2)**4/4 + k**2*p1*w"


@pytest.mark.parametrize("method", ["verlet", "srkn11b", "gauss_legendre4", "rk4", "dopri5"])
def test_other_values_need_no_new_functions_and_no_new_code(method, monkeypatch):
    H = PENDULUMS if method == "gauss_legendre4" else PENDULUMS.removesuffix(" + k**2*p1*w")
    more = {"w": 0.1} if method == "gauss_legendre4" else {}
    values = {"k": 1.3, "g": 0.4, "m": 1.7} | more
    options = {"t_eval": [1.0]} | ({} if method == "dopri5" else {"dt": 0.05})
    y0 = np.array([0.3, -0.2, 0.1, 0.4])
    system = HamiltonianSystem.from_sympy(H, params=values)

    def run(system):
        sol = solve(system, method, (0.0, 1.0), y0, **options)
        return sol.y, sol.energy(), system.hessian(y0), system.gradient(y0), system.inverse_mass

    run(system.with_params(k=0.9))
    changed = {"k": 0.7, "g": -1.9, "m": 2.3}
    made = []
    for name in ("symbolic.generate", "recorded.calculated"):
        place, own = f"sympflow.hamiltonian.{name}", name.partition(".")[2]
        before = getattr(importlib.import_module(place.rpartition(".")[0]), own)
        monkeypatch.setattr(place, lambda *args, before=before, own=own: made.append(own) or before(*args))
    found = run(system.with_params(**changed))
    assert made == []
    for mine, anew in zip(found, run(HamiltonianSystem.from_sympy(H, params=values | changed)), strict=True):
        if mine is not None:
            np.testing.assert_allclose(mine, anew, rtol=1e-12, atol=1e-14)
