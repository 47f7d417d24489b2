"""Domains: seeded uniform samples inside, and membership."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sympflow import Ball, Box, EnergySublevel, systems
from sympflow.domain import domain_from_dict


def kinetic_plus_square(x):
    return (x**2).sum(-1) / 2


DOMAINS = [
    Ball([0.5, -1.0, 0, 0], 2.0),
    Box([-1.0, -2.0], [1.0, 3.0]),
    EnergySublevel(0.5, Box([-1.0, -1.0], [1.0, 1.0]), kinetic_plus_square),
    systems.henon_heiles().domain,
    systems.pendulum().domain,
    systems.harmonic_oscillator(100).domain,
]


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 300))
def test_samples_lie_inside_and_depend_on_the_seed_only(domain, seed, n):
    x = domain.sample(n, seed)
    assert x.shape[0] == n
    assert domain.contains(x).all()
    assert np.array_equal(x, domain.sample(n, seed))


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
def test_description_round_trip(domain):
    assert domain_from_dict(domain.to_dict()) == domain


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


def test_energy_slack_widens_an_energy_domain():
    domain = systems.harmonic_oscillator().domain
    just_outside = np.array([1.7 * np.sqrt(1 + 1e-3), 0.0])
    assert not domain.contains(just_outside)
    assert domain.contains(just_outside, slack=2e-3 * domain.energy)


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


@pytest.mark.parametrize(
    ("make", "message"),
    [
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
        (lambda: domain_from_dict({"kind": "Torus"}), "^`description` is of an unknown kind"),
        (lambda: domain_from_dict({"kind": "Ball", "radius": 1}), "^`description` is not a domain"),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
