"""Flows of like bodies in pairs: fitted on a few of them, judged on more, known by the pair potential."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sympflow
from sympflow import ClusterStates, HamiltonianSystem, LatticeStates, SympFlow, solve, train
from sympflow.training import table_fit

LENNARD_JONES = "4*e*(r**-12 - r**-6)"
FIT = {"restarts": 1, "steps": 8, "points": 20, "label_times": 3, "reference_states": 10, "progress": False}
STATES = ClusterStates((0.02, 0.1))


def cluster(n=10, **options):
    given = {"potential": LENNARD_JONES, "params": {"e": 1.0}, "masses": np.ones(n), "dim": 2, **options}
    return HamiltonianSystem.pairs(**given)


@pytest.fixture(scope="module")
def flow():
    system = cluster(domain=STATES)
    return train(system, flow=SympFlow.primed(system, 2, dt=0.02, processor=0), **FIT)


def test_a_piece_has_the_states_of_the_cluster():
    piece = cluster(100, domain=STATES).piece()
    assert piece.ndof == 14
    assert piece.domain == STATES
    rest = piece.domain.at_rest
    assert piece.local.bond_length == pytest.approx(2 ** (1 / 6))
    assert piece.potential(rest[:14]) == pytest.approx(-12.5, abs=0.1)  # a body and the six around it: 12 bonds
    np.testing.assert_allclose(piece.force(rest[:14]), 0, atol=1e-3)
    x = piece.domain.sample(400)
    assert piece.domain.contains(x).all()
    assert not piece.domain.contains(5 * x[:3]).any() or not np.isfinite(x).all()
    momenta = x[:, 14:].reshape(400, 7, 2).sum(1)
    np.testing.assert_allclose(momenta, 0, atol=1e-12)
    density = (piece.hamiltonian(x) - piece.hamiltonian(rest)) / 7
    assert density.mean() == pytest.approx(0.06, rel=0.1)  # of 400 draws, each with a spread of about a half
    pressed = rest.copy()
    pressed[:2] *= 1 - 1e-9
    pressed[2:4] = pressed[0] + 0.9, pressed[1]  # two bodies closer than any thermal motion brings them
    assert not piece.domain.contains(pressed)
    from_y0 = cluster(7, y0=x[0]).piece(5).domain
    assert isinstance(from_y0, ClusterStates)
    assert 0.01 < from_y0.bounds[0] <= from_y0.bounds[1] < 0.5


@pytest.mark.parametrize(
    "options",
    [
        {"masses": [1.0, 1.0, 2.0]},
        {"potential": "-e/r"},  # no minimum
        {"potential": "e*(r - 1)**2"},  # all bodies of a cluster would pull at each other
        {"potential": "e*(1/r**2 - 1/r)"},  # too long a range
        {"box": 20.0},
        {"cutoff": 1.5},
    ],
)
def test_what_has_no_piece_is_refused(options):
    system = cluster(3, **options)
    assert not system.local.has_piece
    assert system.few_sites is system
    with pytest.raises(TypeError, match=r"^`system` has no piece"):
        system.piece()
    with pytest.raises(ValueError, match=r"^`domain` ClusterStates is of like bodies"):
        STATES.of(system)


def test_bad_arguments_of_a_piece_are_refused():
    with pytest.raises(TypeError, match=r"^`boundary` is of lattices"):
        cluster().piece(5, "free")
    with pytest.raises(ValueError, match=r"^`sites` must be a number of bodies"):
        cluster().piece(1)
    with pytest.raises(ValueError, match=r"^`domain` LatticeStates is of lattices"):
        LatticeStates(0.1).of(cluster())


@pytest.mark.parametrize(
    ("system", "states"),
    [(cluster(), "ClusterStates"), (HamiltonianSystem.lattice(bond="r**2/2", shape=6), "LatticeStates")],
)
def test_states_that_are_not_known_are_asked_for_by_their_name(system, states):
    with pytest.raises(ValueError, match=rf"^`domain` is not known .*domain=sympflow\.{states}\(density\), "):
        train(system)


def test_a_flow_serves_any_number_of_bodies(flow, tmp_path):
    assert flow.ndof == 20
    assert flow.recipe["fitted_on"] == 14
    assert {"judged_on", "energy_error_95"} <= set(flow.figures)
    flow.save(tmp_path / "flow.safetensors")
    loaded = sympflow.load(tmp_path / "flow.safetensors")
    assert loaded.domain == STATES
    for n in (2, 10, 25):
        system = cluster(n, domain=STATES)
        y0 = system.domain.sample(1)[0]
        runs = [solve(system, f, (0, 1), y0, t_eval=[0.0, 0.5, 1.0], backend="array") for f in (flow, loaded)]
        np.testing.assert_array_equal(runs[0].y, runs[1].y)
        H = system.hamiltonian(runs[0].states)
        above = H[0] - system.potential(system.domain.at_rest[: system.ndof])
        assert np.ptp(H) < 0.2 * above  # a rough flow, of two kicks and eight steps of the fit


def test_a_fit_to_long_runs_is_of_a_larger_cluster(flow, monkeypatch):
    monkeypatch.setattr(table_fit, "RUN_STEPS", 3)
    further = train(cluster(domain=STATES), flow=flow, runs=8, seed=1, **FIT)
    assert further.recipe["stages"][-1]["runs"] == 8
    large = cluster(25, domain=STATES)
    y0 = large.domain.sample(4, seed=77)
    H0, rest = large.hamiltonian(y0), large.hamiltonian(large.domain.at_rest)
    errors = []
    for each in (flow, further):
        H = large.hamiltonian(solve(large, each, (0, 2), y0, t_eval=np.linspace(0, 2, 5)).states)
        errors.append(np.sqrt(np.mean(((H.T - H0) / (H0 - rest)) ** 2)))
    assert errors[1] < errors[0]


def test_a_run_far_outside_that_loses_energy_is_warned_of(flow, monkeypatch):
    monkeypatch.setattr(flow, "certified", replace(flow.certified, relative_limit=1e-7))
    system = cluster(domain=STATES)
    y0 = system.domain.sample(1)[0]
    solve(system, flow, (0, 0.2), y0, t_eval=[0.2])
    y0[20:] *= 8
    with pytest.warns(RuntimeWarning, match=r"^The state left the domain of the flow at t = 0, and the "):
        solve(system, flow, (0, 0.2), y0, t_eval=[0.0, 0.2])
    solve(system, flow, (0, 0.2), y0, t_eval=[0.0, 0.2], on_domain_exit="ignore")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"params": {"e": 1.1}}, r"another system of bodies .*its pair potential is"),
        ({"masses": np.full(10, 2.0)}, "its mass is 2, and not 1"),
        ({"masses": np.arange(1.0, 13.0)}, "is of another kind than that of this flow"),
        ({"box": 20.0}, "is of another kind than that of this flow"),
        ({"softening": 0.1}, "its softening is 0.1"),
        ({"cutoff": 3.0}, "its pair potential is"),
        ({"dim": 3}, "its number of coordinates of a body is 3"),
        ({"damping": 0.1}, "has friction"),
        ({"potential": "e/r"}, "is of another kind than that of this flow"),
    ],
)
def test_another_potential_is_refused(flow, options, reason):
    other = cluster(**options)
    y0 = np.zeros(2 * other.ndof)
    y0[: other.ndof] = np.arange(other.ndof)
    with pytest.raises(ValueError, match=reason):
        solve(other, flow, (0, 1), y0)
