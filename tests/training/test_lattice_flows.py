"""Flows of lattices: fitted on a few sites, judged on the lattice, known by the terms and not by the size."""

from __future__ import annotations

import numpy as np
import pytest

import sympflow
from sympflow import HamiltonianSystem, LatticeStates, SympFlow, solve, train

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
