"""The solver's contract beyond the laws of `check_integrator`: tangents, the grid, failure, limits, the Solution."""

import pickle
import re
import tracemalloc

import numpy as np
import pytest
import torch

from sympflow import Box, HamiltonianSystem, get, solve, systems
from sympflow.kernels.explicit_loops import compiled_field
from sympflow.schemes import SCHEMES

HH = systems.henon_heiles()
PENDULUM = systems.pendulum()
SPLITTINGS = sorted(SCHEMES)
ADAPTIVE = ["rk45", "dop853", "dopri5"]
METHODS = [*SPLITTINGS, *ADAPTIVE]


def options(method):
    return {"rtol": 1e-10, "atol": 1e-12} if method in ADAPTIVE else {"dt": 0.04 if method == "euler" else 0.05}


@pytest.mark.parametrize("method", ["verlet", *ADAPTIVE])
def test_no_times_integers_and_a_batch_without_times(method):
    sol = solve(HH, method, (0.0, 1.0), t_eval=[], **options(method))
    assert (sol.y.shape, sol.success) == ((4, 0), True)
    assert solve(PENDULUM, method, (0.0, 0.5), y0=[1, 0], **options(method)).y.dtype == np.float64
    sol = solve(HH, method, (0.0, 0.5), y0=HH.domain.sample(3), **options(method))
    assert (sol.y.shape, sol.t[-1]) == ((3, 4, len(sol.t)), 0.5)


# the grid -----------------------------------------------------------------------------------------


def test_times_are_multiples_not_running_sums():
    sol = solve(PENDULUM, "verlet", (0.1, 1000.1), dt=0.1)
    np.testing.assert_array_equal(sol.t[:-1], 0.1 + np.arange(10_000) * 0.1)
    assert sol.t[-1] == 1000.1
    assert sol.stats["n_steps"] == 10_000


def test_the_last_step_is_shorter():
    sol = solve(PENDULUM, "verlet", (0, 1), dt=0.3)
    step = get("verlet")().step
    np.testing.assert_array_equal(sol.y[:, -1], step(PENDULUM, 0.0, sol.y[:, -2], 1.0 - 3 * 0.3))


# failure ------------------------------------------------------------------------------------------

ESCAPE = {"t_span": (0, 20), "y0": [0, 0, 0, 0.7]}  # the singularity is at t* = 5.450984210235402


def test_a_tensor_that_blows_up():
    sol = solve(HH, "verlet", (0, 20), y0=torch.tensor(ESCAPE["y0"], dtype=torch.float64), dt=0.01)
    assert sol.status == -1
    assert torch.isfinite(sol.y).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [1e308, 1e200, 5e-324])
def test_extreme_states_end_at_once(method, value):
    sol = solve(HH, method, (0, 1), y0=[value, 0.0, 0.0, 0.0])
    assert sol.status == (0 if value < 1 else -1)
    assert np.isfinite(sol.y).all()


def test_leaving_the_domain():
    outside = {"t_span": (0, 3), "y0": [0.0, 0.0, 0.0, 0.6], "dt": 0.1}
    ignored = solve(HH, "verlet", **outside)
    assert (ignored.status, "domain" in ignored.message) == (0, False)
    warned = solve(HH, "verlet", on_domain_exit="warn", **outside)
    assert warned.status == 0
    assert warned.stats["domain_exit"] == 0.0
    assert "left the domain at t = 0" in warned.message
    stopped = solve(HH, "verlet", on_domain_exit="stop", **outside)
    assert stopped.status == -1
    assert len(stopped.t) == 1


def test_leaving_the_domain_concerns_one_trajectory_of_a_batch():
    box = HamiltonianSystem.from_sympy("p**2/2 + q**2/2", domain=Box([-1, -1], [1, 1]))
    y0 = np.array([[0.3, 0.0], [0.9, 0.9], [0.2, 0.2]])
    sol = solve(box, "verlet", (0, 10), y0=y0, on_domain_exit="stop")
    assert sol.status.tolist() == [0, -1, 0]
    assert np.isfinite(sol.y[[0, 2]]).all()
    assert "trajectory 1, the first of 1" in sol.message
    inside = np.isfinite(sol.y[1]).all(0)
    assert 0 < inside.sum() < len(sol.t)
    assert not box.domain.contains(sol.y[1].T[inside][-1])  # the exit itself is kept
    tensors = solve(box, "verlet", (0, 10), y0=torch.tensor(y0), on_domain_exit="stop")
    np.testing.assert_allclose(tensors.y.numpy(), sol.y, atol=1e-13)


def test_a_batch_of_dopri5_with_one_blow_up_goes_on_one_by_one():
    y0 = torch.tensor([ESCAPE["y0"], [0.1] * 4], dtype=torch.float64, requires_grad=True)
    sol = solve(HH, "dopri5", (0, 20), y0=y0, t_eval=[0.0, 3.0, 20.0])
    assert sol.status.tolist() == [-1, 0]
    assert torch.isfinite(sol.y).all(1).tolist() == [[True, True, False], [True] * 3]
    assert torch.isfinite(torch.autograd.grad(sol.y[1].sum(), y0)[0]).all()


@pytest.mark.parametrize("method", ["verlet", "rk45", "dopri5", "rk4", "sympflow"])
def test_solutions_can_be_pickled(method):
    sol = solve(HH, method, (0, 2), dense_output=True)
    copy = pickle.loads(pickle.dumps(sol))
    np.testing.assert_array_equal(copy.y, sol.y)
    np.testing.assert_array_equal(copy.sol(0.7), sol.sol(0.7))
    np.testing.assert_array_equal(copy.energy(), sol.energy())
    assert len(repr(sol)) < 1000


@pytest.mark.parametrize(
    ("method", "arguments"),
    [
        ("rk45", {"t_span": (0, 1e300), "t_eval": [1e300]}),
        ("rk45", {"t_span": (0, 1), "max_step": 1e-300}),
        ("dopri5", {"t_span": (0, 1e300), "t_eval": [1e300], "max_num_steps": 300}),
    ],
)
def test_a_run_that_would_never_end_says_so(method, arguments):
    sol = solve(PENDULUM, method, **arguments)
    assert sol.status == -1
    assert "at this pace the end needs about" in sol.message


@pytest.mark.parametrize("method", ["rk45", "dop853"])
def test_a_limit_on_steps_keeps_what_was_computed(method):
    """An oscillator of 10⁶ rad/s over 1000 s: seen to be hopeless; a limit of one's own: kept exactly up to there."""
    fast = HamiltonianSystem(lambda q: 5e11 * (q**2).sum(-1), ndof=1, gradient=lambda q: 1e12 * q)
    sol = solve(fast, method, (0, 1000), [1.0, 0.0])
    assert (sol.status, sol.stats["n_steps"], len(sol.t)) == (-1, 10_000, 10_001)
    assert re.match(r"After 10,000 steps t = 0\.0\d+ is reached.* `max_steps` is 10,000,000\. Raise it", sol.message)
    assert sol.message.endswith("terms of H that cancel lose digits: rewrite them.")
    few = solve(HH, method, (0, 100), max_steps=7, dense_output=True)
    whole = solve(HH, method, (0, 100))
    assert (few.status, few.stats["n_steps"], few.stats["failed_at"]) == (-1, 7, few.t[-1])
    np.testing.assert_array_equal(few.y, whole.y[:, :8])
    np.testing.assert_allclose(few.sol(few.t[-1]), few.y[:, -1], rtol=1e-14)
    assert sum(len(t) for t, _, _ in few.integrator.steps(HH, few.t_span, few.y0)) == 7  # as metrics execute it
    enough = solve(HH, method, (0, 100), max_steps=len(whole.t) - 1)
    assert (enough.status, enough.message) == (0, whole.message)
    batch = solve(HH, method, (0, 100), [HH.y0, HH.y0], max_steps=7)
    assert batch.status.tolist() == [-1, -1]
    for wrong in (0, -1, 1.5, True, np.inf):
        with pytest.raises(ValueError, match=r"^`max_steps` must be a positive integer"):
            solve(HH, method, max_steps=wrong)


@pytest.mark.parametrize("method", ["rk45", "dop853"])
def test_the_cause_is_named_where_there_is_no_first_step(method):
    """A relative error of a component that is 0, an infinite field: two causes, two remedies."""
    none = solve(PENDULUM, method, (0, 1), [1.0, 0.0], rtol=1e-6, atol=0)
    assert (none.status, none.t.tolist()) == (-1, [0.0])
    assert re.match(
        r"There is no first step from t = 0: `atol` is 0, and `y0` has components .* Give an `atol`", none.message
    )
    infinite = solve(systems.kepler(), method, (0, 1), np.zeros(4))
    assert infinite.message.startswith("The vector field is not finite at t = 0. Check `y0` and its scale.")
    assert solve(PENDULUM, method, (0, 1), [1.0, 0.1], rtol=1e-6, atol=0).success


@pytest.mark.parametrize(
    "value", [1j, np.complex128(1), 10**400, np.nan, "1", [0.1], True, None], ids=lambda v: repr(v)[:9]
)
@pytest.mark.parametrize("option", ["rtol", "atol", "max_step", "first_step", "event_step"])
def test_options_that_are_no_real_numbers(option, value):
    """Complex numbers, and integers that no float holds, are refused by name like anything else."""
    if value is None and option in ("first_step", "event_step"):
        return  # the default
    arguments = {option: value, "events": lambda t, y: y[0]}
    methods = ["rk45", "dop853"] + ["dopri5"] * (option in ("rtol", "atol", "event_step"))
    for method in methods:
        with pytest.raises((ValueError, TypeError), match=f"^`{option}` must be"):
            solve(PENDULUM, method, (0, 1), [1.0, 0.0], **arguments)


@pytest.mark.parametrize("method", ["verlet", "sympflow", "gauss_legendre4", "rk4", "dopri5", "log_leapfrog"])
def test_a_run_that_ends_with_its_last_output_says_so(method):
    """The end of `t_span` is not reached, which for this orbit of the escape could not be."""
    system = systems.kepler() if method == "log_leapfrog" else systems.henon_heiles_escape()
    if method == "sympflow":
        system = HH
    for y0 in (system.y0, np.array([system.y0, system.y0])):
        early = solve(system, method, (0, 100), y0, t_eval=[0.5, 1.0])
        assert early.success
        assert "ended at t = 1, the last time of `t_eval`, before the end of `t_span`, t = 100:" in early.message
        assert solve(system, method, (0, 1), y0, t_eval=[0.5, 1.0]).message.startswith("The solver successfully")
    none = solve(system, method, (0, 100), t_eval=[])
    assert (none.status, none.stats["n_steps"]) == (0, 0)
    assert none.message.startswith("`t_eval` is empty, so no step was made")
    dense = solve(system, method, (0, 2), t_eval=[1.0], dense_output=True)
    assert dense.message.startswith("The solver successfully")
    assert np.isfinite(dense.sol(2.0)).all()


@pytest.mark.parametrize(("method", "y0"), [("dopri8", None), ("dopri5", None), ("rk45", np.zeros((2, 4)))])
def test_outputs_that_fill_the_memory_are_refused_for_adaptive_methods_too(method, y0):
    """They are reported every `system.dt`, which may be short."""
    short = HamiltonianSystem.from_sympy("p1**2/2+p2**2/2+q1**2/2+q2**2/2", y0=[1, 0, 0, 0], dt=1e-8)
    with pytest.raises(ValueError, match=r"^`t_eval` is not given, so [48]e\+11 values"):
        solve(short, method, (0, 1000), y0)


# the Solution -------------------------------------------------------------------------------------


def test_solution_has_the_fields_of_scipy():
    from scipy.integrate import solve_ivp

    ours = solve(PENDULUM, "rk45", (0, 10), dense_output=True)
    theirs = solve_ivp(compiled_field(PENDULUM), (0, 10), PENDULUM.y0, dense_output=True)
    np.testing.assert_array_equal(ours.t, theirs.t)
    np.testing.assert_array_equal(ours.y, theirs.y)
    assert (ours.nfev, ours.status, ours.message) == (theirs.nfev, theirs.status, theirs.message)
    converted = ours.to_scipy()
    assert set(theirs) <= set(converted)
    np.testing.assert_array_equal(converted.sol(3.3), theirs.sol(3.3))
    np.testing.assert_array_equal(np.concatenate([ours.q, ours.p]), ours.y)
    with pytest.raises(ValueError, match=r"^`solution` is a batch"):
        solve(PENDULUM, "verlet", (0, 1), y0=[[1.0, 0.0]]).to_scipy()


def test_a_million_steps_store_what_was_asked_for():
    solve(PENDULUM, "verlet", (0, 1), dt=1e-2)
    tracemalloc.start()
    sol = solve(PENDULUM, "verlet", (0, 1e4), dt=1e-2, t_eval=np.linspace(0, 1e4, 11))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sol.stats["n_steps"] == 1_000_000
    assert sol.y.shape == (2, 11)
    assert peak < 2e6  # storing every state would take 16 MB


def test_general_kinetic_energies():
    masses = HamiltonianSystem.from_sympy("p1**2/4 + p1*p2/5 + p2**2/6 + q1**4 + q1*q2 + q2**2", y0=[1, 0, 0, 1])
    relativistic = HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**4", y0=[1, 0.5])
    for system, method, close in (
        (masses, "kahan_li8", 1e-9),
        (masses, "srkn11b", 1e-8),
        (relativistic, "kahan_li8", 1e-9),
    ):
        reference = solve(system, "dop853", (0, 3), t_eval=[3.0], rtol=1e-12, atol=1e-13).y
        sol = solve(system, method, (0, 3), t_eval=[3.0], backend="array")
        np.testing.assert_allclose(sol.y, reference, rtol=0, atol=close)
    with pytest.raises(ValueError, match=r"^`method` 'srkn11b' needs a kinetic energy"):
        solve(relativistic, "srkn11b")
