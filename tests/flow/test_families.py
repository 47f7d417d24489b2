"""The families of flows: each builds itself from its architecture, and answers all that the rest asks of a flow map."""

import copy
import pickle

import pytest
import torch

from sympflow import HamiltonianSystem, MLPFlow, SympFlow, solve, systems, time_transformed
from sympflow.flow.clocked import ClockedFlow
from sympflow.flow.families import FAMILIES, family, family_of
from sympflow.flow.flow_map import FlowMap
from sympflow.flow.scaling import Scaling
from sympflow.kernels.protocol import Kernel

PENDULUM, KEPLER = systems.pendulum(), systems.kepler()
TRANSFORMED, DRIVEN = time_transformed(KEPLER), systems.driven_pendulum()
WHOLE = HamiltonianSystem.from_sympy("p**2*(1 + q**2)/2 + q**2/2", y0=[0.4, 0.3])
FLOWS = {
    "sympflow": (lambda: SympFlow(1, hidden=(4, 3)), PENDULUM),
    "primed": (lambda: SympFlow.primed(PENDULUM, 2, dt=0.3, processor=2, curvature=True), PENDULUM),
    "split": (lambda: SympFlow.split(PENDULUM, 2, dt=0.1, parts=("1 - cos(q1)", "p1**2/2")), PENDULUM),
    "clocked": (lambda: ClockedFlow(TRANSFORMED.ndof, "leapfrog", 3, 0.2, TRANSFORMED), TRANSFORMED),
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
def test_a_flow_is_built_again_from_its_architecture(name):
    make, system = FLOWS[name]
    flow = make()
    plan = flow.architecture()
    assert type(flow) is family("sympflow" if name == "timed" else name) is family_of(flow.kind, plan)
    again = type(flow).from_architecture(plan["ndof"], plan, flow.dt, flow.dtype)
    assert again.architecture() == plan
    again.load_state_dict(flow.state_dict())
    x = torch.as_tensor(system.y0)
    assert torch.equal(again.bound(system).psi(0.1, x, **started(flow)), flow.psi(0.1, x, **started(flow)))


@EACH
def test_a_run_of_kernel_steps_is_one_of_the_flow(name):
    make, system = FLOWS[name]
    flow, x = make(), torch.as_tensor(system.y0)
    z = flow.lift(x, **started(flow))
    y = flow.prepare(flow.dt, z)
    for _ in range(3):
        y = flow.kernel_step(flow.dt, y)
    end = flow(3 * flow.dt, x, **started(flow))
    torch.testing.assert_close(flow.project(flow.finish(flow.dt, y)), end, rtol=1e-12, atol=1e-13)
    if flow.symplectic:
        back = flow.kernel_step(flow.dt, flow.kernel_step(flow.dt, z), back=True)
        torch.testing.assert_close(back, z, rtol=1e-12, atol=1e-13)


@EACH
def test_what_is_asked_of_a_flow_map(name):
    make, system = FLOWS[name]
    flow, x = make(), torch.as_tensor(system.y0)
    assert flow.matches(system)
    assert flow.matches(systems.henon_heiles()) == (flow.fingerprint is None and flow.ndof == 2)
    assert flow.origin is None
    assert len(flow.clock_numbers()) == (3 if name == "clocked" else 0)
    assert any(flow.evaluations(10, 1, 0, "array").values()) == (name in ("primed", "split", "clocked", "collocated"))
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
    for weights in list(flow.parameters())[:1]:  # a collocated flow has none
        weights.mul_(1.5).add_(0.1)
    x = torch.as_tensor(system.y0)
    after = flow.kernel_for(system).step(flow.dt, x[None].numpy()).states
    torch.testing.assert_close(torch.as_tensor(after[0]), flow.psi(flow.dt, x), rtol=1e-12, atol=1e-13)
    if name == "primed":
        assert flow.kernel_for(system, compensated=True) is not flow.kernel_for(system)
    else:
        with pytest.raises(ValueError, match=r"^`compensated` sums need the compiled loops of a primed flow"):
            flow.kernel_for(system, compensated=True)


def test_a_flow_in_another_time_knows_the_system_that_it_is_for():
    flow = FLOWS["clocked"][0]()
    origin = {"system": KEPLER.name, "fingerprint": list(KEPLER.fingerprint), "shift": TRANSFORMED.params["shift"]}
    flow.recipe = {"transforms": origin}
    assert flow.origin.is_of(KEPLER)
    assert not flow.matches(KEPLER)
    with pytest.raises(ValueError, match="but in another time"):
        flow.check_system(KEPLER)


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


def test_units_are_values():
    scaling = Scaling([1.0, 2.0], (0.5, 1), t=2.0)
    assert (scaling.q, scaling.p, scaling.q_center) == ((1.0, 2.0), (0.5, 1.0), (0.0, 0.0))
    assert Scaling.from_dict(scaling.to_dict()) == scaling == pickle.loads(pickle.dumps(scaling))
    with pytest.raises(AttributeError):
        scaling.t = 1.0
