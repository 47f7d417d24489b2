"""Kepler's flow, beside one of sixty digits, and orbital elements."""

import mpmath as mp
import numpy as np
import pytest
import torch

from sympflow.arrays import jvp
from sympflow.hamiltonian.kepler import elements_of, kepler_flow, states_of

EPS = np.finfo(float).eps


def exact(x, v, mu, t):
    """Positions and velocities after t: the universal Kepler equation, by bisection and Newton's method."""
    x, v, mu, t = [mp.mpf(a) for a in x], [mp.mpf(a) for a in v], mp.mpf(mu), mp.mpf(t)
    r, eta = mp.sqrt(sum(a * a for a in x)), sum(a * b for a, b in zip(x, v, strict=True))
    beta = 2 * mu / r - sum(a * a for a in v)
    k = mp.sqrt(abs(beta))
    cosine, sine = (mp.cos, mp.sin) if beta > 0 else (mp.cosh, mp.sinh)

    def G(X):
        c, s = cosine(k * X), sine(k * X) / k
        return c, s, (1 - c) / beta, (X - s) / beta

    def excess(X):
        _, _, G2, G3 = G(X)
        return r * X + eta * G2 + (mu - beta * r) * G3 - t

    low, high = mp.mpf(0), mp.mpf(mp.sign(t))
    while excess(high) * high < 0:
        high *= 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) * high < 0 else (low, middle)
    for _ in range(12):
        _, G1, G2, _ = G(low)
        low -= excess(low) / (r + eta * G1 + (mu - beta * r) * G2)
    _, G1, G2, G3 = G(low)
    end = r + eta * G1 + (mu - beta * r) * G2
    f, g, df, dg = 1 - mu * G2 / r, t - mu * G3, -mu * G1 / (r * end), 1 - mu * G2 / end
    pairs = list(zip(x, v, strict=True))
    return np.array([f * a + g * b for a, b in pairs]), np.array([df * a + dg * b for a, b in pairs])


def size(x):
    return float(mp.sqrt(sum(a * a for a in x)))


def test_a_flight_from_a_tiny_pericentre_is_followed():
    """The first guess t/r is 10¹² times too long, and the universal variable far out is that of an exponential."""
    q, mu = 1e-12, 1.25
    for e in (1 + 1e-12, 1.5, 30.0):
        start = [q, 0.0, 0.0], [0.0, np.sqrt(mu * (1 + e) / q), 0.0]
        with mp.workdps(60):
            for t in (0.6, -0.63, 3.0, 1e6):
                x, v = exact(*start, mu, t)
                found = kepler_flow(*start, np.array(mu), np.array(t))
                for a, b in zip(found, (x, v), strict=True):
                    assert size(np.array(a) - b) < 30 * EPS * (1 + 2 / (e - 1)) * size(b)  # β = 2μ/r − v² cancels


def assert_as_exact_as_conditioned(x, v, mu, t, rng):
    """The error is at most a few times what a change of the data by half a unit in their last places makes."""
    found = [np.array(a) for a in kepler_flow([*x], [*v], np.array(mu), np.array(t))]
    right = exact(x, v, mu, t)
    least = [size(a) * EPS / 2 for a in right]
    for _ in range(8):
        c = [1 + mp.mpf(s) for s in rng.choice([-EPS / 2, EPS / 2], 8)]
        other = exact([mp.mpf(a) * s for a, s in zip(x, c, strict=False)],
                      [mp.mpf(a) * s for a, s in zip(v, c[3:], strict=False)], mu * c[6], t * c[7])  # fmt: skip
        least = [max(a, size(y - z)) for a, y, z in zip(least, other, right, strict=True)]
    for a, b, bound in zip(found, right, least, strict=True):
        assert size(a - b) < 100 * bound


@pytest.mark.parametrize("e", [1.001, 1.5, 30.0])
@pytest.mark.parametrize("t", [1e3, -1e8])
def test_a_flight_in_from_far_out_on_a_hyperbola_is_followed(e, t):
    """Sums of Stumpff functions cancel there."""
    rng = np.random.default_rng(0)
    x, v = (np.array(a) for a in kepler_flow([0.1, 0.0, 0.0], [0.0, np.sqrt(10 * (1 + e)), 0.0], np.array(1.0), t))
    with mp.workdps(60):
        for back in (-0.9 * t, -t, -1.001 * t):
            assert_as_exact_as_conditioned(x, v, 1.0, back, rng)


@pytest.mark.parametrize(
    "e", [0.0, 1e-9, 0.1, 0.5, 0.9, 0.99, 1 - 1e-4, 1 - 1e-8, 1 - 1e-12, 1.0, 1 + 1e-12, 1 + 1e-6, 1.1, 3.0]
)
def test_it_is_as_exact_as_its_conditioning_allows(e):
    rng = np.random.default_rng(1)
    with mp.workdps(60):
        for k in range(4):
            mu = rng.uniform(0.5, 2)
            q = rng.uniform(0.2, 2) if e <= 0.99 or k % 2 else max(abs(1 - e), 1e-12)
            start = [q, 0.0, 0.0], [0.0, np.sqrt(mu * (1 + e) / q), 0.0]
            x, v = (np.array(a) for a in kepler_flow(*start, np.array(mu), np.array(rng.uniform(-0.7, 0.7))))
            assert_as_exact_as_conditioned(x, v, mu, rng.uniform(-3, 3), rng)


def test_elements_and_states_are_each_others_inverse():
    rng = np.random.default_rng(0)
    e = np.concatenate([rng.uniform(0.01, 0.95, 60), rng.uniform(1.05, 4, 20)])
    a = np.where(e < 1, 1, -1) * rng.uniform(0.3, 30, 80)
    angles = [rng.uniform(0.05, np.pi - 0.05, 80), *rng.uniform(0, 2 * np.pi, (2, 80)), rng.uniform(0.1, 2, 80)]
    elements, mu = np.stack([a, e, *angles], axis=-1).reshape(8, 10, 6), rng.uniform(0.5, 2, (8, 10))
    again = elements_of(*states_of(elements, mu), mu)
    assert np.allclose(again, elements, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("e", "inclination"), [(0.0, 0.0), (0.0, 0.3), (0.2, 0.0), (0.2, np.pi)])
def test_elements_where_angles_are_not_defined(e, inclination):
    elements = np.array([1.0, e, inclination, 0.0, 0.0, 1.0])
    x, v = states_of(elements, 1.0)
    assert np.allclose(states_of(elements_of(x, v, 1.0), 1.0), (x, v), atol=1e-14)


def test_backwards_batches_and_tensors():
    rng = np.random.default_rng(0)
    x, v = list(rng.normal(size=(3, 200))), list(rng.normal(size=(3, 200)))
    t = rng.uniform(-2, 2, 200)
    there = kepler_flow(x, v, 1.3, t)
    back = kepler_flow(*there, 1.3, -t)
    assert np.median(np.abs(np.array(back[0]) - x)) < 1e-14
    one = kepler_flow([a[7] for a in x], [a[7] for a in v], 1.3, t[7])
    assert [a[7] for a in (*there[0], *there[1])] == [*one[0], *one[1]]
    tensors = kepler_flow(
        *[[torch.tensor(a) for a in z] for z in (x, v)], torch.tensor(1.3, dtype=torch.float64), torch.tensor(t)
    )
    assert np.allclose(torch.stack(tensors[0]).numpy(), there[0], rtol=1e-9)


def test_the_derivative_of_tensors_is_that_of_the_flow():
    x, v = torch.tensor([1.0, 0.1, 0.2]).double(), torch.tensor([0.1, 1.0, 0.2]).double()
    mu, t = torch.tensor(1.0).double(), torch.tensor(0.7).double()

    def end(y):
        x, v = kepler_flow([*y[:3]], [*y[3:]], mu, t)
        return torch.stack([*x, *v])

    y, w, h = torch.cat([x, v]), torch.arange(6.0).double(), 1e-5
    _, along = jvp(end, y, w)
    assert np.allclose(along, (end(y + h * w) - end(y - h * w)) / (2 * h), atol=1e-7)
