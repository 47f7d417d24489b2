"""Domains that are too large for a flow: which part spoils them, and a smaller one that works."""

import re
import warnings

import numpy as np
import pytest

from sympflow import Box, EnergySublevel, HamiltonianSystem, systems, train
from sympflow.training.points import Labels
from sympflow.training.session import OutOfTime, Session
from sympflow.training.starts import frequency, warn_of_domain

MORSE = "p**2/2 + (1 - exp(-q))**2"


def warned(H, low, high):
    """The system of a box, the warning of it, and the box that is named in its place."""
    system = HamiltonianSystem.from_sympy(H, domain=Box(low, high))
    with pytest.warns(UserWarning, match="`domain`") as found:
        warn_of_domain(system, system.domain)
    corners = re.findall(r"\[([^]]+)\]", str(found[0].message))
    return system, str(found[0].message), [[float(x) for x in corner.split(",")] for corner in corners[:2]]


@pytest.mark.parametrize("low", [-20.0, -8.0])
def test_the_wall_of_a_morse_bond_is_left_out(low):
    """The rate is e^(−q) on the wall: in the box that is named it differs by far less, and nothing is said of it."""
    system, _, (lower, upper) = warned(MORSE, [low, -1.0], [3.0, 1.0])
    assert lower[0] > low / 2
    smaller = Box(lower, upper)
    assert frequency(system, smaller) < 1e-2 * frequency(system, system.domain)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_domain(system, smaller)


def test_a_half_without_a_finite_energy_is_left_out():
    _, message, (lower, upper) = warned("p**2/2 + q - log(q)", [-1.0, -1.0], [1.0, 1.0])
    assert "is not finite at 175 of 400 states" in message
    assert 0 <= lower[0] < 0.05
    assert upper[0] > 0.9


@pytest.mark.parametrize("make", [systems.henon_heiles, systems.pendulum, systems.quartic, systems.kepler])
def test_nothing_is_said_of_domains_that_suit(make):
    system = make()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_domain(system, system.domain)
    assert not said


def test_labels_that_are_late_name_the_part_of_the_domain_that_is_fast():
    system = HamiltonianSystem.from_sympy("p**2/2 - q**4/4", domain=Box([-4, -4], [4, 4]))
    x = system.domain.sample(250, 0)
    with pytest.raises(OutOfTime, match=r"from 250 states .*of 0\.5 only; at .* none of these is in Box") as late:
        Labels.of(system, x, np.array([0.5]), Session(time_budget=1e-9).deadline)
    lower, _ = re.findall(r"\[([^]]+)\]", str(late.value))
    assert -3.0 < float(lower.split(",")[0]) < -2.0


def test_a_wall_that_orbits_come_to_is_no_part_to_leave_out():
    """A ball falls on exp(−20 q): where it falls freely nothing oscillates, but it comes back to the wall."""
    system = HamiltonianSystem.from_sympy("p**2/2 + exp(-20*q) + q", domain=Box([-0.3, -2], [3, 2]))
    with pytest.warns(UserWarning, match="no smaller box holds them") as found:
        warn_of_domain(system, system.domain)
    dt, energy, low, high = re.search(
        r": (\S+) in EnergySublevel\((\S+), Box\(\[(.+)\], \[(.+)\]\)\)", str(found[0].message)
    ).groups()
    corners = [[float(x) for x in corner.split(",")] for corner in (low, high)]
    smaller = EnergySublevel(float(energy), Box(*corners), hamiltonian=system.hamiltonian)
    assert 1.0 / frequency(system, smaller) == pytest.approx(float(dt), rel=0.2)
    assert 2 * frequency(system, smaller) < frequency(system, system.domain)


def test_states_whose_solutions_end_before_a_step_are_counted():
    """Most orbits of H = p²/2 − q⁴/4 escape to infinity in a finite time; the others lie about the origin."""
    system = HamiltonianSystem.from_sympy("p**2/2 - q**4/4", domain=Box([-1.6, -0.3], [1.6, 0.3]))
    options = {"restarts": 2, "steps": 20, "points": 60, "reference_states": 50, "label_times": 2, "progress": False}
    with pytest.warns(UserWarning, match=r"From \d+ of 50 held-out states|no solution exists up to") as found:
        train(system, 1.2, **options)
    (lower, upper) = (
        [float(x) for x in corner.split(",")] for corner in re.findall(r"\[([^]]+)\]", str(found[0].message))[:2]
    )
    assert np.max(np.abs([lower[0], upper[0]])) < 1.6
