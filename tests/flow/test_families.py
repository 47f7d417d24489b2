"""The families of flows: laws that all of them obey, and what the rest of the package asks of a flow map."""

import copy
import itertools
import math
import pickle

import numpy as np
import pytest
import torch
from test_primed import FLOWS as PRIMED

from sympflow import Box, HamiltonianSystem, MLPFlow, SympFlow, Tube, load, solve, systems, time_transformed
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.families import FAMILIES
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.planetary import KeplerFlow
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.scaling import Scaling
from sympflow.kernels.protocol import Kernel

EPS = np.finfo(float).eps
PENDULUM, KEPLER = systems.pendulum(), systems.kepler()
TRANSFORMED, DRIVEN = time_transformed(KEPLER), systems.driven_pendulum()
WHOLE = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", y0=[0.4, 0.3])
PLANETS = HamiltonianSystem.planets(
    [1.0, 0.02, 0.01], elements={"a": [1.0, 1.7], "e": [0.05, 0.03], "inc": [0.1, 0], "M": [0, 2]}, encounter=None
)
PLANETS = PLANETS.with_scene(domain=Tube(solve(PLANETS, "kepler_aba864", (0, 10), dt=0.2).states, 0.01))


def of_planets():
    flow = KeplerFlow(PLANETS.ndof, 1, 1, 0.4, system=PLANETS)
    for numbers in (flow.kicks, flow.gradients):
        numbers.copy_(0.02 * torch.arange(1, 1 + len(numbers)))
    return flow


FLOWS = {
    "sympflow": (lambda: SympFlow(1, hidden=(4, 3)), PENDULUM),
    "primed": (lambda: SympFlow.primed(PENDULUM, 2, dt=0.3, processor=2, curvature=True), PENDULUM),
    "split": (lambda: SympFlow.split(PENDULUM, 2, dt=0.1, parts=("1 - cos(q1)", "p1**2/2")), PENDULUM),
    "clocked": (lambda: ClockedFlow(TRANSFORMED.ndof, "leapfrog", 3, 0.2, TRANSFORMED), TRANSFORMED),
    "kepler": (of_planets, PLANETS),
    "collocated": (lambda: SympFlow.collocated(WHOLE, dt=0.2, stages=2, steps=2), WHOLE),
    "timed": (lambda: SympFlow.timed(DRIVEN, 2, hidden=(4,)), DRIVEN),
    "mlp": (lambda: MLPFlow(1, (4, 5)), PENDULUM),
}
UNCOMPILED = {
    "mlp": r"^`method` 'mlp' has no compiled form: use backend='array'\.$",
    "timed": r"^`flow` has networks that take the time .* no compiled form: use backend='array'\.$",
}
EACH = pytest.mark.parametrize("name", FLOWS)


def started(flow):
    """The time of a state, which the flow of a driven system asks for."""
    return {"t0": 0.3} if flow.driven else {}


def test_every_family_is_here():
    assert FLOWS.keys() - {"timed"} == FAMILIES.keys()  # a SympFlow with a drive


@EACH
def test_what_is_asked_of_a_flow_map(name):
    make, system = FLOWS[name]
    flow, x = make(), torch.as_tensor(system.y0)
    assert flow.matches(system)
    with pytest.raises(ValueError, match=r"^`system` .*(degrees of freedom|is not the one|driven)"):
        solve(systems.toda_lattice(), flow, (0, 1), np.zeros(6))
    other = HamiltonianSystem(lambda q: (q**4).sum(-1), ndof=flow.ndof)
    assert flow.matches(other) == (flow.fingerprint is None)
    if name not in ("sympflow", "mlp"):
        with pytest.raises(ValueError, match=r"^`system` 'V of a function' (is not the one|has no drive)"):
            solve(other, flow, (0, 1), np.zeros(2 * flow.ndof))
    assert flow.origin is None
    assert len(flow.clock_numbers()) == (3 if name == "clocked" else 0)
    assert any(flow.evaluations(10, 1, 0, "array").values()) == (name not in ("sympflow", "timed", "mlp"))
    begun = started(flow)
    slope = flow.initial_velocity(x, **begun)
    torch.testing.assert_close(slope, flow.velocity(0.0, x, **begun), rtol=1e-12, atol=1e-13)
    if flow.symplectic:
        assert flow.hamiltonian(0.1, x, **begun).shape == ()
    else:
        with pytest.raises(TypeError, match="which has no Hamiltonian"):
            flow.hamiltonian(0.1, x)


@EACH
def test_compiled_loops_are_kept_while_no_weight_changes(name):
    make, system = FLOWS[name]
    flow = make().requires_grad_(False)
    if name in UNCOMPILED:
        with pytest.raises(ValueError, match=UNCOMPILED[name]):
            flow.kernel_for(system)
        return
    kernel: Kernel = flow.kernel_for(system)
    assert flow.kernel_for(system) is kernel
    for other in (copy.deepcopy(flow), pickle.loads(pickle.dumps(flow))):
        assert other.kernel_for(system) is not kernel
    with pytest.raises(ValueError, match=r"^`flow` is torch.float32 on cpu: compiled flows are float64 on the CPU"):
        copy.deepcopy(flow).float().kernel_for(system)
    for weights in list(flow.parameters())[:1]:  # a collocated flow and one of planets have none
        weights.mul_(1.5).add_(0.1)
    after = flow.kernel_for(system).step(flow.dt, np.atleast_2d(system.y0)).states
    x = torch.as_tensor(system.y0).requires_grad_()  # so that no flow takes its compiled loops
    torch.testing.assert_close(torch.as_tensor(after[0]), flow.psi(flow.dt, x).detach(), rtol=1e-12, atol=1e-13)
    if name in ("primed", "kepler"):
        assert flow.kernel_for(system, compensated=True) is not flow.kernel_for(system)
    else:
        with pytest.raises(ValueError, match=r"^`compensated` sums need the compiled loops of a primed flow"):
            flow.kernel_for(system, compensated=True)


# laws -----------------------------------------------------------------------------------------------------------------


def rough(flow, spread=0.0):
    """The flow with larger weights than it begins with, or with coefficients that are free of any pattern."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for w in flow.parameters():
            noise = torch.randn(w.shape, generator=generator, dtype=w.dtype)
            w.copy_(w + spread * noise if spread else 2 * w)
    return flow.requires_grad_(False)


POLAR = systems.spring_pendulum(1e4, coordinates="polar")


def split(system, **options):
    return rough(SympFlow.split(system, terms=4, **options), 0.05)


def damped(damping):
    hh = systems.henon_heiles()
    return HamiltonianSystem.from_sympy(hh.symbols.H, damping=damping, y0=hh.y0, domain=hh.domain)


DRIVEN_AND_DAMPED = HamiltonianSystem.from_sympy(
    "p**2/2 - cos(q)*(1 + cos(2*t)/9)", time="t", period=np.pi, damping=0.2, domain=Box([-1, -1], [1, 1])
)


def hh(**options):
    return split(systems.henon_heiles(), dt=0.7, **options)


LAWFUL = {
    "published": lambda: rough(SympFlow(2, pairs=3, seed=1)),
    "one degree of freedom, one hidden layer": lambda: rough(SympFlow(1, pairs=2, hidden=(8,), seed=2)),
    "three degrees, deep": lambda: rough(SympFlow(3, pairs=2, hidden=(6, 7, 5), activation="sin", seed=3)),
    "softplus": lambda: rough(SympFlow(2, pairs=2, hidden=(9, 9), activation="softplus", seed=4)),
    "scaled": lambda: rough(SympFlow(2, pairs=2, dt=0.1, scale=Scaling((0.1, 0.2), (30.0, 20.0), 0.1), seed=5)),
    "layers in another order": lambda: rough(
        SympFlow.from_layers([layer(MLPPotential(2)) for layer in (Drift, Kick, Kick, Drift)], dt=1.0)
    ),
    **PRIMED,
    "kicks": lambda: hh(stages=3),
    "shears": lambda: split(POLAR, dt=0.05, stages=2),
    "no filters": lambda: hh(stages=2, filters=False, force_gradient=False),
    "linear part inside": lambda: hh(stages=3, linear_outside=False, force_gradient=(1, 2)),
    "midpoint rule": lambda: SympFlow.collocated(systems.double_pendulum(), dt=0.5, stages=1, steps=3),
    "Gauss": lambda: SympFlow.collocated(systems.double_pendulum(), dt=0.5, stages=3, steps=1),
    "clocked": FLOWS["clocked"][0],
    "planets": of_planets,
    "timed": FLOWS["timed"][0],
    "driven": lambda: rough(SympFlow.primed(DRIVEN, 2, processor=2, dt=0.4), 0.05),
    "damped": lambda: rough(SympFlow.primed(systems.damped_pendulum(0.3), 2, processor=2, dt=0.4), 0.05),
    "damped by a matrix": lambda: rough(SympFlow.primed(damped([[0.3, 0.1], [0.1, 0.2]]), 2, dt=0.8), 0.05),
    "driven and damped": lambda: rough(SympFlow.primed(DRIVEN_AND_DAMPED, 2, processor=1, dt=0.4), 0.05),
}


def states_of(flow):
    """States (5, 2d), and the units of their coordinates."""
    d, generator = flow.ndof, torch.Generator().manual_seed(1)
    system = flow.system
    if system is None:
        of = {layer.kind: layer.potential.scale[:d] for layer in flow.layers}
        unit = torch.cat([of["kick"], of["drift"]])
        return unit * torch.randn(5, 2 * d, dtype=torch.float64, generator=generator), unit
    if system is TRANSFORMED:
        return torch.as_tensor(system.y0) * torch.linspace(0.9, 1, 5)[:, None].double(), torch.ones(2 * d).double()
    return torch.as_tensor(system.domain.sample(5, 0)), torch.ones(2 * d).double()


def canonical(d):
    return torch.kron(torch.tensor([[0.0, 1.0], [-1.0, 0.0]]), torch.eye(d)).double()


@pytest.fixture(params=LAWFUL.values(), ids=LAWFUL.keys())
def lawful(request):
    flow = request.param().requires_grad_(False)
    return (flow, *states_of(flow))


def test_it_is_the_identity_at_zero_and_has_an_exact_inverse(lawful):
    flow, x, unit = lawful
    begun = started(flow)
    assert torch.equal(flow(0.0, x, **begun), x)
    assert torch.equal(flow(torch.zeros(5).double(), x, **begun), x)
    each = flow.dt * torch.tensor([0.4, 1.0, 0.0, 2.3, -1.7]).double()
    for t in (0.4 * flow.dt, 2.3 * flow.dt, -1.7 * flow.dt, each):
        y = flow(t, x, **begun)
        close = {"rtol": 0, "atol": 1e3 * EPS * float(1 + (y / unit).abs().max())}
        torch.testing.assert_close(flow.inverse(t, y, **begun) / unit, x / unit, **close)
        torch.testing.assert_close(flow(t, flow.inverse(t, x, **begun), **begun) / unit, x / unit, **close)
    alone = torch.stack([flow(float(t), row, **begun) for t, row in zip(each, x, strict=True)])
    torch.testing.assert_close(y / unit, alone / unit, rtol=1e-13, atol=1e-13)
    if flow.driven:
        starts = torch.linspace(0.1, 5.0, 5).double()
        alone = torch.stack([flow(2.3, row, float(t0)) for t0, row in zip(starts, x, strict=True)])
        torch.testing.assert_close(flow(2.3, x, starts + 7 * flow.period), alone, rtol=0, atol=1e-12)
        assert (flow(2.3, x, starts + 0.3 * flow.period) - alone).abs().max() > 1e-4


PALINDROMES = ["kicks", "shears", "no filters", "linear part inside", "midpoint rule", "Gauss", "planets"]
PALINDROMES += [name for name, make in PRIMED.items() if make().palindromic]


@pytest.mark.parametrize("name", PALINDROMES)
def test_palindromes_are_time_reversible(name):
    """Their inverse is the step back, and with the momenta turned they themselves: ψ̄₋ₜ = ψ̄ₜ⁻¹ = ρ ψ̄ₜ ρ; or K_t is."""
    flow = LAWFUL[name]().requires_grad_(False)
    x, _ = states_of(flow)
    t, rho = 0.7 * flow.dt, torch.tensor([1.0, -1.0]).double().repeat_interleave(flow.ndof)
    y = flow.kernel_step(t, x)
    for back in (flow.kernel_step(-t, y), rho * flow.kernel_step(t, rho * y)):
        torch.testing.assert_close(back, x, rtol=0, atol=1e3 * EPS * float(1 + x.abs().max()))


def test_it_is_symplectic_at_every_t(lawful):
    """With friction it shrinks the form by exp(−γt), and with a matrix Γ the volume by exp(−t tr Γ)."""
    flow, x, _ = lawful
    J = canonical(flow.ndof)
    damping = flow.system.damping if flow.system is not None and flow.system.friction else 0.0
    for t, row in zip(flow.dt * np.array([0.3, 2.6, -1.4]), x[:3], strict=True):
        A = torch.autograd.functional.jacobian(lambda y, t=t: flow(t, y, **started(flow)), row)
        if np.ndim(damping):
            assert float(torch.linalg.det(A)) == pytest.approx(math.exp(-t * np.trace(damping)), rel=1e-13)
        else:
            defect = A.T @ J @ A - math.exp(-damping * t) * J
            assert defect.abs().max() < 1e-13 * torch.linalg.matrix_norm(A, 2) ** 2


def test_its_velocity_is_the_time_derivative_and_that_of_its_hamiltonian(lawful):
    flow, x, unit = lawful
    t, begun = flow.dt * torch.linspace(0.05, 0.95, 5, dtype=torch.float64), started(flow)
    generated = 1e-10 if flow.system is POLAR else 1e3 * EPS  # a spring of 1e4 times the rounding of r, in each map
    y, velocity = flow.psi_and_velocity(t, x, **begun)
    by_jvp = torch.func.jvp(lambda t: flow.psi(t, x, **begun), (t,), (torch.ones_like(t),))
    torch.testing.assert_close(y / unit, by_jvp[0] / unit, rtol=0, atol=64 * EPS)
    size = float((velocity / unit).abs().max())
    torch.testing.assert_close(velocity / unit, by_jvp[1] / unit, rtol=0, atol=1e-12 * size)
    h = 1e-3 * flow.dt  # the differences are right to (h/Δt)⁴ = 1e-12 times the fifth derivative of ψ in t/Δt
    near, far = (flow.psi(t + k * h, x, **begun) - flow.psi(t - k * h, x, **begun) for k in (1, 2))
    torch.testing.assert_close(velocity / unit, (8 * near - far) / (12 * h) / unit, rtol=0, atol=1e-8 * size)
    if flow.system is not None and flow.system.friction:
        with pytest.raises(ValueError, match="has friction"):
            flow.hamiltonian(t, y, **begun)
        return
    y = y.detach().requires_grad_()
    (slope,) = torch.autograd.grad(flow.hamiltonian(t, y, **begun).sum(), y)
    torch.testing.assert_close(velocity / unit, slope @ canonical(flow.ndof).T / unit, rtol=0, atol=generated * size)


def test_runs_files_and_copies_are_the_flow(lawful, tmp_path):
    flow, x, _ = lawful
    begun, t = started(flow), 2.3 * flow.dt
    end = flow(t, x, **begun)
    flow.save(tmp_path / "flow.safetensors")
    again = load(tmp_path / "flow.safetensors", system=flow.system)
    for other in (again, copy.deepcopy(flow), pickle.loads(pickle.dumps(flow))):
        assert torch.equal(other(t, x, **begun), end)
    if flow.system is None or flow.system is TRANSFORMED:
        return
    t0 = begun.get("t0", 0.0)
    for span, backend in itertools.product(((t0, t0 + t), (t0, t0 - t)), ("compiled", "array")):
        run = solve(
            flow.system, flow, span, x.numpy(), t_eval=np.linspace(*span, 6), backend=backend, on_domain_exit="ignore"
        )
        direct = torch.stack([flow(float(s - t0), x, **begun) for s in run.t], -1)
        np.testing.assert_allclose(run.y, direct, rtol=0, atol=1e3 * EPS * float(1 + direct.abs().max()))


def test_a_family_of_ones_own_needs_only_the_map():
    class Identity(FlowMap):
        kind = "sympflow"

        def _map(self, t, y):
            return y

        _map_inverse = _map

    flow = Identity(1, 0.5)
    x = torch.ones(3, 2, dtype=torch.float64)
    assert torch.equal(flow(-1.2, x), x)
    assert solve(PENDULUM, flow, (0, 2), y0=[0.1, 0.2]).y[:, -1] == pytest.approx([0.1, 0.2], abs=0)


@pytest.mark.parametrize("backend", ["compiled", "array"])
def test_one_planet_is_back_after_its_period(backend):
    """Whatever the trained numbers are: its motion is Kepler's, and nothing kicks it."""
    masses = [1.0, 0.01]
    system = HamiltonianSystem.planets(masses, elements={"a": [1.3], "e": [0.3], "inc": [0.2]}, encounter=None)
    period = 2 * np.pi * np.sqrt(1.3**3 / sum(masses))
    flow = KeplerFlow(system.ndof, 2, 1, period / 16, system=system)
    flow.kicks.copy_(torch.linspace(0.1, 0.4, 4))
    sol = solve(system, flow, (0, period), t_eval=[0.3, period], backend=backend)
    np.testing.assert_allclose(sol.y[:, -1], system.y0, rtol=0, atol=16 * 64 * EPS)
