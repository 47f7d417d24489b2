"""Certificates: the bound holds, the exact flow has none to speak of, and files keep them."""

import json
import math

import numpy as np
import pytest
import torch
from conftest import tampered

import sympflow
from sympflow import Box, HamiltonianSystem, SympFlow, solve, systems
from sympflow.flow.certificate import Certificate, Quantiles, upper_limit
from sympflow.flow.files import load
from sympflow.flow.shipped import named, shipped

HH, PENDULUM, OSCILLATOR = systems.henon_heiles(), systems.pendulum(), systems.harmonic_oscillator()
QUICK = {"states": 300, "times": 9, "held_out": 20, "t_end": 100.0}
NETWORK = named("henon_heiles-sympflow").path


def primed(system=HH, **options):
    """Untrained: three leapfrog steps."""
    return SympFlow.primed(system, 3, dt=0.5, **options).requires_grad_(False)


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """A flow with its certificate, and its file."""
    flow, path = primed(), tmp_path_factory.mktemp("flow") / "flow.safetensors"
    flow.certificate(HH, **QUICK)
    flow.save(path)
    return flow, path


FLOWS = {
    "network": (lambda: load(NETWORK), HH),
    "primed": (primed, HH),
    "pendulum": (lambda: primed(PENDULUM), PENDULUM),
    "layers": (lambda: SympFlow.from_layers(list(load(NETWORK).layers), 1.0), HH),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FLOWS)
def test_the_bound_holds_along_orbits(name):
    """|H(ψ_kΔt x) − H(x)| ≤ kδ at every step until the orbit leaves Ω, for states of another seed."""
    make, system = FLOWS[name]
    flow = make()
    found = flow.certificate(system, **{**QUICK, "states": 2000})
    x = system.domain.sample(200, 987)
    orbit = np.moveaxis(solve(system, flow, (0.0, 100.0), y0=x, on_domain_exit="ignore").y, -1, 0)
    error = np.abs(system.hamiltonian(orbit) - system.hamiltonian(x))
    inside = np.logical_and.accumulate(system.domain.contains(orbit), axis=0)
    assert inside[-1].mean() > 0.5
    bound = np.array([found.bound(flow.dt * k) for k in range(len(orbit))])[:, None]
    assert (error[1:][inside[:-1]] <= np.broadcast_to(bound[1:], error[1:].shape)[inside[:-1]]).all()
    assert found.energy_error.largest <= found.bound(100.0)
    assert found.bound(100.0) < 1e4 * found.energy_error.largest  # pessimistic, but it says something
    steps = [found.bound(flow.dt * t) / found.delta.largest for t in (0.0, 0.2, 1.0, 1.2, 200.0, -2.0)]
    assert steps == pytest.approx([0, 1, 1, 2, 200, 2])


def test_an_upper_limit_of_a_quantile():
    """It is below the quantile in 1 % of the samples, for any distribution; what is not a number counts as infinite."""
    rng = np.random.default_rng(0)
    for n in (100, 1000):
        limits = np.array([upper_limit(rng.standard_exponential(n)) for _ in range(4000)])
        assert (limits < -np.log(0.05)).mean() == pytest.approx(0.01, abs=0.008)
    assert upper_limit(np.arange(1000.0)) == 965.0
    assert upper_limit(np.array([1.0, -3.0])) == 3.0
    assert upper_limit(np.array([1.0, math.nan])) == math.inf


def test_the_error_of_the_hamiltonian_against_its_definition():
    flow = shipped(HH)
    found = flow.certificate(HH, **{**QUICK, "times": 2, "states": 100, "t_end": 10.0})
    x = torch.tensor(HH.domain.sample(100, int(np.random.SeedSequence([0, 20_261, 0]).generate_state(1)[0])))
    differences = [flow.hamiltonian(t, x) - HH.hamiltonian(x) for t in (0.0, flow.dt)]
    values = torch.cat([(d - d.mean()).abs() for d in differences])
    assert found.hamiltonian_error.largest == pytest.approx(float(values.max()), rel=1e-12)
    assert found.hamiltonian_error.q95 == pytest.approx(float(values.quantile(0.95, interpolation="higher")), rel=1e-6)


def test_orbits_that_blow_up_are_infinite_errors():
    big = HamiltonianSystem.from_sympy(str(HH.symbols.H), domain=Box([-3.0] * 4, [3.0] * 4))
    found = primed(big).certificate(big, **{**QUICK, "t_end": 40.0})
    assert found.left > 0
    assert Quantiles.of(np.array([1.0, math.nan, -2.0])).largest == math.inf
    assert Quantiles.of(np.array([-3.0, 1.0, 2.0])) == Quantiles(2.0, 3.0, 3.0)


def test_single_precision(certified):
    found = primed(dtype=torch.float32).certificate(HH, **QUICK)
    assert found.delta.largest == pytest.approx(certified[0].certified.delta.largest, rel=1e-3)


# files -----------------------------------------------------------------------------------------------------------


def test_files_keep_certificates(certified, tmp_path):
    primed().save(tmp_path / "bare.safetensors")
    assert sympflow.load(tmp_path / "bare.safetensors").certified is None
    found = certified[0].certified
    assert sympflow.load(certified[1], system=HH).certified == found
    assert Certificate.from_dict(json.loads(json.dumps(found.to_dict()))) == found


def test_a_certificate_is_of_the_weights_it_was_made_of(tmp_path):
    flow = primed()
    flow.certificate(HH, **QUICK)
    with torch.no_grad():
        flow.kicks.free[0] += 1e-6
    with pytest.warns(RuntimeWarning, match=r"^`flow` was changed, or .* not stored: compute .* flow\.certificate"):
        flow.save(tmp_path / "flow.safetensors")
    assert sympflow.load(tmp_path / "flow.safetensors").certified is None
    trained = sympflow.train(
        HH, flow=flow, optimizer="adam", steps=1, points=40, validation_points=40, progress=False, matching_weight=0.0
    )
    assert trained.certified is None


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c.pop("delta"), "not the description of a certificate"),
        (lambda c: c.update(delta=3.0), "delta that is not made of quantiles"),
        (lambda c: c["delta"].update(median="0"), "median that is not a number"),
        (lambda c: c["delta"].update(median=-1.0), "median that is not a number"),
        (lambda c: c.update(states=True), "states that is not of type int"),
        (lambda c: c.update(weights="0"), "certificate is one of other weights"),
    ],
)
def test_a_certificate_that_was_tampered_with_is_refused(certified, tmp_path, edit, message):
    path = tmp_path / "flow.safetensors"
    path.write_bytes(certified[1].read_bytes())
    tampered(path, lambda record: edit(record["certificate"]))
    with pytest.raises(ValueError, match=rf"^`path` .*{message}"):
        sympflow.load(path)


# solve -----------------------------------------------------------------------------------------------------------


def test_solve_says_that_the_certificate_does_not_hold_outside():
    flow = primed()
    flow.domain = HH.domain
    outside = np.array([0.0, 0.0, 0.7, 0.0])
    assert "left the domain at t = 0: the figures of" in solve(HH, flow, (0.0, 1.0), y0=outside).message
    flow.certificate(HH, **QUICK)
    assert "the figures and the certificate of" in solve(HH, flow, (0.0, 1.0), y0=outside).message


# bad arguments -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"states": 0}, "^`states` must be an integer and at least 1"),
        ({"times": 1}, "^`times` must be an integer and at least 2"),
        ({"held_out": 2.0}, "^`held_out`"),
        ({"seed": -1}, "^`seed`"),
        ({"t_end": 0.1}, "^`t_end` must be finite and at least Δt"),
        ({"t_end": math.inf}, "^`t_end`"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        primed().certificate(HH, **arguments)


@pytest.mark.slow
def test_the_bound_counts_steps():
    found = primed().certificate(HH, **QUICK)
    delta = found.delta.largest
    assert [found.bound(t) / delta for t in (0.0, 0.1, 0.5, 0.6, 100.0, -1.0)] == pytest.approx([0, 1, 1, 2, 200, 2])


@pytest.mark.slow
def test_delta_is_the_integral_of_the_rate():
    """Against H itself: the mean over x of d/dt H(ψ̄_t(x)), integrated, is what H gained."""
    flow = primed()
    found = flow.certificate(HH, **{**QUICK, "states": 1, "times": 401})
    # one state alone: the integral of |rate| is at least what H gained, and the variation of H along the step
    t = torch.linspace(0, flow.dt, 401, dtype=torch.float64)
    x = HH.domain.sample(1, int(np.random.SeedSequence([0, 20_261, 0]).generate_state(1)[0]))
    H = HH.hamiltonian(flow.psi(t, torch.tensor(x))).numpy()
    assert found.delta.median == pytest.approx(np.abs(np.diff(H)).sum(), rel=2e-3)
    assert found.delta.median == found.delta.q95 <= found.delta.largest  # which is searched for near the state


@pytest.mark.slow
def test_delta_is_not_exceeded_by_states_that_are_drawn_later():
    """A state at which a step of the Kepler flow gains twice the largest of 2000 samples; and 20,000 others."""
    kepler = systems.kepler()
    flow = sympflow.load(next(f.path for f in sympflow.shipped_flows(kepler) if f.name == "kepler-primed-2-0.15"))
    found = flow.certificate(kepler, held_out=2, t_end=1.0)
    worst = np.array([[-0.36674323, -0.05063473, -0.0382541, -2.10487249]])
    x = np.concatenate([worst, kepler.domain.sample(20_000, 4711)])
    H = kepler.hamiltonian
    gain = np.abs(H(flow.bind(kepler).psi(flow.dt, torch.as_tensor(x)).detach().numpy()) - H(x))
    assert gain.max() <= found.delta.largest < 3 * gain.max()


EPS = np.finfo(float).eps


def test_an_exact_flow_is_found_exact(rotation):
    found = rotation.certificate(OSCILLATOR, **QUICK)
    for q in (found.defect, found.hamiltonian_error, found.delta):
        assert q.largest < 8 * EPS
    assert found.energy_error.largest < 100 * 8 * EPS
    assert found.bound(100.0) < 100 * 8 * EPS


def test_the_measured_errors_are_those_of_solve(certified):
    flow = certified[0]
    found = flow.certified
    x = HH.domain.sample(20, int(np.random.SeedSequence([0, 20_261, 1]).generate_state(1)[0]))
    together = solve(HH, flow, (0.0, 100.0), y0=x, on_domain_exit="ignore")  # rounds as the measured batch does
    errors = np.abs(together.energy() - together.energy()[:, :1])
    runs = [solve(HH, flow, (0.0, 100.0), y0=y, on_domain_exit="stop") for y in x]
    assert found.left == sum(run.status != 0 for run in runs)
    errors = np.array([row[: len(run.t)].max() for row, run in zip(errors, runs, strict=True)])
    assert found.energy_error.largest == pytest.approx(errors.max(), rel=1e-9)
    relative = errors / np.abs(together.energy()[:, 0])
    assert found.relative_energy_error.largest == pytest.approx(relative.max(), rel=1e-9)
