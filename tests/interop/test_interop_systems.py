"""Peers' systems converted: H(q, p) and modules forward(t, y) describe the same motion as our own definition."""

import numpy as np
import pytest
import torch
from conftest import refusals

from sympflow import HamiltonianSystem, solve, systems
from sympflow.interop.systems import from_hamiltonian, from_module

HH = systems.henon_heiles()


def henon_heiles(q, p):
    return (p**2).sum(-1) / 2 + (q**2).sum(-1) / 2 + q[..., 0] ** 2 * q[..., 1] - q[..., 1] ** 3 / 3


class Field(torch.nn.Module):
    """x' = J∇H of Hénon–Heiles, as one would write it for torchdiffeq."""

    def forward(self, t, y):
        q1, q2, p1, p2 = y.unbind(-1)
        return torch.stack([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2], -1)


class Relativistic(torch.nn.Module):
    """H = √(1 + p²) + q⁴/4 + q p/10: neither separable nor of quadratic kinetic energy."""

    def forward(self, t, y):
        q, p = y.unbind(-1)
        return torch.stack([p / torch.sqrt(1 + p**2) + q / 10, -(q**3) - p / 10], -1)


@pytest.mark.parametrize(
    "system", [from_hamiltonian(henon_heiles, 2, y0=HH.y0, dt=HH.dt), from_module(Field(), 2, y0=HH.y0, dt=HH.dt)]
)
def test_a_separable_one_is_recognised_and_moves_as_ours(system):
    assert system.separable
    assert system.quadratic_kinetic
    y = HH.domain.sample(5)
    np.testing.assert_allclose(system.hamiltonian(y), HH.hamiltonian(y), atol=1e-14)
    np.testing.assert_allclose(system.vector_field(y), HH.vector_field(y), atol=1e-14)
    assert np.allclose(system.fingerprint, HH.fingerprint, rtol=1e-12)  # so that HH's trained flows fit it
    for method in ("verlet", "srkn11b", "sympflow"):
        ours, theirs = (solve(s, method, (0, 5), on_domain_exit="ignore") for s in (HH, system))
        np.testing.assert_allclose(theirs.y, ours.y, atol=1e-12)


def test_masses_are_read_off():
    def H(q, p):
        return p[..., 0] ** 2 / 4 + p[..., 0] * p[..., 1] / 5 + p[..., 1] ** 2 / 6 + (q**4).sum(-1)

    system = from_hamiltonian(H, 2)
    np.testing.assert_allclose(system.inverse_mass, [[1 / 2, 1 / 5], [1 / 5, 1 / 3]], atol=1e-11)


def test_a_general_one():
    H = HamiltonianSystem.from_sympy("sqrt(1 + p**2) + q**4/4 + q*p/10", y0=[1.0, 0.5])
    system = from_module(Relativistic(), 1, y0=[1.0, 0.5])
    assert not system.separable
    y = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    np.testing.assert_allclose(
        system.hamiltonian(y) - system.hamiltonian(y[0]), H.hamiltonian(y) - H.hamiltonian(y[0]), atol=1e-12
    )
    sol = solve(system, "dop853", (0, 10), rtol=1e-10, atol=1e-12)
    assert np.abs(np.ptp(sol.energy())) < 1e-9


def test_terms_linear_in_p_are_kept():
    system = from_hamiltonian(lambda q, p: (p**2).sum(-1) / 2 + p.sum(-1) + (q**4).sum(-1), 1)
    np.testing.assert_allclose(system.vector_field(np.array([1.0, 2.0])), [3.0, -4.0])
    system = from_module(lambda t, y: torch.cat([y[..., 1:] + 1, -y[..., :1]], -1), 1)
    np.testing.assert_allclose(system.vector_field(np.array([1.0, 2.0])), [3.0, -1.0])


def oscillator_in_units_of(e):
    return lambda q, p: ((p**2).sum(-1) / e + e * (q**2).sum(-1)) / 2


@pytest.mark.parametrize("e", [1e-9, 1e-4, 1.0, 3e4, 3e5, 3e6, 7e8])
def test_the_units_do_not_matter(e):
    """The mass is found to rounding, and a coupling q·p, or a term linear in p, is never dropped."""
    plain, y0 = oscillator_in_units_of(e), [1.0, e]
    system = from_hamiltonian(plain, 1, y0=y0)
    assert system.separable
    y = np.array([[0.7, 0.2 * e], [-0.3, 1.1 * e]])
    exact = np.stack([y[:, 1] / e, -e * y[:, 0]], -1)
    np.testing.assert_allclose(system.vector_field(y), exact, rtol=1e-14)
    coupled = from_hamiltonian(lambda q, p: plain(q, p) + 0.3 * (q * p).sum(-1), 1, y0=y0)
    assert not coupled.separable
    np.testing.assert_allclose(coupled.vector_field(y), exact + 0.3 * y * [1, -1], rtol=1e-12)
    moved = from_hamiltonian(lambda q, p: plain(q, p) + 0.3 * p.sum(-1), 1, y0=y0)
    np.testing.assert_allclose(moved.vector_field(y), exact + np.array([0.3, 0.0]), rtol=1e-12)


class Trained(torch.nn.Module):
    """p²/(2m) + b p + k q²/2 with numbers to be trained, as H(q, p) and as a field."""

    def __init__(self, **start):
        super().__init__()
        for name, value in {"m": 1.0, "b": 0.0, "k": 1.0, "c": 0.0, **start}.items():
            self.register_parameter(name, torch.nn.Parameter(torch.tensor(value, dtype=torch.float64)))

    def hamiltonian(self, q, p):
        return (p**2 / (2 * self.m) + self.b * p + self.c * q * p + (self.k * q**2 / 2)).sum(-1)

    def forward(self, t, y):
        q, p = y[..., :1], y[..., 1:]
        return torch.cat([p / self.m + self.b + self.c * q, -self.k * q - self.c * p], -1)


@pytest.mark.parametrize("frozen", [(), ("m",), ("m", "b"), ("m", "b", "c")])
def test_a_kinetic_energy_that_is_trained_keeps_its_gradients(frozen):
    """Numbers of ∂H/∂p, even where they are 0 as yet, make no separable system; those of V alone do."""
    module = Trained(m=1.3)
    for name in frozen:
        getattr(module, name).requires_grad_(False)
    y0 = torch.tensor([1.0, 0.2], dtype=torch.float64)
    trained = [v for v in module.parameters() if v.requires_grad]
    for system in (from_hamiltonian(module.hamiltonian, 1), from_module(module, 1)):
        assert system.separable == (len(frozen) == 3)
        slopes = torch.autograd.grad(solve(system, "rk4", (0, 0.4), y0, dt=0.1).y[0, -1], trained)
        for number, slope in zip(trained, slopes, strict=True):
            ends, value = [], number.item()
            for moved in (value + 1e-4, value - 1e-4, value):
                with torch.no_grad():
                    number.fill_(moved)
                ends.append(solve(system, "rk4", (0, 0.4), y0, dt=0.1).y[0, -1].item())
            assert slope.item() == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-6)


def give_gradients(module):
    module.m.requires_grad_(True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda module: module.m.data.fill_(4.0), "has another ∂H/∂p than when"),
        (lambda module: module.b.data.fill_(0.1), "has another ∂H/∂p than when"),
        (lambda module: module.c.data.fill_(0.1), "has another ∂H/∂p than when"),
        (give_gradients, "depends in ∂H/∂p on tensors that require gradients"),
    ],
)
@pytest.mark.parametrize("method", ["verlet", "rk4"])
def test_a_mass_that_changes_after_it_was_fixed_is_refused(method, change, words):
    """Beside it V may change: it is read in each call."""
    module = Trained().requires_grad_(False)
    made = [from_hamiltonian(module.hamiltonian, 1), from_module(module, 1)]
    assert all(system.separable for system in made)
    module.k.data.fill_(4.0)
    assert solve(made[1], method, (0, 1.0), [1.0, 0.0], dt=0.01).y[0, -1] == pytest.approx(np.cos(2.0), abs=1e-3)
    change(module)
    for system, argument in zip(made, ("H", "module"), strict=True):
        with pytest.raises(ValueError, match=rf"`{argument}` {words}.*Make a new system"):
            solve(system, method, (0, 1.0), [1.0, 0.0], dt=0.01)


def field(force):
    """p, and a force of (t, q, p)."""
    return lambda t, y: torch.cat([y[..., 1:], force(t, y[..., :1], y[..., 1:])], -1)


def kepler(t, y):
    q, p = y.chunk(2, -1)
    return torch.cat([p, -q / (q**2).sum(-1, keepdim=True) ** 1.5], -1)


def single(t, y):
    return torch.nn.functional.linear(y, torch.eye(2))


test_refusals = refusals(
    (lambda: from_module(field(lambda t, q, p: -q - 0.1 * p), 1), "^`module` is not a Hamiltonian field"),
    (lambda: from_module(field(lambda t, q, p: torch.cos(t) - q), 1), "^`module` depends on t"),
    (lambda: from_module(field(lambda t, q, p: -q * (1 + torch.sin(2 * torch.pi * t))), 1), "^`module` depends on t"),
    (lambda: from_module(lambda t, y: Field()(t, y) * (1.0 if t < 5 else 2.0), 2, y0=HH.y0), "^`module` depends on t"),
    (lambda: from_module(lambda t, y: y[..., :1], 1), r"^`module` must map \(\.\.\., 2\)"),
    (lambda: from_module(kepler, 2, y0=[1.0, 0.0, 0.0, 1.0]), "^`module` is not smooth on the straight"),
    (lambda: from_module(single, 1), TypeError, r"^`module` failed on float64 states .*double\(\) first"),
    (lambda: from_module("pendulum", ndof=1), TypeError, "^`module` must be a function .* or a torch module; got str"),
    (lambda: from_module(Field(), 0), "^`ndof` must be a positive integer"),
    (lambda: from_hamiltonian(lambda q, p: q * p, 2), "^`H` must map q, p"),
    (lambda: from_hamiltonian(lambda t, q, p: q, 2), TypeError, r"^`H` must be a function H\(q, p\)"),
    *(
        (lambda y0=y0: from_hamiltonian(henon_heiles, ndof=2, y0=y0), "^`y0` must be 4 finite numbers, .*got")
        for y0 in ([0.0, 0.0], [0.0, 0.0, 0.0, np.nan], [[0.0] * 4])
    ),
    (
        lambda: from_hamiltonian(lambda q, p: torch.from_numpy((q.numpy() ** 2 + p.numpy() ** 2).sum(-1)), 2),
        TypeError,
        "^`H` cannot be differentiated .*torch functions",
    ),
    (
        lambda: from_hamiltonian(lambda q, p: (q.detach().numpy() ** 2).sum(-1), 2),
        "^`H` .*with torch functions; .* gave a NumPy array",
    ),
)


@pytest.mark.parametrize("e", [1e-9, 1.0, 7e8])
def test_the_units_of_a_module_do_not_matter(e):
    def with_coupling(c, d):
        return lambda t, y: torch.stack([y[..., 1] / e + c * y[..., 0], -e * y[..., 0] - d * y[..., 1]], -1)

    assert from_module(with_coupling(0.0, 0.0), 1, y0=[1.0, e]).separable
    assert not from_module(with_coupling(0.3, 0.3), 1, y0=[1.0, e]).separable
    with pytest.raises(ValueError, match=r"^`module` is not a Hamiltonian field"):
        from_module(with_coupling(0.3, 0.2), 1, y0=[1.0, e])


def test_masses_of_very_different_size():
    system = from_hamiltonian(lambda q, p: p[..., 0] ** 2 / 2 + p[..., 1] ** 2 / 2e9 + (q**4).sum(-1), 2)
    assert system.separable
    np.testing.assert_array_equal(system.vector_field(np.array([0.0, 0.0, 3.0, 3e9]))[:2], [3.0, 3.0])
    free = from_hamiltonian(lambda q, p: (p**2).sum(-1) / 6e4, 2)
    np.testing.assert_array_equal(free.vector_field(np.array([0.0, 0.0, 3e4, 6e4]))[:2], [1.0, 2.0])


def test_a_field_that_changes_late_is_not_autonomous():
    with pytest.raises(ValueError, match=r"^`module` depends on t"):
        from_module(lambda t, y: Field()(t, y) * (1.0 if t < 5 else 2.0), 2, y0=HH.y0)
