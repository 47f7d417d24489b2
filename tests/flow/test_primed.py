"""Primed SympFlows: splitting schemes whose coefficients depend on t, and SympFlows in every respect."""

import numpy as np
import pytest
import torch
from conftest import FULL_MASS_MATRIX, tampered
from conftest import RELATIVISTIC as RELATIVISTIC_H

import sympflow
from sympflow import HamiltonianSystem, SympFlow, get, solve, systems, train
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.schemes import SCHEMES, Scheme

EPS = np.finfo(float).eps
HH, PENDULUM = systems.henon_heiles(), systems.pendulum()
MASSES = HamiltonianSystem.from_sympy(
    FULL_MASS_MATRIX, name="masses", domain=sympflow.Ball([0.0] * 4, 1.0), y0=[0.3, 0.1, -0.2, 0.4]
)
RELATIVISTIC = HamiltonianSystem.from_sympy(RELATIVISTIC_H, domain=sympflow.Ball([0.0, 0.0], 1.0))


def random_flow(system, *, size=0.05, seed=0, **options):
    """A flow with all its coefficients free of any pattern."""
    flow = SympFlow.primed(system, **options).requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    for parameter in flow.parameters():
        parameter.add_(size * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return flow


def states(system, n=7, seed=0):
    return torch.as_tensor(system.domain.sample(n, seed))


FLOWS = {
    "palindrome": lambda: random_flow(HH, stages=4, degree=5),
    "free": lambda: random_flow(HH, stages=3, palindromic=False, degree=3),
    "kick first": lambda: random_flow(PENDULUM, scheme="verlet", degree=3),
    "from a force-gradient scheme": lambda: random_flow(MASSES, scheme="omelyan4"),
    "without force gradient": lambda: random_flow(HH, scheme="blanes_moan4", force_gradient=False),
    "kinetic energy not quadratic": lambda: random_flow(RELATIVISTIC, scheme="mclachlan4", palindromic=False),
    "processed": lambda: random_flow(HH, stages=2, processor=2, degree=4),
    "processed, kick first": lambda: random_flow(MASSES, scheme="verlet", processor=1, palindromic=False),
    "processed, no gradients": lambda: random_flow(RELATIVISTIC, scheme="mclachlan4", palindromic=False, processor=3),
    "gradients in some kicks": lambda: random_flow(HH, stages=3, processor=1, degree=3, force_gradient=[1]),
    "curvature": lambda: random_flow(HH, stages=2, degree=3, curvature=True),
    "processed, with curvature": lambda: random_flow(HH, scheme="verlet", processor=1, curvature=True),
    "polynomial": lambda: random_flow(HH, stages=2, degree=3, polynomial=4),
    "processed, with polynomials": lambda: random_flow(HH, size=0.01, scheme="verlet", processor=1, polynomial=4),
    "some kicks with more terms": lambda: random_flow(HH, stages=3, degree=3, processor=1, curvature=[1]),
    "another dt": lambda: random_flow(HH, stages=2, dt=0.3, degree=1),
}


@pytest.fixture(params=FLOWS.values(), ids=FLOWS.keys())
def flow(request):
    return request.param()


def processed(stages=2, processor=2, **options):
    return random_flow(HH, stages=stages, processor=processor, **options)


@pytest.mark.parametrize("name", SCHEMES)
def test_untrained_it_is_the_scheme_at_every_t(name):
    flow = SympFlow.primed(HH, scheme=name, dt=0.5, palindromic=SCHEMES[name].symmetric)
    y = HH.domain.sample(4, 0)
    for t in (0.07, 0.5):
        expected = get(name)().step(HH, 0.0, y, t)
        np.testing.assert_allclose(flow(t, torch.tensor(y)).detach().numpy(), expected, atol=32 * EPS)


def test_at_time_zero_the_hamiltonian_is_the_systems(flow):
    """Consistency, Σb(0) = Σa(0) = 1, whatever the parameters."""
    x = states(flow.system)
    torch.testing.assert_close(flow.hamiltonian(0.0, x), flow.system.hamiltonian(x), rtol=0, atol=32 * EPS)
    for column in (flow.kicks, flow.drifts):
        assert abs(column.table[:, 0].sum() - 1) < 8 * EPS


# processed ----------------------------------------------------------------------------------------------------


def test_untrained_the_processor_is_the_identity():
    x = states(HH)
    with_it, without = SympFlow.primed(HH, 3, processor=4), SympFlow.primed(HH, 3, degree=5)
    assert torch.equal(with_it(1.0, x), without(1.0, x))
    assert with_it.n_parameters == without.n_parameters + (4 + 5 + 4) * 3


def test_tables_of_a_processed_flow():
    flow, y = processed(), HH.domain.sample(3, 0)
    kernel, chi = flow.kernel_scheme(0.7), flow.processor_scheme(0.7)
    assert (kernel.force_evaluations, chi.force_evaluations, flow.scheme(0.7).force_evaluations) == (2, 2, 6)
    assert kernel.symmetric
    loops, out = splitting_loops(HH), y
    for scheme in (chi.inverse(), kernel, chi):
        out = loops.kernel(scheme).step(0.7, out).states
    np.testing.assert_allclose(loops.kernel(flow.scheme(0.7)).step(0.7, y).states, out, atol=64 * EPS)
    with pytest.raises(ValueError, match=r"^`flow` has no processor"):
        SympFlow.primed(HH, 2).processor_scheme()


# frozen, it is a scheme: the compiled loops ---------------------------------------------------------------------


def test_at_one_time_the_polynomials_are_the_table(flow):
    y, t = flow.system.domain.sample(70, 3), 0.7 * flow.dt
    for h, scheme in ((t, flow.scheme(t)), (-t, flow.scheme(t).inverse())):
        by_table = splitting_loops(flow.system).kernel(scheme).step(t, y).states
        np.testing.assert_allclose(flow.kernel_for(flow.system).step(h, y).states, by_table, atol=1e3 * EPS)


# files and copies ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"maps": 10**9},
        {"maps": 4},
        {"processor": -1},
        {"processor": True},
        {"processor": 1},
        {"degree": 10**6},
        {"degree": True},
        {"first": "jump"},
        {"palindromic": 1},
        {"force_gradient": None},
        {"curvature": 1},
        {"curvature": True},
        {"curvature": True, "force_gradient": False},
        {"gradient_kicks": [1.5]},
        {"gradient_kicks": [7]},
        {"gradient_kicks": [0]},
        {"gradient_kicks": 1},
        {"curvature_kicks": [0]},
        {"monomials": [[0, 2]]},
        {"monomials": [[0, 2]], "force_gradient": False},
        {"monomials": [[0, 2, 1]], "force_gradient": False},
        {"monomials": [[0, 0]], "force_gradient": False},
        {"monomials": [[-1, 2]], "force_gradient": False},
        {"monomials": [[0, 2]] * 61, "force_gradient": False},
        {"monomials": 3},
        {"degree": 3},
    ],
)
def test_a_damaged_plan_is_refused(tmp_path, change):
    path = tmp_path / "flow.safetensors"
    random_flow(HH, degree=5).save(path)
    tampered(path, lambda record: record["architecture"]["primed"].update(change))
    with pytest.raises(ValueError, match="is not a usable flow"):
        sympflow.load(path)


def test_kicks_without_force_gradients_keep_none(tmp_path):
    """Whatever is drawn for them, or fitted, they are forces alone, and are counted so."""
    flow = SympFlow.primed(PENDULUM, 5, processor=2, force_gradient=[1, 3], dt=0.5)
    few = {"restarts": 2, "steps": 3, "points": 20, "label_times": 2, "reference_states": 5, "progress": False}
    fitted = train(PENDULUM, flow=flow, **few)
    path = tmp_path / "flow.safetensors"
    fitted.save(path)
    for each in (fitted, sympflow.load(path), fitted.transferred(PENDULUM)):
        scheme = each.kernel_scheme()
        kicks = [s.three for s in scheme.substeps if s.kind == "kick"]
        assert [g != 0 for g in kicks] == [False, True, False, True, False]
        assert (scheme.force_evaluations, scheme.hessian_evaluations) == (5, 2)
        assert all(each.processor_scheme().gradients[1:])  # what is not executed step by step has all of them


# bad arguments ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stages": 0}, r"^`stages` must be a positive integer"),
        ({"stages": 3, "scheme": "verlet"}, r"^`stages` and `scheme` were both given"),
        ({"scheme": "rk4"}, r"^`scheme` 'rk4' is unknown"),
        ({"first": "p"}, r"^`first` must be 'drift' or 'kick', which a step begins with; got 'p'"),
        ({"scheme": "verlet", "first": "kick"}, r"^`first` and `scheme` were both given: leave out `first`"),
        ({"degree": 0}, r"^`degree` must be a positive integer"),
        ({"scheme": "chin4a", "force_gradient": False}, r"^`force_gradient` is False but 'chin4a'"),
        ({"stages": 3, "force_gradient": [0]}, r"^`force_gradient` \(0,\) is not the same from either end of 3 kicks"),
        ({"scheme": "chin4a", "force_gradient": [0]}, r"^`force_gradient` \(0,\) leaves out kicks of 'chin4a'"),
        ({"stages": 3, "force_gradient": [3]}, r"^`force_gradient` \(3,\) does not name kicks from 0 to 2, each once"),
        ({"stages": 3, "force_gradient": []}, r"^`force_gradient` \(\) does not name kicks from 0 to 2"),
        ({"stages": 3, "force_gradient": [2, 0]}, r"^`force_gradient` \(2, 0\) does not name kicks .* and in order"),
        ({"stages": 3, "force_gradient": [1], "curvature": [0, 2]}, r"^`curvature` \(0, 2\) names kicks without"),
        ({"stages": 3, "curvature": [0]}, r"^`curvature` \(0,\) is not the same from either end of 3 kicks"),
        ({"dt": -1.0}, r"^`dt` must be a positive"),
        ({"processor": -1}, r"^`processor` must be a non-negative integer"),
        ({"polynomial": 0}, r"^`polynomial` must be a positive integer, its degree; got 0"),
        ({"polynomial": True}, r"^`polynomial` must be a positive integer, its degree; got True"),
        ({"polynomial": 20}, r"^`polynomial` 20 makes more than 60 monomials in 2 coordinates: take a lower degree"),
        ({"polynomial": 4, "curvature": True}, r"^`polynomial` stands in place of `force_gradient` and `curvature`"),
        ({"polynomial": 4, "scheme": "chin4a"}, r"^`polynomial` stands in place of force gradients, as 'chin4a' has"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        SympFlow.primed(HH, **arguments)


def test_asymmetric_schemes_make_no_palindrome():
    euler = Scheme("symplectic Euler", 1, (1.0,), (1.0,), (0.0,), "test")
    with pytest.raises(ValueError, match=r"^`scheme` 'symplectic Euler' is not symmetric"):
        SympFlow.primed(HH, scheme=euler)
    assert SympFlow.primed(HH, scheme=euler, palindromic=False).scheme(0.5).kicks == (1.0,)


# energy over long times -------------------------------------------------------------------------------------------


def test_stages_are_equal_leapfrog_steps():
    flow, y = SympFlow.primed(HH, 5), HH.domain.sample(4, 0)
    expected = solve(HH, "leapfrog", (0.0, 1.0), y0=y, dt=0.2).y[..., -1]
    np.testing.assert_allclose(flow(1.0, torch.tensor(y)).detach().numpy(), expected, atol=32 * EPS)
    assert flow.scheme().force_evaluations == 5


def test_steps_that_begin_with_a_kick_are_verlets():
    """Half of the first and the last kick belong to each step, and a palindrome of four kicks has three numbers."""
    system = systems.quartic()
    flow = SympFlow.primed(system, 4, dt=0.4, first="kick", curvature=True)
    y0 = system.domain.sample(5, seed=0)
    expected = solve(system, "verlet", (0, 0.4), y0, dt=0.1).y[..., -1]
    np.testing.assert_allclose(flow(0.4, torch.tensor(y0)).detach().numpy(), expected, atol=8 * EPS)
    assert flow.kernel_scheme().force_evaluations == 4
    assert flow.curvatures.free.numel() == 3 * len(flow.curvatures.exponents)


def test_outputs_of_a_processed_flow_change_nothing():
    flow, span = processed(), (0.0, 40.0)
    few, many = (solve(HH, flow, span, t_eval=t).y[:, -1] for t in ([40.0], np.linspace(*span, 81)))
    np.testing.assert_array_equal(few, many)
    for steps in (80, 301):  # χ of several outputs at once, and of those that are left
        end = solve(HH, flow, (0.0, float(steps)), save_every=1).y
        np.testing.assert_array_equal(end[:, -1], solve(HH, flow, (0.0, float(steps)), t_eval=[steps]).y[:, -1])
    every = solve(HH, flow, span)
    np.testing.assert_array_equal(every.y[:, 0], HH.y0)
    np.testing.assert_allclose(every.y[:, -1], few, atol=1e-13)


def test_gradients_flow_through_a_processed_run():
    flow = processed(size=0.02)
    y0 = torch.tensor(HH.y0, requires_grad=True)
    solve(HH, flow, (0.0, 3.5), y0=y0, t_eval=[3.5]).y.sum().backward()
    expected = torch.func.grad(lambda y: flow(3.5, y).sum())(torch.tensor(HH.y0))
    torch.testing.assert_close(y0.grad, expected, rtol=0, atol=1e-11)


def test_evaluations_are_counted():
    stats = solve(HH, random_flow(HH, scheme="verlet"), (0.0, 10.0), backend="array").stats
    assert (stats["force_evaluations"], stats["hessian_evaluations"]) == (20, 20)
    stats = solve(HH, random_flow(HH, stages=3), (0.0, 10.0)).stats
    assert (stats["force_evaluations"], stats["hessian_evaluations"]) == (30, 30)
    assert "curvature_evaluations" not in stats
    for backend in ("compiled", "array"):
        stats = solve(HH, random_flow(HH, stages=3, curvature=True), (0.0, 10.0), backend=backend).stats
        assert stats["curvature_evaluations"] == 30


@pytest.mark.parametrize(("system", "stages", "processor"), [(PENDULUM, 2, 2), (HH, 3, 0), (HH, 2, 3)])
def test_no_drift_over_a_million_steps(system, stages, processor):
    """The slope of the energy error is within three standard errors of 0, or below what rounding adds at random."""
    start = SympFlow.primed(system, stages, dt=0.5, processor=processor, degree=3)
    options = {"restarts": 1, "steps": 10, "points": 40, "reference_states": 20, "progress": False}
    flow = train(system, flow=start, **options)
    n = 1_000_000
    sol = solve(system, flow, (0.0, n * flow.dt), t_eval=np.linspace(0, n * flow.dt, 4001), y0=0.5 * system.y0)
    drift, T = sympflow.energy_drift(sol), n * flow.dt
    error = np.abs(sol.energy_error())
    assert abs(drift.slope) * T <= max(3 * drift.standard_error * T, 10 * EPS * n**0.5)
    assert error.max() < 2 * error[:400].max()
    assert sol.stats["force_evaluations"] == n * stages + (4000 + 1) * processor


@pytest.mark.parametrize("rows", [(), (3,)])
@pytest.mark.slow
def test_compensated_sums_with_curvature(rows):
    """The same run but for rounding, and less of that: n steps and their inverses lead nearer to where it began."""
    flow, y0 = "pendulum-primed-3-0.6", np.broadcast_to([1.1, 0.3], (*rows, 2))
    misses = []
    for compensated in (False, True):
        method = get("sympflow")(flow=flow, compensated=compensated)
        there = solve(PENDULUM, method, (0.0, 6000.0), y0, save_every=10000)
        assert (there.stats["backend"], there.stats["curvature_evaluations"] > 30_000) == ("compiled", True)
        back = solve(PENDULUM, method, (6000.0, 0.0), there.y[..., -1], save_every=10000)
        misses.append(np.abs(back.y[..., -1] - y0).max())
    assert 0 < misses[1] < misses[0] < 1e-10
    assert misses[1] < 1e-11
