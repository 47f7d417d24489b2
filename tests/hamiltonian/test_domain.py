"""Domains: seeded uniform samples inside, and membership."""

import json
import math

import numpy as np
import pytest
from conftest import refusals
from hypothesis import given, settings
from hypothesis import strategies as st

from sympflow import Ball, Box, EnergySublevel, Tube, systems
from sympflow.hamiltonian.domain import domain_from_dict


def kinetic_plus_square(x):
    return (x**2).sum(-1) / 2


angle = np.linspace(0, 2 * np.pi, 65)
CIRCLE = np.stack([np.cos(angle), np.sin(angle)], axis=1)

DOMAINS = [
    Ball([0.5, -1.0, 0, 0], 2.0),
    Box([-1.0, -2.0], [1.0, 3.0]),
    EnergySublevel(0.5, Box([-1.0, -1.0], [1.0, 1.0]), kinetic_plus_square),
    systems.henon_heiles().domain,
    systems.pendulum().domain,
    systems.harmonic_oscillator(100).domain,
    systems.kepler().domain,
    systems.kepler(0.999).domain,
    Tube(CIRCLE, 0.1),
    Tube(np.hstack([CIRCLE, 100 * CIRCLE]), [0.1, 0.2, 30.0, 10.0], groups=[[0, 2], [1, 3]]),
]


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 300))
def test_samples_lie_inside_and_depend_on_the_seed_only(domain, seed, n):
    x = domain.sample(n, seed)
    assert x.shape[0] == n
    assert domain.contains(x).all()
    assert np.array_equal(x, domain.sample(n, seed))


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
def test_description_round_trip(domain):
    """Through JSON, in which a flow's file keeps it."""
    same = domain_from_dict(json.loads(json.dumps(domain.to_dict())))
    assert same == domain
    assert hash(same) == hash(domain)


def test_ball_samples_are_uniform_in_radius():
    radius = np.linalg.norm(Ball([0.0] * 4, 1.0).sample(20_000, 0), axis=1)
    # P(r < 1/2) = 2^-4; the binomial standard deviation is sqrt(p (1-p) / n)
    p = 0.5**4
    assert abs((radius < 0.5).mean() - p) < 5 * np.sqrt(p * (1 - p) / 20_000)


def test_henon_heiles_well_is_the_bounded_component():
    domain = systems.henon_heiles().domain
    q1, q2 = domain.sample(5000, 1)[:, :2].T
    assert (q2 > -0.5).all()
    assert (np.sqrt(3) * np.abs(q1) < 1 - q2).all()
    assert not domain.contains(np.array([0.0, 1.5, 0.0, 0.0]))  # H < 1/6 there too, but outside the well


def test_the_tube_around_a_circle_is_an_annulus():
    tube = Tube(CIRCLE, 0.1)
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.3, 1.3, (5000, 2))
    distance = abs(np.linalg.norm(x, axis=1) - 1)
    sagitta = 1 - np.cos(np.pi / 64)  # how far the broken line is from the circle
    assert tube.contains(x[distance < 0.1 - sagitta]).all()
    assert not tube.contains(x[distance > 0.1 + sagitta]).any()
    assert tube.contains(x.reshape(50, 100, 2)).shape == (50, 100)
    assert not tube.contains([np.nan, 0.0])


def test_a_tube_has_its_radius_in_each_coordinate():
    tube = Tube([[0.0, 0.0], [1.0, 0.0]], [0.5, 2.0])
    assert tube.contains([[-0.49, 0.0], [0.5, 1.99], [1.49, 0.0]]).all()
    assert not tube.contains([[-0.51, 0.0], [0.5, 2.01], [1.51, 0.0]]).any()


def test_tube_samples_are_uniform_about_the_orbit():
    """About a segment, far from its ends: uniform in the disc of the section times the segment."""
    x = Tube([[0.0, 0.0], [1000.0, 0.0]], 1.0).sample(20_000, 0)
    assert abs(x[:, 0].mean() - 500) < 5 * 1000 / math.sqrt(12 * 20_000)
    assert abs((x[:, 1] ** 2).mean() - 1 / 4) < 5 / math.sqrt(20_000)  # of a disc: E y² = 1/4


def test_energy_slack_widens_an_energy_domain():
    domain = systems.harmonic_oscillator().domain
    just_outside = np.array([1.7 * np.sqrt(1 + 1e-3), 0.0])
    assert not domain.contains(just_outside)
    assert domain.contains(just_outside, slack=2e-3 * domain.energy)
    shell = EnergySublevel(domain.energy, domain.box, domain.hamiltonian, above=0.5)
    just_below = np.array([np.sqrt(1 - 1e-3), 0.0])
    assert not shell.contains(just_below)
    assert shell.contains(just_below, slack=1e-3)


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
def test_what_are_not_states_of_the_domain_is_refused(domain):
    width = domain.sample(1).shape[-1]
    assert domain.contains(domain.sample(1)[0].tolist())
    for x in ([1, 2, 3], 0.5, np.zeros((2, width + 1))):
        with pytest.raises(ValueError, match=rf"^`x` must have shape \(\.\.\., {width}\).*last axis"):
            domain.contains(x)
    for x in ("here", None, [[1.0], [1.0, 2.0]], np.zeros(width, dtype=complex)):
        with pytest.raises(TypeError, match=r"^`x` must be states of real numbers.*pass an array"):
            domain.contains(x)


test_bad_arguments_are_named = refusals(
    (lambda: Ball([0.0, 0.0], -1), "^`radius` must be positive"),
    (lambda: Ball([0.0, np.nan], 1), "^`center` must be finite"),
    (lambda: Ball([0.0, 0.0, 0.0], 1), r"^`center` must have shape \(2d,\)"),
    (lambda: Box([0.0, 0.0], [1.0, 0.0]), "^`low` must be below `high`"),
    (lambda: Box([0.0, 0.0], [1.0] * 4), "^`high` must have the length of `low`"),
    (lambda: EnergySublevel(np.inf, Box([0.0, 0.0], [1.0, 1.0])), "^`energy` must be finite"),
    (lambda: EnergySublevel(1.0, Box([0.0, 0.0], [1.0, 1.0])).sample(1), "^`hamiltonian` is not known"),
    (lambda: Box([0.0, 0.0], [1.0, 1.0]).sample(0), "^`n` must be a positive integer"),
    (
        lambda: EnergySublevel(-1.0, Box([0.0, 0.0], [1.0, 1.0]), kinetic_plus_square).sample(1),
        "^`box` holds almost no state",
    ),
    (lambda: EnergySublevel(1.0, Box([0.0] * 4, [1.0] * 4), above=2.0), "^`above` must be below `energy`"),
    (lambda: EnergySublevel(1.0, Box([0.0, 0.0], [1.0, 1.0]), angular_momentum=(0, 1)), "^`angular_momentum` only"),
    (lambda: EnergySublevel(1.0, Box([0.0] * 4, [1.0] * 4), angular_momentum=(2, 1)), "^`angular_momentum` must be"),
    (lambda: EnergySublevel(1.0, Box([0.0] * 4, [1.0] * 4), angular_momentum=3), "^`angular_momentum` must be two"),
    (lambda: Tube([[0.0, 1.0]], 1.0), r"^`orbit` must have shape \(n, 2d\)"),
    (lambda: Tube([0.0, 1.0], 1.0), r"^`orbit` must have shape"),
    (lambda: Tube([[0.0, 1.0], [0.0, np.nan]], 1.0), "^`orbit` must be finite"),
    (lambda: Tube(CIRCLE, [1.0] * 3), "^`radius` must be a number or have shape"),
    (lambda: Tube(CIRCLE, [1.0, 0.0]), "^`radius` must be positive"),
    (lambda: Tube(CIRCLE, 1.0, groups=[[0], [0, 1]]), "^`groups` must hold each"),
    (lambda: domain_from_dict({"kind": "Tube", "orbit": "a", "radius": 1}), "^`description` is not a domain"),
    (lambda: domain_from_dict({"kind": "Torus"}), "^`description` is of an unknown kind"),
    (lambda: domain_from_dict({"kind": "Ball", "radius": 1}), "^`description` is not a domain"),
)


@pytest.mark.parametrize("system", [systems.henon_heiles(), systems.kepler(0.6), systems.fput(omega=50.0)], ids=str)
@pytest.mark.parametrize("slack", [0.0, 0.01])
def test_compiled_code_agrees_on_what_lies_in_a_sublevel(system, slack):
    from sympflow.kernels.passes import all_within

    domain = system.domain
    if isinstance(domain, Box):
        domain = EnergySublevel(2.5, domain, system.hamiltonian)
    rng = np.random.default_rng(0)
    inside = domain.sample(50, 0)
    assert all_within(system, domain, inside, slack)
    for x in (inside * 1.3, inside + 0.2 * rng.standard_normal(inside.shape), np.full((1, inside.shape[1]), np.nan)):
        expected = domain.contains(x, slack=slack)
        assert expected.tolist() == [all_within(system, domain, row[None], slack) for row in x]
        assert all_within(system, domain, x, slack) == expected.all()
    other = domain.attach(system.symbols.hamiltonian)
    assert not all_within(system, other, inside, slack)  # an H of its own, which is not compiled


def test_a_shell_is_what_its_bounds_say():
    shell = systems.kepler().domain
    q, p = np.split(shell.sample(500, 3), 2, axis=1)
    E = (p**2).sum(1) / 2 - 1 / np.linalg.norm(q, axis=1)
    L = abs(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0])
    a, e = -1 / (2 * E), np.sqrt(1 + 2 * E * L**2)
    assert 0.95 < a.min() < a.max() < 1.05
    assert 0.45 < e.min() < e.max() < 0.67
    angle = np.arctan2(q[:, 1], q[:, 0])
    assert abs(np.exp(1j * angle).mean()) < 5 / math.sqrt(2 * 500)
    assert not shell.contains([1.0, 0.0, 0.0, 1.0])  # a circle: too much angular momentum
