"""A flow knows its system by H all over its domain and along the run, not near the origin alone."""

import copy
import gc
import pickle
import weakref

import numpy as np
import pytest
import torch

import sympflow
from sympflow import Ball, Box, HamiltonianSystem, SympFlow, load, shipped_flows, solve, systems
from sympflow.flow.shipped import named
from sympflow.hamiltonian.fingerprint import Identity, same_system

PENDULUM = systems.pendulum()
WALL = "p**2/2 - cos(q) + 5*Max(q - {}, 0)**2"


def walled(where, **scene):
    scene = {"domain": PENDULUM.domain, "y0": [1.5, 0.0]} | scene
    return HamiltonianSystem.from_sympy(WALL.format(where), **scene)


@pytest.mark.parametrize("where", [0.6, 2.0, 2.4])
def test_a_system_that_differs_far_from_the_origin_is_another(where):
    other = walled(where)
    assert same_system(other.fingerprint, PENDULUM.fingerprint)
    assert len(shipped_flows(other)) == 0
    for method, flow in [
        ("sympflow", None),
        ("mlp", None),
        ("sympflow", "pendulum-primed-3-1"),
        ("mlp", "pendulum-mlp"),
    ]:
        with pytest.raises(ValueError, match=r"^`system` '.*' (has no shipped|is not the one that this flow)"):
            solve(other, method, (0, 1), **({} if flow is None else {"flow": flow}))
    with pytest.raises(ValueError, match=r"^`system` '.*' is not the one"):
        load(named("pendulum-primed-3-1").path, system=other)


def test_outside_of_the_domain_the_run_tells():
    other = walled(2.6)
    assert len(shipped_flows(other)) == len(shipped_flows(PENDULUM)) > 0
    assert solve(other, "sympflow", (0, 2)).status == 0
    for method in ("sympflow", "mlp"):
        with pytest.raises(ValueError, match=r"at the state \(2\.8, 0\) of this run its H is another\. Pass the flow"):
            solve(other, method, (0, 2), y0=[2.8, 0.0])
        with pytest.raises(ValueError, match="of this run its H is another"):  # from 2.5 it comes there
            solve(other, method, (0, 2), y0=[2.5, 1.0])
    batch = np.array([[0.1, 0.0], [0.2, 0.0], [2.8, 0.0]])
    with pytest.raises(ValueError, match=r"at the state \(2\.8, 0\)"):
        solve(other, "sympflow", (0, 1), y0=torch.tensor(batch))
    assert solve(PENDULUM, "sympflow", (0, 2), y0=[2.8, 0.0]).status == 0


def test_a_narrow_difference_between_the_probes_is_found_where_the_run_meets_it():
    narrow = "p**2/2 - cos(q) + Piecewise((1e9*((q - 1)**2 - 1e-6)**2, (q - 1)**2 < 1e-6), (0, True))"
    other = HamiltonianSystem.from_sympy(narrow, domain=PENDULUM.domain)
    with pytest.raises(ValueError, match=r"at the state \(1, 0\) of this run its H is another"):
        solve(other, "sympflow", (0, 1), y0=[1.0, 0.0])


@pytest.mark.parametrize(
    "system",
    [
        HamiltonianSystem.from_sympy("p**2/2 - cos(q)"),
        HamiltonianSystem.from_sympy("(p**2 - 2*cos(q) + 6)/2"),
        HamiltonianSystem.from_sympy("a*p**2/2 + 2*sin(q/2)**2", params={"a": 1.0}),
        HamiltonianSystem(lambda q: -torch.cos(q).sum(-1), ndof=1),
    ],
    ids=["another constant", "another form", "an identity of trigonometry", "a function"],
)
def test_the_same_system_in_other_words_is_the_same(system):
    assert len(shipped_flows(system)) == len(shipped_flows(PENDULUM)) > 0
    y = [solve(s, "sympflow", (0, 4), [1.5, 0.0], t_eval=[4.0]).y for s in (system, PENDULUM)]
    np.testing.assert_allclose(y[0], y[1], atol=1e-12)
    solve(system, "mlp", (0, 2), [2.8, 0.0])


def test_flows_that_ship_are_not_shared_by_systems_that_differ_outside_of_the_domain():
    """Each runs on its own forces."""
    for system in (walled(2.6), PENDULUM):
        flow = sympflow.get("sympflow")().flow_for(system)
        assert flow.system.force(np.array([2.8]))[0] == pytest.approx(system.force(np.array([2.8]))[0])


@pytest.mark.parametrize(
    ("name", "system"),
    [
        ("pendulum-mlp", PENDULUM),
        ("henon_heiles-sympflow", systems.henon_heiles()),
        ("outer_solar_system-primed-3-100", systems.outer_solar_system()),
        ("fput_50-sympflow", systems.fput(50.0)),
    ],
)
def test_files_hold_the_identity_and_those_of_before_load(name, system, tmp_path):
    flow = load(named(name).path, system=system)
    assert len(flow.identity.states) == len(flow.identity.energies) == 64
    inside = flow.domain_for(system).contains(flow.identity.states)
    assert inside.mean() > 0.6  # six digits may put one on the border outside
    flow.save(tmp_path / "again.safetensors")
    again = load(tmp_path / "again.safetensors")
    np.testing.assert_array_equal(again.identity.states, flow.identity.states)
    np.testing.assert_array_equal(again.identity.energies, flow.identity.energies)
    assert again.identity.expression == flow.identity.expression
    again.identity = None
    again.save(tmp_path / "before.safetensors")
    before = load(tmp_path / "before.safetensors")
    assert before.identity is None
    assert before.fingerprint == flow.fingerprint


def test_in_another_time_the_system_in_the_physical_one_is_known():
    kepler = systems.kepler(0.5)
    other = HamiltonianSystem.from_sympy(
        "(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2) + Max(q1 - 0.6, 0)**2/50", domain=kepler.domain, y0=kepler.y0
    )
    assert same_system(other.fingerprint, kepler.fingerprint)
    assert solve(kepler, "log_sympflow", (0, 1)).status == 0
    with pytest.raises(ValueError, match=r"^`flow` is needed: no flow in another time ships"):
        solve(other, "log_sympflow", (0, 1))
    with pytest.raises(ValueError, match=r"^`system` '.*' has 2 degrees|is not the one"):
        solve(other, "sympflow", (0, 1), flow="kepler-log-1")


def test_training_keeps_it_over_the_domain_that_was_trained_on():
    box = Box([1.0, -1.0], [3.0, 1.0])
    flow = SympFlow.primed(PENDULUM, stages=1, dt=0.1)
    assert flow.identity.expression == PENDULUM.expression
    trained = sympflow.train(PENDULUM, flow=flow, domain=box, optimizer="gauss-newton", restarts=1, points=10)
    states = trained.identity.states
    assert box.contains(states).mean() > 0.9
    np.testing.assert_allclose([states.min(0), states.max(0)], [box.low, box.high], atol=0.01)  # its ends among them
    assert not trained.matches(walled(2.9, domain=box))
    for again in (copy.deepcopy(trained), pickle.loads(pickle.dumps(trained))):
        assert again.matches(PENDULUM)
        assert not again.matches(walled(2.9, domain=box))


def test_of_functions_by_values_alone():
    system = HamiltonianSystem(lambda q: (q**4).sum(-1) / 4, ndof=1, domain=Ball([0.0, 0.0], 2.0))
    identity = Identity.of(system, system.domain)
    assert identity.expression is None
    for offset in (0.0, 1e6):
        assert identity.agrees(HamiltonianSystem(lambda q, c=offset: c + (q**4).sum(-1) / 4, ndof=1))
    assert not identity.agrees(HamiltonianSystem(lambda q: (q**4).sum(-1) / 4 + torch.relu(q[..., 0] - 1.8), ndof=1))
    assert Identity.from_dict(identity.to_dict(), 1).agrees(system)


@pytest.mark.parametrize("expression", ["__import__('os').system('x')", "q1 +", "q1**2 + p1**2 + q2", "k*q1"])
def test_a_text_in_a_file_is_read_by_a_grammar_and_proves_nothing_where_it_is_none(expression):
    identity = Identity(np.empty((0, 2)), np.empty(0), expression)
    assert not identity.is_proved(PENDULUM)
    assert identity.first_difference(PENDULUM, np.ones((1, 2))) is None


@pytest.mark.parametrize(
    "description",
    [
        [],
        {"states": [[0.0, 0.0]], "energies": [0.0]},
        {"states": [[0.0, 0.0]], "energies": [0.0, 1.0], "expression": None},
        {"states": [[0.0, 0.0, 0.0]], "energies": [0.0], "expression": None},
        {"states": [[0.0], [0.0, 1.0]], "energies": [0.0, 1.0], "expression": None},
        {"states": [[0.0, "a"]], "energies": [0.0], "expression": None},
        {"states": [[0.0, None]], "energies": [0.0], "expression": None},
        {"states": [[0.0, 10**400]], "energies": [0.0], "expression": None},
        {"states": 3, "energies": [], "expression": None},
        {"states": [], "energies": [], "expression": 3},
        {"states": [], "energies": [], "expression": "q" * 30_000},
    ],
)
def test_what_is_no_identity_is_refused(description):
    with pytest.raises(ValueError, match=r"^its? "):
        Identity.from_dict(description, 1)


def test_no_system_is_kept_alive():
    solve(PENDULUM, "sympflow", (0, 1))  # the first keeps the flow that ships, which later ones share
    system = systems.pendulum()
    solve(system, "sympflow", (0, 1))
    solve(PENDULUM, "sympflow", (0, 1))  # the loops of that flow are those of the last system
    gone = weakref.ref(system)
    del system
    gc.collect()
    assert gone() is None


def test_a_file_is_known_again_where_h_overflows_at_common_states(tmp_path):
    """A Morse well of hydrogen in SI units: exp(−aq) is infinite at q = −0.3 m."""

    def well(depth):
        numbers = {"D": depth, "a": 1.9e10, "m": 8.4e-28}
        domain = Box([-1e-11, -5e-24], [1.2e-11, 5e-24])
        return HamiltonianSystem.from_sympy("p**2/(2*m) + D*(1 - exp(-a*q))**2", params=numbers, domain=domain)

    SympFlow.primed(well(7.5e-19), 1, dt=1e-15).save(tmp_path / "flow.safetensors")
    sympflow.load(tmp_path / "flow.safetensors", system=well(7.5e-19))
    with pytest.raises(ValueError, match="is not the one that this flow was trained for"):
        sympflow.load(tmp_path / "flow.safetensors", system=well(7.6e-19))
