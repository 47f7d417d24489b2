"""A flow knows its system by H all over its domain and along the run, not near the origin alone."""

import re

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, load, shipped_flows, solve, systems
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
    named_so = re.escape(other.name)
    assert same_system(other.fingerprint, PENDULUM.fingerprint)
    assert len(shipped_flows(other)) == 0
    for method, flow in [
        ("sympflow", None),
        ("mlp", None),
        ("sympflow", "pendulum-primed-3-1"),
        ("mlp", "pendulum-mlp"),
    ]:
        with pytest.raises(ValueError, match=rf"^`system` '{named_so}' (has no shipped|is not the one that this flow)"):
            solve(other, method, (0, 1), **({} if flow is None else {"flow": flow}))
    with pytest.raises(ValueError, match=f"^`system` '{named_so}' is not the one"):
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
