"""The built-in scenes: each is what its docstring says, and the truths that are known of it hold."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import refusals

from sympflow import max_energy_error, solve, systems
from sympflow.hamiltonian.domain import domain_from_dict
from sympflow.systems import SYSTEMS, celestial, chains

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


def test_on_the_separatrix_of_the_double_well():
    system = systems.double_well()
    t = np.linspace(0, 8, 33)
    sol = solve(system, "dop853", (0, 8), t_eval=t, rtol=1e-13, atol=1e-14)
    exact = math.sqrt(2) / np.cosh(t) * np.array([np.ones(33), -np.tanh(t)])
    np.testing.assert_allclose(sol.y, exact, atol=1e-14 * math.exp(8) * 10)  # errors grow with exp(t)
    right = solve(systems.double_well(0.2), "verlet", (0, 50), backend="array")
    assert right.y[0].min() > 0


def test_on_the_separatrix_of_the_pendulum():
    t = np.linspace(0, 8, 33)
    sol = solve(systems.pendulum_separatrix(), "dop853", (0, 8), t_eval=t, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(sol.y, [4 * np.arctan(np.exp(t)) - np.pi, 2 / np.cosh(t)], atol=1e-13 * math.exp(8))
    below, above = (solve(systems.pendulum_separatrix(E), "kahan_li8", (0, 50)).y[0] for E in (1.99, 2.01))
    assert abs(below).max() < math.pi
    assert above[-1] > 4 * math.pi


def test_henon_heiles_ends_in_finite_time_above_the_escape_energy():
    from scipy.integrate import quad

    p, E = 0.7, 0.245
    # q = tan²(s) maps [0, π/2) to [0, ∞) and makes the integrand smooth
    t_star, _ = quad(
        lambda s: 2 * math.tan(s) / math.cos(s) ** 2 / math.sqrt(2 * E - math.tan(s) ** 4 + 2 * math.tan(s) ** 6 / 3),
        0,
        math.pi / 2 - 1e-9,
        epsabs=1e-13,
        epsrel=1e-13,
        limit=200,
    )
    assert t_star == pytest.approx(5.450984210235402, abs=1e-8)
    system = systems.henon_heiles_escape(E)
    np.testing.assert_array_equal(system.y0, [0, 0, 0, p])
    sol = solve(system, "dop853", (0, t_star - 0.01), rtol=1e-13, atol=1e-13)
    assert sol.y[1, -1] == pytest.approx(6 / 0.01**2, rel=1e-3)
    beyond = solve(system, "dop853", (0, 10), rtol=1e-12, atol=1e-12)
    assert beyond.status == -1
    assert beyond.t[-1] == pytest.approx(t_star, abs=1e-6)


def test_henon_heiles_stays_in_the_well_below_the_escape_energy():
    system = systems.henon_heiles_escape(0.16567)
    sol = solve(system, "kahan_li8", (0, 1000), dt=0.1)
    assert system.domain.contains(sol.states, slack=1e-9).all()


def test_the_toda_lattice_of_three_is_henon_heiles_to_third_order():
    """With differences (2q₂ + 2√3q₁, 2q₂ − 2√3q₁, −4q₂) of neighbours, V/24 is the potential of Hénon and Heiles."""
    toda, hh = systems.toda_lattice(3), systems.henon_heiles()
    x = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    worst = []
    for size in (2e-2, 1e-2):
        q1, q2 = size * x.T
        second = 2 * q2 - 2 * math.sqrt(3) * q1  # with the third particle at 0
        particles = np.stack([second + 2 * q2 + 2 * math.sqrt(3) * q1, second, 0 * q1], axis=-1)
        worst.append(abs(toda.potential(particles) / 24 - hh.potential(size * x)).max())
    assert worst[0] / worst[1] == pytest.approx(16, rel=0.2)  # what is left is of fourth order


def test_the_pythagorean_bodies_meet_as_they_should():
    """The closest approach, at t = 15.8299."""
    sol = solve(systems.three_body(), "dop853", (0, 16), rtol=1e-13, atol=1e-14)
    bodies = sol.states[:, :6].reshape(-1, 3, 2)
    distances = [np.linalg.norm(bodies[:, i] - bodies[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2))]
    distance = np.min(distances, axis=0)
    assert distance.min() == pytest.approx(4.14e-4, rel=0.01)
    assert sol.t[distance.argmin()] == pytest.approx(15.8299, abs=2e-4)


PLANETS, ARGON = systems.outer_solar_system(), systems.lennard_jones()  # what is compiled belongs to the system


def test_bodies_keep_their_momenta():
    for system, dimension, mass in (
        (systems.three_body(), 2, np.array([3.0, 4, 5])),
        (PLANETS, 3, celestial.PLANET_MASSES),
        (ARGON, 2, np.full(7, chains.MASS)),
    ):
        backend = "array" if system.symbols else "compiled"
        sol = solve(system, "kahan_li8", (0, 400 * system.dt), save_every=20, backend=backend)
        q, p = (x.reshape(len(sol.t), -1, dimension) for x in np.split(sol.states, 2, axis=-1))
        scale = abs(p).max()
        np.testing.assert_allclose(p.sum(1), p[:1].sum(1) + np.zeros((len(sol.t), 1)), atol=1e-12 * scale)
        assert abs(p[0].sum(0)).max() < 1e-14 * scale
        angular = np.cross(q, p).sum(1) if dimension == 3 else (q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]).sum(1)
        np.testing.assert_allclose(angular, angular[:1] + np.zeros_like(angular), atol=1e-11 * scale * abs(q).max())
        np.testing.assert_allclose(system.velocity(p.reshape(len(p), -1)), (p / mass[:, None]).reshape(len(p), -1))


def test_the_outer_solar_system_is_that_of_the_book():
    system = systems.outer_solar_system()
    m, G = celestial.PLANET_MASSES, celestial.G
    q, p = (x.reshape(6, 3) for x in np.split(system.y0, 2))
    v = p / m[:, None]
    np.testing.assert_allclose(q - q[0], celestial.POSITIONS, atol=1e-14)
    np.testing.assert_allclose(v - v[0], celestial.VELOCITIES, atol=1e-17)
    # osculating elements about the Sun: semi-major axes in AU, periods in days
    r, speed2 = np.linalg.norm(q[1:] - q[0], axis=1), ((v[1:] - v[0]) ** 2).sum(1)
    mu = G * (m[0] + m[1:])
    a = 1 / (2 / r - speed2 / mu)
    period = 2 * math.pi * np.sqrt(a**3 / mu)
    np.testing.assert_allclose(a, [5.20, 9.58, 19.2, 30.1, 39.5], rtol=0.02)
    assert period[0] == pytest.approx(4332, rel=2e-3)
    # Kepler's third law with the year: k = 0.01720209895, G = k² in solar masses
    assert math.sqrt(G) == pytest.approx(0.01720209895, rel=1e-9)


def test_jupiter_returns_after_4332_days():
    """Its mean period over 16 revolutions, from the angle swept in the plane of its orbit."""
    system = PLANETS
    sol = solve(system, "kahan_li8", (0, 16 * 4332.0), dt=50.0)
    assert max_energy_error(sol) < 1e-13
    assert sol.stats["backend"] == "compiled"
    q = (sol.states[:, 3:6] - sol.states[:, :3]).T
    pole = np.cross(q[:, 0], q[:, 20])
    pole /= np.linalg.norm(pole)
    x = q[:, 0] / np.linalg.norm(q[:, 0])
    angle = np.unwrap(np.arctan2(np.cross(pole, x) @ q, x @ q))
    assert 2 * math.pi * sol.t[-1] / angle[-1] == pytest.approx(4332, rel=2e-3)
    assert system.domain.contains(sol.states).all()


def test_small_oscillations_of_the_double_pendulum():
    """Their frequencies √(2 ± √2), and the second angle ∓√2 times the first."""
    system = systems.double_pendulum()
    J = np.kron([[0, 1], [-1, 0]], np.eye(2))
    rates, modes = np.linalg.eig(J @ system.hessian(np.zeros(4)))
    order = np.argsort(rates.imag)[2:]
    np.testing.assert_allclose(rates.imag[order], [math.sqrt(2 - math.sqrt(2)), math.sqrt(2 + math.sqrt(2))])
    np.testing.assert_allclose(modes[1, order] / modes[0, order], [math.sqrt(2), -math.sqrt(2)], atol=1e-12)
    assert system.hamiltonian(np.zeros(4)) == -3


@pytest.mark.parametrize(("semilatus", "e"), [(12.0, 0.5), (7.5, 0.7), (1000.0, 0.2)])
def test_the_perihelion_of_the_schwarzschild_orbit_advances(semilatus, e):
    """By the elliptic integral of its own quadrature, dφ/dχ = √(ℓ/(ℓ − 6 − 2e cos χ)); far out by 6π/ℓ."""
    from scipy.integrate import quad

    angle = systems.perihelion_angle(semilatus, e)
    quadrature, _ = quad(
        lambda x: math.sqrt(semilatus / (semilatus - 6 - 2 * e * math.cos(x))), 0, 2 * math.pi, epsabs=1e-13
    )
    assert angle == pytest.approx(quadrature, rel=1e-12)
    if semilatus == 1000:
        assert angle - 2 * math.pi == pytest.approx(6 * math.pi / semilatus, rel=0.02)
    system = systems.schwarzschild(semilatus, e)
    sol = solve(system, "dop853", (0, system.t_span[1] / 5), events=lambda t, y: y[2], rtol=1e-12, atol=1e-12)
    r, phi = sol.y_events[0][:, :2].T  # p_r = 0 at either end of the orbit, from the first perihelion on
    np.testing.assert_allclose(r[:4], np.array([1 / (1 + e), 1 / (1 - e)] * 2)[:4] * semilatus, rtol=1e-8)
    np.testing.assert_allclose(np.diff(phi[:4]), angle / 2, rtol=1e-8)
    assert system.domain.contains(sol.states, slack=1e-9).all()


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_scene_is_documented(name):
    docs = Path(__file__).parents[2] / "docs"
    assert f"| `{name}` |" in (docs / "systems.md").read_text(encoding="utf-8")
    assert f"::: sympflow.systems.{SYSTEMS[name].__name__}\n" in (docs / "reference" / "systems.md").read_text(
        encoding="utf-8"
    )


def test_the_argon_crystal_is_that_of_the_book():
    system = ARGON
    assert system.hamiltonian(system.y0) == pytest.approx(-1260.2, abs=0.05)
    sol = solve(system, "verlet", (0, 0.02))
    assert max_energy_error(sol) * 1260.2 < 10  # figure I.4.1 of the book: a few kelvin
    assert sol.stats["backend"] == "compiled"


def test_fput_exchanges_energy_among_the_stiff_springs_and_keeps_its_sum():
    """Hairer, Lubich, Wanner, figure I.5.2: I₂ rises to about one half while I stays near 1."""
    system = systems.fput()
    sol = solve(system, "kahan_li8", dt=0.004, save_every=25)
    stiff = systems.oscillatory_energies(system, sol.states)
    assert stiff.shape == (len(sol.t), 3)
    assert abs(stiff.sum(-1) - 1).max() == pytest.approx(0.065, abs=0.003)
    assert stiff[:, 1].max() == pytest.approx(0.519, abs=0.01)
    assert max_energy_error(sol) < 1e-9
    assert system.domain.contains(sol.states).all()
    with pytest.raises(ValueError, match=r"^`system` must be fput"):
        systems.oscillatory_energies(systems.quartic(), np.zeros(4))
