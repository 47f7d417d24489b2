"""The built-in scenes: each is what its docstring says, and the truths that are known of it hold."""

import math

import numpy as np
import pytest
import torch
from conftest import refusals

from sympflow import max_energy_error, solve, systems
from sympflow.hamiltonian.domain import domain_from_dict

# a scene as it is built, and H(y0) worked out by hand
SCENES = {
    "harmonic_oscillator": (lambda: systems.harmonic_oscillator(3.0), 4.5),
    "henon_heiles": (systems.henon_heiles, 0.45 * 0.3 - 0.027 + 0.009 + 0.5 * 0.0225 + 0.0),
    "pendulum": (systems.pendulum, 1 - math.cos(1.5)),
    "henon_heiles_escape": (systems.henon_heiles_escape, 0.245),
    "pendulum_separatrix": (systems.pendulum_separatrix, 2.0),
    "double_well": (systems.double_well, 0.25),
    "double_well below": (lambda: systems.double_well(0.1), 0.1),
    "three_body": (systems.three_body, -769 / 60),
    "toda_lattice": (systems.toda_lattice, 0.75),
    "toda_lattice 2": (lambda: systems.toda_lattice(2), 1.0),
    "toda_lattice 5": (lambda: systems.toda_lattice(5), 0.625),
    "nonseparable": (systems.nonseparable, 5.0),
    "kepler": (systems.kepler, -0.5),
    "kepler 0.999": (lambda: systems.kepler(0.999), -0.5),
    "quartic": (systems.quartic, 0.419025),
    "fput": (systems.fput, 2.00120008),
    "fput 1000": (lambda: systems.fput(1000.0), 1.5 + (0.999**4 + 1.001**4) / 4),
    "fput m = 1": (lambda: systems.fput(50.0, 1), 1.5 + (0.98**4 + 1.02**4) / 4),
    "double_pendulum": (systems.double_pendulum, -2 * math.cos(0.6) - math.cos(0.8)),
    "schwarzschild": (systems.schwarzschild, -0.5),
    "schwarzschild far out": (lambda: systems.schwarzschild(1e6, 0.95), -0.5),
    "schwarzschild, circular": (lambda: systems.schwarzschild(6.5, 0), -0.5),
    "charged_particle": (systems.charged_particle, 0.625),
    "charged_particle 5": (lambda: systems.charged_particle(5.0), 0.625),
    "spring pendulum": (systems.spring_pendulum, -math.cos(1) * (1 + math.cos(1) / 200)),
    "spring pendulum, polar": (
        lambda: systems.spring_pendulum(1e6, "polar", 0.5),
        0.5 - math.cos(1) * (1 + math.cos(1) / 2e6),
    ),
}

PAIR_SCENES = {"outer_solar_system": systems.outer_solar_system, "lennard_jones": systems.lennard_jones}
ALL = {**{name: make for name, (make, _) in SCENES.items()}, **PAIR_SCENES}


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


@pytest.mark.parametrize("scene", PAIR_SCENES)
def test_derivatives_of_sums_over_pairs_are_those_of_H(scene):
    """By central differences, of the potential and of its gradient."""
    system = PAIR_SCENES[scene]()
    q, d = system.y0[: system.ndof], system.ndof
    step = 1e-4 * np.abs(q).max() * np.eye(d)
    slope = (system.potential(q + step) - system.potential(q - step)) / (2 * step.diagonal())
    np.testing.assert_allclose(system.force(q), -slope, rtol=1e-5, atol=1e-6 * abs(slope).max())
    hessian = (system.force(q - step) - system.force(q + step)) / (2 * step.diagonal()[:, None])
    given = system.potential_hessian(q)
    np.testing.assert_allclose(given, hessian, rtol=1e-4, atol=1e-5 * abs(hessian).max())
    np.testing.assert_allclose(given, given.T, atol=1e-14 * abs(given).max())
    np.testing.assert_allclose(system.hessian_vector(q, q), given @ q, rtol=1e-9, atol=1e-14 * abs(given).max())


@pytest.mark.parametrize("scene", ALL)
def test_the_scene_can_be_described_and_starts_inside_its_domain(scene):
    system = ALL[scene]()
    assert bool(system.domain.contains(system.y0)) is (scene != "henon_heiles_escape")  # which is above its energy
    same = domain_from_dict(system.domain.to_dict())
    assert same == system.domain
    assert system.t_span[1] > system.t_span[0]


@pytest.mark.parametrize("scene", sorted({*SCENES} - {"kepler 0.999", "spring pendulum, polar", "henon_heiles_escape"}))
def test_the_default_step_is_sensible(scene):
    """A method of order 8 at the default step keeps the energy to 1e-9 for 200 steps.

    Not for a close encounter, which takes a transformation of time, nor for a solution that ends in finite time. Far
    out, where r is 1e9 times p, the coupling of Tao's two copies adds up what differs in units.
    """
    system = SCENES[scene][0]()
    method = "kahan_li8" if system.separable else "gauss_legendre8" if scene.endswith("far out") else "tao8"
    sol = solve(system, method, (0, 200 * system.dt), backend="array", save_every=20)
    assert max_energy_error(sol) < 1e-9


def test_kepler_comes_back_after_every_period():
    for e in (0.0, 0.3, 0.6):
        system = systems.kepler(e)
        sol = solve(system, "dop853", (0, 20 * math.pi), rtol=1e-12, atol=1e-13, t_eval=np.arange(11) * 2 * math.pi)
        # an error in the energy is one in the period: it grows with t
        np.testing.assert_allclose(sol.y.T, np.tile(system.y0, (11, 1)), atol=1e-8)


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


@pytest.mark.parametrize("amplitude", [0.5, 3.0])
def test_the_nonseparable_system_is_solved_by_elliptic_functions(amplitude):
    from scipy.special import ellipj, ellipk

    system = systems.nonseparable(amplitude)
    rate, m = math.sqrt(1 + amplitude**2), amplitude**2 / (1 + amplitude**2)
    t = np.linspace(0, 4 * ellipk(m) / rate, 41)
    sol = solve(system, "dop853", (0, t[-1]), t_eval=t, rtol=1e-13, atol=1e-14)
    sn, cn, dn, _ = ellipj(rate * t, m)
    q = -amplitude * cn
    np.testing.assert_allclose(sol.y, [q, amplitude * rate * sn * dn / (1 + q**2)], atol=1e-10 * amplitude)
    assert system.domain.contains(sol.states).all()


test_bad_parameters_are_named = refusals(
    (lambda: systems.schwarzschild(6.9, 0.5), r"^`semilatus` must be above 6 \+ 2e = 7"),
    (lambda: systems.schwarzschild(math.nan), "^`semilatus` must be"),
    (lambda: systems.schwarzschild(12, 1.0), "^`e` must be an eccentricity"),
    (lambda: systems.perihelion_angle(12, "0.5"), "^`e` must be"),
    (lambda: systems.charged_particle(4), "^`field` must be positive"),
    (lambda: systems.charged_particle(101), "^`field` must be"),
    (lambda: systems.kepler(1.0), "^`e` must be an eccentricity"),
    (lambda: systems.kepler(-0.1), "^`e` must be"),
    (lambda: systems.kepler("0.6"), "^`e` must be"),
    (lambda: systems.henon_heiles_escape(0), "^`energy` must be positive"),
    (lambda: systems.double_well(math.nan), "^`energy` must be positive"),
    (lambda: systems.pendulum_separatrix(-1), "^`energy` must be positive"),
    (lambda: systems.toda_lattice(1), "^`n` must be an integer"),
    (lambda: systems.toda_lattice("3"), "^`n` must be an integer"),
    (lambda: systems.nonseparable(0), "^`amplitude` must be positive"),
    (lambda: systems.fput(0), "^`omega` must be positive"),
    (lambda: systems.fput(m=0), "^`m` must be a positive integer"),
    (lambda: systems.fput(m=1.5), "^`m` must be a positive integer"),
    (lambda: systems.fput(m=10**6), "^`m` must be a positive integer, at most 50"),
    (lambda: systems.fput(m="3"), "^`m` must be a positive integer"),
    (lambda: systems.fput(m=math.nan), "^`m` must be a positive integer"),
    (lambda: systems.toda_lattice(10**6), "^`n` must be an integer from 2 to 100"),
    (lambda: systems.toda_lattice(math.inf), "^`n` must be an integer"),
    (lambda: systems.spring_pendulum(1e-300), "^`k` must be positive, a stiffness from 1e-6"),
    (lambda: systems.spring_pendulum(math.inf), "^`k` must be positive"),
    (lambda: systems.spring_pendulum(coordinates="spherical"), "^`coordinates` must be"),
    (lambda: systems.spring_pendulum(radial_energy=-1), "^`radial_energy` must be"),
)


@pytest.mark.parametrize("n", [2, 3, 5])
def test_the_toda_lattice_keeps_the_eigenvalues_of_laxs_matrix(n):
    system = systems.toda_lattice(n)
    sol = solve(system, "kahan_li8", (0, 50), backend="compiled" if n == 2 else "array")
    eigenvalues = systems.lax_eigenvalues(sol.states)
    assert np.ptp(sol.y[:n], axis=1).min() > 0.5  # it moves
    np.testing.assert_allclose(eigenvalues, np.broadcast_to(eigenvalues[0], eigenvalues.shape), atol=1e-11)
    np.testing.assert_allclose(eigenvalues.sum(-1), 0, atol=1e-12)
    if n > 2:
        np.testing.assert_allclose((eigenvalues**2).sum(-1), (system.hamiltonian(system.y0) + n) / 2, rtol=1e-11)
    assert system.domain.contains(sol.states).all()


def test_a_charged_particle_gyrates_and_is_reflected():
    """Frequency B in the plane q₃ = 0, the speed's along the axis; the moment is an adiabatic invariant."""
    system = systems.charged_particle()
    B, v = 10.0, 1.0
    t = np.linspace(0, 2, 9)
    start = system.y0 * [1, 1, 1, 1, 1, 0]
    flat = solve(system, "dop853", (0, 2), start, t_eval=t, rtol=1e-12, atol=1e-13).y
    np.testing.assert_allclose(flat[:2], [0.6 - 0.1 * np.cos(B * t), 0.1 * np.sin(B * t)], atol=1e-10)

    circle = np.array([v / B, 0, 0, 0, -v / 2, 1e-4])  # v₂ = p₂ − Bq₁/2 = −v: clockwise about the axis
    near = solve(system, "dop853", (0, 2), circle, t_eval=t, rtol=1e-12, atol=1e-15).y
    np.testing.assert_allclose(near[2], 1e-4 / v * np.sin(v * t), atol=1e-10)

    sol = solve(system, "dop853", (0, 20), rtol=1e-11, atol=1e-12)
    moments = systems.magnetic_moment(system, sol.states)
    assert moments[0] == pytest.approx(1 / (2 * B))
    assert np.ptp(moments) < 0.06 * moments[0]
    assert sol.y[2].max() == pytest.approx(0.5, abs=0.1)  # μB(1 + q₃²) is the whole energy
    np.testing.assert_allclose(sol.y[0] * sol.y[4] - sol.y[1] * sol.y[3], 0.5 * 3.5, rtol=1e-9)
    assert system.domain.contains(sol.states).all()
    with pytest.raises(ValueError, match=r"^`system` must be charged_particle"):
        systems.magnetic_moment(systems.quartic(), np.zeros(4))
