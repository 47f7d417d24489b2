"""Flows of lattices: fitted on a few sites, judged on the lattice, known by the terms and not by the size."""

from __future__ import annotations

import numpy as np
import pytest

import sympflow
from sympflow import Box, HamiltonianSystem, LatticeStates, SympFlow, solve, train
from sympflow.training import lattice_fit, table_fit
from sympflow.training.lattice_fit import TAIL, LatticeSubsystem

BOND = "r**2/2 + r**4/4"
FIT = {"restarts": 1, "steps": 8, "points": 20, "label_times": 3, "reference_states": 10, "progress": False}


def ring(n=40, **options):
    return HamiltonianSystem.lattice(shape=n, **{"bond": BOND, **options})


@pytest.fixture(scope="module")
def flow():
    lattice = ring(domain=LatticeStates(0.2))
    return train(lattice, flow=SympFlow.primed(lattice, 2, dt=0.25, processor=2), **FIT)


def test_states_have_the_density_of_the_lattice_at_every_size():
    large = ring(400, domain=LatticeStates(0.2)).domain
    assert large is not None
    many = large.sample(20)
    few = ring(400, domain=LatticeStates(0.2)).subsystem(8).domain
    of_large, of_few = (s.system.energy_density(x).mean(-1) for s, x in ((large, many), (few, few.sample(2000))))
    # a gamma distribution of as many oscillators: relative spreads d^(-1/2), of the mean over n states (d n)^(-1/2)
    for density, d in ((of_large, 400), (of_few, 8)):
        assert abs(density.mean() / 0.2 - 1) < 5 / np.sqrt(d * len(density))
        assert 0.6 < density.std() / 0.2 * np.sqrt(d) < 1.5
    assert large.contains(many).all()
    assert not large.contains(4 * many).any()
    spike = many[0].copy()
    spike[400] += 5.0  # one site alone
    assert not large.contains(spike)


def test_a_flow_serves_every_shape(flow, tmp_path):
    assert flow.ndof == 40
    assert flow.recipe["fitted_on"] == 6
    assert flow.certified is not None
    assert flow.certified.system == "lattice"
    assert {"ends_periodic", "ends_fixed", "ends_free", "energy_error_95"} <= set(flow.figures)
    flow.save(tmp_path / "flow.safetensors")
    assert (tmp_path / "flow.safetensors").stat().st_size < 40_000
    loaded = sympflow.load(tmp_path / "flow.safetensors")
    assert loaded.ndof == 6
    for n in (7, 40, 300):
        lattice = ring(n, domain=LatticeStates(0.2))
        y0, times = lattice.domain.sample(1)[0], [0.0, 2.5, 5.0]
        runs = [solve(lattice, f, (0, 5), y0, t_eval=times, backend="array") for f in (flow, loaded)]
        np.testing.assert_array_equal(runs[0].y, runs[1].y)
        H = lattice.hamiltonian(runs[0].states)
        assert np.ptp(H) / H[0] < 10 * flow.figures["energy_error_95"]
    assert sympflow.load(tmp_path / "flow.safetensors", system=ring(12)).system.ndof == 12


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (ring(bond="r**2/2 + r**4/5"), r"its bond is r\*\*4/5"),
        (ring(onsite="q**2/2"), r"its onsite term is q\*\*2/2"),
        (ring(kinetic="p**2/4"), r"its kinetic energy is p\*\*2/4"),
        (ring((6, 6)), "its number of axes is 2"),
        (ring(kinetic="p**2/(2*m)", params={"m": np.linspace(1, 2, 40)}), "its kinetic energy is"),
        (ring(damping=0.1), "has friction"),
    ],
)
def test_another_lattice_is_refused_by_the_term_that_differs(flow, other, reason):
    y0 = np.full(2 * other.ndof, 0.1)
    with pytest.raises(ValueError, match=reason):
        solve(other, flow, (0, 5), y0)
    with pytest.raises(ValueError, match=r"has friction|is another lattice"):
        flow.transferred(other if other.ndof != 40 else ring(41, bond="r**2/2 + r**4/5"))


def test_ends_at_which_the_numbers_do_not_hold_are_refused(flow, monkeypatch):
    free = ring(30, boundary="free")
    y0 = LatticeStates(0.2, free).sample(1)[0]
    assert solve(free, flow, (0, 5), y0, backend="array").success
    monkeypatch.setitem(flow.figures, "ends_free", 3 * flow.figures["ends_periodic"])
    with pytest.raises(ValueError, match=r"^`system` 'lattice' has free ends"):
        solve(free, flow, (0, 5), y0)


def test_a_piece_has_the_states_of_the_lattice():
    y0 = LatticeStates(0.3, ring(200)).sample(1)[0]
    low, high = ring(200, y0=y0).subsystem(8).domain.bounds
    assert low == pytest.approx(0.3, rel=0.3)
    assert high == pytest.approx(low, rel=1.0)
    of_box = ring(6, domain=Box([-0.5] * 12, [0.5] * 12)).subsystem().domain
    assert 0.01 < of_box.bounds[0] < of_box.bounds[1] < 1
    large = ring(200)
    fitted = LatticeSubsystem.of(large, LatticeStates((0.1, 0.3)).of(large))
    assert fitted.domain.bounds == (0.1, TAIL * 0.3)  # a few neighbours have more than all of them
    assert fitted.states.bounds == (0.1, 0.3)
    assert ring(200).subsystem(8).domain is None
    with pytest.raises(TypeError, match=r"^`system` 'H = .*' is not a lattice"):
        HamiltonianSystem.from_sympy("p**2/2 + q**2/2").subsystem()
    with pytest.raises(ValueError, match=r"^`sites` must be one to 3 positive integers"):
        ring(200).subsystem(0)
    with pytest.raises(ValueError, match=r"^`density` must be positive"):
        LatticeStates((0.3, 0.2))
    with pytest.raises(ValueError, match="`domain` is not known"):
        train(ring(200))


@pytest.mark.parametrize("boundary", ["periodic", "fixed", "free"])
def test_the_expression_by_coordinates_is_the_same_H(boundary):
    lattice = HamiltonianSystem.lattice(
        onsite="a*u**2/2 + u**2*v**2",
        bond={1: "c*r_u**2/2 + r_v**2/2 + r_u**2*r_v", 2: "r_u**4/4"},
        fields=("u", "v"),
        shape=(5, 6),
        boundary=(boundary, "fixed"),
        params={"a": np.linspace(1, 2, 30).reshape(5, 6), "c": 0.5},
    )
    written = HamiltonianSystem.from_sympy(lattice.local.written_out())
    y = np.random.default_rng(0).normal(size=(3, 120))
    np.testing.assert_allclose(written.hamiltonian(y), lattice.hamiltonian(y), rtol=1e-12)


@pytest.mark.slow
def test_a_fit_to_long_runs_keeps_the_energy_of_other_states(flow, monkeypatch):
    """With the table that they found at Δt, which the numbers at shorter times lead to."""
    monkeypatch.setattr(table_fit, "RUN_STEPS", 8)
    lattice = ring(domain=LatticeStates(0.2))
    further = train(lattice, flow=flow, runs=32, seed=1, **FIT | {"steps": 8})
    assert [stage.get("runs") for stage in further.recipe["stages"]] == [None, 32]
    large = ring(200, domain=LatticeStates(0.2))
    y0 = large.domain.sample(4, seed=77)
    errors = []
    for each in (flow, further):
        H = large.hamiltonian(solve(large, each, (0, 40), y0, t_eval=np.linspace(0, 40, 9)).states)
        errors.append(np.sqrt(np.mean((H / H[:, :1] - 1) ** 2)))
    assert errors[1] < errors[0]
    numbers = [further.scheme(t).drifts for t in (0.2, 0.25)]
    np.testing.assert_allclose(*numbers, atol=0.02)


def test_the_flow_of_a_damped_lattice_is_of_its_friction():
    lattice = ring(20, damping=0.1, domain=LatticeStates(0.2))
    flow = train(lattice, flow=SympFlow.primed(lattice, 2, dt=0.25, processor=0), **FIT)
    y0 = np.full(60, 0.1)
    assert solve(ring(30, damping=0.1), flow, (0, 5), y0, backend="array").success
    for other in (ring(30, damping=0.2), ring(30)):
        with pytest.raises(ValueError, match="its friction is another"):
            solve(other, flow, (0, 5), y0)


def test_a_table_that_overflowed_is_as_bad_as_can_be(flow):
    """And is left out of the flow: a search that took too long a step goes on."""
    lattice = ring(12, domain=LatticeStates(0.2))
    mine = flow.of_any_size(lattice)
    runs = lattice_fit.EnergyRuns(mine, lattice, lattice.domain.sample(2), 0.0, 1.0)
    offset, design = runs.table.polynomial(np.array([flow.dt]))
    theta = runs.table.frozen_parameters(offset[0] + design[0] @ runs.table.parameters())
    before = runs.residuals(theta)
    after = runs.residuals(np.full_like(theta, np.nan))
    assert np.isfinite(before).all()
    assert after.shape == before.shape
    assert np.isinf(after).all()
    np.testing.assert_array_equal(runs.residuals(theta), before)
