"""Networks from elsewhere: imported and exported by a layout, with activations and potentials of a user's own."""

import importlib
import math
import pickle
import sys
from importlib import metadata
from importlib.metadata import EntryPoint

import numpy as np
import pytest
import torch
from torch import nn

from sympflow import SympFlow, load, solve, systems, train
from sympflow.flow import potentials
from sympflow.flow.layers import Drift, Kick
from sympflow.flow.potentials import MLPPotential, Potential, activation_named, register_activation, register_potential
from sympflow.flow.scaling import Scaling

PENDULUM = systems.pendulum()


class Swish(nn.Module):
    """An activation of others' code, whose class nobody knows here."""

    def forward(self, x):
        return x * torch.sigmoid(x)


class PlainSympFlow(nn.Module):
    """The architecture of the paper by plain modules and automatic differentiation: time is the last input."""

    def __init__(self, d, pairs, width, activation):
        super().__init__()

        def network():
            layers = nn.Linear(d + 1, width), activation, nn.Linear(width, width), activation, nn.Linear(width, 1)
            return nn.Sequential(*layers).double()

        self.of_q = nn.ModuleList(network() for _ in range(pairs))
        self.of_p = nn.ModuleList(network() for _ in range(pairs))

    def forward(self, t, x):
        q, p = x.chunk(2, -1)

        def impulse(net, z):
            with torch.enable_grad():
                z = z.detach().requires_grad_()
                V = sum(sign * net(torch.cat([z, s.expand(len(z), 1)], 1)).sum() for sign, s in ((1, t), (-1, 0 * t)))
                return torch.autograd.grad(V, z)[0]

        for of_q, of_p in zip(self.of_q, self.of_p, strict=True):
            p = p - impulse(of_q, q)
            q = q + impulse(of_p, p)
        return torch.cat([q, p], -1)

    def entries(self):
        pairs = zip(self.of_q, self.of_p, strict=True)
        return [entry for of_q, of_p in pairs for entry in (("kick", of_q), ("drift", of_p))]


def states(n, d):
    return torch.randn(n, 2 * d, dtype=torch.float64, generator=torch.Generator().manual_seed(3))


@pytest.fixture(autouse=True)
def _own_registries(monkeypatch):
    for register in (potentials.activations, potentials.potentials):
        monkeypatch.setattr(register, "added", dict(register.added))
    torch.manual_seed(5)


@pytest.mark.parametrize(
    "activation",
    [nn.Tanh(), Swish(), *(pytest.param(f, marks=pytest.mark.slow) for f in (nn.SiLU(), nn.Softplus(), nn.Sigmoid()))],
)
def test_networks_of_modules_give_the_map_of_the_modules(activation):
    theirs = PlainSympFlow(2, 3, 6, activation)
    flow = SympFlow.from_potentials(theirs.entries(), dt=1.0)
    x, t = states(20, 2), torch.tensor(0.7, dtype=torch.float64)
    torch.testing.assert_close(flow(t, x), theirs(t, x), rtol=1e-13, atol=1e-13)
    compiled = flow.kernel_for(None).step(0.7, x.numpy()).states
    np.testing.assert_allclose(compiled, theirs(t, x), rtol=1e-13, atol=1e-13)
    assert not any(w.requires_grad for w in flow.parameters())


def test_exported_weights_load_into_plain_modules_and_give_the_same_map():
    scale = Scaling((0.7, 1.3), (1.1, 0.4), 0.9, (0.1, 0.2), (0.3, 0.4))
    flow = SympFlow(2, pairs=2, hidden=(5, 5), activation="swish", dt=0.8, seed=4, scale=scale)
    theirs = PlainSympFlow(2, 2, 5, Swish())
    for (kind, module), entry in zip(theirs.entries(), flow.to_potentials(), strict=True):
        assert (kind, "last", "swish") == (entry["kind"], entry["time"], entry["activation"])
        linear = [layer for layer in module if isinstance(layer, nn.Linear)]
        for layer, weight, bias in zip(linear, entry["weights"], (*entry["biases"], np.zeros(1)), strict=True):
            layer.load_state_dict({"weight": torch.as_tensor(weight), "bias": torch.as_tensor(bias)})
    x, t = states(20, 2), torch.tensor(0.7, dtype=torch.float64)
    torch.testing.assert_close(flow(t, x), theirs(t, x), rtol=1e-13, atol=1e-13)


def test_an_imported_flow_solves_trains_and_is_saved(tmp_path):
    flow = SympFlow.from_potentials(PlainSympFlow(1, 1, 3, nn.Tanh()).entries(), dt=0.5)
    sol = solve(PENDULUM, flow, (0, 2), on_domain_exit="ignore")
    assert sol.stats["backend"] == "compiled"
    trained = train(PENDULUM, flow=flow, optimizer="adam", steps=2, points=20, progress=False, reference_states=2)
    assert not torch.equal(trained(0.5, states(1, 1)), flow(0.5, states(1, 1)))
    flow.save(tmp_path / "flow.safetensors")
    assert torch.equal(load(tmp_path / "flow.safetensors")(0.5, states(2, 1)), flow(0.5, states(2, 1)))


GOOD = SympFlow(1, pairs=1, hidden=(3, 2)).to_potentials()[0]


@pytest.mark.parametrize(
    ("entry", "error", "message"),
    [
        ({**GOOD, "weights": [W.T for W in GOOD["weights"]]}, ValueError, r"`weights` must have shapes \(h_1, d"),
        ({**GOOD, "weights": GOOD["weights"][:1]}, ValueError, r"`weights` must be those of one or more hidden layers"),
        ({**GOOD, "biases": GOOD["biases"][:1]}, ValueError, r"`weights` must be those of one or more hidden layers"),
        ({**GOOD, "biases": [b * np.nan for b in GOOD["biases"]]}, ValueError, r"`biases` must be finite"),
        ({**GOOD, "biases": [b.astype("f4") for b in GOOD["biases"]]}, TypeError, r"must be of one dtype"),
        ({**GOOD, "weights": "tanh"}, TypeError, r"`weights` must be a list of arrays"),
        ({**GOOD, "activation": "relu"}, ValueError, r"`activation` 'relu' is unknown: choose one of tanh, sin"),
        ({**GOOD, "time": "middle"}, ValueError, r"`time` must be 'last' or 'first'"),
        ({**GOOD, "kind": "shear"}, ValueError, r"its kind must be 'kick', V of q, or 'drift', V of p; got 'shear'"),
        ({**GOOD, "bias": 3}, ValueError, r"it must have kind, weights and biases"),
        (("kick", nn.Linear(2, 1)), TypeError, r"`potentials` must be torch.nn.Sequential of Linear, activation"),
        (
            ("kick", nn.Sequential(nn.Linear(2, 3), nn.ELU(alpha=0.5), nn.Linear(3, 1))),
            ValueError,
            r"an activation ELU\(alpha=0.5\) that is not one of tanh, .*: register it by",
        ),
        (3, TypeError, r"it must be a mapping, or a pair of a kind and a torch.nn.Sequential"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_number(entry, error, message):
    with pytest.raises(error, match=rf"^`potentials\[1\]` cannot be taken: .*{message}"):
        SympFlow.from_potentials([GOOD, entry], dt=1.0)


# activations of a user's own -----------------------------------------------------------------------------------------


def softsign_like(a):
    return a / torch.sqrt(1 + a * a)


def softsign_like_slope(a):
    root = (1 + a * a) ** 0.5
    return a / root, 1 / root**3


def softsign_like_by_cases(a):
    """No function of traced numbers: Numba compiles it."""
    root = math.sqrt(1 + a * a)
    return (a / root if a > 0 else -(-a / root)), 1 / root**3


def wrong_slope(a):
    return a / (1 + a * a) ** 0.5, 1.0


@pytest.mark.parametrize("compiled", [softsign_like_slope, softsign_like_by_cases])
def test_an_activation_of_a_function_has_all_derivatives_and_compiled_loops(compiled):
    register_activation("softsign_like", softsign_like, compiled)
    flow = SympFlow(1, pairs=2, hidden=(4, 3), activation="softsign_like", dt=1.0)
    x = states(6, 1)
    t = torch.linspace(0.1, 0.9, 6, dtype=torch.float64)
    step = 1e-5
    difference = (flow(t + step, x) - flow(t - step, x)) / (2 * step)
    torch.testing.assert_close(flow.velocity(t, x), difference, rtol=1e-8, atol=1e-8)
    sol = solve(PENDULUM, flow, (0, 3), on_domain_exit="ignore")
    arrays = solve(PENDULUM, flow, (0, 3), on_domain_exit="ignore", backend="array")
    assert (sol.stats["backend"], arrays.stats["backend"]) == ("compiled", "torch")
    np.testing.assert_allclose(sol.y, arrays.y, rtol=0, atol=1e-14)
    copy = pickle.loads(pickle.dumps(flow))
    assert torch.equal(copy(0.5, x), flow(0.5, x))


def test_without_numba_the_extra_is_named(monkeypatch):
    def not_yet_compiled(a):
        return softsign_like_by_cases(a)

    register_activation("softsign_like", softsign_like, not_yet_compiled)
    flow = SympFlow(1, pairs=1, hidden=(3,), activation="softsign_like", dt=1.0)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ValueError, match=r"`compiled`.*pip install numba.*, or write it by operators"):
        solve(PENDULUM, flow, (0, 2), on_domain_exit="ignore", backend="compiled")
    assert solve(PENDULUM, flow, (0, 2), on_domain_exit="ignore").stats["backend"] == "torch"


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("tanh", softsign_like), ValueError, r"^`name` 'tanh' is a built-in activation, which cannot be replaced"),
        (("", softsign_like), ValueError, r"^`name` '' is empty"),
        ((3, softsign_like), TypeError, r"^`name` must be a string"),
        (("own", 3), TypeError, r"^`activation` must be a function of tensors or an Activation"),
        (("own", lambda a: a.sum()), TypeError, r"^`activation` 'own' must be an elementwise function of tensors"),
        (("own", torch.zeros_like), TypeError, r"^`activation` 'own' must be an elementwise function"),
        (("own", softsign_like, wrong_slope), ValueError, r"^`compiled` does not return the value and the slope of"),
        (("own", softsign_like, 3), TypeError, r"^`compiled` must be a function of a number"),
    ],
)
def test_activations_that_cannot_be_right_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        register_activation(*arguments)


# files of flows that need what is registered -----------------------------------------------------------------------


class Square(Potential):
    """V(t, x) = t·c|x|²/2."""

    def __init__(self, ndof):
        super().__init__()
        self.ndof = ndof
        self.c = nn.Parameter(torch.tensor(0.3, dtype=torch.float64))

    def impulse(self, t, x):
        return t * self.c * x

    def value(self, t, x):
        return t * self.c * (x * x).sum(0) / 2

    def to_dict(self):
        return {"type": "square"}

    @classmethod
    def from_dict(cls, ndof, plan, dtype):
        return cls(ndof).to(dtype)


@pytest.fixture
def announced(monkeypatch):
    points = [
        EntryPoint("announced", f"{__name__}:softsign_like", potentials.ACTIVATION_GROUP),
        EntryPoint("seven", "math:pi", potentials.ACTIVATION_GROUP),
        EntryPoint("square", f"{__name__}:Square", potentials.POTENTIAL_GROUP),
        EntryPoint("pi", "math:pi", potentials.POTENTIAL_GROUP),
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda group: [p for p in points if p.group == group])
    for register in (potentials.activations, potentials.potentials):
        vars(register).pop("announced", None)
    yield
    for register in (potentials.activations, potentials.potentials):
        vars(register).pop("announced", None)


def test_a_file_finds_what_installed_plugins_announce(announced, tmp_path):
    flow = SympFlow.from_layers(
        [Kick(importlib.import_module(__name__).Square(1)), Drift(MLPPotential(1, (3,), "announced"))], dt=0.5
    )
    flow.save(tmp_path / "flow.safetensors")
    assert torch.equal(load(tmp_path / "flow.safetensors")(0.4, states(2, 1)), flow(0.4, states(2, 1)))
    with pytest.raises(ImportError, match=r"^`activation` 'seven' of the plug-in .* is not valid"):
        activation_named("seven")
    with pytest.raises(ImportError, match=r"^`potential` 'pi' of the plug-in .* is not valid"):
        potentials.potential_named("pi")


def test_closed_forms_of_a_user_are_checked():
    class Wrong(potentials.Activation):
        def slope(self, a):
            return potentials.ACTIVATIONS["tanh"].slope(a)

        def tangent(self, a, da):
            h, slope, dh, dslope = potentials.ACTIVATIONS["tanh"].tangent(a, da)
            return h, slope, dh, -dslope

    with pytest.raises(ValueError, match=r"^`activation` 'wrong' has a tangent\(\) whose dslope is not that of value"):
        register_activation("wrong", Wrong())


class Crooked(Square):
    @classmethod
    def from_dict(cls, ndof, plan, dtype):
        raise KeyError("width")


def test_a_file_says_which_potential_it_needs_and_how_it_gets_it(tmp_path, monkeypatch):
    path = tmp_path / "flow.safetensors"
    flow = SympFlow.from_layers([Kick(Square(1)), Drift(MLPPotential(1, (3,)))], dt=0.5)
    with pytest.raises(ValueError, match=r"^`flow` has a potential Square that no file can name: register the class"):
        flow.save(path)
    assert not path.exists()
    register_potential("square", Square)
    flow.save(path)
    x = states(2, 1)
    assert torch.equal(load(path)(0.4, x), flow(0.4, x))
    register_potential("square", Crooked)
    with pytest.raises(ValueError, match=r"its potential 'square' cannot be built \(KeyError: 'width'\)"):
        load(path)
    monkeypatch.setattr(potentials.potentials, "added", {})
    with pytest.raises(ValueError, match=r"it needs the potential 'square', .* sympflow.flow.potentials.register_pot"):
        load(path)
