"""`discover`: the true terms and no other, with errors that are those of the coefficients; and honest refusals."""

import pickle

import numpy as np
import pytest
import sympy as sp

import sympflow
from sympflow.learning.library import Library, coordinates, library_for, polynomials
from sympflow.learning.orbits import Gauss, Method
from sympflow.learning.shooting import Problem, minimized
from sympflow.learning.trajectories import Trajectories
from sympflow.systems import damped_pendulum, pendulum

t = np.linspace(0, 5, 31)
(q,), (p,) = coordinates(1)


def measured(system, sigma, n=6, seed=0):
    starts = pendulum().domain.sample(n, seed)
    sol = sympflow.solve(system, "kahan_li8" if system.conservative else "srkn11b", (0, 5), starts, t_eval=t, dt=0.05)
    return t, sol.y + sigma * np.random.default_rng(seed).normal(size=sol.y.shape)


@pytest.fixture(scope="module")
def found():
    return sympflow.discover(measured(pendulum(), 0.01))


def test_the_true_terms_and_no_other(found):
    record = found.discovery
    assert set(record.terms) == {sp.cos(q), p**2}
    truth = {sp.cos(q): -1.0, p**2: 0.5}
    for f, c, error in zip(record.terms, record.coefficients, record.errors, strict=True):
        assert abs(c - truth[f]) < min(5 * error, 0.01 * abs(truth[f]))
    np.testing.assert_allclose(record.noise, 0.01, rtol=0.15)
    assert record.explains
    assert not record.remark
    assert record.formula().startswith("- 0.9") or record.formula().startswith("- 1.0")


def test_missing_values_irregular_times_and_one_trajectory():
    _, y = measured(pendulum(), 0.01, n=1)
    random = np.random.default_rng(1)
    y[random.random(y.shape) < 0.2] = np.nan
    kept = np.sort(random.permutation(len(t))[:26])
    system = sympflow.discover([(t[kept], y[0][:, kept])], ["p**2", "cos(q)", "q**2", "q**4", "p**4"])
    assert set(system.discovery.terms) == {sp.cos(q), p**2}
    assert all(model.held_out is None for model in system.discovery.path)


def noisy(H, ndof, seed, n=6, sigma=0.01):
    """Trajectories of a symbolic H over a period or so, with noise."""
    random = np.random.default_rng(seed)
    system = sympflow.HamiltonianSystem.from_sympy(H, y0=[0.7] * (2 * ndof))
    times = np.linspace(0, 6, 31)
    starts = random.uniform(-1, 1, (n, 2 * ndof))
    y = np.stack([sympflow.solve(system, "gauss_legendre6", (0, 6), x, t_eval=times, dt=0.05).y for x in starts])
    return times, y + sigma * random.normal(size=y.shape)


@pytest.mark.parametrize(
    ("H", "ndof"),
    [("0.3*q*p", 1), ("q1*p2 - q2*p1", 2), ("(p1**2 + p2**2)/2 + 0.8*(q1*p2 - q2*p1) + 0.32*(q1**2 + q2**2)", 2)],
    ids=["q p", "rotation", "Larmor"],
)
def test_quadratic_forms_of_q_and_p_are_found(H, ndof):
    found = sympflow.discover(noisy(H, ndof, 0), "polynomials", degree=2)
    names = {s.name: s for pair in coordinates(ndof) for s in pair} | ({"q": q, "p": p} if ndof == 1 else {})
    assert set(found.discovery.terms) == set(sp.expand(sp.sympify(H, names)).as_coefficients_dict())
    assert found.discovery.explains


def circles(sigma):
    """Ten orbits of one radius: those of q²/2 + p²/2, of −1/r + p²/2, of q1 p2 − q2 p1."""
    random = np.random.default_rng(0)
    angle = random.uniform(0, 2 * np.pi, 10)[:, None] + t
    y = np.stack([np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)], 1)
    return t, y + sigma * random.normal(size=y.shape)


@pytest.mark.parametrize(
    ("data", "same"),
    [pytest.param(circles(0.0), "p2 - q1, p1 + q2", marks=pytest.mark.slow), (circles(0.01), "p2 - q1, p1 + q2")],
)
def test_what_the_data_do_not_tell_is_said(data, same):
    with pytest.warns(UserWarning, match="The data do not determine H elsewhere: .* within the noise, ") as said:
        found = sympflow.discover(data, [*polynomials(2, 2), "cos(q1)", "cos(q2/2)"])
    assert same in str(said[-1].message)
    record = found.discovery
    assert not record.explains
    assert record.unseen
    assert Library(record.unseen, 2).values(data[1][0].T).std(axis=0).max() < 0.1
    assert found.domain.contains(data[1][0].T).all()
    assert not found.domain.contains(np.zeros((1, 4))).any() or same.startswith("q1")


def test_friction_and_a_wrong_library_are_told():
    with pytest.warns(UserWarning, match=r"No sparse Hamiltonian .* times the noise. Friction p' = -γp with γ = 0"):
        system = sympflow.discover(measured(damped_pendulum(0.1), 0.01), ["p**2", "cos(q)"])
    assert not system.discovery.explains
    with pytest.warns(UserWarning, match="Terms outside of the library fit much better"):
        sympflow.discover(measured(pendulum(), 0.01), ["p**2", "q**2"])


def test_the_hamiltonian_behind_a_flow():
    flow = next(f for f in sympflow.shipped_flows() if f.name == "pendulum-primed-3-0.4").load(pendulum())
    record = sympflow.discover(flow).discovery
    assert set(record.terms) == {sp.cos(q), p**2}
    np.testing.assert_allclose(sorted(record.coefficients), [-1.0, 0.5], rtol=1e-3)


def test_libraries_leave_out_what_the_data_cannot_tell():
    states = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    library, superfluous = library_for(["q**2", "2*q**2 + 1", "polynomials", "distances"], 1, 2, states)
    assert library.expressions == (q**2, q, p, p * q, p**2)  # r comes near 0, so no power of it is a term
    assert superfluous == (2 * q**2 + 1,)
    four = library_for("polynomials", 4, 4, np.random.default_rng(0).normal(size=(500, 8)))[0]
    (a, b, *_), _ = coordinates(4)
    assert (a - b) ** 4 in four.expressions
    assert a * b not in four.expressions


def test_degrees_and_milliseconds_give_the_same_formula(found):
    times, y = measured(pendulum(), 0.01)
    units = {"t": "ms", "q": "deg", "p": "deg/ms"}
    again = sympflow.discover((1e3 * times, np.rad2deg(y) * [[1], [1e-3]]), ["p**2", "cos(q)", "q**2"], units=units)
    assert again.discovery.terms == found.discovery.terms
    np.testing.assert_allclose(again.discovery.coefficients, found.discovery.coefficients, rtol=1e-4)


OSCILLATOR = "(p1**2 + p2**2 + q1**2 + q2**2)/2"


TURNED = f"{OSCILLATOR} + 0.1*(q1*p2 - q2*p1)"


@pytest.mark.parametrize(
    ("H", "n", "seed"),
    [
        pytest.param(f"{OSCILLATOR} - sqrt(q1**2 + q2**2)", 10, 1, marks=pytest.mark.slow),  # a spring of length 1
        pytest.param(f"{OSCILLATOR} - sqrt(q1**2 + q2**2)", 6, 4, marks=pytest.mark.slow),
        pytest.param(OSCILLATOR, 10, 1, marks=pytest.mark.slow),
        pytest.param(TURNED, 6, 2, marks=pytest.mark.slow),
        pytest.param(TURNED, 10, 1, marks=pytest.mark.slow),
        ("p1**2/2 + q1**2/2", 6, 2),
    ],
)
def test_terms_that_are_nearly_alike_are_told_apart(H, n, seed):
    """Cosines, powers and distances make up each other nearly; the search does not end among them."""
    ndof = 2 if "q2" in H else 1
    found = sympflow.discover(noisy(H, ndof, seed, n))
    names = {s.name: s for pair in coordinates(ndof) for s in pair}
    truth = sp.expand(sp.sympify(H, names)).as_coefficients_dict()
    assert found.discovery.explains
    assert set(found.discovery.terms) == set(truth)
    for f, c, error in zip(found.discovery.terms, found.discovery.coefficients, found.discovery.errors, strict=True):
        assert abs(c - float(truth[f])) < 5 * error


def test_the_gain_of_a_term_is_what_its_fit_gains():
    """An H(q, p) that is not separable; the linear model of a small coefficient is right to its size."""
    library = Library([q**2, sp.cos(q), p**2, p**2 * q**2], 1)
    assert library.by_kind().expressions == library.expressions
    theta, sigma = np.array([0.4, -0.2, 0.5, 0.1]), np.array([0.1, 0.2])
    method, starts = Method(Gauss(2), 0.1), np.array([[0.5, 0.3], [-0.2, 0.8]])
    random = np.random.default_rng(0)
    times = [np.cumsum(random.uniform(0.05, 0.4, n)) for n in (12, 9)]
    blank = Trajectories.read([(one, np.zeros((2, len(one)))) for one in times])
    orbits = Problem(library.model(), blank, method, sigma).orbits(theta, starts)
    data = Trajectories.read([*zip(times, orbits, strict=True)])
    fewer = minimized(Problem(library.subset([0, 1, 2]).model(), data, method, sigma), theta[:3], starts, gain=1e-9)
    whole = Problem(library.model(), data, method, sigma)
    gains = whole.normal(np.array([*fewer.theta, 0.0]), fewer.states).gains(np.array([True, True, True, False]))
    left = minimized(whole, theta, starts).cost
    assert (gains[:3] == 0).all()
    assert gains[3] == pytest.approx(fewer.cost - left, rel=0.1)
    assert left < 1e-20


def test_outliers_are_left_to_hubers_loss():
    """Every tenth value is off by 50 σ; the noise is found to the share that they leave of it."""
    times, y = measured(pendulum(), 0.01)
    y[:, 0, ::10] += 0.5
    record = sympflow.discover((times, y), ["p**2", "cos(q)", "q**2"], loss="huber").discovery
    assert set(record.terms) == {sp.cos(q), p**2}
    np.testing.assert_allclose(sorted(record.coefficients), [-1.0, 0.5], rtol=0.01)
    assert record.noise == pytest.approx([0.012, 0.01], rel=0.25)


def test_the_path_shows_what_the_terms_are_worth(found):
    path = found.discovery.path
    counts = [len(model.terms) for model in path]
    chosen = path[counts.index(2)]
    assert counts == sorted(set(counts))
    assert {1, 2} < set(counts)
    assert path[0].residual > 10 * chosen.residual
    assert chosen.criterion == min(model.criterion for model in path)
    noisy, exact = (Trajectories.read(measured(pendulum(), sigma)).split()[1].runs for sigma in (0.01, 0.0))
    drawn = noisy[0].y - exact[0].y  # of the one trajectory that is held out
    left = np.sqrt((drawn**2).sum() / (drawn.size - 4)) / 0.01  # less its initial states and two coefficients
    assert chosen.held_out == pytest.approx(left, abs=0.05)
    assert "<- chosen" in found.discovery.table()
    assert found.discovery.figure().axes[0].get_yscale() == "log"


def test_the_system_is_ordinary(found):
    sol = sympflow.solve(found, "verlet", (0, 1), [1.0, 0.0], dt=0.05)
    assert sol.success
    assert found.separable
    assert found.domain.contains(found.y0[None]).all()
    again = pickle.loads(pickle.dumps(found))
    assert again.discovery.terms == found.discovery.terms


def test_noise_and_slopes_are_seen_without_a_model():
    _, y = measured(pendulum(), 0.02, n=20)
    curves = Trajectories.read((t, y)).smooth
    np.testing.assert_allclose(curves.sigma, 0.02, rtol=0.25)
    field = pendulum().vector_field(curves.points)
    assert np.std(curves.slopes - field) < 0.1 * np.std(field)
