"""The flows that ship as ladders: chosen by accuracy and cost, listed, built by one command; and what they achieve."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from safetensors import safe_open

import sympflow
from sympflow import (
    HamiltonianSystem,
    SympFlow,
    energy_balance_error,
    load,
    max_energy_error,
    shipped_flows,
    solve,
    systems,
)
from sympflow.flow import shipped as catalogue
from sympflow.flow.records import FORMAT, KEY, SUM, text_checksum
from sympflow.flow.shipped import ShippedFlow, choose
from sympflow.integrators import flows
from sympflow.training import pretrained
from sympflow.training.clock_fit import clock_errors
from sympflow.training.fits import GaussNewton, PrimedFit
from sympflow.training.shipped.judges import by_certificate, cost_of, one_step_errors
from sympflow.training.shipped.recipe import SCENES, Recipe, along_the_orbit, scene_named

HH, PENDULUM, OSCILLATOR = systems.henon_heiles(), systems.pendulum(), systems.harmonic_oscillator()
QUARTIC = HamiltonianSystem.from_sympy("p**2/2 + q**4/4", name="plain_quartic", domain=sympflow.Ball([0.0, 0.0], 1.0))
FILES = [f for f in shipped_flows() if f.stages is not None or f.shift is not None]
LADDERS = sorted({f.name.partition("-")[0] for f in FILES})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three rungs for the pendulum with figures made up, a network for it, and a rung for another system."""
    folder = tmp_path_factory.mktemp("pretrained")
    for stages, error, cost in ((2, 1e-3, 3.0), (4, 1e-5, 9.0), (6, 1e-7, 7.0)):
        flow = SympFlow.primed(PENDULUM, stages, dt=0.5)
        flow.figures = {"energy_error_95": error, "cost": cost, "t_end": 1000.0}
        flow.domain = PENDULUM.domain
        flow.save(folder / f"pendulum-primed-{stages}.safetensors")
    network = SympFlow(1, dt=0.7)
    network.fingerprint, network.system_name = OSCILLATOR.fingerprint, OSCILLATOR.name
    network.save(folder / "oscillator-sympflow.safetensors")
    SympFlow.primed(OSCILLATOR, 1, dt=0.3).save(folder / "oscillator-primed-1.safetensors")
    return folder


@pytest.fixture
def three(folder, monkeypatch):
    """They are what ships."""
    files = tuple(ShippedFlow.of(path) for path in sorted(folder.glob("*.safetensors")))
    monkeypatch.setattr(catalogue, "_catalogue", lambda: files)
    monkeypatch.setattr(flows, "_KNOWN", {})
    for name in ("_shipped", "kind_of"):  # what is kept of each system knows other flows
        monkeypatch.setattr(flows, name, getattr(flows, name).__wrapped__)
    return files


# choosing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("tol", "stages"), [(1e-2, 2), (1e-3, 2), (9e-4, 6), (1e-5, 6), (1e-7, 6)])
def test_the_cheapest_that_meets_the_tolerance_is_taken(three, tol, stages):
    assert choose(PENDULUM, tol=tol).stages == stages
    sol = solve(PENDULUM, "sympflow", (0.0, 2.0), tol=tol)
    assert sol.stats["dt"] == 0.5
    assert sol.stats["force_evaluations"] == 4 * stages
    reference = solve(PENDULUM, SympFlow.primed(PENDULUM, stages, dt=0.5), (0.0, 2.0))
    np.testing.assert_array_equal(sol.y, reference.y)


def test_a_tolerance_is_not_met_outside_the_domain():
    """All Kepler problems have the same H; the flows that ship hold near e = 0.6."""
    with pytest.raises(ValueError, match=r"^`y0` is outside the domain that the flow .* `tol`.* pass flow=flow"):
        solve(systems.kepler(0.1), "sympflow", (0.0, 1.0), tol=1e-3)
    kepler = systems.kepler()
    batch = np.stack([kepler.y0, systems.kepler(0.1).y0])
    with pytest.raises(ValueError, match=r"^`y0` is outside the domain \(trajectory 1\)"):
        solve(kepler, "sympflow", (0.0, 1.0), y0=batch, tol=1e-3)
    with pytest.raises(ValueError, match=r"^`y0` is outside the domain"):
        solve(kepler, "sympflow", (0.0, 1.0), y0=torch.as_tensor(batch[1]), tol=1e-3)
    assert solve(kepler, "sympflow", (0.0, 1.0), tol=1e-3).success
    flow = choose(kepler, tol=1e-3).load(kepler)
    assert "domain" in solve(kepler, flow, (0.0, 1.0), y0=batch[1]).message  # without a tolerance: a note


@pytest.mark.parametrize("system", [systems.fput(), systems.spring_pendulum(1e6, coordinates="polar")])
def test_stiff_flows_are_chosen_by_tolerance(system):
    """Their figure is over the scene's own interval, and what it says holds on it."""
    listed = choose(system, tol=1e-3)
    assert listed.t_end == system.t_span[1]
    assert listed.cost > 0
    sol = solve(system, "sympflow", (0.0, 2.0), tol=1e-3)
    assert np.abs(sol.energy_error()).max() < 1e-3


# listing -------------------------------------------------------------------------------------------------------


def test_the_list(three):
    rows = shipped_flows(PENDULUM)
    assert [f.stages for f in rows] == [2, 6, 4]  # by cost
    assert [f.name for f in rows[:1]] == ["pendulum-primed-2"]
    assert rows[0].load(PENDULUM).system is PENDULUM
    assert len(shipped_flows(kind="sympflow")) == 5
    assert len(shipped_flows(QUARTIC)) == 0
    table = rows.table().splitlines()
    assert len(table) == 5
    assert "1.0e-03 (T = 1000)" in table[2]
    assert repr(rows) == rows.table()
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem"):
        shipped_flows(3)
    with pytest.raises(ValueError, match=r"^`kind` 'gan' is unknown"):
        shipped_flows(kind="gan")


# building ------------------------------------------------------------------------------------------------------


def test_a_file_is_the_recipe_of_its_flow(tmp_path, monkeypatch, capsys):
    """The command makes flows again with the same weights, and measures them."""
    monkeypatch.setattr(pretrained, "package_folder", lambda: tmp_path)
    monkeypatch.setattr(Recipe, "judge", property(lambda _: partial(by_certificate, t_end=50.0)))
    fit, solver = PrimedFit(0.5, processor=1, points=40, reference_states=10), GaussNewton(steps=20, restarts=2)
    flows = [
        sympflow.train(PENDULUM, replace(fit, stages=stages, first=first), solver=solver, progress=False)
        for stages, first in ((1, "drift"), (2, "kick"))
    ]
    names = [f"pendulum-primed-{stages}-0.5" for stages in (1, 2)]
    for name, flow in zip(names, flows, strict=True):
        flow.save(tmp_path / f"{name}.safetensors")
    (tmp_path / "again").mkdir()
    pretrained.main(["pendulum", "--kind", "primed", "--out", str(tmp_path / "again")])
    assert capsys.readouterr().out.count("energy_error_95") == 2
    one, two = (load(tmp_path / "again" / f"{name}.safetensors", system=PENDULUM) for name in names)
    for again, flow in zip((one, two), flows, strict=True):
        assert all(torch.equal(w, flow.state_dict()[name]) for name, w in again.state_dict().items())
    assert one.certified.t_end == two.figures["t_end"] == 50.0
    assert two.figures["energy_error_95"] == two.certified.relative_limit < one.figures["energy_error_95"]
    assert two.certified.relative_limit >= two.certified.relative_energy_error.q95
    assert two.certified.held_out == 1000
    assert two.figures["one_step_error_median"] <= two.figures["one_step_error_max"]
    assert two.figures["cost"] > one.figures["cost"] > 0
    assert two.recipe["stages"][0]["restarts"] == 2
    listed = ShippedFlow.of(tmp_path / "again" / f"{names[1]}.safetensors")
    assert (listed.stages, listed.dt, listed.cost) == (2, 0.5, two.figures["cost"])
    pretrained.main(["--rung", "primed-2-0.5", "--out", str(tmp_path / "again"), "--measure"])
    assert capsys.readouterr().out.startswith("pendulum-primed-2-0.5: one_step_error")
    for unknown in (["three_body"], ["--rung", "primed-9-9"]):
        with pytest.raises(SystemExit):
            pretrained.main(unknown)


# what ships ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("listed", shipped_flows(), ids=lambda f: f.name)
def test_every_flow_ships_with_its_record(listed):
    """With checksums, the identity of its system, its recipe, and a certificate if it keeps an energy."""
    assert len(listed.identity.states) == 64
    with safe_open(listed.path, "np") as file:
        notes = file.metadata()
    assert json.loads(notes[KEY])["format"] == FORMAT
    assert notes[SUM] == text_checksum(notes[KEY])
    recipe = Recipe.of(listed.path)
    flow, system, (fit, _) = recipe.flow, recipe.system, recipe.stages[0]
    assert listed.is_of(system)
    if fit.kind in ("primed", "split"):
        made = fit.flow(system)
        shape = dict(made.architecture(), ndof=flow.ndof)
        assert (shape, made.dt) == (flow.architecture(), pytest.approx(flow.dt, rel=1e-14))
    certified = system.autonomous and listed.shift is None and listed.kind != "mlp" and not listed.reach
    assert (flow.certified is not None) == certified
    assert flow.certified is None or flow.certified.delta.largest > 0
    assert listed.path.stat().st_size < 200_000
    assert listed not in FILES or (listed.cost > 0 and listed.energy_error < 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", LADDERS)
def test_shipped_figures_hold(name):
    """Measured again, on states of another seed, over a tenth of the time: no rung is worse than its file says."""
    system = SCENES[name]()
    t_end = max(f.t_end for f in shipped_flows(system) if f.stages) / (100 if name == "outer_solar_system" else 10)
    along = along_the_orbit(system, 4, t_end, seed=1) if name == "outer_solar_system" else None
    for listed in shipped_flows(system):
        if listed.stages is None:
            continue
        flow = listed.load(system)
        y0 = flow.domain_for(system).sample(40, 4321) if along is None else along
        t_eval = np.linspace(0.0, t_end, 201)
        sol = solve(system, flow, (0.0, t_end), y0=y0, t_eval=t_eval, on_domain_exit="ignore")
        kept = max_energy_error(sol) if system.autonomous else energy_balance_error(sol, relative=True).max(-1)
        errors = np.sort(kept)
        assert errors[len(errors) * 9 // 10] <= 3 * listed.energy_error
        assert listed.energy_error < 100 * errors[-1] + 1e-9


@pytest.mark.parametrize("other", [{"dt": 0.1}, {"flow": SympFlow(1)}])
def test_a_tolerance_chooses_flow_and_step(other):
    with pytest.raises(ValueError, match=r"^`tol` chooses the flow and its Δt"):
        solve(PENDULUM, "sympflow", (0.0, 1.0), tol=1e-3, **other)
    with pytest.raises(TypeError, match=r"^`tol` chooses the step .*, and a flow has its own"):
        solve(PENDULUM, "mlp", (0.0, 1.0), tol=1e-3)


@pytest.mark.parametrize("name", ["kepler-primed-2-0.15", "kepler-primed-3-0.1", "pendulum-primed-3-0.6"])
def test_the_figure_is_met_by_95_per_cent_of_other_states(name):
    """1000 states of another seed to T = 1000: no more than one in twenty exceeds it."""
    listed = next(f for f in FILES if f.name == name)
    system = scene_named(listed.name.partition("-")[0])
    y0 = system.domain.sample(1000, 90_210)
    n = int(listed.t_end / listed.dt)
    sol = solve(system, listed.load(system), (0.0, n * listed.dt), y0, save_every=5, on_domain_exit="ignore")
    assert np.mean(max_energy_error(sol) > listed.energy_error) <= 0.05


FIRST = {(f.name.partition("-")[0], f.kind): f.name for f in reversed(shipped_flows())}


@pytest.mark.parametrize(
    "listed",
    [pytest.param(f, marks=() if f.name in FIRST.values() else pytest.mark.slow) for f in shipped_flows()],
    ids=lambda f: f.name,
)
def test_every_flow_is_a_map_for_all_times(listed):
    """Networks and stiff ones included; measured on a few states, not read."""
    system = scene_named(listed.name.partition("-")[0])
    flow = listed.load(system)
    if listed.shift is not None:  # in its own time it is early or late: what it is right in is the physical time
        figures = clock_errors(flow, system, system.domain, 987, 6)
        assert max(figures.values()) <= 10 * flow.figures["one_step_error_max"]
        return
    x = along_the_orbit(system, 6, 3e6, seed=1) if listed.reach else flow.domain_for(system).sample(6, 987)
    omega = system.params.get("omega", 1.0) if system.ndof == 1 else 1.0
    at_end, between = one_step_errors(flow, system, x, times=8, omega=omega)
    assert between <= 10 * at_end
    assert at_end <= 10 * listed.one_step_error * max(1.0, omega)


@pytest.mark.parametrize("name", LADDERS)
def test_what_costs_more_is_more_accurate(name):
    rungs = [f for f in shipped_flows(SCENES[name]()) if f.stages]
    errors = [f.energy_error for f in rungs]  # the cheapest first
    cheap = {"outer_solar_system": 0.1}  # the cheapest rung is better than 1e-4 already
    assert errors[-1] < cheap.get(name, 1e-3) * errors[0]
    of_state = {  # polynomials that are fitted to the state alone, beside flows for the energy
        f.name for f in rungs if f.polynomial and f.load().recipe["stages"][0]["energy_weight"] == 0.0
    }
    of_state.add("driven_pendulum-primed-8-0.5")  # a third of the state error of the rung before
    of_state.add(
        "fput_beta-primed-5-0.68"
    )  # a seventh of the state error of the rung before; its limit is of rare states
    cheaper = [(f, g) for f in rungs for g in rungs if g.cost <= f.cost and g.energy_error < f.energy_error]
    assert not [(f.name, g.name) for f, g in cheaper if f.name not in of_state]  # no rung is dominated by another
    assert not [(f.name, g.name) for f, g in cheaper if g.one_step_error / g.dt < f.one_step_error / f.dt]
    assert all(f.cost == pytest.approx(cost_of(f.load()), rel=1e-3) for f in rungs)


def test_the_figures_are_those_of_the_certificate():
    flow = SympFlow.primed(HH, 2, dt=0.5).requires_grad_(False)
    by_certificate(flow, HH, 100.0)
    sample = HH.domain.sample(400, 77)
    errors = max_energy_error(solve(HH, flow, (0.0, 100.0), y0=sample, on_domain_exit="ignore"))
    # another sample of states: quantiles agree to the noise of 100 draws
    assert flow.figures["energy_error_median"] == pytest.approx(float(np.median(errors)), rel=0.5)
    assert flow.figures["energy_error_95"] == pytest.approx(float(np.quantile(errors, 0.95)), rel=0.8)
