"""The built-in scenes: each is what its docstring says, and the truths that are known of it hold."""

import math

import numpy as np
import pytest
import torch

from sympflow import solve, systems
from sympflow.domain import domain_from_dict

# a scene as it is built, and H(y0) worked out by hand
SCENES = {
    "harmonic_oscillator": (lambda: systems.harmonic_oscillator(3.0), 4.5),
    "henon_heiles": (systems.henon_heiles, 0.45 * 0.3 - 0.027 + 0.009 + 0.5 * 0.0225 + 0.0),
    "pendulum": (systems.pendulum, 1 - math.cos(1.5)),
    "kepler": (systems.kepler, -0.5),
    "kepler 0.999": (lambda: systems.kepler(0.999), -0.5),
    "quartic": (systems.quartic, 0.419025),
    "fput": (systems.fput, 2.00120008),
    "fput 1000": (lambda: systems.fput(1000.0), 1.5 + (0.999**4 + 1.001**4) / 4),
    "fput m = 1": (lambda: systems.fput(50.0, 1), 1.5 + (0.98**4 + 1.02**4) / 4),
    "spring pendulum": (systems.spring_pendulum, -math.cos(1) * (1 + math.cos(1) / 200)),
    "spring pendulum, polar": (
        lambda: systems.spring_pendulum(1e6, "polar", 0.5),
        0.5 - math.cos(1) * (1 + math.cos(1) / 2e6),
    ),
}


@pytest.mark.parametrize("scene", SCENES)
def test_the_energy_of_the_initial_state_is_the_stated_one(scene):
    make, energy = SCENES[scene]
    system = make()
    assert system.hamiltonian(system.y0) == pytest.approx(energy, rel=1e-13)


@pytest.mark.parametrize("scene", SCENES)
def test_derivatives_are_those_of_H(scene):
    """By automatic differentiation where H runs on tensors."""
    system = SCENES[scene][0]()
    y = torch.tensor(np.vstack([system.y0, system.domain.sample(3, 0)]))
    gradient = torch.func.vmap(torch.func.grad(system.hamiltonian))(y)
    hessian = torch.func.vmap(torch.func.hessian(system.hamiltonian))(y)
    for array in (y, y.numpy()):
        np.testing.assert_allclose(system.gradient(array), gradient, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(system.hessian(array), hessian, rtol=1e-10, atol=1e-10 * float(abs(hessian).max()))


@pytest.mark.parametrize("scene", SCENES)
def test_the_scene_starts_inside_its_domain_and_can_be_described(scene):
    system = SCENES[scene][0]()
    assert system.domain.contains(system.y0)
    same = domain_from_dict(system.domain.to_dict())
    assert same == system.domain
    assert system.t_span[1] > system.t_span[0]


@pytest.mark.parametrize("scene", sorted(SCENES.keys() - {"kepler 0.999", "spring pendulum, polar"}))
def test_the_default_step_is_sensible(scene):
    """A method of order 8 at the default step keeps the energy to 1e-9 for 500 steps.

    Not for a close encounter, which takes a transformation of time, nor where no splitting method applies.
    """
    system = SCENES[scene][0]()
    sol = solve(system, "kahan_li8", (0, 500 * system.dt), backend="array", save_every=50)
    assert sol.energy_error().max() < 1e-9


def test_kepler_comes_back_after_every_period():
    for e in (0.0, 0.3, 0.6):
        system = systems.kepler(e)
        sol = solve(system, "dop853", (0, 20 * math.pi), rtol=1e-12, atol=1e-13, t_eval=np.arange(11) * 2 * math.pi)
        # an error in the energy is one in the period: it grows with t
        np.testing.assert_allclose(sol.y.T, np.tile(system.y0, (11, 1)), atol=1e-8)


@pytest.mark.parametrize("e", [0.2, 0.6, 0.95])
def test_the_kepler_ellipse_is_the_orbit(e):
    """J∇H along it is dy/dE ÷ dt/dE, t = E − e sin E; angular momentum √(1 − e²)."""
    system, E = systems.kepler(e), np.linspace(0.1, 6, 7)
    y = systems.kepler_ellipse(e, E)
    step = 1e-6
    dy = (systems.kepler_ellipse(e, E + step) - systems.kepler_ellipse(e, E - step)) / (2 * step)
    field = system.vector_field(y)
    np.testing.assert_allclose(dy / (1 - e * np.cos(E))[:, None], field, rtol=1e-6, atol=1e-6 * abs(field).max())
    np.testing.assert_allclose(y[:, 0] * y[:, 3] - y[:, 1] * y[:, 2], math.sqrt(1 - e * e), rtol=1e-12)
    np.testing.assert_allclose(systems.kepler_ellipse(e, np.array(0.0)), system.y0, atol=1e-12)


def test_fput_exchanges_energy_among_the_stiff_springs_and_keeps_its_sum():
    """Hairer, Lubich, Wanner, figure I.5.2: I₂ rises to about one half while I stays near 1."""
    system = systems.fput()
    sol = solve(system, "kahan_li8", dt=0.004, save_every=25)
    stiff = systems.oscillatory_energies(system, sol.states)
    assert stiff.shape == (len(sol.t), 3)
    assert abs(stiff.sum(-1) - 1).max() == pytest.approx(0.065, abs=0.003)
    assert stiff[:, 1].max() == pytest.approx(0.519, abs=0.01)
    assert sol.energy_error().max() < 1e-9
    assert system.domain.contains(sol.states).all()
    with pytest.raises(ValueError, match=r"^`system` must be fput"):
        systems.oscillatory_energies(systems.quartic(), np.zeros(4))


@pytest.mark.parametrize("k", [1e2, 1e6])
def test_the_spring_pendulum_is_the_same_in_both_coordinates(k):
    for radial_energy in (0.0, 0.5):
        cartesian, polar = (systems.spring_pendulum(k, c, radial_energy) for c in ("cartesian", "polar"))
        r, angle, p_r, p_angle = polar.y0
        unit, across = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        np.testing.assert_allclose(cartesian.y0, np.r_[r * unit, p_r * unit + p_angle / r * across], rtol=1e-14)
        span = (0.0, 20 / math.sqrt(k))
        ends = [solve(s, "dop853", span, rtol=1e-12, atol=1e-13).y[:, -1] for s in (cartesian, polar)]
        r, angle, p_r, p_angle = ends[1]
        unit, across = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        np.testing.assert_allclose(ends[0], np.r_[r * unit, p_r * unit + p_angle / r * across], atol=1e-9)


def test_the_spring_pendulum_starts_on_its_slow_manifold():
    """Without radial energy the spring oscillates with O(1/k³) of energy about its balance; with it, with that."""
    k = 1e4
    fast_energy = {}
    for radial_energy in (0.0, 0.5):
        system = systems.spring_pendulum(k, "polar", radial_energy)
        sol = solve(system, "dop853", (0, 1), rtol=1e-11, atol=1e-12)
        r, angle, p_r, p_angle = sol.y
        balance = 1 + (np.cos(angle) + p_angle**2 / r**3) / k
        fast_energy[radial_energy] = (p_r**2 + k * (r - balance) ** 2) / 2
    assert fast_energy[0.0].max() < 10 / k**2  # p_r of the slow motion itself is O(1/k)
    np.testing.assert_allclose(fast_energy[0.5], 0.5, rtol=0.05)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: systems.kepler(1.0), "^`e` must be an eccentricity"),
        (lambda: systems.kepler(-0.1), "^`e` must be"),
        (lambda: systems.kepler("0.6"), "^`e` must be"),
        (lambda: systems.fput(0), "^`omega` must be positive"),
        (lambda: systems.fput(m=0), "^`m` must be a positive integer"),
        (lambda: systems.fput(m=1.5), "^`m` must be a positive integer"),
        (lambda: systems.spring_pendulum(math.inf), "^`k` must be positive"),
        (lambda: systems.spring_pendulum(coordinates="spherical"), "^`coordinates` must be"),
        (lambda: systems.spring_pendulum(radial_energy=-1), "^`radial_energy` must be"),
    ],
)
def test_bad_parameters_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
