"""Frequencies of orbits, against those that are known; times of escapes."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipk

import sympflow
from sympflow.metrics.frequencies import lines
from sympflow.systems import harmonic_oscillator, henon_heiles_escape, pendulum


def test_lines_of_a_quasi_periodic_signal():
    t = np.arange(4096) * 0.1
    z = 2 * np.exp(1j * t) + 0.5j * np.exp(-1j * np.sqrt(2) * t) + 1e-3 * np.exp(0.3j * t)
    omega, amplitude = lines(z[None, None], t, 4)
    np.testing.assert_allclose(omega[0, 0, :3], [1, -np.sqrt(2), 0.3], atol=1e-10)
    np.testing.assert_allclose(amplitude[0, 0, :3], [2, 0.5j, 1e-3], atol=1e-8)
    assert abs(amplitude[0, 0, 3]) < 1e-7 or np.isnan(omega[0, 0, 3])


def test_the_frequency_of_a_pendulum_is_that_of_the_elliptic_integral():
    y0 = [[2.0, 0.0], [0.5, 0.0]]
    found = sympflow.frequencies(pendulum(), "kahan_li8", (0, 500), y0, dt=0.1, n=3, signal=lambda y: y[:, 0])
    exact = np.pi / 2 / ellipk(np.sin(np.array([1.0, 0.25])) ** 2)
    np.testing.assert_allclose(np.abs(found.frequencies[:, 0, 0]), exact, atol=1e-10)
    assert found.frequencies.shape == (2, 1, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n": 0}, "`n` must be a positive integer"),
        ({"samples": 3}, "samples, and lines need"),
        ({"signal": lambda y: y[:, 0, :5]}, "`signal` must return shape"),
    ],
)
def test_bad_arguments_of_frequencies(arguments, message):
    with pytest.raises(ValueError, match=message):
        sympflow.frequencies(pendulum(), "verlet", (0, 10), **arguments)


def test_an_orbit_escapes_when_it_is_known_to():
    system = henon_heiles_escape()
    exact = quad(lambda q: 1 / np.sqrt(2 * 0.245 - q * q + 2 * q**3 / 3), 0, 10)[0]
    y0 = [system.y0, [0.0, 0.1, 0.0, 0.0], [0.0, 20.0, 0.0, 0.0]]
    for outside in (10.0, lambda y: y[..., 1] > 10):
        found = sympflow.escape_times(system, "kahan_li8", (0, 8), y0, outside=outside, dt=0.01)
        assert found.status.tolist() == [1, 0, 1]
        assert found.time[0] == pytest.approx(exact, abs=1e-10)
        assert found.state[0, 1] == pytest.approx(10, abs=1e-9)
        assert found.time[1:].tolist() == [np.inf, 0.0]
    lost = sympflow.escape_times(system, "verlet", (0, 8), outside=lambda y: y[..., 0] > 10, dt=0.01)
    assert lost.status == -1
    assert np.isnan(lost.time)
    assert not lost.success


def test_bad_arguments_of_escapes():
    system = henon_heiles_escape()
    for outside, error in (
        (-1.0, "`outside` must be a positive radius"),
        (lambda y: y[..., 0], "`outside` must return booleans"),
    ):
        with pytest.raises(ValueError, match=error):
            sympflow.escape_times(system, "verlet", (0, 1), outside=outside)
    with pytest.raises(TypeError, match="`outside` must be a radius"):
        sympflow.escape_times(system, "verlet", (0, 1), outside="far")
    with pytest.raises(ValueError, match="has no fixed steps"):
        sympflow.escape_times(system, "dop853", (0, 1), outside=3.0)


def test_a_turning_angle_needs_a_signal():
    """H = p²/2 − cos q turns in T = ∮dq/p, p² = 9 − 4 sin²(q/2): 4 K(4/9)/3, the parameter being k²."""
    run = {"t_span": (0, 300), "y0": [0.0, 3.0]}
    with pytest.warns(RuntimeWarning, match="`signal`: q1 grows with time"):
        sympflow.frequencies("p**2/2 - cos(q)", **run)
    found = sympflow.frequencies("p**2/2 - cos(q)", signal=lambda y: np.exp(1j * y[..., :1, :]), **run)
    assert found.frequencies[0, 0] == pytest.approx(2 * np.pi / (4 * ellipk(4 / 9) / 3), abs=1e-8)
    assert found.message == "The solver successfully reached the end of the integration interval."


def test_the_frequency_of_an_oscillator():
    system = harmonic_oscillator()
    found = sympflow.frequencies(system, "impulse", (0, 100), [1.0, 0.0], dt=0.1, n=2)  # its flow is exact
    assert found.frequencies[0, 0] == pytest.approx(1, abs=1e-13)
    assert np.isnan(found.frequencies[0, 1])  # there is no other line
    assert found.amplitudes[0, 0] == pytest.approx(1, abs=1e-12)
    assert found.success
